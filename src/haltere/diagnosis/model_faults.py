"""What an alarm of model against IMU means: an axis of the model, a rotor or its tachometer, wind, or a sensor. It detects nothing.

After the first alarm the others are waited for (theory.md §5.5, theory-amendments.md 2, 3, 16). A level of a rate that has stepped and
stays is the gyro's; one that goes on is a moment that the model does not have. Roll, pitch and thrust in the ratio of one rotor are that
rotor, which has less thrust or whose tachometer is wrong: that is not told apart. Thrust alone is the model's or the accelerometer's until
the bank of `haltere.diagnosis.inertial` is silent with power. A force across the thrust axis is {model, wind} where the air was still,
and nobody's in wind; both of them are wind, and no fault.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids.air import wind_n
from haltere.aids.record import E_FAULT, E_OVER, E_SUSPECT, NO_SENSOR, event_since
from haltere.diagnosis.pairs import calm_again, change
from haltere.diagnosis.stand_in import density_of_noise, offset_variance
from haltere.filter.signatures import ACCEL, SLOTS

__all__ = ["CANDIDATES", "MODEL", "ROTOR", "judge"]

#: Codes of an event, above those of `haltere.diagnosis.steps`: six axes of the model, then rotors.
MODEL, ROTOR = constant(64), constant(70)
#: Most rotors that are told apart.
MOST = 8
#: Bits of what an event may be: model axes, wind, accelerometer axes, gyro axes, rotors, their tachometers.
CANDIDATES = (
    "model.hx", "model.hy", "model.t", "model.r", "model.p", "model.q", "wind", "accel.x", "accel.y", "accel.z",
    "gyro.x", "gyro.y", "gyro.z",
    *(f"rotor.{k}" for k in range(MOST)), *(f"rotors.{k}" for k in range(MOST)),
)  # fmt: skip
B_WIND, B_ACCEL, B_GYRO, B_ROTOR, B_TACHOMETER = (constant(i) for i in (6, 7, 10, 13, 21))
#: When a change is looked at first, and when a verdict on moments is given [s]; how long one on forces may wait.
EARLY, COLLECT, WAIT = 0.08, 0.3, 2.5
#: A change of rate that has grown by less than this factor from one to the other is a step.
STEPPED = 1.6
#: By how much a hypothesis must explain better, in twice the log likelihood; what a signature is off by itself, and least 1 sigma.
MARGIN, LIKE, LEAST_M, LEAST_F = 9.0, 0.2, 0.15, 0.08
#: Least change of a rotor's thrust that is a fault.
LEAST_ROTOR = 0.03
#: Air that is still: wind and gusts below these [m/s].
STILL = 1.5
#: Drag that a wind as large as a force would have [1/s]; what the other axis may show of a force along one; in the air before [s].
TYPICAL_DRAG, BESIDE, STILL_FOR = 0.3, 0.3, 3.0
#: Statistics of the bank for silence with power: 99 %.
POWER = 2.33
#: A fault is over when the change is its reverse within this part.
REVERSE = 0.4
UP, FORCES, T, R, P, Q = (constant(i) for i in (1, 3, 2, 3, 4, 5))


@jit
def judge(s: Any, prm: Any) -> None:
    """Look at a pending alarm; a verdict ends it."""
    p = s.pairs[0]
    since = s.t - p.t_first
    if len(s.bank) > 0 and s.bank[0].healed != p.healed:  # an inertial fault was named meanwhile: it explains this
        settle(s)
        return
    if s.t - p.onset >= EARLY and p.early[5] != p.early[5]:
        for i in range(6):
            p.early[i] = change(s, i)
    if since < COLLECT:
        return
    if p.mark < 0:
        settle(s)
        return
    moments = False
    for i in range(R, 6):  # later ones are what the vehicle makes of the first
        if p.t_alarm[i] > p.t_first + COLLECT:
            p.t_alarm[i] = 0.0
        moments = moments or p.t_alarm[i] != 0.0
    if moments:
        of_moments(s, prm)
        settle(s)
    elif p.t_alarm[0] != 0.0 or p.t_alarm[1] != 0.0:
        across(s, prm, since)
    elif p.t_alarm[T] != 0.0:
        of_thrust(s, prm, since)
    else:
        settle(s)


@jit
def settle(s: Any) -> None:
    """End an alarm; levels as they are now are what is usual from here on."""
    p = s.pairs[0]
    p.t_first = 0.0
    for i in range(6):
        calm_again(s, i)
        p.early[i], p.told_size[i] = math.nan, 0.0
    p.still = 0


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


@jit
def moment_of(s: Any, i: int) -> tuple[float, float]:
    """Moment that the model lacks since the onset, and its 1 sigma [rad/s^2]."""
    p = s.pairs[0]
    span = max(s.t - p.onset, EARLY)
    sd2 = 2.0 * p.r[i] / (span * span) + density_of_noise(s, i) / span + offset_variance(s, i) + LEAST_M * LEAST_M
    return change(s, i) / span, math.sqrt(sd2)


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
    p.wrong |= UP << k
    p.was[k] = size
    tell(s, code, detail, size, sd, candidates)


@jit
def signature(s: Any, k: int) -> tuple[float, float, float]:
    """What all of a rotor's thrust is of roll, pitch [rad/s^2] and force along z [m/s^2]."""
    m = s.model[0]
    o2 = s.speed[k] * s.speed[k] * s.pairs[0].ratio
    return m.k[3, 0] * m.roll[k] * o2, m.k[4, 0] * m.pitch[k] * o2, m.k[2, 0] * o2


