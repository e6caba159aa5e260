"""Runs bad input through haltere and other libraries, each in a process of its own, for the page on it. It rates by rule alone.

As a script it is the process: ``python _failures.py LIBRARY FIRST`` runs the cases of a library from the FIRST on and prints one line of
JSON a case, before and after it, so that what kills the process is known.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import platform
import re
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: The motion: rate [Hz], length [s], and the time of the one bad sample [s]; errors are RMS from then on.
RATE, DURATION, BAD = 100.0, 25.0, 10.0
STEP, GRAVITY = 1.0 / RATE, 9.80665
I_BAD = int(BAD * RATE)
FLU = np.array([1.0, -1.0, -1.0])
#: Seconds that a library may take for all its cases.
LIMIT = 300.0


# The motion, NED and FRD


@dataclass
class Data:
    """What the sensors saw [s, rad/s, m/s^2, uT], (n,) and (n, 3), the true attitude q_nb (n, 4), and how the arrays are handed over."""

    t: Array
    gyro: Array
    accel: Array
    mag: Array
    q: Array
    form: Callable[[Array], Any] = lambda x: x
    step: float = STEP
    more: Mapping[str, Any] | None = None

    def but(self, **changes: Any) -> Data:
        """The same with something changed."""
        return Data(**{**self.__dict__, **changes})


def motion() -> Data:
    """Two seconds at rest, then turning about all axes and shaken by up to 0.6 m/s^2; noise and a gyro bias of a small IMU."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(1)
    t = STEP * np.arange(int(DURATION * RATE))
    ramp = np.clip((t - 2.0) / 3.0, 0.0, 1.0) ** 2
    phase = 2.0 * np.pi * t[:, None] * np.array([0.07, 0.19, 0.26])
    attitude = Rotation.from_euler("ZYX", ramp[:, None] * np.array([1.2, 0.35, 0.4]) * np.sin(phase))
    turn = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / STEP
    gyro = np.vstack([turn[:1], turn]) + np.array([0.010, -0.008, 0.006]) + rng.normal(0.0, 0.005, (len(t), 3))
    shake = ramp[:, None] * np.array([0.6, 0.5, 0.4]) * np.sin(2.0 * np.pi * t[:, None] * np.array([0.31, 0.37, 0.43]))
    accel = attitude.inv().apply(shake - [0.0, 0.0, GRAVITY]) + rng.normal(0.0, 0.05, (len(t), 3))
    mag = attitude.inv().apply([21.5, 0.0, 43.0]) + rng.normal(0.0, 0.3, (len(t), 3))
    return Data(t, gyro, accel, mag, attitude.as_quat()[:, [3, 0, 1, 2]])


def at_rest() -> Data:
    """Level and looking north for the whole time, without noise: whole numbers can say it."""
    d = motion()
    row = np.ones((len(d.t), 1))
    return d.but(gyro=0.0 * d.gyro, accel=row * [0.0, 0.0, -10.0], mag=row * [20.0, 0.0, 40.0], q=row * [1.0, 0.0, 0.0, 0.0])


def one(values: Array, what: float, at: float = BAD) -> Array:
    """The same with one bad sample."""
    out = values.copy()
    out[int(at * RATE)] = what
    return out


# The cases. A case makes data of data; ``more`` picks what a library is told besides (its own word for it is in the adapter).

