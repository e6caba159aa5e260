"""Attitude told from outside (motion capture, another navigator): h, H, R, gate. It is fused only where the flight has such a stream."""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids.air import memory
from haltere.aids.fusing import ANY_TURN, RUNNING, THREE, Offer
from haltere.aids.record import ATTITUDE, C_ATTITUDE, R_NONE
from haltere.core.rotation import dcm, quat_from_rotvec, quat_mul
from haltere.filter.robust import IGG3
from haltere.filter.update import NONE
from haltere.strapdown.layout import THETA

__all__ = ["offer"]


@jit
def offer(s: Any, prm: Any, m: Any) -> Offer:
    """Attitude as a rotation vector of q_nb: the observation is the rotation from the estimate to it, in the body frame [rad].

    R is ``noise.attitude`` about the level axes and ``noise.attitude_yaw`` about the vertical; errors last ``noise.attitude_time``.
    """
    a = s.aid[ATTITUDE]
    if a.started == 0:
        a.started, a.t_passed = RUNNING, m.t
    q = (s.q[0], -s.q[1], -s.q[2], -s.q[3])
    d = quat_mul(q, quat_from_rotvec((m.z[0], m.z[1], m.z[2])))
    size = math.sqrt(d[1] * d[1] + d[2] * d[2] + d[3] * d[3])
    k = (2.0 * math.atan2(size, abs(d[0])) / size if size > 1e-12 else 2.0) * (1.0 if d[0] >= 0.0 else -1.0)
    z = (k * d[1], k * d[2], k * d[3])
    down = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2]
    level, yaw = prm.noise_attitude * prm.noise_attitude, prm.noise_attitude_yaw * prm.noise_attitude_yaw
    r = (
        level + (yaw - level) * down[0] * down[0],
        level + (yaw - level) * down[1] * down[1],
        level + (yaw - level) * down[2] * down[2],
    )
    H = (((THETA, (1.0, 0.0, 0.0)), NONE, NONE), ((THETA, (0.0, 1.0, 0.0)), NONE, NONE), ((THETA, (0.0, 0.0, 1.0)), NONE, NONE))
    shared = memory(s, ATTITUDE, m.t, prm.noise_attitude_time)
    robust = (IGG3, 2.5, 1.0, shared)
    return THREE, C_ATTITUDE, z, (0.0, 0.0, 0.0), r, H, prm.gate_attitude, prm.timeout_attitude, R_NONE, ANY_TURN, robust
