"""The compiled step of the published quaternion filter (source W): the same faces as `haltere.estimators.step`, four states.

Gravity as the accelerometer shows it, the Earth's field and the wind triangle correct an additive quaternion, each when it comes
(theory.md §3). It estimates no bias, no velocity and no wind.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import entry, jit
from haltere.aids.record import (
    E_ALIGNED,
    E_DIVERGED,
    E_GAP,
    E_REALIGNED,
    GNSS_VELOCITY,
    MAGNETOMETER,
    NO_SENSOR,
    ROTORS,
    VANES,
    WIND,
    event,
)
from haltere.core.picard import EXACT, increment
from haltere.core.rotation import Mat, Quat, Vec, dcm, mat_vec, norm, quat_from_euler, quat_mul, quat_unit, tmat_vec
from haltere.estimators.alignment import AT_REST, GRAVITY_ONLY, WAIT_COMPASS, level_and_compass
from haltere.estimators.quaternion_fuse import fuse_all, hear
from haltere.estimators.step import COVARIANCE_ROWS, LONG_STEP, behind, take
from haltere.filter.queue import pop_due, pop_imu, push
from haltere.strapdown.quaternion import attitude_covariance, normalise, predict, quaternion_covariance

__all__ = ["COVARIANCE_ROWS", "advance", "begin_at", "flush", "now", "offer", "row_width", "run_chunk", "shown", "stage_of", "step"]

#: Alignment gathers for so long [s].
SPAN = 1.0
ZERO = (0.0, 0.0, 0.0)


def stage_of(S: Any) -> None:
    """Of these states there is no first stage."""
    return


@entry
def row_width(n: int) -> int:
    """Columns of the output rows: those of `haltere.estimators.step.row_width`, of which only t, q and P_θθ are filled."""
    return 35


@jit
def arctan_euler(x: Quat) -> Vec:
    """(3) as printed: roll, pitch and yaw with plain arc tangents, of a quaternion of whatever length."""
    w, i, j, k = x
    return (
        math.atan(2.0 * (j * k + w * i) / (w * w - i * i - j * j + k * k)),
        -math.asin(min(1.0, max(-1.0, 2.0 * (i * k - w * j)))),
        math.atan(2.0 * (i * j + w * k) / (w * w + i * i - j * j - k * k)),
    )


@jit
def shown(prm: Any, x: Quat) -> Quat:
    """The attitude that is given out: the state at length one, or what the printed (3) makes of it."""
    if prm.wind_attitude_angles > 0.0:
        roll, pitch, yaw = arctan_euler(x)
        return quat_from_euler(roll, pitch, yaw)
    return quat_unit(x)


@jit
def show(s: Any, prm: Any) -> None:
    """Bring the attitude given out up to date."""
    q = shown(prm, (s.x[0], s.x[1], s.x[2], s.x[3]))
    s.q[0], s.q[1], s.q[2], s.q[3] = q


@jit
def write_row(s: Any, prm: Any, rows: Any) -> None:
    """Append time, attitude and the covariance of its error."""
    show(s, prm)
    i = s.n_rows
    if i >= rows.shape[0]:
        return
    V = attitude_covariance(s)
    rows[i, 0] = s.t
    for j in range(4):
        rows[i, 1 + j] = s.q[j]
    for j in range(5, 35):
        rows[i, j] = 0.0
    rows[i, 17], rows[i, 18], rows[i, 19] = V[0]
    rows[i, 20], rows[i, 21], rows[i, 22] = V[1][1], V[1][2], V[2][2]
    s.n_rows = i + 1


@jit
def write_covariance(s: Any, prm: Any, cov: Any) -> None:
    """Append the attitude's block of the covariance; the others are not there."""
    i = s.n_cov
    if s.t < s.t_covariance or i >= cov.shape[1]:
        return
    s.t_covariance = s.t + prm.covariance_interval
    V = attitude_covariance(s)
    for k in range(cov.shape[0]):
        cov[k, i] = math.nan
    cov[0, i], cov[1, i], cov[2, i], cov[3, i] = s.t, V[0][0], V[0][1], V[0][2]
    cov[4, i], cov[5, i], cov[6, i] = V[1][1], V[1][2], V[2][2]
    s.n_cov = i + 1


@jit
def sound(s: Any) -> bool:
    """Whether state and covariance are finite, and the state has a length."""
    n = s.x[0] * s.x[0] + s.x[1] * s.x[1] + s.x[2] * s.x[2] + s.x[3] * s.x[3]
    total = n
    for i in range(4):
        total += s.P[i, i]
    return math.isfinite(total) and 1e-6 < n < 1e6


@jit
def begin(s: Any, t: float) -> None:
    """Forget what was gathered; the filter aligns anew."""
    s.t, s.phase, s.t_first, s.n_m, s.n_f, s.path = t, 1, t, 0.0, 0.0, 0.0
    s.t_gnss, s.air.t_rotors, s.air.n_ratio, s.n_block, s.t_block = -1e9, -1e9, 0, 0.0, t
    s.turned[0], s.turned[1], s.turned[2], s.turned[3] = 1.0, 0.0, 0.0, 0.0
    for i in range(3):
        s.f_sum[i], s.m_sum[i], s.f_block[i], s.gnss_a[i] = 0.0, 0.0, 0.0, 0.0
    for k in range(len(s.aid)):
        s.aid[k].started, s.aid[k].t_due, s.aid[k].t_passed = 0, t, t


