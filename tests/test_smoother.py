"""The fixed-interval smoother: against a dense oracle, a closed form and truth, and over everything that interrupts a run."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import haltere
from haltere import drive
from haltere.aids.air import calm
from haltere.drive import run
from haltere.estimators.base import Estimator, InitialState
from haltere.flight.log import FlightLog, Stream
from haltere.metrics.consistency import DOF, band, nees_series
from haltere.metrics.errors import error_series
from haltere.simulate import Scenario, demo_flight, simulate
from test_consistency import _start

FloatArray = NDArray[np.float64]
OPTIONAL = ("baro", "wind", "drag", "steady")
AXES = {"vel": "ned", "pos": "ned", "gyro_bias": "xyz", "accel_bias": "xyz"}


def part(flight: FlightLog, start: float, end: float) -> FlightLog:
    return FlightLog({k: s.where((s.t >= start) & (s.t <= end)) for k, s in flight.streams.items()}, flight.meta)


def with_stream(flight: FlightLog, name: str, stream: Stream) -> FlightLog:
    return FlightLog({**flight.streams, name: stream}, flight.meta)


# The oracle: every step, dense, in plain NumPy, from the posteriors of the online filter.


def skew(v: FloatArray) -> FloatArray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class Oracle:
    """Rauch, Tung and Striebel as in the textbook: gain, state and covariance at every IMU sample."""

    def __init__(self, flight: FlightLog, solution: haltere.Solution) -> None:
        self.number, self.g = solution.config.number, None
        self.t, self.x, self.P, self.raw = self.posteriors(flight, solution)

    def posteriors(self, flight: FlightLog, solution: haltere.Solution) -> tuple[FloatArray, list[Any], FloatArray, FloatArray]:
        est = Estimator(solution.config.estimator, solution.config)
        imu = flight["imu"]
        raw = np.c_[imu.vector("gyro"), imu.vector("accel")]
        offers = sorted(
            (float(t), rank, name, i)
            for rank, name in enumerate(("gnss", "barometer", "magnetometer", "rotors"))
            if name in flight
            for i, t in enumerate(flight[name].t)
        )
        t, x, P, rows, j = [], [], [], [], 0
        for i, stamp in enumerate(imu.t):
            while j < len(offers) and offers[j][0] <= stamp:
                _, _, name, k = offers[j]
                est.offer(name, offers[j][0], {c: float(v[k]) for c, v in flight[name].columns.items()})
                j += 1
            est.step(stamp, raw[i, :3], raw[i, 3:])
            s = est.finish()  # nothing is late, so that the horizon may be the newest sample
            if s.aligned and (not t or s.t > t[-1]):
                assert not t or s.t == imu.t[rows[-1] + 1]  # a row at every sample
                copy = est.state
                optional = [copy.record[block][0] for block in OPTIONAL]
                x.append((copy.q_nb, np.r_[copy.vel_n, copy.pos_n, copy.gyro_bias_b, copy.accel_bias_b, *optional]))
                t.append(copy.t)
                P.append(copy.P)
                rows.append(int(np.searchsorted(imu.t, copy.t)))
                self.g = float(copy.record["gravity"][0])
        return np.array(t), x, np.array(P), raw[rows]

    def predict(self, k: int) -> tuple[Rotation, FloatArray, FloatArray, FloatArray]:
        """Nominal state, Φ and covariance predicted from row k to k + 1; samples are linear between their times."""
        q, v = self.x[k]
        h = self.t[k + 1] - self.t[k]
        a, b = self.raw[k] - v[6:12], self.raw[k + 1] - v[6:12]
        w, f = 0.5 * (a + b)[:3], 0.5 * (a + b)[3:]
        turn = w * h + h * h / 12.0 * np.cross(a[:3], b[:3])
        dv = f * h + h * h / 12.0 * (np.cross(a[:3], b[3:]) + np.cross(a[3:], b[:3]))
        R = Rotation.from_quat(q, scalar_first=True)
        C = (R * Rotation.from_rotvec(0.5 * turn)).as_matrix()
        acc = C @ dv + [0.0, 0.0, self.g * h]
        new = v.copy()
        new[3:6] += h * (v[:3] + 0.5 * acc)
        new[:3] += acc
        n = len(self.P[k])
        F = np.eye(n)
        F[:3, :3] = Rotation.from_rotvec(-turn).as_matrix()
        F[:3, 9:12] = -h * np.eye(3)
        F[3:6, :3], F[3:6, 12:15] = -h * C @ skew(f), -h * C
        F[6:9, 3:6], F[6:9, :3], F[6:9, 12:15] = h * np.eye(3), -0.5 * h * h * C @ skew(f), -0.5 * h * h * C
        gyro, accel, wg, wa = (self.number(f"noise.{s}") ** 2 for s in ("gyro", "accel", "gyro_bias", "accel_bias"))
        Q: Any = [gyro * h + wg * h**3 / 3.0] * 3 + [accel * h] * 3 + [accel * h**3 / 3.0] * 3 + [wg * h] * 3 + [wa * h] * 3
        gyro_step, force_step = (self.raw[k + 1] - self.raw[k]).reshape(2, 3)
        missed = (self.number("noise.between") * h) ** 2  # of the course between two samples
        Q[:6] = list(np.array(Q[:6]) + missed * np.r_[gyro_step**2, np.full(3, force_step @ force_step / 3.0)])
        Q += [self.number("noise.baro_bias") ** 2 * h] * min(n - 15, 1)
        if n > 16:  # wind as its force at hover, ln mu, ln c, two offsets, the mean of the force
            keep = np.exp(-h / self.number("air.gust_time"))
            F[16:18, 16:18], F[16:18, 22:24] = keep * np.eye(2), (1.0 - keep) * np.eye(2)
            new[13:15] = keep * v[13:15] + (1.0 - keep) * v[19:21]
            mu, c, mean = np.exp(v[15]), np.exp(v[16]), np.hypot(*v[19:21])
            per_wind = np.sqrt(mu * mu + 4.0 * c * mean)
            gust = per_wind * (self.number("air.gust") + self.number("air.turbulence") * (per_wind - mu) / (2.0 * c))
            Q += [gust**2 * (1.0 - keep**2)] * 2 + [self.number("noise.air_walk") ** 2 * h] * 4
            Q += [(per_wind * self.number("noise.wind_mean")) ** 2 * h] * 2
        return R * Rotation.from_rotvec(turn), new, F, F @ self.P[k] @ F.T + np.diag(Q)

    def before_assumptions(self, nodes: FloatArray) -> dict[int, tuple[Rotation, FloatArray, FloatArray]]:
        """From a tape: by row, the state and covariance just before assumptions that tell the past nothing."""
        out = {}
        n = len(self.P[0])
        for node, after in pairwise(nodes):
            if after[1] < 0.0:
                P = np.zeros((n, n))
                P[np.triu_indices(n)] = node[19 + n - 15 :]
                P += np.triu(P, 1).T
                row = int(np.searchsorted(self.t, node[0]))
                out[row] = (Rotation.from_quat(node[3:7], scalar_first=True), node[7 : 19 + n - 15], P)
        return out

    def unturn(self, before: Rotation, after: Rotation) -> FloatArray:
        """From errors of the attitude after an injection to those before it: the inverse of 1 - ½[δθ]×."""
        T = np.eye(len(self.P[0]))
        T[:3, :3] = np.linalg.inv(np.eye(3) - 0.5 * skew((before.inv() * after).as_rotvec()))
        return T

    def past(self, k: int, x: Any, P: FloatArray, before: tuple[Rotation, FloatArray, FloatArray]) -> tuple[Any, FloatArray]:
        """What is known of row k before its assumptions: the filter's, and the information of what comes after, which is apart from it."""
        R, v, prior = before
        own = (Rotation.from_quat(self.x[k][0], scalar_first=True), self.x[k][1])
        scale = np.sqrt(np.diag(prior))
        T = self.unturn(R, own[0])
        own_P, Ps, before_P = (M / np.outer(scale, scale) for M in (T @ self.P[k] @ T.T, T @ P @ T.T, prior))
        moved = T @ np.r_[(own[0].inv() * x[0]).as_rotvec(), x[1] - own[1]] / scale
        apart = np.r_[(R.inv() * own[0]).as_rotvec(), own[1] - v] / scale
        # with Λ = (Y⁻¹ + P)⁻¹ = P⁻¹ (P - Pˢ) P⁻¹ instead of Y = Pˢ⁻¹ - P⁻¹, of which rounding leaves nothing
        L = np.linalg.solve(own_P, np.linalg.solve(own_P, own_P - Ps).T)
        M = np.eye(len(L)) + L @ (before_P - own_P)
        d = scale * (before_P @ np.linalg.solve(M, np.linalg.solve(own_P, moved) + L @ apart))
        Ps = before_P - before_P @ np.linalg.solve(M, L) @ before_P
        return (R * Rotation.from_rotvec(d[:3]), v + d[3:]), Ps * np.outer(scale, scale)

    def smooth(self, nodes: FloatArray | None = None) -> tuple[list[Any], FloatArray]:
        n = len(self.t)
        x: list[Any] = [None] * n
        P = self.P.copy()
        before = {} if nodes is None else self.before_assumptions(nodes)
        x[-1] = (Rotation.from_quat(self.x[-1][0], scalar_first=True), self.x[-1][1])
        for k in range(n - 2, -1, -1):
            R, v, F, prior = self.predict(k)
            G = np.linalg.solve(prior, F @ self.P[k]).T
            after, P_after = x[k + 1], P[k + 1]
            if k + 1 in before:
                after, P_after = self.past(k + 1, after, P_after, before[k + 1])
                own = before[k + 1][0]
            else:
                own = Rotation.from_quat(self.x[k + 1][0], scalar_first=True)
            T = self.unturn(R, own)
            P_after = T @ P_after @ T.T
            d = G @ np.r_[(R.inv() * after[0]).as_rotvec(), after[1] - v]
            x[k] = (Rotation.from_quat(self.x[k][0], scalar_first=True) * Rotation.from_rotvec(d[:3]), self.x[k][1] + d[3:])
            P[k] += G @ (P_after - prior) @ G.T
        return x, P


