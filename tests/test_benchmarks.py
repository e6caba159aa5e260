"""The benchmarks run in every part and call the peers rightly. Nothing here looks at a time."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
import common
import made
import memory
import reading
import report
import run
import startup
import throughput
import twin
from haltere.flight.log import FlightLog
from haltere.metrics.attitude import conjugate, multiply, rotation_vector

DEG = math.pi / 180.0


def _quaternion(roll: float, pitch: float, yaw: np.ndarray) -> np.ndarray:
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = np.cos(yaw / 2), np.sin(yaw / 2)
    return np.stack([cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy], 1)


def _turning(n: int, declination: float = 0.0) -> twin.Flight:
    """A tilted vehicle that turns about the vertical in place: what any attitude filter must follow, if its units are right."""
    t, rate = np.arange(n) / throughput.RATE, 20.0 * DEG
    q = _quaternion(0.2, -0.1, 0.5 + rate * t)

    def body(v: list[float]) -> np.ndarray:
        x = np.tile(np.r_[0.0, v], (n, 1))
        return np.ascontiguousarray(multiply(multiply(conjugate(q), x), q)[:, 1:])

    level = math.cos(twin.FIELD[1])
    field = twin.FIELD[2] * np.array([level * math.cos(declination), level * math.sin(declination), math.sin(twin.FIELD[1])])
    zero = np.zeros((n, 3))
    gyro, accel, mag = body([0.0, 0.0, rate]), body([0.0, 0.0, -9.80665]), body(field.tolist())
    offered = np.arange(10, n, 10)  # the compass at 100 Hz, as measurements
    kind, none = np.full(len(offered), 3, np.int64), np.full((len(offered), 3), np.nan)
    return twin.Flight(t, gyro, accel, kind, t[offered], mag[offered], none, q, zero, zero, mag)


#: q_ned_earth: NED from the earth frame that each peer answers in; its body frame is the one it is fed, FRD.
_ENU, _NWU, _NED = (0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0), (0.0, 1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
_ATTITUDE: list[tuple[str, str, Any, tuple[float, ...]]] = [
    ("vqf", "updateBatch", throughput.vqf_batch, _ENU),
    ("vqf", "offline", throughput.vqf_offline, _ENU),
    ("vqf", "each", throughput.vqf_each, _ENU),
    ("imufusion", "each", throughput.imufusion_each, _NWU),
    ("ahrs", "Madgwick", lambda f: throughput.ahrs_batch(f, "Madgwick"), _NWU),
    ("ahrs", "Mahony", lambda f: throughput.ahrs_batch(f, "Mahony"), _ENU),
    ("ahrs", "EKF", lambda f: throughput.ahrs_batch(f, "EKF"), _NED),
]


@pytest.mark.parametrize(("module", "name", "make", "earth"), _ATTITUDE, ids=[f"{m}-{n}" for m, n, *_ in _ATTITUDE])
def test_a_peer_follows_a_turn(module: str, name: str, make: Any, earth: tuple[float, ...]) -> None:
    """To 3 degrees after two seconds: with deg/s for rad/s, or gravity upside down, it would be lost."""
    pytest.importorskip(module)
    flight = _turning(4000)
    _, q = make(flight)()
    assert q.shape == (4000, 4)
    answer = multiply(np.array(earth), q)[2000:]
    error = np.linalg.norm(rotation_vector(multiply(conjugate(answer), flight.q[2000:])), axis=1)
    assert error.max() < 3.0 * DEG


def test_filterpy_follows_the_position() -> None:
    pytest.importorskip("filterpy")
    flight = twin.fly(400)
    _, position = throughput.filterpy_run(flight)()
    assert np.abs(position - flight.pos[-1]).max() < 0.2


@pytest.mark.filterwarnings("ignore")  # pandas and numba of the peer's, not ours
@pytest.mark.parametrize("time_step", [0.1, 0.0])
def test_pyins_follows_the_flight(time_step: float) -> None:
    """Position within its noise, attitude within what the fixes leave open."""
    pytest.importorskip("pyins")
    flight = twin.fly(150 if time_step == 0.0 else 2000)
    _, trajectory = throughput.pyins_run(flight, time_step)()
    assert len(trajectory) == len(flight.t)
    last = trajectory.iloc[-1]
    assert abs(last.alt - (twin.HOME[2] - flight.pos[-1, 2])) < 2.0
    assert np.abs(last[["VN", "VE", "VD"]].to_numpy(float) - flight.vel[-1]).max() < 0.5
    q = _quaternion(last.roll * DEG, last.pitch * DEG, np.array([last.heading * DEG]))
    assert np.linalg.norm(rotation_vector(multiply(conjugate(q), flight.q[-1:]))) < 5.0 * DEG


@pytest.mark.parametrize("make", [lambda f: throughput.filter_run("navigator", f), throughput.step_run], ids=["batch", "each"])
def test_the_navigator_follows_the_flight(make: Any) -> None:
    """Batch and one sample at a time, with all measurements: the end of the flight to 3 degrees."""
    flight = twin.fly(6000)
    _, q = make(flight)()
    assert np.linalg.norm(rotation_vector(multiply(conjugate(q[-1]), flight.q[-1]))) < 3.0 * DEG


def test_ahrs_follows_a_turn() -> None:
    flight = _turning(4000, declination=twin.FIELD[0])
    _, q = throughput.filter_run("ahrs", flight)()
    assert np.linalg.norm(rotation_vector(multiply(conjugate(q[2000:]), flight.q[2000:])), axis=1).max() < 3.0 * DEG


def test_the_made_up_flight_is_the_same_as_a_log() -> None:
    """Every measurement in its stream, positions and velocities of one fix in one row."""
    f = twin.fly(3000)
    log = made.flight_log(f)
    assert isinstance(log, FlightLog)
    assert {name: len(log[name]) for name in log} == {"imu": 3000, "magnetometer": 299, "gnss": 29, "barometer": 149}
    t = log["gnss"].t
    rows = np.searchsorted(f.t, t)
    assert np.abs(log["gnss"].vector("vel", "ned") - f.vel[rows]).max() < 1.0
    assert np.abs((log["gnss"]["lat"] - twin.HOME[0]) * 111_180.0 - f.pos[rows, 0]).max() < 3.0
    assert np.abs(twin.HOME[2] - log["gnss"]["alt"] - f.pos[rows, 2]).max() < 5.0


@pytest.mark.filterwarnings("ignore")
def test_throughput_names_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A peer that is not installed is a row with its reason, and the ratios to it are gone; ours stay."""
    there = common.missing
    monkeypatch.setattr(common, "missing", lambda module: "vqf is not installed" if module == "vqf" else there(module) or "left out here")
    table, asked = throughput.run(rounds=1, samples=6000)
    rows = {row["what"]: row for row in table.rows}
    assert rows[throughput.YARDSTICK]["skipped"] == "vqf is not installed"
    assert rows["haltere navigator"]["speed"]["n"] == 3
    assert rows["haltere Estimator.step, navigator"]["speed"]["n"] == 1
    assert "ratio" not in rows["haltere navigator"]
    assert sum("skipped" in row for row in asked.rows) >= 2


