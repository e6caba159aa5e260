"""The compiled step of `fault-tolerant` (source F): an ordinary filter for alignment and as the IMU chain, the federated filter beside it.

The same faces as `haltere.estimators.step`. In the air, and with rotor speeds, what is given out is the federated filter's state, else
that of the ordinary filter. Source F's steps 1 to 6 are, in that order, in `advance`.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import entry, jit
from haltere.aids.compass import OUT_FIELD
from haltere.aids.drag import density_ratio
from haltere.aids.record import BAROMETER, E_DISTURBED, E_FAULT, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER
from haltere.core.earth import STANDARD_DENSITY
from haltere.core.rotation import Vec, dcm, mat_vec, quat_from_rotvec, quat_mul, quat_unit
from haltere.estimators import step as ordinary
from haltere.estimators.detection_filters import detect_external, detect_inertial, detect_of_the_imu, reseed, watch
from haltere.estimators.isolation import decide
from haltere.estimators.local_filters import MISS_TIME, evaluate, fuse_inertial, fuse_sensors, fusion, predict_all
from haltere.estimators.local_states import begin, set_axes
from haltere.estimators.step import COVARIANCE_ROWS, LONG_STEP, begin_air, behind, hear_rotors, offer, offer_rotors, take
from haltere.filter.rotors import rotors_at
from haltere.strapdown.dynamics import move

__all__ = [
    "COVARIANCE_ROWS", "advance", "begin_air", "flush", "now", "offer", "offer_rotors", "row_width", "run_chunk", "stage_of", "step",
]  # fmt: skip

#: Thrust over weight above which it may fly, and below which it does not, for how long [s].
HEAVY, LIGHT, HEAVY_TIME, LIGHT_TIME = 0.75, 0.5, 1.0, 0.3


def stage_of(S: Any) -> None:
    """There is no first stage."""
    return


@entry
def row_width(n: int) -> int:
    """Columns of the output rows: those of `haltere.estimators.step.row_width`, then wind north and east with their variances."""
    return 35 + 2 * (n - 15) + 4


@jit
def listen(s: Any, t: float) -> None:
    """Keep what the ordinary filter is about to take off its queues at t."""
    x = s.ft[0]
    for kind in (GNSS_VELOCITY, GNSS_POSITION, BAROMETER, MAGNETOMETER):
        size = s.ring.shape[1]
        for k in range(s.ring_n[kind]):
            m = s.ring[kind, (s.ring_head[kind] + k) % size]
            if m.t > t or x.n_due >= len(x.due):
                break
            d = x.due[x.n_due]
            d.kind, d.t = kind, m.t
            for i in range(3):
                d.z[i], d.r[i] = m.z[i], m.r[i]
            x.n_due += 1


@jit
def hand_over(s: Any, aids: Any, n: int) -> int:
    """Append the records that the ordinary filter left in ``heard`` to those that go out, of which there were ``n``; how many there are."""
    x = s.ft[0]
    for i in range(s.n_aids):
        if n < len(aids):
            a, b = aids[n], x.heard[i]
            a.t, a.observation, a.innovation, a.innovation_sd = b.t, b.observation, b.innovation, b.innovation_sd
            a.test_ratio, a.weight, a.sensor, a.component = b.test_ratio, b.weight, b.sensor, b.component
            a.status, a.reason = b.status, b.reason
            n += 1
        else:
            s.n_aids_lost += 1
    return n


@jit
def in_the_air(s: Any, prm: Any, t: float) -> bool:
    """Whether the rotors carry the vehicle: as they do for a while now, or as they did until a moment ago."""
    x, m = s.ft[0], s.model[0]
    if s.rotor_known == 0:
        x.t_heavy, x.t_light = t, t
        return False
    total = 0.0
    for i in range(len(s.speed)):
        total += s.speed[i] * s.speed[i]
    thrust = -m.k[2, 0] * total * density_ratio(s, prm) * STANDARD_DENSITY / m.density
    if thrust < HEAVY * s.gravity:
        x.t_heavy = t
    if thrust > LIGHT * s.gravity:
        x.t_light = t
    if x.on == 1:
        return bool(t - x.t_light < LIGHT_TIME)
    if t - x.t_light > LIGHT_TIME:
        x.ground = s.p[2]
    return bool(t - x.t_heavy > HEAVY_TIME)


@jit
def advance(s: Any, prm: Any, rows: Any, cov: Any, aids: Any, tape: Any, stage: Any) -> None:
    """Move the fusion horizon over the oldest queued IMU sample."""
    x = s.ft[0]
    m = s.imu[s.imu_head]
    t = m.t
    w1, f1 = (m.w[0], m.w[1], m.w[2]), (m.f[0], m.f[1], m.f[2])
    listen(s, t)
    n, unaligned, n_events = s.n_aids, s.n_unaligned, s.n_events
    s.n_aids = 0
    ordinary.advance(s, prm, x.nothing, x.nothing, x.heard, tape, stage)
    n_heard = s.n_aids
    for i in range(n_events, s.n_events):  # the signatures of the IMU chain's faults, steps and ramps
        e = s.event[i]
        if e.code == E_DISTURBED and e.detail == OUT_FIELD:
            x.t_compass = t
        if e.code == E_FAULT and e.detail >= 0 and e.detail < 12 and x.armed == 1:
            x.named = 1 + e.detail % 6
            if x.alarms == 0:
                x.t_first = max(e.seen, x.t_chain)
    s.n_aids = hand_over(s, aids, n)
    rotors_at(s, t)
    dt = t - x.t
    x.t = t
    flies = in_the_air(s, prm, t)
    if x.on == 1 and (not flies or dt > LONG_STEP):
        x.on = 0
    if x.on == 0 and flies and s.phase == 2:
        begin(s, prm, t)
        evaluate(s, prm)
        reseed(s, prm)
        x.n_due = 0
    elif x.on == 1:
        go_on(s, prm, t, dt, w1, f1, n_heard)
    else:
        x.n_due = 0
    if x.on == 1 or s.phase == 2:
        s.n_unaligned = unaligned
        write_row(s, rows)
        write_covariance(s, prm, cov)


@jit
def go_on(s: Any, prm: Any, t: float, dt: float, w1: Vec, f1: Vec, n_heard: int) -> None:
    """Steps 2, 3 and 5: the model's force and moment, the motion that they make, and what sensors say of it."""
    x = s.ft[0]
    move(x, (x.f[0], x.f[1], x.f[2]), (x.a[0], x.a[1], x.a[2]), s.gravity, dt, math.exp(-dt / prm.air_gust_time), math.exp(-dt / MISS_TIME))
    evaluate(s, prm)
    detect_of_the_imu(s, prm, n_heard)
    x.n += 1
    x.span += dt
    for a in range(3):
        x.by_gyro[a] += w1[a] - x.w[a]
        x.by_accel[a] += f1[a] - x.f[a] - x.bf[a]
        x.by_model[a] += x.a[a]
    if x.span < prm.fault_tolerant_step - 0.5 * dt:
        return
    k = 1.0 / x.n
    gyro = (k * x.by_gyro[0], k * x.by_gyro[1], k * x.by_gyro[2])
    accel = (k * x.by_accel[0], k * x.by_accel[1], k * x.by_accel[2])
    turned = (k * x.by_model[0], k * x.by_model[1], k * x.by_model[2])
    span = x.span
    x.n, x.span = 0, 0.0
    for a in range(3):
        x.by_gyro[a], x.by_accel[a], x.by_model[a] = 0.0, 0.0, 0.0
    lin, C, v = predict_all(s, prm, span)
    watch(s, prm, t)
    detect_inertial(s, prm, lin, C, gyro, accel, turned, span)
    detect_external(s, prm, span)
    decide(s, prm, t)
    set_axes(s, prm, t)
    fuse_inertial(s, prm, lin, C, v, gyro, accel, span)
    fuse_sensors(s, prm, C)
    x.n_due = 0
    if t >= x.t_fuse:
        x.t_fuse = max(x.t_fuse + 1.0 / prm.fault_tolerant_fuse_rate, t)
        fusion(s, prm)
        evaluate(s, prm)


