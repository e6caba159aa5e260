"""Fault words, and faults put into flights: exact in time and size, recorded, refused where the data cannot carry them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

import haltere
from haltere.errors import HaltereError, UsageError
from haltere.flight.folder import write_folder
from haltere.flight.log import FlightLog, FlightMeta, Stream
from haltere.simulate import inject, parse_fault
from haltere.simulate.faults import disturbances

DEG = math.pi / 180.0

WORDS = {
    "gyro.x:bias=3deg/s@60": ("gyro", 0, "x", "bias", 3 * DEG, "", 60.0, math.inf),
    "magnetometer:disturb=0.3@20-30": ("magnetometer", 0, None, "disturb", 0.3, "", 20.0, 30.0),
    "gnss:dropout@100-130": ("gnss", 0, None, "dropout", math.nan, "", 100.0, 130.0),
    "model.hx:bias=0.8m/s2@1": ("model", 0, "hx", "bias", 0.8, "", 1.0, math.inf),
    "model.r:bias=3rad/s2@1": ("model", 0, "r", "bias", 3.0, "", 1.0, math.inf),
    "rotor.2:thrust=0.85@1": ("rotor", 0, "2", "thrust", 0.85, "", 1.0, math.inf),
    "wind.n:step=4m/s@1": ("wind", 0, "n", "step", 4.0, "", 1.0, math.inf),
    "gyro.1.z:stuck@10-11.5": ("gyro", 1, "z", "stuck", math.nan, "", 10.0, 11.5),
    "accel.y:ramp=0.1m/s2/s@5": ("accel", 0, "y", "ramp", 0.1, "", 5.0, math.inf),
    "gyro.y:ramp=0.1deg/s/s@5": ("gyro", 0, "y", "ramp", 0.1 * DEG, "", 5.0, math.inf),
    "gnss.n:bias=1.5m/s@5": ("gnss", 0, "n", "bias", 1.5, "velocity", 5.0, math.inf),
    "gnss.n:bias=3m@5": ("gnss", 0, "n", "bias", 3.0, "position", 5.0, math.inf),
    "gnss.d:ramp=0.5m/s@5": ("gnss", 0, "d", "ramp", 0.5, "position", 5.0, math.inf),
    "gnss.d:ramp=0.5m/s/s@5": ("gnss", 0, "d", "ramp", 0.5, "velocity", 5.0, math.inf),
    "accel.z:scale=0.85@5": ("accel", 0, "z", "scale", 0.85, "", 5.0, math.inf),
    "imu:delay=200ms@5": ("imu", 0, None, "delay", 0.2, "", 5.0, math.inf),
    "barometer:bias=1hPa@5": ("barometer", 0, None, "bias", 100.0, "pressure", 5.0, math.inf),
    "barometer:bias=3m@5": ("barometer", 0, None, "bias", 3.0, "altitude", 5.0, math.inf),
    "rotors.0:bias=60rpm@5": ("rotors", 0, "0", "bias", 2 * math.pi, "", 5.0, math.inf),
    "accel:saturate=2g@5": ("accel", 0, None, "saturate", 2 * 9.80665, "", 5.0, math.inf),
    "imu:misalign=90deg@5": ("imu", 0, None, "misalign", math.pi / 2, "", 5.0, math.inf),
}


@pytest.mark.parametrize("word", WORDS)
def test_words_say_what_they_say(word: str) -> None:
    f = parse_fault(word)
    wanted = WORDS[word]
    got = (f.sensor, f.unit, f.axis, f.kind, f.size, f.quantity, f.start, f.end)
    for a, b in zip(got, wanted, strict=True):
        assert a == pytest.approx(b, rel=1e-12, nan_ok=True) if isinstance(b, float) else a == b


WRONG = {
    "gyro.q:bias=3deg/s@60": "an axis (x, y, z)",
    "gyr.x:bias=3@1": "did you mean 'gyro'?",
    "gyro.x:bais=3deg/s@1": "did you mean 'bias'?",
    "gyro.x:bias=3m@1": "a unit of gyro bias (rad/s, deg/s)",
    "gyro.x:bias@1": "a size for bias",
    "gyro.x:stuck=2@1": "no size for stuck",
    "gnss:disturb=0.3@1": "a fault that gnss can have",
    "rotor:thrust=.5@1": "which rotor",
    "wind:step=4m/s@1": "which axis",
    "gyro.x:bias=3deg/s@60-50": "an end after the start",
    "gyro.x:bias=3deg/s": "SENSOR[.UNIT][.AXIS]:KIND[=SIZE]@START[-END]",
    "gyro.x:ramp=3deg/s@5": "a unit of gyro ramp (rad/s/s, deg/s/s)",
    "accel:noise=-1m/s2@2": "a positive size",
    "gyro.x:bias=..deg/s@1": "a number",
    "": "SENSOR",
}


@pytest.mark.parametrize("word", WRONG)
def test_wrong_words_are_wrong_usage(word: str) -> None:
    with pytest.raises(UsageError) as error:
        parse_fault(word)
    assert WRONG[word] in str(error.value)


def flight() -> FlightLog:
    """Twenty seconds of numbers that are all different; attitude turning about the vertical at 9 deg/s."""
    rng = np.random.default_rng(1)
    t, s = np.arange(2000) / 100.0, np.arange(200) / 10.0

    def xyz(stem: str, n: int, centre: float = 0.0) -> dict:
        return {f"{stem}_{a}": centre + rng.standard_normal(n) for a in "xyz"}

    yaw = 9.0 * DEG * t
    return FlightLog(
        {
            "imu": {"t": t, **xyz("gyro", 2000), **xyz("accel", 2000, -5.0)},
            "imu.1": {"t": t, **xyz("gyro", 2000), **xyz("accel", 2000)},
            "magnetometer": {"t": t[::2], **xyz("mag", 1000, 25.0)},
            "gnss": {
                "t": s, "lat": 46.8 + 1e-5 * rng.standard_normal(200), "lon": 8.2 + 1e-5 * rng.standard_normal(200),
                "alt": 600.0 + rng.standard_normal(200), "vel_n": rng.standard_normal(200), "vel_e": rng.standard_normal(200),
                "vel_d": rng.standard_normal(200), "fix_type": np.full(200, 3.0),
            },
            "barometer": {"t": s, "pressure": 95000.0 + 10.0 * rng.standard_normal(200)},
            "rotors": {"t": s, **{f"speed_{k}": 500.0 + 9.0 * rng.standard_normal(200) for k in range(4)}},
            "truth": {"t": t, "q_w": np.cos(yaw / 2), "q_x": 0 * t, "q_y": 0 * t, "q_z": np.sin(yaw / 2)},
        },
        FlightMeta(name="made", field={"strength": 48.0}),
    )  # fmt: skip


def difference(word: str, stream: str, column: str, base: FlightLog | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, change and value before, of a column under one fault."""
    before = base or flight()
    after = inject(before, [word])
    assert after.meta.faults[-1]["word"] == word
    for name in before:
        if name != stream:
            assert after[name] == before[name]
    return before[stream].t, after[stream][column] - before[stream][column], before[stream][column]


