"""`two-stage`: EKF A gives gravity without the magnetometer, EKF B navigates with the field made orthonormal to it (theory.md §4).

It has no code of its own: the layout of `strapdown.layout` with a first stage (`aids.first_stage`, (30)-(35)) beside the fifteen core
states of EKF B, x = [q, v, p, b_g, b_a] (39)-(40), the step of `estimators.step`, the magnetometer of `aids.orthonormal_field`
(36)-(38), (41)-(45), GNSS velocity and position as for `navigator`. In both stages the error state of the attitude is local, q ⊗ δq(δθ),
in place of the published additive quaternion: the two are equal to first order. No barometer, no aids at rest, no yaw from GNSS: the
source has none.

Presets: ``as-printed`` executes the misprints that can be executed, ``as-corrected`` puts them right, ``default`` adds the
innovation test, the slack along the field, WGS-84, innovation gates on GNSS and a tolerance that follows the magnetometer's noise.
"""

from __future__ import annotations

NAME = "two-stage"
#: Streams without which it cannot run, and those that it uses.
NEEDS = ("imu",)
USES = ("imu", "gnss", "magnetometer")
#: Columns of its solution beyond attitude, velocity, position and biases.
POSITION = True
