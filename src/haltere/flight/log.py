"""FlightLog: a recorded flight in memory, as a set of streams with their own time bases. It neither checks nor resamples."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError

if TYPE_CHECKING:
    import polars as pl

__all__ = ["FlightLog", "FlightMeta", "Home", "Stream"]

FloatArray = NDArray[np.float64]


def _column(name: str, values: Any) -> NDArray[Any]:
    """One column as float64, missing values NaN, or as text."""
    where = f"column {name!r}"
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan) if values.dtype.kind in "fiub" else np.ma.filled(values, "")
    try:
        array = np.asarray(values)
    except ValueError:
        raise HaltereError("one-dimensional columns", "rows of several lengths", where) from None
    if array.ndim != 1:
        raise HaltereError("one-dimensional columns", f"shape {array.shape}", where)
    if array.dtype.kind in "fiub":
        array = np.ascontiguousarray(array, dtype=np.float64)
        array = array if array.flags.writeable else array.copy()  # kernels are compiled for arrays that may be written
    elif array.dtype.kind == "O":
        if any(isinstance(v, str) for v in array):
            return np.array(["" if v is None else str(v) for v in array], dtype=np.str_)
        try:
            array = np.array(
                [np.nan if v is None or type(v).__name__ in ("NAType", "NaTType") else float(v) for v in array], dtype=np.float64
            )
        except (TypeError, ValueError):
            raise HaltereError("numbers or text", "other objects", where) from None
    elif array.dtype.kind == "M":
        raise HaltereError("numbers or text", f"dates ({array.dtype})", where, "times are seconds as numbers")
    elif array.dtype.kind != "U":
        raise HaltereError("numbers or text", f"type {array.dtype}", where)
    return array


class Stream:
    """Columns of one length over one time base.

    Parameters
    ----------
    columns
        Arrays or sequences of one length; ``t`` [s] is required. Numbers become float64, text stays text.

    Raises
    ------
    HaltereError
        ``t`` is missing, a column is not one-dimensional or neither numbers nor text, or the lengths differ.
    """

    __slots__ = ("columns",)

    def __init__(self, columns: Mapping[str, Any]) -> None:
        if not isinstance(columns, Mapping) and not (hasattr(columns, "items") and hasattr(columns, "keys")):
            raise HaltereError("columns by name, such as {'t': [...], 'gyro_x': [...]}", f"a {type(columns).__name__}")
        out: dict[str, NDArray[Any]] = {}
        for name, values in columns.items():
            if not isinstance(name, str):
                raise HaltereError("names of columns as text", repr(name))
            out[name] = _column(name, values)
        if "t" not in out or out["t"].dtype.kind != "f":
            raise HaltereError("a time column t in seconds", f"columns {', '.join(out) or 'none'}")
        lengths = {name: len(a) for name, a in out.items()}
        if len(set(lengths.values())) > 1:
            raise HaltereError("columns of one length", ", ".join(f"{k}: {n}" for k, n in lengths.items()))
        self.columns = {"t": out.pop("t"), **out}

    @property
    def t(self) -> FloatArray:
        """Time stamps [s]."""
        return self.columns["t"]

    @property
    def names(self) -> tuple[str, ...]:
        """Column names, ``t`` first."""
        return tuple(self.columns)

    @property
    def rate(self) -> float:
        """Typical sample rate [Hz] from the median interval; NaN below two samples or without a positive median."""
        if len(self) < 2:
            return float("nan")
        dt = float(np.median(np.diff(self.t)))
        return 1.0 / dt if dt > 0.0 else float("nan")

    def get(self, name: str) -> FloatArray:
        """Column ``name``, or NaN of the stream's length where the source does not have it."""
        return self.columns[name] if name in self.columns else np.full(len(self), np.nan)

    def vector(self, stem: str, axes: str = "xyz") -> FloatArray:
        """Columns ``stem_x, stem_y, stem_z`` (or other ``axes``) side by side, shape (n, len(axes))."""
        return np.column_stack([self.get(f"{stem}_{a}") for a in axes]) if len(self) else np.empty((0, len(axes)))

    def where(self, keep: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Stream:
        """Rows picked by a mask, indices or a slice, as a new stream."""
        return Stream({name: a[keep] for name, a in self.columns.items()})

    def to_polars(self) -> pl.DataFrame:
        """The columns as a polars table."""
        import polars as pl

        return pl.DataFrame(dict(self.columns))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __len__(self) -> int:
        return len(self.columns["t"])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Stream) or self.names != other.names:
            return NotImplemented if not isinstance(other, Stream) else False
        return all(
            a.dtype.kind == b.dtype.kind and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
            for a, b in zip(self.columns.values(), other.columns.values(), strict=True)
        )

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"Stream({len(self)} x {', '.join(self.names)})"


