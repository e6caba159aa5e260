"""Detection against injected faults, rates with their intervals, and settling: each against what can be counted by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from haltere.metrics.detection import STATE_CHANGES, alarms, detections, poisson_interval, share_interval
from haltere.metrics.errors import error_series, lengths, settling_time, since
from haltere.simulate.words import parse_fault


def event(t: float, sensor: str = "gyro", axis: str | None = "x", **more: Any) -> dict[str, Any]:
    out = {
        "sensor": sensor, "axis": axis, "kind": "bias", "t_onset": t, "t_detected": t, "t_isolated": None, "t_recovered": None,
        "candidates": [], "statistic": None, "threshold": None, "evidence": "",
    }  # fmt: skip
    return out | more


def fault(word: str) -> dict[str, Any]:
    return parse_fault(word).as_table()


X = fault("gyro.x:bias=3deg/s@60-90")


# --- detected, missed, false ---------------------------------------------------------------------------------------------


def test_the_first_alarm_after_the_start_detects_and_those_before_and_long_after_are_false() -> None:
    events = [event(59.9), event(62.5), event(61.25, statistic=12.0, threshold=4.0), event(94.0), event(95.5, statistic=9.0, threshold=6.0)]
    d = detections(events, [X], 4.0, 120.0, hold=5.0)
    (o,) = d.outcomes
    assert o.detected
    assert o.delay == pytest.approx(1.25)
    assert o.ratio == pytest.approx(3.0)
    assert [e["t_detected"] for e in d.false_alarms] == [59.9, 95.5]
    assert d.false_ratio == pytest.approx(1.5)
    assert d.missed == 0
    assert d.quiet == pytest.approx((60.0 - 4.0) + (120.0 - 95.0))


def test_a_fault_without_an_alarm_is_missed_and_one_outside_the_solution_is_not_counted() -> None:
    later = fault("magnetometer:disturb=0.3@130")
    before = fault("gnss:dropout@1-3")
    d = detections([], [X, later, before], 4.0, 120.0)
    assert (d.missed, d.unseen, len(d.outcomes)) == (1, 2, 1)
    assert math.isnan(d.outcomes[0].delay)
    assert d.outcomes[0].isolation == ""


def test_a_fault_that_lasts_leaves_no_time_without_it() -> None:
    d = detections([event(61.0), event(110.0)], [fault("gyro.x:bias=3deg/s@60")], 10.0, 120.0)
    assert d.quiet == pytest.approx(50.0)
    assert d.false_alarms == ()


def test_overlapping_faults_leave_the_rest_of_the_time() -> None:
    faults = [fault("gyro.x:bias=3deg/s@20-40"), fault("gnss:dropout@30-50"), fault("accel.z:bias=1m/s2@80-90")]
    assert detections([], faults, 0.0, 100.0, hold=0.0).quiet == pytest.approx(20.0 + 30.0 + 10.0)
    assert detections([], faults, 0.0, 100.0, hold=5.0).quiet == pytest.approx(20.0 + 25.0 + 5.0)


@pytest.mark.parametrize("kind", STATE_CHANGES)
def test_changes_of_state_are_no_alarms(kind: str) -> None:
    assert alarms([event(5.0, kind=kind)]) == []


def test_a_fault_that_was_there_before_the_solution_counts_from_its_first_row() -> None:
    (o,) = detections([event(12.0)], [fault("gyro.x:bias=3deg/s@2")], 10.0, 60.0).outcomes
    assert o.delay == pytest.approx(2.0)


# --- isolation -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "more", "isolation", "named"),
    [
        ("gyro.x:bias=1deg/s@60", {"t_isolated": 62.0}, "right", ("gyro.x",)),
        ("gyro.x:bias=1deg/s@60", {"t_isolated": 62.0, "axis": None}, "containing", ("gyro",)),
        ("gyro.x:bias=1deg/s@60", {"t_isolated": 62.0, "axis": "y"}, "wrong", ("gyro.y",)),
        ("gyro.x:bias=1deg/s@60", {"candidates": ["gyro.x"]}, "right", ("gyro.x",)),
        ("gyro.x:bias=1deg/s@60", {"candidates": ["gyro.x", "model.r"]}, "containing", ("gyro.x", "model.r")),
        ("gyro.x:bias=1deg/s@60", {"candidates": ["gyro.y", "model.r"]}, "wrong", ("gyro.y", "model.r")),
        ("gyro.x:bias=1deg/s@60", {}, "none", ()),
        ("gyro:bias=1deg/s@60", {"candidates": ["gyro.x", "gyro.y"]}, "right", ("gyro.x", "gyro.y")),
        ("imu:stuck@60", {"candidates": ["accel.z", "gyro.x"]}, "right", ("accel.z", "gyro.x")),
        ("rotor.2:thrust=0.8@60", {"sensor": "rotors", "axis": "2", "t_isolated": 61.5}, "right", ("rotors.2",)),
        ("magnetometer:disturb=0.3@60", {"sensor": "magnetometer", "axis": None, "t_isolated": 61.5}, "right", ("magnetometer",)),
        ("magnetometer:disturb=0.3@60", {"sensor": "filter", "axis": None, "t_isolated": 61.5}, "none", ()),
    ],
)
def test_isolation(word: str, more: dict[str, Any], isolation: str, named: tuple[str, ...]) -> None:
    (o,) = detections([event(61.0, **more)], [fault(word)], 0.0, 100.0).outcomes
    assert (o.isolation, o.named) == (isolation, named)


def test_isolation_may_come_with_a_later_alarm() -> None:
    (o,) = detections([event(61.0), event(63.0, t_isolated=64.0)], [X], 0.0, 100.0).outcomes
    assert o.delay == pytest.approx(1.0)
    assert o.isolation_delay == pytest.approx(4.0)
    assert o.isolation == "right"


def test_of_two_faults_an_alarm_is_of_the_one_it_names_and_else_of_the_newer() -> None:
    faults = [fault("gyro.x:bias=1deg/s@20"), fault("magnetometer:disturb=0.3@30")]
    named = event(33.0, candidates=["gyro.x"])
    unnamed = event(31.0, "filter", None)
    gyro, magnetometer = detections([named, unnamed], faults, 0.0, 100.0).outcomes
    assert gyro.delay == pytest.approx(13.0)
    assert magnetometer.delay == pytest.approx(1.0)


def test_recovery_counts_from_the_end_or_where_it_lasts_from_the_detection() -> None:
    events = [event(61.0, t_recovered=93.5)]
    assert detections(events, [X], 0.0, 120.0).outcomes[0].recovery == pytest.approx(3.5)
    assert detections(events, [fault("gyro.x:bias=1deg/s@60")], 0.0, 120.0).outcomes[0].recovery == pytest.approx(32.5)
    assert math.isnan(detections([event(61.0)], [X], 0.0, 120.0).outcomes[0].recovery)


# --- intervals -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 3, 40])
@pytest.mark.parametrize("probability", [0.9, 0.95])
def test_the_interval_of_a_rate_is_where_the_count_is_just_not_too_unlikely(n: int, probability: float) -> None:
    low, high = poisson_interval(n, 2.5, probability)
    tail = 0.5 * (1.0 - probability)
    assert stats.poisson.cdf(n, 2.5 * high) == pytest.approx(tail)
    if n:
        assert stats.poisson.sf(n - 1, 2.5 * low) == pytest.approx(tail)
    else:
        assert low == 0.0


def test_known_intervals_of_counts() -> None:
    # Garwood's table: 0 events: 3.69; 10 events: 4.80 to 18.39
    assert poisson_interval(0, 1.0)[1] == pytest.approx(3.689, abs=1e-3)
    assert poisson_interval(10, 1.0) == pytest.approx((4.795, 18.390), abs=1e-3)
    assert math.isnan(poisson_interval(0, 0.0)[0])


@pytest.mark.parametrize(("k", "n"), [(0, 10), (3, 10), (10, 10), (0, 0)])
def test_the_interval_of_a_share(k: int, n: int) -> None:
    low, high = share_interval(k, n)
    if n == 0:
        assert (low, high) == (0.0, 1.0)
        return
    expected = stats.binomtest(k, n).proportion_ci(0.95, method="exact")
    assert (low, high) == pytest.approx((expected.low, expected.high))


# --- settling ------------------------------------------------------------------------------------------------------------

T = np.arange(0.0, 10.0, 0.1)


def test_an_exponential_settles_after_its_logarithm() -> None:
    error = -8.0 * np.exp(-T / 1.5)
    expected = 1.5 * math.log(8.0 / 0.5)
    found = settling_time(T, error, 0.5)
    assert expected <= found < expected + 0.1 + 1e-9


def test_settling_counts_from_its_beginning_and_asks_for_the_rest_of_the_run() -> None:
    error = np.where(T < 2.95, 2.0, 0.1)
    assert settling_time(T, error, 0.5) == pytest.approx(3.0)
    assert settling_time(T, error, 0.5, 1.0) == pytest.approx(2.0)
    assert settling_time(T, error, 0.5, 5.0) == 0.0
    assert settling_time(T, np.where(T > 9.85, 2.0, error), 0.5) != settling_time(T, error, 0.5)
    assert math.isnan(settling_time(T, np.where(T > 9.85, 2.0, error), 0.5))
    assert math.isnan(settling_time(T[:0], T[:0], 0.5))
    late = error.copy()
    late[60] = math.nan
    assert settling_time(T, late, 0.5) == pytest.approx(6.1), "an error that is not known is not within"


def test_errors_of_attitude_by_parts_and_of_wind_by_hand() -> None:
    from haltere.flight.config import Config, defaults
    from haltere.flight.log import Stream
    from haltere.flight.solution import Solution
    from haltere.metrics.attitude import multiply

    n = len(T)

    def about(axis: int, degrees: float) -> np.ndarray[Any, np.dtype[np.float64]]:
        q = np.zeros(4)
        q[0], q[1 + axis] = math.cos(math.radians(degrees) / 2.0), math.sin(math.radians(degrees) / 2.0)
        return q

    truth_q = multiply(about(2, 70.0), about(1, 20.0))
    # 3 degrees about north, then 4 about the vertical, both in the navigation frame
    q = multiply(multiply(about(2, 4.0), about(0, 3.0)), truth_q)
    columns = {"t": T} | {f"q_{a}": np.full(n, truth_q[k]) for k, a in enumerate("wxyz")}
    columns |= {"wind_n": np.full(n, 5.0), "wind_e": np.full(n, -1.0), "wind_d": np.full(n, 0.3)}
    table = {"t": T} | {f"q_{a}": np.full(n, q[k]) for k, a in enumerate("wxyz")}
    table |= {"wind_n": np.full(n, 5.3), "wind_e": np.full(n, -1.4)}
    series = error_series(Solution(table, {}, [], Config("navigator", "default", defaults())), Stream(columns))
    assert np.degrees(series["tilt"][1]) == pytest.approx(3.0)
    assert np.degrees(series["heading"][1]) == pytest.approx(4.0)
    whole = 2.0 * math.degrees(math.acos(math.cos(math.radians(2.0)) * math.cos(math.radians(1.5))))
    assert np.degrees(series["attitude"][1]) == pytest.approx(whole)
    assert series["wind_n"][1] == pytest.approx(0.3)
    assert lengths(series)["wind"][1] == pytest.approx(0.5), "an estimator without vertical wind is not charged with it"


def test_lengths_and_windows_of_errors() -> None:
    three = {f"vel_{a}": (T, k * np.ones(len(T))) for a, k in (("n", 2.0), ("e", 3.0), ("d", 6.0))}
    assert lengths(three)["vel"][1] == pytest.approx(7.0)
    assert "vel" not in lengths({k: v for k, v in three.items() if k != "vel_d"})
    flat = {"wind_n": (T, 3.0 * np.ones(len(T))), "wind_e": (T, 4.0 * np.ones(len(T)))}
    assert lengths(flat)["wind"][1] == pytest.approx(5.0)
    assert len(since(three, 5.0)["vel_n"][0]) == 50
    assert since(three, 50.0) == {}
