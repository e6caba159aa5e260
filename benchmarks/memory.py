"""The largest resident memory of whole processes, each measured in a process of its own that does nothing else.

What is read is prepared beforehand by another process, and is not counted.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import common
from common import Table

#: Half an hour at 1 kHz.
SAMPLES = 1_800_000
LOGS = (("pyulog", "px4/sample.ulg"), ("pymavlink", "ardupilot/log_0036_mechanical_failure.bin"))

#: Prints, after what was to be measured, the peak of this very process image: ru_maxrss would keep that of the process it was forked from.
_PEAK = """
import json, pathlib, resource, sys
def peak():
    status = pathlib.Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1e3
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size / (1e6 if sys.platform == "darwin" else 1e3)
"""


def peak(statements: str, *arguments: str) -> tuple[float, dict[str, Any]]:
    """Largest resident memory [MB] of a process that runs statements; what they leave in ``told`` (a dictionary) comes back too."""
    program = f"{_PEAK}\ntold = {{}}\n{statements}\nprint('\\n' + json.dumps([peak(), told]))"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program, *arguments], check=False, capture_output=True, text=True, cwd=common.HERE
    )
    if done.returncode:
        raise RuntimeError(f"the measured process failed: {done.stderr.strip()[-500:]}")
    megabytes, told = json.loads(done.stdout.splitlines()[-1])
    return megabytes, told


RUN = """
import time
import haltere
flight = haltere.read(sys.argv[1])
began = time.perf_counter()
solution = haltere.run(flight)
told = {"filter": solution.summary["timings"]["filter_s"], "run": time.perf_counter() - began, "rows": len(solution)}
"""
COMMAND = """
import contextlib, io
from haltere import cli
sys.argv = ["haltere", "run", sys.argv[1], "--out", sys.argv[2]]
with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    try:
        cli.main()
    except SystemExit as end:
        if end.code:
            raise
"""


def run(samples: int = SAMPLES) -> list[Table]:
    """A long flight through the filter and through the whole command, reading it alone, reading logs, and bare imports."""
    columns = [
        ("what", "process", "text"), ("peak", "peak, MB", "whole"), ("wanted", "asked", "text"),
        ("met", "met", "text"),
    ]  # fmt: skip
    table = Table("memory", "Largest resident memory of a process of its own", columns)
    speed = Table(
        "half_hour",
        "The long flight in time",
        [("what", "what", "text"), ("value", "s", "number"), ("wanted", "asked", "text"), ("met", "met", "text")],
    )
    imports, _ = peak("import haltere; from haltere import Estimator, read, run; import haltere.readers.px4, haltere.flight.folder, polars")
    table.rows.append({"what": "haltere imported, with its compiled kernels", "peak": imports})

    def add(what: str, statements: str, *arguments: str, wanted: str = "") -> dict[str, Any]:
        try:
            megabytes, told = peak(statements, *arguments)
        except RuntimeError as error:  # the others are still worth having
            table.rows.append({"what": what, "failed": str(error)})
            return {}
        row: dict[str, Any] = {"what": what, "peak": megabytes}
        table.rows.append(common.judged(row, megabytes, wanted) if wanted else row)
        return told

    minutes = f"{samples / 60e3:.3g} min at 1 kHz"
    with tempfile.TemporaryDirectory() as folder:
        flight = str(Path(folder) / "flight")
        subprocess.run([sys.executable, str(common.HERE / "made.py"), flight, str(samples)], check=True)
        size = sum(p.stat().st_size for p in Path(flight).iterdir()) / 1e6
        table.title += f"; the long flight is {minutes}, {size:.0f} MB as a flight folder"
        add("haltere.read, the long flight", "import haltere\nflight = haltere.read(sys.argv[1])", flight)
        told = add("haltere.read and haltere.run, the long flight", RUN, flight, wanted="< 2000")
        if told and told["rows"] < 0.9 * samples:
            raise RuntimeError(f"the filter gave {told['rows']} rows of {samples}")
        add("haltere run with report and files, the long flight", COMMAND, flight, str(Path(folder) / "out"))
        if told:
            row = {"what": f"filter over {minutes}, wall", "value": told["filter"]}
            speed.rows.append(common.judged(row, told["filter"], "< 10"))
            speed.rows.append({"what": f"haltere.run over {minutes}, wall", "value": told["run"]})
    alone = {
        "pyulog": "from pyulog import ULog\nlog = ULog(sys.argv[1])",
        "pymavlink": "from pymavlink import DFReader\nlog = DFReader.DFReader_binary(sys.argv[1])\nwhile log.recv_msg() is not None: pass",
    }
    for library, name in LOGS:
        reason = common.missing_data(name) or common.missing(library)
        if reason:
            table.rows.append({"what": f"haltere.read, {Path(name).name}", "skipped": reason})
            continue
        path = str(common.data_folder() / name)
        add(f"haltere.read, {Path(name).name}", "import haltere\nflight = haltere.read(sys.argv[1])", path)
        add(f"{library} alone, {Path(name).name}", alone[library], path)
    return [table, speed]
