"""Whether a change of specific force is the wind, or a force that the vehicle's model does not have: both are followed, and compared.

A force of the model, or an accelerometer's, is fixed in the body and along one axis. A wind that has changed by ΔW is fixed in the ground
frame while the vehicle turns (theory.md §5.5, rule 5), and is in all of the force that the model makes of the velocity through the air:
also along the thrust axis, by translational lift and inflow. The wind is held as it was before the change, since the filter's own follows.
Each is a small filter on the same blocks, beside one of nothing; its misfit is the sum of the squares of its innovations, which is that of
its best fit and of how far this is from what was to be expected. All have what the model is off by for seconds, what the wind before was
wrong by, which shows when the vehicle turns, and the part that the slopes by velocity are off by, which shows when it flies otherwise. A
wind along the axis of a force explains as well as the force. That it may come from everywhere, and would have come along an axis by
chance, is kept beside (`by_chance`): it is what tells in flight, and nothing to convict on where a vehicle hovers.

A trial that began for little may still be on when a fault comes. So a step at each of the last quarters of a second is matched, too, with
what the filter of nothing makes of it (`latest`): one that explains far more since then than all hypotheses begins the trial anew.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids.air import wind_n
from haltere.core.rotation import Vec, dcm, tmat_vec
from haltere.diagnosis.drifts import LASTS, lasting, walk_of
from haltere.diagnosis.pairs import sector, yaw
from haltere.strapdown.pairs import LATER
from haltere.vehicle.linear import linear

__all__ = ["NOTHING", "PUSH", "WIND", "again", "against_wind", "best", "by_chance", "by_old_wind", "follow", "held", "latest", "start"]

#: 1 sigma of a force and of a change of wind before anything is known [m/s^2, m/s]; how the wind walks meanwhile [m/s/sqrt(s)].
FORCE, CHANGE, WALK = 1.5, 4.0, 0.1
#: A vehicle that was slower [m/s] and turned by less [rad] hovers.
FAST, TURNED = 1.0, 0.2
#: Least 1 sigma of what a level before the change is off by [m/s^2].
LEAST = 0.03
#: 1 sigma of the part that a force's slope by velocity is off by.
SLOPE = 0.03
#: Most that the force along the thrust axis says of a wind against a force across: a wind of 2 m/s lifts by 0.15 m/s^2, and the model is
#: off by as much where the vehicle climbs faster.
BY_LIFT = 2.0
#: Time between later beginnings of a trial, and age of one that a fault of now is not in yet [s].
QUARTER, AGED = 0.25, 0.4
ZERO: Vec = (0.0, 0.0, 0.0)
#: Hypotheses, the first three of which are forces along x, y, z; states, and where they begin.
Z, WIND, NOTHING, TRIED, FORCES, STATES, OFF, PUSH, BEFORE, SLOPES = (constant(i) for i in (2, 3, 4, 5, 3, 11, 2, 5, 6, 8))


@jit
def start(s: Any) -> None:
    """Begin: nothing has changed yet, the wind is that of the mark before the alarm."""
    p = s.pairs[0]
    p.heading = p.m_yaw[p.mark]
    for i in range(2):
        p.wind[i] = p.m_wind[p.mark, i]
    for i in range(FORCES):
        p.level_before[i] = p.m_level[p.mark, i]
    begin(s, (p.m_var[p.mark, 0] + LEAST * LEAST, p.m_var[p.mark, 1] + LEAST * LEAST, p.m_var[p.mark, 2] + LEAST * LEAST))


@jit
def begin(s: Any, var: Vec) -> None:
    """Begin with a level before, and a variance of it, that are known."""
    p = s.pairs[0]
    p.trial, p.both, p.opened, p.moved = 1, 0, -1, 0.0
    air = through_air(s, p.wind[0], p.wind[1])
    for i in range(FORCES):
        p.air[i] = air[i]
    for h in range(TRIED):
        p.misfit[h], p.along_z[h], p.chance[h] = 0.0, 0.0, 0.0
        for j in range(STATES):
            p.tried[h, j] = 0.0
            for k in range(STATES):
                p.tried_P[h, j, k] = 0.0
        for i in range(FORCES):
            p.tried_P[h, OFF + i, OFF + i], p.tried_P[h, SLOPES + i, SLOPES + i] = var[i], SLOPE * SLOPE
        if h < FORCES:
            p.tried_P[h, PUSH, PUSH] = FORCE * FORCE
    for i in range(2):
        p.tried_P[WIND, i, i] = CHANGE * CHANGE
    for k in range(LATER):
        p.later[k] = -1.0
    p.t_later, p.n_later = s.t + QUARTER, 0


@jit
def again(s: Any, k: int) -> None:
    """Begin anew at the later beginning ``k``: what nothing predicted is what was there before."""
    p = s.pairs[0]
    for i in range(FORCES):
        p.level_before[i] += p.later_off[i, k]
    p.heading = yaw(s)
    begin(s, (p.later_var[0, k], p.later_var[1, k], p.later_var[2, k]))


@jit
def latest(s: Any) -> tuple[float, int, int, float]:
    """Of the steps at later beginnings the best: by how much it explains what came since better than all tried, axis, beginning, size."""
    p = s.pairs[0]
    most, axis, slot, size = 0.0, 0, -1, 0.0
    for k in range(LATER):
        if p.later[k] < 0.0:
            continue
        known = 1e18
        for h in range(TRIED):
            known = min(known, p.misfit[h] - p.later_fit[h, k])
        for i in range(FORCES):
            den = p.later_den[i, k] + 1.0 / (FORCE * FORCE)
            more = p.later_num[i, k] * p.later_num[i, k] / den + known - (p.misfit[NOTHING] - p.later_fit[NOTHING, k])
            if more > most:
                most, axis, slot, size = more, i, k, p.later_num[i, k] / den
    return most, axis, slot, size


@jit
def held(s: Any) -> int:
    """Latest of the later beginnings that a fault of now is not in yet; -1: none."""
    p = s.pairs[0]
    k, t = -1, -1.0
    for j in range(LATER):
        if p.trial == 1 and p.later[j] > t and p.later[j] < s.t - AGED:
            k, t = j, p.later[j]
    return k


@jit
def old_wind(s: Any, i: int) -> float:
    """Variance of the wind as the filter knows it, north or east [m^2/s^2]."""
    o = 15 + len(s.baro) + len(s.mag) + i
    per = math.exp(-s.drag[0]) if len(s.drag) > 0 else 1.0
    return float(s.P[o, o] * per * per)


@jit
def open_wind(s: Any) -> None:
    """Once the vehicle heads to where it has not headed before: the wind before may have been wrong by what the filter says."""
    p = s.pairs[0]
    p.opened = 0
    if len(s.wind) == 0 or (p.headings >> sector(yaw(s))) & 1 == 1:
        return
    p.opened = 1
    for h in range(TRIED):
        for i in range(2):
            p.tried_P[h, BEFORE + i, BEFORE + i] += old_wind(s, i)


@jit
def by_old_wind(s: Any, a: int) -> float:
    """1 sigma of the force along axis ``a`` that an error of the wind before makes, where a new heading has been turned to [m/s^2]."""
    p = s.pairs[0]
    if p.opened != 1 or a == Z or len(s.wind) == 0:
        return 0.0
    return float(abs(p.by_v[0, a, a]) * math.sqrt(0.5 * (old_wind(s, 0) + old_wind(s, 1))))


@jit
def through_air(s: Any, n: float, e: float) -> Vec:
    """Velocity through the air, body frame, in a wind of that north and east."""
    return tmat_vec(dcm((s.q[0], s.q[1], s.q[2], s.q[3])), (s.v[0] - n, s.v[1] - e, s.v[2]))


@jit
def white(s: Any, i: int, dt: float) -> float:
    """Variance of a block's residual as that of white noise with the same means over seconds [m^2/s^4]."""
    return float(s.pairs[0].r[i] + 2.0 * LASTS * lasting(s, i) / dt)


