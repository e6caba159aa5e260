"""The decorators of every kernel: compiled and cached, or plain Python as the slow oracle. It holds no kernel.

The cache folder is keyed on a hash of the package's sources, since a compiled caller goes stale silently when a callee
in another file changes. It is set around the decoration only, so that the host process keeps its own cache setting.
``HALTERE_JIT=0`` gives plain Python (debugger, oracle); ``HALTERE_JIT=open`` makes the inner kernels callable from Python too
(tests); ``HALTERE_CACHE_DIR`` moves the cache.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., object])

__all__ = ["COMPILED", "as_records", "cache_folder", "constant", "entry", "jit", "where"]

#: False under ``HALTERE_JIT=0``.
COMPILED = os.environ.get("HALTERE_JIT", "1") != "0"
_OPEN = os.environ.get("HALTERE_JIT", "1") == "open"

#: Rooms whose sources are compiled together; a change in any of them makes a new cache folder. The simulator's kernels stand on
#: fewer rooms, and nothing stands on them.
_KERNEL_ROOMS = ("core", "filter", "strapdown", "aids", "diagnosis", "estimators", "vehicle", "_jit.py")
_SIMULATOR_ROOMS = ("core", "vehicle", "simulate", "_jit.py")


def constant(value: int) -> int:
    """Integer for use in kernels that is no literal: of every plain integer argument a version of its own would be compiled."""
    return cast(int, np.int64(value))


def as_records(array: NDArray[np.void]) -> NDArray[np.void]:
    """The same structured array in the form that kernels reach by attribute: itself compiled, a record array in plain Python."""
    return array if COMPILED else array.view(np.recarray)


@lru_cache(maxsize=2)
def cache_folder(simulator: bool = False) -> Path:
    """Folder of the compiled kernels of exactly these sources: of the filter, or of the simulator."""
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for room in _SIMULATOR_ROOMS if simulator else _KERNEL_ROOMS:
        for path in sorted([here / room] if room.endswith(".py") else (here / room).glob("*.py")):
            digest.update(path.name.encode())
            digest.update(path.read_bytes())
    root = os.environ.get("HALTERE_CACHE_DIR") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "haltere"
    )
    return Path(root) / (digest.hexdigest()[:16] + ("-open" if _OPEN else ""))


if COMPILED:
    import numba
    import numba.extending

    def _compile(function: F, **options: bool) -> F:
        # no reference counts (_nrt): a kernel only borrows arrays, so that none need be counted at every call, and none can be made
        before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        numba.config.CACHE_DIR = str(cache_folder(function.__module__.startswith("haltere.simulate")))  # type: ignore[attr-defined]
        try:
            compiled: object = numba.njit(cache=True, error_model="numpy", _nrt=False, **options)(function)  # type: ignore[call-overload]
            return cast(F, compiled)
        finally:
            numba.config.CACHE_DIR = before  # type: ignore[attr-defined]

    def entry(function: F) -> F:
        """Compile a kernel that Python calls, on its first call, from the cache where it is there."""
        return _compile(function)

    def jit(function: F) -> F:
        """Compile a kernel that only kernels call: without the wrappers for Python, a quarter of the compile time."""
        return _compile(function) if _OPEN else _compile(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)

    def where(block: str, function: F, otherwise: F) -> F:
        """Kernel that is ``function(s, ...)`` for records whose field ``block`` has elements, else ``otherwise(s, ...)``.

        Which one is settled by the type of the record, so that what a layout does not have is not compiled for it: an ``if`` on the length
        is folded away only after both sides were.
        """

        def choice(s: Any, *args: Any) -> object:
            chosen: Callable[..., object] = function if len(getattr(s, block)) > 0 else otherwise
            return chosen(s, *args)

        def choose(s: Any, *args: Any) -> Callable[..., object]:
            chosen: Callable[..., object] = function if s.typeof(block).shape[0] > 0 else otherwise

            def settled(s: Any, *args: Any) -> object:
                return chosen(s, *args)

            return settled

        numba.extending.overload(choice, strict=False, jit_options={"error_model": "numpy", "_nrt": False})(choose)  # type: ignore[typeddict-unknown-key]
        return cast(F, choice)

else:

    def entry(function: F) -> F:
        """Leave a kernel as plain Python."""
        return function

    def jit(function: F) -> F:
        """Leave a kernel as plain Python."""
        return function

    def where(block: str, function: F, otherwise: F) -> F:
        """Kernel that is ``function(s, ...)`` for records whose field ``block`` has elements, else ``otherwise(s, ...)``."""

        def choice(s: Any, *args: Any) -> object:
            return (function if len(getattr(s, block)) > 0 else otherwise)(s, *args)

        return cast(F, choice)
