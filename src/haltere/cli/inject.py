"""`haltere inject LOG FAULT...`: a flight with faults put into it, as a flight folder. It detects nothing."""

from __future__ import annotations

import json as json_
from pathlib import Path

__all__ = ["inject"]


def inject(log: Path, faults: list[str], out: Path, *, json: bool = False) -> None:
    """Put faults into a log and write it as a flight folder.

    Parameters
    ----------
    log
        A log or flight folder; it stays as it is.
    faults
        Fault words, in the order in which they are applied.
    out
        The folder to write; its ``flight.toml`` names the faults.
    json
        Print only the summary, as JSON.

    Raises
    ------
    HaltereError
        The log cannot be read, a fault that it cannot carry, or a folder that cannot be written.
    UsageError
        Not a fault word.
    """
    from haltere.flight.folder import write_folder
    from haltere.readers import read
    from haltere.simulate import inject as put
    from haltere.simulate import parse_fault

    parsed = [parse_fault(word) for word in faults]  # wrong words are found before the log is read
    flight = put(read(log), parsed)
    folder = write_folder(flight, out)
    if json:
        from haltere.cli.info import summary

        print(
            json_.dumps(
                {"folder": str(folder), "faults": flight.meta.faults, **summary(flight)}, indent=2, allow_nan=False, ensure_ascii=False
            )
        )
        return
    for fault in parsed:
        end = f" to {fault.end:g} s" if fault.end != float("inf") else " s on"
        print(f"injected: {fault.word}, from {fault.start:g}{end}")
    print(f"written to {folder}")
