"""The readers on real logs: against other parsers, against physics, and against damage."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from haltere.errors import HaltereError
from haltere.flight.log import FlightLog, Stream
from haltere.flight.schema import NAVIGATION_STREAMS, base_name
from haltere.readers import format_of, read
from haltere.readers._dataflash import DataFlash
from haltere.readers._ulog import Log

ULOGS = (
    *("sample.ulg", "sample_appended_multiple.ulg", "sample_log_small.ulg"),
    *("sample_logging_tagged_and_default_params.ulg", "sample_px4_events.ulg", "sample_unordered.ulg"),
)
DATAFLASH = ("log_0036_mechanical_failure.bin", "log_0041_mechanical_failure.bin", "beast_sample.bin", "mechanical_fail.log", "nan.log")
ALL = (*(f"px4/{n}" for n in ULOGS), *(f"ardupilot/{n}" for n in DATAFLASH))

_read: dict[Path, FlightLog] = {}


def _flight(path: Path) -> FlightLog:
    if path not in _read:
        _read[path] = read(path)
    return _read[path]


def _norm(stream: Stream, stem: str) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(stream.vector(stem), axis=1))


def _attitude(flight: FlightLog, t: NDArray[np.float64]) -> Rotation:
    onboard = flight["onboard"]
    rows = np.isfinite(onboard["q_w"])
    q = np.column_stack([np.interp(t, onboard.t[rows], onboard[f"q_{a}"][rows]) for a in "xyzw"])
    return Rotation.from_quat(q)


@pytest.mark.parametrize("name", ALL)
def test_every_log_reads_into_sane_units(shared_data: Path, name: str) -> None:
    flight = _flight(shared_data / name)
    starts = [s.t.min() for n, s in flight.streams.items() if base_name(n) in NAVIGATION_STREAMS]
    assert min(starts) == 0.0
    assert flight.meta.source.startswith("PX4 ULog" if name.endswith("ulg") else "ArduPilot DataFlash")
    for stream_name, stream in flight.streams.items():
        kind = base_name(stream_name)
        assert len(stream) > 0
        assert stream.t.max() < 1500.0
        if kind == "imu":
            assert 9.3 < np.median(_norm(stream, "accel")) < 10.6
            assert np.median(_norm(stream, "gyro")) < 3.0
            assert np.median(stream["accel_z"]) < -8.0
        elif kind == "magnetometer":
            # The 2016 sample was recorded on a bench with iron about.
            assert 20.0 < np.median(_norm(stream, "mag")) < (120.0 if "appended" in name else 70.0)
        elif kind == "barometer" and "pressure" in stream:
            assert 85e3 < np.median(stream["pressure"]) < 105e3
        elif kind == "gnss":
            assert np.nanmax(np.abs(stream["lat"])) <= 90.0
            assert -50.0 < np.nanmedian(stream["alt"]) < 2000.0
        elif kind in ("onboard", "truth") and "q_w" in stream:
            q = np.column_stack([stream[f"q_{a}"] for a in "wxyz"])
            norms = np.linalg.norm(q[np.isfinite(q[:, 0])], axis=1)
            np.testing.assert_allclose(norms, 1.0, atol=1e-3)
        elif kind == "rotors":
            for column in (c for c in stream.names if c.startswith("command_")):
                assert np.nanmin(stream[column]) >= 0.0
                assert np.nanmax(stream[column]) <= 1.0
        elif kind == "power":
            assert 10.0 < np.nanmedian(stream["voltage"]) < 60.0


@pytest.mark.parametrize("name", ["px4/sample.ulg", "px4/sample_px4_events.ulg", *(f"ardupilot/{n}" for n in (*DATAFLASH[:3], "nan.log"))])
def test_onboard_attitude_turns_gravity_down(shared_data: Path, name: str) -> None:
    """At rest and in steady flight R(q) accel is (0, 0, -g); the transpose is not, where the vehicle is tilted."""
    flight = _flight(shared_data / name)
    imu = flight["imu"]
    onboard = flight["onboard"].t[np.isfinite(flight["onboard"]["q_w"])]
    rows = (imu.t >= onboard[0]) & (imu.t <= onboard[-1]) & (_norm(imu, "gyro") < 0.3)
    if name.endswith("nan.log"):
        rows &= imu.t < 20.0  # after that its own attitude is lost: the compass parameters are NaN
    mean = np.mean(_attitude(flight, imu.t[rows]).apply(imu.vector("accel")[rows]), axis=0)
    assert np.hypot(mean[0], mean[1]) < 0.35
    assert -10.1 < mean[2] < -9.4


@pytest.mark.parametrize("name", ["log_0036_mechanical_failure.bin", "log_0041_mechanical_failure.bin"])
def test_magnetometer_agrees_with_attitude_and_earth(shared_data: Path, name: str) -> None:
    """The field in NED points north, as the EKF that saw the same compass believes."""
    flight = _flight(shared_data / "ardupilot" / name)
    mag = flight["magnetometer"].where(flight["magnetometer"].t < 20.0)
    field = np.mean(_attitude(flight, mag.t).apply(mag.vector("mag")), axis=0)
    assert abs(np.degrees(np.arctan2(field[1], field[0]))) < 8.0
    assert field[2] > 0.0


@pytest.mark.parametrize("name", ["log_0036_mechanical_failure.bin", "log_0041_mechanical_failure.bin"])
def test_gnss_velocity_is_the_derivative_of_position(shared_data: Path, name: str) -> None:
    gnss = _flight(shared_data / "ardupilot" / name)["gnss"]
    metres = 111_195.0
    moving = np.hypot(gnss["vel_n"], gnss["vel_e"]) > 1.0
    assert moving.sum() > 20
    for axis, rate in (
        ("n", np.gradient(gnss["lat"], gnss.t) * metres),
        ("e", np.gradient(gnss["lon"], gnss.t) * metres * np.cos(np.radians(gnss["lat"]))),
        ("d", -np.gradient(gnss["alt"], gnss.t)),
    ):
        assert np.median(np.abs(rate - gnss[f"vel_{axis}"])[moving]) < 0.3
        assert np.corrcoef(rate[moving], gnss[f"vel_{axis}"][moving])[0, 1] > 0.9


def test_log_0036_is_what_its_pilot_saw(shared_data: Path) -> None:
    flight = _flight(shared_data / "ardupilot" / DATAFLASH[0])
    imu, onboard = flight["imu"], flight["onboard"]
    assert flight.meta.time_offset == pytest.approx(224.630352, abs=1e-9)
    assert imu.t[-1] == pytest.approx(375.29 - 224.630352, abs=0.01)
    assert flight.meta.start_utc is not None
    assert flight.meta.start_utc.startswith("2016-12-23T14:15:21")  # 17 leap seconds then, not 18
    assert flight.meta.home is None  # no ORGN message, so no origin and no position relative to it
    assert "pos_n" not in onboard
    assert "h_acc" in flight["gnss"]
    rows = np.isfinite(onboard["q_w"])
    q = np.column_stack([onboard[f"q_{a}"] for a in "xyzw"])[rows]
    roll = np.abs(Rotation.from_quat(q).as_euler("ZYX", degrees=True)[:, 2])
    late = onboard.t[rows] > 147.3
    assert roll[late].max() > 90.0
    assert roll[~late].max() < 45.0


def test_ardupilot_home_is_the_origin_of_its_positions(shared_data: Path) -> None:
    flight = _flight(shared_data / "ardupilot" / "log_0041_mechanical_failure.bin")
    onboard, home = flight["onboard"], flight.meta.home
    assert home is not None
    pos, geo = np.isfinite(onboard["pos_n"]), np.isfinite(onboard["lat"])
    for axis, want in (
        ("n", (onboard["lat"][geo] - home.lat) * 110_640.0),
        ("e", (onboard["lon"][geo] - home.lon) * 111_320.0 * np.cos(np.radians(home.lat))),
        ("d", home.alt - onboard["alt"][geo]),
    ):
        got = np.interp(onboard.t[geo], onboard.t[pos], onboard[f"pos_{axis}"][pos])
        assert np.median(np.abs(got - want)) < 0.1


def test_px4_home_is_the_origin_of_its_positions(shared_data: Path) -> None:
    flight = _flight(shared_data / "px4" / "sample_px4_events.ulg")
    onboard, home = flight["onboard"], flight.meta.home
    assert home is not None
    assert flight.meta.start_utc == "2024-03-18T14:49:10.318Z"
    pos, geo = np.isfinite(onboard["pos_d"]), np.isfinite(onboard["alt"])
    got = np.interp(onboard.t[geo], onboard.t[pos], onboard["pos_d"][pos])
    assert np.median(np.abs(got - (home.alt - onboard["alt"][geo]))) < 0.05
    north = np.interp(onboard.t[geo], onboard.t[pos], onboard["pos_n"][pos])
    assert np.median(np.abs(north - (onboard["lat"][geo] - home.lat) * 111_177.0)) < 0.05


def test_px4_versions(shared_data: Path) -> None:
    px4 = shared_data / "px4"
    old, mid, new = (
        _flight(px4 / n) for n in ("sample_log_small.ulg", "sample_logging_tagged_and_default_params.ulg", "sample_px4_events.ulg")
    )
    # Integer positions of old and floating ones of new give the same kind of column.
    assert old["gnss"]["lat"][0] == pytest.approx(63.4170622)
    assert old["gnss"]["alt"][0] == pytest.approx(66.814)
    assert new["gnss"]["lat"][-1] == pytest.approx(47.3977, abs=1e-3)
    # sensor_baro in millibar (1.11) and pascal (1.13).
    assert np.median(old["barometer.1"]["pressure"]) == pytest.approx(np.median(old["barometer"]["pressure"]), rel=2e-3)
    assert np.median(mid["barometer.1"]["pressure"]) == pytest.approx(np.median(mid["barometer"]["pressure"]), rel=2e-3)
    # The unit that sensor_combined comes from is not listed again.
    assert [n for n in old if base_name(n) == "imu"] == ["imu", "imu.1", "imu.2"]
    assert np.median(np.abs(old["imu.1"]["accel_z"])) == pytest.approx(9.81, abs=0.3)
    assert old.meta.start_utc is not None
    assert old.meta.start_utc.startswith("2021-04-21T06:30:58")
    assert set(mid["truth"].names) >= {"q_w", "vel_n", "pos_n", "lat"}
    assert mid["truth"].rate > 50.0
    # 1.15: speeds ordered by function; commands have their own time base.
    assert [c for c in new["rotors"].names if c != "t"] == [f"speed_{i}" for i in range(4)]
    assert np.nanmax(new["rotors"]["speed_0"]) == pytest.approx(3294 * np.pi / 30, rel=1e-3)
    assert [c for c in new["actuators"].names if c != "t"] == [f"command_{i}" for i in range(4)]
    assert new.meta.imu_kind == "mean"


def test_px4_slow_sensors_inside_sensor_combined(shared_data: Path) -> None:
    flight = _flight(shared_data / "px4" / "sample.ulg")
    assert "barometer" not in flight  # every row says: no sample
    mag = flight["magnetometer"]
    assert (np.diff(mag.t) > 0.0).all()
    assert any("repeat the sample before" in note for note in flight.notes)
    assert any(note.startswith("barometer: 17070 rows") for note in flight.notes)


@pytest.mark.parametrize("name", ULOGS[1:5])
def test_ulog_columns_are_pyulogs(shared_data: Path, name: str) -> None:
    from pyulog import ULog

    path = shared_data / "px4" / name
    flight = _flight(path)
    data = next(d for d in ULog(str(path), ["sensor_combined"]).data_list).data
    np.testing.assert_array_equal(flight["imu"]["gyro_y"], data["gyro_rad[1]"].astype(float))
    np.testing.assert_allclose(flight["imu"].t + flight.meta.time_offset, data["timestamp"] / 1e6, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", DATAFLASH)
def test_dataflash_columns_are_pymavlinks(shared_data: Path, name: str) -> None:
    """Whole-column decoding against the reference parser's message by message, on every field of every message."""
    from pymavlink import DFReader

    path = shared_data / "ardupilot" / name
    mine = DataFlash(path)
    kind = DFReader.DFReader_binary if mine.binary else DFReader.DFReader_text
    reference = kind(str(path))
    seen: dict[str, int] = {}
    while (message := reference.recv_msg()) is not None:
        word = message.get_type()
        i = seen.get(word, 0)
        seen[word] = i + 1
        # Some of every type: the first ones, and then one in fifty.
        if word in ("FMT", "FMTU", "UNIT", "MULT", "MODE") or (i > 5 and i % 50):
            continue
        messages = mine.get(word)
        assert messages is not None
        for field in message.get_fieldnames():
            want = getattr(message, field)
            got = messages.texts(field)[i] if isinstance(want, str) else messages.columns[field][i]
            if isinstance(want, float):
                np.testing.assert_allclose(float(got), want, rtol=1e-12, atol=0.0, equal_nan=True)
            else:
                assert got == want, (word, field, i)
    reference.close()
    for word, n in seen.items():
        if word not in ("FMT", "FMTU") or mine.binary:
            found = mine.get(word)
            assert found is not None
            assert len(found) == n, word


