"""How long whole processes take: the command line, an import, and the main job with a warm and with an empty cache of compiled kernels.

Wall time is what a user waits; processor time stands beside it, since other work on the machine stretches only the first.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
from common import Table

ROUNDS = 7
RUNS = 3
LOG = "ardupilot/log_0036_mechanical_failure.bin"


def processes(commands: dict[str, Sequence[str]], rounds: int, **environment: str) -> dict[str, tuple[common.Measure, common.Measure]]:
    """Wall and processor seconds of whole processes, interleaved."""
    took: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
    for command in commands.values():
        common.ended(command, **environment)
    for _ in range(rounds):
        for name, command in commands.items():
            took[name].append(common.ended(command, **environment))
    return {name: (common.measure([w for w, _ in both]), common.measure([c for _, c in both])) for name, both in took.items()}


def run(rounds: int = ROUNDS, runs: int = RUNS, cold: bool = True) -> list[Table]:
    """Small processes beside bare Python, then ``haltere run`` on a real log; ``cold`` compiles all kernels into an empty folder first."""
    columns = [
        ("what", "process", "text"), ("wall", "wall, s", "number"), ("cpu", "processor, s", "number"), ("wanted", "asked", "text"),
        ("met", "met", "text"),
    ]  # fmt: skip
    table = Table("startup", "Whole processes, median (range), interleaved", columns)
    haltere, python = common.haltere_command(), sys.executable
    asked = {"haltere --help": "< 0.4"}

    def rows(took: dict[str, tuple[common.Measure, common.Measure]]) -> None:
        for name, (wall, cpu) in took.items():
            row: dict[str, Any] = {"what": name, "wall": wall, "cpu": cpu}
            table.rows.append(common.judged(row, wall["median"], asked[name]) if name in asked else row)

    commands: dict[str, Sequence[str]] = {
        "python -c pass": (python, "-c", "pass"),
        "python -c 'import numpy'": (python, "-c", "import numpy"),
        "python -c 'import haltere'": (python, "-c", "import haltere"),
        "python -c 'from haltere import Estimator, read, run'": (python, "-c", "from haltere import Estimator, read, run"),
        "haltere --help": (haltere, "--help"),
    }
    for module, statement in (
        ("vqf", "import vqf"),
        ("ahrs", "import ahrs"),
        ("filterpy", "import filterpy.kalman"),
        ("pyins", "import pyins.filters"),
    ):
        reason = common.missing(module)
        if reason:
            table.rows.append({"what": f"python -c '{statement}'", "skipped": reason})
        else:
            commands[f"python -c '{statement}'"] = (python, "-W", "ignore", "-c", statement)
    rows(processes(commands, rounds))

    reason = common.missing_data(LOG)
    name = Path(LOG).stem.partition("_mech")[0]
    if reason:
        table.rows.append({"what": f"haltere run {name}", "skipped": reason})
        return [table]
    log = str(common.data_folder() / LOG)
    asked |= {f"haltere run {name}, empty cache": "< 30", f"haltere run {name}": "< 5"}
    with tempfile.TemporaryDirectory() as folder:
        job = (haltere, "run", log, "--out", f"{folder}/out")
        cache = {"HALTERE_CACHE_DIR": f"{folder}/cache"} if cold else {}
        if cold:
            wall, cpu = common.ended(job, **cache)
            rows({f"haltere run {name}, empty cache": (common.measure([wall]), common.measure([cpu]))})
        rows(processes({f"haltere info {name}": (haltere, "info", log), f"haltere run {name}": job}, runs, **cache))
    return [table]
