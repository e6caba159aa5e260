"""Facts about the sensors themselves: sampling, spectra, clipping, frozen values, field, accuracies. It judges no innovations.

Limits beyond which a fact becomes a finding are those in use by the autopilots' own people; each says where it is from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import FlightLog, Stream
from haltere.flight.schema import base_name
from haltere.flight.solution import Solution
from haltere.metrics.magnetism import clean, field_load, field_series, vectors
from haltere.metrics.spectra import floor, peaks, px4_vibration, spectrum

__all__ = [
    "FINDINGS", "Clipping", "clipping", "differences", "findings", "flying", "repeats", "rotor_band", "sampling", "sensor_table",
    "white_noise",
]  # fmt: skip

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

G, DEG = 9.80665, math.pi / 180.0
#: Full scales that IMUs are sold with: accelerometers [m/s²], gyros [rad/s].
SCALES = {
    "accel": tuple(g * G for g in (2.0, 4.0, 8.0, 16.0, 32.0)),
    "gyro": tuple(d * DEG for d in (250.0, 500.0, 1000.0, 2000.0, 4000.0)),
}

AXES = tuple(f"{stem}_{a}" for stem in ("gyro", "accel") for a in "xyz")

#: What becomes a finding, and above which value.
#: px4_vibration: flight_review colours PX4's accel_vibration_metric red from 9.81 m/s² on (orange from 4.905).
#: vibration: ArduPilot, "Measuring Vibration": below 30 m/s² normally acceptable, above 60 nearly always trouble.
#: clips: the same page: "low numbers (<100) are likely ok"; it counts at the sensor's own rate, about ten for one logged sample.
#: clipped_samples: that hundred in logged samples. gyro_clipped_samples: an attitude is lost with the first few.
#: frozen: seconds in which an axis of the IMU, or all three of a magnetometer, never change, our own: noise changes the last digit
#: many times in that.
#: field: share of samples outside the tolerance within which our own filter accepts them.
#: field_load: ArduPilot, compassmot: interference below 30 % of the field is acceptable.
#: h_acc, v_acc, s_acc: loosest limits of PX4's and ArduPilot's checks before GNSS is used (5 m, 8 m, 1 m/s); num_sats: fewer than 6.
#: accel_difference: ArduPilot's LogAnalyzer, IMUMatch fails at 1.5 m/s² over 5 s; gyro_difference: PX4's selector, 7 deg/s.
FINDINGS: dict[str, float] = {
    "px4_vibration": 9.81,
    "vibration": 30.0,
    "clips": 100.0,
    "clipped_samples": 10.0,
    "gyro_clipped_samples": 3.0,
    "frozen": 1.0,
    "field": 0.1,
    "field_load": 0.3,
    "h_acc": 5.0,
    "v_acc": 8.0,
    "s_acc": 1.0,
    "num_sats": 6.0,
    "accel_difference": 1.5,
    "gyro_difference": 7.0 * DEG,
}


# --- sampling ------------------------------------------------------------------------------------------------------------


def sampling(t: FloatArray) -> dict[str, float | None]:
    """Mean rate [Hz], longest interval [s] and its start [s], and jitter: the share of intervals off by more than half the median.

    Times may be unsorted; values are None below three finite times.
    """
    t = np.sort(t[np.isfinite(t)])
    if len(t) < 3 or t[-1] <= t[0]:
        return {"mean_rate": None, "longest_gap": None, "longest_gap_at": None, "irregular": None}
    dt = np.diff(t)
    i = int(np.argmax(dt))
    middle = float(np.median(dt))
    return {
        "mean_rate": float((len(t) - 1) / (t[-1] - t[0])), "longest_gap": float(dt[i]), "longest_gap_at": float(t[i]),
        "irregular": float(np.mean(np.abs(dt - middle) > 0.5 * middle)),
    }  # fmt: skip


def _blocks(t: FloatArray, x: FloatArray, width: float, start: float) -> tuple[FloatArray, FloatArray, NDArray[np.intp], FloatArray]:
    """Means of x (n, k) over the blocks of ``width`` seconds from ``start`` that hold samples.

    Returns the means, the samples of each, the row of the block that each sample is in, and the blocks' numbers. Blocks without samples are
    left out: one damaged time can put years between two samples.
    """
    number, row = np.unique(np.floor((t - start) / width), return_inverse=True)
    n = np.bincount(row, minlength=len(number)).astype(np.float64)
    sums = np.column_stack([np.bincount(row, column, len(number)) for column in x.T])
    return sums / n[:, None], n, row, number


@np.errstate(over="ignore")  # samples near the end of the range are damaged ones, and move
def flying(flight: FlightLog, *, gyro: float = 0.02, accel: float = 0.3) -> tuple[FloatArray, Mask, Mask]:
    """Times of the IMU, and which are of the vehicle in motion and at rest: the nearest thing to "in flight" that every log tells.

    A second is at rest where the standard deviations of the rates and of the specific force's size stay below ``gyro`` [rad/s] and
    ``accel`` [m/s²] (the filter's own limits). Motion while disarmed is neither, in a log in which the vehicle is armed at all.
    """
    imu = flight["imu"]
    x = np.column_stack([imu.vector("gyro"), np.linalg.norm(imu.vector("accel"), axis=1)])
    t, x = clean(imu.t, x)
    if len(t) < 8:
        return t, np.zeros(len(t), bool), np.zeros(len(t), bool)
    mean, n, row, _ = _blocks(t, x, 1.0, float(t[0]))
    var, *_ = _blocks(t, (x - mean[row]) ** 2, 1.0, float(t[0]))
    moves = (np.nan_to_num(var) > np.r_[np.full(3, gyro**2), accel**2]).any(axis=1) & (n > 2)
    still = np.asarray(~moves[row])
    moving = ~still
    modes = flight.get("modes")
    if modes is not None and np.any(modes.get("armed") == 1.0):
        row = np.searchsorted(modes.t, t, side="right") - 1
        moving &= (row < 0) | (modes.get("armed")[np.maximum(row, 0)] != 0.0)
    return t, moving, still


def rotor_band(flight: FlightLog) -> tuple[float, float] | None:
    """Range of turning rates of the rotors [Hz] while they turn: 5th to 95th percentile over all; None without speeds."""
    rotors = flight.get("rotors")
    names = [] if rotors is None else [n for n in rotors.names if n.startswith("speed_")]
    if rotors is None or not names:
        return None
    speed = np.concatenate([rotors[n] for n in names])
    speed = speed[np.isfinite(speed)]
    turning = speed[speed > 0.3 * float(np.max(speed, initial=0.0))]
    if len(turning) < 20 or float(np.max(turning)) <= 0.0:
        return None
    low, high = np.percentile(turning, [5.0, 95.0]) / (2.0 * math.pi)
    return float(low), float(high)


# --- clipping and frozen values ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Clipping:
    """Samples of one axis at the end of its range: how many, how it is known, times [s] of some, and the limit where it was seen."""

    sensor: str
    axis: str
    n: int
    how: str
    times: FloatArray
    limit: float | None = None


def _runs(hit: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First row of each run of True and the row after its last."""
    edge = np.diff(np.r_[False, hit, False].astype(np.int8))
    return np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)


