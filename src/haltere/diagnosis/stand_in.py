"""A vehicle's model in place of IMU axes that are not to be used: which, since when, what it says, and the covariance of that. No verdicts.

A gyro axis is replaced by the integral of the moment model, an accelerometer axis by the force model in the velocity through the air. The
error of a replaced rate is the state of that axis' gyro bias with its sign turned (true rate = ω̂, so that b_g of the axis is ω̂ minus the
true rate), and that of a replaced force the state of its accelerometer bias (-b_F); the moment model's own offset b_M is a state more,
dormant while the gyro works. With M_v, M_ω, D_v the model's slopes (theory.md §5.3) and v_a = Cᵀ(v - W)::

    d δb_g,i/dt = -M_v,i (Cᵀ(δv - δW) + [v_a]× δθ) + M_ω,i δb_g - δb_M,i + noise
    d δv/dt    += C e_i D_v,i (Cᵀ(δv - δW) + [v_a]× δθ) + C e_i noise

Healthy axes stay as they are. Where no rotor speed is known the last value holds, ever less sure.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit
from haltere.aids import compass
from haltere.aids.air import air_velocity, core_blocks, quadratic_block, wind_block
from haltere.aids.drag import density_ratio
from haltere.core.earth import STANDARD_DENSITY
from haltere.core.rotation import Mat, Vec, dcm
from haltere.filter import usual
from haltere.filter.update import NONE, project, variance
from haltere.vehicle.linear import linear

__all__ = ["across", "couple", "forget", "hold", "stand_in", "stands", "twist_column", "with_lift"]

#: In the air: thrust of the model above this part of gravity (theory-amendments.md §19), and so high above where it last rested [m].
LEAST_THRUST, LIFTED = 0.5, 0.5
#: How long the density holds [s].
DENSITY_HOLDS = 1.0
#: A rate and a force of which nothing is known [rad/s, m/s^2], and for how long that is alike [s].
UNSEEN_RATE, UNSEEN_FORCE, ALIKE = 0.3, 1.5, 0.3
#: 1 sigma of a rate when the model begins without a past [rad/s]; least 1 sigma of offsets [m/s^2, rad/s^2].
NO_PAST, LEAST_FORCE, LEAST_MOMENT = 0.5, 0.05, 0.05
#: A fault began so long [s] before its onset was seen, at most.
EARLIER = 0.06
#: Least 1 sigma in a window, length of the long windows [s], and by what part of its variance an offset wanders a second.
LEAST_NOISE, SECOND, WANDER = 0.05, 1.0, 0.03
FORCES = constant(3)


@jit
def twist_column(s: Any) -> int:
    """First error state of the moment model's offset."""
    return s.P.shape[0] - 3


@jit
def forget(s: Any) -> None:
    """Begin anew: after alignment."""
    p = s.pairs[0]
    p.standing, p.flying, p.head, p.wrong, p.ground, p.lifted = 0, 0, 0, 0, s.p[2], 0
    for i in range(len(p.lift)):
        p.lift[i], p.torque[i] = 0.0, 0.0
    p.t_ratio, p.t_mark = -1e9, -1e9
    usual.begin(p, s.t)
    for i in range(6):
        p.on[i] = 0
    for i in range(3):
        p.turn[i] = 0.0
    k = twist_column(s)
    for i in range(3):
        s.twist[i] = 0.0
        alone(s, k + i, offset_variance(s, 3 + i))


@jit
def offset_variance(s: Any, axis: int) -> float:
    """Variance of what the model of an axis is off by for seconds."""
    least = LEAST_FORCE if axis < FORCES else LEAST_MOMENT
    return max(s.model[0].slow[axis], least) ** 2


@jit
def density_of_noise(s: Any, axis: int) -> float:
    """Spectral density of what the model of an axis leaves: the larger of what its windows and their means over a second say.

    White noise of density q has the variance q/T in means over T. A negative correlation of neighbouring windows is that of a difference of
    samples: the noise of the sensor, no error of the model. What lasts much longer than a second is left to the offset.
    """
    m = s.model[0]
    sd, slow = max(m.sd[axis], LEAST_NOISE), m.slow[axis]
    short = sd * sd * m.window[0 if axis < FORCES else 1] * max(1.0 + 2.0 * min(m.ar1[axis], 0.0), 0.0)
    return float(max(short, slow * slow * SECOND, LEAST_NOISE * LEAST_NOISE * m.window[1]))


