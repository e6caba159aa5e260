"""The page of a campaign: verdicts, distributions of errors, detection, consistency, and what failed. It computes no measures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from haltere.metrics.campaign import (
    DONE,
    MISSED,
    NOBODY,
    by_size,
    confusion,
    consistency,
    distribution,
    estimators,
    of_estimator,
    quartiles,
    roc,
)  # fmt: skip
from haltere.report.document import document
from haltere.report.grid import Grid
from haltere.report.markup import Section, escape, section_html, table
from haltere.report.panels import Figure, plain
from haltere.report.series import Pool, thin
from haltere.report.style import OTHERS
from haltere.report.words import count, number

if TYPE_CHECKING:
    import polars as pl

__all__ = ["campaign_page"]

FloatArray = NDArray[np.float64]
DEG = 180.0 / math.pi
#: Errors that are drawn: column, name, unit, factor.
MAIN = (
    ("tilt_deg.rms", "tilt", "deg", 1.0), ("heading_deg.rms", "heading", "deg", 1.0), ("vel.rms", "velocity", "m/s", 1.0),
    ("pos.rms", "position", "m", 1.0), ("wind.rms", "wind", "m/s", 1.0), ("gyro_bias.rms", "gyro bias", "deg/s", DEG),
    ("accel_bias.rms", "accel. bias", "m/s²", 1.0),
)  # fmt: skip
#: Units of the sizes of faults, by sensor and kind.
UNITS = {
    **{("gyro", kind): "rad/s" for kind in ("bias", "noise", "spike", "saturate")}, ("gyro", "ramp"): "rad/s²",
    **{("accel", kind): "m/s²" for kind in ("bias", "noise", "spike", "saturate")}, ("accel", "ramp"): "m/s³",
    ("magnetometer", "disturb"): "of the field", ("magnetometer", "bias"): "µT", ("rotor", "thrust"): "factor", ("wind", "step"): "m/s",
}  # fmt: skip
#: Errors that settle: name, unit, factor.
SETTLING = {
    "tilt_deg": ("tilt", "deg", 1.0), "heading_deg": ("heading", "deg", 1.0), "vel": ("velocity", "m/s", 1.0),
    "pos": ("position", "m", 1.0), "wind": ("wind", "m/s", 1.0), "gyro_bias": ("gyro bias", "deg/s", DEG),
    "accel_bias": ("accel. bias", "m/s²", 1.0),
}  # fmt: skip
#: Most values of a factor that have a box each, points of a scatter, and different failures listed.
BOXES, POINTS, FAILURES = 16, 600, 20
FOOTER = (
    "Units are SI, angles in degrees for reading. Drag to zoom, double-click for everything; click a name above a plot to hide it. "
    "results.parquet has every run with its factors and figures, faults.parquet every injected fault, timings.parquet what each run took."
)


@dataclass(frozen=True)
class _Results:
    """What the page shows."""

    runs: pl.DataFrame
    faults: pl.DataFrame
    summary: dict[str, Any]
    specification: str


def campaign_page(
    runs: pl.DataFrame, faults: pl.DataFrame, summary: dict[str, Any], specification: str = "", command: str | None = None
) -> str:
    """A campaign as one HTML page that loads nothing from outside.

    Parameters
    ----------
    runs, faults
        Tables of ``results.parquet`` and ``faults.parquet``.
    summary
        As in ``summary.json``.
    specification
        As written.
    command
        The command line that gives it again.

    Returns
    -------
    str
        The text of ``campaign.html``.
    """
    results = _Results(runs, faults, summary, specification)
    names = estimators(results.runs)
    colours = {n: "estimate" if k == 0 else f"other{(k - 1) % OTHERS}" for k, n in enumerate(names)}
    sections = [
        _requirements(results), _errors(results, colours), _factors(results, colours), _detection(results, colours),
        _consistency(results, colours), _failures(results), _done(results, command),
    ]  # fmt: skip
    shown = [s for s in sections if s.figures or s.after]
    figures: list[Figure] = []
    body = [_header(results), *(section_html(s, figures) for s in shown)]
    links = [(s.key, s.title) for s in shown]
    return document(f"{results.summary['name']}, a campaign", body, links, figures, Pool(), span=(0.0, 1.0), footer=FOOTER)


def _values(table_: pl.DataFrame, name: str) -> FloatArray:
    """A column as numbers; what is missing, or a column that is not there, as NaN."""
    if name not in table_.columns or not table_[name].dtype.is_numeric():
        return np.full(len(table_), np.nan)
    return table_[name].to_numpy().astype(np.float64)


def _named(name: str, colours: dict[str, str]) -> str:
    """An estimator's name with a patch of its colour."""
    return f'<span style="color:var(--{colours.get(name, "quiet")})">&#9632;</span> {escape(name)}'


