"""What `fault-tolerant` remembers beside an ordinary filter, as record types: fused state, local filters, detectors. No arithmetic."""

from __future__ import annotations

from functools import cache

import numpy as np

from haltere._jit import constant
from haltere.aids.record import AID_RECORD
from haltere.filter.windows import windows
from haltere.strapdown.dynamics import MOVING, STATES

__all__ = [
    "DUE", "FAST", "FAST_WINDOW", "FEDERATED", "FINDINGS", "LF_ACCEL", "LF_BARO", "LF_GNSS", "LF_GYRO", "LF_MAG", "LOCAL_FILTERS",
    "N_DETECTORS", "SLOW", "SLOW_WINDOW", "federated",
]  # fmt: skip

#: Local filters (theory.md §5.6).
LF_GYRO, LF_ACCEL, LF_MAG, LF_GNSS, LF_BARO = (constant(i) for i in range(5))
LOCAL_FILTERS = constant(5)
#: Detection filters: J11-J16, each of one axis of the IMU against the model; then J21-J24 and J31-J34, model and IMU against compass, GNSS
#: velocity, barometer, GNSS position.
N_DETECTORS = 14
FAST, SLOW = constant(6), constant(8)
#: Longest windows in samples: 10 s of the filter's own steps, and at least 6 s of a sensor's.
FAST_WINDOW, SLOW_WINDOW = 1024, 256
#: Measurements between two steps, and findings, that there is room for.
DUE, FINDINGS = 64, 32
_N = int(STATES)


def _record(*fields: tuple[object, ...]) -> np.dtype[np.void]:
    return np.dtype((np.record, list(fields)), align=True)


#: See `haltere.strapdown.dynamics`.
_NOMINAL: tuple[tuple[object, ...], ...] = (
    ("w", "f8", 3), ("q", "f8", 4), ("v", "f8", 3), ("p", "f8", 3), ("bm", "f8", 3), ("bf", "f8", 3), ("wind", "f8", 2),
    ("steady", "f8", 2),
)  # fmt: skip


def _updated(n: int) -> tuple[tuple[object, ...], ...]:
    """What `haltere.filter.update` needs of a filter of n states."""
    return (("P", "f8", (n, n)), ("dx", "f8", n), ("u", "f8", n), ("k", "f8", n))


#: A local filter: its correction ``dx`` is about the fused nominal state, ``axes`` what it hears, ``share`` its β, 0 where it has none.
LOCAL = _record(("axes", "i8"), ("share", "f8"), ("changed", "i8"), *_updated(_N))
#: The model's own chain, which hears compass, GNSS and barometer but no IMU (J21-J24).
CHAIN = _record(*_NOMINAL, *_updated(int(MOVING) + 1), ("baro", "f8"))
#: Force of the model against the accelerometer (J11-J13): what the model misses, wind and its mean.
AIR_CHAIN = _record(("x", "f8", 7), *_updated(7))
#: A measurement that waits for the next step.
_DUE = _record(("kind", "i8"), ("t", "f8"), ("z", "f8", 3), ("r", "f8", 3))
#: What a verdict rests on: when each detection filter first alarmed (0: did not), and the largest statistic over its level.
FINDING = _record(("when", "f8", N_DETECTORS), ("most", "f8", N_DETECTORS))


@cache
def federated() -> np.dtype[np.void]:
    """Record type of `fault-tolerant`'s own memory."""
    return _record(
        ("on", "i8"),  # 1: the fused state is that of the vehicle's physics; 0: on the ground, or rotors not known
        ("t", "f8"),
        *_NOMINAL,
        ("bg", "f8", 3),  # biases of gyro and accelerometer, offset of the barometer
        ("ba", "f8", 3),
        ("baro", "f8"),
        ("f", "f8", 3),  # force and angular acceleration of the model at the state, without b_F and b_M
        ("a", "f8", 3),
        ("P", "f8", (_N, _N)),
        ("dx", "f8", _N),
        ("y", "f8", _N),
        ("work", "f8", (_N, _N)),
        ("lf", LOCAL, (int(LOCAL_FILTERS),)),
        ("t_fuse", "f8"),
        ("n_fused", "i8"),
        # since the last step: samples, seconds, sums of what the sensors show over the nominal state
        ("n", "i8"),
        ("span", "f8"),
        ("by_gyro", "f8", 3),
        ("by_accel", "f8", 3),
        ("by_model", "f8", 3),  # and of the model's angular acceleration
        ("n_due", "i8"),
        ("due", _DUE, (DUE,)),
        ("heard", AID_RECORD, (128,)),
        ("nothing", "f8", (0, 0)),
        # take-off and landing
        ("t_light", "f8"),
        ("t_heavy", "f8"),
        ("t_begun", "f8"),
        ("ground", "f8"),
        # detection
        ("chain", CHAIN),
        ("air", AIR_CHAIN),
        ("axis", "f8", (3, 2)),  # rate and b_M of J14-J16 with their covariance (xx, xy, yy)
        ("axis_P", "f8", (3, 3)),
        ("fast", windows(FAST_WINDOW), (int(FAST),)),
        ("slow", windows(SLOW_WINDOW), (int(SLOW),)),
        ("level", "f8", N_DETECTORS),
        ("rho", "f8", N_DETECTORS),
        ("last", "f8", N_DETECTORS),  # statistic over level, now and at most
        ("when", "f8", N_DETECTORS),
        ("most", "f8", N_DETECTORS),
        ("alarms", "i8"),
        ("lacking", "f8", 3),  # force that J11-J13 missed when they first alarmed [m/s^2]
        ("held", "f8", (2, 3)),  # accelerometer bias of some seconds ago, and of later
        ("t_held", "f8"),
        ("t_jerked", "f8"),  # when J16 was last near an alarm
        ("t_compass", "f8"),  # when the compass watch last found another field
        ("named", "i8"),  # fault that the signatures of the IMU chain name, plus one
        ("t_first", "f8"),
        ("t_alarm", "f8"),
        ("t_chain", "f8"),
        ("armed", "i8"),
        ("off", "i8"),  # detection filters that contain what is isolated
        ("isolated", "i8"),  # sensors' axes and model's axes that are isolated, a bit each
        ("t_isolated", "f8", 32),
        ("missed", "f8", 6),  # sums of b_F and b_M since an axis of the model is isolated
        ("n_missed", "i8", 6),
        ("n_findings", "i8"),
        ("finding", FINDING, (FINDINGS,)),
        ("exclude", "f8", (2, 4, 3)),  # gyro and accelerometer: axes, from, to
    )  # fmt: skip


FEDERATED = federated()
