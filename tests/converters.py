"""Small converters of foreign recordings for the tests: PX4-ECL replay, InertialNav text files, BROAD. Not part of the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from haltere.flight.log import FlightLog, FlightMeta

DEG = np.pi / 180.0


def _columns(stem: str, vectors: np.ndarray, axes: str = "xyz") -> dict[str, np.ndarray]:
    return {f"{stem}_{a}": vectors[:, k] for k, a in enumerate(axes)}


def ecl_replay(path: Path) -> FlightLog:
    """PX4-ECL replay: lines ``time_us,sensor,values``; imu is accel then gyro, mag in gauss, gps alt [mm], lon, lat [1e-7 deg]."""
    rows: dict[str, list[list[float]]] = {}
    for line in path.read_text().splitlines():
        t, sensor, *values = line.split(",")
        rows.setdefault(sensor, []).append([float(t) * 1e-6, *(float(v) for v in values)])
    a = {k: np.array(v) for k, v in rows.items()}
    imu, mag, baro, gps = a["imu"], a["mag"], a["baro"], a["gps"]
    streams = {
        "imu": {"t": imu[:, 0], **_columns("accel", imu[:, 1:]), **_columns("gyro", imu[:, 4:])},
        "magnetometer": {"t": mag[:, 0]} | {f"mag_{x}": 100.0 * mag[:, 1 + k] for k, x in enumerate("xyz")},
        "barometer": {"t": baro[:, 0], "altitude": baro[:, 1]},
        "gnss": {
            "t": gps[:, 0], "lat": gps[:, 3] * 1e-7, "lon": gps[:, 2] * 1e-7, "alt": gps[:, 1] * 1e-3,
            "vel_n": gps[:, 4], "vel_e": gps[:, 5], "vel_d": gps[:, 6],
        },
    }  # fmt: skip
    return FlightLog(streams, FlightMeta(name=path.stem, source="PX4-ECL replay (simulated)", imu_kind="mean"))


def ekf2_output(path: Path) -> dict[str, np.ndarray]:
    """EKF2's own states: q_nb, velocity and position NED, times [s]; rows before its alignment are left out."""
    a = np.genfromtxt(path, delimiter=",", skip_header=1)
    a = a[np.abs(a[:, 1]) < 0.999999]
    return {"t": a[:, 0] * 1e-6, "q": a[:, 1:5], "vel": a[:, 5:8], "pos": a[:, 8:11], "field": a[:, 17:20], "variance": a[:, 25:49]}


def inertialnav(folder: Path, *, gauss: float) -> FlightLog:
    """InertialNav text files. ``gauss`` is the magnetometer's unit in uT (0.1 for milligauss, 100 for gauss)."""

    def load(name: str) -> np.ndarray:
        return np.loadtxt(folder / f"{name}.txt")

    imu, gps, mag, ntun, att = (load(n) for n in ("IMU", "GPS", "MAG", "NTUN", "ATT"))
    timing = np.loadtxt(folder / "timing.txt")
    course, speed = gps[:, 11] * DEG, gps[:, 10]
    raw = folder / "GPSraw.txt"
    velocity = np.column_stack([speed * np.cos(course), speed * np.sin(course), gps[:, 12]])
    if raw.exists():  # three components as the receiver gave them, instead of speed and course
        fixes = np.loadtxt(raw)
        if len(fixes) == len(gps):
            velocity = fixes[:, 4:7]
    field = mag[:, 2:5] - mag[:, 5:8]
    onboard = {}
    if np.abs(att[:50, 2]).max() < 20.0:  # some of the files have their columns in another order: then there is no reference
        q = _quaternions(att[:, 2:5] * DEG)
        onboard = {"onboard": {"t": att[:, 1] * 1e-3} | {f"q_{x}": q[:, k] for k, x in enumerate("wxyz")}}
    streams = {
        "imu": {"t": imu[:, 1] * 1e-3, **_columns("gyro", imu[:, 2:]), **_columns("accel", imu[:, 5:])},
        "magnetometer": {"t": mag[:, 1] * 1e-3} | {f"mag_{x}": gauss * field[:, k] for k, x in enumerate("xyz")},
        "gnss": {"t": gps[:, 2] * 1e-3, "lat": gps[:, 6], "lon": gps[:, 7], "alt": gps[:, 9], "fix_type": gps[:, 1]}
        | {f"vel_{x}": velocity[:, k] for k, x in enumerate("ned")},
        "barometer": {"t": ntun[:, 1] * 1e-3, "altitude": ntun[:, 8]},
        **onboard,
    }  # fmt: skip
    delays = dict(zip(("gnss_velocity", "gnss_position", "barometer", "magnetometer"), timing[3:7] * 1e-3, strict=True))
    return FlightLog(
        streams, FlightMeta(name=folder.name, source="InertialNav text files", delays={k: float(v) for k, v in delays.items()})
    )


def _quaternions(rpy: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", rpy[:, ::-1]).as_quat()[:, [3, 0, 1, 2]]


def broad(path: Path) -> tuple[FlightLog, dict[str, np.ndarray]]:
    """One BROAD trial: a flight with its sensor axes turned from FLU to FRD, and the raw arrays by the data set's names."""
    from scipy.io import loadmat

    m = loadmat(path, squeeze_me=True)
    raw = {k: np.asarray(m[k]) for k in ("imu_gyr", "imu_acc", "imu_mag", "opt_quat", "movement")}
    rate = float(m["sampling_rate"])
    raw["rate"] = np.array(rate)
    t = np.arange(len(raw["imu_gyr"])) / rate
    turn = np.array([1.0, -1.0, -1.0])
    gyro, accel, mag = (turn * raw[k] for k in ("imu_gyr", "imu_acc", "imu_mag"))
    streams = {
        "imu": {"t": t} | {f"gyro_{x}": gyro[:, k] for k, x in enumerate("xyz")} | {f"accel_{x}": accel[:, k] for k, x in enumerate("xyz")},
        "magnetometer": {"t": t} | {f"mag_{x}": mag[:, k] for k, x in enumerate("xyz")},
    }
    return FlightLog(streams, FlightMeta(name=path.stem, source="BROAD")), raw


def broad_errors(q_enu: np.ndarray, raw: dict[str, np.ndarray]) -> tuple[float, float]:
    """RMS total and inclination error [deg] over the movement phase, rows without truth skipped, no alignment (BROAD's metric)."""
    ref = raw["opt_quat"]
    use = raw["movement"].astype(bool) & np.isfinite(ref).all(axis=1) & np.isfinite(q_enu).all(axis=1)
    a, b = q_enu[use], ref[use]
    # earth-frame error q_e = q_est * conj(q_ref)
    w = np.sum(a * b, axis=1)
    z = -a[:, 0] * b[:, 3] - a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1] + a[:, 3] * b[:, 0]
    total = 2.0 * np.arccos(np.clip(np.abs(w), 0.0, 1.0))
    inclination = 2.0 * np.arccos(np.clip(np.hypot(w, z), 0.0, 1.0))
    return float(np.degrees(np.sqrt(np.mean(total**2)))), float(np.degrees(np.sqrt(np.mean(inclination**2))))


def enu_flu_from_ned_frd(q: np.ndarray) -> np.ndarray:
    """Quaternion body FLU to ENU of q_nb (NED/FRD): inverse of the map in theory-amendments.md §8."""
    c = np.sqrt(0.5)
    return c * np.column_stack([q[:, 0] + q[:, 3], q[:, 1] + q[:, 2], q[:, 1] - q[:, 2], q[:, 0] - q[:, 3]])
