"""Wind told from outside (a constant, a table, a station): h, H, R, gate. It measures no wind."""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit
from haltere.aids.air import SILENT, AirOffer, memory, moves, single, wind_n, wind_rows
from haltere.aids.fusing import RUNNING, THREE
from haltere.aids.record import C_WIND, R_NONE, WIND
from haltere.core.rotation import Vec
from haltere.filter.robust import IGG3
from haltere.filter.update import NONE

__all__ = ["offer"]

TWO = constant(2)
#: How long what a station says differs from the wind at the vehicle in the same way [s].
ALIKE = 10.0


@jit
def _row(s: Any, axis: int) -> Any:
    o = 15 + len(s.baro) + len(s.mag)
    if len(s.drag) > 0:
        n, e = wind_rows(s, wind_n(s))
        row = n if axis == 0 else e
        return (NONE, NONE, NONE, (o, (row[0], row[1], row[2])), single(o + 3, row[3]))
    return (NONE, NONE, NONE, single(o + min(axis, len(s.wind) - 1), 1.0), NONE)


@jit
def offer(s: Any, prm: Any, m: Any) -> AirOffer:
    """Wind: h = W, a component that is no state is not compared with."""
    if len(s.wind) == 0:
        return SILENT
    a = s.aid[WIND]
    if a.started == 0:
        a.started, a.t_passed = RUNNING, m.t
    n = TWO if len(s.wind) == 2 else THREE
    default = prm.noise_given_wind * prm.noise_given_wind
    r: Vec = (m.r[0] if m.r[0] > 0.0 else default, m.r[1] if m.r[1] > 0.0 else default, m.r[2] if m.r[2] > 0.0 else default)
    shared = memory(s, WIND, m.t, ALIKE)
    rows = (_row(s, 0), _row(s, 1), _row(s, 2))
    return (
        n,
        C_WIND,
        (m.z[0], m.z[1], m.z[2]),
        wind_n(s),
        r,
        rows,
        prm.gate_air,
        prm.timeout_air,
        R_NONE,
        moves(s, prm),
        (IGG3, 2.5, 1.0, shared),
    )
