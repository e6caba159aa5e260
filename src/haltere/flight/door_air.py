"""The door for what concerns the air: rotors, air data, and wind and attitude told from outside. Its rules only mask and count."""

from __future__ import annotations

from typing import Any

import numpy as np

from haltere.flight.log import Stream

__all__ = ["RULES"]

#: No rotor turns faster [rad/s], no small aircraft flies faster and no wind blows harder [m/s].
SPEED_MAX, AIRSPEED_MAX, WIND_MAX = 1e4, 400.0, 100.0


def _rotors(out: Any, stream: Stream) -> Stream:
    """A row whose speeds are not all there says nothing of their sum; a rotor that never reported is none. Commands stand by themselves."""
    names = [c for c in stream.names if c.startswith("speed_")]
    silent = {c for c in names if not np.isfinite(stream[c]).any()}
    speaking = [c for c in names if c not in silent]
    if silent:
        stream = Stream({c: v for c, v in stream.columns.items() if c not in silent})
    if not speaking:
        return stream
    values = np.column_stack([stream[c] for c in speaking])
    good = (np.isfinite(values) & (np.abs(values) < SPEED_MAX)).all(axis=1)
    kept: Stream = out.drop("rotors", stream, np.asarray(good), "speed not finite or impossible")
    return kept


def _airdata(out: Any, stream: Stream) -> Stream:
    known = np.isfinite(stream.get("airspeed")) | np.isfinite(stream.get("aoa") + stream.get("sideslip"))
    stream = out.drop("airdata", stream, np.asarray(known), "not finite")
    airspeed = stream.get("airspeed")
    stream = out.drop(
        "airdata", stream, np.asarray(~((airspeed < -AIRSPEED_MAX) | (airspeed > AIRSPEED_MAX))), "airspeed impossible in m/s"
    )
    # a vehicle that flies backwards, or is blown there, has angles of attack up to a half turn; asin gives sideslip a quarter
    for name, most in (("aoa", 3.2), ("sideslip", 1.6)):
        found = np.abs(stream.get(name))
        found = found[np.isfinite(found)]
        if not len(found) or (large := float(np.percentile(found, 95))) < most:
            continue
        out.warnings.append(
            f"airdata: expected {name} within {most:g} rad, found 5 % of them above {large:.3g}; angles not used; are they in deg?"
        )
        out.discarded.setdefault("airdata", {})["aoa and sideslip impossible in rad"] = len(stream)
        return Stream({c: v for c, v in stream.columns.items() if c not in ("aoa", "sideslip")})
    return stream


def _wind(out: Any, stream: Stream) -> Stream:
    speed = np.hypot(stream.get("wind_n"), stream.get("wind_e"))
    kept: Stream = out.drop("wind", stream, np.asarray(speed < WIND_MAX), "not finite or impossible in m/s")
    return kept


def _attitude(out: Any, stream: Stream) -> Stream:
    length = np.linalg.norm(stream.vector("q", "wxyz"), axis=1)
    kept: Stream = out.drop("attitude", stream, np.asarray((length > 0.9) & (length < 1.1)), "not a unit quaternion")
    return kept


#: Rule of each stream: takes what is gathered and the stream in order of time, gives back the rows that can be used.
RULES = (("rotors", _rotors), ("airdata", _airdata), ("wind", _wind), ("attitude", _attitude))
