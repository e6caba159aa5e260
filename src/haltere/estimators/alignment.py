"""Initial alignment from the data: at rest or in motion, on the ground or in the air, with or without compass and GNSS.

It gathers at the fusion horizon, sample by sample, in the state record itself, so that online and offline are one code and a
saved state may be in the middle of it (theory-amendments.md §8).
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids import compass, drag, first_stage, interference, rest
from haltere.aids.fusing import DISTRUSTED, RUNNING
from haltere.aids.gnss import position_observation, position_variance, velocity_variance
from haltere.aids.magnetometer import learn_field
from haltere.aids.record import (
    ATTITUDE,
    BAROMETER,
    E_ALIGNED,
    E_REALIGNED,
    GNSS_POSITION,
    GNSS_VELOCITY,
    MAGNETOMETER,
    N_QUEUED,
    NO_SENSOR,
    POWER,
    ROTORS,
    event,
)
from haltere.core.rotation import (
    Vec,
    cross,
    dcm,
    dot,
    euler,
    mat_vec,
    norm,
    quat_from_euler,
    quat_from_rotvec,
    quat_mul,
    quat_unit,
    scale,
    tmat_vec,
    triad,
    wrap,
)
from haltere.estimators import yaw_bank
from haltere.estimators.beside import begin_anew
from haltere.filter.queue import pop_due

__all__ = ["AT_REST", "GIVEN", "GRAVITY_ONLY", "IN_MOTION", "begin", "gather", "level_and_compass", "start_air"]

AT_REST, IN_MOTION, GRAVITY_ONLY, TWO_SPANS, GIVEN = (constant(i) for i in (1, 2, 3, 4, 5))
#: Longest wait [s] for a compass at rest, and for GNSS or rest before gravity alone must do.
WAIT_COMPASS, WAIT_GRAVITY = 2.0, 5.0
#: How long an attitude told from outside is that of now [s].
WAIT_GIVEN = 0.3
#: Without a compass an acceleration turns into tilt with the unknown yaw: wait for one below this [m/s^2], but no longer than [s].
GENTLE, WAIT_GENTLE = 2.0, 20.0
#: Two spans whose specific forces differ in direction (sine) give yaw too, when they are no further apart than this [s].
SPREAD, REF_MAX, YAW_TWO_SPANS = 0.25, 8.0, math.radians(15.0)
#: Length of the span [s] over which motion is compared, and after which it is given up.
SPAN, SPAN_MAX = 1.0, 3.0


@jit
def open_span(s: Any, t: float) -> None:
    """Begin to integrate rotation, specific force and field from here."""
    a = s.align
    ref = tmat_vec(dcm((a.q[0], a.q[1], a.q[2], a.q[3])), (a.ref_f_b[0], a.ref_f_b[1], a.ref_f_b[2]))
    a.ref_f_b[0], a.ref_f_b[1], a.ref_f_b[2] = ref
    a.open, a.t_span, a.n_m = 1, t, 0.0
    a.q[0], a.q[1], a.q[2], a.q[3] = 1.0, 0.0, 0.0, 0.0
    for i in range(3):
        a.f[i], a.m[i], a.v[i] = 0.0, 0.0, a.gnss_v[i]


@jit
def begin(s: Any, t: float) -> None:
    """Forget what was gathered; the filter aligns anew."""
    a = s.align
    s.t = t
    s.phase = 1
    a.t_given = -1e9
    a.t_first, a.t_gnss_v, a.t_gnss_p, a.t_baro, a.n_baro, a.open = t, -1e9, -1e9, -1e9, 0.0, 0
    a.t_ref = -1e9
    a.q[0], a.q[1], a.q[2], a.q[3] = 1.0, 0.0, 0.0, 0.0
    for i in range(3):
        a.gnss_v[i] = 0.0
    for k in range(len(s.aid)):
        s.aid[k].started = 0
        s.aid[k].t_due = t
        s.aid[k].t_passed = t
    rest.forget(s)
    yaw_bank.forget(s)
    compass.forget(s)
    s.compass.known = 0
    interference.forget(s)
    s.rest.moved = 0
    open_span(s, t)


@jit
def take_due(s: Any, prm: Any) -> bool:
    """Take the measurements valid by now into the gathering; True when a GNSS velocity was among them."""
    a = s.align
    fresh = False
    for kind in range(N_QUEUED):
        i = pop_due(s, kind, s.t)
        while i >= 0:
            m = s.ring[kind, i]
            s.aid[kind].t_offered = m.t
            if kind == GNSS_VELOCITY:
                if m.z[0] == m.z[0] and m.z[1] == m.z[1]:
                    r = velocity_variance(prm, m.r)
                    for j in range(3):
                        known = m.z[j] == m.z[j]
                        a.gnss_v[j] = m.z[j] if known else 0.0
                        a.gnss_v_sd[j] = math.sqrt(r[j]) if known else 5.0
                    a.t_gnss_v = m.t
                    fresh = True
            elif kind == GNSS_POSITION:
                z = position_observation(s, prm, m.z)
                if z[0] == z[0] and z[2] == z[2]:
                    r = position_variance(prm, m.r)
                    for j in range(3):
                        a.gnss_p[j], a.gnss_p_sd[j] = z[j], math.sqrt(r[j])
                    a.t_gnss_p = m.t
            elif kind == BAROMETER:
                a.baro, a.t_baro = m.z[0], m.t
                a.n_baro += 1.0
            elif kind == POWER:
                interference.hear(s, m.t, m.z[0])
            elif kind == ROTORS:
                drag.hear(s, m.t, m.z[0])
            elif kind == ATTITUDE:
                a.given[0], a.given[1], a.given[2], a.given[3] = quat_from_rotvec((m.z[0], m.z[1], m.z[2]))
                a.t_given = m.t
            elif kind == MAGNETOMETER:
                mu = mat_vec(dcm((a.q[0], a.q[1], a.q[2], a.q[3])), (m.z[0], m.z[1], m.z[2]))
                a.n_m += 1.0
                for j in range(3):
                    a.m[j] += mu[j]
            i = pop_due(s, kind, s.t)
    return fresh


@jit
def level_and_compass(s: Any, prm: Any, f_b: Vec, a_n: Vec, m_b: Vec, has_m: bool) -> tuple[float, float, float, float, bool]:
    """Attitude from specific force and, where it is there, the field: q_nb and whether the compass passed its tests.

    Parameters
    ----------
    f_b
        Mean specific force in the body frame [m/s^2].
    a_n
        Acceleration of the same span in NED [m/s^2], zero at rest.
    m_b
        Mean field in the body frame [uT].
    has_m
        Is there a field?
    """
    f_n = (a_n[0], a_n[1], a_n[2] - s.gravity)
    # level first, with an arbitrary yaw: e1 takes the place of the field where that is along gravity
    reference_b = (1.0, 0.0, 0.0) if abs(f_b[0]) < 0.9 * norm(f_b) else (0.0, 1.0, 0.0)
    q = triad(f_n, (1.0, 0.0, 0.0), f_b, reference_b)
    roll, pitch, _ = euler(q)
    moves = norm(a_n) > 1e-9
    if not moves:
        q = quat_from_euler(roll, pitch, 0.0)
    passed = False
    if has_m and norm(m_b) > 0.0 and not (s.has_field == 0 and moves):  # an unknown field is learnt where f is vertical only
        mu = mat_vec(dcm(q), m_b)
        along = dot(mu, f_n) / norm(f_n)
        across = math.sqrt(max(0.0, dot(mu, mu) - along * along))
        if s.has_field == 0:
            learn_field(s, (across, 0.0, -along), s.field[0])
        d, i = s.field[0], s.field[1]
        h = (math.cos(i) * math.cos(d), math.cos(i) * math.sin(d), math.sin(i))
        # the angle between field and specific force is the same in both frames, whatever the attitude; at rest it is the dip
        h_along = dot(h, f_n) / norm(f_n)
        expected = math.atan2(-h_along, math.sqrt(max(0.0, 1.0 - h_along * h_along)))
        passed = (
            abs(norm(m_b) / s.field[2] - 1.0) < prm.field_tolerance_strength
            and abs(math.atan2(-along, across) - expected) < prm.field_tolerance_dip
            and across > 0.2 * s.field[2] * math.cos(expected)
        )
        if not moves:
            q = quat_from_euler(roll, pitch, wrap(d - math.atan2(mu[1], mu[0])))
        elif across > 0.0:
            q = triad(f_n, h, f_b, m_b)
    return q[0], q[1], q[2], q[3], passed


@jit
def start_air(s: Any, prm: Any, o: int) -> None:
    """No wind, as far as is known, and the coefficients as they are told; ``o`` is the wind's first error state."""
    P, scale = s.P, 1.0
    for i in range(len(s.drag)):
        k = o + len(s.wind) + i
        sd = prm.drag_mu_sd if i == 0 else (prm.drag_c_sd if i == 1 else prm.drag_offset_sd)
        s.drag[i] = math.log(prm.drag_mu) if i == 0 else (math.log(prm.drag_c) if i == 1 else 0.0)
        P[k, k] = sd * sd
        scale = prm.drag_mu
    for i in range(len(s.wind)):
        gust = scale * prm.air_gust
        s.wind[i] = 0.0
        P[o + i, o + i] = gust * gust if i < 2 else 0.25 * gust * gust
    for i in range(len(s.steady)):  # all that is known of the wind before any is felt is known of its mean
        k, sd = o + len(s.wind) + len(s.drag) + i, scale * prm.init_wind
        s.steady[i] = 0.0
        P[k, k] = sd * sd
        P[o + i, o + i] += sd * sd
        P[o + i, k], P[k, o + i] = sd * sd, sd * sd
    for i in range(len(s.vane)):
        k = o + len(s.wind) + len(s.drag) + len(s.steady) + i
        sd = prm.init_airspeed_scale if i == 0 else prm.init_vane
        s.vane[i] = 0.0
        P[k, k] = sd * sd
    drag.forget(s)