def _header(results: _Results) -> str:
    summary = results.summary
    level = {"passed": "good", "failed": "bad"}.get(summary["verdict"], "doubtful")
    badge = {"passed": "requirements met", "failed": "requirements not met"}.get(summary["verdict"], "no requirements")
    said = [f"{count(summary['done'], 'run')} of {summary['runs']:,} done"]
    if summary["failed"]:
        said.append(f"{summary['failed']:,} failed")
        level = "doubtful" if level == "good" else level
    if summary["missing"]:
        said.append(f"{summary['missing']:,} not made")
    sentences = [r["verdict"] for r in summary["requirements"]] or ["The specification asks for nothing: add [[require]] to have verdicts."]
    items = "".join(f"<li>{escape(s[:1].upper() + s[1:])}.</li>" if not s.endswith(".") else f"<li>{escape(s)}</li>" for s in sentences)
    return (
        f"<header>\n<h1>{escape(results.summary['name'])}: a campaign</h1>\n"
        f'<section class="verdict {level}" id="verdict"><p class="headline"><span class="badge">{badge}</span> '
        f"{escape(', '.join(said))}.</p><ul>{items}</ul></section>\n</header>"
    )


def _requirements(results: _Results) -> Section:
    section = Section("requirements", "Requirements", "A run that failed, or has no value, counts as the worst there is.")
    rows = []
    for v in results.summary["requirements"]:
        interval = "–" if v["interval"] is None else " … ".join(number(x) for x in v["interval"])
        met = "met" if v["met"] else "<b>not met</b>"
        rows.append((met, escape(v["requirement"]), number(v["value"]), interval, f"{v['runs']:,}", f"{v['failed']:,}"))
    if rows:
        section.after = table(("verdict ", "requirement ", "found", "interval", "runs", "failed"), rows)
    return section


# --- errors --------------------------------------------------------------------------------------------------------------


def _drawn(runs: pl.DataFrame) -> list[tuple[str, str, str, float]]:
    return [m for m in MAIN if np.isfinite(_values(runs, m[0])).any()]


def _against(runs: pl.DataFrame) -> str:
    said = {str(a) for a in runs["against"].drop_nulls().to_list()} if "against" in runs.columns else set()
    if said == {"onboard"}:
        return "Differences from the autopilot's own estimate, which is no truth. "
    return "Errors against truth; where a log has none, differences from the autopilot's own estimate. " if "onboard" in said else ""


