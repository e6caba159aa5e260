"""What is to be compared, read from the words of a user: our estimators with presets and keys, and peers. It runs nothing."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from haltere.errors import UsageError
from haltere.evaluate.peers import PEERS, Peer
from haltere.flight import config as configuration

__all__ = ["Choice", "choices", "peers_named"]


@dataclass(frozen=True)
class Choice:
    """One of our estimators as asked for: its name in tables, the estimator, its preset, and keys that are changed."""

    name: str
    estimator: str
    preset: str
    keys: Mapping[str, Any]


def _listed(words: str | Sequence[str]) -> list[str]:
    parts = words.split(",") if isinstance(words, str) else list(words)
    return [p.strip() for p in parts if p.strip()]


def choices(words: str | Sequence[str], common: Mapping[str, Any] | None = None) -> list[Choice]:
    """Estimators from ``NAME[@PRESET][:KEY=VALUE]...`` texts; every name, preset and key is checked here.

    Parameters
    ----------
    words
        One text with commas between, or several.
    common
        Keys for all of them; an estimator's own win.

    Raises
    ------
    UsageError
        An unknown name, preset or key (with the nearest), a value out of bounds, the same twice, or nothing at all.
    """
    out: list[Choice] = []
    for text in _listed(words):
        head, *assignments = text.split(":")
        estimator, _, preset = head.partition("@")
        if estimator in PEERS:
            raise UsageError("one of our estimators", repr(estimator), "--estimators", f"it is a peer: --peers {estimator}")
        preset = preset or "default"
        keys = {**(common or {}), **dict(configuration.parse_assignment(a) for a in assignments)}
        configuration.resolve(estimator, preset, common, "--set")
        configuration.resolve(estimator, preset, keys, f"--estimators {text}")
        if any(c.name == text for c in out):
            raise UsageError("every estimator once", f"{text!r} twice", "--estimators")
        out.append(Choice(text, estimator, preset, keys))
    if not out:
        raise UsageError("at least one estimator", "none", "--estimators", f"one of {', '.join(configuration.ESTIMATORS)}")
    return out


def peers_named(words: str | Sequence[str]) -> list[Peer]:
    """Peers from ``all``, ``none`` or names.

    Raises
    ------
    UsageError
        A name that is no peer's, with the nearest.
    """
    if words == "all":
        return list(PEERS.values())
    if words == "none":
        return []
    out: list[Peer] = []
    for name in _listed(words):
        if name not in PEERS:
            known = {k.lower(): k for k in PEERS} | {k.split(".")[1].lower(): k for k in PEERS}
            near = difflib.get_close_matches(name.lower(), known, 1, 0.5)
            raise UsageError("a peer", repr(name), "--peers", f"did you mean {known[near[0]]!r}?" if near else f"one of {', '.join(PEERS)}")
        if PEERS[name] not in out:
            out.append(PEERS[name])
    return out
