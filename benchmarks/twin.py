"""The C++ twin of the filter (``twin.cpp``), compiled on demand and called by ctypes, and the made-up flight that both are run on.

The twin is a second, independent implementation of predict, update, gates and output rows: a yardstick for speed
(``benchmarks/run.py``) and for arithmetic (``tests/test_twin.py``). It has no queue, no alignment and no aid records.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.aids.record import BAROMETER, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER
from haltere.core.earth import gravity
from haltere.estimators.base import InitialState
from haltere.flight import config as configuration
from haltere.flight.config import Config

__all__ = ["PLAIN", "Flight", "Twin", "build", "configuration_of", "fly", "missing"]

FloatArray = NDArray[np.float64]

HERE = Path(__file__).resolve().parent
SOURCE = HERE / "twin.cpp"
FLAGS = ("-O3", "-march=native", "-std=c++17", "-shared", "-fPIC", "-Wall", "-Wextra")
#: Where the made-up flight is, and the field there: declination [rad], dip [rad], strength [uT].
HOME = (47.4, 8.5, 450.0)
FIELD = (0.05, 1.1, 48.0)


@dataclass
class Flight:
    """IMU columns, measurements in the order of their stamps as kernels read them, and the truth at each IMU sample."""

    t: FloatArray
    gyro: FloatArray
    accel: FloatArray
    kind: NDArray[np.int64]
    stamp: FloatArray
    z: FloatArray
    r: FloatArray
    q: FloatArray
    vel: FloatArray
    pos: FloatArray
    mag: FloatArray

    def initial(self, n: int = 16) -> InitialState:
        """A state to begin from: the truth, with a covariance of ordinary size."""
        sd = np.r_[[0.02] * 2, 0.05, [0.1] * 3, [0.5] * 3, [0.001] * 3, [0.02] * 3, [0.5] * (n - 15)]
        zero = np.zeros(3)
        return InitialState(0.0, self.q[0], self.vel[0], self.pos[0], zero, zero, np.diag(sd * sd), 0.0)


def _sum_of_sines(t: FloatArray, terms: tuple[tuple[float, float, float], ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sum of a sin(w t + p) over (a, w, p), and its first two derivatives."""
    x, v, a = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
    for size, w, p in terms:
        s, c = np.sin(w * t + p), np.cos(w * t + p)
        x += size * s
        v += size * w * c
        a -= size * w * w * s
    return x, v, a


def _fixes(pos: FloatArray) -> FloatArray:
    """Latitude, longitude [deg], altitude [m] of positions NED from `HOME`, on the ellipsoid."""
    lat0, lon0, alt0 = math.radians(HOME[0]), math.radians(HOME[1]), HOME[2]
    a, e2 = 6378137.0, 6.69437999014e-3
    w2 = 1.0 - e2 * math.sin(lat0) ** 2
    lat = lat0 + pos[:, 0] / (a * (1.0 - e2) / w2**1.5 + alt0)
    lon = lon0 + pos[:, 1] / ((a / math.sqrt(w2) + alt0) * np.cos(0.5 * (lat + lat0)))
    return np.stack([np.degrees(lat), np.degrees(lon), alt0 - pos[:, 2]], 1)


