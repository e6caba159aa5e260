"""The magnetic field as measured: strength and dip against the model, and how it follows the motors. It calibrates nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.field import decimal_year, earth_field
from haltere.flight.load import series
from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution

__all__ = ["FieldSeries", "clean", "field_load", "field_series", "vectors"]

FloatArray = NDArray[np.float64]


def clean(t: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows with finite t (n,) and x (n, k), in order of time, each time once."""
    good = np.isfinite(t) & np.isfinite(x).all(axis=1)
    t, x = t[good], x[good]
    if len(t) > 1 and not np.all(np.diff(t) > 0.0):
        t, first = np.unique(t, return_index=True)
        x = x[first]
    return t, x


@dataclass(frozen=True)
class FieldSeries:
    """Strength [µT] and dip [rad] as measured, (n,), against what they should be.

    Attributes
    ----------
    t, strength
        Of every finite sample.
    dip
        With the solution's attitude, NaN outside it; it says as much of that attitude as of the field.
    expected
        Strength [µT] and dip [rad] of the model, None without one.
    tolerance
        Fraction of the strength, and dip [rad], within which the filter accepts a sample.
    source
        Where the model is from.
    """

    t: FloatArray
    strength: FloatArray
    dip: FloatArray
    expected: tuple[float, float] | None
    tolerance: tuple[float, float]
    source: str

    @property
    def outside(self) -> tuple[float, float] | None:
        """Share of samples whose strength, and whose dip, is outside the tolerance."""
        if self.expected is None:
            return None
        off = np.abs(self.strength / self.expected[0] - 1.0) > self.tolerance[0]
        dip = self.dip[np.isfinite(self.dip)]
        tilted = np.abs(dip - self.expected[1]) > self.tolerance[1]
        return float(np.mean(off)), float(np.mean(tilted)) if len(dip) else 0.0


def vectors(mag: Stream) -> FloatArray:
    """Vectors of a magnetometer (n, 3) [µT], NaN where they are zero: what a unit gives that measured nothing."""
    m = mag.vector("mag")
    return np.asarray(np.where((m == 0.0).all(axis=1, keepdims=True), np.nan, m))


@np.errstate(all="ignore")  # samples near the end of the range are damaged ones
def field_series(solution: Solution, flight: FlightLog, stream: str = "magnetometer") -> FieldSeries | None:
    """Measured strength and dip of the field; None without three samples. Zero is no field, so it counts as no sample."""
    mag = flight.get(stream)
    if mag is None:
        return None
    t, m = clean(mag.t, vectors(mag))
    strength = np.linalg.norm(m, axis=1)
    if len(t) < 3 or not float(np.median(strength)) > 0.0:
        return None
    dip = np.full(len(t), np.nan)
    inside = (t >= solution.t[0]) & (t <= solution.t[-1]) & (strength > 0.0)
    if inside.any():
        i = np.minimum(np.searchsorted(solution.t, t[inside]), len(solution) - 1)
        w, x, y, z = (solution[f"q_{a}"][i] for a in "wxyz")
        down = 2.0 * (x * z - w * y) * m[inside, 0] + 2.0 * (y * z + w * x) * m[inside, 1] + (w * w - x * x - y * y + z * z) * m[inside, 2]
        dip[inside] = np.arcsin(np.clip(down / strength[inside], -1.0, 1.0))
    values = [solution.config.number(f"field.{k}") for k in ("strength", "dip")]
    known = all(math.isfinite(v) for v in values)
    source = ""
    origin = solution.summary.get("origin")
    if known and origin:
        model = earth_field(origin[0], origin[1], origin[2], decimal_year(flight.meta.start_utc))
        near = abs(model.strength - values[0]) < 0.5 and abs(model.dip - values[1]) < 0.01
        source = model.source if near else "the configuration"
    tolerance = (solution.config.number("field.tolerance_strength"), solution.config.number("field.tolerance_dip"))
    return FieldSeries(t, strength, dip, (values[0], values[1]) if known else None, tolerance, source or "the configuration")


def field_load(flight: FlightLog, stream: str = "magnetometer") -> dict[str, Any] | None:
    """How the field's strength follows the motors, where the log has current or throttle.

    The strength is regressed on a constant, the direction of the field in the body (which takes up an offset of the calibration) and
    the load; the standard error allows for the correlation of successive residuals.

    Returns
    -------
    dict or None
        ``load`` (``current`` or ``throttle``), its ``low`` and ``high`` (1st and 99th percentile), ``change`` of strength between
        them [µT] and its standard error ``sd``; None without a load that varies, or below fifty samples.
    """
    mag = flight.get(stream)
    load = _load(flight)
    if mag is None or load is None:
        return None
    name, tl, u = load
    t, m = clean(mag.t, vectors(mag))
    inside = (t >= tl[0]) & (t <= tl[-1])
    t, m = t[inside], m[inside]
    strength = np.linalg.norm(m, axis=1)
    if len(t) < 50 or not float(np.min(strength)) > 0.0:
        return None
    x = np.interp(t, tl, u)
    low, high = (float(v) for v in np.percentile(x, [1.0, 99.0]))
    if not high - low > (0.1 if name == "throttle" else 1.0):
        return None
    A = np.column_stack([x, np.ones(len(t)), m / strength[:, None]])
    solved, _, rank, _ = np.linalg.lstsq(A, strength, rcond=1e-6)
    residual = strength - A @ solved
    # Residuals correlated as a first-order process leave fewer independent samples (M. S. Bartlett, 1946).
    centred = x - x.mean()
    power = float(residual @ residual)
    r = [max(0.0, float(v[:-1] @ v[1:]) / max(float(v @ v), 1e-300)) for v in (residual, centred)]
    independent = len(t) * (1.0 - r[0] * r[1]) / (1.0 + r[0] * r[1])
    if independent < rank + 3.0:
        return None
    variance = np.linalg.pinv(A.T @ A, rcond=1e-12)[0, 0] * power / (len(t) - rank) * len(t) / (independent - rank)
    change = float(solved[0]) * (high - low)
    return {"load": name, "low": low, "high": high, "change": change, "sd": math.sqrt(max(variance, 0.0)) * (high - low)}


def _load(flight: FlightLog) -> tuple[str, FloatArray, FloatArray] | None:
    """Name, times and values of what the motors draw: battery current [A] where it varies, else the mean rotor command (0-1)."""
    for word, least in (("current", 1.0), ("throttle", 0.0)):
        found = series(flight, word)
        if found is not None and len(found[0]) > 10 and float(np.ptp(found[1])) >= least:
            return word, *found
    return None
