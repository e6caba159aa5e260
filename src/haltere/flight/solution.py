"""Solution: what an estimator gives back, and its files. It computes no statistics (see metrics) and draws nothing (see report)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.config import Config
from haltere.flight.writing import whole_files

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Solution"]

FloatArray = NDArray[np.float64]
#: The file that says that all are there, and those that not every run writes.
SUMMARY, FILES = "summary.json", ("smoothed.parquet", "report.html")


@dataclass
class Solution:
    """An estimator's output over a flight.

    Attributes
    ----------
    table
        Columns of ``solution.parquet`` (interface.md §3; units and frames in `haltere.flight.schema.SOLUTION`), each (n,).
    aids
        Columns of ``aids.parquet``: one row a measurement component offered; numbers and text.
    events
        Faults and state changes, as in ``events.json``.
    config
        Every parameter as used.
    summary
        As in ``summary.json``.
    covariance
        ``t`` (m,) and the 3x3 blocks ``attitude, velocity, position, gyro_bias, accel_bias`` (m, 3, 3) and ``baro_bias`` (m, 1, 1)
        at times spaced by at least 0.1 s, for consistency statistics. The attitude block is of the body-frame rotation error.
    smoothed
        The same rows smoothed over the whole run, where that was asked for; ``smoothed.parquet``.
    without
        Rows of the same run in which no inertial fault was named, some a second, where one was; it is not written to a file.
    """

    table: dict[str, FloatArray]
    aids: dict[str, NDArray[Any]]
    events: list[dict[str, Any]]
    config: Config
    summary: dict[str, Any] = field(default_factory=dict)
    covariance: dict[str, FloatArray] = field(default_factory=dict)
    smoothed: Solution | None = None
    without: Solution | None = None

    @property
    def t(self) -> FloatArray:
        """Time [s] of every row."""
        return self.table["t"]

    def __getitem__(self, name: str) -> FloatArray:
        return self.table[name]

    def __contains__(self, name: object) -> bool:
        return name in self.table

    def __len__(self) -> int:
        return len(self.table["t"])

    def vector(self, stem: str, axes: str = "xyz") -> FloatArray:
        """Columns ``stem_x, stem_y, ...`` side by side, (n, len(axes))."""
        return np.column_stack([self.table[f"{stem}_{a}"] for a in axes])

    def to_polars(self) -> pl.DataFrame:
        """The solution as a polars table."""
        import polars as pl

        return pl.DataFrame(dict(self.table))

    def save(self, folder: str | Path, extra: Mapping[str, str] | None = None) -> Path:
        """Write the files of interface.md §3; none is left half under its final name.

        Parameters
        ----------
        folder
            Where to; made if it is not there. Files of an earlier run are replaced, and taken away where this one has none such.
        extra
            Further text files by name (``report.html``).

        Raises
        ------
        HaltereError
            The folder cannot be written, or there is no room.

        Notes
        -----
        ``summary.json`` comes last and is taken away first: where it is, all files are of one run.
        """
        import polars as pl

        folder = Path(folder)
        made = {*(extra or {}), *(["smoothed.parquet"] if self.smoothed is not None else [])}
        with whole_files(folder, SUMMARY, [name for name in FILES if name not in made]) as work:
            self.to_polars().write_parquet(work / "solution.parquet")
            if self.smoothed is not None:
                self.smoothed.to_polars().write_parquet(work / "smoothed.parquet")
            pl.DataFrame(dict(self.aids)).write_parquet(work / "aids.parquet")
            (work / "events.json").write_text(_json(self.events), encoding="utf-8")
            (work / SUMMARY).write_text(_json(self.summary), encoding="utf-8")
            (work / "config.toml").write_text(self.config.to_toml(), encoding="utf-8")
            for file, text in (extra or {}).items():
                (work / file).write_text(text, encoding="utf-8")
        return folder


def _json(value: Any) -> str:
    """JSON text; numbers that are not finite, which JSON does not have, become null."""
    return json.dumps(_known(value), indent=1, allow_nan=False) + "\n"


def _known(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _known(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_known(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
