"""Writes that fail or are killed: nothing half is left under a final name, and what was there before stays or is known to be gone."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from haltere.errors import HaltereError
from haltere.flight import writing
from haltere.flight.config import resolve
from haltere.flight.folder import write_folder
from haltere.flight.log import FlightLog, FlightMeta
from haltere.flight.solution import Solution
from haltere.flight.writing import whole_files
from haltere.readers import read

ROWS = 4000
TABLES, RESULTS = ("solution.parquet", "aids.parquet"), ("events.json", "summary.json", "config.toml", "report.html")


def solution(k: int = 0) -> Solution:
    """A solution whose every file says that it is the k-th."""
    t = np.arange(ROWS) * 0.01
    table = {"t": t, "k": np.full(ROWS, float(k)), "noise": np.random.default_rng(k).normal(size=ROWS)}
    aids = {"t": t[:50], "sensor": np.array(["gnss"] * 50), "innovation": np.full(50, float(k))}
    return Solution(table, aids, [{"sensor": "gnss", "statistic": float(k)}], resolve(overrides={"noise.gyro": 1e-3 + k}), {"k": k})


def flight(k: int = 0) -> FlightLog:
    """A flight whose every part says that it is the k-th."""
    t = np.arange(ROWS) * 0.01
    noise = np.random.default_rng(k).normal(size=ROWS)
    streams = {name: {"t": t, "k": np.full(ROWS, float(k)), "x": noise} for name in ("imu", "gnss", "barometer")}
    return FlightLog(streams, FlightMeta(name=f"{k}"), ["a note"])


def save(k: int, folder: Path) -> None:
    solution(k).save(folder, extra={"report.html": f"<html>{k}{' ' * 20_000}</html>"})


def number_of(folder: Path) -> set[int]:
    """Every file of a result folder read whole: the numbers they say."""
    found: set[int] = set()
    for path in folder.iterdir():
        if path.name.startswith("."):
            continue
        if path.name == "solution.parquet":
            table = pl.read_parquet(path)
            assert len(table) == ROWS
            found |= {int(v) for v in table["k"].unique()}
        elif path.name == "aids.parquet":
            found |= {int(v) for v in pl.read_parquet(path)["innovation"].unique()}
        elif path.name == "events.json":
            found.add(int(json.loads(path.read_text())[0]["statistic"]))
        elif path.name == "summary.json":
            found.add(json.loads(path.read_text())["k"])
        elif path.name == "config.toml":
            found.add(round(tomllib.loads(path.read_text())["noise"]["gyro"] - 1e-3))
        else:
            text = path.read_text()
            assert text.startswith("<html>")
            assert text.endswith("</html>")
            found.add(int(text[6:].split()[0].split("<")[0]))
    return found


def flight_number(folder: Path) -> int | None:
    """The number of the flight in a folder, or None where it is refused because it is none."""
    try:
        got = read(folder)
    except HaltereError as error:
        assert "flight.toml" in str(error) or "nothing there" in str(error)
        return None
    k = int(got.meta.name)
    assert list(got) == ["imu", "gnss", "barometer"]
    for name in got:
        assert len(got[name]) == ROWS
        assert set(got[name]["k"]) == {float(k)}
    return k


def hidden(folder: Path) -> list[str]:
    return [p.name for p in folder.iterdir() if p.name.startswith(".")]


WRITERS: dict[str, Callable[[int, Path], object]] = {
    "solution": save,
    "parquet": lambda k, folder: write_folder(flight(k), folder),
    "csv": lambda k, folder: write_folder(flight(k), folder, csv=True),
}


@pytest.fixture(params=list(WRITERS))
def write(request: pytest.FixtureRequest) -> Callable[[int, Path], object]:
    return WRITERS[request.param]


def child(code: str, *args: object, **options: object) -> subprocess.Popen[str]:
    """A Python process that has this module."""
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\nfrom test_writes import *\n{code}"
    command = [sys.executable, "-c", code, *(str(a) for a in args)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)  # type: ignore[call-overload, no-any-return]


# What a writing leaves when all goes well


def test_a_run_replaces_the_files_of_the_run_before(tmp_path: Path) -> None:
    save(1, tmp_path / "out")
    (tmp_path / "out" / "smoothed.parquet").write_bytes(b"of the run before")
    (tmp_path / "out" / "mine.txt").write_text("mine")
    solution(2).save(tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted([*TABLES, *RESULTS[:3], "mine.txt"])
    (tmp_path / "out" / "mine.txt").unlink()
    assert number_of(tmp_path / "out") == {2}


def test_numbers_that_json_does_not_have_become_null(tmp_path: Path) -> None:
    s = solution()
    s.events = [{"statistic": float("nan"), "t": [1.0, float("inf")]}]
    s.summary = {"a": {"b": float("-inf")}, "c": 1}
    s.save(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "events.json").read_text()) == [{"statistic": None, "t": [1.0, None]}]
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == {"a": {"b": None}, "c": 1}


def test_new_files_have_the_rights_that_the_user_set(tmp_path: Path, write: Callable[[int, Path], object]) -> None:
    before = os.umask(0o027)
    try:
        write(1, tmp_path / "out")
    finally:
        os.umask(before)
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o750
    assert {p.stat().st_mode & 0o777 for p in (tmp_path / "out").iterdir()} == {0o640}


# Where it cannot be written


def test_a_file_in_the_way_is_told_and_kept(tmp_path: Path, write: Callable[[int, Path], object]) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(HaltereError, match="out: expected a folder to write to, found a file; name another folder"):
        write(1, tmp_path / "out")
    with pytest.raises(HaltereError, match="a folder that can be written"):
        write(1, tmp_path / "out" / "below")
    assert (tmp_path / "out").read_text() == "mine"
    assert not hidden(tmp_path)


@contextlib.contextmanager
def _nobody() -> Iterator[Path]:
    """A folder that others may read, as a user who is not allowed everything."""
    folder = Path(tempfile.mkdtemp(prefix="haltere-test-"))
    folder.chmod(0o755)
    root = os.geteuid() == 0
    try:
        (folder / "there").mkdir(mode=0o755)
        if root:
            os.seteuid(65534)
        else:
            (folder / "there").chmod(0o555)
            folder.chmod(0o555)
        yield folder
    finally:
        if root:
            os.seteuid(0)
        else:
            folder.chmod(0o755)
            (folder / "there").chmod(0o755)
        shutil.rmtree(folder)


@pytest.mark.parametrize("name", ["there", "new", "new/below"])
def test_a_folder_without_permission_is_told(name: str, write: Callable[[int, Path], object]) -> None:
    with _nobody() as folder:
        with pytest.raises(HaltereError, match="expected a folder that can be written, found Permission denied; check the path"):
            write(1, folder / name)
        assert [p.name for p in folder.rglob("*")] == ["there"]


FULL = """
import resource
for limit in (0, 1, 5000, 15_000, 30_000, 60_000, 120_000, 500_000):
    for old in (False, True):
        out = Path(sys.argv[2]) / f"{limit}{old}"
        if old:
            WRITERS[sys.argv[1]](1, out)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        try:
            WRITERS[sys.argv[1]](2, out)
            told = ""
        except HaltereError as error:
            told = str(error)
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        print(json.dumps([limit, old, told]), flush=True)
"""


@pytest.mark.parametrize("kind", list(WRITERS))
def test_files_that_may_not_grow(tmp_path: Path, kind: str) -> None:
    """The system refuses every file beyond a size, at one file or the next: what was there before is still there, whole."""
    out, err = child(FULL, kind, tmp_path).communicate(timeout=120)
    assert err == ""
    answers = [json.loads(line) for line in out.splitlines()]
    assert len(answers) == 16
    assert {bool(told) for *_, told in answers} == {True, False}  # limits on both sides of what is needed
    for limit, old, told in answers:
        folder = tmp_path / f"{limit}{old}"
        if told:
            assert "found File too large" in told
            assert "make room there" in told
        if told and not old:
            assert not folder.exists()
            continue
        assert (number_of(folder) if kind == "solution" else {flight_number(folder)}) == {1 if told else 2}
        assert not hidden(folder)
    assert not hidden(tmp_path)


DISK = """
out = Path(sys.argv[2])
for k in range(1, 60):
    try:
        WRITERS[sys.argv[1]](k, out)
    except HaltereError as error:
        print(json.dumps([k, str(error), sorted(p.name for p in out.iterdir())]))
        break
    (out / f"ballast{k}").write_bytes(bytes(30_000))
