"""What every part of the benchmarks shares: medians, interleaving, the machine and its load, and how something absent is named.

It times nothing of its own choosing and judges nothing.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
BUILD = HERE / "build"

#: Distributions whose versions stand beside the figures.
DISTRIBUTIONS = (
    "haltere", "numpy", "numba", "llvmlite", "polars", "scipy", "vqf", "imufusion", "ahrs", "filterpy", "python-ins", "pyulog",
    "pymavlink", "rosbags", "orangebox",
)  # fmt: skip

Measure = dict[str, float]


@dataclass
class Table:
    """One table of results.

    Attributes
    ----------
    title
        Its caption.
    columns
        ``(key, heading, kind)``; the kinds are those of `report.cell`.
    rows
        Values by key: numbers, texts, `measure` results, or ``skipped`` with the reason.
    name
        By which the documentation asks for it.
    """

    name: str
    title: str
    columns: Sequence[tuple[str, str, str]]
    rows: list[dict[str, Any]] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """The table as plain values."""
        return {"name": self.name, "title": self.title, "columns": [list(c) for c in self.columns], "rows": self.rows}


def measure(values: Sequence[float]) -> Measure:
    """Median, smallest, largest and number of repeated measurements."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values), "n": len(values)}


def judged(row: dict[str, Any], value: float, wanted: str) -> dict[str, Any]:
    """The row with what was asked (``>= 0.7`` or ``< 3``) and whether the value meets it."""
    sign, _, limit = wanted.partition(" ")
    met = {">=": value >= float(limit), "<": value < float(limit), "<=": value <= float(limit)}[sign]
    return row | {"wanted": wanted, "met": met}


def interleave(runners: dict[str, Callable[[], float]], rounds: int, warm: bool = True) -> dict[str, list[float]]:
    """Seconds of every runner in each round: all once, then all again, so that a change of the machine's load meets all alike."""
    if warm:
        for run in runners.values():
            run()
    seconds: dict[str, list[float]] = {name: [] for name in runners}
    for _ in range(rounds):
        for name, run in runners.items():
            seconds[name].append(run())
    return seconds


def ratios(above: Sequence[float], below: Sequence[float]) -> Measure:
    """Ratio taken round by round."""
    return measure([a / b for a, b in zip(above, below, strict=True)])


def missing(module: str) -> str | None:
    """Why a module cannot be used, or None."""
    try:
        there = importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        there = False
    return None if there else f"{module.partition('.')[0]} is not installed"


def data_folder() -> Path:
    """Folder of the recordings: HALTERE_DATA, else ``../shared/data`` beside the project."""
    return Path(os.environ.get("HALTERE_DATA") or ROOT.parent / "shared" / "data")


def missing_data(*parts: str) -> str | None:
    """Why a recording cannot be used, or None."""
    path = data_folder().joinpath(*parts)
    return None if path.exists() else f"{path} is not there (HALTERE_DATA names the folder)"


@contextlib.contextmanager
def one_core() -> Iterator[int | None]:
    """Keep this thread, and the processes it starts, on one core; gives its number, or None where that cannot be done."""
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    before = os.sched_getaffinity(0)
    core = max(before)
    os.sched_setaffinity(0, {core})
    try:
        yield core
    finally:
        os.sched_setaffinity(0, before)


#: Processor time of all threads: unlike the time on the wall it does not count the turns that other processes had on the core.
clock = time.process_time


def ended(command: Sequence[str], **environment: str) -> tuple[float, float]:
    """Seconds on the wall and of processor of a whole process; what it says is thrown away unless it fails."""
    own, began = os.times(), time.perf_counter()
    done = subprocess.run(command, check=False, capture_output=True, text=True, env={**os.environ, **environment})
    seconds, after = time.perf_counter() - began, os.times()
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with status {done.returncode}: {done.stderr.strip()[-500:]}")
    return seconds, after.children_user + after.children_system - own.children_user - own.children_system


def haltere_command() -> str:
    """The command line's script of this interpreter."""
    return str(Path(sys.executable).parent / "haltere")


class Load:
    """How busy the machine was meanwhile: load averages at both ends, and cores kept busy by other processes than ours."""

    def __init__(self) -> None:
        self._before, self._busy, self._own, self._began = self._average(), _busy_seconds(), _own_seconds(), time.perf_counter()

    @staticmethod
    def _average() -> list[float] | None:
        return [round(x, 2) for x in os.getloadavg()] if hasattr(os, "getloadavg") else None

    def end(self) -> dict[str, Any]:
        """Seconds since the beginning, load averages, and cores that others kept busy (None where the system does not tell)."""
        seconds = time.perf_counter() - self._began
        busy = _busy_seconds()
        others = None
        if busy is not None and self._busy is not None and seconds > 0.0:
            others = round(max(0.0, (busy - self._busy) - (_own_seconds() - self._own)) / seconds, 2)
        return {"seconds": round(seconds, 1), "load_before": self._before, "load_after": self._average(), "others_cores": others}


def _busy_seconds() -> float | None:
    """CPU seconds that all processes together have used since the machine started."""
    try:
        first = Path("/proc/stat").read_text(encoding="ascii").partition("\n")[0].split()
        user, nice, system, _idle, _wait, irq, softirq, *_ = (int(x) for x in first[1:])
        return (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return None


def _own_seconds() -> float:
    """CPU seconds of this process and of those it started that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def machine() -> dict[str, Any]:
    """Machine, versions and date."""
    found: dict[str, str] = {}
    for name in DISTRIBUTIONS:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gb": _memory(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "compiler": _compiler(),
        "versions": found,
        "commit": _commit(),
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    for line in info.read_text(encoding="utf-8").splitlines() if info.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _memory() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    except (OSError, ValueError):
        return None


def _said(command: Sequence[str]) -> str | None:
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _compiler() -> str | None:
    said = _said(["g++", "--version"])
    return said.partition("\n")[0] if said else None


def _commit() -> str | None:
    commit = _said(["git", "rev-parse", "--short=12", "HEAD"])
    if commit is None:
        return None
    return commit + (" with changes" if _said(["git", "status", "--porcelain", "--untracked-files=no", "--", "src"]) else "")