@jit
def alone(s: Any, k: int, v: float) -> None:
    """Give error state ``k`` a variance, and take away what it has in common with others."""
    P = s.P
    for j in range(s.P.shape[0]):
        P[k, j], P[j, k] = 0.0, 0.0
    P[k, k] = v


@jit
def stands(s: Any) -> bool:
    """Whether the model stands in for an axis."""
    return s.pairs[0].standing != 0


@jit
def across(s: Any) -> bool:
    """Whether it does for the accelerometer across the thrust axis: then there is no drag to be measured."""
    p = s.pairs[0]
    return (p.on[3] | p.on[4]) != 0


@jit
def hold(s: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec) -> tuple[Vec, Vec]:
    """A raw sample with the one before in place of axes that the model stands in for: for what lies ahead of the state."""
    on = s.pairs[0].on
    for i in range(3):
        if on[i] == 1:
            w1 = put(w1, i, (w0[0], w0[1], w0[2])[i])
        if on[3 + i] == 1:
            f1 = put(f1, i, (f0[0], f0[1], f0[2])[i])
    return w1, f1


@jit
def with_lift(s: Any, speed: Any, f: Vec, a: Vec) -> tuple[Vec, Vec]:
    """Force and angular acceleration with what rotors were found to have more than their speeds stand for."""
    p, m = s.pairs[0], s.model[0]
    if p.lifted == 1:
        for k in range(min(len(speed), len(p.lift))):
            o2 = speed[k] * speed[k] * p.ratio
            f = (f[0], f[1], f[2] + p.lift[k] * m.k[2, 0] * o2)
            t = p.lift[k] * o2
            a = (a[0] + t * m.k[3, 0] * m.roll[k], a[1] + t * m.k[4, 0] * m.pitch[k], a[2] + p.torque[k] * o2 * m.k[5, 0] * m.yaw[k])
    return f, a


@jit
def evaluate(s: Any, prm: Any, w: Vec, dt: float) -> None:
    """The model at the state's time, with the rate ``w`` [rad/s], and whether the vehicle is in the air."""
    p, m = s.pairs[0], s.model[0]
    if s.t >= p.t_ratio:
        p.ratio, p.t_ratio = density_ratio(s, prm) * STANDARD_DENSITY / m.density, s.t + DENSITY_HOLDS
    v = air_velocity(s, dcm((s.q[0], s.q[1], s.q[2], s.q[3])), (s.v[0], s.v[1], s.v[2]))
    eta = (p.m[0], p.m[1], p.m[2]) if m.literal == 1 else w
    f, a, D_v, _, M_v, M_w = linear(m, s.speed, s.spin_up, v, w, eta, p.ratio)
    f, a = with_lift(s, s.speed, f, a)
    for i in range(3):
        p.f[i], p.m[i], p.v_a[i] = f[i], a[i], v[i]
        p.turn[i] += a[i] * dt
        for j in range(3):
            p.by_v[0, i, j], p.by_v[1, i, j], p.by_w[i, j] = D_v[i][j], M_v[i][j], M_w[i][j]
    if -f[2] < LEAST_THRUST * s.gravity:
        p.flying = 0
        if s.rest.still == 1:
            p.ground = s.p[2]
    elif p.ground - s.p[2] > LIFTED or s.align.kind != 1:
        if p.flying == 0:
            p.t_flying = s.t
        p.flying = 1
    else:
        p.flying = 0


@jit
def wanted(s: Any, i: int) -> bool:
    """Whether an axis (gyro 0 to 2, accelerometer 3 to 5) is not to be used: told so, or known to be dead."""
    told = s.pairs[0].told
    sensor, bit = (0, 1 << i) if i < FORCES else (1, 1 << (i - 3))
    for k in range(told.shape[1]):
        if int(told[sensor, k, 0]) & bit != 0 and s.t >= told[sensor, k, 1] and s.t < told[sensor, k, 2]:
            return True
    if len(s.bank) > 0:
        return int(s.bank[0].step.wrong[i]) != 0
    return False


