"""The same flight through several solutions: measures in closed form, the same rows for all, peers in their frames, words that hold."""

from __future__ import annotations

import csv
import html
import itertools
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haltere import cli
from haltere.errors import HaltereError, UsageError
from haltere.evaluate import compare as module
from haltere.evaluate import peers as peers_
from haltere.evaluate.choice import choices, peers_named
from haltere.evaluate.compare import compare
from haltere.evaluate.conclusions import conclusions, ranked
from haltere.evaluate.peers import PEERS, Peer, Samples, estimate
from haltere.flight.folder import write_folder
from haltere.flight.log import FlightLog, Stream
from haltere.metrics.attitude import conjugate, euler, heading_between, multiply, tilt_between
from haltere.metrics.comparison import Comparison, Track, common_rows, errors, pair, scores, track_of
from haltere.report.comparison import comparison_page
from haltere.simulate import demo_flight

DEG = math.pi / 180.0
Array = np.ndarray[Any, np.dtype[np.float64]]


def turn(axis: str, angle: float) -> Array:
    """Quaternion of a turn about an axis."""
    q = np.zeros(4)
    q[0], q["wxyz".index(axis)] = math.cos(0.5 * angle), math.sin(0.5 * angle)
    return q


def wandering(t: Array, seed: int = 1) -> Array:
    """Attitudes that wander smoothly through large angles, pitch kept away from the poles."""
    rng = np.random.default_rng(seed)
    roll, pitch, yaw = (
        a * np.sin(w * t + p) for a, w, p in zip((0.7, 0.6, 3.0), rng.uniform(0.3, 0.8, 3), rng.uniform(0.0, 6.0, 3), strict=True)
    )
    half = [np.stack([np.cos(0.5 * x), np.sin(0.5 * x)]) for x in (roll, pitch, yaw)]
    z = np.zeros_like(t)
    q: Array = multiply(
        multiply(np.column_stack([half[2][0], z, z, half[2][1]]), np.column_stack([half[1][0], z, half[1][1], z])),
        np.column_stack([half[0][0], half[0][1], z, z]),
    )
    return q


# --- measures ------------------------------------------------------------------------------------------------------------


def test_a_turn_about_the_vertical_is_heading_and_no_tilt() -> None:
    t = np.arange(0.0, 20.0, 0.05)
    q = wandering(t)
    for angle in (0.3, -0.3, 3.0, -3.0):
        turned = multiply(turn("z", angle), q)
        np.testing.assert_allclose(tilt_between(turned, q), 0.0, atol=1e-7)
        np.testing.assert_allclose(heading_between(turned, q), angle, atol=1e-12)
        np.testing.assert_allclose(heading_between(-turned, q), angle, atol=1e-12)


def test_a_turn_about_a_level_axis_is_tilt_and_no_heading() -> None:
    q = wandering(np.arange(0.0, 20.0, 0.05))
    for axis in "xy":
        turned = multiply(turn(axis, -0.2), q)
        np.testing.assert_allclose(tilt_between(turned, q), 0.2, atol=1e-12)
        np.testing.assert_allclose(heading_between(turned, q), 0.0, atol=1e-12)


def test_tilt_is_the_angle_between_the_verticals() -> None:
    """The same from rotation matrices: down, seen from the body by each."""
    a, b = wandering(np.arange(0.0, 20.0, 0.1), 1), wandering(np.arange(0.0, 20.0, 0.1), 2)

    def down(q: Array) -> Array:
        w, x, y, z = q.T
        return np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])

    angle = np.arccos(np.clip(np.sum(down(a) * down(b), axis=1), -1.0, 1.0))
    np.testing.assert_allclose(tilt_between(a, b), angle, atol=1e-7)


def known(rate: float = 50.0, duration: float = 40.0) -> Track:
    t = np.arange(0.0, duration, 1.0 / rate)
    return Track("truth", t, wandering(t), np.column_stack([np.sin(t), np.cos(t), 0.1 * t]), np.column_stack([t, -t, 0.0 * t]))


def off(track: Track, name: str = "stub", *, body: Array | None = None, nav: Array | None = None, vel: float = 0.0) -> Track:
    """A track with constant errors: turned in the body or navigation frame, faster to the north."""
    q = track.q if body is None else multiply(track.q, body)
    q = q if nav is None else multiply(nav, q)
    v = None if track.vel is None else track.vel + np.array([vel, 0.0, 0.0])
    return Track(name, track.t, q, v, track.pos)


def test_constant_errors_are_scored_exactly() -> None:
    truth = known()
    s = scores(errors(off(truth, body=turn("y", 5.0 * DEG), vel=0.4), truth, truth.t))
    assert s["attitude_deg"]["rms"] == pytest.approx(5.0, abs=1e-9)
    assert s["attitude_deg"]["max"] == pytest.approx(5.0, abs=1e-9)
    assert s["vel_n"]["rms"] == pytest.approx(0.4)
    assert s["vel"] == {"rms": pytest.approx(0.4), "max": pytest.approx(0.4), "n": len(truth.t)}
    assert s["vel_e"]["max"] == pytest.approx(0.0, abs=1e-12)
    assert s["pos"]["rms"] == pytest.approx(0.0, abs=1e-12)
    s = scores(errors(off(truth, nav=turn("z", -7.0 * DEG)), truth, truth.t))
    for name, expected in (("attitude", 7.0), ("tilt", 0.0), ("yaw", 7.0), ("roll", 0.0), ("pitch", 0.0)):
        assert s[f"{name}_deg"]["rms"] == pytest.approx(expected, abs=1e-6), name
    assert s["heading_offset_deg"] == pytest.approx(-7.0, abs=1e-9)


