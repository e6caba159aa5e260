"""What tests of the report share: flights, what a page carries, and a browser to open it in."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import shutil
import subprocess
import tempfile
import zlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haltere import drive
from haltere.flight.config import Config, defaults
from haltere.flight.log import FlightLog, FlightMeta, Stream
from haltere.flight.solution import Solution
from haltere.report import page
from haltere.report.series import Pool
from haltere.simulate import demo_flight

Array = np.ndarray[Any, np.dtype[np.float64]]


# --- flights -------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def demo() -> tuple[Solution, FlightLog]:
    """A short simulated flight with truth and flight modes, and its solution."""
    flight = demo_flight(seed=2, duration=30.0, imu_rate=100.0)
    modes = Stream({"t": [0.0, 4.0, 12.0, 13.0, 26.0], "mode": ["Hold", "Hold", "Loiter", "Loiter", "Land"], "armed": [0, 1, 1, 1, 1]})
    flight = FlightLog({**flight.streams, "modes": modes}, flight.meta)
    return drive.run(flight), flight


@lru_cache(maxsize=1)
def demo_page() -> str:
    return page(*demo(), "haltere run 'my log.bin' --config my.haltere/config.toml")


def made(t: Array, rng: np.random.Generator, aids_rate: float) -> tuple[Solution, FlightLog]:
    """A solution made by hand, as hard to compress as a flight can be: everything is noise."""
    n = len(t)
    names = [
        *(f"{s}_{a}" for s in ("vel", "pos") for a in "ned"),
        *(f"{s}_bias_{a}" for s in ("gyro", "accel") for a in "xyz"),
        "baro_bias",
    ]
    table = {"t": t} | {f"q_{a}": np.zeros(n) for a in "wxyz"}
    yaw = np.cumsum(rng.normal(0.0, 0.1, n))
    table["q_w"], table["q_z"] = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    table |= {name: rng.normal(0.0, 10.0, n) for name in names}
    table |= {f"sd_{name}": np.abs(rng.normal(1.0, 0.3, n)) for name in ("roll", "pitch", "yaw", *names)}
    parts = [("gnss", c) for c in ("vel_n", "vel_e", "vel_d", "pos_n", "pos_e", "pos_d")]
    parts += [("magnetometer", "heading"), ("barometer", "altitude")]
    at = np.sort(np.tile(np.arange(t[0], t[-1], 1.0 / aids_rate), len(parts)))
    m = len(at)
    aids = {
        "t": at,
        "sensor": np.array([s for s, _ in parts] * (m // len(parts))),
        "component": np.array([c for _, c in parts] * (m // len(parts))),
        "status": np.where(rng.random(m) < 0.3, "rejected", "fused"),
        "reason": np.full(m, ""),
    } | {k: np.abs(rng.normal(1.0, 0.3, m)) for k in ("observation", "innovation", "innovation_sd", "test_ratio", "weight")}
    config = Config("navigator", "default", defaults())
    zeros = np.zeros(n)
    imu = {"t": t} | {f"{s}_{a}": zeros for s in ("gyro", "accel") for a in "xyz"}
    truth = {k: v + rng.normal(0.0, 1.0, n) * (k != "t") for k, v in table.items() if not k.startswith("sd_")}
    flight = FlightLog({"imu": imu, "truth": truth}, FlightMeta(name="made"))
    return Solution(table, aids, [], config, {"streams": {}, "errors": {}, "nis": {}, "health": {}, "warnings": []}), flight


# --- what a page carries -------------------------------------------------------------------------------------------------


def carried(text: str, name: str) -> bytes:
    """What the page carries under a name, inflated."""
    found = re.search(rf'<script type="application/octet-stream" id="{name}">([^<]*)</script>', text)
    assert found, f"no {name} in the page"
    return zlib.decompress(base64.b64decode(found.group(1)), -15 if name == "arrays" else 15)


def content(text: str) -> dict[str, Any]:
    """What the scripts of the page read, apart from the arrays."""
    found: dict[str, Any] = json.loads(carried(text, "numbers"))
    return found


def decode(metas: list[dict[str, Any]], data: bytes) -> list[Array]:
    """The arrays of a page: bytes of one weight after the other, folded signs, differences, what is not finite."""
    at, out = 0, []
    for meta in metas:
        if "same" in meta:
            out.append(out[meta["same"]])
            continue
        missing = np.zeros(meta["n"], bool)
        if meta.get("x"):
            missing = np.frombuffer(data, np.uint8, meta["n"], at) == 1
            at += meta["n"]
        count, width = int(np.count_nonzero(~missing)), meta["w"]
        planes = np.frombuffer(data, np.uint8, count * width, at).reshape(width, count)
        at += count * width
        folded = sum((planes[w].astype(np.int64) << (8 * w) for w in range(width)), np.zeros(count, np.int64))
        steps = np.where(folded % 2 == 1, -(folded + 1) // 2, folded // 2)
        for _ in range(meta["o"]):
            steps = np.cumsum(steps)
        values = np.full(meta["n"], np.nan)
        values[~missing] = steps / meta["s"]
        out.append(values)
    assert at == len(data)
    return out


def unpacked(pool: Pool) -> list[Array]:
    """The arrays of a pool, packed and read again."""
    metas, data = pool.packed()
    return decode(metas, zlib.decompress(data, -15))


def numbers(text: str) -> dict[str, Any]:
    """Figures of the page by name, with the arrays they refer to in place of the references."""
    found = content(text)
    arrays = decode(found["arrays"], carried(text, "arrays"))

    def resolve(value: Any) -> Any:
        if isinstance(value, dict):
            if "$a" in value:
                return arrays[value["$a"]]
            if "$b" in value:
                return value["k"] * arrays[value["$b"]]
            if "$track" in value:
                t, north, east, down = (arrays[i] for i in value["$track"]["ids"])
                return {k: resolve(v) for k, v in value.items()} | {"x": east, "y": north, "z": -down, "t": t}
            return {k: resolve(v) for k, v in value.items()}
        return [resolve(v) for v in value] if isinstance(value, list) else value

    return {f["name"]: resolve(f) for f in found["figures"]}


def series(figure: dict[str, Any], label: str, axis: str = "y") -> tuple[Any, Any]:
    """Times and values of a named line of a figure."""
    trace = next(t for t in figure["traces"] if t["name"] == label and t["yaxis"] == axis and "y" in t)
    return trace["x"], trace["y"]


def sections(text: str) -> list[str]:
    return re.findall(r'<section (?:class="[^"]*" )?id="([^"]+)"', text)


# --- in a browser --------------------------------------------------------------------------------------------------------

#: Run in the page once everything is drawn; what ``probe`` returns is left in the document for the test.
AFTERWARDS = """
<script>
new MutationObserver(async (_, me) => {
  const root = document.documentElement;
  if (!root.dataset.ready) return;
  me.disconnect();
  const out = {};
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  const until = async (done) => { for (let i = 0; i < 200 && !done(); i++) await pause(50); };
  try { await (async (H) => { PROBE })(window.haltereReport); } catch (e) { out.failed = String(e && e.stack || e); }
  root.dataset.probe = JSON.stringify(out);
}).observe(document.documentElement, { attributes: true });
</script>
"""


def browse(text: str, probe: str, *options: str, size: str = "1300,900", hash_: str = "") -> tuple[dict[str, str], dict[str, Any]]:
    """Open a page in headless Chromium; returns the data attributes of its document, and what the probe put into ``out``."""
    program = next((p for p in ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable") if shutil.which(p)), None)
    if program is None:
        message = "no Chromium to open the report in (Debian: apt install chromium)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        file = folder / "report.html"
        file.write_text(text.replace("</footer>", "</footer>" + AFTERWARDS.replace("PROBE", probe)), encoding="utf-8")
        result = subprocess.run(
            [
                program, "--headless", "--no-sandbox", "--disable-quic", "--no-first-run",
                "--disable-background-networking", "--disable-component-update", "--disable-sync",
                f"--user-data-dir={folder / 'profile'}", f"--window-size={size}",
                "--virtual-time-budget=30000", *(options or ("--disable-gpu",)), "--dump-dom", file.as_uri() + hash_,
            ],
            capture_output=True, text=True, check=False, timeout=240,
        )  # fmt: skip
    head = re.search(r"<html[^>]*>", result.stdout)
    assert head, result.stderr[-2000:]
    data = {k: html.unescape(v) for k, v in re.findall(r'data-([a-z]+)="([^"]*)"', head.group(0))}
    assert "probe" in data, f"the probe did not run: {data}"
    found = json.loads(data["probe"])
    assert "failed" not in found, found["failed"]
    return data, found
