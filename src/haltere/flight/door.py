"""The door: every stream is checked once, here, and what cannot be used is masked, counted and told. It converts nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.flight.log import FlightLog, Stream
from haltere.flight.schema import column as schema_column

__all__ = ["Checked", "check", "first_fix"]

#: IMU rates [Hz] below which a strapdown filter is worth nothing, and below which it is worth little.
RATE_MIN, RATE_POOR = 10.0, 50.0
#: No small gyro or accelerometer measures more [rad/s, m/s^2].
RATE_MAX, FORCE_MAX = 100.0, 500.0
Mask = NDArray[np.bool_]


@dataclass
class Checked:
    """Streams that passed, with what was left out of each and what should be said."""

    streams: dict[str, Stream]
    discarded: dict[str, dict[str, int]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def drop(self, name: str, stream: Stream, keep: Mask, reason: str) -> Stream:
        """Leave out the rows that are not kept, and count them."""
        n = int(len(keep) - np.count_nonzero(keep))
        if n == 0:
            return stream
        reasons = self.discarded.setdefault(name, {})
        reasons[reason] = reasons.get(reason, 0) + n
        return stream.where(keep)


def check(flight: FlightLog, *, upright: bool = True) -> Checked:
    """Check the streams that estimators read.

    Parameters
    ----------
    flight
        The log as read. It is not changed.
    upright
        The vehicle spends most of its time the right way up, so that the sign of gravity can be checked.

    Returns
    -------
    Checked
        Streams imu, magnetometer, gnss, barometer with strictly increasing finite times; missing values inside a row stay NaN.

    Raises
    ------
    HaltereError
        No IMU that could be navigated with: absent, columns missing, too few samples, too slow, or in the wrong unit or sign.
    """
    out = Checked({}, {k: dict(v) for k, v in flight.discarded.items()}, list(flight.notes))
    _check_types(flight)
    _check_imu(flight, out, upright)
    for name, rule in (("magnetometer", _check_magnetometer), ("gnss", _check_gnss), ("barometer", _check_barometer)):
        stream = flight.get(name)
        if stream is not None and len(stream):
            stream = rule(out, _clean_time(out, name, stream))
            if len(stream):
                out.streams[name] = stream
    return out


def _check_types(flight: FlightLog) -> None:
    """Refuse text where the schema has numbers."""
    for name in ("imu", "magnetometer", "gnss", "barometer"):
        stream = flight.get(name)
        for column in stream.names if stream is not None and len(stream) else ():
            values = stream[column] if stream is not None else None
            if values is not None and values.dtype.kind != "f" and schema_column(name, column) is not None:
                raise HaltereError("numbers", f"text such as {str(values[0])!r}", f"stream {name}, column {column}", "check the column map")


def _clean_time(out: Checked, name: str, stream: Stream) -> Stream:
    """Rows with finite, strictly increasing times; a stream that is only out of order is sorted."""
    stream = out.drop(name, stream, np.isfinite(stream.t), "time not finite")
    if len(stream) == 0:
        return stream
    backwards = int(np.count_nonzero(np.diff(stream.t) < 0.0))
    if backwards:
        out.discarded.setdefault(name, {})["out of order, sorted"] = backwards
        stream = stream.where(np.argsort(stream.t, kind="stable"))
    return out.drop(name, stream, np.r_[True, np.diff(stream.t) > 0.0], "repeated time")


def _check_imu(flight: FlightLog, out: Checked, upright: bool) -> None:
    imu = flight.get("imu")
    where = f"{flight.meta.name or 'flight'}: stream imu"
    if imu is None or len(imu) == 0:
        raise HaltereError("an imu stream with gyro and accel columns", f"streams {', '.join(flight) or 'none'}", where, "see haltere info")
    missing = [c for c in ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z") if c not in imu]
    if missing:
        raise HaltereError("columns gyro_x..z and accel_x..z", f"no {', '.join(missing)}", where)
    imu = _clean_time(out, "imu", imu)
    values = np.column_stack([imu.vector("gyro"), imu.vector("accel")]) if len(imu) else np.empty((0, 6))
    imu = out.drop("imu", imu, np.asarray(np.isfinite(values).all(axis=1)), "not finite")
    if len(imu) < 20:
        raise HaltereError("at least 20 usable samples", f"{len(imu)}", where, "see haltere info for what was left out")
    rate = imu.rate
    if rate < RATE_MIN:
        raise HaltereError(
            f"an IMU of at least {RATE_MIN:.0f} Hz to navigate on", f"{rate:.2g} Hz (median interval {1e3 / rate:.0f} ms)", where,
            "log the IMU faster: ArduPilot LOG_BITMASK with IMU (fast attitude), PX4 SDLOG_PROFILE high rate",
        )  # fmt: skip
    if rate < RATE_POOR:
        out.warnings.append(f"imu: {rate:.0f} Hz is slow for a strapdown filter; turns and vibration between samples are lost")
    gaps = np.diff(imu.t)
    if gaps.max() > 2.0:
        n_long, longest = int(np.count_nonzero(gaps > 2.0)), float(gaps.max())
        out.warnings.append(f"imu: {n_long} gap{'s' * (n_long > 1)} longer than 2 s, the longest {longest:.0f} s; nothing is known of them")
    f = np.linalg.norm(imu.vector("accel"), axis=1)
    w = np.linalg.norm(imu.vector("gyro"), axis=1)
    f_mid, w_mid = float(np.median(f)), float(np.median(w))
    if 0.7 < f_mid < 1.4:
        raise HaltereError(
            "specific force near 9.81 m/s^2", f"median {f_mid:.2f}", where, "it looks like g: give the unit in the column map"
        )
    if not 3.0 < f_mid < 40.0:
        raise HaltereError("specific force near 9.81 m/s^2", f"median {f_mid:.3g}", where, "check unit and columns of the accelerometer")
    # half of a flight tumbling at most of a turn a second is no flight; a fast turn about z is (a vehicle that lost a rotor spins)
    tumble = float(np.median(np.hypot(imu["gyro_x"], imu["gyro_y"])))
    if tumble > 5.0 or w_mid > RATE_MAX:
        found = f"a median of {tumble:.1f} about the horizontal axes"
        raise HaltereError("angular rates in rad/s", found, where, "it looks like deg/s: give the unit in the column map")
    up = float(np.mean(imu["accel_z"] > 0.5 * f_mid))
    if upright and up > 0.9:
        raise HaltereError(
            "specific force with z near -9.81 m/s^2 when level (FRD)", f"positive z in {100 * up:.0f} % of the samples", where,
            "the axes look FLU, or gravity is given instead of specific force: set frame or mounting",
        )  # fmt: skip
    impossible = (np.abs(imu.vector("gyro")).max(axis=1) > RATE_MAX) | (np.abs(imu.vector("accel")).max(axis=1) > FORCE_MAX)
    out.streams["imu"] = out.drop("imu", imu, ~impossible, "impossible value")


def _check_magnetometer(out: Checked, stream: Stream) -> Stream:
    m = stream.vector("mag")
    stream = out.drop("magnetometer", stream, np.asarray(np.isfinite(m).all(axis=1)), "not finite")
    strength = np.linalg.norm(stream.vector("mag"), axis=1)
    stream = out.drop("magnetometer", stream, strength > 0.0, "zero")
    if len(stream) == 0:
        return stream
    middle = float(np.median(np.linalg.norm(stream.vector("mag"), axis=1)))
    if not 5.0 < middle < 200.0:
        looks = "calibrate it"
        for unit, low, high in (("gauss", 0.1, 1.5), ("milligauss", 200.0, 1500.0), ("tesla", 1e-5, 1.5e-4)):
            if low < middle < high:
                looks = f"it looks like {unit}"
        out.warnings.append(f"magnetometer: expected a field of 20 to 70 uT, found a median of {middle:.3g}; not used; {looks}")
        return out.drop("magnetometer", stream, np.zeros(len(stream), bool), "strength impossible in uT")
    return stream


def _check_gnss(out: Checked, stream: Stream) -> Stream:
    stream = out.drop("gnss", stream, ~(stream.get("fix_type") < 3.0), "no 3-D fix")
    lat, lon = stream.get("lat"), stream.get("lon")
    stream = out.drop("gnss", stream, ~((lat == 0.0) & (lon == 0.0)), "latitude and longitude zero")
    lat, lon = stream.get("lat"), stream.get("lon")
    stream = out.drop("gnss", stream, ~((np.abs(lat) > 90.0) | (np.abs(lon) > 360.0)), "latitude or longitude impossible")
    known = np.isfinite(stream.get("lat")) | np.isfinite(stream.get("vel_n"))
    stream = out.drop("gnss", stream, known, "not finite")
    return out.drop("gnss", stream, ~(stream.get("h_acc") > 50.0), "accuracy worse than 50 m")


def _check_barometer(out: Checked, stream: Stream) -> Stream:
    pressure, altitude = stream.get("pressure"), stream.get("altitude")
    stream = out.drop("barometer", stream, np.isfinite(pressure) | np.isfinite(altitude), "not finite")
    pressure = stream.get("pressure")
    stream = out.drop("barometer", stream, ~((pressure < 1e4) | (pressure > 1.2e5)), "pressure impossible in Pa")
    return stream


def first_fix(gnss: Stream | None) -> tuple[float, float, float] | None:
    """Latitude, longitude [deg] and altitude [m] of the first three-dimensional fix of a checked stream, or None."""
    if gnss is None:
        return None
    good = np.isfinite(gnss.get("lat")) & np.isfinite(gnss.get("lon")) & np.isfinite(gnss.get("alt"))
    if not good.any():
        return None
    i = int(np.argmax(good))
    fix = (float(gnss["lat"][i]), float(gnss["lon"][i]), float(gnss["alt"][i]))
    return fix if all(math.isfinite(x) for x in fix) else None
