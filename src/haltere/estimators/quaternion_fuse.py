"""What the published quaternion filter does with each measurement: gravity, field and wind triangle (source W, (23)-(25)). No time update.

Velocity over ground, wind and rotor speeds are only heard, for the wind triangle and for what is gravity.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids import air_vector, drag, vectors
from haltere.aids.fusing import judge
from haltere.aids.gnss import velocity_variance
from haltere.aids.record import (
    ACCELEROMETER,
    C_AIR,
    C_DOWN,
    C_UNIT_FIELD,
    DRAG,
    GNSS_VELOCITY,
    MAGNETOMETER,
    R_ACCELERATION,
    R_NONE,
    ROTORS,
    VANES,
    WIND,
    record,
)
from haltere.core.earth import STANDARD_DENSITY, density
from haltere.core.rotation import Mat, Quat, Vec, mat_vec, norm, quat_unit, scale
from haltere.filter.gates import ABSENT
from haltere.filter.joint import Rows, innovation_covariance, inverse, update
from haltere.filter.queue import pop_due
from haltere.strapdown.quaternion import normalise

__all__ = ["fuse", "fuse_air", "fuse_all", "gravity_shown", "hear"]

#: A velocity over ground this old [s] makes no wind triangle; what it may have changed by meanwhile, 1 sigma a second [m/s^2].
AGE_MAX, AGE_ACCELERATION = 0.5, 3.0
#: Time constant [s] of the acceleration that GNSS velocity shows.
ACCELERATION_TIME = 0.5
#: The drag is read off specific force over so long [s].
BLOCK = 0.1
#: Provider of air velocity: code of ``drag`` in ``wind_attitude.air``.
BY_DRAG = 2.0
NOTHING = (0.0, 0.0, 0.0, 0.0)


@jit
def hear(s: Any, prm: Any, kind: int, m: Any) -> None:
    """Take what is not fused itself: velocity over ground, wind, rotor speeds."""
    if kind == GNSS_VELOCITY:
        r = velocity_variance(prm, m.r)
        dt = m.t - s.t_gnss
        k = min(1.0, dt / ACCELERATION_TIME) if dt < 1.0 else 0.0
        for i in range(3):
            z = m.z[i] if m.z[i] == m.z[i] else 0.0
            s.gnss_a[i] += k * ((z - s.gnss_v[i]) / max(dt, 1e-3) - s.gnss_a[i])
            s.gnss_v[i] = z
            s.gnss_r[i] = r[i] if m.z[i] == m.z[i] else 1e4
        s.t_gnss = m.t
    elif kind == WIND:
        for i in range(3):
            s.wind_v[i] = m.z[i] if m.z[i] == m.z[i] else 0.0
        s.wind_r, s.has_wind = m.r[0] if m.r[0] > 0.0 else prm.noise_given_wind * prm.noise_given_wind, 1
    elif kind == ROTORS:
        drag.hear(s, m.t, m.z[0])


@jit
def gravity_shown(s: Any, prm: Any, f: Vec) -> bool:
    """Is specific force gravity here? Its size is g, and GNSS, where it speaks, shows no acceleration."""
    a = norm((s.gnss_a[0], s.gnss_a[1], s.gnss_a[2])) if s.t - s.t_gnss < 1.0 else 0.0
    return bool(abs(norm(f) - s.gravity) < prm.wind_attitude_force and a < prm.wind_attitude_acceleration)


@jit
def fuse(
    s: Any, prm: Any, aids: Any, t: float, sensor: int, component: int, z: Vec, h: Vec, H: Rows, R: Mat, gate: float, reason: int
) -> None:
    """(23)-(25) for three components: test, fuse and record. Components that are NaN are not there.

    (23) with the S that its sizes need, H P Hᵀ + R; (24) in Joseph's form. The residual is z - h(q), or Z - H X as (25) prints it.
    """
    x = (s.x[0], s.x[1], s.x[2], s.x[3])
    if prm.wind_attitude_residual > 0.0:
        h = (dot4(H[0], x), dot4(H[1], x), dot4(H[2], x))
    ok0, ok1, ok2 = z[0] == z[0], z[1] == z[1], z[2] == z[2]
    e = (z[0] - h[0] if ok0 else 0.0, z[1] - h[1] if ok1 else 0.0, z[2] - h[2] if ok2 else 0.0)
    H = (H[0] if ok0 else NOTHING, H[1] if ok1 else NOTHING, H[2] if ok2 else NOTHING)
    r01, r02, r12 = R[0][1] if ok0 and ok1 else 0.0, R[0][2] if ok0 and ok2 else 0.0, R[1][2] if ok1 and ok2 else 0.0
    R = (
        (R[0][0] if ok0 else ABSENT, r01, r02),
        (r01, R[1][1] if ok1 else ABSENT, r12),
        (r02, r12, R[2][2] if ok2 else ABSENT),
    )
    S = innovation_covariance(s.P, H, R)[1]
    y = mat_vec(inverse(S), e)
    ratio = (y[0] * e[0] + y[1] * e[1] + y[2] * e[2]) / (gate * gate)
    status, reason, weight = judge(s, sensor, t, ratio, prm.timeout_magnetometer, reason)
    if weight > 0.0:
        k = 1.0 / weight
        R = (
            (k * R[0][0], k * R[0][1], k * R[0][2]),
            (k * R[1][0], k * R[1][1], k * R[1][2]),
            (k * R[2][0], k * R[2][1], k * R[2][2]),
        )
        dx = update(s.P, s.work, H, R, e)
        for i in range(4):
            s.x[i] += dx[i]
        if prm.wind_attitude_normalise > 0.0:
            normalise(s, prm.wind_attitude_normalise > 1.0)
    for i in range(3):
        if z[i] == z[i]:
            record(s, aids, t, sensor, component + i, z[i], e[i], math.sqrt(S[i][i]), ratio, weight, status, reason)


@jit
def dot4(a: Quat, b: Quat) -> float:
    """Scalar product of four."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@jit
