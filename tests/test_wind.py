"""What is said of a wind: speed and direction with their uncertainty, rose, profile, means, differences, the verdict."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haltere.flight.config import Config, defaults
from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution
from haltere.metrics.consistency import band, nees_series
from haltere.metrics.wind import (
    BLOCK,
    SECTORS,
    WindSeries,
    blocks,
    difference,
    direction_from,
    direction_sd,
    in_flight,
    profile,
    rose,
    speed_sd,
    turbulence,
    wind_series,
)
from haltere.metrics.wind_quality import WORDS, quality, wind_table
from wind_made import flown, with_wind

Array = np.ndarray
winds = st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0), st.floats(0.05, 3.0), st.floats(0.05, 3.0))


def one(*values: float) -> list[Array]:
    return [np.array([v]) for v in values]


def series(wind: Array, sd: float = 0.3, dt: float = 0.5, height: Array | None = None, flying: Array | None = None) -> WindSeries:
    """A series of given components with a constant 1 sigma."""
    n = len(wind)
    s = np.full(n, sd)
    up = np.ones(n, bool) if flying is None else flying
    north, east = wind.T
    known = direction_sd(north, east, s, s)
    return WindSeries(
        dt * np.arange(n), wind, np.column_stack([s, s]), np.hypot(north, east), speed_sd(north, east, s, s),
        np.where(np.isfinite(known), direction_from(north, east), np.nan), known, up, np.ones(n, bool),
        np.full(n, np.nan) if height is None else height,
    )  # fmt: skip


# --- speed and direction -------------------------------------------------------------------------------------------------


def test_direction_is_where_it_comes_from() -> None:
    for north, east, azimuth in ((-1.0, 0.0, 0.0), (0.0, -1.0, 90.0), (1.0, 0.0, 180.0), (0.0, 1.0, 270.0), (-1.0, 1e-12, 360.0)):
        assert np.degrees(direction_from(*one(north, east))[0]) == pytest.approx(azimuth, abs=1e-6)


@settings(deadline=None)
@given(winds)
def test_first_order_uncertainty_against_finite_differences(w: tuple[float, float, float, float]) -> None:
    north, east, sd_n, sd_e = w
    speed = math.hypot(north, east)
    if speed < 1.5 * math.hypot(sd_n, sd_e):
        return
    h = 1e-6
    slopes = [((math.hypot(north + a * h, east + b * h) - math.hypot(north - a * h, east - b * h)) / (2 * h)) for a, b in ((1, 0), (0, 1))]
    assert speed_sd(*one(*w))[0] == pytest.approx(math.hypot(slopes[0] * sd_n, slopes[1] * sd_e), rel=1e-5)

    def turn(a: float, b: float) -> float:
        e = direction_from(*one(north + a * h, east + b * h))[0] - direction_from(*one(north - a * h, east - b * h))[0]
        return float((e + math.pi) % (2 * math.pi) - math.pi) / (2 * h)

    assert direction_sd(*one(*w))[0] == pytest.approx(math.hypot(turn(1, 0) * sd_n, turn(0, 1) * sd_e), rel=1e-4, abs=1e-9)


@settings(deadline=None)
@given(winds, st.floats(0.0, 2.0 * math.pi))
def test_turning_the_axes_turns_the_direction_alone(w: tuple[float, float, float, float], angle: float) -> None:
    north, east, sd, _ = w
    if math.hypot(north, east) < 2.0 * sd:
        return
    c, s = math.cos(angle), math.sin(angle)
    turned = (c * north - s * east, s * north + c * east)
    assert speed_sd(*one(*turned, sd, sd))[0] == pytest.approx(speed_sd(*one(north, east, sd, sd))[0], rel=1e-6)
    e = float(direction_from(*one(*turned))[0] - direction_from(*one(north, east))[0] - angle)
    assert math.cos(e) == pytest.approx(1.0, abs=1e-9)


def test_a_wind_weaker_than_its_uncertainty_has_no_direction_but_a_size() -> None:
    assert np.isnan(direction_sd(*one(0.2, 0.1, 0.5, 0.5))[0])
    assert np.isnan(direction_sd(*one(0.0, 0.0, 0.5, 0.5))[0])
    assert speed_sd(*one(0.0, 0.0, 0.5, 0.3))[0] == 0.5
    # weak along a direction that is known across
    assert np.isfinite(direction_sd(*one(0.2, 0.0, 0.5, 0.1))[0])


# --- rose, profile, means ------------------------------------------------------------------------------------------------


def test_the_rose_counts_time_in_flight_by_sector_against_a_slow_count() -> None:
    rng = np.random.default_rng(2)
    wind = rng.normal([3.0, -1.0], 3.0, (500, 2))
    flying = np.arange(500) > 120
    w = series(wind, flying=flying)
    r = rose(w)
    assert r is not None
    slow = np.zeros_like(r.share)
    for k in np.flatnonzero(flying):
        if np.isnan(w.direction[k]):
            continue
        sector = min(range(SECTORS), key=lambda s: abs((w.direction[k] - s * 2 * math.pi / SECTORS + math.pi) % (2 * math.pi) - math.pi))
        slow[sector, max(i for i, low in enumerate(r.bounds) if w.speed[k] >= low)] += 1.0 / flying.sum()
    assert r.share == pytest.approx(slow, abs=1e-12)
    assert r.share.sum() + r.calm == pytest.approx(1.0)
    assert len(r.bounds) <= 6


def test_a_gap_in_the_rows_counts_for_no_more_than_a_row() -> None:
    w = series(np.tile([0.0, 5.0], (100, 1)))
    t = w.t.copy()
    t[50:] += 1000.0
    assert dataclasses.replace(w, t=t).weight.sum() == pytest.approx(50.0)


@pytest.mark.parametrize("exponent", [0.12, 0.3])
def test_a_power_law_over_height_is_found(exponent: float) -> None:
    height = np.concatenate([np.linspace(2.0, 80.0, 800), np.linspace(80.0, 2.0, 800)])
    speed = 4.0 * (height / 10.0) ** exponent
    p = profile(series(np.column_stack([0.6 * speed, 0.8 * speed]), height=height))
    assert p is not None and p.law is not None
    assert p.law["kind"] == "power"
    assert p.law["exponent"] == pytest.approx(exponent, abs=0.01)
    assert p.speed == pytest.approx(4.0 * (p.height / 10.0) ** exponent, rel=0.03)
    assert p.seconds.sum() == pytest.approx(800.0, abs=BLOCK)


def test_a_logarithmic_law_over_height_is_found() -> None:
    height = np.linspace(2.0, 80.0, 2000)
    speed = 0.4 / 0.4 * np.log(height / 0.05)
    p = profile(series(np.column_stack([speed, 0.0 * speed]), height=height))
    assert p is not None and p.law is not None
    assert p.law["kind"] == "log"
    assert p.law["roughness"] == pytest.approx(0.05, rel=0.15)
    assert p.law["friction"] == pytest.approx(0.4, rel=0.05)


def test_no_law_and_no_profile_where_heights_do_not_suffice() -> None:
    wind = np.tile([3.0, 1.0], (400, 1))
    assert profile(series(wind)) is None  # no position
    assert profile(series(wind, height=np.full(400, 30.0))) is None
    p = profile(series(wind, height=np.repeat([30.0, 40.0], 200)))
    assert p is not None and p.law is None


def test_means_are_of_vectors_and_of_what_is_in_flight() -> None:
    t = 0.5 * np.arange(240)
    angle = np.radians(np.where(t % 2.0 < 1.0, 350.0, 10.0))  # from north, either side of it
    wind = -4.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    flying = (t >= 20.0) & (t < 95.0)
    found = blocks(series(wind, flying=flying))
    assert [b.t for b in found] == pytest.approx([34.75, 64.75, 87.25])  # the last is half a block
    for b in found:
        assert abs((b.direction + math.pi) % (2 * math.pi) - math.pi) < math.radians(1.0)
        assert b.speed == pytest.approx(4.0)
        assert math.hypot(*b.wind) == pytest.approx(4.0 * math.cos(math.radians(10.0)), rel=2e-3)


def test_turbulence_is_the_spread_along_the_mean() -> None:
    rng = np.random.default_rng(3)
    along = 8.0 + 1.2 * rng.standard_normal(20000)
    across = 3.0 * rng.standard_normal(20000)
    wind = np.column_stack([0.6 * along - 0.8 * across, 0.8 * along + 0.6 * across])
    assert turbulence(wind, np.ones(20000)) == pytest.approx(0.15, rel=0.03)
    assert math.isnan(turbulence(0.01 * wind, np.ones(20000)))


def test_differences_from_a_reference_and_of_means() -> None:
    w = series(np.tile([3.0, 1.0], (400, 1)))
    t = np.arange(0.0, 195.0, 0.1)  # 26 whole turns
    sway = np.sin(2.0 * math.pi * t / 7.5)
    other = Stream({"t": t, "wind_n": 2.5 + sway, "wind_e": np.full(len(t), 1.0)})
    d = difference(w, other)
    assert d is not None and d.means is not None
    assert d.bias == pytest.approx([0.5, 0.0], abs=2e-3)
    assert d.sd == pytest.approx([math.sqrt(0.5), 0.0], abs=2e-3)
    assert d.means[1] == pytest.approx([0.0, 0.0], abs=1e-2)  # four whole turns a block
    assert d.turn == pytest.approx(math.atan2(1.0, 3.0) - math.atan2(1.0, 2.5), abs=1e-3)
    assert difference(w, Stream({"t": t, "vel_n": t})) is None
    assert difference(w, Stream({"t": t, "wind_n": np.full(len(t), np.nan), "wind_e": t})) is None


# --- in flight, and the verdict ------------------------------------------------------------------------------------------


def test_in_flight_is_from_the_first_to_the_last_motion_and_hover_counts() -> None:
    flight, solution = flown("hover")
    up = in_flight(solution.t, flight)
    truth = flight["truth"]
    above = np.interp(solution.t, truth.t, -truth["pos_d"]) > 0.3
    assert up[above].all()
    t = solution.t
    near = (t > t[above][0] - 3.0) & (t < t[above][-1] + 3.0)  # the rotors spin up before and run down after
    assert not up[~near].any()
    armed = Stream({"t": [0.0, 20.0, 40.0], "mode": ["a", "b", "c"], "armed": [0.0, 1.0, 0.0]})
    cut = in_flight(solution.t, FlightLog({**flight.streams, "modes": armed}, flight.meta))
    assert not cut[(solution.t < 19.9) | (solution.t > 40.1)].any()
    assert cut[(solution.t > 21.0) & (solution.t < 39.0)].all()


def verdict(mission: str, **changes: float) -> tuple[str, str]:
    flight, plain = flown(mission)
    solution = with_wind(flight, plain, **changes)  # type: ignore[arg-type]
    w = wind_series(solution, flight)
    assert w is not None
    q = quality(solution, flight, w)
    assert q.word in WORDS
    return q.word, "; ".join(q.why)


def test_the_verdict_is_good_with_motion_and_a_learned_drag() -> None:
    word, why = verdict("figure-eight", sd=0.3)
    assert word == "good"
    assert "0.3 m/s over the second half" in why
    assert "enough to tell wind, drag and accelerometer offsets apart" in why


@pytest.mark.parametrize(
    ("mission", "changes", "word", "reason"),
    [
        ("figure-eight", {"sd": 0.8}, "usable", "0.8 m/s over the second half"),
        ("figure-eight", {"sd": 1.6}, "poor", "1.6 m/s over the second half"),
        ("figure-eight", {"sd": 4.0}, "not observable", "4 m/s over the second half"),
        ("figure-eight", {"mu": (0.15, 0.14)}, "usable", "not learned in this flight"),
        ("hover", {"mu": (0.35, 0.34), "drift": 0.33}, "poor", "moved by a factor of"),
        ("figure-eight", {"mu": (0.35, 0.1), "drift": 1.5, "sd": 0.3}, "good", "went from ±35 %"),
        ("figure-eight", {"nis": 2.5}, "usable", "the stated 1σ is too small"),
        ("figure-eight", {"nis": 9.0}, "poor", "not to be believed"),
        ("figure-eight", {"nis": 0.1}, "good", "set larger than this flight shows"),
        ("hover", {"mu": (0.15, 0.14)}, "usable", "not told apart"),
        ("hover", {}, "usable", "an accelerometer offset from wind was not"),
        ("hover", {"sensor": "airdata", "mu": None}, "poor", "at one heading"),
        ("figure-eight", {"sensor": "airdata", "mu": None}, "good", "from several sides"),
        ("figure-eight", {"sensor": "gnss"}, "not observable", "nothing that feels the air"),
    ],
)
def test_the_verdict_follows_from_what_was_stated_moved_and_fitted(mission: str, changes: dict, word: str, reason: str) -> None:
    found, why = verdict(mission, **changes)
    assert found == word, why
    assert reason in why


def test_the_verdict_reads_no_reference() -> None:
    flight, plain = flown("figure-eight")
    solution = with_wind(flight, plain)
    blind = flight.without("truth", "onboard")
    a, b = (quality(solution, f, wind_series(solution, f)) for f in (flight, blind))  # type: ignore[arg-type]
    assert a == b


def test_the_table_of_a_summary_and_an_estimator_without_wind() -> None:
    flight, plain = flown("figure-eight")
    told = wind_table(with_wind(flight, plain, sd=0.3), flight)
    truth = flight["truth"]
    mean = np.array([truth["wind_n"].mean(), truth["wind_e"].mean()])
    assert [told["mean"]["n"], told["mean"]["e"]] == pytest.approx(mean, abs=1.0)
    assert told["mean"]["from_deg"] == pytest.approx(np.degrees(direction_from(*one(*mean))[0]), abs=12.0)
    assert told["settled_at"] > 10.0  # before, it is the prior of 5 m/s
    assert set(told["against"]) == {"truth"}
    bare = dataclasses.replace(plain, table={k: v for k, v in plain.table.items() if "wind" not in k})
    assert wind_table(bare, flight) == {}
    unsure = with_wind(flight, plain)
    unsure = dataclasses.replace(unsure, table={k: v for k, v in unsure.table.items() if not k.startswith("sd_wind")})
    assert wind_table(unsure, flight)["verdict"] == "poor"


def test_nees_of_the_wind_of_drawn_errors_is_one() -> None:
    rng = np.random.default_rng(5)
    n = 2000
    a = rng.standard_normal((n, 2, 2))
    P = 0.3**2 * (a @ a.transpose(0, 2, 1) + 0.2 * np.eye(2))
    e = np.einsum("nij,nj->ni", np.linalg.cholesky(P), rng.standard_normal((n, 2)))
    t = np.arange(n, dtype=float)
    q = {"q_w": np.ones(n)} | {f"q_{x}": np.zeros(n) for x in "xyz"}
    solution = Solution(
        {"t": t, **q, "wind_n": 4.0 + e[:, 0], "wind_e": -2.0 + e[:, 1]}, {}, [], Config("navigator", "default", defaults())
    )
    solution.covariance = {"t": t, "wind": P}
    truth = Stream({"t": t, "wind_n": np.full(n, 4.0), "wind_e": np.full(n, -2.0)})
    found = nees_series(solution, truth)
    assert set(found) == {"wind"}
    low, high = band(2, n, 0.999)
    assert low < found["wind"][1].mean() < high
    wide = np.zeros((n, 3, 3))
    wide[:, :2, :2], wide[:, 2, 2] = P, 1.0  # a vertical part is not counted
    solution.covariance = {"t": t, "wind": wide}
    assert nees_series(solution, truth)["wind"][1] == pytest.approx(found["wind"][1])
