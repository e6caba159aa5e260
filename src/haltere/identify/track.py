"""A flight as the vehicle model sees it: columns at the IMU's samples, windows of force and of rate change. It fits nothing."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.identify.forms import RHO0
from haltere.identify.prepare import Motion, Samples, matrices
from haltere.identify.rotors import Speeds, box
from haltere.vehicle.regressors import AERO, COLUMNS, lumped_layout, regress

__all__ = ["FORCE", "MOMENT", "Track", "Windows", "flying", "in_wind", "track"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

#: Windows of force and of rate change [s], and stretches taken as independent [s].
FORCE, MOMENT, STRETCH = 0.1, 0.1, 1.0
#: Below this part of its usual ΣΩ² a vehicle may be in a hand, or on the ground.
LEAST_THRUST = 0.25


@dataclass
class Track:
    """A flight at the IMU's samples.

    Attributes
    ----------
    motion, speeds
        What it is from.
    wind
        Wind at the samples, NED (n, 3) [m/s].
    v_air
        Velocity through the air, body (n, 3) [m/s].
    ratio
        Air density over that at sea level (n,).
    use
        Samples that count (n,).
    """

    motion: Motion
    speeds: Speeds
    wind: FloatArray
    v_air: FloatArray
    ratio: FloatArray
    use: BoolArray

    @property
    def t(self) -> FloatArray:
        """Times of the samples (n,) [s]."""
        return self.motion.t


@dataclass
class Windows:
    """What is fitted: measured (n,), both readings of the columns (n, p), stretches (n,), middle of the windows (n,) [s]."""

    y: FloatArray
    a: FloatArray
    b: FloatArray
    stretch: IntArray
    t: FloatArray

    @property
    def x(self) -> FloatArray:
        """Mean reading of the columns."""
        return np.asarray(0.5 * (self.a + self.b))


def flying(m: Motion, speeds: Speeds) -> BoolArray:
    """In the air and carried by its rotors."""
    s2 = np.sum(speeds.mean**2, axis=1)
    usual = float(np.percentile(s2[m.air], 75.0)) if m.air.any() else 0.0
    carried = box((s2 > LEAST_THRUST * usual).astype(np.float64)[:, None], 2 * round(0.1 / _dt(m.t)) + 1)[:, 0] > 0.999
    return np.asarray(m.air & carried)


def track(m: Motion, speeds: Speeds, windows: Samples, wind: FloatArray) -> Track:
    """A flight with the wind (k, 2) at its windows' times."""
    still = Track(m, speeds, np.zeros((0, 3)), np.zeros((0, 3)), m.density / RHO0, flying(m, speeds))
    return in_wind(still, windows.t, wind)


def in_wind(tr: Track, t: FloatArray, wind: FloatArray) -> Track:
    """The same flight in another wind, north and east (k, 2) [m/s] at times t (k,): one that an anemometer told, or none."""
    m = tr.motion
    W = np.zeros((len(m.t), 3))
    for k in range(2):
        W[:, k] = np.interp(m.t, t, wind[:, k])
    return replace(tr, wind=W, v_air=np.einsum("kji,kj->ki", matrices(m.q_nb), m.vel_n - W))


def _dt(t: FloatArray) -> float:
    return float(np.median(np.diff(t)))


def columns(tr: Track, speeds: FloatArray, weights: tuple[FloatArray, FloatArray, FloatArray], literal: bool, s1: float) -> FloatArray:
    """Columns of all axes (n, 6, 7) with one reading of the rotor speeds, those of the air times the density's ratio."""
    m = tr.motion
    record = as_records(np.zeros(1, lumped_layout(len(weights[0]))))
    record["roll"], record["pitch"], record["yaw"] = weights
    record["s1"] = s1
    dt = _dt(m.t)
    smooth = box(speeds, max(round(0.02 / dt) | 1, 3))
    accelerations = np.gradient(smooth, m.t, axis=0)
    w = np.ascontiguousarray(m.gyro_b)
    eta = np.gradient(box(w, max(round(0.02 / dt) | 1, 3)), m.t, axis=0) if literal else w
    out = np.empty((len(m.t), 6, COLUMNS))
    regress(record, np.ascontiguousarray(speeds), np.ascontiguousarray(accelerations), np.ascontiguousarray(tr.v_air), w,
            np.ascontiguousarray(eta), out)  # fmt: skip
    aero = np.array(AERO, dtype=np.float64)
    out *= 1.0 + aero[None] * (tr.ratio - 1.0)[:, None, None]
    return out


