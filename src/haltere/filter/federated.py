"""Federated fusion: covariances and corrections of local filters, about one nominal state, into one and back. It knows no state.

Carlson's filter (1990; theory.md §5.6). With P_i and δ_i what a local filter has of the states, all of them shared,

P_f⁻¹ = Σ P_i⁻¹,  δ_f = P_f Σ P_i⁻¹ δ_i;  shared out again P_i = P_f/β_i, δ_i = 0, Σ β_i = 1, and noise of the process Q/β_i.

With the states shared out after every step that is the filter that has all measurements; less often, or never, it is a cautious one. A
sensor's bias must be among the shared states: where it is a local filter's own, what is known of it goes through a rate or a force that
the noise of the process makes unsure by Q/β at every step, and 1/β of it is lost each time.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import jit

__all__ = ["add_information", "fused", "invert", "keep_apart", "share_out"]


@jit
def invert(A: Any, n: int) -> None:
    """Inverse of a symmetric positive matrix in its own place, of its first n rows and columns (Gauss-Jordan, no pivots)."""
    for k in range(n):
        p = 1.0 / A[k, k]
        A[k, k] = 1.0
        for j in range(n):
            A[k, j] *= p
        for i in range(n):
            if i != k:
                f = A[i, k]
                A[i, k] = 0.0
                for j in range(n):
                    A[i, j] -= f * A[k, j]


@jit
def add_information(f: Any, m: Any) -> None:
    """Add to ``f.P``, ``f.y`` what a local filter says, P_i⁻¹ and P_i⁻¹ δ_i.

    ``f`` has P (n, n), y (n) and work (n, n); ``m`` has P (n, n) and dx (n).
    """
    W, P = f.work, m.P
    n = f.P.shape[0]
    for i in range(n):
        for j in range(n):
            W[i, j] = P[i, j]
    invert(W, n)
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += W[i, j] * m.dx[j]
            f.P[i, j] += W[i, j]
        f.y[i] += total


@jit
def fused(f: Any) -> None:
    """Turn the sum of what local filters say into P_f and δ_f, in ``f.P`` and ``f.dx``."""
    n = f.P.shape[0]
    invert(f.P, n)
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += f.P[i, j] * f.y[j]
        f.dx[i] = total
    for i in range(n):
        for j in range(i):
            f.P[i, j] = f.P[j, i] = 0.5 * (f.P[i, j] + f.P[j, i])


@jit
def share_out(f: Any, m: Any, beta: float) -> None:
    """Give a local filter its share of the fused states; its nominal state is then to take δ_f."""
    P, n = m.P, f.P.shape[0]
    k = 1.0 / beta
    for i in range(n):
        m.dx[i] = 0.0
        for j in range(n):
            P[i, j] = k * f.P[i, j]


@jit
def keep_apart(f: Any, m: Any) -> None:
    """Leave a local filter its own opinion: only the nominal state that it is counted from has moved by δ_f."""
    n = f.P.shape[0]
    for j in range(n):
        m.dx[j] -= f.dx[j]
