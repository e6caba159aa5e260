"""The name that was probably meant by one that is not known, for error messages. Nothing is renamed by it."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

__all__ = ["nearest", "nearest_column", "nearest_stream"]

#: What others call our streams.
_STREAMS = {
    **dict.fromkeys(("gps", "gnss_fix", "gps_fix", "fix", "navsat", "ublox"), "gnss"),
    **dict.fromkeys(("mag", "compass", "magnetic_field", "mags", "magneto"), "magnetometer"),
    **dict.fromkeys(("baro", "pressure", "air_pressure", "static_pressure"), "barometer"),
    **dict.fromkeys(("gyro", "accel", "gyroscope", "accelerometer", "acc", "ins", "inertial", "imu_raw"), "imu"),
    **dict.fromkeys(("airspeed", "pitot", "air_data"), "airdata"),
    **dict.fromkeys(("rotor", "rpm", "esc", "motors"), "rotors"),
    **dict.fromkeys(("battery", "bat"), "power"),
    **dict.fromkeys(("groundtruth", "ground_truth", "reference", "mocap"), "truth"),
    **dict.fromkeys(("ekf", "autopilot", "estimate"), "onboard"),
}
#: What others call our columns.
_COLUMNS = {
    **{"latitude": "lat", "longitude": "lon", "lng": "lon", "long": "lon", "altitude": "alt", "height": "alt", "hmsl": "alt"},
    **{f"{other}{a}": f"gyro_{a}" for other in ("g", "w", "gyr", "gyro", "omega", "angularvelocity") for a in "xyz"},
    **{f"{other}{a}": f"accel_{a}" for other in ("a", "acc", "accel", "acceleration", "f") for a in "xyz"},
    **{f"{other}{a}": f"mag_{a}" for other in ("m", "b", "mag", "magfield", "magnetic") for a in "xyz"},
    **{f"{other}{a}": f"vel_{a}" for other in ("v", "vel", "velocity") for a in "ned"},
    **{"p": "pressure", "press": "pressure", "baro": "pressure", "time": "t", "timestamp": "t", "stamp": "t"},
    **{"eph": "h_acc", "hacc": "h_acc", "epv": "v_acc", "vacc": "v_acc", "sacc": "s_acc", "satellites": "num_sats", "nsats": "num_sats"},
}


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known name most like a word, or None where none is."""
    known = list(known)
    plain = {_plain(k): k for k in reversed(known)}
    if (same := plain.get(_plain(word))) is not None:
        return same
    close = difflib.get_close_matches(word.lower(), known, 1, 0.7)
    return close[0] if close else None


def nearest_stream(word: str, known: Iterable[str]) -> str | None:
    """The stream that was probably meant, or None; its instance number does not count."""
    base = word.lower().rstrip("0123456789._-")
    known = list(known)
    meant = _STREAMS.get(base)
    if any(base.startswith(f"{k}_") for k in known):  # named after one of ours on purpose
        return None
    return meant if meant in known else nearest(base, known)


def nearest_column(word: str, known: Iterable[str]) -> str | None:
    """The column that was probably meant, or None."""
    known = list(known)
    meant = _COLUMNS.get(_plain(word))
    return meant if meant in known else nearest(word, known)


def _plain(word: str) -> str:
    return re.sub(r"[^a-z0-9]", "", word.lower())
