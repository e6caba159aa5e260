"""A ROS bag's topics as columns on one clock. It chooses no topic and turns no axis."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haltere.readers._common import Builder, Columns, FloatArray, IntArray
from haltere.readers._rosbag import Channel, messages, storages
from haltere.readers._rosmsg import Decoder, UndecodableError

__all__ = ["Topic", "Topics", "enu_to_ned", "flu_to_frd", "of_autopilot"]

#: A stamp further than this [s] from the time of reception, once the clocks' usual distance is taken off, was never set.
STRAY_STAMP = 60.0
#: Two topics whose stamps differ by more than this [s] from their reception were stamped by two clocks.
CLOCK_LIMIT = 2.0


def _xyz(*stems: str) -> list[str]:
    return [f"{stem}.{axis}" for stem in stems for axis in "xyz"]


def _q(stem: str) -> list[str]:
    return [f"{stem}.{part}" for part in "wxyz"]


STAMP = ["header.stamp.sec", "header.stamp.nanosec"]
PX4_STAMP = ["timestamp", "timestamp_sample"]
#: Fields that are read, by type.
FIELDS: dict[str, list[str]] = {
    "sensor_msgs/msg/Imu": [
        *_q("orientation"),
        *_xyz("angular_velocity", "linear_acceleration"),
        *("orientation_covariance[0]", "angular_velocity_covariance[0]", "linear_acceleration_covariance[0]"),
    ],
    "sensor_msgs/msg/MagneticField": _xyz("magnetic_field"),
    "sensor_msgs/msg/NavSatFix": [
        *("status.status", "latitude", "longitude", "altitude", "position_covariance_type"),
        *("position_covariance[0]", "position_covariance[4]", "position_covariance[8]"),
    ],
    "sensor_msgs/msg/FluidPressure": ["fluid_pressure"],
    "sensor_msgs/msg/BatteryState": ["voltage", "current"],
    "geometry_msgs/msg/TwistStamped": _xyz("twist.linear"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": [*_xyz("twist.twist.linear"), "twist.covariance[0]", "twist.covariance[7]"],
    "geometry_msgs/msg/PoseStamped": [*_xyz("pose.position"), *_q("pose.orientation")],
    "geometry_msgs/msg/PoseWithCovarianceStamped": [*_xyz("pose.pose.position"), *_q("pose.pose.orientation")],
    "geometry_msgs/msg/TransformStamped": [*_xyz("transform.translation"), *_q("transform.rotation")],
    "geometry_msgs/msg/PointStamped": _xyz("point"),
    "nav_msgs/msg/Odometry": [*_xyz("pose.pose.position", "twist.twist.linear"), *_q("pose.pose.orientation")],
    "mavros_msgs/msg/State": ["mode", "armed", "connected"],
    "mavros_msgs/msg/ESCStatus": ["esc_status.rpm"],
    "mavros_msgs/msg/ESCTelemetry": ["esc_telemetry.rpm"],
    "px4_msgs/msg/SensorCombined": ["gyro_rad", "accelerometer_m_s2", "accelerometer_timestamp_relative"],
    "px4_msgs/msg/VehicleMagnetometer": ["magnetometer_ga"],
    "px4_msgs/msg/VehicleAirData": ["baro_pressure_pa", "baro_alt_meter", "baro_temp_celcius", "ambient_temperature"],
    "px4_msgs/msg/SensorGps": [],
    "px4_msgs/msg/VehicleGpsPosition": [],
    "px4_msgs/msg/AirspeedValidated": ["true_airspeed_m_s", "airspeed_source", "selected_airspeed_index"],
    "px4_msgs/msg/BatteryStatus": ["voltage_v", "current_a"],
    "px4_msgs/msg/EscStatus": ["esc_count", "esc_online_flags", "esc.esc_rpm", "esc.actuator_function"],
    "px4_msgs/msg/VehicleStatus": ["nav_state", "arming_state"],
    "px4_msgs/msg/VehicleAttitude": ["q"],
    "px4_msgs/msg/VehicleLocalPosition": [
        *("x", "y", "z", "vx", "vy", "vz", "xy_valid", "z_valid", "v_xy_valid", "v_z_valid"),
        *("xy_global", "z_global", "ref_lat", "ref_lon", "ref_alt"),
    ],
    "px4_msgs/msg/VehicleGlobalPosition": ["lat", "lon", "alt"],
    "px4_msgs/msg/VehicleOdometry": ["pose_frame", "velocity_frame", "position", "q", "velocity"],
    "px4_msgs/msg/Wind": ["windspeed_north", "windspeed_east", "variance_north", "variance_east"],
}
_GPS = [
    *("lat", "lon", "alt", "latitude_deg", "longitude_deg", "altitude_msl_m", "vel_n_m_s", "vel_e_m_s", "vel_d_m_s", "vel_ned_valid"),
    *("eph", "epv", "s_variance_m_s", "fix_type", "satellites_used", "time_utc_usec"),
]
FIELDS["px4_msgs/msg/SensorGps"] = FIELDS["px4_msgs/msg/VehicleGpsPosition"] = _GPS


IMUS = ("sensor_msgs/msg/Imu", "px4_msgs/msg/SensorCombined")


class Topic:
    """One topic of one type as columns.

    Parameters
    ----------
    name, msgtype
        Topic, and type as ``package/msg/Type``.
    ns
        Time of reception [ns].
    numbers, texts
        Column by dotted field name.
    """

    def __init__(
        self, name: str, msgtype: str, ns: IntArray, numbers: dict[str, FloatArray], texts: dict[str, NDArray[np.str_]] | None = None
    ) -> None:
        self.name, self.msgtype, self.ns, self.numbers, self.texts = name, msgtype, ns, numbers, texts or {}
        self.us: IntArray = ns // 1000

    def __contains__(self, field: object) -> bool:
        return field in self.numbers

    def __len__(self) -> int:
        return len(self.ns)

    @property
    def words(self) -> list[str]:
        """Parts of the topic's name in small letters."""
        return [word for word in self.name.lower().split("/") if word]

    @property
    def place(self) -> str:
        """The name without its last part."""
        return self.name.rpartition("/")[0]

    @property
    def vehicle(self) -> str:
        """What stands before MAVROS's or PX4's own part of the name."""
        words = self.name.strip("/").split("/")
        return "/".join(words[: next((i for i, word in enumerate(words) if word == "fmu" or "mavros" in word.lower()), len(words))])

    @property
    def rate(self) -> float:
        """Samples a second over the topic's own span [Hz]."""
        span = float(np.ptp(self.us)) if len(self.us) else 0.0
        return 1e6 * (len(self) - 1) / span if span > 0.0 else 0.0

    def get(self, *fields: str, scale: float = 1.0) -> FloatArray:
        """First of several columns that is there, scaled; NaN where none is."""
        for field in fields:
            if field in self.numbers:
                return self.numbers[field] * scale
        return np.full(len(self), np.nan)

    def where(self, keep: NDArray[np.bool_]) -> Topic:
        """Rows picked by a mask."""
        picked = Topic(self.name, self.msgtype, self.ns[keep], {k: v[keep] for k, v in self.numbers.items()})
        picked.texts = {k: v[keep] for k, v in self.texts.items()}
        picked.us = self.us[keep]
        return picked

    def sent_ns(self) -> IntArray:
        """Stamps that the sender set [ns], 0 where it set none."""
        if STAMP[0] in self.numbers:
            seconds, nanoseconds = self.get(STAMP[0]), self.get(STAMP[1])
            good = (seconds >= 0.0) & (nanoseconds >= 0.0)
            return np.where(good, np.nan_to_num(seconds).astype(np.int64) * 1_000_000_000 + np.nan_to_num(nanoseconds).astype(np.int64), 0)
        stamp = np.nan_to_num(self.get("timestamp"))
        sample = np.nan_to_num(self.get("timestamp_sample"))
        us = np.where(sample > 0.0, sample, stamp)
        return np.where((us > 0.0) & (us < 9e15), us, 0.0).astype(np.int64) * 1000


