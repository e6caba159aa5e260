"""Simulated flights with truth: paths, sensors, faults. It knows no estimator and reads no log."""

from __future__ import annotations

from haltere.simulate.demo import demo_flight

__all__ = ["demo_flight"]
