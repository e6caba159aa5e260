"""Diagnosis of inertial faults: the bank against twin filters and dense matrices, steps against made samples, faults named in flights."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from haltere._jit import COMPILED
from haltere.diagnosis import inertial, steps
from haltere.drive import run
from haltere.estimators.base import Estimator
from haltere.estimators.inputs import alarm_level, parameters
from haltere.filter import signatures
from haltere.filter.signatures import ACCEL, ACCEL_RAMP, GYRO, GYRO_RAMP, HEADING, N_FAULTS, POSITION, SLOTS, VELOCITY, YAW
from haltere.filter.update import NONE
from haltere.flight.config import resolve
from haltere.flight.log import FlightLog
from haltere.metrics.detection import detections
from haltere.simulate import Scenario, demo_flight, inject, simulate
from haltere.strapdown.layout import layout

FloatArray = NDArray[np.float64]
DEG = math.pi / 180.0
WIND = {"n": 5.2, "e": 3.0, "gust": 1.2}


def column(fault: int, slot: int) -> int:
    return int(fault) * int(SLOTS) + slot


# --- laws of the bank --------------------------------------------------------------------------------------------------------


def fly(flight: FlightLog, until: float, size: FloatArray, onset: float, options: Any) -> Estimator:
    """Online over the flight up to ``until``, with a constant added to gyro (3) and accelerometer (3) after the onset."""
    est = Estimator("navigator", options)
    imu, gnss, mag, baro = (flight[k] for k in ("imu", "gnss", "magnetometer", "barometer"))
    w, f = imu.vector("gyro"), imu.vector("accel")
    queue = sorted(
        [(t, "gnss", dict(zip(("lat", "lon", "alt", "vel_n", "vel_e", "vel_d"), v, strict=True))) for t, v in zip(
            gnss.t, np.column_stack([gnss.get(c) for c in ("lat", "lon", "alt", "vel_n", "vel_e", "vel_d")]), strict=True)]
        + [(t, "magnetometer", v) for t, v in zip(mag.t, mag.vector("mag"), strict=True)]
        + [(t, "barometer", [v]) for t, v in zip(baro.t, baro.get("pressure"), strict=True)],
        key=lambda q: q[0],
    )  # fmt: skip
    j = 0
    for i in range(len(imu.t)):
        if imu.t[i] > until:
            break
        while j < len(queue) and queue[j][0] <= imu.t[i]:
            est.offer(queue[j][1], queue[j][0], queue[j][2])
            j += 1
        late = imu.t[i] > onset
        est.step(imu.t[i], w[i] + size[:3] * late, f[i] + size[3:] * late)
    est.finish()
    return est


def error_state(a: Any, b: Any) -> FloatArray:
    """State a less state b as an error state, attitude in the body frame, of the sixteen states."""
    qa, qb = a["q"][0], b["q"][0]
    w, v = qb[0], -qb[1:]
    d = np.r_[w * qa[0] - v @ qa[1:], w * qa[1:] + qa[0] * v + np.cross(v, qa[1:])]
    parts = [2.0 * d[1:] / d[0]] + [a[k][0] - b[k][0] for k in ("v", "p", "bg", "ba", "baro")]
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def moving() -> FlightLog:
    return demo_flight(4, 24.0, imu_rate=100.0)


#: Everything that is not linear in the measurements is off: tests, weights, watches; the responses are those of the filter alone.
LINEAR = {
    "gate.gnss": 1e5, "gate.barometer": 1e5, "gate.magnetometer": 1e5, "robust.innovation": 1e5, "aid.compass_watch": "off",
    "aid.motor_field": "off", "aid.yaw_bank": "off", "aid.zero_velocity": "off", "aid.zero_rate": "off", "noise.gyro_scale": 0.0,
    "home.lat": 46.8, "home.lon": 8.2, "home.alt": 600.0, "diagnosis.false_alarms": 1e-9,
}  # fmt: skip


@pytest.mark.parametrize("channel", range(6))
def test_a_response_is_what_a_small_fault_does_to_a_twin_of_the_filter(moving: FlightLog, channel: int) -> None:
    """Two filters on the same samples, one of them with a small constant on one axis: their difference is the response, to first order."""
    end, size = 20.0, (1e-4 if channel < 3 else 1e-3)
    clean = fly(moving, end, np.zeros(6), 0.0, LINEAR)
    bank = clean.state.record["bank"][0, 0]
    slot = int(np.argmin(np.abs(bank["onset"] - (end - 3.0)) + 1e9 * (bank["live"] == 0)))
    vector = np.zeros(6)
    vector[channel] = size
    faulty = fly(moving, end, vector, float(bank["onset"][slot]), LINEAR)
    true_jump = np.zeros(16)
    true_jump[9 + channel] = size  # the bias itself has jumped: true minus estimate has that, less what the filter has found
    got = (true_jump + error_state(clean.state.record, faulty.state.record)) / size
    want = bank["x"][:, column(GYRO if channel < 3 else ACCEL, slot) + int(SLOTS) * (channel % 3)].astype(float)
    scale = np.array([np.abs(want[k : k + 3]).max() for k in (0, 3, 6, 9, 12)]).repeat(3)
    assert np.abs(got[:15] - want[:15]).max() == pytest.approx(0.0, abs=0.02 * max(np.abs(want[:9]).max(), 1.0))
    assert (np.abs(got[:9] - want[:9]) < 0.05 * scale[:9] + 2e-3).all()  # second order in the corrections, half a sample at the onset


def test_ramps_are_sums_of_steps(moving: FlightLog) -> None:
    """The response to a ramp is the integral of those to steps, for every onset: responses are linear in the fault."""
    est = fly(moving, 20.0, np.zeros(6), 0.0, LINEAR)
    bank = est.state.record["bank"][0, 0]
    alive = [k for k in np.argsort(bank["onset"]) if bank["live"][k]]
    for step, ramp in ((GYRO, GYRO_RAMP), (ACCEL, ACCEL_RAMP)):
        for a in range(3):
            first = alive[-9]
            onsets = np.array([bank["onset"][k] for k in alive[-9:]])
            x = np.array([bank["x"][:9, column(step + a, k)] for k in alive[-9:]], dtype=float)
            x = np.vstack([x, np.zeros(9)])
            t = np.r_[onsets, est.state.t]
            integral = (0.5 * (x[1:] + x[:-1]) * np.diff(t)[:, None]).sum(axis=0)
            got = bank["x"][:9, column(ramp + a, first)].astype(float)
            assert got == pytest.approx(integral, abs=0.03 * np.abs(integral).max() + 1e-4)


def test_without_a_fault_the_statistic_is_chi_square(moving: FlightLog) -> None:
    """num²/den of one fault and onset over many flights: mean one, and its tail."""
    level = []
    for seed in range(12):
        flight = demo_flight(200 + seed, 26.0, imu_rate=100.0)
        told = run(flight, scored=False).config.changed(noise__gnss_velocity=0.15, noise__gnss_position=0.8, noise__gnss_altitude=1.2)
        bank = fly(flight, 24.0, np.zeros(6), 0.0, told).state.record["bank"][0, 0]
        for k in np.flatnonzero(bank["live"]):
            for f in range(6):
                j = column(f, int(k))
                if bank["den"][j] > 1.0 and 2.0 < 24.0 - bank["onset"][k] < 4.0:
                    level.append(bank["num"][j] ** 2 / bank["den"][j])
    mean = float(np.mean(level))
    assert 0.5 < mean < 1.6  # about 12 x 6 independent ones: 1 sigma of the mean is 0.17
    assert np.max(level) < 20.0


def test_the_level_of_an_alarm_follows_from_the_wanted_rate() -> None:
    from scipy.stats import chi2

    for rate in (0.01, 0.035, 1.0):
        p = rate / (3600.0 * 4.4 * 14.0 * 10.0)
        assert alarm_level(rate) == pytest.approx(chi2.isf(p, 1), rel=1e-9)
    assert parameters(resolve("navigator"))["diagnosis_threshold"][0] == pytest.approx(alarm_level(0.035))


# --- the bank against dense matrices -----------------------------------------------------------------------------------------


def transition(rng: np.random.Generator) -> tuple[Any, FloatArray]:
    """Blocks of Φ as kernels have them, and Φ dense."""
    D, A, B = np.eye(3) + 0.05 * rng.standard_normal((3, 3)), 0.1 * rng.standard_normal((3, 3)), 0.01 * rng.standard_normal((3, 3))
    dt = 0.01
    F = np.eye(16)
    F[0:3, 0:3], F[0:3, 9:12] = D, -dt * np.eye(3)
    F[3:6, 0:3], F[3:6, 12:15] = A, B
    F[6:9, 3:6], F[6:9, 0:3], F[6:9, 12:15] = dt * np.eye(3), 0.5 * dt * A, 0.5 * dt * B
    return (tuple(map(tuple, D)), tuple(map(tuple, A)), tuple(map(tuple, B)), dt), F


def test_the_bank_is_what_dense_matrices_make_of_it() -> None:
    rng = np.random.default_rng(3)
    S = np.zeros(1, layout(1, banks=1))
    S = S if COMPILED else S.view(np.recarray)
    s = S[0]
    s["q"][0] = 1.0
    b = s["bank"][0]
    signatures.clear(b)
    signatures.open_slot(s, 3, (0.1, 0.2, 0.97))
    n, m = 16, int(N_FAULTS * SLOTS)
    x = b["x"].astype(float).copy()
    assert x[:, column(YAW, 3)][:3] == pytest.approx([0.1, 0.2, 0.97])
    num, den = np.zeros(m), np.zeros(m)
    bias = np.zeros((n, m))
    for a in range(3):
        bias[9 + a, column(GYRO_RAMP + a, 3)] = 1.0
        bias[12 + a, column(ACCEL_RAMP + a, 3)] = 1.0
    for epoch in range(5):
        for _ in range(4):
            (D, A, B, dt), F = transition(rng)
            inertial.carry(s, D, A, B, dt)
            x = F @ x + dt * bias
        for component, c in ((0, 3), (4, 7), (6, 13), (1, 3)):
            h = rng.standard_normal(3)
            k = 0.05 * rng.standard_normal(n)
            s["k"][:] = k
            y, variance, evidence = float(rng.standard_normal()), 0.5 + float(rng.random()), component != 1
            signatures.matched(s, ((c, tuple(h)), NONE, NONE), variance, y, component, evidence, epoch != 2)
            row = np.zeros(n)
            row[c : c + 3] = h
            e = row @ x
            if evidence and component < 6:
                own = (VELOCITY if component < 3 else POSITION) + component % 3
                e[own * SLOTS : (own + 1) * SLOTS] += 1.0
            if evidence:
                num += e * y / variance
                den += e * e / variance
            if epoch != 2:
                x = x - np.outer(k, e)
    assert b["x"] == pytest.approx(x, rel=2e-4, abs=2e-5)
    assert b["num"] == pytest.approx(num, rel=1e-3, abs=1e-3)
    assert b["den"] == pytest.approx(den, rel=1e-3, abs=1e-3)


def test_heading_has_the_response_of_its_row_and_a_compass_that_steps_one_of_its_own() -> None:
    S = np.zeros(1, layout(1, banks=1))
    S = S if COMPILED else S.view(np.recarray)
    s = S[0]
    s["q"][0] = 1.0
    b = s["bank"][0]
    signatures.clear(b)
    signatures.open_slot(s, 5, (0.0, 0.0, 1.0))
    b["x"][2, column(GYRO + 2, 5)] = -0.5
    before = b["x"].astype(float).copy()
    s["k"][:] = 0.01
    for i in range(2):
        s["t"] += 0.02
        signatures.matched(s, ((0, (0.1, 0.2, 0.9)), NONE, NONE), 1.0, 0.05, 7, True, i == 0)
    assert b["e"][column(HEADING, 5)] == pytest.approx(1.0 - 0.01 * (0.1 + 0.2 + 0.9))  # one itself, less what the gain has moved
    e = 0.1 * before[0] + 0.2 * before[1] + 0.9 * before[2]
    e[column(HEADING, 0) : column(HEADING, 0) + int(SLOTS)] = 1.0
    # as evidence: without the filter's own heading, about the vertical (0, 0, 1), that the gain has turned; the first one is the offset
    assert b["bearing"][column(HEADING, 5)] == pytest.approx(1.0 - 0.01 * (0.1 + 0.2 + 0.9 - 1.0))
    assert b["heading_o"][column(GYRO + 2, 5)] == pytest.approx(e[column(GYRO + 2, 5)] - before[2, column(GYRO + 2, 5)], abs=0.01)
    assert b["x"] == pytest.approx(before - 0.01 * e, abs=1e-6)


def test_a_lone_outlier_proves_nothing_and_what_stays_does() -> None:
    S = np.zeros(1, layout(1, banks=1))
    S = S if COMPILED else S.view(np.recarray)
    s = S[0]
    b = s["bank"][0]
    signatures.clear(b)
    signatures.open_slot(s, 0, (0.0, 0.0, 1.0))
    j = column(VELOCITY, 0)
    levels = []
    for y in (100.0, 0.0, 30.0, 30.0, 30.0, 30.0, 30.0):
        signatures.matched(s, (NONE, NONE, NONE), 1.0, y, 0, True, False)
        levels.append(float(b["num"][j] ** 2 / b["den"][j]))
    assert levels[0] == pytest.approx(16.0, rel=1e-5)
    assert levels[1] < 1.0
    assert levels[-1] > 900.0
    # by hand: up to 4, and 1.2 times what counted before; the weight of what is beyond is the square of that part
    counted, weights = 0.0, [(4.0 / 100.0) ** 2, 1.0]
    for _ in range(5):
        counted = min(30.0, 4.0 + 1.2 * counted)
        weights.append((counted / 30.0) ** 2)
    values = [100.0, 0.0] + [30.0] * 5
    assert b["num"][j] / b["den"][j] == pytest.approx(np.dot(weights, values) / sum(weights), rel=1e-4)


def test_onsets_are_close_when_they_are_recent_and_reach_back() -> None:
    S = np.zeros(1, layout(1, banks=1))
    S = S if COMPILED else S.view(np.recarray)
    b = S[0]["bank"][0]
    for i in range(400):
        t = 0.25 * i
        k = int(inertial.next_slot(b, t))
        b["live"][k], b["onset"][k] = 1, t
    age = np.sort(t - b["onset"])
    assert age[0] == 0.0
    assert age[-1] > 9.0
    gaps = np.diff(age)
    assert (gaps <= np.maximum(0.51, 0.35 * age[1:])).all()
    assert (gaps[:4] <= 0.26).all()


# --- steps and failing channels in raw samples ---------------------------------------------------------------------------------


def hovering(seed: int, seconds: float = 40.0, rate: float = 250.0) -> FlightLog:
    return simulate(Scenario(mission="hover", duration=seconds, seed=seed, wind=WIND, landing=False, sensors={"imu": {"rate": rate}}))


@pytest.fixture(scope="module")
def hover() -> FlightLog:
    return hovering(31)


@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("size", [-20.0, 20.0])
def test_a_large_step_of_the_gyro_is_named_at_once(hover: FlightLog, axis: str, size: float) -> None:
    flight = inject(hover, [f"gyro.{axis}:bias={size}deg/s@25.3"])
    solution = run(flight, scored=False)
    (o,) = detections(solution.events, flight.meta.faults, 4.0, float(solution.t[-1])).outcomes
    assert o.delay < 0.1
    assert o.isolation == "right"
    assert o.isolation_delay < 0.3
    bias = solution.table[f"gyro_bias_{axis}"]
    before, after = bias[np.searchsorted(solution.t, 25.2)], bias[np.searchsorted(solution.t, 27.0)]
    assert after - before == pytest.approx(size * DEG, rel=0.1)


@pytest.mark.parametrize(
    ("word", "kind"),
    [
        ("gyro.y:stuck@25-28", "stuck"),
        ("accel.x:stuck@25-28", "stuck"),
        ("gyro.z:noise=60deg/s@25-29", "noise"),
    ],
)
def test_a_channel_that_fails_is_named_with_its_kind_and_its_end(hover: FlightLog, word: str, kind: str) -> None:
    flight = inject(hover, [word])
    solution = run(flight, scored=False)
    found = [e for e in solution.events if e["kind"] == kind]
    assert len(found) == 1
    sensor, axis = word.partition(":")[0].split(".")
    assert (found[0]["sensor"], found[0]["axis"]) == (sensor, axis)
    assert 25.0 <= found[0]["t_detected"] < 26.6
    end = float(flight.meta.faults[-1]["end"])
    assert found[0]["t_recovered"] == pytest.approx(end, abs=2.0)  # as long as the memory of roughness takes


def test_an_unseen_axis_makes_the_attitude_unsure(hover: FlightLog) -> None:
    before = run(hover, scored=False)
    stuck = run(inject(hover, ["gyro.x:stuck@25-29"]), scored=False)
    k = int(np.searchsorted(before.t, 28.0))
    assert stuck.table["sd_roll"][k] > 2.0 * before.table["sd_roll"][k]


# --- faults in flights ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "named", "within"),
    [
        ("gyro.x:bias=3deg/s@25", "gyro.x", 2.5),
        ("gyro.y:bias=-3deg/s@25", "gyro.y", 2.5),
        ("gyro.z:bias=6deg/s@25", "gyro.z", 3.5),
        ("accel.x:bias=0.8m/s2@25", "accel.x", 2.5),
        ("accel.y:bias=-0.8m/s2@25", "accel.y", 2.5),
        ("accel.z:bias=0.8m/s2@25", "accel.z", 2.5),
    ],
)
def test_a_fault_is_found_named_and_its_effect_taken_back(hover: FlightLog, word: str, named: str, within: float) -> None:
    flight = inject(hover, [word])
    solution = run(flight)
    (o,) = detections(solution.events, flight.meta.faults, 4.0, float(solution.t[-1])).outcomes
    assert (o.isolation, o.named) == ("right", (named,))
    assert o.delay < within
    deaf = run(flight, set={"diagnosis.inertial": "off"})
    late = solution.t > 25.0 + 8.0

    def worst(s: Any) -> float:
        truth = flight["truth"]
        q = [np.interp(s.t, truth.t, truth.get(f"q_{a}")) for a in "wxyz"]
        down = [(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z)
                for w, x, y, z in (q, [s.table[f"q_{a}"] for a in "wxyz"])]  # fmt: skip
        c = sum(a * b for a, b in zip(*down, strict=True))
        return float(np.degrees(np.arccos(np.clip(c[late], -1.0, 1.0))).max())

    assert worst(solution) < 2.5
    if named in ("gyro.x", "gyro.y"):
        assert worst(solution) < worst(deaf)


def test_the_size_that_is_found_is_that_of_the_fault(hover: FlightLog) -> None:
    got = []
    for size in (2.0, 3.0, 4.0):
        solution = run(inject(hover, [f"gyro.y:bias={size}deg/s@25"]), scored=False)
        before, after = (solution.table["gyro_bias_y"][np.searchsorted(solution.t, t)] for t in (24.5, 36.0))
        got.append((after - before) / DEG)
    assert got == pytest.approx([2.0, 3.0, 4.0], rel=0.15)


def test_no_fault_no_alarm(hover: FlightLog) -> None:
    solution = run(hover, scored=False)
    assert [e for e in solution.events if e["kind"] not in ("aligned", "reset")] == []


def test_switched_off_it_changes_nothing(hover: FlightLog) -> None:
    """Without a fault the filter is the same bit by bit, with diagnosis and without."""
    on, off = run(hover, scored=False), run(hover, set={"diagnosis.inertial": "off"}, scored=False)
    for name, values in on.table.items():
        assert np.array_equal(values, off.table[name]), name


def test_the_same_online(hover: FlightLog) -> None:
    """Sample by sample the same fault is named at the same time: the bank is a part of the state."""
    flight = inject(hover, ["gyro.x:bias=20deg/s@12"])
    cut = FlightLog({k: s.where(s.t <= 16.0) for k, s in flight.streams.items()}, flight.meta)
    offline = run(cut, scored=False)
    est = Estimator("navigator", offline.config)
    streams = {k: cut[k] for k in ("gnss", "magnetometer", "barometer")}
    at = dict.fromkeys(streams, 0)
    imu = cut["imu"]
    for i in range(len(imu.t)):
        for name, s in sorted(streams.items(), key=lambda kv: ("gnss", "barometer", "magnetometer").index(kv[0])):
            while at[name] < len(s) and s.t[at[name]] <= imu.t[i]:
                row = {c: float(s.get(c)[at[name]]) for c in s.names if c != "t"}
                if name == "barometer":
                    row = {"pressure": row["pressure"]}
                est.offer(name, float(s.t[at[name]]), row)
                at[name] += 1
        est.step(float(imu.t[i]), imu.vector("gyro")[i], imu.vector("accel")[i])
    est.finish()
    assert int(est.state.record["n_events"][0]) >= 1
    assert est.state.gyro_bias_b == pytest.approx([offline.table[f"gyro_bias_{a}"][-1] for a in "xyz"], abs=1e-9)


@pytest.mark.parametrize("word", ["barometer:bias=4m@25", "gnss.e:bias=2m/s@25"])
def test_what_is_measured_outside_is_not_blamed_on_the_imu(hover: FlightLog, word: str) -> None:
    flight = inject(hover, [word])
    solution = run(flight, scored=False)
    (o,) = detections(solution.events, flight.meta.faults, 4.0, float(solution.t[-1])).outcomes
    assert o.isolation == "right"


def test_constants_match_the_record() -> None:
    assert len(inertial.FAMILIES) == int(inertial.N_FAMILIES)
    assert signatures.BANK_COLUMNS % int(signatures.WIDTH) == 0
    assert int(signatures.WIDTH) % int(SLOTS) == 0
    assert set(steps.DEATHS) == {"stuck", "dropout", "saturate", "noise"}


# --- statistics -----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("mission", ["hover", "lissajous", "box"])
def test_faults_of_full_size_in_wind_are_named(mission: str) -> None:
    """Twenty seeds a fault and mission in gusts: at least 97 % right over all."""
    right = n = 0
    for word in ("gyro.x:bias=3deg/s", "gyro.y:bias=3deg/s", "gyro.z:bias=6deg/s", "accel.x:bias=0.8m/s2", "accel.y:bias=0.8m/s2",
                 "accel.z:bias=0.8m/s2"):  # fmt: skip
        for seed in range(9000, 9020):
            on = 24.0 + 0.37 * (seed % 7)
            flight = simulate(Scenario(mission=mission, duration=on + 14.0, seed=seed, wind=WIND, fault=(f"{word}@{on}",), landing=False))
            solution = run(flight, scored=False)
            (o,) = detections(solution.events, flight.meta.faults, 4.0, float(solution.t[-1])).outcomes
            right += o.isolation == "right"
            n += 1
    assert right >= 0.97 * n


@pytest.mark.slow
def test_an_hour_without_a_fault_has_no_alarm() -> None:
    for i in range(40):
        mission = ("hover", "lissajous", "box", "tour")[i % 4]
        flight = simulate(Scenario(mission=mission, duration=90.0, seed=9500 + i, wind=WIND if i % 8 < 4 else {}))
        bad = [
            e for e in run(flight, scored=False).events if e["sensor"] in ("gyro", "accel", "gnss", "barometer") and e["kind"] != "reset"
        ]
        assert bad == [], (i, bad)
