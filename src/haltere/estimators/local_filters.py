"""The federated filter of `fault-tolerant`: prediction by the vehicle's model, and a local filter for each sensor.

Step 5 of source F (theory.md §5.3, §5.6; theory-amendments.md 1, 2, 4). All are about one nominal state, driven by rotor speeds alone; what
a sensor shows beyond it is heard by its local filter, and the fusion moves the nominal state. The detection filters are elsewhere.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids import gnss
from haltere.aids.drag import density_ratio
from haltere.aids.magnetometer import heading_row
from haltere.aids.record import BAROMETER, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER
from haltere.core.earth import STANDARD_DENSITY
from haltere.core.rotation import Mat, Vec, cross, dcm, mat_vec, mul_mat, quat_from_rotvec, quat_mul, quat_unit, wrap
from haltere.estimators.federated_layout import LF_ACCEL, LF_BARO, LF_GNSS, LF_GYRO, LF_MAG, LOCAL_FILTERS
from haltere.filter.federated import add_information, fused, keep_apart, share_out
from haltere.filter.update import NONE, apply, column_of, innovation, project, variance
from haltere.strapdown.dynamics import (
    ACCEL_BIAS,
    ATTITUDE,
    BARO_OFFSET,
    FORCE,
    GYRO_BIAS,
    PLACE,
    RATE,
    SPEED,
    STATES,
    WIND,
    air_velocity,
    carry,
    carry_vector,
    cross_matrix,
    transition,
    transpose,
)
from haltere.vehicle.linear import Linear, linear
from haltere.vehicle.regressors import model

__all__ = [
    "add_noise", "compass_row", "evaluate", "fuse_inertial", "fuse_sensors", "fusion", "gust", "left_over", "linear_at", "miss",
    "predict_all", "scalar", "set_shares", "swing_noise", "unit",
]  # fmt: skip

#: How long what the model misses of force and moment lasts [s], and least 1 sigma of it [m/s^2, rad/s^2].
MISS_TIME = 1.0
#: Of what identification left, at least this part is the model's.
LEAST_LEFT = 0.1
#: What an angular acceleration is off by, as a part of it.
RELATIVE = 0.3
#: Shares of the fused information, over those that have any.
SHARES = (0.5, 0.4, 0.034, 0.033, 0.033)
#: Spectral density of a wind that is no state, for its variance not to vanish [m^2/s^3].
STILL = 1e-9
FORCE_LEAST, MOMENT_LEAST = 0.05, 0.05
#: An isolated axis of the model is left to the sensors: 1 sigma of what it may miss [m/s^2, rad/s^2].
FORCE_FREE, MOMENT_FREE = 5.0, 30.0
#: So is all of it that a sensor can tell below this height over where it stood [m]: what the ground does, no model here knows.
LOW = 1.0


@jit
def set_shares(x: Any) -> None:
    """Shares β of the local filters: `SHARES` over those that hear anything, over all where none does."""
    total = 0.0
    for k in range(LOCAL_FILTERS):
        total += SHARES[k] if x.lf[k].axes != 0 else 0.0
    for k in range(LOCAL_FILTERS):
        f = x.lf[k]
        if total > 0.0:
            f.share = SHARES[k] / total if f.axes != 0 else 0.0
        else:
            f.share = SHARES[k]


@jit
def unit(a: int) -> Vec:
    """Unit vector along axis a."""
    return (1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 1.0 if a == 2 else 0.0)


@jit
def linear_at(s: Any, prm: Any, x: Any) -> tuple[Linear, Mat, Vec]:
    """Model with its derivatives at a nominal state, C_nb and the velocity through the air there."""
    C = dcm((x.q[0], x.q[1], x.q[2], x.q[3]))
    v = air_velocity(C, (x.v[0], x.v[1], x.v[2]), x.wind[0], x.wind[1])
    m, w = s.model[0], (x.w[0], x.w[1], x.w[2])
    f = s.ft[0]
    eta = (f.a[0] + f.bm[0], f.a[1] + f.bm[1], f.a[2] + f.bm[2]) if m.literal == 1 else w
    ratio = density_ratio(s, prm) * STANDARD_DENSITY / m.density
    return linear(m, s.speed, s.spin_up, v, w, eta, ratio), C, v


@jit
def evaluate(s: Any, prm: Any) -> None:
    """Force and angular acceleration of the model at the fused state, into ``f`` and ``a``."""
    x = s.ft[0]
    C = dcm((x.q[0], x.q[1], x.q[2], x.q[3]))
    v = air_velocity(C, (x.v[0], x.v[1], x.v[2]), x.wind[0], x.wind[1])
    m, w = s.model[0], (x.w[0], x.w[1], x.w[2])
    eta = (x.a[0] + x.bm[0], x.a[1] + x.bm[1], x.a[2] + x.bm[2]) if m.literal == 1 else w
    ratio = density_ratio(s, prm) * STANDARD_DENSITY / m.density
    f, a = model(m, s.speed, s.spin_up, v, w, eta, ratio)
    for i in range(3):
        x.f[i], x.a[i] = f[i], a[i]


@jit
def miss(s: Any, prm: Any, axis: int) -> float:
    """1 sigma of what the model misses for a while, by axis hx hy t r p q [m/s^2, rad/s^2]; of thrust also by gusts up and down."""
    m = s.model[0]
    out = max(m.slow[axis], FORCE_LEAST if axis < 3 else MOMENT_LEAST)
    if axis == 2 and prm.fault_tolerant_wind > 0.0:
        total = 0.0
        for i in range(len(s.speed)):
            total += s.speed[i]
        out = math.hypot(out, 0.5 * (gust(s, prm) - prm.air_gust) * m.k[2, 2] * total)
    return float(out)


@jit
def gust(s: Any, prm: Any) -> float:
    """1 sigma of gusts along an axis [m/s], see `haltere.strapdown.propagate.blow`."""
    x = s.ft[0]
    return float(prm.air_gust + prm.air_turbulence * math.sqrt(x.steady[0] * x.steady[0] + x.steady[1] * x.steady[1]))


@jit
def left_over(s: Any, prm: Any, axis: int) -> float:
    """Variance of what identification left in its windows, without the noise of its sensors: means, and changes of means over a fifth."""
    m = s.model[0]
    total, w = m.sd[axis] * m.sd[axis], m.window[0 if axis < 3 else 1]
    own = prm.noise_accel * prm.noise_accel / w if axis < 3 else 10.0 * prm.noise_gyro * prm.noise_gyro / (w * w * w)
    return float(max(total - own, LEAST_LEFT * total))


@jit
def swing_noise(s: Any, prm: Any, a: int) -> float:
    """Spectral density of what the model's angular acceleration about an axis misses for a moment [rad^2/s^3].

    What identification left in its windows, and a part of the angular acceleration itself: rotor speeds come late and are not quite right.
    """
    x, m = s.ft[0], s.model[0]
    part = RELATIVE * (x.a[a] + x.bm[a])
    if a == 2:
        h = 0.0
        for i in range(len(s.speed)):
            h += m.yaw[i] * s.spin_up[i]
        part = math.hypot(part, RELATIVE * m.k[5, 3] * h)
    return float((left_over(s, prm, 3 + a) + part * part) * m.window[1])


@jit
def add_noise(s: Any, prm: Any, P: Any, C: Mat, dt: float, share: float, low: bool) -> None:
    """Noise of the process over one interval, ``share`` (1/β) times: what the model misses (near the ground ``low`` all), and gusts."""
    m, x = s.model[0], s.ft[0]
    k = share * dt
    blow = gust(s, prm)
    for i in range(3):
        moment, force = miss(s, prm, 3 + i), miss(s, prm, i)
        if (low and x.lf[LF_ACCEL].axes & (1 << i)) or x.isolated & (1 << (6 + i)):
            force = FORCE_FREE
        if (low and x.lf[LF_GYRO].axes & (1 << i)) or x.isolated & (1 << (9 + i)):
            moment = MOMENT_FREE
        P[i, i] += k * swing_noise(s, prm, i)
        P[3 + i, 3 + i] += k * 1e-9
        P[9 + i, 9 + i] += k * 1e-6
        P[12 + i, 12 + i] += k * 2.0 * moment * moment / MISS_TIME
        P[15 + i, 15 + i] += k * 2.0 * force * force / MISS_TIME
    white = 0.0
    for i in range(3):
        white = max(white, left_over(s, prm, i) * m.window[0])
    for i in range(3):
        P[6 + i, 6 + i] += k * white
    if prm.fault_tolerant_wind > 0.0:
        for i in range(2):
            P[18 + i, 18 + i] += k * 2.0 * blow * blow / prm.air_gust_time
            P[20 + i, 20 + i] += k * prm.noise_wind_mean * prm.noise_wind_mean
    else:
        for i in range(2):
            P[18 + i, 18 + i] += k * STILL
            P[20 + i, 20 + i] += k * 0.01 * STILL


@jit
def add_walks(prm: Any, P: Any, k: float) -> None:
    """Walks of the sensors' biases over k = dt/β."""
    if prm.fault_tolerant_biases > 0.0:
        for i in range(3):
            P[GYRO_BIAS + i, GYRO_BIAS + i] += k * prm.noise_gyro_bias * prm.noise_gyro_bias
            P[ACCEL_BIAS + i, ACCEL_BIAS + i] += k * prm.noise_accel_bias * prm.noise_accel_bias
        P[BARO_OFFSET, BARO_OFFSET] += k * prm.noise_baro_bias * prm.noise_baro_bias


