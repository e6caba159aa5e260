"""Faults of one IMU without a vehicle model: onsets are opened, the bank of signatures is judged, a fault is named and its effect undone.

The statistic of a fault is the largest of its onsets (theory-amendments.md §3). An alarm is a statistic above its threshold; a name is one
that exceeds every other by a margin, until when the verdict is the set within that margin. What a named fault has put into the state is
known, size times response, and is taken back; the failed axis is open again by the uncertainty of its size. The onsets kept are 0.25 s
apart at first and further the longer they are ago, about a seventh of that time: those of ramps lie many seconds back.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids import compass
from haltere.aids.fusing import DISTRUSTED, RUNNING
from haltere.aids.record import E_FAULT, E_SUSPECT, GNSS_POSITION, GNSS_VELOCITY, NO_SENSOR, event_since
from haltere.core.rotation import Mat, dcm
from haltere.diagnosis import doubt, jumps, pairs, steps
from haltere.diagnosis.heading import gyro_that_turns
from haltere.diagnosis.healing import follow, heal, heal_between
from haltere.diagnosis.model_detectors import BY_BAROMETER, BY_POSITION, BY_VELOCITY, outside, spoke, testify
from haltere.diagnosis.steps import refuted, shown
from haltere.filter import jumping, turning, usual
from haltere.filter.signatures import (
    ACCEL,
    ACCEL_RAMP,
    BAROMETER_OFFSET,
    GYRO,
    GYRO_RAMP,
    HEADING,
    N_FAULTS,
    POSITION,
    SLOTS,
    VELOCITY,
    YAW,
    clear,
    move,
    open_slot,
)
from haltere.strapdown.propagate import left_F

__all__ = ["FAMILIES", "N_FAMILIES", "carry", "judge", "tick"]

#: What faults are told apart: gyro and accelerometer axes, GNSS velocity and position, compass, barometer.
FAMILIES = (
    "gyro.x", "gyro.y", "gyro.z", "accel.x", "accel.y", "accel.z", "gnss.n", "gnss.e", "gnss.d", "gnss.n", "gnss.e", "gnss.d",
    "magnetometer", "barometer",
)  # fmt: skip
N_FAMILIES = constant(14)
F_ACCEL, F_VELOCITY, F_POSITION, F_COMPASS, F_BAROMETER = (constant(i) for i in (3, 6, 9, 12, 13))
#: The gyro's axis that is next to vertical.
VERTICAL = constant(2)
NONE = constant(-1)
#: Spacing of new onsets, how old the oldest may be, time between judgements, and how long a set is kept for itself [s].
GRID, OLDEST, EVERY, TELL = 0.25, 15.0, 0.1, 2.5
#: An inertial fault is named so long [s] after the alarm at the earliest: what is sudden is rather in what was measured.
SETTLE = 0.4
#: An accelerometer that alarms sooner than this [s] waits as long as the following.
SUDDEN = 0.5
#: And what is measured is found wrong by a fault that lasts so long [s]: a gust on a barometer, a glitch, do not.
LASTS = 1.2
#: By how much a name must exceed the others; and for an axis of the gyro against that of the accelerometer which looks most like it.
MARGIN, MARGIN_ALIKE = 9.0, 16.0
#: What it says for an axis that the raw samples show its step, or the rotors do; margins as a part of the statistic, since responses are
#: linear and onsets on a grid.
SHOWN, LINEAR = 25.0, 0.02
#: Part of a threshold that is enough where rotors alarmed by themselves for the same axis, sign and onset: both would have to be wrong.
TWO_WITNESSES = 0.6
#: Part of the threshold that an axis of the IMU that tilts must come to without the compass.
UNAIDED = 0.5
#: How sure [sigma] it must be that a fault is more than such a change before it is told.
CERTAIN = 3.0
#: Changes that are no fault: slopes, as those of a bias over so long [s]; GNSS velocity [m/s], position [m], heading [rad], height [m].
RAMP_TIME, VELOCITY_FREE, POSITION_FREE, HEADING_FREE, HEIGHT_FREE = 60.0, 0.7, 1.2, 0.1, 1.0
#: Part of them while the vehicle's model agrees with the IMU.
VOUCHED = 0.4
#: What a pressure may lag behind the height [s], beside the delay that is known: faster than HEIGHT_FREE a LATE it makes more than that.
LATE = 0.35
#: Largest steps [rad/s, m/s^2], steepest ramps [rad/s^2, m/s^3].
GYRO_MOST, ACCEL_MOST = 1.0, 8.0
GYRO_STEEPEST, ACCEL_STEEPEST = math.radians(0.3), 0.12
#: Factor on the threshold of what is no inertial sensor: its errors last longer than a filter believes.
OTHERS = 2.0
#: Least information on a size, in 1/(unit)^2.
LEAST = 1.0
#: GNSS velocity speaks if it did so long ago [s].
SPOKEN = 3.0
#: From this uncertainty of attitude on the bank listens: 1 sigma of tilt and of yaw [rad].
TILT_KNOWN, YAW_KNOWN = math.radians(5.0), math.radians(25.0)


@jit
def carry(s: Any, D: Mat, A: Mat, B: Mat, dt: float) -> None:
    """Take one interval of prediction, with its blocks of Φ, into that since the last fusion."""
    b = s.bank[0]
    for j in range(15):
        left_F(b.phi, j, D, A, B, dt)
    for a in range(3):
        b.phi.P[9 + a, 9 + a] += dt
        b.phi.P[12 + a, 12 + a] += dt
    b.span += dt
    b.climb -= s.v[2] * dt


@jit
def family_of(fault: int) -> int:
    """Family of a signature: a ramp is of its axis, a wrong yaw of the compass."""
    if fault == YAW:
        return F_COMPASS
    return fault - 6 if fault >= GYRO_RAMP else fault


@jit
def free(s: Any, prm: Any, fault: int) -> float:
    """Size that is no fault."""
    if fault < ACCEL:
        return float(prm.diagnosis_gyro)
    if fault < GYRO_RAMP:
        return float(prm.diagnosis_accel)
    if fault < ACCEL_RAMP:
        return float(prm.diagnosis_gyro / RAMP_TIME)
    if fault < VELOCITY:
        return float(prm.diagnosis_accel / RAMP_TIME)
    if fault < POSITION:
        return VELOCITY_FREE
    if fault < HEADING:
        return POSITION_FREE if fault < POSITION + 2 else 2.0 * POSITION_FREE
    return max(HEIGHT_FREE, LATE * s.bank[0].sank) if fault == BAROMETER_OFFSET else HEADING_FREE


@jit
def changed(s: Any, prm: Any, fault: int, k: int) -> bool:
    """Whether an inertial fault has come to more than a change that is no fault, with `CERTAIN` sigma; a ramp by its time."""
    b = s.bank[0]
    j = fault * SLOTS + k
    lasted = s.t - b.onset[k] if fault >= GYRO_RAMP else 1.0
    gyro = fault < ACCEL or (fault >= GYRO_RAMP and fault < ACCEL_RAMP)
    least = (abs(b.num[j]) / b.den[j] - CERTAIN / math.sqrt(b.den[j])) * lasted
    return bool(least > (prm.diagnosis_gyro if gyro else prm.diagnosis_accel))


@jit
def most(fault: int) -> float:
    """Size that no fault has; for a ramp, since hover one of an accelerometer looks like a step of the gyro, g times as steep."""
    if fault < GYRO_RAMP:
        return GYRO_MOST if fault < ACCEL else ACCEL_MOST
    if fault < VELOCITY:
        return GYRO_STEEPEST if fault < ACCEL_RAMP else ACCEL_STEEPEST
    return 1e9


@jit
def next_slot(b: Any, t: float) -> int:
    """A slot for an onset now: one that is free or too old, else the one that is missed least, its neighbours' distance over its age."""
    best, least = 0, 1e18
    for k in range(len(b.live)):
        age = t - b.onset[k]
        if b.live[k] == 0 or age > OLDEST:
            return k
        before, after = 1e18, 1e18
        for i in range(len(b.live)):
            gap = b.onset[i] - b.onset[k]
            if gap > 0.0:
                after = min(after, gap)
            elif i != k:
                before = min(before, -gap)
        if before < 1e18 and (before + after) / age < least and age > 2.5 * GRID:
            best, least = k, (before + after) / age
    return best


