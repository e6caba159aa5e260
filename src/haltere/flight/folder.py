"""The flight folder: flight.toml and one table a stream, written whole or not at all. It keeps samples as they are and checks none."""

from __future__ import annotations

import csv
import datetime as dt
import difflib
import io
import math
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.flight.log import FlightLog, FlightMeta, Home, Stream
from haltere.flight.schema import STREAMS, base_name, column
from haltere.flight.writing import whole_files

if TYPE_CHECKING:
    import polars as pl

__all__ = ["csv_table", "parquet_table", "read", "read_folder", "sniff", "to_column", "write_folder"]

TOML = "flight.toml"
KEYS = (
    *("name", "source", "start_utc", "time_offset", "frame", "imu_kind", "streams", "notes"),
    *("home", "vehicle", "delays", "mounting", "noise", "field", "text", "discarded", "fault", "compass"),
)
FRAMES = ("NED/FRD", "ENU/FLU")
#: Tables of a result folder, which are no streams.
RESULTS = ("solution", "smoothed", "aids")
FIELD_KEYS = ("declination", "dip", "strength")
IMU_KINDS = ("instant", "mean")
#: Columns of the schema that are text; all others are numbers.
TEXT_COLUMNS = ("mode",)


def sniff(path: Path, head: bytes) -> bool:
    """Whether a path is a flight folder or its flight.toml, or a folder of tables that lacks only that."""
    if not path.is_dir():
        return path.name == TOML
    return (path / TOML).is_file() or any(p.suffix in (".csv", ".parquet") and p.is_file() for p in path.iterdir())


def write_folder(flight: FlightLog, path: Path | str, *, csv: bool = False) -> Path:
    """Write a flight as ``flight.toml`` and one table a stream.

    Parameters
    ----------
    flight
        What to write; every column, note and count is kept.
    path
        The folder. Streams of a flight written there before are replaced; other files are left alone.
    csv
        Tables as ``.csv`` instead of ``.parquet``.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    HaltereError
        ``path`` is a file, or cannot be written.

    Notes
    -----
    Tables are written under a temporary name and renamed when they are complete, ``flight.toml`` last: what an
    interrupted write leaves is no flight folder, never half a table under its final name.
    """
    path = Path(path)
    suffix = ".csv" if csv else ".parquet"
    with whole_files(path, TOML, _written_before(path)) as work:
        for name, stream in flight.streams.items():
            _write_table(stream, work / (_quoted(name) + suffix))
        (work / TOML).write_text(_to_toml(flight), encoding="utf-8")
    return path


def read_folder(path: Path | str) -> FlightLog:
    """Read a flight folder.

    Parameters
    ----------
    path
        The folder, or its ``flight.toml``.

    Returns
    -------
    FlightLog
        In NED/FRD whatever the folder's frame; times as they are.

    Raises
    ------
    HaltereError
        No ``flight.toml``, a key or value that is not understood, or a table that cannot be read.
    """
    path = Path(path)
    path = path.parent if path.name == TOML and not path.is_dir() else path
    file = path / TOML
    if not file.is_file():
        raise HaltereError(f"a flight folder with a {TOML}", "none", str(path), "`haltere convert LOG DIR` makes one")
    try:
        doc = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise HaltereError("valid TOML in UTF-8", str(error), str(file), "correct the line") from error
    _known(doc, KEYS, file, "key")
    frame = _choice(doc, "frame", FRAMES, file)
    text: dict[str, list[str]] = _table(doc, "text", file)
    streams: dict[str, Stream] = {}
    for name, table in _tables(path, doc, file):
        streams[name] = _read_table(name, table, text.get(name, []))
    flight = FlightLog(streams, _meta(doc, file), _texts(doc, "notes", file), _counts(doc, file))
    return _to_ned_frd(flight) if frame == "ENU/FLU" else flight


def read(path: Path) -> FlightLog:
    """The same as `read_folder`: the face that every reader has."""
    return read_folder(path)


# Writing


def _quoted(stream: str) -> str:
    name = quote(stream, safe=" +,=@()")
    return f"%2E{name[1:]}" if name.startswith(".") else name


def _write_table(stream: Stream, path: Path) -> None:
    import polars as pl

    # Text goes in as Python strings: polars cuts NumPy's fixed-width text no other way.
    table = pl.DataFrame({k: v if v.dtype.kind == "f" else pl.Series(v.tolist(), dtype=pl.String) for k, v in stream.columns.items()})
    if path.suffix == ".csv":
        table.write_csv(path)
    else:
        table.write_parquet(path)


def _written_before(path: Path) -> list[str]:
    """Tables of the flight that is in a folder already."""
    try:
        return [t.name for _, t in _tables(path, tomllib.loads((path / TOML).read_text(encoding="utf-8")), path / TOML)]
    except (OSError, ValueError):
        return []


