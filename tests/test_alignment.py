"""Where a run begins: at rest, in motion, shaken, with a compass, without one and with a wrong one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from haltere._jit import COMPILED
from haltere.aids.record import BAROMETER, FUSED
from haltere.drive import run
from haltere.errors import HaltereError
from haltere.estimators.alignment import AT_REST, GRAVITY_ONLY, IN_MOTION, TWO_SPANS, level_and_compass
from haltere.estimators.base import Estimator, InitialState, State
from haltere.flight.local import geodetic_from_local
from haltere.flight.log import FlightLog, FlightMeta
from haltere.flight.solution import Solution
from haltere.metrics.errors import error_series
from haltere.simulate import demo_flight
from haltere.simulate.demo import HOME
from haltere.strapdown.layout import PARAMETERS, layout

FloatArray = NDArray[np.float64]
G = 9.80665
DEG = math.pi / 180.0
FIELD = {"field.declination": 0.05, "field.dip": 1.1, "field.strength": 48.0}
FIELD_N = 48.0 * np.array([math.cos(1.1) * math.cos(0.05), math.cos(1.1) * math.sin(0.05), math.sin(1.1)])


def scipy_of(q: FloatArray) -> Rotation:
    return Rotation.from_quat(np.r_[q[1:], q[0]])


def tup(a: FloatArray) -> tuple[float, ...]:
    return tuple(float(x) for x in a)


def columns(stem: str, values: FloatArray) -> dict[str, FloatArray]:
    return {f"{stem}_{a}": values[:, k] for k, a in enumerate("xyz")}


def wrap(a: float) -> float:
    return math.remainder(a, 2.0 * math.pi)


# At rest


def feed_rest(est: Estimator, C: FloatArray, gyro: FloatArray, accel: FloatArray, mag: FloatArray, rate: float = 100.0) -> State:
    """Samples of a body at rest until the estimator is aligned; at each, rate and force and a magnetometer sample with their noise."""
    for i in range(len(gyro)):
        t = i / rate
        est.offer("magnetometer", t, tup(C.T @ FIELD_N + mag[i]))
        if est.step(t, tup(gyro[i]), tup(C.T @ np.array([0.0, 0.0, -G]) + accel[i])).aligned:
            return est.state
    raise AssertionError("never aligned")


@pytest.mark.parametrize("seed", range(20))
def test_at_rest_without_noise_alignment_is_exact(seed: int) -> None:
    """Any attitude, head down too: theory-amendments.md §8 in closed form, to rounding."""
    rng = np.random.default_rng(seed)
    truth = Rotation.random(random_state=rng)
    zero = np.zeros((200, 3))
    state = feed_rest(Estimator("ahrs", FIELD), truth.as_matrix(), zero, zero, zero)
    assert 0.9 < state.t < 1.2  # the statistics of a second
    assert (truth.inv() * scipy_of(state.q_nb)).magnitude() < 1e-9
    np.testing.assert_array_equal(state.gyro_bias_b, 0.0)


@pytest.mark.parametrize("seed", range(20))
def test_at_rest_alignment_is_as_good_as_its_sensors(seed: int) -> None:
    """Noise of a still vehicle, biases of 0.2 m/s² and 0.5 deg/s, any attitude.

    Tilt is off by at most |b_a|/g and the noise of a mean of 100 samples. Heading: by tan(dip) of that, by the magnetometer's noise
    over the horizontal field, and by the turn that the gyro's bias feigns between the mean time of the field and the end.
    """
    rng = np.random.default_rng(100 + seed)
    truth = Rotation.random(random_state=rng)
    C = truth.as_matrix()
    bg, ba = rng.uniform(-1.0, 1.0, 3) * 0.0087, rng.uniform(-1.0, 1.0, 3) * 0.2
    gyro, accel = bg + 0.003 * rng.standard_normal((200, 3)), ba + 0.05 * rng.standard_normal((200, 3))
    state = feed_rest(Estimator("ahrs", FIELD), C, gyro, accel, 0.5 * rng.standard_normal((200, 3)))
    error = (truth.inv() * scipy_of(state.q_nb)).as_rotvec()
    tilt = (float(np.linalg.norm(ba)) + 4.0 * 0.05 / 10.0) / G
    n = scipy_of(state.q_nb).as_matrix()
    assert math.acos(min(1.0, float(n[2] @ C[2]))) < tilt
    slip = 0.5 * float(np.linalg.norm(bg))
    about_vertical = abs(float(C[2] @ error))
    assert about_vertical < math.tan(1.1) * (tilt + slip) + slip + 4.0 * 0.5 / 10.0 / (48.0 * math.cos(1.1)) + 0.01 * tilt
    # the bias is the mean of the second before; windows that differ by two samples differ by a fiftieth of the noise
    last = round(state.t * 100.0)
    np.testing.assert_allclose(state.gyro_bias_b, gyro[max(0, last - 100) : last].mean(axis=0), atol=2.0 * 4.0 * 0.003 / 100.0)
    # what it claims: of its own errors, none is beyond four of its 1 sigma
    d = C[2]
    P = state.P
    assert error @ np.linalg.solve(P[:3, :3], error) < 16.0
    assert math.sqrt(d @ P[:3, :3] @ d) == pytest.approx(10.0 * DEG, rel=1e-3)
    across = np.cross(d, [0.3, 0.5, -0.8])
    across /= np.linalg.norm(across)
    assert math.sqrt(across @ P[:3, :3] @ across) == pytest.approx(math.hypot(3.0 * DEG, 0.2 / G), rel=0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(P)[9:12]), 0.05 * DEG, rtol=0.05)


def test_roll_and_pitch_are_those_of_the_mean_force() -> None:
    """φ = atan2(-f_y, -f_z), θ = atan2(f_x, √(f_y²+f_z²)), whatever bias is in f."""
    f = np.array([1.5, -2.0, -9.2])
    f *= 9.9 / np.linalg.norm(f)
    est = Estimator("ahrs", FIELD)
    state = est.step(0.0, (0.0, 0.0, 0.0), tup(f))
    for i in range(1, 400):
        state = est.step(0.01 * i, (0.0, 0.0, 0.0), tup(f))
        if state.aligned:
            break
    yaw, pitch, roll = scipy_of(state.q_nb).as_euler("ZYX")
    assert roll == pytest.approx(math.atan2(2.0, 9.2), abs=1e-12)
    assert pitch == pytest.approx(math.atan2(1.5, math.hypot(2.0, 9.2)), abs=1e-12)
    assert yaw == pytest.approx(0.0, abs=1e-12)
    assert state.t > 2.0  # it waited for a compass that never spoke
    d = scipy_of(state.q_nb).as_matrix()[2]
    assert math.sqrt(d @ state.P[:3, :3] @ d) == pytest.approx(60.0 * DEG, rel=1e-3)


# Level and compass, the kernel


def kernel(attitude: Rotation, a_n: FloatArray, field_known: bool = True) -> tuple[Rotation, bool, Any]:
    """Alignment from exact means: attitude, whether the compass passed, and the state record."""
    S, PRM = np.zeros(1, layout(0)), np.zeros(1, PARAMETERS)
    s, prm = (S[0], PRM[0]) if COMPILED else (S.view(np.recarray)[0], PRM.view(np.recarray)[0])
    s["gravity"] = G
    s["field"][:] = 0.05, 1.1 if field_known else 0.0, 48.0 if field_known else 0.0
    s["has_field"] = int(field_known)
    prm["field_tolerance_strength"], prm["field_tolerance_dip"] = 0.35, 20.0 * DEG
    C = attitude.as_matrix()
    f_b, m_b = C.T @ (a_n - np.array([0.0, 0.0, G])), C.T @ FIELD_N
    *q, passed = level_and_compass(s, prm, tup(f_b), tup(a_n), tup(m_b), True)  # type: ignore[arg-type]
    return scipy_of(np.array(q)), passed, s


def accelerations() -> list[tuple[Rotation, FloatArray]]:
    rng = np.random.default_rng(5)
    return [(Rotation.random(random_state=rng), rng.uniform(-7.0, 7.0, 3)) for _ in range(40)]


def test_attitude_in_motion_is_exact_with_exact_means() -> None:
    for attitude, a_n in accelerations():
        q, _, _ = kernel(attitude, a_n)
        assert (attitude.inv() * q).magnitude() < 1e-9


def test_clean_compass_passes_its_tests_in_any_motion() -> None:
    """The dip of a vehicle that accelerates is the field's angle to the vertical, not to the specific force."""
    passed = [kernel(attitude, a_n)[1] for attitude, a_n in accelerations()]
    assert sum(passed) == len(passed), f"{len(passed) - sum(passed)} of {len(passed)} clean compasses refused"


