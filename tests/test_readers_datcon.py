"""The DatCon reader: units and axes proved on a real flight record, and its rules on tables made here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from haltere.errors import HaltereError
from haltere.flight.log import FlightLog
from haltere.readers import format_of, read


@pytest.fixture(scope="module")
def flight(shared_data: Path) -> FlightLog:
    path = shared_data / "wemuav" / "datconv3.csv"
    assert format_of(path) == "haltere.readers.datcon"
    return read(path)


def _attitude(flight: FlightLog, t: np.ndarray) -> Rotation:  # type: ignore[type-arg]
    onboard = flight["onboard"]
    rows = np.clip(np.searchsorted(onboard.t, t), 0, len(onboard) - 1)
    return Rotation.from_quat(np.column_stack([onboard[f"q_{a}"][rows] for a in "xyzw"]))


def test_gyro_is_deg_s_and_frd(flight: FlightLog) -> None:
    """The onboard attitude turns as the gyro says, axis by axis; the table is thinned, hence the width."""
    onboard = flight["onboard"]
    q = _attitude(flight, onboard.t)
    rate = (q[:-2].inv() * q[2:]).as_rotvec() / (onboard.t[2:] - onboard.t[:-2])[:, None]
    gyro = np.column_stack([np.interp(onboard.t[1:-1], flight["imu"].t, flight["imu"][f"gyro_{a}"]) for a in "xyz"])
    slope = np.linalg.lstsq(gyro, rate, rcond=None)[0].T
    np.testing.assert_allclose(slope, np.eye(3), atol=0.15)


def test_accelerometer_is_specific_force_frd(flight: FlightLog) -> None:
    """Carried about by hand before the flight, it feels gravity along its axes as the onboard attitude says."""
    imu = flight["imu"]
    calm = (imu.t > 12.0) & (imu.t < 54.0) & (np.linalg.norm(imu.vector("gyro"), axis=1) < 1.0)
    force = imu.vector("accel")[calm]
    assert np.median(np.linalg.norm(force, axis=1)) == pytest.approx(9.81, abs=0.15)
    up = _attitude(flight, imu.t[calm]).inv().apply(np.tile([0.0, 0.0, -9.80665], (int(calm.sum()), 1)))
    assert force[:, 2].mean() == pytest.approx(up[:, 2].mean(), abs=0.3)
    for axis in (0, 1):
        assert np.ptp(up[:, axis]) > 5.0
        assert np.polyfit(up[:, axis], force[:, axis], 1)[0] == pytest.approx(1.0, abs=0.2)


def test_magnetometer_has_the_direction_but_no_unit(flight: FlightLog) -> None:
    """Counts: turned north, east, down they dip by 81 degrees, where the vehicle's own field model (78.5 N) says 82.4."""
    counts = flight["field_counts"]
    flying = counts.t > 55.0
    field = _attitude(flight, counts.t[flying]).apply(counts.vector("mag")[flying]).mean(axis=0)
    assert np.degrees(np.arctan2(field[2], np.hypot(field[0], field[1]))) == pytest.approx(82.4, abs=2.0)
    assert "magnetometer" not in flight
    assert any("nothing documents" in n and "54.8 uT" in n for n in flight.notes)


def test_the_flight_is_in_its_last_seconds(flight: FlightLog) -> None:
    rotors, barometer, gnss = flight["rotors"], flight["barometer"], flight["gnss"]
    speeds = np.column_stack([rotors[f"speed_{i}"] for i in range(4)])
    started = rotors.t[np.argmax(speeds.min(axis=1) > 300.0)]
    assert 52.0 < started < 54.0  # the table's own clock is zero where the motors start
    assert -flight.meta.time_offset == pytest.approx(started, abs=1.5)
    # Barometer, receiver and onboard velocity climb together.
    t = np.array([57.0, 59.0])
    rise = np.diff(np.interp(t, barometer.t, barometer["altitude"]))[0]
    assert rise > 2.5
    assert np.diff(np.interp(t, gnss.t, gnss["alt"]))[0] == pytest.approx(rise, abs=1.5)
    onboard = flight["onboard"]
    during = (onboard.t > t[0]) & (onboard.t < t[1])
    climbed = -float(np.sum(onboard["vel_d"][during][1:] * np.diff(onboard.t[during])))
    assert climbed == pytest.approx(rise, abs=1.5)


