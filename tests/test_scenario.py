"""Scenarios: every mission flown to its end, seeds, files and their errors, faults in the vehicle and the air, tracks, the command line."""

from __future__ import annotations

import dataclasses
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import haltere
from haltere import cli
from haltere.errors import HaltereError, UsageError
from haltere.flight.folder import write_folder
from haltere.flight.log import FlightLog
from haltere.flight.vehicle import LIBRARY, load_vehicle
from haltere.simulate import SCENARIOS, Scenario, load_scenario, parse_fault, parse_scenario, simulate
from haltere.simulate.missions import MISSIONS, RATE, reference, track_reference
from haltere.simulate.simulator import simulate_truth
from haltere.simulate.track import track_of
from haltere.simulate.truth import Truth

#: Largest distance from the reference [m] in 4 m/s of gusty wind. The Iris lifts 1.76 of its weight: quick curves against the wind
#: are beyond it, and it is allowed to lag and catch up.
BOUND = {"hover": 0.5, "climb": 0.5, "box": 1.0, "figure-eight": 1.0, "tour": 1.0, "identify": 1.0, "lissajous": 2.0}
BOUND_IRIS = {**BOUND, "identify": 6.0, "lissajous": 9.0}


def distance(truth: Truth, rows: np.ndarray) -> np.ndarray:
    """From the reference [m], row by row of the truth."""
    at = np.arange(len(rows)) / RATE
    return np.linalg.norm(truth.pos_n - np.column_stack([np.interp(truth.t, at, rows[:, k]) for k in range(3)]), axis=1)


@pytest.mark.parametrize("vehicle", LIBRARY)
def test_every_mission_is_flown_to_its_end_in_gusty_wind(vehicle: str) -> None:
    for mission in MISSIONS:
        scenario = Scenario(vehicle=vehicle, mission=mission, duration=90.0, wind={"n": 3.2, "e": -2.4, "gust": 1.0}, seed=5)
        truth = simulate_truth(scenario)
        assert len(truth.t) == 90 * 250
        far = distance(truth, reference(mission, 90.0))
        flying = (truth.t > 10.0) & (truth.t < 68.0)
        assert far[flying].max() < (BOUND_IRIS if vehicle == "iris" else BOUND)[mission], mission
        # take-off from rest, landing at rest: there the specific force is that of gravity
        for still in (truth.t < 3.9, truth.t > 87.0):
            assert np.abs(truth.vel_n[still]).max() < 2e-3, mission
            assert np.abs(truth.force_b[still] + [0.0, 0.0, 9.806]).max() < 0.1, mission
            assert np.abs(truth.gyro_b[still]).max() < 1e-3, mission
            assert not truth.command[still].any()
        assert -truth.pos_n[flying, 2].max() > 1.0


@pytest.mark.parametrize("mission", MISSIONS)
def test_references_are_smooth_and_consistent(mission: str) -> None:
    """Velocity and acceleration are the derivatives of the position; nothing jumps but where the motors go on and off."""
    rows = reference(mission, 90.0)
    dt = 1.0 / RATE
    for first in (0, 3):
        slope = (rows[2:, first : first + 3] - rows[:-2, first : first + 3]) / (2.0 * dt)
        np.testing.assert_allclose(rows[1:-1, first + 3 : first + 6], slope, atol=1e-9)
    assert np.abs(np.diff(rows[:, 3:6], axis=0)).max() < 14.0 * dt
    assert np.abs(np.diff(rows[:, 9])).max() < 3.0 * dt + 1e-9
    assert np.abs(rows[0, :9]).max() == 0.0
    assert rows[-1, 2] == pytest.approx(0.02)  # a little into the ground, so that it stands
    assert np.flatnonzero(np.diff(rows[:, 11])).size == 2


def test_a_flight_may_begin_and_end_in_the_air() -> None:
    truth = simulate_truth(Scenario(mission="figure-eight", duration=20.0, rest=0.0, landing=False, wind={"n": 4.0}))
    assert -truth.pos_n[:, 2].max() > 9.0
    assert truth.command[0].min() > 0.0


# --- seeds ---------------------------------------------------------------------------------------------------------------

SEEDED = Scenario(mission="figure-eight", duration=24.0, wind={"n": 3.0, "gust": 1.0}, sensors={"gnss": {"preset": "consumer"}})


