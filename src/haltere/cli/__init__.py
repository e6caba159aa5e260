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
Columns = Annotated[
    Path | None,
    typer.Option("--columns", metavar="F", help='Column map of a single table: TOML, "imu.gyro_x" = "gx [deg/s]".', show_default=False),
]
Column = Annotated[
    list[str] | None,
    typer.Option(
        "--column", metavar="COL=SOURCE", help="One column of the map, imu.gyro_x='gx [deg/s]'. May be repeated.", show_default=False
    ),
]
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
        str | None,
        typer.Option("--estimator", metavar="E", help="navigator (default), ahrs, two-stage or wind-attitude.", show_default=False),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            "--preset",
            metavar="P",
            help="Named set of parameters; two-stage and wind-attitude have as-corrected and as-printed.",
            show_default=False,
        ),
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
    wind: Annotated[
        str | None,
        typer.Option(
            "--wind",
            metavar="W",
            show_default=False,
            help="Wind told from outside: N,E[,D] in m/s as it blows to, SPEED@FROM such as 5@270, or a table of a station.",
        ),
    ] = None,
    wind_sd: Annotated[
        float | None,
        typer.Option("--wind-sd", metavar="M/S", help="Its 1 sigma. Default: what the table says, else 1.", show_default=False),
    ] = None,
    columns: Columns = None,
    column: Column = None,
    json: Json = False,
    open_: Open = False,
) -> None:
    from haltere.cli.run import run

    run(
        log, estimator=estimator, preset=preset, config=config, assignments=set_ or [], smooth=smooth, vehicle=vehicle, out=out, rate=rate,
        wind=wind, wind_sd=wind_sd, columns=columns, column=column, json=json, show=open_,
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
def _info(log: Log, columns: Columns = None, column: Column = None, json: Json = False) -> None:
    from haltere.cli.info import info

    info(log, json=json, columns=columns, column=column)


@app.command(
    "compare",
    short_help="A log through several estimators and peers.",
    help="Run a log through several estimators, installed peers (vqf, imufusion, ahrs) and the onboard solution; score all alike, against "
    "truth or onboard; write one table and one page.",
)
def _compare(
    log: Log,
    estimators: Annotated[
        str,
        typer.Option("--estimators", metavar="A,B,...", help="Of ours, each NAME[@PRESET][:KEY=VALUE]..., e.g. navigator:gate.gnss=3"),
    ] = "navigator,ahrs",
    peers: Annotated[str, typer.Option("--peers", metavar="P,Q,...", help="all that are installed, none, or names like vqf.VQF")] = "all",
    against: Annotated[
        str | None,
        typer.Option("--against", metavar="REF", help="truth or onboard. Default: truth, if there, else onboard.", show_default=False),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One configuration key, for all of ours. May be repeated.", show_default=False),
    ] = None,
    settle: Annotated[float, typer.Option("--settle", metavar="S", help="Seconds after the slowest start before scoring.")] = 5.0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write. Default: ./<log>.haltere-compare", show_default=False)
    ] = None,
    json: Json = False,
    open_: Open = False,
) -> None:
    from haltere.cli.compare import compare

    compare(log, estimators=estimators, peers=peers, against=against, assignments=set_ or [], settle=settle, out=out, json=json, show=open_)


calibrate = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Calibrate a sensor from a log that turns it.")
app.add_typer(calibrate, name="calibrate", short_help="Calibrate a magnetometer from a log.")


@calibrate.command(
    "magnetometer",
    short_help="Offset, matrix, load, rotation.",
    help="Fit offset, matrix, field of the motors and rotation against the IMU of a magnetometer, from a flight or turning it by hand; "
    "write parameters for haltere, PX4 and ArduPilot with their uncertainty, and a page. Refused where too few directions were seen.",
)
def _calibrate_magnetometer(
    log: Log,
    method: Annotated[str, typer.Option("--method", metavar="M", help="sampson, lg, fz or axis.")] = "sampson",
    load: Annotated[str, typer.Option("--load", metavar="L", help="auto, off, current, throttle or rotors.")] = "auto",
    stream: Annotated[str, typer.Option("--stream", metavar="S", help="Which unit, such as magnetometer.1.")] = "magnetometer",
    config: Annotated[
        Path | None, typer.Option("--config", metavar="F", help="Configuration file: units, axes, home, field.", show_default=False)
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One key, e.g. field.strength=48. May be repeated.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write. Default: ./<log>.haltere", show_default=False)
    ] = None,
    columns: Columns = None,
    column: Column = None,
    json: Json = False,
    open_: Open = False,
) -> None:
    from haltere.cli.calibrate import magnetometer

    magnetometer(
        log, method=method, load=load, stream=stream, config=config, assignments=set_ or [], out=out, columns=columns, column=column,
        json=json, show=open_,
    )  # fmt: skip


