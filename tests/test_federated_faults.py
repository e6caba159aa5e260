"""`fault-tolerant` where it must show what it is for: the source's own form, faults one after another, fewer sensors, what comes back."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import haltere
from haltere.flight.log import FlightLog
from haltere.simulate import Scenario, simulate

DATA = Path(__file__).parents[1] / "docs" / "_data"
VERDICTS = ("bias", "suspect", "step")
#: The IMU of the truth table (caption of theory.md §5.5), without bias: 0.005 rad/s and 0.15 m/s² a sample at 100 Hz.
QUIET = {"gyro_noise": 5e-4, "accel_noise": 0.015, "gyro_turn_on": 0.0, "accel_turn_on": 0.0}


@cache
def flight(
    *faults: str, seed: int = 51000, wind: float = 0.0, duration: float = 60.0, mission: str = "lissajous", quiet: bool = False
) -> FlightLog:
    imu = {"rate": 500.0, **(QUIET if quiet else {})}
    return simulate(
        Scenario(
            mission=mission, duration=duration, seed=seed, wind={"n": wind, "e": 0.5 * wind} if wind else {}, scale=0.6, fault=faults,
            sensors={"imu": imu, "rotors": {"rate": 100.0}},
        )
    )  # fmt: skip


def run(log: FlightLog, scored: bool = False, preset: str = "default", **keys: Any) -> Any:
    keys = {k.replace("__", "."): v for k, v in keys.items()}
    return haltere.run(log, "fault-tolerant", preset=preset, set=keys, vehicle=DATA / "hummingbird_identified.toml", scored=scored)


def as_corrected(log: FlightLog) -> Any:
    keys = {"noise.gyro": 5e-4, "noise.accel": 0.015}
    return haltere.run(log, "fault-tolerant", preset="as-corrected", set=keys, vehicle=DATA / "hummingbird_quiet.toml", scored=False)


def verdicts(s: Any) -> list[dict[str, Any]]:
    return [e for e in s.events if e["kind"] in VERDICTS]


def errors(s: Any, log: FlightLog, start: float, end: float) -> tuple[float, float]:
    """RMS of tilt and of heading [deg]."""
    use = (s.t >= start) & (s.t <= end)
    truth = log["truth"]
    k = np.searchsorted(truth.t, s.t[use]).clip(0, len(truth.t) - 1)

    def parts(q: Any) -> tuple[Any, Any]:
        w, x, y, z = q.T
        down = np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])
        return down, np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)

    (a, u), (b, v) = parts(s.vector("q", "wxyz")[use]), parts(np.column_stack([truth[f"q_{c}"] for c in "wxyz"])[k])
    tilt, turn = np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0)), np.angle(np.exp(1j * (u - v)))
    return float(np.degrees(np.sqrt(np.mean(tilt**2)))), float(np.degrees(np.sqrt(np.mean(turn**2))))


@pytest.mark.parametrize(
    ("word", "said"),
    [  # theory.md §5.4(b): a force alarms J11 or J12 alone, whichever of model and accelerometer it is
        ("accel.y:bias=0.8m/s2", [["accel.y", "model.hy"]]),
        ("model.hy:bias=0.8m/s2", [["accel.y", "model.hy"]]),
        ("gyro.z:bias=6deg/s", [["gyro.z"]]),
        ("gnss.n:bias=1.5m/s", [["gnss.velocity"]]),
        ("magnetometer:disturb=0.35", [["magnetometer"]]),
    ],
)
def test_as_corrected_says_what_snapshots_can_tell(word: str, said: list[list[str]]) -> None:
    s = as_corrected(flight(f"{word}@25", seed=50001, duration=45.0, quiet=True))
    found = [e for e in verdicts(s) if e["t_detected"] < 32.0]
    assert [sorted(e["candidates"]) for e in found][:1] == said
    assert 25.0 <= found[0]["t_detected"] < 27.0
    assert (found[0]["t_isolated"] is None) == (len(said[0]) > 1)
    assert np.isfinite(s.vector("q", "wxyz")).all()


def test_as_corrected_hears_a_gyro_late_and_an_accelerometer_never_by_gnss() -> None:
    """theory.md §5.4(b): gyro x and y of 3 deg/s show at J32 after seconds, and 0.8 m/s² of the accelerometer's not at all in five."""
    s = as_corrected(flight("gyro.x:bias=3deg/s@25", seed=50000, duration=45.0, quiet=True))
    e = next(e for e in verdicts(s) if "J32" in e["evidence"])
    assert "gyro.x" in e["candidates"] and e["t_detected"] > 26.5
    s = as_corrected(flight("accel.y:bias=0.8m/s2@25", seed=50001, duration=45.0, quiet=True))
    assert not any("J32" in e["evidence"] and e["t_detected"] < 30.0 for e in verdicts(s))


