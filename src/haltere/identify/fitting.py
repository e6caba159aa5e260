"""Fit of a drag model jointly with wind, offsets and the colour of what is left, over one or several flights. It judges nothing.

The force across the thrust axis is ``f = model(p, C_nbᵀ(v - W - g), T, ρ) + Z z + e + white``: a mean wind W a flight, gusts g
(exponentially correlated in NED), what the model leaves e (exponentially correlated in the body), and what else is in the force, linear:
an offset of either axis, its part that goes with the rate (rotors above or below the centre of gravity), the IMU's arm. Parameters are
found by iterated generalised least squares about the mean wind; sizes and times of g, e and the noise by restricted maximum likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, nnls

from haltere.errors import HaltereError
from haltere.identify.coloured import Coloured
from haltere.identify.forms import FORMS, drag_force, drag_slopes
from haltere.identify.prepare import Samples

__all__ = ["COLOUR", "Part", "Result", "fit", "load_of", "without_wind"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: 1 sigma before the flight: of the mean wind [m/s]; of an offset along x, y [m/s^2] (thrust axis 1.5 deg off, accelerometer bias), of
#: what goes with pitch and roll rate [m/s], of the IMU's arm [m].
WIND_SD = 10.0
ELSE_SD = (0.3, 0.3, 0.05, 0.05, 0.05, 0.05, 0.05)
N_ELSE = len(ELSE_SD)
N_OWN = N_ELSE + 2
#: Stretches whose agreement is looked at [s].
STRETCH = 7.0
#: Size of gusts [m/s], their time [s], size of what the model leaves [m/s^2], its time [s], white noise [m/s^2]: typical, and the factor
#: (natural logarithm, 1 sigma) by which a flight may differ.
COLOUR = np.log(np.array([0.5, 5.0, 0.03, 0.7, 0.05]))
COLOUR_SD = 1.2
#: Rounds between parameters and colour, and steps of least squares in each.
ROUNDS, STEPS = 4, 25


def load_of(form: str, s: Samples) -> FloatArray:
    """What a model's linear drag goes with: thrust per mass [m/s^2], or the sum of the rotor speeds [rad/s]."""
    if form not in ("rotors", "lumped"):
        return s.thrust
    if s.speed is None:  # whoever asks has looked
        raise HaltereError("rotor speeds through the flight", "none", s.name)
    return s.speed


@dataclass
class Part:
    """What belongs to one flight.

    Attributes
    ----------
    samples
        What was fitted.
    rest, wind
        What else is in the force, as `ELSE_SD` (7,), and mean wind towards north, east (2,) [m/s].
    paths
        Gusts north, east [m/s] and what the model leaves along x, y [m/s^2], most likely, (n, 4).
    colour
        Logarithms as `COLOUR`.
    residual
        What is left white (n, 2) [m/s^2].
    """

    samples: Samples
    rest: FloatArray = field(default_factory=lambda: np.zeros(N_ELSE))
    wind: FloatArray = field(default_factory=lambda: np.zeros(2))
    paths: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    colour: FloatArray = field(default_factory=COLOUR.copy)
    residual: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def sizes(self) -> FloatArray:
        """Gusts [m/s], their time [s], what the model leaves [m/s^2], its time [s], white noise [m/s^2]."""
        return np.asarray(np.exp(self.colour))

    @property
    def wind_path(self) -> FloatArray:
        """Wind towards north and east over the flight (n, 2) [m/s]."""
        return np.asarray(self.wind + self.paths[:, :2])