def _at_limit(x: FloatArray, scales: tuple[float, ...]) -> tuple[Mask, float] | None:
    """Rows of a column at the end of its range, and that end; None where its extremes are those of an ordinary signal.

    An extreme counts that is fifty steps of the resolution or more, comes back exactly, lasts for two samples at least once, and is
    entered and left by steps of more than a hundredth of it, which a smooth maximum is not. At a full scale that sensors are sold
    with (5 % for calibration) three samples are enough. Elsewhere, or where samples are logged several times, it takes ten in three
    stretches, and more of them than there are in the tenth of the range before it.
    """
    values = np.unique(x)
    if len(values) < 50:
        return None
    quantum = float(np.min(np.diff(values)))
    held = float(np.mean(x[1:] == x[:-1])) > 0.2
    out = np.zeros(len(x), bool)
    limit = 0.0
    for value, side in ((float(values[-1]), 1.0), (float(values[0]), -1.0)):
        size = side * value
        if size < 50.0 * quantum:
            continue
        hit = np.abs(x - value) <= 1e-6 * size
        n = int(np.count_nonzero(hit))
        if n < 3:
            continue
        first, after = _runs(hit)
        flanks = np.r_[x[first[first > 0] - 1], x[after[after < len(x)]]]
        if len(flanks) == 0 or int(np.max(after - first)) < 2 or float(np.median(np.abs(flanks - value))) <= 0.01 * size:
            continue
        sold = any(0.95 <= size / scale <= 1.05 for scale in scales)
        crowded = n > np.count_nonzero((side * x >= 0.9 * size) & ~hit)
        if (sold and not held) or (n >= 10 and len(first) >= 3 and crowded):
            out |= hit
            limit = max(limit, size)
    return (out, limit) if out.any() else None


