"""Heading innovations as evidence: against a Kalman filter in plain matrices, white on made compasses, the size of a made drift found."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from haltere._jit import COMPILED
from haltere.diagnosis import inertial
from haltere.filter import signatures, turning
from haltere.filter.update import NONE
from haltere.strapdown.layout import layout

DEG = math.pi / 180.0
UP = (0.0, 0.0, 1.0)
NO_TURN = (0.0, 0.0, 0.0)
GYRO, DRIFT, DT = 1.5e-3, 1e-4, 0.02
FloatArray = NDArray[np.float64]


def bank() -> Any:
    S = np.zeros(1, layout(1, banks=1))
    S = S if COMPILED else S.view(np.recarray)
    b = S[0]["bank"][0]
    signatures.clear(b)
    return b


def wait(b: Any, w: tuple[float, float, float] = NO_TURN, dt: float = DT, calibration: float = 0.0) -> None:
    for _ in range(4):
        turning.suppose(b, GYRO, 0.0, DRIFT, calibration, w, UP, dt / 4, NO_TURN, 0.0)


def test_it_is_a_kalman_filter_on_innovations_and_on_every_response() -> None:
    rng = np.random.default_rng(1)
    b = bank()
    columns = [3, 77, 250]
    r, t = (2.0 * DEG) ** 2, 0.0
    state, P, num, den = np.zeros((2, 4)), np.zeros((2, 2)), np.zeros(3), np.zeros(3)
    for i in range(300):
        b["track"]["r"], b["track"]["known"], b["track"]["share"] = r, 1e9, 0.3  # known, so that nothing is learnt here
        e = np.array([0.01 * i, 1.0, math.sin(0.1 * i)])
        y = 0.02 * rng.standard_normal()
        wait(b)
        t += DT
        b["bearing"][columns] = e
        turning.hear(b, t, y)
        if i == 0:
            state[0], P = np.r_[y, e], np.diag([r, turning.DRIFT**2])
            continue
        F = np.array([[1.0, DT], [0.0, 1.0]])
        Q = np.diag([(GYRO**2 + 0.3 * turning.AROUND**2) * DT, DRIFT**2 * DT])
        state, P = F @ state, F @ P @ F.T + Q
        S = P[0, 0] + float(b["track"]["r"])  # as measured with this sample
        K = P[:, 0] / S
        left = np.r_[y, e] - state[0]
        state, P = state + np.outer(K, left), P - np.outer(K, P[0])
        num, den = num + left[1:] * left[0] / S, den + left[1:] ** 2 / S
    assert b["num"][columns] == pytest.approx(num, rel=1e-3, abs=1e-2)
    assert b["den"][columns] == pytest.approx(den, rel=1e-3)
    assert b["heading_num"][columns] == pytest.approx(b["num"][columns])
    assert b["heading_den"][columns] == pytest.approx(b["den"][columns])


def wander(rng: np.random.Generator, n: int, walk: float) -> FloatArray:
    """Error of a heading that walks [rad]."""
    return np.asarray(walk * math.sqrt(DT) * np.cumsum(rng.standard_normal(n)))


@pytest.mark.parametrize(("around", "most"), [(0.0, 1.25), (0.4 * DEG, 1.5)])
def test_what_comes_out_is_white_in_samples_and_nearly_in_seconds(around: float, most: float) -> None:
    """A compass of 2 deg white, alone and one that surroundings turn, which means of a second do not show whole: up to half is left."""
    squares, blocks = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        b = bank()
        y = wander(rng, 6000, math.hypot(GYRO, around)) + 2.0 * DEG * rng.standard_normal(6000)
        z = []
        for i in range(len(y)):
            wait(b)
            turning.hear(b, (i + 1) * DT, float(y[i]))
            z.append(float(b["track"]["last"]))
        tail = np.array(z[3000:])
        squares.append(np.mean(tail**2))
        blocks.append(np.mean(tail.reshape(-1, 100).sum(axis=1) ** 2 / 100.0))
        assert math.sqrt(float(b["track"]["r"])) == pytest.approx(2.0 * DEG, rel=0.1)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.05)
    assert 0.75 < np.mean(blocks) < most  # of 12 x 30 means of two seconds: 1 sigma is 0.08


def test_a_drift_of_the_gyro_has_its_size_and_none_is_none() -> None:
    """Heading runs away as t²/2 since 40 s, times the size: found within its own 1 sigma; without it the statistic is χ²(1)."""
    found, none = [], []
    size = 0.2 * DEG
    for seed in range(24):
        rng = np.random.default_rng(100 + seed)
        b = bank()
        n, start = 2400, 2000
        y = wander(rng, n, GYRO) + 2.0 * DEG * rng.standard_normal(n)
        late = np.maximum(np.arange(n) - start, 0) * DT
        y = y + (size * 0.5 * late**2 if seed % 2 else 0.0)
        for i in range(n):
            if i == start:
                b["num"][7] = b["den"][7] = b["heading_o"][7] = b["heading_d"][7] = 0.0
            b["bearing"][7] = 0.5 * late[i] ** 2
            wait(b)
            turning.hear(b, (i + 1) * DT, float(y[i]))
        num, den = float(b["num"][7]), float(b["den"][7])
        if seed % 2:
            found.append((num / den - size) * math.sqrt(den))
        else:
            none.append(num * num / den)
    assert abs(np.mean(found)) < 1.2
    assert np.std(found) < 2.0
    assert np.mean(none) < 2.5
    assert max(none) < 15.0


def test_a_compass_that_may_turn_with_the_vehicle_says_little_while_it_turns() -> None:
    b = [bank(), bank()]
    for i, calibration in enumerate((0.0, 0.3)):
        b[i]["track"]["r"], b[i]["track"]["known"] = (2.0 * DEG) ** 2, 1e9
        for k in range(200):
            wait(b[i], (0.0, 0.0, 1.0), calibration=calibration)
            b[i]["bearing"][7] = 0.01 * k
            turning.hear(b[i], (k + 1) * DT, 0.0)
    assert float(b[1]["den"][7]) < 0.2 * float(b[0]["den"][7])


def test_a_gap_begins_anew_and_says_nothing() -> None:
    b = bank()
    for k in range(100):
        wait(b)
        turning.hear(b, (k + 1) * DT, 0.0)
    before = float(b["den"][7])
    b["bearing"][7] = 1.0
    assert turning.hear(b, 100 * DT + 2.0, 1.0) < 0.0
    assert float(b["den"][7]) == before


def test_no_correction_is_in_what_a_gyro_axis_turns_by_itself() -> None:
    """A unit rate of gyro z since a slot was opened turns the gyro's heading by its time, whatever gains took out of the filter's."""
    rng = np.random.default_rng(5)
    S = np.zeros(1, layout(1, banks=1))
    S = S if COMPILED else S.view(np.recarray)
    s = S[0]
    s["q"][0] = 1.0
    b = s["bank"][0]
    signatures.clear(b)
    z, ramp, compass = (int(f) * int(signatures.SLOTS) + 4 for f in (2, 8, signatures.HEADING))
    eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    nothing = ((0.0, 0.0, 0.0),) * 3
    for k in range(150):
        s["t"] += DT
        if k == 50:
            signatures.open_slot(s, 4, UP)
        inertial.carry(s, eye, nothing, nothing, DT)
        turning.suppose(b, GYRO, 0.0, DRIFT, 0.0, NO_TURN, UP, DT, NO_TURN, 0.0)
        s["k"][:] = 0.05 * rng.standard_normal(len(s["k"]))
        signatures.matched(s, ((0, UP), NONE, NONE), 1.0, 0.0, 7, True, True)
    lasted = 100 * DT
    assert b["bearing"][z] == pytest.approx(-lasted, rel=1e-4)
    assert b["bearing"][ramp] == pytest.approx(-0.5 * lasted**2, rel=0.02)
    assert b["bearing"][compass] == pytest.approx(1.0, abs=1e-5)
    assert abs(b["e"][z] + lasted) > 0.2  # the filter's own innovation is what the gains have made of it
