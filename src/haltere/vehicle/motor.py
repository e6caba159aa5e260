"""A motor between its command and its rotor's speed: a curve, the voltage and a lag of first order. No fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import entry

__all__ = ["commanded", "driven"]

FloatArray = NDArray[np.float64]
#: A motor that stands still has a command that does not vary.
VARIES = 1e-3


def commanded(streams: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Times (m,) [s] and commands (m, r), 0 to 1, that vary; with no row where a log has none of at least three motors."""
    for name in ("rotors", "actuators"):
        stream = streams.get(name)
        columns = [] if stream is None else [c for c in stream.names if c.startswith("command_")]
        if stream is None or len(columns) < 3:
            continue
        values = np.column_stack([stream[c] for c in sorted(columns, key=lambda c: int(c[8:]))])
        with np.errstate(invalid="ignore"):
            values = values[:, np.isfinite(values).any(axis=0) & (np.nanstd(values, axis=0) > VARIES)]
        good = np.isfinite(values).all(axis=1) & np.isfinite(stream.t)
        t, values = stream.t[good], values[good]
        if values.shape[1] >= 3 and len(t) > 50:
            return t, np.clip(values, 0.0, 1.0)
    return np.empty(0), np.empty((0, 0))


def driven(t: FloatArray, t_u: FloatArray, u: FloatArray, ratio: FloatArray, a: float, tau: float, full: float) -> FloatArray:
    """Speeds (n, r) [rad/s] at times t (n,) of motors with commands ``u`` (m, r) at times ``t_u``.

    Thrust goes with ``a u + (1 - a) u²`` and the square of the voltage ratio (n,); a command holds until the next; the speed follows with
    time constant ``tau`` [s]; ``full`` [rad/s] is that of a full command at voltage ratio 1.
    """
    held = u[np.clip(np.searchsorted(t_u, t, side="right") - 1, 0, len(t_u) - 1)]
    wanted = full * np.sqrt(a * held + (1.0 - a) * held * held) * ratio[:, None]
    out = np.empty_like(wanted)
    _follow(np.ascontiguousarray(t), np.ascontiguousarray(wanted), tau, out)
    return out


@entry
def _follow(t: Any, wanted: Any, tau: float, out: Any) -> None:
    """First-order lag at uneven times; the speed wanted at a sample holds until the next."""
    for j in range(wanted.shape[1]):
        out[0, j] = wanted[0, j]
    for k in range(1, len(t)):
        keep = np.exp(-(t[k] - t[k - 1]) / tau)
        for j in range(wanted.shape[1]):
            out[k, j] = wanted[k - 1, j] + keep * (out[k - 1, j] - wanted[k - 1, j])
