"""Vectors, matrices and rotations on tuples, for kernels. Nothing here knows of sensors or states.

Conventions (theory.md §1): quaternion scalar first, Hamilton, body to navigation; ``C = dcm(q)`` turns body vectors into
navigation vectors; Euler angles ZYX.
"""

from __future__ import annotations

import math

from haltere._jit import jit

Vec = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Mat = tuple[Vec, Vec, Vec]

__all__ = [
    "Mat",
    "Quat",
    "Vec",
    "add",
    "cross",
    "dcm",
    "dot",
    "euler",
    "mat_vec",
    "mul_mat",
    "norm",
    "quat_from_dcm",
    "quat_from_euler",
    "quat_from_rotvec",
    "quat_mul",
    "quat_unit",
    "rotvec_dcm",
    "scale",
    "sub",
    "tmat_vec",
    "triad",
    "wrap",
]


@jit
def add(a: Vec, b: Vec) -> Vec:
    """Sum of two vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@jit
def sub(a: Vec, b: Vec) -> Vec:
    """Difference of two vectors."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@jit
def scale(a: Vec, k: float) -> Vec:
    """Vector times a number."""
    return (k * a[0], k * a[1], k * a[2])


@jit
def dot(a: Vec, b: Vec) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def norm(a: Vec) -> float:
    """Length of a vector."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@jit
def cross(a: Vec, b: Vec) -> Vec:
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@jit
def mat_vec(m: Mat, a: Vec) -> Vec:
    """Matrix times vector."""
    return (dot(m[0], a), dot(m[1], a), dot(m[2], a))


@jit
def tmat_vec(m: Mat, a: Vec) -> Vec:
    """Transposed matrix times vector."""
    return (
        m[0][0] * a[0] + m[1][0] * a[1] + m[2][0] * a[2],
        m[0][1] * a[0] + m[1][1] * a[1] + m[2][1] * a[2],
        m[0][2] * a[0] + m[1][2] * a[1] + m[2][2] * a[2],
    )


@jit
def mul_mat(a: Mat, b: Mat) -> Mat:
    """Product of two matrices."""
    return (tmat_vec(b, a[0]), tmat_vec(b, a[1]), tmat_vec(b, a[2]))


@jit
def quat_mul(a: Quat, b: Quat) -> Quat:
    """Hamilton product."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@jit
def quat_unit(q: Quat) -> Quat:
    """Quaternion of length one."""
    k = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (k * q[0], k * q[1], k * q[2], k * q[3])


@jit
def quat_from_rotvec(r: Vec) -> Quat:
    """Exact quaternion of a rotation vector [rad] (theory.md §2.2, closed form)."""
    angle2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    if angle2 < 1e-8:  # the series is exact to rounding here, and has no division by zero
        c, s = 1.0 - angle2 / 8.0, 0.5 - angle2 / 48.0
    else:
        angle = math.sqrt(angle2)
        c, s = math.cos(0.5 * angle), math.sin(0.5 * angle) / angle
    return (c, s * r[0], s * r[1], s * r[2])


@jit
def dcm(q: Quat) -> Mat:
    """Direction cosine matrix C_nb of the unit quaternion q_nb."""
    w, x, y, z = q
    return (
        (w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )


@jit
def rotvec_dcm(r: Vec) -> Mat:
    """Direction cosine matrix of a rotation vector [rad]."""
    return dcm(quat_from_rotvec(r))


@jit
def quat_from_dcm(m: Mat) -> Quat:
    """Unit quaternion of a direction cosine matrix, largest component first against cancellation."""
    trace = m[0][0] + m[1][1] + m[2][2]
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        q = (0.25 * s, (m[2][1] - m[1][2]) / s, (m[0][2] - m[2][0]) / s, (m[1][0] - m[0][1]) / s)
    elif m[0][0] > m[1][1] and m[0][0] > m[2][2]:
        s = 2.0 * math.sqrt(1.0 + m[0][0] - m[1][1] - m[2][2])
        q = ((m[2][1] - m[1][2]) / s, 0.25 * s, (m[0][1] + m[1][0]) / s, (m[0][2] + m[2][0]) / s)
    elif m[1][1] > m[2][2]:
        s = 2.0 * math.sqrt(1.0 + m[1][1] - m[0][0] - m[2][2])
        q = ((m[0][2] - m[2][0]) / s, (m[0][1] + m[1][0]) / s, 0.25 * s, (m[1][2] + m[2][1]) / s)
    else:
        s = 2.0 * math.sqrt(1.0 + m[2][2] - m[0][0] - m[1][1])
        q = ((m[1][0] - m[0][1]) / s, (m[0][2] + m[2][0]) / s, (m[1][2] + m[2][1]) / s, 0.25 * s)
    return quat_unit(q)


@jit
def euler(q: Quat) -> Vec:
    """Roll, pitch, yaw [rad] of q_nb (ZYX)."""
    w, x, y, z = q
    sin_pitch = 2.0 * (w * y - x * z)
    return (
        math.atan2(2.0 * (y * z + w * x), w * w - x * x - y * y + z * z),
        math.asin(min(1.0, max(-1.0, sin_pitch))),
        math.atan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z),
    )


@jit
def quat_from_euler(roll: float, pitch: float, yaw: float) -> Quat:
    """q_nb of roll, pitch, yaw [rad] (ZYX)."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@jit
def wrap(angle: float) -> float:
    """Angle in (-pi, pi]."""
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@jit
def triad(a_n: Vec, b_n: Vec, a_b: Vec, b_b: Vec) -> Quat:
    """q_nb from two directions known in both frames, the first kept exactly (TRIAD)."""
    x_n, x_b = scale(a_n, 1.0 / norm(a_n)), scale(a_b, 1.0 / norm(a_b))
    y_n, y_b = cross(a_n, b_n), cross(a_b, b_b)
    y_n, y_b = scale(y_n, 1.0 / norm(y_n)), scale(y_b, 1.0 / norm(y_b))
    z_n, z_b = cross(x_n, y_n), cross(x_b, y_b)
    m = (
        add(add(scale(x_b, x_n[0]), scale(y_b, y_n[0])), scale(z_b, z_n[0])),
        add(add(scale(x_b, x_n[1]), scale(y_b, y_n[1])), scale(z_b, z_n[1])),
        add(add(scale(x_b, x_n[2]), scale(y_b, y_n[2])), scale(z_b, z_n[2])),
    )
    return quat_from_dcm(m)
