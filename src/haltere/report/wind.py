"""The section on wind: verdict, speed and direction over time, rose, profile over height, means, drag. It computes no results."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.solution import Solution
from haltere.metrics.wind import BLOCK, SECTORS, Profile, Rose, WindSeries, blocks, components, direction_from, profile, rose, wind_series
from haltere.report.context import Context
from haltere.report.grid import Grid
from haltere.report.markup import Section, escape, table
from haltere.report.panels import TOP, Figure, Panels
from haltere.report.words import number, wind_in_words

__all__ = ["wind"]

FloatArray = NDArray[np.float64]
DEG = 180.0 / math.pi
NAMES = {"n": "north", "e": "east", "d": "down"}
#: Corners of the compass, every 45 degrees from north.
COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
#: Below this a reference's wind has no direction worth a line [m/s].
STILL = 0.05
LEVELS = {"good": "good", "usable": "doubtful", "poor": "bad", "not observable": "bad"}
#: Coefficients estimated together with the wind: column, title of its panel, factor.
COEFFICIENTS = (
    ("drag_mu", "rotor drag [1/s]", 1.0), ("drag_c", "body drag [1/m]", 1.0),
    ("drag_offset_x", "offset x [m/s²]", 1.0), ("drag_offset_y", "offset y [m/s²]", 1.0), ("airspeed_scale", "airspeed [1]", 1.0),
    ("aoa_offset", "attack [deg]", DEG), ("sideslip_offset", "sideslip [deg]", DEG),
)  # fmt: skip
#: What is estimated of air data.
PARTS = {
    "airspeed_scale": "the airspeed its scale",
    "aoa_offset": "the angle of attack its offset",
    "sideslip_offset": "the sideslip its offset",
}
CONVENTION = (
    "Speed of the air over ground. The direction is the one the wind comes from, clockwise from true north, as weather reports give it; "
    "components, here and in every file, are of the velocity of the air: where it blows to."
)


def wind(c: Context) -> Section | None:
    """Wind of a solution, where it has one, with the autopilot's and the true one beside it."""
    w = wind_series(c.solution, c.flight)
    if w is None:
        return None
    section = Section("wind", "Wind", CONVENTION)
    said = c.solution.summary.get("wind", {})
    section.before = _verdict(said)
    section.figures = [_speed(c, w), _components(c)]
    r, p = rose(w), profile(w)
    if r is not None and r.share.any():
        section.figures.append(_rose(r))
    if p is not None:
        section.figures.append(_profile(p))
    coefficients = [k for k in COEFFICIENTS if k[0] in c.solution]
    if coefficients:
        section.figures.append(_coefficients(c, coefficients))
    section.after = _means(said) + _differences(said)
    return section


def _verdict(said: dict[str, Any]) -> str:
    """The verdict first, with its reasons."""
    if not said:
        return ""
    reasons = "".join(f"<li>{escape(why)}</li>" for why in said["why"])
    return (
        f'<div class="verdict {LEVELS[said["verdict"]]}"><p class="headline"><span class="badge">wind {escape(said["verdict"])}</span> '
        f"{escape(wind_in_words(said) or 'none in flight')}</p><ul>{reasons}</ul></div>"
    )


def _lines(c: Context, w: WindSeries) -> list[tuple[str, str, WindSeries | None, FloatArray, FloatArray]]:
    """Label, colour, series of ours where it is, times and components of every wind to be drawn."""
    out: list[tuple[str, str, WindSeries | None, FloatArray, FloatArray]] = []
    given = c.flight.get("wind")
    others = [(("autopilot's" if name == "onboard" else name), name, stream) for name, stream in c.references]
    if given is not None and len(given):
        others.append(("given", "assumed", given))
    for label, colour, stream in others:
        if components(stream):
            out.append((label, colour, None, stream.t, stream.vector("wind", "ne")))
    out.append(("estimate", "estimate", w, w.t, w.wind))
    s = c.solution.smoothed
    smoothed = wind_series(s, c.flight) if s is not None else None
    if smoothed is not None:
        out.append(("smoothed", "smoothed", smoothed, smoothed.t, smoothed.wind))
    return out


