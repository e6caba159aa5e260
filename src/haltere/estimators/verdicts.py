"""The verdicts of `fault-tolerant` as the events that a reader sees: sensor, axis, candidates, which detection filters alarmed when."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.diagnosis.truth_table import DETECTORS, FAULTS

__all__ = ["VERDICTS", "verdict"]

#: Kinds of the filter's events that are told here.
VERDICTS = ("isolated", "undecided", "readmitted")
_NAMES = {"gnss.velocity": ("gnss", None), "gnss.position": ("gnss", None), "rotor": ("rotors", None), "wind": ("wind", None)}
_DONE = {
    "gyro": "left out; the model's moments and the other sensors carry the attitude",
    "accel": "left out; the model's force and GNSS carry the velocity",
    "model": "the sensors drive this axis in its place",
    "rotors": "the sensors drive what the model can no longer tell",
    "wind": "no fault; the wind is found anew",
}


def verdict(kind: str, record: np.void, S: NDArray[np.void], events: list[dict[str, Any]]) -> None:
    """Append the event of a verdict, or put the end into that of what is heard again."""
    t, number = float(record["t"]), int(record["detail"])
    if kind == "readmitted":
        sensor, axis = _parts(FAULTS[number])
        for e in reversed(events):
            if e["sensor"] == sensor and e["axis"] == axis and e["t_recovered"] is None:
                e["t_recovered"] = t
                e["evidence"] += f"; agrees again, heard from {t:.2f} s on"
                return
        if sensor == "model":  # an axis that a rotor took with it
            for e in reversed(events):
                if e["sensor"] == "rotors" and e["t_isolated"] is not None:
                    e["evidence"] += f"; {axis} is right again from {t:.2f} s on"
                    return
        return
    finding = S["ft"]["finding"][0, 0, int(record["value"])]
    when, most = finding["when"], finding["most"]
    alarmed = sorted((float(when[i]), i) for i in range(len(DETECTORS)) if when[i] > 0.0)
    evidence = ", ".join(f"{DETECTORS[i]} at {at:.2f} s ({most[i]:.1f} times its level)" for at, i in alarmed)
    candidates = [FAULTS[k] for k in range(len(FAULTS)) if int(record["candidates"]) & (1 << k)]
    if kind == "isolated":
        name = FAULTS[number]
        sensor, axis = _parts(name)
        done = _DONE.get(sensor, "left out")
        evidence = f"{evidence}: the signature of {name}; {done}"
    else:
        sensor, axis = ("filter", None)
        heads = {c.partition(".")[0] for c in candidates}
        if len(heads) == 1:
            sensor = _parts(candidates[0])[0]
        evidence += f": {'fits ' + ', '.join(candidates) if candidates else 'no signature'}; nothing was left out"
    word = "suspect" if kind == "undecided" else "step" if sensor == "wind" else "bias"
    events.append(
        {
            "sensor": sensor, "axis": axis, "kind": word,
            "t_onset": float(record["onset"]), "t_detected": float(record["seen"]), "t_isolated": t if kind == "isolated" else None,
            "t_recovered": None, "candidates": candidates, "statistic": float(max(most)), "threshold": 1.0, "evidence": evidence,
        }
    )  # fmt: skip


def _parts(name: str) -> tuple[str, str | None]:
    if name in _NAMES:
        return _NAMES[name]
    sensor, _, axis = name.partition(".")
    return sensor, axis or None
