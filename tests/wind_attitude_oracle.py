"""The filter of source W in plain NumPy: dense matrices, Jacobians by complex steps, one measurement after the other. Slow, on purpose.

It shares no code with the package. Measurements are fused at the first IMU sample at or after the time that they were valid at.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[Any]


def omega(w: Array) -> Array:
    """Ω of (6), the third row put right."""
    x, y, z = w
    return np.array([[0, -x, -y, -z], [x, 0, z, -y], [y, -z, 0, x], [z, y, -x, 0]])


def phi_7(a: Array) -> Array:
    """Φ exactly as (7) is printed, element by element."""
    d2 = a @ a
    c, s = 1 - d2 / 8 + d2**2 / 384, 0.5 - d2 / 48
    x, y, z = a
    return np.array(
        [
            [c, -s * x, -s * y, -s * z],
            [s * x, c, s * z, -s * y],
            [s * y, -s * z, c, s * x],
            [s * z, s * y, -s * x, c],
        ]
    )


def picard(order: int, a: Array) -> Array:
    """Picard's approximation by its definition: the exponential's series to that order."""
    M, term, out = omega(a) / 2, np.eye(4), np.eye(4)
    for k in range(1, order + 1):
        term = term @ M / k
        out = out + term
    return out


def runge_kutta(w0: Array, w1: Array, dt: float) -> Array:
    """The matrix of the classical step for a rate on a line."""

    def rate(t: float, X: Array) -> Array:
        return omega(w0 + t / dt * (w1 - w0)) / 2 @ X

    k1 = rate(0.0, np.eye(4))
    k2 = rate(dt / 2, np.eye(4) + dt / 2 * k1)
    k3 = rate(dt / 2, np.eye(4) + dt / 2 * k2)
    k4 = rate(dt, np.eye(4) + dt * k3)
    return np.eye(4) + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def xi(q: Array) -> Array:
    """Ξ: q̇ = ½ Ξ ω."""
    w, x, y, z = q
    return np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])


def matrix(q: Array) -> Array:
    """C_b^n of any q, homogeneous of degree two."""
    w, x, y, z = q
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def rows(q: Array, a: Array) -> Array:
    """∂(C(q)ᵀ a)/∂q by complex steps."""
    return np.array([(matrix(q + 1e-30j * e).T @ a).imag / 1e-30 for e in np.eye(4)]).T


def rows_20(q: Array, h: Array) -> Array:
    """The nine rows of (20) exactly as printed."""
    q0, q1, q2, q3 = q
    hx, hy, hz = h
    a, b = q0 * hx + q3 * hy - q2 * hz, q1 * hx + q2 * hy + q3 * hz
    c, d = -q2 * hx + q1 * hy - q0 * hz, -q3 * hx + q0 * hy + q1 * hz
    return 2 * np.array(
        [
            [-q2, q3, -q0, q1],
            [q1, q0, q3, q2],
            [q0, -q1, -q2, q3],
            [a, b, c, d],
            [d, q2 * hx - q1 * hy + q0 * hz, b, -q0 * hx - q3 * hy + q2 * hz],
            [q2 * hx - q1 * hy + q0 * hz, q3 * hx - q0 * hy - q1 * hz, a, b],
            [q3, -q2, -q1, q0],
            [-q0, q1, -q2, q3],
            [-q1, -q0, -q2, -q3],
        ]
    )


def euler_3(q: Array) -> Array:
    """(3) as printed: roll, pitch, yaw."""
    q0, q1, q2, q3 = q
    return np.array(
        [
            np.arctan(2 * (q2 * q3 + q0 * q1) / (-(q1**2) + q0**2 - q2**2 + q3**2)),
            -np.arcsin(np.clip(2 * (q1 * q3 - q0 * q2), -1.0, 1.0)),
            np.arctan(2 * (q1 * q2 + q0 * q3) / (q1**2 + q0**2 - q2**2 - q3**2)),
        ]
    )


def from_euler(angles: Array) -> Array:
    """Unit quaternion of roll, pitch, yaw, by three products."""

    def half(angle: float, axis: int) -> Array:
        q = np.zeros(4)
        q[0], q[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
        return q

    def product(a: Array, b: Array) -> Array:
        return np.r_[a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])]

    return product(product(half(angles[2], 2), half(angles[1], 1)), half(angles[0], 0))


class Filter:
    """(4)-(25) with the corrections that ``keys`` names, over whole arrays."""

    def __init__(self, keys: dict[str, Any], q: Array, V: Array, gravity: float) -> None:
        self.keys, self.g = keys, gravity
        self.x = q.copy()
        self.P = xi(q) @ V @ xi(q).T / 4
        d, i = keys["field.declination"], keys["field.dip"]
        self.h = np.array([np.cos(i) * np.cos(d), np.cos(i) * np.sin(d), np.sin(i)])
        self.velocity = (-1e9, np.zeros(3), np.zeros(3), np.zeros(3))
        self.wind, self.wind_r = np.array([keys["told_wind.n"], keys["told_wind.e"], keys["told_wind.d"]]), keys["told_wind.sd"] ** 2
        self.records: list[tuple[float, str, Array, Array]] = []

    def normalise(self) -> None:
        if self.keys["wind_attitude.normalise"] == "off":
            return
        n = np.linalg.norm(self.x)
        self.x = self.x / n
        if self.keys["wind_attitude.normalise"] == "on":
            J = (np.eye(4) - np.outer(self.x, self.x)) / n
            self.P = J @ self.P @ J.T

    def predict(self, w0: Array, w1: Array, dt: float) -> None:
        word, a = self.keys["wind_attitude.integrator"], 0.5 * dt * (w0 + w1)
        if word == "exp":
            Phi = expm(omega(a) / 2)
        elif word == "rk4":
            Phi = runge_kutta(w0, w1, dt)
        else:
            Phi = phi_7(a) if word == "picard4" else picard(int(word[-1]), a)
        Gamma = xi(self.x) * dt / 2
        self.P = Phi @ self.P @ Phi.T + Gamma @ (self.keys["noise.gyro"] ** 2 / dt * np.eye(3)) @ Gamma.T
        self.x = Phi @ self.x
        self.normalise()

    def fuse(self, t: float, name: str, z: Array, h: Array, H: Array, R: Array) -> None:
        there = np.isfinite(z)
        z, h, H, R = z[there], h[there], H[there], R[np.ix_(there, there)]
        e = z - (H @ self.x if self.keys["wind_attitude.residual"] == "printed" else h)
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        self.records.append((t, name, e, np.sqrt(np.diag(S))))
        self.P = (np.eye(4) - K @ H) @ self.P
        self.P = 0.5 * (self.P + self.P.T)
        self.x = self.x + K @ e
        self.normalise()

    def hear_velocity(self, t: float, v: Array, r: Array) -> None:
        before, last, _, a = self.velocity
        dt = t - before
        if dt < 1.0:
            a = a + min(1.0, dt / 0.5) * ((v - last) / dt - a)
        self.velocity = (t, v, r, a)

    def accelerometer(self, t: float, f: Array, dt: float) -> None:
        size, age = np.linalg.norm(f), t - self.velocity[0]
        moves = np.linalg.norm(self.velocity[3]) if age < 1.0 else 0.0
        if abs(size - self.g) >= self.keys["wind_attitude.force"] or moves >= self.keys["wind_attitude.acceleration"]:
            return
        e3 = np.array([0.0, 0.0, 1.0])
        R = self.keys["noise.accel"] ** 2 / dt / self.g**2 * np.eye(3)
        self.fuse(t, "accelerometer", -f / size, matrix(self.x).T @ e3, rows(self.x, e3), R)

    def magnetometer(self, t: float, m: Array) -> None:
        R = (self.keys["noise.magnetometer"] / self.keys["field.strength"]) ** 2 * np.eye(3)
        self.fuse(t, "magnetometer", m / np.linalg.norm(m), matrix(self.x).T @ self.h, rows(self.x, self.h), R)

    def airdata(self, t: float, now: float, V: float, aoa: float, slip: float) -> None:
        age = now - self.velocity[0]
        if age > 0.5:
            return
        unit = self.x / np.linalg.norm(self.x)

        def vector(p: Array) -> Array:
            return p[0] * np.array([np.cos(p[1]) * np.cos(p[2]), np.sin(p[2]), np.sin(p[1]) * np.cos(p[2])])

        p = np.array([V, aoa, slip])
        J = np.array([vector(p + 1e-30j * e).imag / 1e-30 for e in np.eye(3)]).T
        sd = self.keys["noise.airspeed"]
        polar = np.diag([sd**2, self.keys["noise.aoa"] ** 2 + (sd / (V * np.cos(slip))) ** 2, self.keys["noise.sideslip"] ** 2])
        polar[2, 2] = self.keys["noise.sideslip"] ** 2 + (sd / V) ** 2
        C = matrix(unit)
        R = J @ polar @ J.T + C.T @ (np.diag(self.velocity[2]) + (self.wind_r + (3.0 * age) ** 2) * np.eye(3)) @ C
        a = self.velocity[1] - self.wind
        H = rows_20(self.x, self.h)[6:] if self.keys["wind_attitude.rows"] == "printed" else rows(self.x, a)
        self.fuse(t, "airdata", vector(p), matrix(self.x).T @ a, H, R)

    def attitude(self) -> Array:
        return from_euler(euler_3(self.x)) if self.keys["wind_attitude.angles"] == "arctan" else self.x / np.linalg.norm(self.x)


def run(
    keys: dict[str, Any], flight: Any, q: Array, V: Array, gravity: float, velocity_variance: Callable[[Array], Array]
) -> tuple[Array, Filter]:
    """Attitudes after every IMU sample, and the filter at the end.

    ``flight`` maps stream names to their columns; ``velocity_variance`` gives variances of a fix from its accuracies.
    """
    filt = Filter(keys, q, V, gravity)
    imu = flight["imu"]
    t, w, f = imu.t, imu.vector("gyro"), imu.vector("accel")
    queues: list[tuple[str, Array, Array]] = []
    if "gnss" in flight:
        g = flight["gnss"]
        queues.append(("velocity", g.t - keys["delay.gnss_velocity"], np.column_stack([g.vector("vel", "ned"), g["s_acc"]])))
    if "wind" in flight:
        s = flight["wind"]
        queues.append(("wind", s.t, np.column_stack([s.vector("wind", "ned"), s["sd"]])))
    if "magnetometer" in flight:
        s = flight["magnetometer"]
        queues.append(("magnetometer", s.t - keys["delay.magnetometer"], s.vector("mag")))
    if "airdata" in flight:
        s = flight["airdata"]
        data = np.column_stack([s["airspeed"], s["aoa"], s["sideslip"]])
        good = np.isfinite(data).all(axis=1)
        good[good] = data[good, 0] >= 3.0 * keys["noise.airspeed"]
        queues.append(("airdata", (s.t - keys["delay.airdata"])[good], data[good]))
    at = dict.fromkeys((name for name, _, _ in queues), 0)
    out = np.empty((len(t), 4))
    out[0] = filt.attitude()
    for k in range(1, len(t)):
        filt.predict(w[k - 1], w[k], t[k] - t[k - 1])
        for name, times, values in queues:
            if name == "magnetometer":
                filt.accelerometer(t[k], f[k], t[k] - t[k - 1])
            while at[name] < len(times) and times[at[name]] <= t[k]:
                s, x = times[at[name]], values[at[name]]
                at[name] += 1
                if s < t[0] - 1e-9:
                    continue
                if name == "velocity":
                    filt.hear_velocity(s, x[:3], velocity_variance(x[3:]))
                elif name == "wind":
                    filt.wind, filt.wind_r = x[:3], float(x[3]) ** 2
                elif name == "magnetometer":
                    filt.magnetometer(s, x)
                else:
                    filt.airdata(s, t[k], *x)
        out[k] = filt.attitude()
    return out, filt
