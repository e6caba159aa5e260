"""The detection filters J11-J16, J21-J24, J31-J34 of `fault-tolerant` (source F, step 4; theory.md §5.4, theory-amendments.md 2-5, 10).

Every one is a filter of its own that updates itself, judged by its whitened innovations: J11-J13 the model's force against the
accelerometer, with what the model misses and the wind as states; J14-J16 its moments against the gyro; J21-J24 a chain that the model
alone drives, against compass, GNSS velocity, barometer, GNSS position; J31-J34 the same of the chain that the IMU drives, which is the
ordinary filter. What their alarms mean is decided elsewhere.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids import gnss
from haltere.aids.record import BAROMETER, C_ALTITUDE, C_HEADING, C_POS, C_VEL, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER, R_START
from haltere.core.rotation import Mat, Vec, dcm, mul_mat
from haltere.estimators.local_filters import (
    MISS_TIME,
    add_noise,
    compass_row,
    correct,
    gust,
    left_over,
    linear_at,
    miss,
    scalar,
    swing_noise,
    unit,
)
from haltere.filter.update import NONE
from haltere.filter.windows import empty, take
from haltere.strapdown.dynamics import ATTITUDE, BARO_OFFSET, MEAN, PLACE, SPEED, carry, move, transition, transpose
from haltere.vehicle.linear import Linear

__all__ = ["detect_external", "detect_inertial", "detect_of_the_imu", "reseed", "watch"]

#: Detection filters by number: J11, J14, J21, J31.
FORCES, MOMENTS, BY_MODEL, BY_IMU = (constant(i) for i in (0, 3, 6, 10))
#: J16, and the part of its level that tells a gyro from a compass when J31 alarms soon after: only these two are left then.
TURNS, NEARLY = constant(5), 0.5
#: The chains settle for so long after they begin [s], and the air near the ground counts for nothing [m].
SETTLE, NEAR = 6.0, 1.5
#: The accelerometer's bias that J11-J13 take off is as old as that, to twice that [s]: a fault shall not hide in it.
HELD = 4.0
#: The model's chain begins anew when its tilt is less sure than this [rad].
LOST = math.radians(40.0)


@jit
def reseed(s: Any, prm: Any) -> None:
    """Begin every chain and window anew from the fused state (source F, step 6)."""
    x = s.ft[0]
    c, a = x.chain, x.air
    for i in range(3):
        c.w[i], c.v[i], c.p[i], c.bm[i], c.bf[i] = x.w[i], x.v[i], x.p[i], x.bm[i], x.bf[i]
        x.axis[i, 0], x.axis[i, 1] = x.w[i] + x.bg[i], 0.0
        sd = miss(s, prm, 3 + i)
        x.axis_P[i, 0], x.axis_P[i, 1], x.axis_P[i, 2] = 1e-3, 0.0, sd * sd if prm.fault_tolerant_biases > 0.0 else 0.0
        a.x[i], x.held[0, i], x.held[1, i] = x.bf[i], x.ba[i], x.ba[i]
    for i in range(4):
        c.q[i] = x.q[i]
    for i in range(2):
        c.wind[i], c.steady[i] = x.wind[i], x.steady[i]
        a.x[3 + i], a.x[5 + i] = x.wind[i], x.steady[i]
    c.baro = x.baro
    for i in range(23):
        c.dx[i] = 0.0
        for j in range(23):
            c.P[i, j] = x.P[i if i < 22 else BARO_OFFSET, j if j < 22 else BARO_OFFSET]
    for i in range(7):
        a.dx[i] = 0.0
        for j in range(7):
            a.P[i, j] = 0.0
    for i in range(3):
        sd = miss(s, prm, i)
        a.P[i, i] = sd * sd
    for i in range(4):
        for j in range(4):
            a.P[3 + i, 3 + j] = x.P[18 + i, 18 + j]
    for i in range(len(x.fast)):
        empty(x.fast[i])
    for i in range(len(x.slow)):
        empty(x.slow[i])
    x.t_chain = x.t_held = x.t


@jit
def judge(s: Any, prm: Any, detector: int, w: Any, t: float) -> None:
    """Whether a detection filter alarms, and the first time that it does."""
    x = s.ft[0]
    statistic = w.snapshot if prm.fault_tolerant_detector > 0.0 else w.glr
    ratio = statistic / x.level[detector]
    x.last[detector] = ratio
    if x.armed != 1 or x.off & (1 << detector):
        return
    x.most[detector] = max(x.most[detector], ratio)
    if detector == TURNS and ratio > NEARLY:
        x.t_jerked = t
    if ratio > 1.0:
        x.t_alarm = t
        if x.alarms == 0:
            x.t_first = t
        if x.alarms & (1 << detector) == 0:
            x.alarms |= 1 << detector
            x.when[detector] = t


@jit
def fast(s: Any, prm: Any, detector: int, z: float, t: float) -> None:
    """Take the residual of one of J11-J16."""
    x = s.ft[0]
    w = x.fast[detector]
    take(w, (z, 0.0, 0.0), 1, x.rho[detector])
    judge(s, prm, detector, w, t)


@jit
def slow(s: Any, prm: Any, detector: int, z: Vec, d: int, t: float) -> None:
    """Take the residual of one of J21-J34."""
    x = s.ft[0]
    w = x.slow[detector - 6]
    take(w, z, d, x.rho[detector])
    judge(s, prm, detector, w, t)


@jit
def watch(s: Any, prm: Any, t: float) -> None:
    """Arm the detection filters where their chains have settled and the vehicle is clear of the ground."""
    x = s.ft[0]
    clear = x.ground - x.p[2] > NEAR
    if not clear:
        x.armed = -1  # contact and ground effect are no faults
        return
    if x.armed < 0:
        reseed(s, prm)
    x.armed = 1 if t - x.t_chain > SETTLE else 0


@jit
def detect_inertial(s: Any, prm: Any, lin: Linear, C: Mat, gyro: Vec, accel: Vec, turned: Vec, dt: float) -> None:
    """J11-J16: mean gyro and accelerometer over the nominal state in one step; ``turned`` is the model's mean angular acceleration."""
    x, m = s.ft[0], s.model[0]
    leak = math.exp(-dt / MISS_TIME)
    r_gyro = (prm.noise_gyro * prm.noise_gyro) / dt
    for i in range(3):
        P, sd = x.axis_P[i], miss(s, prm, 3 + i)
        w, b = x.axis[i, 0], x.axis[i, 1]
        w += dt * (turned[i] + b + lin[5][i][i] * (w - x.w[i] - x.bg[i]))
        b *= leak
        p00 = P[0] + dt * (2.0 * P[1] + dt * P[2]) + dt * swing_noise(s, prm, i)
        p01, p11 = leak * (P[1] + dt * P[2]), leak * leak * P[2]
        if prm.fault_tolerant_biases > 0.0:
            p11 += (1.0 - leak * leak) * sd * sd
        e, S = x.w[i] + gyro[i] - w, p00 + r_gyro
        k0, k1 = p00 / S, p01 / S
        x.axis[i, 0], x.axis[i, 1] = w + k0 * e, b + k1 * e
        P[0], P[1], P[2] = (1.0 - k0) * p00, (1.0 - k0) * p01, p11 - k1 * p01
        fast(s, prm, MOMENTS + i, e / math.sqrt(S), x.t)
    a, keep = x.air, math.exp(-dt / prm.air_gust_time)
    blow = gust(s, prm)
    for i in range(3):
        a.x[i] *= leak
    for i in range(2):
        a.x[3 + i] = keep * a.x[3 + i] + (1.0 - keep) * a.x[5 + i]
    for _half in range(2):
        for j in range(7):
            for i in range(3):
                a.P[i, j] *= leak
            for i in range(2):
                a.P[3 + i, j] = keep * a.P[3 + i, j] + (1.0 - keep) * a.P[5 + i, j]
        for i in range(7):
            for j in range(i):
                a.P[i, j], a.P[j, i] = a.P[j, i], a.P[i, j]
    for i in range(3):
        sd = miss(s, prm, i)
        if prm.fault_tolerant_biases > 0.0:
            a.P[i, i] += (1.0 - leak * leak) * sd * sd
        if i < 2 and prm.fault_tolerant_wind > 0.0:
            a.P[3 + i, 3 + i] += (1.0 - keep * keep) * blow * blow
            a.P[5 + i, 5 + i] += dt * prm.noise_wind_mean * prm.noise_wind_mean
    by_v = mul_mat(lin[2], transpose(C))
    for i in range(3):
        b = by_v[i]
        e = accel[i] + x.bf[i] - x.held[0, i] - a.x[i] - b[0] * (x.wind[0] - a.x[3]) - b[1] * (x.wind[1] - a.x[4])
        r = (prm.noise_accel * prm.noise_accel + left_over(s, prm, i) * m.window[0]) / dt
        for j in range(3):
            r += b[j] * b[j] * x.P[6 + j, 6 + j]
        H = ((0, unit(i)), (3, (-b[0], -b[1], 0.0)), NONE)
        e, S = scalar(a, H, e, r, 1e9)
        before = x.alarms & (1 << i)
        fast(s, prm, FORCES + i, e / math.sqrt(S), x.t)
        if before == 0 and x.alarms & (1 << i):
            x.lacking[i] = abs(x.fast[i].average[0]) * math.sqrt(S)
    if x.t - x.t_held > HELD and x.alarms == 0:
        x.t_held = x.t
        for i in range(3):
            x.held[0, i], x.held[1, i] = x.held[1, i], x.ba[i]
    for i in range(7):
        a.x[i] += a.dx[i]
        a.dx[i] = 0.0


