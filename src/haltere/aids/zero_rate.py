"""Zero angular rate at rest: the gyro shows its bias. Whether the vehicle rests is said elsewhere (aids.rest)."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.aids.fusing import ANY_TURN, HARD, NO_TIMEOUT, THREE, Offer, unit_rows
from haltere.aids.record import C_RATE, R_NONE
from haltere.core.rotation import Vec
from haltere.strapdown.layout import BG

__all__ = ["offer"]


@jit
def offer(s: Any, prm: Any, w: Vec) -> Offer:
    """Measured rate w = bias with ``noise.zero_rate`` (theory-amendments.md §8); w [rad/s], bias not removed."""
    r = prm.noise_zero_rate * prm.noise_zero_rate
    h = (s.bg[0], s.bg[1], s.bg[2])
    return THREE, C_RATE, w, h, (r, r, r), unit_rows(BG), prm.gate_zero_rate, NO_TIMEOUT, R_NONE, ANY_TURN, HARD
