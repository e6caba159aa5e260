"""Force and moment of a multirotor linear in lumped constants (theory.md §5.2, theory-amendments.md 12): columns, and the model. No fit.

Per mass and inertia, with the rotor speeds Ω, S1 = ΣΩ, S2 = ΣΩ², the velocity through the air v, the rate ω = (p, q, r), and weights of the
rotors about each axis, U_R = Σ roll Ω², U_P = Σ pitch Ω², U_Q = Σ yaw Ω² (of a known geometry -y, x and the spin), and the same sums of
Ω, V_R and V_P:

====  =============================================================================
axis  columns
====  =============================================================================
hx    S1 v_x, η_x, v_x, |v| v_x, 1
hy    S1 v_y, η_y, v_y, |v| v_y, 1
t     S2, v_x² + v_y², S1 v_z, 1
r     U_R, q r, s p, S2, S1 v_y, r v_x, V_R v_z
p     U_P, p r, s q, S2, S1 v_x, r v_y, V_P v_z
q     U_Q, p q, s r, Σ yaw Ω̇, S2, V_R v_x, V_P v_y
====  =============================================================================

η is the rate about the other axis (q for hx, p for hy); in the preset ``literal`` the angular acceleration about it.

The last two of each moment and the factor s are not in theory.md, but follow from its forces (§5.2) at hubs that each have a velocity
of their own, v + ω×r. Damping of rates is that of forces which go with the rotor speed (k_z, k_d): s = S1 over the S1 of the constants
(1 where that is not known). Who yaws in forward flight has more lift on the side that advances (k_h; r v_x). Rotors that turn faster on
one side damp a climb more there (k_z; V_R v_z), and have more drag there (k_d; V_R v_x).
"""

from __future__ import annotations

from typing import Any

from haltere._jit import entry, jit
from haltere.core.lumped import COLUMNS, lumped_layout
from haltere.core.rotation import Vec, norm

__all__ = ["AERO", "AXES", "COLUMNS", "NAMES", "PRESETS", "lumped_layout", "model", "predict", "regress", "regressors"]

#: Axes of the model in the order of its rows (interface.md §3: model axes).
AXES = ("hx", "hy", "t", "r", "p", "q")
#: Names of the constants, as theory.md §5.2 numbers them, more after.
NAMES: tuple[tuple[str, ...], ...] = (
    ("kHx0", "kHx1", "kHx2", "kHx3", "kHx4"),
    ("kHy0", "kHy1", "kHy2", "kHy3", "kHy4"),
    ("kT0", "kT1", "kT2", "kT3", ""),
    ("kR0", "kR1", "kR2", "kR3", "kR4", "kR5", "kR6"),
    ("kP0", "kP1", "kP2", "kP3", "kP4", "kP5", "kP6"),
    ("kQ0", "kQ1", "kQ2", "kQ3", "kQ4", "kQ5", "kQ6"),
)
#: Columns that each preset uses, by axis.
PRESETS: dict[str, tuple[tuple[int, ...], ...]] = {
    "literal": ((0, 1, 2), (0, 1, 2), (0, 1), (0, 1, 2), (0, 1, 2), (0, 1, 2)),
    "rate": ((0, 1, 2), (0, 1, 2), (0, 1), (0, 1, 2), (0, 1, 2), (0, 1, 2)),
    "full": ((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (0, 1, 2, 3), *(tuple(range(7)),) * 3),
}
#: Columns that are of the air and go with its density, by axis; the others are of inertia and of the sensors.
AERO: tuple[tuple[bool, ...], ...] = (
    (True, True, True, True, False, False, False),
    (True, True, True, True, False, False, False),
    (True, True, True, False, False, False, False),
    (True, False, True, True, True, True, True),
    (True, False, True, True, True, True, True),
    (True, False, True, False, True, True, True),
)

Row = tuple[float, float, float, float, float, float, float]


@jit
def regressors(m: Any, speeds: Any, accelerations: Any, v: Vec, w: Vec, eta: Vec) -> tuple[Row, Row, Row, Row, Row, Row]:
    """Columns of every axis at one time; the air density is that of the constants.

    ``m`` has the weights, ``speeds`` [rad/s] and ``accelerations`` [rad/s^2] are of the rotors, ``v`` is through the air [m/s], ``w``
    the rate [rad/s], all body FRD. ``eta`` is the rate too, or the angular acceleration in the literal reading.
    """
    s1, s2, u_r, u_p, u_q, h, v_r, v_p = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(m.yaw)):
        o = speeds[i]
        s1 += o
        s2 += o * o
        u_r += m.roll[i] * o * o
        u_p += m.pitch[i] * o * o
        u_q += m.yaw[i] * o * o
        h += m.yaw[i] * accelerations[i]
        v_r += m.roll[i] * o
        v_p += m.pitch[i] * o
    k = norm(v)
    s = s1 / m.s1 if m.s1 > 0.0 else 1.0
    return (
        (s1 * v[0], eta[1], v[0], k * v[0], 1.0, 0.0, 0.0),
        (s1 * v[1], eta[0], v[1], k * v[1], 1.0, 0.0, 0.0),
        (s2, v[0] * v[0] + v[1] * v[1], s1 * v[2], 1.0, 0.0, 0.0, 0.0),
        (u_r, w[1] * w[2], s * w[0], s2, s1 * v[1], w[2] * v[0], v_r * v[2]),
        (u_p, w[0] * w[2], s * w[1], s2, s1 * v[0], w[2] * v[1], v_p * v[2]),
        (u_q, w[0] * w[1], s * w[2], h, s2, v_r * v[0], v_p * v[1]),
    )


