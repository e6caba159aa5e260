"""Metrics in closed form: errors that were put in come out, and drawn ones lie in their bands."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2

from haltere.drive import _decimate, _euler_sd
from haltere.flight.config import resolve
from haltere.flight.local import geodetic_from_local
from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution
from haltere.metrics.attitude import conjugate, euler, multiply, rotation_vector, slerp
from haltere.metrics.consistency import band, nees_series, nees_table, nis_table
from haltere.metrics.errors import error_series, error_table, reference_position
from haltere.metrics.summary import finite, gaps_of, summarise

FloatArray = NDArray[np.float64]
DEG = math.pi / 180.0
ORIGIN = [46.8, 8.2, 600.0]
law = settings(deadline=None, max_examples=100)


def scalar_first(r: Rotation) -> FloatArray:
    return np.asarray(r.as_quat()[..., [3, 0, 1, 2]])


def scipy_of(q: FloatArray) -> Rotation:
    return Rotation.from_quat(np.asarray(q)[..., [1, 2, 3, 0]])


# Attitude on columns


def test_products_are_those_of_rotations() -> None:
    rng = np.random.default_rng(1)
    a, b = Rotation.random(200, random_state=rng), Rotation.random(200, random_state=rng)
    product = multiply(scalar_first(a), scalar_first(b))
    assert (scipy_of(product).inv() * (a * b)).magnitude().max() < 1e-14
    np.testing.assert_allclose(multiply(scalar_first(a), conjugate(scalar_first(a))), np.tile([1.0, 0, 0, 0], (200, 1)), atol=1e-15)
    one = multiply(scalar_first(a[0]), scalar_first(b))  # one with many
    np.testing.assert_allclose(one, np.array([multiply(scalar_first(a[0]), q) for q in scalar_first(b)]), atol=1e-15)
    np.testing.assert_allclose(euler(scalar_first(a)), a.as_euler("ZYX")[:, ::-1], atol=1e-7)


@law
@given(st.floats(0.0, math.pi), st.integers(0, 10**6), st.booleans())
def test_rotation_vector_is_the_shorter_way(angle: float, seed: int, other_sign: bool) -> None:
    axis = np.random.default_rng(seed).standard_normal(3)
    r = angle * axis / np.linalg.norm(axis)
    q = scalar_first(Rotation.from_rotvec(r))
    got = rotation_vector(-q[None] if other_sign else q[None])[0]
    if angle > math.pi - 1e-9:  # either way is as short
        assert np.abs(np.abs(got) - np.abs(r)).max() < 1e-8
    else:
        np.testing.assert_allclose(got, r, rtol=0.0, atol=1e-15 + 4e-15 * angle)


def test_rotation_vector_of_nothing_and_next_to_it() -> None:
    q = np.array([[1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [1.0, 1e-13, 0.0, 0.0], [1.0, 0.0, 1e-200, 0.0], [1.0, 0.0, 2e-12, 0.0]])
    expected = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2e-13, 0.0, 0.0], [0.0, 2e-200, 0.0], [0.0, 4e-12, 0.0]]
    np.testing.assert_allclose(rotation_vector(q), expected, rtol=1e-12, atol=0.0)


def test_slerp_is_that_of_scipy() -> None:
    """Also where neighbours differ in sign, on the knots, and when they are the same; outside the ends it stays there."""
    rng = np.random.default_rng(2)
    tq = np.cumsum(rng.uniform(0.1, 1.0, 30))
    rotations = Rotation.concatenate([Rotation.random(29, random_state=rng), Rotation.identity()])
    q = scalar_first(rotations)
    q[5] = q[4]
    q *= np.where(rng.random(30) < 0.5, -1.0, 1.0)[:, None]
    t = np.r_[rng.uniform(tq[0], tq[-1], 500), tq]
    expected = Slerp(tq, scipy_of(q))(t)
    got = slerp(t, tq, q)
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), 1.0, atol=1e-14)
    assert (scipy_of(got).inv() * expected).magnitude().max() < 1e-13
    ends = slerp(np.array([tq[0] - 1.0, tq[-1] + 5.0]), tq, q)
    assert (scipy_of(ends).inv() * scipy_of(q[[0, -1]])).magnitude().max() < 1e-14


# A solution with known errors

OFFSET_V, OFFSET_P = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, -3.0])
TURN = np.array([0.01, -0.02, 0.015])


def truth_at(t: FloatArray) -> dict[str, FloatArray]:
    """Constant turn, constant acceleration: what interpolation between samples reproduces (attitude exactly, velocity exactly)."""
    q = scalar_first(Rotation.from_euler("ZYX", [3.0, 0.2, -0.1]) * Rotation.from_rotvec(np.outer(t, [0.02, -0.01, 0.3])))
    v = np.array([1.0, 2.0, -0.5]) + np.outer(t, [0.3, -0.2, 0.1])
    p = np.array([5.0, -4.0, -30.0]) + np.outer(t, [2.0, 1.0, -0.5])
    return {f"q_{a}": q[:, k] for k, a in enumerate("wxyz")} | {f"vel_{a}": v[:, k] for k, a in enumerate("ned")} | {
        f"pos_{a}": p[:, k] for k, a in enumerate("ned")
    }  # fmt: skip


def solution_of(t: FloatArray, turn: FloatArray, dv: FloatArray, dp: FloatArray) -> Solution:
    """A solution that is off by these: q_true = q ⊗ exp(turn), the rest true plus d."""
    x = truth_at(t)
    q = scipy_of(np.column_stack([x[f"q_{a}"] for a in "wxyz"])) * Rotation.from_rotvec(-np.atleast_2d(turn))
    table: dict[str, FloatArray] = {"t": t} | {f"q_{a}": scalar_first(q)[:, k] for k, a in enumerate("wxyz")}
    table |= {f"vel_{a}": x[f"vel_{a}"] + np.atleast_2d(dv)[:, k] for k, a in enumerate("ned")}
    table |= {f"pos_{a}": x[f"pos_{a}"] + np.atleast_2d(dp)[:, k] for k, a in enumerate("ned")}
    return Solution(table, {}, [], resolve(), {"origin": ORIGIN})


T = np.arange(0.0, 20.0, 0.1)
T_REF = np.arange(-1.0, 21.0, 0.37)


def test_constant_errors_come_out_as_they_were_put_in() -> None:
    series = error_series(solution_of(T, TURN, OFFSET_V, OFFSET_P), Stream({"t": T_REF, **truth_at(T_REF)}))
    inside = T_REF[(T_REF >= 0.0) & (T[-1] >= T_REF)]
    for k, a in enumerate("ned"):
        np.testing.assert_allclose(series[f"vel_{a}"][1], OFFSET_V[k], atol=1e-12)
        np.testing.assert_allclose(series[f"pos_{a}"][1], OFFSET_P[k], atol=1e-12)
    for t, _ in series.values():
        np.testing.assert_array_equal(t, inside)  # nothing beyond the ends of the solution
    np.testing.assert_allclose(series["attitude"][1], np.linalg.norm(TURN), atol=1e-12)
    # yaw passes through 180 degrees: its error does not
    assert np.abs(series["yaw"][1]).max() < 0.05
    table = error_table(series)
    assert table["attitude_deg"]["rms"] == pytest.approx(np.linalg.norm(TURN) / DEG, rel=1e-9)
    assert table["pos_e"] == {"rms": pytest.approx(2.0), "max": pytest.approx(2.0), "n": len(inside)}
    assert table["vel_d"]["max"] == pytest.approx(0.3)


def test_error_of_yaw_alone_is_an_error_of_yaw_alone() -> None:
    """A turn about the vertical in n: the solution's yaw is larger by it (solution minus reference), roll and pitch are right."""
    solution = solution_of(T, np.zeros(3), OFFSET_V, OFFSET_P)
    q = Rotation.from_rotvec([0.0, 0.0, 0.25]) * scipy_of(solution.vector("q", "wxyz"))
    for k, a in enumerate("wxyz"):
        solution.table[f"q_{a}"] = scalar_first(q)[:, k]
    series = error_series(solution, Stream({"t": T_REF, **truth_at(T_REF)}))
    np.testing.assert_allclose(series["yaw"][1], 0.25, atol=1e-12)
    np.testing.assert_allclose(series["roll"][1], 0.0, atol=1e-12)
    np.testing.assert_allclose(series["pitch"][1], 0.0, atol=1e-12)