@app.command(
    "identify",
    short_help="The vehicle from its flights; --drag: in wind.",
    help="Identify a vehicle from flights with rotor speeds: forces and moments with their uncertainty, to a vehicle file, tested on "
    "flights not fitted. --drag needs no rotor speeds: the drag that the wind estimation of PX4 and ArduPilot needs (EKF2_MCOEF, "
    "EKF2_BCOEF_X/Y, EK3_DRAG_*) and haltere's own, jointly with the wind, with its uncertainty, ready to paste. Refused where the flights "
    "do not tell it.",
)
def _identify(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs or flight folders of one vehicle.", show_default=False)],
    drag: Annotated[bool, typer.Option("--drag", help="Only drag and wind.")] = False,
    preset: Annotated[str, typer.Option("--preset", metavar="P", help="Set of columns: full, rate or literal.")] = "full",
    vehicle: Annotated[
        str | None,
        typer.Option("--vehicle", metavar="F", help="Vehicle file or name whose geometry is checked and used.", show_default=False),
    ] = None,
    validate: Annotated[
        list[Path] | None,
        typer.Option("--validate", metavar="LOG", help="A flight to predict, not fitted. May be repeated.", show_default=False),
    ] = None,
    still: Annotated[
        bool | None,
        typer.Option("--still/--windy", help="Take the air for still, or fit wind. Default: by the flight.", show_default=False),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="F", help="Configuration file, as of a run.", show_default=False)
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One key, e.g. baro.temperature=293. May be repeated.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="F", help="vehicle.toml, or folder. Default: ./<log>.haltere", show_default=False),
    ] = None,
    columns: Columns = None,
    column: Column = None,
    json: Json = False,
    open_: Open = False,
) -> None:
    from haltere.cli import identify

    if drag:
        identify.drag(logs, config=config, assignments=set_ or [], out=out, columns=columns, column=column, json=json, show=open_)
        return
    identify.vehicle(
        logs, preset=preset, vehicle=vehicle, validate=validate or [], still=still, config=config, assignments=set_ or [], out=out,
        columns=columns, column=column, json=json, show=open_,
    )  # fmt: skip


@app.command(
    "simulate",
    short_help="A simulated flight with truth.",
    help="Simulate a flight and write it as a flight folder with truth. SCENARIO is a built-in name (hover, climb, box, figure-eight, "
    "lissajous, identify, tour, demo, gusty, real-parts) or a TOML file.",
)
def _simulate(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="Name or TOML file.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The folder to write.", show_default=False)],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change one key, e.g. wind.n=6 or seed=3. May be repeated.", show_default=False),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="WORD", help="A fault, e.g. gyro.x:bias=3deg/s@60. May be repeated.", show_default=False),
    ] = None,
    json: Json = False,
) -> None:
    from haltere.cli.simulate import simulate

    simulate(scenario, out, assignments=set_ or [], faults=fault or [], json=json)


@app.command(
    "inject",
    short_help="Put faults into a flight.",
    help="Put faults into a real or simulated flight, exact in time and size, and write it as a flight folder that names them.",
)
def _inject(
    log: Log,
    faults: Annotated[
        list[str],
        typer.Argument(
            metavar="FAULT...", help="SENSOR[.UNIT][.AXIS]:KIND[=SIZE]@START[-END], e.g. gnss:dropout@100-130", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The folder to write.", show_default=False)],
    json: Json = False,
) -> None:
    from haltere.cli.inject import inject

    inject(log, faults, out, json=json)


@app.command(
    "campaign",
    short_help="Many runs from a specification.",
    help="Make many runs from a TOML specification: a grid, a sample or cases of scenario and configuration keys, faults and seeds, or a "
    "folder of logs; write tables, verdicts and a page. What is interrupted goes on where it was when called again.",
)
def _campaign(
    specification: Annotated[Path, typer.Argument(metavar="SPEC", help="A TOML file.", show_default=False)],
    workers: Annotated[
        int | None, typer.Option("--workers", metavar="N", help="Processes. Default: one a core.", show_default=False)
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="A Dask scheduler, such as tcp://10.0.0.1:8786.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write. Default: ./<name>.campaign", show_default=False)
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 where a requirement is not met.")] = False,
    json: Json = False,
    open_: Open = False,
) -> None:
    from haltere.cli.campaign import campaign

    campaign(specification, out, workers=workers, scheduler=scheduler, strict=strict, json=json, show=open_)


@app.command(
    "convert", short_help="Any log to a flight folder.", help="Write a log as a flight folder: one table a sensor, SI units, NED and FRD."
)
def _convert(
    log: Log,
    out: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to write.", show_default=False)],
    csv: Annotated[bool, typer.Option("--csv", help="Tables as CSV instead of Parquet.")] = False,
    columns: Columns = None,
    column: Column = None,
    json: Json = False,
) -> None:
    from haltere.cli.convert import convert

    convert(log, out, csv=csv, json=json, columns=columns, column=column)


def main() -> None:
    """Run the command line. What a user can put right is one line on stderr, with the error's exit status."""
    try:
        app()
    except HaltereError as error:
        print(f"haltere: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:  # outside a verb, while the command line itself is read
        sys.exit(130)
