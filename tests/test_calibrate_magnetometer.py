"""A magnetometer calibrated from logs: recovery with an IMU, load, refusal, autopilots' corrections and parameters, files, page, verb."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import haltere
from haltere.calibrate import CoverageError, MagnetometerCalibration, ardupilot_parameters, calibrate_magnetometer, px4_parameters
from haltere.calibrate.coverage import coverage, heading_errors, level_fields
from haltere.calibrate.files import document, to_toml, write
from haltere.cli import app
from haltere.errors import HaltereError, UsageError
from haltere.flight.config import load as load_config
from haltere.flight.corrections import calibrated, calibration, correct, raw_vectors
from haltere.flight.field import earth_field
from haltere.flight.folder import read_folder, write_folder
from haltere.flight.load import load_at, loads_of
from haltere.flight.log import FlightLog, FlightMeta, Home, Stream
from haltere.readers import read
from haltere.report.calibration import calibration_page, refused_page
from haltere.simulate import inject

FloatArray = NDArray[np.float64]
HOME = Home(46.8, 8.2, 600.0)
YEAR = 2026.41
M = np.array([[1.08, 0.03, -0.04], [0.03, 0.94, 0.05], [-0.04, 0.05, 1.03]])
TURN = Rotation.from_rotvec(np.radians([1.2, -0.8, 0.9])).as_matrix()
OFFSET, LOAD = np.array([12.0, -7.0, 20.0]), np.array([0.35, -0.2, 0.5])


def turned_by_hand(seed: int = 1, *, noise: float = 0.3, seconds: float = 90.0, load: bool = False, limit: float = 10.0) -> FlightLog:
    """A vehicle held in the hand and turned; m_raw = M R h_b + b + k u. ``limit`` holds roll and pitch back [rad]."""
    rng = np.random.default_rng(seed)
    rate, n = 100.0, int(100 * seconds)
    t = np.arange(n) / rate
    smooth = np.column_stack([lfilter([0.02], [1.0, -0.98], rng.standard_normal(n)) for _ in range(3)])
    angles = np.cumsum(smooth * np.array([0.35, 0.35, 0.5]), axis=0) * np.clip((t - 3.0) / 3.0, 0.0, 1.0)[:, None]
    angles[:, :2] = limit * np.tanh(angles[:, :2] / limit)
    attitude = Rotation.from_euler("ZYX", angles[:, ::-1])
    gyro = np.vstack([(attitude[:-1].inv() * attitude[1:]).as_rotvec() * rate, np.zeros((1, 3))])
    accel = attitude.inv().apply([0.0, 0.0, -9.8065])
    gyro = gyro + 1e-3 * rng.standard_normal((n, 3))
    accel = accel + 0.02 * rng.standard_normal((n, 3))
    f = earth_field(HOME.lat, HOME.lon, HOME.alt, YEAR)
    d, i = f.declination, f.dip
    h = f.strength * np.array([math.cos(i) * math.cos(d), math.cos(i) * math.sin(d), math.sin(i)])
    s = slice(None, None, 4)
    u = 8.0 + 6.0 * np.sin(0.7 * t) + 4.0 * np.sin(2.9 * t + 1.0)
    m = attitude[s].inv().apply(h) @ (M @ TURN.T).T + OFFSET + noise * rng.standard_normal((len(t[s]), 3))
    if load:
        m = m + np.outer(u[s], LOAD)
    streams: dict[str, Any] = {
        "imu": {"t": t, **_xyz("gyro", gyro), **_xyz("accel", accel)},
        "magnetometer": {"t": t[s], **_xyz("mag", m)},
        "truth": {"t": t} | dict(zip(("q_x", "q_y", "q_z", "q_w"), attitude.as_quat().T, strict=True)),
        "power": {"t": t[::10], "current": u[::10]},
    }
    return FlightLog(streams, FlightMeta(name="hand", source="made", home=HOME, start_utc="2026-06-01T10:00:00Z"))


def _xyz(stem: str, v: FloatArray) -> dict[str, FloatArray]:
    return {f"{stem}_{a}": v[:, k] for k, a in enumerate("xyz")}


TRUE = TURN @ np.linalg.inv(M)


@pytest.fixture(scope="module")
def hand() -> FlightLog:
    return turned_by_hand()


@pytest.fixture(scope="module")
def found(hand: FlightLog) -> MagnetometerCalibration:
    return calibrate_magnetometer(hand)


def test_offset_matrix_and_rotation_are_recovered(found: MagnetometerCalibration) -> None:
    """Within four of their stated standard deviations; the rotation, which no ellipsoid tells, too."""
    sd = found.sd
    assert (np.abs(found.offset - OFFSET) < 4.0 * sd[:3]).all()
    assert (np.abs(found.matrix - TRUE) < 4.0 * sd[3:12].reshape(3, 3)).all()
    assert found.turn is not None
    wanted = Rotation.from_matrix(TURN).as_rotvec()
    assert (np.abs(found.turn.vector - wanted) < 4.0 * np.sqrt(np.diag(found.turn.covariance))).all()
    assert float(np.linalg.norm(found.turn.vector - wanted)) < math.radians(0.7) < 0.5 * float(np.linalg.norm(wanted))
    assert found.turn.scatter_after < 0.75 * found.turn.scatter_before
    assert (sd[:3] < 0.3).all()
    assert not found.refused


def test_headings_are_right_and_as_uncertain_as_stated(found: MagnetometerCalibration) -> None:
    fields = level_fields(found.strength, found.dip)
    raw = np.linalg.solve(TRUE, fields.T).T + OFFSET
    off = heading_errors(calibrated(raw, np.concatenate([found.offset, found.matrix.ravel(), np.zeros(3)])))
    assert float(np.max(np.abs(off))) < math.radians(1.0)
    assert (np.abs(off) < 4.0 * found.heading_sd).all()
    np.testing.assert_allclose(found.heading_before, heading_errors(raw), atol=math.radians(1.5))
    assert float(np.max(np.abs(found.heading_before))) > math.radians(20.0)


def test_strength_and_field(found: MagnetometerCalibration) -> None:
    assert found.strength == pytest.approx(earth_field(HOME.lat, HOME.lon, HOME.alt, YEAR).strength, rel=1e-4)
    assert found.spread(found.calibrated) < 0.01 < 0.1 < found.spread(found.log)
    assert np.linalg.norm(found.calibrated, axis=1).mean() == pytest.approx(found.strength, rel=2e-3)
    assert found.field_source.startswith("World Magnetic Model")


def test_rotation_needs_an_imu(hand: FlightLog) -> None:
    c = calibrate_magnetometer(hand.without("imu"))
    assert c.turn is None
    assert any("no IMU" in n for n in c.notes)
    np.testing.assert_allclose(c.matrix, c.matrix.T)


def test_load_is_identified() -> None:
    c = calibrate_magnetometer(turned_by_hand(2, load=True))
    assert c.load_word == "current"
    assert (np.abs(c.load - LOAD) < 4.0 * c.sd[12:]).all()
    assert (c.sd[12:] < 0.05).all()
    assert (np.abs(c.offset - OFFSET) < 4.0 * c.sd[:3]).all()  # at no current
    assert c.spread(c.calibrated) < 0.01


def test_load_of_chance_is_not_taken(found: MagnetometerCalibration) -> None:
    assert found.load_word == "off"
    assert any("follows current" in n and "not taken" in n for n in found.notes)


def test_a_load_asked_for_has_to_be_there(hand: FlightLog) -> None:
    assert loads_of(hand) == ("current",)
    with pytest.raises(HaltereError, match="the flight has current"):
        calibrate_magnetometer(hand, load="rotors")
    still = FlightLog({**hand.streams, "power": {"t": [0.0, 90.0], "current": [5.0, 5.1]}}, hand.meta)
    with pytest.raises(HaltereError, match="varies by more than 1 A"):
        calibrate_magnetometer(still, load="current")
    for word, match in (("curent", "did you mean 'current'"), ("x", "auto, off, current")):
        with pytest.raises(UsageError, match=match):
            calibrate_magnetometer(hand, load=word)
    with pytest.raises(UsageError, match="sampson with a load"):
        calibrate_magnetometer(hand, "lg", load="current")


def test_loads_by_word() -> None:
    t = np.linspace(0.0, 1.0, 11)
    flight = FlightLog({
        "power": {"t": t, "current": 10.0 * t},
        "rotors": {"t": t, "speed_0": 100.0 + t, "speed_1": np.where(t > 0.5, np.nan, 300.0)},
        "actuators": {"t": t[::-1], "command_0": t, "command_1": t},
    })  # fmt: skip
    at = np.array([-1.0, 0.25, 2.0])
    np.testing.assert_allclose(load_at(flight, "current", at), [0.0, 2.5, 10.0])
    np.testing.assert_allclose(load_at(flight, "throttle", at), [1.0, 0.75, 0.0])
    np.testing.assert_allclose(load_at(flight, "rotors", at), [200.0, 200.125, 101.0])


def test_too_few_directions_are_refused(tmp_path: Path) -> None:
    """A vehicle that turns about its vertical, with a little roll and pitch, tells of no ellipsoid worth having."""
    with pytest.raises(CoverageError, match=r"roll and pitch further") as info:
        calibrate_magnetometer(turned_by_hand(3, limit=0.05))
    c = info.value.calibration
    assert c is not None
    assert c.refused
    assert c.coverage.share < 0.5
    text = calibration_page(c)
    assert "refused" in text
    assert "param set" not in text
    write(c, tmp_path / "out", {"calibration.html": text})
    assert not (tmp_path / "out" / "calibration.toml").exists()
    assert json.loads((tmp_path / "out" / "calibration.json").read_text())["px4"] is None


def test_no_ellipsoid_at_all_is_refused_with_a_page() -> None:
    t = np.arange(200.0)
    m = 50.0 * np.column_stack([np.cos(t), np.sin(t), np.zeros(200)])
    flight = FlightLog({"magnetometer": {"t": t, **_xyz("mag", m)}}, FlightMeta(name="flat"))
    with pytest.raises(CoverageError, match="in a plane") as info:
        calibrate_magnetometer(flight)
    assert info.value.calibration is None
    assert "flat" in refused_page(info.value, "flat")


def test_other_input() -> None:
    t = np.arange(100.0)
    flight = FlightLog({"magnetometer": {"t": t, **_xyz("mag", np.zeros((100, 3)))}}, FlightMeta(name="zero"))
    with pytest.raises(HaltereError, match="samples with a value"):
        calibrate_magnetometer(flight)
    with pytest.raises(HaltereError, match="there is magnetometer"):
        calibrate_magnetometer(flight, stream="magnetometer.1")
    with pytest.raises(UsageError, match="did you mean"):
        calibrate_magnetometer(flight, "sampso")
    with pytest.raises(UsageError, match="magnetometer"):
        calibrate_magnetometer(flight, set={"unit.magnetomete": "G"})


def test_order_holes_and_repeats_do_not_matter(hand: FlightLog, found: MagnetometerCalibration) -> None:
    mag = hand["magnetometer"]
    rows = np.random.default_rng(1).permutation(np.repeat(np.arange(len(mag)), 2))
    columns = {k: v[rows].copy() for k, v in mag.columns.items()}
    columns["mag_y"][:50] = np.nan
    flight = FlightLog({"magnetometer": Stream(columns)}, hand.meta)
    c, plain = calibrate_magnetometer(flight), calibrate_magnetometer(hand.without("imu"))
    np.testing.assert_allclose(c.offset, plain.offset, atol=0.1)
    assert any("repeat the one before" in n for n in c.notes)
    assert any("without a value" in n for n in c.notes)


def test_units_and_axes_go_before_and_are_written(hand: FlightLog, found: MagnetometerCalibration, tmp_path: Path) -> None:
    """A log in milligauss with its sensor turned over: the same calibration, and a file with which a run does the same."""
    v = hand["magnetometer"].vector("mag") * 10.0 * np.array([1.0, -1.0, -1.0])
    flight = FlightLog({**hand.streams, "magnetometer": {"t": hand["magnetometer"].t, **_xyz("mag", v)}}, hand.meta)
    c = calibrate_magnetometer(flight, set={"unit.magnetometer": "mG", "axes.magnetometer": "FLU"})
    np.testing.assert_allclose(c.offset, found.offset, atol=1e-6)
    np.testing.assert_allclose(c.matrix, found.matrix, atol=1e-6)
    (tmp_path / "c.toml").write_text(to_toml(c))
    keys = load_config(tmp_path / "c.toml")[2]
    assert keys["unit.magnetometer"] == "mG"
    after = correct(flight, keys)["magnetometer"].vector("mag")
    np.testing.assert_allclose(after, found.calibrated, atol=1e-5)


def test_mounting_is_kept_apart(hand: FlightLog, found: MagnetometerCalibration) -> None:
    """With a mounting quaternion the calibration is in the sensor's axes, the headings in the body's."""
    C = Rotation.from_euler("z", 90.0, degrees=True)
    q = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    v = C.inv().apply(hand["magnetometer"].vector("mag"))
    flight = FlightLog(
        {**hand.streams, "magnetometer": {"t": hand["magnetometer"].t, **_xyz("mag", v)}}, replace(hand.meta, mounting={"magnetometer": q})
    )
    c = calibrate_magnetometer(flight)
    R = C.as_matrix()
    np.testing.assert_allclose(R @ c.offset, found.offset, atol=0.05)
    np.testing.assert_allclose(R @ c.matrix @ R.T, found.matrix, atol=2e-3)
    np.testing.assert_allclose(c.heading_before, found.heading_before, atol=math.radians(0.3))
    np.testing.assert_allclose(c.heading_sd, found.heading_sd, rtol=0.2)


def _keys(offset: FloatArray, matrix: FloatArray) -> dict[str, float]:
    return {f"magnetometer.offset_{a}": float(offset[k]) for k, a in enumerate("xyz")} | {
        f"magnetometer.matrix_{r}{c}": float(matrix[i, k]) for i, r in enumerate("xyz") for k, c in enumerate("xyz")
    }


# --- a run with it ---------------------------------------------------------------------------------------------------


def test_a_run_takes_it_and_is_reproduced(hand: FlightLog, found: MagnetometerCalibration, tmp_path: Path) -> None:
    (tmp_path / "calibration.toml").write_text(to_toml(found))
    solution = haltere.run(hand, "ahrs", config=tmp_path / "calibration.toml")
    plain = haltere.run(hand, "ahrs")
    perfect = correct(hand, _keys(OFFSET, TRUE))
    rms = [s.summary["errors"]["truth"]["yaw_deg"]["rms"] for s in (haltere.run(perfect, "ahrs"), solution, plain)]
    assert rms[1] == pytest.approx(rms[0], abs=0.3)  # as with a compass that has no error
    assert rms[2] > 2.0 * rms[1]
    (tmp_path / "config.toml").write_text(solution.config.to_toml())
    again = haltere.run(hand, "ahrs", config=tmp_path / "config.toml")
    np.testing.assert_array_equal(again["q_w"], solution["q_w"])


def test_online_applies_it_and_refuses_a_load(found: MagnetometerCalibration) -> None:
    keys = found.keys()
    raw = np.array([30.0, -20.0, 45.0])
    m = found.matrix @ (raw - found.offset)
    states = []
    for config, vector in ((keys, raw), ({}, m)):
        est = haltere.Estimator("ahrs", config)
        for k in range(400):
            est.step(0.005 * k, (0.0, 0.0, 0.0), (0.0, 0.0, -9.80665))
            if k % 10 == 0:
                assert est.offer("magnetometer", 0.005 * k, tuple(vector))
        states.append(np.array(est.now()["q_nb"]))
    np.testing.assert_allclose(states[0], states[1], atol=1e-9)
    assert abs(states[0][3]) > 0.01
    with pytest.raises(UsageError, match="online the load is not known"):
        haltere.Estimator("navigator", keys | {"magnetometer.load": "current"})


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-50.0, 50.0), min_size=15, max_size=15))
def test_keys_are_the_formula(values: list[float]) -> None:
    """m = A (m_raw - b - k load), whatever the numbers; all defaults change nothing."""
    names = [
        *(f"magnetometer.offset_{a}" for a in "xyz"), *(f"magnetometer.matrix_{r}{c}" for r in "xyz" for c in "xyz"),
        *(f"magnetometer.load_{a}" for a in "xyz"),
    ]  # fmt: skip
    config: dict[str, Any] = dict(zip(names, values, strict=True)) | {"magnetometer.load": "current"}
    flight = FlightLog({"magnetometer": {"t": [0.0, 1.0], "mag_x": [1.0, 2.0], "mag_y": [3.0, 4.0], "mag_z": [5.0, 6.0]},
                        "power": {"t": [0.0, 1.0], "current": [2.0, 4.0]}})  # fmt: skip
    out = correct(flight, config)["magnetometer"].vector("mag")
    b, A, k = np.array(values[:3]), np.array(values[3:12]).reshape(3, 3), np.array(values[12:])
    for row, (raw, u) in enumerate((((1.0, 3.0, 5.0), 2.0), ((2.0, 4.0, 6.0), 4.0))):
        np.testing.assert_allclose(out[row], A @ (np.array(raw) - b - k * u), atol=1e-9)
    assert calibration({}) is None
    assert correct(flight, {}) is flight


def test_a_load_that_the_flight_lacks_is_told(hand: FlightLog) -> None:
    with pytest.raises(HaltereError, match=r"magnetometer\.load=off"):
        correct(hand.without("power"), {"magnetometer.load": "current", "magnetometer.load_x": 1.0})


# --- autopilots ------------------------------------------------------------------------------------------------------


def _autopilot(found: MagnetometerCalibration, **changes: Any) -> MagnetometerCalibration:
    return replace(found, **changes)


@pytest.mark.parametrize("word", ["off", "current", "throttle"])
def test_px4_parameters_do_what_the_calibration_does(found: MagnetometerCalibration, word: str) -> None:
    """PX4's formula, gauss and kiloampere, in the sensor's axes before the rotation (Magnetometer.hpp)."""
    R = Rotation.from_euler("ZYX", [90.0, 0.0, 180.0], degrees=True).as_matrix()
    sensor = {"autopilot": "PX4", "slot": 2, "rotation": R.ravel().tolist()}
    c = _autopilot(found, load_word=word, load=LOAD if word != "off" else np.zeros(3), sensor=sensor)
    p = px4_parameters(c)
    assert all(name.startswith("CAL_MAG2_") or name == "CAL_MAG_COMP_TYP" for name in p)
    assert p.get("CAL_MAG_COMP_TYP", 0) == {"off": 0, "throttle": 1, "current": 2}[word]
    off, comp = (np.array([p[f"CAL_MAG2_{a}{k}"] for a in "XYZ"]) for k in ("OFF", "COMP"))
    S = np.diag([p[f"CAL_MAG2_{a}SCALE"] for a in "XYZ"])
    S[0, 1] = S[1, 0] = p["CAL_MAG2_XODIAG"]
    S[0, 2] = S[2, 0] = p["CAL_MAG2_YODIAG"]
    S[1, 2] = S[2, 1] = p["CAL_MAG2_ZODIAG"]
    raw, u = np.array([31.0, -12.0, 40.0]), 14.0
    power = u * 1e-3 if word == "current" else u
    theirs = 100.0 * R @ (S @ (R.T @ raw / 100.0 + power * comp - off))
    np.testing.assert_allclose(theirs, c.symmetric @ (raw - c.offset - u * c.load), atol=1e-9)


@pytest.mark.parametrize("inside", [False, True])
def test_ardupilot_parameters_do_what_the_calibration_does(found: MagnetometerCalibration, inside: bool) -> None:
    """ArduPilot's formula, milligauss (AP_Compass_Backend.cpp, correct_field), before and since compensation by motor."""
    sensor = {"autopilot": "ArduPilot", "slot": 1, "scale": True, "mot_inside": inside}
    c = _autopilot(found, load_word="current", load=LOAD, sensor=sensor)
    p = ardupilot_parameters(c)
    assert p["COMPASS_SCALE2"] == 1.0
    assert p["COMPASS_MOTCT"] == 2
    ofs, dia, odi, mot = (np.array([p[f"COMPASS_{k}2_{a}"] for a in "XYZ"]) for k in ("OFS", "DIA", "ODI", "MOT"))
    D = np.array([[dia[0], odi[0], odi[1]], [odi[0], dia[1], odi[2]], [odi[1], odi[2], dia[2]]])
    raw, u = np.array([31.0, -12.0, 40.0]), 14.0
    theirs = 0.1 * (D @ (10.0 * raw + ofs + u * mot) if inside else D @ (10.0 * raw + ofs) + u * mot)
    np.testing.assert_allclose(theirs, c.symmetric @ (raw - c.offset - u * c.load), atol=1e-9)