def _to_toml(flight: FlightLog) -> str:
    import tomli_w

    meta = flight.meta
    text = {name: [k for k, v in s.columns.items() if v.dtype.kind != "f"] for name, s in flight.streams.items()}
    doc: dict[str, Any] = {
        "name": meta.name,
        "source": meta.source,
        "start_utc": meta.start_utc,
        "time_offset": meta.time_offset,
        "frame": FRAMES[0],
        "imu_kind": meta.imu_kind,
        "streams": list(flight.streams),
        "notes": flight.notes,
        "home": {"lat": meta.home.lat, "lon": meta.home.lon, "alt": meta.home.alt} if meta.home else None,
        "vehicle": {"file": meta.vehicle_file} if meta.vehicle_file is not None else None,
        "delays": meta.delays or None,
        "mounting": meta.mounting or None,
        "noise": meta.noise or None,
        "field": meta.field or None,
        "text": {k: v for k, v in text.items() if v} or None,
        "discarded": flight.discarded or None,
        "fault": meta.faults or None,
        "compass": {k: v for k, v in meta.compass.items() if v} or None,
    }
    return tomli_w.dumps(_plain(doc))


def _plain(value: Any) -> Any:
    """The value in TOML's types; keys without a value are left out, as TOML has none."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value if v is not None]
    return value.item() if isinstance(value, np.generic) else value


# Reading


def _nearest(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def _known(doc: Mapping[str, Any], keys: Iterable[str], file: Path, what: str) -> None:
    keys = tuple(keys)
    for key in doc:
        if key not in keys:
            raise HaltereError(f"a known {what}", repr(key), str(file), _nearest(key, keys))


def _choice(doc: Mapping[str, Any], key: str, allowed: tuple[str, ...], file: Path) -> str:
    value = doc.get(key, allowed[0])
    if value not in allowed:
        raise HaltereError(f"{key} = {' or '.join(map(repr, allowed))}", repr(value), str(file), _nearest(str(value), allowed))
    return str(value)


def _table(doc: Mapping[str, Any], key: str, file: Path) -> dict[str, Any]:
    value = doc.get(key, {})
    if not isinstance(value, dict):
        raise HaltereError(f"a table [{key}]", f"{key} = {value!r}", str(file), "see the page on flight folders")
    return value


def _number(value: Any, where: str, file: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise HaltereError(f"a number for {where}", repr(value), str(file), "write it without quotes")
    try:
        number = float(value)
    except OverflowError:  # whole numbers of TOML have no end
        number = math.inf
    if not math.isfinite(number):
        raise HaltereError(f"a finite number for {where}", str(value)[:40], str(file), "leave the key out where there is no value")
    return number


def _numbers(doc: Mapping[str, Any], key: str, file: Path) -> dict[str, float]:
    """A table of numbers; ``[noise] gyro.x = 1`` and ``"gyro.x" = 1`` are the same key."""
    out: dict[str, float] = {}

    def walk(table: Mapping[str, Any], prefix: str) -> None:
        for name, value in table.items():
            if isinstance(value, dict):
                walk(value, f"{prefix}{name}.")
            else:
                out[prefix + name] = _number(value, f"{key}.{prefix}{name}", file)

    walk(_table(doc, key, file), "")
    return out


def _string(doc: Mapping[str, Any], key: str, file: Path) -> str:
    value = doc.get(key, "")
    if not isinstance(value, str):
        raise HaltereError(f"text for {key}", repr(value), str(file), "write it in quotes")
    return value


def _texts(doc: Mapping[str, Any], key: str, file: Path) -> list[str]:
    value = doc.get(key, [])
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise HaltereError(f"a list of texts for {key}", repr(value), str(file), 'write it as ["one", "two"]')
    return value


def _counts(doc: Mapping[str, Any], file: Path) -> dict[str, dict[str, int]]:
    streams = _table(doc, "discarded", file)
    return {s: {k: int(_number(v, f"discarded.{s}.{k}", file)) for k, v in _table(streams, s, file).items()} for s in streams}


def _utc(doc: Mapping[str, Any], file: Path) -> str | None:
    value = doc.get("start_utc")
    if isinstance(value, dt.datetime):
        # TOML's own date form; a time without an offset is taken as UTC.
        value = value if value.tzinfo else value.replace(tzinfo=dt.UTC)
        return value.astimezone(dt.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if value is None or isinstance(value, str):
        return value
    raise HaltereError("an ISO 8601 time for start_utc", repr(value), str(file), 'write it as "2024-05-01T12:00:00Z"')


def _meta(doc: Mapping[str, Any], file: Path) -> FlightMeta:
    home = None
    if "home" in doc:
        table = _table(doc, "home", file)
        _known(table, ("lat", "lon", "alt"), file, "key of [home]")
        missing = [k for k in ("lat", "lon", "alt") if k not in table]
        if missing:
            raise HaltereError("lat, lon and alt in [home]", f"no {missing[0]}", str(file), "degrees, degrees, metres above mean sea level")
        home = Home(*(_number(table[k], f"home.{k}", file) for k in ("lat", "lon", "alt")))
    vehicle = _table(doc, "vehicle", file)
    _known(vehicle, ("file",), file, "key of [vehicle]")
    field = _numbers(doc, "field", file)
    _known(field, FIELD_KEYS, file, "key of [field]")
    mounting: dict[str, tuple[float, float, float, float]] = {}
    for stream, q in _table(doc, "mounting", file).items():
        if not isinstance(q, list) or len(q) != 4:
            raise HaltereError("a quaternion [w, x, y, z]", repr(q), f"{file}: mounting.{stream}", "q_b_sensor, scalar first")
        w, x, y, z = (_number(v, f"mounting.{stream}", file) for v in q)
        mounting[stream] = (w, x, y, z)
    faults = doc.get("fault", [])
    if not isinstance(faults, list) or not all(isinstance(f, dict) for f in faults):
        raise HaltereError("tables [[fault]]", repr(faults), str(file), "one [[fault]] a fault")
    return FlightMeta(
        name=_string(doc, "name", file) if "name" in doc else file.parent.name,
        source=_string(doc, "source", file),
        start_utc=_utc(doc, file),
        time_offset=_number(doc.get("time_offset", 0.0), "time_offset", file),
        home=home,
        vehicle_file=_string(vehicle, "file", file) if "file" in vehicle else None,
        delays=_numbers(doc, "delays", file),
        mounting=mounting,
        noise=_numbers(doc, "noise", file),
        field=field,
        imu_kind=_choice(doc, "imu_kind", IMU_KINDS, file),
        faults=faults,
        compass={name: dict(_table(_table(doc, "compass", file), name, file)) for name in _table(doc, "compass", file)},
    )


def _tables(path: Path, doc: Mapping[str, Any], file: Path) -> list[tuple[str, Path]]:
    """Streams and their tables: those that flight.toml lists, else every table that lies there, in the schema's order."""
    found: dict[str, Path] = {}
    for suffix in (".csv", ".parquet"):  # parquet wins where both are there
        found |= {unquote(p.name[: -len(suffix)]): p for p in sorted(path.glob(f"*{suffix}")) if not p.name.startswith(".")}
    if "streams" in doc:
        names = _texts(doc, "streams", file)
        for name in names:
            if name not in found:
                missing = f"no {_quoted(name)}.parquet or .csv"
                raise HaltereError(f"a table for the stream {name!r}", missing, str(path), f"add it or take it out of streams in {TOML}")
        return [(name, found[name]) for name in names]
    known = list(STREAMS)
    names = [n for n in found if n not in RESULTS]
    names.sort(key=lambda n: (known.index(base_name(n)) if base_name(n) in known else len(known), n))
    if not names:
        raise HaltereError("at least one table, e.g. imu.csv", "none", str(path), f"put one table a stream beside {TOML}")
    return [(name, found[name]) for name in names]


