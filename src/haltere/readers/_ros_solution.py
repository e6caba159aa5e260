"""The autopilot's own solution, reference poses and the home position of a ROS bag, turned to NED and FRD. It reads no sensor."""

from __future__ import annotations

import re

import numpy as np

from haltere.readers._common import Builder, Columns, FloatArray, IntArray, merge_rows
from haltere.readers._ros_topics import Topic, Topics, enu_to_ned

__all__ = ["REFERENCE", "add_onboard", "add_truth", "ned_frd_quaternion", "set_home"]

#: Names of topics that carry a reference: motion capture, surveying instruments, simulators.
REFERENCE = re.compile(r"vicon|vrpn|optitrack|natnet|mocap|motion_capture|qualisys|leica|ground_?truth|(?:^|[/_])truth|gazebo")
#: A quaternion whose length is off one by more than this is none.
UNIT_LIMIT = 0.05
#: Position and attitude of a pose message, by type.
POSES = {
    "geometry_msgs/msg/PoseStamped": ("pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose.pose.position", "pose.pose.orientation"),
    "geometry_msgs/msg/TransformStamped": ("transform.translation", "transform.rotation"),
    "geometry_msgs/msg/PointStamped": ("point", ""),
    "nav_msgs/msg/Odometry": ("pose.pose.position", "pose.pose.orientation"),
}

Piece = tuple[IntArray, Columns]


def ned_frd_quaternion(w: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray) -> Columns:
    """Quaternion q_nb from body FRD to NED of one from body FLU to ENU; NaN where it has not length one.

    ENU turns into NED by half a turn about north-east, FLU into FRD by half a turn about x: q_nb = (0, s, s, 0) q (0, 1, 0, 0) with
    s = 1/sqrt(2), up to the sign.
    """
    length = np.sqrt(w * w + x * x + y * y + z * z)
    bad = ~(np.abs(length - 1.0) < UNIT_LIMIT)
    s = np.where(bad, np.nan, np.sqrt(0.5) / np.where(length > 0.0, length, np.nan))
    return {"q_w": s * (w + z), "q_x": s * (x + y), "q_y": s * (x - y), "q_z": s * (w - z)}


def set_home(topics: Topics, builder: Builder) -> None:
    """Home is the origin of PX4's local position, where the bag has one."""
    for local in topics.of("px4_msgs/VehicleLocalPosition")[:1]:
        good = _referenced(local)
        if good.any():
            i = int(np.flatnonzero(good)[-1])
            builder.set_home(local.get("ref_lat")[i], local.get("ref_lon")[i], local.get("ref_alt")[i])
            builder.note(f"home is the origin of {local.name}")


def add_onboard(topics: Topics, builder: Builder) -> None:
    """The stream ``onboard``: PX4's own messages, else MAVROS's local position, attitude and wind."""
    pieces = _px4(topics, builder) or _mavros(topics, builder)
    us, merged = merge_rows(pieces)
    builder.add("onboard", us, merged)


def add_truth(topics: Topics, builder: Builder) -> None:
    """The stream ``truth`` from the topic of a reference with the most samples."""
    found = [t for t in topics if t.msgtype in POSES and REFERENCE.search(t.name.lower())]
    found.sort(key=lambda t: (t.msgtype.endswith("PointStamped"), -len(t), t.name))
    for other in found[1:]:
        builder.note(f"{other.name} not read: truth is {found[0].name}")
    fixes = [t for t in topics.of("sensor_msgs/NavSatFix") if REFERENCE.search(t.name.lower())]
    pieces: list[Piece] = [
        (t.us, {"lat": t.get("latitude"), "lon": t.get("longitude"), "alt": t.get("altitude")})
        for t in fixes[:1]
    ]  # fmt: skip
    for topic in found[:1]:
        columns = _pose(topic)
        if topic.msgtype == "nav_msgs/msg/Odometry":
            columns |= _odometry_velocity(topic, "truth", builder)
        pieces.append((topic.us, columns))
        for twist in topics.of("geometry_msgs/TwistStamped"):
            if twist.place == topic.place and twist.words[-1:] in (["twist"], ["velocity"]):
                pieces.append((twist.us, enu_to_ned(twist, "twist.linear", "vel")))
                builder.note(f"truth velocity is {twist.name}, taken as in the axes of {topic.name}")
        builder.note(
            f"truth is {topic.name}: its frame is taken as x east, y north, z up, its body as forward, left, up; a motion-capture "
            "room's heading, origin and marker axes are its own, so compare after aligning them"
        )
    us, merged = merge_rows(pieces)
    builder.add("truth", us, merged)


def _quaternion(topic: Topic, field: str) -> Columns:
    return ned_frd_quaternion(*(topic.get(f"{field}.{part}") for part in "wxyz"))


def _pose(topic: Topic) -> Columns:
    position, orientation = POSES[topic.msgtype]
    columns = enu_to_ned(topic, position, "pos")
    return columns | _quaternion(topic, orientation) if orientation else columns


