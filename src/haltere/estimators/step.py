"""The compiled step of every error-state filter here: queue, alignment, prediction, fusion, output rows. One code, online and offline."""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import entry, jit
from haltere.aids import drag, fake, first_stage, rest
from haltere.aids.air import wind_covariance, wind_n
from haltere.aids.dispatch import N_SENSORS, fuse_all
from haltere.aids.record import (
    AIRSPEED,
    ATTITUDE,
    BAROMETER,
    E_DIVERGED,
    E_GAP,
    FAKE_POSITION,
    GNSS_POSITION,
    GNSS_VELOCITY,
    MAGNETOMETER,
    NO_SENSOR,
    POWER,
    ROTORS,
    VANES,
    WIND,
    event,
)
from haltere.core.rotation import Vec, cross, dcm, mat_vec, quat_from_rotvec, quat_mul
from haltere.diagnosis import inertial, model_faults, pairs, stand_in, steps
from haltere.estimators import alignment, yaw_bank
from haltere.filter.queue import pop_imu, push, push_imu
from haltere.filter.rotors import push_rotors, rotors_at
from haltere.strapdown.optional import get_optional
from haltere.strapdown.propagate import predict, unseen

__all__ = [
    "ASSUMED",
    "COVARIANCE_ROWS",
    "LONG_STEP",
    "NODE_SPAN",
    "NODE_STEPS",
    "SUB_STEP",
    "advance",
    "begin_air",
    "bridge_push",
    "flush",
    "interval",
    "now",
    "offer",
    "offer_rotors",
    "row_width",
    "run_chunk",
    "stage_of",
    "step",
]

#: Rows of the covariance output: time, the upper triangles of the five core blocks, the variance of the barometer offset, the upper
#: triangle of the wind's covariance.
COVARIANCE_ROWS = 1 + 5 * 6 + 1 + 6
#: Longest interval [s] bridged in one step, and longest gap [s] bridged at all.
LONG_STEP, SUB_STEP = 0.12, 0.06
#: A tape for smoothing has a node after each fusion, at least after so many predictions, and about every so many seconds.
NODE_STEPS, NODE_SPAN = 64, 0.05
#: What a node says of itself: a stretch begins, it follows a prediction, or only assumptions that tell the past nothing came before it.
BEGINS, FOLLOWS, ASSUMED = 1.0, 0.0, -1.0
#: No sensor measures more [rad/s, m/s^2].
RATE_MAX, FORCE_MAX = 100.0, 500.0


def stage_of(S: Any) -> Any:
    """The first stage of a one-element array of states, an array of one record in the same memory; None where there is none."""
    return S["a"][0] if S["a"].shape[1] else None


@entry
def row_width(n: int) -> int:
    """Columns of the output rows of ``n`` error states.

    t, q 4, v 3, p 3, bg 3, ba 3; P_θθ upper triangle 6, other variances 12; optional states, their variances.
    """
    return 35 + 2 * (n - 15)


@jit
def reported_wind(s: Any, P: Any, row: Any, k: int, more: int) -> None:
    """The wind and its variances into columns k, k + ``more`` of a row, where the state is µW instead, see `haltere.aids.air`."""
    W, cov = wind_n(s), wind_covariance(s, P)
    row[k], row[k + 1] = W[0], W[1]
    row[k + more], row[k + more + 1] = cov[0], cov[3]


@jit
def write_row(s: Any, rows: Any) -> None:
    """Append the state and the variances that a solution reports."""
    i = s.n_rows
    if i >= rows.shape[0]:
        return
    P = s.P
    rows[i, 0] = s.t
    for j in range(4):
        rows[i, 1 + j] = s.q[j]
    for j in range(3):
        rows[i, 5 + j] = s.v[j]
        rows[i, 8 + j] = s.p[j]
        rows[i, 11 + j] = s.bg[j]
        rows[i, 14 + j] = s.ba[j]
        rows[i, 23 + j] = P[3 + j, 3 + j]
        rows[i, 26 + j] = P[6 + j, 6 + j]
        rows[i, 29 + j] = P[9 + j, 9 + j]
        rows[i, 32 + j] = P[12 + j, 12 + j]
    rows[i, 17] = P[0, 0]
    rows[i, 18] = P[0, 1]
    rows[i, 19] = P[0, 2]
    rows[i, 20] = P[1, 1]
    rows[i, 21] = P[1, 2]
    rows[i, 22] = P[2, 2]
    more = P.shape[0] - 15
    get_optional(s, rows[i], 35)
    for j in range(more):
        rows[i, 35 + more + j] = P[15 + j, 15 + j]
    if len(s.drag) > 0:
        reported_wind(s, P, rows[i], 35 + len(s.baro) + len(s.mag), more)
    s.n_rows = i + 1


