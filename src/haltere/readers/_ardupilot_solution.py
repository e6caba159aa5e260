"""ArduPilot's own solution, its primary sensors and the simulator's truth in a DataFlash log. It reads no sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haltere.readers._common import DEG, Builder, Columns, IntArray, merge_rows, q_from_euler
from haltere.readers._dataflash import DataFlash, Messages

__all__ = ["add_solution", "add_truth", "primary"]

#: Index fields of XKFS (today) and XKF2/NKF2 by sensor.
INDEX_FIELDS = {"imu": "", "mag": "MI", "baro": "BI", "gps": "GI", "airspeed": "AI"}


def _family(log: DataFlash, params: dict[str, float]) -> str | None:
    """Prefix of the estimator in charge: XKF (EKF3) or NKF (EKF2), by parameter, else by what is there."""
    kind = int(params.get("AHRS_EKF_TYPE", -1))
    wanted = {2: "NKF", 3: "XKF"}.get(kind)
    there = [p for p in ("XKF", "NKF") if log.get(f"{p}1") is not None]
    if kind == 0:
        return None
    return wanted if wanted in there else (there[0] if there else None)


def _lanes(log: DataFlash, family: str, number: int) -> dict[int, Messages]:
    """One message of the estimator by lane: by the field C, else lane 1 has numbers higher by five."""
    first = log.get(f"{family}{number}")
    if first is None:
        return {}
    core = first.integers("C")
    if core is not None:
        return {int(c): first.where(core == c) for c in np.unique(core)}
    second = log.get(f"{family}{number + 5}") if number < 5 else None
    return {0: first} | ({1: second} if second is not None else {})


def _in_charge(log: DataFlash, family: str) -> tuple[IntArray, IntArray] | None:
    """Times [us] and number of the primary lane, sorted."""
    status = log.get(f"{family}4")
    lane = status.integers("PI") if status is not None else None
    if status is None or lane is None:
        return None
    us = log.us(status)
    order = np.argsort(us, kind="stable")
    return us[order], lane[order]


def _rows_in_charge(us: IntArray, lane: int, charge: tuple[IntArray, IntArray] | None) -> NDArray[np.bool_]:
    """Rows of a lane at which it was the primary one; without that knowledge, lane 0's."""
    if charge is None:
        return np.full(len(us), lane == 0)
    at = np.clip(np.searchsorted(charge[0], us, side="right") - 1, 0, None)
    # States and status of one pass bear one stamp.
    return np.asarray(charge[1][at] == lane)


def _usual(values: IntArray) -> int:
    found, counts = np.unique(values, return_counts=True)
    return int(found[np.argmax(counts)])


def primary(log: DataFlash, params: dict[str, float], sensor: str) -> int | None:
    """Instance of a sensor (``imu``, ``mag``, ``baro``, ``gps``, ``airspeed``) that the primary lane mostly used, or None if unknown."""
    family = _family(log, params)
    if family is None:
        return None
    charge = _in_charge(log, family)
    lane = _usual(charge[1]) if charge is not None else 0
    if sensor == "imu":
        mask = int(params.get("EK3_IMU_MASK" if family == "XKF" else "EK2_IMU_MASK", 0))
        units = [i for i in range(8) if mask >> i & 1]
        return units[lane] if lane < len(units) else lane
    field = INDEX_FIELDS[sensor]
    for name, number in ((f"{family}S", None), (f"{family}2", 2)):
        lanes = _lanes(log, family, number) if number else _by_core(log.get(name))
        used = lanes.get(lane)
        index = used.integers(field) if used is not None else None
        if index is not None and len(index):
            return _usual(index)
    return None


def _by_core(messages: Messages | None) -> dict[int, Messages]:
    if messages is None:
        return {}
    core = messages.integers("C")
    return {0: messages} if core is None else {int(c): messages.where(core == c) for c in np.unique(core)}


def _attitude(messages: Messages) -> Columns:
    return q_from_euler(*(np.radians(messages.get(angle)) for angle in ("Roll", "Pitch", "Yaw")))