@jit
def predict_all(s: Any, prm: Any, dt: float) -> tuple[Linear, Mat, Vec]:
    """Covariances and corrections of all local filters over one step; the nominal state is there already."""
    x = s.ft[0]
    lin, C, v = linear_at(s, prm, x)
    force = (lin[0][0] + x.bf[0], lin[0][1] + x.bf[1], lin[0][2] + x.bf[2])
    keep = math.exp(-dt / prm.air_gust_time)
    T = transition(C, (x.w[0], x.w[1], x.w[2]), force, v, lin[2], lin[3], lin[4], lin[5], dt, keep, math.exp(-dt / MISS_TIME))
    for i in range(LOCAL_FILTERS):
        f = x.lf[i]
        if f.share > 0.0:
            carry(f, T)
            carry_vector(f.dx, T)
            add_noise(s, prm, f.P, C, dt, 1.0 / f.share, x.ground - x.p[2] < LOW)
            add_walks(prm, f.P, dt / f.share)
    return lin, C, v


@jit
def scalar(f: Any, H: Any, e: float, r: float, gate: float) -> tuple[float, float]:
    """One scalar update of a local filter: innovation and its variance; not applied beyond ``gate`` sigma."""
    e = innovation(f, H, e)
    project(f, H)
    S = variance(f, H) + r
    if e * e <= gate * gate * S:
        column_of(f, H)
        for j in range(f.P.shape[0]):
            f.k[j] /= S
        apply(f, H, r, e)
    return e, S


