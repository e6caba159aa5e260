"""The door: every stream is checked once, here, and what cannot be used is masked, counted and told. It converts nothing.

Units and axes are only named here, with the configuration key that puts them right; `haltere.flight.corrections` does it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.flight import moving
from haltere.flight.agreement import judge, option
from haltere.flight.corrections import mounted
from haltere.flight.door_air import RULES
from haltere.flight.field import decimal_year, earth_field
from haltere.flight.log import FlightLog, Stream
from haltere.flight.names import nearest_column, nearest_stream
from haltere.flight.schema import STREAMS, schema_of
from haltere.flight.schema import column as schema_column

__all__ = ["Checked", "check", "first_fix", "fit", "impossible_place", "impossible_pressure"]

#: IMU rates [Hz] below which a strapdown filter is worth nothing, below which it is worth little, and which no IMU has.
RATE_MIN, RATE_POOR, RATE_HIGH = 10.0, 50.0, 40000.0
#: No flight has a hole of this many seconds.
DAY = 86400.0
#: What estimators read.
READ = ("imu", "magnetometer", "gnss", "barometer", "power", "rotors", "airdata", "wind", "attitude")
IMU = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
#: No small gyro or accelerometer measures more [rad/s, m/s^2].
RATE_MAX, FORCE_MAX = 100.0, 500.0
#: No small vehicle draws more [A].
CURRENT_MAX = 2000.0
Mask = NDArray[np.bool_]
FloatArray = NDArray[np.float64]


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


@np.errstate(all="ignore")  # numbers near the end of the range are samples like others: they are masked below
def check(flight: FlightLog, *, upright: bool = True, given: Mapping[str, Any] | None = None) -> Checked:
    """Check the streams that estimators read.

    Parameters
    ----------
    flight
        The log as read. It is not changed.
    upright
        The vehicle spends most of its time the right way up, so that the sign of gravity can be checked.
    given
        Configuration as given: axes and units that were put right already, the place and the field.

    Returns
    -------
    Checked
        Streams imu, magnetometer, gnss, barometer, power with strictly increasing finite times; missing values inside a row stay NaN.

    Raises
    ------
    HaltereError
        No IMU that could be navigated with: absent, columns missing, too few samples, too slow, or in other units or axes.
    """
    out = Checked({}, {k: dict(v) for k, v in flight.discarded.items()}, list(flight.notes))
    _check_names(flight, out)
    _check_types(flight)
    _check_imu(flight, out, upright, given or {})
    rules = (("magnetometer", _check_magnetometer), ("gnss", _check_gnss), ("barometer", _check_barometer), *RULES)
    for name, rule in rules:
        stream = flight.get(name)
        if stream is None:
            continue
        n = len(stream)
        if n == 0:
            out.warnings.append(f"{name}: the log has the stream, but not one sample in it")
            continue
        cleaned = rule(out, _clean_time(out, name, stream))
        cleaned = cleaned if name in ("wind", "rotors") else _check_held(out, name, cleaned)
        if len(cleaned):
            out.streams[name] = cleaned
            _check_clock(out, name, cleaned)
        else:
            why = ", ".join(f"{reason} {k}" for reason, k in out.discarded.get(name, {}).items())
            out.warnings.append(f"{name}: none of its {n} samples can be used ({why})")
    _check_power(flight, out)
    _check_agreement(flight, out, given or {})
    return out


def _check_agreement(flight: FlightLog, out: Checked, given: Mapping[str, Any]) -> None:
    """Refuse an IMU, or leave out a magnetometer, with axes or units that the other sensors contradict."""
    imu, mag = out.streams["imu"], out.streams.get("magnetometer")
    where = f"{flight.meta.name or 'flight'}: stream imu"
    t_mag, field = (mag.t, mounted(flight, "magnetometer", mag.vector("mag"))) if mag is not None else (np.empty(0), np.empty((0, 3)))
    accused = judge(
        imu.t, mounted(flight, "imu", imu.vector("gyro")), mounted(flight, "imu", imu.vector("accel")), t_mag, field,
        dip=_dip(flight, out, given) if mag is not None else math.nan, where=where, given=given, mounting=flight.meta.mounting,
    )  # fmt: skip
    if accused is not None and mag is not None:
        out.warnings.append(
            f"magnetometer: expected a field that turns as gyro and dip say, found {accused.found}; not used; {accused.remedy}"
        )
        del out.streams["magnetometer"]
        out.drop("magnetometer", mag, np.zeros(len(mag), bool), "axes unlike the gyro's or the field's")


def _dip(flight: FlightLog, out: Checked, given: Mapping[str, Any]) -> float:
    """Dip of the field [rad] as given, or of the World Magnetic Model at home or the first fix, or NaN."""
    dip = float(given.get("field.dip", flight.meta.field.get("dip", math.nan)))
    if math.isfinite(dip):
        return dip
    home = flight.meta.home
    place = (home.lat, home.lon, home.alt) if home is not None else first_fix(out.streams.get("gnss"))
    named = tuple(float(given.get(f"home.{k}", math.nan)) for k in ("lat", "lon", "alt"))
    if all(math.isfinite(x) for x in named):
        place = (named[0], named[1], named[2])
    if place is None or not all(math.isfinite(x) for x in place) or impossible_place(place[0], place[1]):
        return math.nan
    return earth_field(*place, decimal_year(flight.meta.start_utc)).dip


def _check_names(flight: FlightLog, out: Checked) -> None:
    """Say which streams and columns are not read, where the name is nearly one that would be."""
    for name in flight:
        schema = schema_of(name)
        if schema is None:
            near = nearest_stream(name, STREAMS)
            if near is not None and near not in flight:
                out.warnings.append(f"stream {name!r} is not known and not read; did you mean {near!r}?")
            continue
        if name not in READ:
            continue
        missing = [c for c in schema.names if c not in flight[name]]
        for c in flight[name].names:
            near = nearest_column(c, missing) if schema_column(name, c) is None else None
            if near is not None and name != "imu":  # of the imu all columns must be there: that error names them
                out.warnings.append(f"{name}: column {c!r} is not known and not read; did you mean {near!r}?")


def _check_types(flight: FlightLog) -> None:
    """Refuse text where the schema has numbers."""
    for name in READ:
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
    if backwards and _overlaps(stream.t):
        stream = _one_recording(out, name, stream)
        backwards = int(np.count_nonzero(np.diff(stream.t) < 0.0))
    if backwards:
        reasons = out.discarded.setdefault(name, {})
        reasons["out of order, sorted"] = reasons.get("out of order, sorted", 0) + backwards
        stream = stream.where(np.argsort(stream.t, kind="stable"))
    stream = out.drop(name, stream, np.r_[True, np.diff(stream.t) > 0.0], "repeated time")
    return _drop_far(out, name, stream)


def _drop_far(out: Checked, name: str, stream: Stream) -> Stream:
    """Leave out single times more than a day from all others, such as a flipped bit makes them; refuse a clock that was set on by days."""
    t = stream.t
    dt = np.diff(t)
    steps = np.flatnonzero(dt > max(DAY, 1e3 * float(np.median(dt)))) if len(dt) else dt
    if len(steps) == 0:
        return stream
    edges = np.r_[0, steps + 1, len(t)]
    sizes = np.diff(edges)
    whole = sizes >= max(20, len(t) // 100)
    if name == "imu" and np.count_nonzero(whole) > 1:
        i = int(steps[0])
        raise HaltereError(
            "one clock", f"a step of {t[i + 1] - t[i]:.4g} s after t = {t[i]:.3f} s", "stream imu",
            "the clock was set while logging, or the log holds several recordings: cut it there and run each",
        )  # fmt: skip
    keep = np.zeros(len(t), dtype=bool)
    longest = int(np.argmax(sizes))
    keep[edges[longest] : edges[longest + 1]] = True
    return out.drop(name, stream, keep, "more than a day from the others")


def _overlaps(t: FloatArray) -> bool:
    """Whether rising stretches of a stream lie over one another in time: then it is not disorder but a clock that was set back.

    In order of time, rows that arrived late change between stretches about as often as there are stretches; two recordings that
    cover the same time change with nearly every row.
    """
    stretch = np.cumsum(np.r_[0, np.diff(t) < 0.0])
    changes = int(np.count_nonzero(np.diff(stretch[np.argsort(t, kind="stable")])))
    return changes > 4 * int(stretch[-1] + 1) + 20


def _one_recording(out: Checked, name: str, stream: Stream) -> Stream:
    """The longest stretch of a stream whose clock was set back; an IMU is refused, since all other streams hang on its clock."""
    dt = np.diff(stream.t)
    steps = np.flatnonzero(dt < -max(1.0, 20.0 * float(np.median(np.abs(dt)))))
    if len(steps) == 0:
        return stream
    if name == "imu":
        i = int(steps[np.argmin(dt[steps])])
        raise HaltereError(
            "times that rise", f"a clock set back by {-dt[i]:.4g} s after sample {i + 1} of {len(stream)} (t = {stream.t[i]:.3f} s), over "
            "times that were there before", "stream imu", "the log holds several recordings: cut it there and run each",
        )  # fmt: skip
    edges = np.r_[0, steps + 1, len(stream)]
    longest = int(np.argmax(np.diff(edges)))
    keep = np.zeros(len(stream), dtype=bool)
    keep[edges[longest] : edges[longest + 1]] = True
    out.warnings.append(f"{name}: its clock is set back {len(steps)} time{'s' * (len(steps) > 1)}; only the longest stretch is used")
    return out.drop(name, stream, keep, "clock set back")


def _check_held(out: Checked, name: str, stream: Stream) -> Stream:
    """Find rows that only repeat the row before, where a slower sensor was written at a faster rate.

    A held fix or height is an old one, and is left out. A held field is only told: it is younger than the vehicle turns.
    """
    if len(stream) < 20:
        return stream
    columns = [c for c in stream.names if c not in ("t", "temperature") and schema_column(name, c) is not None]
    values = np.column_stack([stream[c] for c in columns]) if columns else np.empty((len(stream), 0))
    new = np.r_[True, ~((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))).all(axis=1)]
    runs = np.diff(np.r_[np.flatnonzero(new), len(new)])
    # many short runs of like length; a value that is held long, or never changes, is another thing: at rest, or stuck
    if len(runs) < 10 or np.median(runs) < 2.0 or runs.max() > 20.0 * np.median(runs):
        return stream
    drops = name != "magnetometer"
    what = "are not used" if drops else "count as samples"
    out.warnings.append(f"{name}: {len(new) - len(runs)} of {len(new)} rows only hold the row before; they {what}")
    return out.drop(name, stream, new, "repeats the row before") if drops else stream


def _check_clock(out: Checked, name: str, stream: Stream) -> None:
    """Say when a stream's times are not those of the IMU."""
    imu = out.streams["imu"].t
    inside = (stream.t >= imu[0]) & (stream.t <= imu[-1])
    if inside.mean() < 0.5 and min(stream.t[-1] - stream.t[0], imu[-1] - imu[0]) > 0.0:
        span = f"t = {stream.t[0]:.6g} to {stream.t[-1]:.6g} s, the imu's are {imu[0]:.6g} to {imu[-1]:.6g} s"
        out.warnings.append(f"{name}: only {100 * inside.mean():.0f} % of its times are within the imu's: {span}; is it on another clock?")


