"""What an alarm of model against IMU means: an axis of the model, a rotor or its tachometer, wind, or a sensor. It detects nothing.

After the first alarm the others are waited for (theory.md §5.5, theory-amendments.md 2, 3, 16). A level of a rate that has stepped and
stays is the gyro's; one that goes on is a moment that the model does not have. Roll, pitch and thrust in the ratio of one rotor are that
rotor, which has less thrust or whose tachometer is wrong: that is not told apart; from then on the model has it so. A force is tried
against a change of the wind (`haltere.diagnosis.wind_or_force`), and is the model's or the accelerometer's until the bank of
`haltere.diagnosis.inertial` is silent with power. What gusts may do convicts nobody. A compass that turns while the gyro agrees with the
rotors is a disturbed compass.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids import compass
from haltere.aids.air import wind_n
from haltere.aids.compass import OUT_TURN
from haltere.aids.record import E_FAULT, E_OVER, E_SUSPECT, NO_SENSOR, event_since
from haltere.core.rotation import dcm, tmat_vec
from haltere.diagnosis import doubt
from haltere.diagnosis.drifts import LASTS, forget_means, lasting
from haltere.diagnosis.model_detectors import testify
from haltere.diagnosis.pairs import BLOCK, CALM_ENOUGH, calm_again, change, listen, shift_bias, would_show
from haltere.diagnosis.rate_step import began, shape
from haltere.diagnosis.stand_in import density_of_noise, mark_before, offset_variance
from haltere.diagnosis.wind_or_force import NOTHING, PUSH, again, against_wind, best, by_chance, by_old_wind, follow, held, latest, start
from haltere.filter.signatures import ACCEL, SLOTS, clear
from haltere.strapdown.pairs import LATELY
from haltere.strapdown.propagate import gusts, inject

__all__ = ["CANDIDATES", "MODEL", "ROTOR", "hear"]

#: Codes of an event, above those of `haltere.diagnosis.steps`: six axes of the model, then rotors.
MODEL, ROTOR = constant(64), constant(70)
#: Most rotors that are told apart.
MOST = 8
#: Bits of what an event may be: model axes, wind, accelerometer axes, gyro axes, rotors, their tachometers.
CANDIDATES = (
    "model.hx", "model.hy", "model.t", "model.r", "model.p", "model.q", "wind", "accel.x", "accel.y", "accel.z",
    "gyro.x", "gyro.y", "gyro.z",
    *(f"rotor.{k}" for k in range(MOST)), *(f"rotors.{k}" for k in range(MOST)), "magnetometer",
)  # fmt: skip
B_WIND, B_ACCEL, B_GYRO, B_ROTOR, B_TACHOMETER, B_COMPASS = (constant(i) for i in (6, 7, 10, 13, 21, 29))
#: When a change is looked at first, and when a verdict on moments is given [s]; how long one on forces may wait, and one on a rotor.
EARLY, COLLECT, WAIT, LONGER = 0.08, 0.3, 6.0, 2.0
#: Blocks that say how large a moment is.
FEW = constant(6)
#: For how long after its onset a change of a rate may be looked at, where a step is not told from a ramp before, or a moment is too small
#: yet [s]: its blocks are kept so long.
UNDECIDED = 0.5
#: How long a force and wind are compared at the most before both are named [s].
COMPARED = 2.5
#: By how much a hypothesis must explain better, in twice the log likelihood; what a signature is off by itself, and least 1 sigma.
MARGIN, LIKE, LEAST_M, LEAST_F = 9.0, 0.2, 0.15, 0.04
#: A change that is the wind beyond doubt, soon; what a force must explain better than what the model is off by in this flight, and less
#: than what a second it is not looked at any longer.
SURE, WORTH, LITTLE = 40.0, 20.0, 4.0
#: How much more a later step must explain than all that is tried, in the same measure, for the trial to begin anew there.
#: While it explains this much more, no trial ends as one of nothing.
AFRESH, PERHAPS = 10.0, 4.0
#: What must speak against a wind when no more is waited for; how many sigma of an error of the wind before a force must be that a wind
#: explains as well, where the vehicle has turned to a new heading.
LATE, BEYOND_WIND = 3.0, 2.5
#: Two rotors that explain alike within the first are both named, within the second they are looked at for longer.
NEARLY, UNLIKE = 1.0, 3.0
#: A moment that has lasted for so long [s] before its alarm is dated anew.
OLD = 0.5
#: Least change of a rotor's thrust that is a fault.
LEAST_ROTOR = 0.015
#: 1 sigma of what a rotor that has lost thrust has lost of its torque, beside that; and of the part of it that may be: half of it ± that.
TORQUE, SOME = 0.1, 0.5
#: Air that is still: the wind is below this [m/s]; for so long in the air before, in which the wind was learnt [s]; how many sigma of gusts
#: a force must exceed.
STILL, STILL_FOR, BEYOND_GUSTS = 1.5, 15.0, 4.0
#: Vertical gusts beside horizontal ones; drag by wind that an unknown one may have [1/s].
DOWN, TYPICAL_DRAG = 0.5, 0.3
#: What must speak against an accelerometer's fault of the size, in twice the log likelihood: that one of size² D = d would do so by chance
#: has the probability Φ(-(d + 16)/(2 √d)), at most that of four sigma; along z, where it hears height too, its innovations are less white.
#: By what part the size may be off: a few blocks have told it. An onset of the bank is one of the pair if so near [s].
AGAINST, AGAINST_Z, ABOUT, NEAR = 16.0, 36.0, 0.3, 0.5
#: How long forces are not listened to [s]: after a verdict, and while levels begin anew; and for how long only at their full threshold:
#: after a change of the wind, and where there was nothing.
DEAF, ANEW, SOON, BRIEFLY = 5.0, 0.15, 1.5, 0.5
#: A fault is over when the change is its reverse within this part.
REVERSE = 0.4
#: A step of the gyro and the onset of what turned the compass are one if so near [s]; part of a step that its size may be off by.
AROUND_OUT, UNSURE = 5.0, 0.2
#: For how long what was done about one fault may turn the compass [s].
HEALS = 10.0
#: How much earlier than the window of an alarm a step may be [s]; what a force of the air off the centre turns [rad/s^2 per m/s^2].
AROUND, OFF_CENTRE = 0.1, 0.6
#: Gusts push so many sigma of theirs; a finding below this part of a rotor's fault that is carried is its change.
AS_GUSTS, PART = 1.5, 0.6
#: What the model of a moment is off by as a part of the largest of late: constants, and the time of a rotor's speed.
HARD = 0.05
#: How many sigma of it a moment of the model alone must be.
SIGMAS = 2.0
UP, FORCES, T, R, P, Q = (constant(i) for i in (1, 3, 2, 3, 4, 5))


@jit
def hear(s: Any, prm: Any) -> None:
    """Take the block that has ended: detectors, the trial of a force, a pending alarm, the compass."""
    p = s.pairs[0]
    dt = p.span
    pending = listen(s, prm)
    if pending:
        if p.trial == 1:
            follow(s, dt)
        judge(s, prm)
    if len(s.bank) > 0 and s.bank[0].healed != p.healed_out:
        p.healed_out, p.t_healed = s.bank[0].healed, s.t
        if p.t_first == 0.0:  # forces change with what was taken back
            settle_forces(s, DEAF, DEAF)
    if s.compass.out != p.out:
        p.out = s.compass.out
        if p.out == OUT_TURN:
            compass_or_gyro(s, prm)


@jit
def compass_or_gyro(s: Any, prm: Any) -> None:
    """The compass turned against the gyro and was put out: which of them it was, if the rotors say."""
    p, c = s.pairs[0], s.compass
    if s.t < p.t_healed + HEALS:
        return  # what was done about another fault has turned it
    if p.t_step[2] > c.onset - AROUND_OUT and p.on[2] == 0:
        name_gyro(s, 2)
        return
    if p.t_hint[Q] > c.onset - AROUND_OUT or p.on[2] == 1 or p.t_calm > c.onset - 0.5:
        return  # the rotors do not agree with the gyro either
    rate = c.jump / max(s.t - c.onset, 0.1)
    if would_show(s, prm, Q, rate):
        n = s.n_events
        event_since(s, s.t, c.onset, E_SUSPECT, NO_SENSOR, math.nan, math.nan, MODEL + Q)
        if s.n_events > n:
            s.event[n].seen, s.event[n].size, s.event[n].sd, s.event[n].candidates = s.t, rate, 0.0, UP << B_COMPASS


@jit
def name_gyro(s: Any, a: int) -> None:
    """A gyro axis stepped against the rotors: say so, and take back what it did."""
    p = s.pairs[0]
    size, since = p.step[a], s.t - p.t_step[a]
    n = s.n_events
    event_since(s, s.t, p.t_step[a], E_FAULT, NO_SENSOR, math.nan, math.nan, MODEL + R + a)
    sd2 = moment_spread(s, R + a) + UNSURE * UNSURE * size * size
    if s.n_events > n:
        e = s.event[n]
        e.seen, e.size, e.sd, e.candidates = min(p.t_hint[R + a], s.t), size, math.sqrt(sd2), UP << (B_GYRO + a)
    s.dx[a], s.dx[9 + a] = -size * since, size
    s.P[9 + a, 9 + a] += sd2
    s.P[a, a] += sd2 * since * since
    s.P[a, 9 + a] -= sd2 * since
    s.P[9 + a, a] -= sd2 * since
    inject(s)
    shift_bias(s, R + a, size)
    p.next[R + a] += size
    if len(s.bank) > 0:
        clear(s.bank[0])
        s.bank[0].healed += 1
        s.bank[0].yaw = s.yaw_corrected
    compass.forget(s)
    p.out, p.t_step[a] = s.compass.out, -1e9
    settle(s)


@jit
def moment_spread(s: Any, i: int) -> float:
    """Variance of a change of rate over a block or two of time to look [rad^2/s^2]."""
    return float(2.0 * s.pairs[0].r[i] + density_of_noise(s, i) * COLLECT + offset_variance(s, i) * COLLECT * COLLECT)


@jit
def judge(s: Any, prm: Any) -> None:
    """Look at a pending alarm; a verdict ends it."""
    p = s.pairs[0]
    since = s.t - p.t_first
    if len(s.bank) > 0 and s.bank[0].healed != p.healed:  # an inertial fault was named meanwhile: it explains this
        settle(s)
        p.t_across, p.t_deaf = s.t, s.t + DEAF
        return
    if since < COLLECT:
        return
    if p.mark < 0 or (len(s.bank) > 0 and doubt.near_ground(s)):
        settle(s)
        return
    moments, late = False, False
    for i in range(R, 6):  # later ones are what the vehicle makes of the first
        if p.t_alarm[i] > p.t_first + COLLECT:
            p.t_alarm[i], late = 0.0, True
        moments = moments or p.t_alarm[i] != 0.0
    if moments:
        if of_moments(s, prm) or since > LONGER:
            settle(s)
    elif late:  # a force was looked at, and there is something new: it alarms again by itself
        settle_forces(s, ANEW, SOON)
    elif p.t_alarm[0] != 0.0 or p.t_alarm[1] != 0.0 or p.t_alarm[T] != 0.0:
        of_forces(s, prm, since)
    else:
        settle(s)


@jit
def settle(s: Any) -> None:
    """End an alarm; levels as they are now are what is usual from here on."""
    p = s.pairs[0]
    p.t_first, p.trial, p.n_blocks, p.t_calm = 0.0, 0, 0, s.t
    forget_means(p)
    for i in range(6):
        calm_again(s, i)
        p.told_size[i] = 0.0
    p.still = 0


@jit
def settle_forces(s: Any, deaf: float, dull: float) -> None:
    """The same of forces alone, which are not listened to for some seconds, and then at their full threshold: rates are as before."""
    p = s.pairs[0]
    p.t_first, p.trial, p.t_across, p.t_deaf, p.t_dull = 0.0, 0, s.t, s.t + deaf, s.t + dull
    forget_means(p)
    for i in range(6):
        if i < FORCES:
            calm_again(s, i)
        p.t_alarm[i], p.told_size[i] = 0.0, 0.0
    p.still = 0


@jit
def go_on(s: Any, dull: float) -> None:
    """End a trial that came to nothing: levels are what it has found them to be, and a fault that has just come is still heard."""
    p = s.pairs[0]
    k = held(s)
    settle_forces(s, ANEW if k < 0 else 0.0, dull)
    if k < 0:
        return
    p.t_held, p.wind_held[0], p.wind_held[1] = s.t, p.later_wind[0, k], p.later_wind[1, k]
    for i in range(FORCES):
        p.level[i], p.P[i, 0] = p.later_level[i, k], p.later_var[i, k]


@jit
def tell(s: Any, code: Any, detail: Any, size: float, sd: float, candidates: int) -> None:
    """Leave an event with what alarmed when."""
    p, n = s.pairs[0], s.n_events
    event_since(s, s.t, p.onset, code, NO_SENSOR, p.statistic, p.threshold, detail)
    if s.n_events > n:
        e = s.event[n]
        e.seen, e.size, e.sd, e.candidates = p.t_first, size, sd, candidates
        for i in range(6):
            if p.t_alarm[i] != 0.0:
                e.alarms[i] = p.t_alarm[i]
        testify(s, e, p.onset)


@jit
def moment_of(s: Any, i: int) -> tuple[float, float]:
    """Moment that the model lacks since the onset, and its 1 sigma [rad/s^2]."""
    p = s.pairs[0]
    span = max(s.t - p.onset, EARLY)
    air = by_air(s, i, span)
    sd2 = 2.0 * p.r[i] / (span * span) + density_of_noise(s, i) / span + offset_variance(s, i) + LEAST_M * LEAST_M + air * air
    return change(s, i) / span, math.sqrt(sd2)


@jit
def by_air(s: Any, i: int, span: float) -> float:
    """What a moment is off by if forces that alarmed are the accelerometer's: they bend the velocity and, as drag, the wind [rad/s^2]."""
    p, off = s.pairs[0], 0.0
    if p.t_alarm[0] == 0.0 and p.t_alarm[1] == 0.0 and p.t_alarm[T] == 0.0:
        return 0.0
    W = wind_n(s)
    blown = tmat_vec(dcm((s.q[0], s.q[1], s.q[2], s.q[3])), (W[0] - p.m_wind[p.mark, 0], W[1] - p.m_wind[p.mark, 1], 0.0))
    for j in range(FORCES):
        bent = 0.5 * abs(p.told_size[j]) * span if p.t_alarm[j] != 0.0 else 0.0
        off += abs(p.by_v[1, i - FORCES, j]) * (abs(blown[j]) + bent)
    return off


