"""Bank of fault signatures: what a unit fault since an onset has done to a filter's error, and how well the innovations match it.

Generalised likelihood ratio on the innovations of one filter (Willsky and Jones 1976; theory-amendments.md §3). A fault of size b since
an onset has put x b into the error state (true minus estimate) and e b into an innovation, where e = H x, plus one where the fault is in
that very observation. Every response follows the filter: x <- Φ x between fusions, x <- x - K e with the gain that was really applied. A
bias of an inertial sensor, or of the barometer where its offset is a state, is a jump of that state: x begins as a unit vector, and says
later how much of the jump the filter has not yet found by itself. A ramp begins as nothing and adds to the bias at a constant rate.
Whitened innovations y of variance S then give num = Σ e y/S, den = Σ e²/S: the statistic num²/den is χ²(1) without a fault, and
num/den ± den^-1/2 is the size. Nothing is decided here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere._jit import constant, jit
from haltere.filter.update import Row

__all__ = [
    "ACCEL",
    "ACCEL_RAMP",
    "BANK_COLUMNS",
    "BAROMETER_OFFSET",
    "GYRO",
    "GYRO_RAMP",
    "HEADING",
    "N_FAULTS",
    "POSITION",
    "SLOTS",
    "VELOCITY",
    "clear",
    "matched",
    "move",
    "open_slot",
    "restart_transition",
]

#: Signatures: first of each kind. Those of VELOCITY, POSITION and HEADING are of GNSS and compass; the last is a jump of the offset.
GYRO, ACCEL, GYRO_RAMP, ACCEL_RAMP, VELOCITY, POSITION, HEADING, BAROMETER_OFFSET = (constant(i) for i in (0, 3, 6, 9, 12, 15, 18, 19))
N_FAULTS = constant(20)
#: Onsets that are kept. Column fault * SLOTS + slot of every array of the bank belongs to a fault and an onset.
SLOTS = constant(20)
BANK_COLUMNS = int(N_FAULTS * SLOTS)
#: A whitened innovation counts up to so many sigma, more by this factor of the one before it: a lone outlier proves nothing.
ALONE, FOLLOWED = 4.0, 1.2
#: Components of an innovation that have a signature of their own: six of GNSS, and the heading (see haltere.aids.record).
N_GNSS, C_HEADING = 6, 7


@jit
def restart_transition(b: Any) -> None:
    """Begin a new interval between fusions: Φ is one, nothing has been added by ramps."""
    P = b.phi.P
    b.span = 0.0
    for i in range(15):
        for j in range(15):
            P[i, j] = 0.0
    for a in range(3):
        P[a, a] = 1.0
        P[9 + a, 3 + a] = 1.0
        P[12 + a, 6 + a] = 1.0


@jit
def clear(b: Any) -> None:
    """Forget every onset and response."""
    x = b.x
    for j in range(x.shape[1]):
        b.num[j], b.den[j] = 0.0, 0.0
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            x[i, j] = 0.0
    for k in range(len(b.live)):
        b.live[k] = 0
    for k in range(len(b.last)):
        b.last[k] = 0.0
    b.fresh, b.alarm = 0, 0
    restart_transition(b)


@jit
def open_slot(b: Any, k: int, t: float) -> None:
    """Let slot ``k`` stand for faults that begin at t [s]."""
    x = b.x
    b.live[k], b.onset[k] = 1, t
    for f in range(N_FAULTS):
        j = f * SLOTS + k
        b.num[j], b.den[j] = 0.0, 0.0
        for i in range(x.shape[0]):
            x[i, j] = 0.0
    for a in range(3):
        x[9 + a, (GYRO + a) * SLOTS + k] = 1.0
        x[12 + a, (ACCEL + a) * SLOTS + k] = 1.0
    if x.shape[0] > 15:
        x[15, BAROMETER_OFFSET * SLOTS + k] = 1.0


@jit
def move(b: Any) -> None:
    """Carry every response over the interval since the last fusion: x <- Φ x, and what ramps have added meanwhile.

    ``b.phi.P`` holds the columns of Φ that are not zero or one, of attitude, gyro bias and accelerometer bias, and then the integrals of
    the last two over the time at which a bias has been added.
    """
    x, P, span = b.x, b.phi.P, b.span
    m = x.shape[1]
    for i in range(3):  # position, of what attitude and velocity were
        a0, a1, a2 = P[6 + i, 0], P[6 + i, 1], P[6 + i, 2]
        g0, g1, g2 = P[6 + i, 3], P[6 + i, 4], P[6 + i, 5]
        f0, f1, f2 = P[6 + i, 6], P[6 + i, 7], P[6 + i, 8]
        for j in range(m):
            x[6 + i, j] += (
                span * x[3 + i, j]
                + a0 * x[0, j] + a1 * x[1, j] + a2 * x[2, j]
                + g0 * x[9, j] + g1 * x[10, j] + g2 * x[11, j]
                + f0 * x[12, j] + f1 * x[13, j] + f2 * x[14, j]
            )  # fmt: skip
    for i in range(3):
        a0, a1, a2 = P[3 + i, 0], P[3 + i, 1], P[3 + i, 2]
        g0, g1, g2 = P[3 + i, 3], P[3 + i, 4], P[3 + i, 5]
        f0, f1, f2 = P[3 + i, 6], P[3 + i, 7], P[3 + i, 8]
        for j in range(m):
            x[3 + i, j] += (
                a0 * x[0, j] + a1 * x[1, j] + a2 * x[2, j]
                + g0 * x[9, j] + g1 * x[10, j] + g2 * x[11, j]
                + f0 * x[12, j] + f1 * x[13, j] + f2 * x[14, j]
            )  # fmt: skip
    for j in range(m):
        t0, t1, t2, g0, g1, g2 = x[0, j], x[1, j], x[2, j], x[9, j], x[10, j], x[11, j]
        x[0, j] = P[0, 0] * t0 + P[0, 1] * t1 + P[0, 2] * t2 + P[0, 3] * g0 + P[0, 4] * g1 + P[0, 5] * g2
        x[1, j] = P[1, 0] * t0 + P[1, 1] * t1 + P[1, 2] * t2 + P[1, 3] * g0 + P[1, 4] * g1 + P[1, 5] * g2
        x[2, j] = P[2, 0] * t0 + P[2, 1] * t1 + P[2, 2] * t2 + P[2, 3] * g0 + P[2, 4] * g1 + P[2, 5] * g2
    for a in range(3):
        for i in range(15):
            g, f = P[i, 9 + a], P[i, 12 + a]
            for k in range(SLOTS):
                if b.live[k] == 1:
                    x[i, (GYRO_RAMP + a) * SLOTS + k] += g
                    x[i, (ACCEL_RAMP + a) * SLOTS + k] += f
    restart_transition(b)


@jit
def matched(s: Any, H: Row, S: float, y: float, component: int, evidence: bool, moved: bool) -> None:
    """Take one scalar innovation ``y`` of variance ``S`` into the bank, as the filter takes it.

    Parameters
    ----------
    s
        State record with ``bank``, and the gain in ``s.k``.
    H
        Row of the measurement matrix.
    component
        What was observed, to know the faults that lie in the observation itself.
    evidence
        Whether it counts; an assumption of the filter's own only moves the state.
    moved
        Whether the filter has applied the gain; a refused measurement moves nothing.
    """
    b = s.bank[0]
    if b.span > 0.0:
        move(b)
    x, e, num, den = b.x, b.e, b.num, b.den
    m = x.shape[1]
    for j in range(m):
        e[j] = 0.0
    for c, h in H:
        h0, h1, h2 = h
        if h0 != 0.0 or h1 != 0.0 or h2 != 0.0:
            for j in range(m):
                e[j] += h0 * x[c, j] + h1 * x[c + 1, j] + h2 * x[c + 2, j]
    own = VELOCITY + component if component < N_GNSS else HEADING
    if evidence and (component < N_GNSS or component == C_HEADING):
        for k in range(SLOTS):
            e[own * SLOTS + k] += 1.0
    if evidence:
        sd = math.sqrt(S)
        most = ALONE + FOLLOWED * abs(b.last[component])
        z = min(max(y / sd, -most), most)
        b.last[component] = z
        z /= sd
        weight = 1.0 / S
        for j in range(m):
            num[j] += e[j] * z
            den[j] += weight * e[j] * e[j]
        b.fresh = 1
    if moved:
        for i in range(x.shape[0]):
            k_i = s.k[i]
            if k_i != 0.0:
                for j in range(m):
                    x[i, j] -= k_i * e[j]
