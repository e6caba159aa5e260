"""Drag and wind from flights: the models fitted, what autopilots are to be told, and how far to trust it. It draws and writes nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.flight.config import Config
from haltere.flight.log import FlightLog
from haltere.identify.fitting import Result, fit, load_of, without_wind
from haltere.identify.forms import FORMS, G0, RHO0
from haltere.identify.prepare import Motion, Samples, motion, samples
from haltere.identify.projection import Projection, project

__all__ = ["DragIdentification", "NotObservableError", "identify_drag"]

FloatArray = NDArray[np.float64]

#: 1 sigma of the logarithm of the linear drag above which nothing is given, and from which it is called poor.
REFUSED, POOR = 0.35, 0.12
#: A quadratic coefficient less than this many sigma above zero is left away.
TOLD = 2.0
#: Without rotor speeds, where their root of thrust is bent by inflow, errors in simulation were about this many times 1 sigma; and more of
#: ArduPilot's formula, whose quadratic part knows each axis by itself.
DOUBT, DOUBT_AXES = 1.5, 2.0
#: Least spread of the ground velocity [m/s, root mean square], largest offset [m/s^2] and least quadratic drag [sigma] that are believed.
LEAST_SPREAD, LARGEST_OFFSET, LEAST_C = 0.7, 1.0, -3.0
#: Mean wind known worse than this is said to be mixed with offsets [m/s].
WIND_POOR = 1.0


@dataclass
class DragIdentification:
    """What flights tell of a vehicle's drag.

    Attributes
    ----------
    fits
        Every model fitted to the data, by name (`haltere.identify.forms.FORMS`).
    base
        The model of haltere's own two, ``rotors`` (where the log has rotor speeds) and ``haltere``, that fits better.
    haltere, px4, ardupilot
        What comes nearest to it in the terms of haltere and of the autopilots; a quadratic part that the flights do not tell is left away.
    still
        Parameters by model of a fit that takes the air for still, for comparison.
    flights, motions
        What was fitted, and where it is from.
    density
        Mean air density [kg/m^3] and its relative 1 sigma.
    force_sd
        Root mean square of what a filter with a slow wind sees beside the drag, gusts included [m/s^2].
    refused
        Why nothing is to be pasted; empty where it may be.
    notes
        Sentences on what was assumed, found and not told.
    """

    fits: dict[str, Result]
    base: Result
    haltere: Projection
    px4: Projection
    ardupilot: Projection
    still: dict[str, FloatArray]
    flights: list[Samples]
    motions: list[Motion]
    density: float
    density_sd: float
    force_sd: float
    refused: str = ""
    notes: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Of the flights."""
        return ", ".join(m.name for m in self.motions)

    def sd(self, p: Projection) -> FloatArray:
        """1 sigma of parameters with that of the air density: the linear one goes with its root, the quadratic with itself."""
        share = np.r_[0.5, np.ones(len(p.values) - 1)] * self.density_sd
        return np.asarray(np.hypot(self.doubt(p.form) * p.sd, share * np.abs(p.values)))

    def doubt(self, form: str) -> float:
        """Factor on 1 sigma of a form's parameters for what the model of the drag itself is wrong by."""
        if self.base.form == "rotors":
            return 1.0
        return DOUBT_AXES if form == "ardupilot" else DOUBT

    @property
    def own(self) -> tuple[FloatArray, FloatArray]:
        """Linear drag in hover at sea level [1/s] and quadratic drag [1/m] for navigator (2,), and 1 sigma."""
        if self.base.form != "rotors":
            return self.haltere.values, self.sd(self.haltere)
        # rotor speed in hover there, from the proportion of its square to thrust over density
        ratio = [np.median(load_of("rotors", s) * np.sqrt(s.density / RHO0 * G0 / np.maximum(s.thrust, 1.0))) for s in self.flights]
        k = np.r_[float(np.mean(ratio)), 1.0]
        values = k * self.base.values
        if values[1] < TOLD * k[1] * self.base.sd[1]:
            values = np.r_[values[0], 0.0]
        return values, np.hypot(k * self.base.sd, np.r_[0.5, 1.0] * self.density_sd * values)

    @property
    def drag_at(self) -> tuple[float, float]:
        """Drag at 5 m/s in level flight [m/s^2] and 1 sigma, at the flights' mean load and density."""
        form = self.haltere.form
        s = self.flights[0]
        load = float(np.mean(np.concatenate([load_of(form, f) for f in self.flights])))
        g = np.array([5.0 * math.sqrt(self.density / 1.225 * max(load, 0.0) / 9.80665), 25.0 * float(np.mean(s.density)) / 1.225])
        return float(g @ self.haltere.values), self.doubt(form) * float(np.sqrt(max(g @ self.haltere.covariance @ g, 0.0)))


