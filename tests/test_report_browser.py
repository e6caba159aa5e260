"""The report in headless Chromium: everything drawn without a script error, linked, saved, legible, and on a phone."""

from __future__ import annotations

import base64
import csv
import io
import json
import re
import zlib

import numpy as np
import pytest

from haltere import drive
from haltere.report import page
from haltere.report.series import Pool
from report_page import browse, content, decode, demo, demo_page, made, numbers

#: Without the interfaces for three dimensions, so that the page must do without.
FLAT = "--disable-3d-apis"

DRAWN = """
  const { divs } = H;
  const flat = divs.filter((d) => H.figure(d).kind !== "3d");
  out.panels = flat.map((d) => d.querySelectorAll("svg.main-svg").length);
  out.lines = flat.map((d) => d.querySelectorAll("path.js-line, path.point, .js-fill, .heatmaplayer image, .bars path").length);
  out.wide = document.documentElement.scrollWidth - innerWidth;
  out.shades = flat.filter((d) => H.figure(d).time).map((d) => d.querySelectorAll(".layer-below path").length);
  const attitude = document.getElementById("figure-attitude");
  await Plotly.relayout(attitude, { "xaxis.range[0]": 10, "xaxis.range[1]": 12 });
  await until(() => H.shown);
  await H.settle();
  out.hash = location.hash;
  out.box = document.getElementById("window").textContent;
  const time = flat.filter((d) => H.figure(d).time);
  out.zoomed = time.map((d) => d.layout.xaxis.range.map(Number));
  const line = attitude.data.find((t) => t.name === "estimate");
  out.single = [line.mode, line.x.filter((t) => t >= 10 && t <= 12).length];
  const track = document.getElementById("figure-map").data.find((t) => t.name === "time shown");
  out.track = [track.customdata[0][0], track.customdata[track.customdata.length - 1][0]];
  await Plotly.relayout(attitude, { "xaxis.autorange": true });
  await until(() => !H.shown);
  await H.settle();
  out.whole = time.map((d) => d.layout.xaxis.range.map(Number));
  out.after = location.hash;
  document.dispatchEvent(new KeyboardEvent("keydown", { key: "+", bubbles: true }));
  out.key = H.shown;
  document.querySelector("#window button").click();
  out.reset = H.shown;
"""


def test_every_figure_is_drawn_without_script_errors_and_zooms_with_the_others() -> None:
    text = demo_page()
    data, found = browse(text, DRAWN)
    assert data["errors"] == "[]"
    assert len(found["panels"]) == len(numbers(text)) - 1 == int(data["drawn"])
    assert min(found["panels"]) >= 1
    assert min(found["lines"]) >= 1
    assert min(found["shades"]) >= 5, "four stretches of modes, one of them twice for its being disarmed"
    assert found["wide"] <= 0
    assert all(r == [10, 12] for r in found["zoomed"])
    assert found["hash"] == "#t=10.000-12.000"
    assert "10.0 to 12.0 s" in found["box"]
    assert 10.0 <= found["track"][0] < 10.1
    assert 11.9 < found["track"][1] <= 12.0
    assert found["single"][0] in ("lines", "lines+markers")
    assert found["single"][1] == pytest.approx(200, abs=2), "every sample of 100 Hz"
    assert len({tuple(r) for r in found["whole"]}) == 1
    assert found["whole"][0] != [10, 12]
    assert found["after"] == ""
    span = content(text)["span"]
    assert found["key"][1] - found["key"][0] == pytest.approx(0.5 * (span[1] - span[0]))
    assert found["reset"] is None


