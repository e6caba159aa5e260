"""Steps of barometer and compass: what alarms, what is a step, what is none."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from haltere import run
from haltere._jit import COMPILED
from haltere.diagnosis import jumps
from haltere.filter import jumping
from haltere.metrics.detection import alarms
from haltere.simulate import Scenario, inject, simulate
from haltere.strapdown.layout import layout

FloatArray = NDArray[np.float64]
LEVEL, DT = 32.0, 0.04


def sensor() -> Any:
    S = np.zeros(1, layout(1, banks=1))
    S = S if COMPILED else S.view(np.recarray)
    return S[0]["bank"][0]["height"]


def listen(x: FloatArray, dt: float = DT, unit: float = 1.0) -> list[tuple[float, float, float]]:
    """Alarm, onset and size of every step that was found."""
    h = sensor()
    found = []
    for k in range(len(x)):
        t = (k + 1) * dt
        jumping.hear(h, t, float(x[k]), unit)
        before = int(h["verdict"])
        jumps.listen(h, t, LEVEL, jumps.LASTS)
        if int(h["verdict"]) == 1 and before != 1:
            found.append((float(h["t_alarm"]), float(h["onset"]), float(h["found"])))
    return found


def made(seed: int, seconds: float, noise: float = 0.5, walk: float = 0.05, dt: float = DT) -> FloatArray:
    rng = np.random.default_rng(seed)
    n = int(seconds / dt)
    return np.asarray(walk * math.sqrt(dt) * np.cumsum(rng.standard_normal(n)) + noise * rng.standard_normal(n))


@pytest.mark.parametrize(("size", "late"), [(3.0, 0.1), (1.5, 0.5), (-1.5, 0.5)])
def test_a_step_of_three_sigma_is_seen_and_measured(size: float, late: float) -> None:
    delay, errors = [], []
    for seed in range(40):
        x = made(seed, 40.0)
        x[750:] += size
        found = listen(x)
        assert len(found) == 1, seed
        delay.append(found[0][0] - 751 * DT)
        errors.append(found[0][2] - size)
        assert abs(found[0][1] - 751 * DT) < 0.3
    assert np.mean(delay) < late
    assert abs(np.mean(errors)) < 0.1
    assert np.std(errors) < 0.25  # two means of 30 values each: 0.13


@pytest.mark.parametrize(("noise", "walk"), [(0.5, 0.05), (0.1, 0.5), (0.3, 1.0), (0.05, 0.0)])
def test_noise_that_lasts_or_not_is_no_step(noise: float, walk: float) -> None:
    """Whatever the barometer is like: 4 x 400 s of it."""
    for seed in range(4):
        assert listen(made(300 + seed, 400.0, noise, walk)) == []


def test_what_rises_within_a_second_or_does_not_stay_is_no_step() -> None:
    """A gust on the port that comes in a second, one that goes again, a spike, a climb that the pressure lags behind.

    In 0.3 m of noise: squares that a rise of 1.5 m in one second and a step leave differ by 1.5² / 12 * 25 / 0.3² = 52 variances.
    """
    t = np.arange(1000) * DT
    shapes = {
        "comes": 1.5 * np.clip((t - 30.0) / 1.0, 0.0, 1.0),
        "goes": np.where((t > 30.0) & (t < 30.7), 2.0, 0.0),
        "spike": np.where((t > 30.0) & (t < 30.05), 10.0, 0.0),
        "drifts": 0.5 * np.clip(t - 30.0, 0.0, None),
    }
    wrong = {name: sum(len(listen(made(500 + seed, 40.0, 0.3) + x)) for seed in range(30)) for name, x in shapes.items()}
    assert wrong["comes"] + wrong["goes"] + wrong["spike"] == 0, wrong
    assert wrong["drifts"] <= 3, wrong  # it alarms again and again, some four times in each of 30


def test_the_noise_is_the_flights_own() -> None:
    """A step that stands out from a quiet barometer is nothing beside a rough one; units do not matter."""
    x = made(7, 40.0, noise=0.05, walk=0.0)
    rough = made(7, 40.0, noise=1.0, walk=0.0)
    x[750:] += 0.5
    rough[750:] += 0.5
    assert len(listen(x)) == 1
    assert listen(rough) == []
    assert len(listen(0.1 * x, unit=0.1)) == 1


def test_squares_of_step_and_rise_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(11)
    h = sensor()
    y = rng.standard_normal(60) + np.where(np.arange(60) >= 30, 2.0, 0.0)
    t = 0.04 * (np.arange(60) + 1)
    h["filled"] = 60
    h["d"][:60], h["t"][:60] = y, t

    def left(g: FloatArray) -> float:
        A = np.column_stack([np.ones(60), g])
        return float(np.linalg.lstsq(A, y, rcond=None)[1][0])

    onset = float(t[30])
    step = min(left((t >= a).astype(float)) for a in t[2:58] if abs(a - onset) <= jumps.NEAR)
    rise = min(left(np.clip((t - a) / r, 0.0, 1.0)) for a in t[2:58] for r in jumps.RISES if abs(a - onset) <= jumps.NEAR + jumps.RISES[-1])
    gain, size, when = jumps.step_or_rise(h, 0, 60, onset)
    assert gain == pytest.approx(step - rise, rel=1e-9)
    assert abs(when - onset) < 0.3
    assert size == pytest.approx(2.0, abs=0.8)


@pytest.mark.parametrize(("mission", "wind"), [("hover", {}), ("lissajous", {"n": 5.2, "e": 3.0, "gust": 1.2})])
def test_small_steps_of_barometer_and_compass_are_named_in_flight(mission: str, wind: dict[str, float]) -> None:
    """Half of the truth table's sizes: 1.5 m, and a field that turns the compass by ten degrees; nothing is named in the flight without."""
    calm = simulate(Scenario(mission=mission, scale=0.55, duration=30.0, seed=62001, wind=wind, landing=False))
    assert not alarms(run(calm, scored=False).events)
    for word, sensor in (("barometer:bias=1.5m", "barometer"), ("magnetometer:disturb=0.08", "magnetometer")):
        events = alarms(run(inject(calm, [f"{word}@24.1"]), scored=False).events)
        assert [e["candidates"] for e in events] == [[sensor]]
        assert 0.0 <= events[0]["t_detected"] - 24.1 < 0.6
        assert abs(events[0]["t_onset"] - 24.1) < 0.3
        assert events[0]["t_isolated"] - 24.1 < 3.0
