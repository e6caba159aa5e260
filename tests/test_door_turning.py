"""Axes and units told by physics: every wrong word found on motions of known truth, and no healthy recording accused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import haltere
from converters import broad, ecl_replay, inertialnav
from haltere.errors import HaltereError
from haltere.flight import axes, moving, turning
from haltere.flight.agreement import MAGNETOMETER_ENOUGH, judge, option
from haltere.flight.corrections import correct, mounted
from haltere.flight.door import check
from haltere.flight.log import FlightLog, FlightMeta, Stream
from haltere.simulate import Scenario, inject, simulate

FloatArray = NDArray[np.float64]
FIELD = np.array([20.0, 1.0, 43.0])  # north, east, down [uT]
DIP = float(np.arctan2(43.0, np.hypot(20.0, 1.0)))
GRAVITY = np.array([0.0, 0.0, -9.81])  # specific force of a body at rest, NED
NO_MAG = (np.empty(0), np.empty((0, 3)))


class Motion:
    """A body that is turned about all axes by hand, without acceleration: its attitude is exact, its gyro the true rate."""

    def __init__(self, seed: int = 0, seconds: float = 30.0, rate: float = 100.0, size: float = 0.5) -> None:
        rng = np.random.default_rng(seed)
        self.t = np.arange(int(seconds * rate)) / rate
        angles = np.zeros((3, len(self.t)))
        for k in range(3):
            for f in (0.11, 0.23, 0.41):
                angles[k] += size * rng.normal() * np.sin(2.0 * np.pi * f * self.t + rng.uniform(0.0, 6.0))
        angles[0] += 0.3 * self.t  # yaw turns round
        attitude = Rotation.from_euler("ZYX", angles.T)
        step = attitude[:-1].inv() * attitude[1:]
        middle = step.as_rotvec() * rate  # mean rate between the samples
        self.gyro = np.vstack([middle[:1], 0.5 * (middle[1:] + middle[:-1]), middle[-1:]])
        self.field = attitude.inv().apply(FIELD)
        self.force = attitude.inv().apply(GRAVITY)
        self.every = slice(None, None, 4)

    def mag(self, word: str = "FRD") -> tuple[FloatArray, FloatArray]:
        return self.t[self.every], self.field[self.every] @ axes.matrix(word)


@pytest.fixture(scope="module")
def motion() -> Motion:
    return Motion()


def test_words_are_all_signed_permutations() -> None:
    assert len(set(axes.WORDS)) == 48
    assert axes.WORDS[0] == "FRD"
    np.testing.assert_array_equal(axes.matrix("FRD"), np.eye(3))
    np.testing.assert_array_equal(axes.matrix("FLU"), np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_array_equal(axes.matrix("BLU"), -np.eye(3))
    np.testing.assert_array_equal(
        axes.matrix("RFU") @ [1.0, 2.0, 3.0], [2.0, 1.0, -3.0]
    )  # x points right, y forward, z up: as ENU is to NED
    for word in axes.WORDS:
        np.testing.assert_allclose(axes.matrix(word) @ axes.matrix(word).T, np.eye(3))
        assert axes.word(axes.matrix(word)) == word
    assert sum(np.linalg.det(axes.matrix(w)) > 0.0 for w in axes.WORDS) == 24
    assert all(np.linalg.det(axes.matrix(w)) > 0.0 for w in axes.WORDS[:24])


def test_the_gyro_explains_the_turning(motion: Motion) -> None:
    found = turning.compare(motion.t, motion.gyro, *motion.mag())
    assert found is not None
    assert found.given > 0.999
    assert (found.word, found.factor, found.others) == ("FRD", 1.0, ())
    assert found.agrees
    assert not found.disagrees


@pytest.mark.parametrize("word", axes.WORDS)
def test_every_gyro_word_is_found(word: str, motion: Motion) -> None:
    """The gyro as logged with axes ``word``: W takes it back."""
    found = turning.compare(motion.t, motion.gyro @ axes.matrix(word), *motion.mag())
    assert found is not None
    assert (found.word, found.factor) == (word, 1.0)
    assert found.best > 0.999
    assert found.disagrees == (word != "FRD")


@pytest.mark.parametrize("word", axes.WORDS)
def test_a_field_and_its_opposite_turn_alike(word: str, motion: Motion) -> None:
    """A magnetometer with axes W looks like a gyro with axes ±Wᵀ, the one of them that is a rotation: mirrored it is not the field's."""
    found = turning.compare(motion.t, motion.gyro, *motion.mag(word))
    W = axes.matrix(word)
    assert found is not None
    assert found.word == axes.word(W.T * np.linalg.det(W))


