"""NIS, NEES and whiteness over time and lag, with their bands. It computes no results: see the metrics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.metrics.consistency import DOF, WINDOW, band, nees_series, nis_series
from haltere.metrics.whiteness import Whiteness, whiteness_series
from haltere.report.context import COMPONENTS, Context, sensor_label
from haltere.report.grid import Grid
from haltere.report.panels import Figure, Panels, plain
from haltere.report.style import SENSOR_COLOURS
from haltere.report.words import whiteness_in_words

__all__ = ["consistency_figures", "unmarked"]

FloatArray = NDArray[np.float64]
#: What the parts of a vector are called in the records of the filter.
QUANTITIES = {"vel": "velocity", "pos": "position", "mag": "field", "altitude": "altitude", "heading": "heading", "down": "gravity"}
#: The same, and sensors, where there is little room.
SHORT = {"vel": "vel.", "pos": "pos.", "altitude": "alt.", "mag": "field", "magnetometer": "mag.", "barometer": "baro."}
#: How lines of one colour are told apart, in the order of their axes.
DASHES = ("solid", "6px,3px", "2px,2px")

#: Ratios below this are drawn at it: how far they are below the band matters no more.
LEAST = 1e-3


def _label(sensor: str, stem: str) -> str:
    """``GNSS velocity``, ``barometer altitude``."""
    return f"{sensor_label(sensor)} {QUANTITIES.get(stem, stem)}"


def _short(sensor: str, stem: str) -> str:
    """The same for the side of a panel."""
    return f"{SHORT.get(sensor, sensor_label(sensor))} {SHORT.get(stem, stem)} [1]"


def _logarithmic(figure: Figure, least: float = LEAST) -> Figure:
    """The same figure with logarithmic vertical axes; ranges were set as for linear ones."""
    for key, axis in figure["layout"].items():
        if key.startswith("yaxis"):
            low, high = axis.get("range", (least, 1.0))
            axis["type"] = "log"
            axis["range"] = [math.log10(max(low, least)) - 0.1, math.log10(max(high, 10.0 * least)) + 0.1]
            axis["dtick"] = 1 if axis["range"][1] - axis["range"][0] > 1.5 else math.log10(2.0)  # decades, or factors of two
    return figure


def unmarked(panels: Panels, *labels: str, dash: str = "dot") -> None:
    """Make constant lines plain: no markers where there are few points, and nothing at the pointer."""
    for trace in panels.traces:
        if trace["name"] in [plain(label) for label in labels] and "$a" in trace["y"]:
            trace["y"] = {"$b": trace["y"]["$a"], "k": 1.0}
            trace["mode"] = "lines"
            trace["line"] = {**trace["line"], "dash": dash}
            trace["hoverinfo"] = "skip"
            trace.pop("hovertemplate", None)


def consistency_figures(c: Context) -> list[Figure]:
    """NIS and NEES over time with their bands, and whiteness; only what there is."""
    return [f for f in (_nis(c), _nees(c), _whiteness(c)) if f is not None]


def _ratio_panels(c: Context, name: str, titles: list[str], lines: Sequence[tuple[str, FloatArray, FloatArray, Any, Any]]) -> Figure:
    """Ratios that should be one, with their bands, on logarithmic axes."""
    panels = Panels(name, c.pool, c.span, titles, 112)
    panels.note_times(c.event_times)
    for k, (colour, t, y, low, high) in enumerate(lines):
        y = np.maximum(y, LEAST)
        for bound in (low, high):
            panels.line(k, "95 % band", "limit", t, np.broadcast_to(bound, t.shape).astype(np.float64), unit="", width=1.2)
        panels.line(k, "mean NIS" if name == "nis" else "NEES", colour, t, y, unit="", resolution=1e-3, width=1.4)
        high_shown, low_shown = float(np.max(y)), float(np.min(y))
        panels.extent[k] = (min(low_shown, float(np.min(low))), max(high_shown, float(np.max(high))))
    unmarked(panels, "95 % band")
    return _logarithmic(panels.figure())


def _nis(c: Context) -> Figure | None:
    series = nis_series(c.solution)
    if not series:
        return None
    lines = [(SENSOR_COLOURS.get(s, "assumed"), v.t, v.mean, v.low, v.high) for (s, _), v in series.items()]
    figure = _ratio_panels(c, "nis", [_short(*key) for key in series], lines)
    outside = {key: float(np.mean((v.mean < v.low) | (v.mean > v.high))) for key, v in series.items()}
    above = {key: float(np.mean(v.mean > v.high)) for key, v in series.items()}
    figure["title"] = f"NIS over time, mean of {WINDOW} measurements"
    worst = max(above, key=lambda key: above[key])
    told = "None is above for long"
    if above[worst] > 0.05:
        told = f"{_label(*worst)} is above its band for {100.0 * above[worst]:.0f} % of the time"
    below = [key for key in series if outside[key] - above[key] > 0.5]
    under = f"; {', '.join(_label(*key) for key in below)} mostly below, which is cautious" if below else ""
    figure["reading"] = (
        "Inside the band the sensor is as noisy as the filter believes; above, noisier or disturbed; below, better than it believes. "
        f"{told}{under}."
    )
    return figure


def _nees(c: Context) -> Figure | None:
    truth = c.flight.get("truth")
    series = nees_series(c.solution, truth) if truth is not None else {}
    blocks = [b for b in ("attitude", "velocity", "position") if b in series]
    if not blocks:
        return None
    lines = [("estimate", *series[b], *band(DOF[b], 1.0)) for b in blocks]
    figure = _ratio_panels(c, "nees", [f"{b} [1]" for b in blocks], lines)
    share = {b: float(np.mean(series[b][1] <= band(DOF[b], 1.0)[1])) for b in blocks}
    figure["title"] = "NEES over time, a degree of freedom"
    said = ", ".join(f"{b} {100.0 * share[b]:.0f} %" for b in blocks)
    figure["reading"] = (
        f"Errors against truth over what the filter states of them. Share of the time not above the band, 97.5 % being right: {said}."
    )
    return figure


def _whiteness(c: Context) -> Figure | None:
    """Autocorrelation with its band, one panel a quantity."""
    series = whiteness_series(c.solution)
    groups: dict[tuple[str, str], dict[str, Whiteness]] = {}
    for sensor, components in series.items():
        for component, w in components.items():
            groups.setdefault((sensor, component.rpartition("_")[0] or component), {})[component] = w
    if not groups:
        return None
    grid = Grid("whiteness", [_short(*key) for key in groups], "lag [samples]", 120)
    longest = 0
    for k, ((sensor, _), components) in enumerate(groups.items()):
        for i, (component, w) in enumerate(components.items()):
            lags = np.arange(1, len(w.r) + 1)
            longest = max(longest, len(lags))
            words = COMPONENTS[component][0].rpartition(" ")[2] if component in COMPONENTS else component
            grid.line(k, words, SENSOR_COLOURS.get(sensor, "assumed"), lags, w.r, dash=DASHES[i % 3], symbol=True,
                      hover=f"%{{y:.2f}} at lag %{{x}} of {w.interval:.3g} s")  # fmt: skip
        widest = max(components.values(), key=lambda w: float(w.band[-1]))
        for sign in (1.0, -1.0):
            grid.line(k, "95 % band if white", "limit", np.arange(1, len(widest.band) + 1), sign * widest.band, dash="dot", hover="")
        low = min(float(np.min(w.r)) for w in components.values())
        high = max(float(np.max(w.r)) for w in components.values())
        grid.range(k, min(-0.25, low - 0.05), max(0.5, high + 0.05))
    grid.x_range(0.0, longest + 1.0)
    figure = grid.figure()
    figure["title"] = "Whiteness: does an innovation tell of the next?"
    table_ = c.solution.summary.get("whiteness", {})
    said = "; ".join(f"{sensor_label(s)} {whiteness_in_words(v)}" for s, v in table_.items())
    figure["reading"] = "Autocorrelation of normalised innovations; dots inside the dotted lines are chance. " + (
        f"{said[:1].upper()}{said[1:]}." if said else ""
    )
    return figure
