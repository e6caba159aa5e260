"""Reading one CSV or Parquet table by a column map, or by column names as in the schema. It guesses neither units nor axes."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from haltere.errors import HaltereError
from haltere.flight.folder import csv_table, parquet_table, to_column
from haltere.flight.log import FlightLog, FlightMeta, Stream
from haltere.flight.schema import NAVIGATION_STREAMS, STREAMS, base_name, column
from haltere.flight.units import UNITS, unit_word
from haltere.readers._common import FloatArray, unusable

if TYPE_CHECKING:
    import polars as pl

__all__ = ["ROWS", "UNITS", "bare_vectors", "read", "sniff"]

PARQUET = b"PAR1"
#: What is said of a table without time.
ROWS = "the table has no time: t is the number of the row"
#: Streams whose columns are recognised without the stream's name.
BARE_STREAMS = tuple(name for name in STREAMS if name not in ("onboard", "truth"))
EXAMPLE = 'e.g. {"imu.t": "time_us [us]", "imu.gyro_x": "gx [deg/s]", "imu.accel_x": "ax [g]"}'


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is a Parquet table, or text whose first line is one of names."""
    if head.startswith(PARQUET):
        return True
    # The header alone decides; damage further down is told by the reader, with its line.
    header = next((line for line in _lines(head) if line.strip() and not line.startswith("#")), "")
    fields = header.split(_delimiter(header))
    named = sum(_is_name(f) for f in fields)
    # A nameless column is the row number that some tools write; one that is no name is damage.
    return named > 1 and 2 * named > sum(bool(f.strip(' "')) for f in fields) and "\0" not in header


def _is_name(field: str) -> bool:
    text = field.strip().strip('"')
    return text[:1].isascii() and (text[:1].isalpha() or text[:1] == "_") and text.isprintable()


def read(path: Path, column_map: Mapping[str, str] | None = None) -> FlightLog:
    """Read a table.

    Parameters
    ----------
    path
        A ``.csv`` (comma, semicolon or tab; a header line) or ``.parquet`` file.
    column_map
        Which column is what: ``{"imu.gyro_x": "gx [deg/s]"}`` takes the column ``gx`` in deg/s for ``gyro_x`` of the stream ``imu``.
        Without a unit the schema's is meant; ``-gx`` turns the sign; ``{"t": "time [ms]"}`` is the time of every stream without its own.
        In a table of numbers without a header line ``#1`` is the first column, and ``#row`` the number of the row, for a table without
        time: ``{"t": "#row [ms]"}``.
        Without a map, columns named ``imu.gyro_x`` or ``gyro_x``, with or without a unit in brackets, are taken.

    Returns
    -------
    FlightLog
        Streams in SI units, t = 0 at the earliest sample. Rows in which a stream has no value are not part of that stream.
        Axes are taken as NED/FRD.

    Raises
    ------
    HaltereError
        An unreadable table, a source column that is not there, an unknown stream, column or unit, or a stream without time.
    """
    numbered = column_map is not None and any(_split_unit(v)[0].lstrip("-").startswith("#") for v in column_map.values())
    table = _load_numbers(path) if numbered else _load(path)
    notes: list[str] = []
    wanted = _from_map(column_map, table, path) if column_map is not None else _from_names(table, path, notes)
    discarded: dict[str, dict[str, int]] = {}
    streams: dict[str, dict[str, FloatArray]] = {}
    if any(columns["t"][0] == "#row" for columns in wanted.values()):
        notes.append(ROWS)
    for stream, columns in wanted.items():
        values = {name: _values(table, source, unit, column_unit(stream, name), path) for name, (source, unit) in columns.items()}
        t = values.pop("t")
        some = np.any([np.isfinite(v) for v in values.values()], axis=0) if values else np.zeros(len(t), dtype=bool)
        timed = np.isfinite(t)
        if lost := int((some & ~timed).sum()):
            discarded[stream] = {"no time stamp": lost}
        keep = some & timed
        if not keep.any():
            notes.append(f"{stream} left out: no row has a time and a value")
            continue
        streams[stream] = {"t": t[keep], **{k: v[keep] for k, v in values.items()}}
    if not streams:
        raise unusable(path, "a table with values", "none in the columns that were taken", f"give a column map, {EXAMPLE}")
    starts = [float(s["t"].min()) for name, s in streams.items() if base_name(name) in NAVIGATION_STREAMS]
    start = min(starts or [float(s["t"].min()) for s in streams.values()])
    for name, part in streams.items():
        part["t"] = part["t"] - start
        if base_name(name) in ("magnetometer", "gnss", "barometer") and _held(part):
            notes.append(f"{name}: most rows repeat the row before, as if held between updates")
    meta = FlightMeta(name=path.stem, source=f"table: {path.name}", time_offset=start)
    return FlightLog({name: Stream(part) for name, part in streams.items()}, meta, notes, discarded)


