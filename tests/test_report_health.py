"""Sections on sensor health and consistency: drawn where the log has the data, told where it has not, and judged in words."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from haltere import drive
from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.metrics.sensors import FINDINGS, findings, sensor_table
from haltere.report.consistency import consistency_figures
from haltere.report.context import Context
from haltere.report.health import health
from haltere.report.series import Pool
from haltere.report.tables import consistency, data
from haltere.report.words import verdict, whiteness_in_words
from haltere.simulate import demo_flight

G = 9.80665
Shown = tuple[Solution, FlightLog]


@pytest.fixture(scope="module")
def demo() -> Shown:
    flight = demo_flight(seed=3, duration=60.0, imu_rate=250.0)
    return drive.run(flight), flight


def again(shown: Shown, **streams: dict[str, Any]) -> Context:
    """The same solution over a flight with other streams, its summary's facts of the sensors made anew."""
    solution, flight = shown
    flight = FlightLog({**flight.streams, **streams}, flight.meta)
    facts = sensor_table(solution, flight)
    summary = solution.summary | {"sensors": facts, "findings": findings(facts)}
    return Context(replace(solution, summary=summary), flight, Pool())


def names(figures: list[dict[str, Any]]) -> list[str]:
    return [f["name"] for f in figures]


def figure(c: Context, name: str) -> dict[str, Any]:
    return next(f for f in health(c).figures if f["name"] == name)


def imu_with(flight: FlightLog, **changed: Any) -> dict[str, Any]:
    return {**{k: v.copy() for k, v in flight["imu"].columns.items()}, **changed}


# --- what is drawn -------------------------------------------------------------------------------------------------------


def test_every_figure_has_a_title_a_reading_units_and_something_to_show(demo: Shown) -> None:
    c = Context(*demo, Pool())
    section = health(c)
    figures = [*section.figures, *consistency_figures(c)]
    assert names(section.figures) == ["imu_interval", "spectrum", "accel_spectrogram", "vibration", "field", "gnss_quality"]
    assert names(consistency_figures(c)) == ["nis", "nees", "whiteness"]
    for f in figures:
        assert f["title"]
        assert len(f["reading"]) > 20, f["name"]
        assert f["reading"].endswith((".", "!")), f["reading"]
        for axis in (k for k in f["layout"] if re.match(r"[xy]axis", k)):
            title = f["layout"][axis].get("title", {}).get("text", "")
            assert re.search(r"\[.+\]", title), (f["name"], axis)
            if axis.startswith("y"):
                short = axis.replace("axis", "")
                assert any(t["yaxis"] == short for t in f["traces"]), (f["name"], axis)


def test_what_the_log_lacks_is_said_and_not_drawn(demo: Shown) -> None:
    solution, flight = demo
    bare = FlightLog({"imu": flight["imu"]})
    aids = {k: v[:0] for k, v in solution.aids.items()}
    section = health(Context(replace(solution, aids=aids), bare, Pool()))
    assert names(section.figures) == ["imu_interval", "spectrum", "accel_spectrogram", "vibration"]
    assert "GNSS" in section.after
    assert "rotor speeds" in section.after
    assert "second IMU" in section.after
    c = Context(replace(solution, aids=aids), bare, Pool())
    assert consistency_figures(c) == []
    assert "<h2>" not in section.after
    nothing = health(Context(solution, FlightLog({}), Pool()))
    assert nothing.figures == []
    assert "GNSS" in nothing.after


@pytest.mark.parametrize("n", [0, 1, 2, 3, 40])
def test_short_streams_are_drawn_as_far_as_they_go(demo: Shown, n: int) -> None:
    solution, flight = demo
    short = {name: stream.where(slice(n)) for name, stream in flight.streams.items()}
    if n == 0:
        short["imu"] = flight["imu"].where(slice(1))
    c = again((solution, FlightLog(short)))
    section = health(c)
    assert "spectrum" not in names(section.figures) or n == 40
    consistency_figures(c)
    verdict(c)


