"""Every stream and column of a flight, with its unit and frame, written once. It holds no data and checks none."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["SOLUTION", "STREAMS", "Column", "StreamSchema", "base_name", "column", "schema_of"]


@dataclass(frozen=True)
class Column:
    """One column: its name, unit (SI; lat and lon in degrees), frame and meaning, and whether it holds words."""

    name: str
    unit: str
    frame: str
    doc: str
    text: bool = False


@dataclass(frozen=True)
class StreamSchema:
    """One stream: what it is, its columns, and those without which it is worth nothing."""

    name: str
    doc: str
    columns: tuple[Column, ...]
    required: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns, in order."""
        return tuple(c.name for c in self.columns)


T = Column("t", "s", "", "time")


def _xyz(stem: str, unit: str, frame: str, doc: str) -> tuple[Column, ...]:
    return tuple(Column(f"{stem}_{a}", unit, frame, f"{doc}, {a} axis") for a in "xyz")


def _ned(stem: str, unit: str, doc: str) -> tuple[Column, ...]:
    words = {"n": "north", "e": "east", "d": "down"}
    return tuple(Column(f"{stem}_{a}", unit, "NED", f"{doc}, {words[a]}") for a in "ned")


#: What a navigation solution, an autopilot's own solution and a reference have in common.
SOLUTION: tuple[Column, ...] = (
    T,
    *(Column(f"q_{a}", "1", "body to NED", f"attitude quaternion q_nb, {a} part (Hamilton)") for a in "wxyz"),
    *_ned("vel", "m/s", "velocity over ground"),
    *_ned("pos", "m", "position from the origin"),
    Column("lat", "deg", "WGS-84", "geodetic latitude"),
    Column("lon", "deg", "WGS-84", "longitude"),
    Column("alt", "m", "", "altitude above mean sea level, up"),
    *_xyz("gyro_bias", "rad/s", "FRD", "gyro bias (measured minus true)"),
    *_xyz("accel_bias", "m/s^2", "FRD", "accelerometer bias (measured minus true)"),
    Column("baro_bias", "m", "", "barometric height minus height above the origin"),
    *_ned("wind", "m/s", "velocity of the air over ground (blowing to)"),
    Column("sd_roll", "rad", "", "1 sigma of roll, first order, at most pi"),
    Column("sd_pitch", "rad", "", "1 sigma of pitch, first order, at most pi"),
    Column("sd_yaw", "rad", "", "1 sigma of yaw, first order, at most pi"),
    *_ned("sd_vel", "m/s", "1 sigma of velocity"),
    *_ned("sd_pos", "m", "1 sigma of position"),
    *_xyz("sd_gyro_bias", "rad/s", "FRD", "1 sigma of the gyro bias"),
    *_xyz("sd_accel_bias", "m/s^2", "FRD", "1 sigma of the accelerometer bias"),
    *_xyz("mag_offset", "uT", "FRD", "estimated offset of the magnetometer"),
    *_xyz("sd_mag_offset", "uT", "FRD", "1 sigma of the magnetometer's offset"),
    Column("sd_baro_bias", "m", "", "1 sigma of the barometer offset"),
    *_ned("sd_wind", "m/s", "1 sigma of wind"),
    Column("drag_mu", "1/s", "FRD", "rotor drag over mass and speed at hover, standard atmosphere at sea level"),
    Column("drag_c", "1/m", "FRD", "quadratic drag over mass, standard atmosphere at sea level"),
    Column("drag_offset_x", "m/s^2", "FRD", "specific force along x without drag"),
    Column("drag_offset_y", "m/s^2", "FRD", "specific force along y without drag"),
    Column("airspeed_scale", "1", "", "measured over true airspeed"),
    Column("aoa_offset", "rad", "", "offset of the vane of the angle of attack"),
    Column("sideslip_offset", "rad", "", "offset of the vane of the sideslip"),
    Column("sd_drag_mu", "1/s", "", "1 sigma of the rotor drag"),
    Column("sd_drag_c", "1/m", "", "1 sigma of the quadratic drag"),
    Column("sd_drag_offset_x", "m/s^2", "FRD", "1 sigma of the offset along x"),
    Column("sd_drag_offset_y", "m/s^2", "FRD", "1 sigma of the offset along y"),
    Column("sd_airspeed_scale", "1", "", "1 sigma of the airspeed's scale"),
    Column("sd_aoa_offset", "rad", "", "1 sigma of that offset"),
    Column("sd_sideslip_offset", "rad", "", "1 sigma of that offset"),
)