def test_field_learnt_in_motion_has_the_true_dip() -> None:
    """Where no field is known it is learnt right or not at all: its dip is against the vertical, which specific force is not here."""
    for attitude, a_n in accelerations()[:10]:
        _, _, s = kernel(attitude, a_n, field_known=False)
        if s["has_field"]:
            assert float(s["field"][1]) == pytest.approx(1.1, abs=1.0 * DEG)


# In motion


def flight_kind(solution: Solution) -> int:
    assert solution.events[0]["kind"] == "aligned"
    return int(solution.events[0]["statistic"])


def first_error(solution: Solution, flight: FlightLog) -> FloatArray:
    """δθ of the first row, body frame."""
    truth = flight["truth"]
    i = int(np.argmin(np.abs(truth.t - solution.t[0])))
    q = np.array([truth[f"q_{a}"][i] for a in "wxyz"])
    return np.asarray((scipy_of(solution.vector("q", "wxyz")[0]).inv() * scipy_of(q)).as_rotvec())


def last_yaw_error(solution: Solution, flight: FlightLog) -> float:
    """RMS over the last five seconds [rad]."""
    t, e = error_series(solution, flight["truth"])["yaw"]
    return float(np.sqrt(np.mean(e[t > t[-1] - 5.0] ** 2)))


