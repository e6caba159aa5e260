"""The ellipsoid on which a magnetometer's vectors lie: four fits, robust weights, covariance. It knows no sensor and no unit."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from haltere.errors import HaltereError, UsageError, nearest

__all__ = ["METHODS", "Ellipsoid", "correlation_time", "fit"]

FloatArray = NDArray[np.float64]

#: Ways to fit: Li and Griffiths' constraint, Fitzgibbon's, the axis-aligned form of the publication, and least Sampson distance (default).
METHODS = ("sampson", "lg", "fz", "axis")
#: Rows and columns of the six numbers of a symmetric matrix, in the order in which they are estimated.
SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Basis of the symmetric matrices in that order.
BASIS = np.array([[[float({i, j} == {r, c} and (i == j) == (r == c)) for c in range(3)] for r in range(3)] for i, j in SYMMETRIC])
#: Residuals in standard deviations where a weight begins to fall, and from where it is zero (IGG-III, theory-amendments.md §7).
WEIGHT_FROM, WEIGHT_TO = 2.5, 6.0
#: Random subsets tried for a sphere that outliers do not move, and vectors in each.
SUBSETS, SUBSET = 40, 8
#: Rounds of weights for which a start is followed, and over about how many vectors.
ROUNDS, THINNED = 5, 2000
FEWEST = 30


@dataclass(frozen=True)
class Ellipsoid:
    """Result of a fit: ``|shape (m - centre - load u)| = 1`` on the surface.

    Attributes
    ----------
    centre
        Centre (3,) [unit of the vectors]; where the load is zero.
    shape
        Symmetric positive matrix (3, 3) [1/unit]: A'^(1/2) of theory.md §4.2.
    load
        Shift of the centre a unit of load (3,); zeros where none was fitted.
    covariance
        Of ``centre, shape (xx, yy, zz, xy, xz, yz)[, load]``, (9, 9) or (12, 12), from the scatter about the surface and how it
        correlates in time.
    sigma
        Standard deviation of the vectors about the surface, along its normal [unit].
    weights
        Of each vector (n,), 1 where it is used fully, 0 where it is an outlier.
    residuals
        Distance of each vector from the surface to first order (n,) [unit].
    independent
        Share of the samples that are independent, from the correlation of successive residuals.
    stretches
        Number of stretches of the record that the covariance rests on; the number of samples where they do not correlate.
    """

    centre: FloatArray
    shape: FloatArray
    load: FloatArray
    covariance: FloatArray
    sigma: float
    weights: FloatArray
    residuals: FloatArray
    independent: float
    stretches: float

    def __call__(self, m: FloatArray, u: FloatArray | float = 0.0) -> FloatArray:
        """Vectors (n, 3) on the unit sphere, at loads (n,)."""
        return np.asarray((m - self.centre - np.multiply.outer(np.broadcast_to(u, len(m)), self.load)) @ self.shape.T)


def fit(m: FloatArray, method: str = "sampson", load: FloatArray | None = None, *, robust: bool = True) -> Ellipsoid:
    """Fit an ellipsoid to vectors.

    Parameters
    ----------
    m
        Vectors (n, 3), in order of time where the correlation of successive residuals is to count.
    method
        One of `METHODS`. The first three solve D^T D a = λ B a (theory.md eq 26-29, theory-amendments.md §6).
    load
        Load (n,) whose influence on the centre is estimated too; only with ``sampson``.
    robust
        Weigh down and leave out vectors far from the surface.

    Returns
    -------
    Ellipsoid
        With the covariance of the least Sampson distance at the solution, whatever the method.

    Raises
    ------
    HaltereError
        Vectors that fix no ellipsoid: too few, all in a plane, or on an open surface.
    UsageError
        An unknown method.

    Notes
    -----
    Li and Griffiths, "Least squares ellipsoid specific fitting", GMP 2004, for B; Sampson's distance as in theory.md §4.2.
    """
    if method not in METHODS:
        raise UsageError(f"a method: {', '.join(METHODS)}", repr(method), "--method", nearest(method, METHODS))
    m = np.asarray(m, dtype=np.float64)
    if m.ndim != 2 or m.shape[1] != 3 or not np.isfinite(m).all():
        raise HaltereError(
            "finite vectors of shape (n, 3)", f"shape {m.shape}" if m.ndim != 2 or m.shape[1] != 3 else "some not finite", "fit"
        )
    if len(m) < FEWEST:
        raise HaltereError(f"at least {FEWEST} vectors", f"{len(m)}", "fit", "turn the sensor through all directions while recording")
    middle = m.mean(axis=0)
    size = math.sqrt(float(np.mean(np.sum((m - middle) ** 2, axis=1))))
    if not size > 1e-9 * float(np.max(np.abs(m))):
        raise HaltereError("vectors that differ", f"{len(m)} of one value", "fit", "turn the sensor through all directions while recording")
    x = (m - middle) / size
    u = np.zeros(0)
    low = unit = 0.0
    if load is not None:
        low, unit = float(np.mean(load)), float(np.std(load)) or 1.0
        u = (load - low) / unit
    p, w = _solve(x, method if load is None else "sampson", u, robust)
    r, J = _residuals(p, x, u)
    sigma = _scale(r, w, len(p)) if robust else math.sqrt(float(r @ r) / (len(r) - len(p)))
    scores = J * (w * r)[:, None]
    information = (J * w[:, None]).T @ J
    if np.linalg.cond(information) > 1e16:
        raise _flat()
    inverse = np.linalg.inv(information)
    time = correlation_time(r * w)
    spectral, stretches = _spectral(scores, information * sigma * sigma, time)
    cov = inverse @ spectral @ inverse
    independent = 1.0 / time
    # from scaled to given units: centre = middle + size p, shape = p / size, and the centre is moved to load zero
    T = np.zeros((len(p), len(p)))
    T[:3, :3] = size * np.eye(3)
    T[3:9, 3:9] = np.eye(6) / size
    shift = np.zeros(3)
    if load is not None:
        T[9:, 9:] = size / unit * np.eye(3)
        T[:3, 9:] = -low * size / unit * np.eye(3)
        shift = p[9:] * size / unit
    return Ellipsoid(
        middle + size * p[:3] - low * shift, _matrix(p[3:9]) / size, shift, T @ cov @ T.T, sigma * size, w, r * size, independent, stretches
    )


def _flat() -> HaltereError:
    return HaltereError(
        "vectors that fix an ellipsoid", "vectors in a plane, or too few directions", "fit",
        "turn the sensor through all directions: nose, tail, both sides, level and upside down, each with a full turn",
    )  # fmt: skip


def _matrix(s: FloatArray) -> FloatArray:
    return np.asarray(np.tensordot(s, BASIS, 1))


def _solve(x: FloatArray, method: str, u: FloatArray, robust: bool) -> tuple[FloatArray, FloatArray]:
    """Parameters and weights of centred and scaled vectors: start, then weights and solution in turn until they stay."""
    algebraic = "lg" if method == "sampson" else method
    w = np.ones(len(x))
    p = _start(x, algebraic, robust, method == "sampson")
    p = np.concatenate([p, np.zeros(3 if len(u) else 0)])
    if robust:
        w = _weights(_residuals(p, x, u)[0])
    for _ in range(30 if robust else 1):
        if method == "sampson":
            p = _gauss_newton(p, x, u, w)
        else:
            p = _algebraic(x, w, algebraic)
        if not robust:
            break
        before, w = w, _weights(_residuals(p, x, u)[0])
        if float(np.max(np.abs(w - before))) < 1e-3:
            break
    return p, w


def _start(x: FloatArray, method: str, robust: bool, refine: bool) -> FloatArray:
    """The algebraic fit of all vectors, or of those near a sphere that outliers do not move, whichever ends nearer to most of them.

    A sphere has four parameters, which a few vectors fix even where directions are missing; distortions are small beside it, outliers
    are not. Ellipsoids through few vectors are no start: where directions are missing they are wild.
    """
    if not robust:
        return _algebraic(x, np.ones(len(x)), method)
    x = x[:: max(1, len(x) // THINNED)]
    followed = []
    for w in (np.ones(len(x)), _near_sphere(x)):
        with contextlib.suppress(HaltereError):
            followed.append(_algebraic(x, w, method))
            if refine:
                followed.append(_gauss_newton(followed[-1], x, np.zeros(0), w))
    if not followed:
        raise _flat()
    for _ in range(ROUNDS):
        for k, p in enumerate(followed):
            w = _weights(_distances(p, x))
            with contextlib.suppress(HaltereError):
                followed[k] = _gauss_newton(p, x, np.zeros(0), w, 8) if refine else _algebraic(x, w, method)
    distances = [np.abs(_distances(p, x)) for p in followed]
    scale = max(1.4826 * min(float(np.median(d)) for d in distances), 1e-14)
    return followed[int(np.argmin([np.sum(np.minimum(d / scale, WEIGHT_TO) ** 2) for d in distances]))]


def _near_sphere(x: FloatArray) -> FloatArray:
    """Weight one for the vectors (n, 3) near the sphere that most of them are near to, zero for others."""
    rng = np.random.default_rng(len(x))  # the same log gives the same result
    D = np.column_stack([2.0 * x, np.ones(len(x))])
    squares = np.sum(x * x, axis=1)
    least, r = math.inf, np.zeros(len(x))

    def distances(rows: NDArray[Any]) -> FloatArray:
        a = np.linalg.lstsq(D[rows], squares[rows], rcond=None)[0]
        return np.asarray(np.linalg.norm(x - a[:3], axis=1) - math.sqrt(max(float(a[3] + a[:3] @ a[:3]), 0.0)))

    for _ in range(SUBSETS):
        found = distances(rng.choice(len(x), SUBSET, replace=False))
        for _ in range(2):
            found = distances(np.flatnonzero(np.abs(found) <= np.median(np.abs(found))))
        if (middle := float(np.median(np.abs(found)))) < least:
            least, r = middle, found
    return np.asarray(np.abs(r) <= WEIGHT_TO * 1.4826 * least + 1e-12, dtype=np.float64)


def _constraint(method: str) -> FloatArray:
    """B of a^T B a = 1 in the order x², y², z²[, xy, xz, yz] (theory-amendments.md §6)."""
    block = np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]])
    if method == "axis":
        return block
    B = np.zeros((6, 6))
    if method == "lg":
        B[:3, :3] = block
        B[3:, 3:] = -np.eye(3)
    else:  # 4ac - b² = 1
        B[0, 1] = B[1, 0] = 2.0
        B[3, 3] = -1.0
    return B


def _algebraic(x: FloatArray, w: FloatArray, method: str) -> FloatArray:
    """Centre and shape (9,) from the largest λ of D^T D a = λ B a, written as max a^T B a at |D a| = 1.

    The linear columns are taken out by least squares, which is the Schur complement without squaring its condition.
    """
    used = w > 0.0
    root = np.sqrt(w[used])[:, None]
    x1, x2, x3 = x[used].T
    squares = [x1 * x1, x2 * x2, x3 * x3] + ([] if method == "axis" else [x1 * x2, x1 * x3, x2 * x3])
    D1, D2 = root * np.column_stack(squares), root * np.column_stack([x1, x2, x3, np.ones(len(x1))])
    Q, R = np.linalg.qr(D2)
    if abs(R[-1, -1]) < 1e-9 * math.sqrt(len(x1)) or np.linalg.cond(R) > 1e9:
        raise _flat()
    T = Q.T @ D1
    _, s, Vt = np.linalg.svd(D1 - Q @ T, full_matrices=False)
    if not s[0] > 0.0 or (len(s) > 1 and s[-2] < 1e-12 * s[0]):
        raise _flat()
    L = Vt.T / np.maximum(s, 1e-15 * s[0])
    _, vectors = np.linalg.eigh(L.T @ _constraint(method) @ L)
    a1 = L @ vectors[:, -1]
    a2 = -np.linalg.solve(R, T @ a1)
    scale = float(np.max(np.abs(a1)))
    a1, a2 = a1 / scale, a2 / scale
    a, c, j = a1[:3]
    b, d, e = a1[3:] if method != "axis" else (0.0, 0.0, 0.0)
    A = np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, j]])
    values = np.linalg.eigvalsh(A)
    if values[0] * values[-1] <= 0.0 or abs(values).min() < 1e-12 * abs(values).max():
        raise _flat()
    centre = -0.5 * np.linalg.solve(A, a2[:3])  # eq 18-22
    level = float(centre @ A @ centre - a2[3])
    if not level * values[0] > 0.0:
        raise _flat()
    squared, axes = np.linalg.eigh(A / level)
    G = (axes * np.sqrt(squared)) @ axes.T
    return np.concatenate([centre, [G[i, k] for i, k in SYMMETRIC]])


def _distances(p: FloatArray, x: FloatArray) -> FloatArray:
    """Sampson's distance alone, of vectors without load."""
    G = _matrix(p[3:9])
    y = (x - p[:3]) @ G
    n = np.linalg.norm(y, axis=1)
    return np.asarray((n - 1.0) * n / np.maximum(np.linalg.norm(y @ G, axis=1), 1e-300))