@pytest.mark.parametrize(("unit", "factor"), [(180.0 / np.pi, np.pi / 180.0), (np.pi / 180.0, 180.0 / np.pi), (1e3, 1e-3)])
def test_units_of_the_gyro_are_found(unit: float, factor: float, motion: Motion) -> None:
    for slow in (1.0, 0.05):  # gentle motions too: it is the factor that is seen, not the size
        t = motion.t / slow
        found = turning.compare(t, unit * slow * motion.gyro, t[motion.every], motion.field[motion.every])
        assert found is not None
        assert found.word == "FRD"
        assert found.factor == pytest.approx(factor)
        assert found.disagrees


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_hard_iron_accuses_nobody(seed: int, size: float, motion: Motion) -> None:
    """An offset in the body of up to three times the field: less is explained, and still by nothing better than the gyro as it is."""
    d = np.random.default_rng(seed).normal(size=3)
    t, m = motion.mag()
    found = turning.compare(motion.t, motion.gyro, t, m + size * np.linalg.norm(FIELD) * d / np.linalg.norm(d))
    assert found is None or not found.disagrees


@pytest.mark.parametrize("seed", range(6))
def test_noise_accuses_nobody(seed: int, motion: Motion) -> None:
    rng = np.random.default_rng(seed)
    t, m = motion.mag()
    noise = turning.compare(motion.t, motion.gyro, t, rng.normal(size=m.shape) * 3.0 + [20.0, 0.0, 43.0])
    other = turning.compare(motion.t, Motion(seed + 50).gyro, t, m)  # a gyro of another body
    assert noise is not None and other is not None
    assert not noise.disagrees and not other.disagrees


def test_a_body_that_hardly_turns_tells_nothing() -> None:
    still = Motion(seconds=20.0, size=0.001)
    still.gyro[:] = 0.0
    found = turning.compare(still.t, still.gyro, still.t[::4], np.tile(FIELD, (len(still.t[::4]), 1)))
    assert found is not None
    assert not found.enough(*MAGNETOMETER_ENOUGH)
    assert turning.compare(still.t[:2], still.gyro[:2], *NO_MAG) is None
    assert judge(still.t, -still.gyro, np.tile(GRAVITY, (len(still.t), 1)), *NO_MAG) is None


def test_a_gyro_that_fails_in_flight_has_no_wrong_axes() -> None:
    """A hover hardly turns, so that a rate of 20 deg/s that is not there outweighs what is: the log must not be refused for it."""
    found = 0
    for seed in range(78000, 78012):
        scenario = Scenario(
            mission="hover", duration=22.0 + 0.37 * (seed % 7) + 8.0, seed=seed, wind={"n": 5.2, "e": 3.0, "gust": 1.2}, landing=False
        )
        flight = inject(simulate(scenario), [f"gyro.x:bias=20deg/s@{22.0 + 0.37 * (seed % 7):g}"])
        imu, mag = flight["imu"], flight["magnetometer"]
        gyro, field = (np.column_stack([f[f"{name}_{c}"] for c in "xyz"]) for f, name in ((imu, "gyro"), (mag, "mag")))
        by_mag = turning.compare(imu.t, gyro, mag.t, field)
        assert by_mag is not None and not by_mag.disagrees
        found += by_mag.given < turning.DOUBT
    assert found  # as a whole it did explain little


def test_what_the_body_did_not_turn_about_is_said() -> None:
    """Turning about yaw alone: that z is turned over is seen, what x and y are is not."""
    t = np.arange(3000) / 100.0
    yaw = 0.8 * np.sin(0.7 * t)
    gyro = np.column_stack([0.0 * t, 0.0 * t, 0.56 * np.cos(0.7 * t)])
    field = Rotation.from_euler("z", yaw[:, None]).inv().apply(FIELD)
    found = turning.compare(t, -gyro, t, field)
    assert found is not None
    assert found.disagrees
    assert len(found.others) >= 3
    with pytest.raises(HaltereError, match=r"--set axes\.gyro=|axes\.magnetometer="):
        accused = judge(t, -gyro, np.tile(GRAVITY, (len(t), 1)), t, field)
        assert accused is not None
        raise HaltereError("", accused.remedy)


