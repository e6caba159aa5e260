"""What every aid does with its h, H and R: test, fuse, deweight or refuse, and leave one record a component. It knows no sensor."""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit, where
from haltere.aids.record import (
    C_HEADING,
    DEWEIGHTED,
    E_TIMEOUT,
    FUSED,
    HELD,
    MAGNETOMETER,
    R_DISTRUSTED,
    R_INNOVATION,
    R_NONE,
    R_TIMEOUT,
    REJECTED,
    event,
    record,
)
from haltere.core.rotation import Vec, dcm
from haltere.filter.gates import ABSENT, inflation, joint_nis, optimal_gain
from haltere.filter.robust import PLAIN, inflate
from haltere.filter.signatures import matched
from haltere.filter.update import NONE, Row, apply, innovation, project, variance
from haltere.strapdown.propagate import inject

__all__ = [
    "ANY_TURN",
    "DISTRUSTED",
    "HARD",
    "NOTHING",
    "NO_GATE",
    "NO_TIMEOUT",
    "NO_TURN",
    "ONLY_AIR",
    "ONLY_TURN",
    "ONLY_WIND",
    "WITH_DRAG",
    "Offer",
    "Robust",
    "fuse_offer",
    "judge",
    "unit_rows",
]

#: What an aid has to say of one measurement, the same shape for all, so that one machine-code version fuses them all:
#: number of components (0: nothing to fuse), code of the first, observations z, their predictions h, variances r, rows of H,
#: gate [sigma], timeout [s], reason to refuse it whatever the test says, what it may do to the turn about the vertical, and `Robust`.
Offer = tuple[int, int, Vec, Vec, Vec, tuple[Row, Row, Row], float, float, int, int, tuple[int, float, float, float]]
#: How large innovations are taken: form of `haltere.filter.robust`, deviation sqrt(NIS/n) from which the variance is inflated (up to
#: the gate, from where it is dropped) [sigma], the weight that other tests of the aid leave it (1: all; 1/weight is a factor on r),
#: and how many successive samples share one error (1: none): a factor on r that no test sees.
Robust = tuple[int, float, float, float]

#: The gain as it is, only its turn about the vertical, all but that, only what it does to the wind and what air data depend on, that
#: without the coefficients of drag, or all with these: no other code moves them, see `haltere.aids.drag`.
ANY_TURN, ONLY_TURN, NO_TURN, ONLY_AIR, ONLY_WIND, WITH_DRAG = (constant(i) for i in (0, 1, 2, 3, 4, 5))

#: No robust weight: all up to the gate.
HARD = (PLAIN, 1e9, 1.0, 1.0)

NO_GATE, NO_TIMEOUT = 1e9, 1e18
#: What ``started`` says of a sensor.
RUNNING, FORCED, DISTRUSTED = (constant(i) for i in (1, 3, 4))
#: How long a distrusted sensor must pass before it is believed again [s].
PROBATION = 10.0
ZERO, ONE, THREE = (constant(i) for i in (0, 1, 3))
ZEROS = (0.0, 0.0, 0.0)
#: An offer of nothing.
NOTHING = (ZERO, ZERO, ZEROS, ZEROS, ZEROS, ((NONE, NONE, NONE), (NONE, NONE, NONE), (NONE, NONE, NONE)), 1.0, 1.0, ZERO, ANY_TURN, HARD)


@jit
def unit_rows(column: int) -> tuple[Row, Row, Row]:
    """Rows that pick the three states from this column on."""
    return (
        ((column, (1.0, 0.0, 0.0)), NONE, NONE),
        ((column, (0.0, 1.0, 0.0)), NONE, NONE),
        ((column, (0.0, 0.0, 1.0)), NONE, NONE),
    )


@jit
def judge(s: Any, sensor: int, t: float, ratio: float, timeout: float, reason: int) -> tuple[int, int, float]:
    """Status, reason and weight of a measurement with this test ratio, and the sensor's memory brought up to date.

    Continues while the ratio is at most one. After ``timeout`` [s] of refusals by the innovation the measurement is let in
    with its variance inflated until the ratio is one: the state is drawn to it without a jump. ``reason`` other than
    `R_NONE` refuses it whatever the ratio. A sensor found wrong by another is not let in by force, and is believed again only
    when it has passed for `PROBATION` without a break.
    """
    a = s.aid[sensor]
    if reason != R_NONE:
        a.n_rejected += 1
        a.t_due = t  # for a queued sensor: since when it has passed without a break
        return REJECTED, reason, 0.0
    if a.started == DISTRUSTED:
        if ratio > 1.0:
            a.t_due = t
            a.n_rejected += 1
            return REJECTED, R_INNOVATION, 0.0
        if t - a.t_due < PROBATION:
            return HELD, R_DISTRUSTED, 0.0
    if ratio <= 1.0:
        a.t_passed = t
        a.started = RUNNING
        a.n_fused += 1
        return FUSED, R_NONE, 1.0
    if t - a.t_passed > timeout:
        if a.started != FORCED:
            event(s, t, E_TIMEOUT, sensor, t - a.t_passed)
            a.started = FORCED
        a.n_fused += 1
        return DEWEIGHTED, R_TIMEOUT, 1.0 / ratio
    a.n_rejected += 1
    return REJECTED, R_INNOVATION, 0.0


