"""Drag identified from flights in wind: models against their sources' arithmetic, coloured least squares, fits, coverage, the verb."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import haltere
from converters_air import wemuav
from haltere.aids import drag as aid
from haltere.cli import app
from haltere.flight import config as configuration
from haltere.flight.folder import write_folder
from haltere.flight.log import FlightLog, FlightMeta
from haltere.flight.vehicle import load_vehicle
from haltere.identify import NotObservableError, ardupilot_parameters, identify_drag, px4_parameters
from haltere.identify.coloured import Coloured
from haltere.identify.files import document, keys, to_toml
from haltere.identify.fitting import fit, without_wind
from haltere.identify.forms import FORMS, drag_force, drag_slopes
from haltere.identify.prepare import Samples, motion, samples
from haltere.identify.projection import project
from haltere.report.identification import drag_page
from haltere.simulate.scenario import Scenario

TEMPERATURE = {"baro.temperature": 288.15}
numbers = st.floats(-12.0, 12.0, allow_nan=False)


@settings(max_examples=50, deadline=None)
@given(numbers, numbers, numbers, st.floats(0.8, 1.3), st.floats(0.0, 0.8), st.floats(0.005, 0.1))
def test_models_are_what_their_sources_compute(x: float, y: float, z: float, rho: float, m: float, b: float) -> None:
    v, load, density = np.array([[x, y, z]]), np.array([9.0]), np.array([rho])
    speed = math.sqrt(x * x + y * y + z * z)
    px4 = drag_force("px4", np.array([m, b, b]), v, load, density)[0]
    for k, u in enumerate((x, y)):  # drag_fusion.cpp: both coefficients alike, so that its interpolation is the coefficient
        assert px4[k] == pytest.approx(-0.5 * b * rho * u * speed - u * m * math.sqrt(rho / 1.225), abs=1e-12)
    eas2tas = math.sqrt(1.225 / rho)
    ours = drag_force("ardupilot", np.array([m, b, 2.0 * b]), v, load, density)[0]
    for k, (u, c) in enumerate(((x, b), (y, 2.0 * b))):  # AP_NavEKF3_AirDataFusion.cpp
        density_ratio = math.sqrt(eas2tas)
        sign = -1.0 if u > 0.0 else 1.0
        assert ours[k] == pytest.approx(0.5 * c * 1.225 * density_ratio * u * u * sign - u * m * density_ratio, abs=1e-12)


@settings(max_examples=50, deadline=None)
@given(numbers, numbers, numbers, st.floats(0.1, 0.8), st.floats(0.0, 0.05))
def test_haltere_drag_is_that_of_the_navigator(x: float, y: float, z: float, mu: float, c: float) -> None:
    rho, thrust = 1.1, 12.0
    mine = drag_force("haltere", np.array([mu, c]), np.array([[x, y, z]]), np.array([thrust]), np.array([rho]))[0]
    ratio = rho / 1.225
    theirs = aid.drag_force((x, y, z), mu * math.sqrt(ratio * thrust / 9.80665), ratio * c)
    assert mine == pytest.approx(theirs[:2], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_slopes_are_derivatives(form: str) -> None:
    rng = np.random.default_rng(1)
    p = np.array([0.3, 0.02, 0.03, 0.2, 0.01, 0.02][: len(FORMS[form].names)])
    v, load, rho = rng.uniform(1.0, 8.0, (20, 3)), rng.uniform(8.0, 12.0, 20), np.full(20, 1.1)
    by_p, by_v = drag_slopes(form, p, v, load, rho)
    for k in range(len(p)):  # linear: exact for any step
        d = np.eye(len(p))[k]
        assert by_p[:, :, k] == pytest.approx(drag_force(form, p + d, v, load, rho) - drag_force(form, p, v, load, rho), abs=1e-8)
    for k in range(3):
        d = 1e-5 * np.eye(3)[k]
        assert by_v[:, :, k] == pytest.approx(
            (drag_force(form, p, v + d, load, rho) - drag_force(form, p, v - d, load, rho)) / 2e-5, abs=1e-6
        )


def test_coloured_noise_against_the_dense_matrix() -> None:
    rng = np.random.default_rng(2)
    n, m, l = 30, 2, 4
    t = np.cumsum(rng.uniform(0.05, 0.6, n))
    H, variance, time, noise = rng.standard_normal((n, m, l)), rng.uniform(0.1, 2.0, l), rng.uniform(0.3, 6.0, l), 0.07
    c = Coloured.of(t, H, variance, time, noise)
    K = np.zeros((n * l, n * l))
    for i in range(l):
        K[i::l, i::l] = variance[i] * np.exp(-np.abs(t[:, None] - t[None, :]) / time[i])
    G = np.zeros((n * m, n * l))
    for k in range(n):
        G[k * m : (k + 1) * m, k * l : (k + 1) * l] = H[k]
    S = G @ K @ G.T + noise * np.eye(n * m)
    X = rng.standard_normal((n, m, 3))
    assert c.weigh(X).reshape(n * m, 3) == pytest.approx(np.linalg.solve(S, X.reshape(n * m, 3)), rel=1e-8)
    assert c.log_det == pytest.approx(np.linalg.slogdet(S)[1], rel=1e-10)
    r = X[:, :, 0]
    assert c.paths(r).ravel() == pytest.approx(K @ G.T @ np.linalg.solve(S, r.ravel()), rel=1e-8)


def made(
    form: str, p: np.ndarray, wind: tuple[float, float], seed: int = 1, gust: float = 0.0, noise: float = 0.0, n: int = 700
) -> Samples:
    """Windows of a vehicle that goes about with a turning nose, its force made with a model, without any simulation."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    v = np.column_stack([5.0 * np.sin(0.4 * t), 4.0 * np.sin(0.27 * t + 1.0), 0.5 * np.sin(0.2 * t)])
    yaw, tilt = 0.9 * np.sin(0.1 * t) + 0.05 * t, 0.1 * np.cos(0.4 * t)
    C = np.empty((n, 3, 3))
    for k in range(n):
        c, s, a, b = math.cos(yaw[k]), math.sin(yaw[k]), math.cos(tilt[k]), math.sin(tilt[k])
        C[k] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[a, 0, b], [0, 1, 0], [-b, 0, a]])
    W = np.zeros((n, 3))
    W[:, :2] = wind
    decay = math.exp(-0.1 / 4.0)
    g = rng.standard_normal(2) * gust
    for k in range(n):
        W[k, :2] += g
        g = decay * g + gust * math.sqrt(1.0 - decay * decay) * rng.standard_normal(2)
    thrust, density = 10.0 + np.sin(0.5 * t), np.full(n, 1.15)
    speed = 1800.0 + 50.0 * np.sin(0.5 * t)
    air = np.einsum("kji,kj->ki", C, v - W)
    force = np.column_stack([drag_force(form, p, air, speed if form in ("rotors", "lumped") else thrust, density), -thrust])
    force[:, :2] += np.array([0.08, -0.05]) + noise * rng.standard_normal((n, 2))
    rates = np.zeros((n, 3))
    return Samples("made", t, C, v, np.zeros((n, 3)), rates, rates, force, density, speed)