def test_a_log_corrected_by_its_autopilot_gives_the_same_parameters(hand: FlightLog, found: MagnetometerCalibration) -> None:
    """Parameters replace those in the log and do not stack on them: the log with an earlier correction calibrates to the same."""
    raw = hand["magnetometer"].vector("mag")
    D, b = np.array([[0.9, 0.05, 0.0], [0.05, 1.1, 0.02], [0.0, 0.02, 1.05]]), np.array([5.0, 5.0, 5.0])
    mag = {"t": hand["magnetometer"].t, **_xyz("mag", (raw - b) @ D.T), **_xyz("raw", raw)}
    flight = FlightLog({**hand.streams, "magnetometer": mag}, hand.meta)
    c = calibrate_magnetometer(flight)
    assert c.undone
    np.testing.assert_allclose(c.offset, found.offset, atol=1e-6)
    np.testing.assert_allclose(c.matrix, found.matrix, atol=1e-6)
    assert abs(c.spread(c.log) - found.spread(found.log)) > 0.005
    after = correct(flight, c.keys())["magnetometer"].vector("mag")
    np.testing.assert_allclose(after, found.calibrated, atol=1e-5)
    assert ardupilot_parameters(c) == pytest.approx(ardupilot_parameters(found), abs=1e-4)


def test_raw_field_of_ardupilot_logs(shared_data: Path) -> None:
    """Its own formula on the raw field gives the logged one, with the offsets in each message."""
    from haltere.readers._dataflash import DataFlash

    path = shared_data / "ardupilot" / "log_0041_mechanical_failure.bin"
    flight = read(path)
    assert flight.meta.compass["magnetometer"]["autopilot"] == "ArduPilot"
    parm = DataFlash(path).get("PARM")
    assert parm is not None
    p = dict(zip(parm.texts("Name"), parm.get("Value").tolist(), strict=True))
    mag = flight["magnetometer"]
    dia, odi = ([p[f"COMPASS_{k}_{a}"] for a in "XYZ"] for k in ("DIA", "ODI"))
    D = np.array([[dia[0], odi[0], odi[1]], [odi[0], dia[1], odi[2]], [odi[1], odi[2], dia[2]]])
    again = (mag.vector("raw") + mag.vector("offset")) @ D.T
    np.testing.assert_allclose(again, mag.vector("mag"), atol=1e-9)
    assert np.abs(mag.vector("raw") - mag.vector("mag")).max() > 5.0