@jit
def lately(s: Any, i: int) -> float:
    """The same moment from the last blocks as they are: a chain follows a ramp late, by its slope over its gain."""
    p = s.pairs[0]
    rate, when = 0.0, 0.0
    for k in range(p.n_lately - FEW, p.n_lately):
        rate += p.lately[k % LATELY, i - FORCES] / FEW
        when += p.t_lately[k % LATELY] / FEW
    rate -= p.m_level[p.mark, i] + p.m_drift[p.mark, i] * (when - p.m_t[p.mark])
    return float(rate / max(when - p.onset, EARLY))


@jit
def returned(p: Any, i: int, size: float) -> bool:
    """Whether a change of moment is for the most part the end of what the model was off by before: a model that fits again is no fault."""
    return abs(p.m_drift[p.mark, i] + size) < REVERSE * abs(size)


@jit
def ended(p: Any, bit: int, k: int, size: float) -> bool:
    """Whether a change is the end of the fault ``k`` that lasts."""
    return (p.wrong >> bit) & 1 == 1 and abs(size + p.was[k]) < REVERSE * abs(p.was[k])


@jit
def conclude(s: Any, k: int, detail: Any, size: float, sd: float, candidates: int, code: Any) -> None:
    """Say that fault ``k`` (an axis, or six and a rotor) is there, or that it is over."""
    p = s.pairs[0]
    if ended(p, k, k, size):
        p.wrong &= ~(UP << k)
        tell(s, E_OVER, detail, size, sd, candidates)
        return
    known = (p.wrong >> k) & 1 == 1 and k >= 6  # a rotor's fault that is carried was not quite that large
    p.wrong |= UP << k
    p.was[k] = size + (p.was[k] if known else 0.0)
    if not known or abs(size) > 0.5 * abs(p.was[k]):
        tell(s, code, detail, p.was[k], sd, candidates)


