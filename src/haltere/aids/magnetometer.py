"""Magnetometer as a heading that leaves tilt alone (default), or as three axes: h, H, R, tests, start. No calibration."""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids import compass, interference
from haltere.aids.fusing import ANY_TURN, NO_TIMEOUT, NOTHING, ONE, ONLY_TURN, RUNNING, THREE, Offer, Robust
from haltere.aids.record import (
    C_HEADING,
    C_MAG,
    E_RESET,
    FUSED,
    MAGNETOMETER,
    R_DIP,
    R_HORIZONTAL,
    R_NONE,
    R_START,
    R_STRENGTH,
    event,
    record,
)
from haltere.core.rotation import Mat, Vec, dcm, mat_vec, norm, quat_from_rotvec, quat_mul, quat_unit, tmat_vec, wrap
from haltere.filter.robust import IGG3
from haltere.filter.update import NONE, symmetrise
from haltere.strapdown.layout import THETA

__all__ = ["field_n", "heading_row", "learn_field", "offer", "reset_yaw", "yaw_variance"]


@jit
def field_n(s: Any) -> Vec:
    """Reference field [uT] in NED from declination, dip and strength."""
    d, i, h = s.field[0], s.field[1], s.field[2]
    return (h * math.cos(i) * math.cos(d), h * math.cos(i) * math.sin(d), h * math.sin(i))


@jit
def learn_field(s: Any, m_n: Vec, declination: float) -> None:
    """Take dip and strength of the reference from a measured field in NED, where no model of the field is known."""
    horizontal = math.sqrt(m_n[0] * m_n[0] + m_n[1] * m_n[1])
    s.field[0], s.field[1], s.field[2] = declination, math.atan2(m_n[2], horizontal), norm(m_n)
    s.has_field = 1


@jit
def heading_row(C: Mat, declination: float, dip: float) -> Vec:
    """Derivative of the tilt-levelled compass heading against δθ: (e3 - tan I [cos D, sin D, 0])ᵀ C (theory-amendments.md §1)."""
    t = math.tan(dip)
    a, b = -t * math.cos(declination), -t * math.sin(declination)
    return (a * C[0][0] + b * C[1][0] + C[2][0], a * C[0][1] + b * C[1][1] + C[2][1], a * C[0][2] + b * C[1][2] + C[2][2])


@jit
def yaw_variance(s: Any, C: Mat) -> float:
    """Variance of the attitude error about the vertical [rad^2]."""
    return compass.along(s.P, C[2], 0)


@jit
def reset_yaw(s: Any, delta: float, sd: float) -> None:
    """Turn the attitude by ``delta`` [rad] about the vertical; the error about it becomes ``sd`` and independent of the rest."""
    q = quat_unit(quat_mul(quat_from_rotvec((0.0, 0.0, delta)), (s.q[0], s.q[1], s.q[2], s.q[3])))
    s.q[0], s.q[1], s.q[2], s.q[3] = q
    s.yaw_corrected += delta
    C = dcm(q)
    d = C[2]
    P = s.P
    n = s.P.shape[0]
    for j in range(n):  # P <- (I - d dᵀ) P (I - d dᵀ) on the attitude rows, then the new variance along d
        a = d[0] * P[0, j] + d[1] * P[1, j] + d[2] * P[2, j]
        for i in range(3):
            P[i, j] -= d[i] * a
    for j in range(n):
        a = d[0] * P[j, 0] + d[1] * P[j, 1] + d[2] * P[j, 2]
        for i in range(3):
            P[j, i] -= d[i] * a
    for i in range(3):
        for j in range(3):
            P[i, j] += sd * sd * d[i] * d[j]
    symmetrise(s)


@jit
def rate_is_modelled(s: Any) -> bool:
    """Whether a vehicle's model stands in for an axis of the gyro."""
    return len(s.pairs) > 0 and (s.pairs[0].on[0] | s.pairs[0].on[1] | s.pairs[0].on[2]) != 0