@jit
def detect_external(s: Any, prm: Any, dt: float) -> None:
    """J21-J24: the chain that the model alone drives moves on and hears what waits of the other sensors."""
    x = s.ft[0]
    c = x.chain
    lin, C, v = linear_at(s, prm, c)
    keep, leak = math.exp(-dt / prm.air_gust_time), math.exp(-dt / MISS_TIME)
    force = (lin[0][0] + c.bf[0], lin[0][1] + c.bf[1], lin[0][2] + c.bf[2])
    T = transition(C, (c.w[0], c.w[1], c.w[2]), force, v, lin[2], lin[3], lin[4], lin[5], dt, keep, leak)
    move(c, lin[0], lin[1], s.gravity, dt, keep, leak)
    carry(c, T)
    add_noise(s, prm, c.P, C, dt, 1.0, False)
    c.P[22, 22] += prm.noise_baro_bias * prm.noise_baro_bias * dt
    tilt = (
        C[2][0] * C[2][0] * (c.P[4, 4] + c.P[5, 5])
        + C[2][1] * C[2][1] * (c.P[3, 3] + c.P[5, 5])
        + C[2][2] * C[2][2] * (c.P[3, 3] + c.P[4, 4])
    )
    if tilt > LOST * LOST or not math.isfinite(c.v[0] + c.p[2] + c.q[0]):
        reseed(s, prm)
        return
    C = dcm((c.q[0], c.q[1], c.q[2], c.q[3]))
    for i in range(x.n_due):
        m = x.due[i]
        z0, z1, z2 = 0.0, 0.0, 0.0
        if m.kind == GNSS_VELOCITY or m.kind == GNSS_POSITION:
            place = m.kind == GNSS_POSITION
            value = gnss.position_observation(s, prm, m.z) if place else (m.z[0], m.z[1], m.z[2])
            r = gnss.position_variance(prm, m.r) if place else gnss.velocity_variance(prm, m.r)
            d = 0
            for k in range(3):
                if math.isfinite(value[k]):
                    H = ((PLACE if place else SPEED, unit(k)), NONE, NONE)
                    gate = 0.0 if x.isolated & (1 << (15 if place else 13)) else prm.gate_gnss
                    e, S = scalar(c, H, value[k] - (c.p[k] if place else c.v[k]), r[k], gate)
                    z0, z1, z2 = z1, z2, e / math.sqrt(S)
                    d += 1
            slow(s, prm, BY_MODEL + (3 if place else 1), (z2, z1, z0), d, m.t)
        elif m.kind == MAGNETOMETER and s.has_field == 1:
            # each sample for itself: innovations must be white here, and what surroundings do to all of them is a factor on the level
            e, h, r1 = compass_row(s, prm, C, (m.z[0], m.z[1], m.z[2]), prm.noise_field_time)
            e, S = scalar(c, ((ATTITUDE, h), NONE, NONE), e, r1, 0.0 if x.isolated & (1 << 12) else prm.gate_magnetometer)
            slow(s, prm, BY_MODEL, (e / math.sqrt(S), 0.0, 0.0), 1, m.t)
        elif m.kind == BAROMETER:
            r1 = prm.noise_barometer * prm.noise_barometer
            e = m.z[0] - s.origin[2] + c.p[2] - c.baro
            gate = 0.0 if x.isolated & (1 << 14) else prm.gate_barometer
            e, S = scalar(c, ((PLACE, (0.0, 0.0, -1.0)), (MEAN, (0.0, 0.0, 1.0)), NONE), e, r1, gate)
            slow(s, prm, BY_MODEL + 2, (e / math.sqrt(S), 0.0, 0.0), 1, m.t)
    correct(c, c.dx)
    c.baro += c.dx[22]
    for i in range(23):
        c.dx[i] = 0.0


