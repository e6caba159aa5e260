"""Inertial units against each other: when they begin to differ, and which of them is the bad one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import haltere
from haltere.errors import HaltereError
from haltere.flight.corrections import on_unit
from haltere.flight.log import FlightLog, Stream
from haltere.metrics.faults import apart
from haltere.metrics.units import agreement, part, stations
from haltere.report import page
from haltere.simulate import Scenario, inject, simulate

WORDS = ("gyro.x:bias=3deg/s", "gyro.z:bias=6deg/s", "accel.x:bias=0.8m/s2", "accel.z:bias=0.8m/s2")
SIZE = {"gyro": np.radians(3.0), "accel": 0.8}


def with_second(flight: FlightLog, seed: int = 7) -> FlightLog:
    """A simulated flight with a second unit: biases, scale, noise and an arm of its own."""
    rng = np.random.default_rng(seed)
    imu = flight["imu"]
    w, f = imu.vector("gyro"), imu.vector("accel")
    turning = np.gradient(w, imu.t, axis=0)
    arm = np.array([0.01, -0.015, 0.005])
    f = f + np.cross(turning, arm) + np.cross(w, np.cross(w, arm))
    w = w * (1.0 + 0.003 * rng.standard_normal(3)) + 0.01 * rng.standard_normal(3) + 0.03 * rng.standard_normal(w.shape)
    f = f * (1.0 + 0.003 * rng.standard_normal(3)) + 0.2 * rng.standard_normal(3) + 0.6 * rng.standard_normal(f.shape)
    second = Stream({"t": imu.t + 0.0007, **{f"gyro_{a}": w[:, i] for i, a in enumerate("xyz")},
                     **{f"accel_{a}": f[:, i] for i, a in enumerate("xyz")}})  # fmt: skip
    return FlightLog({**flight.streams, "imu.1": second}, flight.meta, flight.notes)


def of_units(solution: Any) -> list[dict[str, Any]]:
    """Events of gyro and accelerometer."""
    return [e for e in solution.events if e["sensor"] in ("gyro", "accel")]


@pytest.mark.parametrize("mission", ["hover", "lissajous", "box"])
def test_units_that_work_do_not_differ(mission: str) -> None:
    for seed in (1, 2):
        flight = with_second(simulate(Scenario(mission=mission, duration=90.0, seed=seed, wind={"n": 4.0, "gust": 0.8})), seed)
        assert stations(flight) == ["imu", "imu.1"]
        assert part(flight, "imu", "imu.1") == []


@pytest.mark.parametrize("word", WORDS)
@pytest.mark.parametrize("bad", ["imu", "imu.1"])
def test_the_bad_one_of_two_is_named(word: str, bad: str) -> None:
    """Both units are told apart by GNSS, barometer and compass alone, with the diagnosis of one unit off."""
    flight = with_second(simulate(Scenario(mission="lissajous", duration=70.0, seed=5, wind={"n": 3.0})), 5)
    flight = on_unit(inject(on_unit(flight, bad), [f"{word}@40.3"]), bad)
    (event,) = of_units(haltere.run(flight, set={"diagnosis.inertial": "off"}))
    sensor, axis = word.split(":", maxsplit=1)[0].split(".")
    assert (event["sensor"], event["axis"]) == (sensor, axis)
    assert event["candidates"] == [f"{sensor}.{axis}" if bad == "imu" else f"imu.1.{sensor}.{axis}"]
    assert event["t_onset"] == pytest.approx(40.3, abs=1.0)
    assert 40.3 < event["t_detected"] < 42.5
    assert event["t_isolated"] < 48.0


def test_of_three_the_one_apart_is_named_at_once() -> None:
    flight = with_second(simulate(Scenario(mission="box", duration=60.0, seed=3)), 3)
    third = with_second(flight, 4)["imu.1"]
    flight = FlightLog({**flight.streams, "imu.2": third}, flight.meta)
    for bad in ("imu", "imu.1", "imu.2"):
        faulty = on_unit(inject(on_unit(flight, bad), ["gyro.y:bias=4deg/s@33"]), bad)
        (event,) = of_units(haltere.run(faulty, set={"diagnosis.inertial": "off"}))
        assert event["candidates"] == ["gyro.y" if bad == "imu" else f"{bad}.gyro.y"]
        assert "agree" in event["evidence"] or "alike" in event["evidence"]


def test_what_the_second_unit_saw_is_told_of_a_finding() -> None:
    flight = inject(with_second(simulate(Scenario(mission="lissajous", duration=60.0, seed=2)), 2), ["gyro.x:bias=5deg/s@40"])
    change, sd = agreement(flight, "imu.1", 0, 40.0, 43.0) or (0.0, 0.0)
    assert change == pytest.approx(np.radians(5.0), abs=4.0 * sd + np.radians(0.3))
    assert agreement(flight, "imu.1", 0, 1.0, 2.0) is None
    (event,) = of_units(haltere.run(flight, set={"diagnosis.inertial": "on"}))
    assert "imu.1" in event["evidence"]


def test_another_unit_can_be_used(tmp_path: Path) -> None:
    flight = with_second(simulate(Scenario(mission="hover", duration=30.0, seed=2)))
    second = FlightLog({**{k: v for k, v in flight.streams.items() if k != "imu.1"}, "imu": flight["imu.1"]}, flight.meta)
    a, b = haltere.run(flight, set={"imu.unit": "1"}), haltere.run(second)
    assert all(np.array_equal(a.table[name], b.table[name]) for name in b.table)
    with pytest.raises(HaltereError, match=r"imu\.3"):
        haltere.run(flight, set={"imu.unit": "3"})


def test_the_third_accelerometer_of_log_0041_is_bad(shared_data: Path) -> None:
    """A real one: in the air its z reads up to 2.5 m/s^2 less than the other two and its x up to 6 more, and vibrates twice as much."""
    solution = haltere.run(haltere.read(shared_data / "ardupilot" / "log_0041_mechanical_failure.bin"))
    found = [e for e in of_units(solution) if e["candidates"][0].startswith("imu.")]
    assert [e["candidates"] for e in found] == [["imu.2.accel.z"]] or [e["candidates"] for e in found] == [["imu.2.accel.x"]]


def test_faults_put_into_log_0036_are_named_by_its_two_units(shared_data: Path) -> None:
    flight = haltere.read(shared_data / "ardupilot" / "log_0036_mechanical_failure.bin")
    before = FlightLog({k: s.where(s.t < 120.0) for k, s in flight.streams.items()}, flight.meta)
    assert part(flight, "imu", "imu.1") == []  # nor in its crash: the motion is real
    for bad in ("imu", "imu.1"):
        for word in WORDS:
            faulty = on_unit(inject(on_unit(before, bad), [f"{word}@81.3"]), bad)
            (event,) = of_units(haltere.run(faulty, set={"diagnosis.inertial": "off"}))
            assert event["candidates"] == [f"{'' if bad == 'imu' else 'imu.1.'}{word.split(':')[0]}"]
            assert event["t_isolated"] - 81.3 < 5.0


def test_the_report_shows_suspects_and_the_run_without() -> None:
    flight = inject(simulate(Scenario(mission="lissajous", duration=60.0, seed=8)), ["gyro.x:bias=5deg/s@35"])
    solution = haltere.run(flight, set={"diagnosis.inertial": "on"})
    assert solution.without is not None
    (event,) = [e for e in solution.events if e["sensor"] == "gyro"]
    assert "without the finding" in event["evidence"]
    off = apart(solution, solution.without)
    assert off["tilt"][off["t"] < 35.0].max() < 1e-4
    truth = flight["truth"]
    k = np.searchsorted(truth.t, solution.without.t).clip(0, len(truth) - 1)
    alike = np.abs(np.sum(truth.vector("q", "wxyz")[k] * solution.without.vector("q", "wxyz"), axis=1))
    worst = np.degrees(2.0 * np.arccos(np.clip(alike, 0.0, 1.0))).max()
    assert off["tilt"].max() < worst + 2.0  # what it would have cost is no more than the run without is wrong
    text = page(solution, flight)
    assert "<h2>Faults" in text
    assert haltere.run(flight, set={"diagnosis.inertial": "off"}).without is None