def test_the_address_opens_a_window_and_pointing_shows_one_moment_everywhere() -> None:
    probe = """
      out.shown = H.shown;
      const timeline = document.getElementById("figure-timeline"), attitude = document.getElementById("figure-attitude");
      out.ranges = H.divs.filter((d) => H.figure(d).time).map((d) => d.layout.xaxis.range.map(Number));
      document.documentElement.style.scrollBehavior = "auto";
      timeline.scrollIntoView();
      await pause(200);
      const hair = (d) => d.parentElement.querySelector(".hair");
      timeline.emit("plotly_hover", { xvals: [6.5], points: [], event: {} });
      await until(() => !hair(timeline).hidden);
      out.near = H.divs.filter((d) => H.figure(d).time && H.nearby(d, 0)).map((d) => !hair(d).hidden);
      const axis = timeline._fullLayout.xaxis;
      out.off = parseFloat(hair(timeline).style.left) - axis._offset - axis.l2p(6.5);
      await until(() => attitude.querySelector(".hoverlayer").textContent.includes("6.5"));
      out.label = attitude.querySelector(".hoverlayer").textContent;
      timeline.emit("plotly_unhover", { event: {} });
      await until(() => hair(timeline).hidden);
      out.hidden = hair(timeline).hidden && hair(attitude).hidden;
    """
    data, found = browse(demo_page(), probe, hash_="#t=5-8.5")
    assert data["errors"] == "[]"
    assert found["shown"] == [5, 8.5]
    assert all(r == [5, 8.5] for r in found["ranges"])
    assert len(found["near"]) >= 2
    assert all(found["near"])
    assert abs(found["off"]) < 0.01
    assert "estimate" in found["label"], "the values of the plots beside are shown"
    assert found["hidden"]


def test_an_address_of_no_time_of_the_flight_opens_the_whole() -> None:
    probe = """
      out.shown = [H.shown];
      for (const address of ["#t=-9--5", "#t=8-5", "#t=nan-3", "#map"]) {
        location.hash = address;
        await pause(100);
        out.shown.push(H.shown);
      }
      location.hash = "#t=5-8";
      await until(() => H.shown);
      out.shown.push(H.shown);
    """
    data, found = browse(demo_page(), probe, hash_="#t=500-600")
    assert data["errors"] == "[]"
    assert found["shown"] == [None] * 5 + [[5, 8]]


def test_data_are_saved_as_csv_in_the_window_shown() -> None:
    probe = """
      const saved = [];
      URL.createObjectURL = (blob) => { saved.push(blob); return "blob:kept"; };
      HTMLAnchorElement.prototype.click = function () { out.name = this.download; };
      await H.show([20, 21]);
      const buttons = (name) => [...document.getElementById(name).parentElement.querySelectorAll("button")];
      const press = (name) => buttons(name).find((b) => b.textContent === "CSV").click();
      press("figure-velocity");
      out.file = out.name;
      for (const name of ["figure-map", "figure-timeline", "figure-innovations_gnss"]) press(name);
      [out.velocity, out.map, out.timeline, out.innovations] = await Promise.all(saved.map((b) => b.text()));
      out.type = saved[0].type;
    """
    data, found = browse(demo_page(), probe)
    assert data["errors"] == "[]"
    assert found["file"] == "velocity.csv"
    assert found["type"].startswith("text/csv")
    solution, _ = demo()
    rows = list(csv.DictReader(io.StringIO(found["velocity"])))
    head = list(rows[0])
    assert head[0] == "t [s]"
    assert {"estimate north [m/s]", "estimate 1σ north [m/s]", "truth east [m/s]", "GNSS down [m/s]"} <= set(head)
    t = np.array([float(r["t [s]"]) for r in rows])
    assert np.all(np.diff(t) > 0.0)
    assert t[0] >= 20.0
    assert t[-1] <= 21.0
    inside = (solution.t >= 20.0) & (solution.t <= 21.0)
    north = np.array([float(r["estimate north [m/s]"]) for r in rows if r["estimate north [m/s]"]])
    sd = np.array([float(r["estimate 1σ north [m/s]"]) for r in rows if r["estimate 1σ north [m/s]"]])
    assert np.allclose(north, solution["vel_n"][inside], atol=1e-3)
    assert np.allclose(sd, solution["sd_vel_n"][inside], atol=1e-3)
    track = list(csv.DictReader(io.StringIO(found["map"])))
    east = np.array([float(r["estimate east [m]"]) for r in track if r["estimate east [m]"]])
    assert np.allclose(east, solution["pos_e"][inside], atol=1e-3)
    stretches = list(csv.DictReader(io.StringIO(found["timeline"])))
    assert any(r["what"].startswith("mode Loiter: 12.00 to 26.00 s") for r in stretches)
    assert all(float(r["to [s]"]) >= 20.0 and float(r["from [s]"]) <= 21.0 for r in stretches)
    assert "innovation vel. north [m/s]" in found["innovations"].splitlines()[0]