@entry
def begin_at(S: Any, V: Mat) -> None:
    """Run from the state ``x`` of length one, with the covariance of its local attitude error [rad^2]."""
    s = S[0]
    quaternion_covariance((s.x[0], s.x[1], s.x[2], s.x[3]), V, s.P)
    s.phase, s.n_aligned = 2, 1
    for k in range(len(s.aid)):
        s.aid[k].t_passed = s.t


@jit
def gather(s: Any, prm: Any, w0: Vec, w1: Vec, f: Vec, dt: float) -> None:
    """Initial attitude: a second of specific force as gravity, whatever the vehicle does, and of the field (the source says nothing)."""
    q = quat_unit(quat_mul((s.turned[0], s.turned[1], s.turned[2], s.turned[3]), increment(EXACT, w0, w1, dt)))
    s.turned[0], s.turned[1], s.turned[2], s.turned[3] = q
    s.path += norm(w1) * dt
    C = dcm(q)
    part = mat_vec(C, f)
    for i in range(3):
        s.f_sum[i] += part[i]
    s.n_f += 1.0
    for kind in range(len(s.ring_n)):
        k = pop_due(s, kind, s.t)
        while k >= 0:
            m = s.ring[kind, k]
            if kind == MAGNETOMETER:
                part = mat_vec(C, (m.z[0], m.z[1], m.z[2]))
                s.n_m += 1.0
                for i in range(3):
                    s.m_sum[i] += part[i]
            else:
                hear(s, prm, kind, m)
            k = pop_due(s, kind, s.t)
    waited = s.t - s.t_first
    if waited < SPAN or (prm.aid_magnetometer > 0.0 and s.n_m == 0.0 and waited < WAIT_COMPASS):
        return
    k = 1.0 / s.n_f
    f_b = tmat_vec(C, (k * s.f_sum[0], k * s.f_sum[1], k * s.f_sum[2]))
    if norm(f_b) < 0.3 * s.gravity:
        begin(s, s.t)
        return
    k = 1.0 / max(s.n_m, 1.0)
    m_b = tmat_vec(C, (k * s.m_sum[0], k * s.m_sum[1], k * s.m_sum[2]))
    x0, x1, x2, x3, passed = level_and_compass(s, prm, f_b, ZERO, m_b, s.n_m > 0.0 and prm.aid_magnetometer > 0.0)
    s.x[0], s.x[1], s.x[2], s.x[3] = x0, x1, x2, x3
    still = abs(norm(f_b) - s.gravity) < prm.rest_gravity and s.path < prm.rest_gyro * waited
    tilt = prm.init_tilt_rest if still else prm.init_tilt_motion
    yaw = prm.init_yaw_compass if passed else prm.init_yaw_unknown
    a, b = tilt * tilt, yaw * yaw - tilt * tilt
    d = dcm((x0, x1, x2, x3))[2]
    V = (
        (a + b * d[0] * d[0], b * d[0] * d[1], b * d[0] * d[2]),
        (b * d[1] * d[0], a + b * d[1] * d[1], b * d[1] * d[2]),
        (b * d[2] * d[0], b * d[2] * d[1], a + b * d[2] * d[2]),
    )
    quaternion_covariance((x0, x1, x2, x3), V, s.P)
    s.phase, s.t_aligned, s.t_covariance = 2, s.t, s.t
    event(s, s.t, E_ALIGNED if s.n_aligned == 0 else E_REALIGNED, NO_SENSOR, float(AT_REST) if still else float(GRAVITY_ONLY))
    s.n_aligned += 1


@jit
def advance(s: Any, prm: Any, rows: Any, cov: Any, aids: Any) -> None:
    """Move the fusion horizon over the oldest queued IMU sample."""
    m = s.imu[s.imu_head]
    t = m.t
    w1, f1 = (m.w[0], m.w[1], m.w[2]), (m.f[0], m.f[1], m.f[2])
    pop_imu(s)
    w0 = w1 if prm.imu_mean > 0.0 else (s.w_raw[0], s.w_raw[1], s.w_raw[2])
    s.w_raw[0], s.w_raw[1], s.w_raw[2] = w1
    s.f_raw[0], s.f_raw[1], s.f_raw[2] = f1
    s.n_steps += 1
    dt = t - s.t
    if s.phase == 0 or (s.n_steps > 1 and dt > prm.timeout_imu):
        if s.phase > 0:  # too long to bridge: align anew
            event(s, t, E_GAP, NO_SENSOR, dt)
            s.n_gaps += 1
        begin(s, t)
        s.n_unaligned += 1
        return
    s.t = t
    if s.n_steps == 1:  # begun from a given state: its first sample only begins the first interval
        write_row(s, prm, rows)
        write_covariance(s, prm, cov)
        return
    if s.phase == 1:
        gather(s, prm, w0, w1, f1, dt)
        if s.phase == 1:
            s.n_unaligned += 1
            return
    else:
        order = int(prm.wind_attitude_integrator) if dt <= LONG_STEP else EXACT
        predict(s, increment(order, w0, w1, dt), prm.noise_gyro, dt)
        if dt > LONG_STEP:  # nobody knows what happened meanwhile
            predict(s, (1.0, 0.0, 0.0, 0.0), 0.5 * math.sqrt(dt), dt)
            event(s, t, E_GAP, NO_SENSOR, dt)
            s.n_gaps += 1
        if prm.wind_attitude_normalise > 0.0:
            normalise(s, prm.wind_attitude_normalise > 1.0)
        fuse_all(s, prm, aids, f1, dt)
    if t >= s.t_covariance and not sound(s):
        event(s, t, E_DIVERGED, NO_SENSOR, 0.0)
        begin(s, t)
        s.n_unaligned += 1
        return
    write_row(s, prm, rows)
    write_covariance(s, prm, cov)


