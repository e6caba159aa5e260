"""haltere info and haltere convert, and what a log supports."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from haltere.cli.convert import convert
from haltere.cli.info import info, summary
from haltere.errors import HaltereError
from haltere.flight.folder import read_folder
from haltere.flight.log import FlightLog, FlightMeta
from haltere.readers import read
from haltere.readers._settings import SETTINGS, settings_of
from haltere.readers.support import ESTIMATORS, doubts, streams, support


def _flight(rate: float = 100.0, source: str = "PX4 ULog: x", without: tuple[str, ...] = ()) -> FlightLog:
    t = np.arange(0.0, 10.0, 1.0 / rate)
    slow = np.arange(0.0, 10.0, 0.2)
    one, z = np.ones_like(slow), np.zeros_like(t)
    fix = {"lat": 47.4 * one, "lon": 8.5 * one, "alt": 500.0 * one, "vel_n": 0 * one, "vel_e": 0 * one, "vel_d": 0 * one}
    flight = FlightLog(
        {
            "imu": {"t": t, "gyro_x": z, "gyro_y": z, "gyro_z": z, "accel_x": z, "accel_y": z, "accel_z": z - 9.81},
            "magnetometer": {"t": slow, "mag_x": 20 * one, "mag_y": 0 * one, "mag_z": 40 * one},
            "gnss": {"t": slow, **fix, "fix_type": 3 * one},
            "barometer": {"t": slow, "pressure": 1e5 * one},
        },
        FlightMeta(name="made", source=source),
    )
    return flight.without(*without)


def _by_name(flight: FlightLog) -> dict[str, tuple[str, str, str]]:
    return {s.estimator: (s.verdict, " | ".join(s.cannot), " | ".join(s.remedies)) for s in support(flight)}


def test_a_complete_log_is_supported() -> None:
    assert {s.estimator: s.verdict for s in support(_flight())} == {
        "navigator": "yes",
        "ahrs": "yes",
        "two-stage": "yes",
        "wind-attitude": "yes",
    }


@pytest.mark.parametrize(
    ("without", "navigator", "ahrs", "said"),
    [
        (("imu",), "no", "no", "no imu stream"),
        (("gnss",), "limited", "yes", "no gnss stream"),
        (("magnetometer",), "limited", "limited", "no magnetometer"),
        (("barometer",), "limited", "yes", "barometric height"),
        (("gnss", "magnetometer", "barometer"), "limited", "limited", "neither magnetometer nor GNSS"),
    ],
)
def test_what_is_missing_is_named_with_its_cure(without: tuple[str, ...], navigator: str, ahrs: str, said: str) -> None:
    for source, cure in (("PX4 ULog: x", "SDLOG_PROFILE"), ("ArduPilot DataFlash: x", "LOG_BITMASK"), ("table: x", "record")):
        found = _by_name(_flight(source=source, without=without))
        assert (found["navigator"][0], found["ahrs"][0]) == (navigator, ahrs)
        assert said in found["navigator"][1]
        assert cure in found["navigator"][2]


def test_every_estimator_is_judged_and_every_origin_has_every_setting() -> None:
    from haltere.estimators.registry import SPECIFICATIONS

    # One line each; an estimator without one would be silently left out of `haltere info`.
    assert {"navigator", "ahrs"} <= set(ESTIMATORS) <= set(SPECIFICATIONS)
    keys = set(settings_of(""))
    for origin, settings in SETTINGS.items():
        assert set(settings) == keys, origin
        assert settings_of(f"{origin}: log") is settings


@pytest.mark.parametrize(
    ("source", "without", "words"),
    [
        ("PX4 ULog: x", (), "esc_status 5"),
        ("PX4 ULog: x", (), "SDLOG_PROFILE has bit 4"),
        ("ArduPilot DataFlash: x", (), "SERVO_BLH_BDMASK"),
        ("ArduPilot DataFlash: x", ("magnetometer",), "13 on Copter"),
        ("Blackbox: x", (), "dshot_bidir = ON"),
        ("Blackbox: x", ("imu",), "blackbox_sample_rate"),
        ("Blackbox: x", ("magnetometer",), "record the compass elsewhere"),
        ("ROS bag: x", ("magnetometer", "barometer"), "add /fmu/out/vehicle_air_data"),
        ("DJI DatCon CSV: x", ("magnetometer",), "counts"),
    ],
)
def test_the_setting_that_helps_is_named(source: str, without: tuple[str, ...], words: str) -> None:
    assert words in _by_name(_flight(source=source, without=without))["navigator"][2]


def test_missing_velocity_has_its_own_cure() -> None:
    for column, said in (("vel_n", "only positions"), ("vel_d", "vertical velocity")):
        flight = _flight()
        flight["gnss"].columns[column][:] = np.nan
        _, cannot, remedies = _by_name(flight)["navigator"]
        assert said in cannot
        assert "vel_ned_valid" in remedies


def test_suspicious_units_are_told() -> None:
    flight = _flight(source="table: x")
    flight["magnetometer"].columns["mag_x"] *= 1e-2
    flight["magnetometer"].columns["mag_z"] *= 1e-2
    assert doubts(_flight()) == []
    (doubt,) = [d for d in doubts(flight) if "gauss" in d]
    assert "magnetometer" in doubt
    assert summary(flight)["doubts"] == doubts(flight)


def test_the_rate_of_a_solution_is_that_of_its_attitude() -> None:
    """Rows of several topics lie between each other: attitude at 10 Hz and position half way between, once a second."""
    from haltere.metrics.summary import _attitudes

    fast, slow = np.arange(0.0, 10.0, 0.1), np.arange(0.05, 10.0, 1.0)
    t = np.sort(np.r_[fast, slow])
    q = np.where(np.isin(t, fast), 1.0, np.nan)
    stream = FlightLog({"onboard": {"t": t, "q_w": q, "pos_n": np.where(np.isin(t, slow), 5.0, np.nan)}})["onboard"]
    assert _attitudes(stream).rate == pytest.approx(10.0)
    (numbers,) = streams(FlightLog({"onboard": stream}))
    assert numbers.rate == pytest.approx(10.0)
    assert numbers.gaps == 0


def test_modes_have_no_rate() -> None:
    flight = FlightLog({"modes": {"t": [0.0, 1.0, 100.0], "mode": ["a", "b", "c"]}})
    (modes,) = streams(flight)
    assert np.isnan(modes.rate)
    assert modes.gaps == 0
    assert summary(flight)["streams"]["modes"]["rate"] is None


def test_slow_imu_is_limited_and_too_slow_is_refused() -> None:
    assert _by_name(_flight(rate=25.0))["navigator"][0] == "limited"
    verdict, cannot, remedies = _by_name(_flight(rate=4.0, source="ArduPilot DataFlash: x"))["ahrs"]
    assert verdict == "no"
    assert "Hz" in cannot
    assert "bit 18" in remedies


def test_gnss_without_fix_does_not_count() -> None:
    flight = _flight()
    flight["gnss"].columns["fix_type"][:] = 1.0
    assert "no 3-D fix" in _by_name(flight)["navigator"][1]


def test_rates_tell_stretches_from_the_whole(shared_data: Path) -> None:
    flight = read(shared_data / "ardupilot" / "beast_sample.bin")
    imu = next(s for s in streams(flight) if s.name == "imu")
    assert imu.rate == pytest.approx(25.0, rel=0.01)
    assert imu.mean_rate == pytest.approx(2.6, rel=0.01)
    assert imu.gaps == 1
    assert imu.largest_gap_at == pytest.approx(42.76, abs=0.01)
    verdict, cannot, _ = _by_name(flight)["navigator"]
    assert verdict == "limited"
    assert "627.9 s" in cannot
    assert "too slow" in cannot


def test_info_prints_streams_notes_and_verdicts(shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    info(shared_data / "ardupilot" / "log_0041_mechanical_failure.bin")
    out = capsys.readouterr().out
    for word in (
        "imu.2",
        "[m/s^2]",
        "rad/s",
        "home 13.0658397",
        "2019-03-13T12:37:00",
        "navigator",
        "ahrs",
        "LOG_BITMASK",
        "already corrected",
    ):
        assert word in out


def test_info_json_is_only_json(shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    info(shared_data / "px4" / "sample_px4_events.ulg", json=True)
    out = json.loads(capsys.readouterr().out)
    assert out["streams"]["imu"]["n"] == 7783
    assert out["streams"]["imu"]["columns"]["accel_x"] == "m/s^2"
    assert out["estimators"]["navigator"]["verdict"] == "yes"
    assert out["home"]["lat"] == pytest.approx(47.3977, abs=1e-4)
    assert out["time_offset"] == pytest.approx(1710773350.318)


def test_summary_has_no_nan() -> None:
    text = json.dumps(summary(FlightLog({"imu": {"t": [np.nan]}, "gnss": {"t": [1.0], "lat": [np.nan]}})), allow_nan=False)
    assert "NaN" not in text


@pytest.mark.parametrize("csv", [False, True])
def test_convert_loses_nothing(shared_data: Path, tmp_path: Path, csv: bool, capsys: pytest.CaptureFixture[str]) -> None:
    log = shared_data / "px4" / "sample_log_small.ulg"
    convert(log, tmp_path / "out", csv=csv, json=True)
    shown = json.loads(capsys.readouterr().out)
    assert shown["folder"] == str(tmp_path / "out")
    a, b = read(log), read_folder(tmp_path / "out")
    assert all(a[name] == b[name] for name in a)
    assert (a.meta, a.notes, a.discarded) == (b.meta, b.notes, b.discarded)


def test_convert_says_what_was_discarded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "log.csv").write_text("t,gyro_x\n0,1\n,2\n")
    convert(tmp_path / "log.csv", tmp_path / "out")
    shown = capsys.readouterr()
    assert "no time stamp" in shown.err
    assert "imu: 1 samples" in shown.out


def test_info_on_nothing(tmp_path: Path) -> None:
    with pytest.raises(HaltereError, match="nothing there"):
        info(tmp_path / "no.ulg")


def test_what_feels_the_air_is_named_and_its_absence_is_no_lack() -> None:
    flight = _flight()
    t, one = flight["gnss"].t, np.ones(len(flight["gnss"]))
    speeds = {"t": t} | {f"speed_{k}": 500.0 * one for k in range(4)}
    commands = {"t": t} | {f"command_{k}": 0.4 * one for k in range(3)} | {"command_3": 0.0 * one}
    pitot = {"t": t, "airspeed": 15.0 * one}
    for streams_, said in (
        ({"rotors": speeds}, "wind from the drag of 4 rotors"),
        ({"rotors": commands}, "wind from the drag of 3 rotors"),
        ({"airdata": pitot}, "wind from the airspeed"),
        ({"airdata": pitot | {"aoa": 0.1 * one, "sideslip": 0.0 * one}}, "wind from the airspeed and vanes"),
        ({"rotors": {"t": t, "speed_0": 500.0 * one}}, None),
        ({}, None),
    ):
        found = {s.estimator: s for s in support(FlightLog({**flight.streams, **streams_}, flight.meta))}
        assert [c for c in found["navigator"].can if c.startswith("wind")] == ([said] if said else [])
        assert found["navigator"].verdict == "yes"
        assert not any("wind" in c for c in found["ahrs"].can)
    blind = FlightLog({**flight.without("gnss").streams, "rotors": speeds}, flight.meta)
    assert not any("wind" in c for s in support(blind) for c in s.can)
