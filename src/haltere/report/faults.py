"""The section on faults: who was suspected and named when, and what would have become of the run without. It computes no results."""

from __future__ import annotations

from typing import Any

import numpy as np

from haltere.metrics.detection import STATE_CHANGES
from haltere.metrics.faults import apart
from haltere.report.context import Context, sensor_label
from haltere.report.markup import Section
from haltere.report.panels import FOOT, LEFT, TOP, Figure, Panels, plain
from haltere.report.style import AXES, SENSOR_COLOURS

__all__ = ["faults"]

#: Rows of the timeline of suspects at most.
ROWS = 14
UNITS = {"roll": "roll [deg]", "pitch": "pitch [deg]", "yaw": "yaw [deg]", "vel": "velocity [m/s]", "pos": "position [m]"}


def faults(c: Context) -> Section | None:
    """Faults that were found, as a timeline of suspects, and the run with and without the findings; None where nothing was found."""
    found = [e for e in c.solution.events if e["kind"] not in STATE_CHANGES and e.get("t_detected") is not None]
    if not found:
        return None
    section = Section(
        "faults", "Faults",
        "Thin: from the onset until the fault was told from others, for each that it may have been; thick: named, until it was over. "
        "Onset, size and evidence are in the table of events.",
        [_suspects(c, found)],
    )  # fmt: skip
    if c.solution.without is not None:
        section.figures.append(_without(c))
    return section


def _label(name: str) -> str:
    """A candidate in words: ``gyro.x`` as gyro x, ``imu.1.gyro.x`` as gyro x of imu.1."""
    unit, sensor, axis = "", name, ""
    parts = name.split(".")
    if len(parts) == 4:
        unit, sensor, axis = f" of {parts[0]}.{parts[1]}", parts[2], parts[3]
    elif len(parts) == 2:
        sensor, axis = parts
    return f"{sensor_label(sensor)} {axis}".strip() + unit


def _suspects(c: Context, found: list[dict[str, Any]]) -> Figure:
    labels: list[str] = []
    traces: list[dict[str, Any]] = []
    rows: list[tuple[float, float, str]] = []

    def bar(label: str, colour: str, start: float, end: float, width: int, text: str, word: str) -> None:
        if label not in labels:
            if len(labels) >= ROWS:
                return
            labels.append(label)
        end = max(end, start + 0.002 * (c.span[1] - c.span[0]))
        first = not any(t["name"] == word for t in traces)
        traces.append({
            "type": "scatter", "name": word, "legendgroup": word, "showlegend": first, "mode": "lines",
            "x": [round(start, 4), round(end, 4)], "y": [labels.index(label)] * 2, "text": [plain(text)] * 2,
            "line": {"color": f"@{colour}", "width": width},
            "hovertemplate": "%{text}<extra></extra>",
        })  # fmt: skip
        rows.append((round(start, 4), round(end, 4), plain(text)))

    for e in sorted(found, key=lambda e: float(e["t_detected"])):
        own = e["sensor"] + (f".{e['axis']}" if e.get("axis") is not None else "")
        seen, known, end = float(e["t_detected"]), e.get("t_isolated"), e.get("t_recovered")
        onset, over = float(e["t_onset"]) if e.get("t_onset") is not None else seen, c.span[1] if end is None else float(end)
        candidates = e.get("candidates") or [own]
        named = known is not None or len(candidates) == 1
        until = (seen if known is None else float(known)) if named else over
        for who in candidates:
            label = _label(who)
            colour = SENSOR_COLOURS.get(who.rsplit(".", 1)[0].rsplit(".", 1)[-1], "imu")
            bar(label, colour, onset, until, 4, f"{label}: {e['kind']}, suspected {onset:.2f} to {until:.2f} s", "suspected")
            if named:
                bar(label, colour, until, over, 13, f"{label}: {e['kind']}, named from {until:.2f} s. {e.get('evidence') or ''}", "named")
    n = len(labels)
    layout = {
        "margin": {"l": LEFT, "r": 12, "t": TOP, "b": FOOT}, "hovermode": "closest",
        "xaxis": {**AXES, "range": list(c.span), "title": {"text": "t [s]", "standoff": 4}, "hoverformat": ".3f"},
        "yaxis": {**AXES, "range": [n - 0.4, -0.6], "tickvals": list(range(n)), "ticktext": [plain(x) for x in labels], "showgrid": False,
                  "automargin": True, "fixedrange": True, "ticks": ""},
    }  # fmt: skip
    return {"name": "suspects", "traces": traces, "layout": layout, "height": 22 * n + 14 + FOOT + TOP, "time": True,
            "table": {"heads": ["from [s]", "to [s]", "what"], "rows": sorted(rows)}}  # fmt: skip


def _without(c: Context) -> Figure:
    assert c.solution.without is not None
    off = apart(c.solution, c.solution.without)
    names = [n for n in UNITS if n in off]
    panels = Panels("without", c.pool, c.span, [UNITS[n] for n in names], 112)
    panels.note_times(c.event_times)
    for k, name in enumerate(names):
        panels.line(
            k, "without the findings, less with them", "refused", off["t"], off[name], unit=UNITS[name].split("[")[1][:-1], width=1.4
        )
    figure = panels.figure()
    figure["title"] = "The same run with no inertial fault named: difference to the run shown"
    largest = {n: float(np.abs(off[n]).max()) for n in ("tilt", "yaw", "vel") if n in off}
    figure["reading"] = f"It would have come to differ by up to {largest['tilt']:.2g}° of tilt and {largest['yaw']:.2g}° of heading" + (
        f" and {largest['vel']:.2g} m/s." if "vel" in largest else "."
    )
    return figure
