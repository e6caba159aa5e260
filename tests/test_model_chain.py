"""The chain that a vehicle's model drives, and J21 to J24: derivatives, a dense oracle, what they see, in which order."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import haltere
from haltere import drive
from haltere._jit import COMPILED
from haltere.aids.record import BAROMETER, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER
from haltere.core.rotation import dcm
from haltere.diagnosis import model_detectors
from haltere.diagnosis.model_chain import MISS_TIME, advance, gather, seed
from haltere.flight.log import FlightLog
from haltere.simulate import Scenario, simulate
from haltere.strapdown import dynamics
from haltere.strapdown.layout import PARAMETERS, layout
from haltere.vehicle.linear import linear
from test_dynamics import SPEEDS, SPIN_UP, three, vehicle

FloatArray = NDArray[np.float64]
KIND = layout(baro=1, wind=2, drag=4, rotors=4, twist=3)
N, DT = 23, 0.004
W, TH, V, P_, BM, BF, WIND, MEAN = (slice(*k) for k in ((0, 3), (3, 6), (6, 9), (9, 12), (12, 15), (15, 18), (18, 20), (20, 22)))
DATA = Path(__file__).parents[1] / "docs" / "_data"
AT = 20.0
needs_records = pytest.mark.skipif(not COMPILED, reason="records by attribute")


def parameters() -> Any:
    prm = np.zeros(1, PARAMETERS)
    for key, value in {
        "air_gust_time": 3.0, "air_gust": 0.3, "air_turbulence": 0.15, "noise_wind_mean": 0.05, "noise_baro_bias": 0.05,
        "noise_barometer": 1.0, "noise_magnetometer": 1.0, "noise_field": 2.5, "noise_gnss_velocity_min": 0.1,
        "noise_gnss_position_min": 0.5, "gate_gnss": 5.0, "gate_barometer": 5.0, "gate_magnetometer": 6.0, "diagnosis_vehicle": 1.0,
        "diagnosis_chain_single": 31.0, "diagnosis_chain_triple": 40.0,
    }.items():  # fmt: skip
        prm[key] = value
    return prm


def begun() -> Any:
    """A filter in flight whose chain has just begun."""
    s = np.zeros(1, KIND)
    q = Rotation.from_euler("xyz", [0.2, -0.15, 0.6]).as_quat()
    s["q"][0], s["v"][0], s["p"][0], s["w"][0] = np.r_[q[3], q[:3]], [3.0, -2.0, 0.5], [10.0, 5.0, -20.0], [0.3, -0.2, 0.4]
    s["wind"][0], s["steady"][0], s["drag"][0] = [0.8, -0.5], [0.7, -0.4], [math.log(0.35), math.log(0.02), 0.05, -0.03]
    s["gravity"], s["origin"][0], s["has_origin"] = 9.8, [46.8, 8.2, 600.0], 1
    s["field"][0], s["has_field"] = [0.03, 1.1, 48.0], 1
    root = np.random.default_rng(3).normal(size=(27, 27)) * 0.02
    s["P"][0] = root @ root.T + 1e-3 * np.eye(27)
    s["model"][0, 0] = vehicle()[0]
    s["model"]["density"], s["model"]["sd"], s["model"]["slow"] = 1.225, 0.15, 0.08
    s["model"]["window"] = 0.1
    s["speed"][0], s["spin_up"][0], s["rotor_known"] = SPEEDS, SPIN_UP, 1
    s["pairs"]["ratio"], s["pairs"]["flying"] = 0.95, 1
    s["aid"]["started"] = 1
    s["t"] = 10.0
    model_detectors.forget(s[0])
    seed(s[0], parameters()[0])
    return s


def block(s: Any, prm: Any) -> None:
    """One block at constant rotor speeds."""
    while True:
        s["t"] += DT
        if gather(s[0], DT):
            break
    advance(s[0], prm[0])


def moved(s: Any, e: FloatArray) -> None:
    """Put an error into the nominal state of the chain."""
    c = s["chain"][0, 0]
    q = (Rotation.from_quat(np.r_[c["q"][1:], c["q"][0]]) * Rotation.from_rotvec(e[TH])).as_quat()
    c["q"][:] = np.r_[q[3], q[:3]]
    for name, k in (("w", W), ("v", V), ("p", P_), ("bm", BM), ("bf", BF), ("wind", WIND), ("steady", MEAN)):
        c[name][:] += e[k]
    c["baro"] += e[22]


def error(s: Any, ref: Any) -> FloatArray:
    c, r = s["chain"][0, 0], ref["chain"][0, 0]
    turn = Rotation.from_quat(np.r_[r["q"][1:], r["q"][0]]).inv() * Rotation.from_quat(np.r_[c["q"][1:], c["q"][0]])
    names = ("v", "p", "bm", "bf", "wind", "steady")
    return np.r_[c["w"] - r["w"], turn.as_rotvec(), *(c[n] - r[n] for n in names), c["baro"] - r["baro"]]


def jacobian(prm: Any, prepare: Any, after: Any) -> FloatArray:
    """Derivative of what ``after`` does to a chain, by central differences."""
    columns = []
    reference = prepare()
    after(reference, prm)
    for e in np.eye(N):
        side = []
        for h in (1e-5, -1e-5):
            s = prepare()
            moved(s, h * e)
            after(s, prm)
            side.append(error(s, reference))
        columns.append((side[0] - side[1]) / 2e-5)
    return np.column_stack(columns)


@needs_records
def test_covariance_is_carried_by_the_derivative_of_the_block() -> None:
    """A block of a fiftieth of a second, to first order in it."""
    prm = parameters()
    A = jacobian(prm, begun, block)
    s = begun()
    before = s["chain"]["P"][0, 0].copy()
    block(s, prm)
    still = begun()
    still["chain"]["P"] = 0.0
    block(still, prm)
    noise = still["chain"]["P"][0, 0]
    want = A @ before @ A.T + noise
    sd = np.sqrt(np.diag(want))
    np.testing.assert_allclose(s["chain"]["P"][0, 0] / np.outer(sd, sd), want / np.outer(sd, sd), rtol=0, atol=0.01)
    assert np.linalg.eigvalsh(noise).min() > -1e-12 and (np.diag(noise)[[0, 1, 2, 12, 15, 18, 20, 22]] > 0.0).all()


@needs_records
def test_no_sample_of_the_imu_enters_and_errors_are_linear_in_the_seed() -> None:
    prm = parameters()
    reference = begun()
    e = np.random.default_rng(1).normal(size=N) * 1e-3
    e[22] = 0.0
    ends = []
    for scale in (1.0, 2.0):
        s = begun()
        moved(s, scale * e)
        s["w_raw"], s["f_raw"], s["bg"], s["ba"] = 9.0, -7.0, 0.3, 1.0  # what the IMU says is not asked
        for _ in range(25):
            block(s, prm)
        ends.append(s)
    for _ in range(25):
        block(reference, prm)
    one, two = (error(s, reference) for s in ends)
    np.testing.assert_allclose(two, 2.0 * one, atol=2e-2 * np.abs(one).max())


def put(s: Any, kind: int, z: tuple[float, float, float], r: tuple[float, float, float]) -> None:
    c = s["chain"][0, 0]
    k = int(c["n_due"])
    d = c["due"][k]
    d["kind"], d["t"] = kind, s["t"][0]
    d["z"][:], d["r"][:] = z, r
    s["chain"]["n_due"][0, 0] = k + 1


def dense_update(x: FloatArray, P: FloatArray, H: FloatArray, y: float, r: float) -> tuple[FloatArray, FloatArray, float]:
    """Textbook scalar update in Joseph form; the innovation over its sigma comes back too."""
    S = float(H @ P @ H) + r
    e = y - float(H @ x)
    K = P @ H / S
    left = np.eye(N) - np.outer(K, H)
    return x + K * e, left @ P @ left.T + r * np.outer(K, K), e / math.sqrt(S)


def dense_transition(s: Any) -> FloatArray:
    """The block's transition as a full matrix, from the model's derivatives; that it is the derivative of the block, another test says."""
    c = s["chain"][0, 0]
    C = dcm(tuple(float(x) for x in c["q"]))
    w, v = three(c["w"]), dynamics.air_velocity(C, three(c["v"]), float(c["wind"][0]), float(c["wind"][1]))
    f, _, D_a, D_w, M_a, M_w = linear(s["model"][0, 0], SPEEDS, SPIN_UP, v, w, w, 0.95)
    dt = 5 * DT
    T = dynamics.transition(
        C, w, three(np.array(f) + c["bf"]), v, D_a, D_w, M_a, M_w, dt, math.exp(-dt / 3.0), math.exp(-dt / MISS_TIME)
    )  # fmt: skip
    A = np.eye(N)
    for column in A:
        dynamics.carry_vector(column, T)
    return np.asarray(A.T)


@needs_records
def test_against_a_dense_filter() -> None:
    """Half a second of blocks with every sensor: state, covariance and innovations are those of full matrices, in textbook form."""
    prm, rng = parameters(), np.random.default_rng(5)
    s = begun()
    P = s["chain"]["P"][0, 0].copy()
    for n in range(25):
        A = dense_transition(s)
        empty = s.copy()
        empty["chain"]["P"] = 0.0
        block(empty, prm)
        P = A @ P @ A.T + empty["chain"]["P"][0, 0]
        block(s, prm)
        c = s["chain"][0, 0]
        x, want = np.zeros(N), {}
        worth = s["chain"]["worth"][0, 0].copy()
        C = Rotation.from_quat(np.r_[c["q"][1:], c["q"][0]]).as_matrix()
        if n % 5 == 0:
            z = c["v"] + rng.normal(size=3) * 0.2
            put(s, GNSS_VELOCITY, tuple(z), (0.04, 0.04, 0.09))
            out = []
            for i, r in enumerate((0.04, 0.04, 0.09)):
                x, P, e = dense_update(x, P, np.eye(N)[6 + i], float(z[i] - c["v"][i]), r)
                out.append(e)
            want[1] = out
        if n % 2 == 0:
            height = -c["p"][2] + c["baro"] + rng.normal() * 0.5
            put(s, BAROMETER, (height + 600.0, 0.0, 0.0), (math.nan,) * 3)
            H = np.zeros(N)
            H[11], H[22] = -1.0, 1.0
            x, P, e = dense_update(x, P, H, float(height + c["p"][2] - c["baro"]), float(worth[2]))
            want[2] = [e]
        d, dip, strength = 0.03, 1.1, 48.0
        turned = Rotation.from_rotvec([0.0, 0.0, rng.normal() * 0.05]).as_matrix()
        field = C.T @ turned @ np.array([math.cos(dip) * math.cos(d), math.cos(dip) * math.sin(d), math.sin(dip)]) * strength
        put(s, MAGNETOMETER, tuple(field), (math.nan,) * 3)
        mu = C @ field
        H = np.zeros(N)
        H[TH] = (np.array([0.0, 0.0, 1.0]) - math.tan(dip) * np.array([math.cos(d), math.sin(d), 0.0])) @ C
        r = (1.0 + 2.5**2) / (strength * math.cos(dip)) ** 2 * float(worth[0])
        x, P, e = dense_update(x, P, H, d - math.atan2(mu[1], mu[0]), r)
        want[0] = [e]
        reference = s.copy()
        model_detectors.hear(s[0], prm[0])
        for k, z in want.items():
            np.testing.assert_allclose(s["chain"]["z"][0, 0][k][: len(z)], z, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(error(s, reference), x, atol=1e-7)
        P = 0.5 * (P + P.T)
    sd = np.sqrt(np.diag(P))
    np.testing.assert_allclose(s["chain"]["P"][0, 0] / np.outer(sd, sd), P / np.outer(sd, sd), rtol=0, atol=1e-9)
    assert int(s["chain"]["n_due"][0, 0]) == 0


def flight(
    *faults: str, mission: str = "box", wind: dict[str, float] | None = None, seed: int = 66001, end: float = 5.0, **more: Any
) -> FlightLog:
    return simulate(
        Scenario(
            mission=mission, duration=AT + end, seed=seed, landing=False, wind=wind or {}, fault=tuple(f"{f}@{AT:g}" for f in faults),
            sensors={"rotors": {"rate": 250.0}}, scale=0.55 if mission == "lissajous" else 1.0, **more,
        )
    )  # fmt: skip


def chain_of(log: FlightLog, **keys: str) -> Any:
    """The chain's record at the end of a flight through `navigator`; alarms of J11 to J16 are never large enough to be told of."""
    vehicle_model = drive.model_of(DATA / "hummingbird_identified.toml", "navigator")
    asked = drive.request(log, "navigator", "default", None, {"diagnosis.moment": "50", "diagnosis.force": "50", **keys})
    log = drive.correct(log, asked.values)
    blind = log.without("onboard", "truth")
    checked = drive.check(blind, upright=True, given=asked.values)
    config = drive.configure(blind, checked, "navigator", "default", asked)
    t, gyro, accel = drive.imu_arrays(blind, checked)
    m = drive.measurements(blind, checked, config)
    heard = drive.rotor_speeds(checked.streams, vehicle_model, t)
    m.rotor_t, m.rotor_speed = heard.t, heard.speed
    S = drive.new_state(config, None, vehicle_model)
    drive._loop(S, drive.parameters(config), t, gyro, accel, m, np.empty((drive.COVARIANCE_ROWS, len(t))), None, False)
    return S["chain"][0, 0]


