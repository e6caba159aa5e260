"""Rotor speeds made ready for identification: at the IMU's times, their lag, and which rotor does what. It fits no vehicle model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.flight.log import Stream
from haltere.identify.instrument import Instrumented, instrumented
from haltere.identify.prepare import Motion

__all__ = ["Layout", "Speeds", "box", "find_lag", "find_layout", "quick_turns", "speeds_of"]

FloatArray = NDArray[np.float64]

#: How far apart in time rotors and IMU may be [s], the step of the search [s], and the part of the rates' variance that must be explained.
REACH, STEP, TOLD = 0.1, 0.002, 0.15
#: Lowest sample rate of rotor speeds that tells anything, and that tells moments [Hz].
LEAST_RATE, MOMENT_RATE = 8.0, 40.0
#: Windows of moments [s], and within how many sigma a sign is believed.
WINDOW, CLEAR = 0.2, 4.0


@dataclass
class Speeds:
    """Rotor speeds of a flight at the IMU's times.

    Attributes
    ----------
    first, second
        From every other sample each (n, r) [rad/s]: two readings with independent noise.
    lag
        How long before its stamp a sample was valid [s], and whether the flight told it.
    """

    first: FloatArray
    second: FloatArray
    lag: float
    lag_told: bool
    explained: float
    rate: float

    @property
    def mean(self) -> FloatArray:
        """Both readings together (n, r)."""
        return np.asarray(0.5 * (self.first + self.second))


def _table(rotors: Stream, name: str) -> tuple[FloatArray, FloatArray]:
    """Times and speeds (m, r) without missing and repeated rows."""
    columns = sorted((c for c in rotors.names if c.startswith("speed_")), key=lambda c: int(c[6:]))
    if len(columns) < 3:
        raise HaltereError("speeds of at least 3 rotors", ", ".join(columns) or "none", f"{name}: rotors")
    values = np.column_stack([rotors[c] for c in columns])
    good = np.isfinite(values).all(axis=1) & np.isfinite(rotors.t)
    t, values = rotors.t[good], values[good]
    fresh = np.r_[True, (np.diff(values, axis=0) != 0.0).any(axis=1) & (np.diff(t) > 0.0)]
    if len(t) < 50:
        raise HaltereError("rotor speeds", f"{len(t)} whole rows", f"{name}: rotors")
    return t[fresh], values[fresh]


def _read(t: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(at, t, column) for column in values.T])


def speeds_of(m: Motion, lag: float | None = None) -> Speeds:
    """Rotor speeds at the IMU's times, their lag found unless it is given.

    Raises
    ------
    HaltereError
        The log has no rotor speeds, or too few a second to tell what a manoeuvre is.
    """
    rotors = m.flight.get("rotors")
    if rotors is None or not any(c.startswith("speed_") for c in rotors.names):
        raise HaltereError("rotor speeds", "none", m.name, "log ESC telemetry")
    t, values = _table(rotors, m.name)
    rate = 1.0 / float(np.median(np.diff(t)))
    if rate < LEAST_RATE:
        raise HaltereError(f"at least {LEAST_RATE:g} rotor speeds a second", f"{rate:.1f}", f"{m.name}: rotors", "raise the logging rate")
    found, explained = find_lag(m, t, values) if lag is None else (lag, 1.0)
    told = explained > TOLD
    found = found if told else 0.0
    at = m.t + found
    return Speeds(_read(t[::2], values[::2], at), _read(t[1::2], values[1::2], at), found, told, explained, rate)


def find_lag(m: Motion, t: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Lag of rotor speeds behind the IMU [s], and the part of roll and pitch acceleration that they explain there.

    The regression of the angular accelerations on the squares of the speeds, at lags within 0.1 s (theory-amendments.md 19: the top of a
    correlation, with a parabola through it); it needs no geometry. Rates are in it too: damping turns the phase as a lag does.
    """
    lags, score = quick_turns(m, t, values, np.arange(-REACH, REACH + 0.5 * STEP, STEP))
    best = int(np.argmax(score))
    if 0 < best < len(lags) - 1:
        before, top, after = score[best - 1 : best + 2]
        shift = 0.5 * (before - after) / min(before - 2.0 * top + after, -1e-12)
        return float(lags[best] + STEP * np.clip(shift, -1.0, 1.0)), float(score[best])
    return float(lags[best]), 0.0  # at the edge: not a top


