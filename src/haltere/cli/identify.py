"""`haltere identify --drag LOG...`: what flights tell of their vehicle, files and a page. It computes nothing itself."""

from __future__ import annotations

import json as json_
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haltere.cli.columns import column_map
from haltere.cli.progress import Progress
from haltere.cli.run import default_folder

if TYPE_CHECKING:
    from haltere.identify.drag import DragIdentification

__all__ = ["drag"]


def drag(
    logs: list[Path],
    *,
    config: Path | None,
    assignments: list[str],
    out: Path | None,
    columns: Path | None,
    column: list[str] | None,
    json: bool,
    show: bool,
) -> None:
    """Identify drag and wind; write ``drag.toml``, ``drag.json`` and ``drag.html``.

    Parameters
    ----------
    logs
        Logs or flight folders of one vehicle.
    config, assignments
        Configuration file and ``key=value`` texts over it, as of a run; ``baro.temperature`` [K] sharpens the air density.
    out
        Folder to write; default ``./<first log's stem>.haltere``.
    columns, column
        Column map, where the logs are single tables.
    json
        Print only the result, as JSON.
    show
        Open the page in the browser.

    Raises
    ------
    HaltereError
        A log cannot be read or navigated on, the flights do not tell drag from wind (the page shows what was seen), or the folder
        cannot be written.
    UsageError
        Unknown key.
    """
    from haltere.flight import config as configuration

    keys: dict[str, Any] = configuration.load(config)[2] if config is not None else {}
    changes = dict(configuration.parse_assignment(text) for text in assignments)
    configuration.resolve("navigator", "default", {**keys, **changes}, "--set")
    mapped = column_map(columns, column)
    folder = Path(out) if out is not None else default_folder(logs[0])
    words = ["haltere", "identify", "--drag", *(str(log) for log in logs)]
    words += ["--config", str(config)] if config is not None else []
    words += [word for text in assignments for word in ("--set", text)]
    words += ["--columns", str(columns)] if columns is not None else []
    words += [word for text in column or [] for word in ("--column", text)]
    with Progress() as progress:
        progress.stage("reading" if len(logs) == 1 else f"reading {len(logs)} logs")
        from haltere.readers import read

        flights = [read(log, mapped) for log in logs]
        progress.stage("smoothing and fitting", compiles=True)
        from haltere.identify.drag import NotObservableError, identify_drag
        from haltere.identify.files import document, write
        from haltere.report.identification import drag_page

        refused: NotObservableError | None = None
        try:
            d = identify_drag(flights, config=keys, set=changes)
        except NotObservableError as error:
            refused, d = error, error.identification
        progress.stage("drawing the page")
        write(d, folder, {"drag.html": drag_page(d, shlex.join(words))})
    page = folder / "drag.html"
    if show:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())
    for note in d.notes:
        print(f"note: {note}", file=sys.stderr)
    if refused is not None:
        refused.args = (f"{refused}; {page} shows what was seen",)
        raise refused
    if json:
        print(json_.dumps(document(d), indent=1, allow_nan=False, ensure_ascii=False))
    else:
        print("\n".join(_lines(d, folder)))


def _lines(d: DragIdentification, folder: Path) -> list[str]:
    """The result for people."""
    import math

    from haltere.identify.autopilots import ardupilot_parameters, parameter_sd, px4_parameters, remarks
    from haltere.identify.forms import FORMS

    force, force_sd = d.drag_at
    seconds = sum(float(s.t[-1] - s.t[0]) for s in d.flights)
    best = min(f.bic for f in d.fits.values())
    out = [
        f"{d.name}: {seconds:.0f} s in the air",
        f"drag at 5 m/s: {force:.2f} ± {force_sd:.2g} m/s^2",
    ]
    for m, part, k in zip(d.motions, d.base.parts, range(len(d.motions)), strict=True):
        sd = d.base.part_sd(k)[-2:]
        speed = math.hypot(*part.wind)
        toward = math.degrees(math.atan2(part.wind[1], part.wind[0])) % 360.0
        out.append(
            f"wind of {m.name}: {speed:.1f} m/s towards {toward:.0f} deg (n {part.wind[0]:.2f} ± {sd[0]:.2g}, e {part.wind[1]:.2f} ± "
            f"{sd[1]:.2g}), gusts {part.sizes[0]:.2g} m/s lasting {part.sizes[1]:.2g} s"
        )
    for name, f in d.fits.items():
        rows = zip(FORMS[name].names, f.values, f.sd, FORMS[name].units, strict=True)
        out.append(f"model {name}: {', '.join(f'{n} {v:.4g} ± {s:.2g} {u}' for n, v, s, u in rows)}; BIC {f.bic - best:+.0f}")
    for title, values, sds, form in (
        ("PX4", px4_parameters(d), parameter_sd(d, "px4"), "  param set {name} {value}"),
        ("ArduPilot", ardupilot_parameters(d), parameter_sd(d, "ardupilot"), "  {name},{value}"),
    ):
        out.append(f"{title}:")
        out += [form.format(name=n, value=f"{v:.4g}") for n, v in values.items()]
        out.append("  1 sigma: " + ", ".join(f"{n} {v:.2g}" for n, v in sds.items()))
    out += [f"remark: {r}" for r in remarks(d)]
    out.append(f"use it: haltere run LOG --config {shlex.quote(str(folder / 'drag.toml'))}")
    out.append(f"page: {folder / 'drag.html'}")
    return out