#: What a message on a bad sample interval must name.
INTERVAL = r"sample (time|rate|period)|\btimes?\b|period|frequency|\brate\b|gyrTs"
SHAPE = "shape|dimension|size|length|column|elements"
Case = tuple[str, str, Callable[[Data], Data]]
NAN = float("nan")
SAMPLES: tuple[Case, ...] = (
    ("one gyro sample NaN, turning", "nan|finite", lambda d: d.but(gyro=one(d.gyro, NAN))),
    ("one gyro sample NaN, at rest", "nan|finite", lambda d: d.but(gyro=one(d.gyro, NAN, 1.5))),
    ("one accelerometer sample NaN", "nan|finite", lambda d: d.but(accel=one(d.accel, NAN))),
    ("one magnetometer sample NaN", "nan|finite", lambda d: d.but(mag=one(d.mag, NAN))),
    ("one accelerometer sample all zero", "zero", lambda d: d.but(accel=one(d.accel, 0.0))),
    ("one magnetometer sample all zero", "zero", lambda d: d.but(mag=one(d.mag, 0.0))),
    ("magnetometer zero throughout", "zero|field|magnet", lambda d: d.but(mag=0.0 * d.mag)),
    ("field parallel to specific force throughout", "parallel|dip|field|magnet", lambda d: d.but(mag=-4.8 * d.accel)),
    ("gyro in the wrong unit", "deg/s|rad/s|rate", lambda d: d.but(more={"unit": True})),
    ("accelerometer with the other sign", "gravity|sign|specific force|accel", lambda d: d.but(accel=-d.accel)),
)
#: Cases in which nothing tells the heading: only the tilt is compared.
NO_HEADING = ("magnetometer zero throughout", "field parallel to specific force throughout")
FORMS: tuple[Case, ...] = (
    (
        "arrays transposed, (3, n)",
        SHAPE,
        lambda d: d.but(form=lambda x: np.ascontiguousarray(x.T)),
    ),
    ("gyro one sample shorter", SHAPE, lambda d: d.but(more={"short": True})),
    ("empty arrays", "empty|no sample|at least|no rows|imu stream", lambda d: d.but(form=lambda x: x[:0])),
    ("Python lists", "list|array|type", lambda d: d.but(form=lambda x: x.tolist())),
    ("float32", "float32|dtype|type|contiguous", lambda d: d.but(form=lambda x: x.astype(np.float32))),
    ("integers", "int|dtype|type|contiguous", lambda d: at_rest().but(form=lambda x: np.rint(x).astype(np.int64))),
    ("Fortran order", "contiguous|order", lambda d: d.but(form=np.asfortranarray)),
    ("sample time zero", INTERVAL, lambda d: d.but(step=0.0)),
    ("sample time negative", INTERVAL, lambda d: d.but(step=-STEP)),
    ("sample time NaN", INTERVAL, lambda d: d.but(step=NAN)),
    ("a misspelt parameter", "MISSPELT", lambda d: d.but(more={"typo": True})),
    ("a negative gain or variance", "negative|positive|NEGATIVE|at least|above|>", lambda d: d.but(more={"negative": True})),
)
#: What is misspelt, and which parameter is made negative, by library.
MISSPELT = {"haltere": "noise.gyr", "vqf": "tauAac", "imufusion": "gian", "Madgwick": "gian", "Mahony": "k_Q", "EKF": "frane"}
NEGATIVE = {"haltere": "noise.gyro", "vqf": "tauAcc", "imufusion": "gain", "Madgwick": "gain", "Mahony": "k_P", "EKF": "noises"}


# The libraries, each called as its documentation does


class NotAskedError(Exception):
    """A case that never reaches the library."""


def told(d: Data, what: str) -> bool:
    return bool(d.more and d.more.get(what))


def handed(d: Data, *values: Array) -> list[Any]:
    """Arrays as the case hands them over; the gyro comes first."""
    first, *rest = values
    return [d.form(first[:-1] if told(d, "short") else first), *(d.form(v) for v in rest)]


def with_haltere(d: Data) -> tuple[Array, str]:
    import haltere
    from haltere.flight.log import FlightLog

    gyro, accel, mag = handed(d, d.gyro * (180.0 / np.pi if told(d, "unit") else 1.0), d.accel, d.mag)
    t: Any = {STEP: d.t, 0.0: 0.0 * d.t, -STEP: -d.t}.get(d.step, d.t + NAN)
    if isinstance(gyro, list) or not len(gyro) or gyro.dtype == np.float32:
        t = d.form(t)

    def columns(stem: str, v: Any) -> dict[str, Any]:
        return {f"{stem}_{a}": [row[k] for row in v] if isinstance(v, list) else v[:, k] for k, a in enumerate("xyz")}

    streams = {"imu": {"t": t, **columns("gyro", gyro), **columns("accel", accel)}, "magnetometer": {"t": t, **columns("mag", mag)}}
    changes = {MISSPELT["haltere"]: 0.01} if told(d, "typo") else {NEGATIVE["haltere"]: -0.01} if told(d, "negative") else {}
    solution = haltere.run(FlightLog(streams), "ahrs", set=changes)
    # Rows begin at alignment, and a sample that is left out has none: there the row before stands.
    row = np.searchsorted(solution.t, d.t + 1e-3) - 1
    q = np.column_stack([solution[f"q_{a}"] for a in "wxyz"])[np.maximum(row, 0)]
    return q, said_by(solution)


