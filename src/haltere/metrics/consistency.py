"""Is the reported uncertainty true? NIS of the innovations, NEES against truth, with χ² bands. It judges no sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import Stream
from haltere.flight.solution import Solution
from haltere.metrics.attitude import conjugate, multiply, rotation_vector, slerp
from haltere.metrics.errors import reference_position
from haltere.metrics.whiteness import assumed

__all__ = ["BLOCKS", "DOF", "WINDOW", "NisSeries", "band", "nees_series", "nees_table", "nis_series", "nis_table", "tested"]

FloatArray = NDArray[np.float64]
#: Blocks of the error state, in order.
BLOCKS = ("attitude", "velocity", "position", "gyro_bias", "accel_bias", "baro_bias", "wind")
#: Degrees of freedom of each; of the wind only its horizontal part counts.
DOF = dict.fromkeys(BLOCKS, 3) | {"baro_bias": 1, "wind": 2}
#: Measurements in the moving mean of the NIS: few enough to show when, enough for a band of about 0.5 to 1.6 (one component).
WINDOW = 25


def band(dof: float, n: float, probability: float = 0.95) -> tuple[float, float]:
    """Interval in which the mean of n independent χ²(dof), divided by dof, lies with this probability."""
    from scipy.special import gammaincinv  # quantiles of χ²(k) are twice those of the gamma distribution k/2; scipy.stats loads for long

    tail, k = 0.5 * (1.0 - probability), dof * n
    low, high = (2.0 * gammaincinv(0.5 * k, q) for q in (tail, 1.0 - tail))
    return float(low / k), float(high / k)


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
        used = tested(aids)[rows]
        out[str(sensor)] = {
            "mean": float(np.mean(ratio[used])) if used.any() else None,
            "band": list(band(1.0, max(int(used.sum()), 1))),
            "n": n,
            "rejected": int(np.count_nonzero(aids["status"][rows] == "rejected")),
            "deweighted": int(np.count_nonzero(aids["status"][rows] == "deweighted")),
            "lost": float(1.0 - np.mean(np.minimum(aids["weight"][rows], 1.0))),
        }
    return out


def tested(aids: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Which records say how true the filter's own variances are: what was fused, with its full weight or with less.

    Those let in by force after a timeout are not among them: they are there because they do not fit.
    """
    status = aids["status"]
    return np.asarray((status == "fused") | ((status == "deweighted") & (aids["reason"] != "timeout")))


@dataclass(frozen=True)
class NisSeries:
    """Moving mean of a sensor's NIS a component: middle times, means, and the χ² band of each, all (n,)."""

    t: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray


def nis_series(solution: Solution, window: int = WINDOW) -> dict[tuple[str, str], NisSeries]:
    """Moving mean of the squared normalised innovations over ``window`` measurements, by sensor and quantity.

    The components of one measurement count as that many degrees of freedom: quantities are ``vel``, ``pos``, ``mag`` or a scalar's
    own name. What was refused or let in by force is left out as in `nis_table`, and so are assumptions and quantities with fewer
    measurements than the window.
    """
    a = solution.aids
    out: dict[tuple[str, str], NisSeries] = {}
    good = tested(a) & (a["reason"] != "start") & (a["innovation_sd"] > 0.0) & np.isfinite(a["innovation"])
    for sensor in (str(s) for s in np.unique(a["sensor"][good])):
        if assumed(sensor):
            continue
        rows = np.flatnonzero(good & (a["sensor"] == sensor))
        stems = np.array([c.rpartition("_")[0] or c for c in a["component"][rows].tolist()])
        for stem in dict.fromkeys(stems.tolist()):
            mine = rows[stems == stem]
            t, which, parts = np.unique(a["t"][mine], return_inverse=True, return_counts=True)
            if len(t) < window:
                continue
            ratio = (a["innovation"][mine] / a["innovation_sd"][mine]) ** 2
            squares = np.asarray(np.bincount(which.ravel(), ratio, len(t)), np.float64)
            total, dof = _moving_sum(squares, window), _moving_sum(parts.astype(np.float64), window)
            kinds, back = np.unique(np.rint(dof), return_inverse=True)
            bands = np.array([band(1.0, n) for n in kinds])[back.ravel()]
            out[sensor, stem] = NisSeries(_moving_sum(t, window) / window, total / dof, bands[:, 0], bands[:, 1])
    return out


