"""Compass watch: does the compass turn when the gyro does not, and is the field still the one it was? It fuses nothing.

Of the innovation of heading and the turns that corrections made, only the difference D of compass and gyro is left, whatever the filter
believes: D(t) - D(t - L) less the drift of a gyro bias held from t - L shows a disturbance that is slower than any innovation test
(theory-amendments.md §19). Without turning, no calibration error can change, so that the bound is tight in hover and wide in a turn. On an
alarm what the compass has done to yaw and gyro bias since the onset is taken back, and both are held until it agrees again.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids.fusing import RUNNING
from haltere.aids.record import (
    E_DISTURBED,
    E_RECOVERED,
    E_TIMEOUT,
    MAGNETOMETER,
    R_DIP,
    R_DISTURBED,
    R_NONE,
    R_STRENGTH,
    event,
    event_since,
)
from haltere.core.rotation import Mat, Vec, dcm, quat_from_rotvec, quat_mul, quat_unit, wrap
from haltere.filter.robust import IGG3, inflate
from haltere.strapdown.layout import COMPASS_BINS

__all__ = [
    "OUT_APART",
    "OUT_FIELD",
    "OUT_STEP",
    "OUT_TURN",
    "allowed",
    "along",
    "attribute",
    "forget",
    "level",
    "moment",
    "observe",
    "put_out",
    "tilt_variance",
    "unsee",
    "vertical_bias",
    "yaw_sd",
]

#: A bin of the history [s], and the smoothing of innovations while the compass is out [s].
BIN, SLOW = 0.1, 2.0
#: Lags over which compass and gyro are compared [s]; the windows averaged at both ends are a fifth of them.
LAGS = (1.0, 2.0, 5.0, 10.0)
#: Error of a sample's time [s], which turns a levelled heading by the tilt of that time.
LATE = 0.02
#: How many sigma a lag must differ, and how long a compass that was out must agree before it is believed again [s].
SIGMAS, AGREED = 4.0, 5.0
#: Bounds of the robust weight of strength and dip, in tolerances (theory.md §4.7), and how fast their reference follows [s].
SOFT, HARD_LIMIT, FOLLOW = 2.0, 6.0, 20.0
#: Share of refused samples, over about a third of a second, that puts the compass out.
BAD_SHARE, BAD_SPAN = 0.6, 0.33
#: No disturbance below the horizontal field turns a compass further: beyond, it is the gyro [rad].
BEYOND = 0.5 * math.pi
#: What is then taken to be wrong, 1 sigma: yaw [rad] and vertical gyro bias [rad/s].
YAW_SPOILT, BIAS_SPOILT = math.radians(60.0), 0.1
#: What put the compass out.
OUT_TURN, OUT_FIELD, OUT_APART, OUT_STEP = (constant(i) for i in (1, 2, 3, 4))


@jit
def forget(s: Any) -> None:
    """Start the history anew: at the beginning, after a gap, when the compass comes back."""
    c = s.compass
    c.out, c.n, c.filled, c.head, c.seen = 0, 0, 0, 0, 0
    c.bad, c.total, c.slow, c.pending = 0.0, 0.0, 0.0, 0


@jit
def along(P: Any, d: Vec, block: int) -> float:
    """Variance along d of three states from a column of P on."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += d[i] * P[block + i, block + j] * d[j]
    return total


@jit
def widen(P: Any, d: Vec, block: int, variance: float) -> None:
    """Add a variance along d to three states from a column of P on."""
    for i in range(3):
        for j in range(3):
            P[block + i, block + j] += variance * d[i] * d[j]


@jit
def level(s: Any, prm: Any, strength: float, dip: float, dt: float) -> tuple[float, int]:
    """Weight that strength [uT] and dip [rad] of a sample leave it, and the reason to refuse it, against the field of the flight so far.

    The reference begins at the first sample and follows with `FOLLOW` what is not refused: a compass with a calibration of its own
    is compared with itself. While the compass is out it follows anything, slowly, so that a field that has changed for good is believed
    some day; its heading must agree all the same. Absolute bounds against the Earth's field are tested elsewhere (aids.magnetometer).
    """
    c = s.compass
    if c.known == 0:
        c.known, c.strength, c.dip = 1, strength, dip
    by_strength = inflate(IGG3, abs(strength / c.strength - 1.0) / prm.robust_strength, SOFT, HARD_LIMIT)
    by_dip = inflate(IGG3, abs(dip - c.dip) / prm.robust_dip, SOFT, HARD_LIMIT)
    worst = max(by_strength, by_dip)
    refused = worst > 1e3
    if c.out != 0 or not refused:
        k = min(1.0, max(dt, 0.0) / FOLLOW) / (4.0 if c.out != 0 else worst)
        c.strength += k * (strength - c.strength)
        c.dip += k * (dip - c.dip)
    if refused:
        return 0.0, R_STRENGTH if by_strength >= by_dip else R_DIP
    return 1.0 / worst, R_NONE


