"""The report on one solution: verdict, facts, map, timeline and sections. What it shows is computed elsewhere."""

from __future__ import annotations

from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.report import overview, sections, tables
from haltere.report.context import Context
from haltere.report.document import LIMIT, POINTS, document
from haltere.report.markup import Section, escape, section_html
from haltere.report.panels import Figure
from haltere.report.series import Pool
from haltere.report.words import facts, verdict

__all__ = ["page"]


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
    body = [_header(c), _first(c, track, figures), *(section_html(s, figures) for s in shown)]
    return document(c.flight.meta.name or "flight", body, [(s.key, s.title) for s in (track, *shown)], figures, c.pool)


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
    return f'<div class="first">\n{flown}\n{section_html(track, figures)}\n</div>'