def test_pictures_are_saved() -> None:
    probe = """
      out.saved = [];
      HTMLAnchorElement.prototype.click = function () { out.saved.push(this.download); };
      for (const format of ["svg", "png"]) await H.savePicture(document.getElementById("figure-attitude"), format);
      const size = { format: "svg", width: 600, height: 400 };
      out.svg = decodeURIComponent(await Plotly.toImage(document.getElementById("figure-attitude"), size));
    """
    data, found = browse(demo_page(), probe)
    assert data["errors"] == "[]"
    assert found["saved"] == ["attitude.svg", "attitude.png"]
    assert "roll [deg]" in found["svg"]


VIEW = """
  const root = document.documentElement, view = document.getElementById("figure-view");
  root.style.scrollBehavior = "auto";
  out.before = [root.dataset.view, H.drawn.has(view)];
  view.scrollIntoView();
  await until(() => root.dataset.view !== "waiting");
  out.view = root.dataset.view;
  out.text = view.textContent;
  out.webgl = Boolean(document.createElement("canvas").getContext("webgl"));
"""


def test_the_view_in_three_dimensions_says_what_it_needs() -> None:
    data, found = browse(demo_page(), VIEW, FLAT, "--disable-gpu")
    assert data["errors"] == "[]"
    assert found["before"] == ["waiting", False]
    assert found["view"] == "needs WebGL"
    assert "needs WebGL" in found["text"]


