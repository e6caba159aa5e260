"""From checked streams and a configuration to the arrays and the parameter record that kernels read. It estimates nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records, entry
from haltere.aids.record import AIR_VANES, BAROMETER, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER, POWER, ROTORS, WIND
from haltere.core.earth import pressure_altitude
from haltere.errors import UsageError
from haltere.estimators.air import air_from_vanes, given_wind, rotor_lift, steady_wind
from haltere.flight import config as configuration
from haltere.flight.config import KEYS, Config
from haltere.flight.corrections import mounted
from haltere.flight.door import Checked, first_fix
from haltere.flight.field import decimal_year, earth_field
from haltere.flight.log import FlightLog, Stream
from haltere.strapdown.layout import PARAMETERS

__all__ = ["Measurements", "configure", "horizon", "imu_arrays", "measurements", "parameters", "request"]

FloatArray = NDArray[np.float64]

#: How far the fusion horizon runs behind the largest delay [s] (theory-amendments.md §8).
HORIZON_MARGIN = 0.05


@dataclass
class Measurements:
    """Measurements of all sensors in the order of their stamps: sensor code, stamp, values (m, 3), variances (m, 3)."""

    kind: NDArray[np.int64]
    t: FloatArray
    z: FloatArray
    r: FloatArray


def request(
    flight: FlightLog,
    estimator: str,
    preset: str = "default",
    config: Config | Mapping[str, Any] | str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Config:
    """What is asked of a run: defaults, then the flight's own, then a file or mapping, then single overrides.

    It needs no sample of the flight; `configure` adds what the samples tell.
    """
    meta = flight.meta
    keys: dict[str, Any] = {"imu.kind": meta.imu_kind}
    where = "flight.toml"
    for stream, seconds in meta.delays.items():
        keys[f"delay.{stream}"] = seconds
    keys |= {f"noise.{k}": v for k, v in meta.noise.items()} | {f"field.{k}": v for k, v in meta.field.items()}
    if meta.home is not None:
        keys |= {"home.lat": meta.home.lat, "home.lon": meta.home.lon, "home.alt": meta.home.alt}
    known = set(KEYS) | set(configuration.GROUPS)
    keys = {k: v for k, v in keys.items() if k in known or not k.startswith("delay.")}  # a delay of a stream no estimator reads
    base = configuration.resolve(estimator, preset, keys, where).values
    given: dict[str, Any] = {}
    if isinstance(config, Config):
        given = dict(config.values)
    elif isinstance(config, Mapping):
        given = dict(config)
    elif isinstance(config, (str, Path)):
        _, _, given = configuration.load(config)
    elif config is not None:
        raise UsageError("a configuration file, a Config or a mapping of keys", type(config).__name__, "config")
    if overrides is not None and not isinstance(overrides, Mapping):
        raise UsageError("a mapping of configuration keys", type(overrides).__name__, "set", 'for example set={"gate.gnss": 4}')
    given |= dict(overrides or {})
    return configuration.resolve(estimator, preset, {**base, **_spread(given)}, "configuration")


def configure(
    flight: FlightLog,
    checked: Checked,
    estimator: str,
    preset: str = "default",
    config: Config | Mapping[str, Any] | str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Config:
    """Complete configuration of a run, so that it reproduces the run, online too: `request`, and what the samples tell.

    Home and field that nobody named come from the first 3-D fix and the World Magnetic Model there.
    """
    asked = request(flight, estimator, preset, config, overrides)
    values = dict(asked.values)
    if math.isnan(asked.number("home.lat")):
        fix = first_fix(checked.streams.get("gnss"))
        if fix is not None:
            values |= {"home.lat": fix[0], "home.lon": fix[1], "home.alt": fix[2]}
    elif math.isnan(float(values["home.lon"])) or math.isnan(float(values["home.alt"])):
        raise UsageError("home.lat, home.lon and home.alt together", "only some of them", "configuration")
    if not math.isnan(float(values["home.lat"])):
        year = decimal_year(flight.meta.start_utc)
        model = earth_field(float(values["home.lat"]), float(values["home.lon"]), float(values["home.alt"]), year)
        for key, value in (("declination", model.declination), ("dip", model.dip), ("strength", model.strength)):
            if math.isnan(float(values[f"field.{key}"])):
                values[f"field.{key}"] = value
    if math.isnan(float(values["field.declination"])):
        values["field.declination"] = 0.0
    if values["wind_attitude.filter"] == "quaternion":
        values["wind_attitude.air"] = air_provider(checked, asked)
    return Config(estimator, preset, values)


def _spread(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Keys with those that stand for several written out, so that they override a flight's own."""
    return {name: value for key, value in keys.items() for name in configuration.GROUPS.get(key, (key,))}


