"""The page of a magnetometer's calibration: verdict, sphere, strength, headings, coverage, parameters. It fits nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.calibrate.autopilots import ardupilot_parameters, px4_parameters, remarks
from haltere.calibrate.coverage import AZIMUTHS, BANDS, HEADINGS
from haltere.calibrate.files import to_toml
from haltere.calibrate.magnetometer import CoverageError, MagnetometerCalibration
from haltere.flight.load import LOADS
from haltere.readers.table import ROWS
from haltere.report.document import document
from haltere.report.grid import Grid
from haltere.report.markup import Section, escape, section_html, table
from haltere.report.panels import FOOT, LEFT, TOP, Figure, Panels
from haltere.report.series import Pool
from haltere.report.style import AXES
from haltere.report.words import number

__all__ = ["calibration_page", "refused_page"]

FloatArray = NDArray[np.float64]
DEG = 180.0 / math.pi
#: Points of a picture of vectors.
POINTS = 1500
FOOTER = (
    "Units are µT, angles in degrees for reading. Drag to zoom, double-click to see all again. calibration.toml applies the calibration in "
    "a run, calibration.json has every number."
)


def calibration_page(c: MagnetometerCalibration, command: str | None = None) -> str:
    """A calibration as one HTML page that loads nothing from outside.

    Parameters
    ----------
    c
        What `haltere.calibrate_magnetometer` gave back, or what it refused.
    command
        The command line that gives it again.

    Returns
    -------
    str
        The text of ``calibration.html``.
    """
    pool = Pool()
    sections = [_vectors(c), _strength(c, pool), _headings(c), _coverage(c), _values(c), _paste(c), _done(c, command)]
    shown = [s for s in sections if s.figures or s.after]
    figures: list[Figure] = []
    body = [_header(c), *(section_html(s, figures) for s in shown)]
    span = (float(c.t[0]), float(c.t[-1])) if c.t[-1] > c.t[0] else None
    return document(
        f"{c.name or 'log'}, {c.stream} calibrated", body, [(s.key, s.title) for s in shown], figures, pool, span=span, footer=FOOTER
    )


def refused_page(error: CoverageError, name: str) -> str:
    """A page for a log whose vectors fix no ellipsoid: what was seen."""
    figures: list[Figure] = []
    section = Section(
        "vectors", "Vectors", "The field as measured, in the sensor's axes: it has to go round an ellipsoid in all three views."
    )
    section.figures.append(_views({"measured": ("refused", error.raw)}, None))
    head = _verdict("bad", "not calibrated", str(error), [], f"{name or 'log'}: magnetometer")
    return document(
        f"{name or 'log'}, not calibrated", [head, section_html(section, figures)], [("vectors", "Vectors")], figures, Pool(), footer=FOOTER
    )


def _verdict(level: str, badge: str, headline: str, sentences: list[str], title: str) -> str:
    items = "".join(f"<li>{escape(s)}</li>" for s in sentences)
    return (
        f'<header><h1>{escape(title)}</h1>\n<section class="verdict {level}" id="verdict"><p class="headline">'
        f'<span class="badge">{badge}</span> {escape(headline)}</p>{f"<ul>{items}</ul>" if items else ""}</section></header>'
    )


def _header(c: MagnetometerCalibration) -> str:
    worst, before = DEG * float(np.max(c.heading_sd)), DEG * float(np.max(np.abs(c.heading_before)))
    spread = (
        f"strength spreads by {100.0 * c.spread(c.log):.2g} % as logged and {100.0 * c.spread(c.calibrated):.2g} % calibrated; "
        f"level headings are off by up to {before:.1f}° as logged, and uncertain by up to {worst:.2g}° (1σ) calibrated"
    )
    poor = any(n.startswith("poor coverage") for n in c.notes)
    level, badge = ("bad", "refused") if c.refused else ("doubtful", "poor coverage") if poor else ("good", "calibrated")
    headline = f"not to be used: {c.refused}" if c.refused else spread
    sentences = ([spread] if c.refused else []) + [n for n in c.notes]
    return _verdict(level, badge, headline, sentences, f"{c.name or 'log'}: {c.stream} calibrated")


def _thinned(v: FloatArray) -> FloatArray:
    step = max(1, math.ceil(len(v) / POINTS))
    return v[::step]


def _views(clouds: dict[str, tuple[str, FloatArray]], radius: float | None) -> Figure:
    """Vectors seen along each axis, side by side on equal scales, with the outline of the sphere they should lie on."""
    layout: dict[str, Any] = {"margin": {"l": LEFT, "r": 12, "t": TOP, "b": FOOT}, "hovermode": "closest"}
    traces: list[dict[str, Any]] = []
    turn = np.linspace(0.0, 2.0 * math.pi, 121)
    for panel, (i, k) in enumerate(((0, 1), (0, 2), (1, 2))):
        s = "" if panel == 0 else str(panel + 1)
        x, y = (f"x{s}", f"y{s}")
        layout[f"xaxis{s}"] = {
            **AXES, "domain": [panel * 0.35, panel * 0.35 + 0.29], "anchor": y, "nticks": 6, "constrain": "domain",
            "title": {"text": f"{'xyz'[i]} [µT]", "standoff": 4},
        }  # fmt: skip
        layout[f"yaxis{s}"] = {
            **AXES, "anchor": x, "scaleanchor": x, "nticks": 6, "title": {"text": f"{'xyz'[k]} [µT]", "standoff": 4}, "constrain": "domain",
        }  # fmt: skip
        for name, (colour, vectors) in clouds.items():
            v = _thinned(vectors)
            traces.append({
                "type": "scatter", "mode": "markers", "name": name, "legendgroup": name, "showlegend": panel == 0, "xaxis": x, "yaxis": y,
                "x": [float(f"{a:.4g}") for a in v[:, i]], "y": [float(f"{a:.4g}") for a in v[:, k]],
                "marker": {"size": 3, "color": f"@{colour}"}, "hovertemplate": "%{x:.3~g}, %{y:.3~g} µT",
            })  # fmt: skip
        if radius is not None:
            traces.append({
                "type": "scatter", "mode": "lines", "name": "field strength", "legendgroup": "field strength", "showlegend": panel == 0,
                "xaxis": x, "yaxis": y, "x": [float(f"{radius * a:.4g}") for a in np.cos(turn)],
                "y": [float(f"{radius * a:.4g}") for a in np.sin(turn)], "line": {"color": "@limit", "width": 1.2, "dash": "dot"},
                "hoverinfo": "skip",
            })  # fmt: skip
    return {"name": "vectors", "traces": traces, "layout": layout, "height": 340, "time": False}


def _vectors(c: MagnetometerCalibration) -> Section:
    note = (
        "The field seen along each axis of the sensor. Calibrated vectors lie within the outline of a sphere of the field's strength, and "
        "on it where they are at its edge."
    )
    raw = "before the autopilot's correction" if c.undone else "as logged"
    clouds = {raw: ("deweighted", c.raw[c.used])}
    if c.undone:
        clouds["as logged"] = ("onboard", c.log[c.used])
    clouds["calibrated"] = ("magnetometer", c.calibrated[c.used])
    if not c.used.all():
        clouds["left out"] = ("refused", c.calibrated[~c.used])
    return Section("vectors", "Vectors", note, [_views(clouds, c.strength)])


def _strength(c: MagnetometerCalibration, pool: Pool) -> Section:
    """Strength over time, with the load."""
    with_load = c.load_word != "off"
    titles = ["strength [µT]"] + ([f"{c.load_word} [{LOADS[c.load_word][0]}]"] if with_load else [])
    panels = Panels("strength", pool, (float(c.t[0]), max(float(c.t[-1]), float(c.t[0]) + 1e-3)), titles, 170)
    panels.line(0, "as logged", "onboard", c.t, np.linalg.norm(c.log, axis=1), unit="µT", resolution=1e-3, width=1.0)
    panels.line(0, "calibrated", "magnetometer", c.t, np.linalg.norm(c.calibrated, axis=1), unit="µT", resolution=1e-3, width=1.2)
    field = np.array([c.t[0], c.t[-1]])
    panels.line(0, f"field ({c.field_source})", "limit", field, np.full(2, c.strength), unit="µT", width=1.0)
    if not c.used.all():
        out = ~c.used
        panels.markers(0, "left out", "refused", c.t[out], np.linalg.norm(c.calibrated[out], axis=1), unit="µT", size=5, widen=False)
    if with_load:
        panels.line(1, c.load_word, "imu", c.t, c.load_values, unit=LOADS[c.load_word][0], width=1.0)
    note = f"Spread (1σ over mean): {100.0 * c.spread(c.log):.2g} % as logged, {100.0 * c.spread(c.calibrated):.2g} % calibrated."
    figure = panels.figure()
    if ROWS in c.notes:
        figure["layout"]["xaxis"]["title"]["text"] = "sample"
    return Section("strength", "Strength", note, [figure])


def _headings(c: MagnetometerCalibration) -> Section:
    """Heading error by direction."""
    grid = Grid("headings", ["heading error [deg]"], "magnetic heading, level [deg]", 230)
    x = np.append(DEG * HEADINGS, 360.0)

    def closed(v: FloatArray) -> FloatArray:
        return np.append(v, v[0])

    sd, before = closed(DEG * c.heading_sd), closed(DEG * c.heading_before)
    jumps = np.flatnonzero(np.abs(np.diff(before)) > 180.0) + 1  # from 180 to -180 deg
    grid.line(0, "as logged", "onboard", np.insert(x, jumps, np.nan), np.insert(before, jumps, np.nan), width=1.9, hover="%{y:.2~f}°")
    grid.line(0, "calibrated, ±1σ", "magnetometer", x, sd, hover="±%{y:.2~f}°")
    grid.line(0, "calibrated, ±1σ", "magnetometer", x, -sd, hover="")
    grid.layout["xaxis"]["tickvals"] = list(range(0, 361, 45))
    reach = 1.08 * max(float(np.max(np.abs(before))), float(np.max(sd)))
    grid.range(0, -reach, reach)
    grid.x_range(0.0, 360.0)
    note = (
        "Of a level vehicle, by the direction it points to: with the log as it is, against this calibration; and what is left uncertain of "
        f"this calibration. The dip is {DEG * c.dip:.1f}°."
    )
    return Section("headings", "Headings", note, [grid.figure()])


def _coverage(c: MagnetometerCalibration) -> Section:
    """Which directions of the field, in the sensor, were seen."""
    edges = np.linspace(-1.0, 1.0, BANDS + 1)
    elevation = DEG * np.arcsin(0.5 * (edges[1:] + edges[:-1]))
    azimuth = (np.arange(AZIMUTHS) + 0.5) * 360.0 / AZIMUTHS
    counts = c.coverage.cells
    layout = {
        "margin": {"l": LEFT, "r": 12, "t": TOP, "b": FOOT}, "hovermode": "closest",
        "xaxis": {
            **AXES, "range": [0.0, 360.0], "tickvals": list(range(0, 361, 45)),
            "title": {"text": "azimuth of the field in the sensor [deg]: 0 forward, 90 right", "standoff": 4},
        },
        "yaxis": {
            **AXES, "tickvals": [round(float(e), 1) for e in elevation], "autorange": "reversed",
            "title": {"text": "below the horizontal [deg]", "standoff": 6},
        },
    }  # fmt: skip
    trace = {
        "type": "heatmap", "x": azimuth.tolist(), "y": [round(float(e), 1) for e in elevation],
        "z": [[None if n == 0 else round(math.log10(n), 3) for n in row] for row in counts.tolist()],
        "text": [[f"{int(n)}" for n in row] for row in counts.tolist()], "texttemplate": "%{text}", "xgap": 2, "ygap": 2,
        "colorscale": [[0.0, "@magnetometer/0.15"], [1.0, "@magnetometer/0.75"]], "showscale": False, "hoverinfo": "skip", "zmin": 0,
    }  # fmt: skip
    figure: Figure = {"name": "coverage", "traces": [trace], "layout": layout, "height": 300, "time": False}
    low = c.coverage.eigenvalues
    missing = f" None came from within 45° of {', '.join(c.coverage.missing)}." if c.coverage.missing else ""
    note = (
        "Number of samples by the direction the field came from, in cells of equal area of the sphere; what is empty was never seen, and "
        f"its headings are extrapolated. {100.0 * c.coverage.share:.0f} % of the cells were seen.{missing} Scatter of the directions "
        f"(eigenvalues): {number(float(low[0]))}, {number(float(low[1]))}, {number(float(low[2]))}; a third each for the whole sphere."
    )
    return Section("coverage", "Coverage", note, [figure])


def _values(c: MagnetometerCalibration) -> Section:
    """Every parameter with 1 sigma."""
    sd = c.sd
    rows = [(f"offset {a}", number(float(c.offset[k]), 4), number(float(sd[k])), "µT") for k, a in enumerate("xyz")]
    rows += [
        (f"matrix {r}{k}", number(float(c.matrix[i, j]), 4), number(float(sd[3 + 3 * i + j])), "1")
        for i, r in enumerate("xyz")
        for j, k in enumerate("xyz")
    ]
    if c.load_word != "off":
        rows += [
            (f"load {a}", number(float(c.load[k]), 4), number(float(sd[12 + k])), f"µT per {LOADS[c.load_word][0]} of {c.load_word}")
            for k, a in enumerate("xyz")
        ]
    if c.turn is not None:
        turn_sd = np.sqrt(np.maximum(np.diag(c.turn.covariance), 0.0))
        rows += [
            (f"rotation {a}, in the matrix", number(DEG * float(c.turn.vector[k])), number(DEG * float(turn_sd[k])), "deg")
            for k, a in enumerate("xyz")
        ]
        rows.append(("dip of the field, from gravity", number(DEG * c.turn.dip, 4), number(DEG * c.turn.dip_sd), "deg"))
    rows.append(("noise about the ellipsoid", number(c.ellipsoid.sigma), "", "µT"))
    section = Section("values", "Parameters")
    section.note = f"m = matrix (m_raw − offset{' − load u' if c.load_word != 'off' else ''}), in the sensor's axes."
    section.after = table(("parameter", "value", "1σ", "unit "), rows)
    gravity = (
        "gravity gave; what the flight did not tell of it stays at zero with an assumed 1σ of 2° an axis"
        if c.turn is not None
        else "nothing in this log tells: the symmetric matrix is given"
    )
    section.after += (
        f"<p>{len(c.t):,} samples, {int((~c.used).sum())} of them left out as outliers; 1σ counts "
        f"{100.0 * c.ellipsoid.independent:.2g} % of them as independent, from how successive residuals resemble each other. An ellipsoid "
        f"fixes the matrix up to a rotation, which {gravity}.</p>"
    )
    return section


def _block(parameters: dict[str, float], form: str) -> str:
    text = "\n".join(form.format(name=name, value=f"{value:.6g}") for name, value in parameters.items())
    return f'<pre class="command">{escape(text)}</pre>'


def _paste(c: MagnetometerCalibration) -> Section:
    """Parameters of autopilots and of haltere."""
    section = Section("paste", "To paste")
    if c.refused:
        section.after = "<p>Nothing: the calibration is refused.</p>"
        return section
    said = "".join(f"<li>{escape(r)}</li>" for r in remarks(c))
    section.after = (
        f"<ul>{said}</ul><h3>PX4 (gauss; console)</h3>{_block(px4_parameters(c), 'param set {name} {value}')}"
        f"<h3>ArduPilot (milligauss; parameter file)</h3>{_block(ardupilot_parameters(c), '{name},{value}')}"
        f'<h3>haltere (calibration.toml)</h3><pre class="command">{escape(to_toml(c))}</pre>'
    )
    return section


def _done(c: MagnetometerCalibration, command: str | None) -> Section:
    section = Section("done", "How it was made")
    section.after = (
        f"<p>Method {escape(c.method)}; field {number(c.strength, 4)} µT, dip {number(DEG * c.dip, 4)}°: {escape(c.field_source)}.</p>"
        + (f'<p>The command that gives this again:</p><pre class="command">{escape(command)}</pre>' if command else "")
    )
    return section
