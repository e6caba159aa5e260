"""What a disturbed compass did: how far off it was, when it came back, what it followed, and what it would have done to the heading.

It judges nothing: that a compass is disturbed is the filter's own finding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.load import series
from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.metrics.magnetism import clean

__all__ = ["describe", "disturbances"]

FloatArray = NDArray[np.float64]

#: Correlation from which on a disturbance is said to follow something, and how many samples that takes.
FOLLOWS, SAMPLES = 0.7, 20
#: Seconds before the onset and after the end that are looked at too, and the longest stretch looked at.
AROUND, LONGEST = 10.0, 60.0
#: Two disturbances within this distance [m] are at one place.
SAME_PLACE = 5.0


def disturbances(events: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The events that put the compass out."""
    return [e for e in events if e["sensor"] == "magnetometer" and e["kind"] == "disturb"]


def describe(solution: Solution, flight: FlightLog, unwatched: FloatArray | None = None) -> None:
    """Complete the events of a disturbed compass, in place: ``t_recovered`` and what the evidence adds.

    Parameters
    ----------
    solution
        With its events and aid records.
    flight
        For current, throttle and specific force.
    unwatched
        Heading [rad] of the same run, (n,) at the solution's times, of a filter that goes on hearing the compass; None where there is none.
    """
    found = disturbances(solution.events)
    if not found:
        return
    a = solution.aids
    mine = (a["sensor"] == "magnetometer") & np.isfinite(a["innovation"]) & (a["component"] == "heading")
    t, off = a["t"][mine], np.degrees(a["innovation"][mine])
    loads = _loads(solution, flight)
    places: list[tuple[float, FloatArray]] = []
    for e in found:
        back = [x["t_detected"] for x in solution.events if x["sensor"] == "magnetometer" and x["kind"] in ("recovered", "timeout")]
        e["t_recovered"] = min((x for x in back if x > e["t_detected"]), default=None)
        end = e["t_recovered"] if e["t_recovered"] is not None else float(solution.t[-1])
        words = [e["evidence"]]
        during = (t >= e["t_onset"]) & (t <= end)
        if during.any():
            words.append(f"up to {np.abs(off[during]).max():.0f} deg off the heading held")
        if unwatched is not None and (rows := (solution.t >= e["t_onset"]) & (solution.t <= end)).any():
            turn = np.degrees(np.abs((unwatched[rows] - _yaw(solution)[rows] + np.pi) % (2.0 * np.pi) - np.pi)).max()
            words.append(f"heard on it would have turned the heading by up to {turn:.0f} deg")
        window = (t >= e["t_onset"] - AROUND) & (t <= min(end + AROUND, e["t_onset"] + LONGEST))
        follows = [name for name, tl, x in loads if _follow(t[window], off[window], tl, x)]
        if follows:
            words.append("it follows " + " and ".join(follows))
        if "pos_n" in solution.table:
            at = np.array([np.interp(e["t_onset"], solution.t, solution[f"pos_{k}"]) for k in "ned"])
            north, east, up = (round(float(x)) + 0 for x in (at[0], at[1], -at[2]))
            words.append(f"began at {north} m north, {east} m east, {up} m up")
            again = [f"{t0:.1f}" for t0, p in places if float(np.linalg.norm(p - at)) < SAME_PLACE]
            if again:
                words.append(f"the place of that at {', '.join(again)} s")
            places.append((e["t_onset"], at))
        e["evidence"] = "; ".join(words)


def _yaw(solution: Solution) -> FloatArray:
    w, x, y, z = (solution[f"q_{k}"] for k in "wxyz")
    return np.asarray(np.arctan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z))


def _loads(solution: Solution, flight: FlightLog) -> list[tuple[str, FloatArray, FloatArray]]:
    """What a disturbance may follow: name, times and values."""
    out: list[tuple[str, FloatArray, FloatArray]] = []
    for word, name in (("current", "the battery current"), ("throttle", "the throttle")):
        found = series(flight, word)
        if found is not None:
            out.append((name, *found))
    imu = flight["imu"]
    ti, force = clean(imu.t, np.linalg.norm(imu.vector("accel"), axis=1)[:, None])
    out.append(("the thrust", ti, force[:, 0]))
    if "pos_d" in solution.table:
        out.append(("the height", solution.t, -solution["pos_d"]))
    return out


def _follow(t: FloatArray, off: FloatArray, tl: FloatArray, x: FloatArray) -> bool:
    """Whether the compass error is correlated with a load, both as means of half a second."""
    if len(t) < SAMPLES or len(tl) < SAMPLES:
        return False
    edges = np.arange(t[0], t[-1] + 0.5, 0.5)
    means = []
    for times, values in ((t, off), (tl, x)):
        number = np.histogram(times, edges)[0]
        means.append(np.where(number > 0, np.histogram(times, edges, weights=values)[0] / np.maximum(number, 1), np.nan))
    both = np.isfinite(means[0]) & np.isfinite(means[1])
    if both.sum() < SAMPLES or min(float(np.ptp(m[both])) for m in means) <= 0.0:
        return False
    return bool(abs(np.corrcoef(means[0][both], means[1][both])[0, 1]) > FOLLOWS)
