"""What is true of a simulated flight, at the IMU's rate and between its samples. It adds no error."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import entry
from haltere.core.rotation import dcm, tmat_vec
from haltere.flight.field import Field
from haltere.flight.local import geodetic_from_local
from haltere.flight.log import Home

__all__ = ["Truth", "rotate_to_body", "rotate_to_nav"]

FloatArray = NDArray[np.float64]


@dataclass
class Truth:
    """True motion, wind and rotors at times ``t`` (n,), equally spaced from 0.

    Attributes
    ----------
    pos_n, vel_n, wind_n
        Of the point that `moved` names, first the centre of gravity, NED (n, 3) [m, m/s, m/s]; wind there.
    q_nb
        Attitude (n, 4).
    gyro_b, gyro_dot_b, force_b
        Rate, its derivative and specific force at that point, FRD (n, 3).
    speed, phase, command
        Rotor speeds [rad/s], turned angles [rad], commands (n, m).
    voltage, current
        Of the battery; None without one.
    hover
        Mean rotor speed in hover [rad/s], for what scales with it.
    """

    t: FloatArray
    pos_n: FloatArray
    vel_n: FloatArray
    wind_n: FloatArray
    q_nb: FloatArray
    gyro_b: FloatArray
    gyro_dot_b: FloatArray
    force_b: FloatArray
    speed: FloatArray
    phase: FloatArray
    command: FloatArray
    voltage: FloatArray | None
    current: FloatArray | None
    hover: float
    home: Home
    field: Field

    @property
    def rate(self) -> float:
        """Samples a second [Hz]."""
        return float((len(self.t) - 1) / (self.t[-1] - self.t[0]))

    def at(self, values: FloatArray, t: FloatArray) -> FloatArray:
        """Values (n,) or (n, k) at times between the samples, linear; held at the ends."""
        x = np.clip((t - self.t[0]) * self.rate, 0.0, len(self.t) - 1.0)
        i = np.minimum(x.astype(np.int64), len(self.t) - 2)
        f = x - i
        if not f.any():
            return np.ascontiguousarray(values[i])
        if values.ndim == 2:
            f = f[:, None]
        return np.asarray(values[i] + f * (values[i + 1] - values[i]), dtype=np.float64)

    def attitude(self, t: FloatArray) -> FloatArray:
        """Unit quaternions (k, 4) at times between the samples."""
        q = self.at(self.q_nb, t)  # the record is continuous in sign
        return np.asarray(q / np.sqrt(np.einsum("ij,ij->i", q, q))[:, None], dtype=np.float64)

    @property
    def field_n(self) -> FloatArray:
        """The Earth's field, NED (3,) [uT]."""
        d, i = self.field.declination, self.field.dip
        return np.asarray(self.field.strength * np.array([math.cos(i) * math.cos(d), math.cos(i) * math.sin(d), math.sin(i)]))

    def moved(self, arm: FloatArray) -> Truth:
        """The same motion at a point ``arm`` (3,) [m, FRD] from this one and fixed to the body."""
        if not arm.any():
            return self
        w = self.gyro_b
        swing = np.cross(w, arm)
        return replace(
            self,
            pos_n=self.pos_n + rotate_to_nav(self.q_nb, np.broadcast_to(arm, w.shape)),
            vel_n=self.vel_n + rotate_to_nav(self.q_nb, swing),
            force_b=self.force_b + np.cross(self.gyro_dot_b, arm) + np.cross(w, swing),
        )

    def columns(self) -> dict[str, FloatArray]:
        """The stream ``truth``: attitude, velocity, position, wind, rate, specific force, field in the body, rotor speeds."""
        out: dict[str, FloatArray] = {"t": self.t}
        for stem, axes, values in (("q", "wxyz", self.q_nb), ("vel", "ned", self.vel_n), ("pos", "ned", self.pos_n),
                                   ("wind", "ned", self.wind_n), ("gyro", "xyz", self.gyro_b), ("force", "xyz", self.force_b)):  # fmt: skip
            out |= {f"{stem}_{a}": np.ascontiguousarray(values[:, k]) for k, a in enumerate(axes)}
        home = self.home
        out["lat"], out["lon"], out["alt"] = geodetic_from_local(out["pos_n"], out["pos_e"], out["pos_d"], home.lat, home.lon, home.alt)
        field_b = np.empty((3, len(self.t)))
        _seen(np.asfortranarray(self.q_nb), self.field_n, field_b)
        out |= {f"field_{a}": field_b[k] for k, a in enumerate("xyz")}
        return out | {f"speed_{k}": np.ascontiguousarray(self.speed[:, k]) for k in range(self.speed.shape[1])}


@entry
def _seen(q: Any, v: Any, out: Any) -> None:
    """A constant NED vector (3,) seen from the body at attitudes (n, 4), as (3, n)."""
    for i in range(len(q)):
        b = tmat_vec(dcm((q[i, 0], q[i, 1], q[i, 2], q[i, 3])), (v[0], v[1], v[2]))
        out[0, i], out[1, i], out[2, i] = b


def rotate_to_body(q: FloatArray, v_n: FloatArray) -> FloatArray:
    """NED vectors, (3,) or (n, 3), seen from the body at attitudes q_nb (n, 4)."""
    w, u = q[:, :1], q[:, 1:]
    c = np.cross(u, v_n)
    return np.asarray(v_n - 2.0 * w * c + 2.0 * np.cross(u, c), dtype=np.float64)


def rotate_to_nav(q: FloatArray, v_b: FloatArray) -> FloatArray:
    """Body vectors, (3,) or (n, 3), in NED at attitudes q_nb (n, 4)."""
    w, u = q[:, :1], q[:, 1:]
    c = np.cross(u, v_b)
    return np.asarray(v_b + 2.0 * w * c + 2.0 * np.cross(u, c), dtype=np.float64)
