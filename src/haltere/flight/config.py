"""Configuration: every key with its default, unit and meaning, once; presets, overrides and the file that reproduces a run."""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from haltere.errors import HaltereError, UsageError
from haltere.flight import axes
from haltere.flight.key import Key, Value, axes_key, delay, exclusion, positive, switch, unit_key
from haltere.flight.units import unit_word

__all__ = ["ESTIMATORS", "KEYS", "PRESETS", "Config", "Key", "Value", "defaults", "load", "parse_assignment", "resolve"]

DEG = math.pi / 180.0

#: Estimators and the presets each has.
PRESETS: dict[str, tuple[str, ...]] = {
    "navigator": ("default",),
    "ahrs": ("default",),
    "two-stage": ("default", "as-corrected", "as-printed"),
    "wind-attitude": ("default", "as-corrected", "as-printed"),
    "fault-tolerant": ("default", "as-corrected"),
}
ESTIMATORS = tuple(PRESETS)


_CALIBRATION = (
    "m = A (m_raw - b - k load), in the sensor's axes, after unit and axes were put right. m_raw is the field before the autopilot's own "
    "correction where the log tells it. `haltere calibrate magnetometer` finds it."
)

#: Every key (theory-amendments.md §8 unless said). NaN: from the data.
KEYS: dict[str, Key] = {
    "noise.gyro": positive(1.5e-3, "rad/s/sqrt(Hz)", "Gyro white noise density, vibration included. Higher trusts the aids more."),
    "noise.gyro_scale": Key(
        0.005, "1", "Gyro error in proportion to the rate (scale, misalignment), 1 sigma, taken as noise that lasts a second.", low=0.0
    ),
    "noise.between": Key(
        0.2,
        "1",
        "Share of the change between two IMU samples that the mean between them may be off by, 1 sigma. It matters at low rates.",
        low=0.0,
    ),
    "noise.accel": positive(0.035, "m/s^2/sqrt(Hz)", "Accelerometer white noise density, vibration included."),
    "noise.gyro_bias": positive(1e-4, "rad/s/sqrt(s)", "Walk of the gyro bias."),
    "noise.accel_bias": positive(3e-4, "m/s^2/sqrt(s)", "Walk of the accelerometer bias."),
    "noise.baro_bias": positive(0.05, "m/sqrt(s)", "Walk of the barometer offset (weather, wind on the port)."),
    "noise.gnss_velocity": positive(0.5, "m/s", "GNSS velocity, 1 sigma, where the receiver gives no accuracy."),
    "noise.gnss_position": positive(1.0, "m", "GNSS horizontal position, 1 sigma, where the receiver gives no accuracy."),
    "noise.gnss_altitude": positive(2.0, "m", "GNSS altitude, 1 sigma, where the receiver gives no accuracy."),
    "noise.gnss_velocity_min": positive(0.1, "m/s", "Least velocity accuracy believed of a receiver: its errors last for many fixes."),
    "noise.gnss_position_min": positive(0.5, "m", "Least position accuracy believed of a receiver."),
    "noise.barometer": positive(1.0, "m", "Barometric altitude, 1 sigma."),
    "noise.magnetometer": positive(1.0, "uT", "Magnetometer, 1 sigma a sample, white."),
    "noise.field": Key(
        2.5, "uT", "What surroundings and calibration add to the field, 1 sigma, alike in all samples of a correlation time.", low=0.0
    ),
    "noise.field_time": positive(2.0, "s", "That correlation time."),
    "noise.mag_offset": positive(0.02, "uT/sqrt(s)", "Walk of the magnetometer's offset, where it is estimated."),
    "noise.zero_velocity": positive(0.05, "m/s", "Zero velocity at rest, 1 sigma at 10 Hz."),
    "noise.zero_rate": positive(0.01, "rad/s", "Zero rate at rest, 1 sigma at 10 Hz."),
    "noise.fake_position": positive(10.0, "m", "Fake position in flight, 1 sigma at 5 Hz."),
    "noise.fake_position_rest": positive(0.5, "m", "Fake position at rest, 1 sigma at 5 Hz."),
    "noise.fake_velocity": positive(
        6.0,
        "m/s",
        "Fake velocity of ahrs, 1 sigma at 5 Hz: worth 2 m/s that last a second. Lower trusts gravity more, accelerations less.",
    ),
    "told_wind.n": Key(math.nan, "m/s", "Wind taken for true, where it blows to, north. Default: not given.", low=-100.0, high=100.0),
    "told_wind.e": Key(math.nan, "m/s", "The same, east.", low=-100.0, high=100.0),
    "told_wind.d": Key(0.0, "m/s", "The same, down.", low=-50.0, high=50.0),
    "told_wind.speed": Key(
        math.nan, "m/s", "Instead of told_wind.n and told_wind.e, as a station gives it: its speed,", low=0.0, high=100.0
    ),
    "told_wind.from": Key(math.nan, "rad", "and where it comes from, clockwise from true north.", low=-6.2832, high=6.2832),
    "told_wind.sd": positive(1.0, "m/s", "1 sigma of each of its components, gusts included."),
    "noise.wind_mean": positive(0.05, "m/s/sqrt(s)", "Walk of the mean wind, which gusts return to."),
    "air.gust": positive(0.3, "m/s", "Gusts, 1 sigma an axis in calm air; vertical ones are half of it."),
    "air.turbulence": Key(0.15, "1", "Gusts more in proportion to the mean wind.", low=0.0, high=2.0),
    "air.gust_time": positive(3.0, "s", "How long a gust lasts."),
    "noise.air_walk": positive(
        2e-3, "1/sqrt(s)", "Walk of what air data depend on: relative for drag and airspeed scale, in m/s^2 and rad for offsets."
    ),
    "noise.airspeed": positive(1.0, "m/s", "Airspeed, 1 sigma, alike in all samples of noise.airdata_time."),
    "noise.aoa": positive(2.0 * DEG, "rad", "Vane of the angle of attack, 1 sigma, likewise."),
    "noise.sideslip": positive(2.0 * DEG, "rad", "Vane of the sideslip, 1 sigma, likewise."),
    "noise.airdata_time": Key(0.5, "s", "How long errors of air data last (gusts shorter than that, the tube's lag).", low=0.0),
    "noise.no_sideslip": positive(6.0 * DEG, "rad", "Sideslip of an aeroplane without vanes, 1 sigma, likewise."),
    "noise.drag": positive(0.15, "m/s^2", "What the drag model misses, 1 sigma, alike in all samples of noise.drag_time."),
    "noise.drag_time": Key(0.2, "s", "That correlation time.", low=0.0),
    "noise.given_wind": positive(1.0, "m/s", "Wind told from outside, 1 sigma, where no sd is told with it."),
    "noise.attitude": positive(1.0 * DEG, "rad", "Roll and pitch told from outside, 1 sigma."),
    "noise.attitude_yaw": positive(2.0 * DEG, "rad", "Yaw told from outside, 1 sigma."),
    "noise.attitude_time": Key(1.0, "s", "How long the errors of a told attitude last.", low=0.0),
    "gate.air": positive(5.0, "sigma", "Innovation gate of airspeed, vanes and told wind."),
    "gate.drag": positive(15.0, "sigma", "The same of drag: wide, since wind may well step."),
    "gate.attitude": positive(5.0, "sigma", "Innovation gate of a told attitude."),
    "gate.gnss": positive(5.0, "sigma", "Innovation gate of GNSS position and velocity, joint over the components."),
    "gate.barometer": positive(5.0, "sigma", "Innovation gate of the barometer."),
    "gate.magnetometer": positive(6.0, "sigma", "Innovation gate of the magnetometer."),
    "gate.zero_velocity": positive(5.0, "sigma", "Innovation gate of zero velocity."),
    "gate.zero_rate": positive(5.0, "sigma", "Innovation gate of zero rate."),
    "delay.gnss_velocity": delay("A velocity stamped t was valid at t - delay. delay.gnss sets velocity and position."),
    "delay.gnss_position": delay("The same for position."),
    "delay.barometer": delay("The same for the barometer."),
    "delay.magnetometer": delay("The same for the magnetometer."),
    "delay.rotors": delay("The same for rotor speeds."),
    "delay.airdata": delay("The same for airspeed and vanes."),
    "delay.wind": delay("The same for a told wind."),
    "delay.attitude": delay("The same for a told attitude."),
    "aid.gnss": switch("on", "Use GNSS position and velocity."),
    "aid.barometer": switch("on", "Use the barometer."),
    "aid.magnetometer": switch(
        "heading",
        "Use the magnetometer: as a heading that leaves tilt alone, as three axes, or (two-stage, which has no other) as the horizontal "
        "field orthonormal to the gravity of its first stage.",
        ("off", "heading", "3-axis", "orthonormal"),
    ),
    "aid.zero_velocity": switch("on", "Zero velocity at rest."),
    "aid.zero_rate": switch("on", "Zero rate at rest."),
    "aid.fake_position": switch("on", "Fake position while nothing else holds it."),
    "aid.yaw_bank": switch("on", "Set yaw from GNSS velocity where it is unknown, or contradicted by it."),
    "aid.fake_velocity": switch("off", "Fake zero velocity, always on in ahrs."),
    "aid.drag": switch(
        "auto",
        "Estimate the horizontal wind of a multirotor from its drag, and the drag with it; auto: where at least three rotors turn.",
        ("off", "on", "auto"),
    ),
    "aid.airdata": switch(
        "auto",
        "Estimate the wind from airspeed and vanes, and their scale and offsets with it; auto: where the log has them.",
        ("off", "on", "auto"),
    ),
    "aid.vanes": switch(
        "auto",
        "Use vanes of angle of attack and sideslip, and estimate the vertical wind too; auto: where the log has both.",
        ("off", "on", "auto"),
    ),
    "aid.no_sideslip": switch(
        "auto", "Take an aeroplane to fly straight through the air; auto: with airspeed, without vanes and rotors.", ("off", "on", "auto")
    ),
    "aid.wind": switch("on", "Use the stream wind, told from outside, where wind is estimated."),
    "aid.attitude": switch("on", "Use the stream attitude, told from outside."),
    "air.moves": switch(
        "wind",
        "What measurements of the air may move while GNSS is heard: only the wind and their own coefficients, or the whole state.",
        ("wind", "all"),
    ),
    "air.density": positive(math.nan, "kg/m^3", "Air density at the origin. Default: standard atmosphere at its altitude."),
    "air.airspeed_min": positive(4.0, "m/s", "Airspeeds below this say nothing."),
    "drag.mu": positive(0.3, "1/s", "Rotor drag over mass and speed at hover, standard atmosphere at sea level: as begun with."),
    "drag.mu_sd": positive(0.35, "1", "Its relative 1 sigma, log-normal. `haltere identify --drag` finds both."),
    "drag.c": positive(0.008, "1/m", "Quadratic drag over mass, standard atmosphere at sea level: as begun with."),
    "drag.c_sd": positive(0.7, "1", "Its relative 1 sigma, log-normal."),
    "drag.offset_sd": positive(0.1, "m/s^2", "1 sigma of what the thrust's axis is askew to the accelerometer's: 0.1 is 0.6 deg."),
    "timeout.air": positive(10.0, "s", "The same for measurements of the air."),
    "timeout.drag": positive(2.0, "s", "The same for drag."),
    "timeout.attitude": positive(10.0, "s", "The same for a told attitude."),
    "timeout.gnss": positive(7.0, "s", "After this long without a fix that passes, GNSS is let in again by force, at the gate's edge."),
    "timeout.barometer": positive(7.0, "s", "The same for the barometer."),
    "timeout.magnetometer": positive(10.0, "s", "The same for the magnetometer."),
    "timeout.imu": positive(2.0, "s", "IMU gaps longer than this are not bridged: the filter aligns anew."),
    "arm.gnss_x": Key(0.0, "m", "GNSS antenna ahead of the IMU (FRD)."),
    "arm.gnss_y": Key(0.0, "m", "GNSS antenna right of the IMU."),
    "arm.gnss_z": Key(0.0, "m", "GNSS antenna below the IMU."),
    "aid.compass_watch": switch(
        "on", "Compare the compass with the gyro and with the field so far; hear it no more while it is disturbed."
    ),
    "aid.motor_field": switch("on", "Find the field of the motors' currents from the flight, and take it off the magnetometer."),
    "delay.power": delay("The same for the battery current."),
    "robust.innovation": positive(
        2.5, "sigma", "From this heading innovation on the variance of a magnetometer sample is inflated (IGG-III), up to its gate."
    ),
    "robust.strength": positive(0.04, "1", "Change of the field's strength taken as 1 sigma: inflated from two on, refused from six on."),
    "robust.dip": positive(2.5 * DEG, "rad", "The same for its dip."),
    "robust.heading": positive(
        2.0 * DEG, "rad", "Turn against the gyro that a compass is allowed without turning, beside its noise and half of noise.field."
    ),
    "robust.calibration": positive(
        0.12, "1", "Error of its calibration, as a fraction of the field, that may turn a compass when the vehicle turns."
    ),
    "field.declination": Key(
        math.nan, "rad", "Declination, east positive. Default: World Magnetic Model at home, else 0.", low=-math.pi, high=math.pi
    ),
    "field.dip": Key(
        math.nan, "rad", "Dip, down positive. Default: World Magnetic Model at home, else from the first samples.", low=-1.5708, high=1.5708
    ),
    "field.strength": positive(math.nan, "uT", "Field strength. Default: World Magnetic Model at home, else from the first samples."),
    "field.tolerance_strength": positive(0.35, "1", "Refuse a sample whose strength is off by more than this fraction."),
    "field.tolerance_dip": positive(20.0 * DEG, "rad", "Refuse a sample whose dip is off by more than this."),
    "home.lat": Key(math.nan, "deg", "Origin latitude. Default: the log's home, else the first 3-D fix.", low=-90.0, high=90.0),
    "home.lon": Key(math.nan, "deg", "Origin longitude.", low=-360.0, high=360.0),
    "home.alt": Key(math.nan, "m", "Origin altitude above mean sea level.", low=-1e4, high=1e5),
    "init.tilt_rest": positive(3.0 * DEG, "rad", "1 sigma of roll and pitch aligned at rest, without the accelerometer bias."),
    "init.tilt_motion": positive(10.0 * DEG, "rad", "1 sigma of roll and pitch aligned in motion."),
    "init.yaw_compass": positive(10.0 * DEG, "rad", "1 sigma of yaw from a compass that passed its tests."),
    "init.yaw_unknown": positive(60.0 * DEG, "rad", "1 sigma of yaw without one."),
    "init.gyro_bias_rest": positive(0.05 * DEG, "rad/s", "1 sigma of the gyro bias measured at rest."),
    "init.gyro_bias": positive(0.01, "rad/s", "1 sigma of the gyro bias aligned in motion."),
    "init.accel_bias": positive(0.2, "m/s^2", "1 sigma of the accelerometer bias."),
    "init.velocity": positive(0.3, "m/s", "Least 1 sigma of velocity."),
    "init.baro_bias": positive(3.0, "m", "1 sigma of the barometer offset."),
    "init.mag_offset": positive(5.0, "uT", "1 sigma of the magnetometer's offset, where it is estimated."),
    "init.wind": positive(5.0, "m/s", "1 sigma of each component of the horizontal wind, which begins at none."),
    "init.airspeed_scale": positive(0.1, "1", "Relative 1 sigma of the airspeed's scale."),
    "init.vane": positive(3.0 * DEG, "rad", "1 sigma of a vane's offset."),
    "rest.gyro": positive(0.02, "rad/s", "At rest the rate's standard deviation over a second is below this."),
    "rest.accel": positive(0.3, "m/s^2", "At rest the standard deviation of |f| over a second is below this."),
    "rest.gravity": positive(0.5, "m/s^2", "At rest mean |f| differs from gravity by less than this."),
    "two_stage.tolerance": positive(
        math.nan,
        "1",
        "T_D: one unit of the anomaly index, in |F| (uT^2 where the index is algebraic). Default: the index's own 1 sigma, twice that of "
        "the field over its strength. Higher lets more disturbed field in.",
    ),
    "two_stage.k1": positive(2.0, "T_D", "Anomaly index from which the magnetometer's variance is inflated."),
    "two_stage.k2": positive(6.0, "T_D", "Anomaly index from which a magnetometer sample is dropped."),
    "two_stage.robust": switch(
        "igg3",
        "How the variance grows between k1 and k2; huber never drops, off takes every sample as it is.",
        ("off", "igg3", "huber", "step"),
    ),
    "two_stage.index": switch(
        "relative",
        "F of the anomaly index: |m|^2/|H|^2 - 1, or the algebraic |m|^2 - |H|^2 [uT^2] of the printed one.",
        ("relative", "algebraic"),
    ),
    "two_stage.innovation": switch(
        "on", "A second factor from sqrt(NIS): two_stage.robust from robust.innovation to gate.magnetometer, where it is dropped."
    ),
    "two_stage.radial": positive(
        math.nan, "1", "Slack of the unit horizontal field along itself, which its noise does not move. Default: as much as across."
    ),
    "two_stage.memory": Key(
        0.0,
        "s",
        "How long an error of the first stage's gravity lasts; its variance counts 2 memory/interval times. 0: each sample anew.",
        low=0.0,
        high=1e4,
    ),
    "two_stage.haversine": switch("off", "North and east of a fix by the haversine on a sphere, as printed, instead of on WGS-84."),
    "two_stage.height_sign": switch(
        "minus", "Down position of a fix is minus the height above the origin; plus is a misprint of the source.", ("minus", "plus")
    ),
    "wind_attitude.filter": switch(
        "error-state",
        "The filter behind wind-attitude, as its preset says: the error-state filter of haltere with wind as a state, or the published one "
        "of four states.",
        ("error-state", "quaternion"),
    ),
    "wind_attitude.integrator": switch(
        "picard4",
        "Step of the quaternion: Picard's approximations (published: the fourth), Runge-Kutta, or exact for a constant rate.",
        ("picard1", "picard2", "picard3", "picard4", "rk4", "exp"),
    ),
    "wind_attitude.residual": switch("nonlinear", "z - h(q), or Z - H X as (25) prints it.", ("nonlinear", "printed")),
    "wind_attitude.rows": switch("jacobian", "Rows 7 to 9 of H: of the wind triangle, or as (20) prints them.", ("jacobian", "printed")),
    "wind_attitude.normalise": switch(
        "on", "Bring the quaternion back to length one after each step: its covariance too (on), or not (length).", ("off", "length", "on")
    ),
    "wind_attitude.angles": switch(
        "atan2", "Roll and yaw given out: over the whole circle, or by the arc tangents of (3).", ("atan2", "arctan")
    ),
    "wind_attitude.accel": switch("on", "Take specific force for gravity."),
    "wind_attitude.force": positive(1.0, "m/s^2", "Only where its size differs from gravity by less than this."),
    "wind_attitude.acceleration": positive(1.5, "m/s^2", "And only where GNSS velocity, if any, shows an acceleration below this."),
    "wind_attitude.gate": positive(1e6, "sigma", "Innovation gate of gravity, joint over the components."),
    "wind_attitude.air": switch(
        "auto",
        "Where the velocity through the air is from: vanes (stream airdata), drag (specific force over drag.*), or what there is: vanes, "
        "else drag where at least three rotors turn.",
        ("off", "vanes", "drag", "auto"),
    ),
    "diagnosis.inertial": switch(
        "on",
        "Look for faults of gyro and accelerometer axes by their signature in the innovations, name them, and take their effect back.",
    ),
    "diagnosis.false_alarms": positive(0.035, "1/h", "Wanted rate of false alarms; lower finds faults later."),
    "diagnosis.gyro": Key(0.3 * DEG, "rad/s", "Change of a gyro bias that is no fault.", low=0.0),
    "diagnosis.accel": Key(0.08, "m/s^2", "Change of an accelerometer bias that is no fault.", low=0.0),
    "fault_tolerant.detector": switch(
        "windows",
        "Detection filters of fault-tolerant: the largest of many windows of whitened residuals, or χ² of each one, as the source has it.",
        ("windows", "snapshot"),
    ),
    "fault_tolerant.reset": switch(
        "fusion", "Local filters take the fused state after each fusion, or keep their own opinion.", ("fusion", "none")
    ),
    "fault_tolerant.wind": switch("on", "Wind is a state of every chain that has the model; off: the air is taken to be still."),
    "fault_tolerant.biases": switch("on", "Biases of sensors and model may change in flight; off: they are held as at take-off."),
    "fault_tolerant.isolate": switch("on", "Leave out what the detection filters name; off: only say so."),
    "fault_tolerant.fuse_rate": Key(20.0, "Hz", "Fusions a second; more is nearer to one filter with all sensors.", low=1.0, high=25.0),
    "fault_tolerant.step": Key(
        0.01, "s", "Step of covariances and detection filters: the IMU's samples are averaged over it.", low=0.002, high=0.05
    ),
    "fault_tolerant.wait": Key(2.5, "s", "How long alarms are gathered before a verdict.", low=0.1, high=10.0),
    "fault_tolerant.recover": Key(5.0, "s", "How long an isolated sensor must agree again before it is heard.", low=0.5, high=60.0),
    "diagnosis.vehicle": switch(
        "on", "With a vehicle's model: compare it with gyro and accelerometer, and name a rotor or an axis of the model that fails."
    ),
    "diagnosis.force": Key(0.2, "m/s^2", "Change of what the model's force is off by that is no fault.", low=0.0),
    "diagnosis.moment": Key(0.5, "rad/s^2", "The same of its moments.", low=0.0),
    "exclude.gyro": exclusion("Gyro axes that are not to be used, and when: a sensor known to be broken, or a trial without it."),
    "exclude.accel": exclusion("The same of the accelerometer."),
    "imu.kind": switch("instant", "An IMU sample is the value at its time, or the mean since the sample before.", ("instant", "mean")),
    "imu.unit": switch("0", "Which of the log's inertial units is used: 0 the first, 1 the stream imu.1, and so on.", ("0", "1", "2", "3")),
    "baro.temperature": Key(
        math.nan, "K", "Air temperature at the ground, scales pressure altitude. Default: standard atmosphere.", low=200.0, high=330.0
    ),
    "baro.offset": switch("on", "Estimate the barometer offset as a state."),
    "magnetometer.refine": switch("off", "Estimate the magnetometer's offset (hard iron) as slow states; tilt is left alone all the same."),
    "unit.time": unit_key("s", "What the log's time stamps are in, in every stream."),
    "unit.gyro": unit_key("rad/s", "What the log's angular rates are in."),
    "unit.accel": unit_key("m/s^2", "What the log's specific forces are in."),
    "unit.magnetometer": unit_key("uT", "What the log's magnetic field is in: G is gauss, mG milligauss, T tesla."),
    "unit.pressure": unit_key("Pa", "What the log's static pressure is in."),
    "unit.gnss_position": unit_key("deg", "What the log's latitude and longitude are in."),
    "unit.gnss_altitude": unit_key("m", "What the log's GNSS altitude is in."),
    "unit.gnss_velocity": unit_key("m/s", "What the log's GNSS velocity is in."),
    "axes.gyro": axes_key(
        "Where the gyro's x, y and z point in the body: forward or back, right or left, down or up. `FLU` is forward, left, up; "
        "`FRU` is a mirrored triad, allowed too."
    ),
    "axes.accel": axes_key(
        "The same for the accelerometer. `BLU`, all three turned over, is one that gives gravity instead of specific force."
    ),
    "axes.magnetometer": axes_key("The same for the magnetometer."),
    "magnetometer.offset_x": Key(0.0, "uT", f"Offset b of the magnetometer: {_CALIBRATION}"),
    "magnetometer.offset_y": Key(0.0, "uT", "The same along y."),
    "magnetometer.offset_z": Key(0.0, "uT", "The same along z."),
    **{f"magnetometer.matrix_{r}{c}": Key(float(r == c), "1", f"Matrix A of the same, {r} from {c}.") for r in "xyz" for c in "xyz"},
    "magnetometer.load": switch(
        "off",
        "What the magnetometer's offset follows: the battery's current, the mean rotor command, or the mean rotor speed.",
        ("off", "current", "throttle", "rotors"),
    ),
    **{f"magnetometer.load_{a}": Key(0.0, "uT/A, uT or uT s/rad", f"Field k a unit of that load, along {a}.") for a in "xyz"},
}

