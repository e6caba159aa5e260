"""Robust weights: by how much the variance of a measurement is inflated when its normalised deviation is large. It tests nothing.

Three levels, as in IGG-III (Yang Yuanxi; theory.md §4.7, reconstructed (44)): as it is, inflated, dropped; two plainer forms beside it.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit

__all__ = ["DROPPED", "HUBER", "IGG3", "PLAIN", "STEP", "inflate"]

#: Forms: no inflation below the outer bound, IGG-III, Huber (two levels, never dropped), and a step.
PLAIN, IGG3, HUBER, STEP = (constant(i) for i in range(4))
#: Factor that stands for a measurement that is to be dropped.
DROPPED = 1e12
#: Factor between the two bounds in the form `STEP`.
STEP_FACTOR = 10.0


@jit
def inflate(form: Any, s: float, k1: float, k2: float) -> float:
    """Factor on the variance of a measurement.

    Parameters
    ----------
    form
        `PLAIN`, `IGG3`, `HUBER` or `STEP`.
    s
        Normalised deviation, not negative [sigma].
    k1, k2
        Bounds [sigma]: up to k1 nothing changes; from k2 on the measurement is dropped (all but Huber).

    Returns
    -------
    float
        1 up to k1; between, IGG-III (s/k1) ((k2 - k1)/(k2 - s))², Huber s/k1, step `STEP_FACTOR`; from k2 on `DROPPED`.
    """
    if s <= k1:
        return 1.0
    if form == HUBER:
        return s / k1
    if s >= k2:
        return DROPPED
    if form == PLAIN:
        return 1.0
    if form == STEP:
        return STEP_FACTOR
    c = (k2 - k1) / (k2 - s)
    return min(s / k1 * c * c, DROPPED)
