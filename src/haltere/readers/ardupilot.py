"""Reading ArduPilot DataFlash logs, binary and text, of three generations into a FlightLog. It corrects units and names, never samples."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from haltere.readers._ardupilot_solution import add_solution, add_truth, primary
from haltere.readers._common import RPM, Builder, Columns, FloatArray, IntArray
from haltere.readers._compass import ardupilot_compass
from haltere.readers._dataflash import BINARY_HEAD, DataFlash, Messages, is_text_log
from haltere.readers._modes import ARDUPILOT_MODES, add_modes, ardupilot_mode, spelt

if TYPE_CHECKING:
    from haltere.flight.log import FlightLog

__all__ = ["read", "sniff"]

#: Milligauss to microtesla.
MILLIGAUSS = 0.1
#: GPS seconds ahead of UTC, from the GPS second (since 1980) of each leap second; before the first: 15.
LEAP_SECONDS = ((1025136016, 16), (1119744017, 17), (1167264018, 18))
GPS_EPOCH_UNIX = 315964800
#: SERVOx_FUNCTION of motors 1 to 8 and 9 to 12.
MOTOR_FUNCTIONS = {**{33 + i: i for i in range(8)}, **{82 + i: 8 + i for i in range(4)}}
#: Motors by FRAME_CLASS: quad, hexa, octa, octaquad, Y6, tri, dodecahexa.
MOTORS_BY_FRAME = {1: 4, 2: 6, 3: 8, 4: 8, 5: 6, 7: 3, 12: 12}
INTEGER_LETTERS = "bBhHiI"
#: Event numbers (EV) of arming and disarming, the same in all vehicles and generations.
EVENT_ARMED, EVENT_DISARMED = 10, 11


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is a DataFlash log, binary or text."""
    return BINARY_HEAD in head or is_text_log(head)


def read(path: Path) -> FlightLog:
    """Read a DataFlash log.

    Parameters
    ----------
    path
        The ``.bin`` or ``.log`` file.

    Returns
    -------
    FlightLog
        ``imu`` is the unit of the estimator's primary lane, the others ``imu.1``, ... in instance order.

    Raises
    ------
    HaltereError
        The file holds no messages that are read.

    Notes
    -----
    Message names and units after the log message documentation of ArduPilot, three generations of it.
    """
    builder = Builder(path, "ArduPilot DataFlash")
    log = DataFlash(path)
    params = _params(log)
    _version(log, builder)
    _add_imu(log, builder, params)
    _add_magnetometer(log, builder, params)
    _add_barometer(log, builder)
    _add_gnss(log, builder)
    _add_airdata(log, builder)
    _add_rotors(log, builder, params)
    _add_power(log, builder)
    _add_vibration(log, builder, params)
    _add_modes(log, builder)
    add_solution(log, builder, params)
    add_truth(log, builder)
    for note in log.notes:
        builder.note(note)
    return builder.build()


def _params(log: DataFlash) -> dict[str, float]:
    parm = log.get("PARM")
    if parm is None or "Name" not in parm:
        return {}
    pairs = zip(parm.texts("Name"), parm.get("Value").tolist(), strict=True)
    return {name: value for name, value in pairs if math.isfinite(value)}  # a damaged value is none


def _version(log: DataFlash, builder: Builder) -> None:
    msg = log.get("MSG")
    texts = msg.texts("Message") if msg is not None and "Message" in msg else []
    version = next((t for t in texts if any(v in t for v in ("Copter", "Plane", "Rover", "Sub", "Heli"))), None)
    if version:
        builder.meta.source += f", {version}"


def _instances(log: DataFlash, name: str, *others: str) -> list[tuple[int, Messages]]:
    """Messages by unit: by instance field where the type has one, else by the older names with a number."""
    first = log.get(name)
    units: list[tuple[int, Messages]] = []
    if first is not None:
        instance = first.integers("I", "Instance", "Inst")
        if instance is None:
            units.append((0, first))
        else:
            units += [(int(i), first.where(instance == i)) for i in np.unique(instance)]
    for number, other in enumerate(others, 1):
        found = log.get(other)
        if found is not None:
            units.append((number, found))
    return units


