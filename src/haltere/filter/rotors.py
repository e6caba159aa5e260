"""Rotor speeds as they come and as they are at the filter's time: queue, interpolation, rate of change. It knows no vehicle."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit

__all__ = ["forget_rotors", "push_rotors", "rotors_at"]

#: A speed is believed for so long after its time [s], and interpolated over at most as much.
STALE = 0.25


@jit
def forget_rotors(s: Any) -> None:
    """No speed is known."""
    s.rotor_n, s.rotor_known = 0, 0


@jit
def push_rotors(s: Any, t: float, speeds: Any) -> int:
    """Queue the speeds (n,) [rad/s] of all rotors, valid at t; only the newest that fit are kept.

    Returns
    -------
    int
        1 queued; 0 refused and counted: not after the one before, or the wrong number of rotors.
    """
    size = len(s.rotor)
    if size == 0 or len(speeds) != len(s.speed):
        return 0
    if s.rotor_n > 0 and t <= s.rotor[(s.rotor_head + s.rotor_n - 1) % size].t:
        s.n_rotor_bad += 1
        return 0
    if s.rotor_n == size:
        s.rotor_head = (s.rotor_head + 1) % size
        s.rotor_n -= 1
    m = s.rotor[(s.rotor_head + s.rotor_n) % size]
    m.t = t
    for k in range(len(speeds)):
        m.o[k] = abs(speeds[k])
    s.rotor_n += 1
    return 1


@jit
def rotors_at(s: Any, t: float) -> None:
    """Put speeds [rad/s] and their rates of change [rad/s^2] at t into ``s.speed`` and ``s.spin_up``; ``s.rotor_known`` says whether.

    Between two samples they are interpolated, after the last one its speeds hold for a while. Times must not go back.
    """
    size = len(s.rotor)
    while s.rotor_n > 1 and s.rotor[(s.rotor_head + 1) % size].t <= t:
        s.rotor_head = (s.rotor_head + 1) % size
        s.rotor_n -= 1
    s.rotor_known = 0
    if s.rotor_n == 0:
        return
    a = s.rotor[s.rotor_head]
    since = t - a.t
    if since < 0.0 or since > STALE:
        return
    s.rotor_known = 1
    if s.rotor_n > 1:
        b = s.rotor[(s.rotor_head + 1) % size]
        span = b.t - a.t
        if span <= STALE:
            for k in range(len(s.speed)):
                s.spin_up[k] = (b.o[k] - a.o[k]) / span
                s.speed[k] = a.o[k] + since * s.spin_up[k]
            return
    for k in range(len(s.speed)):
        s.speed[k], s.spin_up[k] = a.o[k], 0.0
