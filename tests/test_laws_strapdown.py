"""Laws of the strapdown equations: mechanisation against closed forms and Runge-Kutta, covariance against the dense text, the reset."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from haltere._jit import COMPILED
from haltere.estimators.step import predict_interval
from haltere.strapdown.layout import PARAMETERS, layout
from haltere.strapdown.propagate import inject, mechanise, predict

FloatArray = NDArray[np.float64]
G = 9.80665
GRAVITY = np.array([0.0, 0.0, G])
TH, V, P_, BG, BA = (slice(k, k + 3) for k in (0, 3, 6, 9, 12))
BAROS = pytest.mark.parametrize("baro", [0, 1])


def new(dtype: np.dtype[np.void]) -> Any:
    """One record that kernels can change."""
    array = np.zeros(1, dtype)
    return (array if COMPILED else array.view(np.recarray))[0]


def skew(a: FloatArray) -> FloatArray:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def rotation(r: FloatArray) -> FloatArray:
    """Exact matrix of a rotation vector, by the matrix exponential."""
    return np.asarray(expm(skew(np.asarray(r))))


def scipy_of(q: FloatArray) -> Rotation:
    return Rotation.from_quat(np.r_[q[1:], q[0]])


def scalar_first(r: Rotation) -> FloatArray:
    x, y, z, w = r.as_quat()
    return np.array([w, x, y, z])


def tup(a: FloatArray) -> tuple[float, float, float]:
    return float(a[0]), float(a[1]), float(a[2])


def state(rng: np.random.Generator, baro: int = 0) -> Any:
    """Any attitude, moving, with biases and a covariance whose blocks are all correlated."""
    s = new(layout(baro))
    n = 15 + baro
    s["q"][:] = scalar_first(Rotation.random(random_state=rng))
    s["v"][:], s["p"][:] = rng.standard_normal(3) * 5.0, rng.standard_normal(3) * 20.0
    s["bg"][:], s["ba"][:] = rng.standard_normal(3) * 0.01, rng.standard_normal(3) * 0.2
    s["gravity"] = G
    d = np.r_[np.repeat([0.05, 0.5, 2.0, 0.01, 0.2], 3), [3.0] * baro]
    a = rng.standard_normal((n, n))
    s["P"][:] = d[:, None] * (a @ a.T / n + 0.1 * np.eye(n)) * d
    s["P"][:] = 0.5 * (s["P"] + s["P"].T)
    return s


def parameters() -> Any:
    prm = new(PARAMETERS)
    for name, value in (("gyro", 2e-2), ("accel", 0.3), ("gyro_bias", 3e-2), ("accel_bias", 0.2), ("baro_bias", 0.1)):
        prm[f"noise_{name}"] = value
    return prm


# Covariance


def phi_of_the_text(C: FloatArray, w: FloatArray, f: FloatArray, dt: float, n: int) -> FloatArray:
    """Φ of theory-amendments.md §8, C in the middle of the interval."""
    Phi = np.eye(n)
    Phi[TH, TH] = rotation(w * dt).T
    Phi[TH, BG] = -np.eye(3) * dt
    Phi[V, TH] = -C @ skew(f) * dt
    Phi[V, BA] = -C * dt
    Phi[P_, V] = np.eye(3) * dt
    Phi[P_, TH] = -0.5 * C @ skew(f) * dt**2
    Phi[P_, BA] = -0.5 * C * dt**2
    return Phi


def q_of_the_text(C: FloatArray, prm: Any, dt: float, n: int, diagonal: bool) -> FloatArray:
    """Q of theory-amendments.md §8; its diagonal alone up to 20 ms."""
    g2, a2 = float(prm["noise_gyro"]) ** 2, float(prm["noise_accel"]) ** 2
    bg2, ba2 = float(prm["noise_gyro_bias"]) ** 2, float(prm["noise_accel_bias"]) ** 2
    Q = np.zeros((n, n))
    one = np.eye(3)
    Q[TH, TH] = (g2 * dt + bg2 * dt**3 / 3.0) * one
    Q[V, V] = a2 * dt * one
    Q[P_, P_] = a2 * dt**3 / 3.0 * one
    Q[BG, BG] = bg2 * dt * one
    Q[BA, BA] = ba2 * dt * one
    if n > 15:
        Q[15, 15] = float(prm["noise_baro_bias"]) ** 2 * dt
    if not diagonal:
        Q[TH, BG] = Q[BG, TH] = -0.5 * bg2 * dt**2 * one
        Q[V, P_] = Q[P_, V] = 0.5 * a2 * dt**2 * one
        Q[V, BA] = -0.5 * ba2 * dt**2 * C
        Q[BA, V] = Q[V, BA].T
    return Q


@BAROS
@pytest.mark.parametrize("dt", [0.001, 0.004, 0.02, 0.0201, 0.05])
def test_covariance_is_predicted_as_the_text_says(baro: int, dt: float) -> None:
    rng = np.random.default_rng(1)
    n = 15 + baro
    prm = parameters()
    for _ in range(20):
        s = state(rng, baro)
        before, C0 = s["P"].copy(), scipy_of(s["q"]).as_matrix()
        w, f = rng.standard_normal(3) * 3.0, rng.standard_normal(3) * 3.0 - GRAVITY
        predict(s, prm, tup(w), tup(f), tup(w * dt), tup(f * dt), dt)
        C = C0 @ rotation(0.5 * w * dt)
        Phi = phi_of_the_text(C, w, f, dt, n)
        expected = Phi @ before @ Phi.T + q_of_the_text(C, prm, dt, n, dt <= 0.02)
        d = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(s["P"] / d / d[:, None], expected / d / d[:, None], rtol=0.0, atol=1e-12)
        np.testing.assert_array_equal(s["w"], w)


def test_process_noise_is_that_of_the_continuous_system() -> None:
    """Q of one long interval at rest against Van Loan's integral of the linear system.

    The text keeps the leading term of each block. With |f| dt = 0.5 m/s the next ones (noise of the gyro bias in velocity, and so
    on) are smaller by dt each; compared on the scale of the standard deviations that one interval makes.
    """
    rng = np.random.default_rng(2)
    prm = parameters()
    s = state(rng)
    s["P"][:] = 0.0
    dt = 0.05
    C = scipy_of(s["q"]).as_matrix()
    F = np.zeros((15, 15))
    F[TH, BG], F[V, TH], F[V, BA], F[P_, V] = -np.eye(3), -C @ skew(-C.T @ GRAVITY), -C, np.eye(3)
    density = np.repeat([prm["noise_gyro"], prm["noise_accel"], 0.0, prm["noise_gyro_bias"], prm["noise_accel_bias"]], 3) ** 2
    M = expm(np.block([[-F, np.diag(density)], [np.zeros((15, 15)), F.T]]) * dt)
    exact = M[15:, 15:].T @ M[:15, 15:]
    predict(s, prm, (0.0, 0.0, 0.0), tup(-C.T @ GRAVITY), (0.0, 0.0, 0.0), tup(-C.T @ GRAVITY * dt), dt)
    d = np.sqrt(np.diag(exact))
    difference = (s["P"] - exact) / d / d[:, None]
    for a, b in ((TH, TH), (V, V), (P_, P_), (BG, BG), (BA, BA), (TH, BG), (V, P_), (V, BA)):
        assert np.abs(difference[a, b]).max() < 0.02


def test_transition_is_the_derivative_of_the_mechanisation() -> None:
    """Errors of 1e-5 through the nonlinear equations, both ways: what comes out is Φ δx of the text.

    Each block of the text is the first term of a series in dt. What is left out, by hand from the same series, with C in the
    middle of the interval: ½|ω|dt² in θ-b_g (the rotation while it acts), ½|ω||f|dt² in v-θ, ½|f|dt² in v-b_g, and half a dt of
    these in position. The rest is exact. Central differences leave (1e-5)² and roundings of 1e-15/1e-5.
    """
    rng = np.random.default_rng(3)
    prm = parameters()
    for dt in (0.02, 0.01, 0.005):
        for _ in range(10):
            start = state(rng)
            start["p"][:] = start["v"][:] = 0.0  # for the roundings only: the equations do not know where they are
            w, f = rng.standard_normal(3) * 2.0, rng.standard_normal(3) * 2.0 - GRAVITY
            q0 = scipy_of(start["q"])

            def after(x: FloatArray, q0: Rotation = q0, start: Any = start, w: FloatArray = w, f: FloatArray = f, dt: float = dt) -> Any:
                s = new(layout(0))
                s["q"][:] = scalar_first(q0 * Rotation.from_rotvec(x[TH]))
                s["v"][:], s["p"][:] = start["v"] + x[V], start["p"] + x[P_]
                s["gravity"] = G
                w_, f_ = w - x[BG], f - x[BA]  # a bias that is larger takes more off
                predict(s, prm, tup(w_), tup(f_), tup(w_ * dt), tup(f_ * dt), dt)
                return s

            nominal = scipy_of(after(np.zeros(15))["q"])

            def error(s: Any, x: FloatArray, nominal: Rotation = nominal) -> FloatArray:
                return np.r_[(nominal.inv() * scipy_of(s["q"])).as_rotvec(), s["v"], s["p"], x[BG], x[BA]]

            step = 1e-5
            Phi = np.empty((15, 15))
            for k in range(15):
                x = np.zeros(15)
                x[k] = step
                Phi[:, k] = (error(after(x), x) - error(after(-x), -x)) / (2.0 * step)
            text = phi_of_the_text(q0.as_matrix() @ rotation(0.5 * w * dt), w, f, dt, 15)
            W, F = float(np.linalg.norm(w)), float(np.linalg.norm(f))
            bound = np.full((15, 15), 1e-9)
            bound[TH, BG] += 0.5 * W * dt**2
            bound[V, TH] += 0.5 * W * F * dt**2
            bound[V, BG] += 0.5 * F * dt**2
            bound[P_, TH] += 0.25 * W * F * dt**3
            bound[P_, BG] += 0.25 * F * dt**3
            assert (np.abs(Phi - text) <= 1.02 * bound).all()


# Mechanisation


def turned(w: FloatArray, f: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
    """∫R(ωs)f ds and its integral over 0 ... t: entries of the exponential of [[W, I, 0], [0, 0, I], [0, 0, 0]]."""
    B = np.zeros((9, 9))
    B[:3, :3], B[:3, 3:6], B[3:6, 6:9] = skew(w), np.eye(3), np.eye(3)
    E = expm(B * t)
    return E[:3, 3:6] @ f, E[:3, 6:9] @ f


def test_turned_is_right() -> None:
    """The closed form used below, against a quadrature of its own."""
    w, f, t = np.array([0.4, -1.2, 2.0]), np.array([1.0, -2.0, -9.0]), 1.3
    x, weight = np.polynomial.legendre.leggauss(40)
    s = 0.5 * t * (x + 1.0)
    values = np.array([rotation(w * u) @ f for u in s])
    np.testing.assert_allclose(turned(w, f, t)[0], 0.5 * t * weight @ values, rtol=1e-13)
    np.testing.assert_allclose(turned(w, f, t)[1], 0.5 * t * (weight * (t - s)) @ values, rtol=1e-13)


@pytest.mark.parametrize("kind", ["instant", "mean"])
def test_constant_rate_and_force_have_a_closed_form(kind: str) -> None:
    """Attitude is exact. Velocity and position take the force as constant in a frame turned to the middle of the interval.

    That leaves ω×(ω×f) dt³/24 a step in velocity and (ω×f) dt³/12 in position: over T, |ω|²|f| T dt²/24, and in position
    |ω||f| T dt²/12 and half of the velocity's times T. Halving dt quarters them.
    """
    rng = np.random.default_rng(4)
    T = 1.0
    prm = parameters()
    prm["imu_mean"] = float(kind == "mean")
    for _ in range(5):
        w, f = rng.standard_normal(3) * 2.0, rng.standard_normal(3) * 3.0 - GRAVITY
        start = state(rng)
        C = scipy_of(start["q"]).as_matrix()
        v1, p1 = turned(w, f, T)
        q_true = scipy_of(start["q"]) * Rotation.from_rotvec(w * T)
        v_true = start["v"] + C @ v1 + GRAVITY * T
        p_true = start["p"] + start["v"] * T + C @ p1 + 0.5 * GRAVITY * T**2
        errors = []
        for n in (50, 100):
            dt = T / n
            s = new(layout(0))
            for name in ("q", "v", "p", "bg", "ba", "gravity"):
                s[name] = start[name]
            raw_w, raw_f = tup(w + start["bg"]), tup(f + start["ba"])
            for _ in range(n):
                predict_interval(s, prm, raw_w, raw_f, raw_w, raw_f, dt)
            assert (q_true.inv() * scipy_of(s["q"])).magnitude() < 1e-13
            e_v, e_p = float(np.linalg.norm(s["v"] - v_true)), float(np.linalg.norm(s["p"] - p_true))
            W, F = float(np.linalg.norm(w)), float(np.linalg.norm(f))
            assert e_v <= W**2 * F * T * dt**2 / 24.0 * 1.01 + 1e-12
            assert e_p <= W * F * T * dt**2 / 12.0 * 1.01 + W**2 * F * T**2 * dt**2 / 48.0 * 1.01 + 1e-12
            errors.append((e_v, e_p))
        for coarse, fine in zip(*errors, strict=True):
            assert fine < coarse / 3.8 + 1e-12


def test_at_rest_nothing_moves() -> None:
    """Ten seconds of the specific force of rest, at any attitude: v and p stay within roundings of g dt a step."""
    rng = np.random.default_rng(5)
    s = state(rng)
    s["v"][:] = s["p"][:] = 0.0
    q = s["q"].copy()
    f = scipy_of(q).as_matrix().T @ -GRAVITY
    for _ in range(2500):
        mechanise(s, (0.0, 0.0, 0.0), tup(f * 0.004), 0.004)
    assert np.abs(s["v"]).max() < 2500 * 0.04 * 4e-16 * 4
    assert np.abs(s["p"]).max() < 10.0 * 2500 * 0.04 * 4e-16 * 4
    np.testing.assert_allclose(s["q"], q, atol=1e-12)


def test_free_fall_is_a_parabola() -> None:
    s = new(layout(0))
    s["q"][0], s["gravity"] = 1.0, G
    s["v"][:] = 3.0, -1.0, -2.0
    for _ in range(500):
        mechanise(s, (0.002, -0.001, 0.003), (0.0, 0.0, 0.0), 0.004)
    np.testing.assert_allclose(s["v"], [3.0, -1.0, -2.0 + G * 2.0], rtol=1e-12)
    np.testing.assert_allclose(s["p"], [6.0, -2.0, -4.0 + 0.5 * G * 4.0], rtol=1e-12)


def runge_kutta(w: Callable[[float], FloatArray], f: Callable[[float], FloatArray], T: float, n: int) -> FloatArray:
    """q, v, p from rest and level after T, by the classical fourth order in n steps of the differential equations themselves."""

    def slope(t: float, x: FloatArray) -> FloatArray:
        q, r = x[:4], w(t)
        C = scipy_of(q).as_matrix()  # normalises, as the equations would for a unit q
        return np.r_[0.5 * np.r_[-q[1:] @ r, q[0] * r + np.cross(q[1:], r)], C @ f(t) + GRAVITY, x[4:7]]

    x, h = np.r_[1.0, np.zeros(9)], T / n
    for i in range(n):
        t = i * h
        k1 = slope(t, x)
        k2 = slope(t + h / 2, x + h / 2 * k1)
        k3 = slope(t + h / 2, x + h / 2 * k2)
        k4 = slope(t + h, x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def sampled(w: Callable[[float], FloatArray], f: Callable[[float], FloatArray], T: float, n: int) -> Any:
    s, prm, dt = new(layout(0)), parameters(), T / n
    s["q"][0], s["gravity"] = 1.0, G
    for i in range(n):
        t0, t1 = i * dt, (i + 1) * dt
        predict_interval(s, prm, tup(w(t0)), tup(f(t0)), tup(w(t1)), tup(f(t1)), dt)
    return s


def errors_of(s: Any, x: FloatArray) -> tuple[float, float, float]:
    """Angle, velocity and position error."""
    angle = (scipy_of(x[:4]).inv() * scipy_of(s["q"])).magnitude()
    return angle, float(np.linalg.norm(s["v"] - x[4:7])), float(np.linalg.norm(s["p"] - x[7:]))


def test_coning_of_a_linear_course_is_kept_to_fourth_order() -> None:
    """Rate and force linear in time, sampled at 25, 50, 100 Hz, against Runge-Kutta with 100 steps a sample of the slowest.

    The rotation vector ω̄dt + (a×b)dt²/12 is Magnus' series up to terms of dt⁵: halving dt takes the angle down by 16. Its error is
    of the size |ω|²|ω×ω̇| dt⁴/240 T, the next term; without the coning term |ω×ω̇| dt²/12 T remains, 400 times more at 25 Hz.
    Velocity and position go as the middle frame of the closed form does, by 4.
    """
    w0, w1 = np.array([1.5, -1.0, 0.8]), np.array([-2.0, 1.5, 1.0])
    f0, f1 = np.array([1.0, -2.0, -9.0]), np.array([3.0, 2.0, -4.0])

    def w(t: float) -> FloatArray:
        return w0 + w1 * t

    def f(t: float) -> FloatArray:
        return f0 + f1 * t

    x = runge_kutta(w, f, 1.0, 2500)
    errors = np.array([errors_of(sampled(w, f, 1.0, n), x) for n in (25, 50, 100)])
    W, cone = 3.5, float(np.linalg.norm(np.cross(w0, w1)))
    F = 13.0
    for (angle, e_v, e_p), dt in zip(errors, (0.04, 0.02, 0.01), strict=True):
        assert angle < W**2 * cone * dt**4 / 240.0 + 1e-13
        assert angle < 0.01 * cone * dt**2 / 12.0
        assert e_v < W**2 * F * dt**2 / 24.0
        assert e_p < W**2 * F * dt**2 / 48.0 + (W * F + float(np.linalg.norm(f1))) * dt**2 / 12.0
    np.testing.assert_array_less(15.0, errors[:-1, 0] / errors[1:, 0])
    np.testing.assert_array_less(3.9, errors[:-1, 1:] / errors[1:, 1:])


@pytest.mark.parametrize("which", ["rate ramp", "force ramp", "both"])
def test_sculling_is_kept(which: str) -> None:
    """What is of first order in the rate, alone: rates of 0.1 mrad/s under forces of 10 m/s², so that |ω|² terms vanish.

    A step without the sculling terms would be wrong by (ω×ḟ - ω̇×f) dt³/12, 5e-4 of it is allowed here: the closed form's
    |ω|²|f| dt³/24, and for the ramp of the rate a higher order in dt.
    """
    k = 1e-4
    turns = which in ("rate ramp", "both")
    w0, w1 = k * np.array([0.3, -0.7, 0.5]), k * np.array([-2.0, 1.0, 3.0]) * turns
    f0, f1 = np.array([2.0, -1.0, -10.0]), np.array([-8.0, 6.0, 4.0]) * (which != "rate ramp")
    T, n = 0.4, 10
    dt = T / n

    def w(t: float) -> FloatArray:
        return w0 + w1 * t

    def f(t: float) -> FloatArray:
        return f0 + f1 * t

    x = runge_kutta(w, f, T, 400)
    _, e_v, _ = errors_of(sampled(w, f, T, n), x)
    lost = sum(np.cross(w((i + 0.5) * dt), f1) - np.cross(w1, f((i + 0.5) * dt)) for i in range(n)) * dt**3 / 12.0
    assert float(np.linalg.norm(lost)) > 1e-8
    assert e_v < 5e-4 * float(np.linalg.norm(lost)) + 1e-13


# Injection


@BAROS
@pytest.mark.parametrize("size", [1e-3, 0.02, 0.2])
def test_injection_moves_the_state_and_turns_the_covariance(baro: int, size: float) -> None:
    rng = np.random.default_rng(6)
    n = 15 + baro
    for _ in range(20):
        s = state(rng, baro)
        P, q = s["P"].copy(), scipy_of(s["q"])
        before = {k: s[k].copy() for k in ("v", "p", "bg", "ba", "baro")}
        dx = rng.standard_normal(n) * 0.3
        dx[TH] *= size / np.linalg.norm(dx[TH])
        s["dx"][:] = dx
        inject(s)
        # q ⊗ δq(δθ) exactly; the rest adds
        assert ((q * Rotation.from_rotvec(dx[TH])).inv() * scipy_of(s["q"])).magnitude() < 1e-14
        for name, block in (("v", V), ("p", P_), ("bg", BG), ("ba", BA), ("baro", slice(15, n))):
            np.testing.assert_allclose(s[name], before[name] + dx[block], rtol=0.0, atol=1e-14)
        assert not s["dx"].any()
        assert float(s["yaw_corrected"]) == pytest.approx(float((q.as_matrix() @ dx[TH])[2]), abs=1e-15)
        Gr = np.eye(n)
        Gr[TH, TH] -= 0.5 * skew(dx[TH])
        expected = Gr @ P @ Gr.T
        d = np.sqrt(np.diag(P))
        np.testing.assert_allclose(s["P"] / d / d[:, None], expected / d / d[:, None], rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("size", [1e-2, 5e-2])
def test_the_reset_matrix_is_the_derivative_of_the_reset(size: float) -> None:
    """After the correction θ̂ the error is log(exp(-θ̂) exp(θ̂+ε)) = G ε, G = I - ½[θ̂]× to the order |θ̂|²/6."""
    rng = np.random.default_rng(7)
    t = rng.standard_normal(3)
    t *= size / np.linalg.norm(t)
    h = 1e-6
    J = np.empty((3, 3))
    for k in range(3):
        e = np.zeros(3)
        e[k] = h
        plus = (Rotation.from_rotvec(t).inv() * Rotation.from_rotvec(t + e)).as_rotvec()
        minus = (Rotation.from_rotvec(t).inv() * Rotation.from_rotvec(t - e)).as_rotvec()
        J[:, k] = (plus - minus) / (2.0 * h)
    s = state(rng)
    P = s["P"][TH, TH].copy()
    s["dx"][TH] = t
    inject(s)
    d = math.sqrt(float(np.trace(P)))
    assert np.abs(s["P"][TH, TH] - J @ P @ J.T).max() <= 2.0 * size**2 / 6.0 * d**2 + 1e-9 * d**2
