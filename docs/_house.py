"""Draws the page of the house from the import contract and the rooms' own docstrings. It states nothing itself."""

from __future__ import annotations

import ast
import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "haltere"
KERNEL_TOWER = "The kernel tower knows no data, tables, files or screens"
DATA_TOWER = "The data tower holds no kernels"


def _contracts() -> list[dict[str, list[str]]]:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    found: list[dict[str, list[str]]] = tomllib.loads(text)["tool"]["importlinter"]["contracts"]
    return found


def _layers() -> list[list[str]]:
    """Rooms by floor, the highest first; a room in brackets is planned and may not be there yet."""
    rows = next(c["layers"] for c in _contracts() if "layers" in c)
    floors = [[room.strip(" ()") for room in row.split("|")] for row in rows]
    return [there for floor in floors if (there := [room for room in floor if _files(room)])]


def _tower(name: str) -> set[str]:
    contract = next(c for c in _contracts() if name == str(c["name"]))
    return {module.removeprefix("haltere.") for module in contract["source_modules"]}


def _files(room: str) -> list[Path]:
    module = SOURCE / f"{room}.py"
    return [module] if module.exists() else sorted((SOURCE / room).rglob("*.py"))


def _sentences(room: str) -> str:
    head = SOURCE / f"{room}.py" if (SOURCE / f"{room}.py").exists() else SOURCE / room / "__init__.py"
    doc = ast.get_docstring(ast.parse(head.read_text(encoding="utf-8"))) or ""
    return " ".join(doc.split("\n\n")[0].split()).replace("|", r"\|")


def _imports(room: str) -> list[str]:
    known = [name for row in _layers() for name in row]
    used: set[str] = set()
    for path in _files(room):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{a.name}" for a in node.names)]
            used |= {n.split(".")[1] for n in names if n.startswith("haltere.")}
    return [name for name in known if name in used and name != room]


def rooms() -> str:
    """Markdown table of every room: what it is for, and what it imports."""
    lines = ["| room | what it is for | imports |", "|---|---|---|"]
    for row in _layers():
        for room in row:
            lines.append(f"| `{room}` | {_sentences(room)} | {', '.join(f'`{r}`' for r in _imports(room))} |")
    return "\n".join(lines)


def picture() -> str:
    """SVG of the floors: the kernel tower left, the data tower right, what stands on both across."""
    left, right = _tower(KERNEL_TOWER), _tower(DATA_TOWER)
    width, height, gap = 640, 34, 8
    half = (width - gap) / 2
    boxes = []
    layers = _layers()
    for floor, row in enumerate(layers):
        y = gap + floor * (height + gap)
        for place, room in enumerate(row):
            x, w, fill = gap, half if len(row) == 2 else width, "#888888"
            if room in left:
                w, fill = half, "#2a6fbb"
            elif room in right:
                x, w, fill = gap + half + gap, half, "#c8852b"
            elif place == 1:
                x = gap + half + gap
            boxes.append(
                f'<rect x="{x}" y="{y}" width="{w}" height="{height}" rx="4" fill="{fill}" fill-opacity="0.3"/>'
                f'<text x="{x + w / 2}" y="{y + height / 2 + 5}" text-anchor="middle">{escape(room)}</text>'
            )
    total = gap + len(layers) * (height + gap)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width + 2 * gap} {total}" width="100%" role="img" '
        'aria-label="The rooms of haltere, floor by floor" font-family="monospace" font-size="14" fill="currentColor">'
        f"{''.join(boxes)}</svg>"
    )
