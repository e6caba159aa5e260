"""How many IMU samples a second: our filters whole, their C++ twin, and what others offer, interleaved on one core.

Every peer is called as its own documentation shows. Conversions into a peer's units are made before its clock starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import common
import made
import twin
from common import Table
from haltere.aids.record import AID_RECORD
from haltere.drive import run as run_flight
from haltere.estimators import step as kernels
from haltere.estimators.base import Estimator, new_state
from haltere.estimators.inputs import parameters

ROUNDS = 7
SAMPLES = 100_000
RATE = 1000.0
#: The peer that every ratio is taken to.
YARDSTICK = "vqf.VQF.updateBatch"
FloatArray = NDArray[np.float64]
#: A run gives its seconds and what came out of it, by which tests see that it was called rightly.
Run = Callable[[], tuple[float, Any]]


@dataclass
class Runner:
    """One competitor: what it estimates, how it is called, over how many samples, and the run itself, or why it is not there."""

    name: str
    estimates: str
    called: str
    samples: int
    run: Run | None = None
    reason: str = ""
    fast: bool = False

    def seconds(self) -> float:
        """Seconds of one run."""
        if self.run is None:
            raise RuntimeError(self.reason)
        return self.run()[0]


def filter_run(estimator: str, flight: twin.Flight) -> Run:
    """The compiled filter with everything on: gates, aid records, output rows, queue, rest, yaw bank."""
    config = twin.configuration_of(estimator)
    first, prm = new_state(config, flight.initial(16 if estimator == "navigator" else 15)), parameters(config)
    use = np.isin(flight.kind, [3]) if estimator == "ahrs" else np.ones(len(flight.kind), bool)
    kind, stamp, z, r = flight.kind[use], flight.stamp[use], flight.z[use], flight.r[use]
    n = len(flight.t)
    rows = np.empty((n + 2000, int(kernels.row_width(first["baro"].shape[1]))))
    cov, aids = np.empty((kernels.COVARIANCE_ROWS, n // 50 + 64)), np.empty(6 * len(kind) + 6 * n // 10 + 1000, AID_RECORD)

    def run() -> tuple[float, FloatArray]:
        S = first.copy()
        began = common.clock()
        i = j = 0
        while i < n or S["imu_n"][0] > 0:
            i, j = kernels.run_chunk(
                S,
                prm,
                flight.t,
                flight.gyro,
                flight.accel,
                i,
                n,
                kind,
                stamp,
                z,
                r,
                j,
                rows,
                cov,
                aids,
                np.empty((0, 0)),
                None,
                np.empty(0),
                np.empty((0, 0)),
            )
            S["n_aids"] = S["n_events"] = 0
        seconds = common.clock() - began
        if int(S["n_rows"][0]) != n:
            raise RuntimeError("the filter did not run to the end")
        return seconds, rows[:n, 1:5]

    return run


def whole_run(flight: twin.Flight) -> Run:
    """`haltere.run`: the flight checked and aligned, filtered, and everything put into tables and a summary."""
    log = made.flight_log(flight)

    def run() -> tuple[float, FloatArray]:
        began = common.clock()
        solution = run_flight(log)
        return common.clock() - began, solution.vector("q", "wxyz")

    return run


def step_run(flight: twin.Flight, estimator: str = "navigator") -> Run:
    """One `Estimator.step` a sample from Python; measurements are offered in the same loop, inside the clock."""
    config = twin.configuration_of(estimator)
    n = len(flight.t)
    t, gyro, accel = flight.t.tolist(), [tuple(x) for x in flight.gyro.tolist()], [tuple(x) for x in flight.accel.tolist()]
    offers: list[list[tuple[str, tuple[float, ...]]]] = [[] for _ in range(n)]
    where = np.searchsorted(flight.t, flight.stamp)
    velocity: dict[int, FloatArray] = {}
    for i, kind, z in zip(where.tolist(), flight.kind.tolist(), flight.z, strict=True):
        if kind == 0:
            velocity[i] = z
        elif kind == 1:
            offers[i].append(("gnss", (*z.tolist(), *velocity[i].tolist())))
        elif kind == 3:
            offers[i].append(("magnetometer", tuple(z.tolist())))
    pressure = [
        (i, float(101325.0 * (1.0 - z[0] / 44330.77) ** (1.0 / 0.190263)))
        for i, z in zip(where[flight.kind == 2], flight.z[flight.kind == 2], strict=True)
    ]
    for i, p in pressure:
        offers[int(i)].append(("barometer", (p,)))

    def run() -> tuple[float, FloatArray]:
        est = Estimator(estimator, config, flight.initial(16 if estimator == "navigator" else 15))
        began = common.clock()
        for i in range(n):
            est.step(t[i], gyro[i], accel[i])
            for sensor, values in offers[i]:
                est.offer(sensor, t[i], values)
            if i % 1000 == 0:
                est.records()
        return common.clock() - began, np.atleast_2d(np.asarray(est.now()["q_nb"]))

    return run


def twin_run(flight: twin.Flight) -> Run:
    """The same filter as plain C++ loops."""
    peer = twin.Twin(twin.configuration_of())
    rows = np.empty((len(flight.t), 37))

    def run() -> tuple[float, FloatArray]:
        state = peer.begin(flight.initial())
        began = common.clock()
        peer.run(state, flight, rows)
        return common.clock() - began, rows[:, 1:5]

    return run


def vqf_batch(flight: twin.Flight, kind: str = "VQF") -> Run:
    """VQF over whole arrays; it needs gyro, accelerometer and magnetometer at one rate."""
    import vqf

    def run() -> tuple[float, FloatArray]:
        peer = getattr(vqf, kind)(1.0 / RATE)
        began = common.clock()
        out = peer.updateBatch(flight.gyro, flight.accel, flight.mag)
        return common.clock() - began, out["quat9D"]

    return run


def vqf_offline(flight: twin.Flight) -> Run:
    """VQF forwards and backwards over the whole record."""
    import vqf

    def run() -> tuple[float, FloatArray]:
        began = common.clock()
        out = vqf.offlineVQF(flight.gyro, flight.accel, flight.mag, 1.0 / RATE)
        return common.clock() - began, out["quat9D"]

    return run


def vqf_each(flight: twin.Flight) -> Run:
    """VQF sample by sample from Python, its quaternion read at each."""
    import vqf

    out = np.empty((len(flight.t), 4))

    def run() -> tuple[float, FloatArray]:
        peer = vqf.VQF(1.0 / RATE)
        gyro, accel, mag = flight.gyro, flight.accel, flight.mag
        began = common.clock()
        for i in range(len(out)):
            peer.update(gyro[i], accel[i], mag[i])
            out[i] = peer.getQuat9D()
        return common.clock() - began, out

    return run


def imufusion_each(flight: twin.Flight) -> Run:
    """imufusion as in its simple example: degrees a second, g, any unit of field; the quaternion read at each sample."""
    import imufusion

    gyro, accel, mag = np.degrees(flight.gyro), flight.accel / 9.80665, flight.mag
    out = np.empty((len(flight.t), 4))

    def run() -> tuple[float, FloatArray]:
        peer = imufusion.Ahrs()
        peer.set_settings(imufusion.AhrsSettings(sample_rate=RATE))
        began = common.clock()
        for i in range(len(out)):
            peer.update(gyro[i], accel[i], mag[i])
            out[i] = peer.get_quaternion()
        return common.clock() - began, out

    return run


def ahrs_batch(flight: twin.Flight, kind: str) -> Run:
    """A filter of ahrs, which runs over arrays in its constructor. Its EKF wants gravity for specific force, against its words."""
    from ahrs import filters

    sign = -1.0 if kind == "EKF" else 1.0
    accel = sign * flight.accel
    more = {"magnetic_ref": float(np.degrees(twin.FIELD[1]))} if kind == "EKF" else {}

    def run() -> tuple[float, FloatArray]:
        began = common.clock()
        peer = getattr(filters, kind)(gyr=flight.gyro, acc=accel, mag=flight.mag, frequency=RATE, **more)
        return common.clock() - began, peer.Q

    return run


def filterpy_run(flight: twin.Flight) -> Run:
    """A general Kalman filter of 15 states: predict, and an update with a position of three components, at every sample."""
    from filterpy.kalman import KalmanFilter

    dt = 1.0 / RATE
    F, H = np.eye(15), np.zeros((3, 15))
    F[0:3, 3:6] = F[3:6, 6:9] = dt * np.eye(3)
    H[:, 0:3] = np.eye(3)
    pos = flight.pos.reshape(len(flight.t), 3, 1)

    def run() -> tuple[float, FloatArray]:
        peer = KalmanFilter(dim_x=15, dim_z=3)
        peer.F, peer.H, peer.Q, peer.R = F, H, 1e-4 * np.eye(15), 0.01 * np.eye(3)
        peer.x[0:3] = pos[0]
        began = common.clock()
        for z in pos:
            peer.predict()
            peer.update(z)
        return common.clock() - began, peer.x[0:3, 0]

    return run


def pyins_run(flight: twin.Flight, time_step: float) -> Run:
    """pyins' extended Kalman filter with GNSS position and velocity; ``time_step`` 0 propagates its covariance at every sample."""
    import pandas as pd
    from pyins import filters, inertial_sensor, measurements, strapdown

    from haltere.metrics.attitude import euler

    config = twin.configuration_of()
    imu = pd.DataFrame(
        np.c_[flight.gyro, flight.accel], index=flight.t, columns=["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    )
    increments = strapdown.compute_increments_from_imu(imu, "rate")
    velocity, position = flight.kind == 0, flight.kind == 1
    fixes = [
        measurements.Position(pd.DataFrame(flight.z[position], index=flight.stamp[position], columns=["lat", "lon", "alt"]), 0.7),
        measurements.NedVelocity(pd.DataFrame(flight.z[velocity], index=flight.stamp[velocity], columns=["VN", "VE", "VD"]), 0.2),
    ]
    columns = ["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"]
    start = np.r_[twin.HOME[0], twin.HOME[1], twin.HOME[2] - flight.pos[0, 2], flight.vel[0], np.degrees(euler(flight.q[:1])[0])]
    first = pd.Series(start, index=columns, name=0.0)

    def model(sensor: str) -> Any:
        bias = {"gyro": 0.003, "accel": 0.05}[sensor]
        return inertial_sensor.EstimationModel(
            bias_sd=bias, noise=config.number(f"noise.{sensor}"), bias_walk=config.number(f"noise.{sensor}_bias")
        )

    def run() -> tuple[float, Any]:
        gyro, accel = model("gyro"), model("accel")
        began = common.clock()
        out = filters.run_feedback_filter(first, 0.5, 0.1, 1.0, 3.0, increments, gyro, accel, measurements=fixes, time_step=time_step)
        return common.clock() - began, out.trajectory

    return run


def runners(samples: int) -> list[Runner]:
    """Everything that is compared; the slow ones get a part of the flight, so that each takes less than a second."""
    whole, every = twin.fly(samples), twin.fly(samples, magnetometer=1, barometer=0, gnss=0)
    some, few, least = (twin.fly(max(200, samples // k)) for k in (5, 40, 1000))
    full = "navigation, 16 states"
    reduced = "attitude aided, 15 states"
    out: list[Runner] = []

    def add(name: str, estimates: str, called: str, flight: twin.Flight, make: Callable[[twin.Flight], Run], needs: str = "") -> None:
        reason = (twin.missing() if needs == "g++" else common.missing(needs)) if needs else None
        fast = flight is whole or flight is every
        out.append(Runner(name, estimates, called, len(flight.t), None if reason else make(flight), reason or "", fast))

    attitude = "attitude, gyro bias"
    add(YARDSTICK, attitude, "batch", whole, vqf_batch, "vqf")
    add("haltere navigator", full, "batch", whole, lambda f: filter_run("navigator", f))
    add("C++ twin of navigator", full, "batch, C++", whole, twin_run, "g++")
    add("haltere ahrs", reduced, "batch", whole, lambda f: filter_run("ahrs", f))
    add("haltere ahrs, magnetometer every sample", reduced, "batch", every, lambda f: filter_run("ahrs", f))
    add("haltere.run, navigator", f"{full}, and its tables", "whole flight", whole, whole_run)
    add("vqf.BasicVQF.updateBatch", "attitude", "batch", whole, lambda f: vqf_batch(f, "BasicVQF"), "vqf")
    add("vqf.offlineVQF", f"{attitude}, smoothed", "batch", whole, vqf_offline, "vqf")
    add("haltere Estimator.step, navigator", full, "each sample", some, step_run)
    add("vqf.VQF.update", attitude, "each sample", some, vqf_each, "vqf")
    add("imufusion.Ahrs.update", "attitude", "each sample", some, imufusion_each, "imufusion")
    for kind, estimates in (("Madgwick", "attitude"), ("Mahony", attitude), ("EKF", "attitude, 4 states")):
        add(f"ahrs.filters.{kind}", estimates, "batch, loop in Python", few, lambda f, kind=kind: ahrs_batch(f, kind), "ahrs")
    add(
        "filterpy KalmanFilter",
        "15 linear states, 3 measurements",
        "each sample",
        few,
        filterpy_run,
        "filterpy",
    )
    inertial = "navigation, 15 states"
    add("pyins, covariance every 0.1 s", inertial, "batch, loop in pandas", few, lambda f: pyins_run(f, 0.1), "pyins")
    add("pyins, covariance every sample", inertial, "batch, loop in pandas", least, lambda f: pyins_run(f, 0.0), "pyins")
    return out


def run(rounds: int = ROUNDS, samples: int = SAMPLES) -> list[Table]:
    """The two tables: everybody's speed beside the yardstick of the same round, and what is asked of ours."""
    table = Table(
        "throughput",
        f"IMU samples a second on one core: median (range) of {3 * rounds} interleaved rounds of the compiled, {rounds} of the others",
        [
            ("what", "what", "text"),
            ("called", "called", "text"),
            ("estimates", "estimates", "text"),
            ("speed", "samples/s", "rate"),
            ("ratio", f"of {YARDSTICK}", "ratio"),
        ],
    )
    columns = [("what", "what", "text"), ("value", "measured", "ratio"), ("wanted", "asked", "text"), ("met", "met", "text")]
    asked = Table("asked", "What is asked", columns)
    with common.one_core():
        everyone = runners(samples)
        there = {r.name: r for r in everyone if r.run is not None}
        fast = {n: r.seconds for n, r in there.items() if r.fast}
        slow = {n: r.seconds for n, r in there.items() if not r.fast or n == YARDSTICK}
        groups = [common.interleave(fast, 3 * rounds), common.interleave(slow, rounds)]
    each = [{name: [s / there[name].samples for s in seconds] for name, seconds in group.items()} for group in groups]
    for r in everyone:
        row: dict[str, Any] = {"what": r.name, "called": r.called, "estimates": r.estimates}
        group = each[0] if r.fast else each[1]
        if r.name not in group:
            table.rows.append(row | {"skipped": r.reason})
            continue
        row |= {"speed": common.measure([1.0 / s for s in group[r.name]]), "samples": r.samples}
        if YARDSTICK in group:
            row["ratio"] = common.ratios(group[YARDSTICK], group[r.name])
        table.rows.append(row)
    for ours, other, wanted in (
        ("haltere navigator", YARDSTICK, ">= 0.7"),
        ("haltere navigator", "C++ twin of navigator", ">= 0.65"),
        ("haltere ahrs", YARDSTICK, ">= 1.0"),
    ):
        row = {"what": f"{ours}, speed in units of {other}"}
        if other in each[0]:
            value = common.ratios(each[0][other], each[0][ours])
            asked.rows.append(common.judged(row | {"value": value}, value["median"], wanted))
        else:
            asked.rows.append(row | {"skipped": next(r.reason for r in everyone if r.name == other)})
    step = common.measure([1e6 * s for s in each[1]["haltere Estimator.step, navigator"]])
    asked.rows.append(
        common.judged({"what": "haltere Estimator.step with all that is offered, µs a sample", "value": step}, step["median"], "< 3")
    )
    return [table, asked]