@jit
def offer(s: Any, prm: Any, m: Any, aids: Any) -> Offer:
    """Magnetometer sample ``m.z`` [uT, body]. Starts by setting yaw where that is unknown, then heading or three axes."""
    z = (m.z[0], m.z[1], m.z[2])
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    if prm.aid_motor_field > 0.0 and s.has_field == 1:
        interference.learn(s, prm, m.t, z, field_n(s), C)
        z = interference.cleaned(s, z)
    spread = 0.0  # what the offset may still be, as a part of the field
    for i in range(len(s.mag)):
        o = 15 + len(s.baro) + i
        spread = max(spread, 3.0 * math.sqrt(s.P[o, o]) / s.field[2])
    if len(s.mag) > 0:
        z = (z[0] - s.mag[0], z[1] - s.mag[1], z[2] - s.mag[2])
    mu = mat_vec(C, z)
    a = s.aid[MAGNETOMETER]
    horizontal = math.sqrt(mu[0] * mu[0] + mu[1] * mu[1])
    if s.has_field == 0:
        learn_field(s, mu, s.field[0])
    reason, weight = R_NONE, 1.0
    strength, dip = norm(z), math.atan2(mu[2], horizontal)
    if abs(strength / s.field[2] - 1.0) > prm.field_tolerance_strength + spread:
        reason = R_STRENGTH
    elif abs(dip - s.field[1]) > prm.field_tolerance_dip + spread:
        reason = R_DIP
    elif horizontal < 0.2 * s.field[2] * math.cos(s.field[1]):
        reason = R_HORIZONTAL
    heading = wrap(s.field[0] - math.atan2(mu[1], mu[0]))
    if a.started == 0 and reason == R_NONE:
        a.started = RUNNING
        a.t_passed = m.t
        if yaw_variance(s, C) > 0.25:  # above 30 deg linearisation means little: set, do not fuse
            reset_yaw(s, heading, prm.init_yaw_compass)
            event(s, m.t, E_RESET, MAGNETOMETER, heading)
            record(s, aids, m.t, MAGNETOMETER, C_HEADING, heading, 0.0, prm.init_yaw_compass, 0.0, 1.0, FUSED, R_START)
            return NOTHING
    unsure = interference.unsure(s)
    timeout = prm.timeout_magnetometer
    if prm.aid_compass_watch > 0.0 and a.started > 0 and not rate_is_modelled(s):  # which would be taken for the compass' own turning
        timeout = NO_TIMEOUT  # the watch says when the compass is to be heard again
        if reason == R_NONE:
            weight, reason = compass.level(s, prm, strength, dip, m.t - s.compass.t_last)
        watched = compass.observe(s, prm, m.t, heading, weight if reason == R_NONE else 0.0, unsure < interference.UNSURE * s.field[2], C)
        if reason == R_NONE:
            reason = watched
    white, slow = prm.noise_magnetometer * prm.noise_magnetometer, prm.noise_field * prm.noise_field
    weight *= (white + slow) / (white + slow + unsure * unsure)
    shared = 1.0
    if slow > 0.0:  # within its correlation time an error is the same in every sample: together they are worth one
        since = max(m.t - s.compass.t_before, 1e-3)
        shared = 1.0 + slow / (white + slow) * max(2.0 * prm.noise_field_time / since - 1.0, 0.0)
    s.compass.t_before = m.t
    robust = (IGG3, prm.robust_innovation, weight, shared)
    if prm.aid_magnetometer == 2.0 or len(s.mag) > 0:
        return offer_axes(s, prm, C, z, white + slow, timeout, reason, robust)
    row = ((THETA, heading_row(C, s.field[0], s.field[1])), NONE, NONE)
    r = (white + slow) / max(horizontal * horizontal, 1e-6)
    return (
        ONE, C_HEADING, (heading, 0.0, 0.0), (0.0, 0.0, 0.0), (r, r, r), (row, row, row), prm.gate_magnetometer, timeout,
        reason, ANY_TURN if rate_is_modelled(s) else ONLY_TURN, robust,
    )  # fmt: skip


@jit
def offer_axes(s: Any, prm: Any, C: Mat, z: Vec, r: float, timeout: float, reason: int, robust: Robust) -> Offer:
    """Three axes: h = Cᵀ m_n [+ b], H_θ = [Cᵀ m_n]× (theory.md §2.1, §3.6) [and H_b = I]; ``z`` [uT] is without the offset b.

    With the offset as states tilt is left alone: only the turn about the vertical and the offset move.
    """
    h = tmat_vec(C, field_n(s))
    H = (
        ((THETA, (0.0, -h[2], h[1])), NONE, NONE),
        ((THETA, (h[2], 0.0, -h[0])), NONE, NONE),
        ((THETA, (-h[1], h[0], 0.0)), NONE, NONE),
    )
    turn = ANY_TURN
    if len(s.mag) > 0:
        o = 13 + len(s.baro)  # a block that begins two columns before its last
        H = (
            ((THETA, (0.0, -h[2], h[1])), (o, (0.0, 0.0, 1.0)), NONE),
            ((THETA, (h[2], 0.0, -h[0])), (o + 1, (0.0, 0.0, 1.0)), NONE),
            ((THETA, (-h[1], h[0], 0.0)), (o + 2, (0.0, 0.0, 1.0)), NONE),
        )
        if prm.aid_magnetometer != 2.0:
            turn = ONLY_TURN
    return THREE, C_MAG, z, h, (r, r, r), H, prm.gate_magnetometer, timeout, reason, turn, robust
