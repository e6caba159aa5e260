"""What the raw samples of an IMU show by themselves: a step that no torque makes, an axis that is stuck, lost, at its end, or rough.

A rate is the integral of what rotors and air can do: over three samples it changes little. A gyro that fails by a step changes between two
samples and then stays (theory-amendments.md §3, §17). Six samples after are set against six before, with one between them left out. What
is large is measured by the flight's own: the mean square of differences over two samples, which holds noise, vibration and motion. A step
is told when it stands out from that, both halves are level within it, and neither the other axes nor the accelerometer notice anything.
No filter is asked, so that a step is named within some hundredths of a second; what it did to the state in that time is taken back.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids import compass
from haltere.aids.record import E_FAULT, E_OVER, NO_SENSOR, event_since
from haltere.core.rotation import Vec, dcm
from haltere.diagnosis import doubt
from haltere.filter.signatures import clear
from haltere.strapdown.bank import STEP_HISTORY, STEP_RING
from haltere.strapdown.propagate import inject

__all__ = ["DEATHS", "DROPOUT", "NOISE", "SATURATE", "STEP", "STUCK", "forget", "refuted", "shown", "watch"]

#: Samples of each half of a step; shortest and longest interval at which steps can be told from motion [s].
HALF, SHORTEST, LONGEST = 6, 2e-4, 5.2e-3
#: Memory of the differences' mean square where it falls and where it rises [s], from how many samples on it is known, and how far a
#: lone one may move it.
MEMORY, ALERT, WARM, LONE = 2.0, 0.5, 250, 9.0
#: A step in sigma; what the other gyro axes may show of it, and the accelerometer [sigma]; how level the halves are (of 10 degrees of
#: freedom), and by how much a step must fit better than a straight line, in variances.
LARGE, ASIDE, QUIET, LEVEL, BETTER = 9.0, 0.4, 6.0, 2.3, 18.0
#: Square of a specific force beside the half before, of 3 degrees of freedom, that is a shock.
SHOCK = 20.0
#: Motors carry the vehicle at a specific force from here on [m/s^2]; rotors that are braked or driven turn it at once (§19).
CARRIED = 4.9
#: After rest steps are not looked for during this time [s].
SPIN_UP = 2.0
#: Part of a step that its size may be off by, 1 sigma.
UNSURE = 0.2
#: Intervals of the history of steps [s].
INTERVAL = 0.25
#: A hypothesis of a step this large [sigma] must show; it does with half of its size.
MUST, HALF_SEEN = 8.0, 0.5
#: Codes of an event, above those of signatures: what is wrong, six channels each.
STEP, STUCK, DROPOUT, SATURATE, NOISE = (constant(i) for i in (20, 26, 32, 38, 44))
DEATHS = {"stuck": int(STUCK), "dropout": int(DROPOUT), "saturate": int(SATURATE), "noise": int(NOISE)}
#: A value held for so many samples, for so long [s], and so many times longer than ever before is stuck; at the end of a range, so many.
HELD, HELD_TIME, HELD_RATIO, HELD_END = 10, 0.1, 4, 4
#: What may be the end of a range at all [rad/s, m/s^2].
END_GYRO, END_ACCEL = 4.0, 35.0
#: Roughness: memories [s], ratio of the mean squares, how much more than the other axes, for how long [s].
LATELY, EVER, ROUGH, ALONE_ROUGH, ROUGH_TIME = 0.2, 10.0, 9.0, 6.0, 1.0
#: Where samples are further apart [s], second differences are motion.
COARSE = 0.012
#: Least rate and force [rad/s, m/s^2] that an axis may have had unseen, and for how long that is alike [s].
UNSEEN_RATE, UNSEEN_FORCE, ALIKE = 0.3, 1.5, 0.3


@jit
def forget(b: Any) -> None:
    """Begin anew: after a gap, at alignment. What is known of noise and range stays."""
    d = b.step
    d.filled = 0
    for i in range(STEP_HISTORY):
        d.h_t[i] = -1e9
    for c in range(6):
        d.after[c], d.before[c], d.z[c], d.low[c], d.high[c], d.run[c], d.wrong[c], d.t_rough[c] = 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, -1.0


@jit
def scale(d: Any, c: int) -> float:
    """1 sigma of the difference of two halves from noise, of one channel."""
    return math.sqrt(2.0 * d.square[c] / HALF)


@jit
def watch(s: Any, prm: Any, t: float, dt: float, w: Vec, f: Vec) -> bool:
    """Take one raw IMU sample; True when a step was named and its effect taken back."""
    d = s.bank[0].step
    h = d.head
    new = (w[0], w[1], w[2], f[0], f[1], f[2])
    n = STEP_RING
    p1, p2 = (h - 1) % n, (h - 2) % n
    k6, k7, k13 = (h - HALF) % n, (h - HALF - 1) % n, (h - 2 * HALF - 1) % n
    slow, fast = min(1.0, dt / MEMORY), min(1.0, dt / ALERT)
    quick, ever = min(1.0, dt / LATELY), min(1.0, dt / EVER)
    ready = d.filled >= 2 * HALF + 2
    doubt.contact(s, f)
    if s.rest.still == 1:  # motors begin to turn: nothing is known yet of what is usual
        d.t_free = t + SPIN_UP
    found = -1
    for c in range(6):
        v = new[c]
        if d.filled >= 2:
            a = v - d.u[p2, c]
            square = 0.5 * a * a
            if d.n > WARM:
                square = min(square, LONE * d.square[c])
                d.square[c] += (fast if square > d.square[c] else slow) * (square - d.square[c])
            else:
                d.square[c] += (square - d.square[c]) / (d.n + 1.0)
            a = v - 2.0 * d.u[p1, c] + d.u[p2, c]
            square = a * a
            d.quick[c] += quick * (square - d.quick[c])
            if d.t_rough[c] < 0.0:
                d.slow[c] += max(ever, 1.0 / (d.n + 1.0)) * (square - d.slow[c])
        if ready:
            before = d.z[c]
            d.after[c] += v - d.u[k6, c]
            d.before[c] += d.u[k7, c] - d.u[k13, c]
            z = (d.after[c] - d.before[c]) / (HALF * max(scale(d, c), 1e-9))
            d.low[c], d.high[c] = min(d.low[c], z), max(d.high[c], z)
            if c < 3 and d.n > WARM and t > d.t_free and abs(before) > LARGE and abs(z) < abs(before) and dt > SHORTEST and dt < LONGEST:
                found = c
            d.z_before[c], d.z[c] = before, z
        d.u[h, c] = v
    d.head = (h + 1) % n
    d.when[h] = t
    d.filled += 1
    d.n += 1
    if d.filled == 2 * HALF + 2:
        for c in range(6):
            d.after[c], d.before[c] = 0.0, 0.0
            for i in range(HALF):
                d.after[c] += d.u[(h - i) % n, c]
                d.before[c] += d.u[(h - HALF - 1 - i) % n, c]
    if t >= d.t_interval:
        d.t_interval = t + INTERVAL
        i = d.h_head
        d.h_head = (i + 1) % STEP_HISTORY
        d.h_t[i] = t
        for c in range(6):
            d.h_low[i, c], d.h_high[i, c], d.h_sd[i, c] = d.low[c], d.high[c], scale(d, c)
            d.low[c], d.high[c] = 0.0, 0.0
    sick(s, prm, t, dt, new)
    if found >= 0 and not replaced(s, found) and not doubt.near_ground(s) and t - s.bank[0].t_contact > doubt.CONTACT:
        return step_of(s, found, t)
    return False


@jit
def replaced(s: Any, c: int) -> bool:
    """Whether a vehicle's model stands in for a channel."""
    return len(s.pairs) > 0 and s.pairs[0].on[c] == 1


