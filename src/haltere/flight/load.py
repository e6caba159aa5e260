"""What the motors draw, from the streams a flight has, at given times: current, throttle or rotor speed. It judges none of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError, UsageError
from haltere.flight.log import FlightLog

__all__ = ["LOADS", "load_at", "loads_of", "series"]

FloatArray = NDArray[np.float64]

#: Unit of a load by its word, and the streams it may be in with the beginning of their columns.
LOADS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "current": ("A", ("power",), "current"),
    "throttle": ("1", ("actuators", "rotors"), "command_"),
    "rotors": ("rad/s", ("rotors",), "speed_"),
}


def series(flight: FlightLog, word: str) -> tuple[FloatArray, FloatArray] | None:
    """Times (n,) [s] and values (n,) of a load by its word, in order of time, the mean over the rotors; None where there are not two."""
    _, streams, stem = LOADS[word]
    for name in streams:
        stream = flight.get(name)
        columns = [] if stream is None else [c for c in stream.names if c.startswith(stem) and stream[c].dtype.kind == "f"]
        if stream is None or not columns:
            continue
        values = np.column_stack([stream[c] for c in columns])
        good = np.isfinite(stream.t) & np.isfinite(values).any(axis=1)
        if good.sum() < 2:
            continue
        t, u = stream.t[good], np.nanmean(values[good], axis=1)
        order = np.argsort(t, kind="stable")
        return t[order], u[order]
    return None


def loads_of(flight: FlightLog) -> tuple[str, ...]:
    """Words of the loads that a flight has."""
    return tuple(word for word in LOADS if series(flight, word) is not None)


def load_at(flight: FlightLog, word: str, t: FloatArray) -> FloatArray:
    """Load at times (n,), between its samples interpolated, before the first and after the last held.

    Parameters
    ----------
    flight
        The flight; ``power.current`` [A], the mean of ``command_*`` [1] or the mean of ``speed_*`` [rad/s] is taken.
    word
        ``current``, ``throttle`` or ``rotors``.
    t
        Times [s].

    Raises
    ------
    HaltereError
        The flight has no such samples.
    UsageError
        An unknown word.
    """
    if word not in LOADS:
        raise UsageError(f"a load: {', '.join(LOADS)}", repr(word), "load")
    found = series(flight, word)
    if found is None:
        unit, streams, stem = LOADS[word]
        have = loads_of(flight)
        raise HaltereError(
            f"{stem.rstrip('_')} [{unit}] in the stream {' or '.join(streams)}", "none", f"{flight.meta.name or 'flight'}: load {word}",
            f"the flight has {', '.join(have)}" if have else "set magnetometer.load=off, or log it",
        )  # fmt: skip
    return np.asarray(np.interp(t, *found))
