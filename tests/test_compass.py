"""The compass watch and the field of the motors: laws, closed forms, and what a disturbed compass may do to a flight."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import haltere
from haltere import drive
from haltere._jit import as_records
from haltere.aids import compass, interference
from haltere.aids.record import R_DIP, R_DISTURBED, R_NONE, R_STRENGTH
from haltere.drive import run
from haltere.errors import UsageError
from haltere.estimators.base import Estimator
from haltere.estimators.inputs import parameters
from haltere.filter import robust
from haltere.flight.config import resolve
from haltere.flight.log import FlightLog, Stream
from haltere.metrics.errors import error_series
from haltere.simulate import demo_flight
from haltere.strapdown.layout import layout

FloatArray = NDArray[np.float64]
DEG = math.pi / 180.0


# Robust weights


@settings(deadline=None)
@given(st.floats(0.0, 50.0), st.floats(1.0, 3.0), st.floats(3.5, 9.0))
def test_robust_weights_have_three_levels(s: float, k1: float, k2: float) -> None:
    """IGG-III as in theory.md §4.7 (44): one, rising without a jump at k1, dropped from k2 on; Huber is s/k1 for ever."""
    igg = robust.inflate(robust.IGG3, s, k1, k2)
    if s <= k1:
        assert igg == 1.0
    elif s >= k2:
        assert igg == robust.DROPPED
    else:
        assert igg == pytest.approx(min((s / k1) * ((k2 - k1) / (k2 - s)) ** 2, robust.DROPPED))
    assert robust.inflate(robust.HUBER, s, k1, k2) == pytest.approx(max(1.0, s / k1))
    assert robust.inflate(robust.STEP, s, k1, k2) == (1.0 if s <= k1 else robust.STEP_FACTOR if s < k2 else robust.DROPPED)
    assert robust.inflate(robust.PLAIN, s, k1, k2) == (1.0 if s < k2 else robust.DROPPED)
    assert robust.inflate(robust.IGG3, s + 0.01, k1, k2) >= igg


# The watch itself, fed by hand


def hovering(**keys: Any) -> tuple[Any, Any]:
    """State and parameters of a filter that stands still, heading known to a degree, gyro bias to 0.02 deg/s."""
    s = as_records(np.zeros(1, layout(1)))[0]
    s["q"][0], s["field"][:], s["has_field"], s["phase"] = 1.0, (0.0, 60.0 * DEG, 48.0), 1, 2
    s["P"][:] = np.diag(np.r_[np.full(3, (1.0 * DEG) ** 2), np.full(6, 1.0), np.full(3, (0.02 * DEG) ** 2), np.full(3, 0.01), 1.0])
    prm = parameters(resolve("navigator", overrides=keys))[0]
    compass.forget(s)
    return s, prm


def watch(s: Any, prm: Any, t: FloatArray, e: FloatArray, weight: float = 1.0) -> NDArray[np.int64]:
    """Reasons to refuse samples whose heading innovation is e [rad]; the filter itself does nothing with them."""
    C = tuple(tuple(float(x) for x in row) for row in np.eye(3))
    out = []
    for ti, ei in zip(t, e, strict=True):
        s["t"] = ti
        out.append(compass.observe(s, prm, float(ti), float(ei - s["yaw_corrected"]), weight, True, C))
    return np.array(out)


def test_noise_is_no_disturbance() -> None:
    rng = np.random.default_rng(1)
    s, prm = hovering()
    t = np.arange(0.0, 300.0, 0.02)
    assert (watch(s, prm, t, 3.0 * DEG * rng.standard_normal(len(t))) == R_NONE).all()


@pytest.mark.parametrize("size", [8.0, 15.0, 40.0, -25.0])
def test_a_step_is_found_at_once_and_forgotten_when_it_ends(size: float) -> None:
    rng = np.random.default_rng(2)
    s, prm = hovering()
    t = np.arange(0.0, 60.0, 0.02)
    e = 1.0 * DEG * rng.standard_normal(len(t)) + np.where((t >= 20.0) & (t < 30.0), size * DEG, 0.0)
    out = watch(s, prm, t, e) == R_DISTURBED
    found = float(t[out][0])
    assert 20.0 <= found <= (20.4 if abs(size) > 10.0 else 23.0)
    assert out[(t >= found) & (t < 30.0)].all()
    back = float(t[out][-1])
    assert 30.0 + compass.AGREED < back < 30.0 + compass.AGREED + 4.0 * compass.SLOW
    assert not out[t < 20.0].any()
    assert s["event"][0]["onset"] == pytest.approx(20.0, abs=0.3)


@pytest.mark.parametrize("rate", [1.0, 1.5, 4.0])
def test_a_ramp_is_found_while_it_is_small_and_stays_out(rate: float) -> None:
    """No single innovation says anything: each is within three of its sigmas when the ramp is found."""
    rng = np.random.default_rng(3)
    s, prm = hovering()
    t = np.arange(0.0, 60.0, 0.02)
    ramp = np.clip(t - 20.0, 0.0, 25.0) * rate
    out = watch(s, prm, t, (ramp + 1.0 * rng.standard_normal(len(t))) * DEG) == R_DISTURBED
    assert not out[t < 20.0].any()
    first = int(np.argmax(out))
    assert out.any()
    assert ramp[first] < 10.0
    if rate < 90.0 / 25.0:
        assert out[first:].all()


def test_a_turn_of_the_compass_beyond_any_disturbance_is_the_gyros() -> None:
    s, prm = hovering()
    t = np.arange(0.0, 60.0, 0.02)
    before = float(s["P"][2, 2])
    out = watch(s, prm, t, np.clip(t - 20.0, 0.0, None) * 6.0 * DEG) == R_DISTURBED
    assert out.any()
    again = float(t[out][-1])
    assert 20.0 + 15.0 <= again <= 20.0 + 15.0 + 4.0  # ninety degrees at six a second
    assert float(s["P"][2, 2]) > before + (50.0 * DEG) ** 2


def test_calibration_error_is_allowed_in_a_turn_and_not_in_hover() -> None:
    """A hard iron of 10 % of the field turns the heading by 11 deg between north and south: fine while the vehicle turns."""
    for turning in (True, False):
        s, prm = hovering()
        t = np.arange(0.0, 60.0, 0.02)
        yaw = 0.5 * np.clip(t - 20.0, 0.0, None) if turning else np.zeros(len(t))
        error = math.asin(0.2) * np.sin(0.5 * np.clip(t - 20.0, 0.0, None))
        C = np.eye(3)
        out = []
        for ti, psi, e in zip(t, yaw, error, strict=True):
            s["q"][:] = math.cos(0.5 * psi), 0.0, 0.0, math.sin(0.5 * psi)
            s["t"], s["w"][2] = ti, 0.5 if turning and ti > 20.0 else 0.0
            C = Rotation.from_rotvec([0.0, 0.0, psi]).as_matrix()
            out.append(compass.observe(s, prm, float(ti), float(e - s["yaw_corrected"]), 1.0, True, tuple(tuple(map(float, r)) for r in C)))
        assert bool((np.array(out) == R_DISTURBED).any()) is not turning


def test_what_the_compass_did_is_taken_back() -> None:
    """A filter that follows its compass through a ramp ends where one stands that never heard it: in yaw and in gyro bias."""
    s, prm = hovering()
    t = np.arange(0.0, 40.0, 0.02)
    true = np.clip(t - 20.0, 0.0, None) * 1.5 * DEG
    yaw = bias = 0.0
    C = tuple(tuple(float(x) for x in row) for row in np.eye(3))
    for ti, disturbed in zip(t, true, strict=True):
        s["t"] = ti
        yaw -= float(s["bg"][2]) * 0.02  # a still vehicle and a true bias of zero
        s["q"][:] = math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)
        e = disturbed - yaw
        was, was_bias = float(s["yaw_corrected"]), float(s["bg"][2])
        before = yaw
        if compass.observe(s, prm, float(ti), float(e), 1.0, True, C) == R_DISTURBED:
            yaw = before + float(s["yaw_corrected"]) - was
            bias = float(s["bg"][2])
            break
        s["yaw_corrected"] += 0.002 * e
        s["bg"][2] -= 0.0002 * e
        yaw += 0.002 * e
        compass.attribute(s, was, was_bias)
    assert ti > 20.0
    assert abs(before) > 0.3 * DEG  # it had been pulled
    assert abs(yaw) < 0.1 * abs(before)
    assert abs(bias) < 0.1 * abs(was_bias)


def test_weights_of_strength_and_dip() -> None:
    s, prm = hovering()
    assert compass.level(s, prm, 48.0, 1.0, 0.02) == (1.0, R_NONE)  # the first sample is the reference
    for change, reason in ((0.05, R_NONE), (0.12, R_NONE), (0.25, R_STRENGTH)):
        weight, why = compass.level(s, prm, 48.0 * (1.0 + change), 1.0, 0.0)
        assert why == reason
        want = robust.inflate(robust.IGG3, change / 0.04, compass.SOFT, compass.HARD_LIMIT)
        assert weight == pytest.approx(0.0 if reason else 1.0 / want, rel=1e-9)
    assert compass.level(s, prm, 48.0, 1.0 + 16.0 * DEG, 0.0)[1] == R_DIP
    for _ in range(10_000):  # a field that has changed for good is the field after a while
        compass.level(s, prm, 50.0, 1.0, 0.02)
    assert float(s["compass"]["strength"]) == pytest.approx(50.0, rel=1e-3)


# Flights


def disturbed(flight: FlightLog, share: Callable[[FloatArray], FloatArray]) -> FlightLog:
    """A flight with a fraction of the field added towards east, ``share`` of the time."""
    truth, mag = flight["truth"], flight["magnetometer"]
    q = np.column_stack([np.interp(mag.t, truth.t, truth[f"q_{k}"]) for k in "wxyz"])
    size = float(np.median(np.linalg.norm(mag.vector("mag"), axis=1)))
    east = Rotation.from_quat(q[:, [1, 2, 3, 0]]).inv().apply([0.0, 1.0, 0.0])
    m = mag.vector("mag") + size * share(mag.t)[:, None] * east
    columns = dict(mag.columns) | {f"mag_{a}": m[:, k] for k, a in enumerate("xyz")}
    return FlightLog({**flight.streams, "magnetometer": Stream(columns)}, flight.meta)


def hover(seed: int, **sensors: Any) -> FlightLog:
    return haltere.simulate(
        haltere.Scenario(
            vehicle="hummingbird", mission="hover", duration=70.0, seed=seed, wind={"n": 3.0, "gust": 0.5},
            sensors={"imu": {"rate": 250.0}, **sensors},
        )
    )  # fmt: skip


def errors(solution: haltere.Solution, flight: FlightLog, start: float, end: float) -> dict[str, float]:
    """Largest yaw and tilt error [deg] within a time."""
    series = error_series(solution, flight["truth"])
    out = {}
    for name in ("roll", "pitch", "yaw"):
        t, e = series[name]
        out[name] = float(np.degrees(np.abs(e[(t >= start) & (t < end)])).max())
    return out


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_hover_through_a_disturbance(seed: int) -> None:
    """A quarter of the field for ten seconds, and a ramp to 0.4 of it in 25 s: the heading stays where it was without them."""
    flight = hover(seed)
    plain = run(flight)
    before = errors(plain, flight, 30.0, 65.0)
    step = disturbed(flight, lambda t: np.where((t >= 30.0) & (t < 40.0), 0.25, 0.0))
    solution = run(step)
    worst = errors(solution, step, 30.0, 65.0)
    assert worst["yaw"] - before["yaw"] < 1.5
    for axis in ("roll", "pitch"):  # what tilt is off by is the accelerometer's bias, with or without a disturbance
        assert abs(worst[axis] - before[axis]) < 0.05
    (found,) = [e for e in solution.events if e["kind"] == "disturb"]
    assert found["t_onset"] == pytest.approx(30.0, abs=0.3)
    assert found["t_detected"] < 30.5
    assert 40.0 < found["t_recovered"] < 50.0
    assert found["candidates"][0] == "magnetometer"
    ramp = disturbed(flight, lambda t: 0.4 * np.clip((t - 30.0) / 25.0, 0.0, 1.0))
    solution = run(ramp)
    assert errors(solution, ramp, 30.0, 65.0)["yaw"] < 5.0
    assert errors(run(ramp, set={"aid.compass_watch": "off"}), ramp, 30.0, 65.0)["yaw"] > 5.0  # it takes the watch


@pytest.mark.parametrize("seed", range(500, 504))
def test_a_compass_disturbed_on_the_ground_alone_is_found_right_in_flight(seed: int) -> None:
    """Aligned 37 deg wrong beside a magnet, which is gone at 8 s: GNSS velocity turns the heading, and the compass is heard again."""
    flight = disturbed(demo_flight(seed, 60.0, imu_rate=100.0), lambda t: np.where(t < 8.0, 0.35, 0.0))
    solution = run(flight)
    assert errors(solution, flight, 2.0, 7.0)["yaw"] > 30.0  # it could not know
    assert errors(solution, flight, 45.0, 60.0)["yaw"] < 3.0
    magnetometer = [e["kind"] for e in solution.events if e["sensor"] == "magnetometer"]
    assert magnetometer[0] == "disturb"
    assert magnetometer[-1] == "recovered"


def test_robust_handling_costs_nothing_on_clean_flights() -> None:
    """Less than 5 % of accuracy against the same filter with the tests off, and no alarm in 20 flights."""
    off = {"aid.compass_watch": "off", "robust.innovation": 1e9, "gate.magnetometer": 1e9, "aid.motor_field": "off"}
    squares = {"on": 0.0, "off": 0.0}
    for seed in range(20):
        flight = demo_flight(300 + seed, 60.0, imu_rate=100.0)
        for name, keys in (("on", {}), ("off", off)):
            solution = run(flight, set=keys)
            assert not [e for e in solution.events if e["kind"] == "disturb"], seed
            t, e = error_series(solution, flight["truth"])["yaw"]
            squares[name] += float(np.mean(e[t > 10.0] ** 2))
    assert math.sqrt(squares["on"] / squares["off"]) < 1.05


# The offset of the magnetometer as slow states


def test_an_offset_is_found_in_flight() -> None:
    """Hard iron of 5 uT an axis, 20 flights: found within the stated uncertainty, and the compass is heard where else it is put out."""
    heard = {"on": 0.0, "off": 0.0}
    z = []
    for seed in range(20):
        flight = haltere.simulate(
            haltere.Scenario(
                vehicle="hummingbird", mission="tour", duration=90.0, seed=seed, wind={"n": 3.0, "gust": 1.0},
                sensors={"imu": {"rate": 125.0}, "magnetometer": {"hard_iron": 5.0}},
            )
        )  # fmt: skip
        mag, truth = flight["magnetometer"], flight["truth"]
        true = np.array([np.mean(mag[f"mag_{a}"] - np.interp(mag.t, truth.t, truth[f"field_{a}"])) for a in "xyz"])
        for word in heard:
            solution = run(flight, set={"magnetometer.refine": word})
            heard[word] += float(np.mean(solution.aids["status"][solution.aids["sensor"] == "magnetometer"] != "rejected")) / 20.0
            if word == "on":
                found, sd = (np.array([solution[f"{n}_{a}"][-1] for a in "xyz"]) for n in ("mag_offset", "sd_mag_offset"))
                z.append((found - true) / sd)
            else:
                assert "mag_offset_x" not in solution.table
    assert np.abs(z).max() < 3.0
    assert heard["on"] > 0.95
    assert heard["off"] < heard["on"] - 0.1


def test_an_offset_leaves_tilt_alone() -> None:
    """Roll and pitch of a run that estimates the offset are those of one without a compass, in flight with GNSS."""
    flight = demo_flight(21, 40.0, imu_rate=100.0)
    refined, deaf = run(flight, set={"magnetometer.refine": "on"}), run(flight, set={"aid.magnetometer": "off"})
    series = {name: error_series(s, flight["truth"]) for name, s in (("refined", refined), ("deaf", deaf))}
    for axis in ("roll", "pitch"):
        a, b = (series[n][axis][1][-500:] for n in ("refined", "deaf"))
        assert float(np.degrees(np.abs(a - b)).max()) < 0.3


def test_what_cannot_be_smoothed_yet_is_refused() -> None:
    with pytest.raises(UsageError, match=r"magnetometer\.refine"):
        run(demo_flight(1, 30.0, imu_rate=50.0), set={"magnetometer.refine": "on"}, smooth=True)


# The field of the motors


def motors(monkeypatch: pytest.MonkeyPatch, flight: FlightLog, **keys: Any) -> tuple[haltere.Solution, Any]:
    """A run and what its filter knew of the motors' field at the end."""
    kept: list[Any] = []
    table = drive._table

    def spy(rows: Any, S: Any, position: bool) -> Any:
        kept.append(S["motors"][0].copy())
        return table(rows, S, position)

    monkeypatch.setattr(drive, "_table", spy)
    solution = run(flight, set={k.replace("__", "."): v for k, v in keys.items()})
    return solution, kept[0]