@pytest.mark.parametrize("estimator", ["navigator", "ahrs", "wind"])
def test_it_is_the_dense_smoother_of_the_textbook(estimator: str) -> None:
    flight = part(demo_flight(3, 24.0), 2.0, 8.0)
    if estimator == "wind":
        flight = part(
            simulate(Scenario(mission="figure-eight", duration=30.0, rest=0.0, seed=4, tell_noise=True, wind={"n": 4.0})), 8.0, 14.5
        )
        flight, estimator = flight.without("truth", "power"), "navigator"
    prompt = {f"delay.{k}": 0.0 for k in ("gnss", "barometer", "magnetometer")}
    solution = run(flight, estimator, set=prompt, smooth=True)
    oracle = Oracle(flight, solution)
    x, P = oracle.smooth()
    s = solution.smoothed
    assert s is not None
    assert np.array_equal(s.t, oracle.t)
    assert len(s) > 1000
    turned = (Rotation.from_quat(s.vector("q", "wxyz"), scalar_first=True).inv() * Rotation.concatenate([r for r, _ in x])).magnitude()
    sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert (turned / sd[:, :3].min(axis=1)).max() < 1e-8
    values, column = np.array([v for _, v in x]), 0
    for stem, axes in AXES.items():
        for a in axes:
            if f"{stem}_{a}" in s:
                assert np.abs(s[f"{stem}_{a}"] - values[:, column]).max() < 1e-8 * sd[:, 3 + column].min(), (stem, a)
                ratio = s[f"sd_{stem}_{a}"] / sd[:, 3 + column]
                assert np.abs(ratio - 1.0).max() < 0.01, (stem, a)  # linear between the nodes
                assert np.mean(np.abs(ratio - 1.0) < 1e-8) > 0.15, (stem, a)  # and exact at them
            column += 1
    if "drag_mu" in s:
        drag = np.column_stack([np.log(s["drag_mu"]), np.log(s["drag_c"]), s["drag_offset_x"], s["drag_offset_y"]])
        assert np.abs((drag - values[:, 15:19]) / sd[:, 18:22]).max() < 1e-8
        assert np.abs(s["sd_drag_mu"] / s["drag_mu"] / sd[:, 18] - 1.0).max() < 0.01
        wind = np.array([calm(*a, np.exp(u), np.exp(c)) for a, u, c in zip(values[:, 13:15], values[:, 15], values[:, 16], strict=True)])
        assert np.abs((s["wind_n"] - wind[:, 0]) / s["sd_wind_n"]).max() < 1e-8
    if "baro_bias" in s:
        assert np.abs(s["baro_bias"] - values[:, 12]).max() < 1e-8 * sd[:, 15].min()
    c = s.covariance
    rows = np.searchsorted(oracle.t, c["t"])
    for k, name in enumerate(("attitude", "velocity", "position", "gyro_bias", "accel_bias")):
        want = P[rows, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        size = np.sqrt(np.einsum("nii,njj->nij", want, want))
        assert np.abs((c[name] - want) / size).max() < 0.02, name
    assert (solution["sd_roll"] / s["sd_roll"]).max() > 1.3  # there was something to smooth


def test_assumptions_tell_the_past_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without compass and GNSS, a barometer that speaks only later: against the oracle."""
    seen: list[FloatArray] = []
    plain = drive.smoothed

    def spy(S: Any, prm: Any, rows: FloatArray, nodes: FloatArray, *rest: Any) -> Any:
        seen.append(nodes)
        return plain(S, prm, rows, nodes, *rest)

    monkeypatch.setattr(drive, "smoothed", spy)
    flight = part(demo_flight(3, 24.0), 2.0, 12.0).without("magnetometer", "gnss")
    baro = flight["barometer"]
    flight = with_stream(flight, "barometer", baro.where((baro.t < 4.0) | (baro.t > 9.0)))
    solution = run(flight, set={"delay.barometer": 0.0, "aid.fake_velocity": "on"}, smooth=True)
    s = solution.smoothed
    assert s is not None
    oracle = Oracle(flight, solution)
    x, P = oracle.smooth(seen[0])
    assert len(oracle.before_assumptions(seen[0])) > 20
    sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    turned = (Rotation.from_quat(s.vector("q", "wxyz"), scalar_first=True).inv() * Rotation.concatenate([r for r, _ in x])).magnitude()
    assert (turned / sd[:, :3].min(axis=1)).max() < 1e-6
    values, column = np.array([v for _, v in x]), 0
    for stem, axes in AXES.items():
        for a in axes:
            assert np.abs(s[f"{stem}_{a}"] - values[:, column]).max() < 1e-6 * sd[:, 3 + column].min(), (stem, a)
            ratio = s[f"sd_{stem}_{a}"] / sd[:, 3 + column]
            assert np.mean(np.abs(ratio - 1.0) < 1e-6) > 0.09, (stem, a)  # at the nodes
            column += 1
    assert (solution["sd_vel_d"] / s["sd_vel_d"]).max() > 1.05  # the barometer does tell the past


def _back(
    F: FloatArray, filtered: list[FloatArray], priors: list[FloatArray], befores: list[FloatArray | None], told: bool
) -> list[tuple[FloatArray, FloatArray]]:
    """Smoothed errors and what is stated of them, from those of the filter: after and before fusion, and before one with a mask."""
    out = [(filtered[-1], filtered[-1] @ filtered[-1].T)]
    inverse = np.linalg.inv
    for k in range(len(filtered) - 1, 0, -1):
        S, Ps = out[-1]
        plus, before = filtered[k], befores[k]
        if before is not None and not told:
            Y = inverse(Ps) - inverse(plus @ plus.T)
            Pb = inverse(inverse(before @ before.T) + Y)
            S = before - Pb @ (inverse(Ps) @ (plus - S) + Y @ (before - plus))
            Ps = Pb
        P, prior = filtered[k - 1] @ filtered[k - 1].T, priors[k] @ priors[k].T
        G = np.linalg.solve(prior, F @ P).T
        out.append((filtered[k - 1] - G @ (priors[k] - S), P + G @ (Ps - prior) @ G.T))
    return out[::-1]


def test_what_is_stated_over_masked_gains_is_true_and_smaller() -> None:
    """The law, in a linear system where every error is a known sum of independent ones: exact covariances, no draws.

    Rauch's recursion over masked gains states the truth, but it may be larger than the filter's; with the past told nothing by what was
    fused with a mask it states the truth too, and is nowhere larger.
    """
    rng = np.random.default_rng(4)
    worse = 0
    for _ in range(20):
        n, steps = 4, 12
        width = n + steps * (n + 1)
        F = np.eye(n) + 0.4 * rng.standard_normal((n, n))
        root = 0.05 * rng.standard_normal((n, n))
        Q = root @ root.T + 1e-6 * np.eye(n)
        E = np.zeros((n, width))  # true less estimate, as a sum of independent errors of variance 1
        E[:, :n] = 0.5 * rng.standard_normal((n, n)) + np.eye(n)
        filtered, priors, befores = [], [], []
        for k in range(steps):
            at = n + k * (n + 1)
            if k:
                E = F @ E
                E[:, at : at + n] += np.linalg.cholesky(Q)
            priors.append(E)
            h, r, masked = rng.standard_normal(n), 0.3, k % 3 != 2
            P = E @ E.T
            gain = P @ h / (h @ P @ h + r)
            gain[0] *= not masked
            befores.append(E if masked else None)
            E = E - np.outer(gain, h @ E)
            E[:, at + n] -= gain * np.sqrt(r)
            filtered.append(E)

        for told in (True, False):
            for (S, Ps), plus in zip(_back(F, filtered, priors, befores, told), filtered, strict=True):
                P = plus @ plus.T
                np.testing.assert_allclose(S @ S.T, Ps, atol=1e-7 * np.abs(P).max())
                excess = np.linalg.eigvalsh(Ps - P).max() / np.abs(P).max()
                if told:
                    worse += excess > 1e-3
                else:
                    assert excess < 1e-7
    assert worse > 20


def test_without_process_noise_it_carries_the_end_back() -> None:
    """Nothing turns or accelerates and nothing is noisy: the smoothed state of every row is the last one, carried back."""
    n, h = 1001, 0.01
    t = h * np.arange(n)
    quiet: dict[str, Any] = {f"noise.{k}": 1e-9 for k in ("gyro", "accel", "gyro_bias", "accel_bias", "baro_bias")}
    quiet |= {f"aid.{k}": "off" for k in ("zero_velocity", "zero_rate", "fake_position", "fake_velocity", "yaw_bank")}
    flight = demo_flight(1, 24.0)
    rest = Stream(
        {"t": t}
        | {f"gyro_{a}": np.zeros(n) for a in "xyz"}
        | {f"accel_{a}": np.full(n, v) for a, v in zip("xyz", (0, 0, -9.80665), strict=True)}
    )
    pressure = flight["barometer"]["pressure"][0]
    tb = 0.1 * np.arange(1, 100)
    baro = Stream({"t": tb, "pressure": pressure * (1.0 + 2e-5 * np.random.default_rng(1).standard_normal(len(tb)))})
    log = FlightLog({"imu": rest, "barometer": baro}, flight.meta)
    P = np.diag(np.r_[np.full(3, 1e-8), np.full(3, 1.0), np.full(3, 4.0), np.full(3, 1e-8), np.full(3, 1e-8)])
    start = InitialState(0.0, np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), P)
    # a start that is wrong by 2 m is no fault of the barometer
    solution = run(log, set=quiet | {"baro.offset": "off", "diagnosis.inertial": "off"}, initial=start, smooth=True)
    s = solution.smoothed
    assert s is not None
    assert "barometer" in solution.summary["nis"]
    fall = s["pos_d"][-1] - s["vel_d"][-1] * (t[-1] - s.t)  # constant velocity but for the residual of gravity
    g = np.polyfit(s.t, s["pos_d"], 2)
    np.testing.assert_allclose(s["pos_d"], np.polyval(g, s.t), atol=1e-5)
    assert abs(2.0 * g[0]) < 0.05
    assert np.abs(fall - s["pos_d"]).max() < 2.5
    # the variance carried back by the same motion: var p(t) = var p - 2 (T - t) cov + (T - t)² var v, a parabola
    for name in ("pos_d", "vel_d"):
        var = s[f"sd_{name}"] ** 2
        np.testing.assert_allclose(var, np.polyval(np.polyfit(s.t, var, 2), s.t), rtol=1e-3)
    assert solution["sd_pos_d"][0] > 10.0 * s["sd_pos_d"][0]


# Against truth.


def _scores(flights: int, first: int) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Mean NEES a block, and the squared errors of filter and smoother, summed over flights."""
    nees: dict[str, list[float]] = {}
    squares: dict[str, list[float]] = {}
    for k in range(flights):
        flight = demo_flight(first + k, 60.0, rest=0.0, gyro_bias_sd=0.01, accel_bias_sd=0.2)
        solution = run(flight, initial=_start(flight, np.random.default_rng([7, first + k])), smooth=True)
        assert solution.smoothed is not None
        for block, (_, value) in nees_series(solution.smoothed, flight["truth"]).items():
            nees.setdefault(block, []).append(float(value.mean()))
        for which, table in enumerate((solution.summary["errors"]["truth"], solution.summary["smoothed"]["errors"]["truth"])):
            for name, row in table.items():
                squares.setdefault(name, [0.0, 0.0])[which] += row["rms"] ** 2
    return {b: float(np.mean(v)) for b, v in nees.items()}, squares


def _judge(nees: dict[str, float], squares: dict[str, list[float]], flights: int) -> None:
    assert set(nees) == set(DOF) - {"wind"}  # nothing in these flights feels the air
    for block, value in nees.items():
        low, high = band(DOF[block], float(flights), 0.999)
        assert low < value < high, (block, value, low, high)
    assert {"roll_deg", "yaw_deg", "vel_n", "pos_d", "gyro_bias_x", "accel_bias_z"} <= set(squares)
    for name, (filtered, smoothed) in squares.items():
        assert smoothed < filtered, name


def test_nees_and_errors_of_30_flights() -> None:
    _judge(*_scores(30, 500), 30)


@pytest.mark.slow
def test_nees_and_errors_of_200_flights() -> None:
    _judge(*_scores(200, 2000), 200)


def test_the_band_catches_a_smoother_that_is_too_sure() -> None:
    values = []
    for k in range(10):
        flight = demo_flight(900 + k, 40.0, rest=0.0, gyro_bias_sd=0.01, accel_bias_sd=0.2)
        start = _start(flight, np.random.default_rng([8, k]))
        solution = run(flight, set={"noise.gyro": 4e-4, "noise.accel": 0.009}, initial=start, smooth=True)
        assert solution.smoothed is not None
        values.append(float(nees_series(solution.smoothed, flight["truth"])["velocity"][1].mean()))
    assert np.mean(values) > band(3.0, 10.0, 0.999)[1]


# What interrupts a run.


def _gap(f: FlightLog, start: float, end: float) -> FlightLog:
    imu = f["imu"]
    return with_stream(f, "imu", imu.where((imu.t < start) | (imu.t > end)))


def _outliers(f: FlightLog) -> FlightLog:
    g = f["gnss"]
    columns = {k: v.copy() for k, v in g.columns.items()}
    wild = (g.t > 15.0) & (np.arange(len(g)) % 7 == 0)
    columns["lat"][wild] += 0.01
    columns["vel_n"][wild] += 30.0
    return with_stream(f, "gnss", Stream(columns))


def _dropout(f: FlightLog) -> FlightLog:
    return with_stream(f, "gnss", f["gnss"].where((f["gnss"].t < 15.0) | (f["gnss"].t > 25.0)))


CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "as it is": (lambda f: f, {}),
    "ahrs": (lambda f: f, {"estimator": "ahrs"}),
    "a gap that is bridged": (lambda f: _gap(f, 18.0, 18.8), {}),
    "a gap that is not": (lambda f: _gap(f, 18.0, 24.0), {}),
    "GNSS away": (_dropout, {}),
    "GNSS wild": (_outliers, {}),
    "late data": (lambda f: f, {"set": {"delay.gnss": 0.2, "delay.barometer": 0.05, "delay.magnetometer": 0.02}}),
    "increments": (lambda f: f, {"set": {"imu.kind": "mean"}}),
    "three axes": (lambda f: f, {"set": {"aid.magnetometer": "3-axis"}}),
    "no offset": (lambda f: f, {"set": {"baro.offset": "off"}}),
    "yaw from GNSS": (lambda f: f.without("magnetometer"), {}),
    "no aids": (lambda f: f.without("gnss", "barometer", "magnetometer"), {}),
    "ahrs, no aids": (lambda f: f.without("gnss", "barometer", "magnetometer"), {"estimator": "ahrs"}),
    "few rows": (lambda f: f, {"rate": 20.0}),
}


