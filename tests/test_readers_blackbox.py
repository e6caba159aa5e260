"""The blackbox reader: units and axes against motion capture and physics on real logs, and every rule on logs made here."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from haltere.errors import HaltereError
from haltere.flight.log import FlightLog
from haltere.readers import format_of, read

pytest.importorskip("orangebox", reason='needs the extra: pip install "haltere[blackbox]"')

LOGS = ("IROS2024_ExperimentData__LOG00230.BFL", "IROS2024_ExperimentData__LOG00267.BFL", "IROS2024_ExperimentData__LOG00281.BFL")
_read: dict[Path, FlightLog] = {}


def _flight(path: Path) -> FlightLog:
    if path not in _read:
        _read[path] = read(path)
    return _read[path]


# Real logs


def _turned(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Products of small turns (n, 3) one after another, scalar last."""
    out = []
    x, y, z, w = 0.0, 0.0, 0.0, 1.0
    for a, b, c, d in Rotation.from_rotvec(angles).as_quat().tolist():
        x, y, z, w = (
            w * a + x * d + y * c - z * b,
            w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d,
            w * d - x * a - y * b - z * c,
        )
        out.append((x, y, z, w))
    return np.array(out)


@pytest.mark.parametrize("name", LOGS)
def test_gyro_turns_as_motion_capture_saw(shared_data: Path, name: str) -> None:
    """Scale and sign of each axis, by regression of the captured turn over four updates on the gyro integrated over the same time.

    The captured body's axes are some degrees off the vehicle's, and updates come in late: hence the width. A wrong sign is -1, deg for
    rad 57, the factor 10 of the high resolution 10.
    """
    flight = _flight(shared_data / "indiflight" / name)
    imu, truth = flight["imu"], flight["truth"]
    turned = _turned(imu.vector("gyro") * np.diff(imu.t, prepend=imu.t[0])[:, None])
    gyro = Rotation.from_quat(turned[np.clip(np.searchsorted(imu.t, truth.t), 0, len(imu) - 1)])
    captured = Rotation.from_quat(np.column_stack([truth[f"q_{a}"] for a in "xyzw"]))
    a, b = ((r[:-4].inv() * r[4:]).as_rotvec() for r in (captured, gyro))
    size = np.linalg.norm(a, axis=1)
    good = (size > 0.1) & (size < 2.2) & (np.linalg.norm(b, axis=1) < 2.5)
    assert good.sum() > 100
    slope = np.linalg.lstsq(b[good], a[good], rcond=None)[0].T
    np.testing.assert_allclose(slope, np.eye(3), atol=0.2)


@pytest.mark.parametrize("name", ("IROS2024_ExperimentData__LOG00257.BFL", *LOGS[1:]))
def test_gyro_turns_as_the_onboard_attitude(shared_data: Path, name: str) -> None:
    """The same against the flight controller's own quaternion, which has no latency: better than three per cent.

    Not on the first log: there the flight controller turns its attitude towards the motion capture's.
    """
    flight = _flight(shared_data / "indiflight" / name)
    imu, onboard = flight["imu"], flight["onboard"]
    q = Rotation.from_quat(np.column_stack([onboard[f"q_{a}"] for a in "xyzw"]))
    n = 25
    turn = (q[:-n].inv() * q[n:]).as_rotvec()
    summed = np.cumsum(imu.vector("gyro") * np.gradient(imu.t)[:, None], axis=0)
    swept = summed[n:] - summed[:-n]
    good = (np.linalg.norm(swept, axis=1) < 0.5) & (imu.t[:-n] < imu.t[-1] - 2.0)  # the landing of some is a crash
    slope = np.linalg.lstsq(swept[good], turn[good], rcond=None)[0].T
    np.testing.assert_allclose(slope, np.eye(3), atol=0.03)


@pytest.mark.parametrize("name", LOGS)
def test_specific_force_and_rotor_speed_agree_with_physics(shared_data: Path, name: str) -> None:
    """Specific force turned north, east, down integrates to the captured vertical velocity; thrust goes with the squares of the speeds."""
    flight = _flight(shared_data / "indiflight" / name)
    imu, truth, onboard, rotors = (flight[s] for s in ("imu", "truth", "onboard", "rotors"))
    q = Rotation.from_quat(np.column_stack([onboard[f"q_{a}"] for a in "xyzw"]))
    down = q.apply(imu.vector("accel"))[:, 2] + 9.80665
    gained = np.interp(truth.t, imu.t, np.cumsum(down * np.gradient(imu.t)))
    L = 20  # a second
    rise = truth["vel_d"][L:] - truth["vel_d"][:-L]
    both = np.polyfit(gained[L:] - gained[:-L], rise, 1)
    assert both[0] == pytest.approx(1.0, abs=0.2)
    speeds = np.column_stack([rotors[f"speed_{i}"] for i in range(4)])
    assert "speed_4" not in rotors
    flying = np.median(speeds, axis=1) > 1500.0
    k = float(np.median(-imu["accel_z"][flying] / (speeds**2).sum(axis=1)[flying]))
    assert 6.0e-7 < k < 7.0e-7  # the same vehicle in every flight
    for i in range(4):
        assert 0.0 <= np.min(rotors[f"command_{i}"]) <= np.max(rotors[f"command_{i}"]) <= 1.0


