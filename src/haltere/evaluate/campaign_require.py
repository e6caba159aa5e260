"""Requirements on a campaign and their verdicts: a statistic of a metric over some runs against a limit. It makes no runs."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from haltere.errors import UsageError, nearest
from haltere.evaluate.campaign_row import METRICS, OPEN
from haltere.metrics.consistency import DOF, band
from haltere.metrics.detection import poisson_interval, share_interval

if TYPE_CHECKING:
    import polars as pl

__all__ = ["POOLED", "Requirement", "Verdict", "judge", "pooled", "requirements"]

#: Metrics of all runs together, with what they are.
POOLED = {
    "detection_rate": "share of the faults that were detected",
    "isolation_rate": "share of the faults that were detected and named alone",
    "containing_rate": "share of the faults that were detected and named, alone or among others",
    "false_alarms_per_hour": "false alarms an hour without a fault",
    "failure_rate": "share of the runs that failed",
}
STATISTICS = ("mean", "median", "max", "min", "fraction", "band")
KEYS = ("metric", "limit", "least", "statistic", "share", "probability", "confident", "where", "ignore_failed")


@dataclass(frozen=True)
class Requirement:
    """What is asked of a campaign.

    Attributes
    ----------
    metric
        Column of the results, or one of `POOLED`.
    statistic
        ``mean, median, max, min, p0 ... p100``; ``fraction`` of the runs whose metric keeps the limit; ``band``: the mean over runs lies
        in the interval of that many independent chi-square samples (NEES and NIS). Empty for `POOLED`.
    limit, least
        Largest and least value that is allowed; None: any.
    share
        Least share of the runs, for ``fraction``.
    probability
        Of the band, and of the interval of a confident verdict.
    confident
        For `POOLED`: the end of the confidence interval counts, not the estimate.
    where
        Values of factors that a run must have.
    ignore_failed
        Leave out runs that failed; otherwise each counts as the worst value there is.
    """

    metric: str
    statistic: str = "max"
    limit: float | None = None
    least: float | None = None
    share: float = 1.0
    probability: float = 0.95
    confident: bool = False
    where: Mapping[str, Any] = field(default_factory=dict)
    ignore_failed: bool = False

    @property
    def words(self) -> str:
        """The requirement in words."""
        name = self.metric if not self.statistic else f"{self.statistic} of {self.metric}"
        bounds = [f"at most {self.limit:g}"] if self.limit is not None else []
        bounds += [f"at least {self.least:g}"] if self.least is not None else []
        asked = " and ".join(bounds)
        if self.statistic == "fraction":
            name, asked = self.metric, f"{asked} in {100.0 * self.share:g} % of the runs"
        elif self.statistic == "band":
            name, asked = f"mean of {self.metric}", f"in its {100.0 * self.probability:g} % band"
        if self.confident:
            asked += f" with {100.0 * self.probability:g} % confidence"
        if self.where:
            asked += " where " + ", ".join(f"{k} = {_listed(v)}" for k, v in self.where.items())
        return f"{name} {asked}"


def _listed(value: Any) -> str:
    return " or ".join(str(v) or "none" for v in (value if isinstance(value, list) else [value]))


@dataclass(frozen=True)
class Verdict:
    """A requirement judged: whether it is met, the value, its interval or band, over how many runs, and a sentence."""

    requirement: Requirement
    met: bool
    value: float
    interval: tuple[float, float] | None
    runs: int
    failed: int
    sentence: str

    def as_table(self) -> dict[str, Any]:
        """As in ``summary.json``."""
        r = self.requirement
        return {
            "requirement": r.words, "metric": r.metric, "statistic": r.statistic, "limit": r.limit, "least": r.least,
            "where": dict(r.where), "met": self.met, "value": self.value, "interval": list(self.interval) if self.interval else None,
            "runs": self.runs, "failed": self.failed, "verdict": self.sentence,
        }  # fmt: skip


def requirements(tables: Any, factors: Sequence[str], where: str) -> list[Requirement]:
    """Requirements from the ``[[require]]`` tables of a specification.

    Raises
    ------
    UsageError
        A key, metric, statistic or factor that is not one (with the nearest name), or a limit that is missing.
    """
    if not isinstance(tables, list) or not all(isinstance(t, Mapping) for t in tables):
        raise UsageError("tables [[require]]", repr(tables), where)
    return [_requirement(dict(t), factors, f"{where}: [[require]]") for t in tables]


def _requirement(table: dict[str, Any], factors: Sequence[str], where: str) -> Requirement:
    for key in table:
        if key not in KEYS:
            raise UsageError(f"keys {', '.join(KEYS)}", repr(key), where, nearest(key, KEYS))
    metric = table.get("metric")
    if not isinstance(metric, str) or not (metric in METRICS or metric in POOLED or metric.startswith(OPEN)):
        known = [*METRICS, *POOLED]
        raise UsageError("a metric", repr(metric), where, nearest(str(metric), known) or "such as tilt_deg.rms")
    at = f"{where} {metric}"
    numbers: dict[str, float] = {k: _number(v, k, at) for k, v in table.items() if k in ("limit", "least", "share", "probability")}
    for key in ("share", "probability"):
        if not 0.0 <= numbers.get(key, 0.5) <= 1.0:
            raise UsageError(f"{key} between 0 and 1", f"{numbers[key]:g}", at)
    for key in ("confident", "ignore_failed"):
        if not isinstance(table.get(key, False), bool):
            raise UsageError(f"true or false for {key}", repr(table[key]), at)
    statistic = table.get("statistic", "" if metric in POOLED else "max")
    if metric in POOLED:
        if statistic:
            raise UsageError("no statistic, as it is one of all runs together", repr(statistic), at)
    elif statistic not in STATISTICS and not _percentile(statistic):
        raise UsageError(f"a statistic ({', '.join(STATISTICS)}, p95)", repr(statistic), at, nearest(str(statistic), STATISTICS))
    if statistic == "band" and not metric.startswith(("nees.", "nis.")):
        raise UsageError("a metric nees.* or nis.* for the statistic band", repr(metric), at)
    if statistic != "band" and "limit" not in numbers and "least" not in numbers:
        raise UsageError("limit (largest value) or least (least value)", "neither", at)
    if table.get("confident") and metric not in POOLED:
        raise UsageError("confident for shares and rates", repr(metric), at, f"these are {', '.join(POOLED)}")
    chosen = table.get("where", {})
    if not isinstance(chosen, Mapping):
        raise UsageError("a table where", repr(chosen), at)
    flat = dict(_flat(chosen))
    for key in flat:
        if key not in factors:
            raise UsageError(f"a factor of this campaign ({', '.join(factors)})", repr(key), f"{at}: where", nearest(key, factors))
    return Requirement(
        metric, statistic, numbers.get("limit"), numbers.get("least"), numbers.get("share", 1.0), numbers.get("probability", 0.95),
        table.get("confident", False), flat, table.get("ignore_failed", False),
    )  # fmt: skip


def _flat(table: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for key, value in table.items():
        out += _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [(f"{prefix}{key}", value)]
    return out


def _number(value: Any, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UsageError(f"a number for {key}", repr(value), where)
    return float(value)


def _percentile(statistic: Any) -> float | None:
    found = re.fullmatch(r"p(\d+(?:\.\d+)?)", str(statistic))
    return float(found[1]) if found is not None and float(found[1]) <= 100.0 else None


# --- verdicts ------------------------------------------------------------------------------------------------------------


def pooled(metric: str, runs: pl.DataFrame, faults: pl.DataFrame, probability: float = 0.95) -> tuple[float, tuple[float, float], str]:
    """Value, exact confidence interval and counts in words of a metric of `POOLED` over some runs and their faults."""
    if metric == "false_alarms_per_hour":
        n = round(float(runs["false_alarms"].fill_null(0.0).sum())) if "false_alarms" in runs else 0
        hours = float(runs["quiet"].fill_null(0.0).sum()) / 3600.0 if "quiet" in runs else 0.0
        return n / hours if hours > 0.0 else math.nan, poisson_interval(n, hours, probability), f"{n} in {hours:.3g} h"
    if metric == "failure_rate":
        k, n = int((runs["status"] != "done").sum()), len(runs)
    else:
        n = len(faults)
        good = {"isolation_rate": ("right",), "containing_rate": ("right", "containing")}.get(metric)
        k = int(faults["isolation"].is_in(good).sum() if good else (faults["detected"] == 1.0).sum()) if n else 0
    return k / n if n else math.nan, share_interval(k, n, probability), f"{k} of {n}"


def _chosen(table: pl.DataFrame, where: Mapping[str, Any]) -> pl.DataFrame:
    """Rows whose factors have these values."""
    keep = np.ones(len(table), bool)
    for key, value in where.items():
        wanted = value if isinstance(value, list) else [value]
        cells = table[key].to_list() if key in table.columns else [None] * len(table)
        keep &= np.array([any(c == w or str(c) == str(w) for w in wanted) for c in cells], bool)
    return table.filter(keep)


def judge(requirement: Requirement, runs: pl.DataFrame, faults: pl.DataFrame) -> Verdict:
    """Verdict over the tables of a campaign.

    Parameters
    ----------
    requirement
        What is asked.
    runs
        One row a run, with its factors, ``status`` and metrics.
    faults
        One row a fault that a run could see, with the run's factors.
    """
    r = requirement
    runs, faults = _chosen(runs, r.where), _chosen(faults, r.where)
    failed = int((runs["status"] != "done").sum()) if len(runs) else 0
    interval: tuple[float, float] | None = None
    if not len(runs):
        return _said(r, math.nan, None, 0, 0, False, "no run is like that")
    if r.metric in POOLED:
        value, interval, counts = pooled(r.metric, runs, faults, r.probability)
        low, high = interval if r.confident else (value, value)
        met = _kept(low, high, r) and math.isfinite(value)
        lost = bool(failed) and not r.ignore_failed and r.metric != "failure_rate"
        note = counts + (f", and {failed} runs failed" if lost else "")
        return _said(r, value, interval, len(runs), failed, met and not lost, note)
    done = runs.filter(runs["status"] == "done")
    values = done[r.metric].drop_nulls().to_numpy().astype(np.float64) if r.metric in done.columns and len(done) else np.empty(0)
    missing = len(done) - len(values)
    if not len(values):
        return _said(r, math.nan, None, len(runs), failed, False, "no run has this metric")
    bad = (0 if r.ignore_failed else failed) + missing
    note = ", ".join([*([f"{failed} failed"] if failed else []), *([f"{missing} without a value"] if missing else [])])
    if r.statistic == "band":
        dof = DOF.get(r.metric.removeprefix("nees."), 1)
        value, interval = float(np.mean(values)), band(dof, len(values), r.probability)
        return _said(r, value, interval, len(runs), failed, interval[0] <= value <= interval[1] and not bad, note)
    if r.statistic == "fraction":
        good = int(np.count_nonzero([_kept(v, v, r) for v in values]))
        value = good / (len(values) + bad)
        return _said(r, value, None, len(runs), failed, value >= r.share - 1e-12, note)
    # what has no value is as bad as can be: infinite against a limit, and as small against a least value
    worst = math.inf if r.limit is not None else -math.inf
    value = _statistic(r.statistic, np.r_[values, np.full(bad, worst)])
    return _said(r, value, None, len(runs), failed, _kept(value, value, r), note)


def _statistic(name: str, values: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    if name in ("mean", "max", "min"):
        return float(getattr(np, name)(values))
    rank = 50.0 if name == "median" else _percentile(name) or 0.0
    ordered = np.sort(values)
    x = rank / 100.0 * (len(ordered) - 1)
    i, f = int(x), x - int(x)
    return float(ordered[i] if f == 0.0 else (1.0 - f) * ordered[i] + f * ordered[i + 1])


def _kept(low: float, high: float, r: Requirement) -> bool:
    return (r.limit is None or high <= r.limit) and (r.least is None or low >= r.least)


def _said(r: Requirement, value: float, interval: tuple[float, float] | None, runs: int, failed: int, met: bool, note: str = "") -> Verdict:
    """The verdict with its sentence."""
    if not math.isfinite(value):
        found = "–" if math.isnan(value) else "beyond every limit"
    elif r.statistic == "fraction":
        found = f"{100.0 * value:.3g} %"
    else:
        found = f"{value:.4g}"
    extra = f" ({interval[0]:.4g} to {interval[1]:.4g})" if interval is not None and math.isfinite(value) else ""
    over = f"{runs} run{'s' if runs != 1 else ''}{f', {note}' if note else ''}"
    return Verdict(r, met, value, interval, runs, failed, f"{'met' if met else 'not met'}: {r.words}; found {found}{extra} over {over}")