#: Keys that stand for several, each with what it sets.
GROUPS: dict[str, tuple[str, ...]] = {
    "delay.gnss": ("delay.gnss_velocity", "delay.gnss_position"),
    "axes.imu": ("axes.gyro", "axes.accel"),
}

_DIAGNOSIS = tuple(key for key in KEYS if key.startswith("diagnosis."))
_FAULT_TOLERANT = tuple(key for key in KEYS if key.startswith("fault_tolerant."))
#: What only an estimator with a vehicle's model can do without.
_EXCLUDE = tuple(key for key in KEYS if key.startswith("exclude."))
_TWO_STAGE = tuple(key for key in KEYS if key.startswith("two_stage."))
_WIND_ATTITUDE = tuple(key for key in KEYS if key.startswith("wind_attitude."))
#: A wind taken for true, which only the published filter of wind-attitude needs.
_GIVEN_WIND = tuple(f"told_wind.{key}" for key in ("n", "e", "d", "speed", "from", "sd"))
#: What only an estimator with wind has.
_AIR_TAILS = (
    "wind wind_mean air_walk airspeed aoa sideslip airdata_time no_sideslip drag drag_time given_wind air airdata vanes airspeed_scale vane"
).split()
_AIR = tuple(
    key
    for key in KEYS
    if not key.startswith("delay.") and (key.startswith(("air.", "drag.", "told_wind.")) or key.partition(".")[2] in _AIR_TAILS)
)
_NO_AIR: dict[str, Value] = {"aid.drag": "off", "aid.airdata": "off", "aid.vanes": "off", "aid.no_sideslip": "off", "aid.wind": "off"}
#: What an estimator sets differently from the defaults above.
_OVERRIDES: dict[str, dict[str, Value]] = {
    "navigator": {},
    "fault-tolerant": {**_NO_AIR},
    "ahrs": {
        "aid.gnss": "off", "aid.barometer": "off", "aid.fake_velocity": "on", "aid.fake_position": "off", "baro.offset": "off",
        "diagnosis.inertial": "off",
        **_NO_AIR,
    },
    "two-stage": {
        "aid.magnetometer": "orthonormal", "aid.barometer": "off", "baro.offset": "off", "aid.fake_velocity": "off",
        "aid.zero_velocity": "off", "aid.zero_rate": "off", "aid.yaw_bank": "off", "aid.compass_watch": "off",
        "aid.motor_field": "off", "diagnosis.inertial": "off", "two_stage.radial": 0.05, "two_stage.memory": 10.0,
        **_NO_AIR,
    },
    "wind-attitude": {"air.moves": "all", "aid.magnetometer": "3-axis", "diagnosis.inertial": "off"},
}  # fmt: skip
_NO_GATE = 1e6
#: What a preset of an estimator sets differently from its `default`. The source has no innovation tests.
_PRESET_OVERRIDES: dict[tuple[str, str], dict[str, Value]] = {
    ("two-stage", "as-corrected"): {
        "two_stage.tolerance": 0.03, "two_stage.innovation": "off", "two_stage.radial": math.nan,
        "two_stage.memory": 0.0, "two_stage.haversine": "on",
        "gate.gnss": _NO_GATE, "gate.magnetometer": _NO_GATE, "noise.field": 0.0, "noise.gyro_scale": 0.0, "noise.between": 0.0,
    },
}  # fmt: skip
_PRESET_OVERRIDES["two-stage", "as-printed"] = _PRESET_OVERRIDES["two-stage", "as-corrected"] | {
    "two_stage.index": "algebraic",
    "two_stage.height_sign": "plus",
}
_PRESET_OVERRIDES["fault-tolerant", "as-corrected"] = {
    "fault_tolerant.detector": "snapshot", "fault_tolerant.wind": "off", "diagnosis.inertial": "off",
    "diagnosis.false_alarms": 2.8,  # 1e-6 a residual: 600 of J11 to J16 a second, 190 of the others
    "gate.gnss": _NO_GATE, "gate.magnetometer": _NO_GATE, "gate.barometer": _NO_GATE, "noise.field": 0.0,
}  # fmt: skip
_PRESET_OVERRIDES["wind-attitude", "as-corrected"] = {
    "wind_attitude.filter": "quaternion", "aid.magnetometer": "3-axis", "gate.magnetometer": _NO_GATE, "gate.air": _NO_GATE,
    "noise.field": 0.0, "aid.airdata": "on",
}  # fmt: skip
_PRESET_OVERRIDES["wind-attitude", "as-printed"] = _PRESET_OVERRIDES["wind-attitude", "as-corrected"] | {
    "wind_attitude.residual": "printed", "wind_attitude.rows": "printed", "wind_attitude.normalise": "off",
    "wind_attitude.angles": "arctan", "wind_attitude.force": _NO_GATE, "wind_attitude.acceleration": _NO_GATE,
}  # fmt: skip
#: Where the keys begin that the published filter of wind-attitude is told; noise and delays a flight may tell of any sensor.
_QUATERNION = (
    "noise.", "delay.", "gate.magnetometer", "gate.air", "aid.gnss", "aid.magnetometer", "aid.airdata", "aid.wind", "timeout.magnetometer",
    "timeout.imu", "field.", "home.", "init.tilt_", "init.yaw_", "init.accel_bias", "rest.gyro", "rest.gravity", "imu.kind", "unit.",
    "axes.", "magnetometer.offset_", "magnetometer.matrix_", "magnetometer.load", "air.density", "drag.", "wind_attitude.", *_GIVEN_WIND,
)  # fmt: skip
_TWO_STAGE_OFF = (
    "aid.barometer", "baro.offset", "aid.fake_velocity", "aid.zero_velocity", "aid.zero_rate", "aid.yaw_bank", "aid.compass_watch",
    "aid.motor_field",
)  # fmt: skip
#: Keys that an estimator does not have: changing them would change nothing, or make it another one.
_FIXED: dict[str, tuple[str, ...]] = {
    "navigator": (*_TWO_STAGE, *_WIND_ATTITUDE, *_GIVEN_WIND, *_FAULT_TOLERANT),
    "fault-tolerant": (*_TWO_STAGE, *_WIND_ATTITUDE, *_GIVEN_WIND, *_NO_AIR, "magnetometer.refine"),
    "ahrs": (*_OVERRIDES["ahrs"], *_TWO_STAGE, *_AIR, *_WIND_ATTITUDE, *_DIAGNOSIS, *_FAULT_TOLERANT, *_EXCLUDE),
    "wind-attitude": (*_TWO_STAGE, *_DIAGNOSIS, *_FAULT_TOLERANT, *_EXCLUDE, "wind_attitude.filter"),
    "two-stage": (
        *_FAULT_TOLERANT,
        *_EXCLUDE,
        *_WIND_ATTITUDE,
        *_AIR,
        *_TWO_STAGE_OFF,
        *_DIAGNOSIS,
        "magnetometer.refine",
        "noise.mag_offset",
        "init.mag_offset",
        "robust.strength",
        "robust.dip",
        "robust.heading",
        "robust.calibration",
    ),
}
#: Further ones by preset.
_FIXED_PRESET: dict[tuple[str, str], tuple[str, ...]] = {
    ("wind-attitude", "default"): (*_WIND_ATTITUDE, *_GIVEN_WIND),
    **{("wind-attitude", preset): tuple(k for k in KEYS if not k.startswith(_QUATERNION)) for preset in ("as-corrected", "as-printed")},
}
#: Words of a switch that an estimator does not have.
_LACKS: dict[str, dict[str, tuple[str, ...]]] = {
    "navigator": {"aid.magnetometer": ("orthonormal",)},
    "ahrs": {"aid.magnetometer": ("orthonormal",)},
    "two-stage": {"aid.magnetometer": ("heading", "3-axis")},
    "wind-attitude": {"aid.magnetometer": ("orthonormal",)},
    "fault-tolerant": {"aid.magnetometer": ("orthonormal",)},
}
_LACKS_PRESET: dict[tuple[str, str], dict[str, tuple[str, ...]]] = {
    ("wind-attitude", preset): {"aid.magnetometer": ("heading", "orthonormal"), "aid.airdata": ("auto",)}
    for preset in ("as-corrected", "as-printed")
}


