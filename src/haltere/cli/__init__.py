"""The command line: verbs, options and exit statuses. Each verb's work is in its own file, imported when the verb is called."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from haltere._version import __version__
from haltere.errors import HaltereError

__all__ = ["app", "main"]

app = typer.Typer(
    name="haltere",
    help="Inertial navigation for small multirotors: reads a flight log, estimates attitude, velocity, position and sensor biases, "
    "and says how far to trust them.",
    epilog="Exit status: 0 done, 1 the run failed, 2 wrong usage. `haltere VERB --help` describes a verb.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # plain help is readable everywhere, and quick
    pretty_exceptions_enable=False,
)

Log = Annotated[Path, typer.Argument(metavar="LOG", help="A log of any supported format, or a flight folder.", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="Print the summary as JSON to stdout, and nothing else.")]
Open = Annotated[bool, typer.Option("--open", help="Show the report in the browser afterwards.")]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"haltere {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.", callback=_version, is_eager=True)] = False,
) -> None:
    pass


@app.command(
    "run",
    short_help="Navigate a log; write solution and report.",
    help="Estimate a flight from its log; write solution, summary, configuration and report to a folder.",
)
def _run(
    log: Log,
    estimator: Annotated[
        str | None, typer.Option("--estimator", metavar="E", help="navigator (default) or ahrs.", show_default=False)
    ] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", metavar="P", help="Named set of parameters: default.", show_default=False)
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="F", help="Configuration file, such as the config.toml of another run.", show_default=False),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change one configuration key. May be repeated.", show_default=False),
    ] = None,
    smooth: Annotated[bool, typer.Option("--smooth", help="Run the smoother too.")] = False,
    vehicle: Annotated[Path | None, typer.Option("--vehicle", metavar="F", help="Vehicle file.", show_default=False)] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write. Default: ./<log>.haltere", show_default=False)
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Rows a second of the solution. Default: every IMU sample.", show_default=False),
    ] = None,
    json: Json = False,
    open_: Open = False,
) -> None:
    from haltere.cli.run import run

    run(
        log, estimator=estimator, preset=preset, config=config, assignments=set_ or [], smooth=smooth, vehicle=vehicle, out=out, rate=rate,
        json=json, show=open_,
    )  # fmt: skip


@app.command(
    "demo",
    short_help="Simulate a flight, navigate it, report.",
    help="Simulate a flight, navigate it and write its report: no input, no network.",
)
def _demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")] = Path("demo.haltere"),
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Of everything random in the flight.")] = 1,
    json: Json = False,
    open_: Open = False,
) -> None:
    from haltere.cli.demo import demo

    demo(out, seed=seed, json=json, show=open_)


@app.command(
    "info",
    short_help="What a log holds and supports.",
    help="Say what is in a log, what each estimator can do with it, and which logging setting would help.",
)
def _info(log: Log, json: Json = False) -> None:
    from haltere.cli.info import info

    info(log, json=json)


@app.command(
    "convert", short_help="Any log to a flight folder.", help="Write a log as a flight folder: one table a sensor, SI units, NED and FRD."
)
def _convert(
    log: Log,
    out: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to write.", show_default=False)],
    csv: Annotated[bool, typer.Option("--csv", help="Tables as CSV instead of Parquet.")] = False,
    json: Json = False,
) -> None:
    from haltere.cli.convert import convert

    convert(log, out, csv=csv, json=json)


def main() -> None:
    """Run the command line. What a user can put right is one line on stderr, with the error's exit status."""
    try:
        app()
    except HaltereError as error:
        print(f"haltere: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:  # outside a verb, while the command line itself is read
        sys.exit(130)