def inside(t: np.ndarray, start: float, end: float = math.inf) -> np.ndarray:
    return (t >= start) & (t < end)


def test_bias_is_exact() -> None:
    t, d, _ = difference("gyro.y:bias=3deg/s@5-8", "imu", "gyro_y")
    np.testing.assert_allclose(d, np.where(inside(t, 5.0, 8.0), 3 * DEG, 0.0), atol=1e-15)
    _, other, _ = difference("gyro.y:bias=3deg/s@5-8", "imu", "gyro_x")
    assert not other.any()


def test_second_unit_alone() -> None:
    t, d, _ = difference("gyro.1.y:bias=3deg/s@5", "imu.1", "gyro_y")
    np.testing.assert_allclose(d, np.where(t >= 5.0, 3 * DEG, 0.0), atol=1e-15)


def test_ramp_grows_from_its_start() -> None:
    t, d, _ = difference("accel.z:ramp=0.1m/s2/s@5-15", "imu", "accel_z")
    np.testing.assert_allclose(d, np.where(inside(t, 5.0, 15.0), 0.1 * (t - 5.0), 0.0), atol=1e-14)


def test_scale_and_saturation() -> None:
    t, d, x = difference("accel.z:scale=0.85@5", "imu", "accel_z")
    np.testing.assert_allclose(d, np.where(t >= 5.0, -0.15 * x, 0.0), atol=1e-14)
    t, d, x = difference("accel.x:saturate=5m/s2@5", "imu", "accel_x")
    np.testing.assert_allclose(x + d, np.where(t >= 5.0, np.clip(x, -5.0, 5.0), x), atol=1e-14)