@entry
def step(S: Any, PRM: Any, t: float, gyro: Vec, accel: Vec, rows: Any, cov: Any, aids: Any, tape: Any, stage: Any) -> int:
    """Take one IMU sample, and move the horizon as far as ``horizon`` behind it; see `haltere.estimators.step.step`."""
    s, prm = S[0], PRM[0]
    status = take(s, t, gyro, accel)
    while behind(s, prm):
        advance(s, prm, rows, cov, aids)
    return status


@entry
def flush(S: Any, PRM: Any, rows: Any, cov: Any, aids: Any, tape: Any, stage: Any) -> None:
    """Move the horizon to the newest IMU sample: the end of a log."""
    s, prm = S[0], PRM[0]
    while s.imu_n > 0:
        advance(s, prm, rows, cov, aids)


@entry
def offer(S: Any, PRM: Any, kind: int, t: float, z: Vec, r: Vec) -> int:
    """Queue a measurement stamped t by the time it was valid; see `filter.queue.push` for what comes back, 2 when switched off."""
    s, prm = S[0], PRM[0]
    delay = 0.0
    if kind == GNSS_VELOCITY and prm.aid_gnss > 0.0:
        delay = prm.delay_gnss_velocity
    elif kind == MAGNETOMETER and prm.aid_magnetometer > 0.0:
        delay = prm.delay_magnetometer
    elif kind == VANES and prm.aid_airdata > 0.0:
        delay = prm.delay_airdata
    elif kind == WIND and prm.aid_wind > 0.0:
        delay = prm.delay_wind
    elif kind == ROTORS:
        delay = prm.delay_rotors
    else:
        return 2
    return push(s, kind, t - delay, z, r)


@entry
def run_chunk(
    S: Any, PRM: Any, t: Any, gyro: Any, accel: Any, i: int, i_end: int, kinds: Any, stamps: Any, z: Any, r: Any, j: int, rows: Any,
    cov: Any, aids: Any, tape: Any, stage: Any, rotor_t: Any, rotor_speed: Any,
) -> tuple[int, int]:  # fmt: skip
    """Do what `offer` and `step` do over IMU samples i ... i_end - 1; see `haltere.estimators.step.run_chunk`. No model hears rotors."""
    s, prm = S[0], PRM[0]
    while s.n_aids <= len(aids) - 2048 and s.n_events <= len(s.event) - 8 and s.n_rows <= rows.shape[0] - 2 * len(s.imu):
        if behind(s, prm) or (i == len(t) and s.imu_n > 0):
            advance(s, prm, rows, cov, aids)
        elif i < i_end:
            while j < len(stamps) and stamps[j] <= t[i]:
                offer(S, PRM, kinds[j], stamps[j], (z[j, 0], z[j, 1], z[j, 2]), (r[j, 0], r[j, 1], r[j, 2]))
                j += 1
            take(s, t[i], (gyro[i, 0], gyro[i, 1], gyro[i, 2]), (accel[i, 0], accel[i, 1], accel[i, 2]))
            i += 1
        else:
            break
    return i, j


@entry
def now(S: Any, PRM: Any, out: Any) -> None:
    """Attitude predicted to the newest IMU sample: t and q into ``out`` (11); velocity and position are not known."""
    s, prm = S[0], PRM[0]
    x, t = (s.x[0], s.x[1], s.x[2], s.x[3]), s.t
    w0 = (s.w_raw[0], s.w_raw[1], s.w_raw[2])
    for i in range(s.imu_n):
        m = s.imu[(s.imu_head + i) % len(s.imu)]
        w1 = (m.w[0], m.w[1], m.w[2])
        dt = m.t - t
        x = quat_mul(x, increment(int(prm.wind_attitude_integrator), w1 if prm.imu_mean > 0.0 else w0, w1, dt))
        w0, t = w1, m.t
    q = shown(prm, x)
    out[0] = t
    for i in range(4):
        out[1 + i] = q[i]
    for i in range(5, 11):
        out[i] = math.nan
