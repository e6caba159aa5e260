"""Laws of rotations, of gravity and of the local frame, against forms that share nothing with ours."""

from __future__ import annotations

import math

import numpy as np
import pymap3d
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pymap3d.rcurve import meridian, transverse
from scipy.spatial.transform import Rotation

from haltere.core import earth
from haltere.core import rotation as rot
from haltere.flight import local
from haltere.flight.field import decimal_year

FloatArray = NDArray[np.float64]
Quat = tuple[float, float, float, float]

#: A product of two quaternions or two matrices is some twenty roundings of numbers below two.
EPS = 20 * np.finfo(float).eps
law = settings(deadline=None, max_examples=120)  # the first example may compile


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, width=64)


@st.composite
def unit_quaternions(draw: st.DrawFn) -> Quat:
    q = np.array([draw(number(-1.0, 1.0)) for _ in range(4)])
    n = float(np.linalg.norm(q))
    if n < 0.05:
        return 1.0, 0.0, 0.0, 0.0
    w, x, y, z = (float(v) for v in q / n)
    return w, x, y, z


vectors = st.tuples(number(-10.0, 10.0), number(-10.0, 10.0), number(-10.0, 10.0))
angles = number(-3.1, 3.1)
quaternions = unit_quaternions()


def scipy_of(q: Quat) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


def close(a: object, b: object, tolerance: float) -> None:
    np.testing.assert_allclose(np.array(a), np.array(b), rtol=0.0, atol=tolerance)


def same_rotation(a: Quat, b: Quat, tolerance: float) -> None:
    """q and -q are one rotation; near equality the distance of quaternions is half the angle between them."""
    a_, b_ = np.array(a), np.array(b)
    assert min(np.abs(a_ - b_).max(), np.abs(a_ + b_).max()) <= tolerance


# Rotations


@law
@given(quaternions)
def test_dcm_is_the_rotation_of_the_quaternion(q: Quat) -> None:
    C = np.array(rot.dcm(q))
    close(C, scipy_of(q).as_matrix(), EPS)
    close(C @ C.T, np.eye(3), EPS)
    assert np.linalg.det(C) == pytest.approx(1.0, abs=EPS)


@law
@given(quaternions, quaternions, quaternions)
def test_quaternions_are_a_group(a: Quat, b: Quat, c: Quat) -> None:
    one: Quat = (1.0, 0.0, 0.0, 0.0)
    inverse: Quat = (a[0], -a[1], -a[2], -a[3])
    close(rot.quat_mul(a, one), a, 0.0)
    close(rot.quat_mul(one, a), a, 0.0)
    close(rot.quat_mul(a, inverse), one, EPS)
    close(rot.quat_mul(rot.quat_mul(a, b), c), rot.quat_mul(a, rot.quat_mul(b, c)), EPS)
    # body to navigation: the product of quaternions is the product of matrices in the same order
    close(rot.dcm(rot.quat_mul(a, b)), np.array(rot.dcm(a)) @ np.array(rot.dcm(b)), EPS)


@law
@given(quaternions, number(0.1, 10.0))
def test_unit_keeps_the_direction(q: Quat, k: float) -> None:
    close(rot.quat_unit((k * q[0], k * q[1], k * q[2], k * q[3])), q, EPS)


@law
@given(quaternions)
def test_dcm_and_back(q: Quat) -> None:
    same_rotation(rot.quat_from_dcm(rot.dcm(q)), q, EPS)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle", [math.pi, math.pi - 1e-9, -math.pi + 1e-5, 2.0, math.pi / 2])
def test_dcm_and_back_at_half_a_turn(axis: int, angle: float) -> None:
    """Where the trace is -1 the scalar part vanishes: each branch is right, also at its edge."""
    r = [0.0, 0.0, 0.0]
    r[axis] = angle
    x, y, z, w = Rotation.from_rotvec(r).as_quat()
    m = Rotation.from_rotvec(r).as_matrix()
    q = rot.quat_from_dcm(tuple(tuple(float(v) for v in row) for row in m))  # type: ignore[arg-type]
    same_rotation(q, (float(w), float(x), float(y), float(z)), EPS)


