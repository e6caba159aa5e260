"""How right: attitude on BROAD beside the peers, the states of PX4's EKF2 on the same input, and the autopilot's own on a real flight.

Settings are each filter's defaults; nothing is tuned to these recordings. Times are not taken here, so all cores are used, and the
scores of peers, which depend on nothing of ours but how they are called, are kept in benchmarks/build until that or their version changes.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import common
from common import Table

sys.path.insert(0, str(common.ROOT / "tests"))
from converters import broad, broad_errors, ecl_replay, ekf2_output, enu_flu_from_ned_frd
from haltere import HaltereError
from haltere.drive import run as run_flight
from haltere.evaluate.peers import PEERS, Peer, Samples, estimate
from haltere.flight.log import FlightLog
from haltere.metrics.attitude import conjugate, multiply, rotation_vector, slerp
from haltere.metrics.errors import error_series
from haltere.readers import read

FloatArray = NDArray[np.float64]
DEG = math.pi / 180.0
OURS = "haltere ahrs"
#: Rows of the table of BROAD, the slowest last.
ALGORITHMS = (OURS, "vqf.VQF", "vqf.offlineVQF", "imufusion.Ahrs", "imufusion.Ahrs, advanced", "ahrs.Madgwick", "ahrs.Mahony", "ahrs.EKF")
#: Scores of peers by what they depend on.
SCORES = common.BUILD / "scores"
#: EKF2 replays and the time [s] after which its yaw stands.
REPLAYS = (("iris_gps", 8.0), ("ekf_gsf_reset", 8.0))
#: Log clock [s] of the failure in log_0036: after it there is no flight to agree on.
FAILURE = 371.0


def imufusion_advanced(s: Samples, heading: bool, told: Any) -> tuple[FloatArray, FloatArray, list[str]]:
    """imufusion with the settings of its advanced example: gain 0.5, rejection of 10 degrees both, 5 s of patience, bias correction."""
    import imufusion

    rate = 1.0 / float(np.median(np.diff(s.t)))
    flu = np.array([1.0, -1.0, -1.0])
    gyro, accel, mag = np.degrees(s.gyro) * flu, s.accel * flu / 9.80665, s.held()[0] * flu
    bias, peer = imufusion.Bias(), imufusion.Ahrs()
    bias.set_settings(imufusion.BiasSettings(sample_rate=rate))
    peer.set_settings(
        imufusion.AhrsSettings(
            sample_rate=rate, gain=0.5, gyroscope_range=2000, acceleration_rejection=10, magnetic_rejection=10, rejection_timeout=5
        )
    )
    q = np.empty((len(s.t), 4))
    for i in range(len(s.t)):
        peer.update(bias.update(gyro[i]), accel[i], mag[i])
        q[i] = peer.get_quaternion()
    half = np.array([0.0, 1.0, 0.0, 0.0])
    return s.t, multiply(multiply(half, q), half), ["settings of its advanced example"]


def peer_of(name: str) -> Peer:
    """A peer by its row's name."""
    return Peer(name, "imufusion", imufusion_advanced) if name == "imufusion.Ahrs, advanced" else PEERS[name]


def attitude(name: str, flight: FlightLog) -> FloatArray:
    """q_nb (n, 4) at the flight's IMU times; NaN before the filter gives anything."""
    imu = flight["imu"]
    if name == OURS:
        solution = run_flight(flight, "ahrs")
        t, rows = solution.t, solution.vector("q", "wxyz")
    else:
        mag = flight["magnetometer"]
        found = estimate(peer_of(name), Samples(imu.t, imu.vector("gyro"), imu.vector("accel"), mag.t, mag.vector("mag")))
        t, rows = found.t, found.q
    q = np.full((len(imu.t), 4), np.nan)
    q[np.searchsorted(imu.t, t)] = rows
    return q


def broad_score(task: tuple[str, str]) -> tuple[float, float]:
    """Total and inclination error [deg] of one algorithm on one trial, by the benchmark's own metric; a peer's is taken from `SCORES` where it is there."""
    name, path = task
    kept = None if name == OURS else SCORES / f"{_key(name, Path(path))}.json"
    if kept is not None and kept.exists():
        total, inclination = json.loads(kept.read_text(encoding="utf-8"))
        return float(total), float(inclination)
    flight, raw = broad(Path(path))
    score = broad_errors(enu_flu_from_ned_frd(attitude(name, flight)), raw)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        scratch = kept.with_suffix(f".{os.getpid()}")
        scratch.write_text(json.dumps(score), encoding="utf-8")
        scratch.replace(kept)
    return score


def _key(name: str, path: Path) -> str:
    """Everything a peer's score depends on: its version, NumPy's, how it is called and scored, and the recording."""
    from haltere.evaluate import peers

    said = [name, version(peer_of(name).package), version("numpy"), sys.version]
    said += [inspect.getsource(f) for f in (imufusion_advanced, attitude, broad, broad_errors, enu_flu_from_ned_frd)]
    digest = hashlib.sha256("\n".join(said).encode())
    for file in (Path(peers.__file__), path):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:24]


