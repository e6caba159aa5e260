"""The dynamics chain of a vehicle's model: derivatives of force and moment, transition of the error, covariance, against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.core.rotation import dcm
from haltere.strapdown import dynamics
from haltere.vehicle.linear import linear
from haltere.vehicle.regressors import AERO, PRESETS, lumped_layout, model

FloatArray = NDArray[np.float64]
NOMINAL = np.dtype(
    (
        np.record,
        [
            ("alone", "i8"),  # no record of the product begins like this one
            ("w", "f8", 3),
            ("q", "f8", 4),
            ("v", "f8", 3),
            ("p", "f8", 3),
            ("bm", "f8", 3),
            ("bf", "f8", 3),
            ("wind", "f8", 2),
            ("steady", "f8", 2),
        ],
    )
)


def vehicle(preset: str = "full", seed: int = 0) -> Any:
    """A quadrotor much like the Hummingbird, every constant of the preset other than zero."""
    rng = np.random.default_rng(seed)
    M = as_records(np.zeros(1, lumped_layout(4)))
    M["roll"], M["pitch"], M["yaw"] = [-0.12, 0.12, 0.12, -0.12], [0.12, 0.12, -0.12, -0.12], [1, -1, 1, -1]
    k = np.array(
        [
            [-2.4e-4, 0.01, -0.02, -0.01, 0.05, 0, 0], [-2.4e-4, -0.01, -0.02, -0.01, -0.03, 0, 0],
            [-1.11e-5, 3e-3, -4.6e-4, 0.02, 0, 0, 0], [1.5e-3, -0.92, -1.7, 1e-6, 1e-4, 0.1, 0.06],
            [1.5e-3, 0.92, -1.7, 1e-6, -1e-4, -0.12, 0.05], [1.9e-5, 0.05, -0.3, 1e-5, 1e-7, -0.017, -0.02],
        ]
    )  # fmt: skip
    use = np.zeros((6, 7))
    for i, columns in enumerate(PRESETS[preset]):
        use[i, list(columns)] = 1.0
    M["k"], M["aero"], M["literal"] = k * use * rng.uniform(0.8, 1.2, k.shape), np.array(AERO, float), int(preset == "literal")
    M["s1"] = 1900.0 if preset == "full" else 0.0
    return M


SPEEDS, SPIN_UP = np.array([460.0, 480.0, 470.0, 455.0]), np.array([100.0, -50.0, 20.0, 0.0])


def three(x: Any) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("v", [(3.0, -2.0, 1.0), (0.0, 0.0, 0.0)])
def test_derivatives_of_the_model(preset: str, v: tuple[float, float, float]) -> None:
    M, w, ratio = vehicle(preset), (0.4, -0.7, 0.9), 0.93

    def at(v: Any, w: Any) -> FloatArray:
        eta = (0.3, 0.2, -0.1) if preset == "literal" else three(w)
        f, a = model(M[0], SPEEDS, SPIN_UP, three(v), three(w), eta, ratio)
        return np.array([*f, *a])

    f, a, D_a, D_w, M_a, M_w = linear(M[0], SPEEDS, SPIN_UP, v, w, (0.3, 0.2, -0.1) if preset == "literal" else w, ratio)
    assert np.array_equal([*f, *a], at(v, w))
    h, one = 1e-5, np.eye(3)
    by_v = np.column_stack([(at(np.array(v) + h * e, w) - at(np.array(v) - h * e, w)) / (2 * h) for e in one])
    by_w = np.column_stack([(at(v, np.array(w) + h * e) - at(v, np.array(w) - h * e)) / (2 * h) for e in one])
    # |v| v has a bend at zero: its derivative there is zero, and central differences say so to first order in h
    np.testing.assert_allclose(np.vstack([D_a, M_a]), by_v, atol=1e-6)
    np.testing.assert_allclose(np.vstack([D_w, M_w]), by_w, atol=1e-6)


def _state(seed: int) -> dict[str, FloatArray]:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    return {
        "w": rng.normal(size=3), "q": q / np.linalg.norm(q), "v": rng.normal(size=3) * 4, "p": rng.normal(size=3) * 9,
        "bm": rng.normal(size=3) * 0.2, "bf": rng.normal(size=3) * 0.2, "wind": rng.normal(size=2) * 3, "steady": rng.normal(size=2) * 3,
    }  # fmt: skip


def _turned(q: FloatArray, t: FloatArray) -> FloatArray:
    angle = float(np.linalg.norm(t))
    d = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * t / angle]) if angle > 0 else np.array([1.0, 0, 0, 0])
    w, v = q[0], q[1:]
    return np.concatenate([[w * d[0] - v @ d[1:]], w * d[1:] + d[0] * v + np.cross(v, d[1:])])


def _with_error(x: dict[str, FloatArray], e: FloatArray) -> dict[str, FloatArray]:
    return {
        "w": x["w"] + e[0:3], "q": _turned(x["q"], e[3:6]), "v": x["v"] + e[6:9], "p": x["p"] + e[9:12], "bm": x["bm"] + e[12:15],
        "bf": x["bf"] + e[15:18], "wind": x["wind"] + e[18:20], "steady": x["steady"] + e[20:22],
    }  # fmt: skip


def _error(a: dict[str, FloatArray], b: dict[str, FloatArray]) -> FloatArray:
    """a minus b."""
    inverse = b["q"] * np.array([1, -1, -1, -1])
    d = np.concatenate([[inverse[0] * a["q"][0] - inverse[1:] @ a["q"][1:]],
                        inverse[0] * a["q"][1:] + a["q"][0] * inverse[1:] + np.cross(inverse[1:], a["q"][1:])])  # fmt: skip
    t = 2 * d[1:] * np.sign(d[0])
    return np.concatenate([a["w"] - b["w"], t, *(a[k] - b[k] for k in ("v", "p", "bm", "bf", "wind", "steady"))])


def _step(x: dict[str, FloatArray], M: Any, dt: float, keep: float) -> dict[str, FloatArray]:
    """One interval of the kernel's own nominal motion."""
    X = as_records(np.zeros(1, NOMINAL))
    for k, v in x.items():
        X[k][0] = v
    C = dcm(tuple(float(c) for c in x["q"]))
    v_air = dynamics.air_velocity(C, three(x["v"]), float(x["wind"][0]), float(x["wind"][1]))
    f, a, *_ = linear(M[0], SPEEDS, SPIN_UP, v_air, three(x["w"]), three(x["w"]), 0.97)
    dynamics.move(X[0], f, a, 9.81, dt, keep, keep**2)
    return {k: np.array(X[k][0]) for k in x}


