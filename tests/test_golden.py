"""Golden replays: the solution once a second, as a table a person can review in a diff. ``pytest tests/test_golden.py --update`` rewrites.

A change of these files says that behaviour changed, not that it got worse: the other tests say that.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import haltere
from converters import ecl_replay
from haltere.drive import run
from haltere.flight.log import Stream
from haltere.metrics.attitude import euler
from haltere.simulate import demo_flight
from haltere.simulate.truth import rotate_to_body

GOLDEN = Path(__file__).parent / "golden"


def _table(solution: haltere.Solution) -> str:
    """One row a second: degrees with 3 decimals, m/s with 3, m with 2, biases and 1 sigma with what matters."""
    slots = np.floor(solution.t)
    rows = np.flatnonzero(np.r_[True, np.diff(slots) > 0])
    angles = np.degrees(euler(solution.vector("q", "wxyz")))
    columns: list[tuple[str, np.ndarray, int]] = [("t", solution.t, 3)]
    columns += [(name, angles[:, k], 3) for k, name in enumerate(("roll", "pitch", "yaw"))]
    for stem, axes, decimals in (("vel", "ned", 3), ("pos", "ned", 2), ("gyro_bias", "xyz", 5), ("accel_bias", "xyz", 4)):
        columns += [(f"{stem}_{a}", solution[f"{stem}_{a}"], decimals) for a in axes if f"{stem}_{a}" in solution]
    columns += [(name, np.degrees(solution[name]), 3) for name in ("sd_roll", "sd_pitch", "sd_yaw")]
    columns += [(f"sd_{stem}_n", solution[f"sd_{stem}_n"], 3) for stem in ("vel", "pos") if f"sd_{stem}_n" in solution]
    lines = [",".join(name for name, _, _ in columns)]
    lines += [",".join(f"{values[i]:.{decimals}f}" for _, values, decimals in columns) for i in rows]
    return "\n".join(lines) + "\n"


def _compare(name: str, text: str, update: bool) -> None:
    """Equal within two units of the last decimal: another processor may round otherwise."""
    file = GOLDEN / f"{name}.csv"
    if update:
        file.write_text(text)
        return
    want, got = file.read_text().splitlines(), text.splitlines()
    assert got[0] == want[0], "other columns"
    assert len(got) == len(want), "other number of rows"
    for line, (a, b) in enumerate(zip(want[1:], got[1:], strict=True), start=2):
        for column, x, y in zip(want[0].split(","), a.split(","), b.split(","), strict=True):
            unit = 10.0 ** -len(x.partition(".")[2])
            difference = abs(float(x) - float(y))
            if column == "yaw":
                difference = min(difference, abs(difference - 360.0))
            assert difference <= 2.01 * unit, f"{file.name}:{line} {column}: was {x}, is {y} (review, then --update)"


@pytest.mark.parametrize(
    ("name", "make", "estimator"),
    [
        ("demo_navigator", lambda: demo_flight(1, 60.0), "navigator"),
        ("demo_no_compass", lambda: demo_flight(2, 60.0).without("magnetometer"), "navigator"),
        ("demo_ahrs", lambda: demo_flight(1, 60.0), "ahrs"),
        ("demo_two_stage", lambda: demo_flight(1, 60.0), "two-stage"),
    ],
)
def test_demo(name: str, make: Callable[[], haltere.FlightLog], estimator: str, request: pytest.FixtureRequest) -> None:
    _compare(name, _table(run(make(), estimator)), request.config.getoption("--update"))


@pytest.mark.parametrize("preset", ["as-corrected", "as-printed"])
def test_published_attitude_under_wind(preset: str, request: pytest.FixtureRequest) -> None:
    """With airspeed and vanes made of the truth, in a wind of 3 and -2 m/s that is given."""
    flight = demo_flight(1, 60.0)
    truth, rng = flight["truth"], np.random.default_rng(1)
    rows = np.arange(0, len(truth), len(truth) // 1200)
    q, ground = truth.vector("q", "wxyz")[rows], truth.vector("vel", "ned")[rows] - np.array([3.0, -2.0, 0.0])
    u, v, w = rotate_to_body(q, ground).T
    speed = np.sqrt(u * u + v * v + w * w)
    angles = 0.03 * rng.standard_normal((2, len(rows))) + np.array([np.arctan2(w, u), np.arcsin(v / speed)])
    columns = {"airspeed": np.maximum(speed + 0.5 * rng.standard_normal(len(rows)), 0.0), "aoa": angles[0], "sideslip": angles[1]}
    streams = {**flight.streams, "airdata": Stream({"t": truth.t[rows], **columns})}
    keys = {"told_wind.n": 3.0, "told_wind.e": -2.0, "noise.airspeed": 0.5}
    solution = run(haltere.FlightLog(streams, flight.meta), "wind-attitude", preset=preset, set=keys)
    _compare(f"wind_attitude_{preset.replace('-', '_')}", _table(solution), request.config.getoption("--update"))


def test_px4_replay(shared_data: Path, request: pytest.FixtureRequest) -> None:
    solution = run(ecl_replay(shared_data / "px4_ecl_replay" / "iris_gps.csv"))
    _compare("iris_gps", _table(solution), request.config.getoption("--update"))


def test_ardupilot_log(shared_data: Path, request: pytest.FixtureRequest) -> None:
    solution = run(haltere.read(shared_data / "ardupilot" / "log_0036_mechanical_failure.bin"))
    _compare("log_0036", _table(solution), request.config.getoption("--update"))