def _errors(results: _Results, colours: dict[str, str]) -> Section:
    """Distributions over runs, and their table."""
    runs, settle = results.runs, results.summary["settle"]
    section = Section("errors", "Errors")
    metrics = _drawn(runs)
    if not metrics:
        return section
    section.note = (
        f"{_against(runs)}RMS of each run from {settle:g} s after alignment. Share of all runs, the failed ones too, that are not above."
    )
    for column, name, unit, factor in metrics:
        grid = Grid(f"distribution_{column.replace('.', '_')}", ["share of runs"], f"{name} [{unit}]", 170)
        low, high = math.inf, 0.0
        for estimator, colour in colours.items():
            mine = of_estimator(runs, estimator)
            x, share = distribution(factor * _values(mine, column), len(mine))
            if not len(x):
                continue
            # A step at every value, from none of the runs on.
            steps_x, steps_y = np.repeat(x, 2), np.r_[0.0, np.repeat(share, 2)[:-1]]
            grid.line(0, estimator, colour, steps_x, steps_y, hover=f"%{{y:.0%}} not above %{{x:.3~g}} {unit}")
            low, high = min(low, float(x[0])), max(high, float(x[-1]))
        grid.range(0, 0.0, 1.03)
        grid.layout["yaxis"]["tickformat"] = ".0%"
        if low > 0.0 and high > 12.0 * low:
            ticks = [k * 10.0**e for e in range(math.floor(math.log10(low)), math.ceil(math.log10(high))) for k in (1, 2, 5)]
            shown = [v for v in ticks if low <= v <= high]
            grid.layout["xaxis"] |= {"type": "log", "tickmode": "array", "tickvals": shown, "ticktext": [number(v) for v in shown]}
        section.figures.append(grid.figure())
    rows = []
    for estimator in colours:
        entries = results.summary["metrics"].get(estimator, {})
        for column, name, unit, factor in metrics:
            s = entries.get(column)
            if s and s.get("n"):
                figures = [number(factor * s[k]) for k in ("mean", "median", "p95", "max")]
                rows.append((_named(estimator, colours), escape(name), *figures, escape(unit), f"{s['n']:,}"))
    section.after = table(("estimator", "RMS error in ", "mean", "median", "95 % below", "largest", "unit ", "runs"), rows)
    settled = []
    for estimator in colours:
        mine = of_estimator(runs, estimator)
        done = int((mine["status"] == DONE).sum())
        for key, bound in results.summary["bounds"].items():
            if (
                f"{key}.settling" not in mine.columns
                or f"{key}.rms" not in mine.columns
                or not np.isfinite(_values(mine, f"{key}.rms")).any()
            ):
                continue
            values = _values(mine, f"{key}.settling")
            known = values[np.isfinite(values)]
            middle, late = (float(np.quantile(known, q)) for q in (0.5, 0.95)) if len(known) else (math.nan, math.nan)
            words, unit, factor = SETTLING[key]
            within = f"{number(factor * bound)} {unit}"
            cells = (number(middle), number(late), f"{len(known):,} of {done:,}")
            settled.append((_named(estimator, colours), escape(words), escape(within), *cells))
    if settled:
        heads = ("estimator", "settling of ", "within", "median [s]", "95 % below [s]", "runs that settle")
        section.after += table(heads, settled, caption="time from alignment until the error stays within a bound")
    return section


def _factors(results: _Results, colours: dict[str, str]) -> Section:
    """Errors by each factor that has more than one value: boxes, or points where it has many."""
    runs = results.runs
    section = Section("factors", "Errors by factor", "Box: the middle half of the runs, line: the median, whiskers: 5 to 95 %.")
    metrics = [m for m in _drawn(runs) if m[0] in ("tilt_deg.rms", "heading_deg.rms", "vel.rms", "pos.rms", "wind.rms")]
    for factor in results.summary["varied"]:
        if factor in ("seed", "estimator") or not metrics or factor not in runs.columns:
            continue
        cells = runs[factor].to_list()
        levels = list(dict.fromkeys(cells))
        if len(levels) <= BOXES:
            section.figures.append(_boxes(runs, factor, levels, metrics, colours))
        elif runs[factor].dtype.is_numeric():
            section.figures.append(_points(runs, factor, metrics, colours))
    return section


def _trace(grid: Grid, k: int, name: str, first: set[str], **rest: Any) -> None:
    """One trace of a grid that is no line; the legend names each label once."""
    grid.traces.append({
        "name": plain(name), "legendgroup": plain(name), "showlegend": name not in first, "xaxis": "x",
        "yaxis": "y" if k == 0 else f"y{k + 1}", **rest,
    })  # fmt: skip
    first.add(name)


def _title(factor: str) -> str:
    return f"by {factor}"


