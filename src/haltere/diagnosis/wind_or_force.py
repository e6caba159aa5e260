"""Whether a change of specific force is the wind, or a force that the vehicle's model does not have: both are followed, and compared.

A force of the model, or an accelerometer's, is fixed in the body and along one axis. A wind that has changed by ΔW is fixed in the ground
frame while the vehicle turns (theory.md §5.5, rule 5), and is in all of the force that the model makes of the velocity through the air:
also along the thrust axis, by translational lift and inflow. The wind is held as it was before the change, since the filter's own follows.
Each is a small filter on the same blocks, with what the model is off by for seconds as states of its own; its misfit is the sum of the
squares of its innovations, which is that of its best fit and of how far this is from what was to be expected. A wind along the axis of a
force explains as well as the force. That it may come from everywhere, and would have come along an axis by chance, is kept beside
(`by_chance`): it is what tells in flight, and nothing to convict on where a vehicle hovers.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.core.rotation import Vec, dcm, tmat_vec
from haltere.diagnosis.drifts import LASTS, lasting, walk_of
from haltere.diagnosis.pairs import sector, yaw
from haltere.vehicle.linear import linear

__all__ = ["WIND", "best", "by_chance", "follow", "start"]

#: 1 sigma of a force and of a change of wind before anything is known [m/s^2, m/s]; how the wind walks meanwhile [m/s/sqrt(s)].
FORCE, CHANGE, WALK = 1.5, 4.0, 0.1
#: A vehicle that was slower [m/s] and turned by less [rad] hovers.
FAST, TURNED = 1.0, 0.2
#: Least 1 sigma of what a level before the change is off by [m/s^2].
LEAST = 0.03
ZERO: Vec = (0.0, 0.0, 0.0)
WIND, FORCES, STATES = constant(3), constant(3), constant(5)


@jit
def start(s: Any) -> None:
    """Begin: nothing has changed yet, the wind is that of the mark before the alarm."""
    p = s.pairs[0]
    p.trial, p.both = 1, 0
    for i in range(4):
        p.misfit[i], p.chance[i] = 0.0, 0.0
    p.moved, p.turned, p.heading = 0.0, 0.0, p.m_yaw[p.mark]
    turned = turn(s)
    for i in range(STATES):
        p.blown[i] = 0.0
        for j in range(STATES):
            p.blown_P[i, j] = 0.0
    for i in range(3):
        v = p.m_var[p.mark, i] + LEAST * LEAST + turned * by_old_wind(s, i)
        p.push[i], p.push_var[i], p.off[i], p.off_var[i] = 0.0, v + FORCE * FORCE, 0.0, v
        p.pushed[i], p.unpushed[i] = 0.0, 0.0
        p.blown_P[2 + i, 2 + i] = v
    for i in range(2):
        p.wind[i] = p.m_wind[p.mark, i]
        p.blown_P[i, i] = CHANGE * CHANGE


@jit
def by_old_wind(s: Any, i: int) -> float:
    """Variance of what a turn by 1 rad makes of the error of the wind before, which was taken for what the model is off by [m^2/s^4]."""
    p, o = s.pairs[0], 15 + len(s.baro) + len(s.mag)
    if i == FORCES - 1 or len(s.wind) == 0:
        return 0.0
    slope = p.by_v[0, i, i]
    if len(s.drag) > 0:
        slope /= math.exp(s.drag[0])
    return float(slope * slope * 0.5 * (s.P[o, o] + s.P[o + 1, o + 1]))


@jit
def turn(s: Any) -> float:
    """Take the heading; by how much the square of the largest turn since the mark has grown [rad^2], to where it has not headed before."""
    p, now = s.pairs[0], yaw(s)
    change = now - p.heading
    turned = min(abs(math.atan2(math.sin(change), math.cos(change))), 1.5)
    before = p.turned
    p.turned = max(p.turned, turned)
    p.moved = max(p.moved, math.sqrt(s.v[0] * s.v[0] + s.v[1] * s.v[1]) / FAST, turned / TURNED)
    return 0.0 if (p.headings >> sector(now)) & 1 == 1 else float(p.turned * p.turned - before * before)


@jit
def through_air(s: Any, n: float, e: float) -> Vec:
    """Velocity through the air, body frame, in a wind of that north and east."""
    return tmat_vec(dcm((s.q[0], s.q[1], s.q[2], s.q[3])), (s.v[0] - n, s.v[1] - e, s.v[2]))


@jit
def left(p: Any, i: int, by_wind: float) -> float:
    """What the model leaves of a force, less what it left before, in the wind of before."""
    return float(p.residual[i] - p.m_level[p.mark, i] - by_wind)


@jit
def white(s: Any, i: int, dt: float) -> float:
    """Variance of a block's residual as that of white noise with the same means over seconds [m^2/s^4]."""
    return float(s.pairs[0].r[i] + 2.0 * LASTS * lasting(s, i) / dt)


