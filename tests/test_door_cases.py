"""Broken logs from one table of ways to break a good one: in memory, as flight folders, as single tables, and on the command line.

Each case either works, with what was left out counted and told, or is refused in one sentence that says what to do. No row of a
solution is ever not finite.
"""

from __future__ import annotations

import json
import math
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from haltere import cli
from haltere.drive import run, usable
from haltere.errors import HaltereError
from haltere.flight import axes
from haltere.flight.folder import write_folder
from haltere.flight.log import FlightLog, FlightMeta
from haltere.flight.solution import Solution
from haltere.readers import read
from haltere.simulate import demo_flight

Columns = dict[str, Any]
Streams = dict[str, Columns]
GYRO, ACCEL, MAG = (tuple(f"{s}_{a}" for a in "xyz") for s in ("gyro", "accel", "mag"))
VEL = ("vel_n", "vel_e", "vel_d")


@dataclass(frozen=True)
class Case:
    """A way to break a flight and what must come of it.

    ``lost`` is (stream, reason, number) counted in the summary; ``says`` a pattern among its warnings; ``refused`` the pattern of the error
    instead; ``cure`` the keys of the option that the message names: with them the flight is as good as before.
    """

    name: str
    change: Callable[[Streams], Any]
    lost: tuple[str, str, int] | None = None
    says: str = ""
    refused: str = ""
    cure: dict[str, str] | None = None
    table: bool = True
    folder: bool = True


def put(stream: str, names: tuple[str, ...] | str, rows: Any, value: float) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        for name in (names,) if isinstance(names, str) else names:
            s[stream][name][rows] = value

    return change


def scale(stream: str, names: tuple[str, ...] | str, factor: float) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        for name in (names,) if isinstance(names, str) else names:
            s[stream][name] = factor * s[stream][name]

    return change


def worn(stream: str, stem: str, word: str) -> Callable[[Streams], None]:
    """The sensor as it would be logged with its x, y, z where the word says."""

    def change(s: Streams) -> None:
        v = np.column_stack([s[stream][f"{stem}_{a}"] for a in "xyz"]) @ axes.matrix(word)
        for k, a in enumerate("xyz"):
            s[stream][f"{stem}_{a}"] = v[:, k]

    return change


def both(*changes: Callable[[Streams], Any]) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        for one in changes:
            one(s)

    return change


def reorder(stream: str, order: Callable[[int], Any]) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        rows = order(len(s[stream]["t"]))
        s[stream] = {name: v[rows] for name, v in s[stream].items()}

    return change


def clock(names: tuple[str, ...], after: float, step: float) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        for name in names:
            t = s[name]["t"]
            s[name]["t"] = np.where(t > after, t + step, t)

    return change


def freeze(stream: str, names: tuple[str, ...], start: float, end: float) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        t = s[stream]["t"]
        rows = (t >= start) & (t <= end)
        for name in names:
            s[stream][name][rows] = s[stream][name][rows][0]

    return change


def hold(stream: str, n: int) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        first = np.arange(len(s[stream]["t"])) // n * n
        s[stream] = {name: v if name == "t" else v[first] for name, v in s[stream].items()}

    return change


def rename(stream: str, old: str, new: str) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        s[stream] = {new if name == old else name: v for name, v in s[stream].items()}

    return change


def call(old: str, new: str) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        s[new] = s.pop(old)

    return change


def cut(stream: str, rows: slice) -> Callable[[Streams], None]:
    return reorder(stream, lambda n: np.arange(n)[rows])


def text(stream: str, name: str) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        s[stream][name] = np.array(["n/a"] * len(s[stream]["t"]))

    return change


def exchange(stream: str, one: str, other: str) -> Callable[[Streams], None]:
    def change(s: Streams) -> None:
        s[stream][one], s[stream][other] = s[stream][other], s[stream][one]

    return change


def in_radians(s: Streams) -> None:
    for name in ("lat", "lon"):
        s["gnss"][name] = np.radians(s["gnss"][name])


SENSORS = ("imu", "magnetometer", "gnss", "barometer")
EVERY = (*SENSORS, "truth")

