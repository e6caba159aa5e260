"""Is the reported uncertainty true? NEES over independent simulated flights, initial errors drawn from P0, matched noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from haltere.core.rotation import quat_from_rotvec
from haltere.drive import run
from haltere.estimators.base import InitialState
from haltere.flight.log import FlightLog
from haltere.metrics.attitude import multiply
from haltere.metrics.consistency import DOF, band, nees_series
from haltere.simulate import Scenario, demo_flight
from haltere.simulate.simulator import simulate

#: 1 sigma of the initial errors: attitude [rad], velocity [m/s], position [m], gyro bias [rad/s], accelerometer bias [m/s^2], offset [m].
SD = np.r_[np.radians([5.0, 5.0, 10.0]), np.full(3, 0.5), np.full(3, 1.0), np.full(3, 0.01), np.full(3, 0.2), 2.0]


#: The same of a simulated rotorcraft, whose IMU's turn-on biases are smaller.
SD_ROTORCRAFT = np.r_[SD[:9], np.full(3, 0.005), np.full(3, 0.1), SD[15]]


def _start(flight: FlightLog, rng: np.random.Generator, sd: NDArray[np.float64] = SD) -> InitialState:
    """Truth at the first sample, less an error drawn from P0. The biases' errors are the simulated biases themselves."""
    truth = flight["truth"]
    e = sd * rng.standard_normal(len(sd))
    return InitialState(
        t=float(flight["imu"].t[0]),
        q_nb=multiply(truth.vector("q", "wxyz")[0], np.array(quat_from_rotvec((-e[0], -e[1], -e[2])))),
        vel_n=truth.vector("vel", "ned")[0] - e[3:6],
        pos_n=truth.vector("pos", "ned")[0] - e[6:9],
        gyro_bias_b=np.zeros(3),
        accel_bias_b=np.zeros(3),
        P=np.diag(sd**2),
        baro_bias=0.0,
    )


def _mean_nees(flights: int, first_seed: int) -> tuple[dict[str, float], dict[str, float]]:
    nees: dict[str, list[float]] = {}
    nis: dict[str, list[float]] = {}
    for k in range(flights):
        flight = demo_flight(first_seed + k, 60.0, rest=0.0, gyro_bias_sd=0.01, accel_bias_sd=0.2)
        solution = run(flight, initial=_start(flight, np.random.default_rng([7, first_seed + k])))
        for block, (_, value) in nees_series(solution, flight["truth"]).items():
            nees.setdefault(block, []).append(float(value.mean()))
        for sensor, row in solution.summary["nis"].items():
            nis.setdefault(sensor, []).append(row["mean"])
    return {b: float(np.mean(v)) for b, v in nees.items()}, {s: float(np.mean(v)) for s, v in nis.items()}


def _rotorcraft(seed: int) -> FlightLog:
    """A minute of a rotorcraft in gusty wind, in the air from the start; its sensors have the noise that the filter is told."""
    mission = ("figure-eight", "box", "lissajous", "climb", "tour")[seed % 5]
    wind = {"n": 4.0, "e": 2.0, "gust": 1.0}
    scenario = Scenario(mission=mission, duration=60.0, seed=seed, rest=0.0, landing=False, tell_noise=True, wind=wind)
    return simulate(scenario)


def _rotorcraft_scores(flights: int, first_seed: int) -> tuple[dict[tuple[str, str], float], dict[str, list[float]]]:
    """Mean NEES of each block of filter and smoother, and the mean squares of their errors."""
    nees: dict[tuple[str, str], list[float]] = {}
    squares: dict[str, list[float]] = {}
    for k in range(first_seed, first_seed + flights):
        flight = _rotorcraft(k)
        solution = run(flight, initial=_start(flight, np.random.default_rng([7, k]), SD_ROTORCRAFT), smooth=True)
        assert solution.smoothed is not None
        for which, rows in (("filter", solution), ("smoother", solution.smoothed)):
            for block, (_, value) in nees_series(rows, flight["truth"]).items():
                nees.setdefault((which, block), []).append(float(value.mean()))
        for which, table in enumerate((solution.summary["errors"]["truth"], solution.summary["smoothed"]["errors"]["truth"])):
            for name, row in table.items():
                squares.setdefault(name, [0.0, 0.0])[which] += row["rms"] ** 2 / flights
    return {b: float(np.mean(v)) for b, v in nees.items()}, squares