def _boxes(runs: pl.DataFrame, factor: str, levels: list[Any], metrics: Any, colours: dict[str, str]) -> Figure:
    grid = Grid(f"by_{factor.replace('.', '_')}", [f"{m[1]} [{m[2]}]" for m in metrics], factor, 120)
    words = [_level(v) for v in levels]
    first: set[str] = set()
    cells = np.array([levels.index(v) for v in runs[factor].to_list()])
    whose = np.array(runs["estimator"].to_list())
    for k, (column, _, unit, scale) in enumerate(metrics):
        values = scale * _values(runs, column)
        for estimator, colour in colours.items():
            boxes = [quartiles(values[(cells == i) & (whose == estimator)]) for i in range(len(levels))]
            kept = [i for i, b in enumerate(boxes) if math.isfinite(b[2])]
            if not kept:
                continue
            part = {
                key: [float(f"{boxes[i][j]:.4g}") for i in kept] for j, key in enumerate(("lowerfence", "q1", "median", "q3", "upperfence"))
            }
            _trace(grid, k, estimator, first, type="box", x=[words[i] for i in kept], **part, fillcolor=f"@{colour}/0.2",
                   line={"color": f"@{colour}", "width": 1.4}, hoverinfo="y", hovertemplate=f"%{{y:.3~g}} {unit}",
                   offsetgroup=plain(estimator))  # fmt: skip
    grid.layout["xaxis"] |= {"type": "category", "categoryorder": "array", "categoryarray": words}
    grid.layout["boxmode"] = "group"
    return {**grid.figure(), "title": _title(factor)}


def _level(value: Any) -> str:
    """A value of a factor on an axis: short."""
    text = "none" if value is None or value == "" else f"{value:g}" if isinstance(value, float) else str(value)
    return plain(text if len(text) <= 28 else f"{text[:26]}…")


def _points(runs: pl.DataFrame, factor: str, metrics: Any, colours: dict[str, str]) -> Figure:
    grid = Grid(f"by_{factor.replace('.', '_')}", [f"{m[1]} [{m[2]}]" for m in metrics], factor, 120)
    first: set[str] = set()
    for k, (column, _, unit, scale) in enumerate(metrics):
        for estimator, colour in colours.items():
            mine = of_estimator(runs, estimator)
            x, y = _values(mine, factor), scale * _values(mine, column)
            good = np.isfinite(x) & np.isfinite(y)
            order = np.argsort(x[good])
            x, y = x[good][order], y[good][order]
            if not len(x):
                continue
            rows = thin([y], POINTS)
            _trace(grid, k, estimator, first, type="scatter", mode="markers", x=[float(f"{v:.5g}") for v in x[rows]],
                   y=[float(f"{v:.4g}") for v in y[rows]], marker={"size": 4, "color": f"@{colour}", "opacity": 0.6},
                   hovertemplate=f"%{{y:.3~g}} {unit} at %{{x:.4~g}}")  # fmt: skip
    return {**grid.figure(), "title": _title(factor)}


# --- detection -----------------------------------------------------------------------------------------------------------


