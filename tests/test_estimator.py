"""The seam of the estimators: online equals offline, states can be saved and resumed, nothing forbidden is read, lateness is honest."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import haltere
from haltere.drive import run
from haltere.errors import HaltereError, UsageError
from haltere.estimators.base import Estimator, State
from haltere.flight.log import FlightLog
from haltere.simulate import demo_flight


@pytest.fixture(scope="module")
def flight() -> FlightLog:
    return demo_flight(3, 40.0)


@pytest.fixture(scope="module")
def offline(flight: FlightLog) -> haltere.Solution:
    return run(flight)


def _messages(flight: FlightLog) -> list[tuple[float, int, str, int]]:
    """All samples in the order in which they arrive: by stamp, measurements before the IMU sample of the same time."""
    order = [("gnss", 0), ("barometer", 1), ("magnetometer", 2), ("imu", 3)]
    return sorted((t, rank, name, i) for name, rank in order if name in flight for i, t in enumerate(flight[name].t))


def _feed(est: Estimator, flight: FlightLog, messages: list[tuple[float, int, str, int]]) -> list[np.ndarray]:
    imu, gyro, accel = flight["imu"], flight["imu"].vector("gyro"), flight["imu"].vector("accel")
    columns = {name: flight[name].columns for name in ("gnss", "barometer", "magnetometer") if name in flight}
    states = []
    before = est.state.t
    for t, _, name, i in messages:
        if name == "imu":
            state = est.step(imu.t[i], gyro[i], accel[i])
            if state.aligned and state.t != before:
                before = state.t
                states.append(np.r_[state.t, state.q_nb, state.vel_n, state.pos_n, state.gyro_bias_b, state.accel_bias_b])
        else:
            est.offer(name, t, {k: float(v[i]) for k, v in columns[name].items()})
    return states


def _rows(solution: haltere.Solution) -> np.ndarray:
    names = ["t", *(f"q_{a}" for a in "wxyz"), *(f"vel_{a}" for a in "ned"), *(f"pos_{a}" for a in "ned")]
    names += [*(f"gyro_bias_{a}" for a in "xyz"), *(f"accel_bias_{a}" for a in "xyz")]
    return np.column_stack([solution[n] for n in names])


@pytest.mark.parametrize("delay", [0.0, 0.23])
def test_online_equals_offline_to_the_last_bit(flight: FlightLog, delay: float) -> None:
    offline = run(flight, set={"delay.gnss": delay})
    est = Estimator("navigator", offline.config)
    states = np.array(_feed(est, flight, _messages(flight)))
    rows = _rows(offline)
    # one step may move the horizon by no sample or by two, so that some rows are never seen online
    assert len(states) > 0.7 * len(rows)
    assert np.array_equal(states, rows[np.searchsorted(rows[:, 0], states[:, 0])])
    last = est.finish()
    assert last.t == flight["imu"].t[-1]
    assert np.array_equal(last.q_nb, _rows(offline)[-1, 1:5])


def test_a_saved_state_resumes_identically(flight: FlightLog) -> None:
    config = run(flight).config
    messages = _messages(flight)
    half = len(messages) // 2
    first, second = Estimator("navigator", config), Estimator("navigator", config)
    _feed(first, flight, messages[:half])
    kept: State = pickle.loads(pickle.dumps(first.state))
    a = _feed(first, flight, messages[half:])
    second.restore(kept)
    b = _feed(second, flight, messages[half:])
    assert len(a) > 1000
    assert np.array_equal(np.array(a), np.array(b))
    assert np.array_equal(first.state.P, second.state.P)


def test_a_snapshot_does_not_change_when_the_filter_goes_on(flight: FlightLog) -> None:
    est = Estimator("navigator", run(flight).config)
    _feed(est, flight, _messages(flight)[:4000])
    kept = est.state
    copy = kept.record.copy()
    _feed(est, flight, _messages(flight)[4000:6000])
    assert kept.record.tobytes() == copy.tobytes()


def test_a_state_of_another_layout_is_refused(flight: FlightLog) -> None:
    with pytest.raises(UsageError, match="same layout"):
        Estimator("navigator").restore(Estimator("ahrs").state)


@pytest.mark.parametrize("estimator", ["navigator", "ahrs"])
def test_no_estimator_reads_what_it_must_not(flight: FlightLog, estimator: str) -> None:
    blind = flight.without("truth", "onboard")
    blind.meta.faults = []
    lied = FlightLog(dict(flight.streams), flight.meta)
    lied.streams["truth"] = flight["truth"].where(slice(None, None, 7))
    lied.streams["truth"].columns["q_w"] = -lied.streams["truth"].columns["q_w"]
    lied.streams["onboard"] = lied.streams["truth"]
    a, b, c = run(flight, estimator), run(blind, estimator), run(lied, estimator)
    for other in (b, c):
        assert list(a.table) == list(other.table)
        for name in a.table:
            assert np.array_equal(a[name], other[name], equal_nan=True), name
        for name in a.aids:
            assert np.array_equal(a.aids[name], other.aids[name]), name


def test_now_predicts_to_the_newest_sample(flight: FlightLog) -> None:
    est = Estimator("navigator", run(flight).config)
    _feed(est, flight, [m for m in _messages(flight) if m[0] <= 25.0])
    now, horizon = est.now(), est.state
    newest = flight["imu"].t[flight["imu"].t <= 25.0][-1]
    assert now["t"] == newest
    assert 0.04 < newest - horizon.t < 0.06  # the margin of the horizon, without delays
    truth = flight["truth"]
    k = np.searchsorted(truth.t, newest)
    at_horizon = np.searchsorted(truth.t, horizon.t)
    lag = np.linalg.norm(truth.vector("pos", "ned")[k] - horizon.pos_n)
    error = np.linalg.norm(truth.vector("pos", "ned")[k] - now["pos_n"])
    own = np.linalg.norm(truth.vector("pos", "ned")[at_horizon] - horizon.pos_n)
    assert error < own + 0.02 < lag + 0.02  # as good as the horizon's own error; the horizon itself lags behind


def test_delayed_gnss_is_fused_when_it_was_valid() -> None:
    """A receiver that stamps 0.2 s late: with the delay configured the solution is as good as without delay, else worse."""
    flight = demo_flight(5, 60.0)
    late = FlightLog(dict(flight.streams), flight.meta)
    columns = dict(flight["gnss"].columns)
    columns["t"] = columns["t"] + 0.2
    late.streams["gnss"] = haltere.Stream(columns)

    def rms(solution: haltere.Solution) -> float:
        return float(np.hypot(solution.summary["errors"]["truth"]["pos_n"]["rms"], solution.summary["errors"]["truth"]["pos_e"]["rms"]))

    good, told, untold = rms(run(flight)), rms(run(late, set={"delay.gnss": 0.2})), rms(run(late))
    assert told < 1.05 * good + 0.01
    assert untold > 3.0 * good


def test_out_of_order_within_the_horizon_changes_nothing(flight: FlightLog) -> None:
    """Measurements that arrive late but within the horizon give the solution of those that arrive in time."""
    config = run(flight, set={"delay.gnss": 0.1}).config
    messages = [m for m in _messages(flight) if m[0] < 20.0]
    held = sorted((t + (0.03 if name == "barometer" else 0.0), rank, name, i) for t, rank, name, i in messages)
    a, b = Estimator("navigator", config), Estimator("navigator", config)
    _feed(a, flight, messages)

    stamps = {(name, i): t for t, _, name, i in messages}
    imu, gyro, accel = flight["imu"], flight["imu"].vector("gyro"), flight["imu"].vector("accel")
    for _, _, name, i in held:
        if name == "imu":
            b.step(imu.t[i], gyro[i], accel[i])
        else:
            b.offer(name, stamps[name, i], {k: float(v[i]) for k, v in flight[name].columns.items()})
    a.finish()
    b.finish()
    assert np.array_equal(a.state.q_nb, b.state.q_nb)
    assert np.array_equal(a.state.pos_n, b.state.pos_n)


def test_too_late_is_discarded_and_counted(flight: FlightLog) -> None:
    est = Estimator("navigator", run(flight).config)
    _feed(est, flight, [m for m in _messages(flight) if m[0] < 10.0])
    before = int(est.state.record["aid"]["n_late"][0, 2])
    assert not est.offer("barometer", 5.0, {"pressure": 95000.0})
    assert int(est.state.record["aid"]["n_late"][0, 2]) == before + 1


@pytest.mark.parametrize(
    ("t", "gyro", "accel"),
    [
        (float("nan"), (0, 0, 0), (0, 0, -9.8)),
        (11.0, (float("inf"), 0, 0), (0, 0, -9.8)),
        (11.0, (0, 0, 0), (0, float("nan"), 0)),
        (3.0, (0, 0, 0), (0, 0, -9.8)),
    ],
)
def test_one_bad_sample_is_left_out(flight: FlightLog, t: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
    messages = [m for m in _messages(flight) if m[0] < 20.0]
    split = next(k for k, m in enumerate(messages) if m[0] > 10.0)
    config = run(flight).config
    a, b = Estimator("navigator", config), Estimator("navigator", config)
    _feed(a, flight, messages)
    _feed(b, flight, messages[:split])
    b.step(t, gyro, accel)
    assert int(b.state.record["n_bad"][0]) == 1
    _feed(b, flight, messages[split:])
    assert np.array_equal(a.state.P, b.state.P)


def test_offer_says_what_is_wrong() -> None:
    est = Estimator("navigator")
    with pytest.raises(UsageError, match="a sensor: gnss"):
        est.offer("lidar", 0.0, (1.0,))
    with pytest.raises(UsageError, match="3 to 3 values"):
        est.offer("magnetometer", 0.0, (1.0,))
    assert not est.offer("magnetometer", 0.0, (float("nan"), 1.0, 1.0))
    assert not est.offer("magnetometer", 0.0, (0.0, 0.0, 0.0))


def test_the_configuration_reproduces_the_run(flight: FlightLog, offline: haltere.Solution, tmp_path) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "config.toml"
    file.write_text(offline.config.to_toml())
    again = run(flight, config=file)
    for name in offline.table:
        assert np.array_equal(offline[name], again[name], equal_nan=True), name


def test_rate_decimates_and_does_not_interpolate(flight: FlightLog, offline: haltere.Solution) -> None:
    slow = run(flight, rate=10.0)
    assert abs(len(slow) - 10.0 * (offline.t[-1] - offline.t[0])) <= 2
    rows = np.searchsorted(offline.t, slow.t)
    assert np.array_equal(offline.t[rows], slow.t)
    assert np.array_equal(offline["q_w"][rows], slow["q_w"])
    with pytest.raises(UsageError, match="positive"):
        run(flight, rate=-1.0)


def test_what_is_not_there_is_said(flight: FlightLog) -> None:
    for option in ({"vehicle": "x.toml"}, {"preset": "as-printed"}):
        with pytest.raises(UsageError):
            run(flight, **option)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"did you mean 'gate\.gnss'"):
        run(flight, set={"gate.gns": 4})


def test_a_long_gap_is_told_and_survived(flight: FlightLog) -> None:
    keep = (flight["imu"].t < 20.0) | (flight["imu"].t > 30.0)
    holed = FlightLog({**flight.streams, "imu": flight["imu"].where(keep)}, flight.meta)
    solution = run(holed)
    assert any(e["kind"] == "gap" for e in solution.events)
    assert any(e["kind"] == "realigned" for e in solution.events)
    assert any("gap" in w for w in solution.summary["warnings"])
    assert not ((solution.t > 20.1) & (solution.t < 30.0)).any()
    assert all(np.isfinite(column).all() for column in solution.table.values())
    # well after realigning in motion it is as good as before
    late = solution.t > 38.0
    error = np.interp(solution.t[late], flight["truth"].t, flight["truth"]["vel_n"]) - solution["vel_n"][late]
    assert np.sqrt(np.mean(error**2)) < 0.5


def test_a_short_gap_is_bridged_with_wider_bounds(flight: FlightLog) -> None:
    keep = (flight["imu"].t < 20.0) | (flight["imu"].t > 20.6)
    solution = run(FlightLog({**flight.streams, "imu": flight["imu"].where(keep)}, flight.meta))
    assert [e["kind"] for e in solution.events if e["kind"] in ("gap", "realigned")] == ["gap"]
    before, after = np.searchsorted(solution.t, [19.99, 20.6])
    assert solution["sd_roll"][after] > 3.0 * solution["sd_roll"][before]


def test_gnss_outage_grows_the_bounds_and_the_truth_stays_inside() -> None:
    flight = demo_flight(8, 80.0)
    gnss = flight["gnss"]
    solution = run(FlightLog({**flight.streams, "gnss": gnss.where((gnss.t < 40.0) | (gnss.t > 60.0))}, flight.meta))
    truth = flight["truth"]
    k = np.searchsorted(solution.t, 59.9)
    assert solution["sd_pos_n"][k] > 5.0 * solution["sd_pos_n"][np.searchsorted(solution.t, 39.9)]
    for axis in "ned":
        error = solution[f"pos_{axis}"][k] - np.interp(solution.t[k], truth.t, truth[f"pos_{axis}"])
        assert abs(error) < 4.0 * solution[f"sd_pos_{axis}"][k]


def test_gnss_jump_is_refused() -> None:
    flight = demo_flight(9, 60.0)
    columns = dict(flight["gnss"].columns)
    jump = (columns["t"] > 30.0) & (columns["t"] < 34.0)
    columns["lat"] = columns["lat"] + np.where(jump, 60.0 / 111000.0, 0.0)
    solution = run(FlightLog({**flight.streams, "gnss": haltere.Stream(columns)}, flight.meta))
    aids = solution.aids
    during = (aids["sensor"] == "gnss") & (aids["component"] == "pos_n") & (aids["t"] > 30.0) & (aids["t"] < 34.0)
    assert (aids["status"][during] == "rejected").all()
    truth = flight["truth"]
    inside = (solution.t > 30.0) & (solution.t < 34.0)
    error = solution["pos_n"][inside] - np.interp(solution.t[inside], truth.t, truth["pos_n"])
    assert np.abs(error).max() < 3.0


def test_divergence_is_said_and_recovered(flight: FlightLog) -> None:
    est = Estimator("navigator", run(flight).config)
    messages = _messages(flight)
    split = next(k for k, m in enumerate(messages) if m[0] > 15.0)
    _feed(est, flight, messages[:split])
    broken = est.state
    broken.record["P"][0, 4, 4] = -1.0  # as after a numerical accident
    est.restore(broken)
    _feed(est, flight, messages[split:])
    codes = [int(c) for c in est.state.record["event"]["code"][0, : int(est.state.record["n_events"][0])]]
    assert 2 in codes and 3 in codes  # diverged, realigned
    truth = flight["truth"]
    k = np.searchsorted(truth.t, est.state.t)
    assert est.state.aligned
    assert np.linalg.norm(est.state.vel_n - truth.vector("vel", "ned")[k]) < 1.0


def test_no_alignment_is_an_error_that_says_why() -> None:
    flight = demo_flight(1, 40.0)
    short = FlightLog({"imu": flight["imu"].where(slice(0, 60))}, flight.meta)
    with pytest.raises(HaltereError, match="alignment"):
        run(short)
