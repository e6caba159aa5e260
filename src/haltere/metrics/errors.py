"""Errors of a solution against the autopilot's own or a reference, at the reference's times. Frames and origins are matched first."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.local import local_from_geodetic
from haltere.flight.log import Stream
from haltere.flight.solution import Solution
from haltere.metrics.attitude import conjugate, euler, multiply, rotation_vector, slerp

__all__ = ["attitude_error", "error_series", "error_table", "reference_position"]

FloatArray = NDArray[np.float64]
Series = dict[str, tuple[FloatArray, FloatArray]]


def _inside(solution: Solution, t: FloatArray, gap: float = 0.5) -> NDArray[np.bool_]:
    """Reference times between two solution rows that are not further apart than ``gap`` [s]."""
    if len(solution) < 2:
        return np.zeros(len(t), bool)
    i = np.clip(np.searchsorted(solution.t, t, side="right") - 1, 0, len(solution) - 2)
    inside = (t >= solution.t[0]) & (t <= solution.t[-1])
    inside &= solution.t[i + 1] - solution.t[i] <= gap
    return np.asarray(inside)


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
    q_ref = reference.vector("q", "wxyz")
    good = np.isfinite(q_ref).all(axis=1) & _inside(solution, reference.t)
    t, q_ref = reference.t[good], q_ref[good]
    if len(t) == 0:
        return t, np.empty((0, 3)), np.empty((0, 3))
    q_ref = q_ref / np.linalg.norm(q_ref, axis=1, keepdims=True)
    q = slerp(t, solution.t, solution.vector("q", "wxyz"))
    difference = euler(q) - euler(q_ref)
    return t, rotation_vector(multiply(conjugate(q), q_ref)), (difference + math.pi) % (2.0 * math.pi) - math.pi


def reference_position(reference: Stream, origin: list[float] | None) -> tuple[FloatArray, FloatArray]:
    """Times (m,) and positions NED (m, 3) [m] of a reference from our origin, NaN where not known.

    From lat, lon and alt where they are given, since they hang on no origin; else from pos_n, pos_e, pos_d, which are
    relative to the flight's home.
    """
    p = reference.vector("pos", "ned")
    if origin is not None:
        n, e, d = local_from_geodetic(reference.get("lat"), reference.get("lon"), reference.get("alt"), *origin)
        geodetic = np.column_stack([n, e, d])
        for axes in ([0, 1], [2]):  # a column comes from one source alone: two would differ by a step
            if np.isfinite(geodetic[:, axes]).any():
                p[:, axes] = geodetic[:, axes]
    good = np.isfinite(p).any(axis=1)
    return reference.t[good], p[good]


def error_series(solution: Solution, reference: Stream) -> Series:
    """Errors, solution minus reference, by name: ``(t, error)`` with angles in rad; only what both sides have."""
    out: Series = {}
    t, rotvec, angles = attitude_error(solution, reference)
    if len(t):
        for k, name in enumerate(("roll", "pitch", "yaw")):
            out[name] = (t, angles[:, k])
        out["attitude"] = (t, np.linalg.norm(rotvec, axis=1))
    if "vel_n" in solution:
        v = reference.vector("vel", "ned")
        for k, a in enumerate("ned"):
            good = np.isfinite(v[:, k]) & _inside(solution, reference.t)
            if good.any():
                out[f"vel_{a}"] = (reference.t[good], np.interp(reference.t[good], solution.t, solution[f"vel_{a}"]) - v[good, k])
        tp, p = reference_position(reference, solution.summary.get("origin"))
        for k, a in enumerate("ned"):
            good = np.isfinite(p[:, k]) & _inside(solution, tp)
            if good.any():
                out[f"pos_{a}"] = (tp[good], np.interp(tp[good], solution.t, solution[f"pos_{a}"]) - p[good, k])
    for stem in ("gyro_bias", "accel_bias"):
        for a in "xyz":
            name = f"{stem}_{a}"
            if name in solution and name in reference:
                good = np.isfinite(reference[name]) & _inside(solution, reference.t)
                if good.any():
                    out[name] = (reference.t[good], np.interp(reference.t[good], solution.t, solution[name]) - reference[name][good])
    return out


def error_table(series: Series) -> dict[str, dict[str, float]]:
    """RMS and largest absolute error by name; angles in degrees under ``*_deg``."""
    out: dict[str, dict[str, float]] = {}
    for name, (_, error) in series.items():
        angle = name in ("roll", "pitch", "yaw", "attitude")
        k = 180.0 / math.pi if angle else 1.0
        e = k * error
        row: dict[str, Any] = {"rms": float(np.sqrt(np.mean(e * e))), "max": float(np.max(np.abs(e))), "n": len(e)}
        out[f"{name}_deg" if angle else name] = row
    return out