@jit
def fuse_inertial(s: Any, prm: Any, lin: Linear, C: Mat, v: Vec, gyro: Vec, accel: Vec, dt: float) -> None:
    """What gyro and accelerometer show over the nominal state, means of one step, into their local filters."""
    x = s.ft[0]
    g, h = x.lf[LF_GYRO], x.lf[LF_ACCEL]
    rate = x.w[0] * x.w[0] + x.w[1] * x.w[1] + x.w[2] * x.w[2]
    r = (prm.noise_gyro * prm.noise_gyro + prm.noise_gyro_scale * prm.noise_gyro_scale * rate) / dt
    for a in range(3):
        if g.axes & (1 << a):
            H = ((RATE, unit(a)), (GYRO_BIAS, unit(a)), NONE)
            scalar(g, H, gyro[a] - x.bg[a], r, 1e9)
    D_a, D_w = lin[2], lin[3]
    by_theta, by_v = mul_mat(D_a, cross_matrix(v)), mul_mat(D_a, transpose(C))
    for a in range(3):
        if h.axes & (1 << a):
            r = (prm.noise_accel * prm.noise_accel + left_over(s, prm, a) * s.model[0].window[0]) / dt
            b = by_v[a]
            H6 = (
                (RATE, D_w[a]), (ATTITUDE, by_theta[a]), (SPEED, b), (FORCE, unit(a)), (WIND, (-b[0], -b[1], 0.0)), (ACCEL_BIAS, unit(a)),
            )  # fmt: skip
            scalar(h, H6, accel[a] - x.ba[a], r, 1e9)


@jit
def compass_row(s: Any, prm: Any, C: Mat, z: Vec, since: float) -> tuple[float, Vec, float]:
    """Heading of a magnetometer sample over the estimate: innovation [rad], derivative against the attitude error, variance.

    theory-amendments.md 1: y = wrap(D - atan2(μ_E, μ_N)), H = (e3 - tan I [cos D, sin D, 0])ᵀ C.
    """
    mu = mat_vec(C, z)
    e = wrap(s.field[0] - math.atan2(mu[1], mu[0]))
    horizontal = s.field[2] * math.cos(s.field[1])
    spread = prm.noise_field * prm.noise_field * max(1.0, prm.noise_field_time / max(since, 1e-3))
    return e, heading_row(C, s.field[0], s.field[1]), (prm.noise_magnetometer * prm.noise_magnetometer + spread) / (horizontal * horizontal)


