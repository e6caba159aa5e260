"""Damaged logs end in a flight or in one clear error: a short run over every format, and the faults that the long run found."""

from __future__ import annotations

import random
import re
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fuzz
from haltere.errors import HaltereError
from haltere.flight.door import check
from haltere.readers import read

KINDS = [kind for kind in fuzz.MADE if fuzz.MADE[kind]]


@pytest.mark.parametrize("kind", KINDS)
def test_the_good_logs_are_good(kind: str, tmp_path: Path) -> None:
    """Else the fuzzer would only see refusals."""
    for i, files in enumerate(fuzz.made(kind)):
        flight = read(fuzz.lay(files, tmp_path / str(i)))
        imu = check(flight).streams["imu"]
        assert len(imu) >= fuzz.N_IMU
        assert np.median(imu["accel_z"]) == pytest.approx(-9.8, abs=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_damage(kind: str) -> None:
    """Reading says what is wrong or gives a flight, whose content can be told, checked, written and read again."""
    fates: set[str] = set()

    @settings(
        max_examples=30, deadline=None, derandomize=True, database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )  # fmt: skip
    @given(rng=st.randoms(use_true_random=False), deed=st.sampled_from([1, fuzz.WRITE_EVERY, 2 * fuzz.WRITE_EVERY]))
    def one(rng: random.Random, deed: int) -> None:
        with tempfile.TemporaryDirectory() as folder:
            verdict = fuzz.judge(fuzz.lay(fuzz.damaged(kind, rng, recordings=False), Path(folder)), deed)
        assert verdict.fate != "finding", f"{verdict.what}\n{verdict.detail}"
        fates.add(verdict.fate)

    one()
    assert {"read", "refused"} <= fates  # the damage is neither nothing nor everything


@pytest.mark.parametrize("kind", list(fuzz.REAL))
def test_damaged_recordings(shared_data: Path, kind: str, tmp_path: Path) -> None:
    seeds = fuzz.real(kind)
    assert seeds
    for number in range(4):
        rng = random.Random(number)
        ((name, data),) = seeds[number % len(seeds)].items()
        for _ in range(1 + number % 3):
            data = fuzz._damage_file(name, data, kind, rng, data)
        verdict = fuzz.judge(fuzz.lay({name: data}, tmp_path / str(number)), 1)
        assert verdict.fate != "finding", f"{verdict.what}\n{verdict.detail}"


BROKEN = """
import os, sys
sys.path.insert(0, HERE)
import fuzz

def broken(path, deed=0, *, draw=True):
    count = os.path.join(os.getcwd(), "count")
    n = os.path.getsize(count) if os.path.exists(count) else 0
    with open(count, "a") as file:
        file.write("x")
    if n == 0:
        while True:
            pass
    if n == 1:
        os.abort()
    if n == 2:
        print("a word", file=sys.stderr)
    if n == 3:
        try:
            bytearray(2 * fuzz.MEMORY)
        except MemoryError:
            return fuzz.Verdict("finding", "no memory")
    if n == 4:
        raise SystemExit("the fuzzer itself")
    return fuzz.Verdict("read", "")

fuzz.__file__, fuzz.judge, fuzz.CPU_SECONDS = __file__, broken, 0.5
fuzz._warm = lambda *_: None
sys.exit(fuzz.main())
"""


def test_the_long_run_sees_hangs_crashes_words_and_floods(tmp_path: Path) -> None:
    """A judge that misbehaves in one way after the other; the last way is the fuzzer's own fault, and ends it."""
    script = tmp_path / "broken.py"
    script.write_text(BROKEN.replace("HERE", repr(str(Path(__file__).parent))))
    command = [sys.executable, str(script), "--minutes", "9", "--only", "csv", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path, check=False)
    assert done.returncode == 1
    for said in ("1: took too long", "2: the interpreter died (SIGABRT)", "3: said on the terminal: a word", "4: no memory"):
        assert f"FOUND csv {said}" in done.stdout
    assert "the fuzzer failed at ('csv', 5)" in done.stderr
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["csv-1", "csv-2", "csv-3", "csv-4"]
    assert "broken.py" in (tmp_path / "out" / "csv-1" / "what.txt").read_text()  # where it hung
    # A case is what its kind and number make of it.
    for name, data in fuzz.damaged("csv", fuzz._random("csv", 1)).items():
        assert (tmp_path / "out" / "csv-1" / name).read_bytes() == data


# What the long run has found


def _refused(path: Path, *said: str) -> None:
    with pytest.raises(HaltereError) as caught:
        read(path)
    assert "damaged content" not in str(caught.value)
    for words in said:
        assert words in str(caught.value)


def _csv(tmp_path: Path, change: tuple[bytes, bytes], folder: bool = False) -> Path:
    files = dict(fuzz.made("folder-csv" if folder else "csv")[0])
    name = "imu.csv" if folder else "table.csv"
    assert change[0] in files[name]
    files[name] = files[name].replace(*change, 1)
    return fuzz.lay(files, tmp_path)


def test_a_byte_that_is_no_text_is_told_with_its_line(tmp_path: Path) -> None:
    row = fuzz.made("csv")[0]["table.csv"].split(b"\n")[3]
    _refused(_csv(tmp_path / "a", (row, row[:-2] + b"\xb0\xb0")), "table.csv line 4", "UTF-8", "0xb0")
    _refused(_csv(tmp_path / "b", (row, row[:9] + bytes(20))), "table.csv line 4", "a zero byte", "cut it there")


def test_a_row_with_too_many_cells_is_told_with_its_line(tmp_path: Path) -> None:
    row = fuzz.made("csv")[0]["table.csv"].split(b"\n")[7]
    _refused(_csv(tmp_path, (row, row + b",1,2")), "table.csv line 8", "expected 11 cells", "found 13")


def test_lines_may_end_in_carriage_returns_alone(tmp_path: Path) -> None:
    (name, data), *_ = fuzz.made("csv")[0].items()
    for end in (b"\r", b"\r\n"):
        assert len(read(fuzz.lay({name: data.replace(b"\n", end)}, tmp_path))["imu"]) == fuzz.N_IMU


def test_a_word_among_numbers_is_told_with_its_row(tmp_path: Path) -> None:
    cell = fuzz.made("folder-csv")[0]["imu.csv"].split(b"\n")[5].split(b",")[2]
    _refused(_csv(tmp_path, (cell, b"#REF!"), folder=True), "imu.csv column 'gyro_y', row 5", "found '#REF!'")


def test_text_in_a_reference_is_told_too(tmp_path: Path) -> None:
    """Truth and the onboard solution pass no door: text in them would only be found after the run."""
    files = dict(fuzz.made("folder-csv")[0])
    files["truth.csv"] = files["truth.csv"].replace(b"1.0", b"one", 1)
    _refused(fuzz.lay(files, tmp_path), "truth.csv column 'q_w', row 1", "'one'")


def test_parquet_pages_that_contradict_their_description(tmp_path: Path) -> None:
    """Not every damage of a Parquet file is an Exception in polars: some is a panic."""
    data = fuzz.made("parquet")[0]["table.parquet"]
    for at in range(0, 4000, 37):
        bad = bytearray(data)
        bad[at] ^= 0x55
        path = fuzz.lay({"table.parquet": bytes(bad)}, tmp_path)
        try:
            read(path)
        except HaltereError as error:
            assert "damaged content" not in str(error)


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "9" * 400])
@pytest.mark.parametrize("key", ["time_offset", "home.lat", "delays.gnss", "discarded.imu.lost", "mounting.imu"])
def test_numbers_of_flight_toml_are_finite(tmp_path: Path, key: str, value: str) -> None:
    table, _, last = key.rpartition(".")
    line = f"{last} = {f'[{value}, 0, 0, 0]' if 'mounting' in key else value}\n"
    more = "lon = 0\nalt = 0\n" if table == "home" else ""
    (tmp_path / "flight.toml").write_text((f"[{table}]\n" if table else "") + line + more)
    (tmp_path / "imu.csv").write_text("t\n0\n")
    _refused(tmp_path, f"expected a finite number for {'mounting.imu' if 'mounting' in key else key}")


