"""`haltere info LOG`: what a log holds, and what can be done with it. It runs no estimator."""

from __future__ import annotations

import json as json_
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from haltere.flight.log import FlightLog

__all__ = ["info", "summary"]


def info(log: Path, json: bool = False, columns: Path | None = None, column: list[str] | None = None) -> None:
    """Print what a log holds.

    Parameters
    ----------
    log
        A log or flight folder.
    json
        Print only the summary, as JSON.
    columns, column
        Column map of a single table: a file, and single columns.

    Raises
    ------
    HaltereError
        The log cannot be read.
    """
    from haltere.cli.columns import column_map
    from haltere.readers import read

    flight = read(log, column_map(columns, column))
    if json:
        print(json_.dumps(summary(flight), indent=2, allow_nan=False, ensure_ascii=False))
        return
    from rich.console import Console

    _print(flight, Console(soft_wrap=True, highlight=False))


def summary(flight: FlightLog) -> dict[str, Any]:
    """The content of a flight and what it supports, in JSON's types.

    Returns
    -------
    dict
        ``haltere, name, source, start_utc, time_offset, home, streams, notes, doubts, discarded, estimators``. Numbers that are not
        known are None; ``doubts`` are units and axes that look wrong, with the key that puts them right.
    """
    from haltere._version import __version__
    from haltere.readers.support import doubts, streams, support

    meta = flight.meta
    return {
        "haltere": __version__,
        "name": meta.name,
        "source": meta.source,
        "start_utc": meta.start_utc,
        "time_offset": meta.time_offset,
        "home": {"lat": meta.home.lat, "lon": meta.home.lon, "alt": meta.home.alt} if meta.home else None,
        "imu_kind": meta.imu_kind,
        "streams": {
            s.name: {
                "n": s.n,
                "rate": _known(s.rate),
                "mean_rate": _known(s.mean_rate),
                "start": _known(s.start),
                "end": _known(s.end),
                "duration": _known(s.duration),
                "gaps": s.gaps,
                "largest_gap": _known(s.largest_gap),
                "largest_gap_at": _known(s.largest_gap_at),
                "columns": s.columns,
                "discarded": flight.discarded.get(s.name, {}),
            }
            for s in streams(flight)
        },
        "notes": flight.notes,
        "doubts": doubts(flight),
        "discarded": flight.discarded,
        "estimators": {
            s.estimator: {"verdict": s.verdict, "can": list(s.can), "cannot": list(s.cannot), "remedies": list(s.remedies)}
            for s in support(flight)
        },
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _cell(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _columns(columns: dict[str, str]) -> str:
    """Columns with their units; neighbours of one unit share it."""
    parts: list[tuple[str, str]] = []
    for name, unit in columns.items():
        if name == "t":
            continue
        if parts and parts[-1][1] == unit:
            parts[-1] = (f"{parts[-1][0]}, {name}", unit)
        else:
            parts.append((name, unit))
    return "; ".join(f"{names} [{unit}]" if unit not in ("", "1") else names for names, unit in parts)


def _print(flight: FlightLog, console: Console) -> None:
    from rich.markup import escape
    from rich.table import Table

    from haltere.readers.support import doubts, streams, support

    meta = flight.meta
    console.print(f"[bold]{escape(meta.name)}[/bold]  {escape(meta.source)}")
    clock = f"t {'-' if meta.time_offset < 0.0 else '+'} {abs(meta.time_offset):.6f} s"
    if meta.start_utc:
        console.print(f"start {meta.start_utc}, log clock = {clock}")
    elif meta.time_offset:
        console.print(f"log clock = {clock}, UTC unknown")
    if meta.home:
        console.print(f"home {meta.home.lat:.7f} deg, {meta.home.lon:.7f} deg, {meta.home.alt:.1f} m")
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("stream", no_wrap=True)
    for head in ("samples", "rate Hz", "mean Hz", "from s", "to s", "gaps", "longest s"):
        table.add_column(head, justify="right", no_wrap=True)
    alike: dict[str, list[str]] = {}
    for s in streams(flight):
        numbers = (_cell(s.rate, 1), _cell(s.mean_rate, 1), _cell(s.start, 2), _cell(s.end, 2))
        table.add_row(s.name, f"{s.n}", *numbers, f"{s.gaps}", _cell(s.largest_gap, 3))
        alike.setdefault(_columns(s.columns), []).append(s.name)
    console.print(table, soft_wrap=False)
    for columns, names in alike.items():
        console.print(f"{', '.join(names)}: {escape(columns)}")
    for note in flight.notes:
        console.print(f"note: {escape(note)}")
    for doubt in doubts(flight):
        console.print(f"[yellow]check[/yellow]: {escape(doubt)}")
    for name, reasons in flight.discarded.items():
        for reason, n in reasons.items():
            console.print(f"discarded: {escape(name)}: {n} samples, {escape(reason)}")
    for judged in support(flight):
        colour = {"yes": "green", "limited": "yellow", "no": "red"}[judged.verdict]
        console.print(f"[bold]{judged.estimator}[/bold]: [{colour}]{judged.verdict}[/{colour}]")
        for head, lines in (("can", judged.can), ("cannot", judged.cannot), ("to improve", judged.remedies)):
            for line in lines:
                console.print(f"  {head}: {escape(line)}")
