"""`run`: a whole log through an estimator, the only loop over a log. It computes no formula of its own."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.aids.compass import OUT_APART, OUT_FIELD, OUT_STEP, OUT_TURN
from haltere.aids.record import AID_RECORD, COMPONENTS, EVENTS, N_QUEUED, REASONS, SENSORS, STATUSES, YAW_BANK
from haltere.diagnosis.findings import findings
from haltere.errors import HaltereError, UsageError
from haltere.estimators.base import InitialState, new_state
from haltere.estimators.inputs import Measurements, configure, imu_arrays, measurements, parameters, request
from haltere.estimators.lumped import Lumped
from haltere.estimators.registry import SPECIFICATIONS, kernels_of
from haltere.estimators.rotors import model_of, rotor_speeds
from haltere.estimators.smoother import node_width, smoothed
from haltere.estimators.step import COVARIANCE_ROWS
from haltere.estimators.verdicts import VERDICTS, verdict
from haltere.flight.config import Config
from haltere.flight.corrections import correct, on_unit
from haltere.flight.door import Checked, check, fit
from haltere.flight.local import geodetic_from_local
from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.flight.vehicle import Vehicle
from haltere.metrics import control
from haltere.metrics.disturbance import describe, disturbances
from haltere.metrics.faults import findings as inertial_findings
from haltere.metrics.faults import tell
from haltere.metrics.summary import summarise
from haltere.metrics.units import better, stations
from haltere.metrics.units import events as differences
from haltere.strapdown.layout import IMU_CAPACITY

__all__ = ["run", "usable"]

FloatArray = NDArray[np.float64]
#: IMU samples between two looks at progress, and room for aid records between two drains.
CHUNK, AID_ROOM = 20000, 60000
#: What a disturbed compass may be instead: a compass that turns against the gyro is as well a gyro that turns against the compass.
CANDIDATES = {OUT_TURN: ["magnetometer", "gyro.z"], OUT_FIELD: ["magnetometer"], OUT_APART: ["magnetometer"], OUT_STEP: ["magnetometer"]}


def run(
    flight: FlightLog,
    estimator: str = "navigator",
    *,
    preset: str = "default",
    config: Config | Mapping[str, Any] | str | Path | None = None,
    set: Mapping[str, Any] | None = None,
    vehicle: str | Path | Vehicle | Lumped | None = None,
    smooth: bool = False,
    rate: float | None = None,
    initial: InitialState | None = None,
    progress: Callable[[float], None] | None = None,
    scored: bool = True,
) -> Solution:
    """Run an estimator over a flight.

    Parameters
    ----------
    flight
        The log. Streams ``onboard`` and ``truth`` are compared with afterwards and never read by the estimator.
    estimator
        ``navigator``, ``ahrs``, ``two-stage`` or ``wind-attitude``.

    Other Parameters
    ----------------
    preset
        Named set of parameters.
    config
        Configuration file, `Config` or mapping of keys.
    set
        Single keys to change, over everything else.
    vehicle
        Vehicle file with the force and moment model that ``haltere identify`` finds, or what was read from it.
    smooth
        Smooth the run too (fixed-interval): ``solution.smoothed``.
    rate
        Rows a second of the solution; decimates, does not interpolate.
    initial
        State to begin from instead of aligning.
    progress
        Called with the fraction done, between chunks.
    scored
        Whether the summary holds errors, NEES and the tables of sensors too; without them for who scores many runs otherwise.

    Returns
    -------
    Solution
        Row t is the state at t after every measurement valid at or before t, whenever it arrived. Rows begin at alignment.

    Raises
    ------
    HaltereError
        The log cannot be navigated on, or the filter never aligned; the message says why and what to do.
    UsageError
        Unknown estimator, preset or key, or something asked for that is not there.
    """
    model = None if vehicle is None else model_of(vehicle, estimator)
    if rate is not None and not (math.isfinite(rate) and rate > 0.0):
        raise UsageError("a positive number of rows a second", repr(rate), "--rate")
    began = time.perf_counter()
    asked = request(flight, estimator, preset, config, set)
    if smooth and asked["magnetometer.refine"] == "on":
        raise UsageError("magnetometer.refine=off with a smoothed run", "on", "--smooth", "the smoother does not know those states yet")
    attitude_only = asked["wind_attitude.filter"] == "quaternion"
    if smooth and attitude_only:
        raise UsageError("no smoothing of the published filter", f"{estimator}, preset {preset}", "--smooth", "preset default has it")
    specification = SPECIFICATIONS[estimator]
    if smooth and not getattr(specification, "SMOOTHS", True):
        raise UsageError(
            f"no smoothing of {estimator}", "--smooth", "run", "a federated filter cannot be taken back in time; navigator can"
        )
    if smooth and model is not None:
        raise UsageError(
            "a smoothed run without a vehicle's model", str(vehicle)[:60], "--smooth", "the smoother does not know its states yet"
        )
    if model is None and getattr(specification, "REQUIRES_VEHICLE", False):
        raise UsageError(
            "a vehicle file with [lumped]", "none", f"run of {estimator}",
            "it predicts motion from rotor speeds: haltere identify LOG... --out vehicle.toml makes it, --vehicle vehicle.toml gives it",
        )  # fmt: skip
    flight = correct(flight, asked.values)
    blind = flight.without("onboard", "truth")
    checked = check(blind, upright=estimator != "ahrs", given=asked.values)
    resolved = configure(blind, checked, estimator, preset, asked)
    t, gyro, accel = imu_arrays(blind, checked)
    offered = measurements(blind, checked, resolved)
    if model is not None:
        heard = rotor_speeds(checked.streams, model, t)
        offered.rotor_t, offered.rotor_speed = heard.t, heard.speed
    prepared = time.perf_counter()

    S, prm = new_state(resolved, initial, model), parameters(resolved)
    cov = np.empty((COVARIANCE_ROWS, min(int((t[-1] - t[0]) / 0.1), len(t)) + 64))
    rows, aids_parts, events, nodes = _loop(S, prm, t, gyro, accel, offered, cov, progress, smooth)
    filtered = time.perf_counter()

    n = rows.shape[1]
    if n == 0:
        raise HaltereError(
            "an alignment (a second at rest, or motion with GNSS velocity, or five seconds of any motion)",
            f"{t[-1] - t[0]:.1f} s of IMU that allowed none", f"{flight.meta.name or 'flight'}: initial alignment",
            "give the estimator a longer stretch of data, or an initial state",
        )  # fmt: skip
    table = _attitude(rows) if attitude_only else _table(rows, S, specification.POSITION)
    if rate is not None:
        keep = _decimate(table["t"], rate)
        table = {name: column[keep] for name, column in table.items()}
    solution = Solution(table, _aid_table(aids_parts), events, resolved, {}, _covariance(cov, int(S["n_cov"][0])))
    shown = fit(flight, checked)  # counts what it leaves out: before the facts are gathered
    facts = _facts(flight, checked, S, offered, n, t, began, prepared, filtered)
    if smooth:
        began = time.perf_counter()
        back, back_cov, lost = smoothed(S, prm, rows, nodes, t, gyro, accel, solution.covariance["t"])
        facts["timings"]["smooth_s"] = time.perf_counter() - began
        table = _table(back, S, specification.POSITION)
        if rate is not None:
            table = {name: column[keep] for name, column in table.items()}
        solution.smoothed = Solution(table, solution.aids, events, resolved, {}, _covariance(back_cov, back_cov.shape[1]))
        if lost:
            facts["warnings"].append(f"smoothed: {lost} times what came after could not be used; what is before was smoothed by itself")
    if scored and disturbances(solution.events):
        describe(solution, shown, _unwatched(resolved, initial, model, t, gyro, accel, offered, solution.t))
    if scored and estimator == "navigator" and resolved["diagnosis.inertial"] == "on" and inertial_findings(solution.events):
        solution.without = _without(resolved, initial, model, t, gyro, accel, offered)
        tell(solution)
    if scored and len(stations(flight)) > 1 and not attitude_only:
        solution.events += _units(flight, resolved, initial, model, offered, solution.events)
    if scored and model is None and specification.POSITION and not attitude_only:
        solution.events += control.events(flight, solution)
    summarise(solution, shown, facts, scored)
    for name, stream in flight.streams.items():  # as read, before anything was left out
        solution.summary["streams"][name]["n"] = len(stream)
    return solution


def usable(flight: FlightLog, config: Config) -> FlightLog:
    """A flight as a run with this configuration took it: corrected, in order and without what cannot be used; for what shows a run."""
    flight = correct(flight, config.values)
    return fit(flight, check(flight.without("onboard", "truth"), upright=config.estimator != "ahrs", given=config.values))


def _loop(
    S: NDArray[np.void],
    prm: NDArray[np.void],
    t: FloatArray,
    gyro: FloatArray,
    accel: FloatArray,
    m: Measurements,
    cov: FloatArray,
    progress: Callable[[float], None] | None,
    smooth: bool,
) -> tuple[FloatArray, list[NDArray[np.void]], list[dict[str, Any]], FloatArray]:
    """Drive the compiled step over the whole log, draining rows, records and events between chunks; rows come back as columns.

    The last of what comes back is the tape for smoothing, empty where none is wanted.
    """
    kernels = kernels_of(S)
    width = int(kernels.row_width(S["P"].shape[1]))
    columns = np.empty((width, len(t)))
    chunk = np.empty((CHUNK + 4 * IMU_CAPACITY, width))
    aids = as_records(np.empty(AID_ROOM, AID_RECORD))
    parts: list[NDArray[np.void]] = []
    events: list[dict[str, Any]] = []
    # room for all nodes of most flights, so that nothing need be copied: a node a measurement, some a second beside; more makes more tapes
    room = len(m.t) + int(60.0 * (t[-1] - t[0])) + 8 * IMU_CAPACITY if smooth else 0
    tape = np.empty((room, node_width(S["P"].shape[1])))
    tapes: list[FloatArray] = []
    filled = 0

    def drain() -> None:
        nonlocal filled
        n = int(S["n_rows"][0])
        columns[:, filled : filled + n] = chunk[:n].T
        filled += n
        S["n_rows"] = 0
        _drain(S, aids, parts, events)
        if S["n_nodes"][0] > room - 4 * IMU_CAPACITY:
            tapes.append(tape[: int(S["n_nodes"][0])].copy())
            S["n_nodes"] = 0

    stage = kernels.stage_of(S)
    i = j = 0
    while i < len(t) or S["imu_n"][0] > 0:
        i, j = kernels.run_chunk(
            S,
            prm,
            t,
            gyro,
            accel,
            i,
            min(i + CHUNK, len(t)),
            m.kind,
            m.t,
            m.z,
            m.r,
            j,
            chunk,
            cov,
            aids,
            tape,
            stage,
            m.rotor_t,
            m.rotor_speed,
        )
        drain()
        if progress is not None:
            progress(i / len(t))
    nodes = tape[: int(S["n_nodes"][0])]
    return columns[:, :filled], parts, events, np.concatenate([*tapes, nodes]) if tapes else nodes


def _unwatched(
    config: Config, initial: InitialState | None, model: Lumped | None, t: FloatArray, gyro: FloatArray, accel: FloatArray, m: Measurements,
    at: FloatArray,
) -> FloatArray:  # fmt: skip
    """Heading [rad] at the times ``at`` (k,) of the same filter hearing its compass to the end: what a disturbance would have done."""
    deaf = config.changed(aid__compass_watch="off")
    rows = _loop(new_state(deaf, initial, model), parameters(deaf), t, gyro, accel, m, np.empty((COVARIANCE_ROWS, 0)), None, False)[0]
    w, x, y, z = rows[1:5]
    yaw = np.unwrap(np.arctan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z))
    return np.asarray(np.interp(at, rows[0], yaw)) if rows.shape[1] else np.full(len(at), np.nan)


def _without(
    config: Config, initial: InitialState | None, model: Lumped | None, t: FloatArray, gyro: FloatArray, accel: FloatArray, m: Measurements
) -> Solution:
    """The same run with no inertial fault named, ten rows a second."""
    plain = config.changed(diagnosis__inertial="off")
    S = new_state(plain, initial, model)
    rows, _, events, _ = _loop(S, parameters(plain), t, gyro, accel, m, np.empty((COVARIANCE_ROWS, 0)), None, False)
    table = _table(np.ascontiguousarray(rows[:, _decimate(rows[0], 10.0)]), S, True)
    return Solution(table, {}, events, plain)


def _units(
    flight: FlightLog, config: Config, initial: InitialState | None, model: Lumped | None, m: Measurements, told: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Events of further inertial units; of two that differ both are run by themselves, with nothing taken back."""
    plain = config.changed(diagnosis__inertial="off")
    runs: dict[str, dict[str, NDArray[Any]]] = {}

    def aids(stream: str) -> dict[str, NDArray[Any]]:
        if stream not in runs:
            blind = on_unit(flight, stream).without("onboard", "truth")
            t, gyro, accel = imu_arrays(blind, check(blind, upright=config.estimator != "ahrs", given=config.values))
            begin = new_state(plain, initial, model)
            parts = _loop(begin, parameters(plain), t, gyro, accel, m, np.empty((COVARIANCE_ROWS, 0)), None, False)[1]
            runs[stream] = _aid_table(parts)
        return runs[stream]

    def likelier(other: str, onset: float, until: float) -> float | None:
        try:
            return better(aids("imu"), aids(other), onset, until)
        except HaltereError:
            return None

    return differences(flight, likelier, told)