@jit
def vertical_bias(s: Any) -> float:
    """Gyro bias about the vertical [rad/s]."""
    d = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2]
    return float(d[0] * s.bg[0] + d[1] * s.bg[1] + d[2] * s.bg[2])


@jit
def attribute(s: Any, yaw: float, bias: float) -> None:
    """Book on the compass what its update did: ``yaw`` is ``s.yaw_corrected`` before it, ``bias`` the vertical gyro bias."""
    c = s.compass
    c.pulled += s.yaw_corrected - yaw
    c.pulled_bias += vertical_bias(s) - bias


@jit
def yaw_sd(s: Any) -> float:
    """1 sigma of the attitude error about the vertical [rad]."""
    return math.sqrt(along(s.P, dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2], 0))


@jit
def tilt_variance(s: Any) -> float:
    """Variance of one axis of tilt [rad^2], the mean of both."""
    yaw = along(s.P, dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2], 0)
    return max(0.0, 0.5 * (s.P[0, 0] + s.P[1, 1] + s.P[2, 2] - yaw))


@jit
def back(c: Any, k: int) -> int:
    """Place in the ring of the bin k bins before the newest."""
    return (c.head - 1 - k) % COMPASS_BINS


@jit
def unsee(s: Any, t: float) -> None:
    """Forget the samples since t."""
    c = s.compass
    c.n, c.total = 0, 0.0
    while c.filled > 0 and c.bin[back(c, 0)].t > t:
        c.head = (c.head - 1) % COMPASS_BINS
        c.filled -= 1


@jit
def take_back(s: Any, prm: Any, k: int) -> None:
    """Undo in yaw and vertical gyro bias what the compass did since the bin k bins ago; the filter is then as unsure as it was."""
    c, b = s.compass, s.compass.bin[back(s.compass, k)]
    q = (s.q[0], s.q[1], s.q[2], s.q[3])
    d = dcm(q)[2]
    dt = c.t_last - b.t
    turn = -(c.pulled - b.pulled) + (c.pulled_drift - b.pulled_drift - b.pulled_bias * dt)
    q = quat_unit(quat_mul(quat_from_rotvec((0.0, 0.0, turn)), q))
    s.q[0], s.q[1], s.q[2], s.q[3] = q
    s.yaw_corrected += turn
    for i in range(3):
        s.bg[i] -= d[i] * (c.pulled_bias - b.pulled_bias)
    c.pulled, c.pulled_bias = b.pulled, b.pulled_bias
    grown = b.yaw_var + prm.noise_gyro * prm.noise_gyro * dt + b.bias_var * dt * dt
    widen(s.P, d, 0, max(0.0, grown - along(s.P, d, 0)))
    widen(s.P, d, 9, max(0.0, b.bias_var - along(s.P, d, 9)))


@jit
def moment(s: Any, t: float) -> tuple[int, float]:
    """How many bins ago time t was, the last bin before it, and the largest rate about then [rad/s]."""
    c = s.compass
    k, rate = 0, 0.0
    while k < c.filled - 1 and c.bin[back(c, k)].t >= t:
        k += 1
    for i in range(max(k - 1, 0), min(k + 2, c.filled)):
        rate = max(rate, c.bin[back(c, i)].rate)
    return k, rate


@jit
def put_out(s: Any, prm: Any, k: int, cause: Any, value: float, threshold: float) -> None:
    """The compass is disturbed since the bin k bins ago: take back what it did, and hear it no more."""
    c = s.compass
    c.onset, c.level = c.t_last, c.last
    if c.filled > 0:
        c.onset, c.level = c.bin[back(c, k)].t, c.bin[back(c, k)].d
        take_back(s, prm, k)
    c.out, c.t_good, c.yaw_sd = cause, c.t_last, yaw_sd(s)
    c.jump = 2.0 * allowed(s, prm) if cause == OUT_FIELD else abs(value)
    event_since(s, c.t_last, c.onset, E_DISTURBED, MAGNETOMETER, value, threshold, cause)


