"""Were injected faults detected, when, and was the right part named? Counted from events against what was injected. It detects nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

__all__ = [
    "HOLD",
    "ISOLATIONS",
    "STATE_CHANGES",
    "Detections",
    "Outcome",
    "alarms",
    "detections",
    "names",
    "poisson_interval",
    "share_interval",
]

Event = Mapping[str, Any]

#: Kinds of event that are no claim of a fault.
STATE_CHANGES = ("aligned", "realigned", "reset", "timeout", "gap", "recovered", "diverged")
#: An alarm so long [s] after the end of a fault is still of that fault.
HOLD = 5.0
#: How well a detected fault was isolated: named alone, named among others, others named, nothing named.
ISOLATIONS = ("right", "containing", "wrong", "none")
#: Sensors that are one part of others.
_PARTS = {"imu": ("imu", "gyro", "accel"), "rotor": ("rotor", "rotors"), "rotors": ("rotors", "rotor")}


@dataclass(frozen=True)
class Outcome:
    """What became of one injected fault.

    Attributes
    ----------
    fault
        As in ``[[fault]]`` of ``flight.toml``.
    delay
        From its start to the first alarm [s]; NaN where it was missed.
    isolation
        One of `ISOLATIONS`; empty where it was missed.
    named
        The candidates that were named.
    isolation_delay
        From its start to the isolation [s]; NaN without one.
    ratio
        Largest statistic over its threshold among its alarms; NaN where no alarm has both.
    recovery
        From its end, or from its detection where it lasts, to the recovery that the alarm states [s]; NaN without one.
    """

    fault: Mapping[str, Any]
    delay: float
    isolation: str
    named: tuple[str, ...]
    isolation_delay: float
    ratio: float
    recovery: float

    @property
    def detected(self) -> bool:
        """Whether there was an alarm."""
        return math.isfinite(self.delay)


@dataclass(frozen=True)
class Detections:
    """Outcomes of a run: each fault that was there to be seen, false alarms, and the time without a fault in which they could come.

    Attributes
    ----------
    outcomes
        In the order of the faults' starts.
    unseen
        Faults that ended before the solution began or began after its end: they count nowhere.
    false_alarms
        Alarms outside every fault and its hold.
    false_ratio
        Largest statistic over threshold among them; NaN where none has both.
    quiet
        Time without a fault [s].
    """

    outcomes: tuple[Outcome, ...]
    unseen: int
    false_alarms: tuple[Event, ...]
    false_ratio: float
    quiet: float

    @property
    def missed(self) -> int:
        """Number of faults without an alarm."""
        return sum(not o.detected for o in self.outcomes)


def alarms(events: Sequence[Event]) -> list[Event]:
    """Events that claim a fault, by the time of detection; state changes (`STATE_CHANGES`) do not."""
    claims = [e for e in events if e["kind"] not in STATE_CHANGES and _time(e, "t_detected") is not None]
    return sorted(claims, key=lambda e: float(e["t_detected"]))


def _time(event: Event, key: str) -> float | None:
    value = event.get(key)
    return float(value) if value is not None and math.isfinite(value) else None


def _ratio(event: Event) -> float:
    """Statistic over threshold; NaN where one is missing."""
    statistic, threshold = event.get("statistic"), event.get("threshold")
    if statistic is None or not threshold or not math.isfinite(statistic) or not math.isfinite(threshold):
        return math.nan
    return abs(float(statistic) / float(threshold))


def _largest(events: Sequence[Event]) -> float:
    return max((r for r in map(_ratio, events) if math.isfinite(r)), default=math.nan)


def names(event: Event) -> tuple[str, ...]:
    """Candidates of an event; else its own sensor and axis, if that is isolated."""
    if event.get("candidates"):
        return tuple(str(c) for c in event["candidates"])
    if _time(event, "t_isolated") is None or event["sensor"] == "filter":
        return ()
    return (event["sensor"] if event.get("axis") is None else f"{event['sensor']}.{event['axis']}",)


def _is(candidate: str, fault: Mapping[str, Any]) -> str:
    """``right``, ``wider`` (the sensor without the axis that fails) or empty: what a candidate is to a fault."""
    sensor, *parts = candidate.split(".")
    if sensor not in _PARTS.get(fault["sensor"], (fault["sensor"],)):
        return ""
    axis = fault.get("axis")
    if axis is None or str(axis) in parts:
        return "right"
    return "wider" if not parts else ""


def _isolation(event: Event, fault: Mapping[str, Any]) -> str:
    named = names(event)
    if not named:
        return "none"
    found = [_is(c, fault) for c in named]
    if all(f == "right" for f in found):
        return "right"
    return "containing" if any(found) else "wrong"


def detections(events: Sequence[Event], faults: Sequence[Mapping[str, Any]], begin: float, end: float, hold: float = HOLD) -> Detections:
    """Set the alarms of a run against the faults that were injected.

    Parameters
    ----------
    events
        As in ``events.json``.
    faults
        As in ``flight.meta.faults``: ``sensor``, ``axis``, ``start``, ``end`` and what else is to be passed on.
    begin, end
        First and last time of the solution [s].
    hold
        An alarm so long after the end of a fault is still of that fault [s].

    Returns
    -------
    Detections
        The first alarm from a fault's start to its end and hold detects it. Where several faults last, an alarm is of those it names,
        else of the one that began last. Alarms of a fault that is already detected are neither more detections nor false. Alarms before
        the start are false, and a fault that runs on leaves no time without one.

    Notes
    -----
    A fault counts from the later of its start and ``begin``. Isolation is that of the first of its alarms that is isolated or names
    candidates; an axis that is not named makes ``containing`` of ``right``.
    """
    seen = sorted((f for f in faults if f["start"] < end and f.get("end", math.inf) > begin), key=lambda f: float(f["start"]))
    spans = [(max(float(f["start"]), begin), float(f.get("end", math.inf)) + hold) for f in seen]
    mine: list[list[Event]] = [[] for _ in seen]
    false: list[Event] = []
    for event in alarms(events):
        t = float(event["t_detected"])
        active = [k for k, (a, b) in enumerate(spans) if a <= t <= b]
        if not active:
            false.append(event)
            continue
        named = [k for k in active if any(_is(c, seen[k]) for c in names(event))]
        mine[(named or active)[-1]].append(event)
    outcomes = tuple(_outcome(f, span[0], es) for f, span, es in zip(seen, spans, mine, strict=True))
    return Detections(outcomes, len(faults) - len(seen), tuple(false), _largest(false), _quiet(spans, begin, end))


def _outcome(fault: Mapping[str, Any], start: float, events: list[Event]) -> Outcome:
    if not events:
        return Outcome(fault, math.nan, "", (), math.nan, math.nan, math.nan)
    first = events[0]
    telling = next((e for e in events if _time(e, "t_isolated") is not None), next((e for e in events if names(e)), first))
    isolated = _time(telling, "t_isolated")
    detected = float(first["t_detected"])
    recovered = next((t for e in events if (t := _time(e, "t_recovered")) is not None), None)
    since = float(fault["end"]) if math.isfinite(fault.get("end", math.inf)) else detected
    return Outcome(
        fault, detected - start, _isolation(telling, fault), names(telling), math.nan if isolated is None else isolated - start,
        _largest(events), math.nan if recovered is None else max(recovered - since, 0.0),
    )  # fmt: skip


def _quiet(spans: Sequence[tuple[float, float]], begin: float, end: float) -> float:
    """Time from ``begin`` to ``end`` in none of the spans."""
    free, at = 0.0, begin
    for a, b in sorted(spans):
        free += max(min(a, end) - at, 0.0)
        at = max(at, b)
    return free + max(end - at, 0.0)


def poisson_interval(n: int, exposure: float, probability: float = 0.95) -> tuple[float, float]:
    """Exact confidence interval of a rate from a count (F. Garwood, Biometrika 28, 1936), events a unit of exposure.

    The lower end is 0 for no event; both ends are NaN and infinite for no exposure.
    """
    from scipy.special import gammaincinv

    if not exposure > 0.0:
        return math.nan, math.inf
    tail = 0.5 * (1.0 - probability)
    low = float(gammaincinv(n, tail)) if n else 0.0
    return low / exposure, float(gammaincinv(n + 1, 1.0 - tail)) / exposure


def share_interval(k: int, n: int, probability: float = 0.95) -> tuple[float, float]:
    """Exact confidence interval of a probability from k of n (C. J. Clopper and E. S. Pearson, Biometrika 26, 1934); 0 to 1 for n = 0."""
    from scipy.special import betaincinv

    tail = 0.5 * (1.0 - probability)
    low = float(betaincinv(k, n - k + 1, tail)) if k else 0.0
    return low, float(betaincinv(k + 1, n - k, 1.0 - tail)) if k < n else 1.0
