"""Sections of series over time: attitude, velocity, position, biases, errors, innovations. It computes no results."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from haltere.flight.config import KEYS
from haltere.metrics.attitude import euler
from haltere.metrics.errors import error_series, reference_position
from haltere.report.context import COMPONENTS, Context, sensor_label
from haltere.report.markup import Section
from haltere.report.panels import Panels
from haltere.report.style import SENSOR_COLOURS

__all__ = ["DEG", "angle_columns", "attitude", "biases", "errors", "innovations", "position", "velocity"]

FloatArray = NDArray[np.float64]
DEG = 180.0 / math.pi
WORDS = {"n": "north", "e": "east", "d": "down"}


def _panels(c: Context, name: str, titles: list[str], row: int = 150) -> Panels:
    panels = Panels(name, c.pool, c.span, titles, row)
    panels.note_times(c.event_times)
    return panels


def _sd(c: Context, name: str, factor: float = 1.0) -> FloatArray | None:
    return factor * c.solution[name] if name in c.solution else None


def _smoothed(c: Context, panels: Panels, row: int, name: str, unit: str, factor: float = 1.0, resolution: float = 1e-3) -> None:
    """The smoothed quantity with 1σ, where the run was smoothed."""
    s = c.solution.smoothed
    if s is not None and name in s:
        sd = factor * s[f"sd_{name}"] if f"sd_{name}" in s else None
        panels.line(row, "smoothed", "smoothed", s.t, factor * s[name], sd, unit=unit, resolution=resolution, width=1.4, slow=True)


def angle_columns(c: Context, k: int) -> tuple[FloatArray, list[FloatArray], list[float], float | None]:
    """Times, angle and 1σ [deg], resolutions and period of roll, pitch or yaw (0, 1, 2), as `Pool.series` takes them."""
    columns = [c.angles[:, k]]
    sd = _sd(c, f"sd_{('roll', 'pitch', 'yaw')[k]}", DEG)
    if sd is not None:
        columns.append(sd)
    return c.solution.t, columns, [1e-3] * len(columns), None if k == 1 else 360.0


def attitude(c: Context) -> Section:
    """Roll, pitch and yaw with 1σ, over truth and onboard."""
    panels = _panels(c, "attitude", ["roll [deg]", "pitch [deg]", "yaw [deg]"])
    for k in range(3):
        t, columns, _, period = angle_columns(c, k)
        panels.line(k, "estimate", "estimate", t, *columns, unit="deg", period=period)
        if c.solution.smoothed is not None:
            s, sd = c.solution.smoothed, f"sd_{('roll', 'pitch', 'yaw')[k]}"
            panels.line(
                k, "smoothed", "smoothed", s.t, c.smoothed_angles[:, k], DEG * s[sd], unit="deg", period=period, width=1.4, slow=True
            )
        for name, stream in c.references:
            q = stream.vector("q", "wxyz")
            good = np.isfinite(q).all(axis=1)
            panels.line(k, name, name, stream.t[good], DEG * euler(q[good])[:, k], unit="deg", period=period, width=1.0)
    return Section("attitude", "Attitude", "Roll right side down, pitch nose up, yaw from true north towards east.", [panels.figure()])


def velocity(c: Context) -> Section | None:
    """Velocity NED with 1σ, over GNSS, truth and onboard."""
    if "vel_n" not in c.solution:
        return None
    panels = _panels(c, "velocity", [f"{WORDS[a]} [m/s]" for a in "ned"])
    panels.reversed = {2}
    for k, a in enumerate("ned"):
        t, v = c.measured(f"vel_{a}")
        panels.line(k, "GNSS", "gnss", t, v, unit="m/s", width=1.0)
        panels.line(k, "estimate", "estimate", c.solution.t, c.solution[f"vel_{a}"], _sd(c, f"sd_vel_{a}"), unit="m/s")
        _smoothed(c, panels, k, f"vel_{a}", "m/s")
        for name, stream in c.references:
            panels.line(k, name, name, stream.t, stream.get(f"vel_{a}"), unit="m/s", width=1.0)
    return Section(
        "velocity",
        "Velocity",
        "Over ground, north, east and down; the axis of down points down, so that climbing goes up.",
        [panels.figure()],
    )


def position(c: Context) -> Section | None:
    """Position NED with 1σ, over GNSS, barometer, truth and onboard."""
    if "pos_n" not in c.solution:
        return None
    note = "From the origin, north, east and down; the axis of down points down."
    if not c.held_by_measurement:
        note += " <strong>No GNSS position was let in: this is dead reckoning, held near the start by an assumption.</strong>"
    panels = _panels(c, "position", [f"{WORDS[a]} [m]" for a in "ned"])
    panels.reversed = {2}
    for k, a in enumerate("ned"):
        t, p = c.measured(f"pos_{a}")
        panels.line(k, "GNSS", "gnss", t, p, unit="m", width=1.0)
        if a == "d":
            _barometer(c, panels, k)
        panels.line(k, "estimate", "estimate", c.solution.t, c.solution[f"pos_{a}"], _sd(c, f"sd_pos_{a}"), unit="m")
        _smoothed(c, panels, k, f"pos_{a}", "m")
        for name, stream in c.references:
            tp, p = reference_position(stream, list(c.origin) if c.origin else None)
            panels.line(k, name, name, tp, p[:, k], unit="m", width=1.0)
    return Section("position", "Position", note, [panels.figure()])


def _barometer(c: Context, panels: Panels, row: int) -> None:
    """Barometric height as the filter compares it: without its estimated offset."""
    rows = c.offered("barometer", "altitude")
    if rows.any() and "baro_bias" in c.solution:
        t = c.solution.aids["t"][rows]
        offset = np.interp(t, c.solution.t, c.solution["baro_bias"])
        panels.line(row, "barometer less its offset", "barometer", t, offset - c.solution.aids["observation"][rows], unit="m", width=1.0)


def biases(c: Context) -> Section | None:
    """Biases of gyro, accelerometer and barometer with 1σ."""
    groups = [(f"gyro_bias_{a}", f"gyro {a} [deg/s]", "deg/s", DEG, 1e-4) for a in "xyz"]
    groups += [(f"accel_bias_{a}", f"accel. {a} [m/s²]", "m/s²", 1.0, 1e-4) for a in "xyz"]
    groups += [("baro_bias", "barometer [m]", "m", 1.0, 1e-3), *((f"mag_offset_{a}", f"magnet. {a} [µT]", "µT", 1.0, 1e-3) for a in "xyz")]
    groups = [g for g in groups if g[0] in c.solution]
    if not groups:
        return None
    panels = _panels(c, "biases", [g[1] for g in groups], 112)
    for k, (name, _, unit, factor, resolution) in enumerate(groups):
        y = factor * c.solution[name]
        panels.line(k, "estimate", "estimate", c.solution.t, y, _sd(c, f"sd_{name}", factor), unit=unit, resolution=resolution, slow=True)
        _smoothed(c, panels, k, name, unit, factor, resolution)
        for label, stream in c.references:
            panels.line(k, label, label, stream.t, factor * stream.get(name), unit=unit, resolution=resolution, width=1.0)
    return Section("biases", "Sensor biases", "Measured minus true; the estimate is subtracted from the sensor.", [panels.figure()])


def errors(c: Context) -> Section | None:
    """Errors against truth with the stated 1σ about zero, where there is a truth."""
    truth = c.flight.get("truth")
    if truth is None or len(truth) < 2:
        return None
    series = error_series(c.solution, truth)
    names = [n for n in ("roll", "pitch", "yaw", "vel_n", "vel_e", "vel_d", "pos_n", "pos_e", "pos_d") if n in series]
    if not names:
        return None
    smoothed = error_series(c.solution.smoothed, truth) if c.solution.smoothed is not None else {}
    figures = []
    for group, title in (("", "attitude"), ("vel", "velocity"), ("pos", "position")):
        mine = [n for n in names if n.rpartition("_")[0] == group]
        if not mine:
            continue
        units = [(n, "deg", DEG) if not group else COMPONENTS[n][:3] for n in mine]
        panels = _panels(c, f"errors_{title}", [f"{label} [{unit}]" for label, unit, _ in units], 112)
        for k, (name, (_, unit, factor)) in enumerate(zip(mine, units, strict=True)):
            t, e = series[name]
            sd = _sd(c, f"sd_{name}", factor)
            at = None if sd is None else np.interp(t, c.solution.t, sd)
            panels.line(k, "estimate less truth", "estimate", t, factor * e, at, unit=unit, centred=True)
            if at is not None:
                panels.multiples(k, "±3σ", 3.0)
            if name in smoothed:
                t, e = smoothed[name]
                panels.line(k, "smoothed less truth", "smoothed", t, factor * e, unit=unit, width=1.2)
        figures.append({**panels.figure(), "title": title})
    note = "The band is what the filter states: the error should lie inside for two thirds of the time, and nearly always between the dots."
    return Section("errors", "Errors against truth", note, figures)


def innovations(c: Context) -> Section:
    """Innovations a sensor and component with ±1σ, the gate, and what was refused or de-weighted."""
    section = Section("innovations", "Innovations", "Measured minus predicted, before each update. " + _legend_note())
    beyond = 0
    for sensor in c.sensors:
        components = [k for k in COMPONENTS if c.offered(sensor, k).any()]
        if not components:
            continue
        titles = [f"{COMPONENTS[k][0]} [{COMPONENTS[k][1]}]" for k in components]
        panels = _panels(c, f"innovations_{sensor}", titles, 112 if sensor in SENSOR_COLOURS else 106)
        for k, component in enumerate(components):
            beyond += _innovation(c, panels, k, sensor, component)
        figure = panels.figure()
        figure["title"] = sensor_label(sensor)
        section.figures.append(figure)
    if not section.figures:
        section.note = "Not drawn: no measurement was offered to the filter."
    elif beyond:
        section.note += f" {beyond} refused samples lie beyond the axes shown; a double click on a panel shows them."
    return section


def _legend_note() -> str:
    return "A joint gate tests the components of one measurement together, so that a sample may be refused for its neighbour."


def _innovation(c: Context, panels: Panels, row: int, sensor: str, component: str) -> int:
    """One panel; returns how many refused samples lie beyond its axis."""
    a = c.solution.aids
    _, unit, factor, resolution = COMPONENTS[component]
    rows = c.offered(sensor, component)
    t, e, sd = a["t"][rows], factor * a["innovation"][rows], factor * a["innovation_sd"][rows]
    status, reason = a["status"][rows], a["reason"][rows]
    key = f"gate.{sensor}"
    gate = c.solution.config.number(key) if key in KEYS else 3.0
    label = f"gate ±{gate:g}σ" if key in KEYS else "±3σ (no gate)"
    panels.line(
        row, "innovation", SENSOR_COLOURS.get(sensor, "assumed"), t, e, sd, unit=unit, resolution=resolution, width=1.0, centred=True
    )
    panels.multiples(row, label, gate)
    bound = 1.1 * gate * float(np.median(sd))
    passed = np.abs(e[status != "rejected"])
    refused = np.abs(e[status == "rejected"])
    # The gate is shown where innovations come near it; a few wild samples must not flatten the rest.
    reach = max(float(passed.max(initial=0.0)), min(float(refused.max(initial=0.0)), 4.0 * bound))
    reach = max(reach, min(bound, 6.0 * float(np.quantile(np.abs(e), 0.95))), float(np.median(sd)) * 1.3)
    panels.extent[row] = (-reach, reach)
    for word, name, colour, symbol in (
        ("deweighted", "de-weighted", "deweighted", "diamond"),
        ("rejected", "refused", "refused", "x"),
        ("held", "held", "deweighted", "circle-open"),
    ):
        mine = status == word
        if mine.any():
            texts = [f"{name}: {why}" if why else name for why in reason[mine].tolist()]
            panels.markers(row, name, colour, t[mine], e[mine], symbol=symbol, texts=texts, unit=unit, resolution=resolution, widen=False)
    return int(np.count_nonzero(refused > 1.06 * reach))
