"""Laws of the filter's parts: updates, innovation tests and queues, against dense numpy and sorted lists."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from haltere._jit import COMPILED
from haltere.filter import gates, queue
from haltere.filter.update import NONE, apply, column_of, innovation, project, symmetrise, variance
from haltere.strapdown.layout import IMU_CAPACITY, MEASUREMENT_CAPACITY, PARAMETERS, layout
from haltere.strapdown.propagate import inject, predict

FloatArray = NDArray[np.float64]
Row = tuple[Any, Any, Any]

law = settings(deadline=None, max_examples=100)
BAROS = pytest.mark.parametrize("baro", [0, 1])


def new(dtype: np.dtype[np.void]) -> Any:
    """One record that kernels can change."""
    array = np.zeros(1, dtype)
    return (array if COMPILED else array.view(np.recarray))[0]


def spd(rng: np.random.Generator, n: int) -> FloatArray:
    """Covariance with strong correlations and with standard deviations from 1e-4 to 10, as a filter has them."""
    a = rng.standard_normal((n, n))
    d = 10.0 ** rng.uniform(-4.0, 1.0, n)
    c = a @ a.T / n + 0.05 * np.eye(n)
    P: FloatArray = d[:, None] * c * d
    return 0.5 * (P + P.T)


def state(rng: np.random.Generator, baro: int) -> Any:
    s = new(layout(baro))
    n = 15 + baro
    s["P"][:] = spd(rng, n)
    s["q"][0] = 1.0
    return s


def random_row(rng: np.random.Generator, n: int) -> tuple[Row, FloatArray]:
    """A row of one to three blocks, which may overlap, in the kernels' form and dense."""
    blocks, dense = [], np.zeros(n)
    for _ in range(rng.integers(1, 4)):
        c = int(rng.integers(0, n - 2))
        h = rng.standard_normal(3)
        dense[c : c + 3] += h
        blocks.append((c, tuple(float(x) for x in h)))
    while len(blocks) < 3:
        blocks.append(NONE)
    return tuple(blocks), dense  # type: ignore[return-value]


def joseph(P: FloatArray, H: FloatArray, K: FloatArray, R: FloatArray) -> FloatArray:
    a = np.eye(len(P)) - K @ H
    out: FloatArray = a @ P @ a.T + K @ R @ K.T
    return out


def near(P: FloatArray, expected: FloatArray, tolerance: float, before: FloatArray) -> None:
    """Elements compared on the scale of the standard deviations of the prior, from which they are differences."""
    d = np.sqrt(np.diag(before))
    np.testing.assert_allclose(P / d / d[:, None], expected / d / d[:, None], rtol=0.0, atol=tolerance)


# Updates


@BAROS
def test_rows_and_columns(baro: int) -> None:
    rng = np.random.default_rng(1)
    n = 15 + baro
    s = state(rng, baro)
    s["P"][:] += 1e-3 * rng.standard_normal((n, n))  # not symmetric: rows and columns are not to be mixed up
    for _ in range(50):
        row, H = random_row(rng, n)
        project(s, row)
        np.testing.assert_allclose(s["u"], H @ s["P"], rtol=0.0, atol=1e-12)
        assert variance(s, row) == pytest.approx(H @ s["P"] @ H, abs=1e-12)
        column_of(s, row)
        np.testing.assert_allclose(s["k"], s["P"] @ H, rtol=0.0, atol=1e-12)
        s["dx"][:] = rng.standard_normal(n)
        assert innovation(s, row, 0.7) == pytest.approx(0.7 - H @ s["dx"], abs=1e-13)


@BAROS
def test_optimal_updates_are_the_dense_joseph_form(baro: int) -> None:
    """Twenty scalar updates one after the other; the measurement variance is of the size of the innovation's."""
    rng = np.random.default_rng(2)
    n = 15 + baro
    for _ in range(30):
        s = state(rng, baro)
        P, x = s["P"].copy(), np.zeros(n)
        before = P.copy()
        for _ in range(20):
            row, H = random_row(rng, n)
            r = float(H @ P @ H) * 10.0 ** rng.uniform(-2.0, 2.0)
            e = float(rng.standard_normal()) * math.sqrt(r)
            S = gates.optimal_gain(s, row, r)
            assert pytest.approx(float(H @ P @ H) + r, rel=1e-12) == S
            K = P @ H / (H @ P @ H + r)
            np.testing.assert_allclose(s["k"], K, rtol=1e-11, atol=1e-12 * np.abs(K).max())
            apply(s, row, r, e)
            P = joseph(P, H[None], K[:, None], np.array([[r]]))
            x = x + K * e
            near(s["P"], P, 1e-12, before)
            sd = np.sqrt(np.diag(before))
            np.testing.assert_allclose(s["dx"] / sd, x / sd, rtol=0.0, atol=1e-11)  # a correction is some sd, twenty times
        assert np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P)))).min() > 0.0


