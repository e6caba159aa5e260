"""Missions as references for the controller: positions, velocities, accelerations and yaw over time. It knows no vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from haltere.errors import UsageError, nearest

__all__ = ["MISSIONS", "RATE", "TRACK", "reference", "track_reference"]

FloatArray = NDArray[np.float64]
Path = tuple[FloatArray, FloatArray]

#: Rows of a reference a second [Hz]; the controller takes values between them on lines.
RATE = 100.0
#: Name of the mission that follows a recorded track.
TRACK = "track"
#: At rest before take-off and after landing, and climbing or sinking between ground and mission [s]; height of missions [m].
REST, CLIMB, HEIGHT = 4.0, 6.0, 12.0


def _smooth(x: FloatArray) -> FloatArray:
    """From 0 to 1 with velocity, acceleration and jerk zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**4 * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x))), dtype=np.float64)


def _hover(t: FloatArray, scale: float) -> Path:
    return np.zeros((len(t), 3)), np.zeros(len(t))


def _climb(t: FloatArray, scale: float) -> Path:
    """Up and down by 20 m, resting at both ends."""
    pos = np.zeros((len(t), 3))
    pos[:, 2] = -20.0 * scale * (_smooth((t % 40.0) / 15.0) - _smooth((t % 40.0 - 20.0) / 15.0))
    return pos, np.zeros(len(t))