@jit
def start(s: Any, prm: Any, kind: int, f_b: Vec, a_n: Vec) -> None:
    """Set nominal state and P0, and let the filter run (theory-amendments.md §8, P0)."""
    a = s.align
    Cs = dcm((a.q[0], a.q[1], a.q[2], a.q[3]))
    has_m = a.n_m > 0.0 and prm.aid_magnetometer > 0.0
    k = 1.0 / max(a.n_m, 1.0)
    m_b = tmat_vec(Cs, (k * a.m[0], k * a.m[1], k * a.m[2]))
    q0, q1, q2, q3, passed = level_and_compass(s, prm, f_b, a_n, m_b, has_m)
    if kind == TWO_SPANS:
        ref_b = tmat_vec(Cs, (a.ref_f_b[0], a.ref_f_b[1], a.ref_f_b[2]))
        ref_n = (a.ref_f_n[0], a.ref_f_n[1], a.ref_f_n[2])
        q0, q1, q2, q3 = triad((a_n[0], a_n[1], a_n[2] - s.gravity), ref_n, f_b, ref_b)
    s.q[0], s.q[1], s.q[2], s.q[3] = q0, q1, q2, q3
    P = s.P
    n = s.P.shape[0]
    for i in range(n):
        s.dx[i] = 0.0
        for j in range(n):
            P[i, j] = 0.0
    given = s.t - a.t_given < WAIT_GIVEN
    if given:
        q0, q1, q2, q3 = a.given[0], a.given[1], a.given[2], a.given[3]
        s.q[0], s.q[1], s.q[2], s.q[3] = q0, q1, q2, q3
    known = passed or given or kind == TWO_SPANS
    d = dcm((q0, q1, q2, q3))[2]
    if not known:  # without a compass the turn about the specific force is unknown; at rest that is the vertical
        d = scale(f_b, 1.0 / norm(f_b))
    tilt = prm.init_tilt_rest if kind == AT_REST else prm.init_tilt_motion
    from_bias = prm.init_accel_bias / s.gravity
    yaw = prm.init_yaw_compass if passed else (YAW_TWO_SPANS if known else prm.init_yaw_unknown)
    if given:
        tilt, from_bias, yaw = 2.0 * prm.noise_attitude, 0.0, 2.0 * prm.noise_attitude_yaw
    tilt2, yaw2 = tilt * tilt + from_bias * from_bias, yaw * yaw
    for i in range(3):
        for j in range(3):
            P[i, j] = (yaw2 - tilt2) * d[i] * d[j]
        P[i, i] += tilt2
    recent_v = s.t - a.t_gnss_v < 2.0
    recent_p = s.t - a.t_gnss_p < 2.0
    for i in range(3):
        s.v[i] = a.gnss_v[i] if recent_v and kind != AT_REST else 0.0
        sd_v = prm.init_velocity if kind == AT_REST else (max(prm.init_velocity, a.gnss_v_sd[i]) if recent_v else 5.0)
        P[3 + i, 3 + i] = sd_v * sd_v
        if recent_p:
            s.p[i] = a.gnss_p[i]
        else:
            s.p[i] = 0.0
        s.anchor[i] = s.p[i]
        sd_p = a.gnss_p_sd[i] if recent_p else prm.noise_fake_position
        P[6 + i, 6 + i] = sd_p * sd_p
        s.bg[i] = s.rest.mean_w[i] if kind == AT_REST else 0.0
        sd_bg = prm.init_gyro_bias_rest if kind == AT_REST else prm.init_gyro_bias
        P[9 + i, 9 + i] = sd_bg * sd_bg
        s.ba[i] = 0.0
        P[12 + i, 12 + i] = prm.init_accel_bias * prm.init_accel_bias
    s.baro_start = a.baro - s.origin[2] + s.p[2]
    for i in range(len(s.baro)):
        s.baro[i] = s.baro_start
        P[15 + i, 15 + i] = prm.init_baro_bias * prm.init_baro_bias
    o = 15 + len(s.baro)
    for i in range(len(s.mag)):
        s.mag[i] = 0.0
        P[o + i, o + i] = prm.init_mag_offset * prm.init_mag_offset
    start_air(s, prm, o + len(s.mag))
    begin_anew(s)
    for k2 in range(len(s.aid)):
        s.aid[k2].t_passed = s.t
        s.aid[k2].t_due = s.t
    s.aid[GNSS_VELOCITY].started = 1 if recent_v else 0
    s.aid[GNSS_POSITION].started = 1 if recent_p else 0
    s.aid[BAROMETER].started = 1 if s.t - a.t_baro < 2.0 else 0
    s.aid[MAGNETOMETER].started = RUNNING if passed else (DISTRUSTED if has_m and s.has_field == 1 else 0)
    first_stage.begin(s)
    a.kind = kind
    s.phase = 2
    s.t_aligned = s.t
    s.t_wake = s.t
    event(s, s.t, E_ALIGNED if s.n_aligned == 0 else E_REALIGNED, NO_SENSOR, float(kind))
    s.n_aligned += 1


