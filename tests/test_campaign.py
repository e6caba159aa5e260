"""Campaigns: what a specification means, that nothing is lost or made twice, that workers change nothing, verdicts, tables and the page."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy import stats

from haltere import cli
from haltere.errors import HaltereError, UsageError
from haltere.evaluate import campaign as room
from haltere.evaluate.campaign import Results, campaign
from haltere.evaluate.campaign_plan import Plan, load_plan, parse_plan
from haltere.evaluate.campaign_pool import processes
from haltere.evaluate.campaign_require import Requirement, judge
from haltere.evaluate.campaign_run import Result, Task, code, work
from haltere.evaluate.campaign_store import Store
from haltere.evaluate.campaign_summary import summary
from haltere.flight.folder import write_folder
from haltere.metrics.campaign import MISSED, NOBODY, SEVERAL, by_size, confusion, consistency, distribution, roc
from haltere.report.campaign import campaign_page
from haltere.simulate import parse_scenario, simulate
from report_page import browse, numbers, sections

#: A flight that takes a tenth of a second.
SHORT = {"base": "hover", "duration": 16.0, "sensors": {"imu": {"rate": 100.0}}}
SPEC = """
name = "short"
seeds = {seeds}
estimators = ["navigator", "ahrs"]

[scenario]
base = "hover"
duration = 16.0
sensors.imu.rate = 100.0

[grid]
"wind.n" = [0, 4]
fault = ["", "gyro.x:bias={{size}}deg/s@13"]
"fault.size" = [2, 5]

