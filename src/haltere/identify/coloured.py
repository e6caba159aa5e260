"""Least squares under coloured noise: white noise and exponentially correlated paths seen through a matrix. It knows no vehicle.

The paths are eliminated exactly: with the precision Λ of paths and measurements, which is banded, Σ⁻¹ = (1 - H Λ⁻¹ Hᵀ/σ²)/σ² for the
covariance Σ of everything random, and log|Σ| follows from the same factor. Time and room grow with the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

__all__ = ["Coloured"]

FloatArray = NDArray[np.float64]


@dataclass
class Coloured:
    """Covariance of m measurements at each of n times: ``y = H_k g_k + white``, paths g exponentially correlated in time.

    Attributes
    ----------
    H
        How the paths are seen (n, m, l).
    variance, time
        Of each path (l,): stationary variance and correlation time [s].
    noise
        Variance of the white noise.
    log_det
        Logarithm of the determinant of the covariance.
    """

    H: FloatArray
    variance: FloatArray
    time: FloatArray
    noise: float
    log_det: float
    _factor: FloatArray

    @classmethod
    def of(cls, t: FloatArray, H: FloatArray, variance: FloatArray, time: FloatArray, noise: float) -> Coloured:
        """The covariance at times t (n,) [s], rising; gaps are what they are."""
        n, m, l = H.shape
        decay = np.exp(-np.diff(t)[:, None] / time)  # (n - 1, l)
        q = 1.0 / (variance * np.maximum(1.0 - decay * decay, 1e-12))
        diagonal = np.zeros((n, l))
        diagonal[0] = 1.0 / variance
        diagonal[1:] += q
        diagonal[:-1] += q * decay * decay
        band = np.zeros((l + 1, n * l))
        inner = np.einsum("kmi,kmj->kij", H, H) / noise
        for i in range(l):
            band[0, i::l] = diagonal[:, i] + inner[:, i, i]
            for j in range(i):
                band[i - j, j::l] = inner[:, i, j]
            band[l, i : (n - 1) * l : l] = -q[:, i] * decay[:, i]
        factor = cholesky_banded(band, lower=True, check_finite=False)
        prior = np.sum(np.log(variance)) - np.sum(np.log(q))
        log_det = 2.0 * float(np.sum(np.log(factor[0]))) + float(prior) + n * m * float(np.log(noise))
        return cls(H, variance, time, noise, log_det, factor)

    def paths(self, r: FloatArray) -> FloatArray:
        """Most likely paths (n, l) given residuals (n, m)."""
        n, _, l = self.H.shape
        b = np.einsum("kmi,km->ki", self.H, r) / self.noise
        return np.asarray(cho_solve_banded((self._factor, True), b.reshape(n * l), check_finite=False)).reshape(n, l)

    def weigh(self, X: FloatArray) -> FloatArray:
        """Σ⁻¹ X of columns (n, m, p)."""
        n, _, l = self.H.shape
        p = X.shape[2]
        b = np.einsum("kmi,kmp->kip", self.H, X).reshape(n * l, p) / self.noise
        g = cho_solve_banded((self._factor, True), b, check_finite=False).reshape(n, l, p)
        return np.asarray((X - np.einsum("kmi,kip->kmp", self.H, g)) / self.noise)
