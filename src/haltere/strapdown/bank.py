"""What diagnosis remembers, as record types: responses to unit faults and how they match, and the raw samples of late. No arithmetic."""

from __future__ import annotations

from functools import cache

import numpy as np

from haltere._jit import constant
from haltere.filter.jumping import JUMP_RING
from haltere.filter.signatures import BANK_COLUMNS, SLOTS
from haltere.filter.windows import windows

__all__ = ["STEPS", "STEP_HISTORY", "STEP_RING", "bank"]

#: Raw IMU samples that the search for steps looks back, in a plain number: it is a modulus.
STEP_RING = constant(16)
#: Quarters of a second that the extremes of steps are kept.
STEP_HISTORY = constant(64)


def _record(*fields: tuple[object, ...]) -> np.dtype[np.void]:
    """Nested record type that plain Python can also reach by attribute."""
    return np.dtype((np.record, list(fields)), align=True)


#: What `haltere.diagnosis.steps` remembers of the raw samples: six channels, gyro and then accelerometer.
STEPS = _record(
    ("head", "i8"),
    ("filled", "i8"),
    ("u", "f8", (int(STEP_RING), 6)),
    ("when", "f8", int(STEP_RING)),
    ("after", "f8", 6),  # sums of the two halves, and the step between them [sigma], now and one sample ago
    ("before", "f8", 6),
    ("z", "f8", 6),
    ("z_before", "f8", 6),
    ("low", "f8", 6),  # extremes of that since the last interval began, and of each interval with its 1 sigma
    ("high", "f8", 6),
    ("t_free", "f8"),  # steps are looked for from here on
    ("t_interval", "f8"),
    ("h_head", "i8"),
    ("h_t", "f8", int(STEP_HISTORY)),
    ("h_low", "f8", (int(STEP_HISTORY), 6)),
    ("h_high", "f8", (int(STEP_HISTORY), 6)),
    ("h_sd", "f8", (int(STEP_HISTORY), 6)),
    ("square", "f8", 6),  # mean square of a difference over two samples
    ("held", "f8", 6),  # the last value, how often it has come, the longest such run before, the largest size before
    ("run", "i8", 6),
    ("t_run", "f8", 6),
    ("longest", "i8", 6),
    ("peak", "f8", 6),
    ("quick", "f8", 6),  # mean square of second differences, lately and in the flight
    ("slow", "f8", 6),
    ("t_rough", "f8", 6),  # since when it is rough, and what is wrong with the channel: 0 nothing
    ("wrong", "i8", 6),
    ("rate", "f8", 3),  # mean square of the rate in flight [rad^2/s^2]
    ("n", "i8"),
)

#: What `haltere.filter.turning` knows of the innovations of heading.
_TRACK = _record(
    ("t", "f8"),  # last sample: time, value; number since the beginning
    ("y", "f8"),
    ("n", "i8"),
    ("o", "f8"),  # offset and drift, and their covariance
    ("d", "f8"),
    ("oo", "f8"),
    ("od", "f8"),
    ("dd", "f8"),
    ("q", "f8"),  # what has been added to that since the last sample
    ("q_drift", "f8"),
    ("r", "f8"),  # white variance, and from how many it is known
    ("known", "f8"),
    ("last", "f8"),  # whitened one before
    ("total", "f8"),  # of the whitened ones of this block, their number, when it began
    ("samples", "f8"),
    ("t_block", "f8"),
    ("late", "f8", 8),  # squares of the means of the last blocks
    ("blocks", "i8"),
    ("share", "f8"),  # of what a compass may turn by itself, as this flight shows
    ("w", "f8", 3),  # rate of late across the vertical, and about it
    ("about", "f8"),
    ("bias", "f8", 3),  # of the gyro when it began, variance of what that turns, and turn by what it has changed since
    ("unsure", "f8"),
    ("by_bias", "f8"),
    ("spun", "f8", 3),  # turn by a unit rate of each axis since the last sample, and by slot in all, for a step and for a ramp
    ("t_spun", "f8"),
    ("turned", "f8", (int(SLOTS), 3)),
    ("ramped", "f8", (int(SLOTS), 3)),
)