@jit
def of_moments(s: Any, prm: Any) -> None:
    """A gyro axis, a moment of the model, or a rotor."""
    p = s.pairs[0]
    m_r, s_r = moment_of(s, R)
    m_p, s_p = moment_of(s, P)
    m_q, s_q = moment_of(s, Q)
    f, s_f = change(s, T), math.sqrt(offset_variance(s, T) + LEAST_F * LEAST_F)
    for i in range(R, 6):  # a rate that steps and stays, and the other axes keep quiet
        others = (p.t_alarm[R] != 0.0) + (p.t_alarm[P] != 0.0) + (p.t_alarm[Q] != 0.0) - 1
        if p.t_alarm[i] != 0.0 and others == 0 and abs(change(s, i)) < STEPPED * abs(p.early[i]):
            return  # the gyro's: steps and bank say so
    best, least, lift = -1, 1e18, 0.0
    for k in range(min(len(s.speed), MOST)):
        g = signature(s, k)
        weight = (1.0 / (s_r * s_r), 1.0 / (s_p * s_p), 1.0 / (s_f * s_f))
        den = g[0] * g[0] * weight[0] + g[1] * g[1] * weight[1] + g[2] * g[2] * weight[2]
        if den <= 0.0:
            continue
        d = (g[0] * m_r * weight[0] + g[1] * m_p * weight[1] + g[2] * f * weight[2]) / den
        left = misfit(m_r, d * g[0], s_r) + misfit(m_p, d * g[1], s_p) + misfit(f, d * g[2], s_f)
        if left < least:
            best, least, lift = k, left, d
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
    if best >= 0 and least + MARGIN < single and abs(lift) > LEAST_ROTOR:
        conclude(s, 6 + best, ROTOR + best, lift, 0.02, (UP << (B_ROTOR + best)) | (UP << (B_TACHOMETER + best)), E_FAULT)
        return
    size, sd = (m_r, s_r) if axis == R else ((m_p, s_p) if axis == P else (m_q, s_q))
    if abs(size) > prm.diagnosis_moment:
        conclude(s, axis, MODEL + axis, size, sd, UP << axis, E_FAULT)


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
    best, near = -1, 1e18
    for k in range(len(b.live)):
        if b.live[k] == 1 and abs(b.onset[k] - p.onset) < near:
            best, near = k, abs(b.onset[k] - p.onset)
    if best < 0 or near > 0.5:
        return 0
    j = (ACCEL + a) * SLOTS + best
    h = prm.diagnosis_threshold
    level = b.num[j] * b.num[j] / max(b.den[j], 1e-9)
    root = math.sqrt(h) + POWER
    if level > h:
        return -1
    return 1 if size * size * b.den[j] >= root * root else 0


@jit
def of_thrust(s: Any, prm: Any, since: float) -> None:
    """Force along the thrust axis: the model's, or the accelerometer's."""
    p = s.pairs[0]
    size = change(s, T)
    if abs(size) < 0.5 * abs(p.told_size[T]) and abs(size) < prm.diagnosis_force:  # gone by itself
        settle(s)
        return
    quiet = silent(s, prm, T, size)
    if quiet == 1:
        conclude(s, T, MODEL + T, size, 0.05, UP << T, E_FAULT)
        settle(s)
    elif since > WAIT and quiet == 0:
        conclude(s, T, MODEL + T, size, 0.05, (UP << T) | (UP << (B_ACCEL + 2)), E_SUSPECT)
        settle(s)
    elif since > 2.0 * WAIT:
        settle(s)


@jit
def across(s: Any, prm: Any, since: float) -> None:
    """Forces across the thrust axis: wind, or in still air the model's or the accelerometer's."""
    p = s.pairs[0]
    p.t_across = s.t
    first, second = abs(p.told_size[0]), abs(p.told_size[1])
    a = 0 if first > second else 1
    size = p.told_size[a]
    if p.still == 0:  # looked at once, soon after the alarm: later the filter's wind has followed
        W = wind_n(s)
        moved = size / TYPICAL_DRAG
        still = W[0] * W[0] + W[1] * W[1] < STILL * STILL + moved * moved and p.t_flying < p.onset - STILL_FOR
        p.still = 1 if still and min(first, second) < BESIDE * max(first, second) else -1
    if p.still < 0:  # wind, whatever else
        settle(s)
        return
    quiet = silent(s, prm, a, size)
    if quiet == 1:
        conclude(s, a, MODEL + a, size, 0.05, (UP << a) | (UP << B_WIND), E_SUSPECT)
        settle(s)
    elif since > WAIT and quiet == 0:
        conclude(s, a, MODEL + a, size, 0.05, (UP << a) | (UP << (B_ACCEL + a)), E_SUSPECT)
        settle(s)
    elif since > 2.0 * WAIT:
        settle(s)
