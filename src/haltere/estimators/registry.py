"""Estimators by name: one line each."""

from __future__ import annotations

from types import ModuleType

from haltere.estimators import ahrs, navigator

#: Module of each estimator.
SPECIFICATIONS: dict[str, ModuleType] = {navigator.NAME: navigator, ahrs.NAME: ahrs}