CASES = (
    # samples that are no numbers, or no measurements
    Case("gyro nan", put("imu", "gyro_x", [900, 901, 1200], math.nan), ("imu", "not finite", 3)),
    Case("accel inf", put("imu", "accel_z", [900], math.inf), ("imu", "not finite", 1)),
    Case("imu zero", put("imu", GYRO + ACCEL, slice(900, 905), 0.0), ("imu", "zero accelerometer", 5)),
    Case("gyro flipped bit", put("imu", "gyro_y", [900], 1e30), ("imu", "impossible value", 1)),
    Case("mag nan", put("magnetometer", "mag_y", slice(400, 404), math.nan), ("magnetometer", "not finite", 4)),
    Case("mag zero", put("magnetometer", MAG, slice(400, 403), 0.0), ("magnetometer", "zero", 3)),
    Case("fix nan", put("gnss", ("lat", "vel_n"), [90], math.nan), ("gnss", "not finite", 1)),
    Case("fix at zero", put("gnss", ("lat", "lon"), slice(90, 93), 0.0), ("gnss", "latitude and longitude zero", 3)),
    Case("no fix ever", put("gnss", "fix_type", slice(None), 0.0), says=r"gnss: none of its 239 samples can be used \(no 3-D fix 239\)"),
    Case("pressure nan", put("barometer", "pressure", [200], math.nan), ("barometer", "not finite", 1)),
    Case(
        "accuracies negative", put("gnss", ("h_acc", "v_acc"), slice(90, 99), -1.0),
        says=r"9 of 239 values of h_acc are zero or negative",
    ),
    # times
    Case("imu time nan", put("imu", "t", [900, 901], math.nan), ("imu", "time not finite", 2), table=False),
    Case("imu repeated", reorder("imu", lambda n: np.sort(np.r_[:n, 900:910])), ("imu", "repeated time", 10)),
    Case("imu swapped", reorder("imu", lambda n: np.r_[:900, 901, 900, 902:n]), ("imu", "out of order, sorted", 1)),
    Case("imu reversed", reorder("imu", lambda n: np.arange(n)[::-1]), ("imu", "out of order, sorted", 2399)),
    Case("imu in blocks", reorder("imu", lambda n: np.r_[:800, 1200:1600, 800:1200, 1600:n]), ("imu", "out of order, sorted", 1)),
    Case("imu time flipped", put("imu", "t", [900], 1e9), ("imu", "more than a day from the others", 1)),
    Case("mag time flipped", put("magnetometer", "t", [400], -1e9), ("magnetometer", "more than a day from the others", 1), table=False),
    Case("hours of nothing", clock(EVERY, 14.0, 7200.0), says=r"imu: 1 gap longer than 2 s, the longest 7200 s"),
    Case("imu 10 s gap", reorder("imu", lambda n: np.r_[:1200, 2200:n]), says=r"imu: 1 gap longer than 2 s, the longest 10 s"),
    Case(
        "mag set back", clock(("magnetometer",), 16.0, -6.0), ("magnetometer", "clock set back", 399),
        says="its clock is set back 1 time",
    ),
    Case("gnss of another clock", scale("gnss", "t", 1000.0), says=r"gnss: only 0 % of its times are within the imu's.*another clock\?"),
    Case("imu set back", clock(EVERY, 16.0, -6.0), refused=r"times that rise.*set back by 5\.99 s after sample 1601.*cut it there"),
    Case("imu set on by years", clock(EVERY, 14.0, 1.7e9), refused=r"expected one clock.*a step of 1\.7e\+09 s after t = 14\.000 s"),
    Case(
        "one time for all", put("imu", "t", slice(None), 5.0),
        refused=r"at least 20 usable samples, found 1 of 2400 \(repeated time 2399\)",
    ),
    Case(
        "microseconds", lambda s: [scale(n, "t", 1e6)(s) for n in EVERY],
        refused=r"microseconds: --set unit\.time=us", cure={"unit.time": "us"},
    ),
    Case(
        "milliseconds", lambda s: [scale(n, "t", 1e3)(s) for n in EVERY],
        refused=r"milliseconds: --set unit\.time=ms", cure={"unit.time": "ms"},
    ),
    Case(
        "nanoseconds", lambda s: [scale(n, "t", 1e9)(s) for n in EVERY],
        refused=r"nanoseconds: --set unit\.time=ns", cure={"unit.time": "ns"},
    ),
    # units
    Case("accel in g", scale("imu", ACCEL, 1 / 9.80665), refused=r"it looks like g: --set unit\.accel=g", cure={"unit.accel": "g"}),
    Case("accel in mg", scale("imu", ACCEL, 1e3 / 9.80665), refused=r"it looks like mg: --set unit\.accel=mg", cure={"unit.accel": "mg"}),
    Case("gyro in deg/s", scale("imu", GYRO, 180 / math.pi), refused=r"deg/s: --set unit\.gyro=deg/s", cure={"unit.gyro": "deg/s"}),
    Case("gyro in mrad/s", scale("imu", GYRO, 1e3), refused=r"angular rates in rad/s"),
    Case("gyro converted twice", scale("imu", GYRO, math.pi / 180), refused=r"rates in rad/s.*taken for deg/s and converted"),
    Case(
        "mag in gauss", scale("magnetometer", MAG, 0.01), ("magnetometer", "strength impossible in uT", 1199),
        r"looks like gauss: --set unit\.magnetometer=G", cure={"unit.magnetometer": "gauss"},
    ),
    Case("mag in mG", scale("magnetometer", MAG, 10.0), says=r"milligauss: --set unit\.magnetometer=mG", cure={"unit.magnetometer": "mG"}),
    Case("mag in nT", scale("magnetometer", MAG, 1e3), says=r"nT: --set unit\.magnetometer=nT", cure={"unit.magnetometer": "nT"}),
    Case("mag in T", scale("magnetometer", MAG, 1e-6), says=r"tesla: --set unit\.magnetometer=T", cure={"unit.magnetometer": "tesla"}),
    Case("mag in mT", scale("magnetometer", MAG, 1e-3), says=r"mT: --set unit\.magnetometer=mT", cure={"unit.magnetometer": "mT"}),
    Case("mag normalised", scale("magnetometer", MAG, 1 / 47.6), says=r"normalised to one"),
    Case(
        "pressure in hPa", scale("barometer", "pressure", 0.01), ("barometer", "pressure impossible in Pa", 599),
        r"hPa: --set unit\.pressure=hPa", cure={"unit.pressure": "hPa"},
    ),
    Case("pressure in kPa", scale("barometer", "pressure", 0.001), says=r"--set unit\.pressure=kPa", cure={"unit.pressure": "kPa"}),
    Case(
        "altitude in mm", scale("gnss", "alt", 1e3), ("gnss", "altitude impossible in m", 239),
        r"mm: --set unit\.gnss_altitude=mm", cure={"unit.gnss_altitude": "mm"},
    ),
    Case(
        "place in 1e-7 deg", scale("gnss", ("lat", "lon"), 1e7), ("gnss", "latitude or longitude impossible", 239),
        r"--set unit\.gnss_position=1e-7deg", cure={"unit.gnss_position": "1e-7deg"},
    ),
    Case(
        "place in radians",
        in_radians,
        ("gnss", "place and velocity disagree", 239),
        r"place in rad; not used; --set unit\.gnss_position=rad",
        cure={"unit.gnss_position": "rad"},
    ),
    Case("velocity in cm/s", scale("gnss", VEL, 100.0), says=r"--set unit\.gnss_velocity=cm/s", cure={"unit.gnss_velocity": "cm/s"}),
    Case("lat and lon exchanged", exchange("gnss", "lat", "lon"), says=r"only with lat and lon exchanged; not used; exchange the columns"),
    Case("vel_n and vel_e exchanged", exchange("gnss", "vel_n", "vel_e"), ("gnss", "place and velocity disagree", 239)),
    # axes
    Case("gyro FLU", worn("imu", "gyro", "FLU"), says=r"=BRD; if the gyro's: --set axes\.gyro=FLU", cure={"axes.gyro": "FLU"}),
    Case("gyro mirrored", worn("imu", "gyro", "FLD"), refused=r"found mirrored ones.*--set axes\.gyro=FLD", cure={"axes.gyro": "FLD"}),
    Case("gyro x, y swapped", worn("imu", "gyro", "RFD"), refused=r"found mirrored ones.*--set axes\.gyro=RFD", cure={"axes.gyro": "RFD"}),
    Case("gyro all reversed", scale("imu", GYRO, -1.0), refused=r"found mirrored ones.*--set axes\.gyro=BLU", cure={"axes.gyro": "BLU"}),
    Case(
        "mag FLU", worn("magnetometer", "mag", "FLU"), ("magnetometer", "axes unlike the gyro's or the field's", 1199),
        r"with axes FLU; not used; --set axes\.magnetometer=FLU$", cure={"axes.magnetometer": "FLU"},
    ),
    Case(
        "mag x, y swapped", worn("magnetometer", "mag", "RFD"),
        says=r"axes: --set axes\.magnetometer=RFD;", cure={"axes.magnetometer": "RFD"},
    ),
    Case(
        "mag turned on its mast", worn("magnetometer", "mag", "RBD"),
        says=r"--set axes\.magnetometer=RBD;", cure={"axes.magnetometer": "RBD"},
    ),
    Case(
        "mag z turned over", worn("magnetometer", "mag", "FRU"),
        says=r"not used; --set axes\.magnetometer=FRU$", cure={"axes.magnetometer": "FRU"},
    ),
    Case(
        "mag all reversed", scale("magnetometer", MAG, -1.0),
        says=r"not used; --set axes\.magnetometer=BLU", cure={"axes.magnetometer": "BLU"},
    ),
    Case("gravity for force", scale("imu", ACCEL, -1.0), refused=r"found positive z.*--set axes\.accel=BLU", cure={"axes.accel": "BLU"}),
    Case(
        "imu FLU", both(worn("imu", "gyro", "FLU"), worn("imu", "accel", "FLU")), refused=r"found positive z.*--set axes\.imu=FLU",
        cure={"axes.imu": "flu"},
    ),
    Case(
        "imu on its side", both(worn("imu", "gyro", "FUR"), worn("imu", "accel", "FUR")),
        says=r"force is along positive y", cure={"axes.imu": "FUR"},
    ),
    # stuck, and held
    Case(
        "gyro axis stuck", freeze("imu", ("gyro_x",), 8.0, 12.0),
        says=r"gyro_x holds one value from t = 8\.00 to 12\.00 s while the other",
    ),
    Case(
        "imu frozen", freeze("imu", GYRO + ACCEL, 8.0, 12.0),
        says=r"imu: gyro_x, gyro_y, gyro_z all hold one value from t = 8\.00 to 12\.00",
    ),
    Case("accel axis missing", put("imu", "accel_y", slice(None), 0.0), says=r"imu: accel_y never changes: is the axis there\?"),
    Case("mag frozen", freeze("magnetometer", MAG, 8.0, 12.0), says=r"magnetometer: mag_x, mag_y, mag_z all hold one value"),
    Case("height held", hold("barometer", 4), ("barometer", "repeats the row before", 449)),
    Case("fixes held", hold("gnss", 5), ("gnss", "repeats the row before", 191)),
    Case("mag held", hold("magnetometer", 5), says=r"magnetometer: 959 of 1199 rows only hold the row before; they count"),
    # names, and what is missing
    Case("stream gps", call("gnss", "gps"), says=r"'gps' is not known and not read; did you mean 'gnss'\?", table=False),
    Case("stream mag", call("magnetometer", "mag"), says=r"'mag' is not known and not read; did you mean 'magnetometer'\?", table=False),
    Case("stream gyro", call("imu", "gyro"), refused=r"an imu stream.*rename 'gyro' to 'imu'", table=False),
    Case(
        "column magx", rename("magnetometer", "mag_x", "magX"),
        says=r"column 'magX' is not known and not read; did you mean 'mag_x'", table=False,
    ),
    Case(
        "column latitude", rename("gnss", "lat", "latitude"),
        says=r"'latitude' is not known and not read; did you mean 'lat'", table=False,
    ),
    Case("column gyr_x", rename("imu", "gyro_x", "gyr_x"), refused=r"found no gyro_x; is 'gyr_x' meant to be 'gyro_x'\?", table=False),
    Case("no imu", lambda s: s.pop("imu"), refused=r"expected an imu stream with gyro and accel"),
    Case("imu is text", text("imu", "gyro_x"), refused=r"gyro_x.*expected (a )?numbers?, found (text such as )?'n/a'"),
    Case("gnss is text", text("gnss", "lat"), refused=r"lat.*expected (a )?numbers?, found (text such as )?'n/a'"),
    Case("one imu sample", cut("imu", slice(0, 1)), refused=r"at least 20 usable samples, found 1 of 1"),
    Case("one fix", cut("gnss", slice(90, 91))),
    Case("one field", cut("magnetometer", slice(90, 91))),
    Case("two pressures", cut("barometer", slice(90, 92))),
    Case("empty mag", cut("magnetometer", slice(0, 0)), table=False),
    Case("no magnetometer", lambda s: s.pop("magnetometer")),
    Case("no gnss", lambda s: s.pop("gnss")),
    Case("no barometer", lambda s: s.pop("barometer")),
    # the reference, which costs no run
    Case("truth reversed", reorder("truth", lambda n: np.arange(n)[::-1]), ("truth", "out of order, sorted", 2399)),
    Case("truth is text", text("truth", "vel_n"), ("truth", "text in vel_n", 2400), table=False, folder=False),
    Case("truth time nan", put("truth", "t", slice(0, 7), math.nan), ("truth", "time not finite", 7), table=False),
    Case("truth of zeros", put("truth", ("q_w", "q_x", "q_y", "q_z"), slice(1000, 1100), 0.0), ("truth", "zero quaternion", 100)),
    Case("truth empty", cut("truth", slice(0, 0)), table=False),
)  # fmt: skip
BY_NAME = {c.name: c for c in CASES}
assert len(BY_NAME) == len(CASES)


