"""Strapdown mechanisation and covariance propagation of one IMU interval, and the injection of a correction. No sensor aiding.

Error state: q_true = q ⊗ δq(δθ) (body), everything else true minus estimate (theory.md §1, theory-amendments.md §8).
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.core.rotation import Mat, Vec, cross, dcm, dot, mat_vec, quat_from_rotvec, quat_mul, quat_unit, rotvec_dcm, sub
from haltere.filter.update import symmetrise
from haltere.strapdown.optional import add_optional

__all__ = ["gust_keeps", "gusts", "inject", "left_F", "mechanise", "predict", "propagate", "transition", "turn", "unseen"]


@jit
def mechanise(s: Any, rotation: Vec, dv_mid: Vec, dt: float) -> Mat:
    """Advance attitude, velocity and position by one interval; return C_nb in the middle of it.

    Parameters
    ----------
    s
        State record.
    rotation
        Rotation vector over the interval, body frame [rad], bias removed.
    dv_mid
        Integral of specific force over the interval in the body frame of its middle [m/s], bias removed.
    dt
        Interval [s].
    """
    q = (s.q[0], s.q[1], s.q[2], s.q[3])
    half = quat_from_rotvec((0.5 * rotation[0], 0.5 * rotation[1], 0.5 * rotation[2]))
    q_mid = quat_mul(q, half)
    C = dcm(q_mid)
    dv = mat_vec(C, dv_mid)
    q = quat_unit(quat_mul(q_mid, half))
    s.q[0], s.q[1], s.q[2], s.q[3] = q
    for i in range(3):
        a = dv[i]
        if i == 2:
            a += s.gravity * dt
        s.p[i] += dt * (s.v[i] + 0.5 * a)
        s.v[i] += a
    return C


@jit
def transition(C: Mat, rotation: Vec, f: Vec, dt: float) -> tuple[Mat, Mat, Mat]:
    """Blocks of Φ that are not zero or one (theory-amendments.md §8): Φ_θθ = R(ω dt)ᵀ, Φ_vθ = -C [f]× dt and Φ_v,ba = -C dt.

    Parameters
    ----------
    C
        C_nb in the middle of the interval.
    rotation, f
        Rotation vector and mean specific force of the interval, bias removed [rad, m/s^2].
    dt
        Interval [s].
    """
    D = rotvec_dcm((-rotation[0], -rotation[1], -rotation[2]))
    # -C [f]x: column j is -C (f x e_j)
    fx, fy, fz = dt * f[0], dt * f[1], dt * f[2]
    A = (
        (C[0][2] * fy - C[0][1] * fz, C[0][0] * fz - C[0][2] * fx, C[0][1] * fx - C[0][0] * fy),
        (C[1][2] * fy - C[1][1] * fz, C[1][0] * fz - C[1][2] * fx, C[1][1] * fx - C[1][0] * fy),
        (C[2][2] * fy - C[2][1] * fz, C[2][0] * fz - C[2][2] * fx, C[2][1] * fx - C[2][0] * fy),
    )
    B = (
        (-dt * C[0][0], -dt * C[0][1], -dt * C[0][2]),
        (-dt * C[1][0], -dt * C[1][1], -dt * C[1][2]),
        (-dt * C[2][0], -dt * C[2][1], -dt * C[2][2]),
    )
    return D, A, B


@jit
def left_F(s: Any, j: int, D: Mat, A: Mat, B: Mat, dt: float) -> None:
    """Column j of P <- Φ P, touching only the blocks of Φ that are not zero or one.

    Parameters
    ----------
    j
        Column. The loop over it is the caller's: with a length known there it becomes SIMD.
    D, A, B
        Blocks of Φ, see `transition`.
    dt
        Interval [s].
    """
    P = s.P
    t0, t1, t2 = P[0, j], P[1, j], P[2, j]
    g0, g1, g2 = P[9, j], P[10, j], P[11, j]
    b0, b1, b2 = P[12, j], P[13, j], P[14, j]
    d0 = A[0][0] * t0 + A[0][1] * t1 + A[0][2] * t2 + B[0][0] * b0 + B[0][1] * b1 + B[0][2] * b2
    d1 = A[1][0] * t0 + A[1][1] * t1 + A[1][2] * t2 + B[1][0] * b0 + B[1][1] * b1 + B[1][2] * b2
    d2 = A[2][0] * t0 + A[2][1] * t1 + A[2][2] * t2 + B[2][0] * b0 + B[2][1] * b1 + B[2][2] * b2
    P[6, j] += dt * (P[3, j] + 0.5 * d0)
    P[7, j] += dt * (P[4, j] + 0.5 * d1)
    P[8, j] += dt * (P[5, j] + 0.5 * d2)
    P[3, j] += d0
    P[4, j] += d1
    P[5, j] += d2
    P[0, j] = D[0][0] * t0 + D[0][1] * t1 + D[0][2] * t2 - dt * g0
    P[1, j] = D[1][0] * t0 + D[1][1] * t1 + D[1][2] * t2 - dt * g1
    P[2, j] = D[2][0] * t0 + D[2][1] * t1 + D[2][2] * t2 - dt * g2


@jit
def turn(s: Any) -> None:
    """Between the two halves of Φ P Φᵀ: make the first nine columns of P those of (Φ P)ᵀ.

    The other columns of Φᵀ are those of one, so that Φ P has the final values there, and the last rows theirs by symmetry.
    """
    P = s.P
    for i in range(9):
        for j in range(i):
            P[i, j], P[j, i] = P[j, i], P[i, j]
    for i in range(9, s.P.shape[0]):
        for j in range(9):
            P[i, j] = P[j, i]


@jit
def predict(s: Any, prm: Any, w: Vec, f: Vec, rotation: Vec, dv_mid: Vec, dt: float) -> tuple[Mat, Mat, Mat]:
    """Advance nominal state and covariance by one interval (theory-amendments.md §8); return the blocks of Φ, see `transition`.

    Parameters
    ----------
    s, prm
        State and parameter records.
    w, f
        Mean angular rate and specific force of the interval, bias removed [rad/s, m/s^2].
    rotation, dv_mid
        Rotation vector and velocity increment, see `mechanise`.
    dt
        Interval [s].
    """
    C = mechanise(s, rotation, dv_mid, dt)
    s.w[0], s.w[1], s.w[2] = w
    D, A, B = transition(C, rotation, f, dt)
    propagate(s, prm, C, D, A, B, dt)
    return D, A, B


@jit
def propagate(s: Any, prm: Any, C: Mat, D: Mat, A: Mat, B: Mat, dt: float) -> None:
    """P <- Φ P Φᵀ + Q.

    Parameters
    ----------
    s, prm
        State and parameter records.
    C
        C_nb in the middle of the interval.
    D, A, B
        Blocks of Φ, see `transition`.
    dt
        Interval [s].
    """
    for j in range(s.P.shape[0]):
        left_F(s, j, D, A, B, dt)
    turn(s)
    for j in range(9):
        left_F(s, j, D, A, B, dt)

    P = s.P
    qg, qbg = prm.noise_gyro * prm.noise_gyro, prm.noise_gyro_bias * prm.noise_gyro_bias
    qa, qba = prm.noise_accel * prm.noise_accel, prm.noise_accel_bias * prm.noise_accel_bias
    turned = 3.0 - D[0][0] - D[1][1] - D[2][2]  # angle squared: what is wrong in proportion to the rate stays for about a second
    q_theta = qg * dt + qbg * dt * dt * dt / 3.0 + prm.noise_gyro_scale * prm.noise_gyro_scale * turned / dt
    q_v, q_p = qa * dt, qa * dt * dt * dt / 3.0
    for i in range(3):
        P[i, i] += q_theta
        P[3 + i, 3 + i] += q_v
        P[6 + i, 6 + i] += q_p
        P[9 + i, 9 + i] += qbg * dt
        P[12 + i, 12 + i] += qba * dt
    for i in range(len(s.baro)):
        P[15 + i, 15 + i] += prm.noise_baro_bias * prm.noise_baro_bias * dt
    o = 15 + len(s.baro)
    for i in range(len(s.mag)):
        P[o + i, o + i] += prm.noise_mag_offset * prm.noise_mag_offset * dt
    if len(s.wind) > 0:
        blow(s, prm, o + len(s.mag), dt)
    if dt > 0.02:  # below that the off-diagonal blocks are lost in the noise (theory-amendments.md §8)
        for i in range(3):
            c = -0.5 * qbg * dt * dt
            P[i, 9 + i] += c
            P[9 + i, i] += c
            c = 0.5 * qa * dt * dt
            P[3 + i, 6 + i] += c
            P[6 + i, 3 + i] += c
            for j in range(3):
                c = -0.5 * qba * dt * dt * C[i][j]
                P[3 + i, 12 + j] += c
                P[12 + j, 3 + i] += c


@jit
def unseen(s: Any, prm: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> None:
    """Admit that the course between two samples is not known: 1 sigma of its mean is ``noise.between`` of the change from one to the other.

    The mean of two samples of a sine ωt errs by ωh/12 of their difference: 0.2 at two fifths of the sampling rate. At 250 Hz that is next
    to nothing in P, at 25 Hz, as logs have it, more than the noise.
    """
    k = prm.noise_between * dt
    k2 = k * k
    f = sub(f1, f0)
    force = k2 * dot(f, f) / 3.0  # in whatever direction
    for i in range(3):
        w = w1[i] - w0[i]
        s.P[i, i] += k2 * w * w
        s.P[3 + i, 3 + i] += force


@jit
def gust_keeps(prm: Any, dt: float) -> float:
    """What is left of a gust after ``dt`` seconds."""
    return math.exp(-dt / prm.air_gust_time)


@jit
def gusts(s: Any, prm: Any) -> tuple[float, float]:
    """1 sigma of gusts, and how the mean wind walks [1/sqrt(s)], in the units of the wind's states."""
    speed, factor = math.sqrt(s.steady[0] * s.steady[0] + s.steady[1] * s.steady[1]), 1.0
    if len(s.drag) > 0:
        mu, c = math.exp(s.drag[0]), math.exp(s.drag[1])
        factor = math.sqrt(mu * mu + 4.0 * c * speed)  # µ + 2c|W|
        speed = 2.0 * speed / (mu + factor)
    return factor * (prm.air_gust + prm.air_turbulence * speed), factor * prm.noise_wind_mean