@jit
def signature(s: Any, k: int) -> tuple[float, float, float]:
    """What all of a rotor's thrust is of roll, pitch [rad/s^2] and force along z [m/s^2]."""
    m = s.model[0]
    o2 = s.speed[k] * s.speed[k] * s.pairs[0].ratio
    return m.k[3, 0] * m.roll[k] * o2, m.k[4, 0] * m.pitch[k] * o2, m.k[2, 0] * o2


@jit
def lift(s: Any, k: int, thrust: float, m_q: float, s_q: float) -> None:
    """Let the model have a rotor's thrust as it was found, and its torque: as much, or what the yawing moment says."""
    p, m = s.pairs[0], s.model[0]
    g = m.k[5, 0] * m.yaw[k] * s.speed[k] * s.speed[k] * p.ratio
    gain = TORQUE * TORQUE * g / (TORQUE * TORQUE * g * g + s_q * s_q)
    over = (p.wrong >> (6 + k)) & 1 == 0
    p.lift[k] = 0.0 if over else p.lift[k] + thrust
    p.torque[k] = 0.0 if over else p.torque[k] + thrust + gain * (m_q - g * thrust)
    p.lifted = 1


@jit
def of_moments(s: Any, prm: Any) -> bool:
    """A gyro axis, a moment of the model, or a rotor; False where it is not clear yet which rotor."""
    p = s.pairs[0]
    if p.t_first - p.onset > OLD:  # a long window was full already: it says nothing of when
        for i in range(R, 6):
            if p.t_alarm[i] == p.t_first:
                p.onset = began(p, i - R, p.m_drift[p.mark, i])
                p.mark = max(mark_before(p, p.onset - 2.0 * BLOCK), 0)
    m_r, s_r = moment_of(s, R)
    m_p, s_p = moment_of(s, P)
    m_q, s_q = moment_of(s, Q)
    span = max(s.t - p.onset, EARLY)
    f = p.mean_T - p.m_level[p.mark, T]
    s_f = math.sqrt(p.r[T] / max(p.mean_n, 1.0) + lasting(s, T) * min(1.0, 2.0 * LASTS / span) + LEAST_F * LEAST_F)
    alarmed = (p.t_alarm[R] != 0.0) + (p.t_alarm[P] != 0.0) + (p.t_alarm[Q] != 0.0)
    for i in range(R, 6):  # a rate that steps and stays, and the other axes keep quiet
        if p.t_alarm[i] != 0.0 and alarmed == 1:
            better, step, onset = shape(p, i - R, p.m_drift[p.mark, i], p.onset - AROUND)
            if better > -MARGIN:
                p.t_step[i - R], p.step[i - R] = onset, step
            if better > MARGIN and abs(step) > prm.diagnosis_gyro and p.calm <= CALM_ENOUGH:
                name_gyro(s, i - R)
                return True
            if better > -MARGIN and s.t < p.onset + UNDECIDED:
                return False
            if better > -MARGIN:
                return True  # it may be the gyro's: the bank will say so
    first, other, least, second, thrust = -1, -1, 1e18, 1e18, 0.0
    for k in range(min(len(s.speed), MOST)):
        g = signature(s, k)
        weight = (1.0 / (s_r * s_r), 1.0 / (s_p * s_p), 1.0 / (s_f * s_f))
        den = g[0] * g[0] * weight[0] + g[1] * g[1] * weight[1] + g[2] * g[2] * weight[2]
        if den <= 0.0:
            continue
        d = (g[0] * m_r * weight[0] + g[1] * m_p * weight[1] + g[2] * f * weight[2]) / den
        left = misfit(m_r, d * g[0], s_r) + misfit(m_p, d * g[1], s_p) + misfit(f, d * g[2], s_f) + off_torque(s, k, d, m_q)
        if left < least:
            first, other, least, second, thrust = k, first, left, least, d
        elif left < second:
            other, second = k, left
    if first >= 0:  # torque tells rotors apart; it does not speak against all of them
        of_torque = off_torque(s, first, thrust, m_q)
        least, second = least - of_torque, second - of_torque
    nothing = (m_r / s_r) * (m_r / s_r) + (m_p / s_p) * (m_p / s_p) + (f / s_f) * (f / s_f)
    alone = (nothing - (m_r / s_r) * (m_r / s_r), nothing - (m_p / s_p) * (m_p / s_p), nothing)
    spread = (m_q / s_q) * (m_q / s_q)
    axis, single = Q, alone[2]
    if p.t_alarm[R] != 0.0 and alone[0] + spread < single:
        axis, single = R, alone[0] + spread
    if p.t_alarm[P] != 0.0 and alone[1] + spread < single:
        axis, single = P, alone[1] + spread
    if p.t_alarm[Q] == 0.0 and axis == Q:
        axis, single = (R, alone[0]) if abs(m_r / s_r) > abs(m_p / s_p) else (P, alone[1])
    pushed = AS_GUSTS * (by_gusts(s, prm, 0) + by_gusts(s, prm, 1))
    pushed += (abs(p.told_size[0]) if p.t_alarm[0] != 0.0 else 0.0) + (abs(p.told_size[1]) if p.t_alarm[1] != 0.0 else 0.0)
    least_moment = prm.diagnosis_moment + OFF_CENTRE * pushed + HARD * p.hard
    carried = -1
    for k in range(min(len(s.speed), MOST)):
        if (p.wrong >> (6 + k)) & 1 == 1:
            carried = k
    if carried >= 0 and p.lifted == 1:  # its thrust is not what was found by so much, or goes with speed in another way
        g = signature(s, carried)
        small = abs(m_r) < PART * abs(p.lift[carried] * g[0]) and abs(m_p) < PART * abs(p.lift[carried] * g[1])
        if small and (first != carried or abs(thrust) < PART * abs(p.lift[carried])):
            weight = (1.0 / (s_r * s_r), 1.0 / (s_p * s_p), 1.0 / (s_f * s_f))
            den = g[0] * g[0] * weight[0] + g[1] * g[1] * weight[1] + g[2] * g[2] * weight[2]
            lift(s, carried, (g[0] * m_r * weight[0] + g[1] * m_p * weight[1] + g[2] * f * weight[2]) / den, m_q, s_q)
            return True
    turns = 0.0
    if first >= 0:
        g = signature(s, first)
        turns = abs(thrust) * math.sqrt(g[0] * g[0] + g[1] * g[1])
    if first >= 0 and least + MARGIN < single and abs(thrust) > LEAST_ROTOR and turns > least_moment:
        if second - least < UNLIKE and s.t - p.t_first < LONGER:
            return False
        if second - least < NEARLY:
            both = (UP << (B_ROTOR + first)) | (UP << (B_ROTOR + other)) | (UP << (B_TACHOMETER + first)) | (UP << (B_TACHOMETER + other))
            tell(s, E_SUSPECT, ROTOR + first, thrust, 0.02, both)
            return True
        if (p.wrong >> (6 + first)) & 1 == 0 and returned(p, R, m_r) and returned(p, P, m_p):
            return True
        bits = (UP << (B_ROTOR + first)) | (UP << (B_TACHOMETER + first))
        conclude(s, 6 + first, ROTOR + first, thrust, 0.02, bits, E_FAULT)
        lift(s, first, thrust, m_q, s_q)
        return True
    size, sd = lately(s, axis), s_r if axis == R else (s_p if axis == P else s_q)
    if (p.wrong >> axis) & 1 == 0 and returned(p, axis, size):
        return True
    if abs(size) > max(least_moment, SIGMAS * sd):  # what the vehicle file says the model is off by is no fault
        conclude(s, axis, MODEL + axis, size, sd, UP << axis, E_FAULT)
        return True
    return bool(s.t >= p.onset + UNDECIDED)