def _check_imu(flight: FlightLog, out: Checked, upright: bool, given: Mapping[str, Any]) -> None:
    imu = flight.get("imu")
    where = f"{flight.meta.name or 'flight'}: stream imu"
    if imu is None or len(imu) == 0:
        near = next((s for s in flight if schema_of(s) is None and nearest_stream(s, STREAMS) == "imu"), None)
        hint = f"rename {near!r} to 'imu'" if near else "see haltere info"
        raise HaltereError("an imu stream with gyro and accel columns", f"streams {', '.join(flight) or 'none'}", where, hint)
    missing = [c for c in IMU if c not in imu]
    if missing:
        meant = {m: c for c in imu.names if schema_column("imu", c) is None and (m := nearest_column(c, missing))}
        hint = f"is {', '.join(f'{c!r} meant to be {m!r}' for m, c in meant.items())}?" if meant else "check the column map"
        raise HaltereError("columns gyro_x..z and accel_x..z", f"no {', '.join(missing)}", where, hint)
    n = len(imu)
    imu = _clean_time(out, "imu", imu)
    values = np.column_stack([imu.vector("gyro"), imu.vector("accel")]) if len(imu) else np.empty((0, 6))
    imu = out.drop("imu", imu, np.asarray(np.isfinite(values).all(axis=1)), "not finite")
    if len(imu):  # not even free fall is exactly zero on all axes of a sensor that is there
        imu = out.drop("imu", imu, np.asarray(imu.vector("accel").any(axis=1)), "zero accelerometer")
    if len(imu) < 20:
        why = ", ".join(f"{reason} {k}" for reason, k in out.discarded.get("imu", {}).items())
        raise HaltereError(
            "at least 20 usable samples", f"{len(imu)} of {n}{f' ({why})' if why else ''}", where, "see haltere info for what was left out"
        )
    _check_rate(flight, out, imu, where)
    _check_imu_units(imu, where)
    impossible = (np.abs(imu.vector("gyro")).max(axis=1) > RATE_MAX) | (np.abs(imu.vector("accel")).max(axis=1) > FORCE_MAX)
    imu = out.drop("imu", imu, ~impossible, "impossible value")
    if upright:
        _check_up(flight, out, imu, where, given)
    _check_stuck(out, "imu", imu, IMU[:3])
    _check_stuck(out, "imu", imu, IMU[3:])
    out.streams["imu"] = imu


