"""The page of a comparison: what follows, one table, attitudes and errors of all, and what was done to each. It computes no measures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.metrics.attitude import euler
from haltere.metrics.comparison import Comparison, Series, Track, errors
from haltere.report.document import document
from haltere.report.markup import Section, escape, section_html, table
from haltere.report.panels import Figure, Panels
from haltere.report.series import Pool
from haltere.report.style import OTHERS, PEERS
from haltere.report.words import number

__all__ = ["comparison_page"]

FloatArray = NDArray[np.float64]
DEG = 180.0 / math.pi
#: Colour of each peer that is known by name.
PEER_COLOURS = {
    "vqf.VQF": "peer0", "vqf.offlineVQF": "peer1", "imufusion.Ahrs": "peer2", "ahrs.Madgwick": "peer3", "ahrs.Mahony": "peer4",
    "ahrs.EKF": "peer5",
}  # fmt: skip
#: An axis of errors reaches this many times what the middle one of the solutions needs; wilder lines leave it.
REACH = 3.0


def comparison_page(comparison: Comparison, command: str | None = None) -> str:
    """A comparison as one HTML page that loads nothing from outside.

    Parameters
    ----------
    comparison
        What `haltere.compare` gave back.
    command
        The command line that gives it again.

    Returns
    -------
    str
        The text of ``compare.html``.
    """
    summary, pool = comparison.summary, Pool()
    colours = _colours(summary)
    sections = [
        _scores(summary, colours), _errors(comparison, colours, pool), _attitude(comparison, colours, pool),
        _velocity(comparison, colours, pool), _pairs(summary, colours), _consistency(summary, colours), _done(summary, colours, command),
    ]  # fmt: skip
    shown = [s for s in sections if s.figures or s.after]
    figures: list[Figure] = []
    body = [_header(summary), *(section_html(s, figures) for s in shown)]
    title = f"{summary['name'] or 'flight'}, compared"
    return document(title, body, [(s.key, s.title) for s in shown], figures, pool, span=_span(comparison))


def _colours(summary: dict[str, Any]) -> dict[str, str]:
    """One colour a solution: a peer's goes by its name, ours by their place, the first as in every report."""
    out: dict[str, str] = {"onboard": "onboard", "truth": "truth"}
    free = [c for c in (f"peer{k}" for k in range(PEERS)) if c not in PEER_COLOURS.values()] or [f"other{k}" for k in range(OTHERS)]
    ours = strange = 0
    for name, s in summary["solutions"].items():
        if name in PEER_COLOURS:
            out[name] = PEER_COLOURS[name]
        elif s["kind"] == "peer":
            out[name] = free[strange % len(free)]
            strange += 1
        elif s["kind"] == "haltere":
            out[name] = "estimate" if ours == 0 else f"other{(ours - 1) % OTHERS}"
            ours += 1
    return out


def _span(comparison: Comparison) -> tuple[float, float]:
    """First and last time of any solution [s]."""
    low, high = min(float(k.t[0]) for k in comparison.tracks), max(float(k.t[-1]) for k in comparison.tracks)
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _header(summary: dict[str, Any]) -> str:
    sentences = "".join(f"<li>{escape(s)}</li>" for s in summary["conclusions"])
    truth = summary["against"] == "truth"
    badge = "against truth" if truth else "no truth: no ranking"
    return (
        f"<header>\n<h1>{escape(summary['name'] or 'flight')}: solutions compared</h1>\n"
        f'<section class="verdict {"good" if truth else "doubtful"}" id="verdict"><p class="headline"><span class="badge">{badge}</span> '
        f"{escape(summary['headline'])}</p><ul>{sentences}</ul></section>\n</header>"
    )


def _named(name: str, colours: dict[str, str]) -> str:
    """A solution's name with a patch of its colour."""
    return f'<span style="color:var(--{colours.get(name, "quiet")})">&#9632;</span> {escape(name)}'


def _figure(value: dict[str, float] | None) -> str:
    """RMS, and in brackets the largest."""
    return "–" if value is None else f"{number(value['rms'])} ({number(value['max'])})"