def column_unit(stream: str, name: str) -> str:
    """Unit of a column of the schema."""
    known = column(stream, name)
    return known.unit if known is not None else "1"


def _held(part: dict[str, FloatArray]) -> bool:
    rows = np.column_stack([v for k, v in part.items() if k != "t"])
    return len(rows) > 10 and float(np.mean(np.all((rows[1:] == rows[:-1]) | np.isnan(rows[1:]), axis=1))) > 0.5


def _lines(data: bytes) -> list[str]:
    return data.decode("utf-8-sig", "replace").splitlines()


def _delimiter(line: str) -> str:
    return max(",;\t", key=line.count)


def _load(path: Path) -> pl.DataFrame:
    with path.open("rb") as file:
        head = file.read(65536)
    if head.startswith(PARQUET):
        return parquet_table(path)
    lines = [line for line in _lines(head) if line.strip() and not line.startswith("#")]
    table = csv_table(path, _delimiter(lines[0]) if lines else ",", "#")
    names = [name.strip() for name in table.columns]
    if len(set(names)) < len(names):
        name, n = Counter(names).most_common(1)[0]
        raise unusable(path, "columns with names of their own", f"{n} columns {name!r}", "rename one of them")
    return table.rename(dict(zip(table.columns, names, strict=True)))


def bare_vectors(path: Path) -> bool:
    """Whether a file is text of three numbers a line and no header."""
    try:
        with path.open("rb") as file:
            head = file.read(4096)
        lines = [line for line in head.decode("ascii").splitlines() if line.strip() and not line.startswith("#")]
        rows = [[float(v) for v in _fields(line)] for line in (lines[:-1] if len(head) == 4096 else lines)]
    except (OSError, ValueError):
        return False
    return len(rows) > 1 and all(len(row) == 3 for row in rows)


def _fields(line: str) -> list[str]:
    """Fields of a line, between commas, semicolons or blanks."""
    mark = next((c for c in ",;" if c in line), None)
    return [v.strip() for v in line.strip().strip(mark or " ").split(mark)]


def _load_numbers(path: Path) -> pl.DataFrame:
    """A table of numbers without a header line: columns ``#1``, ``#2``, ... and ``#row``."""
    import polars as pl

    rows: list[list[float]] = []
    for n, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            rows.append([float(v or "nan") for v in _fields(line)])
        except ValueError:
            raise unusable(
                path, "numbers alone, as there are columns by number", f"{line[:40]!r} in line {n}", "map columns by name"
            ) from None
        if len(rows[-1]) != len(rows[0]):
            raise unusable(path, f"{len(rows[0])} numbers a line", f"{len(rows[-1])} in line {n}", "clean the table")
    if not rows:
        raise unusable(path, "a table with values", "none", "copy the log again")
    columns = np.array(rows).T
    return pl.DataFrame({**{f"#{k + 1}": v for k, v in enumerate(columns)}, "#row": np.arange(len(rows), dtype=np.float64)})