def _check_rate(flight: FlightLog, out: Checked, imu: Stream, where: str) -> None:
    """Refuse times too slow or too fast to be seconds of an IMU, and say what they look like."""
    rate, span = imu.rate, float(imu.t[-1] - imu.t[0])
    interval = f"median interval {1e3 / rate:.4g} ms"
    if rate > RATE_HIGH:
        found = f"{rate:.3g} Hz ({len(imu)} samples in {span:.3g} s)"
        raise HaltereError(f"at most {RATE_HIGH:.0f} IMU samples a second", found, where, "check unit.time and the column map of t")
    if rate < RATE_MIN * (1.0 - 1e-6):  # stamps are rounded
        known = flight.meta.source.startswith(("PX4", "ArduPilot"))  # whose clocks are known
        looks = next(
            ((unit, word) for unit, word, k in (("us", "microseconds", 1e6), ("ms", "milliseconds", 1e3), ("ns", "nanoseconds", 1e9))
             if RATE_POOR <= rate * k <= RATE_HIGH and span / k > 2.0 and not known),
            None,
        )  # fmt: skip
        remedy = "log the IMU faster: ArduPilot LOG_BITMASK with IMU (fast attitude), PX4 SDLOG_PROFILE high rate"
        if looks is not None:
            remedy = f"the stamps look like {looks[1]}: --set unit.time={looks[0]}; if they are seconds, log the IMU faster"
        raise HaltereError(f"an IMU of at least {RATE_MIN:.0f} Hz to navigate on", f"{rate:.2g} Hz ({interval})", where, remedy)
    if rate < RATE_POOR:
        out.warnings.append(f"imu: {rate:.0f} Hz is slow for a strapdown filter; turns and vibration between samples are lost")
    gaps = np.diff(imu.t)
    if gaps.max() > 2.0:
        n_long, longest = int(np.count_nonzero(gaps > 2.0)), float(gaps.max())
        out.warnings.append(f"imu: {n_long} gap{'s' * (n_long > 1)} longer than 2 s, the longest {longest:.0f} s; nothing is known of them")


