"""One run of a campaign as a row of figures: errors after settling, consistency, detection, health. It runs and compares nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from haltere.flight.corrections import correct
from haltere.flight.door import Checked, fit
from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution
from haltere.metrics.consistency import BLOCKS, nees_series
from haltere.metrics.detection import STATE_CHANGES, Detections, detections
from haltere.metrics.errors import ANGLES, VECTORS, Series, error_series, largest, lengths, rms, settling_time, since

__all__ = ["BOUNDS", "ERRORS", "FAULT_COLUMNS", "METRICS", "OPEN", "row_of"]

DEG = math.pi / 180.0

#: Errors that are scored, with the units of the rows: degrees, m/s, m, rad/s, m/s^2.
ERRORS = tuple(
    [f"{name}_deg" for name in ANGLES] + [name for stem, axes in VECTORS.items() for name in (stem, *(f"{stem}_{a}" for a in axes))]
)
#: Errors whose settling is told, and within which bound.
BOUNDS = {
    "tilt_deg": 1.0, "heading_deg": 3.0, "vel": 0.5, "pos": 3.0, "wind": 1.0, "gyro_bias": 0.2 * DEG, "accel_bias": 0.1,
}  # fmt: skip
#: Metrics whose names are known before a run; and beginnings of names of those that depend on its sensors.
METRICS = (
    "aligned_at", "span", "rows", "discarded", *(f"{name}.{kind}" for name in ERRORS for kind in ("rms", "max")),
    *(f"{name}.settling" for name in BOUNDS), *(f"nees.{block}" for block in BLOCKS), "faults", "detected", "missed", "unseen",
    "false_alarms", "false_ratio", "quiet", *(f"events.{kind}" for kind in STATE_CHANGES),
)  # fmt: skip
OPEN = ("nis.", "tested.", "rejected.", "whiteness.")
#: Columns of the table of faults after those of the run and before those of the errors' recovery.
FAULT_COLUMNS = (
    "word", "sensor", "axis", "kind", "size", "start", "end", "detected", "delay", "isolation", "named", "isolation_delay", "ratio",
    "recovery",
)  # fmt: skip


def row_of(
    solution: Solution, flight: FlightLog, settle: float, hold: float, bounds: Mapping[str, float]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Figures of a run and of each fault that it could see.

    Parameters
    ----------
    solution
        Made with ``scored=False`` or not.
    flight
        As it was given to the run, with what was injected in ``meta.faults``.
    settle
        Time after the first row before anything is scored [s]; settling times count from the first row.
    hold
        Of `haltere.metrics.detection.detections`.
    bounds
        Bound of each error that settles, by the names and in the units of `BOUNDS`.

    Returns
    -------
    row : dict
        Metrics by name, floats and text. ``against`` says what the errors are against.
    faults : list of dict
        One each, with `FAULT_COLUMNS`.
    """
    summary = solution.summary
    begin, end = float(solution.t[0]), float(solution.t[-1])
    row: dict[str, Any] = {"aligned_at": begin, "span": end - begin, "rows": float(len(solution))}
    row["discarded"] = float(sum(sum(s["discarded"].values()) for s in summary["streams"].values()))
    against, reference = _reference(solution, flight)
    row["against"] = against
    series: Series = {}
    if reference is not None:
        series = error_series(solution, reference)
        series = _in_units(series | lengths(series))
        scored = since(series, begin + settle)
        for name in (n for n in ERRORS if n in scored):
            row[f"{name}.rms"] = rms(scored[name][1])
            row[f"{name}.max"] = largest(scored[name][1])
        for name, bound in bounds.items():
            if name in series:
                row[f"{name}.settling"] = settling_time(*series[name], bound, begin)
        if against == "truth":
            for block, (t, nees) in nees_series(solution, reference).items():
                late = t >= begin + settle
                if late.any():
                    row[f"nees.{block}"] = float(np.mean(nees[late]))
    for sensor, nis in summary["nis"].items():
        row[f"nis.{sensor}"] = nis["mean"]
        row[f"tested.{sensor}"] = float(nis["n"] - nis["rejected"] - nis["deweighted"])
        row[f"rejected.{sensor}"] = nis["rejected"] / nis["n"]
    for sensor, components in summary["whiteness"].items():
        row |= {f"whiteness.{sensor}.{component}": w["lag1"] for component, w in components.items()}
    row |= {f"health.{sensor}": h["verdict"] for sensor, h in summary["health"].items()}
    for kind in STATE_CHANGES:
        row[f"events.{kind}"] = float(sum(e["kind"] == kind for e in solution.events))
    found = detections(solution.events, flight.meta.faults, begin, end, hold)
    row |= {
        "faults": float(len(found.outcomes)), "detected": float(len(found.outcomes) - found.missed), "missed": float(found.missed),
        "unseen": float(found.unseen), "false_alarms": float(len(found.false_alarms)), "false_ratio": found.false_ratio,
        "quiet": found.quiet,
    }  # fmt: skip
    return row, _faults(found, series, bounds)


def _reference(solution: Solution, flight: FlightLog) -> tuple[str, Stream | None]:
    """Truth, else the autopilot's own solution, in our units and with rising times; nothing where neither is there."""
    for name in ("truth", "onboard"):
        stream = flight.get(name)
        if stream is not None and len(stream) > 1:
            alone = correct(FlightLog({name: stream}, flight.meta), solution.config.values)
            return name, fit(alone, Checked({}))[name]
    return "", None


def _in_units(series: Series) -> Series:
    """Angles in degrees under ``*_deg``."""
    return {f"{n}_deg" if n in ANGLES else n: (t, e / DEG if n in ANGLES else e) for n, (t, e) in series.items()}


def _faults(found: Detections, series: Series, bounds: Mapping[str, float]) -> list[dict[str, Any]]:
    """A row a fault; errors count from its start, and their return from its end."""
    out = []
    for o in found.outcomes:
        f = o.fault
        start, end = float(f["start"]), float(f.get("end", math.inf))
        row: dict[str, Any] = {
            "word": f["word"], "sensor": f["sensor"], "axis": f.get("axis", ""), "kind": f["kind"], "size": f.get("size", math.nan),
            "start": start, "end": end, "detected": float(o.detected), "delay": o.delay, "isolation": o.isolation or "missed",
            "named": " ".join(o.named), "isolation_delay": o.isolation_delay, "ratio": o.ratio, "recovery": o.recovery,
        }  # fmt: skip
        during = since(series, start, end)
        for name, bound in bounds.items():
            if name in during:
                row[f"{name}.max"] = largest(during[name][1])
            if name in series and math.isfinite(end):
                row[f"{name}.recovery"] = settling_time(*series[name], bound, end)
        out.append(row)
    return out