@jit
def known(s: Any) -> bool:
    """Whether the attitude is known well enough for linear responses, and GNSS speaks: without it nothing tells one axis from another."""
    if doubt.sparse(s.bank[0]) or s.t - s.aid[GNSS_VELOCITY].t_offered > SPOKEN:
        return False
    return compass.tilt_variance(s) < TILT_KNOWN * TILT_KNOWN and compass.yaw_sd(s) < YAW_KNOWN


@jit
def sick(s: Any) -> bool:
    """Whether a channel of the IMU is known to fail, or a model stands in for one: then the bank has nothing to say."""
    if len(s.pairs) > 0 and s.pairs[0].standing != 0:
        return True
    w = s.bank[0].step.wrong
    return int(w[0] | w[1] | w[2] | w[3] | w[4] | w[5]) != 0


@jit
def tick(s: Any, prm: Any, dt: float) -> bool:
    """After fusion: open onsets, judge; True when a named fault has changed the state beyond what its measurements did."""
    b = s.bank[0]
    follow(s, dt)
    doubt.note(s, dt)
    jumps.listen(b.height, s.t, prm.diagnosis_threshold, jumps.LASTS)
    if sick(s):
        jumping.restart(b.course)
    else:
        jumps.compass_that_steps(s, prm)
    calibration = prm.robust_calibration / max(math.cos(s.field[1]), 0.1)
    w, down = (s.w[0], s.w[1], s.w[2]), dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2]
    bias, unsure = (s.bg[0], s.bg[1], s.bg[2]), compass.along(s.P, down, 9) if b.track.n == 0 else 0.0
    turning.suppose(b, prm.noise_gyro, prm.noise_gyro_scale, prm.noise_gyro_bias, calibration, w, down, dt, bias, unsure)
    if b.n_aligned != s.n_aligned or abs(s.yaw_corrected - b.yaw) > 0.5:
        clear(b)
        if b.n_aligned != s.n_aligned:
            steps.forget(b)
            jumping.restart(b.height)
            jumping.restart(b.course)
            doubt.begin(s)
            usual.begin(b, s.t)
        b.n_aligned, b.t_slot, b.t_judge = s.n_aligned, s.t, s.t
        for a in range(len(b.slope)):
            b.slope[a] = 0.0
    b.yaw = s.yaw_corrected
    if b.n_gaps != s.n_gaps:  # what happened meanwhile is in no response
        b.n_gaps = s.n_gaps
        clear(b)
        jumping.restart(b.height)
        jumping.restart(b.course)
        b.t_doubt = max(b.t_doubt, s.t + doubt.AFTER_GAP)
    if s.t >= b.t_slot:
        b.t_slot = s.t + GRID - 1e-6
        if known(s) and s.t > b.t_doubt and not sick(s):
            if b.span > 0.0:
                move(b)
            open_slot(s, next_slot(b, s.t), dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2])
        else:
            clear(b)
    if s.t < b.t_judge:
        return False
    b.t_judge = s.t + EVERY - 1e-6
    doubt.watch(s, prm)
    if known(s) and doubt.judged(s) and not sick(s):
        b.watched += EVERY
    k = gyro_that_turns(s)
    if k >= 0:
        heal(s, GYRO + 2, k)
        compass.forget(s)
        clear(b)
        return True
    if b.fresh == 1:
        b.fresh = 0
        return judge(s, prm)
    return False


