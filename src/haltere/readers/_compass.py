"""The magnetic field before an autopilot's own correction, from its parameters, and whose parameters they are. It calibrates nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from haltere.readers._common import Columns, FloatArray, IntArray

if TYPE_CHECKING:
    from haltere.readers._dataflash import Messages
    from haltere.readers._ulog import Log, Topic

__all__ = ["ardupilot_compass", "px4_compass"]

#: Gauss and milligauss in microtesla.
GAUSS, MILLIGAUSS = 100.0, 0.1
#: Roll, pitch, yaw [deg] of PX4's enumeration Rotation, which is MAVLink's MAV_SENSOR_ORIENTATION up to 37.
ROTATIONS = (
    (0, 0, 0), (0, 0, 45), (0, 0, 90), (0, 0, 135), (0, 0, 180), (0, 0, 225), (0, 0, 270), (0, 0, 315), (180, 0, 0), (180, 0, 45),
    (180, 0, 90), (180, 0, 135), (0, 180, 0), (180, 0, 225), (180, 0, 270), (180, 0, 315), (90, 0, 0), (90, 0, 45), (90, 0, 90),
    (90, 0, 135), (270, 0, 0), (270, 0, 45), (270, 0, 90), (270, 0, 135), (0, 90, 0), (0, 270, 0), (0, 180, 90), (0, 180, 270),
    (90, 90, 0), (180, 90, 0), (270, 90, 0), (90, 180, 0), (270, 180, 0), (90, 270, 0), (180, 270, 0), (270, 270, 0), (90, 180, 90),
    (90, 0, 270), (90, 68, 293), (0, 315, 0), (90, 315, 0), (270, 0, 180), (270, 0, 270), (0, 90, 180), (0, 9, 180), (0, 45, 0),
    (270, 0, 225), (270, 0, 315),
)  # fmt: skip
#: CAL_MAGn_ROT of a rotation given by its own angles, and what current compensation is of (CAL_MAG_COMP_TYP: battery 0, battery 1).
CUSTOM_ROTATION = 100
BY_CURRENT = {2: 0, 3: 1}
#: COMPASS_SCALE is used by ArduPilot within these.
SCALES = (1.0 / 1.5, 1.5)


def _turn(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Matrix from sensor to body of Euler angles [deg]."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.radians([roll, pitch, yaw])) for f in (np.cos, np.sin))
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip


def _symmetric(diagonal: list[float], off: list[float]) -> FloatArray:
    (x, y, z), (xy, xz, yz) = diagonal, off
    return np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]])


def _px4_rotation(p: Mapping[str, float], slot: int) -> FloatArray | None:
    """From the sensor's axes, in which PX4 corrects, to the body."""
    rotation = int(p.get(f"CAL_MAG{slot}_ROT", -1))
    if rotation == CUSTOM_ROTATION:
        return _turn(*(p.get(f"CAL_MAG{slot}_{a}", 0.0) for a in ("ROLL", "PITCH", "YAW")))
    if 0 <= rotation < len(ROTATIONS):
        return _turn(*ROTATIONS[rotation])
    board = int(p.get("SENS_BOARD_ROT", 0))
    if rotation >= 0 or not 0 <= board < len(ROTATIONS):
        return None
    return _turn(*(p.get(f"SENS_BOARD_{a}_OFF", 0.0) for a in "XYZ")) @ _turn(*ROTATIONS[board])


