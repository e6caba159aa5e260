"""Barometric altitude with a slow offset as a state: h, H, R, gate, start. It corrects nothing for wind."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.aids.fusing import ANY_TURN, HARD, NOTHING, ONE, RUNNING, Offer
from haltere.aids.record import BAROMETER, C_ALTITUDE, FUSED, R_NONE, R_START, record
from haltere.filter.update import NONE
from haltere.strapdown.layout import LAST, POS

__all__ = ["offer"]


@jit
def offer(s: Any, prm: Any, m: Any, aids: Any) -> Offer:
    """Barometer: z = h - h_origin = -p_D + b_baro (theory-amendments.md §8). The first sample sets the offset (start).

    ``m.z[0]`` is the pressure altitude [m]. In a layout without the offset it stays at its start value.
    """
    z = m.z[0] - s.origin[2]
    a = s.aid[BAROMETER]
    if a.started == 0:
        a.started = RUNNING
        a.t_passed = m.t
        s.baro_start = z + s.p[2]
        for i in range(len(s.baro)):
            s.baro[i] = s.baro_start
            for j in range(s.P.shape[0]):
                s.P[15 + i, j] = 0.0
                s.P[j, 15 + i] = 0.0
            s.P[15 + i, 15 + i] = prm.init_baro_bias * prm.init_baro_bias
        record(s, aids, m.t, BAROMETER, C_ALTITUDE, z, 0.0, prm.init_baro_bias, 0.0, 1.0, FUSED, R_START)
        return NOTHING
    r = m.r[0] if m.r[0] >= 0.0 else prm.noise_barometer * prm.noise_barometer
    h = s.baro_start - s.p[2]
    row = ((POS, (0.0, 0.0, -1.0)), NONE, NONE)
    for i in range(len(s.baro)):
        h = s.baro[i] - s.p[2]
        row = ((POS, (0.0, 0.0, -1.0)), (LAST, (0.0, 0.0, 1.0)), NONE)
    return (
        ONE, C_ALTITUDE, (z, 0.0, 0.0), (h, 0.0, 0.0), (r, r, r), (row, row, row), prm.gate_barometer, prm.timeout_barometer, R_NONE,
        ANY_TURN, HARD,
    )  # fmt: skip