@pytest.mark.parametrize("name", ["sample.ulg", "sample_log_small.ulg"])
def test_raw_field_of_px4_logs(shared_data: Path, name: str) -> None:
    """PX4's formula forward, from the parameters as they stand in the log."""
    from pyulog import ULog

    flight = read(shared_data / "px4" / name)
    meta = flight.meta.compass["magnetometer"]
    p = ULog(str(shared_data / "px4" / name), ["sensor_combined"]).initial_parameters
    n = meta["slot"]
    R = np.array(meta["rotation"]).reshape(3, 3)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    off, scale = (np.array([p[f"CAL_MAG{n}_{a}{k}"] for a in "XYZ"]) for k in ("OFF", "SCALE"))
    mag = flight["magnetometer"]
    again = (scale * (mag.vector("raw") @ R - 100.0 * off)) @ R.T
    np.testing.assert_allclose(again, mag.vector("mag"), atol=1e-6)


def test_raw_px4_field_is_what_the_sensor_counts(shared_data: Path) -> None:
    """The sensor of this log counts in 0.3 uT, two samples averaged: the raw field lies on that grid, the calibrated one does not."""
    mag = read(shared_data / "px4" / "sample_log_small.ulg")["magnetometer"]
    off = {name: np.abs(v / 0.15 - np.rint(v / 0.15)).max(axis=0) for name, v in (("raw", mag.vector("raw")), ("mag", mag.vector("mag")))}
    assert (off["raw"] < 1e-3).all()
    assert (off["mag"] > 0.1).all()