def test_rms_and_largest() -> None:
    e = np.array([3.0, -4.0, 0.0, 0.0])
    table = error_table({"vel_n": (np.arange(4.0), e), "yaw": (np.arange(4.0), e * DEG)})
    assert table["vel_n"] == {"rms": 2.5, "max": 4.0, "n": 4}
    assert table["yaw_deg"] == {"rms": pytest.approx(2.5), "max": pytest.approx(4.0), "n": 4}


def test_errors_stop_at_gaps_and_holes() -> None:
    """Where the solution has no rows for more than half a second nothing is compared, nor where the reference knows nothing."""
    rows = T[(T < 5.0) | (T > 8.0)]
    reference = Stream({"t": T_REF, **truth_at(T_REF)})
    reference.columns["vel_n"][10:20] = np.nan
    reference.columns["q_x"][30:33] = np.nan
    series = error_series(solution_of(rows, TURN, OFFSET_V, OFFSET_P), reference)
    for t, e in series.values():
        assert not ((t > 4.9) & (t < 8.1)).any()
        assert np.isfinite(e).all()
    assert len(series["vel_n"][0]) == len(series["vel_e"][0]) - np.count_nonzero((T_REF[10:20] <= 4.9) | (T_REF[10:20] >= 8.1))
    assert not np.isin(T_REF[30:33], series["yaw"][0]).any()
    assert error_series(solution_of(T, TURN, OFFSET_V, OFFSET_P), Stream({"t": T_REF})) == {}
    assert error_series(solution_of(T[:1], TURN, OFFSET_V, OFFSET_P), reference) == {}


