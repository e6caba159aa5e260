"""Good logs of every format, seeded ways to damage them, and a judge of what reading them came to; as a script, the long run.

    python tests/fuzz.py --minutes 10 [--seed N] [--jobs 2] [--only KIND ...]     run; exit status 1 where something was found
    python tests/fuzz.py --case KIND NUMBER [--keep FOLDER]                       one case again, with its traceback

A case is made from its kind and number alone. Every case runs in a worker process with a limit on processor time and memory,
so that a hang, a crash of the interpreter and a flood of memory are findings like others.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import json
import os
import random
import re
import resource
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("HALTERE_JIT", "open")
os.environ.setdefault("POLARS_MAX_THREADS", "2")

from haltere.errors import HaltereError
from haltere.flight.door import check
from haltere.flight.folder import write_folder
from haltere.flight.log import FlightLog, FlightMeta, Home
from haltere.readers import read

#: A case: its files by relative path. One file is a log, several are a flight folder.
Files = dict[str, bytes]
Rng = random.Random

#: Processor seconds and bytes of memory that a case may take beyond what the worker has, and seconds after which it is called stuck.
CPU_SECONDS, MEMORY, WALL_SECONDS = 10.0, 1 << 30, 120.0
#: Every how many cases that could be read a flight is written and read again, navigated, and drawn.
WRITE_EVERY, RUN_EVERY, DRAW_EVERY = 4, 6, 60


# Good logs: four seconds at rest, every stream, small enough that a thousand a minute can be read

N_IMU, IMU_US = 200, 20_000
START_US = 100_000_000


def _flight() -> FlightLog:
    """A vehicle at rest, with every stream."""
    rng = np.random.default_rng(0)
    t = np.arange(N_IMU) * IMU_US * 1e-6
    slow, fix = t[::5], t[::10]
    gyro, accel = rng.normal(0.0, 0.002, (3, N_IMU)), rng.normal(0.0, 0.05, (3, N_IMU))
    field = rng.normal(0.0, 0.3, (3, len(slow)))
    ones = np.ones(len(fix))
    return FlightLog(
        {
            "imu": {"t": t, "gyro_x": gyro[0], "gyro_y": gyro[1], "gyro_z": gyro[2],
                    "accel_x": accel[0], "accel_y": accel[1], "accel_z": accel[2] - 9.81},
            "magnetometer": {"t": slow, "mag_x": 21.0 + field[0], "mag_y": 1.0 + field[1], "mag_z": 43.0 + field[2]},
            "gnss": {"t": fix, "lat": 47.0 + 1e-6 * rng.normal(size=len(fix)), "lon": 8.0 + 1e-6 * rng.normal(size=len(fix)),
                     "alt": 500.0 * ones, "vel_n": 0.02 * rng.normal(size=len(fix)), "vel_e": 0.02 * rng.normal(size=len(fix)),
                     "vel_d": 0.02 * rng.normal(size=len(fix)), "h_acc": ones, "v_acc": ones, "s_acc": 0.2 * ones,
                     "fix_type": 3.0 * ones, "num_sats": 12.0 * ones},
            "barometer": {"t": slow, "pressure": 95461.0 + rng.normal(0.0, 4.0, len(slow))},
            "rotors": {"t": slow, "speed_0": 0.0 * slow, "speed_1": 0.0 * slow},
            "truth": {"t": fix, "q_w": ones, "q_x": 0.0 * ones, "q_y": 0.0 * ones, "q_z": 0.0 * ones},
        },
        FlightMeta(name="made", source="made", start_utc="2024-05-01T12:00:00.000Z", home=Home(47.0, 8.0, 500.0),
                   delays={"gnss": 0.1}, mounting={"magnetometer": (1.0, 0.0, 0.0, 0.0)}, noise={"gyro": 1e-3}),
        ["made here"],
        {"imu": {"not finite": 2}},
    )  # fmt: skip


def _files_of(folder: Path) -> Files:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _folder(csv: bool) -> Files:
    with tempfile.TemporaryDirectory() as name:
        return _files_of(write_folder(_flight(), Path(name) / "flight", csv=csv))


def _table(parquet: bool) -> Files:
    import polars as pl

    imu = _flight()["imu"].columns
    table = pl.DataFrame({"time [ms]" if k == "t" else f"{k} [deg/s]" if k.startswith("gyro") else k: v for k, v in imu.items()})
    table = table.with_columns(pl.col("time [ms]") * 1000.0, mag_x=pl.lit(21.0), mag_y=pl.lit(1.0), mag_z=pl.lit(43.0), note=pl.lit("ok"))
    out = io.BytesIO()
    if parquet:
        table.write_parquet(out)
        return {"table.parquet": out.getvalue()}
    table.write_csv(out)
    return {"table.csv": out.getvalue()}


def _ulog() -> Files:
    from test_readers_made import Ulg

    flight, log = _flight(), Ulg()
    imu, mag, baro, gnss = (flight[n] for n in ("imu", "magnetometer", "barometer", "gnss"))

    def us(stream: str) -> list[int]:
        return [START_US + int(v) for v in np.rint(flight[stream].t * 1e6)]

    log.param("MAV_TYPE", 2)
    log.param("PWM_MAIN_FUNC1", 101)
    gyro, accel = imu.vector("gyro").tolist(), imu.vector("accel").tolist()
    log.topic(
        "sensor_combined", "float[3] gyro_rad, int32_t accelerometer_timestamp_relative, float[3] accelerometer_m_s2",
        [(t, *g, 0, *a) for t, g, a in zip(us("imu"), gyro, accel, strict=True)],
    )  # fmt: skip
    unit = "uint64_t timestamp_sample, uint32_t accel_device_id, uint32_t gyro_device_id, float[3] delta_angle, float[3] delta_velocity, "
    unit += "uint16_t delta_angle_dt, uint16_t delta_velocity_dt"
    for i in range(2):
        log.topic("vehicle_imu", unit, [(t, t - 300, 10 + i, 10 + i, 0, 0, 0, 0, 0, -0.0392, 4000, 4000) for t in us("gnss")], instance=i)
    log.topic("sensor_selection", "uint32_t accel_device_id, uint32_t gyro_device_id, uint32_t mag_device_id", [(START_US, 11, 11, 77)])
    field = (mag.vector("mag") * 0.01).tolist()
    log.topic(
        "vehicle_magnetometer", "uint64_t timestamp_sample, uint32_t device_id, float[3] magnetometer_ga",
        [(t, t - 50, 77, *m) for t, m in zip(us("magnetometer"), field, strict=True)],
    )  # fmt: skip
    log.topic(
        "vehicle_air_data", "uint32_t baro_device_id, float baro_pressure_pa, float ambient_temperature, float baro_alt_meter",
        [(t, 5, float(p), 20.0, 500.0) for t, p in zip(us("barometer"), baro["pressure"], strict=True)],
    )  # fmt: skip
    log.topic("sensor_baro", "uint32_t device_id, float pressure, float temperature", [(t, 6, 951.0, 20.0) for t in us("gnss")])
    log.topic(
        "vehicle_gps_position",
        "uint64_t time_utc_usec, double latitude_deg, double longitude_deg, double altitude_msl_m, float vel_n_m_s, float vel_e_m_s, "
        "float vel_d_m_s, float eph, float epv, float s_variance_m_s, uint8_t fix_type, uint8_t satellites_used, bool vel_ned_valid",
        [(t, 1_700_000_000_000_000 + t, float(la), float(lo), 500.0, 0.0, 0.01, 0.0, 0.5, 0.6, 0.2, 3, 14, True)
         for t, la, lo in zip(us("gnss"), gnss["lat"], gnss["lon"], strict=True)],
    )  # fmt: skip
    log.topic("airspeed_validated", "float true_airspeed_m_s, uint8_t airspeed_source", [(t, 0.1, 1) for t in us("gnss")])
    log.topic(
        "wind", "float windspeed_north, float windspeed_east, float variance_north, float variance_east",
        [(t, 3.0, -2.0, 0.1, 0.1) for t in us("gnss")],
    )  # fmt: skip
    log.topic(
        "vehicle_local_position",
        "double ref_lat, double ref_lon, float ref_alt, float x, float y, float z, float vx, float vy, float vz, "
        "bool xy_valid, bool z_valid, bool v_xy_valid, bool v_z_valid, bool xy_global, bool z_global",
        [(t, 47.0, 8.0, 500.0, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3, *[True] * 6) for t in us("gnss")],
    )  # fmt: skip
    log.topic("vehicle_global_position", "double lat, double lon, float alt", [(t, 47.0, 8.0, 500.0) for t in us("gnss")])
    log.topic("home_position", "double lat, double lon, float alt, bool valid_hpos, bool valid_alt", [(START_US, 47.0, 8.0, 500.0, 1, 1)])
    log.topic("vehicle_attitude", "uint64_t timestamp_sample, float[4] q", [(t, t - 9, 1.0, 0.0, 0.0, 0.0) for t in us("magnetometer")])
    bias = "float[3] gyro_bias, float[3] accel_bias, bool gyro_bias_valid, bool accel_bias_valid"
    log.topic("estimator_sensor_bias", bias, [(t, 0, 0, 0, 0, 0, 0, True, True) for t in us("gnss")])
    log.topic("battery_status", "float voltage_v, float current_a", [(t, 16.0, 5.0) for t in us("gnss")])
    log.topic("actuator_outputs", "float[4] output", [(t, 1250.0, 1500.0, 1900.0, 900.0) for t in us("gnss")])
    log.topic("actuator_motors", "float[12] control", [(t, *[0.1] * 12) for t in us("gnss")])
    return {"log.ulg": bytes(log.head + log.data)}


def _old_ulog() -> Files:
    """As before 1.9: slow sensors inside sensor_combined, integer positions, speed controllers."""
    from test_readers_made import Ulg, _escs

    log = Ulg()
    fields = "float[3] gyro_rad, int32_t accelerometer_timestamp_relative, float[3] accelerometer_m_s2, "
    fields += "int32_t magnetometer_timestamp_relative, float[3] magnetometer_ga, int32_t baro_timestamp_relative, float baro_alt_meter, "
    fields += "float baro_temp_celcius"
    rows = []
    for k in range(N_IMU):
        wobble = 0.001 * (k % 7)
        held = 2147483647 if k < 3 else -IMU_US * (k % 5)
        rows.append((START_US + IMU_US * k, wobble, 0, 0, 0, wobble, 0.0, -9.8, held, 0.2, wobble, 0.4, held, 500.0 + wobble, 20.0))
    log.topic("sensor_combined", fields, rows)
    log.topic(
        "vehicle_gps_position",
        "int32_t lat, int32_t lon, int32_t alt, float vel_n_m_s, float vel_e_m_s, float vel_d_m_s, uint8_t fix_type",
        [(START_US + 200_000 * k, 470_000_000, 80_000_000, 500_000, 0.0, 0.0, 0.0, 3) for k in range(20)],
    )  # fmt: skip
    log.topic("vehicle_global_position", "int32_t lat, int32_t lon, int32_t alt", [(START_US + 9 * k, 470_000_000, 8, 9) for k in range(9)])
    log.topic("sensor_mag", "float x, float y, float z", [(START_US + 9 * k, 0.2, 0.0, 0.4) for k in range(9)])
    _escs(log, (101, 102, 103, 104), (3000, -1000, 2000, 50), 0b1111)
    return {"old.ulg": bytes(log.head + log.data)}


def _dataflash() -> Files:
    from test_readers_made import Bin

    flight, log = _flight(), Bin()
    log.define("PARM", "QNf", "TimeUS,Name,Value")
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.define("MAG", "QBhhhhhh", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ")
    log.define("GPS", "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U")
    log.define("GPA", "QBCCCCBIH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,VV,SMS,Delta")
    log.define("BARO", "QBffc", "TimeUS,I,Alt,Press,Temp")
    log.define("ARSP", "QBfB", "TimeUS,I,Airspeed,H")
    log.define("ESC", "QBf", "TimeUS,Instance,RPM")
    log.define("RCOU", "QHHHH", "TimeUS,C1,C2,C3,C4")
    log.define("BAT", "QBff", "TimeUS,Inst,Volt,Curr")
    log.define("ORGN", "QBLLe", "TimeUS,Type,Lat,Lng,Alt")
    log.define("XKF1", "QBccCffffffccc", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,PN,PE,PD,GX,GY,GZ")
    log.define("XKF2", "QBccccc", "TimeUS,C,AX,AY,AZ,VWN,VWE")
    log.define("XKF4", "QBb", "TimeUS,C,PI")
    log.define("XKFS", "QBBBBB", "TimeUS,C,MI,BI,GI,AI")
    log.define("POS", "QLLf", "TimeUS,Lat,Lng,Alt")
    log.define("SIM", "QccCfLL", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng")
    log.define("MODE", "MBB", "Mode,ModeNum,Rsn")
    for name, value in (("SERVO1_FUNCTION", 33.0), ("SERVO2_FUNCTION", 34.0), ("AHRS_EKF_TYPE", 3.0)):
        log.put("PARM", 0, name, value)
    log.put("MSG", 0, "ArduCopter V4.5.1 (abc)")
    log.put("ORGN", START_US, 0, 47.0, 8.0, 500.0)
    gyro, accel = flight["imu"].vector("gyro").tolist(), flight["imu"].vector("accel").tolist()
    field = (flight["magnetometer"].vector("mag") * 10.0).tolist()
    for k in range(N_IMU):
        us = START_US + IMU_US * k
        log.put("IMU", us, 0, *gyro[k], *accel[k])
        if k % 20 == 0:
            log.put("IMU", us + 5, 1, *gyro[k], *accel[k])
        if k % 5 == 0:
            log.put("MAG", us, 0, *(round(v) for v in field[k // 5]), 5, 6, 7)
            log.put("BARO", us, 0, 500.0, 95461.0 + k % 7, 20.0)
        if k % 10 == 0:
            log.put("GPS", us, 0, 3, 200 * k, 2300, 12, 0.8, 47.0, 8.0, 500.0, 0.0, 90.0, 0.0, 0.0, 1)
            log.put("GPA", us + 100, 0, 1.0, 0.5, 0.9, 0.3, 1, 0, 0)
            log.put("ARSP", us, 0, 0.1, 1)
            log.put("RCOU", us, 1100, 1200, 1300, 1400)
            log.put("BAT", us, 0, 16.0, 5.0)
            for c in range(2):
                log.put("XKF1", us, c, 1.0 + c, 2.0, 350.0, 3.0, 4.0, 5.0, 6.0 + c, 7.0, 8.0, 0.5, 0.0, -0.5)
                log.put("XKF2", us, c, 0.01, 0.02, 0.03, 2.0 + c, -1.0)
                log.put("XKF4", us, c, 0)
                log.put("XKFS", us, c, 0, 0, 0, 0)
            log.put("POS", us + 300, 47.001, 8.001, 510.0)
            log.put("SIM", us, 0.0, 0.0, 90.0, 500.0, 47.0, 8.0)
            log.put("MODE", 3, 3, 1)
        for i in (0, 1):
            log.put("ESC", us + 20 * i, i, 6000.0 + i)
    return {"log.bin": bytes(log.data)}


def _dataflash_text() -> Files:
    flight = _flight()
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 129, 23, PARM, Nf, Name,Value",
        "FMT, 130, 67, MSG, Z, Message",
        "FMT, 131, 31, IMU, Iffffff, TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
        "FMT, 132, 21, MAG, Ihhhhhh, TimeMS,MagX,MagY,MagZ,OfsX,OfsY,OfsZ",
        "FMT, 133, 43, GPS, BIHBcLLeeEefI, Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T",
        "FMT, 134, 17, BARO, Iffc, TimeMS,Alt,Press,Temp",
        "FMT, 135, 13, ATT, IccC, TimeMS,Roll,Pitch,Yaw",
        "FMT, 136, 13, MOT, IHHHH, TimeMS,Mot1,Mot2,Mot3,Mot4",
        "FMT, 137, 13, CURR, IHhh, TimeMS,Thr,Volt,Curr",
        "PARM, FRAME_CLASS, 1.0",
        "MSG, ArduCopter V3.1.2, built, with commas",
    ]
    gyro, accel = flight["imu"].vector("gyro").tolist(), flight["imu"].vector("accel").tolist()
    field = (flight["magnetometer"].vector("mag") * 10.0).tolist()
    for k in range(N_IMU):
        ms = 100_000 + 20 * k
        lines.append("IMU, " + ", ".join([str(ms), *(f"{v:.6f}" for v in gyro[k] + accel[k])]))
        if k % 5 == 0:
            lines.append("MAG, " + ", ".join([str(ms), *(str(round(v)) for v in field[k // 5]), "5", "6", "7"]))
            lines.append(f"BARO, {ms}, {500.0 + k % 3}, {95461.0 + k % 7}, 20.0")
        if k % 10 == 0:
            lines.append(f"GPS, 3, {1000 + 20 * k}, 1800, 12, 0.8, 47.0, 8.0, 1.0, 500.0, 0.0, 90.0, 0.0, {ms}")
            lines.append(f"ATT, {ms}, 1.0, 2.0, 350.0")
            lines.append(f"MOT, {ms}, 1100, 1200, 1300, 1400")
            lines.append(f"CURR, {ms}, 100, 1600, 500")
    return {"log.log": ("\n".join(lines) + "\n").encode()}


def _ros(storage: str) -> Files:
    from test_readers_ros import STORAGES, T0, fix, header, xyz

    flight = _flight()
    turned = np.array([1.0, -1.0, -1.0])
    gyro, accel, field = (flight[s].vector(stem) * turned for s, stem in (("imu", "gyro"), ("imu", "accel"), ("magnetometer", "mag")))
    messages: list[Any] = []
    for k in range(N_IMU):
        at = T0 + 1000 * IMU_US * k
        imu = {"header": header(at), "angular_velocity": xyz(gyro[k]), "linear_acceleration": xyz(accel[k])}
        messages.append(("/imu/data", "sensor_msgs/msg/Imu", at, {**imu, "orientation_covariance": [-1.0, *[0.0] * 8]}))
        if k % 5 == 0:
            mag = {"header": header(at), "magnetic_field": xyz(field[k // 5] * 1e-6)}
            messages.append(("/imu/mag", "sensor_msgs/msg/MagneticField", at, mag))
            messages.append(("/baro", "sensor_msgs/msg/FluidPressure", at, {"header": header(at), "fluid_pressure": 95461.0 + k % 7}))
        if k % 10 == 0:
            messages.append(fix("/fix", at, status={"status": 0, "service": 1}, position_covariance=np.eye(3).ravel()))
    with tempfile.TemporaryDirectory() as name:
        path = STORAGES[storage](Path(name), messages)
        return _files_of(path) if path.is_dir() else {path.name: path.read_bytes()}


def _blackbox() -> Files:
    from test_readers_blackbox import IMU, Log

    rng = np.random.default_rng(0)
    log = Log([*IMU, "motor[0]", "motor[1]", "baroAlt", "vbatLatest"])
    for k in range(3000):
        log.row(*rng.integers(-1, 2, 3).tolist(), *rng.integers(-9, 10, 2).tolist(), 2048 + k % 9, 300, 301, 100 + k % 5, 1600)
        if k % 200 == 0:
            log.slow(1)
            log.gps(12, 470000000, 80000000, 500, 3, 900)
    return {"log.bbl": log.end()}


#: The formats: their good logs, made here.
MADE: dict[str, tuple[Callable[[], Files], ...]] = {
    "ulog": (_ulog, _old_ulog),
    "dataflash": (_dataflash,),
    "dataflash-text": (_dataflash_text,),
    "csv": (lambda: _table(False),),
    "parquet": (lambda: _table(True),),
    "folder-csv": (lambda: _folder(True),),
    "folder-parquet": (lambda: _folder(False),),
    "ros": tuple(partial(_ros, s) for s in ("bag", "bag lz4", "mcap", "mcap, chunks compressed", "db3", "db3 folder", "mcap folder")),
    "blackbox": (_blackbox,),
    "datcon": (),
}
#: Beginnings of real logs, by the file's path below the folder of recordings, with the bytes taken.
REAL: dict[str, tuple[tuple[str, int], ...]] = {
    "ulog": (("px4/sample_log_small.ulg", 250_000), ("px4/sample_appended_multiple.ulg", 150_000), ("px4/sample_px4_events.ulg", 250_000)),
    "dataflash": (("ardupilot/beast_sample.bin", 200_000), ("ardupilot/log_0041_mechanical_failure.bin", 200_000)),
    "dataflash-text": (("ardupilot/nan.log", 60_000), ("ardupilot/mechanical_fail.log", 60_000)),
    "blackbox": (
        ("indiflight/IROS2024_ExperimentData__LOG00257.BFL", 50_000),
        ("indiflight/IROS2024_VideoShootData__LOG00340.BFL", 50_000),
    ),
    "datcon": (("wemuav/datconv3.csv", 200_000),),
}


@cache
def made(kind: str) -> tuple[Files, ...]:
    """The good logs of a format that are made here."""
    return tuple(make() for make in MADE[kind])


@cache
def real(kind: str) -> tuple[Files, ...]:
    """Beginnings of real logs of a format, where the recordings are there."""
    data = Path(os.environ.get("HALTERE_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
    found = [(data / name, size) for name, size in REAL.get(kind, ()) if (data / name).is_file()]
    return tuple({path.name: path.read_bytes()[:size]} for path, size in found)


# Damage

INTEGERS = (0, 1, -1, 2, 127, 128, 255, 256, 32767, -32768, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 2**53, 2**63 - 1, -(2**63), 2**64 - 1)
NUMBERS = (0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 1e-38, 1e308, -1e308, 5e-324, 1e9, 1e18)
WORDS = (
    b"-", b"0x10", b"1_000", b"1,5", b"true", b"None", b"null", b'"', b"'", b'"a,b"', b"[", b"]", b"{", b"=", b"#", b"\0", b"\xff",
    "é".encode(), "\u0661".encode(), b"2024-05-01", b"2024-05-01T12:00:00Z", b"t", b"imu", b"gyro_x", b"..", b"a" * 300,
)  # fmt: skip
#: Cells that are numbers, or that stand where one is missing.
CELLS = (
    b"", b" ", b"nan", b"NaN", b"inf", b"-inf", b"1e400", b"-1e400", b"9" * 400, b"+1", b"0", b"-1", b"1e-400", b"1e308", b"-1e308",
    b"1e18", b"9223372036854775808", b"18446744073709551616",
)  # fmt: skip


def _packed(rng: Rng) -> bytes:
    """A number at the edge of some type, as a file holds it."""
    letter = rng.choice("bBhHiIqQeffdd")
    if letter in "efd":
        value = rng.choice(NUMBERS)
        try:
            return struct.pack("<" + letter, value)
        except OverflowError:
            return struct.pack("<" + letter, float("inf"))
    return struct.pack("<q" if letter.islower() else "<Q", rng.choice(INTEGERS) % (2**63))[: struct.calcsize(letter)]


def _span(rng: Rng, size: int, most: int = 400) -> tuple[int, int]:
    start = rng.randrange(size + 1)
    return start, min(size, start + rng.randint(1, most))


def damage_bytes(data: bytes, rng: Rng, other: bytes = b"") -> bytes:
    """One change that knows no format."""
    out = bytearray(data)
    size = len(out)
    what = rng.randrange(10)
    if what == 0 and size:
        out[rng.randrange(size)] ^= 1 << rng.randrange(8)
    elif what == 1 and size:
        for _ in range(rng.randint(1, 8)):
            out[rng.randrange(size)] = rng.randrange(256)
    elif what == 2 and size:
        at, new = rng.randrange(size), _packed(rng)
        out[at : at + len(new)] = new
    elif what == 3:
        start, end = _span(rng, size)
        del out[start:end]
    elif what == 4:
        start, end = _span(rng, size)
        out[end:end] = out[start:end] * rng.choice((1, 1, 2, 20))
    elif what == 5:
        out = out[: rng.randrange(size + 1)] if rng.random() < 0.5 else out[: max(0, size - rng.randrange(64))]
    elif what == 6:
        at = rng.randrange(size + 1)
        out[at:at] = rng.choice((bytes(rng.randrange(1, 100)), b"\xff" * rng.randrange(1, 100), rng.randbytes(rng.randrange(1, 300))))
    elif what == 7 and other:
        start, end = _span(rng, len(other), 2000)
        at = rng.randrange(size + 1)
        out[at:at] = other[start:end]
    elif what == 8:
        (a, b), at = _span(rng, size), rng.randrange(size + 1)
        piece = out[a:b]
        del out[a:b]
        out[at:at] = piece
    else:
        start, end = _span(rng, size)
        out[start:end] = rng.choice((b"\0", b"\xff", b"\xa3\x95", b" ", b"0")) * (end - start)
    return bytes(out)


def damage_pieces(pieces: list[bytes], rng: Rng) -> list[bytes]:
    """Messages or lines lost, repeated, swapped, turned round."""
    out = list(pieces)
    what = rng.randrange(5)
    start, end = _span(rng, len(out), rng.choice((1, 1, 5, 100)))
    if what == 0:
        del out[start:end]
    elif what == 1:
        out[end:end] = out[start:end]
    elif what == 2 and out:
        i, k = rng.randrange(len(out)), rng.randrange(len(out))
        out[i], out[k] = out[k], out[i]
    elif what == 3:
        out[start:end] = out[start:end][::-1]
    elif out:
        out.insert(rng.randrange(len(out) + 1), out[rng.randrange(len(out))])
    return out


def _ulog_messages(data: bytes) -> tuple[bytes, list[bytes]]:
    head, at, found = data[:16], 16, []
    while at + 3 <= len(data):
        end = at + 3 + int.from_bytes(data[at : at + 2], "little")
        found.append(data[at:end])
        at = end
    return head, found


ULOG_TYPES = (
    b"int8_t",
    b"uint8_t",
    b"int16_t",
    b"uint16_t",
    b"int32_t",
    b"uint32_t",
    b"int64_t",
    b"uint64_t",
    b"float",
    b"double",
    b"bool",
    b"char",
)


def damage_ulog(data: bytes, rng: Rng) -> bytes:
    """One change to a message of a ULog: its kind, length, definition or values."""
    head, messages = _ulog_messages(data)
    if not messages:
        return damage_bytes(data, rng)
    what = rng.randrange(6)
    if what == 0:
        return head + b"".join(damage_pieces(messages, rng))
    definitions = [i for i, m in enumerate(messages) if m[2:3] in (b"F", b"A", b"P", b"I")]
    i = rng.choice(definitions) if definitions and what in (1, 2) else rng.randrange(len(messages))
    message = messages[i]
    length, kind, body = message[:2], message[2:3], message[3:]
    keep_length = False
    if what == 1:
        new = [*ULOG_TYPES, b"esc_report", b"nothing"]
        body = re.sub(rb"u?int\d+_t|float|double|bool|char", lambda m: rng.choice(new) if rng.random() < 0.3 else m[0], body)
    elif what == 2:
        places = [m.span() for m in re.finditer(rb"[a-z_0-9]+", body)]
        if places:
            a, b = rng.choice(places)
            body = body[:a] + rng.choice((b"", b"timestamp", b"timestamp_sample", b"x", b"99999999", b"[3]", b";;", b"\xff")) + body[b:]
    elif what == 3:
        kind = rng.choice((b"A", b"D", b"F", b"I", b"M", b"P", b"Q", b"L", b"C", b"S", b"O", b"R", b"B", b"\0", b"z"))
    elif what == 4:
        length, keep_length = struct.pack("<H", rng.choice((0, 1, 2, 3, 255, 65535, rng.randrange(65536)))), True
    else:
        at, new_value = rng.randrange(len(body) + 1), _packed(rng)
        body = body[:at] + new_value + body[at + len(new_value) :]
    messages[i] = (length if keep_length else struct.pack("<H", len(body) % 65536)) + kind + body
    return head + b"".join(messages)


def damage_dataflash(data: bytes, rng: Rng) -> bytes:
    """One change to a format definition or to the values of a message."""
    lengths = {data[m.start() + 3]: data[m.start() + 4] for m in re.finditer(rb"\xa3\x95\x80", data) if m.start() + 5 <= len(data)}
    at, messages = 0, []
    while at + 3 <= len(data) and data[at : at + 2] == b"\xa3\x95" and (length := lengths.get(data[at + 2], 0)) > 3:
        messages.append(data[at : at + length])
        at += length
    if not messages:
        return damage_bytes(data, rng)
    rest, what = data[at:], rng.randrange(5)
    if what == 0:
        return b"".join(damage_pieces(messages, rng)) + rest
    formats = [i for i, m in enumerate(messages) if m[2] == 0x80 and len(m) == 89]
    if what in (1, 2, 3) and formats:
        i = rng.choice(formats)
        m = bytearray(messages[i])
        if what == 1:  # type, length
            m[3 + rng.randrange(2)] = rng.choice((0, 1, 2, 3, 4, 0x80, 255, rng.randrange(256)))
        elif what == 2:  # letters
            m[9 + rng.randrange(16)] = rng.choice(b"abBgGhHiIfdnNZcCeELMqQ\0?x")
        else:  # name or columns
            a, b = (5, 9) if rng.random() < 0.3 else (25, 89)
            names = bytes(m[a:b]).split(b",")
            names[rng.randrange(len(names))] = rng.choice((b"", b"TimeUS", b"I", b"AccX", b"\xff\xfe", b"IMU", b"A" * 70))
            m[a:b] = b",".join(names)[: b - a].ljust(b - a, b"\0")
        messages[i] = bytes(m)
    else:
        i = rng.randrange(len(messages))
        m, k, new = messages[i], 3 + rng.randrange(max(1, len(messages[i]) - 3)), _packed(rng)
        messages[i] = (m[:k] + new + m[k + len(new) :])[: len(m)]
    return b"".join(messages) + rest


def damage_text(data: bytes, rng: Rng, mark: bytes = b",") -> bytes:
    """One change to the lines or cells of a text file."""
    end = rng.choice((b"\n", b"\n", b"\n", b"\r\n", b"\r"))
    lines = data.split(b"\n")
    what = rng.randrange(8)
    if what == 0:
        lines = damage_pieces(lines, rng)
    elif what <= 5:
        words = CELLS if rng.random() < 0.6 else WORDS
        for _ in range(rng.choice((1, 1, 3, 50))):
            i = 0 if what == 1 else rng.randrange(len(lines))
            cells = lines[i].split(mark)
            k = rng.randrange(len(cells))
            if what <= 3:
                cells[k] = rng.choice(words)
            elif what == 4:
                cells.insert(k, rng.choice(words) if rng.random() < 0.5 else cells[rng.randrange(len(cells))])
            else:
                del cells[k]
            lines[i] = mark.join(cells)
    elif what == 6:  # one column of every line
        k, word = rng.randrange(1, 8), rng.choice(CELLS)
        rows = [line.split(mark) for line in lines]
        lines = [mark.join([*r[:k], word, *r[k + 1 :]]) if len(r) > k and i else mark.join(r) for i, r in enumerate(rows)]
    else:
        return rng.choice((b"\xef\xbb\xbf", b"\xff\xfe", b"#", b"\n\n", b" ", b"")) + end.join(lines)
    return end.join(lines)


TOML_VALUES = (
    b"1", b"-1", b"1.5", b"nan", b"inf", b"true", b'"x"', b"[]", b"[1, 2]", b'["a"]', b"{}", b"{a = 1}", b"2024-05-01", b"12:00:00",
    b"1e400", b"9" * 40, b'["imu", "imu"]', b'["../imu"]', b'["imu"]', b"[nan, nan, nan, nan]", b"[0, 0, 0, 0]", b'"ENU/FLU"', b'"mean"',
    b"'''", b"1e308",
)  # fmt: skip
TOML_KEYS = (
    b"name", b"source", b"start_utc", b"time_offset", b"frame", b"imu_kind", b"streams", b"notes", b"lat", b"alt", b"gnss", b"imu", b"gyro",
    b"fault", b"text", b"discarded", b"home", b"delays", b"mounting", b"noise", b"field", b"dip", b"strength", b"declination", b"",
)  # fmt: skip


def damage_toml(data: bytes, rng: Rng) -> bytes:
    """One change to a line of flight.toml."""
    lines = data.split(b"\n")
    i = rng.randrange(len(lines))
    key, equals, value = lines[i].partition(b" = ")
    what = rng.randrange(5)
    if what == 0:
        return b"\n".join(damage_pieces(lines, rng))
    if what == 1:
        lines[i] = key + b" = " + rng.choice(TOML_VALUES)
    elif what == 2:
        lines[i] = rng.choice(TOML_KEYS) + (equals or b" = ") + (value or rng.choice(TOML_VALUES))
    elif what == 3:
        lines.insert(i, rng.choice(TOML_KEYS) + b" = " + rng.choice(TOML_VALUES))
    else:
        lines.insert(i, rng.choice((b"[%s]", b"[[%s]]", b"[imu.%s]")) % rng.choice(TOML_KEYS))
    return b"\n".join(lines)


def damage_parquet(data: bytes, rng: Rng) -> bytes:
    """One change to a table's columns: another type, name or order, or values at the edge."""
    import polars as pl

    try:
        table = pl.read_parquet(io.BytesIO(data))
    except (Exception, pl.exceptions.PanicException):  # damaged before
        return damage_bytes(data, rng)
    if not table.width:
        return damage_bytes(data, rng)
    name = rng.choice(table.columns)
    col, what = pl.col(name), rng.randrange(8)
    if what == 0:
        kind: Any = rng.choice(
            (pl.String, pl.Int8, pl.UInt64, pl.Float32, pl.Boolean, pl.Date, pl.Datetime("ns"), pl.Duration("us"), pl.Binary, pl.Time,
             pl.Categorical, pl.Decimal(18, 3), pl.Int128)
        )  # fmt: skip
        try:
            table = table.with_columns(col.cast(kind, strict=False))
        except Exception:  # no such cast
            table = table.with_columns(pl.lit(None, dtype=kind).alias(name))
    elif what == 1:
        table = table.with_columns(
            rng.choice((pl.concat_list(name, name), pl.struct(name), pl.lit(None), pl.lit("x"), pl.lit(b"x"))).alias(name)
        )
    elif what == 2:
        new = rng.choice(("t", "", " t ", "gyro_x", "imu.t", "x" * 300, "é", "time [ms]", "\n"))
        table = table.rename({name: new}) if new not in table.columns else table.drop(name)
    elif what == 3:
        table = table.drop(name)
    elif what == 4:
        table = rng.choice(
            (table.clear(), table.head(1), table.reverse(), table.sample(fraction=1.0, shuffle=True, seed=1), pl.concat([table] * 3))
        )
    else:
        value = rng.choice(NUMBERS)
        rows = pl.int_range(pl.len()) % rng.choice((1, 2, 7, 50)) == 0
        numbers = col if table[name].dtype.is_numeric() else pl.lit(None, dtype=pl.Float64)
        table = table.with_columns(pl.when(rows).then(value).otherwise(numbers).alias(name))
    out = io.BytesIO()
    table.write_parquet(out)
    return out.getvalue()