@jit
def mark_before(p: Any, t: float) -> int:
    """The newest mark of the past before t, -1 if there is none."""
    best, when = -1, -1e8
    for k in range(len(p.m_t)):
        if p.m_t[k] <= t and p.m_t[k] > when:
            best, when = k, p.m_t[k]
    return best


@jit
def onset_of(s: Any, i: int) -> float:
    """When an axis that is dead was alive last [s]."""
    t = s.t
    if len(s.bank) > 0:
        d = s.bank[0].step
        if d.wrong[i] != 0:
            t = min(t, d.t_rough[i] if d.t_rough[i] > 0.0 else d.t_run[i])
    return t - EARLIER


@jit
def begin(s: Any, i: int, w: float) -> float:
    """Let the model stand in for an axis from here on; the rate to begin with, of a gyro axis that read ``w``, free of bias."""
    p = s.pairs[0]
    p.on[i], p.standing = 1, 1
    t0 = onset_of(s, i)
    k = mark_before(p, t0)
    if i >= FORCES:
        a = i - 3
        p.kept[i] = s.ba[a]
        s.ba[a] = 0.0
        if k >= 0:
            s.ba[a] = -p.m_level[k, a]  # the pair's offset is measured less modelled force: b_F
        alone(s, 12 + a, offset_variance(s, a))
        return 0.0
    p.kept[i] = s.bg[i]
    s.bg[i] = 0.0
    spread, rate, drift = NO_PAST * NO_PAST, w, 0.0
    if k >= 0:
        age = s.t - p.m_t[k]
        drift = p.m_drift[k, 3 + i]
        rate = p.m_level[k, 3 + i] + p.turn[i] + drift * age
        noise = density_of_noise(s, 3 + i)
        spread = 1e-6 + p.m_var[k, 3 + i] + noise * age + offset_variance(s, 3 + i) * age * age
    s.twist[i] = drift
    alone(s, 9 + i, spread)
    alone(s, twist_column(s) + i, offset_variance(s, 3 + i))
    compass.forget(s)
    return rate


@jit
def end(s: Any, prm: Any, i: int) -> None:
    """An axis is used again: its bias as it was, as unsure as at the start."""
    p = s.pairs[0]
    p.on[i] = 0
    if i >= FORCES:
        s.ba[i - 3] = p.kept[i]
        alone(s, 12 + i - 3, prm.init_accel_bias * prm.init_accel_bias)
    else:
        s.bg[i], s.twist[i] = p.kept[i], 0.0
        alone(s, 9 + i, prm.init_gyro_bias * prm.init_gyro_bias)
        alone(s, twist_column(s) + i, offset_variance(s, 3 + i))
    p.standing = 0
    for k in range(6):
        p.standing |= p.on[k]
    p.n_blocks = 0


@jit
def stand_in(s: Any, prm: Any, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> tuple[Vec, Vec, Vec, Vec]:
    """Rate and force at the beginning and the end of an interval, raw, with the model's in place of those of axes not to be used."""
    p = s.pairs[0]
    for i in range(3):  # an error that was found in a replaced rate is taken out of it
        if p.on[i] == 1:
            w0 = put(w0, i, (w0[0], w0[1], w0[2])[i] - s.bg[i])
            s.bg[i] = 0.0
    w = (w1[0] - s.bg[0], w1[1] - s.bg[1], w1[2] - s.bg[2])
    if p.standing != 0:
        w = (w0[0] if p.on[0] == 1 else w[0], w0[1] if p.on[1] == 1 else w[1], w0[2] if p.on[2] == 1 else w[2])
    if s.rotor_known == 1:
        evaluate(s, prm, w, dt)
    p.t = s.t
    for i in range(6):
        want = wanted(s, i)
        if want and p.on[i] == 0:
            rate = begin(s, i, (w[0], w[1], w[2], 0.0, 0.0, 0.0)[i])
            if i < FORCES:
                w0 = put(w0, i, rate)
        elif not want and p.on[i] == 1:
            end(s, prm, i)
    if p.flying == 1:  # carried by its rotors: a hover in still air is as quiet as rest
        s.rest.still = 0
    if p.standing == 0:
        return w0, f0, w1, f1
    known = s.rotor_known == 1
    down = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2]
    for i in range(3):
        if p.on[i] == 1:
            rate = (w0[0], w0[1], w0[2])[i]
            if p.flying == 1:
                rate += dt * (p.m[i] + s.twist[i]) if known else 0.0
            else:
                rate = 0.0
            w1 = put(w1, i, rate)
        if p.on[3 + i] == 1:
            force = (f0[0], f0[1], f0[2])[i]
            if p.flying == 0:
                force = s.ba[i] - s.gravity * down[i]
            elif known:
                force = p.f[i]
            f1 = put(f1, i, force)
    return w0, f0, w1, f1