@pytest.mark.parametrize("name", LOGS)
def test_motion_capture_is_read_once_an_update(shared_data: Path, name: str) -> None:
    flight = _flight(shared_data / "indiflight" / name)
    truth = flight["truth"]
    rate = len(truth) / truth.t[-1]
    assert 16.0 < rate < 21.0
    assert flight["imu"].rate == pytest.approx(504.0, abs=2.0)
    speed = np.gradient(truth["pos_d"], truth.t)
    close = np.abs(truth["vel_d"]) > 0.3
    assert np.polyfit(truth["vel_d"][close], speed[close], 1)[0] == pytest.approx(1.0, abs=0.15)
    assert any("its north is the capture volume's" in n for n in flight.notes)


def test_fixes_made_of_motion_capture_are_not_gnss(shared_data: Path) -> None:
    flight = _flight(shared_data / "indiflight" / LOGS[1])
    assert "gnss" not in flight
    copy, truth = flight["gnss_of_capture"], flight["truth"]
    north = (copy["lat"] - copy["lat"][0]) * 111.2e3
    there = np.interp(copy.t, truth.t, truth["pos_n"])
    assert np.std(north - there) < 0.05
    assert any("made of it" in n for n in flight.notes)


def test_modes_and_clock(shared_data: Path) -> None:
    flight = _flight(shared_data / "indiflight" / LOGS[0])
    modes = flight["modes"]
    assert list(modes["armed"]) == [0.0, 1.0, 1.0, 0.0, 0.0]
    assert modes["mode"][1] == "Angle + Position Control + Learner"
    armed, disarmed = modes.t[1], modes.t[3]
    rotors = flight["rotors"]
    # Rotors turn while armed and stand before.
    assert rotors["speed_0"][rotors.t < armed].max() == 0.0
    assert rotors["speed_0"][(rotors.t > armed) & (rotors.t < disarmed)].max() > 1000.0
    assert flight.meta.start_utc == "2024-02-27T18:22:45.436Z"
    assert flight.meta.source.endswith("Indiflight 5.0.0 (norevision) STM32H743")