def said_by(solution: Any) -> str:
    """What a solution's summary says of the input: samples left out, warnings, and sensors that are not well."""
    summary = solution.summary
    lost = [
        f"{name}: {n} {reason}"
        for name, s in summary["streams"].items()
        for reason, n in s["discarded"].items()
        if reason not in ("before alignment", "after the last IMU sample")
    ]
    ill = [f"{sensor} {h['verdict']}: {h['why']}" for sensor, h in summary["health"].items() if h["verdict"] not in ("good", "unknown")]
    return "; ".join(dict.fromkeys([*lost, *(w for w in summary.get("warnings", []) if not w.startswith("simulated")), *ill])).strip("; ")


def with_vqf(d: Data) -> tuple[Array, str]:
    from vqf import VQF

    more = {"tauAac": 3.0} if told(d, "typo") else {"tauAcc": -1.0} if told(d, "negative") else {}
    unit = 180.0 / np.pi if told(d, "unit") else 1.0
    out = VQF(d.step, **more).updateBatch(*handed(d, d.gyro * FLU * unit, d.accel * FLU, d.mag * FLU))
    return from_enu(out["quat9D"]), ""


def with_imufusion(d: Data) -> tuple[Array, str]:
    import imufusion

    more = {"gian": 0.5} if told(d, "typo") else {"gain": -1.0} if told(d, "negative") else {}
    ahrs = imufusion.Ahrs()
    ahrs.set_settings(imufusion.AhrsSettings(sample_rate=RATE, **more))
    if d.step != STEP:
        ahrs.set_sample_period(d.step)
    if told(d, "short") or not len(d.form(d.gyro)):
        raise NotAskedError("the loop over the samples is the user's")
    gyro, accel, mag = handed(d, d.gyro * FLU * (1.0 if told(d, "unit") else 180.0 / np.pi), d.accel * FLU / GRAVITY, d.mag * FLU)
    q = []
    for i in range(len(accel)):
        ahrs.update(gyro[i], accel[i], mag[i])
        q.append(ahrs.get_quaternion())
    return from_nwu(np.array(q)), ""


def with_ahrs(name: str) -> Callable[[Data], tuple[Array, str]]:
    def call(d: Data) -> tuple[Array, str]:
        import ahrs

        turn, sign = (np.ones(3), -1.0) if name == "EKF" else (FLU, 1.0)
        more: dict[str, Any] = {"frequency": 1.0 / d.step if d.step else 0.0}
        if name == "EKF":
            more["magnetic_ref"] = math.degrees(math.atan2(43.0, 21.5))
        if told(d, "typo"):
            more[MISSPELT[name]] = 0.5
        if told(d, "negative"):
            more[NEGATIVE[name]] = [-0.1, -0.1, -0.1] if name == "EKF" else -1.0
        unit = 180.0 / np.pi if told(d, "unit") else 1.0
        gyro, accel, mag = handed(d, d.gyro * turn * unit, sign * d.accel * turn, d.mag * turn)
        q = getattr(ahrs.filters, name)(gyr=gyro, acc=accel, mag=mag, **more).Q
        return {"Madgwick": from_nwu, "Mahony": from_enu, "EKF": np.asarray}[name](q), ""

    return call


def from_enu(q: Array) -> Array:
    """Quaternions body FLU to ENU as body FRD to NED."""
    w, x, y, z = np.asarray(q, dtype=np.float64).T * math.sqrt(0.5)
    return np.column_stack([w + z, x + y, x - y, w - z])