@jit
def model(m: Any, speeds: Any, accelerations: Any, v: Vec, w: Vec, eta: Vec, ratio: float) -> tuple[Vec, Vec]:
    """Specific force [m/s^2] and angular acceleration [rad/s^2] of the model at ``ratio`` times the density of its constants."""
    c = regressors(m, speeds, accelerations, v, w, eta)
    f = (_sum(m, 0, c[0], ratio), _sum(m, 1, c[1], ratio), _sum(m, 2, c[2], ratio))
    return f, (_sum(m, 3, c[3], ratio), _sum(m, 4, c[4], ratio), _sum(m, 5, c[5], ratio))


@jit
def _sum(m: Any, axis: int, c: Row, ratio: float) -> float:
    out = 0.0
    for j in range(7):
        out += m.k[axis, j] * c[j] * (1.0 + m.aero[axis, j] * (ratio - 1.0))
    return out


@entry
def regress(M: Any, speeds: Any, accelerations: Any, v: Any, w: Any, eta: Any, out: Any) -> None:
    """Columns (n, 6, 7) over a flight; ``M`` holds one record."""
    m = M[0]
    for k in range(len(v)):
        c = regressors(
            m, speeds[k], accelerations[k], (v[k, 0], v[k, 1], v[k, 2]), (w[k, 0], w[k, 1], w[k, 2]), (eta[k, 0], eta[k, 1], eta[k, 2])
        )
        for i in range(6):
            for j in range(7):
                out[k, i, j] = c[i][j]


@entry
def predict(M: Any, speeds: Any, accelerations: Any, v: Any, w: Any, eta: Any, ratio: Any, out: Any) -> None:
    """Specific force and angular acceleration (n, 6) over a flight; ``M`` holds one record."""
    m = M[0]
    for k in range(len(v)):
        f, a = model(
            m, speeds[k], accelerations[k], (v[k, 0], v[k, 1], v[k, 2]), (w[k, 0], w[k, 1], w[k, 2]), (eta[k, 0], eta[k, 1], eta[k, 2]),
            ratio[k],
        )  # fmt: skip
        for i in range(3):
            out[k, i] = f[i]
            out[k, 3 + i] = a[i]