@pytest.mark.parametrize("estimator", ["navigator", "ahrs"])
def test_the_airframe_stands_as_the_solution_says(estimator: str) -> None:
    probe = (
        VIEW
        + """
      if (out.view !== "drawn") return;
      const read = () => [view.parentElement.querySelector("output").textContent, view.data.slice(-3).map((t) => [t.x, t.y, t.z])];
      const slider = view.parentElement.querySelector("input");
      slider.value = "17.5";
      slider.dispatchEvent(new Event("input"));
      await until(() => read()[0].startsWith("t = 17.50"));
      await pause(500);
      out.pose = read();
      out.ranges = ["xaxis", "yaxis", "zaxis"].map((a) => view.layout.scene[a].range);
      out.aspect = view.layout.scene.aspectratio;
      const vertical = document.getElementById("figure-attitude");
      H.pointAt(8, vertical);
      await until(() => read()[0].startsWith("t = 8.00"));
      out.followed = read()[0];
      out.csv = H.csv(view).split("\\n", 1)[0];
    """
    )
    solution, flight = demo()
    text = demo_page() if estimator == "navigator" else page(drive.run(flight, "ahrs"), flight)
    data, found = browse(text, probe, "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    assert data["errors"] == "[]"
    if not found["webgl"]:
        pytest.skip("this Chromium has no WebGL in software")
    assert found["view"] == "drawn"
    said, (_, nose, belly) = found["pose"]
    angles = [float(v) for v in re.findall(r"(?:roll|pitch|yaw) (-?[\d.]+)°", said)]
    from haltere.metrics.attitude import euler

    solution = solution if estimator == "navigator" else drive.run(flight, "ahrs")
    k = int(np.argmin(np.abs(solution.t - 17.5)))
    q = solution.vector("q", "wxyz")[k : k + 1]
    assert np.allclose(angles, np.degrees(euler(q))[0], atol=0.5)
    # The nose from the centre, turned by the quaternion itself: q (1, 0, 0) q*, north, east, down.
    w, x, y, z = q[0]
    forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    down = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    for line, axis in ((nose, forward), (belly, down)):
        ends = np.array([[c[0] for c in line], [c[1] for c in line]], float)
        way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        assert np.allclose(way, [axis[1], axis[0], -axis[2]], atol=0.01)
    if estimator == "navigator":
        north, east, down_ = (float(v) for v in re.search(r"north (\S+) m, east (\S+) m, height (\S+) m", said).groups())  # type: ignore[union-attr]
        assert np.allclose([north, east, -down_], solution.vector("pos", "ned")[k], atol=0.1)
        spans = np.array([r[1] - r[0] for r in found["ranges"]])
        assert np.allclose(spans / spans[0], np.array([found["aspect"][a] for a in "xyz"]) / found["aspect"]["x"])
    assert found["followed"].startswith("t = 8.00")
    assert found["csv"].startswith("t [s],GNSS fixes north [m]" if estimator == "navigator" else "t [s],roll [deg],pitch [deg],yaw [deg]")


PHONE = """
  const root = document.documentElement;
  out.wide = root.scrollWidth - innerWidth;
  out.width = innerWidth;
  out.order = ["verdict", "facts", "map", "timeline"].map((id) => document.getElementById(id).getBoundingClientRect().top);
  out.right = H.divs.map((d) => d.getBoundingClientRect().right);
  out.tools = [...document.querySelectorAll(".tools")].map((d) => getComputedStyle(d).display);
  const menu = document.getElementById("menu"), links = document.querySelector(".links");
  out.closed = getComputedStyle(links).display;
  menu.click();
  out.open = getComputedStyle(links).display;
  out.text = getComputedStyle(document.querySelector("#figure-attitude .ytick text")).fill;
  out.page = getComputedStyle(document.body).backgroundColor;
  out.legends = H.divs.map((d) => {
    const legend = d.querySelector(".legend"), box = d.getBoundingClientRect();
    return legend ? legend.getBoundingClientRect().right - box.right : 0;
  });
"""


def test_dark_page_is_legible_and_a_phone_needs_no_sideways_scrolling() -> None:
    data, found = browse(demo_page(), PHONE, "--disable-gpu", "--blink-settings=preferredColorScheme=0", size="500,900")
    assert data["errors"] == "[]"
    assert found["width"] <= 500
    assert found["wide"] <= 0
    assert found["order"] == sorted(found["order"])
    assert len(set(found["order"])) == 4
    assert max(found["right"]) <= found["width"]
    assert max(found["legends"]) <= 1.0
    assert set(found["tools"]) == {"flex"}
    assert found["closed"] == "none"
    assert found["open"] == "grid"
    from test_report import contrast

    ground, ink = (np.array([float(x) for x in re.findall(r"\d+", found[k])[:3]]) for k in ("page", "text"))
    assert ground.max() < 60.0
    assert contrast(ink, ground) > 7.0


def test_the_first_screen_holds_verdict_facts_map_and_timeline() -> None:
    probe = """
      out.high = innerHeight;
      const box = (id) => { const b = document.getElementById(id).getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; };
      for (const id of ["verdict", "facts", "figure-map", "figure-timeline"]) out[id] = box(id);
      out.columns = innerWidth;
    """
    _, found = browse(demo_page(), probe, size="1440,1043")  # the frame of the window is part of the size
    assert 800 <= found["high"] <= 900
    for part in ("verdict", "facts", "figure-map", "figure-timeline"):
        assert found[part][3] <= found["high"], part
        assert found[part][1] >= 0
    assert found["figure-map"][0] > found["verdict"][2], "side by side"


def test_paper_gets_every_plot_in_light_colours() -> None:
    probe = """
      H.root.style.scrollBehavior = "auto";
      dispatchEvent(new Event("beforeprint"));
      out.widths = H.divs.filter((d) => H.figure(d).kind !== "3d").map((d) => d.querySelector("svg.main-svg").clientWidth);
      out.ink = document.querySelector("#figure-attitude .ytick text").style.fill;
      out.open = [...document.querySelectorAll("details.more")].every((d) => d.open);
      dispatchEvent(new Event("afterprint"));
      await until(() => document.querySelector("#figure-attitude .ytick text").style.fill !== out.ink);
      out.again = document.querySelector("#figure-attitude .ytick text").style.fill;
      out.closed = [...document.querySelectorAll("details.more")].some((d) => d.open);
    """
    data, found = browse(demo_page(), probe, "--disable-gpu", "--blink-settings=preferredColorScheme=0")
    assert data["errors"] == "[]"
    assert set(found["widths"]) == {700}
    assert found["ink"] == "rgb(27, 31, 36)"
    assert found["again"] != found["ink"]
    assert found["open"]
    assert not found["closed"]


def test_the_browser_reads_the_numbers_as_they_are() -> None:
    rng = np.random.default_rng(5)
    pool = Pool()
    kept = [
        rng.normal(0.0, 1e9, 50), np.cumsum(rng.normal(0.0, 1.0, 3000)), np.r_[np.nan, 1.0, np.nan, np.nan, -2.0], np.array([]),
        np.full(4, np.nan), np.array([1e30, -1e30, 1.0]), np.arange(900.0) * 0.004,
    ]  # fmt: skip
    for values in kept:
        pool.add(values)
    metas, data = pool.packed()
    mine = decode(metas, zlib.decompress(data, -15))
    probe = f"""
      const bytes = Uint8Array.from(atob("{base64.b64encode(data).decode()}"), (c) => c.charCodeAt(0));
      const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
      const raw = new Uint8Array(await new Response(stream).arrayBuffer());
      out.arrays = H.decode({json.dumps(metas)}, raw).map(({{ v, s }}) => Array.from(v, (x) => (Number.isNaN(x) ? null : x / s)));
    """
    _, found = browse(demo_page(), probe)
    for ours, theirs, values in zip(mine, found["arrays"], kept, strict=True):
        seen = np.array([np.nan if v is None else v for v in theirs], float)
        assert np.allclose(seen, ours, rtol=1e-15, atol=0.0, equal_nan=True)
        assert np.allclose(seen, values, rtol=1e-14, atol=max(5.1e-4, 1e-14 * np.nanmax(np.abs(values), initial=0.0)), equal_nan=True)


def test_a_long_flight_is_thinned_for_the_screen_only() -> None:
    solution, flight = made(np.arange(0.0, 400.0, 0.01), np.random.default_rng(2), 5.0)
    solution.table["vel_n"][12_345] = 300.0
    probe = """
      const velocity = document.getElementById("figure-velocity");
      const line = () => velocity.data.find((t) => t.name === "estimate");
      const width = velocity._fullLayout._size.w;
      out.points = line().x.length / width;
      out.spike = Math.max(...line().y.filter((v) => v !== null));
      await H.show([123.4, 123.5]);
      await H.settle();
      out.near = line().x.filter((t) => t >= 123.4 && t <= 123.5).length;
      out.mode = line().mode;
      out.fine = velocity.parentElement.querySelector(".fine").textContent;
    """
    text = page(solution, flight)
    data, found = browse(text, probe)
    assert data["errors"] == "[]"
    assert 1.0 < found["points"] < 2.7
    assert found["spike"] == pytest.approx(300.0)
    trace = next(t for t in numbers(text)["velocity"]["traces"] if t["name"] == "estimate")
    stored = np.count_nonzero((trace["x"] >= 123.4) & (trace["x"] <= 123.5))
    assert found["near"] == stored
    assert stored >= 2
    assert found["mode"] == "lines+markers"
    assert "every sample" in found["fine"]


def test_a_script_error_is_kept_for_reading() -> None:
    text = demo_page().replace("H.startTime();", "H.startTime(); setTimeout(() => { throw new Error('on purpose'); });")
    data, _ = browse(text, "")
    assert "on purpose" in data["errors"]