@jit
def follow(s: Any, dt: float) -> None:
    """Take the residuals of a block of length ``dt`` into all of the hypotheses."""
    p, m = s.pairs[0], s.model[0]
    air, now = through_air(s, p.wind[0], p.wind[1]), yaw(s)
    f_now = linear(m, s.speed, s.spin_up, (p.v_a[0], p.v_a[1], p.v_a[2]), ZERO, ZERO, p.ratio)[0]
    f_0, _, D_0, _, _, _ = linear(m, s.speed, s.spin_up, air, ZERO, ZERO, p.ratio)
    turned = math.atan2(math.sin(now - p.heading), math.cos(now - p.heading))
    p.moved = max(p.moved, math.sqrt(s.v[0] * s.v[0] + s.v[1] * s.v[1]) / FAST, abs(turned) / TURNED)
    first, second = p.tried[WIND, 0], p.tried[WIND, 1]
    f_w, _, D, _, _, _ = linear(m, s.speed, s.spin_up, through_air(s, p.wind[0] + first, p.wind[1] + second), ZERO, ZERO, p.ratio)
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    a, b = math.cos(p.heading - now), math.sin(p.heading - now)
    for i in range(2):
        p.tried_P[WIND, i, i] += WALK * WALK * dt
    for i in range(FORCES):
        p.follows[i] = f_now[i] - f_0[i]
        r, R, q = p.residual[i] - p.level_before[i] + p.follows[i], white(s, i, dt), walk_of(s, i) * dt
        for j in range(STATES):
            p.row[j] = 0.0
        p.row[OFF + i], p.row[SLOPES + i] = 1.0, D_0[i][i] * (air[i] - p.air[i])
        if p.opened < 0:
            p.along[i, 0], p.along[i, 1] = along(D_0[i], C, a, -b), along(D_0[i], C, b, a)
        p.row[BEFORE], p.row[BEFORE + 1] = p.along[i, 0] - along(D_0[i], C, 1.0, 0.0), p.along[i, 1] - along(D_0[i], C, 0.0, 1.0)
        for h in range(TRIED):
            p.tried_P[h, OFF + i, OFF + i] += q
            x = r
            p.row[0], p.row[1], p.row[PUSH] = 0.0, 0.0, 1.0 if h == i else 0.0
            if h == WIND:
                p.row[0], p.row[1] = -along(D[i], C, 1.0, 0.0), -along(D[i], C, 0.0, 1.0)
                x -= f_w[i] - f_0[i] - p.row[0] * first - p.row[1] * second
            S = R
            for j in range(STATES):
                x -= p.row[j] * p.tried[h, j]
                p.gain[j] = 0.0
                for k in range(STATES):
                    p.gain[j] += p.tried_P[h, j, k] * p.row[k]
                S += p.row[j] * p.gain[j]
            p.misfit[h] += x * x / S
            p.along_z[h] += x * x / S if i == Z else 0.0
            p.chance[h] += math.log(S)
            if h == NOTHING:
                match(p, i, x, S, 1.0 - R / S)
            for j in range(STATES):
                p.tried[h, j] += p.gain[j] / S * x
                for k in range(STATES):
                    p.tried_P[h, j, k] -= p.gain[j] * p.gain[k] / S
            if h == NOTHING and s.t >= p.t_later:
                keep(p, i, p.n_later % LATER)
    if p.opened != 1:
        open_wind(s)
    if s.t >= p.t_later:
        k = p.n_later % LATER
        p.n_later += 1
        p.t_later, p.later[k] = s.t + QUARTER, s.t
        W = wind_n(s)
        p.later_wind[0, k], p.later_wind[1, k] = W[0], W[1]
        for h in range(TRIED):
            p.later_fit[h, k] = p.misfit[h]


