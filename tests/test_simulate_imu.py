"""The simulated IMU against what its parameters say, and a truth that agrees with itself."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from haltere.simulate import Scenario, simulate
from haltere.simulate.imu import SECOND_HARMONIC
from haltere.simulate.parts import PARTS, sensor
from haltere.simulate.sensors import sense
from made_truth import HOME, allan_band, allan_variance, at_rest, has_variance, streams, tumbling, xyz


def test_allan_variance_of_this_test_is_right() -> None:
    """White noise of density N: N^2 / tau. A walk of density K: K^2 tau / 3. Worked out by hand for a ramp: (a tau)^2 / 2."""
    t = np.arange(4000)[:, None] * 0.01
    assert allan_variance(0.3 * t, 50)[0] == pytest.approx((0.3 * 0.5) ** 2 / 2)


@pytest.mark.parametrize("preset", PARTS["imu"])
def test_imu_has_the_allan_deviation_of_its_preset(preset: str) -> None:
    """At rest for an hour: white noise, quantisation and walk together at every cluster time, each axis within its band."""
    rate, duration = 200.0, 3600.0
    p = sensor("imu", {"preset": preset, "rate": rate, "warm_up": 0.0})
    out, _ = sense(at_rest(duration, rate), {"imu": p}, 7)
    for stem in ("gyro", "accel"):
        N, K, q = p[f"{stem}_noise"] * p["still"], p[f"{stem}_walk"], p[f"{stem}_resolution"]
        assert q < 2.0 * N * math.sqrt(rate)  # so that rounding is as good as white
        x = xyz(out["imu"], stem)
        for tau in (0.05, 0.2, 1.0, 5.0, 20.0, 60.0):
            wanted = (N**2 + q**2 / 12.0 / rate) / tau + K**2 * tau / 3.0
            low, high = allan_band(duration / tau)
            found = allan_variance(x, round(tau * rate))
            assert np.all((low * wanted < found) & (found < high * wanted)), (stem, tau)


def test_imu_noise_in_flight_is_the_full_density() -> None:
    truth = at_rest(60.0, 250.0, speed=500.0)
    out, _ = streams(truth, imu={"gyro_noise": 2e-3, "accel_noise": 0.04})
    assert has_variance(xyz(out["imu"], "gyro"), 250.0 * 2e-3**2)
    assert has_variance(xyz(out["imu"], "accel") - truth.force_b, 250.0 * 0.04**2)


def test_imu_white_noise_is_white_and_its_axes_are_independent() -> None:
    out, _ = streams(at_rest(200.0, 250.0), imu={"gyro_noise": 2e-3, "accel_noise": 0.04})
    x = np.column_stack([xyz(out["imu"], "gyro"), xyz(out["imu"], "accel")])
    x = (x - x.mean(axis=0)) / x.std(axis=0)
    bound = 5.0 / math.sqrt(len(x))
    assert np.abs(x.T @ x / len(x) - np.eye(6)).max() < bound
    for lag in (1, 2, 3, 10, 50):
        assert np.abs(np.mean(x[lag:] * x[:-lag], axis=0)).max() < bound


@pytest.mark.parametrize("preset", PARTS["imu"])
def test_turn_on_bias_is_spread_over_flights_and_told_in_the_truth(preset: str) -> None:
    p = sensor("imu", {"preset": preset, "gyro_noise": 0.0, "accel_noise": 0.0, "gyro_resolution": 0.0, "accel_resolution": 0.0})
    truth = at_rest(1.0, 100.0)
    first = {"gyro": [], "accel": []}
    for seed in range(300):
        out, biases = sense(truth, {"imu": p}, seed)
        first["gyro"].append([biases[f"gyro_bias_{a}"][0] for a in "xyz"])
        first["accel"].append([biases[f"accel_bias_{a}"][0] for a in "xyz"])
    for stem, drawn in first.items():
        assert has_variance(np.array(drawn), p[f"{stem}_turn_on"] ** 2)
    if p["gyro_scale"] == 0.0:  # nothing but the bias is left of what a gyro at rest says
        np.testing.assert_allclose(xyz(out["imu"], "gyro"), xyz(biases, "gyro_bias"), rtol=0.0, atol=1e-15)


def test_bias_walks_at_its_density() -> None:
    truth = at_rest(2000.0, 100.0)
    _, biases = streams(truth, imu={"gyro_walk": 3e-4, "accel_walk": 2e-3})
    for stem, K in (("gyro_bias", 3e-4), ("accel_bias", 2e-3)):
        steps = np.diff(xyz(biases, stem)[::100], axis=0)  # a second apart: independent
        assert has_variance(steps, K**2 * 1.0)


def test_scale_and_misalignment_by_regression() -> None:
    """A linear fit gives the matrix; over flights its elements have the spread of the parameters."""
    truth = tumbling(400, 100.0)
    diagonal, rest = [], []
    for seed in range(60):
        out, _ = streams(truth, seed, imu={"gyro_scale": 0.02, "gyro_misalignment": 0.01, "accel_scale": 0.03, "accel_misalignment": 0.005,
                                           "gyro_turn_on": 0.02, "accel_turn_on": 0.2})  # fmt: skip
        for stem, true, scale, angle in (("gyro", truth.gyro_b, 0.02, 0.01), ("accel", truth.force_b, 0.03, 0.005)):
            A = np.column_stack([true, np.ones(len(true))])
            fit, residual = np.linalg.lstsq(A, xyz(out["imu"], stem), rcond=None)[:2]
            assert np.all(residual < 1e-18 * len(true))
            M = fit[:3].T - np.eye(3)
            diagonal.append(np.diag(M) / scale)
            rest.append(M[~np.eye(3, dtype=bool)] / angle)
    assert has_variance(np.array(diagonal), 1.0)
    assert has_variance(np.array(rest), 1.0)


def test_lever_arm_is_the_closed_form_of_a_turn_table() -> None:
    """Turning at w about z, an IMU at [x, y, 0] feels -w^2 [x, y, 0], and dw/dt of it across."""
    still = at_rest(2.0, 100.0)
    w, w_dot = 4.0 + 0.5 * still.t, 0.5
    turning = dataclasses.replace(
        still,
        gyro_b=np.column_stack([0 * w, 0 * w, w]),
        gyro_dot_b=np.tile([0.0, 0.0, w_dot], (len(w), 1)),
        q_nb=np.column_stack(
            [np.cos(0.5 * (4 * still.t + 0.25 * still.t**2)), 0 * w, 0 * w, np.sin(0.5 * (4 * still.t + 0.25 * still.t**2))]
        ),
    )
    x, y, z = 0.05, -0.03, 0.02
    there = turning.moved(np.array([x, y, z]))
    felt = there.force_b - still.force_b
    np.testing.assert_allclose(felt, np.column_stack([-(w**2) * x - w_dot * y, -(w**2) * y + w_dot * x, 0 * w]), atol=1e-12)
    yaw = 4 * still.t + 0.25 * still.t**2
    np.testing.assert_allclose(there.pos_n[:, 0], np.cos(yaw) * x - np.sin(yaw) * y, atol=1e-12)
    np.testing.assert_allclose(there.vel_n[:, 0], w * (-np.sin(yaw) * x - np.cos(yaw) * y), atol=1e-12)
    out, _ = streams(there)
    np.testing.assert_allclose(xyz(out["imu"], "accel"), there.force_b, atol=1e-14)


def test_saturation_and_quantisation() -> None:
    truth = tumbling(2000, 100.0)
    p = {"gyro_range": 1.5, "accel_range": 8.0, "gyro_resolution": 0.01, "accel_resolution": 0.05}
    out, _ = streams(truth, imu=p)
    for stem, true, limit, step in (("gyro", truth.gyro_b, 1.5, 0.01), ("accel", truth.force_b, 8.0, 0.05)):
        x = xyz(out["imu"], stem)
        clipped = np.clip(true, -limit, limit)
        assert np.any(np.abs(true) > limit)
        assert np.abs(x - clipped).max() <= 0.5 * step + 1e-12
        np.testing.assert_allclose(x / step, np.round(x / step), atol=1e-9)


@pytest.mark.parametrize("rate", [1000.0, 100.0])
def test_vibration_is_a_line_at_each_rotor_or_at_its_alias(rate: float) -> None:
    """Rotors at 80 to 82 revolutions a second: lines there, and at twice, or where a slow IMU folds them."""
    truth = at_rest(60.0, rate, speed=500.0)
    truth = dataclasses.replace(truth, hover=500.0)
    sizes = []
    for seed in range(12):
        out, _ = streams(truth, seed, imu={"rate": rate, "gyro_vibration": 0.05, "accel_vibration": 2.0})
        x = np.column_stack([xyz(out["imu"], "gyro") / 0.05, (xyz(out["imu"], "accel") - truth.force_b) / 2.0])
        columns = []
        for r in range(4):
            for harmonic in (1, 2):
                hertz = harmonic * 500.0 * (1.0 + 0.01 * r) / (2.0 * math.pi)
                folded = abs((hertz + rate / 2) % rate - rate / 2)
                columns += [np.cos(2 * math.pi * folded * truth.t), np.sin(2 * math.pi * folded * truth.t)]
        A = np.column_stack(columns)
        fit = np.linalg.lstsq(A, x, rcond=None)[0]
        assert np.abs(x - A @ fit).max() < 1e-6  # nothing else is there
        grown = (1.0 + 0.01 * np.arange(4)) ** 2
        sizes.append(np.hypot(fit[0::2], fit[1::2]).reshape(4, 2, 6) / grown[:, None, None])
    size = np.array(sizes) / np.array([1.0, SECOND_HARMONIC])[:, None]
    assert size.min() >= 0.5 - 1e-6
    assert size.max() <= 1.5 + 1e-6
    assert size.mean() == pytest.approx(1.0, abs=5.0 / math.sqrt(12.0 * size.size))


def test_vibration_stops_with_the_motors() -> None:
    out, _ = streams(at_rest(2.0, 250.0), imu={"gyro_vibration": 0.05, "accel_vibration": 2.0})
    assert not xyz(out["imu"], "gyro").any()


def test_temperature_moves_the_bias() -> None:
    truth = at_rest(600.0, 50.0)
    slopes = []
    for seed in range(40):
        out, biases = streams(truth, seed, imu={"gyro_temperature": 1e-3, "warm_up": 12.0, "warm_up_time": 100.0})
        heat = out["imu"]["temperature"] - out["imu"]["temperature"][0]
        np.testing.assert_allclose(heat, 12.0 * (1.0 - np.exp(-truth.t / 100.0)), atol=1e-12)
        slope = biases["gyro_bias_x"][-1] / heat[-1]
        np.testing.assert_allclose(biases["gyro_bias_x"], slope * heat, atol=1e-8)
        np.testing.assert_allclose(out["imu"]["gyro_x"], biases["gyro_bias_x"], atol=1e-15)
        slopes += [biases[f"gyro_bias_{a}"][-1] / heat[-1] for a in "xyz"]
    assert has_variance(np.array(slopes), 1e-6)


# --- truth agrees with itself ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (0.06, -0.04, 0.03)])
def test_truth_integrates_to_itself(arm: tuple[float, float, float]) -> None:
    """Rates and specific force of the truth, integrated (coning by the mean rate, trapezoids), give its attitude, velocity, position."""
    from haltere.core.earth import gravity

    sensors = {"imu": {"rate": 1000.0, "arm_x": arm[0], "arm_y": arm[1], "arm_z": arm[2]}}
    flight = simulate(Scenario(mission="lissajous", duration=30.0, wind={"n": 4.0, "gust": 1.0}, rest=0.0, landing=False, sensors=sensors))
    s = flight["truth"]
    gyro, force, q = s.vector("gyro"), s.vector("force"), s.vector("q", "wxyz")
    dt = 1e-3
    # third order: the mean rate and the coning of two neighbouring rates
    turn = 0.5 * dt * (gyro[1:] + gyro[:-1]) + dt**2 / 12.0 * np.cross(gyro[:-1], gyro[1:])
    true = Rotation.from_quat(q[:, [1, 2, 3, 0]])
    at = true[0]
    worst = 0.0
    steps = Rotation.from_rotvec(turn)
    for k in range(len(turn)):
        at = at * steps[k]
        if k % 500 == 499:
            worst = max(worst, (at.inv() * true[k + 1]).magnitude())
    assert worst < 2e-5
    acc = true.apply(force) + np.array([0.0, 0.0, gravity(flight.meta.home.lat, flight.meta.home.alt)])
    vel, pos = s.vector("vel", "ned"), s.vector("pos", "ned")
    # the wind is held for a step, so the force jumps with each gust: what is left is of the order of dt times those jumps
    moved = vel[0] + np.vstack([np.zeros(3), np.cumsum(0.5 * dt * (acc[1:] + acc[:-1]), axis=0)])
    assert np.abs(moved - vel).max() < 5e-3
    gone = pos[0] + np.vstack([np.zeros(3), np.cumsum(0.5 * dt * (vel[1:] + vel[:-1]), axis=0)])
    assert np.abs(gone - pos).max() < 1e-4
    assert np.ptp(vel, axis=0).min() > 2.0


def test_truth_s_field_and_place_are_of_its_attitude_and_position() -> None:
    from pymap3d import geodetic2ned

    from haltere.flight.field import decimal_year, earth_field

    scenario = Scenario(mission="box", duration=60.0)
    s = simulate(scenario)["truth"]
    f = earth_field(HOME.lat, HOME.lon, HOME.alt, decimal_year(scenario.start_utc))
    m_n = f.strength * np.array([math.cos(f.dip) * math.cos(f.declination), math.cos(f.dip) * math.sin(f.declination), math.sin(f.dip)])
    C = Rotation.from_quat(s.vector("q", "wxyz")[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(s.vector("field"), np.einsum("nji,j->ni", C, m_n), atol=1e-9)
    assert 45.0 < f.strength < 52.0
    ned = np.column_stack(geodetic2ned(s["lat"], s["lon"], s["alt"], HOME.lat, HOME.lon, HOME.alt))
    np.testing.assert_allclose(ned, s.vector("pos", "ned"), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(s.vector("q", "wxyz"), axis=1), 1.0, atol=1e-12)
    assert np.all(np.sum(np.diff(s.vector("q", "wxyz"), axis=0) ** 2, axis=1) < 0.01)  # no jump of sign
