"""GNSS velocity and position: h, H, R, gates, and when they start, go on and stop. It reads no receiver format."""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids.fusing import ANY_TURN, HARD, NOTHING, RUNNING, THREE, Offer
from haltere.aids.record import BAROMETER, C_POS, C_VEL, E_RESET, FUSED, GNSS_POSITION, R_NONE, R_START, event, record
from haltere.core.earth import gravity, local_from_geodetic, local_from_sphere
from haltere.core.rotation import Mat, Vec, cross, dcm, dot, mat_vec
from haltere.filter.update import NONE, Row
from haltere.strapdown.layout import BG, POS, THETA, VEL

__all__ = [
    "lever_rows",
    "offer_position",
    "offer_velocity",
    "position_observation",
    "position_variance",
    "velocity_model",
    "velocity_variance",
]

#: Variance above which an accuracy says no more [m^2, m^2/s^2]: infinity would poison a gain.
WORTHLESS = 1e8
ONES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@jit
def lever_rows(C: Mat, a: Vec, k: float) -> Mat:
    """Rows of k C [a]×, the derivative of C a against the attitude error with the sign k."""
    return (
        (k * (C[0][1] * a[2] - C[0][2] * a[1]), k * (C[0][2] * a[0] - C[0][0] * a[2]), k * (C[0][0] * a[1] - C[0][1] * a[0])),
        (k * (C[1][1] * a[2] - C[1][2] * a[1]), k * (C[1][2] * a[0] - C[1][0] * a[2]), k * (C[1][0] * a[1] - C[1][1] * a[0])),
        (k * (C[2][1] * a[2] - C[2][2] * a[1]), k * (C[2][2] * a[0] - C[2][0] * a[2]), k * (C[2][0] * a[1] - C[2][1] * a[0])),
    )


@jit
def velocity_variance(prm: Any, r: Any) -> Vec:
    """Variances of a velocity fix: the receiver's own where given, at least the configured floor, else the configured value."""
    default = prm.noise_gnss_velocity * prm.noise_gnss_velocity
    floor = prm.noise_gnss_velocity_min * prm.noise_gnss_velocity_min
    return (
        min(max(r[0], floor), WORTHLESS) if r[0] >= 0.0 else default,
        min(max(r[1], floor), WORTHLESS) if r[1] >= 0.0 else default,
        min(max(r[2], floor), WORTHLESS) if r[2] >= 0.0 else default,
    )


@jit
def position_variance(prm: Any, r: Any) -> Vec:
    """Variances of a position fix [m^2], as `velocity_variance`."""
    default = prm.noise_gnss_position * prm.noise_gnss_position
    default_d = prm.noise_gnss_altitude * prm.noise_gnss_altitude
    floor = prm.noise_gnss_position_min * prm.noise_gnss_position_min
    return (
        min(max(r[0], floor), WORTHLESS) if r[0] >= 0.0 else default,
        min(max(r[1], floor), WORTHLESS) if r[1] >= 0.0 else default,
        min(max(r[2], floor), WORTHLESS) if r[2] >= 0.0 else default_d,
    )


@jit
def position_observation(s: Any, prm: Any, z: Any) -> Vec:
    """North, east, down [m] of a fix (lat, lon, alt); the first three-dimensional one sets the origin where none is set."""
    if s.has_origin == 0 and z[0] == z[0] and z[2] == z[2]:
        s.origin[0], s.origin[1], s.origin[2] = z[0], z[1], z[2]
        s.has_origin = 1
        s.gravity = gravity(z[0], z[2])
    north, east, down = local_from_geodetic(z[0], z[1], z[2], s.origin[0], s.origin[1], s.origin[2])
    if prm.two_stage_haversine > 0.0:
        north, east = local_from_sphere(z[0], z[1], s.origin[0], s.origin[1])
    return (north, east, down if prm.two_stage_height_sign == 0.0 else -down)