@jit
def put(v: Vec, i: int, x: float) -> Vec:
    """A vector with another component."""
    return (x if i == 0 else v[0], x if i == 1 else v[1], x if i == 2 else v[2])


@jit
def add_along(s: Any, column: int, c: Vec, H: Any, dt: float) -> None:
    """P <- (1 + a hᵀ) P (1 + h aᵀ), where a is ``c`` dt in the three states from ``column`` on, and h the row ``H``."""
    project(s, H)
    v = variance(s, H)
    P, u = s.P, s.u
    for i in range(3):
        a = c[i] * dt
        if a != 0.0:
            for j in range(s.P.shape[0]):
                P[column + i, j] += a * u[j]
    for i in range(3):
        a = c[i] * dt
        if a != 0.0:
            for j in range(s.P.shape[0]):
                P[j, column + i] += a * u[j]
    for i in range(3):
        for j in range(3):
            P[column + i, column + j] += v * dt * dt * c[i] * c[j]


@jit
def slope_row(s: Any, C: Mat, d: Vec, sign: float) -> tuple[Any, Any, Any, Any]:
    """Blocks of attitude, velocity, wind and drag's square of what goes with the velocity through the air by ``sign`` d (body)."""
    p = s.pairs[0]
    d = (sign * d[0], sign * d[1], sign * d[2])
    theta, vel, e = core_blocks(C, (p.v_a[0], p.v_a[1], p.v_a[2]), d)
    if len(s.wind) == 0:
        return theta, vel, NONE, NONE
    return theta, vel, wind_block(s, e, 0.0), quadratic_block(s, e)


@jit
def couple(s: Any, prm: Any, dt: float) -> None:
    """After prediction: what the model, where it stands in, carries from one state into another, and its noise."""
    p, P = s.pairs[0], s.P
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    known = s.rotor_known == 1 and p.flying == 1
    twist = twist_column(s)
    for i in range(3):
        if p.on[3 + i] == 1:
            c = (C[0][i], C[1][i], C[2][i])
            q = UNSEEN_FORCE * UNSEEN_FORCE * ALIKE
            if known:
                d = (p.by_v[0, i, 0], p.by_v[0, i, 1], p.by_v[0, i, 2])
                theta, vel, wind, square = slope_row(s, C, d, 1.0)
                add_along(s, 3, c, (theta, vel, wind, square), dt)
                q = density_of_noise(s, i)
                P[12 + i, 12 + i] += WANDER * offset_variance(s, i) * dt
            for j in range(3):
                for k in range(3):
                    P[3 + j, 3 + k] += q * dt * c[j] * c[k]
        if p.on[i] == 1:
            q = UNSEEN_RATE * UNSEEN_RATE / ALIKE
            if known:
                d = (p.by_v[1, i, 0], p.by_v[1, i, 1], p.by_v[1, i, 2])
                theta, vel, wind, square = slope_row(s, C, d, -1.0)
                rate = (9, (p.by_w[i, 0], p.by_w[i, 1], p.by_w[i, 2]))
                offset = (twist, (-1.0 if i == 0 else 0.0, -1.0 if i == 1 else 0.0, -1.0 if i == 2 else 0.0))
                unit = (1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0)
                add_along(s, 9, unit, (theta, vel, wind, square, rate, offset), dt)
                q = density_of_noise(s, 3 + i)
                P[twist + i, twist + i] += WANDER * offset_variance(s, 3 + i) * dt
            P[9 + i, 9 + i] += q * dt
