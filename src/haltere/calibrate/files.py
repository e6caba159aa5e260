"""A calibration as files: configuration keys, JSON, and what else is given as text. It computes nothing."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from haltere._version import __version__
from haltere.calibrate.autopilots import ardupilot_parameters, px4_parameters, remarks
from haltere.calibrate.coverage import HEADINGS
from haltere.calibrate.magnetometer import MagnetometerCalibration
from haltere.flight.writing import whole_files

__all__ = ["document", "to_toml", "write"]

DEG = 180.0 / math.pi


def document(c: MagnetometerCalibration) -> dict[str, Any]:
    """Everything of a calibration but its samples, for JSON: angles in degrees where the key says so, else SI and microtesla."""
    sd = c.sd
    turn = c.turn
    return {
        "haltere": __version__,
        "name": c.name,
        "stream": c.stream,
        "method": c.method,
        "refused": c.refused or None,
        "offset_uT": c.offset.tolist(),
        "offset_sd_uT": sd[:3].tolist(),
        "matrix": c.matrix.tolist(),
        "matrix_sd": sd[3:12].reshape(3, 3).tolist(),
        "load": c.load_word,
        "load_uT_per_unit": c.load.tolist() if c.load_word != "off" else None,
        "load_sd_uT_per_unit": sd[12:].tolist() if c.load_word != "off" else None,
        "covariance": c.covariance.tolist(),
        "rotation_deg": None
        if turn is None
        else {
            "vector": (DEG * turn.vector).tolist(),
            "sd": [DEG * math.sqrt(max(v, 0.0)) for v in turn.covariance.diagonal().tolist()],
            "dip": DEG * turn.dip,
            "dip_sd": DEG * turn.dip_sd,
            "dip_scatter_before": DEG * turn.scatter_before,
            "dip_scatter_after": DEG * turn.scatter_after,
            "samples": turn.n,
        },
        "field": {"strength_uT": c.strength, "dip_deg": DEG * c.dip, "source": c.field_source},
        "samples": {
            "n": len(c.t),
            "outliers": int((~c.used).sum()),
            "independent_share": c.ellipsoid.independent,
            "noise_uT": c.ellipsoid.sigma,
        },
        "coverage": {
            "eigenvalues": c.coverage.eigenvalues.tolist(),
            "share": c.coverage.share,
            "missing": list(c.coverage.missing),
        },
        "strength_spread": {"log": c.spread(c.log), "raw": c.spread(c.raw), "calibrated": c.spread(c.calibrated)},
        "heading_deg": {
            "heading": (DEG * HEADINGS).tolist(),
            "error_before": (DEG * c.heading_before).tolist(),
            "sd_after": (DEG * c.heading_sd).tolist(),
        },
        "log_correction_undone": c.undone,
        "px4": None if c.refused else px4_parameters(c),
        "ardupilot": None if c.refused else ardupilot_parameters(c),
        "remarks": remarks(c),
        "notes": list(c.notes),
    }


def to_toml(c: MagnetometerCalibration) -> str:
    """Configuration keys as a file that ``haltere run LOG --config`` takes."""
    import tomli_w

    tables: dict[str, dict[str, Any]] = {}
    for key, value in {**c.given, **c.keys()}.items():
        head, _, tail = key.partition(".")
        tables.setdefault(head, {})[tail] = value
    first = f"# Calibration of {c.stream} from {c.name or 'a flight'} by haltere {__version__}: haltere run LOG --config calibration.toml\n"
    return first.replace("\r", " ") + tomli_w.dumps(tables)


def write(c: MagnetometerCalibration, folder: str | Path, extra: Mapping[str, str] | None = None) -> Path:
    """Write ``calibration.json``, ``calibration.toml`` (not where it is refused) and further texts by name, whole or not at all.

    Raises
    ------
    HaltereError
        The folder cannot be written.
    """
    folder = Path(folder)
    texts = {"calibration.json": json.dumps(document(c), indent=1, allow_nan=False, ensure_ascii=False) + "\n", **(extra or {})}
    if not c.refused:
        texts["calibration.toml"] = to_toml(c)
    with whole_files(folder, "calibration.json", ["calibration.toml"] if c.refused else []) as work:
        for name, text in texts.items():
            (work / name).write_text(text, encoding="utf-8")
    return folder