@dataclass(frozen=True)
class Config:
    """A complete configuration: estimator, preset and a value for every key."""

    estimator: str
    preset: str
    values: Mapping[str, Value]

    def __getitem__(self, key: str) -> Value:
        return self.values[key]

    def number(self, key: str) -> float:
        """Value as a number; the code of a switch."""
        value = self.values[key]
        words = KEYS[key].words
        return float(words.index(str(value))) if words else float(value)

    def to_toml(self) -> str:
        """The file that reproduces the run."""
        import tomli_w

        tables: dict[str, Any] = {"estimator": self.estimator, "preset": self.preset}
        for key, value in self.values.items():
            head, _, tail = key.partition(".")
            tables.setdefault(head, {})[tail] = value
        return tomli_w.dumps(tables)

    def changed(self, **keys: Value) -> Config:
        """Same configuration with some keys changed; dots are written as two underscores."""
        return resolve(self.estimator, self.preset, {**self.values, **{k.replace("__", "."): v for k, v in keys.items()}})


def defaults(estimator: str = "navigator", preset: str = "default") -> dict[str, Value]:
    """Every key with its value before anything is overridden."""
    if str(estimator) not in PRESETS:
        near = difflib.get_close_matches(str(estimator), ESTIMATORS, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"one of {', '.join(ESTIMATORS)}"
        raise UsageError("an estimator", repr(estimator), "--estimator", hint)
    if preset not in PRESETS[estimator]:
        why = (
            f"{estimator} is not one of the published designs, so it has no printed or corrected form"
            if len(PRESETS[estimator]) == 1
            else ""
        )
        if estimator == "fault-tolerant":
            why = "the printed thresholds of source F are lost, and most of its formulas with them"
        raise UsageError(f"a preset of {estimator} ({', '.join(PRESETS[estimator])})", repr(preset), "--preset", why)
    return {key: spec.default for key, spec in KEYS.items()} | _OVERRIDES[estimator] | _PRESET_OVERRIDES.get((estimator, preset), {})


def _check(key: str, value: Any, where: str) -> Value:
    """Value of a key in its proper type, or an error that says what is wrong."""
    spec = KEYS.get(key)
    if spec is None:
        near = [k for k in (*KEYS, *GROUPS) if k.startswith(key)] or difflib.get_close_matches(key, [*KEYS, *GROUPS], 1)
        raise UsageError(
            "a configuration key", repr(key), where, f"did you mean {near[0]!r}?" if near else "see the documentation's table of keys"
        )
    if spec.words:
        word = {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value).strip()
        # the word itself, another way to write a unit, or axes in small letters
        found = next((w for w in (word, unit_word(word), word.upper(), word.lower()) if w in spec.words), None)
        if found is None:
            near = [w for w in spec.words if w.lower() == word.lower()] or difflib.get_close_matches(word, spec.words, 1)
            near = near if spec.words is not axes.WORDS else []
            raise UsageError(f"{key} to be {spec.unit}", repr(value), where, f"did you mean {near[0]!r}?" if near else "")
        return found
    if spec.text is not None:
        return spec.text(str(value), f"{where}: {key}" if where else key)
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise UsageError(f"a number [{spec.unit}] for {key}", repr(value), where) from None
    if math.isnan(number) and isinstance(spec.default, float) and math.isnan(spec.default):
        return number
    if not (spec.low <= number <= spec.high) or math.isinf(number):
        bounds = f"between {spec.low:g} and {spec.high:g}" if spec.high < math.inf else f"of at least {spec.low:g}"
        raise UsageError(f"a number [{spec.unit}] {bounds if spec.low > -math.inf else 'that is finite'} for {key}", repr(value), where)
    return number


def resolve(estimator: str = "navigator", preset: str = "default", overrides: Mapping[str, Any] | None = None, where: str = "") -> Config:
    """Complete configuration of an estimator from its preset and overrides.

    Raises
    ------
    UsageError
        Unknown estimator, preset or key (with the nearest name), a value out of bounds, or a key the estimator lacks.
    """
    values = defaults(estimator, preset)
    fixed = (*_FIXED[estimator], *_FIXED_PRESET.get((estimator, preset), ()))
    lacks = _LACKS[estimator] | _LACKS_PRESET.get((estimator, preset), {})
    for key, value in (overrides or {}).items():
        for name in GROUPS.get(key, (key,)):
            checked = _check(name, value, where)
            same = checked == values[name] or (checked != checked and values[name] != values[name])
            if name in fixed and not same:
                raise UsageError(f"a key that {estimator} has", repr(name), where, f"{estimator} keeps it at {values[name]}")
            if checked in lacks.get(name, ()):
                left = [w for w in KEYS[name].words if w not in lacks[name]]
                raise UsageError(f"{name} of {estimator} to be {' or '.join(left)}", repr(checked), where)
            values[name] = checked
    if estimator == "two-stage" and not float(values["two_stage.k1"]) < float(values["two_stage.k2"]):
        found = f"{values['two_stage.k1']} and {values['two_stage.k2']}"
        raise UsageError("two_stage.k1 below two_stage.k2", found, where, "the variance is inflated between them")
    return Config(estimator, preset, values)


def parse_assignment(text: str) -> tuple[str, str]:
    """Key and value of ``key=value`` as given to ``--set``."""
    key, sign, value = text.partition("=")
    if not sign or not key.strip() or not value.strip():
        raise UsageError("key=value", repr(text), "--set", "for example --set gate.gnss=4")
    return key.strip(), value.strip()


def load(path: str | Path) -> tuple[str | None, str | None, dict[str, Value]]:
    """Estimator, preset (None where not said) and keys of a configuration file."""
    path = Path(path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError("a configuration file", "no such file", str(path)) from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise HaltereError("a TOML file of configuration keys", str(error), str(path)) from None
    keys: dict[str, Value] = {}
    for head, body in document.items():
        if head in ("estimator", "preset"):
            continue
        if not isinstance(body, dict):
            _check(head, body, str(path))
            continue
        for tail, value in body.items():
            key = f"{head}.{tail}"
            for name in GROUPS.get(key, (key,)):
                keys[name] = _check(name, value, str(path))
    return document.get("estimator"), document.get("preset"), keys
