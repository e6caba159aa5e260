"""Queues of a filter that runs behind its newest sample: IMU samples, and measurements sorted by the time they were valid."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit

__all__ = ["oldest_imu", "pop_due", "pop_imu", "push", "push_imu"]

Vec = tuple[float, float, float]


@jit
def push_imu(s: Any, t: float, w: Vec, f: Vec) -> None:
    """Append an IMU sample; there must be room."""
    i = (s.imu_head + s.imu_n) % len(s.imu)
    m = s.imu[i]
    m.t = t
    m.w[0], m.w[1], m.w[2] = w
    m.f[0], m.f[1], m.f[2] = f
    s.imu_n += 1


@jit
def oldest_imu(s: Any) -> int:
    """Index of the oldest IMU sample, or -1."""
    return s.imu_head if s.imu_n > 0 else -1


@jit
def pop_imu(s: Any) -> None:
    """Drop the oldest IMU sample."""
    s.imu_head = (s.imu_head + 1) % len(s.imu)
    s.imu_n -= 1


@jit
def push(s: Any, kind: int, t: float, z: Vec, r: Vec) -> int:
    """Queue a measurement of a sensor by its valid time.

    Returns
    -------
    int
        1 queued; 0 refused, valid before the state's time; -1 queued in the room of the oldest. Both losses are counted.
    """
    a = s.aid[kind]
    if s.phase > 0 and t < s.t - 1e-9:
        a.n_late += 1
        return 0
    n, size = s.ring_n[kind], s.ring.shape[1]
    full = n == size
    if full:
        a.n_overflow += 1
        s.ring_head[kind] = (s.ring_head[kind] + 1) % size
        n -= 1
    head = s.ring_head[kind]
    i = n
    while i > 0:  # nearly always in order already
        before = s.ring[kind, (head + i - 1) % size]
        if before.t <= t:
            break
        here = s.ring[kind, (head + i) % size]
        here.t = before.t
        for j in range(3):
            here.z[j], here.r[j] = before.z[j], before.r[j]
        i -= 1
    m = s.ring[kind, (head + i) % size]
    m.t = t
    m.z[0], m.z[1], m.z[2] = z
    m.r[0], m.r[1], m.r[2] = r
    s.ring_n[kind] = n + 1
    s.t_wake = min(s.t_wake, t)
    return -1 if full else 1


@jit
def pop_due(s: Any, kind: int, t: float) -> int:
    """Index of the next measurement of a sensor valid at or before t, taken off its queue; -1 where there is none."""
    if s.ring_n[kind] == 0:
        return -1
    i = s.ring_head[kind]
    if s.ring[kind, i].t > t:
        return -1
    s.ring_head[kind] = (i + 1) % s.ring.shape[1]
    s.ring_n[kind] -= 1
    return i
