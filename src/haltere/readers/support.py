"""What a log holds, what the estimators can and cannot do with it, and which logging setting would help. It reads and prints nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from haltere.errors import HaltereError
from haltere.flight.door import RATE_MIN, RATE_POOR, check
from haltere.flight.log import FlightLog, Stream
from haltere.flight.schema import column

__all__ = ["StreamSummary", "Support", "streams", "support"]

#: A hole is an interval longer than this many typical ones and this many seconds.
GAP_FACTOR, GAP_SECONDS = 5.0, 0.1
#: Holes in the IMU from which on [s] a solution is no longer continuous.
COAST = 1.0
#: Below this rate [Hz] rotor speeds show a failing motor too late.
ROTOR_RATE = 50.0

#: What to set on the vehicle, by autopilot and by what is missing.
REMEDIES: dict[str, dict[str, str]] = {
    "px4": {
        "imu": "PX4: log the default topics (SDLOG_PROFILE bit 0) for sensor_combined at full rate, and bit 4 (high rate) for more",
        "gaps": "PX4: a faster SD card, or fewer topics (SDLOG_PROFILE); the log's notes count the logger's dropouts",
        "gnss": "PX4: log the default topics (SDLOG_PROFILE bit 0), which has vehicle_gps_position, and arm with a 3-D fix",
        "magnetometer": "PX4: log the default topics (SDLOG_PROFILE bit 0), which has vehicle_magnetometer; check SYS_HAS_MAG",
        "barometer": "PX4: log the default topics (SDLOG_PROFILE bit 0), which has vehicle_air_data; check SYS_HAS_BARO",
        "rotors": "PX4: esc_status needs speed controllers with telemetry (bidirectional DShot, UAVCAN), and SDLOG_PROFILE bit 4 "
        "(high rate) or etc/logging/logger_topics.txt on the SD card; the default is 4 Hz",
        "still": "PX4: SDLOG_MODE 1 logs from boot, so that the vehicle is seen at rest before take-off",
    },
    "ardupilot": {
        "imu": "ArduPilot: set bit 18 of LOG_BITMASK (fast IMU), or bit 19 (raw IMU); LOG_BITMASK bit 7 alone gives 25 Hz",
        "gaps": "ArduPilot: a faster SD card or a larger LOG_FILE_BUFSIZE; separate flights: LOG_FILE_DSRMROT 1 starts a new log at each",
        "gnss": "ArduPilot: set bit 2 of LOG_BITMASK (GPS), and arm with a 3-D fix",
        "magnetometer": "ArduPilot: set bit 13 of LOG_BITMASK (compass)",
        "barometer": "ArduPilot: firmware from 3.2 on logs BARO by itself; CTUN (bit 4 of LOG_BITMASK) holds its altitude before",
        "rotors": "ArduPilot: ESC messages need telemetry: bidirectional DShot (SERVO_BLH_BDMASK) or CAN speed controllers",
        "still": "ArduPilot: LOG_DISARMED 1 logs from boot, so that the vehicle is seen at rest before take-off",
    },
    "": {
        "imu": "record gyro and accelerometer at 50 Hz or more, 200 Hz if you can",
        "gaps": "record without holes, or cut the log into its flights",
        "gnss": "record satellite position and velocity at 1 Hz or more",
        "magnetometer": "record the magnetometer at 5 Hz or more",
        "barometer": "record the barometer at 5 Hz or more",
        "rotors": "record rotor speeds at 50 Hz or more",
        "still": "begin to record some seconds before take-off",
    },
}


@dataclass(frozen=True)
class StreamSummary:
    """One stream in numbers.

    Attributes
    ----------
    n
        Samples.
    rate, mean_rate
        Hz, of the typical interval and of the whole span: far apart where there are holes.
    start, end
        First and last time [s].
    gaps, largest_gap, largest_gap_at
        Holes, the longest interval [s] and the time of the sample before it [s].
    columns
        Unit by column; empty for a column outside the schema.
    """

    name: str
    n: int
    rate: float
    mean_rate: float
    start: float
    end: float
    gaps: int
    largest_gap: float
    largest_gap_at: float
    columns: dict[str, str]

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return self.end - self.start


@dataclass(frozen=True)
class Support:
    """What one estimator can do with a log.

    Attributes
    ----------
    estimator
        Its name.
    verdict
        ``yes``, ``limited`` or ``no``.
    can, cannot
        One sentence each.
    remedies
        Logging settings that would fix what is missing.
    """

    estimator: str
    verdict: str
    can: tuple[str, ...]
    cannot: tuple[str, ...]
    remedies: tuple[str, ...]


def streams(flight: FlightLog) -> list[StreamSummary]:
    """Every stream of a flight in numbers."""
    return [_summary(name, stream) for name, stream in flight.streams.items()]


def _summary(name: str, stream: Stream) -> StreamSummary:
    units = {c: known.unit if (known := column(name, c)) is not None else "" for c in stream.names}
    # Rows of a solution come from several topics; its rate is that of its attitude.
    rows = np.isfinite(stream.t) & (np.isfinite(stream["q_w"]) if "q_w" in stream else True)
    t = stream.t[rows]
    nan = float("nan")
    if not len(t):
        return StreamSummary(name, len(stream), nan, nan, nan, nan, 0, nan, nan, units)
    steps = np.diff(t)
    span = float(t.max() - t.min())
    mean_rate = (len(t) - 1) / span if span > 0.0 else nan
    typical = float(np.median(steps)) if len(steps) else nan
    holes = int(np.count_nonzero(steps > max(GAP_FACTOR * typical, GAP_SECONDS))) if len(steps) else 0
    at = int(np.argmax(steps)) if len(steps) else 0
    largest = float(steps[at]) if len(steps) else nan
    rate = 1.0 / typical if typical > 0.0 else nan
    return StreamSummary(name, len(stream), rate, mean_rate, float(t.min()), float(t.max()), holes, largest, float(t[at]), units)


def support(flight: FlightLog) -> list[Support]:
    """What ``navigator`` and ``ahrs`` can and cannot do with a flight.

    Parameters
    ----------
    flight
        The flight as read.

    Returns
    -------
    list of Support
        One an estimator. ``no``: it would refuse; ``limited``: it runs, with less than it could give.
    """
    return [_judge(flight, "navigator"), _judge(flight, "ahrs")]


class _Judgement:
    def __init__(self, flight: FlightLog) -> None:
        source = flight.meta.source
        kind = "px4" if source.startswith("PX4") else "ardupilot" if source.startswith("ArduPilot") else ""
        self.known = REMEDIES[kind]
        self.can: list[str] = []
        self.cannot: list[str] = []
        self.remedies: list[str] = []

    def lacks(self, text: str, *keys: str) -> None:
        self.cannot.append(text)
        self.remedies += [self.known[k] for k in keys if self.known[k] not in self.remedies]

    def result(self, estimator: str, verdict: str) -> Support:
        return Support(estimator, verdict, tuple(self.can), tuple(self.cannot), tuple(self.remedies))


def _judge(flight: FlightLog, estimator: str) -> Support:
    out = _Judgement(flight)
    imu = flight.get("imu")
    if imu is None or not len(imu):
        out.lacks("nothing: there is no imu stream", "imu")
        return out.result(estimator, "no")
    try:
        check(flight.without(*(name for name in flight if name != "imu")))
    except HaltereError as error:
        out.lacks(f"nothing: {error}", "imu")
        return out.result(estimator, "no")
    numbers = _summary("imu", imu)
    _judge_imu(out, numbers)
    magnetometer = _usable(flight, "magnetometer", "mag_x", "mag_y", "mag_z")
    if estimator == "ahrs":
        out.can.append("roll and pitch")
        if magnetometer:
            out.can.append("heading from the magnetometer")
        else:
            out.lacks("heading: without a magnetometer it drifts", "magnetometer")
    else:
        _judge_navigator(out, flight, magnetometer)
    return out.result(estimator, "limited" if out.cannot else "yes")


def _judge_imu(out: _Judgement, numbers: StreamSummary) -> None:
    if numbers.rate < RATE_POOR:
        out.lacks(
            f"turns and vibration faster than the IMU's {numbers.rate:.3g} Hz "
            f"({RATE_POOR:.0f} Hz or more is good, {RATE_MIN:.0f} Hz the least)",
            "imu",
        )
    if numbers.largest_gap > COAST:
        many = "s" if numbers.gaps > 1 else ""
        out.lacks(
            f"one continuous solution: the imu has {numbers.gaps} gap{many}, the longest {numbers.largest_gap:.4g} s after "
            f"t = {numbers.largest_gap_at:.1f} s; "
            f"{numbers.rate:.3g} Hz in stretches is {numbers.mean_rate:.3g} Hz on average: too slow on the whole",
            "gaps",
        )


def _judge_navigator(out: _Judgement, flight: FlightLog, magnetometer: bool) -> None:
    gnss = flight.get("gnss")
    fixed = gnss is not None and bool((np.nan_to_num(gnss.get("fix_type"), nan=3.0) >= 3.0).any()) and _usable(flight, "gnss", "lat", "lon")
    barometer = _usable(flight, "barometer", "pressure") or _usable(flight, "barometer", "altitude")
    out.can.append("attitude")
    if fixed and gnss is not None:
        out.can.append("velocity and position")
        if not _usable(flight, "gnss", "vel_n", "vel_e"):
            out.lacks("velocity measured by GNSS: only positions are there", "gnss")
        elif not _usable(flight, "gnss", "vel_d"):
            out.lacks("vertical velocity measured by GNSS", "gnss")
    else:
        reason = "no 3-D fix in the gnss stream" if gnss is not None else "no gnss stream"
        out.lacks(f"horizontal velocity and position: {reason}", "gnss")
    if barometer:
        out.can.append("height from the barometer")
    else:
        out.lacks("barometric height: GNSS height alone is metres worse" if fixed else "height: neither barometer nor GNSS", "barometer")
    if magnetometer:
        out.can.append("heading from the magnetometer")
    elif fixed:
        out.lacks("heading before the vehicle accelerates: no magnetometer", "magnetometer")
    else:
        out.lacks("heading: neither magnetometer nor GNSS velocity", "magnetometer")
    rotors = flight.get("rotors")
    speeds = rotors is not None and any(c.startswith("speed_") for c in rotors.names)
    if rotors is not None and speeds and rotors.rate >= ROTOR_RATE:
        out.can.append("rotor speeds fast enough to watch the vehicle model")
    elif rotors is not None and speeds:
        wanted = f"{rotors.rate:.3g} Hz here, {ROTOR_RATE:.0f} Hz wanted"
        out.remedies.append(f"for fault detection by rotor speeds ({wanted}): {out.known['rotors']}")
    else:
        out.remedies.append(f"for fault detection by rotor speeds: {out.known['rotors']}")


def _usable(flight: FlightLog, name: str, *columns: str) -> bool:
    stream = flight.get(name)
    return stream is not None and all(np.isfinite(stream.get(c)).any() for c in columns)
