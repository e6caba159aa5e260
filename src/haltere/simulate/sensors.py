"""Sensors of a simulated flight: what each would have measured, with its errors, clock and delay. It injects no faults."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.local import geodetic_from_local
from haltere.simulate.imu import imu
from haltere.simulate.truth import Truth, rotate_to_body, rotate_to_nav

__all__ = ["sense"]

FloatArray = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]
Parameters = Mapping[str, float]

#: Mean length of a multipath step [s].
MULTIPATH_LENGTH = 10.0


def sense(truth: Truth, parameters: Mapping[str, Parameters], seed: int) -> tuple[dict[str, Columns], Columns]:
    """Streams of all sensors, and the columns of ``truth`` that only they know (biases).

    Parameters
    ----------
    truth
        The flight, at the IMU.
    parameters
        Of each stream, see `haltere.simulate.parts.sensor`.
    seed
        Each stream and each clock draws from a generator of its own, so that one sensor's parameters change no other's numbers.

    Returns
    -------
    streams, biases
        Columns by stream; columns ``gyro_bias_*``, ``accel_bias_*``, ``baro_bias`` at the times of the truth.
    """
    streams: dict[str, Columns] = {}
    biases: Columns = {}
    for name, p in parameters.items():
        if p["rate"] <= 0.0 or (name == "power" and truth.voltage is None):
            continue
        own = zlib.crc32(name.encode())
        rng, clock = np.random.default_rng([seed, own]), np.random.default_rng([seed, own, 1])
        if name == "imu":
            streams[name], more = imu(truth, p, _stamps(truth.t, p, clock), rng)
        else:
            t = _times(truth, p)
            columns, more = _MAKERS[name](truth, p, t, rng)
            streams[name] = {"t": _stamps(t, p, clock), **columns}
        biases |= more
    return streams, biases


def _xyz(stem: str, vectors: FloatArray, axes: str = "xyz") -> Columns:
    return {f"{stem}_{a}": np.ascontiguousarray(vectors[:, k]) for k, a in enumerate(axes)}


def _times(truth: Truth, p: Parameters) -> FloatArray:
    """Valid times of a sensor's samples: the first one period after the start, so that no two sensors begin together."""
    return np.arange(1, int((truth.t[-1] - truth.t[0]) * p["rate"]) + 1, dtype=np.float64) / p["rate"]


def _stamps(t: FloatArray, p: Parameters, rng: np.random.Generator) -> FloatArray:
    """What the clock says of samples valid at t: later by the delay, jittered, never out of order."""
    if p["jitter"] == 0.0:
        return t + p["delay"]
    return np.maximum.accumulate(t + p["delay"] + p["jitter"] * rng.standard_normal(len(t)))


def _walk(rng: np.random.Generator, start: float, density: float, step: float, n: int, k: int) -> FloatArray:
    """A random walk (n, k) from a drawn start of standard deviation ``start``."""
    steps = density * math.sqrt(step) * rng.standard_normal((n, k))
    steps[:1] = start * rng.standard_normal(k)
    return np.cumsum(steps, axis=0)


def _markov(rng: np.random.Generator, sd: FloatArray, tau: float, step: float, n: int) -> FloatArray:
    """A first-order Gauss-Markov process (n, k) of stationary standard deviations sd (k,)."""
    if not sd.any():
        return np.zeros((n, len(sd)))
    from scipy.signal import lfilter

    a = math.exp(-step / tau)
    x = rng.standard_normal((n, len(sd)))
    x[1:] *= math.sqrt(1.0 - a * a)
    return np.asarray(sd * lfilter([1.0], [1.0, -a], x, axis=0))


def _stepped(values: FloatArray, step: float) -> FloatArray:
    return values if step <= 0.0 else np.asarray(step * np.round(values / step))


def _direction(rng: np.random.Generator) -> FloatArray:
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def _magnetometer(truth: Truth, p: Parameters, t: FloatArray, rng: np.random.Generator) -> tuple[Columns, Columns]:
    n = len(t)
    m = rotate_to_body(truth.attitude(t), truth.field_n)
    soft = np.eye(3) + p["soft_iron"] * rng.standard_normal((3, 3))
    m = m @ soft.T + p["hard_iron"] * rng.standard_normal(3) + p["noise"] * rng.standard_normal((n, 3))
    by_current, by_throttle = _direction(rng), _direction(rng)
    if p["current"] and truth.current is not None:
        m += p["current"] * truth.at(truth.current, t)[:, None] * by_current
    if p["throttle"]:
        m += p["throttle"] * truth.at(truth.command, t).mean(axis=1)[:, None] * by_throttle
    if p["walk"]:
        m += _walk(rng, 0.0, p["walk"], 1.0 / p["rate"], n, 3)
    return _xyz("mag", _stepped(m, p["resolution"])), {}


