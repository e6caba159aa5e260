"""The report: one page that loads nothing, says what there is, keeps the extremes, and draws itself in a browser."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haltere import drive
from haltere.flight.config import Config, defaults
from haltere.flight.log import FlightLog, FlightMeta
from haltere.flight.solution import Solution
from haltere.report import page
from haltere.report.series import Pool, display, thin
from haltere.simulate import demo_flight

EVIL = "</script><script>alert('x')</script><img src=http://example.org/x onerror=alert(1)>"


# --- what the page is made of --------------------------------------------------------------------------------------------


def packed(text: str, name: str) -> str:
    """What the page carries under a name, inflated."""
    found = re.search(rf'<script type="application/octet-stream" id="{name}">([^<]*)</script>', text)
    assert found, f"no {name} in the page"
    return zlib.decompress(base64.b64decode(found.group(1))).decode()


def numbers(text: str) -> dict[str, Any]:
    """Figures of the page by name, with the arrays they refer to in place of the references."""
    content = json.loads(packed(text, "numbers"))
    arrays = [decode(a) for a in content["arrays"]]

    def resolve(value: Any) -> Any:
        if isinstance(value, dict):
            if "$a" in value:
                return arrays[value["$a"]]
            if "$b" in value:
                return value["k"] * arrays[value["$b"]]
            return {k: resolve(v) for k, v in value.items()}
        return [resolve(v) for v in value] if isinstance(value, list) else value

    return {f["name"]: resolve(f) for f in content["figures"]}


def decode(array: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    steps = np.array([0.0 if d is None else float(d) for d in array["d"]])
    values = np.cumsum(steps) / array["s"]
    values[[d is None for d in array["d"]]] = np.nan
    return values


def series(figure: dict[str, Any], label: str, axis: str = "y") -> tuple[Any, Any]:
    """Times and values of a named line of a figure."""
    trace = next(t for t in figure["traces"] if t["name"] == label and t["yaxis"] == axis and "y" in t)
    return trace["x"], trace["y"]


def sections(text: str) -> list[str]:
    return re.findall(r'<section (?:class="[^"]*" )?id="([^"]+)"', text)


# --- flights -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def demo() -> tuple[Solution, FlightLog]:
    flight = demo_flight(seed=2, duration=30.0, imu_rate=100.0)
    return drive.run(flight), flight


@pytest.fixture(scope="module")
def text(demo: tuple[Solution, FlightLog]) -> str:
    return page(*demo, "haltere run 'my log.bin' --config my.haltere/config.toml")


def made(t: np.ndarray[Any, Any], rng: np.random.Generator, aids_rate: float) -> tuple[Solution, FlightLog]:
    """A solution made by hand, as hard to compress as a flight can be: everything is noise."""
    n = len(t)
    names = [
        *(f"{s}_{a}" for s in ("vel", "pos") for a in "ned"),
        *(f"{s}_bias_{a}" for s in ("gyro", "accel") for a in "xyz"),
        "baro_bias",
    ]
    table = {"t": t} | {f"q_{a}": np.zeros(n) for a in "wxyz"}
    yaw = np.cumsum(rng.normal(0.0, 0.1, n))
    table["q_w"], table["q_z"] = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    table |= {name: rng.normal(0.0, 10.0, n) for name in names}
    table |= {f"sd_{name}": np.abs(rng.normal(1.0, 0.3, n)) for name in ("roll", "pitch", "yaw", *names)}
    parts = [("gnss", c) for c in ("vel_n", "vel_e", "vel_d", "pos_n", "pos_e", "pos_d")]
    parts += [("magnetometer", "heading"), ("barometer", "altitude")]
    at = np.sort(np.tile(np.arange(t[0], t[-1], 1.0 / aids_rate), len(parts)))
    m = len(at)
    aids = {
        "t": at,
        "sensor": np.array([s for s, _ in parts] * (m // len(parts))),
        "component": np.array([c for _, c in parts] * (m // len(parts))),
        "status": np.where(rng.random(m) < 0.3, "rejected", "fused"),
        "reason": np.full(m, ""),
    } | {k: np.abs(rng.normal(1.0, 0.3, m)) for k in ("observation", "innovation", "innovation_sd", "test_ratio", "weight")}
    config = Config("navigator", "default", defaults())
    zeros = np.zeros(n)
    imu = {"t": t} | {f"{s}_{a}": zeros for s in ("gyro", "accel") for a in "xyz"}
    truth = {k: v + rng.normal(0.0, 1.0, n) * (k != "t") for k, v in table.items() if not k.startswith("sd_")}
    flight = FlightLog({"imu": imu, "truth": truth}, FlightMeta(name="made"))
    return Solution(table, aids, [], config, {"streams": {}, "errors": {}, "nis": {}, "health": {}, "warnings": []}), flight


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
    back = decode(pool.arrays[pool.add(given_, resolution)])
    assert np.array_equal(np.isnan(back), np.isnan(given_))
    assert np.allclose(back, given_, rtol=1e-13, atol=0.51 * resolution, equal_nan=True)


def test_huge_and_tiny_numbers_survive_packing() -> None:
    pool = Pool(100)
    for values in ([1e30, -1e30, 1.0], [1e-12, 2e-12, 3e-12], [0.0, 0.0], [np.inf, 1.0], []):
        back = decode(pool.arrays[pool.add(np.array(values))])
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

    assert packed(text, "library") == get_plotlyjs()


def test_navigator_with_truth_has_every_section(text: str) -> None:
    expected = "verdict facts map timeline attitude velocity position biases errors innovations consistency data configuration".split()
    assert sections(text) == expected
    assert text.index('id="verdict"') < text.index('id="map"') < text.index('id="timeline"')
    figures = numbers(text)
    assert {"map", "timeline", "attitude", "velocity", "position", "biases", "errors_attitude", "innovations_gnss"} <= set(figures)
    assert "gate ±5σ" in {t["name"] for t in figures["innovations_gnss"]["traces"]}
    for word in ("RMS error against truth", "mean NIS", "mean NEES", "before alignment", "haltere run &#x27;my log.bin&#x27; --config"):
        assert word in text


def test_every_axis_has_a_unit_and_no_panel_is_empty(text: str) -> None:
    for name, figure in numbers(text).items():
        layout, traces = figure["layout"], figure["traces"]
        axes = [k for k in layout if re.fullmatch(r"yaxis\d*", k)]
        for axis in axes:
            mine = [t for t in traces if t.get("yaxis", "y") == axis.replace("axis", "") and ("y" in t and len(t["y"]))]
            assert mine, f"{name} {axis} is empty"
            if name != "timeline":
                assert re.search(r"\[(deg|deg/s|m|m/s|m/s²|µT)\]", layout[axis]["title"]["text"])
        last = layout[f"xaxis{len(axes)}" if len(axes) > 1 else "xaxis"]["title"]["text"]
        assert last == ("east [m]" if name == "map" else "t [s]")


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
    assert "<script" not in json.dumps(json.loads(packed(shown, "numbers")))


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


def test_a_page_too_large_shows_fewer_points(demo: tuple[Solution, FlightLog], monkeypatch: pytest.MonkeyPatch) -> None:
    target = sys.modules["haltere.report.page"]
    large = page(*demo)
    monkeypatch.setattr(target, "LIMIT", len(large) - 50_000)
    small = page(*demo)
    assert len(small) < len(large) - 50_000
    assert len(series(numbers(small)["velocity"], "estimate")[0]) < len(series(numbers(large)["velocity"], "estimate")[0])


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


# --- in a browser --------------------------------------------------------------------------------------------------------

#: Run in the page once everything is drawn; what it finds is left in the document for the test.
PROBE = """
<script>
new MutationObserver(async (_, me) => {
  const root = document.documentElement;
  if (!root.dataset.ready) return;
  me.disconnect();
  const out = {};
  try {
    const { divs, settle } = window.haltereReport;
    out.panels = divs.map((d) => d.querySelectorAll("svg.main-svg").length);
    out.lines = divs.map((d) => d.querySelectorAll("path.js-line, path.point, .js-fill").length);
    out.wide = root.scrollWidth - innerWidth;
    out.opened = Number(root.dataset.opened);
    out.text = getComputedStyle(document.querySelector("#figure-attitude .ytick text")).fill;
    out.page = getComputedStyle(document.body).backgroundColor;
    const attitude = document.getElementById("figure-attitude");
    await Plotly.relayout(attitude, { "xaxis.range[0]": 10, "xaxis.range[1]": 12 });
    await settle();
    const time = divs.filter((d) => d.id !== "figure-map");
    out.zoomed = time.map((d) => Object.keys(d.layout).filter((k) => /^xaxis/.test(k)).map((k) => d.layout[k].range.map(Number)));
    await Plotly.relayout(time[0], { "xaxis.autorange": true });
    await settle();
    out.whole = time.map((d) => d.layout.xaxis.range.map(Number));
  } catch (e) { out.failed = String(e); }
  root.dataset.probe = JSON.stringify(out);
}).observe(document.documentElement, { attributes: true });
</script>
"""


@pytest.fixture(scope="module")
def browse(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., dict[str, str]]:
    """Open a page in headless Chromium; returns the data attributes of its document."""
    program = next((p for p in ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable") if shutil.which(p)), None)
    if program is None:
        message = "no Chromium to open the report in (Debian: apt install chromium)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)

    def open_page(text: str, *options: str, size: str = "1300,900") -> dict[str, str]:
        folder = tmp_path_factory.mktemp("page")
        file = folder / "report.html"
        file.write_text(text.replace("</footer>", "</footer>" + PROBE), encoding="utf-8")
        result = subprocess.run(
            [
                program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
                "--disable-background-networking", "--disable-component-update", "--disable-sync",
                f"--user-data-dir={folder / 'profile'}", f"--window-size={size}",
                "--virtual-time-budget=20000", *options, "--dump-dom", file.as_uri(),
            ],
            capture_output=True, text=True, check=False, timeout=120,
        )  # fmt: skip
        head = re.search(r"<html[^>]*>", result.stdout)
        assert head, result.stderr[-2000:]
        return {k: html.unescape(v) for k, v in re.findall(r'data-([a-z]+)="([^"]*)"', head.group(0))}

    return open_page


def test_every_figure_is_drawn_without_script_errors_and_zooms_with_the_others(browse: Callable[..., dict[str, str]], text: str) -> None:
    data = browse(text)
    assert data["errors"] == "[]"
    found = json.loads(data["probe"])
    assert "failed" not in found, found["failed"]
    assert len(found["panels"]) == len(numbers(text)) == int(data["drawn"])
    assert min(found["panels"]) >= 1
    assert min(found["lines"]) >= 1
    assert found["wide"] <= 0
    assert all(r == [10, 12] for figure in found["zoomed"] for r in figure)
    assert len({tuple(r) for r in found["whole"]}) == 1
    assert found["whole"][0] != [10, 12]


def test_dark_page_is_legible_and_a_phone_needs_no_sideways_scrolling(browse: Callable[..., dict[str, str]], text: str) -> None:
    data = browse(text, "--blink-settings=preferredColorScheme=0", size="500,900")
    assert data["errors"] == "[]"
    found = json.loads(data["probe"])
    assert found["wide"] <= 0

    def luminance(colour: str) -> float:
        r, g, b = (int(x) / 255.0 for x in re.findall(r"\d+", colour)[:3])
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (r, g, b)]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    page_light, text_light = luminance(found["page"]), luminance(found["text"])
    assert page_light < 0.05
    assert (text_light + 0.05) / (page_light + 0.05) > 7.0


def test_a_script_error_is_kept_for_reading(browse: Callable[..., dict[str, str]], text: str) -> None:
    data = browse(text.replace("const Plotly = window.Plotly;", "const Plotly = window.Plotly; throw new Error('on purpose');"))
    assert "on purpose" in data["errors"]


@pytest.mark.parametrize("theme", [0, 1])
def test_colours_differ_from_the_page_and_from_each_other(theme: int) -> None:
    from haltere.report.style import COLOURS

    def rgb(name: str) -> np.ndarray[Any, Any]:
        h = COLOURS[name][theme]
        return np.array([int(h[i : i + 2], 16) for i in (1, 3, 5)], float)

    lines = ("estimate", "truth", "onboard", "gnss", "barometer", "magnetometer", "refused", "deweighted", "event")
    for i, a in enumerate(lines):
        assert np.linalg.norm(rgb(a) - rgb("page")) > 110.0, a
        for b in lines[i + 1 :]:
            assert np.linalg.norm(rgb(a) - rgb(b)) > 60.0, (a, b)


def test_report_reads_no_kernels() -> None:
    for path in Path(sys.modules["haltere.report"].__path__[0]).glob("*.py"):
        for name in re.findall(r"^\s*(?:from|import) (haltere\.[a-z]+)", path.read_text(encoding="utf-8"), re.MULTILINE):
            assert name in ("haltere.flight", "haltere.metrics", "haltere.report"), f"{path.name}: {name}"