@pytest.mark.parametrize("case", CASES)
def test_whatever_happens(case: str) -> None:
    change, options = CASES[case]
    flight = change(demo_flight(5, 40.0))
    plain, solution = run(flight, **options), run(flight, **options, smooth=True)
    s = solution.smoothed
    assert s is not None
    assert plain.smoothed is None
    for name, column in plain.table.items():  # smoothing changes nothing else
        assert np.array_equal(column, solution.table[name]), name
    assert plain.events == solution.events
    assert list(s.table) == list(plain.table)
    assert np.array_equal(s.t, plain.t)
    set_anew = [e["t_onset"] for e in plain.events if e["kind"] in ("reset", "timeout", "recovered") and e["t_onset"] > plain.t[0]]
    quiet = np.ones(len(s), bool)
    for t in set_anew:  # there the filter itself may raise its covariance
        quiet &= s.t > t
    for name, column in s.table.items():
        assert np.isfinite(column).all(), name
        if name.startswith("sd_"):
            assert (column > 0.0).all(), name
            if name not in ("sd_roll", "sd_pitch", "sd_yaw"):  # those depend on the attitude too
                # the gain of a heading is not the optimal one, so that the filter's covariance is not the smallest either
                assert (column[quiet] <= plain[name][quiet] * 1.001).all(), name
    np.testing.assert_allclose(np.linalg.norm(s.vector("q", "wxyz"), axis=1), 1.0, atol=1e-12)
    for name, block in s.covariance.items():
        if name != "t":
            assert np.linalg.eigvalsh(block).min() > 0.0, name
    for name in s.table if "rate" not in options else ():  # at the end of a stretch there is nothing to smooth with
        assert s[name][-1] == pytest.approx(plain[name][-1], abs=1e-9), name


