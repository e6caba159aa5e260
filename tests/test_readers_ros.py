"""The ROS reader on bags made here, written by rosbags, and on a MAVROS bag made of a real flight's topics."""

from __future__ import annotations

import ast
import csv
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from haltere.errors import HaltereError
from haltere.flight.door import check
from haltere.flight.log import FlightLog
from haltere.readers import format_of, read
from haltere.readers._rosbag import Channel
from haltere.readers._rosmsg import Decoder, UndecodableError

OWN = {
    "mavros_msgs/msg/State": "std_msgs/Header header\nbool connected\nbool armed\nbool guided\nbool manual_input\nstring mode\n"
    "uint8 system_status\n",
    "mavros_msgs/msg/ESCStatusItem": "std_msgs/Header header\nint32 rpm\nfloat32 voltage\nfloat32 current\n",
    "mavros_msgs/msg/ESCStatus": "std_msgs/Header header\nmavros_msgs/ESCStatusItem[] esc_status\n",
    "px4_msgs/msg/SensorCombined": "uint64 timestamp\nfloat32[3] gyro_rad\nuint32 gyro_integral_dt\n"
    "int32 accelerometer_timestamp_relative\nfloat32[3] accelerometer_m_s2\n"
    "uint32 accelerometer_integral_dt\nuint8 accelerometer_clipping\n",
    "px4_msgs/msg/SensorGps": "uint64 timestamp\nuint64 timestamp_sample\nuint32 device_id\nfloat64 latitude_deg\nfloat64 longitude_deg\n"
    "float64 altitude_msl_m\nfloat64 altitude_ellipsoid_m\nfloat32 s_variance_m_s\nuint8 fix_type\nfloat32 eph\nfloat32 epv\n"
    "float32 vel_n_m_s\nfloat32 vel_e_m_s\nfloat32 vel_d_m_s\nbool vel_ned_valid\nuint64 time_utc_usec\nuint8 satellites_used\n",
    "px4_msgs/msg/VehicleMagnetometer": "uint64 timestamp\nuint64 timestamp_sample\nuint32 device_id\nfloat32[3] magnetometer_ga\n"
    "uint8 calibration_count\n",
    "px4_msgs/msg/VehicleAirData": "uint64 timestamp\nuint64 timestamp_sample\nuint32 baro_device_id\nfloat32 baro_alt_meter\n"
    "float32 baro_temp_celcius\nfloat32 baro_pressure_pa\nfloat32 rho\nuint8 calibration_count\n",
    "px4_msgs/msg/VehicleAttitude": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[4] q\nfloat32[4] delta_q_reset\n"
    "uint8 quat_reset_counter\n",
    "px4_msgs/msg/VehicleLocalPosition": "uint64 timestamp\nuint64 timestamp_sample\nbool xy_valid\nbool z_valid\nbool v_xy_valid\n"
    "bool v_z_valid\nfloat32 x\nfloat32 y\nfloat32 z\nfloat32 vx\nfloat32 vy\nfloat32 vz\nbool xy_global\nbool z_global\nfloat64 ref_lat\n"
    "float64 ref_lon\nfloat32 ref_alt\n",
    "px4_msgs/msg/VehicleOdometry": "uint64 timestamp\nuint64 timestamp_sample\nuint8 pose_frame\nfloat32[3] position\nfloat32[4] q\n"
    "uint8 velocity_frame\nfloat32[3] velocity\n",
    "px4_msgs/msg/VehicleStatus": "uint64 timestamp\nuint64 armed_time\nuint8 arming_state\nuint8 nav_state\n",
}


def _store(base: Stores) -> Any:
    store = get_typestore(base)
    for name, text in OWN.items():
        store.register(get_types_from_msg(text, name))
    return store


ROS1, ROS2 = _store(Stores.ROS1_NOETIC), _store(Stores.ROS2_HUMBLE)
SIZES = {"float64": "f8", "float32": "f4", "bool": "?", "char": "u1", "byte": "u1", "octet": "u1"}
#: A time at which a bag might be recorded [ns].
T0 = 1_700_000_000_123_456_789


def fill(store: Any, kind: str, values: dict[str, Any]) -> Any:
    """A message with some fields set and the others zero or empty."""
    fields = {}
    for name, (node, what) in store.fielddefs[kind][1]:
        value = values.get(name)
        if node == 2:
            fields[name] = fill(store, what, value or {})
        elif node == 1:
            empty = "" if what[0] == "string" else False if what[0] == "bool" else 0
            fields[name] = empty if value is None else value
        else:
            (inner, detail), n = what
            if inner == 2:
                fields[name] = [fill(store, detail, v) for v in (value if value is not None else [{}] * n * (node == 3))]
            elif detail[0] == "string":
                fields[name] = list(value) if value is not None else [""] * n * (node == 3)
            else:
                dtype = SIZES.get(detail[0], detail[0])
                fields[name] = np.array(value if value is not None else np.zeros(n * (node == 3)), dtype=dtype)
    return store.types[kind](**fields)


def xyz(v: Sequence[float]) -> dict[str, float]:
    return {a: float(x) for a, x in zip("xyz", v, strict=True)}


def quaternion(r: Rotation) -> dict[str, float]:
    return {a: float(x) for a, x in zip("xyzw", r.as_quat(), strict=True)}


def header(ns: int, frame: str = "base_link") -> dict[str, Any]:
    return {"stamp": {"sec": int(ns) // 10**9, "nanosec": int(ns) % 10**9}, "frame_id": frame}


#: Topic, type, time of reception [ns] and fields.
Message = tuple[str, str, int, dict[str, Any]]


def write_bag(path: Path, messages: Sequence[Message], compression: str = "") -> Path:
    writer = Writer1(path)
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression])
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, ns, fields in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(connections[topic], ns, ROS1.serialize_ros1(fill(ROS1, kind, fields), kind))
    return path


def write_ros2(path: Path, messages: Sequence[Message], plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE) -> Path:
    writer = Writer2(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, ns, fields in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], ns, ROS2.serialize_cdr(fill(ROS2, kind, fields), kind))
    return path


def _mcap(folder: Path, messages: Sequence[Message], mode: CompressionMode = CompressionMode.NONE) -> Path:
    return next(write_ros2(folder / "bag", messages, StoragePlugin.MCAP, mode).glob("*.mcap*"))


