"""Scalar measurement updates of a covariance held in a record: gain, Joseph form, deferred injection. It knows no sensor.

A row of H is three blocks ``((first column, (h0, h1, h2)), ...)``, those not needed zero, so that one machine-code version
serves every sensor. A single column c is the block ``(c - 2, (0, 0, h))``.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit

__all__ = ["NONE", "Row", "apply", "column_of", "innovation", "project", "symmetrise", "variance"]

Block = tuple[int, tuple[float, float, float]]
Row = tuple[Block, Block, Block]

#: A block that is not there.
NONE = (constant(0), (0.0, 0.0, 0.0))


@jit
def project(s: Any, H: Row) -> None:
    """Put H P into ``s.u``, from the rows of P."""
    P, u = s.P, s.u
    n = s.P.shape[0]
    for j in range(n):
        u[j] = 0.0
    for c, h in H:
        h0, h1, h2 = h
        if h0 != 0.0 or h1 != 0.0 or h2 != 0.0:
            for j in range(n):
                u[j] += h0 * P[c, j] + h1 * P[c + 1, j] + h2 * P[c + 2, j]


@jit
def variance(s: Any, H: Row) -> float:
    """Innovation variance without measurement noise, H P Hᵀ, after `project`."""
    total = 0.0
    for c, h in H:
        total += h[0] * s.u[c] + h[1] * s.u[c + 1] + h[2] * s.u[c + 2]
    return total


@jit
def innovation(s: Any, H: Row, e: float) -> float:
    """Innovation ``e - H dx``: what is left of e after the updates since the last injection."""
    for c, h in H:
        e -= h[0] * s.dx[c] + h[1] * s.dx[c + 1] + h[2] * s.dx[c + 2]
    return e


@jit
def add_outer(s: Any, sign: float, a: Any, b: Any) -> None:
    """P <- P ± a bᵀ, five rows at a time: a shorter loop body is unrolled into scalar code before it can become SIMD."""
    P = s.P
    n = s.P.shape[0]
    for i in range(0, n - 4, 5):
        a0, a1, a2, a3, a4 = sign * a[i], sign * a[i + 1], sign * a[i + 2], sign * a[i + 3], sign * a[i + 4]
        for j in range(n):
            bj = b[j]
            P[i, j] += a0 * bj
            P[i + 1, j] += a1 * bj
            P[i + 2, j] += a2 * bj
            P[i + 3, j] += a3 * bj
            P[i + 4, j] += a4 * bj
    for i in range(n - n % 5, n):
        ai = sign * a[i]
        for j in range(n):
            P[i, j] += ai * b[j]


@jit
def apply(s: Any, H: Row, r: float, e: float) -> None:
    """Update with the gain in ``s.k`` and the rows in ``s.u``: dx and P.

    Any gain is allowed, also a masked one: P <- (I - K H) P (I - K H)ᵀ + K r Kᵀ as a true congruence, H P from the rows
    and then (..) Hᵀ from the columns (theory.md §2.4, theory-amendments.md §1).

    Parameters
    ----------
    s
        State record with P (n, n), dx (n), u = H P (n), k = gain (n).
    H
        Row of the measurement matrix.
    r
        Measurement variance.
    e
        Innovation, already reduced by ``H dx``.
    """
    P, u, k, dx = s.P, s.u, s.k, s.dx
    n = s.P.shape[0]
    for i in range(n):
        dx[i] += k[i] * e
    add_outer(s, -1.0, k, u)
    for i in range(n):
        u[i] = r * k[i]
    for c, h in H:
        h0, h1, h2 = h
        if h0 != 0.0 or h1 != 0.0 or h2 != 0.0:
            for i in range(n):
                u[i] -= P[i, c] * h0 + P[i, c + 1] * h1 + P[i, c + 2] * h2
    add_outer(s, 1.0, u, k)


@jit
def symmetrise(s: Any) -> None:
    """Make P exactly symmetric again, from its upper triangle; the update keeps it so to rounding."""
    P = s.P
    for i in range(s.P.shape[0]):
        for j in range(i):
            P[i, j] = P[j, i]


@jit
def column_of(s: Any, H: Row) -> None:
    """Put the optimal gain's numerator P Hᵀ into ``s.k``, from the columns of P."""
    P, k = s.P, s.k
    n = s.P.shape[0]
    for i in range(n):
        k[i] = 0.0
    for c, h in H:
        h0, h1, h2 = h
        if h0 != 0.0 or h1 != 0.0 or h2 != 0.0:
            for i in range(n):
                k[i] += P[i, c] * h0 + P[i, c + 1] * h1 + P[i, c + 2] * h2
