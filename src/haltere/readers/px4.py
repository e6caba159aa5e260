"""Reading PX4 ULog files into a FlightLog through all versions of their topics. It corrects units and names, never samples."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from haltere.readers._common import GAUSS, RPM, UTC_FLOOR_US, Builder, Columns, IntArray
from haltere.readers._compass import px4_compass
from haltere.readers._modes import add_modes, px4_mode
from haltere.readers._px4_solution import add_solution, add_truth, set_home
from haltere.readers._ulog import MAGIC, Log, Topic

if TYPE_CHECKING:
    from haltere.flight.log import FlightLog

__all__ = ["read", "sniff"]

#: ``*_timestamp_relative`` of a sensor that has no sample.
INVALID_RELATIVE = 2147483647
#: Motors by MAV_TYPE (quadrotor, hexarotor, octorotor, tricopter), where outputs are not named otherwise.
MOTORS_BY_TYPE = {2: 4, 13: 6, 14: 8, 15: 3}
#: ``actuator_function`` of the first motor.
MOTOR_1 = 101


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is a ULog."""
    return head.startswith(MAGIC)


def read(path: Path) -> FlightLog:
    """Read a ULog.

    Parameters
    ----------
    path
        The ``.ulg`` file.

    Returns
    -------
    FlightLog
        ``imu`` is ``sensor_combined`` (means over the interval since the sample before), the other physical units ``imu.1``, ...

    Raises
    ------
    HaltereError
        The file cannot be parsed or holds no topic that is read.

    Notes
    -----
    Topics and units after the ULog specification and PX4's uORB message definitions.
    """
    builder = Builder(path, "PX4 ULog")
    log = Log(path, builder)
    if log.version:
        builder.meta.source += f", PX4 {log.version}"
    _add_imu(log, builder)
    _add_magnetometer(log, builder)
    _add_barometer(log, builder)
    _add_gnss(log, builder)
    _add_airdata(log, builder)
    _add_rotors(log, builder)
    for i, topic in enumerate(log.all("battery_status")):
        current = topic.get("current_a")
        current[current < 0.0] = np.nan  # -1: not measured
        builder.add("power" if i == 0 else f"power.{i}", topic.us, {"voltage": topic.get("voltage_v"), "current": current})
    _add_modes(log, builder)
    set_home(log, builder)
    add_solution(log, builder)
    add_truth(log, builder)
    if builder.utc is None:
        span = builder.span("imu")
        if span and span[0] > UTC_FLOOR_US:
            builder.utc = (span[0], span[0])
    return builder.build()


def _numbered(stream: str, items: list[Topic], start: int = 0) -> Iterator[tuple[str, Topic]]:
    for i, item in enumerate(items, start):
        yield (stream if i == 0 else f"{stream}.{i}"), item


def _add_imu(log: Log, builder: Builder) -> None:
    units = log.all("vehicle_imu")
    combined = log.one("sensor_combined")
    primary = _primary_imu(log, units)
    if combined is not None:
        accel = combined.vector("accelerometer_m_s2", "accel")
        if "accelerometer_timestamp_relative" in combined:
            lost = combined.data["accelerometer_timestamp_relative"] == INVALID_RELATIVE
            for values in accel.values():
                values[lost] = np.nan
            builder.discard("imu", "accelerometer without a sample (rows kept, accel NaN)", int(lost.sum()))
        clipping = {"gyro_clipping": combined.get("gyro_clipping"), "accel_clipping": combined.get("accelerometer_clipping")}
        builder.add("imu", combined.us, {**combined.vector("gyro_rad", "gyro"), **accel, **clipping})
        builder.meta.imu_kind = "mean"
        if primary in units:
            units.remove(primary)
    elif primary is not None:
        units.insert(0, units.pop(units.index(primary)))
        builder.note("no sensor_combined: imu is vehicle_imu")
        builder.meta.imu_kind = "mean"
    for name, unit in _numbered("imu", units, start=1 if combined is not None else 0):
        columns: Columns = {}
        for field, out in (("delta_angle", "gyro"), ("delta_velocity", "accel")):
            span = unit.get(f"{field}_dt", scale=1e-6)
            span[span <= 0.0] = np.nan
            columns |= {k: v / span for k, v in unit.vector(field, out).items()}
        builder.add(name, unit.us, columns)
    if combined is None and not units:
        builder.note("no sensor_combined or vehicle_imu topic: there is no imu stream")


def _primary_imu(log: Log, units: list[Topic]) -> Topic | None:
    """The unit that the autopilot navigated with, by device, else the first."""
    selection = log.one("sensor_selection")
    wanted = selection.last("gyro_device_id") if selection else None
    for unit in units:
        if wanted and unit.last("gyro_device_id") == wanted:
            return unit
    return units[0] if units else None