def seen(c: Any) -> dict[str, float]:
    """Delay of the alarms since the fault."""
    return {f"J2{k + 1}": float(t) - AT for k, t in enumerate(c["t_alarm"]) if t > 0.0}


@pytest.mark.parametrize("mission", ["hover", "box", "lissajous"])
def test_signatures_and_their_order(mission: str) -> None:
    """Theory.md §5.5: what each fault does to J21 to J23, and when: its delay + 30 % or + 0.15 s, where the table has it always."""
    for word in ("gyro.x:bias=3deg/s", "gyro.z:bias=6deg/s", "accel.x:bias=0.8m/s2", "accel.z:bias=0.8m/s2", "model.hx:bias=0.8m/s2"):
        assert seen(chain_of(flight(word, mission=mission))) == {}, word
    for word, name, most in (
        ("gnss.n:bias=1.5m/s", "J22", 0.25),
        ("barometer:bias=3m", "J23", 0.15),
        ("magnetometer:disturb=0.165", "J21", 0.25),
    ):
        found = seen(chain_of(flight(word, mission=mission, end=1.0)))
        assert set(found) == {name} and 0.0 <= found[name] < most, (word, found)
    for word, least, most in (("model.r:bias=3rad/s2", 0.5, 1.3), ("model.p:bias=3rad/s2", 0.5, 1.3), ("rotor.2:thrust=0.85", 0.4, 0.8)):
        found = seen(chain_of(flight(word, mission=mission, end=3.0)))
        assert least < found["J22"] < most, (word, found)  # turned, it is pushed, and then it sinks
        assert found["J22"] < found.get("J23", 9.0), (word, found)
    runs = []
    for k in range(8):  # a yawing moment shows sooner or later by the phase of the mission: the table's delays are means
        at = AT + 0.93 * k
        log = simulate(
            Scenario(
                mission=mission, duration=at + 3.0, seed=66001 + k, landing=False, fault=(f"model.q:bias=1.5rad/s2@{at:g}",),
                sensors={"rotors": {"rate": 250.0}}, scale=0.55 if mission == "lissajous" else 1.0,
            )
        )  # fmt: skip
        runs.append({name: delay + AT - at for name, delay in seen(chain_of(log)).items()})
    assert np.mean([r["J21"] for r in runs]) < 0.91, runs
    assert all(r["J21"] < r.get("J22", 9.0) for r in runs), runs


