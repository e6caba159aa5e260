"""Small converters of foreign recordings for the tests: PX4-ECL replay, InertialNav, BROAD, ANSFL QDR. Not part of the package.

Those with air data or a wind mast (UMN Thor, InertialNav TestLog2, WEMUAV) are in ``converters_air.py``.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from haltere.flight.field import Field, earth_field
from haltere.flight.log import FlightLog, FlightMeta
from haltere.metrics.attitude import conjugate, multiply, slerp

DEG = np.pi / 180.0


def _columns(stem: str, vectors: np.ndarray, axes: str = "xyz") -> dict[str, np.ndarray]:
    return {f"{stem}_{a}": vectors[:, k] for k, a in enumerate(axes)}


def ecl_replay(path: Path) -> FlightLog:
    """PX4-ECL replay: lines ``time_us,sensor,values``; imu is accel then gyro, mag in gauss, gps alt [mm], lon, lat [1e-7 deg]."""
    rows: dict[str, list[list[float]]] = {}
    for line in path.read_text().splitlines():
        t, sensor, *values = line.split(",")
        rows.setdefault(sensor, []).append([float(t) * 1e-6, *(float(v) for v in values)])
    a = {k: np.array(v) for k, v in rows.items()}
    imu, mag, baro, gps = a["imu"], a["mag"], a["baro"], a["gps"]
    streams = {
        "imu": {"t": imu[:, 0], **_columns("accel", imu[:, 1:]), **_columns("gyro", imu[:, 4:])},
        "magnetometer": {"t": mag[:, 0]} | {f"mag_{x}": 100.0 * mag[:, 1 + k] for k, x in enumerate("xyz")},
        "barometer": {"t": baro[:, 0], "altitude": baro[:, 1]},
        "gnss": {
            "t": gps[:, 0], "lat": gps[:, 3] * 1e-7, "lon": gps[:, 2] * 1e-7, "alt": gps[:, 1] * 1e-3,
            "vel_n": gps[:, 4], "vel_e": gps[:, 5], "vel_d": gps[:, 6],
        },
    }  # fmt: skip
    return FlightLog(streams, FlightMeta(name=path.stem, source="PX4-ECL replay (simulated)", imu_kind="mean"))


def ekf2_output(path: Path) -> dict[str, np.ndarray]:
    """EKF2's own states: q_nb, velocity and position NED, times [s]; rows before its alignment are left out."""
    a = np.genfromtxt(path, delimiter=",", skip_header=1)
    a = a[np.abs(a[:, 1]) < 0.999999]
    return {"t": a[:, 0] * 1e-6, "q": a[:, 1:5], "vel": a[:, 5:8], "pos": a[:, 8:11], "field": a[:, 17:20], "variance": a[:, 25:49]}


def inertialnav(folder: Path, *, gauss: float) -> FlightLog:
    """InertialNav text files. ``gauss`` is the magnetometer's unit in uT (0.1 for milligauss, 100 for gauss)."""

    def load(name: str) -> np.ndarray:
        return np.loadtxt(folder / f"{name}.txt")

    imu, gps, mag, ntun, att = (load(n) for n in ("IMU", "GPS", "MAG", "NTUN", "ATT"))
    timing = np.loadtxt(folder / "timing.txt")
    course, speed = gps[:, 11] * DEG, gps[:, 10]
    raw = folder / "GPSraw.txt"
    velocity = np.column_stack([speed * np.cos(course), speed * np.sin(course), gps[:, 12]])
    if raw.exists():  # three components as the receiver gave them, instead of speed and course
        fixes = np.loadtxt(raw)
        if len(fixes) == len(gps):
            velocity = fixes[:, 4:7]
    field = mag[:, 2:5] - mag[:, 5:8]
    onboard = {}
    if np.abs(att[:50, 2]).max() < 20.0:  # some of the files have their columns in another order: then there is no reference
        q = _quaternions(att[:, 2:5] * DEG)
        onboard = {"onboard": {"t": att[:, 1] * 1e-3} | {f"q_{x}": q[:, k] for k, x in enumerate("wxyz")}}
    streams = {
        "imu": {"t": imu[:, 1] * 1e-3, **_columns("gyro", imu[:, 2:]), **_columns("accel", imu[:, 5:])},
        "magnetometer": {"t": mag[:, 1] * 1e-3} | {f"mag_{x}": gauss * field[:, k] for k, x in enumerate("xyz")},
        "gnss": {"t": gps[:, 2] * 1e-3, "lat": gps[:, 6], "lon": gps[:, 7], "alt": gps[:, 9], "fix_type": gps[:, 1]}
        | {f"vel_{x}": velocity[:, k] for k, x in enumerate("ned")},
        "barometer": {"t": ntun[:, 1] * 1e-3, "altitude": ntun[:, 8]},
        **onboard,
    }  # fmt: skip
    delays = dict(zip(("gnss_velocity", "gnss_position", "barometer", "magnetometer"), timing[3:7] * 1e-3, strict=True))
    return FlightLog(
        streams, FlightMeta(name=folder.name, source="InertialNav text files", delays={k: float(v) for k, v in delays.items()})
    )


