"""The first state of a filter: its record for a configuration and a vehicle, and a state to begin from instead of aligning. No filter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.core.earth import STANDARD_GRAVITY, gravity
from haltere.errors import HaltereError, UsageError
from haltere.estimators import quaternion_step
from haltere.estimators.air import steady_wind
from haltere.estimators.detection_levels import detection_levels
from haltere.estimators.federated_layout import federated
from haltere.estimators.inputs import parameters
from haltere.estimators.lumped import Lumped
from haltere.estimators.registry import kernels_of
from haltere.flight.config import Config
from haltere.flight.exclusion import exclusion_table
from haltere.strapdown.layout import CORE, layout
from haltere.strapdown.quaternion import quaternion_layout

__all__ = ["InitialState", "new_state", "number"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class InitialState:
    """A state to begin from in place of alignment: nominal values at time t and the covariance of their errors.

    Attributes
    ----------
    t
        Time of the first IMU sample [s].
    q_nb, vel_n, pos_n, gyro_bias_b, accel_bias_b
        Nominal state, SI units.
    P
        Covariance (n, n) in the order of `State.P`, or of it without wind and coefficients of the air, which then begin as configured.
        The published filter of `wind-attitude` takes only that of the attitude error, the first three rows and columns.
    baro_bias
        Barometer offset [m].
    """

    t: float
    q_nb: FloatArray
    vel_n: FloatArray
    pos_n: FloatArray
    gyro_bias_b: FloatArray
    accel_bias_b: FloatArray
    P: FloatArray
    baro_bias: float = 0.0


def new_state(config: Config, initial: InitialState | None = None, vehicle: Lumped | None = None) -> NDArray[np.void]:
    """State record, one element, that has seen nothing yet; with the model of a vehicle where one is given."""
    quaternion = config["wind_attitude.filter"] == "quaternion"
    model = None if vehicle is None else vehicle.record()
    beside = federated() if config.estimator == "fault-tolerant" else None
    if beside is not None and vehicle is None:
        raise UsageError(
            "a vehicle file with [lumped]", "none", config.estimator, "haltere identify LOG... --out vehicle.toml makes one; --vehicle"
        )
    kind = quaternion_layout() if quaternion else layout(**_sizes(config), **_of_vehicle(config, vehicle), beside=beside)
    record = as_records(np.zeros(1, kind))
    if model is not None:
        record["model"][0, 0] = model[0]
        if record["pairs"].shape[1]:
            record["pairs"]["told"][0, 0] = [exclusion_table(str(config[f"exclude.{sensor}"])) for sensor in ("gyro", "accel")]
    record["q"][0, 0] = 1.0
    home = (config.number("home.lat"), config.number("home.lon"), config.number("home.alt"))
    record["gravity"] = STANDARD_GRAVITY
    if not math.isnan(home[0]):
        record["origin"][0] = home
        record["has_origin"] = 1
        record["gravity"] = gravity(home[0], home[2])
    declination = config.number("field.declination")
    record["field"][0, 0] = 0.0 if math.isnan(declination) else declination
    dip, strength = config.number("field.dip"), config.number("field.strength")
    if not (math.isnan(dip) or math.isnan(strength)):
        record["field"][0, 1:] = dip, strength
        record["has_field"] = 1
    if quaternion:
        _published(record, config)
    if beside is not None:
        record["ft"]["ground"] = 1e9
        record["ft"]["level"][0, 0], record["ft"]["rho"][0, 0] = detection_levels(config)
        for i, sensor in enumerate(("gyro", "accel")):
            record["ft"]["exclude"][0, 0, i] = exclusion_table(str(config[f"exclude.{sensor}"]))
    if initial is not None:
        if quaternion:
            _begin_quaternion(record, initial)
        else:
            _begin_from(record, config, initial)
    return record


def _of_vehicle(config: Config, vehicle: Lumped | None) -> dict[str, int]:
    """Rotors of a vehicle's model, and the states with which it stands in for axes of the IMU."""
    if vehicle is None:
        for key in ("exclude.gyro", "exclude.accel"):
            if config[key] != "off":
                raise UsageError(f"a vehicle's model to do without {key[8:]} axes", "none", key, "give a vehicle file (--vehicle)")
        return {}
    return {"rotors": len(vehicle.yaw), "twist": 3 if config.estimator == "navigator" else 0}