def test_rms_and_largest_are_of_the_rows_given() -> None:
    truth = known()
    wrong = off(truth)
    half = len(truth.t) // 2
    wrong.q = wrong.q.copy()
    wrong.q[:half] = multiply(turn("z", 0.1), wrong.q[:half])
    s = scores(errors(wrong, truth, truth.t))
    assert s["attitude_deg"]["rms"] == pytest.approx(0.1 / DEG * math.sqrt(0.5), rel=1e-9)
    assert s["attitude_deg"]["max"] == pytest.approx(0.1 / DEG)
    assert scores(errors(wrong, truth, truth.t[half:]))["attitude_deg"]["max"] == pytest.approx(0.0, abs=1e-6)


def test_turning_everything_about_the_vertical_changes_nothing_but_yaw_s_zero() -> None:
    truth, other = known(), Track("stub", known().t, wandering(known().t, 2))
    plain = scores(errors(other, truth, truth.t))
    g = turn("z", 1.234)
    turned = scores(errors(Track("stub", other.t, multiply(g, other.q)), Track("truth", truth.t, multiply(g, truth.q)), truth.t))
    for name in ("attitude_deg", "tilt_deg", "roll_deg", "pitch_deg", "yaw_deg"):
        assert turned[name] == pytest.approx(plain[name], rel=1e-9), name
    assert turned["heading_offset_deg"] == pytest.approx(plain["heading_offset_deg"])


def test_a_steady_turn_at_another_rate_has_no_error() -> None:
    """Interpolation along the shortest turn is exact for a turn at a constant rate, whatever the two rates."""

    def steady(rate: float) -> tuple[Array, Array]:
        t = np.arange(0.0, 30.0, 1.0 / rate)
        z = np.zeros_like(t)
        return t, multiply(turn("x", 0.4), np.column_stack([np.cos(0.35 * t), z, z, np.sin(0.35 * t)]))

    slow, fast = steady(7.0), steady(91.0)
    truth = Track("truth", *fast)
    rows, _ = common_rows([Track("stub", *slow)], truth.t, 0.0)
    s = scores(errors(Track("stub", *slow), truth, truth.t[rows]))
    assert s["attitude_deg"]["max"] < 1e-6
    assert s["attitude_deg"]["n"] > 2700


def test_rows_without_a_reference_are_skipped() -> None:
    truth = known()
    columns = {"t": truth.t} | {f"q_{a}": truth.q[:, k].copy() for k, a in enumerate("wxyz")}
    columns |= {f"vel_{a}": truth.vel[:, k].copy() for k, a in enumerate("ned")}
    columns["q_x"][100:200] = np.nan
    columns["vel_n"][300:700] = np.nan
    columns["t"] = columns["t"].copy()
    columns["t"][50] = np.nan
    for a in "wxyz":
        columns[f"q_{a}"][60] = 0.0  # no attitude either
    reference = track_of("truth", Stream(columns))
    assert reference is not None
    assert len(reference.t) == len(truth.t) - 102
    s = scores(errors(off(truth, body=turn("x", 0.05), vel=1.0), reference, reference.t))
    assert s["attitude_deg"]["n"] == len(truth.t) - 102
    assert s["attitude_deg"]["rms"] == pytest.approx(0.05 / DEG)
    assert s["vel_n"] == {"rms": pytest.approx(1.0), "max": pytest.approx(1.0), "n": len(truth.t) - 102 - 400}
    assert s["vel_e"]["n"] == len(truth.t) - 102


def test_a_reference_that_goes_back_in_time_is_read_forwards() -> None:
    t = np.array([0.0, 1.0, 0.5, 1.0, 2.0, 3.0])
    track = track_of("truth", Stream({"t": t, "q_w": np.ones(6), "q_x": np.zeros(6), "q_y": np.zeros(6), "q_z": np.zeros(6)}))
    assert track is not None
    assert track.t.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert track.vel is None and track.pos is None
    assert track_of("truth", Stream({"t": t})) is None


# --- the same rows for all -----------------------------------------------------------------------------------------------


def test_all_are_scored_on_the_same_rows_after_the_slowest_has_settled() -> None:
    truth = known(10.0, 100.0)
    early, late = off(truth, "early"), off(truth, "late")
    late = Track("late", late.t[200:], late.q[200:])  # begins at 20 s
    rows, left_out = common_rows([early, late], truth.t, 5.0)
    assert not left_out
    assert truth.t[rows][0] == pytest.approx(25.0)
    assert truth.t[rows][-1] == truth.t[-1]


def test_a_hole_of_one_is_a_hole_for_all() -> None:
    truth = known(10.0, 100.0)
    keep = (truth.t < 40.0) | (truth.t > 50.0)
    holed = Track("holed", truth.t[keep], truth.q[keep])
    rows, left_out = common_rows([off(truth), holed], truth.t, 0.0)
    assert not left_out
    t = truth.t[rows]
    assert not np.any((t > 40.0) & (t < 50.0))
    assert np.count_nonzero(~rows) == 102  # those in it, and the one before it, which has nothing after it


def test_one_that_comes_too_late_does_not_take_the_rows_of_the_others() -> None:
    truth = known(10.0, 100.0)
    late = Track("late", truth.t[900:], truth.q[900:])
    rows, left_out = common_rows([off(truth, "a"), late, off(truth, "b")], truth.t, 5.0)
    assert list(left_out) == ["late"]
    assert "50" in left_out["late"] and "950" in left_out["late"]
    assert np.count_nonzero(rows) == 950
    rows, left_out = common_rows([late], truth.t, 5.0)  # but alone it is scored
    assert not left_out
    assert np.count_nonzero(rows) == 50


