"""Detectors J21 to J24: the chain that a vehicle's model drives against compass, GNSS velocity, barometer, GNSS position. It names nothing.

Theory.md §5.4(d), theory-amendments.md 2, 4, 5, 10: innovations of `haltere.diagnosis.model_chain` over their sigma, and over what they
come to in this flight, less what follows from the one before, go into a GLR over windows of 1 to 512 samples of the sensor. Compass and
barometer are worth what this flight shows. A threshold is that of a wanted rate of false alarms, times a factor from flights without
faults, raised by what the statistic usually comes to. While an alarm lasts nothing is learnt and the chain goes on as it is; it begins
anew from the filter's state once a verdict has changed what the filter or the model is, or after `PATIENCE`; while an axis of the model is
known to be wrong nobody alarms (theory.md §5.6).
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit, where
from haltere.aids import gnss, interference
from haltere.aids.fusing import DISTRUSTED
from haltere.aids.magnetometer import heading_row
from haltere.aids.record import BAROMETER, E_ALARM, GNSS_VELOCITY, MAGNETOMETER, NO_SENSOR, event_since
from haltere.core.rotation import Mat, Vec, cross, dcm, mat_vec, quat_from_rotvec, quat_mul, quat_unit, sub, wrap
from haltere.diagnosis import doubt
from haltere.diagnosis.model_chain import advance, forget_chain, gather, listen, lost, seed
from haltere.filter import usual
from haltere.filter.update import NONE, apply, column_of, innovation, project, variance
from haltere.filter.windows import empty, take
from haltere.strapdown.dynamics import ATTITUDE, MEAN, PLACE, SPEED
from haltere.strapdown.model_chain import CHAIN_DETECTORS

__all__ = [
    "ALARM", "BY_BAROMETER", "BY_COMPASS", "BY_POSITION", "BY_VELOCITY", "COLOUR", "HEARD", "SILENT", "drive", "forget", "outside", "spoke",
    "testify",
]  # fmt: skip

#: Bits of the model's axes in what is known to be wrong.
AXES_OF_MODEL = constant(63)
#: Detectors in their order, and the code of an event of the first.
BY_COMPASS, BY_VELOCITY, BY_BAROMETER, BY_POSITION = (constant(i) for i in range(4))
ALARM = constant(96)
#: In an event: alarms of J11 to J16 come first; a detector that listened and did not alarm; how much before the onset it may [s].
PAIRS, SILENT, EARLIER = constant(6), -1.0, 0.5
#: What GNSS has at once [s] is GNSS's: a fault of the model takes longer to move the vehicle.
AT_ONCE = 0.6
#: Samples a second that are expected of compass, GNSS velocity, barometer, GNSS position, for the share of false alarms.
HEARD = (50.0, 10.0, 25.0, 10.0)
#: Factors on the levels for innovations that are not white: the largest statistic of 4 h of simulated flights without a fault over that of
#: white ones (seeds from 60500; hover, lissajous, box, tour, figure-eight, a real track; still air and gusts; take-off and landing).
COLOUR = (1.1, 1.05, 1.1, 1.0)
#: An alarm of a chain younger than this [s] is none; nor within this time in the air [s].
SETTLE, AIRBORNE = 4.0, 5.0
#: Memory of what innovations come to, in samples, and at first; how far a lone one may move it; most correlation that is taken out.
LEARN, EARLY, LONE, MOST_RHO = 400.0, 40.0, 9.0, 0.9
#: Bounds of what innovations come to, mean square over what the chain expects; and of a sensor's variance, over what is configured.
LEAST, MOST, LEAST_WORTH = 0.05, 9.0, 0.01
#: An alarm is over when its statistic was not above the threshold for so long [s]; the chain begins anew after one of so long [s].
OVER, PATIENCE = 3.0, 10.0
#: A compass that is put out is compared for so long [s].
COMPARED = 8.0
#: A measurement is older than the end of the block it is heard in by this at most [s].
OLDEST = 0.1


@jit
def forget(s: Any) -> None:
    """There is no chain, and nothing is known of its innovations: after alignment."""
    forget_chain(s)
    c = s.chain[0]
    usual.begin(c, s.t)
    for k in range(CHAIN_DETECTORS):
        c.c0[k], c.c1[k], c.n_learnt[k], c.worth[k] = 1.0, 0.0, 0.0, 1.0
        c.t_alarm[k], c.t_over[k] = -1e9, -1e9


@jit
def begin(s: Any, prm: Any) -> None:
    """Begin the chain at the filter's state, with empty windows."""
    c, p = s.chain[0], s.pairs[0]
    seed(s, prm)
    for k in range(CHAIN_DETECTORS):
        empty(c.w_of[k])
        c.n_heard[k], c.ratio[k] = 0, 0.0
    c.wrong, c.lift = p.wrong, carried(s)
    c.healed = s.bank[0].healed if len(s.bank) > 0 else 0