@jit
def off_torque(s: Any, k: int, thrust: float, m_q: float) -> float:
    """How badly a yawing moment goes with a rotor's thrust that is off by a part: torque is off by as much, or not at all."""
    p, m = s.pairs[0], s.model[0]
    g = m.k[5, 0] * m.yaw[k] * s.speed[k] * s.speed[k] * p.ratio
    span = max(s.t - p.onset, EARLY)
    sd2 = 2.0 * p.r[Q] / (span * span) + density_of_noise(s, Q) / span + offset_variance(s, Q) + HARD * HARD * p.m[2] * p.m[2]
    x = m_q - SOME * thrust * g
    return float(x * x / (sd2 + SOME * SOME * thrust * thrust * g * g))


@jit
def misfit(x: float, y: float, sd: float) -> float:
    """Square of a difference in sigma, of what a signature says but in part."""
    return (x - y) * (x - y) / (sd * sd + LIKE * LIKE * y * y)


@jit
def silent(s: Any, prm: Any, a: int, size: float) -> int:
    """Of an accelerometer axis: 1 the bank would have seen a fault of this size and has not, -1 it sees one, 0 it cannot tell yet."""
    p = s.pairs[0]
    if len(s.bank) == 0:
        return 0
    b = s.bank[0]
    near = 1e18
    for k in range(len(b.live)):
        if b.live[k] == 1:
            near = min(near, abs(b.onset[k] - p.onset))
    if near > NEAR:
        return 0
    for k in range(len(b.live)):  # it may have begun with the window that alarmed, or with the alarm
        if b.live[k] == 0 or (abs(b.onset[k] - p.onset) > near and (b.onset[k] < p.onset or b.onset[k] > p.t_first + AROUND)):
            continue
        j = (ACCEL + a) * SLOTS + k
        if b.num[j] * b.num[j] > prm.diagnosis_threshold * max(b.den[j], 1e-9):
            return -1
        likely = b.num[j] / max(b.den[j], 1e-9) * math.copysign(1.0, size)
        likely = math.copysign(min(max(likely, (1.0 - ABOUT) * abs(size)), (1.0 + ABOUT) * abs(size)), size)
        if 2.0 * likely * b.num[j] - likely * likely * b.den[j] > -(AGAINST_Z if a == T else AGAINST):
            return 0
    return 1


