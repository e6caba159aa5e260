"""Series for display: thinned with their extremes kept, broken at gaps, and packed for a page. It computes no results."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Pool", "breaks", "display", "pack", "thin", "to_json"]

FloatArray = NDArray[np.float64]


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
    picked = [np.array([0, n - 1])]
    for column in columns:
        values = column[rows]
        missing = np.isnan(values)
        for fill, pick in ((math.inf, np.argmin), (-math.inf, np.argmax)):
            at = pick(np.where(missing, fill, values), axis=1)
            picked.append(rows[np.arange(buckets), at])
    return np.unique(np.concatenate(picked))


def breaks(t: FloatArray) -> NDArray[np.bool_]:
    """True where a line is interrupted before a row: an interval above five typical ones and a fifth of a second."""
    out = np.zeros(len(t), bool)
    if len(t) > 1:
        dt = np.diff(t)
        out[1:] = dt > max(5.0 * float(np.median(dt)), 0.2)
    return out


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
    good = np.isfinite(columns[0]) & np.isfinite(t)
    t, columns = t[good], [c[good] for c in columns]
    if len(t) == 0:
        return [t, *columns]
    piece = np.cumsum(breaks(t))
    if period is not None:
        columns[0] = np.unwrap(columns[0], period=period)
    rows = thin(columns, points)
    t, piece, columns = t[rows], piece[rows], [c[rows] for c in columns]
    cut = np.diff(piece) != 0
    if period is not None:
        turn = np.floor(columns[0] / period + 0.5)
        columns[0] = columns[0] - period * turn
        cut |= np.diff(turn) != 0
    where = np.flatnonzero(cut) + 1
    return [np.insert(t, where, t[where - 1]), *(np.insert(c, where, np.nan) for c in columns)]


class Pool:
    """The numbers of a page, each array once; figures refer to them by index.

    Parameters
    ----------
    points
        About how many rows of a series to show.
    """

    def __init__(self, points: int) -> None:
        self.points = points
        self.arrays: list[dict[str, Any]] = []

    def add(self, values: FloatArray, resolution: float = 1e-3) -> int:
        """Keep an array and return its index.

        Numbers are rounded to ``resolution``, or finer where they vary little, and stored as differences of integers, which
        deflate well: ``{"s": scale, "d": [first, difference, ...]}`` with value = running sum / scale, null where not finite.
        """
        values = np.asarray(values, dtype=np.float64)
        finite = np.isfinite(values)
        usable = values[finite]
        scale = 1.0
        if len(usable):
            low, high = np.percentile(usable, [5.0, 95.0])
            spread = float(high - low) or float(np.max(np.abs(usable)))
            wanted = min(resolution, spread / 2000.0) if spread > 0.0 else resolution
            largest = max(float(np.max(np.abs(usable))), 1e-300)
            scale = 10.0 ** min(math.ceil(-math.log10(wanted)), 15 - math.ceil(math.log10(largest)), 300)
        steps = np.diff(np.rint(usable * scale).astype(np.int64), prepend=0).tolist()
        if finite.all():
            coded: list[int | None] = steps
        else:
            coded = [None] * len(values)
            for k, i in enumerate(np.flatnonzero(finite).tolist()):
                coded[i] = steps[k]
        self.arrays.append({"s": scale, "d": coded})
        return len(self.arrays) - 1


def pack(text: str, level: int = 6) -> str:
    """Text deflated (zlib format) and in base64, as the page inflates it."""
    return base64.b64encode(zlib.compress(text.encode("utf-8"), level)).decode("ascii")


def to_json(value: Any) -> str:
    """Compact JSON without NaN."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