def airborne_log(seed: int, begin: float) -> FlightLog:
    """A flight whose log begins in the air, in the middle of its manoeuvres."""
    flight = demo_flight(seed, 50.0, imu_rate=100.0)
    return FlightLog({name: stream.where(stream.t >= begin) for name, stream in flight.streams.items()}, flight.meta)


@pytest.fixture(scope="module", params=[(1, 13.0), (2, 17.0), (3, 13.0), (4, 17.0), (6, 17.0), (8, 13.0)], ids=str)
def airborne(request: pytest.FixtureRequest) -> tuple[FlightLog, Solution]:
    flight = airborne_log(*request.param)
    return flight, run(flight)


def test_in_motion_attitude_is_as_good_as_it_claims(airborne: tuple[FlightLog, Solution]) -> None:
    """Accelerating and turning from the first sample: within the 10 degrees that tilt and yaw claim each, and no error beyond 4 sigma."""
    flight, solution = airborne
    assert flight_kind(solution) == IN_MOTION
    assert solution.t[0] < flight["imu"].t[0] + 4.0
    error = first_error(solution, flight)
    assert float(np.linalg.norm(error)) < 10.0 * DEG
    P = solution.covariance["attitude"][0]
    assert solution.covariance["t"][0] == solution.t[0]
    assert error @ np.linalg.solve(P, error) < 16.0
    velocity = np.array([solution[f"vel_{a}"][0] - np.interp(solution.t[0], flight["truth"].t, flight["truth"][f"vel_{a}"]) for a in "ned"])
    assert np.abs(velocity / solution.vector("sd_vel", "ned")[0]).max() < 4.0
    assert last_yaw_error(solution, flight) < 3.0 * DEG


def test_good_compass_in_motion_gives_a_known_yaw(airborne: tuple[FlightLog, Solution]) -> None:
    """Yaw from a compass that passed its tests is known to 10 degrees, so about the vertical it claims not 60."""
    _, solution = airborne
    d = scipy_of(solution.vector("q", "wxyz")[0]).as_matrix()[2]
    assert math.sqrt(d @ solution.covariance["attitude"][0] @ d) < 20.0 * DEG