@jit
def by_gusts(s: Any, prm: Any, a: int) -> float:
    """1 sigma of the force along an axis that gusts like those of late make [m/s^2]."""
    p = s.pairs[0]
    gust = prm.air_gust
    if len(s.wind) > 0:
        gust, _ = gusts(s, prm)
        if len(s.drag) > 0:
            gust /= max(math.exp(s.drag[0]), 1e-3)
    gust *= p.calm
    x, y, z = p.by_v[0, a, 0], p.by_v[0, a, 1], DOWN * p.by_v[0, a, 2]
    return gust * math.sqrt(x * x + y * y + z * z)


@jit
def of_forces(s: Any, prm: Any, since: float) -> None:
    """Forces: wind, or the model's or the accelerometer's."""
    p = s.pairs[0]
    if p.still == 0:  # looked at once, soon after the alarm: later the filter's wind has followed
        W, a = (p.m_wind[p.mark, 0], p.m_wind[p.mark, 1]), 0
        for i in range(FORCES):
            a = i if abs(p.told_size[i]) > abs(p.told_size[a]) else a
        still = W[0] * W[0] + W[1] * W[1] < STILL * STILL and p.t_flying < p.onset - STILL_FOR
        p.still = 1 if still and abs(p.told_size[a]) > by_gusts(s, prm, a) else -1
        if p.still == 1:
            start(s)
            return
    if p.still < 0:  # wind, whatever else
        settle_forces(s, ANEW, SOON)
        return
    more, axis, slot, step = latest(s)
    if more > AFRESH and abs(step) > prm.diagnosis_force:  # whatever it began for, this is more: it is looked at from here on
        p.onset, p.t_first, p.statistic, p.threshold = p.later[slot], s.t, more, AFRESH
        for i in range(FORCES):
            p.t_alarm[i], p.told_size[i] = 0.0, 0.0
        p.t_alarm[axis], p.told_size[axis] = s.t, step
        again(s, slot)
        return
    a = best(s)
    gap = against_wind(p, a)
    others, worth = 1e18, p.misfit[NOTHING] - p.misfit[a]  # against another axis, and against no fault at all
    for i in range(FORCES):
        if i != a:
            others = min(others, p.misfit[i] - p.misfit[a])
    size = p.tried[a, PUSH]
    if since > COMPARED and gap < (-MARGIN if since > WAIT else -SURE):
        if since > WAIT:
            go_on(s, SOON)
        else:
            settle_forces(s, ANEW, SOON)
        return
    small = abs(size) < max(0.5 * prm.diagnosis_force, BEYOND_GUSTS * by_gusts(s, prm, a))
    if since > 1.0 and more < PERHAPS and (small or (since > 1.5 and worth < LITTLE * min(since, 3.0))):  # gusts, chance, or gone by itself
        go_on(s, BRIEFLY)
        return
    if len(s.bank) > 0 and s.bank[0].alarm != 0 and since < WAIT:  # an inertial fault is about to be named
        return
    quiet = silent(s, prm, a, size)
    decided = gap + (by_chance(s, a) if p.moved > 1.0 else 0.0)  # in hover a wind along an axis is no chance to convict on
    windy = decided < (MARGIN if since < WAIT else LATE) or len(s.wind) == 0
    if gap < MARGIN and abs(size) < BEYOND_WIND * by_old_wind(s, a):  # as well the wind before, which was not known so well
        if since > WAIT and more < PERHAPS:
            go_on(s, SOON)
        return
    if worth > WORTH and others > MARGIN and not windy and quiet == 1:
        conclude(s, a, MODEL + a, size, 0.05, UP << a, E_FAULT)
        settle_forces(s, DEAF, DEAF)
        return
    near = 0.0 if p.moved > 1.0 else -MARGIN  # in flight a wind that explains better is not named beside a force
    if worth > WORTH and since > COMPARED and gap > near and quiet == 1 and p.both == 0:  # both, until the vehicle has turned
        p.both = 1
        conclude(s, a, MODEL + a, size, 0.05, (UP << a) | (UP << B_WIND), E_SUSPECT)
    if since > WAIT and more < PERHAPS:
        if worth > SURE and quiet == 0 and not windy:  # three that it may be are no verdict
            conclude(s, a, MODEL + a, size, 0.05, (UP << a) | (UP << (B_ACCEL + a)), E_SUSPECT)
        go_on(s, SOON)