def test_folder_keeps_raw_field_and_parameters(hand: FlightLog, tmp_path: Path) -> None:
    meta = replace(
        hand.meta, compass={"magnetometer": {"autopilot": "PX4", "slot": 1, "device": 7, "rotation": np.eye(3).ravel().tolist()}}
    )
    mag = {**hand["magnetometer"].columns, **_xyz("raw", hand["magnetometer"].vector("mag") + 1.0)}
    write_folder(FlightLog({**hand.streams, "magnetometer": mag}, meta), tmp_path / "f")
    back = read_folder(tmp_path / "f")
    assert back.meta.compass == meta.compass
    raw, undone = raw_vectors(back["magnetometer"])
    assert undone
    np.testing.assert_array_equal(raw, hand["magnetometer"].vector("mag") + 1.0)


def test_an_injected_fault_reaches_the_raw_field(hand: FlightLog) -> None:
    mag = {**hand["magnetometer"].columns, **_xyz("raw", hand["magnetometer"].vector("mag") + 1.0)}
    flight = FlightLog({**hand.streams, "magnetometer": mag}, hand.meta)
    after = inject(flight, ["magnetometer.x:bias=5uT@10"])["magnetometer"]
    np.testing.assert_allclose(after["raw_x"] - after["mag_x"], 1.0, atol=1e-9)
    assert float(np.max(np.abs(after["mag_x"] - mag["mag_x"]))) == pytest.approx(5.0)


