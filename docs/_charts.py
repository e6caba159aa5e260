"""Lines and point clouds as SVG, for the executed pages. It knows no flight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Colours that can be told apart on light and dark ground.
COLOURS = ("#2a6fbb", "#d1651a", "#2f9e57", "#8a5fb5")


def _text(x: float, y: float, words: str, anchor: str = "middle", turn: bool = False) -> str:
    rotate = f' transform="rotate(-90 {x:.0f} {y:.0f})"' if turn else ""
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}"{rotate}>{words}</text>'


def _svg(width: float, height: float, label: str, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="100%" role="img" aria-label="{label}" '
        'font-family="sans-serif" font-size="12" fill="currentColor">' + "".join(parts) + "</svg>"
    )


def lines(
    x: Array, series: Sequence[tuple[str, Array]], x_label: str, y_label: str, window: tuple[float, float] | None = None, points: int = 700
) -> str:
    """Several lines over one axis with a legend; ``window`` is shaded. At most ``points`` points a line are drawn, the extremes kept."""
    width, height, left, top, foot = 640.0, 200.0, 62.0, 20.0, 36.0
    low = min(0.0, *(float(np.nanmin(y)) for _, y in series))
    high = max(0.0, *(float(np.nanmax(y)) for _, y in series))
    pad = 0.05 * (high - low)
    low, high = low - (pad if low < 0.0 else 0.0), high + pad

    def across(u: Array | float) -> Array:
        return np.asarray(left + (np.asarray(u) - x[0]) / (x[-1] - x[0]) * (width - left - 10.0))

    def down(v: Array | float) -> Array:
        return np.asarray(top + (high - np.asarray(v)) / (high - low) * (height - top - foot))

    parts = []
    if window is not None:
        a, b = across(window[0]), across(window[1])
        parts.append(
            f'<rect x="{a:.1f}" y="{top}" width="{b - a:.1f}" height="{height - top - foot}" fill="currentColor" fill-opacity="0.08"/>'
        )
    parts.append(
        f'<line x1="{left}" x2="{width - 10}" y1="{down(0.0):.1f}" y2="{down(0.0):.1f}" stroke="currentColor" stroke-opacity="0.4"/>'
    )
    for k, (name, y) in enumerate(series):
        bins = np.array_split(np.arange(len(x)), max(1, min(points // 2, len(x) // 2)))
        pick = np.unique(np.concatenate([[b[np.argmin(y[b])], b[np.argmax(y[b])]] for b in bins if len(b)]))
        where = " ".join(f"{i:.1f},{j:.1f}" for i, j in zip(across(x[pick]), down(y[pick]), strict=True))
        colour = COLOURS[k % len(COLOURS)]
        parts.append(f'<polyline points="{where}" fill="none" stroke="{colour}" stroke-width="1.3"/>')
        at = left + 10.0 + k * (width - left) / len(series)
        parts.append(f'<line x1="{at:.0f}" x2="{at + 18:.0f}" y1="9" y2="9" stroke="{colour}" stroke-width="2.5"/>')
        parts.append(_text(at + 23.0, 13.0, name, "start"))
    for value in sorted({low, 0.0, high}, key=abs)[: 3 if low < 0.0 else 2]:
        parts.append(_text(left - 6.0, float(down(value)) + 4.0, f"{value:.2g}", "end"))
    parts += [
        _text(left + 4.0, height - foot + 16.0, f"{x[0]:.0f}"), _text(width - 10.0, height - foot + 16.0, f"{x[-1]:.0f}", "end"),
        _text((left + width) / 2.0, height - 6.0, x_label), _text(12.0, (height - foot + top) / 2.0, y_label, turn=True),
    ]  # fmt: skip
    return _svg(width, height, f"{y_label} over {x_label}", parts)


def clouds(points: Array, radius: float, unit: str) -> str:
    """Points (n, 3) seen along each axis, about the origin, with the circle of a radius for comparison; all to one scale."""
    size, gap, foot = 200.0, 20.0, 40.0
    reach = 1.08 * max(float(np.abs(points).max()), radius)
    parts = []
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        x0 = k * (size + gap) + gap
        scale = 0.5 * size / reach
        a, b = x0 + 0.5 * size + scale * points[:, i], 0.5 * size - scale * points[:, j]
        parts.append(
            f'<rect x="{x0:.0f}" y="0" width="{size:.0f}" height="{size:.0f}" fill="none" stroke="currentColor" stroke-opacity="0.3"/>'
        )
        parts += [f'<circle cx="{u:.1f}" cy="{v:.1f}" r="1.3" fill="{COLOURS[0]}" fill-opacity="0.55"/>' for u, v in zip(a, b, strict=True)]
        middle = x0 + 0.5 * size
        parts.append(f'<circle cx="{middle:.1f}" cy="{0.5 * size:.1f}" r="{scale * radius:.1f}" fill="none" stroke="{COLOURS[1]}"/>')
        parts.append(_text(middle, size + 15.0, f"{'xyz'[i]} [{unit}], ±{reach:.0f}"))
        parts.append(_text(x0 - 6.0, 0.5 * size, f"{'xyz'[j]} [{unit}]", turn=True))
    return _svg(3.0 * (size + gap) + gap, size + foot - 15.0, "points seen along each axis", parts)