def test_pairs_know_what_both_know() -> None:
    truth = known()
    a, b = off(truth, "a", nav=turn("z", 0.2), vel=1.0), off(truth, "b", nav=turn("x", 0.1))
    p = pair(a, b, truth.t)
    assert p["vel"] == pytest.approx(1.0)
    assert p["pos"] == pytest.approx(0.0)
    assert p["tilt_deg"] == pytest.approx(0.1 / DEG)
    # the triangle: no difference exceeds the sum of the errors
    assert p["attitude_deg"] <= (0.1 + 0.2) / DEG + 1e-9
    assert pair(b, a, truth.t)["attitude_deg"] == pytest.approx(p["attitude_deg"])
    blind = replace(b, heading=False, vel=None)
    assert pair(a, blind, truth.t)["attitude_deg"] is None
    assert pair(a, blind, truth.t)["vel"] is None
    assert pair(a, blind, truth.t)["tilt_deg"] == pytest.approx(0.1 / DEG)


# --- a whole comparison, with stubs for peers ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flight() -> FlightLog:
    return demo_flight(seed=3, duration=30.0, imu_rate=100.0)


def stubbed(monkeypatch: pytest.MonkeyPatch, **calls: Callable[..., Any]) -> None:
    """Peers that are functions of the samples; their package is one that is there."""
    made = {name: Peer(name, "numpy", call, smoother=name.startswith("smooth")) for name, call in calls.items()}
    for name in list(PEERS):
        monkeypatch.delitem(PEERS, name)
    for name, peer in made.items():
        monkeypatch.setitem(PEERS, name, peer)


def wrong_by(flight: FlightLog, body: Array) -> Callable[..., Any]:
    """A peer that knows the truth, up to a constant turn, with magnetic north as its north."""
    truth = flight["truth"]
    field = module.configure(flight.without("truth"), module.check(flight.without("truth")), "ahrs").number("field.declination")
    assert abs(field) > 0.02, "a declination that would be seen"
    q = multiply(multiply(turn("z", -field), truth.vector("q", "wxyz")), body)
    return lambda s, heading, told: (s.t, q[np.searchsorted(truth.t, s.t)], ["stub"])


def test_a_peer_with_a_known_error_gets_that_error(flight: FlightLog, monkeypatch: pytest.MonkeyPatch) -> None:
    stubbed(monkeypatch, exact=wrong_by(flight, turn("x", 0.0)), five=wrong_by(flight, turn("y", 5.0 * DEG)))
    c = compare(flight, "ahrs", settle=4.0)
    s = c.summary["solutions"]
    assert c.summary["against"] == "truth"
    assert s["exact"]["errors"]["attitude_deg"]["max"] < 1e-5
    assert s["exact"]["errors"]["heading_offset_deg"] == pytest.approx(0.0, abs=1e-9)
    assert s["five"]["errors"]["attitude_deg"]["rms"] == pytest.approx(5.0, abs=1e-6)
    assert s["five"]["covered"] == pytest.approx(1.0, abs=2e-3)
    assert any("declination" in w for w in s["five"]["done"])
    assert {v["errors"]["attitude_deg"]["n"] for v in s.values()} == {c.summary["rows"]}
    assert c.summary["span"][0] >= 4.0 + max(v["aligned_at"] for v in s.values()) - 1e-9
    assert c.summary["pairs"][-1]["attitude_deg"] == pytest.approx(5.0, abs=1e-6)


