"""Wind of a solution in numbers: speed, direction, rose, profile over height, means, turbulence, differences. It estimates none."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution
from haltere.metrics.sensors import flying

__all__ = [
    "BLOCK", "SECTORS", "Block", "Difference", "Profile", "Rose", "WindSeries", "blocks", "components", "difference", "direction_from",
    "direction_sd", "in_flight", "profile", "rose", "speed_sd", "turbulence", "wind_series",
]  # fmt: skip

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]
TURN = 2.0 * math.pi
#: Sectors of a rose, the first about north; means are taken over so many seconds.
SECTORS, BLOCK = 16, 30.0
#: Bounds between classes of speed [m/s] are multiples of one of these, at most so many.
STEPS, CLASSES = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0), 6
#: Widths of bins of height [m], and shortest time [s] in one that counts.
HEIGHTS, BIN_TIME = (2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0), 5.0
#: Range of heights [m] below which there is no profile: height itself is not known better than a metre or two.
RANGE = 5.0
#: Bins, ratio of the highest to the lowest, and lowest height [m], from which a law over height is fitted.
FIT_BINS, FIT_RATIO, FIT_LOWEST = 4, 3.0, 1.0
#: A wind is settled where its 1 sigma is at most so many times the median of the second half of the flight.
SETTLED = 2.0
#: Below this mean speed [m/s] a turbulence intensity is a division by next to nothing.
SLOWEST = 1.0


def direction_from(north: FloatArray, east: FloatArray) -> FloatArray:
    """Azimuth [rad], 0 to 2 pi, that a wind comes from whose velocity towards north and east is given [m/s]."""
    angle = np.arctan2(-east, -north)
    return np.asarray(np.where(angle < 0.0, angle + TURN, angle))


def speed_sd(north: FloatArray, east: FloatArray, sd_n: FloatArray, sd_e: FloatArray) -> FloatArray:
    """1 sigma [m/s] of the horizontal speed, first order, errors of north and east independent.

    Where the wind is weaker than its own uncertainty the speed is no longer linear in it: there the larger of the two is given.
    """
    along, _ = _turned(north, east, sd_n, sd_e)
    weak = np.hypot(north, east) < np.hypot(sd_n, sd_e)
    return np.asarray(np.where(weak, np.maximum(sd_n, sd_e), along))


def direction_sd(north: FloatArray, east: FloatArray, sd_n: FloatArray, sd_e: FloatArray) -> FloatArray:
    """1 sigma [rad] of the direction, first order; NaN where it is unknown: where the wind is weaker than its 1 sigma across."""
    _, across = _turned(north, east, sd_n, sd_e)
    speed = np.hypot(north, east)
    known = speed > across
    return np.asarray(np.where(known, across / np.where(known, speed, 1.0), np.nan))


def _turned(north: FloatArray, east: FloatArray, sd_n: FloatArray, sd_e: FloatArray) -> tuple[FloatArray, FloatArray]:
    """1 sigma along and across the wind [m/s]; of no wind, those along north and east."""
    speed = np.hypot(north, east)
    some = speed > 0.0
    c, s = np.where(some, north, 1.0) / np.where(some, speed, 1.0), np.where(some, east, 0.0) / np.where(some, speed, 1.0)
    return np.sqrt((c * sd_n) ** 2 + (s * sd_e) ** 2), np.sqrt((s * sd_n) ** 2 + (c * sd_e) ** 2)


def components(table: Solution | Stream) -> str:
    """Axes of the wind that a table has: ``ned``, ``ne`` or nothing."""
    axes = "".join(a for a in "ned" if f"wind_{a}" in table)
    return axes if axes.startswith("ne") else ""


@dataclass(frozen=True)
class WindSeries:
    """Wind over time.

    Attributes
    ----------
    t
        Times [s] (n,).
    wind
        North and east [m/s], where it blows to, (n, 2).
    sd
        1 sigma of both [m/s]; NaN where it is not stated.
    speed, speed_sd
        Horizontal speed and its 1 sigma [m/s].
    direction, direction_sd
        Azimuth it comes from and its 1 sigma [rad]; NaN where it is not known, the wind being weaker than its own uncertainty.
    flying
        Rows in flight.
    settled
        Rows whose stated 1 sigma is at most `SETTLED` times that of the second half of the flight: before, it is the prior that is seen.
    height
        Above the origin [m], up; NaN where there is no position.
    """

    t: FloatArray
    wind: FloatArray
    sd: FloatArray
    speed: FloatArray
    speed_sd: FloatArray
    direction: FloatArray
    direction_sd: FloatArray
    flying: Mask
    settled: Mask
    height: FloatArray

    @property
    def weight(self) -> FloatArray:
        """Seconds that each row in flight and settled stands for, others none; a gap counts as a usual interval."""
        use = self.flying & self.settled & np.isfinite(self.speed)
        if len(self.t) < 2:
            return use.astype(np.float64)
        dt = np.diff(self.t, append=self.t[-1])
        dt[-1] = dt[-2]
        usual = float(np.median(dt))
        return np.where(use, np.where(dt > 5.0 * usual, usual, dt), 0.0)


def wind_series(solution: Solution, flight: FlightLog) -> WindSeries | None:
    """Wind of a solution with what is derived from it; None where it has none."""
    if not components(solution):
        return None
    n, e = solution["wind_n"], solution["wind_e"]
    stated = "sd_wind_n" in solution and "sd_wind_e" in solution
    sd_n, sd_e = (solution[f"sd_wind_{a}"] if stated else np.full(len(n), np.nan) for a in "ne")
    known = direction_sd(n, e, sd_n, sd_e)
    direction = direction_from(n, e)
    height = -solution["pos_d"] if "pos_d" in solution else np.full(len(n), np.nan)
    up, sd = in_flight(solution.t, flight), np.sqrt(0.5 * (sd_n**2 + sd_e**2))
    late = sd[up][np.count_nonzero(up) // 2 :]
    settled = sd <= SETTLED * float(np.median(late)) if stated and len(late) else np.ones(len(n), bool)
    return WindSeries(
        solution.t, np.column_stack([n, e]), np.column_stack([sd_n, sd_e]), np.hypot(n, e), speed_sd(n, e, sd_n, sd_e),
        np.where(np.isfinite(known) | ~np.isfinite(sd_n), direction, np.nan), known, up, settled, height,
    )  # fmt: skip


def in_flight(t: FloatArray, flight: FlightLog) -> Mask:
    """Which times are between the first and the last motion of a stretch in which the vehicle is armed (of the log, where none says so).

    Rest in between is taken for calm hovering. Where rotor speeds are known, the rotors have to turn as well.
    """
    out = np.zeros(len(t), bool)
    if "imu" not in flight or len(flight["imu"]) == 0:
        return out
    at, moving, _ = flying(flight)
    modes = flight.get("modes")
    edges = [-math.inf, math.inf]
    if modes is not None and np.any(modes.get("armed") == 1.0):
        edges = [-math.inf, *(float(x) for x in modes.t[1:][np.diff(modes.get("armed") == 1.0)]), math.inf]
    for start, end in itertools.pairwise(edges):
        mine = at[moving & (at >= start) & (at < end)]
        if len(mine):
            out |= (t >= mine[0]) & (t <= mine[-1])
    rotors = flight.get("rotors")
    names = [] if rotors is None else [n for n in rotors.names if n.startswith("speed_")]
    if rotors is not None and names:
        speed = np.nanmax(np.nan_to_num(np.column_stack([rotors[n] for n in names])), axis=1)
        usual = np.percentile(speed, 90.0)
        if usual > 0.0 and len(speed) > 1:
            out &= np.interp(t, rotors.t, (speed > 0.3 * usual).astype(np.float64)) > 0.5
    return out


@dataclass(frozen=True)
class Rose:
    """Share of the time in flight by sector it comes from (`SECTORS`, clockwise from north) and class of speed; and without direction.

    ``share`` is (SECTORS, classes) and sums with ``calm`` to one; ``bounds`` [m/s] are the lower bounds of the classes, the last open.
    """

    bounds: FloatArray
    share: FloatArray
    calm: float


def rose(w: WindSeries) -> Rose | None:
    """The rose of the rows that count (`WindSeries.weight`), by time; None without any."""
    weight = w.weight
    total = float(weight.sum())
    if total <= 0.0:
        return None
    speed, use = w.speed, weight > 0.0
    high = float(np.percentile(speed[use], 98.0))
    step = next((s for s in STEPS if high / s <= CLASSES), max(STEPS[-1], math.ceil(high / CLASSES)))
    bounds = step * np.arange(max(1, min(CLASSES, math.ceil(high / step))), dtype=np.float64)
    known = use & np.isfinite(w.direction)
    sector = np.rint(w.direction[known] / TURN * SECTORS).astype(np.intp) % SECTORS
    kind = np.searchsorted(bounds, speed[known], side="right") - 1
    share = np.bincount(sector * len(bounds) + kind, weight[known], SECTORS * len(bounds)).reshape(SECTORS, len(bounds)) / total
    return Rose(bounds, share, float(weight[use & ~known].sum()) / total)


@dataclass(frozen=True)
class Profile:
    """Wind by height: mean ``height`` above the origin [m], ``wind`` (n, 2), ``speed``, ``spread`` ``sd`` [m/s], ``seconds`` of each bin.

    ``spread`` is the standard deviation of the speed in a bin; ``sd`` the mean of what the filter states of it, which does not shrink with
    time, since its errors are nearly the same all the time. ``law`` is the law that fits better, if there was enough to fit one:
    ``{"kind": "power", "exponent", "sd", "rms"}`` or ``{"kind": "log", "roughness", "friction", "sd", "rms"}``.
    """

    height: FloatArray
    wind: FloatArray
    speed: FloatArray
    spread: FloatArray
    sd: FloatArray
    seconds: FloatArray
    law: dict[str, Any] | None


def profile(w: WindSeries) -> Profile | None:
    """Wind by bins of height above the origin over the rows that count; None without two of them."""
    weight = w.weight
    use = (weight > 0.0) & np.isfinite(w.height)
    if not use.any():
        return None
    low, high = np.percentile(w.height[use], [0.5, 99.5])
    width = next((h for h in HEIGHTS if (high - low) / h <= 10.0), HEIGHTS[-1])
    row = np.floor(w.height[use] / width).astype(np.intp)
    first = int(row.min())
    n = int(row.max()) - first + 1

    def mean(values: FloatArray) -> FloatArray:
        total = np.bincount(row - first, weight[use] * values, n)
        return np.asarray(total / np.where(seconds > 0.0, seconds, 1.0))

    seconds = np.bincount(row - first, weight[use], n).astype(np.float64)
    wind = np.column_stack([mean(w.wind[use, k]) for k in range(2)])
    speed = mean(w.speed[use])
    spread = np.sqrt(np.maximum(mean(w.speed[use] ** 2) - speed**2, 0.0))
    middle = mean(w.height[use])
    keep = seconds >= BIN_TIME
    if np.count_nonzero(keep) < 2 or np.ptp(middle[keep]) < RANGE:
        return None
    level = np.exp(mean(np.log(np.maximum(w.height[use], 0.1))))  # of the logarithm, in which the laws are straight
    parts = (middle, wind, speed, spread, mean(w.speed_sd[use]), seconds, level)
    height, wind, speed, spread, sd, seconds, level = (np.asarray(p[keep], np.float64) for p in parts)
    return Profile(height, wind, speed, spread, sd, seconds, _law(level, speed, seconds))


def _law(height: FloatArray, speed: FloatArray, seconds: FloatArray) -> dict[str, Any] | None:
    """Power law s = a h^p or logarithmic law s = b ln(h/z0) over height, whichever leaves less; None where heights do not suffice."""
    use = (height >= FIT_LOWEST) & (speed > 0.1)
    h, s, weight = height[use], speed[use], np.sqrt(np.minimum(seconds[use], BLOCK))
    if len(h) < FIT_BINS or h.max() < FIT_RATIO * h.min():
        return None
    laws: list[dict[str, Any]] = []
    a, b, sd = _line(np.log(h), np.log(s), weight)
    laws.append({"kind": "power", "exponent": b, "sd": sd, "rms": _rms(s - np.exp(a + b * np.log(h)), weight)})
    a, b, sd = _line(np.log(h), s, weight)
    if b > 0.0:
        left = s - a - b * np.log(h)
        laws.append({"kind": "log", "roughness": math.exp(-a / b), "friction": 0.4 * b, "sd": 0.4 * sd, "rms": _rms(left, weight)})
    return min(laws, key=lambda law: float(law["rms"]))


def _line(x: FloatArray, y: FloatArray, weight: FloatArray) -> tuple[float, float, float]:
    """Intercept, slope and 1 sigma of the slope from the residuals of a weighted straight line."""
    A = np.column_stack([np.ones(len(x)), x]) * weight[:, None]
    inverse = np.linalg.inv(A.T @ A)
    a, b = inverse @ (A.T @ (weight * y))
    left = weight * (y - a - b * x)
    return float(a), float(b), float(math.sqrt(float(left @ left) / max(len(x) - 2, 1) * inverse[1, 1]))


def _rms(left: FloatArray, weight: FloatArray) -> float:
    return float(math.sqrt(float(np.sum((weight * left) ** 2) / np.sum(weight**2))))


@dataclass(frozen=True)
class Block:
    """One mean: mean time, seconds in flight, mean wind north and east, mean speed and 1 sigma of it [m/s], turbulence intensity [1]."""

    t: float
    seconds: float
    wind: tuple[float, float]
    speed: float
    sd: float
    turbulence: float

    @property
    def direction(self) -> float:
        """Azimuth [rad] that the mean wind comes from."""
        return float(direction_from(np.array(self.wind[0]), np.array(self.wind[1])))


def turbulence(wind: FloatArray, weight: FloatArray) -> float:
    """Turbulence intensity: standard deviation along the mean wind over the mean speed [1]; NaN below `SLOWEST`.

    Of an estimate it is a lower bound: a filter lets through only gusts slower than itself.
    """
    total = float(weight.sum())
    if total <= 0.0:
        return math.nan
    mean = weight @ wind / total
    speed = float(np.hypot(*mean))
    if speed < SLOWEST:
        return math.nan
    along = wind @ (mean / speed)
    return float(math.sqrt(max(float(weight @ (along - speed) ** 2) / total, 0.0)) / speed)


def blocks(w: WindSeries, length: float = BLOCK) -> list[Block]:
    """Means over blocks of ``length`` seconds of which at least half counts (`WindSeries.weight`), from the first row that does."""
    weight = w.weight
    rows = np.flatnonzero(weight > 0.0)
    if len(rows) == 0:
        return []
    start = float(w.t[rows[0]])
    number = np.floor((w.t - start) / length).astype(np.intp)
    out = []
    for k in range(int(number[rows[-1]]) + 1):
        mine = rows[number[rows] == k]
        seconds = float(weight[mine].sum())
        if seconds < 0.5 * length:
            continue
        share = weight[mine] / seconds
        north, east = (float(share @ w.wind[mine, i]) for i in range(2))
        out.append(Block(float(share @ w.t[mine]), seconds, (north, east), float(share @ w.speed[mine]), float(share @ w.speed_sd[mine]),
                         turbulence(w.wind[mine], weight[mine])))  # fmt: skip
    return out


@dataclass(frozen=True)
class Difference:
    """Wind of the solution minus a reference's: bias, standard deviation and RMS north and east [m/s], (2,) each, of so many samples.

    ``means`` is the same of means over `BLOCK` seconds, ``None`` with fewer than two; ``turn`` the difference of the mean directions [rad].
    """

    bias: FloatArray
    sd: FloatArray
    rms: FloatArray
    n: int
    means: tuple[FloatArray, FloatArray, int] | None
    turn: float


def difference(w: WindSeries, reference: Stream) -> Difference | None:
    """How the wind differs from a reference's over the reference's times in flight and settled; None where there are fewer than two."""
    if not components(reference):
        return None
    other = reference.vector("wind", "ne")
    good = np.isfinite(other).all(axis=1) & (reference.t >= w.t[0]) & (reference.t <= w.t[-1])
    t, other = reference.t[good], other[good]
    good = np.interp(t, w.t, (w.weight > 0.0).astype(np.float64)) > 0.5
    t, other = t[good], other[good]
    if len(t) < 2:
        return None
    mine = np.column_stack([np.interp(t, w.t, w.wind[:, k]) for k in range(2)])
    e = mine - other
    block = np.floor((t - t[0]) / BLOCK).astype(np.intp)
    count = np.bincount(block)
    usual = float(np.median(np.diff(t)))
    whole = count * usual >= 0.5 * BLOCK
    means = None
    if np.count_nonzero(whole) > 1:
        m = np.column_stack([np.bincount(block, e[:, k])[whole] / count[whole] for k in range(2)])
        means = (m.mean(axis=0), m.std(axis=0, ddof=1), len(m))
    a, b = (float(direction_from(*x.mean(axis=0))) for x in (mine, other))
    turn = (a - b + math.pi) % TURN - math.pi
    return Difference(e.mean(axis=0), e.std(axis=0), np.sqrt(np.mean(e * e, axis=0)), len(t), means, turn)
