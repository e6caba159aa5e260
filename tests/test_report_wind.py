"""The section on wind: verdict first, directions without lines over north, no empty plots, the autopilot's wind beside ours."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution
from haltere.metrics.summary import finite
from haltere.metrics.wind_quality import wind_table
from haltere.report import page
from haltere.report.context import Context
from haltere.report.markup import Section
from haltere.report.series import Pool
from haltere.report.wind import wind
from haltere.report.words import facts, wind_in_words
from report_page import browse, unpacked
from wind_made import flown, with_wind


@lru_cache(maxsize=4)
def made(north: float = 4.0) -> tuple[Solution, FlightLog]:
    """An eight in wind with an autopilot's wind of 0.5 m/s too much towards north."""
    flight, plain = flown("figure-eight", north=north, east=0.6)
    truth = flight["truth"]
    rows = slice(None, None, 200)
    own = Stream({"t": truth.t[rows], "wind_n": truth["wind_n"][rows] + 0.5, "wind_e": truth["wind_e"][rows]})
    flight = FlightLog({**flight.streams, "onboard": own}, flight.meta)
    solution = with_wind(flight, plain, sd=0.3)
    solution.summary["wind"] = finite(wind_table(solution, flight))
    return solution, flight


def section(solution: Solution, flight: FlightLog) -> tuple[Section, Context]:
    c = Context(solution, flight, Pool())
    found = wind(c)
    assert found is not None
    return found, c


def figure(s: Section, name: str) -> dict[str, Any]:
    return next(f for f in s.figures if f["name"] == name)


def test_the_verdict_comes_first_and_conventions_are_stated() -> None:
    solution, flight = made()
    s, c = section(solution, flight)
    assert s.before.index("wind good") < s.before.index("over the second half")
    assert "comes from" in s.note and "blows to" in s.note
    said = dict(facts(c))["wind"]
    assert said.endswith(": good")
    assert "from" in said and "±" in said
    text = page(solution, flight)
    assert text.index('id="wind"') < text.index("wind good")


def test_every_figure_has_data_units_and_a_time_axis_of_its_own_or_the_common_one() -> None:
    s, _ = section(*made())
    assert [f["name"] for f in s.figures] == ["wind", "wind_components", "wind_rose", "wind_profile", "wind_coefficients"] or [
        f["name"] for f in s.figures
    ] == ["wind", "wind_components", "wind_rose", "wind_coefficients"]
    for f in s.figures:
        assert f["traces"], f["name"]
        axes = [v for k, v in f["layout"].items() if k.startswith("yaxis")]
        assert all("[" in a["title"]["text"] for a in axes), f["name"]
    assert figure(s, "wind")["time"] and figure(s, "wind_components")["time"]
    names = {t["name"] for t in figure(s, "wind")["traces"]}
    assert {"truth", "autopilot's", "estimate", "estimate ±1σ", "mean of 30 s"} <= names


def test_a_wind_from_north_is_drawn_without_lines_over_north_and_labelled_with_the_compass() -> None:
    solution, flight = made(-4.0)  # blows to south, comes from about 351 degrees and turns over north in its gusts
    table = {**solution.table, "wind_e": solution["wind_e"] + 1.5 * np.sin(0.3 * solution.t)}
    s, _ = section(dataclasses.replace(solution, table=table), flight)
    axis = figure(s, "wind")["layout"]["yaxis2"]
    assert axis["range"][0] < 0.0 < axis["range"][1]
    assert axis["range"][1] - axis["range"][0] < 200.0
    assert any(label.startswith("N") for label in axis["ticktext"])
    assert all(not label.startswith("-") for label in axis["ticktext"])


def test_an_angle_is_shown_about_any_middle_and_breaks_there() -> None:
    t = np.arange(0.0, 40.0, 0.05)
    angle = (9.0 * t) % 360.0
    for about, low in ((0.0, -180.0), (180.0, 0.0), (90.0, -90.0)):
        _, shown = shown_about(t, angle, about)
        assert np.nanmin(shown) >= low and np.nanmax(shown) <= low + 360.0
        assert np.nanmax(np.abs(np.diff(shown))) < 180.0
        assert np.nanmax(np.abs(np.cos(np.radians(shown[np.isfinite(shown)])))) == pytest.approx(1.0, abs=1e-3)


def shown_about(t: np.ndarray, angle: np.ndarray, about: float) -> list[np.ndarray]:
    pool = Pool()
    pool.series(t, [angle], [1e-4], 360.0, about=about)
    return unpacked(pool)


