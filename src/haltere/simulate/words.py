"""Fault words (interface.md §5): what they say, checked, with sizes in SI units. It touches no flight."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from haltere.errors import UsageError, nearest

__all__ = ["KINDS", "Fault", "parse_fault"]

DEG, G = math.pi / 180.0, 9.80665

#: Units of a size, each with its factor to SI, by what is measured.
_RATE = {"rad/s": 1.0, "deg/s": DEG}
_FORCE = {"m/s2": 1.0, "m/s^2": 1.0, "g": G, "mg": 1e-3 * G}
_FIELD = {"uT": 1.0, "nT": 1e-3, "mG": 0.1, "G": 100.0}
_SPEED, _LENGTH, _PRESSURE = {"m/s": 1.0}, {"m": 1.0, "cm": 0.01}, {"Pa": 1.0, "hPa": 100.0}
_ROTOR = {"rad/s": 1.0, "rpm": 2.0 * math.pi / 60.0}
_ANGLE, _TIME = {"deg": DEG, "rad": 1.0}, {"s": 1.0, "ms": 1e-3}
_TURN = {"rad/s2": 1.0, "rad/s^2": 1.0, "deg/s2": DEG, "deg/s^2": DEG}
_NONE = {"": 1.0}

#: What each sensor measures: units of its sizes, and the axes it has.
_SENSORS: dict[str, tuple[dict[str, float], str]] = {
    "gyro": (_RATE, "xyz"),
    "accel": (_FORCE, "xyz"),
    "imu": ({}, "xyz"),
    "magnetometer": (_FIELD, "xyz"),
    "gnss": (_SPEED | _LENGTH, "ned"),
    "barometer": (_LENGTH | _PRESSURE, ""),
    "airdata": (_SPEED, ""),
    "rotors": (_ROTOR, "#"),
    "rotor": ({}, "#"),
    "model": ({}, "hx hy t r p q"),
    "wind": (_SPEED, "ned"),
}

#: Kinds of fault: what the size is (``value``: as the sensor's, ``rate``: that a second, or units of its own), and what it does.
KINDS: dict[str, tuple[str | dict[str, float] | None, str]] = {
    "bias": ("value", "adds the size"),
    "ramp": ("rate", "adds the size times the time since the start"),
    "scale": (_NONE, "multiplies by the size"),
    "noise": ("value", "adds white noise of this standard deviation a sample"),
    "stuck": (None, "holds the last value before the start"),
    "dropout": (None, "leaves the samples out"),
    "spike": ("value", "adds the size to one sample; with an end, to one in each second"),
    "delay": (_TIME, "stamps the samples later"),
    "misalign": (_ANGLE, "turns the vector about the axis (z)"),
    "saturate": ("value", "limits the magnitude"),
    "nan": (None, "puts NaN"),
    "disturb": (_NONE, "adds this fraction of the Earth's field, towards east or along the axis"),
    "step": ("value", "adds the size"),
    "thrust": (_NONE, "multiplies a rotor's thrust by the size"),
}

#: Kinds that a sensor cannot have, or is the only one to have.
_ONLY = {
    "disturb": ("magnetometer",),
    "step": ("wind",),
    "thrust": ("rotor",),
    "misalign": ("gyro", "accel", "imu", "magnetometer"),
}
_OF = {
    "imu": ("stuck", "dropout", "delay", "misalign", "nan"),
    "model": ("bias", "ramp"),
    "wind": ("step", "ramp"),
    "rotor": ("thrust",),
}
_PATTERN = re.compile(
    r"^(?P<sensor>[a-z]+)(?P<parts>(\.[A-Za-z0-9]+)*):(?P<kind>[a-z]+)(=(?P<number>[-+]?[0-9.]+(e[-+]?[0-9]+)?)\s*(?P<unit>[^@\s]*))?"
    r"@(?P<start>[0-9.]+)(-(?P<end>[0-9.]+))?$"
)


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes
    ----------
    sensor, unit, axis
        What fails: sensor, its instance (0: the one navigated with), axis or rotor number as text, None for all.
    kind
        One of `KINDS`.
    size
        In SI units; NaN where the kind has none.
    quantity
        What the size is of: for gnss ``velocity`` or ``position``, for the barometer ``altitude`` or ``pressure``, else empty.
    start, end
        Seconds of flight time; the end is infinite where none was given.
    word
        As it was written.
    """

    sensor: str
    unit: int
    axis: str | None
    kind: str
    size: float
    quantity: str
    start: float
    end: float
    word: str

    @property
    def simulated_only(self) -> bool:
        """Whether only a simulation can have it: it is in the vehicle or the air, not in a sensor."""
        return self.sensor in ("model", "rotor", "wind")

    def as_table(self) -> dict[str, Any]:
        """As ``[[fault]]`` of ``flight.toml``."""
        out: dict[str, Any] = {"word": self.word, "sensor": self.sensor, "kind": self.kind, "start": self.start}
        if self.unit:
            out["unit"] = self.unit
        if self.axis is not None:
            out["axis"] = self.axis
        if math.isfinite(self.size):
            out["size"] = self.size
        if self.quantity:
            out["quantity"] = self.quantity
        if math.isfinite(self.end):
            out["end"] = self.end
        return out


