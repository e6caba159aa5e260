"""Barometer or compass against what the IMU carries on: what it is in this flight, and how much of late is more. It decides nothing.

Of a sample only what the sensor shows and the filter's own motion does not is left, whatever the filter has made of the sample: height less
integrated climb, heading less integrated turn, which over a second are good to centimetres and tenths of a degree. That is a level which
walks, and noise. The noise is measured between neighbours; the level walks as fast as makes what is left white, since weather, gusts on the
port, calibration and the motion's own error make of it what they like. Its innovations, over what they come to in this flight and less what
follows from the one before, go into a GLR over windows of 1 to 128 values, as those of a vehicle's model do (`haltere.diagnosis.pairs`).
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.filter.windows import empty, take

__all__ = ["JUMP_RING", "hear", "restart"]

#: Values that are looked back, in a plain number: it is a modulus, and the longest window.
JUMP_RING = constant(128)
#: Shortest time between two values [s]: samples that come faster are averaged. Longest, beyond which it begins anew.
BLOCK, APART = 0.035, 1.0
#: Memory of noise and of innovations in values, from how many on a lone one moves them only so far.
NOISE, LEARN, EARLY, LONE = 500.0, 1000.0, 60.0, 9.0
#: Values until it is known what is usual.
WARM = 80
#: In units that are told, of the order of a bad sensor's noise: least 1 sigma, walk of the level a root second.
LEAST, WALK = 0.02, 0.1
#: How fast a factor on the square of that walk follows the flight, a part a value, and its bounds.
QUICK, LEAST_SCALE, MOST_SCALE = 0.02, 1e-3, 1e3
#: Most correlation of neighbours that is taken out.
MOST_RHO = 0.9


@jit
def restart(h: Any) -> None:
    """Begin anew with the next sample; what is known of the noise stays."""
    h.n_values, h.n, h.total, h.filled, h.t_alarm, h.verdict, h.glr, h.z, h.fresh = 0, 0.0, 0.0, 0, 0.0, 0, 0.0, 0.0, 0
    empty(h.w)


@jit
def hear(h: Any, t: float, x: float, unit: float) -> None:
    """Take a sample. ``h.fresh`` says that it has made a value with a new GLR; while an alarm is pending none says what is usual.

    Parameters
    ----------
    h
        Record of the sensor.
    t
        Time [s].
    x
        The sensor less what the motion makes of it [m, rad].
    unit
        1 sigma before anything is known, likewise.
    """
    learns = h.t_alarm == 0.0
    if h.n_values > 0 and (t - h.t_value > APART or t < h.t_value):
        restart(h)
    h.total += x
    h.n += 1.0
    if h.n_values > 0 and t - h.t_value < BLOCK:
        return
    y = h.total / h.n
    dt = t - h.t_value if h.n_values > 0 else 0.0
    h.t_value, h.total, h.n = t, 0.0, 0.0
    i = h.filled % JUMP_RING
    h.d[i], h.t[i] = y, t
    h.filled += 1
    h.n_values += 1
    least = LEAST * LEAST * unit * unit
    if h.r <= 0.0:
        h.r, h.c0, h.c1, h.scale, h.known = unit * unit, unit * unit, 0.0, 1.0, 0.0
    if h.n_values == 1:
        h.level, h.P, h.before = y, h.r, y
        return
    if learns:
        h.known += 1.0
        step = 0.5 * (y - h.before) * (y - h.before)
        rate = 1.0 / min(h.known, NOISE)
        h.r = max(least, h.r + rate * ((min(step, LONE * h.r) if h.known > EARLY else step) - h.r))
    h.before = y
    h.q = WALK * WALK * unit * unit * h.scale
    h.P += h.q * dt
    S = h.P + h.r
    z, k = y - h.level, h.P / S
    h.level += k * z
    h.P *= 1.0 - k
    if learns and h.n_values > 2:
        rate = 1.0 / min(h.known, LEARN)
        product, square = z * h.z, z * z
        if h.known > EARLY:
            product, square = min(max(product, -LONE * h.c0), LONE * h.c0), min(square, LONE * h.c0)
        h.c0 = max(least, h.c0 + rate * (square - h.c0))
        h.c1 += rate * (product - h.c1)
        h.scale = min(max(h.scale * (1.0 + QUICK * max(min(product / h.c0, LONE), -LONE)), LEAST_SCALE), MOST_SCALE)
    h.z = z
    rho = min(max(h.c1 / h.c0, 0.0), MOST_RHO)
    h.glr = take(h.w, (z / math.sqrt(h.c0), 0.0, 0.0), 1, rho)
    h.fresh = 1 if h.known > WARM else 0
