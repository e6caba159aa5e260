"""Innovation tests: the joint statistic of up to three correlated components, and the variance that brings a ratio to one."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.filter.update import Row, column_of, project, variance

__all__ = ["inflation", "joint_nis", "optimal_gain"]

Vec = tuple[float, float, float]

#: Variance that stands for a component that is not there.
ABSENT = 1e18


@jit
def joint_nis(s: Any, H0: Row, H1: Row, H2: Row, e: Vec, r: Vec) -> tuple[float, Vec]:
    """Normalised innovation squared of three components together, and their own innovation variances.

    Parameters
    ----------
    s
        State record.
    H0, H1, H2
        Rows of H.
    e, r
        Innovations and measurement variances; a component of variance `ABSENT` and innovation 0 does not count.

    Returns
    -------
    nis : float
        eᵀ S⁻¹ e with S = H P Hᵀ + R (theory.md §2.5), by Cholesky elimination.
    s_ii : tuple of 3 floats
        Diagonal of S.
    """
    project(s, H0)
    s00 = variance(s, H0) + r[0]
    s01 = variance(s, H1)
    s02 = variance(s, H2)
    project(s, H1)
    s11 = variance(s, H1) + r[1]
    s12 = variance(s, H2)
    project(s, H2)
    s22 = variance(s, H2) + r[2]
    l10, l20 = s01 / s00, s02 / s00
    d1 = s11 - l10 * s01
    c12 = s12 - l10 * s02
    l21 = c12 / d1
    d2 = s22 - l20 * s02 - l21 * c12
    y0 = e[0]
    y1 = e[1] - l10 * y0
    y2 = e[2] - l20 * y0 - l21 * y1
    return y0 * y0 / s00 + y1 * y1 / d1 + y2 * y2 / d2, (s00, s11, s22)


@jit
def optimal_gain(s: Any, H: Row, r: float) -> float:
    """Put H P into ``s.u`` and the optimal gain P Hᵀ/S into ``s.k``; return S."""
    project(s, H)
    S = variance(s, H) + r
    column_of(s, H)
    inverse = 1.0 / S
    k = s.k
    for i in range(s.P.shape[0]):
        k[i] *= inverse
    return S


@jit
def inflation(nis: float, gate: float, s_ii: float, r: float) -> float:
    """Measurement variance with which an innovation of this size would just pass its gate."""
    return r + s_ii * max(0.0, nis / (gate * gate) - 1.0)
