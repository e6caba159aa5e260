"""Moments while it is open whose a force is: what the force would make of them, and a model that fits again; with real flights."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import haltere
from converters_indiflight import captured, indiflight
from haltere._jit import as_records, entry
from haltere.diagnosis.model_faults import by_air, returned
from haltere.flight.log import FlightLog
from haltere.identify.vehicle import identify_vehicle
from haltere.metrics.detection import alarms
from haltere.simulate import inject
from haltere.strapdown.pairs import MARKS

PAIRS = np.dtype(
    [("of_this_test", "i8"), ("mark", "i8"), ("m_drift", "f8", (int(MARKS), 6)), ("m_wind", "f8", (int(MARKS), 2)), ("t_alarm", "f8", 6),
     ("told_size", "f8", 6), ("by_v", "f8", (2, 3, 3))], align=True,
)  # fmt: skip
STATE = np.dtype([("of_this_test_too", "i8"), ("q", "f8", 4), ("wind", "f8", 2), ("drag", "f8", 0), ("pairs", (np.record, PAIRS), 1)])


@entry
def _returned(P: Any, i: int, size: float, out: Any) -> None:
    out[0] = 1.0 if returned(P[0], i, size) else 0.0


@entry
def _by_air(S: Any, i: int, span: float, out: Any) -> None:
    out[0] = by_air(S[0], i, span)


@pytest.mark.parametrize(("before", "size", "again"), [(7.3, -7.7, True), (7.3, -3.0, False), (0.1, -7.7, False), (-2.0, -2.0, False)])
def test_a_model_that_fits_again_is_known_from_one_that_no_longer_does(before: float, size: float, again: bool) -> None:
    p = np.zeros(1, PAIRS)
    p["mark"], p["m_drift"][0, 3, 5] = 3, before
    out = np.zeros(1)
    _returned(as_records(p), 5, size, out)
    assert bool(out[0]) == again


def test_a_force_that_is_the_accelerometers_bends_velocity_and_wind() -> None:
    """By hand: heading east, 4 m/s more of wind from behind than at the mark, and a force of 2 m/s² along x for half a second.

    The wind blows along body x, so that the air is off by 4 m/s there, and the velocity by 1 m/s at the end and half of that on average.
    """
    s = np.zeros(1, STATE)
    s["q"] = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    s["wind"] = (1.0, 6.0)
    p = s["pairs"][0]
    p["mark"], p["m_wind"][0, 7] = 7, (1.0, 2.0)
    p["by_v"][0, 1] = [[0.0, -0.3, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.2]]
    out = np.zeros(1)
    _by_air(as_records(s), 4, 0.5, out)
    assert out[0] == 0.0, "no force has alarmed"
    p["t_alarm"][0, 0], p["told_size"][0, 0] = 12.0, -2.0
    for axis, wanted in ((3, 0.0), (4, 3.0 * (4.0 + 0.5)), (5, 0.0)):
        _by_air(as_records(s), axis, 0.5, out)
        assert out[0] == pytest.approx(wanted, abs=1e-12)


# --- real flights ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(shared_data: Path) -> Any:
    folder = shared_data / "indiflight"
    known = [captured(next(folder.glob(f"*LOG00{n}.BFL"))) for n in (267, 281)]
    return identify_vehicle(known, still=True, set={"baro.temperature": 293.0, "timeout.gnss": 1.0}).lumped


def flown(shared_data: Path, number: int) -> FlightLog:
    """A flight until a second before its capture ends, in a landing or a net."""
    flight = indiflight(next((shared_data / "indiflight").glob(f"*LOG00{number}.BFL")))
    end = float(flight["truth"].t[-1]) - 1.0
    return FlightLog({k: s.where(s.t <= end) for k, s in flight.streams.items()}, flight.meta, flight.notes)


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("number", [230, 257, 340])
def test_a_real_flight_without_a_fault_is_told_none(shared_data: Path, fitted: Any, number: int) -> None:
    pytest.importorskip("orangebox")
    assert not alarms(haltere.run(flown(shared_data, number), vehicle=fitted, scored=False).events)


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("word", ["accel.x:bias=5m/s2@6", "accel.y:bias=5m/s2@6", "accel.x:bias=2m/s2@6", "gyro.x:bias=20deg/s@6"])
def test_a_fault_put_into_a_real_flight_is_not_taken_for_the_vehicles(shared_data: Path, fitted: Any, word: str) -> None:
    pytest.importorskip("orangebox")
    found = alarms(haltere.run(inject(flown(shared_data, 257), [word]), vehicle=fitted, scored=False).events)
    assert found[0]["candidates"] == [word[:6] if word[0] == "g" else word[:7]]
    assert not [e for e in found if e["sensor"] in ("model", "rotors")]