@jit
def said(s: Any, g: int, onset: float) -> float:
    """When the vehicle's model found what measures GNSS or height wrong since ``onset``, if it did; else -1."""
    if g < F_VELOCITY or g == F_COMPASS:
        return -1.0
    return spoke(s, BY_VELOCITY if g < F_POSITION else (BY_POSITION if g < F_COMPASS else BY_BAROMETER), onset)


@jit
def doubled(s: Any, g: int, onset: float) -> float:
    """Factor on the threshold of what is no inertial sensor; none where the vehicle's model says the same."""
    return 1.0 if g < F_VELOCITY or said(s, g, onset) >= 0.0 else OTHERS


@jit
def weigh(s: Any, prm: Any) -> tuple[int, float]:
    """Statistic of every family: which is the largest, and the largest ratio of one to its threshold, tolerances left out."""
    b = s.bank[0]
    for g in range(N_FAMILIES):
        b.level[g], b.beyond[g], b.fault[g], b.slot[g] = 0.0, 0.0, NONE, 0
    b.ratio, tilting = 0.0, 0.0
    turned, sure = 0.0, pairs.vouch(s)
    for f in range(N_FAULTS):
        g = family_of(f)
        tolerance, largest, least = free(s, prm, f), most(f), 0.25 * prm.diagnosis_threshold
        if sure and f >= VELOCITY:
            tolerance *= VOUCHED
        usually = tolerance
        for k in range(SLOTS):
            j = f * SLOTS + k
            den = b.den[j]
            tolerance = usually
            stepped = f == BAROMETER_OFFSET and jumps.settled(b.height, b.onset[k])  # the flight's own barometer says that it is no gust
            if stepped:
                tolerance = min(tolerance, LATE * b.sank)
            num = abs(b.num[j])
            if num * num > least * den and den > LEAST:
                span = GRID + 0.2 * (s.t - b.onset[k])
                size = min(num / den, largest)
                level = size * (2.0 * num - size * den)  # twice the gain in log likelihood; num²/den where the size is free
                if f < GYRO_RAMP and refuted(b, f, math.copysign(size, b.num[j]), b.onset[k] - span, b.onset[k] + span):
                    continue
                if f < GYRO_RAMP and pairs.contradicted(s, prm, g, size, b.onset[k]):
                    continue
                if level > b.level[g]:
                    b.level[g], b.fault[g], b.slot[g] = level, f, k
                    if g == VERTICAL:
                        turned = b.heading_num[j] * b.heading_num[j] / max(b.heading_den[j], 1e-9)
                if num <= tolerance * den:
                    continue
                h = prm.diagnosis_threshold * (1.0 if stepped else doubled(s, g, b.onset[k]))
                beyond = (level - tolerance * (2.0 * num - tolerance * den)) / h
                b.beyond[g] = max(b.beyond[g], beyond)
                if g < F_VELOCITY and g != VERTICAL and beyond > b.ratio:
                    b.ratio, tilting = beyond, level
    if tilting < b.level[F_COMPASS]:
        b.ratio = 0.0
    turned = min(turned, b.level[VERTICAL])  # a compass that turns as that gyro would have it explains as much of the heading
    if turned > b.level[F_COMPASS]:
        b.level[F_COMPASS], b.fault[F_COMPASS], b.slot[F_COMPASS] = turned, YAW, b.slot[VERTICAL]
    for g in range(F_VELOCITY):
        if b.beyond[g] <= 0.5:
            continue
        hint = pairs.hinted(s, g, b.onset[b.slot[g]], b.num[b.fault[g] * SLOTS + b.slot[g]]) >= 0.0
        if b.fault[g] >= GYRO_RAMP and g >= F_ACCEL:
            hint = False  # forces tell of a step
        if hint or in_samples(s, g):
            b.level[g] += SHOWN
        if hint:
            b.beyond[g] /= TWO_WITNESSES
    lead, ratio = 0, 0.0
    for g in range(N_FAMILIES):
        if b.level[g] > b.level[lead]:
            lead = g
        b.peak[g] = max(b.peak[g], b.beyond[g])
        b.beyond[g] /= usual.raised(b, g)
        ratio = max(ratio, b.beyond[g])
    return lead, ratio


