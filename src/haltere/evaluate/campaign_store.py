"""A campaign's folder: parts written while it runs, what of them is still good, and the tables of all. It makes no runs."""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haltere.errors import HaltereError
from haltere.evaluate.campaign_plan import Plan
from haltere.evaluate.campaign_row import FAULT_COLUMNS, METRICS
from haltere.evaluate.campaign_run import CRASHED, Result, code
from haltere.flight.writing import whole_files

if TYPE_CHECKING:
    import polars as pl

__all__ = ["SUMMARY", "Store"]

PARTS, SUMMARY = "parts", "summary.json"
_TIMING = "timing."
_PLACE = {name: k for k, name in enumerate(METRICS)}


class Store:
    """The folder of a campaign.

    Parameters
    ----------
    folder
        Made if it is not there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.parts = Path(folder), Path(folder) / PARTS
        self.notes: list[str] = []

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """The folder for this process alone.

        Raises
        ------
        HaltereError
            The folder cannot be written, or another process is writing there.
        """
        try:
            self.parts.mkdir(parents=True, exist_ok=True)
            handle = os.open(self.parts, os.O_RDONLY)
        except OSError as error:
            raise HaltereError("a folder that can be written", error.strerror or str(error), str(self.folder), "name another") from None
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise HaltereError(
                    "a folder to itself", "another campaign that is writing to it", str(self.folder), "wait for it, or name another folder"
                ) from None
            yield
        finally:
            os.close(handle)

    def _files(self) -> list[Path]:
        """Parts in the order in which they were written."""
        return sorted(p for p in self.parts.glob("part-*.parquet") if re.fullmatch(r"part-\d{6}", p.stem))

    def done(self) -> dict[str, str]:
        """Status by id of every run that is finished by these sources; one that should not have failed is made again."""
        import polars as pl

        out: dict[str, str] = {}
        stale = 0
        for file in self._files():
            try:
                table = pl.read_parquet(file, columns=["id", "code", "status"])
            except (OSError, pl.exceptions.PolarsError):
                self.notes.append(f"{file.name} cannot be read: its runs are made again")
                continue
            for run, of, status in table.iter_rows():
                if of != code():
                    stale += 1
                elif status != CRASHED:
                    out[run] = status
        if stale:
            self.notes.append(f"{stale} finished runs are of other sources of haltere: they do not count")
        return out

    def write(self, results: Sequence[Result]) -> None:
        """One more part; it is there whole, or not at all.

        Raises
        ------
        HaltereError
            The folder cannot be written, or there is no room.
        """
        files = self._files()
        name = f"part-{int(files[-1].stem.removeprefix('part-')) + 1 if files else 1:06d}.parquet"
        rows = [
            {
                "id": r.id, "code": r.code, "status": r.status, "error": r.error, **r.row,
                "faults_json": json.dumps([_plain(f) for f in r.faults]), **{f"{_TIMING}{k}": v for k, v in r.timings.items()},
            }
            for r in results
        ]  # fmt: skip
        with whole_files(self.parts, name) as work:
            _table(rows).write_parquet(work / name)

    def tables(self, plan: Plan) -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
        """Runs, faults and timings of a plan, in its order; they do not depend on when and where a run was made.

        The last result of a run counts.
        """
        import polars as pl

        wanted = pl.DataFrame({"id": [r.id for r in plan.runs], "run": [r.index for r in plan.runs]}, {"id": pl.String, "run": pl.Int64})
        kept = []
        for k, file in enumerate(self._files()):
            with contextlib.suppress(OSError, pl.exceptions.PolarsError):
                part = pl.read_parquet(file).filter(pl.col("code") == code()).join(wanted, "id", "inner")
                if len(part):
                    kept.append(part.with_columns(pl.lit(k).alias("part")))
        if not kept:
            empty = wanted.clear().select("run", "id")
            words = {name: pl.Series([], dtype=pl.String) for name in ("estimator", "status", "error")}
            return empty.with_columns(**words), _table([], ("run", "id", *FAULT_COLUMNS)), empty
        every = (
            pl.concat(kept, how="diagonal_relaxed").sort("run", "part", maintain_order=True).unique("run", keep="last", maintain_order=True)
        )
        factors = self._factors(plan, every["run"].to_list())
        timings = every.select("run", "id", *sorted(c for c in every.columns if c.startswith(_TIMING)))
        timings = timings.rename({c: c.removeprefix(_TIMING) for c in timings.columns})
        own = {"run", "id", "code", "status", "error", "part", "faults_json", *(c for c in every.columns if c.startswith(_TIMING))}
        metrics = sorted((c for c in every.columns if c not in own), key=lambda c: (_PLACE.get(c, len(_PLACE)), c))
        filled = [m for m in metrics if every[m].null_count() < len(every)]
        runs = pl.concat([every.select("run", "id"), factors, every.select("status", "error", *filled)], how="horizontal").rechunk()
        rows = []
        for run, name, text in every.select("run", "id", "faults_json").iter_rows():
            rows += [{"run": run, "id": name, **f} for f in json.loads(text)]
        faults = _table(rows, ("run", "id", *FAULT_COLUMNS)).with_columns(pl.col("run").cast(pl.Int64))
        if len(faults):
            columns = [c for c in factors.columns if c not in faults.columns]
            faults = faults.join(runs.select("run", *columns), "run", "left", maintain_order="left").rechunk()
        return runs, faults, timings.rechunk()

    @staticmethod
    def _factors(plan: Plan, which: list[int]) -> pl.DataFrame:
        """Columns of the factors: numbers, truths, or else text."""
        import polars as pl

        out = {}
        for name in plan.factors:
            values = [plan.runs[k].factors.get(name) for k in which]
            known = [v for v in values if v is not None]
            if all(isinstance(v, bool) for v in known):
                out[name] = pl.Series(values, dtype=pl.Boolean)
            elif all(isinstance(v, int | float) and not isinstance(v, bool) for v in known):
                out[name] = pl.Series([None if v is None else float(v) for v in values], dtype=pl.Float64)
            else:
                out[name] = pl.Series([None if v is None else str(v) for v in values], dtype=pl.String)
        return pl.DataFrame(out)

    def finish(self, tables: Mapping[str, pl.DataFrame], summary: Mapping[str, Any], texts: Mapping[str, str]) -> None:
        """Write the tables, further texts by name and, last, the summary.

        Raises
        ------
        HaltereError
            The folder cannot be written, or there is no room.
        """
        with whole_files(self.folder, SUMMARY) as work:
            for name, table in tables.items():
                table.write_parquet(work / f"{name}.parquet")
            for name, text in texts.items():
                (work / name).write_text(text, encoding="utf-8")
            (work / SUMMARY).write_text(json.dumps(summary, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """For JSON: what is not finite is null."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _table(rows: Sequence[Mapping[str, Any]], first: Sequence[str] = ()) -> pl.DataFrame:
    """Rows with any keys as a table of numbers and texts; what is missing or not finite is null."""
    import polars as pl

    names = list(dict.fromkeys([*first, *(k for row in rows for k in row)]))
    columns = {}
    for name in names:
        values = [_plain(row.get(name)) for row in rows]
        text = any(isinstance(v, str) for v in values)
        columns[name] = pl.Series(values, dtype=pl.String if text else pl.Float64, strict=False)
    return pl.DataFrame(columns)