def _transition(x: dict[str, FloatArray], M: Any, dt: float, keep: float) -> Any:
    C = dcm(tuple(float(c) for c in x["q"]))
    v_air = dynamics.air_velocity(C, three(x["v"]), float(x["wind"][0]), float(x["wind"][1]))
    f, _, D_a, D_w, M_a, M_w = linear(M[0], SPEEDS, SPIN_UP, v_air, three(x["w"]), three(x["w"]), 0.97)
    return dynamics.transition(C, three(x["w"]), three(np.array(f) + x["bf"]), v_air, D_a, D_w, M_a, M_w, dt, keep, keep**2)


def _dense(T: Any) -> FloatArray:
    """The transition as a matrix (25, 25), column by column."""
    A = np.eye(25)
    for j in range(25):
        column = A[j].copy()
        dynamics.carry_vector(column, T)
        A[j] = column
    return A.T


@pytest.mark.parametrize("seed", range(6))
def test_transition_is_the_derivative_of_the_motion(seed: int) -> None:
    """To first order in the interval: the error of a tenth of the interval is a hundred times smaller."""
    M, x, h = vehicle(seed=seed), _state(seed), 1e-6
    errors = []
    for dt in (1e-2, 1e-3):
        keep = float(np.exp(-dt / 3.0))
        middle = _step(x, M, dt, keep)

        def moved(e: FloatArray, x: Any = x, middle: Any = middle, dt: float = dt, keep: float = keep) -> FloatArray:
            return _error(_step(_with_error(x, e), M, dt, keep), middle)

        numeric = np.column_stack([(moved(h * e) - moved(-h * e)) / (2 * h) for e in np.eye(22)])
        A = _dense(_transition(x, M, dt, keep))
        assert np.array_equal(A[22:, 22:], np.eye(3)) and not A[:22, 22:].any() and not A[22:, :22].any()
        errors.append(np.abs(A[:22, :22] - numeric).max())
    assert errors[0] < 6e-3, errors
    assert errors[1] < 0.02 * errors[0], errors


@pytest.mark.parametrize("seed", range(3))
def test_covariance_is_carried_as_by_the_matrix(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S = as_records(np.zeros(1, np.dtype((np.record, [("alone", "i8"), ("P", "f8", (25, 25))]))))
    root = rng.normal(size=(25, 25))
    S["P"][0] = root @ root.T
    T = _transition(_state(seed), vehicle(), 0.01, 0.99)
    A = _dense(T)
    want = A @ (root @ root.T) @ A.T
    dynamics.carry(S[0], T)
    np.testing.assert_allclose(S["P"][0], want, rtol=0, atol=1e-11 * np.abs(want).max())