def diagonal(r: float) -> Mat:
    """r I."""
    return ((r, 0.0, 0.0), (0.0, r, 0.0), (0.0, 0.0, r))


@jit
def fuse_air(s: Any, prm: Any, aids: Any, t: float, kind: int, z: Vec, r: Vec) -> None:
    """Wind triangle: z = V_T^b, h = C(q)ᵀ (v - W) (19), R = R_a + C(q)ᵀ (R_v + P_W) C(q), with v of the last fix and W as given."""
    if s.t - s.t_gnss > AGE_MAX or s.has_wind == 0:
        return
    x = (s.x[0], s.x[1], s.x[2], s.x[3])
    a = (s.gnss_v[0] - s.wind_v[0], s.gnss_v[1] - s.wind_v[1], s.gnss_v[2] - s.wind_v[2])
    old = (s.t - s.t_gnss) * AGE_ACCELERATION
    more = s.wind_r + old * old
    T = vectors.turned_covariance(quat_unit(x), (s.gnss_r[0] + more, s.gnss_r[1] + more, s.gnss_r[2] + more))
    B = air_vector.air_covariance(z, r) if kind == VANES else ((r[0], 0.0, 0.0), (0.0, r[1], 0.0), (0.0, 0.0, r[2]))
    R = (
        (T[0][0] + B[0][0], T[0][1] + B[0][1], T[0][2] + B[0][2]),
        (T[1][0] + B[1][0], T[1][1] + B[1][1], T[1][2] + B[1][2]),
        (T[2][0] + B[2][0], T[2][1] + B[2][1], T[2][2] + B[2][2]),
    )
    H = vectors.printed_wind_rows(x) if prm.wind_attitude_rows > 0.0 else vectors.seen_rows(x, a)
    fuse(s, prm, aids, t, kind, C_AIR, z, vectors.seen(x, a), H, R, prm.gate_air, R_NONE)


