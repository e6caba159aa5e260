"""One flight: a vehicle with its controller along a reference through wind, recorded with everything that is true. No sensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere._jit import entry, jit
from haltere.core.rotation import Vec
from haltere.simulate.controller import control
from haltere.simulate.rotorcraft import prepare, step_body
from haltere.simulate.wind import gust, shear

__all__ = ["DISTURBANCE", "RECORD", "fly", "record_width"]

#: Columns of a record before those of the rotors: speed [rad/s], turned angle [rad] and command (0 to 1) of each.
RECORD = (
    "pos_n", "pos_e", "pos_d", "vel_n", "vel_e", "vel_d", "q_w", "q_x", "q_y", "q_z", "omega_x", "omega_y", "omega_z",
    "omega_dot_x", "omega_dot_y", "omega_dot_z", "force_x", "force_y", "force_z", "wind_n", "wind_e", "wind_d", "voltage", "current",
)  # fmt: skip

#: What acts on the vehicle between two times: force [m/s^2] and moment [rad/s^2] that its model does not have, wind on top [m/s],
#: and the thrust of one rotor times a factor (rotor -1: none). ``rate`` grows it from the beginning, 0: whole at once.
DISTURBANCE = np.dtype(
    [("start", "f8"), ("end", "f8"), ("rate", "f8"), ("push", "f8", 3), ("twist", "f8", 3), ("wind", "f8", 3), ("rotor", "i8"),
     ("factor", "f8")],
    align=True,
)  # fmt: skip


def record_width(n: int) -> int:
    """Columns of a record of a vehicle with ``n`` rotors."""
    return len(RECORD) + 3 * n


@jit
def _look_up(c: Any, reference: Any, rate: float, t: float) -> None:
    """Row of the reference at a time, linear between its rows, into ``c.reference``; held at its end."""
    x = min(t * rate, len(reference) - 1.0)
    i = min(int(x), len(reference) - 2)
    f = x - i
    for j in range(12):
        c.reference[j] = reference[i, j] + f * (reference[i + 1, j] - reference[i, j])


@jit
def _acting(p: Any, disturbances: Any, t: float) -> tuple[Vec, Vec, Vec]:
    """Force [m/s^2], moment [rad/s^2] and wind [m/s] of the disturbances at a time; thrust factors of the rotors go into the vehicle."""
    push, twist, air = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for i in range(len(p.spin)):
        p.thrust_factor[i] = 1.0
    for j in range(len(disturbances)):
        d = disturbances[j]
        if d.start <= t < d.end:
            x = min(1.0, d.rate * (t - d.start)) if d.rate > 0.0 else 1.0
            push = (push[0] + x * d.push[0], push[1] + x * d.push[1], push[2] + x * d.push[2])
            twist = (twist[0] + x * d.twist[0], twist[1] + x * d.twist[1], twist[2] + x * d.twist[2])
            air = (air[0] + x * d.wind[0], air[1] + x * d.wind[1], air[2] + x * d.wind[2])
            if d.rotor >= 0:
                p.thrust_factor[d.rotor] *= 1.0 + x * (d.factor - 1.0)
    return push, twist, air


@jit
def _air(w: Any, s: Any, mean: Vec, extra: Vec, dt: float, noise: Any) -> Vec:
    """Wind at the vehicle [m/s], NED: the mean at its height, what a disturbance adds, and a step of turbulence."""
    k = shear(w, -s.pos[2])
    base = (k * mean[0] + extra[0], k * mean[1] + extra[1], k * mean[2] + extra[2])
    past = math.sqrt((s.vel[0] - base[0]) ** 2 + (s.vel[1] - base[1]) ** 2 + (s.vel[2] - base[2]) ** 2)
    rough = gust(w, past, dt, noise)
    return (base[0] + rough[0], base[1] + rough[1], base[2] + rough[2])


@entry
def fly(
    P: Any, S: Any, C: Any, W: Any, reference: Any, rate: float, mean: Vec, noise: Any, disturbances: Any, g: float, hertz: float,
    every: int, out: Any,
) -> int:  # fmt: skip
    """Fly along a reference, ``hertz`` steps a second, and record every ``every``-th step in ``out``.

    Parameters
    ----------
    P, S, C, W
        Records (one element each) of vehicle, body, controller and wind.
    reference, rate
        Rows of `haltere.simulate.controller.REFERENCE`, so many a second [Hz].
    mean
        Mean wind NED [m/s].
    noise
        Normal numbers (n, 5), a row a step: the flight has n steps.
    disturbances
        Records of `DISTURBANCE`.
    out
        Filled, (columns, rows): `RECORD` and the rotors'.

    Returns
    -------
    int
        Rows written: fewer than ``out`` has where the vehicle is lost (a state that is not finite, or a kilometre off).
    """
    p, s, c, w = P[0], S[0], C[0], W[0]
    rows, n = 0, len(p.spin)
    dt = 1.0 / hertz
    prepare(p, dt)
    for k in range(len(noise)):
        t = k / hertz
        push, twist, extra = _acting(p, disturbances, t)
        wind = _air(w, s, mean, extra, dt, noise[k])
        _look_up(c, reference, rate, t)
        control(p, c, s, c.reference, g, dt)
        keep = k % every == 0
        if keep:
            for i in range(3):
                out[i, rows], out[3 + i, rows], out[10 + i, rows] = s.pos[i], s.vel[i], s.omega[i]
                out[19 + i, rows] = wind[i]
            for i in range(4):
                out[6 + i, rows] = s.q[i]
            out[22, rows], out[23, rows] = s.voltage, s.current
            for i in range(n):
                out[24 + i, rows], out[24 + n + i, rows], out[24 + 2 * n + i, rows] = s.speed[i], s.phase[i], c.command[i]
        step_body(p, s, c.target, wind, push, twist, g, dt)
        if keep:
            for i in range(3):
                out[13 + i, rows], out[16 + i, rows] = s.omega_dot[i], s.force[i]
            rows += 1
        if not (abs(s.pos[0] - c.reference[0]) + abs(s.pos[1] - c.reference[1]) + abs(s.pos[2] - c.reference[2]) < 1000.0):
            break
    return rows