@law
@given(vectors)
@example((0.0, 0.0, 0.0))
@example((1e-4, 0.0, 0.0))
@example((1e-4 * (1 - 1e-15), 0.0, 0.0))
@example((3e-200, 0.0, 1e-160))
@example((math.pi, 0.0, 0.0))
def test_rotation_vector_is_exact(r: tuple[float, float, float]) -> None:
    """Against scipy; 10 * sqrt(3) / 2 rad has an argument error of 1e-15 in cos and sin."""
    x, y, z, w = Rotation.from_rotvec(r).as_quat()
    q = rot.quat_from_rotvec(r)
    close(q, np.array([w, x, y, z]) * (1.0 if w * q[0] >= 0.0 else -1.0), 5e-15)
    close(rot.rotvec_dcm(r), Rotation.from_rotvec(r).as_matrix(), 1e-14)
    assert math.hypot(*q) == pytest.approx(1.0, abs=EPS)


@law
@given(number(1e-9, 3e-4), quaternions)
def test_small_rotation_vector_has_full_relative_precision(angle: float, q: Quat) -> None:
    """The vector part on both sides of the change from series to sine, relative to itself: sin(a/2) = a/2 (1 - a²/24 + a⁴/1920)."""
    half = angle / 2.0 * (1.0 - angle**2 / 24.0 + angle**4 / 1920.0)
    assert rot.quat_from_rotvec((angle, 0.0, 0.0))[1] == pytest.approx(half, rel=1e-15)


@law
@given(quaternions, vectors, number(1e-4, 1e-3))
def test_kinematics(q: Quat, w: tuple[float, float, float], h: float) -> None:
    """dq/dt = ½ q ⊗ [0, ω] with the body's own rate: central difference of q ⊗ exp(ω t), third derivative |ω|³/8."""
    plus = np.array(rot.quat_mul(q, rot.quat_from_rotvec((h * w[0], h * w[1], h * w[2]))))
    minus = np.array(rot.quat_mul(q, rot.quat_from_rotvec((-h * w[0], -h * w[1], -h * w[2]))))
    expected = 0.5 * np.array(rot.quat_mul(q, (0.0, *w)))
    size = float(np.linalg.norm(w))
    close((plus - minus) / (2.0 * h), expected, size**3 / 48.0 * h * h + 1e-15 / h)


@law
@given(angles, number(-1.48, 1.48), angles)
def test_euler_and_back(roll: float, pitch: float, yaw: float) -> None:
    """Within 85 degrees of pitch; a rounding of 1e-16 costs that over cosθ, which is at least 0.09."""
    q = rot.quat_from_euler(roll, pitch, yaw)
    close(rot.euler(q), (roll, pitch, yaw), 1e-14 / math.cos(pitch))
    close(rot.dcm(q), Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), EPS)


@law
@given(quaternions)
def test_euler_of_any_attitude_is_finite_and_the_same_rotation(q: Quat) -> None:
    angle = rot.euler(q)
    cos_pitch = math.hypot(np.array(rot.dcm(q))[0, 0], np.array(rot.dcm(q))[1, 0])
    assert all(math.isfinite(a) for a in angle)
    assert abs(angle[0]) <= math.pi
    assert abs(angle[1]) <= math.pi / 2
    assert abs(angle[2]) <= math.pi
    if cos_pitch > 1e-6:  # at the pole roll and yaw are one angle, and each alone means nothing
        same_rotation(rot.quat_from_euler(*angle), q, 1e-15 / cos_pitch)


def test_euler_signs_are_those_of_the_field() -> None:
    """Yaw towards east, pitch nose up, roll right side down (theory.md §1)."""
    a = 0.3
    nose, right = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    close(rot.mat_vec(rot.dcm(rot.quat_from_euler(0.0, 0.0, a)), nose), (math.cos(a), math.sin(a), 0.0), EPS)
    close(rot.mat_vec(rot.dcm(rot.quat_from_euler(0.0, a, 0.0)), nose), (math.cos(a), 0.0, -math.sin(a)), EPS)
    close(rot.mat_vec(rot.dcm(rot.quat_from_euler(a, 0.0, 0.0)), right), (0.0, math.cos(a), math.sin(a)), EPS)