[[require]]
metric = "tilt_deg.rms"
statistic = "p95"
limit = 5.0
where = {{ estimator = "navigator", fault = "" }}
"""


def plan(**keys: Any) -> Plan:
    return parse_plan({"scenario": SHORT, **keys})


def written(folder: Path, seeds: int = 2) -> Path:
    path = folder / "short.toml"
    path.write_text(SPEC.format(seeds=seeds), encoding="utf-8")
    return path


def page_of(results: Results) -> str:
    return campaign_page(results.runs, results.faults, results.summary, results.plan.text, "haltere campaign short.toml")


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """The short campaign, made in this process without a stop."""
    folder = tmp_path_factory.mktemp("campaign")
    results = campaign(written(folder), folder / "out", workers=1)
    results.save({"campaign.html": page_of(results)})
    return results


def equal(a: Path, b: Path) -> None:
    """Tables of two folders, but for the timings, and summaries."""
    for name in ("results", "faults"):
        assert (a / f"{name}.parquet").read_bytes() == (b / f"{name}.parquet").read_bytes(), name
    first, second = (json.loads((f / "summary.json").read_text(encoding="utf-8")) for f in (a, b))
    for s in (first, second):
        s.pop("timings"), s.pop("notes")
    assert first == second


# --- the specification ---------------------------------------------------------------------------------------------------


def test_a_grid_is_the_full_product_and_identical_runs_are_made_once() -> None:
    p = plan(
        seeds=3, estimators=["navigator", "ahrs"],
        grid={"wind": {"n": [0.0, 4.0]}, "fault": ["", "gyro.x:bias={size}deg/s@13"], "fault.size": [2, 5]},
    )  # fmt: skip
    # without a fault its size does not matter: 2 winds x (1 + 2) x 2 estimators x 3 seeds
    assert len(p.runs) == 36
    assert p.same == 2 * 2 * 3
    assert [r.index for r in p.runs] == list(range(36))
    assert len({r.id for r in p.runs}) == 36
    assert p.factors == ("wind.n", "fault.size", "fault", "estimator", "seed")
    assert p.varied == p.factors
    faults = {r.scenario.fault for r in p.runs if r.scenario is not None}
    assert faults == {(), ("gyro.x:bias=2deg/s@13",), ("gyro.x:bias=5deg/s@13",)}
    scenario = p.runs[-1].scenario
    assert scenario is not None
    assert (scenario.wind["n"], scenario.wind["e"], scenario.seed) == (4.0, 1.0, 3), "the rest is that of the base"


@pytest.mark.parametrize(
    ("seeds", "expected"), [(3, [1, 2, 3]), ([7, 5], [7, 5]), ("4-6", [4, 5, 6]), (None, [1])]
)  # fmt: skip
def test_seeds(seeds: Any, expected: list[int]) -> None:
    p = plan(**({} if seeds is None else {"seeds": seeds}))
    assert [r.factors["seed"] for r in p.runs] == expected


def test_configuration_presets_and_estimators_of_a_run() -> None:
    p = plan(estimators=["navigator:gate.gnss=3", "ahrs"], set={"noise": {"gyro": 2e-3}}, grid={"aid.magnetometer": ["off", "3-axis"]})
    assert len(p.runs) == 4
    first = p.runs[0]
    assert (first.estimator, first.preset) == ("navigator", "default")
    assert {k: str(v) for k, v in first.keys.items()} == {"noise.gyro": "0.002", "aid.magnetometer": "off", "gate.gnss": "3"}
    assert first.factors["estimator"] == "navigator:gate.gnss=3"


def test_cases_are_explicit_and_multiply_with_the_rest() -> None:
    p = plan(
        case=[
            {"wind": {"n": 8.0}, "fault": "gnss:dropout@13-15"},
            {"mission": "box", "duration": 30.0, "home": {"lat": 10.0, "lon": 20.0, "alt": 30.0}},
        ],
        seeds=2,
    )
    assert len(p.runs) == 4
    assert [r.factors.get("mission") for r in p.runs] == [None, None, "box", "box"]
    assert p.runs[3].scenario is not None
    assert p.runs[3].scenario.home.lat == 10.0


def test_a_sample_is_reproducible_and_neither_more_draws_nor_more_keys_change_a_draw() -> None:
    rules = {"wind.n": {"uniform": [-8.0, 8.0]}, "gate.gnss": {"normal": [5.0, 0.5]}, "fault.size": {"log_uniform": [1e-2, 10.0]},
             "mission": {"choice": ["hover", "climb"]}, "sensors.gnss.sats": {"integer": [6, 9]}}  # fmt: skip
    whole = plan(sample={"n": 300, **rules}, fault="gyro.x:bias={size}deg/s@13")
    few = plan(sample={"n": 20, **{k: rules[k] for k in ("wind.n", "gate.gnss")}})
    drawn = {k: [r.factors[k] for r in whole.runs] for k in rules}
    assert [r.factors["wind.n"] for r in few.runs] == drawn["wind.n"][:20]
    assert [r.factors["gate.gnss"] for r in few.runs] == drawn["gate.gnss"][:20]
    assert [r.factors["seed"] for r in whole.runs] == list(range(1, 301)), "each draw is a flight of its own"
    assert stats.kstest(drawn["wind.n"], stats.uniform(-8.0, 16.0).cdf).pvalue > 1e-3
    assert stats.kstest(drawn["gate.gnss"], stats.norm(5.0, 0.5).cdf).pvalue > 1e-3
    assert stats.kstest(np.log10(drawn["fault.size"]), stats.uniform(-2.0, 3.0).cdf).pvalue > 1e-3
    assert set(drawn["mission"]) == {"hover", "climb"}
    assert set(drawn["sensors.gnss.sats"]) == {6, 7, 8, 9}
    assert plan(sample={"n": 20, "seed": 2, **rules}, fault="gyro.x:bias={size}deg/s@13").runs[0].factors["wind.n"] != drawn["wind.n"][0]
    assert abs(np.corrcoef(drawn["wind.n"], drawn["gate.gnss"])[0, 1]) < 0.2


def test_a_sample_with_seeds_flies_each_draw_with_each() -> None:
    p = plan(sample={"n": 3, "wind.n": {"uniform": [0.0, 8.0]}}, seeds=2)
    assert [r.factors["seed"] for r in p.runs] == [1, 2] * 3


def test_an_id_is_of_what_the_run_is_and_not_of_its_campaign() -> None:
    one = plan(grid={"wind.n": [0.0, 4.0]}, seeds=2)
    other = parse_plan({"scenario": {**SHORT, "wind": {"n": 4.0}}, "seeds": [2], "name": "other"})
    assert other.runs[0].id == one.runs[3].id
    for keys in ({"settle": 6.0}, {"set": {"gate.gnss": 4.0}}, {"estimators": ["ahrs"]}, {"seeds": [5]}, {"fault": "gnss:dropout@13-15"}):
        assert not {r.id for r in plan(**{"seeds": [2], **keys}).runs} & {other.runs[0].id, one.runs[2].id, one.runs[3].id}, keys


def test_what_is_in_a_vehicle_file_counts_and_not_where_it_lies(tmp_path: Path) -> None:
    text = resources.files("haltere.flight").joinpath("vehicles", "hummingbird.toml").read_text(encoding="utf-8")
    ids = []
    for k, change in enumerate(("", "", "\n# heavier\n")):
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / "mine.toml").write_text(text + change, encoding="utf-8")
        ids.append(parse_plan({"scenario": {**SHORT, "vehicle": "mine.toml"}}, folder=folder).runs[0].id)
    assert ids[0] == ids[1] != ids[2]


WRONG = [
    ({"girds": {}}, "grid"),
    ({"grid": {"wind.m": [1]}}, "wind.n"),
    ({"grid": {"gate.gns": [1]}}, "gate.gnss"),
    ({"grid": {"wind.n": 3}}, "a list of values"),
    ({"grid": {"wind.n": []}}, "a list of values"),
    ({"grid": {"seed": [1]}}, "seeds"),
    ({"grid": {"mission": ["hoover"]}}, "hover"),
    ({"grid": {"vehicle": ["hummingbrid"]}}, "hummingbird"),
    ({"grid": {"sensors.imu.preset": ["icm42689"]}}, "icm42688"),
    ({"grid": {"fault": ["gyro.x:bais=1deg/s@3"]}}, "bias"),
    ({"grid": {"fault": ["gyro.x:bias={size}deg/s@3"]}}, "fault.size"),
    ({"grid": {"gate.gnss": [-1.0]}}, "gate.gnss"),
    ({"grid": {"wind.n": [1]}, "case": [{"wind.n": 2}]}, "once"),
    ({"estimators": ["navigatr"]}, "navigator"),
    ({"estimators": []}, "estimators"),
    ({"preset": "as-printed"}, "preset"),
    ({"set": {"gate.gnss": "wide"}}, "number"),
    ({"seeds": 0}, "seeds"),
    ({"seeds": "9-2"}, "range"),
    ({"seeds": [1, 1]}, "different"),
    ({"sample": {"wind.n": {"uniform": [0, 1]}}}, "n"),
    ({"sample": {"n": 3, "wind.n": {"uniform": [1, 0]}}}, "low"),
    ({"sample": {"n": 3, "wind.n": [1, 2]}}, "uniform"),
    ({"sample": {"n": 3, "wind.n": {"unifrm": [0, 1]}}}, "wind.n"),
    ({"settling": {"tilt": 1.0}}, "tilt_deg"),
    ({"settle": -1.0}, "settle"),
    ({"scenario": "hoverr"}, "hover"),
    ({"scenario": {"durations": 3.0}}, "duration"),
    ({"scenario": {"seed": 3}}, "seeds"),
    ({"require": [{"metric": "tilt_deg.rsm", "limit": 1.0}]}, "tilt_deg.rms"),
    ({"require": [{"metric": "tilt_deg.rms"}]}, "limit"),
    ({"require": [{"metric": "tilt_deg.rms", "limit": 1.0, "statistic": "p105"}]}, "statistic"),
    ({"require": [{"metric": "tilt_deg.rms", "limit": 1.0, "statistic": "band"}]}, "nees"),
    ({"require": [{"metric": "tilt_deg.rms", "limit": 1.0, "where": {"wind.n": 1}}]}, "factor"),
    ({"require": [{"metric": "tilt_deg.rms", "limt": 1.0}]}, "limit"),
    ({"require": [{"metric": "detection_rate", "least": 0.9, "statistic": "mean"}]}, "statistic"),
    ({"require": [{"metric": "tilt_deg.rms", "limit": 1.0, "confident": True}]}, "detection_rate"),
]


@pytest.mark.parametrize(("keys", "hint"), WRONG)
def test_what_is_wrong_is_said_before_anything_runs(keys: dict[str, Any], hint: str) -> None:
    with pytest.raises(UsageError) as caught:
        plan(**keys)
    assert hint in str(caught.value)


def test_a_file_that_is_none_and_text_that_is_no_toml(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        load_plan(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("grid = [", encoding="utf-8")
    with pytest.raises(HaltereError):
        load_plan(tmp_path / "bad.toml")


# --- runs ----------------------------------------------------------------------------------------------------------------


def test_the_tables_have_every_factor_and_what_is_there_to_be_measured(made: Results) -> None:
    runs, faults = made.runs, made.faults
    assert len(runs) == len(made.plan.runs) == 24
    assert runs["run"].to_list() == list(range(24))
    assert set(runs["status"]) == {"done"}
    assert set(runs["against"]) == {"truth"}
    ours, theirs = runs.filter(pl.col("estimator") == "navigator"), runs.filter(pl.col("estimator") == "ahrs")
    for column in (
        "tilt_deg.rms",
        "heading_deg.max",
        "vel.rms",
        "pos_d.rms",
        "gyro_bias.rms",
        "accel_bias.rms",
        "nees.velocity",
        "nis.gnss",
    ):
        assert np.isfinite(ours[column].to_numpy()).all(), column
    assert theirs["vel.rms"].null_count() == len(theirs), "ahrs estimates none"
    assert len(faults) == 16
    assert set(faults["word"]) == {"gyro.x:bias=2deg/s@13", "gyro.x:bias=5deg/s@13"}
    assert set(faults["fault.size"]) == {2.0, 5.0}
    assert faults["size"].to_list() == pytest.approx([math.radians(s) for s in faults["fault.size"]])
    assert set(runs["faults"]) == {0.0, 1.0}
    assert made.summary["done"] == 24
    assert made.summary["same"] == 8
    assert made.verdicts[0].runs == 4


def test_a_row_is_what_a_run_by_itself_gives(made: Results) -> None:
    from haltere import drive
    from haltere.metrics.errors import error_series

    run = made.plan.runs[0]
    assert run.scenario is not None
    flight = simulate(run.scenario)
    solution = drive.run(flight, "navigator")
    t, e = error_series(solution, flight["truth"])["tilt"]
    late = t >= solution.t[0] + 5.0
    row = made.runs.row(0, named=True)
    assert row["tilt_deg.rms"] == pytest.approx(math.degrees(math.sqrt(float(np.mean(e[late] ** 2)))), rel=1e-12)
    assert row["nis.gnss"] == pytest.approx(solution.summary["nis"]["gnss"]["mean"], rel=1e-12)
    v = np.column_stack([error_series(solution, flight["truth"])[f"vel_{a}"][1] for a in "ned"])[late]
    assert row["vel.max"] == pytest.approx(float(np.linalg.norm(v, axis=1).max()), rel=1e-12)


def test_a_failing_run_is_a_row_with_its_reason(tmp_path: Path) -> None:
    p = plan(case=[{}, {"wind.n": 80.0}, {"fault": "gnss:dropout@500-600"}])
    results = campaign(p, tmp_path / "out", workers=1)
    assert results.runs["status"].to_list() == ["done", "failed", "failed"]
    assert "lost" in results.runs["error"][1]
    assert "samples of gnss in its time" in results.runs["error"][2]
    assert (results.summary["done"], results.summary["failed"]) == (1, 2)
    assert len(results.summary["failures"]) == 2
    text = page_of(results)
    assert "samples of gnss in its time" in text
    again = campaign(p, tmp_path / "out", workers=1)
    assert again.summary["timings"]["made"] == 0, "a failure that says why is a result"


def test_an_error_of_ours_is_a_row_too_and_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from haltere.evaluate import campaign_run

    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("by nothing")

    p = plan(seeds=1)
    monkeypatch.setattr(campaign_run, "row_of", broken)
    results = campaign(p, tmp_path, workers=1)
    assert results.runs["status"].to_list() == ["crashed"]
    assert results.runs["error"][0].startswith("ZeroDivisionError: by nothing (test_campaign.py:")
    monkeypatch.undo()
    results = campaign(p, tmp_path, workers=1)
    assert results.runs["status"].to_list() == ["done"]
    assert len(results.runs) == 1


def test_logs_with_faults_and_a_log_that_is_none(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    for seed in (1, 2):
        write_folder(simulate(parse_scenario({**SHORT, "seed": seed})), logs / f"flight{seed}")
    (logs / "notes.txt").write_text("not a log", encoding="utf-8")
    p = parse_plan({"logs": "logs", "grid": {"fault": ["", "magnetometer:dropout@13-15"]}, "set": {"gate.gnss": 4.0}}, folder=tmp_path)
    assert len(p.runs) == 6
    results = campaign(p, tmp_path / "out", workers=1)
    status = dict(zip(zip(results.runs["log"], results.runs["fault"], strict=True), results.runs["status"], strict=True))
    assert status["notes.txt", ""] == "failed"
    assert status["flight1", "magnetometer:dropout@13-15"] == "done"
    assert results.faults["log"].to_list() == ["flight1", "flight2"]
    assert results.faults["word"].unique().to_list() == ["magnetometer:dropout@13-15"]
    with pytest.raises(UsageError, match="logs"):
        parse_plan({"logs": "logs", "grid": {"wind.n": [1]}}, folder=tmp_path)
    with pytest.raises(UsageError, match="simulated"):
        parse_plan({"logs": "logs", "fault": "rotor.1:thrust=0.8@13"}, folder=tmp_path)
    with pytest.raises(HaltereError):
        parse_plan({"logs": "nowhere"}, folder=tmp_path)


def test_memory_does_not_grow_with_the_number_of_runs() -> None:
    import tracemalloc

    p = plan(seeds=40)
    task = Task(p.runs, p.settle, p.hold, p.bounds, code())
    work(replace(task, runs=p.runs[:4]))
    tracemalloc.start()
    try:
        held = []
        for k in range(4, 40, 12):
            results = work(replace(task, runs=p.runs[k : k + 12]))
            assert {r.status for r in results} == {"done"}
            del results
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    flight = sum(c.nbytes for s in simulate(parse_scenario(SHORT)).streams.values() for c in s.columns.values())
    assert held[-1] - held[0] < 0.2 * flight, "24 more runs leave less behind than a fifth of one flight"


# --- workers, interruptions, other processes -----------------------------------------------------------------------------

#: The command line, writing a part after each task.
DRIVER = """
import sys
import haltere.evaluate.campaign as room
room.EVERY, room.CHUNK = 0.0, 2
from haltere.cli import main
if __name__ == "__main__":
    main()