@dataclass
class Result:
    """A model fitted.

    Attributes
    ----------
    form, values, covariance
        Name, parameters and their covariance; fixed ones are zero with no variance. The covariance of everything, parameters first, then
        offsets and wind of each flight, is ``full``.
    log_sd
        1 sigma of the logarithm of the first parameter.
    free
        Which parameters were fitted.
    parts
        The flights.
    deviance
        -2 log of the restricted likelihood.
    inflation
        Factor on the covariance: how much more the stretches of the flights disagree about the parameters than the colour explains.
    """

    form: str
    values: FloatArray
    log_sd: float
    covariance: FloatArray
    full: FloatArray
    free: BoolArray
    parts: list[Part]
    deviance: float
    inflation: float
    steps: int
    converged: bool

    @property
    def sd(self) -> FloatArray:
        """1 sigma of the parameters."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def bic(self) -> float:
        """Bayesian information criterion; the parameters of the model count."""
        n = sum(2 * len(p.samples.t) for p in self.parts)
        return self.deviance + float(self.free.sum()) * float(np.log(n))

    def part_sd(self, k: int) -> FloatArray:
        """1 sigma of the rest and of wind n, e of flight k (9,)."""
        at = len(self.values) + N_OWN * k
        return np.asarray(np.sqrt(np.maximum(np.diag(self.full)[at : at + N_OWN], 0.0)))


@dataclass
class _Linear:
    """One flight's model about its current state: columns of p, the rest, wind; residual with gusts in it; covariance."""

    X: FloatArray
    r: FloatArray
    H: FloatArray
    cov: Coloured


def _linear(part: Part, form: str, p: FloatArray) -> _Linear:
    s = part.samples
    # About the mean wind: a slope taken at the most likely gusts would know of the residuals, and the drag would come out too large.
    v = np.einsum("kji,kj->ki", s.C_nb, s.vel_n - np.r_[part.wind, 0.0])
    by_p, by_v = drag_slopes(form, p, v, load_of(form, s), s.density)
    by_p[:, :, 0] *= p[0]  # the logarithm is what is fitted
    by_wind = -np.einsum("kmi,kji->kmj", by_v, s.C_nb)[:, :, :2]
    Z = _rest(s)
    r = s.force_b[:, :2] - drag_force(form, p, v, load_of(form, s), s.density) - Z @ part.rest
    H = np.concatenate([by_wind, Z[:, :, :2]], axis=2)
    return _Linear(np.concatenate([by_p, Z, by_wind], axis=2), r, H, _covariance(s.t, H, part.colour))


def _rest(s: Samples) -> FloatArray:
    """Columns (n, 2, 7) of what else is in the force along x and y: offsets, with pitch and roll rate, with the arm r.

    The arm gives ω̇ × r + ω × (ω × r).
    """
    Z = np.zeros((len(s.t), 2, N_ELSE))
    Z[:, 0, 0] = Z[:, 1, 1] = 1.0
    p, q, r = s.gyro_b.T
    Z[:, 0, 2], Z[:, 1, 3] = q, p
    dp, dq, dr = s.turn_b.T
    Z[:, 0, 4], Z[:, 0, 5], Z[:, 0, 6] = -(q * q + r * r), p * q - dr, p * r + dq
    Z[:, 1, 4], Z[:, 1, 5], Z[:, 1, 6] = p * q + dr, -(p * p + r * r), q * r - dp
    return Z


def _covariance(t: FloatArray, H: FloatArray, colour: FloatArray) -> Coloured:
    gust, gust_time, left, left_time, noise = np.exp(colour)
    return Coloured.of(
        t, H, np.array([gust, gust, left, left]) ** 2, np.array([gust_time, gust_time, left_time, left_time]), float(noise**2)
    )


def _prior(form: str, free: BoolArray, wind_sd: float = WIND_SD) -> tuple[FloatArray, FloatArray]:
    """Mean and precision of p, the first as logarithm, of the rest and the wind of a flight."""
    f = FORMS[form]
    mean = np.r_[np.log(f.prior[0]), np.array(f.prior[1:]), np.zeros(N_OWN)]
    sd = np.r_[np.array(f.scale), ELSE_SD, wind_sd, wind_sd]
    precision = 1.0 / sd**2
    precision[: len(free)][~free] = 1e18
    mean[: len(free)][~free] = 0.0
    return mean, precision


def _colour(lin: _Linear, t: FloatArray, start: FloatArray, precision: FloatArray) -> FloatArray:
    """Most likely colour by restricted likelihood, the model linear as it stands."""

    def cost(h: FloatArray) -> float:
        c = _covariance(t, lin.H, h)
        return 0.5 * _restricted(c, lin.X, lin.r, precision) + 0.5 * float(np.sum(((h - COLOUR) / COLOUR_SD) ** 2))

    bounds = [(c - 5.0, c + 4.0) for c in COLOUR]
    found = minimize(cost, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 40, "ftol": 1e-7})
    return np.asarray(found.x)


