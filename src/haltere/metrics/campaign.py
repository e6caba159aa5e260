"""What many runs say together: spread of errors, consistency, detection over size, isolation, operating curves. It makes no runs."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from haltere.metrics.consistency import BLOCKS, DOF, band
from haltere.metrics.detection import share_interval
from haltere.metrics.whiteness import assumed

if TYPE_CHECKING:
    import polars as pl

__all__ = [
    "ASTRAY", "DONE", "MISSED", "NOBODY", "SEVERAL", "BySize", "Confusion", "Consistency", "Curve", "by_size", "confusion", "consistency",
    "distribution", "estimators", "label", "of_estimator", "quartiles", "roc", "spread",
]  # fmt: skip

FloatArray = NDArray[np.float64]
#: Status of a run that gave figures.
DONE = "done"
#: Sizes of a fault that are each shown by itself, and into how many groups more of them are put.
LEVELS, GROUPS = 12, 8


def estimators(runs: pl.DataFrame) -> list[str]:
    """Names of estimators in the order of the runs."""
    return list(dict.fromkeys(runs["estimator"].to_list())) if "estimator" in runs.columns else []


def of_estimator(table: pl.DataFrame, estimator: str) -> pl.DataFrame:
    """Rows of one estimator."""
    return table.filter(table["estimator"] == estimator) if "estimator" in table.columns else table


def spread(values: FloatArray) -> dict[str, float | int]:
    """Mean, median, 95th percentile, largest and number."""
    ordered = np.sort(values[np.isfinite(values)])
    if not len(ordered):
        return {"n": 0}
    return {
        "mean": float(ordered.mean()), "median": float(np.quantile(ordered, 0.5)), "p95": float(np.quantile(ordered, 0.95)),
        "max": float(ordered[-1]), "n": len(ordered),
    }  # fmt: skip


def distribution(values: FloatArray, total: int, points: int = 400) -> tuple[FloatArray, FloatArray]:
    """Values in order and the share of ``total`` runs that are not above each, at no more than about so many of them."""
    ordered = np.sort(values[np.isfinite(values)])
    n = len(ordered)
    rows = np.unique(np.linspace(0, n - 1, min(n, points)).round().astype(np.int64)) if n else np.empty(0, np.int64)
    return ordered[rows], (rows + 1.0) / max(total, 1)


def quartiles(values: FloatArray) -> tuple[float, float, float, float, float]:
    """5, 25, 50, 75 and 95 % of the finite values; NaN where there are none."""
    known = values[np.isfinite(values)]
    if not len(known):
        return (math.nan,) * 5
    q = np.quantile(known, [0.05, 0.25, 0.5, 0.75, 0.95])
    return float(q[0]), float(q[1]), float(q[2]), float(q[3]), float(q[4])


@dataclass(frozen=True)
class Consistency:
    """Mean of a NEES or NIS over the runs of one estimator, a degree of freedom.

    Attributes
    ----------
    estimator, metric
        Whose, and the column of the results.
    values
        One a run.
    mean, low, high
        Over runs, with its 95 % interval from their scatter (Student's t; nothing assumed of what is in a run).
    bands
        95 % and 99.9 % chi-square intervals of a consistent filter. NEES: a run counts as one sample, since within it they hang
        together, so that the mean of its many lies inside at least as often. NIS: innovations of a consistent filter are
        independent, so that every one counts.
    """

    estimator: str
    metric: str
    values: FloatArray
    mean: float
    low: float
    high: float
    bands: tuple[tuple[float, float], tuple[float, float]]

    @property
    def verdict(self) -> str:
        """``inside`` the 99.9 % band, ``above`` or ``below``."""
        low, high = self.bands[1]
        return "inside" if low <= self.mean <= high else "above" if self.mean > high else "below"


def consistency(runs: pl.DataFrame) -> list[Consistency]:
    """Consistency over runs, by estimator and metric, of the runs without a fault where there are such.

    Runs that failed are not in it, and neither are assumptions such as zero velocity, which nobody measured.
    """
    from scipy.special import stdtrit

    out = []
    for name in estimators(runs):
        mine = of_estimator(runs, name)
        if "faults" in mine.columns and (sound := mine["faults"].fill_null(1.0) == 0.0).any():
            mine = mine.filter(sound)
        for metric in [f"nees.{b}" for b in BLOCKS] + [c for c in mine.columns if c.startswith("nis.") and not assumed(c[4:])]:
            if metric not in mine.columns:
                continue
            column = mine[metric].to_numpy().astype(np.float64)
            known = np.isfinite(column)
            values, n = column[known], int(known.sum())
            if n == 0:
                continue
            if metric.startswith("nees."):
                dof, count = DOF[metric.removeprefix("nees.")], float(n)
            else:
                tested = mine[metric.replace("nis.", "tested.")].to_numpy().astype(np.float64)[known]
                dof, count = 1, max(float(tested.sum()), 1.0)
            mean = float(values.mean())
            reach = float(stdtrit(n - 1, 0.975) * values.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan
            out.append(Consistency(name, metric, values, mean, mean - reach, mean + reach, (band(dof, count), band(dof, count, 0.999))))
    return out


# --- detection -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BySize:
    """Detection of one kind of fault by one estimator over its size.

    Attributes
    ----------
    estimator, sensor, kind
        Whose, and of what.
    size
        Magnitudes in SI units (n,): each that there is, or the medians of groups.
    faults, detected
        Numbers (n,).
    share
        Detected, with its exact 95 % interval, (n, 3).
    delay
        5, 25, 50, 75 and 95 % of the delays [s], (n, 5); NaN where nothing was detected.
    """

    estimator: str
    sensor: str
    kind: str
    size: FloatArray
    faults: NDArray[np.int64]
    detected: NDArray[np.int64]
    share: FloatArray
    delay: FloatArray


@dataclass(frozen=True)
class Curve:
    """Detected share of faults over the share of fault-free runs with a false alarm, as the threshold is raised.

    ``factor`` is that on the thresholds: 1 as run, from there on only what the events tell (an alarm that was never given has no
    statistic), infinity at the origin.
    """

    estimator: str
    factor: FloatArray
    false: FloatArray
    detected: FloatArray
    faults: int
    quiet_runs: int


def by_size(faults: pl.DataFrame) -> list[BySize]:
    """Detection over size, by sensor, kind and estimator; faults without a size are left out. Many sizes are put into `GROUPS` groups."""
    out = []
    for sensor, kind in sorted(set(faults.select("sensor", "kind").iter_rows())):
        every = faults.filter((faults["sensor"] == sensor) & (faults["kind"] == kind))
        for name in estimators(every):
            mine = of_estimator(every, name)
            size = np.abs(mine["size"].to_numpy().astype(np.float64))
            delay, hit = mine["delay"].to_numpy().astype(np.float64), mine["detected"].to_numpy() > 0.0
            known = np.isfinite(size)
            size, delay, hit = size[known], delay[known], hit[known]
            if not len(size):
                continue
            levels = np.unique(size)
            edges = levels if len(levels) <= LEVELS else np.unique(np.quantile(size, np.linspace(0.0, 1.0, GROUPS + 1)[:-1]))
            group = np.searchsorted(edges, size, side="right") - 1
            members = [group == g for g in range(len(edges))]
            n, k = [int(m.sum()) for m in members], [int(hit[m].sum()) for m in members]
            out.append(
                BySize(
                    name, sensor, kind, np.array([float(np.median(size[m])) for m in members]), np.array(n), np.array(k),
                    np.array([(b / a, *share_interval(b, a)) for a, b in zip(n, k, strict=True)]),
                    np.array([quartiles(delay[m]) for m in members]),
                )
            )  # fmt: skip
    return out


def roc(runs: pl.DataFrame, faults: pl.DataFrame) -> list[Curve]:
    """Operating curves by estimator, where there are faults, and runs without one."""
    out = []
    for name in estimators(runs):
        mine, theirs = of_estimator(runs, name), of_estimator(faults, name)
        mine = mine.filter((mine["status"] == DONE) & (mine["faults"] == 0.0)) if "faults" in mine.columns else mine.clear()
        if not len(mine) or not len(theirs):
            continue
        hits = _ratios(theirs, "ratio", "detected")
        alarms = _ratios(mine, "false_ratio", "false_alarms")
        steps = np.unique(np.r_[1.0, hits[np.isfinite(hits)], alarms[np.isfinite(alarms)]])
        steps = np.r_[steps[steps >= 1.0], math.inf]
        lost = np.array([float(np.mean(alarms >= k)) for k in steps])
        found = np.array([float(np.mean(hits >= k)) for k in steps])
        out.append(Curve(name, steps, lost, found, len(theirs), len(mine)))
    return out


def _ratios(table: pl.DataFrame, ratio: str, number: str) -> FloatArray:
    """Largest statistic over threshold; 1 for alarms that do not tell it, -inf without an alarm."""
    value = table[ratio].to_numpy().astype(np.float64) if ratio in table.columns else np.full(len(table), np.nan)
    alarmed = table[number].fill_null(0.0).to_numpy() > 0.0
    return np.where(alarmed, np.where(np.isfinite(value), np.maximum(value, 1.0), 1.0), -math.inf)


def label(sensor: str, axis: str | None) -> str:
    """``gyro.x``."""
    return f"{sensor}.{axis}" if axis else sensor


@dataclass(frozen=True)
class Confusion:
    """What was named for each part that failed: counts (rows, columns)."""

    estimator: str
    rows: list[str]
    columns: list[str]
    counts: NDArray[np.int64]


#: Columns of a confusion matrix that name no single part.
SEVERAL, ASTRAY, NOBODY, MISSED = "several, it too", "several, not it", "not isolated", "missed"


def confusion(faults: pl.DataFrame) -> list[Confusion]:
    """Isolation by estimator: a row a part that failed, a column a part that was named alone, and what else can be."""
    out = []
    for name in estimators(faults):
        cells: Counter[tuple[str, str]] = Counter()
        for sensor, axis, isolation, named in of_estimator(faults, name).select("sensor", "axis", "isolation", "named").iter_rows():
            said = named.split()
            if isolation == "missed":
                column = MISSED
            elif not said:
                column = NOBODY
            elif len(said) == 1:
                column = said[0]
            else:
                column = SEVERAL if isolation in ("right", "containing") else ASTRAY
            cells[label(sensor, axis), column] += 1
        rows = sorted({r for r, _ in cells})
        parts = sorted({c for _, c in cells} - {SEVERAL, ASTRAY, NOBODY, MISSED})
        ends = [c for c in (SEVERAL, ASTRAY, NOBODY, MISSED) if any(k == c for _, k in cells)]
        columns = [*(r for r in rows if r in parts), *(p for p in parts if p not in rows), *ends]
        counts = np.array([[cells[r, c] for c in columns] for r in rows], np.int64).reshape(len(rows), len(columns))
        out.append(Confusion(name, rows, columns, counts))
    return out