def _read_table(stream: str, path: Path, text: list[str]) -> Stream:
    table = parquet_table(path) if path.suffix == ".parquet" else csv_table(path)
    columns: dict[str, NDArray[Any]] = {}
    for series in table.get_columns():
        name = series.name if series.name in text else series.name.strip()
        if name in columns:
            raise HaltereError("columns with names of their own", f"two columns {name!r}", str(path), "rename one of them")
        known = column(stream, name) is not None
        if known and name not in TEXT_COLUMNS:
            columns[name] = _numbers_of(series, path)
        else:
            as_text = name in text or known or (None if path.suffix == ".csv" else True)
            columns[name] = to_column(series, path, as_text=as_text)
    try:
        return Stream(columns)
    except HaltereError as error:
        raise HaltereError(error.expected, error.found, f"{path} {error.where}".strip(), error.remedy) from None


def parquet_table(path: Path) -> pl.DataFrame:
    """A Parquet file as a table.

    Raises
    ------
    HaltereError
        It cannot be read: cut short, damaged, or of another kind.
    """
    import polars as pl

    try:
        return pl.read_parquet(path)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        # A page that contradicts the file's own description is a panic to polars, which is no Exception.
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: BaseException) -> HaltereError:
    found = f"one that cannot be read ({(str(error).splitlines() or [''])[0][:200]})"
    remedy = "write the table again, or copy it again from where it is whole"
    return HaltereError(f"a {path.suffix[1:] or 'CSV'} table", found, str(path), remedy)


