"""A scenario flown: what is true, what its sensors saw, and its faults, as a log. It draws no conclusions."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.core.earth import gravity
from haltere.errors import HaltereError, UsageError
from haltere.flight.field import Field, decimal_year, earth_field
from haltere.flight.log import FlightLog, FlightMeta
from haltere.flight.vehicle import Vehicle, load_vehicle
from haltere.simulate.controller import controller_record
from haltere.simulate.faults import disturbances, inject
from haltere.simulate.flight import RECORD, fly, record_width
from haltere.simulate.missions import RATE, TRACK, reference, track_reference
from haltere.simulate.parts import SENSORS, sensor
from haltere.simulate.rotorcraft import drift, new_body, vehicle_record
from haltere.simulate.scenario import Scenario, load_scenario, wind_parameters
from haltere.simulate.sensors import sense
from haltere.simulate.track import track_of
from haltere.simulate.truth import Truth
from haltere.simulate.wind import WIND, gust_now
from haltere.simulate.words import Fault, parse_fault

__all__ = ["simulate", "simulate_truth"]

FloatArray = NDArray[np.float64]

#: The dynamics run at this rate [Hz] or the next multiple of the IMU's above it.
DYNAMICS = 500.0


def simulate(scenario: Scenario | str | Path) -> FlightLog:
    """Simulate a flight.

    Parameters
    ----------
    scenario
        What to fly, see `Scenario`; or the name of a built-in one, or a TOML file.

    Returns
    -------
    FlightLog
        Streams imu, magnetometer, gnss, barometer, rotors, power (airdata where asked for) and ``truth`` at the IMU: attitude, velocity,
        position, wind, rate and specific force, sensor biases, the true field in the body and the true rotor speeds.
        The same seed gives the same flight.

    Raises
    ------
    HaltereError
        The vehicle was lost, or a fault that the flight cannot carry.
    UsageError
        A part of the scenario that is not there.
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario)
    for stream in scenario.sensors:
        sensor(stream, scenario.sensors[stream])
    parameters = {stream: sensor(stream, scenario.sensors.get(stream)) for stream in SENSORS}
    p = parameters["imu"]
    if p["rate"] <= 0.0:
        raise UsageError("a positive rate of the IMU", f"{p['rate']:g}", "sensors.imu")
    vehicle = _vehicle(scenario)
    faults = [parse_fault(word) for word in scenario.fault]
    truth = simulate_truth(scenario.changed(vehicle=vehicle), p["rate"], faults).moved(np.array([p["arm_x"], p["arm_y"], p["arm_z"]]))
    streams, biases = sense(truth, parameters, scenario.seed)
    meta = FlightMeta(
        name=scenario.name,
        source=f"haltere simulate, {vehicle.name}, {scenario.mission}, seed {scenario.seed}",
        start_utc=scenario.start_utc,
        home=scenario.home,
        delays={s: q["delay"] for s, q in parameters.items() if q["delay"] > 0.0 and s in streams},
        noise=_told(parameters) if scenario.tell_noise else {},
        faults=[f.as_table() for f in faults if f.simulated_only],
    )
    flight = FlightLog({**streams, "truth": truth.columns() | biases}, meta, [f"simulated: {meta.source}"])
    return inject(flight, [f for f in faults if not f.simulated_only])


def _told(parameters: dict[str, dict[str, float]]) -> dict[str, float]:
    """Noise of the sensors as a filter's configuration knows it, errors that they do not have included; for tests of consistency."""
    imu, compass = parameters["imu"], parameters["magnetometer"]
    out = {s: parameters[s]["noise"] for s in ("magnetometer", "barometer")}
    out["gyro_scale"] = math.hypot(imu["gyro_scale"], imu["gyro_misalignment"])
    if not any(compass[k] for k in ("walk", "hard_iron", "soft_iron", "current", "throttle")):
        out["field"] = 0.0
    return out