@pytest.mark.parametrize("form", FORMS)
def test_what_was_put_in_comes_out(form: str) -> None:
    p = {"rotors": [1.2e-4, 0.012], "haltere": [0.35, 0.012], "lumped": [1.2e-4, 0.0, 0.012, 1.0e-4, 0.0, 0.02]}.get(
        form, [0.35, 0.012, 0.02]
    )
    p = np.array(p)
    r = fit(form, [made(form, p, (3.0, -2.0), gust=0.02, noise=0.005)])
    assert r.converged
    if form == "lumped":  # of linear drag with and without rotor speed the sum is told
        assert 1800.0 * r.values[[0, 3]] + r.values[[1, 4]] == pytest.approx(1800.0 * p[[0, 3]], rel=0.02)
        assert r.values[[2, 5]] == pytest.approx(p[[2, 5]], abs=1e-3)
    else:
        assert r.values == pytest.approx(p, rel=0.02, abs=3e-4)
    assert r.parts[0].wind == pytest.approx([3.0, -2.0], abs=0.08)
    assert r.parts[0].rest[:2] == pytest.approx([0.08, -0.05], abs=0.03)
    assert project(r, form).values == pytest.approx(r.values, rel=1e-6)  # a model in its own terms


def test_flights_share_the_drag_and_not_the_wind() -> None:
    p = np.array([0.35, 0.012])
    flights = [made("haltere", p, w, seed, 0.3, 0.1) for seed, w in enumerate(((3.0, -2.0), (-4.0, 1.0), (0.0, 0.0)))]
    one, three = fit("haltere", flights[:1]), fit("haltere", flights)
    assert (np.abs(three.values - p) < 4.0 * three.sd).all()
    assert (three.sd < 0.75 * one.sd).all()
    for part, wind in zip(three.parts, ((3.0, -2.0), (-4.0, 1.0), (0.0, 0.0)), strict=True):
        assert part.wind == pytest.approx(wind, abs=0.6)


def test_air_taken_for_still_ruins_the_drag() -> None:
    p = np.array([0.35, 0.012, 0.012])
    calm, windy = made("px4", p, (0.0, 0.0)), made("px4", p, (4.0, 0.0))
    for s in (calm, windy):
        s.force_b[:, :2] -= np.array([0.08, -0.05])
    assert without_wind("px4", [calm]) == pytest.approx(p, rel=1e-6)
    assert without_wind("px4", [windy])[0] < 0.85 * p[0]  # a nose that turns averages much of it out
    assert fit("px4", [windy]).values[0] == pytest.approx(p[0], rel=0.02)


