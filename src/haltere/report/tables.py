"""Tables of a report as HTML: errors, consistency, streams, discards, events, configuration. It computes no results."""

from __future__ import annotations

import math
from typing import Any

from haltere.flight.config import KEYS, Value, defaults
from haltere.flight.schema import base_name
from haltere.report.consistency import consistency_figures
from haltere.report.context import Context, sensor_label
from haltere.report.markup import Section, escape, table
from haltere.report.words import count, discarded, episode_in_words, nis_in_words, number

__all__ = ["configuration", "consistency", "data", "errors_table", "events"]

#: Rows of a table of events or episodes at most.
ROWS = 40


_UNITS = {
    "gyro_bias": ("deg/s", 180.0 / math.pi), "accel_bias": ("m/s²", 1.0), "vel": ("m/s", 1.0), "pos": ("m", 1.0), "wind": ("m/s", 1.0),
}  # fmt: skip


def errors_table(c: Context) -> str:
    """RMS and largest error against each reference, of the filter and of what was smoothed."""
    summary = c.solution.summary
    out = _errors_table(summary.get("errors", {}), "")
    return out + _errors_table(summary.get("smoothed", {}).get("errors", {}), "smoothed: ")


def _errors_table(errors: dict[str, Any], whose: str) -> str:
    out = ""
    for name, rows in errors.items():
        if not rows:
            continue
        cells = []
        for key, row in rows.items():
            if row["rms"] is None or row["max"] is None:  # nothing of it could be compared
                continue
            stem = key.rpartition("_")[0]
            unit, factor = ("deg", 1.0) if key.endswith("_deg") else _UNITS.get(stem, ("", 1.0))
            label = key.removesuffix("_deg").replace("_", " ")
            cells.append((escape(label), number(factor * row["rms"]), number(factor * row["max"]), escape(unit), f"{row.get('n', 0):,}"))
        what = "errors against truth" if name == "truth" else f"differences from {name}"
        out += table(("quantity", "RMS", "largest", "unit ", "samples"), cells, caption=whose + what)
    return out


def consistency(c: Context) -> Section:
    """NIS and NEES against their χ² bands, in a table and in words."""
    summary = c.solution.summary
    section = Section("consistency", "Is the stated uncertainty true?", figures=consistency_figures(c))
    nis = summary.get("nis", {})
    rows: list[tuple[str, ...]] = [
        (
            escape(sensor_label(sensor)), f"{v['n']:,}", number(v["mean"]), f"{number(v['band'][0])} … {number(v['band'][1])}",
            f"{v['rejected']:,}", f"{v['deweighted']:,}", escape(nis_in_words(sensor, v["mean"], v["band"])),
        )
        for sensor, v in ((s, nis[s]) for s in c.sensors if s in nis)
    ]  # fmt: skip
    if rows:
        section.after += table(("sensor", "tested", "mean NIS", "95 % band", "refused", "de-weighted", "reading "), rows,
                               caption="squared innovations over their stated variance (NIS); 1 is ideal")  # fmt: skip
    rows = [
        (escape(block.replace("_", " ")), number(v["mean"]), f"{number(v['band'][0])} … {number(v['band'][1])}", f"{v['dof']}")
        for block, v in summary.get("nees", {}).items()
    ]
    if rows:
        caption = "squared errors over their stated variance a degree of freedom (NEES), against truth; 1 is ideal"
        section.after += table(("block", "mean NEES", "95 % band", "degrees of freedom"), rows, caption=caption)
        rows = [
            (escape(block.replace("_", " ")), number(v["mean"]), f"{number(v['band'][0])} … {number(v['band'][1])}", f"{v['dof']}")
            for block, v in summary.get("smoothed", {}).get("nees", {}).items()
        ]
        if rows:
            section.after += table(("block", "mean NEES", "95 % band", "degrees of freedom"), rows, caption="NEES of the smoothed solution")
    elif nis:
        section.after += "<p>No NEES: it needs a truth, and this flight has none.</p>"
    section.after += errors_table(c)
    if not section.after and not section.figures:
        section.note = "Nothing to say: no measurement was offered to the filter, and there is nothing to compare with."
    return section