def made(seed: int) -> dict[str, dict[str, np.ndarray]]:
    flight = simulate(SEEDED.changed(seed=seed))
    return {name: dict(flight[name].columns) for name in flight}


def equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[s][c], b[s][c], equal_nan=True) for s in a for c in a[s])


def test_a_seed_is_a_flight_whoever_makes_it() -> None:
    """Bit for bit the same again, in another order, and in one or two other processes."""
    seeds = [1, 2, 3]
    here = {s: made(s) for s in seeds}
    assert all(equal(here[s], made(s)) for s in reversed(seeds))
    assert not equal(here[1], here[2])
    for workers in (1, 2):
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            there = dict(zip(seeds[::-1], pool.map(made, seeds[::-1]), strict=True))
        assert all(equal(here[s], there[s]) for s in seeds)


def test_wind_and_sensors_do_not_share_their_numbers() -> None:
    calm = simulate(SEEDED.changed(wind={}))
    sensors = simulate(SEEDED.changed(wind={}, sensors={"gnss": {"preset": "consumer"}, "magnetometer": {"noise": 2.0}}))
    assert all(calm[s] == sensors[s] for s in calm if s != "magnetometer")
    assert calm["magnetometer"] != sensors["magnetometer"]


# --- files and their errors ------------------------------------------------------------------------------------------------

FILE = """
base = "gusty"
vehicle = "mine.toml"
mission = "box"
duration = 40
seed = 7
fault = ["gyro.x:bias=3deg/s@20", "wind.n:step=4m/s@15"]

[wind]
gust = 0.5

[sensors.imu]
preset = "bmi088"
rate = 200

[home]
lat = -33.9
lon = 151.2
alt = 20
"""


def test_a_scenario_file_with_a_vehicle_beside_it(tmp_path: Path) -> None:
    heavy = dataclasses.replace(load_vehicle("hummingbird"), name="heavy", mass=0.6)
    (tmp_path / "mine.toml").write_text(heavy.to_toml())
    (tmp_path / "mine-flown.toml").write_text(FILE)
    scenario = load_scenario(tmp_path / "mine-flown.toml")
    assert (scenario.name, scenario.mission, scenario.duration, scenario.seed) == ("mine-flown", "box", 40.0, 7)
    assert scenario.wind == {"n": 5.2, "e": 3.0, "gust": 0.5}  # over those of the base
    flight = simulate(scenario)
    assert [f["word"] for f in flight.meta.faults] == ["wind.n:step=4m/s@15", "gyro.x:bias=3deg/s@20"]
    assert "heavy" in flight.meta.source
    assert flight["imu"].rate == pytest.approx(200.0)
    assert flight.meta.home.lat == -33.9
    assert flight["truth"]["field_z"][0] < -40.0  # it points up in the south
    back = haltere.read(write_folder(flight, tmp_path / "folder"))
    assert all(back[name] == flight[name] for name in flight)
    assert back.meta.faults == flight.meta.faults
    assert back.meta.home == flight.meta.home


WRONG = {
    "mision = 'box'": "did you mean 'mission'?",
    "mission = 'bx'": "did you mean 'box'?",
    "vehicle = 'humingbird'": "did you mean 'hummingbird'?",
    "vehicle = 3": "a text for vehicle",
    "base = 'gust'": "did you mean 'gusty'?",
    "duration = 'long'": "a number of at least 0 for duration [s]",
    "duration = 5": "a duration of at least 14 s",
    "duration = nan": "a number of at least 0 for duration [s]",
    "seed = 1.5": "a whole number",
    "landing = 1": "true or false for landing",
    "wind = 4": "a table [wind]",
    "[wind]\nnorth = 4": "a parameter of the wind",
    "[wind]\ngust = -1": "gust [m/s]",
    "[wind]\ngust = '1 m/s'": "gust [m/s]",
    "sensors = 3": "a table [sensors]",
    "[sensors]\nimu = 3": "a table [sensors.imu]",
    "[sensors.imus]\nrate = 3": "did you mean 'imu'?",
    "[sensors.imu]\ngyro_nois = 3": "did you mean 'gyro_noise'?",
    "[sensors.imu]\npreset = 'icm4268'": "did you mean 'icm42688'?",
    "[sensors.gnss]\nh_noise = -1": "a number [m] of at least 0 for h_noise",
    "[sensors.imu]\nrate = 0": "a positive rate",
    "fault = 3": "fault words",
    "fault = 'gyro.x:bias=3m@20'": "a unit of gyro bias",
    "home = {lat = 46.0}": "lat, lon and alt",
    "home = {lat = 460.0, lon = 0.0, alt = 0.0}": "a place on Earth",
    "start_utc = 'yesterday'": "an ISO 8601 time",
    "mission = 'track'": 'track = "path of a log"',
    "name = 3": "a text for name",
}


