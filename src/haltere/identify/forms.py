"""Models of the drag across the thrust axis, as autopilots and as haltere write them, over whole flights at once. They fit nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haltere.errors import UsageError, nearest

__all__ = ["FORMS", "G0", "RHO0", "Form", "ardupilot_density", "drag_force", "drag_slopes"]

FloatArray = NDArray[np.float64]

#: Air density at sea level in the standard atmosphere [kg/m^3], and the gravity that thrust is set against [m/s^2].
RHO0, G0 = 1.225, 9.80665


@dataclass(frozen=True)
class Form:
    """One model of drag.

    Attributes
    ----------
    names, units
        Of its parameters: the linear one first, then the quadratic ones.
    prior, scale
        What is thought of each before the flight, and its 1 sigma, of the first that of its logarithm: so wide that any flight that tells
        anything overrules it.
    said
        The model in one line.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    prior: tuple[float, ...]
    scale: tuple[float, ...]
    said: str


#: Models by name. Force per mass [m/s^2] along body x and y, with the air velocity v_a [m/s], its length over all three axes |v_a|, thrust
#: per mass T and air density ρ. The drag of a rotor goes with its speed, which goes with the root of its thrust where nothing blows
#: through it along its axis: ``rotors`` knows the speeds, ``haltere`` takes that root, the autopilots a constant. PX4:
#: src/modules/ekf2/EKF/aid_sources/drag/drag_fusion.cpp (00c59fa); ArduPilot: libraries/AP_NavEKF3/AP_NavEKF3_AirDataFusion.cpp
#: (031de06), each with the density as that code computes it.
FORMS: dict[str, Form] = {
    "haltere": Form(
        ("mu", "c"), ("1/s", "1/m"), (0.3, 0.01), (0.7, 0.02),
        "f = -mu sqrt(rho/rho0) sqrt(T/g) v - (rho/rho0) c |v_a| v",
    ),
    "rotors": Form(
        ("h", "c"), ("1/rad", "1/m"), (1.5e-4, 0.01), (1.5, 0.02),
        "f = -(rho/rho0) (h S + c |v_a|) v, S the sum of the rotor speeds",
    ),
    "lumped": Form(
        ("hx0", "hx2", "hx3", "hy0", "hy2", "hy3"), ("1/rad", "1/s", "1/m", "1/rad", "1/s", "1/m"),
        (1.5e-4, 0.0, 0.01, 1.5e-4, 0.0, 0.01), (1.5, 0.1, 0.02, 3e-4, 0.1, 0.02),
        "f = -(rho/rho0) (h0 S + h2 + h3 |v_a|) v, each axis by itself",
    ),
    "px4": Form(
        ("mcoef", "inverse_bcoef_x", "inverse_bcoef_y"), ("1/s", "m^2/kg", "m^2/kg"), (0.3, 0.016, 0.016), (0.7, 0.035, 0.035),
        "f = -MCOEF sqrt(rho/rho0) v - rho/2 |v_a| v / BCOEF, 1/BCOEF by the direction of v between 1/BCOEF_X and 1/BCOEF_Y",
    ),
    "ardupilot": Form(
        ("mcoef", "inverse_bcoef_x", "inverse_bcoef_y"), ("1/s", "m^2/kg", "m^2/kg"), (0.3, 0.016, 0.016), (0.7, 0.035, 0.035),
        "f = -MCOEF sqrt(EAS2TAS) v - rho/2 |v| v / BCOEF, each axis by itself",
    ),
}  # fmt: skip


def ardupilot_density(rho: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Factor of MCOEF and the density [kg/m^3] that ArduPilot uses in air of a true density: EAS2TAS = √(ρ0/ρ), and its square root.

    Its drag fusion takes 1.225 times √EAS2TAS for the density, which rises with height: parameters are fitted to what it computes.
    """
    ratio = np.sqrt(np.sqrt(RHO0 / np.asarray(rho, dtype=np.float64)))
    return ratio, RHO0 * ratio


def drag_force(form: str, p: FloatArray, v: FloatArray, load: FloatArray, rho: FloatArray) -> FloatArray:
    """Force per mass (n, 2) [m/s^2] along body x and y.

    Parameters
    ----------
    form
        One of `FORMS`.
    p
        Its parameters.
    v
        Velocity through the air, body FRD (n, 3) [m/s].
    load
        Thrust per mass (n,) [m/s^2], for ``rotors`` and ``lumped`` the sum of their speeds [rad/s].
    rho
        Air density (n,) [kg/m^3].
    """
    across = v[:, :2]
    speed = np.sqrt(v[:, 0] ** 2 + v[:, 1] ** 2 + v[:, 2] ** 2)
    if form == "haltere":
        linear = p[0] * np.sqrt(rho / RHO0 * np.maximum(load, 0.0) / G0)
        return np.asarray(-(linear + rho / RHO0 * p[1] * speed)[:, None] * across)
    if form == "rotors":
        return np.asarray(-(rho / RHO0 * (p[0] * load + p[1] * speed))[:, None] * across)
    if form == "lumped":
        slopes = (np.outer(load, p[[0, 3]]) + p[[1, 4]] + np.outer(speed, p[[2, 5]])) * (rho / RHO0)[:, None]
        return np.asarray(-slopes * across)
    if form == "px4":
        level = np.maximum(across[:, 0] ** 2 + across[:, 1] ** 2, 1e-300)
        # PX4 takes the root of the mean square of the two; the mean is smooth through zero, and 5 % less where one is twice the other
        b = (p[1] * across[:, 0] ** 2 + p[2] * across[:, 1] ** 2) / level
        return np.asarray(-(p[0] * np.sqrt(rho / RHO0) + 0.5 * rho * b * speed)[:, None] * across)
    if form == "ardupilot":
        ratio, density = ardupilot_density(rho)
        return np.asarray(-(p[0] * ratio)[:, None] * across - 0.5 * density[:, None] * p[1:] * np.abs(across) * across)
    raise UsageError(f"a model of drag: {', '.join(FORMS)}", repr(form), "identify", nearest(form, FORMS))


def drag_slopes(form: str, p: FloatArray, v: FloatArray, load: FloatArray, rho: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `drag_force` by its parameters (n, 2, p) and by the air velocity (n, 2, 3).

    The models are linear in their parameters; by the velocity they are differences, good to 1e-8.
    """
    by_p = np.stack([drag_force(form, unit, v, load, rho) for unit in np.eye(len(p))], axis=2)
    by_v = np.empty((len(v), 2, 3))
    for k in range(3):
        up, down = v.copy(), v.copy()
        up[:, k] += 1e-4
        down[:, k] -= 1e-4
        by_v[:, :, k] = (drag_force(form, p, up, load, rho) - drag_force(form, p, down, load, rho)) / 2e-4
    return by_p, by_v
