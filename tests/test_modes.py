"""The streams modes and vibration, and clipping in imu, from the autopilots' logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from haltere.flight.folder import read_folder, write_folder
from haltere.flight.log import FlightLog
from haltere.readers import read
from haltere.readers._common import Builder
from haltere.readers._modes import add_modes, ardupilot_mode, px4_mode, spelt


def _rows(flight: FlightLog) -> list[tuple[float, str, float]]:
    m = flight["modes"]
    return [(round(float(t), 2), str(name), float(a)) for t, name, a in zip(m.t, m["mode"], m.get("armed"), strict=True)]


@pytest.mark.parametrize(
    ("number", "version", "name"),
    [
        (0, None, "Manual"),
        (4, (1, 11), "Hold"),
        (5, (1, 15), "Return"),
        # These numbers were given away anew: without a version nothing is claimed.
        (6, (1, 9), "RC Recovery"),
        (6, (1, 16), "Position Slow"),
        (6, (1, 14), "mode 6"),
        (6, None, "mode 6"),
        (16, (1, 10), "Rattitude"),
        (16, (1, 16), "mode 16"),
        (23, (1, 15), "External 1"),
        (30, (1, 15), "External 8"),
        (31, (1, 15), "mode 31"),
        (200, (1, 15), "mode 200"),
    ],
)
def test_px4_names(number: int, version: tuple[int, int] | None, name: str) -> None:
    assert px4_mode(number, version) == name


def test_ardupilot_names_are_the_firmware_s() -> None:
    """Against pymavlink's own tables, which are kept by ArduPilot's people; spelling aside."""
    from pymavlink import mavutil

    def bare(name: str) -> str:
        return name.replace("_", "").replace(" ", "").upper()

    other_words = {"AUTOROTATE": "HELIAUTOROTATE", "LOITERALTQLAND": "LOITERTOQLAND"}
    tables = {"Copter": mavutil.mode_mapping_acm, "Plane": mavutil.mode_mapping_apm, "Rover": mavutil.mode_mapping_rover}
    for vehicle, table in tables.items():
        for number, name in table.items():
            ours = ardupilot_mode(number, vehicle)
            if not ours.startswith("mode "):
                assert bare(ours) == other_words.get(bare(name), bare(name)), (vehicle, number)
        assert sum(not ardupilot_mode(n, vehicle).startswith("mode ") for n in table) >= len(table) - 1
    assert ardupilot_mode(5, "Copter") == "Loiter"
    assert ardupilot_mode(5, "Plane") == "FBWA"
    assert ardupilot_mode(5, None) == "mode 5"
    assert ardupilot_mode(99, "Copter") == "mode 99"


def test_old_capitals_are_spelt_as_today() -> None:
    assert [spelt(n) for n in ("STABILIZE", "ALT_HOLD", "RTL", "OF_LOITER", "SOMETHING")] == [
        "Stabilize",
        "AltHold",
        "RTL",
        "OF_Loiter",
        "SOMETHING",
    ]


def test_rows_are_the_changes_and_never_the_start_of_time() -> None:
    builder = Builder(Path("x"), "made")
    us = np.arange(5) * 1_000_000
    add_modes(builder, (us, ["a", "a", "b", "b", "a"]), (us[1:4] + 500_000, np.array([0.0, 1.0, np.nan])))
    builder.add("imu", np.arange(3) * 1000 + 2_000_000, {f"{s}_{a}": np.zeros(3) for s in ("gyro", "accel") for a in "xyz"})
    flight = builder.build()
    assert flight.meta.time_offset == 2.0
    found = [(t, m, None if np.isnan(a) else a) for t, m, a in _rows(flight)]
    assert found == [(-2.0, "a", None), (-0.5, "a", 0.0), (0.0, "b", 0.0), (0.5, "b", 1.0), (1.5, "b", None), (2.0, "a", None)]


@pytest.mark.parametrize("csv", [False, True])
def test_a_flight_folder_keeps_them(tmp_path: Path, csv: bool) -> None:
    modes = {"t": [0.0, 1.0, 2.0], "mode": ["Loiter", "", "AltHold, then some"], "armed": [np.nan, 1.0, 0.0]}
    flight = FlightLog({"modes": modes, "vibration.1": {"t": [0.0], "vibe_x": [1.0], "clip": [3.0]}})
    again = read_folder(write_folder(flight, tmp_path / "f", csv=csv))
    assert again["modes"] == flight["modes"]
    assert again["modes"]["mode"].dtype.kind == "U"
    assert again["vibration.1"] == flight["vibration.1"]


def test_px4_modes_of_a_simulated_flight(shared_data: Path) -> None:
    """Take-off, hold and return of a PX4 1.15 simulation: armed with the take-off, disarmed after landing."""
    flight = read(shared_data / "px4" / "sample_px4_events.ulg")
    assert [(m, a) for _, m, a in _rows(flight)] == [("Hold", 0.0), ("Takeoff", 1.0), ("Hold", 1.0), ("Return", 1.0), ("Hold", 0.0)]
    # The vehicle left the ground while it was armed, and only then: the onboard height says when.
    armed_at, disarmed_at = flight["modes"].t[1], flight["modes"].t[4]
    onboard = flight["onboard"]
    high = onboard.t[onboard.get("pos_d") < np.nanmax(onboard.get("pos_d")) - 1.0]
    assert armed_at < high.min() < high.max() < disarmed_at


def test_ardupilot_modes_of_a_crash(shared_data: Path) -> None:
    """Loss of control at t = 147.3 s in altitude hold; the pilot takes over in Stabilize; disarmed on the ground."""
    flight = read(shared_data / "ardupilot" / "log_0036_mechanical_failure.bin")
    rows = _rows(flight)
    assert [(m, a) for _, m, a in rows] == [("Stabilize", 1.0), ("AltHold", 1.0), ("Stabilize", 1.0), ("Stabilize", 0.0)]
    assert rows[2][0] == pytest.approx(371.558 - 224.63, abs=0.02)
    vibration, other = flight["vibration"], flight["vibration.1"]
    quiet = vibration.t < 20.0
    assert np.median(vibration["vibe_z"][quiet]) < 0.1 * vibration["vibe_z"].max()
    assert np.all(np.diff(vibration["clip"]) >= 0.0)
    assert vibration["clip"][0] == 0.0 < vibration["clip"][-1]
    assert "vibe_x" not in other
    # Clipping is counted in the crash, not before.
    assert vibration.t[np.argmax(vibration["clip"] > 0.0)] > 146.0


def test_text_logs_have_modes_by_place(shared_data: Path) -> None:
    flight = read(shared_data / "ardupilot" / "nan.log")
    assert [(m, a) for _, m, a in _rows(flight)] == [("Stabilize", 1.0), ("Stabilize", 0.0), ("Stabilize", 1.0), ("Stabilize", 0.0)]


def test_clipping_bits_are_columns_of_imu(shared_data: Path) -> None:
    new, old = (read(shared_data / "px4" / f"{n}.ulg")["imu"] for n in ("sample_px4_events", "sample_log_small"))
    assert {"gyro_clipping", "accel_clipping"} < set(new.names)
    assert "accel_clipping" in old
    assert "gyro_clipping" not in old
    assert not new["accel_clipping"].any()  # a simulated, gentle flight
