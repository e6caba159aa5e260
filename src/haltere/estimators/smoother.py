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
from haltere.core.rotation import Vec, dcm
from haltere.estimators.dense import turn_block
from haltere.estimators.nodes import NODE_HEAD, corrected, enter, keep, load_node, past
from haltere.estimators.step import (
    ASSUMED,
    COVARIANCE_ROWS,
    LONG_STEP,
    SUB_STEP,
    bridge_push,
    interval,
    reported_wind,
    write_wind_covariance,
)
from haltere.strapdown.optional import put_optional
from haltere.strapdown.propagate import gust_keeps, left_F, mechanise, propagate, transition, unseen

__all__ = ["BUFFER", "node_width", "smooth", "smoothed"]

FloatArray = NDArray[np.float64]

#: Predictions between two nodes at most: those of `haltere.estimators.step.NODE_STEPS`, one of them through a gap.
BUFFER = 160


def node_width(n: int) -> int:
    """Columns of a node of ``n`` error states."""
    return NODE_HEAD + n - 15 + n * (n + 1) // 2


@cache
def _workspace(n: int) -> np.dtype[np.void]:
    """Record type to work in: the predictions of one interval, μ, the smoothed state and matrices.

    Matrices are as wide as a multiple of four, with ones on the diagonal where there is no state: so every inner loop becomes SIMD.
    ``system.P`` is three matrices side by side: P' | Φ P | x̂ˢ ⊟ x̂, the last one four wide.
    """
    b, m = BUFFER + 1, 4 * ((n + 3) // 4)
    system = np.dtype((np.record, [("P", "f8", (m, 2 * m + 4))]), align=True)
    return np.dtype(
        [
            ("x", "f8", (b, 1 + n)), ("P", "f8", (b, m, m)), ("phi", "f8", (b, 3, 3, 3)), ("dt", "f8", b), ("row", "i8", b),
            ("system", system), ("W", "f8", (m, m)), ("D", "f8", (m, m)), ("T", "f8", (m, m)),
            ("first", "f8", (m, m)), ("last", "f8", (m, m)), ("between", "f8", (m, m)), ("turned", "f8", (3, 3, 3)),
            ("r", "f8", (4, 2 * m + 4)), ("mu", "f8", n), ("later", "f8", n), ("d", "f8", n), ("xs", "f8", 1 + n),
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
    n = S["P"].shape[1]
    times = rows[0]
    at = np.searchsorted(t, times)
    node_row = np.searchsorted(times, nodes[:, 0])
    starts = node_row[nodes[:, 1] > 0.0]
    last_row = np.append(starts[1:], len(times))[np.searchsorted(starts, node_row, side="right") - 1] - 1
    out = np.empty_like(rows)
    cov = np.empty((COVARIANCE_ROWS, len(t_covariance)))
    column = np.full(len(times), -1)
    column[np.searchsorted(times, t_covariance)] = np.arange(len(t_covariance))
    work, w = as_records(np.zeros(1, S.dtype)), as_records(np.zeros(1, _workspace(n)))
    w["P"] = np.eye(w["P"].shape[-1])  # where there is no state it stays so
    lost = smooth(work, prm, w, nodes, node_row, last_row, times, gyro[at], accel[at], out, cov, column)
    return out, cov, int(lost)


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
    if prm.imu_mean == 0.0:
        unseen(s, prm, w0, f0, w1, f1, dt)
    m = w.W.shape[0]
    for j in range(m):
        left_F(w.system, m + j, D, A, B, dt)
    if len(s.steady) > 0:
        o, keep = first_of_wind(s), gust_keeps(prm, dt)
        c = o + len(s.wind) + len(s.drag)
        for i in range(len(s.wind)):
            for j in range(m):
                w.system.P[o + i, m + j] *= keep
                if i < 2:
                    w.system.P[o + i, m + j] += (1.0 - keep) * w.system.P[c + i, m + j]


@jit
def first_of_wind(s: Any) -> int:
    """First error state of the wind."""
    return 15 + len(s.baro) + len(s.mag)


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
def back(s: Any, prm: Any, w: Any, k: int) -> None:
    """μ <- Φᵀ μ over the k-th prediction; the blocks of Φ as in `haltere.strapdown.propagate.left_F` and `blow`."""
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
    if len(s.steady) > 0:
        o, keep = first_of_wind(s), gust_keeps(prm, dt)
        c = o + len(s.wind) + len(s.drag)
        for i in range(len(s.wind)):
            if i < 2:
                u[c + i] += (1.0 - keep) * u[o + i]
            u[o + i] *= keep


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
def write(s: Any, w: Any, out: Any, cov: Any, column: int, row: int, t: float) -> None:
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
    more = s.P.shape[0] - 15
    for i in range(more):
        out[35 + i, row] = y[16 + i]
        out[35 + more + i, row] = P[15 + i, 15 + i]
    put_optional(s, y, 16)
    if len(s.drag) > 0:
        k = 35 + len(s.baro) + len(s.mag)
        reported_wind(s, P, out[:, row], k, more)
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
    for i in range(len(s.baro)):
        cov[k, column] = P[15 + i, 15 + i]
    write_wind_covariance(s, P, cov, column)


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
    whole = len(s.drag) > 0
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
                    write(s, w, out, cov, column[w.row[k]], w.row[k], t[w.row[k]])
            for i in range(w.W.shape[0]):
                for c in range(w.W.shape[0]):
                    w.first[i, c] = w.P[0, i, c]
            continue
        for k in range(count - 1, -1, -1):
            back(s, prm, w, k)
            if w.row[k] >= 0:
                corrected(w, k)
                blend(w, k, (t[w.row[k]] - t[a]) / (t[b] - t[a]), whole or column[w.row[k]] >= 0)
                write(s, w, out, cov, column[w.row[k]], w.row[k], t[w.row[k]])
    return lost
