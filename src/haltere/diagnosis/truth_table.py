"""Source F's decision: what fault each pattern of alarms of the detection filters stands for (theory.md §5.5, as amended), as data.

A fault's signature says of every detection filter that it must alarm, may, or must not. What matches is named; where several do, the set
is returned; where none does, the nearest with one contradiction. Whether silence counts is for the caller to say: a filter without power
against a fault is taken as one that may.
"""

from __future__ import annotations

from haltere._jit import constant, jit

__all__ = ["DETECTORS", "FAULTS", "MAY", "MUST", "N_FAULTS", "count", "match"]

#: Detection filters in the order of their bits: model against IMU, model and IMU against compass, GNSS velocity, barometer, GNSS position.
DETECTORS = ("J11", "J12", "J13", "J14", "J15", "J16", "J21", "J22", "J23", "J24", "J31", "J32", "J33", "J34")
_BIT = {name: 1 << i for i, name in enumerate(DETECTORS)}

#: Fault, what it isolates, must, may (theory.md §5.5: ● and ○; J24 and J34 of theory-amendments.md 10 may follow what moves position).
_TABLE: tuple[tuple[str, str, str], ...] = (
    ("gyro.x", "J32", "J14 J31 J33 J34"),
    ("gyro.y", "J32", "J15 J31 J33 J34"),
    ("gyro.z", "J31", "J16 J32 J34"),
    ("accel.x", "J11 J32", "J33 J34"),
    ("accel.y", "J12 J32", "J33 J34"),
    ("accel.z", "J13 J33", "J32 J34"),
    ("model.hx", "J11", "J22 J24"),
    ("model.hy", "J12", "J22 J24"),
    ("model.t", "J13", "J22 J23 J24"),
    ("model.r", "J14", "J11 J12 J21 J22 J23 J24"),
    ("model.p", "J15", "J11 J12 J21 J22 J23 J24"),
    ("model.q", "J16", "J21 J22 J23 J24"),
    ("magnetometer", "J21 J31", ""),
    ("gnss.velocity", "J22 J32", "J24 J34"),
    ("barometer", "J23 J33", ""),
    ("gnss.position", "J24 J34", ""),
    ("rotor", "J14 J15", "J13 J16 J21 J22 J23 J24 J11 J12"),
    ("wind", "", "J11 J12 J13 J22 J24"),
)
#: A step of the wind shows in one of these at least, by its direction.
AIR = constant(_BIT["J11"] | _BIT["J12"])
FAULTS = tuple(row[0] for row in _TABLE)
N_FAULTS = constant(len(FAULTS))
#: The first of them are faults of gyro and accelerometer.
INERTIAL = 6
MUST = tuple(constant(sum(_BIT[name] for name in row[1].split())) for row in _TABLE)
MAY = tuple(constant(sum(_BIT[name] for name in row[2].split())) for row in _TABLE)


@jit
def count(bits: int) -> int:
    """Number of bits that are set."""
    n = 0
    while bits != 0:
        bits &= bits - 1
        n += 1
    return n


@jit
def match(alarms: int, blind: int) -> tuple[int, int]:
    """Faults, a bit each, whose signatures contradict the alarms least, and in how many filters.

    Parameters
    ----------
    alarms
        Detection filters that alarmed, a bit each.
    blind
        Filters whose silence says nothing of a fault of the IMU. What another sensor's fault does to a residual is there at once.
    """
    best, least = 0, 99
    for f in range(N_FAULTS):
        unheard = blind if f < INERTIAL else 0
        wrong = count(MUST[f] & ~alarms & ~unheard) + count(alarms & ~(MUST[f] | MAY[f]))
        some = MUST[f] if MUST[f] != 0 else AIR
        if some & ~unheard == 0:
            some |= MAY[f] & ~unheard
        if some & alarms == 0:
            continue
        if wrong < least:
            best, least = 1 << f, wrong
        elif wrong == least:
            best |= 1 << f
    return best, least