# --- coverage, files, page, verb -------------------------------------------------------------------------------------


def test_coverage_of_known_sets() -> None:
    rng = np.random.default_rng(1)
    d = rng.standard_normal((20000, 3))
    whole = coverage(d)
    np.testing.assert_allclose(whole.eigenvalues, 1.0 / 3.0, atol=0.01)
    assert whole.share == 1.0
    assert whole.missing == ()
    np.testing.assert_allclose(whole.cells, 20000 / 72, rtol=0.25)  # cells of equal area
    down = coverage(d[d[:, 2] > 0.8 * np.linalg.norm(d, axis=1)])
    assert down.missing == ("forward", "back", "right", "left", "up")
    assert down.share == pytest.approx(1.0 / 6.0)


def test_files_and_page(found: MagnetometerCalibration, tmp_path: Path) -> None:
    write(found, tmp_path, {"calibration.html": calibration_page(found, "haltere calibrate magnetometer hand")})
    data = json.loads((tmp_path / "calibration.json").read_text())
    assert data == json.loads(json.dumps(document(found)))
    assert data["offset_uT"] == pytest.approx(found.offset.tolist())
    assert len(data["covariance"]) == 15
    keys = load_config(tmp_path / "calibration.toml")[2]
    assert keys == pytest.approx(found.keys())
    text = (tmp_path / "calibration.html").read_text()
    for words in ("param set CAL_MAG0_XOFF", "COMPASS_OFS_X,", "[magnetometer]", "Headings", "Coverage", "rotation x"):
        assert words in text
    assert "http://" not in text.split("<script")[0]
    assert len(text) < 5_000_000


