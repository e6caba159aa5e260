"""Field of the motors' currents: found from how the compass follows the battery current, and taken off. It fuses nothing.

Body field less the reference field turned by the attitude, and the current, are both freed of what is slower than a few seconds: a hard
iron and a wrong yaw go with it. What is left is regressed on the current, in each axis, with slow forgetting. Only a regression far beyond
chance is used. What is taken off is the field of the current beyond that at alignment: on the ground, with motors off, the compass was as
its calibration left it. Without a current nothing is done: thrust felt by the accelerometer follows a hand that turns the sensor, too.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids import compass
from haltere.core.rotation import Mat, Vec, norm, tmat_vec

__all__ = ["UNSURE", "cleaned", "forget", "hear", "learn", "unsure"]

#: Slowest variation that counts, memory of the regression [s], and how long a current is believed without a new sample [s].
SLOW, MEMORY, STALE = 5.0, 120.0, 1.0
#: The regression is used from this many sigma of its vector on, when it moves the field by this part of it, after this many seconds,
#: and dropped below half of that.
SIGMAS, WORTH, EARLIEST = 8.0, 0.01, 10.0
#: Residuals are alike for about this long [s]: samples within it are one.
ALIKE = 0.5
#: Part of the field by which a wrong attitude may turn it, 1 sigma, while the regression learns.
SETTLED = 0.1
#: Part of the field that a change of the current may move unseen.
UNSURE = 0.04


@jit
def forget(s: Any) -> None:
    """Begin anew: nothing is known of the motors' field."""
    i = s.motors
    i.used, i.known = 0, 0
    i.t_start, i.t_last, i.t_load, i.weight, i.sxx = s.t, s.t, -1e9, 0.0, 0.0
    for a in range(3):
        i.sxy[a], i.syy[a], i.k[a] = 0.0, 0.0, 0.0


@jit
def hear(s: Any, t: float, current: float) -> None:
    """Take a battery current [A]."""
    i = s.motors
    before = i.t_load
    i.change, i.current, i.t_load = current - i.current, current, t
    if unsure(s) > UNSURE * s.field[2]:
        compass.unsee(s, before)  # what was cleaned with a current that was no longer true


@jit
def use(s: Any, prm: Any, used: bool) -> None:
    """Begin or end to take the field off: the watch does not take that for a turn, and an offset that was found is open again."""
    s.motors.used, s.compass.seen = (1 if used else 0), 0
    o = 15 + len(s.baro)
    for i in range(len(s.mag)):
        s.P[o + i, o + i] += prm.init_mag_offset * prm.init_mag_offset


@jit
def learn(s: Any, prm: Any, t: float, m_b: Vec, h_n: Vec, C: Mat) -> None:
    """Take a magnetometer sample [uT, body], uncorrected, into the regression; ``h_n`` is the reference field [uT, NED].

    k = Σ u'y'/Σ u'² of the quick parts u', y' of load and field residual; its covariance from the residuals' variance, with as many
    independent ones as the time holds stretches of `ALIKE`.
    """
    i = s.motors
    if t - i.t_load > STALE:
        return
    if i.known == 0:
        i.known, i.reference, i.t_last = 1, i.current, -1e9
    unsettled = math.cos(s.field[1]) * compass.yaw_sd(s) + math.sqrt(compass.tilt_variance(s))
    if unsettled > SETTLED:  # an attitude that is being corrected moves the field, too
        return
    dt = t - i.t_last
    u = i.current
    h = tmat_vec(C, h_n)
    y = (m_b[0] - h[0], m_b[1] - h[1], m_b[2] - h[2])
    if dt > 1.0 or dt <= 0.0:
        i.t_last, i.mean_u = t, u
        for a in range(3):
            i.mean_y[a] = y[a]
        return
    i.t_last = t
    g = min(1.0, dt / SLOW)
    keep = math.exp(-dt / MEMORY)
    i.mean_u += g * (u - i.mean_u)
    x = u - i.mean_u
    i.weight = keep * i.weight + dt
    i.sxx = keep * i.sxx + dt * x * x
    noise, strength = 0.0, 0.0
    for a in range(3):
        i.mean_y[a] += g * (y[a] - i.mean_y[a])
        e = y[a] - i.mean_y[a]
        i.sxy[a] = keep * i.sxy[a] + dt * x * e
        i.syy[a] = keep * i.syy[a] + dt * e * e
    if not i.sxx > 0.0:
        return
    for a in range(3):
        i.k[a] = i.sxy[a] / i.sxx
        strength += i.k[a] * i.k[a]
        noise += max(i.syy[a] - i.k[a] * i.sxy[a], 0.0)
    independent = max(i.weight / ALIKE - 4.0, 1.0)
    variance = noise / (i.sxx * independent)  # of the three components together
    i.sd = math.sqrt(variance)
    spread = math.sqrt(i.sxx / max(i.weight, 1e-9))
    moved = math.sqrt(strength) * spread / norm(h_n)
    sure = strength > SIGMAS * SIGMAS * variance and moved > WORTH
    if i.used == 0 and sure and t - i.t_start > EARLIEST:
        use(s, prm, True)
    elif i.used == 1 and strength < 0.25 * SIGMAS * SIGMAS * variance:
        use(s, prm, False)


@jit
def unsure(s: Any) -> float:
    """Field [uT] that may be left because the current has changed since it was measured: as much as it did from the sample before."""
    i = s.motors
    if i.used == 0:
        return 0.0
    return norm((i.k[0], i.k[1], i.k[2])) * abs(i.change)


@jit
def cleaned(s: Any, m_b: Vec) -> Vec:
    """A magnetometer sample [uT, body] without the field of the motors' varying currents."""
    i = s.motors
    if i.used == 0:
        return m_b
    x = i.current - i.reference
    return (m_b[0] - i.k[0] * x, m_b[1] - i.k[1] * x, m_b[2] - i.k[2] * x)