@law
@given(vectors, vectors, number(-5.0, 5.0))
def test_vectors(a: tuple[float, float, float], b: tuple[float, float, float], k: float) -> None:
    """Against numpy; components up to 10, so products up to 100 a rounding of 1e-14."""
    close(rot.add(a, b), np.add(a, b), 0.0)
    close(rot.sub(a, b), np.subtract(a, b), 0.0)
    close(rot.scale(a, k), k * np.array(a), 0.0)
    close(rot.cross(a, b), np.cross(a, b), 1e-13)
    assert rot.dot(a, b) == pytest.approx(float(np.dot(a, b)), abs=1e-13)
    assert rot.norm(a) == pytest.approx(float(np.linalg.norm(a)), rel=1e-15)


@law
@given(st.tuples(vectors, vectors, vectors), st.tuples(vectors, vectors, vectors), vectors)
def test_matrices(a: rot.Mat, b: rot.Mat, v: rot.Vec) -> None:
    close(rot.mat_vec(a, v), np.array(a) @ np.array(v), 1e-12)
    close(rot.tmat_vec(a, v), np.array(a).T @ np.array(v), 1e-12)
    close(rot.mul_mat(a, b), np.array(a) @ np.array(b), 1e-12)


@law
@given(number(-1e4, 1e4))
@example(0.0)
@example(math.pi)
@example(-math.pi)
@example(3.0 * math.pi)
@example(math.nextafter(math.pi, 4.0))
@example(math.nextafter(-math.pi, -4.0))
def test_wrap(angle: float) -> None:
    """Into (-π, π], by whole turns; the multiple of a rounded 2π is exact to |angle| roundings."""
    rounding = 4e-16 * max(1.0, abs(angle))
    w = rot.wrap(angle)
    assert -math.pi - rounding < w <= math.pi + rounding
    turns = (angle - w) / (2.0 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-12)
    close((math.cos(w), math.sin(w)), (math.cos(angle), math.sin(angle)), 2.0 * rounding)


def test_wrap_keeps_plus_half_a_turn() -> None:
    assert rot.wrap(math.pi) == math.pi
    assert rot.wrap(-math.pi) == math.pi


@law
@given(quaternions, vectors, vectors, number(-2.0, 2.0))
def test_triad(q: Quat, a: rot.Vec, b: rot.Vec, spoil: float) -> None:
    """Two exact directions give the attitude; a second one spoilt within the plane of both changes nothing, and the first is kept."""
    a_, b_ = np.array(a), np.array(b)
    sine = np.linalg.norm(np.cross(a_, b_)) / max(np.linalg.norm(a_) * np.linalg.norm(b_), 1e-9)
    if sine < 0.05 or min(np.linalg.norm(a_), np.linalg.norm(b_)) < 0.1:
        return
    C = np.array(rot.dcm(q))
    seen_a, seen_b = (tuple(float(x) for x in C.T @ v) for v in (a_, b_))
    tolerance = 1e-14 / sine
    same_rotation(rot.triad(a, b, seen_a, seen_b), q, tolerance)  # type: ignore[arg-type]
    spoilt = tuple(float(x) for x in C.T @ (2.0 * b_ + spoil * a_))
    same_rotation(rot.triad(a, b, seen_a, spoilt), q, 40.0 * tolerance)  # type: ignore[arg-type]
    aside = tuple(float(x) for x in C.T @ (b_ + 0.3 * np.cross(a_, b_) / np.linalg.norm(a_)))
    kept = rot.triad(a, b, seen_a, aside)  # type: ignore[arg-type]
    close(np.array(rot.dcm(kept)) @ np.array(seen_a), a_, 10.0 * tolerance * np.linalg.norm(a_))


# Earth


