"""One table with a column map: units, times, holes, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from haltere.errors import HaltereError
from haltere.flight.schema import STREAMS
from haltere.readers import format_of, read
from haltere.readers.table import UNITS

MAP = {
    "t": "time_us [us]",
    "imu.gyro_x": "gx [deg/s]",
    "imu.accel_z": "-az [g]",
    "gnss.lat": "lat [1e-7deg]",
    "gnss.alt": "alt [mm]",
    "magnetometer.1.mag_x": "mx [mG]",
    "barometer.temperature": "T [K]",
}
CSV = """# my logger
time_us,gx,az,lat,alt,mx,T,remark
1000000,180,1.0,,,,293.15,start
1100000,90,1.0,473977418,488000,210,,
1200000,0,1.0,,,,,
"""


def test_column_map_turns_units(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(CSV)
    flight = read(path, MAP)
    assert list(flight["imu"].columns) == ["t", "gyro_x", "accel_z"]
    np.testing.assert_allclose(flight["imu"].t, [0.0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_allclose(flight["imu"]["gyro_x"], [np.pi, np.pi / 2, 0.0])
    np.testing.assert_allclose(flight["imu"]["accel_z"], -9.80665)
    # A slow sensor has only the rows in which it has a value.
    assert len(flight["gnss"]) == 1
    assert flight["gnss"].t[0] == pytest.approx(0.1)
    assert flight["gnss"]["lat"][0] == pytest.approx(47.3977418, abs=1e-12)
    assert flight["gnss"]["alt"][0] == 488.0
    assert flight["magnetometer.1"]["mag_x"][0] == pytest.approx(21.0)
    assert flight["barometer"]["temperature"].tolist() == [20.0]
    assert flight.meta.time_offset == 1.0


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_columns_named_as_in_the_schema_need_no_map(tmp_path: Path, ending: str) -> None:
    table = pl.DataFrame(
        {
            "t": [0, 1, 2],
            "gyro_x": [1.0, None, 3.0],
            "imu.gyro_y [deg/s]": [180, 0, 0],
            "lat": [None, 47.0, None],
            "onboard.q_w": [1, 1, 1],
            "rpm": [1, 2, 3],
        }
    )
    path = tmp_path / "any.name"
    if ending == "csv":
        table.write_csv(path)
    else:
        table.write_parquet(path)
    assert format_of(path) == "haltere.readers.table"
    flight = read(path)
    np.testing.assert_array_equal(flight["imu"]["gyro_x"], [1.0, np.nan, 3.0])
    assert flight["imu"]["gyro_y"][0] == pytest.approx(np.pi)
    assert flight["gnss"].t.tolist() == [1.0]
    assert flight["onboard"]["q_w"].tolist() == [1.0, 1.0, 1.0]
    assert flight.notes == ["columns not recognised and not read: rpm"]


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_delimiters_and_units_in_headers(tmp_path: Path, mark: str) -> None:
    path = tmp_path / "log.txt"
    path.write_text("\n".join(mark.join(row) for row in (["Time [ms]", " gyro_x [deg/s]"], ["0", "180"], ["5", " 90 "])) + "\n")
    flight = read(path)
    assert flight["imu"].t.tolist() == [0.0, 0.005]
    np.testing.assert_allclose(flight["imu"]["gyro_x"], [np.pi, np.pi / 2])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"imu.gyro_x": "gyrox"}, "did you mean 'gx'"),
        ({"imu.gyrox": "gx"}, "did you mean 'gyro_x'"),
        ({"imv.gyro_x": "gx"}, "did you mean 'imu'"),
        ({"imu.gyro_x": "gx [m/s]"}, "a unit that can be turned into rad/s"),
        ({"imu.gyro_y": "remark"}, "expected numbers, found 'start'"),
        ({"imu.t": "nothing"}, "no such column"),
        ({"": "gx"}, "stream.column"),
    ],
)
def test_wrong_maps_are_told(tmp_path: Path, change: dict[str, str], said: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(CSV)
    with pytest.raises(HaltereError) as caught:
        read(path, MAP | change)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "column map"),
        ("t,gyro_x\n1,\n", "a table with values"),
        ("gyro_x,gyro_y\n1,2\n", "a time for imu"),
        ("t,gyro_x\n1,fast\n", "expected numbers, found 'fast'"),
    ],
)
def test_tables_that_cannot_be_used_are_told(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(HaltereError) as caught:
        read(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)


def test_row_numbers_without_a_name_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(",t,gyro_x\n0,0.5,1\n1,0.6,2\n")
    assert read(path)["imu"]["gyro_x"].tolist() == [1.0, 2.0]


def test_rows_without_time_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,gyro_x\n0,1\n,2\nnan,3\n3,4\n")
    flight = read(path)
    assert flight["imu"]["gyro_x"].tolist() == [1.0, 4.0]
    assert flight.discarded == {"imu": {"no time stamp": 2}}


def test_held_values_are_told(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,mag_x\n" + "".join(f"{i},{i // 5}\n" for i in range(50)))
    assert any("held between updates" in note for note in read(path).notes)


def test_every_unit_of_the_schema_is_known() -> None:
    units = {c.unit for s in STREAMS.values() for c in s.columns}
    assert units <= set(UNITS)
    for unit, known in UNITS.items():
        assert known[unit] == (1.0, 0.0)


def test_column_map_on_a_real_recording(shared_data: Path) -> None:
    path = shared_data / "px4_ecl_replay" / "iris_gps.csv"
    assert path.exists()
    with pytest.raises(HaltereError):
        read(path)  # lines of mixed kinds are no table