def _check_imu_units(imu: Stream, where: str) -> None:
    """Refuse what by its size alone is in another unit."""
    f_mid = float(np.median(np.linalg.norm(imu.vector("accel"), axis=1)))
    w_mid = float(np.median(np.linalg.norm(imu.vector("gyro"), axis=1)))
    if not 3.0 < f_mid < 40.0:
        looks = next((f"it looks like {u}: --set unit.accel={u}" for u, k in (("g", 1.0), ("mg", 1e3)) if 0.7 * k < f_mid < 1.4 * k), None)
        raise HaltereError(
            "specific force near 9.81 m/s^2",
            f"median {f_mid:.3g}",
            where,
            looks or "check unit.accel and the columns of the accelerometer",
        )
    # half of a flight tumbling at most of a turn a second is no flight; a fast turn about z is (a vehicle that lost a rotor spins)
    tumble = float(np.median(np.hypot(imu["gyro_x"], imu["gyro_y"])))
    if tumble > 5.0 or w_mid > RATE_MAX:
        found = f"a median of {tumble:.3g} about the horizontal axes"
        raise HaltereError("angular rates in rad/s", found, where, "it looks like deg/s: --set unit.gyro=deg/s")


def _check_up(flight: FlightLog, out: Checked, imu: Stream, where: str, given: Mapping[str, Any]) -> None:
    """Which way the specific force points most of the time: up, which is -z, unless the axes or the sign are others."""
    f = mounted(flight, "imu", imu.vector("accel"))
    share = np.column_stack([f, -f]) > 0.8 * np.linalg.norm(f, axis=1)[:, None]
    along = int(np.argmax(share.mean(axis=0)))
    percent = 100.0 * float(share[:, along].mean())
    if percent < 90.0 or along == 5:
        return
    axis = f"{'positive' if along < 3 else 'negative'} {'xyz'[along % 3]}"
    over, meta = np.diag([1.0, -1.0, -1.0]), flight.meta.mounting
    if along == 2:
        raise HaltereError(
            "specific force with z near -9.81 m/s^2 when level (FRD)", f"positive z in {percent:.0f} % of the samples", where,
            f"if y points left and z up (FLU): {option('gyro', over, given, meta).replace('gyro', 'imu')}, and axes.magnetometer where it "
            f"is the same; if gravity is given instead of specific force: {option('accel', -np.eye(3), given, meta)}",
        )  # fmt: skip
    out.warnings.append(
        f"imu: the specific force is along {axis} in {percent:.0f} % of the samples, where a level vehicle has it along negative z; "
        "if it does not fly on its side, its axes are others: give axes.imu, three letters for where x, y and z point"
    )