def test_positions_with_another_origin_are_compared_geodetically() -> None:
    """A reference whose pos_* hang on an origin 100 m away, but which knows latitude and longitude."""
    x = truth_at(T_REF)
    p = np.column_stack([x[f"pos_{a}"] for a in "ned"])
    lat, lon, alt = geodetic_from_local(p[:, 0], p[:, 1], p[:, 2], *ORIGIN)
    x["pos_n"] = x["pos_n"] + 100.0
    reference = Stream({"t": T_REF, **x, "lat": lat, "lon": lon, "alt": alt})
    series = error_series(solution_of(T, TURN, OFFSET_V, OFFSET_P), reference)
    for k, a in enumerate("ned"):
        np.testing.assert_allclose(series[f"pos_{a}"][1], OFFSET_P[k], atol=1e-6)
    t, got = reference_position(Stream({"t": T_REF, **x, "lat": lat, "lon": lon}), ORIGIN)
    np.testing.assert_allclose(got, p, atol=1e-6)  # without altitude: down is the reference's own
    np.testing.assert_array_equal(t, T_REF)
    _, got = reference_position(Stream({"t": T_REF, **x}), None)
    np.testing.assert_array_equal(got[:, 0], x["pos_n"])


# Consistency


def test_band_is_that_of_the_mean() -> None:
    """Against draws: 95 % of means of n values of χ²(3)/3 lie inside, within four sigma of 4000 trials (0.0138)."""
    rng = np.random.default_rng(3)
    for n in (1, 10, 200):
        low, high = band(3, n)
        means = rng.chisquare(3, (4000, n)).mean(axis=1) / 3.0
        assert ((means > low) & (means < high)).mean() == pytest.approx(0.95, abs=0.0138)
        assert (means < low).mean() == pytest.approx(0.025, abs=0.01)
    assert band(2, 50, 0.999)[1] == pytest.approx(chi2.ppf(0.9995, 100) / 100)
    assert band(3, 1)[0] < 0.1 < 1.0 < 3.0 < band(3, 1)[1]


