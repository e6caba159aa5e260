"""Drag of a multirotor as a measurement of the wind: gathering, h, H, R, gate, and when it is in the air. It fits no vehicle.

Rotors in flight drag in proportion to their speed and to the velocity through the air, the body with its square (theory.md §5.2;
Martin and Salaün 2010): f = -µ s v_a - (ρ/ρ0) c |v_a| v_a + o + b_a along body x and y, with µ at hover in the standard atmosphere at sea
level and s what density and rotor speed make of it. The offset o is what the thrust's axis is askew to the accelerometer's.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids import rest
from haltere.aids.air import SILENT, AirOffer, air_velocity, calm, core_blocks, moves, wind_block, wind_rows
from haltere.aids.fusing import ANY_TURN, NO_GATE, ONLY_AIR, ONLY_WIND, RUNNING, WITH_DRAG
from haltere.aids.record import C_DRAG, DRAG, R_NONE
from haltere.core.earth import STANDARD_DENSITY, density
from haltere.core.rotation import Vec, dcm, dot, norm, quat_unit, tmat_vec
from haltere.filter.robust import PLAIN
from haltere.filter.update import project, variance
from haltere.strapdown.layout import BA

__all__ = ["airborne", "density_ratio", "drag_force", "forget", "gather", "hear", "offer", "spin"]

#: Thrust below this part of the weight drags otherwise, or not at all: free fall, landing.
LEAST_THRUST = 0.3
#: A vehicle that rose by so much [m], or is so fast [m/s], since it rested is in the air.
LIFTED, FAST = 1.5, 2.0
#: How long a rotor speed is believed [s], and how slowly its proportion to thrust is followed [samples at 10 Hz].
STALE, FOLLOW = 0.5, 200
#: Innovations beyond so many sigma are a step of the wind.
STEPPED = 3.5
#: Drag is learnt from motion faster than this [m/s], and by no other measurement: what a vehicle that hovers makes of gusts moves with
#: them, and would be taken for less drag.
LEARNT = 2.0
TWO = constant(2)


@jit
def forget(s: Any) -> None:
    """Begin anew, on the ground or in the air as alignment finds it."""
    a = s.air
    a.dt, a.airborne, a.level, a.t_rest, a.n_ratio, a.t_rotors = 0.0, 0, s.p[2], -1e9, 0, -1e9
    for i in range(3):
        a.f[i] = 0.0


@jit
def hear(s: Any, t: float, speed: float) -> None:
    """Take the sum of the rotors' speeds [rad/s]."""
    s.air.speed, s.air.t_rotors = speed, t


@jit
def gather(s: Any, f: Vec, dt: float) -> None:
    """Take the raw specific force [m/s^2] of an interval that ends now."""
    a = s.air
    if a.dt == 0.0:
        a.t = s.t - dt
        for i in range(3):
            a.v[i], a.f[i] = s.v[i], 0.0
        for i in range(4):
            a.q[i] = s.q[i]
    a.dt += dt
    for i in range(3):
        a.f[i] += f[i] * dt


@jit
def airborne(s: Any, prm: Any, w: Vec, f: Vec) -> bool:
    """In the air: it has risen or is fast since it last rested, or was never seen at rest."""
    a = s.air
    if rest.at_rest(s, prm, w, f):
        a.airborne, a.level, a.t_rest = 0, s.p[2], s.t
    elif a.airborne == 0:
        speed2 = s.v[0] * s.v[0] + s.v[1] * s.v[1] + s.v[2] * s.v[2]
        never = a.t_rest < 0.0 and s.align.kind != 1 and s.t - s.t_aligned > 2.0
        if abs(s.p[2] - a.level) > LIFTED or speed2 > FAST * FAST or never:
            a.airborne = 1
    if a.airborne == 0:
        a.dt = 0.0  # nothing of the ground is kept
    return a.airborne == 1


@jit
def density_ratio(s: Any, prm: Any) -> float:
    """Air density over that of the standard atmosphere at sea level."""
    if prm.air_density > 0.0:
        return prm.air_density / STANDARD_DENSITY * density(s.origin[2] - s.p[2]) / density(s.origin[2])
    return density(s.origin[2] - s.p[2]) / STANDARD_DENSITY


@jit
def spin(s: Any, thrust: float, ratio: float) -> float:
    """What density and the rotors' speed make of µ: (ρ/ρ0) ΣΩ over its value at hover there.

    Without the speeds they follow from thrust T a mass: T ~ ρ (ΣΩ)², so that it is sqrt(ρ/ρ0 T/g). With them, the proportion of
    the two is learnt slowly from the flight, and what is quick is left to the speeds: inflow, climb.
    """
    a = s.air
    if s.t - a.t_rotors < STALE and a.speed > 0.0:
        found = a.speed * math.sqrt(ratio / thrust)
        if a.n_ratio == 0:
            a.ratio = found
        a.n_ratio = min(a.n_ratio + 1, FOLLOW)
        a.ratio += (found - a.ratio) / a.n_ratio
        if a.n_ratio > 10:
            return ratio * a.speed / (a.ratio * math.sqrt(s.gravity))
    return math.sqrt(ratio * thrust / s.gravity)


@jit
def drag_force(v_a: Vec, mu: float, c: float) -> Vec:
    """Drag per mass along the body's axes [m/s^2] of a velocity through the air, with µ [1/s] and c [1/m] as they are here and now."""
    k = -mu - c * norm(v_a)
    return (k * v_a[0], k * v_a[1], k * v_a[2])