def _odometry_velocity(topic: Topic, stream: str, builder: Builder) -> Columns:
    """Velocity of an Odometry: in the body's axes by its definition, but some senders give the world's, which its positions show."""
    world = np.column_stack([topic.get(f"twist.twist.linear.{a}") for a in "xyz"])
    turned = _turn(topic, world)
    place = np.column_stack([topic.get(f"pose.pose.position.{a}") for a in "xyz"])
    velocity = turned
    seconds = 1e-6 * (topic.us - topic.us[0])
    if len(topic) > 10 and (np.diff(seconds) > 0.0).all():
        moved = np.gradient(place, seconds, axis=0)
        off = [float(np.nanmedian(np.linalg.norm(v - moved, axis=1))) if np.isfinite(v).any() else np.inf for v in (turned, world)]
        if off[1] < 0.3 * off[0] and off[0] > 0.1:
            velocity = world
            builder.note(
                f"{stream}: the twist of {topic.name} is in the world's axes (median {off[1]:.2g} m/s from its positions; "
                f"{off[0]:.2g} m/s if it were in the body's, as defined)"
            )
    return {"vel_n": velocity[:, 1], "vel_e": velocity[:, 0], "vel_d": -velocity[:, 2]}


def _turn(topic: Topic, body: FloatArray) -> FloatArray:
    """Vectors of the body in the axes of the pose's frame."""
    w, x, y, z = (topic.get(f"pose.pose.orientation.{part}") for part in "wxyz")
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = (np.where(np.abs(length - 1.0) < UNIT_LIMIT, part, np.nan) for part in (w, x, y, z))
    axis = np.column_stack([x, y, z])
    twice = 2.0 * np.cross(axis, body)
    return np.asarray(body + w[:, None] * twice + np.cross(axis, twice))


def _mavros(topics: Topics, builder: Builder) -> list[Piece]:
    """Attitude of the filtered IMU topic, pose and velocity of MAVROS's local position, its fused global position and its wind."""
    pieces: list[Piece] = []
    attitude = _attitude(topics)
    local = {t.words[-1]: t for t in topics if "local_position" in t.words[:-1] and not REFERENCE.search(t.name.lower())}
    odometry = local.get("odom") if local.get("odom") in topics.of("nav_msgs/Odometry") else None
    pose = local.get("pose") if local.get("pose") in topics.of("geometry_msgs/PoseStamped") else odometry
    said: list[str] = []
    if attitude is not None:
        pieces.append((attitude.us, _quaternion(attitude, "orientation")))
        said.append(f"attitude {attitude.name}")
    if pose is not None:
        columns = _pose(pose)
        if attitude is not None:
            columns = {k: v for k, v in columns.items() if not k.startswith("q_")}
        pieces.append((pose.us, columns))
        said.append(f"position {pose.name}")
        builder.note("onboard positions are relative to the autopilot's own origin, which the bag does not name")
    velocity = next((local[n] for n in ("velocity_local", "velocity") if n in local), None)
    if velocity is not None and velocity.msgtype == "geometry_msgs/msg/TwistStamped":
        pieces.append((velocity.us, enu_to_ned(velocity, "twist.linear", "vel")))
        said.append(f"velocity {velocity.name}")
    elif odometry is not None:
        pieces.append((odometry.us, _odometry_velocity(odometry, "onboard", builder)))
        said.append(f"velocity {odometry.name}")
    for fused in topics.of("sensor_msgs/NavSatFix"):
        if fused.words[-2:] == ["global_position", "global"]:
            pieces.append((fused.us, {"lat": fused.get("latitude"), "lon": fused.get("longitude"), "alt": fused.get("altitude")}))
            said.append(f"lat, lon and alt (above the ellipsoid) {fused.name}")
            break
    for wind in topics.of("geometry_msgs/TwistWithCovarianceStamped", "geometry_msgs/TwistStamped"):
        if wind.words[-1:] == ["wind_estimation"]:
            pieces.append((wind.us, _mavros_wind(wind, builder)))
            said.append(f"wind {wind.name}")
            break
    if said:
        builder.note(f"onboard is {', '.join(said)}; east, north, up and forward, left, up turned to NED and FRD")
    return pieces


def _mavros_wind(wind: Topic, builder: Builder) -> Columns:
    """Wind of MAVROS, blowing to: its x is east, y north, z up, but not in every version.

    Until 2018 it was a TwistStamped of ArduPilot's wind alone, whose direction is where the wind comes *from*, handed on as it is, and
    its vertical part down. Then PX4's came right and ArduPilot's mirrored, until 1.3 of 2020; a covariance tells them apart.
    """
    if not wind.msgtype.endswith("TwistWithCovarianceStamped"):
        builder.note(
            f"onboard wind turned round: {wind.name} without covariance, as MAVROS before 2018 sent it, is where the wind comes from"
        )
        columns = {name: -v for name, v in enu_to_ned(wind, "twist.linear", "wind").items()}
    else:
        columns = enu_to_ned(wind, "twist.twist.linear", "wind")
        variances = [wind.get("twist.covariance[7]"), wind.get("twist.covariance[0]")]
        sd = {f"sd_wind_{a}": np.sqrt(np.where(v > 0.0, v, np.nan)) for a, v in zip("ne", variances, strict=True)}
        known = {name: v for name, v in sd.items() if np.isfinite(v).any()}
        if not known:
            builder.note(
                f"onboard wind {wind.name} has no covariance, so it is ArduPilot's; MAVROS before 1.3 (2020) mirrored its direction, "
                "which nothing in the bag tells"
            )
        columns |= known
    if not np.nan_to_num(columns["wind_d"]).any():
        del columns["wind_d"]
    return columns


