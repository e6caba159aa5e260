"""Section on the sensors themselves: sampling, vibration, range, field, accuracies. It computes no results: see the metrics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import Stream
from haltere.flight.schema import base_name
from haltere.metrics.magnetism import field_series
from haltere.metrics.sensors import FINDINGS, differences, flying, rotor_band
from haltere.metrics.spectra import Spectrum, floor, folded, peaks, px4_vibration, spectrogram, spectrum
from haltere.report.consistency import unmarked
from haltere.report.context import Context
from haltere.report.grid import Grid
from haltere.report.markup import Section, escape, table
from haltere.report.panels import FOOT, LEFT, TOP, Figure, Panels
from haltere.report.style import AXES
from haltere.report.words import count, number

__all__ = ["health"]

FloatArray = NDArray[np.float64]
DEG = 180.0 / math.pi
BODY = ("body_x", "body_y", "body_z")
#: Below this rate [Hz] a multirotor's rotors turn faster than half of it, so that their vibration is folded or filtered away.
SLOW = 150.0


def health(c: Context) -> Section:
    """What each sensor's own samples say: sampling, vibration, range, field, accuracies, and further units."""
    section = Section("health", "Sensor health", "What the samples themselves say, whatever the filter made of them.")
    absent: list[str] = []
    imu = c.flight.get("imu")
    if imu is not None and len(imu) > 2:
        section.figures += [f for f in (_intervals(c, imu), _spectra(c, imu, absent), _spectrogram(c, imu)) if f is not None]
    vibration = _vibration(c, absent)
    figures = (vibration, _field(c, absent), _gnss(c, absent), _temperature(c), _units(c, absent))
    section.figures += [f for f in figures if f is not None]
    section.after = _ranges(c)
    if absent:
        section.after += f"<p>Not in this log, so not shown: {escape('; '.join(absent))}.</p>"
    return section


def _facts(c: Context, stream: str) -> dict[str, Any]:
    """What the summary says of a stream's sensor."""
    facts: dict[str, Any] = c.solution.summary.get("sensors", {}).get(stream) or {}
    return facts


def _panels(c: Context, name: str, titles: list[str], row: int = 112) -> Panels:
    panels = Panels(name, c.pool, c.span, titles, row)
    panels.note_times(c.event_times)
    return panels


def _intervals(c: Context, imu: Stream) -> Figure | None:
    """Time between IMU samples."""
    t = np.sort(imu.t[np.isfinite(imu.t)])
    dt = np.round(1e3 * np.diff(t), 4)
    if len(dt) < 2:
        return None
    middle = float(np.median(dt))
    panels = _panels(c, "imu_interval", ["interval [ms]"], 84)
    panels.line(0, "since the sample before", "imu", t[1:], dt, unit="ms", resolution=1e-2, width=1.0)
    # One long gap must not flatten the rest; the words below have it.
    high = min(float(dt.max()), 20.0 * middle)
    panels.extent[0] = (min(float(dt.min()), 0.9 * middle), max(high, 1.1 * middle))
    figure = panels.figure()
    figure["title"] = "IMU sampling"
    late = float(np.mean(np.abs(dt - middle) > 0.5 * middle))
    i = int(np.argmax(dt))
    steady = "Steady" if late < 0.001 else f"{100.0 * late:.2g} % of the intervals are off by more than half"
    longest = f"{number(float(dt[i]))} ms" if dt[i] < 1e3 else f"{number(1e-3 * float(dt[i]))} s"
    beyond = " (beyond the axis)" if dt[i] > 1.1 * panels.extent[0][1] else ""
    figure["reading"] = f"{steady}: median {number(middle)} ms, longest {longest} from t = {t[i]:.1f} s{beyond}."
    return figure


def _ordered(imu: Stream, stem: str) -> tuple[FloatArray, FloatArray]:
    """Times that increase, and the vectors at them that are finite."""
    x = imu.vector(stem)
    good = np.isfinite(imu.t) & np.isfinite(x).all(axis=1)
    t, first = np.unique(imu.t[good], return_index=True)
    return t, x[good][first]


