"""`haltere convert LOG DIR`: any log to a flight folder. It changes no sample."""

from __future__ import annotations

import json as json_
import sys
from pathlib import Path

__all__ = ["convert"]


def convert(
    log: Path, out: Path, csv: bool = False, json: bool = False, columns: Path | None = None, column: list[str] | None = None
) -> None:
    """Write a log as a flight folder.

    Parameters
    ----------
    log
        A log or flight folder.
    out
        The folder to write.
    csv
        Tables as CSV instead of Parquet.
    json
        Print only the summary, as JSON.
    columns, column
        Column map of a single table: a file, and single columns.

    Raises
    ------
    HaltereError
        The log cannot be read, or the folder not be written.
    """
    from haltere.cli.columns import column_map
    from haltere.cli.info import summary
    from haltere.flight.folder import write_folder
    from haltere.readers import read

    flight = read(log, column_map(columns, column))
    folder = write_folder(flight, out, csv=csv)
    for name, reasons in flight.discarded.items():
        for reason, n in reasons.items():
            print(f"discarded: {name}: {n} samples, {reason}", file=sys.stderr)
    if json:
        print(json_.dumps({"folder": str(folder), **summary(flight)}, indent=2, allow_nan=False, ensure_ascii=False))
        return
    for name, stream in flight.streams.items():
        print(f"{name}: {len(stream)} samples")
    print(f"written to {folder}")