def test_page_opens_without_script_errors(found: MagnetometerCalibration) -> None:
    from report_page import browse

    text = calibration_page(found)
    data, _ = browse(text, "")
    assert data["errors"] == "[]"
    assert int(data["drawn"]) == text.count("data-figure=")


def test_verb_on_a_flight(hand: FlightLog, tmp_path: Path) -> None:
    write_folder(hand, tmp_path / "hand")
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["calibrate", "magnetometer", str(tmp_path / "hand"), "--out", str(out)], catch_exceptions=False)
    assert result.exit_code == 0
    assert "level headings are off by up to" in result.stdout
    assert {p.name for p in out.iterdir()} == {"calibration.html", "calibration.json", "calibration.toml"}
    again = [
        "run",
        str(tmp_path / "hand"),
        "--estimator",
        "ahrs",
        "--config",
        str(out / "calibration.toml"),
        "--out",
        str(tmp_path / "run"),
    ]
    assert CliRunner().invoke(app, again, catch_exceptions=False).exit_code == 0
    assert "matrix_xy" in (tmp_path / "run" / "config.toml").read_text()


def test_verb_on_bench_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three columns of numbers without a header, and a table with names and no time."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    d = rng.standard_normal((400, 3))
    m = 45.0 * d / np.linalg.norm(d, axis=1)[:, None] @ M.T + OFFSET + 0.2 * rng.standard_normal((400, 3))
    for name, mark in (("a.txt", " "), ("b.csv", ",")):
        np.savetxt(tmp_path / name, m, delimiter=mark, fmt="%.4f")
        result = CliRunner().invoke(
            app, ["calibrate", "magnetometer", name, "--set", "field.strength=45", "--json"], catch_exceptions=False
        )
        assert result.exit_code == 0
        data = json.loads(result.stdout)
        assert data["offset_uT"] == pytest.approx(OFFSET, abs=0.2)
        assert np.array(data["matrix"]) == pytest.approx(np.linalg.inv(M), abs=0.01)
    np.savetxt(tmp_path / "c.csv", np.column_stack([np.arange(400), m / 100.0]), delimiter=";", fmt="%.6f")
    columns = [w for k, a in enumerate("xyz") for w in ("--column", f"magnetometer.mag_{a}=#{k + 2} [G]")]
    words = ["calibrate", "magnetometer", "c.csv", *columns, "--column", "t=#row [ms]", "--json"]
    data = json.loads(CliRunner().invoke(app, words, catch_exceptions=False).stdout)
    assert data["offset_uT"] == pytest.approx(OFFSET, abs=0.2)