@jit
def without_compass(b: Any, prm: Any, j: int) -> bool:
    """Whether what is not heading speaks for column ``j``, too: a compass that is not calibrated tells of tilts that are not there."""
    num, den = b.num[j] - b.heading_num[j], b.den[j] - b.heading_den[j]
    return bool(num * b.num[j] > 0.0 and num * num > UNAIDED * prm.diagnosis_threshold * den)


@jit
def alike(g: int, o: int) -> bool:
    """Whether two axes look alike in hover: gyro x and accelerometer y, gyro y and accelerometer x; tilted into a wind, gyro z and both."""
    low, high = min(g, o), max(g, o)
    return (low == 0 and high == F_ACCEL + 1) or (low == 1 and high == F_ACCEL) or high == 2 or (low == 2 and high < F_ACCEL + 2)


@jit
def in_samples(s: Any, g: int) -> bool:
    """Whether the raw samples show the step of a gyro axis that the bank believes in."""
    b = s.bank[0]
    f, k = b.fault[g], b.slot[g]
    if f < GYRO or f >= ACCEL:
        return False
    j = f * SLOTS + k
    span = GRID + 0.2 * (s.t - b.onset[k])
    return shown(b, f, b.num[j] / b.den[j], b.onset[k] - span, b.onset[k] + span)