def test_interleaving_runs_all_of_a_round_before_the_next() -> None:
    order: list[str] = []

    def runner(name: str) -> Any:
        def once() -> float:
            order.append(name)
            return float(len(order))

        return once

    seconds = common.interleave({"a": runner("a"), "b": runner("b")}, 2)
    assert order == ["a", "b"] * 3
    assert seconds == {"a": [3.0, 5.0], "b": [4.0, 6.0]}
    assert common.ratios(seconds["b"], seconds["a"]) == {"median": (4 / 3 + 6 / 5) / 2, "min": 6 / 5, "max": 4 / 3, "n": 2}


@pytest.mark.parametrize(
    ("value", "wanted", "met"), [(0.7, ">= 0.7", True), (0.69, ">= 0.7", False), (3.0, "< 3", False), (1.3, "<= 1.3", True)]
)
def test_what_is_asked_is_judged(value: float, wanted: str, met: bool) -> None:
    assert common.judged({}, value, wanted) == {"wanted": wanted, "met": met}


def test_one_core_is_given_back() -> None:
    import os

    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("this system cannot pin a process")
    before = os.sched_getaffinity(0)
    with common.one_core() as core:
        assert os.sched_getaffinity(0) == {core}
    assert os.sched_getaffinity(0) == before


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "function", "least"),
    [
        ("px4/sample_log_small.ulg", reading.pyulog_alone, 10_000),
        ("px4/sample_log_small.ulg", reading.pyulog_same_topics, 1000),
        ("ardupilot/beast_sample.bin", reading.pymavlink_alone, 10_000),
        ("ardupilot/nan.log", reading.pymavlink_alone, 1000),
    ],
)
def test_a_library_alone_reads_the_whole_log(shared_data: Path, name: str, function: Any, least: int) -> None:
    assert function(shared_data / name) > least


