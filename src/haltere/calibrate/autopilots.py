"""A calibration as the parameters that PX4 and ArduPilot take, ready to paste. It sends nothing anywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.calibrate.magnetometer import MagnetometerCalibration

__all__ = ["ardupilot_parameters", "px4_parameters", "remarks"]

FloatArray = NDArray[np.float64]

#: Microtesla in a gauss, milligauss in a microtesla, and amperes in the kiloampere of PX4's power compensation.
UT_PER_GAUSS, MGAUSS_PER_UT, KILO = 100.0, 10.0, 1000.0
#: What the load is called: CAL_MAG_COMP_TYP of PX4 (battery 0), COMPASS_MOTCT of ArduPilot.
PX4_TYPE = {"off": 0, "throttle": 1, "current": 2}
ARDUPILOT_TYPE = {"off": 0, "throttle": 1, "current": 2}


def _sensor(c: MagnetometerCalibration, autopilot: str) -> Mapping[str, Any]:
    return c.sensor if c.sensor.get("autopilot") == autopilot else {}


def px4_parameters(c: MagnetometerCalibration) -> dict[str, float]:
    """Parameters of PX4: ``m_b = R S (m_raw + power · COMP - OFF)``, gauss.

    Offset, scale and compensation are in the sensor's own axes, before PX4 turns them into the body by R; R is taken from the log's
    parameters and unity where they do not tell it. (PX4 src/lib/sensor_calibration/Magnetometer.hpp.)
    """
    meta = _sensor(c, "PX4")
    n = int(meta.get("slot", 0))
    R = np.array(meta.get("rotation", np.eye(3).ravel()), dtype=np.float64).reshape(3, 3)
    offset, S = R.T @ c.offset / UT_PER_GAUSS, R.T @ c.symmetric @ R
    out: dict[str, float] = {}
    for k, a in enumerate("XYZ"):
        out[f"CAL_MAG{n}_{a}OFF"] = float(offset[k])
    for k, a in enumerate("XYZ"):
        out[f"CAL_MAG{n}_{a}SCALE"] = float(S[k, k])
    for a, (i, k) in zip("XYZ", ((0, 1), (0, 2), (1, 2)), strict=True):
        out[f"CAL_MAG{n}_{a}ODIAG"] = float(S[i, k])
    comp = -R.T @ c.load / UT_PER_GAUSS * (KILO if c.load_word == "current" else 1.0)
    known = c.load_word in PX4_TYPE
    for k, a in enumerate("XYZ"):
        out[f"CAL_MAG{n}_{a}COMP"] = float(comp[k]) + 0.0 if known and c.load_word != "off" else 0.0
    if known and c.load_word != "off":
        out["CAL_MAG_COMP_TYP"] = float(PX4_TYPE[c.load_word])
    return out


def ardupilot_parameters(c: MagnetometerCalibration) -> dict[str, float]:
    """Parameters of ArduPilot: ``m = D (m_raw + OFS) + MOT · load``, milligauss, in the body's axes.

    (ArduPilot libraries/AP_Compass/AP_Compass_Backend.cpp, correct_field.) Firmware without compensation by motor adds MOT inside the
    bracket, and then gets it so.
    """
    meta = _sensor(c, "ArduPilot")
    s = "" if not meta.get("slot", 0) else str(int(meta["slot"]) + 1)
    D = c.symmetric
    out = {f"COMPASS_OFS{s}_{a}": float(-MGAUSS_PER_UT * c.offset[k]) for k, a in enumerate("XYZ")}
    out |= {f"COMPASS_DIA{s}_{a}": float(D[k, k]) for k, a in enumerate("XYZ")}
    out |= {f"COMPASS_ODI{s}_{a}": float(D[i, k]) for a, (i, k) in zip("XYZ", ((0, 1), (0, 2), (1, 2)), strict=True)}
    known = c.load_word in ARDUPILOT_TYPE and c.load_word != "off"
    mot = -MGAUSS_PER_UT * (c.load if meta.get("mot_inside") else D @ c.load)
    out |= {f"COMPASS_MOT{s}_{a}": float(mot[k]) + 0.0 if known else 0.0 for k, a in enumerate("XYZ")}
    if known:
        out["COMPASS_MOTCT"] = float(ARDUPILOT_TYPE[c.load_word])
    if meta.get("scale"):
        out[f"COMPASS_SCALE{s}"] = 1.0
    return out


def remarks(c: MagnetometerCalibration) -> list[str]:
    """What to know before pasting."""
    out = []
    if not c.sensor:
        out.append("the log does not name its autopilot's parameters: those of the first compass are written, for a sensor not turned")
    if c.undone:
        out.append(f"the log's own correction ({c.sensor.get('autopilot', 'autopilot')}) was undone first: these replace it")
    elif c.sensor.get("autopilot") == "PX4" or not c.sensor:
        out.append("they replace whatever is set only if the log holds the raw field: what corrected it before is not known")
    if c.turn is not None:
        angle = math.degrees(float(np.linalg.norm(c.turn.vector)))
        sd = math.degrees(math.sqrt(float(np.trace(c.turn.covariance)) / 3.0))
        out.append(
            f"the rotation against the IMU, {angle:.1f} deg (1 sigma {sd:.1f} deg an axis), is not in them: autopilots take a symmetric "
            "matrix; calibration.toml has it"
        )
    if c.load_word == "rotors":
        out.append("neither autopilot has a compensation by rotor speed: calibration.toml has it")
    if c.load_word == "throttle":
        out.append("load is the mean rotor command of the log; the autopilots take their own throttle, which differs where mixing does")
    return out
