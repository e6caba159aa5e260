"""`haltere run LOG`: the main job, from a log to a folder with solution and report. It computes nothing itself."""

from __future__ import annotations

import json as json_
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haltere.cli.columns import column_map
from haltere.cli.progress import Progress
from haltere.errors import UsageError

if TYPE_CHECKING:
    from haltere.flight.log import FlightLog
    from haltere.flight.solution import Solution

__all__ = ["default_folder", "finish", "run"]


def default_folder(log: Path) -> Path:
    """Where a run is written when nothing else is said: ``./<log stem>.haltere``."""
    log = Path(log)
    named = log if log.stem not in ("", "..") else log.resolve()
    return Path(f"{named.stem or 'flight'}.haltere")


def run(
    log: Path,
    *,
    estimator: str | None = None,
    preset: str | None = None,
    config: Path | None = None,
    assignments: list[str] | None = None,
    smooth: bool = False,
    vehicle: Path | None = None,
    out: Path | None = None,
    rate: float | None = None,
    wind: str | None = None,
    wind_sd: float | None = None,
    columns: Path | None = None,
    column: list[str] | None = None,
    json: bool = False,
    show: bool = False,
) -> None:
    """Estimate a flight and write its folder.

    Parameters
    ----------
    log
        A log or flight folder.

    Other Parameters
    ----------------
    estimator, preset
        Names; what is not given is taken from the configuration file, else ``navigator`` and ``default``.
    config
        Configuration file.
    assignments
        ``key=value`` texts, over everything else.
    smooth, vehicle, rate
        As of `haltere.run`.
    out
        Folder to write; default `default_folder`.
    wind, wind_sd
        Wind told from outside and its 1 sigma [m/s], as of `haltere.with_wind`.
    columns, column
        Column map of a single table: a file, and single columns; see `haltere.cli.columns`.
    json
        Print only the summary, as JSON.
    show
        Open the report in the browser.

    Raises
    ------
    HaltereError
        The log cannot be read or navigated on, or the folder not be written.
    UsageError
        Unknown estimator, preset or key, or a value out of bounds.
    """
    from haltere.flight import config as configuration

    # Wrong usage is found before the log is read.
    named: tuple[str | None, str | None] = (None, None)
    keys: dict[str, Any] = {}
    if config is not None:
        *named_, keys = configuration.load(config)
        named = (named_[0], named_[1])
    estimator, preset = estimator or named[0] or "navigator", preset or named[1] or "default"
    changes = dict(configuration.parse_assignment(text) for text in assignments or [])
    configuration.resolve(estimator, preset, keys, str(config))
    configuration.resolve(estimator, preset, changes, "--set")
    if wind is not None:
        _usable_wind(wind, wind_sd)
    elif wind_sd is not None:
        raise UsageError("--wind with --wind-sd", "--wind-sd alone", "run")

    mapped = column_map(columns, column)
    folder = Path(out) if out is not None else default_folder(log)
    with Progress() as progress:
        progress.stage("reading the log")
        from haltere.readers import read

        flight = read(log, mapped)
        if wind is not None:
            from haltere.flight.given_wind import with_wind

            flight = with_wind(flight, wind, sd=wind_sd)
        progress.stage(estimator, compiles=True)
        from haltere import drive

        solution = drive.run(
            flight, estimator, preset=preset, config=keys, set=changes, vehicle=vehicle, smooth=smooth, rate=rate, progress=progress.update
        )
        again = [
            "haltere",
            "run",
            str(log),
            "--config",
            str(folder / "config.toml"),
            *(["--smooth"] if smooth else []),
            *(["--rate", f"{rate:g}"] if rate is not None else []),
            *(["--wind", wind] if wind is not None else []),
            *(["--wind-sd", f"{wind_sd:g}"] if wind_sd is not None else []),
            *(["--columns", str(columns)] if columns is not None else []),
            *(word for text in column or [] for word in ("--column", text)),
        ]
        flight = drive.usable(flight, solution.config)
        finish(solution, flight, folder, shlex.join(again), progress)
    told(solution, flight, folder, json=json, show=show)


def _usable_wind(wind: str, sd: float | None) -> None:
    """Refuse an option that is no wind before the log is read."""
    from haltere.flight.given_wind import SHAPES, parse_wind

    if parse_wind(wind) is None and not Path(wind).is_file():
        raise UsageError(SHAPES, f"{wind!r}, which is no file", "--wind")
    if sd is not None and not sd > 0.0:
        raise UsageError("a positive 1 sigma [m/s]", repr(sd), "--wind-sd")


def finish(solution: Solution, flight: FlightLog, folder: Path, command: str, progress: Progress) -> None:
    """Draw the report and write everything."""
    progress.stage("drawing the report")
    from haltere.report import page

    text = page(solution, flight, command)
    progress.stage("writing")
    solution.save(folder, extra={"report.html": text})


def told(solution: Solution, flight: FlightLog, folder: Path, *, json: bool, show: bool) -> None:
    """Print what came out, and open the report where asked."""
    from haltere.cli.told import lines, losses

    losses(solution.summary)
    if json:
        print(json_.dumps(solution.summary, indent=1, allow_nan=False, ensure_ascii=False))
    else:
        print("\n".join(lines(solution, flight, folder)))
    if show:
        import webbrowser

        webbrowser.open((folder / "report.html").resolve().as_uri())