def test_stuck_holds_the_last_value_before() -> None:
    t, d, x = difference("gyro.x:stuck@5-6", "imu", "gyro_x")
    np.testing.assert_array_equal((x + d)[inside(t, 5.0, 6.0)].round(12), np.full(100, x[499].round(12)))
    assert not d[~inside(t, 5.0, 6.0)].any()


def test_noise_has_its_size_and_repeats() -> None:
    word = "gyro.x:noise=2deg/s@5"
    t, d, _ = difference(word, "imu", "gyro_x")
    n = int((t >= 5.0).sum())
    assert np.std(d[t >= 5.0]) == pytest.approx(2 * DEG, rel=4.0 / math.sqrt(2 * n))
    np.testing.assert_array_equal(d, difference(word, "imu", "gyro_x")[1])
    assert np.abs(np.corrcoef(d[t >= 5.0], difference(word.replace("x", "y"), "imu", "gyro_y")[1][t >= 5.0])[0, 1]) < 0.2


def test_spike_is_one_sample_or_one_a_second() -> None:
    _, d, _ = difference("accel.x:spike=30m/s2@5", "imu", "accel_x")
    assert np.flatnonzero(d).tolist() == [500]
    assert d[500] == pytest.approx(30.0)
    _, d, _ = difference("accel.x:spike=30m/s2@5-8", "imu", "accel_x")
    assert np.flatnonzero(d).tolist() == [500, 600, 700]


def test_dropout_leaves_samples_out() -> None:
    before = flight()
    after = inject(before, ["gnss:dropout@5-10"])
    np.testing.assert_array_equal(after["gnss"].t, before["gnss"].t[~inside(before["gnss"].t, 5.0, 10.0)])
    after = inject(before, ["magnetometer.y:dropout@5-10"])
    assert np.isnan(after["magnetometer"]["mag_y"]).sum() == inside(before["magnetometer"].t, 5.0, 10.0).sum()


def test_nan_and_delay() -> None:
    before = flight()
    after = inject(before, ["imu:nan@5-6"])
    assert np.isnan(after["imu"].vector("accel")).all(axis=1).sum() == 100
    late = inject(before, ["gnss:delay=300ms@5"])["gnss"]
    np.testing.assert_allclose(late.t, np.where(before["gnss"].t >= 5.0, before["gnss"].t + 0.3, before["gnss"].t), atol=1e-12)
    np.testing.assert_array_equal(late["vel_n"], before["gnss"]["vel_n"])
    back = inject(before, ["gnss:delay=350ms@5-6"])["gnss"]  # afterwards the stamps go on as before: still in order
    assert np.all(np.diff(back.t) > 0.0)
    assert sorted(back["vel_n"]) == sorted(before["gnss"]["vel_n"])


