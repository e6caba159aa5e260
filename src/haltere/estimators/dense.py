"""Matrix kernels of the smoother, over the workspace of `haltere.estimators.smoother`: solve, multiply, turn. No filtering."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.core.rotation import Mat

__all__ = ["multiply", "solve", "solve_any", "turn_attitude", "turn_block"]


@jit
def solve(w: Any) -> bool:
    """``w.W`` and ``w.mu``: P'⁻¹ times what stands beside P' in ``w.system``; False where P' is not positive. Gauss, without pivots.

    A row is copied before others are changed by it: only then does the inner loop become SIMD.
    """
    R, W, r = w.system.P, w.W, w.r
    m, n = w.W.shape[0], len(w.mu)
    for k in range(m):
        if not R[k, k] > 0.0:
            return False
        d = 1.0 / R[k, k]
        for j in range(2 * m + 4):
            r[j] = d * R[k, j]
        for i in range(k + 1, m):
            f = R[i, k]
            for j in range(2 * m + 4):
                R[i, j] -= f * r[j]
        for j in range(2 * m + 4):
            R[k, j] = r[j]
    for k in range(m - 1, -1, -1):
        for j in range(m + 4):
            r[j] = R[k, m + j]
        for j in range(m):
            W[k, j] = r[j]
        for i in range(k):
            f = R[i, k]
            for j in range(m + 4):
                R[i, m + j] -= f * r[j]
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
def multiply(w: Any, A: Any, B: Any, out: Any, symmetric: bool) -> None:
    """``out`` <- Aᵀ B of matrices of the workspace, in blocks of four by four that stay in registers; what is symmetric only once."""
    m = w.W.shape[0]
    for i in range(0, m, 4):
        for j in range(i if symmetric else 0, m, 4):
            c0, c1, c2, c3 = 0.0, 0.0, 0.0, 0.0
            d0, d1, d2, d3 = 0.0, 0.0, 0.0, 0.0
            e0, e1, e2, e3 = 0.0, 0.0, 0.0, 0.0
            f0, f1, f2, f3 = 0.0, 0.0, 0.0, 0.0
            for k in range(m):
                x0, x1, x2, x3 = B[k, j], B[k, j + 1], B[k, j + 2], B[k, j + 3]
                a = A[k, i]
                c0 += a * x0
                c1 += a * x1
                c2 += a * x2
                c3 += a * x3
                a = A[k, i + 1]
                d0 += a * x0
                d1 += a * x1
                d2 += a * x2
                d3 += a * x3
                a = A[k, i + 2]
                e0 += a * x0
                e1 += a * x1
                e2 += a * x2
                e3 += a * x3
                a = A[k, i + 3]
                f0 += a * x0
                f1 += a * x1
                f2 += a * x2
                f3 += a * x3
            out[i, j], out[i, j + 1], out[i, j + 2], out[i, j + 3] = c0, c1, c2, c3
            out[i + 1, j], out[i + 1, j + 1], out[i + 1, j + 2], out[i + 1, j + 3] = d0, d1, d2, d3
            out[i + 2, j], out[i + 2, j + 1], out[i + 2, j + 2], out[i + 2, j + 3] = e0, e1, e2, e3
            out[i + 3, j], out[i + 3, j + 1], out[i + 3, j + 2], out[i + 3, j + 3] = f0, f1, f2, f3
    if symmetric:
        for i in range(m):
            for j in range(i):
                out[i, j] = out[j, i]


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
