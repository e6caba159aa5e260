"""`haltere demo`: a simulated flight with two faults through the navigator, with its report; no input, no network."""

from __future__ import annotations

import shlex
from pathlib import Path

from haltere.cli.progress import Progress

__all__ = ["demo"]


def demo(out: Path, *, seed: int = 1, json: bool = False, show: bool = False) -> None:
    """Simulate a flight in gusty wind, with a disturbed field and a gyro that fails, navigate it, write its folder.

    Parameters
    ----------
    out
        Folder to write.
    seed
        Of everything random in the flight.
    json
        Print only the summary, as JSON.
    show
        Open the report in the browser.
    """
    from haltere.cli.run import finish, told

    with Progress() as progress:
        progress.stage("simulating a flight", compiles=True)
        from haltere.simulate import SCENARIOS
        from haltere.simulate import simulate as fly

        flight = fly(SCENARIOS["demo"].changed(seed=seed))
        progress.stage("navigator", compiles=True)
        from haltere import drive

        solution = drive.run(flight, "navigator", progress=progress.update)
        finish(solution, flight, out, shlex.join(["haltere", "demo", "--seed", str(seed), "--out", str(out)]), progress)
    told(solution, flight, out, json=json, show=show)