def _quaternions(rpy: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", rpy[:, ::-1]).as_quat()[:, [3, 0, 1, 2]]


def broad(path: Path) -> tuple[FlightLog, dict[str, np.ndarray]]:
    """One BROAD trial: a flight with its sensor axes turned from FLU to FRD, and the raw arrays by the data set's names."""
    from scipy.io import loadmat

    m = loadmat(path, squeeze_me=True)
    raw = {k: np.asarray(m[k]) for k in ("imu_gyr", "imu_acc", "imu_mag", "opt_quat", "movement")}
    rate = float(m["sampling_rate"])
    raw["rate"] = np.array(rate)
    t = np.arange(len(raw["imu_gyr"])) / rate
    turn = np.array([1.0, -1.0, -1.0])
    gyro, accel, mag = (turn * raw[k] for k in ("imu_gyr", "imu_acc", "imu_mag"))
    streams = {
        "imu": {"t": t} | {f"gyro_{x}": gyro[:, k] for k, x in enumerate("xyz")} | {f"accel_{x}": accel[:, k] for k, x in enumerate("xyz")},
        "magnetometer": {"t": t} | {f"mag_{x}": mag[:, k] for k, x in enumerate("xyz")},
    }
    return FlightLog(streams, FlightMeta(name=path.stem, source="BROAD")), raw


def broad_errors(q_enu: np.ndarray, raw: dict[str, np.ndarray]) -> tuple[float, float]:
    """RMS total and inclination error [deg] over the movement phase, rows without truth skipped, no alignment (BROAD's metric)."""
    ref = raw["opt_quat"]
    use = raw["movement"].astype(bool) & np.isfinite(ref).all(axis=1) & np.isfinite(q_enu).all(axis=1)
    a, b = q_enu[use], ref[use]
    # earth-frame error q_e = q_est * conj(q_ref)
    w = np.sum(a * b, axis=1)
    z = -a[:, 0] * b[:, 3] - a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1] + a[:, 3] * b[:, 0]
    total = 2.0 * np.arccos(np.clip(np.abs(w), 0.0, 1.0))
    inclination = 2.0 * np.arccos(np.clip(np.hypot(w, z), 0.0, 1.0))
    return float(np.degrees(np.sqrt(np.mean(total**2)))), float(np.degrees(np.sqrt(np.mean(inclination**2))))


def enu_flu_from_ned_frd(q: np.ndarray) -> np.ndarray:
    """Quaternion body FLU to ENU of q_nb (NED/FRD): inverse of the map in theory-amendments.md §8."""
    c = np.sqrt(0.5)
    return c * np.column_stack([q[:, 0] + q[:, 3], q[:, 1] + q[:, 2], q[:, 1] - q[:, 2], q[:, 0] - q[:, 3]])