@jit
def carried(s: Any) -> float:
    """What changes when a rotor's fault is carried otherwise."""
    total = 0.0
    for k in range(len(s.pairs[0].lift)):
        total += s.pairs[0].lift[k]
    return total


@jit
def outdated(s: Any) -> bool:
    """Whether a verdict changed the filter or the model since the chain began."""
    c, p = s.chain[0], s.pairs[0]
    healed = s.bank[0].healed if len(s.bank) > 0 else 0
    return bool(c.wrong != p.wrong or c.lift != carried(s) or c.healed != healed)


@jit
def drive(s: Any, prm: Any, dt: float) -> None:
    """Take the rotor speeds of one interval, and what waits of the other sensors; at the end of a block move the chain, correct it, judge.

    The filter's state is that at the beginning of the interval, and ``s.t`` its end.
    """
    c, p = s.chain[0], s.pairs[0]
    if p.flying == 0 or s.rotor_known == 0 or prm.diagnosis_vehicle == 0.0 or dt > OLDEST:
        forget_chain(s)
        return
    if c.live == 0:
        begin(s, prm)
    if s.t >= s.t_wake:
        listen(s)
    if not gather(s, dt):
        return
    advance(s, prm)
    if lost(s) or outdated(s) or (pending(c, s.t) and s.t - first(c) > PATIENCE):
        forget_chain(s)  # begins anew with the next sample
        return
    hear(s, prm)
    usual.learn(c, s.t)


@jit
def pending(c: Any, t: float) -> bool:
    """Whether an alarm lasts."""
    return bool(t - max(c.t_over[0], c.t_over[1], c.t_over[2], c.t_over[3]) < OVER)


@jit
def first(c: Any) -> float:
    """When the first of the alarms that last began [s]."""
    last = max(c.t_over[0], c.t_over[1], c.t_over[2], c.t_over[3])
    t = 1e18
    for k in range(CHAIN_DETECTORS):
        if c.t_over[k] > last - OVER:
            t = min(t, c.t_alarm[k])
    return t


@jit
def scalar(c: Any, H: Any, e: float, r: float, gate: float) -> tuple[float, float]:
    """One scalar update of the chain: innovation and its variance. Not applied beyond ``gate`` sigma."""
    e = innovation(c, H, e)
    project(c, H)
    S = variance(c, H) + r
    if e * e <= gate * gate * S:
        column_of(c, H)
        for j in range(c.P.shape[0]):
            c.k[j] /= S
        apply(c, H, r, e)
    return e, S


@jit
def by_one(s: Any, prm: Any, k: int, H: Any, e: float, r: float, gate: float) -> None:
    """Correct by a heading or a height, whose variance is ``r`` as configured and what the flight shows it to be, and judge."""
    c = s.chain[0]
    e, S = scalar(c, H, e, r * c.worth[k], gate)
    if learning(s, k):
        square = min(e * e, LONE * S) - S
        c.worth[k] = min(max(c.worth[k] + rate_of(c, k) * square / r, LEAST_WORTH), MOST)
    judge(s, prm, k, (e / math.sqrt(S), 0.0, 0.0), 1)


@jit
def learning(s: Any, k: int) -> bool:
    """Whether it is learnt what innovations come to: while nothing is wrong."""
    c = s.chain[0]
    return not pending(c, s.t) and bool(s.pairs[0].t_first == 0.0 and c.n_heard[k] > 0)


@jit
def rate_of(c: Any, k: int) -> float:
    """How fast it is learnt, a part a sample."""
    return float(1.0 / min(max(c.n_learnt[k], EARLY), LEARN))


