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
from haltere.core.rotation import dcm
from haltere.filter import jumping, turning
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
    "YAW",
    "clear",
    "matched",
    "move",
    "open_slot",
    "restart_transition",
]

Vec = tuple[float, float, float]

#: Signatures: first of each kind. Those of VELOCITY, POSITION and HEADING are of GNSS and compass; the
#: last two are jumps of the barometer's offset, and of yaw: a heading that was wrong shows when the vehicle accelerates.
GYRO, ACCEL, GYRO_RAMP, ACCEL_RAMP, VELOCITY, POSITION, HEADING, BAROMETER_OFFSET, YAW = (
    constant(i) for i in (0, 3, 6, 9, 12, 15, 18, 19, 20)
)
N_FAULTS = constant(21)
#: Onsets that are kept. Column fault * SLOTS + slot of every array of the bank belongs to a fault and an onset.
SLOTS = constant(20)
BANK_COLUMNS = int(N_FAULTS * SLOTS)
#: Columns that are worked on together: what of them is needed stays in the nearest cache.
WIDTH = constant(60)
#: Responses are in single precision: a statistic need not be better, and twice as many are worked on at once.
ZERO, ONE = np.float32(0.0), np.float32(1.0)
#: A whitened innovation counts up to so many sigma, more by this factor of the one before it: a lone outlier proves nothing. Beyond, its
#: variance is inflated instead of the innovation cut: cut ones would look like something that grows.
ALONE, FOLLOWED = 4.0, 1.2
#: Components of an innovation that have a signature of their own: six of GNSS, and the heading; and the altitude (see haltere.aids.record).
N_GNSS, C_ALTITUDE, C_HEADING = 6, 6, 7
#: Memory of the usual square of a component's innovation [s], from how many on it is known, and how far a lone one may move it.
OWN, KNOWN, LONE_SQUARE = 40.0, 20.0, 9.0
#: 1 sigma of a barometer [m] and of a compass [rad] before anything is known of them, see `haltere.filter.jumping`.
METRE, RADIAN = 1.0, 0.1


@jit
def single(a: float, b: float, c: float) -> tuple[np.float32, np.float32, np.float32]:
    """Three coefficients in the precision of the responses."""
    return np.float32(a), np.float32(b), np.float32(c)


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
        b.num[j], b.den[j], b.heading_num[j], b.heading_den[j] = 0.0, 0.0, 0.0, 0.0
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            x[i, j] = 0.0
    for k in range(len(b.live)):
        b.live[k] = 0
    for k in range(len(b.last)):
        b.last[k] = 0.0
    b.fresh, b.alarm = 0, 0
    turning.restart(b)
    restart_transition(b)


@jit
def open_slot(s: Any, k: int, down: Vec) -> None:
    """Let slot ``k`` stand for faults that begin now; ``down`` is the vertical in the body frame."""
    b = s.bank[0]
    x = b.x
    b.live[k], b.onset[k] = 1, s.t
    for f in range(N_FAULTS):
        j = f * SLOTS + k
        b.num[j], b.den[j], b.heading_num[j], b.heading_den[j] = 0.0, 0.0, 0.0, 0.0
        b.heading_o[j], b.heading_d[j] = 0.0, 0.0
        for i in range(x.shape[0]):
            x[i, j] = 0.0
    b.excess[k], b.spread[k] = 0.0, 0.0
    turning.open_slot(b, k)
    for a in range(3):
        x[9 + a, (GYRO + a) * SLOTS + k] = 1.0
        x[12 + a, (ACCEL + a) * SLOTS + k] = 1.0
        x[a, YAW * SLOTS + k] = down[a]
    if len(s.baro) > 0:
        x[15, BAROMETER_OFFSET * SLOTS + k] = 1.0


