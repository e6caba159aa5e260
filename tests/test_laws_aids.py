"""Laws of the aids: every row of H is the derivative of its own h, and what an update may not touch stays as it was."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from haltere._jit import COMPILED
from haltere.aids import barometer, fake, fusing, gnss, magnetometer, zero_rate, zero_velocity
from haltere.aids import record as records
from haltere.core.rotation import euler, quat_from_euler
from haltere.estimators.step import predict_interval
from haltere.strapdown.layout import MEASUREMENT, PARAMETERS, layout

FloatArray = NDArray[np.float64]
G = 9.80665
DEG = math.pi / 180.0
TH, V, P_, BG, BA = (slice(k, k + 3) for k in (0, 3, 6, 9, 12))
NAN = math.nan
ORIGIN = (46.8, 8.2, 600.0)


def array(dtype: np.dtype[np.void], n: int = 1) -> Any:
    out = np.zeros(n, dtype)
    return out if COMPILED else out.view(np.recarray)


def scipy_of(q: FloatArray) -> Rotation:
    return Rotation.from_quat(np.r_[q[1:], q[0]])


def scalar_first(r: Rotation) -> FloatArray:
    x, y, z, w = r.as_quat()
    return np.array([w, x, y, z])


def tup(a: FloatArray) -> tuple[float, ...]:
    return tuple(float(x) for x in a)


def parameters() -> Any:
    prm = array(PARAMETERS)[0]
    for name, value in {
        "noise_gnss_velocity": 0.5, "noise_gnss_position": 1.0, "noise_gnss_altitude": 2.0, "noise_gnss_velocity_min": 0.1,
        "noise_gnss_position_min": 0.5, "noise_barometer": 1.5, "noise_magnetometer": 2.0, "noise_zero_velocity": 0.05,
        "noise_zero_rate": 0.01, "noise_fake_position": 10.0, "noise_fake_position_rest": 0.5, "noise_fake_velocity": 2.0,
        "gate_gnss": 5.0, "gate_barometer": 5.0, "gate_magnetometer": 3.0, "gate_zero_velocity": 5.0, "gate_zero_rate": 5.0,
        "timeout_gnss": 7.0, "timeout_barometer": 7.0, "timeout_magnetometer": 10.0, "aid_magnetometer": 1.0, "init_baro_bias": 3.0,
        "arm_gnss_x": 0.3, "arm_gnss_y": -0.2, "arm_gnss_z": -0.5, "field_tolerance_strength": 0.35, "field_tolerance_dip": 20.0 * DEG,
        "init_yaw_compass": 10.0 * DEG, "robust_innovation": 1e9,
    }.items():  # fmt: skip
        prm[name] = value
    return prm


ARM = np.array([0.3, -0.2, -0.5])


def state(rng: np.random.Generator, baro: int = 1) -> Any:
    """Any attitude within 60 degrees of tilt, turning, every sensor already running, all states correlated."""
    s = array(layout(baro))[0]
    n = 15 + baro
    roll, pitch, yaw = rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), rng.uniform(-3.0, 3.0)
    s["q"][:] = quat_from_euler(roll, pitch, yaw)
    s["v"][:], s["p"][:] = rng.standard_normal(3) * 5.0, rng.standard_normal(3) * 20.0
    s["bg"][:], s["ba"][:] = rng.standard_normal(3) * 0.01, rng.standard_normal(3) * 0.2
    s["w"][:] = rng.standard_normal(3) * 2.0
    s["gravity"], s["t"] = G, 100.0
    s["origin"][:], s["has_origin"] = ORIGIN, 1
    s["field"][:], s["has_field"] = (0.05, 63.4 * DEG, 48.0), 1
    s["aid"]["started"][:] = 1
    s["aid"]["t_passed"][:] = 100.0
    s["phase"] = 2
    d = np.r_[np.repeat([0.02, 0.3, 1.0, 0.005, 0.1], 3), [2.0] * baro]
    a = rng.standard_normal((n, n))
    s["P"][:] = d[:, None] * (a @ a.T / n + 0.1 * np.eye(n)) * d
    s["P"][:] = 0.5 * (s["P"] + s["P"].T)
    return s


def measurement(z: tuple[float, float, float], r: tuple[float, float, float] = (NAN, NAN, NAN), t: float = 100.0) -> Any:
    m = array(MEASUREMENT)[0]
    m["t"], m["z"][:], m["r"][:] = t, z, r
    return m


def buffer() -> Any:
    return array(records.AID_RECORD, 64)


def perturbed(s: Any, x: FloatArray) -> Any:
    """The true state whose error, seen from s, is x: δθ turns the body, the rest adds, and the true rate lacks more bias."""
    out = array(s.dtype if COMPILED else np.dtype(s.dtype))[0]
    for name in s.dtype.names:
        out[name] = s[name]
    out["q"][:] = scalar_first(scipy_of(s["q"]) * Rotation.from_rotvec(x[TH]))
    out["v"][:], out["p"][:] = s["v"] + x[V], s["p"] + x[P_]
    out["bg"][:], out["ba"][:] = s["bg"] + x[BG], s["ba"] + x[BA]
    out["w"][:] = s["w"] - x[BG]
    if len(x) > 15:
        out["baro"][:] = s["baro"] + x[15:]
    return out


def dense(rows: Any, n: int) -> FloatArray:
    H = np.zeros((len(rows), n))
    for i, row in enumerate(rows):
        for c, h in row:
            H[i, c : c + 3] += h
    return H


def derivative(s: Any, h: Callable[[Any], FloatArray], n: int) -> FloatArray:
    """Central differences of a prediction in every error state; steps of 1e-5 leave 1e-10 and the roundings of h over 1e-5."""
    step, out = 1e-5, []
    for k in range(n):
        x = np.zeros(n)
        x[k] = step
        out.append((h(perturbed(s, x)) - h(perturbed(s, -x))) / (2.0 * step))
    return np.array(out).T


def predicted(offer: Any) -> FloatArray:
    n = offer[0]
    return np.array(offer[3][:n])


# h, H, R of each sensor


@pytest.mark.parametrize("seed", range(5))
def test_gnss_velocity_row(seed: int) -> None:
    s, prm = state(np.random.default_rng(seed)), parameters()
    m = measurement((1.0, 2.0, 3.0))
    offer = gnss.offer_velocity(s, prm, m)
    C = scipy_of(s["q"]).as_matrix()
    np.testing.assert_allclose(offer[3], s["v"] + C @ np.cross(s["w"], ARM), atol=1e-13)
    H = derivative(s, lambda x: predicted(gnss.offer_velocity(x, prm, m)), 16)
    np.testing.assert_allclose(dense(offer[5], 16), H, atol=1e-8)
    assert np.abs(H[:, BG]).max() > 0.1  # the antenna is off the centre
    assert (offer[0], offer[1], offer[2], offer[6], offer[7], offer[9]) == (
        3, records.C_VEL, (1.0, 2.0, 3.0), 5.0, 7.0, fusing.ANY_TURN,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_gnss_position_row(seed: int) -> None:
    s, prm = state(np.random.default_rng(seed)), parameters()
    m = measurement((46.8001, 8.2002, 610.0))
    offer = gnss.offer_position(s, prm, m, buffer(), 0.004)
    C = scipy_of(s["q"]).as_matrix()
    np.testing.assert_allclose(offer[3], s["p"] + C @ ARM, atol=1e-12)
    H = derivative(s, lambda x: predicted(gnss.offer_position(x, prm, m, buffer(), 0.004)), 16)
    np.testing.assert_allclose(dense(offer[5], 16), H, atol=1e-7)
    # a ten thousandth of a degree of latitude is 11.1 m; down is against altitude
    np.testing.assert_allclose(offer[2], [11.117, 15.25, -10.0], atol=0.02)


def test_gnss_variances() -> None:
    """The receiver's own, not below the floor; the configured ones where it says nothing; the time a fix falls within an interval."""
    s, prm = state(np.random.default_rng(1)), parameters()
    velocity = gnss.offer_velocity(s, prm, measurement((1.0, 2.0, 3.0), (0.04, 0.0001, NAN)))
    np.testing.assert_allclose(velocity[4], [0.04, 0.01, 0.25])
    position = gnss.offer_position(s, prm, measurement((46.8, 8.2, 600.0), (4.0, 0.01, NAN)), buffer(), 0.02)
    jitter = float(s["v"] @ s["v"]) * 0.02**2 / 12.0
    np.testing.assert_allclose(position[4], np.array([4.0, 0.25, 4.0]) + jitter, rtol=1e-13)