def parse_fault(word: str) -> Fault:
    """Fault of a word such as ``gyro.x:bias=3deg/s@60`` or ``gnss:dropout@100-130``.

    Raises
    ------
    UsageError
        The word is not one: form, sensor, axis, kind, size or times, with what would be right.
    """
    found = _PATTERN.match(word.strip())
    if found is None:
        raise UsageError("SENSOR[.UNIT][.AXIS]:KIND[=SIZE]@START[-END]", repr(word), "fault", "for example gyro.x:bias=3deg/s@60")
    sensor, kind = found["sensor"], found["kind"]
    if sensor not in _SENSORS:
        raise UsageError(f"a sensor ({', '.join(_SENSORS)})", repr(sensor), f"fault {word}", nearest(sensor, _SENSORS))
    if kind not in KINDS:
        raise UsageError(f"a kind of fault ({', '.join(KINDS)})", repr(kind), f"fault {word}", nearest(kind, KINDS))
    allowed = _OF.get(sensor, tuple(k for k in KINDS if sensor in _ONLY.get(k, (sensor,))))
    if kind not in allowed or (kind in _ONLY and sensor not in _ONLY[kind]):
        raise UsageError(f"a fault that {sensor} can have ({', '.join(allowed)})", repr(kind), f"fault {word}")
    unit, axis = _parts(sensor, found["parts"], word)
    size, quantity = _size(sensor, axis, kind, found["number"], found["unit"] or "", word)
    start, end = _time(found["start"], word), _time(found["end"], word) if found["end"] is not None else math.inf
    if not end > start:
        raise UsageError("an end after the start", f"{start:g} to {end:g} s", f"fault {word}")
    return Fault(sensor, unit, axis, kind, size, quantity, start, end, word.strip())


def _time(text: str, word: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError("a time in seconds", repr(text), f"fault {word}") from None


def _parts(sensor: str, text: str, word: str) -> tuple[int, str | None]:
    """Instance and axis of ``.UNIT.AXIS``."""
    parts = text.split(".")[1:]
    axes = _SENSORS[sensor][1]
    unit, axis = 0, None
    for part in parts:
        if axes == "#" and part.isdigit() and axis is None:
            axis = part
        elif part.isdigit() and axes != "#" and sensor not in ("model", "wind") and axis is None and not unit:
            unit = int(part)
        elif axis is None and part in (axes.split() if " " in axes else list(axes)) and axes != "#":
            axis = part
        else:
            can = (
                "a rotor number" if axes == "#" else f"an axis ({', '.join(axes.split() if ' ' in axes else axes)})" if axes else "no axis"
            )
            raise UsageError(f"{can} for {sensor}", repr(part), f"fault {word}")
    if sensor in ("model", "rotor", "wind") and axis is None:
        raise UsageError(f"which {'rotor' if sensor == 'rotor' else 'axis'} of {sensor}", "none", f"fault {word}")
    return unit, axis


def _size(sensor: str, axis: str | None, kind: str, number: str | None, unit: str, word: str) -> tuple[float, str]:
    """Size in SI units, and what it is of."""
    rule = KINDS[kind][0]
    if rule is None:
        if number is not None:
            raise UsageError(f"no size for {kind}", f"{number}{unit}", f"fault {word}")
        return math.nan, ""
    if number is None:
        raise UsageError(f"a size for {kind} ({KINDS[kind][1]})", "none", f"fault {word}", f"for example {kind}=...")
    units = rule if isinstance(rule, dict) else _SENSORS[sensor][0]
    if sensor == "model" and not isinstance(rule, dict):
        units = _FORCE if axis in ("hx", "hy", "t") else _TURN
    plain = unit
    if rule == "rate":
        if not unit.endswith("/s"):
            raise UsageError("a size a second for ramp", f"{number}{unit}", f"fault {word}", f"for example {next(iter(units))}/s")
        plain = unit.removesuffix("/s")
        if plain not in units and unit.removesuffix("/s") + "/s" in units:  # m/s/s is a speed a second; m/s alone a position a second
            plain = unit.removesuffix("/s")
    if plain not in units:
        said = ", ".join(f"{u}/s" if rule == "rate" else u or "a plain number" for u in units)
        raise UsageError(f"a unit of {sensor} {kind} ({said})", repr(unit), f"fault {word}")
    quantity = ""
    if not isinstance(rule, dict):
        if sensor == "gnss":
            quantity = "velocity" if plain in _SPEED else "position"
        elif sensor == "barometer":
            quantity = "pressure" if plain in _PRESSURE else "altitude"
    try:
        value = float(number)
    except ValueError:
        raise UsageError("a number", repr(number), f"fault {word}") from None
    value *= units[plain]
    if kind in ("noise", "saturate", "delay") and value <= 0.0:
        raise UsageError(f"a positive size for {kind}", f"{number}{unit}", f"fault {word}")
    return value, quantity
