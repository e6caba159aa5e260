"""Rotor speeds from commands where no telemetry tells them: a curve, the voltage and a lag of first order, fitted. It fits no vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from haltere.errors import HaltereError
from haltere.identify.prepare import Motion
from haltere.vehicle.motor import commanded, driven

__all__ = ["FULL", "Motor", "commands_of", "fit_motor", "modelled"]

FloatArray = NDArray[np.float64]

#: What a full command at the mean voltage is counted as [rad/s]: commands alone do not tell a speed.
FULL = 1000.0
#: Bounds and start of the part of thrust that goes with the command itself, and of the time constant [s].
BOUNDS, START = ((0.0, 1.0), (0.003, 0.3)), (0.4, 0.04)


@dataclass(frozen=True)
class Motor:
    """A motor model: thrust goes with ``a u + (1 - a) u²`` of the command u and the square of the voltage, behind a first-order lag.

    Attributes
    ----------
    a
        Part of the thrust that is linear in the command.
    tau
        Time constant of the speed [s].
    voltage
        Mean voltage that the model is relative to [V]; NaN where the log has none.
    explained
        Part of the variance of the force along z, and of quick roll and pitch acceleration, that it explains.
    """

    a: float
    tau: float
    voltage: float
    explained: tuple[float, float]


def commands_of(m: Motion) -> tuple[FloatArray, FloatArray, float]:
    """Times (n,) [s] and commands (n, r) that vary, and their rate [Hz].

    Raises
    ------
    HaltereError
        The log has neither rotor speeds nor commands of at least three motors.
    """
    t, values = commanded(m.flight.streams)
    if not len(t):
        raise HaltereError(
            "rotor speeds, or commands of at least 3 motors",
            "neither",
            m.name,
            "log ESC telemetry; a motor model from commands is less sure",
        )
    return t, values, 1.0 / float(np.median(np.diff(t)))


def _voltage(m: Motion) -> tuple[FloatArray, float]:
    """Voltage over its mean in the air at the IMU's samples (n,), and that mean [V]."""
    power = m.flight.get("power")
    volts = None if power is None else power.get("voltage")
    if power is None or volts is None or np.isfinite(volts).sum() < 10:
        return np.ones(len(m.t)), float("nan")
    good = np.isfinite(volts) & (volts > 0.0)
    v = np.interp(m.t, power.t[good], volts[good])
    mean = float(np.mean(v[m.air]))
    return np.asarray(v / mean), mean


def modelled(m: Motion, a: float, tau: float) -> FloatArray:
    """Speeds at the IMU's samples (n, r) [rad/s, a full command counted as `FULL`]."""
    t, u, _ = commands_of(m)
    ratio, _ = _voltage(m)
    return driven(m.t, t, u, ratio, a, tau, FULL)


def fit_motor(motions: list[Motion]) -> Motor:
    """The motor model with which commands explain thrust and quick turns of the flights best."""
    from haltere.identify.rotors import quick_turns

    def explained(x: FloatArray) -> tuple[float, float]:
        thrust, turns = [], []
        for m in motions:
            speeds = modelled(m, float(np.clip(x[0], *BOUNDS[0])), float(np.clip(x[1], *BOUNDS[1])))
            s2 = np.sum(speeds**2, axis=1)[m.air]
            f = -m.force_b[m.air, 2]
            thrust.append(1.0 - float(np.mean((f - s2 * (s2 @ f) / (s2 @ s2)) ** 2)) / max(float(np.var(f)), 1e-9))
            turns.append(quick_turns(m, m.t, speeds, np.zeros(1))[1][0])
        return float(np.mean(thrust)), float(np.mean(turns))

    found = minimize(lambda x: -sum(explained(x)), START, method="Nelder-Mead", options={"maxfev": 60, "xatol": 2e-3, "fatol": 1e-4})
    a, tau = float(np.clip(found.x[0], *BOUNDS[0])), float(np.clip(found.x[1], *BOUNDS[1]))
    return Motor(a, tau, float(np.mean([_voltage(m)[1] for m in motions])), explained(np.array([a, tau])))
