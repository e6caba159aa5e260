"""What a run prints: a short summary for people on stdout, and what was discarded on stderr. It computes nothing."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from haltere.flight.log import FlightLog
    from haltere.flight.solution import Solution

__all__ = ["lines", "losses"]


def losses(summary: dict[str, Any]) -> None:
    """Say on stderr what was discarded and what should be known of the log."""
    for note in summary["warnings"]:
        print(f"note: {note}", file=sys.stderr)
    for name, stream in summary["streams"].items():
        for reason, n in stream["discarded"].items():
            print(f"discarded: {name}: {n} samples, {reason}", file=sys.stderr)


def _row(rows: dict[str, dict[str, float]], names: list[tuple[str, str]], unit: str) -> str:
    parts = [f"{label} {rows[key]['rms']:.3g} ({rows[key]['max']:.3g})" for key, label in names if key in rows]
    return f"  {', '.join(parts)} {unit}" if parts else ""


def _errors(what: str, rows: dict[str, dict[str, float]]) -> list[str]:
    """A heading, and a line each of attitude, velocity and position, where there are any."""
    shown = [
        _row(rows, [("roll_deg", "roll"), ("pitch_deg", "pitch"), ("yaw_deg", "yaw")], "deg"),
        _row(rows, [("vel_n", "velocity north"), ("vel_e", "east"), ("vel_d", "down")], "m/s"),
        _row(rows, [("pos_n", "position north"), ("pos_e", "east"), ("pos_d", "down")], "m"),
    ]
    return [f"{what}, RMS (largest):", *(s for s in shown if s)] if any(shown) else []


def lines(solution: Solution, flight: FlightLog, folder: Path) -> list[str]:
    """The summary for people."""
    from haltere.report.words import diagnosis_in_words, verdict_of, wind_in_words

    summary = solution.summary
    said = verdict_of(solution, flight)
    out = [
        f"{summary['name'] or 'flight'}: {said.headline}",
        f"{summary['estimator']}: {summary['rows']} rows, t = {solution.t[0]:.2f} to {solution.t[-1]:.2f} s, "
        f"aligned at t = {summary['aligned_at']:.2f} s",
    ]
    for name, rows in summary["errors"].items():
        out += _errors("error against truth" if name == "truth" else f"difference from {name}", rows)
    if "smoothed" in summary:
        out.append("smoothed over the whole run: smoothed.parquet")
        for name, rows in summary["smoothed"]["errors"].items():
            out += _errors("smoothed: error against truth" if name == "truth" else f"smoothed: difference from {name}", rows)
    if summary.get("wind"):
        out.append(f"wind: {': '.join(w for w in (wind_in_words(summary['wind']), summary['wind']['verdict']) if w)}")
    if summary["health"]:
        out.append("health: " + ", ".join(f"{sensor} {h['verdict']}" for sensor, h in summary["health"].items()))
    if diagnosis_in_words(summary):
        out.append(diagnosis_in_words(summary))
    for event in [e for e in solution.events if e["kind"] != "aligned"][:8]:
        out.append(f"event: t = {event['t_detected']:.2f} s, {event['sensor']} {event['kind']}: {event['evidence']}")
    lost = {n: sum(s["discarded"].values()) for n, s in summary["streams"].items() if s["discarded"]}
    out.append("discarded: " + (", ".join(f"{n} {k}" for n, k in lost.items()) + " samples" if lost else "nothing"))
    out.append(f"report: {folder / 'report.html'}")
    return out
