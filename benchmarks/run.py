"""`make bench`: speed side by side in one run, interleaved, with medians, ratios, machine and versions. It asserts nothing.

Prints a Markdown table and writes ``results.md`` and ``results.json`` into benchmarks/build.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import twin  # noqa: E402
from haltere.aids.record import AID_RECORD  # noqa: E402
from haltere.estimators import step as kernels  # noqa: E402
from haltere.estimators.base import Estimator, new_state  # noqa: E402
from haltere.estimators.inputs import parameters  # noqa: E402

RUNS = 15
SAMPLES = 100_000
Row = dict[str, Any]


def filter_runner(estimator: str, flight: twin.Flight) -> Callable[[], float]:
    """Seconds of one run of the compiled filter, everything on: gates, aid records, output rows, queue, rest, yaw bank."""
    config = twin.configuration_of(estimator)
    first, prm = new_state(config, flight.initial(16 if estimator == "navigator" else 15)), parameters(config)
    use = np.isin(flight.kind, [3]) if estimator == "ahrs" else np.ones(len(flight.kind), bool)
    kind, stamp, z, r = flight.kind[use], flight.stamp[use], flight.z[use], flight.r[use]
    n = len(flight.t)
    rows = np.empty((n + 2000, int(kernels.row_width(first["baro"].shape[1]))))
    cov, aids = np.empty((kernels.COVARIANCE_ROWS, n // 50)), np.empty(400_000, AID_RECORD)

    def run() -> float:
        S = first.copy()
        began = time.perf_counter()
        i = j = 0
        while i < n or S["imu_n"][0] > 0:
            i, j = kernels.run_chunk(S, prm, flight.t, flight.gyro, flight.accel, i, n, kind, stamp, z, r, j, rows, cov, aids)
            S["n_aids"] = S["n_events"] = 0
        seconds = time.perf_counter() - began
        if int(S["n_rows"][0]) != n:
            raise RuntimeError("the filter did not run to the end")
        return seconds

    return run


def peers(flight: twin.Flight) -> dict[str, Callable[[], float] | str]:
    """What ours is compared with, or why it is not there."""
    out: dict[str, Callable[[], float] | str] = {}
    try:
        import vqf

        def attitude() -> float:
            peer = vqf.VQF(1.0 / 1000.0)
            began = time.perf_counter()
            peer.updateBatch(flight.gyro, flight.accel, flight.mag)
            return time.perf_counter() - began

        out["vqf.VQF.updateBatch"] = attitude
    except ImportError:
        out["vqf.VQF.updateBatch"] = "vqf is not installed"
    reason = twin.missing()
    if reason:
        out["C++ twin"] = reason
    else:
        peer = twin.Twin(twin.configuration_of())
        rows = np.empty((len(flight.t), 37))

        def cpp() -> float:
            state = peer.begin(flight.initial())
            began = time.perf_counter()
            peer.run(state, flight, rows)
            return time.perf_counter() - began

        out["C++ twin"] = cpp
    return out


def throughput() -> list[Row]:
    """Filters and peers, interleaved; the ratio is taken run by run."""
    flight = twin.fly(SAMPLES)
    others = peers(flight)
    ours = {"navigator": filter_runner("navigator", flight), "ahrs": filter_runner("ahrs", flight)}
    runners = ours | {k: f for k, f in others.items() if callable(f)}
    for run in runners.values():
        run()
    seconds: dict[str, list[float]] = {k: [] for k in runners}
    for _ in range(RUNS):
        for name, run in runners.items():
            seconds[name].append(run())
    rows: list[Row] = []
    for name in runners:
        per_second = [SAMPLES / s for s in seconds[name]]
        rows.append({"what": f"{name}, samples/s", "median": statistics.median(per_second), "min": min(per_second), "max": max(per_second)})
    for name, peer, wanted in (
        ("navigator", "vqf.VQF.updateBatch", 0.7),
        ("navigator", "C++ twin", 0.65),
        ("ahrs", "vqf.VQF.updateBatch", 1.0),
    ):
        if peer not in seconds:
            rows.append({"what": f"{name} / {peer}", "skipped": others[peer]})
            continue
        ratios = [b / a for a, b in zip(seconds[name], seconds[peer], strict=True)]
        middle = statistics.median(ratios)
        rows.append(
            {
                "what": f"{name} / {peer}, speed",
                "median": middle,
                "min": min(ratios),
                "max": max(ratios),
                "wanted": f">= {wanted}",
                "met": middle >= wanted,
            }
        )
    return rows


def online() -> list[Row]:
    """One `Estimator.step` at a time from Python, measurements offered between."""
    flight = twin.fly(30_000)
    est = Estimator("navigator", twin.configuration_of())
    gyro, accel, t = [tuple(x) for x in flight.gyro.tolist()], [tuple(x) for x in flight.accel.tolist()], flight.t.tolist()
    took: list[int] = []
    for i in range(len(t)):
        if i % 10 == 0:
            est.offer("magnetometer", t[i], flight.mag[i])
        began = time.perf_counter_ns()
        est.step(t[i], gyro[i], accel[i])
        took.append(time.perf_counter_ns() - began)
        if i % 1000 == 0:
            est.records()
    middle = float(np.median(took[2000:])) * 1e-3
    return [
        {
            "what": "Estimator.step, us",
            "median": middle,
            "max": float(np.percentile(took[2000:], 99)) * 1e-3,
            "wanted": "< 3",
            "met": middle < 3.0,
        }
    ]


def _wall(command: list[str], runs: int, **environment: str) -> list[float]:
    out = []
    for _ in range(runs):
        began = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True, env={**os.environ, **environment})
        out.append(time.perf_counter() - began)
    return out


def start() -> list[Row]:
    """Start of the command line, and the main job with a warm and an empty cache of compiled kernels."""
    haltere = str(Path(sys.executable).parent / "haltere")
    took = _wall([haltere, "--help"], 11)[1:]
    rows: list[Row] = [
        {
            "what": "haltere --help, s",
            "median": statistics.median(took),
            "min": min(took),
            "max": max(took),
            "wanted": "< 0.4",
            "met": statistics.median(took) < 0.4,
        }
    ]
    log = Path(os.environ.get("HALTERE_DATA") or HERE.parents[1] / "shared" / "data") / "ardupilot" / "log_0036_mechanical_failure.bin"
    if not log.exists():
        return [*rows, {"what": "haltere run, log_0036", "skipped": f"{log} is not there"}]
    with tempfile.TemporaryDirectory() as folder:
        command = [haltere, "run", str(log), "--out", f"{folder}/out"]
        cold = _wall(command, 1, HALTERE_CACHE_DIR=f"{folder}/cache")[0]
        warm = _wall(command, 5, HALTERE_CACHE_DIR=f"{folder}/cache")
    rows.append({"what": "haltere run log_0036, empty cache, s", "median": cold, "wanted": "< 30", "met": cold < 30.0})
    middle = statistics.median(warm)
    return [
        *rows,
        {
            "what": "haltere run log_0036, warm, s",
            "median": middle,
            "min": min(warm),
            "max": max(warm),
            "wanted": "< 5",
            "met": middle < 5.0,
        },
    ]


HALF_HOUR = """
import resource, sys
sys.path.insert(0, {here!r})
import twin
import numpy as np
from haltere.drive import run
from haltere.flight.log import FlightLog, FlightMeta, Home
f = twin.fly(1_800_000)
xyz = lambda stem, v: {{f"{{stem}}_{{a}}": v[:, k] for k, a in enumerate("xyz")}}
code = lambda k: f.kind == k
v, p, b, m = code(0), code(1), code(2), code(3)
flight = FlightLog({{
    "imu": {{"t": f.t, **xyz("gyro", f.gyro), **xyz("accel", f.accel)}},
    "magnetometer": {{"t": f.stamp[m], **xyz("mag", f.z[m])}},
    "gnss": {{"t": f.stamp[v], "vel_n": f.z[v, 0], "vel_e": f.z[v, 1], "vel_d": f.z[v, 2], "lat": f.z[p, 0], "lon": f.z[p, 1], "alt": f.z[p, 2]}},
    "barometer": {{"t": f.stamp[b], "altitude": f.z[b, 0]}},
}}, FlightMeta(name="half an hour", home=Home(*twin.HOME), field=dict(declination=twin.FIELD[0], dip=twin.FIELD[1], strength=twin.FIELD[2])))
del f
solution = run(flight)
solution = run(flight)
print(solution.summary["timings"]["filter_s"], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, len(solution))
"""


def half_hour() -> list[Row]:
    """Thirty minutes at 1 kHz in a process of its own: seconds of filter, and the largest memory of the whole process."""
    done = subprocess.run([sys.executable, "-c", HALF_HOUR.format(here=str(HERE))], check=True, capture_output=True, text=True)
    seconds, memory, _ = (float(x) for x in done.stdout.split())
    return [
        {"what": "30 min at 1 kHz, filter s", "median": seconds, "wanted": "< 10", "met": seconds < 10.0},
        {"what": "30 min at 1 kHz, process GB (input made in it)", "median": memory, "wanted": "< 2", "met": memory < 2.0},
    ]


def main() -> None:
    """Run every benchmark, print the table and write it."""
    rows = throughput() + online() + start() + half_hour()
    names = ("numba", "numpy", "vqf", "polars")
    machine = {
        "processor": _processor(), "cores": os.cpu_count(), "load": os.getloadavg(), "python": platform.python_version(),
        "versions": {n: version(n) for n in names if _has(n)}, "runs": RUNS, "samples": SAMPLES,
    }  # fmt: skip
    lines = ["| what | median | min | max | wanted | met |", "|---|---|---|---|---|---|"]
    for row in rows:
        if "skipped" in row:
            lines.append(f"| {row['what']} | skipped: {row['skipped']} | | | | |")
            continue
        numbers = [f"{row[k]:.4g}" if k in row else "" for k in ("median", "min", "max")]
        lines.append(
            f"| {row['what']} | {' | '.join(numbers)} | {row.get('wanted', '')} | {'' if 'met' not in row else 'yes' if row['met'] else 'NO'} |"
        )
    text = "\n".join([json.dumps(machine), "", *lines, ""])
    print(text)
    folder = HERE / "build"
    folder.mkdir(exist_ok=True)
    (folder / "results.md").write_text(text)
    (folder / "results.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1))


def _has(name: str) -> bool:
    try:
        version(name)
    except Exception:
        return False
    return True


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


if __name__ == "__main__":
    main()
