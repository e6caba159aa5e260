"""Corrupted input, case by case: it is left out and counted, or warned of, or refused in one sentence. Never a crash, never poison."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from haltere.drive import run
from haltere.errors import HaltereError, UsageError
from haltere.estimators.base import Estimator
from haltere.flight.door import check, first_fix
from haltere.flight.log import FlightLog, FlightMeta, Stream
from haltere.flight.solution import Solution
from haltere.simulate import demo_flight

FloatArray = NDArray[np.float64]
Columns = dict[str, Any]
AXES = {"imu": ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"), "magnetometer": ("mag_x", "mag_y", "mag_z")}


@pytest.fixture(scope="module")
def flight() -> FlightLog:
    return demo_flight(2, 30.0, imu_rate=100.0)


@pytest.fixture(scope="module")
def clean(flight: FlightLog) -> Solution:
    return run(flight)


def spoilt(flight: FlightLog, stream: str, change: Callable[[Columns], Any]) -> FlightLog:
    """The flight with one stream's columns changed in place, the others untouched."""
    columns: Columns = {name: values.copy() for name, values in flight[stream].columns.items()}
    change(columns)
    return FlightLog({**flight.streams, stream: columns}, flight.meta)


def replaced(flight: FlightLog, stream: str, other: Stream | None) -> FlightLog:
    streams: dict[str, Any] = {k: v for k, v in flight.streams.items() if k != stream}
    if other is not None:
        streams[stream] = other
    return FlightLog(streams, flight.meta)


def put(name: str, rows: Any, value: float) -> Callable[[Columns], None]:
    def change(c: Columns) -> None:
        c[name][rows] = value

    return change


def times(factor: float, *names: str) -> Callable[[Columns], None]:
    def change(c: Columns) -> None:
        for name in names:
            c[name] = factor * c[name]

    return change


def swap(i: int, j: int) -> Callable[[Columns], None]:
    def change(c: Columns) -> None:
        for values in c.values():
            values[[i, j]] = values[[j, i]]

    return change


def reverse(c: Columns) -> None:
    for name in c:
        c[name] = c[name][::-1].copy()


def repeat(rows: slice) -> Callable[[Columns], None]:
    def change(c: Columns) -> None:
        order = np.sort(np.r_[np.arange(len(c["t"])), np.arange(len(c["t"]))[rows]])
        for name in c:
            c[name] = c[name][order]

    return change


def all_finite(solution: Solution) -> bool:
    return all(np.isfinite(column).all() for column in solution.table.values())


def distance(solution: Solution, clean: Solution) -> FloatArray:
    """How far two solutions are apart at the rows of the second [m]."""
    d = [np.interp(clean.t, solution.t, solution[f"pos_{a}"]) - clean[f"pos_{a}"] for a in "ned"]
    return np.asarray(np.linalg.norm(d, axis=0))


def angle(solution: Solution, clean: Solution) -> FloatArray:
    """The same of attitude [rad], at rows that both have."""
    _, i, j = np.intersect1d(solution.t, clean.t, return_indices=True)
    a, b = solution.vector("q", "wxyz")[i], clean.vector("q", "wxyz")[j]
    return np.asarray(2.0 * np.arccos(np.minimum(1.0, np.abs(np.sum(a * b, axis=1)))))


# Left out and counted