@jit
def velocity_model(s: Any, prm: Any) -> tuple[Vec, tuple[Row, Row, Row], Vec]:
    """GNSS velocity: h = v + C (ω × r) with the antenna at r (theory-amendments.md §8), its rows, and C (ω × r)."""
    arm = (prm.arm_gnss_x, prm.arm_gnss_y, prm.arm_gnss_z)
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    swing = cross((s.w[0], s.w[1], s.w[2]), arm)
    offset = mat_vec(C, swing)
    T = lever_rows(C, swing, -1.0)
    B = lever_rows(C, arm, 1.0)
    H = (
        ((THETA, T[0]), (VEL, ONES[0]), (BG, B[0])),
        ((THETA, T[1]), (VEL, ONES[1]), (BG, B[1])),
        ((THETA, T[2]), (VEL, ONES[2]), (BG, B[2])),
    )
    return (s.v[0] + offset[0], s.v[1] + offset[1], s.v[2] + offset[2]), H, offset


@jit
def offer_velocity(s: Any, prm: Any, m: Any) -> Offer:
    """GNSS velocity with its own variances where given, see `velocity_model`; what the bank of yaw hypotheses reads is left for it."""
    h, H, offset = velocity_model(s, prm)
    z, r = (m.z[0], m.z[1], m.z[2]), velocity_variance(prm, m.r)
    s.yaw.z[0], s.yaw.z[1], s.yaw.r, s.yaw.fresh = z[0] - offset[0], z[1] - offset[1], r[0], 1
    return THREE, C_VEL, z, h, r, H, prm.gate_gnss, prm.timeout_gnss, R_NONE, ANY_TURN, HARD


@jit
def start_position(s: Any, prm: Any, m: Any, aids: Any) -> None:
    """The first fix sets position and makes its error independent of the rest."""
    z = position_observation(s, prm, m.z)
    if not (z[0] == z[0] and z[2] == z[2]):
        return
    r = position_variance(prm, m.r)
    offset = mat_vec(dcm((s.q[0], s.q[1], s.q[2], s.q[3])), (prm.arm_gnss_x, prm.arm_gnss_y, prm.arm_gnss_z))
    a = s.aid[GNSS_POSITION]
    a.started = RUNNING
    a.t_passed = m.t
    P = s.P
    for i in range(3):
        s.p[i] = z[i] - offset[i]
        for j in range(s.P.shape[0]):
            P[6 + i, j] = 0.0
            P[j, 6 + i] = 0.0
        P[6 + i, 6 + i] = r[i]
        record(s, aids, m.t, GNSS_POSITION, C_POS + i, z[i], 0.0, math.sqrt(r[i]), 0.0, 1.0, FUSED, R_START)
    s.aid[BAROMETER].started = 0  # its offset hangs on the height that has just been set
    event(s, m.t, E_RESET, GNSS_POSITION, 0.0)


@jit
def offer_position(s: Any, prm: Any, m: Any, aids: Any, dt: float) -> Offer:
    """GNSS position: h = p + C r. The first fix sets the position instead (start).

    ``dt`` is the IMU interval: a fix falls anywhere in it, which adds (|v| dt)²/12 (theory-amendments.md §8).
    """
    if s.aid[GNSS_POSITION].started == 0:
        start_position(s, prm, m, aids)
        return NOTHING
    z = position_observation(s, prm, m.z)
    r = position_variance(prm, m.r)
    v = (s.v[0], s.v[1], s.v[2])
    jitter = dot(v, v) * dt * dt / 12.0
    r = (r[0] + jitter, r[1] + jitter, r[2] + jitter)
    arm = (prm.arm_gnss_x, prm.arm_gnss_y, prm.arm_gnss_z)
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    offset = mat_vec(C, arm)
    T = lever_rows(C, arm, -1.0)
    H = (((THETA, T[0]), (POS, ONES[0]), NONE), ((THETA, T[1]), (POS, ONES[1]), NONE), ((THETA, T[2]), (POS, ONES[2]), NONE))
    h = (s.p[0] + offset[0], s.p[1] + offset[1], s.p[2] + offset[2])
    return THREE, C_POS, z, h, r, H, prm.gate_gnss, prm.timeout_gnss, R_NONE, ANY_TURN, HARD
