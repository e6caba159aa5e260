"""Flight modes in words and the stream ``modes`` made of them. It names what the autopilot logged and infers nothing."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from haltere.readers._common import Builder, FloatArray, IntArray

__all__ = ["ARDUPILOT_MODES", "add_modes", "ardupilot_mode", "px4_mode", "spelt"]

#: PX4's ``nav_state`` in the words of its user guide. Numbers that were given away anew over the versions are in `PX4_REUSED`.
PX4_MODES = {
    0: "Manual",
    1: "Altitude",
    2: "Position",
    3: "Mission",
    4: "Hold",
    5: "Return",
    10: "Acro",
    12: "Descend",
    13: "Termination",
    14: "Offboard",
    15: "Stabilized",
    17: "Takeoff",
    18: "Land",
    19: "Follow Me",
    20: "Precision Land",
    21: "Orbit",
    22: "VTOL Takeoff",
    **{22 + i: f"External {i}" for i in range(1, 9)},
}
#: A mode and an arming logged within this many microseconds are one event.
SAME_EVENT = 1000
#: Number: first and last version (major, minor) in which it had a name, and the name (history of PX4's ``vehicle_status.msg``).
PX4_REUSED: dict[int, tuple[tuple[tuple[int, int], tuple[int, int], str], ...]] = {
    6: (((1, 0), (1, 13), "RC Recovery"), ((1, 15), (99, 0), "Position Slow")),
    7: (((1, 0), (1, 13), "Return to Ground Station"),),
    8: (((1, 0), (1, 13), "Land on Engine Failure"),),
    9: (((1, 0), (1, 13), "Land on GPS Failure"),),
    16: (((1, 0), (1, 11), "Rattitude"),),
}

#: ``ModeNum`` by vehicle (a word of its firmware's name), in the words of ArduPilot's user guides.
ARDUPILOT_MODES: dict[str, dict[int, str]] = {
    "Copter": {
        **dict(enumerate("Stabilize,Acro,AltHold,Auto,Guided,Loiter,RTL,Circle,Position,Land,OF_Loiter,Drift".split(","))),
        **dict(enumerate("Sport,Flip,AutoTune,PosHold,Brake,Throw,Avoid_ADSB,Guided_NoGPS,Smart_RTL,FlowHold".split(","), 13)),
        **dict(enumerate("Follow,ZigZag,SystemID,Heli_Autorotate,Auto RTL,Turtle".split(","), 23)),
    },
    "Plane": {
        **dict(enumerate("Manual,CIRCLE,STABILIZE,TRAINING,ACRO,FBWA,FBWB,CRUISE,AUTOTUNE".split(","))),
        **dict(enumerate("Auto,RTL,Loiter,TAKEOFF,AVOID_ADSB,Guided,Initialising,QSTABILIZE,QHOVER,QLOITER,QLAND,QRTL".split(","), 10)),
        **dict(enumerate("QAUTOTUNE,QACRO,THERMAL,Loiter to QLand,AUTOLAND".split(","), 22)),
    },
    "Rover": {
        **dict(enumerate("Manual,Acro,,Steering,Hold,Loiter,Follow,Simple,Dock,Circle,Auto,RTL,SmartRTL".split(","))),
        15: "Guided",
        16: "Initialising",
    },
    "Sub": {0: "Stabilize", 1: "Acro", 2: "Depth Hold", 3: "Auto", 4: "Guided", 7: "Circle", 9: "Surface", 16: "PosHold", 19: "Manual"},
}


def px4_mode(number: int, version: tuple[int, int] | None) -> str:
    """Name of PX4's ``nav_state``; ``mode N`` where the number or its meaning in this version (major, minor) is not known."""
    for first, last, name in PX4_REUSED.get(number, ()):
        if version is not None and first <= version <= last:
            return name
    return PX4_MODES.get(number, f"mode {number}")


def ardupilot_mode(number: int, vehicle: str | None) -> str:
    """Name of ArduPilot's mode ``number`` on a vehicle (a key of `ARDUPILOT_MODES`); ``mode N`` where it is not known."""
    return ARDUPILOT_MODES.get(vehicle or "", {}).get(number) or f"mode {number}"


def spelt(name: str) -> str:
    """A mode that an old log names in capitals, as today's guides spell it; any other as it stands."""
    bare = name.replace("_", "").replace(" ", "").upper()
    return next((known for known in ARDUPILOT_MODES["Copter"].values() if known.replace("_", "").replace(" ", "").upper() == bare), name)


def add_modes(builder: Builder, modes: tuple[IntArray, Iterable[str]], armed: tuple[IntArray, FloatArray] | None = None) -> None:
    """Add the stream ``modes``: a row at the start and at each change of mode or arming.

    Parameters
    ----------
    builder
        The flight being read.
    modes
        Stamps [us] and names, in any order.
    armed
        Stamps [us] and 1 or 0, NaN unknown. Before its first sample arming is unknown; before the first mode its name is empty.
    """
    named = list(modes[1])
    arm_us, arm = armed if armed is not None else (np.empty(0, np.int64), np.empty(0))
    us = np.concatenate([np.asarray(modes[0], np.int64), np.asarray(arm_us, np.int64)])
    rows: list[tuple[int, str, float]] = []
    mode, state = "", float("nan")
    for i in np.argsort(us, kind="stable"):
        if i < len(named):
            mode = named[i]
        else:
            state = float(arm[i - len(named)])
        row = (int(us[i]), mode, state)
        if rows and row[0] - rows[-1][0] <= SAME_EVENT:
            rows[-1] = row
        elif not rows or rows[-1][1] != mode or not (rows[-1][2] == state or (np.isnan(rows[-1][2]) and np.isnan(state))):
            rows.append(row)
    if rows:
        names = np.array([r[1] for r in rows], dtype=np.str_)
        builder.add("modes", np.array([r[0] for r in rows], np.int64), {"mode": names, "armed": np.array([r[2] for r in rows])})
