"""What the findings on gyro and accelerometer changed: how far off the same run would have become without them. It finds no fault."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.solution import Solution
from haltere.metrics.attitude import euler

__all__ = ["apart", "findings", "tell"]

FloatArray = NDArray[np.float64]
#: How long after a finding its consequence is looked at [s].
AFTER = 60.0


def findings(events: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Faults of gyro and accelerometer that the filter has named, and acted on."""
    return [e for e in events if e["sensor"] in ("gyro", "accel") and e["t_isolated"] is not None]


def apart(solution: Solution, without: Solution) -> dict[str, FloatArray]:
    """The run without the findings less the run with them, at the times of the former.

    Returns
    -------
    dict
        ``t`` (n,) [s], ``roll``, ``pitch``, ``yaw`` and ``tilt`` [deg], and where there is a velocity the lengths ``vel`` [m/s] and
        ``pos`` [m].
    """
    t = without.t
    k = np.clip(np.searchsorted(solution.t, t), 0, len(solution.t) - 1)
    a, b = without.vector("q", "wxyz"), solution.vector("q", "wxyz")[k]
    turn = (euler(a) - euler(b) + math.pi) % (2.0 * math.pi) - math.pi
    out = {"t": t, **{name: np.degrees(turn[:, i]) for i, name in enumerate(("roll", "pitch", "yaw"))}}
    down = [np.column_stack([2 * (q[:, 1] * q[:, 3] - q[:, 0] * q[:, 2]), 2 * (q[:, 2] * q[:, 3] + q[:, 0] * q[:, 1]),
                             1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2)]) for q in (a, b)]  # fmt: skip
    out["tilt"] = np.degrees(np.arccos(np.clip(np.sum(down[0] * down[1], axis=1), -1.0, 1.0)))
    for stem in ("vel", "pos"):
        if f"{stem}_n" in without and f"{stem}_n" in solution:
            out[stem] = np.linalg.norm(without.vector(stem, "ned") - solution.vector(stem, "ned")[k], axis=1)
    return out


def tell(solution: Solution) -> None:
    """Add to the evidence of each finding what would have become of the run without, in place."""
    if solution.without is None:
        return
    found, off = findings(solution.events), apart(solution, solution.without)
    for i, e in enumerate(found):
        end = min(e["t_isolated"] + AFTER, found[i + 1]["t_onset"] if i + 1 < len(found) else math.inf)
        mine = (off["t"] >= e["t_onset"]) & (off["t"] <= end)
        if mine.any():
            words = [f"tilt off by up to {off['tilt'][mine].max():.2g} deg", f"heading by {np.abs(off['yaw'][mine]).max():.2g} deg"]
            words += [f"velocity by {off['vel'][mine].max():.2g} m/s"] if "vel" in off else []
            e["evidence"] += f"; without the finding: {', '.join(words)} until {min(end, float(off['t'][-1])):.0f} s"
