"""`haltere campaign SPEC`: many runs, their tables, verdicts and page. It computes nothing itself."""

from __future__ import annotations

import json as json_
import shlex
import sys
from pathlib import Path
from typing import Any

from haltere.cli.progress import Progress

__all__ = ["campaign", "duration"]


def campaign(
    specification: Path, out: Path | None, *, workers: int | None, scheduler: str | None, strict: bool, json: bool, show: bool
) -> None:
    """Make the runs of a campaign that are not there yet, and write its folder.

    Parameters
    ----------
    specification
        A TOML file.
    out
        Folder to write; default ``./<name>.campaign``.
    workers, scheduler
        As of `haltere.evaluate.campaign.campaign`.
    strict
        A requirement that is not met is exit status 1.
    json
        Print only the summary, as JSON.
    show
        Open the page in the browser.

    Raises
    ------
    HaltereError
        A file that cannot be read, a folder that cannot be written, or a scheduler that is not there.
    UsageError
        A specification that is not one.
    """
    from haltere.evaluate.campaign import Progress as Reached
    from haltere.evaluate.campaign import campaign as made
    from haltere.evaluate.campaign_plan import load_plan

    words = [
        "haltere", "campaign", str(specification), *(["--out", str(out)] if out is not None else []),
        *(["--workers", str(workers)] if workers is not None else []), *(["--scheduler", scheduler] if scheduler is not None else []),
    ]  # fmt: skip
    with Progress() as progress:
        progress.stage("reading the specification")

        def told(p: Reached) -> None:
            failed = f", {p.failed} failed" if p.failed else ""
            progress.update(p.done / p.total, f"{p.done:,} of {p.total:,} runs{failed}, {duration(p.left)} left")

        plan = load_plan(specification)
        progress.stage(f"{len(plan.runs):,} runs", compiles=True)
        try:
            results = made(plan, out, workers=workers, scheduler=scheduler, progress=told)
        except KeyboardInterrupt:
            print("haltere: interrupted; the same command goes on from here", file=sys.stderr)
            raise
        progress.stage("drawing the page")
        from haltere.report.campaign import campaign_page

        page = campaign_page(results.runs, results.faults, results.summary, plan.text, shlex.join(words))
        progress.stage("writing")
        folder = results.save({"campaign.html": page})
    summary = results.summary
    for line in [*summary["notes"], *(f"{n} runs failed: {why}" for why, n in summary["failures"].items())]:
        print(line, file=sys.stderr)
    if json:
        print(json_.dumps(summary, indent=1, allow_nan=False, ensure_ascii=False))
    else:
        for line in _lines(summary, folder):
            print(line)
    if show:
        import webbrowser

        webbrowser.open((folder / "campaign.html").resolve().as_uri())
    if strict and not results.passed:
        sys.exit(1)


def duration(seconds: float) -> str:
    """``40 s``, ``12 min``, ``3.5 h``."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5970.0 else f"{seconds / 3600.0:.1f} h"


def _lines(summary: dict[str, Any], folder: Path) -> list[str]:
    """The summary for people."""
    timings = summary["timings"]
    how = f"{timings['made']:,} made in {duration(timings['wall_s'])}" + (
        f", {timings['resumed']:,} from before" if timings["resumed"] else ""
    )
    failed = f", {summary['failed']:,} failed" if summary["failed"] else ""
    out = [f"{summary['name']}: {summary['runs']:,} runs, {summary['done']:,} done{failed} ({how})"]
    for estimator, metrics in summary["metrics"].items():
        parts = [
            f"{words} {metrics[key]['median']:.3g} ({metrics[key]['p95']:.3g}) {unit}"
            for key, words, unit in (("tilt_deg.rms", "tilt", "deg"), ("heading_deg.rms", "heading", "deg"), ("vel.rms", "velocity", "m/s"),
                                     ("pos.rms", "position", "m"), ("wind.rms", "wind", "m/s"))
            if key in metrics
        ]  # fmt: skip
        if parts:
            out.append(f"{estimator}: RMS error, median over runs (95 % below): {', '.join(parts)}")
    out += [r["verdict"] for r in summary["requirements"]]
    if summary["requirements"]:
        met = sum(r["met"] for r in summary["requirements"])
        out.append(f"requirements: {met} of {len(summary['requirements'])} met")
    return [*out, f"page: {folder / 'campaign.html'}"]
