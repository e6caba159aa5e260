"""Gravity and the local tangent frame on the WGS-84 ellipsoid, and the standard atmosphere. No magnetic field (see flight.field)."""

from __future__ import annotations

import math

from haltere._jit import entry, jit

__all__ = [
    "STANDARD_DENSITY", "STANDARD_GRAVITY", "density", "geodetic_from_local", "gravity", "local_from_geodetic", "local_from_sphere",
    "pressure_altitude", "radii",
]  # fmt: skip

#: Gravity [m/s^2] where no position is known.
STANDARD_GRAVITY = 9.80665
#: Density of the standard atmosphere at sea level [kg/m^3].
STANDARD_DENSITY = 1.225
#: WGS-84 semi-major axis [m] and first eccentricity squared.
A_WGS84 = 6378137.0
E2_WGS84 = 6.69437999014e-3
#: Mean radius [m] of the spherical Earth.
R_SPHERE = 6371008.8
DEG = math.pi / 180.0


@entry
def gravity(lat: float, alt: float) -> float:
    """Normal gravity [m/s^2] at latitude [deg] and altitude [m] (Somigliana with free-air term, theory-amendments.md §8)."""
    s = math.sin(lat * DEG)
    s2 = s * s
    return 9.7803253359 * (1.0 + 0.00193185265241 * s2) / math.sqrt(1.0 - 0.00669437999013 * s2) - 3.086e-6 * alt


@jit
def radii(lat: float) -> tuple[float, float]:
    """Meridian and transverse radius of curvature [m] at latitude [deg]."""
    s = math.sin(lat * DEG)
    w2 = 1.0 - E2_WGS84 * (s * s)
    w = math.sqrt(w2)
    return A_WGS84 * (1.0 - E2_WGS84) / (w2 * w), A_WGS84 / w


@jit
def local_from_geodetic(lat: float, lon: float, alt: float, lat0: float, lon0: float, alt0: float) -> tuple[float, float, float]:
    """Position north, east, down [m] from the origin (degrees, metres), along the curves of the ellipsoid.

    Down is the difference of altitudes, so that it agrees with a barometer at any distance (theory.md §4.6, corrected sign).
    """
    m, n = radii(lat0)
    dlon = lon - lon0
    dlon -= 360.0 * math.floor((dlon + 180.0) / 360.0)
    return (
        (lat - lat0) * DEG * (m + alt0),
        dlon * DEG * (n + alt0) * math.cos(0.5 * (lat + lat0) * DEG),
        alt0 - alt,
    )


@jit
def local_from_sphere(lat: float, lon: float, lat0: float, lon0: float) -> tuple[float, float]:
    """Position north, east [m] from the origin (degrees) on a sphere by the haversine (theory.md §4.6, (7)-(8), reconstructed).

    P_N = R (B - B0), P_E = sgn(L - L0) 2 R asin(cos B |sin((L - L0)/2)|): the legs through the auxiliary point (B, L0). Against the
    ellipsoid their scale is wrong by -0.25 % to +0.15 % at 40 degrees of latitude.
    """
    dlon = lon - lon0
    dlon -= 360.0 * math.floor((dlon + 180.0) / 360.0)
    return R_SPHERE * (lat - lat0) * DEG, 2.0 * R_SPHERE * math.asin(math.cos(lat * DEG) * math.sin(0.5 * dlon * DEG))


@jit
def geodetic_from_local(north: float, east: float, down: float, lat0: float, lon0: float, alt0: float) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and altitude [m]: inverse of `local_from_geodetic`."""
    m, n = radii(lat0)
    lat = lat0 + north / (DEG * (m + alt0))
    return lat, lon0 + east / (DEG * (n + alt0) * math.cos(0.5 * (lat + lat0) * DEG)), alt0 - down


@jit
def pressure_altitude(pressure: float) -> float:
    """Altitude [m] of a pressure [Pa] in the standard atmosphere (theory-amendments.md §8)."""
    return 44330.77 * (1.0 - (pressure / 101325.0) ** 0.190263)


@jit
def density(alt: float) -> float:
    """Density [kg/m^3] of the standard atmosphere at an altitude [m], in the troposphere."""
    return STANDARD_DENSITY * max(1.0 - 2.25577e-5 * alt, 0.1) ** 4.25588
