"""Whether a change of specific force is the wind, or a force that the vehicle's model does not have: both are followed, and compared.

A force of the model, or an accelerometer's, is fixed in the body and along one axis. A wind that has changed by ΔW is fixed in the ground
frame while the vehicle turns (theory.md §5.5, rule 5), and is in all of the force that the model makes of the velocity through the air:
also along the thrust axis, by translational lift and inflow. The wind is held as it was before the change, since the filter's own follows.
Each is a small filter of its own on the same blocks; what it leaves is its misfit, in twice the negative log likelihood.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.core.rotation import Vec, dcm, tmat_vec
from haltere.diagnosis.stand_in import density_of_noise
from haltere.vehicle.linear import linear

__all__ = ["WIND", "best", "follow", "start"]

#: 1 sigma of a force and of a change of wind before anything is known [m/s^2, m/s]; how the wind walks meanwhile [m/s/sqrt(s)].
FORCE, CHANGE, WALK = 1.5, 4.0, 0.1
ZERO: Vec = (0.0, 0.0, 0.0)
WIND, FORCES = constant(3), constant(3)


@jit
def start(s: Any) -> None:
    """Begin: nothing has changed yet, the wind is that of the mark before the alarm."""
    p = s.pairs[0]
    p.trial = 1
    for i in range(4):
        p.misfit[i] = 0.0
    for i in range(3):
        p.push[i], p.push_var[i] = 0.0, FORCE * FORCE
    for i in range(2):
        p.blown[i], p.wind[i] = 0.0, p.m_wind[p.mark, i]
    p.blown_var[0], p.blown_var[1], p.blown_var[2] = CHANGE * CHANGE, 0.0, CHANGE * CHANGE


@jit
def through_air(s: Any, n: float, e: float) -> Vec:
    """Velocity through the air, body frame, in a wind of that north and east."""
    return tmat_vec(dcm((s.q[0], s.q[1], s.q[2], s.q[3])), (s.v[0] - n, s.v[1] - e, s.v[2]))


@jit
def left(p: Any, i: int, by_wind: float) -> float:
    """What the model leaves of a force, less what it left before, in the wind of before."""
    return float(p.residual[i] - p.m_level[p.mark, i] - by_wind)


@jit
def follow(s: Any, dt: float) -> None:
    """Take the residuals of a block of length ``dt`` into all of the hypotheses."""
    p, m = s.pairs[0], s.model[0]
    v = (p.v_a[0], p.v_a[1], p.v_a[2])
    f_now = linear(m, s.speed, s.spin_up, v, ZERO, ZERO, p.ratio)[0]
    f_0 = linear(m, s.speed, s.spin_up, through_air(s, p.wind[0], p.wind[1]), ZERO, ZERO, p.ratio)[0]
    r = (left(p, 0, f_0[0] - f_now[0]), left(p, 1, f_0[1] - f_now[1]), left(p, 2, f_0[2] - f_now[2]))
    R = (density_of_noise(s, 0) / dt, density_of_noise(s, 1) / dt, density_of_noise(s, 2) / dt)
    for h in range(FORCES):
        for i in range(3):
            if i != h:
                p.misfit[h] += r[i] * r[i] / R[i]
                continue
            S = p.push_var[h] + R[i]
            x = r[i] - p.push[h]
            p.misfit[h] += x * x / S + math.log(S / R[i])
            p.push[h] += p.push_var[h] / S * x
            p.push_var[h] *= R[i] / S
    n, e = p.wind[0] + p.blown[0], p.wind[1] + p.blown[1]
    f_w, _, D, _, _, _ = linear(m, s.speed, s.spin_up, through_air(s, n, e), ZERO, ZERO, p.ratio)
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    q = WALK * WALK * dt
    p.blown_var[0] += q
    p.blown_var[2] += q
    first, second = p.blown[0], p.blown[1]
    for i in range(3):
        h_n = -(D[i][0] * C[0][0] + D[i][1] * C[0][1] + D[i][2] * C[0][2])
        h_e = -(D[i][0] * C[1][0] + D[i][1] * C[1][1] + D[i][2] * C[1][2])
        x = r[i] - (f_w[i] - f_0[i]) - h_n * (p.blown[0] - first) - h_e * (p.blown[1] - second)
        k_n = p.blown_var[0] * h_n + p.blown_var[1] * h_e
        k_e = p.blown_var[1] * h_n + p.blown_var[2] * h_e
        S = h_n * k_n + h_e * k_e + R[i]
        p.misfit[WIND] += x * x / S + math.log(S / R[i])
        p.blown[0] += k_n / S * x
        p.blown[1] += k_e / S * x
        p.blown_var[0] -= k_n * k_n / S
        p.blown_var[1] -= k_n * k_e / S
        p.blown_var[2] -= k_e * k_e / S


@jit
def best(s: Any) -> int:
    """Axis of the force that explains most."""
    p = s.pairs[0]
    force = 0
    for h in range(FORCES):
        if p.misfit[h] < p.misfit[force]:
            force = h
    return force