#: Clock of the ANSFL QDR raw files of 11:14:38: seconds of the vehicle's log at ``SampleTimeFine`` 677.583 s (the first sample of DOT 1);
#: both sensors are on one clock. 180.495 s was noted beside the data; correlating rates (`rates_fit`) gives 0.03 s less for both sensors.
QDR_CLOCK, QDR_FIRST = 180.495 - 0.03, 677.583
#: Xsens DOT (x forward, y left, z up as mounted) to FRD.
#: How long the magnetometer is calibrated [s].
QDR_CALIBRATION = 60.0
QDR_AXES = np.array([1.0, -1.0, -1.0])


def ansfl_qdr(folder: Path, imu: int = 1, seed: int = 1, calibrated: bool = False) -> FlightLog:
    """Raw straight lines of ANSFL QDR: an Xsens DOT (1 or 4) on a DJI Phantom 4 RTK; ``onboard`` is the vehicle's own attitude and RTK.

    The vehicle has no plain GNSS in its log: ``gnss`` is its RTK position and velocity at 5 Hz with white noise of 1 m and 0.1 m/s added,
    seeded, and says so. The magnetometer is that of DOT 1 for both, in its arbitrary unit times what makes its mean over the first ten
    seconds the strength of the Earth's field. Calibrated: scale and hard iron by least squares against the Earth's field seen from
    the vehicle's own attitude over the first `QDR_CALIBRATION`; errors are to be counted after it.
    """
    air, dot, mag = _qdr_vehicle(folder), _qdr_dot(folder, imu), _qdr_dot(folder, 1)
    t0 = max(dot["t"][0], mag["t"][0])
    dot, mag = ({k: v[x["t"] > t0] for k, v in x.items()} for x in (dot, mag))
    here = (air["t"] >= t0) & (air["t"] <= dot["t"][-1])
    air = {k: v[here] for k, v in air.items()}
    rng = np.random.default_rng(seed)
    field = earth_field(float(air["lat"][0]), float(air["lon"][0]), float(air["alt"][0]), 2022.51)
    m = mag["mag"] * field.strength / np.linalg.norm(mag["mag"][:1200], axis=1).mean()
    if calibrated:
        m = _qdr_calibrated(mag, air, field)
    s = slice(0, None, 2)
    metres = 1.0 / np.array([110_900.0, 111_320.0 * np.cos(air["lat"][0] * DEG)])
    n = len(air["t"][s])
    place = np.column_stack([air["lat"][s], air["lon"][s]]) + rng.normal(0.0, 1.0, (n, 2)) * metres
    streams = {
        "imu": {"t": dot["t"], **_columns("gyro", dot["gyro"]), **_columns("accel", dot["accel"])},
        "magnetometer": {"t": mag["t"], **_columns("mag", m)},
        "gnss": {
            "t": air["t"][s], "lat": place[:, 0], "lon": place[:, 1], "alt": air["alt"][s] + rng.normal(0.0, 1.0, n),
            **_columns("vel", air["vel"][s] + rng.normal(0.0, 0.1, (n, 3)), "ned"), "h_acc": np.full(n, 1.0), "v_acc": np.full(n, 1.0),
            "s_acc": np.full(n, 0.1),
        },
        "onboard": {"t": air["t"], **_columns("q", air["q"], "wxyz"), **_columns("vel", air["vel"], "ned"),
                    "lat": air["lat"], "lon": air["lon"], "alt": air["alt"]},
    }  # fmt: skip
    said = "GNSS is RTK at 5 Hz with white noise of 1 m and 0.1 m/s added"
    said += ", magnetometer calibrated with the vehicle's attitude" if calibrated else ""
    meta = FlightMeta(name=f"straight lines, DOT {imu}", source=f"ANSFL QDR; {said}, seed {seed}", start_utc="2022-07-07T08:10:25Z")
    return FlightLog(streams, meta, [said])


