"""`campaign`: every run of a specification, resumed where it was left, to tables and verdicts. It draws nothing."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haltere.errors import UsageError
from haltere.evaluate.campaign_plan import Plan, Run, load_plan
from haltere.evaluate.campaign_pool import by_dask, here, processes
from haltere.evaluate.campaign_require import Verdict, judge
from haltere.evaluate.campaign_run import Result, Task, code
from haltere.evaluate.campaign_store import Store
from haltere.evaluate.campaign_summary import summary
from haltere.metrics.campaign import DONE

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Progress", "Results", "campaign", "cores"]

#: Most runs of a task, seconds between two parts, and most results that wait for one.
CHUNK, EVERY, HELD = 8, 3.0, 256


@dataclass(frozen=True)
class Progress:
    """How far a campaign is.

    Attributes
    ----------
    done, total, failed
        Runs of all.
    left
        Seconds to the end, from the pace of this call; NaN before the first run.
    """

    done: int
    total: int
    failed: int
    left: float


@dataclass(frozen=True)
class Results:
    """What a campaign gave.

    Attributes
    ----------
    plan
        The campaign.
    runs, faults, timings
        One row a run (its factors, status, metrics), a fault (what became of it), a run (seconds by stage).
    verdicts
        On the requirements, in their order.
    summary
        As in ``summary.json``.
    folder
        Where its files are.
    """

    plan: Plan
    runs: pl.DataFrame
    faults: pl.DataFrame
    timings: pl.DataFrame
    verdicts: tuple[Verdict, ...]
    summary: dict[str, Any]
    folder: Path

    @property
    def passed(self) -> bool:
        """Whether every requirement is met."""
        return all(v.met for v in self.verdicts)

    def save(self, texts: dict[str, str] | None = None) -> Path:
        """Write the tables, ``campaign.toml``, further texts by name and ``summary.json``.

        Raises
        ------
        HaltereError
            The folder cannot be written.
        """
        tables = {"results": self.runs, "faults": self.faults, "timings": self.timings}
        Store(self.folder).finish(tables, self.summary, {"campaign.toml": self.plan.text, **(texts or {})})
        return self.folder


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def campaign(
    specification: str | Path | Plan,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Results:
    """Make every run of a specification that is not yet there, and judge all of them.

    Parameters
    ----------
    specification
        A TOML file, or a plan made of one.
    out
        Folder of its results; by default ``./<name>.campaign``. Runs that are finished there are not made again.

    Other Parameters
    ----------------
    workers
        Processes; by default one a core. With one, runs are made in this process.
    scheduler
        Address of a Dask scheduler whose workers make the runs instead.
    progress
        Called after each task.

    Returns
    -------
    Results
        The same whatever the number of workers and interruptions, but for the timings. `Results.save` writes them; the parts of
        which they are made are written while it runs.

    Raises
    ------
    UsageError
        A specification that is not one, before anything runs.
    HaltereError
        A file that cannot be read, a folder that cannot be written, or a scheduler that is not there. A run that fails is a row.
    """
    if workers is not None and workers < 1:
        raise UsageError("at least one worker", str(workers), "--workers")
    if workers is not None and scheduler is not None:
        raise UsageError("workers of this machine or a scheduler", "both", "--workers and --scheduler")
    plan = specification if isinstance(specification, Plan) else load_plan(specification)
    folder = Path(out) if out is not None else Path(f"{plan.name}.campaign")
    store = Store(folder)
    began = time.monotonic()
    with store.held():
        status = store.done()
        kept = {r.id for r in plan.runs} & status.keys()
        missing = [r for r in plan.runs if r.id not in kept]
        failed = sum(status[i] != DONE for i in kept)
        used = 0
        if missing:
            names = sorted({r.estimator for r in missing})
            used = 0 if scheduler is not None else min(workers or cores(), len(missing))
            tasks = _tasks(plan, missing, max(used, 1), scheduler is not None)
            if scheduler is not None:
                stream = by_dask(tasks, scheduler)
            else:
                stream = here(tasks) if used == 1 else processes(tasks, used, names)
            _gather(store, stream, len(kept), len(plan.runs), failed, progress)
        runs, faults, timings = store.tables(plan)
    verdicts = tuple(judge(r, runs, faults) for r in plan.require)
    took: dict[str, Any] = {
        "wall_s": time.monotonic() - began, "made": len(missing), "resumed": len(kept), "workers": used, "scheduler": scheduler,
        **{k: float(timings[k].sum()) for k in ("flight_s", "run_s", "score_s") if k in timings.columns},
    }  # fmt: skip
    said = summary(plan, runs, faults, verdicts, store.notes, took)
    return Results(plan, runs, faults, timings, verdicts, said, folder)


def _tasks(plan: Plan, missing: Sequence[Run], workers: int, elsewhere: bool) -> list[Task]:
    """Tasks of neighbouring runs, those over the same flight next to each other; small enough for every worker to have several."""
    first: dict[tuple[Any, ...], int] = {}
    for run in missing:
        first.setdefault(run.flight, run.index)
    ordered = sorted(missing, key=lambda r: (first[r.flight], r.index))
    size = max(1, min(CHUNK, math.ceil(len(ordered) / (4 * workers))))
    return [
        Task(tuple(ordered[i : i + size]), plan.settle, plan.hold, plan.bounds, code(), elsewhere) for i in range(0, len(ordered), size)
    ]


def _gather(
    store: Store, stream: Iterator[list[Result]], done: int, total: int, failed: int, progress: Callable[[Progress], None] | None
) -> None:
    """Write results as they come; what has come is written, however it ends."""
    held: list[Result] = []
    began = last = time.monotonic()
    before = done

    def put() -> None:
        nonlocal last, held
        if held:
            store.write(held)
        held, last = [], time.monotonic()

    try:
        for results in stream:
            held += results
            done += len(results)
            failed += sum(r.status != DONE for r in results)
            if time.monotonic() - last >= EVERY or len(held) >= HELD:
                put()
            if progress is not None:
                pace = (time.monotonic() - began) / (done - before)
                progress(Progress(done, total, failed, pace * (total - done)))
    finally:
        put()
        close = getattr(stream, "close", None)
        if close is not None:
            close()
