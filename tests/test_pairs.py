"""A vehicle's model against its IMU: faults of model, rotor and tachometer are named, wind and a flight without a fault are not."""

from __future__ import annotations

from typing import Any

import pytest

import haltere
from haltere.diagnosis.model_faults import CANDIDATES
from haltere.flight.vehicle import Vehicle
from haltere.metrics.detection import alarms
from haltere.simulate import Scenario, simulate

SENSORS = {"rotors": {"rate": 250.0}}
ON = {"diagnosis.inertial": "on"}
AT = 22.0


@pytest.fixture(scope="module")
def identified() -> Vehicle:
    """A vehicle file from two flights that nothing else here uses, geometry not given."""
    from haltere.identify.vehicle import identify_vehicle

    return identify_vehicle([
        simulate(Scenario(mission=m, scale=k, duration=80.0, seed=95000 + i, sensors=SENSORS, wind={"n": 2.0, "e": -1.0, "gust": 0.4}))
        for i, (m, k) in enumerate((("lissajous", 0.6), ("tour", 1.0)))
    ]).as_vehicle()  # fmt: skip


def told(of: Vehicle, word: str, mission: str = "box", end: float = 8.0, **wind: float) -> list[dict[str, Any]]:
    scenario = Scenario(
        mission=mission, duration=AT + end, seed=96001, sensors=SENSORS, landing=False, wind=wind, fault=(word,) if word else ()
    )
    return alarms(haltere.run(simulate(scenario), vehicle=of, set=ON, scored=False).events)


@pytest.mark.parametrize(
    ("word", "sensor", "axis", "candidates"),
    [
        (f"model.r:bias=3rad/s2@{AT:g}", "model", "r", ["model.r"]),
        (f"model.p:bias=-3rad/s2@{AT:g}", "model", "p", ["model.p"]),
        (f"model.q:bias=1.5rad/s2@{AT:g}", "model", "q", ["model.q"]),
        (f"model.t:bias=0.8m/s2@{AT:g}", "model", "t", ["model.t"]),
        (f"rotor.3:thrust=0.85@{AT:g}", "rotors", "3", ["rotor.3", "rotors.3"]),
        (f"rotors.0:scale=1.04@{AT:g}", "rotors", "0", ["rotor.0", "rotors.0"]),
        (f"rotors.0:scale=1.02@{AT:g}", "rotors", "0", ["rotor.0", "rotors.0"]),
        (f"model.hy:bias=-0.8m/s2@{AT:g}", "model", "hy", ["model.hy"]),
        (f"model.hx:bias=0.8m/s2@{AT:g}", "model", "hx", ["model.hx"]),
    ],
)
def test_faults_of_model_and_rotor_are_named(identified: Vehicle, word: str, sensor: str, axis: str, candidates: list[str]) -> None:
    e, *later = told(identified, word)
    assert not later
    assert (e["sensor"], e["axis"], e["candidates"]) == (sensor, axis, candidates)
    named = 4.0 if axis in ("t", "hx", "hy") else 0.6
    assert 0.0 <= e["t_detected"] - AT < 0.25 and e["t_isolated"] - AT < named
    assert e["statistic"] > e["threshold"] and "silent" in e["evidence"] and "J1" in e["evidence"]


@pytest.mark.parametrize("size", [0.8, 0.4])
def test_an_accelerometer_is_not_taken_for_the_model(identified: Vehicle, size: float) -> None:
    (e,) = told(identified, f"accel.z:bias={size}m/s2@{AT:g}")
    assert e["candidates"] == ["accel.z"]


def test_in_hover_a_force_along_an_axis_and_a_wind_along_it_are_both_named(identified: Vehicle) -> None:
    for word in (f"model.hx:bias=0.8m/s2@{AT:g}", f"wind.n:step=2m/s@{AT:g}"):
        (e,) = told(identified, word, "hover")
        assert e["candidates"] == ["model.hx", "wind"] and e["t_isolated"] is None


def test_a_gyro_that_steps_is_named_at_once(identified: Vehicle) -> None:
    e, *later = told(identified, f"gyro.x:bias=20deg/s@{AT:g}")
    assert not [x for x in later if x["sensor"] in ("model", "rotors")]
    assert e["candidates"] == ["gyro.x"] and e["t_detected"] - AT < 0.1 and e["t_isolated"] - AT < 0.3


def test_a_hover_as_quiet_as_rest_is_still_a_flight(identified: Vehicle) -> None:
    """Sensors of theory-amendments.md 4 in still air meet every condition of rest but the rotors."""
    quiet = {"imu": {"gyro_noise": 0.0005, "accel_noise": 0.015}}
    word = f"accel.z:bias=0.8m/s2@{AT:g}"
    flight = simulate(Scenario(mission="hover", duration=AT + 8.0, seed=96002, sensors=SENSORS | quiet, landing=False, fault=(word,)))
    noise = {"noise.gyro": "0.0005", "noise.accel": "0.015"}
    (e,) = alarms(haltere.run(flight, vehicle=identified, set=ON | noise, scored=False).events)
    assert e["candidates"] == ["accel.z"] and 0.0 <= e["t_detected"] - AT < 0.15


def test_wind_convicts_nobody(identified: Vehicle) -> None:
    for e in told(identified, f"wind.n:step=4m/s@{AT:g}"):
        assert "wind" in e["candidates"] and e["t_isolated"] is None
    assert not told(identified, "", n=5.2, e=3.0, gust=1.2)


def test_a_fault_that_ends_is_over(identified: Vehicle) -> None:
    events = told(identified, f"model.r:bias=3rad/s2@{AT:g}-{AT + 6:g}", end=14.0)
    assert [e["axis"] for e in events] == ["r"]
    assert events[0]["t_recovered"] == pytest.approx(AT + 6.0, abs=0.6)


def test_names_of_what_it_may_be() -> None:
    assert len(CANDIDATES) == len(set(CANDIDATES)) < 63
    assert CANDIDATES.index("rotor.0") == 13 and CANDIDATES.index("rotors.0") == 21 and CANDIDATES.index("gyro.x") == 10
