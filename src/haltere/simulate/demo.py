"""The demonstration flight: a smooth path seen by an IMU, a magnetometer, GNSS and a barometer of known noise. No vehicle model yet."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from haltere.core.earth import gravity
from haltere.errors import UsageError
from haltere.flight.config import defaults
from haltere.flight.field import earth_field
from haltere.flight.local import geodetic_from_local
from haltere.flight.log import FlightLog, FlightMeta, Home
from haltere.simulate.path import fly, random_path

__all__ = ["demo_flight"]

#: Where and when it flies, and what its sensors are like (densities as the filter's defaults: vibration included).
HOME = Home(46.8, 8.2, 600.0)
UTC = "2026-06-01T10:00:00Z"
NOISE_MAGNETOMETER, NOISE_BARO, H_ACC, V_ACC, S_ACC = 1.0, 0.5, 0.8, 1.2, 0.15


def demo_flight(
    seed: int = 1,
    duration: float = 120.0,
    *,
    imu_rate: float = 250.0,
    rest: float = 4.0,
    gyro_bias_sd: float | None = None,
    accel_bias_sd: float | None = None,
) -> FlightLog:
    """Simulate a flight along a random smooth path, with truth.

    Parameters
    ----------
    seed
        Of everything random in it.
    duration
        Length [s].
    imu_rate
        IMU samples a second [Hz]; magnetometer 50, barometer 25, GNSS 10 Hz.
    rest
        Time at rest before take-off [s]; 0 begins in the air.
    gyro_bias_sd, accel_bias_sd
        1 sigma of the turn-on biases [rad/s, m/s^2]; default 0.005 and 0.1.

    Returns
    -------
    FlightLog
        Streams imu, magnetometer, gnss, barometer and truth (with biases). Its ``[noise]`` is the noise it was made with.

    Raises
    ------
    UsageError
        A duration too short for a path.
    """
    if not (math.isfinite(duration) and duration >= rest + 20.0):
        raise UsageError(f"a duration of at least {rest + 20.0:g} s", f"{duration}", "demo_flight")
    rng = np.random.default_rng(seed)
    noise = {k: float(v) for k, v in defaults().items() if k.startswith("noise.")}
    g = gravity(HOME.lat, HOME.alt)
    dt = 1.0 / imu_rate
    t = dt * np.arange(int(duration * imu_rate), dtype=np.float64)
    motion = fly(t, *random_path(rng, duration + 10.0, rest), g)
    n = len(t)

    def white(sd: float, shape: tuple[int, int]) -> NDArray[np.float64]:
        return sd * rng.standard_normal(shape)

    def walk(start_sd: float, density: float, step: float, m: int) -> NDArray[np.float64]:
        return white(start_sd, (1, 3)) + np.cumsum(white(density * math.sqrt(step), (m, 3)), axis=0)

    gyro_bias = walk(0.005 if gyro_bias_sd is None else gyro_bias_sd, noise["noise.gyro_bias"], dt, n)
    accel_bias = walk(0.1 if accel_bias_sd is None else accel_bias_sd, noise["noise.accel_bias"], dt, n)
    shake = np.where(t < rest, 0.1, 1.0)[:, None]  # the motors are still off
    gyro = motion.gyro_b + gyro_bias + shake * white(noise["noise.gyro"] / math.sqrt(dt), (n, 3))
    accel = motion.accel_b + accel_bias + shake * white(noise["noise.accel"] / math.sqrt(dt), (n, 3))

    pos = motion.pos_n
    lat, lon, alt = geodetic_from_local(pos[:, 0], pos[:, 1], pos[:, 2], HOME.lat, HOME.lon, HOME.alt)
    every = {name: slice(max(1, round(imu_rate / rate)), None, max(1, round(imu_rate / rate)))
             for name, rate in (("mag", 50.0), ("baro", 25.0), ("gnss", 10.0))}  # fmt: skip

    s = every["mag"]
    field = earth_field(HOME.lat, HOME.lon, HOME.alt, 2026.41)
    d, i = field.declination, field.dip
    m_n = field.strength * np.array([math.cos(i) * math.cos(d), math.cos(i) * math.sin(d), math.sin(i)])
    mag = _to_body(motion.q_nb[s], m_n)
    mag = mag + white(NOISE_MAGNETOMETER, (len(mag), 3))

    s = every["baro"]
    m = len(t[s])
    offset = rng.normal(0.0, 2.0) + np.cumsum(rng.normal(0.0, noise["noise.baro_bias"] * math.sqrt(t[s][1] - t[s][0]), m))
    baro_alt = alt[s] + offset + rng.normal(0.0, NOISE_BARO, m)
    pressure = 101325.0 * (1.0 - baro_alt / 44330.77) ** (1.0 / 0.190263)
    t_baro = t[s]

    s = every["gnss"]
    m = len(t[s])
    fix = motion.pos_n[s] + white(1.0, (m, 3)) * np.array([H_ACC, H_ACC, V_ACC])
    vel = motion.vel_n[s] + white(S_ACC, (m, 3))
    fix_lat, fix_lon, fix_alt = geodetic_from_local(fix[:, 0], fix[:, 1], fix[:, 2], HOME.lat, HOME.lon, HOME.alt)

    ones = np.ones(m)
    truth = {"t": t} | {f"q_{a}": motion.q_nb[:, k] for k, a in enumerate("wxyz")}
    truth |= {f"vel_{a}": motion.vel_n[:, k] for k, a in enumerate("ned")} | {f"pos_{a}": motion.pos_n[:, k] for k, a in enumerate("ned")}
    truth["baro_bias"] = np.interp(t, t_baro, offset)
    truth |= {"lat": lat, "lon": lon, "alt": alt}
    truth |= {f"gyro_bias_{a}": gyro_bias[:, k] for k, a in enumerate("xyz")} | {
        f"accel_bias_{a}": accel_bias[:, k] for k, a in enumerate("xyz")
    }
    return FlightLog(
        {
            "imu": {"t": t, **_xyz("gyro", gyro), **_xyz("accel", accel)},
            "magnetometer": {"t": t[every["mag"]]} | {f"mag_{a}": mag[:, k] for k, a in enumerate("xyz")},
            "gnss": {
                "t": t[s], "lat": fix_lat, "lon": fix_lon, "alt": fix_alt, "vel_n": vel[:, 0], "vel_e": vel[:, 1], "vel_d": vel[:, 2],
                "h_acc": H_ACC * ones, "v_acc": V_ACC * ones, "s_acc": S_ACC * ones, "fix_type": 3.0 * ones, "num_sats": 14.0 * ones,
            },
            "barometer": {"t": t_baro, "pressure": pressure},
            "truth": truth,
        },
        FlightMeta(
            name="demo", source=f"haltere demo, simulated, seed {seed}", start_utc=UTC, home=HOME,
            noise={"magnetometer": NOISE_MAGNETOMETER, "field": 0.0, "barometer": NOISE_BARO, "gyro_scale": 0.0},
        ),
        ["simulated: a smooth path with white noise and bias walks of known size"],
    )  # fmt: skip


def _xyz(stem: str, vectors: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Columns of vectors (n, 3) by axis."""
    return {f"{stem}_{a}": vectors[:, k] for k, a in enumerate("xyz")}


def _to_body(q: NDArray[np.float64], v_n: NDArray[np.float64]) -> NDArray[np.float64]:
    """A constant NED vector seen from the body at each attitude, (n, 3)."""
    w, u = q[:, :1], q[:, 1:]
    c = np.cross(u, v_n)
    return np.asarray(v_n - 2.0 * w * c + 2.0 * np.cross(u, c))
