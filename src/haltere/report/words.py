"""The verdict in words and the facts of the flight, from the summary and the solution. It judges nothing that the run has not judged."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from haltere.flight.log import FlightLog
from haltere.flight.schema import base_name
from haltere.flight.solution import Solution
from haltere.metrics.disturbance import disturbances
from haltere.report.context import Context, Episode, sensor_label
from haltere.report.series import Pool

__all__ = [
    "Verdict", "count", "diagnosis_in_words", "discarded", "facts", "fixed", "nis_in_words", "number", "verdict",
    "verdict_of", "whiteness_in_words", "wind_in_words",
]  # fmt: skip

#: Share of a stream's samples above which a discard is worth a word in the verdict.
WORTH_TELLING = 0.01

#: Sixteenths of the compass from north.
SIXTEENTHS = ("N", "NNE", "NE", "ENE", "E", "ESE", "SE", "SSE", "S", "SSW", "SW", "WSW", "W", "WNW", "NW", "NNW")


@dataclass
class Verdict:
    """One level, one headline, and sentences under it: what happened, how good it is, what to do."""

    level: str
    headline: str
    sentences: list[str] = field(default_factory=list)


def number(value: float | None, digits: int = 3) -> str:
    """A number for reading, with a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    shown = f"{value:.{digits}g}"
    return f"{float(shown):.0f}" if "e" in shown else shown


def fixed(value: float) -> str:
    """A number for a sentence: two digits below one, one decimal above."""
    return f"{value:#.2g}" if 1e-3 <= abs(value) < 0.995 else f"{value:.1f}" if abs(value) < 1e4 else f"{value:.1e}"


def count(n: int, thing: str, things: str | None = None) -> str:
    """``1 sample``, ``28 samples``, ``12,345 samples``."""
    return f"{n:,} {thing if n == 1 else things or thing + 's'}"


def discarded(summary: dict[str, Any]) -> list[tuple[str, str, int, int]]:
    """Stream, reason, number and size of the stream, for everything left out."""
    return [
        (stream, reason, int(n), int(facts["n"]))
        for stream, facts in summary.get("streams", {}).items()
        for reason, n in facts.get("discarded", {}).items()
        if n
    ]


def verdict_of(solution: Solution, flight: FlightLog) -> Verdict:
    """The verdict on a solution, for those who draw nothing."""
    return verdict(Context(solution, flight, Pool(1)))


def verdict(c: Context) -> Verdict:
    """What a reader wants to know first."""
    summary, solution = c.solution.summary, c.solution
    health = summary.get("health", {})
    levels = {"good": 0, "doubtful": 1, "bad": 2}
    by_level = {word: [s for s, h in health.items() if h.get("verdict") == word] for word in levels}
    broken = [e for e in solution.events if e["kind"] == "diverged"]
    lost = [d for d in discarded(summary) if d[2] > 0.05 * max(d[3], 1) and d[1] not in ("before alignment", "no 3-D fix")]
    drifting = "pos_n" in solution and not c.held_by_measurement
    torn = [e for e in solution.events if e["kind"] == "gap" and (e.get("statistic") or 0.0) > 1.0]
    found = summary.get("findings", [])
    ill = list(dict.fromkeys(_unit_label(f) for f in found if base_name(f["stream"]) == f["stream"]))  # further units are not used
    compass = disturbances(solution.events)
    alone = compass and by_level["bad"] == ["magnetometer"] and not by_level["doubtful"] and compass[0]["t_onset"] > solution.t[0] + 2.0
    failed = _named_faults(solution.events)
    driven = [e for e in solution.events if e["sensor"] == "rotors" and e.get("candidates")]
    doubtful = by_level["doubtful"] or lost or drifting or torn or ill or alone or failed
    worst = 2 if (by_level["bad"] and not alone) or broken else 1 if doubtful else 0
    if broken:
        headline = f"The filter broke down {count(len(broken), 'time')}: read what follows with that in mind."
    elif failed:
        headline = _failed(failed)
    elif driven:
        whose = " or ".join(driven[0]["candidates"])
        headline = f"The vehicle did not do what its rotors should make it do, first at t = {driven[0]['t_onset']:.1f} s: {whose}."
    elif alone:
        times = f" {len(compass)} times" if len(compass) > 1 else ""
        headline = f"The compass was disturbed{times}, first at t = {compass[0]['t_onset']:.1f} s; the heading was held without it."
    elif by_level["bad"] or by_level["doubtful"]:
        named = [sensor_label(s) for s in (*by_level["bad"], *by_level["doubtful"])]
        headline = f"Not all sensors fit: {_list(named)} {'disagree' if len(named) > 1 else 'disagrees'} with the rest."
    elif drifting:
        headline = "Rely on attitude only: no GNSS position was let in, so velocity and position are held by assumptions."
    elif torn:
        seconds = sum(float(e["statistic"]) for e in torn)
        headline = f"The sensors agree, but the solution is interrupted: {seconds:.0f} s are without IMU samples."
    elif ill:
        agree = "The sensors agree with each other, but" if len(by_level["good"]) > 1 else "Mind that"
        headline = f"{agree} the {_list(ill)} {'are' if len(ill) > 1 else 'is'} not in good health."
    elif worst:
        headline = "The sensors agree, but a good part of the data could not be used."
    elif len(by_level["good"]) > 1:
        headline = f"The sensors agree with each other: {_list([sensor_label(s) for s in by_level['good']])}."
    elif by_level["good"]:
        headline = f"The {sensor_label(by_level['good'][0])} agrees with the inertial sensors."
    else:
        headline = "Nothing but the inertial sensors was used, so nothing confirms the solution."
        worst = 1
    out = Verdict(("good", "doubtful", "bad")[worst], headline)
    out.sentences += [_coverage(c), *_health(by_level, health), *(_finding_in_words(f) for f in found)]
    if diagnosis_in_words(summary):
        out.sentences.append(f"D{diagnosis_in_words(summary)[1:]}.")
    out.sentences += [*_what_happened(c), *_quality(c), *_left_out(summary)]
    return out


