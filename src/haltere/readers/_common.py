"""What the readers of foreign logs share: one integer clock, stream assembly, row merging and unit constants. It reads no file."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haltere.errors import HaltereError
from haltere.flight.log import FlightLog, FlightMeta, Home, Stream
from haltere.flight.schema import NAVIGATION_STREAMS, STREAMS, base_name, schema_of

__all__ = ["DEG", "GAUSS", "RPM", "Builder", "Columns", "FloatArray", "IntArray", "metres_per_degree", "number", "q_from_euler", "unusable"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Columns = dict[str, FloatArray]

#: Degrees to radians.
DEG = np.pi / 180.0
#: Gauss to microtesla.
GAUSS = 100.0
#: Revolutions a minute to rad/s.
RPM = 2.0 * np.pi / 60.0
#: Stamps below this many microseconds of UTC (2001) are time since boot, not a date.
UTC_FLOOR_US = 1_000_000_000_000_000


def unusable(path: Path, expected: str, found: str, remedy: str = "") -> HaltereError:
    """The error of a log that cannot be read."""
    return HaltereError(expected, found, str(path), remedy or "check that the file was copied whole from the vehicle")


def number(values: ArrayLike) -> FloatArray:
    """Float64 copy of a column of numbers."""
    return np.array(values, dtype=np.float64)


def q_from_euler(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> Columns:
    """Quaternion columns q_nb (body FRD to NED, Hamilton, scalar first) of roll, pitch, yaw [rad], turned in the order yaw, pitch, roll."""
    cr, sr = np.cos(0.5 * roll), np.sin(0.5 * roll)
    cp, sp = np.cos(0.5 * pitch), np.sin(0.5 * pitch)
    cy, sy = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    return {
        "q_w": cr * cp * cy + sr * sp * sy,
        "q_x": sr * cp * cy - cr * sp * sy,
        "q_y": cr * sp * cy + sr * cp * sy,
        "q_z": cr * cp * sy - sr * sp * cy,
    }


def metres_per_degree(lat: float, alt: float) -> tuple[float, float]:
    """Metres north and east of one degree of latitude and of longitude (WGS-84 radii of curvature)."""
    a, e2 = 6378137.0, 6.69437999014e-3
    s = np.sin(lat * DEG)
    w2 = 1.0 - e2 * s * s
    meridian, normal = a * (1.0 - e2) / w2**1.5, a / np.sqrt(w2)
    return float((meridian + alt) * DEG), float((normal + alt) * np.cos(lat * DEG) * DEG)


def _row_keys(us: IntArray, width: int) -> tuple[NDArray[np.intp], IntArray]:
    """Order by time, and a key a row that tells rows of one stamp apart by their place."""
    order = np.argsort(us, kind="stable")
    sorted_us = us[order]
    place = np.arange(len(us)) - np.searchsorted(sorted_us, sorted_us)
    return order, sorted_us * width + place


def merge_rows(pieces: Iterable[tuple[IntArray, Columns]]) -> tuple[IntArray, Columns]:
    """Rows of several sources on the union of their stamps; a column is NaN where its source has no sample.

    Parameters
    ----------
    pieces
        Stamps [us] and columns of each source. Where two sources give one column at one stamp, the later source stands.

    Returns
    -------
    us, columns
        Stamps in ascending order and the columns side by side.
    """
    pieces = [(us, columns) for us, columns in pieces if len(us) and columns]
    if not pieces:
        return np.empty(0, np.int64), {}
    base = min(int(us.min()) for us, _ in pieces)
    width = 1 + max(int(np.unique(us, return_counts=True)[1].max()) for us, _ in pieces)
    keyed = [(*_row_keys(us - base, width), columns) for us, columns in pieces]
    keys = np.unique(np.concatenate([key for _, key, _ in keyed]))
    out: Columns = {}
    for order, key, columns in keyed:
        rows = np.searchsorted(keys, key)
        for name, values in columns.items():
            out.setdefault(name, np.full(len(keys), np.nan))[rows] = values[order]
    return keys // width + base, out


class Builder:
    """Collects a foreign log's streams on its own integer clock and turns them into a flight.

    Parameters
    ----------
    path
        The log; it names the flight.
    kind
        Format, for ``meta.source``.
    """

    def __init__(self, path: Path, kind: str) -> None:
        self.path = path
        self.meta = FlightMeta(name=path.stem, source=f"{kind}: {path.name}")
        self.notes: list[str] = []
        self.discarded: dict[str, dict[str, int]] = {}
        self.utc: tuple[int, int] | None = None
        self._streams: dict[str, tuple[IntArray, dict[str, NDArray[Any]]]] = {}

    def note(self, text: str) -> None:
        """Say something once."""
        if text not in self.notes:
            self.notes.append(text)

    def discard(self, stream: str, reason: str, n: int) -> None:
        """Count samples left out of a stream."""
        if n:
            reasons = self.discarded.setdefault(stream, {})
            reasons[reason] = reasons.get(reason, 0) + int(n)

    def add(self, stream: str, us: IntArray, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add a stream with stamps [us]. Columns without a single value are left away, unless the stream is nothing without them."""
        schema = schema_of(stream)
        required = schema.required if schema else ()
        kept = {k: v for k, v in columns.items() if k in required or v.dtype.kind != "f" or not np.isnan(v).all()}
        # A zero stamp in a log whose other stamps are not near zero was never set by its sender.
        unset = (us == 0) & bool(len(us) > 1 and np.median(us) > 60_000_000)
        if unset.any():
            self.discard(stream, "time stamp never set", int(unset.sum()))
            us, kept = us[~unset], {k: v[~unset] for k, v in kept.items()}
        if len(us) and kept:
            self._streams[stream] = (us.astype(np.int64), kept)

    def has(self, stream: str) -> bool:
        """Whether a stream was added."""
        return stream in self._streams

    def span(self, stream: str) -> tuple[int, int] | None:
        """First and last stamp [us] of a stream."""
        found = self._streams.get(stream)
        return (int(found[0].min()), int(found[0].max())) if found else None

    def set_home(self, lat: float, lon: float, alt: float) -> None:
        """Name the origin of positions; what cannot be a place is left out and told."""
        if np.isfinite([lat, lon, alt]).all() and abs(lat) <= 90.0 and abs(lon) <= 360.0:
            self.meta.home = Home(float(lat), float(lon), float(alt))
        else:
            self.note(f"home position left out: latitude {lat:.6g}, longitude {lon:.6g} deg, altitude {alt:.6g} m is no place")

    def build(self) -> FlightLog:
        """The flight, with t = 0 at the earliest sample of the navigation streams.

        Raises
        ------
        HaltereError
            The log has none of the streams that haltere reads.
        """
        starts = [int(us.min()) for name, (us, _) in self._streams.items() if base_name(name) in NAVIGATION_STREAMS]
        if not starts:
            starts = [int(us.min()) for us, _ in self._streams.values()]
        if not starts:
            raise unusable(
                self.path,
                "a log with at least one sensor stream",
                "; ".join(self.notes[:3]) or "none",
                "check that the vehicle was logging sensors; `haltere info` on a good log lists what is read",
            )
        start = min(starts)
        for name, (us, _) in self._streams.items():
            back = int(np.count_nonzero(np.diff(us) < -1_000_000))
            if back and name == "imu":
                self.note(f"imu: the clock jumps back {back} times: the file may hold several starts of the autopilot; cut it at each")
        self.meta.time_offset = start / 1e6
        if self.utc is not None:
            self.meta.start_utc = iso_utc(start - self.utc[0] + self.utc[1])
        known = list(STREAMS)

        def rank(name: str) -> tuple[int, int, str]:
            base = base_name(name)
            return known.index(base) if base in known else len(known), int(name[len(base) + 1 :] or 0) if base != name else 0, name

        streams = {}
        for name in sorted(self._streams, key=rank):
            us, columns = self._streams[name]
            streams[name] = Stream({"t": (us - start) / 1e6, **columns})
        return FlightLog(streams, self.meta, self.notes, self.discarded)


def iso_utc(us: int) -> str | None:
    """ISO 8601 text of UTC microseconds since 1970, or None for a time that no clock shows."""
    try:
        stamp = dt.datetime(1970, 1, 1, tzinfo=dt.UTC) + dt.timedelta(microseconds=us)
    except OverflowError:
        return None
    return stamp.isoformat(timespec="milliseconds").replace("+00:00", "Z")
