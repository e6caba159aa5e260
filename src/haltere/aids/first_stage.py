"""EKF A, the first of two stages: gravity in the body frame from IMU and GNSS velocity, without magnetometer. It holds no position.

Its states are those of (31), x = [q, v, b_g, b_a], as the errors of `strapdown.layout.STAGE` (local error state in place of the
published additive quaternion); its model is (30), its measurement (32)-(33). [C/R] of theory.md §4.3. The rows of position are
carried along, since prediction is that of the main state, and are measured by nothing: all other marginals are what they were
without them.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.aids.gnss import velocity_model, velocity_variance
from haltere.filter.gates import ABSENT, inflation, joint_nis, optimal_gain
from haltere.filter.update import apply, innovation
from haltere.strapdown.propagate import inject

__all__ = ["begin", "fuse_velocity", "sound"]


@jit
def begin(s: Any) -> None:
    """Start every first stage of ``s`` where the main state starts: same attitude, with its yaw, and same uncertainty.

    A wrong yaw, which GNSS velocity alone does not see at hover, would become a tilt error under acceleration (theory.md §6, rule g).
    """
    for k in range(len(s.a)):
        a = s.a[k]
        a.gravity, a.yaw_corrected = s.gravity, 0.0
        for i in range(4):
            a.q[i] = s.q[i]
        for i in range(3):
            a.v[i], a.p[i], a.bg[i], a.ba[i], a.w[i] = s.v[i], s.p[i], s.bg[i], s.ba[i], s.w[i]
        for i in range(a.P.shape[0]):
            a.dx[i] = 0.0
            for j in range(a.P.shape[0]):
                a.P[i, j] = s.P[i, j]


@jit
def fuse_velocity(a: Any, prm: Any, m: Any) -> None:
    """Fuse a GNSS velocity that the main state has let in: z = v_GNSS, h = v (32)-(33), at the antenna.

    Where its own innovation is beyond the gate, the variance is inflated until it is not: the stage is drawn to what the other one
    already believes, instead of being left behind.

    Parameters
    ----------
    a
        Record of the stage.
    prm
        Parameter record.
    m
        Measurement: velocity NED [m/s] and variances.
    """
    h, H, _ = velocity_model(a, prm)
    H0, H1, H2 = H
    r = velocity_variance(prm, m.r)
    ok0, ok1, ok2 = m.z[0] == m.z[0], m.z[1] == m.z[1], m.z[2] == m.z[2]
    e = (m.z[0] - h[0] if ok0 else 0.0, m.z[1] - h[1] if ok1 else 0.0, m.z[2] - h[2] if ok2 else 0.0)
    r = (r[0] if ok0 else ABSENT, r[1] if ok1 else ABSENT, r[2] if ok2 else ABSENT)
    nis, s_ii = joint_nis(a, H0, H1, H2, e, r)
    for i in range(3):
        row, r_i, e_i, s_i, ok = H0, r[0], e[0], s_ii[0], ok0
        if i == 1:
            row, r_i, e_i, s_i, ok = H1, r[1], e[1], s_ii[1], ok1
        elif i == 2:
            row, r_i, e_i, s_i, ok = H2, r[2], e[2], s_ii[2], ok2
        if ok:
            r_i = inflation(nis, prm.gate_gnss, s_i, r_i)
            optimal_gain(a, row, r_i)
            apply(a, row, r_i, innovation(a, row, e_i))
    inject(a)


@jit
def sound(a: Any) -> bool:
    """Whether every variance of the stage is positive and none beyond sense; what is not finite is not."""
    ok = True
    for i in range(a.P.shape[0]):
        ok = ok and a.P[i, i] > 0.0 and a.P[i, i] < 1e14
    return ok