def _detection(results: _Results, colours: dict[str, str]) -> Section:
    """Detected, isolated, false alarms; delays over sizes, operating curve, confusion."""
    runs, faults = results.runs, results.faults
    section = Section("detection", "Faults and alarms")
    alarms = float(np.nansum(_values(runs, "false_alarms"))) if len(runs) else 0.0
    detected = _values(faults, "detected") if len(faults) else np.empty(0)
    if not len(faults) and not alarms:
        if len(runs):
            section.after = "<p>No fault was injected, and no estimator raised an alarm.</p>"
        return section
    rows = []
    for estimator in colours:
        d = results.summary["detection"].get(estimator, {})
        cells = []
        for key, k in (("detection_rate", 100.0), ("isolation_rate", 100.0), ("containing_rate", 100.0), ("false_alarms_per_hour", 1.0)):
            v = d.get(key, {})
            if v.get("value") is None:
                cells.append("–")
                continue
            high = v["interval"][1]
            unit = " %" if k == 100.0 else ""
            cells.append(
                f"{number(k * v['value'])}{unit} ({number(k * v['interval'][0])} … {number(k * high) if high is not None else '∞'})"
            )
        rows.append((_named(estimator, colours), d["detection_rate"]["counts"], *cells, d["false_alarms_per_hour"]["counts"]))
    heads = ("estimator", "detected ", "share", "named alone", "named, others too", "false alarms / h", "alarms ")
    section.note = (
        "Shares are of all faults injected while the estimator ran. In brackets exact 95 % intervals (Clopper and Pearson; Garwood). "
        f"An alarm up to {results.summary['hold']:g} s after a fault counts as its."
    )
    section.after = table(heads, rows)
    if not detected.any():
        section.after += (
            "<p>No alarm was raised during any fault: there is no delay, no operating curve and no isolation to show. "
            "An event counts as an alarm if its kind is a fault and not a change of state such as a reset or a timeout.</p>"
        )
        return section
    section.figures += _delays(faults, colours)
    if (curve := _curves(runs, faults, colours)) is not None:
        section.figures.append(curve)
    for c in confusion(faults):
        if c.counts.size and any(col not in (MISSED, NOBODY) for col in c.columns):
            body = [(escape(r), *(f"{n:,}" if n else "" for n in line)) for r, line in zip(c.rows, c.counts.tolist(), strict=True)]
            section.after += table(("fault in", *c.columns), body, caption=f"{c.estimator}: what failed, and what was named")
    return section


def _delays(faults: pl.DataFrame, colours: dict[str, str]) -> list[Figure]:
    """Share detected, and delay, over the size: a figure a kind of fault."""
    every = by_size(faults)
    out = []
    for sensor, kind in dict.fromkeys((b.sensor, b.kind) for b in every):
        mine = [b for b in every if (b.sensor, b.kind) == (sensor, kind)]
        if not any(b.detected.any() for b in mine):
            continue
        unit = UNITS.get((sensor, kind), "SI units")
        grid = Grid(f"delay_{sensor}_{kind}", ["detected", "delay [s]"], f"size [{unit}]", 140)
        first: set[str] = set()
        sizes = np.unique(np.concatenate([b.size for b in mine]))
        span = float(sizes[-1] - sizes[0]) or max(float(sizes[0]), 1e-9)  # estimators stand beside each other
        top = 0.0
        for i, b in enumerate(mine):
            shift = 0.0 if len(mine) == 1 else 0.008 * span * (2.0 * i / (len(mine) - 1) - 1.0)
            x = [float(f"{v:.4g}") for v in b.size + shift]
            look: dict[str, Any] = {
                "type": "scatter", "mode": "lines+markers", "x": x, "marker": {"size": 7, "color": f"@{colours[b.estimator]}"},
                "line": {"width": 1, "color": f"@{colours[b.estimator]}"},
            }  # fmt: skip
            told = [f"{k:,} of {n:,}, size {number(v)}" for k, n, v in zip(b.detected, b.faults, b.size, strict=True)]
            bars = _bars(b.share[:, 0], b.share[:, 1], b.share[:, 2], colours[b.estimator])
            _trace(grid, 0, b.estimator, first, **look, y=_short(b.share[:, 0]), error_y=bars, text=told, hovertemplate="%{text}")
            if b.detected.any():
                bars = _bars(b.delay[:, 2], b.delay[:, 0], b.delay[:, 4], colours[b.estimator])
                _trace(grid, 1, b.estimator, first, **look, y=_short(b.delay[:, 2]), error_y=bars, hovertemplate="%{y:.3~g} s")
                top = max(top, float(np.nanmax(b.delay[:, 4])))
        grid.range(0, -0.03, 1.05)
        grid.layout["yaxis"]["tickformat"] = ".0%"
        grid.range(1, 0.0, 1.08 * top if top > 0.0 else 1.0)
        out.append({
            **grid.figure(), "title": f"{sensor} {kind}: detection over the size",
            "reading": "Share with its exact 95 % interval; delay: median, and 5 to 95 % of the faults detected.",
        })  # fmt: skip
    return out