def _way_points(t: FloatArray, corners: FloatArray, yaws: FloatArray, leg: float) -> Path:
    """Legs of equal time from corner to corner, round and round, resting briefly at each."""
    k = np.floor(t / leg).astype(np.int64)
    x = _smooth((t - k * leg) / (0.9 * leg))[:, None]
    n = len(corners)
    pos = (1.0 - x) * corners[k % n] + x * corners[(k + 1) % n]
    turns = yaws[-1] + (yaws[1] - yaws[0])  # of one round
    yaw = (1.0 - x[:, 0]) * (yaws[k % n] + turns * (k // n)) + x[:, 0] * np.where(
        (k + 1) % n == 0, yaws[0] + turns * (k // n + 1), yaws[(k + 1) % n] + turns * (k // n)
    )
    return pos, yaw


def _box(t: FloatArray, scale: float) -> Path:
    """A square of 30 m, the nose turning a quarter at each corner, and heights that differ."""
    a = 30.0 * scale
    corners = np.array([[0.0, 0.0, 0.0], [a, 0.0, -3.0], [a, a, 2.0], [0.0, a, -5.0]])
    return _way_points(t, corners, 0.5 * math.pi * np.arange(4, dtype=np.float64), 10.0)


def _eight(t: FloatArray, scale: float) -> Path:
    """A horizontal figure eight, 40 m by 20 m in 20 s, the nose along the way."""
    w = 2.0 * math.pi / 20.0
    s = _spin_up(t)
    pos = np.column_stack([20.0 * scale * np.sin(w * s), 10.0 * scale * np.sin(2.0 * w * s), np.zeros(len(t))])
    way = np.unwrap(np.arctan2(np.cos(2.0 * w * s), np.cos(w * s)))
    return pos, way


def _lissajous(t: FloatArray, scale: float) -> Path:
    """Fast three-dimensional curves of incommensurable periods with turning nose: 8 m/s and 45 degrees of tilt."""
    s = _spin_up(t)
    x = 2.0 * math.pi * s[:, None] / np.array([7.1, 5.3, 9.7])
    pos = scale * np.array([8.0, 5.0, 3.0]) * np.sin(x)
    return pos, 1.5 * np.sin(2.0 * math.pi * s / 13.0)


def _spin_up(t: FloatArray) -> FloatArray:
    """Time along a curve that is entered gently: its rate grows from 0 to 1 within four seconds."""
    ramp = 4.0
    x = np.clip(t / ramp, 0.0, 1.0)
    grown = ramp * (x**5 * (7.0 - x * (14.0 - x * (10.0 - 2.5 * x))))
    return np.asarray(np.where(t < ramp, grown, grown + t - ramp), dtype=np.float64)


def _tour(t: FloatArray, scale: float) -> Path:
    """Five legs of the box in 50 s, then the figure eight from the corner reached, turned so that it begins along the nose."""
    box = np.minimum(t, 50.0)
    pos, yaw = _box(box, scale)
    eight, way = _eight(t - box, scale)
    turn = 0.25 * math.pi
    c, s = math.cos(turn), math.sin(turn)
    pos += np.column_stack([c * eight[:, 0] - s * eight[:, 1], s * eight[:, 0] + c * eight[:, 1], eight[:, 2]])
    return pos, yaw + way - 0.25 * math.pi


def _identify(t: FloatArray, scale: float) -> Path:
    """What identification wants (theory.md §7): two speeds along each axis, vertical steps, and small quick swings about each axis."""
    pos, _ = _lissajous(t, 0.45 * scale)
    pos += _eight(t, 0.4 * scale)[0]
    on = _smooth((t - 4.0) / 2.0)
    for axis, (size, hertz) in enumerate(((0.025, 1.7), (0.025, 2.1), (0.05, 0.9))):
        pos[:, axis] += on * scale * size * np.sin(2.0 * math.pi * hertz * t)
    return pos, on * (0.5 * np.sin(2.0 * math.pi * t / 3.1) + 0.1 * np.sin(2.0 * math.pi * 1.3 * t))


#: Missions by name: where to be at each time after the climb, and the yaw there.
MISSIONS: dict[str, Callable[[FloatArray, float], Path]] = {
    "hover": _hover, "climb": _climb, "box": _box, "figure-eight": _eight, "lissajous": _lissajous, "identify": _identify,
    "tour": _tour,
}  # fmt: skip


def reference(
    mission: str, duration: float, *, rest: float = REST, scale: float = 1.0, height: float = HEIGHT, landing: bool = True
) -> FloatArray:
    """Reference of a mission from take-off to landing.

    Parameters
    ----------
    mission
        One of `MISSIONS`.
    duration
        Length [s].
    rest
        Time at rest on the ground before take-off [s]; 0 begins in the air.
    scale
        Size of the mission.
    height
        Above ground [m].
    landing
        Land at the end, where there is time for it.

    Returns
    -------
    numpy.ndarray
        Rows of `haltere.simulate.controller.REFERENCE`, (n, 12), `RATE` a second, to the end or just beyond it.

    Raises
    ------
    UsageError
        Unknown mission, or too short.
    """
    if mission not in MISSIONS:
        raise UsageError(f"a mission ({', '.join([*MISSIONS, TRACK])})", repr(mission), "mission", nearest(mission, [*MISSIONS, TRACK]))
    begin = rest + CLIMB if rest > 0.0 else 0.0
    if not (math.isfinite(duration) and duration >= begin + 4.0):
        raise UsageError(f"a duration of at least {begin + 4.0:g} s", f"{duration}", "duration")
    t = np.arange(math.ceil(duration * RATE) + 1, dtype=np.float64) / RATE
    lands = landing and duration >= begin + 3.0 * CLIMB + REST
    end = duration - (3.0 * CLIMB + REST) if lands else duration
    pos, yaw = MISSIONS[mission](np.clip(t - begin, 0.0, max(end - begin, 1.0 / RATE)), scale)
    pos[:, 2] -= height
    flying = np.ones(len(t))
    if rest > 0.0:
        up = _smooth((t - rest) / CLIMB)
        low = t < begin
        pos[low, 2] *= up[low]
        pos[low, :2] = 0.0
        flying[t < rest] = 0.0
    if lands:
        # come to rest where the mission ends, then down to the ground, then motors off
        last = MISSIONS[mission](end - begin + np.array([-0.5, 0.0, 0.5]) / RATE, scale)[0]
        speed = (last[2] - last[0]) * RATE
        s = t - end
        late = s >= 0.0
        x = np.clip(s / CLIMB, 0.0, 1.0)
        # velocity falls as 1 - smooth step: how far it carries
        carried = CLIMB * (x - x**5 * (7.0 - x * (14.0 - x * (10.0 - 2.5 * x))))
        pos[late] = (last[1] - np.array([0.0, 0.0, height]) + carried[:, None] * speed)[late]
        down = _smooth((s - CLIMB) / (2.0 * CLIMB))[late]
        pos[late, 2] = pos[late, 2] * (1.0 - down) + 0.02 * down
        flying[s > 3.0 * CLIMB] = 0.0
    return _rows(pos, yaw, flying)


def track_reference(
    t: FloatArray, pos_n: FloatArray, yaw: FloatArray, smoothing: float = 0.05, *, rest: float = REST, height: float = HEIGHT
) -> FloatArray:
    """Reference along a track of a real flight: smoothed to what a multirotor can follow, flown from the air.

    Parameters
    ----------
    t, pos_n, yaw
        Times (n,) [s], positions NED (n, 3) [m] and yaw (n,) [rad]; rows that are not finite are left out.
    smoothing
        Weight of the squared acceleration against the squared errors of the points: 0.05 lets half a hertz through, 1 a quarter of it.
    rest
        Time hovering at the first point [s] before the track begins.
    height
        Of the lowest point of the track above ground [m].

    Returns
    -------
    numpy.ndarray
        Rows of `haltere.simulate.controller.REFERENCE`, (n, 12), `RATE` a second. North and east begin at zero.

    Raises
    ------
    UsageError
        Too few points.
    """
    from scipy.interpolate import make_smoothing_spline

    good = np.isfinite(pos_n).all(axis=1) & np.isfinite(t) & np.isfinite(yaw)
    t, pos_n, yaw = t[good], pos_n[good], np.unwrap(yaw[good])
    slots = np.unique(np.floor(t / 0.2), return_index=True)[1]  # five points a second are enough for a track
    t, pos_n, yaw = t[slots], pos_n[slots], yaw[slots]
    if len(t) < 8:
        raise UsageError("a track of at least 8 points, 0.2 s apart", f"{len(t)}", "track")
    s = np.arange(math.floor((rest + 2.0 + t[-1] - t[0]) * RATE) + 1, dtype=np.float64) / RATE
    # from the first point it sets off gently: its clock starts slowly, and loses two seconds by it
    at = np.minimum(_spin_up(np.maximum(s - rest, 0.0)), t[-1] - t[0])
    pos = np.column_stack([make_smoothing_spline(t - t[0], pos_n[:, k], lam=smoothing)(at) for k in range(3)])
    low = pos[:, 2].max()
    pos -= np.array([pos[0, 0], pos[0, 1], low + height])
    turned = make_smoothing_spline(t - t[0], yaw, lam=smoothing)(at)
    return _rows(pos, turned, np.ones(len(s)))


def _rows(pos: FloatArray, yaw: FloatArray, flying: FloatArray) -> FloatArray:
    out = np.empty((len(pos), 12))
    out[:, :3], out[:, 9], out[:, 11] = pos, yaw, flying
    out[:, 3:6] = np.gradient(pos, 1.0 / RATE, axis=0)
    out[:, 6:9] = np.gradient(out[:, 3:6], 1.0 / RATE, axis=0)
    out[:, 10] = np.gradient(yaw, 1.0 / RATE)
    return out
