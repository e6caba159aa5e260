"""One self-contained page about a solution, and how it looks. It computes no results: it shows those of the run and its metrics."""

from __future__ import annotations

from haltere.report.page import page

__all__ = ["page"]
