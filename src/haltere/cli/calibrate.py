"""`haltere calibrate magnetometer LOG`: parameters of a magnetometer from a log, files and a page. It computes nothing itself."""

from __future__ import annotations

import json as json_
import math
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haltere.cli.columns import column_map
from haltere.cli.progress import Progress
from haltere.cli.run import default_folder

if TYPE_CHECKING:
    from haltere.calibrate.magnetometer import MagnetometerCalibration
    from haltere.flight.log import FlightLog

__all__ = ["magnetometer"]

DEG = 180.0 / math.pi


def magnetometer(
    log: Path,
    *,
    method: str,
    load: str,
    stream: str,
    config: Path | None,
    assignments: list[str],
    out: Path | None,
    columns: Path | None,
    column: list[str] | None,
    json: bool,
    show: bool,
) -> None:
    """Calibrate and write ``calibration.toml``, ``calibration.json`` and ``calibration.html``.

    Parameters
    ----------
    log
        A log, a flight folder, or a table of magnetometer vectors.
    method, load, stream
        As of `haltere.calibrate_magnetometer`.
    config, assignments
        Configuration file and ``key=value`` texts over it: units, axes, home, field.
    out
        Folder to write; default ``./<log stem>.haltere``.
    columns, column
        Column map of a single table.
    json
        Print only the result, as JSON.
    show
        Open the page in the browser.

    Raises
    ------
    HaltereError
        The log cannot be read, does not turn the sensor enough (the page shows what is missing), or the folder cannot be written.
    UsageError
        Unknown method, load or key.
    """
    from haltere.errors import UsageError, nearest
    from haltere.flight import config as configuration

    keys: dict[str, Any] = configuration.load(config)[2] if config is not None else {}
    changes = dict(configuration.parse_assignment(text) for text in assignments)
    configuration.resolve("navigator", "default", {**keys, **changes}, "--set")
    mapped = column_map(columns, column)
    folder = Path(out) if out is not None else default_folder(log)
    words = ["haltere", "calibrate", "magnetometer", str(log), "--method", method, "--load", load]
    words += ["--stream", stream] if stream != "magnetometer" else []
    words += ["--config", str(config)] if config is not None else []
    words += [word for text in assignments for word in ("--set", text)]
    words += ["--columns", str(columns)] if columns is not None else []
    words += [word for text in column or [] for word in ("--column", text)]
    with Progress() as progress:
        progress.stage("reading the log")
        flight = _read(log, mapped)
        progress.stage("calibrating", compiles=True)
        from haltere.calibrate.ellipsoid import METHODS
        from haltere.calibrate.files import document, write
        from haltere.calibrate.magnetometer import CoverageError, calibrate_magnetometer
        from haltere.flight.writing import whole_files
        from haltere.report.calibration import calibration_page, refused_page

        if method not in METHODS:
            raise UsageError(f"a method: {', '.join(METHODS)}", repr(method), "--method", nearest(method, METHODS))
        refused: CoverageError | None = None
        try:
            c: MagnetometerCalibration | None = calibrate_magnetometer(flight, method, load=load, stream=stream, config=keys, set=changes)
        except CoverageError as error:
            refused, c = error, error.calibration
        progress.stage("drawing the page")
        if c is not None:
            write(c, folder, {"calibration.html": calibration_page(c, shlex.join(words))})
        elif refused is not None:
            with whole_files(folder, "calibration.html", ["calibration.toml", "calibration.json"]) as work:
                (work / "calibration.html").write_text(refused_page(refused, flight.meta.name), encoding="utf-8")
    page = folder / "calibration.html"
    if show:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())
    for note in c.notes if c is not None else ():
        print(f"note: {note}", file=sys.stderr)
    if refused is not None:
        refused.args = (f"{refused}; {page} shows what was seen",)
        raise refused
    if c is None:  # cannot be: one of the two is there
        return
    if json:
        print(json_.dumps(document(c), indent=1, allow_nan=False, ensure_ascii=False))
    else:
        print("\n".join(_lines(c, folder)))


def _read(log: Path, mapped: dict[str, str] | None) -> FlightLog:
    """The log; three columns of numbers without a header are taken as vectors in order."""
    from haltere.readers import read
    from haltere.readers.table import bare_vectors

    if mapped is None and Path(log).is_file() and bare_vectors(Path(log)):
        print("note: three columns of numbers without names, taken as mag_x, mag_y, mag_z", file=sys.stderr)
        mapped = {"t": "#row", **{f"magnetometer.mag_{a}": f"#{k + 1}" for k, a in enumerate("xyz")}}
    return read(log, mapped)


def _lines(c: MagnetometerCalibration, folder: Path) -> list[str]:
    """The result for people."""
    from haltere.calibrate.autopilots import ardupilot_parameters, px4_parameters, remarks
    from haltere.flight.load import LOADS

    sd = c.sd
    out = [
        f"{c.name or 'log'}: {c.stream}, method {c.method}, {len(c.t)} samples, {int((~c.used).sum())} outliers",
        f"strength spreads by {100.0 * c.spread(c.log):.2g} % as logged, {100.0 * c.spread(c.calibrated):.2g} % calibrated",
        f"level headings are off by up to {DEG * max(abs(c.heading_before)):.1f} deg as logged, uncertain by up to "
        f"{DEG * max(c.heading_sd):.2g} deg (1 sigma) calibrated",
        "offset [uT]: " + ", ".join(f"{v:.2f} ± {s:.2g}" for v, s in zip(c.offset, sd[:3], strict=True)),
    ]
    if c.load_word != "off":
        values = ", ".join(f"{v:.3g} ± {s:.2g}" for v, s in zip(c.load, sd[12:], strict=True))
        out.append(f"load [uT per {LOADS[c.load_word][0]} of {c.load_word}]: {values}")
    if c.turn is not None:
        turn = zip(c.turn.vector, c.turn.covariance.diagonal(), strict=True)
        out.append("rotation against the IMU [deg]: " + ", ".join(f"{DEG * v:.2f} ± {DEG * math.sqrt(max(p, 0.0)):.2g}" for v, p in turn))
    out.append(f"field: {c.strength:.2f} uT, dip {DEG * c.dip:.1f} deg ({c.field_source})")
    out.append(
        f"coverage: {100.0 * c.coverage.share:.0f} % of the directions"
        + (f", none near {', '.join(c.coverage.missing)}" if c.coverage.missing else "")
    )
    autopilot = c.sensor.get("autopilot")
    if autopilot == "PX4" or not autopilot:
        out += ["PX4:", *(f"  param set {k} {v:.6g}" for k, v in px4_parameters(c).items())]
    if autopilot == "ArduPilot" or not autopilot:
        out += ["ArduPilot:", *(f"  {k},{v:.6g}" for k, v in ardupilot_parameters(c).items())]
    out += [f"remark: {r}" for r in remarks(c)]
    out.append(f"use it: haltere run LOG --config {shlex.quote(str(folder / 'calibration.toml'))}")
    out.append(f"page: {folder / 'calibration.html'}")
    return out
