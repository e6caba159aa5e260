"""The work of a campaign's worker: simulate or read, run, score; a run that fails is a row that says so. It writes no files."""

from __future__ import annotations

import hashlib
import os
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import haltere
from haltere import drive
from haltere.errors import HaltereError
from haltere.evaluate.campaign_plan import Run
from haltere.evaluate.campaign_row import row_of
from haltere.flight.log import FlightLog
from haltere.metrics.campaign import DONE
from haltere.readers import read
from haltere.simulate.faults import inject
from haltere.simulate.scenario import parse_scenario
from haltere.simulate.simulator import simulate

__all__ = ["CRASHED", "FAILED", "Result", "Task", "code", "crashed", "warm", "work"]

#: What became of a run that gave no figures: an error that says what is wrong with it, or one that should not be.
FAILED, CRASHED = "failed", "crashed"


@dataclass(frozen=True)
class Task:
    """Runs that one worker makes one after the other, how they are scored, and the sources that are to do it.

    ``elsewhere`` where the worker may have another copy of them.
    """

    runs: tuple[Run, ...]
    settle: float
    hold: float
    bounds: Mapping[str, float]
    code: str
    elsewhere: bool = False

    def parted(self) -> list[Task]:
        """The same, a run each."""
        return [replace(self, runs=(run,)) for run in self.runs]


@dataclass(frozen=True)
class Result:
    """What a run gave: its row, a row a fault, seconds by stage, and of which sources."""

    id: str
    status: str
    error: str
    row: dict[str, Any] = field(default_factory=dict)
    faults: list[dict[str, Any]] = field(default_factory=list)
    timings: dict[str, float] = field(default_factory=dict)
    code: str = ""


@lru_cache(maxsize=1)
def code() -> str:
    """Of the package's sources: results of others are of another program."""
    digest = hashlib.sha256()
    root = Path(haltere.__file__).parent
    for path in sorted([*root.rglob("*.py"), *root.rglob("*.toml")]):
        if not {"report", "cli"} & set(path.relative_to(root).parts):  # what draws and prints changes no figure
            digest.update(f"{path.relative_to(root)}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def warm(estimators: Sequence[str], simulated: bool) -> None:
    """Compile, or load, what the runs need."""
    flight = simulate(parse_scenario({"base": "hover", "duration": 15.0}))
    for estimator in estimators:
        drive.run(flight, estimator, scored=False)


def work(task: Task) -> list[Result]:
    """Results of a task, in its order. Nothing that goes wrong in a run ends another.

    Raises
    ------
    HaltereError
        This is another haltere than the one that planned the task.
    """
    if task.elsewhere and task.code != code():
        raise HaltereError("the same haltere on every worker", f"sources {code()} instead of {task.code}", "campaign", "install the same")
    return [_one(run, task) for run in task.runs]


def crashed(task: Task, why: str) -> list[Result]:
    """Results of runs that took their worker with them."""
    return [Result(run.id, CRASHED, why, code=task.code) for run in task.runs]


class _Kept(threading.local):
    """The last flight of a worker: several estimators often follow each other over the same."""

    key: tuple[Any, ...] | None = None
    flight: FlightLog | None = None


_kept = _Kept()


def _flight(run: Run) -> FlightLog:
    """The run's flight, with its faults."""
    if _kept.flight is not None and _kept.key == run.flight:
        return _kept.flight
    _kept.key = _kept.flight = None
    if run.scenario is not None:
        flight = simulate(run.scenario)
    elif run.log is not None:
        flight = inject(read(run.log), run.faults)
    else:
        raise HaltereError("a scenario or a log", "neither", run.id)
    _kept.key, _kept.flight = run.flight, flight
    return flight


def _one(run: Run, task: Task) -> Result:
    began = time.perf_counter()
    timings: dict[str, float] = {}

    def stage(name: str) -> None:
        nonlocal began
        now = time.perf_counter()
        timings[name], began = now - began, now

    try:
        flight = _flight(run)
        stage("flight_s")
        solution = drive.run(flight, run.estimator, preset=run.preset, set=run.keys, scored=False)
        stage("run_s")
        row, faults = row_of(solution, flight, task.settle, task.hold, task.bounds)
        stage("score_s")
    except HaltereError as error:
        stage("failed_s")
        return Result(run.id, FAILED, str(error), timings=timings, code=task.code)
    except Exception as error:  # whatever it is, the other runs go on, and this one says what it was
        stage("failed_s")
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        return Result(run.id, CRASHED, f"{type(error).__name__}: {' '.join(str(error).split())} ({where})", timings=timings, code=task.code)
    timings["worker"] = float(os.getpid())
    return Result(run.id, DONE, "", row, faults, timings, task.code)
