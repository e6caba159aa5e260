"""The optional states of a layout in their order after the core: copied out, copied in, added to. It knows what none of them means."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit

__all__ = ["add_optional", "get_optional", "put_optional"]


@jit
def get_optional(s: Any, x: Any, k: int) -> None:
    """Optional states of a record into ``x`` from index k on."""
    for i in range(len(s.baro)):
        x[k + i] = s.baro[i]
    k += len(s.baro)
    for i in range(len(s.mag)):
        x[k + i] = s.mag[i]
    k += len(s.mag)
    for i in range(len(s.wind)):
        x[k + i] = s.wind[i]
    k += len(s.wind)
    for i in range(len(s.drag)):
        x[k + i] = s.drag[i]
    k += len(s.drag)
    for i in range(len(s.steady)):
        x[k + i] = s.steady[i]
    k += len(s.steady)
    for i in range(len(s.vane)):
        x[k + i] = s.vane[i]
    k += len(s.vane)
    for i in range(len(s.twist)):
        x[k + i] = s.twist[i]


@jit
def put_optional(s: Any, x: Any, k: int) -> None:
    """The inverse of `get_optional`."""
    for i in range(len(s.baro)):
        s.baro[i] = 0.0
    for i in range(len(s.mag)):
        s.mag[i] = 0.0
    for i in range(len(s.wind)):
        s.wind[i] = 0.0
    for i in range(len(s.drag)):
        s.drag[i] = 0.0
    for i in range(len(s.steady)):
        s.steady[i] = 0.0
    for i in range(len(s.vane)):
        s.vane[i] = 0.0
    for i in range(len(s.twist)):
        s.twist[i] = 0.0
    add_optional(s, x, k)


@jit
def add_optional(s: Any, x: Any, k: int) -> None:
    """Add ``x`` from index k on to the optional states."""
    for i in range(len(s.baro)):
        s.baro[i] += x[k + i]
    k += len(s.baro)
    for i in range(len(s.mag)):
        s.mag[i] += x[k + i]
    k += len(s.mag)
    for i in range(len(s.wind)):
        s.wind[i] += x[k + i]
    k += len(s.wind)
    for i in range(len(s.drag)):
        s.drag[i] += x[k + i]
    k += len(s.drag)
    for i in range(len(s.steady)):
        s.steady[i] += x[k + i]
    k += len(s.steady)
    for i in range(len(s.vane)):
        s.vane[i] += x[k + i]
    k += len(s.vane)
    for i in range(len(s.twist)):
        s.twist[i] += x[k + i]