def _drain(S: NDArray[np.void], aids: NDArray[np.void], parts: list[NDArray[np.void]], events: list[dict[str, Any]]) -> None:
    """Move records and events out of the buffers of fixed size."""
    if S["n_aids"][0]:
        parts.append(aids[: int(S["n_aids"][0])].copy())
        S["n_aids"] = 0
    for e in S["event"][0, : int(S["n_events"][0])]:
        kind = EVENTS[int(e["code"])]
        if kind in ("fault", "suspect", "over", "alarm"):
            findings(kind, e, events)
            continue
        if kind in VERDICTS:
            verdict(kind, e, S, events)
            continue
        named = kind in ("reset", "timeout", "recovered", "disturb")
        sensor = SENSORS[int(e["sensor"])] if named else ("imu" if kind == "gap" else "filter")
        events.append(_event(kind, sensor, e, int(e["sensor"]) == YAW_BANK))
    S["n_events"] = 0


def _event(kind: str, sensor: str, record: np.void, bank: bool) -> dict[str, Any]:
    t, value, threshold = float(record["t"]), float(record["value"]), float(record["threshold"])
    code, detail = int(value) if math.isfinite(value) else 0, int(record["detail"])
    turned, allowed = f"{math.degrees(value):.0f} deg", f"{math.degrees(threshold):.0f} deg"
    how = {1: "at rest", 2: "in motion, from GNSS velocity", 3: "from gravity alone", 4: "in motion, from two turns of GNSS velocity"}
    evidence = {
        "aligned": f"initial alignment {how.get(code, '')}",
        "realigned": f"aligned anew {how.get(code, '')}",
        "reset": f"yaw set from GNSS velocity, turned by {math.degrees(value):.0f} deg" if bank else "first measurement sets the state",
        "disturb": {
            OUT_TURN: f"the compass turned by {turned} against the gyro; {allowed} are allowed",
            OUT_FIELD: "strength or dip of the field are not those of before, or not the Earth's",
            OUT_STEP: f"the compass steps by {turned} at once and stays there, which the gyro does not; {allowed} are allowed",
            OUT_APART: f"the compass is {turned} off the heading that everything else holds; {allowed} are allowed",
        }.get(detail, ""),
        "recovered": f"agrees again, {value:.1f} s after the onset",
        "timeout": f"refused for {value:.1f} s, let in again at the gate's edge",
        "gap": f"{value:.2f} s without IMU samples",
        "diverged": "state or covariance not finite or not positive",
    }.get(kind, kind)
    return {
        "sensor": sensor, "axis": None, "kind": kind, "t_onset": float(record["onset"]), "t_detected": float(record["seen"]),
        "t_isolated": t if kind == "disturb" and detail == OUT_STEP else None,
        "t_recovered": None, "candidates": CANDIDATES.get(detail, []) if kind == "disturb" else [], "statistic": value,
        "threshold": threshold if math.isfinite(threshold) else None, "evidence": evidence,
    }  # fmt: skip