@jit
def blow(s: Any, prm: Any, o: int, dt: float) -> None:
    """Advance wind and coefficients of the air, from error state ``o`` on.

    Wind is gusts about a slow mean, dW = -(W - W̄) dt/τ + noise; the mean of the vertical wind is zero. In a layout with drag the state is
    the specific force on a vehicle at hover, A = µW + c|W|W (see `haltere.aids.air`), and the noise is that of W times µ + 2c|W|. A wind
    that only walked would let drag that follows the vehicle's motion look like wind that returns, and µ would be found wrong
    (theory-amendments.md §2); without GNSS it would run away with the velocity.
    """
    P, n = s.P, s.P.shape[0]
    first, keep = o + len(s.wind), gust_keeps(prm, dt)
    m = first + len(s.drag)
    gust, walk = gusts(s, prm)
    if len(s.pairs) > 0 and (s.pairs[0].on[3] | s.pairs[0].on[4]) != 0:
        gust *= s.pairs[0].calm  # no drag is measured: gusts are those of the flight so far
    for i in range(len(s.wind)):
        if i < 2:
            s.wind[i] = keep * s.wind[i] + (1.0 - keep) * s.steady[i]
            for j in range(n):
                P[o + i, j] = keep * P[o + i, j] + (1.0 - keep) * P[m + i, j]
        else:
            s.wind[i] *= keep
            for j in range(n):
                P[o + i, j] *= keep
    for j in range(n):
        for i in range(len(s.wind)):
            if i < 2:
                P[j, o + i] = keep * P[j, o + i] + (1.0 - keep) * P[j, m + i]
            else:
                P[j, o + i] *= keep
    for i in range(len(s.wind)):
        k = gust if i < 2 else 0.5 * gust
        P[o + i, o + i] += k * k * (1.0 - keep * keep)
    for i in range(2):
        P[m + i, m + i] += walk * walk * dt
    for i in range(first, n - len(s.twist)):
        if i < m or i >= m + 2:
            P[i, i] += prm.noise_air_walk * prm.noise_air_walk * dt


