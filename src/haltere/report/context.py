"""What every section of a report reads: the solution, the flight, and what was measured and refused. It draws nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from haltere.flight.local import local_from_geodetic
from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution
from haltere.metrics.attitude import euler
from haltere.report.series import Pool, breaks
from haltere.report.style import MODES

__all__ = ["COMPONENTS", "SENSORS", "Context", "Episode", "Mode", "covered", "sensor_label"]

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: What a reader calls a sensor of the aid records.
SENSORS = {
    "gnss": "GNSS",
    "magnetometer": "magnetometer",
    "accelerometer": "gravity",
    "barometer": "barometer",
    "airdata": "air data",
    "drag": "drag",
    "wind": "given wind",
    "attitude": "given attitude",
    "no_sideslip": "no sideslip, assumed",
    "zero_velocity": "zero velocity at rest",
    "zero_rate": "zero rate at rest",
    "fake_position": "assumed position",
    "fake_velocity": "assumed velocity",
}

#: Label, unit for reading, factor to it, and resolution of a component of the aid records.
COMPONENTS: dict[str, tuple[str, str, float, float]] = {
    **{f"vel_{w[0]}": (f"vel. {w}", "m/s", 1.0, 1e-3) for w in ("north", "east", "down")},
    **{f"pos_{w[0]}": (f"pos. {w}", "m", 1.0, 1e-3) for w in ("north", "east", "down")},
    "altitude": ("altitude", "m", 1.0, 1e-3),
    "heading": ("heading", "deg", 180.0 / math.pi, 1e-3),
    **{f"mag_{a}": (f"field {a}", "µT", 1.0, 1e-2) for a in "xyz"},
    **{f"rate_{a}": (f"rate {a}", "deg/s", 180.0 / math.pi, 1e-3) for a in "xyz"},
    "airspeed": ("airspeed", "m/s", 1.0, 1e-3),
    "aoa": ("angle of attack", "deg", 180.0 / math.pi, 1e-3),
    "sideslip": ("sideslip", "deg", 180.0 / math.pi, 1e-3),
    **{f"drag_{a}": (f"drag {a}", "m/s²", 1.0, 1e-4) for a in "xy"},
    **{f"wind_{w[0]}": (f"wind {w}", "m/s", 1.0, 1e-3) for w in ("north", "east", "down")},
    **{f"attitude_{a}": (f"attitude {a}", "deg", 180.0 / math.pi, 1e-3) for a in "xyz"},
    **{f"field_{a}": (f"unit field {a}", "1", 1.0, 1e-4) for a in ("east", "down", "north", *"xyz")},
    **{f"down_{a}": (f"gravity {a}", "1", 1.0, 1e-4) for a in "xyz"},
    **{f"air_{a}": (f"air velocity {a}", "m/s", 1.0, 1e-3) for a in "xyz"},
}


def sensor_label(sensor: str) -> str:
    """What a reader calls a sensor."""
    return SENSORS.get(sensor, sensor.replace("_", " "))


@dataclass(frozen=True)
class Episode:
    """A stretch in which measurements of a sensor were refused or de-weighted."""

    sensor: str
    what: str
    status: str
    start: float
    end: float
    n: int
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Mode:
    """A stretch of one flight mode; ``armed`` is None where the log does not say."""

    start: float
    end: float
    name: str
    armed: bool | None


@dataclass
class Context:
    """A solution and its flight, ready for drawing."""

    solution: Solution
    flight: FlightLog
    pool: Pool

    @cached_property
    def span(self) -> tuple[float, float]:
        """First and last time shown: of the IMU and the solution [s]."""
        times = [self.solution.t]
        if "imu" in self.flight:
            times.append(self.flight["imu"].t)
        finite = np.concatenate([t[np.isfinite(t)] for t in times])
        low, high = float(finite.min()), float(finite.max())
        return (low, high) if high > low else (low - 0.5, high + 0.5)

    @cached_property
    def references(self) -> list[tuple[str, Stream]]:
        """Streams to compare with; truth first."""
        return [(name, self.flight[name]) for name in ("truth", "onboard") if name in self.flight and len(self.flight[name])]

    @cached_property
    def angles(self) -> FloatArray:
        """Roll, pitch, yaw of the solution [deg], (n, 3)."""
        return np.degrees(euler(self.solution.vector("q", "wxyz")))

    @cached_property
    def smoothed_angles(self) -> FloatArray:
        """Roll, pitch, yaw [deg] of the smoothed rows (n, 3); none where the run was not smoothed."""
        s = self.solution.smoothed
        return np.degrees(euler(s.vector("q", "wxyz"))) if s is not None else np.empty((0, 3))

    @cached_property
    def tilt(self) -> FloatArray:
        """Angle between the body's and the true vertical [deg]."""
        x, y = self.solution["q_x"], self.solution["q_y"]
        return np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))

    @cached_property
    def event_times(self) -> list[float]:
        """Times of what happened apart from the first alignment, at most forty."""
        times = [
            e.get("t_onset") if e.get("t_onset") is not None else e.get("t_detected")
            for e in self.solution.events
            if e["kind"] != "aligned"
        ]
        return [float(t) for t in times if t is not None][:40]

    @cached_property
    def modes(self) -> list[Mode]:
        """Flight modes and arming over the time shown, as the log gives them; empty where it does not."""
        stream = self.flight.get("modes")
        if stream is None or len(stream) == 0:
            return []
        known = np.flatnonzero(np.isfinite(stream.t))
        rows = known[np.argsort(stream.t[known], kind="stable")]
        names = [str(m) for m in stream["mode"][rows]] if "mode" in stream else [""] * len(rows)
        armed = [None if math.isnan(a) else bool(a > 0.5) for a in stream.get("armed")[rows]]
        out: list[Mode] = []
        for t, end, name, state in zip(stream.t[rows], [*stream.t[rows][1:], math.inf], names, armed, strict=True):
            start, stop = max(float(t), self.span[0]), min(float(end), self.span[1])
            if stop <= start:
                continue
            if out and (out[-1].name, out[-1].armed) == (name, state) and out[-1].end == start:
                start = out.pop().start
            out.append(Mode(start, stop, name, state))
        return out

    @cached_property
    def mode_colours(self) -> dict[str, str]:
        """Colour of each flight mode, in the order in which they were flown; the last serves all that remain."""
        names = dict.fromkeys(m.name for m in self.modes if m.name)
        return {name: f"mode{min(k, MODES - 1)}" for k, name in enumerate(names)}

    @cached_property
    def origin(self) -> tuple[float, float, float] | None:
        """Latitude, longitude [deg] and altitude [m] of the origin."""
        given = self.solution.summary.get("origin")
        return (float(given[0]), float(given[1]), float(given[2])) if given else None

    @cached_property
    def held_by_measurement(self) -> bool:
        """Whether a position from GNSS was ever let in."""
        a = self.solution.aids
        return bool(np.any((a["sensor"] == "gnss") & (a["status"] != "rejected") & np.char.startswith(a["component"].astype(str), "pos")))

    @cached_property
    def sensors(self) -> list[str]:
        """Sensors of the aid records, in the order of `SENSORS`."""
        present = [str(s) for s in np.unique(self.solution.aids["sensor"])]
        return [s for s in SENSORS if s in present] + [s for s in present if s not in SENSORS]

    def offered(self, sensor: str, component: str) -> Mask:
        """Rows of the aid records of one component, without the sample that only set the start."""
        a = self.solution.aids
        mask: Mask = (a["sensor"] == sensor) & (a["component"] == component) & (a["reason"] != "start")
        return mask

    def measured(self, component: str) -> tuple[FloatArray, FloatArray]:
        """Times and values of a GNSS component (``vel_n`` ... ``pos_d``): as offered to the filter, else from the flight."""
        a = self.solution.aids
        rows = (a["sensor"] == "gnss") & (a["component"] == component)
        if rows.any():
            return a["t"][rows], a["observation"][rows]
        gnss = self.flight.get("gnss")
        if gnss is None or len(gnss) == 0:
            return np.empty(0), np.empty(0)
        if component.startswith("vel"):
            values = gnss.get(component)
        elif self.origin is None:
            return np.empty(0), np.empty(0)
        else:
            lat, lon, alt = gnss.get("lat"), gnss.get("lon"), gnss.get("alt")
            no_fix = (gnss.get("fix_type") < 3.0) | ((lat == 0.0) & (lon == 0.0))
            values = local_from_geodetic(lat, lon, alt, *self.origin)["ned".index(component[-1])]
            values = np.where(no_fix, np.nan, values)
        good = np.isfinite(values)
        return gnss.t[good], values[good]

    @cached_property
    def episodes(self) -> list[Episode]:
        """Stretches of refused or de-weighted measurements, in time order."""
        a = self.solution.aids
        out: list[Episode] = []
        stems = np.array([c.rpartition("_")[0] or c for c in a["component"].tolist()]) if len(a["t"]) else np.empty(0, str)
        for sensor in np.unique(a["sensor"]):
            for stem in np.unique(stems[a["sensor"] == sensor]):
                for status in ("rejected", "deweighted"):
                    rows = (a["sensor"] == sensor) & (stems == stem) & (a["status"] == status)
                    if rows.any():
                        reasons = a["reason"][rows]
                        every = a["t"][(a["sensor"] == sensor) & (stems == stem)]
                        out += _stretches(str(sensor), str(stem), status, a["t"][rows], reasons, every)
        return sorted(out, key=lambda e: e.start)


def _stretches(sensor: str, stem: str, status: str, t: FloatArray, reasons: NDArray[np.str_], every: FloatArray) -> list[Episode]:
    """Stretches of times closer than two seconds or five typical intervals of the sensor."""
    times = np.unique(every)
    apart = max(2.0, 5.0 * float(np.median(np.diff(times)))) if len(times) > 1 else 2.0
    group = np.cumsum(np.r_[False, np.diff(t) > apart])
    what = {"vel": "velocity", "pos": "position", "mag": "field", "rate": "rate"}.get(stem, stem)
    out = []
    for k in range(int(group[-1]) + 1):
        mine = group == k
        n = len(np.unique(t[mine]))
        out.append(
            Episode(sensor, what, status, float(t[mine][0]), float(t[mine][-1]), n, tuple(sorted(set(reasons[mine].tolist()) - {""})))
        )
    return out


def covered(t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Stretches in which a series has samples: starts and ends, as `haltere.report.series.breaks` cuts it."""
    t = np.sort(t[np.isfinite(t)])
    if len(t) == 0:
        return t, t
    cut = np.flatnonzero(breaks(t))
    return t[np.r_[0, cut]], t[np.r_[cut - 1, len(t) - 1]]
