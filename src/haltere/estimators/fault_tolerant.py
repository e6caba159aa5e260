"""`fault-tolerant`: the vehicle's own physics as the second sensor (source F; theory.md §5), in the structure of the source.

The state is predicted by a model of forces and moments from rotor speeds, never by the IMU; gyro, accelerometer, compass, GNSS and
barometer each have a local filter, and a federated filter fuses these (`haltere.estimators.local_filters`). Detection filters compare
the model, the IMU and the other sensors in pairs; what fails is named by the pattern of their alarms and left out (`haltere.diagnosis`).

It needs a vehicle file with ``[lumped]`` (``haltere identify``) and rotor speeds. Wind and biases are states, and detectors have many
windows; ``as-corrected`` has neither wind nor windows. The printed thresholds of the source are lost, so there is no ``as-printed``.
"""

from __future__ import annotations

NAME = "fault-tolerant"
#: Streams without which it cannot run, and those that it uses.
NEEDS = ("imu", "rotors")
USES = ("imu", "rotors", "gnss", "magnetometer", "barometer")
#: Columns of its solution beyond attitude, velocity, position and biases.
POSITION = True
#: It reads a vehicle's force and moment model, and does nothing without one.
VEHICLE = True
REQUIRES_VEHICLE = True
#: What comes after cannot be taken back through a federated filter.
SMOOTHS = False
