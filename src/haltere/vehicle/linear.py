"""The lumped force and moment model with its derivatives against velocity through the air and rate, for filters. It has no state."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.core.rotation import Mat, Vec, norm
from haltere.vehicle.regressors import model

__all__ = ["Linear", "linear"]

#: Specific force [m/s^2], angular acceleration [rad/s^2]; ∂f/∂v_a, ∂f/∂ω, ∂ω̇/∂v_a, ∂ω̇/∂ω.
Linear = tuple[Vec, Vec, Mat, Mat, Mat, Mat]


@jit
def linear(m: Any, speeds: Any, accelerations: Any, v: Vec, w: Vec, eta: Vec, ratio: float) -> Linear:
    """Model of `haltere.vehicle.regressors.model` at one time, and its derivatives (theory.md §5.3, theory-amendments.md 12).

    Parameters
    ----------
    m
        Record of the vehicle's constants.
    speeds, accelerations
        Of the rotors [rad/s, rad/s^2].
    v, w
        Velocity through the air [m/s] and rate [rad/s], body FRD.
    eta
        The rate again; in the literal reading the angular acceleration, whose own derivative is left away.
    ratio
        Air density over that of the constants.
    """
    f, a = model(m, speeds, accelerations, v, w, eta, ratio)
    s1, v_r, v_p = 0.0, 0.0, 0.0
    for i in range(len(m.yaw)):
        s1 += speeds[i]
        v_r += m.roll[i] * speeds[i]
        v_p += m.pitch[i] * speeds[i]
    k, g = m.k, ratio
    size = norm(v)
    x0, x3 = g * k[0, 0] * s1 + g * k[0, 2], g * k[0, 3]
    y0, y3 = g * k[1, 0] * s1 + g * k[1, 2], g * k[1, 3]
    unit = (v[0] / size, v[1] / size, v[2] / size) if size > 1e-9 else (0.0, 0.0, 0.0)
    D_a = (
        (x0 + x3 * (size + v[0] * unit[0]), x3 * v[0] * unit[1], x3 * v[0] * unit[2]),
        (y3 * v[1] * unit[0], y0 + y3 * (size + v[1] * unit[1]), y3 * v[1] * unit[2]),
        (2.0 * g * k[2, 1] * v[0], 2.0 * g * k[2, 1] * v[1], g * k[2, 2] * s1),
    )
    own = 0.0 if m.literal == 1 else g
    D_w = ((0.0, own * k[0, 1], 0.0), (own * k[1, 1], 0.0, 0.0), (0.0, 0.0, 0.0))
    M_a = (
        (g * k[3, 5] * w[2], g * k[3, 4] * s1, g * k[3, 6] * v_r),
        (g * k[4, 4] * s1, g * k[4, 5] * w[2], g * k[4, 6] * v_p),
        (g * k[5, 5] * v_r, g * k[5, 6] * v_p, 0.0),
    )
    s = g * s1 / m.s1 if m.s1 > 0.0 else g
    M_w = (
        (s * k[3, 2], k[3, 1] * w[2], k[3, 1] * w[1] + g * k[3, 5] * v[0]),
        (k[4, 1] * w[2], s * k[4, 2], k[4, 1] * w[0] + g * k[4, 5] * v[1]),
        (k[5, 1] * w[1], k[5, 1] * w[0], s * k[5, 2]),
    )
    return f, a, D_a, D_w, M_a, M_w
