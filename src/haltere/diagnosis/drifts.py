"""What a vehicle's force model is off by in this flight: for a second, learnt, and slowly. It alarms of nothing.

The file's figure is of the flights that it was identified on, gusts among them; in still air a force leaves far less, and it leaves it for
about a second: errors of the filter's velocity, of the air's lift, of rotors that change speed. Such an error is u, of a variance σ² and a
correlation of exp(-t/τ), beside an offset that walks slowly. Means over a second, and by how much neighbours of them differ beyond the
noise of their samples, tell its variance: (2 τ/T)(1 - τ/T (1 - exp(-T/τ))) σ² each, and (τ/T)² (1 - exp(-T/τ))² σ² in common.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit
from haltere.diagnosis.stand_in import offset_variance

__all__ = ["LASTS", "forget_means", "lasting", "shift_means", "take_means", "walk_of"]

#: How long what a force is off by lasts [s]; part of its variance that neighbouring means over a second differ by, and that of such a mean.
LASTS, APART, MEAN = 0.7, 0.75, 0.65
#: The offset walks by 1 sigma of that in this time [s].
SLOWLY = 40.0
#: Blocks of a mean; how many differences the file's word is worth, how many are remembered; most of one, over what is expected.
BLOCKS, PRIOR, MEMORY, LONE = 100.0, 1.0, 20.0, 9.0
#: Least 1 sigma that is believed in [m/s^2], most of the file's variance.
LEAST_SD, MOST = 0.03, 4.0
FORCES = constant(3)


@jit
def lasting(s: Any, i: int) -> float:
    """Variance of what the model of a force is off by for a second in this flight [m^2/s^4]."""
    return float(max(offset_variance(s, i) * s.pairs[0].scale[i], LEAST_SD * LEAST_SD))


@jit
def walk_of(s: Any, i: int) -> float:
    """How its offset walks, variance a second [(m/s^2)^2/s]."""
    return lasting(s, i) / SLOWLY


@jit
def forget_means(p: Any) -> None:
    """Begin the means anew: levels jumped. What was learnt stays."""
    p.slow_n, p.slow_known = 0.0, 0
    for i in range(FORCES):
        p.slow_sum[i] = 0.0


@jit
def shift_means(p: Any, i: int, change: float) -> None:
    """Let what was gathered be free of a bias that is larger by ``change``."""
    p.slow_sum[i] -= change * p.slow_n
    p.slow_mean[i] -= change


@jit
def take_means(s: Any, y: tuple[float, float, float]) -> None:
    """Take a block's residuals of force; at the end of a mean, what it differs by from the one before."""
    p = s.pairs[0]
    p.slow_n += 1.0
    for i in range(FORCES):
        p.slow_sum[i] += (y[0], y[1], y[2])[i]
    if p.slow_n < BLOCKS:
        return
    known, fade = p.slow_known == 1, 1.0
    if known:
        if p.slow_count >= MEMORY:
            fade = MEMORY / (MEMORY + 1.0)
        p.slow_count = fade * p.slow_count + 1.0
    for i in range(FORCES):
        mean = p.slow_sum[i] / p.slow_n
        p.slow_sum[i] = 0.0
        if known:
            expected, noise = APART * offset_variance(s, i), 2.0 * p.r[i] / p.slow_n
            d = mean - p.slow_mean[i]
            p.slow_square[i] = fade * p.slow_square[i] + min(d * d - noise, LONE * (noise + expected)) / expected
            p.scale[i] = min(max((PRIOR + p.slow_square[i]) / (PRIOR + p.slow_count), 0.0), MOST)
        p.slow_mean[i] = mean
    p.slow_n, p.slow_known = 0.0, 1