def _primary_first(units: list[tuple[int, Messages]], wanted: int | None) -> list[tuple[int, Messages]]:
    return sorted(units, key=lambda unit: (unit[0] != wanted, unit[0]))


def _name(stream: str, i: int) -> str:
    return stream if i == 0 else f"{stream}.{i}"


def _add_imu(log: DataFlash, builder: Builder, params: dict[str, float]) -> None:
    units = _instances(log, "IMU", "IMU2", "IMU3")
    wanted = primary(log, params, "imu")
    for i, (number, unit) in enumerate(_primary_first(units, wanted)):
        columns = {f"{out}_{a}": unit.get(f"{field}{a.upper()}") for out, field in (("gyro", "Gyr"), ("accel", "Acc")) for a in "xyz"}
        builder.add(_name("imu", i), log.us(unit), columns)
        if i == 0 and number:
            builder.note(f"imu is IMU instance {number}: the estimator's primary lane used it")
    if not units:
        builder.note("no IMU messages: there is no imu stream (LOG_BITMASK without IMU)")
    unread = [name for name in ("ACC", "GYR", "ISBD") if name in log.names()]
    if unread:
        builder.note(f"raw IMU messages {', '.join(unread)} were not read: imu is the messages IMU")


def _add_magnetometer(log: DataFlash, builder: Builder, params: dict[str, float]) -> None:
    units = _primary_first(_instances(log, "MAG", "MAG2", "MAG3"), primary(log, params, "mag"))
    for i, (number, unit) in enumerate(units):
        columns = {f"mag_{a}": unit.get(f"Mag{a.upper()}") * MILLIGAUSS for a in "xyz"}
        # What the autopilot added, so that the raw field can be had back.
        columns |= {f"offset_{a}": unit.get(f"Ofs{a.upper()}") * MILLIGAUSS for a in "xyz"}
        raw, builder.meta.compass[_name("magnetometer", i)], note = ardupilot_compass(unit, number, params)
        builder.add(_name("magnetometer", i), log.us(unit), columns | raw)
        if note:
            builder.note(note)
        if i == 0 and number:
            builder.note(f"magnetometer is MAG instance {number}: the estimator's primary lane used it")
    if units:
        builder.note(
            "magnetometer is already corrected by the autopilot with its COMPASS_* parameters; "
            "offset_x, offset_y, offset_z [uT] are the offsets in it, raw_x, raw_y, raw_z [uT] the field before it"
        )


def _add_barometer(log: DataFlash, builder: Builder) -> None:
    units = _primary_first(_instances(log, "BARO", "BAR2", "BAR3"), primary(log, {}, "baro"))
    for i, (_, unit) in enumerate(units):
        columns = {"pressure": unit.get("Press"), "temperature": unit.get("Temp"), "altitude": unit.get("Alt")}
        builder.add(_name("barometer", i), log.us(unit), columns)
    control = log.get("CTUN")
    if not units and control is not None and ("BarAlt" in control or "BAlt" in control):
        builder.add("barometer", log.us(control), {"altitude": control.get("BarAlt", "BAlt")})
        builder.note("barometer is the barometric altitude in CTUN: the log has no BARO messages")