@jit
def detect_of_the_imu(s: Any, prm: Any, n: int) -> None:
    """J31-J34: innovations of the ordinary filter, which the IMU drives, as its records tell them."""
    x = s.ft[0]
    z0, z1, d = 0.0, 0.0, 0
    for i in range(n):
        h = x.heard[i]
        if h.reason == R_START or not h.innovation_sd > 0.0:
            continue
        z = h.innovation / h.innovation_sd
        place, speed = h.sensor == GNSS_POSITION, h.sensor == GNSS_VELOCITY  # not what was assumed for want of it
        if h.sensor == MAGNETOMETER and h.component == C_HEADING:
            slow(s, prm, BY_IMU, (z, 0.0, 0.0), 1, h.t)
        elif h.sensor == BAROMETER and h.component == C_ALTITUDE:
            slow(s, prm, BY_IMU + 2, (z, 0.0, 0.0), 1, h.t)
        elif (speed and h.component == C_VEL) or (place and h.component == C_POS):
            z0, d = z, 1
        elif (speed and h.component == C_VEL + 1) or (place and h.component == C_POS + 1):
            z1, d = z, 2
        elif d == 2 and ((speed and h.component == C_VEL + 2) or (place and h.component == C_POS + 2)):
            slow(s, prm, BY_IMU + (1 if speed else 3), (z0, z1, z), 3, h.t)
            d = 0