def test_held_values_are_read_once_and_told(flight: FlightLog) -> None:
    gnss = flight["gnss"]
    assert gnss.rate == pytest.approx(4.8, abs=0.6)
    assert flight["power"].rate == pytest.approx(1.0, abs=0.2)
    assert (np.abs(gnss["lat"]) > 1.0).all()
    assert flight.discarded["gnss"]["no fix yet: latitude and longitude zero"] > 0
    assert any(n.startswith("of 1698 rows") and "gnss 121" in n for n in flight.notes)
    assert list(flight["modes"]["mode"]) == ["Manual", "Atti", "GPS Atti", "ASST TAKEOFF", "AssitedTakeoff", "GPS Atti"]
    # The receiver's second 12:06:45 is in the table; the record began a minute before its end.
    assert flight.meta.start_utc is not None
    assert flight.meta.start_utc.startswith("2020-08-05T12:06:0")


def _table(path: Path, header: str, rows: list[str]) -> FlightLog:
    path.write_text("\n".join([header, *rows]) + "\n")
    return read(path)


HEADER = (
    "Tick#,offsetTime,IMU_ATTI(0):accel:X,IMU_ATTI(0):accel:Y,IMU_ATTI(0):accel:Z,IMU_ATTI(0):gyro:X,IMU_ATTI(0):gyro:Y,IMU_ATTI(0):gyro:Z"
)


def test_units_by_size_and_names_of_other_versions(tmp_path: Path) -> None:
    rows = [f"{k},{k / 100 - 1:.3f},{k * 1e-6},0,-1,180,0,{k}" for k in range(100)]
    one = _table(tmp_path / "a.csv", HEADER, rows)
    other = HEADER.replace("accel:", "accel").replace("gyro:", "gyro").replace("offsetTime", "Clock:offsetTime[seconds]")
    metres = [r.replace(",-1,", ",-9.80665,") for r in rows]
    two = _table(tmp_path / "b.csv", other, metres)
    for flight in (one, two):
        assert flight["imu"]["accel_z"][0] == pytest.approx(-9.80665)
        assert flight["imu"]["gyro_x"][0] == pytest.approx(np.pi)
        assert flight.meta.time_offset == -1.0
    assert any("in g" in n for n in one.notes)
    assert any("in m/s^2" in n for n in two.notes)


def test_held_empty_and_broken_cells(tmp_path: Path) -> None:
    rows = ["0,0.00,0,0,-1,0,0,0", "1,0.01,0,0,-1,0,0,0", "2,,0,0,-1,0,0,5", "3,0.03,,,,,,", "4,0.04,0,0,-1,0,x,1", "5,0.05,0,0,-1,0,0,2"]
    flight = _table(tmp_path / "a.csv", HEADER, rows)
    np.testing.assert_allclose(flight["imu"].t, [0.0, 0.05])
    assert flight.discarded["imu"]["row without a time"] == 1


def test_wind_is_where_it_blows_to_and_nothing_before_it_is_estimated(tmp_path: Path) -> None:
    header = HEADER + "".join(f",IMU_ATTI(0):{c}" for c in ("roll", "pitch", "yaw", "velN", "velE", "velD", "Latitude", "Longitude"))
    header += ",Wind:velocity,Wind:direction,Wind:fromDir"
    rows = [f"{k},{k / 100:.2f},{k * 1e-6},0,-1,0,0,{k},1,2,{3 + k * 0.01},0,0,0,47,8,{4 if k > 50 else 0},90,270" for k in range(100)]
    onboard = _table(tmp_path / "a.csv", header, rows)["onboard"]
    known = np.isfinite(onboard["wind_e"])
    assert known.any() and not known[:50].any()
    np.testing.assert_allclose(onboard["wind_e"][known], 4.0)
    np.testing.assert_allclose(onboard["wind_n"][known], 0.0, atol=1e-12)
    still = _table(tmp_path / "b.csv", header, [r.replace(",4,90,", ",0,90,") for r in rows])
    assert "wind_n" not in still["onboard"]


def test_what_cannot_be_read_is_one_clear_error(tmp_path: Path) -> None:
    for name, text in (("a", HEADER), ("b", HEADER + "\n0,,0,0,0,0,0,0"), ("c", "offsetTime,IMU_ATTI(0):accel:X\n1,\n")):
        (tmp_path / f"{name}.csv").write_text(text + "\n")
        with pytest.raises(HaltereError):
            read(tmp_path / f"{name}.csv")


def test_a_table_of_one_s_own_is_not_datcon(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,gyro_x\n0,1\n")
    assert format_of(tmp_path / "a.csv") == "haltere.readers.table"
