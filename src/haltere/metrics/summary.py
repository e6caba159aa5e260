"""The summary of a run: streams, errors, consistency, health, timings, as in ``summary.json``. It runs nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere._version import __version__
from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution
from haltere.metrics.consistency import nees_series, nees_table, nis_table
from haltere.metrics.errors import error_series, error_table
from haltere.metrics.sensors import findings, sampling, sensor_table
from haltere.metrics.whiteness import whiteness_series, whiteness_table
from haltere.metrics.wind_quality import wind_table

__all__ = ["finite", "gaps_of", "summarise"]

#: What is said of a wind told for a flight of which none is estimated.
UNUSED_WIND = "the wind told from outside was not used: it takes rotors or an airspeed in the log, and an estimator with a wind"


def gaps_of(t: np.ndarray[Any, np.dtype[np.float64]]) -> int:
    """Number of intervals longer than four times the median, and than a tenth of a second."""
    if len(t) < 3:
        return 0
    dt = np.diff(t[np.isfinite(t)])
    if len(dt) == 0:
        return 0
    middle = float(np.median(dt))
    return int(np.count_nonzero(dt > max(4.0 * middle, 0.1)))


def _attitudes(stream: Stream) -> Stream:
    """The rows of a solution that hold its attitude: rows of several topics lie between each other, and have no rate together."""
    return stream.where(np.isfinite(stream["q_w"])) if "q_w" in stream else stream


def _timing(stream: Stream) -> dict[str, Any]:
    return {"rate": stream.rate, "gaps": gaps_of(stream.t), **sampling(stream.t)}


def finite(value: Any) -> Any:
    """The same with numbers that are not finite as None, for JSON."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


@np.errstate(all="ignore")  # what is near the end of the range is a damaged sample, and shows as such
def summarise(solution: Solution, flight: FlightLog, facts: dict[str, Any], scored: bool = True) -> None:
    """Fill ``solution.summary`` from the solution, the flight it is of, and what the run knows.

    Without ``scored`` it holds no errors and no NEES, of streams only counts, and nothing of what sensors show by themselves.
    Only here, after the run, are ``onboard`` and ``truth`` read.
    """
    meta = flight.meta
    summary = solution.summary
    summary["haltere"] = __version__
    summary["estimator"] = solution.config.estimator
    summary["preset"] = solution.config.preset
    summary["name"] = meta.name
    summary["source"] = meta.source
    summary["time_offset"] = meta.time_offset
    summary["start_utc"] = meta.start_utc
    summary["origin"] = facts["origin"]
    summary["aligned_at"] = float(solution.t[0])
    summary["duration"] = facts["duration"]
    summary["rows"] = len(solution)
    summary["streams"] = {
        name: {"n": len(stream), **(_timing(_attitudes(stream)) if scored else {}), "discarded": facts["discarded"].get(name, {})}
        for name, stream in flight.streams.items()
    }
    references = [name for name in ("truth", "onboard") if name in flight and len(flight[name])] if scored else []
    summary["errors"] = {name: error_table(error_series(solution, flight[name])) for name in references}
    summary["nis"] = nis_table(solution)
    summary["whiteness"] = whiteness_table(whiteness_series(solution))
    summary["nees"] = nees_table(nees_series(solution, flight["truth"])) if "truth" in references else {}
    if solution.smoothed is not None:
        solution.smoothed.summary["origin"] = facts["origin"]
        summary["smoothed"] = {
            "errors": {name: error_table(error_series(solution.smoothed, flight[name])) for name in references},
            "nees": nees_table(nees_series(solution.smoothed, flight["truth"])) if "truth" in references else {},
        }
    summary["health"] = _health(solution, flight)
    summary["sensors"] = sensor_table(solution, flight) if scored else {}
    wind = wind_table(solution, flight) if scored else {}
    if wind:
        summary["wind"] = wind
    summary["findings"] = findings(summary["sensors"])
    summary["diagnosis"] = _diagnosis(solution, facts)
    unused = "wind" in flight and len(flight["wind"]) > 0 and "wind_n" not in solution
    summary["warnings"] = facts["warnings"] + ([UNUSED_WIND] if unused else [])
    summary["timings"] = facts["timings"]
    solution.summary = finite(summary)


def _diagnosis(solution: Solution, facts: dict[str, Any]) -> dict[str, Any]:
    """Whether axes of the IMU were diagnosed, for how long what was measured allowed a verdict [s], and what was named."""
    if facts.get("watched") is None:
        return {"inertial": "off"}
    named = [e for e in solution.events if e["sensor"] in ("gyro", "accel") and e["t_isolated"] is not None]
    axes = list(dict.fromkeys(c for e in named for c in e["candidates"] if c.startswith(("gyro.", "accel."))))  # of the unit that is used
    return {
        "inertial": "on",
        "judged_s": round(facts["watched"], 1),
        "of_s": round(float(solution.t[-1] - solution.t[0]), 1),
        "named": axes,
    }


def _health(solution: Solution, flight: FlightLog) -> dict[str, dict[str, str]]:
    """What the innovations say of each sensor that was fused; diagnosis proper is another room's work."""
    out: dict[str, dict[str, str]] = {}
    for sensor in ("gnss", "magnetometer", "barometer"):
        if sensor not in flight or sensor not in solution.summary["nis"]:
            continue
        nis = solution.summary["nis"][sensor]
        bad = nis["lost"]
        forced = any(e["kind"] == "timeout" and e["sensor"] == sensor for e in solution.events)
        if forced or bad > 0.2:
            verdict = "bad"
        elif bad > 0.02:
            verdict = "doubtful"
        else:
            verdict = "good"
        out[sensor] = {"verdict": verdict, "why": f"{100.0 * bad:.1f} % of the weight of {nis['n']} components refused or taken off"}
    return out