@jit
def step_of(s: Any, c: int, t: float) -> bool:
    """Whether the halves as they stood one sample ago are a step of gyro axis ``c``; name it and take it back."""
    d = s.bank[0].step
    n = STEP_RING
    h = d.head - 2  # the newest sample then
    z = d.z_before[c]
    for a in range(3):
        if a != c and abs(d.z_before[a]) > max(5.0, ASIDE * abs(z)):
            return False
        if abs(d.z_before[3 + a]) > QUIET:
            return False
    for i in range(2 * HALF + 1):  # contact: what turns the vehicle at once pushes it, too
        q = 0.0
        for a in range(3, 6):
            level = 0.0
            for j in range(HALF):
                level += d.u[(h - HALF - 1 - j) % n, a] / HALF
            x = d.u[(h - i) % n, a] - level
            q += x * x / max(d.square[a], 1e-12)
        if q > SHOCK:
            return False
    for o in range(2):
        q = 0.0
        for a in range(3, 6):
            level = 0.0
            for i in range(HALF):
                level += d.u[(h - o * (HALF + 1) - i) % n, a] / HALF
            q += level * level
        if q < CARRIED * CARRIED:
            return False
    after, before = 0.0, 0.0
    for i in range(HALF):
        after += d.u[(h - i) % n, c] / HALF
        before += d.u[(h - HALF - 1 - i) % n, c] / HALF
    rest, sxy, sxx = 0.0, 0.0, 0.0
    for i in range(HALF):
        x, y = d.u[(h - i) % n, c] - after, d.u[(h - HALF - 1 - i) % n, c] - before
        rest += x * x + y * y
        k = HALF - i  # samples from the one between
        sxy += k * (d.u[(h - i) % n, c] - d.u[(h - 2 * HALF + i) % n, c])
        sxx += 2.0 * k * k
    if rest > LEVEL * (2.0 * HALF - 2.0) * d.square[c]:
        return False
    line = rest + 0.5 * HALF * (after - before) * (after - before) - sxy * sxy / sxx  # what a straight line leaves
    if line - rest < BETTER * d.square[c]:
        return False
    size, sd = after - before, scale(d, c)
    onset = 0.5 * (d.when[(h - HALF) % n] + d.when[(h - HALF + 1) % n])
    told(s, E_FAULT, STEP + c, t, onset, abs(z), LARGE, size, sd)
    s.dx[c] = -size * (t - onset)
    s.dx[9 + c] = size
    variance = sd * sd + UNSURE * UNSURE * size * size
    s.P[9 + c, 9 + c] += variance
    s.P[c, c] += variance * (t - onset) * (t - onset)
    inject(s)
    clear(s.bank[0])
    s.bank[0].healed += 1
    s.bank[0].yaw = s.yaw_corrected
    compass.forget(s)
    for a in range(6):  # the history is that of the failed sensor: it proves nothing any more
        d.z[a], d.z_before[a], d.low[a], d.high[a] = 0.0, 0.0, 0.0, 0.0
    d.filled = 0
    return True


