"""An identified vehicle as files: the vehicle file and JSON. It computes nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from haltere._version import __version__
from haltere.flight.writing import whole_files
from haltere.identify.vehicle import VehicleIdentification
from haltere.vehicle.regressors import AXES, NAMES, PRESETS

__all__ = ["document", "to_toml", "write"]


def document(d: VehicleIdentification) -> dict[str, Any]:
    """Everything of an identification but its samples, for JSON, in SI."""
    m, used = d.lumped, PRESETS[d.lumped.preset]
    return {
        "haltere": __version__,
        "flights": [tr.motion.name for tr in d.tracks],
        "vehicle": None if d.vehicle is None else d.vehicle.name,
        "preset": m.preset,
        "constants": {
            NAMES[i][j]: {
                "value": float(m.k[i, j]), "sd": float(m.sd[i, j]), "told": bool(d.told[i, j]), "least_squares": float(d.plain[i, j]),
            }
            for i in range(6)
            for j in used[i]
        },
        "axes": {
            a: {
                "condition": float(d.condition[i]), "residual_sd": float(m.residual_sd[i]), "residual_ar1": float(m.residual_ar1[i]),
                "residual_slow": float(m.residual_slow[i]),
            }
            for i, a in enumerate(AXES)
        },
        "rotors": {
            "roll": m.roll.tolist(), "pitch": m.pitch.tolist(), "yaw": m.yaw.tolist(), "signs": d.layout.found.tolist(),
            "effect": d.layout.effect.tolist(), "effect_sd": d.layout.effect_sd.tolist(),
            "lags": [tr.speeds.lag for tr in d.tracks], "lags_told": [tr.speeds.lag_told for tr in d.tracks],
        },
        "arm": d.arm.tolist(), "arm_sd": d.arm_sd.tolist(),
        "valid": dict(m.valid),
        "checks": [
            {
                "flight": c.name, "fitted": c.seen,
                **{a: {"signal": float(c.signal[i]), "error": float(c.error[i]), "bias": float(c.bias[i]),
                       "explained": float(c.explained[i])} for i, a in enumerate(AXES)},
            }
            for c in d.checks
        ],
        "notes": list(d.notes),
    }  # fmt: skip


def to_toml(d: VehicleIdentification) -> str:
    """The vehicle file: what was given, and ``[lumped]``; without a vehicle only that."""
    import tomli_w

    first = f"# Identified from {d.name} by haltere {__version__}; [lumped] is per mass and inertia\n".replace("\r", " ")
    if d.vehicle is not None:
        return first + d.as_vehicle().to_toml()
    return first + tomli_w.dumps({"name": "identified", "lumped": dict(d.as_vehicle().lumped)})


def write(d: VehicleIdentification, file: str | Path, extra: Mapping[str, str] | None = None) -> Path:
    """Write the vehicle file, a JSON file of the same stem beside it and further texts by name, whole or not at all.

    Raises
    ------
    HaltereError
        The folder cannot be written.
    """
    file = Path(file)
    text = json.dumps(document(d), indent=1, allow_nan=False, ensure_ascii=False, default=_plain) + "\n"
    texts = {file.name: to_toml(d), f"{file.stem}.json": text, **(extra or {})}
    with whole_files(file.parent, file.name, []) as work:
        for name, content in texts.items():
            (work / name).write_text(content, encoding="utf-8")
    return file


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else str(value)
