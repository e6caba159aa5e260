"""Joint update of a small state by three measured components with a full covariance, in Joseph's form. It knows no sensor.

For additive states of a few elements, such as a quaternion; error states with many have `haltere.filter.update`.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.core.rotation import Mat, Quat, Vec

__all__ = ["Rows", "innovation_covariance", "inverse", "project", "update"]

#: Rows of H against four states.
Rows = tuple[Quat, Quat, Quat]


@jit
def _dot4(a: Quat, b: Quat) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@jit
def project(P: Any, h: Quat) -> Quat:
    """P hᵀ of one row."""
    return (
        P[0, 0] * h[0] + P[0, 1] * h[1] + P[0, 2] * h[2] + P[0, 3] * h[3],
        P[1, 0] * h[0] + P[1, 1] * h[1] + P[1, 2] * h[2] + P[1, 3] * h[3],
        P[2, 0] * h[0] + P[2, 1] * h[1] + P[2, 2] * h[2] + P[2, 3] * h[3],
        P[3, 0] * h[0] + P[3, 1] * h[1] + P[3, 2] * h[2] + P[3, 3] * h[3],
    )


@jit
def innovation_covariance(P: Any, H: Rows, R: Mat) -> tuple[Rows, Mat]:
    """Rows of H P, and S = H P Hᵀ + R."""
    u0, u1, u2 = project(P, H[0]), project(P, H[1]), project(P, H[2])
    s01, s02, s12 = _dot4(u0, H[1]) + R[0][1], _dot4(u0, H[2]) + R[0][2], _dot4(u1, H[2]) + R[1][2]
    return (u0, u1, u2), (
        (_dot4(u0, H[0]) + R[0][0], s01, s02),
        (s01, _dot4(u1, H[1]) + R[1][1], s12),
        (s02, s12, _dot4(u2, H[2]) + R[2][2]),
    )


@jit
def inverse(S: Mat) -> Mat:
    """Inverse of a symmetric positive matrix."""
    a = S[1][1] * S[2][2] - S[1][2] * S[1][2]
    b = S[0][2] * S[1][2] - S[0][1] * S[2][2]
    c = S[0][1] * S[1][2] - S[0][2] * S[1][1]
    k = 1.0 / (S[0][0] * a + S[0][1] * b + S[0][2] * c)
    d = S[0][2] * S[0][1] - S[0][0] * S[1][2]
    return (
        (k * a, k * b, k * c),
        (k * b, k * (S[0][0] * S[2][2] - S[0][2] * S[0][2]), k * d),
        (k * c, k * d, k * (S[0][0] * S[1][1] - S[0][1] * S[0][1])),
    )


@jit
def update(P: Any, work: Any, H: Rows, R: Mat, e: Vec) -> Quat:
    """Correction K e of four states, and P <- (I - K H) P (I - K H)ᵀ + K R Kᵀ.

    Parameters
    ----------
    P
        Covariance (4, 4), changed in place; exactly symmetric afterwards.
    work
        Scratch (3, 4, 4).
    H, R, e
        Rows, covariance of the measurement (3, 3), innovations. A component that is not there has e = 0, a row of zeros and a
        diagonal R.

    Returns
    -------
    Quat
        K e.
    """
    U, S = innovation_covariance(P, H, R)
    W = inverse(S)
    K, A, B = work[0], work[1], work[2]  # K is (4, 3): the fourth column is not used
    for i in range(4):
        for j in range(3):
            K[i, j] = U[0][i] * W[0][j] + U[1][i] * W[1][j] + U[2][i] * W[2][j]
    for i in range(4):
        for j in range(4):
            A[i, j] = (1.0 if i == j else 0.0) - K[i, 0] * H[0][j] - K[i, 1] * H[1][j] - K[i, 2] * H[2][j]
    for i in range(4):
        for j in range(4):
            B[i, j] = A[i, 0] * P[0, j] + A[i, 1] * P[1, j] + A[i, 2] * P[2, j] + A[i, 3] * P[3, j]
    for i in range(4):
        k0, k1, k2 = K[i, 0], K[i, 1], K[i, 2]
        r0 = k0 * R[0][0] + k1 * R[1][0] + k2 * R[2][0]
        r1 = k0 * R[0][1] + k1 * R[1][1] + k2 * R[2][1]
        r2 = k0 * R[0][2] + k1 * R[1][2] + k2 * R[2][2]
        for j in range(i + 1):
            P[i, j] = (
                B[i, 0] * A[j, 0] + B[i, 1] * A[j, 1] + B[i, 2] * A[j, 2] + B[i, 3] * A[j, 3] + r0 * K[j, 0] + r1 * K[j, 1] + r2 * K[j, 2]
            )
            P[j, i] = P[i, j]
    return (
        K[0, 0] * e[0] + K[0, 1] * e[1] + K[0, 2] * e[2],
        K[1, 0] * e[0] + K[1, 1] * e[1] + K[1, 2] * e[2],
        K[2, 0] * e[0] + K[2, 1] * e[1] + K[2, 2] * e[2],
        K[3, 0] * e[0] + K[3, 1] * e[1] + K[3, 2] * e[2],
    )