@jit
def _untold(s: Any, H: Any, S: float, y: float, component: int, evidence: bool, moved: bool) -> None:
    return


#: The bank of the diagnosis, where there is one, hears of an innovation.
told = where("bank", matched, _untold)


@jit
def fuse_offer(s: Any, aids: Any, t: float, sensor: int, offer: Any) -> None:
    """Test the components of an offer together (NIS/gate²), fuse them one after the other, and record them.

    Parameters
    ----------
    s, aids
        State record and aid records.
    t
        Valid time [s].
    sensor
        Code.
    offer
        What the aid has to say, see `Offer`; rows may have any number of blocks.
    """
    n, component, z, h, r, H, gate, timeout, reason, turn, robust = offer
    form, soft, weighed, shared = robust
    if n == 0:
        return
    H0, H1, H2 = H
    ok0, ok1, ok2 = z[0] == z[0], n > 1 and z[1] == z[1], n > 2 and z[2] == z[2]
    e = (z[0] - h[0] if ok0 else 0.0, z[1] - h[1] if ok1 else 0.0, z[2] - h[2] if ok2 else 0.0)
    r = (r[0] if ok0 else ABSENT, r[1] if ok1 else ABSENT, r[2] if ok2 else ABSENT)
    if n == 1:
        project(s, H0)
        s00 = variance(s, H0) + r[0]
        nis, s_ii = e[0] * e[0] / s00, (s00, s00, s00)
    else:
        nis, s_ii = joint_nis(s, H0, H1, H2, e, r)
    ratio = nis / (gate * gate)
    status, reason, weight = judge(s, sensor, t, ratio, timeout, reason)
    if status == FUSED:
        present = (1.0 if ok0 else 0.0) + (1.0 if ok1 else 0.0) + (1.0 if ok2 else 0.0)
        weight = weighed / inflate(form, math.sqrt(nis / max(present, 1.0)), soft, gate / math.sqrt(max(present, 1.0)))
        if weight < 1.0:
            status = DEWEIGHTED
            r = (r[0] / weight, r[1] / weight, r[2] / weight)
    elif status == DEWEIGHTED:
        r = (inflation(nis, gate, s_ii[0], r[0]), inflation(nis, gate, s_ii[1], r[1]), inflation(nis, gate, s_ii[2], r[2]))
    if weight > 0.0:
        r = (shared * r[0], shared * r[1], shared * r[2])
        for i in range(3):
            row, r_i, e_i, ok = H0, r[0], e[0], ok0
            if i == 1:
                row, r_i, e_i, ok = H1, r[1], e[1], ok1
            elif i == 2:
                row, r_i, e_i, ok = H2, r[2], e[2], ok2
            if ok:
                variance_i = optimal_gain(s, row, r_i)
                if len(s.wind) > 0:
                    mask_air(s, turn)
                if turn in (ONLY_TURN, NO_TURN):
                    project_gain(s, turn == ONLY_TURN)
                e_i = innovation(s, row, e_i)
                if len(s.bank) > 0:
                    told(s, row, variance_i, e_i, component + i, sensor <= MAGNETOMETER and component <= C_HEADING, True)
                apply(s, row, r_i, e_i)
        inject(s)
    elif len(s.bank) > 0 and reason == R_INNOVATION and s.aid[sensor].started != DISTRUSTED and sensor <= MAGNETOMETER:
        for i in range(n):  # what the filter refuses is evidence all the same
            row = H0 if i == 0 else (H1 if i == 1 else H2)
            if z[i] == z[i]:
                told(s, row, s_ii[i], e[i], component + i, component <= C_HEADING, False)
    for i in range(n):
        if z[i] == z[i]:
            record(s, aids, t, sensor, component + i, z[i], e[i], math.sqrt(s_ii[i]), ratio, weight, status, reason)


@jit
def mask_air(s: Any, turn: int) -> None:
    """Keep of the gain in ``s.k`` what the codes from `ONLY_AIR` on say; the coefficients of drag are the two states after the wind."""
    o = 15 + len(s.baro) + len(s.mag)
    if turn in (ONLY_AIR, ONLY_WIND):
        for i in range(o):
            s.k[i] = 0.0
    if len(s.drag) > 0 and turn not in (ONLY_AIR, WITH_DRAG):
        s.k[o + len(s.wind)], s.k[o + len(s.wind) + 1] = 0.0, 0.0


@jit
def project_gain(s: Any, only: bool) -> None:
    """Keep of the gain in ``s.k`` only what turns about the vertical, or all but that.

    Only: K_θ <- d (dᵀ K_θ), K_bg likewise, the rest zero but for a magnetometer's offset; else K_θ <- K_θ - d (dᵀ K_θ), K_bg likewise.
    d = Cᵀ e3 is the vertical in the body frame (theory-amendments.md §1).
    """
    d = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2]
    k = s.k
    a = d[0] * k[0] + d[1] * k[1] + d[2] * k[2]
    b = d[0] * k[9] + d[1] * k[10] + d[2] * k[11]
    if only:
        for i in range(15 + len(s.baro)):  # an offset of the magnetometer keeps its gain
            k[i] = 0.0
        for i in range(3):
            k[i] = a * d[i]
            k[9 + i] = b * d[i]
        return
    for i in range(3):
        k[i] -= a * d[i]
        k[9 + i] -= b * d[i]
