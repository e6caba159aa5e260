"""A compass that its watch has put out since it turns, when it is the gyro that turns. It raises no alarm.

A compass that turns against the gyro (`haltere.aids.compass`) is a disturbance, or the gyro's vertical axis: a step in the raw rate of the
same size and time says the gyro, and so does a turn that goes on at the same rate further than a disturbance swings.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids import compass
from haltere.aids.record import E_FAULT, NO_SENSOR, event_since
from haltere.diagnosis.steps import LARGE, extreme, shown
from haltere.filter.signatures import GYRO, SLOTS

__all__ = ["gyro_that_turns"]

#: A turn that goes on: this far [rad], so many times as long as when it was noticed, at the same rate within this part, at least this fast:
#: a field that creeps turns a compass slower, and not as far.
FAR, LONGER, SAME, SLOWEST = math.radians(60.0), 2.0, 0.25, math.radians(4.0)
#: From this part of a threshold on something may have tilted the attitude.
TILTED = 0.35


@jit
def gyro_that_turns(s: Any) -> int:
    """Slot of the onset of a fault of gyro z that turns the compass, -1 if there is none; its event is left, its size in ``b.turn``."""
    b, c = s.bank[0], s.compass
    if c.out != compass.OUT_TURN:
        b.t_turn = -1.0
        return -1
    lasted = c.t_last - c.onset
    if lasted < 0.3 or b.ratio > TILTED:  # a tilt turns the levelled heading, too
        return -1
    rate = (c.last - c.level) / lasted
    first = b.t_turn != c.onset
    if first:
        b.t_turn, b.turn_rate, b.turn_lasted = c.onset, rate, lasted
    step = first and shown(b, 2, -rate, c.onset - 0.6, c.onset + 0.4)
    if step:  # a larger one was looked at by itself, and is the vehicle's
        z, _ = extreme(b.step, 2, -rate, c.onset - 0.6, c.onset + 0.4)
        step = z < LARGE + 2.0
    on = lasted > LONGER * b.turn_lasted and abs(c.last - c.level) > FAR and abs(rate) > SLOWEST
    if not step and not (on and abs(rate - b.turn_rate) < SAME * abs(rate)):
        return -1
    best, near = -1, 1e18
    for k in range(len(b.live)):
        if b.live[k] == 1 and abs(b.onset[k] - c.onset) < near:
            best, near = k, abs(b.onset[k] - c.onset)
    if best < 0 or near > 0.5 + 0.2 * lasted:
        return -1
    b.turn = -rate
    n = s.n_events
    event_since(s, s.t, b.onset[best], E_FAULT, NO_SENSOR, abs(c.last - c.level), FAR, GYRO + 2)
    if s.n_events > n:
        e = s.event[n]
        e.seen, e.size, e.sd, e.candidates = s.t, -rate, 0.1 * abs(rate), 4
    j = (GYRO + 2) * SLOTS + best
    b.den[j] = 1.0 / (0.1 * rate * 0.1 * rate)
    b.num[j] = -rate * b.den[j]
    return best