def test_as_corrected_takes_a_wind_for_a_fault() -> None:
    """The source has no wind (theory.md §5.2): its force is an error of the model, or of the accelerometer, to it."""
    s = as_corrected(flight("wind.n:step=4m/s@25", seed=50000, duration=45.0, quiet=True))
    found = [e for e in verdicts(s) if 25.0 <= e["t_detected"] < 26.0]
    assert found and "wind" not in found[0]["candidates"] and found[0]["evidence"].startswith("J1")


@pytest.mark.parametrize(
    ("word", "key", "axes", "which", "factor"),
    [("accel.x:ramp=0.1m/s2/s@25", "exclude.accel", "x@35-60", 0, 2.0), ("gyro.z:ramp=0.3deg/s/s@25", "exclude.gyro", "z@35-60", 1, 2.0)],
)
def test_without_reset_a_fault_stays_in_its_local_filter(word: str, key: str, axes: str, which: int, factor: float) -> None:
    """theory.md §5.6: with resets a fault that is not seen spreads to all filters; without, it goes with its own when that is left out."""
    left: dict[str, float] = {}
    for reset in ("fusion", "none"):
        keys = {"fault_tolerant.isolate": "off", "fault_tolerant.reset": reset, "diagnosis.inertial": "off", key: axes}
        left[reset] = float(
            np.mean([errors(run(log, **keys), log, 35.1, 36.1)[which] for log in (flight(word, seed=51000 + k) for k in (0, 1))])
        )
    assert left["fusion"] > factor * left["none"], left


def test_faults_one_after_another() -> None:
    log = flight("barometer:bias=3m@25-32", "accel.z:bias=0.8m/s2@45", seed=50011, mission="box", wind=4.0)
    s = run(log)
    found = verdicts(s)
    assert {tuple(e["candidates"]) for e in found} == {("barometer",), ("accel.z",)}
    first = next(e for e in found if e["candidates"] == ["accel.z"])
    assert 44.5 < first["t_onset"] < 46.5 and first["t_isolated"] < 48.0
    assert errors(s, log, 50.0, 54.0)[0] < 1.5
    assert any(e["t_recovered"] is not None for e in found if e["candidates"] == ["barometer"])


def test_a_model_that_is_right_again_is_used_again() -> None:
    log = flight("model.q:bias=1.5rad/s2@25-33", seed=50012, mission="box")
    found = verdicts(run(log))
    assert [e["candidates"] for e in found] == [["model.q"]]
    assert 33.0 < found[0]["t_recovered"] < 45.0
    lasting = verdicts(run(flight("model.q:bias=1.5rad/s2@25", seed=50012, mission="box", duration=50.0)))
    assert [e["candidates"] for e in lasting] == [["model.q"]] and lasting[0]["t_recovered"] is None


def test_with_fewer_sensors_it_says_what_it_can() -> None:
    log = flight("gyro.y:bias=3deg/s@25", seed=50000, duration=45.0)
    assert ["gyro.y"] in [e["candidates"] for e in verdicts(run(log.without("barometer")))]
    s = run(log.without("magnetometer"))  # a pair: heading would tell
    assert any("gyro.y" in e["candidates"] for e in verdicts(s))
    clean = flight(seed=50000, duration=45.0)
    for drop in (("magnetometer",), ("gnss",), ("magnetometer", "gnss", "barometer")):
        s = run(clean.without(*drop))
        assert verdicts(s) == [], drop  # what is assumed for want of a sensor is no sensor that fails
        assert np.isfinite(s.vector("q", "wxyz")).all()


def test_what_it_states_of_itself() -> None:
    """Mean NEES a degree of freedom over four flights in wind, by block; and errors of the wind, where there is one."""
    means: dict[str, list[float]] = {}
    for k in range(4):
        s = run(flight(seed=51010 + k, wind=4.0), scored=True)
        for block, row in s.summary["nees"].items():
            means.setdefault(block, []).append(row["mean"])
        wind = s.summary["errors"]["truth"]["wind_n"]
        assert 0.0 < wind["rms"] < 1.0 and 0 < wind["n"] < len(s.t)
    for block in ("attitude", "velocity", "position", "gyro_bias", "accel_bias", "wind"):
        assert 0.1 < np.mean(means[block]) < 2.5, (block, means[block])


def test_landing_in_wind() -> None:
    """What the ground does is no force of the model's: until the rotors stop, the sensors have the say."""
    log = flight(seed=50011, mission="box", wind=4.0)
    assert errors(run(log), log, 55.0, 58.0)[0] < 2.5