def quick_turns(m: Motion, t: FloatArray, values: FloatArray, lags: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lags, and the part of quick roll and pitch acceleration that the squares of speeds (n, r) at times t explain at each."""
    dt = max(float(np.median(np.diff(m.t))), 0.004)
    span = m.t[m.air]
    grid = np.arange(span[0] + REACH, span[-1] - REACH, dt)
    flying = np.interp(grid, m.t, m.air.astype(np.float64)) > 0.99
    width = max(round(0.024 / dt) | 1, 3)
    rate = np.column_stack([np.interp(grid, m.t, m.gyro_b[:, k]) for k in range(2)])
    y = _high(np.gradient(box(rate, width), dt, axis=0), dt)[flying]
    damping = _high(box(rate, width), dt)[flying]
    y -= damping @ np.linalg.lstsq(damping, y, rcond=None)[0]
    power = float(np.sum(y * y))
    score = np.empty(len(lags))
    for k, lag in enumerate(lags):
        x = np.hstack([_high(box(_read(t, values, grid + lag) ** 2, width), dt)[flying], damping])
        left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
        score[k] = 1.0 - float(np.sum(left * left)) / power
    return lags, score


def box(x: FloatArray, width: int) -> FloatArray:
    """Moving average along time, odd width, shorter at the ends."""
    total = np.cumsum(np.vstack([np.zeros((1, x.shape[1])), x]), axis=0)
    half = width // 2
    low, high = np.maximum(np.arange(len(x)) - half, 0), np.minimum(np.arange(len(x)) + half + 1, len(x))
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def _high(x: FloatArray, dt: float) -> FloatArray:
    """Without what lasts longer than half a second."""
    return x - box(x, round(0.5 / dt) | 1)


@dataclass
class Layout:
    """What each rotor does, found from flights.

    Attributes
    ----------
    roll, pitch, yaw
        Weights of the rotors (r,): of the geometry where it is given, else what each was found to do over the mean size.
    effect, effect_sd
        Angular acceleration about each axis by each rotor's Ω² (3, r), and 1 sigma.
    found
        Signs that are clear, 0 where they are not (3, r).
    notes
        What was found against what was given.
    """

    roll: FloatArray
    pitch: FloatArray
    yaw: FloatArray
    effect: FloatArray
    effect_sd: FloatArray
    found: FloatArray
    notes: list[str]


def find_layout(
    blocks: list[tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]]],
    geometry: tuple[FloatArray, FloatArray, FloatArray] | None,
    rotors: int,
) -> Layout:
    """Signs of every rotor about every axis, against a geometry's weights where there is one.

    Parameters
    ----------
    blocks
        By axis r, p, q: rate changes (n,), both readings of the columns - integrals of every rotor's Ω², and of what else turns a vehicle -
        and stretches.
    geometry
        Weights -y, x and spin of the rotors.
    rotors
        Their number: so many columns come first.

    Raises
    ------
    HaltereError
        The geometry contradicts the flights, and in which order it would not.
    """
    fits: list[Instrumented] = [instrumented(*block) for block in blocks]
    effect = np.array([f.k[:rotors] for f in fits])
    sd = np.array([f.sd[:rotors] for f in fits])
    # what a rotor does beside the mean of all is what tells it from the others: a tilted or shifted body gives all the same sign
    beside = effect - effect.mean(axis=1, keepdims=True)
    clear = np.array([_explained(f, block) > 0.5 for f, block in zip(fits, blocks, strict=True)])
    signs = np.where((np.abs(beside) > CLEAR * sd) & clear[:, None], np.sign(beside), 0.0)
    notes: list[str] = []
    if geometry is not None:
        given = np.array(geometry)
        _check(given, _borne_out(blocks, fits, given), beside, sd, signs, notes)
        return Layout(geometry[0], geometry[1], geometry[2], effect, sd, signs, notes)
    if (signs == 0.0).any():
        axes = [name for name, row in zip(("roll", "pitch", "yaw"), signs, strict=True) if (row == 0.0).any()]
        notes.append(
            f"the flights do not tell every rotor's part in {', '.join(axes)}: give the vehicle's geometry, or excite these axes more"
        )
    # rotors, arms and mounts are not alike: each by what it was found to do, the mean of their sizes one
    weights = effect / np.maximum(np.mean(np.abs(effect), axis=1, keepdims=True), 1e-300)
    notes.append("no geometry was given: rotors are weighted by what each was found to do, and kR0, kP0, kQ0 contain arms")
    return Layout(weights[0], weights[1], weights[2], effect, sd, signs, notes)


def _explained(f: Instrumented, block: tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]]) -> float:
    """Part of the variance of rate changes that the rotors explain; where it is little, noise decides."""
    y, a, b, _ = block
    return 1.0 - float(np.var(y - 0.5 * (a + b) @ f.k) / max(float(np.var(y)), 1e-300))


def _borne_out(
    blocks: list[tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]]], fits: list[Instrumented], given: FloatArray
) -> list[bool]:
    """Whether each axis' weights do nearly as well as rotors each for itself, with the right sign: then they are not contradicted.

    Rotors each for itself are hardly told from each other where a flight swings about one axis only.
    """
    out = []
    r = given.shape[1]
    for (y, a, b, stretch), f, weights in zip(blocks, fits, given, strict=True):
        M = np.zeros((a.shape[1], 1 + a.shape[1] - r))
        M[:r, 0] = weights
        M[r:, 1:] = np.eye(a.shape[1] - r)
        block = (y, a @ M, b @ M, stretch)
        own = instrumented(*block)
        out.append(bool(own.k[0] > 0.0 and _explained(own, block) > 0.8 * _explained(f, (y, a, b, stretch))))
    return out


def _check(given: FloatArray, borne: list[bool], beside: FloatArray, sd: FloatArray, signs: FloatArray, notes: list[str]) -> None:
    """Compare a geometry with what was found; contradicted, the permutation and spin that agree are named."""
    from itertools import permutations

    centred = given - given.mean(axis=1, keepdims=True)
    expected = np.sign(np.where(np.abs(centred) > 1e-6, centred, 0.0))
    wrong = (expected != 0.0) & (signs != 0.0) & (expected != signs) & ~np.array(borne)[:, None]
    if not wrong.any():
        told = int(np.sum((expected != 0.0) & (signs == expected)))
        notes.append(f"the geometry agrees with the flights: {told} of {int(np.sum(expected != 0.0))} signs told, none against")
        return
    n = given.shape[1]
    spun = -given[2] if (wrong[2] | (signs[2] == 0.0)).all() else given[2]
    best, score = tuple(range(n)), -np.inf
    weight = beside / np.maximum(sd, 1e-12)
    weight = np.clip(weight, -20.0, 20.0)
    norm = centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-12)
    for order in permutations(range(n)) if n <= 8 else [tuple(range(n))]:
        total = float(np.sum(weight * norm[:, order]))
        if total > score:
            best, score = order, total
    axes = ", ".join(f"rotor {i} in {('roll', 'pitch', 'yaw')[a]}" for a, i in zip(*np.nonzero(wrong), strict=True))
    if (spun != given[2]).all() and not wrong[:2].any():
        remedy = "every spin is the other way round"
    elif best != tuple(range(n)):
        remedy = f"in the log's order the vehicle's rotors are {', '.join(map(str, best))}"
    else:
        remedy = "compare positions and spins of the vehicle file with the log's order of motors"
    raise HaltereError("a vehicle geometry that agrees with its flights", f"the wrong sign: {axes}", "vehicle [[rotor]]", remedy)