def _scores(summary: dict[str, Any], colours: dict[str, str]) -> Section:
    """The one table; a column that nobody fills is left out."""
    measures = [
        ("attitude [deg]", "attitude_deg"), ("tilt [deg]", "tilt_deg"), ("roll [deg]", "roll_deg"), ("pitch [deg]", "pitch_deg"),
        ("yaw [deg]", "yaw_deg"), ("velocity [m/s]", "vel"), ("position [m]", "pos"),
    ]  # fmt: skip
    scored = {n: s.get("errors") or {} for n, s in summary["solutions"].items()}
    measures = [m for m in measures if any(m[1] in e for e in scored.values())]
    rows = []
    for name, s in summary["solutions"].items():
        e = scored[name]
        offset = number(e["heading_offset_deg"]) if "heading_offset_deg" in e else "–"
        note = "not installed" if s.get("missing") else "failed" if s["failed"] else "not scored" if s.get("left_out") else ""
        cells = (*(_figure(e.get(key)) for _, key in measures), offset, _share(s.get("covered")), _times(s.get("times_real_time")))
        rows.append((_named(name, colours), note or ("smoother" if s["smoother"] else ""), *cells))
    what = {"truth": "error against truth", "onboard": "difference from the autopilot's estimate"}.get(summary["against"] or "", "")
    section = Section("scores", "Scores", "RMS, and in brackets the largest. " + (f"Each figure is the {what}." if what else ""))
    section.after = table(("solution", " ", *(m[0] for m in measures), "mean heading [deg]", "covers", "× real time"), rows) + (
        "<p>Attitude is the angle of the whole rotation, tilt the angle between the verticals. Roll, pitch and yaw are differences of "
        "Euler angles, which grow near pitch ±90°. Mean heading is the constant part of the heading error. Covers: share of the IMU's "
        "samples with a row. Times are of the filter alone, on this machine, as called from Python. A smoother has seen what comes after."
        "</p>"
    )
    return section


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100.0 * value:.1f} %"


def _times(value: float | None) -> str:
    return "–" if value is None else f"{value:,.0f}" if value >= 10.0 else number(value)


def _lines(
    panels: Panels, k: int, comparison: Comparison, colours: dict[str, str], pick: Any, unit: str, period: float | None = None
) -> None:
    """A line a solution: peers thin, below ours."""
    for track in reversed(comparison.tracks):
        drawn = pick(track)
        if drawn is not None:
            ours = comparison.summary["solutions"][track.name]["kind"] == "haltere"
            panels.line(k, track.name, colours[track.name], *drawn, unit=unit, period=period, width=1.9 if ours else 1.2)


def _drawn(panels: Panels, comparison: Comparison) -> Figure:
    """The figure, its legend in the order of the tables whatever lies on top."""
    order = [track.name for track in comparison.tracks]
    figure = panels.figure()
    for trace in figure["traces"]:
        trace["legendrank"] = order.index(trace["name"]) if trace["name"] in order else len(order)
    return figure


def _attitude(comparison: Comparison, colours: dict[str, str], pool: Pool) -> Section:
    """Roll, pitch and yaw of all, from each one's first row."""
    panels = Panels("attitude", pool, _span(comparison), ["roll [deg]", "pitch [deg]", "yaw [deg]"])
    angles = {track.name: DEG * euler(track.q) for track in comparison.tracks}
    for k, name in enumerate(("roll", "pitch", "yaw")):
        period = None if name == "pitch" else 360.0

        def pick(track: Track, k: int = k) -> tuple[FloatArray, FloatArray]:
            return track.t, angles[track.name][:, k]

        _lines(panels, k, comparison, colours, pick, "deg", period)
        reference = comparison.reference
        if reference is not None and comparison.against is not None:
            q = DEG * euler(reference.q)[:, k]
            panels.line(k, comparison.against, comparison.against, reference.t, q, unit="deg", period=period, width=1.4)
    note = "From each one's first row. A heading that nothing measured begins anywhere, and is drawn as it is."
    return Section("attitude", "Attitude", note, [_drawn(panels, comparison)])


def _errors(comparison: Comparison, colours: dict[str, str], pool: Pool) -> Section:
    """Errors against the reference at the scored rows."""
    truth = comparison.against == "truth"
    section = Section("errors", "Errors against truth" if truth else "Differences from the autopilot's estimate")
    reference = comparison.reference
    if reference is None or len(comparison.times) == 0:
        return section
    scored = [k for k in comparison.tracks if comparison.summary["solutions"][k.name].get("errors") is not None]
    series = {k.name: errors(k, reference, comparison.times) for k in scored}
    measures = [
        ("attitude", "attitude [deg]", "deg", DEG), ("tilt", "tilt [deg]", "deg", DEG), ("heading", "heading [deg]", "deg", DEG),
        ("vel", "velocity [m/s]", "m/s", 1.0), ("pos", "position [m]", "m", 1.0),
    ]  # fmt: skip
    measures = [m for m in measures if any(m[0] in s for s in series.values())]
    panels = Panels("errors", pool, _span(comparison), [m[1] for m in measures])
    beyond = False
    for k, (key, _, unit, factor) in enumerate(measures):

        def pick(track: Track, key: str = key, factor: float = factor) -> tuple[FloatArray, FloatArray] | None:
            s = series.get(track.name, {})
            return (s[key][0], factor * s[key][1]) if key in s else None

        _lines(panels, k, comparison, colours, pick, unit, 360.0 if key == "heading" else None)
        low, high = panels.extent[k]
        reach = _reach([s for s in series.values() if key in s], key, factor)
        beyond |= max(-low, high) > reach
        panels.extent[k] = (max(low, -reach), min(high, reach))
    section.note = "At the rows that are scored. Attitude, tilt, velocity and position are lengths of the error, heading has its sign."
    if beyond:
        section.note += " Lines that leave an axis go on: a double click on the panel shows them."
    section.figures.append(_drawn(panels, comparison))
    return section


