"""The page: verdict, sections and their numbers in one file that needs no network. What it shows is computed elsewhere."""

from __future__ import annotations

from functools import lru_cache
from importlib import resources

from haltere._version import __version__
from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.metrics.summary import finite
from haltere.report import overview, sections, tables
from haltere.report.context import Context, Section
from haltere.report.panels import Figure
from haltere.report.series import Pool, pack, to_json
from haltere.report.style import colours, style_sheet
from haltere.report.tables import escape
from haltere.report.words import facts, verdict

__all__ = ["LIMIT", "page"]

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


def page(solution: Solution, flight: FlightLog, command: str | None = None) -> str:
    """A report on a solution as one HTML page that loads nothing from outside.

    Parameters
    ----------
    solution
        What an estimator gave back, with its summary.
    flight
        The flight it is of; ``onboard`` and ``truth`` are drawn for comparison.
    command
        The command line that gives the same result again.

    Returns
    -------
    str
        The text of ``report.html``, below 5 MB.
    """
    text = ""
    for points in POINTS:
        text = _assemble(Context(solution, flight, Pool(points)), command)
        if len(text.encode("utf-8")) <= LIMIT:
            break
    return text


def _assemble(c: Context, command: str | None) -> str:
    timeline = overview.timeline(c)
    timeline.after = tables.events(c)
    parts = [
        timeline, sections.attitude(c), sections.velocity(c), sections.position(c), sections.biases(c), sections.wind(c),
        sections.errors(c), sections.innovations(c), tables.consistency(c), tables.data(c), tables.configuration(c, command),
    ]  # fmt: skip
    shown = [s for s in parts if s is not None and (s.figures or s.note or s.after)]
    track = overview.track(c)
    figures: list[Figure] = []
    body = [_header(c), _first(c, track, figures), *(_section(s, figures) for s in shown)]
    links = " ".join(f'<a href="#{s.key}">{escape(s.title)}</a>' for s in (track, *shown))
    name = c.flight.meta.name or "flight"
    numbers = to_json({"colours": colours(), "arrays": c.pool.arrays, "figures": finite(figures)})
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta name="generator" content="haltere {escape(__version__)}">',
            f"<title>{escape(name)} – haltere</title>",
            f"<style>{style_sheet()}</style>",
            f"<script>{_resource('errors.js')}</script>",
            "</head>\n<body>",
            f'<nav>{links}</nav>\n<main>\n<noscript><p class="trouble">The plots need JavaScript; the tables below do not.</p></noscript>',
            '<p class="trouble" id="trouble" hidden></p>',
            *body,
            f"</main>\n<footer>haltere {escape(__version__)}. {FOOTER}</footer>",
            f'<script type="application/octet-stream" id="library">{_plotly()}</script>',
            f'<script type="application/octet-stream" id="numbers">{pack(numbers)}</script>',
            f"<script>{_resource('page.js')}</script>",
            "</body>\n</html>\n",
        ]
    )


def _header(c: Context) -> str:
    said = verdict(c)
    words = {"good": "solution good", "doubtful": "solution doubtful", "bad": "solution bad"}[said.level]
    sentences = "".join(f"<li>{escape(s)}</li>" for s in said.sentences)
    return (
        f'<header>\n<h1>{escape(c.flight.meta.name or "flight")}</h1>\n<section class="verdict {said.level}" id="verdict">'
        f'<p class="headline"><span class="badge">{words}</span> {escape(said.headline)}</p><ul>{sentences}</ul></section>\n</header>'
    )


def _first(c: Context, track: Section, figures: list[Figure]) -> str:
    """Map and facts, side by side where there is room."""
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts(c))
    flown = f'<section id="facts"><h2>Flight</h2><table class="facts">{rows}</table></section>'
    return f'<div class="first">\n{flown}\n{_section(track, figures)}\n</div>'


def _section(section: Section, figures: list[Figure]) -> str:
    """HTML of a section; its figures are added to those of the page."""
    out = [f'<section id="{section.key}"><h2>{escape(section.title)}</h2>']
    if section.note:
        out.append(f'<p class="note">{section.note}</p>')
    for figure in section.figures:
        if "title" in figure:
            out.append(f"<h3>{escape(figure['title'])}</h3>")
        name, height = f"figure-{escape(figure['name'])}", figure["height"]
        out.append(f'<div class="figure" id="{name}" data-figure="{len(figures)}" style="height:{height}px"></div>')
        figures.append(figure)
    out.append(f"{section.after}</section>")
    return "\n".join(out)
