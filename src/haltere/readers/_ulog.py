"""ULog files as topics with usable times, parsed by pyulog. It knows no topic's meaning."""

from __future__ import annotations

import contextlib
import io
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.readers._common import Builder, Columns, FloatArray, IntArray, number, unusable

__all__ = ["MAGIC", "Log", "Topic"]

MAGIC = b"ULog\x01\x12\x35"
#: Bytes out of place in the definitions after which they are beyond repair.
STRAY_LIMIT = 10_000
#: Topics that are read, all versions.
TOPICS = (
    "sensor_combined vehicle_imu sensor_selection vehicle_magnetometer sensor_mag vehicle_air_data sensor_baro "
    "vehicle_gps_position sensor_gps airspeed_validated airspeed esc_status actuator_motors actuator_outputs battery_status "
    "vehicle_attitude vehicle_local_position vehicle_status "
    "vehicle_global_position estimator_sensor_bias estimator_selector_status wind wind_estimate home_position "
    "vehicle_attitude_groundtruth vehicle_local_position_groundtruth vehicle_global_position_groundtruth"
).split()


class Topic:
    """One instance of one uORB topic as columns.

    Parameters
    ----------
    name, instance
        Topic and instance number.
    data
        Column by ULog field name.
    """

    def __init__(self, name: str, instance: int, data: dict[str, NDArray[Any]]) -> None:
        self.name, self.instance, self.data = name, instance, data
        sent = data["timestamp"].astype(np.int64)
        sample = data["timestamp_sample"].astype(np.int64) if "timestamp_sample" in data else None
        # The sample stamp is the truer one, but some senders leave it zero or never change it.
        usable = sample is not None and (sample > 0).any() and (len(sample) == 1 or bool((sample != sample[0]).any()))
        self.us: IntArray = np.where(sample > 0, sample, sent) if usable and sample is not None else sent
        self.sent: IntArray = sent

    def __contains__(self, field: object) -> bool:
        return field in self.data

    def __len__(self) -> int:
        return len(self.us)

    def get(self, *fields: str, scale: float = 1.0) -> FloatArray:
        """First of several fields that is there, scaled; NaN where none is."""
        for field in fields:
            if field in self.data:
                return number(self.data[field]) * scale
        return np.full(len(self.us), np.nan)

    def vector(self, field: str, out: str, scale: float = 1.0) -> Columns:
        """Three components ``field[0..2]`` as ``out_x, out_y, out_z``."""
        return {f"{out}_{a}": self.get(f"{field}[{i}]", scale=scale) for i, a in enumerate("xyz")}

    def integers(self, field: str) -> IntArray | None:
        """A field of whole numbers or flags, or None where it is not there."""
        return np.nan_to_num(number(self.data[field])).astype(np.int64) if field in self.data else None

    def last(self, field: str) -> int | None:
        """Newest value of an integer field."""
        return int(self.data[field][-1]) if field in self.data and len(self) else None


class Log:
    """The topics of a ULog that have usable times."""

    def __init__(self, path: Path, builder: Builder) -> None:
        from pyulog import ULog

        said = io.StringIO()
        # pyulog tells of damage on standard output, where only results belong.
        with contextlib.redirect_stdout(said):
            try:
                with path.open("rb") as file:  # pyulog leaves a file open that it cannot parse
                    _check_definitions(file, path)
                    ulog = ULog(file, list(TOPICS))
            except HaltereError:
                raise
            except Exception as error:
                raise unusable(path, "a ULog that can be parsed", f"{type(error).__name__}: {error}") from error
        if ulog.file_corruption:
            builder.note("the file is damaged: what could not be parsed is missing")
        if ulog.dropouts:
            total = sum(d.duration for d in ulog.dropouts)
            builder.note(f"the logger dropped data {len(ulog.dropouts)} times, {total} ms in all")
        changed = {name: value for _, name, value in ulog.changed_parameters}
        self.params: dict[str, int] = {k: v for k, v in (ulog.initial_parameters | changed).items() if isinstance(v, int)}
        #: All of them as numbers.
        self.numbers = {k: float(v) for k, v in (ulog.initial_parameters | changed).items() if isinstance(v, int | float)}
        known = isinstance(ulog.msg_info_dict.get("ver_sw_release", 0), int)
        self.version: str | None = ulog.get_version_info_str() if known else None
        self._topics: dict[str, dict[int, Topic]] = {}
        for data in ulog.data_list:
            stamps = data.data.get("timestamp")
            if stamps is None or not len(stamps):
                continue
            if len(stamps) > 1 and (stamps == stamps[0]).all():
                builder.note(f"{data.name}[{data.multi_id}] left out: all {len(stamps)} samples are stamped {int(stamps[0])} us")
                builder.discard(data.name, "constant time stamps", len(stamps))
                continue
            self._topics.setdefault(data.name, {})[data.multi_id] = Topic(data.name, data.multi_id, data.data)

    def one(self, *names: str, instance: int = 0) -> Topic | None:
        """First of several topics that is there, in an instance or else the lowest one."""
        for name in names:
            found = self._topics.get(name)
            if found:
                return found.get(instance) or found[min(found)]
        return None

    def all(self, name: str) -> list[Topic]:
        """Every instance of a topic, in order."""
        return [topic for _, topic in sorted(self._topics.get(name, {}).items())]


def _check_definitions(file: BinaryIO, path: Path) -> None:
    """Walk the definitions up to the first data, as pyulog does, and refuse damage on which it would never come to an end."""
    size = path.stat().st_size
    at, stray = 16, 0
    while at + 3 <= size:
        file.seek(at)
        length, kind = struct.unpack("<Hc", file.read(3))
        if kind in (b"A", b"L", b"C"):
            break
        if kind not in (b"I", b"M", b"F", b"P", b"Q", b"B") and (kind == b"\0" or not 0 < length <= 10000):
            stray += 1
            if at + 3 + length > size or stray > STRAY_LIMIT:
                raise unusable(path, "a ULog with whole definitions", f"damage at byte {at}")
            at += 1
        else:
            at += 3 + length
    file.seek(0)
