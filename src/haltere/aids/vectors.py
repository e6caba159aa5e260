"""The three observations of the filter of source W as h and H against the four elements of a quaternion. It fuses nothing.

Each is a vector known in the navigation frame and seen in the body: h = C(q)ᵀ a (theory.md §3.2), quadratic in q, whence H q = 2 h.
"""

from __future__ import annotations

from haltere._jit import jit
from haltere.core.rotation import Mat, Quat, Vec, dcm, mul_mat, tmat_vec
from haltere.filter.joint import Rows

__all__ = ["printed_wind_rows", "seen", "seen_rows", "turned_covariance"]


@jit
def seen(q: Quat, a: Vec) -> Vec:
    """h = C(q)ᵀ a: (11) for a = e3, (12) as corrected for the field, (19) for v - W."""
    return tmat_vec(dcm(q), a)


@jit
def seen_rows(q: Quat, a: Vec) -> Rows:
    """∂(C(q)ᵀ a)/∂q = 2 [s a - v × a, (v·a) I + v aᵀ - a vᵀ + s [a]×] (theory.md §2.1); rows 1-6 of (20) for a = e3 and the field."""
    s, x, y, z = q
    p = 2.0 * (s * a[0] + z * a[1] - y * a[2])
    r = 2.0 * (x * a[0] + y * a[1] + z * a[2])
    t = 2.0 * (-y * a[0] + x * a[1] - s * a[2])
    u = 2.0 * (-z * a[0] + s * a[1] + x * a[2])
    return ((p, r, t, u), (u, -t, r, -p), (-t, -u, p, r))


@jit
def printed_wind_rows(q: Quat) -> Rows:
    """Rows 7-9 of (20) as printed: no velocity, no wind. They are of another function (theory.md §3.4)."""
    s, x, y, z = q
    return (
        (2.0 * z, -2.0 * y, -2.0 * x, 2.0 * s),
        (-2.0 * s, 2.0 * x, -2.0 * y, 2.0 * z),
        (-2.0 * x, -2.0 * s, -2.0 * y, -2.0 * z),
    )


@jit
def turned_covariance(q: Quat, r: Vec) -> Mat:
    """Cᵀ diag(r) C: a covariance along north, east, down seen in the body."""
    C = dcm(q)
    T = (
        (C[0][0], C[1][0], C[2][0]),
        (C[0][1], C[1][1], C[2][1]),
        (C[0][2], C[1][2], C[2][2]),
    )
    scaled = (
        (T[0][0] * r[0], T[0][1] * r[1], T[0][2] * r[2]),
        (T[1][0] * r[0], T[1][1] * r[1], T[1][2] * r[2]),
        (T[2][0] * r[0], T[2][1] * r[1], T[2][2] * r[2]),
    )
    return mul_mat(scaled, C)
