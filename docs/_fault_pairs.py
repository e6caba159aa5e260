"""Two faults of different parts in one flight, the second 15 s after the first, and whether each is named as it is alone.

``python docs/_fault_pairs.py --seeds 62000 62004 --runs pairs.jsonl --out docs/_data/fault_pairs.json`` flies them; vehicle file, missions
and sizes are those of `docs/_truth_table.py`. The first lasts. Pairs of sensors are flown in still air and in gusts, those with a fault of
the vehicle in still air.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import _truth_table as bench

import haltere
from haltere.flight.vehicle import Vehicle
from haltere.metrics.detection import detections
from haltere.simulate import Scenario, simulate

PAIRS = (
    ("accel.x:bias=0.8m/s2", "gyro.z:bias=6deg/s"), ("gyro.x:bias=3deg/s", "magnetometer:disturb=0.165"),
    ("barometer:bias=3m", "gnss.n:bias=1.5m/s"), ("gnss.e:bias=1.5m/s", "accel.z:bias=0.8m/s2"),
    ("magnetometer:disturb=0.165", "gyro.y:bias=3deg/s"), ("rotor.2:thrust=0.85", "accel.z:bias=0.8m/s2"),
    ("gyro.y:bias=3deg/s", "rotors.1:scale=1.04"), ("model.r:bias=3rad/s2", "model.t:bias=0.8m/s2"),
)  # fmt: skip
OF_THE_VEHICLE = ("rotor", "model")
MISSIONS = ("hover", "box")
APART = 15.0


def fly(of: Vehicle, seed: int, mission: str, wind: str, pair: Sequence[str]) -> dict[str, Any]:
    """One flight, and what became of both faults."""
    on = bench.START + 0.37 * (seed % 7)
    words = tuple(f"{word}@{on + APART * i:g}" for i, word in enumerate(pair))
    scenario = Scenario(mission=mission, scale=bench.MISSIONS[mission], duration=on + APART + bench.AFTER, seed=seed, landing=False,
                        wind=bench.WINDS[wind], sensors=bench.SENSORS, fault=words)  # fmt: skip
    flight = simulate(scenario)
    solution = haltere.run(flight, vehicle=of, set=bench.ON, scored=False)
    found = detections(solution.events, flight.meta.faults, float(solution.t[0]), float(solution.t[-1]))
    ends = [{"kind": o.isolation or "missed", "names": " ".join(o.named), "seen": o.delay if o.detected else None} for o in found.outcomes]
    return {"pair": list(pair), "mission": mission, "wind": wind, "seed": seed, "outcomes": ends}


def summary(lines: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows by pair and air: flights, and in how many the first, the second and both were right; what else was named of either."""
    rows = []
    for first, second in PAIRS:
        for wind in bench.WINDS:
            mine = [x["outcomes"] for x in lines if x["pair"] == [first, second] and x["wind"] == wind]
            if not mine:
                continue
            right = [[o["kind"] == "right" for o in both] for both in mine]
            wrong: dict[str, int] = {}
            for both in mine:
                for i, o in enumerate(both):
                    if o["kind"] != "right":
                        name = f"{('first', 'second')[i]}: {o['names'].replace(' ', ' or ') or 'nothing'}"
                        wrong[name] = wrong.get(name, 0) + 1
            rows.append({"first": first, "second": second, "wind": wind, "n": len(mine), "first_right": sum(r[0] for r in right),
                         "second_right": sum(r[1] for r in right), "both": sum(all(r) for r in right), "else": wrong})  # fmt: skip
    return rows


def page(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table of the page on the vehicle's model, as Markdown."""
    lines = ["| first | second, 15 s later | air | flights | first right | second right | both | else |", "|---" * 8 + "|"]
    for r in rows:
        other = ", ".join(f"{name}: {n}" for name, n in r["else"].items())
        cells = (f"`{r['first']}`", f"`{r['second']}`", r["wind"], r["n"], r["first_right"], r["second_right"], r["both"], other)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(62000, 62004))
    parser.add_argument("--vehicle", type=Path, help="file to keep the identified vehicle in")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    warnings.simplefilter("ignore")
    of, what = bench.vehicle(a.vehicle), bench.commit()
    lines = [json.loads(x) for x in a.runs.read_text(encoding="utf-8").splitlines()] if a.runs.exists() else []
    done = {(tuple(x["pair"]), x["mission"], x["wind"], x["seed"]) for x in lines}
    with a.runs.open("a", encoding="utf-8") as file:
        for seed in range(*a.seeds):
            for mission in MISSIONS:
                for pair in PAIRS:
                    still = any(word.startswith(OF_THE_VEHICLE) for word in pair)
                    for wind in ("still",) if still else bench.WINDS:
                        if (pair, mission, wind, seed) in done:
                            continue
                        line = fly(of, seed, mission, wind, pair) | {"commit": what}
                        lines.append(line)
                        file.write(json.dumps(line) + "\n")
                        file.flush()
    rows = summary(lines)
    print(page(rows))
    if a.out:
        result = {"commits": sorted({x["commit"] for x in lines}), "seeds": list(a.seeds), "rows": rows}
        a.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