def _held(topic: Topic, prefix: str, stream: str, builder: Builder) -> tuple[IntArray, NDArray[np.intp]]:
    """Stamps and rows of a slow sensor inside an old sensor_combined: invalid rows and held copies left out."""
    relative = topic.data[f"{prefix}_timestamp_relative"].astype(np.int64)
    valid = relative != INVALID_RELATIVE
    stamps = topic.us + np.where(valid, relative, 0)
    rows = np.flatnonzero(valid)
    fresh = np.ones(len(rows), dtype=bool)
    fresh[1:] = stamps[rows][1:] != stamps[rows][:-1]
    if not valid.all():
        builder.note(f"{stream}: {int((~valid).sum())} rows of sensor_combined hold no sample yet")
    if not fresh.all():
        builder.note(f"{stream}: {int((~fresh).sum())} rows of sensor_combined repeat the sample before and were read once")
    rows = rows[fresh]
    return stamps[rows], rows


def _add_magnetometer(log: Log, builder: Builder) -> None:
    units = log.all("vehicle_magnetometer")
    # Until 1.11 the selection names the device, since then the estimator that uses it does.
    naming = [t for t in (log.one("sensor_selection"), log.one("estimator_sensor_bias")) if t is not None and "mag_device_id" in t]
    wanted = naming[0].last("mag_device_id") if naming else None
    units.sort(key=lambda u: (not wanted or u.last("device_id") != wanted, u.instance))
    for name, unit in _numbered("magnetometer", units):
        _add_calibrated(log, builder, name, unit, unit.us, unit.vector("magnetometer_ga", "mag", scale=GAUSS))
    combined = log.one("sensor_combined")
    if not units and combined is not None and "magnetometer_timestamp_relative" in combined:
        us, rows = _held(combined, "magnetometer", "magnetometer", builder)
        mag = {k: v[rows] for k, v in combined.vector("magnetometer_ga", "mag", scale=GAUSS).items()}
        _add_calibrated(log, builder, "magnetometer", combined, us, mag)
    if not builder.has("magnetometer"):
        for name, unit in _numbered("magnetometer", log.all("sensor_mag")):
            builder.note("magnetometer is sensor_mag: raw, without the calibration that the autopilot applied")
            builder.add(name, unit.us, {f"mag_{a}": unit.get(a, scale=GAUSS) for a in "xyz"})


def _add_calibrated(log: Log, builder: Builder, name: str, unit: Topic, us: IntArray, mag: Columns) -> None:
    """A magnetometer with the field before the autopilot's calibration beside it, where the parameters tell it."""
    raw, builder.meta.compass[name], note = px4_compass(log, unit, us, mag)
    builder.add(name, us, mag | raw)
    if note:
        builder.note(note)


def _add_barometer(log: Log, builder: Builder) -> None:
    air = log.one("vehicle_air_data")
    combined = log.one("sensor_combined")
    if air is not None:
        columns = {
            "pressure": air.get("baro_pressure_pa"),
            "temperature": air.get("baro_temp_celcius", "ambient_temperature"),
            "altitude": air.get("baro_alt_meter"),
        }
        builder.add("barometer", air.us, columns)
    elif combined is not None and "baro_timestamp_relative" in combined:
        us, rows = _held(combined, "baro", "barometer", builder)
        columns = {"temperature": combined.get("baro_temp_celcius")[rows], "altitude": combined.get("baro_alt_meter")[rows]}
        builder.add("barometer", us, columns)
    device = air.last("baro_device_id") if air is not None else None
    units = [u for u in log.all("sensor_baro") if device is None or u.last("device_id") != device]
    for name, unit in _numbered("barometer", units, start=1 if builder.has("barometer") else 0):
        pressure = unit.get("pressure")
        if float(np.median(np.nan_to_num(pressure))) < 2000.0:  # millibar before 1.13
            pressure *= 100.0
        builder.add(name, unit.us, {"pressure": pressure, "temperature": unit.get("temperature"), "altitude": unit.get("altitude")})


