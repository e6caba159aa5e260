"""The Earth's magnetic field at a place and date from the World Magnetic Model. It calibrates nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date, datetime

__all__ = ["Field", "decimal_year", "earth_field"]


@dataclass(frozen=True)
class Field:
    """Declination (east positive) and dip (down positive) [rad], strength [uT], and where they are from."""

    declination: float
    dip: float
    strength: float
    source: str


def decimal_year(utc: str | None) -> float | None:
    """Year with fraction of an ISO 8601 time, or None where there is none."""
    if not utc:
        return None
    try:
        when = datetime.fromisoformat(utc.replace("Z", "+00:00")).date()
    except ValueError:
        return None
    days = (date(when.year + 1, 1, 1) - date(when.year, 1, 1)).days
    return when.year + (when.timetuple().tm_yday - 1) / days


def earth_field(lat: float, lon: float, alt: float, year: float | None) -> Field:
    """Field of the World Magnetic Model.

    Parameters
    ----------
    lat, lon
        Place [deg].
    alt
        Altitude [m].
    year
        Decimal year; outside the models at hand (or None) the nearest year they cover stands in, which costs less than
        0.2 deg of declination a year.
    """
    from pygeomag import GeoMag

    # coefficient files cover five years each
    known = ((2010.0, "wmm/WMM_2010.COF"), (2015.0, "wmm/WMM_2015v2.COF"), (2020.0, "wmm/WMM_2020.COF"), (2025.0, "wmm/WMM_2025.COF"))
    wanted = 2025.0 if year is None else year
    wanted = min(max(wanted, known[0][0]), known[-1][0] + 4.99)
    name = [file for start, file in known if wanted >= start][-1]
    result = GeoMag(coefficients_file=name).calculate(glat=lat, glon=lon, alt=alt / 1000.0, time=wanted)
    return Field(math.radians(result.d), math.radians(result.i), result.f / 1000.0, f"World Magnetic Model, {wanted:.2f}")
