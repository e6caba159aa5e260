"""Quaternion arithmetic on whole columns for errors of attitude. Kernels have their own scalar form (core.rotation)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "angles_between",
    "conjugate",
    "euler",
    "euler_between",
    "heading_between",
    "multiply",
    "rotation_vector",
    "slerp",
    "tilt_between",
]

FloatArray = NDArray[np.float64]


def multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Hamilton product of quaternions, (n, 4) or (4,)."""
    a0, a1, a2, a3 = np.moveaxis(np.asarray(a), -1, 0)
    b0, b1, b2, b3 = np.moveaxis(np.asarray(b), -1, 0)
    product = np.stack(
        [
            a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
            a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
            a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
            a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
        ]
    )
    return np.moveaxis(product, 0, -1)  # columns in one piece: arithmetic on them is twice as fast


def conjugate(q: FloatArray) -> FloatArray:
    """Inverse of unit quaternions."""
    inverse: FloatArray = np.asarray(q) * np.array([1.0, -1.0, -1.0, -1.0])
    return inverse


def rotation_vector(q: FloatArray) -> FloatArray:
    """Rotation vectors [rad] (n, 3) of unit quaternions (n, 4), the shorter way round."""
    q = np.where(q[..., :1] < 0.0, -q, q)
    s = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(s, q[..., :1])
    return np.asarray(q[..., 1:] * np.where(s > 1e-12, angle / np.maximum(s, 1e-300), 2.0))


def euler(q: FloatArray) -> FloatArray:
    """Roll, pitch, yaw [rad] (n, 3) of q_nb (n, 4)."""
    w, x, y, z = np.moveaxis(np.asarray(q), -1, 0)
    angles: FloatArray = np.stack(
        [
            np.arctan2(2.0 * (y * z + w * x), w * w - x * x - y * y + z * z),
            np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0)),
            np.arctan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z),
        ],
        axis=-1,
    )
    return angles


def euler_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Roll, pitch, yaw [rad] (n, 3) of attitudes a less those of b (q_nb, (n, 4)), wrapped."""
    (sa, ca, pa, ua, va), (sb, cb, pb, ub, vb) = (_sides(np.moveaxis(np.asarray(q), -1, 0)) for q in (a, b))
    angles = np.stack([np.arctan2(sa * cb - ca * sb, ca * cb + sa * sb), pa - pb, np.arctan2(ua * vb - va * ub, va * vb + ua * ub)])
    return np.moveaxis(angles, 0, -1)


def _sides(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of quaternions (4, n): what roll is the arc tangent of, pitch, and what yaw is the arc tangent of."""
    w, x, y, z = q
    a, b = w * w - y * y, x * x - z * z
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    return 2.0 * (y * z + w * x), a - b, pitch, 2.0 * (x * y + w * z), a + b


def slerp(t: FloatArray, tq: FloatArray, q: FloatArray) -> FloatArray:
    """Unit quaternions (m, 4) at times t, linear in the rotation vector between rows of q (n, 4) at times tq."""
    i = np.clip(np.searchsorted(tq, t, side="right") - 1, 0, len(tq) - 2)
    k = np.clip((t - tq[i]) / (tq[i + 1] - tq[i]), 0.0, 1.0)
    half = 0.5 * k[:, None] * rotation_vector(multiply(conjugate(q[i]), q[i + 1]))
    angle = np.linalg.norm(half, axis=1, keepdims=True)
    step = np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], axis=1)
    return multiply(q[i], step)


def angles_between(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Whole angle, tilt and heading [rad] (n,) between two attitudes q_nb (n, 4): see `tilt_between` and `heading_between`."""
    w, x, y, z = np.moveaxis(multiply(a, conjugate(b)), -1, 0)
    off, size = x * x + y * y, np.abs(w)
    whole, tilt = np.arctan2(np.sqrt(off + z * z), size), np.arctan2(np.sqrt(off), np.sqrt(w * w + z * z))
    return np.asarray(2.0 * whole), np.asarray(2.0 * tilt), np.asarray(2.0 * np.arctan2(np.where(w < 0.0, -z, z), size))


def tilt_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angle [rad] (n,) between the verticals that two attitudes q_nb (n, 4) see from the body; heading does not enter."""
    w, x, y, z = np.moveaxis(multiply(a, conjugate(b)), -1, 0)
    return np.asarray(2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)))


def heading_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Turn about the vertical [rad] (n,), within a half turn, that is left of a ⊗ b⁻¹ (q_nb, (n, 4)) without its tilt."""
    w, _, _, z = np.moveaxis(multiply(a, conjugate(b)), -1, 0)
    return np.asarray(2.0 * np.arctan2(np.where(w < 0.0, -z, z), np.abs(w)))