def test_the_cases_are_what_they_say() -> None:
    def kinds(case: str) -> list[str]:
        change, options = CASES[case]
        return [e["kind"] for e in run(change(demo_flight(5, 40.0)), **options).events]

    assert "gap" in kinds("a gap that is bridged")
    assert "realigned" in kinds("a gap that is not")
    assert (run(_outliers(demo_flight(5, 40.0))).aids["status"] == "rejected").sum() > 10


def test_a_stretch_knows_nothing_of_the_next() -> None:
    """What comes after a gap that is not bridged changes nothing before it, to the last bit; what comes before the gap does."""
    flight = _gap(demo_flight(5, 40.0), 18.0, 24.0)
    baro = flight["barometer"]
    a, b, c = (
        run(f, smooth=True).smoothed
        for f in (
            flight,
            with_stream(flight, "barometer", baro.where(baro.t < 30.0)),
            with_stream(flight, "barometer", baro.where((baro.t < 17.0) | (baro.t > 17.5))),
        )
    )
    assert a is not None
    assert b is not None
    assert c is not None
    before = a.t < 18.0
    for name in a.table:
        assert np.array_equal(a[name][before], b[name][before]), name
    assert not np.array_equal(a["pos_d"][~before], b["pos_d"][~before])
    assert not np.array_equal(a["pos_d"][a.t < 16.0], c["pos_d"][c.t < 16.0])