def test_the_antenna_moves_as_the_row_says() -> None:
    """An antenna at r on a body that turns: the difference of its position over a small time is v + C(ω×r).

    Central over ± h: h² times a third derivative of 20 m/s³; the mechanisation adds |ω||f|h²/12.
    """
    rng = np.random.default_rng(3)
    s, prm = state(rng), parameters()
    w, f = s["w"].copy(), np.array([1.0, 2.0, -9.0])
    h = 1e-4
    where = {}
    for sign in (1.0, -1.0):
        moved = perturbed(s, np.zeros(16))
        moved["ba"][:] = moved["bg"][:] = 0.0
        predict_interval(moved, prm, tup(w), tup(f), tup(w), tup(f), sign * h)
        where[sign] = moved["p"] + scipy_of(moved["q"]).as_matrix() @ ARM
    seen = gnss.offer_velocity(s, prm, measurement((0.0, 0.0, 0.0)))[3]
    np.testing.assert_allclose((where[1.0] - where[-1.0]) / (2.0 * h), seen, atol=20.0 * h * h + 1e-9)


def test_spinning_on_the_spot() -> None:
    """Turning at 2 rad/s on the spot, heading east, with the antenna 0.5 m ahead: it moves south at 1 m/s."""
    s, prm = state(np.random.default_rng(1)), parameters()
    s["q"][:] = quat_from_euler(0.0, 0.0, math.pi / 2)
    s["v"][:], s["w"][:] = 0.0, (0.0, 0.0, 2.0)
    prm["arm_gnss_x"], prm["arm_gnss_y"], prm["arm_gnss_z"] = 0.5, 0.0, 0.0
    np.testing.assert_allclose(gnss.offer_velocity(s, prm, measurement((0.0, 0.0, 0.0)))[3], [-1.0, 0.0, 0.0], atol=1e-15)