"""


def started(folder: Path, *words: object) -> subprocess.Popen[str]:
    script = folder / "driver.py"
    script.write_text(DRIVER, encoding="utf-8")
    return subprocess.Popen(
        [sys.executable, str(script), *map(str, words)], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def until(done: Any, seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def children(pid: int) -> list[int]:
    """Processes whose parent is this one."""
    out = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                command = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if int(fields[1]) == pid and b"spawn_main" in command:
                out.append(int(entry.name))
    return out


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def parts(out: Path) -> int:
    return len(list((out / "parts").glob("part-*.parquet")))


def test_two_workers_give_the_tables_of_one(made: Results, tmp_path: Path) -> None:
    process = started(tmp_path, "campaign", written(tmp_path), "--workers", 2, "--out", "out", "--json")
    text, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    equal(made.folder, tmp_path / "out")
    assert json.loads(text)["timings"]["workers"] == 2


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks at processes through /proc")
def test_a_campaign_that_was_killed_goes_on_where_it_was(made: Results, tmp_path: Path) -> None:
    words = ("campaign", written(tmp_path), "--workers", 2, "--out", "out", "--json")
    first = started(tmp_path, *words)
    until(lambda: parts(tmp_path / "out") >= 2 or first.poll() is not None)
    workers = children(first.pid)
    first.kill()
    first.communicate()
    assert not (tmp_path / "out" / "summary.json").exists()
    before = sum(len(pl.read_parquet(p)) for p in (tmp_path / "out" / "parts").glob("*.parquet"))
    assert 0 < before < 24
    assert workers
    until(lambda: not any(alive(w) for w in workers), 30.0)
    second = started(tmp_path, *words)
    text, errors = second.communicate(timeout=600)
    assert second.returncode == 0, errors
    timings = json.loads(text)["timings"]
    assert (timings["resumed"], timings["made"]) == (before, 24 - before)
    equal(made.folder, tmp_path / "out")


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks at processes through /proc")
def test_a_worker_that_is_killed_loses_nothing(made: Results, tmp_path: Path) -> None:
    process = started(tmp_path, "campaign", written(tmp_path), "--workers", 2, "--out", "out")
    until(lambda: parts(tmp_path / "out") >= 1 or process.poll() is not None)
    os.kill(children(process.pid)[0], signal.SIGKILL)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    equal(made.folder, tmp_path / "out")


class Poison:
    """Ends the process that unpacks it."""

    def __reduce__(self) -> tuple[Any, tuple[int]]:
        return os._exit, (3,)


def test_a_run_that_kills_its_worker_is_a_row_and_the_others_are_made() -> None:
    p = plan(seeds=4)
    poisoned = replace(p.runs[2], keys={"gate.gnss": Poison()})
    runs = (p.runs[0], p.runs[1], poisoned, p.runs[3])
    tasks = [Task(runs[k : k + 2], p.settle, p.hold, p.bounds, code()) for k in (0, 2)]
    results = {r.id: r for found in processes(tasks, 2, ["navigator"]) for r in found}
    assert {r.id for r in p.runs} == set(results)
    assert [results[r.id].status for r in p.runs] == ["done", "done", "crashed", "done"]
    assert "died" in results[poisoned.id].error


def test_two_campaigns_do_not_write_to_one_folder(tmp_path: Path) -> None:
    with Store(tmp_path).held(), pytest.raises(HaltereError, match="another campaign"):
        campaign(plan(), tmp_path, workers=1)


def test_results_of_other_sources_do_not_count_and_more_seeds_make_only_the_missing_runs(tmp_path: Path) -> None:
    results = campaign(plan(seeds=2), tmp_path, workers=1)
    store = Store(tmp_path)
    stale = [Result(r.id, "done", "", {"tilt_deg.rms": 99.0}, code="others") for r in results.plan.runs]
    store.write(stale)
    again = campaign(plan(seeds=3), tmp_path, workers=1)
    assert (again.summary["timings"]["resumed"], again.summary["timings"]["made"]) == (2, 1)
    assert again.runs["tilt_deg.rms"].max() < 90.0
    assert any("other sources" in n for n in again.summary["notes"])
    (tmp_path / "parts" / "part-000001.parquet").write_bytes(b"broken")
    last = campaign(plan(seeds=3), tmp_path, workers=1)
    assert len(last.runs) == 3
    assert any("part-000001.parquet cannot be read" in n for n in last.summary["notes"])
    assert last.runs.equals(again.runs)


def test_an_interrupt_keeps_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(p: room.Progress) -> None:
        if p.done == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(room, "CHUNK", 1)
    with pytest.raises(KeyboardInterrupt):
        campaign(plan(seeds=4), tmp_path, workers=1, progress=interrupted)
    assert campaign(plan(seeds=4), tmp_path, workers=1).summary["timings"]["resumed"] == 2


# --- Dask ----------------------------------------------------------------------------------------------------------------

CLUSTER = """
import json, sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1") as cluster:
        print(json.dumps([cluster.scheduler_address, [w.pid for w in cluster.workers.values()]]), flush=True)
        sys.stdin.read()
