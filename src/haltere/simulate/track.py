"""Tracks of real flights out of their logs, to be flown again. It smooths and flies nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.flight.local import local_from_geodetic
from haltere.flight.log import FlightLog, Stream

__all__ = ["track_of"]

FloatArray = NDArray[np.float64]

#: Smoothing (see `haltere.simulate.missions.track_reference`) of what is smooth already, and of GNSS positions.
SMOOTHING, SMOOTHING_GNSS = 0.05, 1.0
#: Below this speed [m/s] the course of a GNSS track says nothing of the yaw.
SLOW = 1.0


def track_of(source: str | Path | FlightLog) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Times (n,) [s], positions NED (n, 3) [m], yaw (n,) [rad] and smoothing of a flight: of its truth, else onboard, else GNSS.

    The yaw of a GNSS track is its course, held where it is slow.

    Raises
    ------
    HaltereError
        The log cannot be read, or has no positions.
    """
    if isinstance(source, FlightLog):
        flight = source
    else:
        from haltere.readers import read

        flight = read(source)
    for name in ("truth", "onboard", "gnss"):
        stream = flight.get(name)
        pos = None if stream is None else _positions(stream)
        if stream is None or pos is None:
            continue
        yaw = _course(stream, pos) if name == "gnss" else _yaw(stream, pos)
        good = np.isfinite(pos).all(axis=1) & np.isfinite(yaw) & np.isfinite(stream.t)
        order = np.flatnonzero(good)[np.argsort(stream.t[good], kind="stable")]
        if len(order) > 1:
            return stream.t[order], pos[order], yaw[order], SMOOTHING_GNSS if name == "gnss" else SMOOTHING
    raise HaltereError("positions in truth, onboard or gnss", f"streams {', '.join(flight)}", f"track {flight.meta.name}")


def _positions(stream: Stream) -> FloatArray | None:
    """Positions NED (n, 3) [m], of the columns themselves or of latitude, longitude and altitude."""
    pos = stream.vector("pos", "ned")
    if len(pos) and np.isfinite(pos).all(axis=1).any():
        return pos
    place = np.column_stack([stream.get(c) for c in ("lat", "lon", "alt")])
    good = np.flatnonzero(np.isfinite(place).all(axis=1))
    if not len(good):
        return None
    lat0, lon0, alt0 = place[good[0]]
    return np.column_stack(local_from_geodetic(place[:, 0], place[:, 1], place[:, 2], lat0, lon0, alt0))


def _yaw(stream: Stream, pos: FloatArray) -> FloatArray:
    w, x, y, z = (stream.get(f"q_{a}") for a in "wxyz")
    yaw = np.arctan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z)
    return yaw if np.isfinite(yaw).any() else _course(stream, pos)


def _course(stream: Stream, pos: FloatArray) -> FloatArray:
    """Direction of motion, held where slow, from the velocity or else from the positions."""
    vel = stream.vector("vel", "ned")[:, :2]
    if not np.isfinite(vel).all(axis=1).any():
        step = np.maximum(np.gradient(stream.t), 1e-9)
        vel = np.column_stack([np.gradient(pos[:, k]) / step for k in range(2)])
    course = np.arctan2(vel[:, 1], vel[:, 0])
    known = np.flatnonzero(np.hypot(vel[:, 0], vel[:, 1]) > SLOW)  # NaN is not faster
    if not len(known):
        return np.zeros(len(course))
    last = np.maximum(np.searchsorted(known, np.arange(len(course)), side="right") - 1, 0)
    return np.asarray(course[known[last]])
