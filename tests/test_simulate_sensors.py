"""Simulated magnetometer, GNSS, barometer, air data, rotor speeds and power against what their parameters say; clocks and seeds."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from haltere.simulate import Scenario, simulate
from haltere.simulate.parts import SENSORS, sensor
from haltere.simulate.sensors import sense
from haltere.simulate.simulator import simulate_truth
from haltere.simulate.truth import Truth
from made_truth import FIELD, allan_band, allan_variance, at_rest, has_variance, streams, tumbling, xyz

# --- magnetometer --------------------------------------------------------------------------------------------------------


def test_magnetometer_noise_and_walk() -> None:
    truth = at_rest(4000.0, 50.0)
    for preset in ("clean", "iris", "near-power"):
        p = sensor("magnetometer", {"preset": preset, "hard_iron": 0.0, "soft_iron": 0.0, "current": 0.0})
        m = xyz(sense(truth, {"magnetometer": p}, 3)[0]["magnetometer"], "mag")
        for tau in (0.1, 1.0, 10.0, 60.0):
            wanted = (p["noise"] ** 2 + p["resolution"] ** 2 / 12.0) / (p["rate"] * tau) + p["walk"] ** 2 * tau / 3.0
            low, high = allan_band(4000.0 / tau)
            found = allan_variance(m, round(tau * p["rate"]))
            assert np.all((low * wanted < found) & (found < high * wanted)), (preset, tau)


def test_magnetometer_measures_the_earth_s_field() -> None:
    d, i = FIELD.declination, FIELD.dip
    m_n = 48.0 * np.array([math.cos(i) * math.cos(d), math.cos(i) * math.sin(d), math.sin(i)])
    truth = tumbling(500, 50.0)
    out, _ = streams(truth)
    rows = 1 + np.arange(len(out["magnetometer"]["t"]))  # the first sample comes one period after the start
    C = Rotation.from_quat(truth.q_nb[rows][:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(xyz(out["magnetometer"], "mag"), np.einsum("nji,j->ni", C, m_n), atol=1e-9)


def test_magnetometer_iron_current_and_throttle_by_regression() -> None:
    truth = tumbling(600, 50.0)
    hard, soft = [], []
    for seed in range(40):
        out, _ = streams(truth, seed, magnetometer={"hard_iron": 6.0, "soft_iron": 0.04, "current": 0.3, "throttle": 5.0})
        rows = 1 + np.arange(len(out["magnetometer"]["t"]))
        C = Rotation.from_quat(truth.q_nb[rows][:, [1, 2, 3, 0]]).as_matrix()
        field = np.einsum("nji,j->ni", C, truth.field_n)
        A = np.column_stack([field, np.ones(len(rows)), truth.current[rows], truth.command[rows].mean(axis=1)])
        m = xyz(out["magnetometer"], "mag")
        fit = np.linalg.lstsq(A, m, rcond=None)[0]
        assert np.abs(A @ fit - m).max() < 1e-8
        soft.append((fit[:3] - np.eye(3)) / 0.04)
        hard.append(fit[3] / 6.0)
        assert np.linalg.norm(fit[4]) == pytest.approx(0.3, abs=1e-8)
        assert np.linalg.norm(fit[5]) == pytest.approx(5.0, abs=1e-6)
    assert has_variance(np.array(hard), 1.0)
    assert has_variance(np.array(soft), 1.0)


# --- GNSS ----------------------------------------------------------------------------------------------------------------


def gnss_errors(truth: Truth, p: dict, seed: int = 1) -> tuple[np.ndarray, np.ndarray, dict]:
    """Errors of position [m] and velocity of GNSS, and its stream; the truth stands at home."""
    from pymap3d import geodetic2ned

    out, _ = streams(truth, seed, gnss=p)
    g = out["gnss"]
    pos = np.column_stack(geodetic2ned(g["lat"], g["lon"], g["alt"], truth.home.lat, truth.home.lon, truth.home.alt))
    return pos, xyz(g, "vel", "ned"), g


def test_gnss_white_errors() -> None:
    pos, vel, g = gnss_errors(at_rest(2000.0, 10.0), {"h_noise": 0.7, "v_noise": 1.3, "s_noise": 0.12})
    assert has_variance(pos[:, :2], 0.7**2)
    assert has_variance(pos[:, 2], 1.3**2)
    assert has_variance(vel, 0.12**2)
    assert np.abs(np.mean(pos[1:] * pos[:-1], axis=0) / np.var(pos, axis=0)).max() < 5.0 / math.sqrt(len(pos))
    assert (g["h_acc"][0], g["v_acc"][0], g["s_acc"][0]) == (0.7, 1.3, 0.12)
    assert np.all(g["fix_type"] == 3.0)


def test_gnss_correlated_errors_are_a_gauss_markov_process() -> None:
    """Variance and correlation time, by the exact one-step law x' = a x + sqrt(1 - a^2) sd w, whose w are independent."""
    pos, vel, g = gnss_errors(at_rest(4000.0, 5.0), {"rate": 5.0, "h_drift": 1.1, "v_drift": 2.0, "s_drift": 0.2, "drift_time": 40.0})
    for x, sd, tau in ((pos[:, 0], 1.1, 40.0), (pos[:, 2], 2.0, 40.0), (vel[:, 1], 0.2, 4.0)):
        a = math.exp(-0.2 / tau)
        w = (x[1:] - a * x[:-1]) / (sd * math.sqrt(1.0 - a * a))
        assert has_variance(w, 1.0)
        assert abs(np.mean(w[1:] * w[:-1])) < 5.0 / math.sqrt(len(w))
        independent = 4000.0 / (2.0 * tau)
        assert np.var(x) == pytest.approx(sd**2, rel=4.5 * math.sqrt(2.0 / independent))
    assert g["h_acc"][0] == pytest.approx(1.1)