#: Stream, what is done to it, the reason under which it is counted, how often.
COUNTED: dict[str, tuple[str, Callable[[Columns], Any], str, int]] = {
    "imu nan": ("imu", put("gyro_x", [1500, 1501, 2000], math.nan), "not finite", 3),
    "imu inf": ("imu", put("accel_z", 1500, math.inf), "not finite", 1),
    "imu -inf": ("imu", put("gyro_z", slice(1500, 1505), -math.inf), "not finite", 5),
    "imu time nan": ("imu", put("t", [10, 1500], math.nan), "time not finite", 2),
    "imu time inf": ("imu", put("t", 1500, math.inf), "time not finite", 1),
    "imu repeated": ("imu", repeat(slice(1500, 1510)), "repeated time", 10),
    "imu swapped": ("imu", swap(1500, 1501), "out of order, sorted", 1),
    "imu reversed": ("imu", reverse, "out of order, sorted", 2999),
    "mag nan": ("magnetometer", put("mag_y", slice(700, 704), math.nan), "not finite", 4),
    "mag zero": ("magnetometer", lambda c: [put(n, slice(700, 703), 0.0)(c) for n in AXES["magnetometer"]], "zero", 3),
    "mag repeated": ("magnetometer", repeat(slice(700, 702)), "repeated time", 2),
    "mag reversed": ("magnetometer", reverse, "out of order, sorted", 1498),
    "gnss nan": ("gnss", lambda c: [put(n, 150, math.nan)(c) for n in ("lat", "vel_n")], "not finite", 1),
    "gnss zero place": ("gnss", lambda c: [put(n, slice(150, 152), 0.0)(c) for n in ("lat", "lon")], "latitude and longitude zero", 2),
    "gnss no fix": ("gnss", put("fix_type", slice(100, 103), 2.0), "no 3-D fix", 3),
    "gnss impossible": ("gnss", put("lat", 150, 91.0), "latitude or longitude impossible", 1),
    "gnss inf": ("gnss", put("lon", 150, math.inf), "latitude or longitude impossible", 1),
    "gnss worthless": ("gnss", put("h_acc", 150, 80.0), "accuracy worse than 50 m", 1),
    "gnss worthless, inf": ("gnss", put("h_acc", 150, math.inf), "accuracy worse than 50 m", 1),
    "gnss swapped": ("gnss", swap(150, 151), "out of order, sorted", 1),
    "gnss repeated": ("gnss", repeat(slice(150, 151)), "repeated time", 1),
    "baro nan": ("barometer", put("pressure", 400, math.nan), "not finite", 1),
    "baro zero": ("barometer", put("pressure", 400, 0.0), "pressure impossible in Pa", 1),
    "baro negative": ("barometer", put("pressure", 400, -94000.0), "pressure impossible in Pa", 1),
    "baro huge": ("barometer", put("pressure", 400, 5e5), "pressure impossible in Pa", 1),
    "baro hPa": ("barometer", times(0.01, "pressure"), "pressure impossible in Pa", 749),
}


@pytest.mark.parametrize("case", COUNTED)
def test_left_out_and_counted(case: str, flight: FlightLog, clean: Solution) -> None:
    """A few samples of one stream lost: the solution stays finite and next to the clean one, and the summary says how many."""
    stream, change, reason, n = COUNTED[case]
    solution = run(spoilt(flight, stream, change))
    assert solution.summary["streams"][stream]["discarded"].get(reason) == n
    assert all_finite(solution)
    settled = clean.t > 5.0
    assert distance(solution, clean)[settled].max() < 0.2
    assert angle(solution, clean).max() < math.radians(1.0)
    assert solution.t[-1] == clean.t[-1]


@pytest.mark.parametrize(
    "case", ["imu repeated", "imu swapped", "imu reversed", "mag repeated", "mag reversed", "gnss swapped", "gnss repeated"]
)
def test_what_can_be_put_in_order_loses_nothing(case: str, flight: FlightLog, clean: Solution) -> None:
    stream, change, _, _ = COUNTED[case]
    solution = run(spoilt(flight, stream, change))
    for name, column in clean.table.items():
        np.testing.assert_array_equal(solution[name], column, err_msg=name)


def test_the_log_itself_is_not_changed(flight: FlightLog) -> None:
    bad = spoilt(flight, "imu", lambda c: [reverse(c), put("gyro_x", 3, math.nan)(c)])
    before = {k: v.copy() for k, v in bad["imu"].columns.items()}
    run(bad)
    for name, values in before.items():
        np.testing.assert_array_equal(bad["imu"][name], values)


# One bad sample does not poison

