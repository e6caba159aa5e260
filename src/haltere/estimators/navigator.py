"""`navigator`, the default: the error-state filter with GNSS, barometer, magnetometer, at-rest aids and wind.

It has no code of its own: fifteen core states, the barometer offset, and with rotors or air data the wind and what they depend on, of
`strapdown.layout`, the step of `estimators.step`, and the configuration's defaults.
"""

from __future__ import annotations

NAME = "navigator"
#: Streams without which it cannot run, and those that it uses.
NEEDS = ("imu",)
USES = ("imu", "gnss", "magnetometer", "barometer", "power", "rotors", "airdata", "wind", "attitude")
#: Columns of its solution beyond attitude, velocity, position and biases.
POSITION = True
#: Whether it uses a vehicle's model.
VEHICLE = True
