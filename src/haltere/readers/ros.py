"""Reading ROS 1 bags, ROS 2 bags and MCAP files into a FlightLog by message type. It turns axes and units as ROS defines them.

ROS measures in forward, left, up (REP 103, 145), and east, north, up; px4_msgs are in PX4's own axes, which are those of a flight here.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from haltere.readers._common import GAUSS, RPM, UTC_FLOOR_US, Builder, Columns, FloatArray, merge_rows
from haltere.readers._modes import add_modes, px4_mode
from haltere.readers._ros_solution import REFERENCE, add_onboard, add_truth, set_home
from haltere.readers._ros_topics import Topic, Topics, enu_to_ned, flu_to_frd, of_autopilot
from haltere.readers._rosbag import BAG_MAGIC, DB3_MAGIC, MCAP_MAGIC, ZSTD_MAGIC

if TYPE_CHECKING:
    from haltere.flight.log import FlightLog

__all__ = ["read", "sniff"]

#: Tesla to microtesla.
TESLA = 1e6
#: MAVROS multiplies milligauss by 1000 where tesla are due (mavlink/mavros#1855): the factor from its number to microtesla, and the number
#: above which it can be nothing else.
MAVROS_FIELD, MAVROS_FIELD_FLOOR = 1e-4, 2e4
#: A static pressure between these [Pa] is one in hectopascal: MAVROS passes HIGHRES_IMU on as it comes.
HECTOPASCAL = (100.0, 1200.0)
#: ``accelerometer_timestamp_relative`` of a message without an accelerometer sample.
INVALID_RELATIVE = 2147483647
#: ``actuator_function`` of the first motor.
MOTOR_1 = 101
#: An IMU at this rate [Hz] goes before a slower one.
FAST = 50.0
#: NavSatFix: ``position_covariance_type`` without, and approximated from the dilution of precision.
UNKNOWN_COVARIANCE, APPROXIMATED_COVARIANCE = 0.0, 1.0
#: What a ROS 2 bag's metadata.yaml begins with, and its files' names.
ROSBAG2 = b"rosbag2_bagfile_information"
BAG_NAMES = re.compile(r"\.(db3|mcap)(\.zstd)?$")
NED = ("n", "e", "d")


def sniff(path: Path, head: bytes) -> bool:
    """Whether a path is a ROS bag, an MCAP file, a ROS 2 bag's SQLite file, or a ROS 2 bag folder."""
    if path.is_dir():
        try:
            metadata = path / "metadata.yaml"
            if metadata.is_file() and ROSBAG2 in metadata.read_bytes()[:65536]:
                return True
            return any(BAG_NAMES.search(file.name) for file in path.iterdir())
        except OSError:
            return False
    if head.startswith(DB3_MAGIC):
        return b"messages" in head and b"topics" in head
    if path.name == "metadata.yaml":
        return ROSBAG2 in head
    return head.startswith((BAG_MAGIC, MCAP_MAGIC)) or bool(head.startswith(ZSTD_MAGIC) and BAG_NAMES.search(path.name))


def read(path: Path) -> FlightLog:
    """Read a ROS 1 bag, a ROS 2 bag or an MCAP file.

    Parameters
    ----------
    path
        A ``.bag``, ``.mcap`` or ``.db3`` file, or a ROS 2 bag folder (with or without its ``metadata.yaml``). A file that was cut or not
        closed is read up to there.

    Returns
    -------
    FlightLog
        In NED/FRD. Which topic became which stream is in ``notes``. Times are the stamps of the messages' headers, or the times of
        reception where these were not set. ``alt`` of a NavSatFix is the height above the ellipsoid, which ROS gives.

    Raises
    ------
    HaltereError
        The file cannot be read, or holds no message of a type that is read.

    Notes
    -----
    Types and frames after REP 103, REP 145 and the message definitions; MAVROS's topics after its plugins' sources.
    """
    if path.name == "metadata.yaml" and not path.is_dir():
        path = path.parent
    builder = Builder(path, "ROS bag")
    topics = Topics(path, builder)
    _add_imu(topics, builder)
    _add_magnetometer(topics, builder)
    _add_gnss(topics, builder)
    _add_barometer(topics, builder)
    _add_airdata(topics, builder)
    _add_rotors(topics, builder)
    _add_power(topics, builder)
    _add_modes(topics, builder)
    set_home(topics, builder)
    add_onboard(topics, builder)
    add_truth(topics, builder)
    if builder.utc is None:
        spans = [span for span in map(builder.span, ("imu", "gnss", "magnetometer", "barometer")) if span]
        if spans and spans[0][0] > UTC_FLOOR_US:
            builder.utc = (spans[0][0], spans[0][0])
    return builder.build()


