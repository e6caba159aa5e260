"""What a vehicle's model against its IMU showed, as events that a reader sees. It decides nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere.diagnosis.model_detectors import ALARM, SILENT
from haltere.diagnosis.model_faults import CANDIDATES, MODEL, ROTOR

__all__ = ["detectors", "of_the_model"]

#: Detectors in the order of an event's alarms.
DETECTORS = ("J11", "J12", "J13", "J14", "J15", "J16", "J21", "J22", "J23", "J24")
#: An alarm so long [s] after a fault was told is of that.
LATE = 10.0
OF_FAULTS = ("gyro", "accel", "model", "rotors", "gnss", "barometer", "magnetometer")
OF_THE_STATE = ("reset", "timeout", "recovered")
_AXES = ("hx", "hy", "t", "r", "p", "q")


def of_the_model(kind: str, record: np.void, events: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Append a finding to the events, or complete the one that it is about; what is given back is a gyro axis that was named."""
    detail, t, size = int(record["detail"]), float(record["t"]), float(record["size"])
    candidates = [name for i, name in enumerate(CANDIDATES) if int(record["candidates"]) >> i & 1]
    if detail >= ALARM:
        _late(f"J2{detail - ALARM + 1}", t, events)
        return None
    if candidates == ["magnetometer"]:
        _disturbed(t, size, events)
        return None
    if candidates[:1] in (["gyro.x"], ["gyro.y"], ["gyro.z"]):
        return _gyro(candidates[0], record, events)
    rotor = detail >= ROTOR
    axis = str(detail - int(ROTOR)) if rotor else _AXES[detail - int(MODEL)]
    sensor = "rotors" if rotor else "model"
    if kind == "over":
        for e in reversed(events):
            if (e["sensor"], e["axis"]) == (sensor, axis) and e["t_recovered"] is None:
                e["t_recovered"] = t
                e["evidence"] += f"; gone again at {t:.2f} s"
                return None
        return None
    said, quiet = detectors(record)
    if rotor:
        what = f"roll, pitch and thrust change as with {100.0 * size:+.0f} % of the thrust that the speed of rotor {axis} stands for"
        what += ": less or more thrust, or a tachometer that is wrong, which is not told apart"
    else:
        unit = "m/s²" if detail - int(MODEL) < 3 else "rad/s²"
        what = f"measured less modelled changes by {size:+.3g} ± {float(record['sd']):.2g} {unit} and stays"
    out = {
        "sensor": sensor, "axis": axis, "kind": "thrust" if rotor else "bias", "t_onset": float(record["onset"]),
        "t_detected": float(record["seen"]), "t_isolated": t if kind == "fault" else None, "t_recovered": None,
        "candidates": candidates, "statistic": float(record["value"]), "threshold": float(record["threshold"]),
        "evidence": f"{said}; {quiet} silent; {what}",
    }  # fmt: skip
    before = next((e for e in reversed(events) if (e["sensor"], e["axis"], e["t_onset"]) == (sensor, axis, out["t_onset"])), None)
    if before is not None and before["t_isolated"] is None and before["t_recovered"] is None:  # a set that is decided now
        events[events.index(before)] = out
    else:
        events.append(out)
    return None


def detectors(record: np.void, first: int = 0) -> tuple[str, str]:
    """Of J11 to J16 and J21 to J24, from the ``first`` one on: those that alarmed, with their times, and those that did not."""
    when = {name: float(x) for name, x in zip(DETECTORS[first:], record["alarms"][first:], strict=True)}
    there = {name: x for name, x in when.items() if math.isfinite(x) or name < "J2"}
    alarmed = sorted((x, name) for name, x in there.items() if math.isfinite(x) and x != SILENT)
    return ", ".join(f"{name} at {x:.2f} s" for x, name in alarmed), ", ".join(
        name for name, x in there.items() if (x, name) not in alarmed
    )


def _late(name: str, t: float, events: list[dict[str, Any]]) -> None:
    """A detector of the model's chain that alarms after a fault was told speaks of that."""
    for e in reversed(events):
        told = e["t_isolated"] if e["t_isolated"] is not None else e["t_detected"]
        if e["sensor"] in OF_FAULTS and e["kind"] not in OF_THE_STATE and told is not None:
            if t - told < LATE and e["t_recovered"] is None:
                e["evidence"] += f"; then {name} at {t:.2f} s"
            return


def _disturbed(t: float, rate: float, events: list[dict[str, Any]]) -> None:
    """A compass that turned, while the gyro agreed with the rotors: it is the compass."""
    for e in reversed(events):
        if (e["sensor"], e["kind"]) == ("magnetometer", "disturb") and e["t_recovered"] is None and "gyro.z" in e["candidates"]:
            e["candidates"], e["t_isolated"] = ["magnetometer"], t
            e["evidence"] += f"; a gyro wrong by {math.degrees(rate):.3g} deg/s, as it turned, would differ from the rotors, and does not"
            return


def _gyro(name: str, record: np.void, events: list[dict[str, Any]]) -> dict[str, Any]:
    """A gyro axis that stepped against the rotors."""
    size, sd = math.degrees(float(record["size"])), math.degrees(float(record["sd"]))
    sensor, _, axis = name.partition(".")
    out = {
        "sensor": sensor, "axis": axis, "kind": "bias", "t_onset": float(record["onset"]), "t_detected": float(record["seen"]),
        "t_isolated": float(record["t"]), "t_recovered": None, "candidates": [name], "statistic": None, "threshold": None,
        "evidence": f"the rate steps by {size:+.3g} ± {sd:.2g} deg/s at once, which the rotors do not explain; its effect was "
        "taken back",
    }  # fmt: skip
    events.append(out)
    return out