#: A value that is not impossible in its format, in one sample.
OUTLIERS: dict[str, tuple[str, Callable[[Columns], Any]]] = {
    "fix 300 km off": ("gnss", put("lat", 150, 50.0)),
    "fix 1000 km high": ("gnss", put("alt", 150, 1e6)),
    "altitude nan": ("gnss", put("alt", 150, math.nan)),
    "altitude inf": ("gnss", put("alt", 150, math.inf)),
    "longitude nan": ("gnss", put("lon", 150, math.nan)),
    "velocity 1000 m/s": ("gnss", put("vel_n", 150, 1e3)),
    "velocity 1e100": ("gnss", put("vel_e", 150, 1e100)),
    "down velocity inf": ("gnss", put("vel_d", 150, math.inf)),
    "down velocity nan": ("gnss", put("vel_d", 150, math.nan)),
    "north velocity inf": ("gnss", put("vel_n", 150, math.inf)),
    "accuracy zero": ("gnss", put("s_acc", 150, 0.0)),
    "accuracy negative": ("gnss", lambda c: [put(n, 150, -1.0)(c) for n in ("h_acc", "v_acc", "s_acc")]),
    "accuracy tiny": ("gnss", lambda c: [put(n, 150, 1e-12)(c) for n in ("h_acc", "v_acc", "s_acc")]),
    "accuracy 1e9": ("gnss", lambda c: [put(n, 150, 1e9)(c) for n in ("v_acc", "s_acc")]),
    "accuracy inf": ("gnss", lambda c: [put(n, 150, math.inf)(c) for n in ("v_acc", "s_acc")]),
    "accuracy 1e150": ("gnss", lambda c: [put(n, 150, 1e150)(c) for n in ("v_acc", "s_acc")]),
    "field 1000 uT": ("magnetometer", put("mag_x", 700, 1e3)),
    "field 1e100": ("magnetometer", put("mag_z", 700, 1e100)),
    "pressure of 9 km": ("barometer", put("pressure", 400, 3e4)),
}


@pytest.mark.parametrize("case", OUTLIERS)
def test_one_bad_measurement_does_not_poison(case: str, flight: FlightLog, clean: Solution) -> None:
    stream, change = OUTLIERS[case]
    solution = run(spoilt(flight, stream, change))
    assert all_finite(solution)
    assert len(solution) == len(clean)
    assert distance(solution, clean).max() < 0.1
    assert angle(solution, clean).max() < math.radians(0.5)
    assert [e["kind"] for e in solution.events] == ["aligned"]


@pytest.mark.parametrize("value", [1e3, 1e6, 1e30, 1e100])
@pytest.mark.parametrize("name", ["gyro_x", "accel_y"])
def test_one_impossible_imu_sample_does_not_poison(name: str, value: float, flight: FlightLog, clean: Solution) -> None:
    """No vehicle turns at 57 000 deg/s or survives 100 g; a flipped bit in a log does. It is left out and counted."""
    solution = run(spoilt(flight, "imu", put(name, 1500, value)))
    assert all_finite(solution)
    assert distance(solution, clean)[-1] < 0.5
    assert angle(solution, clean)[-1] < math.radians(1.0)


@pytest.mark.parametrize("stamp", [1e9, -1e9])
def test_one_impossible_imu_time_does_not_poison(stamp: float, flight: FlightLog, clean: Solution) -> None:
    """A flipped bit in one time stamp, decades away: no memory is asked for the years in between."""
    solution = run(spoilt(flight, "imu", put("t", 1500, stamp)))
    assert all_finite(solution)
    near = solution.t[np.abs(solution.t) < 100.0]
    assert near[-1] == clean.t[-1]


@pytest.mark.parametrize("stream", ["gnss", "magnetometer", "barometer"])
@pytest.mark.parametrize("stamp", [1e9, -1e9])
def test_one_impossible_measurement_time_does_not_poison(stream: str, stamp: float, flight: FlightLog, clean: Solution) -> None:
    solution = run(spoilt(flight, stream, put("t", 200, stamp)))
    assert all_finite(solution)
    assert distance(solution, clean).max() < 0.1


# Refused, or warned of


@pytest.mark.parametrize(
    ("stream", "change", "message"),
    [
        ("imu", times(1.0 / 9.80665, *AXES["imu"][3:]), r"demo: stream imu: .*near 9\.81.*found median 1\.\d+; .*--set unit\.accel=g"),
        ("imu", times(1000.0 / 9.80665, *AXES["imu"][3:]), r"near 9\.81.*found median 1\.\d+e\+03; .*unit\.accel=mg"),
        ("imu", times(57.29578, *AXES["imu"][:3]), r"stream imu: expected angular rates in rad/s.*found.*--set unit\.gyro=deg/s"),
        ("imu", times(-1.0, *AXES["imu"][3:]), r"z near -9\.81.*found positive z.*axes\.imu=FLU.*axes\.accel=BLU"),
        ("imu", times(1e6, "t"), r"stream imu: expected an IMU of at least 10 Hz.*found 0\.0001 Hz.*microseconds: --set unit\.time=us"),
        ("imu", lambda c: c.pop("gyro_y"), r"stream imu: expected columns.*found no gyro_y"),
        ("imu", put("gyro_x", slice(None), math.nan), r"stream imu: expected at least 20 usable samples, found 0"),
        ("imu", put("t", slice(None), 5.0), r"stream imu: expected at least 20 usable samples, found 1"),
        ("imu", put("t", slice(None), math.nan), r"stream imu: expected at least 20 usable samples, found 0"),
    ],
    ids=["g", "milli-g", "deg per s", "gravity sign", "microseconds", "no column", "all nan", "one time", "no time"],
)  # fmt: skip
def test_refused_in_one_sentence(flight: FlightLog, stream: str, change: Callable[[Columns], Any], message: str) -> None:
    with pytest.raises(HaltereError, match=message) as caught:
        run(spoilt(flight, stream, change))
    error = caught.value
    assert error.expected
    assert error.found
    assert error.where
    assert "\n" not in str(error)