@dataclass(frozen=True)
class Home:
    """The origin a flight names itself: geodetic degrees, metres above mean sea level."""

    lat: float
    lon: float
    alt: float


@dataclass
class FlightMeta:
    """What a log says of itself besides its samples; the keys of ``flight.toml``.

    Attributes
    ----------
    name, source
        A short name and where it came from (format, file).
    start_utc
        ISO 8601 time of t = 0 in UTC, where known.
    time_offset
        Log clock = t + time_offset [s].
    home
        Origin of positions, where the flight names one.
    vehicle_file
        Path of its vehicle file.
    delays
        Seconds a stream: a sample stamped t was valid at t - delay.
    mounting
        Quaternion q_b_sensor a stream.
    noise, field
        Overrides of the configuration keys ``noise.*`` and ``field.*``.
    imu_kind
        ``instant``: a sample is the value at its time; ``mean``: the mean since the sample before.
    faults
        What was injected. No estimator reads it.
    compass
        What a magnetometer stream is to its autopilot, for parameters to paste: ``autopilot`` (PX4, ArduPilot), ``slot`` (number of its
        parameters), ``rotation`` (q_b_sensor of the parameters' axes), ``device``.
    """

    name: str = ""
    source: str = ""
    start_utc: str | None = None
    time_offset: float = 0.0
    home: Home | None = None
    vehicle_file: str | None = None
    delays: dict[str, float] = dataclass_field(default_factory=dict)
    mounting: dict[str, tuple[float, float, float, float]] = dataclass_field(default_factory=dict)
    noise: dict[str, float] = dataclass_field(default_factory=dict)
    field: dict[str, float] = dataclass_field(default_factory=dict)
    imu_kind: str = "instant"
    faults: list[dict[str, Any]] = dataclass_field(default_factory=list)
    compass: dict[str, dict[str, Any]] = dataclass_field(default_factory=dict)


class FlightLog:
    """A flight: streams by name, what the log says of itself, and what its reader had to leave out.

    Parameters
    ----------
    streams
        Stream by name (``imu``, ``imu.1``, ``magnetometer``, ``gnss``, ...); mappings of columns are made into streams.
    meta
        See `FlightMeta`.
    notes
        What the reader found worth saying, one sentence each.
    discarded
        ``{stream: {reason: number of samples}}`` that the reader left out.
    """

    def __init__(
        self,
        streams: Mapping[str, Stream | Mapping[str, Any]],
        meta: FlightMeta | None = None,
        notes: Iterable[str] = (),
        discarded: Mapping[str, Mapping[str, int]] | None = None,
    ) -> None:
        self.streams: dict[str, Stream] = {}
        for name, stream in streams.items():
            try:
                self.streams[name] = stream if isinstance(stream, Stream) else Stream(stream)
            except HaltereError as error:
                raise HaltereError(error.expected, error.found, f"stream {name!r} {error.where}".strip(), error.remedy) from None
        self.meta = meta if meta is not None else FlightMeta()
        self.notes = list(notes)
        self.discarded: dict[str, dict[str, int]] = {k: dict(v) for k, v in (discarded or {}).items()}

    def __getitem__(self, name: str) -> Stream:
        return self.streams[name]

    def __contains__(self, name: object) -> bool:
        return name in self.streams

    def __iter__(self) -> Iterator[str]:
        return iter(self.streams)

    def get(self, name: str) -> Stream | None:
        """Stream ``name``, or None where the flight has none."""
        return self.streams.get(name)

    def without(self, *names: str) -> FlightLog:
        """The same flight without some streams."""
        return FlightLog({k: s for k, s in self.streams.items() if k not in names}, self.meta, self.notes, self.discarded)

    def note_discarded(self, stream: str, reason: str, n: int) -> None:
        """Count samples of a stream that were left out."""
        if n:
            reasons = self.discarded.setdefault(stream, {})
            reasons[reason] = reasons.get(reason, 0) + int(n)

    def __repr__(self) -> str:
        rows = ", ".join(f"{k} {len(s)}" for k, s in self.streams.items())
        return f"FlightLog({self.meta.name!r}: {rows})"
