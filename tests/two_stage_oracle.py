"""The two-stage filter as published, in plain NumPy: additive quaternions, 13 and 16 states, joint updates. Slow, and on purpose.

It shares no code with the package: (30)-(33) and (39)-(42) as they stand, Jacobians against the quaternion's four elements from their
definition, by complex steps where they are long. The error of a unit quaternion has three dimensions, so that P of the four elements
begins as Ξ P_θ Ξᵀ/4 and keeps rank three but for rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np

R_EARTH = 6378137.0
E2 = 6.69437999014e-3


def dcm(q: np.ndarray) -> np.ndarray:
    """C_nb (34), the polynomial form: of a quaternion that is not of length one it is not a rotation."""
    a, b, c, d = q
    return np.array([
        [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d],
    ])  # fmt: skip


def omega(w: np.ndarray) -> np.ndarray:
    x, y, z = w
    return np.array([[0, -x, -y, -z], [x, 0, z, -y], [y, -z, 0, x], [z, y, -x, 0]])


def xi(q: np.ndarray) -> np.ndarray:
    a, b, c, d = q
    return np.array([[-b, -c, -d], [a, -d, c], [d, a, -b], [-c, b, a]])


def by_complex_steps(f: Any, q: np.ndarray) -> np.ndarray:
    return np.array([f(q + 1e-30j * e).imag / 1e-30 for e in np.eye(4)]).T


class Stage:
    """States q, v, (p), b_g, b_a and their covariance; ``p`` says whether there is a position."""

    def __init__(self, start: Any, config: Any, gravity: float, p: bool) -> None:
        self.q, self.v = np.array(start.q_nb), np.array(start.vel_n)
        self.p, self.has_p = np.array(start.pos_n), p
        self.bg, self.ba, self.g = np.array(start.gyro_bias_b), np.array(start.accel_bias_b), gravity
        self.noise = {k: float(config[f"noise.{k}"]) for k in ("gyro", "accel", "gyro_bias", "accel_bias")}
        self.n = 16 if p else 13
        self.P = np.zeros((self.n, self.n))
        self.P[:4, :4] = 0.25 * xi(self.q) @ start.P[:3, :3] @ xi(self.q).T
        blocks = [3, 6, 9, 12] if p else [3, 9, 12]
        for k, b in enumerate(blocks):
            self.P[4 + 3 * k : 7 + 3 * k, 4 + 3 * k : 7 + 3 * k] = start.P[b : b + 3, b : b + 3]
        self.at = {"v": 4, "p": 7, "bg": 10 if p else 7, "ba": 13 if p else 10}

    def predict(self, w0: np.ndarray, w1: np.ndarray, f0: np.ndarray, f1: np.ndarray, dt: float) -> None:
        """(30) or (39): the mean of two samples as constant over the interval, the quaternion by its closed form, midpoint for v."""
        w, f = 0.5 * (w0 + w1) - self.bg, 0.5 * (f0 + f1) - self.ba
        F = np.zeros((self.n, self.n))
        at = self.at
        angle = np.linalg.norm(w) * dt

        def turned(part: float) -> np.ndarray:
            half = 0.5 * part * angle
            return np.asarray((np.cos(half) * np.eye(4) + np.sin(half) * omega(w / max(np.linalg.norm(w), 1e-12))) @ self.q)

        middle = turned(0.5)
        C = dcm(middle)
        F[:4, :4] = 0.5 * omega(w)
        F[:4, at["bg"] : at["bg"] + 3] = -0.5 * xi(middle)
        F[4:7, :4] = by_complex_steps(lambda q: dcm(q) @ f, middle)
        F[4:7, at["ba"] : at["ba"] + 3] = -C
        if self.has_p:
            F[7:10, 4:7] = np.eye(3)
        phi = np.eye(self.n) + F * dt + 0.5 * F @ F * dt * dt + F @ F @ F * dt**3 / 6.0
        a = C @ f + np.array([0.0, 0.0, self.g])
        self.p = self.p + self.v * dt + 0.5 * a * dt * dt
        self.v = self.v + a * dt
        self.q = turned(1.0)
        Q = np.zeros((self.n, self.n))
        Q[:4, :4] = 0.25 * self.noise["gyro"] ** 2 * dt * xi(self.q) @ xi(self.q).T
        Q[4:7, 4:7] = self.noise["accel"] ** 2 * dt * np.eye(3)
        for name, noise in (("bg", "gyro_bias"), ("ba", "accel_bias")):
            i = at[name]
            Q[i : i + 3, i : i + 3] = self.noise[noise] ** 2 * dt * np.eye(3)
        self.P = phi @ self.P @ phi.T + Q

    def update(self, z: np.ndarray, h: np.ndarray, H: np.ndarray, R: np.ndarray) -> None:
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        dx = K @ (z - h)
        I_KH = np.eye(self.n) - K @ H
        self.P = I_KH @ self.P @ I_KH.T + K @ R @ K.T
        at = self.at
        self.q = self.q + dx[:4]
        self.q /= np.linalg.norm(self.q)
        self.v = self.v + dx[4:7]
        if self.has_p:
            self.p = self.p + dx[7:10]
        self.bg, self.ba = self.bg + dx[at["bg"] : at["bg"] + 3], self.ba + dx[at["ba"] : at["ba"] + 3]

    def block(self, name: str) -> np.ndarray:
        H = np.zeros((3, self.n))
        H[:, self.at[name] : self.at[name] + 3] = np.eye(3)
        return H


def place(lat: float, lon: float, alt: float, home: np.ndarray) -> np.ndarray:
    """North, east, down [m] near home, from the radii of curvature."""
    s2 = np.sin(np.radians(home[0])) ** 2
    n = R_EARTH / np.sqrt(1.0 - E2 * s2)
    m = n * (1.0 - E2) / (1.0 - E2 * s2)
    mid = np.radians(0.5 * (lat + home[0]))
    return np.array([
        np.radians(lat - home[0]) * (m + home[2]), np.radians(lon - home[1]) * (n + home[2]) * np.cos(mid), home[2] - alt,
    ])  # fmt: skip


def igg3(s: float, k1: float, k2: float) -> float:
    return 1.0 if s <= k1 else (np.inf if s >= k2 else s / k1 * ((k2 - k1) / (k2 - s)) ** 2)


def additive_quaternion(flight: Any, config: Any, start: Any) -> dict[str, np.ndarray]:
    """Run both stages over a flight whose measurements fall on IMU samples: t, q, v, p at every tenth of a second, and four 1 sigma."""
    home = np.array([float(config[f"home.{k}"]) for k in ("lat", "lon", "alt")])
    s2 = np.sin(np.radians(home[0])) ** 2
    g = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - 0.00669437999013 * s2) - 3.086e-6 * home[2]
    a, b = Stage(start, config, g, False), Stage(start, config, g, True)
    imu, gnss, mag = flight["imu"], flight["gnss"], flight["magnetometer"]
    gyro, accel = imu.vector("gyro"), imu.vector("accel")
    D, strength, sd = float(config["field.declination"]), float(config["field.strength"]), float(config["noise.magnetometer"])
    level = np.array([np.cos(D), np.sin(D), 0.0])
    out: dict[str, list[Any]] = {"t": [], "q": [], "v": [], "p": [], "sd": []}
    i_gnss = i_mag = 0
    for k in range(1, len(imu.t)):
        for stage in (a, b):
            stage.predict(gyro[k - 1], gyro[k], accel[k - 1], accel[k], imu.t[k] - imu.t[k - 1])
        now = imu.t[k] + 1e-9
        while i_gnss < len(gnss.t) and gnss.t[i_gnss] <= now:
            v = gnss.vector("vel", "ned")[i_gnss]
            R = gnss["s_acc"][i_gnss] ** 2 * np.eye(3)
            for stage in (b, a):
                stage.update(v, stage.v, stage.block("v"), R)
            p = place(gnss["lat"][i_gnss], gnss["lon"][i_gnss], gnss["alt"][i_gnss], home)
            b.update(p, b.p, b.block("p"), np.diag([gnss["h_acc"][i_gnss] ** 2] * 2 + [gnss["v_acc"][i_gnss] ** 2]))
            i_gnss += 1
        while i_mag < len(mag.t) and mag.t[i_mag] <= now:
            m = mag.vector("mag")[i_mag]
            i_mag += 1
            factor = igg3(abs(m @ m / strength**2 - 1.0) / float(config["two_stage.tolerance"]), 2.0, 6.0)
            if not np.isfinite(factor):
                continue
            down = dcm(a.q).T[:, 2]
            east = np.cross(down, m) / np.linalg.norm(np.cross(down, m))
            unit = np.cross(east, down)
            size = np.linalg.norm(np.cross(down, m))
            # R_⊥ (theory.md §4.5); the slack along the field as large as the noise across it
            plane = np.eye(3) - np.outer(unit, unit)
            J_m = plane @ (np.eye(3) - np.outer(down, down)) / size
            J_g = -plane @ ((down @ m) * np.eye(3) + np.outer(down, m)) / size
            G = by_complex_steps(lambda q: dcm(q).T[:, 2], a.q)
            R = sd**2 * J_m @ J_m.T + J_g @ G @ a.P[:4, :4] @ G.T @ J_g.T + (sd / size) ** 2 * np.outer(unit, unit)
            H = np.zeros((3, 16))
            H[:, :4] = by_complex_steps(lambda q: dcm(q).T @ level, b.q)
            b.update(unit, dcm(b.q).T @ level, H, factor * R)
        if k % 10 == 0:
            out["t"].append(imu.t[k])
            out["q"].append(b.q.copy())
            out["v"].append(b.v.copy())
            out["p"].append(b.p.copy())
            out["sd"].append(np.sqrt(np.diag(b.P)[[4, 7, 10, 13]]))
    return {name: np.array(values) for name, values in out.items()}
