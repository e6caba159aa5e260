"""indiflight's flights with what stands in for GNSS, a compass or a told attitude, made of the motion capture that the log holds."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import haltere
from haltere.flight.local import geodetic_from_local
from haltere.flight.log import FlightLog, Stream

__all__ = ["captured", "indiflight"]

#: Rates [Hz] and noise of what `indiflight` makes of the capture: 1 sigma of velocity [m/s], position [m] and each axis of the field [uT].
GNSS_RATE, COMPASS_RATE = 10.0, 20.0
VELOCITY, POSITION, FIELD = 0.1, 0.3, 0.8
#: The field that the made compass sees, north being that of the capture: any will do that is said to the filter [uT].
FIELD_N = np.array([20.0, 0.0, 43.0])
#: Where the capture's origin is said to be: any will do.
PLACE = (52.0, 4.37, 0.0)
#: Rotation vector [deg] from the body of the capture's markers to that of the IMU: solved (Wahba) from the specific force and rates of both
#: over LOG00267 and LOG00281, which agree within 0.7 deg; the markers sat otherwise in LOG00230.
MARKERS = {"LOG00230": (1.6, -0.8, -1.0)}
MARKERS_ELSE = (5.8, -1.6, -1.5)


def _truth(flight: FlightLog, path: Path) -> Stream:
    """The capture with its attitude turned to the IMU's axes, updates that hold numbers and go on in time."""
    truth = flight["truth"]
    good = np.isfinite(truth.vector("pos", "ned")).all(axis=1) & np.isfinite(truth.vector("q", "wxyz")).all(axis=1)
    truth = truth.where(good & np.r_[True, np.diff(truth.t) > 0.0])
    turned = Rotation.from_rotvec(next((v for k, v in MARKERS.items() if k in path.name), MARKERS_ELSE), degrees=True)
    q = (Rotation.from_quat(truth.vector("q", "wxyz")[:, [1, 2, 3, 0]]) * turned.inv()).as_quat()[:, [3, 0, 1, 2]]
    return Stream({**truth.columns, **{f"q_{a}": q[:, i] for i, a in enumerate("wxyz")}})


def _gnss(truth: Stream, velocity: float, position: float, rng: np.random.Generator, stated: tuple[float, float]) -> Stream:
    n = len(truth)
    pos = truth.vector("pos", "ned") + position * rng.standard_normal((n, 3))
    vel = truth.vector("vel", "ned") + velocity * rng.standard_normal((n, 3))
    lat, lon, alt = geodetic_from_local(pos[:, 0], pos[:, 1], pos[:, 2], *PLACE)
    accuracy = {"s_acc": np.full(n, stated[0]), "h_acc": np.full(n, stated[1]), "v_acc": np.full(n, stated[1])}
    return Stream({"t": truth.t, "lat": lat, "lon": lon, "alt": alt, **{f"vel_{a}": vel[:, i] for i, a in enumerate("ned")}, **accuracy})


def _every(truth: Stream, rate: float) -> Stream:
    """The first update of each interval of 1/rate."""
    return truth.where(np.r_[True, np.diff(np.floor(truth.t * rate)) > 0])


def indiflight(path: Path, seed: int = 1) -> FlightLog:
    """A flight of indiflight's quadrotor, 500 Hz, with ``gnss`` and ``magnetometer`` made of the motion capture, decimated and noised.

    The vehicle has neither. The capture (17 to 20 updates a second, stamped when they came in) stays as ``truth``, its attitude turned
    to the IMU's axes. No delay is taken out: capture and IMU agree within the capture's spacing.
    """
    flight, rng = haltere.read(path), np.random.default_rng(seed)
    truth = _truth(flight, path)
    gnss = _gnss(_every(truth, GNSS_RATE), VELOCITY, POSITION, rng, (VELOCITY, POSITION))
    seen = _every(truth, COMPASS_RATE)
    field_b = Rotation.from_quat(seen.vector("q", "wxyz")[:, [1, 2, 3, 0]]).inv().apply(FIELD_N)
    field_b += FIELD * rng.standard_normal(field_b.shape)
    magnetometer = Stream({"t": seen.t, **{f"mag_{a}": field_b[:, i] for i, a in enumerate("xyz")}})
    field = {"declination": 0.0, "dip": float(np.arctan2(FIELD_N[2], FIELD_N[0])), "strength": float(np.linalg.norm(FIELD_N))}
    meta = dataclasses.replace(flight.meta, name=path.stem[-8:], field=field)
    note = f"gnss and magnetometer are made of the motion capture, decimated and noised, seed {seed}"
    return FlightLog({**flight.streams, "truth": truth, "gnss": gnss, "magnetometer": magnetometer}, meta, [*flight.notes, note])


def captured(path: Path, seed: int = 1) -> FlightLog:
    """The same with all of the capture as GNSS (noise 0.02 m, 0.05 m/s) and told attitude: what identifying a vehicle in a hall has."""
    flight = haltere.read(path)
    truth = _truth(flight, path)
    streams = {
        "imu": flight["imu"], "rotors": flight["rotors"], "gnss": _gnss(truth, 0.05, 0.02, np.random.default_rng(seed), (0.07, 0.05)),
        "attitude": Stream({"t": truth.t, **{f"q_{a}": truth[f"q_{a}"] for a in "wxyz"}}),
    }  # fmt: skip
    said = "GNSS and attitude are motion capture, with noise added"
    return FlightLog(streams, dataclasses.replace(flight.meta, name=path.stem[-5:], source=f"indiflight; {said}, seed {seed}"), [said])