def _spectra(c: Context, imu: Stream, absent: list[str]) -> Figure | None:
    """Density of gyro and accelerometer in motion and at rest, with what the filter assumes."""
    at, moving, still = flying(c.flight)
    found: list[tuple[str, str, float, str, Spectrum | None, Spectrum | None]] = []
    for stem, word, factor, unit in (("gyro", "gyro", DEG, "(deg/s)/√Hz"), ("accel", "accel.", 1.0, "(m/s²)/√Hz")):
        t, x = _ordered(imu, stem)
        motion, rest = (spectrum(t, x, rows) if rows.any() else None for rows in (np.isin(t, at[moving]), np.isin(t, at[still])))
        if motion is not None or rest is not None:
            found.append((stem, f"{word} [{unit}]", factor, word, motion, rest))
    if not found:
        return None
    grid = Grid("spectrum", [f[1] for f in found], "frequency [Hz]")
    rotors, said, rate = rotor_band(c.flight), [], 1.0
    for k, (stem, _, factor, word, motion, rest) in enumerate(found):
        lead = motion or rest
        assert lead is not None
        rate = lead.rate
        levels = []
        for s, thin in ((motion, False), (rest, motion is not None)):
            if s is None:
                continue
            y = factor * s.density
            if thin:
                grid.line(k, "at rest, mean of axes", "assumed", s.f, np.maximum(np.sqrt(np.mean(y**2, axis=1)), 1e-12), width=1.1)
            else:
                for axis in range(3):
                    grid.line(k, "xyz"[axis], BODY[axis], s.f, np.maximum(y[:, axis], 1e-12), hover="%{y:.3~g} at %{x:.4~g} Hz")
            levels.append(y[s.f > 0.03 * rate])
        given = factor * c.solution.config.number(f"noise.{stem}")
        grid.line(k, "assumed by the filter", "estimate", np.array([0.0, 0.5 * rate]), np.array([given, given]), dash="6px,3px", width=1.6)
        every = np.concatenate([v.ravel() for v in levels])
        grid.range(k, max(0.5 * min(float(np.quantile(every, 0.01)), given), 1e-9), 2.0 * max(float(every.max()), given), log=True)
        if rotors is not None and rotors[0] < 0.5 * rate:
            grid.shade(k, rotors[0], min(rotors[1], 0.5 * rate), "deweighted/0.22")
        if motion is not None:
            named: list[float] = []
            for p in peaks(motion):
                if any(abs(p.frequency - f) < 0.03 * rate for f in named):
                    continue  # its words would lie on those of a stronger line
                named.append(p.frequency)
                i = int(np.argmin(np.abs(motion.f - p.frequency)))
                grid.name_at(k, p.frequency, factor * float(motion.density[max(i - 2, 0) : i + 3].max()), f"{p.frequency:.0f} Hz", log=True)
        said.append(_spectrum_words(word, factor, "deg/s" if stem == "gyro" else "m/s²", motion, rest, given, rotors))
    grid.x_range(0.0, 0.5 * rate)
    figure = grid.figure()
    figure["title"] = "Noise and vibration over frequency" + ("" if found[0][4] is not None else ", at rest throughout")
    caveat = ""
    if rate < SLOW:
        caveat = (
            f" Logged at {rate:.0f} Hz, the IMU shows nothing above {0.5 * rate:.0f} Hz: rotor vibration is either filtered away before, "
            "or folded into this band, and the log cannot tell which."
        )
    if rotors is None:
        absent.append("rotor speeds, to tell whose vibration it is")
    figure["reading"] = " ".join(said) + caveat
    return figure


def _spectrum_words(
    word: str, factor: float, unit: str, motion: Spectrum | None, rest: Spectrum | None, given: float, rotors: tuple[float, float] | None
) -> str:
    """Floor against what is assumed, and the strongest lines, in a sentence or two."""
    lead = motion or rest
    assert lead is not None
    level = factor * float(np.sqrt(np.mean(floor(lead) ** 2)))
    ratio = level / given
    judged = "about as assumed" if 0.5 <= ratio <= 2.0 else "less, which is cautious" if ratio < 0.5 else "more than the filter believes"
    where = "in motion" if motion is not None else "at rest"
    name = {"accel.": "Accelerometer"}.get(word, word.capitalize())
    out = f"{name} floor {where} {number(level, 2)} against {number(given, 2)} ({unit})/√Hz assumed: {judged}."
    lines = peaks(motion) if motion is not None else []
    if lines:
        listed = ", ".join(
            f"{number(factor * p.amplitude, 2)} {unit} at {p.frequency:.0f} Hz{_whose(p.frequency, rotors, lead.rate)}" for p in lines
        )
        out += f" {'Line' if len(lines) == 1 else 'Lines'}: {listed}."
    return out