#: What `haltere.filter.jumping` knows of barometer or compass, and `haltere.diagnosis.jumps` makes of it.
_JUMP = _record(
    ("total", "f8"),  # samples of the value to come, the time of the last one, number of values since it began
    ("n", "f8"),
    ("t_value", "f8"),
    ("n_values", "i8"),
    ("before", "f8"),
    ("level", "f8"),  # and its variance, noise of a value, factor on the walk
    ("P", "f8"),
    ("r", "f8"),
    ("scale", "f8"),
    ("q", "f8"),  # variance of that walk, a second
    ("z", "f8"),  # innovation, its mean square, product of neighbours, from how many
    ("c0", "f8"),
    ("c1", "f8"),
    ("known", "f8"),
    ("w", windows(int(JUMP_RING))),
    ("glr", "f8"),
    ("fresh", "i8"),
    ("d", "f8", int(JUMP_RING)),  # the last values, and their times
    ("t", "f8", int(JUMP_RING)),
    ("filled", "i8"),
    ("peak", "f8", 1),  # statistic over threshold: largest of this stretch and of the one before, what is usual
    ("waiting", "f8", 1),
    ("usual", "f8", 1),
    ("t_usual", "f8"),
    ("t_alarm", "f8"),  # of what is looked into (0: nothing): when it alarmed, 1 a step, -1 none, its size and onset
    ("verdict", "i8"),
    ("found", "f8"),
    ("onset", "f8"),
    ("t_free", "f8"),  # nothing alarms before
)

#: Part of Φ since the last fusion, see `haltere.filter.signatures.move`.
_TRANSITION = _record(("P", "f8", (15, 15)))


@cache
def bank(n: int) -> np.dtype[np.void]:
    """What `haltere.diagnosis` remembers of ``n`` error states: responses to unit faults, a column each, and how they match."""
    return _record(
        ("x", "f4", (n, BANK_COLUMNS)),
        ("e", "f4", BANK_COLUMNS),
        ("bearing", "f4", BANK_COLUMNS),  # responses of heading by compass less that by the gyro
        ("num", "f4", BANK_COLUMNS),
        ("den", "f4", BANK_COLUMNS),
        ("heading_o", "f4", BANK_COLUMNS),  # responses through `haltere.filter.turning`, and what heading alone says of each
        ("heading_d", "f4", BANK_COLUMNS),
        ("heading_num", "f4", BANK_COLUMNS),
        ("heading_den", "f4", BANK_COLUMNS),
        ("track", _TRACK),
        ("live", "i8", int(SLOTS)),
        ("onset", "f8", int(SLOTS)),
        ("t_heading", "f8"),  # when heading was last heard
        ("phi", _TRANSITION),
        ("span", "f8"),
        ("last", "f8", 20),  # whitened innovation before, by component
        ("own", "f8", 20),  # mean square of the whitened innovations of the flight, by component, and their number
        ("heard", "f8", 20),
        ("t_own", "f8", 20),
        ("excess", "f8", int(SLOTS)),  # by onset: how far the squares since then are above that, and the variance of this without a fault
        ("spread", "f8", int(SLOTS)),
        ("fresh", "i8"),  # evidence has come since the last judgement
        ("t_slot", "f8"),
        ("t_judge", "f8"),
        ("n_aligned", "i8"),
        ("n_gaps", "i8"),
        ("yaw", "f8"),  # ``yaw_corrected`` as it was
        ("level", "f8", 14),  # by family: largest statistic, its fault and slot
        ("beyond", "f8", 14),  # likewise in thresholds; maxima of this block, of the one before, and what is usual
        ("peak", "f8", 14),
        ("waiting", "f8", 14),
        ("usual", "f8", 14),
        ("t_usual", "f8"),
        ("fault", "i8", 14),
        ("slot", "i8", 14),
        ("alarm", "i8"),  # 1: seen, 2: told as a set
        ("t_seen", "f8"),
        (
            "ratio",
            "f8",
        ),  # statistic over threshold of what may have tilted the attitude; 0 if a compass explains more
        ("slope", "f8", 6),  # of a ramp that was named, by axis, until when
        ("t_slope", "f8", 6),
        ("healed", "i8"),
        ("watched", "f8"),  # how long axes of the IMU were judged [s]
        ("t_unfit", "f8"),  # when what explains most last left too much unexplained
        ("t_doubt", "f8"),  # until when nothing is judged
        ("t_named", "f8", 14),  # by family: when it was last named, how often in a row, until when it is not named again
        ("n_named", "i8", 14),
        ("t_mute", "f8", 14),
        ("aloft", "i8"),  # in the air; height down where it last rested, when; last contact
        ("floor", "f8"),
        ("t_rest", "f8"),
        ("spacing", "f8"),  # how far IMU samples are apart on average, and how fast it rose or sank of late
        ("sank", "f8"),
        ("t_contact", "f8"),
        ("t_turn", "f8"),  # of a compass that turns against the gyro: its onset, rate and duration when that was noticed
        ("turn_rate", "f8"),
        ("turn_lasted", "f8"),
        ("turn", "f8"),
        ("step", STEPS),
        ("climb", "f8"),  # integral of the vertical velocity, up [m]
        ("height", _JUMP),
        ("course", _JUMP),
        ("course_healed", "i8"),
    )
