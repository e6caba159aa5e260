"""A flight controller that knows the true state: position, attitude and rates in cascade, then rotor commands. It senses nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records, jit
from haltere.core.rotation import Quat, Vec, add, cross, dcm, norm, quat_from_dcm, quat_mul, scale
from haltere.flight.vehicle import Vehicle
from haltere.vehicle.wrench import apply

__all__ = ["REFERENCE", "control", "controller_layout", "controller_record"]

#: Columns of a row of the reference: position, velocity, acceleration NED, yaw [rad], its rate, and 1 in flight or 0 with motors off.
REFERENCE = ("n", "e", "d", "vn", "ve", "vd", "an", "ae", "ad", "yaw", "yaw_rate", "flying")

#: Tangent of the largest tilt asked for.
TILT_MAX = math.tan(math.radians(55.0))


def controller_layout(n: int) -> np.dtype[np.void]:
    """Record type of a controller for ``n`` rotors.

    Bandwidths [rad/s], motor lag left [s], integrals, what it commands [0-1], and the row of the reference that it follows.
    """
    return np.dtype(
        [
            ("position", "f8"), ("attitude", "f8"), ("rate", "f8"), ("lag", "f8", n), ("sum_pos", "f8", 3), ("sum_att", "f8", 3),
            ("command", "f8", n), ("target", "f8", n), ("thrust", "f8", n), ("wanted", "f8", 3), ("grow", "f8", 3),
            ("reference", "f8", 12),
        ],
        align=True,
    )  # fmt: skip


def controller_record(vehicle: Vehicle) -> NDArray[np.void]:
    """Controller of a vehicle, its bandwidths as fast as the motors allow."""
    c = as_records(np.zeros(1, controller_layout(len(vehicle.rotors))))
    slow = np.array([max(r.tau_up, r.tau_down) for r in vehicle.rotors])
    lag = np.maximum(0.25 * slow, np.minimum(slow, 0.012))
    rate = min(0.35 / float(lag.max()), 30.0)
    c["lag"][0] = lag
    c["rate"], c["attitude"], c["position"] = rate, rate / 3.0, min(rate / 10.0, 2.5)
    return c


@jit
def _most(p: Any, s: Any) -> float:
    """Thrust [N] that the weakest rotor can give at the voltage there is, with a little left for the governor."""
    fill = s.voltage / p.voltage if s.voltage > 0.0 else 1.0
    most = 1e30
    for i in range(len(p.spin)):
        full = 0.98 * p.speed_max[i] * fill
        most = min(most, p.k_T[i] * full * full)
    return most


@jit
def _wanted_force(c: Any, s: Any, ref: Any, g: float, strength: float, dt: float) -> Vec:
    """Specific force NED [m/s^2] that brings the vehicle to its reference, within ``strength`` [m/s^2]: height comes first."""
    k = c.position
    for i in range(3):
        e, de = max(-6.0, min(6.0, ref[i] - s.pos[i])), ref[3 + i] - s.vel[i]
        # the integral carries wind drag and what the thrust model lacks
        c.grow[i] = 0.35 * k * (k * k * e + 1.4 * k * de) * dt
        c.wanted[i] = ref[6 + i] + k * k * e + 1.8 * k * de + c.sum_pos[i] + c.grow[i]
    down = max(-0.97 * strength, min(-0.2 * g, c.wanted[2] - g))
    flat = math.sqrt(c.wanted[0] * c.wanted[0] + c.wanted[1] * c.wanted[1])
    limit = min(-down * TILT_MAX, math.sqrt(strength * strength - down * down))
    k = limit / flat if flat > limit else 1.0
    for i in range(3):
        # what cannot be had is not asked for more and more
        if k == 1.0 or c.grow[i] * c.wanted[i] < 0.0 or i == 2:
            c.sum_pos[i] = max(-8.0, min(8.0, c.sum_pos[i] + c.grow[i]))
    return (k * c.wanted[0], k * c.wanted[1], down)


@jit
def _wanted_attitude(force: Vec, yaw: float) -> Quat:
    """Attitude q_nb whose thrust points along a force, the nose along yaw as nearly as the thrust allows."""
    b3 = scale(force, -1.0 / norm(force))
    b1 = cross((-math.sin(yaw), math.cos(yaw), 0.0), b3)
    b1 = scale(b1, 1.0 / norm(b1))
    b2 = cross(b3, b1)
    return quat_from_dcm(((b1[0], b2[0], b3[0]), (b1[1], b2[1], b3[1]), (b1[2], b2[2], b3[2])))


@jit
def control(p: Any, c: Any, s: Any, ref: Any, g: float, dt: float) -> None:
    """Rotor commands ``c.command`` (0 to 1) and the speeds they ask for ``c.target`` [rad/s] for one row of the reference."""
    n = len(p.spin)
    if ref[11] < 0.5:
        for i in range(3):
            c.sum_pos[i] = 0.0
            c.sum_att[i] = 0.0
        for i in range(n):
            c.command[i] = 0.0
            c.target[i] = 0.0
        return
    most = _most(p, s)
    force = _wanted_force(c, s, ref, g, 0.92 * n * most / p.mass, dt)
    q, w = (s.q[0], s.q[1], s.q[2], s.q[3]), (s.omega[0], s.omega[1], s.omega[2])
    d = quat_mul((q[0], -q[1], -q[2], -q[3]), _wanted_attitude(force, ref[9]))
    k = 2.0 if d[0] >= 0.0 else -2.0
    C = dcm(q)
    for i in range(3):
        e = k * d[i + 1]
        quick = 2.5 if i == 2 else 6.0
        wanted = max(-quick, min(quick, c.attitude * e + C[2][i] * ref[10]))
        c.sum_att[i] = max(-20.0, min(20.0, c.sum_att[i] + c.rate * c.attitude * e * dt))
        c.wanted[i] = c.rate * (wanted - w[i]) + c.sum_att[i]
    alpha = (c.wanted[0], c.wanted[1], c.wanted[2])
    moment = add(apply(p.inertia, alpha), cross(w, apply(p.inertia, w)))
    lift = -p.mass * (C[0][2] * force[0] + C[1][2] * force[1] + C[2][2] * force[2])
    _mix(p, c, s, most, lift, moment)


@jit
def _mix(p: Any, c: Any, s: Any, most: float, lift: float, moment: Vec) -> None:
    """Thrusts for a lift [N] and moments [N m]: roll and pitch before lift, lift before yaw, where rotors reach their limits."""
    n = len(p.spin)
    fill = s.voltage / p.voltage if s.voltage > 0.0 else 1.0
    low, high = 1e30, -1e30
    for i in range(n):
        tilt = p.allocate[i, 1] * moment[0] + p.allocate[i, 2] * moment[1]
        low, high = min(low, tilt), max(high, tilt)
    shrink = 0.9 * most / (high - low) if high - low > 0.9 * most else 1.0
    low, high = 1e30, -1e30
    for i in range(n):
        c.thrust[i] = p.allocate[i, 0] * lift + shrink * (p.allocate[i, 1] * moment[0] + p.allocate[i, 2] * moment[1])
        low, high = min(low, c.thrust[i]), max(high, c.thrust[i])
    shift = min(most - high, 0.0) if high > most else max(0.02 * most - low, 0.0)
    room = 1.0
    for i in range(n):
        c.thrust[i] += shift
        yaw = p.allocate[i, 3] * moment[2]
        if yaw > 0.0:
            room = min(room, max(most - c.thrust[i], 0.0) / yaw)
        if yaw < 0.0:
            room = min(room, max(c.thrust[i], 0.0) / -yaw)
    for i in range(n):
        speed = math.sqrt(max(0.0, c.thrust[i] + room * p.allocate[i, 3] * moment[2]) / p.k_T[i])
        # the governor asks for more than it wants, so that a slow motor gets there sooner
        tau = p.tau_up[i] if speed > s.speed[i] else p.tau_down[i]
        full = p.speed_max[i] * fill
        c.target[i] = max(0.0, min(full, s.speed[i] + (speed - s.speed[i]) * tau / c.lag[i]))
        c.command[i] = c.target[i] / full