@jit
def fuse_sensors(s: Any, prm: Any, C: Mat) -> None:
    """What waits of compass, GNSS and barometer into their local filters."""
    x = s.ft[0]
    arm = (prm.arm_gnss_x, prm.arm_gnss_y, prm.arm_gnss_z)
    for i in range(x.n_due):
        m = x.due[i]
        if m.kind == GNSS_VELOCITY and x.lf[LF_GNSS].axes & 1:
            f = x.lf[LF_GNSS]
            r = gnss.velocity_variance(prm, m.r)
            swing = mat_vec(C, cross((x.w[0], x.w[1], x.w[2]), arm))
            for a in range(3):
                if math.isfinite(m.z[a]):
                    H = ((SPEED, unit(a)), NONE, NONE)
                    scalar(f, H, m.z[a] - x.v[a] - swing[a], r[a], prm.gate_gnss)
        elif m.kind == GNSS_POSITION and x.lf[LF_GNSS].axes & 2:
            f = x.lf[LF_GNSS]
            r = gnss.position_variance(prm, m.r)
            z = gnss.position_observation(s, prm, m.z)
            lever = mat_vec(C, arm)
            for a in range(3):
                if math.isfinite(z[a]):
                    H = ((PLACE, unit(a)), NONE, NONE)
                    scalar(f, H, z[a] - x.p[a] - lever[a], r[a], prm.gate_gnss)
        elif m.kind == MAGNETOMETER and x.lf[LF_MAG].axes & 1 and s.has_field == 1 and s.compass.out == 0:
            f = x.lf[LF_MAG]
            e, h, r1 = compass_row(s, prm, C, (m.z[0], m.z[1], m.z[2]), 0.02)
            scalar(f, ((ATTITUDE, h), NONE, NONE), e, r1, prm.gate_magnetometer)
        elif m.kind == BAROMETER and x.lf[LF_BARO].axes & 1:
            f = x.lf[LF_BARO]
            e = m.z[0] - s.origin[2] + x.p[2] - x.baro
            scalar(
                f,
                ((PLACE, (0.0, 0.0, -1.0)), (BARO_OFFSET - 2, (0.0, 0.0, 1.0)), NONE),
                e,
                prm.noise_barometer * prm.noise_barometer,
                prm.gate_barometer,
            )


@jit
def correct(x: Any, d: Any) -> None:
    """Move the nominal state by an error."""
    q = quat_unit(quat_mul((x.q[0], x.q[1], x.q[2], x.q[3]), quat_from_rotvec((d[3], d[4], d[5]))))
    x.q[0], x.q[1], x.q[2], x.q[3] = q
    for i in range(3):
        x.w[i] += d[i]
        x.v[i] += d[6 + i]
        x.p[i] += d[9 + i]
        x.bm[i] += d[12 + i]
        x.bf[i] += d[15 + i]
    for i in range(2):
        x.wind[i] += d[18 + i]
        x.steady[i] += d[20 + i]


@jit
def fusion(s: Any, prm: Any) -> None:
    """All local filters into one state, and that shared out again; with no reset they keep their own opinion.

    What a local filter heard until now counts, then its share goes to the others if it hears no more. With no reset it is left out at once,
    with all that it has come to believe, and what the others know is shared out anew.
    """
    x = s.ft[0]
    anew, n = prm.fault_tolerant_reset == 0.0, 0
    for i in range(LOCAL_FILTERS):
        f = x.lf[i]
        if f.changed == 0 and f.share > 0.0:
            n += 1
        anew = anew or f.changed == 1
    for i in range(STATES):
        x.y[i] = 0.0
        for j in range(STATES):
            x.P[i, j] = 0.0
    for i in range(LOCAL_FILTERS):
        f = x.lf[i]
        if f.share > 0.0 and (f.changed == 0 or n == 0 or prm.fault_tolerant_reset == 0.0):
            add_information(x, f)
    fused(x)
    correct(x, x.dx)
    for i in range(3):
        x.bg[i] += x.dx[GYRO_BIAS + i]
        x.ba[i] += x.dx[ACCEL_BIAS + i]
    x.baro += x.dx[BARO_OFFSET]
    if anew:
        set_shares(x)
    for i in range(LOCAL_FILTERS):
        f = x.lf[i]
        f.changed = 0
        if f.share > 0.0:
            if anew:
                share_out(x, f, f.share)
            else:
                keep_apart(x, f)
    x.n_fused += 1
