"""What `fault-tolerant` does with alarms: gathers them, names the fault by its signature, leaves out what failed, hears it again later.

Source F, steps 4 to 6 (theory.md §5.5, §5.6). A verdict comes when a signature is complete and no other fits, else after
``fault_tolerant.wait`` with what there is; several that fit are returned as a set, and nothing is left out then.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids.record import E_ISOLATED, E_READMITTED, E_UNDECIDED, NO_SENSOR, event_since
from haltere.diagnosis.truth_table import MAY, MUST, N_FAULTS, count, match
from haltere.estimators.detection_filters import reseed
from haltere.estimators.federated_layout import FINDINGS, LOCAL_FILTERS, N_DETECTORS
from haltere.estimators.local_filters import miss
from haltere.filter.signatures import SLOTS

__all__ = ["decide"]

#: Numbers of faults in `haltere.diagnosis.truth_table.FAULTS`: first of the gyro, of the accelerometer, of the model; then each.
GYRO, ACCEL, MODEL, COMPASS, VELOCITY, BARO, POSITION, ROTOR, WIND = (constant(i) for i in (0, 3, 6, 12, 13, 14, 15, 16, 17))
#: A complete signature must have had no new alarm for so long [s].
SETTLED = 0.4
#: What a fault may have done to the fused state until it was named, 1 sigma: attitude [rad], velocity [m/s], height [m], wind [m/s].
TURNED, PUSHED, LIFTED, BLOWN = math.radians(3.0), 0.5, 1.0, 4.0
#: An axis of the model is right again where in the mean it misses less than so many times 1 sigma of what identification left for seconds.
USUAL = 3.0
#: Gyro z and compass are told apart within so many times ``fault_tolerant.wait``.
DRIFT = 1.6
J31 = constant(1 << 10)
#: Bits of the detection filters that hear a sensor: of the IMU chain, of the model's chain, of both by what they hear.
BY_IMU, BY_MODEL = constant(0b1111 << 10), constant(0b1111 << 6)


@jit
def parts_of(fault: int) -> int:
    """Bits of what is isolated for a fault, see `haltere.estimators.local_states.set_axes`."""
    if fault == ROTOR:
        return 0b1111 << 8
    return 0 if fault == WIND else 1 << fault


@jit
def filters_of(parts: int) -> int:
    """Bits of the detection filters that contain any of what is isolated."""
    off = 0
    for a in range(3):
        if parts & ((1 << a) | (1 << (9 + a))):
            off |= 1 << (3 + a)
        if parts & ((1 << (3 + a)) | (1 << (6 + a))):
            off |= 1 << a
    if parts & 0b111111:
        off |= BY_IMU
    if parts & (0b111111 << 6):
        off |= BY_MODEL
    for k in range(4):
        if parts & (1 << (12 + k)):
            off |= (1 << (6 + k)) | (1 << (10 + k))
    return off


@jit
def doubt(s: Any, i: int, variance: float) -> None:
    """Admit that a shared state may be wrong by as much as that: in the fused covariance, and in all that is shared."""
    x = s.ft[0]
    x.P[i, i] += variance
    for k in range(LOCAL_FILTERS):
        if x.lf[k].share > 0.0:
            x.lf[k].P[i, i] += variance / x.lf[k].share


@jit
def leave_out(s: Any, prm: Any, fault: int, t: float) -> None:
    """Isolate what failed, and admit what it may have spoilt."""
    x = s.ft[0]
    parts = parts_of(fault)
    if prm.fault_tolerant_isolate > 0.0:
        x.isolated |= parts
        x.off = filters_of(x.isolated)
        for k in range(16):
            if parts & (1 << k):
                x.t_isolated[k] = t
                if k >= MODEL and k < COMPASS:
                    x.missed[k - MODEL], x.n_missed[k - MODEL] = 0.0, 0
    for i in range(3):
        if parts & (0b111 | (0b111 << 9)):
            doubt(s, 3 + i, TURNED * TURNED)
        if parts & ~0b111:
            doubt(s, 6 + i, PUSHED * PUSHED)
    if fault in (BARO, POSITION):
        for i in range(3):
            doubt(s, 9 + i, LIFTED * LIFTED)
    if fault == COMPASS:
        for i in range(3):
            doubt(s, 3 + i, TURNED * TURNED)
    if fault == WIND and prm.fault_tolerant_wind > 0.0:
        for i in range(2):
            doubt(s, 18 + i, BLOWN * BLOWN)
            doubt(s, 20 + i, BLOWN * BLOWN)


@jit
def tell(s: Any, code: Any, t: float, fault: int, candidates: int) -> None:
    """Leave an event with what it rests on."""
    x = s.ft[0]
    k = x.n_findings % FINDINGS
    f = x.finding[k]
    for i in range(N_DETECTORS):
        f.when[i] = x.when[i] if x.alarms & (1 << i) else 0.0
        f.most[i] = x.most[i]
    n = s.n_events
    event_since(s, t, x.t_first, code, NO_SENSOR, float(k), 1.0, fault)
    if s.n_events > n:
        s.event[n].seen, s.event[n].candidates = x.t_first, candidates
        x.n_findings += 1


@jit
def forget_alarms(x: Any) -> None:
    """Nothing has alarmed."""
    x.alarms, x.t_first, x.t_alarm, x.named = 0, 0.0, 0.0, 0
    for i in range(N_DETECTORS):
        x.when[i], x.most[i] = 0.0, 0.0


@jit
def lowest(bits: int) -> int:
    """Number of the lowest bit that is set."""
    k = 0
    while bits & (1 << k) == 0:
        k += 1
    return k


@jit
def complete(alarms: int) -> int:
    """The one fault whose signature is complete, with none but what may alarm, and that no more alarms can turn into another; else -1."""
    best = -1
    for f in range(N_FAULTS):
        if MUST[f] & ~alarms == 0 and alarms & ~(MUST[f] | MAY[f]) == 0:
            if best >= 0:
                return -1
            best = f
    if best < 0 or count(MUST[best]) < 2:
        return -1
    for f in range(N_FAULTS):
        if f != best and alarms & ~(MUST[f] | MAY[f]) == 0:
            return -1
    return best


@jit
def newest(x: Any) -> float:
    """When the last detection filter alarmed that had not before."""
    t = float(x.t_first)
    for i in range(N_DETECTORS):
        if x.alarms & (1 << i):
            t = max(t, x.when[i])
    return t


@jit
def powerless(s: Any, prm: Any, t: float) -> int:
    """Detection filters whose silence says nothing yet: those of the IMU chain, where a model's force alarms (theory-amendments.md 3).

    With the signatures of `haltere.filter.signatures`, an accelerometer fault of the size b that J11-J13 saw would be found by now with
    probability 99 % where b² D ≥ (√h + 2.33)², D the information on it. Without them nothing is known of the power, and of single
    residuals it is small: the chain's tilt swallows a force, and its innovations fade (theory.md §5.4(b)).
    """
    x = s.ft[0]
    if len(s.bank) == 0:
        return int(BY_IMU)
    b = s.bank[0]
    for a in range(3):
        if x.alarms & (1 << a):
            known = 0.0
            for k in range(len(b.live)):
                if b.live[k] == 1 and abs(b.onset[k] - x.when[a]) < 0.4:
                    known = max(known, float(b.den[(3 + a) * SLOTS + k]))
            need = math.sqrt(prm.diagnosis_threshold) + 2.33
            if x.lacking[a] * x.lacking[a] * known < need * need:
                return int(BY_IMU)
    return 0


@jit
def decide(s: Any, prm: Any, t: float) -> None:
    """After the detection filters: a verdict where it is time for one, and what was isolated comes back where it agrees again."""
    x = s.ft[0]
    readmit(s, prm, t)
    named = x.named - 1
    if x.alarms == 0 and named < 0:
        return
    if named >= 0 and (x.alarms & (BY_MODEL | 0b111111)) & ~MUST[named] == 0:
        tell(s, E_ISOLATED, t, named, 1 << named)
        leave_out(s, prm, named, t)
        forget_alarms(x)
        reseed(s, prm)
        return
    if x.alarms == 0:
        x.named = 0
        return
    fault = complete(x.alarms)
    if fault >= 0 and t - newest(x) < SETTLED:
        return
    candidates = 0
    if fault < 0 and len(s.bank) > 0 and x.alarms & ~(MUST[GYRO + 2] | MAY[GYRO + 2]) == 0 and x.alarms & J31:
        # a gyro that drifts, or a compass: the model alone holds heading too badly for J21 to tell; a field of another size does
        jerked = x.t_jerked > x.t_first - prm.fault_tolerant_wait
        if t - x.t_first < (SETTLED if jerked else DRIFT * prm.fault_tolerant_wait):
            return
        candidates = (1 << (GYRO + 2)) | (1 << COMPASS)
        if jerked:
            fault = GYRO + 2
        elif x.t_compass > x.t_first - 1.0:
            fault = COMPASS
    elif fault < 0:
        if t - x.t_first < prm.fault_tolerant_wait:
            return
        blind = powerless(s, prm, t)
        if blind != 0 and len(s.bank) > 0 and t - x.t_first < 2.0 * prm.fault_tolerant_wait:
            return
        candidates, wrong = match(x.alarms, blind)
        if prm.fault_tolerant_detector > 0.0 and wrong > 0:
            candidates = 0  # the source's table has no nearest
        if prm.fault_tolerant_wind == 0.0:
            candidates &= ~(1 << WIND)  # without a state of it, its steps are not among what is known
        if count(candidates) > 1 and len(s.bank) > 0 and t - x.t_first < 2.0 * prm.fault_tolerant_wait and candidates & 0b111111:
            return  # the IMU chain's signatures may yet tell them apart
        if count(candidates) == 1 and wrong <= 1:
            fault = lowest(candidates)
    if fault >= 0:
        tell(s, E_ISOLATED, t, fault, 1 << fault)
        leave_out(s, prm, fault, t)
    else:
        tell(s, E_UNDECIDED, t, N_FAULTS, candidates)
        if candidates & (1 << WIND):
            leave_out(s, prm, WIND, t)  # nothing is left out for that
    forget_alarms(x)
    reseed(s, prm)


@jit
def heard_again(s: Any, prm: Any, t: float, k: int) -> bool:
    """Whether a sensor (of an axis, for gyro and accelerometer) has agreed for ``fault_tolerant.recover``.

    Its own detection filter has been quiet, and for the IMU those of its chain too: J14 to J16 do not see a rate that stays wrong.
    """
    x = s.ft[0]
    loud = x.last[3 + k if k < 3 else k - 3 if k < 6 else k - 6] > 1.0
    if k < 6:
        for i in range(10, N_DETECTORS):
            loud = loud or x.last[i] > 1.0
    if loud:
        x.t_isolated[k] = t
    return bool(t - x.t_isolated[k] > prm.fault_tolerant_recover)


@jit
def right_again(s: Any, prm: Any, t: float, k: int) -> bool:
    """Whether an axis of the model (bit 6 to 11) has been right for ``fault_tolerant.recover``: the mean of what it missed is as usual.

    While it is isolated the sensors tell what it misses, b_F or b_M; a mean of that over seconds is known well.
    """
    x, a = s.ft[0], k - 6
    x.missed[a] += x.bf[a] if a < 3 else x.bm[a - 3]
    x.n_missed[a] += 1
    if t - x.t_isolated[k] < prm.fault_tolerant_recover:
        return False
    mean = abs(x.missed[a]) / x.n_missed[a]
    x.missed[a], x.n_missed[a], x.t_isolated[k] = 0.0, 0, t
    return bool(mean < USUAL * miss(s, prm, a))


@jit
def readmit(s: Any, prm: Any, t: float) -> None:
    """Hear again what has been right for a while: a sensor with its bias open, an axis of the model with what it misses as usual."""
    x = s.ft[0]
    if x.isolated == 0:
        return
    for k in range(16):
        if x.isolated & (1 << k) == 0:
            continue
        model = k >= MODEL and k < COMPASS
        if right_again(s, prm, t, k) if model else heard_again(s, prm, t, k):
            x.isolated &= ~(1 << k)
            x.off = filters_of(x.isolated)
            pending = x.t_first
            x.t_first = t
            tell(s, E_READMITTED, t, k, 1 << k)
            x.t_first = pending
            if model:
                reseed(s, prm)
