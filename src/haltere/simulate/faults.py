"""Faults put into a flight, real or simulated, exact in time and size. It knows no estimator and detects nothing."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.errors import HaltereError
from haltere.flight.log import FlightLog, Stream
from haltere.simulate.flight import DISTURBANCE
from haltere.simulate.truth import rotate_to_body
from haltere.simulate.words import Fault, parse_fault

__all__ = ["disturbances", "inject"]

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Stream and columns of each sensor, by axis.
_STREAM = {"gyro": "imu", "accel": "imu", "imu": "imu"}
_EXPONENT, _SCALE = 0.190263, 44330.77


def inject(flight: FlightLog, faults: Sequence[str | Fault]) -> FlightLog:
    """Put faults into a flight.

    Parameters
    ----------
    flight
        Any flight; it is not changed.
    faults
        Fault words, or what `parse_fault` made of them; applied in their order.

    Returns
    -------
    FlightLog
        The flight with faults, which ``meta.faults`` names. Streams ``truth`` and ``onboard`` are as they were.

    Raises
    ------
    UsageError
        Not a fault word.
    HaltereError
        A fault that this flight cannot carry: no such stream, column or axis, no sample in the time, nothing that would change.
    """
    parsed = [f if isinstance(f, Fault) else parse_fault(f) for f in faults]
    streams = dict(flight.streams)
    for fault in parsed:
        if fault.simulated_only:
            raise _refused(fault, f"a flight that can have it: {fault.sensor} faults are in the vehicle or the air",
                           "a log of sensors", "use haltere simulate")  # fmt: skip
        name = _STREAM.get(fault.sensor, fault.sensor) + (f".{fault.unit}" if fault.unit else "")
        if name not in streams:
            raise _refused(fault, f"a stream {name}", ", ".join(streams) or "none")
        streams[name] = _apply(fault, name, streams[name], flight)
    meta = type(flight.meta)(**{**vars(flight.meta), "faults": [*flight.meta.faults, *(f.as_table() for f in parsed)]})
    note = "faults were injected: " + ", ".join(f.word for f in parsed)
    return FlightLog(
        streams, meta, [*flight.notes, note] if parsed else list(flight.notes), {k: dict(v) for k, v in flight.discarded.items()}
    )


def _refused(fault: Fault, expected: str, found: str, remedy: str = "") -> HaltereError:
    return HaltereError(expected, found, f"fault {fault.word}", remedy)


def _columns(fault: Fault, stream: Stream) -> list[str]:
    """Columns of a stream that a fault touches."""
    axes = [fault.axis] if fault.axis is not None else None
    if fault.sensor in ("gyro", "accel"):
        wanted = [f"{fault.sensor}_{a}" for a in axes or "xyz"]
    elif fault.sensor == "imu":
        wanted = [f"{s}_{a}" for s in ("gyro", "accel") for a in axes or "xyz"]
    elif fault.sensor == "magnetometer":
        wanted = [f"mag_{a}" for a in axes or "xyz"]
    elif fault.sensor == "gnss":
        places = {"n": "lat", "e": "lon", "d": "alt"}
        wanted = [] if fault.quantity == "position" else [f"vel_{a}" for a in axes or "ned"]
        wanted += [] if fault.quantity == "velocity" else [places[str(a)] for a in axes or "ned"]
    elif fault.sensor == "rotors":
        wanted = [f"speed_{fault.axis}"] if fault.axis is not None else [c for c in stream.names if c.startswith("speed_")]
    elif fault.sensor == "barometer":
        wanted = [c for c in ("pressure", "altitude") if c in stream]
    else:
        wanted = ["airspeed"]
    missing = [c for c in wanted if c not in stream]
    if missing or not wanted:
        raise _refused(fault, f"columns {', '.join(wanted) or 'to change'}", f"only {', '.join(stream.names)}")
    return wanted


def _apply(fault: Fault, name: str, stream: Stream, flight: FlightLog) -> Stream:
    on = (stream.t >= fault.start) & (stream.t < fault.end)
    if not on.any():
        first, last = (float(stream.t.min()), float(stream.t.max())) if len(stream) else (math.nan, math.nan)
        raise _refused(fault, f"samples of {name} in its time", f"samples from {first:.2f} to {last:.2f} s")
    columns = _columns(fault, stream)
    if fault.kind == "dropout":
        if fault.axis is not None:
            return _changed(fault, stream, {c: np.where(on, np.nan, stream[c]) for c in columns})
        return stream.where(~on)
    if fault.kind == "delay":
        late = stream.t + np.where(on, fault.size, 0.0)
        order = np.argsort(late, kind="stable")
        return Stream({**{c: v[order] for c, v in stream.columns.items()}, "t": late[order]})
    if fault.kind in ("misalign", "disturb"):
        vector = _turned if fault.kind == "misalign" else _disturbed
        return _changed(fault, stream, vector(fault, stream, on, flight))
    if fault.sensor == "gnss" and fault.quantity == "position":
        return _changed(fault, stream, _moved(fault, stream, on, columns))
    if fault.sensor == "barometer" and fault.quantity == "altitude":
        return _changed(fault, stream, _lifted(fault, stream, on))
    if fault.sensor == "barometer" and fault.quantity == "pressure":
        if "pressure" not in columns:
            raise _refused(fault, "a column pressure", f"only {', '.join(stream.names)}", "give the size in metres")
        columns = ["pressure"]
    new = {c: _value(fault, stream.t, stream[c], on, k) for k, c in enumerate(columns)}
    if fault.kind == "scale" and fault.sensor == "gnss":
        raise _refused(fault, "a size that positions and velocities have", "a factor", "use bias or noise")
    return _changed(fault, stream, new)


def _changed(fault: Fault, stream: Stream, new: dict[str, FloatArray]) -> Stream:
    """The stream with new columns, if any value is another one."""
    same = all(np.array_equal(stream[c], v, equal_nan=True) for c, v in new.items())
    if same:
        raise _refused(fault, "a value that it changes", "none: every sample stays as it was", "look at its size and time")
    for name, values in list(new.items()):  # the field before the autopilot's correction changes with it
        raw = name.replace("mag_", "raw_")
        if name.startswith("mag_") and raw in stream:
            new[raw] = stream[raw] + (values - stream[name])
    return Stream({**stream.columns, **new})


def _spikes(fault: Fault, t: FloatArray, on: Mask) -> Mask:
    """The first sample, or with an end the first of each second."""
    rows = np.flatnonzero(on)
    if math.isinf(fault.end):
        rows = rows[:1]
    else:
        rows = rows[np.unique(np.floor(t[rows] - fault.start), return_index=True)[1]]
    out = np.zeros(len(t), bool)
    out[rows] = True
    return out


def _noise(fault: Fault, k: int, n: int) -> FloatArray:
    """Numbers of a fault: the same for the same word, whatever else is done to the flight."""
    return np.random.default_rng([zlib.crc32(fault.word.encode()), k]).standard_normal(n)


def _added(fault: Fault, t: FloatArray, on: Mask, k: int) -> FloatArray | None:
    """What a fault adds to each sample, in its own unit; None for a fault that does something else."""
    if fault.kind in ("bias", "step"):
        return np.where(on, fault.size, 0.0)
    if fault.kind == "ramp":
        return np.where(on, fault.size * (t - fault.start), 0.0)
    if fault.kind == "noise":
        return np.where(on, fault.size * _noise(fault, k, len(t)), 0.0)
    if fault.kind == "spike":
        return np.where(_spikes(fault, t, on), fault.size, 0.0)
    return None


def _value(fault: Fault, t: FloatArray, x: FloatArray, on: Mask, k: int) -> FloatArray:
    added = _added(fault, t, on, k)
    if added is not None:
        return np.where(on, x + added, x)
    if fault.kind == "scale":
        return np.where(on, fault.size * x, x)
    if fault.kind == "stuck":
        before = np.flatnonzero(~on & (t < fault.start) & np.isfinite(x))
        held = x[before[-1]] if len(before) else x[np.flatnonzero(on)[0]]
        return np.where(on, held, x)
    if fault.kind == "saturate":
        return np.where(on, np.clip(x, -fault.size, fault.size), x)
    return np.where(on, np.nan, x)  # nan


def _moved(fault: Fault, stream: Stream, on: Mask, columns: list[str]) -> dict[str, FloatArray]:
    """GNSS position shifted by metres; north and east along the ellipsoid, down lowers the altitude."""
    from pymap3d.rcurve import meridian, transverse

    out: dict[str, FloatArray] = {}
    for k, column in enumerate(columns):
        x = stream[column]
        added = _added(fault, stream.t, on, k)
        if added is None:
            raise _refused(fault, "bias, ramp, noise or spike for a position", fault.kind)
        if column == "alt":
            out[column] = np.where(on, x - added, x)
            continue
        lat = float(np.nanmedian(stream["lat"]))
        alt = float(np.nanmedian(stream["alt"])) if "alt" in stream else 0.0
        radius = float(meridian(lat)) + alt if column == "lat" else (float(transverse(lat)) + alt) * math.cos(math.radians(lat))
        out[column] = np.where(on, x + np.degrees(added / radius), x)
    return out


def _lifted(fault: Fault, stream: Stream, on: Mask) -> dict[str, FloatArray]:
    """Barometer shifted by metres of height: its altitude, and its pressure by the standard atmosphere."""
    added = _added(fault, stream.t, on, 0)
    if added is None:
        raise _refused(fault, "bias, ramp, noise or spike in metres", fault.kind)
    out = {}
    if "altitude" in stream:
        out["altitude"] = np.where(on, stream["altitude"] + added, stream["altitude"])
    if "pressure" in stream:
        p = stream["pressure"]
        height = _SCALE * (1.0 - (p / 101325.0) ** _EXPONENT) + added
        out["pressure"] = np.where(on, 101325.0 * (1.0 - height / _SCALE) ** (1.0 / _EXPONENT), p)
    return out


def _turned(fault: Fault, stream: Stream, on: Mask, flight: FlightLog) -> dict[str, FloatArray]:
    """Vectors of a sensor that sits turned by the size about an axis."""
    k = "xyz".index(fault.axis or "z")
    c, s = math.cos(fault.size), math.sin(fault.size)
    i, j = (k + 1) % 3, (k + 2) % 3
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, s, -s, c  # what a sensor turned by +size sees
    out: dict[str, FloatArray] = {}
    for stem in {"imu": ("gyro", "accel"), "magnetometer": ("mag",)}.get(fault.sensor, (fault.sensor,)):
        turned = stream.vector(stem) @ R.T
        out |= {f"{stem}_{a}": np.where(on, turned[:, n], stream[f"{stem}_{a}"]) for n, a in enumerate("xyz")}
    return out


def _disturbed(fault: Fault, stream: Stream, on: Mask, flight: FlightLog) -> dict[str, FloatArray]:
    """A field added to the magnetometer: fixed in the body along an axis, else towards east by the flight's truth or onboard attitude."""
    strength = float(flight.meta.field.get("strength", math.nan))
    if not math.isfinite(strength):
        before = stream.vector("mag")[stream.t < fault.start] if (stream.t < fault.start).any() else stream.vector("mag")
        strength = float(np.nanmedian(np.linalg.norm(before, axis=1)))
    size = fault.size * strength
    if fault.axis is not None:
        name = f"mag_{fault.axis}"
        return {name: np.where(on, stream[name] + size, stream[name])}
    for reference in ("truth", "onboard"):
        source = flight.get(reference)
        if source is not None and "q_w" in source and np.isfinite(source["q_w"]).sum() > 1:
            good = np.isfinite(source["q_w"])
            t, q = source.t[good], source.vector("q", "wxyz")[good]
            i = np.clip(np.searchsorted(t, stream.t), 1, len(t) - 1)
            nearest = np.where(stream.t - t[i - 1] < t[i] - stream.t, i - 1, i)
            east = size * rotate_to_body(q[nearest], np.array([0.0, 1.0, 0.0]))
            return {f"mag_{a}": np.where(on, stream[f"mag_{a}"] + east[:, k], stream[f"mag_{a}"]) for k, a in enumerate("xyz")}
    raise _refused(fault, "an attitude, truth or onboard, that tells where east is", "none", "give an axis: magnetometer.x:disturb=...")


