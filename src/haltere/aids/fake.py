"""Fake position and fake velocity: weak pseudo-measurements that keep a filter bounded when nothing else holds it."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.aids.fusing import ANY_TURN, HARD, NO_GATE, NO_TIMEOUT, NO_TURN, THREE, ZEROS, Offer, unit_rows
from haltere.aids.record import C_POS, C_VEL, FAKE_POSITION, FAKE_VELOCITY, GNSS_POSITION, MAGNETOMETER, R_NONE
from haltere.strapdown.layout import POS, VEL

__all__ = ["blind_to_heading", "offer_position", "offer_velocity", "position_is_lost"]


@jit
def position_is_lost(s: Any) -> bool:
    """Start and stop condition: position was never fixed, or dead reckoning is worth nothing any more (1σ of v above 20 m/s)."""
    a = s.aid[GNSS_POSITION]
    never = a.started == 0
    return never or (s.P[3, 3] + s.P[4, 4] > 20.0**2 and s.t - a.t_passed > 10.0)


@jit
def turn_allowed(s: Any, prm: Any) -> int:
    """Whether an assumption may turn the heading: only while a compass holds it.

    An assumed velocity is wrong for longer than a filter believes, and its error is correlated with the heading's under every
    acceleration: a heading that nothing measures would soon be taken for known.
    """
    a = s.aid[MAGNETOMETER]
    return ANY_TURN if a.started > 0 and s.t - a.t_passed < prm.timeout_magnetometer else NO_TURN


@jit
def blind_to_heading(s: Any, prm: Any) -> bool:
    """Whether an assumption is due now that may not turn the heading: see `haltere.estimators.smoother`."""
    velocity = prm.aid_fake_velocity > 0.0 and s.t >= s.aid[FAKE_VELOCITY].t_due
    position = prm.aid_fake_position > 0.0 and s.t >= s.aid[FAKE_POSITION].t_due and position_is_lost(s)
    return (velocity or position) and turn_allowed(s, prm) == NO_TURN


@jit
def offer_position(s: Any, prm: Any, resting: bool) -> Offer:
    """Position stays where it last was: 1σ ``noise.fake_position`` in flight, ``noise.fake_position_rest`` at rest, no gate."""
    sd = prm.noise_fake_position_rest if resting else prm.noise_fake_position
    r = sd * sd
    z, h = (s.anchor[0], s.anchor[1], s.anchor[2]), (s.p[0], s.p[1], s.p[2])
    return THREE, C_POS, z, h, (r, r, r), unit_rows(POS), NO_GATE, NO_TIMEOUT, R_NONE, turn_allowed(s, prm), HARD


@jit
def offer_velocity(s: Any, prm: Any) -> Offer:
    """Velocity is zero within ``noise.fake_velocity``: what attitude alone knows of where down is (theory-amendments.md §8)."""
    r = prm.noise_fake_velocity * prm.noise_fake_velocity
    return THREE, C_VEL, ZEROS, (s.v[0], s.v[1], s.v[2]), (r, r, r), unit_rows(VEL), NO_GATE, NO_TIMEOUT, R_NONE, turn_allowed(s, prm), HARD
