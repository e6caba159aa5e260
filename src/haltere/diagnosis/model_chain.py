"""A chain of motion that a vehicle's model drives beside the filter: rotor speeds in, no sample of the IMU. It judges nothing.

States are those of `haltere.strapdown.dynamics` (theory-amendments.md 4: rate, attitude, velocity, position, what the model misses of
moment and force; and 2: the wind and its mean, its own), then the offset of the barometer. It begins at the filter's state, goes on in
blocks of a fiftieth of a second with the mean of the squared rotor speeds over each, and corrects itself by compass, GNSS and barometer:
one chain for all three, since by the compass alone, or the barometer, it would not know which way is down for longer than some seconds.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids.air import wind_covariance, wind_n
from haltere.aids.record import BAROMETER, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER
from haltere.core.rotation import Mat, dcm, mat_vec
from haltere.diagnosis.stand_in import density_of_noise, offset_variance, with_lift
from haltere.strapdown.dynamics import air_velocity, carry, move, transition
from haltere.vehicle.linear import linear

__all__ = ["advance", "forget_chain", "gather", "listen", "lost", "seed"]

#: Length of a block [s].
BLOCK = 0.02
#: How long what the model misses lasts [s].
MISS_TIME = 1.0
#: 1 sigma of a rate when the chain begins [rad/s]; what a moment is off by as a part of it, for so long [s].
RATE_SD, RELATIVE, LASTING = 0.02, 0.1, 0.05
#: Vertical gusts beside horizontal ones.
DOWN = 0.5
#: The chain begins anew when its tilt is less sure than this [rad].
LOST = math.radians(20.0)
#: Wind and its mean begin alike to this correlation.
ALIKE = 0.9


@jit
def forget_chain(s: Any) -> None:
    """There is no chain: after alignment, on the ground, without rotor speeds."""
    c = s.chain[0]
    c.live, c.n_due, c.span, c.n = 0, 0, 0.0, 0.0


@jit
def seed(s: Any, prm: Any) -> None:
    """Begin at the filter's state; what the model misses is not known, the wind as the filter knows it."""
    c, P = s.chain[0], s.chain[0].P
    n = P.shape[0]
    c.live, c.t_seed, c.span, c.n = 1, s.t, 0.0, 0.0
    for i in range(n):
        c.dx[i] = 0.0
        for j in range(n):
            P[i, j] = 0.0
    for i in range(3):
        c.w[i], c.v[i], c.p[i], c.bm[i], c.bf[i] = s.w[i], s.v[i], s.p[i], 0.0, 0.0
        c.a[i], c.a_n[i] = 0.0, 0.0
        P[i, i] = RATE_SD * RATE_SD
        P[12 + i, 12 + i], P[15 + i, 15 + i] = offset_variance(s, 3 + i), offset_variance(s, i)
    for i in range(4):
        c.q[i] = s.q[i]
    for i in range(9):
        for j in range(9):
            P[3 + i, 3 + j] = s.P[i, j]
    W = wind_n(s)
    cov = wind_covariance(s, s.P)
    least = prm.air_gust * prm.air_gust
    for i in range(2):
        c.wind[i] = c.steady[i] = W[i]
        v = max((cov[0], cov[3])[i], least)
        P[18 + i, 18 + i], P[20 + i, 20 + i] = v, v
        P[18 + i, 20 + i] = P[20 + i, 18 + i] = ALIKE * v
    c.has_baro = 1 if s.aid[BAROMETER].started != 0 else 0
    c.baro = s.baro_start
    P[22, 22] = 1.0
    for k in range(len(s.baro)):
        c.baro = s.baro[k]
        for i in range(9):
            P[22, 3 + i] = P[3 + i, 22] = s.P[15 + k, i]
        P[22, 22] = s.P[15 + k, 15 + k]
    for k in range(len(s.speed)):
        c.squares[k], c.spin[k] = 0.0, 0.0


@jit
def gather(s: Any, dt: float) -> bool:
    """Take the rotor speeds at the state's time; True at the end of a block."""
    c = s.chain[0]
    for k in range(len(s.speed)):
        c.squares[k] += s.speed[k] * s.speed[k]
        c.spin[k] += s.spin_up[k]
    c.n += 1.0
    c.span += dt
    return bool(c.span >= BLOCK - 0.5 * dt)