@jit
def fuse_drag(s: Any, prm: Any, aids: Any, f: Vec) -> None:
    """Gather specific force, and every tenth of a second read the air velocity off its drag."""
    s.n_block += 1.0
    for i in range(3):
        s.f_block[i] += f[i]
    span = s.t - s.t_block
    if span < BLOCK - 1e-6:
        return
    k = 1.0 / s.n_block
    mean = (k * s.f_block[0], k * s.f_block[1], k * s.f_block[2])
    s.n_block, s.t_block = 0.0, s.t
    for i in range(3):
        s.f_block[i] = 0.0
    thrust = -mean[2]
    if thrust < drag.LEAST_THRUST * s.gravity:
        return
    ratio = 1.0
    if prm.air_density > 0.0:
        ratio = prm.air_density / STANDARD_DENSITY
    elif s.has_origin == 1:
        ratio = density(s.origin[2]) / STANDARD_DENSITY
    mu, c = prm.drag_mu * drag.spin(s, thrust, ratio), prm.drag_c * ratio
    sd = math.sqrt(prm.noise_drag * prm.noise_drag + prm.init_accel_bias * prm.init_accel_bias + prm.drag_offset_sd * prm.drag_offset_sd)
    v, r = air_vector.from_drag(mean, mu, c, sd, prm.drag_mu_sd)
    fuse_air(s, prm, aids, s.t, DRAG, v, r)


@jit
def fuse_all(s: Any, prm: Any, aids: Any, f: Vec, dt: float) -> None:
    """Hear and fuse what is due, in the order of the codes, the accelerometer of this very sample first."""
    for kind in (GNSS_VELOCITY, WIND, ROTORS):
        k = pop_due(s, kind, s.t)
        while k >= 0:
            hear(s, prm, kind, s.ring[kind, k])
            k = pop_due(s, kind, s.t)
    x = (s.x[0], s.x[1], s.x[2], s.x[3])
    size = norm(f)
    if prm.wind_attitude_accel > 0.0 and size > 0.0:
        e3 = (0.0, 0.0, 1.0)
        reason = R_NONE if gravity_shown(s, prm, f) else R_ACCELERATION
        r = prm.noise_accel * prm.noise_accel / (dt * s.gravity * s.gravity)
        fuse(
            s, prm, aids, s.t, ACCELEROMETER, C_DOWN, scale(f, -1.0 / size), vectors.seen(x, e3), vectors.seen_rows(x, e3),
            diagonal(r), prm.wind_attitude_gate, reason,
        )  # fmt: skip
    k = pop_due(s, MAGNETOMETER, s.t)
    while k >= 0:
        m = s.ring[MAGNETOMETER, k]
        z = (m.z[0], m.z[1], m.z[2])
        size = norm(z)
        if s.has_field == 1 and size > 0.0:
            x = (s.x[0], s.x[1], s.x[2], s.x[3])
            d, i = s.field[0], s.field[1]
            h = (math.cos(i) * math.cos(d), math.cos(i) * math.sin(d), math.sin(i))
            r = (prm.noise_magnetometer * prm.noise_magnetometer + prm.noise_field * prm.noise_field) / (s.field[2] * s.field[2])
            fuse(
                s, prm, aids, m.t, MAGNETOMETER, C_UNIT_FIELD, scale(z, 1.0 / size), vectors.seen(x, h), vectors.seen_rows(x, h),
                diagonal(r), prm.gate_magnetometer, R_NONE,
            )  # fmt: skip
        k = pop_due(s, MAGNETOMETER, s.t)
    k = pop_due(s, VANES, s.t)
    while k >= 0:
        m = s.ring[VANES, k]
        fuse_air(s, prm, aids, m.t, VANES, (m.z[0], m.z[1], m.z[2]), (m.r[0], m.r[1], m.r[2]))
        k = pop_due(s, VANES, s.t)
    if prm.wind_attitude_air == BY_DRAG:
        fuse_drag(s, prm, aids, f)
