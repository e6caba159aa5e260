"""Change detectors on whitened residuals: χ² of one sample, GLR over many windows, CUSUM; and the levels that belong to a rate of alarms.

Of a residual z of unit variance (theory.md §5.4(d), §5.7; theory-amendments.md §5): the snapshot is |z|²; the GLR is the largest
|Σ of the last m z|²/m over m = 1, 2, 4 … samples, each χ²(d) without a fault; a CUSUM is g± ← max(0, g± ± z - k), the largest of both
signs and all components. A residual that follows itself, z_k = ρ z_{k-1} + …, is prewhitened first. It names no fault.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from haltere._jit import constant, jit

__all__ = ["CUSUM_SLOW", "CUSUM_SWIFT", "FACTOR", "cusum_level", "empty", "exceeds", "glr_level", "sample_level", "take", "windows"]

#: Reference values k of the two CUSUMs: for shifts of half a sigma, and of two.
CUSUM_SLOW, CUSUM_SWIFT = 0.25, 1.0
#: The largest over all windows is passed so many times as often as one of them (theory-amendments.md §5).
FACTOR = 4.4
#: Components that a residual may have.
WIDTH = constant(3)


@cache
def windows(longest: int) -> np.dtype[np.void]:
    """Record type of a detector with windows of 1, 2, 4 … ``longest`` samples; ``longest`` is a power of two."""
    if longest < 1 or longest & (longest - 1):
        raise ValueError(f"a power of two, not {longest}")
    return np.dtype(
        (
            np.record,
            [
                ("n", "i8"),  # samples so far
                ("total", "f8", 3),  # of all of them, and as it was before each of the last ones
                ("before", "f8", (longest, 3)),
                ("last", "f8", 3),  # sample before, not prewhitened
                ("cusum", "f8", (2, 2, 3)),  # slow and swift, up and down, by component
                ("snapshot", "f8"),
                ("glr", "f8"),
                ("window", "i8"),  # samples of the window that gave it
                ("slow", "f8"),
                ("swift", "f8"),
                ("average", "f8", 3),  # mean of the residual over that window
            ],
        ),
        align=True,
    )


@jit
def empty(w: Any) -> None:
    """Forget every sample."""
    w.n, w.snapshot, w.glr, w.window, w.slow, w.swift = 0, 0.0, 0.0, 0, 0.0, 0.0
    for j in range(3):
        w.total[j], w.last[j], w.average[j] = 0.0, 0.0, 0.0
        for i in range(2):
            w.cusum[i, 0, j], w.cusum[i, 1, j] = 0.0, 0.0


@jit
def take(w: Any, z: tuple[float, float, float], d: int, rho: float) -> float:
    """Take the next residual, of ``d`` components, in turn; the GLR, which with the other statistics stays in the record.

    Parameters
    ----------
    w
        Record of `windows`.
    z
        Residual of unit variance; components from ``d`` on are not looked at.
    rho
        Correlation of neighbours, taken out by z_k - ρ z_{k-1} over √(1 - ρ²). 0 leaves it as it is.
    """
    longest = len(w.before)
    i = w.n % longest
    k = 1.0 / math.sqrt(1.0 - rho * rho)
    if w.n == 0:
        rho, k = 0.0, 1.0
    w.snapshot, w.slow, w.swift = 0.0, 0.0, 0.0
    for j in range(d):
        x = k * (z[j] - rho * w.last[j])
        w.last[j] = z[j]
        w.before[i, j] = w.total[j]
        w.total[j] += x
        w.snapshot += x * x
        w.cusum[0, 0, j] = max(0.0, w.cusum[0, 0, j] + x - CUSUM_SLOW)
        w.cusum[0, 1, j] = max(0.0, w.cusum[0, 1, j] - x - CUSUM_SLOW)
        w.cusum[1, 0, j] = max(0.0, w.cusum[1, 0, j] + x - CUSUM_SWIFT)
        w.cusum[1, 1, j] = max(0.0, w.cusum[1, 1, j] - x - CUSUM_SWIFT)
        w.slow = max(w.slow, w.cusum[0, 0, j], w.cusum[0, 1, j])
        w.swift = max(w.swift, w.cusum[1, 0, j], w.cusum[1, 1, j])
    w.n += 1
    w.glr, w.window = 0.0, 0
    m = 1
    while m <= longest and m <= w.n:
        old = (w.n - m) % longest
        total = 0.0
        for j in range(d):
            s = w.total[j] - w.before[old, j]
            total += s * s
        if total > w.glr * m:
            w.glr, w.window = total / m, m
        m *= 2
    if w.window > 0:
        old = (w.n - w.window) % longest
        for j in range(d):
            w.average[j] = (w.total[j] - w.before[old, j]) / w.window
    return w.glr


def exceeds(x: float, d: int) -> float:
    """Probability that χ² of ``d`` = 1, 2 or 3 degrees of freedom is above x."""
    if d == 2:
        return math.exp(-0.5 * x)
    tail = math.erfc(math.sqrt(0.5 * x))
    return tail if d == 1 else tail + math.sqrt(2.0 * x / math.pi) * math.exp(-0.5 * x)


def sample_level(p: float, d: int) -> float:
    """Level that χ²(d), d = 1, 2 or 3, exceeds with probability p."""
    low, high = 0.0, 1500.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if exceeds(middle, d) > p else (low, middle)
    return 0.5 * (low + high)


def glr_level(alarms: float, samples: float, d: int) -> float:
    """Level of the GLR of `take` for ``alarms`` false ones an hour of a whole bank that takes ``samples`` residuals a second.

    Of the bank's detectors each has its share by its samples: p = r/(3600 · 4.4 · Σf) (theory-amendments.md §5). Residuals must be white;
    those that are not need a factor, from flights without faults.
    """
    return sample_level(alarms / (3600.0 * FACTOR * samples), d)


def cusum_level(run_length: float, k: float) -> float:
    """Level of a two-sided CUSUM with reference ``k`` that is passed once in ``run_length`` white samples (Siegmund's approximation).

    The mean run length of one side is (exp(2k b) - 2k b - 1)/(2k²), b = h + 1.166.
    """
    low, high = 0.0, 1e4
    for _ in range(80):
        middle = 0.5 * (low + high)
        x = 2.0 * k * (middle + 1.166)
        length = (math.exp(min(x, 700.0)) - x - 1.0) / (2.0 * k * k) / 2.0
        low, high = (middle, high) if length < run_length else (low, middle)
    return 0.5 * (low + high)
