"""The report on one solution: verdict, facts, map, timeline and sections. What it shows is computed elsewhere."""

from __future__ import annotations

import numpy as np

from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.report import overview, sections, tables
from haltere.report.context import Context
from haltere.report.document import document
from haltere.report.faults import faults
from haltere.report.health import health
from haltere.report.markup import Section, escape, section_html
from haltere.report.panels import Figure
from haltere.report.series import Pool
from haltere.report.view import view
from haltere.report.wind import wind
from haltere.report.words import facts, verdict

__all__ = ["page"]

#: Sentences of the verdict that a first screen has room for, with the first, which is folded.
SENTENCES = 6


@np.errstate(all="ignore")  # what is near the end of the range is a damaged sample, and shows as such
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
    c = Context(solution, flight, Pool())
    timeline = overview.timeline(c)
    timeline.after = tables.events(c)
    parts = [
        timeline, faults(c), sections.attitude(c), sections.velocity(c), sections.position(c), view(c), sections.biases(c), wind(c),
        sections.errors(c), sections.innovations(c), tables.consistency(c), health(c), tables.data(c), tables.configuration(c, command),
    ]  # fmt: skip
    shown = [s for s in parts if s is not None and (s.figures or s.note or s.after)]
    track = overview.track(c)
    figures: list[Figure] = []
    body = [_first(c, track, figures), *(section_html(s, figures) for s in shown)]
    links = [(s.key, s.title) for s in (track, *shown)]
    return document(_name(c), body, links, figures, c.pool, span=c.span, shades=overview.shades(c))


def _name(c: Context) -> str:
    return c.flight.meta.name or "flight"


def _verdict(c: Context) -> str:
    """The verdict; what does not fit a first screen is folded, and so is its first sentence, which says when the estimator ran."""
    said = verdict(c)
    words = {"good": "solution good", "doubtful": "solution doubtful", "bad": "solution bad"}[said.level]
    shown, folded = said.sentences[1:SENTENCES], said.sentences[SENTENCES:] + said.sentences[:1]
    return (
        f'<header><h1>{escape(_name(c))}</h1>\n<section class="verdict {said.level}" id="verdict">'
        f'<p class="headline"><span class="badge">{words}</span> {escape(said.headline)}</p>{_list(shown)}{_more(_list(folded))}'
        "</section></header>"
    )


def _list(sentences: list[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(s)}</li>' for s in sentences)}</ul>" if sentences else ""


def _more(html: str) -> str:
    return f'<details class="more"><summary>more</summary>{html}</details>'


def _facts(c: Context) -> str:
    rows = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in facts(c))
    return f'<section id="facts"><h2>Flight</h2><dl>{rows}</dl></section>'


def _first(c: Context, track: Section, figures: list[Figure]) -> str:
    """Verdict and facts, and beside them the map where there is room."""
    beside = ' class="first"' if track.figures else ""
    return f"<div{beside}>\n<div>{_verdict(c)}\n{_facts(c)}</div>\n{section_html(track, figures)}\n</div>"
