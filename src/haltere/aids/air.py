"""What all measurements of moving air have in common: the wind, the velocity through the air, the rows they share. It measures nothing.

A row of the air has five blocks, see `haltere.filter.update`: attitude, velocity, accelerometer bias, wind (with the state after it,
where the wind is horizontal) and what else the measurement depends on.

In a layout with drag the state is not W but µW, what the wind pushes the vehicle with. At a hover drag measures that product, whatever µ
is. With W as the state, the direction that stays unobserved, δW = -W δln µ, would turn with every change of the estimate, and the filter
would believe that it learnt µ from the turning; with µW it is the same direction for ever (theory.md §6, rule c).
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids.fusing import ANY_TURN, HARD, ONLY_AIR, ZERO, ZEROS, Robust
from haltere.aids.record import GNSS_VELOCITY
from haltere.core.rotation import Mat, Vec, cross, mat_vec, sub, tmat_vec
from haltere.filter.update import NONE, Block
from haltere.strapdown.layout import THETA, VEL

__all__ = [
    "SILENT",
    "AirOffer",
    "AirRow",
    "air_velocity",
    "core_blocks",
    "memory",
    "moves",
    "single",
    "wind_block",
    "wind_covariance",
    "wind_n",
]

AirRow = tuple[Block, Block, Block, Block, Block]
#: `haltere.aids.fusing.Offer` with rows of the air.
AirOffer = tuple[int, int, Vec, Vec, Vec, tuple[AirRow, AirRow, AirRow], float, float, int, int, Robust]
_NO_ROW = (NONE, NONE, NONE, NONE, NONE)
#: An offer of nothing.
SILENT = (
    ZERO, ZERO, ZEROS, ZEROS, ZEROS, (_NO_ROW, _NO_ROW, _NO_ROW), 1.0, 1.0, ZERO, ANY_TURN, HARD,
)  # fmt: skip
#: For how long after a GNSS velocity air data move nothing but the wind [s].
HELD = 2.0


@jit
def wind_n(s: Any) -> Vec:
    """Wind [m/s] in NED, where the air blows to; what is no state is zero."""
    n, e, d = 0.0, 0.0, 0.0
    if len(s.wind) > 0:
        n, e = s.wind[0], s.wind[1]
    if len(s.wind) > 2:
        d = s.wind[2]
    if len(s.drag) > 0:
        k = math.exp(-s.drag[0])
        n, e = k * n, k * e
    return (n, e, d)


@jit
def wind_covariance(s: Any, P: Any) -> tuple[float, float, float, float, float, float]:
    """Upper triangle of the wind's covariance [m^2/s^2] out of one of the whole state; zero for what is no state.

    Of µW and ln µ it is that of δW = δ(µW)/µ - W δln µ, to first order.
    """
    o = 15 + len(s.baro) + len(s.mag)
    nn, ne, nd, ee, ed, dd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if len(s.wind) > 0:
        nn, ne, ee = P[o, o], P[o, o + 1], P[o + 1, o + 1]
    if len(s.wind) > 2:
        nd, ed, dd = P[o, o + 2], P[o + 1, o + 2], P[o + 2, o + 2]
    if len(s.drag) > 0:
        W, k, m = wind_n(s), math.exp(-s.drag[0]), o + 2
        nn = k * k * nn - 2.0 * k * W[0] * P[o, m] + W[0] * W[0] * P[m, m]
        ne = k * k * ne - k * (W[1] * P[o, m] + W[0] * P[o + 1, m]) + W[0] * W[1] * P[m, m]
        ee = k * k * ee - 2.0 * k * W[1] * P[o + 1, m] + W[1] * W[1] * P[m, m]
    return (nn, ne, nd, ee, ed, dd)


@jit
def air_velocity(s: Any, C: Mat, v_n: Vec) -> Vec:
    """Velocity through the air in the body frame [m/s], Cᵀ (v - W) (theory.md §1)."""
    return tmat_vec(C, sub(v_n, wind_n(s)))


@jit
def core_blocks(C: Mat, v_a: Vec, d: Vec) -> tuple[Block, Block, Vec]:
    """Blocks of attitude and velocity of a measurement with ∂h/∂v_a = d (body), and ∂h/∂v = C d (theory.md §3.6)."""
    e = mat_vec(C, d)
    return (THETA, cross(d, v_a)), (VEL, e), e


@jit
def wind_block(s: Any, e: Vec, after: float) -> Block:
    """Block of the wind of a measurement with ∂h/∂v = e.

    ``after`` is the derivative against the state after a horizontal wind, at a constant wind: ln µ, else the airspeed's scale.
    """
    o = 15 + len(s.baro) + len(s.mag)
    if len(s.drag) > 0:
        k, W = math.exp(-s.drag[0]), wind_n(s)
        return (o, (-k * e[0], -k * e[1], after + e[0] * W[0] + e[1] * W[1]))
    if len(s.wind) == 3:
        return (o, (-e[0], -e[1], -e[2]))
    return (o, (-e[0], -e[1], after))


@jit
def single(column: int, h: float) -> Block:
    """A block of one column."""
    return (column - 2, (0.0, 0.0, h))


@jit
def moves(s: Any, prm: Any) -> int:
    """What air data may move: nothing but wind and coefficients while GNSS holds the rest, since a wrong model of the air is the rule."""
    a = s.aid[GNSS_VELOCITY]
    held = a.started > 0 and s.t - a.t_passed < HELD
    return ONLY_AIR if prm.air_moves == 0.0 and held else ANY_TURN


@jit
def memory(s: Any, sensor: int, t: float, lasting: float) -> float:
    """Factor on the variance of a sample whose error lasts ``lasting`` seconds, after the one before it; ``t_due`` keeps its time."""
    a = s.aid[sensor]
    since = t - a.t_due
    a.t_due = t
    return max(1.0, 2.0 * lasting / max(since, 1e-3))
