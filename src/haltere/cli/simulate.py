"""`haltere simulate SCENARIO`: a simulated flight as a flight folder with truth. It estimates nothing."""

from __future__ import annotations

import json as json_
from pathlib import Path
from typing import Any

from haltere.cli.progress import Progress
from haltere.errors import UsageError

__all__ = ["simulate"]


def simulate(
    scenario: str, out: Path, *, assignments: list[str] | None = None, faults: list[str] | None = None, json: bool = False
) -> None:
    """Simulate a flight and write its folder.

    Parameters
    ----------
    scenario
        Name of a built-in scenario, or a TOML file.
    out
        The folder to write.
    assignments
        ``key=value`` texts over the scenario's keys, with dots: ``wind.n=6``, ``sensors.imu.preset=icm42688``, ``seed=3``.
    faults
        Fault words on top of the scenario's.
    json
        Print only the summary, as JSON.

    Raises
    ------
    HaltereError
        The vehicle was lost, a fault that the flight cannot carry, or a folder that cannot be written.
    UsageError
        A scenario, key, vehicle, mission or fault word that is not there.
    """
    from haltere.simulate import load_scenario, parse_scenario
    from haltere.simulate import simulate as fly

    chosen = load_scenario(scenario)
    given = _nested(assignments or [])
    if given:
        chosen = parse_scenario(given, "--set", chosen)
    if faults:
        chosen = chosen.changed(fault=(*chosen.fault, *faults))
    with Progress() as progress:
        progress.stage("simulating a flight", compiles=True)
        flight = fly(chosen)
        progress.stage("writing")
        from haltere.flight.folder import write_folder

        folder = write_folder(flight, out)
    if json:
        from haltere.cli.info import summary

        print(json_.dumps({"folder": str(folder), **summary(flight)}, indent=2, allow_nan=False, ensure_ascii=False))
        return
    for name, stream in flight.streams.items():
        print(f"{name}: {len(stream)} samples")
    for fault in flight.meta.faults:
        print(f"fault: {fault['word']}")
    print(f"written to {folder}")


def _nested(assignments: list[str]) -> dict[str, Any]:
    """Tables of ``a.b=value`` texts; values are numbers, true, false or text."""
    import tomllib

    out: dict[str, Any] = {}
    for text in assignments:
        key, sign, value = text.partition("=")
        if not sign or not key.strip() or not value.strip():
            raise UsageError("key=value", repr(text), "--set", "for example --set wind.n=6")
        try:
            parsed = tomllib.loads(f"x = {value.strip()}")["x"]
        except tomllib.TOMLDecodeError:
            parsed = value.strip()
        *tables, last = key.strip().split(".")
        at = out
        for table in tables:
            at = at.setdefault(table, {})
            if not isinstance(at, dict):
                raise UsageError("keys and tables apart", repr(text), "--set")
        at[last] = parsed
    return out
