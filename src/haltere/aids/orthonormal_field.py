"""Magnetometer of `two-stage`: the field without its dip, made orthonormal with EKF A's gravity, and its anomaly index. No calibration.

Gravity in the body frame from EKF A (35), east (36), the unit horizontal field (37)-(38); its model for EKF B (41)-(42); the index of
how the field's strength fits (43), the factor on its variance (44)-(45). (35)-(38), (44) and (45) were pictures in the source and are
reconstructed, theory.md §4.5 and §4.7 say on what grounds.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit
from haltere.aids.fusing import ANY_TURN, NO_GATE, NOTHING, RUNNING, THREE, Offer
from haltere.aids.magnetometer import learn_field, reset_yaw, yaw_variance
from haltere.aids.record import C_FIELD, E_RESET, FUSED, MAGNETOMETER, R_HORIZONTAL, R_NONE, R_START, R_STRENGTH, event, record
from haltere.core.rotation import Vec, cross, dcm, dot, mat_vec, norm, scale, sub, tmat_vec, wrap
from haltere.filter.robust import DROPPED, PLAIN, inflate
from haltere.filter.update import NONE, Row
from haltere.strapdown.layout import THETA

__all__ = ["decorrelated", "index", "offer", "orthonormal", "variances"]

#: Words of ``two_stage.index``.
RELATIVE, ALGEBRAIC = (constant(i) for i in (0, 1))
#: a of (25) for a sphere of radius |H| about the origin is (1, 1, 1, 0, ..., -|H|²) times this, where its fit was held to aᵀ B a = 1 (26)
#: with B of Li and Griffiths: 4 J - I² = 3 c².
SPHERE = 1.0 / math.sqrt(3.0)
#: From sqrt(NIS/3) to sqrt(NIS): of the three components only the heading is much the magnetometer's.
ROOT3 = math.sqrt(3.0)
#: The measurement along (ê, ĝ, m_⊥).
UNIT_NORTH = (0.0, 0.0, 1.0)


@jit
def orthonormal(g: Vec, m: Vec) -> tuple[Vec, Vec, float]:
    """East ê = ĝ × m/|ĝ × m| (36), horizontal field m_⊥ = ê × ĝ (37)-(38), and |ĝ × m|; [R], theory.md §4.5.

    Parameters
    ----------
    g
        Unit gravity, body frame (35).
    m
        Field, body frame [uT].
    """
    across = cross(g, m)
    horizontal = norm(across)
    east = scale(across, 1.0 / max(horizontal, 1e-9))
    return east, cross(east, g), horizontal


@jit
def variances(a: Any, g: Vec, m: Vec, noise: float, radial: float, repeats: float) -> tuple[float, float, float, float]:
    """R_⊥ of m_⊥ in the axes (ê, ĝ, m_⊥): east, down, their covariance, north (theory.md §4.5, reconstructed).

    R_⊥ = J_m σ² J_mᵀ + J_g P_g J_gᵀ + σ_r² m_⊥ m_⊥ᵀ with P_g = [ĝ]× P_θ [ĝ]×ᵀ of EKF A. In these axes, with the error δθ of A,
    δm_⊥ = (n_e/|ĝ × m| - tan I (m_⊥ᵀ δθ)) ê + (êᵀ δθ) ĝ: nothing along m_⊥, for which there is the slack σ_r.

    Parameters
    ----------
    a
        Record of EKF A, whose P_θ is read.
    g, m
        Unit gravity and field [uT], body frame.
    noise
        Variance of the field [uT^2].
    repeats
        Factor on P_g: over how many samples an error of A lasts.
    radial
        Slack σ_r [1]; NaN: as much as the noise makes across.
    """
    east, north, horizontal = orthonormal(g, m)
    tan_dip = dot(g, m) / max(horizontal, 1e-9)
    nn, ne, ee = 0.0, 0.0, 0.0
    for i in range(3):
        for j in range(3):
            p = repeats * a.P[i, j]
            nn += north[i] * p * north[j]
            ne += north[i] * p * east[j]
            ee += east[i] * p * east[j]
    noise /= max(horizontal * horizontal, 1e-18)
    return noise + tan_dip * tan_dip * nn, ee, -tan_dip * ne, radial * radial if radial == radial else noise


@jit
def decorrelated(east: Vec, g: Vec, north: Vec, h: Vec, R: tuple[float, float, float, float]) -> tuple[Vec, tuple[Row, Row, Row], Vec]:
    """Predictions, rows of H and variances along (ê, ĝ - k ê, m_⊥), which R_⊥ does not correlate: k is the covariance over R_ee.

    Parameters
    ----------
    east, g, north
        Axes in the body frame, from EKF A and the field.
    h
        Prediction C_Bᵀ [cos D, sin D, 0] (41)-(42); its derivative against δθ of EKF B is [h]×.
    R
        From `variances`.
    """
    r_e, r_d, r_ed, r_n = R
    k = r_ed / r_e
    down = sub(g, scale(east, k))
    H = (
        ((THETA, cross(east, h)), NONE, NONE),
        ((THETA, cross(down, h)), NONE, NONE),
        ((THETA, cross(north, h)), NONE, NONE),
    )
    return (dot(east, h), dot(down, h), dot(north, h)), H, (r_e, r_d - k * r_ed, r_n)


@jit
def index(prm: Any, m: Vec, strength: float) -> float:
    """Deviation s = ln ξ/T_D = |F|/T_D, with ξ = exp |F| (43).

    Relative, [C]: F = |m|²/|H|² - 1 of the calibrated field, without dimension. Algebraic, [S]: F of (25) as it stands, d(m)ᵀ a, which
    for a calibrated field is c (|m|² - |H|²) and has the unit of the field squared [uT²]: in gauss it would be 10⁴ times smaller.
    The tolerance T_D, where it is not given, is the index's own standard deviation 2 σ_m/|H|, with all that is told of the field's noise.
    """
    excess = dot(m, m) - strength * strength
    F = excess / (strength * strength)
    if prm.two_stage_index == ALGEBRAIC:
        F = SPHERE * excess
    tolerance = prm.two_stage_tolerance
    if tolerance != tolerance:
        tolerance = 2.0 * math.sqrt(prm.noise_magnetometer**2 + prm.noise_field**2) / strength
    return abs(F) / tolerance


@jit
def begin_yaw(s: Any, stage: Any, prm: Any, m: Any, aids: Any, heading: float) -> None:
    """Set an unknown yaw from the first field, in both stages."""
    reset_yaw(s, heading, prm.init_yaw_compass)
    mu = mat_vec(dcm((stage.q[0], stage.q[1], stage.q[2], stage.q[3])), (m.z[0], m.z[1], m.z[2]))
    reset_yaw(stage, wrap(s.field[0] - math.atan2(mu[1], mu[0])), prm.init_yaw_compass)
    event(s, m.t, E_RESET, MAGNETOMETER, heading)
    record(s, aids, m.t, MAGNETOMETER, C_FIELD, heading, 0.0, prm.init_yaw_compass, 0.0, 1.0, FUSED, R_START)


@jit
def offer(s: Any, stage: Any, prm: Any, m: Any, aids: Any) -> Offer:
    """Magnetometer sample ``m.z`` [uT, body] to EKF B: z = m_⊥, h = C_Bᵀ [cos D, sin D, 0] (41)-(42), R̄ = λ R_⊥ (45).

    ``stage`` is the record of EKF A, whose gravity it is.

    The three components are those along EKF A's east, down and north, decorrelated in this order, so that fusing them one after the
    other is the joint update. In λ go the strength (44) and, where ``two_stage.innovation`` is on, sqrt(NIS), as one factor each.

    A shares IMU and GNSS with B, and its error lasts: the source takes every sample for a new measurement of gravity. [E]: with
    ``two_stage.memory`` τ, P_g counts as often as samples fall into 2τ, the length of a first-order process' memory, as does
    ``noise.field`` within its own time. The test is of a sample alone, but for the component along gravity, which is not the
    magnetometer's.
    """
    z = (m.z[0], m.z[1], m.z[2])
    a = s.aid[MAGNETOMETER]
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    mu = mat_vec(C, z)
    if s.has_field == 0:
        learn_field(s, mu, s.field[0])
    g = dcm((stage.q[0], stage.q[1], stage.q[2], stage.q[3]))[2]
    east, north, horizontal = orthonormal(g, z)
    factor, reason = 1.0, R_NONE
    form = int(prm.two_stage_robust)
    if form != PLAIN:
        factor = inflate(form, index(prm, z, s.field[2]), prm.two_stage_k1, prm.two_stage_k2)
    if factor >= DROPPED:
        reason = R_STRENGTH
    elif horizontal < 0.2 * s.field[2] * math.cos(s.field[1]):
        reason = R_HORIZONTAL
    if a.started == 0 and reason == R_NONE:
        a.started = RUNNING
        a.t_passed = m.t
        if yaw_variance(s, C) > 0.25:  # above 30 deg linearisation means little: set, do not fuse
            begin_yaw(s, stage, prm, m, aids, wrap(s.field[0] - math.atan2(mu[1], mu[0])))
            return NOTHING
    white, slow = prm.noise_magnetometer * prm.noise_magnetometer, prm.noise_field * prm.noise_field
    since = max(m.t - s.compass.t_before, 1e-3)
    s.compass.t_before = m.t
    once = variances(stage, g, z, white + slow, prm.two_stage_radial, 1.0)
    alike = max(1.0, 2.0 * prm.noise_field_time / since)
    lasting = variances(stage, g, z, white + alike * slow, prm.two_stage_radial, max(1.0, 2.0 * prm.two_stage_memory / since))
    shared = lasting[0] / once[0]
    h = tmat_vec(C, (math.cos(s.field[0]), math.sin(s.field[0]), 0.0))
    predicted, H, r = decorrelated(east, g, north, h, lasting)
    r = (once[0], r[1] / shared, once[3])
    gate, soft, how = NO_GATE, NO_GATE, PLAIN
    if prm.two_stage_innovation > 0.0:
        gate, soft, how = prm.gate_magnetometer, prm.robust_innovation / ROOT3, form
    return (
        THREE, C_FIELD, UNIT_NORTH, predicted, r, H, gate, prm.timeout_magnetometer, reason, ANY_TURN, (how, soft, 1.0 / factor, shared),
    )  # fmt: skip