def _damage_file(name: str, data: bytes, kind: str, rng: Rng, other: bytes) -> bytes:
    suffix = Path(name).suffix
    if rng.random() < (0.08 if suffix in (".csv", ".log", ".toml") else 0.3):
        return damage_bytes(data, rng, other)
    if kind == "ulog":
        return damage_ulog(data, rng)
    if kind == "dataflash":
        return damage_dataflash(data, rng)
    if suffix == ".toml":
        return damage_toml(data, rng)
    if suffix == ".parquet":
        return damage_parquet(data, rng)
    if suffix in (".csv", ".log"):
        return damage_text(data, rng)
    return damage_bytes(data, rng, other)


def damaged(kind: str, rng: Rng, recordings: bool = True) -> Files:
    """A good log of a kind with one to six changes."""
    seeds = made(kind)
    if recordings and real(kind) and (rng.random() < 0.2 or not seeds):
        seeds = real(kind)
    files = dict(rng.choice(seeds))
    other = rng.choice(list(rng.choice(seeds).values()))
    for _ in range(rng.choice((1, 1, 2, 3, 6))):
        if not files:
            break
        name = rng.choice(list(files))
        what = rng.random()
        if len(files) > 1 and what < 0.05:
            del files[name]
        elif len(files) > 1 and what < 0.1:
            files[rng.choice(("imu.csv", "imu.parquet", "..csv", "x.csv", "aids.csv", "gnss.1.csv", "imu%2E1.csv"))] = files[name]
        else:
            files[name] = _damage_file(name, files[name], kind, rng, other)
    return files