def covariances(rng: np.random.Generator, n: int, scale: float) -> FloatArray:
    a = rng.standard_normal((n, 3, 3))
    return scale**2 * (a @ a.transpose(0, 2, 1) / 3.0 + 0.2 * np.eye(3))


def test_nees_of_drawn_errors_is_one() -> None:
    """2000 independent errors from the very covariances that are reported: means inside the 99.9 % band; twice as large: four."""
    rng = np.random.default_rng(4)
    n = 2000
    t = np.arange(n, dtype=float)
    P = {"attitude": covariances(rng, n, 0.003), "velocity": covariances(rng, n, 0.3), "position": covariances(rng, n, 2.0)}
    P["gyro_bias"], P["accel_bias"] = covariances(rng, n, 0.01), covariances(rng, n, 0.1)
    e = {k: np.einsum("nij,nj->ni", np.linalg.cholesky(c), rng.standard_normal((n, 3))) for k, c in P.items()}
    solution = solution_of(t, e["attitude"], -e["velocity"], -e["position"])
    truth = truth_at(t)
    for k, a in enumerate("xyz"):
        truth[f"gyro_bias_{a}"], truth[f"accel_bias_{a}"] = 0.01 + e["gyro_bias"][:, k], -0.2 + e["accel_bias"][:, k]
        solution.table[f"gyro_bias_{a}"], solution.table[f"accel_bias_{a}"] = np.full(n, 0.01), np.full(n, -0.2)
    b = rng.standard_normal(n) * 1.5
    truth["baro_bias"], solution.table["baro_bias"] = 4.0 + b, np.full(n, 4.0)
    P["baro_bias"] = np.full((n, 1, 1), 2.25)
    solution.covariance = {"t": t, **P}
    series = nees_series(solution, Stream({"t": t, **truth}))
    assert set(series) == set(P)
    for block, (times, nees) in series.items():
        dof = 1 if block == "baro_bias" else 3
        low, high = band(dof, n, 0.999)
        np.testing.assert_array_equal(times, t)
        assert low < nees.mean() < high, block
    np.testing.assert_allclose(
        series["velocity"][1], np.einsum("ni,nij,nj->n", e["velocity"], np.linalg.inv(P["velocity"]), e["velocity"]) / 3.0
    )
    table = nees_table(series)
    assert table["attitude"]["mean"] == pytest.approx(series["attitude"][1].mean())
    assert table["attitude"]["band"] == list(band(3, 1.0))
    solution.covariance = {"t": t, **{k: c / 4.0 for k, c in P.items()}}
    assert nees_series(solution, Stream({"t": t, **truth}))["position"][1].mean() == pytest.approx(4.0 * series["position"][1].mean())


def test_nees_leaves_out_what_truth_does_not_know() -> None:
    solution = solution_of(T, TURN, OFFSET_V, OFFSET_P)
    eye = np.tile(np.eye(3), (len(T), 1, 1))
    solution.covariance = {"t": T, "attitude": eye, "velocity": eye, "position": eye, "gyro_bias": eye, "accel_bias": eye}
    x = truth_at(T_REF)
    for a in "ned":
        del x[f"vel_{a}"]
    series = nees_series(solution, Stream({"t": T_REF, **x}))
    assert set(series) == {"attitude", "position"}
    np.testing.assert_allclose(series["attitude"][1], TURN @ TURN / 3.0, atol=1e-12)
    np.testing.assert_allclose(series["position"][1], OFFSET_P @ OFFSET_P / 3.0, atol=1e-10)
    assert nees_series(solution, Stream({"t": T_REF + 1000.0, **x})) == {}