@jit
def told(s: Any, code: Any, detail: Any, t: float, onset: float, value: float, threshold: float, size: float, sd: float) -> None:
    """Leave an event of the raw samples."""
    i = s.n_events
    event_since(s, t, onset, code, NO_SENSOR, value, threshold, detail)
    if s.n_events > i:
        s.event[i].size, s.event[i].sd = size, sd


@jit
def sick(s: Any, prm: Any, t: float, dt: float, new: tuple[float, float, float, float, float, float]) -> None:
    """Held values and roughness of each channel, and what an axis that is not to be believed leaves open."""
    d = s.bank[0].step
    for c in range(6):
        v = new[c]
        if c < 3:
            d.rate[c] += min(1.0, dt / EVER) * (v * v - d.rate[c])
        if v == d.held[c]:
            d.run[c] += 1
            run = d.run[c]
            end = abs(v) > (END_GYRO if c < 3 else END_ACCEL) and abs(v) >= d.peak[c]
            if d.wrong[c] == 0 and d.n > WARM:
                if end and run >= HELD_END:
                    fail(s, c, SATURATE, t, d.t_run[c], run, HELD_END)
                elif run >= max(HELD, HELD_RATIO * d.longest[c]) and t - d.t_run[c] > HELD_TIME:
                    fail(s, c, DROPOUT if v == 0.0 else STUCK, t, d.t_run[c], run, max(HELD, HELD_RATIO * d.longest[c]))
        else:
            if d.wrong[c] == STUCK or d.wrong[c] == DROPOUT or d.wrong[c] == SATURATE:
                over(s, c, t)
            elif d.run[c] > d.longest[c]:
                d.longest[c] = d.run[c]
            d.run[c], d.held[c], d.t_run[c] = 0, v, t
            d.peak[c] = max(d.peak[c], abs(v))
    for c in range(6):
        o = 3 * (c // 3)
        others = 1.0
        for i in range(3):
            if o + i != c:
                others *= d.quick[o + i] / max(d.slow[o + i], 1e-18)
        ratio = d.quick[c] / max(d.slow[c], 1e-18)
        rough = ratio > ROUGH and ratio > ALONE_ROUGH * math.sqrt(others) and d.run[c] == 0 and dt < COARSE
        if d.wrong[c] == 0 and d.n > 4 * WARM:
            if not rough:
                d.t_rough[c] = -1.0
            elif d.t_rough[c] < 0.0:
                d.t_rough[c] = t
            elif t - d.t_rough[c] > ROUGH_TIME:
                fail(s, c, NOISE, t, d.t_rough[c], ratio, ROUGH)
        elif d.wrong[c] == NOISE and ratio < 0.5 * ROUGH:
            over(s, c, t)
        if d.wrong[c] != 0 and not replaced(s, c):
            unsure(s, c, dt)


@jit
def fail(s: Any, c: int, kind: Any, t: float, onset: float, value: float, threshold: float) -> None:
    """A channel is not to be believed."""
    d = s.bank[0].step
    d.wrong[c] = kind
    told(s, E_FAULT, kind + c, t, onset, value, threshold, math.nan, math.nan)


@jit
def over(s: Any, c: int, t: float) -> None:
    """A channel works again."""
    d = s.bank[0].step
    told(s, E_OVER, d.wrong[c] + c, t, t, 0.0, math.nan, math.nan, math.nan)
    d.wrong[c], d.t_rough[c] = 0, -1.0


@jit
def unsure(s: Any, c: int, dt: float) -> None:
    """What the axis does unseen goes into the covariance: as much as it did in the flight so far, or its own noise."""
    d = s.bank[0].step
    if d.wrong[c] == NOISE:
        q = d.quick[c] / 6.0 * dt
    elif c < 3:
        q = max(d.rate[c], UNSEEN_RATE * UNSEEN_RATE) * ALIKE
    else:
        q = UNSEEN_FORCE * UNSEEN_FORCE * ALIKE
    if c < 3:
        s.P[c, c] += q * dt
        return
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    for i in range(3):
        for j in range(3):
            s.P[3 + i, 3 + j] += q * dt * C[i][c - 3] * C[j][c - 3]


@jit
def extreme(d: Any, c: int, size: float, begin: float, end: float) -> tuple[float, float]:
    """Largest step of channel ``c`` in the direction of ``size`` between two times [sigma], and the largest 1 sigma of that time."""
    z, sd = 0.0, 0.0
    for i in range(STEP_HISTORY):
        if d.h_t[i] > begin and d.h_t[i] - INTERVAL < end:
            z = max(z, d.h_high[i, c] if size > 0.0 else -d.h_low[i, c])
            sd = max(sd, d.h_sd[i, c])
    if end > d.t_interval - INTERVAL:  # the interval that is not over yet
        z = max(z, d.high[c] if size > 0.0 else -d.low[c])
        sd = max(sd, scale(d, c))
    return z, sd


@jit
def refuted(b: Any, c: int, size: float, begin: float, end: float) -> bool:
    """Whether a step of ``size`` in channel ``c`` at a time between those would have shown, and did not."""
    z, sd = extreme(b.step, c, size, begin, end)
    return sd > 0.0 and abs(size) > MUST * sd and z * sd < HALF_SEEN * abs(size)


@jit
def shown(b: Any, c: int, size: float, begin: float, end: float) -> bool:
    """Whether the raw samples show a step of that size."""
    z, sd = extreme(b.step, c, size, begin, end)
    return z > MUST - 1.0 and abs(z * sd - abs(size)) < 0.4 * abs(size)
