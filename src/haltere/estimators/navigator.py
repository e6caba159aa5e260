"""`navigator`, the default: the error-state filter with GNSS, barometer, magnetometer and at-rest aids, and a barometer offset.

It has no code of its own: fifteen core states and the barometer offset of `strapdown.layout`, the step of `estimators.step`,
and the configuration's defaults. Wind, vehicle model and diagnosis come with their own issues.
"""

from __future__ import annotations

NAME = "navigator"
#: Streams without which it cannot run, and those that it uses.
NEEDS = ("imu",)
USES = ("imu", "gnss", "magnetometer", "barometer", "power")
#: Columns of its solution beyond attitude, velocity, position and biases.
POSITION = True