def cruise(speed: float, shake: float, *, duration: float = 20.0, accuracy: float | None = None) -> FlightLog:
    """Level and straight northwards at constant speed, with a quiet or a shaken IMU."""
    rng = np.random.default_rng(9)
    t, tg = np.arange(0.0, duration, 0.01), np.arange(0.0, duration, 0.2)
    gyro = shake * 0.02 * rng.standard_normal((len(t), 3))
    accel = np.array([0.0, 0.0, -G]) + shake * 0.3 * rng.standard_normal((len(t), 3))
    lat, lon, alt = geodetic_from_local(speed * tg, 0.0 * tg, 0.0 * tg, 46.8, 8.2, 600.0)
    gnss = {"t": tg, "lat": lat, "lon": lon, "alt": alt}
    gnss |= {f"vel_{a}": v + 0.1 * rng.standard_normal(len(tg)) for a, v in (("n", speed), ("e", 0.0), ("d", 0.0))}
    if accuracy is not None:
        gnss["s_acc"] = np.full(len(tg), accuracy)
    return FlightLog({"imu": {"t": t} | columns("gyro", gyro) | columns("accel", accel), "gnss": gnss})


@pytest.mark.parametrize("shake", [0.5, 2.0])
def test_steady_cruise_aligns_whether_it_shakes_or_not(shake: float) -> None:
    """At 8 m/s without acceleration, which to an IMU is rest: GNSS says that it is not, and alignment is in motion."""
    solution = run(cruise(8.0, shake))
    assert flight_kind(solution) == IN_MOTION
    assert solution["vel_n"][-1] == pytest.approx(8.0, abs=1.0)


@pytest.mark.parametrize("accuracy", [0.3, None])
def test_smooth_drift_that_gnss_sees_is_not_rest(accuracy: float | None) -> None:
    """At 2 m/s, as smooth as rest: every fix says 2 m/s, so the velocity at the end is not zero."""
    solution = run(cruise(2.0, 0.5, accuracy=accuracy))
    assert solution["vel_n"][-1] == pytest.approx(2.0, abs=1.0)


@pytest.mark.parametrize("accuracy", [0.05, 0.1, 0.2, 0.5])
def test_gentle_departure_that_gnss_sees_ends_rest(accuracy: float) -> None:
    """Six seconds at rest, then 0.3 m/s² up to 3 m/s, as smooth as rest: every fix says so, however good the receiver."""
    rng = np.random.default_rng(9)
    t, tg = np.arange(0.0, 40.0, 0.01), np.arange(0.0, 40.0, 0.2)
    speed = np.clip(0.3 * (t - 6.0), 0.0, 3.0)
    accel = np.column_stack([np.gradient(speed, 0.01), 0.0 * t, 0.0 * t - G]) + 0.1 * rng.standard_normal((len(t), 3))
    way, zero = np.interp(tg, t, np.cumsum(speed) * 0.01), np.zeros(len(tg))
    lat, lon, alt = geodetic_from_local(way, zero, zero, 46.8, 8.2, 600.0)
    gnss = {"t": tg, "lat": lat, "lon": lon, "alt": alt, "s_acc": zero + accuracy}
    gnss |= {
        f"vel_{a}": v + 0.7 * accuracy * rng.standard_normal(len(tg)) for a, v in (("n", np.interp(tg, t, speed)), ("e", zero), ("d", zero))
    }
    imu = {"t": t} | columns("gyro", 0.008 * rng.standard_normal((len(t), 3))) | columns("accel", accel)
    solution = run(FlightLog({"imu": imu, "gnss": gnss}))
    assert flight_kind(solution) == AT_REST
    assert solution["vel_n"][-1] == pytest.approx(3.0, abs=1.0)


# Yaw without a compass, and against a wrong one


