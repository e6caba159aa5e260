"""Velocity through the air in the body frame, with its variances: from vanes, or from the drag that specific force shows. No filter.

One face for both: ``v`` [m/s] (u, v, w; NaN where not known) and three variances ``r`` [m^2/s^2], along the air axes (with the flow, of
growing angle of attack, of growing sideslip) for vanes, along the body's for drag. Source W, (13)-(15); theory.md §3.2, §5.2.
"""

from __future__ import annotations

import math

from haltere._jit import jit
from haltere.core.rotation import Mat, Vec, cross, norm

__all__ = ["ENOUGH", "air_covariance", "from_drag", "from_vanes", "polar_jacobian"]

#: Airspeed over its 1 sigma from which its direction means something (theory-amendments.md §11).
ENOUGH = 3.0


@jit
def from_vanes(airspeed: float, aoa: float, sideslip: float, sd: float, sd_aoa: float, sd_sideslip: float) -> tuple[Vec, Vec]:
    """(15): v = V [cosα cosβ, sinβ, sinα cosβ], and its variances in air axes.

    Angles of vanes in a flow that itself is only known to σ_V are worth no more than σ_V/V: σ_β² + (σ_V/V)², and
    σ_α² + (σ_V/(V cosβ))² of its part in the plane of symmetry (theory-amendments.md §11). Without that the variance across vanishes
    with V.
    """
    ca, sa, cb, sb = math.cos(aoa), math.sin(aoa), math.cos(sideslip), math.sin(sideslip)
    r, v2 = sd * sd, airspeed * airspeed
    v = (airspeed * ca * cb, airspeed * sb, airspeed * sa * cb)
    return v, (r, cb * cb * v2 * sd_aoa * sd_aoa + r, v2 * sd_sideslip * sd_sideslip + r)


@jit
def polar_jacobian(airspeed: float, aoa: float, sideslip: float) -> Mat:
    """J = ∂v/∂(V, α, β) (theory.md §3.2); its columns are orthogonal."""
    ca, sa, cb, sb = math.cos(aoa), math.sin(aoa), math.cos(sideslip), math.sin(sideslip)
    return (
        (ca * cb, -airspeed * sa * cb, -airspeed * ca * sb),
        (sb, 0.0, airspeed * cb),
        (sa * cb, airspeed * ca * cb, -airspeed * sa * sb),
    )


@jit
def air_covariance(v: Vec, r: Vec) -> Mat:
    """Covariance in the body frame of a velocity with variances in air axes: J diag(σ²) Jᵀ of J's orthogonal columns."""
    u = norm(v)
    flat = math.sqrt(v[0] * v[0] + v[2] * v[2])
    x = (v[0] / u, v[1] / u, v[2] / u)
    a = (-v[2] / flat, 0.0, v[0] / flat) if flat > 1e-9 * u else (0.0, 0.0, 1.0)
    b = cross(a, x)
    c01 = r[0] * x[0] * x[1] + r[1] * a[0] * a[1] + r[2] * b[0] * b[1]
    c02 = r[0] * x[0] * x[2] + r[1] * a[0] * a[2] + r[2] * b[0] * b[2]
    c12 = r[0] * x[1] * x[2] + r[1] * a[1] * a[2] + r[2] * b[1] * b[2]
    return (
        (r[0] * x[0] * x[0] + r[1] * a[0] * a[0] + r[2] * b[0] * b[0], c01, c02),
        (c01, r[0] * x[1] * x[1] + r[1] * a[1] * a[1] + r[2] * b[1] * b[1], c12),
        (c02, c12, r[0] * x[2] * x[2] + r[1] * a[2] * a[2] + r[2] * b[2] * b[2]),
    )


@jit
def from_drag(f: Vec, mu: float, c: float, sd_force: float, sd_mu: float) -> tuple[Vec, Vec]:
    """Air velocity along body x and y whose drag is the specific force there: -(µ + c |v|) v = f_xy, |v| in the plane, z not known.

    Parameters
    ----------
    f
        Specific force without accelerometer bias and drag offset [m/s^2].
    mu, c
        Coefficients as they are here and now [1/s, 1/m], see `haltere.aids.drag`.
    sd_force
        1 sigma of the force, of its bias too [m/s^2].
    sd_mu
        1 sigma of ln µ.

    Returns
    -------
    tuple
        v = (u, v, NaN) and variances along the body's axes: those of the force over the slope of the drag, and of µ.
    """
    size = math.sqrt(f[0] * f[0] + f[1] * f[1])
    speed = 2.0 * size / (mu + math.sqrt(mu * mu + 4.0 * c * size))
    slope = mu + c * speed
    v = (-f[0] / slope, -f[1] / slope, math.nan)
    r = sd_force * sd_force / (slope * slope)
    s = mu * sd_mu / (mu + 2.0 * c * speed)
    return v, (r + v[0] * v[0] * s * s, r + v[1] * v[1] * s * s, math.nan)
