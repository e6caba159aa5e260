"""Wind told by the user, a constant, a table or a station, as the stream ``wind`` of a flight. It judges no wind and estimates none."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError, UsageError, nearest
from haltere.flight.log import FlightLog, Stream
from haltere.flight.units import UNITS, unit_word

if TYPE_CHECKING:
    import polars as pl

__all__ = ["SD", "SHAPES", "given_wind", "parse_wind", "with_wind"]

FloatArray = NDArray[np.float64]
#: 1 sigma [m/s] of each component where none is given: what a station nearby says of the wind at a vehicle.
SD = 1.0
#: Seconds between rows of a constant; and over how many of them a gust is a peak of how many standard deviations.
INTERVAL, PEAK = 1.0, 3.0
#: Names of columns, by what they are, and the unit of each where no other is named in brackets.
COLUMNS: dict[str, tuple[tuple[str, ...], str]] = {
    "t": (("t",), "s"),
    "utc": (("utc", "time", "timestamp", "datetime", "date"), ""),
    "wind_n": (("wind_n", "north"), "m/s"),
    "wind_e": (("wind_e", "east"), "m/s"),
    "wind_d": (("wind_d", "down"), "m/s"),
    "speed": (("speed", "wind_speed", "windspeed"), "m/s"),
    "from": (("from", "direction", "wind_direction", "direction_from", "wind_from"), "deg"),
    "to": (("to", "direction_to", "wind_to"), "deg"),
    "gust": (("gust", "wind_gust", "gusts"), "m/s"),
    "sd": (("sd", "sigma"), "m/s"),
}
KNOWN = {name: what for what, (names, _) in COLUMNS.items() for name in names}
#: A wind above this [m/s] is a unit gone wrong.
STRONGEST = 100.0
SHAPES = '"N,E[,D]" in m/s as it blows to, "SPEED@FROM" such as 5@270 or 18km/h@270, or a table'
HEADS = "t or utc; wind_n, wind_e[, wind_d] or speed, direction; [gust, sd]"
CONSTANT = re.compile(r"\s*([-+]?[\d.]+(?:e[-+]?\d+)?)\s*([a-z/]*)\s*@\s*([-+]?[\d.]+)\s*(?:deg|°)?\s*", re.IGNORECASE)


def parse_wind(text: str) -> tuple[float, float, float] | None:
    """Wind north, east, down [m/s] of ``N,E[,D]`` or ``SPEED@FROM``; None of a text that is neither, and so the name of a table.

    Raises
    ------
    UsageError
        It is meant as one of the two, but has a wrong number or unit.
    """
    found = CONSTANT.fullmatch(text)
    if found is not None:
        speed = _number(found[1], text) * _factor(found[2] or "m/s", text)
        if speed < 0.0:
            raise UsageError("a speed that is not negative", found[1], f"wind {text!r}")
        angle = math.radians(_number(found[3], text))
        return _strong((-speed * math.cos(angle), -speed * math.sin(angle), 0.0), text)
    parts = text.split(",")
    if len(parts) not in (2, 3) or not all(re.fullmatch(r"\s*[-+]?[\d.]+(?:[eE][-+]?\d+)?\s*", p) for p in parts):
        if "@" in text and not Path(text).exists():
            raise UsageError("SPEED@FROM, such as 5@270", repr(text), "wind", f"give {SHAPES}")
        return None
    n, e, d = (_number(p, text) for p in (*parts, "0")[:3])
    return _strong((n, e, d), text)


def _number(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError("a number", repr(text), f"wind {where!r}", f"give {SHAPES}") from None


def _factor(unit: str, where: str) -> float:
    if unit_word(unit) not in UNITS["m/s"]:
        raise UsageError(f"a unit of speed ({', '.join(UNITS['m/s'])})", repr(unit), f"wind {where!r}")
    return UNITS["m/s"][unit_word(unit)][0]


def _strong(wind: tuple[float, float, float], where: str) -> tuple[float, float, float]:
    if not math.hypot(*wind) < STRONGEST:
        raise UsageError(f"a wind below {STRONGEST:g} m/s", f"{math.hypot(*wind):g} m/s", f"wind {where!r}", "is the unit m/s?")
    return wind


def with_wind(
    flight: FlightLog, wind: str | Path | Sequence[float] | Mapping[str, Any], *, sd: float | None = None
) -> FlightLog:  # fmt: skip
    """A flight with a wind told from outside, for estimators that use one.

    Parameters
    ----------
    flight
        The flight; a stream ``wind`` it has is replaced.
    wind
        Text as on the command line (``"3,1"``: north and east in m/s, where it blows to; ``"5@270"``: speed and azimuth it comes from), the
        path of a table, north, east and down [m/s] as numbers, or columns by name as a table has them.
    sd
        1 sigma of each component [m/s], over what the wind says itself; by default `SD` where it says nothing.

    Returns
    -------
    FlightLog
        With the stream ``wind``, and notes on what was taken how.

    Raises
    ------
    HaltereError
        A table that cannot be read, lacks a time or a wind, or does not reach the flight.
    UsageError
        A text or a number that is no wind.

    Notes
    -----
    A table has a time, ``t`` [s] of the flight or ``utc`` (ISO 8601, or seconds since 1970; the flight has to know its own start); a
    wind, ``wind_n, wind_e[, wind_d]`` as it blows to, or ``speed`` with ``direction`` it comes from (or ``to``); and, if it likes, ``sd``
    and ``gust``. A unit stands in brackets behind a name: ``speed [km/h]``. Directions become vectors at once, so that nothing is ever
    interpolated across north. Without ``sd`` a gust says how far the wind varies about its mean: a third of what it is above it.
    """
    if sd is not None and not (math.isfinite(sd) and sd > 0.0):
        raise UsageError("a positive 1 sigma [m/s]", repr(sd), "wind")
    stream, notes = given_wind(flight, wind, sd)
    return FlightLog({**flight.streams, "wind": stream}, flight.meta, [*flight.notes, *notes], flight.discarded)


def given_wind(flight: FlightLog, wind: Any, sd: float | None = None) -> tuple[Stream, list[str]]:
    """The stream ``wind`` of `with_wind`, and what is to be said of it."""
    constant: tuple[float, float, float] | None = None
    if isinstance(wind, Mapping):
        return _of_columns(flight, {str(k): v for k, v in wind.items()}, sd, "wind")
    if isinstance(wind, (str, Path)):
        constant = parse_wind(str(wind))
        if constant is None:
            path = Path(wind)
            if not path.is_file():
                raise UsageError(SHAPES, f"{str(wind)!r}, which is no file", "wind")
            return _of_columns(flight, _load(path), sd, str(path))
    else:
        values = tuple(float(v) for v in np.atleast_1d(np.asarray(wind, dtype=np.float64)).ravel())
        if len(values) not in (2, 3) or not all(math.isfinite(v) for v in values):
            raise UsageError("north, east[, down] in m/s", repr(wind), "wind")
        constant = _strong((values[0], values[1], values[2] if len(values) > 2 else 0.0), str(wind))
    start, end = _span(flight)
    t = np.append(np.arange(start, end, INTERVAL), end)
    columns = {"t": t} | {f"wind_{a}": np.full(len(t), v) for a, v in zip("ned", constant, strict=True)} | {"sd": np.full(len(t), sd or SD)}
    assumed = "" if sd else ", an assumption"
    n, e = (round(v, 3) + 0.0 for v in constant[:2])
    return Stream(columns), [f"wind told: {n:g} m/s to north, {e:g} to east, 1 sigma {sd or SD:g} m/s{assumed}"]


def _span(flight: FlightLog) -> tuple[float, float]:
    """First and last time of the flight [s]."""
    times = [s.t[np.isfinite(s.t)] for name, s in flight.streams.items() if name == "imu"] or [s.t for s in flight.streams.values()]
    times = [t for t in times if len(t)]
    if not times:
        raise HaltereError("a flight with samples", "none", "wind")
    return float(min(t.min() for t in times)), float(max(t.max() for t in times))


def _load(path: Path) -> dict[str, Any]:
    from haltere.flight.folder import csv_table, parquet_table

    with path.open("rb") as file:
        head = file.read(65536)
    if head.startswith(b"PAR1"):
        table = parquet_table(path)
    else:
        line = next((x for x in head.decode("utf-8-sig", "replace").splitlines() if x.strip() and not x.startswith("#")), "")
        table = csv_table(path, max(",;\t", key=line.count), "#")
    return {name.strip(): _plain(table[name]) for name in table.columns}


def _plain(column: pl.Series) -> NDArray[Any]:
    """A column as numbers, or as text (dates too)."""
    import polars as pl

    if column.dtype.is_temporal():
        return np.array([v.isoformat() if v is not None else "" for v in column.to_list()])
    if column.dtype == pl.String:
        column = column.str.strip_chars().replace("", None)
        values = column.cast(pl.Float64, strict=False)
        if values.null_count() == column.null_count():
            return np.asarray(values.fill_null(math.nan).to_numpy(), np.float64)
        return np.array([v or "" for v in column.to_list()])
    return np.asarray(column.cast(pl.Float64).to_numpy(), np.float64)


def _of_columns(flight: FlightLog, table: dict[str, Any], sd: float | None, where: str) -> tuple[Stream, list[str]]:
    """A table of a station or of components as a stream."""
    found, notes = _known(table, where)
    t = _time(found, flight, where)
    if {"wind_n", "wind_e"} <= set(found):
        n, e = found["wind_n"], found["wind_e"]
    elif "speed" in found and ("from" in found or "to" in found):
        angle = np.radians(found["from"]) + math.pi if "from" in found else np.radians(found["to"])
        n, e = found["speed"] * np.cos(angle), found["speed"] * np.sin(angle)
        if "from" in found:
            notes.append("wind told by its direction: taken as the one it comes from, clockwise from true north")
    else:
        raise HaltereError("wind_n and wind_e, or speed and direction", f"columns {', '.join(table)}", where, f"name them {HEADS}")
    d = found.get("wind_d", np.zeros(len(t)))
    if sd is not None:
        spread = np.full(len(t), sd)
    elif "sd" in found:
        spread = found["sd"]
    elif "gust" in found:
        spread = np.maximum((found["gust"] - np.hypot(n, e)) / PEAK, 0.5 * SD)
        notes.append(
            f"1 sigma of the told wind from its gusts: what they are above the mean over {PEAK:g}, at least {0.5 * SD:g} m/s; an assumption"
        )
    else:
        spread = np.full(len(t), SD)
        notes.append(f"1 sigma of the told wind is {SD:g} m/s, an assumption: the table has neither sd nor gust")
    good = np.isfinite(t) & np.isfinite(n) & np.isfinite(e)
    if not good.any():
        raise HaltereError("rows with a time and a wind", "none", where)
    fastest = float(np.max(np.hypot(n[good], e[good])))
    if fastest > STRONGEST:
        raise HaltereError(f"winds below {STRONGEST:g} m/s", f"{fastest:.3g} m/s", where, "name the unit in brackets, such as speed [km/h]")
    if (spread[good] <= 0.0).any():
        raise HaltereError("a positive sd [m/s]", f"{float(np.min(spread[good])):g}", where)
    order = np.argsort(t[good], kind="stable")
    columns = {"t": t, "wind_n": n, "wind_e": e, "wind_d": np.nan_to_num(d), "sd": spread}
    stream = Stream({name: v[good][order] for name, v in columns.items()})
    start, end = _span(flight)
    if stream.t[-1] < start or stream.t[0] > end:
        raise HaltereError(
            f"a wind between t = {start:.1f} and {end:.1f} s of the flight", f"t = {stream.t[0]:.1f} to {stream.t[-1]:.1f} s", where,
            "is the time UTC, and the flight's start_utc right?",
        )  # fmt: skip
    if lost := int((~good).sum()):
        notes.append(f"told wind: {lost} of {len(t)} rows without a time or a wind left out")
    return stream, [f"wind told by {where}: {len(stream)} rows", *notes]


def _known(table: dict[str, Any], where: str) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Columns by what they are, in SI units but directions in degrees; and which were not read."""
    out: dict[str, NDArray[Any]] = {}
    unread = []
    for head, values in table.items():
        name, unit = _split(head)
        what = KNOWN.get(name.casefold().replace(" ", "_"))
        if what is None:
            unread.append(head)
            continue
        if what in out:
            raise HaltereError(f"one column for {what}", f"two, the second {head!r}", where, "rename one of them")
        array = np.asarray(values)
        if what == "utc":
            out[what] = array
            continue
        if array.dtype.kind not in "fiub":
            raise HaltereError(f"numbers in {head!r}", f"text such as {next((str(v) for v in array if v), '')!r}", where)
        allowed = UNITS[COLUMNS[what][1]]
        if unit and unit_word(unit) not in allowed:
            raise HaltereError(f"a unit of {head!r} among {', '.join(allowed)}", unit, where, nearest(unit, allowed))
        factor, offset = allowed[unit_word(unit) if unit else COLUMNS[what][1]]
        out[what] = factor * array.astype(np.float64) + offset
    lengths = {len(v) for v in out.values()}
    if len(lengths) > 1:
        raise HaltereError("columns of one length", f"lengths {', '.join(map(str, sorted(lengths)))}", where)
    if "from" in out and "to" in out:
        raise HaltereError("a direction, either from or to", "both", where, "leave one out")
    return out, [f"told wind: columns not read: {', '.join(unread)}"] if unread else []


