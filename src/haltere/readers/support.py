"""What a log holds, what the estimators can and cannot do with it, and which logging setting would help. It reads and prints nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from haltere.errors import HaltereError
from haltere.flight.door import RATE_MIN, RATE_POOR, check
from haltere.flight.log import FlightLog, Stream
from haltere.flight.schema import base_name, column
from haltere.readers._settings import settings_of

__all__ = ["ESTIMATORS", "StreamSummary", "Support", "doubts", "streams", "support"]

#: A hole is an interval longer than this many typical ones and this many seconds.
GAP_FACTOR, GAP_SECONDS = 5.0, 0.1
#: Holes in the IMU from which on [s] a solution is no longer continuous.
COAST = 1.0
#: Streams whose rows are events: they have no rate and no holes.
EVENTS = ("modes",)
#: Below this rate [Hz] rotor speeds show a failing motor too late.
ROTOR_RATE = 50.0
#: So many turning rotors make a multirotor, whose drag tells of the wind.
ROTORS = 3


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


@np.errstate(all="ignore")  # times near the end of the range
def _summary(name: str, stream: Stream) -> StreamSummary:
    units = {c: known.unit if (known := column(name, c)) is not None else "" for c in stream.names}
    # Rows of a solution come from several topics; its rate is that of its attitude.
    rows = np.isfinite(stream.t) & (np.isfinite(stream["q_w"]) if "q_w" in stream else True)
    t = stream.t[rows]
    nan = float("nan")
    if not len(t):
        return StreamSummary(name, len(stream), nan, nan, nan, nan, 0, nan, nan, units)
    if base_name(name) in EVENTS:
        return StreamSummary(name, len(stream), nan, nan, float(t.min()), float(t.max()), 0, nan, nan, units)
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
    """What each estimator can and cannot do with a flight.

    Parameters
    ----------
    flight
        The flight as read.

    Returns
    -------
    list of Support
        One an estimator, in the order of `ESTIMATORS`. ``no``: it would refuse; ``limited``: it runs, with less than it could give.
    """
    return [_judge(flight, estimator) for estimator in ESTIMATORS]


def doubts(flight: FlightLog) -> list[str]:
    """What the door would say of a flight besides its reader's own notes: units and axes that look wrong, clocks, stuck values."""
    imu = flight.get("imu")
    if imu is None or not len(imu):
        return []
    try:
        checked = check(flight)
    except HaltereError as error:
        return [str(error)]
    return [warning for warning in checked.warnings if warning not in flight.notes]


class _Judgement:
    """What is found of one estimator and one flight, collected ability by ability."""

    def __init__(self, flight: FlightLog) -> None:
        self.flight = flight
        self.settings = settings_of(flight.meta.source)
        self.can: list[str] = []
        self.cannot: list[str] = []
        self.remedies: list[str] = []

    def lacks(self, text: str, setting: str) -> None:
        """Something that the estimator could do with a better log, and the setting for it."""
        self.cannot.append(text)
        self.advise(self.settings[setting])

    def advise(self, remedy: str) -> None:
        """A setting that would help."""
        if remedy not in self.remedies:
            self.remedies.append(remedy)

    def usable(self, name: str, *columns: str) -> bool:
        """Whether a stream has values in all of several columns."""
        stream = self.flight.get(name)
        return stream is not None and all(np.isfinite(stream.get(c)).any() for c in columns)

    @property
    def fixed(self) -> bool:
        """Whether there are three-dimensional fixes."""
        gnss = self.flight.get("gnss")
        good = gnss is not None and bool((np.nan_to_num(gnss.get("fix_type"), nan=3.0) >= 3.0).any())
        return good and self.usable("gnss", "lat", "lon")

    @property
    def compass(self) -> bool:
        """Whether there is a magnetic field."""
        return self.usable("magnetometer", "mag_x", "mag_y", "mag_z")


def _judge(flight: FlightLog, estimator: str) -> Support:
    out = _Judgement(flight)
    imu = flight.get("imu")
    verdict = ""
    if imu is None or not len(imu):
        out.lacks("nothing: there is no imu stream", "imu")
        verdict = "no"
    else:
        try:
            check(flight.without(*(name for name in flight if name != "imu")))
        except HaltereError as error:
            out.lacks(f"nothing: {error}", "imu")
            verdict = "no"
    if not verdict and imu is not None:
        _sampling(out, _summary("imu", imu))
        for ability in ESTIMATORS[estimator]:
            ability(out)
        verdict = "limited" if out.cannot else "yes"
    return Support(estimator, verdict, tuple(out.can), tuple(out.cannot), tuple(out.remedies))


# Abilities: each says what it finds of one thing that an estimator gives or needs


