"""Whether the rate that rotors do not explain stepped between two blocks, as only a gyro does, or went on to change. It names nothing.

A moment that the model lacks makes a ramp, and one that lasts a while a ramp that ends; a gyro that fails by a step changes at once and
then stays (theory-amendments.md §3). Each is fitted to the residuals of the last half second for every onset; what is left is compared.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit
from haltere.strapdown.pairs import LATELY

__all__ = ["began", "shape"]

#: Blocks before an onset at the least, and after it.
BEFORE, AFTER = 12, 8
#: How long a moment lasts that is set against a step [s]: these, and until now.
LASTS = 1e3
PULSES = (0.06, 0.12, 0.24, LASTS)
FORCES = constant(3)


@jit
def fit(p: Any, a: int, first: int, onset: int, drift: float, rise: float) -> tuple[float, float]:
    """Squares that a change within ``rise`` seconds from block ``onset`` on leaves, and its size; 0 for a step of the gyro.

    The model is damped by the rate that it is told: after a false step of b its own moment is wrong by b ∂ω̇/∂ω.
    """
    damped = p.by_w[a, a]
    n = p.n_lately
    sb, nb = 0.0, 0.0
    t0 = p.t_lately[onset % LATELY]
    for k in range(first, onset):
        j = k % LATELY
        sb += p.lately[j, a] - drift * (p.t_lately[j] - t0)
        nb += 1.0
    base = sb / nb
    xy, xx = 0.0, 0.0
    for k in range(onset + 1, n):
        j = k % LATELY
        g = 1.0 - damped * (p.t_lately[j] - t0) if rise <= 0.0 else min((p.t_lately[j] - t0) / rise, 1.0)
        xy += g * (p.lately[j, a] - drift * (p.t_lately[j] - t0) - base)
        xx += g * g
    size = xy / xx
    left = 0.0
    for k in range(first, n):
        if k == onset:
            continue
        j = k % LATELY
        g = 0.0
        if k > onset:
            g = 1.0 - damped * (p.t_lately[j] - t0) if rise <= 0.0 else min((p.t_lately[j] - t0) / rise, 1.0)
        x = p.lately[j, a] - drift * (p.t_lately[j] - t0) - base - g * size
        left += x * x
    return left, size


@jit
def shape(p: Any, a: int, drift: float, begin: float) -> tuple[float, float, float]:
    """By how much a step of rate axis ``a`` explains better than any ramp (in its noise, negative: worse), its size, its onset [s].

    ``drift`` is the rate of change of before, and the onset is looked for from ``begin`` on.
    """
    n = p.n_lately
    first = max(0, n - int(LATELY))
    step, ramp, size, when = 1e18, 1e18, 0.0, 0.0
    for onset in range(first + BEFORE, n - AFTER):
        t = p.t_lately[onset % LATELY]
        if t < begin:
            continue
        left, b = fit(p, a, first, onset, drift, 0.0)
        if left < step:
            step, size, when = left, b, t
        for rise in PULSES:
            left, _ = fit(p, a, first, onset, drift, rise)
            ramp = min(ramp, left)
    if step > 1e17:
        return 0.0, 0.0, 0.0
    noise = max(p.c0[FORCES + a], step / (n - first - 3.0))
    return (ramp - step) / noise, size, when


@jit
def began(p: Any, a: int, drift: float) -> float:
    """When a moment began that still lasts, of rate axis ``a``: the onset of the ramp that fits best [s]."""
    n = p.n_lately
    first = max(0, n - int(LATELY))
    least, when = 1e18, p.onset
    for onset in range(first + BEFORE, n - AFTER):
        left, _ = fit(p, a, first, onset, drift, LASTS)
        if left < least:
            least, when = left, p.t_lately[onset % LATELY]
    return float(when)