def _split(head: str) -> tuple[str, str]:
    """Name and unit of ``name [unit]``."""
    found = re.fullmatch(r"(.*?)\s*\[([^\]]*)\]", head.strip())
    return (found[1], found[2].strip()) if found else (head.strip(), "")


def _time(found: dict[str, NDArray[Any]], flight: FlightLog, where: str) -> FloatArray:
    """Times of the flight [s]."""
    if "t" in found:
        return np.asarray(found["t"], np.float64)
    if "utc" not in found:
        raise HaltereError("a time, t [s] of the flight or utc", "none", where, f"name the columns {HEADS}")
    if flight.meta.start_utc is None:
        raise HaltereError("the time t [s] of the flight", "utc, and a flight that does not know its start", where,
                           "give start_utc in flight.toml, or t instead of utc")  # fmt: skip
    start = _utc(flight.meta.start_utc, "start_utc")
    values = found["utc"]
    if values.dtype.kind in "fiub":
        return np.asarray(values, np.float64) - start
    return np.array([_utc(str(v), where) - start if str(v).strip() else math.nan for v in values])


def _utc(text: str, where: str) -> float:
    """Seconds since 1970 of an ISO 8601 time, which is UTC where it names no zone."""
    try:
        stamp = dt.datetime.fromisoformat(text.strip())
    except ValueError:
        raise HaltereError("an ISO 8601 time, such as 2024-05-01T12:00:00Z", repr(text), where) from None
    return (stamp if stamp.tzinfo else stamp.replace(tzinfo=dt.UTC)).timestamp()
