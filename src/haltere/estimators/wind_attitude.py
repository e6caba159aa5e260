"""`wind-attitude`: attitude from gyro, gravity, field and wind triangle (source W; theory.md §3).

Presets ``as-printed`` and ``as-corrected`` are the published filter of four states, `haltere.estimators.quaternion_step`: attitude
alone, with the wind given and the velocity through the air measured or read off the drag (`haltere.estimators.air`). ``default`` has no
code of its own: it is the error-state filter of `navigator` with wind as a state and air data fused as the design means it (§3.6).
"""

from __future__ import annotations

NAME = "wind-attitude"
#: Streams without which it cannot run, and those that it uses.
NEEDS = ("imu",)
USES = ("imu", "magnetometer", "gnss", "airdata", "rotors", "wind")
#: Columns of its solution beyond attitude, velocity, position and biases; the published filter gives attitude alone.
POSITION = True