def turned(flight: FlightLog, angle: float) -> FlightLog:
    """The same flight turned about the vertical through home: nothing that an IMU sees has changed, and there is no compass."""
    c, s = math.cos(angle), math.sin(angle)
    streams = {k: dict(v.columns) for k, v in flight.streams.items() if k in ("imu", "gnss", "truth")}
    R = np.array([[c, -s], [s, c]])
    for name in ("gnss", "truth"):
        x = streams[name]
        x["vel_n"], x["vel_e"] = R @ np.array([x["vel_n"], x["vel_e"]])
    metres = 111195.0 * np.array([[1.0], [math.cos(HOME.lat * DEG)]])  # equal scales before and after: a turn of a sphere's tangent
    g = streams["gnss"]
    north_east = R @ (metres * np.array([g["lat"] - HOME.lat, g["lon"] - HOME.lon]))
    g["lat"], g["lon"] = np.array([[HOME.lat], [HOME.lon]]) + north_east / metres
    x = streams["truth"]
    q = Rotation.from_rotvec([0.0, 0.0, angle]) * Rotation.from_quat(np.column_stack([x[f"q_{a}"] for a in "xyzw"]))
    for a, column in zip("xyzw", q.as_quat().T, strict=True):
        x[f"q_{a}"] = column
    for name in ("pos_n", "pos_e", "lat", "lon", "alt", "pos_d"):
        del x[name]
    return FlightLog(streams, flight.meta)


@pytest.mark.parametrize("angle", [0.0, 90.0, 180.0, -120.0])
def test_without_compass_yaw_comes_with_the_first_manoeuvre(angle: float) -> None:
    """From rest, whichever way it points: 60 degrees at first, within 3 after the flight, and honest about it."""
    flight = turned(demo_flight(1, 40.0, imu_rate=100.0), angle * DEG)
    solution = run(flight)
    assert flight_kind(solution) == AT_REST
    assert solution["sd_yaw"][0] == pytest.approx(60.0 * DEG, rel=0.02)
    bank = any(e["kind"] == "reset" and e["sensor"] == "gnss" and "yaw" in e["evidence"] for e in solution.events)
    assert bank or solution["sd_yaw"][-1] < 5.0 * DEG
    if abs(angle) == 180.0:
        assert bank  # nothing else turns the filter round
    assert last_yaw_error(solution, flight) < 3.0 * DEG
    assert last_yaw_error(solution, flight) < 4.0 * float(solution["sd_yaw"][-1])


@pytest.mark.parametrize(("seed", "begin", "angle"), [(3, 13.0, 180.0), (6, 17.0, -90.0), (5, 17.0, 180.0), (10, 17.0, -90.0)])
def test_without_compass_in_motion_yaw_is_found(seed: int, begin: float, angle: float) -> None:
    """From two turns of GNSS velocity at alignment, or by the bank soon after; until then yaw is called unknown."""
    flight = turned(airborne_log(seed, begin), angle * DEG)
    solution = run(flight)
    kind = flight_kind(solution)
    assert kind in (IN_MOTION, TWO_SPANS)
    assert (solution["sd_yaw"][0] > 45.0 * DEG) == (kind == IN_MOTION)
    error = first_error(solution, flight)
    assert math.sqrt(error @ np.linalg.solve(solution.covariance["attitude"][0], error)) < 4.0
    assert last_yaw_error(solution, flight) < 3.0 * DEG


@pytest.mark.parametrize(("seed", "begin", "angle"), [(3, 13.0, 225.0), (9, 13.0, 270.0), (4, 17.0, 270.0)])
def test_without_compass_in_motion_yaw_is_found_or_said_to_be_unknown(seed: int, begin: float, angle: float) -> None:
    """Starts far from the true yaw: after half a minute of manoeuvres it is found, or at least no error is beyond 4 sigma."""
    flight = turned(airborne_log(seed, begin), angle * DEG)
    solution = run(flight)
    error, claimed = last_yaw_error(solution, flight), float(solution["sd_yaw"][-1])
    assert error < max(3.0 * DEG, 4.0 * claimed)


@pytest.mark.parametrize("angle", [90.0, 180.0])
def test_unknown_yaw_in_motion_is_a_turn_about_the_specific_force(angle: float) -> None:
    """Without compass the mean force is matched, so that the unknown turn is about it, not about the vertical.

    A turn of half the circle is three of 60 degrees; with it tilt is off by twice the angle of the force to the vertical, which
    must not be claimed to be known to 10 degrees.
    """
    flight = turned(airborne_log(4, 17.0), angle * DEG)
    solution = run(flight)
    error = first_error(solution, flight)
    assert math.sqrt(error @ np.linalg.solve(solution.covariance["attitude"][0], error)) < 4.0


