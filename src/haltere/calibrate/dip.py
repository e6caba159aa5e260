"""The rotation that an ellipsoid leaves open, from gravity: the dip of the field is the same at every attitude. It fits no ellipsoid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from haltere.calibrate.ellipsoid import BASIS, Ellipsoid, correlation_time

__all__ = ["PRIOR", "Turn", "turn"]

FloatArray = NDArray[np.float64]

#: 1 sigma of the residual rotation about each axis before the flight is looked at [rad]: mounting and soft iron turn by a degree or two.
PRIOR = math.radians(2.0)
#: 1 sigma of the dip of the World Magnetic Model at a place [rad]: 0.2 deg of the model, the rest local.
DIP_SD = math.radians(0.5)
#: 1 sigma of what stays wrong with gravity's direction for a whole flight, an axis of the body [rad]: an accelerometer bias of 0.09 m/s².
GRAVITY_SD = math.radians(0.5)
FEWEST = 50
#: Sine of the dip beyond which nothing is made of it (87 deg).
STEEP = 0.9986


@dataclass(frozen=True)
class Turn:
    """Rotation from the ellipsoid's symmetric axes to the IMU's, as found from gravity.

    Attributes
    ----------
    vector
        Rotation vector (3,) [rad].
    covariance
        Of it (3, 3), with what comes from the ellipsoid.
    cross
        Covariance with the ellipsoid's parameters (3, 9 or 12).
    dip, dip_sd
        Dip of the field over the flight and its 1 sigma [rad].
    scatter_before, scatter_after
        Standard deviation of the dip sample by sample [rad].
    n
        Samples used.
    """

    vector: FloatArray
    covariance: FloatArray
    cross: FloatArray
    dip: float
    dip_sd: float
    scatter_before: float
    scatter_after: float
    n: int

    @property
    def matrix(self) -> FloatArray:
        """The rotation (3, 3)."""
        return np.asarray(Rotation.from_rotvec(self.vector).as_matrix())


def turn(ellipsoid: Ellipsoid, m: FloatArray, down: FloatArray, u: FloatArray | None = None, dip: float | None = None) -> Turn | None:
    """Find the rotation R that makes ``asin(down · R y) = dip`` hold best, y the unit vectors on the sphere.

    Parameters
    ----------
    ellipsoid
        The fit.
    m
        Vectors (n, 3), in order of time.
    down
        Unit vectors of gravity's direction (n, 3) in the sensor's axes, of a filter that does not use the magnetometer; NaN: unknown.
    u
        Loads (n,).
    dip
        Of the World Magnetic Model, used with 1 sigma of 0.5 deg.

    Returns
    -------
    Turn or None
        None below fifty samples with gravity.

    Notes
    -----
    A level vehicle that only yaws says nothing of the rotation about gravity: what the flight does not tell stays at zero with the
    assumed 1 sigma of 2 deg about each axis (`PRIOR`).
    """
    good = np.isfinite(down).all(axis=1) & (ellipsoid.weights > 0.0)
    if int(good.sum()) < FEWEST:
        return None
    loads = np.zeros(len(m)) if u is None else u
    m, g, loads = m[good], down[good], loads[good]
    y = ellipsoid(m, loads)
    n = np.linalg.norm(y, axis=1)
    y = y / n[:, None]
    sine = np.clip(np.sum(g * y, axis=1), -1.0, 1.0)
    R = np.eye(3)
    prior = np.diag([PRIOR**-2] * 3 + [0.0 if dip is None else DIP_SD**-2] + [GRAVITY_SD**-2] * 3)
    first = np.zeros(7)  # rotation, dip, and what is wrong with gravity
    first[3] = dip if dip is not None else float(np.median(np.arcsin(sine)))
    x = first.copy()
    w = np.ones(len(m))
    sigma = independent = 1.0
    cosine = np.ones(len(m))
    N = prior
    J = np.empty((len(m), 7))
    for _ in range(20):
        R = Rotation.from_rotvec(x[:3]).as_matrix()
        z = y @ R.T
        sine_z = np.clip(np.sum(g * z, axis=1), -STEEP, STEEP)
        cosine = np.sqrt(1.0 - sine_z * sine_z)
        # an angle: the sine would find a steep field better than a flat one, whatever the data
        tilted = (z - sine_z[:, None] * g) / cosine[:, None]
        r = np.arcsin(sine_z) - x[3] + tilted @ x[4:]
        middle = float(np.median(r))
        sigma = max(1.4826 * float(np.median(np.abs(r - middle))), 1e-6)
        w = np.minimum(1.0, 2.5 / np.maximum(np.abs(r - middle) / sigma, 1e-12))  # Huber
        sigma = max(math.sqrt(float(w @ (r * r)) / float(np.sum(w))), 1e-6)
        independent = 1.0 / correlation_time(r)
        # by a small rotation on the left, the dip, and the error of gravity
        J = np.column_stack([np.cross(z, g) / cosine[:, None], -np.ones(len(z)), tilted])
        scale = independent / (sigma * sigma)
        N = scale * (J * w[:, None]).T @ J + prior
        step = np.linalg.solve(N, -(scale * J.T @ (w * r) + prior @ (x - first)))
        x[:3] = (Rotation.from_rotvec(step[:3]) * Rotation.from_rotvec(x[:3])).as_rotvec()
        x[3:] += step[3:]
        if float(np.max(np.abs(step))) < 1e-9:
            break
    # what the ellipsoid's errors do to it: dx = -N^-1 J^T W ∂r/∂θ dθ
    inverse = np.linalg.inv(_without_noise(N - prior, y @ R.T, w / cosine**2, independent) + prior)
    onto = (g @ R - np.sum((g @ R) * y, axis=1)[:, None] * y) / (n * cosine)[:, None]  # by y before it has unit length
    d = m - ellipsoid.centre - np.outer(loads, ellipsoid.load)
    by = [-onto @ ellipsoid.shape, np.column_stack([np.sum(onto * (d @ b.T), axis=1) for b in BASIS])]
    if len(ellipsoid.covariance) > 9:
        by.append(loads[:, None] * by[0])
    K = -(inverse @ (independent / (sigma * sigma) * (J * w[:, None]).T @ np.column_stack(by)))
    P = inverse + K @ ellipsoid.covariance @ K.T
    after = np.sum(g * (y @ R.T), axis=1)
    return Turn(
        x[:3], P[:3, :3], K[:3] @ ellipsoid.covariance, float(x[3]), math.sqrt(P[3, 3]), _scatter(sine), _scatter(after), len(m),
    )  # fmt: skip


def _without_noise(N: FloatArray, z: FloatArray, w: FloatArray, independent: float) -> FloatArray:
    """Information (7, 7) less what noise of gravity makes of itself: it moves the derivatives too, by as much as the residuals.

    A rotation of which the attitudes tell nothing would seem to be known by the noise alone.
    """
    own = independent * (np.sum(w) * np.eye(3) - (z * w[:, None]).T @ z)
    out = N.copy()
    out[:3, :3] -= own
    values, vectors = np.linalg.eigh(out)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _scatter(sine: FloatArray) -> float:
    return float(np.std(np.arcsin(np.clip(sine, -1.0, 1.0))))