def test_barometer_row() -> None:
    s, prm = state(np.random.default_rng(2)), parameters()
    s["baro"][0] = 4.0
    m = measurement((650.0, NAN, NAN))
    offer = barometer.offer(s, prm, m, buffer())
    assert offer[0] == 1
    assert offer[2][0] == 50.0  # above the origin
    assert offer[3][0] == pytest.approx(-float(s["p"][2]) + 4.0)
    H = derivative(s, lambda x: predicted(barometer.offer(x, prm, m, buffer())), 16)
    np.testing.assert_allclose(dense(offer[5][:1], 16), H, atol=1e-9)
    assert offer[4][0] == 1.5**2


def test_barometer_row_without_offset_state() -> None:
    s, prm = state(np.random.default_rng(2), 0), parameters()
    s["baro_start"] = 4.0
    m = measurement((650.0, NAN, NAN))
    offer = barometer.offer(s, prm, m, buffer())
    assert (offer[0], offer[2][0]) == (1, 50.0)
    assert offer[3][0] == pytest.approx(-float(s["p"][2]) + 4.0)
    H = derivative(s, lambda x: predicted(barometer.offer(x, prm, m, buffer())), 15)
    np.testing.assert_allclose(dense(offer[5][:1], 15), H, atol=1e-9)


def test_first_barometer_sample_sets_the_offset() -> None:
    s, prm, aids = state(np.random.default_rng(2)), parameters(), buffer()
    s["aid"]["started"][2] = 0
    P = s["P"].copy()
    assert barometer.offer(s, prm, measurement((650.0, NAN, NAN)), aids)[0] == 0
    assert float(s["baro"][0]) == pytest.approx(50.0 + float(s["p"][2]))  # so that the next innovation is nothing
    np.testing.assert_array_equal(s["P"][:15, :15], P[:15, :15])
    assert not s["P"][15, :15].any()
    assert not s["P"][:15, 15].any()
    assert s["P"][15, 15] == 9.0
    assert (s["n_aids"], aids[0]["reason"]) == (1, records.R_START)


def test_pseudo_measurement_rows() -> None:
    s, prm = state(np.random.default_rng(4)), parameters()
    s["anchor"][:] = 1.0, 2.0, 3.0
    w = (0.1, 0.2, 0.3)
    cases: list[tuple[Callable[[Any], Any], tuple[float, ...], FloatArray, float]] = [
        (lambda x: zero_velocity.offer(x, prm), (0.0, 0.0, 0.0), s["v"], 0.05),
        (lambda x: zero_rate.offer(x, prm, w), w, s["bg"], 0.01),
        (lambda x: fake.offer_velocity(x, prm), (0.0, 0.0, 0.0), s["v"], 2.0),
        (lambda x: fake.offer_position(x, prm, False), (1.0, 2.0, 3.0), s["p"], 10.0),
        (lambda x: fake.offer_position(x, prm, True), (1.0, 2.0, 3.0), s["p"], 0.5),
    ]
    for make, z, h, sd in cases:
        offer = make(s)
        assert offer[0] == 3
        assert tuple(offer[2]) == z
        np.testing.assert_array_equal(offer[3], h)
        np.testing.assert_allclose(offer[4], sd**2)
        np.testing.assert_allclose(dense(offer[5], 16), derivative(s, lambda x, make=make: predicted(make(x)), 16), atol=1e-9)


