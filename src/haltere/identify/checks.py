"""A vehicle model against flights: measured and predicted in windows, and the statistics of what it leaves. It fits nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haltere.estimators.lumped import Lumped
from haltere.identify.track import FORCE, MOMENT, Track, columns, force_windows, moment_windows
from haltere.vehicle.regressors import PRESETS

__all__ = ["Check", "check", "with_residuals"]

FloatArray = NDArray[np.float64]


@dataclass
class Check:
    """Measured against predicted on one flight, by axis hx, hy, t, r, p, q (6,).

    Attributes
    ----------
    name
        Of the flight, and whether the model has seen it.
    signal, error
        Root mean square of the measured about its mean, and of measured minus predicted [m/s^2, rad/s^2].
    bias
        Mean of measured minus predicted.
    windows
        Times, measured and predicted of each axis, for a picture.
    """

    name: str
    seen: bool
    signal: FloatArray
    error: FloatArray
    bias: FloatArray
    windows: list[tuple[FloatArray, FloatArray, FloatArray]]

    @property
    def explained(self) -> FloatArray:
        """Part of the variance that is predicted, bias counted as error (6,)."""
        return np.asarray(1.0 - self.error**2 / np.maximum(self.signal**2, 1e-12))


def _predicted(tr: Track, model: Lumped, arm: FloatArray) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Times, measured and predicted by axis, in windows of force [m/s^2] and of rate change over their length [rad/s^2]."""
    weights = (model.roll, model.pitch, model.yaw)
    x = columns(tr, tr.speeds.mean, weights, model.preset == "literal", model.s1)
    out = []
    for axis in range(6):
        used = PRESETS[model.preset][axis]
        k = model.k[axis, list(used)]
        if axis < 3:
            w = force_windows(tr, x, x, axis, used, arm)
            out.append((w.t, w.y, w.x @ k))
        else:
            w = moment_windows(tr, x[:, axis][:, list(used)], x[:, axis][:, list(used)], axis - 3)
            out.append((w.t, w.y / MOMENT, w.x @ k / MOMENT))
    return out


def with_residuals(model: Lumped, tracks: list[Track], arm: FloatArray) -> Lumped:
    """The model with the statistics of what it leaves on its own flights."""
    sd, ar1, slow = np.zeros(6), np.zeros(6), np.zeros(6)
    shown = [_predicted(tr, model, arm) for tr in tracks]
    for axis in range(6):
        left = [s[axis][1] - s[axis][2] for s in shown]
        times = [s[axis][0] for s in shown]
        every = np.concatenate(left)
        sd[axis] = float(np.sqrt(np.mean(every**2)))
        step = FORCE if axis < 3 else MOMENT
        near = [np.diff(t) < 1.5 * step for t in times]
        pairs = [(e[:-1][n], e[1:][n]) for e, n in zip(left, near, strict=True)]
        ar1[axis] = float(sum(a @ b for a, b in pairs) / max(sum(0.5 * (a @ a + b @ b) for a, b in pairs), 1e-12))
        seconds = [_by_second(t, e) for e, t in zip(left, times, strict=True)]
        slow[axis] = float(np.std(np.concatenate(seconds)))
    return replace(model, residual_sd=sd, residual_ar1=ar1, residual_slow=slow)


def _by_second(t: FloatArray, e: FloatArray) -> FloatArray:
    """Means of every second."""
    k = np.floor(t - t[0]).astype(np.int64)
    counts = np.bincount(k)
    return np.asarray(np.bincount(k, weights=e)[counts > 0] / counts[counts > 0])


def check(tr: Track, model: Lumped, arm: FloatArray, seen: bool) -> Check:
    """What a model says of a flight, and what was measured; ``seen`` where it was fitted to it."""
    windows = _predicted(tr, model, arm)
    signal = np.array([float(np.std(y)) for _, y, _ in windows])
    error = np.array([float(np.sqrt(np.mean((y - p) ** 2))) for _, y, p in windows])
    bias = np.array([float(np.mean(y - p)) for _, y, p in windows])
    return Check(tr.motion.name, seen, signal, error, bias, windows)
