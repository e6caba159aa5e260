"""Motion and its error as a vehicle's own physics drive them: nominal state, transition, covariance. It evaluates no force and no sensor.

The navigation-velocity form of theory.md §5.3, with wind (theory-amendments.md 2) and what the model misses (4). Nominal state: rate ω,
attitude, velocity, position, error of the moments b_M [rad/s^2] and of the specific force b_F [m/s^2], wind W and its mean W̄ (north and
east). Errors are true minus estimate, that of the attitude in the body frame; 22 of them, in this order:

δω̇ = M_ω δω + M_a δv_a + δb_M;  δθ̇ = -[ω]× δθ + δω;  δv̇ = C (-[f]× δθ + D_ω δω + D_a δv_a + δb_F);  δṗ = δv;  Ẇ = -(W - W̄)/τ,
ḃ = -b/τ_b,

where δv_a = [v_a]× δθ + Cᵀ (δv - δW). Constants may follow: biases of gyro, accelerometer, barometer, of which this knows no more.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit
from haltere.core.rotation import (
    Mat,
    Quat,
    Vec,
    add,
    dcm,
    mat_vec,
    mul_mat,
    quat_from_rotvec,
    quat_mul,
    quat_unit,
    rotvec_dcm,
    sub,
    tmat_vec,
)

__all__ = [
    "ACCEL_BIAS", "ATTITUDE", "BARO_OFFSET", "FORCE", "GYRO_BIAS", "MEAN", "MOMENT", "MOVING", "PLACE", "RATE", "SPEED", "STATES", "WIND",
    "Transition", "air_velocity", "carry", "carry_vector", "move", "transition",
]  # fmt: skip

#: First column of each block; then how many states move, and how many there are with the constants.
RATE, ATTITUDE, SPEED, PLACE, MOMENT, FORCE, WIND, MEAN = (constant(i) for i in (0, 3, 6, 9, 12, 15, 18, 20))
GYRO_BIAS, ACCEL_BIAS, BARO_OFFSET = (constant(i) for i in (22, 25, 28))
MOVING, STATES = constant(22), constant(29)

#: Blocks of the transition that are neither zero nor one: ω ← ω, θ, v; θ ← θ; v ← ω, θ, v, b_F; then the interval [s], and what is left
#: after it of a gust, and of b_M and b_F. Against the wind, ω and v go as against v with the other sign.
Transition = tuple[Mat, Mat, Mat, Mat, Mat, Mat, Mat, Mat, float, float, float]


@jit
def air_velocity(C: Mat, v: Vec, north: float, east: float) -> Vec:
    """Velocity through the air in the body frame [m/s], of the velocity over ground and the wind, NED."""
    return tmat_vec(C, (v[0] - north, v[1] - east, v[2]))


@jit
def move(x: Any, f: Vec, a: Vec, gravity: float, dt: float, keep: float, leak: float) -> None:
    """Advance a nominal state by specific force ``f`` [m/s^2] and angular acceleration ``a`` [rad/s^2] held over the interval.

    Both without b_F and b_M, which the state adds. ``keep`` is what is left of a gust, ``leak`` of b_F and b_M.
    """
    w = (x.w[0], x.w[1], x.w[2])
    a = (a[0] + x.bm[0], a[1] + x.bm[1], a[2] + x.bm[2])
    turn = (dt * (w[0] + 0.5 * dt * a[0]), dt * (w[1] + 0.5 * dt * a[1]), dt * (w[2] + 0.5 * dt * a[2]))
    half = quat_from_rotvec((0.5 * turn[0], 0.5 * turn[1], 0.5 * turn[2]))
    q: Quat = quat_mul((x.q[0], x.q[1], x.q[2], x.q[3]), half)
    push = mat_vec(dcm(q), (f[0] + x.bf[0], f[1] + x.bf[1], f[2] + x.bf[2]))
    q = quat_unit(quat_mul(q, half))
    x.q[0], x.q[1], x.q[2], x.q[3] = q
    for i in range(3):
        x.w[i] += dt * a[i]
        g = push[i] + (gravity if i == 2 else 0.0)
        x.p[i] += dt * (x.v[i] + 0.5 * dt * g)
        x.v[i] += dt * g
        x.bm[i] *= leak
        x.bf[i] *= leak
    for i in range(2):
        x.wind[i] = keep * x.wind[i] + (1.0 - keep) * x.steady[i]


@jit
def cross_matrix(a: Vec) -> Mat:
    """[a]×."""
    return ((0.0, -a[2], a[1]), (a[2], 0.0, -a[0]), (-a[1], a[0], 0.0))


@jit
def times(k: float, m: Mat) -> Mat:
    """Number times a matrix."""
    return (
        (k * m[0][0], k * m[0][1], k * m[0][2]),
        (k * m[1][0], k * m[1][1], k * m[1][2]),
        (k * m[2][0], k * m[2][1], k * m[2][2]),
    )


@jit
def transpose(m: Mat) -> Mat:
    """Rows for columns."""
    return ((m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2]))


@jit
def plus_one(m: Mat) -> Mat:
    """Matrix plus the identity."""
    return (
        (1.0 + m[0][0], m[0][1], m[0][2]),
        (m[1][0], 1.0 + m[1][1], m[1][2]),
        (m[2][0], m[2][1], 1.0 + m[2][2]),
    )


@jit
def transition(
    C: Mat, w: Vec, f: Vec, v_air: Vec, D_a: Mat, D_w: Mat, M_a: Mat, M_w: Mat, dt: float, keep: float, leak: float
) -> Transition:
    """Transition of the error over ``dt``, first order but for the turn of the body.

    Parameters
    ----------
    C, w
        C_nb and rate [rad/s].
    f
        Specific force with b_F [m/s^2].
    v_air
        Velocity through the air, body [m/s].
    D_a, D_w, M_a, M_w
        Derivatives of the model, see `haltere.vehicle.linear.linear`.
    dt, keep, leak
        Interval [s], and what is left after it of a gust, and of what the model misses.
    """
    Ct = transpose(C)
    S = cross_matrix(v_air)
    F = cross_matrix(f)
    B = mul_mat(D_a, S)
    return (
        plus_one(times(dt, M_w)),
        times(dt, mul_mat(M_a, S)),
        times(dt, mul_mat(M_a, Ct)),
        rotvec_dcm((-dt * w[0], -dt * w[1], -dt * w[2])),
        times(dt, mul_mat(C, D_w)),
        times(dt, mul_mat(C, (sub(B[0], F[0]), sub(B[1], F[1]), sub(B[2], F[2])))),
        times(dt, mul_mat(C, mul_mat(D_a, Ct))),
        times(dt, C),
        dt,
        keep,
        leak,
    )


@jit
def row_times(m: Vec, a: float, b: float, c: float) -> float:
    """Row of a block times three elements of a column."""
    return m[0] * a + m[1] * b + m[2] * c


@jit
def left(P: Any, n: int, T: Transition) -> None:
    """P <- A P, a column at a time."""
    Aww, Awt, Awv, Att, Avw, Avt, Avv, AvF, dt, keep, leak = T
    for j in range(n):
        w0, w1, w2 = P[0, j], P[1, j], P[2, j]
        t0, t1, t2 = P[3, j], P[4, j], P[5, j]
        a0, a1, a2 = P[6, j] - P[18, j], P[7, j] - P[19, j], P[8, j]  # through the air
        b0, b1, b2 = P[15, j], P[16, j], P[17, j]
        d0 = row_times(Avw[0], w0, w1, w2) + row_times(Avt[0], t0, t1, t2) + row_times(Avv[0], a0, a1, a2) + row_times(AvF[0], b0, b1, b2)
        d1 = row_times(Avw[1], w0, w1, w2) + row_times(Avt[1], t0, t1, t2) + row_times(Avv[1], a0, a1, a2) + row_times(AvF[1], b0, b1, b2)
        d2 = row_times(Avw[2], w0, w1, w2) + row_times(Avt[2], t0, t1, t2) + row_times(Avv[2], a0, a1, a2) + row_times(AvF[2], b0, b1, b2)
        P[9, j] += dt * (P[6, j] + 0.5 * d0)
        P[10, j] += dt * (P[7, j] + 0.5 * d1)
        P[11, j] += dt * (P[8, j] + 0.5 * d2)
        P[6, j] += d0
        P[7, j] += d1
        P[8, j] += d2
        P[3, j] = row_times(Att[0], t0, t1, t2) + dt * w0
        P[4, j] = row_times(Att[1], t0, t1, t2) + dt * w1
        P[5, j] = row_times(Att[2], t0, t1, t2) + dt * w2
        P[0, j] = row_times(Aww[0], w0, w1, w2) + row_times(Awt[0], t0, t1, t2) + row_times(Awv[0], a0, a1, a2) + dt * P[12, j]
        P[1, j] = row_times(Aww[1], w0, w1, w2) + row_times(Awt[1], t0, t1, t2) + row_times(Awv[1], a0, a1, a2) + dt * P[13, j]
        P[2, j] = row_times(Aww[2], w0, w1, w2) + row_times(Awt[2], t0, t1, t2) + row_times(Awv[2], a0, a1, a2) + dt * P[14, j]
        for i in range(12, 18):
            P[i, j] *= leak
        P[18, j] = keep * P[18, j] + (1.0 - keep) * P[20, j]
        P[19, j] = keep * P[19, j] + (1.0 - keep) * P[21, j]


@jit
def carry(s: Any, T: Transition) -> None:
    """Covariance ``s.P`` over one interval, A P Aᵀ; no noise is added. It has 22 states or more, see `MOVING`."""
    P = s.P
    n = s.P.shape[0]
    for _half in range(2):
        left(P, n, T)
        for i in range(n):
            for j in range(i):
                P[i, j], P[j, i] = P[j, i], P[i, j]


@jit
def carry_vector(x: Any, T: Transition) -> None:
    """An error vector over one interval, x <- A x."""
    Aww, Awt, Awv, Att, Avw, Avt, Avv, AvF, dt, keep, leak = T
    w, t = (x[0], x[1], x[2]), (x[3], x[4], x[5])
    a, b = (x[6] - x[18], x[7] - x[19], x[8]), (x[15], x[16], x[17])
    d = add(add(mat_vec(Avw, w), mat_vec(Avt, t)), add(mat_vec(Avv, a), mat_vec(AvF, b)))
    t1 = mat_vec(Att, t)
    w1 = add(add(mat_vec(Aww, w), mat_vec(Awt, t)), mat_vec(Awv, a))
    for i in range(3):
        x[9 + i] += dt * (x[6 + i] + 0.5 * d[i])
        x[6 + i] += d[i]
        x[3 + i] = t1[i] + dt * w[i]
        x[i] = w1[i] + dt * x[12 + i]
        x[12 + i] *= leak
        x[15 + i] *= leak
    for i in range(2):
        x[18 + i] = keep * x[18 + i] + (1.0 - keep) * x[20 + i]