@pytest.mark.parametrize("header", [b"a," * 30_000 + b"b", b"t [s]" + b" " * 60_000 + b"x,gyro_x", b"t," + b"[" * 60_000 + b",gyro_x"])
def test_a_header_without_end_takes_no_longer_than_its_length(tmp_path: Path, header: bytes) -> None:
    began = time.process_time()
    _refused(fuzz.lay({"table.csv": header + b"\n1,2\n"}, tmp_path))
    assert time.process_time() - began < 5.0


def test_two_columns_of_one_name(tmp_path: Path) -> None:
    (tmp_path / "flight.toml").write_text("")
    (tmp_path / "imu.csv").write_text("t,gyro_x, gyro_x\n0,1,2\n")
    _refused(tmp_path, "two columns 'gyro_x'")
    (tmp_path / "table.csv").write_text("t,gyro_x, gyro_x\n0,1,2\n")
    _refused(tmp_path / "table.csv", "2 columns 'gyro_x'")


def _dataflash(tmp_path: Path, **changes: tuple[str, str]) -> Path:
    """The text log with lines of a type changed."""
    lines = fuzz.made("dataflash-text")[0]["log.log"].decode().split("\n")
    for word, (old, new) in changes.items():
        assert any(line.startswith(word) and old in line for line in lines)
        lines = [line.replace(old, new) if line.startswith(word) else line for line in lines]
    return fuzz.lay({"log.log": "\n".join(lines).encode()}, tmp_path)