def test_nis_is_drawn_with_its_band(demo: Shown) -> None:
    nis = consistency_figures(Context(*demo, Pool()))[0]
    assert [nis["layout"][f"yaxis{k}" if k > 1 else "yaxis"]["title"]["text"] for k in range(1, 5)] == [
        "baro. alt. [1]", "GNSS vel. [1]", "GNSS pos. [1]", "mag. heading [1]",
    ]  # fmt: skip
    assert all(nis["layout"][k]["type"] == "log" for k in nis["layout"] if k.startswith("yaxis"))
    assert sum(t["name"] == "95 % band" for t in nis["traces"]) == 8
    assert "None is above for long" in nis["reading"]


def test_whiteness_is_drawn_and_told(demo: Shown) -> None:
    c = Context(*demo, Pool())
    white = consistency_figures(c)[2]
    lines = [t for t in white["traces"] if t["name"] != "95 % band if white"]
    assert {len(t["x"]) for t in lines} == {40}
    assert "GNSS white" in white["reading"]
    assert max(abs(v) for t in lines for v in t["y"]) < 0.3
    assert names(consistency(c).figures) == ["nis", "nees", "whiteness"]


def test_spectrum_shows_lines_rotors_and_what_the_filter_assumes(demo: Shown) -> None:
    solution, flight = demo
    t = flight["imu"].t
    changed = imu_with(flight)
    changed["accel_z"] += 2.0 * np.sin(2 * np.pi * 62.0 * t)
    rotors = {"t": t[::50], "speed_0": np.full(len(t[::50]), 2 * np.pi * 62.0), "speed_1": np.full(len(t[::50]), 2 * np.pi * 60.0)}
    c = again((solution, flight), imu=changed, rotors=rotors)
    spectrum = figure(c, "spectrum")
    assert [a["text"] for a in spectrum["layout"]["annotations"]] == ["62 Hz"]
    assert spectrum["layout"]["shapes"][0]["x0"] == pytest.approx(60.0)
    assert "2 m/s² at 62 Hz (rotor speed)" in spectrum["reading"]
    assert spectrum["reading"].count("about as assumed") == 2
    given = [t for t in spectrum["traces"] if t["name"] == "assumed by the filter"]
    assert given[0]["y"][0] == pytest.approx(np.degrees(solution.config.number("noise.gyro")), rel=1e-3)
    assert given[1]["y"][0] == pytest.approx(solution.config.number("noise.accel"), rel=1e-3)
    assert "folded into this band" not in spectrum["reading"]


def test_a_slow_log_carries_its_caveat(demo: Shown) -> None:
    solution, flight = demo
    slow = flight["imu"].where(slice(None, None, 10))
    c = again((solution, flight), imu=dict(slow.columns))
    assert "Logged at 25 Hz" in figure(c, "spectrum")["reading"]
    assert "vibration" not in names(health(c).figures)
    assert "measure of vibration" in health(c).after


def test_spectrogram_is_small_and_has_its_gaps(demo: Shown) -> None:
    solution, flight = demo
    t = flight["imu"].t
    keep = (t < 20.0) | (t > 35.0)
    heat = figure(again((solution, flight), imu=dict(flight["imu"].where(keep).columns)), "accel_spectrogram")
    z = np.array(heat["traces"][0]["z"], dtype=float)
    x = np.array(heat["traces"][0]["x"])
    assert z.shape == (len(heat["traces"][0]["y"]), len(x))
    assert z.size <= 100 * 200
    assert np.isnan(z[:, (x > 21.0) & (x < 34.0)]).all()
    assert np.all(np.diff(x) >= 0.0)
    assert len(heat["table"]["rows"]) == len(x)
    assert len(heat["table"]["heads"]) == len(heat["table"]["rows"][0])


def test_ardupilot_s_vibration_is_drawn_where_it_is_logged(demo: Shown) -> None:
    t = np.arange(0.0, 60.0, 0.1)
    level = {f"vibe_{a}": np.full(len(t), v) for a, v in zip("xyz", (5.0, 6.0, 34.0), strict=True)}
    c = again(demo, vibration={"t": t, **level, "clip": np.zeros(len(t))})
    shown = figure(c, "vibration")
    assert "ArduPilot" in shown["title"]
    assert {"x", "y", "z", "acceptable"} <= {tr["name"] for tr in shown["traces"]}
    assert "too much" not in {tr["name"] for tr in shown["traces"]}, "a limit far away would flatten the rest"
    assert any("34.0 m/s² by ArduPilot" in s for s in verdict(c).sentences)