def fly(n: int = 100_000, rate: float = 1000.0, magnetometer: int = 10, barometer: int = 20, gnss: int = 100, seed: int = 1) -> Flight:
    """A flight on sines with exact derivatives and matched noise; an interval of 0 leaves a sensor out.

    Parameters
    ----------
    n, rate
        IMU samples and their rate [Hz].
    magnetometer, barometer, gnss
        IMU samples between two samples of each.
    seed
        Of the noise.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(n) / rate
    north, v_n, a_n = _sum_of_sines(t, ((20.0, 0.25, 0.0), (3.0, 1.1, 0.4)))
    east, v_e, a_e = _sum_of_sines(t, ((15.0, 0.31, 0.7), (2.0, 1.3, 1.1)))
    down, v_d, a_d = _sum_of_sines(t, ((5.0, 0.2, 0.3), (0.5, 1.7, 0.2)))
    roll, roll_dot, _ = _sum_of_sines(t, ((0.25, 1.9, 0.0), (0.1, 7.0, 0.5)))
    pitch, pitch_dot, _ = _sum_of_sines(t, ((0.2, 1.6, 1.0), (0.08, 9.0, 0.1)))
    yaw, yaw_dot, _ = _sum_of_sines(t, ((2.0, 0.3, 0.0), (0.2, 2.1, 0.9)))
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    C = np.empty((n, 3, 3))
    C[:, 0] = np.stack([cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy], 1)
    C[:, 1] = np.stack([cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy], 1)
    C[:, 2] = np.stack([-sp, sr * cp, cr * cp], 1)
    g = gravity(HOME[0], HOME[2])
    gyro = np.stack([roll_dot - sp * yaw_dot, cr * pitch_dot + sr * cp * yaw_dot, -sr * pitch_dot + cr * cp * yaw_dot], 1)
    accel = np.einsum("nji,nj->ni", C, np.stack([a_n, a_e, a_d - g], 1))
    gyro += 1.5e-3 * math.sqrt(rate) * 0.5 * rng.standard_normal((n, 3)) + np.array([0.002, -0.001, 0.0015])
    accel += 0.035 * math.sqrt(rate) * 0.5 * rng.standard_normal((n, 3)) + np.array([0.03, -0.02, 0.04])
    field = FIELD[2] * np.array([math.cos(FIELD[1]) * math.cos(FIELD[0]), math.cos(FIELD[1]) * math.sin(FIELD[0]), math.sin(FIELD[1])])
    mag = np.einsum("nji,j->ni", C, field) + 1.0 * rng.standard_normal((n, 3))
    c, s = np.cos(0.5 * np.array([roll, pitch, yaw])), np.sin(0.5 * np.array([roll, pitch, yaw]))
    q = np.stack(
        [
            c[0] * c[1] * c[2] + s[0] * s[1] * s[2],
            s[0] * c[1] * c[2] - c[0] * s[1] * s[2],
            c[0] * s[1] * c[2] + s[0] * c[1] * s[2],
            c[0] * c[1] * s[2] - s[0] * s[1] * c[2],
        ],
        1,
    )
    vel, pos = np.stack([v_n, v_e, v_d], 1), np.stack([north, east, down], 1)

    parts: list[tuple[int, NDArray[np.intp], FloatArray]] = []
    every = np.arange(1, n)
    if gnss:
        k = every[every % gnss == 0]
        parts.append((int(GNSS_VELOCITY), k, vel[k] + 0.15 * rng.standard_normal((len(k), 3))))
        where = pos[k] + np.array([0.5, 0.5, 1.0]) * rng.standard_normal((len(k), 3))
        parts.append((int(GNSS_POSITION), k, _fixes(where)))
    if barometer:
        k = every[every % barometer == 0]
        h = HOME[2] - down[k] + 0.5 + 0.3 * rng.standard_normal(len(k))
        parts.append((int(BAROMETER), k, np.stack([h, np.full(len(k), np.nan), np.full(len(k), np.nan)], 1)))
    if magnetometer:
        k = every[every % magnetometer == 0]
        parts.append((int(MAGNETOMETER), k, mag[k]))
    kind = np.concatenate([np.full(len(k), code, np.int64) for code, k, _ in parts])
    stamp = np.concatenate([t[k] for _, k, _ in parts])
    z = np.concatenate([v for _, _, v in parts])
    r = np.full(z.shape, np.nan)
    fixes = kind == GNSS_VELOCITY
    r[fixes] = 0.2**2
    order = np.lexsort((kind, stamp))
    return Flight(t, gyro, accel, kind[order], stamp[order], z[order], r[order], q, vel, pos, mag)


#: What the twin does not have.
PLAIN: dict[str, Any] = {
    "noise__gyro_scale": 0.0, "noise__between": 0.0, "noise__field": 0.0, "robust__innovation": 1e9, "aid__compass_watch": "off",
    "aid__motor_field": "off",
}  # fmt: skip


def configuration_of(estimator: str = "navigator", **keys: Any) -> Config:
    """Configuration of the made-up flight; dots in keys are written as two underscores."""
    given = {"home.lat": HOME[0], "home.lon": HOME[1], "home.alt": HOME[2]}
    given |= {"field.declination": FIELD[0], "field.dip": FIELD[1], "field.strength": FIELD[2]}
    return configuration.resolve(estimator, "default", {**given, **{k.replace("__", "."): v for k, v in keys.items()}})


_PARAMETERS = (
    "noise.gyro noise.accel noise.gyro_bias noise.accel_bias noise.baro_bias "
    "noise.gnss_velocity noise.gnss_position noise.gnss_altitude noise.gnss_velocity_min noise.gnss_position_min "
    "noise.barometer noise.magnetometer gate.gnss gate.barometer gate.magnetometer "
    "timeout.gnss timeout.barometer timeout.magnetometer arm.gnss_x arm.gnss_y arm.gnss_z "
    "field.tolerance_strength field.tolerance_dip field.declination field.dip field.strength home.lat home.lon home.alt"
).split()

#: As struct State of twin.cpp.
STATE = np.dtype(
    [("t", "f8"), ("q", "f8", 4), ("v", "f8", 3), ("p", "f8", 3), ("bg", "f8", 3), ("ba", "f8", 3), ("baro", "f8"), ("P", "f8", (16, 16)),
     ("t_passed", "f8", 4), ("n_fused", "i8", 4), ("n_rejected", "i8", 4)]
)  # fmt: skip


def missing() -> str | None:
    """Why the twin cannot be built here, or None."""
    return None if shutil.which("g++") else "g++ is not installed"


def build() -> Path:
    """Shared library of the twin, compiled when its source or the compiler's machine changed."""
    machine = subprocess.run(["g++", "-march=native", "-Q", "--help=target"], capture_output=True, check=True).stdout
    key = hashlib.sha256(SOURCE.read_bytes() + " ".join(FLAGS).encode() + machine).hexdigest()[:16]
    library = HERE / "build" / f"twin-{key}.so"
    if not library.exists():
        library.parent.mkdir(exist_ok=True)
        scratch = library.with_suffix(f".{os.getpid()}")
        subprocess.run(["g++", *FLAGS, "-o", str(scratch), str(SOURCE)], check=True)
        scratch.replace(library)
    return library


