"""PX4's own solution, the simulator's truth and the home position of a ULog. It reads no sensor."""

from __future__ import annotations

import numpy as np

from haltere.readers._common import Builder, Columns, FloatArray, IntArray, merge_rows, metres_per_degree
from haltere.readers._ulog import Log, Topic

__all__ = ["add_solution", "add_truth", "set_home"]

#: A reference altitude further than this [m] from home's is not a height above mean sea level.
ALTITUDE_DATUM_LIMIT = 100.0


def set_home(log: Log, builder: Builder) -> None:
    """Home of the flight: the newest valid home_position, else the origin of the local position."""
    home = log.one("home_position")
    if home is not None:
        lat, lon, alt = home.get("lat"), home.get("lon"), home.get("alt")
        good = np.isfinite(lat) & np.isfinite(lon) & np.isfinite(alt) & ((lat != 0.0) | (lon != 0.0))
        for flag in ("valid_hpos", "valid_alt"):
            if flag in home:
                good &= home.data[flag] != 0
        if good.any():
            i = int(np.flatnonzero(good)[-1])
            builder.set_home(lat[i], lon[i], alt[i])
            return
    local = log.one("vehicle_local_position")
    if local is not None:
        good = _referenced(local, "xy_global") & _referenced(local, "z_global")
        if good.any():
            i = int(np.flatnonzero(good)[-1])
            builder.set_home(local.get("ref_lat")[i], local.get("ref_lon")[i], local.get("ref_alt")[i])
            builder.note("home is the origin of the local position: the log has no valid home_position")


def add_solution(log: Log, builder: Builder) -> None:
    """The stream ``onboard``: rows at the stamps of every topic that carries a part of the solution."""
    pieces = _pose(log, builder, "onboard", "")
    selector = log.one("estimator_selector_status")
    primary = selector.last("primary_instance") if selector is not None else 0
    bias = log.one("estimator_sensor_bias", instance=primary or 0)
    if bias is not None:
        columns: Columns = {}
        for sensor in ("gyro", "accel"):
            part = bias.vector(f"{sensor}_bias", f"{sensor}_bias")
            if f"{sensor}_bias_valid" in bias:
                unknown = bias.data[f"{sensor}_bias_valid"] == 0
                for values in part.values():
                    values[unknown] = np.nan
            columns |= part
        pieces.append((bias.us, columns))
    wind = log.one("wind", "wind_estimate")
    if wind is not None:
        columns = {"wind_n": wind.get("windspeed_north"), "wind_e": wind.get("windspeed_east")}
        variances = [wind.get(f"variance_{a}", f"covariance_{a}") for a in ("north", "east")]
        idle = variances[0] + variances[1] == 0.0
        columns |= {f"sd_wind_{a}": np.sqrt(np.where(v > 0.0, v, np.nan)) for a, v in zip("ne", variances, strict=True)}
        if idle.any():
            builder.note(f"onboard wind has zero variance, so was not estimated, in {int(idle.sum())} of {len(wind)} samples: NaN")
        for values in columns.values():
            values[idle] = np.nan
        pieces.append((wind.us, columns))
    us, merged = merge_rows(pieces)
    builder.add("onboard", us, merged)


def add_truth(log: Log, builder: Builder) -> None:
    """The stream ``truth`` from the simulator's groundtruth topics."""
    us, merged = merge_rows(_pose(log, builder, "truth", "_groundtruth"))
    builder.add("truth", us, merged)


def _pose(log: Log, builder: Builder, stream: str, suffix: str) -> list[tuple[IntArray, Columns]]:
    """Attitude, local position and global position topics as pieces of a solution stream."""
    pieces: list[tuple[IntArray, Columns]] = []
    attitude = log.one(f"vehicle_attitude{suffix}")
    if attitude is not None:
        pieces.append((attitude.us, {f"q_{a}": attitude.get(f"q[{i}]") for i, a in enumerate("wxyz")}))
    local = log.one(f"vehicle_local_position{suffix}")
    if local is not None:
        pieces.append((local.us, _local(local, builder, stream)))
    position = log.one(f"vehicle_global_position{suffix}")
    if position is not None:
        columns = {name: position.get(name) for name in ("lat", "lon", "alt")}
        # Before 1.9 these were integers.
        for name, scale in (("lat", 1e-7), ("lon", 1e-7), ("alt", 1e-3)):
            if name in position and position.data[name].dtype.kind in "iu":
                columns[name] *= scale
        for name, flag in (("lat", "lat_lon_valid"), ("lon", "lat_lon_valid"), ("alt", "alt_valid")):
            if flag in position:
                columns[name][position.data[flag] == 0] = np.nan
        home = builder.meta.home
        known = np.isfinite(columns["alt"])
        if home is not None and known.any() and abs(float(np.median(columns["alt"][known])) - home.alt) > ALTITUDE_DATUM_LIMIT:
            builder.note(f"{stream} alt does not count from mean sea level: NaN in {int(known.sum())} samples")
            columns["alt"] = np.full(len(position), np.nan)
        pieces.append((position.us, columns))
    return pieces


def _referenced(local: Topic, flag: str) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Rows whose local position hangs on a known geodetic origin."""
    lat, lon, alt = local.get("ref_lat"), local.get("ref_lon"), local.get("ref_alt")
    good = np.isfinite(lat) & np.isfinite(lon) & np.isfinite(alt) & ((lat != 0.0) | (lon != 0.0))
    if flag in local:
        good &= local.data[flag] != 0
    return np.asarray(good)


def _local(local: Topic, builder: Builder, stream: str) -> Columns:
    """Velocity and position; NaN where the estimator calls them invalid, positions moved to the flight's home."""
    columns: Columns = {}
    lost = 0
    for out, field, flag in (
        ("vel_n", "vx", "v_xy_valid"),
        ("vel_e", "vy", "v_xy_valid"),
        ("vel_d", "vz", "v_z_valid"),
        ("pos_n", "x", "xy_valid"),
        ("pos_e", "y", "xy_valid"),
        ("pos_d", "z", "z_valid"),
    ):
        values = local.get(field)
        if flag in local:
            invalid = local.data[flag] == 0
            values[invalid] = np.nan
            lost = max(lost, int(invalid.sum()))
        columns[out] = values
    if lost:
        builder.note(f"{stream} velocity or position is called invalid by its estimator in up to {lost} of {len(local)} samples: NaN")
    home = builder.meta.home
    if home is None:
        builder.note(f"{stream} positions are relative to the estimator's own origin: the log has no home")
        return columns
    north, east = metres_per_degree(home.lat, home.alt)
    level, height = _referenced(local, "xy_global"), _referenced(local, "z_global")
    shift_d: FloatArray = home.alt - local.get("ref_alt")
    if height.any() and np.median(np.abs(shift_d[height])) > ALTITUDE_DATUM_LIMIT:
        reference = local.get("ref_alt")[height][-1]
        builder.note(f"{stream} heights do not count from mean sea level (reference altitude {reference:.1f} m): kept as they are")
        shift_d = np.zeros(len(local))
    for name, shift, known in (
        ("pos_n", (local.get("ref_lat") - home.lat) * north, level),
        ("pos_e", (local.get("ref_lon") - home.lon) * east, level),
        ("pos_d", shift_d, height),
    ):
        loose = int((~known & np.isfinite(columns[name])).sum())
        if loose:
            builder.note(f"{stream} {name} hangs on no geodetic origin yet in {loose} of {len(local)} samples: NaN")
        columns[name] = np.where(known, columns[name] + shift, np.nan)
    return columns