def test_dataflash_parameter_that_is_no_number(tmp_path: Path) -> None:
    flight = read(_dataflash(tmp_path, PARM=("FRAME_CLASS, 1.0", "AHRS_EKF_TYPE, nan")))
    assert len(flight["imu"]) == fuzz.N_IMU


def test_dataflash_field_of_another_type(tmp_path: Path) -> None:
    """A number that the damaged definition calls a text, and the other way round."""
    flight = read(_dataflash(tmp_path / "a", FMT=("CURR, IHhh", "CURR, IHhZ")))
    assert np.isfinite(flight["power"]["current"]).all()
    flight = read(_dataflash(tmp_path / "b", FMT=("MSG, Z", "MSG, I")))
    assert len(flight["imu"]) == fuzz.N_IMU
    flight = read(_dataflash(tmp_path / "c", FMT=("MOT, IHHHH", "MOT, IaHHH")))
    assert len(flight["imu"]) == fuzz.N_IMU


def test_ulog_flags_of_another_type(tmp_path: Path) -> None:
    head, messages = fuzz._ulog_messages(fuzz.made("ulog")[1]["old.ulg"])
    flags = b"uint8_t esc_online_flags"
    assert any(flags in m for m in messages)
    bodies = [m[3:].replace(flags, b"float esc_online_flags") for m in messages]
    bad = head + b"".join(struct.pack("<H", len(b)) + m[2:3] + b for m, b in zip(messages, bodies, strict=True))
    assert len(read(fuzz.lay({"old.ulg": bad}, tmp_path))["imu"]) == fuzz.N_IMU


def test_a_blackbox_log_of_which_no_frame_can_be_decoded_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not again from its beginning after every damaged place: minutes for a small log, hours for a real one."""
    from orangebox.reader import Reader

    data = fuzz.made("blackbox")[0]["log.bbl"]
    bad = re.sub(rb"H Field I predictor:[^\n]*\n", b"", data)
    assert len(bad) < len(data)
    taken = 0
    original = Reader.__next__

    def counted(self: Reader) -> int | None:
        nonlocal taken
        taken += 1
        return original(self)  # type: ignore[no-any-return]

    monkeypatch.setattr(Reader, "__next__", counted)
    _refused(fuzz.lay({"log.bbl": bad}, tmp_path), "whole frames")
    assert taken < 2 * len(data)


def test_a_blackbox_header_that_contradicts_its_frames(tmp_path: Path) -> None:
    """The line with the names of the slow fields is lost, their values still stand in every frame."""
    data = fuzz.made("blackbox")[0]["log.bbl"]
    bad = data.replace(b"H Field S name:flightModeFlags,stateFlags\n", b"")
    assert len(bad) < len(data)
    _refused(fuzz.lay({"log.bbl": bad}, tmp_path), "as many as the header names")


def test_blackbox_motor_range_that_is_no_number(tmp_path: Path) -> None:
    data = fuzz.made("blackbox")[0]["log.bbl"]
    bad = data.replace(b"motorOutput:48,2047", b"motorOutput:48,2x47")
    assert bad != data
    flight = read(fuzz.lay({"log.bbl": bad}, tmp_path))
    assert any("no motorOutput range" in note for note in flight.notes)


def test_a_home_that_is_no_place(tmp_path: Path) -> None:
    data = bytearray(fuzz.made("dataflash")[0]["log.bin"])
    kind = data[data.index(b"ORGN") - 2]
    at = data.index(bytes([0xA3, 0x95, kind]), data.index(b"MODE"))
    data[at + 3 + 9 : at + 3 + 13] = (2_000_000_000).to_bytes(4, "little")  # latitude 200 deg
    flight = read(fuzz.lay({"log.bin": bytes(data)}, tmp_path))
    assert flight.meta.home is None
    assert any("home position left out: latitude 200" in note for note in flight.notes)


def test_an_empty_folder_and_a_folder_of_tables(tmp_path: Path) -> None:
    _refused(tmp_path, "a folder without flight.toml")
    (tmp_path / "imu.csv").write_text("t\n0\n")
    _refused(tmp_path, "expected a flight folder with a flight.toml, found none")