@pytest.fixture(scope="module")
def flight() -> FlightLog:
    return demo_flight(2, 24.0, imu_rate=100.0)


def lost(solution: Solution) -> dict[str, dict[str, int]]:
    """What was left out, besides what every run has before its alignment."""
    reasons = {n: {k: v for k, v in s["discarded"].items() if k != "before alignment"} for n, s in solution.summary["streams"].items()}
    return {n: r for n, r in reasons.items() if r}


@pytest.fixture(scope="module")
def clean(flight: FlightLog) -> Solution:
    solution = run(flight)
    assert solution.summary["warnings"] == flight.notes
    assert lost(solution) == {}
    return solution


def broken(flight: FlightLog, case: Case) -> FlightLog:
    streams: Streams = {name: {c: v.copy() for c, v in s.columns.items()} for name, s in flight.streams.items()}
    case.change(streams)
    return FlightLog(streams, flight.meta)


def wide(flight: FlightLog, path: Path) -> Path:
    """The flight as one CSV: a row a sample of one stream, the others' columns empty."""
    parts = []
    for name, s in flight.streams.items():
        if name != "truth":
            parts.append(pl.DataFrame({"t" if c == "t" else f"{name}.{c}": v for c, v in s.columns.items()}))
    pl.concat(parts, how="diagonal_relaxed").write_csv(path)
    return path