def test_gnss_first_errors_have_the_stationary_spread() -> None:
    truth = at_rest(1.0, 10.0)
    first = np.array([gnss_errors(truth, {"h_drift": 1.5, "drift_time": 40.0}, seed)[0][0, :2] for seed in range(300)])
    assert has_variance(first, 1.5**2)


def test_gnss_accuracies_say_what_the_errors_are() -> None:
    q = sensor("gnss", {"preset": "consumer"})
    quiet = {"h_noise": q["h_noise"], "v_noise": q["v_noise"], "s_noise": q["s_noise"]}
    pos, vel, g = gnss_errors(at_rest(20000.0, 5.0), {"preset": "consumer", "dropouts": 0.0, "multipath": 0.0, **quiet})
    for x, said, tau in ((pos[:, :2], g["h_acc"][0], 60.0), (pos[:, 2:], g["v_acc"][0], 60.0), (vel, g["s_acc"][0], 6.0)):
        independent = 20000.0 / (2.0 * tau) * x.shape[1]
        assert np.mean(x**2) == pytest.approx(said**2, rel=4.5 * math.sqrt(2.0 / independent))
    cautious = gnss_errors(at_rest(1.0, 10.0), {"h_noise": 1.0, "reported": 2.5})[2]
    assert cautious["h_acc"][0] == 2.5


