"""Fixed-interval smoothing of a run: Rauch, Tung and Striebel (1965) on the error state, from the filter's posteriors. It filters nothing.

Between two nodes of the tape (a posterior after fusion) the filter's prediction is repeated, which gives every Φ, P and nominal state
again, so that only posteriors are kept. Just before the fusion that ends an interval, μ = P⁻¹ (x̂ˢ ⊟ x̂); over a step of prediction
μ <- Φᵀ μ, whatever its process noise, and x̂ˢ = x̂ ⊞ P μ at each row. At the node Pˢ = P + Wᵀ (Pˢ' - P') W with W = P'⁻¹ Φ P, where Φ is
that of the whole interval and P', Pˢ' are those at its end: one factorisation an interval. It needs no gains and no innovations, so
that refused and de-weighted updates, and yaw set anew, are what the filter made of them. Before a correction was injected at the
node, errors of attitude are turned by it: Pˢ' is turned back first, without which a heading known to 60° only spoils the tilt.

What this states is true for any gain: x - x̂ - Wᵀ (x' - x̂') is uncorrelated with x' - x̂' and all noise after it. But only
optimal gains make it the best, and smaller than the filter's. Under a masked gain K = M P Hᵀ/S what was fused is not all kept: the
state at the end, carried back, may be worse than what was known then. For a compass that may only turn the heading that costs next to
nothing. For assumptions that may not turn it (`haltere.aids.fake`), where nothing else holds the filter, it costs all. They tell the
past nothing instead: what comes after is a measurement of x with information Y, whatever was assumed in between, so that before them
Pˢ⁻¹ = P⁻⁻¹ + Y where Pˢ⁻¹ = P⁺⁻¹ + Y after them (Fraser and Potter 1969), with P⁻ from a node of its own. With x̂ˢ = x̂ + P μ and
Pˢ = P - P Λ P: Λ⁻ = (1 + Λ⁺ (P⁻ - P⁺))⁻¹ Λ⁺ and μ⁻ = (1 + Λ⁺ (P⁻ - P⁺))⁻¹ (μ⁺ + Λ⁺ (x̂⁺ ⊟ x̂⁻)), also without any inverse of Y. So a
filter that only assumptions hold has nothing to be smoothed with, and its smoothed course is its own.

The smoothed covariance is continuous in time but for that, also where a measurement was fused. At rows between nodes, which lie at
most `haltere.estimators.step.NODE_SPAN` apart, it is taken as linear between theirs and at most the filter's, the block of attitude
in axes that do not turn; where nothing comes after, it is the filter's.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records, entry, jit
from haltere.core.rotation import Mat, Quat, Vec, cross, dcm, quat_from_rotvec, quat_mul, quat_unit
from haltere.estimators.dense import multiply, solve, solve_any, turn_attitude, turn_block
from haltere.estimators.step import ASSUMED, COVARIANCE_ROWS, LONG_STEP, SUB_STEP, bridge_push, interval
from haltere.strapdown.propagate import left_F, mechanise, propagate, transition

__all__ = ["BUFFER", "node_width", "smooth", "smoothed"]

FloatArray = NDArray[np.float64]

#: Predictions between two nodes at most: those of `haltere.estimators.step.NODE_STEPS`, one of them through a gap.
BUFFER = 160
#: Corrections from here on [rad] are no injections of `haltere.strapdown.propagate`: yaw was set anew, and P is not turned with it.
TURNED = 0.3
#: Columns of a node before the upper triangle of P: time, whether a stretch begins here, gravity, q 4, v 3, p 3, bg 3, ba 3.
NODE_HEAD = 19


def node_width(n: int, n_baro: int) -> int:
    """Columns of a node of ``n`` error states."""
    return NODE_HEAD + n_baro + n * (n + 1) // 2


@cache
def _workspace(n: int, n_baro: int) -> np.dtype[np.void]:
    """Record type to work in: the predictions of one interval, μ, the smoothed state and matrices.

    Matrices are as wide as a multiple of four, with ones on the diagonal where there is no state: so every inner loop becomes SIMD.
    ``system.P`` is three matrices side by side: P' | Φ P | x̂ˢ ⊟ x̂, the last one four wide.
    """
    b, m = BUFFER + 1, 4 * ((n + 3) // 4)
    system = np.dtype((np.record, [("P", "f8", (m, 2 * m + 4))]), align=True)
    return np.dtype(
        [
            ("x", "f8", (b, 16 + n_baro)), ("P", "f8", (b, m, m)), ("phi", "f8", (b, 3, 3, 3)), ("dt", "f8", b), ("row", "i8", b),
            ("system", system), ("W", "f8", (m, m)), ("D", "f8", (m, m)), ("T", "f8", (m, m)),
            ("first", "f8", (m, m)), ("last", "f8", (m, m)), ("between", "f8", (m, m)), ("turned", "f8", (3, 3, 3)),
            ("r", "f8", (4, 2 * m + 4)), ("mu", "f8", n), ("later", "f8", n), ("d", "f8", n), ("xs", "f8", 16 + n_baro),
        ],
        align=True,
    )  # fmt: skip


def smoothed(
    S: NDArray[np.void], prm: NDArray[np.void], rows: FloatArray, nodes: FloatArray, t: FloatArray, gyro: FloatArray, accel: FloatArray,
    t_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray, int]:  # fmt: skip
    """Smooth a run from its rows and its tape.

    Parameters
    ----------
    S, prm
        Records of the filter that ran.
    rows
        Its output (width, n), as `haltere.estimators.step.write_row` orders it.
    nodes
        Its tape (m, `node_width`).
    t, gyro, accel
        All IMU samples: times (k,), rates and forces (k, 3).
    t_covariance
        Times (c,) of rows whose covariance blocks are wanted.

    Returns
    -------
    rows, covariance, lost
        Like ``rows``; (`haltere.estimators.step.COVARIANCE_ROWS`, c); fusions that could not be smoothed over.
    """
    n, n_baro = S["P"].shape[1], S["baro"].shape[1]
    times = rows[0]
    at = np.searchsorted(t, times)
    node_row = np.searchsorted(times, nodes[:, 0])
    starts = node_row[nodes[:, 1] > 0.0]
    last_row = np.append(starts[1:], len(times))[np.searchsorted(starts, node_row, side="right") - 1] - 1
    out = np.empty_like(rows)
    cov = np.empty((COVARIANCE_ROWS, len(t_covariance)))
    column = np.full(len(times), -1)
    column[np.searchsorted(times, t_covariance)] = np.arange(len(t_covariance))
    work, w = as_records(np.zeros(1, S.dtype)), as_records(np.zeros(1, _workspace(n, n_baro)))
    w["P"] = np.eye(w["P"].shape[-1])  # where there is no state it stays so
    lost = smooth(work, prm, w, nodes, node_row, last_row, times, gyro[at], accel[at], out, cov, column)
    return out, cov, int(lost)


@jit
def load_node(s: Any, node: Any) -> None:
    """State and covariance of a node into a record."""
    s.t, s.gravity = node[0], node[2]
    for i in range(4):
        s.q[i] = node[3 + i]
    for i in range(3):
        s.v[i], s.p[i], s.bg[i], s.ba[i] = node[7 + i], node[10 + i], node[13 + i], node[16 + i]
    for i in range(len(s.baro)):
        s.baro[i] = node[NODE_HEAD + i]
    k = NODE_HEAD + len(s.baro)
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
    for i in range(len(s.baro)):
        x[16 + i] = s.baro[i]
    for i in range(s.P.shape[0]):
        for j in range(s.P.shape[0]):
            w.P[k, i, j] = s.P[i, j]


@jit
def step_forward(s: Any, prm: Any, w: Any, k: int, w0: Vec, f0: Vec, w1: Vec, f1: Vec, dt: float) -> None:
    """Predict over one interval and remember its transition as the k-th; Φ P of the intervals so far is carried in ``w.system``."""
    _, f, rotation, dv = interval(s, prm, w0, f0, w1, f1, dt)
    C = mechanise(s, rotation, dv, dt)
    D, A, B = transition(C, rotation, f, dt)
    for i in range(3):
        for j in range(3):
            w.phi[k, 0, i, j], w.phi[k, 1, i, j], w.phi[k, 2, i, j] = D[i][j], A[i][j], B[i][j]
    w.dt[k] = dt
    propagate(s, prm, C, D, A, B, dt)
    m = w.W.shape[0]
    for j in range(m):
        left_F(w.system, m + j, D, A, B, dt)


@jit
def forward(s: Any, prm: Any, w: Any, t: Any, gyro: Any, accel: Any, a: int, b: int) -> int:
    """Repeat the filter's predictions from row a, in ``s``, to row b; returns their number. ``w.row`` says which row each ends at."""
    keep(s, w, 0)
    m = w.W.shape[0]
    for i in range(m):
        for j in range(m):
            w.system.P[i, m + j] = w.P[0, i, j]
    w.row[0] = a
    k = 0
    for i in range(a, b):
        w0, f0 = (gyro[i, 0], gyro[i, 1], gyro[i, 2]), (accel[i, 0], accel[i, 1], accel[i, 2])
        w1, f1 = (gyro[i + 1, 0], gyro[i + 1, 1], gyro[i + 1, 2]), (accel[i + 1, 0], accel[i + 1, 1], accel[i + 1, 2])
        dt = t[i + 1] - t[i]
        parts = 1
        if dt > LONG_STEP:
            parts = math.ceil(dt / SUB_STEP)
        for j in range(parts):
            c0, c1 = j / parts, (j + 1) / parts
            step_forward(
                s, prm, w, k,
                (w0[0] + c0 * (w1[0] - w0[0]), w0[1] + c0 * (w1[1] - w0[1]), w0[2] + c0 * (w1[2] - w0[2])),
                (f0[0] + c0 * (f1[0] - f0[0]), f0[1] + c0 * (f1[1] - f0[1]), f0[2] + c0 * (f1[2] - f0[2])),
                (w0[0] + c1 * (w1[0] - w0[0]), w0[1] + c1 * (w1[1] - w0[1]), w0[2] + c1 * (w1[2] - w0[2])),
                (f0[0] + c1 * (f1[0] - f0[0]), f0[1] + c1 * (f1[1] - f0[1]), f0[2] + c1 * (f1[2] - f0[2])),
                dt / parts,
            )  # fmt: skip
            if dt > LONG_STEP and j == parts - 1:
                bridge_push(s, dt)
            k += 1
            keep(s, w, k)
            w.row[k] = i + 1 if j == parts - 1 else -1
    return k


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

    The posterior is the 0-th prediction with ``w.mu`` and ``w.first``; False where a matrix cannot be inverted, and then nothing that
    comes after is used before.
    """
    m, n, R = w.W.shape[0], len(w.mu), w.system.P
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
    ok = solve(w)  # P⁻¹ (P - Pˢ)
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


@jit
def back(w: Any, k: int) -> None:
    """μ <- Φᵀ μ over the k-th prediction; the blocks of Φ as in `haltere.strapdown.propagate.left_F`."""
    f, dt, u = w.phi[k], w.dt[k], w.mu
    t0, t1, t2 = u[0], u[1], u[2]
    p0, p1, p2 = u[6], u[7], u[8]
    c0, c1, c2 = u[3] + 0.5 * dt * p0, u[4] + 0.5 * dt * p1, u[5] + 0.5 * dt * p2
    for i in range(3):
        u[i] = f[0, 0, i] * t0 + f[0, 1, i] * t1 + f[0, 2, i] * t2 + f[1, 0, i] * c0 + f[1, 1, i] * c1 + f[1, 2, i] * c2
        u[12 + i] += f[2, 0, i] * c0 + f[2, 1, i] * c1 + f[2, 2, i] * c2
    u[3] += dt * p0
    u[4] += dt * p1
    u[5] += dt * p2
    u[9] -= dt * t0
    u[10] -= dt * t1
    u[11] -= dt * t2


@jit
def blend(w: Any, k: int, c: float, whole: bool) -> None:
    """``w.between``: Pˢ at the k-th prediction, a fraction c of the interval: its block of attitude and its diagonal, or all of it."""
    m, x, P, first, last = w.W.shape[0], w.x[k], w.between, w.first, w.last
    if whole:
        for i in range(m):
            for j in range(m):
                P[i, j] = first[i, j] + c * (last[i, j] - first[i, j])
    for i in range(3, m):
        P[i, i] = first[i, i] + c * (last[i, i] - first[i, i])
        if P[i, i] > w.P[k, i, i]:
            shrink = math.sqrt(w.P[k, i, i] / P[i, i])
            for j in range(m if whole else 0):
                P[i, j] *= shrink
                P[j, i] *= shrink
            P[i, i] = w.P[k, i, i]
    for i in range(3):
        for j in range(3):
            w.turned[2, i, j] = w.turned[0, i, j] + c * (w.turned[1, i, j] - w.turned[0, i, j])
    turn_block(w.turned[2], dcm((x[0], -x[1], -x[2], -x[3])), P)


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
def write(w: Any, out: Any, cov: Any, column: int, row: int, t: float, n_baro: int) -> None:
    """``w.xs`` and ``w.between`` into column ``row`` of the output, ordered as by `haltere.estimators.step.write_row`, and of ``cov``."""
    y, P = w.xs, w.between
    out[0, row] = t
    for i in range(16):
        out[1 + i, row] = y[i]
    k = 17
    for i in range(3):
        for j in range(i, 3):
            out[k, row] = P[i, j]
            k += 1
    for b in range(4):
        for i in range(3):
            out[23 + 3 * b + i, row] = P[3 + 3 * b + i, 3 + 3 * b + i]
    for i in range(n_baro):
        out[35 + i, row] = y[16 + i]
        out[35 + n_baro + i, row] = P[15 + i, 15 + i]
    if column < 0:
        return
    cov[0, column] = t
    k = 1
    for b in range(5):
        for i in range(3):
            for j in range(i, 3):
                cov[k, column] = P[3 * b + i, 3 * b + j]
                k += 1
    cov[k, column] = math.nan
    for i in range(n_baro):
        cov[k, column] = P[15 + i, 15 + i]


@entry
def smooth(
    S: Any, PRM: Any, W: Any, nodes: Any, node_row: Any, last_row: Any, t: Any, gyro: Any, accel: Any, out: Any, cov: Any, column: Any
) -> int:
    """Smooth a whole run.

    Parameters
    ----------
    S, PRM, W
        One-element arrays: a state record of the filter's layout to work in, its parameters, and the workspace.
    nodes, node_row, last_row
        Tape (m, width), the row of each node, and the last row of the stretch it lies in.
    t, gyro, accel
        Times and IMU samples of all rows.
    out, cov, column
        Output (width, n) as `haltere.estimators.step.write_row` orders it, covariances (32, c), and the column of each row there or -1.

    Returns
    -------
    int
        Fusions whose covariance could not be inverted: the stretch before is smoothed on its own.
    """
    s, prm, w = S[0], PRM[0], W[0]
    n_baro = len(s.baro)
    lost = 0
    for j in range(len(nodes) - 1, -1, -1):
        a = node_row[j]
        final = j == len(nodes) - 1 or nodes[j + 1, 1] > 0.0
        if not final and nodes[j + 1, 1] == ASSUMED:
            if not past(s, w, nodes[j]):
                lost += 1
            continue
        b = last_row[j] if final else node_row[j + 1]
        load_node(s, nodes[j])
        count = forward(s, prm, w, t, gyro, accel, a, b)
        if not final and not enter(w, count, nodes[j + 1]):
            lost += 1
            final = True
            count -= 1  # the row of the node after has been written
        if final:
            for i in range(len(w.mu)):
                w.mu[i] = 0.0
            for k in range(count, -1, -1):
                if w.row[k] >= 0:
                    corrected(w, k)
                    for i in range(w.W.shape[0]):
                        for c in range(w.W.shape[0]):
                            w.between[i, c] = w.P[k, i, c]
                    write(w, out, cov, column[w.row[k]], w.row[k], t[w.row[k]], n_baro)
            for i in range(w.W.shape[0]):
                for c in range(w.W.shape[0]):
                    w.first[i, c] = w.P[0, i, c]
            continue
        for k in range(count - 1, -1, -1):
            back(w, k)
            if w.row[k] >= 0:
                corrected(w, k)
                blend(w, k, (t[w.row[k]] - t[a]) / (t[b] - t[a]), column[w.row[k]] >= 0)
                write(w, out, cov, column[w.row[k]], w.row[k], t[w.row[k]], n_baro)
    return lost
