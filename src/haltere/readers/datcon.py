"""Reading the CSV tables that DatCon makes of DJI flight records into a FlightLog. Held values are read once; nothing is resampled."""

from __future__ import annotations

import datetime as dt
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from haltere.readers._common import DEG, RPM, Builder, Columns, FloatArray, IntArray, q_from_euler, unusable
from haltere.readers._modes import add_modes

if TYPE_CHECKING:
    import polars as pl

    from haltere.flight.log import FlightLog

__all__ = ["read", "sniff"]

G = 9.80665
#: Motors in DJI's own order: 1 right front, 2 left front, 3 left back, 4 right back.
MOTORS = ("RFront", "LFront", "LBack", "RBack")
IMU = re.compile(r"^IMU_ATTI\((\d)\):(accel|gyro|mag):?([XYZ])$")
#: A unit in brackets that some versions write behind a name.
BRACKETS = re.compile(r"\s*\[(?!mag\]|true\]).*$")
GPS_DATE = ("GPS(0):Date", "GPS(0):Time")


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is a CSV table of DatCon: its header names a clock and the first inertial unit."""
    line = head.lstrip(b"\xef\xbb\xbf").split(b"\n", 1)[0]
    return b"," in line and b"IMU_ATTI(0):" in line and b"offsetTime" in line


def read(path: Path) -> FlightLog:
    """Read a CSV table of DatCon's third version.

    Parameters
    ----------
    path
        The ``.csv`` file.

    Returns
    -------
    FlightLog
        Streams at the rate of the table, each with only the rows at which its sensor gave a new value.

    Raises
    ------
    HaltereError
        The table cannot be read, or has no time.

    Notes
    -----
    DatCon's own description calls accelerations metres a second squared, but writes g: the unit is found from the size of gravity.
    """
    builder = Builder(path, "DJI DatCon CSV")
    table = _Table(path)
    units = sorted({int(m[1]) for name in table.names if (m := IMU.match(name))})
    for i, unit in enumerate(units):
        _add_imu(table, builder, unit, "" if i == 0 else f".{i}")
    _add_gnss(table, builder)
    _add_rotors(table, builder)
    _add_power(table, builder)
    _add_onboard(table, builder)
    if (modes := table.text("flyCState")) is not None:
        rows = np.flatnonzero(modes != "")
        add_modes(builder, (table.us[rows], [m.replace("_", " ") for m in modes[rows].tolist()]))
    attributes = table.text("Attribute|Value")
    known = dict(a.split("|", 1) for a in (attributes.tolist() if attributes is not None else []) if "|" in a)
    if "ACType" in known:
        builder.meta.source += f", DJI {known['ACType'].strip('| ')}"
    _set_utc(table, builder)
    builder.discard("imu", "row without a time", table.lost)
    flight = builder.build()
    counts = ", ".join(f"{name} {len(stream)}" for name, stream in flight.streams.items() if name != "modes")
    flight.notes.append(
        f"of {len(table.us)} rows of the table, those that repeat a sensor's value before or are empty were left out: {counts}"
    )
    return flight


class _Table:
    """The CSV as columns by DatCon's names without units, and its clock."""

    def __init__(self, path: Path) -> None:
        import polars as pl

        try:
            table = pl.read_csv(path, infer_schema_length=0, encoding="utf8-lossy", truncate_ragged_lines=True)
        except (pl.exceptions.PolarsError, OSError) as error:
            raise unusable(path, "a CSV table that can be read", str(error).splitlines()[0]) from error
        self._columns: dict[str, pl.Series] = {}
        for name in table.columns:
            self._columns.setdefault(BRACKETS.sub("", name.strip()).removeprefix("Clock:"), table[name].str.strip_chars())
        self.names = list(self._columns)
        seconds = self.get("offsetTime") if "offsetTime" in self._columns else np.empty(0)
        self._rows = np.isfinite(seconds) & (np.abs(np.nan_to_num(seconds)) < 1e9)
        if not self._rows.any():
            raise unusable(path, "times in the column offsetTime", "none", "let DatCon write the table again")
        # Seconds since the motors started: what came before is negative.
        self.us: IntArray = np.rint(seconds[self._rows] * 1e6).astype(np.int64)
        self.lost = int((~self._rows).sum())

    def get(self, *names: str) -> FloatArray:
        """First of several columns that is there as numbers; NaN where it is empty or none is."""
        import polars as pl

        rows = getattr(self, "_rows", slice(None))
        for name in names:
            if name in self._columns:
                return self._columns[name].cast(pl.Float64, strict=False).fill_null(float("nan")).to_numpy().astype(np.float64)[rows]
        return np.full(len(self.us), np.nan)

    def text(self, name: str) -> NDArray[np.str_] | None:
        """A column as text, or None where it is missing."""
        if name not in self._columns:
            return None
        return np.array(self._columns[name].fill_null("").to_list(), dtype=np.str_)[self._rows]