def _check_stuck(out: Checked, name: str, stream: Stream, columns: tuple[str, ...], least: float = 2.0) -> None:
    """Say where one axis holds its value while others of the same sensor change, or all of them do."""
    runs = {c: _longest_run(stream.t, stream[c]) for c in columns}
    held = {c: r for c, r in runs.items() if r[1] - r[0] >= 20 and stream.t[r[1]] - stream.t[r[0]] >= least}
    whole = [c for c, (i, j) in held.items() if j - i == len(stream) - 1]
    if len(whole) == len(columns):
        return  # nothing ever happened: a body at rest, coarsely measured
    if whole:
        out.warnings.append(f"{name}: {', '.join(whole)} never changes: is the axis there?")
        return
    for c, (i, j) in held.items():
        others = [o for o in columns if o != c]
        if any((stream[o][i : j + 1] != stream[o][i]).any() for o in others):
            out.warnings.append(
                f"{name}: {c} holds one value from t = {stream.t[i]:.2f} to {stream.t[j]:.2f} s while the other axes change"
            )
    if len(held) == len(columns):
        i, j = max(r[0] for r in held.values()), min(r[1] for r in held.values())
        if j - i >= 20 and stream.t[j] - stream.t[i] >= least:
            out.warnings.append(f"{name}: {', '.join(columns)} all hold one value from t = {stream.t[i]:.2f} to {stream.t[j]:.2f} s")


def _longest_run(t: FloatArray, v: FloatArray) -> tuple[int, int]:
    """First and last row of the longest time without a change."""
    edges = np.r_[0, np.flatnonzero(v[1:] != v[:-1]) + 1, len(v)]
    k = int(np.argmax(t[edges[1:] - 1] - t[edges[:-1]]))
    return int(edges[k]), int(edges[k + 1]) - 1


#: Median field strengths that tell a unit, in that unit; the Earth's field is 22 to 67 uT.
_FIELD_UNITS = (
    ("milligauss", "mG", 200.0, 1500.0), ("gauss", "G", 0.15, 0.9), ("nT", "nT", 15e3, 9e4), ("tesla", "T", 1e-5, 1.2e-4),
    ("mT", "mT", 0.01, 0.12),
)  # fmt: skip


