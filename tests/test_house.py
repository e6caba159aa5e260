"""The house keeps its own rules: imports go down, the start is quick, every room and module says what it is for."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import inspect
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import haltere
from haltere.flight import schema

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "haltere"
MODULES = sorted(SOURCE.rglob("*.py"))
HEAVY = ("numba", "plotly", "polars", "scipy")

#: What a kernel module may import besides its own tower: what compiles, and what only types and caches layouts.
KERNEL_IMPORTS = {"__future__", "collections.abc", "functools", "math", "numpy", "numpy.typing", "typing"}
KERNEL_ROOMS = ("core", "filter", "vehicle", "strapdown", "aids", "diagnosis")


def _name(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


def _python(code: str) -> str:
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def _heavy_after(statement: str) -> str:
    return _python(f"{statement}; import sys; print(*[m for m in {HEAVY!r} if m in sys.modules])")


def _imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module or "")
    return found


def test_imports_only_go_down(tmp_path: Path) -> None:
    command = Path(sys.executable).with_name("lint-imports")
    if not command.exists():
        message = "import-linter is not installed beside this Python"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    result = subprocess.run([command, "--no-logo", "--cache-dir", tmp_path], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("room", KERNEL_ROOMS)
def test_kernels_import_little(room: str) -> None:
    below = ("haltere._jit", *(f"haltere.{r}" for r in KERNEL_ROOMS[: KERNEL_ROOMS.index(room) + 1]))
    for path in sorted((SOURCE / room).rglob("*.py")):
        foreign = {m for m in _imports(path) if m not in KERNEL_IMPORTS and not m.startswith(below)}
        assert not foreign, f"{_name(path)} imports {foreign}"


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_module_says_what_it_is_for(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    doc = ast.get_docstring(ast.parse(text))
    assert doc, "no module docstring"
    assert re.search(r"[.:]$", doc.split("\n\n", maxsplit=1)[0].strip()), "the module docstring starts with a whole sentence"
    assert len(text.splitlines()) <= 600, "two rooms would serve better"


@pytest.mark.parametrize("statement", ["import haltere", "import haltere.cli", "from haltere import HaltereError"])
def test_start_is_light(statement: str) -> None:
    assert _heavy_after(statement) == ""


@pytest.mark.parametrize("name", [n for n in haltere.__all__ if n != "__version__"])
def test_public_name_is_there_and_described(name: str) -> None:
    thing = getattr(haltere, name)
    assert callable(thing)
    assert inspect.getdoc(thing)
    assert name in dir(haltere)
    if not inspect.isclass(thing):
        return
    for attribute, value in vars(thing).items():
        if not attribute.startswith("_") and callable(value):
            assert inspect.getdoc(value), f"{name}.{attribute} has no docstring"


def test_public_names_are_typed_as_they_load() -> None:
    """What a type checker sees is what is loaded: the two lists of the package head name the same modules."""
    tree = ast.parse((SOURCE / "__init__.py").read_text(encoding="utf-8"))
    block = next(n for n in tree.body if isinstance(n, ast.If) and isinstance(n.test, ast.Name) and n.test.id == "TYPE_CHECKING")
    typed = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert typed == haltere._HOME
    assert {*typed, "__version__"} == set(haltere.__all__)


def test_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'rnu'"):
        importlib.import_module("haltere").__getattr__("rnu")


def test_version_has_one_source() -> None:
    assert importlib.metadata.version("haltere") == haltere.__version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" not in project["project"]
    assert project["tool"]["hatch"]["version"]["path"] == "src/haltere/_version.py"
    written = [_name(p) for p in MODULES if re.search(r"^__version__\s*=", p.read_text(encoding="utf-8"), re.MULTILINE)]
    assert written == ["_version.py"]


def test_package_is_typed() -> None:
    assert (SOURCE / "py.typed").exists()


@pytest.mark.parametrize("stream", schema.STREAMS)
def test_columns_have_units_frames_and_words(stream: str) -> None:
    described = schema.STREAMS[stream]
    assert described.doc
    assert described.names[0] == "t"
    assert len(set(described.names)) == len(described.names)
    assert set(described.required) <= set(described.names)
    for column in described.columns:
        assert column.unit, f"{column.name} has no unit"
        assert column.doc, f"{column.name} has no words"
        if re.search(r"_[xyzned]$", column.name):
            assert column.frame, f"{column.name} is a vector component without a frame"


def test_a_constant_is_given_once() -> None:
    """A second value under a name would silently be the first one's too: kernels take what stands last."""
    for path in MODULES:
        given = [
            name.id
            for node in ast.parse(path.read_text(encoding="utf-8")).body
            for target in (node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else [])
            for name in ast.walk(target)
            if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store) and name.id.isupper() and not name.id.startswith("_")
        ]
        assert len(given) == len(set(given)), f"{path}: {sorted(n for n in set(given) if given.count(n) > 1)}"


def test_no_field_of_a_record_is_hidden_in_plain_python() -> None:
    """`np.record` has methods; a field of such a name is read as the method when kernels run as plain Python."""
    only_written = {("strapdown/layout.py", "size"), ("estimators/smoother.py", "T")}
    hidden = {
        (_name(p), m[1])
        for p in MODULES
        if _name(p).split("/")[0] in (*KERNEL_ROOMS, "estimators", "simulate")
        for m in re.finditer(r'\("(\w+)",\s*(?:"[fiub]\d"|[A-Z_]{3,})', p.read_text(encoding="utf-8"))
        if hasattr(np.record, m[1])
    }
    assert hidden <= only_written