def somigliana(lat: float) -> float:
    """Normal gravity on the WGS-84 ellipsoid from gravity at equator and pole (NIMA TR8350.2, equation 4-1 in its axes form)."""
    a, b, equator, pole = 6378137.0, 6356752.3142, 9.7803253359, 9.8321849378
    c2, s2 = math.cos(math.radians(lat)) ** 2, math.sin(math.radians(lat)) ** 2
    return (a * equator * c2 + b * pole * s2) / math.sqrt(a * a * c2 + b * b * s2)


@law
@given(number(-90.0, 90.0))
def test_gravity_on_the_ellipsoid(lat: float) -> None:
    """The constants of both forms are given to ten digits."""
    assert earth.gravity(lat, 0.0) == pytest.approx(somigliana(lat), abs=2e-9)


def test_gravity_at_known_places() -> None:
    assert earth.gravity(0.0, 0.0) == pytest.approx(9.780325, abs=5e-7)
    assert earth.gravity(90.0, 0.0) == pytest.approx(9.832185, abs=5e-7)
    assert earth.gravity(-90.0, 0.0) == earth.gravity(90.0, 0.0)
    assert earth.gravity(45.0, 0.0) == pytest.approx(9.80620, abs=1e-5)
    assert abs(earth.gravity(45.5, 0.0) - earth.STANDARD_GRAVITY) < 1e-3


@law
@given(number(-90.0, 90.0), number(-400.0, 5000.0))
def test_gravity_aloft(lat: float, alt: float) -> None:
    """Against the second order free-air formula (TR8350.2, 4-3).

    The first order term there goes from 3.0877e-6 at the equator to 3.0834e-6 at the pole where ours is 3.086e-6, and the
    second order one is 3 g h²/a² = 7.3e-13 h².
    """
    a, f, m = 6378137.0, 1.0 / 298.257223563, 0.00344978650684
    s2 = math.sin(math.radians(lat)) ** 2
    expected = somigliana(lat) * (1.0 - 2.0 / a * (1.0 + f + m - 2.0 * f * s2) * alt + 3.0 / a**2 * alt * alt)
    assert earth.gravity(lat, alt) == pytest.approx(expected, abs=2.7e-9 * abs(alt) + 7.4e-13 * alt * alt + 3e-9)


@law
@given(number(-89.9, 89.9))
def test_radii_of_curvature(lat: float) -> None:
    m, n = earth.radii(lat)
    assert m == pytest.approx(float(meridian(lat)), rel=1e-11)
    assert n == pytest.approx(float(transverse(lat)), rel=1e-11)


places = st.tuples(number(-80.0, 80.0), number(-180.0, 180.0), number(-400.0, 4000.0))
offsets = st.tuples(number(-5e3, 5e3), number(-5e3, 5e3), number(-500.0, 500.0))


@law
@given(places, offsets)
def test_local_and_back(home: tuple[float, float, float], p: tuple[float, float, float]) -> None:
    """A longitude of 180 degrees is rounded to 3e-14 deg, that is 3e-9 m."""
    there = earth.geodetic_from_local(*p, *home)
    close(earth.local_from_geodetic(*there, *home), p, 2e-8)
    close(earth.local_from_geodetic(there[0], there[1] - 360.0, there[2], *home), p, 4e-8)
    close(earth.local_from_geodetic(there[0], there[1] + 360.0, there[2], *home), p, 4e-8)


@law
@given(places, offsets)
def test_local_against_the_tangent_plane(home: tuple[float, float, float], p: tuple[float, float, float]) -> None:
    """Against pymap3d's exact tangent plane, up to what the curvature of the Earth makes between the two.

    Over a distance d the sphere falls from the plane by d²/2R, a parallel bends polewards by e² tanφ/2R, and the meridians
    converge by n e tanφ/2R; a point above the origin is farther away by d Δh/R. What is left is of third order, or of the
    flattening: 1 % of the second.
    """
    lat0, lon0, alt0 = home
    there = earth.geodetic_from_local(*p, *home)
    plane = np.array(pymap3d.geodetic2ned(*there, lat0, lon0, alt0))
    R, t = 6.37e6, math.tan(math.radians(lat0))
    north, east, down = p
    d = math.hypot(north, east)
    curved = np.array([t * east * east, -t * north * east, d * d]) / (2.0 * R)
    rest = 1.1 * d * abs(down) / R + 0.01 * (1.0 + abs(t)) * d * d / R + d**3 / R**2 * (1.0 + t * t) + 1e-7
    close(plane, np.array(p) + curved, rest)