def _speed(c: Context, w: WindSeries) -> Figure:
    """Speed and direction over time, with 1 sigma, and means."""
    panels = Panels("wind", c.pool, c.span, ["speed [m/s]", "comes from [deg]"], 190)
    panels.note_times(c.event_times)
    lines = _lines(c, w)
    known = [direction_from(x[:, 0], x[:, 1])[np.hypot(x[:, 0], x[:, 1]) > STILL] for *_, x in lines]
    about = _about([DEG * d for d in known])
    for label, colour, mine, t, x in lines:
        speed = np.hypot(x[:, 0], x[:, 1])
        width = 1.9 if mine is w else 1.3
        if mine is None:
            direction, sd, sd_speed = np.where(speed > STILL, direction_from(x[:, 0], x[:, 1]), np.nan), None, None
        else:
            direction, sd, sd_speed = mine.direction, DEG * mine.direction_sd, mine.speed_sd
            sd, sd_speed = (None if not np.isfinite(v).any() else v for v in (sd, sd_speed))
        panels.line(0, label, colour, t, speed, sd_speed, unit="m/s", width=width, slow=True)
        panels.line(
            1, label, colour, t, DEG * direction, sd, unit="deg", period=360.0, about=about, width=width, slow=True, resolution=0.01
        )
    means = blocks(w)
    if means:
        t = np.array([b.t for b in means])
        label = f"mean of {BLOCK:.0f} s"
        panels.markers(0, label, "text", t, np.array([b.speed for b in means]), symbol="diamond-open", size=8, unit="m/s")
        turns = DEG * np.array([b.direction for b in means])
        turns = np.where(np.hypot(*np.array([b.wind for b in means]).T) > STILL, turns, np.nan)
        panels.markers(
            1, label, "text", t, turns - 360.0 * np.floor((turns - about) / 360.0 + 0.5), symbol="diamond-open", size=8, unit="deg"
        )
    low, high = panels.extent[0]
    panels.extent[0] = (0.0 if low < 1.0 else low, high)  # a band may reach below zero, a speed does not
    figure = panels.figure()
    _compass(figure["layout"]["yaxis2"], about)
    figure["reading"] = "The band is 1σ, first order. Where no direction is drawn the wind is weaker than its own uncertainty." + (
        " Negative degrees count from north towards west." if about == 0.0 and panels.extent[1][0] < 0.0 else ""
    )
    return figure


def _about(directions: list[FloatArray]) -> float:
    """Middle [deg] of the axis of directions: south, or north where the winds turn over north more often than over south."""
    jumps = [0, 0]
    for d in directions:
        for k, middle in enumerate((180.0, 0.0)):
            shown = d - 360.0 * np.floor((d - middle) / 360.0 + 0.5)
            jumps[k] += int(np.count_nonzero(np.abs(np.diff(shown)) > 180.0))
    return 180.0 if jumps[0] <= jumps[1] else 0.0


def _compass(axis: dict[str, Any], about: float) -> None:
    """Corners of the compass on an axis of directions."""
    low, high = axis.get("range", (about - 180.0, about + 180.0))
    low, high = max(low, about - 185.0), min(high, about + 185.0)
    axis["range"] = [low, high]
    if high - low < 25.0:
        return
    step = 90.0 if high - low > 200.0 else 45.0 if high - low > 70.0 else 15.0
    values = np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step
    axis["tickvals"] = values.tolist()
    axis["ticktext"] = [f"{COMPASS[round(v / 45.0) % 8]} {v % 360.0:.0f}" if v % 45.0 == 0.0 else f"{v % 360.0:.0f}" for v in values]


