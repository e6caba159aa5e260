"""Sensors as data: every parameter with default, unit and meaning, and presets of real parts with their sources. It makes no samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from haltere.errors import UsageError, nearest
from haltere.flight.config import Key

__all__ = ["PARTS", "SENSORS", "sensor"]

DEG = math.pi / 180.0
UG = 9.80665e-6


def _k(default: float, unit: str, doc: str, low: float = 0.0) -> Key:
    return Key(default, unit, doc, low=low)


_CLOCK = {
    "delay": _k(0.0, "s", "A sample valid at t is stamped t + delay; the flight says so in [delays]."),
    "jitter": _k(0.0, "s", "1 sigma of the error of a time stamp."),
}

#: Parameters of each stream. 1 sigma values are drawn once a flight.
SENSORS: dict[str, dict[str, Key]] = {
    "imu": {
        "rate": _k(250.0, "Hz", "Samples a second; the simulation runs at a multiple of it."),
        **_CLOCK,
        "gyro_noise": _k(1.5e-3, "rad/s/sqrt(Hz)", "White noise density."),
        "gyro_walk": _k(1e-4, "rad/s/sqrt(s)", "Bias walk."),
        "gyro_turn_on": _k(5e-3, "rad/s", "1 sigma of the bias at the start."),
        "gyro_scale": _k(0.0, "1", "1 sigma of scale errors."),
        "gyro_misalignment": _k(0.0, "rad", "1 sigma of the small angles between axes."),
        "gyro_range": _k(2000.0 * DEG, "rad/s", "Saturates here."),
        "gyro_resolution": _k(0.0, "rad/s", "Step of the values; 0: none."),
        "gyro_vibration": _k(
            0.0, "rad/s", "Amplitude of the line at each rotor's frequency in hover, give or take half by rotor and axis; grows as thrust."
        ),
        "gyro_temperature": _k(0.0, "rad/s/K", "1 sigma of the bias by temperature."),
        "accel_noise": _k(0.035, "m/s^2/sqrt(Hz)", "White noise density."),
        "accel_walk": _k(3e-4, "m/s^2/sqrt(s)", "Bias walk."),
        "accel_turn_on": _k(0.1, "m/s^2", "1 sigma of the bias at the start."),
        "accel_scale": _k(0.0, "1", "1 sigma of scale errors."),
        "accel_misalignment": _k(0.0, "rad", "1 sigma of the small angles between axes."),
        "accel_range": _k(16.0 * 9.80665, "m/s^2", "Saturates here."),
        "accel_resolution": _k(0.0, "m/s^2", "Step of the values; 0: none."),
        "accel_vibration": _k(0.0, "m/s^2", "Amplitude of the line at each rotor's frequency in hover, as for the gyro."),
        "accel_temperature": _k(0.0, "m/s^2/K", "1 sigma of the bias by temperature."),
        "still": _k(0.1, "1", "Share of the white noise that is there with motors off: the rest is vibration."),
        "warm_up": _k(0.0, "K", "Temperature gained from the start on."),
        "warm_up_time": _k(120.0, "s", "Its time constant."),
        "arm_x": _k(0.0, "m", "IMU ahead of the centre of gravity.", -math.inf),
        "arm_y": _k(0.0, "m", "IMU right of it.", -math.inf),
        "arm_z": _k(0.0, "m", "IMU below it.", -math.inf),
    },
    "magnetometer": {
        "rate": _k(50.0, "Hz", "Samples a second; 0: none."),
        **_CLOCK,
        "noise": _k(1.0, "uT", "1 sigma a sample."),
        "walk": _k(0.0, "uT/sqrt(s)", "Walk of the bias."),
        "hard_iron": _k(0.0, "uT", "1 sigma of a constant field that turns with the vehicle."),
        "soft_iron": _k(0.0, "1", "1 sigma of the elements of the soft-iron matrix away from the identity."),
        "current": _k(0.0, "uT/A", "Field of the supply current along an axis drawn once."),
        "throttle": _k(0.0, "uT", "Field at full throttle along an axis drawn once."),
        "resolution": _k(0.0, "uT", "Step of the values; 0: none."),
    },
    "gnss": {
        "rate": _k(10.0, "Hz", "Fixes a second; 0: none."),
        **_CLOCK,
        "h_noise": _k(0.8, "m", "White horizontal error, 1 sigma an axis."),
        "v_noise": _k(1.2, "m", "White vertical error, 1 sigma."),
        "s_noise": _k(0.15, "m/s", "White velocity error, 1 sigma an axis."),
        "h_drift": _k(0.0, "m", "Correlated horizontal error, 1 sigma an axis."),
        "v_drift": _k(0.0, "m", "Correlated vertical error, 1 sigma."),
        "s_drift": _k(0.0, "m/s", "Correlated velocity error, 1 sigma an axis."),
        "drift_time": _k(60.0, "s", "Correlation time of position errors; velocity errors last a tenth of it."),
        "reported": _k(1.0, "1", "Accuracies given over true ones: above 1 is cautious."),
        "sats": _k(14.0, "1", "Satellites used."),
        "dropouts": _k(0.0, "1/min", "Losses of the fix a minute."),
        "dropout_length": _k(3.0, "s", "Mean length of a loss."),
        "multipath": _k(0.0, "1/min", "Steps of the position a minute."),
        "multipath_size": _k(3.0, "m", "1 sigma of a step; it lasts ten seconds on average."),
        "arm_x": _k(0.0, "m", "Antenna ahead of the IMU.", -math.inf),
        "arm_y": _k(0.0, "m", "Antenna right of it.", -math.inf),
        "arm_z": _k(0.0, "m", "Antenna below it.", -math.inf),
    },
    "barometer": {
        "rate": _k(25.0, "Hz", "Samples a second; 0: none."),
        **_CLOCK,
        "noise": _k(0.5, "m", "White error of height, 1 sigma."),
        "offset": _k(2.0, "m", "1 sigma of the error at the start (weather)."),
        "walk": _k(0.05, "m/sqrt(s)", "Walk of the error."),
        "wind": _k(0.0, "1", "Pressure at the port over dynamic pressure: negative sucks.", -math.inf),
        "temperature": _k(15.0, "degC", "What it says it is.", -60.0),
        "resolution": _k(0.0, "Pa", "Step of the values; 0: none."),
    },
    "airdata": {
        "rate": _k(0.0, "Hz", "Samples a second; 0: none."),
        **_CLOCK,
        "noise": _k(0.5, "m/s", "Airspeed, 1 sigma."),
        "scale": _k(0.0, "1", "1 sigma of the scale error of airspeed."),
        "angle_noise": _k(2.0 * DEG, "rad", "Angles of attack and sideslip, 1 sigma."),
    },
    "rotors": {
        "rate": _k(50.0, "Hz", "Samples a second; 0: none."),
        **_CLOCK,
        "noise": _k(1.0, "rad/s", "1 sigma."),
        "resolution": _k(0.0, "rad/s", "Step of the values; 0: none."),
        "dropouts": _k(0.0, "1", "Share of values lost."),
    },
    "power": {
        "rate": _k(10.0, "Hz", "Samples a second; 0: none."),
        **_CLOCK,
        "voltage_noise": _k(0.02, "V", "1 sigma."),
        "current_noise": _k(0.1, "A", "1 sigma."),
    },
}  # fmt: skip

#: Presets of real parts. Densities, walks and turn-on biases after theory.md §8 and the sources there: the PX4 Iris model's IMU and
#: magnetometer (iris.sdf), the EuRoC data set's ADIS16448 (sensor.yaml), makers' tables for ICM-42688 and BMI088; range and resolution
#: from the parts' full scale at 16 bits. Scale, misalignment, warm-up and vibration are assumptions of the usual size.
PARTS: dict[str, dict[str, dict[str, float]]] = {
    "imu": {
        "flight": {},
        "iris": {
            "gyro_noise": 1.87e-4, "gyro_walk": 3.88e-5, "gyro_turn_on": 0.0087, "accel_noise": 1.86e-3, "accel_walk": 6e-3,
            "accel_turn_on": 0.196, "still": 1.0,
        },
        "adis16448": {
            "gyro_noise": 1.70e-4, "gyro_walk": 1.94e-5, "accel_noise": 2.0e-3, "accel_walk": 3.0e-3, "gyro_turn_on": 0.5 * DEG,
            "accel_turn_on": 0.03, "gyro_range": 1000.0 * DEG, "accel_range": 18.0 * 9.80665, "gyro_resolution": 0.04 * DEG,
            "accel_resolution": 0.833e-3 * 9.80665, "still": 1.0,
        },
        "icm42688": {
            "gyro_noise": 0.0028 * DEG, "gyro_walk": 2e-5, "gyro_turn_on": 0.5 * DEG, "gyro_temperature": 0.005 * DEG,
            "gyro_scale": 0.005, "gyro_misalignment": 0.3 * DEG, "gyro_resolution": 2000.0 * DEG / 32768.0,
            "accel_noise": 75.0 * UG, "accel_walk": 1e-3, "accel_turn_on": 0.2, "accel_scale": 0.005, "accel_misalignment": 0.3 * DEG,
            "accel_resolution": 16.0 * 9.80665 / 32768.0, "warm_up": 10.0, "still": 1.0, "gyro_vibration": 0.02, "accel_vibration": 1.4,
        },
        "bmi088": {
            "gyro_noise": 0.014 * DEG, "gyro_walk": 3e-5, "gyro_turn_on": 1.0 * DEG, "gyro_temperature": 0.015 * DEG,
            "gyro_scale": 0.01, "gyro_misalignment": 0.5 * DEG, "gyro_resolution": 2000.0 * DEG / 32768.0,
            "accel_noise": 150.0 * UG, "accel_walk": 1e-3, "accel_turn_on": 0.2, "accel_scale": 0.01, "accel_misalignment": 0.5 * DEG,
            "accel_range": 24.0 * 9.80665, "accel_resolution": 24.0 * 9.80665 / 32768.0, "warm_up": 10.0, "still": 1.0,
            "gyro_vibration": 0.02, "accel_vibration": 1.4,
        },
    },
    "magnetometer": {
        "clean": {},
        "iris": {"rate": 50.0, "noise": 100.0 * 4e-4 * math.sqrt(50.0), "walk": 100.0 * 6.4e-6},
        "near-power": {"noise": 0.5, "hard_iron": 8.0, "soft_iron": 0.03, "current": 0.25, "resolution": 0.15},
    },
    "gnss": {
        "clean": {},
        "consumer": {
            "rate": 5.0, "delay": 0.12, "h_noise": 0.3, "v_noise": 0.5, "s_noise": 0.05, "h_drift": 1.0, "v_drift": 1.8, "s_drift": 0.08,
            "dropouts": 0.05, "multipath": 0.1,
        },
        "rtk": {"rate": 10.0, "delay": 0.08, "h_noise": 0.01, "v_noise": 0.02, "s_noise": 0.03, "h_drift": 0.01, "v_drift": 0.02},
    },
    "barometer": {"clean": {}, "exposed": {"noise": 0.2, "wind": -0.6, "delay": 0.05}},
    "airdata": {"none": {}, "vanes": {"rate": 50.0, "scale": 0.02}},
    "rotors": {
        "clean": {}, "slow": {"rate": 4.0},
        "telemetry": {"rate": 100.0, "noise": 2.0, "resolution": 100.0 * 2.0 * math.pi / 60.0 / 7.0, "delay": 0.01},
    },
    "power": {"clean": {}},
}  # fmt: skip


def sensor(stream: str, overrides: Mapping[str, Any] | None = None) -> dict[str, float]:
    """Every parameter of a simulated sensor from its preset and overrides.

    Raises
    ------
    UsageError
        Unknown stream, preset or parameter (with the nearest name), or a value out of bounds.
    """
    if stream not in SENSORS:
        raise UsageError(f"a stream ({', '.join(SENSORS)})", repr(stream), "sensors", nearest(stream, SENSORS))
    given = dict(overrides or {})
    preset = str(given.pop("preset", next(iter(PARTS[stream]))))
    if preset not in PARTS[stream]:
        raise UsageError(
            f"a preset of {stream} ({', '.join(PARTS[stream])})", repr(preset), f"sensors.{stream}", nearest(preset, PARTS[stream])
        )
    values = {name: float(key.default) for name, key in SENSORS[stream].items()} | PARTS[stream][preset]
    for name, value in given.items():
        key = SENSORS[stream].get(name)
        if key is None:
            raise UsageError(f"a parameter of {stream}", repr(name), f"sensors.{stream}", nearest(name, SENSORS[stream]))
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < key.low:
            raise UsageError(f"a number [{key.unit}] of at least {key.low:g} for {name}", repr(value), f"sensors.{stream}")
        values[name] = float(value)
    return values