# what is left has to be told here: the file system is gone with this process
if sys.argv[1] == "solution":
    for name in out.glob("ballast*"):
        name.unlink()
    print(json.dumps(sorted(number_of(out))))
else:
    print(json.dumps([flight_number(out)]))
"""


@pytest.mark.parametrize("kind", list(WRITERS))
def test_a_disk_that_is_full(tmp_path: Path, kind: str) -> None:
    """A small file system, filled until a writing fails; the one before is still whole on it."""
    mount = 'mount -t tmpfs -o size=1500k none "$1" && shift && exec "$@"'
    disk = tmp_path / "disk"
    disk.mkdir()
    space = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", mount, "sh", str(disk)]
    if shutil.which("unshare") is None or subprocess.run([*space, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no file systems of one's own here (unshare --user --mount)")
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\nfrom test_writes import *\n{DISK}"
    done = subprocess.run([*space, sys.executable, "-c", code, kind, str(disk)], capture_output=True, text=True, timeout=120, check=False)
    assert done.stderr == ""
    failed, left = (json.loads(line) for line in done.stdout.splitlines())
    k, told, names = failed
    assert k > 2
    assert "No space left on device; make room there" in told
    assert not [name for name in names if name.startswith(".")]
    assert left == [k - 1]


# Interrupted


def _steps(monkeypatch: pytest.MonkeyPatch, stop_at: int) -> list[str]:
    """Count what a writing does under final names, and interrupt it before one of these steps."""
    done: list[str] = []
    replace, unlink, flush = os.replace, Path.unlink, writing._flush

    def step(name: str) -> None:
        if len(done) == stop_at:
            raise KeyboardInterrupt
        done.append(name)

    def counted_replace(a: Path, b: Path) -> None:
        step("replace")
        replace(a, b)

    def counted_unlink(self: Path, missing_ok: bool = False) -> None:
        step("unlink")
        unlink(self, missing_ok=missing_ok)

    def counted_flush(path: Path) -> None:
        step("flush")
        flush(path)

    monkeypatch.setattr(writing.os, "replace", counted_replace)
    monkeypatch.setattr(Path, "unlink", counted_unlink)
    monkeypatch.setattr(writing, "_flush", counted_flush)
    return done


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("kind", list(WRITERS))
def test_interrupted_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, old: bool) -> None:
    for stop_at in range(100):
        out = tmp_path / str(stop_at)
        if old:
            WRITERS[kind](1, out)
        with monkeypatch.context() as patch:
            done = _steps(patch, stop_at)
            try:
                WRITERS[kind](2, out)
            except KeyboardInterrupt:
                pass
            else:
                break
        assert len(done) == stop_at
        assert not out.exists() or not hidden(out)
        assert not hidden(tmp_path)
        if kind == "solution":
            numbers = number_of(out) if out.exists() else set()  # reads every file whole
            if out.exists() and (out / "summary.json").exists():
                assert len(numbers) == 1
        else:
            assert flight_number(out) in ({1, 2, None} if old else {2, None})
        WRITERS[kind](3, out)
        assert (number_of(out) if kind == "solution" else {flight_number(out)}) == {3}
    assert stop_at > (8 if old else 3)


KILLED = """
signal.signal(signal.SIGINT, signal.default_int_handler)  # a process started in the background may ignore it
out = Path(sys.argv[2])
write = WRITERS[sys.argv[1]]
write(0, out)
print("ready", flush=True)
k = 0
while True:
    k += 1
    write(k, out)
