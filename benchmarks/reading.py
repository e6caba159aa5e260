"""How long a log takes to read, beside the library that only parses the format, on the same file in the same process.

The library alone gives fields as logged; ``haltere.read`` also brings them to streams with units, frames and usable times.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import common
from common import Table

ROUNDS = 5
LIMIT = "<= 1.3"
#: Recordings in the data folder, by the library that parses them.
LOGS = (
    ("pyulog", "px4/sample.ulg"),
    ("pyulog", "px4/sample_unordered.ulg"),
    ("pyulog", "px4/sample_logging_tagged_and_default_params.ulg"),
    ("pyulog", "px4/sample_px4_events.ulg"),
    ("pyulog", "px4/sample_log_small.ulg"),
    ("pymavlink", "ardupilot/log_0036_mechanical_failure.bin"),
    ("pymavlink", "ardupilot/log_0041_mechanical_failure.bin"),
    ("pymavlink", "ardupilot/beast_sample.bin"),
    ("orangebox", "indiflight/IROS2024_ExperimentData__LOG00271.BFL"),
)


def pyulog_alone(path: Path) -> int:
    """Samples in a ULog parsed whole."""
    from pyulog import ULog

    with contextlib.redirect_stdout(io.StringIO()):
        return sum(len(d.data["timestamp"]) for d in ULog(str(path)).data_list)


def pyulog_same_topics(path: Path) -> int:
    """Samples in a ULog parsed with the topics that haltere reads, by pyulog's own filter."""
    from pyulog import ULog

    from haltere.readers._ulog import TOPICS

    with contextlib.redirect_stdout(io.StringIO()):
        return sum(len(d.data["timestamp"]) for d in ULog(str(path), list(TOPICS)).data_list)


def pymavlink_alone(path: Path) -> int:
    """Messages of a DataFlash log, binary or text, gone through one by one as pymavlink's own tools do."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its deprecations
        from pymavlink import DFReader

        kind = DFReader.DFReader_text if path.suffix == ".log" else DFReader.DFReader_binary
        log, n = kind(str(path)), 0
        while log.recv_msg() is not None:
            n += 1
        log.close()
    return n


def orangebox_alone(path: Path) -> int:
    """Frames of a blackbox log, all logs of the file's first header."""
    import logging

    from orangebox import Parser

    logging.getLogger("orangebox").setLevel(logging.CRITICAL)  # it tells of every header that it does not know
    return sum(1 for _ in Parser.load(str(path)).frames())