@jit
def offer(s: Any, prm: Any) -> AirOffer:
    """Specific force along body x and y, the mean since the last time, at the middle of that time."""
    a = s.air
    dt = a.dt
    a.dt = 0.0
    if len(s.drag) == 0 or dt < 0.03 or a.airborne == 0:
        return SILENT
    f = (a.f[0] / dt, a.f[1] / dt, a.f[2] / dt)
    thrust = s.ba[2] - f[2]
    if thrust < LEAST_THRUST * s.gravity:
        return SILENT
    t = s.t - 0.5 * dt
    if s.aid[DRAG].started == 0:
        s.aid[DRAG].started, s.aid[DRAG].t_passed = RUNNING, t
    same = 1.0 if a.q[0] * s.q[0] + a.q[1] * s.q[1] + a.q[2] * s.q[2] + a.q[3] * s.q[3] >= 0.0 else -1.0
    C = dcm(quat_unit((s.q[0] + same * a.q[0], s.q[1] + same * a.q[1], s.q[2] + same * a.q[2], s.q[3] + same * a.q[3])))
    v_a = air_velocity(s, C, (0.5 * (s.v[0] + a.v[0]), 0.5 * (s.v[1] + a.v[1]), 0.5 * (s.v[2] + a.v[2])))
    ratio = density_ratio(s, prm)
    mu, c = math.exp(s.drag[0]) * spin(s, thrust, ratio), ratio * math.exp(s.drag[1])
    speed = norm(v_a)
    drag = drag_force(v_a, mu, c)
    h = (drag[0] + s.drag[2] + s.ba[0], drag[1] + s.drag[3] + s.ba[1], 0.0)
    n, e = calm(s.steady[0], s.steady[1], math.exp(s.drag[0]), math.exp(s.drag[1]))
    v_c = tmat_vec(C, (0.5 * (s.v[0] + a.v[0]) - n, 0.5 * (s.v[1] + a.v[1]) - e, 0.5 * (s.v[2] + a.v[2])))
    by_c = _by_c(s, C, v_c, (n, e, 0.0), mu, c)
    first, second = _row(s, C, v_a, speed, mu, c, by_c[0], 0), _row(s, C, v_a, speed, mu, c, by_c[1], 1)
    r = prm.noise_drag * prm.noise_drag
    shared = max(1.0, 2.0 * prm.noise_drag_time / dt)
    robust = (PLAIN, NO_GATE, 1.0, shared)
    alone, slow = moves(s, prm) == ONLY_AIR, s.v[0] * s.v[0] + s.v[1] * s.v[1] < LEARNT * LEARNT
    turn = (ONLY_WIND if slow else ONLY_AIR) if alone else (ANY_TURN if slow else WITH_DRAG)
    z = (f[0], f[1], 0.0)
    widen(s, first, second, (f[0] - h[0], f[1] - h[1]), r)
    rows = (first, second, second)
    return TWO, C_DRAG, z, h, (r, r, 1.0), rows, prm.gate_drag, prm.timeout_drag, R_NONE, turn, robust


@jit
def widen(s: Any, first: Any, second: Any, e: tuple[float, float], r: float) -> None:
    """Let wind and mean wind go where drag says when an innovation is beyond what gusts explain: the wind has stepped.

    The innovation's own square is added to their variances, as of one change of both.
    """
    project(s, first)
    beyond = e[0] * e[0] > STEPPED * STEPPED * (variance(s, first) + r)
    project(s, second)
    beyond = beyond or e[1] * e[1] > STEPPED * STEPPED * (variance(s, second) + r)
    if beyond:
        P, o = s.P, 15 + len(s.baro) + len(s.mag)
        m, more = o + len(s.wind) + len(s.drag), e[0] * e[0] + e[1] * e[1]
        for i in range(2):
            P[o + i, o + i] += more
            P[m + i, m + i] += more
            P[o + i, m + i] += more
            P[m + i, o + i] += more


@jit
def _by_c(s: Any, C: tuple[Vec, Vec, Vec], v_a: Vec, W: Vec, mu: float, c: float) -> tuple[float, float]:
    """Derivatives of drag along body x and y against ln c at a constant A, in the mean wind ``W``.

    In the wind as it is just estimated they would follow the noise that the innovation holds too, and c would be found from that.
    """
    speed = norm(v_a)
    n, e = wind_rows(s, W)
    u = tmat_vec(C, (n[3], e[3], 0.0))
    k = c * dot(v_a, u) / max(speed, 1e-6)
    along = mu + c * speed
    return along * u[0] + k * v_a[0] - c * speed * v_a[0], along * u[1] + k * v_a[1] - c * speed * v_a[1]


@jit
def _row(s: Any, C: tuple[Vec, Vec, Vec], v_a: Vec, speed: float, mu: float, c: float, by_c: float, axis: int) -> Any:
    """Row of drag along a body axis (0: x, 1: y), see `haltere.aids.air`."""
    k = c * v_a[axis] / max(speed, 1e-6)
    on = -mu - c * speed
    d = (on - k * v_a[0] if axis == 0 else -k * v_a[0], on - k * v_a[1] if axis == 1 else -k * v_a[1], -k * v_a[2])
    theta, vel, e = core_blocks(C, v_a, d)
    x, y = (1.0, 0.0) if axis == 0 else (0.0, 1.0)
    o = 15 + len(s.baro) + len(s.mag) + len(s.wind)
    coefficients = (o + 1, (by_c, x, y))
    return (theta, vel, (BA, (x, y, 0.0)), wind_block(s, e, -mu * v_a[axis]), coefficients)
