"""The page of an identified drag: verdict, force measured and predicted, wind, models, parameters to paste. It fits nothing."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from haltere.identify.autopilots import ardupilot_parameters, parameter_sd, px4_parameters, remarks
from haltere.identify.drag import DragIdentification
from haltere.identify.files import to_toml
from haltere.identify.fitting import load_of
from haltere.identify.forms import FORMS, drag_force
from haltere.report.document import document
from haltere.report.grid import Grid
from haltere.report.markup import Section, escape, section_html, table
from haltere.report.panels import Figure, Panels
from haltere.report.series import Pool
from haltere.report.words import number

__all__ = ["drag_page"]

FloatArray = NDArray[np.float64]
FOOTER = (
    "Units are SI; wind is where the air moves to. Drag to zoom, double-click to see all again. drag.toml has the configuration keys, "
    "drag.json every number."
)


def drag_page(d: DragIdentification, command: str | None = None) -> str:
    """An identification as one HTML page that loads nothing from outside.

    Parameters
    ----------
    d
        What `haltere.identify_drag` gave back, or what it refused.
    command
        The command line that gives it again.

    Returns
    -------
    str
        The text of ``drag.html``.
    """
    pool = Pool()
    flights = [_flight(d, k, pool) for k in range(len(d.flights))]
    # of a refused fit the measured forces are shown and what the models came to, but no drag and no wind
    sections = [*flights, _models(d)] if d.refused else [_curve(d), *flights, _winds(d), _models(d)]
    sections += [_paste(d), _done(d, command)]
    figures: list[Figure] = []
    body = [_header(d), *(section_html(s, figures) for s in sections)]
    return document(f"{d.name}, drag", body, [(s.key, s.title) for s in sections], figures, pool, span=_span(d, 0), footer=FOOTER)


def _span(d: DragIdentification, k: int) -> tuple[float, float]:
    t = d.flights[k].t
    return float(t[0]), float(t[-1])


def _header(d: DragIdentification) -> str:
    force, sd = d.drag_at
    poor = any(n.startswith("poor") for n in d.notes)
    level, badge = ("bad", "refused") if d.refused else ("doubtful", "poor") if poor else ("good", "identified")
    found = f"drag of {force:.2f} ± {sd:.2g} m/s² at 5 m/s through the air"
    headline = f"not to be used: {d.refused}" if d.refused else found
    items = "".join(f"<li>{escape(s)}</li>" for s in d.notes)
    return (
        f'<header><h1>{escape(d.name)}: drag and wind</h1>\n<section class="verdict {level}" id="verdict"><p class="headline">'
        f'<span class="badge">{badge}</span> {escape(headline)}</p>{f"<ul>{items}</ul>" if items else ""}</section></header>'
    )


def _air(d: DragIdentification, k: int, gusts: bool) -> FloatArray:
    """Velocity through the air in the body (n, 3), with the mean wind or with gusts."""
    s, part = d.flights[k], d.base.parts[k]
    wind = np.zeros((len(s.t), 3))
    wind[:, :2] = part.wind_path if gusts else part.wind
    return np.asarray(np.einsum("kji,kj->ki", s.C_nb, s.vel_n - wind))


def _curve(d: DragIdentification) -> Section:
    """Drag against speed: what was measured, in classes of speed, and the models."""
    grid = Grid("curve", ["drag against the air velocity [m/s²]"], "horizontal speed through the air [m/s]", 260)
    speeds: list[FloatArray] = []
    forces: list[FloatArray] = []
    loads: list[float] = []
    for k, (s, part) in enumerate(zip(d.flights, d.base.parts, strict=True)):
        v = _air(d, k, True)[:, :2]
        length = np.linalg.norm(v, axis=1)
        f = s.force_b[:, :2] - part.rest[:2]
        speeds.append(length)
        forces.append(-np.einsum("ki,ki->k", f, v) / np.maximum(length, 0.3))
        loads.append(float(np.mean(s.thrust)))
    speed, force = np.concatenate(speeds), np.concatenate(forces)
    edges = np.arange(0.5, max(float(np.max(speed)), 1.5) + 0.5, 0.5)
    at, mean = [], []
    for low, high in itertools.pairwise(edges):
        inside = (speed >= low) & (speed < high)
        if inside.sum() >= 5:
            at.append(0.5 * (low + high))
            mean.append(float(np.mean(force[inside])))
    grid.line(0, "measured, mean of 0.5 m/s", "imu", at, np.array(mean), symbol=True, hover="%{y:.3~g} m/s²")
    x = np.linspace(0.0, float(edges[-1]), 60)
    v = np.column_stack([x, np.zeros((len(x), 2))])
    rho = np.full(len(x), d.density)
    curves = (("haltere", d.haltere.values, "estimate"), ("px4", d.px4.values, "gnss"), ("ardupilot", d.ardupilot.values, "onboard"))
    for form, values, colour in curves:
        y = -drag_force(form, values, v, np.full(len(x), float(np.mean(loads))), rho)[:, 0]
        grid.line(0, f"{form}, forward", colour, x, y, hover="%{y:.3~g} m/s²")
    y = -drag_force("px4", d.still["px4"], v, np.full(len(x), float(np.mean(loads))), rho)[:, 0]
    grid.line(0, "PX4's formula, air taken for still", "refused", x, y, dash="dot", hover="%{y:.3~g} m/s²")
    note = (
        "Force per mass against the velocity through the air, offsets taken off, with the most likely wind. The dotted line is what comes "
        "out of the same flights where the air is taken for still."
    )
    return Section("curve", "Drag", note, [grid.figure()])


def _flight(d: DragIdentification, k: int, pool: Pool) -> Section:
    """Force measured and predicted, and the wind, over time."""
    s, part = d.flights[k], d.base.parts[k]
    titles = ["force x [m/s²]", "force y [m/s²]"] + ([] if d.refused else ["wind north [m/s]", "wind east [m/s]"])
    panels = Panels(f"flight{k}", pool, _span(d, k), titles, 140)
    load = load_of(d.base.form, s)
    predicted = drag_force(d.base.form, d.base.values, _air(d, k, True), load, s.density) + part.rest[:2]
    steady = drag_force(d.base.form, d.base.values, _air(d, k, False), load, s.density) + part.rest[:2]
    for a in range(2):
        panels.line(a, "measured", "imu", s.t, s.force_b[:, a], unit="m/s²", resolution=1e-3, width=1.0)
        if d.refused:
            continue
        panels.line(a, "predicted, mean wind", "assumed", s.t, steady[:, a], unit="m/s²", resolution=1e-3, width=1.0)
        panels.line(a, "predicted", "estimate", s.t, predicted[:, a], unit="m/s²", resolution=1e-3, width=1.2)
        panels.line(2 + a, "wind", "estimate", s.t, part.wind_path[:, a], unit="m/s", resolution=1e-3, width=1.2)
        panels.line(2 + a, "mean wind", "limit", np.array(_span(d, k)), np.full(2, part.wind[a]), unit="m/s", width=1.0)
    name = d.motions[k].name if len(d.flights) > 1 else "Flight"
    if d.refused:
        return Section(f"flight{k}", name, "Force across the thrust axis, means of 0.1 s in the air.", [panels.figure()])
    noise = float(np.sqrt(np.mean((s.force_b[:, :2] - predicted) ** 2)))
    plain = float(np.sqrt(np.mean((s.force_b[:, :2] - steady) ** 2)))
    note = (
        f"Means of 0.1 s in the air. What is left: {noise:.2g} m/s² (rms) with the most likely gusts, {plain:.2g} m/s² with the mean wind "
        "alone. The prediction with gusts has seen the measurement."
    )
    return Section(f"flight{k}", name, note, [panels.figure()])


def _winds(d: DragIdentification) -> Section:
    rows = []
    for k, (m, part) in enumerate(zip(d.motions, d.base.parts, strict=True)):
        sd = d.base.part_sd(k)
        speed, toward = math.hypot(*part.wind), math.degrees(math.atan2(part.wind[1], part.wind[0])) % 360.0
        pairs = zip((*part.wind, *part.rest[:2]), sd[[-2, -1, 0, 1]], strict=True)
        found = [f"{number(float(v))} ± {number(float(s), 2)}" for v, s in pairs]
        gusts = f"{number(float(part.sizes[0]), 2)} in {number(float(part.sizes[1]), 2)} s"
        rows.append((escape(m.name), number(speed), f"{toward:.0f}", f"{(toward + 180.0) % 360.0:.0f}", *found, gusts))
    heads = ("flight", "wind [m/s]", "to [deg]", "from [deg]", "north", "east", "offset x [m/s²]", "offset y [m/s²]", "gusts [m/s]")
    section = Section("winds", "Wind and offsets")
    section.note = "Means over the flight. Offsets are thrust axis and accelerometer bias together."
    section.after = table(heads, rows)
    return section


def _models(d: DragIdentification) -> Section:
    best = min(f.bic for f in d.fits.values())
    rows = [
        (
            form, escape(FORMS[form].said),
            "<br>".join(f"{n} {number(float(v), 4)} ± {number(float(s), 2)} {u}" for n, v, s, u in
                        zip(FORMS[form].names, f.values, f.sd, FORMS[form].units, strict=True)),
            f"{f.bic - best:+.0f}", "<br>".join(number(float(v), 3) for v in d.still[form]),
        )
        for form, f in d.fits.items()
    ]  # fmt: skip
    section = Section("models", "Models")
    section.note = (
        "Each fitted by itself, with its own wind and colour of the noise. BIC, of whitened residuals, above the best: 10 is strong "
        "evidence. The parameters to paste are not these of px4 and ardupilot but those with which their formulas come nearest "
        f"to the drag of {d.base.form}."
    )
    section.after = table(("model", "formula ", "parameters ", "BIC", "air taken for still"), rows)
    return section


def _block(parameters: dict[str, float], sd: dict[str, float], form: str) -> str:
    lines = [form.format(name=n, value=f"{v:.4g}") + (f"    # 1 sigma {sd[n]:.2g}" if n in sd else "") for n, v in parameters.items()]
    return f'<pre class="command">{escape(chr(10).join(lines))}</pre>'


def _paste(d: DragIdentification) -> Section:
    section = Section("paste", "To paste")
    if d.refused:
        section.after = "<p>Nothing: the flights do not tell the drag.</p>"
        return section
    said = "".join(f"<li>{escape(r)}</li>" for r in remarks(d))
    px4 = _block(px4_parameters(d), parameter_sd(d, "px4"), "param set {name} {value}")
    ardupilot = _block(ardupilot_parameters(d), parameter_sd(d, "ardupilot"), "{name},{value}")
    section.after = (
        f"<ul>{said}</ul><h3>PX4 (console)</h3>{px4}<h3>ArduPilot (parameter file)</h3>{ardupilot}"
        f'<h3>haltere (drag.toml)</h3><pre class="command">{escape(to_toml(d))}</pre>'
    )
    return section


def _done(d: DragIdentification, command: str | None) -> Section:
    section = Section("done", "How it was made")
    seconds = sum(float(s.t[-1] - s.t[0]) for s in d.flights)
    section.after = (
        f"<p>{sum(len(s.t) for s in d.flights)} windows over {seconds:.0f} s in the air; air density {number(d.density, 4)} kg/m³, known "
        f"to {100.0 * d.density_sd:.1f} % (1σ). Motion from navigator, smoothed; the autopilot's own solution was not used.</p>"
        + (f'<p>The command that gives this again:</p><pre class="command">{escape(command)}</pre>' if command else "")
    )
    return section