def test_nis_of_drawn_innovations_is_one() -> None:
    """By sensor, over what was fused; start values do not count, those refused or let in by force count as such only."""
    rng = np.random.default_rng(5)
    n = 3000
    sd = rng.uniform(0.1, 3.0, n)
    aids: dict[str, Any] = {
        "sensor": np.where(np.arange(n) % 3 == 0, "gnss", "barometer"),
        "innovation": sd * rng.standard_normal(n),
        "innovation_sd": sd,
        "status": np.array(["fused"] * n, dtype=object).astype(str),
        "reason": np.array([""] * n).astype("<U12"),
        "weight": np.ones(n),
    }
    aids["status"] = aids["status"].astype("<U12")
    baro = np.flatnonzero(aids["sensor"] == "barometer")
    aids["status"][baro[:40]], aids["innovation"][baro[:40]] = "rejected", 1e6
    aids["status"][baro[40:70]], aids["innovation"][baro[40:70]], aids["reason"][baro[40:70]] = "deweighted", 1e6, "timeout"
    aids["status"][baro[80:90]] = "deweighted"  # with less weight, but for no fault of its innovation
    aids["weight"][baro[:40]], aids["weight"][baro[80:90]] = 0.0, 0.5
    aids["reason"][baro[70:80]], aids["innovation"][baro[70:80]] = "start", 1e6
    solution = Solution({"t": T}, aids, [], resolve())
    table = nis_table(solution)
    assert set(table) == {"gnss", "barometer"}
    for sensor, m in (("gnss", 1000), ("barometer", 1920)):
        low, high = band(1, m, 0.999)
        assert low < table[sensor]["mean"] < high
        assert table[sensor]["band"] == list(band(1, m))
    assert [table["barometer"][k] for k in ("n", "rejected", "deweighted")] == [1990, 40, 40]
    assert table["barometer"]["lost"] == pytest.approx(45.0 / 1990.0)
    assert [table["gnss"][k] for k in ("n", "rejected", "deweighted")] == [1000, 0, 0]
    aids["status"][:] = "rejected"
    assert nis_table(solution)["gnss"]["mean"] is None
    assert nis_table(Solution({"t": T}, {k: v[:0] for k, v in aids.items()}, [], resolve())) == {}


# Euler angles' standard deviations


@pytest.mark.parametrize(("roll", "pitch", "yaw"), [(0.0, 0.0, 0.0), (0.4, -0.7, 2.0), (-2.5, 1.1, -1.0), (0.2, 1.35, 0.5)])
def test_euler_sd_against_draws(roll: float, pitch: float, yaw: float) -> None:
    """100 000 body-frame errors of 1e-4 rad: 1 % is more than four sigma of an estimated standard deviation (0.22 %)."""
    rng = np.random.default_rng(6)
    P = covariances(rng, 1, 1e-4)[0]
    e = rng.multivariate_normal(np.zeros(3), P, 100_000)
    base = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    angles = (base * Rotation.from_rotvec(e)).as_euler("ZYX")[:, ::-1] - [roll, pitch, yaw]
    drawn = np.std((angles + math.pi) % (2.0 * math.pi) - math.pi, axis=0)
    upper = P[np.triu_indices(3)][:, None]
    got = _euler_sd(scalar_first(base)[:, None], upper)
    np.testing.assert_allclose([x[0] for x in got], drawn, rtol=0.01)


def test_euler_sd_is_bounded_where_first_order_ends() -> None:
    """At the pole, where roll and yaw are one, they are as unknown as an angle can be; pitch is not."""
    q = scalar_first(Rotation.from_euler("ZYX", [0.3, math.pi / 2.0, 0.2]))[:, None]
    roll, pitch, yaw = _euler_sd(q, 1e-2 * np.eye(3)[np.triu_indices(3)][:, None])
    assert np.isfinite([roll[0], pitch[0], yaw[0]]).all()
    assert roll[0] == yaw[0] == math.pi
    assert pitch[0] <= 0.11
    level = _euler_sd(np.array([[1.0], [0.0], [0.0], [0.0]]), np.array([[1e4], [0.0], [0.0], [4.0], [0.0], [0.25]]))
    assert [float(x[0]) for x in level] == [math.pi, 2.0, 0.5]


