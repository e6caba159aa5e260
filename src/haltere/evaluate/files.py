"""A comparison as files: JSON, CSV and what else is given as text. It computes nothing."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from haltere.errors import HaltereError
from haltere.metrics.comparison import Comparison

__all__ = ["table", "write"]


def table(comparison: Comparison) -> list[dict[str, Any]]:
    """One row a solution, one column a figure; None where there is none."""
    solutions = comparison.summary["solutions"]
    measures = sorted({m for s in solutions.values() for m, e in (s.get("errors") or {}).items() if isinstance(e, dict)})
    rows = []
    for name, s in solutions.items():
        scored = s.get("errors") or {}
        row = {"solution": name} | {
            k: s.get(k) for k in ("kind", "maker", "smoother", "aligned_at", "covered", "seconds", "times_real_time")
        }
        for m in measures:
            row |= {f"{m}_{k}": scored[m][k] if m in scored else None for k in ("rms", "max")}
        rows.append(row | {"heading_offset_deg": scored.get("heading_offset_deg"), "not_scored": s["failed"] or s.get("left_out")})
    return rows


def write(comparison: Comparison, folder: str | Path, extra: Mapping[str, str] | None = None) -> Path:
    """Write ``compare.json``, ``compare.csv`` and further texts by name; none is left half under its final name.

    Raises
    ------
    HaltereError
        The folder cannot be written.
    """
    import polars as pl

    folder = Path(folder)
    rows = table(comparison)
    texts = {
        "compare.json": json.dumps(comparison.summary, indent=1, allow_nan=False, ensure_ascii=False) + "\n",
        "compare.csv": pl.DataFrame(rows, infer_schema_length=None).write_csv(),
        **(extra or {}),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as name:
            for file, text in texts.items():
                (Path(name) / file).write_text(text, encoding="utf-8")
            for file in texts:
                os.replace(Path(name) / file, folder / file)
    except OSError as error:
        raise HaltereError("a folder that can be written", str(error), str(folder), "give another with --out") from None
    return folder