def clipping(flight: FlightLog, stream: str = "imu") -> list[Clipping]:
    """Clipping of an IMU by axis: as the autopilot logged it, else as the samples show it.

    Columns ``accel_clipping`` and ``gyro_clipping`` (bits 1, 2, 4 an axis) go before the counter ``clip`` of the stream vibration,
    which has no axes, and that before what the samples themselves show.
    """
    imu = flight.get(stream)
    if imu is None or len(imu) == 0:
        return []
    out: list[Clipping] = []
    for sensor in ("gyro", "accel"):
        bits = imu.get(f"{sensor}_clipping")
        known = np.isfinite(bits)
        if known.any():
            value = np.where(known, bits, 0.0).astype(np.int64)
            for k, a in enumerate("xyz"):
                hit = (value >> k) & 1 == 1
                if hit.any():
                    out.append(Clipping(sensor, a, int(hit.sum()), "logged", imu.t[hit]))
            continue
        counter = _counter(flight, stream) if sensor == "accel" else None
        if counter is not None:
            if counter[0]:
                out.append(Clipping(sensor, "", counter[0], "counted", counter[1]))
            continue
        for a in "xyz":
            x = imu.get(f"{sensor}_{a}")
            good = np.isfinite(x)
            found = _at_limit(x[good], SCALES[sensor])
            if found is not None:
                out.append(Clipping(sensor, a, int(found[0].sum()), "seen", imu.t[good][found[0]], found[1]))
    return out


def _counter(flight: FlightLog, stream: str) -> tuple[int, FloatArray] | None:
    """Clips counted by the autopilot for an IMU over the log, and the times at which the counter stood higher than before."""
    vibration = flight.get("vibration" + stream.removeprefix("imu"))
    if vibration is None:
        return None
    clip = vibration.get("clip")
    good = np.isfinite(clip)
    if np.count_nonzero(good) < 2:
        return None
    rise = np.diff(clip[good])
    return int(np.sum(rise[rise > 0.0])), vibration.t[good][1:][rise > 0.0]


def repeats(t: FloatArray, x: FloatArray) -> tuple[float, float, float]:
    """Longest stretch [s] in which x never changes, its start [s], and the share of samples equal to the one before.

    ``x`` is (n,), or (n, k) of which all must stay the same.
    """
    x = x.reshape(len(t), -1)
    good = np.isfinite(x).all(axis=1) & np.isfinite(t)
    t, x = t[good], x[good]
    if len(x) < 2:
        return 0.0, float("nan"), 0.0
    same = (x[1:] == x[:-1]).all(axis=1)
    first, after = _runs(same)
    if len(first) == 0:
        return 0.0, float(t[0]), 0.0
    length = t[after] - t[first]
    i = int(np.argmax(length))
    return float(length[i]), float(t[first[i]]), float(np.mean(same))