def _components(c: Context) -> Figure:
    """Components with 1 sigma, over the autopilot's and the true ones."""
    axes = components(c.solution)
    panels = Panels("wind_components", c.pool, c.span, [f"{NAMES[a]} [m/s]" for a in axes], 112)
    panels.note_times(c.event_times)
    s, given = c.solution.smoothed, c.flight.get("wind")
    for k, a in enumerate(axes):
        name = f"wind_{a}"
        for label, stream in c.references:
            panels.line(k, "autopilot's" if label == "onboard" else label, label, stream.t, stream.get(name), unit="m/s", width=1.0)
        if given is not None and len(given):
            panels.line(k, "given", "assumed", given.t, given.get(name), unit="m/s", width=1.3)
        panels.line(k, "estimate", "estimate", c.solution.t, c.solution[name], _sd(c.solution, name), unit="m/s", slow=True)
        if s is not None and name in s:
            panels.line(k, "smoothed", "smoothed", s.t, s[name], _sd(s, name), unit="m/s", width=1.4, slow=True)
    figure = panels.figure()
    figure["title"] = "Components: where it blows to"
    return figure


def _sd(solution: Solution, name: str) -> FloatArray | None:
    return solution.table.get(f"sd_{name}")


def _rose(r: Rose) -> Figure:
    """How often the wind came from where, by class of speed."""
    classes = [f"{low:g} to {high:g} m/s" for low, high in zip(r.bounds, r.bounds[1:], strict=False)] + [f"above {r.bounds[-1]:g} m/s"]
    theta = [360.0 * k / SECTORS for k in range(SECTORS)]
    traces = [
        {
            "type": "barpolar", "name": name, "theta": theta, "r": [round(100.0 * v, 2) for v in r.share[:, k]],
            "width": [360.0 / SECTORS] * SECTORS,
            "marker": {"color": f"@estimate/{0.25 + 0.75 * k / max(len(classes) - 1, 1):.2f}", "line": {"color": "@page", "width": 0.5}},
            "hovertemplate": f"%{{r:.1f}} % of the time, from %{{theta}}°<extra>{name}</extra>",
        }
        for k, name in enumerate(classes)
    ]  # fmt: skip
    axis = {"gridcolor": "@grid", "linecolor": "@axis", "tickcolor": "@axis"}
    layout = {
        "margin": {"l": 40, "r": 40, "t": TOP + 26, "b": 30}, "hovermode": "closest", "legend": {"traceorder": "normal", "y": 1.08},
        "polar": {
            "bgcolor": "@panel",
            "angularaxis": {
                **axis, "direction": "clockwise", "rotation": 90, "tickvals": [45 * k for k in range(8)], "ticktext": list(COMPASS),
            },
            "radialaxis": {**axis, "ticksuffix": " %", "angle": 0, "tickangle": 0, "nticks": 5},
        },
    }  # fmt: skip
    rows = [[t, *(round(100.0 * v, 3) for v in r.share[k])] for k, t in enumerate(theta)]
    figure: Figure = {"name": "wind_rose", "traces": traces, "layout": layout, "height": 400, "time": False,
                      "table": {"heads": ["from [deg]", *(f"{c} [%]" for c in classes)], "rows": rows}}  # fmt: skip
    figure["title"] = "Rose: where the wind came from"
    calm = f" For {100.0 * r.calm:.0f} % of the time the direction is not known." if r.calm > 0.005 else ""
    figure["reading"] = f"Share of the time in flight by the direction the wind comes from, in {SECTORS} sectors.{calm}"
    return figure