def test_misaligned_sensor_sees_the_world_turned_back() -> None:
    """A sensor turned by +90 degrees about z measures along its x axis what was along the body's y."""
    before = flight()
    after = inject(before, ["imu:misalign=90deg@5"])
    on = before["imu"].t >= 5.0
    for stem in ("gyro", "accel"):
        np.testing.assert_allclose(after["imu"][f"{stem}_x"][on], before["imu"][f"{stem}_y"][on], atol=1e-12)
        np.testing.assert_allclose(after["imu"][f"{stem}_y"][on], -before["imu"][f"{stem}_x"][on], atol=1e-12)
        np.testing.assert_array_equal(after["imu"][f"{stem}_z"], before["imu"][f"{stem}_z"])


def test_gnss_position_moves_by_metres() -> None:
    from pymap3d import geodetic2ned

    before = flight()
    after = inject(before, ["gnss.n:bias=30m@5", "gnss.e:bias=-20m@5", "gnss.d:bias=4m@5"])
    a, b = before["gnss"], after["gnss"]
    ned = np.column_stack(geodetic2ned(b["lat"], b["lon"], b["alt"], a["lat"], a["lon"], a["alt"]))
    on = a.t >= 5.0
    np.testing.assert_allclose(ned[on], np.broadcast_to([30.0, -20.0, 4.0], (on.sum(), 3)), atol=2e-3)
    assert np.abs(ned[~on]).max() < 1e-6
    np.testing.assert_array_equal(a["vel_n"], b["vel_n"])


def test_barometer_in_metres_and_pascal() -> None:
    t, d, p = difference("barometer:bias=3m@5", "barometer", "pressure")

    def height(x: np.ndarray) -> np.ndarray:
        return 44330.77 * (1.0 - (x / 101325.0) ** 0.190263)

    np.testing.assert_allclose(height(p + d) - height(p), np.where(t >= 5.0, 3.0, 0.0), atol=1e-8)
    t, d, _ = difference("barometer:bias=1hPa@5", "barometer", "pressure")
    np.testing.assert_allclose(d, np.where(t >= 5.0, 100.0, 0.0), atol=1e-9)


def test_disturbance_is_a_fraction_of_the_field_towards_east() -> None:
    before = flight()
    after = inject(before, ["magnetometer:disturb=0.25@5-10"])
    t = before["magnetometer"].t
    d = after["magnetometer"].vector("mag") - before["magnetometer"].vector("mag")
    yaw = 9.0 * DEG * t
    east = 12.0 * np.column_stack([np.sin(yaw), np.cos(yaw), 0 * yaw])  # east seen from a body that has turned by yaw
    np.testing.assert_allclose(d, np.where(inside(t, 5.0, 10.0)[:, None], east, 0.0), atol=1e-10)
    t, d, _ = difference("magnetometer.z:disturb=0.25@5", "magnetometer", "mag_z")
    np.testing.assert_allclose(d, np.where(t >= 5.0, 12.0, 0.0), atol=1e-12)
    with pytest.raises(HaltereError, match="give an axis"):
        inject(before.without("truth"), ["magnetometer:disturb=0.25@5"])


def test_faults_combine_in_order() -> None:
    before = flight()
    both = inject(before, ["gyro.x:bias=1deg/s@5", "gyro.x:scale=2@7"])
    x, t = before["imu"]["gyro_x"], before["imu"].t
    np.testing.assert_allclose(both["imu"]["gyro_x"], np.where(t >= 7.0, 2 * (x + DEG), np.where(t >= 5.0, x + DEG, x)), atol=1e-14)
    assert [f["word"] for f in both.meta.faults] == ["gyro.x:bias=1deg/s@5", "gyro.x:scale=2@7"]
    assert before.meta.faults == []


REFUSED = {
    "airdata:bias=1m/s@5": "a stream airdata",
    "gnss:dropout@500-600": "samples from 0.00 to 19.90 s",
    "rotors.7:scale=0.9@5": "columns speed_7",
    "gyro.2.x:bias=1deg/s@5": "a stream imu.2",
    "gyro.x:bias=0deg/s@5": "every sample stays as it was",
    "gyro.x:saturate=4000rad/s@5": "every sample stays as it was",
    "rotor.1:thrust=0.5@5": "use haltere simulate",
    "model.hx:bias=1m/s2@5": "use haltere simulate",
}