#: What a force or moment is called that a vehicle's model does not have.
_OF_THE_MODEL = {
    "hx": "a force along body x", "hy": "a force along body y", "t": "a force along the thrust axis",
    "r": "a rolling moment", "p": "a pitching moment", "q": "a yawing moment",
}  # fmt: skip


#: What a vehicle is said to do whose motion is not that of its rotors.
_DRIVEN = "motion that is not what the rotors should make"


def _named_faults(events: list[dict[str, Any]]) -> list[tuple[float, str]]:
    """Onset [s] and name of every part that was found to fail, in order of time: a part that failed before is not said again.

    A compass that was disturbed, and motion that is not the rotors', are among them where a part failed, too: alone they have headlines of
    their own.
    """
    found: dict[str, float] = {}
    compass = disturbances(events)
    for e in sorted((e for e in events if e["t_onset"] is not None), key=lambda e: float(e["t_onset"])):
        sensor, axis = e["sensor"], str(e.get("axis") or "")
        if sensor in ("gyro", "accel", "gnss", "barometer") and e["t_isolated"] is not None:
            name = f"{'accelerometer' if sensor == 'accel' else sensor_label(sensor)} {_AXES.get(axis, axis)}".strip()
            unit = (e.get("candidates") or [""])[0].split(".")
            if len(unit) == 4:  # of a further IMU, which was not used
                name += f" of {unit[0]}.{unit[1]}"
        elif sensor == "rotors" and e["kind"] == "thrust" and e["t_isolated"] is not None:
            name = f"rotor {axis} or its tachometer"
        elif sensor == "model" and e["t_isolated"] is not None:
            name = f"{_OF_THE_MODEL[axis]} that the vehicle's model lacks"
        elif sensor == "rotors" and not axis and e.get("candidates"):
            name = _DRIVEN
        elif sensor == "magnetometer" and e in compass:
            name = "compass"
        else:
            continue
        found.setdefault(name, float(e["t_onset"]))
    return [(t, name) for name, t in found.items()] if set(found) - {"compass", _DRIVEN} else []


def _failed(found: list[tuple[float, str]]) -> str:
    """The headline for parts that failed."""
    inertial = [name for _, name in found if name.startswith(("gyro", "accelerometer")) and " of " not in name]
    healed = f"; {'its effect was' if len(inertial) == 1 else 'their effects were'} taken back as far as it is known" if inertial else ""
    if len(inertial) == len(found):
        return f"An inertial sensor failed: {_list(inertial)}, first at t = {found[0][0]:.1f} s{healed}."
    if inertial:
        healed = f"; what {_list(inertial)} did was taken back as far as it is known"
    parts = [f"{name}, from t = {t:.1f} s" for t, name in found]
    return f"{'A fault was' if len(parts) == 1 else f'{len(parts)} faults were'} found: {'; '.join(parts)}{healed}."


