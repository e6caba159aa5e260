"""Does a multirotor do what its motors are told? From commands, rates and thrust of the flight itself; no vehicle file, no filter.

Change of rate and specific force along z over 0.2 s are explained, by least squares over the flight so far, with the squares of the
commands, the rates and the velocity along the body's axes. What is left is large where a rotor's thrust is missing, and stays small where
a sensor of the navigation fails: a gyro that is off by a constant changes no difference of rates. It is no substitute for rotor speeds and
a vehicle's model, only what commands at 10 Hz can tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.metrics.magnetism import clean
from haltere.metrics.units import agreement, stations
from haltere.vehicle.motor import commanded

__all__ = ["Unanswered", "events", "unanswered"]

FloatArray = NDArray[np.float64]

#: Windows [s] and their spacing, how many in a row are averaged, how long a fit holds and how much of the flight it needs [s].
WIDTH, HOP, IN_A_ROW, HOLDS, NEEDS = 0.2, 0.1, 5, 2.0, 20.0
#: Latencies of the commands that are tried [s].
LAGS = (0.0, 0.03, 0.06, 0.1, 0.15)
#: What is left, in sigmas of the usual, beyond which the motors are not answered: at least this, a tenth more than the largest of 48
#: simulated flights without a fault, and this many times the largest of the flight so far.
LEFT, MORE = 11.0, 1.5
#: Each of the windows shows at least this part of their mean. Windows over which residuals are correlated.
LASTS, LAST_LAG = 0.3, 20
#: 1 sigma of coefficients before the flight, of rate change and of force: of commands, rates, velocity and its square [SI].
WIDE, BY_RATE, BY_VELOCITY, BY_SQUARE = 1e3, (1.0, 0.1), (0.2, 0.5), (0.02, 0.02)
#: Half of that is enough while some motors, not all, are held near the limit, one of them at it (parts of the highest command so far),
#: and what is missing about roll and pitch points, by this cosine, to what those motors do.
NEAR_LIMIT, AT_LIMIT, POINTS = 0.97, 0.998, 0.7
#: Part of a window that the latency of the commands may be wrong by.
LATE = 0.2
#: What comes within so many windows is one and the same event, and no measure of what is usual.
BEFORE = 50
#: A vehicle lower than this above the lowest point of its flight [m] may touch the ground.
CLEAR = 2.0
#: A rotor is named whose missing thrust explains so much of what is left, and this much more than the next one's.
EXPLAINS, APART = 0.7, 0.15
NAMES = ("roll", "pitch", "yaw", "thrust")


@dataclass
class Unanswered:
    """A stretch in which motion is not what the commands ask for.

    Attributes
    ----------
    onset, detected
        Times [s].
    left
        Mean over half a second of measured less expected: rate change about x, y, z [rad/s^2], force along z [m/s^2]; (4,).
    statistic, threshold
        Its size in sigmas of the usual, and what was passed.
    commands
        Of all motors then, 0 to 1, and the largest of each before.
    rotors
        Numbers of the rotors whose missing thrust would explain it, none where the flight has not told what each rotor does.
    """

    onset: float
    detected: float
    left: FloatArray
    statistic: float
    threshold: float
    commands: FloatArray
    highest: FloatArray
    rotors: tuple[int, ...]


@dataclass
class _Windows:
    """Beginnings of windows (k,), measured (k, 4), what explains it (k, p), squared commands and their change (k, r), in the air."""

    t: FloatArray
    y: FloatArray
    x: FloatArray
    u: FloatArray
    du: FloatArray
    air: NDArray[np.bool_]


def _windows(flight: FlightLog, solution: Solution) -> _Windows | None:
    t_u, u = commanded(flight.streams)
    imu = flight.get("imu")
    if not len(t_u) or imu is None or "pos_d" not in solution:
        return None
    ti, samples = clean(imu.t, np.column_stack([imu.vector("gyro"), imu.vector("accel")]))
    if len(ti) < 100 or (ti[-1] - ti[0]) / len(ti) > 0.06:
        return None
    n = max(1, round(0.04 * len(ti) / (ti[-1] - ti[0])))
    rate = np.column_stack([np.convolve(samples[:, k], np.ones(n) / n, "same") for k in range(3)])
    start, end = max(ti[0], t_u[0], solution.t[0]), min(ti[-1], t_u[-1], solution.t[-1]) - WIDTH
    if end - start < NEEDS + HOLDS:
        return None
    t = np.arange(start, end, HOP)

    def at(when: FloatArray, k: int) -> FloatArray:
        return np.asarray(np.interp(when, ti, rate[:, k]))

    parts = (np.arange(5) + 0.5) / 5.0 * WIDTH
    force = np.mean([np.interp(t + s, ti, samples[:, 5]) for s in parts], axis=0)
    y = np.column_stack([*((at(t + WIDTH, k) - at(t, k)) / WIDTH for k in range(3)), force])
    w = np.column_stack([at(t + 0.5 * WIDTH, k) for k in range(3)])
    v = _body_velocity(solution, t + 0.5 * WIDTH)
    # from the lowest point of the flight, which is the ground or above it; the first fixes may be metres off
    sure = solution["sd_pos_d"] < 3.0 * np.median(solution["sd_pos_d"])
    height = float(solution["pos_d"][sure].max()) - np.interp(t, solution.t, solution["pos_d"])
    total = np.interp(t, t_u, (u * u).sum(axis=1))
    usual = float(np.median(total[total > 0.05 * u.shape[1]])) if (total > 0.05 * u.shape[1]).any() else math.inf
    air = (height > CLEAR) & (total > 0.3 * usual)
    if air.sum() < NEEDS / HOP:
        return None
    best: tuple[float, FloatArray, FloatArray, FloatArray] | None = None
    half = air & (np.cumsum(air) < 0.6 * air.sum())
    for lag in LAGS:
        rows = [np.clip(np.searchsorted(t_u, t + s - lag, side="right") - 1, 0, len(t_u) - 1) for s in parts]
        squares, change = np.mean([u[i] ** 2 for i in rows], axis=0), u[rows[-1]] ** 2 - u[rows[0]] ** 2
        x = np.column_stack([squares, w, v, v * v, np.ones(len(t))])
        told = float(np.sum(_explained(x[half], y[half])))
        if best is None or told > best[0]:
            best = told, x, squares, change
    assert best is not None
    return _Windows(t, y, *best[1:], np.asarray(air))


def _body_velocity(solution: Solution, t: FloatArray) -> FloatArray:
    """Velocity over ground along the body's axes at times t, (k, 3)."""
    k = np.clip(np.searchsorted(solution.t, t), 0, len(solution.t) - 1)
    q, v = solution.vector("q", "wxyz")[k], solution.vector("vel", "ned")[k]
    u = -q[:, 1:]
    c = 2.0 * np.cross(u, v)
    return np.asarray(v + q[:, :1] * c + np.cross(u, c))


