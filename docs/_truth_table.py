"""Test bench of the truth table of theory.md §5.5: every fault, by mission and air, in full and half size, and hours without a fault.

``python docs/_truth_table.py --seeds 70000 70200 --track LOG --runs runs.jsonl --out docs/_data/truth_table.json`` makes the tables. Every
run is a line of ``--runs``; lines that are there are not flown again, so that it may be stopped and gone on with. The vehicle file is
identified on four simulated flights (seeds from 90011), geometry not given. Faults last, begin at one of seven phases of a 0.25 s grid
after 22 s, and are watched for 8 s. Faults of sensors are put into one flight for all of them; LOG is an ArduPilot, PX4 or Betaflight log
whose positions the mission ``track`` flies. Seeds below 60000 were looked at while the code was written, those from 70000 on were not.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import haltere
from haltere.flight.log import FlightLog
from haltere.flight.vehicle import Vehicle, load_vehicle
from haltere.identify.vehicle import identify_vehicle
from haltere.metrics.detection import alarms, detections, names, poisson_interval, share_interval
from haltere.simulate import Scenario, inject, parse_fault, simulate

#: Rows of sensors and of the vehicle: full size, half size, and how late the table's detection is in still air [s]. A field towards east of
#: 0.165 of the Earth's turns the compass by 20 degrees.
SENSOR_ROWS = {
    "gyro.x": ("bias=3deg/s", "bias=1.5deg/s", 0.0), "gyro.y": ("bias=3deg/s", "bias=1.5deg/s", 0.0),
    "gyro.z": ("bias=6deg/s", "bias=3deg/s", 0.0), "accel.x": ("bias=0.8m/s2", "bias=0.4m/s2", 0.1),
    "accel.y": ("bias=0.8m/s2", "bias=0.4m/s2", 0.1), "accel.z": ("bias=0.8m/s2", "bias=0.4m/s2", 0.0),
    "magnetometer": ("disturb=0.165", "disturb=0.08", 0.1), "gnss.n": ("bias=1.5m/s", "bias=0.75m/s", 0.1),
    "gnss.e": ("bias=1.5m/s", "bias=0.75m/s", 0.1), "barometer": ("bias=3m", "bias=1.5m", 0.0),
}  # fmt: skip
VEHICLE_ROWS = {
    "model.hx": ("bias=0.8m/s2", "bias=0.4m/s2", 0.1), "model.hy": ("bias=0.8m/s2", "bias=0.4m/s2", 0.1),
    "model.t": ("bias=0.8m/s2", "bias=0.4m/s2", 0.0), "model.r": ("bias=3rad/s2", "bias=1.5rad/s2", 0.0),
    "model.p": ("bias=3rad/s2", "bias=1.5rad/s2", 0.0), "model.q": ("bias=1.5rad/s2", "bias=0.75rad/s2", 0.0),
    "rotor.2": ("thrust=0.85", "thrust=0.925", 0.0), "rotors.1": ("scale=1.04", "scale=1.02", 0.0),
    "wind.n": ("step=4m/s", "step=2m/s", math.inf), "wind.e": ("step=4m/s", "step=2m/s", math.inf),
}  # fmt: skip
#: Theory-amendments.md §17 and the table of PX4's selector: detected within 0.1 s and named within 0.3 s.
FAST_ROWS = {"gyro.x": ("bias=20deg/s", "bias=10deg/s", 0.1)}
STILL: dict[str, float] = {}
GUSTS = {"n": 5.2, "e": 3.0, "gust": 1.2}
WINDS = {"still": STILL, "gusts": GUSTS}
#: Missions and their scale: a lissajous of 4 to 5 m/s.
MISSIONS = {"hover": 1.0, "lissajous": 0.55, "box": 1.0, "track": 1.0}
SENSORS = {"rotors": {"rate": 250.0}}
START, AFTER = 22.0, 8.0
IN_WIND = 2.5
ON = {"diagnosis.inertial": "on"}
#: With ``--quiet``: noise of theory-amendments.md 4, for which theory.md's delays hold (biases are the simulator's), told to the filter.
QUIET: dict[str, dict[str, float]] = {
    "imu": {"gyro_noise": 0.0005, "accel_noise": 0.015}, "barometer": {"noise": 0.3, "rate": 20.0},
    "magnetometer": {"noise": 0.7, "rate": 10.0},
}  # fmt: skip
QUIET_NOISE = {"noise.gyro": 0.0005, "noise.accel": 0.015, "noise.barometer": 0.3}


def be_quiet() -> None:
    """Fly with the sensors of theory-amendments.md 4."""
    SENSORS.update(QUIET)
    ON.update({k: str(v) for k, v in QUIET_NOISE.items()})


def vehicle(file: Path | None) -> Vehicle:
    """The vehicle file, from flights that nothing else here uses; kept in ``file``."""
    if file is not None and file.exists():
        return load_vehicle(file)
    flown = (("lissajous", 0.6, 2.0, -1.5), ("box", 1.0, -3.0, 1.0), ("tour", 1.0, 1.0, 2.0), ("figure-eight", 1.0, -1.0, -2.0))
    found = identify_vehicle([
        simulate(Scenario(mission=m, scale=k, duration=120.0, seed=90011 + i, sensors=SENSORS, wind={"n": n, "e": e, "gust": 0.4}))
        for i, (m, k, n, e) in enumerate(flown)
    ]).as_vehicle()  # fmt: skip
    if file is not None:
        file.write_text(found.to_toml(), encoding="utf-8")
        return load_vehicle(file)
    return found


def commit() -> str:
    """Commit of the code that is measured, with a plus if the tree differs from it."""
    here = Path(__file__).parent
    said = [subprocess.run(["git", *a], cwd=here, capture_output=True, text=True, check=False).stdout.strip()
            for a in (("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "--", "../src"))]  # fmt: skip
    return said[0] + ("+" if said[1] else "")


def track(file: Path | None, begin: float, end: float) -> FlightLog | None:
    """The part of a log whose track is flown."""
    if file is None:
        return None
    log = haltere.read(file)
    return FlightLog({k: s.where((s.t >= begin) & (s.t <= end)) for k, s in log.streams.items()}, log.meta)


def words(size: str, wind: str) -> Iterator[str]:
    """Fault words without their time: all rows in still air, of sensors alone in gusts."""
    k = 0 if size == "full" else 1
    groups = [SENSOR_ROWS, FAST_ROWS] + ([VEHICLE_ROWS] if wind == "still" else [])
    for group in groups:
        for part, row in group.items():
            yield f"{part}:{row[k]}"


def verdict(events: Sequence[Mapping[str, Any]], flight: FlightLog, begin: float, end: float) -> dict[str, Any]:
    """What became of the one fault of a flight: right, set (it and others), wrong, none (no name), missed; and what else was named."""
    d = detections(events, flight.meta.faults[-1:], begin, end)
    o, fault = d.outcomes[0], flight.meta.faults[-1]
    named = [e for e in alarms(events) if e["t_detected"] >= fault["start"] and names(e)]
    if fault["sensor"] == "wind":  # no fault: nobody may be convicted
        convicted = [e for e in named if "wind" not in names(e)]
        kind = "wrong" if convicted else ("set" if named else "right")
    else:
        kind = {"containing": "set", "": "missed"}.get(o.isolation, o.isolation)
    told = [" ".join(names(e)) for e in named]
    mine = " ".join(o.named)
    return {
        "kind": kind, "seen": None if not o.detected else round(o.delay, 3),
        "named": None if not math.isfinite(o.isolation_delay) else round(o.isolation_delay, 3),
        "names": mine, "also": sorted({w for w in told if w != mine}), "before": len(d.false_alarms),
    }  # fmt: skip


def fly(
    of: Vehicle, path: FlightLog | None, seed: int, mission: str, wind: str, todo: Sequence[str], rate: float
) -> Iterator[dict[str, Any]]:
    """Every fault of ``todo`` under one condition, faults of sensors in the same flight."""
    on = START + 0.37 * (seed % 7)
    sensors = {**SENSORS, "imu": {**SENSORS.get("imu", {}), "rate": rate}}
    scenario = Scenario(mission=mission, scale=MISSIONS[mission], duration=on + AFTER, seed=seed, wind=WINDS[wind], sensors=sensors,
                        landing=False, track=path if mission == "track" else None)  # fmt: skip
    clean = None
    for word in todo:
        fault = f"{word}@{on:g}"
        if parse_fault(fault).simulated_only:
            flight = simulate(scenario.changed(fault=(fault,)))
        else:
            clean = simulate(scenario) if clean is None else clean
            flight = inject(clean, [fault])
        began = time.process_time()
        solution = haltere.run(flight, vehicle=of, set=ON, scored=False)
        spent = time.process_time() - began
        line = {"word": word, "mission": mission, "wind": wind, "seed": seed}
        yield line | verdict(solution.events, flight, float(solution.t[0]), float(solution.t[-1])) | {"cpu": round(spent, 3)}


def row(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts and delays of one fault under one condition, against the table's."""
    first = lines[0]
    part, wind = first["word"].partition(":")[0], first["wind"]
    full = any(first["word"] == f"{p}:{r[0]}" for g in (SENSOR_ROWS, VEHICLE_ROWS, FAST_ROWS) for p, r in g.items())
    fast = any(first["word"] == f"{p}:{r[0]}" for p, r in FAST_ROWS.items())
    at = {**SENSOR_ROWS, **VEHICLE_ROWS, **(FAST_ROWS if fast else {})}[part][2]
    limit = (IN_WIND if wind == "gusts" and not fast else max(1.3 * at, at + 0.15)) if full else math.nan
    n, count = len(lines), {k: sum(x["kind"] == k for x in lines) for k in ("right", "set", "wrong", "none", "missed")}
    pair = [x for x in lines if x["kind"] == "set" and len(x["names"].split()) <= 2]
    allowed = [x for x in pair if part in ("model.hx", "model.hy", "wind.n", "wind.e") and first["mission"] == "hover"]
    good = count["right"] + len(allowed)
    seen = [x["seen"] for x in lines if x["seen"] is not None]
    named = [x["named"] for x in lines if x["named"] is not None]
    told = [x["names"] or "-" for x in lines]
    most = {w: told.count(w) for w in sorted(set(told), key=told.count, reverse=True)[:6]}
    also: dict[str, int] = {}
    for x in lines:
        for w in x["also"]:
            also[w] = also.get(w, 0) + 1

    def quantile(values: list[float], q: float) -> float | None:
        return round(float(np.quantile(values, q)), 3) if values else None

    return {
        "word": first["word"], "mission": first["mission"], "wind": wind, "size": "full" if full else "half", "n": n, "good": good,
        "interval": [round(x, 3) for x in share_interval(good, n)], **count, "pairs": len(pair),
        "seen_mean": round(float(np.mean(seen)), 3) if seen else None, "seen_median": quantile(seen, 0.5), "seen_97": quantile(seen, 0.97),
        "limit": None if not math.isfinite(limit) else round(limit, 3), "named_median": quantile(named, 0.5),
        "named_97": quantile(named, 0.97), "before": sum(x["before"] for x in lines), "names": most,
        "also": dict(sorted(also.items(), key=lambda kv: -kv[1])[:6]), "also_runs": sum(bool(x["also"]) for x in lines),
    }  # fmt: skip