def _whose(frequency: float, rotors: tuple[float, float] | None, rate: float) -> str:
    """What a line may come from, where rotor speeds are known."""
    if rotors is None:
        return ""
    low, high = rotors
    for times, what in ((1.0, "rotor speed"), (2.0, "twice the rotor speed")):
        if 0.95 * times * low <= frequency <= 1.05 * times * high:
            return f" ({what})"
    span = np.linspace(low, high, 9)
    if low > 0.5 * rate and any(abs(folded(float(f), rate) - frequency) < 0.02 * rate for f in span):
        return " (rotor speed, folded)"
    return ""


def _spectrogram(c: Context, imu: Stream) -> Figure | None:
    """Vibration of the accelerometer over time and frequency."""
    t, x = _ordered(imu, "accel")
    result = spectrogram(t, np.linalg.norm(x, axis=1)) if len(t) else None
    if result is None:
        return None
    times, f, density = _with_gaps(*result)
    with np.errstate(divide="ignore"):
        level = 20.0 * np.log10(np.maximum(density, 1e-6))
    usable = level[np.isfinite(level)]
    if len(usable) == 0 or float(np.ptp(usable)) < 1.0:
        return None
    low, high = (float(v) for v in np.percentile(usable, [5.0, 99.5]))
    shown = [[None if not math.isfinite(v) else round(v) for v in row] for row in level.tolist()]
    trace = {
        "type": "heatmap", "name": "level", "x": np.round(times, 2).tolist(), "y": np.round(f, 2).tolist(), "z": shown, "zmin": round(low),
        "zmax": max(round(high), round(low) + 1), "colorscale": [[0, "@page"], [0.6, "@estimate"], [1, "@text"]],
        "hovertemplate": "%{z} dB at %{y:.1f} Hz", "xaxis": "x", "yaxis": "y", "showscale": False,
    }  # fmt: skip
    row = 190
    layout = {
        "margin": {"l": LEFT, "r": 12, "t": TOP, "b": FOOT}, "hovermode": "closest",
        "xaxis": {**AXES, "range": list(c.span), "title": {"text": "t [s]", "standoff": 4}, "hoverformat": ".3f", "anchor": "y"},
        "yaxis": {**AXES, "range": [0.0, float(f[-1] + f[0])], "title": {"text": "|accel.| [Hz]", "standoff": 6}, "anchor": "x"},
    }  # fmt: skip
    half = 0.5 * float(np.median(np.diff(times)))
    heads = ["from t [s]", "to t [s]", *(f"{v:.1f} Hz [dB]" for v in f)]
    columns = np.array(shown, dtype=object).T.tolist()
    rows = [[round(float(at) - half, 2), round(float(at) + half, 2), *column] for at, column in zip(times, columns, strict=True)]
    return {
        "name": "accel_spectrogram", "traces": [trace], "layout": layout, "height": row + TOP + FOOT, "time": True,
        "title": "Vibration over time and frequency", "table": {"heads": heads, "rows": rows},
        "reading": f"Density of the specific force's size, from {_db(low)} (as the page) to {_db(high)} of 1 (m/s²)/√Hz (darkest "
                   "on light, lightest on dark). Lines that move with throttle are the rotors; lines that stay are the frame.",
    }  # fmt: skip