@BAROS
def test_any_gain_is_the_full_joseph_form(baro: int) -> None:
    """A masked gain too: (I - KH) P (I - KH)ᵀ + K R Kᵀ; the short form P - K H P would not be symmetric."""
    rng = np.random.default_rng(3)
    n = 15 + baro
    for _ in range(100):
        s = state(rng, baro)
        P = s["P"].copy()
        row, H = random_row(rng, n)
        r = float(H @ P @ H) * 10.0 ** rng.uniform(-1.0, 1.0)
        K = P @ H / (H @ P @ H + r) * rng.uniform(-0.5, 1.5, n) * (rng.random(n) < 0.6)
        project(s, row)
        s["k"][:] = K
        apply(s, row, r, 0.3)
        expected = joseph(P, H[None], K[:, None], np.array([[r]]))
        near(s["P"], expected, 1e-12, P)
        np.testing.assert_allclose(s["dx"], 0.3 * K, rtol=1e-15)
        untouched = K == 0.0
        assert (s["P"][np.ix_(untouched, untouched)] == P[np.ix_(untouched, untouched)]).all()


@BAROS
def test_rows_one_after_the_other_are_the_batch(baro: int) -> None:
    """Three rows whose predictions are correlated through P, the correction injected once at the end: `innovation` is what makes it so."""
    rng = np.random.default_rng(4)
    n = 15 + baro
    for _ in range(50):
        s = state(rng, baro)
        P = s["P"].copy()
        rows = [random_row(rng, n) for _ in range(3)]
        H = np.array([h for _, h in rows])
        R = np.diag(np.diag(H @ P @ H.T) * 10.0 ** rng.uniform(-1.0, 1.0, 3))
        e = rng.standard_normal(3) * np.sqrt(np.diag(R))
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        for k in range(3):
            gates.optimal_gain(s, rows[k][0], float(R[k, k]))
            apply(s, rows[k][0], float(R[k, k]), innovation(s, rows[k][0], float(e[k])))
        near(s["P"], joseph(P, H, K, R), 1e-11, P)
        sd = np.sqrt(np.diag(P))
        np.testing.assert_allclose(s["dx"] / sd, K @ e / sd, rtol=0.0, atol=1e-11)


def test_symmetrise() -> None:
    rng = np.random.default_rng(5)
    s = state(rng, 1)
    s["P"][:] += rng.standard_normal((16, 16))
    upper = np.triu(s["P"])
    symmetrise(s)
    assert (s["P"] == s["P"].T).all()
    assert (np.triu(s["P"]) == upper).all()


