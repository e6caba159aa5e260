"""What the smoother does at a node of its tape: load it, go back over what was fused there, over assumptions too. It walks over no rows.

The workspace and what μ, Pˢ, d and the rest mean are those of `haltere.estimators.smoother`.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import jit
from haltere.core.rotation import Mat, Quat, Vec, cross, dcm, quat_from_rotvec, quat_mul, quat_unit
from haltere.estimators.dense import multiply, smaller_than, solve, solve_any, turn_attitude, turn_block
from haltere.strapdown.optional import get_optional, put_optional

__all__ = ["NODE_HEAD", "corrected", "enter", "keep", "load_node", "past"]

#: What comes after is used before an assumption where it makes the covariance greater than the filter's by less than this part.
WORSE = 0.02
#: Corrections from here on [rad] are no injections of `haltere.strapdown.propagate`: yaw was set anew, and P is not turned with it.
TURNED = 0.3
#: Columns of a node before the upper triangle of P: time, whether a stretch begins here, gravity, q 4, v 3, p 3, bg 3, ba 3.
NODE_HEAD = 19


@jit
def load_node(s: Any, node: Any) -> None:
    """State and covariance of a node into a record."""
    s.t, s.gravity = node[0], node[2]
    for i in range(4):
        s.q[i] = node[3 + i]
    for i in range(3):
        s.v[i], s.p[i], s.bg[i], s.ba[i] = node[7 + i], node[10 + i], node[13 + i], node[16 + i]
    put_optional(s, node, NODE_HEAD)
    k = NODE_HEAD + s.P.shape[0] - 15
    for i in range(s.P.shape[0]):
        for j in range(i, s.P.shape[0]):
            s.P[i, j] = node[k]
            s.P[j, i] = node[k]
            k += 1


@jit
def keep(s: Any, w: Any, k: int) -> None:
    """Remember the k-th prediction of an interval: nominal state and covariance."""
    x = w.x[k]
    for i in range(4):
        x[i] = s.q[i]
    for i in range(3):
        x[4 + i], x[7 + i], x[10 + i], x[13 + i] = s.v[i], s.p[i], s.bg[i], s.ba[i]
    get_optional(s, x, 16)
    for i in range(s.P.shape[0]):
        for j in range(s.P.shape[0]):
            w.P[k, i, j] = s.P[i, j]


@jit
def difference(w: Any, k: int) -> None:
    """``w.d``: the smoothed state of the node after, less the k-th prediction, as an error state."""
    x, y = w.x[k], w.xs
    d = quat_mul((x[0], -x[1], -x[2], -x[3]), (y[0], y[1], y[2], y[3]))
    size = math.sqrt(d[1] * d[1] + d[2] * d[2] + d[3] * d[3])
    angle = 2.0 * math.atan2(size, abs(d[0]))
    c = (angle / size if size > 1e-12 else 2.0) * (1.0 if d[0] >= 0.0 else -1.0)
    w.d[0], w.d[1], w.d[2] = c * d[1], c * d[2], c * d[3]
    for i in range(3, len(w.mu)):
        w.d[i] = y[1 + i] - x[1 + i]


@jit
def corrected(w: Any, k: int) -> None:
    """``w.xs``: the k-th prediction with P μ added."""
    n = len(w.mu)
    P, x, y, d = w.P[k], w.x[k], w.xs, w.d
    for i in range(n):
        d[i] = 0.0
    for j in range(n):
        u = w.mu[j]
        for i in range(n):
            d[i] += P[j, i] * u
    q = quat_unit(quat_mul((x[0], x[1], x[2], x[3]), quat_from_rotvec((w.d[0], w.d[1], w.d[2]))))
    y[0], y[1], y[2], y[3] = q
    for i in range(3, n):
        y[1 + i] = x[1 + i] + w.d[i]


@jit
def injected(w: Any, k: int, q: Quat) -> Vec:
    """Half the rotation vector that was injected between the k-th prediction and a posterior ``q``; nothing if more than `TURNED`."""
    x = w.x[k]
    d = quat_mul((x[0], -x[1], -x[2], -x[3]), q)
    size = math.sqrt(d[1] * d[1] + d[2] * d[2] + d[3] * d[3])
    half = math.atan2(size, abs(d[0]))
    if half > 0.5 * TURNED:
        return (0.0, 0.0, 0.0)
    c = (half / size if size > 1e-12 else 1.0) * (1.0 if d[0] >= 0.0 else -1.0)
    return (c * d[1], c * d[2], c * d[3])


@jit
def unturn(half: Vec) -> Mat:
    """What turns an attitude error after an injection into one before it: (1 - ½[δθ]×)⁻¹, see `haltere.strapdown.propagate.inject`."""
    a, b, e = half
    r = 1.0 / (1.0 + a * a + b * b + e * e)
    return (
        (r * (1.0 + a * a), r * (a * b - e), r * (a * e + b)),
        (r * (a * b + e), r * (1.0 + b * b), r * (b * e - a)),
        (r * (a * e - b), r * (b * e + a), r * (1.0 + e * e)),
    )


@jit
def enter(w: Any, k: int, after: Any) -> bool:
    """μ at the end of an interval of k predictions and Pˢ at both ends, from the node ``after`` it, smoothed.

    False where P cannot be inverted.
    """
    m, R = w.W.shape[0], w.system.P
    difference(w, k)
    turn_attitude(w.first, unturn(injected(w, k, (after[3], after[4], after[5], after[6]))))
    for i in range(m):
        for j in range(m):
            w.last[i, j] = w.first[i, j]
            w.D[i, j] = w.first[i, j] - w.P[k, i, j]
            R[i, j] = w.P[k, i, j]
        R[i, 2 * m] = 0.0
    for i in range(len(w.mu)):
        R[i, 2 * m] = w.d[i]
    if not solve(w):
        return False
    multiply(w, w.D, w.W, w.T)
    multiply(w, w.W, w.T, w.first)
    for i in range(m):
        for j in range(i, m):  # as symmetric as P
            w.first[i, j] += w.P[0, i, j]
    for i in range(m):
        for j in range(i):
            w.first[i, j] = w.first[j, i]
    x, y = w.x[0], w.x[k]
    turn_block(w.first, dcm((x[0], x[1], x[2], x[3])), w.turned[0])
    turn_block(w.last, dcm((y[0], y[1], y[2], y[3])), w.turned[1])
    return True


@jit
def load_system(w: Any, A: Any, B: Any) -> None:
    """``w.system`` <- A | B."""
    m, R = w.W.shape[0], w.system.P
    for i in range(m):
        for j in range(m):
            R[i, j] = A[i, j]
            R[i, m + j] = B[i, j]


@jit
def past(s: Any, w: Any, node: Any) -> bool:
    """Go from a posterior back to the ``node`` before its assumptions, which tell the past nothing; see the head of the module.

    The posterior is the 0-th prediction with ``w.mu`` and ``w.first``; False where a matrix cannot be inverted, or Y is none: the
    covariance has become greater than the filter's, by masked gains after it or where the filter raised its own. Then nothing that comes
    after is used before.
    """
    m, n, R = w.W.shape[0], len(w.mu), w.system.P
    ok = smaller_than(w, w.first, w.P[0], WORSE)
    for i in range(len(w.xs)):
        w.xs[i] = w.x[0, i]
    for i in range(m):
        for j in range(m):
            w.P[1, i, j] = w.P[0, i, j]
            w.D[i, j] = w.P[0, i, j] - w.first[i, j]
    load_node(s, node)
    keep(s, w, 0)
    difference(w, 0)
    half = injected(w, 0, (w.xs[0], w.xs[1], w.xs[2], w.xs[3]))
    M = unturn(half)
    turn_attitude(w.P[1], M)
    turn_attitude(w.D, M)
    for i in range(n):
        R[i, 2 * m] = 0.0
        w.later[i] = w.mu[i]
    turned = cross(half, (w.mu[0], w.mu[1], w.mu[2]))
    for i in range(3):
        w.later[i] += turned[i]
    load_system(w, w.P[1], w.D)
    ok = ok and solve(w)  # P⁻¹ (P - Pˢ)
    if ok:
        for i in range(m):
            for j in range(m):
                w.T[i, j] = w.W[j, i]
            R[i, 2 * m] = 0.0
        load_system(w, w.P[1], w.T)
        ok = solve(w)  # Λ = P⁻¹ (P - Pˢ) P⁻¹
    if ok:
        for i in range(m):
            for j in range(m):
                w.T[i, j] = 0.5 * (w.W[i, j] + w.W[j, i])
                w.D[i, j] = w.P[0, i, j] - w.P[1, i, j]
        multiply(w, w.T, w.D, w.W)
        for i in range(m):
            w.W[i, i] += 1.0
        load_system(w, w.W, w.T)
        for i in range(n):
            R[i, 2 * m] = w.later[i]
            for j in range(n):
                R[i, 2 * m] += w.T[i, j] * w.d[j]
        ok = solve_any(w)  # (1 + Λ (P⁻ - P))⁻¹ times Λ, and times μ + Λ (x̂ ⊟ x̂⁻)
    if not ok:
        for i in range(n):
            w.mu[i] = 0.0
    for i in range(m):
        for j in range(m):
            w.first[i, j] = 0.0
    if ok:
        multiply(w, w.W, w.P[0], w.T)
        multiply(w, w.P[0], w.T, w.first)
    for i in range(m):
        for j in range(i, m):
            w.first[i, j] = w.P[0, i, j] - w.first[i, j]
            w.first[j, i] = w.first[i, j]
    corrected(w, 0)
    return ok