def csv_table(path: Path, separator: str = ",", comment: str | None = None) -> pl.DataFrame:
    """A CSV file as a table of texts.

    Parameters
    ----------
    path
        The file; its first line names the columns.
    separator
        Between the cells.
    comment
        What lines begin with that are passed over.

    Raises
    ------
    HaltereError
        Not UTF-8 text, or a line with more cells than there are names; the message has its number. Or it cannot be read at all.
    """
    import polars as pl

    data = path.read_bytes()
    if b"\n" not in data:  # lines that end as they did on a Macintosh
        data = data.replace(b"\r", b"\n")
    for bad, what in ((data.find(b"\0"), "a zero byte"), (_not_utf8(data), "a byte that is not UTF-8")):
        if bad >= 0:
            line = data.count(b"\n", 0, bad) + 1
            remedy = "save the table as UTF-8; if its end was never written, cut it there"
            raise HaltereError("text in UTF-8", f"{what} ({data[bad]:#04x})", f"{path} line {line}", remedy)
    try:
        # As text first: an empty or all-NaN column must not change its type by what stands in it.
        return pl.read_csv(data, separator=separator, infer_schema_length=0, comment_prefix=comment)
    except pl.exceptions.PolarsError as error:
        rows = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), delimiter=separator)
        counts = [(rows.line_num, len(row)) for row in rows if row and not (comment and row[0].startswith(comment))]
        for line, n in counts:
            if n > (names := counts[0][1]):
                expected = f"{names} cells, as many as the header names"
                raise HaltereError(expected, str(n), f"{path} line {line}", "correct the line") from error
        raise _unreadable(path, error) from error


def _not_utf8(data: bytes) -> int:
    """Offset of the first byte that is not UTF-8 text, or -1."""
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        return error.start
    return -1


def _numbers_of(series: pl.Series, path: Path) -> NDArray[np.float64]:
    """A column that can only be numbers."""
    values = to_column(series, path)
    if values.dtype.kind == "f":
        return values
    for i, text in enumerate(values.tolist()):
        try:
            float(text or "nan")
        except ValueError:
            where = f"{path} column {series.name!r}, row {i + 1}"
            raise HaltereError("a number", repr(text[:40]), where, "correct the cell, or leave it empty where there is no value") from None
    raise HaltereError("numbers", "text", f"{path} column {series.name!r}", "write plain decimal numbers")


def to_column(series: pl.Series, where: Path | str, *, as_text: bool | None = None) -> NDArray[Any]:
    """A polars column as float64 (missing values NaN) or text (missing values empty).

    Parameters
    ----------
    series
        The column.
    where
        Its table, for the error.
    as_text
        Whether a text column stays text; None: it becomes numbers where every filled cell is one, as in a CSV read as text.

    Raises
    ------
    HaltereError
        Neither numbers nor text.
    """
    import polars as pl

    if series.dtype == pl.String:
        if not as_text:
            bare = series.str.strip_chars()
            numbers = bare.replace("", None).cast(pl.Float64, strict=False)
            if int(numbers.is_not_null().sum()) == int((bare != "").sum()):
                return numbers.fill_null(float("nan")).to_numpy().astype(np.float64)
            if as_text is None:
                series = bare
        return np.array(series.fill_null("").to_list(), dtype=np.str_)
    if series.dtype.is_numeric() or series.dtype in (pl.Boolean, pl.Null):
        return series.cast(pl.Float64).fill_null(float("nan")).to_numpy().astype(np.float64)
    raise HaltereError("numbers or text", f"type {series.dtype}", f"{where} column {series.name!r}", "times are seconds as numbers")


# Frames


def _to_ned_frd(flight: FlightLog) -> FlightLog:
    """A flight recorded in ENU and FLU axes, in NED and FRD: body y and z turn over; n, e, d columns are what they are named."""
    streams = {}
    for name, stream in flight.streams.items():
        columns = dict(stream.columns)
        for stem in ("gyro", "accel", "mag", "raw", "gyro_bias", "accel_bias"):
            for axis in "yz":
                if (key := f"{stem}_{axis}") in columns:
                    columns[key] = -columns[key]
        q = [columns.get(f"q_{a}") for a in "wxyz"]
        if all(part is not None for part in q):
            w, x, y, z = (np.asarray(part) * np.sqrt(0.5) for part in q)
            columns |= {"q_w": w + z, "q_x": x + y, "q_y": x - y, "q_z": w - z}
        streams[name] = Stream(columns)
    meta = flight.meta
    # Both the body's and the sensor's axes turn over, so the quaternion between them does too.
    meta.mounting = {k: (w, x, -y, -z) for k, (w, x, y, z) in meta.mounting.items()}
    return FlightLog(streams, meta, flight.notes, flight.discarded)