@pytest.mark.parametrize("size", [0.25, 1.0])
def test_the_motors_field_is_found_from_the_current(monkeypatch: pytest.MonkeyPatch, size: float) -> None:
    """uT per ampere within four of its sigmas; the compass is heard again, where without it it stays out."""
    flight = haltere.simulate(
        haltere.Scenario(
            vehicle="iris", mission="tour", duration=100.0, seed=8, wind={"n": 3.0, "gust": 1.0},
            sensors={"imu": {"rate": 250.0}, "magnetometer": {"current": size}},
        )
    )  # fmt: skip
    solution, known = motors(monkeypatch, flight)
    assert known["used"] == 1
    assert float(np.linalg.norm(known["k"])) == pytest.approx(size, abs=4.0 * float(known["sd"]))
    refused = float(np.mean(solution.aids["status"][solution.aids["sensor"] == "magnetometer"] == "rejected"))
    without, unknown = motors(monkeypatch, flight, aid__motor_field="off")
    assert unknown["used"] == 0
    assert refused < 0.3 < float(np.mean(without.aids["status"][without.aids["sensor"] == "magnetometer"] == "rejected"))


def test_no_motors_field_is_found_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(4):
        _, known = motors(monkeypatch, hover(40 + seed))
        assert known["used"] == 0
        assert float(np.linalg.norm(known["k"])) < 5.0 * float(known["sd"])
    _, known = motors(monkeypatch, hover(40).without("power"))
    assert (known["used"], float(known["sxx"])) == (0, 0.0)


