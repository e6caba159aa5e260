"""What a vehicle's model against its IMU showed, as events that a reader sees. It decides nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere.diagnosis.model_faults import CANDIDATES, MODEL, ROTOR

__all__ = ["of_the_model"]

_AXES = ("hx", "hy", "t", "r", "p", "q")


def of_the_model(kind: str, record: np.void, events: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Append a finding to the events, or complete the one that it is about; what is given back is a gyro axis that was named."""
    detail, t, size = int(record["detail"]), float(record["t"]), float(record["size"])
    candidates = [name for i, name in enumerate(CANDIDATES) if int(record["candidates"]) >> i & 1]
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
    alarms = {f"J1{i + 1}": float(record["alarms"][i]) for i in range(6) if math.isfinite(record["alarms"][i])}
    quiet = [f"J1{i + 1}" for i in range(6) if f"J1{i + 1}" not in alarms]
    said = ", ".join(f"{name} at {when:.2f} s" for name, when in alarms.items())
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
        "evidence": f"{said}; {', '.join(quiet)} silent; {what}",
    }  # fmt: skip
    before = next((e for e in reversed(events) if (e["sensor"], e["axis"], e["t_onset"]) == (sensor, axis, out["t_onset"])), None)
    if before is not None and before["t_isolated"] is None and before["t_recovered"] is None:  # a set that is decided now
        events[events.index(before)] = out
    else:
        events.append(out)
    return None


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
