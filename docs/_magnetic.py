"""The experiment of the two-stage filter rebuilt in simulation: disturbed magnetometers, and what filters make of them.

``python docs/_magnetic.py --seeds 100 --out docs/_data/two_stage.json`` makes the table of the page on it, and
``python docs/_magnetic.py --real .../ansfl_qdr/StraightLine/RAW --out docs/_data/two_stage_qdr.json`` that of a real flight; the page
shows them and runs one flight. Conditions are those of theory.md §4.8: dip 60 degrees, magnetometer noise 1.5 % of the field, 50 s,
errors from 15 s on.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import haltere
from haltere.flight.field import earth_field
from haltere.flight.log import FlightLog, Home, Stream
from haltere.metrics.attitude import euler, slerp, tilt_between
from haltere.simulate.truth import rotate_to_body

Array = NDArray[np.float64]

#: Where the dip is 60 degrees; length, rates [Hz], noise over the field, and the time from which errors count [s].
HOME, DURATION, RATE, NOISE, SETTLED = Home(43.82, 8.2, 100.0), 50.0, 100.0, 0.015, 15.0
#: The window of the source, samples 2000 to 3000 at 100 Hz [s].
START, END = 20.0, 30.0

#: A plain filter with three axes: no test of the magnetometer, and nothing else that the source lacks.
PLAIN = {
    "aid.magnetometer": "3-axis", "gate.magnetometer": 1e6, "field.tolerance_strength": 1e3, "field.tolerance_dip": 7.0,
    "aid.compass_watch": "off", "aid.motor_field": "off", "robust.innovation": 1e6, "noise.field": 0.0,
    "aid.barometer": "off", "baro.offset": "off", "aid.zero_velocity": "off", "aid.zero_rate": "off", "aid.yaw_bank": "off",
}  # fmt: skip
#: Columns: title, estimator, preset, keys.
FILTERS: list[tuple[str, str, str, dict[str, Any]]] = [
    ("three-axis EKF, no test", "navigator", "default", PLAIN),
    ("two-stage, no test", "two-stage", "as-corrected", {"two_stage.robust": "off"}),
    ("two-stage + IGG(F) (`as-corrected`)", "two-stage", "as-corrected", {}),
    (
        "two-stage + IGG(F) + innovation",
        "two-stage",
        "as-corrected",
        {"two_stage.innovation": "on", "two_stage.radial": 0.05, "gate.magnetometer": 6.0},
    ),
    ("two-stage `default`", "two-stage", "default", {}),
    ("heading only, all tests (`navigator`)", "navigator", "default", {}),
]


def scenario(mission: str, seed: int) -> haltere.Scenario:
    """A flight in a light wind: hover, or a lissajous figure at up to 4 m/s."""
    field = earth_field(HOME.lat, HOME.lon, HOME.alt, 2026.41)
    return haltere.Scenario(
        name=mission, mission=mission, duration=DURATION, seed=seed, scale=0.5 if mission == "lissajous" else 1.0, home=HOME, landing=False,
        wind={"n": 2.0, "e": 1.0, "gust": 0.4}, tell_noise=True,
        sensors={
            "imu": {"rate": RATE}, "magnetometer": {"rate": RATE, "noise": NOISE * field.strength}, "gnss": {"rate": 5.0},
            "rotors": {"rate": 0.0}, "power": {"rate": 0.0},
        },
    )  # fmt: skip


def sine(t: Array, seed: int, field: Array) -> tuple[Array, bool]:
    """0.3 of the field along an axis of the body drawn for the flight, one period in the window."""
    axis = np.random.default_rng([seed, 11]).standard_normal(3)
    wave = np.where((t >= START) & (t < END), np.sin(2.0 * np.pi * (t - START) / (END - START)), 0.0)
    return 0.3 * float(np.linalg.norm(field)) * wave[:, None] * axis / np.linalg.norm(axis), True


def east(t: Array, seed: int, field: Array) -> tuple[Array, bool]:
    """A quarter of the field towards magnetic east in the window."""
    on = np.where((t >= START) & (t < END), 0.25, 0.0)
    return float(np.linalg.norm(field)) * on[:, None] * _east(field), False


def ramp(t: Array, seed: int, field: Array) -> tuple[Array, bool]:
    """Growing for 25 s to 0.4 of the field towards magnetic east, and staying."""
    on = 0.4 * np.clip((t - START) / 25.0, 0.0, 1.0)
    return float(np.linalg.norm(field)) * on[:, None] * _east(field), False


def _east(field: Array) -> Array:
    e = np.array([-field[1], field[0], 0.0])
    return np.asarray(e / np.linalg.norm(e))


#: Rows: title, mission, disturbance of the field, in the body's axes or NED.
CASES: list[tuple[str, str, Callable[[Array, int, Array], tuple[Array, bool]] | None]] = [
    ("hover, clean", "hover", None),
    ("hover, 0.3 sine, 10 s", "hover", sine),
    ("hover, 0.25 east, 10 s", "hover", east),
    ("hover, ramp to 0.4 in 25 s", "hover", ramp),
    ("lissajous 4 m/s, 0.3 sine, 10 s", "lissajous", sine),
]


def disturbed(flight: FlightLog, disturbance: Callable[[Array, int, Array], tuple[Array, bool]] | None, seed: int) -> FlightLog:
    """The flight with something added to its magnetometer, and a note of it."""
    if disturbance is None:
        return flight
    mag, truth = flight["magnetometer"], flight["truth"]
    field = _field_n()
    added, in_body = disturbance(mag.t, seed, field)
    if not in_body:
        q = slerp(mag.t, truth.t, truth.vector("q", "wxyz"))
        added = rotate_to_body(q, added)
    columns = {**mag.columns, **{f"mag_{a}": mag[f"mag_{a}"] + added[:, k] for k, a in enumerate("xyz")}}
    name = (disturbance.__doc__ or "").rstrip(".")
    return FlightLog(
        {**flight.streams, "magnetometer": Stream(columns)}, flight.meta, [*flight.notes, f"added to the magnetometer: {name}"]
    )


def _field_n() -> Array:
    f = earth_field(HOME.lat, HOME.lon, HOME.alt, 2026.41)
    return f.strength * np.array([np.cos(f.dip) * np.cos(f.declination), np.cos(f.dip) * np.sin(f.declination), np.sin(f.dip)])


def errors(solution: haltere.Solution, flight: FlightLog) -> tuple[Array, Array, Array]:
    """Times, tilt error and yaw error [deg] from `SETTLED` on."""
    t = solution.t[solution.t >= SETTLED]
    q = solution.vector("q", "wxyz")[solution.t >= SETTLED]
    true = slerp(t, flight["truth"].t, flight["truth"].vector("q", "wxyz"))
    yaw = euler(q)[:, 2] - euler(true)[:, 2]
    return t, np.degrees(tilt_between(q, true)), np.degrees((yaw + np.pi) % (2.0 * np.pi) - np.pi)


def measure(seeds: range, told: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Errors of every filter in every case.

    Returns
    -------
    dict
        ``rows``: case and filter, RMS over all flights of tilt and yaw error, and of their largest values in a flight the median and the
        largest [deg].
    """
    kept: dict[tuple[int, int], list[tuple[float, float, float, float]]] = {}
    for seed in seeds:
        flights = {mission: haltere.simulate(scenario(mission, seed)) for mission in ("hover", "lissajous")}
        for i, (_, mission, disturbance) in enumerate(CASES):
            flight = disturbed(flights[mission], disturbance, seed)
            for j, (_, estimator, preset, keys) in enumerate(FILTERS):
                solution = haltere.run(flight, estimator, preset=preset, set=keys, scored=False)
                _, tilt, yaw = errors(solution, flight)
                kept.setdefault((i, j), []).append(
                    (float(np.mean(tilt**2)), float(np.mean(yaw**2)), float(tilt.max()), float(np.abs(yaw).max()))
                )
        told(f"seed {seed}")
    rows = []
    for (i, j), values in sorted(kept.items()):
        v = np.array(values)
        rows.append({
            "case": CASES[i][0], "filter": FILTERS[j][0],
            "tilt_rms": float(np.sqrt(v[:, 0].mean())), "yaw_rms": float(np.sqrt(v[:, 1].mean())),
            "tilt_max": float(np.median(v[:, 2])), "yaw_max": float(np.median(v[:, 3])), "tilt_worst": float(v[:, 2].max()),
            "yaw_worst": float(v[:, 3].max()),
        })  # fmt: skip
    return {"flights": len(seeds), "first_seed": seeds.start, "version": haltere.__version__, "rows": rows}