def _numbered(stream: str, i: int) -> str:
    return stream if i == 0 else f"{stream}.{i}"


def _ranked(topics: list[Topic]) -> list[Topic]:
    """The autopilot's own first, then by the number of samples."""
    return sorted(topics, key=lambda t: (not of_autopilot(t), -len(t), t.name))


# IMU


def _add_imu(topics: Topics, builder: Builder) -> None:
    combined = topics.of("px4_msgs/SensorCombined")
    units: list[tuple[Topic, Columns]] = []
    for topic in combined:
        columns = _px4_vector(topic, "gyro_rad", "gyro") | _px4_vector(topic, "accelerometer_m_s2", "accel")
        lost = topic.get("accelerometer_timestamp_relative") == INVALID_RELATIVE
        for name in ("accel_x", "accel_y", "accel_z"):
            columns[name][lost] = np.nan
        builder.discard("imu", "accelerometer without a sample (rows kept, accel NaN)", int(lost.sum()))
        units.append((topic, columns))
    for topic in _imu_order(topics.of("sensor_msgs/Imu")):
        columns = {}
        for field, out in (("angular_velocity", "gyro"), ("linear_acceleration", "accel")):
            part = flu_to_frd(topic, field, out)
            # REP 145: a first covariance of -1 says that the device does not measure this.
            absent = topic.get(f"{field}_covariance[0]") == -1.0
            if not np.any([v[~absent] != 0.0 for v in part.values()]):
                absent[:] = True
            for values in part.values():
                values[absent] = np.nan
            columns |= part
        lacking = [word for word, out in (("angular rate", "gyro_x"), ("acceleration", "accel_x")) if np.isnan(columns[out]).all()]
        if lacking:
            builder.note(f"{topic.name} left out: it has no {' and no '.join(lacking)}")
            continue
        units.append((topic, columns))
    for i, (topic, columns) in enumerate(units):
        builder.add(_numbered("imu", i), topic.us, columns)
    if combined:
        builder.meta.imu_kind = "mean"
    if units:
        told = [f"{_numbered('imu', i)} is {topic.name}" for i, (topic, _) in enumerate(units)]
        turned = "" if combined else ", axes forward, left, up turned to forward, right, down"
        builder.note(f"{', '.join(told)}{turned}")


def _imu_order(found: list[Topic]) -> list[Topic]:
    """Fast ones first, then the autopilot's, then those in the vehicle's axes; of one device the raw topic before the filtered one."""

    def raw(topic: Topic) -> bool:
        return "raw" in topic.words[-1] if topic.words else False

    def leader(topic: Topic) -> Topic:
        beside = [t for t in found if t.place == topic.place]
        return next((t for t in beside if raw(t)), max(beside, key=len))

    def camera(topic: Topic) -> bool:
        return any(word in topic.name.lower() for word in ("camera", "realsense", "optical", "zed", "oak", "rovio"))

    def key(topic: Topic) -> tuple[object, ...]:
        first = leader(topic)
        return first.rate < FAST, not of_autopilot(first), camera(first), -len(first), first.name, topic is not first, -len(topic)

    return sorted(found, key=key)


def _px4_vector(topic: Topic, field: str, out: str, scale: float = 1.0, axes: str = "xyz") -> Columns:
    return {f"{out}_{a}": topic.get(f"{field}[{i}]", scale=scale) for i, a in enumerate(axes)}


# Magnetometer


def _add_magnetometer(topics: Topics, builder: Builder) -> None:
    found = [t for t in topics.of("px4_msgs/VehicleMagnetometer", "sensor_msgs/MagneticField")]
    found.sort(key=lambda t: (not t.msgtype.startswith("px4_msgs/"), not of_autopilot(t), -len(t), t.name))
    for i, topic in enumerate(found):
        name = _numbered("magnetometer", i)
        if topic.msgtype.startswith("px4_msgs/"):
            columns = _px4_vector(topic, "magnetometer_ga", "mag", scale=GAUSS)
        else:
            columns = flu_to_frd(topic, "magnetic_field", "mag", scale=TESLA)
            strength = np.sqrt(sum(v * v for v in columns.values())) / TESLA
            known = strength[np.isfinite(strength) & (strength > 0.0)]
            middle = float(np.median(known)) if len(known) else np.nan
            if middle > MAVROS_FIELD_FLOOR and of_autopilot(topic):
                columns = {k: v / TESLA * MAVROS_FIELD for k, v in columns.items()}
                builder.note(
                    f"{name}: {topic.name} holds a median of {middle:.3g} where tesla are due: read as 1000 times milligauss, which MAVROS "
                    f"gives for RAW_IMU and SCALED_IMU (mavlink/mavros#1855), {middle * MAVROS_FIELD:.3g} uT"
                )
        builder.add(name, topic.us, columns)
    if len(found) > 1:
        builder.note(", ".join(f"{_numbered('magnetometer', i)} is {t.name}" for i, t in enumerate(found)))