def horizon(config: Config) -> float:
    """How far the fusion horizon runs behind the newest sample [s]."""
    return max(config.number(k) for k in KEYS if k.startswith("delay.")) + HORIZON_MARGIN


def parameters(config: Config) -> NDArray[np.void]:
    """Parameter record, one element, of a configuration."""
    record = as_records(np.zeros(1, PARAMETERS))
    for name in PARAMETERS.names or ():
        if name in ("horizon", "covariance_interval", "imu_mean"):
            continue
        head = next((h for h in ("two_stage", "wind_attitude") if name.startswith(f"{h}_")), name.partition("_")[0])
        record[name] = config.number(f"{head}.{name[len(head) + 1 :]}")
    record["imu_mean"] = config.number("imu.kind")
    record["horizon"] = horizon(config)
    record["covariance_interval"] = 0.1
    return record


def imu_arrays(flight: FlightLog, checked: Checked) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (n,), angular rates (n, 3) [rad/s] and specific forces (n, 3) [m/s^2] in the body frame."""
    imu = checked.streams["imu"]
    return imu.t, mounted(flight, "imu", imu.vector("gyro")), mounted(flight, "imu", imu.vector("accel"))


@entry
def _altitudes(pressure: Any, scale: float, out: Any) -> None:
    for i in range(len(pressure)):
        out[i] = scale * pressure_altitude(pressure[i])


def altitude_of(pressure: FloatArray, config: Config) -> FloatArray:
    """Pressure altitude [m], scaled by the ground temperature where it is known (theory-amendments.md §8)."""
    temperature = config.number("baro.temperature")
    out = np.empty(len(pressure))
    _altitudes(np.ascontiguousarray(pressure), 1.0 if math.isnan(temperature) else temperature / 288.15, out)
    return out


def _variances(stream: Stream, *names: str) -> FloatArray:
    """Squares of 1-sigma columns side by side; NaN where not given or not positive."""
    sd = np.column_stack([stream.get(n) for n in names])
    return np.where(sd > 0.0, sd * sd, np.nan)


def measurements(flight: FlightLog, checked: Checked, config: Config) -> Measurements:
    """Measurements that the configuration lets in, in the order of their stamps (ties: the order of the sensor codes)."""
    parts: list[tuple[int, FloatArray, FloatArray, FloatArray]] = []
    gnss = checked.streams.get("gnss")
    if gnss is not None and config["aid.gnss"] == "on":
        v, r_v = gnss.vector("vel", "ned"), _variances(gnss, "s_acc", "s_acc", "s_acc")
        p, r_p = np.column_stack([gnss.get(c) for c in ("lat", "lon", "alt")]), _variances(gnss, "h_acc", "h_acc", "v_acc")
        for code, values, variances in ((GNSS_VELOCITY, v, r_v), (GNSS_POSITION, p, r_p)):
            there = np.isfinite(values[:, :2]).all(axis=1)
            parts.append((code, gnss.t[there], values[there], variances[there]))
    baro = checked.streams.get("barometer")
    if baro is not None and config["aid.barometer"] == "on":
        pressure = baro.get("pressure")
        h = altitude_of(pressure, config) if np.isfinite(pressure).any() else baro.get("altitude").copy()
        there = np.isfinite(h)
        nan = np.full((int(there.sum()), 2), np.nan)
        parts.append((BAROMETER, baro.t[there], np.column_stack([h[there], nan]), np.full((int(there.sum()), 3), np.nan)))
    mag = checked.streams.get("magnetometer")
    if mag is not None and config["aid.magnetometer"] != "off":
        parts.append((MAGNETOMETER, mag.t, mounted(flight, "magnetometer", mag.vector("mag")), np.full((len(mag), 3), np.nan)))
    power = checked.streams.get("power")  # only worth hearing for the compass
    if power is not None and parts and parts[-1][0] == MAGNETOMETER and config["aid.motor_field"] == "on":
        current = power.get("current")
        value = np.column_stack([current, np.full((len(power), 2), np.nan)])
        parts.append((POWER, power.t, value, np.full_like(value, np.nan)))
    if config["wind_attitude.filter"] == "quaternion":
        parts += _wind_triangle(flight, checked, config)
    if not parts:
        return Measurements(np.empty(0, np.int64), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    kind = np.concatenate([np.full(len(t), k, np.int64) for k, t, _, _ in parts])
    t = np.concatenate([p[1] for p in parts])
    order = np.argsort(t, kind="stable")
    z, r = np.concatenate([p[2] for p in parts]), np.concatenate([p[3] for p in parts])
    return Measurements(kind[order], t[order], np.ascontiguousarray(z[order]), np.ascontiguousarray(r[order]))


def _wind_triangle(flight: FlightLog, checked: Checked, config: Config) -> list[tuple[int, FloatArray, FloatArray, FloatArray]]:
    """What the published filter of `wind-attitude` hears beside the others: air velocity, wind, rotor speeds; what is missing is told."""
    parts: list[tuple[int, FloatArray, FloatArray, FloatArray]] = []
    told, left_out = checked.warnings, checked.discarded
    airdata = checked.streams.get("airdata")
    if airdata is not None and config["aid.airdata"] == "on" and config["wind_attitude.air"] == "vanes":
        air = air_from_vanes(airdata, config)
        parts.append((AIR_VANES, air.t, air.v_b, air.r))
        told += air.warnings
        for reason, n in air.left_out.items():
            left_out.setdefault("airdata", {})[reason] = n
    wind = given_wind(checked.streams.get("wind"), config)
    if wind is not None:
        parts.append((WIND, wind.t, wind.wind_n, np.column_stack([wind.r, np.full((len(wind.t), 2), np.nan)])))
    if config["wind_attitude.air"] == "drag":
        lift = rotor_lift(flight, config)
        if lift is not None:
            nan = np.full((len(lift[0]), 3), np.nan)
            parts.append((ROTORS, lift[0], np.column_stack([lift[1], nan[:, :2]]), nan))
    if config["wind_attitude.air"] != "off":
        lacks = [] if checked.streams.get("gnss") is not None and config["aid.gnss"] == "on" else ["velocity from GNSS"]
        if wind is None and steady_wind(config.values) is None:
            lacks.append("wind (keys wind.n and wind.e or wind.speed and wind.from, or a stream wind)")
        if lacks:
            told.append(f"wind triangle: no {' and no '.join(lacks)}; attitude is that of gravity and field alone")
    return parts


def air_provider(checked: Checked, config: Config) -> str:
    """Where the published filter takes the velocity through the air from: ``wind_attitude.air`` with ``auto`` resolved.

    Raises
    ------
    UsageError
        Drag is asked for and its coefficient is not known.
    """
    word = str(config["wind_attitude.air"])
    airdata, drag = checked.streams.get("airdata"), not math.isnan(config.number("drag.mu"))
    if word == "auto":
        whole = airdata is not None and all(np.isfinite(airdata.get(c)).any() for c in ("airspeed", "aoa", "sideslip"))
        word = "vanes" if whole else "drag" if drag else "off"
        if word == "off" and airdata is not None:
            word = "vanes"  # which says what it lacks
    if word == "drag" and not drag:
        raise UsageError("drag.mu, the rotor drag over mass", "none", "wind_attitude.air=drag", "set drag.mu [1/s], 0.2 to 0.6")
    return word
