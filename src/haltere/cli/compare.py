"""`haltere compare LOG`: one flight through several estimators and installed peers, one table, one page. It computes nothing itself."""

from __future__ import annotations

import json as json_
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haltere.cli.progress import Progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

__all__ = ["compare", "default_folder"]


def default_folder(log: Path) -> Path:
    """Where a comparison is written when nothing else is said: ``./<log stem>.haltere-compare``."""
    log = Path(log)
    named = log if log.stem not in ("", "..") else log.resolve()
    return Path(f"{named.stem or 'flight'}.haltere-compare")


def compare(
    log: Path,
    *,
    estimators: str,
    peers: str,
    against: str | None,
    assignments: list[str],
    settle: float,
    out: Path | None,
    json: bool,
    show: bool,
) -> None:
    """Compare solutions of a flight and write the folder.

    Parameters
    ----------
    log
        A log or flight folder.
    estimators, peers, against, settle
        As of `haltere.compare`.
    assignments
        ``key=value`` texts for all of our estimators.
    out
        Folder to write; default `default_folder`.
    json
        Print only the summary, as JSON.
    show
        Open the page in the browser.

    Raises
    ------
    HaltereError
        The log cannot be read or compared, or the folder not be written.
    UsageError
        Unknown estimator, peer, preset, key or reference.
    """
    from haltere.errors import UsageError
    from haltere.evaluate.choice import choices, peers_named
    from haltere.flight import config as configuration

    # Wrong usage is found before the log is read.
    changes = dict(configuration.parse_assignment(text) for text in assignments)
    choices(estimators, changes)
    peers_named(peers)
    if against not in (None, "truth", "onboard"):
        raise UsageError("truth or onboard", repr(against), "--against")

    folder = Path(out) if out is not None else default_folder(log)
    words = [
        "haltere", "compare", str(log), "--estimators", estimators, "--peers", peers, *(["--against", against] if against else []),
        *(w for text in assignments for w in ("--set", text)), "--settle", f"{settle:g}", *(["--out", str(out)] if out else []),
    ]  # fmt: skip
    with Progress() as progress:
        progress.stage("reading the log")
        from haltere.readers import read

        flight = read(log)
        progress.stage("compiling the filter, on the first run only")
        from haltere.evaluate.compare import compare as compared
        from haltere.evaluate.files import write
        from haltere.report.comparison import comparison_page

        at = ""

        def told(name: str, fraction: float) -> None:
            nonlocal at
            if name != at:
                at = name
                progress.stage(name)
            progress.update(fraction)

        comparison = compared(flight, estimators, peers=peers, against=against, set=changes, settle=settle, progress=told)
        progress.stage("drawing the page")
        text = comparison_page(comparison, shlex.join(words))
        progress.stage("writing")
        write(comparison, folder, {"compare.html": text})
    summary = comparison.summary
    for reason in _reasons(summary):
        print(reason, file=sys.stderr)
    if json:
        print(json_.dumps(summary, indent=1, allow_nan=False, ensure_ascii=False))
    else:
        _print(summary, folder)
    if show:
        import webbrowser

        webbrowser.open((folder / "compare.html").resolve().as_uri())


def _reasons(summary: dict[str, Any]) -> list[str]:
    """Why a solution has no row of figures, and what was discarded of the log."""
    out = [f"{name}: {s['failed']}" for name, s in summary["solutions"].items() if s["failed"]]
    lost = summary["discarded"]
    return out + [f"discarded: {stream}: {n} samples, {reason}" for stream, reasons in lost.items() for reason, n in reasons.items()]


def _cell(value: dict[str, float] | None) -> str:
    return "–" if value is None else f"{value['rms']:.3g} ({value['max']:.3g})"


def _columns(summary: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """Heads and cells of the columns that somebody fills, one cell a solution."""
    solutions = list(summary["solutions"].values())
    out = []
    for head, key in (
        ("attitude\ndeg", "attitude_deg"), ("tilt\ndeg", "tilt_deg"), ("yaw\ndeg", "yaw_deg"), ("velocity\nm/s", "vel"),
        ("position\nm", "pos"),
    ):  # fmt: skip
        if any(key in (s.get("errors") or {}) for s in solutions):
            out.append((head, [_cell((s.get("errors") or {}).get(key)) for s in solutions]))
    out.append(("covers", [f"{100.0 * s['covered']:.1f} %" if "covered" in s else "–" for s in solutions]))
    out.append(("x real\ntime", [f"{s['times_real_time']:,.3g}" if "times_real_time" in s else "–" for s in solutions]))
    return out


def _notes(summary: dict[str, Any]) -> list[str]:
    """Who is no filter, and who has no figures, a line each."""
    kinds: dict[str, list[str]] = {}
    for name, s in summary["solutions"].items():
        word = "not installed" if s.get("missing") else "failed" if s["failed"] else "not scored" if s.get("left_out") else ""
        word = word or ("smoother" if s["smoother"] else "")
        if word:
            kinds.setdefault(word, []).append(name)
    return [f"{word}: {', '.join(names)}" for word, names in kinds.items()]


def _tables(summary: dict[str, Any], console: Console) -> list[Table]:
    """The one table, cut into as many as it takes for none to be wider than the screen."""
    from rich.markup import escape
    from rich.table import Table

    def made(columns: list[tuple[str, list[str]]]) -> Table:
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("solution", no_wrap=True)
        for head, _ in columns:
            table.add_column(head, justify="right", no_wrap=True)
        for i, name in enumerate(summary["solutions"]):
            table.add_row(escape(name), *(escape(cells[i]) for _, cells in columns))
        return table

    unbounded = console.options.update(width=10_000)
    groups: list[list[tuple[str, list[str]]]] = [[]]
    for column in _columns(summary):
        if groups[-1] and console.measure(made([*groups[-1], column]), options=unbounded).maximum > console.width:
            groups.append([])
        groups[-1].append(column)
    return [made(g) for g in groups]


def _print(summary: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.markup import escape

    console = Console(soft_wrap=True, highlight=False)
    console.print(f"[bold]{escape(summary['name'] or 'flight')}[/bold]: {escape(summary['headline'])}")
    what = {"truth": "error against truth", "onboard": "difference from the autopilot's own estimate"}.get(summary["against"] or "")
    if what:
        console.print(f"{what}, RMS (largest):")
    for table in _tables(summary, console):
        console.print(table, soft_wrap=False)
    for note in _notes(summary):
        console.print(escape(note))
    for sentence in summary["conclusions"]:
        console.print(f"- {escape(sentence)}")
    console.print(f"page: {escape(str(folder / 'compare.html'))}")