def _fresh(*values: FloatArray) -> NDArray[np.intp]:
    """Rows at which one of several columns holds a new value; rows without any are left out."""
    table = np.column_stack(values)
    rows = np.flatnonzero(np.isfinite(table).any(axis=1))
    held = np.nan_to_num(table[rows], nan=1e300)
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (held[1:] != held[:-1]).any(axis=1)
    return rows[new]


def _add_imu(table: _Table, builder: Builder, unit: int, number: str) -> None:
    def vector(sensor: str) -> list[FloatArray]:
        return [table.get(f"IMU_ATTI({unit}):{sensor}:{a}", f"IMU_ATTI({unit}):{sensor}{a}") for a in "XYZ"]

    accel, gyro, mag = vector("accel"), vector("gyro"), vector("mag")
    rows = _fresh(*accel, *gyro)
    rows = rows[np.isfinite(np.column_stack([*accel, *gyro])[rows]).all(axis=1)]
    if len(rows):
        gravity = float(np.median(np.linalg.norm(np.column_stack(accel)[rows], axis=1)))
        in_g = gravity < 3.0
        scale = G if in_g else 1.0
        columns = {f"gyro_{a}": gyro[i][rows] * DEG for i, a in enumerate("xyz")}
        columns |= {f"accel_{a}": accel[i][rows] * scale for i, a in enumerate("xyz")}
        builder.add(f"imu{number}", table.us[rows], columns)
        builder.note(f"imu{number} is in {'g' if in_g else 'm/s^2'} (median {gravity:.3g}) and deg/s, thinned to the rate of the table")
    rows = _fresh(*mag)
    if np.isfinite(np.column_stack(mag)[rows]).all(axis=1).any():
        builder.add(f"field_counts{number}", table.us[rows], {f"mag_{a}": mag[i][rows] for i, a in enumerate("xyz")})
        strength = float(np.nanmedian(np.linalg.norm(np.column_stack(mag)[rows], axis=1)))
        builder.note(
            f"magnetometer{number} is in counts (median {strength:.0f}) whose unit nothing documents: it is in the stream "
            f"field_counts{number}, which no estimator reads{_field(table)}"
        )
    height = table.get(f"IMU_ATTI({unit}):barometer:Raw", f"IMU_ATTI({unit}):barometerRaw")
    rows = _fresh(height)
    rows = rows[height[rows] != 0.0]
    if len(rows) > 1:
        builder.add(f"barometer{number}", table.us[rows], {"altitude": height[rows]})


def _field(table: _Table) -> str:
    """What the vehicle's own field model says of the place."""
    attributes = table.text("Attribute|Value")
    for cell in attributes.tolist() if attributes is not None else []:
        found = re.match(r"geoIntensity\|(\d+)", cell)
        if found:
            return f"; the vehicle's field model gives {float(found[1]) * 1e-5:.1f} uT there"
    return ""