def broad_table(names: Sequence[str], trials: Sequence[Path], workers: int | None = None) -> Table:
    """Means over trials; every trial is in the JSON."""
    here = {p.stem for p in trials}
    columns = [
        ("what", "filter, default settings", "text"), ("total", "total", "fixed"), ("undisturbed", "undisturbed", "fixed"),
        ("disturbed", "magnetically disturbed", "fixed"), ("inclination", "inclination", "fixed"), ("middle", "median trial", "fixed"),
        ("worst", "worst trial", "fixed"),
    ]  # fmt: skip
    table = Table("broad", f"BROAD: orientation error RMS in the moving phases, degrees, mean over {len(here)} trials", columns)
    absent = {n: common.missing(peer_of(n).package) for n in names if n != OURS}
    tasks = [(n, str(p)) for n in reversed(names) if not absent.get(n) for p in trials]
    workers = workers or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    if workers > 1:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            scores = dict(zip(tasks, pool.map(broad_score, tasks), strict=True))
    else:
        scores = {task: broad_score(task) for task in tasks}
    for name in names:
        row: dict[str, Any] = {"what": name}
        if absent.get(name):
            table.rows.append(row | {"skipped": absent[name]})
            continue
        total = {p.stem: scores[name, str(p)][0] for p in trials}
        inclination = {p.stem: scores[name, str(p)][1] for p in trials}
        groups = {kind: [e for stem, e in total.items() if f"_{kind}_" in stem] for kind in ("undisturbed", "disturbed")}
        row |= {kind: float(np.mean(values)) for kind, values in groups.items() if values}
        row |= {"total": float(np.mean(list(total.values()))), "inclination": float(np.mean(list(inclination.values())))}
        row |= {"middle": float(np.median(list(total.values()))), "worst": max(total.values())}
        table.rows.append(row | {"trials": {k: [total[k], inclination[k]] for k in total}})
    return table


def ekf2_rows(name: str, settled: float) -> list[dict[str, Any]]:
    """RMS difference of our navigator from EKF2's states at EKF2's own delayed time, and largest, once its yaw stands.

    EKF2 was told a declination of its own, which its earth field states show, and counts height from another origin: that
    declination is given to ours, and the constant part of the height difference is not counted.
    """
    folder = common.data_folder() / "px4_ecl_replay"
    flight = ecl_replay(folder / f"{name}.csv")
    ekf2 = ekf2_output(folder / "ekf2_output" / f"{name}.csv")
    flight.meta.field = {"declination": float(np.median(np.arctan2(ekf2["field"][:, 1], ekf2["field"][:, 0])[ekf2["t"] > settled]))}
    solution = run_flight(flight)
    use = (ekf2["t"] > settled) & (ekf2["t"] < solution.t[-1])
    t = ekf2["t"][use]
    q = slerp(t, solution.t, solution.vector("q", "wxyz"))
    turn = np.linalg.norm(rotation_vector(multiply(conjugate(q), ekf2["q"][use])), axis=1) / DEG
    vel = np.column_stack([np.interp(t, solution.t, solution[f"vel_{a}"]) for a in "ned"]) - ekf2["vel"][use]
    pos = np.column_stack([np.interp(t, solution.t, solution[f"pos_{a}"]) for a in "ned"]) - ekf2["pos"][use]
    pos[:, 2] -= np.median(pos[:, 2])
    series = {"attitude, deg": turn, "velocity, m/s": np.linalg.norm(vel, axis=1), "position, m": np.linalg.norm(pos, axis=1)}
    return [{"what": f"{name}, {what}", "rms": rms(x), "max": float(x.max()), "n": len(x)} for what, x in series.items()]


def onboard_rows(path: Path) -> list[dict[str, Any]]:
    """RMS and largest difference of our navigator from the autopilot's own solution until the failure."""
    flight = read(path)
    solution = run_flight(flight)
    end = FAILURE - flight.meta.time_offset
    rows = []
    for name, (t, error) in error_series(solution, flight["onboard"]).items():
        kind = "deg" if name in ("roll", "pitch", "yaw") else {"vel": "m/s", "pos": "m"}.get(name[:3])
        if kind is None:
            continue
        e = error[t <= end] / (DEG if kind == "deg" else 1.0)
        rows.append({"what": f"{name}, {kind}", "rms": rms(e), "max": float(np.abs(e).max()), "n": len(e)})
    return rows


def rms(x: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def run(names: Sequence[str] = ALGORITHMS, trials: int | None = None, workers: int | None = None) -> list[Table]:
    """BROAD, EKF2 and log_0036; ``trials`` takes only the first few of BROAD."""
    tables = []
    found = sorted((common.data_folder() / "broad").glob("*.mat"))[:trials]
    if found:
        tables.append(broad_table(names, found, workers))
    else:
        reason = common.missing_data("broad") or f"{common.data_folder() / 'broad'} holds no trial"
        tables.append(
            Table("broad", "BROAD", [("what", "what", "text"), ("total", "total", "fixed")], [{"what": "BROAD", "skipped": reason}])
        )
    columns = [("what", "difference of", "text"), ("rms", "RMS", "number"), ("max", "largest", "number"), ("n", "rows", "whole")]
    ekf2 = Table("ekf2", "haltere navigator against PX4's EKF2 on the same simulated input", columns)
    for name, settled in REPLAYS:
        reason = common.missing_data("px4_ecl_replay", f"{name}.csv")
        ekf2.rows += [{"what": name, "skipped": reason}] if reason else ekf2_rows(name, settled)
    log = ("ardupilot", "log_0036_mechanical_failure.bin")
    onboard = Table("onboard", "haltere navigator against the autopilot's own EKF2, log_0036, until the failure", columns)
    reason = common.missing_data(*log)
    try:
        onboard.rows += [{"what": "log_0036", "skipped": reason}] if reason else onboard_rows(common.data_folder().joinpath(*log))
    except HaltereError as error:
        onboard.rows.append({"what": "log_0036", "failed": str(error)})
    return [*tables, ekf2, onboard]