def white_noise(x: FloatArray) -> float:
    """Standard deviation of the white part of a slowly varying column, from its second differences; NaN below ten samples.

    Second differences of white noise of standard deviation s have √6 s. Those beyond five times their spread, judged by their
    median, are left out: steps, spikes and lost samples are no noise.
    """
    x = x[np.isfinite(x)]
    if len(x) < 10:
        return float("nan")
    second = np.abs(np.diff(x, 2))
    spread = float(np.median(second)) / 0.67449
    usual = second[second <= 5.0 * spread] if spread > 0.0 else second
    return float(np.sqrt(np.mean(usual**2) / 6.0))


# --- further units -------------------------------------------------------------------------------------------------------


def differences(flight: FlightLog, stream: str, stem: str, width: float = 5.0) -> tuple[FloatArray, FloatArray] | None:
    """A further unit less the first over time, in means of ``width`` seconds where both have samples.

    Parameters
    ----------
    stream
        The further unit, as ``imu.1``.
    stem
        ``gyro``, ``accel`` or ``mag``.

    Returns
    -------
    t : (n,)
        Middles of the blocks [s].
    difference : (n, 3)
        In the stream's unit. None where there is no block in common.
    """
    first, other = flight.get(base_name(stream)), flight.get(stream)
    if first is None or other is None:
        return None
    (ta, a), (tb, b) = (clean(s.t, s.vector(stem)) for s in (first, other))
    if len(ta) < 2 or len(tb) < 2:
        return None
    start, end = max(ta[0], tb[0]), min(ta[-1], tb[-1])
    (ta, a), (tb, b) = ((t[(t >= start) & (t <= end)], x[(t >= start) & (t <= end)]) for t, x in ((ta, a), (tb, b)))
    if len(ta) < 2 or len(tb) < 2:
        return None
    # Blocks count only the slower unit's times: a fast unit is interpolated to them, so that both means are of the same moments.
    t, fast_t, fast, slow, sign = (tb, ta, a, b, 1.0) if len(tb) <= len(ta) else (ta, tb, b, a, -1.0)
    delta = sign * (slow - np.column_stack([np.interp(t, fast_t, c) for c in fast.T]))
    mean, n, _, number = _blocks(t, delta, width, start)
    good = n >= 3
    if not good.any():
        return None
    return start + width * (number[good] + 0.5), mean[good]


# --- everything together -------------------------------------------------------------------------------------------------


def _span(values: FloatArray) -> dict[str, float]:
    return {"median": float(np.median(values)), "worst": float(np.max(values))}


def sensor_table(solution: Solution, flight: FlightLog) -> dict[str, dict[str, Any]]:
    """Facts about each sensor for ``summary.json``, by stream; only what the log tells."""
    out: dict[str, dict[str, Any]] = {}
    for name, stream in flight.streams.items():
        if len(stream) == 0:
            continue
        kind = base_name(name)
        facts: dict[str, Any] = {}
        if kind == "imu":
            facts = _imu_facts(flight, name)
        elif kind == "magnetometer":
            facts = _magnetometer_facts(solution, flight, name)
        elif kind == "gnss":
            facts = _gnss_facts(stream)
        elif kind == "barometer":
            facts = _barometer_facts(stream)
        if facts:
            out[name] = facts
    return out


def _unchanged(stream: Stream, columns: dict[str, FloatArray]) -> dict[str, dict[str, float]]:
    """Longest stretch without a change, for each that has one."""
    out = {}
    for name, x in columns.items():
        seconds, at, share = repeats(stream.t, x)
        if seconds > 0.0:
            out[name] = {"seconds": seconds, "at": at, "share": share}
    return out


