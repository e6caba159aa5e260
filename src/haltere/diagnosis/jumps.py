"""A step of barometer or compass against what the IMU carries on: when it alarms, and whether it was a step. It names no barometer.

`haltere.filter.jumping` says how much more than usual a sensor has changed. What stands out from this flight alarms, at the sample. A
second later it is settled what it was: a fault is there at once and stays; a gust on the port, the ground's air, a pressure that lags
behind a climb, a calibration that shows in a turn, a gyro that drifts take longer, or do not last. A barometer is named by
`haltere.diagnosis.inertial`, which asks whether something else explains it; a compass is put out by its watch.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids import compass
from haltere.diagnosis import doubt
from haltere.filter import jumping, usual
from haltere.filter.jumping import JUMP_RING

__all__ = ["LASTS", "compass_that_steps", "listen", "settled", "step_or_rise", "stepped"]

#: A change is looked into for so long [s] before it is settled, of a barometer and of a compass, and then kept for so long.
LASTS, LASTS_COMPASS, KEPT = 1.2, 0.8, 4.0
#: What was no step is no alarm again for so long [s].
NO_STEP_FOR = 2.0
#: How long [s] before its onset the level is taken, and how far the onset may be from where the window has it.
BEFORE, NEAR = 2.0, 0.3
#: How fast what is no step rises at the fastest [s], and slower ones that are set against it.
RISES = (0.5, 0.8, 1.2, 2.0, 5.0)
#: By how much a rise must explain better than a step, in squares of sigma, to be believed.
BETTER = 4.0
#: Part of its size that must still be there, and how sure [sigma] it must be that something is.
STANDS, SURE = 0.6, 4.0
#: An onset of the bank is on a grid; one of the same step is this near [s].
SAME = 0.3
STEP, NO_STEP = constant(1), constant(-1)
#: A compass' calibration shows over a turn of so long [s] at the most, in what looks like a step.
TURN = 0.1


@jit
def listen(h: Any, t: float, threshold: float, lasts: float) -> None:
    """After a value of `haltere.filter.jumping`: raise an alarm, settle one, or let it go."""
    if h.fresh == 0:
        return
    h.fresh = 0
    if h.t_alarm != 0.0:
        if h.verdict == 0 and t - h.t_alarm >= lasts:
            settle(h, lasts)
        if h.verdict == NO_STEP or t - h.t_alarm > KEPT:
            h.t_free = t + NO_STEP_FOR
            jumping.restart(h)
        return
    over = h.glr / threshold
    h.peak[0] = max(h.peak[0], over)
    if over > usual.raised(h, 0) and t >= h.t_free:
        h.t_alarm, h.verdict = t, 0
        h.onset = h.t[(h.filled - min(h.w.window, JUMP_RING)) % JUMP_RING]
        return
    usual.learn(h, t)


@jit
def compass_that_steps(s: Any, prm: Any) -> None:
    """Put the compass out where it has stepped by more than surroundings turn it, and calibration in the turn of that moment."""
    b, c = s.bank[0], s.compass
    h = b.course
    if b.course_healed != b.healed or c.out != 0 or not doubt.judged(s):  # what was taken back has turned it, and so do motors that start
        b.course_healed, c.pending = b.healed, 0
        jumping.restart(h)
        return
    listen(h, s.t, prm.diagnosis_threshold, LASTS_COMPASS)
    c.pending = 1 if h.t_alarm != 0.0 and h.verdict == 0 else 0
    if h.verdict != STEP:
        return
    k, rate = compass.moment(s, h.onset)
    limit = compass.allowed(s, prm) + prm.robust_calibration * rate * TURN / math.cos(s.field[1])
    seen, onset, size = h.t_alarm, h.onset, h.found
    h.t_free = s.t + NO_STEP_FOR
    jumping.restart(h)
    if abs(size) < limit or prm.aid_compass_watch == 0.0:
        return
    n = s.n_events
    compass.put_out(s, prm, k, compass.OUT_STEP, size, limit)
    if s.n_events > n:
        s.event[n].seen, s.event[n].onset = seen, onset


@jit
def left_by(h: Any, first: int, end: int, onset: float, rise: float) -> tuple[float, float]:
    """Squares that a change from ``onset`` on, complete after ``rise`` seconds, leaves of values ``first`` to ``end`` - 1, and its size."""
    n, sg, sgg, sy, sgy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    y0 = h.d[first % JUMP_RING]
    for i in range(first, end):
        x = h.t[i % JUMP_RING] - onset
        g = 0.0 if x < 0.0 else (1.0 if rise <= 0.0 else min(x / rise, 1.0))
        y = h.d[i % JUMP_RING] - y0
        n += 1.0
        sg += g
        sgg += g * g
        sy += y
        sgy += g * y
        syy += y * y
    vg = sgg - sg * sg / n
    if vg <= 1e-9:
        return 1e18, 0.0
    size = (sgy - sg * sy / n) / vg
    return syy - sy * sy / n - size * (sgy - sg * sy / n), size


@jit
def step_or_rise(h: Any, first: int, end: int, onset: float) -> tuple[float, float, float]:
    """By how many squares [m^2] the best rise leaves less than the best step near ``onset``; the step's size [m] and onset [s]."""
    step, rise, size, when = 1e18, 1e18, 0.0, onset
    for i in range(first + 2, end - 2):
        t = h.t[i % JUMP_RING]
        if abs(t - onset) <= NEAR:
            left, b = left_by(h, first, end, t, 0.0)
            if left < step:
                step, size, when = left, b, t
        if abs(t - onset) <= NEAR + RISES[4]:
            for k in range(len(RISES)):
                left, b = left_by(h, first, end, t, RISES[k])
                rise = min(rise, left)
    return step - rise, size, when


@jit
def settle(h: Any, lasts: float) -> None:
    """Say whether what alarmed was a step that stands, with its size and onset."""
    end = h.filled
    first = end
    while first > 0 and first > end - JUMP_RING and h.t[(first - 1) % JUMP_RING] > h.onset - BEFORE:
        first -= 1
    h.verdict = NO_STEP
    gain, size, when = step_or_rise(h, first, end, h.onset)
    before, n, after, m = 0.0, 0.0, 0.0, 0.0
    for i in range(first, end):
        t = h.t[i % JUMP_RING]
        if t < when:
            before += h.d[i % JUMP_RING]
            n += 1.0
        elif t > h.t[(end - 1) % JUMP_RING] - 0.5 * lasts:
            after += h.d[i % JUMP_RING]
            m += 1.0
    if n < 3.0 or m < 3.0 or gain > BETTER * h.r:
        return
    stands = after / m - before / n
    sure = stands * stands > SURE * SURE * (h.r * (1.0 / n + 1.0 / m) + h.q * lasts)
    if sure and stands * size > STANDS * size * size:
        h.verdict, h.found, h.onset = STEP, size, when


@jit
def stepped(h: Any, onset: float) -> bool:
    """Whether a sensor alarmed for a step near ``onset``, settled or not."""
    return bool(h.t_alarm != 0.0 and h.verdict != NO_STEP and abs(h.onset - onset) < SAME)


@jit
def settled(h: Any, onset: float) -> bool:
    """Whether it was found to be a step."""
    return bool(stepped(h, onset) and h.verdict == STEP)
