"""What may be concluded from a comparison, in words, and what may not. It computes no measures."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

__all__ = ["conclusions", "headline", "ranked"]

#: A scored stretch shorter than this [s] is called short.
SHORT = 30.0


def _scored(summary: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {name: s for name, s in summary["solutions"].items() if s.get("errors") is not None}


def ranked(summary: dict[str, Any], measure: str, smoothers: bool = False) -> list[tuple[str, float]]:
    """Solutions and their RMS of a measure, the smallest first; with or without smoothers."""
    rows = [(n, s["errors"][measure]["rms"]) for n, s in _scored(summary).items() if measure in s["errors"] and s["smoother"] == smoothers]
    return sorted(rows, key=lambda row: row[1])


def _best(rows: list[tuple[str, float]]) -> list[str]:
    """Names of a ranking that share its smallest figure, as far as it is printed."""
    return [name for name, value in rows if f"{value:.3g}" == f"{rows[0][1]:.3g}"]


def headline(summary: dict[str, Any]) -> str:
    """One line for people, from the summary of a comparison."""
    scored = len(_scored(summary))
    if summary["span"] is None:
        return "nothing could be scored"
    if summary["against"] == "truth":
        for measure, words in (("attitude_deg", "attitude"), ("tilt_deg", "tilt")):
            rows = ranked(summary, measure)
            if rows:
                best = f"{' and '.join(_best(rows))}, {rows[0][1]:.3g} deg RMS"
                return f"{scored} solutions against truth; the smallest {words} error of a filter: {best}"
    if summary["against"] == "onboard":
        return f"{scored} solutions against the autopilot's own estimate: agreement, not accuracy"
    return f"{scored} solutions against each other: the log has nothing else to compare with"


def conclusions(summary: dict[str, Any]) -> list[str]:
    """Sentences for people, from the summary of a comparison without them.

    Against a truth solutions are ranked. Against the onboard solution, or against nothing, they are not: agreement is not accuracy,
    and what is said is what follows from differences alone.
    """
    out: list[str] = []
    if summary["span"] is None:
        return [
            "Nothing was scored: there is no time at which all solutions have settled and the reference has an attitude.",
            *_absent(summary),
        ]
    a, b = summary["span"]
    rows = (
        f"{summary['rows']} rows, t = {a:.1f} to {b:.1f} s: from {summary['settle']:g} s after the last one began, where every one has rows"
    )
    if summary["against"] == "truth":
        out.append(f"All solutions are scored on the same {rows}, against truth.")
        out += _ranking(summary)
    else:
        if summary["against"] == "onboard":
            out.append(
                "The reference is no truth but the autopilot's own estimate: a small difference from it is agreement, not accuracy, and a "
                "large one may be the autopilot's error. No ranking is made."
            )
        else:
            out.append("This log holds neither truth nor an estimate of the autopilot's: solutions are compared with each other alone.")
        out.append(f"All solutions are compared on the same {rows}.")
        out.append(
            "What they get from the same sensors does not show: a compass that is disturbed or not calibrated, a wrong declination, a "
            "GNSS error or a tilted mount shifts all solutions that use it alike."
        )
        out += _spread(summary)
        out += _against_gnss(summary)
    out += _consistency(summary)
    out += _absent(summary)
    return out


def _ranking(summary: dict[str, Any]) -> Iterable[str]:
    for measure, words, unit in (
        ("attitude_deg", "attitude", "deg"),
        ("tilt_deg", "tilt", "deg"),
        ("vel", "velocity", "m/s"),
        ("pos", "position", "m"),
    ):
        rows = ranked(summary, measure)
        if len(rows) == 1:
            yield f"{words.capitalize()}: {rows[0][0]} {rows[0][1]:.3g} {unit} RMS; no other filter estimates it."
        elif rows:
            best = _best(rows)
            others = ", ".join(f"{n} {v:.3g}" for n, v in rows[len(best) :])
            yield f"{words.capitalize()} error, RMS: {' and '.join(best)} {rows[0][1]:.3g} {unit}" + (
                f", then {others}." if others else "."
            )
        for name, value in ranked(summary, measure, smoothers=True):
            yield f"{name}, {words} {value:.3g} {unit} RMS, is a smoother: it has seen what comes after, and is no rank among filters."
    fed = [n for n, s in _scored(summary).items() if "gnss" in s.get("sensors", ())]
    blind = [n for n, s in _scored(summary).items() if s.get("sensors") and "gnss" not in s["sensors"]]
    if fed and blind:
        yield (
            f"Not all were given the same: {', '.join(fed)} had GNSS, which tells acceleration from tilt; {', '.join(blind)} had not, and "
            "take a lasting acceleration for tilt."
        )
    low, high = summary["span"]
    if high - low < SHORT:
        yield f"Only {high - low:.1f} s are scored: hardly one sample of whatever changes slowly, such as a bias."
    yield "This is one flight, and nobody was tuned to it here: on another, or with other settings, the order may be another."


def _spread(summary: dict[str, Any]) -> Iterable[str]:
    """The largest difference a measure, and what it proves: all of these obey the triangle inequality, so that one error is half of it."""
    for key, words, unit in (("attitude_deg", "attitude", "deg"), ("tilt_deg", "tilt", "deg"), ("vel", "velocity", "m/s")):
        pairs = [p for p in summary["pairs"] if p[key] is not None]
        if not pairs:
            continue
        p = max(pairs, key=lambda p: float(p[key]))
        yield (
            f"The largest difference in {words} is between {p['a']} and {p['b']}: {p[key]:.3g} {unit} RMS. At least one of the two is "
            f"therefore wrong by {0.5 * p[key]:.3g} {unit} RMS or more; which one, this does not say."
        )


def _against_gnss(summary: dict[str, Any]) -> Iterable[str]:
    rows = {n: s["gnss"] for n, s in _scored(summary).items() if s.get("gnss")}
    if summary["against"] == "onboard" and summary["onboard_gnss"]:
        rows["onboard"] = summary["onboard_gnss"]
    parts = []
    for key, words, unit in (("vel", "velocity", "m/s"), ("pos", "position", "m")):
        told = [f"{n} {g[key]['rms']:.3g}" for n, g in rows.items() if key in g]
        if told:
            parts.append(f"{words} {', '.join(told)} {unit}")
    if parts:
        yield (
            f"Difference from GNSS, RMS: {'; '.join(parts)}. Who was fed these fixes follows them: a small difference is a good fit, and "
            "of the receiver's own errors it says nothing."
        )


def _consistency(summary: dict[str, Any]) -> Iterable[str]:
    """Mean NIS and NEES of ours; peers state no uncertainty."""
    parts = []
    for name, s in summary["solutions"].items():
        nis = {
            k: v["mean"] for k, v in (s.get("nis") or {}).items() if v["mean"] is not None and k in ("gnss", "magnetometer", "barometer")
        }
        nees = {k: v["mean"] for k, v in (s.get("nees") or {}).items() if v["mean"] is not None}
        words = [
            f"mean {what} {', '.join(f'{k} {v:.2f}'.replace('_', ' ') for k, v in m.items())}"
            for what, m in (("NIS", nis), ("NEES", nees))
            if m
        ]
        if words:
            parts.append(f"{name}: {'; '.join(words)}")
    if parts:
        yield (
            f"{'. '.join(parts)}. These are squares of innovations (NIS) and errors (NEES) over what the filter states for them, over its "
            "whole run: 1 is ideal, above it the filter is too sure of itself, below it too cautious."
        )


def _absent(summary: dict[str, Any]) -> Iterable[str]:
    for name, s in summary["solutions"].items():
        if s.get("left_out"):
            yield f"{name} is not scored: {s['left_out']}."
    failed = [n for n, s in summary["solutions"].items() if s["failed"] and not s.get("missing")]
    if failed:
        yield f"Gave nothing: {', '.join(failed)}; the reasons are below."
    if summary["missing"]:
        yield f'Not installed: {", ".join(summary["missing"])}; pip install "haltere[peers]" brings them.'
