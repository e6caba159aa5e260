"""Heading without a compass: five hypotheses of the filter's yaw error, weighed by how well they turn its acceleration into GNSS velocity.

Each is a filter of x = [v_N, v_E, ε], where the true navigation frame is the filter's turned by ε about the vertical; the
filter gives the velocity increment between two fixes, so that a hypothesis costs something only when a fix comes
(theory-amendments.md §19, in the yaw error instead of the yaw). It takes over where yaw is unknown, or contradicted by GNSS.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids.fusing import DISTRUSTED, RUNNING
from haltere.aids.magnetometer import reset_yaw, yaw_variance
from haltere.aids.record import E_RESET, GNSS_VELOCITY, MAGNETOMETER, YAW_BANK, event
from haltere.core.rotation import dcm, wrap

__all__ = ["estimate", "follow", "forget", "update"]

HYPOTHESES = 5
#: Velocity noise [m/s/sqrt(s)] (tilt errors and wind on the accelerometer included) and yaw noise [rad/sqrt(s)] of a hypothesis.
NOISE_V, NOISE_YAW = 0.5, 0.01
#: Takes over below this 1 sigma [rad], when velocity has changed by this much [m/s] within the last ten seconds.
SD_MAX, CHANGE_MIN = math.radians(15.0), 1.0
#: What a wrong yaw is taken to have spoilt, 1 sigma: tilt [rad], velocity [m/s], position [m], biases [rad/s, m/s^2].
TILT_SPOILT, VEL_SPOILT, POS_SPOILT, BG_SPOILT, BA_SPOILT = math.radians(5.0), 2.0, 3.0, 0.01, 0.1
#: Yaw is unknown above this 1 sigma, and contradicted from this error on, once GNSS velocity is refused for this long [s].
SD_UNKNOWN, ERROR_MIN, REFUSED = math.radians(20.0), math.radians(25.0), 1.0

#: Half the angle between two hypotheses at the start [rad].
SPACING = math.pi / HYPOTHESES


@jit
def forget(s: Any) -> None:
    """Begin with five equally likely hypotheses around the circle."""
    b = s.yaw
    b.n, b.dv[0], b.dv[1], b.t = 0, 0.0, 0.0, s.t
    b.corrected = s.yaw_corrected
    for i in range(HYPOTHESES):
        b.w[i] = 1.0 / HYPOTHESES
        for j in range(3):
            b.x[i, j] = 0.0
            for k in range(3):
                b.P[i, j, k] = 0.0
        b.x[i, 2] = wrap(2.0 * math.pi * i / HYPOTHESES)
        b.P[i, 2, 2] = SPACING * SPACING


@jit
def follow(s: Any) -> None:
    """Take the corrections of the filter's yaw since the last call off its error."""
    b = s.yaw
    for i in range(HYPOTHESES):
        b.x[i, 2] = wrap(b.x[i, 2] - (s.yaw_corrected - b.corrected))
    b.corrected = s.yaw_corrected


@jit
def estimate(s: Any) -> tuple[float, float]:
    """Yaw error by the mean direction of the weighed hypotheses, and its 1 sigma [rad]."""
    b = s.yaw
    north, east = 0.0, 0.0
    for i in range(HYPOTHESES):
        north += b.w[i] * math.cos(b.x[i, 2])
        east += b.w[i] * math.sin(b.x[i, 2])
    mean = math.atan2(east, north)
    total = 0.0
    for i in range(HYPOTHESES):
        d = wrap(b.x[i, 2] - mean)
        total += b.w[i] * (b.P[i, 2, 2] + d * d)
    return mean, math.sqrt(total)