def _short(values: FloatArray) -> list[float | None]:
    return [float(f"{v:.4g}") if math.isfinite(v) else None for v in values]


def _bars(middle: FloatArray, low: FloatArray, high: FloatArray, colour: str) -> dict[str, Any]:
    up, down = np.nan_to_num(high - middle), np.nan_to_num(middle - low)
    return {"type": "data", "symmetric": False, "array": _short(up), "arrayminus": _short(down), "color": f"@{colour}", "thickness": 1.2}


def _curves(runs: pl.DataFrame, faults: pl.DataFrame, colours: dict[str, str]) -> Figure | None:
    curves = roc(runs, faults)
    if not curves:
        return None
    grid = Grid("roc", ["faults detected"], "fault-free runs with a false alarm", 260)
    for c in curves:
        grid.line(0, c.estimator, colours[c.estimator], c.false, c.detected, hover="%{y:.1%} detected, %{x:.1%} false", symbol=True)
    grid.range(0, 0.0, 1.03)
    grid.x_range(-0.02, 1.02)
    for axis in ("xaxis", "yaxis"):
        grid.layout[axis]["tickformat"] = ".0%"
    sizes = "; ".join(f"{c.estimator} {count(c.faults, 'fault')}, {count(c.quiet_runs, 'run')} without" for c in curves)
    return {
        **grid.figure(), "title": "Operating curve",
        "reading": f"From the thresholds as run (upper right end) to higher ones, by the statistics of the alarms given. {sizes}.",
    }  # fmt: skip


# --- consistency ---------------------------------------------------------------------------------------------------------


def _consistency(results: _Results, colours: dict[str, str]) -> Section:
    """Means over runs of NEES and NIS, with their bands."""
    section = Section("consistency", "Is the stated uncertainty true?")
    entries = consistency(results.runs)
    if not entries:
        return section
    faulty = "faults" in results.runs.columns and len(set(results.runs["faults"].drop_nulls().to_list()) | {0.0}) > 1
    which = "Means over runs without a fault" if faulty and 0.0 in results.runs["faults"] else "Means over runs"
    section.note = (
        f"{which}; 1 is ideal, above it the filter is too sure of itself. A run counts as one sample of the NEES, since errors "
        "within it hang together; innovations of a consistent filter are independent, so that each counts for the NIS."
    )
    for family, words in (("nees.", "NEES"), ("nis.", "NIS")):
        mine = [e for e in entries if e.metric.startswith(family)]
        if mine:
            section.figures.append(_means(family.strip("."), words, mine, colours))
    rows = []
    for e in entries:
        family, _, what = e.metric.partition(".")
        bands = [f"{number(low)} … {number(high)}" for low, high in e.bands]
        interval = "–" if not math.isfinite(e.low) else f"{number(e.low)} … {number(e.high)}"
        rows.append((_named(e.estimator, colours), family.upper(), escape(what.replace("_", " ")), number(e.mean), interval, *bands,
                     e.verdict, f"{len(e.values):,}"))  # fmt: skip
    heads = ("estimator", "statistic ", "of ", "mean", "95 % interval of the mean", "95 % band", "99.9 % band", "verdict ", "runs")
    section.after = table(heads, rows)
    return section