class Twin:
    """The compiled twin, ready to run from an initial state."""

    def __init__(self, config: Config) -> None:
        self._run = ctypes.CDLL(str(build())).run
        self._run.restype = None
        values = [config.number(key) for key in _PARAMETERS]
        values += [float(gravity(config.number("home.lat"), config.number("home.alt"))), config.number("imu.kind")]
        self._parameters = np.array(values)

    def begin(self, initial: InitialState) -> NDArray[np.void]:
        """State to run from."""
        state = np.zeros(1, STATE)
        state["t"], state["baro"], state["P"][0] = initial.t, initial.baro_bias, initial.P
        for name, value in (
            ("q", initial.q_nb),
            ("v", initial.vel_n),
            ("p", initial.pos_n),
            ("bg", initial.gyro_bias_b),
            ("ba", initial.accel_bias_b),
        ):
            state[name][0] = value
        state["t_passed"] = initial.t
        return state

    def run(self, state: NDArray[np.void], f: Flight, rows: FloatArray) -> None:
        """Run over a whole flight: the state is brought to its end, ``rows`` (n, 37) is filled."""

        def at(a: NDArray[Any]) -> ctypes.c_void_p:
            return ctypes.c_void_p(a.ctypes.data)

        n, m = ctypes.c_int64(len(f.t)), ctypes.c_int64(len(f.stamp))
        self._run(
            at(state), at(self._parameters), at(f.t), at(f.gyro), at(f.accel), n, at(f.kind), at(f.stamp), at(f.z), at(f.r), m, at(rows)
        )  # fmt: skip