def test_coverage_on_made_flights() -> None:
    p = np.array([0.35, 0.012])
    z = []
    for seed in range(14):
        r = fit("haltere", [made("haltere", p, (3.0, -2.0), seed, 0.6, 0.1, 400)])
        z.append((r.values - p) / r.sd)
    inside = (np.abs(np.array(z)) < 2.0).mean()  # 28 numbers, not independent: 95 % wanted
    assert inside >= 0.78


def flown(mission: str, seed: int, wind: dict[str, float], vehicle: str = "iris", **sensors: object) -> FlightLog:
    return haltere.simulate(Scenario(name=mission, vehicle=vehicle, mission=mission, duration=90.0, wind=wind, seed=seed, sensors=sensors))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def toured() -> FlightLog:
    return flown("tour", 4, {"n": 3.0, "e": -2.6, "gust": 0.6})


@pytest.fixture(scope="module")
def identified(toured: FlightLog) -> haltere.identify.DragIdentification:  # type: ignore[name-defined]
    return identify_drag(toured, set=TEMPERATURE)


def test_a_simulated_flight_in_wind(identified, toured: FlightLog) -> None:  # type: ignore[no-untyped-def]
    d = identified
    vehicle = load_vehicle("iris")
    k = np.array([vehicle.rotors[0].k_d / vehicle.mass, vehicle.drag[0] / vehicle.mass])
    assert d.base.form == "rotors"
    assert (np.abs(d.base.values - k) < 3.0 * d.base.sd).all()
    assert d.base.log_sd < 0.08
    truth = toured["truth"]
    mean = [float(np.interp(d.flights[0].t, truth.t, truth[f"wind_{a}"]).mean()) for a in "ne"]
    assert d.base.parts[0].wind_path.mean(axis=0) == pytest.approx(mean, abs=0.6)
    px4 = px4_parameters(d)
    mu = sum(r.k_d for r in vehicle.rotors) * vehicle.hover_speeds().mean() / vehicle.mass
    assert px4["EKF2_MCOEF"] == pytest.approx(mu, rel=0.15)
    assert px4["EKF2_DRAG_CTRL"] == 1.0
    assert ardupilot_parameters(d)["EK3_DRAG_M_NSE"] == 0.5
    for name in ("still",):
        assert getattr(d, name)["px4"][0] < 0.6 * mu  # what still air would have made of it


def test_onboard_and_truth_are_not_read(identified, toured: FlightLog) -> None:  # type: ignore[no-untyped-def]
    liar = {"t": toured["imu"].t, "vel_n": np.full(len(toured["imu"]), 50.0), "wind_n": np.full(len(toured["imu"]), -30.0)}
    other = FlightLog({**toured.without("truth").streams, "onboard": liar, "truth": liar}, toured.meta)
    assert (identify_drag(other, set=TEMPERATURE).base.values == identified.base.values).all()


def test_hover_is_refused() -> None:
    with pytest.raises(NotObservableError, match="not observable") as found:
        identify_drag(flown("hover", 1, {"n": 3.0, "e": -2.6, "gust": 0.6}))
    d = found.value.identification
    assert "fly forth and back" in str(found.value)
    assert document(d)["px4"] is None
    assert "Nothing: the flights do not tell" in drag_page(d)


def test_one_speed_one_line_is_less_certain_than_a_tour(identified) -> None:  # type: ignore[no-untyped-def]
    m = identified.motions[0]
    short = fit("rotors", [samples(replace(m, air=m.air & (m.t < 40.0)))])
    assert short.log_sd > identified.base.log_sd


