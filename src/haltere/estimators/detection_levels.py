"""Levels of the detection filters of `fault-tolerant`, from a wanted rate of false alarms (theory-amendments.md 5). It looks at no flight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haltere.filter.windows import glr_level, sample_level
from haltere.flight.config import Config

__all__ = ["COLOUR", "COLOUR_SNAPSHOT", "COMPONENTS", "SAMPLES", "detection_levels"]

FloatArray = NDArray[np.float64]

#: Components of the residual of each detection filter, in the order of `haltere.diagnosis.truth_table.DETECTORS`.
COMPONENTS = (1, 1, 1, 1, 1, 1, 1, 3, 1, 3, 1, 3, 1, 3)
#: Samples a second that are expected of what J21-J24 and J31-J34 hear: compass, GNSS velocity, barometer, GNSS position.
SAMPLES = (50.0, 10.0, 25.0, 10.0)
#: Factors for residuals that are not white and not of unit variance; of windows, and of single residuals.
COLOUR = np.array([1.2, 1.2, 1.1, 1.8, 1.8, 1.6, 0.6, 1.8, 0.6, 1.5, 1.6, 1.3, 0.6, 1.5])
COLOUR_SNAPSHOT = np.ones(14)


def detection_levels(config: Config) -> tuple[FloatArray, FloatArray]:
    """Level of each detection filter (14,), and the correlation of neighbouring residuals that is taken out before (14,)."""
    fast = 1.0 / config.number("fault_tolerant.step")
    total = 6.0 * fast + 2.0 * sum(SAMPLES)
    rate = config.number("diagnosis.false_alarms")
    if config["fault_tolerant.detector"] == "snapshot":
        plain = [sample_level(rate / (3600.0 * total), d) for d in COMPONENTS]
        return np.array(plain) * COLOUR_SNAPSHOT, np.zeros(14)
    return np.array([glr_level(rate, total, d) for d in COMPONENTS]) * COLOUR, np.zeros(14)
