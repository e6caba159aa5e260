"""Heading as evidence: compass against gyro, whitened by what the compass is in this flight. It decides nothing.

A filter takes a compass for little: what surroundings and calibration add lasts, so that many samples are worth one. Its heading then is
what GNSS velocity makes of it and wanders by degrees, which is no news of any sensor. So the corrections that were made are taken off
again, of yaw and what those of the bias have turned since: what is left is heading by compass less heading by the gyro alone, white noise
of the compass upon an error that hardly changes. What changes is evidence.
So these y pass a filter of two states, offset and drift, y = o + n, do = r dt + w, dr = w', and so does every response of the
bank, since all is linear: what comes out is white (theory.md §5.7, theory-amendments.md §3). The variance of n is measured between
neighbours; w is the gyro's noise and scale, and what surroundings and, when the vehicle turns, calibration do to the compass: as much of
that as this flight shows, so that means over a second of what comes out are as white as its samples. The response of y to a fault is what
the tilt that it has put into the filter does to a levelled heading, and the turn that a gyro axis makes by itself: no correction is in it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere._jit import constant, jit
from haltere.core.rotation import Vec

__all__ = ["by_itself", "hear", "open_slot", "restart", "suppose"]

#: Memory of the white variance [s], from how many samples on it is known, its least [rad^2], and how far a lone one may move it.
MEMORY, KNOWN, LEAST, LONE = 20.0, 25.0, math.radians(0.3) ** 2, 9.0
#: Before it is known [rad^2].
UNKNOWN = math.radians(6.0) ** 2
#: Longest time between two samples [s].
APART = 1.0
#: 1 sigma of the drift at the start [rad/s].
DRIFT = math.radians(0.1)
#: Turns that follow each other within this time [s] are one.
TOGETHER = 2.0
#: What surroundings turn a compass by [rad/sqrt(s)], before the flight says what they do.
AROUND = math.radians(0.1)
#: Length of the means that are to be white [s], how late they are taken, so that a fault does not hide itself, the most that one counts,
#: how fast and how far they move the share of the compass' own turning.
BLOCK, LATE, MOST, FASTER, LEAST_SHARE, MOST_SHARE = 1.0, constant(8), 6.0, 0.1, 0.02, 100.0
#: Share at first: a compass is not believed before it has shown what it is; until this many means it is learnt faster.
AT_FIRST, NEW, SOONER = 4.0, constant(24), 0.3
#: A whitened one counts up to so many sigma, more by this factor of the one before; columns worked on together.
ALONE, FOLLOWED, WIDTH = 4.0, 1.2, 60


@jit
def restart(b: Any) -> None:
    """Begin anew at the next sample; what is known of the noise stays."""
    b.track.n = 0


@jit
def suppose(
    b: Any, gyro: float, scale: float, drift: float, calibration: float, w: Vec, down: Vec, dt: float, bias: Vec, unsure: float
) -> None:
    """Add to what heading and compass may have done by themselves since the last sample.

    What is off by a part of how far the vehicle has turned varies by that part squared, times the square of the turn: with a rate that is
    averaged over `TOGETHER` a turn by itself adds just that, and one that goes back at once next to nothing. How far it turns about the
    vertical the compass itself says (`hear`): a gyro that fails turns the estimate, not the vehicle.

    Parameters
    ----------
    gyro, scale, drift
        Density of the gyro's noise [rad/s/sqrt(Hz)], its error in proportion to the rate, walk of its bias [rad/s/sqrt(s)].
    calibration
        1 sigma of what a compass is off by more after one radian [rad].
    w, down
        Angular rate [rad/s] and the vertical, both in the body frame.
    dt
        Time [s].
    bias, unsure
        Bias of the gyro in use [rad/s], and the variance of what it turns about the vertical [rad^2/s^2].
    """
    k = b.track
    for i in range(3):
        if k.n == 0:
            k.bias[i] = bias[i]
        k.spun[i] += down[i] * dt
        k.by_bias += down[i] * (bias[i] - k.bias[i]) * dt
    if k.n == 0:
        k.unsure = unsure
    part = min(1.0, dt / TOGETHER)
    about = w[0] * down[0] + w[1] * down[1] + w[2] * down[2]
    k.about += part * (about - k.about)
    turned = k.about * k.about
    for i in range(3):
        k.w[i] += part * (w[i] - about * down[i] - k.w[i])
        turned += k.w[i] * k.w[i]
    turned *= 2.0 * TOGETHER
    share = k.share if k.share > 0.0 else AT_FIRST
    k.q += (gyro * gyro + scale * scale * turned + share * (AROUND * AROUND + calibration * calibration * turned)) * dt
    k.q_drift += drift * drift * dt


@jit
def open_slot(b: Any, k: int) -> None:
    """Let a slot's gyro axes begin to turn now."""
    for a in range(3):
        b.track.turned[k, a], b.track.ramped[k, a] = -b.track.spun[a], 0.0


