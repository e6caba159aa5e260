"""What must hold on real recordings (and on two that PX4 simulated): the figures asked of the default filters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import haltere
from converters import broad, broad_errors, ecl_replay, ekf2_output, enu_flu_from_ned_frd, inertialnav
from haltere.drive import run
from haltere.flight.log import FlightLog
from haltere.metrics.attitude import conjugate, euler, multiply, rotation_vector, slerp
from haltere.metrics.errors import error_series

DEG = np.pi / 180.0
pytestmark = pytest.mark.real


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.fixture(scope="module")
def log_0036(shared_data: Path) -> tuple[FlightLog, haltere.Solution]:
    flight = haltere.read(shared_data / "ardupilot" / "log_0036_mechanical_failure.bin")
    return flight, run(flight)


def test_log_0036_agrees_with_the_onboard_filter_until_the_failure(log_0036: tuple[FlightLog, haltere.Solution]) -> None:
    flight, solution = log_0036
    end = 371.0 - flight.meta.time_offset
    series = {k: e[t <= end] for k, (t, e) in error_series(solution, flight["onboard"]).items()}
    assert len(series["roll"]) > 1000
    assert _rms(series["roll"]) < 2.0 * DEG
    assert _rms(series["pitch"]) < 2.0 * DEG
    assert _rms(series["yaw"]) < 6.0 * DEG
    for axis in "ned":
        assert _rms(series[f"vel_{axis}"]) < 0.5


def test_log_0036_shows_the_loss_of_control(log_0036: tuple[FlightLog, haltere.Solution]) -> None:
    flight, solution = log_0036
    t = solution.t + flight.meta.time_offset
    roll = np.abs(euler(solution.vector("q", "wxyz"))[:, 0])
    cruise = (t > 330.0) & (t < 370.0)
    assert roll[cruise].max() < 25.0 * DEG
    beyond = t[(t > 370.0) & (roll > 30.0 * DEG)]
    assert abs(beyond[0] - 371.97) < 0.3
    assert roll[t > 371.0].max() > 90.0 * DEG


def test_a_log_in_bursts_is_told(shared_data: Path) -> None:
    """Two stretches of 25 Hz with ten minutes between: the filter says so and aligns anew."""
    solution = run(haltere.read(shared_data / "ardupilot" / "beast_sample.bin"))
    assert any("slow" in w for w in solution.summary["warnings"])
    assert any("gap" in w for w in solution.summary["warnings"])
    assert {"gap", "realigned"} <= {e["kind"] for e in solution.events}


@pytest.mark.parametrize(("name", "settled"), [("iris_gps", 8.0), ("ekf_gsf_reset", 8.0)])
def test_side_by_side_with_ekf2(shared_data: Path, name: str, settled: float) -> None:
    """Against EKF2's own states at its delayed time, once it has set its yaw by its compass.

    EKF2 was told a declination of its own, which its earth field states show, and counts height from another origin: the
    declination is given to both, and the constant part of the height difference is not counted.
    """
    folder = shared_data / "px4_ecl_replay"
    flight = ecl_replay(folder / f"{name}.csv")
    ekf2 = ekf2_output(folder / "ekf2_output" / f"{name}.csv")
    flight.meta.field = {"declination": float(np.median(np.arctan2(ekf2["field"][:, 1], ekf2["field"][:, 0])[ekf2["t"] > settled]))}
    solution = run(flight)
    use = (ekf2["t"] > settled) & (ekf2["t"] < solution.t[-1])
    t = ekf2["t"][use]
    assert len(t) > 250
    q = slerp(t, solution.t, solution.vector("q", "wxyz"))
    attitude = np.linalg.norm(rotation_vector(multiply(conjugate(q), ekf2["q"][use])), axis=1)
    assert _rms(attitude) < 1.0 * DEG
    for k, axis in enumerate("ned"):
        assert _rms(np.interp(t, solution.t, solution[f"vel_{axis}"]) - ekf2["vel"][use, k]) < 0.3
        error = np.interp(t, solution.t, solution[f"pos_{axis}"]) - ekf2["pos"][use, k]
        assert _rms(error - (np.median(error) if axis == "d" else 0.0)) < 1.0


def test_quad106_runs_to_the_end(shared_data: Path) -> None:
    flight = inertialnav(shared_data / "inertialnav" / "quad106", gauss=0.1)
    solution = run(flight)
    assert solution.t[-1] == flight["imu"].t[-1]
    assert all(np.isfinite(column).all() for column in solution.table.values())
    errors = solution.summary["errors"]["onboard"]
    assert errors["roll_deg"]["rms"] < 2.0
    assert errors["pitch_deg"]["rms"] < 2.0
    assert errors["yaw_deg"]["rms"] < 6.0


def test_f450_glitch_does_not_move_the_velocity(shared_data: Path) -> None:
    """Over any second of the glitch the change of velocity is that of the integrated specific force within 2 m/s."""
    flight = inertialnav(shared_data / "inertialnav" / "f450_glitch_log", gauss=0.1)
    solution = run(flight)
    t = solution.t
    assert t[-1] == flight["imu"].t[-1]
    assert any(e["kind"] == "timeout" and e["sensor"] == "gnss" for e in solution.events)
    q = solution.vector("q", "wxyz")
    f = np.column_stack([np.interp(t, flight["imu"].t, flight["imu"][f"accel_{a}"]) for a in "xyz"]) - solution.vector("accel_bias")
    f_n = multiply(multiply(q, np.column_stack([np.zeros(len(f)), f])), conjugate(q))[:, 1:]
    gravity = (
        9.7803253359 * (1 + 0.00193185265241 * np.sin(39.84 * DEG) ** 2) / np.sqrt(1 - 0.00669437999013 * np.sin(39.84 * DEG) ** 2)
        - 3.086e-6 * 1818
    )
    a_n = f_n + [0.0, 0.0, gravity]
    integral = np.vstack([np.zeros(3), np.cumsum(0.5 * (a_n[1:] + a_n[:-1]) * np.diff(t)[:, None], axis=0)])
    starts = np.arange(124.0, 141.0, 0.1)
    difference = []
    for k, axis in enumerate("ned"):
        v, w = solution[f"vel_{axis}"], integral[:, k]
        difference.append(np.interp(starts + 1, t, v) - np.interp(starts, t, v) - np.interp(starts + 1, t, w) + np.interp(starts, t, w))
    assert np.linalg.norm(difference, axis=0).max() < 2.0


def test_px4_log_with_groundtruth_has_errors_in_its_summary(shared_data: Path) -> None:
    solution = run(haltere.read(shared_data / "px4" / "sample_logging_tagged_and_default_params.ulg"))
    errors = solution.summary["errors"]["truth"]
    assert {"roll_deg", "pitch_deg", "yaw_deg", "vel_n", "vel_e", "vel_d", "pos_n", "pos_e", "pos_d"} <= set(errors)
    assert errors["roll_deg"]["rms"] < 1.0 and errors["pitch_deg"]["rms"] < 1.0 and errors["yaw_deg"]["rms"] < 3.0
    assert errors["vel_n"]["rms"] < 0.1 and errors["pos_n"]["rms"] < 1.0
    assert errors["pos_d"]["rms"] < 3.0  # the simulator's altitude counts from another zero: its pos_d is what is compared
    assert solution.summary["nees"]


def _broad(folder: Path, names: list[str]) -> dict[str, list[float]]:
    vqf = pytest.importorskip("vqf")
    out: dict[str, list[float]] = {"ours": [], "theirs": [], "tilt": [], "their tilt": []}
    for name in names:
        flight, raw = broad(folder / f"{name}.mat")
        solution = run(flight, "ahrs")
        q = np.full((len(raw["imu_gyr"]), 4), np.nan)
        q[np.searchsorted(flight["imu"].t, solution.t)] = solution.vector("q", "wxyz")
        total, tilt = broad_errors(enu_flu_from_ned_frd(q), raw)
        peer = vqf.VQF(1.0 / float(raw["rate"])).updateBatch(*(np.ascontiguousarray(raw[k]) for k in ("imu_gyr", "imu_acc", "imu_mag")))
        theirs, their_tilt = broad_errors(peer["quat9D"], raw)
        for key, value in (("ours", total), ("tilt", tilt), ("theirs", theirs), ("their tilt", their_tilt)):
            out[key].append(value)
    return out


@pytest.mark.parametrize(("kind", "number"), [("undisturbed", 9), ("disturbed", 7)])
def test_broad_with_one_set_of_defaults(shared_data: Path, kind: str, number: int) -> None:
    """Mean total error at most that of VQF in the same run, on disturbed and on undisturbed trials."""
    names = sorted(p.stem for p in (shared_data / "broad").glob(f"*_{kind}_*.mat"))
    assert len(names) == number
    found = _broad(shared_data / "broad", names)
    assert np.mean(found["ours"]) < np.mean(found["theirs"])
    assert np.mean(found["tilt"]) < 1.5 * np.mean(found["their tilt"])


def test_a_healthy_compass_is_heard(shared_data: Path) -> None:
    """Refused at most 1 % of the time: a real quad until it is lost, a real quad by PX4, two simulated flights of PX4's."""
    flights = {
        "log_0036": (haltere.read(shared_data / "ardupilot" / "log_0036_mechanical_failure.bin"), 145.0),
        "sample": (haltere.read(shared_data / "px4" / "sample.ulg"), np.inf),
        **{n: (ecl_replay(next((shared_data / "px4_ecl_replay").rglob(f"{n}.csv"))), np.inf) for n in ("iris_gps", "ekf_gsf_reset")},
    }
    for name, (flight, end) in flights.items():
        solution = run(flight)
        a = solution.aids
        rows = (a["sensor"] == "magnetometer") & (a["t"] < end)
        assert np.mean(a["status"][rows] == "rejected") < 0.01, name
        assert not [e for e in solution.events if e["kind"] == "disturb" and e["t_onset"] < end], name


