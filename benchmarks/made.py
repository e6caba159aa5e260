"""The made-up flight of the twin as a `FlightLog` and as a flight folder. It makes no numbers of its own."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np

import twin
from haltere.aids.record import BAROMETER, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER
from haltere.flight.log import FlightLog, FlightMeta, Home

__all__ = ["flight_log", "write"]


def flight_log(f: twin.Flight) -> FlightLog:
    """The flight as streams, each sensor at its own rate."""

    def xyz(stem: str, values: np.ndarray) -> dict[str, np.ndarray]:
        return {f"{stem}_{a}": values[:, k] for k, a in enumerate("xyz")}

    streams = {"imu": {"t": f.t, **xyz("gyro", f.gyro), **xyz("accel", f.accel)}}
    velocity, position, baro, mag = (f.kind == int(code) for code in (GNSS_VELOCITY, GNSS_POSITION, BAROMETER, MAGNETOMETER))
    if mag.any():
        streams["magnetometer"] = {"t": f.stamp[mag], **xyz("mag", f.z[mag])}
    if velocity.any():
        streams["gnss"] = {
            "t": f.stamp[velocity],
            **{f"vel_{a}": f.z[velocity, k] for k, a in enumerate("ned")},
            **{name: f.z[position, k] for k, name in enumerate(("lat", "lon", "alt"))},
        }
    if baro.any():
        streams["barometer"] = {"t": f.stamp[baro], "altitude": f.z[baro, 0]}
    field = dict(zip(("declination", "dip", "strength"), twin.FIELD, strict=True))
    return FlightLog(streams, FlightMeta(name="made-up flight", home=Home(*twin.HOME), field=field))


def write(folder: str, samples: int) -> None:
    """Write a flight folder of so many IMU samples at 1 kHz."""
    from haltere.flight.folder import write_folder

    write_folder(flight_log(twin.fly(samples)), folder)


if __name__ == "__main__":
    write(sys.argv[1], int(sys.argv[2]))
