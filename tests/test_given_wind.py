"""Wind told by the user: texts, tables, stations, times, units; what is wrong is one clear error."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import haltere
from haltere.errors import HaltereError, UsageError
from haltere.flight.door import check
from haltere.flight.given_wind import SD, parse_wind
from haltere.flight.log import FlightLog, FlightMeta, Stream

START = "2024-05-01T12:00:00Z"


def flight(start: str | None = START, end: float = 60.0) -> FlightLog:
    t = np.linspace(0.0, end, 601)
    rng = np.random.default_rng(1)
    imu = {"t": t} | {f"{s}_{a}": rng.normal(-9.8 * (s + a == "accelz"), 0.01, len(t)) for s in ("gyro", "accel") for a in "xyz"}
    return FlightLog({"imu": imu}, FlightMeta(name="made", start_utc=start))


def components(log: FlightLog) -> np.ndarray:
    return log["wind"].vector("wind", "ned")


# --- constants -----------------------------------------------------------------------------------------------------------


@settings(deadline=None)
@given(st.floats(0.0, 40.0), st.floats(-720.0, 720.0))
def test_speed_and_direction_are_where_it_comes_from(speed: float, azimuth: float) -> None:
    n, e, d = parse_wind(f"{speed:.6f}@{azimuth:.6f}") or (math.nan,) * 3
    assert math.hypot(n, e) == pytest.approx(speed, abs=2e-6)
    # the air moves away from where it comes from
    assert n * math.cos(math.radians(azimuth)) + e * math.sin(math.radians(azimuth)) == pytest.approx(-speed, abs=2e-5)
    assert d == 0.0


@pytest.mark.parametrize(
    ("text", "wind"),
    [
        ("3,1", (3.0, 1.0, 0.0)),
        (" -3.5 , 1e0, 0.2", (-3.5, 1.0, 0.2)),
        ("5@270", (0.0, 5.0, 0.0)),
        ("18km/h@0", (-5.0, 0.0, 0.0)),
        ("10 kt @ 90 deg", (0.0, -10.0 * 1852.0 / 3600.0, 0.0)),
    ],
)
def test_texts(text: str, wind: tuple[float, float, float]) -> None:
    assert parse_wind(text) == pytest.approx(wind, abs=1e-12)
    log = haltere.with_wind(flight(), text, sd=0.5)
    assert components(log) == pytest.approx(np.tile(wind, (len(log["wind"]), 1)), abs=1e-12)
    assert log["wind"].t[[0, -1]] == pytest.approx([0.0, 60.0])
    assert set(log["wind"]["sd"]) == {0.5}
    assert "wind" not in flight()
    assert len(check(log, upright=False).streams["wind"]) == len(log["wind"])


@pytest.mark.parametrize("text", ["fast@270", "5@north", "5furlong@270", "-5@270", "500,0", "nowhere.csv", "1,2,3,4", "1.2.3,4"])
def test_texts_that_are_no_wind_are_wrong_usage(text: str) -> None:
    with pytest.raises(UsageError, match="expected"):
        haltere.with_wind(flight(), text)


def test_numbers_are_taken_as_they_are_and_an_assumed_sd_is_said() -> None:
    log = haltere.with_wind(flight(), (1.0, -2.0))
    assert components(log)[0] == pytest.approx([1.0, -2.0, 0.0])
    assert log["wind"]["sd"][0] == SD
    assert any("assumption" in n for n in log.notes)
    for wrong in ((1.0,), (1.0, math.nan), (1.0, 2.0, 3.0, 4.0)):
        with pytest.raises(UsageError):
            haltere.with_wind(flight(), wrong)
    with pytest.raises(UsageError, match="positive"):
        haltere.with_wind(flight(), "1,2", sd=0.0)


# --- tables --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_station_with_units_and_utc(tmp_path: Path, kind: str) -> None:
    table = pl.DataFrame({
        "utc": ["2024-05-01T12:00:10Z", "2024-05-01T14:00:30+02:00", "2024-05-01T12:00:50"],
        "wind speed [km/h]": [18.0, 36.0, 18.0], "direction [deg]": [350.0, 10.0, 90.0],
        "gust [km/h]": [36.0, 90.0, 18.0], "humidity": [1, 2, 3],
    })  # fmt: skip
    path = tmp_path / f"station.{kind}"
    table.write_csv(path) if kind == "csv" else table.write_parquet(path)
    log = haltere.with_wind(flight(), path)
    wind = log["wind"]
    assert wind.t == pytest.approx([10.0, 30.0, 50.0])
    assert wind["wind_n"] == pytest.approx([-5.0 * math.cos(math.radians(10.0)), -10.0 * math.cos(math.radians(10.0)), 0.0], abs=1e-12)
    assert wind["wind_e"] == pytest.approx([5.0 * math.sin(math.radians(10.0)), -10.0 * math.sin(math.radians(10.0)), -5.0])
    # between 350 and 10 degrees the wind is from the north, never from the south
    assert np.interp(20.0, wind.t, wind["wind_n"]) < -7.0
    assert wind["sd"] == pytest.approx([5.0 / 3.0, 5.0, 0.5])
    assert any("comes from" in n for n in log.notes) and any("humidity" in n for n in log.notes)


def test_components_in_flight_time_with_their_own_sd_and_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "mast.csv"
    path.write_text("t [ms];wind_n;wind_e;wind_d;sd\n20000;2;1;0.1;0.4\n10000;1;0;0;0.3\n30000;;5;0;0.5\n")
    log = haltere.with_wind(flight(None), str(path))
    assert log["wind"].t == pytest.approx([10.0, 20.0])
    assert components(log) == pytest.approx(np.array([[1.0, 0.0, 0.0], [2.0, 1.0, 0.1]]))
    assert log["wind"]["sd"] == pytest.approx([0.3, 0.4])
    assert any("1 of 3 rows" in n for n in log.notes)
    assert set(haltere.with_wind(flight(None), path, sd=2.0)["wind"]["sd"]) == {2.0}


def test_columns_in_memory_and_direction_to() -> None:
    log = haltere.with_wind(flight(), {"t": [0.0, 60.0], "speed": [2.0, 2.0], "to": [0.0, 90.0]})
    assert components(log) == pytest.approx(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), abs=1e-12)
    seconds = haltere.with_wind(flight(), {"utc": [1714564800.0 + 5.0], "north": [1.0], "east": [0.0]})  # 12:00:05 of that day
    assert seconds["wind"].t == pytest.approx([5.0])


@pytest.mark.parametrize(
    ("columns", "start", "match"),
    [
        ({"utc": [START], "north": [1.0], "east": [1.0]}, None, "start_utc"),
        ({"north": [1.0], "east": [1.0]}, START, "a time"),
        ({"t": [1.0], "speed": [1.0]}, START, "direction"),
        ({"t": [1.0], "speed": [1.0], "from": [1.0], "to": [2.0]}, START, "leave one out"),
        ({"t": [1.0], "speed [mph]": [1.0], "from": [1.0]}, START, "unit"),
        ({"t": [1.0], "speed": ["calm"], "from": [1.0]}, START, "calm"),
        ({"t": [1.0], "speed": [1.0, 2.0], "from": [1.0]}, START, "one length"),
        ({"t": [1.0], "speed": [150.0], "from": [1.0]}, START, "unit in brackets"),
        ({"t": [1.0], "north": [1.0], "east": [1.0], "sd": [0.0]}, START, "positive sd"),
        ({"t": [900.0], "north": [1.0], "east": [1.0]}, START, "between t = 0.0 and 60.0"),
        ({"t": [math.nan], "north": [1.0], "east": [1.0]}, START, "rows with a time"),
        ({"utc": ["noon"], "north": [1.0], "east": [1.0]}, START, "ISO 8601"),
        ({"t": [1.0], "north": [1.0], "wind_n": [2.0], "east": [1.0]}, START, "two"),
    ],
)
def test_tables_that_cannot_be_used_say_why(columns: dict, start: str | None, match: str) -> None:
    with pytest.raises(HaltereError, match=match):
        haltere.with_wind(flight(start), columns)


@pytest.mark.parametrize(
    "data", [b"", b"\n", b"t,north\n", b"PAR1 and nothing", b"\x00\xff\xfe", b"t,north,east\n1,2\n", b"t,north,east\n1,2,3,4\n"]
)
def test_broken_files_are_one_clear_error(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "broken.csv"
    path.write_bytes(data)
    with pytest.raises(HaltereError, match="expected"):
        haltere.with_wind(flight(), path)


def test_the_stream_survives_a_flight_folder(tmp_path: Path) -> None:
    from haltere.flight.folder import read_folder, write_folder

    log = haltere.with_wind(flight(), "3,1,0.5", sd=0.7)
    assert read_folder(write_folder(log, tmp_path / "f"))["wind"] == log["wind"]
    assert isinstance(log["wind"], Stream)