def _published(record: NDArray[np.void], config: Config) -> None:
    """What the published filter knows from the start: the wind as given."""
    record["x"][0, 0] = 1.0
    record["t_gnss"] = record["air"]["t_rotors"] = -1e9
    wind = steady_wind(config.values)
    if wind is not None:
        record["wind_v"][0], record["wind_r"], record["has_wind"] = wind, config.number("told_wind.sd") ** 2, 1
    elif config["wind_attitude.rows"] == "printed":  # which have no wind in them
        record["has_wind"] = 1


def _begin_quaternion(record: NDArray[np.void], initial: InitialState) -> None:
    """Attitude and the covariance of its error; the other states are not there."""
    P = np.asarray(initial.P, dtype=np.float64)
    if P.ndim != 2 or P.shape[0] != P.shape[1] or len(P) < 3:
        raise HaltereError("an initial covariance of shape (3, 3), of the attitude error", f"{P.shape}", "initial state")
    V = P[:3, :3]
    if not np.allclose(V, V.T, rtol=1e-9, atol=1e-15) or np.linalg.eigvalsh(V).min() <= 0.0:
        raise HaltereError("a symmetric positive covariance", "one that is not", "initial state")
    q = np.asarray(initial.q_nb, dtype=np.float64)
    if q.shape != (4,) or not np.isfinite(q).all() or not q.any():
        raise HaltereError("4 finite numbers for q_nb", f"{q.tolist()}", "initial state")
    record["t"] = record["t_block"] = record["t_aligned"] = number(initial.t, "t", "initial state")
    record["q"][0] = record["x"][0] = q / np.linalg.norm(q)
    a, b, c = ((float(x), float(y), float(z)) for x, y, z in V)
    quaternion_step.begin_at(record, (a, b, c))


def _sizes(config: Config) -> dict[str, int]:
    """Number of optional states of each kind, as `haltere.strapdown.layout.layout` takes them."""
    drag, airdata = config["aid.drag"] == "on", config["aid.airdata"] == "on"
    vanes = airdata and config["aid.vanes"] == "on"
    return {
        "baro": 1 if config["baro.offset"] == "on" else 0,
        "mag": 3 if config["magnetometer.refine"] == "on" else 0,
        "stages": 1 if config.estimator == "two-stage" else 0,
        "wind": (3 if vanes and not drag else 2) if drag or airdata else 0,
        "drag": 4 if drag else 0,
        "vane": (3 if vanes else 1) if airdata else 0,
        "banks": 1 if config["diagnosis.inertial"] == "on" else 0,
    }


def _begin_from(record: NDArray[np.void], config: Config, initial: InitialState) -> None:
    n = record["P"].shape[1]
    P = np.asarray(initial.P, dtype=np.float64)
    sizes = _sizes(config)
    told = CORE + sizes["baro"] + sizes["mag"]  # without the states of the air: these begin as configured
    if P.shape not in ((n, n), (told, told)):
        raise HaltereError(f"an initial covariance of shape ({n}, {n})", f"{P.shape}", "initial state", "see State.P for the order")
    if not np.allclose(P, P.T, rtol=1e-9, atol=1e-15) or np.linalg.eigvalsh(P).min() <= 0.0:
        raise HaltereError("a symmetric positive covariance", "one that is not", "initial state")
    record["t"] = number(initial.t, "t", "initial state")
    for name, field, size in (("q", "q_nb", 4), ("v", "vel_n", 3), ("p", "pos_n", 3), ("bg", "gyro_bias_b", 3), ("ba", "accel_bias_b", 3)):
        values = np.asarray(getattr(initial, field), dtype=np.float64)
        if values.shape != (size,) or not np.isfinite(values).all() or (name == "q" and not values.any()):
            raise HaltereError(f"{size} finite numbers for {field}", f"{values.tolist()}", "initial state")
        record[name][0] = values
    record["baro_start"] = initial.baro_bias
    if n > CORE:
        record["baro"][0, 0] = initial.baro_bias
    record["q"][0] /= np.linalg.norm(record["q"][0])
    kernels_of(record).begin_air(record, parameters(config))
    record["P"][0, : len(P), : len(P)] = P
    for field in ("q", "v", "p", "bg", "ba"):
        record["a"][field][0] = record[field][0]
    record["a"]["P"][0] = P[:CORE, :CORE]
    record["phase"] = 2
    record["n_aligned"] = 1
    record["t_aligned"] = initial.t
    record["aid"]["started"][0] = 1
    record["aid"]["t_passed"][0] = initial.t
    record["aid"]["t_due"][0] = initial.t
    record["rest"]["t_block"] = initial.t
    record["t_wake"] = initial.t


def number(value: Any, name: str, where: str) -> float:
    """A value as a number, or a `UsageError` that names it."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise UsageError(f"a number for {name}", repr(value), where) from None
