"""The flight folder: what is written is what is read, in any frame, and never by halves."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from haltere.errors import HaltereError
from haltere.flight import folder
from haltere.flight.folder import read_folder, write_folder
from haltere.flight.log import FlightLog, FlightMeta, Home, Stream
from haltere.readers import read

ENU_TO_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_TO_FRD = np.diag([1.0, -1.0, -1.0])

finite = st.floats(allow_nan=False, allow_infinity=False)
words = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
names = st.from_regex(r"[a-z][a-z0-9_]{0,9}", fullmatch=True)


@st.composite
def streams(draw: st.DrawFn) -> Stream:
    n = draw(st.integers(0, 6))
    numbers = st.lists(st.floats(), min_size=n, max_size=n)
    columns: dict[str, Any] = {"t": np.array(draw(numbers), dtype=float)}
    for name in draw(st.sets(names, max_size=4)) - {"t"}:
        if draw(st.booleans()):
            columns[name] = np.array(draw(numbers), dtype=float)
        else:
            columns[name] = np.array(draw(st.lists(words, min_size=n, max_size=n)), dtype=np.str_)
    return Stream(columns)


quaternions = st.tuples(finite, finite, finite, finite)
stream_names = st.sampled_from(["imu", "imu.1", "gnss", "a stream/of mine", ".hidden", "actuators", "ümläut", "solution"])
metas = st.builds(
    FlightMeta,
    name=words,
    source=words,
    start_utc=st.none() | words,
    time_offset=finite,
    home=st.none() | st.builds(Home, finite, finite, finite),
    vehicle_file=st.none() | words,
    delays=st.dictionaries(names, finite, max_size=3),
    mounting=st.dictionaries(names, quaternions, max_size=2),
    noise=st.dictionaries(st.sampled_from(["gyro", "gyro.x", "accel_bias"]), finite, max_size=2),
    field=st.dictionaries(st.sampled_from(["declination", "dip", "strength"]), finite, max_size=3),
    imu_kind=st.sampled_from(["instant", "mean"]),
    faults=st.lists(st.dictionaries(names, finite | words | st.lists(finite, max_size=3), max_size=3), max_size=2),
)
flights = st.builds(
    FlightLog,
    st.dictionaries(stream_names, streams(), min_size=1, max_size=3),
    metas,
    st.lists(words, max_size=3),
    st.dictionaries(stream_names, st.dictionaries(words, st.integers(1, 10**9), max_size=2), max_size=2),
)


def _same(a: FlightLog, b: FlightLog) -> None:
    assert list(a.streams) == list(b.streams)
    for name, stream in a.streams.items():
        assert stream == b[name], name
        for column, values in stream.columns.items():
            if values.dtype.kind == "f":
                assert np.array_equal(np.signbit(values), np.signbit(b[name][column])) or np.isnan(values).any()
    assert a.meta == b.meta
    assert a.notes == b.notes
    assert a.discarded == b.discarded


@pytest.mark.parametrize("csv", [False, True])
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(flight=flights)
def test_round_trip_is_lossless(csv: bool, flight: FlightLog) -> None:
    with tempfile.TemporaryDirectory() as there:
        path = write_folder(flight, Path(there) / "flight", csv=csv)
        _same(flight, read_folder(path))
        assert not [p for p in Path(there).iterdir() if p.name.startswith(".")]


def test_is_found_by_content(tmp_path: Path) -> None:
    flight = FlightLog({"imu": {"t": [0.0, 1.0], "gyro_x": [1.0, np.nan]}}, FlightMeta(name="a"))
    path = write_folder(flight, tmp_path / "any name")
    _same(flight, read(path))
    _same(flight, read(path / "flight.toml"))


def test_hand_written_folder(tmp_path: Path) -> None:
    (tmp_path / "flight.toml").write_text(
        "start_utc = 2024-05-01T14:00:00+02:00\n[home]\nlat = 47\nlon = 8.5\nalt = 500\n[noise]\ngyro = 1\n[noise.accel]\nx = 2\n"
    )
    (tmp_path / "imu.csv").write_text("t, gyro_x, clip\n0, 1, yes\n1,,no\n2, 3.5,\n")
    (tmp_path / "gnss.csv").write_text("t,lat\n1,47\n")
    (tmp_path / "solution.parquet").write_bytes(b"a result, no stream")
    flight = read_folder(tmp_path)
    assert list(flight.streams) == ["imu", "gnss"]
    assert flight.meta.name == tmp_path.name
    assert flight.meta.start_utc == "2024-05-01T12:00:00.000Z"
    assert flight.meta.home == Home(47.0, 8.5, 500.0)
    assert flight.meta.noise == {"gyro": 1.0, "accel.x": 2.0}
    assert flight["imu"]["clip"].tolist() == ["yes", "no", ""]
    np.testing.assert_array_equal(flight["imu"]["gyro_x"], [1.0, np.nan, 3.5])


def test_enu_flu_becomes_ned_frd(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    n = 20
    enu_flu = Rotation.random(n, random_state=rng)
    q = enu_flu.as_quat()  # x, y, z, w
    body, mag, bias = rng.normal(size=(3, n, 3))
    columns = {
        "t": np.arange(n),
        **{f"q_{a}": q[:, i] for i, a in enumerate("xyzw")},
        **{f"accel_bias_{a}": bias[:, i] for i, a in enumerate("xyz")},
    }
    vel = {f"vel_{a}": rng.normal(size=n) for a in "ned"}
    flight = FlightLog(
        {
            "imu": {"t": np.arange(n), **{f"{s}_{a}": body[:, i] for s in ("gyro", "accel") for i, a in enumerate("xyz")}},
            "magnetometer.1": {"t": np.arange(n), **{f"mag_{a}": mag[:, i] for i, a in enumerate("xyz")}},
            "truth": {**columns, **vel},
        },
        FlightMeta(mounting={"imu": tuple(Rotation.from_euler("xyz", [0.2, 0.3, 0.4]).as_quat(scalar_first=True))}),
    )
    path = write_folder(flight, tmp_path / "f")
    text = (path / "flight.toml").read_text()
    (path / "flight.toml").write_text(text.replace("NED/FRD", "ENU/FLU"))
    ned = read_folder(path)
    turned = Rotation.from_matrix(ENU_TO_NED) * enu_flu * Rotation.from_matrix(FLU_TO_FRD)
    got = Rotation.from_quat(np.column_stack([ned["truth"][f"q_{a}"] for a in "xyzw"]))
    assert np.max((got * turned.inv()).magnitude()) < 1e-12
    for stream, stem, values in (
        ("imu", "gyro", body),
        ("imu", "accel", body),
        ("magnetometer.1", "mag", mag),
        ("truth", "accel_bias", bias),
    ):
        np.testing.assert_allclose(ned[stream].vector(stem), values @ FLU_TO_FRD.T)
    for name, values in vel.items():
        np.testing.assert_array_equal(ned["truth"][name], values)
    # A field seen from the navigation frame is the same field in either pair of frames.
    before = enu_flu.apply(mag) @ ENU_TO_NED.T
    np.testing.assert_allclose(got.apply(ned["magnetometer.1"].vector("mag")), before, atol=1e-12)
    # q_b_sensor: both ends turn over.
    sensor = Rotation.from_euler("xyz", [0.2, 0.3, 0.4]).as_matrix()
    mounted = Rotation.from_quat(np.array(ned.meta.mounting["imu"]), scalar_first=True).as_matrix()
    np.testing.assert_allclose(mounted, FLU_TO_FRD @ sensor @ FLU_TO_FRD, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nmae = 'x'", "did you mean 'name'"),
        ("frame = 'NED/FLU'", "NED/FRD"),
        ("[home]\nlat = 1\nlon = 2", "no alt"),
        ("[home]\nlat = '1'\nlon = 2\nalt = 3", "number for home.lat"),
        ("[hoem]\nlat = 1", "did you mean 'home'"),
        ("[field]\ndeclinaton = 1", "declination"),
        ("[mounting]\nimu = [1, 0, 0]", "quaternion"),
        ("[noise]\ngyro = true", "number for noise.gyro"),
        ("streams = ['imu', 'gnss']", "table for the stream 'gnss'"),
        ("time_offset = 'late'", "time_offset"),
        ("imu_kind = 'median'", "imu_kind"),
        ("notes = 3", "notes"),
        ("fault = 3", "[[fault]]"),
        ("name = ", "valid TOML"),
        ("[discarded]\nimu = 3", "[imu]"),
    ],
)
def test_bad_toml_is_told(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "flight.toml").write_text(text)
    (tmp_path / "imu.csv").write_text("t,gyro_x\n0,1\n")
    with pytest.raises(HaltereError) as caught:
        read_folder(tmp_path)
    assert said in str(caught.value)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content"),
    [("imu.csv", b"t,gyro_x\nnoon,1\n"), ("imu.csv", b"gyro_x\n1\n"), ("imu.parquet", b"PAR1 and nothing"), ("imu.csv", b"")],
)
def test_bad_tables_are_told(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / "flight.toml").write_text("")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HaltereError, match=name):
        read_folder(tmp_path)


def test_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = FlightLog({"imu": {"t": [0.0]}, "gnss": {"t": [0.0]}})
    real = folder._write_table
    calls = 0

    def failing(stream: Stream, path: Path) -> None:
        nonlocal calls
        calls += 1
        if calls % 2 == 0:
            path.write_bytes(b"half")
            raise OSError(28, "No space left on device")
        real(stream, path)

    monkeypatch.setattr(folder, "_write_table", failing)
    with pytest.raises(HaltereError, match="No space left"):
        write_folder(flight, tmp_path / "f")
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    write_folder(flight, tmp_path / "f")
    monkeypatch.setattr(folder, "_write_table", failing)
    with pytest.raises(HaltereError):
        write_folder(FlightLog({"imu": {"t": [5.0]}, "gnss": {"t": [0.0]}}), tmp_path / "f")
    _same(read_folder(tmp_path / "f"), read_folder(tmp_path / "f"))
    assert read_folder(tmp_path / "f")["imu"].t.tolist() == [0.0]


def test_rewriting_replaces_streams_and_leaves_other_files(tmp_path: Path) -> None:
    write_folder(FlightLog({"imu": {"t": [0.0]}, "gnss": {"t": [0.0]}}), tmp_path / "f")
    (tmp_path / "f" / "report.html").write_text("mine")
    (tmp_path / "f" / "solution.parquet").write_text("mine too")
    flight = FlightLog({"imu": {"t": [1.0]}})
    write_folder(flight, tmp_path / "f", csv=True)
    _same(flight, read_folder(tmp_path / "f"))
    assert sorted(p.name for p in (tmp_path / "f").iterdir()) == ["flight.toml", "imu.csv", "report.html", "solution.parquet"]


def test_does_not_write_over_a_file(tmp_path: Path) -> None:
    (tmp_path / "f").write_text("mine")
    with pytest.raises(HaltereError, match="a folder to write to"):
        write_folder(FlightLog({"imu": {"t": [0.0]}}), tmp_path / "f")
    assert (tmp_path / "f").read_text() == "mine"
