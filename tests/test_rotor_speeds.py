"""Rotor speeds on their way to a filter: queue and interpolation, commands through a motor model, and the same online and offline."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from haltere._jit import as_records
from haltere.aids.record import AID_RECORD
from haltere.errors import HaltereError, UsageError
from haltere.estimators import step
from haltere.estimators.base import Estimator, new_state
from haltere.estimators.inputs import parameters
from haltere.estimators.lumped import Lumped
from haltere.estimators.rotors import model_of, rotor_speeds
from haltere.flight.config import resolve
from haltere.flight.log import Stream
from haltere.vehicle.motor import driven

N = 4


def lumped(**changes: Any) -> Lumped:
    """A model of four rotors without forces."""
    return Lumped("full", np.ones(N), np.ones(N), np.ones(N), np.zeros((6, 7)), np.zeros((6, 7, 7)), **changes)


def test_speeds_at_a_time_are_interpolated_between_samples_and_held_for_a_while() -> None:
    config = resolve("navigator", "default", {"delay.rotors": 0.01}, "test")
    S, prm = new_state(config, None, lumped(lag=0.004)), parameters(config)
    rng = np.random.default_rng(1)
    stamps = np.cumsum(rng.uniform(0.01, 0.03, 300))
    speeds = rng.uniform(300.0, 900.0, (300, N))
    at = np.arange(0.05, 4.0, 0.004)
    rows, aids = np.empty((0, 0)), as_records(np.empty(0, AID_RECORD))
    j = 0
    seen, rates = np.full((len(at), N), np.nan), np.full((len(at), N), np.nan)
    for t in at:
        while j < len(stamps) and stamps[j] <= t + 0.1:
            assert step.offer_rotors(S, prm, stamps[j], speeds[j]) == 1
            j += 1
        step.step(S, prm, t, (0.0, 0.0, 0.0), (0.0, 0.0, -9.8), rows, rows, aids, rows, None)
        when = float(S["t"][0])
        if S["phase"][0] > 0 and S["rotor_known"][0]:
            i = round((when - at[0]) / 0.004)
            seen[i], rates[i] = S["speed"][0], S["spin_up"][0]
    there = np.isfinite(seen[:, 0])
    valid = stamps - 0.014
    assert there.sum() > 900
    for r in range(N):
        assert np.allclose(seen[there, r], np.interp(at[there], valid, speeds[:, r]), atol=1e-9)
        between = np.clip(np.searchsorted(valid, at[there], side="right") - 1, 0, 298)
        slope = np.diff(speeds[:, r]) / np.diff(valid)
        assert np.allclose(rates[there, r], slope[between], atol=1e-6)
    assert step.offer_rotors(S, prm, stamps[0], speeds[0]) == 0  # not after the one before
    assert int(S["n_rotor_bad"][0]) == 1


def test_commands_become_speeds_through_curve_voltage_and_lag() -> None:
    t, t_u = np.arange(0.0, 2.0, 0.002), np.arange(0.0, 2.0, 0.02)
    u = np.where(t_u[:, None] < 1.0, 0.36, 0.64) * np.ones((1, N))
    got = driven(t, t_u, u, np.full(len(t), 0.9), 0.0, 0.05, 1000.0)
    assert np.allclose(got[t < 1.0], 0.9 * 360.0)
    after = t[t > 1.001] - 1.0
    assert np.allclose(got[t > 1.001][:, 0], 0.9 * (640.0 - 280.0 * np.exp(-after / 0.05)), rtol=1e-9)
    assert np.allclose(driven(t, t_u, u, np.ones(len(t)), 1.0, 0.05, 1000.0)[0], 600.0)


def test_a_flight_without_what_the_model_needs_is_refused() -> None:
    t = np.arange(0.0, 4.0, 0.02)
    three = {f"speed_{k}": np.full(len(t), 500.0) for k in range(3)}
    with pytest.raises(HaltereError, match="4 rotors"):
        rotor_speeds({"rotors": Stream({"t": t, **three})}, lumped(), t)
    with pytest.raises(HaltereError, match="rotor speeds"):
        rotor_speeds({}, lumped(), t)
    with pytest.raises(HaltereError, match="commands of 4 motors"):
        rotor_speeds({}, lumped(motor={"full": 1000.0, "linear": 0.3, "tau": 0.04}), t)
    with pytest.raises(UsageError, match="does not use a vehicle model"):
        model_of(lumped(), "ahrs")
    with pytest.raises(UsageError, match="does not use a vehicle model"):
        Estimator("ahrs", vehicle="iris")
