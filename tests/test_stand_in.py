"""A vehicle's model in place of IMU axes: transition against differences, navigation without axes, online as offline, what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import haltere
from haltere._jit import COMPILED
from haltere.diagnosis.stand_in import add_along, couple, stand_in
from haltere.errors import UsageError
from haltere.estimators.base import Estimator
from haltere.estimators.step import predict_interval
from haltere.flight.log import FlightLog, Stream
from haltere.flight.vehicle import Vehicle
from haltere.simulate import Scenario, simulate
from haltere.strapdown.layout import PARAMETERS, layout
from test_dynamics import SPEEDS, SPIN_UP, vehicle

FloatArray = NDArray[np.float64]
KIND = layout(baro=1, wind=2, drag=4, rotors=4, twist=3)
N = 27
TH, V, P_, BG, BA, WIND, DRAG, STEADY, TWIST = (
    slice(*k) for k in ((0, 3), (3, 6), (6, 9), (9, 12), (12, 15), (16, 18), (18, 22), (22, 24), (24, 27))
)


def tup(a: Any) -> tuple[float, float, float]:
    return float(a[0]), float(a[1]), float(a[2])


def parameters() -> Any:
    prm = np.zeros(1, PARAMETERS)
    prm["air_gust_time"], prm["air_density"] = 3.0, 1.1
    return prm


def begun(axes: tuple[int, ...], x: FloatArray, q0: Rotation) -> Any:
    """A state in flight, with the model in place of some axes, that is off by the error x."""
    s = np.zeros(1, KIND)
    q = (q0 * Rotation.from_rotvec(x[TH])).as_quat()
    s["q"][0] = np.r_[q[3], q[:3]]
    s["v"][0], s["p"][0], s["baro"][0] = np.array([3.0, -2.0, 0.5]) + x[V], x[P_], x[15]
    s["bg"][0], s["ba"][0] = x[BG], np.array([0.1, -0.2, 0.15]) + x[BA]
    s["wind"][0] = np.array([0.8, -0.5]) + x[WIND]
    s["drag"][0] = np.array([math.log(0.35), math.log(0.02), 0.05, -0.03]) + x[DRAG]
    s["steady"][0] = np.array([0.7, -0.4]) + x[STEADY]
    s["twist"][0] = np.array([0.1, -0.2, 0.05]) + x[TWIST]
    s["gravity"], s["origin"][0] = 9.8, [46.8, 8.2, 600.0]
    s["model"][0, 0] = vehicle()[0]
    s["speed"][0], s["spin_up"][0], s["rotor_known"] = SPEEDS, SPIN_UP, 1
    s["model"]["density"] = 1.225
    p = s["pairs"]
    p["t_ratio"], p["flying"] = -1e9, 1
    p["told"][0, 0, :, 0] = [
        [sum(1 << a for a in axes if a < 3), -1.0, 1e9],
        [sum(1 << (a - 3) for a in axes if a >= 3), -1.0, 1e9],
    ]
    p["on"][0, 0, list(axes)] = 1
    p["standing"] = 1
    return s


@pytest.mark.skipif(not COMPILED, reason="records by attribute")
@pytest.mark.parametrize("axes", [(0, 1, 2, 3, 4, 5), (2,), (0, 4)])
def test_transition_of_replaced_axes_is_the_derivative(axes: tuple[int, ...]) -> None:
    """Errors through the whole step, both ways, against what the covariance does; half of dt leaves a quarter of the difference."""
    q0 = Rotation.from_euler("xyz", [0.3, -0.2, 0.7])
    w_raw, f_raw = np.array([0.4, -0.3, 0.5]), np.array([0.3, 0.4, -9.5])
    prm = parameters()

    def after(x: FloatArray, dt: float, P: FloatArray | None = None) -> tuple[Any, FloatArray]:
        s = begun(axes, x, q0)
        if P is not None:
            s["P"][0] = P
        s["t"] = 10.0
        # once without time, for what the model says at the beginning of the interval
        w0, _, _, f0 = stand_in(s[0], prm[0], tup(w_raw), tup(f_raw), tup(w_raw), tup(f_raw), 0.0)
        w0, f0, w1, f1 = stand_in(s[0], prm[0], w0, f0, tup(w_raw), tup(f_raw), dt)
        predict_interval(s[0], prm[0], w0, f0, w1, f1, dt)
        couple(s[0], prm[0], dt)
        return s, np.array(w1)

    def error(x: FloatArray, dt: float) -> FloatArray:
        s, w1 = after(x, dt)
        q = s["q"][0]
        # a replaced rate is ω̂: the state of its bias is ω̂ less the true rate; others keep their bias
        bias = np.array([-w1[i] if i in axes else x[9 + i] for i in range(3)])
        return np.r_[
            Rotation.from_quat(np.r_[q[1:], q[0]]).as_rotvec(), s["v"][0], s["p"][0], bias, x[BA], x[15], s["wind"][0], x[DRAG],
            s["steady"][0], x[TWIST],
        ]  # fmt: skip

    left = []
    for dt in (0.008, 0.004):
        nominal = after(np.zeros(N), dt)[0]["q"][0]
        turned = Rotation.from_quat(np.r_[nominal[1:], nominal[0]])
        noise = after(np.zeros(N), dt, np.zeros((N, N)))[0]["P"][0].copy()
        worst = 0.0
        for k in range(N):
            h = 1e-5
            x = np.zeros(N)
            x[k] = h
            plus, minus = error(x, dt), error(-x, dt)
            for y in (plus, minus):
                y[TH] = (turned.inv() * Rotation.from_rotvec(y[TH])).as_rotvec()
            numeric = (plus - minus) / (2.0 * h)
            P = np.zeros((N, N))
            P[k, k] = 1.0
            outer = after(np.zeros(N), dt, P)[0]["P"][0] - noise
            column = outer[:, k] / math.sqrt(outer[k, k])
            worst = max(worst, float(np.abs(numeric - column).max()))
        left.append(worst)
    assert left[0] < 20.0 * 0.008**2 * 10.0
    assert left[1] < 0.3 * left[0]


def test_what_is_carried_along_is_a_congruence() -> None:
    rng = np.random.default_rng(4)
    s = np.zeros(1, KIND)
    A = rng.standard_normal((N, N))
    s["P"][0] = P = A @ A.T
    c, H = rng.standard_normal(3), np.zeros(N)
    blocks = (
        (0, tup(rng.standard_normal(3))),
        (3, tup(rng.standard_normal(3))),
        (16, tup(rng.standard_normal(3))),
        (9, tup(rng.standard_normal(3))),
    )
    for o, h in blocks:
        H[o : o + 3] += h
    add_along(s[0], 9, tup(c), blocks, 0.01)
    F = np.eye(N)
    F[9:12] += 0.01 * np.outer(c, H)
    np.testing.assert_allclose(s["P"][0], F @ P @ F.T, rtol=1e-12, atol=1e-12)


SENSORS = {"rotors": {"rate": 250.0}}


@pytest.fixture(scope="module")
def identified() -> Vehicle:
    """A vehicle file from two flights that nothing else here uses, geometry not given."""
    from haltere.identify.vehicle import identify_vehicle

    return identify_vehicle([
        simulate(Scenario(mission=m, scale=k, duration=80.0, seed=95000 + i, sensors=SENSORS, wind={"n": 2.0, "e": -1.0, "gust": 0.4}))
        for i, (m, k) in enumerate((("lissajous", 0.6), ("tour", 1.0)))
    ]).as_vehicle()  # fmt: skip


@pytest.fixture(scope="module")
def flown() -> FlightLog:
    return simulate(Scenario(mission="box", duration=50.0, seed=95100, sensors=SENSORS, landing=False, wind={"n": 3.0, "e": 1.0}))


def tilt(solution: Any, flight: FlightLog, begin: float) -> FloatArray:
    """Angle between the vertical as estimated and as it is [deg]."""
    truth, k = flight["truth"], solution.t > begin
    a = Rotation.from_quat(np.column_stack([solution.table[f"q_{c}"][k] for c in "xyzw"]))
    b = Rotation.from_quat(np.column_stack([np.interp(solution.t[k], truth.t, truth[f"q_{c}"]) for c in "xyzw"]))
    down = np.array([0.0, 0.0, 1.0])
    return np.asarray(np.degrees(np.arccos(np.clip(np.sum(a.inv().apply(down) * b.inv().apply(down), axis=1), -1.0, 1.0))))


def rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def test_attitude_without_axes_and_without_the_whole_imu(identified: Vehicle, flown: FlightLog) -> None:
    found = {}
    for name, keys in (
        ("none", {}),
        ("forces", {"exclude.accel": "xyz@20"}),
        ("roll", {"exclude.gyro": "x@20"}),
        ("imu", {"exclude.gyro": "xyz@20", "exclude.accel": "xyz@20"}),
    ):
        solution = haltere.run(flown, vehicle=identified, set=keys, scored=False)
        found[name] = rms(tilt(solution, flown, 20.0))
        told = np.degrees(np.hypot(solution.table["sd_roll"], solution.table["sd_pitch"])[solution.t > 20.0])
        assert found[name] < 2.0 * rms(told), name
    # theory.md §5.8 has 0.09, 0.14, 1.1 and 2.4 for sensors without bias; without a model the axes are lost altogether
    assert found["none"] < 0.6 and found["forces"] < 1.2 and found["roll"] < 2.0 and found["imu"] < 5.0


def test_an_axis_that_dies_is_replaced_and_used_again_when_it_works(identified: Vehicle) -> None:
    flight = simulate(Scenario(mission="box", duration=60.0, seed=95101, sensors=SENSORS, landing=False, fault=("gyro.x:stuck@25-45",)))
    on = {"diagnosis.inertial": "on"}
    without = haltere.run(flight, set=on, scored=False)
    solution = haltere.run(flight, vehicle=identified, set=on, scored=False)
    (e,) = [e for e in solution.events if e["kind"] == "stuck"]
    assert (e["sensor"], e["axis"]) == ("gyro", "x") and e["t_detected"] < 25.5 and abs(e["t_recovered"] - 45.0) < 0.2
    assert rms(tilt(solution, flight, 25.0)) < 2.5
    assert rms(tilt(solution, flight, 25.0)) < 0.7 * rms(tilt(without, flight, 25.0))
    assert rms(tilt(solution, flight, 52.0)) < 0.8


def test_truth_onboard_and_faults_are_not_read(identified: Vehicle, flown: FlightLog) -> None:
    bare = FlightLog({k: s for k, s in flown.streams.items() if k not in ("truth", "onboard")}, flown.meta)
    lying = type(flown.meta)(**{**vars(flown.meta), "faults": [{"sensor": "gyro", "axis": "x", "kind": "bias", "start": 10.0}]})
    keys = {"exclude.gyro": "y@22-30"}
    a = haltere.run(flown, vehicle=identified, set=keys, scored=False)
    b = haltere.run(FlightLog(bare.streams, lying), vehicle=identified, set=keys, scored=False)
    for name, column in a.table.items():
        np.testing.assert_array_equal(column, b.table[name])


def test_online_is_offline(identified: Vehicle, flown: FlightLog, tmp_path: Any) -> None:
    file = tmp_path / "vehicle.toml"
    file.write_text(identified.to_toml())
    short = FlightLog({k: s.where(s.t < 26.0) for k, s in flown.streams.items() if k in ("imu", "gnss", "rotors")}, flown.meta)
    keys = {"exclude.gyro": "x@20-24", "exclude.accel": "xyz@22"}
    solution = haltere.run(short, vehicle=file, set=keys, scored=False)
    est = Estimator("navigator", solution.config, vehicle=file)
    imu, gnss, rotors = short["imu"], short["gnss"], short["rotors"]
    speeds, gyro, accel = np.column_stack([rotors[f"speed_{k}"] for k in range(4)]), imu.vector("gyro"), imu.vector("accel")
    i = j = 0
    rows = []
    for k, t in enumerate(imu.t):
        while i < len(gnss) and gnss.t[i] <= t:
            est.offer("gnss", gnss.t[i], {c: float(gnss[c][i]) for c in gnss.names if c != "t"})
            i += 1
        while j < len(rotors) and rotors.t[j] <= t:
            est.offer("rotors", rotors.t[j], speeds[j])
            j += 1
        rows.append((est.step(t, gyro[k], accel[k]).t, est.state.q_nb) if k % 50 == 0 else (est.step(t, gyro[k], accel[k]).t, None))
    est.finish()
    np.testing.assert_allclose(est.state.q_nb, [solution.table[f"q_{c}"][-1] for c in "wxyz"], atol=1e-12)
    at = {round(float(t), 6): n for n, t in enumerate(solution.t)}
    seen = 0
    for t, q in rows:
        if q is not None and round(float(t), 6) in at:
            np.testing.assert_allclose(q, [solution.table[f"q_{c}"][at[round(float(t), 6)]] for c in "wxyz"], atol=1e-12)
            seen += 1
    assert seen > 50
    ahead = est.now()
    assert np.isfinite(ahead["q_nb"]).all()


def test_rotor_speeds_that_are_missing(identified: Vehicle, flown: FlightLog) -> None:
    rotors = flown["rotors"]
    lost = (rotors.t > 25.0) & (rotors.t < 30.0)
    nan = {c: np.where(lost, np.nan, rotors[c]) if c.startswith("speed_") else rotors[c] for c in rotors.names}
    for stream in (Stream({"t": rotors.t, **nan}), rotors.where(~lost)):
        flight = FlightLog({**flown.streams, "rotors": stream}, flown.meta)
        solution = haltere.run(flight, vehicle=identified, scored=False)
        assert not [e for e in solution.events if e["sensor"] in ("model", "rotors", "gyro", "accel")]
        assert rms(tilt(solution, flight, 20.0)) < 0.6
        solution = haltere.run(flight, vehicle=identified, set={"exclude.gyro": "x@24"}, scored=False)
        assert all(np.isfinite(c).all() for c in solution.table.values() if c.dtype == np.float64)


def test_what_cannot_be_done_is_refused(identified: Vehicle, flown: FlightLog) -> None:
    with pytest.raises(UsageError, match="vehicle's model"):
        haltere.run(flown, set={"exclude.gyro": "x"})
    with pytest.raises(UsageError, match="smoothed run without"):
        haltere.run(flown, vehicle=identified, smooth=True)
    with pytest.raises(UsageError, match="xyz@20-80"):
        haltere.run(flown, vehicle=identified, set={"exclude.accel": "w"})
