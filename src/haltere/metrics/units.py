"""Inertial units of one vehicle against each other: when the difference of an axis steps or drifts, and which unit is the bad one.

Two units alone tell that one is bad and not which. Three tell by majority; of two, each is asked what the other sensors make of it
(`haltere.drive` runs the filter on the other unit, too). It runs no filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from haltere.flight.log import FlightLog, Stream
from haltere.flight.schema import base_name
from haltere.metrics.magnetism import clean

__all__ = ["Apart", "agreement", "better", "events", "part", "stations"]

FloatArray = NDArray[np.float64]

#: Blocks that are compared [s], the windows looked at in blocks, blocks of the past that tell what is usual, the guard between, the least.
BLOCK, WINDOWS, PAST, GUARD, LEAST = 0.2, (1, 2, 5, 10, 20, 50), 150, 5, 25
#: A difference beyond so many sigma, and at least this much [rad/s, m/s^2], is no usual one.
SIGMAS, SMALLEST = 7.0, (math.radians(0.5), 0.15)
#: Blocks after a detection that help to tell the onset.
SETTLES = 10
#: Units differ in scale and alignment by about this part of what they measure, sit so far apart [m], and shift by this part of what they
#: vibrate against each other more than before (rectification).
SCALE, ARM, SHAKEN = 0.01, 0.03, 0.25
#: The innovations of one run must be so much less likely (twice the log) than of the other to name its unit.
MARGIN = 30.0
#: Units that begin to differ within so long of each other [s] differ for one reason.
TOGETHER = 3.0
#: A third unit that changed by less than this part of a difference agrees, by more than twice as much differs too.
THIRD = 1.0 / 3.0
#: When the other sensors are asked, after a difference was seen [s].
ASKED = (0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
#: Streams slower than this [Hz] are not compared.
SLOWEST = 8.0
AXES = tuple((sensor, axis) for sensor in ("gyro", "accel") for axis in "xyz")


@dataclass
class Apart:
    """An axis in which two units begin to differ.

    Attributes
    ----------
    first, other
        Streams, as ``imu`` and ``imu.1``.
    axis
        0 to 5: gyro x, y, z, accelerometer x, y, z.
    onset, detected
        Times [s].
    size, sd
        Change of first less other with its 1 sigma [rad/s, m/s^2].
    statistic
        Size over 1 sigma when it was detected.
    """

    first: str
    other: str
    axis: int
    onset: float
    detected: float
    size: float
    sd: float
    statistic: float

    @property
    def name(self) -> str:
        """Sensor and axis, as ``gyro.x``."""
        return ".".join(AXES[self.axis])


@dataclass
class _Blocks:
    """Differences of two units over blocks: middle (k,) [s]; mean, white noise and share of motion, 1 sigma, of each (k, 6)."""

    t: FloatArray
    d: FloatArray
    noise: FloatArray
    motion: FloatArray


def stations(flight: FlightLog) -> list[str]:
    """Names of the streams of inertial units that are fast enough to be compared, the first one first."""
    names = [name for name in flight if base_name(name) == "imu"]
    return [n for n in names if len(flight[n]) > 1 and (len(flight[n]) - 1) / max(flight[n].t[-1] - flight[n].t[0], 1e-9) > SLOWEST]


def _usual(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Running median and robust 1 sigma of the past (k,) of each block, NaN where there is too little of it."""
    k = len(x)
    padded = np.concatenate([np.full(PAST + GUARD, np.nan), x])[: k + PAST]
    window = sliding_window_view(padded, PAST)[:k]
    enough = np.isfinite(window).sum(axis=1) >= LEAST
    level, sd = np.full(k, np.nan), np.full(k, np.nan)
    level[enough] = np.nanmedian(window[enough], axis=1)
    sd[enough] = 1.4826 * np.nanmedian(np.abs(window[enough] - level[enough, None]), axis=1)
    return level, sd


