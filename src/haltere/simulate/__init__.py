"""Simulated flights with truth: vehicles, missions, wind, sensors, faults; it knows no estimator. The room itself can be called."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

from haltere.flight.log import FlightLog
from haltere.simulate.demo import demo_flight
from haltere.simulate.faults import inject
from haltere.simulate.scenario import SCENARIOS, Scenario, load_scenario, parse_scenario
from haltere.simulate.simulator import simulate
from haltere.simulate.words import Fault, parse_fault

__all__ = ["SCENARIOS", "Fault", "Scenario", "demo_flight", "inject", "load_scenario", "parse_fault", "parse_scenario", "simulate"]


class _Room(ModuleType):
    """``haltere.simulate`` is this room and the function in it: importing a room puts it under its name in the package above."""

    def __call__(self, scenario: Scenario | str | Path) -> FlightLog:
        """Simulate a flight, see `simulate`."""
        return simulate(scenario)


sys.modules[__name__].__class__ = _Room
