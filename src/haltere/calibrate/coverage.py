"""How much of the sphere of directions was seen, and what the fit's uncertainty means for headings. It fits nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["AZIMUTHS", "BANDS", "HEADINGS", "Coverage", "coverage", "heading_errors", "heading_sd", "level_fields"]

FloatArray = NDArray[np.float64]

#: Cells of equal area on the sphere: around the vertical of the sensor, and from its top to its bottom.
AZIMUTHS, BANDS = 12, 6
#: Headings at which errors are given [rad].
HEADINGS = np.radians(np.arange(0.0, 360.0, 5.0))
#: Directions of the sensor's axes in words, for what is missing.
POLES = (
    ("forward", (1.0, 0.0, 0.0)), ("back", (-1.0, 0.0, 0.0)), ("right", (0.0, 1.0, 0.0)), ("left", (0.0, -1.0, 0.0)),
    ("down", (0.0, 0.0, 1.0)), ("up", (0.0, 0.0, -1.0)),
)  # fmt: skip


@dataclass(frozen=True)
class Coverage:
    """Directions of the field in the sensor's axes.

    Attributes
    ----------
    eigenvalues
        Of the scatter of the unit directions about their mean, ascending; 1/3 each for the whole sphere evenly.
    cells
        Number of samples a cell (BANDS, AZIMUTHS): bands of equal area from up (z = -1) to down (z = 1), azimuth from forward to right.
    share
        Share of the cells with a sample.
    missing
        Words of the axes that no direction came within 45 degrees of.
    """

    eigenvalues: FloatArray
    cells: FloatArray
    share: float
    missing: tuple[str, ...]


def coverage(directions: FloatArray) -> Coverage:
    """Coverage of unit vectors (n, 3)."""
    d = directions / np.maximum(np.linalg.norm(directions, axis=1), 1e-300)[:, None]
    scatter = np.cov(d.T, bias=True)
    band = np.clip(((d[:, 2] + 1.0) / 2.0 * BANDS).astype(int), 0, BANDS - 1)
    azimuth = np.floor(np.mod(np.arctan2(d[:, 1], d[:, 0]), 2.0 * math.pi) / (2.0 * math.pi) * AZIMUTHS).astype(int) % AZIMUTHS
    cells = np.zeros((BANDS, AZIMUTHS))
    np.add.at(cells, (band, azimuth), 1.0)
    missing = tuple(name for name, pole in POLES if float(np.max(d @ np.array(pole))) < math.cos(math.pi / 4.0))
    return Coverage(np.maximum(np.linalg.eigvalsh(scatter), 0.0), cells, float(np.mean(cells > 0.0)), missing)


def level_fields(strength: float, dip: float, headings: FloatArray = HEADINGS) -> FloatArray:
    """Field (n, 3) in the body of a level vehicle at magnetic headings (n,) [rad]."""
    along, down = strength * math.cos(dip), strength * math.sin(dip)
    return np.column_stack([along * np.cos(headings), -along * np.sin(headings), np.full(len(headings), down)])


def heading_errors(measured: FloatArray, headings: FloatArray = HEADINGS) -> FloatArray:
    """Magnetic heading of measured fields (n, 3) of a level vehicle minus the true one, -pi to pi."""
    off = np.arctan2(-measured[:, 1], measured[:, 0]) - headings
    return np.asarray(np.mod(off + math.pi, 2.0 * math.pi) - math.pi)


def heading_sd(
    matrix: FloatArray, covariance: FloatArray, fields: FloatArray, load: float = 0.0, mounting: FloatArray | None = None
) -> FloatArray:
    """1 sigma of the heading (n,) [rad] of a level vehicle from the covariance of a calibration ``m = A (m_raw - b - k u)``.

    Parameters
    ----------
    matrix
        A (3, 3).
    covariance
        Of b (3), A by rows (9) and k (3): (15, 15).
    fields
        True fields (n, 3) in the body.
    load
        Load u at which it is wanted.
    mounting
        Matrix (3, 3) from the sensor's axes to the body.
    """
    C = np.eye(3) if mounting is None else mounting
    raw = np.linalg.solve(matrix, (fields @ C).T).T  # m_raw - b - k u
    flat = fields[:, 0] ** 2 + fields[:, 1] ** 2
    # heading = atan2(-y, x): its derivative by the field in the body
    slope = np.column_stack([fields[:, 1], -fields[:, 0], np.zeros(len(fields))]) / flat[:, None] @ C
    J = np.zeros((len(fields), 15))
    J[:, :3] = -slope @ matrix
    J[:, 3:12] = (slope[:, :, None] * raw[:, None, :]).reshape(-1, 9)
    J[:, 12:] = load * J[:, :3]
    return np.asarray(np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, covariance, J), 0.0)))
