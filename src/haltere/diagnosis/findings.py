"""What diagnosis found, as the events that a reader sees: sensor, axis, kind, size, candidates, evidence in words. It decides nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere.diagnosis.inertial import FAMILIES
from haltere.diagnosis.model_faults import MODEL
from haltere.diagnosis.model_findings import detectors, of_the_model
from haltere.diagnosis.steps import DEATHS, STEP

__all__ = ["findings"]

#: Kind, unit and its factor of every signature, by groups of three; then compass and barometer.
_KINDS = (
    ("bias", "deg/s", math.degrees(1.0)),
    ("bias", "m/s²", 1.0),
    ("ramp", "deg/s per s", math.degrees(1.0)),
    ("ramp", "m/s² per s", 1.0),
    ("bias", "m/s", 1.0),
    ("bias", "m", 1.0),
)
#: A verdict is revised within this time [s].
REVISED = 10.0
_LAST = (("disturb", "deg", math.degrees(1.0)), ("bias", "m", 1.0), ("disturb", "deg", math.degrees(1.0)))


def _of(fault: int) -> tuple[int, tuple[str, str, float]]:
    """Family of a signature, and its kind, unit and factor."""
    if fault >= 18:
        return (12, 13, 12)[fault - 18], _LAST[fault - 18]
    return fault - 6 if fault >= 6 else fault, _KINDS[fault // 3]


def findings(kind: str, record: np.void, events: list[dict[str, Any]]) -> None:
    """Append a finding to the events, or complete the one that told of it before as one of several."""
    if int(record["detail"]) >= MODEL:
        if (gyro := of_the_model(kind, record, events)) is not None:
            _revise(events, gyro)
        return
    if int(record["detail"]) >= STEP:
        _of_samples(kind, record, events)
        return
    family, (fault, unit, factor) = _of(int(record["detail"]))
    sensor, _, axis = FAMILIES[family].partition(".")
    named = [name for g, name in enumerate(FAMILIES) if int(record["candidates"]) >> g & 1]
    candidates = sorted(set(named), key=named.index)
    size, sd = float(record["size"]) * factor, float(record["sd"]) * factor
    what = {6: "velocity ", 7: "velocity ", 8: "velocity ", 9: "position ", 10: "position ", 11: "position "}.get(family, "")
    evidence = f"{what}{size:+.3g} ± {sd:.2g} {unit} explains the innovations since {float(record['onset']):.2f} s"
    evidence += f" and leaves {max(float(record['left']), 0.0):.0%} as much unexplained"
    for said, how in zip(detectors(record, 6), ("", " silent"), strict=True):
        evidence += f"; {said}{how}" if said else ""
    isolated = kind == "fault"
    if isolated:
        done = "its effect was taken back" if sensor in ("gyro", "accel", "barometer") else "its effect was taken back; it is not heard"
        evidence += f"; {done}"
    else:
        evidence += f"; so may {' or '.join(c for c in candidates if c != FAMILIES[family])}"
    out = {
        "sensor": sensor, "axis": axis or None, "kind": fault, "t_onset": min(float(record["onset"]), float(record["seen"])),
        "t_detected": float(record["seen"]), "t_isolated": float(record["t"]) if isolated else None, "t_recovered": None,
        "candidates": candidates,
        "statistic": float(record["value"]), "threshold": float(record["threshold"]), "evidence": evidence,
    }  # fmt: skip
    told = next((e for e in reversed(events) if _suspected(e) and set(candidates) & set(e["candidates"])), None)
    if isolated and told is not None and out["t_isolated"] - told["t_detected"] < REVISED:
        out["t_detected"], out["t_onset"] = told["t_detected"], min(out["t_onset"], told["t_detected"])
        events[events.index(told)] = out
    else:
        events.append(out)
    if isolated and sensor in ("gyro", "accel"):
        _revise(events, out)


def _suspected(event: dict[str, Any]) -> bool:
    """Whether an event is of an inertial sensor, or of a vehicle's model beside it, and is not settled."""
    return event["t_isolated"] is None and event["sensor"] in ("gyro", "accel", "model") and len(event["candidates"]) > 1


def _revise(events: list[dict[str, Any]], named: dict[str, Any]) -> None:
    """A compass that was said to turn since the gyro or the tilt was at fault: the verdict is that of the fault."""
    who = f"{named['sensor']}.{named['axis']}"
    for e in events:
        late = named["t_isolated"] - e["t_detected"]
        if (e["sensor"], e["kind"]) == ("magnetometer", "disturb") and e["t_recovered"] is None and 0.0 <= late < REVISED:
            e["t_isolated"], e["t_recovered"], e["candidates"] = named["t_isolated"], named["t_isolated"], [who]
            e["evidence"] += f"; revised at {named['t_isolated']:.1f} s: it was {who}, and the compass is heard again"


def _of_samples(kind: str, record: np.void, events: list[dict[str, Any]]) -> None:
    """What the raw samples show by themselves."""
    detail, t, onset = int(record["detail"]), float(record["t"]), float(record["onset"])
    code = STEP + 6 * ((detail - STEP) // 6)
    channel = detail - code
    sensor, axis = ("gyro", "accel")[channel // 3], "xyz"[channel % 3]
    fault = next((word for word, c in DEATHS.items() if c == code), "bias")
    if kind == "over":
        for e in reversed(events):
            if (e["sensor"], e["axis"], e["kind"]) == (sensor, axis, fault) and e["t_recovered"] is None:
                e["t_recovered"] = t
                e["evidence"] += f"; works again at {t:.2f} s"
                return
        return
    size, sd = math.degrees(float(record["size"])), math.degrees(float(record["sd"]))
    evidence = {
        "bias": f"the rate steps by {size:+.3g} ± {sd:.2g} deg/s between two samples, which no torque does; its effect was taken back",
        "stuck": "the value does not change",
        "dropout": "the value is zero",
        "saturate": "the value stays at the largest of the flight",
        "noise": f"{math.sqrt(max(float(record['value']), 0.0)):.1f} times as rough as in the flight so far, and the other axes are not",
    }[fault]
    if fault != "bias":
        evidence += "; attitude and velocity are held as unsure as that leaves them"
    out = {
        "sensor": sensor, "axis": axis, "kind": fault, "t_onset": onset, "t_detected": t, "t_isolated": t, "t_recovered": None,
        "candidates": [f"{sensor}.{axis}"], "statistic": float(record["value"]), "threshold": float(record["threshold"]),
        "evidence": evidence,
    }  # fmt: skip
    events.append(out)
    if fault == "bias":
        _revise(events, out)