@jit
def one_hypothesis(b: Any, i: int, z0: float, z1: float, dt: float, r: float, q: float) -> float:
    """Predict one hypothesis over the interval and update it with the velocity; return the likelihood of the innovation.

    ``r`` is the variance of the velocity, ``q`` what the interval adds to that of the increment.
    """
    x, P = b.x[i], b.P[i]
    c, sn = math.cos(x[2]), math.sin(x[2])
    g0, g1 = -sn * b.dv[0] - c * b.dv[1], c * b.dv[0] - sn * b.dv[1]  # derivative of the turned increment against ε
    x[0] += c * b.dv[0] - sn * b.dv[1]
    x[1] += sn * b.dv[0] + c * b.dv[1]
    p02, p12, p22 = P[0, 2], P[1, 2], P[2, 2]
    a00 = P[0, 0] + 2.0 * g0 * p02 + g0 * g0 * p22 + q
    a01 = P[0, 1] + g1 * p02 + g0 * p12 + g0 * g1 * p22
    a11 = P[1, 1] + 2.0 * g1 * p12 + g1 * g1 * p22 + q
    a02, a12, a22 = p02 + g0 * p22, p12 + g1 * p22, p22 + NOISE_YAW * NOISE_YAW * dt
    s00, s11 = a00 + r, a11 + r
    det = s00 * s11 - a01 * a01
    e0, e1 = z0 - x[0], z1 - x[1]
    i00, i01, i11 = s11 / det, -a01 / det, s00 / det
    nis = e0 * e0 * i00 + 2.0 * e0 * e1 * i01 + e1 * e1 * i11
    k00, k01 = a00 * i00 + a01 * i01, a00 * i01 + a01 * i11
    k10, k11 = a01 * i00 + a11 * i01, a01 * i01 + a11 * i11
    k20, k21 = a02 * i00 + a12 * i01, a02 * i01 + a12 * i11
    x[0] += k00 * e0 + k01 * e1
    x[1] += k10 * e0 + k11 * e1
    x[2] = wrap(x[2] + k20 * e0 + k21 * e1)
    P[0, 0] = a00 - k00 * a00 - k01 * a01
    P[0, 1] = a01 - k00 * a01 - k01 * a11
    P[0, 2] = a02 - k00 * a02 - k01 * a12
    P[1, 1] = a11 - k10 * a01 - k11 * a11
    P[1, 2] = a12 - k10 * a02 - k11 * a12
    P[2, 2] = max(a22 - k20 * a02 - k21 * a12, 1e-6)
    P[1, 0], P[2, 0], P[2, 1] = P[0, 1], P[0, 2], P[1, 2]
    return math.exp(-0.5 * min(nis, 60.0)) / math.sqrt(det)


@jit
def doubt(s: Any) -> None:
    """Widen what a wrong yaw has spoilt meanwhile: tilt, velocity, position and biases, so that the next fixes can mend them."""
    for i in range(3):
        s.P[i, i] += TILT_SPOILT * TILT_SPOILT
        s.P[3 + i, 3 + i] += VEL_SPOILT * VEL_SPOILT
        s.P[6 + i, 6 + i] += POS_SPOILT * POS_SPOILT
        s.P[9 + i, 9 + i] += BG_SPOILT * BG_SPOILT
        s.P[12 + i, 12 + i] += BA_SPOILT * BA_SPOILT


@jit
def update(s: Any, z0: float, z1: float, r: float) -> None:
    """Take a GNSS velocity (north, east [m/s], variance) and, where it is called for, set the filter's yaw.

    Named conditions to take over: the bank agrees within ``SD_MAX``; velocity has changed lately; and the filter's yaw is
    unknown, or is wrong by the bank while no compass vouches for it or GNSS velocity has been refused.
    """
    b = s.yaw
    dt = s.t - b.t
    b.t = s.t
    if b.n == 0 or dt > 2.0:
        forget(s)
        for i in range(HYPOTHESES):
            b.x[i, 0], b.x[i, 1] = z0, z1
            b.P[i, 0, 0], b.P[i, 1, 1] = r, r
        b.slow[0], b.slow[1] = z0, z1
        b.n = 1
        return
    follow(s)
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    yaw2 = yaw_variance(s, C)
    tilt2 = 0.5 * max(0.0, s.P[0, 0] + s.P[1, 1] + s.P[2, 2] - yaw2)
    q = (NOISE_V * NOISE_V + s.gravity * s.gravity * tilt2) * dt  # a tilt error is a false acceleration, for about a second
    total = 0.0
    for i in range(HYPOTHESES):
        b.w[i] *= one_hypothesis(b, i, z0, z1, dt, r, q)
        total += b.w[i]
    for i in range(HYPOTHESES):
        b.w[i] = max(b.w[i] / total, 1e-6) if total > 0.0 else 1.0 / HYPOTHESES
    b.n += 1
    b.dv[0], b.dv[1] = 0.0, 0.0
    k = min(1.0, dt / 10.0)
    b.slow[0] += k * (z0 - b.slow[0])
    b.slow[1] += k * (z1 - b.slow[1])
    moved = math.hypot(z0 - b.slow[0], z1 - b.slow[1]) > CHANGE_MIN

    error, sd = estimate(s)
    if not moved or not sd <= SD_MAX:
        return
    unknown = yaw2 > SD_UNKNOWN * SD_UNKNOWN
    refused = s.t - s.aid[GNSS_VELOCITY].t_passed > REFUSED
    compass = s.aid[MAGNETOMETER].started == RUNNING and s.t - s.aid[MAGNETOMETER].t_passed < 1.0
    contradicted = abs(error) > max(ERROR_MIN, 3.0 * sd) and (refused or not compass)
    if unknown or contradicted:
        reset_yaw(s, error, max(sd, 0.5 * SD_MAX))
        follow(s)
        if abs(error) > ERROR_MIN:
            doubt(s)
            if s.aid[MAGNETOMETER].started > 0:
                s.aid[MAGNETOMETER].started = DISTRUSTED
        event(s, s.t, E_RESET, YAW_BANK, error)