def test_a_peer_that_fails_is_a_row_and_not_the_end(flight: FlightLog, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(s: Samples, heading: bool, told: Any) -> Any:
        raise RuntimeError("it did not like this")

    def empty(s: Samples, heading: bool, told: Any) -> Any:
        return s.t, np.full((len(s.t), 4), np.nan), []

    good = wrong_by(flight, turn("x", 0.1))

    def holes(s: Samples, heading: bool, told: Any) -> Any:
        t, q, done = good(s, heading, told)
        q = q.copy()
        q[500:1000] = np.nan
        return t, q, done

    stubbed(monkeypatch, broken=broken, empty=empty, holes=holes, absent=good)
    monkeypatch.setitem(PEERS, "absent", Peer("absent", "no_such_package_here", good))
    c = compare(flight, "ahrs", settle=1.0)
    s = c.summary["solutions"]
    assert "RuntimeError: it did not like this" in s["broken"]["failed"]
    assert "none that is finite" in s["empty"]["failed"]
    assert 'pip install "haltere[peers]"' in s["absent"]["failed"]
    assert "errors" not in s["broken"]
    assert s["holes"]["covered"] == pytest.approx(1.0 - 500 / 3000, abs=0.02)
    assert s["holes"]["errors"]["attitude_deg"]["rms"] == pytest.approx(0.1 / DEG, abs=1e-6)
    words = " ".join(c.summary["conclusions"])
    assert "Gave nothing: broken, empty;" in words
    assert "Not installed: absent;" in words
    comparison_page(c)


def test_what_is_compared_with_is_never_read(flight: FlightLog) -> None:
    """The same attitudes to the last bit when truth and onboard are nonsense."""
    rng = np.random.default_rng(1)
    nonsense = {k: rng.normal(size=len(flight["truth"])) if k != "t" else v for k, v in flight["truth"].columns.items()}
    norm = np.sqrt(sum(nonsense[f"q_{a}"] ** 2 for a in "wxyz"))
    nonsense |= {f"q_{a}": nonsense[f"q_{a}"] / norm for a in "wxyz"}
    other = FlightLog({**flight.streams, "truth": Stream(nonsense), "onboard": Stream(nonsense)}, flight.meta)
    a = {k.name: k for k in compare(flight, "navigator,ahrs", settle=1.0).tracks}
    b = {k.name: k for k in compare(other, "navigator,ahrs", settle=1.0).tracks}
    assert set(b) == {*a, "onboard"}
    for name, track in a.items():
        assert np.array_equal(track.t, b[name].t), name
        assert np.array_equal(track.q, b[name].q), name


def test_our_own_are_scored_as_a_run_scores_them(flight: FlightLog) -> None:
    """Over the rows of a comparison, the figures are those of the errors of a run."""
    from haltere.drive import run
    from haltere.metrics.errors import error_series

    c = compare(flight, "navigator", peers="none", settle=3.0)
    solution = run(flight.without("truth"), "navigator")
    low, high = c.summary["span"]
    mine = c.summary["solutions"]["navigator"]["errors"]
    for name, (t, e) in error_series(solution, flight["truth"]).items():
        if name.startswith(("gyro", "accel", "heading")):
            continue
        e = e[(t >= low - 1e-9) & (t <= high + 1e-9)]
        key, k = (f"{name}_deg", 1.0 / DEG) if name in ("roll", "pitch", "yaw", "attitude", "tilt") else (name, 1.0)
        assert mine[key]["n"] == len(e)
        assert mine[key]["rms"] == pytest.approx(k * math.sqrt(float(np.mean(e * e))), rel=1e-9), name


def onboard_of(flight: FlightLog) -> FlightLog:
    """The flight with its truth, slightly wrong and at 10 Hz, called the autopilot's estimate."""
    truth = flight["truth"].where(slice(0, None, 10))
    q = multiply(truth.vector("q", "wxyz"), turn("x", 2.0 * DEG))
    columns = {"t": truth.t} | {f"q_{a}": q[:, k] for k, a in enumerate("wxyz")} | {f"vel_{a}": truth[f"vel_{a}"] for a in "ned"}
    return FlightLog({**flight.without("truth").streams, "onboard": columns}, flight.meta)


def test_without_truth_nothing_is_ranked_and_the_words_hold(flight: FlightLog, monkeypatch: pytest.MonkeyPatch) -> None:
    stubbed(monkeypatch, ten=wrong_by(flight, turn("x", 12.0 * DEG)))
    c = compare(onboard_of(flight), "navigator", settle=2.0)
    summary = c.summary
    assert summary["against"] == "onboard"
    assert summary["solutions"]["ten"]["errors"]["attitude_deg"]["rms"] == pytest.approx(10.0, abs=0.05)  # onboard is at 10 Hz
    words = " ".join(summary["conclusions"])
    assert "agreement, not accuracy" in words and "No ranking is made" in words
    assert "smallest" not in words + summary["headline"]
    tilts = [p for p in summary["pairs"] if p["tilt_deg"] is not None]
    largest = max(tilts, key=lambda p: p["tilt_deg"])
    assert {largest["a"], largest["b"]} == {"navigator", "ten"}
    assert f"wrong by {0.5 * largest['tilt_deg']:.3g} deg RMS or more" in words
    assert {"onboard"} < {n for p in summary["pairs"] for n in (p["a"], p["b"])}
    assert summary["onboard_gnss"]["vel"]["n"] == summary["solutions"]["navigator"]["gnss"]["vel"]["n"] > 100
    # the receiver's noise is 0.15 m/s an axis, and this onboard has the true velocity
    assert summary["onboard_gnss"]["vel"]["rms"] == pytest.approx(0.15 * math.sqrt(3.0), rel=0.1)
    assert "Difference from GNSS, RMS: velocity navigator" in words


def test_half_the_difference_is_a_true_bound() -> None:
    """Whatever the truth is: the larger of two errors is at least half of the difference, in RMS too."""
    t = known().t
    for seed in range(6):
        a, b, truth = (Track(n, t, wandering(t, 10 * seed + k)) for k, n in enumerate("abc"))
        worst = max(scores(errors(x, truth, t))["attitude_deg"]["rms"] for x in (a, b))
        assert worst >= 0.5 * pair(a, b, t)["attitude_deg"] - 1e-9


def test_with_nothing_to_compare_with_solutions_are_set_against_each_other(flight: FlightLog) -> None:
    c = compare(flight.without("truth"), "navigator,ahrs", peers="none")
    assert c.summary["against"] is None
    assert c.summary["solutions"]["navigator"]["errors"] == {}
    assert c.summary["solutions"]["navigator"]["gnss"]["vel"]["rms"] < 0.5
    assert len(c.summary["pairs"]) == 1
    assert "neither truth nor an estimate" in " ".join(c.summary["conclusions"])
    comparison_page(c)


def test_smoothers_have_no_rank_among_filters(flight: FlightLog, monkeypatch: pytest.MonkeyPatch) -> None:
    stubbed(monkeypatch, smooth=wrong_by(flight, turn("x", 0.0)), plain=wrong_by(flight, turn("x", 0.2)))
    summary = compare(flight, "ahrs", settle=1.0).summary
    assert [n for n, _ in ranked(summary, "attitude_deg")] == ["ahrs", "plain"]
    assert [n for n, _ in ranked(summary, "attitude_deg", smoothers=True)] == ["smooth"]
    assert "smooth" not in summary["headline"]
    assert any("smooth" in s and "is a smoother" in s for s in summary["conclusions"])


def test_solutions_without_gnss_are_named_as_such(flight: FlightLog) -> None:
    words = " ".join(compare(flight, "navigator,ahrs", peers="none").summary["conclusions"])
    assert "navigator had GNSS" in words and "ahrs had not" in words


def test_units_that_a_user_corrects_are_corrected_for_peers_too(flight: FlightLog) -> None:
    degrees = {k: np.degrees(v) if k.startswith("gyro") else v for k, v in flight["imu"].columns.items()}
    other = FlightLog({**flight.streams, "imu": Stream(degrees)}, flight.meta)
    plain = compare(flight, "ahrs", peers="vqf.VQF").summary["solutions"]
    again = compare(other, "ahrs", peers="vqf.VQF", set={"unit.gyro": "deg/s"}).summary["solutions"]
    for name in ("ahrs", "vqf.VQF"):
        assert again[name]["errors"]["tilt_deg"]["rms"] == pytest.approx(plain[name]["errors"]["tilt_deg"]["rms"], rel=1e-6), name


def test_nothing_scored_is_said(flight: FlightLog) -> None:
    c = compare(flight, "ahrs", peers="none", settle=500.0)
    assert c.summary["span"] is None
    assert c.summary["rows"] == 0
    assert "Nothing was scored" in conclusions(c.summary)[0]
    comparison_page(c)


def test_unmeasured_heading_is_not_scored(flight: FlightLog) -> None:
    c = compare(flight.without("magnetometer", "gnss"), "navigator,ahrs")
    for name, s in c.summary["solutions"].items():
        assert "tilt_deg" in s["errors"], name
        assert "attitude_deg" not in s["errors"], name
        assert "yaw_deg" not in s["errors"], name
        assert "vel" not in s["errors"], "without GNSS a velocity is an assumption"
    assert "smallest tilt error" in c.summary["headline"]
    comparison_page(c)


# --- peers, in their frames ----------------------------------------------------------------------------------------------

INSTALLED = [p for p in PEERS.values() if peers_.version(p) is not None]


def turning(rate: Array, *, q0: Array, t: Array, mag_t: Array | None, dip: float = 1.1) -> tuple[Samples, Array]:
    """Perfect sensors of a body that turns about a fixed body axis, without moving, and its attitudes."""

    def attitude(t: Array) -> Array:
        w = float(np.linalg.norm(rate))
        half = 0.5 * w * t
        axis = rate / w if w > 0.0 else np.zeros(3)
        return multiply(q0, np.column_stack([np.cos(half), np.sin(half)[:, None] * axis]))

    def seen(v_n: list[float], q: Array) -> Array:
        v = np.zeros((len(q), 4))
        v[:, 1:] = v_n
        return multiply(multiply(conjugate(q), v), q)[:, 1:]

    q = attitude(t)
    gyro = np.tile(rate, (len(t), 1))
    accel = seen([0.0, 0.0, -9.81], q)
    if mag_t is None:
        return Samples(t, gyro, accel, np.empty(0), np.empty((0, 3))), q
    mag = seen([48.0 * math.cos(dip), 0.0, 48.0 * math.sin(dip)], attitude(mag_t))
    return Samples(t, gyro, accel, mag_t, mag, dip), q


@pytest.mark.parametrize("peer", INSTALLED, ids=lambda p: p.name)
@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (20.0, -35.0, 75.0), (-60.0, 10.0, -160.0)])
def test_a_peer_at_rest_finds_the_attitude_it_is_in(peer: Peer, rpy: tuple[float, float, float]) -> None:
    q0 = multiply(multiply(turn("z", rpy[2] * DEG), turn("y", rpy[1] * DEG)), turn("x", rpy[0] * DEG))
    t = np.arange(0.0, 20.0, 0.01)
    samples, _ = turning(np.zeros(3), q0=q0, t=t, mag_t=t)
    got = estimate(peer, samples)
    assert got.heading
    np.testing.assert_allclose(np.degrees(euler(got.q[-1:]))[0], rpy, atol=0.3)


