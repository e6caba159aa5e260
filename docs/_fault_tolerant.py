"""Experiment of ``fault-tolerant``: verdicts on faults, false alarms, and navigation without what was isolated, on simulated flights.

``python docs/_fault_tolerant.py --out docs/_data/fault_tolerant.json`` makes the tables of the page. The vehicle's model is identified on
three flights (seeds 901 to 903) that nothing else is made of; levels of the detection filters were set on seeds 7001 to 7008; faults are
put into flights of seeds from 50000, navigation is scored on seeds from 51000, false alarms on seeds from 60000.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import haltere
from haltere.flight.log import FlightLog
from haltere.flight.vehicle import Vehicle, load_vehicle
from haltere.identify.vehicle import identify_vehicle
from haltere.metrics.detection import poisson_interval
from haltere.simulate import Scenario, simulate

SENSORS = {"imu": {"rate": 500.0}, "rotors": {"rate": 100.0}}
WINDS: dict[str, dict[str, float]] = {"still": {}, "steady": {"n": 4.0, "e": 2.0}, "gusts": {"n": 4.0, "e": 2.0, "gust": 0.8}}
START = 25.0
#: Fault, and what may be said of it: theory.md §5.5 as amended has the second set not isolable at one heading.
FAULTS: dict[str, tuple[str, tuple[tuple[str, ...], ...]]] = {
    "gyro.x": ("gyro.x:bias=3deg/s", (("gyro.x",),)),
    "gyro.y": ("gyro.y:bias=3deg/s", (("gyro.y",),)),
    "gyro.z": ("gyro.z:bias=6deg/s", (("gyro.z",),)),
    "accel.x": ("accel.x:bias=0.8m/s2", (("accel.x",),)),
    "accel.y": ("accel.y:bias=0.8m/s2", (("accel.y",),)),
    "accel.z": ("accel.z:bias=0.8m/s2", (("accel.z",),)),
    "model.hx": ("model.hx:bias=0.8m/s2", (("model.hx",), ("model.hx", "wind"))),
    "model.hy": ("model.hy:bias=0.8m/s2", (("model.hy",), ("model.hy", "wind"))),
    "model.t": ("model.t:bias=0.8m/s2", (("model.t",),)),
    "model.r": ("model.r:bias=3rad/s2", (("model.r",),)),
    "model.p": ("model.p:bias=3rad/s2", (("model.p",),)),
    "model.q": ("model.q:bias=1.5rad/s2", (("model.q",),)),
    "magnetometer": ("magnetometer:disturb=0.35", (("magnetometer",),)),
    "gnss": ("gnss.n:bias=1.5m/s", (("gnss.velocity",), ("gnss.n",))),
    "barometer": ("barometer:bias=3m", (("barometer",),)),
    "rotor": ("rotor.2:thrust=0.85", (("rotor",),)),
    "wind": ("wind.n:step=4m/s", (("wind",), ("model.hx", "wind"), ("model.hy", "wind"))),
}
#: Left out, as theory.md §5.8 has it.
WITHOUT: dict[str, dict[str, str]] = {
    "none": {},
    "accel xyz": {"exclude.accel": "xyz@20-80"},
    "gyro z": {"exclude.gyro": "z@20-80"},
    "gyro x": {"exclude.gyro": "x@20-80"},
    "gyro xyz": {"exclude.gyro": "xyz@20-80"},
    "whole IMU": {"exclude.gyro": "xyz@20-80", "exclude.accel": "xyz@20-80"},
}
VERDICTS = ("bias", "suspect", "step")
#: The IMU of the truth table (caption of theory.md §5.5): 0.005 rad/s and 0.15 m/s² a sample at 100 Hz, and no bias.
QUIET = {**SENSORS, "imu": {"rate": 500.0, "gyro_noise": 5e-4, "accel_noise": 0.015, "gyro_turn_on": 0.0, "accel_turn_on": 0.0}}
TOLD = {"noise.gyro": 5e-4, "noise.accel": 0.015}
#: A fault that grows, what is left out from 35 s on.
RAMPS = {
    "accel.x, 0.1 m/s² a second": ("accel.x:ramp=0.1m/s2/s@25", {"exclude.accel": "x@35-60"}),
    "gyro.x, 0.2 °/s a second": ("gyro.x:ramp=0.2deg/s/s@25", {"exclude.gyro": "x@35-60"}),
    "gyro.z, 0.3 °/s a second": ("gyro.z:ramp=0.3deg/s/s@25", {"exclude.gyro": "z@35-60"}),
}


def flight(
    seed: int, mission: str, wind: str, duration: float, fault: tuple[str, ...] = (), scale: float = 0.6, quiet: bool = False
) -> FlightLog:
    """A simulated flight of the Hummingbird with rotor speeds."""
    sensors = QUIET if quiet else SENSORS
    return simulate(Scenario(mission=mission, duration=duration, seed=seed, wind=WINDS[wind], fault=fault, scale=scale, sensors=sensors))


def vehicle(quiet: bool = False) -> Vehicle:
    """What three other flights tell of it."""
    missions = ("lissajous", "box", "figure-eight")
    return identify_vehicle([flight(901 + k, m, "still", 90.0, scale=1.0, quiet=quiet) for k, m in enumerate(missions)]).as_vehicle()


def verdict(log: FlightLog, of: Vehicle, preset: str, told: dict[str, Any] | None = None) -> dict[str, Any]:
    """The first verdict after the fault, and whether there was one before."""
    s = haltere.run(log, "fault-tolerant", preset=preset, set=told or {}, vehicle=of, scored=False)
    events = [e for e in s.events if e["kind"] in VERDICTS]
    later = [e for e in events if e["t_onset"] > START - 1.0]
    out: dict[str, Any] = {"before": len(events) - len(later), "said": None, "detected": None, "isolated": None}
    if later:
        e = later[0]
        out |= {"said": sorted(e["candidates"]), "detected": e["t_detected"] - START}
        if e["t_isolated"] is not None:
            out["isolated"] = e["t_isolated"] - START
    return out


def verdicts(of: Vehicle, preset: str, wind: str, missions: tuple[str, ...], seeds: int, quiet: bool = False) -> dict[str, Any]:
    """Table of all faults."""
    rows: dict[str, Any] = {}
    for mission in missions:
        for name, (word, right) in FAULTS.items():
            said: dict[str, int] = {}
            good, before, detected, isolated = 0, 0, [], []
            for k in range(seeds):
                log = flight(50000 + k, mission, wind, 45.0, (f"{word}@{START:g}",), quiet=quiet)
                v = verdict(log, of, preset, TOLD if quiet else None)
                key = "nothing" if v["said"] is None else " ".join(v["said"]) or "no signature"
                said[key] = said.get(key, 0) + 1
                good += v["said"] is not None and tuple(v["said"]) in right
                before += v["before"] > 0
                detected += [v["detected"]] if v["detected"] is not None else []
                isolated += [v["isolated"]] if v["isolated"] is not None else []
            rows[f"{mission}: {name}"] = {
                "flights": seeds, "right": good, "said": said, "alarms_before": before,
                "detected": float(np.median(detected)) if detected else None, "isolated": float(np.median(isolated)) if isolated else None,
            }  # fmt: skip
            print(preset, wind, mission, name, rows[f"{mission}: {name}"], flush=True)
    return rows


def errors(
    log: FlightLog, of: Vehicle, without: dict[str, str], begin: float = 25.0, end: float = 80.0
) -> tuple[float, float, float, float]:
    """RMS tilt, largest tilt, RMS yaw [deg] and RMS velocity, all axes [m/s], from 25 s to 80 s."""
    s = haltere.run(log, "fault-tolerant", set={"fault_tolerant.isolate": "off", **without}, vehicle=of, scored=False)
    truth, use = log["truth"], (s.t >= begin) & (s.t <= end)
    k = np.searchsorted(truth.t, s.t[use]).clip(0, len(truth.t) - 1)
    a, b = s.vector("q", "wxyz")[use], np.column_stack([truth[f"q_{c}"] for c in "wxyz"])[k]
    down = [np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]) for w, x, y, z in (a.T, b.T)]
    yaw = [np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z) for w, x, y, z in (a.T, b.T)]
    tilt = np.degrees(np.arccos(np.clip((down[0] * down[1]).sum(axis=1), -1.0, 1.0)))
    turn = np.degrees(np.angle(np.exp(1j * (yaw[0] - yaw[1]))))
    v = s.vector("vel", "ned")[use] - truth.vector("vel", "ned")[k]
    return (
        float(np.sqrt(np.mean(tilt**2))), float(tilt.max()), float(np.sqrt(np.mean(turn**2))), float(np.sqrt((v**2).sum(axis=1).mean())),
    )  # fmt: skip


def navigation(of: Vehicle, seeds: int) -> dict[str, Any]:
    """Medians over seeds of `errors`."""
    rows: dict[str, Any] = {}
    for wind in WINDS:
        logs = [flight(51000 + k, "lissajous", wind, 90.0) for k in range(seeds)]
        for name, without in WITHOUT.items():
            e = np.array([errors(log, of, without) for log in logs])
            rows[f"{wind}: {name}"] = {"flights": seeds, "median": np.median(e, axis=0).tolist(), "worst": e.max(axis=0).tolist()}
            print(wind, name, np.round(np.median(e, axis=0), 2), flush=True)
    return rows


def contained(of: Vehicle, seeds: int) -> dict[str, Any]:
    """Tilt and heading [deg] in the second after a fault that grew for ten is left out, with and without resets: medians."""
    rows: dict[str, Any] = {}
    for name, (word, without) in RAMPS.items():
        for reset in ("fusion", "none"):
            keys = {"fault_tolerant.reset": reset, "diagnosis.inertial": "off", **without}
            e = [errors(flight(51000 + k, "lissajous", "still", 60.0, (word,)), of, keys, 35.1, 36.1) for k in range(seeds)]
            m = np.median(np.array(e), axis=0)
            rows[f"{name}: {reset}"] = {"flights": seeds, "tilt": float(m[0]), "heading": float(m[2])}
            print(name, reset, rows[f"{name}: {reset}"], flush=True)
    return rows


def false_alarms(of: Vehicle, flights: int) -> dict[str, Any]:
    """Verdicts in flights without a fault, by wind, and hours in the air."""
    out: dict[str, Any] = {}
    missions = ("hover", "box", "figure-eight", "lissajous", "tour")
    for wind in ("still", "gusts"):
        n, hours, said = 0, 0.0, []
        for k in range(flights):
            s = haltere.run(flight(60000 + k, missions[k % 5], wind, 90.0), "fault-tolerant", vehicle=of, scored=False)
            found = [e for e in s.events if e["kind"] in VERDICTS]
            n += len(found)
            said += [f"{missions[k % 5]} {60000 + k}: {' '.join(e['candidates'])}" for e in found]
            hours += float(s.t[-1] - s.t[0]) / 3600.0
        low, high = poisson_interval(n, hours)
        out[wind] = {"alarms": n, "hours": hours, "per_hour": [n / hours, low, high], "said": said}
        print(wind, out[wind], flush=True)
    return out


def main() -> None:
    """Make the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--flights", type=int, default=20, help="for navigation")
    parser.add_argument("--clean", type=int, default=100, help="flights without a fault, in each wind")
    parser.add_argument("--out", type=Path, required=True)
    a = parser.parse_args()
    kept = a.out.with_name("hummingbird_identified.toml")
    if not kept.exists():
        kept.write_text(
            "# Made by vehicle() of docs/_fault_tolerant.py, on three simulated flights.\n" + vehicle().to_toml(), encoding="utf-8"
        )
    of = load_vehicle(kept)
    kept = a.out.with_name("hummingbird_quiet.toml")
    if not kept.exists():
        kept.write_text(
            "# Made by vehicle(quiet=True) of docs/_fault_tolerant.py, on three simulated flights with the IMU of theory.md §5.5.\n"
            + vehicle(quiet=True).to_toml(),
            encoding="utf-8",
        )
    quiet = load_vehicle(kept)
    out: dict[str, Any] = {}
    for name, part in {
        "navigation": lambda: navigation(of, a.flights),
        "default, still air": lambda: verdicts(of, "default", "still", ("hover", "box"), a.seeds),
        "default, gusts": lambda: verdicts(of, "default", "gusts", ("box",), a.seeds),
        "as-corrected, still air": lambda: verdicts(quiet, "as-corrected", "still", ("lissajous",), a.seeds, quiet=True),
        "resets": lambda: contained(of, a.seeds),
        "false alarms": lambda: false_alarms(of, a.clean),
    }.items():
        out[name] = part()
        a.out.write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