def _explained(x: FloatArray, y: FloatArray) -> FloatArray:
    """Part of the variance of each column that is explained."""
    k, *_ = np.linalg.lstsq(x, y, rcond=None)
    return np.asarray(1.0 - np.var(y - x @ k, axis=0) / np.maximum(np.var(y, axis=0), 1e-12))


def unanswered(flight: FlightLog, solution: Solution) -> Unanswered | None:
    """The first time that the motors are not answered, in clear air; None where they always are, or the flight cannot tell.

    Parameters
    ----------
    flight
        With commands of at least three motors (streams ``rotors`` or ``actuators``).
    solution
        Of the flight, for height and velocity.
    """
    f = _windows(flight, solution)
    if f is None:
        return None
    sizes, each, sums = np.zeros(len(f.t)), np.zeros(len(f.t)), np.zeros((IN_A_ROW, 4))
    fitted, k, sd, spread = -math.inf, np.zeros((f.x.shape[1], 4)), np.ones(4), np.zeros((4, *(f.x.shape[1],) * 2))
    first: int | None = None
    largest = 0.0
    for i in range(len(f.t)):
        largest = max(largest, sizes[max(i - BEFORE, 0)])
        if f.t[i] - fitted >= HOLDS:
            before = f.air & (f.t < f.t[i] - 1.0)
            if before.sum() < NEEDS / HOP:
                continue
            fitted = float(f.t[i])
            k, spread, sd = _fit(f, before)
            first = i if first is None else first
        # beyond what was flown before the fit is no better than its leverage; where commands change it is as uncertain as their latency
        error = sd * np.sqrt(1.0 + np.einsum("i,kij,j->k", f.x[i], spread, f.x[i]))
        z = (f.y[i] - f.x[i] @ k) / np.hypot(error, LATE * (f.du[i] @ k[: f.u.shape[1]]))
        each[i] = float(np.linalg.norm(z))
        sums = np.roll(sums, -1, axis=0)
        sums[-1] = z if f.air[i] else 0.0
        if first is None or i < first + IN_A_ROW or not f.air[i - IN_A_ROW + 1 : i + 1].all():
            continue
        mean = sums.mean(axis=0)
        size = float(np.linalg.norm(mean))
        threshold = max(LEFT, MORE * float(largest))
        held = _held(f, i, k, sd, mean)
        threshold *= 0.5 if held else 1.0
        if size > threshold and bool((sums @ mean > LASTS * size * size).all()):  # a step of the gyro is over after two windows
            return _found(f, i, each, mean * sd, sd, k, spread, size, threshold, held)
        sizes[i] = size
    return None