def test_text_log_of_2014_without_times(shared_data: Path) -> None:
    flight = _flight(shared_data / "ardupilot" / "mechanical_fail.log")
    assert "imu" not in flight
    assert flight.meta.start_utc is not None
    assert flight.meta.start_utc.startswith("2014-01-06T06:19:5")
    assert (np.diff(flight["onboard"].t) > 0.0).all()
    assert any(note.startswith("ATT has no time of its own") for note in flight.notes)
    # Attitude at 10 Hz, placed between the fixes.
    assert flight["onboard"].rate == pytest.approx(10.0, rel=0.2)
    assert np.median(flight["power"]["voltage"]) == pytest.approx(16.0, abs=2.0)


def test_text_log_with_nan(shared_data: Path) -> None:
    flight = _flight(shared_data / "ardupilot" / "nan.log")
    assert flight["imu"].rate == pytest.approx(50.0, rel=0.05)
    assert flight["imu.1"].rate == pytest.approx(50.0, rel=0.05)
    assert "barometer" in flight


def test_beast_sample_has_a_hole(shared_data: Path) -> None:
    imu = _flight(shared_data / "ardupilot" / "beast_sample.bin")["imu"]
    assert np.diff(imu.t).max() == pytest.approx(627.92, abs=0.01)


def test_reading_is_as_fast_as_the_parsers(shared_data: Path) -> None:
    from pyulog import ULog

    path = shared_data / "px4" / "sample.ulg"

    def timed(call: object) -> float:
        assert callable(call)
        best = np.inf
        for _ in range(3):
            start = time.perf_counter()
            call()
            best = min(best, time.perf_counter() - start)
        return float(best)

    assert timed(lambda: read(path)) < 1.3 * timed(lambda: ULog(str(path))) + 0.02