# GNSS


def _add_gnss(topics: Topics, builder: Builder) -> None:
    i = 0
    for gps in topics.of("px4_msgs/SensorGps", "px4_msgs/VehicleGpsPosition"):
        builder.add(_numbered("gnss", i), gps.us, _px4_gnss(gps, _numbered("gnss", i), builder))
        i += 1
    fixes = [t for t in topics.of("sensor_msgs/NavSatFix") if not REFERENCE.search(t.name.lower())]
    fused = [t for t in fixes if t.words[-2:] == ["global_position", "global"] or t.words[-1:] in (["filtered"], ["fused"])]
    for topic in fused:
        builder.note(f"{topic.name} is no receiver's fix but a filter's output: not read as gnss")
    velocities = [t for t in topics.of("geometry_msgs/TwistStamped", "geometry_msgs/TwistWithCovarianceStamped") if _is_gnss_velocity(t)]
    used: list[Topic] = []
    for fix in _ranked([t for t in fixes if t not in fused]):
        name = _numbered("gnss", i)
        columns = _fix(fix, name, builder)
        velocity = _nearest_by_name(fix, [v for v in velocities if v not in used])
        if velocity is None:
            builder.note(f"{name} is {fix.name}, without a velocity topic")
            builder.add(name, fix.us, columns)
        else:
            used.append(velocity)
            builder.note(f"{name} is {fix.name}, its velocity {velocity.name} (east, north, up)")
            builder.add(name, *merge_rows([(fix.us, columns), _beside(fix, velocity, _velocity(velocity, name, builder), name, builder)]))
        i += 1
    for topic in velocities:
        if topic not in used:
            if not builder.has("gnss"):
                builder.note(f"gnss is the velocity of {topic.name} alone: there is no fix")
                builder.add("gnss", topic.us, _velocity(topic, "gnss", builder))
            else:
                builder.note(f"{topic.name} not read: it is the velocity of no fix topic")


def _px4_gnss(gps: Topic, name: str, builder: Builder) -> Columns:
    new = "latitude_deg" in gps
    velocity = {f"vel_{a}": gps.get(f"vel_{a}_m_s") for a in NED}
    lost = gps.get("vel_ned_valid") == 0.0
    for values in velocity.values():
        values[lost] = np.nan
    builder.discard(name, "velocity that the receiver calls invalid (rows kept, vel NaN)", int(lost.sum()))
    utc = gps.get("time_utc_usec")
    known = np.flatnonzero((utc > UTC_FLOOR_US) & (utc < 9e15) & (gps.get("fix_type") >= 3.0))
    if builder.utc is None and len(known):
        builder.utc = (int(gps.us[known[0]]), int(utc[known[0]]))
    return {
        "lat": gps.get("latitude_deg") if new else gps.get("lat", scale=1e-7),
        "lon": gps.get("longitude_deg") if new else gps.get("lon", scale=1e-7),
        "alt": gps.get("altitude_msl_m") if new else gps.get("alt", scale=1e-3),
        **velocity,
        "h_acc": gps.get("eph"),
        "v_acc": gps.get("epv"),
        "s_acc": gps.get("s_variance_m_s"),  # an accuracy, despite its name
        "fix_type": gps.get("fix_type"),
        "num_sats": gps.get("satellites_used"),
    }


