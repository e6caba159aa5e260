"""When diagnosis keeps silent: what a signature leaves unexplained, naming too often, the ground, contact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from haltere._jit import COMPILED
from haltere.diagnosis import doubt
from haltere.drive import run
from haltere.filter import signatures
from haltere.filter.signatures import SLOTS, VELOCITY
from haltere.filter.update import NONE
from haltere.metrics.detection import alarms
from haltere.simulate import Scenario, simulate
from haltere.strapdown.layout import layout

NO_ROW = (NONE, NONE, NONE)


def state() -> Any:
    S = np.zeros(1, layout(1, banks=1))
    S = S if COMPILED else S.view(np.recarray)
    s = S[0]
    signatures.clear(s["bank"][0])
    return s


def hear(s: Any, values: Any, component: int = 0) -> None:
    for y in values:
        s["t"] += 0.1
        signatures.matched(s, NO_ROW, 1.0, float(y), component, True, False)


def test_squares_beyond_the_usual_are_none_without_a_fault_and_a_true_signature_explains_them() -> None:
    rng = np.random.default_rng(1)
    s = state()
    b = s["bank"][0]
    hear(s, 0.6 * rng.standard_normal(600))
    assert float(b["own"][0]) == pytest.approx(0.36, rel=0.2)
    signatures.open_slot(s, 2, (0.0, 0.0, 1.0))
    hear(s, 0.6 * rng.standard_normal(100))
    assert abs(float(b["excess"][2])) < 4.0 * float(b["spread"][2]) ** 0.5
    signatures.open_slot(s, 2, (0.0, 0.0, 1.0))
    hear(s, 2.0 + 0.6 * rng.standard_normal(60))  # GNSS velocity north is off by 2: its signature
    j = VELOCITY * SLOTS + 2
    explained = float(b["num"][j] ** 2 / b["den"][j])
    assert explained == pytest.approx(60 * 4.0, rel=0.1)
    assert float(doubt.left(b, j, 2)) < 0.1 * explained
    s["bank"][0]["t_unfit"] = -1e9
    assert doubt.fits(s, j, 2)


def test_what_wanders_is_not_explained_by_a_step() -> None:
    """Twice as large, but of both signs: a step has some of it, most is left, and nothing is named for a while."""
    rng = np.random.default_rng(2)
    s = state()
    b = s["bank"][0]
    hear(s, 0.6 * rng.standard_normal(600))
    signatures.open_slot(s, 0, (0.0, 0.0, 1.0))
    b["t_seen"] = s["t"]
    hear(s, 3.0 * np.sin(np.arange(60) / 8.0) + 1.0)
    j = VELOCITY * SLOTS
    assert float(b["num"][j] ** 2 / b["den"][j]) > 32.0  # an alarm
    assert not doubt.fits(s, j, 0)
    assert float(b["t_doubt"]) > float(s["t"])


def test_who_is_named_again_and_again_is_not_believed() -> None:
    b = state()["bank"][0]
    for g in range(14):
        b["t_named"][g], b["t_mute"][g] = -1e9, -1e9
    assert [bool(doubt.named(b, 13, t)) for t in (10.0, 15.0, 20.0)] == [True, True, False]
    assert not doubt.may_name(b, 13, 60.0)
    assert doubt.may_name(b, 13, 81.0)
    assert doubt.may_name(b, 0, 60.0)
    assert [bool(doubt.named(b, g, t)) for g, t in ((0, 100.0), (1, 150.0), (2, 200.0), (0, 250.0))] == [True] * 4  # one after another
    assert [bool(doubt.named(b, g, t)) for g, t in ((0, 300.0), (4, 303.0), (1, 306.0), (5, 309.0))] == [True, True, True, False]


@pytest.mark.parametrize(
    ("height", "speed", "rested", "near"),
    [(0.5, 0.5, 1.0, True), (3.0, 0.5, 1.0, False), (0.5, 4.0, 1.0, False), (0.5, 0.5, -1e9, False)],
)
def test_near_the_ground_is_low_over_where_it_rested_and_slow(height: float, speed: float, rested: float, near: bool) -> None:
    s = state()
    b = s["bank"][0]
    b["aloft"], b["floor"], b["t_rest"] = 1, 2.0, rested
    s["p"][2], s["v"][0] = 2.0 - height, speed
    assert bool(doubt.near_ground(s)) == near


@pytest.mark.parametrize("seed", [186, 576])
def test_touchdown_is_no_fault(seed: int) -> None:
    """Two landings in gusts whose contact looked like a step of the gyro's x axis."""
    flight = simulate(Scenario(mission="lissajous", duration=120.0, seed=60000 + seed, wind={"n": 5.2, "e": 3.0, "gust": 1.2}))
    assert alarms(run(flight, scored=False).events) == []