def _add_gnss(log: DataFlash, builder: Builder) -> None:
    accuracies = dict(_instances(log, "GPA", "GPA2"))
    for i, (number, gps) in enumerate(_primary_first(_instances(log, "GPS", "GPS2"), primary(log, {}, "gps"))):
        us = log.us(gps)
        speed, course = gps.get("Spd"), np.radians(gps.get("GCrs"))
        columns: Columns = {
            "lat": gps.get("Lat"),
            "lon": gps.get("Lng"),
            "alt": gps.get("Alt"),
            "vel_n": speed * np.cos(course),
            "vel_e": speed * np.sin(course),
            "vel_d": gps.get("VZ"),
        }
        columns |= _accuracies(log, us, accuracies.get(number), columns)
        columns |= {"fix_type": gps.get("Status"), "num_sats": gps.get("NSats")}
        builder.add(_name("gnss", i), us, columns)
        if builder.utc is None:
            builder.utc = _utc(gps, us)


def _accuracies(log: DataFlash, us: IntArray, gpa: Messages | None, columns: Columns) -> Columns:
    """Accuracies of the accuracy message nearest in time to each fix, within half a second; 0 means not given."""
    if gpa is None or not len(us):
        return {}
    at = log.us(gpa)
    order = np.argsort(at, kind="stable")
    at = at[order]
    after = np.minimum(np.searchsorted(at, us), len(at) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(at[before] - us) <= np.abs(at[after] - us), before, after)
    close = np.abs(at[nearest] - us) <= 500_000
    rows = order[nearest]
    out: Columns = {}
    for name, field in (("h_acc", "HAcc"), ("v_acc", "VAcc"), ("s_acc", "SAcc")):
        values = gpa.get(field)[rows]
        values[~close | (values <= 0.0)] = np.nan
        out[name] = values
    flat = close & (gpa.get("VV")[rows] == 0.0)
    columns["vel_d"][flat] = np.nan  # the receiver gives no vertical velocity
    return out


def _utc(gps: Messages, us: IntArray) -> tuple[int, int] | None:
    """A stamp of the log's clock and the UTC time at it [us since 1970], from the least delayed fix."""
    week, ms = gps.integers("GWk", "Week"), gps.integers("GMS", "TimeMS")
    if week is None or ms is None:
        return None
    good = np.flatnonzero((gps.get("Status") >= 3.0) & (week > 1000))
    if not len(good):
        return None
    seconds = week * 604800 + ms // 1000
    leap = np.full(len(week), 15)
    for since, ahead in LEAP_SECONDS:
        leap[seconds >= since] = ahead
    utc = (GPS_EPOCH_UNIX + seconds - leap) * 1_000_000 + (ms % 1000) * 1000
    i = good[np.argmin((us - utc)[good])]
    return int(us[i]), int(utc[i])


def _add_airdata(log: DataFlash, builder: Builder) -> None:
    for i, (_, unit) in enumerate(_primary_first(_instances(log, "ARSP", "ASP2"), primary(log, {}, "airspeed"))):
        us, speed = log.us(unit), unit.get("Airspeed")
        healthy = unit.get("H", "Health") != 0.0
        builder.discard(_name("airdata", i), "airspeed sensor unhealthy", int((~healthy).sum()))
        us, speed = us[healthy], speed[healthy]
        baro = log.get("BARO")
        if baro is not None and "Press" in baro and len(us):
            # ARSP is the equivalent airspeed; density at the logged pressure after the standard atmosphere.
            order = np.argsort(log.us(baro), kind="stable")
            pressure = np.interp(us, log.us(baro)[order], baro.get("Press")[order]) / 101325.0
            speed = speed * np.sqrt(np.clip(pressure, 0.1, 1.5) ** (0.190263 - 1.0))
            builder.note("airspeed is ARSP made true with the density of the standard atmosphere at the logged pressure")
        else:
            builder.note("airspeed is the equivalent airspeed of ARSP: without pressure it cannot be made true")
        builder.add(_name("airdata", i), us, {"airspeed": speed})


def _add_rotors(log: DataFlash, builder: Builder, params: dict[str, float]) -> None:
    motors = _motors(log, params)
    speeds = _rotor_speeds(log, builder, motors)
    if speeds is not None:
        builder.add("rotors", *speeds)
    commands = _rotor_commands(log, builder, motors, params)
    if commands is not None:
        builder.add("actuators" if speeds is not None else "rotors", *commands)
        if speeds is not None:
            builder.note("rotor commands are in the stream actuators: they have their own time base")