@jit
def hear(s: Any, prm: Any) -> None:
    """Compare and correct by what waits, at the chain's time: states are taken back, a field turned on, by first order."""
    c = s.chain[0]
    if c.n_due == 0:
        return
    C = dcm((c.q[0], c.q[1], c.q[2], c.q[3]))
    w = (c.w[0], c.w[1], c.w[2])
    arm = (prm.arm_gnss_x, prm.arm_gnss_y, prm.arm_gnss_z)
    swing, lever = mat_vec(C, cross(w, arm)), mat_vec(C, arm)
    for i in range(c.n_due):
        m = c.due[i]
        age = min(max(s.t - m.t, 0.0), OLDEST)
        if m.kind == MAGNETOMETER:
            if s.has_field == 1 and (s.compass.out == 0 or s.t - s.compass.onset < COMPARED):
                z = interference.cleaned(s, (m.z[0], m.z[1], m.z[2]))
                for k in range(len(s.mag)):
                    z = add_at(z, k, -s.mag[k])
                turned = cross(w, z)
                z = (z[0] - age * turned[0], z[1] - age * turned[1], z[2] - age * turned[2])
                by_heading(s, prm, C, z)
        elif s.aid[m.kind].started == DISTRUSTED:
            continue
        elif m.kind == BAROMETER:
            if c.has_baro == 1:
                r = m.r[0] if m.r[0] >= 0.0 else prm.noise_barometer * prm.noise_barometer
                e = m.z[0] - s.origin[2] + c.p[2] - age * c.v[2] - c.baro
                H = ((PLACE, (0.0, 0.0, -1.0)), (MEAN, (0.0, 0.0, 1.0)), NONE)
                by_one(s, prm, BY_BAROMETER, H, e, r, prm.gate_barometer)
        elif m.kind == GNSS_VELOCITY:
            v = (c.v[0] - age * c.a_n[0], c.v[1] - age * c.a_n[1], c.v[2] - age * c.a_n[2])
            by_three(s, prm, BY_VELOCITY, SPEED, sub(sub((m.z[0], m.z[1], m.z[2]), v), swing), gnss.velocity_variance(prm, m.r))
        elif s.has_origin == 1:
            p = (c.p[0] - age * c.v[0], c.p[1] - age * c.v[1], c.p[2] - age * c.v[2])
            e = sub(sub(gnss.position_observation(s, prm, m.z), p), lever)
            by_three(s, prm, BY_POSITION, PLACE, e, gnss.position_variance(prm, m.r))
    c.n_due = 0
    correct(c)


@jit
def add_at(v: Vec, i: int, x: float) -> Vec:
    """A vector with x more in one component."""
    return (v[0] + (x if i == 0 else 0.0), v[1] + (x if i == 1 else 0.0), v[2] + (x if i == 2 else 0.0))


@jit
def by_heading(s: Any, prm: Any, C: Mat, z: Vec) -> None:
    """Correct by the levelled heading of a field [uT, body] (theory-amendments.md 1), and judge."""
    mu = mat_vec(C, z)
    horizontal = s.field[2] * math.cos(s.field[1])
    r = (prm.noise_magnetometer * prm.noise_magnetometer + prm.noise_field * prm.noise_field) / (horizontal * horizontal)
    H = ((ATTITUDE, heading_row(C, s.field[0], s.field[1])), NONE, NONE)
    by_one(s, prm, BY_COMPASS, H, wrap(s.field[0] - math.atan2(mu[1], mu[0])), r, prm.gate_magnetometer)


@jit
def by_three(s: Any, prm: Any, k: int, column: int, e: Vec, r: Vec) -> None:
    """Correct by a velocity or a position, one component after the other, and judge; a height may be missing."""
    c = s.chain[0]
    z = (0.0, 0.0, 0.0)
    d = 3 if math.isfinite(e[2]) else 2
    for i in range(d):
        H = ((column, (1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0)), NONE, NONE)
        y, S = scalar(c, H, e[i], r[i], prm.gate_gnss)
        z = add_at(z, i, y / math.sqrt(S))
    judge(s, prm, k, z, d)


@jit
def correct(c: Any) -> None:
    """Move the chain by its error states."""
    d = c.dx
    q = quat_unit(quat_mul((c.q[0], c.q[1], c.q[2], c.q[3]), quat_from_rotvec((d[3], d[4], d[5]))))
    c.q[0], c.q[1], c.q[2], c.q[3] = q
    for i in range(3):
        c.w[i] += d[i]
        c.v[i] += d[6 + i]
        c.p[i] += d[9 + i]
        c.bm[i] += d[12 + i]
        c.bf[i] += d[15 + i]
    for i in range(2):
        c.wind[i] += d[18 + i]
        c.steady[i] += d[20 + i]
    c.baro += d[22]
    for i in range(c.P.shape[0]):
        d[i] = 0.0


