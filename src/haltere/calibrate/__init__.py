"""Calibration of sensors from their own log: the magnetometer. It corrects no flight; `haltere.flight.corrections` does."""

from haltere.calibrate.autopilots import ardupilot_parameters, px4_parameters
from haltere.calibrate.ellipsoid import METHODS, Ellipsoid, fit
from haltere.calibrate.magnetometer import CoverageError, MagnetometerCalibration, calibrate_magnetometer

__all__ = [
    "METHODS", "CoverageError", "Ellipsoid", "MagnetometerCalibration", "ardupilot_parameters", "calibrate_magnetometer", "fit",
    "px4_parameters",
]  # fmt: skip