def _motors(log: DataFlash, params: dict[str, float]) -> dict[int, int]:
    """Motor number by output channel (both from 0), from SERVOx_FUNCTION."""
    functions = {c: int(params.get(f"SERVO{c + 1}_FUNCTION", 0)) for c in range(32)}
    return {c: MOTOR_FUNCTIONS[f] for c, f in functions.items() if f in MOTOR_FUNCTIONS}


def _rotor_speeds(log: DataFlash, builder: Builder, motors: dict[int, int]) -> tuple[IntArray, Columns] | None:
    esc = log.get("ESC")
    if esc is not None and "RPM" in esc:
        us, instance, rpm = log.us(esc), esc.integers("Instance", "I"), esc.get("RPM")
        instance = np.zeros(len(us), np.int64) if instance is None else instance
    else:
        units = [(i, unit) for i in range(8) if (unit := log.get(f"ESC{i + 1}")) is not None and "RPM" in unit]
        if not units:
            return _rpm_sensors(log, builder)
        us = np.concatenate([log.us(unit) for _, unit in units])
        instance = np.concatenate([np.full(len(unit), i) for i, unit in units])
        rpm = np.concatenate([unit.get("RPM") for _, unit in units])
    order = np.argsort(us, kind="stable")
    us, instance, rpm = us[order], instance[order], rpm[order]
    # One pass over the speed controllers is logged within some microseconds, in ascending order: that is one row.
    first = np.ones(len(us), dtype=bool)
    first[1:] = (np.diff(us) > 1000) | (np.diff(instance) <= 0)
    row = np.cumsum(first) - 1
    columns: Columns = {}
    for i in np.unique(instance):
        number = motors.get(int(i), None if motors else int(i))
        if number is None:
            builder.note(f"ESC instance {i} left out: SERVO{i + 1}_FUNCTION is no motor")
            continue
        mine = instance == i
        values = columns.setdefault(f"speed_{number}", np.full(int(first.sum()), np.nan))
        values[row[mine]] = np.abs(rpm[mine]) * RPM
    builder.note(
        "rotors are numbered by SERVOx_FUNCTION" if motors else "rotors are numbered by ESC instance: no SERVOx_FUNCTION is logged"
    )
    return (us[first], dict(sorted(columns.items(), key=lambda item: int(item[0][6:])))) if columns else None


def _rpm_sensors(log: DataFlash, builder: Builder) -> tuple[IntArray, Columns] | None:
    rpm = log.get("RPM")
    if rpm is None:
        return None
    columns = {f"speed_{i}": rpm.get(*names) for i, names in enumerate((("rpm1", "RPM1"), ("rpm2", "RPM2")))}
    us = log.us(rpm)
    if "RPM" in rpm:
        instance = rpm.integers("I", "Inst", "Instance")
        if instance is not None and len(np.unique(instance)) > 1:
            rpm = rpm.where(instance == instance.min())
            us = log.us(rpm)
        columns = {"speed_0": rpm.get("RPM")}
    for name, values in columns.items():
        values[values < 0.0] = np.nan  # -1: no reading
        columns[name] = values * RPM
    columns = {k: v for k, v in columns.items() if np.nan_to_num(v).any()}
    if not columns:
        return None
    builder.note("rotor speeds are RPM sensors: the log does not tell which rotor they watch")
    return us, columns


