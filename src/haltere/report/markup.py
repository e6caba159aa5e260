"""Parts of a page as HTML: escaped text, tables, sections. It knows no solution and no sensor."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from haltere.report.panels import Figure

__all__ = ["Section", "escape", "section_html", "table"]


@dataclass
class Section:
    """One part of the page: its figures, and HTML before and after them."""

    key: str
    title: str
    note: str = ""
    figures: list[Figure] = field(default_factory=list)
    after: str = ""
    before: str = ""


def escape(text: object) -> str:
    """Text for HTML."""
    return html.escape(str(text), quote=True)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], classes: Sequence[str] = (), caption: str = "") -> str:
    """A table of cells that are HTML already; columns after the first whose head ends in a blank are text, others numbers."""
    kinds = ["" if k == 0 or h.endswith(" ") else ' class="num"' for k, h in enumerate(heads)]
    head = "".join(f"<th{kind}>{escape(h.strip())}</th>" for h, kind in zip(heads, kinds, strict=True))
    marks = [*classes]
    body = "".join(
        f"<tr{f' class={chr(34)}{marks[i]}{chr(34)}' if i < len(marks) and marks[i] else ''}>"
        + "".join(f"<td{kind}>{cell}</td>" for cell, kind in zip(row, kinds, strict=True))
        + "</tr>"
        for i, row in enumerate(rows)
    )
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f'<div class="wide"><table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def section_html(section: Section, figures: list[Figure]) -> str:
    """HTML of a section; its figures are added to those of the page."""
    out = [f'<section id="{section.key}"><h2>{escape(section.title)}</h2>']
    if section.note:
        out.append(f'<p class="note">{section.note}</p>')
    if section.before:
        out.append(section.before)
    for figure in section.figures:
        if "title" in figure:
            out.append(f"<h3>{escape(figure['title'])}</h3>")
        name, height = f"figure-{escape(figure['name'])}", figure["height"]
        out.append(f'<div class="figure" id="{name}" data-figure="{len(figures)}" style="height:{height}px"></div>')
        if "reading" in figure:
            out.append(f'<p class="note">{escape(figure["reading"])}</p>')
        figures.append(figure)
    out.append(f"{section.after}</section>")
    return "\n".join(out)
