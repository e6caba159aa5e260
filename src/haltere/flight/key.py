"""One configuration key and the usual kinds of it. It knows no key by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from haltere.flight import axes
from haltere.flight.exclusion import exclusion_text
from haltere.flight.units import UNITS

__all__ = ["Key", "Value", "axes_key", "delay", "exclusion", "positive", "switch", "unit_key"]

Value = float | str | bool


@dataclass(frozen=True)
class Key:
    """One configuration key.

    Attributes
    ----------
    default
        Value where nothing else is said.
    unit
        SI unit, or the words it may be.
    doc
        What it is, and what raising or lowering it does.
    words
        Allowed words of a switch, in the order of their codes 0, 1, 2.
    low, high
        Bounds of a number, both allowed.
    text
        Of a text that is neither: puts it into its usual form, or raises and names where it stands.
    """

    default: Value
    unit: str
    doc: str
    words: tuple[str, ...] = ()
    low: float = -math.inf
    high: float = math.inf
    text: Callable[[str, str], str] | None = None


def positive(default: float, unit: str, doc: str) -> Key:
    """A number above zero."""
    return Key(default, unit, doc, low=1e-12)


def switch(default: str, doc: str, words: tuple[str, ...] = ("off", "on")) -> Key:
    """One of some words."""
    return Key(default, " or ".join(words), doc, words=words)


def delay(doc: str) -> Key:
    """A delay [s]."""
    return Key(0.0, "s", doc, low=0.0, high=2.0)


def exclusion(doc: str) -> Key:
    """Axes that are left out for a time."""
    return Key("off", "off or spans such as xyz@20-80", doc, text=exclusion_text)


def unit_key(unit: str, doc: str) -> Key:
    """What a quantity of a log is in."""
    return Key(unit, ", ".join(UNITS[unit]), doc, words=tuple(UNITS[unit]))


def axes_key(doc: str) -> Key:
    """Where a triad's axes point."""
    return Key(axes.WORDS[0], "one each of F or B, R or L, D or U", doc, words=axes.WORDS)
