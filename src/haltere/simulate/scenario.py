"""A scenario: vehicle, mission, wind, sensors and faults of a simulated flight, checked when it is read. It flies nothing."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from haltere.errors import HaltereError, UsageError, nearest
from haltere.flight.config import Key
from haltere.flight.field import decimal_year
from haltere.flight.log import FlightLog, Home
from haltere.flight.vehicle import Vehicle
from haltere.simulate.missions import MISSIONS, TRACK
from haltere.simulate.parts import sensor
from haltere.simulate.words import parse_fault

__all__ = ["SCENARIOS", "WINDS", "Scenario", "load_scenario", "parse_scenario", "wind_parameters"]

#: Where and when flights take place unless the scenario says otherwise.
HOME, UTC = Home(46.8, 8.2, 600.0), "2026-06-01T10:00:00Z"

#: Parameters of the wind.
WINDS: dict[str, Key] = {
    "n": Key(0.0, "m/s", "Mean wind towards north."),
    "e": Key(0.0, "m/s", "Mean wind towards east."),
    "d": Key(0.0, "m/s", "Mean wind downwards."),
    "gust": Key(0.0, "m/s", "Horizontal turbulence, 1 sigma (Dryden); the vertical is half of it.", low=0.0),
    "length": Key(60.0, "m", "Length of horizontal turbulence.", low=0.1),
    "length_down": Key(12.0, "m", "Length of vertical turbulence.", low=0.1),
    "shear": Key(0.0, "1", "Exponent of the power law by height; 0: none.", low=0.0),
    "shear_height": Key(12.0, "m", "Height at which the mean holds.", low=0.1),
}


@dataclass(frozen=True)
class Scenario:
    """Everything that makes a simulated flight what it is.

    Attributes
    ----------
    name
        Of the flight.
    vehicle
        Name of the library, path of a vehicle file, or a `Vehicle`.
    mission
        One of `haltere.simulate.missions.MISSIONS`, or ``track``.
    track
        For the mission ``track``: a log, or its path, whose positions and yaw are flown, from truth, else onboard, else gnss.
    duration
        Length [s]; a track ends when it ends, if that is earlier.
    seed
        Of everything random.
    wind
        Parameters of `WINDS` that differ from their defaults.
    sensors
        By stream, parameters of `haltere.simulate.parts.SENSORS` that differ, and ``preset``.
    fault
        Fault words (interface.md §5).
    rest
        Time at rest before take-off [s]; 0 begins in the air. A track begins in the air, and hovers so long.
    scale, height, landing
        Of the mission, see `haltere.simulate.missions.reference`; height also is that of a track's lowest point above ground [m].
    home, start_utc
        Where and when.
    temperature
        Air at home [degC]: with the height it gives the density.
    tell_noise
        The flight names the noise of its magnetometer and barometer as configuration, and that errors are not there which a
        filter otherwise allows for. Only for tests of consistency.
    """

    name: str = "simulated"
    vehicle: str | Path | Vehicle = "hummingbird"
    mission: str = "box"
    track: str | Path | FlightLog | None = None
    duration: float = 90.0
    seed: int = 1
    wind: Mapping[str, float] = field(default_factory=dict)
    sensors: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    fault: tuple[str, ...] = ()
    rest: float = 4.0
    scale: float = 1.0
    height: float = 12.0
    landing: bool = True
    home: Home = HOME
    start_utc: str = UTC
    temperature: float = 15.0
    tell_noise: bool = False

    def changed(self, **values: Any) -> Scenario:
        """The same scenario with some fields changed."""
        return replace(self, **values)


#: Scenarios that come with haltere, by name: each mission in light wind, a flight with faults, and two worse days.
SCENARIOS: dict[str, Scenario] = {
    **{name: Scenario(name=name, mission=name, wind={"n": 2.0, "e": 1.0, "gust": 0.4}) for name in MISSIONS},
    "demo": Scenario(
        name="demo", mission="tour", duration=120.0, wind={"n": 5.2, "e": 3.0, "gust": 1.2},
        fault=("magnetometer:disturb=0.3@50-60", "gyro.x:bias=3deg/s@90"),
    ),
    "gusty": Scenario(name="gusty", mission="figure-eight", duration=120.0, wind={"n": 5.2, "e": 3.0, "gust": 1.2}),
    "real-parts": Scenario(
        name="real-parts", vehicle="iris", mission="box", duration=120.0, wind={"n": 3.0, "e": -2.0, "gust": 0.8},
        sensors={
            "imu": {"preset": "icm42688", "rate": 500.0}, "magnetometer": {"preset": "near-power"}, "gnss": {"preset": "consumer"},
            "barometer": {"preset": "exposed"}, "rotors": {"preset": "telemetry"},
        },
    ),
}  # fmt: skip

#: Numbers of a scenario with their units and least values.
_NUMBERS = {"duration": ("s", 0.0), "rest": ("s", 0.0), "scale": ("1", 0.0), "height": ("m", 0.0), "temperature": ("degC", -80.0)}


def load_scenario(source: str | Path) -> Scenario:
    """A built-in scenario by name, or one from a TOML file; vehicle and track files are looked for beside it first.

    Raises
    ------
    UsageError
        Neither a name nor a file, or an unknown key (with the nearest name).
    HaltereError
        The file cannot be read.
    """
    if str(source) in SCENARIOS:
        return SCENARIOS[str(source)]
    path = Path(source)
    if not path.is_file():
        hint = nearest(str(source), SCENARIOS) or f"haltere has {', '.join(SCENARIOS)}"
        raise UsageError("a scenario file or the name of a scenario", repr(str(source)), "scenario", hint)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise HaltereError("a TOML file of a scenario", str(error), str(path)) from None
    for key in ("vehicle", "track"):
        value = document.get(key)
        if isinstance(value, str) and value and (path.parent / value).exists():
            document[key] = str(path.parent / value)
    return parse_scenario({"name": path.stem, **document}, str(path))


def parse_scenario(document: Mapping[str, Any], where: str = "scenario", onto: Scenario | None = None) -> Scenario:
    """A scenario from the keys of its file, over those of another; ``base`` in the file names a built-in one to start from.

    Raises
    ------
    UsageError
        A key, name, number or fault word that is not one, with the nearest name.
    """
    document = dict(document)
    base = document.pop("base", None)
    if base is not None and base not in SCENARIOS:
        raise UsageError(f"a built-in scenario ({', '.join(SCENARIOS)})", repr(base), f"{where}: base", nearest(str(base), SCENARIOS))
    out = SCENARIOS[base] if base is not None else onto or Scenario()
    known = Scenario.__dataclass_fields__
    values: dict[str, Any] = {}
    for key, value in document.items():
        if key not in known:
            raise UsageError(f"keys {', '.join(['base', *known])}", repr(key), where, nearest(key, ["base", *known]))
        values[key] = _value(key, value, out, where)
    out = out.changed(**values)
    if out.mission not in (*MISSIONS, TRACK):
        raise UsageError(f"a mission ({', '.join([*MISSIONS, TRACK])})", repr(out.mission), where, nearest(out.mission, [*MISSIONS, TRACK]))
    wind_parameters(out)
    for stream, changes in out.sensors.items():
        sensor(stream, changes)
    for word in out.fault:
        parse_fault(word)
    return out


def _value(key: str, value: Any, onto: Scenario, where: str) -> Any:
    """Value of one key, checked."""
    if key == "wind":
        return {**onto.wind, **_table(value, key, where)}
    if key == "sensors":
        tables = {k: _table(v, f"sensors.{k}", where) for k, v in _table(value, key, where).items()}
        return {**onto.sensors, **{k: {**onto.sensors.get(k, {}), **v} for k, v in tables.items()}}
    if key == "fault":
        words = [value] if isinstance(value, str) else value
        if not isinstance(words, list | tuple) or not all(isinstance(w, str) for w in words):
            raise UsageError("fault words, a text or a list of texts", repr(value), f"{where}: fault")
        return tuple(words)
    if key == "home":
        table = _table(value, key, where)
        if set(table) != {"lat", "lon", "alt"}:
            raise UsageError("lat, lon and alt", ", ".join(map(str, table)) or "nothing", f"{where}: home")
        lat, lon, alt = (_number(table[k], f"home.{k}", where) for k in ("lat", "lon", "alt"))
        if abs(lat) >= 90.0 or abs(lon) > 360.0 or not -500.0 <= alt <= 9000.0:
            raise UsageError("a place on Earth (deg, deg, m)", f"{lat:g}, {lon:g}, {alt:g}", f"{where}: home")
        return Home(lat, lon, alt)
    if key in _NUMBERS:
        unit, low = _NUMBERS[key]
        return _number(value, f"{key} [{unit}]", where, low)
    if key == "seed":
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise UsageError("a whole number of at least 0 for seed", repr(value), where)
        return value
    if key in ("landing", "tell_noise"):
        if not isinstance(value, bool):
            raise UsageError(f"true or false for {key}", repr(value), where)
        return value
    allowed = (str, Path, Vehicle) if key == "vehicle" else (str, Path, FlightLog) if key == "track" else (str,)
    if not isinstance(value, allowed):
        raise UsageError(f"a text for {key}", repr(value), where)
    if key == "start_utc" and decimal_year(str(value)) is None:
        raise UsageError("an ISO 8601 time such as 2026-06-01T10:00:00Z for start_utc", repr(value), where)
    return value


def _table(value: Any, name: str, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UsageError(f"a table [{name}]", repr(value), where)
    return value


def _number(value: Any, name: str, where: str, low: float = -math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < low:
        raise UsageError(f"a number{f' of at least {low:g}' if low > -math.inf else ''} for {name}", repr(value), where)
    return float(value)


def wind_parameters(scenario: Scenario) -> dict[str, float]:
    """Every parameter of the wind."""
    out = {name: float(key.default) for name, key in WINDS.items()}
    for name, value in scenario.wind.items():
        if name not in WINDS:
            raise UsageError(f"a parameter of the wind ({', '.join(WINDS)})", repr(name), "wind", nearest(name, WINDS))
        out[name] = _number(value, f"{name} [{WINDS[name].unit}]", "wind", WINDS[name].low)
    return out
