"""What a force model is off by for a second, learnt in flight: on made residuals of which it is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from haltere._jit import as_records, entry
from haltere.diagnosis.drifts import LASTS, lasting, shift_means, take_means
from haltere.strapdown.pairs import pairs

NOISE, BLOCK = 0.33, 0.01


@entry
def _learn(S: Any, y: Any, shift_at: int, shift: float) -> float:
    s = S[0]
    for k in range(len(y)):
        take_means(s, (y[k, 0], y[k, 1], y[k, 2] - (shift if k >= shift_at else 0.0)))
        if k + 1 == shift_at:
            shift_means(s.pairs[0], 2, shift)
    return math.sqrt(lasting(s, 2))


def learnt(sd: float, seconds: float, seed: int, of_file: float = 0.2, shift: float = 0.0) -> float:
    """1 sigma that is found where the model is off by ``sd`` with a correlation of `LASTS`, in white noise of the accelerometer."""
    model = np.dtype([("slow", "f8", 6)], align=True)
    S = np.zeros(1, np.dtype([("told_of_drifts", "f8"), ("pairs", pairs(), (1,)), ("model", model, (1,))], align=True))
    S["model"]["slow"] = of_file
    S["pairs"]["scale"], S["pairs"]["r"] = 1.0, NOISE * NOISE
    rng, n = np.random.default_rng(seed), int(seconds / BLOCK)
    u, keep = np.zeros((n, 3)), math.exp(-BLOCK / LASTS)
    for k in range(1, n):
        u[k] = keep * u[k - 1] + math.sqrt(1.0 - keep * keep) * sd * rng.normal(size=3)
    return float(_learn(as_records(S), 0.4 + u + NOISE * rng.normal(size=(n, 3)), n // 2 + 37, shift))


@pytest.mark.parametrize("sd", [0.1, 0.3])
def test_it_is_found_in_flight(sd: float) -> None:
    found = [learnt(sd, 60.0, seed) for seed in range(20)]
    assert float(np.mean(np.square(found))) == pytest.approx(sd * sd, rel=0.25)  # 20 differences of a flight, 20 flights: 10 %, one σ


def test_the_file_is_believed_at_first_and_noise_is_none() -> None:
    assert learnt(0.0, 1.5, 1) == pytest.approx(0.2)
    assert float(np.mean([learnt(0.0, 60.0, seed) for seed in range(10)])) < 0.08  # the file's word is worth one of twenty


def test_a_bias_that_moves_is_no_drift() -> None:
    assert learnt(0.1, 60.0, 3, shift=5.0) == pytest.approx(learnt(0.1, 60.0, 3), rel=1e-6)
