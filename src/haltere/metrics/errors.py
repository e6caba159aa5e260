"""Errors of a solution against the autopilot's own or a reference, at the reference's times. Frames and origins are matched first."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.local import local_from_geodetic
from haltere.flight.log import Stream
from haltere.flight.solution import Solution
from haltere.metrics.attitude import angles_between, conjugate, euler_between, multiply, rotation_vector, slerp

__all__ = [
    "ANGLES",
    "attitude_error",
    "between",
    "error_series",
    "error_table",
    "largest",
    "lengths",
    "reference_position",
    "rms",
    "settling_time",
    "since",
]

FloatArray = NDArray[np.float64]
Series = dict[str, tuple[FloatArray, FloatArray]]
#: Errors that are angles [rad]. Attitude is the whole rotation, tilt and heading its parts off and about the vertical (the total,
#: inclination and heading errors of D. Laidig et al., BROAD, Data 6(7), 2021); roll, pitch and yaw are differences of Euler angles.
ANGLES = ("roll", "pitch", "yaw", "attitude", "tilt", "heading")
#: Vectors and their axes.
VECTORS = {"vel": "ned", "pos": "ned", "wind": "ned", "gyro_bias": "xyz", "accel_bias": "xyz"}


def between(rows: FloatArray, t: FloatArray, gap: float = 0.5) -> NDArray[np.bool_]:
    """Times ``t`` (m,) that lie between two of the increasing ``rows`` (n,) not further apart than ``gap`` [s]."""
    if len(rows) < 2:
        return np.zeros(len(t), bool)
    inside = (t >= rows[0]) & (t <= rows[-1])
    if np.diff(rows).max() > gap:
        i = np.clip(np.searchsorted(rows, t, side="right") - 1, 0, len(rows) - 2)
        inside &= rows[i + 1] - rows[i] <= gap
    return np.asarray(inside)


def _inside(solution: Solution, t: FloatArray) -> NDArray[np.bool_]:
    """Reference times that the solution reaches."""
    return between(solution.t, t)


def _piece(mask: NDArray[np.bool_]) -> NDArray[np.bool_] | slice:
    """The mask, or where its rows lie together the slice of them, with which nothing is copied."""
    n = int(np.count_nonzero(mask))
    first = int(np.argmax(mask)) if n else 0
    return slice(first, first + n) if mask[first : first + n].all() else mask


def _at(solution: Solution, t: FloatArray) -> slice | None:
    """Rows of the solution at just these times, where there is no need to interpolate."""
    first = int(np.searchsorted(solution.t, t[0])) if len(t) else 0
    rows = slice(first, first + len(t))
    return rows if np.array_equal(solution.t[rows], t) else None


def attitude_error(solution: Solution, reference: Stream) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Attitude errors at the reference's times.

    Returns
    -------
    t : (m,)
        Reference times [s] with an attitude on both sides.
    rotvec_b : (m, 3)
        Error δθ of q_ref = q ⊗ δq(δθ), body frame [rad].
    euler_error : (m, 3)
        Roll, pitch, yaw of the solution minus the reference's, wrapped [rad].
    """
    t, q, q_ref = _attitudes(solution, reference, _inside(solution, reference.t))
    if len(t) == 0:
        return t, np.empty((0, 3)), np.empty((0, 3))
    return t, rotation_vector(multiply(conjugate(q), q_ref)), euler_between(q, q_ref)