def test_covariance_stays_symmetric_and_positive_over_a_hundred_thousand_steps() -> None:
    """Predictions and updates in random order, good and bad measurements, masked gains, injections: as long as a flight of minutes.

    Between two symmetrisations, twenty operations apart at most, rounding may leave 20 * 16 roundings of a standard deviation's
    square; the correlation matrix must keep a Cholesky factor.
    """
    rng = np.random.default_rng(6)
    s = state(rng, 1)
    s["gravity"] = 9.81
    s["P"][:] = np.diag(np.repeat([0.03, 0.3, 1.0, 0.01, 0.2], 3).tolist() + [3.0]) ** 2
    prm = new(PARAMETERS)
    for name, value in (("gyro", 1.5e-3), ("accel", 0.035), ("gyro_bias", 1e-4), ("accel_bias", 3e-4), ("baro_bias", 0.05)):
        prm[f"noise_{name}"] = value
    draws = rng.standard_normal((100_000, 8))
    kinds = rng.integers(0, 6, 100_000)
    rows = [random_row(rng, 16) for _ in range(64)]
    unit = [((c, (1.0, 0.0, 0.0)), NONE, NONE) for c in (3, 4, 5, 6, 7, 8)]
    worst = 0.0
    for i in range(100_000):
        a = draws[i]
        if kinds[i] < 3:
            w, f = (float(a[0]), float(a[1]), float(a[2])), (float(a[3]), float(a[4]), -9.81 + float(a[5]))
            dt = 0.004 if i % 50 else 0.05
            predict(s, prm, w, f, (w[0] * dt, w[1] * dt, w[2] * dt), (f[0] * dt, f[1] * dt, f[2] * dt), dt)
        elif kinds[i] < 5:
            row = unit[i % 6]  # what holds the filter
            gates.optimal_gain(s, row, 0.04)
            apply(s, row, 0.04, 0.1 * float(a[0]))
        else:
            row = rows[i % 64][0]
            r = 10.0 ** (2.0 * float(a[1]))
            gates.optimal_gain(s, row, r)
            if i % 3 == 0:
                s["k"][rng.random(16) < 0.5] = 0.0
            apply(s, row, r, 0.01 * float(a[0]))
        if i % 20 == 19:
            inject(s)
            d = np.sqrt(np.diag(s["P"]))
            worst = max(worst, float(np.abs((s["P"] - s["P"].T) / d / d[:, None]).max()))
            symmetrise(s)
        if i % 1000 == 999:
            d = np.sqrt(np.diag(s["P"]))
            assert np.isfinite(d).all()
            assert np.linalg.eigvalsh(s["P"] / d / d[:, None]).min() > 0.0
            s["v"][:] = s["p"][:] = 0.0
    assert worst < 20 * 16 * np.finfo(float).eps


# Innovation tests


@BAROS
def test_joint_nis(baro: int) -> None:
    rng = np.random.default_rng(7)
    n = 15 + baro
    for i in range(100):
        s = state(rng, baro)
        P = s["P"].copy()
        rows = [random_row(rng, n) for _ in range(3)]
        H = np.array([h for _, h in rows])
        r = np.diag(H @ P @ H.T) * 10.0 ** rng.uniform(-1.0, 1.0, 3)
        S = H @ P @ H.T + np.diag(r)
        e = rng.standard_normal(3) * np.sqrt(np.diag(S))
        there = np.array([[1, 1, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1], [0, 0, 1]][i % 5], bool)
        r_given = np.where(there, r, gates.ABSENT)
        e_given = np.where(there, e, 0.0)
        nis, s_ii = gates.joint_nis(s, rows[0][0], rows[1][0], rows[2][0], tuple(map(float, e_given)), tuple(map(float, r_given)))
        inner = np.ix_(there, there)
        assert nis == pytest.approx(float(e[there] @ np.linalg.solve(S[inner], e[there])), rel=1e-11)
        np.testing.assert_allclose(np.array(s_ii)[there], np.diag(S)[there], rtol=1e-12)


@law
@given(st.floats(1e-3, 1e6), st.floats(1e-6, 1e3), st.floats(1e-6, 1e3), st.floats(0.5, 10.0))
def test_inflated_variance_brings_a_scalar_to_its_gate(e: float, hph: float, r: float, gate: float) -> None:
    S = hph + r
    nis = e * e / S
    inflated = gates.inflation(nis, gate, S, r)
    if nis <= gate * gate:
        assert inflated == r
    else:
        assert e * e / (hph + inflated) / gate**2 == pytest.approx(1.0, rel=1e-12)


# Queues


class SortedQueue:
    """A queue as a list kept in order: first valid, first out; of equal times the one that came first."""

    def __init__(self) -> None:
        self.items: list[tuple[float, int]] = []
        self.late = self.overflow = 0

    def push(self, t: float, name: int, now: float) -> int:
        if t < now - 1e-9:
            self.late += 1
            return 0
        full = len(self.items) == MEASUREMENT_CAPACITY
        if full:
            self.overflow += 1
            del self.items[0]
        k = sum(1 for other, _ in self.items if other <= t)
        self.items.insert(k, (t, name))
        return -1 if full else 1

    def pop(self, t: float) -> int | None:
        return self.items.pop(0)[1] if self.items and self.items[0][0] <= t else None