# Magnetometer


def field(s: Any) -> FloatArray:
    d, i, h = s["field"]
    return h * np.array([math.cos(i) * math.cos(d), math.cos(i) * math.sin(d), math.sin(i)])


def levelled(estimate: Rotation, truth: Rotation, field_n: FloatArray, declination: float) -> float:
    """Innovation of a compass: what is seen at the true attitude, levelled and turned north with the estimated one."""
    mu = estimate.as_matrix() @ truth.as_matrix().T @ field_n
    y = declination - math.atan2(mu[1], mu[0])
    return (y + math.pi) % (2.0 * math.pi) - math.pi


def levelled_row(estimate: Rotation, field_n: FloatArray, declination: float) -> FloatArray:
    row, h = [], 1e-5
    for k in range(3):
        e = np.zeros(3)
        e[k] = h
        plus = levelled(estimate, estimate * Rotation.from_rotvec(e), field_n, declination)
        minus = levelled(estimate, estimate * Rotation.from_rotvec(-e), field_n, declination)
        row.append((plus - minus) / (2.0 * h))
    return np.array(row)


def heading_row(C: FloatArray, declination: float, dip: float) -> FloatArray:
    return np.array(magnetometer.heading_row(tuple(tup(r) for r in C), declination, dip))  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("dip", [-70.0, 0.0, 35.0, 63.4, 80.0])
def test_heading_row_is_the_derivative_of_the_levelled_innovation(seed: int, dip: float) -> None:
    rng = np.random.default_rng(seed)
    D, I = rng.uniform(-0.5, 0.5), dip * DEG
    attitude = Rotation.random(random_state=rng)
    m_n = 50.0 * np.array([math.cos(I) * math.cos(D), math.cos(I) * math.sin(D), math.sin(I)])
    expected = levelled_row(attitude, m_n, D)
    # third derivatives grow as tan³ of the dip: 180 at 80 degrees, times (1e-5)²
    np.testing.assert_allclose(heading_row(attitude.as_matrix(), D, I), expected, atol=1e-7)


def test_heading_row_of_the_amendment() -> None:
    """theory-amendments.md §1: dip 63.4°, row [1.854 -0.914 0.846] where the yaw's own derivative is [0 0.307 0.989].

    The attitude is the one whose yaw has that derivative, tanφ = 0.307/0.989 and 1/cosθ = |row|, nose down, 146° left of the field;
    the row is printed to three decimals, and the attitude known to two of them.
    """
    roll, pitch, yaw = math.atan2(0.307, 0.989), -math.acos(1.0 / math.hypot(0.307, 0.989)), -145.75 * DEG
    attitude = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    I = 63.4 * DEG
    m_n = np.array([math.cos(I), 0.0, math.sin(I)])
    assert levelled_row(attitude, m_n, 0.0) == pytest.approx([1.854, -0.914, 0.846], abs=4e-3)
    assert heading_row(attitude.as_matrix(), 0.0, I) == pytest.approx([1.854, -0.914, 0.846], abs=4e-3)
    # the state's yaw, for contrast: it does not know the dip
    assert heading_row(attitude.as_matrix(), 0.0, 0.0) != pytest.approx([0.0, 0.307, 0.989], abs=0.1)


