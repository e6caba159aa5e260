"""Whether a receiver's positions move as its velocities say, or would in other units or with columns exchanged. It drops nothing.

Both come from one receiver, so that over a few seconds the way between two fixes is the integral of the velocity. How alike the two are is
``2 Σ d·v / Σ (d² + v²)``, which is 1 where they are equal, 0 where they have nothing in common or differ a hundredfold, and -1 where one
is the other turned round. Where the vehicle hardly moves nothing can be told, and nothing is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import Stream
from haltere.flight.units import factor

__all__ = ["Moving", "compare", "descends"]

FloatArray = NDArray[np.float64]

#: Windows [s], the way [m] that makes one count, and how many of them and how much way in all are enough.
WINDOW, LEAST_WAY, WINDOWS, WAY = 2.0, 3.0, 6, 40.0
#: Likeness of what is given, below which it is in doubt, and of another reading, above which it is found.
DOUBT, FOUND = 0.4, 0.85
#: Metres a degree of latitude, near enough.
DEGREE = 111.2e3


@dataclass(frozen=True)
class Moving:
    """Likeness of positions and velocities as given, and of the best other reading.

    The readings are ``lat and lon`` or ``vel_n and vel_e`` (exchanged), and the units ``rad`` of the place and ``cm/s, mm/s, km/h`` of the
    velocity.
    """

    given: float
    best: float
    reading: str

    @property
    def disagrees(self) -> bool:
        """The columns as given contradict one another, and in another reading they agree."""
        return self.given < DOUBT and self.best > FOUND


def compare(gnss: Stream) -> Moving | None:
    """Compare horizontal positions with horizontal velocities.

    Parameters
    ----------
    gnss
        Fixes with rising times: ``lat, lon`` [deg] and ``vel_n, vel_e`` [m/s], or what is taken for them.

    Returns
    -------
    Moving or None
        None where the vehicle moved too little, or one of the columns is missing.
    """
    lat, lon = gnss.get("lat"), gnss.get("lon")
    v = gnss.vector("vel", "ne")
    good = np.isfinite(lat + lon + v.sum(axis=1))
    t, lat, lon, v = gnss.t[good], lat[good], lon[good], v[good]
    i, j = _windows(t)
    if len(i) < WINDOWS:
        return None
    way = _integral(t, v, i, j)
    dlat, dlon = lat[j] - lat[i], lon[j] - lon[i]
    degrees = DEGREE * np.column_stack([dlat, np.cos(np.radians(lat[i])) * dlon])
    swapped = DEGREE * np.column_stack([dlon, np.cos(np.radians(lon[i])) * dlat])
    radians = np.degrees(DEGREE) * np.column_stack([dlat, np.cos(lat[i]) * dlon])
    readings = {"lat and lon": (swapped, way), "vel_n and vel_e": (degrees, way[:, ::-1])}
    readings |= {unit: (degrees, factor("m/s", unit) * way) for unit in ("cm/s", "mm/s", "km/h")}
    if np.abs(lat).max() <= 0.5 * np.pi and np.abs(lon).max() <= 2.0 * np.pi:
        readings["rad"] = (radians, way)
    alike = {name: score for name, (d, w) in readings.items() if np.isfinite(score := _alike(d, w))}
    given = _alike(degrees, way)
    if not (alike and np.isfinite(given)):
        return None
    best = max(alike, key=lambda name: alike[name])
    return Moving(given, alike[best], best)


def descends(gnss: Stream) -> float:
    """Likeness of the fall of altitude and ``vel_d``: near -1 where vel_d is in truth up; NaN where the height changed too little."""
    alt, v = gnss.get("alt"), gnss.get("vel_d")
    good = np.isfinite(alt + v)
    t, alt, v = gnss.t[good], alt[good], v[good]
    i, j = _windows(t)
    if len(i) < WINDOWS:
        return float("nan")
    return _alike((alt[i] - alt[j])[:, None], _integral(t, v[:, None], i, j))


def _windows(t: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last fix of windows without a hole."""
    if len(t) < 3 or t[-1] - t[0] > 1e6:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    edges = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], WINDOW)))
    i, j = edges[:-1], edges[1:]
    use = (t[j] - t[i] > 0.5 * WINDOW) & (t[j] - t[i] < 2.0 * WINDOW)
    return i[use], j[use]


def _integral(t: FloatArray, v: FloatArray, i: NDArray[np.intp], j: NDArray[np.intp]) -> FloatArray:
    way = np.vstack([np.zeros(v.shape[1]), np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t)[:, None], axis=0)])
    return np.asarray(way[j] - way[i])


def _alike(d: FloatArray, v: FloatArray) -> float:
    """Likeness over the windows in which either moved; NaN where they are too few, or the way is too short."""
    size = np.maximum(np.linalg.norm(d, axis=1), np.linalg.norm(v, axis=1))
    moved = size > LEAST_WAY
    if np.count_nonzero(moved) < WINDOWS or float(size[moved].sum()) < WAY:
        return float("nan")
    d, v = d[moved], v[moved]
    return float(2.0 * np.sum(d * v) / np.sum(d * d + v * v))