def test_damage_and_truncation(shared_data: Path, tmp_path: Path) -> None:
    """Half a file is half a flight; zeroed bytes in it lose some frames, are counted, and leave the rest as it was."""
    data = (shared_data / "indiflight" / "IROS2024_ExperimentData__LOG00259.BFL").read_bytes()
    whole = _flight(shared_data / "indiflight" / "IROS2024_ExperimentData__LOG00259.BFL")
    half = tmp_path / "half.bfl"
    half.write_bytes(data[: len(data) // 2])
    cut = read(half)
    n = len(cut["imu"])
    assert 0.4 * len(whole["imu"]) < n < 0.6 * len(whole["imu"])
    assert np.array_equal(cut["imu"]["gyro_x"], whole["imu"]["gyro_x"][:n])
    assert any("without its end mark" in note for note in cut.notes)
    hurt = bytearray(data)
    middle = len(data) // 2
    hurt[middle : middle + 300] = bytes(300)
    torn = tmp_path / "torn.bfl"
    torn.write_bytes(bytes(hurt))
    flight = read(torn)
    lost = len(whole["imu"]) - len(flight["imu"])
    assert 0 < lost < 100
    assert sum(flight.discarded["imu"].values()) == lost
    assert "imu" not in whole.discarded
    time = whole["imu"].t + whole.meta.time_offset
    rows = np.searchsorted(time, flight["imu"].t + flight.meta.time_offset - 1e-9)
    for column in ("gyro_x", "gyro_z", "accel_y"):
        assert np.array_equal(flight["imu"][column], whole["imu"][column][rows])


# Logs made here: every frame complete, every field whole


def _unsigned(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _signed(value: int) -> bytes:
    return _unsigned(value << 1 if value >= 0 else (-value << 1) - 1)


class Log:
    """Writes a blackbox session; fields are signed, frames complete."""

    def __init__(self, fields: list[str], firmware: str = "Betaflight 4.5.1 (x) STM32F405", **headers: str) -> None:
        self.fields = ["loopIteration", "time", *fields]
        zeros = ",".join("0" for _ in self.fields)
        lines = {
            "Product": "Blackbox flight data recorder by Nicholas Sherlock",
            "Data version": "2",
            "I interval": "1",
            "P interval": "1",
            "Firmware type": "Cleanflight",
            "Firmware revision": firmware,
            "looptime": "1000",
            "acc_1G": "2048",
            "gyro_scale": "0x3f800000",
            "minthrottle": "1000",
            "vbatref": "0",
            "motorOutput": "48,2047",
            "Field I name": ",".join(self.fields),
            **{f"Field I {k}": zeros for k in ("signed", "predictor", "encoding")},
            "Field P predictor": zeros,
            "Field P encoding": zeros,
            "Field S name": "flightModeFlags,stateFlags",
            **{f"Field S {k}": "0,0" for k in ("signed", "predictor", "encoding")},
            "Field G name": "time,GPS_numSat,GPS_coord[0],GPS_coord[1],GPS_altitude,GPS_speed,GPS_ground_course",
            **{f"Field G {k}": "0,0,0,0,0,0,0" for k in ("signed", "predictor", "encoding")},
            **headers,
        }
        self.data = bytearray("".join(f"H {k}:{v}\n" for k, v in lines.items() if v != "-").encode())
        self.n = 0

    def row(self, *values: int) -> None:
        self.data += b"I" + b"".join(_signed(v) for v in (self.n, 1_000_000 + 1000 * self.n, *values))
        self.n += 1

    def slow(self, flags: int) -> None:
        self.data += b"S" + _signed(flags) + _signed(0)

    def gps(self, *values: int) -> None:
        self.data += b"G" + b"".join(_signed(v) for v in (0, *values))

    def end(self) -> bytes:
        self.data += b"E\xff" + b"End of log\0"
        return bytes(self.data)


IMU = [*(f"gyroADC[{i}]" for i in range(3)), *(f"accSmooth[{i}]" for i in range(3))]


def _write(path: Path, log: Log) -> FlightLog:
    path.write_bytes(log.end())
    assert format_of(path) == "haltere.readers.blackbox"
    return read(path)


@pytest.mark.parametrize(
    ("headers", "rate"),
    [
        ({}, 1.0),
        ({"blackbox_high_resolution": "1"}, 0.1),
        ({"gyro_scale": f"0x{struct.unpack('<I', struct.pack('<f', 1 / 16.4))[0]:x}"}, 1 / 16.4),
    ],
)
def test_units_and_axes_come_from_the_header(tmp_path: Path, headers: dict[str, str], rate: float) -> None:
    log = Log(IMU, **headers)
    for _ in range(50):
        log.row(100, 200, -300, 1024, 512, 2048)
    imu = _write(tmp_path / "a.bbl", log)["imu"]
    np.testing.assert_allclose(imu.vector("gyro")[0], np.radians([100 * rate, -200 * rate, 300 * rate]), rtol=1e-6)
    np.testing.assert_allclose(imu.vector("accel")[0], [0.5 * 9.80665, -0.25 * 9.80665, -9.80665], rtol=1e-9)
    assert imu.rate == pytest.approx(1000.0)


def test_unfiltered_fields_are_preferred(tmp_path: Path) -> None:
    log = Log([*IMU, *(f"gyroUnfilt[{i}]" for i in range(3)), *(f"accUnfiltered[{i}]" for i in range(3))])
    for _ in range(30):
        log.row(1, 1, 1, 0, 0, 2048, 2, 2, 2, 0, 0, 4096)
    flight = _write(tmp_path / "a.bbl", log)
    assert flight["imu"]["gyro_x"][0] == pytest.approx(np.radians(2.0))
    assert flight["imu"]["accel_z"][0] == pytest.approx(-2 * 9.80665)
    assert any("gyroUnfilt and accUnfiltered" in n for n in flight.notes)


def test_rotors_power_barometer_and_gnss(tmp_path: Path) -> None:
    fields = [*IMU, "motor[0]", "motor[1]", "eRPM[0]", "eRPM[1]", "vbatLatest", "amperageLatest", "baroAlt", "magADC[0]"]
    log = Log(fields, motor_poles="14")
    for k in range(40):
        if k in (1, 20):
            log.gps(12, *((473977420, 85455940, 4881, 500, 900) if k == 1 else (473977430, 85455940, 4882, 1000, 1800)))
        log.row(0, 0, 0, 0, 0, 2048, 48, 2047, 700, 0, 1680, 250, 100 + k // 10, 5)
    flight = _write(tmp_path / "a.bbl", log)
    rotors = flight["rotors"]
    # 70000 electrical turns a minute, 7 pairs of poles: 10000 of the rotor.
    assert rotors["speed_0"][0] == pytest.approx(10000 * 2 * np.pi / 60)
    assert "speed_1" not in rotors
    assert (rotors["command_0"][0], rotors["command_1"][0]) == (0.0, 1.0)
    assert (flight["power"]["voltage"][0], flight["power"]["current"][0], len(flight["power"])) == (16.8, 2.5, 1)
    np.testing.assert_allclose(flight["barometer"]["altitude"], [1.00, 1.01, 1.02, 1.03])
    np.testing.assert_allclose(flight["barometer"].t, [0.0, 0.01, 0.02, 0.03], atol=1e-9)
    gnss = flight["gnss"]
    np.testing.assert_allclose(gnss["lat"], [47.3977420, 47.3977430])
    np.testing.assert_allclose(gnss["alt"], [488.1, 488.2])
    np.testing.assert_allclose(gnss["vel_e"], [5.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(gnss["vel_n"], [0.0, -10.0], atol=1e-9)
    assert "vel_d" not in gnss
    assert any("magADC left out" in n for n in flight.notes)
    assert "magnetometer" not in flight


def test_without_poles_or_range_nothing_is_guessed(tmp_path: Path) -> None:
    log = Log([*IMU, "motor[0]", "eRPM[0]"], motorOutput="-")
    for _ in range(30):
        log.row(0, 0, 0, 0, 0, 2048, 500, 700)
    flight = _write(tmp_path / "a.bbl", log)
    assert "rotors" not in flight
    assert any("motor_poles" in n for n in flight.notes)
    assert any("motorOutput" in n for n in flight.notes)


@pytest.mark.parametrize(
    ("firmware", "flags", "mode", "armed"),
    [
        ("Betaflight 4.5.1 (x) STM32F405", 0b11, "Angle", 1.0),
        ("Betaflight 4.5.1 (x) STM32F405", 0b1, "Acro", 1.0),
        ("Betaflight 4.3.0 (x) STM32F405", 0b10000001, "GPS Rescue", 1.0),
        ("Betaflight 2025.12.0 (x) STM32F405", 0b1000, "Acro", 0.0),  # bit 3 means another thing by now
        ("Betaflight 3.5.0 (x) STM32F405", 0b100, "Horizon", 0.0),
        ("INAV 7.1.0 (x) MATEK", 0b11, "flags 0x3", np.nan),
    ],
)
def test_modes(tmp_path: Path, firmware: str, flags: int, mode: str, armed: float) -> None:
    log = Log(IMU, firmware)
    for k in range(30):
        log.row(0, 0, 0, 0, 0, 2048)
        if k == 1:
            log.slow(flags)
    modes = _write(tmp_path / "a.bbl", log)["modes"]
    assert list(modes["mode"]) == [mode]
    np.testing.assert_equal(modes.get("armed"), [armed])


def test_the_longest_of_several_sessions_is_read(tmp_path: Path) -> None:
    data = b"garbage before"
    for n in (30, 200, 60):
        log = Log(IMU)
        for _ in range(n):
            log.row(0, 0, 0, 0, 0, 2048)
        data += log.end()
    (tmp_path / "a.bbl").write_bytes(data)
    flight = read(tmp_path / "a.bbl")
    assert 198 <= len(flight["imu"]) <= 200
    assert any("holds 3 sessions" in n and "number 2" in n for n in flight.notes)
    assert any("14 bytes before" in n for n in flight.notes)


def test_a_clock_is_not_made_up(tmp_path: Path) -> None:
    for text, utc in (("0000-01-01T00:00:00.000+00:00", None), ("2024-05-01T12:00:00.500+02:00", "2024-05-01T10:00:00.500Z")):
        log = Log(IMU, **{"Log start datetime": text})
        for _ in range(30):
            log.row(0, 0, 0, 0, 0, 2048)
        assert _write(tmp_path / "a.bbl", log).meta.start_utc == utc


@pytest.mark.parametrize("keep", [45, 300, 900])
def test_a_header_alone_is_one_clear_error(tmp_path: Path, keep: int) -> None:
    (tmp_path / "a.bbl").write_bytes(Log(IMU).end()[:keep])
    with pytest.raises(HaltereError) as caught:
        read(tmp_path / "a.bbl")
    assert "blackbox" in str(caught.value)


def test_random_bytes_after_the_header_end(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        log = Log(IMU)
        for _ in range(40):
            log.row(0, 0, 0, 0, 0, 2048)
        data = bytes(log.data) + rng.bytes(3000)
        (tmp_path / "a.bbl").write_bytes(data)
        flight = read(tmp_path / "a.bbl")
        assert np.isfinite(flight["imu"].t).all()
        assert len(flight["imu"]) >= 39


def test_without_the_extra_the_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.bbl").write_bytes(Log(IMU).end())
    monkeypatch.setitem(sys.modules, "orangebox", None)
    with pytest.raises(HaltereError, match=r'pip install "haltere\[blackbox\]"'):
        read(tmp_path / "a.bbl")