def test_rates_in_degrees_of_a_lively_flight_are_refused(flight: FlightLog) -> None:
    """Where the median tells: a vehicle that turns at 0.5 rad/s all the time."""
    turning = spoilt(flight, "imu", lambda c: c.update(gyro_z=c["gyro_z"] + 0.5))
    with pytest.raises(HaltereError, match=r"rad/s.*deg/s"):
        run(spoilt(turning, "imu", times(57.29578, *AXES["imu"][:3])))


@pytest.mark.parametrize(
    ("factor", "words"), [(0.01, "looks like gauss"), (10.0, "looks like milligauss"), (1e-6, "looks like tesla"), (1e4, "calibrate it")]
)
def test_magnetometer_in_another_unit_is_not_used_and_said(factor: float, words: str, flight: FlightLog, clean: Solution) -> None:
    solution = run(spoilt(flight, "magnetometer", times(factor, *AXES["magnetometer"])))
    assert any("magnetometer" in w and words in w for w in solution.summary["warnings"])
    assert solution.summary["streams"]["magnetometer"]["discarded"] == {"strength impossible in uT": 1499}
    assert not (solution.aids["sensor"] == "magnetometer").any()
    assert distance(solution, clean)[-1] < 1.0  # it flies without


def test_upside_down_is_no_error_of_ahrs(flight: FlightLog) -> None:
    """An attitude that was asked for at any attitude: the sign of gravity cannot be told from head down."""
    assert all_finite(run(spoilt(flight, "imu", times(-1.0, *AXES["imu"][3:])), "ahrs"))


# Streams that are short or missing


@pytest.mark.parametrize("stream", ["magnetometer", "gnss", "barometer"])
@pytest.mark.parametrize("rows", [None, slice(0, 0), slice(100, 101), slice(100, 102)], ids=["absent", "empty", "one", "two"])
def test_aids_may_be_missing(stream: str, rows: slice | None, flight: FlightLog) -> None:
    bad = replaced(flight, stream, None if rows is None else flight[stream].where(rows))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = run(bad)
    assert all_finite(solution)
    assert solution.t[-1] == flight["imu"].t[-1]
    fused = solution.aids["sensor"] == stream
    assert np.count_nonzero(fused) <= (0 if rows is None else 6 * (rows.stop - rows.start))


def test_imu_alone(flight: FlightLog) -> None:
    solution = run(FlightLog({"imu": flight["imu"]}))
    assert all_finite(solution)
    assert "lat" not in solution  # no place was ever known
    assert set(solution.aids["sensor"]) <= {"zero_velocity", "zero_rate", "fake_position"}


@pytest.mark.parametrize(
    ("streams", "message"),
    [
        ({}, r"stream imu: expected an imu stream.*found streams none"),
        ({"gnss": {"t": [0.0, 1.0]}}, r"stream imu: expected an imu stream.*found streams gnss"),
        ({"imu": {"t": []}}, r"stream imu: expected an imu stream"),
        ({"imu": {"t": [0.0]} | {n: [1.0] for n in AXES["imu"]}}, r"stream imu: expected at least 20 usable samples, found 1"),
    ],
    ids=["nothing", "no imu", "empty", "one sample"],
)
def test_without_imu_there_is_no_navigation(streams: dict[str, Any], message: str) -> None:
    with pytest.raises(HaltereError, match=message):
        run(FlightLog(streams, FlightMeta(name="mine")))