def test_demo_flight_that_begins_in_the_air_is_one_that_could_be_flown() -> None:
    """No more than 2.5 times the force of gravity and 40 m/s, as with a start from the ground."""
    for rest in (4.0, 0.0):
        flight = demo_flight(1, 40.0, imu_rate=50.0, rest=rest)
        assert float(np.linalg.norm(flight["imu"].vector("accel"), axis=1).max()) < 2.5 * G, f"rest={rest}"
        assert float(np.linalg.norm(flight["truth"].vector("vel", "ned"), axis=1).max()) < 40.0, f"rest={rest}"


@pytest.mark.parametrize("degrees", [50.0, 135.0, 230.0, 300.0])
def test_turned_compass_is_found_out(degrees: float) -> None:
    """A compass mounted askew passes every test of the field, and the door, which knows whole axes; GNSS velocity convicts it."""
    flight = demo_flight(3, 40.0, imu_rate=100.0)
    streams: dict[str, Any] = dict(flight.streams)
    m = dict(flight["magnetometer"].columns)
    c, s = math.cos(degrees * DEG), math.sin(degrees * DEG)
    m["mag_x"], m["mag_y"] = c * m["mag_x"] + s * m["mag_y"], c * m["mag_y"] - s * m["mag_x"]
    streams["magnetometer"] = m
    solution = run(FlightLog(streams, flight.meta))
    start = float(error_series(solution, flight["truth"])["yaw"][1][0])
    assert abs(wrap(start - degrees * DEG)) < 15.0 * DEG  # at first it is believed
    assert last_yaw_error(solution, flight) < 3.0 * DEG
    assert solution.summary["health"]["magnetometer"]["verdict"] == "bad"
    assert any(e["kind"] == "reset" and e["sensor"] == "gnss" for e in solution.events)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_compass_turned_by_whole_quarters_does_not_pass_the_door(quarters: int) -> None:
    """It turns unlike the gyro: it is left out, named with the key that puts it right, and the heading comes from GNSS velocity."""
    flight = demo_flight(3, 40.0, imu_rate=100.0)
    m = dict(flight["magnetometer"].columns)
    for _ in range(quarters):
        m["mag_x"], m["mag_y"] = m["mag_y"], -m["mag_x"]
    streams: dict[str, Any] = {**flight.streams, "magnetometer": m}
    solution = run(FlightLog(streams, flight.meta))
    assert "--set axes.magnetometer=" in " ".join(solution.summary["warnings"])
    assert last_yaw_error(solution, flight) < 3.0 * DEG
    word = ("RBD", "BLD", "LFD")[quarters - 1]
    cured = run(FlightLog(streams, flight.meta), set={"axes.magnetometer": word})
    assert cured.summary["health"]["magnetometer"]["verdict"] == "good"
    assert last_yaw_error(cured, flight) < 1.5 * DEG


# Gravity alone


def shaken(duration: float, attitude: Rotation) -> FlightLog:
    """Held at one attitude and shaken by a motor, 1 m/s² and 0.1 rad/s, so that it is never at rest."""
    t = np.arange(0.0, duration, 0.005)
    waves = np.column_stack([np.sin(2.0 * math.pi * hertz * t + phase) for hertz, phase in ((17.0, 0.0), (23.0, 1.0), (31.0, 2.0))])
    C = attitude.as_matrix()
    accel = C.T @ np.array([0.0, 0.0, -G]) + waves
    gyro = np.array([0.004, -0.006, 0.003]) + 0.1 * waves[:, [1, 2, 0]]
    mag = np.tile(C.T @ FIELD_N, (len(t[::4]), 1))
    return FlightLog(
        {
            "imu": {"t": t} | columns("gyro", gyro) | columns("accel", accel),
            "magnetometer": {"t": t[::4]} | columns("mag", mag),
        },
        FlightMeta(field={k.partition(".")[2]: v for k, v in FIELD.items()}),
    )


