"""Height by the barometer against height by the filter's own climb: what a barometer is in this flight, and how much of late is more.

Of a sample only the rise that the barometer shows and the filter's vertical velocity does not, D, is left, whatever the filter has made of
the sample: inertial and GNSS velocity carry a height over a second to some centimetres. D is a level that walks, and noise. The noise is
measured between neighbours; the level walks as fast as makes what is left white, since weather, gusts on the port and the velocity's own
error make of it what they like. Its innovations, over what they come to in this flight and less what follows from the one before, go into
a GLR over windows of 1 to 64 samples, as those of a vehicle's model do (`haltere.diagnosis.pairs`). It decides nothing.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.filter.windows import empty, take

__all__ = ["RISE_RING", "hear", "restart"]

#: Values that are looked back, in a plain number: it is a modulus, and the longest window.
RISE_RING = constant(64)

#: Shortest time between two values [s]: samples that come faster are averaged. Longest, beyond which it begins anew.
BLOCK, APART = 0.035, 1.0
#: Memory of noise and of innovations in values, the shortest of the latter, and how far a lone one may move them.
NOISE, LEARN, EARLY, LONE = 500.0, 1000.0, 60.0, 9.0
#: Values until it is known what is usual.
WARM = 80
#: Walk of the level [m/sqrt(s)], how fast a factor on its square follows the flight, a part a value, and the bounds of that.
WALK, QUICK, LEAST_SCALE, MOST_SCALE = 0.1, 0.02, 1e-3, 1e3
#: Least 1 sigma of a value [m], and 1 sigma before anything is known.
LEAST, UNKNOWN = 0.02, 1.0
#: Most correlation of neighbours that is taken out.
MOST_RHO = 0.9


@jit
def restart(b: Any) -> None:
    """Begin anew with the next sample; what is known of the noise stays."""
    h = b.height
    h.n_values, h.n, h.total, h.filled, h.t_alarm, h.verdict, h.glr, h.z = 0, 0.0, 0.0, 0, 0.0, 0, 0.0, 0.0
    empty(h.w)


@jit
def hear(b: Any, t: float, height: float) -> None:
    """Take a sample at ``t`` [s]: ``height`` by the barometer [m]. ``b.height.fresh`` says that it has made a value with a new GLR.

    It does not say what is usual while an alarm is pending.
    """
    h = b.height
    d, learns = height - h.climb, h.t_alarm == 0.0
    if h.n_values > 0 and (t - h.t_value > APART or t < h.t_value):
        restart(b)
    h.total += d
    h.n += 1.0
    if h.n_values > 0 and t - h.t_value < BLOCK:
        return
    y = h.total / h.n
    dt = t - h.t_value if h.n_values > 0 else 0.0
    h.t_value, h.total, h.n = t, 0.0, 0.0
    i = h.filled % RISE_RING
    h.d[i], h.t[i] = y, t
    h.filled += 1
    h.n_values += 1
    if h.r <= 0.0:
        h.r, h.c0, h.c1, h.scale, h.known = UNKNOWN * UNKNOWN, UNKNOWN * UNKNOWN, 0.0, 1.0, 0.0
    if h.n_values == 1:
        h.level, h.P, h.before = y, h.r, y
        return
    if learns:
        h.known += 1.0
        step = 0.5 * (y - h.before) * (y - h.before)
        rate = 1.0 / min(h.known, NOISE)
        h.r = max(LEAST * LEAST, h.r + rate * ((min(step, LONE * h.r) if h.known > EARLY else step) - h.r))
    h.before = y
    h.P += WALK * WALK * h.scale * dt
    S = h.P + h.r
    z, k = y - h.level, h.P / S
    h.level += k * z
    h.P *= 1.0 - k
    if learns and h.n_values > 2:
        rate = 1.0 / min(max(h.known, EARLY), LEARN)
        x = min(max(z * h.z, -LONE * h.c0), LONE * h.c0)
        h.c0 = max(LEAST * LEAST, h.c0 + rate * (min(z * z, LONE * h.c0) - h.c0))
        h.c1 += rate * (x - h.c1)
        h.scale = min(max(h.scale * (1.0 + QUICK * x / h.c0), LEAST_SCALE), MOST_SCALE)
    h.z = z
    rho = min(max(h.c1 / h.c0, 0.0), MOST_RHO)
    h.glr = take(h.w, (z / math.sqrt(h.c0), 0.0, 0.0), 1, rho)
    h.fresh = 1 if h.known > WARM else 0
