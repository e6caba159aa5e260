"""Converters of recordings with air data or a wind mast for the tests: UMN Thor, InertialNav TestLog2, WEMUAV. Not part of the package."""

from __future__ import annotations

import csv
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from converters import DEG, _columns, _quaternions
from haltere.flight.field import earth_field
from haltere.flight.log import FlightLog, FlightMeta

#: Density of air at sea level to which indicated airspeed refers [kg/m^3], gas constant of dry air [J/(kg K)].
RHO0, R_AIR = 1.225, 287.053
#: Below this the pitot tubes read their own noise (about 1 Pa) [m/s]: no airspeed, and no angles.
SLOW = 3.0


def true_airspeed(indicated: np.ndarray, pressure: np.ndarray, temperature: float | None = None) -> np.ndarray:
    """True of indicated (equivalent) airspeed [m/s]: V sqrt(rho0/rho) at the static pressure [Pa] and air temperature [K].

    Without a temperature that of the standard atmosphere at that pressure; ten kelvins off are 1.7 % of airspeed.
    """
    air = 288.15 * (pressure / 101325.0) ** 0.190263 if temperature is None else temperature
    return np.asarray(indicated * np.sqrt(RHO0 * R_AIR * air / pressure))


def umn_thor(path: Path, magnetometer: bool = False) -> FlightLog:
    """UMN Thor, flight 75: a fixed wing with airspeed and both angles, square circuits of 150 m at walking-pace GNSS (1 Hz).

    Traps met:

    * ``p..az`` have the onboard filter's bias estimate taken off (since 2011); it is put back, so an estimator sees the raw sensors.
      At rest the file's p has mean 0.001 rad/s with 0.021 rad/s taken off, and its f has a norm of 9.809.
    * ``lat, lon`` are 45.0, -93.0 and the rest 0 before the first fix; a fix is held for 50 rows: rows where the time of week changes.
    * ``navlat, navlon`` are radians, zero before the filter starts (24.8 s); ``lat, lon`` are degrees.
    * ``psi`` is unwrapped. ``Ps`` is kPa. ``ias`` is an indicated airspeed already corrected for the zero of its sensor (-0.020 kPa);
      signed, -1.3 m/s at rest. Made true with density at ``Ps`` and standard temperature (the file has none): +1.5 %.
    * Airspeed and angles mean nothing below `SLOW`: NaN there. The angles have zeros of their own (about -1 and +3 degrees).
    * The magnetometer is (hx, -hy, -hz) in FRD, in an arbitrary unit with a hard iron of the field's own size. With ``magnetometer`` it is
      centred and scaled by a sphere through the flight's own samples (nothing of the onboard attitude), and said so.
    * GNSS velocity lags the inertial data by 0 to 0.1 s; no delay is configured.
    """
    from scipy.io import loadmat

    m = loadmat(path, squeeze_me=True, struct_as_record=False)["flight_data"]

    def get(*names: str) -> np.ndarray:
        return np.column_stack([np.asarray(getattr(m, n), dtype=float) for n in names])

    t = get("time")[:, 0]
    on = np.flatnonzero(get("navlat")[:, 0] != 0.0)
    sampled = np.any(get("p", "q", "r", "ax", "ay", "az") != 0.0, axis=1)  # the first row is zeros
    gyro, accel = get("p", "q", "r") + get("p_bias", "q_bias", "r_bias"), get("ax", "ay", "az") + get("ax_bias", "ay_bias", "az_bias")
    fix = np.flatnonzero(np.diff(get("GPS_TOW")[:, 0]) != 0.0) + 1
    pressure = 1e3 * get("Ps")[:, 0]
    ias = get("ias")[:, 0]
    flying = ias > SLOW
    place = get("lat", "lon", "alt")[fix]
    nav = get("navlat", "navlon", "navalt")[on] * [1.0 / DEG, 1.0 / DEG, 1.0]
    streams = {
        "imu": {"t": t[sampled], **_columns("gyro", gyro[sampled]), **_columns("accel", accel[sampled])},
        "gnss": {"t": t[fix], "lat": place[:, 0], "lon": place[:, 1], "alt": place[:, 2],
                 **_columns("vel", get("vn", "ve", "vd")[fix], "ned"), "num_sats": get("satVisible")[fix, 0]},
        "barometer": {"t": t[sampled], "pressure": pressure[sampled]},
        "airdata": {"t": t, "airspeed": np.where(flying, true_airspeed(ias, pressure), np.nan),
                    "aoa": np.where(flying, get("aoa")[:, 0], np.nan), "sideslip": np.where(flying, get("aos")[:, 0], np.nan)},
        "onboard": {"t": t[on], **_columns("q", _quaternions(get("phi", "theta", "psi")[on]), "wxyz"),
                    **_columns("vel", get("navvn", "navve", "navvd")[on], "ned"), "lat": nav[:, 0], "lon": nav[:, 1], "alt": nav[:, 2]},
    }  # fmt: skip
    said = ["airspeed made true with the standard temperature at the static pressure"]
    if magnetometer:
        field = earth_field(float(place[0, 0]), float(place[0, 1]), float(place[0, 2]), 2012.77)
        raw = get("hx", "hy", "hz") * [1.0, -1.0, -1.0]
        new = np.any(raw != 0.0, axis=1) & np.r_[True, np.any(np.diff(raw, axis=0) != 0.0, axis=1)]
        centre, radius = _sphere(raw[new & flying])
        streams["magnetometer"] = {"t": t[new], **_columns("mag", (raw[new] - centre) * field.strength / radius)}
        said.append("magnetometer centred and scaled by a sphere through the flight's own samples")
    # its date and the time of week of the first fix (319569.2 s at t = 22.04 s), 16 s of which are leap seconds
    meta = FlightMeta(name="UMN Thor, flight 75", source="UMN flight_data; " + "; ".join(said), start_utc="2012-10-10T16:45:31Z")
    return FlightLog(streams, meta, said)


