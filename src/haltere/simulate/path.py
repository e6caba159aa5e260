"""Smooth three-dimensional paths as splines with exact derivatives, and the attitude a multirotor needs to fly them. No sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

__all__ = ["Motion", "fly", "random_path"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """True motion at times t (n,): NED position, velocity, acceleration (n, 3), attitude q_nb (n, 4), rate and force in the body.

    Attributes
    ----------
    pos_n, vel_n, acc_n
        Position [m], velocity [m/s], acceleration [m/s^2] NED.
    q_nb
        Attitude, continuous in sign.
    gyro_b
        Angular rate [rad/s], body FRD.
    accel_b
        Specific force [m/s^2], body FRD.
    """

    t: FloatArray
    pos_n: FloatArray
    vel_n: FloatArray
    acc_n: FloatArray
    q_nb: FloatArray
    gyro_b: FloatArray
    accel_b: FloatArray


def random_path(rng: np.random.Generator, duration: float, rest: float, extent: float = 40.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Way-points of a lively flight that begins and ends at rest on the ground.

    Parameters
    ----------
    rng
        Source of randomness.
    duration
        Length of the flight [s], rest included.
    rest
        Time at rest at the beginning [s]; 0 begins in the air and in motion.
    extent
        Typical horizontal distance between way-points [m].

    Returns
    -------
    t, pos_n, yaw
        Knot times (k,), positions NED (k, 3) [m], yaw (k,) [rad].
    """
    spacing = 5.0
    early = 0 if rest > 0.0 else 3  # a flight that begins in the air has begun some way-points before
    n = max(9, int((duration - rest) / spacing) + 1) + early
    moving = rest + spacing * (np.arange(n, dtype=np.float64) - early)
    pos = np.column_stack([rng.uniform(-extent, extent, n), rng.uniform(-extent, extent, n), rng.uniform(-30.0, -10.0, n)])
    yaw = np.asarray(np.cumsum(rng.uniform(-1.2, 1.2, n)), dtype=np.float64)
    if rest > 0.0:
        pos = pos * np.minimum(1.0, np.arange(n) / 3.0)[:, None]  # take off before going anywhere
    return moving, pos, yaw


def fly(t: FloatArray, knots: FloatArray, pos_n: FloatArray, yaw: FloatArray, gravity: float) -> Motion:
    """Fly a path: splines of degree seven through the way-points, thrust along the body's z axis.

    Before the first way-point the vehicle rests there; then velocity, acceleration and jerk begin at zero.

    Parameters
    ----------
    t
        Times (n,) [s].
    knots, pos_n, yaw
        Way-points, see `random_path`.
    gravity
        Gravity [m/s^2], down.

    Returns
    -------
    Motion
        With rates from the jerk and the yaw rate in closed form, not from differences.
    """
    still = t < knots[0]
    s = np.maximum(t, knots[0])
    p, heading = _spline(knots, pos_n), _spline(knots, yaw)
    moves = np.where(still, 0.0, 1.0)[:, None]
    pos, vel, acc, jerk = p(s), moves * p(s, 1), moves * p(s, 2), moves * p(s, 3)
    psi, psi_dot = heading(s), moves[:, 0] * heading(s, 1)
    f_n = acc - np.array([0.0, 0.0, gravity])
    size = np.linalg.norm(f_n, axis=1, keepdims=True)
    unit = f_n / size
    b3 = -unit
    b3_dot = -(jerk - np.sum(jerk * unit, axis=1, keepdims=True) * unit) / size
    zero = np.zeros_like(psi)
    y_c = np.column_stack([-np.sin(psi), np.cos(psi), zero])
    y_c_dot = psi_dot[:, None] * np.column_stack([-np.cos(psi), -np.sin(psi), zero])
    u = np.cross(y_c, b3)
    u_dot = np.cross(y_c_dot, b3) + np.cross(y_c, b3_dot)
    length = np.linalg.norm(u, axis=1, keepdims=True)
    b1 = u / length
    b2 = np.cross(b3, b1)
    b1_dot = (u_dot - np.sum(u_dot * b1, axis=1, keepdims=True) * b1) / length
    gyro = np.column_stack([-np.sum(b2 * b3_dot, axis=1), np.sum(b1 * b3_dot, axis=1), np.sum(b2 * b1_dot, axis=1)])
    C = np.stack([b1, b2, b3], axis=2)  # columns are the body axes in NED
    return Motion(t, pos, vel, acc, _quaternions(C), gyro, np.einsum("nij,ni->nj", C, f_n))


def _spline(knots: FloatArray, values: FloatArray) -> BSpline:
    """Spline of degree seven whose first three derivatives begin and end at zero."""
    zero = np.zeros(values.shape[1:])
    ends = [(order, zero) for order in (1, 2, 3)]
    return make_interp_spline(knots, values, k=7, bc_type=(ends, ends))


def _quaternions(C: FloatArray) -> FloatArray:
    """Unit quaternions (n, 4), scalar first, of matrices C_nb (n, 3, 3), continuous in sign."""
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(C).as_quat()[:, [3, 0, 1, 2]]
    flip = np.cumprod(np.r_[1.0, np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0)])
    return np.asarray(q * flip[:, None])
