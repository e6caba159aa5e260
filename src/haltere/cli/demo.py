"""`haltere demo`: a simulated flight through the navigator, with its report; no input, no network. It simulates nothing itself."""

from __future__ import annotations

import shlex
from pathlib import Path

from haltere.cli.progress import Progress

__all__ = ["demo"]


def demo(out: Path, *, seed: int = 1, json: bool = False, show: bool = False) -> None:
    """Simulate a flight, navigate it, write its folder.

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
        progress.stage("simulating a flight")
        from haltere.simulate import demo_flight

        flight = demo_flight(seed=seed)
        progress.stage("navigator", compiles=True)
        from haltere import drive

        solution = drive.run(flight, "navigator", progress=progress.update)
        finish(solution, flight, out, shlex.join(["haltere", "demo", "--seed", str(seed), "--out", str(out)]), progress)
    told(solution, flight, out, json=json, show=show)