def _list(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _coverage(c: Context) -> str:
    how = next((e.get("evidence") or "aligned" for e in c.solution.events if e["kind"] == "aligned"), "it began from a given state")
    t = c.solution.t
    return (
        f"{c.solution.config.estimator} ran from t = {t[0]:.2f} s to {t[-1]:.2f} s ({count(len(t), 'row')}): {how}"
        f"{f' at t = {t[0]:.2f} s' if how.startswith('initial') else ''}."
    )


def _health(by_level: dict[str, list[str]], health: dict[str, Any]) -> list[str]:
    return [
        f"{sensor_label(s)[:1].upper()}{sensor_label(s)[1:]} {word}: {health[s].get('why', '')}."
        for word in ("bad", "doubtful")
        for s in by_level[word]
    ]


def diagnosis_in_words(summary: dict[str, Any]) -> str:
    """What was watched for failing axes of the IMU, and for how long; empty where nobody asked."""
    said = summary.get("diagnosis", {})
    if said.get("inertial") != "on":
        return ""
    found = f"named {_list(said['named'])}" if said["named"] else "none named"
    if said["judged_s"] < 1.0:
        return (
            "diagnosis of gyro and accelerometer axes: on, but only dead or stepping axes could be seen: the others need GNSS, a known "
            f"attitude, flight and more than 20 samples a second; {found}"
        )
    return f"diagnosis of gyro and accelerometer axes: on, during {said['judged_s']:.0f} of {said['of_s']:.0f} s; {found}"


def _unit_label(finding: dict[str, Any]) -> str:
    """What a reader calls the sensor of a finding."""
    stream, what = finding["stream"], finding["what"]
    if base_name(stream) == "imu":
        named = "gyro" if what.startswith("gyro") or str(finding.get("axis", "")).startswith("gyro") else "accelerometer"
        return named if stream == "imu" else f"{named} of {stream}"
    return sensor_label(stream)


def _span_of(finding: dict[str, Any]) -> str:
    first, last = finding.get("first"), finding.get("last")
    if first is None or last is None:
        return ""
    return f" at t = {first:.1f} s" if last - first < 0.05 else f" between t = {first:.1f} and {last:.1f} s"


def _finding_in_words(f: dict[str, Any]) -> str:
    """One finding about a sensor as a sentence; the limits are those of `haltere.metrics.sensors.FINDINGS`."""
    what, value, unit = f["what"], float(f["value"]), _unit_label(f)
    start = f"{unit[:1].upper()}{unit[1:]}"
    if what in ("vibration", "px4_vibration"):
        whose = "ArduPilot's measure (up to 30 is acceptable)" if what == "vibration" else "PX4's measure (above 9.81 is too high)"
        return f"Vibration is high: {fixed(value)} m/s² by {whose} in a twentieth of the time. It can clip the {unit}, or fold into it."
    if what in ("clips", "clipped_samples", "gyro_clipped_samples"):
        return f"{start}: {count(round(value), 'sample')} at the end of its range{_span_of(f)}; what lies beyond was not measured."
    if what == "frozen":
        axis = f" {str(f['axis'])[-1]}" if str(f["axis"])[-2:-1] == "_" else ""
        return f"{start}{axis} did not change for {value:.1f} s from t = {f['at']:.1f} s: frozen, or no sample was taken."
    if what == "field":
        parts = [f"{k} in {100.0 * f[k]:.0f} %" for k in ("strength", "dip") if (f.get(k) or 0.0) > f["limit"]]
        return f"The magnetic field is far from what is expected here: {' and '.join(parts)} of the samples beyond the filter's tolerance."
    if what == "field_load":
        return f"The magnetic field follows the {f['load']}: {f['change']:+.1f} µT over its range, {100.0 * value:.0f} % of the field."
    if what == "num_sats":
        return f"GNSS used few satellites: {value:.0f} in the median."
    if what in _ACCURACIES:
        word, accuracy_unit = _ACCURACIES[what]
        return f"GNSS accuracy is poor: {word} {fixed(value)} {accuracy_unit} in the median, by the receiver's own account."
    shown = f"{math.degrees(value):.1f} deg/s" if what == "gyro_difference" else f"{value:.1f} m/s²"
    return f"{start} differs from the first one by up to {shown} (t = {f['at']:.0f} s); only the first was used."


_ACCURACIES = {"h_acc": ("horizontal", "m"), "v_acc": ("vertical", "m"), "s_acc": ("speed", "m/s")}


def episode_in_words(e: Episode) -> str:
    """One stretch of refusals as a sentence without its full stop."""
    word = "refused" if e.status == "rejected" else "de-weighted"
    what = sensor_label(e.sensor) if e.what == e.sensor or e.sensor.startswith(("zero", "fake")) else f"{sensor_label(e.sensor)} {e.what}"
    why = "" if e.reasons in ((), ("innovation",)) else f" ({', '.join(e.reasons)})"
    if e.n == 1:
        return f"{what} {word} once at t = {e.start:.1f} s{why}"
    return f"{what} {word} {e.n} times from t = {e.start:.1f} to {e.end:.1f} s{why}"


def _what_happened(c: Context) -> list[str]:
    out = []
    noted = [e for e in c.solution.events if e["kind"] != "aligned" and not str(e.get("evidence")).startswith("first measurement")]
    for event in noted[:4]:
        when = event.get("t_onset") if event.get("t_onset") is not None else event.get("t_detected")
        at = f"At t = {when:.1f} s" if when is not None else "At some time"
        out.append(f"{at}: {sensor_label(event['sensor'])} {event['kind']}{', ' + event['evidence'] if event.get('evidence') else ''}.")
    if len(noted) > 4:
        out.append(f"{count(len(noted) - 4, 'further event')} in the table below.")
    sensors = [e for e in c.episodes if not e.sensor.startswith(("zero", "fake"))]
    largest = sorted(sorted((e for e in sensors if e.n > 2), key=lambda e: -e.n)[:3], key=lambda e: e.start)
    for e in largest:
        words = episode_in_words(e)
        out.append(f"{words[:1].upper()}{words[1:]}.")
    rest = sum(e.n for e in sensors) - sum(e.n for e in largest)
    if rest:
        out.append(f"{count(rest, 'further measurement' if largest else 'measurement')} refused or de-weighted, listed below.")
    i = int(np.argmax(c.tilt))
    if c.tilt[i] > 60.0:
        first = int(np.argmax(c.tilt > 60.0))
        out.append(f"The tilt passed 60° at t = {c.solution.t[first]:.1f} s and reached {c.tilt[i]:.0f}° at t = {c.solution.t[i]:.1f} s.")
    return out


#: Quantities by stem of their columns: word and unit.
_VECTORS = (("vel", "velocity", "m/s"), ("pos", "position", "m"))
_AXES = {"n": "north", "e": "east", "d": "down"}


def _in_words(angles: dict[str, float], vectors: dict[str, float]) -> str:
    """Angles [deg] by name, and components by column, as one phrase."""
    parts = [", ".join(f"{name} {fixed(v)}°" for name, v in angles.items())] if angles else []
    for stem, word, unit in _VECTORS:
        axes = {a: vectors[f"{stem}_{a}"] for a in _AXES if f"{stem}_{a}" in vectors}
        if len(axes) == 3:
            parts.append(f"{word} {' / '.join(fixed(v) for v in axes.values())} {unit} (north / east / down)")
        elif axes:
            parts.append(f"{word} {', '.join(f'{_AXES[a]} {fixed(v)}' for a, v in axes.items())} {unit}")
    return "; ".join(parts)


def _quality(c: Context) -> list[str]:
    out = []
    for name, rows in c.solution.summary.get("errors", {}).items():
        angles = {k: rows[f"{k}_deg"]["rms"] for k in ("roll", "pitch", "yaw") if f"{k}_deg" in rows}
        words = _in_words(angles, {k: row["rms"] for k, row in rows.items()})
        if words:
            what = "RMS error against truth" if name == "truth" else f"RMS difference from the {name} solution (another estimate, no truth)"
            out.append(f"{what}: {words}.")
    sd = {k[3:]: float(np.median(v)) for k, v in c.solution.table.items() if k.startswith("sd_")}
    words = _in_words({k: math.degrees(sd[k]) for k in ("roll", "pitch", "yaw") if k in sd}, sd)
    return [*out, f"Stated 1σ, median over the flight: {words}."] if words else out


def _left_out(summary: dict[str, Any]) -> list[str]:
    lost = discarded(summary)
    if not lost:
        return ["No sample was discarded."]
    large = [d for d in lost if d[2] > WORTH_TELLING * max(d[3], 1)]
    told = "; ".join(
        f"{count(n, 'sample')} of {stream} ({reason}, {100.0 * n / max(size, 1):.0f} % of it)" for stream, reason, n, size in large[:4]
    )
    rest = sum(n for _, _, n, _ in lost) - sum(d[2] for d in large[:4])
    if not told:
        return [f"{count(rest, 'sample')} discarded, less than one in a hundred of any stream; the table below says why."]
    others = f"; and {count(rest, 'other')}" if rest else ""
    return [f"Discarded: {told}{others}."]


def nis_in_words(sensor: str, mean: float | None, band: list[float]) -> str:
    """What the mean of the normalised innovations says of a sensor's noise."""
    if sensor.startswith(("zero", "fake")):
        return "an assumption, not a measurement: may be small"
    if mean is None:
        return "none was used"
    if mean > band[1]:
        return "innovations larger than stated: noise set too low, or the sensor disturbed" if mean > 1.5 else "slightly larger than stated"
    if mean < band[0]:
        return "innovations smaller than stated: noise set high, which is cautious" if mean < 0.67 else "slightly smaller than stated"
    return "as stated"


def whiteness_in_words(components: dict[str, dict[str, Any]]) -> str:
    """What the whiteness of a sensor's components says of the filter or the sensor."""
    ill = {k: w for k, w in components.items() if w["verdict"] == "correlated"}
    if not ill:
        small = any(w["verdict"] == "nearly white" for w in components.values())
        return "white but for a trace" if small else "white, as it should be"
    longest = max(ill.values(), key=lambda w: w["lasting"])
    if all(w["lag1"] < -w["limit1"] for w in ill.values()):
        return "alternating: the filter follows the sensor's noise, its noise is set too low"
    if longest["lag1"] > 0.5:
        return f"lasting up to {fixed(longest['lasting'])} s: the sensor's errors last, or its noise is set too high"
    return "weakly correlated: not all of the motion or the sensor's errors is modelled"


def wind_in_words(said: dict[str, Any]) -> str:
    """Mean wind of the table ``wind`` of a summary: speed and where it comes from, with 1 sigma."""
    mean = said.get("mean")
    if mean is None or mean["speed"] is None:
        return ""
    speed = f"{fixed(mean['speed'])}" + (f" ± {fixed(mean['sd_speed'])}" if mean["sd_speed"] is not None else "") + " m/s"
    if mean["sd_from_deg"] is None:
        return f"{speed}, direction not known"
    corner = SIXTEENTHS[round(mean["from_deg"] / 22.5) % 16]
    return f"{speed} from {mean['from_deg']:.0f}° ± {math.ceil(mean['sd_from_deg'])}° ({corner})"


def facts(c: Context) -> list[tuple[str, str]]:
    """The flight in a few lines: name and value."""
    solution, flight, summary = c.solution, c.flight, c.solution.summary
    meta = flight.meta
    out: list[tuple[str, str]] = []

    def add(name: str, value: str | None) -> None:
        if value:
            out.append((name, value))

    add("source", meta.source)
    add("start (UTC)", meta.start_utc)
    if meta.time_offset:
        add("log clock", f"t + {meta.time_offset:.6f} s")
    if "imu" in flight:
        imu = flight["imu"]
        add("duration", f"{c.span[1] - c.span[0]:.1f} s, IMU at {imu.rate:.0f} Hz, {count(len(imu), 'sample')}")
    add("sensors used", ", ".join(sensor_label(s) for s in c.sensors if not s.startswith(("zero", "fake"))) or "IMU only")
    add("compared with", " and ".join(name for name, _ in c.references) or "nothing: no truth, no onboard solution in the log")
    if c.origin:
        add("origin", f"{c.origin[0]:.7f}°, {c.origin[1]:.7f}°, {c.origin[2]:.1f} m above mean sea level")
    i = int(np.argmax(c.tilt))
    add("largest tilt", f"{c.tilt[i]:.1f}° at t = {solution.t[i]:.1f} s")
    if "vel_n" in solution and c.held_by_measurement:
        ground = np.hypot(solution["vel_n"], solution["vel_e"])
        k = int(np.argmax(ground))
        add("fastest", f"{ground[k]:.1f} m/s over ground at t = {solution.t[k]:.1f} s")
        way = float(np.sum(0.5 * (ground[1:] + ground[:-1]) * np.minimum(np.diff(solution.t), 1.0)))
        low, high = -float(solution["pos_d"].max()), -float(solution["pos_d"].min())
        add("track", f"{way:.0f} m long; height {low:z.1f} to {high:z.1f} m from the origin")
    if summary.get("wind"):
        add("wind", ": ".join(w for w in (wind_in_words(summary["wind"]), summary["wind"]["verdict"]) if w))
    for fault in meta.faults:
        add("injected fault", ", ".join(f"{k} {v}" for k, v in fault.items()))
    timings = summary.get("timings", {})
    if timings.get("filter_s"):
        add("computed in", f"{timings['filter_s']:.2f} s, haltere {summary.get('haltere', '')}")
    return out
