"""Whether a field that stands still in the world turns in the body as the gyro says, or as it would in other axes or units.

A vector that is constant in the navigation frame (the Earth's magnetic field; the specific force where it is gravity) is seen from a
turning body as ``m(t+T) = C(t, t+T)ᵀ m(t)``, with C the product of ``exp[ω dt]`` over the window: its change over a window follows from
the gyro alone. The same is computed for rates ``ω' = s A ω`` with each of the 48 signed permutations A and some factors s between units,
and the share of the changes that each explains is compared. An offset of the field in the body (hard iron) only adds noise to all.

What this can tell, and what not:

* For a rotation A (determinant +1) the gyro may be turned by A or the field by Aᵀ: they disagree, and neither is at fault more than the
  other. A mirrored A (determinant -1) is the gyro's alone: turning does not see whether the field is mirrored, since -m turns as m does,
  and a mirrored field is the opposite of a turned one.
* A factor s is the gyro's, since the size of the field does not matter.
* Where the vehicle hardly turns, nothing can be told, and nothing is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haltere.flight import axes

__all__ = ["Turning", "compare", "levelled"]

FloatArray = NDArray[np.float64]

#: A window [s], the mean at its ends is over this much on each side [s], steps of integration in it, and how many windows are enough.
WINDOW, ENDS, STEPS, WINDOWS = 0.5, 0.04, 8, 400
#: A window in which the field's strength changes by more than this fraction tells of something else than turning.
STRENGTH = 0.15
#: Factors from the gyro's unit to rad/s: none; deg/s; rad/s taken for deg/s and converted; mrad/s.
FACTORS = (1.0, math.pi / 180.0, 180.0 / math.pi, 1e-3)
#: Explained shares: rates as given, below which they are in doubt; other ones, above which they are found, and which must leave this many
#: times less unexplained, in both halves of what the field turned by too: wrong axes are wrong all the time, a gyro that fails in flight
#: is not. On recordings whose axes are right no other reading ever explained more than the rates as given.
DOUBT, FOUND, TIMES = 0.6, 0.7, 4.0
_TURNS = np.array([axes.matrix(w) for w in axes.WORDS])
_MIRRORED = np.linalg.det(_TURNS) < 0.0


@dataclass(frozen=True)
class Turning:
    """How well turning rates explain the turning of a field.

    Attributes
    ----------
    given, best
        Share of the field's changes that the rates explain as given, and in the axes and unit that explain most; 1 is all, and a
        share is negative where they make it worse.
    word, factor
        Axes (where the gyro's x, y, z point, see `haltere.flight.axes`) and factor of the best.
    others
        Axes that explain nearly as much: what the vehicle did not turn about cannot be told apart.
    always
        In both halves of that turning, too, the best leaves far less unexplained than the rates as given.
    turned, windows
        Root of the sum of the squared angles that the field turned by [rad], and in how many windows by more than 0.1 rad.
    """

    given: float
    best: float
    word: str
    factor: float
    others: tuple[str, ...]
    always: bool
    turned: float
    windows: int

    def enough(self, turned: float, windows: int) -> bool:
        """Whether the vehicle turned enough to conclude anything."""
        return self.turned >= turned and self.windows >= windows

    @property
    def agrees(self) -> bool:
        """The rates as given explain most."""
        return self.given >= FOUND

    @property
    def disagrees(self) -> bool:
        """The rates as given explain little, and in another unit most, or in other axes, in both halves."""
        return self.given < DOUBT and self.best > FOUND and _better(self.best, self.given) and (self.always or self.factor != 1.0)


def compare(t: FloatArray, gyro: FloatArray, t_field: FloatArray, field: FloatArray, *, steady: float | None = None) -> Turning | None:
    """Compare the turning of a field with the gyro.

    Parameters
    ----------
    t, gyro
        Rising times (n,) [s] and angular rates (n, 3) in their own unit.
    t_field, field
        Rising times (m,) [s] and the field (m, 3) in any unit, both finite.
    steady
        Use only windows at whose ends the field's strength is its median within this much; for specific force, which is gravity only then.

    Returns
    -------
    Turning or None
        None where no window can be used.
    """
    if len(t) < 3 or len(t_field) < 3:
        return None
    tau, m = _window_ends(t_field, field)
    a, b = tau[:-1], tau[1:]
    strength = np.linalg.norm(m, axis=1)
    s0, s1 = strength[:-1], strength[1:]
    dt = np.diff(t)
    holes = np.r_[0, np.cumsum(dt > max(0.15, 3.0 * float(np.median(dt))))]
    use = (b - a > 0.5 * WINDOW) & (b - a < 1.6 * WINDOW) & (a >= t[0]) & (b <= t[-1])
    use &= holes[np.searchsorted(t[:-1], b)] == holes[np.maximum(np.searchsorted(t, a, side="right") - 1, 0)]
    use &= (np.minimum(s0, s1) > 0.0) & (np.abs(s1 - s0) < STRENGTH * 0.5 * (s0 + s1))
    if steady is not None:
        middle = float(np.median(np.linalg.norm(field, axis=1)))
        use &= (np.abs(s0 - middle) < steady) & (np.abs(s1 - middle) < steady)
    if not use.any():
        return None
    a, b, m0, change = a[use], b[use], m[:-1][use], (m[1:] - m[:-1])[use]
    integral = np.vstack([np.zeros(3), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * dt[:, None], axis=0)])
    edges = a[:, None] + (b - a)[:, None] * np.linspace(0.0, 1.0, STEPS + 1)
    steps = np.diff(np.stack([np.interp(edges, t, integral[:, k]) for k in range(3)], axis=-1), axis=1)
    turned = np.linalg.norm(change, axis=1) / np.linalg.norm(m0, axis=1)
    if len(turned) > WINDOWS:  # those in which most happened
        most = np.sort(np.argsort(-(turned + np.minimum(np.linalg.norm(steps.sum(axis=1), axis=1), 0.5)))[:WINDOWS])
        m0, change, steps, turned = m0[most], change[most], steps[most], turned[most]
    shares = _explained(steps, m0, change)
    k, j = np.unravel_index(int(np.argmax(shares)), shares.shape)
    best = float(shares[k, j])
    half = int(np.searchsorted(np.cumsum(turned**2), 0.5 * np.sum(turned**2))) + 1
    parts = [_explained(steps[i], m0[i], change[i]) for i in (slice(half), slice(half, None)) if len(turned[i])]
    near = [w for w, share in zip(axes.WORDS, shares[k], strict=True) if 1.0 - share < 2.0 * (1.0 - best) and w != axes.WORDS[j]]
    return Turning(
        float(shares[0, 0]), best, axes.WORDS[j], FACTORS[k], tuple(near), all(_better(part[k, j], part[0, 0]) for part in parts),
        float(np.sqrt(np.sum(turned**2))), int(np.count_nonzero(turned > 0.1)),
    )  # fmt: skip


def _better(share: float, given: float) -> bool:
    """Far less is unexplained."""
    return bool(1.0 - given > TIMES * (1.0 - share))


def _window_ends(t: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and values (k, 3) of a field at the ends of windows: means over the samples near them, or the next sample."""
    grid = np.arange(t[0] + ENDS, t[-1], WINDOW) if t[-1] - t[0] < 1e5 else np.linspace(t[0], t[-1], 200_000)
    first, last = np.searchsorted(t, grid - ENDS), np.searchsorted(t, grid + ENDS, side="right")
    alone = last <= first
    near = np.minimum(np.searchsorted(t, grid), len(t) - 1)
    first, last = np.where(alone, near, first), np.where(alone, near + 1, last)
    sums = np.vstack([np.zeros(4), np.cumsum(np.column_stack([t - t[0], v]), axis=0)])
    means = (sums[last] - sums[first]) / (last - first)[:, None]
    return means[:, 0] + t[0], means[:, 1:]


def _explained(steps: FloatArray, m0: FloatArray, change: FloatArray) -> FloatArray:
    """Share of the changes (k, 3) of a field m0 (k, 3) that rotation steps (k, STEPS, 3) explain, by factor and axes (4, 48)."""
    total = float(np.sum(change * change)) or 1.0
    out = np.empty((len(FACTORS), len(_TURNS)))
    for i, factor in enumerate(FACTORS):
        for sign, which in ((1.0, ~_MIRRORED), (-1.0, _MIRRORED)):
            # exp[A w] = A exp(det(A) [w]) Aᵀ
            M = np.swapaxes(_matrices(sign * factor * steps), 1, 2) - np.eye(3)
            A = _TURNS[which]
            predicted = np.einsum("kab,jkb->jka", M, m0 @ A)  # Mᵏ Aᵀ m0, still to be turned by A
            misfit = total - 2.0 * np.sum((change @ A) * predicted, axis=(1, 2)) + np.sum(predicted * predicted, axis=(1, 2))
            out[i, which] = 1.0 - misfit / total
    return out


def _matrices(theta: FloatArray) -> FloatArray:
    """Products of the rotations exp[theta] over the steps of each window, (k, STEPS, 3) to (k, 3, 3); STEPS is a power of two."""
    angle = np.linalg.norm(theta, axis=-1, keepdims=True)
    q = np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * theta], axis=-1)
    while q.shape[1] > 1:
        (w, x, y, z), (W, X, Y, Z) = np.moveaxis(q[:, 0::2], -1, 0), np.moveaxis(q[:, 1::2], -1, 0)
        q = np.stack(
            [w * W - x * X - y * Y - z * Z, w * X + x * W + y * Z - z * Y, w * Y - x * Z + y * W + z * X, w * Z + x * Y - y * X + z * W],
            axis=-1,
        )
    w, x, y, z = q[:, 0].T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def levelled(t: FloatArray, accel: FloatArray, t_field: FloatArray, field: FloatArray) -> float:
    """Sine of the field's dip, down positive, as the accelerometer has it: the median of ``-m.f / |m||f|`` where f is about gravity.

    Parameters
    ----------
    t, accel
        Rising times (n,) [s] and specific force (n, 3) [m/s^2].
    t_field, field
        Rising times (m,) [s] and the field (m, 3).

    Returns
    -------
    float
        NaN where the two share no time of calm.

    Notes
    -----
    In flight the specific force leans with the vehicle and away from the vertical; over a flight that is not all in one direction the
    leanings cancel. A sign can be read from it, an angle only roughly.
    """
    c = np.vstack([np.zeros(3), np.cumsum(accel, axis=0)])
    first, last = np.searchsorted(t, t_field - 0.2), np.searchsorted(t, t_field + 0.2, side="right")
    n = last - first
    there = n > 0
    f = (c[last[there]] - c[first[there]]) / n[there, None]
    m = field[there]
    size = np.linalg.norm(f, axis=1) * np.linalg.norm(m, axis=1)
    calm = (np.abs(np.linalg.norm(f, axis=1) - 9.8) < 1.0) & (size > 0.0)
    return float(np.median(-np.sum(m[calm] * f[calm], axis=1) / size[calm])) if np.count_nonzero(calm) >= 10 else math.nan