def test_level_heading_row_is_tan_dip() -> None:
    """Level and north: an error of roll (about magnetic north) turns the heading by tan(dip), one of pitch not at all, yaw by one."""
    row = heading_row(np.eye(3), 0.0, 60.0 * DEG)
    np.testing.assert_allclose(row, [-math.tan(60.0 * DEG), 0.0, 1.0], atol=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_heading_offer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s, prm = state(rng), parameters()
    estimate = scipy_of(s["q"])
    truth = estimate * Rotation.from_rotvec(rng.standard_normal(3) * 0.03)
    offer = magnetometer.offer(s, prm, measurement(tup(truth.as_matrix().T @ field(s))), buffer())  # type: ignore[arg-type]
    assert offer[0] == 1
    assert offer[8] == records.R_NONE
    assert offer[9] == fusing.ONLY_TURN  # only the turn about the vertical is kept
    e = offer[2][0] - offer[3][0]
    assert e == pytest.approx(levelled(estimate, truth, field(s), 0.05), abs=1e-12)
    row = levelled_row(estimate, field(s), 0.05)
    np.testing.assert_allclose(dense(offer[5][:1], 16)[0], np.r_[row, np.zeros(13)], atol=1e-7)
    # R = (σ/(|H| cos I))², with the horizontal field of this very sample
    mu = estimate.as_matrix() @ truth.as_matrix().T @ field(s)
    assert offer[4][0] == pytest.approx((2.0 / math.hypot(mu[0], mu[1])) ** 2, rel=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_three_axes_row(seed: int) -> None:
    s, prm = state(np.random.default_rng(seed)), parameters()
    prm["aid_magnetometer"] = 2.0
    m = measurement(tup(scipy_of(s["q"]).as_matrix().T @ field(s)))  # type: ignore[arg-type]
    offer = magnetometer.offer(s, prm, m, buffer())
    np.testing.assert_allclose(offer[3], m["z"], atol=1e-12)
    H = derivative(s, lambda x: predicted(magnetometer.offer(x, prm, m, buffer())), 16)
    np.testing.assert_allclose(dense(offer[5], 16), H, atol=1e-6)
    np.testing.assert_allclose(offer[4], 4.0)
    assert (offer[0], offer[9]) == (3, fusing.ANY_TURN)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda m: 1.4 * m, records.R_STRENGTH),
        (lambda m: 0.6 * m, records.R_STRENGTH),
        (lambda m: m, records.R_NONE),
    ],
)
def test_magnetometer_refuses_a_wrong_strength(spoil: Callable[[FloatArray], FloatArray], reason: int) -> None:
    s, prm = state(np.random.default_rng(1)), parameters()
    z = spoil(scipy_of(s["q"]).as_matrix().T @ field(s))
    assert magnetometer.offer(s, prm, measurement(tup(z)), buffer())[8] == reason  # type: ignore[arg-type]


@pytest.mark.parametrize("tilt", [19.0, 21.0, -19.0, -21.0])
def test_magnetometer_refuses_a_wrong_dip(tilt: float) -> None:
    reason = records.R_DIP if abs(tilt) > 20.0 else records.R_NONE
    s, prm = state(np.random.default_rng(1)), parameters()
    s["q"][:] = 1.0, 0.0, 0.0, 0.0
    D, I = 0.05, (63.4 + tilt) * DEG
    z = 48.0 * np.array([math.cos(I) * math.cos(D), math.cos(I) * math.sin(D), math.sin(I)])
    assert magnetometer.offer(s, prm, measurement(tup(z)), buffer())[8] == reason  # type: ignore[arg-type]


def test_the_field_is_learnt_where_none_is_known() -> None:
    s, prm = state(np.random.default_rng(1)), parameters()
    s["has_field"], s["field"][:] = 0, (0.1, 0.0, 0.0)
    m_n = 45.0 * np.array([math.cos(1.0) * math.cos(0.3), math.cos(1.0) * math.sin(0.3), math.sin(1.0)])
    offer = magnetometer.offer(s, prm, measurement(tup(scipy_of(s["q"]).as_matrix().T @ m_n)), buffer())  # type: ignore[arg-type]
    assert s["has_field"] == 1
    np.testing.assert_allclose(s["field"], [0.1, 1.0, 45.0], rtol=1e-12)
    assert offer[8] == records.R_NONE


# What fusing does


def fuse(s: Any, sensor: int, offer: Any, aids: Any = None, t: float = 100.0) -> Any:
    aids = buffer() if aids is None else aids
    s["n_aids"] = 0
    fusing.fuse_offer(s, aids, t, sensor, offer)
    return aids[: int(s["n_aids"])]