def _fix(fix: Topic, name: str, builder: Builder) -> Columns:
    """Columns of a NavSatFix; ``h_acc`` is the root of the larger horizontal variance."""
    status, kind = fix.get("status.status"), fix.get("position_covariance_type")
    fix_type = np.where(status >= 0.0, 3.0, np.where(status == -1.0, 0.0, np.nan))
    east, north, up = (fix.get(f"position_covariance[{i}]") for i in (0, 4, 8))
    h_acc, v_acc = _root(np.maximum(east, north)), _root(up)
    useless = np.isnan(kind) | (kind == UNKNOWN_COVARIANCE)
    if of_autopilot(fix):
        diluted = kind == APPROXIMATED_COVARIANCE
        if diluted.any():
            builder.note(f"{name}: {fix.name} has dilutions of precision for accuracies, as MAVROS does without MAVLink 2: not read")
        useless |= diluted
    h_acc[useless] = np.nan
    v_acc[useless] = np.nan
    builder.note(f"{name} alt is above the WGS-84 ellipsoid, as ROS defines it: above mean sea level it is less by the geoid's height")
    place = {"lat": fix.get("latitude"), "lon": fix.get("longitude"), "alt": fix.get("altitude")}
    return {**place, "h_acc": h_acc, "v_acc": v_acc, "fix_type": fix_type}


def _root(variance: FloatArray) -> FloatArray:
    """Standard deviation, NaN where a variance is none."""
    return np.sqrt(np.where(variance > 0.0, variance, np.nan))


def _is_gnss_velocity(topic: Topic) -> bool:
    """Topics that their drivers document as a receiver's velocity in east, north, up: MAVROS, ublox, nmea_navsat_driver."""
    words = topic.words
    if not words or REFERENCE.search(topic.name.lower()):
        return False
    under = any(re.search(r"gps|gnss|ublox|nmea|navsat|novatel|septentrio", word) for word in words[:-1])
    return words[-1] in ("fix_velocity", "gps_vel") or (words[-1] == "vel" and (under or len(words) == 1))


def _nearest_by_name(fix: Topic, velocities: list[Topic]) -> Topic | None:
    """The velocity topic whose name begins most like the fix's; one of another receiver's namespace is not its."""

    def shared(topic: Topic) -> int:
        ours, theirs = fix.words[:-1], topic.words[:-1]
        return next((i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b), min(len(ours), len(theirs)))

    fitting = [v for v in velocities if shared(v) == len(v.words) - 1 or shared(v) > 0]
    return max(fitting, key=lambda v: (shared(v), len(v))) if fitting else None


def _velocity(topic: Topic, name: str, builder: Builder) -> Columns:
    stem = "twist.twist.linear" if topic.msgtype.endswith("TwistWithCovarianceStamped") else "twist.linear"
    columns = enu_to_ned(topic, stem, "vel")
    if not np.nan_to_num(columns["vel_d"]).any():
        builder.note(f"{name}: {topic.name} has no vertical velocity (all zero, its driver never sets it): no vel_d")
        del columns["vel_d"]
    return {**columns, "s_acc": _root(np.maximum(topic.get("twist.covariance[0]"), topic.get("twist.covariance[7]")))}


def _beside(fix: Topic, velocity: Topic, columns: Columns, name: str, builder: Builder) -> tuple[NDArray[np.int64], Columns]:
    """A velocity's rows at the stamps of their fixes: the same stamp, or the nearest within half the fixes' interval."""
    us = velocity.us.copy()
    order = np.argsort(fix.us, kind="stable")
    stamps = fix.us[order]
    if len(stamps) < 2:
        return us, columns
    after = np.clip(np.searchsorted(stamps, us), 1, len(stamps) - 1)
    nearest = np.where(us - stamps[after - 1] <= stamps[after] - us, after - 1, after)
    distance = np.abs(stamps[nearest] - us)
    near = distance <= 0.5 * float(np.median(np.diff(stamps)))
    # Of several velocities near one fix only the nearest belongs to it.
    best = np.full(len(stamps), np.iinfo(np.int64).max)
    np.minimum.at(best, nearest[near], distance[near])
    near &= distance == best[nearest]
    moved = near & (distance > 0)
    if moved.any():
        most = 1e-3 * float(distance[moved].max())
        builder.note(f"{name}: {int(moved.sum())} velocities stamped apart from their fixes, by up to {most:.1f} ms, were put beside them")
    us[near] = stamps[nearest[near]]
    return us, columns


# The rest


def _add_barometer(topics: Topics, builder: Builder) -> None:
    i = 0
    for air in topics.of("px4_msgs/VehicleAirData"):
        columns = {
            "pressure": air.get("baro_pressure_pa"),
            "temperature": air.get("baro_temp_celcius", "ambient_temperature"),
            "altitude": air.get("baro_alt_meter"),
        }
        builder.add(_numbered("barometer", i), air.us, columns)
        i += 1
    for topic in _ranked(topics.of("sensor_msgs/FluidPressure")):
        pressure = topic.get("fluid_pressure")
        name = _numbered("barometer", i)
        if re.search(r"diff|dynamic|pitot|airspeed", topic.words[-1] if topic.words else ""):
            builder.note(f"{topic.name} left out: a differential pressure is no barometer")
            continue
        known = pressure[np.isfinite(pressure)]
        middle = float(np.median(known)) if len(known) else np.nan
        if HECTOPASCAL[0] < middle < HECTOPASCAL[1]:
            builder.note(f"{name}: {topic.name} has a median of {middle:.4g} where pascal are due: read as hectopascal")
            pressure = pressure * 100.0
        builder.add(name, topic.us, {"pressure": pressure})
        i += 1


