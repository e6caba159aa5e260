"""Made flights through moving air, from closed forms: a fixed wing in circles and straight legs. Not part of the package."""

from __future__ import annotations

import numpy as np

from haltere.flight.log import FlightLog, FlightMeta, Home

G = 9.80665


def rotation(roll: np.ndarray, pitch: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """C_nb (n, 3, 3) of Euler angles [rad]."""
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    rows = [
        [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
        [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
        [-sp, sr * cp, cr * cp],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def quaternions(C: np.ndarray) -> np.ndarray:
    """q_nb (n, 4), scalar first, of C_nb."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(C).as_quat()[:, [3, 0, 1, 2]]


def circling(
    seed: int = 0, duration: float = 300.0, wind: tuple[float, float, float] = (4.0, -3.0, 0.0), gust: float = 0.0, scale: float = 1.0,
    offsets: tuple[float, float] = (0.0, 0.0), vanes: bool = True, noise: float = 0.5, step: float = 0.0,
) -> FlightLog:  # fmt: skip
    """A fixed wing at 16 m/s through the air, turning at up to 18 deg/s one way and the other; in the air from the start.

    Gusts are an Ornstein-Uhlenbeck process of 3 s; ``step`` is added to the north wind at half time; the vehicle drifts with the mean wind
    and does not answer to gusts.
    """
    rng = np.random.default_rng(seed)
    rate = 100.0
    t = np.arange(0.0, duration, 1.0 / rate)
    turning = 0.32 * np.sin(2.0 * np.pi * t / 60.0) * (np.sin(2.0 * np.pi * t / 47.0) > -0.6)
    turning = np.convolve(turning, np.ones(200) / 200.0, "same")
    yaw, speed = np.cumsum(turning) / rate, 16.0 + 1.5 * np.sin(2.0 * np.pi * t / 37.0)
    through = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(t)])
    mean = np.tile(np.array(wind), (len(t), 1))
    mean[t > duration / 2.0, 0] += step
    vel = through + np.array(wind)  # the step is blown through: the vehicle holds its velocity over ground
    acc = np.gradient(vel, t, axis=0)
    f_n = acc - np.array([0.0, 0.0, G])
    roll = np.arctan2(speed * turning, G)
    alpha = np.full_like(t, 0.05)
    C = rotation(roll, alpha, yaw)
    f_b = np.einsum("nji,nj->ni", C, f_n)
    q = quaternions(C)
    dC = np.gradient(C, t, axis=0)
    S = np.einsum("nji,njk->nik", C, dC)
    w_b = np.column_stack([S[:, 2, 1], S[:, 0, 2], S[:, 1, 0]])
    a = np.exp(-1.0 / rate / 3.0)
    g = np.zeros((len(t), 3))
    kick = gust * np.sqrt(1.0 - a * a) * rng.standard_normal((len(t), 3))
    for i in range(1, len(t)):
        g[i] = a * g[i - 1] + kick[i]
    blowing = mean + g
    v_a = np.einsum("nji,nj->ni", C, vel - blowing)
    V = np.linalg.norm(v_a, axis=1)
    air, fix, mag = slice(0, None, 5), slice(0, None, 20), slice(0, None, 5)
    pos = np.cumsum(vel, axis=0) / rate
    n = len(t[air])
    home = Home(46.8, 8.2, 600.0)
    from haltere.flight.field import earth_field
    from haltere.flight.local import geodetic_from_local

    field = earth_field(home.lat, home.lon, home.alt, 2026.4)
    h = field.strength * np.array(
        [np.cos(field.dip) * np.cos(field.declination), np.cos(field.dip) * np.sin(field.declination), np.sin(field.dip)]
    )
    lat, lon, alt = geodetic_from_local(pos[fix, 0], pos[fix, 1], pos[fix, 2] - 100.0, home.lat, home.lon, home.alt)
    airdata = {"t": t[air], "airspeed": scale * V[air] + noise * rng.standard_normal(n)}
    if vanes:
        airdata["aoa"] = np.arctan2(v_a[air, 2], v_a[air, 0]) + offsets[0] + 0.02 * rng.standard_normal(n)
        airdata["sideslip"] = np.arcsin(v_a[air, 1] / V[air]) + offsets[1] + 0.02 * rng.standard_normal(n)
    k = len(t[fix])
    field_b = np.einsum("nji,j->ni", C[mag], h) + rng.standard_normal((len(t[mag]), 3))
    told = vel[fix] + 0.15 * rng.standard_normal((k, 3))
    streams = {
        "imu": {"t": t} | {f"gyro_{x}": w_b[:, i] + 0.015 * rng.standard_normal(len(t)) for i, x in enumerate("xyz")}
        | {f"accel_{x}": f_b[:, i] + 0.35 * rng.standard_normal(len(t)) for i, x in enumerate("xyz")},
        "magnetometer": {"t": t[mag]} | {f"mag_{x}": field_b[:, i] for i, x in enumerate("xyz")},
        "gnss": {"t": t[fix], "lat": lat, "lon": lon, "alt": alt} | {f"vel_{x}": told[:, i] for i, x in enumerate("ned")}
        | {"s_acc": np.full(k, 0.15), "h_acc": np.full(k, 1.0), "v_acc": np.full(k, 1.5)},
        "airdata": airdata,
        "truth": {"t": t} | {f"q_{x}": q[:, i] for i, x in enumerate("wxyz")} | {f"vel_{x}": vel[:, i] for i, x in enumerate("ned")}
        | {f"wind_{x}": blowing[:, i] for i, x in enumerate("ned")},
    }  # fmt: skip
    return FlightLog(streams, FlightMeta(name="circling", source="made", home=home, start_utc="2026-06-01T10:00:00Z"))
