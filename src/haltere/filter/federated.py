"""Federated fusion: covariances and corrections of local filters, about one nominal state, into one and back. It knows no state.

Carlson's filter (1990; theory.md §5.6): local filters share the first ``n`` of their error states; what comes after these is each one's
own (a sensor's bias) and is neither shared nor fused. With P_i and δ_i what a local filter has of the shared states,

P_f⁻¹ = Σ P_i⁻¹,  δ_f = P_f Σ P_i⁻¹ δ_i;  shared out again P_i = P_f/β_i, δ_i = 0, Σ β_i = 1, and noise of the process Q/β_i.

A state of its own follows by regression on what the others have found out about the shared ones: b ← b + G (δ_f - δ_i), G = P_bx P_xx⁻¹.
With the states shared out after every step, and none of their own, that is the filter that has all measurements; less often, or never, it
is a cautious one.
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
    """Add to ``f.P``, ``f.y`` what a local filter says, P_i⁻¹ and P_i⁻¹ δ_i; ``m.gain`` becomes G of its own states.

    ``f`` has P (n, n), y (n) and work (n, n); ``m`` has P (n + 3, n + 3), dx (n + 3) and gain (3, n).
    """
    W, P, G = f.work, m.P, m.gain
    n = f.P.shape[0]
    for i in range(n):
        for j in range(n):
            W[i, j] = P[i, j]
    invert(W, n)
    for a in range(3):
        for j in range(n):
            G[a, j] = 0.0
        for i in range(n):
            b = P[n + a, i]
            if b != 0.0:
                for j in range(n):
                    G[a, j] += b * W[i, j]
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
def own_states(f: Any, m: Any) -> None:
    """Correction of a local filter's own states by what the fusion has found: δ_b + G (δ_f - δ_i), into ``m.dx``."""
    n = f.P.shape[0]
    for a in range(3):
        total = m.dx[n + a]
        for j in range(n):
            total += m.gain[a, j] * (f.dx[j] - m.dx[j])
        m.dx[n + a] = total


@jit
def share_out(f: Any, m: Any, beta: float) -> None:
    """Give a local filter its share of the fused states; its nominal state is then to take δ_f, and its own states ``m.dx``'s last three.

    What it knows of its own states given the shared ones stays: P_bb ← P_bb - G P_xx Gᵀ + G (P_f/β) Gᵀ, P_bx ← G P_f/β.
    """
    P, G = m.P, m.gain
    n = f.P.shape[0]
    own_states(f, m)
    k = 1.0 / beta
    for a in range(3):
        for b in range(3):
            total = 0.0
            for j in range(n):
                total += G[a, j] * P[j, n + b]
            P[n + a, n + b] -= total
    for i in range(n):
        for j in range(n):
            P[i, j] = k * f.P[i, j]
    for a in range(3):
        for j in range(n):
            P[n + a, j] = 0.0
        for i in range(n):
            g = G[a, i]
            if g != 0.0:
                for j in range(n):
                    P[n + a, j] += g * P[i, j]
    for a in range(3):
        for j in range(n):
            P[j, n + a] = P[n + a, j]
        for b in range(3):
            total = 0.0
            for j in range(n):
                total += P[n + a, j] * G[b, j]
            P[n + a, n + b] += total
    for a in range(3):
        for b in range(a):
            P[n + a, n + b] = P[n + b, n + a] = 0.5 * (P[n + a, n + b] + P[n + b, n + a])
    for j in range(n):
        m.dx[j] = 0.0


@jit
def keep_apart(f: Any, m: Any) -> None:
    """Leave a local filter its own opinion: only the nominal state that it is counted from has moved by δ_f."""
    n = f.P.shape[0]
    for j in range(n):
        m.dx[j] -= f.dx[j]