def check_solution(solution: Solution, case: Case, *, counts: bool = True) -> None:
    for name, column in solution.table.items():
        assert np.isfinite(column).all(), name
    summary = solution.summary
    if case.lost is not None and counts:
        stream, reason, n = case.lost
        assert summary["streams"][stream]["discarded"].get(reason) == n
    if case.says:
        assert any(re.search(case.says, w) for w in summary["warnings"]), summary["warnings"]
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert np.isfinite(solution["q_w"]).all() and len(solution) > 0


def check_refused(case: Case, action: Callable[[], Any]) -> None:
    with pytest.raises(HaltereError, match=case.refused) as caught:
        action()
    error = caught.value
    assert error.expected and error.found and error.where and error.remedy
    assert "\n" not in str(error)


@pytest.mark.parametrize("name", BY_NAME)
def test_in_memory(name: str, flight: FlightLog) -> None:
    case, bad = BY_NAME[name], broken(flight, BY_NAME[name])
    before = {(s, c): v.copy() for s, stream in bad.streams.items() for c, v in stream.columns.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if case.refused:
            check_refused(case, lambda: run(bad))
        else:
            solution = run(bad)
            check_solution(solution, case)
            shown = usable(bad, solution.config)
            assert all(np.isfinite(s.t).all() and (np.diff(s.t) > 0.0).all() for s in shown.streams.values())
    for (s, c), v in before.items():  # what was given is not touched
        np.testing.assert_array_equal(bad[s][c], v)


@pytest.mark.parametrize("name", [c.name for c in CASES if c.cure])
def test_the_option_that_is_named_cures(name: str, flight: FlightLog, clean: Solution, tmp_path: Path) -> None:
    """With the key that the message names the flight is what it was; the configuration file of that run does the same."""
    case, bad = BY_NAME[name], broken(flight, BY_NAME[name])
    solution = run(bad, set=case.cure)
    assert not any(re.search(case.says or "not used", w) for w in solution.summary["warnings"])
    assert lost(solution) == {}
    for key in case.cure or {}:
        assert any(f"as configured ({key.replace('imu', 'gyro')})" in w for w in solution.summary["warnings"])
    np.testing.assert_allclose(solution.t, clean.t, rtol=0.0, atol=1e-9)
    for column in ("q_w", "q_x", "q_y", "q_z", "vel_n", "vel_e", "vel_d", "pos_n", "pos_e", "pos_d", "sd_yaw"):
        np.testing.assert_allclose(solution[column], clean[column], rtol=0.0, atol=1e-5, err_msg=column)
    (tmp_path / "config.toml").write_text(solution.config.to_toml())
    again = run(bad, config=tmp_path / "config.toml")
    np.testing.assert_array_equal(again["pos_n"], solution["pos_n"])
    assert "truth" not in solution.summary["errors"] or solution.summary["errors"]["truth"]["pos_n"]["rms"] < 2.0


@pytest.mark.parametrize("csv", [False, True], ids=["parquet", "csv"])
@pytest.mark.parametrize("name", [c.name for c in CASES if c.folder])
def test_as_a_folder(name: str, csv: bool, flight: FlightLog, tmp_path: Path) -> None:
    case = BY_NAME[name]
    folder = write_folder(broken(flight, case), tmp_path / "flight", csv=csv)
    if case.refused:
        check_refused(case, lambda: run(read(folder)))
    else:
        check_solution(run(read(folder)), case)


@pytest.mark.parametrize("name", [c.name for c in CASES if c.table])
def test_as_a_table(name: str, flight: FlightLog, tmp_path: Path) -> None:
    """Rows without a value are no samples of a table, and its reader starts the time at zero: what is said is checked, not each count."""
    case = BY_NAME[name]
    path = wide(broken(flight, case), tmp_path / "flight.csv")
    if case.refused:
        check_refused(Case(case.name, case.change, refused=case.refused), lambda: run(read(path)))
    else:
        check_solution(run(read(path)), case, counts=False)


# The command line


@pytest.fixture
def haltere(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., tuple[int, str, str]]:
    def call(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["haltere", *map(str, words)])
        status = 0
        try:
            cli.main()
        except SystemExit as left:
            status = left.code if isinstance(left.code, int) else 0 if left.code is None else 1
        out = capsys.readouterr()
        return status, out.out, out.err

    monkeypatch.chdir(tmp_path)
    return call


@pytest.mark.parametrize("name", [c.name for c in CASES if c.refused])
def test_refused_on_the_command_line(name: str, flight: FlightLog, haltere: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    case = BY_NAME[name]
    folder = write_folder(broken(flight, case), tmp_path / "flight")
    status, out, err = haltere("run", folder)
    assert status == 1
    assert out == ""
    assert err.count("\n") == 1 and err.startswith("haltere: ")
    assert re.search(case.refused, err)
    assert not (tmp_path / "flight.haltere").exists()


@pytest.mark.parametrize(
    "name", ["gyro nan", "imu reversed", "imu time flipped", "mag FLU", "altitude in mm", "truth of zeros", "empty mag"]
)
def test_told_on_the_command_line(name: str, flight: FlightLog, haltere: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    case = BY_NAME[name]
    status, out, err = haltere("run", write_folder(broken(flight, case), tmp_path / "flight"), "--json")
    assert status == 0, err
    summary = json.loads(out)
    if case.lost is not None:
        stream, reason, n = case.lost
        assert summary["streams"][stream]["discarded"][reason] == n
        assert f"discarded: {stream}: {n} samples, {reason}\n" in err
    if case.says:
        assert re.search(f"^note: .*{case.says}", err, re.MULTILINE)
    assert json.loads((tmp_path / "flight.haltere" / "summary.json").read_text()) == summary


def test_the_cure_on_the_command_line(flight: FlightLog, haltere: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    """The option as the message has it, and config.toml after it."""
    folder = write_folder(broken(flight, BY_NAME["gyro in deg/s"]), tmp_path / "flight")
    status, _, err = haltere("run", folder)
    option = re.search(r"--set (unit\.gyro=deg/s)", err)
    assert status == 1 and option
    status, out, err = haltere("run", folder, "--set", option[1], "--json")
    assert status == 0
    assert "note: imu: gyro_x, gyro_y, gyro_z taken as deg/s as configured (unit.gyro)" in err
    first = json.loads(out)
    status, out, _ = haltere("run", folder, "--config", tmp_path / "flight.haltere" / "config.toml", "--json")
    assert json.loads(out)["errors"] == first["errors"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--set", "unit.gyros=deg/s"], "did you mean 'unit.gyro'?"),
        (["--set", "unit.gyro=degrees"], "expected unit.gyro to be rad/s, deg/s, mrad/s, rpm, found 'degrees'"),
        (["--set", "unit.gyro=degs"], "did you mean 'deg/s'?"),
        (["--set", "unit.magnetometer=mg"], "did you mean 'mG'?"),
        (["--set", "axes.imu=FLX"], "expected axes.gyro to be one each of F or B, R or L, D or U, found 'FLX'"),
        (["--set", "axes.imu=FFD"], "found 'FFD'"),
        (["--set", "axis.imu=FLU"], "did you mean 'axes.imu'?"),
        (["--set", "axes.mag=FLU"], "did you mean 'axes.magnetometer'?"),
        (["--sett", "axes.imu=FLU"], "--sett"),
        (["--column", "imu.gyro_x"], "expected STREAM.COLUMN=SOURCE, found 'imu.gyro_x'"),
        (["--columns", "nothing.toml"], "expected a column map, found no such file"),
    ],
)
def test_misspelt_is_wrong_usage(
    words: list[str], said: str, flight: FlightLog, haltere: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    status, out, err = haltere("run", tmp_path / "no log is read before", *words)
    assert status == 2
    assert said in err
    assert "Traceback" not in err
    assert out == ""


# Column maps


def foreign(flight: FlightLog, path: Path) -> Path:
    """A logger's own table: its own names, deg/s, g and milliseconds."""
    imu = flight["imu"]
    table = {"stamp": 1e3 * imu.t} | {f"g{a}": np.degrees(imu[f"gyro_{a}"]) for a in "xyz"}
    pl.DataFrame(table | {f"a{a}": imu[f"accel_{a}"] / 9.80665 for a in "xyz"}).write_csv(path)
    return path


MAP = {"t": "stamp [ms]"} | {f"imu.gyro_{a}": f"g{a} [deg/s]" for a in "xyz"} | {f"imu.accel_{a}": f"a{a} [g]" for a in "xyz"}


@pytest.mark.parametrize("nested", [False, True])
def test_a_column_map_by_file(nested: bool, flight: FlightLog, haltere: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    path = foreign(flight, tmp_path / "log.csv")
    lines = [f'{k} = "{v}"' if nested else f'"{k}" = "{v}"' for k, v in MAP.items()]
    (tmp_path / "map.toml").write_text("\n".join(lines))
    status, _, err = haltere("convert", path, tmp_path / "folder", "--columns", tmp_path / "map.toml")
    assert status == 0, err
    imu = read(tmp_path / "folder")["imu"]
    for name in ("t", *GYRO, *ACCEL):
        np.testing.assert_allclose(imu[name], flight["imu"][name], rtol=1e-12, atol=1e-12)
    status, out, _ = haltere("info", path, "--columns", tmp_path / "map.toml", "--json")
    assert status == 0
    assert json.loads(out)["streams"]["imu"]["n"] == 2400


def test_a_column_map_by_options_runs_and_is_in_the_command(
    flight: FlightLog, haltere: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    path = foreign(flight, tmp_path / "log.csv")
    words = [word for k, v in MAP.items() for word in ("--column", f"{k}={v}")]
    status, out, err = haltere("run", path, *words, "--json")
    assert status == 0, err
    assert json.loads(out)["rows"] > 1000
    assert "imu.gyro_x=gx [deg/s]" in (tmp_path / "log.haltere" / "report.html").read_text()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"imu.gyro_x": "gxx [deg/s]"}, "did you mean 'gx'?"),
        ({"imu.giro_x": "gx [deg/s]"}, "did you mean 'gyro_x'?"),
        ({"inu.gyro_x": "gx [deg/s]"}, "did you mean 'imu'?"),
        ({"imu.gyro_x": "gx [degs]"}, "expected a unit that can be turned into rad/s"),
        ({"t": "time [ms]"}, "expected the column 'time' for t"),
    ],
)
def test_a_wrong_column_map_is_named(
    change: dict[str, str], said: str, flight: FlightLog, haltere: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    path = foreign(flight, tmp_path / "log.csv")
    words = [word for k, v in (MAP | change).items() for word in ("--column", f"{k}={v}")]
    status, out, err = haltere("run", path, *words)
    assert status == 1
    assert said in err
    assert err.count("\n") == 1
    assert out == ""


# What a flight says of itself, and what a stream may be made of


@pytest.mark.parametrize(
    ("meta", "words"),
    [
        ({"field": {"declination": 2.5e2}}, r"flight\.toml: .*between -3\.14.* for field\.declination"),
        ({"field": {"strength": -50.0}}, r"flight\.toml: .*field\.strength"),
        ({"delays": {"gnss": math.nan}}, r"flight\.toml: .*delay\.gnss"),
        ({"imu_kind": "mena"}, r"flight\.toml: .*imu\.kind"),
    ],
)
def test_metadata_out_of_bounds(meta: dict[str, Any], words: str, flight: FlightLog) -> None:
    with pytest.raises(HaltereError, match=words):
        run(FlightLog(flight.streams, FlightMeta(**meta)))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (None, r"columns by name.*found a NoneType"),
        (np.zeros((3, 2)), r"columns by name.*found a ndarray"),
        ({"t": [[0.0], [1.0, 2.0]]}, r"one-dimensional columns, found rows of several lengths"),
        ({"t": np.array(["2026-01-01"], "datetime64[s]")}, r"found dates.*times are seconds"),
        ({"t": [0.0], 3: [1.0]}, r"names of columns as text, found 3"),
        ({"t": [object()]}, r"numbers or text, found other objects"),
        ({"t": 5.0}, r"one-dimensional columns, found shape \(\)"),
    ],
)
def test_streams_made_of_other_things(given: Any, words: str) -> None:
    with pytest.raises(HaltereError, match=words) as caught:
        FlightLog({"imu": given})
    assert "imu" in str(caught.value)


def _read_only(v: np.ndarray) -> Any:
    v = v.copy()
    v.flags.writeable = False
    return v


@pytest.mark.parametrize(
    "kind",
    [
        list, tuple, _read_only, lambda v: v.astype(object), lambda v: np.asfortranarray(np.column_stack([v, v]))[:, 1],
        lambda v: np.repeat(v, 3)[::3], lambda v: v[::-1].copy()[::-1], lambda v: np.ma.masked_array(v, np.zeros(len(v), bool)),
        lambda v: v.astype(">f8"), pl.Series,
    ],
    ids=["list", "tuple", "read-only", "objects", "Fortran order", "strided", "reversed view", "masked", "big-endian", "polars"],
)  # fmt: skip
def test_arrays_of_any_kind(kind: Callable[[np.ndarray], Any], flight: FlightLog, clean: Solution) -> None:
    given = FlightLog({n: {c: kind(v) for c, v in s.columns.items()} for n, s in flight.streams.items()}, flight.meta)
    solution = run(given)
    for name, column in clean.table.items():
        np.testing.assert_array_equal(solution[name], column, err_msg=name)


def test_masked_values_are_missing_values(flight: FlightLog) -> None:
    columns: Columns = dict(flight["imu"].columns)
    columns["gyro_x"] = np.ma.masked_array(columns["gyro_x"], np.arange(2400) == 900)
    solution = run(FlightLog({**flight.streams, "imu": columns}, flight.meta))
    assert lost(solution) == {"imu": {"not finite": 1}}


def test_integers_of_whole_units() -> None:
    """Milli-g and milliradians as a logger's integers, at rest."""
    n = 600
    rng = np.random.default_rng(1)
    imu: Columns = {"t": 10 * np.arange(n)} | {c: rng.integers(-2, 3, n) for c in GYRO} | {c: rng.integers(-3, 4, n) for c in ACCEL}
    imu["accel_z"] = imu["accel_z"] - 1000
    solution = run(FlightLog({"imu": imu}), set={"unit.time": "ms", "unit.gyro": "mrad/s", "unit.accel": "mg"})
    assert solution.t[-1] == pytest.approx(5.99)
    assert np.isfinite(solution["q_w"]).all()
    assert solution["q_w"].min() > 0.999
