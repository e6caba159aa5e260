"""What a filter remembers of a chain of motion that a vehicle's model drives beside it, and of the detectors on it. No arithmetic."""

from __future__ import annotations

from functools import cache

import numpy as np

from haltere._jit import constant
from haltere.filter.windows import windows
from haltere.strapdown.dynamics import MOVING

__all__ = ["CHAIN_DETECTORS", "chain"]

#: Against compass, GNSS velocity, barometer, GNSS position: J21 to J24.
CHAIN_DETECTORS = constant(4)
#: Longest window of a detector in samples of its sensor, 10 s of a compass at 50 Hz; measurements that wait for the end of a block.
_WINDOW, _DUE = 512, 32
_N = int(MOVING) + 1
_K = int(CHAIN_DETECTORS)


@cache
def chain(rotors: int) -> np.dtype[np.void]:
    """Record type for a vehicle of so many rotors; states of the chain are those of `haltere.strapdown.dynamics`, then the barometer's."""
    due = np.dtype((np.record, [("kind", "i8"), ("t", "f8"), ("z", "f8", 3), ("r", "f8", 3)]), align=True)
    return np.dtype(
        (
            np.record,
            [
                ("live", "i8"),
                ("t_seed", "f8"),  # since when
                ("w", "f8", 3),
                ("q", "f8", 4),
                ("v", "f8", 3),
                ("p", "f8", 3),
                ("bm", "f8", 3),
                ("bf", "f8", 3),
                ("wind", "f8", 2),
                ("steady", "f8", 2),
                ("baro", "f8"),
                ("has_baro", "i8"),
                ("P", "f8", (_N, _N)),
                ("dx", "f8", _N),
                ("u", "f8", _N),
                ("k", "f8", _N),
                # the block so far: seconds, samples, sums of the rotors' squared speeds and of their rates of change
                ("span", "f8"),
                ("n", "f8"),
                ("squares", "f8", rotors),
                ("spin", "f8", rotors),
                ("speed", "f8", rotors),  # of the block that has ended, in its root mean square [rad/s]
                ("spin_up", "f8", rotors),
                ("a", "f8", 3),  # angular acceleration and acceleration over ground of that block
                ("a_n", "f8", 3),
                ("n_due", "i8"),
                ("due", due, (_DUE,)),
                ("w_of", windows(_WINDOW), (_K,)),
                # innovations over their own sigma: mean square, product of neighbours, the last one, how many were learnt from
                ("c0", "f8", _K),
                ("c1", "f8", _K),
                ("z", "f8", (_K, 3)),
                ("n_learnt", "f8", _K),
                ("n_heard", "i8", _K),
                ("worth", "f8", _K),  # variance of a compass or a barometer over what is configured, as this flight shows it
                # statistic over threshold: now, largest of this stretch and of the one before, what is usual
                ("ratio", "f8", _K),
                ("peak", "f8", _K),
                ("waiting", "f8", _K),
                ("usual", "f8", _K),
                ("t_usual", "f8"),
                # alarms: when the last one began, and was last so
                ("t_alarm", "f8", _K),
                ("t_over", "f8", _K),
                # what was known to be wrong when the chain began: it begins anew when that changes
                ("wrong", "i8"),
                ("healed", "i8"),
                ("lift", "f8"),
            ],
        ),
        align=True,
    )
