"""The readers on logs made here: versions of the formats of which no recording is at hand, and rules that need known values."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from haltere.errors import HaltereError
from haltere.flight.log import FlightLog
from haltere.readers import read
from haltere.readers._common import iso_utc, merge_rows, q_from_euler

# DataFlash

STRUCT = {
    "Q": "Q",
    "B": "B",
    "b": "b",
    "H": "H",
    "h": "h",
    "I": "I",
    "i": "i",
    "f": "f",
    "d": "d",
    "c": "h",
    "C": "H",
    "e": "i",
    "E": "I",
    "L": "i",
}
STRUCT |= {"n": "4s", "N": "16s", "Z": "64s", "M": "B"}
SCALE = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}


class Bin:
    """Writes binary DataFlash messages."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.formats: dict[str, tuple[int, str]] = {}
        self._format(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")

    def _format(self, kind: int, length: int, name: str, letters: str, columns: str) -> None:
        self.data += struct.pack("<BBBBB4s16s64s", 0xA3, 0x95, 0x80, kind, length, name.encode(), letters.encode(), columns.encode())

    def define(self, name: str, letters: str, columns: str) -> None:
        kind = 0x81 + len(self.formats)
        packed = "<" + "".join(STRUCT[c] for c in letters)
        self.formats[name] = kind, letters
        self._format(kind, struct.calcsize(packed) + 3, name, letters, columns)

    def put(self, name: str, *values: object) -> None:
        kind, letters = self.formats[name]
        raw = [round(v / SCALE[c]) if c in SCALE else v.encode() if isinstance(v, str) else v for c, v in zip(letters, values, strict=True)]  # type: ignore[operator]
        self.data += struct.pack("<BBB" + "".join(STRUCT[c] for c in letters), 0xA3, 0x95, kind, *raw)


def _copter(path: Path, *, lane: int = 1, origin: bool = True) -> Path:
    """A minute-scale log as a 4.5 copter writes it: instances in fields, two lanes, ESC telemetry, airspeed."""
    log = Bin()
    log.define("PARM", "QNf", "TimeUS,Name,Value")
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.define("MAG", "QBhhhhhh", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ")
    log.define("GPS", "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U")
    log.define("GPA", "QBCCCCBIH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,VV,SMS,Delta")
    log.define("BARO", "QBffc", "TimeUS,I,Alt,Press,Temp")
    log.define("ARSP", "QBfB", "TimeUS,I,Airspeed,H")
    log.define("ESC", "QBf", "TimeUS,Instance,RPM")
    log.define("RCOU", "QHHHHHH", "TimeUS,C1,C2,C3,C4,C5,C6")
    log.define("BAT", "QBff", "TimeUS,Inst,Volt,Curr")
    log.define("ORGN", "QBLLe", "TimeUS,Type,Lat,Lng,Alt")
    log.define("XKF1", "QBccCffffffccc", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,PN,PE,PD,GX,GY,GZ")
    log.define("XKF2", "QBccccc", "TimeUS,C,AX,AY,AZ,VWN,VWE")
    log.define("XKV2", "QBff", "TimeUS,C,V22,V23")
    log.define("XKF4", "QBb", "TimeUS,C,PI")
    log.define("XKFS", "QBBBBB", "TimeUS,C,MI,BI,GI,AI")
    log.define("POS", "QLLf", "TimeUS,Lat,Lng,Alt")
    log.define("SIM", "QccCfLL", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng")
    for name, value in {
        "SERVO1_FUNCTION": 33,
        "SERVO2_FUNCTION": 34,
        "SERVO3_FUNCTION": 35,
        "SERVO4_FUNCTION": 0,
        "SERVO6_FUNCTION": 36,
    }.items():
        log.put("PARM", 0, name, float(value))
    log.put("PARM", 0, "AHRS_EKF_TYPE", 3.0)
    log.put("MSG", 0, "ArduCopter V4.5.1 (abc)")
    if origin:
        log.put("ORGN", 900_000, 1, 47.5, 8.5, 600.0)
        log.put("ORGN", 900_000, 0, 47.0, 8.0, 500.0)
    for k in range(100):
        us = 1_000_000 + 10_000 * k
        for i in range(2):
            log.put("IMU", us + i, i, 0.1 * i, 0.0, 0.0, 0.0, 0.0, -9.8 - 0.1 * i)
        if k % 10 == 0:
            for i in range(2):
                log.put("MAG", us, i, 200, 10 * i, 400, 5, 6, 7)
                log.put("BARO", us, i, 1.0, 101325.0 / 2.0, 20.0)
            log.put("GPS", us, 0, 3, 10 * k, 2300, 12, 0.8, 47.0, 8.0, 500.0, 5.0, 90.0, -1.0, 0.0, 1)
            log.put("GPA", us + 100, 0, 1.0, 0.5, 0.0 if k else 0.9, 0.3, 1 if k else 0, 0, 0)
            log.put("ARSP", us, 0, 10.0, 1 if k else 0)
            log.put("RCOU", us, 1100, 1200, 1300, 1400, 1500, 2600)
            log.put("BAT", us, 0, 16.0, 5.0)
            log.put("BAT", us, 1, 12.0, 1.0)
            for c in range(2):
                log.put("XKF1", us, c, 1.0 + c, 2.0, 350.0, 3.0, 4.0, 5.0, 6.0 + c, 7.0, 8.0, 0.5, 0.0, -0.5)
                log.put("XKF2", us, c, 0.01, 0.02, 0.03, 2.0 + c, -1.0)
                log.put("XKV2", us, c, 0.25 + c, 0.0)
                log.put("XKF4", us, c, lane)
                log.put("XKFS", us, c, c, c, 0, 0)
            log.put("POS", us + 300, 47.001, 8.001, 510.0)
            log.put("SIM", us, 0.0, 0.0, 90.0, 500.0, 47.0, 8.0)
        for i in (0, 1, 2, 3, 5):
            log.put("ESC", us + 20 * i, i, 6000.0 + i)
    path.write_bytes(log.data)
    return path


def test_ardupilot_of_today(tmp_path: Path) -> None:
    flight = read(_copter(tmp_path / "new.bin"))
    assert flight.meta.home is not None
    assert (flight.meta.home.lat, flight.meta.home.alt) == (47.0, 500.0)  # the estimator's origin, not the place of arming
    assert flight.meta.source.endswith("ArduCopter V4.5.1 (abc)")
    # The primary lane is 1: its sensors come first.
    assert flight["imu"]["accel_z"][0] == pytest.approx(-9.9)
    assert flight["imu.1"]["accel_z"][0] == pytest.approx(-9.8)
    assert flight["magnetometer"]["mag_y"][0] == pytest.approx(1.0)
    assert flight["magnetometer"]["offset_z"][0] == pytest.approx(0.7)
    assert flight["barometer"].t[0] == 0.0
    gnss = flight["gnss"]
    assert gnss["vel_e"][0] == pytest.approx(5.0)
    assert abs(gnss["vel_n"][0]) < 1e-6
    assert np.isnan(gnss["vel_d"][0])  # the receiver says that it has no vertical velocity
    assert gnss["vel_d"][1] == -1.0
    assert gnss["h_acc"].tolist() == [0.5] * 10
    assert gnss["v_acc"][0] == pytest.approx(0.9)
    assert np.isnan(gnss["v_acc"][1:]).all()  # 0 means not given
    assert flight["airdata"]["airspeed"][0] == pytest.approx(10.0 / np.sqrt(0.5 ** (1 - 0.190263)))
    assert flight.discarded == {"airdata": {"airspeed sensor unhealthy": 1}}
    # Rotors by SERVOx_FUNCTION: outputs 1, 2, 3, 6 are motors 1 to 4; output 4 is none.
    rotors, actuators = flight["rotors"], flight["actuators"]
    assert [c for c in rotors.names if c != "t"] == [f"speed_{i}" for i in range(4)]
    assert len(rotors) == 100
    assert rotors["speed_3"][0] == pytest.approx(6005.0 * np.pi / 30.0)
    np.testing.assert_allclose([actuators[f"command_{i}"][0] for i in range(4)], [0.1, 0.2, 0.3, 1.0])
    assert any("ESC instance 3" in note for note in flight.notes)
    assert flight["power.1"]["voltage"][0] == 12.0
    onboard = flight["onboard"]
    rows = np.isfinite(onboard["q_w"])
    assert set(onboard["pos_n"][rows]) == {7.0}  # lane 1 only
    assert set(onboard["wind_n"][rows]) == {3.0}  # VWN is the velocity of the air: it blows to
    np.testing.assert_allclose(onboard["sd_wind_n"][rows], np.sqrt(1.25))
    assert "sd_wind_e" not in onboard  # no variance is no certainty
    assert onboard["gyro_bias_x"][rows][0] == pytest.approx(np.radians(0.5))
    assert onboard["accel_bias_z"][rows][0] == pytest.approx(0.03)
    want = q_from_euler(*(np.radians([a]) for a in (2.0, 2.0, 350.0)))
    for part, values in want.items():
        np.testing.assert_allclose(onboard[part][rows], values[0], atol=1e-12)
    assert np.isfinite(onboard["lat"]).sum() == 10
    assert np.isnan(onboard["lat"][rows]).all()
    assert flight["truth"]["q_z"][0] == pytest.approx(np.sqrt(0.5))
    # Week 2300 begins on 2024-02-04; GPS is 18 s ahead of UTC.
    assert flight.meta.start_utc == "2024-02-03T23:59:42.000Z"


def test_ardupilot_lane_change_and_missing_origin(tmp_path: Path) -> None:
    flight = read(_copter(tmp_path / "log", lane=0, origin=False))
    onboard = flight["onboard"]
    assert "pos_n" not in onboard
    assert flight.meta.home is None
    assert set(onboard["wind_n"][np.isfinite(onboard["wind_n"])]) == {2.0}
    assert flight["imu"]["accel_z"][0] == pytest.approx(-9.8)


def test_made_log_is_what_pymavlink_reads(tmp_path: Path) -> None:
    from pymavlink import DFReader

    from haltere.readers._dataflash import DataFlash

    path = _copter(tmp_path / "new.bin")
    mine, reference = DataFlash(path), DFReader.DFReader_binary(str(path))
    seen: dict[str, int] = {}
    while (message := reference.recv_msg()) is not None:
        word = message.get_type()
        i = seen[word] = seen.get(word, -1) + 1
        found = mine.get(word)
        assert found is not None
        for field in message.get_fieldnames():
            want = getattr(message, field)
            got = found.texts(field)[i] if isinstance(want, str) else found.columns[field][i]
            assert got == want
    reference.close()


# ULog


class Ulg:
    """Writes ULog messages."""

    TYPES: Mapping[str, str] = {
        "uint64_t": "Q",
        "int32_t": "i",
        "uint32_t": "I",
        "uint16_t": "H",
        "float": "f",
        "double": "d",
        "uint8_t": "B",
        "bool": "?",
    }

    def __init__(self) -> None:
        self.head = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))
        self.data = bytearray()
        self.topics: dict[tuple[str, int], tuple[int, str]] = {}
        self.known: dict[str, str] = {}

    def _message(self, out: bytearray, kind: str, body: bytes) -> None:
        out += struct.pack("<Hc", len(body), kind.encode()) + body

    def param(self, name: str, value: int) -> None:
        key = f"int32_t {name}".encode()
        self._message(self.head, "P", struct.pack("<B", len(key)) + key + struct.pack("<i", value))

    def topic(self, name: str, fields: str, rows: Sequence[Sequence[float]], instance: int = 0) -> None:
        """Rows of a topic; fields as ``type name`` or ``type[n] name``, timestamp first and implied."""
        if name not in self.known:
            self.known[name] = fields
            text = ";".join(["uint64_t timestamp", *fields.split(", ")]) + ";"
            self._message(self.head, "F", f"{name}:{text}".encode())
        packed = "<HQ"
        for field in self.known[name].split(", "):
            kind = field.split()[0]
            base, _, count = kind.partition("[")
            packed += self.TYPES[base] * (int(count[:-1]) if count else 1)
        number = len(self.topics)
        self.topics[name, instance] = number, packed
        self._message(self.data, "A", struct.pack("<BH", instance, number) + name.encode())
        for row in rows:
            whole = [int(v) if c in "QiIHB" else v for c, v in zip(packed[2:], row, strict=True)]
            self._message(self.data, "D", struct.pack(packed, number, *whole))

    def save(self, path: Path) -> Path:
        path.write_bytes(self.head + self.data)
        return path


def _imu(log: Ulg, n: int = 100, start: int = 100_000_000, relative: int = 0) -> None:
    fields = "float[3] gyro_rad, int32_t accelerometer_timestamp_relative, float[3] accelerometer_m_s2"
    log.topic("sensor_combined", fields, [(start + 4000 * k, 0.1, 0.2, 0.3, relative, 0.0, 0.0, -9.8) for k in range(n)])


def test_px4_of_today(tmp_path: Path) -> None:
    log = Ulg()
    _imu(log)
    at = 100_000_000
    imu = "uint64_t timestamp_sample, uint32_t accel_device_id, uint32_t gyro_device_id, float[3] delta_angle, float[3] delta_velocity, "
    imu += "uint16_t delta_angle_dt, uint16_t delta_velocity_dt"
    for i in range(3):
        rows: list[tuple[float, ...]] = [
            (at + 500_000 * k, at + 500_000 * k - 300, 10 + i, 10 + i, 4e-4 * i, 0, 0, 0, 0, -0.0392, 4000, 4000) for k in range(2)
        ]
        log.topic("vehicle_imu", imu, rows, instance=i)
    log.topic("sensor_selection", "uint32_t accel_device_id, uint32_t gyro_device_id, uint32_t mag_device_id", [(at, 11, 11, 77)])
    mag = "uint64_t timestamp_sample, uint32_t device_id, float[3] magnetometer_ga"
    log.topic("vehicle_magnetometer", mag, [(at + k, at + k - 50, 66, 0.1, 0.0, 0.4) for k in range(3)], instance=0)
    log.topic("vehicle_magnetometer", mag, [(at + k, at + k - 50, 77, 0.2, 0.0, 0.4) for k in range(3)], instance=1)
    air = "uint32_t baro_device_id, float baro_pressure_pa, float ambient_temperature, float baro_alt_meter"
    log.topic("vehicle_air_data", air, [(at + k, 5, 95000.0, 20.0, 500.0) for k in range(3)])
    log.topic("sensor_baro", "uint32_t device_id, float pressure, float temperature", [(at, 5, 950.0, 20.0), (at + 1, 5, 950.0, 20.0)])
    log.topic(
        "sensor_baro", "uint32_t device_id, float pressure, float temperature", [(at, 6, 951.0, 20.0), (at + 1, 6, 951.0, 20.0)], instance=1
    )
    gps = "uint64_t time_utc_usec, double latitude_deg, double longitude_deg, double altitude_msl_m, float vel_n_m_s, float vel_e_m_s, "
    gps += "float vel_d_m_s, float eph, float epv, float s_variance_m_s, uint8_t fix_type, uint8_t satellites_used, bool vel_ned_valid"
    utc = 1_700_000_000_000_000
    rows = [(0, utc, 1, 1, 1, 0, 0, 0, 1, 1, 1, 0, 0, True)]
    rows += [(at + 200_000 * k, utc + 200_000 * k, 47.0, 8.0, 500.0, 1.0, 2.0, 3.0, 0.5, 0.6, 0.2, 3, 14, k > 0) for k in range(4)]
    log.topic("vehicle_gps_position", gps, rows)
    speed = "float calibrated_airspeed_m_s, float true_airspeed_m_s, uint8_t airspeed_source"
    log.topic("airspeed_validated", speed, [(at, 10.0, 11.0, 1), (at + 1000, 10.0, np.nan, 1), (at + 2000, 10.0, 12.0, 0)])
    log.topic(
        "wind",
        "float windspeed_north, float windspeed_east, float variance_north, float variance_east",
        [(at, 3.0, -2.0, 0.1, 0.1), (at + 9, 3.0, -2.0, 0.1, 0.1)],
    )
    ref = "double ref_lat, double ref_lon, float ref_alt, float x, float y, float z, float vx, float vy, float vz, "
    ref += "bool xy_valid, bool z_valid, bool v_xy_valid, bool v_z_valid, bool xy_global, bool z_global"
    rows = [(at + 100_000 * k, 47.0, 8.0, 500.0, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3, True, True, k > 0, True, k > 1, True) for k in range(4)]
    log.topic("vehicle_local_position", ref, rows)
    log.topic(
        "home_position",
        "double lat, double lon, float alt, bool valid_hpos, bool valid_alt",
        [(at, 47.001, 8.0, 490.0, True, True), (at + 1, 0.0, 0.0, 0.0, False, False)],
    )
    log.topic("vehicle_attitude", "float[4] q", [(at + 50_000 * k, 1.0, 0.0, 0.0, 0.0) for k in range(4)])
    flight = read(log.save(tmp_path / "new"))

    assert flight.meta.imu_kind == "mean"
    assert flight["imu"]["gyro_y"][0] == pytest.approx(0.2)
    # Device 11 is what sensor_combined holds, so units 10 and 12 are the others.
    assert [n for n in flight if n.startswith("imu")] == ["imu", "imu.1", "imu.2"]
    assert flight["imu.2"]["gyro_x"][0] == pytest.approx(8e-4 / 4e-3)
    assert flight["imu.1"]["accel_z"][0] == pytest.approx(-9.8)
    assert flight["magnetometer"]["mag_x"][0] == pytest.approx(20.0)
    assert flight["magnetometer.1"]["mag_x"][0] == pytest.approx(10.0)
    assert flight["barometer"]["temperature"][0] == 20.0
    assert flight["barometer.1"]["pressure"][0] == pytest.approx(95100.0)
    assert "barometer.2" not in flight
    assert len(flight["gnss"]) == 4
    assert flight.discarded["gnss"] == {"velocity that the receiver calls invalid (rows kept, vel NaN)": 1, "time stamp never set": 1}
    assert flight["gnss"]["vel_d"].tolist()[1:] == [3.0] * 3
    assert flight.meta.time_offset == pytest.approx((at - 300) / 1e6)
    assert flight.meta.start_utc == iso_utc(utc - 300)
    assert flight["airdata"]["airspeed"].tolist() == [11.0]
    assert flight.discarded["airdata"] == {"airspeed not of a sensor": 1, "airspeed that the autopilot calls invalid": 1}
    onboard = flight["onboard"]
    assert set(onboard["wind_n"][np.isfinite(onboard["wind_n"])]) == {3.0}
    assert onboard["sd_wind_e"][np.isfinite(onboard["sd_wind_e"])] == pytest.approx(np.sqrt(0.1))
    # Positions count from the named home: the estimator's origin lies 111 m south of it and 10 m above.
    pos = np.isfinite(onboard["pos_n"])
    assert pos.sum() == 2  # before that the origin was not known
    np.testing.assert_allclose(onboard["pos_n"][pos], 1.0 - 111.18, atol=0.05)
    np.testing.assert_allclose(onboard["pos_d"][np.isfinite(onboard["pos_d"])], -13.0, atol=1e-3)
    assert np.isfinite(onboard["vel_n"]).sum() == 3
    assert np.isfinite(onboard["q_w"]).sum() == 4


def test_px4_accelerometer_without_sample(tmp_path: Path) -> None:
    log = Ulg()
    _imu(log, relative=2147483647)
    flight = read(log.save(tmp_path / "log.ulg"))
    assert np.isnan(flight["imu"]["accel_z"]).all()
    assert flight["imu"]["gyro_x"][0] == pytest.approx(0.1)
    assert flight.discarded["imu"] == {"accelerometer without a sample (rows kept, accel NaN)": 100}


def test_px4_constant_times_are_left_out(tmp_path: Path) -> None:
    log = Ulg()
    _imu(log)
    log.topic("vehicle_air_data", "float baro_pressure_pa", [(2_069_758, 95000.0)] * 5)
    flight = read(log.save(tmp_path / "log.ulg"))
    assert "barometer" not in flight
    assert any("vehicle_air_data[0] left out: all 5 samples are stamped 2069758" in note for note in flight.notes)
    assert flight.meta.time_offset == 100.0


def _escs(log: Ulg, functions: Sequence[int], rpm: Sequence[int], flags: int) -> None:
    one = "int32_t esc_rpm;uint8_t actuator_function;"
    log._message(log.head, "F", f"esc_report:uint64_t timestamp;{one}".encode())
    log._message(
        log.head, "F", f"esc_status:uint64_t timestamp;uint8_t esc_count;uint8_t esc_online_flags;esc_report[{len(rpm)}] esc;".encode()
    )
    log._message(log.data, "A", struct.pack("<BH", 0, 99) + b"esc_status")
    for k in range(2):
        at = 100_000_000 + k
        body = struct.pack("<HQBB", 99, at, len(rpm), flags) + b"".join(
            struct.pack("<QiB", at, r, f) for r, f in zip(rpm, functions, strict=True)
        )
        log._message(log.data, "D", body)


def test_px4_rotors_by_function(tmp_path: Path) -> None:
    log = Ulg()
    _imu(log)
    _escs(log, (103, 101, 102, 33), (3000, -1000, 2000, 50), 0b1011)
    flight = read(log.save(tmp_path / "log.ulg"))
    rotors = flight["rotors"]
    assert [c for c in rotors.names if c != "t"] == ["speed_0", "speed_2"]  # the second motor's controller is not online
    assert rotors["speed_0"][0] == pytest.approx(1000 * np.pi / 30)
    assert rotors["speed_2"][0] == pytest.approx(3000 * np.pi / 30)


def test_px4_rotors_without_functions_and_outputs_by_parameter(tmp_path: Path) -> None:
    log = Ulg()
    for channel, function in {1: 102, 2: 101, 3: 201}.items():
        log.param(f"PWM_MAIN_FUNC{channel}", function)
    _imu(log)
    _escs(log, (0, 0), (3000, 1000), 0b11)
    log.topic("actuator_outputs", "float[4] output", [(100_000_000 + k, 1250.0, 1500.0, 1900.0, 900.0) for k in range(2)])
    flight = read(log.save(tmp_path / "log.ulg"))
    assert flight["rotors"]["speed_0"][0] == pytest.approx(3000 * np.pi / 30)
    assert [flight["actuators"][c][0] for c in ("command_0", "command_1")] == [0.5, 0.25]
    assert "command_2" not in flight["actuators"]


def test_damaged_definitions_end(tmp_path: Path) -> None:
    """A message without a type before the data, with a length beyond the file, is where pyulog alone would never end."""
    log = Ulg()
    _imu(log)
    log.head += struct.pack("<HB", 60_000, 0)
    with pytest.raises(HaltereError, match="damage at byte"):
        read(log.save(tmp_path / "log.ulg"))


def test_log_without_sensors_is_refused(tmp_path: Path) -> None:
    log = Ulg()
    log.topic("cpuload", "float load", [(1, 0.5), (2, 0.5)])
    with pytest.raises(HaltereError, match="at least one sensor stream"):
        read(log.save(tmp_path / "log.ulg"))


# Merging


def test_merge_keeps_every_row_of_every_source() -> None:
    us = np.array([30, 10, 10, 20])
    other = np.array([10, 25])
    merged_us, columns = merge_rows([(us, {"a": np.array([3.0, 1.0, 1.5, 2.0])}), (other, {"b": np.array([7.0, 8.0])})])
    assert merged_us.tolist() == [10, 10, 20, 25, 30]
    np.testing.assert_array_equal(columns["a"], [1.0, 1.5, 2.0, np.nan, 3.0])
    np.testing.assert_array_equal(columns["b"], [7.0, np.nan, np.nan, 8.0, np.nan])
    assert merge_rows([])[1] == {}


def test_times_beyond_any_clock_have_no_date() -> None:
    assert iso_utc(0) == "1970-01-01T00:00:00.000Z"
    assert iso_utc(2**62) is None


def test_reading_twice_is_the_same(tmp_path: Path) -> None:
    path = _copter(tmp_path / "log.bin")
    a, b = read(path), read(path)
    assert isinstance(a, FlightLog)
    assert all(a[name] == b[name] for name in a)
