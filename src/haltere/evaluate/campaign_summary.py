"""The summary of a campaign, as in ``summary.json``. It makes no runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from haltere._version import __version__
from haltere.evaluate.campaign_plan import Plan
from haltere.evaluate.campaign_require import POOLED, Verdict, pooled
from haltere.evaluate.campaign_row import METRICS
from haltere.metrics.campaign import DONE, consistency, estimators, of_estimator, spread
from haltere.metrics.summary import finite

if TYPE_CHECKING:
    import polars as pl

__all__ = ["summary"]

#: Most different reasons of failure that a summary lists.
REASONS = 20


def summary(
    plan: Plan, runs: pl.DataFrame, faults: pl.DataFrame, verdicts: Sequence[Verdict], notes: Sequence[str], timings: Mapping[str, Any]
) -> dict[str, Any]:
    """As in ``summary.json``; but for ``timings`` and ``notes`` it does not depend on how the runs were made."""
    names = estimators(runs)
    status = Counter(runs["status"].to_list())
    reasons = Counter(e for e in runs["error"].to_list() if e)
    metrics: dict[str, Any] = {}
    for name in names:
        mine = of_estimator(runs, name)
        numeric = [c for c in mine.columns if c in METRICS and mine[c].dtype.is_float() and c not in ("rows", "faults")]
        metrics[name] = {c: spread(mine[c].to_numpy().astype(np.float64)) for c in numeric if mine[c].null_count() < len(mine)}
    detection: dict[str, Any] = {}
    for name in names:
        detection[name] = {}
        for key in POOLED:
            value, interval, counts = pooled(key, of_estimator(runs, name), of_estimator(faults, name))
            detection[name][key] = {"value": value, "interval": list(interval), "counts": counts}
    met = all(v.met for v in verdicts)
    out = {
        "haltere": __version__, "name": plan.name, "runs": len(plan.runs), "done": status.get(DONE, 0),
        "failed": len(runs) - status.get(DONE, 0), "missing": len(plan.runs) - len(runs), "same": plan.same,
        "failures": dict(reasons.most_common(REASONS)), "settle": plan.settle, "hold": plan.hold, "bounds": dict(plan.bounds),
        "factors": {c: sorted({str(r.factors.get(c)) for r in plan.runs}) if c in plan.varied else str(plan.runs[0].factors.get(c))
                    for c in plan.factors if c not in ("seed", *_continuous(plan))},
        "varied": list(plan.varied), "verdict": "none" if not verdicts else "passed" if met else "failed",
        "requirements": [v.as_table() for v in verdicts],
        "metrics": metrics, "detection": detection,
        "consistency": [
            {"estimator": c.estimator, "metric": c.metric, "mean": c.mean, "interval": [c.low, c.high], "band95": list(c.bands[0]),
             "band999": list(c.bands[1]), "runs": len(c.values), "verdict": c.verdict} for c in consistency(runs)
        ],
        "notes": list(notes), "timings": dict(timings),
    }  # fmt: skip
    result: dict[str, Any] = finite(out)
    return result


def _continuous(plan: Plan) -> list[str]:
    """Factors with more values than a list should have."""
    return [c for c in plan.factors if len({repr(r.factors.get(c)) for r in plan.runs}) > 50]
