"""Velocity through the air and wind from what a flight has: vanes, drag, or wind as given, behind one face. It fuses nothing.

Whatever the provider, what comes out is a stream of air velocities in the body frame with variances (`AirVelocity`), and the wind that
is taken for true as another (`GivenWind`), where it blows to.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import entry
from haltere.aids.air_vector import ENOUGH, from_drag, from_vanes
from haltere.aids.drag import LEAST_THRUST
from haltere.errors import UsageError
from haltere.flight.config import Config
from haltere.flight.log import Stream

__all__ = [
    "AirVelocity",
    "GivenWind",
    "air_from_drag",
    "air_from_vanes",
    "given_wind",
    "station_wind",
    "steady_wind",
    "vanes",
]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class AirVelocity:
    """Velocity through the air: times (n,) [s], u, v, w in the body frame (n, 3) [m/s] with NaN where not known, variances (n, 3).

    Attributes
    ----------
    axes
        Which the variances [m^2/s^2] are along: ``air`` (with the flow, of growing angle of attack, of growing sideslip) or ``body``.
    left_out
        Samples that gave none, by reason.
    warnings
        What should be said.
    """

    t: FloatArray
    v_b: FloatArray
    r: FloatArray
    axes: str
    left_out: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class GivenWind:
    """Wind that is taken for true: times (n,) [s], north, east, down (n, 3) [m/s] where it blows to, variance of a component (n,)."""

    t: FloatArray
    wind_n: FloatArray
    r: FloatArray


@entry
def _vanes(data: Any, sd: float, sd_aoa: float, sd_sideslip: float, v: Any, r: Any) -> None:
    for i in range(len(data)):
        a, b = from_vanes(data[i, 0], data[i, 1], data[i, 2], sd, sd_aoa, sd_sideslip)
        for j in range(3):
            v[i, j], r[i, j] = a[j], b[j]


@entry
def _drag(f: Any, mu: Any, c: float, sd: float, sd_mu: float, v: Any, r: Any) -> None:
    for i in range(len(f)):
        a, b = from_drag((f[i, 0], f[i, 1], f[i, 2]), mu[i], c, sd, sd_mu)
        for j in range(3):
            v[i, j], r[i, j] = a[j], b[j]


def vanes(data: FloatArray, config: Config) -> tuple[FloatArray, FloatArray]:
    """Air velocities and variances in air axes, (n, 3) each, of rows airspeed [m/s], angle of attack, sideslip [rad]."""
    v, r = np.empty((len(data), 3)), np.empty((len(data), 3))
    sd, sd_aoa, sd_sideslip = (config.number(f"noise.{k}") for k in ("airspeed", "aoa", "sideslip"))
    _vanes(np.ascontiguousarray(data), sd, sd_aoa, sd_sideslip, v, r)
    return v, r


def air_from_vanes(stream: Stream, config: Config) -> AirVelocity:
    """Provider (a): a stream ``airdata`` with airspeed, angle of attack and sideslip.

    A sample that lacks one of them, or whose airspeed is below three times its noise, gives nothing: without a vane an airspeed is no
    vector, and a vane in a flow that slow says nothing (theory-amendments.md §11).
    """
    data = np.column_stack([stream.get(c) for c in ("airspeed", "aoa", "sideslip")])
    known = np.isfinite(data)
    whole = np.asarray(known.all(axis=1))
    fast = np.zeros(len(data), bool)
    fast[whole] = data[whole, 0] >= ENOUGH * config.number("noise.airspeed")
    left_out = {"no vane": int(np.count_nonzero(known[:, 0] & ~whole)), "airspeed below three times its noise": int((whole & ~fast).sum())}
    warnings = []
    missing = [word for word, k in (("airspeed", 0), ("aoa", 1), ("sideslip", 2)) if not known[:, k].any()]
    if missing:
        warnings.append(
            f"airdata: expected airspeed, aoa and sideslip, found no {' and no '.join(missing)}; no velocity through the air from it; "
            "wind_attitude.air=drag reads it off specific force instead"
        )
    v, r = vanes(data[fast], config)
    return AirVelocity(stream.t[fast], v, r, "air", {k: n for k, n in left_out.items() if n}, warnings)


def air_from_drag(t: FloatArray, accel_b: FloatArray, config: Config, gravity: float, density: float, span: float = 0.1) -> AirVelocity:
    """Provider (b): what the drag of rotors and body says of the flow along x and y, from specific force in blocks of ``span`` [s].

    The published filter does the same inside, sample by sample (``wind_attitude.air=drag``), with rotor speeds where it hears them; here
    thrust is specific force along z.

    Parameters
    ----------
    t, accel_b
        Times (n,) and specific force (n, 3) [m/s^2].
    config
        Keys ``drag.*``, ``noise.drag``, ``init.accel_bias``.
    gravity
        [m/s^2].
    density
        Of the air, over that of the standard atmosphere at sea level.
    """
    slot = np.floor((t - t[0]) / span + 1e-9).astype(np.int64)
    edges = np.flatnonzero(np.r_[True, np.diff(slot) > 0])
    counts = np.diff(np.r_[edges, len(t)])
    mean = np.add.reduceat(accel_b, edges) / counts[:, None]
    turning = -mean[:, 2] >= LEAST_THRUST * gravity
    f = np.ascontiguousarray(mean[turning])
    mu = config.number("drag.mu") * np.sqrt(-density * f[:, 2] / gravity)
    sd = float(np.linalg.norm([config.number(k) for k in ("noise.drag", "init.accel_bias", "drag.offset_sd")]))
    v, r = np.empty_like(f), np.empty_like(f)
    _drag(f, mu, config.number("drag.c") * density, sd, config.number("drag.mu_sd"), v, r)
    last = (edges + counts - 1)[turning]
    return AirVelocity(t[last], v, r, "body", {} if turning.all() else {"rotors slow": int((~turning).sum())})


def station_wind(speed: Any, direction_from: Any) -> tuple[Any, Any]:
    """North and east [m/s] where a wind blows to, of its speed [m/s] and the direction it comes from, clockwise from north [rad]."""
    return -speed * np.cos(direction_from), -speed * np.sin(direction_from)


def steady_wind(values: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Provider (c), constant: wind of the keys ``told_wind.*`` [m/s], where it blows to, or None where none is given.

    Raises
    ------
    UsageError
        Half of one, or a wind given twice.
    """
    n, e, speed, towards = (float(values[f"told_wind.{k}"]) for k in ("n", "e", "speed", "from"))
    vector, station = [not math.isnan(x) for x in (n, e)], [not math.isnan(x) for x in (speed, towards)]
    if any(vector) != all(vector) or any(station) != all(station) or (any(vector) and any(station)):
        given = ", ".join(f"told_wind.{k}" for k in ("n", "e", "speed", "from") if not math.isnan(float(values[f"told_wind.{k}"])))
        raise UsageError(
            "told_wind.n with told_wind.e, or told_wind.speed with told_wind.from",
            given,
            "configuration",
            "a wind is given whole, and once",
        )
    if any(station):
        n, e = (float(x) for x in station_wind(speed, towards))
    return (n, e, float(values["told_wind.d"])) if any(vector) or any(station) else None


def given_wind(stream: Stream | None, config: Config) -> GivenWind | None:
    """Provider (c), table: the stream ``wind``, held from each row to the next. ``noise.given_wind`` where a row has no accuracy."""
    if stream is None:
        return None
    w = np.column_stack([stream.get(f"wind_{a}") for a in "ned"])
    there = np.asarray(np.isfinite(w[:, :2]).all(axis=1))
    w[:, 2] = np.where(np.isfinite(w[:, 2]), w[:, 2], 0.0)
    sd = stream.get("sd")
    sd = np.where(sd > 0.0, sd, config.number("noise.given_wind"))
    return GivenWind(stream.t[there], w[there], sd[there] ** 2)