class NotObservableError(HaltereError):
    """Flights that do not tell drag from wind.

    Attributes
    ----------
    identification
        What came out nevertheless, to be looked at.
    """

    def __init__(self, expected: str, found: str, where: str, remedy: str, identification: DragIdentification) -> None:
        super().__init__(expected, found, where, remedy)
        self.identification = identification

    def __reduce__(self) -> tuple[Any, ...]:
        """The same in another process."""
        return type(self), (self.expected, self.found, self.where, self.remedy, self.identification)


def identify_drag(
    flights: FlightLog | Sequence[FlightLog],
    *,
    config: Config | Mapping[str, Any] | str | Path | None = None,
    set: Mapping[str, Any] | None = None,
) -> DragIdentification:
    """Drag of a vehicle from one or several of its flights, in whatever wind there was.

    Parameters
    ----------
    flights
        Logs of one vehicle with IMU and GNSS, with speeds of some m/s in several directions. Rotor speeds, where logged, are used.
    config, set
        Configuration, as of `haltere.run`; ``baro.temperature`` [K] sharpens the air density.

    Returns
    -------
    DragIdentification
        Parameters with 1 sigma for haltere, PX4 and ArduPilot, wind of each flight, and what was not told.

    Raises
    ------
    NotObservableError
        The flights do not tell drag from wind, as in hover; the message says what to fly.
    HaltereError
        A log that cannot be navigated on, or that never flew.
    """
    logs = [flights] if isinstance(flights, FlightLog) else list(flights)
    if not logs:
        raise HaltereError("at least one flight", "none", "identify")
    motions = [motion(log.without("onboard", "truth"), config, set) for log in logs]
    windows = [samples(m) for m in motions]
    notes = list(dict.fromkeys(note for m in motions for note in m.notes))
    forms = ["haltere", "px4", "ardupilot"] if _spread(windows) >= LEAST_SPREAD else ["haltere"]  # of hover nothing is to be had
    if all(w.speed is not None for w in windows):
        forms.insert(0, "rotors")
    else:
        notes.append(
            "no rotor speeds through the flight: drag is taken to go with the root of the thrust, which inflow and translational lift "
            f"bend; 1 sigma of what is to be pasted is raised by {DOUBT:g}, of ArduPilot's by {DOUBT_AXES:g}"
        )
    fits = {form: fit(form, windows) for form in forms}
    base = min((fits[f] for f in ("rotors", "haltere") if f in fits), key=lambda r: r.bic)
    out = DragIdentification(
        fits, base, project(base, "haltere"), project(base, "px4"), project(base, "ardupilot"),
        {form: without_wind(form, windows) for form in (*forms, "px4")}, windows, motions,
        float(np.mean(np.concatenate([w.density for w in windows]))), max(m.density_sd for m in motions), _force_sd(base), "", notes,
    )  # fmt: skip
    out.refused = _judge(out)
    if not out.refused:
        _leave_away(out)
    else:
        raise NotObservableError(
            "flights that tell drag from wind", out.refused, out.name,
            "fly forth and back and sideways at two or more speeds of 3 to 8 m/s, in several directions, with the nose turning between",
            out,
        )  # fmt: skip
    return out


