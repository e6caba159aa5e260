"""State of the published quaternion filter as a dtype, and its time update. It takes no measurement.

Four additive states, x = q (source W, (4)-(7), (21)-(22)): no velocity, no biases. What drives and shows estimators finds the same
fields as in `strapdown.layout`, those of states that are not there with length zero.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from haltere._jit import jit
from haltere.core.rotation import Mat, Quat, Vec, quat_mul
from haltere.strapdown.layout import AID_STATE, AIR, EVENT, EVENT_CAPACITY, IMU_CAPACITY, IMU_SAMPLE, MEASUREMENT, N_QUEUES, STAGE

__all__ = ["attitude_covariance", "normalise", "predict", "quaternion_covariance", "quaternion_layout"]

#: Sensors that have a memory, and measurements that wait of each that is queued.
SENSORS, CAPACITY = 18, 64


@cache
def quaternion_layout() -> np.dtype[np.void]:
    """State record type."""
    return np.dtype(
        [
            ("t", "f8"),
            ("x", "f8", 4),  # the filter's state
            ("q", "f8", 4),  # the attitude that it gives out: of length one
            *((name, "f8", (0,)) for name in ("v", "p", "bg", "ba", "baro", "mag", "wind", "drag", "steady", "vane", "twist")),
            ("P", "f8", (4, 4)),
            ("work", "f8", (3, 4, 4)),
            ("w_raw", "f8", 3),
            ("f_raw", "f8", 3),
            ("gravity", "f8"),
            ("origin", "f8", 3),
            ("has_origin", "i8"),
            ("field", "f8", 3),  # declination, dip [rad], strength [uT] in use
            ("has_field", "i8"),
            ("t_gnss", "f8"),  # the last velocity over ground, its variances, and the acceleration that the last ones show, NED
            ("gnss_v", "f8", 3),
            ("gnss_r", "f8", 3),
            ("gnss_a", "f8", 3),
            ("wind_v", "f8", 3),  # wind as given last, and its variance
            ("wind_r", "f8"),
            ("has_wind", "i8"),
            ("air", AIR),  # of it only what goes with the rotors' speed
            ("n_block", "f8"),  # mean of specific force for the drag
            ("t_block", "f8"),
            ("f_block", "f8", 3),
            ("t_first", "f8"),  # what initial alignment has gathered since then
            ("turned", "f8", 4),
            ("f_sum", "f8", 3),
            ("m_sum", "f8", 3),
            ("n_m", "f8"),
            ("n_f", "f8"),
            ("path", "f8"),
            ("phase", "i8"),  # 0 nothing seen, 1 aligning, 2 running
            ("n_aligned", "i8"),
            ("t_aligned", "f8"),
            ("t_newest", "f8"),
            ("t_wake", "f8"),
            ("t_covariance", "f8"),
            *((f"n_{name}", "i8") for name in (
                "steps", "unaligned", "gaps", "bad", "ring_full", "rows", "nodes", "cov", "aids", "aids_lost", "events", "events_lost",
            )),
            ("event", EVENT, (EVENT_CAPACITY,)),
            ("aid", AID_STATE, (SENSORS,)),
            ("imu_head", "i8"),
            ("imu_n", "i8"),
            ("imu", IMU_SAMPLE, (IMU_CAPACITY,)),
            ("a", STAGE, (0,)),
            ("ft", "i8", (0,)),
            ("ring_head", "i8", N_QUEUES),
            ("ring_n", "i8", N_QUEUES),
            ("ring", MEASUREMENT, (N_QUEUES, CAPACITY)),
        ],
        align=True,
    )  # fmt: skip


@jit
def predict(s: Any, step: Quat, sd: float, dt: float) -> None:
    """(21)-(22): x <- Φ x, P <- Φ P Φᵀ + Γ Q Γᵀ with Γ = ½ Ξ dt and Q = σ²/dt: (dt/4) σ² Ξ Ξᵀ (theory.md §2.3).

    Parameters
    ----------
    s
        State record.
    step
        p of Φ x = x ⊗ p, see `haltere.core.picard`.
    sd
        White noise density of the gyro [rad/s/sqrt(Hz)].
    dt
        Interval [s].
    """
    P = s.P
    x = (s.x[0], s.x[1], s.x[2], s.x[3])
    k = 0.25 * dt * sd * sd
    n2 = x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3]
    for j in range(4):  # columns, then rows: Φ e = e ⊗ p
        c = quat_mul((P[0, j], P[1, j], P[2, j], P[3, j]), step)
        P[0, j], P[1, j], P[2, j], P[3, j] = c
    for i in range(4):
        c = quat_mul((P[i, 0], P[i, 1], P[i, 2], P[i, 3]), step)
        P[i, 0], P[i, 1], P[i, 2], P[i, 3] = c
    for i in range(4):
        for j in range(i):
            P[i, j] = 0.5 * (P[i, j] + P[j, i]) - k * s.x[i] * s.x[j]
            P[j, i] = P[i, j]
        P[i, i] += k * (n2 - s.x[i] * s.x[i])  # Ξ Ξᵀ = |x|² I - x xᵀ
    x = quat_mul(x, step)
    s.x[0], s.x[1], s.x[2], s.x[3] = x


@jit
def normalise(s: Any, project: bool) -> None:
    """x <- x/|x|, and (``project``) P with the Jacobian of that, (I - x xᵀ)/|x|: along x nothing is left (theory.md §2.4)."""
    P = s.P
    n = 1.0 / (s.x[0] * s.x[0] + s.x[1] * s.x[1] + s.x[2] * s.x[2] + s.x[3] * s.x[3])
    k = n**0.5
    for i in range(4):
        s.x[i] *= k
    if not project:
        return
    x0, x1, x2, x3 = s.x[0], s.x[1], s.x[2], s.x[3]
    for j in range(4):
        a = x0 * P[0, j] + x1 * P[1, j] + x2 * P[2, j] + x3 * P[3, j]
        for i in range(4):
            P[i, j] -= s.x[i] * a
    for i in range(4):
        a = x0 * P[i, 0] + x1 * P[i, 1] + x2 * P[i, 2] + x3 * P[i, 3]
        for j in range(4):
            P[i, j] = n * (P[i, j] - s.x[j] * a)
    for i in range(4):
        for j in range(i):
            P[i, j] = 0.5 * (P[i, j] + P[j, i])
            P[j, i] = P[i, j]


@jit
def columns(q: Quat) -> tuple[Quat, Quat, Quat]:
    """Columns of Ξ(q): q̇ = ½ Ξ(q) ω."""
    w, x, y, z = q
    return ((-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w))


@jit
def attitude_covariance(s: Any) -> Mat:
    """Covariance of the local attitude error δθ [rad^2]: 4 Ξᵀ P Ξ at length one."""
    P = s.P
    n2 = s.x[0] * s.x[0] + s.x[1] * s.x[1] + s.x[2] * s.x[2] + s.x[3] * s.x[3]
    k = 4.0 / (n2 * n2)
    a, b, c = columns((s.x[0], s.x[1], s.x[2], s.x[3]))
    aa, ab, ac, bb, bc, cc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(4):
        for j in range(4):
            p = k * P[i, j]
            aa += a[i] * p * a[j]
            ab += a[i] * p * b[j]
            ac += a[i] * p * c[j]
            bb += b[i] * p * b[j]
            bc += b[i] * p * c[j]
            cc += c[i] * p * c[j]
    return ((aa, ab, ac), (ab, bb, bc), (ac, bc, cc))


@jit
def quaternion_covariance(q: Quat, V: Mat, P: Any) -> None:
    """P of the four elements from the covariance of δθ: ¼ Ξ V Ξᵀ, of rank three."""
    a, b, c = columns(q)
    for i in range(4):
        x: Vec = (
            V[0][0] * a[i] + V[0][1] * b[i] + V[0][2] * c[i],
            V[1][0] * a[i] + V[1][1] * b[i] + V[1][2] * c[i],
            V[2][0] * a[i] + V[2][1] * b[i] + V[2][2] * c[i],
        )
        for j in range(4):
            P[i, j] = 0.25 * (x[0] * a[j] + x[1] * b[j] + x[2] * c[j])
