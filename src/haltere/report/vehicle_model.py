"""The page of an identified vehicle model: verdict, measured against predicted, constants, rotors, how it was made. It fits nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haltere.identify.checks import Check
from haltere.identify.track import FORCE, MOMENT
from haltere.identify.vehicle import VehicleIdentification
from haltere.identify.vehicle_files import to_toml
from haltere.report.document import document
from haltere.report.markup import Section, escape, section_html, table
from haltere.report.panels import Figure, Panels
from haltere.report.series import Pool
from haltere.report.words import number
from haltere.vehicle.regressors import AXES, NAMES, PRESETS

__all__ = ["vehicle_page"]

FloatArray = NDArray[np.float64]
#: What an axis is called for reading, and the columns of each as text.
TITLES = ("force x [m/s²]", "force y [m/s²]", "force z [m/s²]", "roll [rad/s²]", "pitch [rad/s²]", "yaw [rad/s²]")
TEXT = (
    ("ΣΩ v_x", "rate q", "v_x", "|v| v_x", "1"), ("ΣΩ v_y", "rate p", "v_y", "|v| v_y", "1"), ("ΣΩ²", "v_x² + v_y²", "ΣΩ v_z", "1", ""),
    ("U_R", "q r", "s p", "ΣΩ²", "ΣΩ v_y", "r v_x", "V_R v_z"), ("U_P", "p r", "s q", "ΣΩ²", "ΣΩ v_x", "r v_y", "V_P v_z"),
    ("U_Q", "p q", "s r", "Σ yaw dΩ/dt", "ΣΩ²", "V_R v_x", "V_P v_y"),
)  # fmt: skip
#: Errors on flights not seen over those on its own, up to which a model is taken as tested.
FAIR = 1.5
FOOTER = (
    "Units are SI, body forward-right-down. Drag to zoom, double-click to see all again. The vehicle file has the model with its "
    "covariance, the JSON file beside it every number."
)


def vehicle_page(d: VehicleIdentification, command: str | None = None) -> str:
    """An identified vehicle as one HTML page that loads nothing from outside.

    Parameters
    ----------
    d
        What `haltere.identify_vehicle` gave back.
    command
        The command line that gives it again.

    Returns
    -------
    str
        The text of the page.
    """
    pool = Pool()
    unseen = [c for c in d.checks if not c.seen]
    shown = (unseen or d.checks)[:6]
    sections = [_checks(d), *(_flight(c, k, pool) for k, c in enumerate(shown)), _constants(d), _rotors(d), _done(d, command)]
    figures: list[Figure] = []
    body = [_header(d), *(section_html(s, figures) for s in sections)]
    t = shown[0].windows[0][0]
    return document(
        f"{d.name}, vehicle", body, [(s.key, s.title) for s in sections], figures, pool, span=(float(t[0]), float(t[-1])), footer=FOOTER
    )


def _header(d: VehicleIdentification) -> str:
    unseen = [c for c in d.checks if not c.seen]
    if unseen:
        medians = np.median([c.explained for c in unseen], axis=0)
        # a gentle flight has little variance to predict: what is left is set against what was left where it was fitted
        left = np.median([c.error for c in unseen], axis=0) / np.maximum(d.lumped.residual_sd, 1e-12)
        level, badge = ("good", "tested") if float(np.max(left[2:])) < FAIR else ("doubtful", "predicts in part")
        flights = "1 flight" if len(unseen) == 1 else f"{len(unseen)} flights"
        headline = (
            f"of {flights} not fitted it predicts {100.0 * medians[2]:.0f} % of the variance of the force along z, "
            f"{100.0 * medians[3]:.0f} % in roll, {100.0 * medians[4]:.0f} % in pitch, {100.0 * medians[5]:.0f} % in yaw (medians); "
            f"its errors there are {float(np.min(left)):.1f} to {float(np.max(left)):.1f} times those on its own flights"
        )
    else:
        level, badge, headline = "doubtful", "not tested", "no flight was kept back to test it on"
    items = "".join(f"<li>{escape(s)}</li>" for s in d.notes)
    return (
        f'<header><h1>{escape(d.name)}: forces and moments</h1>\n<section class="verdict {level}" id="verdict"><p class="headline">'
        f'<span class="badge">{badge}</span> {escape(headline)}</p>{f"<ul>{items}</ul>" if items else ""}</section></header>'
    )


def _checks(d: VehicleIdentification) -> Section:
    rows = []
    for c in d.checks:
        cells = [
            f"{number(float(c.error[i]), 2)} of {number(float(c.signal[i]), 2)}, {100.0 * float(c.explained[i]):.0f} %" for i in range(6)
        ]
        rows.append((escape(c.name), "fitted" if c.seen else "not fitted", *cells))
    section = Section("checks", "Tests")
    section.note = (
        f"Error of the prediction and signal, root mean square, and the part of the variance that is predicted; means of {FORCE:g} s of "
        f"the specific force, mean angular acceleration over {MOMENT:g} s. A constant difference counts as error."
    )
    section.after = table(("flight", "model has ", *TITLES), rows)
    return section


def _flight(c: Check, k: int, pool: Pool) -> Section:
    t = c.windows[0][0]
    panels = Panels(f"flight{k}", pool, (float(t[0]), float(t[-1])), list(TITLES), 110)
    for i, (at, measured, predicted) in enumerate(c.windows):
        unit = "m/s²" if i < 3 else "rad/s²"
        step = FORCE if i < 3 else MOMENT
        broken = np.flatnonzero(np.diff(at) > 3.0 * step) + 1
        x = np.insert(at, broken, at[broken] - step)
        panels.line(i, "measured", "imu", x, np.insert(measured, broken, np.nan), unit=unit, resolution=1e-3, width=1.1)
        panels.line(i, "predicted", "estimate", x, np.insert(predicted, broken, np.nan), unit=unit, resolution=1e-3, width=1.1)
    seen = "The model has seen this flight." if c.seen else "The model has not seen this flight."
    return Section(f"flight{k}", c.name, seen, [panels.figure()])


def _constants(d: VehicleIdentification) -> Section:
    m = d.lumped
    rows = []
    for i, axis in enumerate(AXES):
        for n, j in enumerate(PRESETS[m.preset][i]):
            sd = float(m.sd[i, j])
            rows.append((
                axis if n == 0 else "", NAMES[i][j], TEXT[i][j] if m.preset != "literal" or i > 1 or j != 1 else "angular acceleration",
                number(float(m.k[i, j]), 4), number(sd, 2), "" if d.told[i, j] else "not told", number(float(d.plain[i, j]), 4),
                number(float(d.condition[i]), 3) if n == 0 else "",
            ))  # fmt: skip
    residuals = [
        (a, number(float(m.residual_sd[i])), f"{float(m.residual_ar1[i]):.2f}", number(float(m.residual_slow[i])))
        for i, a in enumerate(AXES)
    ]
    section = Section("constants", "Constants")
    section.note = (
        f"Preset {m.preset}, at an air density of {m.density:g} kg/m³. The column before the last is ordinary least squares, which takes "
        "the noise of the rotor speeds for signal. A condition number of 20 and more says that two columns were hardly told apart: "
        "their sum is known better than either."
    )
    valid = m.valid
    section.after = (
        table(("axis", "constant ", "column ", "value", "1σ", "told ", "least squares", "condition"), rows)
        + "<h3>What is left</h3>"
        + table(("axis", "1σ", "next window", "over 1 s"), residuals)
        + f"<p>Flown: rotor speeds {number(valid['speed'][0])} to {number(valid['speed'][1])} rad/s, up to "
        f"{number(valid['airspeed'][1])} m/s through the air, rates up to {', '.join(number(v, 2) for v in valid['rate'])} rad/s. "
        "Beyond that it extrapolates.</p>"
    )
    return section


def _rotors(d: VehicleIdentification) -> Section:
    e, sd = d.layout.effect, d.layout.effect_sd
    rows = [
        (
            str(k), *(f"{number(float(e[a, k]), 3)} ± {number(float(sd[a, k]), 1)}" for a in range(3)),
            " ".join({1: "+", -1: "−", 0: "?"}[int(d.layout.found[a, k])] for a in range(3)),
        )
        for k in range(e.shape[1])
    ]  # fmt: skip
    section = Section("rotors", "Rotors")
    section.note = "Angular acceleration by each rotor's Ω² [rad/s² per (rad/s)²], and the sign beside the mean of all where it is clear."
    lags = "".join(
        f"<li>{escape(tr.motion.name)}: speeds stamped {1e3 * tr.speeds.lag:.1f} ms late</li>" for tr in d.tracks if tr.speeds.lag_told
    )
    arm = ", ".join(f"{1e3 * float(v):.0f} ± {1e3 * float(s):.0f}" for v, s in zip(d.arm, d.arm_sd, strict=True))
    section.after = table(("rotor", "roll", "pitch", "yaw", "signs "), rows)
    section.after += f"<ul>{lags}<li>IMU from the centre of gravity [mm]: {arm} (prior ±50)</li></ul>"
    return section


def _done(d: VehicleIdentification, command: str | None) -> Section:
    section = Section("done", "How it was made")
    text = to_toml(d)
    text = text[text.index("[lumped]") :]
    section.after = (
        "<p>Motion from navigator, smoothed; the autopilot's own solution was not used. Moments in integral form, two readings of the "
        "rotor speeds as instruments for each other; forces across the thrust axis jointly with the wind.</p>"
        f'<h3>[lumped] of the vehicle file</h3><pre class="command">{escape(text)}</pre>'
        + (f'<p>The command that gives this again:</p><pre class="command">{escape(command)}</pre>' if command else "")
    )
    return section