@pytest.mark.parametrize(("flights", "first"), [(30, 500), pytest.param(200, 2000, marks=pytest.mark.slow)])
def test_nees_of_simulated_rotorcraft_is_inside_the_band(flights: int, first: int) -> None:
    """Every block of filter and smoother inside the 99.9 % χ² band of so many flights, and the smoother's errors smaller."""
    nees, squares = _rotorcraft_scores(flights, first)
    assert set(nees) >= {(which, block) for which in ("filter", "smoother") for block in DOF if block != "wind"}
    for (which, block), value in nees.items():
        low, high = band(DOF[block], float(flights), 0.999)
        assert low < value < high, (which, block, value, low, high)
    for name, (filtered, smoothed) in squares.items():
        assert smoothed < filtered, name


def test_the_band_catches_sensors_worse_than_the_filter_is_told() -> None:
    values: dict[str, list[float]] = {}
    for k in range(10):
        flight = _rotorcraft(900 + k)
        start = _start(flight, np.random.default_rng([8, k]), SD_ROTORCRAFT)
        told = {"noise.gyro": 4e-4, "noise.accel": 0.009, "noise.magnetometer": 0.3, "noise.barometer": 0.15}
        solution = run(flight, set=told, initial=start, smooth=True)
        assert solution.smoothed is not None
        for block, (_, value) in nees_series(solution.smoothed, flight["truth"]).items():
            values.setdefault(block, []).append(float(value.mean()))
    assert np.mean(values["attitude"]) > band(3.0, 10.0, 0.999)[1]
    assert np.mean(values["velocity"]) > band(3.0, 10.0, 0.999)[1]
    assert np.mean(values["accel_bias"]) > band(3.0, 10.0, 0.999)[1]


def test_nees_of_50_flights_is_inside_the_band() -> None:
    """Every block inside the 99.9 % χ² band of 50 independent flights (samples of one flight are not independent)."""
    nees, nis = _mean_nees(50, 500)
    assert set(nees) == set(DOF) - {"wind"}  # nothing in these flights feels the air
    for block, value in nees.items():
        low, high = band(DOF[block], 50.0, 0.999)
        assert low < value < high, (block, value, low, high)
    for sensor in ("gnss", "barometer", "magnetometer"):
        assert 0.93 < nis[sensor] < 1.07, (sensor, nis[sensor])


@pytest.mark.slow
def test_nees_of_200_flights_is_inside_the_band() -> None:
    nees, _ = _mean_nees(200, 2000)
    for block, value in nees.items():
        low, high = band(DOF[block], 200.0, 0.999)
        assert low < value < high, (block, value, low, high)


def test_the_check_can_fail() -> None:
    """A filter told half the noise is caught by the same band."""
    low, high = band(3.0, 10.0, 0.999)
    values = []
    for k in range(10):
        flight = demo_flight(900 + k, 40.0, rest=0.0, gyro_bias_sd=0.01, accel_bias_sd=0.2)
        lied = {"noise.gyro": 4e-4, "noise.accel": 0.009, "noise.gnss_velocity_min": 0.01}
        columns = dict(flight["gnss"].columns)
        columns["s_acc"] = columns["s_acc"] / 3.0
        flight.streams["gnss"] = type(flight["gnss"])(columns)
        solution = run(flight, set=lied, initial=_start(flight, np.random.default_rng([8, k])))
        values.append(float(nees_series(solution, flight["truth"])["velocity"][1].mean()))
    assert not low < np.mean(values) < high


@pytest.mark.parametrize("estimator", ["navigator", "ahrs"])
def test_a_heading_that_nothing_measures_stays_unknown(estimator: str) -> None:
    """No compass, no GNSS: assumed velocities and positions are no measurement of heading, however the vehicle accelerates."""
    worst = []
    for seed in range(3, 9):
        flight = demo_flight(seed=seed, duration=60.0, imu_rate=100.0).without("magnetometer", "gnss")
        solution = run(flight, estimator)
        assert solution["sd_yaw"].min() > math.radians(30.0)
        error = np.radians(solution.summary["errors"]["truth"]["yaw_deg"]["rms"])
        worst.append(error / float(np.median(solution["sd_yaw"])))
    assert np.sqrt(np.mean(np.square(worst))) < 2.0