@jit
def write_row(s: Any, rows: Any) -> None:
    """Append the state that is given out, and its variances."""
    i = s.n_rows
    if i >= rows.shape[0]:
        return
    ordinary.write_row(s, rows)
    x, row = s.ft[0], rows[i]
    o = 35 + 2 * (s.P.shape[0] - 15)
    row[0] = x.t
    for j in range(4):
        row[o + j] = math.nan
    if x.on == 0:
        return
    for j in range(4):
        row[1 + j] = x.q[j]
    for j in range(3):
        row[5 + j], row[8 + j], row[11 + j], row[14 + j] = x.v[j], x.p[j], x.bg[j], x.ba[j]
        row[23 + j], row[26 + j] = x.P[6 + j, 6 + j], x.P[9 + j, 9 + j]
        row[29 + j], row[32 + j] = x.P[22 + j, 22 + j], x.P[25 + j, 25 + j]
    row[17], row[18], row[19] = x.P[3, 3], x.P[3, 4], x.P[3, 5]
    row[20], row[21], row[22] = x.P[4, 4], x.P[4, 5], x.P[5, 5]
    if len(s.baro) > 0:
        row[35], row[35 + s.P.shape[0] - 15] = x.baro, x.P[28, 28]
    row[o], row[o + 1], row[o + 2], row[o + 3] = x.wind[0], x.wind[1], x.P[18, 18], x.P[19, 19]


