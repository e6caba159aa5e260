"""Ellipsoid of a magnetometer for the page on the two-stage filter: (14)-(29) with all ten coefficients. It is no calibration tool."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def fit(m: Array) -> tuple[Array, Array]:
    """G and b_m so that |G (m - b_m)| = 1: least |D a|² with aᵀ B a = 1, B of Li and Griffiths (theory.md §4.2, amendment 6)."""
    centre, size = m.mean(axis=0), m.std()
    x, y, z = ((m - centre) / size).T
    D1 = np.column_stack([x * x, y * y, z * z, x * y, x * z, y * z])
    D2 = np.column_stack([x, y, z, np.ones(len(x))])
    S11, S12, S22 = D1.T @ D1, D1.T @ D2, D2.T @ D2
    B = np.zeros((6, 6))
    B[:3, :3] = np.ones((3, 3)) - 2.0 * np.eye(3)
    B[3:, 3:] = -np.eye(3)
    M = S11 - S12 @ np.linalg.solve(S22, S12.T)
    # B a = λ M a with the largest λ, the only one with aᵀ B a > 0: M is positive, so that its root turns this into a symmetric problem
    L = np.linalg.cholesky(M + 1e-14 * np.trace(M) * np.eye(6))
    K = np.linalg.solve(L, np.linalg.solve(L, B).T)
    a = np.linalg.solve(L.T, np.linalg.eigh(0.5 * (K + K.T))[1][:, -1])
    p, q, r, s = -np.linalg.solve(S22, S12.T @ a)
    A = np.array([[a[0], a[3] / 2, a[4] / 2], [a[3] / 2, a[1], a[5] / 2], [a[4] / 2, a[5] / 2, a[2]]])
    x0 = -0.5 * np.linalg.solve(A, np.array([p, q, r]))
    shape = A / (x0 @ A @ x0 - s)
    values, vectors = np.linalg.eigh(shape)
    return vectors @ np.diag(np.sqrt(values)) @ vectors.T / size, centre + size * x0