def _table(rows: FloatArray, S: NDArray[np.void], position: bool) -> dict[str, FloatArray]:
    """Columns of the solution from the raw output rows; variances become standard deviations in place."""
    out = {"t": rows[0]} | {f"q_{a}": rows[1 + k] for k, a in enumerate("wxyz")}
    sd_roll, sd_pitch, sd_yaw = _euler_sd(rows[1:5], rows[17:23])
    np.sqrt(rows[23:35], out=rows[23:35])
    if position:
        out |= {f"vel_{a}": rows[5 + k] for k, a in enumerate("ned")}
        out |= {f"pos_{a}": rows[8 + k] for k, a in enumerate("ned")}
        if S["has_origin"][0]:
            out["lat"], out["lon"], out["alt"] = geodetic_from_local(rows[8], rows[9], rows[10], *(float(x) for x in S["origin"][0]))
    out |= {f"gyro_bias_{a}": rows[11 + k] for k, a in enumerate("xyz")}
    values, deviations = _optional(rows, S)
    if position:
        out |= {f"accel_bias_{a}": rows[14 + k] for k, a in enumerate("xyz")}
        out |= values
    out |= {"sd_roll": sd_roll, "sd_pitch": sd_pitch, "sd_yaw": sd_yaw}
    if position:
        out |= {f"sd_vel_{a}": rows[23 + k] for k, a in enumerate("ned")}
        out |= {f"sd_pos_{a}": rows[26 + k] for k, a in enumerate("ned")}
    out |= {f"sd_gyro_bias_{a}": rows[29 + k] for k, a in enumerate("xyz")}
    if position:
        out |= {f"sd_accel_bias_{a}": rows[32 + k] for k, a in enumerate("xyz")}
        out |= deviations
    return out


