"""The vehicle model from flights: columns against rotor physics, noise in regressors, lag, rotor order, recovery, files, the verb."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import haltere
from converters_air import wemuav
from converters_indiflight import captured
from haltere.cli import app
from haltere.errors import HaltereError
from haltere.estimators.lumped import Lumped, lumped_of
from haltere.flight.folder import write_folder
from haltere.flight.log import FlightLog, Stream
from haltere.flight.vehicle import Vehicle, load_vehicle, parse_vehicle
from haltere.identify.checks import check
from haltere.identify.instrument import instrumented
from haltere.identify.prepare import motion
from haltere.identify.rotors import speeds_of
from haltere.identify.track import in_wind
from haltere.identify.vehicle import VehicleIdentification, identify_vehicle
from haltere.identify.vehicle_files import document, to_toml
from haltere.report.vehicle_model import vehicle_page
from haltere.simulate.rotorcraft import vehicle_record
from haltere.simulate.scenario import Scenario
from haltere.vehicle.regressors import AERO, NAMES, PRESETS, predict, regress
from haltere.vehicle.wrench import wrench

TEMPERATURE = {"baro.temperature": 288.15}


def weights(vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    position = np.array([r.position for r in vehicle.rotors])
    return -position[:, 1], position[:, 0], np.array([r.spin for r in vehicle.rotors])


def lumped_model(vehicle: Vehicle, k: np.ndarray, s1: float = 0.0) -> Lumped:
    return Lumped("full", *weights(vehicle), k, np.zeros((6, 7, 7)), s1=s1)


def draws(n: int, rotors: int, hover: float, seed: int = 1) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    speeds = hover * (1.0 + 0.1 * rng.standard_normal((n, rotors)))
    return (
        speeds, 200.0 * rng.standard_normal((n, rotors)), 4.0 * rng.standard_normal((n, 3)), rng.standard_normal((n, 3)),
        rng.standard_normal((n, 3)),
    )  # fmt: skip


def test_columns_against_plain_numpy() -> None:
    vehicle = load_vehicle("hexarotor")
    model = lumped_model(vehicle, np.random.default_rng(3).standard_normal((6, 7)), 2900.0)
    speeds, accelerations, v, w, eta = draws(50, len(vehicle.rotors), 500.0)
    out = np.empty((50, 6, 7))
    regress(model.record(), speeds, accelerations, v, w, eta, out)
    s1, s2 = speeds.sum(axis=1), (speeds**2).sum(axis=1)
    roll, pitch, yaw = weights(vehicle)
    one, no, speed = np.ones(50), np.zeros(50), np.linalg.norm(v, axis=1)
    side, fore, s = speeds @ roll, speeds @ pitch, s1 / 2900.0
    expected = [
        [s1 * v[:, 0], eta[:, 1], v[:, 0], speed * v[:, 0], one, no, no], [s1 * v[:, 1], eta[:, 0], v[:, 1], speed * v[:, 1], one, no, no],
        [s2, v[:, 0] ** 2 + v[:, 1] ** 2, s1 * v[:, 2], one, no, no, no],
        [speeds**2 @ roll, w[:, 1] * w[:, 2], s * w[:, 0], s2, s1 * v[:, 1], w[:, 2] * v[:, 0], side * v[:, 2]],
        [speeds**2 @ pitch, w[:, 0] * w[:, 2], s * w[:, 1], s2, s1 * v[:, 0], w[:, 2] * v[:, 1], fore * v[:, 2]],
        [speeds**2 @ yaw, w[:, 0] * w[:, 1], s * w[:, 2], accelerations @ yaw, s2, side * v[:, 0], fore * v[:, 1]],
    ]  # fmt: skip
    assert out == pytest.approx(np.array(expected).transpose(2, 0, 1), rel=1e-12)
    ratio = np.full(50, 0.9)
    found = np.empty((50, 6))
    predict(model.record(), speeds, accelerations, v, w, eta, ratio, found)
    aero = np.where(np.array(AERO), 0.9, 1.0)
    assert found == pytest.approx(np.einsum("nij,ij->ni", out, model.k * aero), rel=1e-10)


def test_constants_follow_from_the_rotor_physics() -> None:
    """Level rotors without drag of the body: the columns hold its whole force and moment, with the constants of theory.md §5.2."""
    vehicle = replace(load_vehicle("hummingbird"), drag=(0.0, 0.0, 0.0))
    r, m, inertia = vehicle.rotors[0], vehicle.mass, vehicle.inertia
    k = np.zeros((6, 7))
    k[0, 0] = k[1, 0] = -r.k_d / m
    k[2, :3] = -r.k_T / m, -4.0 * r.k_h / m, -r.k_z / m
    k[3, :2] = r.k_T / inertia[0], (inertia[1] - inertia[2]) / inertia[0]
    k[4, :2] = r.k_T / inertia[1], (inertia[2] - inertia[0]) / inertia[1]
    k[5, :2] = r.k_M / inertia[2], (inertia[0] - inertia[1]) / inertia[2]
    k[5, 3] = r.inertia / inertia[2]
    p = vehicle_record(vehicle, vehicle.density)
    speeds, accelerations, v, _, _ = draws(40, 4, 469.0)
    found = np.empty((40, 6))
    still = np.zeros((40, 3))
    predict(lumped_model(vehicle, k).record(), speeds, accelerations, v, still, still, np.ones(40), found)
    for i in range(40):
        force, _ = wrench(p[0], speeds[i], accelerations[i], tuple(v[i]), (0.0, 0.0, 0.0))
        assert found[i, :3] == pytest.approx(np.array(force) / m, rel=1e-9)
    # moments in motion: every hub has a velocity of its own; no sum of spin times speed, whose gyroscopic moment no column has
    x, y = (np.array([rotor.position[j] for rotor in vehicle.rotors]) for j in range(2))
    rng = np.random.default_rng(8)
    part = rng.standard_normal((40, 3))
    speeds = 469.0 * (1.0 + 0.05 * part[:, :1] + 0.3 * part[:, 1:2] * x + 0.3 * part[:, 2:] * y)
    w, s1 = rng.standard_normal((40, 3)), 1900.0
    k[3, [2, 5, 6]] = np.array([-r.k_z * s1 / 4.0 * (y @ y), 2.0 * r.k_h * (y @ y), r.k_z]) / inertia[0]
    k[4, [2, 5, 6]] = np.array([-r.k_z * s1 / 4.0 * (x @ x), 2.0 * r.k_h * (x @ x), r.k_z]) / inertia[1]
    k[5, [2, 5, 6]] = np.array([-r.k_d * s1 / 4.0 * (x @ x + y @ y), -r.k_d, -r.k_d]) / inertia[2]
    predict(lumped_model(vehicle, k, s1).record(), speeds, accelerations, v, w, w, np.ones(40), found)
    k[3:, 5:] = 0.0
    without = np.empty((40, 6))
    predict(lumped_model(vehicle, k).record(), speeds, accelerations, v, w, w, np.ones(40), without)
    largest = np.zeros(3)
    for i in range(40):
        _, moment = wrench(p[0], speeds[i], accelerations[i], tuple(v[i]), tuple(w[i]))
        turn = (np.array(moment) - np.cross(w[i], np.array(inertia[:3]) * w[i])) / np.array(inertia[:3])
        assert found[i, 3:] == pytest.approx(turn, rel=1e-9, abs=1e-9)
        largest = np.maximum(largest, np.abs(without[i, 3:] - turn))
    assert (largest > [0.5, 0.5, 0.1]).all()  # what the columns of theory-amendments.md 12 leave


def test_noise_in_the_regressors() -> None:
    """Ordinary least squares comes out too small; two readings as instruments do not, and say how sure they are."""
    errors, plain, z = [], [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        x = np.column_stack([rng.standard_normal(400), np.ones(400)])
        k = np.array([2.0, -1.0])
        noise = np.zeros((2, 400, 2))
        noise[:, :, 0] = 0.8 * rng.standard_normal((2, 400))
        y = x @ k + 0.3 * rng.standard_normal(400)
        f = instrumented(y, x + noise[0], x + noise[1], np.arange(400) // 10)
        errors.append(f.k - k)
        plain.append(f.plain[0])
        z.append((f.k - k) / f.sd)
        assert f.instruments
    assert np.mean(plain) == pytest.approx(2.0 / 1.32, rel=0.01)  # 1 + half of 0.64
    assert np.mean(errors, axis=0) == pytest.approx([0.0, 0.0], abs=0.02)
    assert 0.6 < (np.abs(np.array(z)) < 1.0).mean() < 0.76
    assert 0.90 < (np.abs(np.array(z)) < 2.0).mean() < 0.98


def test_noise_that_swamps_is_said() -> None:
    rng = np.random.default_rng(1)
    x = 0.01 * rng.standard_normal((300, 1))
    f = instrumented(rng.standard_normal(300), x + rng.standard_normal((300, 1)), x + rng.standard_normal((300, 1)), np.arange(300) // 10)
    assert not f.instruments


def flown(mission: str, vehicle: str = "iris", seed: int = 3, duration: float = 70.0, wind: float = 3.0, **rotors: float) -> FlightLog:
    sensors = {"rotors": {"rate": 250.0, "noise": 1.0, **rotors}}
    where = {"n": 0.8 * wind, "e": 0.6 * wind, "gust": 0.15 * wind}
    return haltere.simulate(
        Scenario(name=mission, vehicle=vehicle, mission=mission, duration=duration, wind=where, seed=seed, sensors=sensors)
    )


@pytest.fixture(scope="module")
def excited() -> FlightLog:
    return flown("identify", delay=0.013)


@pytest.fixture(scope="module")
def identified(excited: FlightLog) -> VehicleIdentification:
    return identify_vehicle(excited, vehicle="iris", validate=flown("lissajous", seed=8, delay=0.013), set=TEMPERATURE)


def test_recovery_on_an_excited_flight(identified: VehicleIdentification) -> None:
    vehicle = load_vehicle("iris")
    r, m, inertia = vehicle.rotors[0], vehicle.mass, vehicle.inertia
    k = identified.lumped.k
    assert k[2, 0] == pytest.approx(-r.k_T / m, rel=0.03)
    assert k[3, 0] == pytest.approx(r.k_T / inertia[0], rel=0.05)
    assert k[4, 0] == pytest.approx(r.k_T / inertia[1], rel=0.05)
    assert k[5, 0] == pytest.approx(r.k_M / inertia[2], rel=0.10)
    assert k[5, 3] == pytest.approx(r.inertia / inertia[2], rel=0.15)
    speed = 4.0 * vehicle.hover_speeds().mean()
    for axis in (0, 1):  # the split of linear drag is hardly told; its sum at hover is
        assert k[axis, 0] * speed + k[axis, 2] == pytest.approx(-r.k_d / m * speed, rel=0.15)


def test_predicts_a_flight_it_has_not_seen(identified: VehicleIdentification) -> None:
    check = identified.checks[-1]
    assert not check.seen
    assert (check.explained[:3] > 0.95).all()
    assert (check.explained[3:] > 0.85).all()
    assert (check.error < 2.0 * np.maximum(identified.lumped.residual_sd, 0.05)).all()


def test_each_flight_is_predicted_from_the_others(excited: FlightLog) -> None:
    d = identify_vehicle([excited, flown("lissajous", seed=8, delay=0.013)], vehicle="iris", set=TEMPERATURE)
    assert [c.seen for c in d.checks] == [True, True, False, False]
    assert (d.checks[3].explained[:3] > 0.95).all()  # lissajous from identify


def test_lag_is_found(identified: VehicleIdentification) -> None:
    assert identified.tracks[0].speeds.lag == pytest.approx(0.013, abs=0.002)


@pytest.mark.parametrize("shift", [-0.04, 0.03])
def test_shifted_stamps_are_found(excited: FlightLog, shift: float) -> None:
    rotors = excited["rotors"]
    moved = FlightLog({**excited.streams, "rotors": Stream({**rotors.columns, "t": rotors.t + shift})}, excited.meta)
    found = speeds_of(motion(moved.without("truth"), set=TEMPERATURE, least=3.0))
    assert found.lag_told
    assert found.lag == pytest.approx(0.013 + shift, abs=0.003)


def reordered(flight: FlightLog, order: tuple[int, ...]) -> FlightLog:
    rotors = flight["rotors"]
    columns = {"t": rotors.t} | {f"speed_{k}": rotors[f"speed_{i}"] for k, i in enumerate(order)}
    return FlightLog({**flight.streams, "rotors": columns}, flight.meta)


def test_rotors_in_another_order_are_found_out(excited: FlightLog) -> None:
    with pytest.raises(HaltereError, match="in the log's order the vehicle's rotors are 2, 1, 0, 3"):
        identify_vehicle(reordered(excited, (2, 1, 0, 3)), vehicle="iris", set=TEMPERATURE)


def test_spins_the_other_way_round_are_found_out(excited: FlightLog) -> None:
    vehicle = load_vehicle("iris")
    wrong = replace(vehicle, rotors=tuple(replace(r, spin=-r.spin) for r in vehicle.rotors))
    with pytest.raises(HaltereError, match="every spin is the other way round"):
        identify_vehicle(excited, vehicle=wrong, set=TEMPERATURE)


def test_without_geometry_the_signs_are_found(excited: FlightLog) -> None:
    d = identify_vehicle(excited, set=TEMPERATURE)
    expected = np.sign(np.array(weights(load_vehicle("iris"))))
    assert (d.layout.found == expected).all()
    assert parse_vehicle(to_toml(d)).rotors == ()


def test_instruments_against_least_squares_under_noise() -> None:
    """Gentle flight, 3 rad/s of noise at 100 Hz: least squares loses a seventh of kR0, instruments much less (theory.md §7)."""
    flight = flown("figure-eight", "hummingbird", duration=100.0, wind=0.0, rate=100.0, noise=3.0, delay=0.013)
    d = identify_vehicle(flight, vehicle="hummingbird", set=TEMPERATURE)
    vehicle = load_vehicle("hummingbird")
    true = vehicle.rotors[0].k_T / np.array(vehicle.inertia[:2])
    for axis, k in ((3, true[0]), (4, true[1])):
        assert d.plain[axis, 0] < 0.9 * k
        assert abs(d.lumped.k[axis, 0] / k - 1.0) < 0.13


def test_a_motion_without_excitation_is_told() -> None:
    d = identify_vehicle(flown("hover", duration=60.0), vehicle="iris", set=TEMPERATURE)
    told = " ".join(d.notes)
    assert "the air is taken for still" in told
    assert "not told from none" in told
    vehicle = load_vehicle("iris")
    assert d.lumped.k[2, 0] == pytest.approx(-vehicle.rotors[0].k_T / vehicle.mass, rel=0.03)


@pytest.mark.parametrize("preset", ["literal", "rate"])
def test_other_presets(excited: FlightLog, identified: VehicleIdentification, preset: str) -> None:
    d = identify_vehicle(excited, preset, vehicle="iris", set=TEMPERATURE)
    used = PRESETS[preset]
    assert all(d.lumped.k[i, j] == 0.0 for i in range(6) for j in range(5) if j not in used[i])
    assert d.lumped.residual_sd[2] > identified.lumped.residual_sd[2]  # thrust without inflow (theory.md §5.2)
    assert lumped_of(d.as_vehicle()).preset == preset


def test_a_file_without_the_hubs_own_velocities_is_read(identified: VehicleIdentification) -> None:
    """Files of before: five constants of each moment, damping that does not go with the rotor speed."""
    vehicle = parse_vehicle(to_toml(identified))
    table: dict[str, Any] = json.loads(json.dumps(vehicle.lumped))
    del table["s1"]
    for axis in "rpq":
        table["k"][axis] = {name: v for name, v in table["k"][axis].items() if name[-1] not in "56"}
        table["covariance"][axis] = np.array(table["covariance"][axis])[:5, :5].tolist()
    found = lumped_of(replace(vehicle, lumped=table))
    assert found.k[:, :5] == pytest.approx(identified.lumped.k[:, :5])
    assert (found.k[:, 5:] == 0.0).all()
    assert found.s1 == 0.0
    del table["k"]["q"]["kQ3"]
    with pytest.raises(HaltereError, match="constants kQ0"):
        lumped_of(replace(vehicle, lumped=table))


def test_the_vehicle_file_gives_the_model_back(identified: VehicleIdentification) -> None:
    vehicle = parse_vehicle(to_toml(identified))
    found = lumped_of(vehicle)
    assert found.k == pytest.approx(identified.lumped.k)
    assert found.covariance == pytest.approx(identified.lumped.covariance)
    assert len(vehicle.rotors) == 4
    assert (np.linalg.eigvalsh(found.covariance) > -1e-12).all()
    assert json.loads(json.dumps(document(identified), allow_nan=False))["preset"] == "full"
    page = vehicle_page(identified, "haltere identify x")
    for words in ("not fitted", "kQ3", "measured", "U_R"):
        assert words in page


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"preset": "fuller"}, "preset"), ({"roll": [1.0]}, "one length"), ({"k": {}}, "constants kHx0"),
        ({"window": None}, "2 numbers window"),
        ({"residual_sd": [1.0]}, "6 numbers residual_sd"), ({"covariance": {"hx": [[1.0]]}}, "covariance of 5 by 5"),
    ],
)  # fmt: skip
def test_a_damaged_table_is_one_clear_error(identified: VehicleIdentification, change: dict[str, object], match: str) -> None:
    table = {**identified.lumped.table(), **change}
    with pytest.raises(HaltereError, match=match):
        lumped_of(Vehicle("x", 1.0, (1.0,) * 3 + (0.0,) * 3, lumped={k: v for k, v in table.items() if v is not None}))
    with pytest.raises(HaltereError, match="none"):
        lumped_of(load_vehicle("iris"))


def test_lost_and_repeated_rows_of_rotors(excited: FlightLog, identified: VehicleIdentification) -> None:
    rng = np.random.default_rng(4)
    rotors = excited["rotors"]
    columns = {k: v.copy() for k, v in rotors.columns.items()}
    lost = rng.random(len(rotors)) < 0.1
    columns["speed_2"][lost] = np.nan
    held = np.flatnonzero(~lost)[1::7]
    for k in range(4):
        columns[f"speed_{k}"][held] = columns[f"speed_{k}"][held - 1]
    d = identify_vehicle(FlightLog({**excited.streams, "rotors": columns}, excited.meta), vehicle="iris", set=TEMPERATURE)
    assert d.lumped.k[3:, 0] == pytest.approx(identified.lumped.k[3:, 0], rel=0.05)


def without_speeds(flight: FlightLog) -> FlightLog:
    rotors = {k: v for k, v in flight["rotors"].columns.items() if not k.startswith("speed_")}
    return FlightLog({**flight.streams, "rotors": rotors}, flight.meta)


def test_commands_where_there_is_no_telemetry(identified: VehicleIdentification) -> None:
    """The motor of the simulation: speed in proportion to command and voltage, 12.5 ms up and 25 ms down."""
    other = without_speeds(flown("lissajous", seed=8))
    d = identify_vehicle(without_speeds(flown("identify")), vehicle="iris", validate=other, set=TEMPERATURE)
    assert d.motor is not None
    assert 0.01 < d.motor.tau < 0.06
    assert any("modelled from commands" in n for n in d.notes)
    assert d.checks[-1].explained[2] > 0.8
    assert (d.checks[-1].error[2:] > 0.9 * identified.checks[-1].error[2:]).all()  # telemetry is not worse
    assert tomllib.loads(to_toml(d))["lumped"]["motor"]["tau"] == d.motor.tau


def test_logs_that_cannot_tell(excited: FlightLog) -> None:
    with pytest.raises(HaltereError, match="rotor speeds, or commands"):
        identify_vehicle(excited.without("rotors"))
    slow = excited["rotors"].where(slice(None, None, 50))
    with pytest.raises(HaltereError, match="rotor speeds a second"):
        identify_vehicle(FlightLog({**excited.streams, "rotors": slow}, excited.meta))
    with pytest.raises(HaltereError, match="preset"):
        identify_vehicle(excited, "whole")
    with pytest.raises(HaltereError, match="4 rotors"):
        identify_vehicle(excited, vehicle="hexarotor", set=TEMPERATURE)


def test_the_verb(tmp_path: Path, excited: FlightLog) -> None:
    from typer.testing import CliRunner

    folder = write_folder(excited, tmp_path / "flight")
    out = tmp_path / "made" / "mine.toml"
    result = CliRunner().invoke(app, ["identify", str(folder), "--vehicle", "iris", "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    assert set(json.loads(result.stdout)["constants"]) == {n for names in NAMES for n in names if n}
    assert {p.name for p in out.parent.iterdir()} == {"mine.toml", "mine.json", "mine.html"}
    assert tomllib.loads(out.read_text())["lumped"]["preset"] == "full"
    assert load_vehicle(out).lumped


def on_indiflight(folder: Path, unseen: tuple[str, ...]) -> VehicleIdentification:
    """Two flights fitted, others predicted."""
    logs = [[captured(next(folder.glob(f"*{k}.BFL"))) for k in names] for names in (("267", "281"), unseen)]
    return identify_vehicle(logs[0], validate=logs[1], still=True, set={"baro.temperature": 293.0, "timeout.gnss": 1.0})


def test_indiflight(shared_data: Path) -> None:
    d = on_indiflight(shared_data / "indiflight", ("259", "271", "262"))
    assert -6.6e-7 < d.lumped.k[2, 0] < -6.0e-7  # thrust over squared speed, 6.2 to 6.5e-7 by the recordings' own notes
    assert (np.sort(d.layout.found, axis=1) == np.array([-1.0, -1.0, 1.0, 1.0])).all()
    assert {tuple(c) for c in d.layout.found[:2].T} == {(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)}
    unseen = np.array([c.explained for c in d.checks if not c.seen])
    assert np.median(unseen[:, 2]) > 0.8
    assert (np.median(unseen[:, 3:], axis=0) > [0.5, 0.7, 0.7]).all()
    assert np.ptp([tr.speeds.lag for tr in d.tracks]) < 0.003


@pytest.mark.slow
def test_indiflight_whole(shared_data: Path) -> None:
    """All eight others, of which one (340, made for a film) is another vehicle to the moments, and one (230) was touched."""
    d = on_indiflight(shared_data / "indiflight", ("230", "257", "259", "262", "265", "271", "275", "340"))
    unseen = np.array([c.explained for c in d.checks if not c.seen])
    assert len(unseen) == 8
    assert (np.median(unseen[:, 2:], axis=0) > [0.75, 0.4, 0.6, 0.6]).all()


def test_wemuav_drag_is_explained_by_the_anemometers_wind(shared_data: Path) -> None:
    """The model of the square, whose wind was fitted and not told, leaves less of both flights in the wind of the mast than in none.

    Of its own flight and of the hover of another day.
    """
    flights = {path.stem.split("__")[-1]: wemuav(path) for path in sorted((shared_data / "wemuav").glob("FLY*.csv"))}
    square = identify_vehicle(flights["Square"], still=False)
    hover = identify_vehicle(flights["Hover"], still=True)
    for tr, arm in ((square.tracks[0], square.arm), (hover.tracks[0], hover.arm)):
        mast = flights[tr.motion.name.split("__")[-1]]["truth"]
        told = np.column_stack([mast["wind_n"], mast["wind_e"]])
        without, with_wind = (check(in_wind(tr, mast.t, w), square.lumped, arm, False) for w in (0.0 * told, told))
        assert np.linalg.norm(with_wind.error[:2]) < 0.5 * np.linalg.norm(without.error[:2])


def test_wemuav_thrust_is_one_constant(shared_data: Path) -> None:
    found = []
    for path in sorted((shared_data / "wemuav").glob("FLY*.csv")):
        flight = wemuav(path)
        first = {name: s.where((s.t >= 0.0) & (s.t < 150.0)) for name, s in flight.streams.items()}
        found.append(identify_vehicle(FlightLog(first, flight.meta)).lumped.k[2, 0])
    assert len(found) == 2
    assert found[0] == pytest.approx(found[1], rel=0.03)
