"""The plain-Python twin: the same kernels, uncompiled, over the same samples give the same numbers."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from haltere._jit import COMPILED

#: Runs all estimators over five seconds that hold alignment at rest, take-off and every sensor, and once online; writes all it got.
SCRIPT = """
import sys
import numpy as np
from haltere._jit import COMPILED
from haltere.drive import run
from haltere.estimators.base import Estimator
from haltere.flight.log import FlightLog, Stream
from haltere.simulate import demo_flight

demo = demo_flight(3, 24.0, imu_rate=100.0)
flight = FlightLog({k: s.where((s.t >= 2.5) & (s.t <= 7.5)) for k, s in demo.streams.items()}, demo.meta)
out = {"compiled": np.array(COMPILED)}
for name, options in (
    ("navigator", {}),
    ("ahrs", {}),
    ("late", {"delay.gnss": 0.12, "delay.barometer": 0.05, "arm.gnss_x": 0.2, "aid.magnetometer": "3-axis"}),
    ("mean", {"imu.kind": "mean", "aid.magnetometer": "off", "init.yaw_unknown": 1.5}),
    ("two-stage", {"noise.field": 1.0, "two_stage.robust": "huber", "two_stage.haversine": "on"}),
):
    solution = run(flight, name if name in ("ahrs", "two-stage") else "navigator", set=options)
    out |= {f"{name}.{k}": v for k, v in solution.table.items()} | {f"{name}.aid.{k}": v for k, v in solution.aids.items()}
    out |= {f"{name}.P.{k}": v for k, v in solution.covariance.items()}
    out[f"{name}.events"] = np.array([f"{e['kind']} {e['sensor']} {e['t_onset']:.6f}" for e in solution.events])
rng, truth = np.random.default_rng(3), flight["truth"]
t = np.arange(2.6, 7.4, 0.05)
speed, angles = 5.0 + rng.standard_normal(len(t)), 0.1 * rng.standard_normal((2, len(t)))
flight.streams["airdata"] = Stream({"t": t, "airspeed": speed, "aoa": angles[0], "sideslip": angles[1]})
flight.streams["wind"] = Stream({"t": t[::40], "wind_n": 3.0 + 0.0 * t[::40], "wind_e": t[::40], "sd": 1.0 + 0.0 * t[::40]})
for name, preset, options in (
    ("published", "as-corrected", {"wind_attitude.integrator": "rk4"}),
    ("printed", "as-printed", {}),
    ("dragged", "as-corrected", {"wind_attitude.air": "drag", "wind_attitude.integrator": "exp", "aid.airdata": "off"}),
):
    solution = run(flight, "wind-attitude", preset=preset, set=options)
    out |= {f"{name}.{k}": v for k, v in solution.table.items()} | {f"{name}.aid.{k}": v for k, v in solution.aids.items()}
del flight.streams["airdata"], flight.streams["wind"]
est, imu, mag, j = Estimator("ahrs"), flight["imu"], flight["magnetometer"], 0
for i in range(300):
    while j < len(mag) and mag.t[j] <= imu.t[i]:
        est.offer("magnetometer", mag.t[j], mag.vector("mag")[j])
        j += 1
    est.step(imu.t[i], imu.vector("gyro")[i], imu.vector("accel")[i])
now, records = est.now(), est.records()
snapshot = est.state
est.finish()
est.restore(snapshot)
out |= {f"online.{k}": np.asarray(v) for k, v in now.items()} | {"online.P": est.state.P, "online.records": records["innovation"]}
np.savez(sys.argv[1], **out)
"""


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What the compiled kernels give, and what plain Python gives."""
    folder = tmp_path_factory.mktemp("twin")
    modes = {"compiled": os.environ.get("HALTERE_JIT", "1") if COMPILED else "1", "plain": "0"}
    running = {
        name: subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(folder / f"{name}.npz")],
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "HALTERE_JIT": mode},
        )
        for name, mode in modes.items()
    }
    got = []
    for name, process in running.items():
        _, told = process.communicate()
        assert process.returncode == 0, f"HALTERE_JIT={modes[name]}: {told[-2000:]}"
        with np.load(folder / f"{name}.npz") as data:
            got.append({k: data[k] for k in data.files})
    return got[0], got[1]


def test_plain_python_runs_the_same_kernels_to_the_same_numbers(twins: tuple[dict[str, np.ndarray], dict[str, np.ndarray]]) -> None:
    """500 steps with 1e-16 a rounding; the filter forgets faster than they add up. Relative to the largest value of each column."""
    compiled, plain = twins
    assert bool(compiled.pop("compiled"))
    assert not bool(plain.pop("compiled"))
    assert compiled.keys() == plain.keys()
    for name, a in compiled.items():
        b = plain[name]
        assert a.shape == b.shape, name
        if a.dtype.kind != "f":
            assert (a == b).all(), name
            continue
        assert (np.isnan(a) == np.isnan(b)).all(), name
        if a.size and np.isfinite(a).any():
            assert np.nanmax(np.abs(a - b)) <= 1e-12 * np.nanmax(np.abs(a)) + 1e-15, name


def test_the_twins_saw_every_sensor(twins: tuple[dict[str, np.ndarray], dict[str, np.ndarray]]) -> None:
    """The comparison is not of an idle filter."""
    plain = twins[1]
    assert len(plain["navigator.t"]) > 300
    assert set(plain["navigator.aid.sensor"]) >= {"gnss", "barometer", "magnetometer", "zero_velocity", "zero_rate"}
    assert set(plain["ahrs.aid.sensor"]) >= {"magnetometer", "fake_velocity"}
    assert "mag_x" in plain["late.aid.component"]
    assert not (plain["mean.aid.sensor"] == "magnetometer").any()
    assert {"field_east", "vel_n", "pos_n"} <= set(plain["two-stage.aid.component"])
    assert {"down_x", "field_y", "air_z"} <= set(plain["published.aid.component"])
    assert {"down_x", "field_y", "air_z"} <= set(plain["printed.aid.component"])
    assert set(plain["dragged.aid.sensor"]) >= {"accelerometer", "drag"}
    assert len(plain["online.records"]) > 50
    assert any(e.startswith("aligned") for e in plain["navigator.events"])
