"""A page in one file that needs no network: style, sections, numbers and the drawing library. It knows no solution and no sensor."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from functools import lru_cache
from importlib import resources

from haltere._version import __version__
from haltere.metrics.summary import finite
from haltere.report.markup import escape
from haltere.report.panels import Figure
from haltere.report.series import Pool, pack, to_json
from haltere.report.style import colours, style_sheet

__all__ = ["LIMIT", "document"]

#: Largest file [bytes]. Series are thinned where the file would be larger.
LIMIT = 4_800_000
#: Bytes set aside an array for how to decode it.
DECODING = 40
#: Scripts of the page, in the order in which they need each other.
SCRIPTS = ("load.js", "plot.js", "time.js", "save.js", "view.js", "start.js")

#: The page runs its own scripts and styles, and even a fault in it cannot reach the network.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:"
FOOTER = (
    "Units are SI, angles in degrees for reading. Drag to zoom, all time axes follow; double-click or Home to see the whole flight again, "
    "+ and − to zoom, ← and → to move; the address keeps the window. Click a name above a plot to hide it. What is drawn are the extremes "
    "of what the page holds, and each sample once you zoom in; solution.parquet and aids.parquet have every row."
)


#: Opens the contents on a narrow screen; and what part of the flight is shown, with the way back.
MENU = '<button type="button" id="menu" aria-expanded="false">Contents</button>'
WINDOW = '<div id="window" hidden><span></span> <button type="button" title="Home">whole flight</button></div>'


@lru_cache(maxsize=1)
def _plotly() -> str:
    """The drawing library of the plotly package, packed."""
    from plotly.offline import get_plotlyjs

    return pack(get_plotlyjs(), 9)


def _resource(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def document(
    title: str,
    body: Sequence[str],
    links: Sequence[tuple[str, str]],
    figures: list[Figure],
    pool: Pool,
    *,
    span: tuple[float, float] | None = None,
    shades: Sequence[tuple[float, float, str]] = (),
    footer: str = FOOTER,
) -> str:
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
    span
        First and last time of the flight [s]; by default that of the first figure over time.
    shades
        First time, last time [s] and colour (``@name/opacity``) of what is shaded behind every figure over time.
    footer
        How the page is to be read, HTML.

    Returns
    -------
    str
        HTML that loads nothing from outside.
    """
    nav = " ".join(f'<a href="#{key}">{escape(name)}</a>' for key, name in links)
    over_time = [f["layout"]["xaxis"]["range"] for f in figures if f.get("time")]
    content = {"colours": colours(), "span": span or (over_time or [(0.0, 1.0)])[0], "shades": shades, "figures": finite(figures)}
    empty = _assembled(title, body, nav, to_json({**content, "arrays": []}), b"", footer)
    # In base64 four characters hold three bytes; how the arrays are to be decoded takes some too.
    arrays, data = pool.packed(0.75 * max(LIMIT - len(empty.encode("utf-8")) - DECODING * len(pool), 0))
    return _assembled(title, body, nav, to_json({**content, "arrays": arrays}), data, footer)


def _assembled(title: str, body: Sequence[str], nav: str, numbers: str, data: bytes, footer: str) -> str:
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
            f'<nav aria-label="Contents">{MENU}<div class="links">{nav}</div>{WINDOW}</nav>\n<main>',
            '<noscript><p class="trouble">The plots need JavaScript; the tables below do not.</p></noscript>',
            '<p class="trouble" id="trouble" hidden></p>',
            *body,
            f"</main>\n<footer>haltere {escape(__version__)}. {footer}</footer>",
            f'<script type="application/octet-stream" id="library">{_plotly()}</script>',
            f'<script type="application/octet-stream" id="numbers">{pack(numbers)}</script>',
            f'<script type="application/octet-stream" id="arrays">{base64.b64encode(data).decode("ascii")}</script>',
            *(f"<script>\n{_resource(name)}</script>" for name in SCRIPTS),
            "</body>\n</html>\n",
        ]
    )