def _attitude(topics: Topics) -> Topic | None:
    """The IMU topic with an orientation that was estimated: MAVROS's before others, more samples before fewer."""

    def estimated(topic: Topic) -> Topic:
        q = np.column_stack([topic.get(f"orientation.{part}") for part in "wxyz"])
        return topic.where((topic.get("orientation_covariance[0]") != -1.0) & np.isfinite(q).all(axis=1) & q.any(axis=1))

    found = [t for t in map(estimated, topics.of("sensor_msgs/Imu")) if len(t)]
    # Drivers without a filter send one quaternion all the time.
    found = [t for t in found if len(t) < 10 or any(np.ptp(t.get(f"orientation.{part}")) > 0.0 for part in "wxyz")]
    return min(found, key=lambda t: (not any("mavros" in word for word in t.words), -len(t), t.name), default=None)


def _referenced(local: Topic) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Rows whose local position hangs on a known geodetic origin."""
    lat, lon, alt = local.get("ref_lat"), local.get("ref_lon"), local.get("ref_alt")
    good = np.isfinite(lat) & np.isfinite(lon) & np.isfinite(alt) & ((lat != 0.0) | (lon != 0.0))
    return np.asarray(good & (local.get("xy_global") != 0.0) & (local.get("z_global") != 0.0))


def _px4(topics: Topics, builder: Builder) -> list[Piece]:
    """PX4's attitude, local and global position and wind; its odometry where these are not there."""
    pieces: list[Piece] = []
    attitude = topics.of("px4_msgs/VehicleAttitude")[:1]
    pieces += [(t.us, {f"q_{a}": t.get(f"q[{i}]") for i, a in enumerate("wxyz")}) for t in attitude]
    local = topics.of("px4_msgs/VehicleLocalPosition")[:1]
    pieces += [(t.us, _px4_local(t, builder)) for t in local]
    for t in topics.of("px4_msgs/VehicleGlobalPosition")[:1]:
        pieces.append((t.us, {name: t.get(name) for name in ("lat", "lon", "alt")}))
    for t in topics.of("px4_msgs/Wind")[:1]:
        columns = {"wind_n": t.get("windspeed_north"), "wind_e": t.get("windspeed_east")}
        variances = [t.get("variance_north"), t.get("variance_east")]
        idle = variances[0] + variances[1] == 0.0
        columns |= {f"sd_wind_{a}": np.sqrt(np.where(v > 0.0, v, np.nan)) for a, v in zip("ne", variances, strict=True)}
        for values in columns.values():
            values[idle] = np.nan
        pieces.append((t.us, columns))
    for t in topics.of("px4_msgs/VehicleOdometry")[:1]:
        columns = {}
        wanted = [] if attitude else [("q", "wxyz", "q", "pose_frame")]
        wanted += [] if local else [("pos", "ned", "position", "pose_frame"), ("vel", "ned", "velocity", "velocity_frame")]
        for stem, axes, field, frame in wanted:
            # 1 is NED; 2 has an arbitrary heading, 3 is the body.
            known = t.get(frame) == 1.0
            columns |= {f"{stem}_{a}": np.where(known, t.get(f"{field}[{i}]"), np.nan) for i, a in enumerate(axes)}
        if columns:
            pieces.append((t.us, columns))
    return pieces


def _px4_local(local: Topic, builder: Builder) -> Columns:
    """Velocity and position of PX4's estimator; NaN where it calls them invalid or they hang on another origin than home."""
    columns: Columns = {}
    for out, field, flag in (
        ("vel_n", "vx", "v_xy_valid"),
        ("vel_e", "vy", "v_xy_valid"),
        ("vel_d", "vz", "v_z_valid"),
        ("pos_n", "x", "xy_valid"),
        ("pos_e", "y", "xy_valid"),
        ("pos_d", "z", "z_valid"),
    ):
        columns[out] = np.where(local.get(flag) == 0.0, np.nan, local.get(field))
    home = builder.meta.home
    if home is None:
        builder.note("onboard positions are relative to the autopilot's own origin, which the bag does not name")
        return columns
    there = (
        _referenced(local) & (local.get("ref_lat") == home.lat) & (local.get("ref_lon") == home.lon) & (local.get("ref_alt") == home.alt)
    )
    if not there.all():
        builder.note(f"onboard positions hang on another origin than home in {int((~there).sum())} of {len(local)} samples: NaN")
    for name in ("pos_n", "pos_e", "pos_d"):
        columns[name][~there] = np.nan
    return columns