@jit
def along(slope: Vec, C: tuple[Vec, Vec, Vec], by_n: float, by_e: float) -> float:
    """Product of a force's slope by velocity, body frame, and a horizontal vector of the ground frame."""
    return (
        slope[0] * (by_n * C[0][0] + by_e * C[1][0])
        + slope[1] * (by_n * C[0][1] + by_e * C[1][1])
        + slope[2] * (by_n * C[0][2] + by_e * C[1][2])
    )


@jit
def match(p: Any, i: int, x: float, S: float, gain: float) -> None:
    """Take an innovation of nothing, of variance S, for that of a step along axis ``i`` at each of the later beginnings."""
    for k in range(LATER):
        e = 1.0 - p.followed[i, k]
        p.later_num[i, k] += e * x / S
        p.later_den[i, k] += e * e / S
        p.followed[i, k] += gain * e


@jit
def keep(p: Any, i: int, k: int) -> None:
    """Remember what nothing predicts of a force as later beginning ``k``."""
    value, var = 0.0, 0.0
    for j in range(STATES):
        value += p.row[j] * p.tried[NOTHING, j]
        for n in range(STATES):
            var += p.row[j] * p.tried_P[NOTHING, j, n] * p.row[n]
    p.later_off[i, k], p.later_var[i, k], p.later_level[i, k] = value, var, p.level_before[i] + value - p.follows[i]
    p.followed[i, k], p.later_num[i, k], p.later_den[i, k] = 0.0, 0.0, 0.0


@jit
def against_wind(p: Any, a: int) -> float:
    """How much better a force along axis ``a`` explains than a wind, in twice the log likelihood."""
    gap = p.misfit[WIND] - p.misfit[a]
    if a != Z:
        lift = p.along_z[WIND] - p.along_z[a]
        gap += min(max(lift, -BY_LIFT), BY_LIFT) - lift
    return float(gap)


@jit
def by_chance(s: Any, a: int) -> float:
    """What goes against a wind beside its misfit, that it would look like a force along axis ``a`` by chance, in the same measure.

    Twice the logarithm of the ratio of what of the two priors is left.
    """
    p = s.pairs[0]
    return float(p.chance[WIND] - p.chance[a])


@jit
def best(s: Any) -> int:
    """Axis of the force that explains most."""
    p = s.pairs[0]
    force = 0
    for h in range(FORCES):
        if p.misfit[h] < p.misfit[force]:
            force = h
    return force
