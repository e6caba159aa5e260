"""Solutions with a wind made by hand, for the tests of what is said of it: the true wind of a simulated flight with drawn errors."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np

from haltere import drive
from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.simulate import Scenario, simulate

Array = np.ndarray


@lru_cache(maxsize=8)
def flown(mission: str, duration: float = 60.0, north: float = 4.0, east: float = 3.0, gust: float = 0.6, shear: float = 0.0):
    """A simulated flight in wind and its solution without any wind."""
    wind = {"n": north, "e": east, "gust": gust, "shear": shear}
    flight = simulate(Scenario(name=mission, mission=mission, duration=duration, seed=3, wind=wind))
    return flight, drive.run(flight, rate=20.0, set={"aid.drag": "off", "aid.airdata": "off"})


def with_wind(
    flight: FlightLog, solution: Solution, *, sd: float = 0.4, prior: float = 5.0, seconds: float = 4.0, seed: int = 1,
    sensor: str = "drag", nis: float = 1.0, mu: tuple[float, float] | None = (0.15, 0.02), scale: float = 1.0,
    drift: float = 1.0,
) -> Solution:  # fmt: skip
    """The solution with the true wind plus a slow error of ``scale`` times the stated 1 sigma, which falls from ``prior`` to ``sd`` [m/s].

    ``sensor`` is what its aid records say felt the air, with innovations of a mean square of ``nis``; ``mu`` the relative 1 sigma of the
    drag coefficient at the start and at the end, and ``drift`` the factor by which it moves.
    """
    rng = np.random.default_rng(seed)
    t, truth = solution.t, flight["truth"]
    stated = np.sqrt(sd**2 + (prior**2 - sd**2) * np.exp(-(t - t[0]) / seconds))
    table = dict(solution.table)
    for a in "ne":
        slow = np.interp(t, np.arange(t[0], t[-1] + 10.0, 10.0), rng.standard_normal(int((t[-1] - t[0]) / 10.0) + 2))
        table[f"wind_{a}"] = np.interp(t, truth.t, truth[f"wind_{a}"]) + scale * stated * slow
        table[f"sd_wind_{a}"] = stated
    if mu is not None:
        relative = np.sqrt(mu[1] ** 2 + (mu[0] ** 2 - mu[1] ** 2) * np.exp(-(t - t[0]) / seconds))
        table["drag_mu"] = 0.4 * (1.0 + 0.5 * relative) * drift ** ((t - t[0]) / (t[-1] - t[0]))
        table["sd_drag_mu"] = table["drag_mu"] * relative
    at = t[::4]
    n = len(at)
    made = {
        "t": at, "sensor": np.full(n, sensor), "component": np.full(n, "drag_x"), "observation": np.zeros(n),
        "innovation": np.sqrt(nis) * rng.standard_normal(n), "innovation_sd": np.ones(n), "test_ratio": np.full(n, 0.1),
        "weight": np.ones(n), "status": np.full(n, "fused"), "reason": np.full(n, ""),
    }  # fmt: skip
    aids = {k: np.concatenate([v, made[k]]) for k, v in solution.aids.items() if k in made}
    summary = {
        **solution.summary,
        "nis": {**solution.summary["nis"], sensor: {"mean": nis, "band": [0.9, 1.1], "n": n, "rejected": 0, "deweighted": 0, "lost": 0.0}},
    }
    return dataclasses.replace(solution, table=table, aids=aids, summary=summary)
