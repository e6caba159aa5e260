"""Steps of a rate, matched with what a chain makes of them: against a slow oracle, how often without a fault, and how soon with one."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

import haltere
from haltere._jit import as_records, entry
from haltere.diagnosis.pairs import STEPS_TOO, stepped
from haltere.filter.windows import empty, sample_level, take, windows
from haltere.flight.vehicle import Vehicle
from haltere.metrics.detection import alarms
from haltere.simulate import Scenario, inject, simulate
from haltere.strapdown.pairs import MATCHED

WIDTH = int(MATCHED)
RECORD = np.dtype(
    [("of_a_test", "i8"), ("w", windows(512)), ("expected", "f8", (3, WIDTH)), ("agrees", "f8", (3, WIDTH)), ("energy", "f8", (3, WIDTH)),
     ("n_matched", "i8", 3)], align=True,
)  # fmt: skip


@entry
def _statistics(W: Any, x: Any, gain: float, rho: float, out: Any) -> None:
    w = W[0]
    for k in range(len(x)):
        out[k, 0], out[k, 1], age = stepped(w, 1, x[k], gain, rho)
        out[k, 2] = age


@entry
def _passed(W: Any, x: Any, gain: float, level: float, apart: int, out: Any) -> None:
    """How often windows alone, and windows and steps, pass a level, passages nearer than ``apart`` samples counted once."""
    w = W[0]
    before_0, before_1 = -apart - 1, -apart - 1
    for k in range(len(x)):
        glr = take(w.w, (x[k], 0.0, 0.0), 1, 0.0)
        step, _, _ = stepped(w, 1, x[k], gain, 0.0)
        if glr > level:
            if k - before_0 > apart:
                out[0] += 1.0
            before_0 = k
        if max(glr, step) > level:
            if k - before_1 > apart:
                out[1] += 1.0
            before_1 = k


def _record() -> Any:
    return as_records(np.zeros(1, RECORD))


@pytest.mark.parametrize(("gain", "rho"), [(0.15, 0.0), (0.4, 0.0), (0.1, 0.3)])
def test_statistic_is_that_of_the_definition(gain: float, rho: float) -> None:
    x = np.random.default_rng(3).normal(size=90)
    got = np.zeros((90, 3))
    _statistics(_record(), x, gain, rho, got)
    shape = (1.0 - gain) ** np.arange(WIDTH)
    shape[1:] -= rho * (1.0 - gain) ** np.arange(WIDTH - 1)
    shape /= math.sqrt(1.0 - rho**2)
    for k in range(90):
        best = (0.0, 0.0, 0)
        for age in range(1, min(k + 1, WIDTH) + 1):
            s, z = shape[:age], x[k + 1 - age : k + 1]
            if (s @ z) ** 2 / (s @ s) > best[0]:
                best = ((s @ z) ** 2 / (s @ s), (s @ z) / (s @ s), age)
        assert got[k] == pytest.approx(best, rel=1e-9, abs=1e-12)


def test_a_level_is_passed_as_often_as_is_allowed_for() -> None:
    x = np.random.default_rng(4).normal(size=4_000_000)
    for gain in (0.1, 0.15, 0.3):
        n = np.zeros(2)
        _passed(_record(), x, gain, 17.0, 100, n)
        assert n[0] > 400 and 1.1 < n[1] / n[0] < STEPS_TOO


def test_a_step_is_seen_as_often_as_its_energy_allows_and_sooner_than_by_windows() -> None:
    """Simulated chain: a walk of the rate, noise of the gyro; steps of 3.5 sigma of a block, as 3 deg/s of the default gyro."""
    gain, step, level = 0.145, 3.5, sample_level(3e-9, 1)
    scale = math.sqrt(1.0 - gain)  # 1 sigma of a block over that of an innovation
    energy = (step * scale) ** 2 / (2.0 * gain - gain**2)
    x = np.random.default_rng(5).normal(size=(3000, 56))
    x[:, 40:] += step * scale * (1.0 - gain) ** np.arange(16)
    seen = np.zeros(2)
    _seen(_record(), x, gain, level, 40, seen)
    share = NormalDist().cdf(math.sqrt(energy) - math.sqrt(level))
    assert abs(seen[1] / len(x) - share) < 0.08
    assert seen[1] > 1.15 * seen[0]


@entry
def _seen(W: Any, x: Any, gain: float, level: float, onset: int, out: Any) -> None:
    """Of how many series windows alone, and steps alone, pass a level from ``onset`` on."""
    w = W[0]
    for j in range(len(x)):
        empty(w.w)
        w.n_matched[1] = 0
        by_window, by_step = 0.0, 0.0
        for k in range(x.shape[1]):
            glr = take(w.w, (x[j, k], 0.0, 0.0), 1, 0.0)
            step, _, _ = stepped(w, 1, x[j, k], gain, 0.0)
            if k >= onset and glr > level:
                by_window = 1.0
            if k >= onset and step > level:
                by_step = 1.0
        out[0] += by_window
        out[1] += by_step


SENSORS = {"rotors": {"rate": 250.0}}
AT = 22.0


@pytest.fixture(scope="module")
def identified() -> Vehicle:
    """A vehicle file from two flights that nothing else here uses, geometry not given."""
    from haltere.identify.vehicle import identify_vehicle

    return identify_vehicle([
        simulate(Scenario(mission=m, scale=k, duration=80.0, seed=95000 + i, sensors=SENSORS, wind={"n": 2.0, "e": -1.0, "gust": 0.4}))
        for i, (m, k) in enumerate((("lissajous", 0.6), ("tour", 1.0)))
    ]).as_vehicle()  # fmt: skip


@pytest.fixture(scope="module")
def hover() -> Any:
    return simulate(Scenario(mission="hover", duration=AT + 8.0, seed=96201, sensors=SENSORS, landing=False))


@pytest.mark.parametrize("word", ["gyro.z:bias=3deg/s", "accel.x:bias=0.4m/s2", "accel.y:bias=-0.4m/s2", "accel.z:bias=0.8m/s2"])
def test_small_faults_in_hover_are_named_alone(identified: Vehicle, hover: Any, word: str) -> None:
    """Without rotors gyro z and the compass, an accelerometer axis and the gyro across it, look alike there."""
    events = alarms(haltere.run(inject(hover, [f"{word}@{AT:g}"]), vehicle=identified, scored=False).events)
    assert [e["candidates"] for e in events] == [[word.partition(":")[0]]]
    assert 0.0 <= events[0]["t_detected"] - AT < 0.8 and events[0]["t_isolated"] - AT < 4.0