def _imu_facts(flight: FlightLog, name: str) -> dict[str, Any]:
    imu = flight[name]
    facts: dict[str, Any] = {"clipping": {}, "unchanged": _unchanged(imu, {n: imu.get(n) for n in AXES})}
    sizes = {n: np.abs(imu.get(n)) for n in AXES}
    facts["largest"] = {n: float(np.nanmax(x)) for n, x in sizes.items() if np.isfinite(x).any()}
    for c in clipping(flight, name):
        facts["clipping"][f"{c.sensor}_{c.axis}" if c.axis else c.sensor] = {
            "n": c.n, "how": c.how, "first": float(c.times[0]) if len(c.times) else None,
            "last": float(c.times[-1]) if len(c.times) else None, "limit": c.limit,
        }  # fmt: skip
    vibration = flight.get("vibration" + name.removeprefix("imu"))
    if vibration is not None and "vibe_x" in vibration:
        levels = vibration.vector("vibe")
        levels = levels[np.isfinite(levels).all(axis=1)]
        if len(levels):
            worst = levels.max(axis=1)
            facts["vibration"] = {"median": float(np.median(worst)), "p95": float(np.percentile(worst, 95.0)), "worst": float(worst.max())}
    if name != "imu":
        for stem in ("gyro", "accel"):
            found = differences(flight, name, stem)
            if found is not None:
                size = np.linalg.norm(found[1], axis=1)
                facts[f"{stem}_difference"] = _span(size) | {"at": float(found[0][np.argmax(size)])}
        return facts
    t, moving, still = flying(flight)
    facts["moving"] = float(np.mean(moving)) if len(t) else 0.0
    for stem in ("gyro", "accel"):
        at, x = clean(imu.t, imu.vector(stem))
        keep = np.isin(at, t[moving])
        for label, rows in (("moving", keep), ("rest", np.isin(at, t[still]))):
            s = spectrum(at, x, rows) if rows.any() else None
            if s is None:
                continue
            facts[f"{stem}_{label}"] = {"floor": float(np.sqrt(np.mean(floor(s) ** 2))), "seconds": s.seconds, "rate": s.rate}
            if label == "moving":
                facts[f"{stem}_{label}"]["peaks"] = [
                    {"frequency": p.frequency, "amplitude": p.amplitude, "axis": "xyz"[p.axis]} for p in peaks(s)
                ]
        if stem == "accel":
            metric = px4_vibration(at, x)
            if metric is not None:
                shown = metric[keep] if keep.any() else metric
                facts["px4_vibration"] = {"median": float(np.median(shown)), "p95": float(np.percentile(shown, 95.0))}
    rotors = rotor_band(flight)
    if rotors is not None:
        facts["rotors_hz"] = list(rotors)
    return facts


def _magnetometer_facts(solution: Solution, flight: FlightLog, name: str) -> dict[str, Any]:
    mag = flight[name]
    # A coarse magnetometer at rest repeats itself on one axis; all three together for long it does not.
    facts: dict[str, Any] = {"unchanged": _unchanged(mag, {"mag": vectors(mag)})}
    series = field_series(solution, flight, name)
    if series is not None:
        low, middle, high = np.percentile(series.strength, [5.0, 50.0, 95.0])
        facts["strength"] = {"p5": float(low), "median": float(middle), "p95": float(high)}
        dip = series.dip[np.isfinite(series.dip)]
        if len(dip):
            facts["dip"] = {"p5": float(np.percentile(dip, 5.0)), "median": float(np.median(dip)), "p95": float(np.percentile(dip, 95.0))}
        if series.expected is not None and series.outside is not None:
            facts["model"] = {"strength": series.expected[0], "dip": series.expected[1], "source": series.source}
            facts["outside"] = {"strength": series.outside[0], "dip": series.outside[1]}
    load = field_load(flight, name)
    if load is not None:
        facts["load"] = load
    if name != "magnetometer":
        found = differences(flight, name, "mag")
        if found is not None:
            size = np.linalg.norm(found[1], axis=1)
            facts["mag_difference"] = _span(size) | {"at": float(found[0][np.argmax(size)])}
    return facts


