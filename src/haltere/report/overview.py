"""Track from above and the timeline of what was used, refused and happened. It computes no results."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.metrics.errors import reference_position
from haltere.report.context import Context, covered, sensor_label
from haltere.report.markup import Section
from haltere.report.panels import FOOT, LEFT, TOP, pen, plain
from haltere.report.style import AXES, SENSOR_COLOURS

__all__ = ["fixes", "shades", "timeline", "track"]

FloatArray = NDArray[np.float64]
#: Opacity of the shade of a flight mode, and of what is not armed.
SHADE, DISARMED = 0.12, 0.1


def track(c: Context) -> Section:
    """The flight from above in metres, north up."""
    section = Section("map", "Map")
    if "pos_n" not in c.solution:
        section.note = f"Not drawn: {c.solution.config.estimator} estimates attitude only, so there is no map, no velocity and no position."
        return section
    if not c.held_by_measurement:
        section.note = "Not drawn: no GNSS position was let in, so where the vehicle flew is not known."
        return section
    traces: list[dict[str, Any]] = []
    points: list[tuple[FloatArray, FloatArray]] = []

    def add(label: str, colour: str, t: FloatArray, p: FloatArray, dots: bool) -> list[int]:
        ids = c.pool.series(t, list(p.T), [1e-3] * 3, even=True, weight=2.0)
        if not ids:
            return ids
        good = np.isfinite(p[:, :2]).all(axis=1)
        points.append((p[good, 0], p[good, 1]))
        look = {"marker": {"size": 4, "color": f"@{colour}"}} if dots else {"line": pen(colour, 2.2 if colour == "estimate" else 1.2)}
        traces.append({
            "type": "scatter", "name": label, "$track": {"ids": ids}, "mode": "markers" if dots else "lines", **look,
            "hovertemplate": "N %{y:.2f} m, E %{x:.2f} m, D %{customdata[1]:.2f} m<br>t = %{customdata[0]:.2f} s",
        })  # fmt: skip
        return ids

    add("GNSS fixes", "gnss", *fixes(c), True)
    ids = add("estimate", "estimate", c.solution.t, c.solution.vector("pos", "ned"), False)
    for name, stream in c.references:
        add(name, name, *reference_position(stream, list(c.origin) if c.origin else None), False)
    if ids:
        window = {"color": "@event", "width": 5}
        traces.append({"type": "scatter", "name": "time shown", "$track": {"ids": ids, "window": True}, "mode": "lines", "line": window,
                       "opacity": 0.55, "hoverinfo": "skip"})  # fmt: skip
    middle, half = _frame(points)
    ends = c.solution.vector("pos", "ned")[[0, -1]]
    inwards = ["left" if east > middle[1] else "right" for east in ends[:, 1]]
    traces.append({
        "type": "scatter", "name": "start and end", "x": ends[:, 1].tolist(), "y": ends[:, 0].tolist(), "mode": "markers+text",
        "text": ["start", "end"],
        "textposition": [f"{v} {h}" for v, h in zip(("top", "bottom"), inwards, strict=True)],
        "textfont": {"color": "@text"}, "hoverinfo": "skip",
        "marker": {"size": 10, "symbol": ["circle-open", "square-open"], "color": "@text", "line": {"width": 2}},
    })  # fmt: skip
    _mark_events(c, traces)
    axis = {**AXES, "zeroline": True, "nticks": 8}
    layout = {
        "margin": {"l": LEFT, "r": 12, "t": TOP, "b": FOOT}, "hovermode": "closest",
        "xaxis": {**axis, "title": {"text": "east [m]", "standoff": 4}, "range": [middle[1] - half, middle[1] + half],
                  "constrain": "domain"},
        "yaxis": {**axis, "title": {"text": "north [m]", "standoff": 6}, "range": [middle[0] - half, middle[0] + half], "scaleanchor": "x",
                  "constrain": "domain"},
    }  # fmt: skip
    figure = {"name": "map", "traces": traces, "layout": layout, "height": 430, "time": False}
    section.figures.append(figure | ({"windowed": {"ids": ids}} if ids else {}))
    return section


def fixes(c: Context) -> tuple[FloatArray, FloatArray]:
    """Times and north, east, down [m] of the GNSS positions, (n,) and (n, 3)."""
    components = [c.measured(f"pos_{a}") for a in "ned"]
    if len({len(t) for t, _ in components}) > 1:
        return np.empty(0), np.empty((0, 3))
    return components[0][0], np.column_stack([v for _, v in components])


def _frame(points: list[tuple[FloatArray, FloatArray]]) -> tuple[tuple[float, float], float]:
    """Middle (north, east) and half the side of a square that holds all points."""
    north, east = (np.concatenate([p[k] for p in points]) for k in (0, 1))
    middle = (0.5 * float(north.min() + north.max()), 0.5 * float(east.min() + east.max()))
    half = 0.5 * max(float(np.ptp(north)), float(np.ptp(east)), 2.0)
    return middle, 1.08 * half


def _mark_events(c: Context, traces: list[dict[str, Any]]) -> None:
    """Where the vehicle was when something happened."""
    times = np.array([t for t in c.event_times if c.solution.t[0] <= t <= c.solution.t[-1]])
    if len(times) == 0:
        return
    north, east = (np.interp(times, c.solution.t, c.solution[f"pos_{a}"]) for a in "ne")
    words = {round(float(e["t_onset"] or 0.0), 6): f"{sensor_label(e['sensor'])}: {e['kind']}" for e in c.solution.events}
    traces.append({
        "type": "scatter", "name": "event", "x": east.tolist(), "y": north.tolist(), "mode": "markers",
        "text": [plain(words.get(round(float(t), 6), "event")) for t in times], "customdata": times.tolist(),
        "marker": {"symbol": "star", "size": 10, "color": "@event"}, "hovertemplate": "%{text}<br>t = %{customdata:.2f} s",
    })  # fmt: skip


def timeline(c: Context) -> Section:
    """When each sensor was used, when refused, and what happened."""
    aids = c.solution.aids
    rows: list[tuple[str, str, FloatArray]] = []
    if "imu" in c.flight:
        rows.append(("IMU", "imu", c.flight["imu"].t))
    for sensor in c.sensors:
        mine = aids["sensor"] == sensor
        if mine.any():
            used = mine & (aids["status"] != "rejected")
            rows.append((sensor_label(sensor), SENSOR_COLOURS.get(sensor, "assumed"), np.unique(aids["t"][used])))
    labels = [r[0] for r in rows]
    traces: list[dict[str, Any]] = []
    for k, (label, colour, t) in enumerate(rows):
        starts, ends = covered(t)
        if len(starts) > 600:  # a stream of nothing but holes: one bar says as much
            starts, ends = starts[:1], ends[-1:]
        text = [f"{plain(label)}: {a:.2f} to {b:.2f} s" for a, b in zip(starts, ends, strict=True)]
        traces.append(_bars(c, k, starts, ends, f"@{colour}", text, "used", 12, False))
    named: set[str] = set()
    for status, colour, word in (("deweighted", "deweighted", "de-weighted"), ("rejected", "refused", "refused")):
        for label in labels:
            mine = [e for e in c.episodes if e.status == status and sensor_label(e.sensor) == label][:400]
            if mine:
                text = [f"{plain(label)} {e.what} {word} {e.n} times, {e.start:.2f} to {e.end:.2f} s{_why(e.reasons)}" for e in mine]
                starts, ends = np.array([e.start for e in mine]), np.array([e.end for e in mine])
                traces.append(_bars(c, labels.index(label), starts, ends, f"@{colour}", text, word, 7, word not in named))
                named.add(word)
    _modes(c, labels, traces)
    happened = [e for e in c.solution.events if e.get("t_onset") is not None]
    if happened:
        labels.append("events")
        traces.append({
            "type": "scatter", "name": "event", "mode": "markers", "x": [float(e["t_onset"]) for e in happened],
            "y": [len(labels) - 1] * len(happened),
            "marker": {"symbol": "star", "size": 11, "color": "@event"}, "hovertemplate": "t = %{x:.2f} s: %{text}", "showlegend": False,
            "text": (told := [plain(f"{sensor_label(e['sensor'])}: {e['kind']}. {e.get('evidence') or ''}") for e in happened]),
            "rows": [(float(e["t_onset"]), float(e["t_onset"]), text) for e, text in zip(happened, told, strict=True)],
        })  # fmt: skip
    n = len(labels)
    height = 19 * n + 10 + FOOT + TOP
    layout = {
        "margin": {"l": LEFT, "r": 12, "t": TOP, "b": FOOT}, "hovermode": "closest",
        "xaxis": {**AXES, "range": list(c.span), "title": {"text": "t [s]", "standoff": 4}, "hoverformat": ".3f"},
        "yaxis": {**AXES, "range": [n - 0.4, -0.6], "tickvals": list(range(n)), "ticktext": [plain(x) for x in labels], "showgrid": False,
                  "automargin": True, "fixedrange": True, "ticks": ""},
    }  # fmt: skip
    note = "Thick: used; inside: refused or de-weighted; stars: events"
    note += "; shades, behind all plots: flight modes, grey while disarmed." if shades(c) else "."
    rows = [row for trace in traces for row in trace.pop("rows", [])]
    figure = {"name": "timeline", "traces": traces, "layout": layout, "height": height, "time": True,
              "table": {"heads": ["from [s]", "to [s]", "what"], "rows": sorted(rows)}}  # fmt: skip
    return Section("timeline", "Timeline", note, [figure])


def _modes(c: Context, labels: list[str], traces: list[dict[str, Any]]) -> None:
    """Rows of flight modes and of arming, named where there is room."""
    named = [m for m in c.modes if m.name]
    if named:
        labels.append("mode")
        row = len(labels) - 1
        for name, colour in c.mode_colours.items():
            mine = [m for m in named if m.name == name]
            first, last = np.array([m.start for m in mine]), np.array([m.end for m in mine])
            texts = [f"mode {plain(name)}: {m.start:.2f} to {m.end:.2f} s" for m in mine]
            traces.append(_bars(c, row, first, last, f"@{colour}/0.5", texts, "mode", 15, False))
        since, until, names = [m.start for m in named], [m.end for m in named], [plain(m.name) for m in named]
        stretches = {"starts": since, "ends": until, "names": names, "row": row}
        traces.append({
            "type": "scatter", "name": "mode", "mode": "text", "$labels": stretches, "textfont": {"size": 11, "color": "@text"},
            "hoverinfo": "skip", "showlegend": False,
        })  # fmt: skip
    armed = [m for m in c.modes if m.armed]
    if any(m.armed is not None for m in c.modes):
        labels.append("armed")
        starts: FloatArray = np.array([m.start for m in armed])
        ends: FloatArray = np.array([m.end for m in armed])
        apart = np.flatnonzero(starts[1:] > ends[:-1]) + 1
        if armed:
            starts, ends = starts[np.r_[0, apart]], ends[np.r_[apart - 1, len(ends) - 1]]
        rest = [m for m in c.modes if m.armed is False]
        texts = [f"not armed: {m.start:.2f} to {m.end:.2f} s" for m in rest]
        before, after = np.array([m.start for m in rest]), np.array([m.end for m in rest])
        traces.append(_bars(c, len(labels) - 1, before, after, "@disarmed/0.35", texts, "not armed", 4, False))
        texts = [f"armed: {a:.2f} to {b:.2f} s" for a, b in zip(starts, ends, strict=True)]
        traces.append(_bars(c, len(labels) - 1, starts, ends, "@armed", texts, "armed", 12, False))


def shades(c: Context) -> list[tuple[float, float, str]]:
    """What is shaded behind every plot over time: each flight mode, and over it where the vehicle was not armed.

    Nothing where neither changes: a shade of the whole plot would only make it harder to read.
    """
    if len({(m.name, m.armed) for m in c.modes}) < 2:
        return []
    modes = [(m.start, m.end, f"@{c.mode_colours[m.name]}/{SHADE}") for m in c.modes if m.name]
    return [*modes, *((m.start, m.end, f"@disarmed/{DISARMED}") for m in c.modes if m.armed is False)]


def _why(reasons: tuple[str, ...]) -> str:
    return f" ({', '.join(reasons)})" if reasons else ""


def _bars(
    c: Context, row: int, starts: FloatArray, ends: FloatArray, colour: str, text: list[str], label: str, width: int, legend: bool
) -> dict[str, Any]:
    """Horizontal bars in one trace; the shortest are wide enough to be seen."""
    least = 0.002 * (c.span[1] - c.span[0])
    x: list[float | None] = []
    texts: list[str | None] = []
    for a, b, words in zip(starts.tolist(), ends.tolist(), text, strict=True):
        x += [round(a, 4), round(max(b, a + least), 4), None]
        texts += [words, words, None]
    rows = [(round(a, 4), round(b, 4), words) for a, b, words in zip(starts.tolist(), ends.tolist(), text, strict=True)]
    return {
        "rows": rows,
        "type": "scatter", "name": label, "legendgroup": label, "showlegend": legend, "mode": "lines", "x": x, "y": [row] * len(x),
        "text": texts, "line": {"color": colour, "width": width}, "hovertemplate": "%{text}<extra></extra>",
    }  # fmt: skip