def test_cleaning_is_the_regression_turned_round() -> None:
    """With k found from exact data, what is left is the field at the current of alignment."""
    s, prm = hovering()
    s["t"] = 0.0
    interference.forget(s)
    k = np.array([0.3, -0.2, 0.5])
    C, h = np.eye(3), np.array([24.0, 0.0, 41.6])
    rng = np.random.default_rng(4)
    current = 10.0
    for i in range(4000):
        t = 0.02 * (i + 1)
        if i % 5 == 0:
            current = 10.0 if i == 0 else 10.0 + 8.0 * float(rng.random())
        interference.hear(s, t, current)
        interference.learn(s, prm, t, tuple(h + k * current), tuple(h), tuple(tuple(map(float, r)) for r in C))  # type: ignore[arg-type]
    assert s["motors"]["used"] == 1
    np.testing.assert_allclose(s["motors"]["k"], k, rtol=1e-9)
    np.testing.assert_allclose(interference.cleaned(s, tuple(h + k * current)), h + 10.0 * k, rtol=1e-9)  # type: ignore[arg-type]


def test_online_is_offline_with_current_and_disturbance() -> None:
    flight = disturbed(hover(5, magnetometer={"current": 0.3}), lambda t: np.where((t >= 40.0) & (t < 50.0), 0.3, 0.0))
    solution = run(flight)
    est = Estimator("navigator", solution.config)
    imu, rows = flight["imu"], []
    offers = sorted(
        (float(t), rank, name, i)
        for rank, name in enumerate(("gnss", "barometer", "magnetometer", "power"))
        for i, t in enumerate(flight[name].t)
    )
    j = 0
    for i, t in enumerate(imu.t):
        while j < len(offers) and offers[j][0] <= t:
            stamp, _, name, k = offers[j]
            est.offer(name, stamp, {c: float(v[k]) for c, v in flight[name].columns.items() if c != "t"})
            j += 1
        state = est.step(float(t), imu.vector("gyro")[i], imu.vector("accel")[i])
        rows.append((state.t, *state.q_nb) if state.aligned else (math.nan,) * 5)
    est.finish()
    rows.append((est.state.t, *est.state.q_nb))
    q = np.column_stack([solution[f"q_{a}"] for a in "wxyz"])
    np.testing.assert_array_equal(rows[-1][1:], q[-1])
    known = {round(r[0], 9): r[1:] for r in rows if r[0] == r[0]}
    for t, want in zip(solution.t[::500], q[::500], strict=True):
        if (key := round(float(t), 9)) in known:
            np.testing.assert_array_equal(known[key], want)


