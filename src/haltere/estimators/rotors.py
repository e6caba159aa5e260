"""A vehicle's model for an estimator, and the rotor speeds of a flight for it: telemetry, or commands through its motor model. No fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError, UsageError
from haltere.estimators.lumped import Lumped, lumped_of
from haltere.estimators.registry import SPECIFICATIONS
from haltere.flight.vehicle import Vehicle, load_vehicle
from haltere.vehicle.motor import commanded, driven

if TYPE_CHECKING:
    from haltere.flight.log import Stream

__all__ = ["RotorSpeeds", "model_of", "rotor_speeds"]

FloatArray = NDArray[np.float64]


@dataclass
class RotorSpeeds:
    """Speeds of all rotors in the order of the vehicle's: stamps (m,), values (m, n) [rad/s], and whether they are from commands."""

    t: FloatArray
    speed: FloatArray
    modelled: bool = False


def model_of(vehicle: str | Path | Vehicle | Lumped, estimator: str) -> Lumped:
    """The force and moment model of a vehicle file, for an estimator that uses one.

    Raises
    ------
    UsageError
        The estimator uses none, or the file is not there.
    HaltereError
        The file has no model.
    """
    if not getattr(SPECIFICATIONS.get(estimator), "VEHICLE", False):
        raise UsageError("no vehicle file", str(vehicle)[:60], "run", f"{estimator} does not use a vehicle model")
    if isinstance(vehicle, Lumped):
        return vehicle
    if isinstance(vehicle, Vehicle):
        return lumped_of(vehicle)
    return lumped_of(load_vehicle(vehicle), str(vehicle))


def rotor_speeds(streams: Mapping[str, Stream], of: Lumped, t: FloatArray) -> RotorSpeeds:
    """Rotor speeds as the constants of a vehicle's model mean them.

    Parameters
    ----------
    streams
        Checked streams: ``rotors``, or ``actuators`` and ``power`` where the model is one of commands.
    of
        The vehicle's model.
    t
        Times of the IMU samples [s], at which speeds from commands are given.

    Raises
    ------
    HaltereError
        The flight does not have what the model was identified from, or another number of rotors.
    """
    n = len(of.yaw)
    if of.motor is not None:
        t_u, u = commanded(streams)
        if u.shape[1] != n:
            raise HaltereError(f"commands of {n} motors, as the vehicle's model has", f"{u.shape[1]}", "actuators")
        power = streams.get("power")
        ratio = np.ones(len(t))
        rated = of.motor.get("voltage")
        if rated is not None and power is not None:
            volts = power.get("voltage")
            good = np.isfinite(volts) & (volts > 0.0)
            if good.sum() > 10:
                ratio = np.interp(t, power.t[good], volts[good]) / float(rated)
        return RotorSpeeds(t, driven(t, t_u, u, ratio, float(of.motor["linear"]), float(of.motor["tau"]), float(of.motor["full"])), True)
    stream = streams.get("rotors")
    names = [] if stream is None else sorted((c for c in stream.names if c.startswith("speed_")), key=lambda c: int(c[6:]))
    if stream is None or not names:
        raise HaltereError(
            "rotor speeds (a stream rotors with speed_0, speed_1, ...)", "none", "vehicle model",
            "log ESC telemetry, or identify the vehicle from flights without it: then commands serve",
        )  # fmt: skip
    if len(names) != n:
        raise HaltereError(f"speeds of {n} rotors, as the vehicle's model has", f"{len(names)} ({', '.join(names)})", "rotors")
    values = np.abs(np.column_stack([stream[c] for c in names]))
    good = np.isfinite(values).all(axis=1)
    return RotorSpeeds(stream.t[good], np.ascontiguousarray(values[good]))
