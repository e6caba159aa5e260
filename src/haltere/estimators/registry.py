"""Estimators by name: one line each, and the kernels that each is made of."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from haltere.estimators import ahrs, fault_tolerant, federated_step, navigator, quaternion_step, step, two_stage, wind_attitude

#: Module of each estimator.
SPECIFICATIONS: dict[str, ModuleType] = {m.NAME: m for m in (navigator, ahrs, two_stage, wind_attitude, fault_tolerant)}


def kernels_of(S: Any) -> ModuleType:
    """The compiled step that belongs to an array of states: they have the same faces."""
    if S["P"].shape[1] == 4:
        return quaternion_step
    return federated_step if S["ft"].shape[1] else step