@jit
def gather(s: Any, prm: Any, rotation: Vec, dv: Vec, dt: float) -> None:
    """One IMU interval that ends at ``s.t``: gather, and start when the conditions hold.

    Parameters
    ----------
    s, prm
        State and parameter records.
    rotation, dv
        Rotation vector [rad] and velocity increment in the middle body frame [m/s] of the interval, as measured.
    dt
        Interval [s].
    """
    a = s.align
    half = quat_from_rotvec((0.5 * rotation[0], 0.5 * rotation[1], 0.5 * rotation[2]))
    q_mid = quat_mul((a.q[0], a.q[1], a.q[2], a.q[3]), half)
    df = mat_vec(dcm(q_mid), dv)
    q = quat_unit(quat_mul(q_mid, half))
    a.q[0], a.q[1], a.q[2], a.q[3] = q
    for i in range(3):
        a.f[i] += df[i]
    fresh = take_due(s, prm)

    gnss_speed = norm((a.gnss_v[0], a.gnss_v[1], a.gnss_v[2]))
    gnss_recent = s.t - a.t_gnss_v < 2.0
    judged = s.rest.filled >= 4
    waited = s.t - a.t_first
    # at rest: the last second is still, GNSS does not contradict, and the compass had time to speak
    compass_there = prm.aid_magnetometer == 0.0 or a.n_m > 0.0 or waited > WAIT_COMPASS
    at_rest = s.rest.still == 1 and not (gnss_recent and gnss_speed > 0.5 + 2.0 * a.gnss_v_sd[0])
    if at_rest and compass_there:
        start(s, prm, AT_REST, (s.rest.mean_f[0], s.rest.mean_f[1], s.rest.mean_f[2]), (0.0, 0.0, 0.0))
        return
    if s.t - a.t_given < WAIT_GIVEN and not at_rest and (gnss_recent or waited > WAIT_COMPASS):
        f_b = tmat_vec(dcm(q), (a.f[0], a.f[1], a.f[2]))
        start(s, prm, GIVEN, f_b if norm(f_b) > 0.0 else (0.0, 0.0, -1.0), (0.0, 0.0, 0.0))
        return
    if not judged:
        return
    span = s.t - a.t_span
    if fresh and span >= SPAN and span <= SPAN_MAX and not at_rest:
        k = 1.0 / span
        f_b = tmat_vec(dcm(q), (k * a.f[0], k * a.f[1], k * a.f[2]))
        a_n = (k * (a.gnss_v[0] - a.v[0]), k * (a.gnss_v[1] - a.v[1]), k * (a.gnss_v[2] - a.v[2]))
        gentle = (a.n_m > 0.0 and s.has_field == 1) or norm(a_n) < GENTLE or waited > WAIT_GENTLE
        if a.open == 2 and norm(f_b) > 0.3 * s.gravity and compass_there and gentle:
            start(s, prm, IN_MOTION, f_b, a_n)
            return
        if a.open == 2 and compass_there:
            f_n = (a_n[0], a_n[1], a_n[2] - s.gravity)
            ref_n = (a.ref_f_n[0], a.ref_f_n[1], a.ref_f_n[2])
            if s.t - a.t_ref < REF_MAX and norm(cross(f_n, ref_n)) > SPREAD * norm(f_n) * norm(ref_n):
                start(s, prm, TWO_SPANS, f_b, a_n)
                return
            if s.t - a.t_ref > 0.5 * REF_MAX:
                now_b = mat_vec(dcm(q), f_b)
                for i in range(3):
                    a.ref_f_b[i], a.ref_f_n[i] = now_b[i], f_n[i]
                a.t_ref = s.t
        open_span(s, s.t)
        a.open = 2
    elif fresh and a.open == 1:  # a span for motion begins at a GNSS velocity
        open_span(s, s.t)
        a.open = 2
    elif not gnss_recent and waited > WAIT_GRAVITY and span > SPAN:
        k = 1.0 / span
        f_b = tmat_vec(dcm(q), (k * a.f[0], k * a.f[1], k * a.f[2]))
        if norm(f_b) > 0.3 * s.gravity:
            start(s, prm, GRAVITY_ONLY, f_b, (0.0, 0.0, 0.0))
            return
        open_span(s, s.t)
    elif span > SPAN_MAX:
        open_span(s, s.t)