STORAGES: dict[str, Callable[[Path, Sequence[Message]], Path]] = {
    "bag": lambda d, m: write_bag(d / "flight.bag", m),
    "bag bz2": lambda d, m: write_bag(d / "flight.bag", m, "BZ2"),
    "bag lz4": lambda d, m: write_bag(d / "flight.bag", m, "LZ4"),
    "db3 folder": lambda d, m: write_ros2(d / "flight", m, StoragePlugin.SQLITE3),
    "db3 folder, messages compressed": lambda d, m: write_ros2(d / "flight", m, StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "db3 folder, file compressed": lambda d, m: write_ros2(d / "flight", m, StoragePlugin.SQLITE3, CompressionMode.FILE),
    "mcap folder": lambda d, m: write_ros2(d / "flight", m, StoragePlugin.MCAP),
    "mcap folder, file compressed": lambda d, m: write_ros2(d / "flight", m, StoragePlugin.MCAP, CompressionMode.FILE),
    "mcap": _mcap,
    "mcap, chunks compressed": lambda d, m: _mcap(d, m, CompressionMode.STORAGE),
    "db3": lambda d, m: next(write_ros2(d / "flight", m, StoragePlugin.SQLITE3).glob("*.db3")),
}


# A flight in ENU and FLU, and the same in NED and FRD by matrices that the reader does not have

#: Rows: north, east, down in east, north, up; forward, right, down in forward, left, up.
NED_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FLU = np.diag([1.0, -1.0, -1.0])


class Made:
    """Random values in both conventions, and the messages that carry them."""

    def __init__(self, n: int = 400, seed: int = 1, namespace: str = "/mavros") -> None:
        rng = np.random.default_rng(seed)
        self.ns = T0 + np.arange(n, dtype=np.int64) * 5_000_000 + rng.integers(0, 999_999, n)
        self.gyro = rng.normal(0.0, 0.3, (n, 3))
        self.accel = rng.normal([0.0, 0.0, -9.81], 0.5, (n, 3))
        self.mag = rng.normal([20.0, 5.0, 42.0], 1.0, (n, 3))
        self.attitude = Rotation.from_euler("ZYX", rng.uniform([-3.1, -0.5, -0.5], [3.1, 0.5, 0.5], (n, 3)))  # body FRD to NED
        self.position = rng.normal(0.0, 20.0, (n, 3))
        self.velocity = rng.normal(0.0, 5.0, (n, 3))
        self.pressure = rng.normal(95000.0, 30.0, n)
        self.fixes = np.arange(0, n, 40)
        self.place = np.column_stack([46.8 + 1e-5 * np.arange(n), 8.2 + 1e-5 * np.arange(n), 650.0 + 0.1 * np.arange(n)])
        self.namespace = namespace

    def enu_flu(self, i: int) -> Rotation:
        """Body FLU to ENU, by matrices."""
        return Rotation.from_matrix(NED_ENU.T @ self.attitude[i].as_matrix() @ FRD_FLU)

    def messages(self) -> list[Message]:
        out: list[Message] = []
        root = self.namespace
        for i, ns in enumerate(self.ns):
            at = int(ns)
            imu = {
                "header": header(at),
                "angular_velocity": xyz(FRD_FLU.T @ self.gyro[i]),
                "linear_acceleration": xyz(FRD_FLU.T @ self.accel[i]),
            }
            raw = {**imu, "orientation_covariance": [-1.0, *[0.0] * 8]}
            out.append((f"{root}/imu/data_raw", "sensor_msgs/msg/Imu", at + 300_000, raw))
            if i % 4 == 0:
                full = {**imu, "orientation": quaternion(self.enu_flu(i)), "orientation_covariance": np.eye(3).ravel()}
                out.append((f"{root}/imu/data", "sensor_msgs/msg/Imu", at + 310_000, full))
                field = {"header": header(at), "magnetic_field": xyz(FRD_FLU.T @ self.mag[i] * 1e-6)}
                out.append((f"{root}/imu/mag", "sensor_msgs/msg/MagneticField", at + 320_000, field))
                pressure = {"header": header(at), "fluid_pressure": float(self.pressure[i])}
                out.append((f"{root}/imu/static_pressure", "sensor_msgs/msg/FluidPressure", at + 330_000, pressure))
                pose = {"position": xyz(NED_ENU.T @ self.position[i]), "orientation": quaternion(self.enu_flu(i))}
                stamped = {"header": header(at, "map"), "pose": pose}
                out.append((f"{root}/local_position/pose", "geometry_msgs/msg/PoseStamped", at + 340_000, stamped))
                twist = {"header": header(at, "map"), "twist": {"linear": xyz(NED_ENU.T @ self.velocity[i])}}
                out.append((f"{root}/local_position/velocity_local", "geometry_msgs/msg/TwistStamped", at + 350_000, twist))
            if i in self.fixes:
                lat, lon, alt = self.place[i]
                fix = {
                    "header": header(at),
                    "status": {"status": -1 if i == 0 else 0, "service": 1},
                    **{"latitude": lat, "longitude": lon, "altitude": alt},
                    "position_covariance": np.diag([0.25, 1.44, 4.0]).ravel(),
                    "position_covariance_type": 2,
                }
                out.append((f"{root}/global_position/raw/fix", "sensor_msgs/msg/NavSatFix", at + 400_000, fix))
                velocity = {"header": header(at, "map"), "twist": {"linear": xyz([*(NED_ENU.T @ self.velocity[i])[:2], 0.0])}}
                out.append((f"{root}/global_position/raw/gps_vel", "geometry_msgs/msg/TwistStamped", at + 410_000, velocity))
        return out

    def t(self, rows: Any) -> np.ndarray:
        """Times in the flight: whole microseconds from the first sample's."""
        return (self.ns[rows] // 1000 - self.ns[0] // 1000) / 1e6


def matrices(flight: FlightLog, stream: str) -> np.ndarray:
    columns = [flight[stream].get(f"q_{a}") for a in "xyzw"]
    rows = np.isfinite(columns[0])
    return Rotation.from_quat(np.column_stack(columns)[rows]).as_matrix()


@pytest.mark.parametrize("storage", STORAGES)
def test_round_trip(tmp_path: Path, storage: str) -> None:
    made = Made()
    path = STORAGES[storage](tmp_path, made.messages())
    assert format_of(path) == "haltere.readers.ros"
    flight = read(path)
    assert set(flight) == {"imu", "imu.1", "magnetometer", "gnss", "barometer", "onboard"}
    every, fourth = slice(None), slice(None, None, 4)
    imu = flight["imu"]
    np.testing.assert_array_equal(imu.t, made.t(every))
    np.testing.assert_array_equal(imu.vector("gyro"), made.gyro)
    np.testing.assert_array_equal(imu.vector("accel"), made.accel)
    assert imu["accel_z"].mean() < -9.5
    np.testing.assert_array_equal(flight["imu.1"].vector("gyro"), made.gyro[fourth])
    np.testing.assert_allclose(flight["magnetometer"].vector("mag"), made.mag[fourth], rtol=1e-13)
    np.testing.assert_array_equal(flight["barometer"]["pressure"], made.pressure[fourth])
    gnss = flight["gnss"]
    np.testing.assert_array_equal(gnss.t, made.t(made.fixes))
    for name, column in zip(("lat", "lon", "alt"), made.place[made.fixes].T, strict=True):
        np.testing.assert_array_equal(gnss[name], column)
    np.testing.assert_array_equal(gnss["vel_n"], made.velocity[made.fixes, 0])
    np.testing.assert_array_equal(gnss["vel_e"], made.velocity[made.fixes, 1])
    assert "vel_d" not in gnss, "MAVROS never sets the vertical velocity"
    np.testing.assert_array_equal(gnss["h_acc"], 1.2)  # the root of the larger horizontal variance
    np.testing.assert_array_equal(gnss["v_acc"], 2.0)
    np.testing.assert_array_equal(gnss["fix_type"], [0.0, *[3.0] * (len(made.fixes) - 1)])
    onboard = flight["onboard"]
    np.testing.assert_array_equal(onboard.t, made.t(fourth))
    np.testing.assert_allclose(matrices(flight, "onboard"), made.attitude[fourth].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(onboard.vector("pos", "ned"), made.position[fourth], atol=1e-12)
    np.testing.assert_allclose(onboard.vector("vel", "ned"), made.velocity[fourth], atol=1e-12)
    assert flight.meta.start_utc == "2023-11-14T22:13:20.123Z"
    assert flight.meta.time_offset == pytest.approx(T0 / 1e9, abs=1e-3)
    assert any("ellipsoid" in note for note in flight.notes)
    assert any("imu is /mavros/imu/data_raw, imu.1 is /mavros/imu/data" in note for note in flight.notes)
    assert not flight.discarded
    assert len(check(flight).streams["imu"]) == len(imu)


def test_a_level_vehicle_that_looks_north_at_rest(tmp_path: Path) -> None:
    """Values that one can check by hand: ROS gives +g up, a nose to the north at +90 degrees from east, a field that dips down."""
    half = np.sqrt(0.5)
    out: list[Message] = []
    for k in range(60):
        ns = T0 + k * 10**7
        imu = {
            "header": header(ns),
            "linear_acceleration": xyz([0.0, 0.0, 9.81]),
            "angular_velocity": xyz([0.1, 0.2, 0.3 + 1e-3 * k]),
            "orientation": {"w": half, "x": 0.0, "y": 0.0, "z": half * (1.0 + 1e-9 * k)},
        }
        out.append(("/imu/data", "sensor_msgs/msg/Imu", ns, imu))
        out.append(("/imu/mag", "sensor_msgs/msg/MagneticField", ns, {"header": header(ns), "magnetic_field": xyz([21e-6, 0.0, -42e-6])}))
    flight = read(write_bag(tmp_path / "rest.bag", out))
    first = {name: flight["imu"][name][0] for name in flight["imu"].names}
    assert first == {"t": 0.0, "gyro_x": 0.1, "gyro_y": -0.2, "gyro_z": -0.3, "accel_x": 0.0, "accel_y": 0.0, "accel_z": -9.81}
    assert [flight["magnetometer"][f"mag_{a}"][0] for a in "xyz"] == pytest.approx([21.0, 0.0, 42.0])
    q = np.array([flight["onboard"][f"q_{a}"][0] for a in "wxyz"])
    np.testing.assert_allclose(q * np.sign(q[0]), [1.0, 0.0, 0.0, 0.0], atol=1e-9)


# Times


def imus(n: int = 100, topic: str = "/imu/data", step: int = 10**7, start: int = T0, **fields: Any) -> list[Message]:
    rng = np.random.default_rng(len(topic))
    out = []
    for k in range(n):
        ns = start + k * step
        message = {
            "header": header(ns),
            "angular_velocity": xyz(rng.normal(0.0, 0.1, 3)),
            "linear_acceleration": xyz(rng.normal([0.0, 0.0, 9.81], 0.1)),
            "orientation_covariance": [-1.0, *[0.0] * 8],
            **fields,
        }
        out.append((topic, "sensor_msgs/msg/Imu", ns + 200_000, message))
    return out


def test_stamps_that_were_never_set_are_times_of_reception(tmp_path: Path) -> None:
    flight = read(write_bag(tmp_path / "zero.bag", imus(header=header(0))))
    np.testing.assert_allclose(flight["imu"].t, 0.01 * np.arange(100), atol=1e-6)
    assert any("/imu/data: no stamp was set: times are those of reception" in note for note in flight.notes)


def test_some_stamps_that_were_never_set(tmp_path: Path) -> None:
    messages = imus()
    for k in (10, 11, 50):
        messages[k][3]["header"] = header(0)
    flight = read(write_bag(tmp_path / "some.bag", messages))
    np.testing.assert_allclose(flight["imu"].t, 0.01 * np.arange(100), atol=1e-6)
    assert any("3 stamps were never set" in note for note in flight.notes)


def test_a_topic_on_another_clock_is_timed_by_reception(tmp_path: Path) -> None:
    """GPS time runs 18 s ahead of UTC: a receiver that stamps in it must not be put 18 s beside the IMU."""
    messages = imus(200)
    for k in range(10):
        ns = T0 + k * 200_000_000
        messages.append(("/fix", "sensor_msgs/msg/NavSatFix", ns + 50_000_000, {"header": header(ns + 18 * 10**9), "latitude": 46.0}))
    flight = read(write_bag(tmp_path / "clock.bag", messages))
    np.testing.assert_allclose(flight["gnss"].t, 0.2 * np.arange(10) + 0.05, atol=1e-3)
    assert any("/fix: its stamps are 17.9" in note for note in flight.notes)


def test_all_stamps_on_a_clock_of_their_own_are_kept(tmp_path: Path) -> None:
    """A simulator's clock begins at zero; what it stamps stays together."""
    messages = [(topic, kind, ns + 10**15, {**m, "header": header(ns - T0 + 5 * 10**9)}) for topic, kind, ns, m in imus()]
    flight = read(write_bag(tmp_path / "sim.bag", messages))
    assert flight.meta.time_offset == pytest.approx(5.0002)
    assert flight.meta.start_utc is None
    assert any("off the recorder's clock in all topics" in note for note in flight.notes)


def test_nan_and_infinite_values_stay_what_they_are(tmp_path: Path) -> None:
    messages = imus()
    messages[3][3]["angular_velocity"] = {"x": np.nan, "y": np.inf, "z": 0.0}
    flight = read(write_bag(tmp_path / "nan.bag", messages))
    assert len(flight["imu"]) == 100
    assert np.isnan(flight["imu"]["gyro_x"][3])
    assert check(flight).discarded == {"imu": {"not finite": 1}}


# Which topic


def test_several_imus(tmp_path: Path) -> None:
    """Fast before slow, the autopilot's before others, raw before filtered, a camera's axes last; without a gyro it is none."""
    messages = [
        *imus(100, "/camera/imu", 2 * 10**6),
        *imus(40, "/xsens/imu/data", 5 * 10**6),
        *imus(20, "/mavros/imu/data", 10**7),
        *imus(20, "/mavros/imu/data_raw", 10**7),
        *imus(8, "/slow/imu", 25 * 10**6),
        *imus(100, "/camera/accel/sample", 2 * 10**6, angular_velocity=xyz([0.0, 0.0, 0.0])),
        *imus(100, "/camera/gyro/sample", 2 * 10**6, linear_acceleration_covariance=[-1.0, *[0.0] * 8]),
    ]
    flight = read(write_bag(tmp_path / "many.bag", sorted(messages, key=lambda m: m[2])))
    order = ["/mavros/imu/data_raw", "/mavros/imu/data", "/xsens/imu/data", "/camera/imu", "/slow/imu"]
    told = next(note for note in flight.notes if note.startswith("imu is"))
    assert [part.split(" is ")[1] for part in told.split(", ")[:5]] == order
    assert [len(flight[name]) for name in ("imu", "imu.1", "imu.2", "imu.3", "imu.4")] == [20, 20, 40, 100, 8]
    assert "imu.5" not in flight
    assert "/camera/accel/sample left out: it has no angular rate" in flight.notes
    assert "/camera/gyro/sample left out: it has no acceleration" in flight.notes


def twist(topic: str, ns: int, v: Sequence[float], kind: str = "TwistStamped", covariance: float = 0.0) -> Message:
    inner = {"linear": xyz(v)}
    body = inner if kind == "TwistStamped" else {"twist": inner, "covariance": np.eye(6).ravel() * covariance}
    return topic, f"geometry_msgs/msg/{kind}", ns, {"header": header(ns), "twist": body}


def fix(topic: str, ns: int, **fields: Any) -> Message:
    return topic, "sensor_msgs/msg/NavSatFix", ns, {"header": header(ns), "latitude": 46.0, "longitude": 8.0, "altitude": 500.0, **fields}


def test_velocity_with_a_vertical_part_and_its_accuracy(tmp_path: Path) -> None:
    messages = imus()
    for k in range(5):
        ns = T0 + k * 200_000_000
        messages += [fix("/ublox/fix", ns), twist("/ublox/fix_velocity", ns, [1.0, 2.0, 3.0], "TwistWithCovarianceStamped", 0.04)]
    gnss = read(write_bag(tmp_path / "ublox.bag", messages))["gnss"]
    assert len(gnss) == 5
    assert [gnss[f"vel_{a}"][2] for a in "ned"] == [2.0, 1.0, -3.0]
    np.testing.assert_allclose(gnss["s_acc"], 0.2)
    assert "h_acc" not in gnss, "a covariance of unknown type is no accuracy"


def test_a_velocity_stamped_beside_its_fix_is_put_to_it(tmp_path: Path) -> None:
    messages = imus()
    for k in range(5):
        ns = T0 + k * 200_000_000
        messages += [fix("/fix", ns), twist("/vel", ns + 40_000_000, [0.0, float(k), 1.0])]
    messages.append(twist("/vel", T0 + 1_500_000_000, [0.0, 9.0, 1.0]))
    flight = read(write_bag(tmp_path / "nmea.bag", messages))
    gnss = flight["gnss"]
    np.testing.assert_allclose(gnss.t, [0.0, 0.2, 0.4, 0.6, 0.8, 1.5], atol=1e-6)
    np.testing.assert_array_equal(gnss["vel_n"], [0.0, 1.0, 2.0, 3.0, 4.0, 9.0])
    assert np.isnan(gnss["lat"][5])
    assert any("5 velocities stamped apart from their fixes, by up to 40.0 ms" in note for note in flight.notes)


@pytest.mark.parametrize(
    "topic", ["/cmd_vel", "/mavros/setpoint_velocity/cmd_vel", "/mavros/local_position/velocity_body", "/vel_odom", "/a/vel"]
)
def test_a_twist_of_another_meaning_is_no_gnss_velocity(tmp_path: Path, topic: str) -> None:
    messages = imus()
    for k in range(5):
        messages += [fix("/gps/fix", T0 + k * 200_000_000), twist(topic, T0 + k * 200_000_000, [1.0, 2.0, 3.0])]
    flight = read(write_bag(tmp_path / "twist.bag", messages))
    assert "vel_n" not in flight["gnss"]
    assert "onboard" not in flight


def test_two_receivers_keep_their_own_velocities(tmp_path: Path) -> None:
    messages = imus()
    for k in range(6):
        ns = T0 + k * 100_000_000
        messages += [fix("/front/gps/fix", ns), twist("/front/gps/vel", ns, [1.0, 0.0, 1.0])]
        if k % 2:
            messages += [fix("/rear/gps/fix", ns), twist("/rear/gps/vel", ns, [2.0, 0.0, 1.0])]
    flight = read(write_bag(tmp_path / "two.bag", messages))
    assert set(flight["gnss"]["vel_e"]) == {1.0}
    assert set(flight["gnss.1"]["vel_e"]) == {2.0}


def test_mavros_dilutions_are_no_accuracies_and_its_fused_position_no_fix(tmp_path: Path) -> None:
    covariance = {"position_covariance": np.diag([0.4, 0.4, 1.7]).ravel(), "position_covariance_type": 1}
    messages = imus(topic="/mavros/imu/data_raw")
    for k in range(5):
        ns = T0 + k * 200_000_000
        messages += [fix("/mavros/global_position/raw/fix", ns, **covariance), fix("/mavros/global_position/global", ns, **covariance)]
    flight = read(write_bag(tmp_path / "dop.bag", messages))
    assert "h_acc" not in flight["gnss"]
    assert "gnss.1" not in flight
    assert set(flight["onboard"].names) == {"t", "lat", "lon", "alt"}
    others = read(write_bag(tmp_path / "nmea.bag", [*imus(), *(fix("/fix", T0 + k * 10**8, **covariance) for k in range(5))]))
    np.testing.assert_allclose(others["gnss"]["h_acc"], np.sqrt(0.4))  # nmea_navsat_driver's are metres


def test_statuses(tmp_path: Path) -> None:
    messages = imus()
    messages += [fix("/fix", T0 + k * 10**8, status={"status": status}) for k, status in enumerate((-2, -1, 0, 1, 2))]
    gnss = read(write_bag(tmp_path / "status.bag", messages))["gnss"]
    np.testing.assert_array_equal(gnss["fix_type"], [np.nan, 0.0, 3.0, 3.0, 3.0])


def test_pressures(tmp_path: Path) -> None:
    messages = imus()
    for k in range(5):
        ns = T0 + k * 10**8
        for topic, pressure in (("/mavros/imu/static_pressure", 955.0 + k), ("/baro", 95500.0 + k), ("/mavros/imu/diff_pressure", 120.0)):
            messages.append((topic, "sensor_msgs/msg/FluidPressure", ns, {"header": header(ns), "fluid_pressure": pressure}))
    flight = read(write_bag(tmp_path / "baro.bag", messages))
    np.testing.assert_array_equal(flight["barometer"]["pressure"], 95500.0 + 100.0 * np.arange(5))
    np.testing.assert_array_equal(flight["barometer.1"]["pressure"], 95500.0 + np.arange(5))
    assert "barometer.2" not in flight
    assert any("read as hectopascal" in note for note in flight.notes)
    assert any("diff_pressure left out" in note for note in flight.notes)


def test_magnetic_units(tmp_path: Path) -> None:
    """Tesla is what ROS says; gauss is left for the check of the flight to name; MAVROS's own odd factor is known."""

    def of(topic: str, scale: float) -> FlightLog:
        messages = imus()
        for k in range(10):
            ns = T0 + k * 10**8
            field = {"header": header(ns), "magnetic_field": xyz(np.array([20.0, 0.0, -45.0]) * scale)}
            messages.append((topic, "sensor_msgs/msg/MagneticField", ns, field))
        return read(write_bag(tmp_path / f"mag{scale}.bag", messages))

    np.testing.assert_allclose(of("/mag", 1e-6)["magnetometer"]["mag_z"], 45.0)
    gauss = of("/imu/mag", 0.01)
    np.testing.assert_allclose(gauss["magnetometer"]["mag_z"], 45e4)
    assert "magnetometer" not in check(gauss).streams or len(check(gauss).streams["magnetometer"]) == 0
    mavros = of("/mavros/imu/mag", 1e4)  # milligauss times 1000
    np.testing.assert_allclose(mavros["magnetometer"]["mag_z"], 45.0)
    assert any("1000 times milligauss" in note for note in mavros.notes)


def test_battery_current_flows_out(tmp_path: Path) -> None:
    def of(name: str, current: float) -> np.ndarray:
        messages = imus()
        for k in range(5):
            ns = T0 + k * 10**8
            messages.append(("/battery", "sensor_msgs/msg/BatteryState", ns, {"header": header(ns), "voltage": 15.5, "current": current}))
        return read(write_bag(tmp_path / name, messages))["power"]["current"]

    np.testing.assert_array_equal(of("a.bag", -12.5), 12.5)
    np.testing.assert_array_equal(of("b.bag", 12.5), 12.5)


def test_modes_and_rotor_speeds(tmp_path: Path) -> None:
    messages = imus()
    for k, (mode, armed) in enumerate((("", False), ("STABILIZE", False), ("STABILIZE", True), ("STABILIZE", True), ("AUTO.LAND", True))):
        ns = T0 + k * 10**8
        messages.append(
            ("/mavros/state", "mavros_msgs/msg/State", ns, {"header": header(ns), "connected": k > 0, "mode": mode, "armed": armed})
        )
        speeds = [{"header": header(ns), "rpm": r} for r in (6000, -6000, 3000 + k, 0)[: 4 if k != 2 else 2]]
        messages.append(("/mavros/esc_status", "mavros_msgs/msg/ESCStatus", ns, {"header": header(ns), "esc_status": speeds}))
    flight = read(write_bag(tmp_path / "modes.bag", messages))
    modes = flight["modes"]
    assert modes["mode"].tolist() == ["STABILIZE", "STABILIZE", "AUTO.LAND"]
    assert modes["armed"].tolist() == [0.0, 1.0, 1.0]
    np.testing.assert_allclose(modes.t, [0.1, 0.2, 0.4], atol=1e-6)
    rotors = flight["rotors"]
    np.testing.assert_allclose(rotors["speed_0"], 6000 * 2 * np.pi / 60)
    np.testing.assert_allclose(rotors["speed_1"], 6000 * 2 * np.pi / 60)
    np.testing.assert_allclose(rotors["speed_2"] * 60 / (2 * np.pi), [3000, 3001, np.nan, 3003, 3004])


def test_two_vehicles_are_not_mixed(tmp_path: Path) -> None:
    one, two = Made(100, seed=1, namespace="/uav1/mavros"), Made(200, seed=2, namespace="/uav2/mavros")
    flight = read(write_bag(tmp_path / "two.bag", sorted([*one.messages(), *two.messages()], key=lambda m: m[2])))
    alone = read(write_bag(tmp_path / "one.bag", two.messages()))
    assert set(flight) == set(alone)
    assert all(flight[name] == alone[name] for name in alone)
    assert any("several vehicles: read 'uav2', not 'uav1'" in note for note in flight.notes)
    assert flight.discarded["/uav1/mavros/imu/data_raw"] == {"of another vehicle": 100}


# Reference and odometry


def circle(n: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray, Rotation]:
    """Times [s], ENU positions and velocities along a circle, and a body that turns with it, nose along the track, banked."""
    t = 0.02 * np.arange(n)
    a = 0.8 * t
    place = np.column_stack([5.0 * np.cos(a), 5.0 * np.sin(a), 0.3 * t])
    velocity = np.column_stack([-4.0 * np.sin(a), 4.0 * np.cos(a), np.full(n, 0.3)])
    return t, place, velocity, Rotation.from_euler("ZYX", np.column_stack([a + np.pi / 2, np.full(n, 0.1), np.full(n, -0.2)]))


@pytest.mark.parametrize("axes", ["body", "world"])
def test_odometry(tmp_path: Path, axes: str) -> None:
    """A twist is in the body's axes by its definition; a sender that gives the world's is found by its positions and told."""
    t, place, velocity, attitude = circle()
    messages = imus(400)
    for k, s in enumerate(t):
        ns = T0 + round(s * 1e9)
        v = attitude[k].inv().apply(velocity[k]) if axes == "body" else velocity[k]
        pose = {"pose": {"position": xyz(place[k]), "orientation": quaternion(attitude[k])}}
        fields = {"header": header(ns, "world"), "child_frame_id": "base", "pose": pose, "twist": {"twist": {"linear": xyz(v)}}}
        messages.append(("/firefly/ground_truth/odometry", "nav_msgs/msg/Odometry", ns, fields))
    flight = read(write_bag(tmp_path / "odometry.bag", messages))
    truth = flight["truth"]
    np.testing.assert_allclose(truth.vector("vel", "ned"), velocity @ NED_ENU.T, atol=1e-12)
    np.testing.assert_allclose(truth.vector("pos", "ned"), place @ NED_ENU.T, atol=1e-12)
    np.testing.assert_allclose(matrices(flight, "truth"), NED_ENU @ attitude.as_matrix() @ FRD_FLU, atol=1e-12)
    assert any("is in the world's axes" in note for note in flight.notes) == (axes == "world")
    assert "onboard" not in flight


def test_motion_capture(tmp_path: Path) -> None:
    t, place, velocity, attitude = circle(50)
    messages = imus(200)
    for k, s in enumerate(t):
        ns = T0 + round(s * 1e9)
        transform = {"translation": xyz(place[k]), "rotation": quaternion(attitude[k])}
        messages.append(("/vicon/bird/bird", "geometry_msgs/msg/TransformStamped", ns, {"header": header(ns), "transform": transform}))
        pose = {"position": xyz(place[k]), "orientation": quaternion(attitude[k])}
        messages.append(("/odom_pose", "geometry_msgs/msg/PoseStamped", ns, {"header": header(ns), "pose": pose}))
        if k % 2:
            messages.append(("/vrpn_client_node/bird/pose", "geometry_msgs/msg/PoseStamped", ns, {"header": header(ns), "pose": pose}))
            messages.append(twist("/vrpn_client_node/bird/twist", ns, velocity[k]))
    flight = read(write_bag(tmp_path / "vicon.bag", messages))
    assert len(flight["truth"]) == 50
    np.testing.assert_allclose(matrices(flight, "truth"), NED_ENU @ attitude.as_matrix() @ FRD_FLU, atol=1e-12)
    assert "vel_n" not in flight["truth"], "the twist belongs to the other system"
    assert "onboard" not in flight, "a pose of unknown origin is nobody's solution"
    assert any("truth is /vicon/bird/bird" in note and "heading" in note for note in flight.notes)
    assert any("/vrpn_client_node/bird/pose not read" in note for note in flight.notes)


def test_a_quaternion_of_no_length_and_a_constant_one_are_no_attitude(tmp_path: Path) -> None:
    constant = imus(orientation={"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}, orientation_covariance=np.zeros(9))
    assert "onboard" not in read(write_bag(tmp_path / "constant.bag", constant))
    assert "onboard" not in read(write_bag(tmp_path / "zero.bag", imus(orientation_covariance=np.zeros(9))))


# PX4's own messages


def px4_messages(boot: int = 60_000_000) -> tuple[list[Message], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    gyro, accel = rng.normal(0.0, 0.1, (200, 3)).astype("f4"), rng.normal([0, 0, -9.81], 0.1, (200, 3)).astype("f4")
    out: list[Message] = []
    for k in range(200):
        us = boot + 5000 * k
        ns = T0 + 5_000_000 * k
        lost = 2147483647 if k == 7 else 0
        imu = {"timestamp": us, "gyro_rad": gyro[k], "accelerometer_m_s2": accel[k], "accelerometer_timestamp_relative": lost}
        out.append(("/fmu/out/sensor_combined", "px4_msgs/msg/SensorCombined", ns, imu))
        both = {"timestamp": us + 800, "timestamp_sample": us}
        if k % 10 == 0:
            out.append(("/fmu/out/vehicle_attitude", "px4_msgs/msg/VehicleAttitude", ns, {**both, "q": [0.6, 0.0, 0.0, 0.8]}))
            out.append(
                ("/fmu/out/vehicle_magnetometer", "px4_msgs/msg/VehicleMagnetometer", ns, {**both, "magnetometer_ga": [0.2, 0.0, 0.4]})
            )
            air = {**both, "baro_pressure_pa": 95000.0, "baro_alt_meter": 540.0, "baro_temp_celcius": 31.0}
            out.append(("/fmu/out/vehicle_air_data", "px4_msgs/msg/VehicleAirData", ns, air))
            local = {"xy_valid": True, "z_valid": True, "v_xy_valid": k > 50, "v_z_valid": True, "x": 1.0, "y": 2.0, "z": -3.0}
            local |= {
                "vx": 4.0,
                "vy": 5.0,
                "vz": -6.0,
                "xy_global": True,
                "z_global": True,
                "ref_lat": 46.5,
                "ref_lon": 8.5,
                "ref_alt": 500.0,
            }
            out.append(("/fmu/out/vehicle_local_position", "px4_msgs/msg/VehicleLocalPosition", ns, {**both, **local}))
            out.append(
                ("/fmu/in/vehicle_visual_odometry", "px4_msgs/msg/VehicleOdometry", ns, {**both, "pose_frame": 1, "q": [1.0, 0, 0, 0]})
            )
            status = {"timestamp": us, "arming_state": 2 if k >= 100 else 1, "nav_state": 17 if k < 100 else 4}
            out.append(("/fmu/out/vehicle_status_v1", "px4_msgs/msg/VehicleStatus", ns, status))
        if k % 40 == 0:
            gps = {
                **both,
                "latitude_deg": 46.5,
                "longitude_deg": 8.5,
                "altitude_msl_m": 510.0,
                "altitude_ellipsoid_m": 560.0,
                "fix_type": 3,
            }
            gps |= {
                "eph": 0.5,
                "epv": 0.75,
                "s_variance_m_s": 0.25,
                "vel_n_m_s": 1.0,
                "vel_e_m_s": 2.0,
                "vel_d_m_s": 3.0,
                "satellites_used": 17,
            }
            gps |= {"vel_ned_valid": k > 0, "time_utc_usec": 1_750_000_000_000_000 + 5000 * k}
            out.append(("/fmu/out/vehicle_gps_position", "px4_msgs/msg/SensorGps", ns, gps))
    return out, gyro, accel


def test_px4_messages(tmp_path: Path) -> None:
    messages, gyro, accel = px4_messages()
    flight = read(write_ros2(tmp_path / "px4", messages, StoragePlugin.MCAP))
    imu = flight["imu"]
    np.testing.assert_allclose(imu.t, 0.005 * np.arange(200), atol=1e-9)
    np.testing.assert_array_equal(imu.vector("gyro"), gyro)  # PX4's axes are the flight's
    np.testing.assert_array_equal(np.delete(imu.vector("accel"), 7, axis=0), np.delete(accel, 7, axis=0))
    assert np.isnan(imu["accel_z"][7])
    assert flight.meta.imu_kind == "mean"
    assert flight.meta.time_offset == 60.0
    assert flight.meta.start_utc == "2025-06-15T15:06:40.000Z"
    np.testing.assert_allclose([flight["magnetometer"][f"mag_{a}"][0] for a in "xyz"], [20.0, 0.0, 40.0], rtol=1e-6)
    assert [flight["barometer"][c][0] for c in ("pressure", "temperature", "altitude")] == [95000.0, 31.0, 540.0]
    gnss = flight["gnss"]
    assert [gnss[c][1] for c in ("lat", "lon", "alt", "vel_n", "vel_e", "vel_d")] == [46.5, 8.5, 510.0, 1.0, 2.0, 3.0]
    assert [gnss[c][1] for c in ("h_acc", "v_acc", "s_acc", "fix_type", "num_sats")] == [0.5, 0.75, 0.25, 3.0, 17.0]
    assert np.isnan(gnss["vel_n"][0])
    assert flight.meta.home is not None
    assert (flight.meta.home.lat, flight.meta.home.alt) == (46.5, 500.0)
    onboard = flight["onboard"]
    np.testing.assert_allclose([onboard[f"q_{a}"][9] for a in "wxyz"], [0.6, 0.0, 0.0, 0.8], rtol=1e-6)
    assert [onboard[c][9] for c in ("pos_n", "pos_e", "pos_d", "vel_n", "vel_e", "vel_d")] == [1.0, 2.0, -3.0, 4.0, 5.0, -6.0]
    assert np.isnan(onboard["vel_n"][0])
    assert onboard["vel_d"][0] == -6.0
    assert flight["modes"]["mode"].tolist() == ["Takeoff", "Hold"]
    assert flight["modes"]["armed"].tolist() == [0.0, 1.0]


def test_px4_odometry_counts_only_in_north_east_down(tmp_path: Path) -> None:
    messages = [m for m in px4_messages()[0] if "sensor_combined" in m[0]]
    for k, frame in enumerate((1, 2, 1)):
        odometry = {"timestamp": 60_000_000 + 10_000 * k, "pose_frame": frame, "velocity_frame": 3 if k == 2 else frame}
        odometry |= {"position": [1.0, 2.0, 3.0], "q": [0.6, 0.8, 0.0, 0.0], "velocity": [4.0, 5.0, 6.0]}
        messages.append(("/fmu/out/vehicle_odometry", "px4_msgs/msg/VehicleOdometry", T0 + 10_000_000 * k, odometry))
    onboard = read(write_ros2(tmp_path / "odometry", messages, StoragePlugin.MCAP))["onboard"]
    np.testing.assert_array_equal(onboard["pos_e"], [2.0, np.nan, 2.0])
    np.testing.assert_allclose(onboard["q_x"], [0.8, np.nan, 0.8], rtol=1e-6)
    np.testing.assert_array_equal(onboard["vel_n"], [4.0, np.nan, np.nan])


# Definitions


def _without_definitions(folder: Path) -> None:
    """As ROS 2 wrote db3 files before Iron."""
    with sqlite3.connect(next(folder.glob("*.db3"))) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE schema SET schema_version = 3")
    database.close()


def test_without_definitions_common_types_are_known_and_others_told(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "old", [*imus(), *px4_messages()[0][:20]], StoragePlugin.SQLITE3)
    _without_definitions(folder)
    flight = read(folder)
    assert len(flight["imu"]) == 100
    told = next(note for note in flight.notes if note.startswith("not decoded"))
    assert "/fmu/out/sensor_combined (px4_msgs/msg/SensorCombined: the bag does not hold its definition)" in told
    assert "MCAP" in told


def test_nothing_but_types_without_definitions_is_an_error_that_helps(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "px4", px4_messages()[0], StoragePlugin.SQLITE3)
    _without_definitions(folder)
    with pytest.raises(HaltereError, match="ros2 bag convert"):
        read(folder)


def test_a_definition_of_another_shape_is_followed(tmp_path: Path) -> None:
    """A bag's own definition counts, not what this program knows by the type's name."""
    vector = "geometry_msgs/Vector3"
    text = f"string comment\n{vector} linear_acceleration\nfloat64 x\nstd_msgs/Header header\n{vector} angular_velocity\n"
    kind = "sensor_msgs/msg/Imu"
    own = get_typestore(Stores.ROS2_HUMBLE)
    own.fielddefs.pop(kind), own.types.pop(kind)
    own.register(get_types_from_msg(text, kind))
    writer = Writer2(tmp_path / "own", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection("/imu", kind, typestore=own)
        for k in range(50):
            fields = {"comment": "x" * (k % 7), "header": header(T0 + k * 10**7), "angular_velocity": xyz([1, 2, k]), "x": 5.0}
            fields["linear_acceleration"] = xyz([0.0, 0.0, 9.81])
            writer.write(connection, T0 + k * 10**7, own.serialize_cdr(fill(own, kind, fields), kind))
    imu = read(tmp_path / "own")["imu"]
    np.testing.assert_array_equal(imu["gyro_z"], -np.arange(50.0))
    np.testing.assert_array_equal(imu["accel_z"], -9.81)


def _random(store: Any, kind: str, rng: np.random.Generator, lengths: np.random.Generator, depth: int = 0) -> dict[str, Any]:
    out: dict[str, Any] = {}

    def one(node: int, what: Any) -> Any:
        if node == 2:
            return _random(store, what, rng, lengths, depth + 1)
        name = what[0]
        if name == "string":
            return "é" * int(lengths.integers(0, 4))
        if name == "bool":
            return bool(rng.integers(2))
        if name.startswith("float"):
            return float(np.float32(rng.normal()))
        return int(rng.integers(0, 100))

    for name, (node, what) in store.fielddefs[kind][1]:
        if node in (1, 2):
            out[name] = one(node, what)
        else:
            (inner, detail), n = what
            out[name] = [one(inner, detail) for _ in range(n if node == 3 else int(lengths.integers(0, 3)))]
    return out


def _flat(store: Any, value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if hasattr(value, "__msgtype__"):
        for name, _ in store.fielddefs[value.__msgtype__][1]:
            yield from _flat(store, getattr(value, name), f"{path}.{name}" if path else name)
    elif isinstance(value, list | np.ndarray):
        for i, item in enumerate(value):
            yield from _flat(store, item, f"{path}[{i}]")
    else:
        yield path, value


def _plain_paths(store: Any, kind: str, path: str = "") -> Iterator[str]:
    for name, (node, what) in store.fielddefs[kind][1]:
        node, what = (node, what) if node in (1, 2) else what[0]
        here = f"{path}.{name}" if path else name
        yield from _plain_paths(store, what, here) if node == 2 else (here,)


@pytest.mark.parametrize("encoding", ["ros1", "cdr", "cdr, big end first"])
def test_decoder_agrees_with_rosbags_on_every_common_type(encoding: str) -> None:
    """rosbags encodes by generated code, one message at a time; here all types, with strings and sequences of several lengths."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_JAZZY)
    rng = np.random.default_rng(5)
    compared = 0
    for kind in sorted(store.fielddefs):
        if not store.fielddefs[kind][1]:
            continue
        decoder = Decoder(Channel("/x", kind, "", "", "ros1" if encoding == "ros1" else "cdr"), _plain_paths(store, kind))
        messages = [fill(store, kind, _random(store, kind, rng, np.random.default_rng(k % 3))) for k in range(6)]
        for k, message in enumerate(messages):
            if encoding == "ros1":
                raw = store.serialize_ros1(message, kind)
            else:
                raw = store.serialize_cdr(message, kind, little_endian=encoding == "cdr")
            decoder.add(k, bytes(raw))
        ns, numbers, texts = decoder.result()
        assert decoder.bad == 0, f"{kind}: {decoder.why}"
        np.testing.assert_array_equal(ns, np.arange(6))
        for k, message in enumerate(messages):
            for path, value in _flat(store, message):
                if encoding == "ros1" and path.endswith("structure_needs_at_least_one_member"):
                    continue  # in ROS 2 alone has a type without fields a byte
                found = texts[path][k] if isinstance(value, str) else numbers[path][k]
                assert found == value, f"{kind} {path}: {found!r}, not {value!r}"
                compared += 1
    assert compared > 5000


def test_messages_that_cannot_be_decoded_are_counted(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/Imu"
    with Writer1(tmp_path / "short.bag") as writer:
        connection = writer.add_connection("/imu", kind, typestore=ROS1)
        for k, (_, _, ns, fields) in enumerate(imus(30)):
            raw = bytes(ROS1.serialize_ros1(fill(ROS1, kind, fields), kind))
            writer.write(connection, ns, raw[:100] if k % 10 == 0 else raw)
    flight = read(tmp_path / "short.bag")
    assert len(flight["imu"]) == 27
    assert flight.discarded["/imu"] == {"messages that cannot be decoded": 3}


def test_a_text_that_is_no_definition() -> None:
    with pytest.raises(UndecodableError, match="cannot be parsed"):
        Decoder(Channel("/x", "a_msgs/msg/B", "}{ not a definition", "msg", "ros1"), ["x"])
    with pytest.raises(UndecodableError, match="does not hold"):
        Decoder(Channel("/x", "a_msgs/msg/B", "", "", "cdr"), ["x"])


# Files that rosbags does not write


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
def test_mcap_with_ros1_messages_and_with_others(tmp_path: Path, compression: str) -> None:
    """As Foxglove's tools make of a ROS 1 bag; a channel of another encoding is named and left alone."""
    import lz4.frame
    from rosbags.rosbag2.reader import zstd

    kind = "sensor_msgs/msg/Imu"
    definition, _ = ROS1.generate_msgdef(kind)
    body = record(3, struct.pack("<H", 1) + text("sensor_msgs/Imu") + text("ros1msg") + text(definition))
    body += record(4, struct.pack("<HH", 1, 1) + text("/imu/data") + text("ros1") + struct.pack("<I", 0))
    body += record(3, struct.pack("<H", 2) + text("foxglove.Pose") + text("protobuf") + struct.pack("<I", 3) + b"\xff\0\1")
    body += record(4, struct.pack("<HH", 2, 2) + text("/pose") + text("protobuf") + struct.pack("<I", 0))
    for k, (_, _, ns, fields) in enumerate(imus(50)):
        raw = bytes(ROS1.serialize_ros1(fill(ROS1, kind, fields), kind))
        body += record(5, struct.pack("<HIQQ", 1, k, ns, ns) + raw) + record(5, struct.pack("<HIQQ", 2, k, ns, ns) + b"\xff")
    packed = {"": bytes, "lz4": lz4.frame.compress, "zstd": zstd.compress}[compression](body)
    path = tmp_path / "flight.mcap"

    def write(checksum: int) -> None:
        chunk = struct.pack("<QQQI", 0, 0, len(body), checksum) + text(compression) + struct.pack("<Q", len(packed)) + packed
        magic = b"\x89MCAP0\r\n"
        path.write_bytes(
            magic + record(1, text("ros1") + text("")) + record(6, chunk) + record(15, bytes(4)) + record(2, bytes(20)) + magic
        )

    write(zlib.crc32(body) ^ 1)
    with pytest.raises(HaltereError, match="checksum is wrong"):
        read(path)
    write(zlib.crc32(body))
    flight = read(path)
    assert len(flight["imu"]) == 50
    assert flight["imu"]["accel_z"].mean() == pytest.approx(-9.81, abs=0.1)
    assert not any("damaged" in note for note in flight.notes)
    assert "topics of types that are not read: /pose (foxglove.Pose)" in flight.notes


def test_messages_in_a_write_ahead_log_are_read(tmp_path: Path) -> None:
    """ROS 2 writes ahead; after a crash the newest messages are in the file beside the database."""
    folder = write_ros2(tmp_path / "flight", imus(60), StoragePlugin.SQLITE3)
    file = next(folder.glob("*.db3"))
    copy = tmp_path / "crashed"
    copy.mkdir()
    with sqlite3.connect(file) as database:
        database.execute("PRAGMA journal_mode = WAL")
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages").fetchall()
        database.execute("DELETE FROM messages WHERE id > 40")
        database.commit()
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows[40:])
        database.commit()
        for part in folder.iterdir():
            if not part.name.endswith("-shm"):
                (copy / part.name).write_bytes(part.read_bytes())
    database.close()
    assert (copy / f"{file.name}-wal").stat().st_size > 0
    before = {part.name: part.read_bytes() for part in copy.iterdir()}
    assert len(read(copy)["imu"]) == 60
    assert {part.name: part.read_bytes() for part in copy.iterdir()} == before, "reading changes nothing"


# Folders


def test_a_folder_without_metadata(tmp_path: Path) -> None:
    for plugin in StoragePlugin:
        folder = write_ros2(tmp_path / plugin.name, imus(), plugin)
        (folder / "metadata.yaml").unlink()
        assert format_of(folder) == "haltere.readers.ros"
        flight = read(folder)
        assert len(flight["imu"]) == 100
        assert any("no metadata.yaml" in note for note in flight.notes)


def test_a_bag_in_several_files_and_one_of_them_lost(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    names = []
    for part in range(12):
        made = write_ros2(tmp_path / f"part_{part}", imus(30, start=T0 + part * 300_000_000), StoragePlugin.SQLITE3)
        names.append(f"split_{part}.db3")
        next(made.glob("*.db3")).rename(folder / names[-1])
    listed = "\n".join(f"    - {name}" for name in names)
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n{listed}\n")
    assert len(read(folder)["imu"]) == 360
    assert len(read(folder / "metadata.yaml")["imu"]) == 360
    (folder / names[5]).unlink()
    flight = read(folder)
    assert len(flight["imu"]) == 330
    assert any("split_5.db3 is named in metadata.yaml and is not there" in note for note in flight.notes)
    (folder / "metadata.yaml").unlink()
    np.testing.assert_array_equal(np.diff(read(folder)["imu"].t) > 0.0, True)  # part 10 after part 9


def test_a_folder_of_nothing_and_a_database_of_another_kind(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  relative_file_paths: []\n")
    with pytest.raises(HaltereError, match="none of them in the folder"):
        read(folder)
    with sqlite3.connect(tmp_path / "other.db3") as database:
        database.execute("CREATE TABLE people (name TEXT)")
    database.close()
    assert format_of(tmp_path / "other.db3") is None


def test_empty_bags(tmp_path: Path) -> None:
    with Writer1(tmp_path / "empty.bag"):
        pass
    with Writer2(tmp_path / "empty2", version=9, storage_plugin=StoragePlugin.SQLITE3):
        pass
    with Writer2(tmp_path / "empty3", version=9, storage_plugin=StoragePlugin.MCAP):
        pass
    for name in ("empty.bag", "empty2", "empty3"):
        with pytest.raises(HaltereError, match="at least one sensor stream"):
            read(tmp_path / name)


def test_topics_that_are_not_read_are_named(tmp_path: Path) -> None:
    messages = [*imus(), ("/scan", "sensor_msgs/msg/LaserScan", T0, {"header": header(T0)})]
    flight = read(write_bag(tmp_path / "scan.bag", messages))
    assert "topics of types that are not read: /scan (sensor_msgs/msg/LaserScan)" in flight.notes


# Damage


def _file(path: Path) -> Path:
    return next(p for p in sorted(path.iterdir()) if p.suffix != ".yaml") if path.is_dir() else path


@pytest.mark.parametrize("storage", STORAGES)
def test_truncated_anywhere(tmp_path: Path, storage: str) -> None:
    """A flight or one clear error, and once there was a flight, a longer file never holds less."""
    path = STORAGES[storage](tmp_path, Made(800).messages())
    whole = len(read(path)["imu"])
    file = _file(path)
    data = file.read_bytes()
    before, fewer = 0, 0
    for part in range(1, 16):
        file.write_bytes(data[: len(data) * part // 16])
        try:
            flight = read(path)
        except HaltereError:
            assert before == 0
            continue
        assert before <= len(flight["imu"]) <= whole
        before = len(flight["imu"])
        fewer += before > 0
        assert any("damaged" in note for note in flight.notes), part
    if storage.startswith(("bag", "mcap")) and "folder" not in storage:
        assert fewer >= 3  # bz2 gives nothing of a block that is cut


def test_a_bag_that_was_not_closed(tmp_path: Path) -> None:
    """As after a loss of power: no index, index_pos still 0, and the last chunk's length not yet written."""
    data = write_bag(tmp_path / "whole.bag", imus(5000)).read_bytes()
    at = data.index(b"index_pos=") + 10
    (index,) = struct.unpack_from("<Q", data, at)
    last = data.rindex(b"compression=none", 0, index)
    # The chunk header's last field is followed by the length of the chunk.
    end = last + 16
    if data[end : end + 4] != struct.pack("<I", 9):
        length_at = end
    else:
        length_at = end + 4 + 9
    chunk = bytearray(data[:index])
    struct.pack_into("<Q", chunk, at, 0)
    (length,) = struct.unpack_from("<I", chunk, length_at)
    assert 0 < length < len(data)
    struct.pack_into("<I", chunk, length_at, 0)
    del chunk[length_at + 4 + length - 10 :]
    (tmp_path / "flight.bag.active").write_bytes(chunk)
    flight = read(tmp_path / "flight.bag.active")
    assert len(flight["imu"]) == 4999
    assert any("was not closed" in note for note in flight.notes)


def test_a_spoilt_chunk_in_the_middle_loses_that_chunk_alone(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "flight.bag", imus(6000), "BZ2")
    data = bytearray(path.read_bytes())
    first = data.index(b"BZh")
    second = data.index(b"BZh", first + 1)
    data[second + 100 : second + 200] = bytes(100)
    path.write_bytes(data)
    flight = read(path)
    assert 2000 < len(flight["imu"]) < 6000
    assert any("bz2 data" in note for note in flight.notes)


@pytest.mark.parametrize("magic", [b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"])
def test_random_bytes_after_the_magic(tmp_path: Path, magic: bytes) -> None:
    rng = np.random.default_rng(7)
    for k in range(40):
        path = tmp_path / f"{k}.bag"
        body = rng.integers(0, 256 if k % 2 else 8, 3000, dtype=np.uint8).tobytes()
        path.write_bytes(magic + (b" topics messages " if magic.startswith(b"SQL") else b"") + body)
        with pytest.raises(HaltereError):
            read(path)


@pytest.mark.parametrize("storage", ["bag", "bag lz4", "mcap", "mcap, chunks compressed", "db3"])
def test_flipped_bytes(tmp_path: Path, storage: str) -> None:
    path = STORAGES[storage](tmp_path, Made(60).messages())
    data = path.read_bytes()
    rng = np.random.default_rng(11)
    for _ in range(30):
        spoilt = bytearray(data)
        for at in rng.integers(16, len(data), int(rng.integers(1, 6))):  # behind the magic
            spoilt[at] = int(rng.integers(256))
        path.write_bytes(spoilt)
        try:
            read(path)
        except HaltereError as error:
            assert "please report" not in str(error), error


def test_old_bags_are_named(tmp_path: Path) -> None:
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(100))
    with pytest.raises(HaltereError, match="rosbag fix"):
        read(tmp_path / "old.bag")


def test_wind_of_mavros_blows_to_in_every_version(tmp_path: Path) -> None:
    """With covariance it is the air's velocity in east, north, up; without, of before 2018, where it comes from, down and turned round."""
    for kind, covariance, note in (
        ("TwistWithCovarianceStamped", 0.25, ""),
        ("TwistWithCovarianceStamped", 0.0, "mirrored"),
        ("TwistStamped", 0.0, "turned round"),
    ):
        messages = imus()
        for k in range(5):
            ns = T0 + k * 200_000_000
            messages += [fix("/ublox/fix", ns), twist("/mavros/wind_estimation", ns, [1.0, 2.0, 0.5], kind, covariance)]
        flight = read(write_bag(tmp_path / f"{kind}{covariance}.bag", messages))
        onboard = flight["onboard"]
        wind = np.array([onboard[f"wind_{a}"][np.isfinite(onboard[f"wind_{a}"])][0] for a in "ned"])
        np.testing.assert_allclose(wind, np.array([2.0, 1.0, -0.5]) * (1.0 if kind.startswith("TwistWith") else -1.0))
        assert any("wind" in n and note in n for n in flight.notes) == bool(note) or not note
        assert ("sd_wind_n" in onboard) == (covariance > 0.0)
        if covariance:
            assert np.nanmax(onboard["sd_wind_n"]) == pytest.approx(0.5)


# A real flight


ALFA = {
    "imu-data_raw": ("sensor_msgs/msg/Imu", "/mavros/imu/data_raw"),
    "imu-data": ("sensor_msgs/msg/Imu", "/mavros/imu/data"),
    "imu-mag": ("sensor_msgs/msg/MagneticField", "/mavros/imu/mag"),
    "imu-atm_pressure": ("sensor_msgs/msg/FluidPressure", "/mavros/imu/atm_pressure"),
    "global_position-raw-fix": ("sensor_msgs/msg/NavSatFix", "/mavros/global_position/raw/fix"),
    "global_position-raw-gps_vel": ("geometry_msgs/msg/TwistStamped", "/mavros/global_position/raw/gps_vel"),
    "local_position-pose": ("geometry_msgs/msg/PoseStamped", "/mavros/local_position/pose"),
    "local_position-odom": ("nav_msgs/msg/Odometry", "/mavros/local_position/odom"),
    "wind_estimation": ("geometry_msgs/msg/TwistStamped", "/mavros/wind_estimation"),
    "state": ("mavros_msgs/msg/State", "/mavros/state"),
}


def _from_csv(kind: str, row: dict[str, str], path: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, (node, what) in ROS1.fielddefs[kind][1]:
        key = f"{path}.{name}"
        if what == "builtin_interfaces/msg/Time":
            out[name] = {"sec": int(row[f"{key}.secs"]), "nanosec": int(row[f"{key}.nsecs"])}
        elif node == 2:
            out[name] = _from_csv(what, row, key)
        elif key in row:
            value = row[key]
            if node == 1:
                out[name] = value if what[0] == "string" else value == "True" if what[0] == "bool" else float(value)
                out[name] = int(out[name]) if what[0].startswith(("int", "uint")) else out[name]
            else:
                out[name] = ast.literal_eval(value)
    return out


def _rows(folder: Path, name: str) -> list[dict[str, str]]:
    with (folder / f"mavros-{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.real
def test_a_real_mavros_flight(tmp_path: Path, shared_data: Path) -> None:
    folder = shared_data / "alfa_seq1"
    messages: list[Message] = []
    for name, (kind, topic) in ALFA.items():
        for row in _rows(folder, name):
            fields = _from_csv(kind, row)
            stamp = fields["header"]["stamp"]
            messages.append((topic, kind, stamp["sec"] * 10**9 + stamp["nanosec"] + 2_000_000, fields))
    flight = read(write_bag(tmp_path / "alfa.bag", sorted(messages, key=lambda m: m[2])))
    raw, mag = _rows(folder, "imu-data_raw"), _rows(folder, "imu-mag")
    assert len(flight["imu"]) == len(raw)
    assert flight["imu"]["gyro_y"][5] == -float(raw[5][".angular_velocity.y"])
    # The file has 1000 times milligauss; the field near Pittsburgh is 52 uT.
    strength = np.linalg.norm(flight["magnetometer"].vector("mag"), axis=1)
    assert len(mag) == len(strength)
    assert 45.0 < np.median(strength) < 60.0
    # The attitude turns the measured force up, and the velocity that the receiver gives is that of its positions.
    onboard, imu, gnss = flight["onboard"], flight["imu"], flight["gnss"]
    known = np.isfinite(onboard.get("q_w"))
    force = np.column_stack([np.interp(onboard.t[known], imu.t, imu[f"accel_{a}"]) for a in "xyz"])
    mean = np.einsum("nij,nj->ni", matrices(flight, "onboard"), force).mean(axis=0)
    np.testing.assert_allclose(mean, [0.0, 0.0, -9.8], atol=0.5)
    north = np.gradient(np.radians(gnss["lat"]) * 6.37e6, gnss.t)
    east = np.gradient(np.radians(gnss["lon"]) * 6.38e6 * np.cos(np.radians(40.6)), gnss.t)
    assert np.median(np.abs(north - gnss["vel_n"])) < 0.5
    assert np.median(np.abs(east - gnss["vel_e"])) < 0.5
    # The body's velocity of the odometry, turned by its attitude, is the receiver's too; z is positive down.
    both = np.interp(gnss.t, onboard.t[np.isfinite(onboard["vel_n"])], onboard["vel_n"][np.isfinite(onboard["vel_n"])])
    assert np.median(np.abs(both - gnss["vel_n"])) < 1.5
    assert flight["modes"]["mode"].tolist()[0] == "GUIDED"
    # Its wind, of a MAVROS before 2018, closes the triangle with the pitot tube only when it is turned round.
    air = _rows(folder, "vfr_hud")
    t_air = np.array([float(r[".header.stamp.secs"]) + 1e-9 * float(r[".header.stamp.nsecs"]) for r in air]) - flight.meta.time_offset
    C = matrices(flight, "onboard")
    heading = np.unwrap(np.arctan2(C[:, 1, 0], C[:, 0, 0]))
    V, psi = np.interp(gnss.t, t_air, [float(r[".airspeed"]) for r in air]), np.interp(gnss.t, onboard.t[known], heading)
    there = np.isfinite(onboard["wind_n"])
    wind = np.column_stack([np.interp(gnss.t, onboard.t[there], onboard[f"wind_{a}"][there]) for a in "ne"])
    left = np.column_stack([gnss["vel_n"] - V * np.cos(psi), gnss["vel_e"] - V * np.sin(psi)])[V > 12.0]
    off = [float(np.sqrt(np.mean(np.sum((left - sign * wind[V > 12.0]) ** 2, axis=1)))) for sign in (1.0, -1.0)]
    assert off[0] < 0.7 * off[1]
    assert len(check(flight).streams["magnetometer"]) > 1000