@pytest.mark.parametrize("text", WRONG)
def test_wrong_scenarios_are_wrong_usage(text: str, tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(UsageError) as error:
        simulate(load_scenario(path))
    assert WRONG[text] in str(error.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("mission = ")
    with pytest.raises(HaltereError, match="a TOML file of a scenario"):
        load_scenario(tmp_path / "s.toml")
    with pytest.raises(UsageError, match="did you mean 'lissajous'"):
        load_scenario("lissajou")
    (tmp_path / "s.toml").write_text("mission = 'track'\ntrack = 'nothing.bin'")
    with pytest.raises(HaltereError, match=r"nothing\.bin"):
        simulate(load_scenario(tmp_path / "s.toml"))
    (tmp_path / "v.toml").write_text("name = 'v'\nmass = 1.0\ninertia = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]\n[lumped]\nk = 1.0")
    with pytest.raises(HaltereError, match="only lumped constants"):
        simulate(Scenario(vehicle=tmp_path / "v.toml"))


def test_a_lost_vehicle_is_one_clear_error() -> None:
    with pytest.raises(HaltereError) as error:
        simulate(Scenario(mission="hover", duration=60.0, wind={"n": 200.0}))
    assert "a flight to the end" in str(error.value)
    assert "the vehicle was lost at t = " in str(error.value)
    assert "less wind" in str(error.value)
    assert not isinstance(error.value, UsageError)


@pytest.mark.parametrize("name", SCENARIOS)
def test_built_in_scenarios_fly(name: str) -> None:
    flight = simulate(name)
    assert {"imu", "magnetometer", "gnss", "barometer", "rotors", "power", "truth"} <= set(flight)
    assert {"wind_n", "gyro_bias_x", "accel_bias_z", "baro_bias", "field_x", "speed_0", "lat", "force_z"} <= set(flight["truth"].names)
    assert parse_scenario({"base": name}) == SCENARIOS[name]


def test_the_room_can_be_called() -> None:
    flight = haltere.simulate(haltere.Scenario(mission="hover", duration=20.0))
    assert isinstance(flight, FlightLog)
    import haltere.simulate as room

    assert room.Scenario is haltere.Scenario
    assert haltere.simulate is room
    assert haltere.inject(flight, ["gnss:dropout@5-10"]).meta.faults[0]["kind"] == "dropout"


# --- faults in the vehicle and in the air ------------------------------------------------------------------------------------


def flown(*words: str, mission: str = "hover", **changes) -> Truth:
    faults = [parse_fault(w) for w in words]
    return simulate_truth(Scenario(mission=mission, duration=40.0, landing=False, **changes), 250.0, faults)


def test_wind_step_is_exact() -> None:
    a, b = flown(wind={"n": 1.0}), flown("wind.n:step=4m/s@20-30", wind={"n": 1.0})
    on = (b.t >= 20.0) & (b.t < 30.0)
    np.testing.assert_array_equal(b.wind_n[:, 0], np.where(on, 5.0, 1.0))
    np.testing.assert_array_equal(a.pos_n[b.t < 20.0], b.pos_n[b.t < 20.0])
    assert np.abs(b.pos_n[on, 0]).max() > 0.1  # it is blown away before the controller brings it back
    ramp = flown("wind.e:ramp=0.5m/s/s@10-20")
    np.testing.assert_allclose(ramp.wind_n[:, 1], np.where((ramp.t >= 10) & (ramp.t < 20), 0.5 * (ramp.t - 10.0), 0.0), atol=1e-12)


def test_model_faults_are_forces_and_moments_the_model_lacks() -> None:
    """In the sample where it begins nothing else has changed yet: the difference is the fault itself."""
    a = flown()
    k = 20 * 250
    push = flown("model.hx:bias=0.8m/s2@20", "model.t:bias=-0.5m/s2@20")
    np.testing.assert_allclose(push.force_b[k] - a.force_b[k], [0.8, 0.0, -0.5], atol=1e-9)
    twist = flown("model.r:bias=3rad/s2@20", "model.q:bias=1rad/s2@20")
    np.testing.assert_allclose(twist.gyro_dot_b[k] - a.gyro_dot_b[k], [3.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_array_equal(a.force_b[: k - 1], push.force_b[: k - 1])


def test_weak_rotor_changes_the_motion_by_what_it_lacks() -> None:
    a, b = flown(), flown("rotor.2:thrust=0.85@20")
    k, vehicle = 20 * 250, load_vehicle("hummingbird")
    density = 101325.0 * (1.0 - 2.25577e-5 * 600.0) ** 5.25588 / (287.05 * 288.15) / vehicle.density
    lost = 0.15 * density * vehicle.rotors[2].k_T * a.speed[k, 2] ** 2
    # thrust is minus z; behind and right of the middle, so that the vehicle falls to the right and lifts its nose
    np.testing.assert_allclose(b.force_b[k] - a.force_b[k], [0.0, 0.0, lost / vehicle.mass], atol=1e-9)
    x, y = vehicle.rotors[2].position[:2]
    expected = np.array([y * lost / vehicle.inertia[0], -x * lost / vehicle.inertia[1], 0.0])
    np.testing.assert_allclose(b.gyro_dot_b[k] - a.gyro_dot_b[k], expected, atol=1e-6)
    end = b.t > 35.0
    # thrusts T + d, T - d, T + d, T - d keep it level; torques go with the squares of the speeds and are in balance:
    # (T + d) + (T + d) / 0.85 = 2 (T - d)
    d = -(1.0 / 0.85 - 1.0) / (1.0 / 0.85 + 3.0)
    assert b.speed[end, 2].mean() / a.speed[end, 2].mean() == pytest.approx(np.sqrt((1.0 + d) / 0.85), rel=1e-3)
    with pytest.raises(HaltereError, match="a rotor from 0 to 3"):
        flown("rotor.4:thrust=0.5@20")


def test_faults_of_sensors_are_those_of_inject() -> None:
    words = ("gyro.x:bias=3deg/s@12", "magnetometer:disturb=0.3@5-8")
    plain = simulate(SEEDED)
    at_once, later = simulate(SEEDED.changed(fault=words)), haltere.inject(plain, words)
    assert all(at_once[s] == later[s] for s in plain)
    assert at_once.meta.faults == later.meta.faults


# --- tracks ----------------------------------------------------------------------------------------------------------------


@pytest.mark.real
def test_a_real_track_is_flown_again(shared_data: Path) -> None:
    """Against the recorded track, smoothing and wind included: decimetres; more only where it falls at 4 m/s and stops on the ground."""
    path = next((shared_data / "ardupilot").glob("log_0036*.bin"))
    t, pos, _, _ = track_of(path)
    assert len(t) > 500
    truth = simulate_truth(Scenario(mission="track", track=path, duration=1000.0, wind={"n": 3.0, "e": 2.0, "gust": 0.8}))
    assert truth.t[-1] > t[-1] - t[0] + 5.0
    late = truth.t > 10.0  # it hovered for 4 s and lost 2 s as its clock started
    moved = truth.pos_n - np.column_stack([np.interp(truth.t - 6.0 + t[0], t, pos[:, k]) for k in range(3)])
    error = (moved - moved[late].mean(axis=0))[late]
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 0.15
    assert np.abs(error[:-1250]).max() < 0.8
    assert np.abs(error).max() < 1.5
    assert -truth.pos_n[:, 2].max() > 11.0


@pytest.mark.parametrize("without", [(), ("truth",)])
def test_a_simulated_track_is_flown_again(without: tuple[str, ...]) -> None:
    """From truth within decimetres; from fixes with their noise of 0.8 m and a yaw that is the course."""
    first = simulate(Scenario(mission="tour", duration=80.0, wind={"n": 2.0}))
    source = first.without(*without)
    t, pos, yaw, smoothing = track_of(source)
    rows = track_reference(t, pos, yaw, smoothing)
    truth = simulate_truth(Scenario(vehicle="hexarotor", mission="track", track=source, duration=500.0))
    assert distance(truth, rows).max() < 1.0
    true = first["truth"]
    moved = truth.pos_n - np.column_stack([np.interp(truth.t - 6.0, true.t, true[f"pos_{a}"]) for a in "ned"])
    late = truth.t > 10.0
    error = (moved - moved[late].mean(axis=0))[late]
    assert np.sqrt(np.mean(error**2)) < (0.8 if without else 0.3)


def test_a_track_beside_its_scenario_file(tmp_path: Path) -> None:
    write_folder(simulate(Scenario(mission="box", duration=50.0)), tmp_path / "recorded")
    (tmp_path / "again.toml").write_text("mission = 'track'\ntrack = 'recorded'\nduration = 30\n")
    flight = simulate(load_scenario(tmp_path / "again.toml"))
    assert flight["truth"].t[-1] == pytest.approx(30.0 - 1.0 / 250.0)
    nowhere = FlightLog({"imu": flight["imu"]})
    with pytest.raises(HaltereError, match="positions in truth, onboard or gnss"):
        simulate(Scenario(mission="track", track=nowhere))


# --- command line ------------------------------------------------------------------------------------------------------------


def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["haltere", *map(str, words)])
    status = 0
    try:
        cli.main()
    except SystemExit as left:
        status = left.code if isinstance(left.code, int) else 0 if left.code is None else 1
    shown = capsys.readouterr()
    return status, shown.out, shown.err


def test_simulate_and_inject_as_verbs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["simulate", "hover", "--out", "a", "--set", "duration=20", "--set", "wind.n=5", "--fault", "gnss:dropout@8-12"]
    status, out, _ = call(monkeypatch, capsys, *words)
    assert status == 0
    assert "fault: gnss:dropout@8-12" in out
    wanted = simulate(SCENARIOS["hover"].changed(duration=20.0, wind={**SCENARIOS["hover"].wind, "n": 5.0}, fault=("gnss:dropout@8-12",)))
    back = haltere.read("a")
    assert all(back[s] == wanted[s] for s in wanted)
    assert back.meta.faults == wanted.meta.faults
    status, out, _ = call(monkeypatch, capsys, *[*words[:3], "b", *words[4:]], "--json")
    assert status == 0
    assert json.loads(out)["folder"] == "b"
    assert json.loads(out)["streams"]["imu"]["n"] == 5000

    status, out, _ = call(monkeypatch, capsys, "inject", "a", "gyro.x:bias=3deg/s@15", "--out", "c", "--json")
    assert status == 0
    assert [f["word"] for f in json.loads(out)["faults"]] == ["gnss:dropout@8-12", "gyro.x:bias=3deg/s@15"]
    injected = haltere.inject(back, ["gyro.x:bias=3deg/s@15"])
    assert all(haltere.read("c")[s] == injected[s] for s in injected)


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["simulate", "hoover", "--out", "x"], 2, "did you mean 'hover'?"),
        (["simulate", "hover", "--out", "x", "--set", "wind.north=3"], 2, "a parameter of the wind"),
        (["simulate", "hover", "--out", "x", "--set", "wind"], 2, "key=value"),
        (["simulate", "hover", "--out", "x", "--fault", "gyro.x:bias=3m@5"], 2, "a unit of gyro bias"),
        (["simulate", "hover", "--out", "x", "--fault", "gnss:dropout@500-600"], 1, "samples of gnss in its time"),
        (["simulate", "hover", "--out", "x", "--set", "wind.n=200"], 1, "the vehicle was lost"),
        (["inject", "nothing", "gyro.x:bias=3deg/s@5", "--out", "x"], 1, "nothing"),
        (["inject", "nothing", "gyro.x:bais=3deg/s@5", "--out", "x"], 2, "did you mean 'bias'?"),
    ],
)
def test_what_cannot_be_is_one_line_and_a_status(
    words: list[str], status: int, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    found, out, err = call(monkeypatch, capsys, *words)
    assert found == status
    assert said in err.splitlines()[-1]
    assert "Traceback" not in err
    assert out == ""
    assert not Path("x").exists()