def _sampling(out: _Judgement, imu: StreamSummary) -> None:
    if imu.rate < RATE_POOR:
        out.lacks(
            f"turns and vibration faster than the IMU's {imu.rate:.3g} Hz "
            f"({RATE_POOR:.0f} Hz or more is good, {RATE_MIN:.0f} Hz the least)",
            "imu",
        )
    if imu.largest_gap > COAST:
        many = "s" if imu.gaps > 1 else ""
        out.lacks(
            f"one continuous solution: the imu has {imu.gaps} gap{many}, the longest {imu.largest_gap:.4g} s after "
            f"t = {imu.largest_gap_at:.1f} s; "
            f"{imu.rate:.3g} Hz in stretches is {imu.mean_rate:.3g} Hz on average: too slow on the whole",
            "gaps",
        )


def _level(out: _Judgement) -> None:
    out.can.append("roll and pitch")


def _attitude(out: _Judgement) -> None:
    out.can.append("attitude")


def _velocity_and_position(out: _Judgement) -> None:
    if not out.fixed:
        reason = "no 3-D fix in the gnss stream" if "gnss" in out.flight else "no gnss stream"
        out.lacks(f"horizontal velocity and position: {reason}", "gnss")
        return
    out.can.append("velocity and position")
    if not out.usable("gnss", "vel_n", "vel_e"):
        out.lacks("velocity measured by GNSS: only positions are there", "gnss velocity")
    elif not out.usable("gnss", "vel_d"):
        out.lacks("vertical velocity measured by GNSS", "gnss velocity")


def _height(out: _Judgement) -> None:
    if out.usable("barometer", "pressure") or out.usable("barometer", "altitude"):
        out.can.append("height from the barometer")
    else:
        missing = "barometric height: GNSS height alone is metres worse" if out.fixed else "height: neither barometer nor GNSS"
        out.lacks(missing, "barometer")


def _heading(out: _Judgement) -> None:
    if out.compass:
        out.can.append("heading from the magnetometer")
    else:
        out.lacks("heading: without a magnetometer it drifts", "magnetometer")


def _heading_or_course(out: _Judgement) -> None:
    if out.compass:
        out.can.append("heading from the magnetometer")
    elif out.fixed:
        out.lacks("heading before the vehicle accelerates: no magnetometer", "magnetometer")
    else:
        out.lacks("heading: neither magnetometer nor GNSS velocity", "magnetometer")


def _air(out: _Judgement) -> None:
    """Not what it cannot do without: the wind triangle is one of three observations."""
    if out.usable("airdata", "airspeed", "aoa", "sideslip"):
        out.can.append("velocity through the air from airspeed and vanes")
    else:
        out.advise("for the wind triangle: an airdata stream with airspeed, aoa and sideslip; or drag.mu, with which drag stands in for it")


def _rotors(out: _Judgement) -> None:
    """Not an ability that the estimator lacks: fault detection watches rotor speeds besides it."""
    rotors = out.flight.get("rotors")
    speeds = rotors is not None and any(c.startswith("speed_") for c in rotors.names)
    remedy = out.settings["rotors"]
    if rotors is not None and speeds and rotors.rate >= ROTOR_RATE:
        out.can.append("rotor speeds fast enough to watch the vehicle model")
    elif rotors is not None and speeds:
        out.advise(f"for fault detection by rotor speeds ({rotors.rate:.3g} Hz here, {ROTOR_RATE:.0f} Hz wanted): {remedy}")
    else:
        out.advise(f"for fault detection by rotor speeds: {remedy}")


def _wind(out: _Judgement) -> None:
    """What feels the air; most vehicles have nothing that does, which is no lack of the log."""
    if not out.fixed:
        return
    if out.usable("airdata", "airspeed"):
        vanes = out.usable("airdata", "aoa", "sideslip")
        out.can.append(f"wind from the airspeed{' and vanes' if vanes else ''}")
    elif (n := _turning(out.flight.get("rotors"))) >= ROTORS:
        out.can.append(f"wind from the drag of {n} rotors")


def _turning(rotors: Stream | None) -> int:
    """Rotors that ever turned, by their speeds, or where there are none by their commands."""
    for stem in ("speed_", "command_"):
        columns = [rotors[c] for c in rotors.names if c.startswith(stem)] if rotors is not None else []
        if columns:
            return sum(bool(np.any(np.nan_to_num(v) != 0.0)) for v in columns)
    return 0


#: What is looked at for each estimator, one line each; a new estimator is a line here.
ESTIMATORS: dict[str, tuple[Callable[[_Judgement], None], ...]] = {
    "navigator": (_attitude, _velocity_and_position, _height, _heading_or_course, _wind, _rotors),
    "ahrs": (_level, _heading),
    "two-stage": (_attitude, _velocity_and_position, _heading_or_course),
    "wind-attitude": (_attitude, _velocity_and_position, _heading_or_course, _wind, _air),
}