def test_verb_refuses_with_a_page(tmp_path: Path) -> None:
    write_folder(turned_by_hand(3, limit=0.05), tmp_path / "level")
    result = CliRunner().invoke(app, ["calibrate", "magnetometer", str(tmp_path / "level"), "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, CoverageError)
    assert "calibration.html shows what was seen" in str(result.exception)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"calibration.html", "calibration.json"}


@pytest.mark.parametrize(
    ("text", "words"),
    [("1 2 3\n4 5\n", "3 numbers a line"), ("1 2 3\n4 five 6\n", "numbers alone"), ("# nothing\n", "a table with values")],
)
def test_bench_tables_that_are_none(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(HaltereError, match=words):
        read(tmp_path / "t.txt", {"t": "#row", **{f"magnetometer.mag_{a}": f"#{k + 1}" for k, a in enumerate("xyz")}})


# --- the rotation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lean", [0.0, 0.6])
def test_rotation_from_dip_says_what_it_does_not_know(lean: float) -> None:
    """Level turns tell the rotation's horizontal part and nothing of its part about the vertical, which keeps the assumed 1 sigma."""
    from haltere.calibrate.dip import PRIOR, turn
    from haltere.calibrate.ellipsoid import fit

    rng = np.random.default_rng(4)
    sphere = rng.standard_normal((4000, 3))
    e = fit(50.0 * sphere / np.linalg.norm(sphere, axis=1)[:, None])
    yaw = rng.uniform(0.0, 2.0 * np.pi, 1500)
    angles = np.column_stack([yaw, lean * rng.standard_normal((1500, 2))])
    attitude = Rotation.from_euler("ZYX", angles).inv()
    down = attitude.apply([0.0, 0.0, 1.0]) + 0.005 * rng.standard_normal((1500, 3))
    h = attitude.apply([25.0, 0.0, 43.3])
    e = replace(e, weights=np.ones(1500))
    found = turn(e, h @ TURN, down / np.linalg.norm(down, axis=1)[:, None])
    assert found is not None
    sd = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.vector - Rotation.from_matrix(TURN).as_rotvec()) < 4.0 * sd).all()
    assert found.dip == pytest.approx(math.atan2(43.3, 25.0), abs=4.0 * found.dip_sd)
    if lean:
        assert (sd < 0.2 * PRIOR).all()
        assert (found.scatter_after, found.dip_sd) < (0.5 * found.scatter_before, math.radians(0.5))
    else:
        assert 0.75 * PRIOR < sd[2] < 1.01 * PRIOR  # but for what chance adds
        assert (sd[:2] < 0.4 * PRIOR).all()
