"""Fixtures that all tests share."""

from __future__ import annotations

import os

os.environ.setdefault("HALTERE_JIT", "open")  # inner kernels are called from Python here; set before haltere is imported
from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "shared_data" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.real)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; without it the test is skipped, in continuous integration it fails."""
    folder = Path(os.environ.get("HALTERE_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
    if not folder.is_dir():
        message = f"the real recordings are not there: {folder} (set HALTERE_DATA)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return folder


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update", action="store_true", help="write the golden replays anew; review their diff before committing")