@jit
def judge(s: Any, prm: Any) -> bool:
    """Alarm, set or name from the bank as it stands; True when the state was changed."""
    b = s.bank[0]
    usual.learn(b, s.t)
    lead, ratio = weigh(s, prm)
    if b.beyond[lead] < 1.0:  # what explains most is no fault
        if b.alarm != 0 and ratio < 0.5:
            b.alarm = 0
        return False
    if b.alarm == 0:
        b.alarm, b.t_seen = 1, s.t
    k = b.slot[lead]
    if lead == F_BAROMETER and jumps.stepped(b.height, b.onset[k]):
        b.t_seen = min(b.t_seen, b.height.t_alarm)
    if lead >= F_VELOCITY and lead < F_COMPASS and not doubt.vouched(s):
        return False
    if not doubt.may_name(b, lead, s.t) or not doubt.judged(s) or not doubt.fits(s, b.fault[lead] * SLOTS + k, k):
        return False  # what is wrong is in no list
    if lead < F_VELOCITY and (outside(s, b.onset[k]) or not changed(s, prm, b.fault[lead], k)):
        return False
    if lead < F_VELOCITY and lead != VERTICAL and not without_compass(b, prm, b.fault[lead] * SLOTS + k):
        return False
    candidates, others = 1 << lead, 0
    top = b.level[lead]
    for g in range(N_FAMILIES):
        margin = max(MARGIN_ALIKE if alike(g, lead) else MARGIN, LINEAR * top)
        if g != lead and top - b.level[g] < margin:
            candidates |= 1 << g
            others += 1
    sudden = lead >= F_ACCEL and b.t_seen - b.onset[k] < SUDDEN  # as what was measured is, and hardly an accelerometer
    if others == 0 and s.t - b.t_seen >= (SETTLE if lead < F_VELOCITY and not sudden else LASTS):
        return name(s, prm, lead)
    if b.alarm == 1 and s.t - b.t_seen > TELL and others == 1:  # a set of three says nothing yet
        b.alarm = 2
        if lead < F_VELOCITY:
            if not doubt.named(b, lead, s.t):
                return False
            tell(s, prm, E_SUSPECT, lead, candidates)
            return heal_between(s, candidates)
    return False


@jit
def tell(s: Any, prm: Any, code: Any, g: int, candidates: int) -> None:
    """Leave an event of the family ``g`` as the bank has it."""
    b = s.bank[0]
    f, k = b.fault[g], b.slot[g]
    j = f * SLOTS + k
    n = s.n_events
    threshold = prm.diagnosis_threshold * doubled(s, g, b.onset[k]) * usual.raised(b, g)
    event_since(s, s.t, b.onset[k], code, NO_SENSOR, b.level[g], threshold, f)
    if s.n_events > n:
        e = s.event[n]
        e.seen, e.size, e.sd, e.candidates = max(b.t_seen, b.onset[k]), b.num[j] / b.den[j], 1.0 / math.sqrt(b.den[j]), candidates
        # the vehicle's model said so before
        hint = pairs.hinted(s, g, b.onset[k], b.num[j]) if g < F_VELOCITY else said(s, g, b.onset[k])
        if hint >= 0.0:
            e.seen = min(e.seen, hint)
        if g == F_BAROMETER and jumps.stepped(b.height, b.onset[k]):
            e.onset, e.seen = b.height.onset, b.height.t_alarm
        testify(s, e, b.onset[k])
        e.left = doubt.left(b, j, k) / max(b.num[j] * b.num[j] / b.den[j], 1e-9)


@jit
def name(s: Any, prm: Any, g: int) -> bool:
    """A fault stands alone: say so, take its effect back, and begin anew."""
    b = s.bank[0]
    f, k = b.fault[g], b.slot[g]
    if g == F_COMPASS:  # the compass has a watch of its own
        b.alarm = 0
        return False
    if not doubt.named(b, g, s.t):
        return False
    tell(s, prm, E_FAULT, g, 1 << g)
    heal(s, f, k)
    if g >= F_VELOCITY and g < F_COMPASS:
        sensor = GNSS_VELOCITY if g < F_POSITION else GNSS_POSITION
        other = GNSS_POSITION if g < F_POSITION else GNSS_VELOCITY
        if s.aid[other].started == RUNNING:
            s.aid[sensor].started = DISTRUSTED
            s.aid[sensor].t_due = s.t
    if g < F_VELOCITY:
        compass.forget(s)  # a tilt that was mended has turned the levelled heading
    clear(b)
    return True
