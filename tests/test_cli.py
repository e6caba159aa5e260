"""The command line: verbs, exit statuses, one-line errors, what goes to which stream, and runs that repeat themselves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from haltere import cli
from haltere.errors import HaltereError
from haltere.flight.folder import write_folder
from haltere.flight.log import Stream
from haltere.simulate import SCENARIOS, demo_flight

OUTPUTS = {"solution.parquet", "aids.parquet", "events.json", "summary.json", "config.toml", "report.html"}


class Called:
    """What a call of the command line left: exit status and both streams."""

    def __init__(self, status: int, out: str, err: str) -> None:
        self.status, self.out, self.err = status, out, err


class Caller:
    """The command line, called in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.monkeypatch, self.capsys = monkeypatch, capsys

    def __call__(self, *words: object) -> Called:
        self.monkeypatch.setattr(sys, "argv", ["haltere", *map(str, words)])
        status = 0
        try:
            cli.main()
        except SystemExit as left:
            status = left.code if isinstance(left.code, int) else 0 if left.code is None else 1
        shown = self.capsys.readouterr()
        return Called(status, shown.out, shown.err)


@pytest.fixture
def haltere(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Caller:
    monkeypatch.chdir(tmp_path)
    return Caller(monkeypatch, capsys)


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short flight with three samples that cannot be used."""
    flight = demo_flight(seed=4, duration=26.0, imu_rate=100.0)
    columns = {k: v.copy() for k, v in flight["magnetometer"].columns.items()}
    columns["mag_x"][[100, 200, 300]] = np.nan
    flight.streams["magnetometer"] = Stream(columns)
    return write_folder(flight, tmp_path_factory.mktemp("logs") / "short flight")


def one_line(text: str) -> bool:
    return text.count("\n") == 1 and "Traceback" not in text


# --- without work --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words", [["--help"], ["--version"], ["run", "--help"], ["demo", "--help"], ["info", "--help"], ["convert", "--help"]]
)
def test_help_imports_nothing_heavy(words: list[str]) -> None:
    code = (
        "import sys, atexit\n"
        "heavy = ('numpy', 'numba', 'polars', 'scipy', 'plotly', 'pymavlink', 'pyulog', 'rich', 'pymap3d', 'pygeomag')\n"
        "atexit.register(lambda: print('HEAVY', [m for m in heavy if m in sys.modules], file=sys.stderr))\n"
        f"sys.argv = ['haltere', *{words!r}]\n"
        "from haltere.cli import main\n"
        "main()\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stderr.strip() == "HEAVY []"
    assert result.stdout.strip()


def test_help_names_every_verb_and_option(haltere: Caller) -> None:
    shown = haltere("--help").out
    for verb in ("run", "demo", "info", "convert"):
        assert f"\n  {verb} " in shown
    shown = haltere("run", "--help").out
    for option in ("--estimator", "--preset", "--config", "--set", "--smooth", "--vehicle", "--out", "--rate", "--json", "--open"):
        assert option in shown


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run"], "LOG"),
        (["fly"], "fly"),
        (["run", "x", "--ratte", "3"], "--ratte"),
        (["run", "x", "--rate", "fast"], "--rate"),
        (["convert", "x"], "DIR"),
    ],
)
def test_wrong_words_are_wrong_usage(haltere: Caller, words: list[str], said: str) -> None:
    done = haltere(*words)
    assert done.status == 2
    assert said in done.err
    assert "Traceback" not in done.err
    assert done.out == ""


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--set", "gate.gnsss=4"], "did you mean 'gate.gnss'?"),
        (["--set", "gate.gnss=wide"], "expected a number [sigma] for gate.gnss, found 'wide'"),
        (["--set", "gate.gnss=-1"], "of at least"),
        (["--set", "aid.magnetometer=maybe"], "off or heading or 3-axis"),
        (["--set", "gate.gnss"], "expected key=value"),
        (["--estimator", "navigater"], "did you mean 'navigator'?"),
        (["--preset", "as-printed"], "not one of the published designs"),
        (["--estimator", "ahrs", "--set", "aid.gnss=on"], "ahrs keeps it at off"),
        (["--config", "nowhere.toml"], "expected a configuration file, found no such file"),
        (["--rate", "-5"], "positive number of rows"),
        (["--vehicle", "quad.toml"], "vehicle"),
    ],
)
def test_wrong_options_are_one_line_and_status_2(haltere: Caller, log: Path, options: list[str], said: str) -> None:
    done = haltere("run", log, *options)
    assert done.status == 2
    assert said in done.err
    assert done.out == ""
    assert one_line(done.err)
    assert not list(Path.cwd().iterdir()), "nothing is written"


def test_wrong_usage_is_found_before_the_log_is_read(haltere: Caller) -> None:
    assert haltere("run", "nowhere.ulg", "--set", "gate.gnsss=4").status == 2


def test_a_failed_run_is_one_line_and_status_1(haltere: Caller, tmp_path: Path) -> None:
    (tmp_path / "noise.ulg").write_bytes(bytes(range(256)) * 8)
    (tmp_path / "empty.bin").write_bytes(b"")
    (tmp_path / "broken.toml").write_text("gate = [")
    for words, said in (
        (("run", "nowhere.ulg"), "nowhere.ulg: expected a log file or flight folder, found nothing there; check the path"),
        (("run", "noise.ulg"), "expected a log in one of the formats"),
        (("run", "empty.bin"), "found an empty file"),
        (("run", "noise.ulg", "--config", "broken.toml"), "broken.toml: expected a TOML file"),
        (("info", "nowhere.ulg"), "found nothing there"),
        (("convert", "nowhere.ulg", "out"), "found nothing there"),
    ):
        done = haltere(*words)
        assert done.status == 1, words
        assert said in done.err
        assert one_line(done.err)
        assert done.out == ""


def test_an_interrupted_run_exits_with_130(haltere: Caller, log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("haltere.readers.read", interrupted)
    done = haltere("run", log)
    assert done.status == 130
    assert "Traceback" not in done.err
    assert not list(Path.cwd().iterdir())


# --- with work -----------------------------------------------------------------------------------------------------------


def test_run_writes_the_folder_and_says_what_came_out(haltere: Caller, log: Path) -> None:
    done = haltere("run", log)
    assert done.status == 0
    folder = Path("short flight.haltere")
    assert {p.name for p in folder.iterdir()} == OUTPUTS
    for word in (
        "navigator: ",
        "aligned at t = ",
        "error against truth",
        "roll ",
        "velocity north ",
        "health: gnss ",
        "report: short flight.haltere",
    ):
        assert word in done.out
    assert "discarded: magnetometer: 3 samples, not finite" in done.err
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert f"haltere run &#x27;{log}&#x27; --config &#x27;short flight.haltere/config.toml&#x27;" in page
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["streams"]["magnetometer"]["discarded"] == {"not finite": 3}


def test_json_is_the_summary_and_nothing_else(haltere: Caller, log: Path, tmp_path: Path) -> None:
    done = haltere("run", log, "--json", "--out", tmp_path / "out", "--estimator", "ahrs", "--rate", "10")
    assert done.status == 0
    shown = json.loads(done.out)
    assert shown == json.loads((tmp_path / "out" / "summary.json").read_text())
    assert shown["estimator"] == "ahrs"
    assert "discarded: magnetometer: 3 samples, not finite" in done.err
    table = pl.read_parquet(tmp_path / "out" / "solution.parquet")
    assert "vel_n" not in table.columns
    assert float(np.median(np.diff(table["t"].to_numpy()))) == pytest.approx(0.1)
    assert "--rate 10" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("estimator", ["navigator", "ahrs"])
def test_config_reproduces_a_run_bit_for_bit(haltere: Caller, log: Path, estimator: str) -> None:
    changed = ("--set", "gate.magnetometer=4", "--set", "noise.gyro=2e-3", "--set", "delay.magnetometer=0.02")
    assert haltere("run", log, "--out", "first", "--estimator", estimator, *changed).status == 0
    assert haltere("run", log, "--out", "second", "--config", "first/config.toml").status == 0
    assert haltere("run", log, "--out", "third", "--estimator", estimator).status == 0
    first, second, third = (pl.read_parquet(f"{name}/solution.parquet") for name in ("first", "second", "third"))
    assert first.columns == second.columns
    assert all(first[c].to_numpy().tobytes() == second[c].to_numpy().tobytes() for c in first.columns)
    assert pl.read_parquet("first/aids.parquet").equals(pl.read_parquet("second/aids.parquet"), null_equal=True)
    assert Path("first/config.toml").read_text() == Path("second/config.toml").read_text()
    assert not first.equals(third)


def test_options_say_more_than_the_configuration_file(haltere: Caller, log: Path) -> None:
    Path("mine.toml").write_text('estimator = "ahrs"\n[gate]\nmagnetometer = 4.0\n')
    shown = json.loads(haltere("run", log, "--config", "mine.toml", "--json").out)
    assert shown["estimator"] == "ahrs"
    assert "magnetometer = 4.0" in Path("short flight.haltere/config.toml").read_text()
    done = haltere("run", log, "--config", "mine.toml", "--estimator", "navigator", "--set", "gate.magnetometer=5", "--json")
    assert json.loads(done.out)["estimator"] == "navigator"
    assert "magnetometer = 5.0" in Path("short flight.haltere/config.toml").read_text()


def test_a_folder_that_cannot_be_written_is_status_1(haltere: Caller, log: Path) -> None:
    Path("taken").write_text("")
    done = haltere("run", log, "--out", "taken")
    assert done.status == 1
    assert "name another folder (--out)" in done.err.splitlines()[-1]
    assert "Traceback" not in done.err
    assert Path("taken").read_text() == ""


def test_open_shows_the_report(haltere: Caller, log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setattr("webbrowser.open", shown.append)
    assert haltere("run", log, "--out", "o", "--open").status == 0
    assert shown == [(Path.cwd() / "o" / "report.html").as_uri()]


def test_demo_needs_nothing_and_repeats_itself(haltere: Caller, monkeypatch: pytest.MonkeyPatch) -> None:
    short = SCENARIOS["demo"].changed(duration=60.0, fault=("magnetometer:disturb=0.3@30-35", "gyro.x:bias=3deg/s@58"))
    monkeypatch.setitem(SCENARIOS, "demo", short)
    done = haltere("demo")
    assert done.status == 0
    assert {p.name for p in Path("demo.haltere").iterdir()} == OUTPUTS
    assert "report: demo.haltere/report.html" in done.out
    assert "haltere demo --seed 1 --out demo.haltere" in Path("demo.haltere/report.html").read_text(encoding="utf-8")
    assert "gyro.x:bias=3deg/s@58" in Path("demo.haltere/report.html").read_text(encoding="utf-8")
    again = haltere("demo", "--json", "--out", "again")
    assert json.loads(again.out)["errors"]["truth"]["roll_deg"]["rms"] < 2.0
    assert pl.read_parquet("demo.haltere/solution.parquet").equals(pl.read_parquet("again/solution.parquet"))


def test_info_and_convert_are_verbs(haltere: Caller, log: Path) -> None:
    assert "navigator" in haltere("info", log).out
    assert json.loads(haltere("info", log, "--json").out)["streams"]["imu"]["n"] == 2600
    done = haltere("convert", log, "copy", "--csv", "--json")
    assert done.status == 0
    assert Path("copy/flight.toml").exists()
    assert json.loads(done.out)["folder"] == "copy"


@pytest.mark.parametrize(
    ("given", "folder"),
    [
        ("a/b/log_0036.bin", "log_0036.haltere"),
        ("flight.v2.ulg", "flight.v2.haltere"),
        ("folder/", "folder.haltere"),
        ("x y", "x y.haltere"),
    ],
)
def test_default_folder(given: str, folder: str) -> None:
    from haltere.cli.run import default_folder

    assert default_folder(Path(given)) == Path(folder)


def test_default_folder_of_the_folder_one_stands_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from haltere.cli.run import default_folder

    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path / "mine")
    assert default_folder(Path(".")) == Path("mine.haltere")
    assert default_folder(Path("..")) == Path(f"{tmp_path.stem}.haltere")


def test_every_error_has_a_status() -> None:
    from haltere.errors import UsageError

    assert (HaltereError("a", "b").exit_status, UsageError("a", "b").exit_status) == (1, 2)


def test_smooth_writes_a_table_and_says_so(haltere: Caller, log: Path) -> None:
    done = haltere("run", log, "--smooth", "--out", "smooth")
    assert done.status == 0
    assert {p.name for p in Path("smooth").iterdir()} == OUTPUTS | {"smoothed.parquet"}
    assert "smoothed over the whole run: smoothed.parquet" in done.out
    assert "smoothed: error against truth, RMS (largest):" in done.out
    page = Path("smooth/report.html").read_text(encoding="utf-8")
    assert "--smooth" in page
    assert "smoothed: errors against truth" in page
    smoothed, solution = pl.read_parquet("smooth/smoothed.parquet"), pl.read_parquet("smooth/solution.parquet")
    assert smoothed.columns == solution.columns
    assert smoothed["t"].equals(solution["t"])
    errors = json.loads(Path("smooth/summary.json").read_text(encoding="utf-8"))
    assert errors["smoothed"]["errors"]["truth"]["roll_deg"]["rms"] < errors["errors"]["truth"]["roll_deg"]["rms"]
    haltere("run", log, "--out", "smooth")  # a later run without it takes the table away
    assert not Path("smooth/smoothed.parquet").exists()


# --- a wind told from outside --------------------------------------------------------------------------------------------


def test_a_told_wind_is_checked_before_the_log_is_read_and_goes_into_the_command(haltere: Caller, log: Path) -> None:
    for words in (["--wind", "nowhere.csv"], ["--wind", "fast@270"], ["--wind-sd", "1"], ["--wind", "1,2", "--wind-sd", "0"]):
        called = haltere("run", "no such log", *words)
        assert called.status == 2
        assert one_line(called.err)
        assert "wind" in called.err
    called = haltere("run", log, "--wind", "-4,2.5", "--out", "told", "--json")
    assert called.status == 0
    summary = json.loads(called.out)
    assert any("wind told: -4 m/s to north, 2.5 to east" in w for w in summary["warnings"])
    assert any("not used" in w for w in summary["warnings"])  # this vehicle has neither rotors nor a pitot tube in its log
    assert "--wind -4,2.5" in Path("told/report.html").read_text(encoding="utf-8")
    assert "not used" in called.err
