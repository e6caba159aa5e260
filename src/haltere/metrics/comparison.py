"""Several solutions of one flight on common terms: the same rows, the same reference, the same measures. It runs no estimator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import Stream
from haltere.metrics.attitude import conjugate, euler, heading_between, multiply, rotation_vector, slerp, tilt_between
from haltere.metrics.errors import between, reference_position

__all__ = [
    "ANGLES", "Comparison", "Series", "Track", "common_rows", "covered", "differences_from_gnss", "errors", "pair", "scores", "track_of",
]  # fmt: skip

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]
Series = dict[str, tuple[FloatArray, FloatArray]]

#: Angles of a score, in the order of tables.
ANGLES = ("attitude", "tilt", "roll", "pitch", "yaw")
#: A solution that would leave less than this part of the rows to all others is not scored with them.
PART = 0.5


@dataclass(eq=False)
class Track:
    """What one solution says of a flight.

    Attributes
    ----------
    name
        How it is called in tables.
    t, q
        Increasing times (n,) [s] and unit attitudes q_nb (n, 4).
    vel, pos
        Velocity and position NED (n, 3) from the comparison's origin, NaN where not known; None where it has none.
    heading
        Its heading is measured by something; if not, it begins anywhere and is not scored.
    smoother
        It uses samples from after each instant.
    """

    name: str
    t: FloatArray
    q: FloatArray
    vel: FloatArray | None = None
    pos: FloatArray | None = None
    heading: bool = True
    smoother: bool = False


@dataclass(eq=False)
class Comparison:
    """Solutions of one flight side by side.

    Attributes
    ----------
    tracks
        Those that ran, in the order of tables.
    reference
        What they are compared with, or None.
    against
        ``truth``, ``onboard`` or None.
    times
        Times of the rows that are scored (m,) [s].
    summary
        As in ``compare.json``.
    """

    tracks: list[Track]
    reference: Track | None
    against: str | None
    times: FloatArray
    summary: dict[str, Any] = field(default_factory=dict)


def track_of(name: str, stream: Stream, origin: Sequence[float] | None = None, *, heading: bool = True) -> Track | None:
    """A stream with the columns of a solution as a `Track`; None where fewer than two rows have an attitude.

    Rows without finite, increasing time or without a unit quaternion are left out. Position is from ``origin`` [deg, deg, m] where the
    stream has latitude and longitude.
    """
    q = stream.vector("q", "wxyz")
    norm = np.linalg.norm(q, axis=1)
    rows = np.flatnonzero(np.isfinite(stream.t) & np.isfinite(norm) & (np.abs(norm - 1.0) < 0.05))
    if len(rows):
        rows = rows[np.r_[True, np.diff(np.maximum.accumulate(stream.t[rows])) > 0.0]]
    if len(rows) < 2:
        return None
    stream, q = stream.where(rows), q[rows] / norm[rows, None]
    vel, pos = stream.vector("vel", "ned"), np.full((len(rows), 3), np.nan)
    at, p = reference_position(stream, list(origin) if origin is not None else None)
    pos[np.searchsorted(stream.t, at)] = p
    return Track(name, stream.t, q, vel if np.isfinite(vel).any() else None, pos if np.isfinite(pos).any() else None, heading)


def common_rows(tracks: Sequence[Track], t: FloatArray, settle: float) -> tuple[Mask, dict[str, str]]:
    """Rows that all tracks can be scored on, the same for every one.

    Parameters
    ----------
    tracks
        The solutions.
    t
        Times at hand (m,) [s], those of the reference.
    settle
        Time after a track's first row in which it is not scored yet [s].

    Returns
    -------
    rows : (m,)
        Mask: every track that is kept has begun ``settle`` before, and has rows on both sides.
    left_out : dict
        Tracks that would leave less than half of the rows to the others, with the reason.
    """
    masks = {k: (t >= track.t[0] + settle) & between(track.t, t) for k, track in enumerate(tracks)}
    left_out: dict[str, str] = {}

    def shared(keys: Sequence[int]) -> Mask:
        return np.logical_and.reduce([masks[k] for k in keys]) if keys else np.zeros(len(t), bool)

    while len(masks) > 1:
        now = int(np.count_nonzero(shared(list(masks))))
        without = {k: int(np.count_nonzero(shared([j for j in masks if j != k]))) for k in masks}
        worst = max(without, key=lambda k: without[k])
        if now >= PART * without[worst]:
            break
        left_out[tracks[worst].name] = (
            f"has {int(np.count_nonzero(masks[worst]))} of the rows; with it {now} would be left, without it {without[worst]}"
        )
        del masks[worst]
    return shared(list(masks)), left_out


def _at(track: Track, values: FloatArray, t: FloatArray) -> FloatArray:
    """Columns of a track at other times, linear; NaN beside a missing value."""
    return np.column_stack([np.interp(t, track.t, values[:, k]) for k in range(values.shape[1])])


def errors(track: Track, reference: Track, t: FloatArray) -> Series:
    """Errors of a track against a reference at times of the reference: ``(t, error)`` by name, angles in rad.

    ``attitude`` is the angle of the whole rotation between them, ``tilt`` that between their verticals, ``roll``, ``pitch``, ``yaw`` are
    differences of Euler angles, ``heading`` the turn about the vertical that is left; ``vel_n`` ... ``pos_d``, with ``vel`` and ``pos``
    for their length. The track is interpolated (attitude along the shortest turn), the reference is read at its own rows. Without a
    measured heading on both sides there is only tilt, roll and pitch.
    """
    row = np.searchsorted(reference.t, t)
    q_ref = reference.q[row]
    q = slerp(t, track.t, track.q)
    out: Series = {}
    angles = (euler(q) - euler(q_ref) + math.pi) % (2.0 * math.pi) - math.pi
    out["tilt"] = (t, tilt_between(q, q_ref))
    out["roll"], out["pitch"] = (t, angles[:, 0]), (t, angles[:, 1])
    if track.heading and reference.heading:
        out["attitude"] = (t, np.linalg.norm(rotation_vector(multiply(conjugate(q), q_ref)), axis=1))
        out["yaw"] = (t, angles[:, 2])
        out["heading"] = (t, heading_between(q, q_ref))
    for stem, mine, theirs in (("vel", track.vel, reference.vel), ("pos", track.pos, reference.pos)):
        if mine is None or theirs is None:
            continue
        difference = _at(track, mine, t) - theirs[row]
        for k, a in enumerate("ned"):
            good = np.isfinite(difference[:, k])
            if good.any():
                out[f"{stem}_{a}"] = (t[good], difference[good, k])
        whole = np.isfinite(difference).all(axis=1)
        if whole.any():
            out[stem] = (t[whole], np.linalg.norm(difference[whole], axis=1))
    return out


def _rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def scores(series: Series) -> dict[str, Any]:
    """RMS and largest absolute error by name (angles in degrees under ``*_deg``), and the mean turn about the vertical."""
    out: dict[str, Any] = {}
    for name, (_, e) in series.items():
        if name == "heading":
            mean = math.atan2(float(np.mean(np.sin(e))), float(np.mean(np.cos(e))))
            out["heading_offset_deg"] = math.degrees(mean)
            continue
        k = 180.0 / math.pi if name in ANGLES else 1.0
        out[f"{name}_deg" if name in ANGLES else name] = {"rms": k * _rms(e), "max": k * float(np.max(np.abs(e))), "n": len(e)}
    return out


def pair(a: Track, b: Track, t: FloatArray) -> dict[str, Any]:
    """RMS differences of two tracks at times both reach: attitude, tilt, heading [deg], velocity [m/s], position [m]; None: not known."""
    qa, qb = slerp(t, a.t, a.q), slerp(t, b.t, b.q)
    known = a.heading and b.heading
    out: dict[str, Any] = {
        "a": a.name,
        "b": b.name,
        "attitude_deg": None,
        "tilt_deg": math.degrees(_rms(tilt_between(qa, qb))),
        "heading_deg": None,
    }
    if known:
        out["attitude_deg"] = math.degrees(_rms(np.linalg.norm(rotation_vector(multiply(conjugate(qa), qb)), axis=1)))
        out["heading_deg"] = math.degrees(_rms(heading_between(qa, qb)))
    for stem, va, vb in (("vel", a.vel, b.vel), ("pos", a.pos, b.pos)):
        out[stem] = None
        if va is not None and vb is not None:
            d = _at(a, va, t) - _at(b, vb, t)
            d = d[np.isfinite(d).all(axis=1)]
            out[stem] = _rms(np.linalg.norm(d, axis=1)) if len(d) else None
    return out


def differences_from_gnss(
    track: Track, velocity: tuple[FloatArray, FloatArray], position: tuple[FloatArray, FloatArray], span: tuple[float, float]
) -> dict[str, dict[str, float]]:
    """RMS length of the difference from GNSS fixes (times (m,), values NED (m, 3)) within a span, for velocity and position."""
    out: dict[str, dict[str, float]] = {}
    for name, mine, (t, values) in (("vel", track.vel, velocity), ("pos", track.pos, position)):
        if mine is None or len(t) == 0:
            continue
        use = (t >= span[0]) & (t <= span[1]) & between(track.t, t) & np.isfinite(values).all(axis=1)
        if use.any():
            d = np.linalg.norm(_at(track, mine, t[use]) - values[use], axis=1)
            d = d[np.isfinite(d)]
            if len(d):
                out[name] = {"rms": _rms(d), "max": float(d.max()), "n": len(d)}
    return out


def covered(t: FloatArray, tracks: Sequence[Track]) -> dict[str, float]:
    """Share of times ``t`` that each track covers, by name."""
    return {track.name: float(np.mean(between(track.t, t))) for track in tracks}
