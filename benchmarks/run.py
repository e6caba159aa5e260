"""`make bench`: every part side by side in one run, with machine, versions and load, to a Markdown table and JSON. It asserts nothing.

Writes ``results.md`` and ``results.json`` into benchmarks/build; ``--publish`` also docs/_data/benchmarks.json, from which the
documentation's page is made. The exit status is 1 where a part fell over, or, with ``--strict``, where something was skipped.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import common
import report

#: Modules beside this one, in the order they run.
PARTS = {
    "throughput": "Filter throughput",
    "reading": "Reading speed",
    "startup": "Start-up",
    "memory": "Memory",
    "accuracy": "Accuracy",
}
PUBLISHED = common.ROOT / "docs" / "_data" / "benchmarks.json"
#: Sizes at which a run only shows that every part works.
QUICK: dict[str, dict[str, Any]] = {
    "throughput": {"rounds": 1, "samples": 10_000},
    "reading": {"rounds": 1, "bag_seconds": 5.0},
    "startup": {"rounds": 1, "runs": 1, "cold": False},
    "memory": {"samples": 30_000},
    "accuracy": {"trials": 1},
}


def run_part(name: str, settings: dict[str, Any]) -> dict[str, Any]:
    """One part with its load; an error in it is told and does not keep the others from running."""
    load = common.Load()
    try:
        tables = [t.as_json() for t in importlib.import_module(name).run(**settings)]
    except Exception as error:
        traceback.print_exc()
        return {"title": PARTS[name], "failed": f"{type(error).__name__}: {error}", **load.end()}
    return {"title": PARTS[name], "tables": tables, **load.end()}


def problems(results: dict[str, Any]) -> tuple[list[str], list[str]]:
    """What fell over, and what was skipped and why."""
    failed = [f"{name}: {found['failed']}" for name, found in results["parts"].items() if "failed" in found]
    skipped = []
    for name, found in results["parts"].items():
        for table in found.get("tables", ()):
            failed += [f"{name}: {row[table['columns'][0][0]]}: {row['failed']}" for row in table["rows"] if "failed" in row]
            skipped += [f"{name}: {row[table['columns'][0][0]]}: {row['skipped']}" for row in table["rows"] if "skipped" in row]
    return failed, skipped


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for, print and write it; the exit status."""
    parser = argparse.ArgumentParser(prog="make bench", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", action="append", choices=PARTS, help="this part alone; may be given again")
    parser.add_argument("--quick", action="store_true", help="smallest sizes: shows that everything runs, measures nothing")
    parser.add_argument("--publish", action="store_true", help=f"write {PUBLISHED.relative_to(common.ROOT)} too; needs every part in full")
    parser.add_argument(
        "--strict", action="store_true", default=bool(os.environ.get("CI")), help="fail where something is skipped; default under CI"
    )
    parser.add_argument("--out", type=Path, default=common.BUILD, help="folder for results.md and results.json")
    given = parser.parse_args(arguments)
    if given.publish and (given.only or given.quick):
        parser.error("--publish goes with a full run, not with --only or --quick")
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # before NumPy is imported: one thread for everybody
        os.environ.setdefault(name, "1")
    words = [w for name in given.only or () for w in ("--only", name)] + [f"--{w}" for w in ("quick", "publish") if getattr(given, w)]
    command = f'make bench BENCH_ARGS="{" ".join(words)}"' if words else "make bench"
    results: dict[str, Any] = {"machine": common.machine(), "command": command, "quick": given.quick, "parts": {}}
    given.out.mkdir(parents=True, exist_ok=True)
    for name in PARTS:
        if given.only and name not in given.only:
            continue
        print(f"{name} ...", file=sys.stderr, flush=True)
        results["parts"][name] = run_part(name, QUICK[name] if given.quick else {})
        content = json.dumps(results, indent=1, ensure_ascii=False) + "\n"
        (given.out / "results.json").write_text(content, encoding="utf-8")  # after each part: an interrupted run is not lost
    text = report.markdown(results)
    print(text)
    (given.out / "results.md").write_text(text, encoding="utf-8")
    failed, skipped = problems(results)
    for line in skipped:
        print(f"skipped: {line}", file=sys.stderr)
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    if failed or (given.strict and skipped):
        return 1
    if given.publish:
        PUBLISHED.parent.mkdir(exist_ok=True)
        PUBLISHED.write_text(content, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