@jit
def allowed(s: Any, prm: Any) -> float:
    """Turn against the gyro [rad] that is no disturbance: half the 1 sigma of what surroundings do, and a little."""
    return prm.robust_heading + 0.5 * prm.noise_field / (s.field[2] * math.cos(s.field[1]))


@jit
def compare(s: Any, prm: Any) -> tuple[float, float, int]:
    """Largest ratio of a lag's difference to its bound: the difference and the bound [rad], and how many bins ago the lag begins."""
    c = s.compass
    now = c.bin[back(c, 0)]
    worst, difference, bound, begin = 0.0, 0.0, 1.0, 0
    k = 0
    for lag in LAGS:
        while k < c.filled - 1 and now.t - c.bin[back(c, k)].t < lag - 0.5 * BIN:
            k += 1
        b = c.bin[back(c, k)]
        span = now.t - b.t
        w = max(1, k // 5)
        if span < lag - 0.5 * BIN or span > 1.5 * lag or k + w > c.filled:
            break
        r = 0.0
        for i in range(w):
            r += (c.bin[back(c, i)].d - c.bin[back(c, k + i)].d) / w
        r -= now.drift - b.drift - b.bias * span
        wrong = prm.noise_gyro_scale * (now.path - b.path)
        mended = max(0.0, b.tilt_var - now.tilt_var)  # a tilt that was mended since has turned the levelled heading
        tilted = math.tan(s.field[1]) * math.tan(s.field[1]) * mended
        sd = math.sqrt(2.0 * c.noise / w + prm.noise_gyro * prm.noise_gyro * span + b.bias_var * span * span + wrong * wrong + tilted)
        same = now.q[0] * b.q[0] + now.q[1] * b.q[1] + now.q[2] * b.q[2] + now.q[3] * b.q[3]
        turned = 2.0 * math.sqrt(max(0.0, 1.0 - same * same))  # chord of the rotation: how far a fixed error of the field has moved
        limit = allowed(s, prm) + prm.robust_calibration * turned / math.cos(s.field[1]) + SIGMAS * sd
        limit += LATE * max(now.rate, b.rate) * math.tan(abs(s.field[1]))
        if abs(r) > worst * limit:
            worst, difference, bound, begin = abs(r) / limit, r, limit, k
    return difference, bound, begin


@jit
def onset(c: Any, difference: float, begin: int) -> int:
    """How many bins ago the difference began: before it every bin is within a quarter of it of the lag's beginning."""
    b = c.bin[back(c, begin)]
    k = 0
    while k < begin:
        x = c.bin[back(c, k)]
        if (x.d - b.d - (x.drift - b.drift - b.bias * (x.t - b.t))) * difference < 0.25 * difference * difference:
            break
        k += 1
    return min(k + 1, begin)


@jit
def close_bin(s: Any, prm: Any) -> None:
    """Put the mean of a tenth of a second into the history, and compare it with what was."""
    c = s.compass
    q = (s.q[0], s.q[1], s.q[2], s.q[3])
    d = dcm(q)[2]
    mean = c.total / c.n
    if c.filled > 0:
        step = mean - c.bin[back(c, 0)].d
        c.noise += 0.02 * (min(0.5 * step * step, 9.0 * c.noise) - c.noise)
    else:
        sd = prm.noise_magnetometer / (s.field[2] * math.cos(s.field[1]))
        c.noise = sd * sd / c.n
    b = c.bin[c.head]
    b.t, b.d, b.drift, b.pulled, b.pulled_bias, b.pulled_drift = c.t_last, mean, c.drift, c.pulled, c.pulled_bias, c.pulled_drift
    b.rate = (c.path - c.path_before) / max(c.t_last - c.t_close, 1e-3)
    c.path_before, c.t_close = c.path, c.t_last
    b.path = c.path
    b.bias = d[0] * s.bg[0] + d[1] * s.bg[1] + d[2] * s.bg[2]
    b.yaw_var, b.tilt_var, b.bias_var = along(s.P, d, 0), tilt_variance(s), along(s.P, d, 9)
    for i in range(4):
        b.q[i] = q[i]
    c.head = (c.head + 1) % COMPASS_BINS
    c.filled = min(c.filled + 1, COMPASS_BINS)
    c.n, c.total = 0, 0.0
    if c.out == 0:
        difference, bound, begin = compare(s, prm)
        if c.pending == 1:
            return  # diagnosis is about to say whether it stepped
        if len(s.bank) > 0 and s.bank[0].ratio > 0.35:
            return  # diagnosis is about to find what is wrong: a tilt turns the levelled heading, too
        if abs(difference) > bound:
            put_out(s, prm, onset(c, difference, begin), OUT_TURN, difference, bound)
        elif abs(c.slow) > apart(s, prm):
            put_out(s, prm, 0, OUT_APART, c.slow, apart(s, prm))


@jit
def apart(s: Any, prm: Any) -> float:
    """How far the smoothed innovation of a sound compass may be off [rad]: what its calibration may do, and the yaw's own uncertainty."""
    return allowed(s, prm) + prm.robust_calibration / math.cos(s.field[1]) + SIGMAS * yaw_sd(s)


@jit
def come_back(s: Any, prm: Any, t: float, fair: bool, C: Mat) -> None:
    """While out: let the compass back in once it agreed with the held yaw for `AGREED` seconds, or turned beyond any disturbance."""
    c = s.compass
    bound = 0.5 * c.jump + SIGMAS * max(0.0, yaw_sd(s) - c.yaw_sd)  # less than what put it out; more as the held yaw is worth less
    if not fair or abs(c.slow) > bound:
        c.t_good = t
    a = s.aid[MAGNETOMETER]
    if t - c.t_good > AGREED:
        event(s, t, E_RECOVERED, MAGNETOMETER, t - c.onset)
    elif fair and c.out == OUT_TURN and abs(c.last - c.level) > BEYOND and t - c.t_bad > 3.0:
        widen(s.P, C[2], 0, YAW_SPOILT * YAW_SPOILT)
        widen(s.P, C[2], 9, BIAS_SPOILT * BIAS_SPOILT)
        event(s, t, E_TIMEOUT, MAGNETOMETER, t - c.onset)
    else:
        return
    forget(s)
    a.started = RUNNING
    a.t_passed = t


@jit
def observe(s: Any, prm: Any, t: float, e: float, weight: float, steady: bool, C: Mat) -> int:
    """Take one sample into the watch, and give the reason to refuse it.

    Parameters
    ----------
    e
        Innovation of heading [rad].
    weight
        What strength and dip leave it; 0 refused.
    steady
        Whether it may speak of the compass: not while something known disturbs it.
    C
        C_nb.
    """
    c = s.compass
    fair = weight > 0.0
    turned = e + s.yaw_corrected
    if c.seen == 0 or t - c.t_last > 1.0 or t <= c.t_last:
        out = c.out
        forget(s)
        c.out, c.t_good = out, t
        c.last, c.seen, c.t_bin, c.t_last, c.t_bad = turned, 1, t, t, t
    dt = t - c.t_last
    c.last += wrap(turned - c.last)
    if c.n > 0 and t - c.t_bin >= BIN:
        close_bin(s, prm)
    if c.n == 0:
        c.t_bin = t
    d = C[2]
    c.drift += (d[0] * s.bg[0] + d[1] * s.bg[1] + d[2] * s.bg[2]) * dt
    c.pulled_drift += c.pulled_bias * dt
    c.path += math.sqrt(s.w[0] * s.w[0] + s.w[1] * s.w[1] + s.w[2] * s.w[2]) * dt
    c.t_last = t
    if steady:
        c.bad += min(1.0, dt / BAD_SPAN) * ((0.0 if fair else 1.0) - c.bad)
    if weight < 1.0:
        c.t_bad = t
    if fair and steady:
        c.total += c.last
        c.n += 1
        c.slow += min(1.0, dt / SLOW) * (e - c.slow)
    if c.out != 0:
        come_back(s, prm, t, fair, C)
    elif c.bad > BAD_SHARE:
        k = 0
        while k < c.filled - 1 and t - c.bin[back(c, k)].t < 3.0 * BAD_SPAN:
            k += 1
        put_out(s, prm, k, OUT_FIELD, c.bad, BAD_SHARE)
    return R_NONE if c.out == 0 else R_DISTURBED
