"""The one record of a measurement update, and the words behind its codes. Everything downstream reads these records."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere._jit import constant, jit

__all__ = ["AID_RECORD", "COMPONENTS", "EVENTS", "REASONS", "SENSORS", "STATUSES", "event", "event_since", "record"]

#: Sensor codes, and indices of the filter's memory of each sensor. The first ones arrive from outside and are queued, the next are made
#: by the filter itself, of what is measured and then (from `FAKE_POSITION` on) of what is assumed; the last is the bank of yaw
#: hypotheses, which speaks of GNSS velocity.
GNSS_VELOCITY, GNSS_POSITION, BAROMETER, MAGNETOMETER, POWER, ROTORS, AIRSPEED, VANES, WIND, ATTITUDE = (constant(i) for i in range(10))
ZERO_VELOCITY, ZERO_RATE, DRAG, NO_SIDESLIP, FAKE_POSITION, FAKE_VELOCITY, YAW_BANK = (constant(i) for i in range(10, 17))
#: Only the published quaternion filter (`wind-attitude`) hears gravity from the accelerometer; of `VANES` and `DRAG` it hears vectors.
ACCELEROMETER = constant(17)
N_QUEUED = 10
#: Sensor of an event that no sensor made.
NO_SENSOR = constant(0)
#: Detail of an event that has none.
NO_DETAIL = constant(0)
SENSORS = (
    "gnss", "gnss", "barometer", "magnetometer", "power", "rotors", "airdata", "airdata", "wind", "attitude",
    "zero_velocity", "zero_rate", "drag", "no_sideslip", "fake_position", "fake_velocity", "gnss",
    "accelerometer",
)  # fmt: skip

COMPONENTS = (
    "vel_n", "vel_e", "vel_d", "pos_n", "pos_e", "pos_d", "altitude", "heading", "mag_x", "mag_y", "mag_z", "rate_x", "rate_y", "rate_z",
    "field_east", "field_down", "field_north", "airspeed", "aoa", "sideslip", "drag_x", "drag_y", "wind_n", "wind_e", "wind_d",
    "attitude_x", "attitude_y", "attitude_z", "down_x", "down_y", "down_z", "field_x", "field_y", "field_z", "air_x", "air_y", "air_z",
)  # fmt: skip
C_VEL, C_POS, C_ALTITUDE, C_HEADING, C_MAG, C_RATE, C_FIELD = (constant(i) for i in (0, 3, 6, 7, 8, 11, 14))
C_AIRSPEED, C_AOA, C_SIDESLIP, C_DRAG, C_WIND, C_ATTITUDE = (constant(i) for i in (17, 18, 19, 20, 22, 25))
C_DOWN, C_UNIT_FIELD, C_AIR = (constant(i) for i in (28, 31, 34))

STATUSES = ("fused", "deweighted", "rejected", "held")
FUSED, DEWEIGHTED, REJECTED, HELD = (constant(i) for i in range(4))

REASONS = (
    "", "innovation", "timeout", "start", "field strength", "dip", "no horizontal field", "alignment", "distrusted", "disturbed",
    "acceleration",
)  # fmt: skip
R_NONE, R_INNOVATION, R_TIMEOUT, R_START, R_STRENGTH, R_DIP, R_HORIZONTAL, R_ALIGNMENT, R_DISTRUSTED, R_DISTURBED = (
    constant(i) for i in range(10)
)
R_ACCELERATION = constant(10)

#: "fault", "suspect" and "over" are findings of `haltere.diagnosis`: a fault that is named, one of several, and the end of one; the last
#: three but one are verdicts of `fault-tolerant`: named and left out, one of several, heard again; "alarm" is one of J21 to J24.
EVENTS = (
    "aligned", "reset", "diverged", "realigned", "gap", "recovered", "timeout", "disturb", "fault", "suspect", "over",
    "isolated", "undecided", "readmitted", "alarm",
)  # fmt: skip
E_ALIGNED, E_RESET, E_DIVERGED, E_REALIGNED, E_GAP, E_RECOVERED, E_TIMEOUT, E_DISTURBED, E_FAULT, E_SUSPECT, E_OVER = (
    constant(i) for i in range(11)
)
E_ISOLATED, E_UNDECIDED, E_READMITTED, E_ALARM = (constant(i) for i in range(11, 15))

AID_RECORD = np.dtype(
    [
        ("t", "f8"),
        ("observation", "f8"),
        ("innovation", "f8"),
        ("innovation_sd", "f8"),
        ("test_ratio", "f8"),
        ("weight", "f8"),
        ("sensor", "u1"),
        ("component", "u1"),
        ("status", "u1"),
        ("reason", "u1"),
    ],
    align=True,
)


@jit
def record(
    s: Any,
    aids: Any,
    t: float,
    sensor: int,
    component: int,
    observation: float,
    innovation: float,
    sd: float,
    ratio: float,
    weight: float,
    status: int,
    reason: int,
) -> None:
    """Append one record; without room it is counted, not lost silently."""
    i = s.n_aids
    if i < len(aids):
        a = aids[i]
        a.t = t
        a.observation = observation
        a.innovation = innovation
        a.innovation_sd = sd
        a.test_ratio = ratio
        a.weight = weight
        a.sensor = sensor
        a.component = component
        a.status = status
        a.reason = reason
        s.n_aids = i + 1
    else:
        s.n_aids_lost += 1


@jit
def event(s: Any, t: float, code: int, sensor: int, value: float) -> None:
    """Append one event of the filter; without room it is counted."""
    event_since(s, t, t, code, sensor, value, math.nan, NO_DETAIL)


@jit
def event_since(s: Any, t: float, onset: float, code: int, sensor: int, value: float, threshold: float, detail: int) -> None:
    """Append an event detected at t that began at ``onset``, with the threshold that ``value`` passed and a code of what kind it is."""
    i = s.n_events
    if i < len(s.event):
        e = s.event[i]
        e.t, e.onset, e.code, e.sensor, e.value, e.threshold, e.detail = t, onset, code, sensor, value, threshold, detail
        e.seen, e.size, e.sd, e.candidates, e.left = t, math.nan, math.nan, 0, math.nan
        for k in range(len(e.alarms)):
            e.alarms[k] = math.nan
        s.n_events = i + 1
    else:
        s.n_events_lost += 1