def _check_magnetometer(out: Checked, stream: Stream) -> Stream:
    m = stream.vector("mag")
    stream = out.drop("magnetometer", stream, np.asarray(np.isfinite(m).all(axis=1)), "not finite")
    strength = np.linalg.norm(stream.vector("mag"), axis=1)
    stream = out.drop("magnetometer", stream, strength > 0.0, "zero")
    if len(stream) == 0:
        return stream
    middle = float(np.median(np.linalg.norm(stream.vector("mag"), axis=1)))
    if not 5.0 < middle < 200.0:
        looks = "it looks normalised to one: scale it to the field's strength" if 0.9 < middle < 1.5 else "calibrate it"
        for name, unit, low, high in _FIELD_UNITS:
            if low < middle < high:
                looks = f"it looks like {name}: --set unit.magnetometer={unit}"
        out.warnings.append(f"magnetometer: expected a field of 20 to 70 uT, found a median of {middle:.3g}; not used; {looks}")
        return out.drop("magnetometer", stream, np.zeros(len(stream), bool), "strength impossible in uT")
    _check_stuck(out, "magnetometer", stream, ("mag_x", "mag_y", "mag_z"))
    return stream


def impossible_place(lat: Any, lon: Any) -> Any:
    """Whether latitude and longitude [deg] are no place on Earth; numbers or arrays."""
    return (abs(lat) > 90.0) | (abs(lon) > 360.0)


def impossible_pressure(pressure: Any) -> Any:
    """Whether no aircraft of this kind meets a static pressure [Pa]; numbers or arrays."""
    return (pressure < 1e4) | (pressure > 1.2e5)


def _check_gnss(out: Checked, stream: Stream) -> Stream:
    stream = out.drop("gnss", stream, ~(stream.get("fix_type") < 3.0), "no 3-D fix")
    lat, lon = stream.get("lat"), stream.get("lon")
    stream = out.drop("gnss", stream, ~((lat == 0.0) & (lon == 0.0)), "latitude and longitude zero")
    lat, lon = stream.get("lat"), stream.get("lon")
    bad = impossible_place(lat, lon)
    if bad.mean() > 0.5 if len(stream) else False:
        middle = float(np.nanmedian(np.abs(lat)))
        looks = "it looks like 1e-7 deg: --set unit.gnss_position=1e-7deg" if 1e4 < middle <= 9.0e8 else "are lat and lon exchanged?"
        out.warnings.append(f"gnss: expected latitude and longitude in degrees, found a median latitude of {middle:.4g}; {looks}")
    stream = out.drop("gnss", stream, ~bad, "latitude or longitude impossible")
    known = np.isfinite(stream.get("lat")) | np.isfinite(stream.get("vel_n"))
    stream = out.drop("gnss", stream, known, "not finite")
    stream = out.drop("gnss", stream, ~(stream.get("h_acc") > 50.0), "accuracy worse than 50 m")
    for column in ("h_acc", "v_acc", "s_acc"):
        if n := int(np.count_nonzero(stream.get(column) <= 0.0)):
            out.warnings.append(f"gnss: {n} of {len(stream)} values of {column} are zero or negative; taken as configured (noise.gnss_*)")
    return _check_moving(out, _check_altitude(out, stream))


def _check_moving(out: Checked, stream: Stream) -> Stream:
    """Leave out fixes whose places and velocities are of two units, or have columns exchanged: which of them is right is not known."""
    found = moving.compare(stream)
    if found is not None and found.disagrees:
        key = {"rad": "unit.gnss_position"}.get(found.reading, "unit.gnss_velocity")
        exchanged = " and " in found.reading
        what = (
            f"with {found.reading} exchanged"
            if exchanged
            else f"with the {'place' if found.reading == 'rad' else 'velocity'} in {found.reading}"
        )
        remedy = "exchange the columns in the file or its column map" if exchanged else f"--set {key}={found.reading}"
        out.warnings.append(f"gnss: expected places that move as the velocities say, found that they do only {what}; not used; {remedy}")
        return out.drop("gnss", stream, np.zeros(len(stream), bool), "place and velocity disagree")
    if moving.descends(stream) < -0.7:
        n = int(np.count_nonzero(np.isfinite(stream.get("vel_d"))))
        out.warnings.append(
            "gnss: expected vel_d to be down, found it up, by the altitude; vel_d not used; turn its sign in the column map"
        )
        out.discarded.setdefault("gnss", {})["vel_d is up"] = n
        return Stream({**stream.columns, "vel_d": np.full(len(stream), np.nan)})
    return stream


