"""What a vehicle's model against its IMU showed, as events that a reader sees. It decides nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere.diagnosis.model_faults import CANDIDATES, MODEL, ROTOR

__all__ = ["of_the_model"]

_AXES = ("hx", "hy", "t", "r", "p", "q")


def of_the_model(kind: str, record: np.void, events: list[dict[str, Any]]) -> None:
    """Append a finding to the events, or complete the one whose fault is over."""
    detail, t, size = int(record["detail"]), float(record["t"]), float(record["size"])
    rotor = detail >= ROTOR
    axis = str(detail - int(ROTOR)) if rotor else _AXES[detail - int(MODEL)]
    sensor = "rotors" if rotor else "model"
    if kind == "over":
        for e in reversed(events):
            if (e["sensor"], e["axis"]) == (sensor, axis) and e["t_recovered"] is None:
                e["t_recovered"] = t
                e["evidence"] += f"; gone again at {t:.2f} s"
                return
        return
    alarms = {f"J1{i + 1}": float(record["alarms"][i]) for i in range(6) if math.isfinite(record["alarms"][i])}
    quiet = [f"J1{i + 1}" for i in range(6) if f"J1{i + 1}" not in alarms]
    said = ", ".join(f"{name} at {when:.2f} s" for name, when in alarms.items())
    if rotor:
        what = f"roll, pitch and thrust change as with {100.0 * size:+.0f} % of the thrust that the speed of rotor {axis} stands for"
        what += ": less or more thrust, or a tachometer that is wrong, which is not told apart"
    else:
        unit = "m/s²" if detail - int(MODEL) < 3 else "rad/s²"
        what = f"measured less modelled changes by {size:+.3g} ± {float(record['sd']):.2g} {unit} and stays"
    events.append({
        "sensor": sensor, "axis": axis, "kind": "thrust" if rotor else "bias", "t_onset": float(record["onset"]),
        "t_detected": float(record["seen"]), "t_isolated": t if kind == "fault" else None, "t_recovered": None,
        "candidates": [name for i, name in enumerate(CANDIDATES) if int(record["candidates"]) >> i & 1],
        "statistic": float(record["value"]), "threshold": float(record["threshold"]),
        "evidence": f"{said}; {', '.join(quiet)} silent; {what}",
    })  # fmt: skip