def push_both(s: Any, oracle: SortedQueue, kind: int, t: float, name: int) -> None:
    z, r = (float(name), t, -t), (name + 0.25, name + 0.5, name + 0.75)
    assert queue.push(s, kind, t, z, r) == oracle.push(t, name, float(s["t"]))


def pop_both(s: Any, oracle: SortedQueue, kind: int, t: float) -> bool:
    i, name = queue.pop_due(s, kind, t), oracle.pop(t)
    if name is None:
        assert i == -1
        return False
    m = s["ring"][kind, i]
    assert m["z"].tolist() == [name, m["t"], -m["t"]]
    assert m["r"].tolist() == [name + 0.25, name + 0.5, name + 0.75]
    return True


#: Times with many ties; False: take what is due, True: put.
operations = st.lists(
    st.tuples(st.booleans(), st.integers(0, 3), st.integers(0, 12).map(lambda k: 0.25 * k)),
    max_size=80,
)


@settings(deadline=None, max_examples=150)
@given(operations)
def test_queues_give_back_in_order_of_valid_time(steps: list[tuple[bool, int, float]]) -> None:
    """Any order of arrival, four queues that know nothing of each other, a horizon that only goes forward."""
    s = new(layout(0))
    s["phase"] = 2
    oracles = [SortedQueue() for _ in range(4)]
    for name, (put, kind, t) in enumerate(steps):
        if put:
            push_both(s, oracles[kind], kind, t, name)
        else:
            s["t"] = max(float(s["t"]), t)
            pop_both(s, oracles[kind], kind, float(s["t"]))
    for kind, oracle in enumerate(oracles):
        assert s["aid"][kind]["n_late"] == oracle.late
        assert s["ring_n"][kind] == len(oracle.items)
        while pop_both(s, oracle, kind, 1e9):
            pass
        assert s["ring_n"][kind] == 0
    assert queue.pop_due(s, 0, 1e9) == -1


@pytest.mark.parametrize("order", ["rising", "falling", "shuffled"])
def test_a_full_queue_drops_the_oldest_and_counts(order: str) -> None:
    rng = np.random.default_rng(8)
    t = np.arange(3 * MEASUREMENT_CAPACITY, dtype=float)
    times = {"rising": t, "falling": t[::-1], "shuffled": rng.permutation(t)}[order]
    s = new(layout(0))
    s["phase"] = 1
    oracle = SortedQueue()
    for name, time in enumerate(times):
        push_both(s, oracle, 2, float(time), name)
        if name % 7 == 0:  # the ring turns
            pop_both(s, oracle, 2, float(t[-1]))
    assert s["aid"][2]["n_overflow"] == oracle.overflow > 0
    assert s["aid"][2]["n_late"] == 0
    while pop_both(s, oracle, 2, 1e9):
        pass
    assert not oracle.items


def test_late_is_before_the_state_and_only_once_it_runs() -> None:
    s = new(layout(0))
    z = (1.0, 2.0, 3.0)
    s["t"] = 10.0
    assert queue.push(s, 0, 5.0, z, z) == 1  # nothing seen yet: the state has no time
    s["phase"] = 1
    assert queue.push(s, 0, 9.999, z, z) == 0
    assert queue.push(s, 0, 10.0, z, z) == 1
    assert queue.push(s, 0, 10.0 - 1e-10, z, z) == 1  # rounding of a stamp is not lateness
    assert s["aid"][0]["n_late"] == 1
    assert s["aid"][1]["n_late"] == 0


def test_imu_queue_turns() -> None:
    s = new(layout(0))
    assert queue.oldest_imu(s) == -1
    k = 0
    for round_ in range(5):
        n = IMU_CAPACITY if round_ == 3 else IMU_CAPACITY - 100
        for i in range(n):
            x = float(k + i)
            queue.push_imu(s, x, (x, x + 0.1, x + 0.2), (x + 0.3, x + 0.4, x + 0.5))
        for i in range(n):
            m = s["imu"][queue.oldest_imu(s)]
            x = float(k + i)
            assert (m["t"], *m["w"], *m["f"]) == (x, x, x + 0.1, x + 0.2, x + 0.3, x + 0.4, x + 0.5)
            queue.pop_imu(s)
        k += n
    assert queue.oldest_imu(s) == -1