def test_innovations_are_white_and_of_the_stated_size_and_gusts_alarm_nobody() -> None:
    """Fault-free, noise told: mean squares 1, over 400 innovations remembered (3 sigma: 0.2), and 15 % for rotors, which are not white."""
    for wind in ({}, {"n": 5.2, "e": 3.0, "gust": 1.2}):
        for mission in ("hover", "lissajous", "box"):
            c = chain_of(flight(mission=mission, wind=wind, end=60.0, tell_noise=True))
            assert seen(c) == {} and int(c["live"]) == 1, (mission, wind, seen(c))
            assert (c["ratio"] < 1.0).all() and (c["n_learnt"] > 300.0).all()
            assert (np.abs(c["c0"] - 1.0) < 0.35).all(), (mission, wind, c["c0"])
            assert (np.abs(c["c1"] / c["c0"]) < 0.25).all(), (mission, wind, c["c1"] / c["c0"])


def test_compass_and_barometer_are_worth_what_the_flight_shows() -> None:
    """The simulator's noise, 1 µT and 0.5 m white, against what is configured: 2.5 µT beside, and 1 m."""
    for mission in ("hover", "box"):
        c = chain_of(flight(mission=mission, end=30.0))
        assert c["worth"][0] == pytest.approx(1.0 / (1.0 + 2.5**2), rel=0.25)
        assert c["worth"][2] == pytest.approx(0.25, rel=0.25)