@jit
def move(b: Any) -> None:
    """Carry every response over the interval since the last fusion: x <- Φ x, and what ramps have added meanwhile.

    ``b.phi.P`` holds the columns of Φ that are not zero or one, of attitude, gyro bias and accelerometer bias, and then the integrals of
    the last two over the time at which a bias has been added.
    """
    x, P = b.x, b.phi.P
    span = np.float32(b.span)
    for c in range(0, x.shape[1], WIDTH):
        for i in range(3):  # position, of what attitude and velocity were
            a0, a1, a2 = single(P[6 + i, 0], P[6 + i, 1], P[6 + i, 2])
            g0, g1, g2 = single(P[6 + i, 3], P[6 + i, 4], P[6 + i, 5])
            f0, f1, f2 = single(P[6 + i, 6], P[6 + i, 7], P[6 + i, 8])
            for j in range(c, c + WIDTH):
                x[6 + i, j] += (
                    span * x[3 + i, j]
                    + a0 * x[0, j] + a1 * x[1, j] + a2 * x[2, j]
                    + g0 * x[9, j] + g1 * x[10, j] + g2 * x[11, j]
                    + f0 * x[12, j] + f1 * x[13, j] + f2 * x[14, j]
                )  # fmt: skip
        for i in range(3):
            a0, a1, a2 = single(P[3 + i, 0], P[3 + i, 1], P[3 + i, 2])
            g0, g1, g2 = single(P[3 + i, 3], P[3 + i, 4], P[3 + i, 5])
            f0, f1, f2 = single(P[3 + i, 6], P[3 + i, 7], P[3 + i, 8])
            for j in range(c, c + WIDTH):
                x[3 + i, j] += (
                    a0 * x[0, j] + a1 * x[1, j] + a2 * x[2, j]
                    + g0 * x[9, j] + g1 * x[10, j] + g2 * x[11, j]
                    + f0 * x[12, j] + f1 * x[13, j] + f2 * x[14, j]
                )  # fmt: skip
        d00, d01, d02 = single(P[0, 0], P[0, 1], P[0, 2])
        d10, d11, d12 = single(P[1, 0], P[1, 1], P[1, 2])
        d20, d21, d22 = single(P[2, 0], P[2, 1], P[2, 2])
        h00, h01, h02 = single(P[0, 3], P[0, 4], P[0, 5])
        h10, h11, h12 = single(P[1, 3], P[1, 4], P[1, 5])
        h20, h21, h22 = single(P[2, 3], P[2, 4], P[2, 5])
        for j in range(c, c + WIDTH):
            t0, t1, t2, g0, g1, g2 = x[0, j], x[1, j], x[2, j], x[9, j], x[10, j], x[11, j]
            x[0, j] = d00 * t0 + d01 * t1 + d02 * t2 + h00 * g0 + h01 * g1 + h02 * g2
            x[1, j] = d10 * t0 + d11 * t1 + d12 * t2 + h10 * g0 + h11 * g1 + h12 * g2
            x[2, j] = d20 * t0 + d21 * t1 + d22 * t2 + h20 * g0 + h21 * g1 + h22 * g2
    for a in range(3):
        for i in range(15):
            g, f = np.float32(P[i, 9 + a]), np.float32(P[i, 12 + a])
            for k in range(SLOTS):
                if b.live[k] == 1:
                    x[i, (GYRO_RAMP + a) * SLOTS + k] += g
                    x[i, (ACCEL_RAMP + a) * SLOTS + k] += f
    restart_transition(b)


@jit
def add_square(b: Any, t: float, component: int, square: float) -> None:
    """Take the square of a whitened innovation into what has come since each onset beyond what is usual of its component.

    Without a fault that is nothing on average. What a true signature explains of it, num²/den, leaves about as little.
    """
    own = b.own[component]
    b.heard[component] += 1.0
    if b.heard[component] > KNOWN:
        for k in range(len(b.live)):
            b.excess[k] += square - own
            b.spread[k] += 2.0 * own * own
    rate = max(1.0 / b.heard[component], min(1.0, (t - b.t_own[component]) / OWN))
    b.t_own[component] = t
    b.own[component] += rate * (min(square, own * LONE_SQUARE + 1.0) - own)


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
    x, e, bearing, num, den = b.x, b.e, b.bearing, b.num, b.den
    down = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))[2]
    z, weight = 0.0, 0.0
    heading = evidence and component == C_HEADING
    if evidence and not heading:
        z = y / math.sqrt(S)
        most = ALONE + FOLLOWED * abs(b.last[component])
        share = min(1.0, most / max(abs(z), 1e-9))
        b.last[component] = share * z
        weight = share * share / S
        z = weight * y
        b.fresh = 1
        add_square(b, s.t, component, z * y)
        if component == C_ALTITUDE:
            jumping.hear(b.height, s.t, y - s.p[2] + (s.baro[0] if len(s.baro) > 0 else s.baro_start) - b.climb, METRE)
    if heading:
        b.t_heading = s.t
    z4, weight4 = np.float32(z), np.float32(weight)
    own = -1
    if evidence and component < N_GNSS:
        own = (VELOCITY + component) * SLOTS
    elif evidence and component == C_HEADING:
        own = HEADING * SLOTS
    for c in range(0, x.shape[1], WIDTH):
        for j in range(c, c + WIDTH):
            e[j] = ZERO
        for o, h in H:
            h0, h1, h2 = single(h[0], h[1], h[2])
            if h0 != 0.0 or h1 != 0.0 or h2 != 0.0:
                for j in range(c, c + WIDTH):
                    e[j] += h0 * x[o, j] + h1 * x[o + 1, j] + h2 * x[o + 2, j]
        if c <= own and own < c + WIDTH:
            for j in range(own, own + SLOTS):
                e[j] += ONE
        if evidence and not heading:
            for j in range(c, c + WIDTH):
                num[j] += z4 * e[j]
                den[j] += weight4 * e[j] * e[j]
        if heading:  # less its turn of the filter's own heading
            d0, d1, d2 = single(down[0], down[1], down[2])
            for j in range(c, c + WIDTH):
                bearing[j] = e[j] - (d0 * x[0, j] + d1 * x[1, j] + d2 * x[2, j])
        if moved:
            for i in range(x.shape[0]):
                k = np.float32(s.k[i])
                if k != 0.0:
                    for j in range(c, c + WIDTH):
                        x[i, j] -= k * e[j]
    if heading:
        jumping.hear(b.course, s.t, y + s.yaw_corrected, RADIAN)
        turning.by_itself(b, s.t, GYRO, GYRO_RAMP)
        square = turning.hear(b, s.t, y + s.yaw_corrected - b.track.by_bias)
        if square >= 0.0:
            b.fresh = 1
            add_square(b, s.t, component, square)
