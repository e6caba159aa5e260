"""`ahrs`: attitude and gyro bias from the IMU, with or without magnetometer, without GNSS. The same kernels as `navigator`.

Velocity and position stay in the filter as what keeps gravity apart from acceleration (fake velocity), and are not given out.
"""

from __future__ import annotations

NAME = "ahrs"
#: Streams without which it cannot run, and those that it uses.
NEEDS = ("imu",)
USES = ("imu", "magnetometer", "power")
#: It gives attitude and gyro bias only.
POSITION = False