def rosbags_alone(path: Path) -> int:
    """Messages of a bag, each deserialised."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    n = 0
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
            n += 1
    return n


ALONE: dict[str, list[tuple[str, Callable[[Path], int]]]] = {
    "pyulog": [("pyulog, all", pyulog_alone), ("pyulog, our topics", pyulog_same_topics)],
    "pymavlink": [("pymavlink", pymavlink_alone)],
    "orangebox": [("orangebox", orangebox_alone)],
    "rosbags": [("rosbags", rosbags_alone)],
}


def make_bag(path: Path, seconds: float = 60.0) -> None:
    """Write a ROS 2 bag: a still vehicle's IMU at 200 Hz, magnetic field at 50, fix at 5, pressure at 10."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = store.types
    header, when = kind["std_msgs/msg/Header"], kind["builtin_interfaces/msg/Time"]
    vector, turn = kind["geometry_msgs/msg/Vector3"], kind["geometry_msgs/msg/Quaternion"]
    import numpy as np

    nine, unit = np.zeros(9), turn(x=0.0, y=0.0, z=0.0, w=1.0)

    def imu(h: Any) -> Any:
        turning, force = vector(x=0.01, y=0.0, z=0.0), vector(x=0.0, y=0.1, z=9.81)
        return kind["sensor_msgs/msg/Imu"](
            header=h, orientation=unit, orientation_covariance=nine, angular_velocity=turning, angular_velocity_covariance=nine,
            linear_acceleration=force, linear_acceleration_covariance=nine,
        )  # fmt: skip

    def field(h: Any) -> Any:
        return kind["sensor_msgs/msg/MagneticField"](
            header=h, magnetic_field=vector(x=0.0, y=2e-5, z=-4e-5), magnetic_field_covariance=nine
        )

    def fix(h: Any) -> Any:
        status = kind["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
        return kind["sensor_msgs/msg/NavSatFix"](
            header=h, status=status, latitude=47.4, longitude=8.5, altitude=450.0, position_covariance=nine, position_covariance_type=0
        )

    def pressure(h: Any) -> Any:
        return kind["sensor_msgs/msg/FluidPressure"](header=h, fluid_pressure=96000.0, variance=1.0)

    topics = (
        ("/imu/data_raw", "Imu", 200, imu),
        ("/imu/mag", "MagneticField", 50, field),
        ("/gps/fix", "NavSatFix", 5, fix),
        ("/pressure", "FluidPressure", 10, pressure),
    )
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for topic, name, rate, message in topics:
            msgtype = f"sensor_msgs/msg/{name}"
            connection = writer.add_connection(topic, msgtype, typestore=store)
            for i in range(int(seconds * rate)):
                ns = 1_700_000_000_000_000_000 + i * 1_000_000_000 // rate
                stamp = when(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)
                content = message(header(stamp=stamp, frame_id="base_link"))
                writer.write(connection, ns, store.serialize_cdr(content, msgtype))


def short(name: str, most: int = 24) -> str:
    """A file's name with its middle left out where it is long."""
    return name if len(name) <= most else f"{name[: most - 12]}…{name[-11:]}"


def compare(path: Path, library: str, rounds: int, called: str = "") -> list[dict[str, Any]]:
    """One row a way of parsing the file alone, with our time beside it."""
    import haltere

    def timed(read: Callable[[Path], Any]) -> Callable[[], float]:
        def run() -> float:
            began = common.clock()
            read(path)
            return common.clock() - began

        return run

    size = sum(p.stat().st_size for p in (path.rglob("*") if path.is_dir() else [path]) if p.is_file()) / 1e6
    base = {"what": called or short(path.name), "size": size}
    reason = common.missing(library)
    if reason is None:
        try:
            haltere.read(path)
        except haltere.HaltereError as error:
            reason = f"haltere.read: {error.found}"
    if reason is not None:
        return [base | {"skipped": reason}]
    ways = ALONE[library]
    seconds = common.interleave({"haltere": timed(haltere.read), **{name: timed(f) for name, f in ways}}, rounds)
    rows = []
    for name, _ in ways:
        ratio = common.ratios(seconds["haltere"], seconds[name])
        row = base | {"ours": common.measure(seconds["haltere"]), "alone": common.measure(seconds[name]), "way": name, "ratio": ratio}
        rows.append(common.judged(row, ratio["median"], LIMIT))
    return rows


def run(rounds: int = ROUNDS, bag_seconds: float = 60.0) -> list[Table]:
    """Every recording of `LOGS`, and a bag made for the occasion."""
    columns = [
        ("what", "log", "text"), ("size", "MB", "fixed"), ("ours", "haltere.read, ms", "ms"), ("way", "library alone", "text"),
        ("alone", "alone, ms", "ms"), ("ratio", "ratio", "ratio"), ("met", "met", "text"),
    ]  # fmt: skip
    title = f"Processor time to read a log on one core, median (range) of {rounds} interleaved rounds; asked is a ratio of at most 1.3"
    table = Table("reading", title, columns)
    with common.one_core():
        for library, name in LOGS:
            reason = common.missing_data(name)
            if reason:
                table.rows.append({"what": short(Path(name).name), "skipped": reason})
                continue
            table.rows += compare(common.data_folder() / name, library, rounds)
        reason = common.missing("rosbags")
        if reason:
            table.rows.append({"what": "ROS 2 bag, made", "skipped": reason})
            return [table]
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / "made"
            make_bag(bag, bag_seconds)
            table.rows += compare(bag, "rosbags", rounds, f"ROS 2 bag, made, {bag_seconds:g} s")
    return [table]