def _blocks(a: Stream, b: Stream) -> _Blocks | None:
    ta, xa = clean(a.t, np.column_stack([a.vector("gyro"), a.vector("accel")]))
    tb, xb = clean(b.t, np.column_stack([b.vector("gyro"), b.vector("accel")]))
    if len(ta) < 20 or len(tb) < 20:
        return None
    start, end = max(ta[0], tb[0]), min(ta[-1], tb[-1])
    slow, fast = ((ta, xa), (tb, xb)) if len(ta) <= len(tb) else ((tb, xb), (ta, xa))
    keep = (slow[0] >= start) & (slow[0] <= end)
    t, x = slow[0][keep], slow[1][keep]
    if len(t) < 20:
        return None
    other = np.column_stack([np.interp(t, fast[0], c) for c in fast[1].T])
    sign = 1.0 if len(ta) <= len(tb) else -1.0
    number = np.floor((t - start) / BLOCK).astype(np.int64)
    n = np.bincount(number)
    there = np.flatnonzero(n > 0)

    def mean(values: FloatArray) -> FloatArray:
        return np.column_stack([np.bincount(number, weights=c)[there] / n[there] for c in values.T])

    if len(there) < 2:
        return None
    at, w = start + BLOCK * (there + 0.5), mean(x[:, :3])
    rate, turning = np.linalg.norm(w, axis=1), np.abs(np.gradient(w, at, axis=0)).max(axis=1)
    force = SCALE * np.abs(np.linalg.norm(mean(x[:, 3:]), axis=1) - 9.8) + ARM * (rate**2 + turning)
    rough = mean(np.gradient(x - other, axis=0) ** 2) ** 0.5  # of neighbours: a step in the block is not roughness
    usual = np.column_stack([_usual(c)[0] for c in rough.T])
    shaken = SHAKEN * np.abs(rough - np.where(np.isfinite(usual), usual, rough))
    motion = np.hypot(np.column_stack([SCALE * rate] * 3 + [force] * 3), shaken)
    return _Blocks(at, sign * mean(x - other), rough / np.sqrt(n[there])[:, None], motion)