@pytest.mark.parametrize("seed", range(10))
def test_heading_leaves_tilt_and_everything_else_alone(seed: int) -> None:
    """Roll and pitch, velocity, position, accelerometer bias, and all that P says of them and of tilt, are exactly what they were.

    The body has turned by a about the vertical d since, and the reset turns the error in it by half of that: I - ½a[d]×.
    """
    rng = np.random.default_rng(seed)
    s, prm = state(rng), parameters()
    estimate = scipy_of(s["q"])
    truth = Rotation.from_rotvec([0.002, -0.003, 0.04]) * estimate
    before = {k: s[k].copy() for k in ("q", "v", "p", "bg", "ba", "baro", "P")}
    out = fuse(s, 3, magnetometer.offer(s, prm, measurement(tup(truth.as_matrix().T @ field(s))), buffer()))  # type: ignore[arg-type]
    assert out["status"][0] == records.FUSED
    old, new = euler(tup(before["q"])), euler(tup(s["q"]))  # type: ignore[arg-type]
    assert new[:2] == pytest.approx(old[:2], abs=1e-14)
    assert abs(new[2] - old[2]) > 1e-6
    for name in ("v", "p", "ba", "baro"):
        np.testing.assert_array_equal(s[name], before[name])
    d = estimate.as_matrix()[2]
    moved = s["bg"] - before["bg"]
    np.testing.assert_allclose(np.cross(moved, d), 0.0, atol=1e-16)
    assert float(np.linalg.norm(moved)) > 1e-8
    rest = np.r_[3:9, 12:16]
    np.testing.assert_array_equal(s["P"][np.ix_(rest, rest)], before["P"][np.ix_(rest, rest)])
    across = np.cross(d, [1.0, 0.0, 0.0]) / np.linalg.norm(np.cross(d, [1.0, 0.0, 0.0]))
    U = np.array([across, np.cross(d, across)])
    M = np.eye(2) - 0.5 * float(s["yaw_corrected"]) * np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose(U @ s["P"][TH, TH] @ U.T, M @ U @ before["P"][TH, TH] @ U.T @ M.T, rtol=0.0, atol=1e-16)
    np.testing.assert_allclose(U @ s["P"][TH][:, rest], M @ U @ before["P"][TH][:, rest], rtol=0.0, atol=1e-14)
    assert np.linalg.eigvalsh(s["P"]).min() > 0.0
    assert d @ s["P"][TH, TH] @ d < d @ before["P"][TH, TH] @ d


def test_masked_gain_of_the_amendment() -> None:
    """K_θ ← d dᵀ K_θ, K_bg ← d dᵀ K_bg with d = Ĉᵀe3, all other rows zero; dx and P by the long form with the full H."""
    rng = np.random.default_rng(11)
    s, prm = state(rng), parameters()
    estimate = scipy_of(s["q"])
    truth = estimate * Rotation.from_rotvec(rng.standard_normal(3) * 0.01)
    P, bg = s["P"].copy(), s["bg"].copy()
    offer = magnetometer.offer(s, prm, measurement(tup(truth.as_matrix().T @ field(s))), buffer())  # type: ignore[arg-type]
    H, r, e = dense(offer[5][:1], 16)[0], offer[4][0], offer[2][0]
    S = H @ P @ H + r
    K = P @ H / S
    d = estimate.as_matrix()[2]
    masked = np.zeros(16)
    masked[TH], masked[BG] = d * (d @ K[TH]), d * (d @ K[BG])
    a = np.eye(16) - np.outer(masked, H)
    expected = a @ P @ a.T + r * np.outer(masked, masked)
    t = masked[TH] * e
    Gr = np.eye(16)
    Gr[TH, TH] -= 0.5 * np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    expected = Gr @ expected @ Gr.T
    out = fuse(s, 3, offer)
    np.testing.assert_allclose((estimate.inv() * scipy_of(s["q"])).as_rotvec(), t, atol=1e-14)
    np.testing.assert_allclose(s["bg"], bg + masked[BG] * e, atol=1e-15)
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(s["P"] / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-12)
    assert float(out["innovation"][0]) == pytest.approx(e)
    assert float(out["innovation_sd"][0]) == pytest.approx(math.sqrt(S), rel=1e-12)
    assert float(out["test_ratio"][0]) == pytest.approx(e * e / S / 9.0, rel=1e-12)