def from_nwu(q: Array) -> Array:
    """Quaternions body FLU to NWU as body FRD to NED."""
    return np.asarray(q, dtype=np.float64) * [1.0, 1.0, -1.0, -1.0]


ATTITUDE: dict[str, Callable[[Data], tuple[Array, str]]] = {
    "haltere": with_haltere,
    "vqf": with_vqf,
    "imufusion": with_imufusion,
    "Madgwick": with_ahrs("Madgwick"),
    "Mahony": with_ahrs("Mahony"),
    "EKF": with_ahrs("EKF"),
}


# Kalman filters: position and velocity along a line, from positions ten times a second; haltere: a flight with ten fixes a second

SHORT, NOISE = 0.1, 1.0
OWN_SD = "its own 1σ of the position"


@dataclass
class Track:
    """Measurements (n, 1), the truth (n,), and what else a filter is told."""

    z: Any
    truth: Array
    R: float = NOISE**2
    missing: bool = False
    typo: bool = False


def track() -> Track:
    rng = np.random.default_rng(2)
    t = SHORT * np.arange(600)
    truth = 20.0 * np.sin(0.1 * t) + 0.5 * t
    return Track((truth + rng.normal(0.0, NOISE, len(t)))[:, None], truth)


def bad_fix(k: Track, what: float) -> Track:
    z = k.z.copy()
    z[300] = what
    return Track(z, k.truth)


Line = tuple[str, str, Callable[[Track], Track]]
LINES: tuple[Line, ...] = (
    ("one NaN measurement", "nan|finite", lambda k: bad_fix(k, NAN)),
    ("one missing measurement, said as documented", "missing", lambda k: Track(bad_fix(k, NAN).z, k.truth, missing=True)),
    ("two numbers where one is measured", SHAPE, lambda k: Track(np.hstack([k.z, k.z]), k.truth)),
    ("a negative measurement variance", "negative|positive|NEGATIVE", lambda k: Track(k.z, k.truth, R=-(NOISE**2))),
    ("a misspelt parameter", "MISSPELT", lambda k: Track(k.z, k.truth, typo=True)),
    ("no measurement at all", "empty|no measurement|at least|no gnss", lambda k: Track(k.z[:0], k.truth[:0])),
    ("Python lists", "list|array|type", lambda k: Track(k.z.tolist(), k.truth)),
    ("float32", "float32|dtype|type", lambda k: Track(k.z.astype(np.float32), k.truth)),
    ("integers", "int|dtype|type", lambda k: Track(np.rint(k.z).astype(np.int64), k.truth)),
)
F, H = np.array([[1.0, SHORT], [0.0, 1.0]]), np.array([[1.0, 0.0]])
Q = 0.5 * np.array([[SHORT**3 / 3.0, SHORT**2 / 2.0], [SHORT**2 / 2.0, SHORT]])
MISSPELT |= {"filterpy": "transition", "pykalman": "transition_matrixes", "simdkalman": "process_nose", "haltere, navigator": "noise.gyr"}


NEGATIVE |= {
    "filterpy": r"\bR\b",
    "pykalman": "observation_covariance",
    "simdkalman": "observation_noise",
    "haltere, navigator": "noise.gnss_position",
}


def with_filterpy(k: Track) -> tuple[Array, str]:
    from filterpy.kalman import KalmanFilter

    f = KalmanFilter(dim_x=2, dim_z=1)
    f.F, f.H, f.Q, f.R, f.P = F, H, Q, np.array([[k.R]]), 100.0 * np.eye(2)
    if k.typo:
        f.transition = F
    out = []
    for z in k.z:
        f.predict()
        f.update(None if k.missing and np.isnan(z).any() else z)
        out.append(float(f.x[0, 0]))
    return np.array(out), ""


def with_pykalman(k: Track) -> tuple[Array, str]:
    from pykalman import KalmanFilter

    f = KalmanFilter(
        transition_matrices=F, observation_matrices=H, transition_covariance=Q, observation_covariance=[[k.R]],
        initial_state_mean=[0.0, 0.0], initial_state_covariance=100.0 * np.eye(2), **({"transition_matrixes": F} if k.typo else {}),
    )  # fmt: skip
    means, _ = f.filter(np.ma.masked_invalid(k.z) if k.missing else k.z)
    return np.asarray(means)[:, 0], ""