def _with_gaps(times: FloatArray, f: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A spectrogram with an empty column after and before each gap, which would be filled by its neighbours otherwise."""
    dt = np.diff(times)
    typical = float(np.median(dt))
    at = np.flatnonzero(dt > 2.5 * typical) + 1
    edges = np.column_stack([times[at - 1] + typical, times[at] - typical]).ravel()
    return np.insert(times, np.repeat(at, 2), edges), f, np.insert(density, np.repeat(at, 2), np.nan, axis=1)


def _db(level: float) -> str:
    return f"{round(level)} dB".replace("-", "−")


def _bound(panels: Panels, k: int, value: float, colour: str, label: str) -> None:
    """A horizontal limit, where the axis comes near it."""
    if value < 1.6 * panels.extent[k][1]:
        ends = np.array(panels.span, np.float64)
        panels.line(k, label, colour, ends, np.full(2, value), unit="", width=1.2)
        unmarked(panels, label, dash="solid")


def _vibration(c: Context, absent: list[str]) -> Figure | None:
    """Vibration in the autopilots' own measures."""
    logged = c.flight.get("vibration")
    if logged is not None and np.isfinite(logged.get("vibe_x")).any():
        panels = _panels(c, "vibration", ["vibration [m/s²]"])
        for k, a in enumerate("xyz"):
            panels.line(0, a, BODY[k], logged.t, logged.get(f"vibe_{a}"), unit="m/s²", resolution=1e-2, width=1.2)
        _bound(panels, 0, FINDINGS["vibration"], "doubtful", "acceptable")
        _bound(panels, 0, 60.0, "bad", "too much")
        figure = panels.figure()
        facts = _facts(c, "imu").get("vibration", {})
        figure["title"] = "Vibration as ArduPilot measured it"
        figure["reading"] = (
            f"Median {number(facts.get('median'))}, worst {number(facts.get('worst'))} m/s² on the worst axis. ArduPilot's people take "
            "below 30 as acceptable, and expect trouble holding position above 60."
        )
        return figure
    imu = c.flight.get("imu")
    t, x = _ordered(imu, "accel") if imu is not None and len(imu) else (np.empty(0), np.empty((0, 3)))
    metric = px4_vibration(t, x)
    if metric is None:
        if len(t):
            absent.append("a measure of vibration (ArduPilot's VIBE, or an IMU logged at 150 to 400 Hz)")
        return None
    panels = _panels(c, "vibration", ["vibration [m/s²]"])
    panels.line(0, "PX4's measure", "imu", t, metric, unit="m/s²", resolution=1e-2, width=1.4)
    _bound(panels, 0, 4.905, "doubtful", "high")
    _bound(panels, 0, FINDINGS["px4_vibration"], "bad", "too high")
    figure = panels.figure()
    facts = _facts(c, "imu").get("px4_vibration", {})
    figure["title"] = "Vibration by PX4's measure"
    figure["reading"] = (
        f"Change between successive samples, smoothed: median {number(facts.get('median'))} m/s² in motion. "
        "PX4's flight review calls below 4.9 good and above 9.8 too high."
    )
    return figure


def _ranges(c: Context) -> str:
    """Largest values, clipping and unchanging values of every IMU as a table."""
    rows: list[tuple[str, ...]] = []
    for stream in (s for s in c.flight if base_name(s) == "imu"):
        facts = _facts(c, stream)
        clipped, still = facts.get("clipping", {}), facts.get("unchanged", {})
        for name, largest in facts.get("largest", {}).items():
            stem, _, axis = name.partition("_")
            factor, unit = (DEG, "deg/s") if stem == "gyro" else (1.0, "m/s²")
            hit = clipped.get(name)
            counted = clipped.get(stem) if axis == "x" else None  # a counter without axes stands once
            rows.append((
                escape(stream), escape(f"{stem} {axis}"), f"{number(factor * largest)} {unit}", _clipped(hit or counted),
                f"{number(still[name]['seconds'], 2)} s at {still[name]['at']:.1f} s" if name in still else "none",
                f"{100.0 * still[name]['share']:.2g} %" if name in still else "0 %",
            ))  # fmt: skip
    if not rows:
        return ""
    heads = ("stream", "axis ", "largest", "clipped ", "unchanged for", "repeats")
    out = table(heads, rows, caption="Samples at the end of the range, longest time without a change, and samples equal to the one before")
    known = {v["how"] for s in c.flight for v in _facts(c, s).get("clipping", {}).values()}
    meaning = "Beyond the end of a range nothing is measured, and the estimate drifts." if known else "No sample was at its range's end."
    return f"{out}<p class='note'>{meaning} A sensor that repeats itself is frozen, coarse, or logged faster than it samples.</p>"


def _clipped(hit: dict[str, Any] | None) -> str:
    if not hit:
        return "none"
    when = "" if hit["first"] is None else f", t = {hit['first']:.1f} … {hit['last']:.1f} s"
    how = {"logged": "", "counted": " counted by the autopilot, all axes", "seen": " seen in the samples"}[hit["how"]]
    return f"<b>{hit['n']:,}</b>{how}{when}"


def _field(c: Context, absent: list[str]) -> Figure | None:
    """Strength and dip of the field against the model, with the filter's tolerance."""
    series = field_series(c.solution, c.flight)
    if series is None:
        return None
    dips = bool(np.isfinite(series.dip).any())
    panels = _panels(c, "field", ["strength [µT]", *(["dip [deg]"] if dips else [])])
    for name in (s for s in c.flight if base_name(s) == "magnetometer" and s != "magnetometer"):
        other = field_series(c.solution, c.flight, name)
        if other is not None:
            label = name.replace("magnetometer.", "further unit ")
            panels.line(0, label, "assumed", other.t, other.strength, unit="µT", resolution=1e-2, width=0.9)
            if dips:
                panels.line(1, label, "assumed", other.t, DEG * other.dip, unit="deg", resolution=1e-2, width=0.9)
    panels.line(0, "measured", "magnetometer", series.t, series.strength, unit="µT", resolution=1e-2, width=1.3)
    if dips:
        panels.line(1, "measured", "magnetometer", series.t, DEG * series.dip, unit="deg", resolution=1e-2, width=1.3)
    ends = np.array(c.span, np.float64)
    if series.expected is not None:
        strength, dip = series.expected
        edges = [(0, strength, series.tolerance[0] * strength), (1, DEG * dip, DEG * series.tolerance[1])]
        for k, middle, reach in edges[: len(panels.titles)]:
            panels.line(k, "expected", "text", ends, np.full(2, middle), width=1.2)
            for edge in (middle - reach, middle + reach):
                panels.line(k, "tolerance of the filter", "refused", ends, np.full(2, edge), width=1.0)
        unmarked(panels, "tolerance of the filter")
        unmarked(panels, "expected", dash="6px,3px")
    else:
        absent.append("a place, for the World Magnetic Model")
    figure = panels.figure()
    figure["title"] = "Magnetic field"
    figure["reading"] = _field_words(c)
    return figure


def _field_words(c: Context) -> str:
    facts = _facts(c, "magnetometer")
    strength, dip, model = facts.get("strength"), facts.get("dip"), facts.get("model")
    if strength is None:
        return ""
    out = f"Strength {number(strength['median'])} µT in the median"
    out += f", dip {number(DEG * dip['median'])}°" if dip else ""
    if model:
        out += f"; expected {number(model['strength'])} µT and {number(DEG * model['dip'])}° ({model['source']})"
    out += ". The dip leans on the estimated attitude. " if dip else ". "
    load = facts.get("load")
    if load:
        word = {"current": ("battery current", "A"), "throttle": ("throttle", "")}[load["load"]]
        scale, unit = (100.0, " %") if load["load"] == "throttle" else (1.0, f" {word[1]}")
        sure = abs(load["change"]) > 3.0 * load["sd"]
        digits = max(0, 1 - math.floor(math.log10(max(load["sd"], 1e-3))))
        size = f"{abs(load['change']):.{digits}f} ± {load['sd']:.{digits}f} µT"
        span = f"from {scale * load['low']:.0f} to {scale * load['high']:.0f}{unit} of {word[0]}"
        how = "stronger" if load["change"] > 0.0 else "weaker"
        out += f"The field becomes {size} {how} {span}." if sure else f"No change with the motors is certain: {size} {how} {span}."
    else:
        out += "Whether the motors disturb it cannot be told: no current or throttle that varies is in the log."
    return out


def _gnss(c: Context, absent: list[str]) -> Figure | None:
    """Accuracies, satellites and kind of fix, as the receiver states them."""
    gnss = c.flight.get("gnss")
    if gnss is None or len(gnss) < 2:
        absent.append("GNSS")
        return None
    rows: list[tuple[str, list[tuple[str, str, str]], str]] = []
    for title, columns, unit in (
        ("acc. [m]", [("h_acc", "horizontal", "solid"), ("v_acc", "vertical", "dash")], "m"),
        ("speed [m/s]", [("s_acc", "speed", "solid")], "m/s"),
        ("sats [1]", [("num_sats", "satellites", "solid")], ""),
        ("fix [1]", [("fix_type", "fix type", "solid")], ""),
    ):
        there = [col for col in columns if np.isfinite(gnss.get(col[0])).any()]
        if there:
            rows.append((title, there, unit))
    if not rows:
        absent.append("the receiver's accuracies")
        return None
    panels = _panels(c, "gnss_quality", [r[0] for r in rows], 84)
    for k, (_, columns, unit) in enumerate(rows):
        for name, label, dash in columns:
            values = gnss.get(name)
            colour = "gnss" if dash == "solid" else "assumed"
            # Some receivers state hundreds of metres before the first fix: they must not flatten the rest.
            panels.line(k, label, colour, gnss.t, values, unit=unit, resolution=1e-2, width=1.3)
        every = np.concatenate([gnss.get(n)[np.isfinite(gnss.get(n))] for n, _, _ in columns])
        if columns[0][0].endswith("acc"):
            panels.extent[k] = (0.0, min(float(every.max()), 4.0 * float(np.median(every)) + 1.0))
    figure = panels.figure()
    figure["title"] = "GNSS by its own account"
    facts = _facts(c, "gnss")
    parts = [
        f"{word} {number(facts[k]['median'], 2)} (worst {number(facts[k]['worst'], 2)}) {unit}"
        for k, word, unit in (("h_acc", "horizontal", "m"), ("v_acc", "vertical", "m"), ("s_acc", "speed", "m/s"))
        if k in facts
    ]
    sats = facts.get("num_sats")
    lost = facts.get("no_fix")
    figure["reading"] = " ".join(
        s for s in (
            f"Stated 1σ, median: {', '.join(parts)}." if parts else "The receiver states no accuracies.",
            f"{sats['median']:.0f} satellites in the median, {sats['least']:.0f} at least." if sats else "",
            f"No 3-D fix in {100.0 * lost:.1f} % of the samples." if lost else "",
        ) if s
    )  # fmt: skip
    return figure


def _temperature(c: Context) -> Figure | None:
    """Barometer: temperature over time, and its noise in words."""
    barometer = c.flight.get("barometer")
    facts = _facts(c, "barometer")
    if barometer is None or not facts:
        return None
    noise, given = facts.get("noise"), c.solution.config.number("noise.barometer")
    words = ""
    if noise is not None:
        words = f"White noise of its altitude {number(noise, 2)} m against {number(given, 2)} m assumed for noise, wind and prop wash. "
    if "temperature" not in facts:
        return None
    panels = _panels(c, "barometer_temperature", ["temperature [°C]"], 84)
    panels.line(0, "barometer", "barometer", barometer.t, barometer.get("temperature"), unit="°C", resolution=1e-2, width=1.3)
    figure = panels.figure()
    figure["title"] = "Barometer"
    t = facts["temperature"]
    figure["reading"] = f"{words}The sensor is at {number(t['low'])} to {number(t['high'])} °C; altitude drifts as it warms or cools."
    return figure


def _units(c: Context, absent: list[str]) -> Figure | None:
    """Further inertial and magnetic units less the first."""
    rows: list[tuple[str, str, float, FloatArray, FloatArray]] = []
    for stream in c.flight:
        kind = base_name(stream)
        if kind == stream or kind not in ("imu", "magnetometer"):
            continue
        number_ = stream.rpartition(".")[2]
        columns = [("mag", f"mag {number_} [µT]", 1.0)] if kind == "magnetometer" else [
            ("gyro", f"gyro {number_} [deg/s]", DEG), ("accel", f"accel. {number_} [m/s²]", 1.0)
        ]  # fmt: skip
        for stem, title, factor in columns:
            found = differences(c.flight, stream, stem)
            if found is not None and len(found[0]) > 1:
                rows.append((title, "", factor, *found))
    if not rows:
        absent.append("a second IMU or magnetometer to compare with, for long enough")
        return None
    panels = _panels(c, "units", [r[0] for r in rows])
    for k, (title, _, factor, t, delta) in enumerate(rows):
        unit = title[title.index("[") + 1 : -1]
        for axis in range(3):
            panels.line(k, "xyz"[axis], BODY[axis], t, factor * delta[:, axis], unit=unit, resolution=1e-3, width=1.2)
    figure = panels.figure()
    figure["title"] = "Further units less the first, means of 5 s"
    said = []
    for stream in c.flight:
        facts = _facts(c, stream)
        parts = [
            f"{word} {number(f * facts[k]['worst'], 2)} {unit}"
            for k, word, f, unit in (
                ("gyro_difference", "gyro", DEG, "deg/s"), ("accel_difference", "accelerometer", 1.0, "m/s²"),
                ("mag_difference", "field", 1.0, "µT"),
            )
            if k in facts
        ]  # fmt: skip
        if parts:
            said.append(f"{stream}: {', '.join(parts)}")
    figure["reading"] = (
        f"Largest differences of {count(len(said), 'further unit')}: {'; '.join(said)}. A constant difference is a bias or the mounting; "
        "one that grows with motion is vibration, scale or a fault. The estimator uses the first units only."
    )
    return figure