@jit
def inject(s: Any) -> None:
    """Move the correction ``s.dx`` into the nominal state, reset it, and turn P with it, G_θθ = I - ½[δθ]×; P is symmetric after it."""
    dx, P = s.dx, s.P
    n = s.P.shape[0]
    t = (dx[0], dx[1], dx[2])
    before = (s.q[0], s.q[1], s.q[2], s.q[3])
    s.yaw_corrected += dot(dcm(before)[2], t)
    q = quat_unit(quat_mul(before, quat_from_rotvec(t)))
    s.q[0], s.q[1], s.q[2], s.q[3] = q
    for i in range(3):
        s.v[i] += dx[3 + i]
        s.p[i] += dx[6 + i]
        s.bg[i] += dx[9 + i]
        s.ba[i] += dx[12 + i]
    add_optional(s, dx, 15)
    for j in range(n):
        c = cross(t, (P[0, j], P[1, j], P[2, j]))
        P[0, j] -= 0.5 * c[0]
        P[1, j] -= 0.5 * c[1]
        P[2, j] -= 0.5 * c[2]
    for i in range(3):  # the last columns are turned by symmetry
        c = cross(t, (P[i, 0], P[i, 1], P[i, 2]))
        P[i, 0] -= 0.5 * c[0]
        P[i, 1] -= 0.5 * c[1]
        P[i, 2] -= 0.5 * c[2]
    for i in range(n):
        dx[i] = 0.0
    symmetrise(s)