@pytest.mark.parametrize("name", ["px4/sample_log_small.ulg", "ardupilot/log_0041_mechanical_failure.bin", "ardupilot/nan.log"])
@pytest.mark.parametrize("ending", [".ulg", ".bin", ".csv", ""])
def test_format_is_found_by_content(shared_data: Path, tmp_path: Path, name: str, ending: str) -> None:
    shutil.copy(shared_data / name, tmp_path / f"log{ending}")
    assert format_of(tmp_path / f"log{ending}") == format_of(shared_data / name)


@pytest.mark.parametrize("name", ["px4/sample_log_small.ulg", "ardupilot/log_0041_mechanical_failure.bin", "ardupilot/nan.log"])
def test_damage_is_told_and_never_a_traceback(shared_data: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (shared_data / name).read_bytes()
    rng = np.random.default_rng(3)
    path = tmp_path / "log"
    cases = [whole[:n] for n in (1, 7, 8, 16, 100, 1000, 5000, len(whole) // 3, len(whole) - 5)]
    for _ in range(6):
        hurt = bytearray(whole)
        for at in rng.integers(0, len(whole), 40):
            hurt[at] = rng.integers(256)
        cases.append(bytes(hurt))
    hurt = bytearray(whole)
    hurt[len(whole) // 2 : len(whole) // 2 + 5000] = rng.bytes(5000)
    cases.append(bytes(hurt))
    read_ = 0
    for case in cases:
        path.write_bytes(case)
        try:
            flight = read(path)
        except HaltereError as error:
            assert str(path) in str(error)
            assert len(str(error).splitlines()) == 1
        else:
            read_ += 1
            assert len(flight.streams) > 0
    assert read_ >= 5  # damage in one place does not lose the rest
    assert capsys.readouterr().out == ""


def test_damaged_dataflash_keeps_the_rest(shared_data: Path, tmp_path: Path) -> None:
    whole = (shared_data / "ardupilot" / DATAFLASH[0]).read_bytes()
    hole = bytearray(whole)
    hole[900_000:900_400] = bytes(400)
    path = tmp_path / "log.bin"
    path.write_bytes(hole)
    flight, reference = read(path), _flight(shared_data / "ardupilot" / DATAFLASH[0])
    assert any("damaged bytes" in note for note in flight.notes)
    lost = len(reference["imu"]) - len(flight["imu"])
    assert 0 <= lost <= 8
    assert set(flight["imu"].t) <= set(reference["imu"].t)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.ulg", b""),
        ("random.bin", np.random.default_rng(0).bytes(100_000)),
        ("magic.ulg", b"ULog\x01\x12\x35" + np.random.default_rng(1).bytes(5000)),
        ("magic.bin", b"\xa3\x95\x80\x80\x59FMT" + np.random.default_rng(2).bytes(5000)),
        ("words.log", b"To be, or not to be\n" * 50),
        ("fmt.log", b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format\n"),
        ("half.parquet", b"PAR1" + bytes(100)),
        ("photo.jpg", b"\xff\xd8\xff\xe0" + bytes(5000)),
        ("zeros.bin", bytes(10_000)),
    ],
)
def test_what_is_no_log_is_refused(tmp_path: Path, name: str, content: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(HaltereError) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert capsys.readouterr().out == ""


def test_nothing_there_and_wrong_folder(tmp_path: Path) -> None:
    with pytest.raises(HaltereError, match="nothing there"):
        read(tmp_path / "none.ulg")
    with pytest.raises(HaltereError, match=r"formats flight folder"):
        read(tmp_path)


def test_ulog_topics_are_filtered(shared_data: Path) -> None:
    """Only topics that are read are parsed: the rest costs nothing."""
    from haltere.readers._common import Builder

    path = shared_data / "px4" / "sample_log_small.ulg"
    log = Log(path, Builder(path, "PX4 ULog"))
    assert log.one("sensor_combined") is not None
    assert log.one("estimator_status") is None
