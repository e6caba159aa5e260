"""From checked streams and a configuration to the arrays and the parameter record that kernels read. It estimates nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records, entry
from haltere.aids.record import (
    AIRSPEED,
    ATTITUDE,
    BAROMETER,
    GNSS_POSITION,
    GNSS_VELOCITY,
    MAGNETOMETER,
    POWER,
    ROTORS,
    VANES,
    WIND,
)
from haltere.core.earth import pressure_altitude
from haltere.diagnosis.model_detectors import HEARD
from haltere.diagnosis.pairs import BLOCK, STEPS_TOO
from haltere.errors import UsageError
from haltere.estimators.air import air_from_vanes, given_wind, steady_wind
from haltere.filter.windows import glr_level
from haltere.flight import config as configuration
from haltere.flight.config import KEYS, Config
from haltere.flight.corrections import mounted
from haltere.flight.door import Checked, first_fix
from haltere.flight.field import decimal_year, earth_field
from haltere.flight.log import FlightLog, Stream
from haltere.strapdown.layout import PARAMETERS

__all__ = ["Measurements", "alarm_level", "configure", "horizon", "imu_arrays", "measurements", "parameters", "request", "rotation_vector"]

FloatArray = NDArray[np.float64]

#: How far the fusion horizon runs behind the largest delay [s] (theory-amendments.md §8).
HORIZON_MARGIN = 0.05
#: Fields of the parameter record that follow from keys.
DERIVED = (
    "horizon", "covariance_interval", "imu_mean", "diagnosis_threshold", "diagnosis_pair_threshold", "diagnosis_chain_single",
    "diagnosis_chain_triple",
)  # fmt: skip
#: Faults that are told apart, judgements of them a second, and the factor for innovations that are not white.
FAMILIES, JUDGEMENTS, COLOURED = 14.0, 10.0, 1.0


@dataclass
class Measurements:
    """Measurements of all sensors in the order of their stamps: sensor code, stamp, values (m, 3), variances (m, 3).

    ``rotor_t`` (k,) and ``rotor_speed`` (k, rotors) [rad/s] are those that a vehicle's model hears.
    """

    kind: NDArray[np.int64]
    t: FloatArray
    z: FloatArray
    r: FloatArray
    rotor_t: FloatArray = field(default_factory=lambda: np.empty(0))
    rotor_speed: FloatArray = field(default_factory=lambda: np.empty((0, 0)))


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
    return Config(estimator, preset, values | _decided(checked, values))


def _decided(checked: Checked, values: Mapping[str, Any]) -> dict[str, Any]:
    """What ``auto`` comes to with the streams of a flight."""
    rotors, airdata = checked.streams.get("rotors"), checked.streams.get("airdata")
    fly = rotors is not None and rotor_count(rotors) >= 3
    tube = airdata is not None and bool(np.isfinite(airdata.get("airspeed")).any())
    vanes = airdata is not None and bool(np.isfinite(airdata.get("aoa") + airdata.get("sideslip")).any())
    if values["wind_attitude.filter"] == "quaternion":
        if values["wind_attitude.air"] != "auto":
            return {}
        # airspeed without vanes is taken too, where there is nothing else: it says what it lacks
        return {"wind_attitude.air": "vanes" if tube and vanes else "drag" if fly else "vanes" if tube else "off"}
    found = {"aid.drag": fly, "aid.airdata": tube, "aid.vanes": vanes, "aid.no_sideslip": tube and not (vanes or fly)}
    return {key: "on" if there else "off" for key, there in found.items() if values[key] == "auto"}


def rotor_count(rotors: Stream) -> int:
    """Rotors of a stream that ever turned, by their speeds, or where there are none by their commands."""
    for stem in ("speed_", "command_"):
        columns = [rotors[c] for c in rotors.names if c.startswith(stem)]
        if columns:
            return sum(bool(np.any(np.nan_to_num(v) != 0.0)) for v in columns)
    return 0


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
        if name in DERIVED:
            continue
        head = next((h for h in ("two_stage", "wind_attitude", "fault_tolerant") if name.startswith(f"{h}_")), name.partition("_")[0])
        record[name] = config.number(f"{head}.{name[len(head) + 1 :]}")
    record["imu_mean"] = config.number("imu.kind")
    record["horizon"] = horizon(config)
    record["covariance_interval"] = 0.1
    record["diagnosis_threshold"] = alarm_level(config.number("diagnosis.false_alarms"))
    record["diagnosis_pair_threshold"] = glr_level(config.number("diagnosis.false_alarms"), (3.0 + 3.0 * STEPS_TOO) / BLOCK, 1)
    for name, d in (("single", 1), ("triple", 3)):
        record[f"diagnosis_chain_{name}"] = glr_level(config.number("diagnosis.false_alarms"), sum(HEARD), d)
    return record


def alarm_level(rate: float) -> float:
    """Level of a statistic χ²(1) that is passed ``rate`` times an hour without a fault (theory-amendments.md §5).

    Fourteen families are judged ten times a second, each as the maximum over onsets, which is passed 4.4 times as often as one of them.
    """
    p = rate / (3600.0 * 4.4 * FAMILIES * JUDGEMENTS)
    return NormalDist().inv_cdf(0.5 * p) ** 2 * COLOURED


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


def rotation_vector(q: FloatArray) -> FloatArray:
    """Rotation vectors (n, 3) [rad] of quaternions (n, 4), scalar first, of any length."""
    q = q / np.linalg.norm(q, axis=1)[:, None] * np.where(q[:, :1] < 0.0, -1.0, 1.0)
    size = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(size, q[:, 0])
    return np.asarray(q[:, 1:] * np.where(size > 1e-12, angle / np.maximum(size, 1e-12), 2.0)[:, None])


Part = tuple[int, FloatArray, FloatArray, FloatArray]


def _of_the_air(checked: Checked, config: Config) -> list[Part]:
    """Rotor speeds, air data, and what is told from outside."""
    parts: list[Part] = []

    def add(code: int, t: FloatArray, z: FloatArray, r: FloatArray | None = None) -> None:
        there = np.isfinite(z[:, 0])
        wide = np.full((int(there.sum()), 3), np.nan)
        wide[:, : z.shape[1]] = z[there]
        parts.append((code, t[there], wide, np.full_like(wide, np.nan) if r is None else r[there]))

    rotors, airdata = checked.streams.get("rotors"), checked.streams.get("airdata")
    if rotors is not None and config["aid.drag"] == "on":
        speeds = [rotors[c] for c in rotors.names if c.startswith("speed_")]
        if speeds:
            add(ROTORS, rotors.t, np.sum(np.abs(speeds), axis=0)[:, None])
    if airdata is not None and config["aid.airdata"] == "on":
        add(AIRSPEED, airdata.t, airdata.get("airspeed")[:, None])
        if config["aid.vanes"] == "on":
            vanes = np.column_stack([airdata.get("aoa"), airdata.get("sideslip")])
            add(VANES, airdata.t, np.where(np.isfinite(vanes.sum(axis=1, keepdims=True)), vanes, np.nan))
    wind, attitude = checked.streams.get("wind"), checked.streams.get("attitude")
    if wind is not None and config["aid.wind"] == "on" and "on" in (config["aid.drag"], config["aid.airdata"]):
        add(WIND, wind.t, wind.vector("wind", "ned"), _variances(wind, "sd", "sd", "sd"))
    if attitude is not None and config["aid.attitude"] == "on":
        add(ATTITUDE, attitude.t, rotation_vector(attitude.vector("q", "wxyz")))
    return parts


def _wind_triangle(checked: Checked, config: Config) -> list[Part]:
    """What the published filter of `wind-attitude` hears of the air: air velocity, wind, rotor speeds; what is missing is told."""
    parts: list[Part] = []
    told, left_out = checked.warnings, checked.discarded
    airdata, rotors = checked.streams.get("airdata"), checked.streams.get("rotors")
    if airdata is not None and config["aid.airdata"] == "on" and config["wind_attitude.air"] == "vanes":
        air = air_from_vanes(airdata, config)
        parts.append((VANES, air.t, air.v_b, air.r))
        told += air.warnings
        for reason, n in air.left_out.items():
            left_out.setdefault("airdata", {})[reason] = n
    wind = given_wind(checked.streams.get("wind"), config) if config["aid.wind"] == "on" else None
    if wind is not None:
        parts.append((WIND, wind.t, wind.wind_n, np.repeat(wind.r[:, None], 3, axis=1)))
    if config["wind_attitude.air"] == "drag" and rotors is not None:
        speeds = [rotors[c] for c in rotors.names if c.startswith("speed_")]
        if speeds:
            total = np.asarray(np.sum(np.abs(speeds), axis=0))
            there = np.asarray(np.isfinite(total))
            nan = np.full((int(there.sum()), 3), np.nan)
            parts.append((ROTORS, rotors.t[there], np.column_stack([total[there], nan[:, :2]]), nan))
    if config["wind_attitude.air"] != "off":
        lacks = [] if checked.streams.get("gnss") is not None and config["aid.gnss"] == "on" else ["velocity from GNSS"]
        if wind is None and steady_wind(config.values) is None and config["wind_attitude.rows"] == "jacobian":
            lacks.append("wind (keys told_wind.n and told_wind.e or told_wind.speed and told_wind.from, or a stream wind)")
        if lacks:
            told.append(f"wind triangle: no {' and no '.join(lacks)}; attitude is that of gravity and field alone")
    if config["wind_attitude.angles"] == "arctan":
        told.append("roll and yaw are those of the printed arc tangents (3): wrong by half a turn in half the circle; as-corrected is not")
    return parts


def measurements(flight: FlightLog, checked: Checked, config: Config) -> Measurements:
    """Measurements that the configuration lets in, in the order of their stamps (ties: the order of the sensor codes)."""
    parts: list[Part] = []
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
    parts += (_wind_triangle if config["wind_attitude.filter"] == "quaternion" else _of_the_air)(checked, config)
    if not parts:
        return Measurements(np.empty(0, np.int64), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    kind = np.concatenate([np.full(len(t), k, np.int64) for k, t, _, _ in parts])
    t = np.concatenate([p[1] for p in parts])
    order = np.argsort(t, kind="stable")
    z, r = np.concatenate([p[2] for p in parts]), np.concatenate([p[3] for p in parts])
    return Measurements(kind[order], t[order], np.ascontiguousarray(z[order]), np.ascontiguousarray(r[order]))