def test_an_uncalibrated_compass_is_said_to_be_one(shared_data: Path) -> None:
    """f450's field has a dip of 44 deg where the Earth's is 66: it is out from the beginning, with the reason, and never heard."""
    solution = run(inertialnav(shared_data / "inertialnav" / "f450_glitch_log", gauss=0.1))
    a = solution.aids
    assert not np.isin(a["status"][a["sensor"] == "magnetometer"], ["fused", "deweighted"]).any()
    (found,) = [e for e in solution.events if e["kind"] == "disturb"]
    assert found["t_detected"] < 5.0
    assert "strength or dip" in found["evidence"]
    assert solution.summary["health"]["magnetometer"]["verdict"] == "bad"


def test_broad_frames_are_one_fixed_choice(shared_data: Path) -> None:
    """The converter's frames are right: the reference itself, through both maps, comes back."""
    _, raw = broad(shared_data / "broad" / "01_undisturbed_slow_rotation_A.mat")
    q = raw["opt_quat"][np.isfinite(raw["opt_quat"]).all(axis=1)][:100]
    c = np.sqrt(0.5)  # ENU/FLU to NED/FRD as in the flight folder
    ned = c * np.column_stack([q[:, 0] + q[:, 3], q[:, 1] + q[:, 2], q[:, 1] - q[:, 2], q[:, 0] - q[:, 3]])
    np.testing.assert_allclose(enu_flu_from_ned_frd(ned), q, atol=1e-12)
