"""Units that logs come in, by the unit they become. It knows words and factors, and no columns."""

from __future__ import annotations

import numpy as np

__all__ = ["ALIASES", "UNITS", "factor", "unit_word"]

#: Factor and offset to the schema's unit, by that unit and the unit of the source: value = factor * source + offset.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "s": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "us": (1e-6, 0.0), "ns": (1e-9, 0.0)},
    "rad/s": {"rad/s": (1.0, 0.0), "deg/s": (np.pi / 180.0, 0.0), "mrad/s": (1e-3, 0.0), "rpm": (2.0 * np.pi / 60.0, 0.0)},
    "m/s^2": {"m/s^2": (1.0, 0.0), "g": (9.80665, 0.0), "mg": (9.80665e-3, 0.0)},
    "uT": {"uT": (1.0, 0.0), "mT": (1e3, 0.0), "T": (1e6, 0.0), "nT": (1e-3, 0.0), "G": (100.0, 0.0), "mG": (0.1, 0.0)},
    "Pa": {"Pa": (1.0, 0.0), "hPa": (100.0, 0.0), "mbar": (100.0, 0.0), "kPa": (1e3, 0.0)},
    "deg": {"deg": (1.0, 0.0), "rad": (180.0 / np.pi, 0.0), "1e-7deg": (1e-7, 0.0)},
    "rad": {"rad": (1.0, 0.0), "deg": (np.pi / 180.0, 0.0), "mrad": (1e-3, 0.0)},
    "m": {"m": (1.0, 0.0), "mm": (1e-3, 0.0), "cm": (1e-2, 0.0), "km": (1e3, 0.0), "ft": (0.3048, 0.0)},
    "m/s": {"m/s": (1.0, 0.0), "cm/s": (1e-2, 0.0), "mm/s": (1e-3, 0.0), "km/h": (1.0 / 3.6, 0.0), "kt": (1852.0 / 3600.0, 0.0)},
    "V": {"V": (1.0, 0.0), "mV": (1e-3, 0.0)},
    "A": {"A": (1.0, 0.0), "mA": (1e-3, 0.0)},
    "degC": {"degC": (1.0, 0.0), "K": (1.0, -273.15)},
    "1": {"1": (1.0, 0.0), "%": (1e-2, 0.0)},
    "1/s": {"1/s": (1.0, 0.0)},
    "1/m": {"1/m": (1.0, 0.0)},
}
ALIASES = {
    **{"µs": "us", "μs": "us", "µT": "uT", "μT": "uT", "°": "deg", "°/s": "deg/s", "dps": "deg/s", "°C": "degC", "C": "degC"},
    **{"m/s2": "m/s^2", "m/s²": "m/s^2", "m/s/s": "m/s^2", "gauss": "G", "mgauss": "mG", "milligauss": "mG", "tesla": "T"},
    **{"degE7": "1e-7deg", "knots": "kt", "-": "1"},
}


def unit_word(text: str) -> str:
    """The word of the table that a unit is written with, or the text itself."""
    return ALIASES.get(text, text)


def factor(schema_unit: str, unit: str) -> float:
    """What a value in ``unit`` is multiplied by to be in the schema's unit, of units without an offset."""
    return UNITS[schema_unit][unit_word(unit)][0]
