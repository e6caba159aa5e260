"""State layouts and the parameter record as NumPy dtypes: what a filter remembers, and what it is told. No arithmetic.

The first fifteen error states are the same in every layout, in this order: attitude (body), velocity (NED), position (NED),
gyro bias, accelerometer bias; optional blocks follow. A layout is a dtype: kernels are generic over the record they are
given, an absent block is a field of length zero, and one machine-code version is compiled for each layout in use.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from haltere._jit import constant
from haltere.core.lumped import lumped_layout
from haltere.strapdown.bank import bank
from haltere.strapdown.model_chain import chain
from haltere.strapdown.pairs import pairs

__all__ = [
    "AID_STATE",
    "ALIGNMENT",
    "BA",
    "BG",
    "COMPASS_BINS",
    "CORE",
    "EVENT",
    "IMU_SAMPLE",
    "LAST",
    "MEASUREMENT",
    "PARAMETERS",
    "POS",
    "REST",
    "ROTOR_CAPACITY",
    "STAGE",
    "THETA",
    "VEL",
    "layout",
]

#: First column of each core block.
THETA, VEL, POS, BG, BA = (constant(i) for i in (0, 3, 6, 9, 12))
#: Block that ends in column 15, the first one after the core: a single state there is ``(LAST, (0, 0, h))``.
LAST = constant(13)
#: Number of core error states.
CORE = 15

#: IMU samples that wait for the fusion horizon, and measurements a sensor.
IMU_CAPACITY = 512
MEASUREMENT_CAPACITY = 128
#: Samples of rotor speeds that wait, where a vehicle's model hears them.
ROTOR_CAPACITY = 512
EVENT_CAPACITY = 32
#: Sensors whose measurements are queued.
N_QUEUES = 10
#: Tenths of a second that the compass watch looks back, in a plain number: it is a modulus.
COMPASS_BINS = constant(128)


def _record(*fields: tuple[object, ...]) -> np.dtype[np.void]:
    """Nested record type that plain Python can also reach by attribute."""
    return np.dtype((np.record, list(fields)), align=True)


IMU_SAMPLE = _record(("t", "f8"), ("w", "f8", 3), ("f", "f8", 3))

#: A measurement: valid time, up to three values and their variances (NaN: not given).
MEASUREMENT = _record(("t", "f8"), ("z", "f8", 3), ("r", "f8", 3))

#: What the filter remembers of one sensor.
AID_STATE = _record(
    ("t_offered", "f8"),  # last measurement seen
    ("t_passed", "f8"),  # last measurement that passed its test
    ("t_due", "f8"),  # next time of a pseudo-measurement
    ("started", "i8"),
    ("n_fused", "i8"),
    ("n_rejected", "i8"),
    ("n_late", "i8"),
    ("n_overflow", "i8"),
)

#: Statistics of the last second, in four blocks of a quarter: is the vehicle at rest?
REST = _record(
    ("block", "i8"),
    ("filled", "i8"),
    ("t_block", "f8"),
    ("n", "f8", 4),
    ("w", "f8", (4, 3)),
    ("ww", "f8", (4, 3)),
    ("f", "f8", (4, 3)),
    ("a", "f8", 4),
    ("aa", "f8", 4),
    ("still", "i8"),
    ("mean_w", "f8", 3),
    ("mean_f", "f8", 3),
    ("mean_a", "f8"),
    ("moved", "i8"),
)

#: What initial alignment has gathered.
ALIGNMENT = _record(
    ("t_first", "f8"),
    ("t_span", "f8"),
    ("open", "i8"),
    ("q", "f8", 4),  # body now to body at the start of the span
    ("f", "f8", 3),  # integral of specific force over the span, in the body frame at its start
    ("m", "f8", 3),  # sum of magnetometer samples, likewise
    ("n_m", "f8"),
    ("v", "f8", 3),  # GNSS velocity at the start of the span
    ("ref_f_b", "f8", 3),  # specific force of an earlier span, in the body frame at the start of this one, and in NED
    ("ref_f_n", "f8", 3),
    ("t_ref", "f8"),
    ("gnss_v", "f8", 3),
    ("gnss_v_sd", "f8", 3),
    ("t_gnss_v", "f8"),
    ("gnss_p", "f8", 3),
    ("gnss_p_sd", "f8", 3),
    ("t_gnss_p", "f8"),
    ("baro", "f8"),
    ("t_baro", "f8"),
    ("n_baro", "f8"),
    ("kind", "i8"),
    ("given", "f8", 4),  # attitude told from outside, and when
    ("t_given", "f8"),
)

#: Bank of yaw hypotheses: states [v_N, v_E, yaw error], covariances, weights, and the velocity increment since the last fix.
YAW_BANK = _record(
    ("x", "f8", (5, 3)),
    ("P", "f8", (5, 3, 3)),
    ("w", "f8", 5),
    ("dv", "f8", 2),
    ("slow", "f8", 2),
    ("z", "f8", 2),  # the fix that waits for the bank, and its variance
    ("r", "f8"),
    ("fresh", "i8"),
    ("t", "f8"),
    ("n", "i8"),
    ("corrected", "f8"),  # corrections of yaw that the hypotheses have followed [rad]
)

#: One bin of the history of `haltere.aids.compass`.
COMPASS_BIN = _record(
    ("t", "f8"),
    ("d", "f8"),  # turn that the compass shows and the gyro does not [rad]
    ("drift", "f8"),  # integral of the vertical gyro bias in use [rad]
    ("bias", "f8"),  # vertical gyro bias [rad/s]
    ("pulled", "f8"),  # what the compass did to yaw [rad] and to the vertical gyro bias [rad/s], in all, and the integral of that
    ("pulled_bias", "f8"),
    ("pulled_drift", "f8"),
    ("path", "f8"),  # integral of the rate's size [rad], and that size [rad/s]
    ("rate", "f8"),
    ("yaw_var", "f8"),
    ("tilt_var", "f8"),
    ("bias_var", "f8"),
    ("q", "f8", 4),
)

#: What the compass watch remembers.
COMPASS = _record(
    ("out", "i8"),  # 0: heard, else what put it out
    ("seen", "i8"),
    ("known", "i8"),
    ("strength", "f8"),  # field of the flight so far [uT], and its dip [rad]
    ("dip", "f8"),
    ("bad", "f8"),  # share of refused samples lately
    ("slow", "f8"),  # smoothed innovation while out [rad]
    ("onset", "f8"),
    ("level", "f8"),
    ("t_good", "f8"),
    ("t_bad", "f8"),
    ("t_last", "f8"),
    ("t_before", "f8"),
    ("t_bin", "f8"),
    ("last", "f8"),
    ("total", "f8"),
    ("n", "i8"),
    ("noise", "f8"),
    ("drift", "f8"),
    ("pulled", "f8"),
    ("pulled_bias", "f8"),
    ("pulled_drift", "f8"),
    ("path", "f8"),
    ("path_before", "f8"),
    ("t_close", "f8"),
    ("pending", "i8"),  # diagnosis looks into a step of it
    ("jump", "f8"),  # what put it out [rad], and the 1 sigma of yaw then
    ("yaw_sd", "f8"),
    ("head", "i8"),
    ("filled", "i8"),
    ("bin", COMPASS_BIN, (COMPASS_BINS,)),
)

#: What is known of the field of the motors' currents, see `haltere.aids.interference`.
MOTORS = _record(
    ("known", "i8"),
    ("used", "i8"),
    ("current", "f8"),  # battery current [A], its last change, and its time
    ("change", "f8"),
    ("t_load", "f8"),
    ("reference", "f8"),  # current at alignment [A]
    ("t_start", "f8"),
    ("t_last", "f8"),
    ("mean_u", "f8"),
    ("mean_y", "f8", 3),
    ("weight", "f8"),  # seconds remembered
    ("sxx", "f8"),
    ("sxy", "f8", 3),
    ("syy", "f8", 3),
    ("k", "f8", 3),  # [uT/A], and the 1 sigma of its length
    ("sd", "f8"),
)

#: What the air aids remember: the last stretch of specific force in flight, and how the rotors' speed goes with thrust.
AIR = _record(
    ("t", "f8"),  # since when it is gathered [s]
    ("dt", "f8"),
    ("f", "f8", 3),  # integral of the raw specific force [m/s]
    ("v", "f8", 3),  # velocity NED [m/s] and attitude at its start
    ("q", "f8", 4),
    ("airborne", "i8"),
    ("level", "f8"),  # height down [m] where it last rested
    ("t_rest", "f8"),
    ("t_rotors", "f8"),
    ("speed", "f8"),  # sum of the rotors' speeds [rad/s]
    ("ratio", "f8"),  # that over the square root of thrust, slowly followed
    ("n_ratio", "i8"),
)

#: ``onset`` and ``threshold`` where there is one, else the time itself and NaN.
EVENT = _record(
    ("t", "f8"),
    ("onset", "f8"),
    ("code", "i8"),
    ("sensor", "i8"),
    ("value", "f8"),
    ("threshold", "f8"),
    ("detail", "i8"),
    ("seen", "f8"),  # of a fault that was named: when it was first seen [s], its size with 1 sigma, what else it may be, bit by bit
    ("size", "f8"),
    ("sd", "f8"),
    ("candidates", "i8"),
    ("left", "f8"),  # what it leaves unexplained, as a part of what it explains
    ("alarms", "f8", 10),  # when each pair of model and IMU, and then J21 to J24, alarmed [s], NaN: not
)

#: A first stage: the part of a state that prediction and updates touch, with the core states only.
STAGE = _record(
    ("q", "f8", 4),
    ("v", "f8", 3),
    ("p", "f8", 3),
    ("bg", "f8", 3),
    ("ba", "f8", 3),
    ("baro", "f8", (0,)),
    ("mag", "f8", (0,)),
    ("bank", bank(CORE), (0,)),
    ("wind", "f8", (0,)),
    ("drag", "f8", (0,)),
    ("steady", "f8", (0,)),
    ("vane", "f8", (0,)),
    ("twist", "f8", (0,)),
    ("pairs", pairs(), (0,)),
    ("P", "f8", (CORE, CORE)),
    ("dx", "f8", CORE),
    ("u", "f8", CORE),
    ("k", "f8", CORE),
    ("w", "f8", 3),
    ("yaw_corrected", "f8"),
    ("gravity", "f8"),
)

#: Every number a filter is told. Field ``noise_gyro`` is configuration key ``noise.gyro``.
PARAMETERS = np.dtype(
    [
        (name, "f8")
        for name in (
            "noise_gyro noise_gyro_scale noise_between noise_accel noise_gyro_bias noise_accel_bias noise_baro_bias "
            "noise_gnss_velocity noise_gnss_position noise_gnss_altitude noise_gnss_velocity_min noise_gnss_position_min "
            "noise_barometer noise_magnetometer noise_field noise_field_time noise_mag_offset "
            "noise_zero_velocity noise_zero_rate noise_fake_position noise_fake_position_rest noise_fake_velocity "
            "noise_wind_mean noise_air_walk air_gust air_turbulence air_gust_time "
            "noise_airspeed noise_aoa noise_sideslip noise_no_sideslip noise_drag noise_given_wind "
            "noise_attitude noise_attitude_yaw noise_attitude_time noise_drag_time noise_airdata_time "
            "gate_gnss gate_barometer gate_magnetometer gate_zero_velocity gate_zero_rate gate_air gate_drag gate_attitude "
            "delay_gnss_velocity delay_gnss_position delay_barometer delay_magnetometer delay_power "
            "delay_rotors delay_airdata delay_wind delay_attitude "
            "aid_gnss aid_barometer aid_magnetometer aid_zero_velocity aid_zero_rate aid_fake_position aid_fake_velocity aid_yaw_bank "
            "aid_compass_watch aid_motor_field aid_airdata aid_no_sideslip aid_drag aid_wind aid_attitude "
            "air_moves air_density air_airspeed_min "
            "drag_mu drag_mu_sd drag_c drag_c_sd drag_offset_sd "
            "timeout_gnss timeout_barometer timeout_magnetometer timeout_air timeout_drag timeout_attitude timeout_imu "
            "arm_gnss_x arm_gnss_y arm_gnss_z "
            "robust_innovation robust_strength robust_dip robust_heading robust_calibration "
            "field_declination field_dip field_strength field_tolerance_strength field_tolerance_dip "
            "init_tilt_rest init_tilt_motion init_yaw_compass init_yaw_unknown init_gyro_bias_rest init_gyro_bias "
            "init_accel_bias init_velocity init_baro_bias init_mag_offset "
            "init_wind init_airspeed_scale init_vane "
            "rest_gyro rest_accel rest_gravity "
            "two_stage_tolerance two_stage_k1 two_stage_k2 two_stage_robust two_stage_index two_stage_innovation "
            "two_stage_radial two_stage_memory "
            "two_stage_haversine two_stage_height_sign "
            "diagnosis_inertial diagnosis_gyro diagnosis_accel diagnosis_threshold "
            "diagnosis_vehicle diagnosis_force diagnosis_moment diagnosis_pair_threshold "
            "diagnosis_chain_single diagnosis_chain_triple "
            "wind_attitude_integrator wind_attitude_residual wind_attitude_rows wind_attitude_normalise wind_attitude_angles "
            "wind_attitude_accel wind_attitude_force wind_attitude_acceleration wind_attitude_gate wind_attitude_air "
            "fault_tolerant_detector fault_tolerant_reset fault_tolerant_wind fault_tolerant_biases fault_tolerant_isolate "
            "fault_tolerant_fuse_rate fault_tolerant_step fault_tolerant_wait fault_tolerant_recover "
            "imu_mean horizon covariance_interval"
        ).split()
    ],
    align=True,
)


@cache
def layout(
    baro: int = 0, mag: int = 0, stages: int = 0, wind: int = 0, drag: int = 0, vane: int = 0, banks: int = 0,
    rotors: int = 0, twist: int = 0, beside: np.dtype[np.void] | None = None,
) -> np.dtype[np.void]:  # fmt: skip
    """State record type.

    Parameters
    ----------
    baro
        1 with the barometer offset as a state, else 0.
    mag
        3 with the offset of the magnetometer as states, else 0.
    stages
        1 with a first stage beside the main state (`two-stage`), else 0.
    wind
        2 with the horizontal wind as states, and the mean that its gusts return to, 3 with the vertical wind too, else 0.
    drag
        4 with the drag of a multirotor as states, else 0; it needs a wind of 2.
    vane
        1 with the scale of the airspeed as a state, 3 with the offsets of both vanes too, else 0.
    banks
        1 with the memory of diagnosis, else 0.
    rotors
        Number of rotors of the vehicle's model, 0 without one.
    twist
        3 with the offset of that model's moments as states, and all that lets it stand in for axes of the IMU, else 0.
    beside
        Record type of what an estimator remembers beside all this (`fault-tolerant`); None for nothing.

    Returns
    -------
    numpy.dtype
        Nominal state, covariance ``P`` (n, n), scratch, queues, monitors and counters: the whole memory of a filter.
    """
    n = CORE + baro + mag + (wind + 2 if wind else 0) + drag + vane + twist
    return np.dtype(
        [
            ("t", "f8"),
            ("q", "f8", 4),
            ("v", "f8", 3),
            ("p", "f8", 3),
            ("bg", "f8", 3),
            ("ba", "f8", 3),
            ("baro", "f8", (baro,)),
            ("mag", "f8", (mag,)),  # offset of the magnetometer in the body frame [uT]
            ("wind", "f8", (wind,)),  # NED [m/s]; in a layout with drag its force at hover [m/s^2], see `aids.air`
            ("drag", "f8", (drag,)),  # ln mu [1/s], ln c [1/m], offset of the thrust's axis along x and y [m/s^2]
            ("steady", "f8", (2 if wind else 0,)),  # what the wind returns to after gusts, likewise
            ("vane", "f8", (vane,)),  # ln of the airspeed's scale, offsets of angle of attack and sideslip [rad]
            ("twist", "f8", (twist,)),  # what the moments of the vehicle's model lack [rad/s^2]
            ("P", "f8", (n, n)),
            ("dx", "f8", n),
            ("u", "f8", n),
            ("k", "f8", n),
            ("w", "f8", 3),  # corrected angular rate of the last step
            ("w_raw", "f8", 3),
            ("f_raw", "f8", 3),
            ("anchor", "f8", 3),  # last position that something held
            ("yaw_corrected", "f8"),  # sum of the turns about the vertical that corrections made [rad]
            ("baro_start", "f8"),  # barometric height minus height at the start [m]
            ("gravity", "f8"),
            ("origin", "f8", 3),
            ("has_origin", "i8"),
            ("field", "f8", 3),  # declination, dip [rad], strength [uT] in use
            ("has_field", "i8"),
            ("phase", "i8"),  # 0 nothing seen, 1 aligning, 2 running
            ("n_aligned", "i8"),
            ("t_aligned", "f8"),
            ("t_newest", "f8"),
            ("t_wake", "f8"),  # nothing is to be fused before this time
            ("t_covariance", "f8"),
            ("n_steps", "i8"),
            ("n_unaligned", "i8"),
            ("n_gaps", "i8"),
            ("n_bad", "i8"),
            ("n_ring_full", "i8"),
            ("n_rows", "i8"),
            ("n_nodes", "i8"),
            ("n_since", "i8"),
            ("n_cov", "i8"),
            ("n_aids", "i8"),
            ("n_aids_lost", "i8"),
            ("n_events", "i8"),
            ("n_events_lost", "i8"),
            ("event", EVENT, (EVENT_CAPACITY,)),
            ("aid", AID_STATE, (16,)),
            ("rest", REST),
            ("yaw", YAW_BANK),
            ("compass", COMPASS),
            ("motors", MOTORS),
            ("air", AIR),
            ("align", ALIGNMENT),
            ("imu_head", "i8"),
            ("imu_n", "i8"),
            ("imu", IMU_SAMPLE, (IMU_CAPACITY,)),
            ("a", STAGE, (stages,)),
            ("bank", bank(n), (banks,)),
            *_of_rotors(rotors),
            ("ft", _record(("on", "i8")) if beside is None else beside, (0 if beside is None else 1,)),
            ("pairs", pairs(), (1 if twist else 0,)),
            ("chain", chain(rotors), (1 if twist else 0,)),
            ("ring_head", "i8", N_QUEUES),
            ("ring_n", "i8", N_QUEUES),
            ("ring", MEASUREMENT, (N_QUEUES, MEASUREMENT_CAPACITY)),
        ],
        align=True,
    )


def _of_rotors(n: int) -> list[tuple[object, ...]]:
    """Fields of a vehicle's model of ``n`` rotors, of speeds that wait, and of the speeds at the state's time."""
    kind = np.dtype((np.record, lumped_layout(n)))
    return [
        ("model", kind, (1 if n else 0,)),
        ("speed", "f8", (n,)),  # [rad/s], and their rates of change [rad/s^2]
        ("spin_up", "f8", (n,)),
        ("rotor_known", "i8"),
        ("rotor_head", "i8"),
        ("rotor_n", "i8"),
        ("n_rotors", "i8"),  # samples of a log taken so far
        ("n_rotor_bad", "i8"),
        ("rotor", _record(("t", "f8"), ("o", "f8", (n,))), (ROTOR_CAPACITY if n else 0,)),
    ]
