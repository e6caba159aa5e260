"""Series for display: broken at gaps, thinned with their extremes kept, and packed to fit a page. It computes no results."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Pool", "breaks", "display", "pack", "thin", "to_json"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Rows of a series that are worth keeping at most, and at least; and about how many a figure shows that cannot be refined.
MOST, LEAST, POINTS = 400_000, 200, 4000
#: Rows of a stretch by which the size of a long series is guessed, and how many rows, relative to bytes, a thinned series has.
STRETCH, GUESS = 4000, 0.42


def thin(columns: Sequence[FloatArray], points: int) -> NDArray[np.intp]:
    """Rows to show of columns of one length: the smallest and largest of every column in each of equal buckets.

    Parameters
    ----------
    columns
        One or more columns (n,). NaN is no extreme.
    points
        About how many rows to keep.

    Returns
    -------
    numpy.ndarray
        Increasing row numbers; all of them where there are no more than ``points``. The first and the last row, and each
        column's overall extremes, are among them.
    """
    n = len(columns[0])
    if n <= points:
        return np.arange(n)
    buckets = max(1, points // (2 * len(columns)))
    start = np.arange(buckets) * n // buckets
    width = int(np.max(np.diff(np.r_[start, n])))
    rows = np.minimum(start[:, None] + np.arange(width), np.r_[start[1:], n][:, None] - 1)
    keep = np.zeros(n, bool)
    keep[[0, -1]] = True
    for column in columns:
        values = column[rows]
        missing = np.isnan(values)
        gaps = bool(missing.any())
        for fill, pick in ((math.inf, np.argmin), (-math.inf, np.argmax)):
            at = pick(np.where(missing, fill, values) if gaps else values, axis=1)
            keep[rows[np.arange(buckets), at]] = True
    return np.flatnonzero(keep)


def _picked(columns: Sequence[FloatArray], points: int, even: bool) -> NDArray[np.intp]:
    """About so many rows: evenly, or by the extremes of the first column, and now and then by those of the others, which go with it."""
    n = len(columns[0])
    if n <= points:
        return np.arange(n)
    if even:
        return np.unique(np.r_[np.arange(0, n, math.ceil(n / max(points, 2))), n - 1])
    rows = thin(columns[:1], points)
    return rows if len(columns) == 1 else np.union1d(rows, thin(columns[1:], points // 8))


def breaks(t: FloatArray) -> NDArray[np.bool_]:
    """True where a line is interrupted before a row: an interval above five typical ones and a fifth of a second."""
    out = np.zeros(len(t), bool)
    if len(t) > 1:
        dt = np.diff(t)
        out[1:] = dt > max(5.0 * float(np.median(dt)), 0.2)
    return out


class _Prepared:
    """Finite rows of times and columns, angles unwrapped, with the number of the unbroken piece each row belongs to."""

    def __init__(
        self, t: FloatArray, columns: Sequence[FloatArray], period: float | None, even: bool = False, about: float = 0.0
    ) -> None:  # fmt: skip
        good = np.isfinite(columns[0]) & np.isfinite(t)
        self.t, self.columns, self.period, self.about = t[good], [c[good] for c in columns], period, about
        self.n, self.even = len(self.t), even
        self.piece = np.cumsum(breaks(self.t))
        if period is not None and self.n:
            self.columns[0] = np.unwrap(self.columns[0], period=period)
        self._keep(MOST)

    def _keep(self, points: int) -> None:
        rows = _picked(self.columns, points, self.even) if self.n else np.arange(0)
        if len(rows) < len(self.t):
            self.t, self.piece, self.columns = self.t[rows], self.piece[rows], [c[rows] for c in self.columns]

    def shown(self, points: int) -> tuple[list[FloatArray], int]:
        """Times and columns of about so many rows, a NaN row wherever the line is interrupted; and how many rows are samples."""
        if self.n == 0:
            return [self.t, *self.columns], 0
        rows = _picked(self.columns, points, self.even)
        t, piece, columns = self.t[rows], self.piece[rows], [c[rows] for c in self.columns]
        cut = np.diff(piece) != 0
        if self.period is not None:
            turn = np.floor((columns[0] - self.about) / self.period + 0.5)
            columns[0] = columns[0] - self.period * turn
            cut |= np.diff(turn) != 0
        where = np.flatnonzero(cut) + 1
        return [np.insert(t, where, t[where - 1]), *(np.insert(c, where, np.nan) for c in columns)], len(rows)


def display(t: FloatArray, columns: Sequence[FloatArray], points: int, period: float | None = None) -> list[FloatArray]:
    """Times and columns to draw as lines: finite rows, thinned, a NaN row wherever the line is interrupted.

    Parameters
    ----------
    t, columns
        Times (n,) and columns (n,). Rows without a finite first column are left out.
    points
        About how many rows to keep.
    period
        Of the first column where it is an angle: it is shown within half a period of zero, and broken where it jumps.

    Returns
    -------
    list
        Times, then the columns, of one length; times are always finite.
    """
    return _Prepared(t, columns, period).shown(points)[0]


@dataclass(frozen=True)
class _Coded:
    """An array as the page holds it: what it takes to decode it, and its bytes, deflated apart from all others."""

    meta: dict[str, Any]
    data: bytes


def _code(values: FloatArray, resolution: float) -> _Coded:
    """Round, take the differences that need the fewest bits, and deflate them, lowest bytes first.

    Numbers are rounded to ``resolution``, or finer where they vary little. ``meta`` has the scale ``s`` (value = integer / s),
    the number of values ``n``, how often differences were taken ``o`` and bytes a value ``w``. The bytes are all lowest bytes,
    then all second bytes, and so on, of 2 v for v >= 0 and -2 v - 1 for v < 0; where ``x`` is set, one byte for each value comes
    before them, 1 where it is not finite and has no others.
    """
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    usable = values[finite]
    scale = 1.0
    if len(usable):
        low, high = np.percentile(usable, [5.0, 95.0])
        spread = float(high - low) or float(np.max(np.abs(usable)))
        wanted = max(min(resolution, spread / 2000.0), 1e-300) if spread > 0.0 else resolution
        largest = max(float(np.max(np.abs(usable))), 1e-300)
        scale = 10.0 ** min(math.ceil(-math.log10(wanted)), 15 - math.ceil(math.log10(largest)), 300)
    steps = np.rint(usable * scale).astype(np.int64)
    order, bits = 0, math.inf
    for k in range(3):
        needed = float(np.log2(1.0 + np.abs(steps)).sum())
        if needed < bits:
            order, bits, best = k, needed, steps
        steps = np.diff(steps, prepend=0)
    if len(usable) == 0:
        best = steps
    folded = np.where(best < 0, -2 * best - 1, 2 * best).astype("<u8")
    width = max(1, (int(folded.max(initial=0)).bit_length() + 7) // 8)
    missing = b"" if finite.all() else (~finite).astype(np.uint8).tobytes()
    planes = np.ascontiguousarray(folded.view(np.uint8).reshape(-1, 8)[:, :width].T).tobytes()
    squeeze = zlib.compressobj(6, zlib.DEFLATED, -15)
    data = squeeze.compress(missing + planes) + squeeze.flush(zlib.Z_FULL_FLUSH)
    return _Coded({"s": scale, "n": len(values), "o": order, "w": width} | ({"x": 1} if missing else {}), data)


class _Series:
    """Columns that are thinned together, and where they stand in the pool."""

    def __init__(self, prepared: _Prepared, first: int, resolutions: Sequence[float], weight: float) -> None:
        self.prepared, self.first, self.resolutions, self.weight = prepared, first, resolutions, weight
        self.whole = len(prepared.t)

    def estimate(self) -> float:
        """About how many bytes all rows would take: those of a few stretches, where there are many."""
        if self.whole <= 4 * STRETCH:
            return float(sum(len(a.data) for a in self.coded(self.whole)))
        total = 0
        starts = np.linspace(0, self.whole - STRETCH, 4).astype(int)
        for first in starts:
            rows = slice(first, first + STRETCH)
            total += sum(len(_code(c[rows], r).data) for c, r in zip(self.prepared.columns, self.resolutions[1:], strict=True))
        return total * self.whole / (len(starts) * STRETCH)

    def coded(self, points: int) -> list[_Coded]:
        columns, kept = self.prepared.shown(points)
        out = [_code(c, r) for c, r in zip(columns, self.resolutions, strict=True)]
        out[0].meta.update({"of": self.prepared.n, "kept": kept})
        return out


class Pool:
    """The numbers of a page, each array once; figures refer to them by index.

    Parameters
    ----------
    points
        About how many rows a figure shows that cannot be refined by zooming in.
    """

    def __init__(self, points: int = POINTS) -> None:
        self.points = points
        self._arrays: list[_Coded | None] = []
        self._series: list[_Series] = []
        self._known: dict[tuple[Any, ...], list[int]] = {}

    def __len__(self) -> int:
        """How many arrays there are."""
        return len(self._arrays)

    def add(self, values: FloatArray, resolution: float = 1e-3) -> int:
        """Keep an array as it is, rounded to ``resolution`` or finer, and return its index."""
        self._arrays.append(_code(values, resolution))
        return len(self._arrays) - 1

    def series(
        self,
        t: FloatArray,
        columns: Sequence[FloatArray],
        resolutions: Sequence[float],
        period: float | None = None,
        *,
        even: bool = False,
        weight: float = 1.0,
        about: float = 0.0,
    ) -> list[int]:
        """Keep columns over time, as many rows of them as the page has room for in the end.

        Parameters
        ----------
        t, columns, period
            As of `display`.
        resolutions
            Of each column; times are kept to 0.1 ms.
        even
            Thin it evenly, as suits a track, rather than by its extremes.
        weight
            How much room it gets relative to others, where there is not room for all.
        about
            Middle of the interval of one period in which the first column is shown.

        Returns
        -------
        list
            Indices of the times and of each column; nothing where no row is finite.
        """
        key = (tuple(hash(np.ascontiguousarray(a, np.float64).tobytes()) for a in (t, *columns)), tuple(resolutions), period, even, about)
        if key in self._known:
            return self._known[key]
        prepared = _Prepared(t, columns, period, even, about)
        if prepared.n == 0:
            return []
        series = _Series(prepared, len(self._arrays), (1e-4, *resolutions), weight)
        self._series.append(series)
        self._arrays += [None] * (1 + len(columns))
        self._known[key] = list(range(series.first, len(self._arrays)))
        return self._known[key]

    def packed(self, budget: float = math.inf) -> tuple[list[dict[str, Any]], bytes]:
        """How to decode each array, and all of them as one raw deflate stream of about ``budget`` bytes at most.

        Every series gets as many bytes as its weight says; what one does not need, the others share. The rows that do not fit are left
        out by `thin`, and ``of`` and ``kept`` of the times say how many there were and are.
        """
        fixed = sum(len(a.data) for a in self._arrays if a is not None)
        room = 0.96 * max(budget - fixed, 0.0)
        wanted = {id(s): s.estimate() for s in self._series}
        weight = {id(s): s.weight for s in self._series}
        share = _share([(size, weight[k]) for k, size in wanted.items()], room)
        dear = {k for k, size in wanted.items() if size > share * weight[k]}
        # Fewer rows differ more from each other and take more bytes each: the first guess allows for it, the next ones know.
        points = {id(s): max(s.whole * (GUESS * share * s.weight / wanted[id(s)] if id(s) in dear else 1.0), LEAST) for s in self._series}
        coded = {id(s): s.coded(round(points[id(s)])) for s in self._series}
        for attempt in range(8):
            sizes = self._sizes(coded)
            total = fixed + sum(sizes.values())
            if total <= budget and (attempt > 2 or not dear or total > 0.87 * budget):
                break
            share = _share([(math.inf if k in dear else n, weight[k]) for k, n in sizes.items()], room)
            for s in self._series:
                k = id(s)
                if k not in dear and sizes[k] <= share * s.weight:
                    continue
                factor = share * s.weight / max(sizes[k], 1) * (GUESS if k not in dear else 1.0 if attempt < 4 else 0.9)
                dear.add(k)
                before, points[k] = points[k], min(max(points[k] * factor, LEAST), s.whole)
                if abs(points[k] / before - 1.0) > 0.02:
                    coded[k] = s.coded(round(points[k]))
        arrays = [*self._arrays]
        for s in self._series:
            arrays[s.first : s.first + len(coded[id(s)])] = coded[id(s)]
        return _joined([a for a in arrays if a is not None])

    def _sizes(self, coded: dict[int, list[_Coded]]) -> dict[int, int]:
        """Bytes of each series; what another has already is free."""
        known: set[bytes] = set()
        out = {}
        for s in self._series:
            fresh = {a.data for a in coded[id(s)]} - known
            known |= fresh
            out[id(s)] = sum(len(data) for data in fresh)
        return out


def _share(wanted: Sequence[tuple[float, float]], budget: float) -> float:
    """The largest size a unit of weight that leaves all together within the budget, from the size and the weight of each."""
    left, weights = budget, sum(weight for _, weight in wanted)
    for size, weight in sorted(wanted, key=lambda item: item[0] / item[1]):
        share = left / weights
        if size > share * weight:
            return share
        left, weights = left - size, weights - weight
    return math.inf


def _joined(arrays: list[_Coded]) -> tuple[list[dict[str, Any]], bytes]:
    """Arrays one after the other; one that is there already is only pointed to."""
    seen: dict[tuple[bytes, str], int] = {}
    metas: list[dict[str, Any]] = []
    parts = []
    for a in arrays:
        key = (a.data, to_json({k: a.meta[k] for k in ("s", "n", "o", "w", "x") if k in a.meta}))
        if key in seen:
            metas.append({"same": seen[key]} | {k: a.meta[k] for k in ("of", "kept") if k in a.meta})
        else:
            seen[key] = len(metas)
            metas.append(a.meta)
            parts.append(a.data)
    end = zlib.compressobj(6, zlib.DEFLATED, -15).flush()
    return metas, b"".join(parts) + end


def pack(text: str, level: int = 6) -> str:
    """Text deflated (zlib format) and in base64, as the page inflates it."""
    return base64.b64encode(zlib.compress(text.encode("utf-8"), level)).decode("ascii")


def to_json(value: Any) -> str:
    """Compact JSON without NaN."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
