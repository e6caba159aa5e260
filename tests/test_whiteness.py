"""Whiteness of innovations and the moving NIS against closed forms: rates of the test, known processes, missing places, bands."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from haltere.flight.config import Config, defaults
from haltere.flight.solution import Solution
from haltere.metrics.consistency import WINDOW, band, nis_series
from haltere.metrics.whiteness import LEAST, autocorrelation, whiteness, whiteness_series, whiteness_table

EVERY = np.ones(100_000, bool)


def judged(z: np.ndarray[Any, Any], used: np.ndarray[Any, Any] | None = None, t: np.ndarray[Any, Any] | None = None) -> Any:
    t = np.arange(len(z)) * 0.1 if t is None else t
    return whiteness(t, z, EVERY[: len(z)] if used is None else used)


def ar1(rng: np.random.Generator, rho: float, n: int) -> np.ndarray[Any, Any]:
    e = rng.standard_normal(n) * np.sqrt(1.0 - rho**2)
    z = np.empty(n)
    z[0] = rng.standard_normal()
    for i in range(1, n):
        z[i] = rho * z[i - 1] + e[i]
    return z


# --- whiteness -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "missing"), [(60, 0.0), (300, 0.0), (300, 0.25)])
def test_white_noise_is_called_white_at_the_stated_rate(n: int, missing: float) -> None:
    rng = np.random.default_rng(5)
    runs = 800
    p = np.empty(runs)
    for k in range(runs):
        p[k] = judged(rng.standard_normal(n), rng.random(n) >= missing).p
    for risk in (0.05, 0.2, 0.5):
        low, high = stats.binom.ppf([1e-4, 1.0 - 1e-4], runs, risk) / runs
        # The chi-square limit is a limit: short series are allowed one part in five of the rate beside chance.
        assert 0.8 * low < np.mean(p < risk) < 1.2 * high, risk


def test_single_lags_keep_their_band() -> None:
    rng = np.random.default_rng(6)
    outside = [np.mean(np.abs(w.r) > w.band) for w in (judged(rng.standard_normal(400)) for _ in range(300))]
    assert np.mean(outside) == pytest.approx(0.05, abs=0.006)


def test_statistic_is_the_textbook_one_where_nothing_is_missing() -> None:
    z = ar1(np.random.default_rng(2), 0.2, 500)
    w = judged(z)
    r = np.array([np.sum(z[:-k] * z[k:]) / np.sum(z * z) for k in range(1, 41)])
    q = 500 * 502 * np.sum(r**2 / (500 - np.arange(1, 41)))
    assert w.statistic == pytest.approx(q, rel=1e-12)
    assert w.p == pytest.approx(stats.chi2.sf(q, 40), rel=1e-9)
    assert w.n == 500
    assert w.band[0] == pytest.approx(1.959964 / np.sqrt(499))


@pytest.mark.parametrize("rho", [-0.6, 0.3, 0.9])
def test_a_first_order_process_shows_its_correlation(rho: float) -> None:
    w = judged(ar1(np.random.default_rng(3), rho, 20_000))
    for lag in (1, 2, 3):
        assert w.r[lag - 1] == pytest.approx(rho**lag, abs=0.03)
    assert w.p < 1e-6
    assert w.verdict == "correlated"
    # first lag at which 0.9^k is below 1/e is 10
    assert w.lasting == pytest.approx(1.0 if rho == 0.9 else 0.1, abs=0.11 if rho == 0.9 else 1e-9)


def test_a_bias_is_no_whiteness() -> None:
    w = judged(1.0 + np.random.default_rng(4).standard_normal(2000))
    assert w.r[0] == pytest.approx(0.5, abs=0.05)
    assert w.verdict == "correlated"


def test_significant_but_small_is_told_apart() -> None:
    w = judged(ar1(np.random.default_rng(8), 0.08, 20_000))
    assert w.p < 0.01
    assert w.verdict == "nearly white"


def test_refused_samples_keep_their_places() -> None:
    z = np.tile([1.0, -1.0], 200)
    used = np.random.default_rng(1).random(400) > 0.3
    w = judged(z, used)
    assert np.allclose(w.r[:4], [-1.0, 1.0, -1.0, 1.0])
    packed = autocorrelation(z[used], 1)[0]
    assert packed[0] > -0.7, "without their places the pairs are of other samples"


def test_gaps_are_no_neighbours_and_order_does_not_matter() -> None:
    rng = np.random.default_rng(9)
    z = np.tile([1.0, -1.0], 200)
    t = np.arange(400) * 0.1 + rng.uniform(-0.01, 0.01, 400)
    t[150:] += 0.1  # one place is empty
    t[300:] += 100.0  # further than any lag
    w = judged(z, t=t)
    assert np.all(np.abs(w.r) <= 1.0)
    # after the empty place the signs are turned: of the pairs at lag 2 only the one across it disagrees
    assert w.r[1] == pytest.approx(1.0 - 2.0 / (397 - 2), abs=0.01)
    order = rng.permutation(400)
    shuffled = whiteness(t[order], z[order], EVERY[:400])
    assert shuffled is not None
    assert np.array_equal(shuffled.r, w.r)


def test_too_little_gives_nothing() -> None:
    rng = np.random.default_rng(1)
    assert judged(rng.standard_normal(LEAST - 1)) is None
    assert judged(rng.standard_normal(LEAST)) is not None
    assert judged(np.zeros(100)) is None
    assert judged(np.full(100, np.nan)) is None
    assert judged(rng.standard_normal(0)) is None
    assert np.isnan(autocorrelation(np.array([1.0]), 3)[0]).all()


def test_repeated_times_do_no_harm() -> None:
    assert judged(np.random.default_rng(1).standard_normal(100), t=np.zeros(100)) is not None


# --- records of a run ----------------------------------------------------------------------------------------------------


def solution_of(records: list[tuple[float, str, str, float, str, str]]) -> Solution:
    """A solution with nothing but aid records: t, sensor, component, normalised innovation, status, reason; its 1 sigma is 2."""
    columns = list(zip(*records, strict=True))
    z = np.array(columns[3])
    aids: dict[str, Any] = {
        "t": np.array(columns[0]), "sensor": np.array(columns[1]), "component": np.array(columns[2]), "innovation": 2.0 * z,
        "innovation_sd": np.full(len(z), 2.0), "status": np.array(columns[4]), "reason": np.array(columns[5]),
    }  # fmt: skip
    table = {"t": np.arange(2.0)} | {f"q_{a}": np.full(2, float(a == "w")) for a in "wxyz"}
    return Solution(table, aids, [], Config("navigator", "default", defaults()))


def made(n: int, components: tuple[str, ...] = ("vel_n", "vel_e", "vel_d"), seed: int = 0, sensor: str = "gnss") -> list[Any]:
    rng = np.random.default_rng(seed)
    return [(0.1 * k, sensor, c, float(rng.standard_normal()), "fused", "") for k in range(n) for c in components]


def test_series_names_what_was_measured() -> None:
    records = made(100) + made(100, ("altitude",), 1, "barometer") + made(100, ("vel_n",), 2, "zero_velocity")
    records += made(20, ("heading",), 3, "magnetometer")
    records = [(*r[:4], "deweighted" if 30 <= i < 36 else "rejected" if 36 <= i < 42 else r[4], r[5]) for i, r in enumerate(records)]
    records.append((0.05, "gnss", "vel_n", 1e6, "fused", "start"))
    found = whiteness_series(solution_of(records))
    assert {s: set(v) for s, v in found.items()} == {"gnss": {"vel_n", "vel_e", "vel_d"}, "barometer": {"altitude"}}
    assert found["gnss"]["vel_n"].n == 98, "two refused, and the start is no test"
    assert found["gnss"]["vel_n"].deweighted == 2
    table = whiteness_table(found)
    row = table["gnss"]["vel_e"]
    assert set(row) >= {"lag1", "n", "statistic", "p", "verdict"}
    assert row["verdict"] == "white"
    assert whiteness_series(solution_of([(0.0, "gnss", "vel_n", 1.0, "fused", "")])) == {}


# --- NIS and its bands ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dof", "n"), [(1, 1), (3, 1), (3, 25), (1, 5000)])
@pytest.mark.parametrize("probability", [0.95, 0.999])
def test_band_is_that_of_chi_square(dof: int, n: int, probability: float) -> None:
    tail = 0.5 * (1.0 - probability)
    expected = stats.chi2.ppf([tail, 1.0 - tail], dof * n) / (dof * n)
    assert band(dof, n, probability) == pytest.approx(tuple(expected), rel=1e-9)


def test_moving_nis_is_the_mean_of_squares() -> None:
    records = made(60)
    series = nis_series(solution_of(records))
    ((key, found),) = series.items()
    assert key == ("gnss", "vel")
    z = np.array([r[3] for r in records]).reshape(60, 3)
    assert len(found.mean) == 60 - WINDOW + 1
    assert found.mean[7] == pytest.approx(np.mean(z[7 : 7 + WINDOW] ** 2))
    assert found.t[7] == pytest.approx(np.mean(0.1 * np.arange(7, 7 + WINDOW)))
    assert (found.low[0], found.high[0]) == pytest.approx(band(1.0, 3 * WINDOW))


def test_moving_nis_leaves_its_band_as_often_as_stated() -> None:
    records = made(25 * 4000, ("altitude",), 5, "barometer")
    found = nis_series(solution_of(records))["barometer", "altitude"]
    apart = slice(None, None, WINDOW)  # means that share no sample
    outside = np.mean((found.mean[apart] < found.low[apart]) | (found.mean[apart] > found.high[apart]))
    assert outside == pytest.approx(0.05, abs=0.012)


def test_moving_nis_follows_what_was_fused() -> None:
    records = made(80)
    records = [(*r[:4], "rejected" if i < 90 else "fused", "") for i, r in enumerate(records)]
    found = nis_series(solution_of(records))["gnss", "vel"]
    assert len(found.t) == 50 - WINDOW + 1
    lost = [r for r in made(60) if not (r[2] == "vel_d" and r[0] < 1.0)]
    bands = nis_series(solution_of(lost))["gnss", "vel"]
    assert bands.high[0] > bands.high[-1], "fewer components, a wider band"
    assert nis_series(solution_of(made(WINDOW - 1))) == {}
    assert nis_series(solution_of(made(60, ("vel_n",), 1, "zero_velocity"))) == {}
