"""The experiment of the filter of source W rebuilt in simulation: attitude in gusty wind, as printed, as corrected, and ours.

``python docs/_wind_attitude.py --seeds 100 --out docs/_data/wind_attitude.json`` makes the tables of the page on it, and
``python docs/_wind_attitude.py --real .../umn_thor/thor_flight75.mat --out docs/_data/wind_attitude_thor.json`` that of a real flight;
the page shows them and runs one flight. Conditions are those of theory.md §3.5 with every rate and noise that it leaves open stated in
`CONDITIONS`.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import haltere
from haltere.flight.field import earth_field
from haltere.flight.log import FlightLog, Home, Stream
from haltere.metrics.attitude import conjugate, multiply, rotation_vector, slerp
from haltere.metrics.errors import error_series

Array = NDArray[np.float64]

#: Where the dip is 60 degrees; length [s], and the time from which errors count.
HOME, DURATION, SETTLED = Home(43.82, 8.2, 100.0), 60.0, 10.0
#: Mean wind [m/s] and 1 sigma of its gusts.
WIND, GUST = (4.0, 2.0), 0.8
#: Noise of gyro and accelerometer [a square root of hertz], magnetometer over the field, airspeed [m/s].
GYRO, ACCEL, MAG, AIRSPEED = 5e-4, 0.015, 0.03, 0.5
#: Bias of each gyro axis, its sign drawn [deg/s].
BIAS = (0.4, 0.5)
CONDITIONS = (
    f"{DURATION:g} s, begun in the air; errors from {SETTLED:g} s on. IMU 100 Hz, white noise {GYRO:g} rad/s and {ACCEL:g} m/s² a square "
    f"root of hertz (0.3 deg/s and 0.15 m/s² a sample), each gyro axis with a constant bias of {BIAS[0]:g} to {BIAS[1]:g} deg/s, each "
    "accelerometer axis with one of 0.1 m/s² (1 σ). "
    f"Magnetometer 10 Hz, {100 * MAG:g} % of the field, dip 60 degrees. GNSS 10 Hz, 0.15 m/s and 0.8 m. Airspeed and vanes 50 Hz, "
    f"{AIRSPEED:g} m/s and 2 degrees. Barometer 25 Hz, 0.5 m. Rotor speeds 50 Hz, 1 rad/s. Wind ({WIND[0]:g}, {WIND[1]:g}) m/s with "
    f"Dryden turbulence of {GUST:g} m/s and 60 m. The filters are told these noises; those that need a wind are given its mean, with the "
    "gusts as its error."
)

#: Flights: title, mission, size.
FLIGHTS: list[tuple[str, str, float]] = [("gentle", "figure-eight", 0.5), ("aggressive", "lissajous", 1.0)]

_TOLD = {"noise.gyro": GYRO, "noise.accel": ACCEL, "noise.airspeed": AIRSPEED}
_GIVEN = {**_TOLD, "told_wind.n": WIND[0], "told_wind.e": WIND[1], "told_wind.sd": GUST}
_OPEN = {"wind_attitude.force": 1e6, "wind_attitude.acceleration": 1e6}
#: Columns of the comparison: title, preset, keys. Below three times its noise an airspeed has no direction (amendment 11).
FILTERS: list[tuple[str, str, dict[str, Any]]] = [
    ("as-printed", "as-printed", _GIVEN),
    ("as-printed, atan2", "as-printed", {**_GIVEN, "wind_attitude.angles": "atan2"}),
    ("as-corrected", "as-corrected", _GIVEN),
    ("as-corrected, no wind rows", "as-corrected", {**_GIVEN, "aid.airdata": "off"}),
    ("default", "default", {**_TOLD, "air.airspeed_min": 3.0 * AIRSPEED}),
]
#: What the source prints or leaves out, one by one on the corrected filter: title, keys.
MISPRINTS: list[tuple[str, dict[str, Any]]] = [
    ("none", {}),
    ("rows 7-9 of (20)", {"wind_attitude.rows": "printed"}),
    ("residual (25)", {"wind_attitude.residual": "printed"}),
    ("residual (25), length alone restored", {"wind_attitude.residual": "printed", "wind_attitude.normalise": "length"}),
    ("length alone restored", {"wind_attitude.normalise": "length"}),
    ("residual (25), no length restored", {"wind_attitude.residual": "printed", "wind_attitude.normalise": "off"}),
    ("no length restored", {"wind_attitude.normalise": "off"}),
    ("arc tangents of (3)", {"wind_attitude.angles": "arctan"}),
    ("no test of what is gravity", _OPEN),
]


def scenario(mission: str, scale: float, seed: int) -> haltere.Scenario:
    """A flight in gusts, begun in the air."""
    field = earth_field(HOME.lat, HOME.lon, HOME.alt, 2026.41)
    return haltere.Scenario(
        name=mission, mission=mission, duration=DURATION, seed=seed, scale=scale, home=HOME, rest=0.0, landing=False, tell_noise=True,
        wind={"n": WIND[0], "e": WIND[1], "gust": GUST},
        sensors={
            "imu": {"rate": 100.0, "gyro_noise": GYRO, "accel_noise": ACCEL, "gyro_turn_on": 0.0, "gyro_walk": 0.0},
            "magnetometer": {"rate": 10.0, "noise": MAG * field.strength}, "airdata": {"rate": 50.0, "noise": AIRSPEED},
            "power": {"rate": 0.0},
        },
    )  # fmt: skip


def flown(mission: str, scale: float, seed: int) -> FlightLog:
    """The flight, its gyro with the bias of the experiment."""
    flight = haltere.simulate(scenario(mission, scale, seed))
    rng = np.random.default_rng([seed, 23])
    bias = np.radians(rng.choice([-1.0, 1.0], 3) * rng.uniform(*BIAS, 3))
    imu = flight["imu"]
    columns = {**imu.columns, **{f"gyro_{a}": imu[f"gyro_{a}"] + bias[k] for k, a in enumerate("xyz")}}
    note = "added to the gyro: a constant bias of 0.4 to 0.5 deg/s on each axis"
    return FlightLog({**flight.streams, "imu": Stream(columns)}, flight.meta, [*flight.notes, note])


def errors(solution: haltere.Solution, flight: FlightLog) -> tuple[Array, Array, Array]:
    """Times, attitude errors about the body's axes (n, 3) [deg] and wind errors (n, 2) [m/s] (or (n, 0)) from `SETTLED` on."""
    late, truth = solution.t >= SETTLED, flight["truth"]
    t = solution.t[late]
    true = slerp(t, truth.t, truth.vector("q", "wxyz"))
    turn = rotation_vector(multiply(conjugate(solution.vector("q", "wxyz")[late]), true))
    there = [c for c in ("wind_n", "wind_e") if c in solution]
    wind = [solution[c][late] - np.interp(t, truth.t, truth[c]) for c in there]
    return t, np.degrees(turn), np.column_stack(wind) if wind else np.empty((len(t), 0))


