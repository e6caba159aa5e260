"""The trial of a force against wind and nothing, against the likelihood of all of its blocks at once, from the model as it is told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from haltere._jit import as_records, entry
from haltere.core.lumped import lumped_layout
from haltere.diagnosis import wind_or_force as trial
from haltere.diagnosis.drifts import LASTS, SLOWLY
from haltere.diagnosis.wind_or_force import CHANGE, FORCE, LEAST, NOTHING, SLOPE, TRIED, WALK, WIND, follow, start
from haltere.strapdown.pairs import pairs

FloatArray = NDArray[np.float64]
STATE = np.dtype([
    ("of_this_oracle", "f8"), ("t", "f8"), ("q", "f8", 4), ("v", "f8", 3), ("wind", "f8", 2), ("drag", "f8", 0), ("baro", "f8", 0),
    ("mag", "f8", 0), ("P", "f8", (17, 17)), ("speed", "f8", 4), ("spin_up", "f8", 4), ("model", (np.record, lumped_layout(4)), (1,)),
    ("pairs", pairs(), (1,)),
])  # fmt: skip
BLOCKS, DT, SLOW = 70, 0.01, 0.12
#: Slopes of the force along x, y, z by velocity through the air [1/s]: linear, so that all hypotheses are.
D = np.diag([-0.3, -0.35, -0.9])


@entry
def _start(S: Any) -> None:
    start(S[0])


@entry
def _follow(S: Any, dt: float) -> None:
    follow(S[0], dt)


def flown(rng: np.random.Generator) -> tuple[list[Rotation], FloatArray, FloatArray]:
    """Attitudes of a vehicle that turns, its velocity, and a force that is measured, a step in y among it."""
    yaw = 0.4 + np.linspace(0.0, 1.8, BLOCKS)
    attitudes = [Rotation.from_euler("ZYX", (psi, 0.1 * np.sin(3.0 * psi), 0.15 * np.cos(2.0 * psi))) for psi in yaw]
    v = np.cumsum(rng.normal(0.0, 0.2, (BLOCKS, 3)), axis=0) + [3.0, -1.0, 0.2]
    return attitudes, v, rng.normal(0.0, 0.5, (BLOCKS, 3)) + [0.1, 0.6, -0.2]


@pytest.mark.parametrize("headed", [False, True])
def test_misfits_are_those_of_all_blocks_at_once(headed: bool) -> None:
    rng = np.random.default_rng(98001)
    attitudes, v, y = flown(rng)
    before, now, level, heading = np.array([1.2, -0.7]), np.array([2.0, -0.2]), np.array([0.05, -0.1, 0.2]), 0.1
    noise, known, unsure = np.array([0.2, 0.3, 0.25]), np.array([0.01, 0.02, 0.015]), np.array([0.5, 0.8])

    s = np.zeros(1, STATE)
    p, m = s["pairs"][0], s["model"][0]
    speed = 500.0
    s["speed"], m["yaw"], m["roll"], m["pitch"] = speed, [1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1]
    for i, column in enumerate((0, 0, 2)):  # of the sum of the rotors' speeds times velocity
        m["k"][0, i, column] = D[i, i] / (4.0 * speed)
    m["slow"], p["scale"], p["ratio"] = SLOW, 1.0, 1.0
    p["r"][0, :3], p["mark"], p["m_var"][0, 3, :3], p["m_level"][0, 3, :3] = noise, 3, known, level
    p["m_wind"][0, 3], p["m_yaw"][0, 3], s["wind"] = before, heading, now
    p["headings"] = 255 if headed else 0  # whether the vehicle has headed everywhere before, so that the wind has shown all it can
    s["P"][0, 15, 15], s["P"][0, 16, 16] = unsure**2
    records = as_records(s)
    r = np.empty((BLOCKS, 3))
    for k in range(BLOCKS):
        C = attitudes[k].as_matrix()
        s["t"], s["q"], s["v"] = k * DT, attitudes[k].as_quat()[[3, 0, 1, 2]], v[k]
        p["v_a"] = C.T @ (v[k] - [*now, 0.0])
        p["residual"][0, :3] = y[k] - D @ p["v_a"][0]  # as the filter has it, in the wind that it has
        r[k] = y[k] - level - D @ (C.T @ (v[k] - [*before, 0.0]))
        if k == 0:
            _start(records)
        _follow(records, DT)

    # the same by the covariance of all residuals: states known beforehand, walks, white noise
    lasting = SLOW**2
    R = noise + 2.0 * LASTS * lasting / DT
    A = np.zeros((BLOCKS, 3, 11))
    C0 = attitudes[0].as_matrix()
    psi = np.arctan2(C0[1, 0], C0[0, 0])
    old = Rotation.from_euler("Z", heading - psi).as_matrix() @ C0  # leaning alike, to where it headed before
    air0 = C0.T @ (v[0] - [*before, 0.0])
    for k in range(BLOCKS):
        C = attitudes[k].as_matrix()
        air = C.T @ (v[k] - [*before, 0.0])
        for i in range(3):
            A[k, i, 2 + i], A[k, i, 8 + i] = 1.0, D[i, i] * (air[i] - air0[i])
            A[k, i, :2] = -(D @ C.T)[i, :2]
            if k > 0 and not headed:
                A[k, i, 6:8] = (D @ old.T)[i, :2] - (D @ C.T)[i, :2]
    walk = (np.minimum.outer(np.arange(BLOCKS), np.arange(BLOCKS)) + 1.0) * DT
    for h in range(TRIED):
        P0 = np.diag(
            [*(2 * [CHANGE**2 if h == WIND else 0.0]), *(known + LEAST**2), FORCE**2 if h < 3 else 0.0, *unsure**2, *(3 * [SLOPE**2])]
        )
        H = A.copy()
        if h < 3:
            H[:, h, 5] = 1.0
        if h != WIND:
            H[:, :, :2] = 0.0
        X = H.reshape(3 * BLOCKS, 11)
        S = X @ P0 @ X.T + np.diag(np.tile(R, BLOCKS)) + np.kron(walk * lasting / SLOWLY, np.eye(3))
        if h == WIND:
            S += np.einsum("kin,ljn,kl->kilj", A[:, :, :2], A[:, :, :2], walk * WALK**2).reshape(S.shape)
        z = r.ravel()
        assert p["misfit"][0, h] == pytest.approx(z @ np.linalg.solve(S, z), rel=1e-8)
        assert p["chance"][0, h] == pytest.approx(np.linalg.slogdet(S)[1], rel=1e-8)
        mean = P0 @ X.T @ np.linalg.solve(S, z)
        for j in (5, *((6, 7) if not headed else ()), 8, 9, 10):  # what does not walk
            assert p["tried"][0, h, j] == pytest.approx(mean[j], rel=1e-6, abs=1e-9)
    assert trial.best(as_records(s)[0]) == int(np.argmin(p["misfit"][0, :3]))
    assert p["misfit"][0, NOTHING] > p["misfit"][0, 1]