# Who is at fault: gyro, accelerometer and magnetometer of a body that shows gravity well


def test_three_that_agree(motion: Motion) -> None:
    assert judge(motion.t, motion.gyro, motion.force, *motion.mag(), dip=DIP) is None


@pytest.mark.parametrize("word", [w for w in axes.WORDS if w != "FRD"])
def test_the_gyro_against_two(word: str, motion: Motion) -> None:
    with pytest.raises(HaltereError, match=rf"stream imu: .*--set axes\.gyro={word}$"):
        judge(motion.t, motion.gyro @ axes.matrix(word), motion.force, *motion.mag(), dip=DIP)


@pytest.mark.parametrize("word", [w for w in axes.WORDS if w != "FRD"])
def test_the_magnetometer_against_two(word: str, motion: Motion) -> None:
    """With gravity and the dip, the very word of it, mirrored ones too; without the dip, it and its opposite."""
    accused = judge(motion.t, motion.gyro, motion.force, *motion.mag(word), dip=DIP)
    assert accused is not None
    assert accused.remedy == f"--set axes.magnetometer={word}"
    accused = judge(motion.t, motion.gyro, motion.force, *motion.mag(word))
    if word == "BLU":  # turns as the true field does
        assert accused is None
    else:
        opposite = axes.word(-axes.matrix(word))
        assert accused is not None
        assert set(accused.remedy.split(" or ")) == {f"--set axes.magnetometer={w}" for w in (word, opposite)}


@pytest.mark.parametrize("word", ["FLU", "RFD", "BRD", "LUF"])
def test_the_accelerometer_against_two(word: str, motion: Motion) -> None:
    with pytest.raises(HaltereError, match=rf"gyro and accelerometer.*--set axes\.accel={word}$"):
        judge(motion.t, motion.gyro, motion.force @ axes.matrix(word), *motion.mag(), dip=DIP)


def test_two_alone_are_two_suspects(motion: Motion) -> None:
    with pytest.raises(HaltereError, match=r"accelerometer's axes: --set axes\.accel=FLU; if the gyro's: --set axes\.gyro=FLU"):
        judge(motion.t, motion.gyro, motion.force @ axes.matrix("FLU"), *NO_MAG)
    with pytest.raises(HaltereError, match=r"mirrored ones.*--set axes\.gyro=FLD"):
        judge(motion.t, motion.gyro @ axes.matrix("FLD"), motion.force, *NO_MAG)
    with pytest.raises(HaltereError, match=r"--set unit\.gyro=deg/s"):
        judge(motion.t, np.degrees(motion.gyro), motion.force, *NO_MAG)


def test_the_option_is_on_top_of_what_is_set() -> None:
    """Axes that were given already and are still wrong: the option that is named replaces them."""
    turn = axes.matrix("FLU")
    assert option("gyro", turn, {"axes.gyro": "RFD"}, {}) == f"--set axes.gyro={axes.word(turn @ axes.matrix('RFD'))}"
    assert "[mounting]" in option("gyro", turn, {}, {"imu": (1.0, 0.0, 0.0, 0.0)})
    assert "[mounting]" not in option("magnetometer", turn, {}, {"imu": (1.0, 0.0, 0.0, 0.0)})


def test_levelled_is_the_sine_of_the_dip(motion: Motion) -> None:
    assert turning.levelled(motion.t, motion.force, *motion.mag()) == pytest.approx(np.sin(DIP), abs=0.01)
    assert turning.levelled(motion.t, motion.force, *motion.mag("BLU")) == pytest.approx(-np.sin(DIP), abs=0.01)
    assert np.isnan(turning.levelled(motion.t, 2.0 * motion.force, *motion.mag()))


# Corrections


def test_corrections_at_their_defaults_change_nothing(motion: Motion) -> None:
    flight = FlightLog({"imu": {"t": motion.t, "gyro_x": motion.t}})
    assert correct(flight, {}) is flight
    assert correct(flight, {"unit.time": "s", "unit.gyro": "rad/s", "axes.gyro": "FRD", "gate.gnss": 5.0}) is flight