def test_three_components_are_one_update() -> None:
    """GNSS velocity: gain, state and covariance of the 3-vector; a missing component leaves the update of the other two."""
    for there in ([0, 1, 2], [0, 1]):
        rng = np.random.default_rng(12)
        s, prm = state(rng), parameters()
        P, v = s["P"].copy(), s["v"].copy()
        z = s["v"] + scipy_of(s["q"]).as_matrix() @ np.cross(s["w"], ARM) + rng.standard_normal(3) * 0.3
        if len(there) == 2:
            z[2] = NAN
        offer = gnss.offer_velocity(s, prm, measurement(tup(z)))  # type: ignore[arg-type]
        H = dense(offer[5], 16)[there]
        S = H @ P @ H.T + 0.25 * np.eye(len(there))
        K = P @ H.T @ np.linalg.inv(S)
        e = (z - np.array(offer[3]))[there]
        out = fuse(s, 0, offer)
        np.testing.assert_allclose(s["v"], v + (K @ e)[V], rtol=0.0, atol=1e-12)
        expected = (P - K @ S @ K.T)[V, V]
        np.testing.assert_allclose(s["P"][V, V], expected, rtol=0.0, atol=1e-12)
        assert out["component"].tolist() == there
        np.testing.assert_allclose(out["innovation"], e, atol=1e-12)
        np.testing.assert_allclose(out["innovation_sd"], np.sqrt(np.diag(S)), rtol=1e-12)
        np.testing.assert_allclose(out["test_ratio"], e @ np.linalg.solve(S, e) / 25.0, rtol=1e-9)
        assert (out["weight"] == 1.0).all()


def velocity_offer(s: Any, prm: Any, off: float) -> Any:
    z = s["v"] + scipy_of(s["q"]).as_matrix() @ np.cross(s["w"], ARM) + off
    return gnss.offer_velocity(s, prm, measurement(tup(z)))  # type: ignore[arg-type]


def test_what_fails_its_gate_changes_nothing_until_the_timeout() -> None:
    s, prm = state(np.random.default_rng(13)), parameters()
    before = {k: s[k].copy() for k in ("q", "v", "p", "bg", "ba", "P", "dx")}
    out = fuse(s, 0, velocity_offer(s, prm, 50.0), t=106.0)
    assert (out["status"] == records.REJECTED).all()
    assert (out["reason"] == records.R_INNOVATION).all()
    assert (out["weight"] == 0.0).all()
    assert (out["test_ratio"] > 1.0).all()
    for name, value in before.items():
        np.testing.assert_array_equal(s[name], value)
    # seven seconds after the last that passed it is let in, de-weighted, and the timeout is told once
    for k in range(3):
        offer = velocity_offer(s, prm, 50.0)
        out = fuse(s, 0, offer, t=107.1 + k)
        assert (out["status"] == records.DEWEIGHTED).all()
        assert (out["reason"] == records.R_TIMEOUT).all()
        np.testing.assert_allclose(out["weight"], 1.0 / out["test_ratio"], rtol=1e-12)
    assert s["n_events"] == 1
    assert (s["event"][0]["code"], s["event"][0]["sensor"]) == (records.E_TIMEOUT, 0)
    assert (s["v"] > before["v"]).all()  # drawn to it
    # and when one passes again the clock starts anew
    assert (fuse(s, 0, velocity_offer(s, prm, 0.0), t=111.0)["status"] == records.FUSED).all()
    assert (fuse(s, 0, velocity_offer(s, prm, 500.0), t=112.0)["status"] == records.REJECTED).all()


def test_a_deweighted_scalar_is_drawn_at_the_edge_of_its_gate() -> None:
    """The variance is what makes e²/S' = gate²; state and offset follow with the gain of that."""
    s, prm = state(np.random.default_rng(14)), parameters()
    P, down, offset = s["P"].copy(), float(s["p"][2]), float(s["baro"][0])
    e = 400.0
    offer = barometer.offer(s, prm, measurement((600.0 - down + offset + e, NAN, NAN), t=108.0), buffer())
    H = dense(offer[5][:1], 16)[0]
    hph = float(H @ P @ H)
    nis = e * e / (hph + 1.5**2)
    r = e * e / 25.0 - hph  # what makes the ratio one
    fuse(s, 2, offer, t=108.0)
    assert nis > 25.0
    K = P @ H / (hph + r)
    assert float(s["p"][2]) == pytest.approx(down + K[8] * e, abs=1e-10)
    assert float(s["baro"][0]) == pytest.approx(offset + K[15] * e, abs=1e-10)