def test_one_row() -> None:
    flight = demo_flight(3, 24.0)
    first = float(run(flight, scored=False).t[0])
    solution = run(part(flight, 0.0, first), smooth=True)
    assert solution.smoothed is not None
    assert len(solution) == 1
    for name, column in solution.table.items():
        np.testing.assert_allclose(solution.smoothed[name], column, rtol=1e-12, atol=1e-12)


def test_a_jump_of_the_filter_is_none_of_the_smoother() -> None:
    """After ten seconds without GNSS the filter jumps back; the smoothed position goes there without."""
    solution = run(_dropout(demo_flight(5, 40.0)), smooth=True)
    s = solution.smoothed
    assert s is not None

    def roughest(x: haltere.Solution) -> float:
        jump = np.diff(x["pos_n"]) - 0.5 * (x["vel_n"][1:] + x["vel_n"][:-1]) * np.diff(x.t)
        return float(np.abs(jump[(x.t[1:] > 14.0) & (x.t[1:] < 26.0)]).max())

    assert roughest(solution) > 20.0 * roughest(s)


def test_the_tape_of_a_quarter_of_an_hour(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes come with fusions, not with IMU samples: 15 minutes with 85 fusions a second take less than 100 MB."""
    seen: list[FloatArray] = []

    def spy(S: Any, prm: Any, rows: FloatArray, nodes: FloatArray, *rest: Any) -> Any:
        seen.append(nodes)
        return smoothed(S, prm, rows, nodes, *rest)

    smoothed = drive.smoothed
    monkeypatch.setattr(drive, "smoothed", spy)
    for rate in (250.0, 1000.0):
        run(demo_flight(3, 60.0, imu_rate=rate), smooth=True, scored=False)
    assert len(seen[0]) == pytest.approx(len(seen[1]), rel=0.02)
    assert 15 * seen[0].nbytes < 100e6
    assert np.diff(seen[0][:, 0]).max() < 0.06


def test_smoothed_attitude_alone_is_better_in_every_block() -> None:
    """`ahrs` on six missions and a made path: tilt, heading and gyro bias, two flights of each."""
    squares: dict[str, list[FloatArray]] = {}
    for mission in ("hover", "climb", "box", "figure-eight", "lissajous", "tour", "path"):
        for seed in (1, 2):
            if mission == "path":
                flight = demo_flight(seed, 90.0, imu_rate=100.0)
            else:
                flight = haltere.simulate(
                    haltere.Scenario(
                        vehicle="hummingbird", mission=mission, duration=90.0, seed=seed, wind={"n": 3.0, "gust": 1.0},
                        sensors={"imu": {"rate": 100.0}},
                    )
                )  # fmt: skip
            solution = run(flight, "ahrs", smooth=True)
            assert solution.smoothed is not None
            both = []
            for s in (solution, solution.smoothed):
                e = {k: float(np.mean(error_series(s, flight["truth"])[k][1] ** 2)) for k in ("roll", "pitch", "yaw")}
                truth = flight["truth"]
                bias = sum(np.mean((s[f"gyro_bias_{a}"] - np.interp(s.t, truth.t, truth[f"gyro_bias_{a}"])) ** 2) for a in "xyz")
                both.append([e["roll"] + e["pitch"], e["yaw"], float(bias)])
            squares.setdefault(mission, []).append(np.array(both))
    for mission, found in squares.items():
        filtered, smoothed = np.mean(found, axis=0)
        assert (smoothed < filtered).all(), (mission, filtered, smoothed)
