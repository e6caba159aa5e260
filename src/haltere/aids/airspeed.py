"""Airspeed with an unknown scale: h, H, R, gate, start. It corrects neither for static pressure nor for density."""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids.air import SILENT, AirOffer, air_velocity, core_blocks, memory, moves, quadratic_block, single, wind_block
from haltere.aids.fusing import ONE, RUNNING
from haltere.aids.record import AIRSPEED, C_AIRSPEED, R_NONE
from haltere.core.rotation import dcm, norm
from haltere.filter.robust import IGG3

__all__ = ["offer"]


@jit
def offer(s: Any, prm: Any, m: Any) -> AirOffer:
    """True airspeed: h = k |v - W| with ln k a state. Below ``air.airspeed_min`` nothing is said: a pitot tube measures pressure."""
    if len(s.wind) == 0 or len(s.vane) == 0 or not m.z[0] >= prm.air_airspeed_min:
        return SILENT
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    v_a = air_velocity(s, C, (s.v[0], s.v[1], s.v[2]))
    speed = norm(v_a)
    a = s.aid[AIRSPEED]
    if a.started == 0:
        a.started, a.t_passed = RUNNING, m.t
    if speed < 0.5:  # a speed of zero has no direction
        return SILENT
    k = math.exp(s.vane[0])
    h = k * speed
    theta, vel, e = core_blocks(C, v_a, (k * v_a[0] / speed, k * v_a[1] / speed, k * v_a[2] / speed))
    o = 15 + len(s.baro) + len(s.mag) + len(s.wind) + len(s.drag) + len(s.steady)
    row = (theta, vel, quadratic_block(s, e), wind_block(s, e, 0.0), single(o, h))
    r = m.r[0] if m.r[0] >= 0.0 else prm.noise_airspeed * prm.noise_airspeed
    shared = memory(s, AIRSPEED, m.t, prm.noise_airdata_time)
    z = (m.z[0], 0.0, 0.0)
    return (
        ONE,
        C_AIRSPEED,
        z,
        (h, 0.0, 0.0),
        (r, r, r),
        (row, row, row),
        prm.gate_air,
        prm.timeout_air,
        R_NONE,
        moves(s, prm),
        (IGG3, 2.5, 1.0, shared),
    )