def quiet(of: Vehicle, path: FlightLog | None, begin: int, hours: float, rate: float) -> Iterator[dict[str, Any]]:
    """Alarms in two-minute flights without a fault, with take-off and landing, half of them in gusts."""
    missions = [m for m in MISSIONS if m != "track" or path is not None]
    flown, i = 0.0, 0
    while flown < hours * 3600.0:
        mission, wind = missions[i % len(missions)], list(WINDS)[(i // len(missions)) % 2]
        sensors = {**SENSORS, "imu": {**SENSORS.get("imu", {}), "rate": rate}}
        scenario = Scenario(mission=mission, scale=MISSIONS[mission], duration=120.0, seed=begin + i, wind=WINDS[wind], sensors=sensors,
                            track=path if mission == "track" else None)  # fmt: skip
        solution = haltere.run(simulate(scenario), vehicle=of, set=ON, scored=False)
        keys = ("sensor", "axis", "kind", "t_onset", "t_detected", "t_isolated", "candidates", "evidence")
        span = float(solution.t[-1] - solution.t[0])
        yield {"quiet": True, "mission": mission, "wind": wind, "seed": begin + i, "span": span,
               "alarms": [{k: e[k] for k in keys} for e in alarms(solution.events)]}  # fmt: skip
        flown += span
        i += 1


def summary(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rows of the table, and the false alarms."""
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for x in lines:
        if not x.get("quiet"):
            groups.setdefault((x["word"], x["mission"], x["wind"]), []).append(x)
    flown = [x for x in lines if x.get("quiet")]
    hours = sum(x["span"] for x in flown) / 3600.0
    found = [{"mission": x["mission"], "wind": x["wind"], "seed": x["seed"], **e} for x in flown for e in x["alarms"]]
    seeds = [x["seed"] for x in lines if not x.get("quiet")]
    return {
        "commits": sorted({x["commit"] for x in lines}), "rate": sorted({x["rate"] for x in lines}),
        "seeds": [min(seeds, default=0), max(seeds, default=0)],
        "rows": [row(g) for g in groups.values()],
        "quiet": {"hours": round(hours, 2), "flights": len(flown), "alarms": found, "interval": poisson_interval(len(found), hours)},
    }  # fmt: skip


def page(result: Mapping[str, Any]) -> str:
    """The tables of the page on the vehicle's model, as Markdown."""
    lines = ["| size | mission | air | runs | right | set | wrong | nothing |", "|---" * 8 + "|"]
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for r in result["rows"]:
        groups.setdefault((r["size"], r["mission"], r["wind"]), []).append(r)
    for key, rows in sorted(groups.items()):
        total = {k: sum(r[k] for r in rows) for k in ("n", "right", "set", "wrong", "none", "missed")}
        counts = (total["n"], total["right"], total["set"], total["wrong"], total["none"] + total["missed"])
        lines.append("| " + " | ".join([*key, *map(str, counts)]) + " |")
    heads = ["fault", "mission", "air", "right", "seen after, mean (allowed) [s]", "named after [s]", "what was named"]
    lines += ["", "| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for r in result["rows"]:
        late = r["limit"] is not None and r["seen_mean"] is not None and r["seen_mean"] > r["limit"]
        if r["good"] >= 0.97 * r["n"] and not late:
            continue
        told = ", ".join(f"{w.replace(' ', ' or ')}: {n}" for w, n in r["names"].items()).replace("-:", "nothing:")
        seen = f"{r['seen_mean'] if r['seen_mean'] is not None else '–'}" + (f" ({r['limit']})" if r["limit"] is not None else "")
        cells = [f"`{r['word']}`", r["mission"], r["wind"], f"{r['good']} of {r['n']}", seen, str(r["named_median"] or "–"), told]
        lines.append("| " + " | ".join(cells) + " |")
    q = result["quiet"]
    if q["flights"]:
        words = f"{len(q['alarms'])} alarms in {q['hours']:.1f} h without a fault (half in gusts): "
        lines += ["", f"{words}{q['interval'][0]:.2f} to {q['interval'][1]:.2f} an hour with 95 %."]
    lines += ["", f"Seeds {result['seeds'][0]} to {result['seeds'][1]}, IMU at 250 Hz, commit {', '.join(result['commits'])}."]
    return "\n".join(lines)


def show(result: Mapping[str, Any]) -> None:
    """The rows on the screen, the bad ones with what was named."""
    for r in result["rows"]:
        late = r["limit"] is not None and r["seen_mean"] is not None and r["seen_mean"] > r["limit"]
        bad = r["good"] < 0.97 * r["n"]
        counts = " ".join(f"{k} {r[k]}" for k in ("right", "set", "wrong", "none", "missed", "before") if r[k])
        more = (f" {r['names']}" if bad else "") + (f" also {r['also']}" if r["also"] else "")
        where = f"{r['word']:26s} {r['mission']:9s} {r['wind']:5s} {r['good']:3d}/{r['n']:<3d}"
        print(f"{'BAD ' if bad else '    '}{'late' if late else '    '} {where} {counts}; seen"
              f" {r['seen_mean']} ({r['limit']}), named {r['named_median']}{more}")  # fmt: skip
    q = result["quiet"]
    if q["flights"]:
        print(f"{len(q['alarms'])} alarms in {q['hours']} h, {q['interval'][0]:.3f} to {q['interval'][1]:.3f} an hour")
        for a in q["alarms"]:
            print("  ", a)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(50000, 50003))
    parser.add_argument("--rows", default="", help="only words that contain one of these, with commas")
    parser.add_argument("--missions", default="")
    parser.add_argument("--winds", default=",".join(WINDS))
    parser.add_argument("--sizes", default="full,half")
    parser.add_argument("--rate", type=float, default=250.0, help="of the IMU [Hz]")
    parser.add_argument("--track", type=Path)
    parser.add_argument("--part", type=float, nargs=2, default=(18.0, 140.0), help="of the track's log [s]")
    parser.add_argument("--quiet", action="store_true", help="noise of theory-amendments.md 4")
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--quiet-seeds", type=int, default=51000)
    parser.add_argument("--vehicle", type=Path, help="file to keep the identified vehicle in")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--show", action="store_true")
    a = parser.parse_args()
    warnings.simplefilter("ignore")
    if a.quiet:
        be_quiet()
    lines = [json.loads(x) for x in a.runs.read_text(encoding="utf-8").splitlines()] if a.runs.exists() else []
    done = {(x["word"], x["mission"], x["wind"], x["seed"]) for x in lines if not x.get("quiet")}
    of, path, what = vehicle(a.vehicle), track(a.track, *a.part), commit()
    missions = a.missions.split(",") if a.missions else [m for m in MISSIONS if m != "track" or path is not None]
    with a.runs.open("a", encoding="utf-8") as file:

        def keep(line: dict[str, Any]) -> None:
            line |= {"commit": what, "rate": a.rate}
            lines.append(line)
            file.write(json.dumps(line) + "\n")
            file.flush()

        for seed in range(*a.seeds):
            for mission in missions:
                for wind in a.winds.split(","):
                    todo = [w for s in a.sizes.split(",") for w in words(s, wind) if (w, mission, wind, seed) not in done]
                    todo = [w for w in todo if not a.rows or any(part in w for part in a.rows.split(","))]
                    for line in fly(of, path, seed, mission, wind, todo, a.rate):
                        keep(line)
        if a.hours > 0.0:
            for line in quiet(of, path, a.quiet_seeds, a.hours, a.rate):
                keep(line)
    result = summary(lines)
    if a.show:
        show(result)
    if a.out:
        a.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