def _moving_sum(x: FloatArray, window: int) -> FloatArray:
    """Sums over every ``window`` successive values, (n - window + 1,)."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(x, window).sum(axis=1))


#: What `nees_series` reads of a truth.
_READ = ("q_", "vel_", "pos_", "gyro_bias_", "accel_bias_", "baro_bias", "wind_", "lat", "lon", "alt")


def _around(truth: Stream, t: FloatArray) -> Stream:
    """Only the rows on both sides of each time, where all of them hold everything: between them lies the same."""
    after = np.searchsorted(truth.t, t, side="right")
    rows = np.unique(np.clip(np.concatenate([after - 1, after]), 0, len(truth) - 1))
    few = {name: a.take(rows) for name, a in truth.columns.items() if name == "t" or name.startswith(_READ)}
    return Stream(few) if len(rows) > 1 and all(np.isfinite(a).all() for a in few.values()) else truth


def _rows(solution: Solution, rows: NDArray[np.intp], stem: str, axes: str) -> FloatArray:
    """Some rows of a vector."""
    return np.column_stack([solution[f"{stem}_{a}"][rows] for a in axes])


def _squared_distance(e: FloatArray, P: FloatArray) -> FloatArray:
    """eᵀ P⁻¹ e of errors (n, k) and covariances (n, k, k), by elimination over all rows at once."""
    k = e.shape[1]
    A = np.ascontiguousarray(np.moveaxis(P, 0, -1))
    x = np.array(e.T)
    total = np.zeros(e.shape[0])
    for i in range(k):
        total += x[i] * x[i] / A[i, i]
        for j in range(i + 1, k):
            f = A[j, i] / A[i, i]
            x[j] -= f * x[i]
            A[j, i + 1 :] -= f * A[i, i + 1 :]
    return np.asarray(total)


def nees_series(solution: Solution, truth: Stream) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Normalised estimation error squared of each block divided by its dof, ``(t, nees)``, at the covariance's times.

    Truth is interpolated to those times; a block whose truth is missing is left out.
    """
    out: dict[str, tuple[FloatArray, FloatArray]] = {}
    cov = solution.covariance
    if not cov or len(cov["t"]) == 0 or len(truth) < 2:
        return out
    row = np.minimum(np.searchsorted(solution.t, cov["t"]), len(solution) - 1)
    inside = (cov["t"] >= truth.t[0]) & (cov["t"] <= truth.t[-1]) & (cov["t"] == solution.t[row])
    t, row = cov["t"][inside], row[inside]
    if len(t) == 0:
        return out
    truth = _around(truth, t)
    errors: dict[str, FloatArray] = {}
    q_ref = truth.vector("q", "wxyz")
    good = np.isfinite(q_ref).all(axis=1)
    if np.count_nonzero(good) > 1:
        q = _rows(solution, row, "q", "wxyz")
        errors["attitude"] = rotation_vector(multiply(conjugate(q), slerp(t, truth.t[good], q_ref[good])))
    for block, stem, axes in (("velocity", "vel", "ned"), ("gyro_bias", "gyro_bias", "xyz"), ("accel_bias", "accel_bias", "xyz")):
        reference = truth.vector(stem, axes)
        good = np.isfinite(reference).all(axis=1)
        if f"{stem}_{axes[0]}" in solution and np.count_nonzero(good) > 1:
            estimate = _rows(solution, row, stem, axes)
            errors[block] = np.column_stack([np.interp(t, truth.t[good], reference[good, k]) for k in range(3)]) - estimate
    if "pos_n" in solution:
        tp, p = reference_position(truth, solution.summary.get("origin"))
        known = np.isfinite(p)
        if all(np.count_nonzero(known[:, k]) > 1 for k in range(3)):
            estimate = _rows(solution, row, "pos", "ned")
            errors["position"] = np.column_stack([np.interp(t, tp[known[:, k]], p[known[:, k], k]) for k in range(3)]) - estimate
    if "baro_bias" in solution and "baro_bias" in truth and np.isfinite(truth["baro_bias"]).sum() > 1:
        good = np.isfinite(truth["baro_bias"])
        errors["baro_bias"] = (np.interp(t, truth.t[good], truth["baro_bias"][good]) - solution["baro_bias"][row])[:, None]
    if "wind" in cov:
        reference = truth.vector("wind", "ne")
        good = np.isfinite(reference).all(axis=1)
        if "wind_n" in solution and np.count_nonzero(good) > 1:
            there = np.column_stack([np.interp(t, truth.t[good], reference[good, k]) for k in range(2)])
            errors["wind"] = there - _rows(solution, row, "wind", "ne")
    for block in BLOCKS:
        if block in errors and block in cov:
            e = errors[block]
            k = e.shape[1]
            nees = _squared_distance(e, cov[block][inside, :k, :k]) / k
            there = np.isfinite(nees)  # an estimator may have no wind on the ground
            if there.any():
                out[block] = (t[there], nees[there])
    return out


def nees_table(series: dict[str, tuple[FloatArray, FloatArray]]) -> dict[str, dict[str, Any]]:
    """Mean NEES a degree of freedom by block. One flight is about one independent sample of a slow block: the band is that of one."""
    return {
        block: {"mean": float(np.mean(nees)), "band": list(band(DOF[block], 1.0)), "dof": DOF[block], "n": len(nees)}
        for block, (_, nees) in series.items()
    }