def _restricted(c: Coloured, X: FloatArray, r: FloatArray, precision: FloatArray) -> float:
    """-2 log of the restricted likelihood, but for constants."""
    both = np.concatenate([X, r[:, :, None]], axis=2)
    W = c.weigh(both)
    M = np.einsum("kmi,kmj->ij", both, W)
    S, s, q = M[:-1, :-1] + np.diag(precision), M[:-1, -1], M[-1, -1]
    L = np.linalg.cholesky(S)
    z = np.linalg.solve(L, s)
    return float(q - z @ z + c.log_det + 2.0 * np.sum(np.log(np.diag(L))) - np.sum(np.log(precision)))


def fit(form: str, flights: list[Samples], free: BoolArray | None = None, wind_sd: float = WIND_SD) -> Result:
    """Fit a model of `FORMS` to flights, each with its own wind, rest and colour.

    Parameters
    ----------
    form
        The model.
    flights
        Windows in the air.
    free
        Which parameters are fitted; the others are zero. Default: all.
    wind_sd
        1 sigma of the mean wind before the flight [m/s]: little where the air is known to be still.
    """
    k = len(FORMS[form].names)
    free = np.ones(k, bool) if free is None else free
    mean, precision = _prior(form, free, wind_sd)
    p = np.array(FORMS[form].prior)
    parts = [Part(s, paths=np.zeros((len(s.t), 4))) for s in flights]
    for part in parts:  # the force of the mean wind, so that the first step is near
        if wind_sd > 1.0:
            _start(part, form, p)
    steps, done = 0, False
    for round_ in range(ROUNDS):
        p, used, done = _solve(form, p, parts, mean, precision)
        steps += used
        if round_ == ROUNDS - 1:
            break
        before = [part.colour.copy() for part in parts]
        for part in parts:
            part.colour = _colour(_linear(part, form, p), part.samples.t, part.colour, precision)
        if round_ > 0 and all(np.max(np.abs(b - part.colour)) < 0.02 for b, part in zip(before, parts, strict=True)):
            p, used, done = _solve(form, p, parts, mean, precision)
            steps += used
            break
    return _result(form, p, free, parts, precision, steps, done)


def _start(part: Part, form: str, p: FloatArray) -> None:
    s = part.samples
    v = np.einsum("kji,kj->ki", s.C_nb, s.vel_n)
    left = s.force_b[:, :2] - drag_force(form, p, v, load_of(form, s), s.density)
    level = np.einsum("kij,kj->ki", s.C_nb[:, :, :2], left).mean(axis=0)
    part.wind = np.clip(level[:2] / 0.3, -8.0, 8.0)


def _solve(form: str, p: FloatArray, parts: list[Part], mean: FloatArray, precision: FloatArray) -> tuple[FloatArray, int, bool]:
    """Iterated least squares with the colour as it is; what belongs to the flights is set."""
    k = len(p)
    scale = 1.0 / np.sqrt(precision)
    for step in range(STEPS):
        lin = [_linear(part, form, p) for part in parts]
        S, s = _normal(lin, p, parts, mean, precision, k)
        d = np.linalg.solve(S, s)
        limit = np.max(np.abs(d) / np.r_[scale[:k], np.tile(np.r_[3.0 * np.array(ELSE_SD), 3.0, 3.0], len(parts))])
        d *= min(1.0, 1.0 / max(limit, 1e-12))
        p = np.r_[p[0] * np.exp(d[0]), p[1:] + d[1:k]]
        for i, (part, l) in enumerate(zip(parts, lin, strict=True)):
            own = d[k + N_OWN * i : k + N_OWN * (i + 1)]
            part.rest, part.wind = part.rest + own[:N_ELSE], part.wind + own[N_ELSE:]
            left = l.r - np.einsum("kmi,i->km", l.X, np.r_[d[:k], own])
            part.paths = l.cov.paths(left)
            part.residual = left - np.einsum("kmi,ki->km", l.H, part.paths)
        if limit < 2e-4:
            return p, step + 1, True
    return p, STEPS, False


