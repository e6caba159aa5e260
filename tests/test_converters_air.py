"""Recordings with air data and a wind mast: that the converters read them with the right signs, units and frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from converters_air import MAST, _blowing_to, _mast, true_airspeed, umn_thor, wemuav, x8_testlog2
from haltere.flight.log import FlightLog

pytestmark = pytest.mark.real


def rotation_matrices(q: np.ndarray) -> np.ndarray:
    """Matrices body to NED of q_nb, scalar first, shape (n, 3, 3)."""
    return np.asarray(Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix())


def wind_triangle(flight: FlightLog, t0: float, t1: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Wind north, east, down [m/s], airspeed scale and residual RMS of v = s C u + W by least squares over t0..t1 at the air data."""
    air, gnss, own = (flight.streams[s] for s in ("airdata", "gnss", "onboard"))
    delay = flight.meta.delays
    ta = air.t - delay.get("airdata", 0.0)
    here = (ta > t0) & (ta < t1) & np.isfinite(air["airspeed"])
    ta = ta[here]
    v = np.column_stack([np.interp(ta, gnss.t - delay.get("gnss_velocity", 0.0), gnss[f"vel_{a}"]) for a in "ned"])
    k = np.clip(np.searchsorted(own.t, ta), 0, len(own) - 1)
    C = rotation_matrices(own.vector("q", "wxyz")[k])
    V, a, b = air["airspeed"][here], air.get("aoa")[here], air.get("sideslip")[here]
    angles = bool(np.isfinite(a).all())
    a, b = (np.nan_to_num(x) for x in (a, b))

    def residual(x: np.ndarray) -> np.ndarray:
        u = V[:, None] * np.column_stack([np.cos(a + x[1]) * np.cos(b + x[2]), np.sin(b + x[2]), np.sin(a + x[1]) * np.cos(b + x[2])])
        r = v - x[0] * np.einsum("nij,nj->ni", C, u) - x[3:6]
        return r if angles else r[:, :2]

    s = least_squares(lambda x: residual(x)[::3].ravel(), [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], loss="soft_l1")
    return s.x[3:6], float(s.x[0]), np.sqrt(np.median(residual(s.x) ** 2, axis=0))


def test_thor_is_read_raw_in_frd_and_its_wind_triangle_closes(shared_data: Path) -> None:
    flight = umn_thor(shared_data / "umn_thor" / "thor_flight75.mat", magnetometer=True)
    imu, gnss, air = (flight.streams[s] for s in ("imu", "gnss", "airdata"))
    rest = (imu.t > 60.0) & (imu.t < 80.0)
    assert np.allclose(imu["gyro_x"][rest].mean(), -0.0206, atol=0.002)  # the raw gyro has its offset, the file has it taken off
    assert len(gnss) == 674 and gnss["lat"].min() > 45.3
    assert np.isnan(air["airspeed"][(air.t > 60.0) & (air.t < 80.0)]).all()
    wind, scale, left = wind_triangle(flight, 215.0, 570.0)
    assert np.hypot(*wind[:2]) == pytest.approx(6.4, abs=0.4)  # what the description of the recordings says
    assert np.degrees(np.arctan2(wind[1], wind[0])) == pytest.approx(98.0, abs=8.0)
    assert 0.95 < scale < 1.06 and (left < 1.5).all()
    # magnetometer: the field at the onboard attitude, which the sphere did not see
    mag, own = flight.streams["magnetometer"], flight.streams["onboard"]
    use = (mag.t > 215.0) & (mag.t < 570.0)
    C = rotation_matrices(own.vector("q", "wxyz")[np.searchsorted(own.t, mag.t[use])])
    level = np.einsum("nij,nj->ni", C, mag.vector("mag")[use])
    assert abs(np.degrees(np.median(np.arctan2(level[:, 1], level[:, 0])))) < 3.0
    assert np.degrees(np.arctan2(level[:, 2].mean(), np.hypot(*level[:, :2].mean(axis=0)))) == pytest.approx(72.0, abs=2.0)


def test_testlog2_uses_the_corrected_field_and_its_wind_triangle_closes(shared_data: Path) -> None:
    flight = x8_testlog2(shared_data / "inertialnav" / "TestLog2.mat")
    assert flight.meta.start_utc is not None and flight.meta.start_utc.startswith("2013-11-29T")
    mag = flight.streams["magnetometer"]
    assert np.linalg.norm(mag.vector("mag"), axis=1).mean() == pytest.approx(60.1, rel=0.06)
    _, scale, left = wind_triangle(flight, 280.0, 570.0)
    assert 0.9 < scale < 1.15 and (left < 2.0).all()


@pytest.mark.parametrize("name", ["FLY134__20210419_093107__Hover.csv", "FLY139__20210420_093827__Square.csv"])
def test_wemuav_mast_and_vehicle_agree_on_the_wind(shared_data: Path, name: str) -> None:
    flight = wemuav(shared_data / "wemuav" / name)
    imu, attitude, truth, own = (flight.streams[s] for s in ("imu", "attitude", "truth", "onboard"))
    C = rotation_matrices(attitude.vector("q", "wxyz"))
    f = np.einsum("nij,nj->ni", C, imu.vector("accel")[np.isin(imu.t, attitude.t)])
    assert np.allclose(f.mean(axis=0), [0.0, 0.0, -9.81], atol=0.05)
    assert np.allclose(np.linalg.norm(attitude.vector("q", "wxyz"), axis=1), 1.0)
    # the vehicle leans into the wind that the mast measured, and its own estimate is of the same sense
    mean = np.array([truth["wind_n"].mean(), truth["wind_e"].mean()])
    assert np.hypot(*(mean - [own["wind_n"].mean(), own["wind_e"].mean()])) < 0.6
    speed = flight.streams["rotors"]["speed_0"]
    assert 450.0 < speed.mean() < 650.0


def test_a_direction_is_never_interpolated_across_north() -> None:
    t = np.arange(4.0)
    table = {f"windHDir_{s}": np.array([350.0, 178.5, 10.0, 12.0]) for s in MAST} | {f"windHMag_{s}": np.full(4, 2.0) for s in MAST}
    wind, spread = _mast(t, dict.fromkeys(table, 0), table.__getitem__, None)
    assert wind[1] == pytest.approx([-2.0 * np.cos(np.radians(10.0)), 0.0], abs=1e-12)  # between 350 and 10: from the north
    assert np.allclose(spread, 0.0)
    assert _blowing_to(np.array([270.0]), np.array([3.0]))[0] == pytest.approx([0.0, 3.0], abs=1e-12)
    with pytest.raises(ValueError, match="not at 40"):
        _mast(t, dict.fromkeys(table, 0), table.__getitem__, 40.0)


def test_the_mast_is_interpolated_as_a_vector_over_height() -> None:
    table = {f"windHDir_{s}": np.array([180.0, 180.0]) for s in MAST} | {f"windHMag_{s}": np.full(2, z) for s, z in MAST.items()}
    for height in (1.5, 8.0, 14.7, 21.3):
        wind, _ = _mast(np.arange(2.0), dict.fromkeys(table, 0), table.__getitem__, height)
        assert wind[:, 0] == pytest.approx([height, height]) and np.allclose(wind[:, 1], 0.0)


def test_true_airspeed_is_indicated_airspeed_at_sea_level() -> None:
    assert true_airspeed(np.array([10.0]), np.array([101325.0]))[0] == pytest.approx(10.0, rel=1e-4)
    assert true_airspeed(np.array([10.0]), np.array([50662.5]), 288.15)[0] == pytest.approx(14.142, rel=1e-3)