def with_simdkalman(k: Track) -> tuple[Array, str]:
    import simdkalman

    f = simdkalman.KalmanFilter(
        state_transition=F, process_noise=Q, observation_model=H, observation_noise=k.R, **({"process_nose": Q} if k.typo else {})
    )
    z = k.z if isinstance(k.z, list) else k.z[None, :, :] if k.z.shape[1:] == (2,) else k.z[None, :, 0]
    z = [[row[0] for row in z]] if isinstance(z, list) else z
    done = f.compute(z, 0, initial_value=[0.0, 0.0], initial_covariance=100.0 * np.eye(2), filtered=True)
    return np.asarray(done.filtered.states.mean)[0, :, 0], ""


def with_navigator(k: Track) -> tuple[Array, str]:
    """A flight; the bad measurement is the north velocity or the latitude of a fix. Errors are of the north position."""
    import haltere
    from haltere.flight.log import FlightLog
    from haltere.simulate import demo_flight

    flight = demo_flight(seed=1, duration=60.0)
    gnss = dict(flight["gnss"].columns)
    if not isinstance(k.z, list) and not len(k.z):
        gnss = {name: v[:0] for name, v in gnss.items()}
    elif isinstance(k.z, list):
        gnss = {name: v.tolist() for name, v in gnss.items()}
    elif k.z.shape[1] == 2:
        gnss["lat"] = np.column_stack([gnss["lat"], gnss["lat"]])
    elif k.z.dtype == np.float32:
        gnss = {name: v.astype(np.float32) if name.startswith("vel") else v for name, v in gnss.items()}
    elif k.z.dtype == np.int64:
        gnss = {name: np.rint(v).astype(np.int64) if name in ("h_acc", "v_acc", "fix_type", "num_sats") else v for name, v in gnss.items()}
    elif np.isnan(k.z).any():
        for name in ("lat", "vel_n"):
            gnss[name][300] = np.nan
    changes: dict[str, Any] = {"noise.gyr": 0.01} if k.typo else {"noise.gnss_position": -1.0} if k.R < 0.0 else {}
    solution = haltere.run(FlightLog({**flight.streams, "gnss": gnss}, flight.meta), "navigator", set=changes)
    truth = np.interp(solution.t, flight["truth"].t, flight["truth"]["pos_n"])
    late = solution.t >= gnss["t"][300] if len(gnss["t"]) else solution.t >= 30.0
    said = said_by(solution)
    if not len(gnss["t"]):
        said = f"{OWN_SD}: {np.sqrt(np.mean(solution['sd_pos_n'][late] ** 2)):.2g} m; {said}".strip("; ")
    return (solution["pos_n"] - truth)[late], said


LINEAR: dict[str, Callable[[Track], tuple[Array, str]]] = {
    "haltere, navigator": with_navigator,
    "filterpy": with_filterpy,
    "pykalman": with_pykalman,
    "simdkalman": with_simdkalman,
}


# The process of one library


def attitude_error(q: Array, truth: Array) -> dict[str, float]:
    """RMS error of attitude and of tilt alone [deg] from the bad sample on, and the share of NaN there and in the last second."""
    if q.shape != truth.shape:
        return {"error": NAN, "tilt": NAN, "nans": 1.0, "end": 1.0}
    late = slice(I_BAD, None)
    bad = ~np.isfinite(q[late]).all(axis=1)
    (w, x, y, z), (a, b, c, d) = q[late][~bad].T, truth[late][~bad].T
    size = np.sqrt(w * w + x * x + y * y + z * z)
    scalar, down = (w * a + x * b + y * c + z * d) / size, (z * a - w * d + y * b - x * c) / size  # of the error seen from the earth
    total, tilt = np.abs(scalar), np.hypot(scalar, down)

    def rms(cosine: Array) -> float:
        return math.degrees(math.sqrt(float(np.mean((2.0 * np.arccos(np.clip(cosine, 0.0, 1.0))) ** 2)))) if len(cosine) else NAN

    return {"error": rms(total), "tilt": rms(tilt), "nans": float(bad.mean()), "end": float(bad[-int(RATE) :].mean())}


