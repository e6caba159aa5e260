"""Logging settings of each autopilot and recorder, by what they would add to a log. It looks at no log."""

from __future__ import annotations

__all__ = ["settings_of"]

_PX4_DEFAULT = "PX4: log the default topics (SDLOG_PROFILE bit 0)"
#: One table an origin; every one has the same keys.
SETTINGS: dict[str, dict[str, str]] = {
    "PX4": {
        "imu": f"{_PX4_DEFAULT}, which has sensor_combined at full rate; bit 4 (high rate) logs more",
        "gaps": "PX4: a faster SD card, or fewer topics (SDLOG_PROFILE); the log's notes count the logger's dropouts",
        "gnss": f"{_PX4_DEFAULT}, which has vehicle_gps_position, and arm with a 3-D fix",
        "gnss velocity": "PX4: a receiver whose driver gives velocity (vel_ned_valid in vehicle_gps_position); u-blox ones do",
        "magnetometer": f"{_PX4_DEFAULT}, which has vehicle_magnetometer; check SYS_HAS_MAG",
        "barometer": f"{_PX4_DEFAULT}, which has vehicle_air_data; check SYS_HAS_BARO",
        "rotors": "PX4: esc_status needs speed controllers with telemetry (bidirectional DShot, DroneCAN); it is logged at 4 Hz unless "
        "SDLOG_PROFILE has bit 4 (17: default and high rate), or etc/logging/logger_topics.txt on the SD card has the line "
        "'esc_status 5' (ms between samples); that file replaces the default topics: the documentation has a whole one",
    },
    "ArduPilot": {
        "imu": "ArduPilot: set bit 18 of LOG_BITMASK (fast IMU; Copter); bit 7 alone gives 25 Hz. Raw IMU (bit 19) and batch "
        "sampling (INS_LOG_BAT_MASK) write other messages, which are not read",
        "gaps": "ArduPilot: a faster SD card or a larger LOG_FILE_BUFSIZE; separate flights: LOG_FILE_DSRMROT 1 starts a new log at each",
        "gnss": "ArduPilot: set bit 2 of LOG_BITMASK (GPS), and arm with a 3-D fix",
        "gnss velocity": "ArduPilot: a receiver that gives vertical velocity (VV in GPA is 1); u-blox ones do, NMEA ones do not",
        "magnetometer": "ArduPilot: set the compass bit of LOG_BITMASK (13 on Copter, 10 on Plane, 11 on Rover); check COMPASS_USE",
        "barometer": "ArduPilot: firmware from 3.2 on logs BARO by itself; CTUN (bit 4 of LOG_BITMASK) holds its altitude before",
        "rotors": "ArduPilot: ESC messages need telemetry: bidirectional DShot (SERVO_BLH_BDMASK, "
        "SERVO_BLH_POLES) or CAN speed controllers",
    },
    "Blackbox": {
        "imu": "Betaflight: set blackbox_sample_rate = 1/4 or faster, blackbox_disable_acc = OFF and blackbox_disable_gyro = OFF "
        "(firmware before 4.3: blackbox_p_ratio, blackbox_record_acc = ON)",
        "gaps": "Betaflight: a slower blackbox_sample_rate, or an SD card in place of serial logging",
        "gnss": "Betaflight: feature GPS, blackbox_disable_gps = OFF, and arm with a fix",
        "gnss velocity": "Betaflight logs the speed over ground and its course only: vertical velocity cannot be had",
        "magnetometer": "Betaflight logs magADC in units of the sensor, which cannot be used: record the compass elsewhere",
        "barometer": "Betaflight: a board with a barometer, and blackbox_disable_alt = OFF",
        "rotors": "Betaflight: dshot_bidir = ON, motor_poles as built, and blackbox_disable_rpm = OFF (firmware from 4.5 on)",
    },
    "ROS": {
        "imu": "ROS: record sensor_msgs/Imu (MAVROS: /mavros/imu/data_raw; PX4 over uXRCE-DDS: /fmu/out/sensor_combined) at full rate",
        "gaps": "ROS: record on the vehicle, not over a radio link; a larger --max-cache-size (ROS 2) or --buffsize (ROS 1)",
        "gnss": "ROS: record sensor_msgs/NavSatFix (MAVROS: /mavros/global_position/raw/fix; PX4: /fmu/out/vehicle_gps_position)",
        "gnss velocity": "ROS: record the receiver's velocity too (MAVROS: /mavros/global_position/raw/gps_vel)",
        "magnetometer": "ROS: record sensor_msgs/MagneticField (MAVROS: /mavros/imu/mag); PX4's dds_topics.yaml has no "
        "vehicle_magnetometer: add /fmu/out/vehicle_magnetometer and build",
        "barometer": "ROS: record sensor_msgs/FluidPressure (MAVROS: /mavros/imu/static_pressure); PX4's dds_topics.yaml has no "
        "vehicle_air_data: add /fmu/out/vehicle_air_data and build",
        "rotors": "ROS: record /mavros/esc_status; PX4's dds_topics.yaml has no esc_status: add /fmu/out/esc_status and build",
    },
    "DJI": {
        "imu": "DatCon: choose the highest sample rate (200 Hz); the CSV is thinned to it",
        "gaps": "DatCon: convert the whole record, not parts of it",
        "gnss": "DJI: wait for a fix before take-off; let DatCon write the GPS columns",
        "gnss velocity": "DatCon: let it write GPS(0):velN, velE and velD",
        "magnetometer": "DJI's magnetometer is in counts whose unit is not documented: map the table by hand if you know it",
        "barometer": "DatCon: let it write IMU_ATTI(0):barometer:Raw",
        "rotors": "DatCon: choose the highest sample rate, and let it write Motor:Speed",
    },
    "": {
        "imu": "record gyro and accelerometer at 50 Hz or more, 200 Hz if you can",
        "gaps": "record without holes, or cut the log into its flights",
        "gnss": "record satellite position and velocity at 1 Hz or more",
        "gnss velocity": "record the receiver's velocity, vertical too: vel_n, vel_e, vel_d",
        "magnetometer": "record the magnetometer at 5 Hz or more",
        "barometer": "record the barometer at 5 Hz or more",
        "rotors": "record rotor speeds at 50 Hz or more",
    },
}


def settings_of(source: str) -> dict[str, str]:
    """Settings by what is missing (``imu``, ``gaps``, ``gnss``, ``gnss velocity``, ``magnetometer``, ``barometer``, ``rotors``).

    Parameters
    ----------
    source
        ``meta.source`` of a flight: it begins with the format that it was read from.
    """
    return next((settings for origin, settings in SETTINGS.items() if origin and source.startswith(origin)), SETTINGS[""])