def _means(name: str, words: str, entries: Any, colours: dict[str, str]) -> Figure:
    """Means with their intervals before the bands, one place a block or sensor."""
    places = list(dict.fromkeys(e.metric.partition(".")[2] for e in entries))
    grid = Grid(name, [f"mean {words} [1]"], "", 210)
    first: set[str] = set()
    shown = [c for c in colours if any(e.estimator == c for e in entries)]
    low, high = 1.0, 1.0
    for i, estimator in enumerate(shown):
        shift = 0.0 if len(shown) == 1 else 0.3 * (i / (len(shown) - 1) - 0.5)
        mine = [e for e in entries if e.estimator == estimator]
        at = [places.index(e.metric.partition(".")[2]) + shift for e in mine]
        for e, x in zip(mine, at, strict=True):
            for (a, b), opacity in zip(e.bands, (0.45, 0.2), strict=True):
                thick = {"width": 16, "color": f"@limit/{opacity}"}
                _trace(grid, 0, "95 % and 99.9 % bands", first, type="scatter", mode="lines", x=[x, x],
                       y=[float(f"{a:.4g}"), float(f"{b:.4g}")], line=thick, hoverinfo="skip")  # fmt: skip
                low, high = min(low, a), max(high, b)
        reach = [float(f"{e.high - e.mean:.4g}") if math.isfinite(e.high) else 0.0 for e in mine]
        _trace(grid, 0, estimator, first, type="scatter", mode="markers", x=at, y=[float(f"{e.mean:.4g}") for e in mine],
               error_y={"type": "data", "array": reach, "color": f"@{colours[estimator]}", "thickness": 1.4},
               marker={"size": 8, "color": f"@{colours[estimator]}"}, hovertemplate="%{y:.3~g}")  # fmt: skip
        low, high = min(low, *(e.mean for e in mine)), max(high, *(e.mean for e in mine))
    grid.layout["xaxis"] |= {
        "tickmode": "array", "tickvals": list(range(len(places))), "ticktext": [plain(p.replace("_", " ")) for p in places],
        "range": [-0.6, len(places) - 0.4],
    }  # fmt: skip
    grid.layout["shapes"].append({"type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": "y", "y0": 1, "y1": 1, "layer": "below",
                                  "line": {"color": "@axis", "width": 1}})  # fmt: skip
    wide = high > 6.0 or low < 0.15
    margin = 0.25 * max(high - low, 0.1)
    grid.range(0, max(0.6 * low, 1e-3) if wide else low - margin, 1.5 * high if wide else high + margin, log=wide)
    return {**grid.figure(), "title": f"{words}, a degree of freedom, mean over runs"}


# --- what was done -------------------------------------------------------------------------------------------------------


def _failures(results: _Results) -> Section:
    section = Section("failures", "Runs that failed")
    failures = list(results.summary["failures"].items())[:FAILURES]
    if failures:
        section.after = table(("reason", "runs"), [(escape(why), f"{n:,}") for why, n in failures])
    return section


def _done(results: _Results, command: str | None) -> Section:
    """Factors, seconds, and the command."""
    runs, summary = results.runs, results.summary
    section = Section("done", "What was done")
    rows = []
    ends = [c for c in ("status", "error") if c in runs.columns]
    for factor in [c for c in runs.columns[: runs.columns.index(ends[0]) if ends else 0] if c not in ("run", "id")]:
        values = runs[factor].to_list()
        levels = list(dict.fromkeys(_level(v) for v in values))
        text = ", ".join(levels) if len(levels) <= BOXES else f"{len(levels):,} values, {levels[0]} to {levels[-1]}"
        if len(levels) > BOXES and runs[factor].dtype.is_numeric():
            known = _values(runs, factor)
            text = f"{len(levels):,} values from {number(float(np.nanmin(known)))} to {number(float(np.nanmax(known)))}"
        rows.append((escape(factor), text))
    section.after = table(("factor", "values "), rows)
    timings = summary["timings"]
    took = [
        (words, timings.get(key)) for words, key in (("simulating or reading", "flight_s"), ("estimating", "run_s"), ("scoring", "score_s"))
    ]
    section.after += table(("work of all runs", "seconds"), [(words, number(s)) for words, s in took if s is not None])
    notes = [
        *summary["notes"],
        *([f"{summary['same']:,} combinations are the same run as another, and were made once"] if summary["same"] else []),
    ]
    section.after += "".join(f"<p>{escape(n[:1].upper() + n[1:])}.</p>" for n in notes)
    if command:
        section.after += f'<p>Once more, or on from where it stopped:</p><pre class="command">{escape(command)}</pre>'
    if results.specification:
        section.after += f"<details><summary>Specification</summary><pre>{escape(results.specification)}</pre></details>"
    return section