def _sphere(m: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the sphere |m - b| = r by linear least squares: |m|^2 = 2 m.b + (r^2 - |b|^2)."""
    A = np.column_stack([2.0 * m, np.ones(len(m))])
    x, *_ = np.linalg.lstsq(A, np.sum(m * m, axis=1), rcond=None)
    return x[:3], float(np.sqrt(x[3] + x[:3] @ x[:3]))


#: Delays [s] that the author of the InertialNav recordings gives for this autopilot (velocity, position, height, magnetometer, airspeed).
APM_DELAYS = {"gnss_velocity": 0.23, "gnss_position": 0.21, "barometer": 0.35, "magnetometer": 0.03, "airdata": 0.21}


def x8_testlog2(path: Path) -> FlightLog:
    """InertialNav ``TestLog2.mat``: a Skywalker X-8 with a pitot tube, 613 s with loops and rolls; ArduPlane of 2013.

    Traps met:

    * ``MAG`` is corrected already: its direction agrees with the Earth's field at the onboard attitude within 0.04 a component;
      ``MAG - Ofs`` (what the text files of this collection want) only within 0.3. Milligauss; its norm is 632, the model's field 601.
    * ``GPS.TimeMS`` is time of week, ``T`` the arrival on the autopilot's clock with jitter; their difference is 50 ms steps apart from the
      first rows, so fixes are stamped ``TimeMS`` plus its median. ``VZ`` is down. ``Lat`` is 0.1 degree off the mission's; left as it is.
    * Course and speed are all there is of the horizontal velocity: below 1 m/s the course is noise, the velocity near zero all the same.
    * The row of ``GPS`` with the same ``TimeMS`` twice is left out; a gap of 2.5 s at the start stays.
    * ``NTUN.Arspd`` is an equivalent airspeed with a floor of noise of 2 m/s at rest: NaN below `SLOW`. ``NTUN.Alt`` is height
      above the start; the density of the standard atmosphere at the GNSS altitude makes it true.
    * No angles of attack or sideslip. ``ATT.Yaw`` runs from 0 to 360 degrees.
    * Delays are the author's for this autopilot; GNSS velocity against the inertial data says 0.2 to 0.35 s.
    """
    from scipy.io import loadmat

    m = loadmat(path, squeeze_me=True)
    imu, gps, mag, ntun, att = (np.asarray(m[n], dtype=float) for n in ("IMU", "GPS", "MAG", "NTUN", "ATT"))
    gps = gps[(gps[:, 1] >= 3.0) & np.r_[True, np.diff(gps[:, 2]) > 0.0]]
    tg = (gps[:, 2] + np.median(gps[:, 13] - gps[:, 2])) * 1e-3
    course, speed = gps[:, 11] * DEG, gps[:, 10]
    ta, tn = att[:, 1] * 1e-3, ntun[:, 1] * 1e-3
    pressure = 101325.0 * (1.0 - np.interp(tn, tg, gps[:, 9]) / 44330.77) ** 5.255876
    eas = ntun[:, 7]
    streams = {
        "imu": {"t": imu[:, 1] * 1e-3, **_columns("gyro", imu[:, 2:5]), **_columns("accel", imu[:, 5:8])},
        "magnetometer": {"t": mag[:, 1] * 1e-3, **_columns("mag", 0.1 * mag[:, 2:5])},
        "gnss": {"t": tg, "lat": gps[:, 6], "lon": gps[:, 7], "alt": gps[:, 9], "vel_n": speed * np.cos(course),
                 "vel_e": speed * np.sin(course), "vel_d": gps[:, 12], "fix_type": gps[:, 1], "num_sats": gps[:, 4]},
        "barometer": {"t": tn, "altitude": ntun[:, 8]},
        "airdata": {"t": tn, "airspeed": np.where(eas > SLOW, true_airspeed(eas, pressure), np.nan)},
        "onboard": {"t": ta, **_columns("q", _quaternions(att[:, 2:5] * DEG), "wxyz")},
    }  # fmt: skip
    said = ["airspeed made true with the standard atmosphere at the GNSS altitude", "delays are the author's for this autopilot"]
    start = datetime(1980, 1, 6) + timedelta(weeks=gps[0, 3], seconds=gps[0, 2] * 1e-3 - tg[0] - 16.0)  # 16 leap seconds in 2013
    meta = FlightMeta(
        name="X-8, TestLog2", source="InertialNav; " + "; ".join(said), start_utc=start.isoformat() + "Z", delays=dict(APM_DELAYS)
    )
    return FlightLog(streams, meta, said)


#: Heights of the mast's anemometers above ground [m] by the stem of their columns; the authors' reference is the mean of the upper three.
MAST = {"0150cm": 1.5, "1140cm": 11.4, "1470cm": 14.7, "1800cm": 18.0, "2130cm": 21.3}
UPPER = ("1470cm", "1800cm", "2130cm")
#: Order of the rotors as ``speed_0 ..``: right front, left front, left back, right back.
P4_ROTORS = ("RF", "LF", "LB", "RB")


def wemuav(path: Path, height: float | None = None) -> FlightLog:
    """WEMUAV: a DJI Phantom 4 RTK beside a mast of sonic anemometers, everything at 10 Hz; ``truth`` is the mast's wind.

    Traps met:

    * Everything was interpolated to 10 Hz by the publishers, each column by itself. A mast sample that is not a whole degree was made of
      two others, at 0/360 through the wrong half of the compass: such samples are left out, and the rest is interpolated as a vector.
    * Directions are where the wind comes *from*; the mast's columns are named ``_refTT`` here and there.
    * Quaternions were interpolated where their sign changes (one row of the square, norm 0.84): rows off unit norm are left out.
    * Height above ground is in no column, and ``alti`` of the two days differs by 22 m at one place: without ``height`` [m] the reference
      is the mean of the mast's upper three (14.7, 18.0, 21.3 m) as the authors took it; with it, the vector interpolated over height.
    * ``gnss`` is the vehicle's own fused position and velocity (RTK behind it), not raw fixes; ``attitude`` and ``onboard`` are its own
      attitude. ``windHDir_other`` is the vehicle's own wind and stands in ``onboard``. There is no magnetometer.
    * ``windVert_*`` of the mast says nowhere which way is positive (its mean is -0.05 to 0.5 m/s): left out of the truth.
    * Acceleration, rates and velocity agree in time within one sample (correlation is largest at no shift).
    """
    with open(path, encoding="utf-8-sig") as file:
        rows = list(csv.reader(file))
    at = {name: k for k, name in enumerate(rows[0])}
    rows = rows[1:]

    def column(name: str) -> np.ndarray:
        return np.array([float(row[at[name]] or "nan") for row in rows])

    def several(*names: str) -> np.ndarray:
        return np.column_stack([column(n) for n in names])

    start = datetime.fromisoformat(rows[0][0])
    t = np.array([(datetime.fromisoformat(row[0]) - start) / timedelta(seconds=1) for row in rows])
    q = several("q1", "q2", "q3", "q4")
    norm = np.linalg.norm(q, axis=1)
    whole = np.abs(norm - 1.0) < 0.01
    q = q / norm[:, None]
    wind, spread = _mast(t, at, column, height)
    own = _blowing_to(column("windHDir_other"), column("windHMag_other"))
    rpm = several(*(f"motRpm_{r}" for r in P4_ROTORS))
    velocity = several("vn", "ve", "vd")
    attitude = {"t": t[whole], **_columns("q", q[whole], "wxyz")}
    streams = {
        "imu": {"t": t, **_columns("gyro", several("gyroX", "gyroY", "gyroZ")), **_columns("accel", several("ax", "ay", "az"))},
        "gnss": {"t": t, "lat": column("lati"), "lon": column("long"), "alt": column("alti"), **_columns("vel", velocity, "ned")},
        "rotors": {"t": t} | {f"speed_{k}": rpm[:, k] * 2.0 * np.pi / 60.0 for k in range(4)},
        "attitude": attitude,
        "onboard": attitude | _columns("vel", velocity[whole], "ned") | _columns("wind", own[whole], "ne"),
        "truth": {"t": t, **_columns("wind", wind, "ne"), **_columns("sd_wind", spread, "ne")},
    }  # fmt: skip
    where = (
        "mean of the mast's anemometers at 14.7, 18.0 and 21.3 m" if height is None else f"mast's anemometers interpolated to {height:g} m"
    )
    said = ["10 Hz, interpolated by the publishers", "GNSS is the vehicle's own solution", f"wind of truth: {where}"]
    meta = FlightMeta(name=path.stem, source="WEMUAV; " + "; ".join(said), start_utc=start.isoformat() + "Z")
    return FlightLog(streams, meta, said)


def _blowing_to(direction_from: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Velocity of the air north, east [m/s] of a direction it comes from [deg] and a speed."""
    return -np.column_stack([speed * np.cos(direction_from * DEG), speed * np.sin(direction_from * DEG)])


def _mast(t: np.ndarray, at: dict[str, int], column, height: float | None) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Wind of the mast at a height, or the mean of its upper three, and the spread over those three; shapes (n, 2)."""
    winds = {}
    for stem in MAST:
        d = column(next(n for n in at if n.startswith(f"windHDir_{stem}")))
        w = _blowing_to(d, column(next(n for n in at if n.startswith(f"windHMag_{stem}"))))
        good = d == np.round(d)
        winds[stem] = np.column_stack([np.interp(t, t[good], w[good, k]) for k in range(2)])
    upper = np.array([winds[s] for s in UPPER])
    if height is None:
        return upper.mean(axis=0), upper.std(axis=0, ddof=1)
    z = np.array(list(MAST.values()))
    if not z[0] <= height <= z[-1]:
        raise ValueError(f"the mast has anemometers from {z[0]} to {z[-1]} m, not at {height} m")
    k = min(int(np.searchsorted(z, height, side="right")) - 1, len(z) - 2)
    share = (height - z[k]) / (z[k + 1] - z[k])
    below, above = list(winds.values())[k : k + 2]
    return (1.0 - share) * below + share * above, upper.std(axis=0, ddof=1)