def test_the_same_topics_are_fewer_than_all(shared_data: Path) -> None:
    path = shared_data / "px4" / "sample_log_small.ulg"
    assert reading.pyulog_same_topics(path) < reading.pyulog_alone(path)


def test_the_bag_holds_what_was_put_in(tmp_path: Path) -> None:
    reading.make_bag(tmp_path / "bag", 2.0)
    assert reading.rosbags_alone(tmp_path / "bag") == 2 * (200 + 50 + 5 + 10)


@pytest.mark.filterwarnings("ignore")
def test_reading_has_a_row_for_each_way(shared_data: Path) -> None:
    rows = reading.compare(shared_data / "px4" / "sample_log_small.ulg", "pyulog", 1)
    assert [row["way"] for row in rows] == [name for name, _ in reading.ALONE["pyulog"]]
    assert all(row["ratio"]["n"] == 1 and row["ours"]["median"] > 0.0 for row in rows)


def test_memory_is_that_of_the_process_and_not_of_ours() -> None:
    """100 MB more are seen in a child, and 300 MB held here are not."""
    held = np.ones(300_000_000 // 8)
    small, told = memory.peak("told['x'] = 3")
    large, _ = memory.peak("a = bytearray(b'x' * 100_000_000)")
    assert told == {"x": 3}
    assert small < 100.0
    assert 90.0 < large - small < 250.0
    assert held[-1] == 1.0


def test_a_process_that_fails_is_told() -> None:
    with pytest.raises(RuntimeError, match="no such module"):
        memory.peak("raise ImportError('no such module')")
    with pytest.raises(RuntimeError, match="status 3"):
        common.ended([sys.executable, "-c", "raise SystemExit(3)"])


def test_processes_are_timed_on_the_wall_and_in_processor_seconds() -> None:
    took = startup.processes({"sleep": [sys.executable, "-c", "import time; time.sleep(0.3)"]}, 2)
    wall, cpu = took["sleep"]
    assert wall["n"] == cpu["n"] == 2
    assert wall["min"] >= 0.3


@pytest.fixture
def results() -> dict[str, Any]:
    columns = [["what", "what", "text"], ["speed", "samples/s", "rate"], ["met", "met", "text"]]
    rows = [
        {"what": "haltere a|b", "speed": {"median": 2.5e6, "min": 2e6, "max": 3e6, "n": 3}, "met": True},
        {"what": "other", "speed": {"median": 900.0, "min": 900.0, "max": 900.0, "n": 1}, "met": False},
        {"what": "absent", "skipped": "x is not installed"},
        {"what": "broken", "failed": "ValueError: y"},
    ]
    load = {"seconds": 3.2, "load_before": [0.5, 0, 0], "load_after": [1.5, 0, 0], "others_cores": 0.25}
    part = {"title": "Speed", "tables": [{"name": "t", "title": "A table", "columns": columns, "rows": rows}], **load}
    machine = {
        "date": "2026-01-01 00:00 UTC", "processor": "P", "cores": 2, "memory_gb": None, "system": "S", "python": "3", "compiler": None,
        "versions": {"numpy": "2"}, "commit": None,
    }  # fmt: skip
    return {
        "machine": machine,
        "command": "make bench",
        "parts": {"throughput": part, "memory": {"title": "Memory", "failed": "no", **load}},
    }


def test_a_table_says_range_reason_and_verdict(results: dict[str, Any]) -> None:
    lines = report.part(results, "throughput").splitlines()
    assert lines[0] == "**A table**"
    assert lines[2:] == [
        "| what | samples/s | met |",
        "|---|--:|---|",
        r"| haltere a\|b | 2.5 (2 – 3) M | yes |",
        "| other | 900 | **no** |",
        "| absent | skipped: x is not installed |  |",
        "| broken | failed: ValueError: y |  |",
    ]
    assert "was not run" in report.part(results, "reading")
    assert "failed: no" in report.part(results, "memory")
    text = report.markdown(results)
    assert "other processes kept 0.25 cores busy" in text and "load average 0.50 before and 1.50 after" in text


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        ({"median": 985e3, "min": 791e3, "max": 1314e3, "n": 9}, "rate", "985 (791 – 1314) k"),
        ({"median": 1 / 243, "min": 1 / 336, "max": 0.11, "n": 3}, "ratio", "1/243 (1/336 – 0.11)"),
        ({"median": 0.8093, "min": 0.8, "max": 1.108, "n": 3}, "ms", "809 (800 – 1108)"),
        (1722.4, "whole", "1 722"),
        (2.4321, "fixed", "2.43"),
        (None, "text", ""),
    ],
)
def test_a_cell(value: Any, kind: str, text: str) -> None:
    assert report.cell(value, kind) == text