def _fit(f: _Windows, before: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coefficients (p, 4), their covariance over the variance of what is left (4, p, p), and 1 sigma of what is left (4,)."""
    x, y, n = f.x[before], f.y[before], f.u.shape[1]
    k = np.asarray(np.linalg.lstsq(x, y, rcond=None)[0], dtype=np.float64)
    rest = y - x @ k
    sd = np.asarray(1.4826 * np.median(np.abs(rest - np.median(rest, axis=0)), axis=0) + 1e-6, dtype=np.float64)
    spread = np.empty((4, x.shape[1], x.shape[1]))
    for axis in range(4):
        count = max(10.0, _alike(rest[:, axis] / sd[axis]))
        prior = np.concatenate([np.full(n, WIDE), *(np.full(3, v[axis // 3]) for v in (BY_RATE, BY_VELOCITY, BY_SQUARE)), [WIDE]])
        spread[axis] = np.linalg.inv(x.T @ x / count + sd[axis] ** 2 * np.diag(prior**-2.0))
        k[:, axis] = spread[axis] @ (x.T @ y[:, axis]) / count
    return k, spread, sd


def _held(f: _Windows, i: int, k: FloatArray, sd: FloatArray, z: FloatArray) -> tuple[int, ...]:
    """Motors that have been held at their limit where the moment that is missing is theirs."""
    part = np.sqrt(f.u[i - IN_A_ROW + 1 : i + 1].min(axis=0) / float(np.max(f.u[: i + 1][f.air[: i + 1]])))
    held = part >= NEAR_LIMIT
    if part.max() < AT_LIMIT or held.all():
        return ()
    loss = -(f.u[i, held] @ k[: f.u.shape[1]][held, :2]) / sd[:2]
    points = bool(loss @ z[:2] > POINTS * np.linalg.norm(loss) * np.linalg.norm(z[:2]))
    return tuple(int(r) for r in np.flatnonzero(held)) if points else ()


def _alike(z: FloatArray) -> float:
    """How many windows in a row say as much as an independent one: 1 + 2 Σ of the correlations up to `LAST_LAG`, of clipped residuals."""
    c = np.clip(z, -3.0, 3.0)
    c = c - c.mean()
    power = float(c @ c)
    return max(1.0, 1.0 + 2.0 * sum(float(c[j:] @ c[:-j]) / power for j in range(1, min(LAST_LAG, len(c) - 1) + 1))) if power > 0 else 1.0


def _found(
    f: _Windows,
    i: int,
    each: FloatArray,
    left: FloatArray,
    sd: FloatArray,
    k: FloatArray,
    spread: FloatArray,
    size: float,
    threshold: float,
    held: tuple[int, ...],
) -> Unanswered:
    """What is told of a stretch: since when, and whose missing thrust explains it."""
    n, before = f.u.shape[1], f.air & (f.t < f.t[i] - 1.0)
    begins = i
    while begins > 0 and i - begins < 2 * IN_A_ROW and each[begins - 1] > 0.5 * size:
        begins -= 1
    error = np.sqrt(np.array([np.diag(v)[:n] for v in spread])).T * sd
    known = (np.abs(k[:n]) > 2.0 * error) & (np.abs(k[:n]) * np.mean(f.u[before], axis=0)[:, None] > sd)
    known[:, 2:] = False  # of yaw and thrust all rotors do much alike
    z, shares = left / sd, np.ones(n)  # of a rotor of which nothing is known: it cannot be excluded
    for r in range(n):
        axes = np.flatnonzero(known[r])
        if len(axes):
            loss, shown = -k[r, axes] * f.u[i, r] / sd[axes], z[axes]
            part = float(np.clip(shown @ loss / (loss @ loss), 0.0, 1.2))
            shares[r] = 1.0 - float(np.sum((shown - part * loss) ** 2) / (shown @ shown))
    order = [int(r) for r in np.argsort(shares)[::-1]]
    rotors = tuple(r for r in order if shares[r] > max(EXPLAINS, shares[order[0]] - APART))
    rotors = held or rotors
    rotors = rotors if len(rotors) <= 2 else ()
    highest = np.sqrt(np.max(f.u[before], axis=0))
    return Unanswered(float(f.t[begins]), float(f.t[i] + WIDTH), left, size, threshold, np.sqrt(f.u[i]), np.asarray(highest), rotors)


def events(flight: FlightLog, solution: Solution) -> list[dict[str, Any]]:
    """An event where the motors are not answered, and no gyro was found to have failed then."""
    found = unanswered(flight, solution)
    if found is None or any(e["sensor"] == "gyro" and abs(e["t_onset"] - found.onset) < 1.0 for e in solution.events):
        return []
    left = ", ".join(
        f"{name} {value:+.2g} {'m/s²' if name == 'thrust' else 'rad/s²'}" for name, value in zip(NAMES, _upward(found.left), strict=True)
    )
    at_limit = [str(k) for k in range(len(found.commands)) if found.commands[k] > NEAR_LIMIT * found.highest.max()]
    words = [f"the vehicle does not do what its motors are told: {left} unasked for, {found.statistic:.0f} times the usual"]
    words += [f"motor{'s' if len(at_limit) > 1 else ''} {', '.join(at_limit)} at the highest command of the flight"] if at_limit else []
    words += _same_motion(flight, found)
    words += ["rotors or what drives them, or a blow from outside; no sensor of the navigation"]
    if not found.rotors:
        words.append("which rotor cannot be told from these commands")
    names = [f"rotor.{k}" for k in found.rotors]  # as the fault word of a thrust that is lost
    return [{
        "sensor": "rotors", "axis": str(found.rotors[0]) if len(names) == 1 else None, "kind": "thrust", "t_onset": found.onset,
        "t_detected": found.detected, "t_isolated": found.detected if len(names) == 1 else None, "t_recovered": None,
        "candidates": names or ["rotors"], "statistic": found.statistic, "threshold": found.threshold, "evidence": "; ".join(words),
    }]  # fmt: skip


def _upward(left: FloatArray) -> list[float]:
    """Thrust counted upwards."""
    return [float(left[0]), float(left[1]), float(left[2]), -float(left[3])]


def _same_motion(flight: FlightLog, found: Unanswered) -> list[str]:
    """Whether other inertial units measure the same motion."""
    same = []
    for other in stations(flight)[1:]:
        near = [agreement(flight, other, axis, found.onset, found.detected) for axis in range(3)]
        change = np.abs(found.left[:3]) * max(found.detected - found.onset, WIDTH)
        worst = int(np.argmax(change))
        got = near[worst]
        if got is not None and abs(got[0]) < 0.2 * change[worst]:
            same.append(other)
    return [f"{' and '.join(same)} measure{'s' if len(same) == 1 else ''} the same motion"] if same else []
