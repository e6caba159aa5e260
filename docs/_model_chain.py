"""Test bench of J21 to J24, the chain that a vehicle's model drives: which fault each sees, after how long, and false alarms.

``python docs/_model_chain.py --seeds 61000 61008 --hours 6 --out docs/_data/model_chain.json`` makes the table of the page. Vehicle file
as in `_truth_table`; faults last, begin at one of seven phases after 22 s, and are watched for 5 s as in theory.md §5.5. So that no
verdict makes the chain begin anew, alarms of J11 to J16 are never large enough to be told of.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from _truth_table import GUSTS, MISSIONS, SENSORS, STILL, vehicle

from haltere import drive
from haltere.flight.log import FlightLog
from haltere.flight.vehicle import Vehicle
from haltere.metrics.detection import poisson_interval
from haltere.simulate import Scenario, simulate

ROWS = (
    "accel.x:bias=0.8m/s2", "accel.y:bias=0.8m/s2", "accel.z:bias=0.8m/s2", "gyro.x:bias=3deg/s", "gyro.y:bias=3deg/s",
    "gyro.z:bias=6deg/s", "magnetometer:disturb=0.165", "gnss.n:bias=1.5m/s", "barometer:bias=3m", "model.hx:bias=0.8m/s2",
    "model.hy:bias=0.8m/s2", "model.t:bias=0.8m/s2", "model.r:bias=3rad/s2", "model.p:bias=3rad/s2", "model.q:bias=1.5rad/s2",
    "rotor.2:thrust=0.85", "rotors.1:scale=1.04", "wind.n:step=4m/s",
)  # fmt: skip
FLOWN = ("hover", "lissajous", "box")
START, AFTER = 22.0, 5.0
NEVER_TOLD = {"diagnosis.moment": "50", "diagnosis.force": "50"}
NAMES = ("J21", "J22", "J23", "J24")


def chain_of(of: Vehicle, log: FlightLog, keys: Mapping[str, str]) -> Any:
    """The chain's record at the end of a flight through `navigator`."""
    model = drive.model_of(of, "navigator")
    asked = drive.request(log, "navigator", "default", None, keys)
    log = drive.correct(log, asked.values)
    blind = log.without("onboard", "truth")
    checked = drive.check(blind, upright=True, given=asked.values)
    config = drive.configure(blind, checked, "navigator", "default", asked)
    t, gyro, accel = drive.imu_arrays(blind, checked)
    m = drive.measurements(blind, checked, config)
    heard = drive.rotor_speeds(checked.streams, model, t)
    m.rotor_t, m.rotor_speed = heard.t, heard.speed
    S = drive.new_state(config, None, model)
    drive._loop(S, drive.parameters(config), t, gyro, accel, m, np.empty((drive.COVARIANCE_ROWS, len(t))), None, False)
    return S["chain"][0, 0]


def delays(of: Vehicle, seeds: range) -> dict[str, dict[str, list[float]]]:
    """Of every row: how often each detector alarmed, of how many, and the median of the delay [s]."""
    out: dict[str, dict[str, list[float]]] = {}
    for word in ROWS:
        found: dict[str, list[float]] = {n: [] for n in NAMES}
        for mission in FLOWN:
            for seed in seeds:
                on = START + 0.37 * (seed % 7)
                log = simulate(Scenario(mission=mission, scale=MISSIONS[mission], duration=on + AFTER, seed=seed, wind=STILL, landing=False,
                                        sensors=SENSORS, fault=(f"{word}@{on:g}",)))  # fmt: skip
                c = chain_of(of, log, NEVER_TOLD)
                for k, name in enumerate(NAMES):
                    if c["t_alarm"][k] >= on:
                        found[name].append(float(c["t_alarm"][k]) - on)
        n = len(FLOWN) * len(seeds)
        out[word] = {name: [len(x), n, round(float(np.median(x)), 2) if x else -1.0] for name, x in found.items()}
        print(word, out[word], flush=True)
    return out


def quiet(of: Vehicle, hours: float, begin: int) -> dict[str, Any]:
    """Flights of two minutes without a fault, half of them in gusts: those in which a detector alarmed, by its last alarm."""
    found, i = [], 0
    while i * 120.0 < hours * 3600.0:
        mission, wind = FLOWN[i % len(FLOWN)], (STILL, GUSTS)[(i // len(FLOWN)) % 2]
        log = simulate(Scenario(mission=mission, scale=MISSIONS[mission], duration=120.0, seed=begin + i, wind=wind, sensors=SENSORS))
        c = chain_of(of, log, {})
        found += [
            {"seed": begin + i, "mission": mission, "gusts": bool(wind), "detector": n}
            for k, n in enumerate(NAMES) if c["t_alarm"][k] > 0.0
        ]  # fmt: skip
        i += 1
    print(found, flush=True)
    return {"hours": round(i * 120.0 / 3600.0, 2), "alarms": found, "interval": list(poisson_interval(len(found), i * 120.0 / 3600.0))}


def table(result: Mapping[str, Any]) -> str:
    """The table of the page, as Markdown, and the line below."""
    lines = ["| fault | " + " | ".join(NAMES) + " |", "|---" * 5 + "|"]
    for word, row in result["rows"].items():
        cells = ["·" if row[n][0] == 0 else f"{row[n][0]} of {row[n][1]}, {row[n][2]:.2f} s" for n in NAMES]
        lines.append(f"| `{word}` | " + " | ".join(cells) + " |")
    q = result["quiet"]
    low, high = q["interval"]
    words = f"Without a fault: {len(q['alarms'])} alarms in {q['hours']:g} h, half of them in gusts of 1.2 m/s"
    lines += ["", f"{words} (95 %: {low:.2f} to {high:.2f} an hour). Seeds {result['seeds'][0]} to {result['seeds'][1] - 1}."]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(61000, 61002))
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--quiet-seeds", type=int, default=62400)
    parser.add_argument("--vehicle", type=Path, help="file to keep the identified vehicle in")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    warnings.simplefilter("ignore")
    of = vehicle(a.vehicle)
    result = {"seeds": list(a.seeds), "rows": delays(of, range(*a.seeds)), "quiet": quiet(of, a.hours, a.quiet_seeds)}
    if a.out:
        a.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