def test_corrections_turn_every_instance_and_keep_nan_in_its_axis() -> None:
    nan = np.nan
    columns = {"t": [0.0, 1e3], "gyro_x": [1.0, nan], "gyro_y": [2.0, 5.0], "gyro_z": [3.0, 6.0]}
    flight = FlightLog({"imu": columns, "imu.1": columns, "gnss": {"t": [0.0], "alt": [1.0]}}, FlightMeta(time_offset=2e3))
    out = correct(flight, {"unit.time": "ms", "unit.gyro": "deg/s", "axes.gyro": "RFU"})
    for name in ("imu", "imu.1"):
        np.testing.assert_allclose(out[name].t, [0.0, 1.0])
        np.testing.assert_allclose(out[name].vector("gyro"), np.radians([[2.0, 1.0, -3.0], [5.0, nan, -6.0]]))
    assert out.meta.time_offset == pytest.approx(2.0)
    assert flight.meta.time_offset == 2e3
    assert flight["imu"]["gyro_x"][0] == 1.0
    assert len(out.notes) == 5


def test_mounting_is_the_rotation_it_says() -> None:
    q = Rotation.from_euler("ZYX", [0.3, -0.2, 0.9])
    x, y, z, w = q.as_quat()
    flight = FlightLog({}, FlightMeta(mounting={"imu": (w, x, y, z)}))
    v = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(mounted(flight, "imu", v), q.apply(v), atol=1e-12)
    np.testing.assert_array_equal(mounted(flight, "magnetometer", v), v)


def test_gravity_is_judged_in_the_body(motion: Motion) -> None:
    """An IMU mounted upside down, and said so, is not taken for one in other axes."""
    level = np.tile(GRAVITY, (600, 1)) + 0.01 * np.random.default_rng(0).normal(size=(600, 3))
    imu = {"t": np.arange(600) / 100.0} | {f"gyro_{a}": 0.001 * level[:, 0] for a in "xyz"}
    imu |= {f"accel_{a}": (level @ np.diag([1.0, -1.0, -1.0]))[:, k] for k, a in enumerate("xyz")}
    with pytest.raises(HaltereError, match="positive z"):
        check(FlightLog({"imu": imu}))
    assert check(FlightLog({"imu": imu}, FlightMeta(mounting={"imu": (0.0, 1.0, 0.0, 0.0)}))).warnings == []


# A receiver's own places and velocities


def _fixes(**change: FloatArray) -> Stream:
    t = np.arange(0.0, 60.0, 0.2)
    n, e, h = 60.0 * np.sin(0.11 * t), 40.0 * np.sin(0.17 * t + 1.0), 30.0 * np.sin(0.2 * t)
    v = {"vel_n": np.gradient(n, t), "vel_e": np.gradient(e, t), "vel_d": -np.gradient(h, t)}
    place = {"lat": 46.8 + n / 111.2e3, "lon": 8.2 + e / (111.2e3 * np.cos(np.radians(46.8))), "alt": 600.0 + h}
    return Stream({"t": t, **place, **v, **change})


def test_places_move_as_velocities_say() -> None:
    good = _fixes()
    found = moving.compare(good)
    assert found is not None
    assert found.given > 0.99
    assert moving.descends(good) > 0.99
    assert moving.descends(_fixes(vel_d=-good["vel_d"])) < -0.99
    for reading, change in (
        ("lat and lon", {"lat": good["lon"], "lon": good["lat"]}),
        ("vel_n and vel_e", {"vel_n": good["vel_e"], "vel_e": good["vel_n"]}),
        ("rad", {"lat": np.radians(good["lat"]), "lon": np.radians(good["lon"])}),
        ("cm/s", {"vel_n": 100.0 * good["vel_n"], "vel_e": 100.0 * good["vel_e"]}),
        ("km/h", {"vel_n": 3.6 * good["vel_n"], "vel_e": 3.6 * good["vel_e"]}),
    ):
        found = moving.compare(_fixes(**change))
        assert found is not None
        assert found.reading == reading
        assert found.disagrees == (reading != "km/h")  # 3.6 is not far enough from 1 to refuse a receiver for
    assert moving.compare(good.where(slice(0, 20))) is None
    assert np.isnan(moving.descends(good.where(slice(0, 20))))


def test_velocity_up_is_told() -> None:
    fixes = _fixes(vel_d=-_fixes()["vel_d"])
    imu = {"t": np.arange(6000) / 100.0} | {f"gyro_{a}": np.zeros(6000) for a in "xyz"}
    imu |= {"accel_x": np.zeros(6000), "accel_y": np.zeros(6000), "accel_z": np.full(6000, -9.81)}
    checked = check(FlightLog({"imu": imu, "gnss": fixes}))
    assert any("vel_d to be down, found it up" in w for w in checked.warnings)
    assert np.isnan(checked.streams["gnss"]["vel_d"]).all()
    assert checked.discarded["gnss"] == {"vel_d is up": 300}