def test_gnss_antenna_arm() -> None:
    truth = tumbling(400, 10.0)
    truth = dataclasses.replace(truth, pos_n=np.zeros((400, 3)), vel_n=np.zeros((400, 3)))
    arm = np.array([0.1, -0.05, -0.2])
    pos, vel, _ = gnss_errors(truth, {"arm_x": 0.1, "arm_y": -0.05, "arm_z": -0.2})
    rows = 1 + np.arange(len(pos))
    C = Rotation.from_quat(truth.q_nb[rows][:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(pos, np.einsum("nij,j->ni", C, arm), atol=1e-6)
    np.testing.assert_allclose(vel, np.einsum("nij,nj->ni", C, np.cross(truth.gyro_b[rows], arm)), atol=1e-12)


def test_gnss_position_is_on_the_ellipsoid() -> None:
    truth = tumbling(400, 10.0)
    pos, _, _ = gnss_errors(truth, {})
    np.testing.assert_allclose(pos, truth.pos_n[1 + np.arange(len(pos))], atol=3e-3)  # the plane bends by d^2 / 2R


def test_gnss_dropouts_come_at_their_rate_and_length() -> None:
    truth = at_rest(60000.0, 5.0)
    _, _, g = gnss_errors(truth, {"rate": 5.0, "dropouts": 0.5, "dropout_length": 4.0})
    lost = g["fix_type"] == 0.0
    assert np.isnan(g["lat"][lost]).all()
    assert np.isfinite(g["lat"][~lost]).all()
    # Poisson beginnings, exponential lengths: the share of time inside any is 1 - exp(-rate x length)
    share = 1.0 - math.exp(-0.5 / 60.0 * 4.0)
    expected = 60000.0 * 0.5 / 60.0
    assert lost.mean() == pytest.approx(share, rel=4.5 * math.sqrt(2.0 / expected))
    begins = np.sum(np.diff(lost.astype(int)) == 1)
    assert begins == pytest.approx(
        expected * (1 - share), abs=4.5 * math.sqrt(expected) + 0.05 * expected
    )  # a short one falls between fixes


def test_gnss_multipath_steps_have_their_size() -> None:
    truth = at_rest(60000.0, 5.0)
    pos, vel, _ = gnss_errors(truth, {"rate": 5.0, "multipath": 0.3, "multipath_size": 4.0})
    moved = np.abs(pos).max(axis=1) > 1e-6
    sizes = np.unique(np.round(pos[moved], 5), axis=0)
    assert len(sizes) == pytest.approx(300, abs=4.5 * math.sqrt(300))
    assert has_variance(sizes, 16.0)
    assert moved.mean() == pytest.approx(1.0 - math.exp(-0.3 / 60.0 * 10.0), rel=4.5 * math.sqrt(2.0 / 300))
    assert not vel.any()


# --- barometer, air data, rotors, power ----------------------------------------------------------------------------------


def height(pressure: np.ndarray) -> np.ndarray:
    return np.asarray(44330.77 * (1.0 - (pressure / 101325.0) ** 0.190263))


def test_barometer_noise_offset_and_walk() -> None:
    truth = at_rest(2000.0, 25.0)
    out, biases = streams(truth, barometer={"noise": 0.4})
    error = height(out["barometer"]["pressure"]) - 600.0
    assert has_variance(error, 0.4**2)
    assert not biases["baro_bias"].any()
    out, biases = streams(truth, barometer={"walk": 0.07})
    np.testing.assert_allclose(
        height(out["barometer"]["pressure"]) - 600.0, biases["baro_bias"][1 : 1 + len(out["barometer"]["t"])], atol=1e-6
    )
    assert has_variance(np.diff(biases["baro_bias"][1:]), 0.07**2 / 25.0)
    short = at_rest(1.0, 25.0)
    first = [streams(short, seed, barometer={"offset": 2.5})[1]["baro_bias"][0] for seed in range(400)]
    assert has_variance(np.array(first), 2.5**2)


def test_barometer_is_sucked_by_the_wind() -> None:
    """At 10 m/s the dynamic pressure is 61 Pa: a port at -0.6 of it says 3.3 m too high near 600 m."""
    still = at_rest(2.0, 25.0)
    windy = dataclasses.replace(still, wind_n=np.tile([6.0, 8.0, 0.0], (len(still.t), 1)))
    out, _ = streams(windy, barometer={"wind": -0.6})
    dp = 0.6 * 0.5 * 1.225 * 100.0
    density = out["barometer"]["pressure"][0] / (287.05 * (288.15 - 0.0065 * 600.0))
    error = height(out["barometer"]["pressure"]) - 600.0
    assert np.all(error > 0.0)
    assert error[0] == pytest.approx(dp / (density * 9.80665), rel=0.01)
    coarse, _ = streams(windy, barometer={"wind": -0.6, "resolution": 10.0})
    np.testing.assert_allclose(coarse["barometer"]["pressure"] % 10.0, 0.0, atol=1e-9)


def test_airdata_is_the_flow_over_the_body() -> None:
    truth = tumbling(400, 50.0)
    out, _ = streams(truth, airdata={"rate": 50.0})
    rows = 1 + np.arange(len(out["airdata"]["t"]))
    C = Rotation.from_quat(truth.q_nb[rows][:, [1, 2, 3, 0]]).as_matrix()
    air = np.einsum("nji,nj->ni", C, truth.vel_n[rows] - truth.wind_n[rows])
    speed = np.linalg.norm(air, axis=1)
    np.testing.assert_allclose(out["airdata"]["airspeed"], speed, rtol=1e-12)
    np.testing.assert_allclose(np.tan(out["airdata"]["aoa"]) * air[:, 0], air[:, 2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.sin(out["airdata"]["sideslip"]) * speed, air[:, 1], atol=1e-9)
    noisy, _ = streams(truth, airdata={"rate": 50.0, "noise": 0.3, "angle_noise": 0.01})
    assert has_variance(noisy["airdata"]["aoa"] - out["airdata"]["aoa"], 0.01**2)
    scales = [streams(truth, s, airdata={"rate": 50.0, "scale": 0.05})[0]["airdata"]["airspeed"][0] / speed[0] - 1.0 for s in range(300)]
    assert has_variance(np.array(scales), 0.05**2)


def test_rotor_telemetry() -> None:
    truth = tumbling(3000, 50.0)
    out, _ = streams(truth, rotors={"noise": 2.0})
    rows = 1 + np.arange(len(out["rotors"]["t"]))
    assert has_variance(xyz(out["rotors"], "speed", "0123") - truth.speed[rows], 4.0)
    np.testing.assert_allclose(xyz(out["rotors"], "command", "0123"), truth.command[rows], atol=1e-12)
    out, _ = streams(truth, rotors={"resolution": 15.0, "dropouts": 0.2, "delay": 0.03})
    speed = xyz(out["rotors"], "speed", "0123")
    share = np.isnan(speed).mean()
    assert share == pytest.approx(0.2, abs=4.5 * math.sqrt(0.16 / speed.size))
    assert np.nanmax(np.abs(speed - truth.speed[rows])) <= 7.5 + 1e-9
    np.testing.assert_allclose(out["rotors"]["t"], truth.t[rows] + 0.03, atol=1e-12)


def test_power() -> None:
    truth = at_rest(500.0, 10.0)
    out, _ = streams(truth, power={"voltage_noise": 0.03, "current_noise": 0.2})
    assert has_variance(out["power"]["voltage"] - 12.0, 0.03**2)
    assert has_variance(out["power"]["current"] - 8.0, 0.2**2)
    without = dataclasses.replace(truth, voltage=None, current=None)
    assert "power" not in streams(without)[0]


# --- clocks, seeds -------------------------------------------------------------------------------------------------------


def test_delay_moves_stamps_not_values_and_is_told() -> None:
    one = Scenario(mission="hover", duration=20.0, sensors={"gnss": {"delay": 0.2}, "magnetometer": {"delay": 0.01}})
    a, b = simulate(one), simulate(one.changed(sensors={}))
    assert a.meta.delays == {"gnss": 0.2, "magnetometer": 0.01}
    assert b.meta.delays == {}
    np.testing.assert_allclose(a["gnss"].t - 0.2, b["gnss"].t, atol=1e-12)
    np.testing.assert_array_equal(a["gnss"]["vel_n"], b["gnss"]["vel_n"])


def test_jitter_has_its_size_and_never_turns_time_back() -> None:
    truth = at_rest(100.0, 250.0)
    out, _ = streams(truth, imu={"jitter": 2e-4}, gnss={"jitter": 0.003, "delay": 0.1})
    assert has_variance(out["imu"]["t"] - truth.t, 2e-4**2)
    assert np.all(np.diff(out["imu"]["t"]) > 0.0)
    assert has_variance(out["gnss"]["t"] - 0.1 - np.arange(1, 1 + len(out["gnss"]["t"])) / 10.0, 0.003**2)
    rough, _ = streams(truth, imu={"jitter": 6e-3})  # larger than the period: some stamps are those of the sample before
    assert np.all(np.diff(rough["imu"]["t"]) >= 0.0)


def test_repeated_stamps_are_counted_by_who_reads_them() -> None:
    from haltere.flight.door import check

    flight = simulate(Scenario(mission="hover", duration=20.0, sensors={"imu": {"jitter": 6e-3}}))
    repeated = int(np.sum(np.diff(flight["imu"].t) == 0.0))
    assert repeated > 100
    assert sum(check(flight).discarded["imu"].values()) == repeated


def test_one_sensor_s_parameters_change_no_other_s_numbers() -> None:
    truth = simulate_truth(Scenario(mission="hover", duration=15.0))
    plain = {name: sensor(name, {"rate": 50.0} if name != "imu" else None) for name in SENSORS}
    before, biases = sense(truth, plain, 4)
    for name in SENSORS:
        key = {"imu": "gyro_walk", "gnss": "h_drift", "power": "current_noise"}.get(name, "noise")
        for changed in ({key: 3.0 * plain[name][key] + 0.1}, {"jitter": 1e-4}, {"rate": 25.0} if name != "imu" else {"arm_x": 0.1}):
            after, _ = sense(truth, {**plain, name: {**plain[name], **changed}}, 4)
            for other in SENSORS:
                same = all(np.array_equal(before[other][c], after[other].get(c), equal_nan=True) for c in before[other])
                assert same == (other != name) or (changed == {"arm_x": 0.1} and same), (name, other, changed)
    assert biases
