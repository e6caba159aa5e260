"""The compiled filter against its C++ twin: the same numbers from an implementation of its own (benchmarks/twin.cpp)."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from haltere._jit import as_records
from haltere.aids.record import AID_RECORD
from haltere.estimators import step as kernels
from haltere.estimators.base import new_state
from haltere.estimators.inputs import parameters

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
import twin

#: What the twin does not have.
WITHOUT = {"aid__zero_velocity": "off", "aid__zero_rate": "off", "aid__fake_position": "off", "aid__yaw_bank": "off"}


def _need_compiler() -> None:
    reason = twin.missing()
    if reason:
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)


@pytest.mark.parametrize("keys", [{}, {"arm__gnss_x": 0.3, "arm__gnss_z": -0.1}, {"imu__kind": "mean"}])
def test_the_twin_gives_the_same_numbers(keys: dict[str, float | str]) -> None:
    """20 000 samples at 1 kHz with every sensor: rows agree to 1e-9 of their size, and so does what was fused and refused."""
    _need_compiler()
    flight = twin.fly(20_000)
    config = twin.configuration_of(**WITHOUT, **twin.PLAIN, **keys)
    S, prm = new_state(config, flight.initial()), parameters(config)
    n = len(flight.t)
    rows, cov = np.zeros((n + 2000, 37)), np.empty((kernels.COVARIANCE_ROWS, 1000))
    aids = as_records(np.empty(60_000, AID_RECORD))
    i = j = 0
    while i < n or S["imu_n"][0] > 0:
        i, j = kernels.run_chunk(
            S, prm, flight.t, flight.gyro, flight.accel, i, n, flight.kind, flight.stamp, flight.z, flight.r, j, rows, cov, aids,
            np.empty((0, 0)), None, np.empty(0), np.empty((0, 0)),
        )  # fmt: skip
        S["n_aids"] = S["n_events"] = 0
    theirs = np.zeros((n, 37))
    peer = twin.Twin(config)
    state = peer.begin(flight.initial())
    peer.run(state, flight, theirs)
    ours = rows[:n]
    assert int(S["n_rows"][0]) == n
    assert np.isfinite(theirs).all()
    scale = np.abs(theirs).max(axis=0) + 1e-12
    assert (np.abs(ours - theirs) / scale).max() < 1e-9
    assert (S["aid"]["n_fused"][0, :4] == state["n_fused"][0]).all()
    assert (S["aid"]["n_rejected"][0, :4] == state["n_rejected"][0]).all()
    assert (state["n_fused"][0] > [150, 150, 900, 1900]).all()  # every sensor took part
