"""The online estimator's door: a bad sample or measurement is refused and counted, a wrong call is one clear error. Nothing poisons."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from haltere.errors import HaltereError, UsageError
from haltere.estimators.base import Estimator, InitialState

HOME = {"home.lat": 46.8, "home.lon": 8.2, "home.alt": 600.0}
STILL, LEVEL = (0.001, 0.0, 0.0), (0.0, 0.01, -9.81)
FIX = {"lat": 46.8, "lon": 8.2, "alt": 600.0, "vel_n": 0.0, "vel_e": 0.0, "vel_d": 0.0}


def fed(est: Estimator, start: int, end: int) -> Estimator:
    """At rest and level: 100 Hz IMU, with a fix, a field and a pressure every tenth of a second."""
    for k in range(start, end):
        t = 0.01 * k
        if k % 10 == 0:
            est.offer("gnss", t, FIX)
            est.offer("magnetometer", t, (21.0, 1.0, 42.0))
            est.offer("barometer", t, [94000.0])
        est.step(t, STILL, LEVEL)
    return est


def sound(est: Estimator) -> bool:
    s = est.state
    return s.aligned and all(np.isfinite(x).all() for x in (s.q_nb, s.vel_n, s.pos_n, s.gyro_bias_b, s.accel_bias_b, s.P))


@pytest.fixture(scope="module")
def good() -> Estimator:
    return fed(Estimator("navigator", HOME), 0, 600)


#: What is done once, at t = 3 s, and what it is counted as.
REFUSED: dict[str, tuple[Callable[[Estimator], Any], str, str]] = {
    "gyro nan": (lambda e: e.step(3.0, (math.nan, 0.0, 0.0), LEVEL), "imu", "refused by the filter"),
    "accel inf": (lambda e: e.step(3.0, STILL, (0.0, math.inf, -9.81)), "imu", "refused by the filter"),
    "gyro 1e30": (lambda e: e.step(3.0, (1e30, 0.0, 0.0), LEVEL), "imu", "refused by the filter"),
    "time nan": (lambda e: e.step(math.nan, STILL, LEVEL), "imu", "refused by the filter"),
    "time inf": (lambda e: e.step(math.inf, STILL, LEVEL), "imu", "refused by the filter"),
    "time back": (lambda e: e.step(1.0, STILL, LEVEL), "imu", "refused by the filter"),
    "time again": (lambda e: e.step(2.99, STILL, LEVEL), "imu", "refused by the filter"),
    "fix time nan": (lambda e: e.offer("gnss", math.nan, FIX), "gnss", "time not finite"),
    "field time inf": (lambda e: e.offer("magnetometer", math.inf, (20.0, 0.0, 40.0)), "magnetometer", "time not finite"),
    "fix nan": (lambda e: e.offer("gnss", 3.0, (math.nan, 8.2, 600.0)), "gnss", "not finite"),
    "fix of nothing": (lambda e: e.offer("gnss", 3.0, {}), "gnss", "not finite"),
    "fix at zero": (lambda e: e.offer("gnss", 3.0, (0.0, 0.0, 0.0)), "gnss", "latitude and longitude zero"),
    "fix beyond the pole": (lambda e: e.offer("gnss", 3.0, (91.0, 8.2, 600.0)), "gnss", "latitude or longitude impossible"),
    "no fix": (lambda e: e.offer("gnss", 3.0, FIX | {"fix_type": 2}), "gnss", "no 3-D fix"),
    "fix of 80 m": (lambda e: e.offer("gnss", 3.0, FIX | {"h_acc": 80.0}), "gnss", "accuracy worse than 50 m"),
    "fix long past": (lambda e: e.offer("gnss", 1.0, (46.8, 8.2, 600.0)), "gnss", "later than the fusion horizon"),
    "field nan": (lambda e: e.offer("magnetometer", 3.0, (math.nan, 0.0, 40.0)), "magnetometer", "not finite"),
    "field zero": (lambda e: e.offer("magnetometer", 3.0, (0.0, 0.0, 0.0)), "magnetometer", "zero"),
    "pressure nan": (lambda e: e.offer("barometer", 3.0, [math.nan]), "barometer", "not finite"),
    "pressure in hPa": (lambda e: e.offer("barometer", 3.0, 940.0), "barometer", "pressure impossible in Pa"),
    "height inf": (lambda e: e.offer("barometer", 3.0, {"altitude": math.inf}), "barometer", "not finite"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_and_counted(case: str, good: Estimator) -> None:
    """One bad call between good ones: counted under its reason, and the state afterwards is that without it."""
    call, sensor, reason = REFUSED[case]
    est = fed(Estimator("navigator", HOME), 0, 300)
    before = {s: dict(r) for s, r in est.discarded.items()}
    came = call(est)
    assert came is False or sensor == "imu"
    after = est.discarded
    assert after[sensor][reason] == before.get(sensor, {}).get(reason, 0) + 1
    fed(est, 300, 600)
    assert sound(est)
    np.testing.assert_array_equal(est.state.P, good.state.P)
    np.testing.assert_array_equal(est.state.q_nb, good.state.q_nb)


@pytest.mark.parametrize("variances", [[-1.0] * 6, [math.inf] * 6, [0.0] * 6, [1e300] * 6, [1e-300] * 6, (1, 1, 1), np.ones(6, np.float32)])
def test_variances_of_any_kind_do_not_poison(variances: Any) -> None:
    est = fed(Estimator("navigator", HOME), 0, 300)
    est.offer("gnss", 3.0, tuple(FIX.values()), variances)
    assert sound(fed(est, 300, 600))


@pytest.mark.parametrize(
    "kind", [list, np.array, lambda v: np.array(v, np.float32), lambda v: np.array([v, v]).T[:, 0], lambda v: np.array(v, object), iter]
)
def test_vectors_of_any_kind_are_taken(kind: Callable[[Any], Any]) -> None:
    """Values that single precision holds exactly; one compiled version serves all."""
    a, b = Estimator("ahrs"), Estimator("ahrs")
    for k in range(200):
        gyro, accel = (0.0, 0.125, 0.0), (0.25, 0.0, -9.75)
        a.step(k / 128, gyro, accel)
        b.step(np.float32(k / 128), kind(gyro), kind(accel))  # type: ignore[arg-type]
    np.testing.assert_array_equal(a.state.q_nb, b.state.q_nb)
    est = Estimator("ahrs")
    for k in range(5):
        est.step(k, (0, 0, 0), (0, 0, -10))  # whole numbers
    assert est.discarded == {}


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda e: e.step(3.0, 0.1, LEVEL), r"three numbers for gyro, found 0\.1"),
        (lambda e: e.step(3.0, (0.1, 0.2), LEVEL), r"three numbers for gyro, found \(0\.1, 0\.2\)"),
        (lambda e: e.step(3.0, STILL, (0.0, 0.0, 0.0, -9.81)), r"three numbers for accel, found \(0\.0, 0\.0, 0\.0, -9\.81\)"),
        (lambda e: e.step(3.0, np.zeros((1, 3)), LEVEL), r"three numbers for gyro, found shape \(1, 3\)"),
        (lambda e: e.step(3.0, np.zeros((3, 1)), LEVEL), r"three numbers for gyro, found shape \(3, 1\)"),
        (lambda e: e.step(3.0, None, LEVEL), r"three numbers for gyro, found None"),
        (lambda e: e.step(3.0, ("a", "b", "c"), LEVEL), r"three numbers for gyro"),
        (lambda e: e.step(None, STILL, LEVEL), r"a number for t, found None"),
        (lambda e: e.step("now", STILL, LEVEL), r"a number for t, found 'now'"),
        (lambda e: e.offer("gps", 3.0, FIX), r"a sensor: .*found 'gps'; did you mean 'gnss'\?"),
        (lambda e: e.offer("mag", 3.0, STILL), r"did you mean 'magnetometer'\?"),
        (lambda e: e.offer("lidar", 3.0, [1.0]), r"found 'lidar'$"),
        (lambda e: e.offer(None, 3.0, [1.0]), r"a sensor: .*found None"),
        (lambda e: e.offer("gnss", "now", FIX), r"a number for t, found 'now'"),
        (lambda e: e.offer("gnss", 3.0, (46.8, 8.2)), r"3 to 6 values for gnss: lat, lon, alt.*found 2"),
        (lambda e: e.offer("gnss", 3.0, np.zeros((2, 3))), r"a sequence of numbers, found shape \(2, 3\)"),
        (lambda e: e.offer("gnss", 3.0, {"latitude": 46.8}), r"values of gnss by name .*found 'latitude'; did you mean 'lat'\?"),
        (lambda e: e.offer("magnetometer", 3.0, {"magx": 1.0}), r"found 'magx'; did you mean 'mag_x'\?"),
        (lambda e: e.offer("gnss", 3.0, FIX | {"lat": "north"}), r"a number for lat, found 'north'"),
        (lambda e: e.offer("gnss", 3.0, tuple(FIX.values()), [1.0] * 7), r"at most 6 variances for gnss, found 7"),
        (lambda e: e.offer("gnss", 3.0, tuple(FIX.values()), "small"), r"variances as a sequence"),
        (lambda e: e.offer("barometer", 3.0, [94000.0, 1.0]), r"1 to 1 values for barometer: pressure, found 2"),
        (lambda e: e.offer("barometer", 3.0, [94000.0], [1.0]), r"no variances for barometer, found some; set noise\.barometer"),
        (lambda e: e.offer("barometer", 3.0, None), r"values of barometer as a sequence of numbers, found None"),
        (lambda e: e.restore(None), r"a State, as Estimator\.state gives, found NoneType"),
        (lambda e: e.restore(Estimator("ahrs").state), r"a state of the same layout"),
        (lambda e: Estimator("navigator", Estimator("ahrs").config), r"a configuration of navigator, found one of ahrs"),
        (lambda e: Estimator("navigator", {"gate.gnsss": 1.0}), r"did you mean 'gate\.gnss'\?"),
    ],
)
def test_a_wrong_call_is_one_clear_error(call: Callable[[Estimator], Any], words: str) -> None:
    est = fed(Estimator("navigator", HOME), 0, 20)
    before = est.state.record.tobytes()
    with pytest.raises(UsageError, match=words) as caught:
        call(est)
    assert caught.value.where
    assert est.state.record.tobytes() == before


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"q_nb": (0.0, 0.0, 0.0, 0.0)}, "4 finite numbers for q_nb"),
        ({"q_nb": (1.0, 0.0, 0.0)}, "4 finite numbers for q_nb"),
        ({"vel_n": (math.nan, 0.0, 0.0)}, "3 finite numbers for vel_n"),
        ({"P": np.eye(3)}, "an initial covariance of shape"),
        ({"P": -np.eye(16)}, "a symmetric positive covariance"),
        ({"P": np.full((16, 16), math.nan)}, "a symmetric positive covariance"),
        ({"t": None}, "a number for t"),
    ],
)
def test_an_initial_state_that_is_none(change: dict[str, Any], words: str) -> None:
    state: dict[str, Any] = {"t": 0.0, "q_nb": (1.0, 0.0, 0.0, 0.0), "P": 0.01 * np.eye(16)}
    state |= dict.fromkeys(("vel_n", "pos_n", "gyro_bias_b", "accel_bias_b"), (0.0, 0.0, 0.0))
    assert Estimator("navigator", initial=InitialState(**state)).state.aligned
    with pytest.raises(HaltereError, match=words):
        Estimator("navigator", initial=InitialState(**(state | change)))