"""


@pytest.fixture
def cluster(tmp_path: Path) -> Any:
    """Address of a Dask scheduler in a process of its own with two worker processes, and theirs."""
    pytest.importorskip("distributed")
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER, encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=tmp_path
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, "no cluster"
    yield json.loads(line)
    try:
        process.communicate("", timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()


def test_a_dask_cluster_whose_worker_is_killed_gives_the_same_tables(made: Results, cluster: Any, tmp_path: Path) -> None:
    address, workers = cluster
    process = started(tmp_path, "campaign", written(tmp_path), "--scheduler", address, "--out", "out", "--json")
    until(lambda: parts(tmp_path / "out") >= 1 or process.poll() is not None)
    assert parts(tmp_path / "out") < 12, "killed in mid-run"
    os.kill(workers[0], signal.SIGKILL)
    text, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    equal(made.folder, tmp_path / "out")
    assert json.loads(text)["timings"]["scheduler"] == address


def test_no_scheduler_and_no_dask_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(HaltereError, match=r'pip install "haltere\[dask\]"'):
        campaign(plan(), tmp_path / "a", scheduler="tcp://127.0.0.1:9")
    monkeypatch.undo()
    pytest.importorskip("distributed")
    for address in ("nonsense://", "tcp://127.0.0.1:9"):  # no protocol, and a port where nobody listens
        process = started(tmp_path, "campaign", written(tmp_path), "--scheduler", address, "--out", "b")
        _, errors = process.communicate(timeout=120)
        assert process.returncode == 1
        assert errors.count("\n") == 1, errors
        assert "a Dask scheduler" in errors


def test_workers_and_a_scheduler_are_not_both(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        campaign(plan(), tmp_path, workers=2, scheduler="tcp://127.0.0.1:9")
    with pytest.raises(UsageError):
        campaign(plan(), tmp_path, workers=0)


# --- verdicts ------------------------------------------------------------------------------------------------------------


def table(values: list[float | None], **columns: list[Any]) -> pl.DataFrame:
    n = len(values)
    status = ["done"] * n
    return pl.DataFrame({"run": range(n), "estimator": ["navigator"] * n, "status": status, "x.rms": values, **columns}, strict=False)


NO_FAULTS = pl.DataFrame(
    {"estimator": [], "detected": [], "isolation": []}, {"estimator": pl.String, "detected": pl.Float64, "isolation": pl.String}
)
HUNDRED = [float(k) for k in range(1, 101)]


@pytest.mark.parametrize(
    ("keys", "value", "met"),
    [
        ({"statistic": "mean", "limit": 50.5}, 50.5, True),
        ({"statistic": "mean", "limit": 50.4}, 50.5, False),
        ({"statistic": "median", "limit": 51.0}, 50.5, True),
        ({"statistic": "p95", "limit": 95.05}, 95.05, True),
        ({"statistic": "p95", "limit": 95.0}, 95.05, False),
        ({"statistic": "max", "limit": 100.0}, 100.0, True),
        ({"statistic": "min", "least": 1.0}, 1.0, True),
        ({"statistic": "min", "least": 1.1}, 1.0, False),
        ({"statistic": "max", "limit": 200.0, "least": 150.0}, 100.0, False),
        ({"statistic": "fraction", "limit": 90.0, "share": 0.9}, 0.9, True),
        ({"statistic": "fraction", "limit": 89.5, "share": 0.9}, 0.89, False),
    ],
)
def test_verdicts_of_known_numbers(keys: dict[str, Any], value: float, met: bool) -> None:
    v = judge(Requirement("x.rms", **keys), table(HUNDRED), NO_FAULTS)
    assert v.value == pytest.approx(value)
    assert v.met is met
    assert v.sentence.startswith("met: " if met else "not met: ")


def test_a_failed_run_counts_as_the_worst_there_is_unless_it_is_to_be_ignored() -> None:
    runs = table([1.0] * 19 + [None]).with_columns(pl.Series("status", ["done"] * 19 + ["failed"]))
    assert not judge(Requirement("x.rms", "max", 2.0), runs, NO_FAULTS).met
    assert not judge(Requirement("x.rms", "mean", 2.0), runs, NO_FAULTS).met
    assert not judge(Requirement("x.rms", "fraction", 2.0), runs, NO_FAULTS).met
    assert judge(Requirement("x.rms", "p90", 2.0), runs, NO_FAULTS).met, "one of twenty is beyond 90 %"
    assert judge(Requirement("x.rms", "fraction", 2.0, share=0.95), runs, NO_FAULTS).met
    v = judge(Requirement("x.rms", "max", 2.0, ignore_failed=True), runs, NO_FAULTS)
    assert v.met
    assert v.failed == 1
    assert "1 failed" in v.sentence
    low = judge(Requirement("x.rms", "min", least=0.5), runs, NO_FAULTS)
    assert (low.met, low.value) == (False, -math.inf)


def test_no_run_and_no_such_figure_are_not_met() -> None:
    runs = table([1.0, 2.0], **{"wind.n": [0.0, 4.0]})
    assert judge(Requirement("x.rms", "max", 9.0, where={"wind.n": 4}), runs, NO_FAULTS).value == 2.0
    assert judge(Requirement("x.rms", "max", 9.0, where={"wind.n": [0, 4]}), runs, NO_FAULTS).runs == 2
    none = judge(Requirement("x.rms", "max", 9.0, where={"wind.n": 5.0}), runs, NO_FAULTS)
    assert not none.met
    assert "no run is like that" in none.sentence
    absent = judge(Requirement("vel.rms", "max", 9.0), runs, NO_FAULTS)
    assert not absent.met
    assert "no run has this metric" in absent.sentence


def test_the_band_is_chi_square_of_that_many_runs() -> None:
    n = 50
    low, high = (float(stats.chi2.ppf(q, 3 * n)) / (3 * n) for q in (0.0005, 0.9995))
    for mean, met in ((low - 1e-3, False), (low + 1e-3, True), (high - 1e-3, True), (high + 1e-3, False)):
        runs = table([1.0] * n).with_columns(pl.lit(mean).alias("nees.velocity"))
        v = judge(Requirement("nees.velocity", "band", probability=0.999), runs, NO_FAULTS)
        assert v.met is met
        assert v.interval == pytest.approx((low, high))


def outcomes(rows: list[tuple[str, str, str, float]]) -> pl.DataFrame:
    """Faults of (sensor.axis, isolation, named, ratio)."""
    return pl.DataFrame(
        {
            "run": range(len(rows)), "estimator": ["navigator"] * len(rows), "sensor": [r[0].partition(".")[0] for r in rows],
            "axis": [r[0].partition(".")[2] for r in rows], "kind": ["bias"] * len(rows), "isolation": [r[1] for r in rows],
            "named": [r[2] for r in rows], "detected": [float(r[1] != "missed") for r in rows], "ratio": [r[3] for r in rows],
        }
    )  # fmt: skip


OUTCOMES = outcomes(
    [
        ("gyro.x", "right", "gyro.x", 8.0), ("gyro.x", "right", "gyro.x", 4.0), ("gyro.x", "wrong", "gyro.y", 2.0),
        ("gyro.y", "containing", "gyro.y model.p", 3.0), ("gyro.y", "none", "", math.nan), ("accel.z", "missed", "", math.nan),
    ]
)  # fmt: skip


def test_rates_of_all_runs_together() -> None:
    runs = table([1.0] * 4, false_alarms=[0.0, 2.0, 1.0, 0.0], quiet=[1800.0] * 4)
    v = judge(Requirement("detection_rate", "", least=0.8), runs, OUTCOMES)
    assert v.value == pytest.approx(5 / 6)
    assert v.met
    assert not judge(Requirement("detection_rate", "", least=0.8, confident=True), runs, OUTCOMES).met
    assert judge(Requirement("isolation_rate", "", least=0.3), runs, OUTCOMES).value == pytest.approx(2 / 6)
    assert judge(Requirement("containing_rate", "", least=0.3), runs, OUTCOMES).value == pytest.approx(3 / 6)
    false = judge(Requirement("false_alarms_per_hour", "", 2.0), runs, OUTCOMES)
    assert false.value == pytest.approx(3 / 2.0)
    assert false.interval == pytest.approx((float(stats.chi2.ppf(0.025, 6)) / 4.0, float(stats.chi2.ppf(0.975, 8)) / 4.0))
    assert false.met
    assert not judge(Requirement("false_alarms_per_hour", "", 2.0, confident=True), runs, OUTCOMES).met
    assert judge(Requirement("failure_rate", "", 0.0), runs, OUTCOMES).met


# --- tables --------------------------------------------------------------------------------------------------------------


def test_confusion_by_hand() -> None:
    (c,) = confusion(OUTCOMES)
    assert c.rows == ["accel.z", "gyro.x", "gyro.y"]
    assert c.columns == ["gyro.x", "gyro.y", SEVERAL, NOBODY, MISSED]
    assert c.counts.tolist() == [[0, 0, 0, 0, 1], [2, 1, 0, 0, 0], [0, 0, 1, 1, 0]]


def test_an_operating_curve_by_hand() -> None:
    runs = table(
        [1.0] * 5,
        faults=[0.0, 0.0, 0.0, 0.0, 1.0],
        false_alarms=[0.0, 1.0, 2.0, 0.0, 9.0],
        false_ratio=[math.nan, 2.5, math.nan, math.nan, 9.0],
    )
    (c,) = roc(runs, OUTCOMES)
    assert (c.faults, c.quiet_runs) == (6, 4)
    assert c.factor.tolist() == [1.0, 2.0, 2.5, 3.0, 4.0, 8.0, math.inf]
    # two of four quiet runs have an alarm, one of which does not tell its statistic; of six faults five are found, one without
    assert c.false.tolist() == [0.5, 0.25, 0.25, 0.0, 0.0, 0.0, 0.0]
    assert c.detected == pytest.approx(np.array([5, 4, 3, 3, 2, 1, 0]) / 6)
    assert roc(runs.filter(pl.col("faults") > 0.0), OUTCOMES) == []
    assert roc(runs, OUTCOMES.clear()) == []


def test_consistency_over_runs() -> None:
    rng = np.random.default_rng(3)
    good = rng.chisquare(3, 400) / 3
    runs = table([1.0] * 400).with_columns(
        pl.Series("nees.velocity", good), pl.Series("nees.attitude", 1.5 * good), pl.Series("nis.gnss", [0.98] * 400),
        pl.Series("tested.gnss", [500.0] * 400),
    )  # fmt: skip
    runs = runs.with_columns(pl.Series("nis.zero_rate", [0.1] * 400), pl.Series("tested.zero_rate", [9.0] * 400))
    by = {c.metric: c for c in consistency(runs)}
    assert "nis.zero_rate" not in by, "an assumption is not tested"
    assert by["nees.velocity"].verdict == "inside"
    assert by["nees.attitude"].verdict == "above"
    assert by["nis.gnss"].verdict == "below"
    v = by["nees.velocity"]
    assert (v.low, v.high) == pytest.approx(stats.t.interval(0.95, 399, good.mean(), good.std(ddof=1) / 20.0))
    assert by["nis.gnss"].bands[0] == pytest.approx([float(stats.chi2.ppf(q, 200_000)) / 200_000 for q in (0.025, 0.975)])


def test_consistency_is_that_of_runs_without_a_fault_where_there_are_such() -> None:
    runs = table([1.0] * 4, faults=[0.0, 0.0, 1.0, None], **{"nees.velocity": [1.0, 1.2, 90.0, None]})
    (c,) = consistency(runs)
    assert c.values.tolist() == [1.0, 1.2]
    (c,) = consistency(runs.filter(pl.col("faults") > 0.0))
    assert c.values.tolist() == [90.0]


def test_detection_over_the_size_by_hand() -> None:
    n = 40
    size = np.repeat([0.1, 0.2], n // 2)
    delay = np.where(np.arange(n) < 10, math.nan, np.where(size > 0.15, 1.0, 3.0))
    faults = pl.DataFrame({"estimator": ["navigator"] * n, "sensor": ["gyro"] * n, "kind": ["bias"] * n, "size": -size, "delay": delay,
                           "detected": np.isfinite(delay).astype(float)})  # fmt: skip
    (b,) = by_size(faults)
    assert b.size.tolist() == [0.1, 0.2]
    assert (b.faults.tolist(), b.detected.tolist()) == ([20, 20], [10, 20])
    assert b.share[0] == pytest.approx([0.5, *stats.binomtest(10, 20).proportion_ci(0.95, method="exact")])
    assert b.delay[:, 2].tolist() == [3.0, 1.0]
    (many,) = by_size(faults.with_columns(pl.Series("size", np.arange(1.0, n + 1.0))))
    assert many.faults.tolist() == [5] * 8
    assert many.size[0] == 3.0


def test_a_distribution_counts_the_runs_that_have_no_value() -> None:
    x, share = distribution(np.array([3.0, 1.0, math.nan, 2.0]), 5)
    assert x.tolist() == [1.0, 2.0, 3.0]
    assert share.tolist() == [0.2, 0.4, 0.6]
    x, share = distribution(np.arange(10_000.0), 10_000)
    assert len(x) <= 400
    assert (x[0], x[-1], share[-1]) == (0.0, 9999.0, 1.0)


# --- command line and page -----------------------------------------------------------------------------------------------


def called(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["haltere", *map(str, words)])
    try:
        cli.main()
    except SystemExit as left:
        return left.code if isinstance(left.code, int) else 1
    return 0


def test_the_command_line(made: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "strict.toml"
    path.write_text(
        "seeds = 2\n[scenario]\nbase = 'hover'\nduration = 16.0\nsensors.imu.rate = 100.0\n"
        "[[require]]\nmetric = 'tilt_deg.rms'\nlimit = 1e-6\n", encoding="utf-8",
    )  # fmt: skip
    assert called(monkeypatch, "campaign", path, "--workers", 1) == 0
    shown = capsys.readouterr()
    assert "not met: max of tilt_deg.rms at most 1e-06" in shown.out
    assert "2 runs, 2 done" in shown.out
    folder = tmp_path / "strict.campaign"
    names = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
    assert names == {"results.parquet", "faults.parquet", "timings.parquet", "summary.json", "campaign.html", "campaign.toml", "parts"}
    assert (folder / "campaign.toml").read_text(encoding="utf-8") == path.read_text(encoding="utf-8")
    assert called(monkeypatch, "campaign", path, "--workers", 1, "--strict", "--json") == 1
    summary_ = json.loads(capsys.readouterr().out)
    assert summary_["verdict"] == "failed"
    assert summary_["timings"]["resumed"] == 2
    assert summary_ == json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    path.write_text("[grid]\n'wind.m' = [1]\n", encoding="utf-8")
    assert called(monkeypatch, "campaign", path, "--out", "none") == 2
    assert "did you mean 'wind.n'?" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def invented(folder: Path) -> Results:
    """A campaign with alarms, misses and failures, out of random numbers, through the store."""
    ours = {"estimator": "navigator"}
    p = parse_plan(
        {
            "name": "invented", "scenario": SHORT, "estimators": ["navigator", "ahrs"], "seeds": 10,
            "grid": {
                "wind.n": [0, 4, 8], "fault.size": [1, 3],
                "fault": ["", "gyro.x:bias={size}deg/s@13", "magnetometer:disturb={size}@13-15"],
            },
            "require": [
                {"metric": "tilt_deg.rms", "statistic": "p95", "limit": 9.0, "where": ours, "ignore_failed": True},
                {"metric": "detection_rate", "least": 0.99, "confident": True},
                {"metric": "nees.attitude", "statistic": "band", "probability": 0.999, "where": ours, "ignore_failed": True},
            ],
        }
    )  # fmt: skip
    rng = np.random.default_rng(1)
    results = []
    for run in p.runs:
        assert run.scenario is not None
        if rng.random() < 0.03:
            results.append(
                Result(run.id, "failed", "scenario hover: expected a flight to the end, found the vehicle was lost", code=code())
            )
            continue
        scale = 1.0 if run.estimator == "navigator" else 2.0
        row: dict[str, Any] = {
            "against": "truth", "tilt_deg.rms": scale * rng.gamma(3.0, 0.4), "heading_deg.rms": scale * rng.gamma(3.0, 0.8),
            "tilt_deg.settling": rng.exponential(2.0), "nees.attitude": rng.chisquare(3) / 3, "nis.magnetometer": 1.0 + 0.02 * rng.normal(),
            "tested.magnetometer": 500.0, "faults": float(bool(run.scenario.fault)), "quiet": 120.0,
        }  # fmt: skip
        if run.estimator == "navigator":
            row |= {"vel.rms": rng.gamma(3.0, 0.1), "pos.rms": rng.gamma(4.0, 0.3), "nees.velocity": rng.chisquare(3) / 3, "nis.gnss": 1.0}
            row["tested.gnss"] = 900.0
        row["false_alarms"] = float(rng.poisson(0.1))
        row["false_ratio"] = 1.0 + rng.exponential(0.5) if row["false_alarms"] else math.nan
        faults = []
        if run.scenario.fault:
            size = float(run.factors["fault.size"])
            hit = rng.random() < 0.5 + 0.15 * size
            sensor, axis = ("gyro", "x") if "gyro" in run.scenario.fault[0] else ("magnetometer", "")
            named = str(rng.choice(["gyro.x", "gyro.x", "gyro.y", "gyro.x model.p", "magnetometer", ""])) if hit else ""
            right = named == (f"{sensor}.{axis}" if axis else sensor)
            isolation = "missed" if not hit else "right" if right else "none" if not named else "containing" if sensor in named else "wrong"
            faults.append({
                "word": run.scenario.fault[0], "sensor": sensor, "axis": axis, "kind": "bias" if axis else "disturb", "size": size,
                "start": 13.0, "end": math.inf, "detected": float(hit), "delay": rng.exponential(2.0 / size) if hit else math.nan,
                "isolation": isolation, "named": named, "isolation_delay": math.nan,
                "ratio": 1.0 + rng.exponential(size) if hit else math.nan, "recovery": math.nan,
            })  # fmt: skip
            row["detected"], row["missed"] = float(hit), float(not hit)
        results.append(Result(run.id, "done", "", row, faults, {"flight_s": 0.04, "run_s": 0.1, "score_s": 0.01}, code()))
    store = Store(folder)
    with store.held():
        store.write(results)
        runs, faults_, timings = store.tables(p)
    verdicts = tuple(judge(r, runs, faults_) for r in p.require)
    took = {
        "wall_s": 60.0,
        "made": len(results),
        "resumed": 0,
        "workers": 2,
        "scheduler": None,
        "flight_s": 14.0,
        "run_s": 36.0,
        "score_s": 3.0,
    }
    return Results(p, runs, faults_, timings, verdicts, summary(p, runs, faults_, verdicts, [], took), folder)


@pytest.fixture(scope="session")
def page_of_all(tmp_path_factory: pytest.TempPathFactory) -> str:
    return page_of(invented(tmp_path_factory.mktemp("invented")))


DRAWN = """
  out.names = H.divs.map((d) => d.id);
  out.drawn = H.divs.map((d) => d.querySelectorAll("path.js-line, path.point, path.box").length);
  out.wide = document.documentElement.scrollWidth - innerWidth;