def test_too_short_a_log_says_what_it_takes(flight: FlightLog) -> None:
    with pytest.raises(HaltereError, match=r"expected an alignment.*found 0\.5 s of IMU"):
        run(replaced(flight, "imu", flight["imu"].where(slice(0, 50))))


def test_slow_imu_is_warned_of(flight: FlightLog) -> None:
    solution = run(replaced(flight, "imu", flight["imu"].where(slice(0, None, 4))))
    assert any("25 Hz is slow" in w for w in solution.summary["warnings"])
    assert all_finite(solution)


def test_ten_seconds_without_imu_are_told(flight: FlightLog) -> None:
    t = flight["imu"].t
    solution = run(replaced(flight, "imu", flight["imu"].where((t < 12.0) | (t > 22.0))))
    assert any("imu: 1 gap longer than 2 s, the longest 10 s" in w for w in solution.summary["warnings"])
    assert [e["kind"] for e in solution.events][:3] == ["aligned", "gap", "realigned"]
    assert solution.summary["streams"]["imu"]["gaps"] == 1
    assert all_finite(solution)


@pytest.mark.parametrize("stream", ["gnss", "magnetometer", "barometer"])
def test_ten_seconds_without_an_aid_are_survived(stream: str, flight: FlightLog, clean: Solution) -> None:
    t = flight[stream].t
    solution = run(replaced(flight, stream, flight[stream].where((t < 12.0) | (t > 22.0))))
    assert all_finite(solution)
    assert distance(solution, clean)[-1] < 1.0
    assert solution.summary["streams"][stream]["gaps"] == 1


def test_times_that_do_not_overlap_are_counted(flight: FlightLog) -> None:
    """GNSS stamped by another clock: none of it is used, and the summary says where it went."""
    later = run(spoilt(flight, "gnss", lambda c: c.update(t=c["t"] + 1e6)))
    assert later.summary["streams"]["gnss"]["discarded"]["after the last IMU sample"] == 2 * len(flight["gnss"])
    assert not (later.aids["sensor"] == "gnss").any()
    assert all_finite(later)


# What may be given


def lists(c: Columns) -> None:
    for name in c:
        c[name] = list(c[name])


def singles(c: Columns) -> None:
    for name in c:
        if name != "t":
            c[name] = c[name].astype(np.float32)


def strided(c: Columns) -> None:
    wide = np.asfortranarray(np.column_stack([np.repeat(v, 2) for v in c.values()]))
    for k, name in enumerate(list(c)):
        c[name] = wide[::2, k]


@pytest.mark.parametrize(("change", "exact"), [(lists, True), (strided, True), (singles, False)], ids=["lists", "strides", "float32"])
def test_arrays_of_any_kind_are_taken(change: Callable[[Columns], None], exact: bool, flight: FlightLog, clean: Solution) -> None:
    """Single precision is 6e-8 of 46.8 degrees: 0.3 m of position, so that GNSS keeps double here."""
    streams: dict[str, Any] = dict(flight.streams)
    for name in ("imu", "magnetometer", "barometer") if not exact else ("imu", "magnetometer", "barometer", "gnss"):
        columns: Columns = {k: v.copy() for k, v in flight[name].columns.items()}
        change(columns)
        streams[name] = columns
    solution = run(FlightLog(streams, flight.meta))
    assert distance(solution, clean).max() <= (0.0 if exact else 0.01)


def test_integers_and_holes_are_taken() -> None:
    """A body at rest whose columns are integers, with None where a value is missing."""
    n = 400
    imu: Columns = {"t": [0.01 * i for i in range(n)]} | {name: [0] * n for name in AXES["imu"]}
    imu["accel_z"] = np.full(n, -10, np.int16)
    imu["gyro_x"] = [None if i % 100 == 50 else 0 for i in range(n)]
    solution = run(FlightLog({"imu": imu}), "ahrs")
    assert all_finite(solution)
    assert solution.summary["streams"]["imu"]["discarded"]["not finite"] == 4


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"t": [0.0, 1.0], "gyro_x": [1.0]}, r"columns of one length.*t: 2, gyro_x: 1"),
        ({"t": np.zeros((3, 2))}, r"one-dimensional.*\(3, 2\).*|'t'.*one-dimensional"),
        ({"gyro_x": [1.0]}, r"a time column t.*gyro_x"),
        ({"t": ["a", "b"]}, r"a time column t"),
        ({"t": [0.0], "gyro_x": np.array([1j])}, r"numbers or text.*complex"),
    ],
    ids=["lengths", "two dimensions", "no time", "time is text", "complex"],
)
def test_streams_that_are_none(columns: Columns, message: str) -> None:
    with pytest.raises(HaltereError, match=message) as caught:
        FlightLog({"imu": columns})
    assert "imu" in str(caught.value)


