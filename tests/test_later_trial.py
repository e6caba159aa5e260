"""A trial of forces begins anew for a step that comes while it is on, and for nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from haltere._jit import as_records
from haltere.diagnosis.wind_or_force import NOTHING, TRIED, latest, match
from haltere.strapdown.pairs import pairs

STATE = np.dtype([("of_a_test", "f8"), ("pairs", pairs(), (1,))])


def trial(step: float, *, known: float) -> tuple[float, int, int, float]:
    """A later beginning, then a second of innovations of nothing along y, of a step that is followed with a gain of 0.01 a block."""
    s: Any = as_records(np.zeros(1, STATE))
    p: Any = s["pairs"][0]
    p["later"], p["later"][0, 2] = -1.0, 20.0
    rng, S, gain, absorbed = np.random.default_rng(97001), 0.5, 0.01, 0.0
    for _ in range(100):
        x = step - absorbed + np.sqrt(S) * rng.standard_normal()
        absorbed += gain * x
        match(as_records(p)[0], 1, x, S, gain)
        p["misfit"][0, :TRIED] += x * x / S
        p["misfit"][0, 1] -= known / 100.0
    found: tuple[float, int, int, float] = latest(s[0])
    assert p["misfit"][0, NOTHING] > 0.0
    return found


def test_a_step_that_nothing_predicts_is_found_with_its_axis_and_size() -> None:
    more, axis, slot, size = trial(0.8, known=0.0)
    assert more > 10.0 and (axis, slot) == (1, 2)
    assert size == pytest.approx(0.8, abs=0.35)  # 1 sigma is sqrt(S / sum of (1 - g)^2n) = 0.107; three of them


def test_what_a_hypothesis_predicts_as_well_is_no_new_beginning() -> None:
    assert trial(0.8, known=200.0)[0] == 0.0


def test_chance_is_none() -> None:
    assert trial(0.0, known=0.0)[0] < 10.0