def px4_compass(log: Log, unit: Topic, us: IntArray, mag: Columns) -> tuple[Columns, dict[str, Any], str]:
    """Raw columns [µT] in the body's axes, what parameters they belong to, and a note.

    PX4 corrects in the sensor's axes and turns afterwards: ``m = R S (m_raw + power · comp - off)``
    (src/lib/sensor_calibration/Magnetometer.hpp), gauss, power in kA where it is the current.
    """
    p = log.numbers
    device = unit.last("device_id") if "device_id" in unit else int(p.get("CAL_MAG_PRIME", 0))
    slots = [n for n in range(4) if device and int(p.get(f"CAL_MAG{n}_ID", 0)) == device]
    if not slots:
        return {}, {}, "magnetometer: its calibration is in no CAL_MAG parameters of the log: what the autopilot applied cannot be undone"
    n = slots[0]
    R = _px4_rotation(p, n)
    S = _symmetric([p.get(f"CAL_MAG{n}_{a}SCALE", 1.0) for a in "XYZ"], [p.get(f"CAL_MAG{n}_{a}ODIAG", 0.0) for a in "XYZ"])
    off = np.array([p.get(f"CAL_MAG{n}_{a}OFF", 0.0) for a in "XYZ"])
    comp = np.array([p.get(f"CAL_MAG{n}_{a}COMP", 0.0) for a in "XYZ"])
    kind = int(p.get("CAL_MAG_COMP_TYP", 0))
    if R is None or not (np.isfinite(S).all() and np.linalg.cond(S) < 1e3 and np.isfinite([off, comp]).all()):
        return {}, {}, f"magnetometer: CAL_MAG{n} cannot be undone: a rotation or scale that is none"
    power = np.zeros(len(us))
    if kind and comp.any():
        battery = [t for t in log.all("battery_status") if t.instance == BY_CURRENT.get(kind, -1)]
        if not battery:
            return {}, {}, f"magnetometer: the power compensation of CAL_MAG{n} (CAL_MAG_COMP_TYP {kind}) cannot be undone"
        power = np.interp(us, battery[0].us, battery[0].get("current_a")) * 1e-3
    m = np.column_stack([mag[f"mag_{a}"] for a in "xyz"]) / GAUSS
    raw = (np.linalg.solve(S, R.T @ m.T).T + off - np.outer(power, comp)) @ R.T * GAUSS
    meta = {"autopilot": "PX4", "slot": n, "device": int(device or 0), "rotation": R.ravel().tolist()}
    return {f"raw_{a}": raw[:, k] for k, a in enumerate("xyz")}, meta, ""


def ardupilot_compass(unit: Messages, number: int, p: Mapping[str, float]) -> tuple[Columns, dict[str, Any], str]:
    """Raw columns [µT] in the body's axes, what parameters they belong to, and a note.

    ArduPilot corrects after the rotation: ``m = D (m_raw + ofs) + mot``, milligauss; before compensation by motor there was
    ``m = D (m_raw + ofs + mot)`` (libraries/AP_Compass/AP_Compass_Backend.cpp, correct_field).
    """
    slot = number
    wanted = int(p.get(f"COMPASS_PRIO{number + 1}_ID", 0))
    for n in range(3):
        if wanted and int(p.get(f"COMPASS_DEV_ID{_suffix(n)}", 0)) == wanted:
            slot = n
    s = _suffix(slot)
    meta = {"autopilot": "ArduPilot", "slot": slot, "device": int(p.get(f"COMPASS_DEV_ID{s}", 0)), "scale": f"COMPASS_SCALE{s}" in p}
    meta["mot_inside"] = "COMPASS_PMOT_EN" not in p
    m = np.column_stack([unit.get(f"Mag{a}") for a in "XYZ"])
    ofs = np.column_stack([unit.get(f"Ofs{a}") for a in "XYZ"])
    known = [p.get(f"COMPASS_OFS{s}_{a}", np.nan) for a in "XYZ"]
    ofs = np.where(np.isfinite(ofs), ofs, known)
    mot = np.nan_to_num(np.column_stack([unit.get(f"MO{a}", f"MOfs{a}") for a in "XYZ"]))
    diagonal = [p.get(f"COMPASS_DIA{s}_{a}", 1.0) for a in "XYZ"]
    D = _symmetric(diagonal if any(diagonal) else [1.0] * 3, [p.get(f"COMPASS_ODI{s}_{a}", 0.0) for a in "XYZ"])
    scale = p.get(f"COMPASS_SCALE{s}", 1.0)
    D = D * (scale if SCALES[0] < scale < SCALES[1] else 1.0)
    if not (np.isfinite(ofs).any() and np.isfinite(D).all() and np.linalg.cond(D) < 1e3):
        return {}, meta, "magnetometer: what the autopilot corrected cannot be undone: no offsets in the log, or a matrix that is none"
    if meta["mot_inside"]:
        raw = np.linalg.solve(D, m.T).T - mot - ofs
    else:
        raw = np.linalg.solve(D, (m - mot).T).T - ofs
    return {f"raw_{a}": raw[:, k] * MILLIGAUSS for k, a in enumerate("xyz")}, meta, ""


def _suffix(slot: int) -> str:
    return "" if slot == 0 else str(slot + 1)
