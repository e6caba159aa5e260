"""The column map of a single table, from options and a TOML file. Which columns there are is the reader's business."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from haltere.errors import HaltereError, UsageError

__all__ = ["column_map"]

EXAMPLE = "for example --column 'imu.gyro_x=gx [deg/s]'"


def column_map(file: Path | None, assignments: list[str] | None) -> dict[str, str] | None:
    """Column map of a table.

    Parameters
    ----------
    file
        TOML with one line a column, ``"imu.gyro_x" = "gx [deg/s]"``; a table ``[imu]`` with ``gyro_x = ...`` is the same.
    assignments
        Texts ``imu.gyro_x=gx [deg/s]``, over those of the file.

    Returns
    -------
    dict or None
        As `haltere.readers.read` takes it; None where nothing is given.

    Raises
    ------
    UsageError
        No such file, or an assignment that is none.
    HaltereError
        A file that is no TOML, or holds something else than names of columns.
    """
    if file is None and not assignments:
        return None
    out: dict[str, str] = _load(Path(file)) if file is not None else {}
    for text in assignments or []:
        target, sign, source = text.partition("=")
        if not sign or not target.strip() or not source.strip():
            raise UsageError("STREAM.COLUMN=SOURCE", repr(text), "--column", EXAMPLE)
        out[target.strip()] = source.strip()
    return out


def _load(path: Path) -> dict[str, str]:
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError("a column map", "no such file", str(path)) from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise HaltereError("a TOML file of columns", str(error), str(path), 'a line is "imu.gyro_x" = "gx [deg/s]"') from None
    out: dict[str, str] = {}

    def walk(table: dict[str, Any], prefix: str) -> None:
        for name, value in table.items():
            if isinstance(value, dict):
                walk(value, f"{prefix}{name}.")
            elif isinstance(value, str):
                out[prefix + name] = value
            else:
                raise HaltereError(f"the name of a column for {prefix}{name}", repr(value), str(path), "write it in quotes")

    walk(document, "")
    if not out:
        raise HaltereError("a column map", "no column in it", str(path), 'a line is "imu.gyro_x" = "gx [deg/s]"')
    return out