def _normal(
    lin: list[_Linear], p: FloatArray, parts: list[Part], mean: FloatArray, precision: FloatArray, k: int
) -> tuple[FloatArray, FloatArray]:
    """Normal equations of all parameters: p, then the rest and wind of each flight."""
    n = k + N_OWN * len(parts)
    S, s = np.zeros((n, n)), np.zeros(n)
    S[:k, :k] = np.diag(precision[:k])
    s[:k] = precision[:k] * (mean[:k] - np.r_[np.log(p[0]), p[1:]])
    for i, (part, l) in enumerate(zip(parts, lin, strict=True)):
        at = np.r_[np.arange(k), np.arange(k + N_OWN * i, k + N_OWN * (i + 1))]
        W = l.cov.weigh(l.X)
        S[np.ix_(at, at)] += np.einsum("kmi,kmj->ij", l.X, W)
        s[at] += np.einsum("kmi,km->i", W, l.r)
        own = at[k:]
        S[own, own] += precision[k:]
        s[own] += precision[k:] * (mean[k:] - np.r_[part.rest, part.wind])
    return S, s


def _result(form: str, p: FloatArray, free: BoolArray, parts: list[Part], precision: FloatArray, steps: int, done: bool) -> Result:
    k = len(p)
    lin = [_linear(part, form, p) for part in parts]
    S, _ = _normal(lin, p, parts, np.zeros(k + N_OWN), precision, k)
    full: FloatArray = np.asarray(np.linalg.inv(S), dtype=np.float64)
    inflation = _inflation(full, lin, parts, free)
    full *= inflation
    log_sd = float(np.sqrt(full[0, 0]))
    full[0] *= p[0]
    full[:, 0] *= p[0]
    cov = full[:k, :k].copy()
    cov[~free] = 0.0
    cov[:, ~free] = 0.0
    deviance = sum(_restricted(l.cov, l.X, l.r, precision) for l in lin)
    return Result(form, np.where(free, p, 0.0), log_sd, cov, full, free, parts, float(deviance), inflation, steps, done)


def _inflation(full: FloatArray, lin: list[_Linear], parts: list[Part], free: BoolArray) -> float:
    """How much the scores of stretches of the flights vary more than they should: mean ratio over the free parameters, at least one."""
    k = len(free)
    gradients: list[FloatArray] = []
    for i, (part, l) in enumerate(zip(parts, lin, strict=True)):
        at = np.r_[np.arange(k), np.arange(k + N_OWN * i, k + N_OWN * (i + 1))]
        W = l.cov.weigh(l.X)
        left = l.r  # at the solution the whole sums to the pull of the prior, which is little
        terms = np.einsum("kmi,km->ki", W, left)
        t = part.samples.t
        stretch = np.minimum(np.floor((t - t[0]) / STRETCH), max(np.floor((t[-1] - t[0]) / STRETCH) - 1.0, 0.0))
        for b in np.unique(stretch):
            g = np.zeros(len(full))
            g[at] = terms[stretch == b].sum(axis=0)
            gradients.append(g)
    n = len(gradients)
    if n < 4:
        return 1.0
    G = np.array(gradients)
    spread = full @ (G.T @ G) @ full * n / max(n - 1.0, 1.0)
    ratio = float(np.mean(np.diag(spread)[:k][free] / np.diag(full)[:k][free]))
    return max(1.0, ratio)


def without_wind(form: str, flights: list[Samples]) -> FloatArray:
    """Parameters as a fit finds them that takes the air for still and the thrust axis for exact: least squares, none below zero.

    What PX4's published script for tuning its wind estimation assumes; for comparison only.
    """
    columns, forces = [], []
    k = len(FORMS[form].names)
    for s in flights:
        v = np.einsum("kji,kj->ki", s.C_nb, s.vel_n)
        X, _ = drag_slopes(form, np.zeros(k), v, load_of(form, s), s.density)
        columns.append(X.reshape(-1, k))
        forces.append(s.force_b[:, :2].ravel())
    found, _ = nnls(np.concatenate(columns), np.concatenate(forces))
    return np.asarray(found)
