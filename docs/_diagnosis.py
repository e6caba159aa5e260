"""Test bench of the diagnosis of inertial faults: faults put into simulated flights, false alarms in flights without, faults in real ones.

``python docs/_diagnosis.py --seeds 20 --hours 100 --out docs/_data/diagnosis.json`` makes the tables of the page on it, and
``--data DIR`` adds the recordings in DIR. Every fault lasts; it begins at one of seven phases of a 0.25 s grid after 24 s. Seeds of the
table (from 40000) and of the false alarms (from 60000) were not looked at while thresholds were chosen.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import platform
import sys
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import haltere
from haltere.flight.log import FlightLog
from haltere.metrics.detection import alarms, detections, poisson_interval
from haltere.simulate import Scenario, inject, simulate

FULL = (
    "gyro.x:bias=3deg/s",
    "gyro.y:bias=3deg/s",
    "gyro.z:bias=6deg/s",
    "accel.x:bias=0.8m/s2",
    "accel.y:bias=0.8m/s2",
    "accel.z:bias=0.8m/s2",
)
HALF = (
    "gyro.x:bias=1.5deg/s",
    "gyro.y:bias=1.5deg/s",
    "gyro.z:bias=3deg/s",
    "accel.x:bias=0.4m/s2",
    "accel.y:bias=0.4m/s2",
    "accel.z:bias=0.4m/s2",
)
RAMP = tuple(f"gyro.{a}:ramp=0.1deg/s/s" for a in "xyz") + tuple(f"accel.{a}:ramp=0.05m/s2/s" for a in "xyz")
SELECTOR = tuple(f"gyro.{a}:bias={n}deg/s" for n in (10, 20) for a in "xyz") + tuple(f"accel.{a}:bias=1m/s2" for a in "xyz")
OUTSIDE = ("magnetometer:disturb=0.35", "gnss.n:bias=1.5m/s", "gnss.e:bias=3m", "barometer:bias=3m")
GROUPS = {"full": FULL, "half": HALF, "ramp": RAMP, "selector": SELECTOR, "outside": OUTSIDE}
WINDS: dict[str, dict[str, float]] = {"still": {}, "gusts": {"n": 5.2, "e": 3.0, "gust": 1.2}}
MISSIONS = ("hover", "lissajous", "box")
START, AFTER = 24.0, 16.0
#: Log whose track the mission ``track`` flies, set by ``--track``.
TRACK: list[Path] = []


def outcome(flight: FlightLog, **options: Any) -> dict[str, Any]:
    """What became of the one fault of a flight."""
    solution = haltere.run(flight, scored=False, set=options)
    (o,) = detections(solution.events, flight.meta.faults[-1:], float(solution.t[0]), float(solution.t[-1])).outcomes
    return {"isolation": o.isolation or "missed", "delay": o.delay, "named_after": o.isolation_delay, "named": list(o.named)}


def row(name: Mapping[str, Any], outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts and delays of one fault under one condition."""
    delays = [o["delay"] for o in outcomes if math.isfinite(o["delay"])]
    named = [o["named_after"] for o in outcomes if math.isfinite(o["named_after"])]
    small = sum(o["isolation"] == "containing" and len(o["named"]) <= 2 for o in outcomes)
    count = {k: sum(o["isolation"] == k for o in outcomes) for k in ("right", "wrong", "none", "missed")}

    def of(values: list[float], q: float) -> float | None:
        return round(float(np.quantile(values, q)), 2) if values else None

    return {**name, "n": len(outcomes), **count, "set": small, "larger_set": len(outcomes) - sum(count.values()) - small,
            "seen_median": of(delays, 0.5), "seen_97": of(delays, 0.97), "named_median": of(named, 0.5)}  # fmt: skip


def table(seeds: int, groups: Iterable[str], missions: Iterable[str], told: bool = False) -> list[dict[str, Any]]:
    """Every fault of the groups, by mission and wind."""
    rows = []
    for group in groups:
        for mission in missions:
            for wind, air in WINDS.items():
                for word in GROUPS[group]:
                    outcomes = []
                    for seed in range(40000, 40000 + seeds):
                        on = START + 0.37 * (seed % 7)
                        scenario = Scenario(
                            mission=mission,
                            duration=on + AFTER,
                            seed=seed,
                            wind=air,
                            fault=(f"{word}@{on:g}",),
                            landing=False,
                            tell_noise=told,
                            track=TRACK[0] if mission == "track" else None,
                        )
                        outcomes.append(outcome(simulate(scenario)))
                    name = {"group": group, "mission": mission, "wind": wind, "fault": word, "told": told}
                    rows.append(row(name, outcomes))
                    print(json.dumps(rows[-1]), flush=True)
    return rows