def _attitudes(solution: Solution, reference: Stream, inside: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, and unit quaternions of solution and reference at them, where both have one."""
    q_ref = np.array([reference.get(f"q_{a}") for a in "wxyz"])  # columns in one piece
    norm = np.sqrt(np.einsum("ij,ij->j", q_ref, q_ref))
    good = _piece(np.isfinite(norm) & inside)
    t, q_ref = reference.t[good], (q_ref[:, good] / norm[good]).T
    if len(t) == 0:
        return t, np.empty((0, 4)), np.empty((0, 4))
    rows = _at(solution, t)
    q = slerp(t, solution.t, solution.vector("q", "wxyz")) if rows is None else np.array([solution[f"q_{a}"][rows] for a in "wxyz"]).T
    return t, q, q_ref


def reference_position(reference: Stream, origin: list[float] | None) -> tuple[FloatArray, FloatArray]:
    """Times (m,) and positions NED (m, 3) [m] of a reference from our origin, NaN where not known.

    From lat, lon and alt where they are given, since they hang on no origin; else from pos_n, pos_e, pos_d, which are
    relative to the flight's home.
    """
    p = reference.vector("pos", "ned")
    if origin is not None and any(name in reference for name in ("lat", "alt")):
        n, e, d = local_from_geodetic(reference.get("lat"), reference.get("lon"), reference.get("alt"), *origin)
        geodetic = np.column_stack([n, e, d])
        for axes in ([0, 1], [2]):  # a column comes from one source alone: two would differ by a step
            if np.isfinite(geodetic[:, axes]).any():
                p[:, axes] = geodetic[:, axes]
    good = _piece(np.asarray(np.isfinite(p).any(axis=1)))
    return reference.t[good], p[good]


def error_series(solution: Solution, reference: Stream) -> Series:
    """Errors, solution minus reference, by name: ``(t, error)`` with angles in rad; only what both sides have.

    Names are those of `ANGLES` (attitude and tilt without sign) and the components of velocity, position, wind and biases.
    """
    out: Series = {}
    inside = _inside(solution, reference.t)
    t, q, q_ref = _attitudes(solution, reference, inside)
    if len(t):
        angles = euler_between(q, q_ref)
        for k, name in enumerate(("roll", "pitch", "yaw")):
            out[name] = (t, angles[:, k])
        for name, angle in zip(("attitude", "tilt", "heading"), angles_between(q, q_ref), strict=True):
            out[name] = (t, angle)
    for stem, axes in VECTORS.items():
        times, values, within = reference.t, reference, inside
        if stem == "pos":
            if "pos_n" not in solution:
                continue
            times, p = reference_position(reference, solution.summary.get("origin"))
            values = Stream({"t": times} | {f"pos_{a}": p[:, k] for k, a in enumerate(axes)})
            within = inside if len(times) == len(reference) else _inside(solution, times)
        where = _piece(within)
        t = times[where]
        rows = _at(solution, t)
        for name in (f"{stem}_{a}" for a in axes):
            if name not in solution or name not in values:
                continue
            value = values[name][where]
            good = np.isfinite(value)
            if good.all() and len(t):
                out[name] = (t, (np.interp(t, solution.t, solution[name]) if rows is None else solution[name][rows]) - value)
            elif good.any():
                out[name] = (t[good], np.interp(t[good], solution.t, solution[name]) - value[good])
            if name in out and stem == "wind":  # an estimator may have none on the ground
                there = np.isfinite(out[name][1])
                if not there.all():
                    out[name] = (out[name][0][there], out[name][1][there])
    return out


def lengths(series: Series) -> Series:
    """Lengths of the error vectors (``vel``, ``pos``, ``wind``, ``gyro_bias``, ``accel_bias``) of which every component is there.

    Wind counts its horizontal part where an estimator has no other.
    """
    out: Series = {}
    for stem, axes in VECTORS.items():
        names = [f"{stem}_{a}" for a in axes if stem != "wind" or a != "d" or "wind_d" in series]
        if any(name not in series for name in names):
            continue
        t = series[names[0]][0]
        if all(series[name][0] is t or np.array_equal(series[name][0], t) for name in names[1:]):
            out[stem] = (t, np.sqrt(sum(series[name][1] ** 2 for name in names)))
    return out


def since(series: Series, begin: float, end: float = math.inf) -> Series:
    """The same errors at times from ``begin`` to ``end`` [s]; names with none are left out."""
    kept: dict[int, tuple[NDArray[np.bool_] | slice, FloatArray]] = {}  # by the array of times, which most share
    for t, _ in series.values():
        if id(t) not in kept:
            where = _piece((t >= begin) & (t <= end)) if len(t) else slice(0, 0)
            kept[id(t)] = where, t[where]
    return {name: (kept[id(t)][1], e[kept[id(t)][0]]) for name, (t, e) in series.items() if len(kept[id(t)][1])}


def settling_time(t: FloatArray, error: FloatArray, bound: float, begin: float | None = None) -> float:
    """Time [s] from ``begin`` until an error stays within a bound to its end.

    Parameters
    ----------
    t, error
        Times [s] and errors (n,), rising; those before ``begin`` do not count.
    bound
        In the error's unit, on its magnitude; equal is within.
    begin
        Where time counts from; by default the first row.

    Returns
    -------
    float
        0 where it never was outside, NaN where it is outside at its last row or has no row.
    """
    begin = float(t[0]) if begin is None and len(t) else begin
    if begin is None:
        return math.nan
    after = t >= begin
    t, outside = t[after], ~(np.abs(error[after]) <= bound)
    if len(t) == 0 or outside[-1]:
        return math.nan
    rows = np.flatnonzero(outside)
    return float(t[rows[-1] + 1] - begin) if len(rows) else 0.0


def rms(error: FloatArray) -> float:
    """Root of the mean square. Not by a product of BLAS, whose threads cost more than they save on so few."""
    return math.sqrt(float(np.einsum("i,i->", error, error)) / len(error))


def largest(error: FloatArray) -> float:
    """Largest magnitude."""
    return float(max(error.max(), -error.min()))


def error_table(series: Series) -> dict[str, dict[str, float]]:
    """RMS and largest absolute error by name; angles in degrees under ``*_deg``."""
    out: dict[str, dict[str, float]] = {}
    for name, (_, error) in series.items():
        angle = name in ANGLES
        k = 180.0 / math.pi if angle else 1.0
        row: dict[str, Any] = {"rms": k * rms(error), "max": k * largest(error), "n": len(error)}
        out[f"{name}_deg" if angle else name] = row
    return out
