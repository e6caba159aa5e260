"""What all measurements of moving air have in common: the wind, the velocity through the air, the rows they share. It measures nothing.

A row of the air has five blocks, see `haltere.filter.update`: attitude, velocity, accelerometer bias, wind (with ln µ, which
follows it in a layout with drag) and what else the measurement depends on.

In a layout with drag the state is not the wind W but A = µW + c|W|W, the specific force that it has on a vehicle at hover. There drag
measures A, whatever µ and c are. With W as the state, the direction that stays unobserved, of more wind and less drag, would turn with
every change of the estimate, and the filter would believe that it learnt the drag from the turning; with A it is the same direction for
ever, and µ and c are learnt from the vehicle's own motion alone (theory.md §6, rule c).
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
    "calm",
    "core_blocks",
    "memory",
    "moves",
    "quadratic_block",
    "single",
    "wind_block",
    "wind_covariance",
    "wind_n",
    "wind_rows",
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
def calm(a_n: float, a_e: float, mu: float, c: float) -> tuple[float, float]:
    """Horizontal wind [m/s] whose specific force at hover is A [m/s^2]: |W| (µ + c|W|) = |A|, along A."""
    size = math.sqrt(a_n * a_n + a_e * a_e)
    k = 2.0 / (mu + math.sqrt(mu * mu + 4.0 * c * size))
    return k * a_n, k * a_e


@jit
def wind_n(s: Any) -> Vec:
    """Wind [m/s] in NED, where the air blows to; what is no state is zero."""
    n, e, d = 0.0, 0.0, 0.0
    if len(s.wind) > 0:
        n, e = s.wind[0], s.wind[1]
    if len(s.wind) > 2:
        d = s.wind[2]
    if len(s.drag) > 0:
        n, e = calm(n, e, math.exp(s.drag[0]), math.exp(s.drag[1]))
    return (n, e, d)


@jit
def by_push(s: Any, W: Vec) -> tuple[float, float, float]:
    """∂W/∂A where the state is A, a symmetric matrix: north-north, north-east, east-east; ((µ + c|W|) 1 + c W Wᵀ/|W|)⁻¹."""
    mu, c = math.exp(s.drag[0]), math.exp(s.drag[1])
    size = max(math.sqrt(W[0] * W[0] + W[1] * W[1]), 1e-9)
    k = c / size
    nn, ne, ee = mu + c * size + k * W[0] * W[0], k * W[0] * W[1], mu + c * size + k * W[1] * W[1]
    i = 1.0 / (nn * ee - ne * ne)
    return i * ee, -i * ne, i * nn


@jit
def wind_rows(s: Any, W: Vec) -> tuple[tuple[float, float, float, float], tuple[float, float, float, float]]:
    """Derivatives of the wind's north and east against the states A (2), ln µ and ln c."""
    nn, ne, ee = by_push(s, W)
    mu, c = math.exp(s.drag[0]), math.exp(s.drag[1]) * math.sqrt(W[0] * W[0] + W[1] * W[1])
    n, e = nn * W[0] + ne * W[1], ne * W[0] + ee * W[1]
    return (nn, ne, -mu * n, -c * n), (ne, ee, -mu * e, -c * e)


@jit
def quadratic(P: Any, o: int, a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    """aᵀ P b of the four states from ``o`` on."""
    out = 0.0
    for i in range(4):
        for j in range(4):
            out += a[i] * P[o + i, o + j] * b[j]
    return out


@jit
def wind_covariance(s: Any, P: Any) -> tuple[float, float, float, float, float, float]:
    """Upper triangle of the wind's covariance [m^2/s^2] out of one of the whole state, to first order; zero for what is no state."""
    o = 15 + len(s.baro) + len(s.mag)
    nn, ne, nd, ee, ed, dd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if len(s.wind) > 0:
        nn, ne, ee = P[o, o], P[o, o + 1], P[o + 1, o + 1]
    if len(s.wind) > 2:
        nd, ed, dd = P[o, o + 2], P[o + 1, o + 2], P[o + 2, o + 2]
    if len(s.drag) > 0:
        n, e = wind_rows(s, wind_n(s))
        nn, ne, ee = quadratic(P, o, n, n), quadratic(P, o, n, e), quadratic(P, o, e, e)
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
def wind_block(s: Any, e: Vec, by_mu: float) -> Block:
    """Block of the wind of a measurement with ∂h/∂v = e.

    ``by_mu`` is the derivative against ln µ at a constant wind.
    """
    o = 15 + len(s.baro) + len(s.mag)
    if len(s.drag) > 0:
        n, east = wind_rows(s, wind_n(s))
        return (o, (-e[0] * n[0] - e[1] * east[0], -e[0] * n[1] - e[1] * east[1], by_mu - e[0] * n[2] - e[1] * east[2]))
    if len(s.wind) == 3:
        return (o, (-e[0], -e[1], -e[2]))
    return (o, (-e[0], -e[1], 0.0))


@jit
def quadratic_block(s: Any, e: Vec) -> Block:
    """Block of ln c of a measurement with ∂h/∂v = e: what it changes by way of the wind, where the state is its force."""
    if len(s.drag) == 0:
        return NONE
    n, east = wind_rows(s, wind_n(s))
    return (15 + len(s.baro) + len(s.mag) + 1, (0.0, 0.0, -e[0] * n[3] - e[1] * east[3]))


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