@jit
def write_covariance(s: Any, prm: Any, cov: Any) -> None:
    """Append the blocks of the covariance that is given out, at most every ``covariance_interval``."""
    i, x = s.n_cov, s.ft[0]
    due = s.t >= s.t_covariance
    ordinary.write_covariance(s, prm, cov)
    if not due or s.n_cov == i:
        if due:
            s.t_covariance = s.t + prm.covariance_interval
        return
    if x.on == 0:
        return
    k = 1
    for b in range(5):
        for r in range(3):
            for c in range(r, 3):
                o = 3 + 3 * b if b < 3 else 13 + 3 * b  # attitude, velocity, position; biases
                cov[k, i] = x.P[o + r, o + c]
                k += 1
    cov[k, i] = x.P[28, 28]
    cov[32, i], cov[33, i], cov[35, i] = x.P[18, 18], x.P[18, 19], x.P[19, 19]


@entry
def step(S: Any, PRM: Any, t: float, gyro: Vec, accel: Vec, rows: Any, cov: Any, aids: Any, tape: Any, stage: Any) -> int:
    """Take one IMU sample, and move the horizon as far as ``horizon`` behind it; see `haltere.estimators.step.step`."""
    s, prm = S[0], PRM[0]
    status = take(s, t, gyro, accel)
    while behind(s, prm):
        advance(s, prm, rows, cov, aids, tape, stage)
    return status


@entry
def flush(S: Any, PRM: Any, rows: Any, cov: Any, aids: Any, tape: Any, stage: Any) -> None:
    """Move the horizon to the newest IMU sample: the end of a log."""
    s, prm = S[0], PRM[0]
    while s.imu_n > 0:
        advance(s, prm, rows, cov, aids, tape, stage)


@entry
def run_chunk(
    S: Any, PRM: Any, t: Any, gyro: Any, accel: Any, i: int, i_end: int, kinds: Any, stamps: Any, z: Any, r: Any, j: int, rows: Any,
    cov: Any, aids: Any, tape: Any, stage: Any, rotor_t: Any, rotor_speed: Any,
) -> tuple[int, int]:  # fmt: skip
    """Do what `offer` and `step` do over IMU samples i ... i_end - 1; see `haltere.estimators.step.run_chunk`."""
    s, prm = S[0], PRM[0]
    while s.n_aids <= len(aids) - 2048 and s.n_events <= len(s.event) - 8 and s.n_rows <= rows.shape[0] - 2 * len(s.imu):
        if behind(s, prm) or (i == len(t) and s.imu_n > 0):
            advance(s, prm, rows, cov, aids, tape, stage)
        elif i < i_end:
            while j < len(stamps) and stamps[j] <= t[i]:
                offer(S, PRM, kinds[j], stamps[j], (z[j, 0], z[j, 1], z[j, 2]), (r[j, 0], r[j, 1], r[j, 2]))
                j += 1
            while s.n_rotors < len(rotor_t) and rotor_t[s.n_rotors] <= t[i]:
                hear_rotors(s, prm, rotor_t[s.n_rotors], rotor_speed[s.n_rotors])
                s.n_rotors += 1
            take(s, t[i], (gyro[i, 0], gyro[i, 1], gyro[i, 2]), (accel[i, 0], accel[i, 1], accel[i, 2]))
            i += 1
        else:
            break
    return i, j


@entry
def now(S: Any, PRM: Any, out: Any) -> None:
    """State predicted to the newest IMU sample: by the model's force and moment held, else as `haltere.estimators.step.now`."""
    s = S[0]
    x = s.ft[0]
    if x.on == 0:
        ordinary.now(S, PRM, out)
        return
    dt = s.t_newest - x.t
    a = (x.a[0] + x.bm[0], x.a[1] + x.bm[1], x.a[2] + x.bm[2])
    turn = (dt * (x.w[0] + 0.5 * dt * a[0]), dt * (x.w[1] + 0.5 * dt * a[1]), dt * (x.w[2] + 0.5 * dt * a[2]))
    half = quat_from_rotvec((0.5 * turn[0], 0.5 * turn[1], 0.5 * turn[2]))
    q = quat_mul((x.q[0], x.q[1], x.q[2], x.q[3]), half)
    push = mat_vec(dcm(q), (x.f[0] + x.bf[0], x.f[1] + x.bf[1], x.f[2] + x.bf[2]))
    q = quat_unit(quat_mul(q, half))
    out[0] = s.t_newest
    for i in range(4):
        out[1 + i] = q[i]
    for i in range(3):
        g = push[i] + (s.gravity if i == 2 else 0.0)
        out[5 + i] = x.v[i] + dt * g
        out[8 + i] = x.p[i] + dt * (x.v[i] + 0.5 * dt * g)