@pytest.mark.parametrize("peer", INSTALLED, ids=lambda p: p.name)
@pytest.mark.parametrize("log", ["regular", "slow magnetometer", "irregular", "gap"])
def test_a_peer_follows_a_turn_at_the_log_s_own_rate(peer: Peer, log: str) -> None:
    """Half a radian a second for 40 s: sample times wrong by a per cent would show as 11 degrees."""
    t = np.arange(0.0, 40.0, 0.01)
    if log == "irregular":
        rng = np.random.default_rng(1)
        t = np.sort(np.r_[0.0, rng.uniform(0.0, 40.0, 3999)])
        t = t[np.r_[True, np.diff(t) > 1e-4]]
    mag_t = t if log == "regular" else np.arange(0.0, 40.0, 0.02)
    if log == "gap":
        t, mag_t = (x[(x < 15.0) | (x > 22.0)] for x in (t, mag_t))
    samples, q = turning(np.array([0.1, -0.2, 0.45]), q0=turn("y", 0.3), t=t, mag_t=mag_t)
    got = estimate(peer, samples)
    truth = Track("truth", t, q)
    rows, _ = common_rows([Track("peer", got.t, got.q)], t, 4.0)
    rows &= ~((t > 15.0) & (t < 27.0)) if log == "gap" else True
    s = scores(errors(Track("peer", got.t, got.q), truth, t[rows]))
    # held magnetometer samples are late by up to one interval, and the worst of these filters follows slowly
    assert s["attitude_deg"]["rms"] < (2.5 if log == "irregular" else 2.0), s
    if log == "gap":
        assert any("started 2 times" in w for w in got.done)
    if log == "irregular" and peer.package == "vqf":
        assert any("interpolated" in w for w in got.done)