@jit
def armed(s: Any) -> bool:
    """Whether an alarm would mean something: a chain that has settled, clear of the ground, of a model not known to be wrong."""
    c, p = s.chain[0], s.pairs[0]
    if len(s.bank) > 0 and (doubt.near_ground(s) or not doubt.judged(s)):
        return False
    return bool(s.t - c.t_seed > SETTLE and s.t - p.t_flying > AIRBORNE and p.wrong & AXES_OF_MODEL == 0)


@jit
def judge(s: Any, prm: Any, k: int, z: Vec, d: int) -> None:
    """Take an innovation of ``d`` components of a detector: what is usual, the statistic, an alarm."""
    c = s.chain[0]
    square, product = 0.0, 0.0
    for i in range(d):
        square += z[i] * z[i] / d
        product += z[i] * c.z[k, i] / d
    if learning(s, k):
        rate = rate_of(c, k)
        c.n_learnt[k] += 1.0
        most = LONE * c.c0[k]
        c.c0[k] = min(max(c.c0[k] + rate * (min(square, most) - c.c0[k]), LEAST), MOST)
        c.c1[k] += rate * (min(max(product, -most), most) - c.c1[k])
    c.n_heard[k] += 1
    rho = min(max(c.c1[k] / c.c0[k], 0.0), MOST_RHO)
    unit = 1.0 / math.sqrt(c.c0[k])
    for i in range(3):
        c.z[k, i] = z[i]
    glr = take(c.w_of[k], (unit * z[0], unit * z[1], unit * z[2]), d, rho)
    level = (prm.diagnosis_chain_single if d == 1 else prm.diagnosis_chain_triple) * (COLOUR[0], COLOUR[1], COLOUR[2], COLOUR[3])[k]
    over = glr / level
    c.ratio[k] = over
    if not armed(s):
        return
    c.peak[k] = max(c.peak[k], over)
    if over > usual.raised(c, k):
        if s.t - c.t_over[k] > OVER:
            c.t_alarm[k] = s.t
            event_since(s, s.t, s.t, E_ALARM, NO_SENSOR, glr, level, ALARM + k)
        c.t_over[k] = s.t


@jit
def _spoke(s: Any, k: int, onset: float) -> float:
    c, p = s.chain[0], s.pairs[0]
    hint = max(p.t_hint[0], p.t_hint[1], p.t_hint[2], p.t_hint[3], p.t_hint[4], p.t_hint[5])
    t = float(c.t_alarm[k])
    if hint > onset - EARLIER or p.standing != 0 or t < onset - EARLIER or t > onset + AT_ONCE:
        return -1.0
    return t


@jit
def _silent(s: Any, k: int, onset: float) -> float:
    return -1.0


#: When detector ``k`` alarmed about a fault that began at ``onset``, while model and IMU agree; -1: it did not. Of a sensor's fault both
#: the model's chain and the IMU's alarm, and nothing else (theory.md §5.5(3)).
spoke = where("chain", _spoke, _silent)


@jit
def outside(s: Any, onset: float) -> bool:
    """Whether GNSS differs from what the model makes of the rotor speeds, too, and the IMU does not: it is no fault of the IMU."""
    return spoke(s, BY_VELOCITY, onset) >= 0.0 or spoke(s, BY_POSITION, onset) >= 0.0


@jit
def _testify(s: Any, e: Any, onset: float) -> None:
    c = s.chain[0]
    for k in range(CHAIN_DETECTORS):
        if c.t_alarm[k] >= onset - EARLIER:
            e.alarms[PAIRS + k] = c.t_alarm[k]
        elif c.live == 1 and c.n_heard[k] > 0 and armed(s):
            e.alarms[PAIRS + k] = SILENT


@jit
def _not_there(s: Any, e: Any, onset: float) -> None:
    return


#: Leave with an event what the detectors say of a fault since ``onset``: when they alarmed, `SILENT`, or nothing where they do not listen.
testify = where("chain", _testify, _not_there)