@law
@given(places, number(0.0, 2.0 * math.pi))
def test_local_scale_and_direction_at_short_range(home: tuple[float, float, float], azimuth: float) -> None:
    """Within ten metres the curvature is d²/R < 2e-5 m and tan(80 deg) of it: both frames are one."""
    lat0, lon0, alt0 = home
    p = (10.0 * math.cos(azimuth), 10.0 * math.sin(azimuth), 3.0)
    there = earth.geodetic_from_local(*p, *home)
    close(pymap3d.geodetic2ned(*there, lat0, lon0, alt0), p, 1.5e-4)
    chord = np.subtract(pymap3d.geodetic2ecef(*there), pymap3d.geodetic2ecef(*home))
    assert float(np.linalg.norm(chord)) == pytest.approx(math.hypot(*p), abs=3e-5)


@law
@given(places, offsets)
def test_local_form_of_kernels_is_that_of_columns(home: tuple[float, float, float], p: tuple[float, float, float]) -> None:
    lat, lon, alt = local.geodetic_from_local(*(np.array([x]) for x in p), *home)
    there = earth.geodetic_from_local(*p, *home)
    close((lat[0], lon[0], alt[0]), there, 1e-13)
    one = np.array([there])
    close(np.ravel(local.local_from_geodetic(one[:, 0], one[:, 1], one[:, 2], *home)), earth.local_from_geodetic(*there, *home), 2e-8)


def test_local_over_the_date_line() -> None:
    """0.002 degrees of longitude on the equator are 222.64 m of the major axis, also from one side of 180 degrees to the other."""
    north, east, down = earth.local_from_geodetic(0.0, -179.999, 5.0, 0.0, 179.999, 2.0)
    assert (north, down) == (0.0, -3.0)
    assert east == pytest.approx(math.radians(0.002) * (6378137.0 + 2.0), abs=1e-6)
    column = local.local_from_geodetic(np.array([0.0]), np.array([-179.999]), np.array([5.0]), 0.0, 179.999, 2.0)
    close(np.ravel(column), (north, east, down), 1e-7)


#: U.S. Standard Atmosphere 1976, geopotential altitude [m] and pressure [Pa].
STANDARD = [
    (-500.0, 107478.0),
    (0.0, 101325.0),
    (500.0, 95461.0),
    (1000.0, 89874.6),
    (2000.0, 79495.2),
    (3000.0, 70108.5),
    (5000.0, 54019.9),
]


@pytest.mark.parametrize(("altitude", "pressure"), STANDARD)
def test_pressure_altitude_of_the_standard_atmosphere(altitude: float, pressure: float) -> None:
    assert earth.pressure_altitude(pressure) == pytest.approx(altitude, abs=1.0)


@law
@given(number(-400.0, 6000.0))
def test_pressure_altitude_inverts_the_hydrostatic_law(altitude: float) -> None:
    """p = p0 (1 - L h/T0)^(g M/(R L)); the constants of the short form are rounded to seven digits, 0.003 m in 6 km."""
    L, T0, g, M, R = 0.0065, 288.15, 9.80665, 0.0289644, 8.31432
    pressure = 101325.0 * (1.0 - L * altitude / T0) ** (g * M / (R * L))
    assert earth.pressure_altitude(pressure) == pytest.approx(altitude, abs=0.1)


def test_decimal_year() -> None:
    assert decimal_year("2024-01-01T00:00:00Z") == 2024.0
    assert decimal_year("2023-07-02T12:00:00Z") == pytest.approx(2023.0 + 182.0 / 365.0, abs=1e-12)
    assert decimal_year(None) is None
    assert decimal_year("yesterday") is None