def _qdr_calibrated(mag: dict[str, np.ndarray], air: dict[str, np.ndarray], field: Field) -> np.ndarray:
    """Field [uT] of DOT 1: m = (Cᵀ h)/k + b solved for 1/k and b at the vehicle's attitudes."""
    h = field.strength * np.array(
        [np.cos(field.dip) * np.cos(field.declination), np.cos(field.dip) * np.sin(field.declination), np.sin(field.dip)]
    )
    use = mag["t"] < mag["t"][0] + QDR_CALIBRATION
    q = slerp(mag["t"][use], air["t"], air["q"])
    pure = np.column_stack([np.zeros(len(q)), np.tile(h, (len(q), 1))])
    seen = multiply(multiply(conjugate(q), pure), q)[:, 1:]
    A = np.column_stack([seen.ravel(), np.tile(np.eye(3), (len(q), 1))])
    x, *_ = np.linalg.lstsq(A, mag["mag"][use].ravel(), rcond=None)
    return np.asarray((mag["mag"] - x[1:]) / x[0])


def _qdr_vehicle(folder: Path) -> dict[str, np.ndarray]:
    """The vehicle's log at 10 Hz: degrees, metres, m/s NED, q_nb. Its speeds are towards north, east and down, as its positions say."""
    with open(next(folder.glob("*Airdata.csv")), encoding="utf-8-sig") as file:
        rows = list(csv.reader(file))
    at = {name.strip(): k for k, name in enumerate(rows[0])}

    def column(name: str) -> np.ndarray:
        return np.array([float(row[at[name]]) for row in rows[1:] if len(row) > at["roll(degrees)"]])

    rpy = np.column_stack([column(f"{n}(degrees)") for n in ("roll", "pitch", "compass_heading")]) * DEG
    return {
        "t": column("time(millisecond)") * 1e-3, "lat": column("latitude"), "lon": column("longitude"),
        "alt": column("altitude_above_seaLevel(meters)"), "vel": np.column_stack([column(f"{a}Speed(m/s)") for a in "xyz"]),
        "q": _quaternions(rpy),
    }  # fmt: skip


def _qdr_dot(folder: Path, imu: int) -> dict[str, np.ndarray]:
    """One Xsens DOT on the vehicle's clock and axes: rad/s, m/s^2, the field in its arbitrary unit."""
    a = np.genfromtxt(next(folder.glob(f"*DOT{imu}_*.csv")), delimiter=",", skip_header=2)  # the first row has no inertial data yet
    out = {"t": a[:, 0] * 1e-6 - QDR_FIRST + QDR_CLOCK, "accel": a[:, 4:7] * QDR_AXES, "gyro": a[:, 7:10] * DEG * QDR_AXES}
    return out | ({"mag": a[:, 10:13] * QDR_AXES} if a.shape[1] > 12 else {})


def rates_fit(folder: Path, imu: int, offsets: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Offset [s] of a DOT's clock to add to its times, the rotation from its FRD axes to the vehicle's, and the share of the vehicle's
    rates that they leave unexplained, from the offsets tried: means of the gyro over the vehicle's steps against its turns (Wahba).
    """
    from scipy.spatial.transform import Rotation

    air, dot = _qdr_vehicle(folder), _qdr_dot(folder, imu)
    q = Rotation.from_quat(air["q"][:, [1, 2, 3, 0]])
    turn = (q[:-1].inv() * q[1:]).as_rotvec()
    angle = np.cumsum(dot["gyro"], axis=0) * np.median(np.diff(dot["t"]))
    best = (0.0, np.eye(3), np.inf)
    for offset in offsets:
        t = dot["t"] + offset
        use = (air["t"][:-1] > t[0] + 1.0) & (air["t"][1:] < t[-1] - 1.0)
        mean = np.column_stack([np.diff(np.interp(air["t"], t, angle[:, k])) for k in range(3)])[use]
        a, b = turn[use] - turn[use].mean(axis=0), mean - mean.mean(axis=0)
        u, _, v = np.linalg.svd(a.T @ b)
        M = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        left = float(np.sum((a - b @ M.T) ** 2) / np.sum(a**2))
        if left < best[2]:
            best = (float(offset), M, left)
    return best
