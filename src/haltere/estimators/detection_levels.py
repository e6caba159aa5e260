"""Levels of the detection filters of `fault-tolerant` from a wanted rate of false alarms (theory-amendments.md 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haltere.filter.windows import glr_level, sample_level
from haltere.flight.config import Config

__all__ = ["COLOUR", "COLOUR_SNAPSHOT", "COMPONENTS", "SAMPLES", "detection_levels"]

FloatArray = NDArray[np.float64]
J21, J31 = 6, 10

#: Components of the residual of each detection filter, in the order of `haltere.diagnosis.truth_table.DETECTORS`.
COMPONENTS = (1, 1, 1, 1, 1, 1, 1, 3, 1, 3, 1, 3, 1, 3)
#: Samples a second that are expected of what J21-J24 and J31-J34 hear: compass, GNSS velocity, barometer, GNSS position.
SAMPLES = (50.0, 10.0, 25.0, 10.0)
#: Factors for residuals that are not white and not of unit variance: the largest statistic of a fault-free flight over what a white one
#: has, in 80 simulated flights of 90 s (seeds 7001 to 7008; hover, lissajous, box, figure-eight, tour; still air, and 4.5 m/s with gusts of
#: 0.8 m/s; vehicle identified from three others). The hardest mission in wind is left out: it is beyond what the vehicle was identified on.
COLOUR = np.array([1.45, 1.45, 2.9, 1.9, 1.9, 2.5, 2.0, 2.4, 0.6, 1.5, 2.4, 1.5, 0.6, 1.5])
#: The same of single residuals.
COLOUR_SNAPSHOT = np.array([1.3, 1.3, 1.1, 1.1, 1.1, 1.1, 1.2, 1.5, 0.5, 1.4, 0.5, 1.3, 0.5, 1.4])


def detection_levels(config: Config) -> tuple[FloatArray, FloatArray]:
    """Level of each detection filter (14,), and the correlation of neighbouring residuals that is taken out before (14,)."""
    fast = 1.0 / config.number("fault_tolerant.step")
    total = 6.0 * fast + 2.0 * sum(SAMPLES)
    rate = config.number("diagnosis.false_alarms")
    if config["fault_tolerant.detector"] == "snapshot":
        plain = [sample_level(rate / (3600.0 * total), d) for d in COMPONENTS]
        colour = COLOUR_SNAPSHOT.copy()
        if config.number("noise.field") == 0.0:
            colour[J31] = colour[J21]  # its residuals have no more than their own noise then, as those of J21
        return np.array(plain) * colour, np.zeros(14)
    return np.array([glr_level(rate, total, d) for d in COMPONENTS]) * COLOUR, np.zeros(14)
