"""A multirotor that does not do what its motors are told, from commands alone."""

from __future__ import annotations

from pathlib import Path

import pytest

import haltere
from haltere.flight.log import FlightLog
from haltere.metrics.control import unanswered
from haltere.report.words import verdict_of
from haltere.simulate import Scenario, simulate

WIND = {"n": 3.0, "gust": 0.6}


def flown(mission: str, seed: int, *fault: str) -> FlightLog:
    """A simulated flight whose log has commands and no rotor speeds."""
    flight = simulate(Scenario(mission=mission, duration=75.0, seed=seed, wind=WIND, fault=fault))
    rotors = flight["rotors"]
    commands = type(rotors)({c: v for c, v in rotors.columns.items() if not c.startswith("speed_")})
    return FlightLog({**flight.streams, "rotors": commands}, flight.meta)


@pytest.mark.parametrize("mission", ["hover", "lissajous", "box", "tour"])
def test_flights_without_a_fault_are_answered(mission: str) -> None:
    for seed in (51, 52):
        flight = flown(mission, seed)
        assert unanswered(flight, haltere.run(flight, scored=False)) is None


@pytest.mark.parametrize("mission", ["lissajous", "box"])
@pytest.mark.parametrize("rotor", [0, 3])
def test_a_rotor_that_loses_thrust_is_named(mission: str, rotor: int) -> None:
    flight = flown(mission, 61, f"rotor.{rotor}:thrust=0.7@60.3")
    (event,) = [e for e in haltere.run(flight).events if e["sensor"] == "rotors"]
    assert event["candidates"] == [f"rotor.{rotor}"]
    assert event["axis"] == str(rotor)
    assert event["t_onset"] == pytest.approx(60.3, abs=0.5)
    assert event["t_detected"] - 60.3 < 1.0


@pytest.mark.parametrize(
    "word", ["gyro.x:bias=3deg/s", "gyro.z:bias=6deg/s", "accel.x:bias=0.8m/s2", "accel.z:bias=0.8m/s2", "gnss.n:bias=2m/s"]
)
def test_sensors_that_fail_are_no_rotors(word: str) -> None:
    for mission in ("hover", "box"):
        flight = flown(mission, 71, f"{word}@60.3")
        assert unanswered(flight, haltere.run(flight, scored=False)) is None


def test_the_crash_of_log_0041_is_no_sensor(shared_data: Path) -> None:
    """It tumbles within half a second while motor 1 is at full command; all three IMUs see it."""
    flight = haltere.read(shared_data / "ardupilot" / "log_0041_mechanical_failure.bin")
    (event,) = [e for e in haltere.run(flight).events if e["sensor"] == "rotors"]
    assert event["t_onset"] == pytest.approx(77.4, abs=0.5)
    assert "motor 1 at the highest command of the flight; imu.1 and imu.2 measure the same motion" in event["evidence"]


def test_the_crash_of_log_0036_is_no_sensor(shared_data: Path) -> None:
    """It noses down to 40 deg while both front motors are held at their limit, three seconds before it rolls over."""
    flight = haltere.read(shared_data / "ardupilot" / "log_0036_mechanical_failure.bin")
    solution = haltere.run(flight)
    assert "first at t = 144.0 s: rotor.0 or rotor.2" in verdict_of(solution, flight).headline
    (event,) = [e for e in solution.events if e["sensor"] == "rotors"]
    assert event["candidates"] == ["rotor.0", "rotor.2"]
    assert 143.8 < event["t_onset"] < event["t_detected"] < 147.3
    assert "motors 0, 2 at the highest command of the flight; imu.1 measures the same motion" in event["evidence"]


def test_a_flight_without_commands_tells_nothing(shared_data: Path) -> None:
    flight = haltere.read(shared_data / "px4" / "sample.ulg")
    assert unanswered(flight, haltere.run(flight, scored=False)) is None
