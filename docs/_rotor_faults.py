"""Test bench of a vehicle's model beside the IMU: faults of model, rotor and tachometer, steps of the wind, false alarms, axes left out.

``python docs/_rotor_faults.py --seeds 20 --hours 5 --out docs/_data/rotor_faults.json`` makes the tables. The vehicle file is identified
on four simulated flights (seeds from 90011), geometry not given. Faults last and begin at one of seven phases of a 0.25 s grid after 24 s.
Seeds of the tables: faults from 70000, flights without from 72000, axes left out from 74000; of the faults, three were looked at before.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import haltere
from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.flight.vehicle import Vehicle
from haltere.identify.vehicle import identify_vehicle
from haltere.metrics.detection import alarms, detections, poisson_interval
from haltere.simulate import Scenario, simulate

FULL = (
    "model.hx:bias=0.8m/s2", "model.hy:bias=0.8m/s2", "model.t:bias=0.8m/s2", "model.r:bias=3rad/s2", "model.p:bias=3rad/s2",
    "model.q:bias=1.5rad/s2", "rotor.2:thrust=0.85", "rotors.1:scale=1.04", "wind.n:step=4m/s", "gyro.x:bias=20deg/s",
)  # fmt: skip
HALF = (
    "model.hx:bias=0.4m/s2", "model.hy:bias=0.4m/s2", "model.t:bias=0.4m/s2", "model.r:bias=1.5rad/s2", "model.p:bias=1.5rad/s2",
    "model.q:bias=0.75rad/s2", "rotor.2:thrust=0.925", "rotors.1:scale=1.02",
)  # fmt: skip
WINDS: dict[str, dict[str, float]] = {"still": {}, "gusts": {"n": 5.2, "e": 3.0, "gust": 1.2}}
STEADY, GUSTY = {"n": 4.0, "e": 2.0}, {"n": 4.0, "e": 2.0, "gust": 0.8}
#: Missions and their scale: a lissajous of 4 to 5 m/s.
MISSIONS = {"hover": 1.0, "lissajous": 0.55, "box": 1.0}
SENSORS = {"rotors": {"rate": 250.0}}
LEFT_OUT: dict[str, dict[str, str]] = {
    "none": {}, "acc xyz": {"exclude.accel": "xyz@25-85"}, "gyro z": {"exclude.gyro": "z@25-85"}, "gyro x": {"exclude.gyro": "x@25-85"},
    "all gyros": {"exclude.gyro": "xyz@25-85"}, "whole IMU": {"exclude.gyro": "xyz@25-85", "exclude.accel": "xyz@25-85"},
}  # fmt: skip
ON = {"diagnosis.inertial": "on"}


def vehicle() -> Vehicle:
    """The vehicle file, from flights that nothing else here uses."""
    flown = (("lissajous", 0.6, 2.0, -1.5), ("box", 1.0, -3.0, 1.0), ("tour", 1.0, 1.0, 2.0), ("figure-eight", 1.0, -1.0, -2.0))
    return identify_vehicle([
        simulate(Scenario(mission=m, scale=k, duration=120.0, seed=90011 + i, sensors=SENSORS, wind={"n": n, "e": e, "gust": 0.4}))
        for i, (m, k, n, e) in enumerate(flown)
    ]).as_vehicle()  # fmt: skip


def table(
    of: Vehicle, words: tuple[str, ...], seeds: int, missions: dict[str, float], winds: dict[str, dict[str, float]]
) -> list[dict[str, Any]]:
    """Every fault, by mission and wind: what was named, and when."""
    rows = []
    for mission, scale in missions.items():
        for wind, air in winds.items():
            for word in words:
                outcomes, told, false = [], [], 0
                for seed in range(70000, 70000 + seeds):
                    on = 24.0 + 0.37 * (seed % 7)
                    flight = simulate(Scenario(mission=mission, scale=scale, duration=on + 12.0, seed=seed, wind=air, sensors=SENSORS,
                                               fault=(f"{word}@{on:g}",), landing=False))  # fmt: skip
                    solution = haltere.run(flight, vehicle=of, set=ON, scored=False)
                    d = detections(solution.events, flight.meta.faults[-1:], float(solution.t[0]), float(solution.t[-1]))
                    outcomes.append(d.outcomes[0])
                    told.append(" ".join(d.outcomes[0].named) or "-")
                    false += len(d.false_alarms)
                delays = [o.delay for o in outcomes if math.isfinite(o.delay)]
                named = [o.isolation_delay for o in outcomes if math.isfinite(o.isolation_delay)]
                rows.append({
                    "fault": word, "mission": mission, "wind": wind, "n": seeds,
                    "right": sum(o.isolation == "right" for o in outcomes),
                    "containing": sum(o.isolation == "containing" for o in outcomes),
                    "wrong": sum(o.isolation == "wrong" for o in outcomes), "missed": sum(not o.detected for o in outcomes),
                    "seen_median": round(float(np.median(delays)), 2) if delays else None,
                    "seen_97": round(float(np.quantile(delays, 0.97)), 2) if delays else None,
                    "named_median": round(float(np.median(named)), 2) if named else None, "before": false,
                    "named": {w: told.count(w) for w in sorted(set(told))},
                })  # fmt: skip
                print(json.dumps(rows[-1]), flush=True)
    return rows


def false_alarms(of: Vehicle, hours: float) -> dict[str, Any]:
    """Alarms in two-minute flights without a fault, with take-off and landing, half of them in gusts."""
    missions = {**MISSIONS, "tour": 1.0, "figure-eight": 1.0}
    found, flown, i = [], 0.0, 0
    while flown < hours * 3600.0:
        mission, wind = list(missions)[i % 5], list(WINDS)[(i // 5) % 2]
        scenario = Scenario(mission=mission, scale=missions[mission], duration=120.0, seed=72000 + i, wind=WINDS[wind], sensors=SENSORS)
        solution = haltere.run(simulate(scenario), vehicle=of, set=ON, scored=False)
        for e in alarms(solution.events):
            found.append(
                {
                    "mission": mission,
                    "wind": wind,
                    "seed": 72000 + i,
                    **{k: e[k] for k in ("sensor", "axis", "kind", "t_detected", "candidates", "evidence")},
                }
            )
            print(json.dumps(found[-1]), flush=True)
        flown += float(solution.t[-1] - solution.t[0])
        i += 1
    low, high = poisson_interval(len(found), flown / 3600.0)
    return {"hours": round(flown / 3600.0, 2), "flights": i, "alarms": found, "interval": [low, high]}


def errors(solution: Solution, flight: FlightLog, begin: float, end: float) -> dict[str, float]:
    """Tilt [deg] RMS and largest, yaw [deg], velocity [m/s] RMS, against truth."""
    truth, k = flight["truth"], (solution.t > begin) & (solution.t < end)
    t = solution.t[k]
    q = np.array([solution.table[f"q_{c}"][k] for c in "wxyz"])
    r = np.array([np.interp(t, truth.t, truth[f"q_{c}"]) for c in "wxyz"])
    r /= np.linalg.norm(r, axis=0)

    def down(a: Any) -> Any:
        return np.array([2 * (a[1] * a[3] - a[0] * a[2]), 2 * (a[2] * a[3] + a[0] * a[1]), a[0] ** 2 - a[1] ** 2 - a[2] ** 2 + a[3] ** 2])

    def yaw(a: Any) -> Any:
        return np.arctan2(2 * (a[1] * a[2] + a[0] * a[3]), a[0] ** 2 + a[1] ** 2 - a[2] ** 2 - a[3] ** 2)

    tilt = np.degrees(np.arccos(np.clip(np.sum(down(q) * down(r), axis=0), -1.0, 1.0)))
    turned = np.degrees((yaw(q) - yaw(r) + np.pi) % (2 * np.pi) - np.pi)
    v = np.array([solution.table[f"vel_{c}"][k] - np.interp(t, truth.t, truth[f"vel_{c}"]) for c in "ned"])
    rms = [float(np.sqrt(np.mean(x**2))) for x in (tilt, turned, v)]
    return {"tilt": rms[0], "largest": float(tilt.max()), "yaw": rms[1], "velocity": rms[2]}


def left_out(of: Vehicle, seeds: int) -> list[dict[str, Any]]:
    """Navigation for a minute with axes left out, in steady wind and in gusts; noise told, as theory.md §5.8 takes it for known."""
    rows = []
    for mission in ("lissajous", "box"):
        for wind, air in (("steady", STEADY), ("gusts", GUSTY)):
            flights = [
                simulate(Scenario(mission=mission, scale=MISSIONS[mission], duration=85.0, seed=74000 + i, wind=air, sensors=SENSORS,
                                  landing=False, tell_noise=True))
                for i in range(seeds)
            ]  # fmt: skip
            for name, keys in LEFT_OUT.items():
                e = [errors(haltere.run(f, vehicle=of, set=keys, scored=False), f, 25.0, 85.0) for f in flights]
                row: dict[str, Any] = {"mission": mission, "wind": wind, "left_out": name, "n": seeds}
                for key in e[0]:
                    values = [x[key] for x in e]
                    row[key] = [round(float(np.median(values)), 3), round(float(min(values)), 3), round(float(max(values)), 3)]
                rows.append(row)
                print(json.dumps(row), flush=True)
    return rows


def speed(of: Vehicle) -> dict[str, float]:
    """IMU samples a second at 500 Hz on one core: the better of three, with diagnosis of inertial faults off and on."""
    flight = simulate(Scenario(mission="box", duration=240.0, seed=5, sensors={"imu": {"rate": 500.0}, **SENSORS}))
    out = {}
    for name, keys in (("model", {"diagnosis.inertial": "off"}), ("model and bank", ON), ("whole IMU left out", LEFT_OUT["whole IMU"])):
        best = 1e9
        for _ in range(4):
            began = time.perf_counter()
            best = min(
                best,
                float(haltere.run(flight, vehicle=of, set=keys, scored=False).summary["timings"]["filter_s"]),
                time.perf_counter() - began,
            )
        out[name] = round(len(flight["imu"]) / best)
    print(out, flush=True)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", default="speed,left_out,full,half,gusts,false_alarms")
    a = parser.parse_args()
    warnings.simplefilter("ignore")
    of, out = vehicle(), {}
    still = {"still": WINDS["still"]}
    for part in a.only.split(","):
        if part == "speed":
            out[part] = speed(of)
        elif part == "left_out":
            out[part] = left_out(of, a.seeds)
        elif part == "false_alarms":
            out[part] = false_alarms(of, a.hours)
        else:
            out[part] = table(
                of, HALF if part == "half" else FULL, a.seeds, MISSIONS, {"gusts": WINDS["gusts"]} if part == "gusts" else still
            )
        if a.out:
            a.out.write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
