"""What identification takes from a flight: the smoothed motion, bias-free inertial data, where it was in the air, air density. No fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.drive import run, usable
from haltere.errors import HaltereError
from haltere.flight.config import Config
from haltere.flight.corrections import mounted
from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.identify.forms import RHO0

__all__ = ["LEAST", "Motion", "Samples", "air_density", "matrices", "motion", "samples"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Length of the windows over which drag is looked at [s], and the least time in the air that anything is fitted to [s].
WINDOW, LEAST = 0.1, 10.0
#: Fewest components of GNSS fused, and 1 sigma of the velocity up to which it is taken for known [m/s].
LEAST_FIXES, KNOWN = 60, 0.4
#: The navigator must not know of drag what is to be found.
APART = {"aid.drag": "off", "aid.wind": "off"}
#: Longest interval of rotor telemetry that tells the speed between samples [s].
SLOW = 0.15
#: In the air: this far above where it last stood [m] or this fast [m/s]; and so long away from standing [s].
HEIGHT, SPEED, CLEAR = 1.0, 1.0, 1.5
#: 1 sigma of air temperature where nobody tells it [K], about the standard atmosphere.
TEMPERATURE_SD = 10.0


@dataclass
class Motion:
    """A flight smoothed, at the IMU's samples.

    Attributes
    ----------
    name
        Of the flight.
    t
        Times (n,) [s].
    q_nb, vel_n, pos_n
        Attitude (n, 4), velocity and position NED (n, 3) [m/s, m].
    gyro_b, force_b
        Angular rate [rad/s] and specific force [m/s^2] without the smoothed biases, body FRD (n, 3).
    air
        Whether it was in the air (n,).
    density, density_sd
        Air density (n,) [kg/m^3] and its relative 1 sigma, alike over the flight.
    notes
        What was assumed.
    """

    name: str
    t: FloatArray
    q_nb: FloatArray
    vel_n: FloatArray
    pos_n: FloatArray
    gyro_b: FloatArray
    force_b: FloatArray
    air: BoolArray
    density: FloatArray
    density_sd: float
    flight: FlightLog
    solution: Solution
    notes: list[str] = field(default_factory=list)


@dataclass
class Samples:
    """Means over short windows in the air, as drag is fitted to.

    Times (n,), rotation C_nb (n, 3, 3), angular acceleration ``turn_b`` (n, 3) [rad/s^2] and ``speed``, the sum of the rotor speeds (n,)
    [rad/s] where the log has them; the others as of `Motion`.
    """

    name: str
    t: FloatArray
    C_nb: FloatArray
    vel_n: FloatArray
    pos_n: FloatArray
    gyro_b: FloatArray
    turn_b: FloatArray
    force_b: FloatArray
    density: FloatArray
    speed: FloatArray | None = None

    @property
    def thrust(self) -> FloatArray:
        """Thrust per mass (n,) [m/s^2]: minus the specific force along body z."""
        return np.asarray(-self.force_b[:, 2])


def motion(
    flight: FlightLog,
    config: Config | Mapping[str, Any] | str | Path | None = None,
    set: Mapping[str, Any] | None = None,
    least: float = LEAST,
) -> Motion:
    """Smooth a flight with the navigator and take from it what identification needs.

    Raises
    ------
    HaltereError
        The log cannot be navigated on, or was never in the air long enough.
    """
    solution = run(flight, "navigator", config=config, set={**(set or {}), **APART}, smooth=True, scored=False)
    s = solution.smoothed
    if s is None:  # cannot be: it was asked for
        raise HaltereError("a smoothed run", "none", flight.meta.name)
    name = flight.meta.name or "flight"
    used = usable(flight, solution.config)
    imu = used["imu"]
    t = s.t
    if "vel_n" not in s or not np.isfinite(s["vel_n"]).all():
        raise HaltereError("velocity", "an estimator without one", name)
    gyro, force = (_at(imu.t, mounted(used, "imu", imu.vector(stem)), t) for stem in ("gyro", "accel"))
    gyro = gyro - s.vector("gyro_bias")
    force = force - s.vector("accel_bias")
    vel, pos = s.vector("vel", "ned"), s.vector("pos", "ned")
    notes: list[str] = []
    density, sd = air_density(used, solution.config, t, -pos[:, 2], notes)
    fixes = int(np.sum((solution.aids["sensor"] == "gnss") & (solution.aids["status"] == "fused")))
    if fixes < LEAST_FIXES:
        raise HaltereError("GNSS velocity or position through the flight", f"{fixes} components fused", name, "motion is not known without")
    known = np.max(s.vector("sd_vel", "ned"), axis=1) < KNOWN
    if float(np.mean(known)) < 0.99:
        notes.append(f"{100.0 * float(np.mean(~known)):.0f} % of the flight left out, where velocity is known to {KNOWN:g} m/s or worse")
    air = _in_air(solution, t, vel, pos) & known
    seconds = float(np.sum(np.diff(t)[air[1:]])) if len(t) > 1 else 0.0
    if seconds < least:
        raise HaltereError(f"at least {least:g} s in the air", f"{seconds:.1f} s", name, "identify from a log that holds a flight")
    return Motion(name, t, s.vector("q", "wxyz"), vel, pos, gyro, force, air, density, sd, used, solution, notes)


def _at(t_from: FloatArray, values: FloatArray, t: FloatArray) -> FloatArray:
    """Rows of values (m, 3) at times t, which are times of theirs or next to them."""
    i = np.clip(np.searchsorted(t_from, t), 0, len(t_from) - 1)
    j = np.maximum(i - 1, 0)
    return np.asarray(values[np.where(np.abs(t_from[j] - t) < np.abs(t_from[i] - t), j, i)])


def _in_air(solution: Solution, t: FloatArray, vel: FloatArray, pos: FloatArray) -> BoolArray:
    """Away from where it stood, and moving or above it."""
    a = solution.aids
    stood = np.sort(np.asarray(a["t"][(a["sensor"] == "zero_velocity") & (a["status"] == "fused")], dtype=np.float64))
    rest = np.zeros(len(t), bool)
    if not len(stood):
        return ~rest
    i = np.clip(np.searchsorted(stood, t), 0, len(stood) - 1)
    j = np.maximum(i - 1, 0)
    gap = np.minimum(np.abs(stood[i] - t), np.abs(stood[j] - t))
    rest |= gap < CLEAR
    # the ground is where it stood last before, or first after
    at = np.interp(stood, t, pos[:, 2])
    ground = at[np.clip(np.searchsorted(stood, t, side="right") - 1, 0, len(stood) - 1)]
    after = at[np.clip(np.searchsorted(stood, t), 0, len(stood) - 1)]
    above = np.minimum(ground - pos[:, 2], after - pos[:, 2]) > HEIGHT
    return np.asarray(~rest & (above | (np.linalg.norm(vel, axis=1) > SPEED)))


def air_density(flight: FlightLog, config: Config, t: FloatArray, height: FloatArray, notes: list[str]) -> tuple[FloatArray, float]:
    """Air density (n,) [kg/m^3] and its relative 1 sigma, from static pressure and ``baro.temperature``, else the standard atmosphere.

    ``height`` is above the origin [m]. The barometer's own temperature is that of its die and is not used.
    """
    alt0 = config.number("home.alt")
    alt = height + (0.0 if math.isnan(alt0) else alt0)
    standard = 288.15 - 0.0065 * np.clip(alt, -500.0, 11000.0)
    pressure = 101325.0 * (standard / 288.15) ** 5.25588
    known = not math.isnan(alt0)
    baro = flight.get("barometer")
    measured = None if baro is None else baro.get("pressure")
    if baro is not None and measured is not None and np.isfinite(measured).sum() > 2:
        good = np.isfinite(measured)
        pressure = np.interp(t, baro.t[good], measured[good])
        standard = 288.15 * (pressure / 101325.0) ** 0.190263
        known = True
    elif baro is not None and not known:
        altitude = baro.get("altitude")
        if np.isfinite(altitude).sum() > 2 and float(np.nanmedian(np.abs(altitude))) > 1.0:
            notes.append("air density from barometric altitude, which may count from the ground instead of from sea level")
    said = config.number("baro.temperature")
    temperature = standard if math.isnan(said) else np.full(len(t), said)
    density = pressure / (287.05 * temperature)
    sd = 0.005 if not math.isnan(said) else TEMPERATURE_SD / 288.0
    if math.isnan(said):
        notes.append(
            f"air temperature is not known: the standard atmosphere's is taken ({float(np.mean(temperature)) - 273.15:.0f} degC at this "
            f"height, 1 sigma {TEMPERATURE_SD:g} K assumed; set baro.temperature [K])"
        )
    if not known:
        notes.append(f"neither pressure nor height above sea level is known: air density {RHO0} kg/m^3 is assumed, 1 sigma 10 %")
        sd = 0.1
    return np.asarray(density), sd


def samples(m: Motion, window: float = WINDOW, speed: FloatArray | None = None) -> Samples:
    """Means over windows that lie in the air as a whole; windows of less than half the usual number of samples are left out.

    ``speed`` is the sum of the rotor speeds at the IMU's samples, where it is known better than from the log's stamps.
    """
    k = np.floor((m.t - m.t[0]) / window).astype(np.int64)
    n = int(k[-1]) + 1
    counts = np.bincount(k, minlength=n).astype(np.float64)
    flying = np.bincount(k, weights=m.air, minlength=n)
    keep = (counts > 0.0) & (flying == counts) & (counts >= 0.5 * np.median(counts[counts > 0.0]))

    def mean(values: FloatArray) -> FloatArray:
        columns = values.reshape(len(values), -1)
        sums = np.column_stack([np.bincount(k, weights=column, minlength=n) for column in columns.T])
        return np.asarray((sums[keep] / counts[keep, None]).reshape(-1, *values.shape[1:]))

    q = mean(_continuous(m.q_nb))
    q /= np.linalg.norm(q, axis=1)[:, None]
    speed = rotor_sum(m) if speed is None else speed
    gyro = mean(m.gyro_b)
    first, last = (np.full(n, -1) for _ in range(2))
    first[k[::-1]] = np.arange(len(k))[::-1]
    last[k] = np.arange(len(k))
    a, b = first[keep], np.minimum(last[keep] + 1, len(k) - 1)
    turn = (m.gyro_b[b] - m.gyro_b[a]) / np.maximum(m.t[b] - m.t[a], 1e-6)[:, None]
    return Samples(
        m.name, mean(m.t), matrices(q), mean(m.vel_n), mean(m.pos_n), gyro, turn, mean(m.force_b), mean(m.density),
        None if speed is None else mean(speed),
    )  # fmt: skip


def rotor_sum(m: Motion) -> FloatArray | None:
    """Sum of the rotor speeds [rad/s] at the IMU's samples (n,); None where they are not known through the flight."""
    rotors = m.flight.get("rotors")
    names = [] if rotors is None else [c for c in rotors.names if c.startswith("speed_")]
    if rotors is None or not names:
        return None
    total = np.sum([rotors[c] for c in names], axis=0)
    good = np.isfinite(total) & (total > 0.0)
    t = m.t[m.air]
    if good.sum() < 10 or rotors.t[good][0] > t[0] + 1.0 or rotors.t[good][-1] < t[-1] - 1.0:
        return None
    gaps = np.diff(rotors.t[good])
    if float(np.median(gaps)) > SLOW or float(np.sum(gaps[gaps > 1.0])) > 0.1 * (t[-1] - t[0]):
        return None  # telemetry at a few hertz does not tell the speed in a manoeuvre
    return np.asarray(np.interp(m.t, rotors.t[good], total[good]))


def _continuous(q: FloatArray) -> FloatArray:
    """The same attitudes without jumps of the sign."""
    flips = np.cumprod(np.r_[1.0, np.where(np.einsum("ij,ij->i", q[1:], q[:-1]) < 0.0, -1.0, 1.0)])
    return np.asarray(q * flips[:, None])


def matrices(q: FloatArray) -> FloatArray:
    """C_nb (n, 3, 3) of unit quaternions (n, 4)."""
    w, x, y, z = q.T
    return np.stack([
        np.stack([w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)], axis=-1),
        np.stack([2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)], axis=-1),
        np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=-1),
    ], axis=1)  # fmt: skip
