"""Federated fusion: with the states shared out at every step it is the filter that has all measurements; less often, a cautious one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from haltere._jit import as_records, entry
from haltere.filter.federated import add_information, fused, invert, keep_apart, share_out

FloatArray = NDArray[np.float64]
N = 6
LOCAL = np.dtype((np.record, [("dx", "f8", N), ("P", "f8", (N, N))]))
FUSED = np.dtype((np.record, [("y", "f8", N), ("P", "f8", (N, N)), ("dx", "f8", N), ("work", "f8", (N, N))]))


@entry
def _fuse(F: Any, L: Any, beta: Any, apart: bool) -> None:
    f = F[0]
    for i in range(len(f.y)):
        f.y[i] = 0.0
        for j in range(len(f.y)):
            f.P[i, j] = 0.0
    for i in range(len(L)):
        add_information(f, L[i])
    fused(f)
    for i in range(len(L)):
        if apart:
            keep_apart(f, L[i])
        else:
            share_out(f, L[i], beta[i])


@entry
def _invert(A: Any, n: int) -> None:
    invert(A, n)


def _system(seed: int) -> tuple[FloatArray, FloatArray, list[FloatArray], list[FloatArray]]:
    rng = np.random.default_rng(seed)
    A = np.eye(N) + 0.1 * rng.normal(size=(N, N))
    root = 0.1 * rng.normal(size=(N, N))
    H = [rng.normal(size=(k, N)) for k in (1, 2, 3, 1)]
    return A, root @ root.T, H, [np.diag(rng.uniform(0.1, 2.0, len(h))) for h in H]


def _update(P: FloatArray, x: FloatArray, H: FloatArray, R: FloatArray, e: FloatArray) -> tuple[FloatArray, FloatArray]:
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    I = np.eye(len(P)) - K @ H
    return I @ P @ I.T + K @ R @ K.T, x + K @ (e - H @ x)


@pytest.mark.parametrize("n", [1, 5, 22])
def test_inverse(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n)) * np.logspace(-3, 2, n)[:, None]
    A = np.zeros((n + 2, n + 2))
    A[:n, :n] = want = root @ root.T + 1e-9 * np.eye(n)
    A[n:, n:] = 7.0
    _invert(A, n)
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    np.testing.assert_allclose((A[:n, :n] @ want), np.eye(n), atol=1e-5)
    np.testing.assert_allclose(
        A[:n, :n] * scale, np.linalg.inv(want / scale), rtol=1e-6, atol=1e-6 * np.abs(np.linalg.inv(want / scale)).max()
    )
    assert (A[n:, n:] == 7.0).all()


@pytest.mark.parametrize("beta", [(0.25, 0.25, 0.25, 0.25), (0.7, 0.1, 0.15, 0.05)])
@pytest.mark.parametrize("seed", range(3))
def test_shared_out_at_every_step_it_is_the_filter_with_all_measurements(beta: tuple[float, ...], seed: int) -> None:
    A, Q, H, R = _system(seed)
    rng = np.random.default_rng(100 + seed)
    P, x = np.eye(N), np.zeros(N)
    F, L = as_records(np.zeros(1, FUSED)), as_records(np.zeros(4, LOCAL))
    nominal = np.zeros(N)
    for i, b in enumerate(beta):
        L["P"][i] = P / b
    for _ in range(200):
        e = [rng.normal(size=len(h)) for h in H]
        P, x = A @ P @ A.T + Q, A @ x
        for i in range(4):
            P, x = _update(P, x, H[i], R[i], e[i])
        nominal = A @ nominal
        for i, b in enumerate(beta):
            p = A @ L["P"][i] @ A.T + Q / b
            L["P"][i], L["dx"][i] = _update(p, A @ L["dx"][i], H[i], R[i], e[i] - H[i] @ nominal)
        _fuse(F, L, np.array(beta), False)
        nominal = nominal + F["dx"][0]
        assert not L["dx"].any()
        np.testing.assert_allclose(F["P"][0], P, rtol=0, atol=1e-10)
        np.testing.assert_allclose(nominal, x, rtol=0, atol=1e-10)


def _bias_and_rate(shared: bool) -> tuple[float, float]:
    """Variance of a constant bias after 400 steps, of the filter with all measurements and of the federated one.

    A rate that walks is measured with a bias by one sensor, and without one, badly, by another. The bias is among the states that the two
    local filters share, or is kept by the first alone: then b given the rate stays, and the rate is told by half.
    """
    Q, b = np.diag([0.01, 0.0]), (0.5, 0.5)
    H, R = (np.array([[1.0, 1.0]]), np.array([[1.0, 0.0]])), (np.array([[0.01]]), np.array([[25.0]]))
    P = np.diag([1.0, 1.0])
    own, rate = P / b[0], np.array([[1.0 / b[1]]])
    if not shared:
        own = np.diag([1.0 / b[0], 1.0])
    local = [P / k for k in b]
    zero = np.zeros(2)
    for _ in range(400):
        P += Q
        for h, r in zip(H, R, strict=True):
            P, _x = _update(P, zero, h, r, np.zeros(1))
        if shared:
            parts = [_update(p + Q / k, zero, h, r, np.zeros(1))[0] for p, k, h, r in zip(local, b, H, R, strict=True)]
            fused_P = np.linalg.inv(sum(np.linalg.inv(p) for p in parts))
            local = [fused_P / k for k in b]
            last = fused_P[1, 1]
        else:
            own, _x = _update(own + Q / b[0], zero, H[0], R[0], np.zeros(1))
            rate, _x = _update(rate + Q[:1, :1] / b[1], np.zeros(1), H[1][:, :1], R[1], np.zeros(1))
            known = 1.0 / (1.0 / own[0, 0] + 1.0 / rate[0, 0])
            slope = own[1, 0] / own[0, 0]
            given = own[1, 1] - slope**2 * own[0, 0]
            own = np.array([[1.0, slope], [slope, slope**2]]) * known / b[0] + np.diag([0.0, given])
            rate = np.array([[known / b[1]]])
            last = given + slope**2 * known
    return float(P[1, 1]), float(last)


def test_a_bias_must_be_shared() -> None:
    """theory-amendments.md 4 keeps biases local; what is known of one then goes through a rate that each step makes unsure by Q/β."""
    central, federated = _bias_and_rate(True)
    assert federated == pytest.approx(central, rel=1e-9)
    central, federated = _bias_and_rate(False)
    assert federated > 2.0 * central


def _toy(every: int, ramp: float, runs: int, steps: int, seed: int) -> tuple[float, float, FloatArray]:
    """A walk seen by three sensors, the first of which drifts by ``ramp`` a step: trace over that of the joint filter, NEES, errors.

    The first sensor is left out of the last fusion where it drifts. All runs go at once: gains are the same in all.
    """
    rng = np.random.default_rng(seed)
    A, Q, R, b = np.array([[1.0, 0.1], [0.0, 1.0]]), np.diag([0.0, 0.01]), (0.25, 0.5, 0.5), 1.0 / 3.0
    H = [np.array([[1.0, 0.0]]), np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]])]
    truth, P, Pf, xf = rng.normal(size=(runs, 2)), np.eye(2), np.eye(2), np.zeros((runs, 2))
    Pi, xi = [np.eye(2) / b] * 3, [np.zeros((runs, 2))] * 3
    for k in range(steps):
        truth = truth @ A.T + np.column_stack([np.zeros(runs), 0.1 * rng.normal(size=runs)])
        P = A @ P @ A.T + Q
        for i in range(3):
            z = truth @ H[i].T + np.sqrt(R[i]) * rng.normal(size=(runs, 1)) + (ramp * (k + 1) if i == 0 else 0.0)
            P, _ = _update(P, np.zeros(2), H[i], R[i] * np.eye(1), np.zeros(1))
            p = A @ Pi[i] @ A.T + Q / b
            K = np.linalg.solve(H[i] @ p @ H[i].T + R[i], H[i] @ p)
            x = xi[i] @ A.T
            xi[i], (Pi[i], _) = x + (z - x @ H[i].T) @ K, _update(p, np.zeros(2), H[i], R[i] * np.eye(1), np.zeros(1))
        parts = range(3) if k < steps - 1 or ramp == 0.0 else range(1, 3)
        inverse = [np.linalg.inv(Pi[i]) for i in range(3)]
        Pf = np.linalg.inv(sum(inverse[i] for i in parts))
        xf = sum(xi[i] @ inverse[i] for i in parts) @ Pf
        if every and (k + 1) % every == 0:
            Pi, xi = [Pf / b] * 3, [xf] * 3
    e = xf - truth
    return float(np.trace(Pf) / np.trace(P)), float(np.mean(np.einsum("ki,ij,kj->k", e, np.linalg.inv(Pf), e))), e


def test_less_often_shared_out_it_is_a_cautious_filter() -> None:
    """As theory.md §5.6 has it: the trace grows with the time between resets, and NEES (want 2 here) is below what it claims."""
    ratios, nees = [], []
    for every in (1, 10, 0):
        ratio, n, _ = _toy(every, 0.0, 4000, 120, 3)
        ratios.append(ratio)
        nees.append(n)
    assert ratios[0] == pytest.approx(1.0, abs=1e-9)
    assert 1.0 < ratios[1] < ratios[2] < 2.0
    assert nees[2] < 2.0 + 3.0 * np.sqrt(4.0 / 4000)


def test_without_reset_a_fault_that_was_not_seen_stays_in_its_own_filter() -> None:
    """theory.md §5.6: a ramp of 0.02 a step, left out after 50 and 100 steps, is in the fused state with resets, and is not without."""
    left = {(every, n): np.abs(_toy(every, 0.02, 2000, n, 4)[2][:, 0].mean()) for every in (1, 0) for n in (50, 100)}
    assert left[1, 50] > 0.3 and left[1, 100] > 1.6 * left[1, 50]
    assert left[0, 50] < 0.12 and left[0, 100] < 0.12