def _reach(series: Sequence[Series], key: str, factor: float) -> float:
    largest = [factor * float(np.max(np.abs(s[key][1]))) for s in series]
    return REACH * float(np.median(largest)) if largest else math.inf


def _velocity(comparison: Comparison, colours: dict[str, str], pool: Pool) -> Section:
    """Velocity of those that estimate it."""
    section = Section("velocity", "Velocity", "North, east and down; the axis of down points down, so that climbing goes up.")
    if not any(track.vel is not None for track in comparison.tracks):
        return section
    panels = Panels("velocity", pool, _span(comparison), ["north [m/s]", "east [m/s]", "down [m/s]"])
    panels.reversed = {2}
    for k in range(3):

        def pick(track: Track, k: int = k) -> tuple[FloatArray, FloatArray] | None:
            return None if track.vel is None else (track.t, track.vel[:, k])

        _lines(panels, k, comparison, colours, pick, "m/s")
        reference = comparison.reference
        if reference is not None and reference.vel is not None and comparison.against is not None:
            panels.line(k, comparison.against, comparison.against, reference.t, reference.vel[:, k], unit="m/s", width=1.4)
    section.figures.append(_drawn(panels, comparison))
    return section


def _pairs(summary: dict[str, Any], colours: dict[str, str]) -> Section:
    """Every solution against every other."""
    section = Section("pairs", "Solutions against each other")
    pairs = summary["pairs"]
    names = list(dict.fromkeys(n for p in pairs for n in (p["a"], p["b"])))
    known = {frozenset((p["a"], p["b"])): p for p in pairs}
    for key, words, unit in (
        ("attitude_deg", "attitude", "deg"), ("tilt_deg", "tilt", "deg"), ("heading_deg", "heading", "deg"),
        ("vel", "velocity", "m/s"), ("pos", "position", "m"),
    ):  # fmt: skip
        mine = [n for n in names if any(p[key] is not None for p in pairs if n in (p["a"], p["b"]))]
        if len(mine) < 2:
            continue
        rows = []
        for a in mine:
            values = [None if a == b else known[frozenset((a, b))][key] for b in mine]
            rows.append((_named(a, colours), *("" if a == b else number(v) for b, v in zip(mine, values, strict=True))))
        section.after += table((f"{words} [{unit}]", *mine), rows, caption=f"difference in {words}, RMS")
    section.note = (
        "Where two differ, at least one of them is wrong by half the difference or more (for heading, as long as their tilts hardly "
        "differ); two that agree may be wrong alike."
    )
    return section


def _consistency(summary: dict[str, Any], colours: dict[str, str]) -> Section:
    """NIS and NEES of ours, and differences from GNSS of all that have a velocity or position."""
    section = Section("consistency", "What needs no truth, and what ours state of themselves")
    tested = []
    for name, s in summary["solutions"].items():
        for what, entries in (("NIS", s.get("nis") or {}), ("NEES", s.get("nees") or {})):
            for key, v in entries.items():
                band = f"{number(v['band'][0])} … {number(v['band'][1])}"
                tested.append((_named(name, colours), what, escape(key.replace("_", " ")), number(v["mean"]), band, f"{v['n']:,}"))
    if tested:
        heads = ("solution", "statistic ", "of ", "mean", "95 % band", "samples")
        section.after += table(heads, tested, caption="squared innovations (NIS) and errors (NEES) over their stated variance; 1 is ideal")
        section.after += "<p>Over each one's whole run. Peers state no uncertainty of attitude that could be tested.</p>"
    own = {n: s.get("gnss") or {} for n, s in summary["solutions"].items()}
    if summary["against"] == "onboard":
        own["onboard"] = summary["onboard_gnss"]
    rows = [(_named(n, colours), _figure(g.get("vel")), _figure(g.get("pos"))) for n, g in own.items() if g]
    if rows:
        section.after += table(("solution", "velocity [m/s]", "position [m]"), rows, caption="difference from GNSS fixes, RMS (largest)")
        section.after += "<p>Who was fed these fixes follows them: this is a fit, not an accuracy.</p>"
    return section


def _done(summary: dict[str, Any], colours: dict[str, str], command: str | None) -> Section:
    """How each was called."""
    section = Section(
        "done", "What was done to each", "No estimator and no peer was given onboard or truth, for alignment or anything else."
    )
    rows = []
    for name, s in summary["solutions"].items():
        words = [*s.get("done", []), *([f"gave nothing: {s['failed']}"] if s["failed"] else [])]
        rows.append((_named(name, colours), escape(s.get("maker", "")), "; ".join(escape(w) for w in words)))
    section.after = table(("solution", "made by ", "how it was called "), rows)
    section.after += (
        f"<p>Scored {summary['settle']:g} s after the slowest solution's first row; a solution is interpolated to the reference's times, "
        "attitude along the shortest turn, and never over more than half a second; rows of the reference without a value are skipped.</p>"
    )
    if command:
        section.after += f'<p>The command that gives this again:</p><pre class="command">{escape(command)}</pre>'
    return section