def part(flight: FlightLog, first: str, other: str) -> list[Apart]:
    """When two units begin to differ by more than they usually do, by axis.

    The mean difference over windows of 0.2 to 10 s is set against the median of the 30 s before and the spread of such means there, motion
    added: scale errors of 1 %, an arm of 3 cm, a part of the vibration. The level and spread are robust, and of the past only.

    Parameters
    ----------
    flight
        With both streams in the same axes.
    """
    b = _blocks(flight[first], flight[other])
    if b is None:
        return []
    out = []
    for axis in range(6):
        change, sd = (np.full((len(WINDOWS), len(b.t)), np.nan) for _ in range(2))
        for i, m in enumerate(WINDOWS):
            if len(b.t) >= m + LEAST:
                change[i], sd[i] = _changes(b, axis, m)
        z = np.nan_to_num(np.where(np.abs(change) > SMALLEST[axis // 3], np.abs(change) / sd, 0.0))
        over = np.flatnonzero(z.max(axis=0) > SIGMAS)
        if len(over):
            k = int(over[0])
            i = int(np.argmax(z[:, k]))
            onset = _split(b, axis, max(k - PAST, 0), k + 1, min(k + SETTLES, len(b.t)))
            out.append(Apart(first, other, axis, onset, float(b.t[k] + 0.5 * BLOCK), float(change[i, k]), float(sd[i, k]), float(z[i, k])))
    return out


def _split(b: _Blocks, axis: int, start: int, last: int, end: int) -> float:
    """When the difference stepped: the split of the blocks start ... end - 1, at ``last`` - 1 at the latest, that leaves least [s]."""
    d, w = b.d[start:end, axis], 1.0 / (b.noise[start:end, axis] ** 2 + b.motion[start:end, axis] ** 2 + 1e-18)
    sums, weights, squares = np.cumsum(w * d), np.cumsum(w), np.cumsum(w * d * d)
    left = squares[-1] - sums[:-1] ** 2 / weights[:-1] - (sums[-1] - sums[:-1]) ** 2 / (weights[-1] - weights[:-1])
    return float(b.t[start + int(np.argmin(left[: last - start - 1])) + 1] - 0.5 * BLOCK)


def _changes(b: _Blocks, axis: int, m: int) -> tuple[FloatArray, FloatArray]:
    """Mean difference over the ``m`` blocks that end with each block, less what was usual before them, and its 1 sigma (k,)."""
    means = np.full(len(b.t), np.nan)
    motion, noise = np.zeros(len(b.t)), np.zeros(len(b.t))
    means[m - 1 :] = sliding_window_view(b.d[:, axis], m).mean(axis=1)
    motion[m - 1 :] = sliding_window_view(b.motion[:, axis], m).mean(axis=1)
    noise[m - 1 :] = sliding_window_view(b.noise[:, axis], m).mean(axis=1) / math.sqrt(m)
    level, sd = _usual(means)
    floor = _usual(b.d[:, axis])[1] / math.sqrt(m)
    # what is usual may not hold the window itself: the past of a window ends before it begins
    level, sd, floor = (np.concatenate([np.full(m, np.nan), v[:-m]]) for v in (level, sd, floor))
    white = np.maximum(np.maximum(sd, floor), noise)
    return means - level, np.sqrt(white**2 + motion**2 + (0.1 * SMALLEST[axis // 3]) ** 2)


def agreement(flight: FlightLog, other: str, axis: int, onset: float, until: float) -> tuple[float, float] | None:
    """How much the first unit's axis changed against another unit's from before an onset to after it, and its 1 sigma.

    None where there is not enough on both sides.
    """
    b = _blocks(flight["imu"], flight[other])
    if b is None:
        return None
    before = (b.t < onset - 0.5) & (b.t > onset - 20.0)
    after = (b.t > onset) & (b.t < until)
    if before.sum() < 10 or after.sum() < 1:
        return None
    d = b.d[:, axis]
    spread = 1.4826 * float(np.median(np.abs(d[before] - np.median(d[before]))))
    sd = math.sqrt(spread**2 * (1.0 / after.sum() + 1.0 / before.sum()) + float(np.mean(b.motion[after, axis])) ** 2)
    return float(np.mean(d[after]) - np.median(d[before])), sd


def better(aids: dict[str, Any], others: dict[str, Any], onset: float, until: float) -> float:
    """By how much the innovations of one run are likelier than those of another from an onset on, twice the log likelihood.

    Of what both fused or refused: GNSS, barometer, magnetometer. A single innovation says at most 50.
    """

    def cost(a: dict[str, Any]) -> float:
        mine = (a["t"] >= onset) & (a["t"] <= until) & np.isin(a["sensor"], ("gnss", "barometer", "magnetometer"))
        y, sd = a["innovation"][mine], a["innovation_sd"][mine]
        good = np.isfinite(y) & (sd > 0.0)
        return float(np.sum(np.minimum((y[good] / sd[good]) ** 2, 50.0) + 2.0 * np.log(sd[good])))

    return cost(others) - cost(aids)


#: By how much the run on the first unit is likelier than that on another, from an onset until a time; None where the other cannot be run.
Likelier = Callable[[str, float, float], "float | None"]


def events(flight: FlightLog, likelier: Likelier, told: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Events of units that begin to differ, with the bad one named where that can be told.

    Parameters
    ----------
    flight
        With further inertial units, as ``imu.1``.
    likelier
        Asked of two units that differ, see `better`.
    told
        Events of the run on the first unit. What is found about the same axis is added to their evidence, and is no event of its own.
    """
    names = stations(flight)
    if len(names) < 2 or names[0] != "imu":
        return []
    out = []
    for found in _first_of_each(flight, names):
        same = next((e for e in told if (e["sensor"], e["axis"]) == AXES[found.axis] and abs(e["t_onset"] - found.onset) < 5.0), None)
        if same is not None and same["t_isolated"] is not None:
            same["evidence"] += f"; {found.other} differs from it by {_size(found)} since {found.onset:.1f} s"
            continue
        out.append(_event(found, *_bad(flight, names, found, likelier)))
    for e in told:
        _beside(flight, names, e)
    return out


def _beside(flight: FlightLog, names: list[str], e: dict[str, Any]) -> None:
    """What further units say of an axis that was named without them: whether they saw it change."""
    axis = next((k for k, who in enumerate(AXES) if who == (e["sensor"], e["axis"])), -1)
    if axis < 0 or e["t_isolated"] is None or "differs from it" in e["evidence"]:
        return
    k, unit = (math.degrees(1.0), "deg/s") if axis < 3 else (1.0, "m/s²")
    for other in names[1:]:
        near = agreement(flight, other, axis, e["t_onset"], max(e["t_isolated"], e["t_onset"] + 1.0))
        if near is not None:
            e["evidence"] += f"; beside {other} it changed by {k * near[0]:+.2g} ± {k * near[1]:.1g} {unit}"


def _first_of_each(flight: FlightLog, names: list[str]) -> list[Apart]:
    """Differences of the first unit to others, and of others where it agrees with one of them; of each sensor the earliest."""
    found: dict[tuple[str, str, str], Apart] = {}
    for other in names[1:]:
        for a in part(flight, "imu", other):
            key = ("imu", other, AXES[a.axis][0])
            if key not in found or a.detected < found[key].detected:
                found[key] = a
    kept: list[Apart] = []
    for a in sorted(found.values(), key=lambda x: x.detected):  # a bad first unit differs from all others: it is told once
        if not any(AXES[a.axis][0] == AXES[k.axis][0] and abs(a.detected - k.detected) < TOGETHER for k in kept):
            kept.append(a)
    return kept


def _bad(flight: FlightLog, names: list[str], a: Apart, likelier: Likelier) -> tuple[list[str], float, str]:
    """Streams that may be the bad one, when that was known [s], and why."""
    thirds = [n for n in names[1:] if n != a.other]
    for third in thirds:
        near = agreement(flight, third, a.axis, a.onset, a.detected + 1.0)
        if near is None:
            continue
        change, sd = near
        if abs(change) < THIRD * abs(a.size) and sd < abs(a.size) / 6.0:
            return [a.other], a.detected + 1.0, f"imu and {third} agree"
        if abs(change) > 2.0 * THIRD * abs(a.size) and sd < abs(a.size) / 6.0:
            return ["imu"], a.detected + 1.0, f"it differs from {a.other} and {third} alike"
    for late in ASKED:
        gain = likelier(a.other, a.onset, a.detected + late)
        if gain is not None and abs(gain) > MARGIN:
            bad, good = (a.other, "imu") if gain > 0.0 else ("imu", a.other)
            why = f"GNSS, barometer and compass agree better with {good} (log likelihood ratio {0.5 * abs(gain):.0f} after {late:g} s)"
            return [bad], a.detected + late, why
    return ["imu", a.other], math.nan, "neither is told to be the bad one by the other sensors"


def _size(a: Apart) -> str:
    k, unit = (math.degrees(1.0), "deg/s") if a.axis < 3 else (1.0, "m/s²")
    return f"{k * a.size:+.3g} ± {k * a.sd:.2g} {unit}"


def _event(a: Apart, bad: list[str], known: float, why: str) -> dict[str, Any]:
    sensor, axis = AXES[a.axis]
    who = [a.name if stream == "imu" else f"{stream}.{a.name}" for stream in bad]
    return {
        "sensor": sensor, "axis": axis, "kind": "bias", "t_onset": a.onset, "t_detected": a.detected,
        "t_isolated": known if math.isfinite(known) else None, "t_recovered": None, "candidates": who, "statistic": a.statistic,
        "threshold": SIGMAS, "evidence": f"imu less {a.other} changes by {_size(a)}; {why}",
    }  # fmt: skip
