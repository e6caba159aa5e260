"""What a statistic usually comes to in this flight, and by how much that raises its threshold: innovations are not quite white.

A record with ``peak``, ``waiting``, ``usual`` (one of each a statistic) and ``t_usual``. The largest ratio of statistic to threshold of a
stretch counts one stretch late, so that a fault does not raise the threshold that it has to pass.
"""

from __future__ import annotations

from typing import Any

from haltere._jit import jit

__all__ = ["begin", "learn", "raised"]

#: A threshold is at least so many times what is usual; a stretch [s]; how fast that is learnt upwards and downwards; its bound.
BEYOND, STRETCH, RISE, FALL, CAP = 2.0, 10.0, 0.6, 0.1, 2.0


@jit
def begin(x: Any, t: float) -> None:
    """Nothing is known at ``t``."""
    x.t_usual = t + STRETCH
    for k in range(len(x.usual)):
        x.peak[k], x.waiting[k], x.usual[k] = 0.0, 0.0, 0.0


@jit
def learn(x: Any, t: float) -> None:
    """At the end of a stretch, take the largest of the one before."""
    if t < x.t_usual:
        return
    x.t_usual = t + STRETCH
    for k in range(len(x.usual)):
        x.usual[k] += (RISE if x.waiting[k] > x.usual[k] else FALL) * (x.waiting[k] - x.usual[k])
        x.waiting[k] = min(x.peak[k], CAP)
        x.peak[k] = 0.0


@jit
def raised(x: Any, k: int) -> float:
    """Factor on the threshold of statistic ``k``."""
    return max(1.0, BEYOND * x.usual[k])