@jit
def listen(s: Any) -> None:
    """Keep what the filter is about to take off its queues, until the end of the block."""
    c = s.chain[0]
    size = s.ring.shape[1]
    for kind in (GNSS_VELOCITY, GNSS_POSITION, BAROMETER, MAGNETOMETER):
        for k in range(s.ring_n[kind]):
            m = s.ring[kind, (s.ring_head[kind] + k) % size]
            if m.t > s.t or c.n_due >= len(c.due):
                break
            d = c.due[c.n_due]
            d.kind, d.t = kind, m.t
            for i in range(3):
                d.z[i], d.r[i] = m.z[i], m.r[i]
            c.n_due += 1


@jit
def advance(s: Any, prm: Any) -> None:
    """Move the chain over the block that has ended."""
    c, p, m = s.chain[0], s.pairs[0], s.model[0]
    dt, n = c.span, c.n
    c.span, c.n = 0.0, 0.0
    for k in range(len(s.speed)):
        c.speed[k], c.spin_up[k] = math.sqrt(c.squares[k] / n), c.spin[k] / n
        c.squares[k], c.spin[k] = 0.0, 0.0
    w = (c.w[0], c.w[1], c.w[2])
    C = dcm((c.q[0], c.q[1], c.q[2], c.q[3]))
    v = air_velocity(C, (c.v[0], c.v[1], c.v[2]), c.wind[0], c.wind[1])
    eta = (c.a[0], c.a[1], c.a[2]) if m.literal == 1 else w
    f, a, D_v, D_w, M_v, M_w = linear(m, c.speed, c.spin_up, v, w, eta, p.ratio)
    f, a = with_lift(s, c.speed, f, a)
    half = mat_vec(M_w, (a[0] + c.bm[0], a[1] + c.bm[1], a[2] + c.bm[2]))  # damping at the rate of the middle
    a = (a[0] + 0.5 * dt * half[0], a[1] + 0.5 * dt * half[1], a[2] + 0.5 * dt * half[2])
    force = (f[0] + c.bf[0], f[1] + c.bf[1], f[2] + c.bf[2])
    keep, leak = math.exp(-dt / prm.air_gust_time), math.exp(-dt / MISS_TIME)
    T = transition(C, w, force, v, D_v, D_w, M_v, M_w, dt, keep, leak)
    for i in range(3):
        c.a[i], c.a_n[i] = a[i] + c.bm[i], c.v[i]
    move(c, f, a, s.gravity, dt, keep, leak)
    for i in range(3):
        c.a_n[i] = (c.v[i] - c.a_n[i]) / dt
    carry(c, T)
    noise(s, prm, C, D_v, dt)


@jit
def noise(s: Any, prm: Any, C: Mat, D_v: Mat, dt: float) -> None:
    """What a block adds to the covariance: what the model misses, gusts, the barometer's walk."""
    c, P = s.chain[0], s.chain[0].P
    gust = prm.air_gust + prm.air_turbulence * math.sqrt(c.steady[0] * c.steady[0] + c.steady[1] * c.steady[1])
    white = (density_of_noise(s, 0), density_of_noise(s, 1), density_of_noise(s, 2))
    for i in range(3):
        part = RELATIVE * c.a[i]
        P[i, i] += dt * (density_of_noise(s, 3 + i) + part * part * LASTING)
        P[3 + i, 3 + i] += dt * 1e-9
        P[9 + i, 9 + i] += dt * 1e-6
        P[12 + i, 12 + i] += dt * 2.0 * offset_variance(s, 3 + i) / MISS_TIME
        lift = DOWN * gust * D_v[2][2] if i == 2 else 0.0
        P[15 + i, 15 + i] += dt * 2.0 * (offset_variance(s, i) + lift * lift) / MISS_TIME
        for j in range(3):
            P[6 + i, 6 + j] += dt * (C[i][0] * C[j][0] * white[0] + C[i][1] * C[j][1] * white[1] + C[i][2] * C[j][2] * white[2])
    for i in range(2):
        P[18 + i, 18 + i] += dt * 2.0 * gust * gust / prm.air_gust_time
        P[20 + i, 20 + i] += dt * prm.noise_wind_mean * prm.noise_wind_mean
    P[22, 22] += dt * prm.noise_baro_bias * prm.noise_baro_bias


@jit
def lost(s: Any) -> bool:
    """Whether the chain does not know which way is down any more."""
    c = s.chain[0]
    C = dcm((c.q[0], c.q[1], c.q[2], c.q[3]))
    tilt = 0.0
    for i in range(3):
        tilt += c.P[3 + i, 3 + i] * (1.0 - C[2][i] * C[2][i])
    return bool(not tilt < LOST * LOST or not math.isfinite(c.v[0] + c.p[2] + c.q[0]))
