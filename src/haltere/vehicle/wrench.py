"""Force and moment of rotors and body drag on a multirotor (theory.md §5.2), and the record of its constants. It integrates nothing."""

from __future__ import annotations

from typing import Any

import numpy as np

from haltere._jit import jit
from haltere.core.rotation import Vec, add, cross, dot, norm, scale, sub

__all__ = ["apply", "body_wrench", "rotor_wrench", "vehicle_layout", "wrench"]


def vehicle_layout(n: int) -> np.dtype[np.void]:
    """Record type of a vehicle with ``n`` rotors; all constants in SI, body FRD, at the air density of the day.

    ``allocate`` gives the thrust of each rotor for a wanted upward force and moment: the pseudo-inverse of the allocation matrix.
    ``motor`` is what a step of the motors needs, speeding up and slowing down; who steps them fills it.
    """
    return np.dtype(
        [
            ("mass", "f8"), ("inertia", "f8", (3, 3)), ("inverse", "f8", (3, 3)), ("drag", "f8", 3),
            ("position", "f8", (n, 3)), ("axis", "f8", (n, 3)), ("spin", "f8", n), ("k_T", "f8", n), ("k_M", "f8", n), ("k_d", "f8", n),
            ("k_z", "f8", n), ("k_h", "f8", n), ("tau_up", "f8", n), ("tau_down", "f8", n), ("speed_max", "f8", n),
            ("spin_inertia", "f8", n), ("motor", "f8", (n, 2, 4)),
            ("thrust_factor", "f8", n), ("allocate", "f8", (n, 4)),
            ("voltage", "f8"), ("resistance", "f8"), ("charge", "f8"), ("sag", "f8"), ("efficiency", "f8"),
        ],
        align=True,
    )  # fmt: skip


@jit
def apply(m: Any, a: Vec) -> Vec:
    """Matrix of a record times a vector."""
    return (
        m[0, 0] * a[0] + m[0, 1] * a[1] + m[0, 2] * a[2],
        m[1, 0] * a[0] + m[1, 1] * a[1] + m[1, 2] * a[2],
        m[2, 0] * a[0] + m[2, 1] * a[1] + m[2, 2] * a[2],
    )


@jit
def rotor_wrench(p: Any, i: int, speed: float, v_air_b: Vec, omega: Vec) -> tuple[Vec, Vec]:
    """Force [N] and moment about the centre of gravity [N m] of rotor ``i``: thrust, translational lift, inflow, H-force, drag torque.

    ``v_air_b`` is the velocity of the centre of gravity through the air [m/s], ``omega`` the body rate [rad/s].
    """
    r = (p.position[i, 0], p.position[i, 1], p.position[i, 2])
    n = (p.axis[i, 0], p.axis[i, 1], p.axis[i, 2])
    a = add(v_air_b, cross(omega, r))
    along = dot(a, n)
    across = sub(a, scale(n, along))
    lift = p.thrust_factor[i] * p.k_T[i] * speed * speed + p.k_h[i] * dot(across, across) - p.k_z[i] * speed * along
    force = sub(scale(n, lift), scale(across, p.k_d[i] * speed))
    moment = sub(cross(r, force), scale(n, p.spin[i] * p.k_M[i] * speed * speed))
    return force, moment


@jit
def body_wrench(p: Any, v_air_b: Vec) -> Vec:
    """Drag of the body at its centre of gravity [N], quadratic in the speed through the air."""
    k = norm(v_air_b)
    return (-k * p.drag[0] * v_air_b[0], -k * p.drag[1] * v_air_b[1], -k * p.drag[2] * v_air_b[2])


@jit
def wrench(p: Any, speeds: Any, accelerations: Any, v_air_b: Vec, omega: Vec) -> tuple[Vec, Vec]:
    """Aerodynamic force [N] and moment [N m] of all rotors and the body, with the torques of spinning and accelerating rotors.

    ``speeds`` [rad/s] and ``accelerations`` [rad/s^2] of the rotors; gravity is not part of it.
    """
    force = body_wrench(p, v_air_b)
    moment = (0.0, 0.0, 0.0)
    h, h_dot = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for i in range(len(p.spin)):
        f, m = rotor_wrench(p, i, speeds[i], v_air_b, omega)
        force, moment = add(force, f), add(moment, m)
        # angular momentum of a rotor that turns counter-clockwise about its thrust axis
        j = p.spin[i] * p.spin_inertia[i]
        n = (p.axis[i, 0], p.axis[i, 1], p.axis[i, 2])
        h, h_dot = add(h, scale(n, j * speeds[i])), add(h_dot, scale(n, j * accelerations[i]))
    return force, sub(moment, add(cross(omega, h), h_dot))
