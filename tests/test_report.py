"""The report: one page that loads nothing, says what there is, and keeps the extremes."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import report_page
from haltere import drive
from haltere.flight.log import FlightLog, FlightMeta, Stream
from haltere.flight.solution import Solution
from haltere.report import page
from haltere.report.series import Pool, display, thin
from haltere.simulate import demo_flight
from report_page import carried, content, made, numbers, sections, series, unpacked

EVIL = "</script><script>alert('x')</script><img src=http://example.org/x onerror=alert(1)>"


@pytest.fixture(scope="module")
def demo() -> tuple[Solution, FlightLog]:
    return report_page.demo()


@pytest.fixture(scope="module")
def text() -> str:
    return report_page.demo_page()


# --- series --------------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 3000), st.integers(1, 200), st.integers(0, 2**31))
def test_thinning_keeps_first_last_and_extremes(n: int, points: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = [np.cumsum(rng.standard_normal(n)), rng.standard_normal(n)]
    columns[1][rng.random(n) < 0.2] = np.nan
    rows = thin(columns, points)
    assert np.all(np.diff(rows) > 0)
    assert rows[0] == 0
    assert rows[-1] == n - 1
    assert len(rows) <= max(points, n if n <= points else 0) + 6
    for c in columns:
        if np.isfinite(c).any():
            assert np.nanmin(c[rows]) == np.nanmin(c)
            assert np.nanmax(c[rows]) == np.nanmax(c)


def test_a_spike_of_one_sample_in_a_million_is_shown() -> None:
    t = np.arange(1_000_000) / 1000.0
    y = np.zeros(len(t))
    y[345_678] = 7.0
    shown_t, shown_y = display(t, [y], 4000)
    assert len(shown_t) <= 4010
    assert shown_t[np.argmax(shown_y)] == t[345_678]
    assert shown_y.max() == 7.0


@settings(deadline=None, max_examples=60)
@given(st.lists(st.one_of(st.floats(-1e9, 1e9), st.just(float("nan"))), min_size=1, max_size=200), st.sampled_from([1e-4, 1e-3, 1.0]))
def test_packed_numbers_come_back(values: list[float], resolution: float) -> None:
    pool = Pool(100)
    given_ = np.array(values)
    pool.add(given_, resolution)
    back = unpacked(pool)[0]
    assert np.array_equal(np.isnan(back), np.isnan(given_))
    assert np.allclose(back, given_, rtol=1e-13, atol=0.51 * resolution, equal_nan=True)


def test_huge_and_tiny_numbers_survive_packing() -> None:
    kept = ([1e30, -1e30, 1.0], [1e-12, 2e-12, 3e-12], [0.0, 0.0], [np.inf, 1.0], [])
    pool = Pool(100)
    for values in kept:
        pool.add(np.array(values))
    for values, back in zip(kept, unpacked(pool), strict=True):
        usable = np.where(np.isinf(values), np.nan, values) if values else np.array([])
        largest = np.nanmax(np.abs(usable), initial=0.0)
        assert np.allclose(back, usable, rtol=1e-3, atol=1e-14 * largest, equal_nan=True)


def test_angles_break_where_they_turn_over_and_lines_where_data_are_missing() -> None:
    t = np.arange(0.0, 60.0, 0.01)
    t = t[(t < 20.0) | (t > 25.0)]
    yaw = (40.0 * t + 180.0) % 360.0 - 180.0
    for points in (len(t), 300):
        shown_t, shown = display(t, [yaw], points, period=360.0)
        step = np.abs(np.diff(shown))
        assert np.nanmax(step) < 180.0
        assert np.nanmin(shown) >= -180.0
        assert np.nanmax(shown) <= 180.0
        assert np.isnan(shown).sum() == 6 + 1
        assert np.all(np.diff(shown_t) >= 0.0)


# --- the page ------------------------------------------------------------------------------------------------------------


def test_page_loads_nothing_from_outside(text: str) -> None:
    own = re.sub(r'<script type="application/octet-stream"[^<]*</script>', "", text)
    assert not re.search(r"""\b(src|srcset|poster|action|data|background)\s*=\s*["']?(?!["'])""", own.split("<script>")[0])
    assert set(re.findall(r"""href=["']([^"']*)""", own)) == {f"#{s}" for s in sections(text) if s not in ("verdict", "facts")}
    assert not re.search(r"https?://|//cdn|@import|url\(|<link|<iframe|<base|import\(|fetch\(|XMLHttpRequest", own)
    assert "default-src 'none'" in own
    assert "connect-src" not in own


def test_library_is_the_plotly_package_s(text: str) -> None:
    from plotly.offline import get_plotlyjs

    assert carried(text, "library").decode() == get_plotlyjs()


def test_navigator_with_truth_has_every_section(text: str) -> None:
    expected = "verdict facts map timeline attitude velocity position view biases errors innovations consistency data configuration".split()
    assert [s for s in sections(text) if s in expected] == expected
    assert text.index('id="verdict"') < text.index('id="map"') < text.index('id="timeline"')
    figures = numbers(text)
    assert {"map", "timeline", "attitude", "velocity", "position", "biases", "errors_attitude", "innovations_gnss"} <= set(figures)
    assert "gate ±5σ" in {t["name"] for t in figures["innovations_gnss"]["traces"]}
    for word in ("RMS error against truth", "mean NIS", "mean NEES", "before alignment", "haltere run &#x27;my log.bin&#x27; --config"):
        assert word in text


def test_every_axis_has_a_unit_and_no_panel_is_empty(text: str) -> None:
    for name, figure in numbers(text).items():
        layout, traces = figure["layout"], figure["traces"]
        if name == "view":
            assert [layout["scene"][f"{a}axis"]["title"]["text"] for a in "xyz"] == ["east [m]", "north [m]", "height [m]"]
            continue
        axes = [k for k in layout if re.fullmatch(r"yaxis\d*", k)]
        for axis in axes:
            mine = [t for t in traces if t.get("yaxis", "y") == axis.replace("axis", "") and ("y" in t and len(t["y"]))]
            assert mine, f"{name} {axis} is empty"
            if name != "timeline":
                assert re.search(r"\[[^\]]+\]", layout[axis]["title"]["text"]), f"{name} {axis}"
        if figure["time"]:
            assert layout["xaxis"]["title"]["text"] == "t [s]"
    assert numbers(text)["map"]["layout"]["xaxis"]["title"]["text"] == "east [m]"


def test_figures_show_what_the_solution_holds(demo: tuple[Solution, FlightLog], text: str) -> None:
    solution, flight = demo
    figures = numbers(text)
    t, v = series(figures["velocity"], "estimate", "y2")
    assert np.allclose(t, solution.t, atol=1e-4)
    assert np.allclose(v, solution["vel_e"], atol=1e-3)
    _, truth = series(figures["velocity"], "truth", "y2")
    assert np.allclose(truth, flight["truth"]["vel_e"], atol=1e-3)
    _, gyro = series(figures["biases"], "estimate", "y3")
    assert np.allclose(gyro, np.degrees(solution["gyro_bias_z"]), atol=1e-4)
    track = next(t for t in figures["map"]["traces"] if t["name"] == "estimate")
    assert np.allclose(track["x"], solution["pos_e"], atol=1e-3)
    assert np.allclose(track["y"], solution["pos_n"], atol=1e-3)
    assert figures["map"]["layout"]["yaxis"]["scaleanchor"] == "x"
    low, high = figures["position"]["layout"]["yaxis3"]["range"]
    assert low > high, "the axis of down points down"


def test_refused_measurements_are_marked(demo: tuple[Solution, FlightLog]) -> None:
    solution, flight = demo
    aids = {k: v.copy() for k, v in solution.aids.items()}
    rows = np.flatnonzero((aids["sensor"] == "magnetometer") & (aids["t"] > 20.0) & (aids["t"] < 21.0))
    aids["status"] = aids["status"].astype("<U10")
    aids["reason"] = aids["reason"].astype("<U20")
    aids["status"][rows], aids["reason"][rows] = "rejected", "field strength"
    figures = numbers(shown := page(replace(solution, aids=aids), flight))
    t, _ = series(figures["innovations_magnetometer"], "refused")
    assert np.allclose(t[(t > 20.0) & (t < 21.0)], aids["t"][rows], atol=1e-4)
    assert re.search(r"<li>Magnetometer heading refused \d+ times from t = [\d.]+ to [\d.]+ s \(field strength", shown)
    assert any(t["name"] == "refused" for t in figures["timeline"]["traces"])


def test_ahrs_says_why_there_is_no_map(demo: tuple[Solution, FlightLog]) -> None:
    flight = demo[1]
    shown = page(drive.run(flight, "ahrs"), flight)
    assert not {"velocity", "position"} & set(sections(shown))
    assert "estimates attitude only" in shown
    assert set(numbers(shown)) & {"map", "velocity", "position", "errors_velocity"} == set()
    assert "gyro x [deg/s]" in str(numbers(shown)["biases"]["layout"])


def test_without_gnss_position_is_called_an_assumption(demo: tuple[Solution, FlightLog]) -> None:
    flight = demo[1].without("gnss", "truth")
    shown = page(drive.run(flight), flight)
    assert "no GNSS position was let in" in shown
    assert "map" not in numbers(shown)
    assert "errors" not in sections(shown)
    assert "solution doubtful" in shown


def test_text_of_a_log_is_only_text(demo: tuple[Solution, FlightLog]) -> None:
    solution, flight = demo
    event = {"sensor": EVIL, "axis": EVIL, "kind": EVIL, "t_onset": 12.0, "t_detected": 12.0, "evidence": EVIL}
    summary = solution.summary | {"warnings": [EVIL], "streams": {EVIL: {"n": 9, "rate": 1.0, "gaps": 0, "discarded": {EVIL: 3}}}}
    meta = FlightMeta(name=EVIL, source=EVIL, start_utc=EVIL, faults=[{EVIL: EVIL}])
    shown = page(replace(solution, events=[event], summary=summary), FlightLog(flight.streams, meta), EVIL)
    clean = page(*demo)
    for tag in ("<script", "<img", "onerror=alert(1)>"):
        assert shown.count(tag) == clean.count(tag)
    assert "<script" not in json.dumps(content(shown))


def test_discards_and_events_are_told(demo: tuple[Solution, FlightLog]) -> None:
    solution, flight = demo
    lost = {"n": 1000, "rate": 10.0, "gaps": 2, "discarded": {"not finite": 200}}
    event = {
        "sensor": "filter",
        "axis": None,
        "kind": "diverged",
        "t_onset": 15.0,
        "t_detected": 15.0,
        "evidence": "covariance not positive",
    }
    changed = replace(solution, events=[*solution.events, event], summary=solution.summary | {"streams": {"imu": lost}})
    shown = page(changed, flight)
    assert "200 samples of imu (not finite, 20 % of it)" in shown
    assert 'class="verdict bad"' in shown
    assert "At t = 15.0 s: filter diverged, covariance not positive." in shown
    assert len(numbers(shown)["attitude"]["layout"]["shapes"]) == 1


def test_changed_keys_stand_out(demo: tuple[Solution, FlightLog]) -> None:
    solution, flight = demo
    assert "<b>4</b>" not in page(*demo)
    shown = page(replace(solution, config=solution.config.changed(gate__gnss=4.0)), flight)
    assert re.search(r'<tr class="changed"><td><code>gate\.gnss</code></td><td class="num"><b>4</b>', shown)
    assert re.search(r'<tr class="found"><td><code>field\.dip</code>', shown)


def test_a_quarter_hour_of_noise_stays_below_five_megabytes() -> None:
    t = np.arange(0.0, 900.0, 0.004)
    made_solution, flight = made(t, np.random.default_rng(1), 10.0)
    made_solution.table["vel_n"][123_456] = 500.0
    shown = page(made_solution, flight)
    assert len(shown.encode()) < 5e6
    _, v = series(numbers(shown)["velocity"], "estimate")
    assert np.nanmax(v) == pytest.approx(500.0)


def test_a_page_too_large_keeps_what_is_cheap_and_the_extremes_of_the_rest(
    demo: tuple[Solution, FlightLog], monkeypatch: pytest.MonkeyPatch
) -> None:
    large = page(*demo)
    limit = len(large.encode()) - 80_000
    monkeypatch.setattr(sys.modules["haltere.report.document"], "LIMIT", limit)
    small = page(*demo)
    assert len(small.encode()) <= limit
    ratios = {}
    for figures in (before := numbers(large), numbers(small)):
        assert set(figures) == set(before)
    for axis, name in (("y", "n"), ("y2", "e"), ("y3", "d")):
        whole = series(before["velocity"], "estimate", axis)[1]
        kept = series(numbers(small)["velocity"], "estimate", axis)[1]
        ratios[name] = len(kept) / len(whole)
        assert np.nanmin(kept) == np.nanmin(whole)
        assert np.nanmax(kept) == np.nanmax(whole)
    assert max(ratios.values()) < 1.0
    told = [m for m in content(small)["arrays"] if "of" in m]
    assert any(m["kept"] == m["of"] for m in told)
    assert any(m["kept"] < m["of"] for m in told)


def test_series_share_the_room_by_bytes() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(20_000) * 0.01
    pool = Pool()
    pool.series(t, [np.sin(t)], [1e-3])
    pool.series(t, [rng.normal(0.0, 10.0, len(t))], [1e-3])
    pool.series(t, [rng.normal(0.0, 10.0, len(t))], [1e-3])
    whole = len(pool.packed()[1])
    for share in (0.8, 0.5, 0.3, 0.1):
        metas, data = pool.packed(share * whole)
        assert len(data) <= share * whole
        assert len(data) > 0.6 * share * whole
        kept = [m["kept"] / m["of"] for m in metas if "of" in m]
        assert kept[0] >= max(kept[1:])
        assert kept[1] == pytest.approx(kept[2], rel=0.05)
    assert pool.series(t, [np.sin(t)], [1e-3]) == [0, 1], "the same series again is the same"


def test_flight_modes_are_shaded_and_named(demo: tuple[Solution, FlightLog], text: str) -> None:
    from haltere.report.context import Context

    c = Context(*demo, Pool())
    assert [(m.start, m.end, m.name, m.armed) for m in c.modes] == [
        (0.0, 4.0, "Hold", False), (4.0, 12.0, "Hold", True), (12.0, 26.0, "Loiter", True), (26.0, c.span[1], "Land", True),
    ]  # fmt: skip
    shades = content(text)["shades"]
    by_start = {start: colour for start, _, colour in shades if "disarmed" not in colour}
    assert by_start[0.0] == by_start[4.0], "one mode, one shade"
    assert len(set(by_start.values())) == 3
    assert [s[:2] for s in shades if "disarmed" in s[2]] == [[0.0, 4.0]]
    timeline = next(f for f in content(text)["figures"] if f["name"] == "timeline")
    rows = timeline["layout"]["yaxis"]["ticktext"]
    assert {"mode", "armed"} <= set(rows)
    labels = next(t["$labels"] for t in timeline["traces"] if "$labels" in t)
    assert labels["names"] == ["Hold", "Hold", "Loiter", "Land"]
    assert rows[labels["row"]] == "mode"
    armed = next(t for t in timeline["traces"] if t["name"] == "armed")
    assert armed["x"] == [4.0, round(c.span[1], 4), None]


@pytest.mark.parametrize(
    ("modes", "found"),
    [
        ({"t": [5.0], "mode": ["<b>x</b>"], "armed": [np.nan]}, [(5.0, "<b>x</b>", None)]),
        ({"t": [-50.0, np.nan, 1000.0], "mode": ["A", "B", "C"], "armed": [1, 1, 1]}, [(0.0, "A", True)]),
        ({"t": [9.0, 3.0], "mode": ["late", "early"]}, [(3.0, "early", None), (9.0, "late", None)]),
        ({"t": [0.0, 9.0], "armed": [0, 1]}, [(0.0, "", False), (9.0, "", True)]),
        ({"t": [], "mode": [], "armed": []}, []),
    ],
)
def test_odd_modes(demo: tuple[Solution, FlightLog], modes: dict[str, Any], found: list[Any]) -> None:
    from haltere.report.context import Context

    solution, flight = demo
    changed = FlightLog({**flight.streams, "modes": Stream(modes)}, flight.meta)
    assert [(m.start, m.name, m.armed) for m in Context(solution, changed, Pool()).modes] == found
    told = content(page(solution, changed))
    timeline = next(f for f in told["figures"] if f["name"] == "timeline")
    assert ("mode" in timeline["layout"]["yaxis"]["ticktext"]) == any(name for _, name, _ in found)
    assert bool(told["shades"]) == (len({(name, armed) for _, name, armed in found}) > 1), "what never changes is not shaded"


def test_no_modes_no_shades(demo: tuple[Solution, FlightLog]) -> None:
    solution, flight = demo
    found = content(page(solution, flight.without("modes")))
    assert found["shades"] == []
    timeline = next(f for f in found["figures"] if f["name"] == "timeline")
    assert not {"mode", "armed"} & set(timeline["layout"]["yaxis"]["ticktext"])


@pytest.mark.slow
def test_a_quarter_hour_at_250_hz_with_all_streams_keeps_far_more_than_a_screen_shows() -> None:
    flight = demo_flight(duration=900.0, imu_rate=250.0)
    shown = page(drive.run(flight), flight)
    assert len(shown.encode()) < 5e6
    told = {name: f for name, f in numbers(shown).items() if name in ("attitude", "position", "velocity")}
    for figure in told.values():
        for axis in ("y", "y2", "y3"):
            assert len(series(figure, "estimate", axis)[0]) > 15_000


@pytest.mark.parametrize("n", [1, 2, 50])
def test_short_and_broken_solutions_are_drawn(n: int) -> None:
    rng = np.random.default_rng(n)
    made_solution, flight = made(np.arange(n) * 0.01 + 5.0, rng, 20.0)
    if n > 2:
        made_solution.table["pos_n"][3] = np.nan
        made_solution.table["pos_n"][-1] = np.nan
        made_solution.table["vel_n"][7] = 1e30
        made_solution.table["sd_vel_n"][8] = np.inf
    shown = page(made_solution, flight)
    assert "attitude" in numbers(shown)
    nothing = {k: v[:0] for k, v in made_solution.aids.items()}
    assert "no measurement was offered" in page(replace(made_solution, aids=nothing), flight)


# --- colours, and what is read -----------------------------------------------------------------------------------------


LINES = ("estimate", "truth", "onboard", "gnss", "barometer", "magnetometer", "imu", "assumed", "refused", "deweighted", "event", "limit")
BODY = ("body_x", "body_y", "body_z")


def rgb(name: str, theme: int) -> np.ndarray[Any, Any]:
    from haltere.report.style import COLOURS

    h = COLOURS[name][theme]
    return np.array([int(h[i : i + 2], 16) for i in (1, 3, 5)], float)


def contrast(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> float:
    """Contrast of two colours by WCAG 2.2, from 1 to 21."""

    def luminance(c: np.ndarray[Any, Any]) -> float:
        c = c / 255.0
        return float(np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722])

    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_contrast_of_known_pairs() -> None:
    black, white, grey = np.zeros(3), np.full(3, 255.0), np.full(3, float(0x76))
    assert contrast(black, white) == pytest.approx(21.0)
    assert contrast(grey, white) == pytest.approx(4.54, abs=0.005)  # the lightest grey that passes on white


@pytest.mark.parametrize("theme", [0, 1])
@pytest.mark.parametrize("ground", ["page", "panel"])
def test_text_and_lines_stand_out_in_both_themes(theme: int, ground: str) -> None:
    for name in ("text", "quiet", "good", "doubtful", "bad", "estimate"):
        assert contrast(rgb(name, theme), rgb(ground, theme)) >= 4.5, name
    for name in (*LINES, *BODY):
        assert contrast(rgb(name, theme), rgb(ground, theme)) >= 3.0, name


@pytest.mark.parametrize("theme", [0, 1])
def test_text_and_lines_stand_out_on_the_shades_of_flight_modes(theme: int) -> None:
    from haltere.report.overview import DISARMED, SHADE
    from haltere.report.style import MODES

    for k in range(MODES):
        shade = (1.0 - SHADE) * rgb("page", theme) + SHADE * rgb(f"mode{k}", theme)
        for ground in (shade, (1.0 - DISARMED) * shade + DISARMED * rgb("disarmed", theme)):
            assert contrast(rgb("text", theme), ground) >= 4.5
            for name in ("estimate", "truth", "gnss", "barometer", "magnetometer", "refused", "event"):
                assert contrast(rgb(name, theme), ground) >= 3.0, (k, name)
        bar = 0.5 * rgb("page", theme) + 0.5 * rgb(f"mode{k}", theme)
        assert contrast(rgb("text", theme), bar) >= 4.5, f"the name of mode {k} on its bar"


@pytest.mark.parametrize("theme", [0, 1])
def test_colours_differ_from_the_page_and_from_each_other(theme: int) -> None:
    lines = ("estimate", "truth", "onboard", "gnss", "barometer", "magnetometer", "refused", "deweighted", "event")
    for i, a in enumerate(lines):
        assert np.linalg.norm(rgb(a, theme) - rgb("page", theme)) > 110.0, a
        for b in lines[i + 1 :]:
            assert np.linalg.norm(rgb(a, theme) - rgb(b, theme)) > 60.0, (a, b)


def test_every_colour_a_figure_names_is_there(text: str) -> None:
    from haltere.report.style import COLOURS

    named = set(re.findall(r'"@([a-z_0-9]+)', json.dumps(content(text))))
    assert "estimate" in named
    assert named <= set(COLOURS)


def test_report_reads_no_kernels() -> None:
    """Nor anything that could compute what it draws; the pages on a calibration and on a vehicle draw the rooms that made them."""
    besides = {"calibration.py": ("haltere.calibrate", "haltere.readers")}
    besides |= {"identification.py": ("haltere.identify",), "vehicle_model.py": ("haltere.identify", "haltere.vehicle")}
    for path in Path(sys.modules["haltere.report"].__path__[0]).glob("*.py"):
        for name in re.findall(r"^\s*(?:from|import) (haltere\.[a-z]+)", path.read_text(encoding="utf-8"), re.MULTILINE):
            assert name in ("haltere.flight", "haltere.metrics", "haltere.report", *besides.get(path.name, ())), f"{path.name}: {name}"


def test_an_error_that_could_not_be_computed_is_left_out(demo: tuple[Solution, FlightLog]) -> None:
    solution, flight = demo
    errors = {"truth": {**solution.summary["errors"]["truth"], "wind_n": {"rms": None, "max": None, "n": 10}}}
    text = page(replace(solution, summary={**solution.summary, "errors": errors}), flight)
    assert "errors against truth" in text
