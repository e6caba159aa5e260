"""One model of drag in the terms of another: with which parameters that comes nearest over the air velocities flown. It fits no data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haltere.identify.fitting import Result, load_of
from haltere.identify.forms import FORMS, drag_force, drag_slopes

__all__ = ["Projection", "project"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Windows between which the misfit of one form to another is taken as independent [s].
STRETCH = 7.0


@dataclass
class Projection:
    """Parameters of a form that comes nearest to a fitted one.

    Attributes
    ----------
    form, values, covariance
        Name, parameters and covariance: the fit's, and what the two forms differ by. Parameters not used are zero.
    free
        Which parameters are used.
    misfit
        Root mean square of what the forms differ by over the flights [m/s^2].
    """

    form: str
    values: FloatArray
    covariance: FloatArray
    free: BoolArray
    misfit: float

    @property
    def sd(self) -> FloatArray:
        """1 sigma of the parameters."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


def project(base: Result, form: str, free: BoolArray | None = None) -> Projection:
    """Least squares of a form on the force that a fitted one gives at the flights' air velocities, gusts included."""
    k = len(FORMS[form].names)
    free = np.ones(k, bool) if free is None else free
    columns: list[FloatArray] = []
    slopes: list[FloatArray] = []
    forces: list[FloatArray] = []
    stretches: list[FloatArray] = []
    for i, part in enumerate(base.parts):
        s = part.samples
        wind = np.zeros((len(s.t), 3))
        wind[:, :2] = part.wind_path
        v = np.einsum("kji,kj->ki", s.C_nb, s.vel_n - wind)
        X, _ = drag_slopes(form, np.zeros(k), v, load_of(form, s), s.density)
        by_p, _ = drag_slopes(base.form, base.values, v, load_of(base.form, s), s.density)
        columns.append(X[:, :, free].reshape(2 * len(s.t), -1))
        slopes.append(by_p.reshape(2 * len(s.t), -1))
        forces.append(drag_force(base.form, base.values, v, load_of(base.form, s), s.density).ravel())
        stretches.append(np.repeat(1000.0 * i + np.floor((s.t - s.t[0]) / STRETCH), 2))
    X, B, f, stretch = np.concatenate(columns), np.concatenate(slopes), np.concatenate(forces), np.concatenate(stretches)
    inverse = np.linalg.pinv(X.T @ X, hermitian=True)
    p = inverse @ (X.T @ f)
    left = f - X @ p
    J = inverse @ (X.T @ B)
    spread = np.zeros((len(p), len(p)))
    for b in np.unique(stretch):
        g = inverse @ (X[stretch == b].T @ left[stretch == b])
        spread += np.outer(g, g)
    values, cov = np.zeros(k), np.zeros((k, k))
    values[free] = p
    cov[np.ix_(free, free)] = J @ base.covariance @ J.T + spread
    return Projection(form, values, cov, free, float(np.sqrt(np.mean(left**2))))