def add_solution(log: DataFlash, builder: Builder, params: dict[str, float]) -> None:
    """The stream ``onboard``: rows at the stamps of every message that carries a part of the solution."""
    family = _family(log, params)
    has_origin = _set_origin(log, builder)
    pieces: list[tuple[IntArray, Columns]] = []
    if family is not None:
        charge = _in_charge(log, family)
        for lane, states in _lanes(log, family, 1).items():
            us = log.us(states)
            mine = _rows_in_charge(us, lane, charge)
            states, us = states.where(mine), us[mine]
            columns = _attitude(states) | {f"vel_{a}": states.get(f"V{a.upper()}") for a in "ned"}
            if has_origin:
                columns |= {f"pos_{a}": states.get(f"P{a.upper()}") for a in "ned"}
            columns |= {f"gyro_bias_{a}": states.get(f"G{a.upper()}") * DEG for a in "xyz"}
            pieces.append((us, columns))
        for lane, states in _lanes(log, family, 2).items():
            us = log.us(states)
            mine = _rows_in_charge(us, lane, charge)
            states, us = states.where(mine), us[mine]
            columns = {"wind_n": states.get("VWN"), "wind_e": states.get("VWE")}
            columns |= {f"accel_bias_{a}": states.get(f"A{a.upper()}") for a in "xyz"}
            if "AZbias" in states:
                columns["accel_bias_z"] = states.get("AZbias") * 0.01  # whole cm/s^2
            pieces.append((us, columns))
        for lane, states in _lanes(log, family.replace("KF", "KV"), 2).items():
            us = log.us(states)
            mine = _rows_in_charge(us, lane, charge) if "C" in states else np.ones(len(us), bool)  # else logged of the primary lane only
            variances = {f"sd_wind_{a}": states.get(f"V{k}")[mine] for a, k in (("n", 22), ("e", 23))}
            pieces.append((us[mine], {name: np.sqrt(np.where(v > 0.0, v, np.nan)) for name, v in variances.items()}))
        _drop_no_wind(pieces, builder)
        if not has_origin:
            builder.note("onboard has no pos_n, pos_e, pos_d: the log has no ORGN message, so their origin is unknown")
    else:
        attitude = log.get("ATT")
        if attitude is not None:
            pieces.append((log.us(attitude), _attitude(attitude)))
            builder.note("onboard attitude is ATT: the log has no EKF2 or EKF3 states in charge")
    position = log.get("POS")
    if position is not None:
        pieces.append((log.us(position), {"lat": position.get("Lat"), "lon": position.get("Lng"), "alt": position.get("Alt")}))
    us, merged = merge_rows(pieces)
    builder.add("onboard", us, merged)


def _drop_no_wind(pieces: list[tuple[IntArray, Columns]], builder: Builder) -> None:
    """A wind of exactly zero from beginning to end was never estimated: the states are not in use on every vehicle."""
    winds = [columns[name] for _, columns in pieces for name in ("wind_n", "wind_e") if name in columns]
    if winds and not any(np.nan_to_num(w).any() for w in winds):
        for _, columns in pieces:
            for name in ("wind_n", "wind_e", "sd_wind_n", "sd_wind_e"):
                columns.pop(name, None)
        builder.note("onboard wind is zero throughout, so the autopilot did not estimate it: left out")


def _set_origin(log: DataFlash, builder: Builder) -> bool:
    """Home of the flight is the estimator's origin, to which its positions refer."""
    origins = log.get("ORGN")
    if origins is None:
        return False
    kind = origins.integers("Type")
    mine = np.flatnonzero(kind == 0) if kind is not None else np.arange(len(origins))
    lat, lon, alt = origins.get("Lat"), origins.get("Lng"), origins.get("Alt")
    mine = mine[(lat[mine] != 0.0) | (lon[mine] != 0.0)]
    if not len(mine):
        return False
    i = mine[-1]
    builder.set_home(lat[i], lon[i], alt[i])
    if np.ptp(lat[mine]) > 1e-5 or np.ptp(lon[mine]) > 1e-5 or np.ptp(alt[mine]) > 1.0:
        builder.note("the estimator's origin was set more than once at different places: home is the last one")
    return True


def add_truth(log: DataFlash, builder: Builder) -> None:
    """The stream ``truth`` of a simulated flight (SIM, SIM2)."""
    pieces: list[tuple[IntArray, Columns]] = []
    sim, sim2 = log.get("SIM"), log.get("SIM2")
    if sim is not None:
        pieces.append((log.us(sim), _attitude(sim) | {"lat": sim.get("Lat"), "lon": sim.get("Lng"), "alt": sim.get("Alt")}))
    if sim2 is not None:
        pieces.append((log.us(sim2), {f"vel_{a}": sim2.get(f"V{a.upper()}") for a in "ned"}))
    us, merged = merge_rows(pieces)
    builder.add("truth", us, merged)