def _split_unit(text: str) -> tuple[str, str]:
    """Name and unit of ``name [unit]``; no unit where nothing stands in brackets at the end."""
    text = text.strip()
    name, bracket, unit = text[:-1].rpartition("[") if text.endswith("]") else ("", "", "")
    return (name.strip(), unit.strip()) if bracket and "]" not in unit else (text, "")


def _nearest(word: str, known: list[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.4)
    return f"did you mean {close[0]!r}?" if close else f"there are: {', '.join(known[:40])}"


#: Source column and unit by column of a stream.
Wanted = dict[str, dict[str, tuple[str, str]]]


def _from_map(column_map: Mapping[str, str], table: pl.DataFrame, path: Path) -> Wanted:
    wanted: Wanted = {}
    shared: tuple[str, str] | None = None
    for target, text in column_map.items():
        source, unit = _split_unit(text)
        if source not in table.columns and source.lstrip("-") not in table.columns:
            if text not in table.columns:  # the header itself may hold the unit
                raise HaltereError(f"the column {source!r} for {target}", "no such column", str(path), _nearest(source, table.columns))
            source = text
        if target == "t":
            shared = source, unit
            continue
        stream, _, name = target.rpartition(".")
        if base_name(stream) not in STREAMS:
            known = list(STREAMS)
            raise HaltereError("stream.column of a known stream", repr(target), "column map", _nearest(base_name(stream) or target, known))
        if column(stream, name) is None:
            known = list(STREAMS[base_name(stream)].names)
            raise HaltereError(f"a column of {stream}", repr(name), "column map", _nearest(name, known))
        wanted.setdefault(stream, {})[name] = source, unit
    return _timed(wanted, shared, path)


def _from_names(table: pl.DataFrame, path: Path, notes: list[str]) -> Wanted:
    wanted: Wanted = {}
    shared: tuple[str, str] | None = None
    unknown = []
    for source in table.columns:
        name, unit = _split_unit(source)
        if name == "t" or (unit and name.lower() in ("time", "timestamp")):
            shared = source, unit
            continue
        stream, _, last = name.rpartition(".")
        if not stream:
            stream = next((s for s in BARE_STREAMS if column(s, name) is not None), "")
        if not stream or column(stream, last) is None:
            unknown.append(source)
            continue
        wanted.setdefault(stream, {})[last] = source, unit
    if not wanted:
        raise HaltereError(
            "columns named as in haltere's schema (gyro_x or imu.gyro_x), or a column map",
            f"columns {', '.join(table.columns[:12])}{' ...' if len(table.columns) > 12 else ''}",
            str(path),
            f"give a column map, {EXAMPLE}",
        )
    if unknown:
        notes.append(f"columns not recognised and not read: {', '.join(unknown)}")
    return _timed(wanted, shared, path)


def _timed(wanted: Wanted, shared: tuple[str, str] | None, path: Path) -> Wanted:
    for stream, columns in wanted.items():
        if "t" not in columns:
            if shared is None:
                remedy = f'map "{stream}.t", or "t" for every stream, to the time column'
                raise HaltereError(f"a time for {stream}", "none", str(path), remedy)
            columns["t"] = shared
    return wanted


def _values(table: pl.DataFrame, source: str, unit: str, target_unit: str, path: Path) -> FloatArray:
    """One column in the schema's unit."""
    name = source if source in table.columns else source.lstrip("-")
    allowed = UNITS[target_unit]
    unit = unit_word(unit) or target_unit
    if unit not in allowed:
        found = f"[{unit}] of column {name!r}"
        raise HaltereError(f"a unit that can be turned into {target_unit}", found, str(path), f"known: {', '.join(allowed)}")
    values = to_column(table[name], path)
    if values.dtype.kind != "f":
        bad = next((v for v in values.tolist() if not _is_number(v)), "")
        raise HaltereError("numbers", f"{bad!r}", f"{path} column {name!r}", "map another column or clean the table")
    factor, offset = allowed[unit]
    return np.asarray(values * (factor if name == source else -factor) + offset, dtype=np.float64)


def _is_number(text: str) -> bool:
    try:
        float(text or "nan")
    except ValueError:
        return False
    return True
