"""The table ``[lumped]`` of a vehicle file: its constants with their uncertainty, checked, and as the record that kernels read. No fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.errors import HaltereError
from haltere.flight.vehicle import Vehicle
from haltere.vehicle.regressors import AERO, AXES, COLUMNS, NAMES, PRESETS, lumped_layout

__all__ = ["Lumped", "lumped_of"]

FloatArray = NDArray[np.float64]

#: A file that lacks the columns after these has none of their constants.
LEAST_COLUMNS = 5


@dataclass(frozen=True)
class Lumped:
    """A vehicle's forces and moments, linear in constants (theory.md §5.2; columns in `haltere.vehicle.regressors`).

    Attributes
    ----------
    preset
        ``literal``, ``rate`` or ``full``.
    roll, pitch, yaw
        Weights of the rotors (n,): -y, x [m] and spin of a known geometry, else relative to their mean size.
    k
        Constants (6, 7) by axis hx, hy, t, r, p, q and column; 0 where the preset has none.
    covariance
        Of the constants of each axis (6, 7, 7).
    density
        Air density of the constants [kg/m^3].
    residual_sd, residual_ar1, residual_slow
        By axis (6,): what is left in windows of ``window`` [s] (forces, moments), 1 sigma [m/s^2, rad/s^2]; its correlation with the next
        window; the part that lasts over one second, 1 sigma.
    s1
        Sum of the rotor speeds at which the damping of rates is kR2, kP2, kQ2 [rad/s]; 0 where it does not go with that sum.
    lag
        Rotor speeds were valid so long before their stamps [s].
    valid
        Range of what was flown: ``speed`` of a rotor [rad/s], ``airspeed`` [m/s], ``rate`` about each axis [rad/s].
    motor
        Where speeds are from commands: ``full`` [rad/s], ``linear``, ``tau`` [s], ``voltage`` [V], see `haltere.vehicle.motor`.
    """

    preset: str
    roll: FloatArray
    pitch: FloatArray
    yaw: FloatArray
    k: FloatArray
    covariance: FloatArray
    density: float = 1.225
    residual_sd: FloatArray = field(default_factory=lambda: np.zeros(6))
    residual_ar1: FloatArray = field(default_factory=lambda: np.zeros(6))
    residual_slow: FloatArray = field(default_factory=lambda: np.zeros(6))
    window: tuple[float, float] = (0.1, 0.2)
    lag: float = 0.0
    valid: Mapping[str, Any] = field(default_factory=dict)
    motor: Mapping[str, Any] | None = None
    s1: float = 0.0

    @property
    def sd(self) -> FloatArray:
        """1 sigma of the constants (6, 7)."""
        return np.asarray(np.sqrt(np.maximum(np.einsum("aii->ai", self.covariance), 0.0)))

    def record(self) -> NDArray[np.void]:
        """The constants as the record that kernels read, one element."""
        m = as_records(np.zeros(1, lumped_layout(len(self.yaw))))
        m["roll"], m["pitch"], m["yaw"], m["k"], m["aero"] = self.roll, self.pitch, self.yaw, self.k, np.array(AERO, dtype=np.float64)
        m["literal"] = int(self.preset == "literal")
        m["density"], m["lag"], m["s1"] = self.density, self.lag, self.s1
        m["sd"], m["slow"], m["ar1"], m["window"] = self.residual_sd, self.residual_slow, self.residual_ar1, self.window
        return m

    def table(self) -> dict[str, Any]:
        """The table ``[lumped]`` of a vehicle file."""
        used = PRESETS[self.preset]
        return {
            "preset": self.preset, "density": self.density, "s1": self.s1, "lag": self.lag, "window": list(self.window),
            "roll": self.roll.tolist(), "pitch": self.pitch.tolist(), "yaw": self.yaw.tolist(),
            "k": {a: {NAMES[i][j]: float(self.k[i, j]) for j in used[i]} for i, a in enumerate(AXES)},
            "covariance": {a: self.covariance[i][np.ix_(used[i], used[i])].tolist() for i, a in enumerate(AXES)},
            "residual_sd": self.residual_sd.tolist(), "residual_ar1": self.residual_ar1.tolist(),
            "residual_slow": self.residual_slow.tolist(), "valid": dict(self.valid), **({"motor": dict(self.motor)} if self.motor else {}),
        }  # fmt: skip


def lumped_of(vehicle: Vehicle, where: str = "vehicle file") -> Lumped:
    """The lumped model of a vehicle file that has one.

    Raises
    ------
    HaltereError
        There is none, or it is not complete; the message names the key.
    """
    table = vehicle.lumped
    where = f"{where}: [lumped]"
    if not table:
        raise HaltereError("a table [lumped]", "none", where, "haltere identify LOG... --out vehicle.toml makes one")
    preset = table.get("preset", "full")
    if preset not in PRESETS:
        raise HaltereError(f"a preset {', '.join(PRESETS)}", repr(preset), where)
    weights = [_vector(table, name, None, where) for name in ("roll", "pitch", "yaw")]
    if len({len(w) for w in weights}) != 1 or len(weights[0]) < 3:
        raise HaltereError("roll, pitch and yaw of one length, at least 3 rotors", f"{[len(w) for w in weights]}", where)
    used = PRESETS[preset]
    k, covariance = np.zeros((6, COLUMNS)), np.zeros((6, COLUMNS, COLUMNS))
    for i, axis in enumerate(AXES):
        constants = table.get("k", {}).get(axis)
        names = [NAMES[i][j] for j in used[i]]
        must = names[:LEAST_COLUMNS]
        if not isinstance(constants, Mapping) or not set(must) <= set(constants) <= set(names):
            raise HaltereError(f"constants {', '.join(names)}", "others or none", f"{where} k.{axis}")
        names = [n for n in names if n in constants]
        there = [j for j in used[i] if NAMES[i][j] in constants]
        k[i, there] = [float(constants[n]) for n in names]
        block = np.asarray(table.get("covariance", {}).get(axis, np.zeros((len(names), len(names)))), dtype=np.float64)
        if block.shape != (len(names), len(names)) or not np.isfinite(block).all():
            raise HaltereError(
                f"a covariance of {len(names)} by {len(names)} numbers", f"shape {block.shape}", f"{where} covariance.{axis}"
            )
        covariance[i][np.ix_(there, there)] = block
    if not np.isfinite(k).all():
        raise HaltereError("finite constants", "others", where)
    sd, ar1, slow = (_vector(table, n, 6, where) for n in ("residual_sd", "residual_ar1", "residual_slow"))
    window = _vector(table, "window", 2, where)
    motor = table.get("motor")
    if motor is not None and not all(isinstance(motor.get(key), int | float) for key in ("full", "linear", "tau")):
        raise HaltereError("numbers full, linear and tau", repr(motor)[:60], f"{where} motor")
    return Lumped(
        preset, weights[0], weights[1], weights[2], k, covariance, float(table.get("density", 1.225)), sd, ar1, slow,
        (float(window[0]), float(window[1])), float(table.get("lag", 0.0)), dict(table.get("valid", {})),
        motor, float(table.get("s1", 0.0)),
    )  # fmt: skip


def _vector(table: Mapping[str, Any], key: str, n: int | None, where: str) -> FloatArray:
    values = table.get(key)
    good = isinstance(values, list) and (n is None or len(values) == n) and all(isinstance(v, int | float) for v in values)
    if not good:
        raise HaltereError(f"{'numbers' if n is None else f'{n} numbers'} {key}", "nothing" if values is None else repr(values)[:60], where)
    return np.asarray(values, dtype=np.float64)
