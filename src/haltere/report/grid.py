"""Panels one above the other whose horizontal axis is not time, as plotly dictionaries. It knows no sensor and no estimator."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.report.panels import FOOT, LEFT, TOP, Figure, plain
from haltere.report.style import AXES

__all__ = ["Grid"]

FloatArray = NDArray[np.float64]
#: Height of a panel, and between panels.
ROW, GAP = 190, 16


class Grid:
    """Stacked panels whose common horizontal axis is not time."""

    def __init__(self, name: str, titles: list[str], x_title: str, row: int = ROW) -> None:
        self.name, self.titles, self.x_title, self.row = name, titles, x_title, row
        self.traces: list[dict[str, Any]] = []
        self.layout: dict[str, Any] = {"margin": {"l": LEFT, "r": 12, "t": TOP, "b": FOOT}, "hovermode": "closest", "shapes": [],
                                       "annotations": []}  # fmt: skip
        n = len(titles)
        inner = n * row + (n - 1) * GAP
        for k, title in enumerate(titles):
            top = 1.0 - k * (row + GAP) / inner
            self.layout[self._key(k)] = {
                **AXES, "domain": [max(0.0, top - row / inner), top], "anchor": "x", "nticks": 6,
                "title": {"text": plain(title), "standoff": 6},
            }  # fmt: skip
        bottom = "y" if n == 1 else f"y{n}"
        self.layout["xaxis"] = {**AXES, "anchor": bottom, "title": {"text": x_title, "standoff": 4}, "nticks": 10}
        self._named: set[str] = set()

    @staticmethod
    def _key(k: int) -> str:
        return "yaxis" if k == 0 else f"yaxis{k + 1}"

    def line(
        self, k: int, label: str, colour: str, x: Any, y: FloatArray, *, dash: str = "solid", width: float = 1.4, hover: str = "%{y:.3~g}",
        symbol: bool = False,
    ) -> None:  # fmt: skip
        """A line; numbers stand in the figure itself, so keep them few."""
        first = label not in self._named
        self._named.add(label)
        trace: dict[str, Any] = {
            "type": "scatter", "name": plain(label), "legendgroup": plain(label), "showlegend": first, "xaxis": "x",
            "yaxis": "y" if k == 0 else f"y{k + 1}", "x": [float(f"{v:.5g}") for v in x], "y": [float(f"{v:.4g}") for v in y],
            "mode": "lines+markers" if symbol else "lines", "line": {"color": f"@{colour}", "width": width, "dash": dash},
        }  # fmt: skip
        if symbol:
            trace["marker"] = {"size": 4, "color": f"@{colour}"}
        trace |= {"hovertemplate": hover} if hover else {"hoverinfo": "skip"}
        self.traces.append(trace)

    def range(self, k: int, low: float, high: float, log: bool = False) -> None:
        """Limits of a panel's vertical axis."""
        axis = self.layout[self._key(k)]
        axis["range"] = [math.log10(low), math.log10(high)] if log else [low, high]
        if log:
            axis |= {"type": "log", "dtick": 1, "exponentformat": "power", "minor": {"ticks": "outside", "ticklen": 2}}

    def x_range(self, low: float, high: float) -> None:
        """Limits of the horizontal axis."""
        self.layout["xaxis"]["range"] = [low, high]

    def shade(self, k: int, low: float, high: float, colour: str) -> None:
        """A stretch of the horizontal axis, in one panel."""
        self.layout["shapes"].append({
            "type": "rect", "xref": "x", "yref": "y domain" if k == 0 else f"y{k + 1} domain", "x0": low, "x1": high, "y0": 0, "y1": 1,
            "layer": "below", "line": {"width": 0}, "fillcolor": f"@{colour}",
        })  # fmt: skip

    def name_at(self, k: int, x: float, y: float, text: str, log: bool = False) -> None:
        """Words at a point of a panel."""
        self.layout["annotations"].append({
            "x": x, "y": math.log10(y) if log else y, "xref": "x", "yref": "y" if k == 0 else f"y{k + 1}", "text": plain(text),
            "showarrow": False, "yanchor": "bottom", "yshift": 3, "font": {"size": 11, "color": "@text"},
        })  # fmt: skip

    def figure(self) -> Figure:
        """The figure as the page takes it."""
        n = len(self.titles)
        height = n * self.row + (n - 1) * GAP + FOOT + TOP
        return {"name": self.name, "traces": self.traces, "layout": self.layout, "height": height, "time": False}
