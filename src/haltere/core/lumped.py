"""Record type of a vehicle's forces and moments, linear in constants; what the columns are says `haltere.vehicle.regressors`."""

from __future__ import annotations

import numpy as np

__all__ = ["COLUMNS", "lumped_layout"]

#: Columns that each of the six axes has at most.
COLUMNS = 7


def lumped_layout(n: int) -> np.dtype[np.void]:
    """Record type of a lumped model of ``n`` rotors: weights of the rotors, constants by axis and column (0 where a preset has none).

    ``aero`` is 1 for the constants that go with the ratio of the air density to that of the constants, ``density`` [kg/m^3]. Speeds were
    valid ``lag`` [s] before their stamps. ``sd``, ``slow``, ``ar1`` and ``window`` are what the model leaves, by axis, see
    `haltere.estimators.lumped.Lumped`. ``s1`` [rad/s] is the sum of the speeds at which the damping of rates is that of the constants; 0
    where damping does not go with it.
    """
    return np.dtype(
        [
            ("roll", "f8", n), ("pitch", "f8", n), ("yaw", "f8", n), ("k", "f8", (6, COLUMNS)), ("aero", "f8", (6, COLUMNS)),
            ("literal", "i8"), ("s1", "f8"), ("density", "f8"), ("lag", "f8"),
            ("sd", "f8", 6), ("slow", "f8", 6), ("ar1", "f8", 6), ("window", "f8", 2),
        ],
        align=True,
    )  # fmt: skip