@pytest.mark.parametrize("peer", INSTALLED, ids=lambda p: p.name)
def test_a_peer_without_magnetometer_keeps_its_tilt(peer: Peer) -> None:
    t = np.arange(0.0, 30.0, 0.01)
    samples, q = turning(np.array([0.2, 0.1, 0.3]), q0=turn("x", 0.5), t=t, mag_t=None)
    got = estimate(peer, samples)
    assert not got.heading
    s = scores(errors(Track("peer", got.t, got.q, heading=False), Track("truth", t, q), t[(t > 5.0) & (t < 29.9)]))
    assert s["tilt_deg"]["rms"] < 1.0
    assert "attitude_deg" not in s


@pytest.mark.parametrize("peer", [p for p in INSTALLED if not p.smoother], ids=lambda p: p.name)
def test_a_magnetometer_that_stops_is_not_held_for_ever(peer: Peer) -> None:
    """It turns on without it; a heading that follows the last sample would be lost within seconds."""
    t = np.arange(0.0, 30.0, 0.01)
    samples, q = turning(np.array([0.0, 0.0, 0.5]), q0=turn("x", 0.0), t=t, mag_t=np.arange(0.0, 20.0, 0.02))
    got = estimate(peer, samples)
    s = scores(errors(Track("peer", got.t, got.q), Track("truth", t, q), t[(t > 25.0) & (t < 29.9)]))
    assert s["attitude_deg"]["max"] < 12.0


def test_imufusion_is_left_out_while_it_says_it_is_starting() -> None:
    pytest.importorskip("imufusion")
    t = np.arange(0.0, 10.0, 0.01)
    samples, _ = turning(np.zeros(3), q0=turn("x", 0.2), t=t, mag_t=t)
    assert 1.0 < estimate(PEERS["imufusion.Ahrs"], samples).t[0] < 5.0


# --- words of a user -----------------------------------------------------------------------------------------------------


def test_estimators_with_presets_and_keys() -> None:
    a, b = choices("navigator, ahrs@default:gate.magnetometer=2:noise.gyro=1e-3", {"noise.accel": "0.1"})
    assert (a.name, a.estimator, a.preset, dict(a.keys)) == ("navigator", "navigator", "default", {"noise.accel": "0.1"})
    assert (b.estimator, b.preset) == ("ahrs", "default")
    assert dict(b.keys) == {"noise.accel": "0.1", "gate.magnetometer": "2", "noise.gyro": "1e-3"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("navigater", "did you mean 'navigator'?"),
        ("navigator,navigator", "twice"),
        ("navigator@as-printed", "preset"),
        ("navigator:gate.gnsss=3", "did you mean 'gate.gnss'?"),
        ("navigator:gate.gnss", "key=value"),
        ("vqf.VQF", "it is a peer: --peers vqf.VQF"),
        ("", "at least one"),
    ],
)
def test_wrong_estimators_are_wrong_usage(words: str, said: str) -> None:
    with pytest.raises(UsageError, match=re.escape(said)):
        choices(words)


def test_peers_by_name() -> None:
    assert peers_named("none") == []
    assert [p.name for p in peers_named("ahrs.EKF,vqf.VQF,ahrs.EKF")] == ["ahrs.EKF", "vqf.VQF"]
    for wrong, meant in (("vqf.VFQ", "vqf.VQF"), ("madgwik", "ahrs.Madgwick"), ("imufusion", "imufusion.Ahrs")):
        with pytest.raises(UsageError, match=f"did you mean '{meant}'"):
            peers_named(wrong)


# --- the command line ----------------------------------------------------------------------------------------------------