def _gnss(truth: Truth, p: Parameters, t: FloatArray, rng: np.random.Generator) -> tuple[Columns, Columns]:
    n, step = len(t), 1.0 / p["rate"]
    pos, vel = truth.at(truth.pos_n, t), truth.at(truth.vel_n, t)
    arm = np.array([p["arm_x"], p["arm_y"], p["arm_z"]])
    if arm.any():
        q = truth.attitude(t)
        pos = pos + rotate_to_nav(q, np.broadcast_to(arm, (n, 3)))
        vel = vel + rotate_to_nav(q, np.cross(truth.at(truth.gyro_b, t), arm))
    white, slow, jumps, losses = rng.spawn(4)
    h, v = p["h_noise"], p["v_noise"]
    pos = pos + np.array([h, h, v]) * white.standard_normal((n, 3))
    vel = vel + p["s_noise"] * white.standard_normal((n, 3))
    pos = pos + _markov(slow, np.array([p["h_drift"], p["h_drift"], p["v_drift"]]), p["drift_time"], step, n)
    vel = vel + _markov(slow, np.full(3, p["s_drift"]), 0.1 * p["drift_time"], step, n)
    jumped, count = _spans(jumps, t, p["multipath"], MULTIPATH_LENGTH)
    pos = pos + np.vstack([np.zeros(3), p["multipath_size"] * jumps.standard_normal((count, 3))])[jumped]
    lost = _spans(losses, t, p["dropouts"], p["dropout_length"])[0] > 0
    lat, lon, alt = geodetic_from_local(pos[:, 0], pos[:, 1], pos[:, 2], truth.home.lat, truth.home.lon, truth.home.alt)
    known = p["reported"]
    out: Columns = {"lat": lat, "lon": lon, "alt": alt, **_xyz("vel", vel, "ned")}
    out["h_acc"] = np.full(n, known * math.hypot(h, p["h_drift"]))
    out["v_acc"] = np.full(n, known * math.hypot(v, p["v_drift"]))
    out["s_acc"] = np.full(n, known * math.hypot(p["s_noise"], p["s_drift"]))
    for column in out.values():
        column[lost] = np.nan
    return {**out, "fix_type": np.where(lost, 0.0, 3.0), "num_sats": np.where(lost, 0.0, p["sats"])}, {}


def _spans(rng: np.random.Generator, t: FloatArray, per_minute: float, length: float) -> tuple[NDArray[np.int64], int]:
    """Number from 1 of the span each time is in, 0 outside, and how many there are; they begin at random, their lengths exponential."""
    out = np.zeros(len(t), np.int64)
    if per_minute <= 0.0 or len(t) == 0:
        return out, 0
    starts = np.sort(rng.uniform(t[0], t[-1], rng.poisson(per_minute * (t[-1] - t[0]) / 60.0)))
    for k, start in enumerate(starts):
        out[(t >= start) & (t < start + rng.exponential(length))] = k + 1
    return out, len(starts)


def _barometer(truth: Truth, p: Parameters, t: FloatArray, rng: np.random.Generator) -> tuple[Columns, Columns]:
    n = len(t)
    drift = _walk(rng, p["offset"], p["walk"], 1.0 / p["rate"], n, 1)[:, 0]
    height = truth.home.alt - truth.at(truth.pos_n[:, 2], t) + drift + p["noise"] * rng.standard_normal(n)
    pressure = 101325.0 * (1.0 - height / 44330.77) ** (1.0 / 0.190263)
    if p["wind"]:
        air = truth.at(truth.vel_n, t) - truth.at(truth.wind_n, t)
        pressure = pressure + p["wind"] * 0.5 * 1.225 * np.einsum("ij,ij->i", air, air)
    out: Columns = {"pressure": _stepped(pressure, p["resolution"]), "temperature": np.full(n, p["temperature"])}
    return out, {"baro_bias": np.interp(truth.t, t, drift)}


def _airdata(truth: Truth, p: Parameters, t: FloatArray, rng: np.random.Generator) -> tuple[Columns, Columns]:
    n = len(t)
    air = rotate_to_body(truth.attitude(t), truth.at(truth.vel_n, t) - truth.at(truth.wind_n, t))
    speed = np.sqrt(np.einsum("ij,ij->i", air, air))
    said = speed * (1.0 + p["scale"] * rng.standard_normal()) + p["noise"] * rng.standard_normal(n)
    aoa = np.arctan2(air[:, 2], air[:, 0]) + p["angle_noise"] * rng.standard_normal(n)
    slip = np.arcsin(np.clip(air[:, 1] / np.maximum(speed, 1e-9), -1.0, 1.0)) + p["angle_noise"] * rng.standard_normal(n)
    return {"airspeed": np.maximum(said, 0.0), "aoa": aoa, "sideslip": slip}, {}


def _rotors(truth: Truth, p: Parameters, t: FloatArray, rng: np.random.Generator) -> tuple[Columns, Columns]:
    n, m = len(t), truth.speed.shape[1]
    speed = np.maximum(truth.at(truth.speed, t) + p["noise"] * rng.standard_normal((n, m)), 0.0)
    speed = _stepped(speed, p["resolution"])
    if p["dropouts"]:
        speed[rng.random((n, m)) < p["dropouts"]] = np.nan
    command = truth.at(truth.command, t)
    return {f"{stem}_{k}": np.ascontiguousarray(x[:, k]) for stem, x in (("speed", speed), ("command", command)) for k in range(m)}, {}


def _power(truth: Truth, p: Parameters, t: FloatArray, rng: np.random.Generator) -> tuple[Columns, Columns]:
    if truth.voltage is None or truth.current is None:
        return {}, {}
    voltage = truth.at(truth.voltage, t) + p["voltage_noise"] * rng.standard_normal(len(t))
    return {"voltage": voltage, "current": truth.at(truth.current, t) + p["current_noise"] * rng.standard_normal(len(t))}, {}


_MAKERS: dict[str, Callable[[Truth, Parameters, FloatArray, np.random.Generator], tuple[Columns, Columns]]] = {
    "magnetometer": _magnetometer, "gnss": _gnss, "barometer": _barometer, "airdata": _airdata, "rotors": _rotors, "power": _power,
}  # fmt: skip