def measure(seeds: range, told: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Errors of every filter on every flight.

    Returns
    -------
    dict
        ``rows``: flight and filter, RMS over all flights about x, y, z [deg] and of the wind's components together [m/s], and the largest
        RMS of a flight; ``misprints`` alike; ``order``: in how many flights as-printed is worse than as-corrected, and that than default.
    """
    kept: dict[tuple[str, str, str], list[Array]] = {}
    for seed in seeds:
        for title, mission, scale in FLIGHTS:
            flight = flown(mission, scale, seed)
            runs = [("rows", *f) for f in FILTERS]
            runs += [("misprints", name, "as-corrected", {**_GIVEN, **keys}) for name, keys in MISPRINTS]
            for table, name, preset, keys in runs:
                _, turn, wind = errors(haltere.run(flight, "wind-attitude", preset=preset, set=keys, scored=False), flight)
                squares = np.r_[np.mean(turn**2, axis=0), np.mean(wind**2) if wind.shape[1] else np.nan]
                kept.setdefault((table, title, name), []).append(squares)
        told(f"seed {seed}")
    out: dict[str, Any] = {"flights": len(seeds), "first_seed": seeds.start, "version": haltere.__version__, "rows": [], "misprints": []}
    for (table, title, name), values in kept.items():
        v = np.array(values)
        mean, worst = np.sqrt(v.mean(axis=0)).tolist(), np.sqrt(v.max(axis=0)).tolist()
        row = {"flight": title, "filter": name, **dict(zip(("x", "y", "z"), mean, strict=False))}
        row |= {f"{a}_worst": w for a, w in zip("xyz", worst, strict=False)}
        out[table].append(row | ({"wind": mean[3], "wind_worst": worst[3]} if np.isfinite(mean[3]) else {}))
    names = ("as-printed", "as-corrected", "default")
    for title, *_ in FLIGHTS:
        whole = [np.sqrt(np.array(kept["rows", title, n])[:, :3].sum(axis=1)) for n in names]
        out.setdefault("order", {})[title] = int(np.count_nonzero((whole[0] > whole[1]) & (whole[1] > whole[2])))
    return out


def table(results: Mapping[str, Any], which: str = "rows") -> str:
    """RMS over all flights about the body's x, y and z, the largest of a flight in brackets [deg], and of the wind [m/s]."""
    names = [f[0] for f in (FILTERS if which == "rows" else MISPRINTS)]
    cells = {(r["flight"], r["filter"]): r for r in results[which]}
    titles = [f[0] for f in FLIGHTS]
    lines = [f"| {'filter' if which == 'rows' else 'misprint'} | " + " | ".join(titles) + " |", "|---|" + "---|" * len(titles)]
    for name in names:
        said = []
        for title in titles:
            r = cells[title, name]
            text = " / ".join(f"{r[a]:.2f}" if r[a] < 9.95 else f"{r[a]:.0f}" for a in "xyz")
            worst = " / ".join(f"{r[f'{a}_worst']:.2f}" if r[f"{a}_worst"] < 9.95 else f"{r[f'{a}_worst']:.0f}" for a in "xyz")
            wind = f"; wind {r['wind']:.2f} ({r['wind_worst']:.2f}) m/s" if "wind" in r else ""
            said.append(f"**{text}** ({worst}){wind}")
        lines.append(f"| {name} | " + " | ".join(said) + " |")
    return "\n".join(lines)


def real(path: Path) -> dict[str, Any]:
    """UMN Thor, flight 75 (see the tests' converter): RMS against the aircraft's own filter while it flies.

    There is no station: the wind that the published filter is given is the median of what ``default`` finds over that time.
    """
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    from converters_air import umn_thor

    flight = umn_thor(path, magnetometer=True)
    air = flight["airdata"]
    fast = air.t[np.isfinite(air["airspeed"]) & (air["airspeed"] > 8.0)]
    begins, ends = float(fast[0]) + 30.0, float(fast[-1]) - 10.0
    ours = haltere.run(flight, "wind-attitude", scored=False)
    inside = (ours.t > begins) & (ours.t < ends)
    n, e = (float(np.median(ours[c][inside])) for c in ("wind_n", "wind_e"))
    given = {"told_wind.n": n, "told_wind.e": e}
    rows = []
    for name, preset, keys in (
        ("as-printed", "as-printed", given), ("as-printed, atan2", "as-printed", {**given, "wind_attitude.angles": "atan2"}),
        ("as-corrected", "as-corrected", given),
        ("as-corrected, told of no wind", "as-corrected", {"told_wind.n": 0.0, "told_wind.e": 0.0}),
        ("as-corrected, no wind rows", "as-corrected", {"aid.airdata": "off"}), ("default", "default", {}),
    ):  # fmt: skip
        series = error_series(haltere.run(flight, "wind-attitude", preset=preset, set=keys, scored=False), flight["onboard"])
        rms = {k: float(np.degrees(np.sqrt(np.mean(x[(t > begins) & (t < ends)] ** 2)))) for k, (t, x) in series.items()}
        rows.append({"filter": name, **{k: rms[k] for k in ("roll", "pitch", "yaw", "tilt")}})
    return {"version": haltere.__version__, "begins": begins, "ends": ends, "wind": [n, e], "rows": rows}


def real_table(results: Mapping[str, Any]) -> str:
    """RMS against the aircraft's own filter [deg]."""
    lines = ["| filter | roll | pitch | yaw | tilt |", "|---|---|---|---|---|"]
    lines += [f"| {r['filter']} | {r['roll']:.1f}° | {r['pitch']:.1f}° | {r['yaw']:.1f}° | {r['tilt']:.1f}° |" for r in results["rows"]]
    return "\n".join(lines)


def main() -> None:
    """Make the tables anew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--real", type=Path)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.real is not None:
        results = real(given.real)
        print(real_table(results))
    else:
        results = measure(range(given.first, given.first + given.seeds), lambda text: print(text, flush=True))
        print(table(results), table(results, "misprints"), results["order"], sep="\n\n")
    results |= {"date": datetime.datetime.now(datetime.UTC).date().isoformat(), "machine": platform.machine()}
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