def disturbances(faults: Sequence[Fault], rotors: int) -> NDArray[np.void]:
    """Records of the faults that only a simulation can have, for the flight of a vehicle with so many rotors."""
    mine = [f for f in faults if f.simulated_only]
    D = as_records(np.zeros(len(mine), DISTURBANCE))
    for k, fault in enumerate(mine):
        row: dict[str, Any] = {"start": fault.start, "end": fault.end, "rotor": -1, "factor": 1.0}
        size = fault.size
        if fault.kind == "ramp":
            # the record grows in proportion to the whole, reached at the end; an open end is as good as an hour
            length = min(fault.end, fault.start + 3600.0) - fault.start
            row["rate"], size = 1.0 / length, size * length
        vector = np.zeros(3)
        if fault.sensor == "rotor":
            row["rotor"], row["factor"] = int(fault.axis or 0), fault.size
            if row["rotor"] >= rotors:
                raise _refused(fault, f"a rotor from 0 to {rotors - 1}", str(fault.axis))
        elif fault.sensor == "wind":
            vector["ned".index(str(fault.axis))] = size
            row["wind"] = vector
        elif fault.axis in ("hx", "hy", "t"):
            vector[("hx", "hy", "t").index(fault.axis)] = size
            row["push"] = vector
        else:
            vector["rpq".index(str(fault.axis))] = size
            row["twist"] = vector
        for name, value in row.items():
            D[name][k] = value
    return D