@jit
def follow(s: Any, dt: float) -> None:
    """Take the residuals of a block of length ``dt`` into all of the hypotheses."""
    p, m = s.pairs[0], s.model[0]
    v = (p.v_a[0], p.v_a[1], p.v_a[2])
    f_now = linear(m, s.speed, s.spin_up, v, ZERO, ZERO, p.ratio)[0]
    f_0 = linear(m, s.speed, s.spin_up, through_air(s, p.wind[0], p.wind[1]), ZERO, ZERO, p.ratio)[0]
    r = (left(p, 0, f_0[0] - f_now[0]), left(p, 1, f_0[1] - f_now[1]), left(p, 2, f_0[2] - f_now[2]))
    R = (white(s, 0, dt), white(s, 1, dt), white(s, 2, dt))
    turned = turn(s)
    for i in range(FORCES):  # with a force along the axis, and with no more than what the model is off by
        q = walk_of(s, i) * dt + turned * by_old_wind(s, i)
        p.push_var[i] += q
        S = p.push_var[i] + R[i]
        x = r[i] - p.push[i]
        p.pushed[i] += x * x / S
        p.chance[i] -= math.log(S)
        p.push[i] += p.push_var[i] / S * x
        p.push_var[i] *= R[i] / S
        p.off_var[i] += q
        S = p.off_var[i] + R[i]
        x = r[i] - p.off[i]
        p.unpushed[i] += x * x / S
        p.chance[i] += math.log(S)
        p.chance[WIND] -= math.log(S)
        p.off[i] += p.off_var[i] / S * x
        p.off_var[i] *= R[i] / S
        p.blown_P[2 + i, 2 + i] += q
    for h in range(FORCES):
        p.misfit[h] = p.unpushed[0] + p.unpushed[1] + p.unpushed[2] + p.pushed[h] - p.unpushed[h]
    first, second = p.blown[0], p.blown[1]
    f_w, _, D, _, _, _ = linear(m, s.speed, s.spin_up, through_air(s, p.wind[0] + first, p.wind[1] + second), ZERO, ZERO, p.ratio)
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    for i in range(2):
        p.blown_P[i, i] += WALK * WALK * dt
    for i in range(FORCES):
        h_n = -(D[i][0] * C[0][0] + D[i][1] * C[0][1] + D[i][2] * C[0][2])
        h_e = -(D[i][0] * C[1][0] + D[i][1] * C[1][1] + D[i][2] * C[1][2])
        x = r[i] - (f_w[i] - f_0[i]) - h_n * (p.blown[0] - first) - h_e * (p.blown[1] - second) - p.blown[2 + i]
        for j in range(STATES):
            p.gain[j] = p.blown_P[j, 0] * h_n + p.blown_P[j, 1] * h_e + p.blown_P[j, 2 + i]
        S = h_n * p.gain[0] + h_e * p.gain[1] + p.gain[2 + i] + R[i]
        p.misfit[WIND] += x * x / S
        p.chance[WIND] += math.log(S)
        for j in range(STATES):
            p.blown[j] += p.gain[j] / S * x
            for k in range(STATES):
                p.blown_P[j, k] -= p.gain[j] * p.gain[k] / S


@jit
def by_chance(s: Any, a: int) -> float:
    """What goes against a wind beside its misfit, that it would look like a force along axis ``a`` by chance, in the same measure.

    Twice the logarithm of the ratio of what of the two priors is left.
    """
    p = s.pairs[0]
    return float(p.chance[WIND] + p.chance[a])


@jit
def best(s: Any) -> int:
    """Axis of the force that explains most."""
    p = s.pairs[0]
    force = 0
    for h in range(FORCES):
        if p.misfit[h] < p.misfit[force]:
            force = h
    return force