def simulate_truth(scenario: Scenario, imu_rate: float = 250.0, faults: list[Fault] | None = None) -> Truth:
    """Fly a scenario; what is true of its centre of gravity at ``imu_rate`` samples a second.

    Parameters
    ----------
    scenario
        What to fly; its sensors and its own list of faults do not matter here.
    imu_rate
        Rows a second [Hz].
    faults
        Those in the vehicle and in the air are flown, others left alone.

    Raises
    ------
    HaltereError
        The vehicle was lost: the mission or the wind is too much for it.
    UsageError
        A part of the scenario that is not there.
    """
    vehicle = _vehicle(scenario)
    n, home = len(vehicle.rotors), scenario.home
    every = max(1, math.ceil(DYNAMICS / imu_rate - 1e-9))
    hertz = imu_rate * every
    g = float(gravity(home.lat, home.alt))
    density = 101325.0 * (1.0 - 2.25577e-5 * home.alt) ** 5.25588 / (287.05 * (scenario.temperature + 273.15))
    ref, duration = _reference(scenario)
    steps = round(duration * hertz)
    wind = wind_parameters(scenario)
    rng = np.random.default_rng([scenario.seed, 0])
    W = _wind_record(wind, rng)
    noise = rng.standard_normal((steps, 5)) if wind["gust"] > 0.0 else np.zeros((steps, 5))
    P, S, C = vehicle_record(vehicle, density), new_body(n), controller_record(vehicle)
    S["voltage"] = P["voltage"]
    mean = (wind["n"], wind["e"], wind["d"])
    if ref[0, 11] < 0.5:
        # it has stood there for a while: the gear carries it and holds it against the wind
        rough = gust_now(W)
        drift(P, S, np.zeros(n), (mean[0] + rough[0], mean[1] + rough[1], mean[2] + rough[2]), g, 1.0 / hertz, round(hertz))
        S["pos"][0, :2], S["used"] = 0.0, 0.0
    else:
        S["pos"][0], S["vel"][0] = ref[0, :3], ref[0, 3:6]
        S["q"][0] = math.cos(0.5 * ref[0, 9]), 0.0, 0.0, math.sin(0.5 * ref[0, 9])
        S["speed"][0] = vehicle.hover_speeds(g, density)
    out = np.empty((record_width(n), -(-steps // every)))
    rows = int(fly(P, S, C, W, ref, RATE, mean, noise, disturbances(faults or [], n), g, hertz, every, out))
    if rows < out.shape[1]:
        raise HaltereError(
            "a flight to the end", f"the vehicle was lost at t = {rows / imu_rate:.1f} s", f"scenario {scenario.name}",
            "less wind, a gentler mission (scale), smaller faults or a stronger vehicle",
        )  # fmt: skip
    return _truth(out, imu_rate, vehicle, scenario, float(vehicle.hover_speeds(g, density).mean()))


def _vehicle(scenario: Scenario) -> Vehicle:
    vehicle = scenario.vehicle if isinstance(scenario.vehicle, Vehicle) else load_vehicle(scenario.vehicle)
    if not vehicle.rotors:
        raise HaltereError("a vehicle with rotors", "only lumped constants", f"vehicle {vehicle.name}", "the simulator needs [[rotor]]")
    return vehicle


def _reference(scenario: Scenario) -> tuple[FloatArray, float]:
    """Reference of the mission and how long it is flown [s]."""
    if scenario.mission != TRACK:
        ref = reference(scenario.mission, scenario.duration, rest=scenario.rest, scale=scenario.scale, height=scenario.height,
                        landing=scenario.landing)  # fmt: skip
        return ref, scenario.duration
    if scenario.track is None:
        raise UsageError('track = "path of a log"', "none", f"scenario {scenario.name}", "the mission track flies the positions of a log")
    ref = track_reference(*track_of(scenario.track), rest=scenario.rest, height=scenario.height)
    return ref, min(scenario.duration, (len(ref) - 1) / RATE)


def _wind_record(wind: dict[str, float], rng: np.random.Generator) -> NDArray[np.void]:
    """Wind as kernels read it; its turbulence drawn from the stationary distribution, so that gusts are there from the start."""
    W = as_records(np.zeros(1, WIND))
    sd = wind["gust"] * np.array([1.0, 1.0, 0.5])
    W["sd"], W["length"] = sd, (wind["length"], wind["length"], wind["length_down"])
    toward = math.atan2(wind["e"], wind["n"])
    W["cos"], W["sin"] = math.cos(toward), math.sin(toward)
    W["exponent"], W["height"] = wind["shear"], wind["shear_height"] if wind["shear"] > 0.0 else 0.0
    x = rng.standard_normal(5)
    second = np.linalg.cholesky(np.array([[0.5, 0.25], [0.25, 0.25]]))
    W["along"], W["across"], W["down"] = sd[0] * x[0], sd[1] * second @ x[1:3], sd[2] * second @ x[3:5]
    return W


def _truth(out: FloatArray, rate: float, vehicle: Vehicle, scenario: Scenario, hover: float) -> Truth:
    """The record (columns, rows) as truth: its arrays are views, each column in one piece."""
    at = {name: k for k, name in enumerate(RECORD)}

    def vectors(first: str, k: int = 3) -> FloatArray:
        return out[at[first] : at[first] + k].T

    n, end = len(vehicle.rotors), len(RECORD)
    battery = vehicle.battery is not None
    return Truth(
        np.arange(out.shape[1], dtype=np.float64) / rate, vectors("pos_n"), vectors("vel_n"), vectors("wind_n"), vectors("q_w", 4),
        vectors("omega_x"), vectors("omega_dot_x"), vectors("force_x"), out[end : end + n].T, out[end + n : end + 2 * n].T,
        out[end + 2 * n :].T, out[at["voltage"]] if battery else None, out[at["current"]] if battery else None, hover, scenario.home,
        _field(scenario.home.lat, scenario.home.lon, scenario.home.alt, scenario.start_utc),
    )  # fmt: skip


@lru_cache(maxsize=64)
def _field(lat: float, lon: float, alt: float, utc: str) -> Field:
    """Field at home; kept, since reading the model takes longer than flying a second."""
    return earth_field(lat, lon, alt, decimal_year(utc))