# Recordings


@pytest.fixture(scope="module")
def recordings(shared_data: Path) -> dict[str, FlightLog]:
    folder = shared_data
    out = {p.name: haltere.read(p) for p in sorted((folder / "px4").glob("*.ulg"))}
    out |= {n: haltere.read(folder / "ardupilot" / n) for n in ("log_0036_mechanical_failure.bin", "log_0041_mechanical_failure.bin")}
    out |= {n: ecl_replay(folder / "px4_ecl_replay" / f"{n}.csv") for n in ("iris_gps", "ekf_gsf_reset")}
    out |= {
        n: inertialnav(folder / "inertialnav" / n, gauss=g)
        for n, g in (("quad106", 0.1), ("f450_glitch_log", 0.1), ("InputFilesPX4", 100.0))
    }
    return out | {p.stem: broad(p)[0] for p in sorted((folder / "broad").glob("*.mat"))}


#: What a check says that is no accusation.
HARMLESS = ("is slow for a strapdown filter", "longer than 2 s", "rows only hold the row before")


@pytest.mark.real
def test_no_healthy_recording_is_accused_and_every_wrong_one_is(recordings: dict[str, FlightLog]) -> None:
    """All recordings as they are pass; with wrong axes or units put on, what their turning can tell is told rightly."""
    told: dict[str, int] = {}
    judged = 0
    for name, flight in recordings.items():
        checked = check(flight)
        said = [w for w in checked.warnings if w not in flight.notes and not any(h in w for h in HARMLESS)]
        assert said == [], name
        imu, mag = checked.streams["imu"], checked.streams.get("magnetometer")
        if mag is None:
            continue
        gyro, field = imu.vector("gyro"), mag.vector("mag")
        found = turning.compare(imu.t, gyro, mag.t, field)
        if found is None or not found.enough(*MAGNETOMETER_ENOUGH):
            continue
        judged += 1
        assert found.given == found.best > 0.5, name  # none of 191 other readings is better
        steady = turning.compare(imu.t, gyro, imu.t, imu.vector("accel"), steady=0.4)
        assert steady is None or not (steady.given < turning.DOUBT and steady.best > 0.5), name  # margin to FOUND
        for word in ("FLU", "FRU", "RFD", "LFD", "BLU"):
            wrong = turning.compare(imu.t, gyro @ axes.matrix(word), mag.t, field)
            assert wrong is not None
            assert wrong.word == word, name
            told[word] = told.get(word, 0) + wrong.disagrees
        for unit in (180.0 / np.pi, np.pi / 180.0):
            wrong = turning.compare(imu.t, unit * gyro, mag.t, field)
            assert wrong is not None
            assert (wrong.word, wrong.factor) == ("FRD", pytest.approx(1.0 / unit)), name
            told["unit"] = told.get("unit", 0) + wrong.disagrees
        if np.isfinite(dip := _sine(flight, checked.streams.get("gnss"))) and abs(dip) > 0.35:
            assert np.sign(turning.levelled(imu.t, imu.vector("accel"), mag.t, field)) == np.sign(dip), name
    assert judged >= 20
    print(f"judged {judged}: {told}")
    assert told["FLU"] >= 0.85 * judged
    assert told["BLU"] >= 0.85 * judged
    assert told["unit"] >= 2 * 0.9 * judged


def _sine(flight: FlightLog, gnss: Stream | None) -> float:
    from haltere.flight.door import first_fix
    from haltere.flight.field import decimal_year, earth_field

    place = first_fix(gnss)
    return float(np.sin(earth_field(*place, decimal_year(flight.meta.start_utc)).dip)) if place else float("nan")


@pytest.mark.real
def test_places_and_velocities_of_recordings_agree(recordings: dict[str, FlightLog]) -> None:
    judged = 0
    for name, flight in recordings.items():
        gnss = check(flight).streams.get("gnss")
        found = moving.compare(gnss) if gnss is not None else None
        if found is not None:
            judged += 1
            assert found.given > 0.9, name
            assert not moving.descends(gnss) < 0.5, name
    assert judged >= 3