def line_error(x: Array, truth: Array, own: bool) -> dict[str, float]:
    """RMS error [m] from the bad measurement on, and the shares that are NaN."""
    if not len(x):
        return {"error": NAN, "nans": 0.0, "end": 0.0}
    e = x if own else (x - truth)[300:]
    bad = ~np.isfinite(e)
    rms = float(np.sqrt(np.mean(e[~bad] ** 2))) if not bad.all() else NAN
    return {"error": rms, "nans": float(bad.mean()), "end": float(bad[-10:].mean())}


def cases(library: str) -> list[tuple[str, str, Callable[[Any], Any]]]:
    """What a library is run on: good data first, and whole numbers handed over as floating-point ones."""
    if library in ATTITUDE:
        return [("good", "", lambda d: d), ("good integers", "", lambda d: at_rest()), *SAMPLES, *FORMS]
    return [("good", "", lambda k: k), *LINES]


def run_one(library: str, change: Callable[[Any], Any]) -> dict[str, Any]:
    """What became of a case."""
    try:
        if library in ATTITUDE:
            d = change(motion())
            q, said = ATTITUDE[library](d)
            errors = attitude_error(np.asarray(q, dtype=np.float64), d.q)
        else:
            k = change(track())
            x, said = LINEAR[library](k)
            errors = line_error(x, k.truth, library.startswith("haltere"))
    except NotAskedError as why:
        return {"fate": "not asked", "text": str(why)}
    except Exception as error_:
        return {"fate": "raised", "kind": type(error_).__name__, "text": " ".join(str(error_).split())}
    return {"fate": "returned", **errors, "said": said}


def work(library: str, first: int) -> None:
    """Run the cases of a library from one on."""
    warnings.simplefilter("ignore")
    for i, (_, _, change) in enumerate(cases(library)):
        if i >= first:
            print(json.dumps({"case": i}), flush=True)
            print(json.dumps({"case": i, **run_one(library, change)}), flush=True)


# The page


def outcomes(library: str) -> list[dict[str, Any]]:
    """What became of every case of a library; a process that dies is started again with the case after."""
    found: dict[int, dict[str, Any]] = {}
    n = len(cases(library))
    while len(found) < n:
        command = [sys.executable, __file__, library, str(len(found))]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
            out, status, said = done.stdout, done.returncode, done.stderr
        except subprocess.TimeoutExpired as late:
            out, status, said = (late.stdout or b"").decode(), None, ""
        begun = -1
        for line in out.splitlines():
            answer = json.loads(line) if line.startswith("{") else {}
            begun = answer.get("case", begun)
            if "fate" in answer:
                found[begun] = answer
        if len(found) < n:
            if begun in found or begun < 0 or (status is not None and status >= 0):
                raise RuntimeError(f"{library}: {said}")
            why = f"no answer in {LIMIT:.0f} s" if status is None else f"{signal.Signals(-status).name}: {' '.join(said.split())}"
            found[begun] = {"fate": "died", "text": why}
    return [found[i] for i in range(n)]


@dataclass
class Cell:
    """A word on what happened, how grave it is (good, fair, bad), what was said, and the error with good data and with bad."""

    word: str
    grade: str
    text: str = ""
    numbers: str = ""


def _short(value: float) -> str:
    return f"{value:.2g}" if value < 10.0 else f"{value:.0f}"


