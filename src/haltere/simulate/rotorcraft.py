"""A multirotor as a rigid body in wind, on the ground and in the air: its derivative and one step in time. No controller, no sensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records, entry, jit
from haltere.core.rotation import Mat, Quat, Vec, add, cross, dcm, mat_vec, quat_mul, quat_unit, scale, sub, tmat_vec
from haltere.flight.vehicle import Vehicle
from haltere.vehicle.wrench import apply, vehicle_layout, wrench

__all__ = ["body_layout", "derivative", "drift", "new_body", "prepare", "step_body", "vehicle_record"]

#: Stiffness and damping of the landing gear, as of an oscillator: so stiff that it settles within a tenth of a second and sinks 3 mm;
#: it grips like a stiff damper up to its friction.
GEAR_FREQUENCY, GEAR_DAMPING, GEAR_SLIP, GEAR_FRICTION = 60.0, 1.0, 500.0, 0.8


def body_layout(n: int) -> np.dtype[np.void]:
    """Record type of the state of a body with ``n`` rotors.

    Velocity and position NED [m/s, m], attitude q_nb, rate body FRD [rad/s], rotor speeds [rad/s] and their turned angle [rad],
    charge used [A s]; below, what the last step found: force on the body without gravity [N] and angular acceleration [rad/s^2].
    """
    return np.dtype(
        [
            ("pos", "f8", 3), ("vel", "f8", 3), ("q", "f8", 4), ("omega", "f8", 3), ("speed", "f8", n), ("phase", "f8", n),
            ("used", "f8"), ("voltage", "f8"), ("current", "f8"),
            ("force", "f8", 3), ("omega_dot", "f8", 3), ("w", "f8", n), ("w_dot", "f8", n),
        ],
        align=True,
    )  # fmt: skip


def vehicle_record(vehicle: Vehicle, density: float | None = None) -> NDArray[np.void]:
    """Constants of a vehicle as the record that kernels read, at an air density [kg/m^3] (default: that of the file)."""
    n = len(vehicle.rotors)
    p = as_records(np.zeros(1, vehicle_layout(n)))
    ratio = 1.0 if density is None else density / vehicle.density
    p["mass"], p["inertia"], p["inverse"] = vehicle.mass, vehicle.inertia_matrix, np.linalg.inv(vehicle.inertia_matrix)
    p["drag"] = ratio * np.array(vehicle.drag)
    for name in ("position", "axis", "spin", "tau_up", "tau_down", "speed_max"):
        p[name][0] = [getattr(r, name) for r in vehicle.rotors]
    for name in ("k_T", "k_M", "k_d", "k_z", "k_h"):
        p[name][0] = [ratio * getattr(r, name) for r in vehicle.rotors]
    p["spin_inertia"][0] = [r.inertia for r in vehicle.rotors]
    p["thrust_factor"] = 1.0
    p["allocate"][0] = np.linalg.pinv(vehicle.allocation())
    b = vehicle.battery
    p["voltage"] = b.voltage if b else 1.0
    if b is not None:
        p["resistance"], p["charge"], p["sag"], p["efficiency"] = b.resistance, 3600.0 * b.capacity, b.sag, b.efficiency
    return p


def new_body(n: int) -> NDArray[np.void]:
    """State of a body with ``n`` rotors, at rest on the ground at the origin, level, nose north."""
    s = as_records(np.zeros(1, body_layout(n)))
    s["q"][0, 0] = 1.0
    return s


@jit
def _gear(p: Any, pos: Vec, vel: Vec, C: Mat, omega: Vec, g: float) -> tuple[Vec, Vec]:
    """Force NED [N] and moment body [N m] of the landing gear: a spring and damper under the body, friction, and what keeps it upright."""
    depth = pos[2]
    if depth <= 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    k = p.mass * GEAR_FREQUENCY * GEAR_FREQUENCY
    c = 2.0 * GEAR_DAMPING * p.mass * GEAR_FREQUENCY
    load = max(0.0, k * depth + c * vel[2])
    ease = min(1.0, load / (p.mass * g))  # a vehicle about to lift off slides and tips freely
    slip = math.sqrt(vel[0] * vel[0] + vel[1] * vel[1])
    k = min(ease * p.mass * GEAR_SLIP, GEAR_FRICTION * load / slip) if slip > 0.0 else 0.0
    f = (-k * vel[0], -k * vel[1], -load)
    up = (C[2][0], C[2][1], C[2][2])  # the vertical in the body; level is (0, 0, 1)
    stiff, damp = 900.0 * ease, 60.0 * ease
    a = (-stiff * up[1] - damp * omega[0], stiff * up[0] - damp * omega[1], -damp * omega[2])
    m = (p.inertia[0, 0] * a[0], p.inertia[1, 1] * a[1], p.inertia[2, 2] * a[2])
    return f, m


@jit
def derivative(
    p: Any, s: Any, pos: Vec, vel: Vec, q: Quat, omega: Vec, wind: Vec, push: Vec, twist: Vec, g: float
) -> tuple[Vec, Quat, Vec, Vec]:
    """Acceleration NED, q_dot, omega_dot and the body force per mass [m/s^2] (gravity left out) with rotor speeds ``s.w``, ``s.w_dot``.

    ``push`` [m/s^2] and ``twist`` [rad/s^2] are what the model of the vehicle does not have: faults and disturbances, body FRD.
    """
    C = dcm(q)
    v_air_b = tmat_vec(C, sub(vel, wind))
    force, moment = wrench(p, s.w, s.w_dot, v_air_b, omega)
    ground_f, ground_m = _gear(p, pos, vel, C, omega, g)
    f_b = add(add(scale(force, 1.0 / p.mass), push), tmat_vec(C, scale(ground_f, 1.0 / p.mass)))
    moment = add(moment, ground_m)
    h = apply(p.inertia, omega)
    omega_dot = add(apply(p.inverse, sub(moment, cross(omega, h))), twist)
    acc = mat_vec(C, f_b)
    q_dot = quat_mul(q, (0.0, 0.5 * omega[0], 0.5 * omega[1], 0.5 * omega[2]))
    return (acc[0], acc[1], acc[2] + g), q_dot, omega_dot, f_b


@jit
def prepare(p: Any, dt: float) -> None:
    """What steps of ``dt`` need of each motor, up and down: its decay, the means of the decay and of its square, 1 / time constant."""
    for i in range(len(p.spin)):
        for u in range(2):
            tau = p.tau_up[i] if u == 0 else p.tau_down[i]
            x = dt / tau
            decay = math.exp(-x)
            p.motor[i, u, 0], p.motor[i, u, 1], p.motor[i, u, 2] = decay, (1.0 - decay) / x, 0.5 * (1.0 - decay * decay) / x
            p.motor[i, u, 3] = 1.0 / tau


@jit
def _motors(p: Any, s: Any, command: Any, dt: float, stage: int) -> None:
    """Speeds and accelerations of the motors at the beginning (0), middle (1) and end (2) of a step of constant command.

    First order, up and down apart, in closed form. In the middle stand the values with which Simpson's rule gives the exact mean
    of the squared speed and of the acceleration, since a small motor settles within a few steps.
    """
    for i in range(len(p.spin)):
        m = p.motor[i, 0 if command[i] > s.speed[i] else 1]
        decay = m[0]
        first, left = s.speed[i], s.speed[i] - command[i]
        if stage == 0:
            s.w[i], s.w_dot[i] = first, -left * m[3]
            continue
        last = command[i] + left * decay
        if stage == 2:
            s.w[i], s.w_dot[i] = last, -left * decay * m[3]
            continue
        mean_square = command[i] * command[i] + 2.0 * command[i] * left * m[1] + left * left * m[2]
        s.w[i] = math.sqrt(max(0.0, 0.25 * (6.0 * mean_square - first * first - last * last)))
        s.w_dot[i] = 0.25 * (6.0 * (last - first) / dt + left * (1.0 + decay) * m[3])


@jit
def _quat_add(q: Quat, d: Quat, k: float) -> Quat:
    return (q[0] + k * d[0], q[1] + k * d[1], q[2] + k * d[2], q[3] + k * d[3])


@jit
def step_body(p: Any, s: Any, command: Any, wind: Vec, push: Vec, twist: Vec, g: float, dt: float) -> None:
    """One step of ``dt`` seconds with constant commanded speeds and wind: Runge-Kutta of fourth order, the motors exactly.

    `prepare` has been called for this ``dt``. Afterwards ``s.force`` is the specific force at the beginning of the step and
    ``s.omega_dot`` the angular acceleration there.
    """
    pos, vel = (s.pos[0], s.pos[1], s.pos[2]), (s.vel[0], s.vel[1], s.vel[2])
    q, w = (s.q[0], s.q[1], s.q[2], s.q[3]), (s.omega[0], s.omega[1], s.omega[2])
    half = 0.5 * dt
    _motors(p, s, command, dt, 0)
    a1, q1, w1, f1 = derivative(p, s, pos, vel, q, w, wind, push, twist, g)
    _motors(p, s, command, dt, 1)
    v2 = add(vel, scale(a1, half))
    a2, q2, w2, _ = derivative(p, s, add(pos, scale(vel, half)), v2, _quat_add(q, q1, half), add(w, scale(w1, half)), wind, push, twist, g)
    v3 = add(vel, scale(a2, half))
    a3, q3, w3, _ = derivative(p, s, add(pos, scale(v2, half)), v3, _quat_add(q, q2, half), add(w, scale(w2, half)), wind, push, twist, g)
    _motors(p, s, command, dt, 2)
    v4 = add(vel, scale(a3, dt))
    a4, q4, w4, _ = derivative(p, s, add(pos, scale(v3, dt)), v4, _quat_add(q, q3, dt), add(w, scale(w3, dt)), wind, push, twist, g)
    k = dt / 6.0
    for i in range(3):
        s.pos[i] += k * (vel[i] + 2.0 * (v2[i] + v3[i]) + v4[i])
        s.vel[i] += k * (a1[i] + 2.0 * (a2[i] + a3[i]) + a4[i])
        s.omega[i] += k * (w1[i] + 2.0 * (w2[i] + w3[i]) + w4[i])
        s.force[i] = f1[i]
        s.omega_dot[i] = w1[i]
    q = quat_unit(_quat_add(_quat_add(_quat_add(_quat_add(q, q1, k), q2, 2.0 * k), q3, 2.0 * k), q4, k))
    s.q[0], s.q[1], s.q[2], s.q[3] = q[0], q[1], q[2], q[3]
    power = 0.0
    for i in range(len(p.spin)):
        s.phase[i] += 0.5 * (s.speed[i] + s.w[i]) * dt
        if s.phase[i] > 2.0 * math.pi:
            s.phase[i] -= 2.0 * math.pi * math.floor(s.phase[i] / (2.0 * math.pi))
        s.speed[i] = s.w[i]
        power += p.k_M[i] * s.w[i] * s.w[i] * s.w[i]
    _battery(p, s, power, dt)


@jit
def _battery(p: Any, s: Any, power: float, dt: float) -> None:
    """Terminal voltage and current for a rotor power [W]; charge used."""
    if p.charge <= 0.0:
        s.voltage = p.voltage
        return
    source = p.voltage * (1.0 - p.sag * min(s.used / p.charge, 1.0))
    wanted = power / p.efficiency
    # I of I (V0 - R I) = P; beyond the largest power the battery gives, that one
    root = source * source - 4.0 * p.resistance * wanted
    s.current = (source - math.sqrt(max(root, 0.0))) / (2.0 * p.resistance)
    s.voltage = source - p.resistance * s.current
    s.used += s.current * dt


@entry
def drift(p: Any, s: Any, command: Any, wind: Vec, g: float, dt: float, n: int) -> None:
    """``n`` steps with constant commands and wind: for comparison with other integrators."""
    prepare(p[0], dt)
    for _ in range(n):
        step_body(p[0], s[0], command, wind, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), g, dt)
