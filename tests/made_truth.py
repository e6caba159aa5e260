"""Truths made by hand and tests of variance, for the tests of simulated sensors."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from haltere.flight.field import Field
from haltere.flight.log import Home
from haltere.simulate.parts import SENSORS, sensor
from haltere.simulate.sensors import sense
from haltere.simulate.truth import Truth

HOME = Home(46.8, 8.2, 600.0)
FIELD = Field(math.radians(3.0), math.radians(62.0), 48.0, "test")
#: Chance of a right sensor failing a two-sided test here.
RARE = 1e-5


def at_rest(duration: float, rate: float, *, rotors: int = 4, speed: float = 0.0, home: Home = HOME) -> Truth:
    """A vehicle that stands level, nose north, in no wind; its rotors may turn at a constant speed [rad/s]."""
    n = round(duration * rate)
    t = np.arange(n) / rate
    zero, q = np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    speeds = np.full((n, rotors), speed) * (1.0 + 0.01 * np.arange(rotors))
    turned = speeds * t[:, None] % (2.0 * math.pi)
    force = np.tile([0.0, 0.0, -9.8], (n, 1))
    return Truth(t, zero, zero, zero, q, zero, zero, force, speeds, turned, np.full((n, rotors), 0.5), np.full(n, 12.0), np.full(n, 8.0),
                 500.0, home, FIELD)  # fmt: skip


def tumbling(n: int, rate: float, seed: int = 1) -> Truth:
    """Every attitude, rate and force there is, for regressions; no motion that could be."""
    rng = np.random.default_rng(seed)
    still = at_rest(n / rate, rate)
    q = Rotation.random(n, random_state=seed).as_quat()[:, [3, 0, 1, 2]]
    return dataclasses.replace(
        still, q_nb=q, gyro_b=rng.uniform(-3.0, 3.0, (n, 3)), force_b=rng.uniform(-15.0, 15.0, (n, 3)), command=rng.random((n, 4)),
        current=rng.uniform(0.0, 30.0, n), vel_n=rng.uniform(-9.0, 9.0, (n, 3)), wind_n=rng.uniform(-5.0, 5.0, (n, 3)),
        pos_n=rng.uniform(-50.0, 50.0, (n, 3)), speed=rng.uniform(300.0, 900.0, (n, 4)),
    )  # fmt: skip


#: Parameters that make noise, walks and offsets even in a sensor of which nothing was said.
RANDOM = {
    "gyro_noise", "gyro_walk", "gyro_turn_on", "accel_noise", "accel_walk", "accel_turn_on", "noise", "walk", "h_noise", "v_noise",
    "s_noise", "offset", "angle_noise", "voltage_noise", "current_noise",
}  # fmt: skip


def streams(truth: Truth, seed: int = 1, **changes: dict) -> tuple[dict, dict]:
    """Streams and biases of the sensors named, or of all, with everything random switched off unless it is given."""
    quiet = {name: {k: 0.0 for k in keys if k in RANDOM} for name, keys in SENSORS.items()}
    parameters = {name: sensor(name, quiet[name] | changes.get(name, {})) for name in changes or SENSORS}
    return sense(truth, parameters, seed)


def xyz(stream: dict, stem: str, axes: str = "xyz") -> np.ndarray:
    return np.column_stack([stream[f"{stem}_{a}"] for a in axes])


def has_variance(x: np.ndarray, variance: float) -> bool:
    """Whether independent numbers of mean zero have a variance: chi-square, two-sided."""
    n = x.size
    return bool(chi2.ppf(RARE / 2, n) < float(np.sum(x**2)) / variance < chi2.ppf(1 - RARE / 2, n))


def allan_variance(x: np.ndarray, m: int) -> np.ndarray:
    """Allan variance of the columns of x at a cluster of m samples, clusters side by side."""
    k = len(x) // m
    means = x[: k * m].reshape(k, m, -1).mean(axis=1)
    return np.asarray(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0))


def allan_band(clusters: float) -> tuple[float, float]:
    """Band of an Allan variance of so many clusters over the true one.

    Neighbouring differences of clusters are correlated, by -1/2 for white noise and 1/4 for a walk: at most 1.5 of them count for one.
    """
    degrees = (clusters - 1.0) / 1.5
    low, high = chi2.ppf((RARE, 1 - RARE), degrees) / degrees
    return float(low), float(high)