def _residuals(p: FloatArray, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sampson's distance (n - 1) n / |G^T y|, y = G (x - b - k u), n = |y|, and its derivatives (n, 9 or 12)."""
    G = _matrix(p[3:9])
    d = x - p[:3]
    if len(u):
        d = d - np.outer(u, p[9:])
    y = d @ G.T
    n = np.linalg.norm(y, axis=1)
    g = y @ G  # G^T y
    h = np.linalg.norm(g, axis=1)
    n, h = np.maximum(n, 1e-300), np.maximum(h, 1e-300)
    r = (n - 1.0) * n / h
    unit_y, unit_g = y / n[:, None], g / h[:, None]
    first, second = (2.0 * n - 1.0) / h, (n * n - n) / (h * h)

    def derivative(dy: FloatArray, dG: FloatArray | None) -> FloatArray:
        dg = dy @ G if dG is None else dy @ G + y @ dG
        return np.asarray(first * np.sum(unit_y * dy, axis=1) - second * np.sum(unit_g * dg, axis=1))

    centre = [derivative(np.broadcast_to(-G[:, k], y.shape), None) for k in range(3)]
    shape = [derivative(d @ basis.T, basis) for basis in BASIS]
    loads = [u * c for c in centre] if len(u) else []
    return r, np.column_stack([*centre, *shape, *loads])


def _gauss_newton(p: FloatArray, x: FloatArray, u: FloatArray, w: FloatArray, most: int = 100) -> FloatArray:
    """Least weighted Sampson distance, with Levenberg's damping."""
    damping = 1e-6
    r, J = _residuals(p, x, u)
    cost = float(w @ (r * r))
    for _ in range(most):
        N, g = (J * w[:, None]).T @ J, J.T @ (w * r)
        step = np.linalg.lstsq(N + damping * np.diag(np.diag(N)), -g, rcond=None)[0]
        trial = p + step
        r2, J2 = _residuals(trial, x, u)
        cost2 = float(w @ (r2 * r2))
        closed = float(np.linalg.eigvalsh(_matrix(trial[3:9]))[0]) > 0.0
        if closed and math.isfinite(cost2) and cost2 <= cost:
            small = float(np.max(np.abs(step))) < 1e-13 or cost - cost2 <= 1e-13 * cost
            p, r, J, cost, damping = trial, r2, J2, cost2, max(damping / 10.0, 1e-12)
            if small and damping <= 1e-6:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return p


def _weights(r: FloatArray) -> FloatArray:
    """IGG-III weights by the median deviation; residuals at rounding are all kept."""
    s = max(1.4826 * float(np.median(np.abs(r))), 1e-14)
    z = np.abs(r) / s
    fall = np.clip((WEIGHT_TO - z) / (WEIGHT_TO - WEIGHT_FROM), 0.0, 1.0)
    return np.asarray(np.where(z <= WEIGHT_FROM, 1.0, WEIGHT_FROM / np.maximum(z, WEIGHT_FROM) * fall * fall))


@lru_cache(maxsize=1)
def _consistency() -> float:
    """E[w z²] / E[w] of a normal variable: what the weights take off its variance."""
    z = np.linspace(-8.0, 8.0, 20001)
    fall = np.clip((WEIGHT_TO - np.abs(z)) / (WEIGHT_TO - WEIGHT_FROM), 0.0, 1.0)
    w = np.where(np.abs(z) <= WEIGHT_FROM, 1.0, WEIGHT_FROM / np.maximum(np.abs(z), WEIGHT_FROM) * fall * fall) * norm.pdf(z)
    return float(np.sum(w * z * z) / np.sum(w))


def _scale(r: FloatArray, w: FloatArray, parameters: int) -> float:
    total = float(np.sum(w))
    return math.sqrt(float(w @ (r * r)) / max(total - parameters, 1.0) / _consistency())


def _spectral(scores: FloatArray, white: FloatArray, time: float) -> tuple[FloatArray, float]:
    """Covariance (p, p) of the sum of the scores (n, p) that correlate in time, and the number of stretches that it is from.

    It is never below ``white``, which takes them for independent.

    From the sums over stretches that overlap (Newey and West, 1987): what residuals have in common over time counts only as far as
    their derivatives have it in common too. Stretches are four correlation times long, and a tenth of the record at most.
    """
    n = len(scores)
    length = int(min(max(4.0 * time, 1.0), max(n / 10.0, 1.0)))
    if time < 1.5 or length < 2:
        return white, float(n)
    total = np.concatenate([np.zeros((1, scores.shape[1])), np.cumsum(scores, axis=0)])
    sums = total[length:] - total[:-length]
    # what the finite stretch misses, what a record of few correlation times cannot show, and what the fitted parameters take off
    missed = (1.0 + time / length) * max(1.0, 4.0 * time / length) * (1.0 + scores.shape[1] * length / n)
    S = sums.T @ sums / length * missed
    values, vectors = np.linalg.eigh(_whitened(S, white))
    L = np.linalg.cholesky(white)
    return np.asarray(L @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ L.T), n / length


def _whitened(S: FloatArray, white: FloatArray) -> FloatArray:
    """L^-1 S L^-T with white = L L^T."""
    L = np.linalg.cholesky(white)
    half = np.linalg.solve(L, S)
    return np.asarray(np.linalg.solve(L, half.T))


def correlation_time(r: FloatArray) -> float:
    """Samples a piece of independent information takes: 1 + 2 Σ ρ over the first lags whose sum of two is positive (C. J. Geyer, 1992)."""
    n = len(r)
    r = r - np.mean(r)
    power = float(r @ r)
    if n < 8 or not power > 0.0:
        return 1.0
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(r, size)
    rho = np.fft.irfft(spectrum * np.conj(spectrum), size)[: n // 3] / power
    pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    kept = pairs[: int(ends[0])] if len(ends) else pairs
    return max(1.0, 2.0 * float(np.sum(kept)) - 1.0)
