"""A step of the barometer against the height that the IMU carries on: when it alarms, and whether it was a step. It names nothing.

`haltere.filter.rising` says how much more than usual the barometer has changed. What stands out from this flight alarms, at the sample.
After a second it is settled what it was: a fault is there at once and stays; a gust on the port, the ground's air, a pressure that lags
behind a climb come and go in about a second, or do not last. `haltere.diagnosis.inertial` then asks whether something else explains it.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit
from haltere.filter import rising
from haltere.filter.rising import RISE_RING

__all__ = ["LASTS", "listen", "settled", "step_or_rise", "stepped"]

#: A change is looked into for so long [s] before it is settled, and then kept for so long.
LASTS, KEPT = 1.2, 4.0
#: How long [s] before its onset the level is taken, and how far the onset may be from where the window has it.
BEFORE, NEAR = 1.2, 0.3
#: How fast what is no step rises at the fastest [s], and slower ones that are set against it.
RISES = (0.5, 0.8, 1.2, 2.0)
#: By how much a rise must explain better than a step, in squares of sigma, to be believed: one of half a second in 20 times chance does.
BETTER = 4.0
#: Part of its size that must still be there.
STANDS = 0.6
#: An onset of the bank is on a grid; one of the same step is this near [s].
SAME = 0.3
#: The threshold is at least so many times what is usual; stretch [s], how fast that is learnt, its bound.
BEYOND_USUAL, STRETCH, RISE, FALL, CAP = 2.0, 10.0, 0.6, 0.1, 2.0
STEP, NO_STEP = constant(1), constant(-1)


@jit
def listen(s: Any, threshold: float) -> None:
    """After a value of `haltere.filter.rising`: raise an alarm, settle one, or let it go."""
    h = s.bank[0].height
    if h.fresh == 0:
        return
    h.fresh = 0
    if h.t_alarm != 0.0:
        if h.verdict == 0 and s.t - h.t_alarm >= LASTS:
            settle(h)
        if h.verdict == NO_STEP or s.t - h.t_alarm > KEPT:
            rising.restart(s.bank[0])
        return
    over = h.glr / threshold
    h.peak = max(h.peak, over)
    if over > max(1.0, BEYOND_USUAL * h.usual):
        h.t_alarm, h.verdict = s.t, 0
        h.onset = h.t[(h.filled - min(h.w.window, RISE_RING)) % RISE_RING]
        return
    if s.t >= h.t_usual:
        h.t_usual = s.t + STRETCH
        h.usual += (RISE if h.waiting > h.usual else FALL) * (h.waiting - h.usual)
        h.waiting = min(h.peak, CAP)
        h.peak = 0.0


@jit
def left_by(h: Any, first: int, end: int, onset: float, rise: float) -> tuple[float, float]:
    """Squares that a change from ``onset`` on, complete after ``rise`` seconds, leaves of values ``first`` to ``end`` - 1, and its size."""
    n, sg, sgg, sy, sgy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    y0 = h.d[first % RISE_RING]
    for i in range(first, end):
        x = h.t[i % RISE_RING] - onset
        g = 0.0 if x < 0.0 else (1.0 if rise <= 0.0 else min(x / rise, 1.0))
        y = h.d[i % RISE_RING] - y0
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
        t = h.t[i % RISE_RING]
        if abs(t - onset) <= NEAR:
            left, b = left_by(h, first, end, t, 0.0)
            if left < step:
                step, size, when = left, b, t
        if abs(t - onset) <= NEAR + RISES[3]:
            for k in range(4):
                left, b = left_by(h, first, end, t, RISES[k])
                rise = min(rise, left)
    return step - rise, size, when


@jit
def settle(h: Any) -> None:
    """Say whether what alarmed was a step that stands, with its size and onset."""
    end = h.filled
    first = end
    while first > 0 and first > end - RISE_RING and h.t[(first - 1) % RISE_RING] > h.onset - BEFORE:
        first -= 1
    h.verdict = NO_STEP
    gain, size, when = step_or_rise(h, first, end, h.onset)
    before, n, after, m = 0.0, 0.0, 0.0, 0.0
    for i in range(first, end):
        t = h.t[i % RISE_RING]
        if t < when:
            before += h.d[i % RISE_RING]
            n += 1.0
        elif t > h.t[(end - 1) % RISE_RING] - 0.5 * LASTS:
            after += h.d[i % RISE_RING]
            m += 1.0
    if n < 3.0 or m < 3.0 or gain > BETTER * h.r:
        return
    stands = after / m - before / n
    if stands * size > STANDS * size * size:
        h.verdict, h.size, h.onset = STEP, size, when


@jit
def stepped(b: Any, onset: float) -> bool:
    """Whether the barometer alarmed for a step near ``onset``, settled or not."""
    h = b.height
    return bool(h.t_alarm != 0.0 and h.verdict != NO_STEP and abs(h.onset - onset) < SAME)


@jit
def settled(b: Any, onset: float) -> bool:
    """Whether it was found to be a step."""
    return bool(stepped(b, onset) and b.height.verdict == STEP)