@jit
def by_itself(b: Any, t: float, gyro: int, ramp: int) -> None:
    """Add to ``b.bearing`` what gyro axes turn by themselves: steps are the signatures from ``gyro`` on, ramps those from ``ramp`` on."""
    k = b.track
    slots = len(b.live)
    for i in range(slots):
        if b.live[i] == 1:
            middle = t - 0.5 * (t - k.t_spun) - b.onset[i]
            for a in range(3):
                k.turned[i, a] += k.spun[a]
                k.ramped[i, a] += k.spun[a] * max(middle, 0.0)
                b.bearing[(gyro + a) * slots + i] -= np.float32(k.turned[i, a])
                b.bearing[(ramp + a) * slots + i] -= np.float32(k.ramped[i, a])
    for a in range(3):
        k.spun[a] = 0.0
    k.t_spun = t


@jit
def begin(b: Any, t: float, y: float) -> None:
    """Take the first sample for the offset."""
    k = b.track
    if k.r == 0.0:
        k.r, k.share = UNKNOWN, AT_FIRST
    k.t, k.o, k.d, k.y, k.n = t, y, 0.0, y, 1
    k.oo, k.od, k.dd, k.last, k.q, k.q_drift = k.r, 0.0, max(DRIFT * DRIFT, k.unsure), 0.0, 0.0, 0.0
    k.total, k.samples, k.t_block = 0.0, 0.0, t
    for j in range(len(b.heading_o)):
        b.heading_o[j], b.heading_d[j] = b.bearing[j], 0.0


@jit
def measure(k: Any, t: float, y: float) -> None:
    """Take the change since the sample before into the white variance."""
    square = 0.5 * (y - k.y) * (y - k.y)
    k.known += 1.0
    rate = max(1.0 / k.known, min(1.0, (t - k.t) / MEMORY))
    k.r = max(LEAST, k.r + rate * ((min(square, LONE * k.r) if k.known > KNOWN else square) - k.r))


@jit
def adapt(k: Any, t: float, z: float) -> None:
    """Take a whitened innovation into how much of its own turning the compass shows, some means late."""
    k.total += z
    k.samples += 1.0
    if t - k.t_block < BLOCK:
        return
    i = k.blocks % LATE
    if k.blocks >= LATE:
        faster = SOONER if k.blocks < NEW else FASTER
        k.share = min(max(k.share * math.exp(faster * (min(k.late[i], MOST) - 1.0)), LEAST_SHARE), MOST_SHARE)
    k.late[i] = k.total * k.total / k.samples
    k.blocks += 1
    k.total, k.samples, k.t_block = 0.0, 0.0, t


@jit
def hear(b: Any, t: float, y: float) -> float:
    """Take heading by compass less that by the gyro alone, ``y`` [rad], whose responses are in ``b.bearing``, as evidence.

    Returns
    -------
    float
        Its whitened square as it counted; negative where nothing was to be judged.
    """
    k = b.track
    if k.n == 0 or t - k.t > APART or t <= k.t:
        begin(b, t, y)
        return -1.0
    measure(k, t, y)
    dt = t - k.t
    k.o += dt * k.d
    k.oo += dt * (2.0 * k.od + dt * k.dd) + k.q
    k.od += dt * k.dd
    k.dd += k.q_drift
    S = k.oo + k.r
    g_o, g_d = k.oo / S, k.od / S
    k.oo, k.od, k.dd = (1.0 - g_o) * k.oo, (1.0 - g_o) * k.od, k.dd - g_d * k.od
    left = y - k.o
    z = left / math.sqrt(S)
    share = min(1.0, (ALONE + FOLLOWED * abs(k.last)) / max(abs(z), 1e-9))
    k.last = share * z
    k.about += (dt * k.d + share * g_o * left) / TOGETHER
    k.o += share * g_o * left
    k.d += share * g_d * left
    k.t, k.y, k.q, k.q_drift = t, y, 0.0, 0.0
    k.n += 1
    adapt(k, t, share * z)
    weight = 0.0 if k.known < KNOWN else share * share / S
    o, d, e, num, den = b.heading_o, b.heading_d, b.bearing, b.heading_num, b.heading_den
    total_num, total_den = b.num, b.den
    step, go, gd = np.float32(dt), np.float32(share * g_o), np.float32(share * g_d)
    w4, z4 = np.float32(weight), np.float32(weight * left)
    for c in range(0, len(e), WIDTH):
        for j in range(c, c + WIDTH):
            before = o[j] + step * d[j]
            x = e[j] - before
            o[j] = before + go * x
            d[j] += gd * x
            num[j] += z4 * x
            den[j] += w4 * x * x
            total_num[j] += z4 * x
            total_den[j] += w4 * x * x
    return weight * left * left