@pytest.mark.parametrize(
    ("stream", "name"), [("imu", "gyro_x"), ("magnetometer", "mag_x"), ("gnss", "lat"), ("gnss", "s_acc"), ("barometer", "pressure")]
)
def test_text_where_numbers_belong_is_refused_or_left_out(stream: str, name: str, flight: FlightLog) -> None:
    """A column that a table gave as text."""
    bad = spoilt(flight, stream, lambda c: c.update({name: np.array(["n/a"] * len(c["t"]))}))
    try:
        solution = run(bad)
    except HaltereError as error:
        assert stream in str(error)
        assert name.partition("_")[0] in str(error)
    else:
        assert all_finite(solution)


# Options


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("noise.gyr", 1.0, r"a configuration key, found 'noise\.gyr'; did you mean 'noise\.gyro'\?"),
        ("gate_gnss", 1.0, r"did you mean 'gate\.gnss'\?"),
        ("delay.gps", 0.1, r"a configuration key, found 'delay\.gps'"),
        ("aid.gyro", "on", r"a configuration key, found 'aid\.gyro'"),
        ("noise.gyro", -1e-3, r"noise\.gyro.*-0\.001"),
        ("noise.barometer", 0.0, r"noise\.barometer.*0\.0"),
        ("noise.accel", math.nan, r"noise\.accel.*nan"),
        ("gate.gnss", math.inf, r"gate\.gnss.*inf"),
        ("noise.gyro", "big", r"a number.*noise\.gyro.*'big'"),
        ("delay.gnss", -0.1, r"between 0 and 2 for delay\.gnss_velocity.*-0\.1"),
        ("delay.barometer", 3.0, r"between 0 and 2 for delay\.barometer.*3\.0"),
        ("aid.gnss", "maybe", r"aid\.gnss to be off or on.*'maybe'"),
        ("aid.magnetometer", "3axis", r"aid\.magnetometer to be off or heading or 3-axis.*'3axis'"),
        ("baro.temperature", 15.0, r"between 200 and 330 for baro\.temperature.*15"),
        ("home.lat", math.inf, r"home\.lat.*inf"),
    ],
)
def test_wrong_keys_are_named(flight: FlightLog, key: str, value: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        run(flight, set={key: value})
    assert caught.value.where
    with pytest.raises(UsageError, match=message):
        Estimator("navigator", {key: value})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"estimator": "navigater"}, r"an estimator, found 'navigater'; did you mean 'navigator'\?"),
        ({"estimator": "ekf2"}, r"an estimator, found 'ekf2'; one of navigator, ahrs"),
        ({"preset": "as-printed"}, r"a preset of navigator \(default\), found 'as-printed'"),
        ({"preset": "fast"}, r"a preset of navigator \(default\), found 'fast'"),
        ({"estimator": "ahrs", "set": {"aid.gnss": "on"}}, r"a key that ahrs has, found 'aid\.gnss'"),
        ({"rate": 0.0}, r"a positive number of rows a second, found 0\.0"),
        ({"rate": math.nan}, r"a positive number of rows a second, found nan"),
        ({"config": "no/such/file.toml"}, r"a configuration file, found no such file"),
    ],
)
def test_wrong_options_are_named(flight: FlightLog, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        run(flight, **options)


@pytest.mark.parametrize(
    "meta", [{"noise": {"gyro": -1.0}}, {"noise": {"giro": 1.0}}, {"delays": {"gnss": -1.0}}, {"field": {"dipp": 1.0}}]
)
def test_what_a_flight_says_of_itself_is_checked_too(flight: FlightLog, meta: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=r"flight\.toml"):
        run(FlightLog(flight.streams, FlightMeta(**meta)))


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)])
def test_mounting_is_a_unit_quaternion(flight: FlightLog, q: tuple[float, float, float, float]) -> None:
    with pytest.raises(HaltereError, match=r"\[mounting\] imu: expected a unit quaternion"):
        run(FlightLog(flight.streams, FlightMeta(mounting={"imu": q})))


