"""What a filter remembers of a vehicle's model beside its IMU: what stands in for failed axes, residuals of the pairs. No arithmetic."""

from __future__ import annotations

from functools import cache

import numpy as np

from haltere._jit import constant
from haltere.filter.windows import windows

__all__ = ["LATELY", "LATER", "MARKS", "MATCHED", "PAIR_WINDOW", "pairs"]

#: Longest window of the detectors in blocks of a hundredth of a second, in a plain number: it is a modulus.
PAIR_WINDOW = constant(512)
#: Blocks whose residuals of rate are kept.
LATELY = constant(64)
#: Blocks for which a step of a rate is looked for: a chain has followed it by then. In a plain number: it is a modulus.
MATCHED = constant(24)
#: Quarters of a second that the past of each pair is kept.
MARKS = constant(40)
#: Later beginnings of a trial of forces that are kept. In a plain number: it is a modulus.
LATER = constant(8)


@cache
def pairs() -> np.dtype[np.void]:
    """Record type; channels are in the order of the model's axes: force along x, y, z, moment about x, y, z."""
    return np.dtype(
        (
            np.record,
            [
                # axes told not to be used: bits, start, end [s], of gyro and accelerometer; axes that the model stands in for
                ("told", "f8", (2, 4, 3)),
                ("on", "i8", 6),
                ("standing", "i8"),
                ("kept", "f8", 6),  # bias of an axis as it was before
                ("flying", "i8"),
                ("t_flying", "f8"),  # since when
                ("ground", "f8"),  # height down [m] where it last rested
                ("ratio", "f8"),  # air density over that of the constants, and until when that holds
                ("t_ratio", "f8"),
                # the model at the last sample [m/s^2, rad/s^2] and its slopes: of force and of moment by air velocity, of moment by rate
                ("f", "f8", 3),
                ("m", "f8", 3),
                ("v_a", "f8", 3),
                ("by_v", "f8", (2, 3, 3)),
                ("by_w", "f8", (3, 3)),
                ("hard", "f8"),  # largest moment of late [rad/s^2]
                ("turn", "f8", 3),  # integral of the model's moment [rad/s]
                # thrust that rotors were found to have more than their speeds stand for, as a part, and the same of their torque
                ("lift", "f8", 8),
                ("torque", "f8", 8),
                ("lifted", "i8"),
                ("t", "f8"),
                # biases that residuals are free of: in use, and the ones to come
                ("bias", "f8", 6),
                ("next", "f8", 6),
                ("t_bias", "f8"),
                # block of samples: residual sums, number, length
                ("total", "f8", 6),
                ("n", "f8"),
                ("span", "f8"),
                # chain of each pair: of a force its offset and what it is off by for a second beside, of a moment the rate less `turn` and
                # its drift; covariance
                ("level", "f8", 6),
                ("drift", "f8", 6),
                ("P", "f8", (6, 3)),
                ("sd", "f8", 6),
                ("scale", "f8", 6),  # noise of the model in this flight over that of the vehicle file, in variances
                # what forces are off by for a second: sum of residuals, number, mean before and whether there is one, squares, how many
                ("slow_sum", "f8", 3),
                ("slow_n", "f8"),
                ("slow_mean", "f8", 3),
                ("slow_known", "i8"),
                ("slow_square", "f8", 3),
                ("slow_count", "f8"),
                ("n_blocks", "i8"),
                ("t_calm", "f8"),  # when the chains began anew last
                # innovations: variance, product of neighbours, both learnt, from how many; measurement variance of a block
                ("n_learnt", "f8", 6),
                ("c0", "f8", 6),
                ("c1", "f8", 6),
                ("z", "f8", 6),
                ("r", "f8", 6),
                ("before", "f8", 6),
                ("w", windows(int(PAIR_WINDOW)), (6,)),
                # of rates, a step at each of the last blocks: what it would be in the next innovation, sums of products and squares
                ("expected", "f8", (3, int(MATCHED))),
                ("agrees", "f8", (3, int(MATCHED))),
                ("energy", "f8", (3, int(MATCHED))),
                ("n_matched", "i8", 3),
                # statistic over threshold: largest of this stretch and of the one before, what is usual
                ("peak", "f8", 6),
                ("waiting", "f8", 6),
                ("usual", "f8", 6),
                ("t_usual", "f8"),
                # an alarm: when each pair gave it first (0: not), the first of all and its onset, size as the window had it
                ("t_alarm", "f8", 6),
                ("t_first", "f8"),
                ("onset", "f8"),
                ("told_size", "f8", 6),
                ("statistic", "f8"),
                ("threshold", "f8"),
                ("mark", "i8"),
                ("mean_T", "f8"),  # mean residual along the thrust axis since then, and of how many blocks
                ("mean_n", "f8"),
                ("t_hint", "f8", 6),  # last alarm of each pair, whatever came of it, and its sign
                ("hint_sign", "f8", 6),
                ("t_across", "f8"),  # last verdict on forces was pending
                ("t_deaf", "f8"),  # until when forces are not listened to, and until when at their full threshold only
                ("t_dull", "f8"),
                ("t_step", "f8", 3),  # onset of the last step of a gyro axis that the rotors do not explain, and its size [rad/s]
                ("step", "f8", 3),
                ("out", "i8"),  # cause for which the compass was not heard, at the last block
                ("residual", "f8", 6),  # of the last block
                ("lately", "f8", (int(LATELY), 3)),  # of the last ones, of rates, and their times
                ("t_lately", "f8", int(LATELY)),
                ("n_lately", "i8"),
                ("lag", "i8"),  # mark of the wind that forces are compared in
                ("wind_held", "f8", 2),  # the same after a trial that came to nothing, and when it ended
                ("t_held", "f8"),
                # trial of what a change of force is: of the model along x, y, z, wind, or nothing; misfits, sums of the logarithms of the
                # innovations' variances
                ("trial", "i8"),
                ("both", "i8"),  # 1: that it is one or the other was told
                ("misfit", "f8", 5),
                ("along_z", "f8", 5),  # the part of a misfit that is of the force along z
                ("chance", "f8", 5),
                # the filters of these: change of wind (2), what the model is off by (3), force, error of the wind before (2), parts that
                # the slopes by velocity are off by (3); covariances, room for a row and a gain
                ("tried", "f8", (5, 11)),
                ("tried_P", "f8", (5, 11, 11)),
                ("row", "f8", 11),
                ("gain", "f8", 11),
                ("moved", "f8"),  # most of what is no hover any more, speed or turn since, and the heading before
                ("heading", "f8"),
                ("opened", "i8"),  # 1: the wind before counts as unknown, -1: just begun
                # before: wind, level, velocity through the air; what the filter's own wind makes of the forces since
                ("wind", "f8", 2),
                ("level_before", "f8", 3),
                ("air", "f8", 3),
                ("along", "f8", (3, 2)),  # slopes of forces by the wind before, at that heading
                ("follows", "f8", 3),
                # the same trial begun later, at the last quarters of a second: when, what nothing predicted then, its variance, how much of
                # a step since has been taken for that, sums of products and squares, misfits then; when the next one is kept, and where
                ("later", "f8", int(LATER)),
                ("later_off", "f8", (3, int(LATER))),
                ("later_var", "f8", (3, int(LATER))),
                ("later_level", "f8", (3, int(LATER))),  # the same as a residual in the filter's wind of then, and that wind
                ("later_wind", "f8", (2, int(LATER))),
                ("followed", "f8", (3, int(LATER))),
                ("later_num", "f8", (3, int(LATER))),
                ("later_den", "f8", (3, int(LATER))),
                ("later_fit", "f8", (5, int(LATER))),
                ("t_later", "f8"),
                ("n_later", "i8"),
                ("healed", "i8"),
                ("healed_out", "i8"),
                ("t_healed", "f8"),
                ("still", "i8"),  # of forces across the thrust axis: 1 the air was still, -1 it was not, 0 not looked at
                # faults of the model that last: bits by axis, then by rotor, and sizes
                ("wrong", "i8"),
                ("was", "f8", 14),
                # gusts lately against those the filter expects
                ("stir", "f8"),
                ("n_stir", "f8"),
                ("calm", "f8"),
                # marks of the past: time, level, drift, turn
                ("head", "i8"),
                ("t_mark", "f8"),
                ("m_t", "f8", int(MARKS)),
                ("m_level", "f8", (int(MARKS), 6)),
                ("m_drift", "f8", (int(MARKS), 6)),
                ("m_turn", "f8", (int(MARKS), 3)),
                ("m_var", "f8", (int(MARKS), 6)),
                ("m_wind", "f8", (int(MARKS), 2)),
                ("m_yaw", "f8", int(MARKS)),
                ("headings", "i8"),  # sectors of 45 degrees that it has headed to in the air, a bit each
            ],
        ),
        align=True,
    )