def _add_gnss(table: _Table, builder: Builder) -> None:
    lat, lon = table.get("GPS(0):Lat"), table.get("GPS(0):Long")
    height, velocity = table.get("GPS(0):heightMSL"), [table.get(f"GPS(0):vel{a}") for a in "NED"]
    stamp = [table.get(name) for name in GPS_DATE]
    rows = _fresh(lat, lon, height, *velocity, *stamp)
    fixed = (lat[rows] != 0.0) & (lon[rows] != 0.0) & np.isfinite(lat[rows])
    builder.discard("gnss", "no fix yet: latitude and longitude zero", int((~fixed).sum()))
    rows = rows[fixed]
    if not len(rows):
        return
    columns: Columns = {"lat": lat[rows], "lon": lon[rows], "alt": height[rows]}
    columns |= {f"vel_{a}": v[rows] for a, v in zip("ned", velocity, strict=True)}
    columns["num_sats"] = table.get("GPS(0):numSV")[rows]
    columns |= {f"{k.lower()}": table.get(f"GPS(0):{k}")[rows] for k in ("hDOP", "pDOP")}
    builder.add("gnss", table.us[rows], columns)
    if "GPS(0):sAcc" in table.names:
        builder.note("GPS(0):sAcc left out: its unit is not documented; accuracies of gnss are not known")


def _add_rotors(table: _Table, builder: Builder) -> None:
    found = [n.removeprefix("Motor:Speed:") for n in table.names if n.startswith("Motor:Speed:")]
    motors = [m for m in MOTORS if m in found] + sorted(m for m in found if m not in MOTORS)
    if not motors:
        return
    speeds = [table.get(f"Motor:Speed:{m}") for m in motors]
    rows = _fresh(*speeds)
    if not len(rows):
        return
    builder.add("rotors", table.us[rows], {f"speed_{i}": np.abs(s[rows]) * RPM for i, s in enumerate(speeds)})
    builder.note(f"rotors are, from speed_0 on, {', '.join(motors)}")


def _add_power(table: _Table, builder: Builder) -> None:
    voltage, current = table.get("BattInfo:Pack_ve"), table.get("BattInfo:Current")
    rows = _fresh(voltage, current)
    rows = rows[(voltage[rows] != 0.0) & np.isfinite(voltage[rows])]
    if len(rows):
        builder.add("power", table.us[rows], {"voltage": voltage[rows], "current": current[rows]})


def _add_onboard(table: _Table, builder: Builder) -> None:
    angles = [table.get(f"IMU_ATTI(0):{a}") for a in ("roll", "pitch", "yaw")]
    velocity = [table.get(f"IMU_ATTI(0):vel{a}") for a in "NED"]
    lat, lon = table.get("IMU_ATTI(0):Latitude"), table.get("IMU_ATTI(0):Longitude")
    rows = _fresh(*angles, *velocity, lat, lon)
    # Before the flight controller's own filter runs, all angles are zero.
    turned = np.column_stack(angles)[rows]
    rows = rows[np.isfinite(turned).all(axis=1) & (turned != 0.0).any(axis=1)]
    if not len(rows):
        return
    columns = q_from_euler(*(a[rows] * DEG for a in angles)) | {f"vel_{a}": v[rows] for a, v in zip("ned", velocity, strict=True)}
    builder.add("onboard", table.us[rows], columns | {"lat": lat[rows], "lon": lon[rows]} | _wind(table, rows))


def _wind(table: _Table, rows: NDArray[np.intp]) -> Columns:
    """DJI's own wind: speed and the direction it comes from; NaN while it is zero, which is before it is estimated."""
    speed, direction = table.get("Wind:velocity")[rows], table.get("Wind:fromDir")[rows]
    speed = np.where(speed > 0.0, speed, np.nan)
    if not np.isfinite(speed * direction).any():
        return {}
    return {"wind_n": -speed * np.cos(direction * DEG), "wind_e": -speed * np.sin(direction * DEG)}


def _set_utc(table: _Table, builder: Builder) -> None:
    """UTC at the first row after the receiver's second changed: between two of them it is held."""
    date, time = (table.get(name) for name in GPS_DATE)
    # Without a fix the receiver makes a date up.
    change = np.flatnonzero((np.diff(time) == 1.0) & (np.nan_to_num(table.get("GPS(0):Lat"))[1:] != 0.0)) + 1
    if not len(change):
        return
    i = int(change[0])
    try:
        stamp = dt.datetime.strptime(f"{int(date[i]):08d}{int(time[i]):06d}+0000", "%Y%m%d%H%M%S%z")
    except ValueError:
        return
    builder.utc = (int(table.us[i]), round(stamp.timestamp() * 1e6))
