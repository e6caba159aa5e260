"""Zero velocity at rest, a pseudo-measurement. Whether the vehicle rests is said elsewhere (aids.rest)."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.aids.fusing import ANY_TURN, HARD, NO_TIMEOUT, THREE, ZEROS, Offer, unit_rows
from haltere.aids.record import C_VEL, R_NONE
from haltere.strapdown.layout import VEL

__all__ = ["offer"]


@jit
def offer(s: Any, prm: Any) -> Offer:
    """v = 0 with ``noise.zero_velocity`` (theory-amendments.md §8)."""
    r = prm.noise_zero_velocity * prm.noise_zero_velocity
    h = (s.v[0], s.v[1], s.v[2])
    return THREE, C_VEL, ZEROS, h, (r, r, r), unit_rows(VEL), prm.gate_zero_velocity, NO_TIMEOUT, R_NONE, ANY_TURN, HARD