# The rest


def test_decimation_keeps_the_first_row_of_each_interval() -> None:
    t = 5.0 + 0.004 * np.arange(1001)
    kept = t[_decimate(t, 10.0)]
    np.testing.assert_allclose(kept, 5.0 + 0.1 * np.arange(41), atol=0.004)
    assert kept[0] == t[0]
    assert _decimate(t, 1000.0).all()
    assert np.count_nonzero(_decimate(t, 1e-3)) == 1


def test_gaps() -> None:
    t = np.arange(0.0, 10.0, 0.01)
    assert gaps_of(t) == 0
    assert gaps_of(t[(t < 3.0) | (t > 3.05)]) == 0  # shorter than a tenth of a second
    assert gaps_of(t[(t < 3.0) | (t > 3.2)]) == 1
    assert gaps_of(np.arange(0.0, 10.0, 1.0)) == 0  # slow is not a gap
    assert gaps_of(np.array([0.0, 1.0, 2.0, 7.0, 8.0, 9.0, 15.0])) == 2
    assert gaps_of(np.array([0.0, 5.0])) == 0
    assert gaps_of(np.array([0.0, np.nan, 1.0, 2.0])) == 0


def test_numbers_that_json_cannot_hold_become_null() -> None:
    assert finite({"a": [1.0, math.nan, (math.inf, 2)], "b": {"c": -math.inf, "d": "x"}}) == {
        "a": [1.0, None, [None, 2]],
        "b": {"c": None, "d": "x"},
    }


@pytest.mark.parametrize(
    ("bad", "forced", "verdict"), [(0.0, False, "good"), (0.05, False, "doubtful"), (0.3, False, "bad"), (0.0, True, "bad")]
)
def test_health_is_read_off_the_innovations(bad: float, forced: bool, verdict: str) -> None:
    n = 1000
    status = np.where(np.arange(n) < bad * n, "rejected", "fused")
    aids = {"sensor": np.full(n, "gnss"), "innovation": np.ones(n), "innovation_sd": np.ones(n), "status": status, "reason": np.full(n, "")}
    aids |= {"t": 0.02 * np.arange(n), "component": np.full(n, "vel_n"), "weight": np.where(status == "fused", 1.0, 0.0)}
    events = [{"kind": "timeout", "sensor": "gnss"}] if forced else []
    solution = solution_of(T, TURN, OFFSET_V, OFFSET_P)
    solution.aids, solution.events = aids, events
    flight = FlightLog({"imu": {"t": T}, "gnss": {"t": T}, "truth": {"t": T_REF, **truth_at(T_REF)}})
    facts = {"origin": ORIGIN, "duration": 20.0, "discarded": {"gnss": {"no 3-D fix": 3}}, "warnings": ["one"], "timings": {}}
    summarise(solution, flight, facts)
    assert solution.summary["health"]["gnss"]["verdict"] == verdict
    assert solution.summary["streams"]["gnss"]["discarded"] == {"no 3-D fix": 3}
    imu = solution.summary["streams"]["imu"]
    assert (imu["n"], imu["gaps"], imu["discarded"]) == (200, 0, {})
    assert (imu["rate"], imu["mean_rate"]) == pytest.approx((10.0, 10.0))
    assert imu["longest_gap"] == pytest.approx(0.1)
    assert solution.summary["errors"]["truth"]["pos_n"]["rms"] == pytest.approx(1.0)
    assert "onboard" not in solution.summary["errors"]
    assert solution.summary["warnings"] == ["one"]