def _profile(p: Profile) -> Figure:
    """Speed over height."""
    grid = Grid("wind_profile", ["height above the origin [m]"], "speed [m/s]", 250)
    order = np.argsort(p.height)
    h, s = p.height[order], p.speed[order]
    if np.isfinite(p.sd).any():
        for sign, hover in ((1.0, "estimate +1σ"), (-1.0, "")):
            grid.line(0, "±1σ", "limit", s + sign * p.sd[order], h, dash="dot", hover=hover and "%{x:.3~g} m/s")
    grid.line(0, "mean speed, bars: spread over time", "estimate", s, h, symbol=True, width=1.9, hover="%{x:.3~g} m/s at %{y:.3~g} m")
    grid.traces[-1]["error_x"] = {
        "type": "data",
        "array": [round(float(v), 3) for v in p.spread[order]],
        "color": "@estimate",
        "thickness": 1,
        "width": 4,
    }
    low, high = (
        float(np.min(s - np.maximum(p.spread, np.nan_to_num(p.sd))[order])),
        float(np.max(s + np.maximum(p.spread, np.nan_to_num(p.sd))[order])),
    )
    margin = 0.06 * max(high - low, 0.5)
    grid.x_range(min(low, 0.0) if low < 1.0 else low - margin, high + margin)
    span = float(h[-1] - h[0])
    grid.range(0, float(h[0]) - 0.08 * span, float(h[-1]) + 0.08 * span)
    figure = grid.figure()
    figure["title"] = "Profile over height"
    figure["reading"] = (
        "Height and time are not told apart: a wind that freshens during the climb looks like one that grows with height. " + _law(p)
    )
    return figure


def _law(p: Profile) -> str:
    if p.law is None:
        return "No law is fitted: too few heights, or too close together."
    rest = f"and leaves {p.law['rms']:.2g} m/s (heights from the origin, taken as ground)."
    if p.law["kind"] == "power":
        return f"A power law of exponent {p.law['exponent']:.2f} ± {p.law['sd']:.2f} fits best {rest}"
    return f"A logarithmic law with a roughness length of {p.law['roughness']:.2g} m fits best {rest}"


def _coefficients(c: Context, wanted: list[tuple[str, str, float]]) -> Figure:
    """What is estimated together with the wind, with 1 sigma."""
    panels = Panels("wind_coefficients", c.pool, c.span, [title for _, title, _ in wanted], 112)
    panels.note_times(c.event_times)
    for k, (name, title, factor) in enumerate(wanted):
        unit = title[title.index("[") + 1 : -1]
        sd = _sd(c.solution, name)
        sd = None if sd is None else factor * sd
        panels.line(k, "estimate", "estimate", c.solution.t, factor * c.solution[name], sd, unit=unit, resolution=1e-5, slow=True)
        s = c.solution.smoothed
        if s is not None and name in s:
            panels.line(k, "smoothed", "smoothed", s.t, factor * s[name], unit=unit, resolution=1e-5, width=1.4, slow=True)
    figure = panels.figure()
    figure["title"] = "Estimated together with the wind"
    parts = [words for name, words in PARTS.items() if any(name == n for n, *_ in wanted)]
    if parts:
        figure["reading"] = f"Of {', of '.join(parts)}."
    return figure


def _means(said: dict[str, Any]) -> str:
    rows = [
        (number(m["t"], 4), number(m["speed"]), number(m["sd"], 2), f"{m['from_deg']:.0f}", number(m["turbulence"], 2))
        for m in said.get("means", [])
    ]
    if not rows:
        return ""
    heads = ("middle, t [s]", "speed [m/s]", "1σ [m/s]", "comes from [deg]", "turbulence intensity [1]")
    note = (
        "<p>Turbulence intensity is the standard deviation along the mean wind over the mean speed. Of an estimate it is a lower bound: "
        "gusts quicker than the filter do not pass it.</p>"
    )
    return f"<details><summary>Means of {BLOCK:.0f} s</summary>{table(heads, rows)}{note}</details>"


def _differences(said: dict[str, Any]) -> str:
    rows = []
    for name, d in said.get("against", {}).items():
        who = "autopilot's" if name == "onboard" else name
        kinds = [(who, d)] + ([(f"{who}, means of {d['means']['seconds']:.0f} s", d["means"])] if "means" in d else [])
        for what, v in kinds:
            rows.append((escape(what), *(number(v[k][a], 2) for a in "ne" for k in ("bias", "sd")), f"{v['n']:,}"))
    if not rows:
        return ""
    heads = ("estimate less", "north, mean [m/s]", "north, spread [m/s]", "east, mean [m/s]", "east, spread [m/s]", "samples")
    return table(heads, rows, caption="Differences in flight")
