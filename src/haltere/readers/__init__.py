"""Reading any supported log into a FlightLog, picked by content. It knows the formats' names and nothing of their fields."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from haltere.errors import HaltereError

if TYPE_CHECKING:
    from haltere.flight.log import FlightLog

__all__ = ["FORMATS", "format_of", "read"]

#: One line a format, tried in this order: module and what it reads. A module has ``sniff(path, head)`` and ``read(path)``.
FORMATS: tuple[tuple[str, str], ...] = (
    ("haltere.flight.folder", "flight folder"),
    ("haltere.readers.px4", "PX4 ULog"),
    ("haltere.readers.ardupilot", "ArduPilot DataFlash"),
    ("haltere.readers.ros", "ROS bag or MCAP"),
    ("haltere.readers.blackbox", "Betaflight blackbox"),
    ("haltere.readers.datcon", "DJI DatCon CSV"),
    ("haltere.readers.table", "CSV or Parquet table"),
)

#: Bytes of a file's beginning that a format may look at.
HEAD_BYTES = 65536


def format_of(path: Path | str) -> str | None:
    """Module of the format that recognises a log by its content, or None.

    Raises
    ------
    HaltereError
        There is nothing at ``path``, it is empty, or it cannot be opened.
    """
    path = Path(path)
    head = _head(path)
    for module, _ in FORMATS:
        if importlib.import_module(module).sniff(path, head):
            return module
    return None


def read(path: Path | str, column_map: Mapping[str, str] | None = None) -> FlightLog:
    """Read a log of any supported format.

    Parameters
    ----------
    path
        A log file or a flight folder. The format is found from the content, not from the name.
    column_map
        For a single CSV or Parquet table: which column is what, e.g. ``{"imu.gyro_x": "gx [deg/s]"}``; see `haltere.readers.table`.

    Returns
    -------
    FlightLog
        Streams in SI units, NED/FRD, each on its own time base; what was left out is in ``notes`` and ``discarded``.

    Raises
    ------
    HaltereError
        The file is missing, empty, cut short beyond use or of no format that haltere reads.
    """
    path = Path(path)
    module = "haltere.readers.table" if column_map is not None else format_of(path)
    if module is None:
        raise HaltereError(
            f"a log in one of the formats {', '.join(name for _, name in FORMATS)}",
            "a folder without flight.toml" if path.is_dir() else f"{path.stat().st_size} bytes of none of them",
            str(path),
            "check that the file was copied whole; a table of your own needs a header line and a column map",
        )
    reader = importlib.import_module(module)
    try:
        # Damaged numbers (inf, beyond an integer's range) are samples like others until the flight is checked.
        with np.errstate(all="ignore"):
            flight: FlightLog = reader.read(path, column_map) if column_map is not None else reader.read(path)
    except HaltereError:
        raise
    except OSError as error:
        raise HaltereError("a readable log", error.strerror or str(error), str(path), "check the path and its permissions") from error
    except Exception as error:
        # Readers check what they can foresee; a format's own library may still fall over a damaged file in its own way.
        raise HaltereError(
            f"a whole {dict(FORMATS)[module]}",
            f"damaged content ({type(error).__name__}: {error})",
            str(path),
            "copy the log again from the vehicle; if it is whole, please report it",
        ) from error
    return flight


def _head(path: Path) -> bytes:
    if not path.exists():
        raise HaltereError("a log file or flight folder", "nothing there", str(path), "check the path")
    if path.is_dir():
        return b""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise HaltereError("a readable log", error.strerror or str(error), str(path), "check the path and its permissions") from error
    if not head:
        raise HaltereError("a log", "an empty file", str(path), "copy the log again from the vehicle")
    return head
