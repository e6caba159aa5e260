"""Least squares with noise in the regressors: two readings of them with independent noise, as instruments for each other. No vehicle here.

With the readings a and b of the true columns x, the mean of aᵀb has no noise in it, while that of xᵀx from either alone has: ordinary
least squares finds constants too small. From A = (aᵀb + bᵀa)/2 and the mean reading both are used; their own difference tells the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Instrumented", "instrumented"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass
class Instrumented:
    """A fit.

    Attributes
    ----------
    k, covariance
        Constants (p,) and covariance, from how stretches of the data differ.
    plain
        Constants of ordinary least squares on the mean reading (p,).
    condition
        Condition number of the columns, each to its root mean square.
    noise
        Share of each column's power that is noise of the readings (p,).
    instruments
        Whether the instruments were used; ordinary least squares where noise swamps the columns.
    """

    k: FloatArray
    covariance: FloatArray
    plain: FloatArray
    condition: float
    noise: FloatArray
    instruments: bool

    @property
    def sd(self) -> FloatArray:
        """1 sigma of the constants."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


def instrumented(
    y: FloatArray, a: FloatArray, b: FloatArray, stretch: IntArray, mean: FloatArray | None = None, precision: FloatArray | None = None
) -> Instrumented:
    """Fit y = x k.

    Parameters
    ----------
    y
        Measurements (n,).
    a, b
        Two readings of the columns (n, p), their noise independent of each other.
    stretch
        Which stretch each row belongs to (n,); stretches are taken as independent, whatever the colour within.
    mean, precision
        What is thought of the constants before (p,), and one over its variance in the unit of the sum of squares: times the variance of
        what is left and the number of rows in a stretch. Nothing by default.
    """
    p = a.shape[1]
    x, d = 0.5 * (a + b), a - b
    size = np.sqrt(np.mean(x * x, axis=0))
    size[size == 0.0] = 1.0
    x, d = x / size, d / size
    prior = np.zeros(p) if precision is None else precision / size**2
    before = np.zeros(p) if mean is None else mean * size
    G, N = x.T @ x, 0.25 * (d.T @ d)
    plain = np.linalg.solve(G + np.diag(prior) + 1e-12 * np.eye(p), x.T @ y + prior * before)
    weakest = float(np.linalg.eigvalsh(G - N + np.diag(prior))[0])
    use = weakest > 0.1 * float(np.linalg.eigvalsh(G + np.diag(prior))[0])
    noise = N if use else np.zeros_like(N)
    A = G - noise + np.diag(prior)
    k = np.linalg.solve(A + 1e-12 * np.eye(p), x.T @ y + prior * before)
    e = y - x @ k
    psi = x * e[:, None] + (0.25 * d * (d @ k)[:, None] if use else 0.0)
    _, which = np.unique(stretch, return_inverse=True)
    groups = np.zeros((int(which.max()) + 1, p))
    np.add.at(groups, which, psi)
    n = len(groups)
    inverse = np.linalg.inv(A + 1e-12 * np.eye(p))
    spread = inverse @ (groups.T @ groups) @ inverse * (n / max(n - p, 1))
    # where the data tell nothing the prior stands, with its own width
    unit = float(np.var(e)) * len(y) / n
    covariance = spread + unit * inverse @ np.diag(prior) @ inverse
    eigen = np.linalg.eigvalsh(G / len(y))
    return Instrumented(
        k / size, covariance / np.outer(size, size), plain / size, float(np.sqrt(eigen[-1] / max(eigen[0], 1e-15))),
        np.asarray(np.diag(N) / np.maximum(np.diag(G), 1e-12)), bool(use),
    )  # fmt: skip