def false_alarms(hours: float) -> dict[str, Any]:
    """Alarms in two-minute flights without a fault, with take-off and landing, half of them in gusts."""
    missions = (*MISSIONS, "tour", "figure-eight")
    found: list[dict[str, Any]] = []
    flown, i = 0.0, 0
    while flown < hours * 3600.0:
        mission, wind = missions[i % len(missions)], list(WINDS)[(i // len(missions)) % 2]
        solution = haltere.run(simulate(Scenario(mission=mission, duration=120.0, seed=60000 + i, wind=WINDS[wind])), scored=False)
        for e in alarms(solution.events):
            what = {k: e[k] for k in ("sensor", "axis", "kind", "t_onset", "t_detected", "t_isolated", "statistic")}
            found.append({"mission": mission, "wind": wind, "seed": 60000 + i, **what})
            print(found[-1], flush=True)
        flown += float(solution.t[-1] - solution.t[0])
        i += 1
    low, high = poisson_interval(len(found), flown / 3600.0)
    return {
        "hours": round(flown / 3600.0, 2),
        "flights": i,
        "alarms": found,
        "per_hour": len(found) / (flown / 3600.0),
        "interval": [low, high],
    }


def real(data: Path) -> list[dict[str, Any]]:
    """Recordings: alarms as they are, and what is found of faults put into them."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from converters import ecl_replay, inertialnav

    flights = {
        "ardupilot/log_0036 before 140 s": (haltere.read(data / "ardupilot" / "log_0036_mechanical_failure.bin"), 140.0),
        "px4/sample.ulg": (haltere.read(data / "px4" / "sample.ulg"), math.inf),
        "px4_ecl_replay/iris_gps": (ecl_replay(data / "px4_ecl_replay" / "iris_gps.csv"), math.inf),
        "px4_ecl_replay/ekf_gsf_reset": (ecl_replay(data / "px4_ecl_replay" / "ekf_gsf_reset.csv"), math.inf),
        "inertialnav/quad106": (inertialnav(data / "inertialnav" / "quad106", gauss=0.1), math.inf),
    }
    rows = []
    for name, (flight, end) in flights.items():
        if end < math.inf:
            flight = FlightLog({k: s.where(s.t <= end) for k, s in flight.streams.items()}, flight.meta)
        clean = haltere.run(flight, scored=False)
        mine = [e for e in alarms(clean.events) if e["sensor"] != "magnetometer"]
        out = {
            "flight": name,
            "seconds": round(float(clean.t[-1] - clean.t[0])),
            "alarms": [f"{e['sensor']}.{e['axis']}" for e in mine],
            "faults": [],
        }
        if len(flight["imu"]) > 30.0 * 100.0:
            for word in (*FULL, "gyro.x:bias=20deg/s", "gyro.y:bias=10deg/s"):
                at = float(clean.t[0]) + 0.6 * float(clean.t[-1] - clean.t[0])
                out["faults"].append({"fault": word, **outcome(inject(flight, [f"{word}@{at:.2f}"]))})
        rows.append(out)
        print(json.dumps(out), flush=True)
    return rows


def fault_table(results: Mapping[str, Any], group: str) -> str:
    """The rows of a group as a Markdown table."""
    heads = ["fault", "mission", "air", "right", "set of two", "wrong", "missed", "seen after [s], median / 97 %", "named after [s]"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for r in results["faults"]:
        if r["group"] != group:
            continue
        others = r["wrong"] + r["none"] + r["larger_set"]
        figures = [f"{r['right']} of {r['n']}", r["set"] or "", others or "", r["missed"] or ""]
        figures += [f"{r['seen_median'] or '–'} / {r['seen_97'] or '–'}", r["named_median"] or "–"]
        told = ", noise told" if r["told"] else ""
        lines.append(f"| `{r['fault']}` | {r['mission']} | {r['wind']}{told} | " + " | ".join(map(str, figures)) + " |")
    return "\n".join(lines)


def real_table(results: Mapping[str, Any]) -> str:
    """What was found in recordings, as a Markdown table."""
    lines = ["| recording | seconds | alarms as it is | faults put in: right, set, wrong, missed |", "|---|---|---|---|"]
    for r in results["real"]:
        kinds = [f["isolation"] for f in r["faults"]]
        counts = ", ".join(str(kinds.count(k)) for k in ("right", "containing", "wrong", "missed")) if kinds else "too short"
        lines.append(f"| {r['flight']} | {r['seconds']} | {', '.join(r['alarms']) or 'none'} | {counts} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--groups", default=",".join(GROUPS))
    parser.add_argument("--missions", default=",".join(MISSIONS))
    parser.add_argument("--told", type=int, default=0, help="seeds of ramps with the noise told to the filter")
    parser.add_argument("--track", type=Path, help="log whose track the mission `track` flies; name that in --missions")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    if a.track:
        TRACK.append(a.track)
    warnings.simplefilter("ignore")
    out = {"made": datetime.date.today().isoformat(), "python": platform.python_version(), "seeds": a.seeds}
    out["faults"] = table(a.seeds, a.groups.split(","), a.missions.split(",")) if a.seeds else []
    if a.told:
        out["faults"] += table(a.told, ("full", "ramp"), a.missions.split(","), True)
    out["false_alarms"] = false_alarms(a.hours)
    out["real"] = real(a.data) if a.data else []
    if a.out:
        a.out.write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