class Topics:
    """The topics of a bag that are read, on one clock.

    Parameters
    ----------
    path
        Bag file or folder.
    builder
        Told of damage, of topics that could not be decoded or are not read, and of stamps that were not used.
    """

    def __init__(self, path: Path, builder: Builder) -> None:
        self.builder = builder
        self._topics: list[Topic] = []
        decoders: dict[tuple[str, str], Decoder] = {}
        self._load(path, decoders)
        for (name, msgtype), decoder in decoders.items():
            ns, numbers, texts = decoder.result()
            if decoder.bad:
                builder.discard(name, "messages that cannot be decoded", decoder.bad)
                builder.note(f"{name}: {decoder.bad} messages cannot be decoded ({decoder.why})")
            if len(ns):
                self._topics.append(Topic(name, msgtype, ns, numbers, texts))
        self._one_vehicle()
        self._set_clock()

    def __iter__(self) -> Iterator[Topic]:
        return iter(self._topics)

    def of(self, *types: str) -> list[Topic]:
        """Topics of some types, given without ``msg``: ``sensor_msgs/Imu``. PX4's inputs (``/fmu/in/``) are no output of its."""
        wanted = {kind.replace("/", "/msg/") for kind in types}
        return [t for t in self._topics if t.msgtype in wanted and not (t.msgtype.startswith("px4_msgs/") and "in" in t.words)]

    def _load(self, path: Path, decoders: dict[tuple[str, str], Decoder]) -> None:
        builder = self.builder
        unread: dict[str, str] = {}
        undecodable: dict[str, str] = {}

        def wanted(channel: Channel) -> bool:
            key = channel.topic, channel.msgtype
            if key in decoders:
                return decoders[key].channel.encoding == channel.encoding
            fields = FIELDS.get(channel.msgtype)
            if fields is None or channel.encoding not in ("ros1", "cdr"):
                unread[channel.topic] = channel.msgtype or channel.encoding
                return False
            try:
                stamp = PX4_STAMP if channel.msgtype.startswith("px4_msgs/") else STAMP
                decoders[key] = Decoder(channel, [*fields, *stamp])
            except UndecodableError as why:
                undecodable[channel.topic] = f"{channel.msgtype}: {why}"
                return False
            return True

        for file in storages(path, builder):
            for channel, ns, data in messages(file, wanted, builder):
                decoders[channel.topic, channel.msgtype].add(ns, data)
        if undecodable:
            listed = ", ".join(f"{name} ({why})" for name, why in sorted(undecodable.items()))
            builder.note(
                f"not decoded: {listed}; record as MCAP, or convert with `ros2 bag convert` to MCAP where the packages of these types are "
                "installed: its files hold the definitions"
            )
        if unread:
            shown = [f"{name} ({kind})" for name, kind in sorted(unread.items())]
            more = f" and {len(shown) - 12} more" if len(shown) > 12 else ""
            builder.note(f"topics of types that are not read: {', '.join(shown[:12])}{more}")

    def _one_vehicle(self) -> None:
        """Leave out the topics of all autopilots but the one with the most IMU samples: sensors of two vehicles make no flight."""
        samples: dict[str, int] = {}
        for topic in filter(of_autopilot, self._topics):
            imu = topic.msgtype in IMUS
            samples[topic.vehicle] = max(samples.get(topic.vehicle, 0), len(topic) if imu else 0)
        if len(samples) > 1:
            chosen = max(sorted(samples), key=lambda vehicle: samples[vehicle])
            others = ", ".join(sorted(repr(vehicle) for vehicle in samples if vehicle != chosen))
            self.builder.note(f"the bag holds several vehicles: read {chosen!r}, not {others}; cut the bag by topic to read another")
            left = [t for t in self._topics if of_autopilot(t) and t.vehicle != chosen]
            for topic in left:
                self.builder.discard(topic.name, "of another vehicle", len(topic))
            self._topics = [t for t in self._topics if t not in left]

    def _set_clock(self) -> None:
        """Put every topic on the clock of the stamps that the IMU's sender set; what has no such stamp comes by its reception."""
        offsets: dict[int, float] = {}
        sent = [topic.sent_ns() for topic in self._topics]
        for i, (topic, stamps) in enumerate(zip(self._topics, sent, strict=True)):
            if (stamps > 0).any():
                offsets[i] = float(np.median((stamps - topic.ns)[stamps > 0])) / 1e9
        leading = [i for i in offsets if self._topics[i].msgtype in IMUS] or list(offsets)
        # The topics that agree among themselves lead, so that one sender's odd clock moves none but itself.
        reference = float(np.median([offsets[i] for i in leading])) if leading else 0.0
        if leading:
            reference = min((offsets[i] for i in leading), key=lambda o: abs(o - reference))
        shift = round(reference * 1e9)
        for i, (topic, stamps) in enumerate(zip(self._topics, sent, strict=True)):
            received = topic.ns + shift
            if i not in offsets:
                self.builder.note(f"{topic.name}: no stamp was set: times are those of reception")
                topic.us = received // 1000
                continue
            if abs(offsets[i] - reference) > CLOCK_LIMIT:
                self.builder.note(
                    f"{topic.name}: its stamps are {offsets[i] - reference:.3f} s off the clock of the others: times are those of reception"
                )
                topic.us = received // 1000
                continue
            own = round(offsets[i] * 1e9)
            stray = (stamps <= 0) | (np.abs(stamps - topic.ns - own) > STRAY_STAMP * 1e9)
            if stray.any():
                self.builder.note(
                    f"{topic.name}: {int(stray.sum())} stamps were never set or make no sense: there it is the time of reception"
                )
            topic.us = np.where(stray, topic.ns + own, stamps) // 1000
        if abs(reference) > CLOCK_LIMIT:
            self.builder.note(f"stamps are {reference:.3f} s off the recorder's clock in all topics: times are the stamps'")


def of_autopilot(topic: Topic) -> bool:
    """Whether a topic comes from the autopilot: PX4's own messages, or MAVROS's."""
    return topic.msgtype.startswith("px4_msgs/") or any("mavros" in word for word in topic.words)


def flu_to_frd(topic: Topic, field: str, out: str, scale: float = 1.0) -> Columns:
    """A vector's components in the body axes forward, right, down, from forward, left, up."""
    return {f"{out}_{a}": topic.get(f"{field}.{a}", scale=sign * scale) for a, sign in (("x", 1.0), ("y", -1.0), ("z", -1.0))}


def enu_to_ned(topic: Topic, field: str, out: str) -> Columns:
    """A vector's components north, east, down, from east, north, up."""
    return {f"{out}_{to}": topic.get(f"{field}.{a}", scale=sign) for to, a, sign in (("n", "y", 1.0), ("e", "x", 1.0), ("d", "z", -1.0))}
