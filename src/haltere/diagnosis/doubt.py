"""When diagnosis holds its tongue: near the ground, on contact, without a good fit, where GNSS is forced in, after naming too often.

A signature can explain more than the others and still be wrong, when what is wrong is in no list: a manoeuvre that the log's rate does not
show, a GNSS that wanders, a crash. Three things tell. A true signature leaves about what is usual of the innovations' squares since its
onset (`haltere.filter.signatures.add_square`). A fault that was taken back is gone, so that the same part is not named again and again.
And no fault is judged by what is measured while GNSS is let in by force.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids import rest
from haltere.aids.fusing import FORCED
from haltere.aids.record import GNSS_POSITION, GNSS_VELOCITY
from haltere.core.rotation import Vec

__all__ = ["begin", "contact", "fits", "judged", "left", "may_name", "named", "near_ground", "note", "sparse", "vouched", "watch"]

#: Families of inertial faults, the first ones.
N_INERTIAL = constant(6)
#: Height [m] over where it rested from which a vehicle is in the air; that from which it is if faster than so many m/s (lower it may roll);
#: height below which one that is slower may touch the ground.
LIFTED, CLEAR, FAST, LOW = 1.5, 0.5, 2.0, 1.0
#: Faster than this [m/s] nothing is judged: delays, scale and lever arms make errors that look like faults; nor for so long [s] after,
#: in which biases that were learnt from them are forgotten.
FASTEST, AFTER_FAST = 18.0, 30.0
#: Where IMU samples are further apart on average [s], what happens between them is unknown for longer than a vehicle moves alike. Samples
#: over which that is averaged.
SPARSE, SAMPLES = 0.05, 100.0
#: How fast [s] it is forgotten how fast the vehicle rose or sank.
SANK = 5.0
#: After contact nothing is judged for so long [s]; it is a specific force this far [m/s^2] from the mean of late. After GNSS was forced
#: in, after a gap of the IMU, and after alignment in motion, whose errors are no fault.
CONTACT, PUSHED, AFTER_FORCED, AFTER_GAP, AFTER_MOTION = 1.0, 20.0, 5.0, 3.0, 2.0
#: Parts of what a signature explains that it may leave, and so many sigma of what is usual; see docs/diagnosis.md.
LEAVES, SIGMAS = 0.35, 2.0
#: A fit must have been good for so long [s]; one that is not within that time after the alarm never is, and nothing is judged for a time.
GOOD, NEVER, AFTER_NEVER = 0.3, 5.0, 8.0
#: A compass is heard that spoke so long ago [s].
HEARD = 0.5
#: A part that is named more often than this within that time [s] is not named, nor healed, for the next so many seconds.
OFTEN, WITHIN, MUTE = 2, 30.0, 60.0


@jit
def begin(s: Any) -> None:
    """Begin anew, at alignment: the vehicle may be anywhere."""
    b = s.bank[0]
    b.aloft, b.floor, b.t_rest, b.t_contact, b.t_unfit = 0, s.p[2], -1e9, -1e9, -1e9
    b.t_doubt = -1e9 if s.align.kind == 1 else s.t + AFTER_MOTION
    b.sank = 0.0
    for g in range(len(b.t_named)):
        b.t_named[g], b.n_named[g], b.t_mute[g] = -1e9, 0, -1e9


@jit
def contact(s: Any, f: Vec) -> None:
    """Take one specific force: far from the second before it is contact."""
    a = math.sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
    if abs(a - s.rest.mean_a) > PUSHED:
        s.bank[0].t_contact = s.t


@jit
def note(s: Any, dt: float) -> None:
    """Take one step into how far IMU samples are apart, and how fast the vehicle rose or sank of late."""
    b = s.bank[0]
    b.spacing += (dt - b.spacing) / SAMPLES if b.spacing > 0.0 else dt
    b.sank = max(abs(s.v[2]), b.sank * (1.0 - min(1.0, dt / SANK)))


@jit
def sparse(b: Any) -> bool:
    """Whether IMU samples are too far apart for a verdict on an axis."""
    return bool(b.spacing > SPARSE)


@jit
def near_ground(s: Any) -> bool:
    """Whether the vehicle may touch the ground from which it rose: low over where it rested, and slow."""
    b = s.bank[0]
    if b.t_rest < 0.0:
        return False
    speed2 = s.v[0] * s.v[0] + s.v[1] * s.v[1] + s.v[2] * s.v[2]
    return b.aloft == 0 or (abs(b.floor - s.p[2]) < LOW and speed2 < FAST * FAST)


@jit
def watch(s: Any, prm: Any) -> None:
    """Bring up to date whether the vehicle is in the air, and until when nothing is judged.

    In the air: it rose or is fast since it last rested, or was never seen at rest.
    """
    b = s.bank[0]
    if s.aid[GNSS_VELOCITY].started == FORCED or s.aid[GNSS_POSITION].started == FORCED:
        b.t_doubt = max(b.t_doubt, s.t + AFTER_FORCED)
    if s.v[0] * s.v[0] + s.v[1] * s.v[1] + s.v[2] * s.v[2] > FASTEST * FASTEST:
        b.t_doubt = max(b.t_doubt, s.t + AFTER_FAST)
    w, f = (s.w_raw[0], s.w_raw[1], s.w_raw[2]), (s.f_raw[0], s.f_raw[1], s.f_raw[2])
    if rest.at_rest(s, prm, w, f):
        b.aloft, b.floor, b.t_rest = 0, s.p[2], s.t
    elif b.aloft == 0:
        speed2 = s.v[0] * s.v[0] + s.v[1] * s.v[1] + s.v[2] * s.v[2]
        never = b.t_rest < 0.0 and s.align.kind != 1 and s.t - s.t_aligned > 2.0
        rise = abs(s.p[2] - b.floor)
        if rise > LIFTED or (rise > CLEAR and speed2 > FAST * FAST) or never:
            b.aloft = 1


@jit
def judged(s: Any) -> bool:
    """Whether what is measured now may be held against a sensor: in the air, not just after contact, nothing in doubt."""
    b = s.bank[0]
    return b.aloft == 1 and s.t > b.t_doubt and s.t - b.t_contact > CONTACT


@jit
def vouched(s: Any) -> bool:
    """Whether a compass is heard: without it nothing but GNSS holds the attitude, and it must not be found wrong by that."""
    return s.has_field == 1 and s.compass.out == 0 and s.t - s.bank[0].t_heading < HEARD


@jit
def left(b: Any, j: int, k: int) -> float:
    """What column ``j`` of onset ``k`` leaves of the squares beyond the usual, in squares."""
    return float(b.excess[k] - b.num[j] * b.num[j] / b.den[j])


@jit
def fits(s: Any, j: int, k: int) -> bool:
    """Whether column ``j`` of onset ``k`` has explained what came since for `GOOD` seconds."""
    b = s.bank[0]
    allowed = LEAVES * b.num[j] * b.num[j] / b.den[j] + SIGMAS * math.sqrt(b.spread[k])
    if left(b, j, k) > allowed:
        b.t_unfit = s.t
        if s.t - b.t_seen > NEVER:
            b.t_doubt = max(b.t_doubt, s.t + AFTER_NEVER)
    return s.t - b.t_unfit >= GOOD


@jit
def may_name(b: Any, g: int, t: float) -> bool:
    """Whether family ``g`` may be named: not if it was too often of late."""
    return t > b.t_mute[g]


@jit
def named(b: Any, g: int, t: float) -> bool:
    """Count a naming of family ``g``; False if that makes too many, and this one is not to be believed either."""
    first = 0 if g < N_INERTIAL else g
    end = N_INERTIAL if g < N_INERTIAL else g + 1
    n = 0
    if t - b.t_named[g] > WITHIN:
        b.n_named[g] = 0
    for i in range(first, end):
        if t - b.t_named[i] < WITHIN:
            n += b.n_named[i]
    if n >= OFTEN + (1 if g < N_INERTIAL else 0):
        for i in range(first, end):
            b.t_mute[i], b.n_named[i] = t + MUTE, 0
        return False
    b.t_named[g] = t
    b.n_named[g] += 1
    return True