def _add_gnss(log: Log, builder: Builder) -> None:
    units = log.all("vehicle_gps_position") or log.all("sensor_gps")
    for name, gps in _numbered("gnss", units):
        new = "latitude_deg" in gps
        velocity = {f"vel_{a}": gps.get(f"vel_{a}_m_s") for a in "ned"}
        if "vel_ned_valid" in gps:
            lost = gps.data["vel_ned_valid"] == 0
            for values in velocity.values():
                values[lost] = np.nan
            builder.discard(name, "velocity that the receiver calls invalid (rows kept, vel NaN)", int(lost.sum()))
        columns = {
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
        builder.add(name, gps.us, columns)
        if builder.utc is None and "time_utc_usec" in gps:
            utc = gps.data["time_utc_usec"].astype(np.int64)
            known = np.flatnonzero((utc > UTC_FLOOR_US) & (columns["fix_type"] >= 3.0))
            if len(known):
                builder.utc = (int(gps.us[known[0]]), int(utc[known[0]]))


def _add_airdata(log: Log, builder: Builder) -> None:
    topic = log.one("airspeed_validated", "airspeed")
    if topic is None:
        return
    speed = topic.get("true_airspeed_m_s")
    source = topic.get("airspeed_source", "selected_airspeed_index")
    # -1 none, 0 made of GNSS and wind, 4 a model: only 1 to 3 are sensors.
    made_up = np.isfinite(source) & ((source < 1.0) | (source > 3.0))
    keep = np.isfinite(speed) & ~made_up
    builder.discard("airdata", "airspeed not of a sensor", int(made_up.sum()))
    builder.discard("airdata", "airspeed that the autopilot calls invalid", int((~np.isfinite(speed) & ~made_up).sum()))
    builder.add("airdata", topic.us[keep], {"airspeed": speed[keep]})


def _add_modes(log: Log, builder: Builder) -> None:
    status = log.one("vehicle_status")
    if status is None or "nav_state" not in status:
        return
    release = log.version.lstrip("v").split(".") if log.version else []
    version = (int(release[0]), int(release[1])) if len(release) > 1 and release[0].isdigit() and release[1].isdigit() else None
    numbers, rows = np.unique(status.data["nav_state"], return_inverse=True)
    names = [px4_mode(int(n), version) for n in numbers]
    state = status.get("arming_state")
    # 3 was "armed with an error" in the first ULogs and "standby with an error" from then on.
    armed = np.where((state == 3.0) | np.isnan(state), np.nan, state == 2.0)
    add_modes(builder, (status.us, [names[i] for i in rows]), (status.us, armed))


def _add_rotors(log: Log, builder: Builder) -> None:
    speeds = _rotor_speeds(log, builder)
    if speeds is not None:
        builder.add("rotors", *speeds)
    commands = _rotor_commands(log, builder)
    if commands is not None:
        builder.add("actuators" if speeds is not None else "rotors", *commands)
    if speeds is not None and commands is not None:
        builder.note("rotor commands are in the stream actuators: they have their own time base")


def _rotor_speeds(log: Log, builder: Builder) -> tuple[IntArray, Columns] | None:
    esc = log.one("esc_status")
    if esc is None:
        return None
    count = int(np.max(esc.get("esc_count"), initial=0)) if "esc_count" in esc else 12
    online = esc.integers("esc_online_flags")
    functions = [esc.last(f"esc[{i}].actuator_function") or 0 for i in range(12)]
    columns: Columns = {}
    for i in range(12):
        rpm = esc.get(f"esc[{i}].esc_rpm")
        seen = esc.get(f"esc[{i}].timestamp")
        if i >= count or np.isnan(rpm).all() or not ((rpm != 0.0) | (seen > 0.0)).any():
            continue
        if online is not None and online.any():
            rpm[(online >> i) & 1 == 0] = np.nan
        if any(functions):
            motor = functions[i] - MOTOR_1
            if not 0 <= motor < 12:
                builder.note(f"esc[{i}] left out: its function {functions[i]} is no motor")
                continue
        else:
            motor = i
        columns[f"speed_{motor}"] = np.abs(rpm) * RPM
    if not any(functions) and columns:
        builder.note("rotor speeds are in the order of the speed controllers: the log does not name their motors")
    return (esc.us, dict(sorted(columns.items(), key=lambda item: int(item[0][6:])))) if columns else None


def _rotor_commands(log: Log, builder: Builder) -> tuple[IntArray, Columns] | None:
    motors = log.one("actuator_motors")
    if motors is not None:
        columns = {f"command_{i}": motors.get(f"control[{i}]") for i in range(12)}
        return motors.us, {k: v for k, v in columns.items() if np.isfinite(v).any()}
    for outputs in log.all("actuator_outputs"):
        channels = _motor_channels(log, outputs)
        if not channels:
            continue
        values = np.column_stack([outputs.get(f"output[{c}]") for c in channels])
        if (values > 1.0).any():  # pulse width [us], 1000 to 2000
            values = np.clip((values - 1000.0) / 1000.0, 0.0, 1.0)
        builder.note("rotor commands are actuator_outputs: (pulse width - 1000 us) / 1000 us, channels by parameter or airframe type")
        return outputs.us, {f"command_{i}": values[:, i] for i in range(len(channels))}
    if log.all("actuator_outputs"):
        builder.note("actuator_outputs left out: the log does not tell which channels are motors")
    return None


def _motor_channels(log: Log, outputs: Topic) -> list[int]:
    """Output channels of motors 1, 2, ... by PWM_MAIN_FUNCx, else the first ones of a multirotor's first output group."""
    functions = {log.params.get(f"PWM_MAIN_FUNC{c + 1}", 0): c for c in range(16)}
    named = [functions[f] for f in range(MOTOR_1, MOTOR_1 + 12) if f in functions]
    if named or outputs.instance:
        return named if not outputs.instance else []
    return list(range(MOTORS_BY_TYPE.get(log.params.get("MAV_TYPE", 0), 0)))
