"""Panels over time, one above the other with one time axis, as plotly dictionaries. It knows no sensor and no estimator."""

from __future__ import annotations

import html
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.report.series import Pool, thin
from haltere.report.style import AXES

__all__ = ["FOOT", "LEFT", "TOP", "Figure", "Panels", "pen", "plain"]

FloatArray = NDArray[np.float64]
Figure = dict[str, Any]

#: Room for a line that is shown with its band, relative to others.
BANDED = 3.0
#: Pixels of one panel, between panels, below, left and above them; markers shown at most a series.
ROW, GAP, FOOT, LEFT, TOP, MARKERS = 150, 14, 44, 74, 30, 300


def plain(text: object) -> str:
    """Text of a log for plotly, which reads some tags in text."""
    return html.escape(str(text), quote=False)


def pen(colour: str, width: float) -> dict[str, Any]:
    """Style of a line; truth is dashed, since a good estimate lies exactly under it."""
    return {"color": f"@{colour}", "width": width} | ({"dash": "6px,5px"} if colour == "truth" else {})


class Panels:
    """Stacked panels with linked time axes.

    Parameters
    ----------
    name
        Of the figure; also the file name of an exported picture.
    pool
        Where the numbers go.
    span
        First and last time shown [s].
    titles
        Title with unit of each panel's vertical axis.
    row
        Height of one panel in pixels.
    """

    def __init__(self, name: str, pool: Pool, span: tuple[float, float], titles: list[str], row: int = ROW) -> None:
        self.name, self.pool, self.span, self.titles, self.row = name, pool, span, titles, row
        self.traces: list[dict[str, Any]] = []
        self.shapes: list[dict[str, Any]] = []
        self.extent = [(math.inf, -math.inf) for _ in titles]
        self.reversed: set[int] = set()
        self.drawn: set[int] = set()
        self._named: set[str] = set()

    def _axes(self, row: int) -> dict[str, str]:
        return {"xaxis": "x", "yaxis": "y" if row == 0 else f"y{row + 1}"}

    def _trace(self, row: int, label: str, legend: bool = True, **rest: Any) -> None:
        """One trace; the legend names each label once a figure."""
        first = legend and label not in self._named
        if first:
            self._named.add(label)
        self.traces.append(
            {"type": "scatter", "name": plain(label), "legendgroup": plain(label), "showlegend": first, **self._axes(row), **rest}
        )

    def _widen(self, row: int, low: float, high: float) -> None:
        if math.isfinite(low) and math.isfinite(high):
            self.extent[row] = (min(self.extent[row][0], low), max(self.extent[row][1], high))

    def line(
        self,
        row: int,
        label: str,
        colour: str,
        t: FloatArray,
        y: FloatArray,
        sd: FloatArray | None = None,
        *,
        unit: str = "",
        resolution: float = 1e-3,
        period: float | None = None,
        about: float = 0.0,
        width: float = 1.9,
        centred: bool = False,
        slow: bool = False,
    ) -> None:
        """A line, with its band of one standard deviation where ``sd`` is given: about the line, or about zero (``centred``).

        A ``slow`` quantity needs no more room in the page than others. An angle is shown within half a ``period`` of ``about``.
        """
        columns = [y] if sd is None else [y, sd]
        weight = 1.0 if sd is None or centred or slow else BANDED
        ids = self.pool.series(t, columns, [resolution] * len(columns), period, weight=weight, about=about)
        if not ids:
            return
        good = np.isfinite(y) & np.isfinite(t)
        finite = y[good] if period is None else y[good] - period * np.floor((y[good] - about) / period + 0.5)
        reach = 0.0
        if sd is not None:
            known = sd[good & np.isfinite(sd)]
            reach = 1.5 * float(np.median(known)) if len(known) else 0.0
            band: dict[str, Any] = {
                "$band": {"t": ids[0], "y": None if centred else ids[1], "sd": ids[2], "line": ids[1]}, "mode": "lines", "fill": "toself",
                "hoverinfo": "skip", "fillcolor": "@limit/0.3" if centred else f"@{colour}/0.22", "line": {"width": 0},
            }  # fmt: skip
            self._trace(row, "±1σ" if centred else f"{label} ±1σ", **band)
        low, high = float(finite.min()), float(finite.max())
        self._widen(row, *((min(low, -reach), max(high, reach)) if centred else (low - reach, high + reach)))
        few = len(finite) <= 60
        trace: dict[str, Any] = {
            "x": {"$a": ids[0]}, "y": {"$a": ids[1]}, "mode": "lines+markers" if few else "lines", "line": pen(colour, width),
            "marker": {"size": 4, "color": f"@{colour}"},
            "hovertemplate": f"%{{y:.4~g}}{' ± %{customdata:.2~g}' if sd is not None else ''} {unit}",
        }  # fmt: skip
        if sd is not None:
            trace["customdata"] = {"$a": ids[2]}
        self._trace(row, label, **trace)
        self.drawn.add(row)

    def multiples(self, row: int, label: str, factor: float, *, colour: str = "limit") -> None:
        """Dotted lines at plus and minus a multiple of the standard deviation of the line drawn last."""
        band = next((t["$band"] for t in reversed(self.traces) if "$band" in t), None)
        if band is not None:
            self._bounds(row, label, band["t"], band["sd"], factor, colour)

    def limits(self, row: int, label: str, t: FloatArray, bound: FloatArray, *, resolution: float = 1e-3, colour: str = "limit") -> None:
        """Dotted lines at plus and minus a bound."""
        ids = self.pool.series(t, [bound], [resolution])
        if not ids:
            return
        self._bounds(row, label, ids[0], ids[1], 1.0, colour)

    def _bounds(self, row: int, label: str, t: int, bound: int, factor: float, colour: str) -> None:
        for sign in (factor, -factor):
            self._trace(row, label, x={"$a": t}, y={"$b": bound, "k": sign}, mode="lines", hoverinfo="skip",
                        line={"color": f"@{colour}", "width": 1, "dash": "dot"})  # fmt: skip

    def markers(
        self,
        row: int,
        label: str,
        colour: str,
        t: FloatArray,
        y: FloatArray,
        *,
        symbol: str = "x",
        size: int = 7,
        texts: list[str] | None = None,
        unit: str = "",
        resolution: float = 1e-3,
        widen: bool = True,
    ) -> None:
        """Marked points, at most `MARKERS` of them with the extremes among them."""
        good = np.flatnonzero(np.isfinite(y) & np.isfinite(t))
        if len(good) == 0:
            return
        rows = good[thin([y[good]], MARKERS)]
        if widen:
            self._widen(row, float(y[rows].min()), float(y[rows].max()))
        trace: dict[str, Any] = {
            "x": {"$a": self.pool.add(t[rows], 1e-4)}, "y": {"$a": self.pool.add(y[rows], resolution)}, "mode": "markers",
            "marker": {"symbol": symbol, "size": size, "color": f"@{colour}"}, "hovertemplate": f"%{{y:.4~g}} {unit}",
        }  # fmt: skip
        if texts is not None:
            trace["text"] = [plain(texts[i]) for i in rows]
            trace["hovertemplate"] = f"%{{y:.4~g}} {unit}, %{{text}}"
        self._trace(row, label, **trace)
        self.drawn.add(row)

    def note_times(self, times: list[float]) -> None:
        """Vertical lines through all panels."""
        for t in times:
            self.shapes.append({"type": "line", "x0": t, "x1": t, "y0": 0, "y1": 1, "xref": "x", "yref": "paper", "layer": "below",
                                "line": {"color": "@event", "width": 1, "dash": "dot"}})  # fmt: skip

    @property
    def height(self) -> int:
        """Pixels of the panels, the time axis and a line of legend."""
        n = len(self.titles)
        return n * self.row + (n - 1) * GAP + FOOT + TOP

    def figure(self) -> Figure:
        """The figure: name, traces, layout, height and that its x axis is time."""
        n = len(self.titles)
        inner = n * self.row + (n - 1) * GAP
        layout: dict[str, Any] = {
            "shapes": self.shapes, "margin": {"l": LEFT, "r": 12, "t": TOP, "b": FOOT}, "hoversubplots": "axis",
            "xaxis": {**AXES, "anchor": "y" if n == 1 else f"y{n}", "range": list(self.span), "hoverformat": ".3f",
                      "unifiedhovertitle": {"text": "t = %{x:.3f} s"}, "title": {"text": "t [s]", "standoff": 4}},
        }  # fmt: skip
        for k, title in enumerate(self.titles):
            top = 1.0 - k * (self.row + GAP) / inner
            low, high = self.extent[k]
            y: dict[str, Any] = {
                **AXES, "domain": [max(0.0, top - self.row / inner), top], "anchor": "x", "nticks": 6,
                "title": {"text": plain(title), "standoff": 6},
            }  # fmt: skip
            if low <= high:
                margin = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
                y["range"] = [low - margin, high + margin]
                if k in self.reversed:
                    y["range"].reverse()
            layout["yaxis" if k == 0 else f"yaxis{k + 1}"] = y
        return {"name": self.name, "traces": self.traces, "layout": layout, "height": self.height, "time": True}