def table(results: Mapping[str, Any], angle: str) -> str:
    """RMS over all flights and largest error of a flight (median over flights, and the largest of all) of ``tilt`` or ``yaw`` [deg]."""
    names = [name for name, *_ in FILTERS]
    lines = ["| case | " + " | ".join(names) + " |", "|---|" + "---|" * len(names)]
    cells = {(r["case"], r["filter"]): r for r in results["rows"]}
    for case, *_ in CASES:
        row = [cells[case, name] for name in names]
        said = [f"**{r[f'{angle}_rms']:.2f}**, {r[f'{angle}_max']:.1f} ({r[f'{angle}_worst']:.0f})" for r in row]
        lines.append(f"| {case} | " + " | ".join(said) + " |")
    return "\n".join(lines)


def real(folder: Path) -> dict[str, Any]:
    """The straight lines of ANSFL QDR (see the tests' converter): RMS against the vehicle's attitude and RTK after the first minute."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    from converters import QDR_CALIBRATION, ansfl_qdr
    from haltere.metrics.errors import error_series

    rows = []
    for calibrated in (True, False):
        for imu in (1, 4):
            flight = ansfl_qdr(folder, imu, calibrated=calibrated)
            begins = flight["imu"].t[0] + QDR_CALIBRATION
            for estimator, preset in REAL:
                series = error_series(haltere.run(flight, estimator, preset=preset), flight["onboard"])
                rms = {name: float(np.sqrt(np.mean(e[t > begins] ** 2))) for name, (t, e) in series.items()}
                rows.append({
                    "magnetometer": "calibrated" if calibrated else "as it is", "imu": f"DOT {imu}",
                    "estimator": estimator, "preset": preset,
                    **{f"{a}_deg": float(np.degrees(rms[a])) for a in ("roll", "pitch", "yaw")},
                    "vel_ne": float(np.hypot(rms["vel_n"], rms["vel_e"])), "vel_d": rms["vel_d"],
                    "pos_ne": float(np.hypot(rms["pos_n"], rms["pos_e"])), "pos_d": rms["pos_d"],
                })  # fmt: skip
    return {"version": haltere.__version__, "rows": rows}


#: What is run over the real flight.
REAL = [("two-stage", "default"), ("two-stage", "as-corrected"), ("two-stage", "as-printed"), ("navigator", "default")]


def real_table(results: Mapping[str, Any], magnetometer: str) -> str:
    """The figures of `real` with a magnetometer ``calibrated`` or ``as it is``, as a Markdown table."""
    heads = ["IMU", "estimator", "roll [deg]", "pitch [deg]", "yaw [deg]", "velocity, horizontal / down [m/s]"]
    heads += ["position, horizontal / down [m]"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for r in results["rows"]:
        if r["magnetometer"] != magnetometer:
            continue
        who = f"`{r['estimator']}`" + (f" `{r['preset']}`" if r["estimator"] != "navigator" else "")
        figures = [f"{r[k]:.2f}" for k in ("roll_deg", "pitch_deg", "yaw_deg")]
        figures += [f"{r[f'{k}_ne']:.2f} / {r[f'{k}_d']:.2f}" for k in ("vel", "pos")]
        lines.append(f"| {r['imu']} | {who} | " + " | ".join(figures) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--real", type=Path, help="folder StraightLine/RAW of ANSFL QDR: the table of the real flight instead")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.real is not None:
        results = real(given.real)
    else:
        results = measure(range(given.first, given.first + given.seeds), lambda text: print(text, file=sys.stderr))
    results["date"] = datetime.date.today().isoformat()
    results["machine"] = f"Python {platform.python_version()}, {platform.machine()}"
    try:
        results["commit"] = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True, cwd=Path(__file__).parent
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        results["commit"] = ""
    for part in ("tilt", "yaw") if given.real is None else ("calibrated", "as it is"):
        print(f"{part}\n{(table if given.real is None else real_table)(results, part)}\n")
    if given.out is not None:
        given.out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