@jit
def write_wind_covariance(s: Any, P: Any, cov: Any, i: int) -> None:
    """Covariance of the wind into column i, NaN for what is no state."""
    c = wind_covariance(s, P)
    for k in range(6):
        cov[32 + k, i] = math.nan
    if len(s.wind) > 0:
        cov[32, i], cov[33, i], cov[35, i] = c[0], c[1], c[3]
    if len(s.wind) > 2:
        cov[34, i], cov[36, i], cov[37, i] = c[2], c[4], c[5]


@jit
def write_covariance(s: Any, prm: Any, cov: Any) -> None:
    """Append the core blocks of P at most every ``covariance_interval``, for the consistency statistics."""
    i = s.n_cov
    if s.t < s.t_covariance or i >= cov.shape[1]:
        return
    s.t_covariance = s.t + prm.covariance_interval
    cov[0, i] = s.t
    k = 1
    for b in range(5):
        for r in range(3):
            for c in range(r, 3):
                cov[k, i] = s.P[3 * b + r, 3 * b + c]
                k += 1
    cov[k, i] = math.nan
    for j in range(len(s.baro)):
        cov[k, i] = s.P[15 + j, 15 + j]
    write_wind_covariance(s, s.P, cov, i)
    s.n_cov = i + 1


@jit
def write_node(s: Any, tape: Any, kind: float) -> None:
    """Append a posterior to the tape for smoothing, where there is one: see `haltere.estimators.smoother.load_node`."""
    i = s.n_nodes
    if i >= tape.shape[0]:
        return
    node = tape[i]
    node[0], node[1], node[2] = s.t, kind, s.gravity
    for j in range(4):
        node[3 + j] = s.q[j]
    for j in range(3):
        node[7 + j], node[10 + j], node[13 + j], node[16 + j] = s.v[j], s.p[j], s.bg[j], s.ba[j]
    k = 19
    get_optional(s, node, k)
    k += s.P.shape[0] - 15
    for r in range(s.P.shape[0]):
        for c in range(r, s.P.shape[0]):
            node[k] = s.P[r, c]
            k += 1
    s.n_nodes = i + 1
    s.n_since = 0


@jit
def sound(s: Any) -> bool:
    """Whether state and covariance are finite and every variance positive."""
    total = s.q[0] + s.q[1] + s.q[2] + s.q[3]
    for i in range(3):
        total += s.v[i] + s.p[i] + s.bg[i] + s.ba[i]
    if not math.isfinite(total):
        return False
    ok = True
    for i in range(s.P.shape[0]):
        ok = ok and s.P[i, i] > 0.0 and s.P[i, i] < 1e14
    for i in range(len(s.a)):
        ok = ok and first_stage.sound(s.a[i])
    return ok


@jit
def interval(s: Any, prm: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> tuple[Vec, Vec, Vec, Vec]:
    """Mean rate and force, rotation vector and velocity increment of one interval between IMU samples (w0, f0) and (w1, f1), raw.

    Samples are values at their times (then coning and sculling of a linear course are kept), or means since the one before.
    """
    bg, ba = (s.bg[0], s.bg[1], s.bg[2]), (s.ba[0], s.ba[1], s.ba[2])
    b = (w1[0] - bg[0], w1[1] - bg[1], w1[2] - bg[2])
    g = (f1[0] - ba[0], f1[1] - ba[1], f1[2] - ba[2])
    if prm.imu_mean > 0.0:
        return b, g, (b[0] * dt, b[1] * dt, b[2] * dt), (g[0] * dt, g[1] * dt, g[2] * dt)
    a = (w0[0] - bg[0], w0[1] - bg[1], w0[2] - bg[2])
    h = (f0[0] - ba[0], f0[1] - ba[1], f0[2] - ba[2])
    w = (0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2]))
    f = (0.5 * (h[0] + g[0]), 0.5 * (h[1] + g[1]), 0.5 * (h[2] + g[2]))
    k = dt * dt / 12.0
    coning = cross(a, b)
    s1, s2 = cross(a, g), cross(h, b)
    return (
        w,
        f,
        (w[0] * dt + k * coning[0], w[1] * dt + k * coning[1], w[2] * dt + k * coning[2]),
        (f[0] * dt + k * (s1[0] + s2[0]), f[1] * dt + k * (s1[1] + s2[1]), f[2] * dt + k * (s1[2] + s2[2])),
    )


