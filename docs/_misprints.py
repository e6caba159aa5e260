"""The formulas of source W exactly as printed beside what they should be, in NumPy, for the page that shows the difference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]


def printed_1(q: Array) -> Array:
    """(1), its third diagonal element a copy of the second."""
    C = matrix(q)
    C[2, 2] = C[1, 1]
    return C


def matrix(q: Array) -> Array:
    """The matrix that (1) means: C_b^n."""
    w, x, y, z = q
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def printed_2(phi: float, theta: float, psi: float) -> Array:
    """(2), without the stray s."""
    c, s = np.cos, np.sin
    return np.array(
        [
            [c(theta) * c(psi), c(psi) * s(theta) * s(phi) - c(phi) * s(psi), s(phi) * s(psi) + c(phi) * s(theta) * c(psi)],
            [c(theta) * s(psi), c(phi) * c(psi) + s(phi) * s(theta) * s(psi), c(phi) * s(theta) * s(psi) - s(phi) * c(psi)],
            [-s(theta), s(phi) * c(theta), c(phi) * c(theta)],
        ]
    )


def quaternion(phi: float, theta: float, psi: float) -> Array:
    """Unit quaternion of roll, pitch and yaw [rad]."""
    a, b, c = 0.5 * phi, 0.5 * theta, 0.5 * psi
    ca, sa, cb, sb, cc, sc = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(c), np.sin(c)
    return np.array([ca * cb * cc + sa * sb * sc, sa * cb * cc - ca * sb * sc, ca * sb * cc + sa * cb * sc, ca * cb * sc - sa * sb * cc])


def yaw_3(q: Array) -> float:
    """Yaw of (3), with its plain arc tangent [rad]."""
    return float(np.arctan(2 * (q[1] * q[2] + q[0] * q[3]) / (q[1] ** 2 + q[0] ** 2 - q[2] ** 2 - q[3] ** 2)))


def omega(w: Array, printed: bool = False) -> Array:
    """Ω of (6), its third row as it must be or as printed."""
    x, y, z = w
    out = np.array([[0, -x, -y, -z], [x, 0, z, -y], [y, -z, 0, x], [z, y, -x, 0]], dtype=float)
    if printed:
        out[2, 1] = -x
    return out


def longest(w: Array, printed: bool, seconds: float = 60.0) -> float:
    """Largest length of a quaternion that turns at a constant rate [rad/s] by (6)."""
    step, q, most = expm(omega(w, printed) * 0.05), np.array([1.0, 0.0, 0.0, 0.0]), 1.0
    for _ in range(int(seconds / 0.1)):
        q = step @ q
        most = max(most, float(np.linalg.norm(q)))
    return most


def printed_12(q: Array, h: Array) -> Array:
    """(12) with the indices that it prints."""
    q0, q1, q2, q3 = q
    zero = q0**2 + q0**2 - q0**2 - q0**2
    return np.array(
        [
            zero * h[0] + 2 * (q1 * q1 + q1 * q1) * h[1] + 2 * (q1 * q3 - q0 * q2) * h[2],
            2 * (q1 * q2 - q0 * q3) * h[0] + zero * h[1] + 2 * (q0 * q1 + q2 * q3) * h[2],
            2 * (q1 * q3 + q0 * q2) * h[0] + 2 * (q2 * q3 - q0 * q1) * h[1] + (q0**2 - q0**2 - q0**2 + q0**2) * h[2],
        ]
    )


def jacobian(q: Array, a: Array, transposed: bool = True) -> Array:
    """∂(C(q)ᵀ a)/∂q, or of C(q) a, by complex steps."""
    C = [matrix(q + 1e-30j * e) for e in np.eye(4)]
    return np.array([((M.T if transposed else M) @ a).imag / 1e-30 for M in C]).T


def printed_20(q: Array, h: Array) -> Array:
    """(20), all nine rows."""
    q0, q1, q2, q3 = q
    x, y, z = h
    a, b = q0 * x + q3 * y - q2 * z, q1 * x + q2 * y + q3 * z
    c, d = -q2 * x + q1 * y - q0 * z, -q3 * x + q0 * y + q1 * z
    return 2.0 * np.array(
        [
            [-q2, q3, -q0, q1],
            [q1, q0, q3, q2],
            [q0, -q1, -q2, q3],
            [a, b, c, d],
            [d, q2 * x - q1 * y + q0 * z, b, -q0 * x - q3 * y + q2 * z],
            [q2 * x - q1 * y + q0 * z, q3 * x - q0 * y - q1 * z, a, b],
            [q3, -q2, -q1, q0],
            [-q0, q1, -q2, q3],
            [-q1, -q0, -q2, -q3],
        ]
    )