def test_files_and_keys(identified, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    d = identified
    text = tmp_path / "drag.toml"
    text.write_text(to_toml(d))
    loaded = configuration.load(text)[2]
    assert loaded == keys(d)
    configuration.resolve("navigator", "default", loaded, "drag.toml")
    assert json.loads(json.dumps(document(d), allow_nan=False))["base"] == "rotors"
    page = drag_page(d, "haltere identify --drag x")
    for words in ("EKF2_MCOEF", "EK3_DRAG_BCOEF_X", "drag.toml", "air taken for still"):
        assert words in page


def test_limits_of_the_autopilots(identified) -> None:  # type: ignore[no-untyped-def]
    d = replace(identified, px4=replace(identified.px4, values=np.array([1.4, 1.0 / 500.0, 0.02])), force_sd=9.0)
    found = px4_parameters(d)
    assert found["EKF2_MCOEF"] == 1.0
    assert found["EKF2_BCOEF_X"] == 0.0  # beyond 200: off
    assert found["EKF2_BCOEF_Y"] == pytest.approx(50.0)
    assert found["EKF2_DRAG_NOISE"] == 10.0


def test_density_from_pressure_and_temperature(toured: FlightLog) -> None:
    cold = motion(toured, set={"baro.temperature": 273.15})
    warm = motion(toured, set={"baro.temperature": 303.15})
    assert cold.density.mean() / warm.density.mean() == pytest.approx(303.15 / 273.15)
    assert motion(toured).density_sd > cold.density_sd
    nothing = FlightLog({k: s for k, s in toured.streams.items() if k in ("imu", "gnss", "magnetometer")}, FlightMeta(name="bare"))
    assert motion(nothing).density.mean() == pytest.approx(1.155, rel=0.02)  # from GNSS altitude


def test_a_flight_without_gnss_is_refused_and_what_is_not_known_left_out(toured: FlightLog) -> None:
    with pytest.raises(haltere.HaltereError, match="GNSS velocity or position"):
        identify_drag(toured.without("gnss"), set=TEMPERATURE)
    gnss = toured["gnss"]
    lost = FlightLog({**toured.streams, "gnss": gnss.where(gnss.t < 40.0)}, toured.meta)
    m = motion(lost, set=TEMPERATURE)
    assert m.air[(m.t > 20.0) & (m.t < 39.0)].all()
    assert not m.air[(m.t > 65.0) & (m.t < 75.0)].any()  # nothing comes after that a smoother could hold on to
    assert any("left out" in n for n in m.notes)


def test_on_the_ground_is_not_in_the_air(toured: FlightLog) -> None:
    m = motion(toured)
    truth = toured["truth"]
    height = -np.interp(m.t, truth.t, truth["pos_d"])
    assert not m.air[(m.t < 4.0) | (height < 0.3)].any()
    assert m.air[height > 3.0].all()


def test_the_verb(tmp_path: Path, toured: FlightLog) -> None:
    from typer.testing import CliRunner

    folder = write_folder(toured, tmp_path / "flight")
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["identify", "--drag", str(folder), "--out", str(out), "--json", "--set", "baro.temperature=288.15"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["px4"]["EKF2_DRAG_CTRL"] == 1.0
    assert {p.name for p in out.iterdir()} == {"drag.json", "drag.toml", "drag.html"}


@pytest.mark.slow
def test_coverage_of_the_stated_confidence() -> None:
    """100 flights of two vehicles in 0 to 8 m/s with gusts, five missions: model by rotor speed against the vehicle's constants."""
    rng = np.random.default_rng(0)
    z, relative = [], []
    for seed in range(100):
        name, mission = ("hummingbird", "iris")[seed % 2], ("identify", "box", "lissajous", "tour", "figure-eight")[seed % 5]
        speed, toward = rng.uniform(0.0, 8.0), rng.uniform(0.0, 2.0 * np.pi)
        wind = {"n": speed * np.cos(toward), "e": speed * np.sin(toward), "gust": 0.1 + 0.15 * speed}
        try:
            flight = flown(mission, 300 + seed, wind, name)
        except haltere.HaltereError:
            continue
        vehicle = load_vehicle(name)
        k = np.array([vehicle.rotors[0].k_d / vehicle.mass, vehicle.drag[0] / vehicle.mass])
        r = fit("rotors", [samples(motion(flight, set=TEMPERATURE))])
        z.append((r.values - k) / r.sd)
        relative.append(r.values[0] / k[0] - 1.0)
    within = np.abs(np.array(z))
    assert len(z) >= 95
    assert 0.60 < (within[:, 0] < 1.0).mean() < 0.87
    assert (within < 2.0).mean() > 0.91
    assert np.median(np.abs(relative)) < 0.05


def test_wemuav(shared_data: Path) -> None:
    """A real quadrotor beside a wind mast at 10 Hz: 33 s of square tell the drag, minutes of hover do not."""
    flight = wemuav(next((shared_data / "wemuav").glob("FLY139*")))
    d = identify_drag(flight)
    truth = flight["truth"]
    mast = np.array([np.nanmean(np.interp(d.flights[0].t, truth.t, truth[f"wind_{a}"])) for a in "ne"])
    assert d.base.parts[0].wind_path.mean(axis=0) == pytest.approx(mast, abs=1.0)
    assert 0.1 < d.haltere.values[0] < 0.6
    hover = wemuav(next((shared_data / "wemuav").glob("FLY134*")))
    first = {name: s.where(s.t < 120.0) for name, s in hover.streams.items()}
    with pytest.raises(NotObservableError, match="hover"):
        identify_drag(FlightLog(first, hover.meta))


@pytest.mark.slow
def test_loiter_of_a_real_log_is_refused(shared_data: Path) -> None:
    with pytest.raises(NotObservableError):
        identify_drag(haltere.read(shared_data / "ardupilot" / "log_0036_mechanical_failure.bin"))
