"""Results as Markdown: the same tables for the terminal, for ``results.md`` and for the documentation. It measures nothing."""

from __future__ import annotations

import json
import math
from html import escape
from pathlib import Path
from typing import Any

__all__ = ["bars", "cell", "circumstances", "load", "markdown", "part", "table"]


def load(path: Path | str) -> dict[str, Any]:
    """Results as written by ``run.py``."""
    results: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
    return results


def _number(x: float, kind: str) -> str:
    if kind == "rate":
        size, letter = _scale(x)
        return _three(x / size) + letter
    if kind == "ratio":  # a hundredth of the yardstick is read more easily as 1/100
        return f"{x:.2f}" if abs(x) >= 0.1 or x <= 0.0 else f"1/{1.0 / x:.0f}"
    if kind == "ms":
        return _three(1e3 * x)
    if kind == "fixed":
        return f"{x:.2f}"
    if kind == "whole":
        return f"{x:,.0f}".replace(",", " ")
    return _three(x)


def _three(x: float) -> str:
    """Three digits, and all of a whole number."""
    return f"{x:.3g}" if abs(x) < 999.5 else f"{x:.0f}"


def _scale(x: float) -> tuple[float, str]:
    return next(((size, letter) for size, letter in ((1e6, " M"), (1e3, " k")) if abs(x) >= size), (1.0, ""))


def cell(value: Any, kind: str = "text") -> str:
    """One cell: a text, a number of a kind (``rate, ratio, ms, fixed, whole, number``; ms is given in seconds), or a measure as median and range."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "**no**"
    if isinstance(value, dict):
        middle = _number(value["median"], kind)
        if value["n"] < 2:
            return middle
        if kind == "rate":  # all three in the unit of the median
            size, letter = _scale(value["median"])
            middle, low, high = (_three(value[k] / size) for k in ("median", "min", "max"))
            return f"{middle} ({low} – {high}){letter}"
        return f"{middle} ({_number(value['min'], kind)} – {_number(value['max'], kind)})"
    if isinstance(value, int | float):
        return _number(float(value), "number" if kind == "text" else kind)
    return str(value).replace("|", r"\|")


def table(results: dict[str, Any]) -> str:
    """One table of results; a row that was skipped says why in place of its figures."""
    columns = results["columns"]
    left = {"text"}
    lines = [
        "| " + " | ".join(heading for _, heading, _ in columns) + " |",
        "|" + "|".join("---" if kind in left else "--:" for _, _, kind in columns) + "|",
    ]
    for row in results["rows"]:
        said = next((f"{word}: {cell(row[word])}" for word in ("failed", "skipped") if word in row), None)
        if said:
            cells = [cell(row.get(columns[0][0])), said] + [""] * (len(columns) - 2)
        else:
            cells = [cell(row.get(key), kind) for key, _, kind in columns]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def part(results: dict[str, Any], name: str, *tables: str) -> str:
    """The tables of one part, all or those named, each under its title."""
    found = results["parts"].get(name)
    if found is None:
        return f"*{name} was not run.*"
    if "failed" in found:
        return f"*{name} failed: {found['failed']}*"
    wanted = [t for t in found["tables"] if not tables or t["name"] in tables]
    return "\n\n".join(f"**{t['title']}**\n\n{table(t)}" for t in wanted)


def rows_of(results: dict[str, Any], part_name: str, table_name: str) -> list[dict[str, Any]]:
    """Rows with figures of one table; none where the part was not run."""
    tables = results["parts"].get(part_name, {}).get("tables", ())
    return [row for t in tables if t["name"] == table_name for row in t["rows"] if "skipped" not in row and "failed" not in row]


def bars(rows: list[dict[str, Any]], key: str, label: str, *, logarithmic: bool = False, kind: str = "number") -> str:
    """SVG of one figure a row as bars, ours in another colour; a measure has its range as a line."""
    value = [float(row[key]["median"] if isinstance(row[key], dict) else row[key]) for row in rows]
    low = 10.0 ** math.floor(math.log10(min(value))) if logarithmic else 0.0
    high = 10.0 ** math.ceil(math.log10(max(value))) if logarithmic else 1.1 * max(value)
    left, width, step = 280.0, 640.0, 22.0
    room = width - left - 70.0

    def place(x: float) -> float:
        part_of = math.log(max(x, low) / low) / math.log(high / low) if logarithmic else x / high
        return left + room * part_of

    pieces = []
    for i, (row, x) in enumerate(zip(rows, value, strict=True)):
        y, colour = 6.0 + i * step, "#2a6fbb" if str(row["what"]).startswith("haltere") else "#888888"
        end = place(x)
        pieces.append(f'<text x="{left - 8:.0f}" y="{y + 12:.0f}" text-anchor="end">{escape(str(row["what"]))}</text>')
        pieces.append(
            f'<rect x="{left:.0f}" y="{y:.0f}" width="{max(end - left, 1.0):.1f}" height="15" fill="{colour}" fill-opacity="0.7"/>'
        )
        if isinstance(row[key], dict):
            a, b = place(row[key]["min"]), place(row[key]["max"])
            pieces.append(f'<line x1="{a:.1f}" x2="{b:.1f}" y1="{y + 7.5}" y2="{y + 7.5}" stroke="currentColor" stroke-width="1.5"/>')
            end = max(end, b)
        pieces.append(f'<text x="{end + 5:.1f}" y="{y + 12:.0f}">{_number(x, kind)}</text>')
    height = 6.0 + len(rows) * step + 18.0
    scale = ", logarithmic" if logarithmic else ""
    pieces.append(f'<text x="{left:.0f}" y="{height - 4:.0f}">{escape(label + scale)}</text>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="100%" role="img" '
        f'aria-label="{escape(label)}" font-family="sans-serif" font-size="12" fill="currentColor">{"".join(pieces)}</svg>'
    )


def busy(found: dict[str, Any]) -> str:
    """In words, how busy the machine was while a part ran."""
    averages = [x[0] for x in (found.get("load_before"), found.get("load_after")) if x]
    words = f"{found['seconds']:.0f} s"
    if averages:
        words += ", load average " + " before and ".join(f"{x:.2f}" for x in averages) + " after"
    others = found.get("others_cores")
    return words + (f", other processes kept {others:.2f} cores busy" if others is not None else "")


def circumstances(results: dict[str, Any]) -> str:
    """Machine, versions, date, command and load as a list."""
    m = results["machine"]
    memory = f", {m['memory_gb']} GB" if m.get("memory_gb") else ""
    lines = [
        f"* {m['date']}, `{results['command']}`" + (f", sources {m['commit']}" if m.get("commit") else ""),
        f"* {m['processor']}, {m['cores']} cores{memory}; {m['system']}; Python {m['python']}"
        + (f"; {m['compiler']}" if m.get("compiler") else ""),
        "* " + ", ".join(f"{name} {number}" for name, number in m["versions"].items()),
    ]
    lines += [f"* {name}: {busy(found)}" for name, found in results["parts"].items()]
    return "\n".join(lines)


def markdown(results: dict[str, Any]) -> str:
    """Everything, as ``results.md``."""
    parts = [f"## {found['title']}\n\n{part(results, name)}" for name, found in results["parts"].items()]
    return "\n\n".join(["# Benchmarks", circumstances(results), *parts]) + "\n"
