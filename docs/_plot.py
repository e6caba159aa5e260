"""A line with its band as SVG, for the executed pages. It knows no flight."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def band(x: Array, y: Array, sd: Array, x_label: str, y_label: str, points: int = 600) -> str:
    """SVG of y over x inside -sd ... +sd; at most ``points`` points are drawn."""
    pick = np.unique(np.linspace(0, len(x) - 1, min(points, len(x))).astype(int))
    x, y, sd = x[pick], y[pick], sd[pick]
    width, height, left, foot = 640.0, 220.0, 60.0, 34.0
    top = float(np.nanmax(np.abs(np.concatenate([y, sd])))) * 1.05

    def place(u: Array, v: Array) -> str:
        a = left + (u - x[0]) / (x[-1] - x[0]) * (width - left - 10)
        b = (height - foot) * (0.5 - 0.5 * v / top)
        return " ".join(f"{i:.1f},{j:.1f}" for i, j in zip(a, b, strict=True))

    def label(a: float, b: float, text: str, **more: Any) -> str:
        attributes = "".join(f' {k.replace("_", "-")}="{v}"' for k, v in more.items())
        return f'<text x="{a:.0f}" y="{b:.0f}"{attributes}>{text}</text>'

    middle = (height - foot) / 2
    around = place(np.concatenate([x, x[::-1]]), np.concatenate([sd, -sd[::-1]]))
    return "".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="100%" role="img" ',
            f'aria-label="{y_label} over {x_label}" font-family="sans-serif" font-size="12" fill="currentColor">',
            f'<polygon points="{around}" fill="#2a6fbb" fill-opacity="0.25"/>',
            f'<polyline points="{place(x, y)}" fill="none" stroke="#2a6fbb"/>',
            f'<line x1="{left}" x2="{width - 10}" y1="{middle}" y2="{middle}" stroke="currentColor" stroke-opacity="0.4"/>',
            label(left - 6, 12, f"{top:.2g}", text_anchor="end"),
            label(left - 6, middle + 4, "0", text_anchor="end"),
            label(left - 6, height - foot, f"{-top:.2g}", text_anchor="end"),
            label(left, height - foot + 14, f"{x[0]:.0f}"),
            label(width - 10, height - foot + 14, f"{x[-1]:.0f}", text_anchor="end"),
            label((left + width) / 2, height - 4, x_label, text_anchor="middle"),
            label(12, middle, y_label, text_anchor="middle", transform=f"rotate(-90 12 {middle:.0f})"),
            "</svg>",
        ]
    )