def test_what_alarmed_is_in_the_evidence() -> None:
    of = DATA / "hummingbird_identified.toml"
    for word, candidates, said in (
        ("gnss.n:bias=1.5m/s", ["gnss.n"], "J22 at "), ("barometer:bias=3m", ["barometer"], "J23 at "),
        ("accel.x:bias=0.8m/s2", ["accel.x"], "J21, J22, J23, J24 silent"), ("rotor.2:thrust=0.85", ["rotor.2", "rotors.2"], "J21 at "),
    ):  # fmt: skip
        events = [e for e in haltere.run(flight(word), vehicle=of, scored=False).events if e["t_detected"] > AT]
        assert [e["candidates"] for e in events] == [candidates], word
        assert said in events[0]["evidence"], (word, events[0]["evidence"])
        if "GNSS" not in word and word.startswith(("gnss", "baro")):
            assert events[0]["t_detected"] - AT < 0.25, events[0]  # when the first of both chains alarmed
    plain = [e for e in haltere.run(flight("accel.x:bias=0.8m/s2"), scored=False).events if e["t_detected"] > AT]
    assert all("J2" not in e["evidence"] for e in plain)  # who has no model has no such detectors


def test_switched_off_there_is_no_chain() -> None:
    c = chain_of(flight("gnss.n:bias=1.5m/s", end=1.0), **{"diagnosis.vehicle": "off"})
    assert int(c["live"]) == 0 and seen(c) == {}


def test_kinds_of_what_is_heard() -> None:
    assert [int(x) for x in (GNSS_VELOCITY, GNSS_POSITION, BAROMETER, MAGNETOMETER)] == [0, 1, 2, 3]
    assert len(model_detectors.HEARD) == len(model_detectors.COLOUR) == 4