def _gnss_facts(stream: Stream) -> dict[str, Any]:
    fix = stream.get("fix_type")
    good = (fix >= 3.0) | np.isnan(fix)
    facts: dict[str, Any] = {"no_fix": float(np.mean(~good))} if np.isfinite(fix).any() else {}
    for name in ("h_acc", "v_acc", "s_acc"):
        values = stream.get(name)[good]
        values = values[np.isfinite(values)]
        if len(values):
            facts[name] = _span(values)
    sats = stream.get("num_sats")[good]
    sats = sats[np.isfinite(sats)]
    if len(sats):
        facts["num_sats"] = {"median": float(np.median(sats)), "least": float(np.min(sats))}
    return facts


def _barometer_facts(stream: Stream) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    altitude = stream.get("altitude")
    if not np.isfinite(altitude).any():
        # Standard atmosphere near the ground: 8.43 km times the relative change of pressure.
        p = stream.get("pressure")
        usable = p[np.isfinite(p) & (p > 0.0)]
        altitude = -8430.0 * np.log(usable / np.median(usable)) if len(usable) else usable
    noise = white_noise(altitude)
    if math.isfinite(noise):
        facts["noise"] = noise
    temperature = stream.get("temperature")
    temperature = temperature[np.isfinite(temperature)]
    if np.any(temperature != 0.0):  # simulators write zero throughout
        facts["temperature"] = {"first": float(temperature[0]), "low": float(temperature.min()), "high": float(temperature.max())}
    return facts


def findings(table: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """What in `sensor_table` a reader should know first: ``{"stream", "what", "value", "limit"}``, with ``what`` a key of `FINDINGS`."""
    out: list[dict[str, Any]] = []

    def check(stream: str, what: str, value: float | None, below: bool = False, **more: Any) -> None:
        limit = FINDINGS[what]
        if value is not None and (value < limit if below else value > limit):
            out.append({"stream": stream, "what": what, "value": value, "limit": limit, **more})

    for name, facts in table.items():
        kind = base_name(name)
        first = name == kind
        if kind == "imu":
            _imu_findings(name, facts, check)
        elif kind == "magnetometer" and first:
            outside = facts.get("outside", {})
            check(name, "field", max(outside.values(), default=0.0), strength=outside.get("strength"), dip=outside.get("dip"))
            load, strength = facts.get("load"), facts.get("strength")
            if load is not None and strength is not None and abs(load["change"]) > 3.0 * load["sd"]:
                check(name, "field_load", abs(load["change"]) / strength["median"], load=load["load"], change=load["change"])
        elif kind == "gnss" and first:
            for what in ("h_acc", "v_acc", "s_acc"):
                check(name, what, facts.get(what, {}).get("median"))
            check(name, "num_sats", facts.get("num_sats", {}).get("median"), below=True)
        if first:
            still = facts.get("unchanged", {})
            axis = max(still, key=lambda a: still[a]["seconds"], default=None)
            if axis is not None and kind in ("imu", "magnetometer"):
                check(name, "frozen", still[axis]["seconds"], axis=axis, at=still[axis]["at"])
    return out


def _imu_findings(name: str, facts: dict[str, Any], check: Any) -> None:
    for sensor in ("gyro", "accel"):
        rows = [c for key, c in facts["clipping"].items() if key.startswith(sensor)]
        if rows and name == "imu":
            counted = rows[0]["how"] == "counted"
            what = "gyro_clipped_samples" if sensor == "gyro" else "clips" if counted else "clipped_samples"
            times = {"first": min(c["first"] for c in rows), "last": max(c["last"] for c in rows)}
            check(name, what, float(sum(c["n"] for c in rows)), **times)
        if f"{sensor}_difference" in facts:
            worst = facts[f"{sensor}_difference"]
            check(name, f"{sensor}_difference", worst["worst"], at=worst["at"])
    if "vibration" in facts:
        check(name, "vibration", facts["vibration"]["p95"])
    elif "px4_vibration" in facts:
        check(name, "px4_vibration", facts["px4_vibration"]["p95"])