def data(c: Context) -> Section:
    """Streams with rates and gaps, and what was discarded and why."""
    summary = c.solution.summary
    section = Section("data", "Data, and what was discarded")
    lost = discarded(summary)
    if lost:
        left = [(escape(s), escape(why), f"{n:,}", f"{100.0 * n / max(size, 1):.2g} %") for s, why, n, size in lost]
        section.after += table(("stream", "reason ", "samples", "of the stream"), left, caption="discarded")
    else:
        section.after += "<p>No sample was discarded.</p>"
    warnings = summary.get("warnings", [])
    if warnings:
        section.after += "<ul>" + "".join(f"<li>{escape(w)}</li>" for w in warnings) + "</ul>"
    rows = []
    for name, facts in summary.get("streams", {}).items():
        stream = c.flight.get(name)
        length = float(stream.t[-1] - stream.t[0]) if stream is not None and len(stream) > 1 else 0.0
        mean = (facts["n"] - 1) / length if length > 0.0 else None
        compared = base_name(name) in ("onboard", "truth")
        note = "compared with, never read by the estimator" if compared else "" if base_name(name) == name else "further unit, not used"
        gap = facts.get("longest_gap")
        rows.append(
            (
                escape(name),
                f"{facts['n']:,}",
                "–" if compared else number(facts["rate"]),
                number(mean),
                "–" if compared else f"{facts['gaps']}",
                number(gap),
                "–" if gap is None else f"{facts['longest_gap_at']:.2f}",
                note,
            )
        )
    heads = ("stream", "samples", "rate [Hz]", "mean [Hz]", "gaps", "longest interval [s]", "from t [s]", "note ")
    section.after += table(heads, rows, caption="streams of the log")
    return section


def _time(event: dict[str, Any]) -> str:
    t = event.get("t_onset") if event.get("t_onset") is not None else event.get("t_detected")
    return "–" if t is None else f"{t:.3f}"


def events(c: Context) -> str:
    """Events, and stretches of refused measurements, as tables."""
    rows = [
        (
            _time(e), escape(sensor_label(e["sensor"])) + (f" {escape(e['axis'])}" if e.get("axis") not in (None, "") else ""),
            escape(e["kind"]), escape(e.get("evidence") or ""),
        )
        for e in c.solution.events[:ROWS]
    ]  # fmt: skip
    out = table(("t [s]", "sensor ", "event ", "evidence "), rows, caption="events") if rows else "<p>No event was recorded.</p>"
    if len(c.solution.events) > ROWS:
        out += f"<p>{len(c.solution.events) - ROWS} further events in events.json.</p>"
    largest = sorted(sorted(c.episodes, key=lambda e: -e.n)[:ROWS], key=lambda e: e.start)
    if largest:
        items = "".join(f"<li>{escape(episode_in_words(e))}</li>" for e in largest)
        more = f"<p>{len(c.episodes) - len(largest)} smaller stretches in aids.parquet.</p>" if len(c.episodes) > len(largest) else ""
        title = f"{count(len(c.episodes), 'stretch', 'stretches')} of refused or de-weighted measurements"
        out += f"<details><summary>{title}</summary><ul>{items}</ul>{more}</details>"
    return out


def _shown(value: Value) -> str:
    if isinstance(value, float):
        return "from the data" if math.isnan(value) else f"{value:.6g}"
    return str(value)


def configuration(c: Context, command: str | None) -> Section:
    """Keys that differ from the defaults, all keys, and how to repeat the run."""
    config = c.solution.config
    section = Section("configuration", "Configuration")
    section.note = f"Estimator {escape(config.estimator)}, preset {escape(config.preset)}."
    usual = defaults(config.estimator, config.preset)
    rows, marks, changed = [], [], []
    for key, value in config.values.items():
        before = usual[key]
        same = value == before or (isinstance(value, float) and isinstance(before, float) and math.isnan(value) and math.isnan(before))
        found = not same and isinstance(before, float) and math.isnan(before)
        shown = escape(_shown(value)) if same else f"<b>{escape(_shown(value))}</b>"
        row = (f"<code>{escape(key)}</code>", shown, escape(KEYS[key].unit), escape(_shown(before)), escape(KEYS[key].doc))
        rows.append(row)
        marks.append("" if same else "found" if found else "changed")
        if not same:
            changed.append((row, marks[-1]))
    heads = ("key", "value", "unit ", "default", "meaning ")
    if changed:
        section.after += table(heads, [r for r, _ in changed], [m for _, m in changed], caption="keys that are not at their default")
        section.after += "<p>Shaded strongly: set by the user or the log. Shaded lightly: no default, taken from the data or a model.</p>"
    else:
        section.after += "<p>Every key is at its default.</p>"
    section.after += f"<details><summary>all {len(rows)} keys</summary>{table(heads, rows, marks)}</details>"
    section.after += f"<details><summary>config.toml</summary><pre>{escape(config.to_toml())}</pre></details>"
    again = command or "haltere run LOG --config config.toml"
    section.after += f'<p>The command that gives this result again:</p><pre class="command">{escape(again)}</pre>'
    if command is None:
        section.after += "<p>with config.toml as above and LOG the log that was read.</p>"
    return section
