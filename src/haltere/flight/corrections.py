"""Units, axes and calibration that a log has other than it should, put right as configured, once, before anything is checked.

It finds none of them itself: the door finds units and axes, `haltere.calibrate` the calibration.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.flight import axes
from haltere.flight.load import load_at
from haltere.flight.log import FlightLog, Stream
from haltere.flight.schema import base_name
from haltere.flight.units import factor

__all__ = [
    "AXES", "CALIBRATION", "UNIT_KEYS", "calibrated", "calibration", "correct", "mounted", "mounting_matrix", "on_unit",
    "raw_vectors",
]  # fmt: skip

FloatArray = NDArray[np.float64]

#: Configuration key of a unit: the kind of stream, its columns, and the unit they should have. Every instance of a stream is meant.
UNIT_KEYS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "unit.gyro": ("imu", ("gyro_x", "gyro_y", "gyro_z"), "rad/s"),
    "unit.accel": ("imu", ("accel_x", "accel_y", "accel_z"), "m/s^2"),
    "unit.magnetometer": ("magnetometer", ("mag_x", "mag_y", "mag_z", "raw_x", "raw_y", "raw_z"), "uT"),
    "unit.pressure": ("barometer", ("pressure",), "Pa"),
    "unit.gnss_position": ("gnss", ("lat", "lon"), "deg"),
    "unit.gnss_altitude": ("gnss", ("alt",), "m"),
    "unit.gnss_velocity": ("gnss", ("vel_n", "vel_e", "vel_d"), "m/s"),
}
#: Configuration key of axes: the kind of stream, and the stem of its columns.
AXES: dict[str, tuple[str, str]] = {
    "axes.gyro": ("imu", "gyro"),
    "axes.accel": ("imu", "accel"),
    "axes.magnetometer": ("magnetometer", "mag"),
}
#: Configuration keys of the magnetometer's calibration, in the order offset (3), matrix by rows (9), load (3), and the load's word.
CALIBRATION: tuple[str, ...] = (
    *(f"magnetometer.offset_{a}" for a in "xyz"),
    *(f"magnetometer.matrix_{r}{c}" for r in "xyz" for c in "xyz"),
    *(f"magnetometer.load_{a}" for a in "xyz"),
    "magnetometer.load",
)
#: The stream that the calibration is of; other units have their own.
CALIBRATED = "magnetometer"


def correct(flight: FlightLog, config: Mapping[str, Any]) -> FlightLog:
    """A flight in the schema's units and axes, from one in those that the configuration names.

    Parameters
    ----------
    flight
        The log as read. It is not changed.
    config
        Values of the keys ``unit.*``, ``axes.*`` and ``magnetometer.*``; a key that is absent is at its default.

    Returns
    -------
    FlightLog
        The same object where every key is at its default; else a copy whose notes say what was taken as what.

    Raises
    ------
    HaltereError
        A load whose samples the flight does not have, or columns that are no numbers.
    """
    streams = dict(flight.streams)
    notes: list[str] = []
    meta = flight.meta
    unit = str(config.get("unit.time", "s"))
    if unit != "s":
        k = factor("s", unit)
        streams = {name: _with(s, {"t": k * s.t}) for name, s in streams.items()}
        meta = dataclasses.replace(meta, time_offset=k * meta.time_offset)
        notes.append(f"all streams: times taken as {unit} as configured (unit.time)")
    for key, (kind, columns, schema_unit) in UNIT_KEYS.items():
        unit = str(config.get(key, schema_unit))
        if unit != schema_unit:
            for name in _instances(streams, kind):
                there = [c for c in columns if c in streams[name]]
                streams[name] = _with(streams[name], {c: factor(schema_unit, unit) * _numbers(streams[name], name, c) for c in there})
                notes.append(f"{name}: {', '.join(there) or 'nothing'} taken as {unit} as configured ({key})")
    for key, (kind, stem) in AXES.items():
        word = str(config.get(key, axes.WORDS[0]))
        if word != axes.WORDS[0]:
            for name in _instances(streams, kind):
                if all(f"{stem}_{a}" in streams[name] for a in "xyz"):
                    v = np.column_stack([_numbers(streams[name], name, f"{stem}_{a}") for a in "xyz"])
                    streams[name] = _with(streams[name], _turned(stem, v, word))
                    notes.append(f"{name}: {stem} x, y, z taken as {word} as configured ({key})")
                if stem == "mag" and all(f"raw_{a}" in streams[name] for a in "xyz"):
                    streams[name] = _with(streams[name], _turned("raw", streams[name].vector("raw"), word))
    unit_ = str(config.get("imu.unit", "0"))
    if unit_ != "0":
        streams = dict(on_unit(FlightLog(streams, meta), f"imu.{unit_}").streams)
        notes.append(f"imu is the log's imu.{unit_}, and the other way round, as configured (imu.unit)")
    parameters = calibration(config)
    if parameters is not None and CALIBRATED in streams:
        mag = streams[CALIBRATED]
        raw, undone = raw_vectors(mag)
        word = str(config.get("magnetometer.load", "off"))
        load = load_at(FlightLog(streams, meta), word, mag.t) if word != "off" else np.zeros(len(mag))
        m = calibrated(raw, parameters, load)
        streams[CALIBRATED] = _with(mag, {f"mag_{a}": m[:, k] for k, a in enumerate("xyz")})
        notes.append(
            f"{CALIBRATED}: calibrated as configured (magnetometer.*)"
            + (", from the field before the autopilot's own correction" if undone else "")
            + (f", with the field that follows {word}" if word != "off" else "")
        )
    if not notes:
        return flight
    return FlightLog(streams, meta, [*flight.notes, *notes], flight.discarded)


def on_unit(flight: FlightLog, stream: str) -> FlightLog:
    """The same flight with another inertial unit as ``imu``, and ``imu`` as that one.

    Raises
    ------
    HaltereError
        The flight has no such unit.
    """
    if stream == "imu":
        return flight
    if stream not in flight:
        there = ", ".join(n for n in flight if base_name(n) == "imu")
        raise HaltereError(f"a stream {stream}", there or "no imu", "imu.unit", "imu.unit=0 takes the first")
    streams = dict(flight.streams)
    streams["imu"], streams[stream] = streams[stream], streams["imu"]
    return FlightLog(streams, flight.meta, flight.notes, flight.discarded)


def calibration(config: Mapping[str, Any]) -> FloatArray | None:
    """Offset (3), matrix by rows (9) and load (3) of a configuration, None where they change nothing."""
    identity = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    values = np.array([float(config.get(k, d)) for k, d in zip(CALIBRATION, identity, strict=False)])
    if config.get("magnetometer.load", "off") == "off":
        values[12:] = 0.0
    return None if np.array_equal(values, identity) else values


def calibrated(raw: FloatArray, parameters: FloatArray, load: FloatArray | float = 0.0) -> FloatArray:
    """Vectors (n, 3) [µT] after ``A (raw - b - k load)``, parameters as `calibration` gives them."""
    shifted = raw - parameters[:3] - np.multiply.outer(np.broadcast_to(load, len(raw)), parameters[12:15])
    return np.asarray(shifted @ parameters[3:12].reshape(3, 3).T)


def raw_vectors(mag: Stream) -> tuple[FloatArray, bool]:
    """Vectors (n, 3) [µT] before the correction of the autopilot that logged them, and whether there was one to undo.

    A reader that knows it gives the columns ``raw_x, raw_y, raw_z`` beside ``mag_x, mag_y, mag_z``.
    """
    if all(f"raw_{a}" in mag for a in "xyz"):
        return mag.vector("raw"), True
    return mag.vector("mag"), False


def _turned(stem: str, v: FloatArray, word: str) -> dict[str, FloatArray]:
    """Columns of vectors (n, 3) turned into the body: picked and negated, which is exact and keeps NaN in its own axis."""
    C = axes.matrix(word)
    source = np.argmax(np.abs(C), axis=1)
    return {f"{stem}_{a}": float(C[k, source[k]]) * v[:, source[k]] for k, a in enumerate("xyz")}


def _instances(streams: Mapping[str, Stream], kind: str) -> list[str]:
    return [name for name in streams if base_name(name) == kind]


def _with(stream: Stream, columns: Mapping[str, FloatArray]) -> Stream:
    return Stream({**stream.columns, **columns})


def _numbers(stream: Stream, name: str, column: str) -> FloatArray:
    values = stream[column]
    if values.dtype.kind != "f":
        raise HaltereError("numbers", f"text such as {str(values[0])!r}", f"stream {name}, column {column}", "check the column map")
    return values


def mounted(flight: FlightLog, stream: str, vectors: FloatArray) -> FloatArray:
    """Vectors (n, 3) of a sensor turned into the body frame by the flight's mounting quaternion q_b_sensor.

    Raises
    ------
    HaltereError
        The quaternion is not of unit length.
    """
    if flight.meta.mounting.get(stream) is None:
        return np.ascontiguousarray(vectors)
    return np.ascontiguousarray(vectors @ mounting_matrix(flight, stream).T)


def mounting_matrix(flight: FlightLog, stream: str) -> FloatArray:
    """Matrix (3, 3) from a sensor's axes to the body, of the flight's mounting quaternion; unity where it names none.

    Raises
    ------
    HaltereError
        The quaternion is not of unit length.
    """
    q = flight.meta.mounting.get(stream)
    if q is None:
        return np.eye(3)
    parts = [float(x) for x in q]
    length = math.hypot(*parts)
    if not (len(parts) == 4 and abs(length - 1.0) <= 1e-2):
        raise HaltereError("a unit quaternion q_b_sensor", f"{tuple(q)}", f"flight.toml [mounting] {stream}", "scalar first: [w, x, y, z]")
    w, x, y, z = (part / length for part in parts)
    return np.array([
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ])  # fmt: skip