def test_home_is_whole_or_not_given(flight: FlightLog) -> None:
    with pytest.raises(UsageError, match=r"home\.lat, home\.lon and home\.alt together"):
        run(FlightLog(flight.streams), set={"home.lat": 46.8})


# The door alone


def test_check_leaves_good_streams_alone(flight: FlightLog) -> None:
    checked = check(flight)
    assert checked.discarded == {}
    assert set(checked.streams) == {"imu", "magnetometer", "gnss", "barometer"}
    for name, stream in checked.streams.items():
        assert stream == flight[name]


def test_what_the_reader_left_out_is_counted_on(flight: FlightLog) -> None:
    bad = spoilt(flight, "imu", put("gyro_x", 7, math.nan))
    bad.note_discarded("imu", "not finite", 5)
    bad.note_discarded("rotors", "broken", 2)
    assert check(bad).discarded == {"imu": {"not finite": 6}, "rotors": {"broken": 2}}
    assert bad.discarded["imu"] == {"not finite": 5}


def test_first_fix_is_the_first_whole_one() -> None:
    nan = math.nan
    gnss = Stream({"t": [0.0, 1.0, 2.0], "lat": [nan, 46.8, 46.9], "lon": [8.0, 8.2, 8.3], "alt": [1.0, 600.0, 700.0]})
    assert first_fix(gnss) == (46.8, 8.2, 600.0)
    assert first_fix(gnss.where(slice(0, 1))) is None
    assert first_fix(Stream({"t": [0.0]})) is None
    assert first_fix(None) is None


# Online


def test_online_bad_samples_are_left_out_and_counted() -> None:
    est = Estimator("navigator")
    for k in range(300):
        est.step(0.01 * k, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81))
    before = est.state
    for t, gyro, accel in (
        (3.0, (math.nan, 0.0, 0.0), (0.0, 0.0, -9.81)),
        (3.0, (0.0, 0.0, 0.0), (0.0, math.inf, -9.81)),
        (math.nan, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81)),
        (2.99, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81)),
        (1.0, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81)),
    ):
        est.step(t, gyro, accel)
    assert int(est.state.record["n_bad"][0]) == 5
    np.testing.assert_array_equal(est.state.P, before.P)
    nan = math.nan
    assert not est.offer("magnetometer", 3.0, (nan, 0.0, 40.0))
    assert not est.offer("magnetometer", 3.0, (0.0, 0.0, 0.0))
    assert not est.offer("barometer", 3.0, [nan])
    assert not est.offer("barometer", 3.0, [-1.0])
    assert not est.offer("barometer", 3.0, {"temperature": 20.0})
    assert not est.offer("gnss", 3.0, (nan, nan, nan))
    assert not est.offer("gnss", 1.0, (46.8, 8.2, 600.0))  # long past
    with pytest.raises(UsageError, match=r"gnss, barometer, magnetometer, power.*'lidar'"):
        est.offer("lidar", 3.0, [1.0])
    with pytest.raises(UsageError, match=r"3 to 6 values for gnss.*found 2"):
        est.offer("gnss", 3.0, (46.8, 8.2))
    with pytest.raises(UsageError, match=r"3 to 3 values for magnetometer.*found 4"):
        est.offer("magnetometer", 3.0, (1.0, 2.0, 3.0, 4.0))
    assert est.step(3.01, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81)).aligned
    assert np.isfinite(est.state.P).all()


@pytest.mark.parametrize("variances", [[math.inf] * 6, [-1.0] * 6, [math.nan] * 6, [0.0] * 6, [1e300] * 6])
def test_online_variances_that_mean_nothing_do_not_poison(variances: list[float]) -> None:
    est = Estimator("navigator", {"home.lat": 46.8, "home.lon": 8.2, "home.alt": 600.0})
    for k in range(600):
        t = 0.01 * k
        if k % 20 == 0:
            est.offer("gnss", t, (46.8, 8.2, 600.0, 0.0, 0.0, 0.0), variances if k == 400 else None)
        est.step(t, (0.001 * (k % 3), 0.0, 0.0), (0.0, 0.01 * (k % 5), -9.81))
    state = est.state
    assert state.aligned
    assert np.isfinite(state.P).all()
    assert np.isfinite(np.r_[state.q_nb, state.vel_n, state.pos_n]).all()
    assert int(state.record["n_aligned"][0]) == 1
