"""A page in one file that needs no network: style, sections, numbers and the drawing library. It knows no solution and no sensor."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from importlib import resources

from haltere._version import __version__
from haltere.metrics.summary import finite
from haltere.report.markup import escape
from haltere.report.panels import Figure
from haltere.report.series import Pool, pack, to_json
from haltere.report.style import colours, style_sheet

__all__ = ["LIMIT", "POINTS", "document"]

#: Largest file [bytes], and about how many points a series shows: fewer only where the file would be larger.
LIMIT, POINTS = 4_800_000, (4000, 2500, 1500, 800, 400)

#: The page runs its own scripts and styles, and even a fault in it cannot reach the network.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:"
FOOTER = (
    "Units are SI, angles in degrees for reading. Drag to zoom, all time axes follow; double-click to see all again; click a name above "
    "a plot to hide it. Long series are thinned for display, with their extremes kept; solution.parquet and aids.parquet have every row."
)


@lru_cache(maxsize=1)
def _plotly() -> str:
    """The drawing library of the plotly package, packed."""
    from plotly.offline import get_plotlyjs

    return pack(get_plotlyjs(), 9)


def _resource(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def document(title: str, body: Sequence[str], links: Sequence[tuple[str, str]], figures: list[Figure], pool: Pool) -> str:
    """A whole page.

    Parameters
    ----------
    title
        What it is about.
    body
        HTML of its parts, in order, as `haltere.report.markup.section_html` makes it.
    links
        Key and title of each part for the line at the top.
    figures, pool
        The figures the parts refer to, and their numbers.

    Returns
    -------
    str
        HTML that loads nothing from outside.
    """
    nav = " ".join(f'<a href="#{key}">{escape(name)}</a>' for key, name in links)
    numbers = to_json({"colours": colours(), "arrays": pool.arrays, "figures": finite(figures)})
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta name="generator" content="haltere {escape(__version__)}">',
            f"<title>{escape(title)} – haltere</title>",
            f"<style>{style_sheet()}</style>",
            f"<script>{_resource('errors.js')}</script>",
            "</head>\n<body>",
            f'<nav>{nav}</nav>\n<main>\n<noscript><p class="trouble">The plots need JavaScript; the tables below do not.</p></noscript>',
            '<p class="trouble" id="trouble" hidden></p>',
            *body,
            f"</main>\n<footer>haltere {escape(__version__)}. {FOOTER}</footer>",
            f'<script type="application/octet-stream" id="library">{_plotly()}</script>',
            f'<script type="application/octet-stream" id="numbers">{pack(numbers)}</script>',
            f"<script>{_resource('page.js')}</script>",
            "</body>\n</html>\n",
        ]
    )
