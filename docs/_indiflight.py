"""Faults put into real flights of indiflight's quadrotor: what is found with one IMU, rotor speeds and a vehicle identified on two of them.

``python docs/_indiflight.py --data DIR --out docs/_data/indiflight.json``; DIR holds the recordings. Motion capture stands in for GNSS and
compass, decimated and noised (tests/converters_indiflight.py). The vehicle is identified on LOG00267 and LOG00281; the eight others
are flown with it: as they are, with five sizes of fault on each of six axes, and with one gyro axis that is not used.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import sys
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import haltere
from haltere.flight.log import FlightLog
from haltere.identify.vehicle import identify_vehicle
from haltere.metrics.detection import alarms, detections
from haltere.simulate import inject

IDENTIFIED = ("267", "281")
FLOWN = ("230", "257", "259", "262", "265", "271", "275", "340")
SIZES = {"gyro": (3, 6, 10, 20, 60), "accel": (0.5, 0.8, 1, 2, 5)}
UNITS = {"gyro": "deg/s", "accel": "m/s2"}
#: A fault begins so long after alignment, or halfway to the end of the flight where that is sooner [s]; what is after the end is left away.
AFTER, BEFORE_END = 3.0, 1.0


def flights(data: Path, names: Iterable[str], how: Any) -> dict[str, FlightLog]:
    """Recordings by number."""
    return {n: how(next((data / "indiflight").glob(f"*LOG00{n}.BFL"))) for n in names}


def in_the_air(flight: FlightLog) -> FlightLog:
    """A flight until a second before its motion capture ends: the last is a landing, or a net."""
    end = float(flight["truth"].t[-1]) - BEFORE_END
    return FlightLog({k: s.where(s.t <= end) for k, s in flight.streams.items()}, flight.meta, flight.notes)


def of(flight: FlightLog, word: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """What became of one fault: how it was named, and after how long."""
    solution = haltere.run(inject(flight, [word]), scored=False, **options)
    (o,) = detections(solution.events, [inject(flight, [word]).meta.faults[-1]], float(solution.t[0]), float(solution.t[-1])).outcomes
    return {"fault": word, "isolation": o.isolation or "missed", "named": list(o.named), "seen": o.delay, "named_after": o.isolation_delay}


def attitude_errors(flight: FlightLog, **options: Any) -> dict[str, float]:
    """Root mean square of tilt and heading against the capture [deg]."""
    e = haltere.run(flight, **options).summary["errors"]["truth"]
    return {"tilt": e["tilt_deg"]["rms"], "heading": e["heading_deg"]["rms"]}


def bench(data: Path, numbers: Iterable[str], model: Any, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Everything of the flights ``numbers``."""
    from converters_indiflight import indiflight

    rows: list[dict[str, Any]] = []
    clean: dict[str, Any] = {}
    isolated: dict[str, Any] = {}
    options = {"set": dict(extra), "vehicle": model}
    for name, whole in flights(data, numbers, indiflight).items():
        flight = in_the_air(whole)
        solution = haltere.run(flight, scored=False, **options)
        start, end = float(solution.t[0]), float(solution.t[-1])
        mine = alarms(solution.events)
        clean[name] = {"seconds": end - start, "alarms": [f"{e['sensor']}.{e['axis']} {e['kind']} {e['t_detected']:.2f}" for e in mine]}
        begin = min(start + AFTER, 0.5 * (start + end))
        print(name, json.dumps(clean[name]), flush=True)
        for sensor, sizes in SIZES.items():
            for size in sizes:
                for axis in "xyz":
                    row = of(flight, f"{sensor}.{axis}:bias={size}{UNITS[sensor]}@{begin:.3f}", options)
                    rows.append({"flight": name, "sensor": sensor, "axis": axis, "size": size, "left": end - begin, **row})
        if model is not None:
            isolated[name] = {"none": attitude_errors(flight, **options)}
            for axis in "xyz":
                keys = {**extra, "exclude.gyro": f"{axis}@{begin:.3f}-{end:.3f}"}
                isolated[name][f"gyro.{axis}"] = attitude_errors(flight, set=keys, vehicle=model)
            print(name, json.dumps(isolated[name]), flush=True)
    return {"clean": clean, "faults": rows, "isolated": isolated}


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By sensor, axis and size over the flights."""
    out = []
    for sensor, sizes in SIZES.items():
        for axis in "xyz":
            for size in sizes:
                mine = [r for r in rows if (r["sensor"], r["axis"], r["size"]) == (sensor, axis, size)]
                seen = [r["seen"] for r in mine if math.isfinite(r["seen"])]
                count = {k: sum(r["isolation"] == k for r in mine) for k in ("right", "containing", "wrong", "none", "missed")}
                out.append({"sensor": sensor, "axis": axis, "size": size, "n": len(mine), **count,
                            "seen_median": round(float(np.median(seen)), 3) if seen else None})  # fmt: skip
    return out


def table(results: Mapping[str, Any]) -> str:
    """The faults as a Markdown table: how many of the flights named them right, as a set, wrong, or not at all, and when they were seen."""
    heads = ["axis", *(f"{g} / {a}" for g, a in zip(SIZES["gyro"], SIZES["accel"], strict=True))]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for sensor in SIZES:
        for axis in "xyz":
            cells = []
            for r in results["summary"]:
                if (r["sensor"], r["axis"]) == (sensor, axis):
                    seen = "" if r["seen_median"] is None else f", {r['seen_median']:.2f} s"
                    cells.append(f"{r['right']} + {r['containing']} of {r['n']}, {r['wrong'] + r['none']} wrong{seen}")
            lines.append(f"| `{sensor}.{axis}` | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--flights", default=",".join(FLOWN))
    parser.add_argument("--no-vehicle", action="store_true", help="without rotor speeds and vehicle, for comparison")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    warnings.simplefilter("ignore")
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from converters_indiflight import captured

    model = None
    if not a.no_vehicle:
        known = flights(a.data, IDENTIFIED, captured)
        model = identify_vehicle(list(known.values()), still=True, set={"baro.temperature": 293.0, "timeout.gnss": 1.0}).lumped
    out: dict[str, Any] = {"made": datetime.date.today().isoformat(), "vehicle": not a.no_vehicle}
    out |= bench(a.data, a.flights.split(","), model, {"diagnosis.inertial": "on"})
    out["summary"] = summary(out["faults"])
    minutes = sum(c["seconds"] for c in out["clean"].values()) / 60.0
    out["false_alarms_per_minute"] = sum(len(c["alarms"]) for c in out["clean"].values()) / minutes
    out["minutes"] = minutes
    print(table(out))
    print(f"{out['false_alarms_per_minute']:.2f} false alarms a minute in {minutes:.2f} min")
    if a.out:
        a.out.write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
