"""Estimators by name: one line each."""

from __future__ import annotations

from types import ModuleType

from haltere.estimators import ahrs, navigator, two_stage

#: Module of each estimator.
SPECIFICATIONS: dict[str, ModuleType] = {m.NAME: m for m in (navigator, ahrs, two_stage)}
