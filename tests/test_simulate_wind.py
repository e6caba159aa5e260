"""Wind of the simulator against its spectrum and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import welch

from haltere._jit import as_records
from haltere.simulate.scenario import Scenario
from haltere.simulate.simulator import simulate_truth
from haltere.simulate.wind import WIND, gust, shear

L = (60.0, 40.0, 12.0)
SD = (1.5, 1.0, 0.6)


def record(**values) -> np.ndarray:
    W = as_records(np.zeros(1, WIND))
    W["cos"] = 1.0
    for name, value in values.items():
        W[name] = value
    return W


def blow(speed: float, dt: float, n: int, seed: int = 1) -> np.ndarray:
    W = record(sd=SD, length=L)
    noise = np.random.default_rng(seed).standard_normal((n, 5))
    return np.array([gust(W[0], speed, dt, noise[k]) for k in range(n)])


def dryden(hertz: np.ndarray, speed: float, k: int) -> np.ndarray:
    """One-sided spectral density [(m/s)^2/Hz] of MIL-F-8785C: integrates to the variance over all frequencies."""
    T, w = L[k] / speed, 2.0 * math.pi * hertz
    if k == 0:
        return SD[0] ** 2 * 4.0 * T / (1.0 + (T * w) ** 2)
    return SD[k] ** 2 * 2.0 * T * (1.0 + 3.0 * (T * w) ** 2) / (1.0 + (T * w) ** 2) ** 2


@pytest.mark.parametrize("dt", [0.002, 0.02, 0.1])
def test_turbulence_has_its_standard_deviation_at_any_step(dt: float) -> None:
    speed = 12.0
    # many independent stretches: the variance of n correlated samples is known to about sqrt(4 T / length)
    n = int(min(2e5, 4000.0 / dt))
    x = blow(speed, dt, n)
    for k in range(3):
        independent = n * dt / (2.0 * L[k] / speed)
        assert np.std(x[:, k]) == pytest.approx(SD[k], rel=4.0 / math.sqrt(2.0 * independent) + 0.01)


def test_turbulence_has_the_dryden_spectrum() -> None:
    speed, dt = 15.0, 0.02
    x = blow(speed, dt, 200_000, seed=5)
    for k in range(3):
        hertz, density = welch(x[:, k], fs=1.0 / dt, nperseg=4096)
        wanted = dryden(hertz, speed, k)
        band = (hertz > 0.05) & (hertz < 5.0)
        # a third of an octave at a time: each mean of many independent estimates
        for low in np.geomspace(0.06, 4.0, 12):
            mine = band & (hertz >= low) & (hertz < 1.26 * low)
            if mine.sum() > 3:
                estimates = mine.sum() * (len(x) / 4096)
                assert density[mine].mean() == pytest.approx(wanted[mine].mean(), rel=4.5 / math.sqrt(estimates) + 0.03)


def test_components_are_independent_and_turn_with_the_mean() -> None:
    W = record(sd=(2.0, 0.0, 0.0), length=L, cos=0.6, sin=0.8)
    noise = np.random.default_rng(1).standard_normal((500, 5))
    x = np.array([gust(W[0], 10.0, 0.1, noise[k]) for k in range(500)])
    np.testing.assert_allclose(x[:, 0] * 0.8, x[:, 1] * 0.6, atol=1e-12)
    assert np.all(x[:, 2] == 0.0)
    y = blow(10.0, 0.1, 40_000)
    assert np.abs(np.corrcoef(y.T) - np.eye(3)).max() < 0.15


def test_shear_is_the_power_law() -> None:
    W = record(exponent=0.2, height=10.0)
    assert shear(W[0], 10.0) == 1.0
    assert shear(W[0], 40.0) == pytest.approx(4.0**0.2)
    assert shear(W[0], 0.0) == shear(W[0], 1.0)
    assert shear(record()[0], 123.0) == 1.0


def test_flight_meets_the_wind_it_was_given() -> None:
    calm = simulate_truth(Scenario(mission="hover", duration=30.0, wind={"n": 3.0, "e": -1.0, "d": 0.2}))
    np.testing.assert_allclose(calm.wind_n, np.broadcast_to([3.0, -1.0, 0.2], calm.wind_n.shape), atol=1e-12)
    sheared = simulate_truth(Scenario(mission="climb", duration=45.0, wind={"n": 3.0, "shear": 0.25, "shear_height": 12.0}))
    height = np.maximum(-sheared.pos_n[:, 2], 1.0)
    np.testing.assert_allclose(sheared.wind_n[:, 0], 3.0 * (height / 12.0) ** 0.25, rtol=2e-3)