"""


def test_the_page_draws_everything_without_script_errors(page_of_all: str) -> None:
    data, found = browse(page_of_all, DRAWN)
    assert data["errors"] == "[]"
    assert len(found["names"]) == len(numbers(page_of_all)) == int(data["drawn"])
    assert {
        "figure-roc",
        "figure-delay_gyro_bias",
        "figure-delay_magnetometer_disturb",
        "figure-nees",
        "figure-nis",
        "figure-by_wind_n",
        "figure-distribution_tilt_deg_rms",
    } <= set(found["names"])
    assert min(found["drawn"]) >= 1, dict(zip(found["names"], found["drawn"], strict=True))
    assert found["wide"] <= 0
    assert sections(page_of_all) == ["verdict", "requirements", "errors", "factors", "detection", "consistency", "failures", "done"]


def test_the_page_says_what_the_tables_say(page_of_all: str, tmp_path: Path) -> None:
    results = invented(tmp_path)
    for v in results.verdicts:
        assert v.sentence[1:].replace("<", "&lt;") in page_of_all
    figures = numbers(page_of_all)
    line = next(t for t in figures["distribution_tilt_deg_rms"]["traces"] if t["name"] == "navigator")
    mine = results.runs.filter(pl.col("estimator") == "navigator")
    assert line["x"][-1] == pytest.approx(mine["tilt_deg.rms"].max(), rel=1e-4)
    assert line["y"][-1] == pytest.approx(mine["tilt_deg.rms"].count() / len(mine), rel=1e-3), "failed runs never arrive"
    box = next(t for t in figures["by_wind_n"]["traces"] if t["type"] == "box" and t["name"] == "navigator")
    calm = mine.filter(pl.col("wind.n") == 0.0)["tilt_deg.rms"].drop_nulls().to_numpy()
    assert box["median"][0] == pytest.approx(np.median(calm), rel=1e-3)
    assert box["q3"][0] == pytest.approx(np.quantile(calm, 0.75), rel=1e-3)


def test_the_page_of_estimators_that_detect_nothing_says_so_and_draws_nothing_empty(tmp_path: Path) -> None:
    text = page_of(campaign(plan(seeds=2, grid={"fault": ["", "barometer:bias=0.3m@13"]}), tmp_path, workers=1))
    assert "No alarm was raised during any fault" in text
    assert not [name for name in numbers(text) if name.startswith(("roc", "delay"))]
    data, found = browse(text, DRAWN)
    assert data["errors"] == "[]"
    assert min(found["drawn"]) >= 1