STREAMS: dict[str, StreamSchema] = {
    s.name: s
    for s in (
        StreamSchema(
            "imu",
            "angular rate and specific force, as the autopilot navigated with",
            (
                T,
                *_xyz("gyro", "rad/s", "FRD", "angular rate"),
                *_xyz("accel", "m/s^2", "FRD", "specific force (at rest, level: z = -9.81)"),
                Column("gyro_clipping", "1", "FRD", "axes at the end of the gyro's range since the sample before: x 1 + y 2 + z 4"),
                Column(
                    "accel_clipping", "1", "FRD", "axes at the end of the accelerometer's range since the sample before: x 1 + y 2 + z 4"
                ),
            ),
            ("t", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"),
        ),
        StreamSchema(
            "magnetometer",
            "magnetic field",
            (T, *_xyz("mag", "uT", "FRD", "magnetic field"), *_xyz("raw", "uT", "FRD", "magnetic field before the autopilot's correction")),
            ("t", "mag_x", "mag_y", "mag_z"),
        ),
        StreamSchema(
            "gnss",
            "satellite navigation fixes",
            (
                T,
                Column("lat", "deg", "WGS-84", "geodetic latitude"),
                Column("lon", "deg", "WGS-84", "longitude"),
                Column("alt", "m", "", "altitude above mean sea level, up"),
                *_ned("vel", "m/s", "velocity over ground"),
                Column("h_acc", "m", "", "horizontal accuracy, 1 sigma"),
                Column("v_acc", "m", "", "vertical accuracy, 1 sigma"),
                Column("s_acc", "m/s", "", "speed accuracy, 1 sigma"),
                Column("fix_type", "1", "", "0 or 1 none, 2 two-dimensional, 3 and above three-dimensional"),
                Column("num_sats", "1", "", "satellites used"),
            ),
            ("t",),
        ),
        StreamSchema(
            "barometer",
            "static pressure, or the altitude made of it",
            (
                T,
                Column("pressure", "Pa", "", "static pressure"),
                Column("temperature", "degC", "", "sensor temperature"),
                Column("altitude", "m", "", "pressure altitude, up"),
            ),
            ("t",),
        ),
        StreamSchema(
            "airdata",
            "air data",
            (
                T,
                Column("airspeed", "m/s", "", "true airspeed"),
                Column("aoa", "rad", "", "angle of attack"),
                Column("sideslip", "rad", "", "sideslip angle"),
            ),
            ("t",),
        ),
        StreamSchema("rotors", "rotor speeds and commands: speed_0 ... [rad/s], command_0 ... [0-1]", (T,), ("t",)),
        StreamSchema(
            "power",
            "battery",
            (T, Column("voltage", "V", "", "battery voltage"), Column("current", "A", "", "battery current")),
            ("t",),
        ),
        StreamSchema(
            "wind",
            "wind told from outside: constant, table or station",
            (T, *_ned("wind", "m/s", "velocity of the air over ground (blowing to)"), Column("sd", "m/s", "", "1 sigma of each component")),
            ("t", "wind_n", "wind_e"),
        ),
        StreamSchema(
            "attitude",
            "attitude told from outside, used by the estimators: motion capture, another navigator",
            (T, *(Column(f"q_{a}", "1", "body to NED", f"attitude quaternion q_nb, {a} part (Hamilton)") for a in "wxyz")),
            ("t", "q_w", "q_x", "q_y", "q_z"),
        ),
        StreamSchema("onboard", "the autopilot's own solution", SOLUTION, ("t",)),
        StreamSchema("truth", "reference (motion capture, RTK, simulator)", SOLUTION, ("t",)),
        StreamSchema(
            "vibration",
            "vibration of an IMU as the autopilot measured it: vibration.1 is that of imu.1",
            (
                T,
                *_xyz("vibe", "m/s^2", "FRD", "standard deviation of specific force above 5 Hz"),
                Column("clip", "1", "", "samples at the end of the accelerometer's range since boot"),
            ),
            ("t",),
        ),
        StreamSchema(
            "modes",
            "flight mode and arming: a row at the start and at each change, valid until the next",
            (
                T,
                Column("mode", "1", "", "the autopilot's own mode name", text=True),
                Column("armed", "1", "", "1 armed, 0 disarmed, NaN unknown"),
            ),
            ("t", "mode"),
        ),
    )
}

#: Streams whose earliest sample sets t = 0 in readers of foreign logs.
NAVIGATION_STREAMS = ("imu", "magnetometer", "gnss", "barometer", "airdata", "rotors")


def base_name(stream: str) -> str:
    """Kind of a stream without its instance number: ``imu.1`` is an ``imu``."""
    head, _, tail = stream.rpartition(".")
    return head if head and tail.isdigit() else stream


def schema_of(stream: str) -> StreamSchema | None:
    """Schema of a stream, or None for a stream that haltere does not know."""
    return STREAMS.get(base_name(stream))


def column(stream: str, name: str) -> Column | None:
    """Column of a stream, or None where it is not in the schema."""
    schema = schema_of(stream)
    if schema is None:
        return None
    if schema.name == "rotors" and name.startswith("speed_"):
        return Column(name, "rad/s", "", f"speed of rotor {name[6:]}")
    if schema.name == "rotors" and name.startswith("command_"):
        return Column(name, "1", "", f"command of rotor {name[8:]}, 0 to 1")
    return next((c for c in schema.columns if c.name == name), None)
