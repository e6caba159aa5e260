"""What the filter does about a fault: its effect on the state is taken back, and the failed axis is open again. It names nothing."""

from __future__ import annotations

from typing import Any

from haltere._jit import constant, jit
from haltere.aids import compass
from haltere.filter.signatures import GYRO_RAMP, SLOTS, VELOCITY, clear
from haltere.strapdown.propagate import inject

__all__ = ["follow", "heal", "heal_between"]

#: Families of inertial faults, the first ones.
N_INERTIAL = constant(6)
#: Part of a size that its onset and linearity leave open, 1 sigma.
LEFT = 0.1
#: A ramp that was named is followed for so long; its bias then walks as fast as it goes in about this time [s].
FOLLOWED, LAG = 10.0, 2.0


@jit
def follow(s: Any, dt: float) -> None:
    """Let the bias of an axis whose ramp was named walk as fast as it was found to go."""
    b = s.bank[0]
    for a in range(len(b.slope)):
        if b.slope[a] != 0.0:
            if s.t > b.t_slope[a]:
                b.slope[a] = 0.0
            s.P[9 + a, 9 + a] += b.slope[a] * b.slope[a] * LAG * dt


@jit
def heal_between(s: Any, candidates: int) -> bool:
    """Several inertial faults explain alike: take back the mean of what they would have done, and be as unsure as they differ.

    With equal weights x̂ <- x̂ + m, m = Σ b̂ x / n, P <- P + Σ (b̂ x - m)(b̂ x - m)ᵀ / n + σ² x xᵀ. The filter then finds out by itself.
    """
    b = s.bank[0]
    n, total = s.P.shape[0], 0.0
    for g in range(N_INERTIAL):
        total += float((candidates >> g) & 1)
    if total == 0.0 or candidates >> N_INERTIAL != 0:
        return False
    for g in range(N_INERTIAL):
        if (candidates >> g) & 1 == 1:
            j = b.fault[g] * SLOTS + b.slot[g]
            for i in range(n):
                s.dx[i] += b.num[j] / b.den[j] * b.x[i, j] / total
    for g in range(N_INERTIAL):
        if (candidates >> g) & 1 == 1:
            j = b.fault[g] * SLOTS + b.slot[g]
            size = b.num[j] / b.den[j]
            variance = 1.0 / b.den[j] + LEFT * LEFT * size * size
            for i in range(n):
                for c in range(n):
                    apart = (size * b.x[i, j] - s.dx[i]) * (size * b.x[c, j] - s.dx[c])
                    s.P[i, c] += (apart + variance * b.x[i, j] * b.x[c, j]) / total
    inject(s)
    b.healed += 1
    b.yaw = s.yaw_corrected
    compass.forget(s)
    clear(b)
    return True


@jit
def heal(s: Any, f: int, k: int) -> None:
    """Take back what fault ``f`` since the onset of slot ``k`` has put into the state: x̂ <- x̂ + b̂ x, P <- P + σ² x xᵀ."""
    b = s.bank[0]
    j = f * SLOTS + k
    size = b.num[j] / b.den[j]
    variance = 1.0 / b.den[j] + LEFT * LEFT * size * size
    n = s.P.shape[0]
    for i in range(n):
        s.dx[i] = size * b.x[i, j]
    for i in range(n):
        for c in range(n):
            s.P[i, c] += variance * b.x[i, j] * b.x[c, j]
    inject(s)
    b.healed += 1
    if f >= GYRO_RAMP and f < VELOCITY:
        a = f - GYRO_RAMP
        b.slope[a], b.t_slope[a] = abs(size), s.t + FOLLOWED
    b.yaw = s.yaw_corrected
