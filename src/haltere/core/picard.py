"""One step of the quaternion's differential equation: Picard's approximations, Runge-Kutta, the exact one. It corrects no rates.

q̇ = ½ Ω(ω) q = ½ q ⊗ [0, ω] is linear in q, so that every one of them is a product from the right, q(k+1) = Φ q(k) = q(k) ⊗ p, and Φ
is the matrix of that product. Source W, (5)-(7); theory.md §2.2.
"""

from __future__ import annotations

import math

from haltere._jit import constant, jit
from haltere.core.rotation import Quat, Vec, quat_mul

__all__ = ["EXACT", "INTEGRATORS", "PICARD_1", "PICARD_2", "PICARD_3", "PICARD_4", "RK4", "increment", "picard", "runge_kutta"]

#: Codes, in the order of their words.
PICARD_1, PICARD_2, PICARD_3, PICARD_4, RK4, EXACT = (constant(i) for i in range(6))
INTEGRATORS = ("picard1", "picard2", "picard3", "picard4", "rk4", "exp")


@jit
def picard(order: int, rotation: Vec) -> Quat:
    """p = [c, s Δθ] of Φ = c I + s Ω(Δθ): Taylor's polynomial of that order of exp(Ω(Δθ)/2), order 4 being the published (7).

    Parameters
    ----------
    order
        `PICARD_1` ... `PICARD_4`, or `EXACT`: c = cos(Δ/2), s = sin(Δ/2)/Δ, exact for a constant rate.
    rotation
        Δθ = ∫ω dt [rad], body frame. None of them knows of coning within the step.
    """
    d2 = rotation[0] * rotation[0] + rotation[1] * rotation[1] + rotation[2] * rotation[2]
    c, s = 1.0, 0.5
    if order == EXACT:
        if d2 < 1e-8:  # the series is exact to rounding here, and has no division by zero
            c, s = 1.0 - d2 / 8.0, 0.5 - d2 / 48.0
        else:
            d = math.sqrt(d2)
            c, s = math.cos(0.5 * d), math.sin(0.5 * d) / d
    else:
        if order >= PICARD_2:
            c -= d2 / 8.0
        if order >= PICARD_3:
            s -= d2 / 48.0
        if order >= PICARD_4:
            c += d2 * d2 / 384.0
    return (c, s * rotation[0], s * rotation[1], s * rotation[2])


@jit
def runge_kutta(w0: Vec, w1: Vec, dt: float) -> Quat:
    """p of the classical fourth-order step for a rate that goes from w0 to w1 [rad/s] on a line; it sees the coning of that line."""
    h = 0.5 * dt
    a, b = (0.0, 0.5 * w0[0], 0.5 * w0[1], 0.5 * w0[2]), (0.0, 0.5 * w1[0], 0.5 * w1[1], 0.5 * w1[2])
    m = (0.0, 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2]), 0.5 * (a[3] + b[3]))
    k2 = quat_mul((1.0, h * a[1], h * a[2], h * a[3]), m)
    k3 = quat_mul((1.0 + h * k2[0], h * k2[1], h * k2[2], h * k2[3]), m)
    k4 = quat_mul((1.0 + dt * k3[0], dt * k3[1], dt * k3[2], dt * k3[3]), b)
    s = dt / 6.0
    return (
        1.0 + s * (a[0] + 2.0 * (k2[0] + k3[0]) + k4[0]),
        s * (a[1] + 2.0 * (k2[1] + k3[1]) + k4[1]),
        s * (a[2] + 2.0 * (k2[2] + k3[2]) + k4[2]),
        s * (a[3] + 2.0 * (k2[3] + k3[3]) + k4[3]),
    )


@jit
def increment(order: int, w0: Vec, w1: Vec, dt: float) -> Quat:
    """p of one interval between the rates w0 and w1 [rad/s]; w0 = w1 where a sample is the mean of its interval."""
    if order == RK4:
        return runge_kutta(w0, w1, dt)
    h = 0.5 * dt
    return picard(order, (h * (w0[0] + w1[0]), h * (w0[1] + w1[1]), h * (w0[2] + w1[2])))