def _add_airdata(topics: Topics, builder: Builder) -> None:
    for topic in topics.of("px4_msgs/AirspeedValidated")[:1]:
        speed, source = topic.get("true_airspeed_m_s"), topic.get("airspeed_source", "selected_airspeed_index")
        # -1 none, 0 made of GNSS and wind, 4 a model: only 1 to 3 are sensors.
        made_up = np.isfinite(source) & ((source < 1.0) | (source > 3.0))
        keep = np.isfinite(speed) & ~made_up
        builder.discard("airdata", "airspeed not of a sensor", int(made_up.sum()))
        builder.discard("airdata", "airspeed that the autopilot calls invalid", int((~np.isfinite(speed) & ~made_up).sum()))
        builder.add("airdata", topic.us[keep], {"airspeed": speed[keep]})


def _add_rotors(topics: Topics, builder: Builder) -> None:
    found = topics.of("px4_msgs/EscStatus") or sorted(topics.of("mavros_msgs/ESCStatus", "mavros_msgs/ESCTelemetry"), key=len, reverse=True)
    for topic in found[:1]:
        stem = {"EscStatus": "esc", "ESCStatus": "esc_status", "ESCTelemetry": "esc_telemetry"}[topic.msgtype.rpartition("/")[2]]
        field = "esc_rpm" if stem == "esc" else "rpm"
        count = np.nanmax(topic.get("esc_count"), initial=0.0) if "esc_count" in topic else np.inf
        online = np.nan_to_num(topic.get("esc_online_flags")).astype(np.int64)
        columns: Columns = {}
        named = False
        for i in range(12):
            rpm = topic.get(f"{stem}[{i}].{field}")
            if i >= count or not np.isfinite(rpm).any():
                continue
            if online.any():
                rpm[(online >> i) & 1 == 0] = np.nan
            function = topic.get(f"{stem}[{i}].actuator_function")
            motor = int(function[-1]) - MOTOR_1 if stem == "esc" and np.nan_to_num(function).any() and np.isfinite(function[-1]) else -1
            named |= 0 <= motor < 12
            columns[f"speed_{motor if 0 <= motor < 12 else i}"] = np.abs(rpm) * RPM
        if columns and not named:
            builder.note(f"rotors are numbered as the speed controllers of {topic.name}: the bag does not name their motors")
        if columns:
            builder.add("rotors", topic.us, dict(sorted(columns.items(), key=lambda item: int(item[0][6:]))))
    for topic in found[1:]:
        builder.note(f"{topic.name} not read: rotor speeds are those of {found[0].name}")


def _add_power(topics: Topics, builder: Builder) -> None:
    for i, topic in enumerate(topics.of("px4_msgs/BatteryStatus") or _ranked(topics.of("sensor_msgs/BatteryState"))):
        voltage, current = topic.get("voltage_v", "voltage"), topic.get("current_a", "current")
        if "current_a" in topic:
            current[current < 0.0] = np.nan  # -1: not measured
        elif np.isfinite(current).any() and float(np.nanmedian(current)) < 0.0:
            current = -current  # ROS counts what flows in
        builder.add(_numbered("power", i), topic.us, {"voltage": voltage, "current": current})


def _add_modes(topics: Topics, builder: Builder) -> None:
    for topic in topics.of("mavros_msgs/State")[:1]:
        known = topic.where((topic.get("connected") != 0.0) & (topic.texts.get("mode", np.full(len(topic), "")) != ""))
        if len(known):
            add_modes(builder, (known.us, known.texts["mode"].tolist()), (known.us, known.get("armed")))
    for topic in [] if builder.has("modes") else topics.of("px4_msgs/VehicleStatus")[:1]:
        topic = topic.where(np.isfinite(topic.get("nav_state")))
        state = topic.get("arming_state")
        names = [px4_mode(int(n), None) for n in topic.get("nav_state")]
        add_modes(builder, (topic.us, names), (topic.us, np.where(np.isnan(state), np.nan, state == 2.0)))