def test_a_distrusted_sensor_passes_ten_seconds_before_it_is_believed() -> None:
    s, prm = state(np.random.default_rng(15)), parameters()
    s["aid"]["started"][3] = fusing.DISTRUSTED
    s["aid"]["t_due"][3] = 100.0

    def look(t: float, off: float) -> int:
        m_n = Rotation.from_rotvec([0.0, 0.0, off]).as_matrix() @ field(s)
        z = scipy_of(s["q"]).as_matrix().T @ m_n
        return int(fuse(s, 3, magnetometer.offer(s, prm, measurement(tup(z), t=t), buffer()), t=t)["status"][0])  # type: ignore[arg-type]

    P = s["P"].copy()
    assert [look(101.0, 0.0), look(109.9, 0.0)] == [records.HELD, records.HELD]
    assert look(109.95, 1.5) == records.REJECTED  # not by force either, and the ten seconds begin anew
    assert [look(110.5, 0.0), look(119.9, 0.0)] == [records.HELD, records.HELD]
    np.testing.assert_array_equal(s["P"], P)
    assert look(120.0, 0.0) == records.FUSED
    assert s["aid"]["started"][3] == fusing.RUNNING


def test_full_record_buffer_counts_what_it_loses() -> None:
    s, prm = state(np.random.default_rng(16)), parameters()
    aids = array(records.AID_RECORD, 2)
    fuse(s, 0, velocity_offer(s, prm, 0.0), aids)
    assert (s["n_aids"], s["n_aids_lost"]) == (2, 1)


# Setting yaw


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("delta", [-3.0, -0.4, 1e-3, 2.0])
def test_yaw_is_reset_and_nothing_else(seed: int, delta: float) -> None:
    s = state(np.random.default_rng(seed))
    sd = 0.2
    before = {k: s[k].copy() for k in ("v", "p", "bg", "ba", "baro", "P")}
    q = scipy_of(s["q"])
    old = euler(tup(s["q"]))  # type: ignore[arg-type]
    magnetometer.reset_yaw(s, delta, sd)
    new = euler(tup(s["q"]))  # type: ignore[arg-type]
    assert new[:2] == pytest.approx(old[:2], abs=1e-14)
    assert math.remainder(new[2] - old[2] - delta, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-14)
    np.testing.assert_allclose(scipy_of(s["q"]).as_matrix(), (Rotation.from_rotvec([0.0, 0.0, delta]) * q).as_matrix(), atol=1e-14)
    for name in ("v", "p", "bg", "ba", "baro"):
        np.testing.assert_array_equal(s[name], before[name])
    assert float(s["yaw_corrected"]) == delta
    # the vertical is the same in the body before and after: of the error about it nothing is left but sd
    d = q.as_matrix()[2]
    n = len(s["P"])
    A = np.eye(n)
    A[TH, TH] -= np.outer(d, d)
    expected = A @ before["P"] @ A.T
    expected[TH, TH] += sd * sd * np.outer(d, d)
    scale = np.sqrt(np.diag(before["P"]))
    np.testing.assert_allclose(s["P"] / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-12)
    assert d @ s["P"][TH, TH] @ d == pytest.approx(sd * sd, rel=1e-12)
    np.testing.assert_allclose(d @ s["P"][TH, 3:], 0.0, atol=1e-15)
    C = scipy_of(s["q"]).as_matrix()
    assert magnetometer.yaw_variance(s, tuple(tup(r) for r in C)) == pytest.approx(sd * sd, rel=1e-12)  # type: ignore[arg-type]
    assert np.linalg.eigvalsh(s["P"] / scale / scale[:, None]).min() > 0.0


def test_first_compass_sample_sets_an_unknown_yaw_and_fuses_a_known_one() -> None:
    for yaw_sd, sets in ((1.0, True), (0.1, False)):
        rng = np.random.default_rng(17)
        s, prm, aids = state(rng), parameters(), buffer()
        s["aid"]["started"][3] = 0
        magnetometer.reset_yaw(s, 0.0, yaw_sd)
        truth = Rotation.from_rotvec([0.0, 0.0, 0.7]) * scipy_of(s["q"])
        offer = magnetometer.offer(s, prm, measurement(tup(truth.as_matrix().T @ field(s))), aids)  # type: ignore[arg-type]
        assert (offer[0] == 0) == sets
        left = (truth.inv() * scipy_of(s["q"])).magnitude()
        assert left == pytest.approx(0.0 if sets else 0.7, abs=1e-12)
        assert s["n_events"] == int(sets)
        assert s["aid"]["started"][3] == fusing.RUNNING
