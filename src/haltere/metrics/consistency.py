"""Is the reported uncertainty true? NIS of the innovations, NEES against truth, with χ² bands. It judges no sensor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import Stream
from haltere.flight.solution import Solution
from haltere.metrics.attitude import conjugate, multiply, rotation_vector, slerp
from haltere.metrics.errors import reference_position

__all__ = ["BLOCKS", "band", "nees_series", "nees_table", "nis_table"]

FloatArray = NDArray[np.float64]
#: Blocks of the error state, in order.
BLOCKS = ("attitude", "velocity", "position", "gyro_bias", "accel_bias", "baro_bias")
#: Degrees of freedom of each.
DOF = dict.fromkeys(BLOCKS, 3) | {"baro_bias": 1}


def band(dof: float, n: float, probability: float = 0.95) -> tuple[float, float]:
    """Interval in which the mean of n independent χ²(dof), divided by dof, lies with this probability."""
    from scipy.stats import chi2

    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], dof * n)
    return float(low / (dof * n)), float(high / (dof * n))


def nis_table(solution: Solution) -> dict[str, dict[str, Any]]:
    """Mean normalised innovation squared a component, by sensor, over what was tested (not the start values).

    The band is that of n independent innovations; those of one flight are only nearly so.
    """
    aids = solution.aids
    out: dict[str, dict[str, Any]] = {}
    for sensor in np.unique(aids["sensor"]):
        rows = (aids["sensor"] == sensor) & (aids["reason"] != "start")
        n = int(np.count_nonzero(rows))
        if n == 0:
            continue
        ratio = (aids["innovation"][rows] / aids["innovation_sd"][rows]) ** 2
        used = aids["status"][rows] == "fused"
        out[str(sensor)] = {
            "mean": float(np.mean(ratio[used])) if used.any() else None,
            "band": list(band(1.0, max(int(used.sum()), 1))),
            "n": n,
            "rejected": int(np.count_nonzero(aids["status"][rows] == "rejected")),
            "deweighted": int(np.count_nonzero(aids["status"][rows] == "deweighted")),
        }
    return out


def nees_series(solution: Solution, truth: Stream) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Normalised estimation error squared of each block divided by its dof, ``(t, nees)``, at the covariance's times.

    Truth is interpolated to those times; a block whose truth is missing is left out.
    """
    out: dict[str, tuple[FloatArray, FloatArray]] = {}
    cov = solution.covariance
    if not cov or len(cov["t"]) == 0 or len(truth) < 2:
        return out
    inside = (cov["t"] >= truth.t[0]) & (cov["t"] <= truth.t[-1]) & np.isin(cov["t"], solution.t)
    t = cov["t"][inside]
    if len(t) == 0:
        return out
    row = np.searchsorted(solution.t, t)
    errors: dict[str, FloatArray] = {}
    q_ref = truth.vector("q", "wxyz")
    good = np.isfinite(q_ref).all(axis=1)
    if np.count_nonzero(good) > 1:
        q = solution.vector("q", "wxyz")[row]
        errors["attitude"] = rotation_vector(multiply(conjugate(q), slerp(t, truth.t[good], q_ref[good])))
    for block, stem, axes in (("velocity", "vel", "ned"), ("gyro_bias", "gyro_bias", "xyz"), ("accel_bias", "accel_bias", "xyz")):
        reference = truth.vector(stem, axes)
        good = np.isfinite(reference).all(axis=1)
        if f"{stem}_{axes[0]}" in solution and np.count_nonzero(good) > 1:
            estimate = solution.vector(stem, axes)[row]
            errors[block] = np.column_stack([np.interp(t, truth.t[good], reference[good, k]) for k in range(3)]) - estimate
    if "pos_n" in solution:
        tp, p = reference_position(truth, solution.summary.get("origin"))
        known = np.isfinite(p)
        if all(np.count_nonzero(known[:, k]) > 1 for k in range(3)):
            estimate = solution.vector("pos", "ned")[row]
            errors["position"] = np.column_stack([np.interp(t, tp[known[:, k]], p[known[:, k], k]) for k in range(3)]) - estimate
    if "baro_bias" in solution and "baro_bias" in truth and np.isfinite(truth["baro_bias"]).sum() > 1:
        good = np.isfinite(truth["baro_bias"])
        errors["baro_bias"] = (np.interp(t, truth.t[good], truth["baro_bias"][good]) - solution["baro_bias"][row])[:, None]
    for block in BLOCKS:
        if block in errors and block in cov:
            e = errors[block]
            out[block] = (t, np.einsum("ni,ni->n", e, np.linalg.solve(cov[block][inside], e[..., None])[..., 0]) / e.shape[1])
    return out


def nees_table(series: dict[str, tuple[FloatArray, FloatArray]]) -> dict[str, dict[str, Any]]:
    """Mean NEES a degree of freedom by block. One flight is about one independent sample of a slow block: the band is that of one."""
    return {
        block: {"mean": float(np.mean(nees)), "band": list(band(DOF[block], 1.0)), "dof": DOF[block], "n": len(nees)}
        for block, (_, nees) in series.items()
    }
