"""Wind at a vehicle: a mean with shear, and Dryden turbulence exact at any step. It knows no vehicle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from haltere._jit import entry, jit
from haltere.core.rotation import Vec

__all__ = ["WIND", "gust", "gust_now", "shear"]

#: Slowest speed through the air [m/s] at which turbulence is carried past a vehicle.
SLOWEST = 1.0

#: Turbulence: 1 sigma [m/s] and lengths [m] along, across and down, the direction of the mean (cosine and sine of where it blows to),
#: its filters' states; shear: exponent and the height [m] at which the mean holds (0: no shear).
WIND = np.dtype(
    [
        ("sd", "f8", 3), ("length", "f8", 3), ("cos", "f8"), ("sin", "f8"), ("along", "f8"), ("across", "f8", 2), ("down", "f8", 2),
        ("exponent", "f8"), ("height", "f8"),
    ],
    align=True,
)  # fmt: skip


@jit
def shear(w: Any, height: float) -> float:
    """Factor of the mean wind at a height [m] above ground: the power law, constant below one metre."""
    if w.height <= 0.0:
        return 1.0
    return math.pow(max(height, 1.0) / w.height, w.exponent)


@jit
def _second_order(x: Any, sd: float, r: float, n1: float, n2: float) -> float:
    """One step of the Dryden filter (1 + √3 T s) / (1 + T s)² driven by white noise, r = dt / T, stationary variance sd².

    States x1 = 1/(1 + T s), x2 = 1/(1 + T s)² of the noise; the noise of a step has the covariance P - Φ P Φᵀ with the stationary
    P = sd² [1/2, 1/4; 1/4, 1/4], so that variance and spectrum do not depend on dt.
    """
    a = math.exp(-r)
    b = a * a
    q11, q12, q22 = 0.5 * (1.0 - b), 0.25 - b * (0.25 + 0.5 * r), 0.25 - b * (0.25 + 0.5 * r + 0.5 * r * r)
    l11 = math.sqrt(q11)
    l21 = q12 / l11
    l22 = math.sqrt(max(q22 - l21 * l21, 0.0))
    x2 = a * x[1] + a * r * x[0] + sd * (l21 * n1 + l22 * n2)
    x[0] = a * x[0] + sd * l11 * n1
    x[1] = x2
    return _output(x)


@jit
def _turned(w: Any, across: float, down: float) -> Vec:
    return (w.cos * w.along - w.sin * across, w.sin * w.along + w.cos * across, down)


@jit
def _output(x: Any) -> float:
    return 1.7320508075688772 * float(x[0]) + (1.0 - 1.7320508075688772) * float(x[1])


@entry
def gust_now(W: Any) -> Vec:
    """Turbulence as it stands [m/s], NED; ``W`` holds one record."""
    w = W[0]
    return _turned(w, _output(w.across), _output(w.down))


@jit
def gust(w: Any, airspeed: float, dt: float, noise: Any) -> Vec:
    """Turbulence after ``dt`` seconds [m/s], NED (MIL-F-8785C, Dryden form; frozen and carried past at ``airspeed``).

    ``noise`` holds five independent normal numbers.
    """
    speed = max(airspeed, SLOWEST)
    a = math.exp(-dt * speed / w.length[0])
    w.along = a * w.along + w.sd[0] * math.sqrt(1.0 - a * a) * noise[0]
    across = _second_order(w.across, w.sd[1], dt * speed / w.length[1], noise[1], noise[2])
    down = _second_order(w.down, w.sd[2], dt * speed / w.length[2], noise[3], noise[4])
    return _turned(w, across, down)
