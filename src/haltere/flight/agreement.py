"""Which of gyro, accelerometer and magnetometer has other axes or units than the rest, as turning and dip tell. It drops nothing.

Gyro against magnetometer, and gyro against specific force where that is gravity, are compared by `haltere.flight.turning`. Two that
disagree are two suspects; the third decides where it can. The dip shows a magnetometer that is upside down, which turning cannot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.flight import axes, turning
from haltere.flight.turning import Turning

__all__ = ["Accused", "judge", "option"]

FloatArray = NDArray[np.float64]

#: Least turning [rad] and number of windows with more than 0.1 rad to conclude from: magnetometer; specific force, which also accelerates.
MAGNETOMETER_ENOUGH, ACCEL_ENOUGH = (0.5, 3), (1.0, 10)
#: Specific force is taken for gravity within this much of its median [m/s^2].
STEADY = 0.4
#: A sine of the dip less than this, known or measured, tells no sign.
DIP_SIGN = 0.35


@dataclass(frozen=True)
class Accused:
    """A finding against the magnetometer, or against it and the gyro: what was found, and what to do."""

    found: str
    remedy: str


def option(sensor: str, turn: FloatArray, given: Mapping[str, Any], mounting: Mapping[str, Any]) -> str:
    """The option that turns a sensor by ``turn`` on top of what is configured already.

    Parameters
    ----------
    sensor
        ``gyro``, ``accel`` or ``magnetometer``.
    turn
        Signed permutation (3, 3).
    given
        Configuration as given.
    mounting
        Mounting quaternions of the flight; where the sensor has one, axes are not all there is to it.
    """
    if ("magnetometer" if sensor == "magnetometer" else "imu") in mounting:
        return f"check [mounting] in flight.toml and axes.{sensor}"
    before = axes.matrix(str(given.get(f"axes.{sensor}", axes.WORDS[0])))
    return f"--set axes.{sensor}={axes.word(turn @ before)}"


def judge(
    t: FloatArray,
    gyro: FloatArray,
    accel: FloatArray,
    t_mag: FloatArray,
    mag: FloatArray,
    *,
    dip: float = math.nan,
    where: str = "stream imu",
    given: Mapping[str, Any] | None = None,
    mounting: Mapping[str, Any] | None = None,
) -> Accused | None:
    """Compare the three sensors.

    Parameters
    ----------
    t, gyro, accel
        Checked IMU in the body frame: (n,), (n, 3) [rad/s], (n, 3) [m/s^2].
    t_mag, mag
        Checked magnetometer in the body frame, (m,), (m, 3); may be empty.
    dip
        Dip of the field [rad], down positive, where it is known.
    where
        Of the IMU, for the error.
    given, mounting
        Configuration and mounting quaternions as given, for the remedies.

    Returns
    -------
    Accused or None
        The magnetometer is not to be used: it, or the gyro, has other axes.

    Raises
    ------
    HaltereError
        Gyro or accelerometer has other axes or another unit.
    """
    given, mounting = given or {}, mounting or {}
    by_mag = turning.compare(t, gyro, t_mag, mag)
    by_accel = turning.compare(t, gyro, t, accel, steady=STEADY)
    by_mag = by_mag if by_mag is not None and by_mag.enough(*MAGNETOMETER_ENOUGH) else None
    by_accel = by_accel if by_accel is not None and by_accel.enough(*ACCEL_ENOUGH) else None
    for found, field in ((by_mag, "magnetic field"), (by_accel, "direction of gravity")):
        if found is not None and found.disagrees and found.factor != 1.0:
            raise HaltereError("angular rates in rad/s", _words(found, field), where, _unit_remedy(found.factor, given))
    suspects = [f for f in (by_mag, by_accel) if f is not None and f.disagrees]
    mirrored = next((f for f in suspects if np.linalg.det(axes.matrix(f.word)) < 0.0), None)
    same = len(suspects) == 2 and suspects[0].word == suspects[1].word
    if mirrored is not None and not (len(suspects) == 2 and not same):
        field = "magnetic field" if mirrored is by_mag else "direction of gravity"
        raise HaltereError(
            "gyro axes forward, right, down (FRD)", f"mirrored ones: {_words(mirrored, field)}", where,
            option("gyro", axes.matrix(mirrored.word), given, mounting) + _ties(mirrored),
        )  # fmt: skip
    if same:
        raise HaltereError(
            "gyro axes as those of accelerometer and magnetometer", _words(suspects[0], "magnetic field and of gravity"), where,
            option("gyro", axes.matrix(suspects[0].word), given, mounting) + _ties(suspects[0]),
        )  # fmt: skip
    if by_mag is not None and by_mag.disagrees:
        return _against_magnetometer(by_mag, by_accel, t, accel, t_mag, mag, dip, given, mounting)
    if by_accel is not None and by_accel.disagrees:
        turn = axes.matrix(by_accel.word)
        back = turn.T if float(np.median((accel @ turn)[:, 2])) < 0.0 else -turn.T  # most of the time up is -z
        remedy = option("accel", back, given, mounting)
        if by_mag is None:
            remedy = f"if it is the accelerometer's axes: {remedy}; if the gyro's: {option('gyro', turn, given, mounting)}"
        raise HaltereError("one set of axes for gyro and accelerometer", _words(by_accel, "direction of gravity"), where, remedy)
    return _upside_down(by_mag, t, accel, t_mag, mag, dip, given, mounting)


def _words(found: Turning, field: str) -> str:
    less = f"{100.0 * found.given:.0f} %" if found.given > 0.0 else "nothing"
    other = f"with axes {found.word}" if found.factor == 1.0 else f"multiplied by {found.factor:.3g}"
    return f"rates that explain {less} of how the {field} turns, but {100.0 * found.best:.0f} % {other}"


def _ties(found: Turning) -> str:
    return f" (or {', '.join(found.others[:3])}: the vehicle turned too little to tell)" if found.others else ""


def _unit_remedy(factor: float, given: Mapping[str, Any]) -> str:
    unit = {turning.FACTORS[1]: "deg/s", turning.FACTORS[3]: "mrad/s"}.get(factor)
    configured = str(given.get("unit.gyro", "rad/s"))
    if configured != "rad/s":
        return f"leave out unit.gyro={configured}" if unit is None else f"check unit.gyro={configured}"
    if unit is None:
        return "they look like rad/s that were taken for deg/s and converted: leave that out"
    return f"it looks like {unit}: --set unit.gyro={unit}"


def _against_magnetometer(
    by_mag: Turning,
    by_accel: Turning | None,
    t: FloatArray,
    accel: FloatArray,
    t_mag: FloatArray,
    mag: FloatArray,
    dip: float,
    given: Mapping[str, Any],
    mounting: Mapping[str, Any],
) -> Accused:
    """The magnetometer; or it or the gyro, where neither accelerometer nor dip decides.

    A field that points up where it should point down has axes of its own that are wrong, whatever the gyro's are. Of the field turned
    back and the same turned over, which turn alike, the dip tells the right one.
    """
    turn = axes.matrix(by_mag.word)
    back = turn.T
    true = _sign(math.sin(dip)) if math.isfinite(dip) else 0.0
    right = true * _sign(turning.levelled(t, accel, t_mag, mag @ back.T))
    choices = [back, -back] if right == 0.0 else [back] if right > 0.0 else [-back]
    remedy = " or ".join(option("magnetometer", c, given, mounting) for c in choices)
    decided = (by_accel is not None and by_accel.agrees) or true * _sign(turning.levelled(t, accel, t_mag, mag)) < 0.0
    if not decided:
        remedy = f"if it is the magnetometer's axes: {remedy}; if the gyro's: {option('gyro', turn, given, mounting)}"
    return Accused(f"{_words(by_mag, 'magnetic field')}{_ties(by_mag)}", remedy)


def _upside_down(
    by_mag: Turning | None,
    t: FloatArray,
    accel: FloatArray,
    t_mag: FloatArray,
    mag: FloatArray,
    dip: float,
    given: Mapping[str, Any],
    mounting: Mapping[str, Any],
) -> Accused | None:
    """A magnetic field that points up where it should point down, or the other way round."""
    if not (len(t_mag) and math.isfinite(dip)):
        return None
    measured = turning.levelled(t, accel, t_mag, mag)
    if _sign(math.sin(dip)) * _sign(measured) >= 0.0:
        return None
    found = f"a field {math.degrees(math.asin(measured)):.0f} deg below the horizontal where the Earth's is {math.degrees(dip):.0f} deg"
    if by_mag is not None and by_mag.agrees:  # it turns rightly, so that all three axes are turned over
        return Accused(found, option("magnetometer", -np.eye(3), given, mounting))
    words = [option("magnetometer", np.diag(d), given, mounting) for d in ((1.0, -1.0, -1.0), (1.0, 1.0, -1.0), (-1.0, -1.0, -1.0))]
    return Accused(found, f"one of {', '.join(words)}")


def _sign(sine: float) -> float:
    """Sign of a sine of a dip, or zero where it tells none."""
    return math.copysign(1.0, sine) if abs(sine) > DIP_SIGN else 0.0  # of NaN none