class Caller:
    """The command line, called in this process: exit status and both streams."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.monkeypatch, self.capsys = monkeypatch, capsys

    def __call__(self, *words: object) -> tuple[int, str, str]:
        self.monkeypatch.setattr(sys, "argv", ["haltere", *map(str, words)])
        status = 0
        try:
            cli.main()
        except SystemExit as left:
            status = left.code if isinstance(left.code, int) else 0 if left.code is None else 1
        shown = self.capsys.readouterr()
        return status, shown.out, shown.err


@pytest.fixture
def haltere(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Caller:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return Caller(monkeypatch, capsys)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, flight: FlightLog) -> Path:
    return write_folder(flight, tmp_path_factory.mktemp("logs") / "short flight")


def test_a_comparison_writes_table_page_and_json(haltere: Caller, log: Path) -> None:
    status, out, _ = haltere("compare", log, "--estimators", "navigator,ahrs:aid.magnetometer=3-axis", "--peers", "vqf.VQF")
    assert status == 0
    folder = Path("short flight.haltere-compare")
    assert {p.name for p in folder.iterdir()} == {"compare.json", "compare.csv", "compare.html"}
    for line in ("navigator", "ahrs:aid.magnetometer=3-axis", "error against truth, RMS (largest):", "compare.html"):
        assert line in out
    assert "…" not in out, "a table that is cut says nothing"
    summary = json.loads((folder / "compare.json").read_text())
    rows = list(csv.DictReader((folder / "compare.csv").read_text().splitlines()))
    assert [r["solution"] for r in rows] == list(summary["solutions"])
    figure = summary["solutions"]["navigator"]["errors"]["tilt_deg"]["rms"]
    assert float(rows[0]["tilt_deg_rms"]) == pytest.approx(figure)
    assert f"{figure:.3g} (" in out


def test_json_alone_goes_to_stdout(haltere: Caller, log: Path) -> None:
    status, out, _ = haltere("compare", log, "--estimators", "ahrs", "--peers", "none", "--json", "--out", "there")
    assert status == 0
    assert json.loads(out) == json.loads(Path("there/compare.json").read_text())


@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        (["--estimators", "navigater"], 2, "did you mean 'navigator'?"),
        (["--peers", "vqf.VFQ"], 2, "did you mean 'vqf.VQF'?"),
        (["--against", "gnss"], 2, "expected truth or onboard, found 'gnss'"),
        (["--set", "gate.gnsss=4"], 2, "did you mean 'gate.gnss'?"),
        (["--settle", "-1"], 2, "zero or more"),
        (["--against", "onboard"], 1, "leave out --against to compare with truth"),
    ],
)
def test_wrong_words_are_one_line(haltere: Caller, log: Path, options: list[str], status: int, said: str) -> None:
    done = haltere("compare", log, *options)
    assert done[0] == status
    assert said in done[2]
    assert done[1] == ""
    assert done[2].count("\n") == 1
    assert not list(Path.cwd().iterdir()), "nothing is written"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, atexit\n"
        "atexit.register(lambda: print([m for m in ('numpy', 'numba', 'polars', 'vqf', 'rich') if m in sys.modules], file=sys.stderr))\n"
        "sys.argv = ['haltere', 'compare', '--help']\n"
        "from haltere.cli import main\n"
        "main()\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stderr.strip() == "[]"
    for option in ("--estimators", "--peers", "--against", "--set", "--settle", "--out", "--json", "--open"):
        assert option in result.stdout


def test_wrong_usage_is_found_before_the_log_is_read(haltere: Caller) -> None:
    assert haltere("compare", "nowhere.ulg", "--estimators", "navigater")[0] == 2
    assert haltere("compare", "nowhere.ulg", "--peers", "vfq")[0] == 2
    assert haltere("compare", "nowhere.ulg")[0] == 1


def test_a_log_that_nothing_runs_on_is_one_error(haltere: Caller, flight: FlightLog) -> None:
    with pytest.raises(HaltereError, match="imu"):
        compare(flight.without("imu"))
    short = FlightLog({k: s.where(s.t < 0.4) for k, s in flight.streams.items()}, flight.meta)
    with pytest.raises(HaltereError, match=r"navigator: .*alignment"):
        compare(short, "navigator", peers="none")


# --- the page ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compared(flight: FlightLog) -> Comparison:
    return compare(flight, "navigator,ahrs")


def test_page_has_what_was_found_and_loads_nothing(compared: Comparison) -> None:
    text = comparison_page(compared, "haltere compare 'my log.bin'")
    for section in ("verdict", "scores", "errors", "attitude", "velocity", "pairs", "consistency", "done"):
        assert f'id="{section}"' in text, section
    own = re.sub(r'<script type="application/octet-stream"[^<]*</script>', "", text)
    assert not re.search(r"https?://|//cdn|@import|url\(|<link|<iframe|<base", own.split("<script>")[0])
    for sentence in compared.summary["conclusions"]:
        assert html.escape(sentence, quote=True) in text
    assert "haltere compare &#x27;my log.bin&#x27;" in text
    assert len(text.encode()) < 5e6


def test_text_of_a_log_is_only_text(compared: Comparison) -> None:
    evil = "</script><script>alert('x')</script>"
    summary = compared.summary | {"name": evil, "headline": evil, "conclusions": [evil]}
    summary["solutions"] = {**summary["solutions"], "ahrs": {**summary["solutions"]["ahrs"], "done": [evil], "maker": evil}}
    shown = comparison_page(replace(compared, summary=summary), evil)
    assert shown.count("<script") == comparison_page(compared).count("<script")


def test_every_solution_has_a_colour_of_its_own(compared: Comparison) -> None:
    from haltere.report.comparison import PEER_COLOURS, _colours
    from haltere.report.style import COLOURS

    assert set(PEER_COLOURS) == set(PEERS)
    mine = _colours(compared.summary)
    drawn = [mine[n] for n in (*compared.summary["solutions"], "truth", "onboard")]
    assert len(set(drawn)) == len(drawn)
    for theme in (0, 1):
        values = {
            c: np.array([int(COLOURS[c][theme][i : i + 2], 16) for i in (1, 3, 5)], float)
            for c in (*drawn, "page", *(f"other{k}" for k in range(1, 4)))
        }
        for (a, x), (b, y) in itertools.combinations(values.items(), 2):
            assert np.linalg.norm(x - y) > 50.0, (theme, a, b)


def test_page_opens_without_script_errors(compared: Comparison, tmp_path: Path) -> None:
    program = next((p for p in ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable") if shutil.which(p)), None)
    if program is None:
        message = "no Chromium to open the page in (Debian: apt install chromium)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    file = tmp_path / "compare.html"
    text = comparison_page(compared)
    file.write_text(text, encoding="utf-8")
    result = subprocess.run(
        [
            program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1300,900",
            "--virtual-time-budget=20000", "--dump-dom", file.as_uri(),
        ],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    head = re.search(r"<html[^>]*>", result.stdout)
    assert head, result.stderr[-2000:]
    data = {k: html.unescape(v) for k, v in re.findall(r'data-([a-z]+)="([^"]*)"', head.group(0))}
    assert data["errors"] == "[]"
    assert "ready" in data
    assert int(data["drawn"]) == text.count("data-figure=")


# --- real recordings -----------------------------------------------------------------------------------------------------


def broad_flight(path: Path) -> tuple[FlightLog, dict[str, Any]]:
    """A BROAD trial as a flight: its reference, while it moves, is the truth."""
    from converters import broad, enu_flu_from_ned_frd

    flight, raw = broad(path)
    q = enu_flu_from_ned_frd(raw["opt_quat"])  # the map is its own inverse
    q[~raw["movement"].astype(bool)] = np.nan
    flight.streams["truth"] = Stream({"t": flight["imu"].t} | {f"q_{a}": q[:, k] for k, a in enumerate("wxyz")})
    return flight, raw


def as_documented(raw: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """The data set's own measure of peers called by hand in its own frames, without anything of ours."""
    import imufusion
    import vqf

    from converters import broad_errors

    rate = float(raw["rate"])
    gyro, accel, mag = (np.ascontiguousarray(raw[k]) for k in ("imu_gyr", "imu_acc", "imu_mag"))
    f = imufusion.Ahrs()
    f.set_settings(imufusion.AhrsSettings(sample_rate=rate))
    q = np.empty((len(gyro), 4))
    for i in range(len(gyro)):
        f.update(np.degrees(gyro[i]), accel[i] / 9.80665, mag[i])
        q[i] = f.get_quaternion()
    return {
        "vqf.VQF": broad_errors(vqf.VQF(1.0 / rate).updateBatch(gyro, accel, mag)["quat9D"], raw),
        "vqf.offlineVQF": broad_errors(vqf.offlineVQF(gyro, accel, mag, 1.0 / rate)["quat9D"], raw),
        "imufusion.Ahrs": broad_errors(multiply(turn("z", 0.5 * math.pi), q), raw),
    }