def _rotor_commands(log: DataFlash, builder: Builder, motors: dict[int, int], params: dict[str, float]) -> tuple[IntArray, Columns] | None:
    outputs = log.get("RCOU", "MOT")
    if outputs is None:
        return None
    if outputs.name == "MOT":
        channels = {c: c for c in range(8) if f"Mot{c + 1}" in outputs}
    elif motors:
        channels = motors
    elif "Copter" in builder.meta.source or "Solo" in builder.meta.source:
        channels = {c: c for c in range(MOTORS_BY_FRAME.get(int(params.get("FRAME_CLASS", 1)), 4))}
        builder.note(f"rotor commands are the first {len(channels)} output channels: the log does not name its motors")
    else:
        builder.note("RCOU left out: the log does not tell which channels are motors")
        return None
    columns: Columns = {}
    for channel, motor in sorted(channels.items(), key=lambda item: item[1]):
        width = outputs.get(f"C{channel + 1}", f"Chan{channel + 1}", f"Ch{channel + 1}", f"Mot{channel + 1}")
        columns[f"command_{motor}"] = np.clip((width - 1000.0) / 1000.0, 0.0, 1.0)
    builder.note("rotor commands are (pulse width - 1000 us) / 1000 us")
    return log.us(outputs), columns


def _add_power(log: DataFlash, builder: Builder) -> None:
    units = _instances(log, "BAT", "BAT2") or _instances(log, "CURR", "CURR2")

    def scaled(unit: Messages, field: str) -> FloatArray:
        # Integers were hundredths, with no scale in the format.
        return unit.get(field) * (0.01 if unit.letters.get(field, "f") in INTEGER_LETTERS else 1.0)

    for i, (_, unit) in enumerate(units):
        builder.add(_name("power", i), log.us(unit), {"voltage": scaled(unit, "Volt"), "current": scaled(unit, "Curr")})


def _add_vibration(log: DataFlash, builder: Builder, params: dict[str, float]) -> None:
    """Vibration and clipping by unit, numbered as the imu streams are."""
    first = log.get("VIBE")
    if first is None:
        return
    units = [number for number, _ in _primary_first(_instances(log, "IMU", "IMU2", "IMU3"), primary(log, params, "imu"))]
    levels = {f"vibe_{a}": first.get(f"Vibe{a.upper()}") for a in "xyz"}
    instance = first.integers("IMU")
    for i, number in enumerate(units or [0]):
        if instance is not None:
            unit = first.where(instance == number)
            columns = {f"vibe_{a}": unit.get(f"Vibe{a.upper()}") for a in "xyz"} | {"clip": unit.get("Clip")}
        else:  # one message for all units: levels of the first, clipping of each
            unit = first
            columns = (levels if number == 0 else {}) | {"clip": first.get(f"Clip{number}")}
        if len(unit):
            builder.add(_name("vibration", i), log.us(unit), columns)


def _add_modes(log: DataFlash, builder: Builder) -> None:
    mode = log.get("MODE")
    names: list[str] = []
    if mode is not None:
        numbers = mode.integers("ModeNum")
        if numbers is None and "Mode" in mode and np.asarray(mode.columns["Mode"]).dtype.kind in "iu":
            numbers = mode.integers("Mode")
        if numbers is not None:
            source = builder.meta.source.replace("Solo", "Copter")
            vehicle = next((v for v in ARDUPILOT_MODES if v in source), None)
            names = [ardupilot_mode(int(n), vehicle) for n in numbers]
        elif "Mode" in mode:
            names = [spelt(name) for name in mode.texts("Mode")]
    us = log.us(mode) if mode is not None and names else np.empty(0, np.int64)
    arm = log.get("ARM")
    event = log.get("EV")
    numbers = event.integers("Id", "Event") if event is not None else None
    if arm is not None and "ArmState" in arm:
        armed = log.us(arm), np.asarray(arm.get("ArmState") != 0.0, dtype=np.float64)
    elif event is not None and numbers is not None:
        mine = (numbers == EVENT_ARMED) | (numbers == EVENT_DISARMED)
        armed = log.us(event)[mine], np.asarray(numbers[mine] == EVENT_ARMED, dtype=np.float64)
    else:
        armed = np.empty(0, np.int64), np.empty(0)
    add_modes(builder, (us, names), armed)