@pytest.mark.parametrize("word", REFUSED)
def test_what_the_data_cannot_carry_is_refused(word: str) -> None:
    with pytest.raises(HaltereError) as error:
        inject(flight(), [word])
    assert REFUSED[word] in str(error.value)
    assert not isinstance(error.value, UsageError)
    assert word in str(error.value)


def test_no_estimator_reads_the_faults(tmp_path: Path) -> None:
    """The list of faults is taken out of a flight: the solution is the same."""
    flown = haltere.simulate(haltere.Scenario(duration=30.0, fault=("gyro.x:bias=3deg/s@20",)))
    told = haltere.run(flown, set={"aid.zero_rate": "on"})
    silent = haltere.run(FlightLog(flown.streams, dataclasses.replace(flown.meta, faults=[])), set={"aid.zero_rate": "on"})
    for name, column in told.table.items():
        np.testing.assert_array_equal(column, silent.table[name])


@pytest.mark.real
@pytest.mark.parametrize(
    "word", [f"gyro.x:bias={s}deg/s@40" for s in (0.5, 3, 20)] + [f"accel.z:bias={s}m/s2@40-60" for s in (0.1, 0.8, 5)]
)
def test_faults_read_back_exactly_from_log_0036(shared_data: Path, tmp_path: Path, word: str) -> None:
    before = haltere.read(next((shared_data / "ardupilot").glob("log_0036*.bin")))
    _read_back(before, word, tmp_path)


@pytest.mark.real
@pytest.mark.parametrize("word", [f"gyro.x:bias={s}deg/s@4" for s in (0.5, 3, 20)] + [f"rotors.1:scale={s}@4" for s in (0.99, 0.96, 0.8)])
def test_faults_read_back_exactly_from_indiflight(shared_data: Path, tmp_path: Path, word: str) -> None:
    pytest.importorskip("orangebox")
    _read_back(haltere.read(next((shared_data / "indiflight").glob("*LOG00267*"))), word, tmp_path)


def _read_back(before: FlightLog, word: str, folder: Path) -> None:
    fault = parse_fault(word)
    back = haltere.read(write_folder(inject(before, [word]), folder / "faulty"))
    stream = "rotors" if fault.sensor == "rotors" else "imu"
    column = f"speed_{fault.axis}" if fault.sensor == "rotors" else f"{fault.sensor}_{fault.axis}"
    x, y, t = before[stream][column], back[stream][column], back[stream].t
    np.testing.assert_array_equal(t, before[stream].t)
    on = inside(t, fault.start, fault.end)
    assert on.any()
    assert not on.all()
    wanted = np.where(on, fault.size * x if fault.kind == "scale" else x + fault.size, x)
    np.testing.assert_array_equal(y, wanted)
    (recorded,) = back.meta.faults
    assert recorded == fault.as_table()


def test_disturbances_of_the_vehicle_and_the_air() -> None:
    D = disturbances([parse_fault(w) for w in ("model.hy:bias=0.8m/s2@5", "wind.e:ramp=0.5m/s/s@10-20", "rotor.1:thrust=0.7@3-4")], 4)
    assert D["push"].tolist() == [[0.0, 0.8, 0.0], [0.0] * 3, [0.0] * 3]
    assert D["wind"][1].tolist() == [0.0, 5.0, 0.0]
    assert D["rate"].tolist() == [0.0, 0.1, 0.0]
    assert (D["rotor"].tolist(), D["factor"].tolist()) == ([-1, -1, 1], [1.0, 1.0, 0.7])
    with pytest.raises(HaltereError, match="from 0 to 3"):
        disturbances([parse_fault("rotor.4:thrust=0.7@3")], 4)


def test_streams_are_whole_without_faults() -> None:
    before = flight()
    after = inject(before, [])
    assert isinstance(after["imu"], Stream)
    assert all(after[name] == before[name] for name in before)