@pytest.mark.parametrize("name", ["ahrs", "navigator"])
def test_shaken_and_without_gnss_gravity_alone_must_do(name: str) -> None:
    """The mean over a second of these waves leaves less than 1/(2π 17) of their 1 m/s²; the gyro's bias turns 0.4 deg a second."""
    attitude = Rotation.from_euler("ZYX", [2.0, -0.4, 0.3])
    solution = run(shaken(8.0, attitude), name)
    assert flight_kind(solution) == GRAVITY_ONLY
    assert 5.0 < solution.t[0] < 6.5
    error = (attitude.inv() * scipy_of(solution.vector("q", "wxyz")[0])).as_rotvec()
    assert float(np.linalg.norm(error)) < 2.0 * DEG
    assert solution["sd_pitch"][0] == pytest.approx(math.hypot(10.0 * DEG, 0.2 / G), rel=0.05)
    end = (attitude.inv() * scipy_of(solution.vector("q", "wxyz")[-1])).as_rotvec()
    assert float(np.linalg.norm(end)) < 3.0 * DEG


@pytest.mark.parametrize("name", ["ahrs", "navigator"])
def test_nothing_to_align_on_says_so(name: str) -> None:
    with pytest.raises(HaltereError, match=r"alignment.*at rest.*GNSS velocity.*found 4\.0 s.*longer stretch"):
        run(shaken(4.0, Rotation.identity()), name)


def test_first_fix_after_alignment_leaves_the_barometer_trusted() -> None:
    """Online, home not known: ten seconds at rest 600 m above sea level with a barometer, then GNSS sets the origin.

    The offset counts from the origin. When that changes by 600 m, so must the offset, or every sample after it is refused.
    """
    rng = np.random.default_rng(0)
    est = Estimator("navigator")
    for i in range(2000):
        t = 0.01 * i
        if i % 4 == 0:
            est.offer("barometer", t, [94322.0 + 2.0 * rng.standard_normal()])
        if i % 20 == 0 and t > 10.0:
            est.offer("gnss", t, [46.8, 8.2, 600.0 + rng.standard_normal(), *(0.1 * rng.standard_normal(3))])
        est.step(t, tup(0.003 * rng.standard_normal(3)), tup(np.array([0.0, 0.0, -9.807]) + 0.03 * rng.standard_normal(3)))
    records = est.records()
    after = records[(records["sensor"] == BAROMETER) & (records["t"] > 10.5)]
    assert len(after) > 200
    assert (after["status"] == FUSED).mean() > 0.95


@pytest.mark.parametrize("begin", [-10.0, 0.0, 1e6])
def test_a_given_state_takes_the_place_of_alignment_at_any_time(begin: float) -> None:
    """At rest from a given state, five seconds, also at times before zero: the aids of rest hold velocity within theirs of 0.05 m/s."""
    P = np.diag(np.repeat([0.05, 0.3, 1.0, 0.01, 0.2], 3) ** 2)
    zero = np.zeros(3)
    est = Estimator("ahrs", initial=InitialState(begin, np.array([1.0, 0.0, 0.0, 0.0]), zero, zero, zero, zero, P))
    for k in range(500):
        state = est.step(begin + 0.01 * k, (0.001 * (k % 3), 0.0, 0.0), (0.0, 0.0, -G + 0.01 * (k % 2)))
        assert state.aligned
    assert np.sqrt(np.diag(state.P)[3:6]).max() < 0.1
    assert len(est.records()) > 100


def test_alignment_begins_anew_after_a_long_gap() -> None:
    """Ten seconds without IMU are not bridged: aligned, gap, realigned, and no row in between."""
    flight = demo_flight(4, 40.0, imu_rate=100.0)
    imu = flight["imu"]
    streams: dict[str, Any] = dict(flight.streams)
    streams["imu"] = imu.where((imu.t < 15.0) | (imu.t > 25.0))
    solution = run(FlightLog(streams, flight.meta))
    kinds = [e["kind"] for e in solution.events]
    assert kinds[:3] == ["aligned", "gap", "realigned"]
    assert solution.events[1]["statistic"] == pytest.approx(10.0, abs=0.05)
    assert not ((solution.t > 15.0) & (solution.t < 25.5)).any()
    assert last_yaw_error(solution, flight) < 3.0 * DEG