def test_a_field_that_was_wrong_and_is_right_again_is_heard_again() -> None:
    """Strength off by half for ten seconds: out for the field, back five seconds after it ends, with a degree of noise."""
    rng = np.random.default_rng(6)
    s, prm = hovering()
    t = np.arange(0.0, 60.0, 0.02)
    C = tuple(tuple(float(x) for x in row) for row in np.eye(3))
    out = []
    for ti in t:
        s["t"] = ti
        e = 1.0 * DEG * rng.standard_normal()
        out.append(compass.observe(s, prm, float(ti), float(e - s["yaw_corrected"]), 0.0 if 20.0 <= ti < 30.0 else 1.0, True, C))
    refused = np.array(out) == R_DISTURBED
    assert refused[(t > 20.5) & (t < 34.9)].all()
    assert not refused[t < 20.0].any()
    assert not refused[t > 40.0].any()


def test_a_field_that_has_changed_for_good_is_believed_some_day() -> None:
    """Thirty per cent stronger from 20 s on, heading right: out at once, heard again within four minutes and not within ten seconds."""
    s, prm = hovering()
    C = tuple(tuple(float(x) for x in row) for row in np.eye(3))
    back = math.inf
    for ti in np.arange(0.0, 260.0, 0.02):
        s["t"] = ti
        weight, _ = compass.level(s, prm, 48.0 if ti < 20.0 else 62.4, 60.0 * DEG, 0.02)
        reason = compass.observe(s, prm, float(ti), float(-s["yaw_corrected"]), weight, True, C)
        if ti > 21.0 and reason == R_NONE:
            back = float(ti)
            break
    assert 30.0 < back < 260.0