def test_without_uncertainty_truth_and_autopilot_there_are_no_empty_panels() -> None:
    solution, flight = made()
    table = {k: v for k, v in solution.table.items() if not k.startswith(("sd_wind", "drag", "sd_drag"))}
    bare = dataclasses.replace(solution, table=table, summary={k: v for k, v in solution.summary.items() if k != "wind"})
    s, _ = section(bare, flight.without("truth", "onboard"))
    assert s.before == "" and "Differences" not in s.after
    assert all("±1σ" not in t["name"] for t in figure(s, "wind")["traces"])
    assert "wind_coefficients" not in [f["name"] for f in s.figures]
    still = {**table, "wind_n": np.zeros(len(solution)), "wind_e": np.zeros(len(solution))}
    s, _ = section(dataclasses.replace(bare, table=still), flight.without("truth", "onboard"))
    assert figure(s, "wind")["traces"]
    none = {k: v for k, v in table.items() if "wind" not in k}
    assert wind(Context(dataclasses.replace(bare, table=none), flight, Pool())) is None


def test_what_was_smoothed_and_what_was_told_are_drawn_too() -> None:
    solution, flight = made()
    smoothed = dataclasses.replace(solution, table={k: v for k, v in solution.table.items() if not k.startswith("drag")})
    told = Stream({"t": [0.0, 60.0], "wind_n": [4.0, 4.0], "wind_e": [0.6, 0.6], "wind_d": [0.0, 0.0], "sd": [1.0, 1.0]})
    s, _ = section(dataclasses.replace(solution, smoothed=smoothed), FlightLog({**flight.streams, "wind": told}, flight.meta))
    for name in ("wind", "wind_components"):
        assert {"smoothed", "given", "estimate"} <= {t["name"] for t in figure(s, name)["traces"]}


def test_what_is_estimated_with_air_data_is_named() -> None:
    solution, flight = made()
    n = len(solution)
    table = {**solution.table, "airspeed_scale": np.ones(n), "sd_airspeed_scale": np.full(n, 0.1), "aoa_offset": np.full(n, 0.02)}
    s, _ = section(dataclasses.replace(solution, table=table), flight)
    assert figure(s, "wind_coefficients")["reading"] == "Of the airspeed its scale, of the angle of attack its offset."


@pytest.mark.parametrize("rows", [slice(None), slice(200, 600), slice(0, 3), slice(-3, None)])
def test_a_wind_that_is_not_finite_breaks_nothing(rows: slice) -> None:
    solution, flight = made()
    table = dict(solution.table)
    for name in ("wind_n", "sd_wind_e", "drag_mu"):
        table[name] = table[name].copy()
        table[name][rows] = np.nan
    torn = dataclasses.replace(solution, table=table)
    torn = dataclasses.replace(torn, summary={**solution.summary, "wind": finite(wind_table(torn, flight))})
    assert torn.summary["wind"]["verdict"] in ("good", "usable", "poor", "not observable")
    assert "wind" in page(torn, flight)


def test_a_mean_wind_in_words() -> None:
    mean = {"speed": 5.23, "sd_speed": 0.41, "from_deg": 213.4, "sd_from_deg": 4.2}
    assert wind_in_words({"mean": mean}) == "5.2 ± 0.41 m/s from 213° ± 5° (SSW)"
    assert wind_in_words({"mean": mean | {"sd_from_deg": None}}) == "5.2 ± 0.41 m/s, direction not known"
    assert wind_in_words({"mean": mean | {"from_deg": 359.0}}).endswith("(N)")
    assert wind_in_words({}) == ""


def test_the_section_draws_in_a_browser_and_its_rose_can_be_saved_as_numbers() -> None:
    solution, flight = made()
    probe = """
      const div = document.getElementById("figure-wind_rose");
      div.scrollIntoView();
      await window.haltereReport.draw(div);
      out.csv = window.haltereReport.csv(div);
      out.bars = div.querySelectorAll(".barpolar path, .barlayer path").length;
    """
    data, found = browse(page(solution, flight), probe)
    assert data["errors"] == "[]"
    lines = found["csv"].strip().split("\n")
    assert lines[0].startswith("from [deg],")
    assert len(lines) == 17
    total = sum(float(v) for line in lines[1:] for v in line.split(",")[1:])
    assert total == pytest.approx(100.0 * (1.0 - solution.summary["wind"]["rose"]["no_direction"]), abs=0.1)
    assert found["bars"] > 0