@pytest.mark.real
def test_peers_on_broad_have_the_figures_of_its_own_measure(shared_data: Path) -> None:
    for package in ("vqf", "imufusion"):
        pytest.importorskip(package)
    flight, raw = broad_flight(shared_data / "broad" / "15_undisturbed_fast_translation_A.mat")
    c = compare(flight, "ahrs", peers="vqf.VQF,vqf.offlineVQF,imufusion.Ahrs", settle=0.0)
    for name, (total, inclination) in as_documented(raw).items():
        e = c.summary["solutions"][name]["errors"]
        assert e["attitude_deg"]["rms"] == pytest.approx(total, abs=0.03), name
        assert e["tilt_deg"]["rms"] == pytest.approx(inclination, abs=0.03), name


#: Total error [deg] of the worst of 30 trials, measured once with the data set's own program; all of them are among the 16 here.
BROAD_WORST = {"vqf.VQF": 7.7, "imufusion.Ahrs": 63.5, "ahrs.Madgwick": 19.9, "ahrs.Mahony": 107.0}
#: Mean over the 30 trials, likewise; half of the 30 are not among the 16.
BROAD_MEAN = {
    "vqf.VQF": 2.43,
    "vqf.offlineVQF": 2.15,
    "imufusion.Ahrs": 11.05,
    "ahrs.Madgwick": 5.26,
    "ahrs.EKF": 7.35,
    "ahrs.Mahony": 30.2,
}


@pytest.mark.real
@pytest.mark.slow
def test_peers_over_all_trials_have_their_known_figures(shared_data: Path) -> None:
    for package in ("vqf", "imufusion", "ahrs"):
        pytest.importorskip(package)
    found: dict[str, list[float]] = {name: [] for name in BROAD_MEAN}
    files = sorted((shared_data / "broad").glob("*.mat"))
    assert len(files) == 16
    for path in files:
        solutions = compare(broad_flight(path)[0], "ahrs", peers=list(BROAD_MEAN), settle=0.0).summary["solutions"]
        for name, figures in found.items():
            figures.append(solutions[name]["errors"]["attitude_deg"]["rms"])
    for name, expected in BROAD_WORST.items():
        assert max(found[name]) == pytest.approx(expected, rel=0.01), name
    for name, expected in BROAD_MEAN.items():
        assert 0.6 * expected < float(np.mean(found[name])) < 1.6 * expected, (name, found[name])


@pytest.mark.real
def test_log_0036_is_compared_without_ranking(shared_data: Path) -> None:
    import haltere as package

    flight = package.read(shared_data / "ardupilot" / "log_0036_mechanical_failure.bin")
    summary = package.compare(flight, "navigator", peers="none").summary
    assert summary["against"] == "onboard"
    assert "No ranking is made" in " ".join(summary["conclusions"])
    e = summary["solutions"]["navigator"]["errors"]
    assert e["tilt_deg"]["rms"] < 3.0
    assert e["vel"]["rms"] < 1.0
    assert summary["solutions"]["navigator"]["gnss"]["vel"]["rms"] < 1.0


@pytest.mark.real
@pytest.mark.parametrize("name", ["sample.ulg", "sample_logging_tagged_and_default_params.ulg"])
def test_px4_logs_are_compared(shared_data: Path, name: str) -> None:
    import haltere as package

    flight = package.read(shared_data / "px4" / name)
    c = package.compare(flight, "navigator,ahrs", peers="vqf.VQF,imufusion.Ahrs", settle=2.0)
    assert c.summary["against"] == ("truth" if "truth" in flight else "onboard")
    assert c.summary["rows"] > 20
    for solution, s in c.summary["solutions"].items():
        assert s["failed"] is None, solution
        assert s["errors"]["tilt_deg"]["rms"] < 6.0, solution
