"""Matrix kernels of the smoother, over the workspace of `haltere.estimators.smoother`: solve, multiply, turn. No filtering."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.core.rotation import Mat

__all__ = ["multiply", "smaller_than", "solve", "solve_any", "turn_attitude", "turn_block"]


@jit
def solve(w: Any) -> bool:
    """``w.W`` and ``w.mu``: P'⁻¹ times what stands beside P' in ``w.system``; False where P' is not positive. Gauss-Jordan, without pivots.

    Four rows at a time, by the factors L D Lᵀ of their block on the diagonal: each other row is then read and written once for four.
    The four rows stand in ``w.r`` meanwhile: only what no other row can alias becomes SIMD.
    """
    R, W, r = w.system.P, w.W, w.r
    m, n = w.W.shape[0], len(w.mu)
    width = 2 * m + 4
    for b in range(0, m, 4):
        R0, R1, R2, R3 = R[b], R[b + 1], R[b + 2], R[b + 3]
        d0 = R0[b]
        if not d0 > 0.0:
            return False
        i0 = 1.0 / d0
        l10, l20, l30 = R1[b] * i0, R2[b] * i0, R3[b] * i0
        d1 = R1[b + 1] - l10 * R1[b]
        if not d1 > 0.0:
            return False
        i1 = 1.0 / d1
        c21, c31 = R2[b + 1] - l20 * R1[b], R3[b + 1] - l30 * R1[b]
        l21, l31 = c21 * i1, c31 * i1
        d2 = R2[b + 2] - l20 * R2[b] - l21 * c21
        if not d2 > 0.0:
            return False
        i2 = 1.0 / d2
        c32 = R3[b + 2] - l30 * R2[b] - l31 * c21
        l32 = c32 * i2
        d3 = R3[b + 3] - l30 * R3[b] - l31 * c31 - l32 * c32
        if not d3 > 0.0:
            return False
        i3 = 1.0 / d3
        for j in range(b + 4, width):
            y0 = R0[j]
            y1 = R1[j] - l10 * y0
            y2 = R2[j] - l20 * y0 - l21 * y1
            y3 = R3[j] - l30 * y0 - l31 * y1 - l32 * y2
            z3 = y3 * i3
            z2 = y2 * i2 - l32 * z3
            z1 = y1 * i1 - l21 * z2 - l31 * z3
            r[0, j], r[1, j], r[2, j], r[3, j] = y0 * i0 - l10 * z1 - l20 * z2 - l30 * z3, z1, z2, z3
        for i in range(m):
            if i < b or i >= b + 4:
                f0, f1, f2, f3 = R[i, b], R[i, b + 1], R[i, b + 2], R[i, b + 3]
                for j in range(b + 4, width):
                    R[i, j] -= f0 * r[0, j] + f1 * r[1, j] + f2 * r[2, j] + f3 * r[3, j]
        for k in range(4):
            for j in range(b + 4, width):
                R[b + k, j] = r[k, j]
    for i in range(m):
        for j in range(m):
            W[i, j] = R[i, m + j]
    for i in range(n):
        w.mu[i] = R[i, 2 * m]
    return True


@jit
def solve_any(w: Any) -> bool:
    """Like `solve`, of a first matrix that need not be symmetric: with pivots, and slower."""
    R, m = w.system.P, w.W.shape[0]
    for k in range(m):
        p = k
        for i in range(k + 1, m):
            if abs(R[i, k]) > abs(R[p, k]):
                p = i
        if not abs(R[p, k]) > 0.0:
            return False
        for j in range(2 * m + 4):
            R[k, j], R[p, j] = R[p, j], R[k, j]
        d = 1.0 / R[k, k]
        for j in range(2 * m + 4):
            R[k, j] *= d
        for i in range(m):
            f = R[i, k]
            if i != k:
                for j in range(2 * m + 4):
                    R[i, j] -= f * R[k, j]
    for i in range(m):
        for j in range(m):
            w.W[i, j] = R[i, m + j]
    for i in range(len(w.mu)):
        w.mu[i] = R[i, 2 * m]
    return True


@jit
def smaller_than(w: Any, P: Any, Q: Any, by: float) -> bool:
    """Whether P <= (1 + by) Q: Cholesky's elimination of the difference, in ``w.W``, finds no pivot below zero."""
    W, m = w.W, w.W.shape[0]
    for i in range(m):
        for j in range(m):
            W[i, j] = (1.0 + by) * Q[i, j] - P[i, j]
    for k in range(m):
        if not W[k, k] > 0.0:
            return False
        d = 1.0 / W[k, k]
        for i in range(k + 1, m):
            f = W[i, k] * d
            for j in range(k + 1, m):
                W[i, j] -= f * W[k, j]
    return True


@jit
def multiply(w: Any, A: Any, B: Any, out: Any) -> None:
    """``out`` <- Aᵀ B of matrices of the workspace, a row at a time in ``w.r``: eight terms are summed before it is read and written."""
    m, r = w.W.shape[0], w.r[0]
    whole = m - m % 8
    for i in range(m):
        for j in range(m):
            r[j] = 0.0
        for k in range(0, whole, 8):
            a, b, c, d = A[k, i], A[k + 1, i], A[k + 2, i], A[k + 3, i]
            e, f, g, h = A[k + 4, i], A[k + 5, i], A[k + 6, i], A[k + 7, i]
            for j in range(m):
                first = a * B[k, j] + b * B[k + 1, j] + c * B[k + 2, j] + d * B[k + 3, j]
                r[j] += first + e * B[k + 4, j] + f * B[k + 5, j] + g * B[k + 6, j] + h * B[k + 7, j]
        for k in range(whole, m, 4):
            a, b, c, d = A[k, i], A[k + 1, i], A[k + 2, i], A[k + 3, i]
            for j in range(m):
                r[j] += a * B[k, j] + b * B[k + 1, j] + c * B[k + 2, j] + d * B[k + 3, j]
        for j in range(m):
            out[i, j] = r[j]


@jit
def turn_attitude(P: Any, M: Mat) -> None:
    """P <- M P Mᵀ, where M is one but for the block of attitude."""
    n = P.shape[0]
    for j in range(n):
        a, b, c = P[0, j], P[1, j], P[2, j]
        for i in range(3):
            P[i, j] = M[i][0] * a + M[i][1] * b + M[i][2] * c
    for j in range(n):
        a, b, c = P[j, 0], P[j, 1], P[j, 2]
        for i in range(3):
            P[j, i] = M[i][0] * a + M[i][1] * b + M[i][2] * c


@jit
def turn_block(P: Any, C: Mat, out: Any) -> None:
    """``out`` <- C P Cᵀ of the block of attitude."""
    p00, p01, p02, p11, p12, p22 = P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]
    for i in range(3):
        c = C[i]
        a0, a1, a2 = c[0] * p00 + c[1] * p01 + c[2] * p02, c[0] * p01 + c[1] * p11 + c[2] * p12, c[0] * p02 + c[1] * p12 + c[2] * p22
        out[i, 0] = a0 * C[0][0] + a1 * C[0][1] + a2 * C[0][2]
        out[i, 1] = a0 * C[1][0] + a1 * C[1][1] + a2 * C[1][2]
        out[i, 2] = a0 * C[2][0] + a1 * C[2][1] + a2 * C[2][2]