#: Columns of the optional states in the order of `haltere.strapdown.optional`; those in `_LOGARITHMIC` are states as logarithms,
#: those without a name are not given out.
_OPTIONAL = {
    "baro": ("baro_bias",),
    "mag": ("mag_offset_x", "mag_offset_y", "mag_offset_z"),
    "wind": ("wind_n", "wind_e", "wind_d"),
    "drag": ("drag_mu", "drag_c", "drag_offset_x", "drag_offset_y"),
    "steady": ("", ""),
    "vane": ("airspeed_scale", "aoa_offset", "sideslip_offset"),
    "twist": ("", "", ""),
}
_LOGARITHMIC = ("drag_mu", "drag_c", "airspeed_scale")


def _optional(rows: FloatArray, S: NDArray[np.void]) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Columns of the optional states, and of their standard deviations, from the raw output rows."""
    names = [name for block, columns in _OPTIONAL.items() for name in columns[: S[block].shape[1]]]
    values: dict[str, FloatArray] = {}
    deviations: dict[str, FloatArray] = {}
    for i, name in enumerate(names):
        if not name:  # kept inside
            continue
        value, sd = rows[35 + i], rows[35 + len(names) + i]
        np.sqrt(np.maximum(sd, 0.0, out=sd), out=sd)
        if name in _LOGARITHMIC:
            np.exp(value, out=value)
            sd *= value
        values[name], deviations[f"sd_{name}"] = value, sd
    if S["ft"].shape[1]:  # in the last columns, see `haltere.estimators.federated_step.row_width`
        for i, name in enumerate(("wind_n", "wind_e")):
            values[name], deviations[f"sd_{name}"] = rows[-4 + i], np.sqrt(np.maximum(rows[-2 + i], 0.0))
    return values, deviations


def _attitude(rows: FloatArray) -> dict[str, FloatArray]:
    """Columns of a filter that estimates nothing else."""
    sd = _euler_sd(rows[1:5], rows[17:23])
    q = {f"q_{a}": rows[1 + k] for k, a in enumerate("wxyz")}
    return {"t": rows[0]} | q | dict(zip(("sd_roll", "sd_pitch", "sd_yaw"), sd, strict=True))


def _euler_sd(q: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """1 sigma of roll, pitch, yaw [rad] from the body-frame error covariance, first order, at most pi.

    δ(roll, pitch, yaw) = W δθ with W = [1, sinφ tanθ, cosφ tanθ; 0, cosφ, -sinφ; 0, sinφ/cosθ, cosφ/cosθ].
    ``q`` is (4, n), ``P`` the upper triangle (6, n).
    """
    w, x, y, z = q
    s2, c2 = 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z  # cosθ sinφ, cosθ cosφ
    cos2 = np.maximum(s2 * s2 + c2 * c2, 1e-12)
    sin_pitch = 2.0 * (w * y - x * z)
    p_s = P[3] * s2 * s2 + 2.0 * P[4] * s2 * c2 + P[5] * c2 * c2
    yaw = p_s / (cos2 * cos2)
    k = sin_pitch / cos2
    roll = P[0] + 2.0 * k * (P[1] * s2 + P[2] * c2) + k * k * p_s
    pitch = (P[3] * c2 * c2 - 2.0 * P[4] * s2 * c2 + P[5] * s2 * s2) / cos2
    pole = cos2 <= 1e-8  # there roll and yaw are one angle, and the first order has ended
    roll, yaw = np.where(pole, math.pi**2, roll), np.where(pole, math.pi**2, yaw)
    pitch = np.where(pole, 0.5 * (P[3] + P[5]), pitch)
    sd = [np.minimum(np.sqrt(np.maximum(v, 0.0)), math.pi) for v in (roll, pitch, yaw)]
    return sd[0], sd[1], sd[2]


def _decimate(t: FloatArray, rate: float) -> NDArray[np.bool_]:
    """First row of each interval of 1/rate."""
    slot = np.floor((t - t[0]) * rate + 1e-6)
    return np.asarray(np.r_[True, np.diff(slot) > 0.0], dtype=np.bool_)


def _aid_table(parts: list[NDArray[np.void]]) -> dict[str, NDArray[Any]]:
    """Columns of ``aids.parquet``, in order of valid time."""
    a = np.concatenate(parts) if parts else np.empty(0, AID_RECORD)
    a = a[np.argsort(a["t"], kind="stable")]
    out: dict[str, NDArray[Any]] = {"t": np.ascontiguousarray(a["t"])}
    out["sensor"] = np.array(SENSORS)[a["sensor"]]
    out["component"] = np.array(COMPONENTS)[a["component"]]
    for name in ("observation", "innovation", "innovation_sd", "test_ratio", "weight"):
        out[name] = np.ascontiguousarray(a[name])
    out["status"] = np.array(STATUSES)[a["status"]]
    out["reason"] = np.array(REASONS)[a["reason"]]
    return out


def _covariance(cov: FloatArray, n: int) -> dict[str, FloatArray]:
    """Core blocks (m, 3, 3) by name."""
    out = {"t": cov[0, :n].copy()}
    where = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    for b, name in enumerate(("attitude", "velocity", "position", "gyro_bias", "accel_bias")):
        out[name] = np.ascontiguousarray(cov[1 + 6 * b : 7 + 6 * b, :n].T[:, where])
    if n and not np.isfinite(cov[7, :n]).any():  # attitude alone
        return {"t": out["t"], "attitude": out["attitude"]}
    if np.isfinite(cov[31, :n]).any():
        out["baro_bias"] = np.ascontiguousarray(cov[31, :n].reshape(-1, 1, 1))
    if np.isfinite(cov[32, :n]).any():
        wind = cov[32:38, :n].T[:, where]
        out["wind"] = np.ascontiguousarray(wind if np.isfinite(cov[37, :n]).any() else wind[:, :2, :2])
    if np.isfinite(cov[32, :n]).any():
        wind = cov[32:38, :n].T[:, where]
        out["wind"] = np.ascontiguousarray(wind if np.isfinite(cov[37, :n]).any() else wind[:, :2, :2])
    return out


def _facts(
    flight: FlightLog,
    checked: Checked,
    S: NDArray[np.void],
    m: Measurements,
    n: int,
    t: FloatArray,
    began: float,
    prepared: float,
    filtered: float,
) -> dict[str, Any]:
    """What only the run knows, for the summary."""
    lost: dict[str, dict[str, int]] = {k: dict(v) for k, v in checked.discarded.items()}

    def count(stream: str, reason: str, number: int) -> None:
        if number:
            reasons = lost.setdefault(stream, {})
            reasons[reason] = reasons.get(reason, 0) + number

    count("imu", "before alignment", int(S["n_unaligned"][0]))
    count("imu", "refused by the filter", int(S["n_bad"][0]))
    for k in range(N_QUEUED):
        count(SENSORS[k], "later than the fusion horizon", int(S["aid"]["n_late"][0, k]))
        count(SENSORS[k], "queue full before the first IMU sample", int(S["aid"]["n_overflow"][0, k]))
        after = int(S["ring_n"][0, k]) + int(np.count_nonzero((m.kind == k) & (m.t > t[-1])))
        count(SENSORS[k], "after the last IMU sample", after)
    warnings = list(checked.warnings)
    if S["n_ring_full"][0]:
        warnings.append("the fusion horizon was shortened: more IMU samples than the queue holds within the largest delay")
    if S["n_aids_lost"][0] or S["n_events_lost"][0]:
        warnings.append(f"{int(S['n_aids_lost'][0])} aid records and {int(S['n_events_lost'][0])} events did not fit and were lost")
    origin = [float(x) for x in S["origin"][0]] if S["has_origin"][0] else None
    return {
        "origin": origin, "aligned_at": float(S["t_aligned"][0]), "discarded": lost, "warnings": warnings, "gaps": int(S["n_gaps"][0]),
        "steps": int(S["n_steps"][0]), "rows": n, "duration": float(t[-1] - t[0]),
        "timings": {"prepare_s": prepared - began, "filter_s": filtered - prepared},
        "watched": float(S["bank"]["watched"][0, 0]) if "bank" in (S.dtype.names or ()) and S["bank"].shape[1] else None,
    }  # fmt: skip
