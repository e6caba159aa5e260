"""Is the vehicle at rest? Statistics of the last second of the IMU, in four blocks of a quarter second. It fuses nothing."""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.aids.record import GNSS_VELOCITY
from haltere.core.rotation import Vec, norm

__all__ = ["at_rest", "forget", "monitor", "quiet"]

BLOCK = 0.25


@jit
def forget(s: Any) -> None:
    """Start the statistics anew, after a gap or at the beginning."""
    m = s.rest
    m.block, m.filled, m.still, m.t_block = 0, 0, 0, s.t
    for b in range(4):
        m.n[b], m.a[b], m.aa[b] = 0.0, 0.0, 0.0
        for i in range(3):
            m.w[b, i], m.ww[b, i], m.f[b, i] = 0.0, 0.0, 0.0


@jit
def judge(s: Any, prm: Any) -> None:
    """Judge the last second: std of rate, std of |f|, and mean |f| against gravity (theory-amendments.md §8)."""
    m = s.rest
    n, a, aa = 0.0, 0.0, 0.0
    for b in range(4):
        n += m.n[b]
        a += m.a[b]
        aa += m.aa[b]
    if n < 4.0:
        m.still = 0
        return
    spread = 0.0
    for i in range(3):
        w, ww, f = 0.0, 0.0, 0.0
        for b in range(4):
            w += m.w[b, i]
            ww += m.ww[b, i]
            f += m.f[b, i]
        m.mean_w[i], m.mean_f[i] = w / n, f / n
        spread = max(spread, ww / n - (w / n) * (w / n))
    mean_f = norm((m.mean_f[0], m.mean_f[1], m.mean_f[2]))
    m.mean_a = a / n
    sd_a = math.sqrt(max(0.0, aa / n - (a / n) * (a / n)))
    rate = norm((m.mean_w[0], m.mean_w[1], m.mean_w[2]))
    still = spread < prm.rest_gyro * prm.rest_gyro and sd_a < prm.rest_accel and abs(mean_f - s.gravity) < prm.rest_gravity
    m.still = 1 if still and rate < 5.0 * prm.rest_gyro else 0


@jit
def monitor(s: Any, prm: Any, t: float, w: Vec, f: Vec) -> None:
    """Take one IMU sample into the statistics; judge at the end of each block."""
    m = s.rest
    if t - m.t_block >= BLOCK:
        m.filled = min(4, m.filled + 1)
        if m.filled >= 4:
            judge(s, prm)
        m.block = (m.block + 1) % 4
        m.t_block = t
        b = m.block
        m.n[b], m.a[b], m.aa[b] = 0.0, 0.0, 0.0
        for i in range(3):
            m.w[b, i], m.ww[b, i], m.f[b, i] = 0.0, 0.0, 0.0
    b = m.block
    a = math.sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
    m.n[b] += 1.0
    m.a[b] += a
    m.aa[b] += a * a
    for i in range(3):
        m.w[b, i] += w[i]
        m.ww[b, i] += w[i] * w[i]
        m.f[b, i] += f[i]


@jit
def quiet(s: Any, prm: Any, w: Vec, f: Vec) -> bool:
    """Is this very sample still like the second before it? It ends rest before the statistics do."""
    m = s.rest
    a = math.sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
    return (
        abs(a - m.mean_a) < 4.0 * prm.rest_accel
        and abs(w[0] - m.mean_w[0]) < 6.0 * prm.rest_gyro
        and abs(w[1] - m.mean_w[1]) < 6.0 * prm.rest_gyro
        and abs(w[2] - m.mean_w[2]) < 6.0 * prm.rest_gyro
    )


@jit
def at_rest(s: Any, prm: Any, w: Vec, f: Vec) -> bool:
    """At rest on something that does not move.

    Named conditions: the last second was still and this sample is; the velocity estimate is small; GNSS, where it speaks,
    says the same; and a vehicle that has moved away without GNSS since is not believed to rest, since a smooth hover or
    cruise looks alike to an IMU.
    """
    m = s.rest
    speed2 = s.v[0] * s.v[0] + s.v[1] * s.v[1] + s.v[2] * s.v[2]
    sd2 = s.P[3, 3] + s.P[4, 4] + s.P[5, 5]
    gnss_speaks = s.aid[GNSS_VELOCITY].started > 0 and s.t - s.aid[GNSS_VELOCITY].t_passed < 1.0
    if speed2 > 1.5**2 and sd2 < 0.75**2:
        m.moved = 1
    if gnss_speaks and speed2 < 0.3**2:
        m.moved = 0
    fix = math.sqrt(s.yaw.z[0] * s.yaw.z[0] + s.yaw.z[1] * s.yaw.z[1])  # the last GNSS velocity
    denied = s.t - s.aid[GNSS_VELOCITY].t_offered < 1.0 and fix > 0.5 + 2.0 * math.sqrt(s.yaw.r)
    small = speed2 < 0.5**2 + 4.0 * sd2 and not denied
    return m.still == 1 and small and (gnss_speaks or m.moved == 0) and quiet(s, prm, w, f)