"""


@pytest.mark.parametrize("kind", list(WRITERS))
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_killed_at_random_moments(tmp_path: Path, kind: str, how: signal.Signals) -> None:
    rng = random.Random(f"{kind} {how}")
    processes = [(child(KILLED, kind, tmp_path / f"{i}" / "out"), tmp_path / f"{i}" / "out") for i in range(3)]
    left = 0
    for process, out in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(rng.uniform(0.02, 0.15))
        process.send_signal(how)
        try:
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
        assert process.returncode in (-how, 1)
        if how == signal.SIGKILL:
            assert err == ""
        names = [*hidden(out), *hidden(out.parent)]
        left += len(names)
        if how == signal.SIGINT:
            assert names == []
        if kind == "solution":
            numbers = number_of(out)
            assert not (out / "summary.json").exists() or len(numbers) == 1
        else:
            flight_number(out)
        WRITERS[kind](1_000_000, out)
        assert hidden(out) == hidden(out.parent) == []
        assert (number_of(out) if kind == "solution" else {flight_number(out)}) == {1_000_000}
    if how == signal.SIGKILL:
        assert left > 0  # at least one was killed in the middle of it


def test_what_a_killed_writing_leaves_is_not_a_result(tmp_path: Path) -> None:
    """Hidden work beside a folder that never came to be, and inside one that is there: nobody takes it for a flight."""
    code = """