@jit
def predict_interval(s: Any, prm: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> None:
    """Predict over one interval between raw IMU samples, see `interval`."""
    w, f, rotation, dv = interval(s, prm, w0, f0, w1, f1, dt)
    D, A, B = predict(s, prm, w, f, rotation, dv, dt)
    if len(s.bank) > 0:
        inertial.carry(s, D, A, B, dt)
    if prm.imu_mean == 0.0:
        unseen(s, prm, w0, f0, w1, f1, dt)


@jit
def predict_stage(s: Any, stage: Any, prm: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> None:
    """Predict the first stage, where there is one, with its own biases beside the main state.

    ``stage`` is None or the one-element array ``s.a``, an argument of its own: of what hangs on a None nothing is compiled.
    """
    if stage is not None:
        stage[0].gravity = s.gravity
        predict_interval(stage[0], prm, w0, f0, w1, f1, dt)


@jit
def bridge_push(s: Any, dt: float) -> None:
    """Admit that nobody knows what happened in ``dt`` seconds without samples."""
    turn, push_v, push_p = 0.5 * dt, 3.0 * dt, 1.5 * dt * dt
    for i in range(3):
        s.P[i, i] += turn * turn
        s.P[3 + i, 3 + i] += push_v * push_v
        s.P[6 + i, 6 + i] += push_p * push_p


@jit
def bridge_gap(s: Any, stage: Any, prm: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> None:
    """Predict across missing samples in sub-steps, and admit that nobody knows what happened meanwhile."""
    n = math.ceil(dt / SUB_STEP)
    h = dt / n
    for i in range(n):
        k0, k1 = i / n, (i + 1) / n
        wa = (w0[0] + k0 * (w1[0] - w0[0]), w0[1] + k0 * (w1[1] - w0[1]), w0[2] + k0 * (w1[2] - w0[2]))
        fa = (f0[0] + k0 * (f1[0] - f0[0]), f0[1] + k0 * (f1[1] - f0[1]), f0[2] + k0 * (f1[2] - f0[2]))
        wb = (w0[0] + k1 * (w1[0] - w0[0]), w0[1] + k1 * (w1[1] - w0[1]), w0[2] + k1 * (w1[2] - w0[2]))
        fb = (f0[0] + k1 * (f1[0] - f0[0]), f0[1] + k1 * (f1[1] - f0[1]), f0[2] + k1 * (f1[2] - f0[2]))
        predict_interval(s, prm, wa, fa, wb, fb, h)
        predict_stage(s, stage, prm, wa, fa, wb, fb, h)
    bridge_push(s, dt)
    if stage is not None:
        bridge_push(stage[0], dt)
    event(s, s.t, E_GAP, NO_SENSOR, dt)
    s.n_gaps += 1


@jit
def advance(s: Any, prm: Any, rows: Any, cov: Any, aids: Any, tape: Any, stage: Any) -> None:
    """Move the fusion horizon over the oldest queued IMU sample."""
    m = s.imu[s.imu_head]
    t = m.t
    w1, f1 = (m.w[0], m.w[1], m.w[2]), (m.f[0], m.f[1], m.f[2])
    pop_imu(s)
    if len(s.model) > 0:
        rotors_at(s, t)
    w0, f0 = (s.w_raw[0], s.w_raw[1], s.w_raw[2]), (s.f_raw[0], s.f_raw[1], s.f_raw[2])
    s.w_raw[0], s.w_raw[1], s.w_raw[2] = w1
    s.f_raw[0], s.f_raw[1], s.f_raw[2] = f1
    s.n_steps += 1
    if s.phase == 0:
        alignment.begin(s, t)
        s.n_unaligned += 1
        return
    dt = t - s.t
    if s.n_steps == 1:  # begun from a given state: its first sample only begins the first interval
        s.t = t
        write_row(s, rows)
        write_covariance(s, prm, cov)
        write_node(s, tape, BEGINS)
        return
    if dt > prm.timeout_imu:  # too long to bridge: align anew
        event(s, t, E_GAP, NO_SENSOR, dt)
        s.n_gaps += 1
        alignment.begin(s, t)
        s.n_unaligned += 1
        return
    s.t = t
    rest.monitor(s, prm, t, w1, f1)
    w_raw, f_raw = w1, f1
    if s.phase == 1:
        if prm.imu_mean > 0.0:
            alignment.gather(s, prm, (w1[0] * dt, w1[1] * dt, w1[2] * dt), (f1[0] * dt, f1[1] * dt, f1[2] * dt), dt)
        else:
            k = 0.5 * dt
            alignment.gather(
                s,
                prm,
                (k * (w0[0] + w1[0]), k * (w0[1] + w1[1]), k * (w0[2] + w1[2])),
                (k * (f0[0] + f1[0]), k * (f0[1] + f1[1]), k * (f0[2] + f1[2])),
                dt,
            )
        if s.phase == 1:
            s.n_unaligned += 1
            return
        s.t_covariance = t
        node, kind = True, BEGINS
    else:
        node, kind = dt > LONG_STEP or t >= s.t_wake or s.n_since >= NODE_STEPS - 1 or s.n_since * dt >= NODE_SPAN, FOLLOWS
        s.n_since += 1
        if len(s.pairs) > 0:
            w0, f0, w1, f1 = stand_in.stand_in(s, prm, w0, f0, w1, f1, dt)
            s.w_raw[0], s.w_raw[1], s.w_raw[2] = w1
            s.f_raw[0], s.f_raw[1], s.f_raw[2] = f1
            if pairs.gather(s, prm, w_raw, f_raw, dt):
                model_faults.hear(s, prm)
        north, east = s.v[0], s.v[1]
        if dt > LONG_STEP:
            bridge_gap(s, stage, prm, w0, f0, w1, f1, dt)
        else:
            predict_interval(s, prm, w0, f0, w1, f1, dt)
            predict_stage(s, stage, prm, w0, f0, w1, f1, dt)
        if len(s.pairs) > 0 and stand_in.stands(s):
            stand_in.couple(s, prm, dt)
        s.yaw.dv[0] += s.v[0] - north
        s.yaw.dv[1] += s.v[1] - east
        if len(s.drag) > 0:
            if len(s.pairs) > 0 and stand_in.across(s):
                s.air.dt = 0.0  # no drag is measured
            else:
                drag.gather(s, f1, dt)
        if t >= s.t_wake:
            for part in range(2):  # what is measured, then what is assumed; one call, since with a second one it is compiled twice
                if part == 1 and fake.blind_to_heading(s, prm):
                    write_node(s, tape, FOLLOWS)
                    kind = ASSUMED
                fuse_all(s, prm, aids, dt, w1, f1, FAKE_POSITION * part, FAKE_POSITION + (N_SENSORS - FAKE_POSITION) * part, stage)
                if s.yaw.fresh == 1:
                    s.yaw.fresh = 0
                    if prm.aid_yaw_bank > 0.0:
                        yaw_bank.update(s, s.yaw.z[0], s.yaw.z[1], s.yaw.r)
        if len(s.bank) > 0:
            found = steps.watch(s, prm, t, dt, w_raw, f_raw)
            if inertial.tick(s, prm, dt) or found:  # what was before is smoothed by itself
                node, kind = True, BEGINS
    if t >= s.t_covariance and not sound(s):
        event(s, t, E_DIVERGED, NO_SENSOR, 0.0)
        alignment.begin(s, t)
        s.n_unaligned += 1
        return
    write_row(s, rows)
    write_covariance(s, prm, cov)
    if node:
        write_node(s, tape, kind)


@jit
def take(s: Any, t: float, gyro: Vec, accel: Vec) -> int:
    """Queue an IMU sample, or refuse and count it; see `step` for what comes back."""
    if not (math.isfinite(t) and math.isfinite(gyro[0] + gyro[1] + gyro[2] + accel[0] + accel[1] + accel[2])):
        s.n_bad += 1
        return 1
    if s.n_steps + s.imu_n > 0 and t <= s.t_newest:
        s.n_bad += 1
        return 2
    if max(abs(gyro[0]), abs(gyro[1]), abs(gyro[2])) > RATE_MAX or max(abs(accel[0]), abs(accel[1]), abs(accel[2])) > FORCE_MAX:
        s.n_bad += 1
        return 3
    push_imu(s, t, gyro, accel)
    s.t_newest = t
    return 0


@jit
def behind(s: Any, prm: Any) -> bool:
    """Whether the horizon is to move: the oldest queued IMU sample is old enough, or there is no room for the next one (counted)."""
    if s.imu_n == 0:
        return False
    if s.imu[s.imu_head].t <= s.t_newest - prm.horizon:
        return True
    if s.imu_n < len(s.imu):
        return False
    s.n_ring_full += 1  # the horizon comes closer than configured
    return True


@entry
def step(S: Any, PRM: Any, t: float, gyro: Vec, accel: Vec, rows: Any, cov: Any, aids: Any, tape: Any, stage: Any) -> int:
    """Take one IMU sample, and move the horizon as far as ``horizon`` behind it.

    Parameters
    ----------
    S, PRM
        One-element arrays of the state and parameter records.
    t
        Time stamp [s].
    gyro, accel
        Angular rate [rad/s] and specific force [m/s^2], body frame.
    rows, cov, aids, tape
        Output arrays; their fill is counted in the state. Arrays without room are left alone.
    stage
        The first stage, see `stage_of`.

    Returns
    -------
    int
        0 taken; 1 not finite; 2 not after the sample before; 3 beyond any sensor. All but 0 are counted and left out.
    """
    s, prm = S[0], PRM[0]
    status = take(s, t, gyro, accel)
    while behind(s, prm):
        advance(s, prm, rows, cov, aids, tape, stage)
    return status


@entry
def begin_air(S: Any, PRM: Any) -> None:
    """Wind and coefficients of the air as configured, for a state that was not aligned."""
    s = S[0]
    if len(s.wind) > 0:
        alignment.start_air(s, PRM[0], 15 + len(s.baro) + len(s.mag))


@entry
def flush(S: Any, PRM: Any, rows: Any, cov: Any, aids: Any, tape: Any, stage: Any) -> None:
    """Move the horizon to the newest IMU sample: the end of a log."""
    s, prm = S[0], PRM[0]
    while s.imu_n > 0:
        advance(s, prm, rows, cov, aids, tape, stage)


@entry
def offer(S: Any, PRM: Any, kind: int, t: float, z: Vec, r: Vec) -> int:
    """Queue a measurement stamped t by the time it was valid; see `filter.queue.push` for what comes back, 2 when switched off."""
    s, prm = S[0], PRM[0]
    delay, on = 0.0, 1.0
    if kind == GNSS_VELOCITY:
        delay, on = prm.delay_gnss_velocity, prm.aid_gnss
    elif kind == GNSS_POSITION:
        delay, on = prm.delay_gnss_position, prm.aid_gnss
    elif kind == BAROMETER:
        delay, on = prm.delay_barometer, prm.aid_barometer
    elif kind == MAGNETOMETER:
        delay, on = prm.delay_magnetometer, prm.aid_magnetometer
    elif kind == POWER:
        delay, on = prm.delay_power, prm.aid_motor_field
    elif kind == ROTORS:
        delay, on = prm.delay_rotors, 1.0 if prm.aid_drag == 1.0 else 0.0
    elif kind in (AIRSPEED, VANES):
        delay, on = prm.delay_airdata, 1.0 if prm.aid_airdata == 1.0 else 0.0
    elif kind == WIND:
        delay, on = prm.delay_wind, prm.aid_wind
    elif kind == ATTITUDE:
        delay, on = prm.delay_attitude, prm.aid_attitude
    if on == 0.0:
        return 2
    return push(s, kind, t - delay, z, r)


@jit
def hear_rotors(s: Any, prm: Any, t: float, speeds: Any) -> int:
    """Queue the speeds of all rotors by the time they were valid, where there is a vehicle's model to hear them."""
    if len(s.model) == 0:
        return 2
    return push_rotors(s, t - prm.delay_rotors - s.model[0].lag, speeds)


@entry
def offer_rotors(S: Any, PRM: Any, t: float, speeds: Any) -> int:
    """Queue the speeds (n,) [rad/s] of all rotors stamped t; 1 queued, 0 refused and counted, 2 no model hears them."""
    return hear_rotors(S[0], PRM[0], t, speeds)


@entry
def run_chunk(
    S: Any,
    PRM: Any,
    t: Any,
    gyro: Any,
    accel: Any,
    i: int,
    i_end: int,
    kinds: Any,
    stamps: Any,
    z: Any,
    r: Any,
    j: int,
    rows: Any,
    cov: Any,
    aids: Any,
    tape: Any,
    stage: Any,
    rotor_t: Any,
    rotor_speed: Any,
) -> tuple[int, int]:
    """Do what `offer` and `step` do, over IMU samples i ... i_end - 1 and the measurements stamped at or before them.

    After the last sample of all, the horizon moves up to it, as `flush` does. Stops early when the output arrays are nearly
    full, so that nothing is lost. The same calls in the same order online give the same numbers.

    Parameters
    ----------
    t, gyro, accel
        IMU columns, shapes (n,), (n, 3), (n, 3).
    kinds, stamps, z, r
        Measurements in order of their stamps: sensor codes (m,), stamps (m,), values and variances (m, 3).
    j
        Next measurement.
    rotor_t, rotor_speed
        Stamps (k,) and speeds (k, rotors) for a vehicle's model; how many were taken is counted in the state.

    Returns
    -------
    tuple of int
        Next IMU sample and next measurement.
    """
    s, prm = S[0], PRM[0]
    room = 4 * len(s.imu)
    while (
        s.n_aids <= len(aids) - 2048
        and s.n_events <= len(s.event) - 8
        and s.n_rows <= rows.shape[0] - 2 * len(s.imu)
        and (tape.shape[0] == 0 or s.n_nodes <= tape.shape[0] - room)
    ):
        if behind(s, prm) or (i == len(t) and s.imu_n > 0):  # the one call of `advance` here: with a second one it is compiled twice
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
    """State predicted to the newest IMU sample by repeating the queued increments: t, q, v, p into ``out`` (11)."""
    s, prm = S[0], PRM[0]
    q = (s.q[0], s.q[1], s.q[2], s.q[3])
    v, p = (s.v[0], s.v[1], s.v[2]), (s.p[0], s.p[1], s.p[2])
    t = s.t
    w0, f0 = (s.w_raw[0], s.w_raw[1], s.w_raw[2]), (s.f_raw[0], s.f_raw[1], s.f_raw[2])
    for i in range(s.imu_n):
        m = s.imu[(s.imu_head + i) % len(s.imu)]
        w1, f1 = (m.w[0], m.w[1], m.w[2]), (m.f[0], m.f[1], m.f[2])
        if len(s.pairs) > 0:
            w1, f1 = stand_in.hold(s, w0, f0, w1, f1)
        dt = m.t - t
        k = 1.0 if prm.imu_mean > 0.0 else 0.5
        w = (
            (k * w1[0] + (1.0 - k) * w0[0] - s.bg[0]) * dt,
            (k * w1[1] + (1.0 - k) * w0[1] - s.bg[1]) * dt,
            (k * w1[2] + (1.0 - k) * w0[2] - s.bg[2]) * dt,
        )
        f = (
            (k * f1[0] + (1.0 - k) * f0[0] - s.ba[0]) * dt,
            (k * f1[1] + (1.0 - k) * f0[1] - s.ba[1]) * dt,
            (k * f1[2] + (1.0 - k) * f0[2] - s.ba[2]) * dt,
        )
        half = quat_from_rotvec((0.5 * w[0], 0.5 * w[1], 0.5 * w[2]))
        q = quat_mul(q, half)
        a = mat_vec(dcm(q), f)
        q = quat_mul(q, half)
        a = (a[0], a[1], a[2] + s.gravity * dt)
        p = (p[0] + dt * (v[0] + 0.5 * a[0]), p[1] + dt * (v[1] + 0.5 * a[1]), p[2] + dt * (v[2] + 0.5 * a[2]))
        v = (v[0] + a[0], v[1] + a[1], v[2] + a[2])
        w0, f0, t = w1, f1, m.t
    out[0] = t
    for i in range(4):
        out[1 + i] = q[i]
    for i in range(3):
        out[5 + i] = v[i]
        out[8 + i] = p[i]