def rate(library: str, name: str, key: str, got: Mapping[str, Any], good: Mapping[str, Any], unit: str) -> Cell:
    """The rule: see the page."""
    if got["fate"] == "died":
        return Cell("the process dies", "bad", got["text"])
    if got["fate"] == "not asked":
        return Cell("–", "", got["text"])
    if got["fate"] == "raised":
        words = {"MISSPELT": MISSPELT.get(library, "?"), "NEGATIVE": NEGATIVE.get(library, "?")}
        for mark, word in words.items():
            key = key.replace(mark, word)
        clear = re.search(key, got["text"], re.IGNORECASE) is not None
        return Cell("refused" if clear else "obscure error", "good" if clear else "fair", f"{got['kind']}: {got['text']}")
    what = "tilt" if name in NO_HEADING else "error"
    clean, error, nans, end = good[what], got[what], got["nans"], got["end"]
    if name in ("empty arrays", "no measurement at all") and not (error <= 1e9):
        return Cell("nothing comes back", "fair")
    if end == 1.0:
        return Cell("NaN to the end" if nans < 1.0 or "one" in name else "NaN", "bad")
    if nans > 0.0:
        return Cell(f"NaN in {100 * nans:.3g} % of the rows", "bad")
    change = f"{_short(clean)} → {_short(error)} {unit}{' (tilt)' if what == 'tilt' else ''}"
    if error <= 1.2 * clean + (0.5 if unit == "°" else 0.05):
        silent = name == "a misspelt parameter" or name.startswith(("a negative", "sample time"))
        if silent:
            return Cell("accepted in silence", "bad", got["said"])
        return Cell("works", "good", got["said"], change)
    told_of = got["said"] and not got["said"].startswith(OWN_SD)
    return Cell("wrong", "fair" if told_of else "bad", got["said"], change)


def table(libraries: Iterable[str], chosen: Iterable[tuple[str, str, Any]], found: Mapping[str, list[dict[str, Any]]], unit: str) -> str:
    """HTML of one table: a row a case, a column a library."""
    libraries = list(libraries)
    head = "".join(f"<th>{escape(label(x))}</th>" for x in libraries)
    rows = []
    for name, key, _ in chosen:
        cells = []
        for library in libraries:
            names = [c[0] for c in cases(library)]
            good = found[library][names.index("good integers" if name == "integers" and "good integers" in names else "good")]
            cell = rate(library, name, key, found[library][names.index(name)], good, unit)
            short = cell.text if len(cell.text) <= 130 else cell.text[:127] + "..."
            numbers = f"<br><span>{escape(cell.numbers)}</span>" if cell.numbers else ""
            note = f'<br><small title="{escape(cell.text, quote=True)}">{escape(short)}</small>' if cell.text else ""
            cells.append(f'<td class="{cell.grade}"><strong>{escape(cell.word)}</strong>{numbers}{note}</td>')
        rows.append(f"<tr><th>{escape(name)}</th>{''.join(cells)}</tr>")
    return f'<div class="failures"><table><thead><tr><th></th>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def label(library: str) -> str:
    """A library's name and version."""
    if library in ("Madgwick", "Mahony", "EKF"):
        return f"ahrs {importlib.metadata.version('ahrs')} {library}"
    name, _, part = library.partition(", ")
    return f"{name} {importlib.metadata.version(name)} {part}".strip()


def machine() -> str:
    """What it was run on."""
    return f"Python {platform.python_version()}, NumPy {np.__version__}, {platform.system()} {platform.machine()}"


STYLE = """<style>
.failures { overflow-x: auto; margin-bottom: 1.5em }
.failures table { border-collapse: collapse; font-size: 0.72em; line-height: 1.35; table-layout: fixed; width: 100%; min-width: 58em }
.failures th, .failures td { border: 1px solid #8886; padding: 0.3em 0.4em; text-align: left; vertical-align: top; overflow-wrap: anywhere }
.failures td span { white-space: nowrap }
.failures small { opacity: 0.9 }
.failures td.good { background: #2a9d4a22 }
.failures td.fair { background: #e0a10033 }
.failures td.bad { background: #d0303033 }
</style>"""


def everything() -> dict[str, list[dict[str, Any]]]:
    """Every library through every case, two libraries at a time."""
    from concurrent.futures import ThreadPoolExecutor

    names = [*ATTITUDE, *LINEAR]
    with ThreadPoolExecutor(2) as pool:
        return dict(zip(names, pool.map(outcomes, names), strict=True))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    work(sys.argv[1], int(sys.argv[2]))