def vehicle(
    logs: list[Path],
    *,
    preset: str,
    vehicle: str | None,
    validate: list[Path],
    still: bool | None,
    config: Path | None,
    assignments: list[str],
    out: Path | None,
    columns: Path | None,
    column: list[str] | None,
    json: bool,
    show: bool,
) -> None:
    """Identify forces and moments; write a vehicle file with ``[lumped]``, and a page and JSON of the same stem beside it.

    Parameters
    ----------
    logs, validate
        Logs to fit, and logs to predict.
    preset, vehicle, still
        As of `haltere.identify_vehicle`.
    config, assignments
        Configuration file and ``key=value`` texts over it, as of a run.
    out
        Vehicle file (``.toml``) or folder to write; default ``./<first log's stem>.haltere/vehicle.toml``.
    columns, column
        Column map, where the logs are single tables.
    json
        Print only the result, as JSON.
    show
        Open the page in the browser.

    Raises
    ------
    HaltereError
        A log cannot be read, navigated on or used, or a geometry that the flights contradict.
    UsageError
        Unknown preset, vehicle or key.
    """
    from haltere.flight import config as configuration

    keys: dict[str, Any] = configuration.load(config)[2] if config is not None else {}
    changes = dict(configuration.parse_assignment(text) for text in assignments)
    configuration.resolve("navigator", "default", {**keys, **changes}, "--set")
    mapped = column_map(columns, column)
    target = Path(out) if out is not None else default_folder(logs[0])
    file = target if target.suffix == ".toml" else target / "vehicle.toml"
    words = ["haltere", "identify", *(str(log) for log in logs), "--preset", preset]
    words += ["--vehicle", vehicle] if vehicle is not None else []
    words += [word for log in validate for word in ("--validate", str(log))]
    words += [] if still is None else ["--still" if still else "--windy"]
    words += ["--config", str(config)] if config is not None else []
    words += [word for text in assignments for word in ("--set", text)]
    words += ["--columns", str(columns)] if columns is not None else []
    words += [word for text in column or [] for word in ("--column", text)]
    with Progress() as progress:
        progress.stage("reading" if len(logs) == 1 else f"reading {len(logs)} logs")
        from haltere.readers import read

        flights, kept = [read(log, mapped) for log in logs], [read(log, mapped) for log in validate]
        progress.stage("smoothing and fitting", compiles=True)
        from haltere.identify.vehicle import identify_vehicle
        from haltere.identify.vehicle_files import document, write
        from haltere.report.vehicle_model import vehicle_page

        d = identify_vehicle(flights, preset, vehicle=vehicle, validate=kept, still=still, config=keys, set=changes)
        progress.stage("drawing the page")
        page = file.with_suffix(".html")
        write(d, file, {page.name: vehicle_page(d, shlex.join(words))})
    if show:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())
    for note in d.notes:
        print(f"note: {note}", file=sys.stderr)
    if json:
        print(json_.dumps(document(d), indent=1, allow_nan=False, ensure_ascii=False))
        return
    from haltere.vehicle.regressors import AXES, NAMES, PRESETS

    for i, axis in enumerate(AXES):
        found = [f"{NAMES[i][j]} {d.lumped.k[i, j]:.4g} ± {d.lumped.sd[i, j]:.2g}" for j in PRESETS[preset][i]]
        print(f"{axis}: {', '.join(found)}; left {d.lumped.residual_sd[i]:.3g}")
    for c in d.checks:
        part = ", ".join(f"{a} {100.0 * e:.0f} %" for a, e in zip(AXES, c.explained, strict=True))
        print(f"{'fitted' if c.seen else 'not fitted'} {c.name}: variance predicted {part}")
    print(f"vehicle file: {file}\npage: {page}")
