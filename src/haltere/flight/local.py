"""Geodetic to local coordinates and back for whole columns, with radii from pymap3d. Kernels have their own scalar form (core.earth)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["geodetic_from_local", "local_from_geodetic"]

FloatArray = NDArray[np.float64]


def local_from_geodetic(
    lat: FloatArray, lon: FloatArray, alt: FloatArray, lat0: float, lon0: float, alt0: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position north, east, down [m] from the origin along the curves of the WGS-84 ellipsoid (degrees, metres)."""
    from pymap3d.rcurve import meridian, transverse

    m, n = float(meridian(lat0)), float(transverse(lat0))
    dlon = (np.asarray(lon) - lon0 + 180.0) % 360.0 - 180.0
    north = np.radians(np.asarray(lat) - lat0) * (m + alt0)
    east = np.radians(dlon) * (n + alt0) * np.cos(np.radians(0.5 * (np.asarray(lat) + lat0)))
    return north, east, alt0 - np.asarray(alt)


def geodetic_from_local(
    north: FloatArray, east: FloatArray, down: FloatArray, lat0: float, lon0: float, alt0: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude [deg] and altitude [m]: inverse of `local_from_geodetic`."""
    from pymap3d.rcurve import meridian, transverse

    m, n = float(meridian(lat0)), float(transverse(lat0))
    lat = lat0 + np.degrees(north / (m + alt0))
    return lat, lon0 + np.degrees(east / ((n + alt0) * np.cos(np.radians(0.5 * (lat + lat0))))), alt0 - down