def test_bars_have_their_lengths_in_order(results: dict[str, Any]) -> None:
    import re

    rows = report.rows_of(results, "throughput", "t")
    assert [row["what"] for row in rows] == ["haltere a|b", "other"]
    for logarithmic in (True, False):
        svg = report.bars(rows, "speed", "a second", logarithmic=logarithmic, kind="rate")
        widths = [float(w) for w in re.findall(r'<rect [^>]*width="([\d.]+)"', svg)]
        assert widths[0] > widths[1] >= 1.0
        assert "2.5 M" in svg


def test_problems_are_found_in_parts_and_rows(results: dict[str, Any]) -> None:
    failed, skipped = run.problems(results)
    assert failed == ["memory: no", "throughput: broken: ValueError: y"] or sorted(failed) == [
        "memory: no",
        "throughput: broken: ValueError: y",
    ]
    assert skipped == ["throughput: absent: x is not installed"]


def test_the_command_writes_and_judges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Skipped is status 0, and 1 when strict; a part that falls over is 1, and the others are still there."""

    def part(**settings: Any) -> list[common.Table]:
        return [
            common.Table(
                "t", "T", [("what", "what", "text"), ("x", "x", "number")], [{"what": "a", "x": 1.0}, {"what": "b", "skipped": "not there"}]
            )
        ]

    def broken(**settings: Any) -> list[common.Table]:
        raise ValueError("fell over")

    monkeypatch.setattr(reading, "run", part)
    monkeypatch.setattr(memory, "run", broken)
    monkeypatch.delenv("CI", raising=False)
    arguments = ["--only", "reading", "--out", str(tmp_path)]
    assert run.main(arguments) == 0
    assert "skipped: reading: b: not there" in capsys.readouterr().err
    assert run.main([*arguments, "--strict"]) == 1
    assert run.main([*arguments, "--only", "memory"]) == 1
    written = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert written["parts"]["reading"]["tables"][0]["rows"][0]["x"] == 1.0
    assert written["parts"]["memory"]["failed"] == "ValueError: fell over"
    assert (tmp_path / "results.md").read_text(encoding="utf-8").startswith("# Benchmarks")
    with pytest.raises(SystemExit):
        run.main(["--publish", "--quick"])


@pytest.mark.real
def test_a_peers_score_on_broad(shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """VQF on a slow trial is right to three degrees, which no mistake of frame or unit would leave, and its kept score is the same."""
    pytest.importorskip("vqf")
    import accuracy

    monkeypatch.setattr(accuracy, "SCORES", tmp_path)
    trial = next((shared_data / "broad").glob("01_*.mat"))
    first = accuracy.broad_table(["vqf.VQF"], [trial], workers=1)
    assert len(list(tmp_path.iterdir())) == 1
    assert first.rows[0]["inclination"] < first.rows[0]["total"] < 3.0
    assert accuracy.broad_table(["vqf.VQF"], [trial], workers=1).rows == first.rows


@pytest.mark.real
def test_ours_and_ekf2_differ_little(shared_data: Path) -> None:
    import accuracy

    rows = {row["what"]: row for row in accuracy.ekf2_rows("iris_gps", 8.0)}
    assert rows["iris_gps, attitude, deg"]["rms"] < 1.0
    assert rows["iris_gps, velocity, m/s"]["rms"] < 0.5
    assert all(0.0 < row["rms"] <= row["max"] for row in rows.values())


def test_the_published_page_has_every_table() -> None:
    """What the documentation asks for by name is in the published figures."""
    published = report.load(run.PUBLISHED)
    assert set(published["parts"]) == set(run.PARTS)
    assert not published["quick"]
    names = {t["name"] for part in published["parts"].values() for t in part["tables"]}
    assert names == {"throughput", "asked", "reading", "startup", "memory", "half_hour", "broad", "ekf2", "onboard"}
    assert run.problems(published)[0] == []