with whole_files(Path(sys.argv[1]), "flight.toml") as work:
    (work / "imu.csv").write_text("t\\n0\\n")
    print("ready", flush=True)
    sys.stdin.readline()
"""
    for out in (tmp_path / "new", tmp_path / "there"):
        if out.name == "there":
            write_folder(flight(1), out)
        process = child(code, out)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        # While it runs, its work is left alone by others that write to the same place ...
        write_folder(flight(2), out)
        assert hidden(out if out.name == "there" else tmp_path) != []
        assert flight_number(out) == 2
        process.kill()
        process.communicate()
        # ... and when it is dead, the next one clears it away.
        assert hidden(out if out.name == "there" else tmp_path) != []
        assert flight_number(out) == 2
        write_folder(flight(3), out)
        assert hidden(out) == hidden(tmp_path) == []


def test_two_that_write_the_same_new_folder(tmp_path: Path) -> None:
    """The later one replaces the files of the earlier."""
    with whole_files(tmp_path / "out", "last") as work:
        (work / "last").write_text("mine")
        (work / "other").write_text("mine")
        with whole_files(tmp_path / "out", "last") as second:
            (second / "last").write_text("first")
    assert {p.name: p.read_text() for p in (tmp_path / "out").iterdir()} == {"last": "mine", "other": "mine"}


def test_links_that_look_like_leftovers_are_not_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "file").write_text("mine")
    (tmp_path / ".out.writing-x").symlink_to(precious)
    write_folder(flight(1), tmp_path / "out")
    assert (precious / "file").read_text() == "mine"


# The command line


def test_convert_on_a_disk_without_room(tmp_path: Path) -> None:
    write_folder(flight(1), tmp_path / "log")
    code = "import resource, haltere.cli; resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000)); haltere.cli.main()"
    command = [sys.executable, "-c", code, "convert", str(tmp_path / "log"), str(tmp_path / "new")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith(f"haltere: {tmp_path / 'new'}: expected a folder that can be written, found File too large")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "new").exists()
    assert not hidden(tmp_path)


def test_a_folder_of_tables_without_flight_toml_is_no_flight(tmp_path: Path) -> None:
    write_folder(flight(1), tmp_path / "f")
    (tmp_path / "f" / "flight.toml").unlink()
    with pytest.raises(HaltereError, match=r"expected a flight folder with a flight\.toml, found none"):
        read(tmp_path / "f")