# Judging


@dataclass
class Verdict:
    """What became of a case.

    ``fate`` is ``read``, ``refused`` (a message of ours), ``library`` (refused because a format's own library fell over it) or
    ``finding``. ``what`` is the message without what differs from case to case, ``detail`` the whole of it.
    """

    fate: str
    what: str
    detail: str = ""
    deeds: tuple[str, ...] = ()


def lay(files: Mapping[str, bytes], folder: Path) -> Path:
    """Write a case below a folder, and return the path to read."""
    place = folder / "flight" if len(files) != 1 or "flight.toml" in files else folder
    place.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (place / name).write_bytes(data)
    return place / next(iter(files)) if place == folder else place


def _plain(text: str) -> str:
    """A message without paths and numbers."""
    text = re.sub(r"(/[^\s:;,]+)+", "PATH", text)
    text = re.sub(r"'[^']*'|\"[^\"]*\"", "'...'", text)
    return re.sub(r"[-+]?\d[\d.,e+-]*", "N", text)[:200]


def _origin(error: BaseException) -> tuple[bool, str]:
    """Whether an error was raised by our own code (or by NumPy, polars or Python called from there), and where in it."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "/haltere/" in f.filename]
    foreign = [f for f in frames if any(f"/{lib}/" in f.filename for lib in ("pyulog", "rosbags", "orangebox"))]
    last = ours[-1] if ours else frames[-1]
    return not foreign, f"{Path(last.filename).name}:{last.lineno} {type(error).__name__}"


def judge(path: Path, deed: int = 0, *, draw: bool = True) -> Verdict:
    """Read a case, and do with a flight what users do: check, tell, write, navigate, draw. ``deed`` picks what besides the first two."""
    try:
        flight = read(path)
    except HaltereError as error:
        cause = error.__cause__
        if "damaged content (" not in str(error) or cause is None:
            return Verdict("refused", _plain(str(error)), str(error))
        own, place = _origin(cause)
        return Verdict("finding" if own else "library", f"unforeseen: {place}", "".join(traceback.format_exception(cause)))
    except Exception as error:
        return Verdict("finding", f"read: {_origin(error)[1]}", traceback.format_exc())
    deeds = ["read"]
    try:
        _tell(flight)
        deeds.append("told")
        if deed % WRITE_EVERY == 0:
            _write_and_read(flight, path.parent / "again", csv=bool(deed % (2 * WRITE_EVERY)))
            deeds.append("written")
        try:
            _checked(flight)
            deeds.append("checked")
            if deed % RUN_EVERY == 0:
                _navigate(flight, "ahrs" if deed % (2 * RUN_EVERY) else "navigator", draw=draw and deed % DRAW_EVERY == 0)
                deeds.append("run")
        except HaltereError as error:
            return Verdict("read", "then " + _plain(str(error)), str(error), tuple(deeds))
    except Exception as error:
        return Verdict("finding", f"after {deeds[-1]}: {_origin(error)[1]}: {_plain(str(error))}", traceback.format_exc(), tuple(deeds))
    return Verdict("read", "", "", tuple(deeds))


def _tell(flight: FlightLog) -> None:
    from haltere.cli.info import summary

    json.dumps(summary(flight), allow_nan=False)


def _write_and_read(flight: FlightLog, folder: Path, csv: bool) -> None:
    """A flight folder gives back what was written."""
    again = read(write_folder(flight, folder, csv=csv))
    assert list(again) == list(flight), f"streams {list(flight)} came back as {list(again)}"
    for name in flight:
        assert again[name] == flight[name], f"stream {name} came back changed"
    assert again.notes == flight.notes
    assert again.discarded == flight.discarded


def _checked(flight: FlightLog) -> None:
    """The door lets only usable times and IMU samples pass."""
    checked = check(flight)
    for name, stream in checked.streams.items():
        assert np.isfinite(stream.t).all(), f"{name}: time not finite"
        assert (np.diff(stream.t) > 0.0).all(), f"{name}: times not increasing"
    imu = checked.streams["imu"]
    assert np.isfinite(np.column_stack([imu.vector("gyro"), imu.vector("accel")])).all(), "imu not finite"


def _navigate(flight: FlightLog, estimator: str, draw: bool) -> None:
    from haltere.drive import run

    solution = run(flight, estimator)
    for name, column in solution.table.items():
        assert np.isfinite(column).all(), f"solution column {name}: {int((~np.isfinite(column)).sum())} of {len(column)} not finite"
    json.dumps(solution.summary, allow_nan=False)
    json.dumps(solution.events, allow_nan=False)
    if draw:
        from haltere.report import page

        page(solution, flight)


# The long run


def _random(kind: str, number: int) -> Rng:
    return random.Random(f"{kind} {number}")


def work(folder: Path, kinds: Iterable[str], draw: bool) -> None:
    """Judge the cases named on standard input, one JSON answer a line, under limits."""
    answers = os.dup(1)
    said = os.open(folder / "said", os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_TRUNC)
    os.dup2(said, 1)
    os.dup2(said, 2)
    warnings.simplefilter("always")
    warnings.showwarning = _warned
    faulthandler.enable(2)
    signal.signal(signal.SIGVTALRM, signal.SIG_DFL)
    faulthandler.register(signal.SIGVTALRM, 2, chain=True)  # tells where it was, then dies
    _warm(folder, kinds, draw)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.ftruncate(said, 0)
    os.write(answers, b'{"ready": true}\n')
    for line in sys.stdin:
        kind, number = json.loads(line)
        place = folder / "case"
        shutil.rmtree(place, ignore_errors=True)
        rng = _random(kind, number)
        path = lay(damaged(kind, rng), place)
        os.ftruncate(said, 0)  # of making the case
        signal.setitimer(signal.ITIMER_VIRTUAL, CPU_SECONDS)
        verdict = judge(path, rng.randrange(DRAW_EVERY * 4), draw=draw)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        sys.stdout.flush()
        sys.stderr.flush()
        if words := os.pread(said, 4000, 0).decode("utf-8", "replace"):
            os.ftruncate(said, 0)
            # What polars prints of its own panic over a damaged page cannot be kept from the terminal; the error after it is ours.
            if verdict.fate != "finding" and not ("panicked at" in words and verdict.fate == "refused"):
                verdict = Verdict("finding", f"said on the terminal: {words.splitlines()[0][:150]}", words, verdict.deeds)
        os.write(answers, json.dumps(asdict(verdict)).encode() + b"\n")


def _warned(message: Warning | str, category: type[Warning], *_: object) -> None:
    ours = [f for f in traceback.extract_stack() if "/haltere/" in f.filename]
    place = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "?"
    print(f"{place} {category.__name__}: {message}", file=sys.stderr)


def _warm(folder: Path, kinds: Iterable[str], draw: bool) -> None:
    """Do everything once, so that what is loaded and compiled counts in no case."""
    for kind in kinds:
        for i, files in enumerate(made(kind)):
            path = lay(files, folder / "warm" / f"{kind}{i}")
            for deed in (0, RUN_EVERY):  # one estimator each
                verdict = judge(path, deed, draw=draw)
                if verdict.fate != "read" or "run" not in verdict.deeds:
                    raise SystemExit(f"the good log {kind} {i} was not read and navigated: {verdict}")
        real(kind)


class Worker:
    """A worker process, and what it is doing."""

    def __init__(self, folder: Path, options: list[str]) -> None:
        self.folder, self.options = folder, options
        self.case: tuple[str, int] | None = None
        self.start()

    def start(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--work", str(self.folder), *self.options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        self.case, self.since = None, time.monotonic()

    def give(self, kind: str, number: int) -> None:
        assert self.process.stdin is not None
        self.case, self.since = (kind, number), time.monotonic()
        self.process.stdin.write(json.dumps([kind, number]) + "\n")

    def stop(self) -> int:
        self.process.kill()
        return self.process.wait()

    def said(self) -> str:
        file = self.folder / "said"
        return file.read_text("utf-8", "replace")[-4000:] if file.exists() else ""


def fuzz(minutes: float, seed: int, jobs: int, kinds: list[str], out: Path, options: list[str]) -> int:
    """Run for a time; returns the number of distinct findings."""
    fates: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    deeds: Counter[str] = Counter()
    messages: Counter[str] = Counter()
    findings: dict[str, list[str]] = {}
    number = seed * 1_000_000
    end = float("inf")  # the time runs from when the first worker is ready
    with tempfile.TemporaryDirectory(prefix="haltere-fuzz-") as scratch:
        workers = [Worker(Path(scratch) / str(i), options) for i in range(jobs)]

        def take(worker: Worker, verdict: Verdict) -> None:
            assert worker.case is not None
            kind, n = worker.case
            fates[kind][verdict.fate] += 1
            deeds.update(verdict.deeds)
            if verdict.fate == "finding":
                cases = findings.setdefault(f"{kind}: {verdict.what}", [])
                cases.append(f"{kind} {n}")
                if len(cases) == 1:
                    print(f"FOUND {kind} {n}: {verdict.what}", flush=True)
                    kept = out / f"{kind}-{n}"
                    shutil.copytree(worker.folder / "case", kept, dirs_exist_ok=True)
                    (kept / "what.txt").write_text(f"{verdict.what}\n\n{verdict.detail}\n", encoding="utf-8")
            elif verdict.what:
                messages[f"{verdict.fate}: {verdict.what}"] += 1

        while any(w.case is not None or time.monotonic() < end for w in workers):
            ready, _, _ = select.select([w.process.stdout for w in workers], [], [], 1.0)
            for worker in workers:
                if worker.process.stdout in ready:
                    assert worker.process.stdout is not None
                    line = worker.process.stdout.readline()
                    if not line:
                        status = worker.process.wait()
                        if worker.case is None:
                            raise SystemExit(f"a worker cannot start: {worker.said()}")
                        if status > 0:
                            raise SystemExit(f"the fuzzer failed at {worker.case}: {worker.said()}")
                        name = "took too long" if status == -signal.SIGVTALRM else f"the interpreter died ({signal.Signals(-status).name})"
                        said = worker.said()
                        last = re.findall(r'File "[^"]*/haltere/([^"]+)", line (\d+)', said)
                        take(worker, Verdict("finding", f"{name} at {':'.join(last[0]) if last else '?'}", said))
                        worker.start()
                        continue
                    answer = json.loads(line)
                    if "ready" in answer:
                        end = min(end, time.monotonic() + 60.0 * minutes)
                    else:
                        take(worker, Verdict(**answer))
                    worker.case = None
                    if time.monotonic() < end:
                        number += 1
                        worker.give(kinds[number % len(kinds)], number)
                elif worker.case is not None and time.monotonic() - worker.since > WALL_SECONDS:
                    worker.stop()
                    take(worker, Verdict("finding", "stuck without using the processor", worker.said()))
                    worker.start()
            if time.monotonic() > end:
                for worker in workers:
                    if worker.case is None:
                        worker.stop()
                workers = [w for w in workers if w.case is not None]
        for worker in workers:
            worker.stop()
    print(f"{'kind':16} {'cases':>8} {'read':>8} {'refused':>8} {'library':>8} {'findings':>8}")
    for kind, count in fates.items():
        print(f"{kind:16} {count.total():8} {count['read']:8} {count['refused']:8} {count['library']:8} {count['finding']:8}")
    total = sum(fates.values(), Counter[str]())
    print(f"{'all':16} {total.total():8} {total['read']:8} {total['refused']:8} {total['library']:8} {total['finding']:8}")
    print("done with flights that were read: " + ", ".join(f"{k} {n}" for k, n in deeds.items()))
    print(f"{len(messages)} distinct messages; the most frequent:")
    for text, n in messages.most_common(25):
        print(f"{n:8} {text}")
    for what, cases in findings.items():
        print(f"FINDING x{len(cases)} ({', '.join(cases[:3])}): {what}")
    return len(findings)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Damage logs of every format and see that reading them ends well.")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0, help="cases are numbered from a million times this")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=list(MADE), default=[k for k in MADE if made(k) or real(k)], metavar="KIND")
    parser.add_argument("--out", type=Path, default=Path("build/fuzz"), help="where cases that found something are kept")
    parser.add_argument("--case", nargs=2, metavar=("KIND", "NUMBER"))
    parser.add_argument("--keep", type=Path, help="with --case: leave its files in this folder")
    parser.add_argument("--no-draw", dest="draw", action="store_false", help="leave the report out")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.work:
        work(args.work, args.only, args.draw)
        return 0
    if args.case:
        kind, number = args.case[0], int(args.case[1])
        rng = _random(kind, number)
        with tempfile.TemporaryDirectory() as name:
            path = lay(damaged(kind, rng), args.keep or Path(name))
            verdict = judge(path, rng.randrange(DRAW_EVERY * 4), draw=args.draw)
        print(verdict.fate, verdict.deeds, verdict.what, verdict.detail, sep="\n")
        return int(verdict.fate == "finding")
    options = ["--only", *args.only, *([] if args.draw else ["--no-draw"])]
    return int(fuzz(args.minutes, args.seed, args.jobs, args.only, args.out, options) > 0)


if __name__ == "__main__":
    sys.exit(main())