def test_field_is_drawn_with_the_model_and_further_units(demo: Shown) -> None:
    solution, flight = demo
    second = {k: v * (1.1 if k != "t" else 1.0) for k, v in flight["magnetometer"].columns.items()}
    current = {"t": np.arange(0.0, 60.0, 0.2), "current": 10.0 + 3.0 * np.sin(np.arange(0.0, 60.0, 0.2)), "voltage": np.zeros(300)}
    c = again((solution, flight), **{"magnetometer.1": second, "power": current})
    field = figure(c, "field")
    traces = {t["name"] for t in field["traces"]}
    assert {"measured", "expected", "tolerance of the filter", "further unit 1"} == traces
    assert "World Magnetic Model, 2026" in field["reading"]
    assert "No change with the motors is certain" in field["reading"]
    assert "magnetometer.1: field" in figure(c, "units")["reading"]


def test_clipping_and_frozen_axes_stand_in_the_table(demo: Shown) -> None:
    solution, flight = demo
    bits = np.zeros(len(flight["imu"]))
    bits[5000:5040] = 2.0
    frozen = flight["imu"]["gyro_x"].copy()
    frozen[8000:9000] = frozen[8000]
    c = again((solution, flight), imu=imu_with(flight, accel_clipping=bits, gyro_x=frozen))
    html = health(c).after
    assert re.search(r"<td>accel y</td><td class=\"num\">[\d.]+ m/s²</td><td><b>40</b>, t = 20\.0 … 20\.2 s", html)
    assert re.search(r"<td>gyro x</td>.*?4 s at 32\.0 s", html)
    said = verdict(c)
    assert said.level == "doubtful"
    assert "gyro" in said.headline
    assert "accelerometer" in said.headline
    assert any(s.startswith("Accelerometer: 40 samples at the end of its range between t = 20.0 and 20.2 s") for s in said.sentences)
    assert any(s.startswith("Gyro x did not change for 4.0 s from t = 32.0 s") for s in said.sentences)


def test_longest_intervals_are_in_the_table_of_streams(demo: Shown) -> None:
    html = data(Context(*demo, Pool())).after
    assert "longest interval [s]" in html
    assert re.search(r"<td>imu</td><td class=\"num\">15,000</td><td class=\"num\">250</td><td class=\"num\">250</td>", html)


# --- in words ------------------------------------------------------------------------------------------------------------


def test_a_healthy_flight_is_called_good(demo: Shown) -> None:
    said = verdict(Context(*demo, Pool()))
    assert said.level == "good"
    assert demo[0].summary["findings"] == []


MORE = {
    "frozen": {"axis": "gyro_x", "at": 3.0}, "field": {"strength": 0.4, "dip": 0.0}, "field_load": {"load": "current", "change": -18.0},
    "accel_difference": {"at": 7.0}, "gyro_difference": {"at": 7.0}, "clips": {"first": 1.0, "last": 9.0},
}  # fmt: skip
STREAM = {"field": "magnetometer", "field_load": "magnetometer", "accel_difference": "imu.1", "gyro_difference": "imu.1"}
STREAM |= dict.fromkeys(("h_acc", "v_acc", "s_acc", "num_sats"), "gnss")


@pytest.mark.parametrize("what", sorted(FINDINGS))
def test_every_finding_has_its_words(demo: Shown, what: str) -> None:
    solution, flight = demo
    value = 0.4 if what == "field" else 3.0 if what == "num_sats" else 1.5 * FINDINGS[what]
    found = {"stream": STREAM.get(what, "imu"), "what": what, "value": value, "limit": FINDINGS[what], **MORE.get(what, {})}
    said = verdict(Context(replace(solution, summary=solution.summary | {"findings": [found]}), flight, Pool()))
    plain = verdict(Context(solution, flight, Pool()))
    (sentence,) = [s for s in said.sentences if s not in plain.sentences]
    assert re.search(r"\d", sentence)
    assert sentence.endswith(".")
    assert "None" not in sentence
    assert "nan" not in sentence
    used = not found["stream"].endswith(".1")
    assert said.level == ("doubtful" if used else "good"), "a unit that was not used says nothing of the solution"
    assert (said.headline != plain.headline) == used


