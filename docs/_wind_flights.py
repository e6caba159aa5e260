"""Figures of the page on wind that take recordings or a thousand simulated flights.

``python docs/_wind_flights.py --data .../shared/data --out docs/_data/wind_flights.json`` flies all of it (some minutes); the page shows
what was written there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import haltere
from haltere.flight.config import KEYS
from haltere.flight.vehicle import load_vehicle

#: An RTK solution in place of a receiver's fixes.
WEMUAV = {"noise.gnss_velocity": 0.1, "noise.gnss_position": 0.1}


def drawn(seed: int) -> list[float]:
    """Errors and 1 sigma, north and east, of a hover at fixed heading in steady wind; drag, offsets and biases drawn from the priors."""
    rng = np.random.default_rng([7, seed])
    vehicle = load_vehicle("hummingbird")
    told = {name: float(KEYS[f"drag.{name}"].default) for name in ("mu", "mu_sd", "c", "c_sd", "offset_sd")}
    mu, c = (told[k] * math.exp(told[f"{k}_sd"] * rng.standard_normal()) for k in ("mu", "c"))
    askew = np.r_[told["offset_sd"] * rng.standard_normal(2) / 9.80665, -1.0]
    askew /= np.linalg.norm(askew)
    k_d = mu * vehicle.mass / float(vehicle.hover_speeds().sum())
    rotors = tuple(dataclasses.replace(r, k_d=k_d, axis=tuple(askew)) for r in vehicle.rotors)
    vehicle = dataclasses.replace(vehicle, rotors=rotors, drag=(c * vehicle.mass,) * 3)
    speed, to = rng.uniform(0.0, 8.0), rng.uniform(0.0, 2.0 * math.pi)
    wind = {"n": speed * math.cos(to), "e": speed * math.sin(to)}
    sensors = {"imu": {"accel_turn_on": float(KEYS["init.accel_bias"].default)}}
    scenario = haltere.Scenario(vehicle=vehicle, mission="hover", duration=60.0, seed=seed, rest=0.0, wind=wind, sensors=sensors)
    s = haltere.run(haltere.simulate(scenario), scored=False)
    i = np.searchsorted(s.t, 45.0)
    return [*(float(s[f"wind_{a}"][i] - wind[a]) for a in "ne"), *(float(s[f"sd_wind_{a}"][i]) for a in "ne")]


def honesty(flights: int, workers: int = 2) -> dict[str, float]:
    """Share of wind errors within one and two stated sigma."""
    with ProcessPoolExecutor(workers) as pool:
        rows = np.array(list(pool.map(drawn, range(flights), chunksize=10)))
    z = np.abs(rows[:, :2] / rows[:, 2:]).ravel()
    return {
        "flights": flights,
        "one": float(np.mean(z < 1.0)),
        "two": float(np.mean(z < 2.0)),
        "rms": float(np.sqrt(np.mean(rows[:, :2] ** 2))),
    }


def aeroplane(flight: haltere.FlightLog, start: float, end: float, cuts: tuple[float, ...]) -> dict[str, Any]:
    """Wind and scale against the triangle of least squares, attitude against the onboard one, and velocity without GNSS for two minutes."""
    from scipy.spatial.transform import Rotation

    from test_converters_air import wind_triangle

    s, own = haltere.run(flight), flight["onboard"]
    flying = (s.t > start) & (s.t < end)
    triangle, scale, _ = wind_triangle(flight, start, end)
    i = np.searchsorted(own.t, s.t[flying]).clip(0, len(own) - 1)
    angles = [
        Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_euler("ZYX", degrees=True)
        for q in (s.vector("q", "wxyz")[flying], own.vector("q", "wxyz")[i])
    ]
    off = (angles[0] - angles[1] + 180.0) % 360.0 - 180.0
    out: dict[str, Any] = {
        "wind": [float(s[f"wind_{a}"][flying].mean()) for a in "ne"], "triangle": [float(x) for x in triangle[:2]],
        "sd": float(s["sd_wind_n"][flying].mean()), "scale": float(1.0 / s["airspeed_scale"][-1]), "triangle_scale": scale,
        "roll": float(np.sqrt(np.mean(off[:, 2] ** 2))), "pitch": float(np.sqrt(np.mean(off[:, 1] ** 2))), "cuts": [],
    }  # fmt: skip
    for cut in cuts:
        without = haltere.inject(flight, [f"gnss:dropout@{cut:g}-{cut + 120:g}"])
        errors = []
        for on in ("on", "off"):
            d = haltere.run(without, set={"aid.airdata": on}, scored=False)
            here = (d.t > cut) & (d.t < cut + 120.0)
            e = [d[f"vel_{a}"][here] - np.interp(d.t[here], own.t, own[f"vel_{a}"]) for a in "ne"]
            errors.append(float(np.sqrt(np.sum(np.square(e)) / here.sum())))
        out["cuts"].append([cut, *errors])
    return out


def thirty(s: haltere.Solution, truth: haltere.Stream) -> np.ndarray:
    """Errors of 30 s means, north and east [m/s], counted from the end."""
    n = max(1, int((s.t[-1] - s.t[0]) // 30.0))
    edges = s.t[-1] - 30.0 * np.arange(n, -1, -1)
    rows = []
    for a, b in pairwise(edges):
        ours, theirs = (s.t >= a) & (s.t < b), (truth.t >= a) & (truth.t < b)
        rows.append([s[c][ours].mean() - truth[c][theirs].mean() for c in ("wind_n", "wind_e")])
    return np.array(rows)


def beside_the_mast(folder: Path, height: float | None) -> dict[str, Any]:
    """The square teaches the drag; the hover of another day is told it."""
    from converters_air import wemuav

    square = wemuav(folder / "FLY139__20210420_093827__Square.csv", height)
    s = haltere.run(square, set=WEMUAV, scored=False)
    drag = {k: float(s[f"drag_{k}"][-1]) for k in ("mu", "c")}
    told = {f"drag.{k}": v for k, v in drag.items()} | {f"drag.{k}_sd": float(s[f"sd_drag_{k}"][-1]) / v for k, v in drag.items()}
    hover = wemuav(folder / "FLY134__20210419_093107__Hover.csv", height)
    out: dict[str, Any] = {"height": height, "mu": drag["mu"], "mu_sd": told["drag.mu_sd"]}
    for name, flight, keys in (("square", square, {}), ("hover", hover, told), ("hover untold", hover, {})):
        e = thirty(haltere.run(flight, set={**WEMUAV, **keys}, scored=False), flight["truth"])
        out[name] = {"n": len(e), "bias": e.mean(axis=0).tolist(), "std": e.std(axis=0).tolist()}
    return out


def tables(figures: dict[str, Any]) -> dict[str, str]:
    """Tables of the page, in Markdown."""
    planes = [
        "| | wind of the filter [m/s] | of the triangle | 1σ | true over measured airspeed | of the triangle | roll, pitch RMS, onboard |",
        "|---|---|---|---|---|---|---|",
    ]
    for key, name in (("thor", "UMN Thor, circuits, vanes"), ("x8", "X-8, aerobatics, tube alone")):
        f = figures[key]
        w, t = ("{:.2f} north, {:.2f} east".format(*f[k]) for k in ("wind", "triangle"))
        attitude = f"{f['roll']:.1f}°, {f['pitch']:.1f}°"
        planes.append(f"| {name} | {w} | {t} | {f['sd']:.2f} | {f['scale']:.3f} | {f['triangle_scale']:.3f} | {attitude} |")
    cuts = ["| GNSS cut for 120 s from | with air data | without | ratio |", "|---|---|---|---|"]
    for start, on, off in figures["thor"]["cuts"]:
        cuts.append(f"| {start:.0f} s | {on:.1f} m/s | {off:.1f} m/s | {on / off:.2f} |")
    mast = [
        "| truth at | µ from the square | square: bias | hover, told that µ: bias | spread | hover, untold: bias |",
        "|---|---|---|---|---|---|",
    ]
    for f in figures["mast"]:
        at = "mean of 14.7, 18.0 and 21.3 m" if f["height"] is None else f"{f['height']:g} m"
        pairs = [
            "{:+.2f}, {:+.2f}".format(*f[k][q])
            for k, q in (("square", "bias"), ("hover", "bias"), ("hover", "std"), ("hover untold", "bias"))
        ]
        mast.append(f"| {at} | {f['mu']:.3f} ± {f['mu'] * f['mu_sd']:.3f} 1/s | " + " | ".join(pairs) + " |")
    return {name: "\n".join(rows) for name, rows in (("planes", planes), ("cuts", cuts), ("mast", mast))}


def main() -> None:
    """Fly all of it and write the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--flights", type=int, default=1000)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    from converters_air import umn_thor, x8_testlog2

    thor = umn_thor(given.data / "umn_thor" / "thor_flight75.mat", magnetometer=True)
    x8 = x8_testlog2(given.data / "inertialnav" / "TestLog2.mat")
    figures = {
        "thor": aeroplane(thor, 215.0, 570.0, (240.0, 300.0, 400.0, 440.0)),
        "x8": aeroplane(x8, 280.0, 570.0, ()),
        "mast": [beside_the_mast(given.data / "wemuav", h) for h in (None, 14.7, 18.0, 21.3)],
        "honesty": honesty(given.flights),
    }
    given.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
