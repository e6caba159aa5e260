"""Reading Betaflight-format blackbox logs (Betaflight, INAV, Indiflight) into a FlightLog. It turns units and axes, never samples."""

from __future__ import annotations

import datetime as dt
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from haltere.readers._blackbox import MAGIC, Session
from haltere.readers._common import DEG, RPM, Builder, Columns, FloatArray, IntArray, q_from_euler, unusable
from haltere.readers._modes import add_modes

if TYPE_CHECKING:
    from haltere.flight.log import FlightLog

__all__ = ["read", "sniff"]

G = 9.80665
#: FLU to FRD.
FLU = {"x": 1.0, "y": -1.0, "z": -1.0}
#: Steps of a degree a second with ``blackbox_high_resolution``.
HIGH_RESOLUTION = 10.0
#: Bits of ``flightModeFlags`` (the box ids of the firmware's ``rc_modes.h``): bit 0 is the arming switch.
BOXES = {1: "Angle", 2: "Horizon", 3: "Mag", 4: "Headfree", 5: "Passthru", 6: "Failsafe", 7: "GPS Rescue"}
INDIFLIGHT_BOXES = BOXES | {8: "Velocity Control", 9: "Position Control", 10: "Catapult", 11: "Learner"}
#: Fixes whose way differs from the motion capture's by less than this [m] are made of it.
SAME_WAY = 0.25


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is a Betaflight-format blackbox log."""
    return MAGIC in head


def read(path: Path) -> FlightLog:
    """Read the longest arming session of a blackbox log.

    Parameters
    ----------
    path
        The ``.bfl``, ``.bbl`` or ``.bbx`` file.

    Returns
    -------
    FlightLog
        ``imu`` is unfiltered where the log has it so. Motion capture that the log holds is ``truth``.

    Raises
    ------
    HaltereError
        The package orangebox is not installed, or no frame of the log can be parsed.

    Notes
    -----
    Fields and units after Betaflight's ``blackbox.c`` and its log viewer; body axes of the log are forward, left, up.
    """
    builder = Builder(path, "Blackbox")
    session = Session(path, builder)
    if not len(session.us):
        raise unusable(path, "a blackbox log with whole frames", "none", "check that the file was copied whole from the vehicle")
    firmware = _Firmware(str(session.headers.get("Firmware revision", session.headers.get("Firmware type", ""))))
    builder.meta.source += f", {firmware.text}" if firmware.text else ""
    _set_utc(session, builder)
    _add_imu(session, builder)
    _add_rotors(session, builder)
    captured = _add_capture(session, builder)
    _add_gnss(session, builder, captured)
    _add_slow_sensors(session, builder, firmware)
    _add_onboard(session, builder)
    _add_modes(session, builder, firmware)
    return builder.build()


class _Firmware:
    """Name and version (major, minor) of the firmware; (0, 0) where it does not say."""

    def __init__(self, text: str) -> None:
        self.text = text.strip()
        found = re.match(r"\s*(?P<name>\w+)(?:\s*/\s*\w+)?\s+(?P<major>\d+)\.(?P<minor>\d+)", text)
        self.name = found["name"].lower() if found else ""
        self.version = (int(found["major"]), int(found["minor"])) if found else (0, 0)

    @property
    def indiflight(self) -> bool:
        return self.name == "indiflight"

    def betaflight(self, *since: int) -> bool:
        """Whether it is Betaflight of at least a version, or Indiflight, which left Betaflight at 4.4."""
        return (self.name == "betaflight" and self.version >= since) or (self.indiflight and since <= (4, 4))


def _set_utc(session: Session, builder: Builder) -> None:
    try:
        start = dt.datetime.fromisoformat(str(session.headers.get("Log start datetime", "")))
    except ValueError:
        return
    if start.year > 2000:  # without a clock it is the year 0
        start = start if start.tzinfo else start.replace(tzinfo=dt.UTC)
        builder.utc = (int(session.us[0]), round(start.timestamp() * 1e6))


def _held(session: Session, *fields: str) -> NDArray[np.bool_]:
    """Rows at which one of several fields holds a new value; those between repeat it."""
    values = np.column_stack([session.get(f) for f in fields])
    fresh: NDArray[np.bool_] = np.asarray(np.isfinite(values).any(axis=1))
    known = np.flatnonzero(fresh)
    same = (values[known][1:] == values[known][:-1]).all(axis=1) if len(known) else np.empty(0, bool)
    fresh[known[1:][same]] = False
    return fresh


def _vector(session: Session, field: str, out: str, scale: float) -> Columns:
    return {f"{out}_{a}": session.get(f"{field}[{i}]") * scale * FLU[a] for i, a in enumerate("xyz")}


def _add_imu(session: Session, builder: Builder) -> None:
    headers = session.headers
    gyro = next((f for f in ("gyroUnfilt", "gyroADC") if session.all_of(f, 3)), None)
    accel = next((f for f in ("accUnfiltered", "accSmooth") if session.all_of(f, 3)), None)
    one_g = headers.get("acc_1G")
    if gyro is None or accel is None or not isinstance(one_g, int | float) or not one_g > 0:
        missing = [name for name, there in (("gyroADC", gyro), ("accSmooth", accel), ("acc_1G in the header", one_g)) if not there]
        builder.note(f"no imu stream: the log has no {', '.join(missing)} (blackbox_disable_acc, blackbox_disable_gyro)")
        return
    scale = _float_bits(headers.get("gyro_scale"))
    if scale is None:
        scale = 1.0
        builder.note("the header has no gyro_scale: gyro taken as whole degrees a second")
    fine = HIGH_RESOLUTION if headers.get("blackbox_high_resolution") == 1 else 1.0
    columns = _vector(session, gyro, "gyro", scale / fine * DEG) | _vector(session, accel, "accel", G / one_g)
    builder.add("imu", session.us, columns)
    builder.note(f"imu is {gyro} and {accel}, turned from forward, left, up to forward, right, down")


def _float_bits(value: Any) -> float | None:
    """A number that the header holds as the bits of a float32."""
    if not isinstance(value, int) or not 0 < value < 1 << 32:
        return None
    number = float(struct.unpack("<f", struct.pack("<I", value))[0])
    return number if np.isfinite(number) and number > 0.0 else None


def _add_rotors(session: Session, builder: Builder) -> None:
    columns: Columns = {}
    poles = session.headers.get("motor_poles")
    motors = [i for i in range(8) if f"motor[{i}]" in session]
    if session.has("omega[0]"):
        speeds: Callable[[int], FloatArray] = lambda i: np.abs(session.get(f"omega[{i}]"))  # noqa: E731
    elif session.has("eRPM[0]") and isinstance(poles, int) and poles > 0:
        # Hundreds of electrical turns a minute; a pair of poles makes one of the rotor's.
        speeds = lambda i: session.get(f"eRPM[{i}]") * (100.0 * 2.0 / poles * RPM)  # noqa: E731
    else:
        if session.has("eRPM[0]"):
            builder.note("eRPM left out: the header has no motor_poles")
        speeds = lambda i: np.full(len(session.us), np.nan)  # noqa: E731
    for i in range(8):
        speed = speeds(i)
        if np.nan_to_num(speed).any():
            columns[f"speed_{i}"] = speed
    ends = session.headers.get("motorOutput")
    if isinstance(ends, list) and len(ends) == 2 and all(isinstance(e, int) for e in ends) and ends[1] > ends[0]:
        for i in motors:
            columns[f"command_{i}"] = np.clip((session.get(f"motor[{i}]") - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)
    elif motors:
        builder.note("motor commands left out: the header has no motorOutput range")
    if columns:
        builder.add("rotors", session.us, columns)
        builder.note("rotors are numbered as the firmware's motors from 0 (in its quad X: rear right, front right, rear left, front left)")


def _add_capture(session: Session, builder: Builder) -> bool:
    """Motion capture that was sent to the vehicle: millimetres, centimetres a second, milliradians; north, east, down of its volume."""
    fields = [f"{stem}[{i}]" for stem in ("extPos", "extVel", "extAtt") for i in range(3)]
    if not all(session.has(f) for f in fields[:3]):
        return False
    fields = [f for f in fields if session.has(f)]
    rows = _held(session, *fields)
    columns: Columns = {f"pos_{a}": session.get(f"extPos[{i}]")[rows] * 1e-3 for i, a in enumerate("ned")}
    if session.all_of("extVel", 3):
        columns |= {f"vel_{a}": session.get(f"extVel[{i}]")[rows] * 1e-2 for i, a in enumerate("ned")}
    if session.all_of("extAtt", 3):
        columns |= q_from_euler(*(session.get(f"extAtt[{i}]")[rows] * 1e-3 for i in range(3)))
    if int(rows.sum()) < 2:
        return False
    builder.add("truth", session.us[rows], columns)
    builder.note(
        f"truth is the motion capture that the vehicle was sent, {int(rows.sum())} updates stamped when they came in "
        f"({int((~rows).sum())} rows repeat the update before); its north is the capture volume's, not the Earth's"
    )
    return True


def _add_gnss(session: Session, builder: Builder, captured: bool) -> None:
    if not session.all_of("GPS_coord", 2):
        return
    fields = [f for f in session.names if f.startswith("GPS_") and "home" not in f]
    rows = _held(session, *fields)
    lat, lon = (session.get(f"GPS_coord[{i}]")[rows] * 1e-7 for i in range(2))
    if not np.nan_to_num(lat).any():
        builder.note("no gnss stream: every fix is at latitude zero")
        return
    speed, course = session.get("GPS_speed")[rows] * 1e-2, session.get("GPS_ground_course")[rows] * (0.1 * DEG)
    columns = {"lat": lat, "lon": lon, "alt": session.get("GPS_altitude")[rows] * 0.1}
    if session.all_of("GPS_velned", 3):
        columns |= {f"vel_{a}": session.get(f"GPS_velned[{i}]")[rows] * 1e-2 for i, a in enumerate("ned")}
    else:
        columns |= {"vel_n": speed * np.cos(course), "vel_e": speed * np.sin(course)}
    columns["num_sats"] = session.get("GPS_numSat")[rows]
    name = "gnss"
    if captured and _same_way(session, lat, rows):
        name = "gnss_of_capture"
        builder.note(
            "the satellite fixes in this log follow the motion capture within "
            f"{SAME_WAY:.2f} m: they are made of it; they are in the stream gnss_of_capture, which no estimator reads"
        )
    builder.add(name, session.us[rows], columns)


def _same_way(session: Session, lat: FloatArray, rows: NDArray[np.bool_]) -> bool:
    """Whether the fixes go north as the motion capture does."""
    north = (lat - lat[np.isfinite(lat)][0]) * 111.2e3
    captured = session.get("extPos[0]")[rows] * 1e-3
    apart = north - captured
    apart = apart[np.isfinite(apart)]
    return len(apart) > 5 and float(np.max(np.abs(apart - np.median(apart)))) < SAME_WAY


def _add_slow_sensors(session: Session, builder: Builder, firmware: _Firmware) -> None:
    if session.has("baroAlt"):
        rows = _held(session, "baroAlt")
        if int(rows.sum()) > 1:
            builder.add("barometer", session.us[rows], {"altitude": session.get("baroAlt")[rows] * 1e-2})
            builder.note(f"barometer is baroAlt at its {int(rows.sum())} changes")
        else:
            builder.note("no barometer stream: baroAlt never changes")
    if session.has("magADC[0]"):
        builder.note("magADC left out: the log does not tell its unit, and it differs between sensors")
    voltage = next((f for f in ("vbatLatest", "vbat") if session.has(f)), None)
    current = next((f for f in ("amperageLatest", "amperage") if session.has(f)), None)
    scale = {True: 1e-2, False: 0.1}[firmware.betaflight(4, 0) or firmware.name == "inav"]
    if voltage is None and current is None:
        return
    if not (firmware.betaflight(3, 1) or firmware.name == "inav"):
        builder.note(f"{voltage or current} left out: its unit in this firmware is not known")
        return
    rows = _held(session, *(f for f in (voltage, current) if f))
    nothing = np.full(int(rows.sum()), np.nan)
    columns = {
        "voltage": session.get(voltage)[rows] * scale if voltage else nothing,
        "current": session.get(current)[rows] * 1e-2 if current else nothing,
    }
    builder.add("power", session.us[rows], columns)


def _add_onboard(session: Session, builder: Builder) -> None:
    """Indiflight's own attitude, position and velocity, in the frame of its motion capture."""
    if not session.all_of("quat", 4):
        return
    q = np.column_stack([session.get(f"quat[{i}]") for i in range(4)])
    length = np.linalg.norm(q, axis=1)
    length[length == 0.0] = np.nan
    columns: Columns = {f"q_{a}": q[:, i] / length for i, a in enumerate("wxyz")}
    if session.all_of("pos", 3):
        columns |= {f"pos_{a}": session.get(f"pos[{i}]") * 1e-3 for i, a in enumerate("ned")}
    if session.all_of("vel", 3):
        columns |= {f"vel_{a}": session.get(f"vel[{i}]") * 1e-2 for i, a in enumerate("ned")}
    builder.add("onboard", session.us, columns)


def _add_modes(session: Session, builder: Builder, firmware: _Firmware) -> None:
    if not session.has("flightModeFlags"):
        return
    rows = _held(session, "flightModeFlags")
    us: IntArray = session.us[rows]
    flags = [int(f) for f in session.get("flightModeFlags")[rows]]
    if firmware.betaflight(3, 1):
        boxes = {1: "Angle", 2: "Horizon"}  # the others moved from version to version
        if firmware.indiflight:
            boxes = INDIFLIGHT_BOXES
        elif (4, 0) <= firmware.version < (4, 6):
            boxes = BOXES
        names = [" + ".join(name for bit, name in boxes.items() if f >> bit & 1) or "Acro" for f in flags]
        add_modes(builder, (us, names), (us, np.array([float(f & 1) for f in flags])))
    else:
        add_modes(builder, (us, [f"flags 0x{f:x}" for f in flags]))
