"""Angle of attack and sideslip from vanes with unknown offsets, and the assumption that there is no sideslip: h, H, R, gate, start."""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids.air import SILENT, AirOffer, air_velocity, core_blocks, memory, moves, quadratic_block, single, wind_block
from haltere.aids.fusing import ONE, RUNNING
from haltere.aids.record import AIRSPEED, C_AOA, C_SIDESLIP, R_NONE, VANES
from haltere.core.rotation import Vec, dcm, norm, wrap
from haltere.filter.robust import IGG3
from haltere.filter.update import NONE

__all__ = ["angle_of_attack", "offer", "offer_no_sideslip", "sideslip"]

TWO = constant(2)


@jit
def angle_of_attack(v_a: Vec) -> tuple[float, Vec]:
    """α = atan2(w, u) and its derivative against v_a (theory.md §1)."""
    k = 1.0 / max(v_a[0] * v_a[0] + v_a[2] * v_a[2], 1e-6)
    return math.atan2(v_a[2], v_a[0]), (-k * v_a[2], 0.0, k * v_a[0])


@jit
def sideslip(v_a: Vec) -> tuple[float, Vec]:
    """β = asin(v/V) and its derivative against v_a (theory.md §1)."""
    speed = max(norm(v_a), 1e-3)
    across = max(math.sqrt(v_a[0] * v_a[0] + v_a[2] * v_a[2]), 1e-3)
    sine = v_a[1] / speed
    k = sine / (speed * across)
    return math.asin(max(-1.0, min(1.0, sine))), (-k * v_a[0], 1.0 / across - k * v_a[1], -k * v_a[2])


@jit
def offer(s: Any, prm: Any, m: Any) -> AirOffer:
    """Both vanes: z = [α + α0, β + β0]. A vane turns with an error σ_V/V in the slow air (theory-amendments.md §11)."""
    if len(s.wind) == 0 or len(s.vane) < 3:
        return SILENT
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    v_a = air_velocity(s, C, (s.v[0], s.v[1], s.v[2]))
    speed = norm(v_a)
    a = s.aid[VANES]
    if a.started == 0:
        a.started, a.t_passed = RUNNING, m.t
    if speed < max(3.0 * prm.noise_airspeed, prm.air_airspeed_min):
        return SILENT
    alpha, da = angle_of_attack(v_a)
    beta, db = sideslip(v_a)
    o = 15 + len(s.baro) + len(s.mag) + len(s.wind) + len(s.drag) + len(s.steady)
    theta, vel, e = core_blocks(C, v_a, da)
    first = (theta, vel, quadratic_block(s, e), wind_block(s, e, 0.0), single(o + 1, 1.0))
    theta, vel, e = core_blocks(C, v_a, db)
    second = (theta, vel, quadratic_block(s, e), wind_block(s, e, 0.0), single(o + 2, 1.0))
    # the direction of a flow that is known to σ_V; that of its part in the plane of symmetry, for the angle of attack
    slow = prm.noise_airspeed / speed
    slow_alpha = prm.noise_airspeed / max(math.sqrt(v_a[0] * v_a[0] + v_a[2] * v_a[2]), 1e-3)
    shared = memory(s, VANES, m.t, prm.noise_airdata_time)
    r = (prm.noise_aoa * prm.noise_aoa + slow_alpha * slow_alpha, prm.noise_sideslip * prm.noise_sideslip + slow * slow, 1.0)
    h = (alpha + s.vane[1], beta + s.vane[2], 0.0)
    z = (h[0] + wrap(m.z[0] - h[0]), m.z[1], 0.0)  # backwards through the air it is half a turn, of either sign
    return TWO, C_AOA, z, h, r, (first, second, second), prm.gate_air, prm.timeout_air, R_NONE, moves(s, prm), (IGG3, 2.5, 1.0, shared)


@jit
def offer_no_sideslip(s: Any, prm: Any) -> AirOffer:
    """An aeroplane without vanes flies about straight through the air: β = 0 within ``noise.no_sideslip``, while its airspeed is heard."""
    if len(s.wind) == 0 or s.t - s.aid[AIRSPEED].t_passed > 1.0 or s.aid[AIRSPEED].started == 0:
        return SILENT
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    v_a = air_velocity(s, C, (s.v[0], s.v[1], s.v[2]))
    if v_a[0] < max(2.0 * prm.air_airspeed_min, 4.0 * abs(v_a[1])):
        return SILENT
    beta, d = sideslip(v_a)
    theta, vel, e = core_blocks(C, v_a, d)
    row = (theta, vel, quadratic_block(s, e), wind_block(s, e, 0.0), NONE)
    r = prm.noise_no_sideslip * prm.noise_no_sideslip
    shared = max(1.0, 2.0 * prm.noise_airdata_time / 0.2)
    z = (0.0, 0.0, 0.0)
    return (
        ONE,
        C_SIDESLIP,
        z,
        (beta, 0.0, 0.0),
        (r, r, r),
        (row, row, row),
        prm.gate_air,
        prm.timeout_air,
        R_NONE,
        moves(s, prm),
        (IGG3, 2.5, 1.0, shared),
    )