def event(sensor: str, axis: str | None, onset: float, kind: str = "bias", *, isolated: bool = True) -> dict[str, Any]:
    return {
        "sensor": sensor, "axis": axis, "kind": kind, "t_onset": onset, "t_detected": onset + 0.1, "t_recovered": None,
        "t_isolated": onset + 1.0 if isolated else None, "candidates": [], "statistic": 50.0, "threshold": 32.0, "evidence": "so",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("events", "headline"),
    [
        ([event("gyro", "x", 20.0)], "An inertial sensor failed: gyro x, first at t = 20.0 s; its effect was taken back"),
        ([event("gyro", "x", 20.0), event("gyro", "x", 25.0)], "An inertial sensor failed: gyro x, first at t = 20.0 s; its effect"),
        (
            [event("accel", "z", 30.0), event("gyro", "x", 20.0)],
            "An inertial sensor failed: gyro x and accelerometer z, first at t = 20.0 s",
        ),
        ([event("barometer", None, 20.0)], "A fault was found: barometer, from t = 20.0 s."),
        ([event("gnss", "n", 20.0)], "A fault was found: GNSS north, from t = 20.0 s."),
        ([event("rotors", "2", 20.0, "thrust")], "A fault was found: rotor 2 or its tachometer, from t = 20.0 s."),
        ([event("model", "q", 20.0)], "A fault was found: a yawing moment that the vehicle's model lacks, from t = 20.0 s."),
        (
            [event("gyro", "x", 35.0), event("barometer", None, 20.0)],
            "2 faults were found: barometer, from t = 20.0 s; gyro x, from t = 35.0 s; what gyro x did was taken back",
        ),
        ([event("model", "hx", 20.0, isolated=False)], "The sensors agree"),
        ([event("accel", "x", 33.4) | {"candidates": ["imu.2.accel.x"]}], "A fault was found: accelerometer x of imu.2, from t = 33.4 s."),
        (
            [event("rotors", None, 77.3, "thrust", isolated=False) | {"candidates": ["rotors"]}, event("gyro", "z", 30.0)],
            "2 faults were found: gyro z, from t = 30.0 s; motion that is not what the rotors should make, from t = 77.3 s; what gyro z",
        ),
    ],
)
def test_what_failed_is_the_headline(demo: Shown, events: list[dict[str, Any]], headline: str) -> None:
    solution, flight = demo
    said = verdict(Context(replace(solution, events=[*solution.events, *events]), flight, Pool()))
    assert said.headline.startswith(headline)
    assert said.level == ("doubtful" if headline[0] in "A2" else "good")


def test_findings_from_json_without_all_keys_are_told(demo: Shown) -> None:
    solution, flight = demo
    summary = {k: v for k, v in solution.summary.items() if k not in ("findings", "sensors", "whiteness")}
    c = Context(replace(solution, summary=summary), flight, Pool())
    assert verdict(c).level == "good"
    assert "spectrum" in names(health(c).figures)
    consistency_figures(c)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([("white", 0.01)], "white, as it should be"),
        ([("white", 0.01), ("nearly white", 0.1)], "white but for a trace"),
        ([("correlated", -0.4)], "alternating"),
        ([("correlated", 0.9), ("white", 0.0)], "lasting up to 2.0 s"),
        ([("correlated", 0.2)], "weakly correlated"),
    ],
)
def test_whiteness_in_words(rows: list[tuple[str, float]], words: str) -> None:
    table = {str(k): {"verdict": v, "lag1": r, "limit1": 0.05, "lasting": 2.0} for k, (v, r) in enumerate(rows)}
    assert words in whiteness_in_words(table)