def _check_altitude(out: Checked, stream: Stream) -> Stream:
    """Take no altitude from a receiver whose altitudes are in another unit."""
    alt = stream.get("alt")
    middle = float(np.median(alt[np.isfinite(alt)])) if np.isfinite(alt).any() else 0.0
    if abs(middle) < 2e4:
        return stream
    unit = "mm" if abs(middle) < 1e7 else ""
    remedy = f"it looks like {unit}: --set unit.gnss_altitude={unit}" if unit else "check unit.gnss_altitude"
    out.warnings.append(f"gnss: expected altitudes in m, found a median of {middle:.4g}; altitude not used; {remedy}")
    reasons = out.discarded.setdefault("gnss", {})
    reasons["altitude impossible in m"] = int(np.count_nonzero(np.isfinite(alt)))
    return Stream({**stream.columns, "alt": np.full(len(stream), np.nan)})


def _check_barometer(out: Checked, stream: Stream) -> Stream:
    pressure, altitude = stream.get("pressure"), stream.get("altitude")
    stream = out.drop("barometer", stream, np.isfinite(pressure) | np.isfinite(altitude), "not finite")
    pressure = stream.get("pressure")
    bad = impossible_pressure(pressure)
    if len(stream) and bad.mean() > 0.5:
        middle = float(np.median(pressure[bad]))
        looks = next((u for u, low, high in (("hPa", 300.0, 1200.0), ("kPa", 30.0, 120.0)) if low < middle < high), "")
        remedy = f"it looks like {looks}: --set unit.pressure={looks}" if looks else "check unit.pressure"
        out.warnings.append(f"barometer: expected a pressure of 30000 to 110000 Pa, found a median of {middle:.4g}; not used; {remedy}")
    return out.drop("barometer", stream, ~bad, "pressure impossible in Pa")


def _check_power(flight: FlightLog, out: Checked) -> None:
    """Battery current, where there is any: only the compass listens to it, so that a log without says nothing."""
    stream = flight.get("power")
    if stream is None or not len(stream):
        return
    stream = _clean_time(out, "power", stream)
    current = stream.get("current")
    if np.isfinite(current).any():
        out.streams["power"] = out.drop("power", stream, np.abs(current) < CURRENT_MAX, "current not finite or impossible in A")


def fit(flight: FlightLog, checked: Checked) -> FlightLog:
    """The flight as it can be shown and compared with: the IMU as checked, all other streams with finite, rising times and every value.

    What is left out of streams that no estimator reads is counted in ``checked.discarded``. Text where the schema has numbers is left
    away: a reference that cannot be compared with costs no run.
    """
    streams = {}
    for name, stream in flight.streams.items():
        if name == "imu" and name in checked.streams:
            streams[name] = checked.streams[name]
            continue
        text = [c for c in stream.names if stream[c].dtype.kind != "f" and (known := schema_column(name, c)) is not None and not known.text]
        if text and len(stream):
            reasons = checked.discarded.setdefault(name, {})
            reasons[f"text in {', '.join(text)}"] = len(stream)
        numbers = Stream({c: v for c, v in stream.columns.items() if c not in text})
        q = numbers.vector("q", "wxyz")
        if (zero := (q == 0.0).all(axis=1)).any():  # no attitude; the other columns may stand
            reasons = checked.discarded.setdefault(name, {})
            reasons["zero quaternion"] = int(np.count_nonzero(zero))
            numbers = Stream({**numbers.columns, **{f"q_{a}": np.where(zero, np.nan, q[:, k]) for k, a in enumerate("wxyz")}})
        streams[name] = _clean_time(Checked({}) if name in READ else checked, name, numbers)  # of those in READ it is counted already
    return FlightLog(streams, flight.meta, flight.notes, flight.discarded)


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
