"""The rotorcraft of the simulator against an independent model, conservation laws and closed forms."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from haltere.errors import HaltereError, UsageError
from haltere.flight.vehicle import LIBRARY, Battery, Vehicle, load_vehicle, parse_vehicle
from haltere.simulate.rotorcraft import drift, new_body, vehicle_record
from haltere.vehicle.wrench import wrench

G = 9.81
#: From front-left-up to front-right-down and back.
FLIP = np.array([1.0, -1.0, -1.0])
CALM = (0.0, 0.0, 0.0)


def without_spin_inertia(vehicle: Vehicle) -> Vehicle:
    return dataclasses.replace(vehicle, rotors=tuple(dataclasses.replace(r, inertia=0.0) for r in vehicle.rotors))


def rotorpy_vehicle(name: str):
    pytest.importorskip("rotorpy")
    from importlib import import_module

    from rotorpy.vehicles.multirotor import Multirotor

    return Multirotor(import_module(f"rotorpy.vehicles.{name}_params").quad_params), Multirotor


@pytest.mark.parametrize("name", ["hummingbird", "crazyflie"])
def test_wrench_is_rotorpy_s(name: str) -> None:
    model, _ = rotorpy_vehicle(name)
    p = vehicle_record(without_spin_inertia(load_vehicle(name)))
    rng = np.random.default_rng(3)
    for _ in range(50):
        speeds = rng.uniform(0.3, 1.0, 4) * p["speed_max"][0]
        omega, air = 4.0 * rng.standard_normal(3), 8.0 * rng.standard_normal(3)
        force, moment = wrench(p[0], speeds, np.zeros(4), tuple(air), tuple(omega))
        theirs = model.compute_body_wrench(FLIP * omega, speeds, FLIP * air)
        np.testing.assert_allclose(force, FLIP * theirs[0], rtol=1e-7, atol=1e-9 * model.mass)
        np.testing.assert_allclose(moment, FLIP * theirs[1], rtol=1e-7, atol=2e-8 * abs(theirs[1]).max())


@pytest.mark.parametrize("name", ["hummingbird", "crazyflie"])
def test_two_seconds_are_rotorpy_s_to_a_millionth(name: str) -> None:
    """Its derivative integrated by DOP853 at 1e-12, against our step of 2 ms; commands leave a motor in transient throughout."""
    from scipy.integrate import solve_ivp

    model, multirotor = rotorpy_vehicle(name)
    vehicle = without_spin_inertia(load_vehicle(name))
    hover = vehicle.hover_speeds(G)
    rng = np.random.default_rng(1)
    command, wind = hover * (1.0 + 0.02 * rng.standard_normal(4)), np.array([3.0, -2.0, 0.5])
    pos, vel, omega = np.array([1.0, 2.0, -300.0]), np.array([0.5, -1.0, 0.2]), np.array([0.3, -0.2, 0.5])
    speeds = hover * np.array([1.1, 0.9, 1.0, 1.0])
    start = multirotor._pack_state(
        {
            "x": FLIP * pos,
            "v": FLIP * vel,
            "q": np.array([0.0, 0.0, 0.0, 1.0]),
            "w": FLIP * omega,
            "wind": FLIP * wind,
            "rotor_speeds": speeds,
        }
    )
    end = solve_ivp(lambda t, s: model._s_dot_fn(t, s, command), (0.0, 2.0), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]

    s = new_body(4)
    s["pos"][0], s["vel"][0], s["omega"][0], s["speed"][0] = pos, vel, omega, speeds
    drift(vehicle_record(vehicle), s, command, tuple(wind), G, 0.002, 1000)
    x, y, z, w = end[6:10]
    ours, theirs = s["q"][0], np.array([w, x, -y, -z])
    for got, wanted in (
        (s["pos"][0], FLIP * end[:3]), (s["vel"][0], FLIP * end[3:6]), (ours * math.copysign(1.0, ours @ theirs), theirs),
        (s["omega"][0], FLIP * end[10:13]), (s["speed"][0] / hover, end[16:] / hover),
    ):  # fmt: skip
        np.testing.assert_allclose(got, wanted, rtol=0.0, atol=1e-6)


def bare(**changes) -> Vehicle:
    """A body with rotors that do nothing, of an inertia with products."""
    rotors = tuple(
        dataclasses.replace(r, k_T=1e-30, k_M=1e-40, k_d=0.0, k_z=0.0, k_h=0.0, inertia=0.0) for r in load_vehicle("hummingbird").rotors
    )
    return dataclasses.replace(
        load_vehicle("hummingbird"), rotors=rotors, drag=CALM, inertia=(0.003, 0.004, 0.006, 3e-4, -2e-4, 1e-4), battery=None, **changes
    )


def matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_tumbling_keeps_angular_momentum_and_energy() -> None:
    vehicle = bare()
    s = new_body(4)
    s["pos"][0], s["omega"][0] = (0.0, 0.0, -1e4), (3.0, -5.0, 2.0)
    I = vehicle.inertia_matrix
    before, energy = I @ s["omega"][0], 0.5 * s["omega"][0] @ I @ s["omega"][0]
    drift(vehicle_record(vehicle), s, np.zeros(4), CALM, G, 0.002, 5000)
    np.testing.assert_allclose(matrix(s["q"][0]) @ I @ s["omega"][0], before, rtol=0.0, atol=1e-7 * np.linalg.norm(before))
    assert abs(0.5 * s["omega"][0] @ I @ s["omega"][0] / energy - 1.0) < 1e-7
    assert s["vel"][0, 2] == pytest.approx(10.0 * G, rel=1e-12)  # ten seconds of free fall
    assert s["pos"][0, 2] == pytest.approx(-1e4 + 50.0 * G, rel=1e-12)


def test_spinning_rotors_add_their_angular_momentum() -> None:
    """Rotor speeds change under command; what the rotors gain the body loses, and the sum is kept in the navigation frame."""
    vehicle = bare()
    vehicle = dataclasses.replace(
        vehicle, rotors=tuple(dataclasses.replace(r, inertia=2e-5, tau_up=0.3, tau_down=0.5) for r in vehicle.rotors)
    )
    s = new_body(4)
    s["pos"][0], s["omega"][0], s["speed"][0] = (0.0, 0.0, -1e4), (1.0, -2.0, 0.5), (400.0, 500.0, 300.0, 450.0)
    I = vehicle.inertia_matrix

    def momentum() -> np.ndarray:
        # counter-clockwise from above is a turn about up: minus z
        spins = sum(r.spin * r.inertia * w for r, w in zip(vehicle.rotors, s["speed"][0], strict=True))
        return matrix(s["q"][0]) @ (I @ s["omega"][0] + np.array([0.0, 0.0, -spins]))

    before = momentum()
    drift(vehicle_record(vehicle), s, np.array([800.0, 100.0, 700.0, 200.0]), CALM, G, 0.002, 1000)
    np.testing.assert_allclose(momentum(), before, rtol=0.0, atol=1e-6 * np.linalg.norm(before))
    assert np.linalg.norm(s["omega"][0] - [1.0, -2.0, 0.5]) > 0.1  # the rotors did turn it


@pytest.mark.parametrize("name", LIBRARY)
def test_hover_speeds_hold(name: str) -> None:
    vehicle = load_vehicle(name)
    s, hover = new_body(len(vehicle.rotors)), vehicle.hover_speeds(G)
    s["pos"][0], s["speed"][0] = (0.0, 0.0, -100.0), hover
    drift(vehicle_record(vehicle), s, hover, CALM, G, 0.002, 500)
    assert np.abs(s["vel"][0]).max() < 1e-3
    assert np.abs(s["omega"][0]).max() < 1e-3
    assert s["force"][0] == pytest.approx((0.0, 0.0, -G), abs=1e-3)


def test_motors_rise_and_fall_with_their_own_constants() -> None:
    vehicle = dataclasses.replace(bare(), rotors=tuple(dataclasses.replace(r, tau_up=0.05, tau_down=0.11) for r in bare().rotors))
    s = new_body(4)
    s["pos"][0], s["speed"][0] = (0.0, 0.0, -1e3), (100.0, 900.0, 500.0, 500.0)
    drift(vehicle_record(vehicle), s, np.full(4, 500.0), CALM, G, 0.002, 35)
    t = 0.07
    expected = (500.0 - 400.0 * math.exp(-t / 0.05), 500.0 + 400.0 * math.exp(-t / 0.11), 500.0, 500.0)
    np.testing.assert_allclose(s["speed"][0], expected, rtol=1e-12)


def test_falling_body_reaches_terminal_velocity() -> None:
    vehicle = dataclasses.replace(bare(), drag=(0.01, 0.01, 0.02))
    s = new_body(4)
    s["pos"][0] = (0.0, 0.0, -1e6)
    drift(vehicle_record(vehicle), s, np.zeros(4), CALM, G, 0.002, 30000)
    assert s["vel"][0, 2] == pytest.approx(math.sqrt(vehicle.mass * G / 0.02), rel=1e-6)


def test_at_rest_on_the_ground_it_feels_gravity_and_stays() -> None:
    vehicle = load_vehicle("iris")
    s = new_body(4)
    s["pos"][0, 2] = -0.3  # let it fall
    drift(vehicle_record(vehicle), s, np.zeros(4), (4.0, -3.0, 0.0), G, 0.002, 2000)
    assert np.abs(s["vel"][0]).max() < 2e-3
    assert abs(np.linalg.norm(s["force"][0]) - G) < 0.05
    before = s["pos"].copy()
    drift(vehicle_record(vehicle), s, np.zeros(4), CALM, G, 0.002, 5000)
    assert np.abs(s["pos"] - before).max() < 2e-3
    assert s["force"][0] == pytest.approx((0.0, 0.0, -G), abs=1e-6)


def test_battery_gives_the_power_asked_for() -> None:
    vehicle = dataclasses.replace(load_vehicle("hummingbird"), battery=Battery(12.0, 0.05, 2.0, sag=0.2, efficiency=0.5))
    s, hover = new_body(4), vehicle.hover_speeds(G)
    s["pos"][0], s["speed"][0] = (0.0, 0.0, -1000.0), hover
    drift(vehicle_record(vehicle), s, hover, CALM, G, 0.002, 5000)
    electrical = sum(r.k_M * w**3 for r, w in zip(vehicle.rotors, hover, strict=True)) / 0.5
    assert s["voltage"][0] * s["current"][0] == pytest.approx(electrical, rel=1e-6)
    source = 12.0 * (1.0 - 0.2 * s["used"][0] / 7200.0)
    assert s["voltage"][0] == pytest.approx(source - 0.05 * s["current"][0], rel=1e-5)
    assert s["used"][0] == pytest.approx(10.0 * s["current"][0], rel=3e-3)  # which rose by 0.3 % as the voltage fell


def test_thrust_of_tilted_rotors_is_along_their_axes() -> None:
    vehicle = load_vehicle("hexarotor")
    p = vehicle_record(vehicle)
    speeds = np.zeros(6)
    speeds[1] = 300.0
    force, moment = wrench(p[0], speeds, np.zeros(6), CALM, CALM)
    r = vehicle.rotors[1]
    np.testing.assert_allclose(force, r.k_T * 9e4 * np.array(r.axis), rtol=1e-12)
    np.testing.assert_allclose(moment, np.cross(r.position, force) - r.spin * r.k_M * 9e4 * np.array(r.axis), rtol=1e-12)


@pytest.mark.parametrize("name", LIBRARY)
def test_vehicle_files_round_trip(name: str) -> None:
    vehicle = load_vehicle(name)
    assert parse_vehicle(vehicle.to_toml()) == vehicle


def test_sources_of_published_vehicles() -> None:
    """Hover speeds and rotor drag as in theory.md §7."""
    for name, hover, mu in (("iris", 805.0, 0.365), ("hummingbird", 469.0, 0.447), ("crazyflie", 1788.0, 0.244)):
        vehicle = load_vehicle(name)
        speed = vehicle.hover_speeds(9.81).mean()
        assert speed == pytest.approx(hover, rel=1e-3)
        assert sum(r.k_d for r in vehicle.rotors) * speed / vehicle.mass == pytest.approx(mu, rel=0.01)


BROKEN = {
    "mass = 0.5": ("mass = -1", "a positive mass"),
    "inertia = [3.65e-3, 3.68e-3, 7.03e-3, 0.0, 0.0, 0.0]": ("inertia = [1.0, 1.0, 5.0, 0.0, 0.0, 0.0]", "real body"),
    "spin = -1": ("spin = 2", "spin +1"),
    "k_T = 5.57e-06": ("k_t = 5.57e-06", "did you mean 'k_T'"),
    "tau_up = 0.005": ("tau_up = 0", "positive tau_up"),
    "position = [": ("position = [1.0, ", "3 numbers position"),
}


@pytest.mark.parametrize("old", BROKEN)
def test_broken_vehicle_files_are_refused(old: str) -> None:
    from importlib import resources

    text = resources.files("haltere.flight").joinpath("vehicles", "hummingbird.toml").read_text(encoding="utf-8")
    new, words = BROKEN[old]
    assert old in text
    with pytest.raises(HaltereError) as error:
        parse_vehicle(text.replace(old, new, 1), "mine.toml")
    assert words in str(error.value)
    assert "mine.toml" in str(error.value)


def test_unknown_vehicle_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="hummingbird"):
        load_vehicle("humingbird")


def test_compiled_flight_is_that_of_plain_python(tmp_path: Path) -> None:
    """The same kernels uncompiled, in a process of their own: every column of every stream."""
    code = (
        "import sys, numpy as np\n"
        "from haltere._jit import COMPILED\n"
        "from haltere.simulate import Scenario, simulate\n"
        "wind = {'n': 3.0, 'gust': 1.0, 'shear': 0.2}\n"
        "flight = simulate(Scenario(mission='lissajous', duration=15.0, rest=0.5, landing=False, wind=wind,\n"
        "    sensors={'imu': {'preset': 'icm42688', 'arm_x': 0.05}}, fault=('rotor.1:thrust=0.9@10', 'wind.e:step=2m/s@9')))\n"
        "np.savez(sys.argv[1], compiled=COMPILED, **{f'{s}.{c}': flight[s][c] for s in flight for c in flight[s].names})\n"
    )
    made = []
    for jit in ("0", "1"):
        path = tmp_path / f"{jit}.npz"
        subprocess.run([sys.executable, "-c", code, str(path)], check=True, env={**os.environ, "HALTERE_JIT": jit})
        with np.load(path) as file:
            made.append(dict(file))
    plain, compiled = made
    assert (bool(plain.pop("compiled")), bool(compiled.pop("compiled"))) == (False, True)
    assert plain.keys() == compiled.keys()
    for name, column in plain.items():
        np.testing.assert_allclose(compiled[name], column, rtol=1e-9, atol=1e-9, err_msg=name)