def runs(use: BoolArray, t: FloatArray) -> list[tuple[int, int]]:
    """First and last but one index of stretches of samples that count, without gaps in time."""
    dt = _dt(t)
    breaks = np.flatnonzero(~use[1:] | ~use[:-1] | (np.diff(t) > 3.0 * dt)) + 1
    edges = np.r_[0, breaks, len(use)]
    return [(int(a), int(b)) for a, b in itertools.pairwise(edges) if b - a > 1 and use[a]]


def force_windows(tr: Track, first: FloatArray, second: FloatArray, axis: int, used: tuple[int, ...], arm: FloatArray) -> Windows:
    """Means of the specific force along an axis over `FORCE`, at the centre of gravity of an IMU with an arm (3,) [m]."""
    m = tr.motion
    f = m.force_b[:, axis] - _swing(m, arm)[:, axis]
    return _means(tr, f, first[:, axis][:, list(used)], second[:, axis][:, list(used)])


def _swing(m: Motion, arm: FloatArray) -> FloatArray:
    """What an arm adds to the specific force (n, 3)."""
    if not arm.any():
        return np.zeros_like(m.gyro_b)
    dt = _dt(m.t)
    turn = np.gradient(box(m.gyro_b, max(round(0.02 / dt) | 1, 3)), m.t, axis=0)
    return np.asarray(np.cross(turn, arm) + np.cross(m.gyro_b, np.cross(m.gyro_b, arm)))


def _means(tr: Track, y: FloatArray, a: FloatArray, b: FloatArray) -> Windows:
    t = tr.t
    k = np.floor((t - t[0]) / FORCE).astype(np.int64)
    n = int(k[-1]) + 1
    counts = np.bincount(k, minlength=n).astype(np.float64)
    keep = (np.bincount(k, weights=tr.use, minlength=n) == counts) & (counts >= 0.5 * np.median(counts[counts > 0.0])) & (counts > 0.0)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.column_stack([np.bincount(k, weights=c, minlength=n) for c in values.T])[keep] / counts[keep, None])

    at = mean(t[:, None])[:, 0]
    return Windows(mean(y[:, None])[:, 0], mean(a), mean(b), np.floor((at - t[0]) / STRETCH).astype(np.int64), at)


def moment_windows(tr: Track, first: FloatArray, second: FloatArray, axis: int) -> Windows:
    """Change of the rate about an axis over `MOMENT` and the integrals of columns (n, p), without differentiating anything.

    Rates and integrals go through the same short moving average first, which leaves the equation as it is and takes noise off the ends.
    """
    t, w = tr.t, tr.motion.gyro_b[:, axis]
    dt = _dt(t)
    steps, width = max(round(MOMENT / dt), 2), max(round(0.2 * MOMENT / dt) | 1, 1)
    parts: list[tuple[FloatArray, ...]] = []
    for low, high in runs(tr.use, t):
        if high - low < steps + width + 2:
            continue
        s = slice(low, high)
        both = np.concatenate([first[s], second[s]], axis=1)
        whole = np.vstack([np.zeros((1, both.shape[1])), np.cumsum(0.5 * (both[1:] + both[:-1]) * np.diff(t[s])[:, None], axis=0)])
        smooth = box(np.column_stack([w[s], whole]), width)
        ends = np.arange(width // 2, high - low - width // 2, steps)
        change = np.diff(smooth[ends], axis=0)
        p = first.shape[1]
        parts.append((change[:, 0], change[:, 1 : 1 + p], change[:, 1 + p :], 0.5 * (t[s][ends[1:]] + t[s][ends[:-1]])))
    if not parts:
        p = first.shape[1]
        return Windows(np.zeros(0), np.zeros((0, p)), np.zeros((0, p)), np.zeros(0, np.int64), np.zeros(0))
    y, a, b, at = (np.concatenate([part[k] for part in parts]) for k in range(4))
    return Windows(y, a, b, np.floor((at - t[0]) / STRETCH).astype(np.int64), at)