def _force_sd(base: Result) -> float:
    """Root mean square of force that neither the model nor the mean wind explains: what a filter has to take for noise [m/s^2]."""
    parts = []
    for part in base.parts:
        v_slope = base.values[0] * float(np.mean(load_of(base.form, part.samples))) if base.form == "rotors" else base.values[0]
        gust, _, left, _, noise = part.sizes
        parts.append((v_slope * gust) ** 2 + left**2 + noise**2)
    return float(np.sqrt(np.mean(parts)))


def _leave_away(out: DragIdentification) -> None:
    """Quadratic parts that the flights do not tell from zero are left away, and said."""
    for name in ("haltere", "px4", "ardupilot"):
        p: Projection = getattr(out, name)
        free = np.r_[True, (p.values > TOLD * p.sd)[1:]]
        if not free.all():
            form, most = FORMS[name], np.maximum(p.values, 0.0) + 2.0 * p.sd
            off = np.flatnonzero(~free)
            missing = [f"{form.names[k].replace('inverse_', '1/')} (below {most[k]:.2g} {form.units[k]})" for k in off]
            out.notes.append(f"{name}: {' and '.join(missing)} not told from none and left away; 2 sigma. Fly faster")
            setattr(out, name, project(out.base, name, free))


def _spread(windows: list[Samples]) -> float:
    """Spread of the horizontal ground velocity within flights, root mean square [m/s]."""
    return float(np.sqrt(np.mean([np.sum(np.var(s.vel_n[:, :2], axis=0)) for s in windows])))


def _odd(out: DragIdentification) -> str:
    """Why a result that looks certain is none: too little motion, or numbers that no vehicle has."""
    base = out.base
    spread = _spread(out.flights)
    if spread < LEAST_SPREAD:
        return f"not observable: the horizontal velocity varies by {spread:.2f} m/s only (rms; {LEAST_SPREAD:g} needed), as in hover"
    offset = max(float(np.max(np.abs(part.rest[:2]))) for part in base.parts)
    if offset > LARGEST_OFFSET:
        return f"no plausible fit: an offset of {offset:.1f} m/s^2 across the thrust axis"
    if base.values[1] < LEAST_C * base.sd[1]:
        return f"no plausible fit: a quadratic drag of {base.values[1]:.2g} 1/m, below zero by more than chance"
    return ""


def _judge(out: DragIdentification) -> str:
    """Why nothing is to be used; notes on what is poor."""
    base = out.base
    if not base.converged:
        out.notes.append("the fit did not settle: what it gives is rough")
    if base.log_sd > REFUSED:
        known = f"to {100.0 * base.log_sd:.0f} %" if base.log_sd < 1.0 else "not even to its order"
        return f"not observable: linear drag known {known} (1 sigma; {100.0 * REFUSED:.0f} % allowed)"
    if found := _odd(out):
        return found
    if base.log_sd > POOR:
        out.notes.append(f"poor: linear drag is known to {100.0 * base.log_sd:.0f} % (1 sigma); fly longer, or at more different speeds")
    for k, (part, m) in enumerate(zip(base.parts, out.motions, strict=True)):
        sd = base.part_sd(k)[-2:]
        if float(np.max(sd)) > WIND_POOR:
            out.notes.append(
                f"{m.name}: mean wind is known to {float(np.max(sd)):.1f} m/s only: it is not told from offsets of thrust axis and "
                "accelerometer where the nose hardly turns"
            )
        most = float(np.max(np.abs(part.rest[:2])))
        if most > 0.4:
            out.notes.append(f"{m.name}: offset of {most:.2f} m/s^2 across the thrust axis, more than usual")
    if base.inflation > 1.5:
        out.notes.append(f"stretches of the flights differ more than gusts explain: 1 sigma was raised by {math.sqrt(base.inflation):.1f}")
    return ""
