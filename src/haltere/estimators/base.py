"""The online estimator: step, offer, now, state, restore over the compiled step. It reads no log; `haltere.drive` does."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.aids.air_vector import ENOUGH
from haltere.aids.record import (
    AID_RECORD,
    AIRSPEED,
    ATTITUDE,
    BAROMETER,
    GNSS_POSITION,
    GNSS_VELOCITY,
    MAGNETOMETER,
    POWER,
    ROTORS,
    VANES,
    WIND,
)
from haltere.errors import UsageError
from haltere.estimators import quaternion_step
from haltere.estimators.air import vanes
from haltere.estimators.begin import InitialState, new_state, number
from haltere.estimators.inputs import altitude_of, parameters, rotation_vector
from haltere.estimators.registry import kernels_of
from haltere.estimators.rotors import model_of
from haltere.flight import config as configuration
from haltere.flight.config import Config
from haltere.flight.corrections import calibrated, calibration
from haltere.flight.door import impossible_place, impossible_pressure
from haltere.flight.names import nearest_column, nearest_stream
from haltere.flight.schema import column as schema_column

__all__ = ["Estimator", "InitialState", "State", "new_state"]

FloatArray = NDArray[np.float64]
_NO_ROWS = np.empty((0, 0))
_NAN = (math.nan, math.nan, math.nan)
_VALUES = {
    "gnss": ("lat", "lon", "alt", "vel_n", "vel_e", "vel_d"),
    "barometer": ("pressure",),
    "magnetometer": ("mag_x", "mag_y", "mag_z"),
    "power": ("current",),
    "airdata": ("airspeed", "aoa", "sideslip"),
    "wind": ("wind_n", "wind_e", "wind_d", "sd"),
    "attitude": ("q_w", "q_x", "q_y", "q_z"),
    "rotors": (),
}
_ACCURACIES = ("h_acc", "h_acc", "v_acc", "s_acc", "s_acc", "s_acc")


@dataclass(frozen=True)
class State:
    """All memory of an estimator at one moment: can be kept, pickled and given back to `Estimator.restore`."""

    record: NDArray[np.void]

    @property
    def t(self) -> float:
        """Time of the fusion horizon [s]."""
        return float(self.record["t"][0])

    @property
    def aligned(self) -> bool:
        """Whether initial alignment has been done."""
        return bool(self.record["phase"][0] == 2)

    def _vector(self, name: str) -> FloatArray:
        if self._federated:
            return np.array(self.record["ft"][0, 0][name], dtype=np.float64)
        return np.array(self.record[name][0], dtype=np.float64)

    @property
    def _federated(self) -> bool:
        """Whether the state that counts is that of a federated filter."""
        names = self.record.dtype.names or ()
        return "ft" in names and self.record["ft"].shape[1] > 0 and bool(self.record["ft"]["on"][0, 0] == 1)

    @property
    def q_nb(self) -> FloatArray:
        """Attitude quaternion, body to NED, scalar first, (4,)."""
        return self._vector("q")

    @property
    def vel_n(self) -> FloatArray:
        """Velocity NED [m/s], (3,)."""
        return self._vector("v")

    @property
    def pos_n(self) -> FloatArray:
        """Position NED from the origin [m], (3,)."""
        return self._vector("p")

    @property
    def gyro_bias_b(self) -> FloatArray:
        """Gyro bias [rad/s], (3,)."""
        return self._vector("bg")

    @property
    def accel_bias_b(self) -> FloatArray:
        """Accelerometer bias [m/s^2], (3,)."""
        return self._vector("ba")

    @property
    def P(self) -> FloatArray:
        """Covariance of the error state: attitude (body), velocity, position, gyro bias, accelerometer bias, optional blocks."""
        if self._federated:  # attitude, velocity, position, and the biases behind what only this filter has
            core = np.r_[3:12, 22:28]
            return np.array(self.record["ft"][0, 0]["P"][np.ix_(core, core)], dtype=np.float64)
        return self._vector("P")


class Estimator:
    """A filter that is fed sample by sample; the same compiled code as `haltere.run` over a log.

    Parameters
    ----------
    name
        ``navigator``, ``ahrs``, ``two-stage`` or ``wind-attitude``.
    config
        A complete `Config`, or a mapping of configuration keys to change. Home and field that are not given are taken from
        the first fix (origin) and from the first magnetometer samples (field); declination is then 0.
    initial
        State to begin from instead of aligning.
    vehicle
        Vehicle file with ``[lumped]``, whose rotors are then heard one by one.

    Raises
    ------
    UsageError
        A configuration of another estimator, or one with a magnetometer's load, which is not known online.

    Examples
    --------
    >>> est = Estimator("ahrs")
    >>> for k in range(1500):
    ...     state = est.step(0.001 * k, (0.0, 0.0, 0.0), (0.0, 0.0, -9.80665))
    """

    def __init__(
        self, name: str = "navigator", config: Config | Mapping[str, Any] | None = None, initial: InitialState | None = None,
        vehicle: str | Path | None = None,
    ) -> None:  # fmt: skip
        if isinstance(config, Config):
            if config.estimator != name:
                raise UsageError(f"a configuration of {name}", f"one of {config.estimator}", "Estimator")
            self.config = config
        else:
            self.config = configuration.resolve(name, "default", config or {}, "Estimator")
        if self.config["magnetometer.load"] != "off":
            raise UsageError(
                "magnetometer.load off", repr(self.config["magnetometer.load"]), "Estimator",
                "online the load is not known: take its field off before offering, and set magnetometer.load=off",
            )  # fmt: skip
        self._calibration = calibration(self.config.values)
        model = None if vehicle is None else model_of(vehicle, name)
        self._rotors = 0 if model is None else len(model.yaw)
        self._S = new_state(self.config, initial, model)
        self._kernels = kernels_of(self._S)
        self._stage = self._kernels.stage_of(self._S)
        self._prm = parameters(self.config)
        self._aids = as_records(np.empty(4096, AID_RECORD))
        self._now = np.zeros(11)
        self._view = State(self._S)
        self._refused: dict[str, dict[str, int]] = {}

    def step(self, t: float, gyro: Sequence[float], accel: Sequence[float]) -> State:
        """Take one IMU sample.

        Parameters
        ----------
        t
            Time stamp [s]; a sample not after the one before, or not finite, is left out and counted.
        gyro, accel
            Angular rate [rad/s] and specific force [m/s^2], body FRD, (3,).

        Returns
        -------
        State
            Live view of the state at the fusion horizon. Use ``state`` for a copy that stays.

        Raises
        ------
        UsageError
            Not three numbers each.
        """
        self._kernels.step(
            self._S, self._prm, number(t, "t", "Estimator.step"), _three(gyro, "gyro"), _three(accel, "accel"),
            _NO_ROWS, _NO_ROWS, self._aids, _NO_ROWS, self._stage,
        )  # fmt: skip
        return self._view

    def offer(self, sensor: str, t: float, values: Sequence[float] | Mapping[str, float], variances: Sequence[float] | None = None) -> bool:
        """Offer a measurement, whenever it arrives.

        Parameters
        ----------
        sensor
            ``gnss``, ``barometer``, ``magnetometer``, ``power``, ``rotors``, ``airdata``, ``wind`` or ``attitude``.
        t
            Time stamp [s]; it was valid at t minus the configured delay.
        values
            By column name as in the flight folder, or in order: gnss ``lat, lon, alt[, vel_n, vel_e, vel_d]`` (deg, m, m/s),
            barometer ``pressure`` [Pa], magnetometer ``mag_x, mag_y, mag_z`` [uT], to which a calibration (``magnetometer.*``) is applied,
            power ``current`` [A], rotors the speeds of all [rad/s], airdata ``airspeed[, aoa, sideslip]``, wind
            ``wind_n, wind_e[, wind_d, sd]`` [m/s, blowing to], attitude ``q_w, q_x, q_y, q_z``.
        variances
            Of the values in order, for gnss (lat, lon and alt in m^2); NaN, not positive or absent: as configured.

        Returns
        -------
        bool
            False when it was not taken: switched off, or refused and counted in `discarded`: not finite, impossible, or valid before
            the fusion horizon.

        Raises
        ------
        UsageError
            Unknown sensor or name of a value, the wrong number of values, or something that is no number.
        """
        if sensor not in _VALUES:
            near = nearest_stream(str(sensor), _VALUES)
            raise UsageError(
                f"a sensor: {', '.join(_VALUES)}",
                repr(sensor),
                "Estimator.offer",
                f"did you mean {near!r}?" if near else "",
            )
        t = number(t, "t", "Estimator.offer")
        if not math.isfinite(t):
            return self._refuse(sensor, "time not finite")
        if sensor == "gnss":
            return self._offer_gnss(t, values, variances)
        if variances is not None:
            raise UsageError(f"no variances for {sensor}", "some", "Estimator.offer", f"set noise.{sensor}")
        if sensor == "barometer":
            return self._offer_barometer(t, values)
        if sensor == "power":
            (current,) = _in_order(sensor, values, 1, ("voltage",))
            return (
                self._queue(POWER, t, (current, math.nan, math.nan), _NAN) if math.isfinite(current) else self._refuse(sensor, "not finite")
            )
        if sensor in ("rotors", "airdata", "wind", "attitude"):
            return self._offer_of_the_air(sensor, t, values)
        m = _in_order(sensor, values, 3)
        if not math.isfinite(m[0] + m[1] + m[2]):
            return self._refuse(sensor, "not finite")
        if m == (0.0, 0.0, 0.0):
            return self._refuse(sensor, "zero")
        if self._calibration is not None:
            x, y, z = calibrated(np.array([m[:3]]), self._calibration)[0].tolist()
            return self._queue(MAGNETOMETER, t, (x, y, z), _NAN)
        return self._queue(MAGNETOMETER, t, (m[0], m[1], m[2]), _NAN)

    def _offer_gnss(self, t: float, values: Sequence[float] | Mapping[str, float], variances: Sequence[float] | None) -> bool:
        v = _in_order("gnss", values, 3, _ACCURACIES)
        r: tuple[float, ...] = (math.nan,) * 6
        if variances is not None:
            r = tuple(number(x, "a variance", "Estimator.offer") for x in _flat(variances, "variances"))
            if len(r) > 6:
                raise UsageError("at most 6 variances for gnss", f"{len(r)}", "Estimator.offer")
            r = tuple(x if x > 0.0 else math.nan for x in r) + (math.nan,) * (6 - len(r))
        elif isinstance(values, Mapping):
            sd = [number(values.get(k, math.nan), k, "Estimator.offer") for k in _ACCURACIES]
            r = tuple(x * x if x > 0.0 else math.nan for x in sd)
        velocity, place = math.isfinite(v[3] + v[4]), math.isfinite(v[0] + v[1])
        if isinstance(values, Mapping) and number(values.get("fix_type", 3.0), "fix_type", "Estimator.offer") < 3.0:
            return self._refuse("gnss", "no 3-D fix")
        if v[0] == 0.0 and v[1] == 0.0:
            return self._refuse("gnss", "latitude and longitude zero")
        if r[0] > 50.0**2:
            return self._refuse("gnss", "accuracy worse than 50 m")
        if not (velocity or place):
            return self._refuse("gnss", "not finite")
        taken = velocity and self._queue(GNSS_VELOCITY, t, (v[3], v[4], v[5]), (r[3], r[4], r[5]))
        if place and impossible_place(v[0], v[1]):
            return self._refuse("gnss", "latitude or longitude impossible") or taken
        return (place and self._queue(GNSS_POSITION, t, (v[0], v[1], v[2]), (r[0], r[1], r[2]))) or taken

    def _offer_barometer(self, t: float, values: Sequence[float] | Mapping[str, float]) -> bool:
        if isinstance(values, Mapping) and "pressure" not in values and "altitude" in values:
            h = number(values["altitude"], "altitude", "Estimator.offer")
        else:
            (pressure,) = _in_order("barometer", values, 1, ("altitude", "temperature"))
            if impossible_pressure(pressure):
                return self._refuse("barometer", "pressure impossible in Pa")
            h = float(altitude_of(np.array([pressure]), self.config)[0])
        if not math.isfinite(h):
            return self._refuse("barometer", "not finite")
        return self._queue(BAROMETER, t, (h, math.nan, math.nan), _NAN)

    def _offer_of_the_air(self, sensor: str, t: float, values: Sequence[float] | Mapping[str, float]) -> bool:
        if sensor == "rotors":
            named = [v for k, v in values.items() if str(k).startswith("speed_")] if isinstance(values, Mapping) else None
            if named == []:
                raise UsageError("values of rotors by name (speed_0, speed_1, ...)", ", ".join(map(repr, values)), "Estimator.offer")
            speeds = named or _flat(values, "values of rotors")
            each = np.array([abs(number(x, "a rotor's speed", "Estimator.offer")) for x in speeds])
            total = float(each.sum())
            if not math.isfinite(total):
                return self._refuse(sensor, "not finite")
            taken = self._queue(ROTORS, t, (total, math.nan, math.nan), _NAN)
            if self._rotors and len(each) != self._rotors:
                raise UsageError(f"speeds of {self._rotors} rotors, as the vehicle's model has", f"{len(each)}", "Estimator.offer")
            return (self._rotors > 0 and self._kernels.offer_rotors(self._S, self._prm, t, each) == 1) or taken
        v = _in_order(sensor, values, {"airdata": 1, "wind": 2, "attitude": 4}[sensor])
        if sensor == "airdata" and self._kernels is quaternion_step:
            return self._offer_air_vector(t, v)
        if sensor == "airdata":
            taken = math.isfinite(v[0]) and self._queue(AIRSPEED, t, (v[0], math.nan, math.nan), _NAN)
            vanes = math.isfinite(v[1] + v[2]) and self._queue(VANES, t, (v[1], v[2], math.nan), _NAN)
            return taken or vanes or (not math.isfinite(v[0]) and self._refuse(sensor, "not finite"))
        if sensor == "wind":
            if not math.isfinite(v[0] + v[1]):
                return self._refuse(sensor, "not finite")
            r = v[3] * v[3] if v[3] > 0.0 else math.nan
            return self._queue(WIND, t, (v[0], v[1], v[2]), (r, r, r))
        if not math.isfinite(sum(v)) or not 0.9 < math.hypot(*v) < 1.1:
            return self._refuse(sensor, "not a unit quaternion")
        x, y, z = rotation_vector(np.array([v]))[0].tolist()
        return self._queue(ATTITUDE, t, (x, y, z), _NAN)

    def _offer_air_vector(self, t: float, v: tuple[float, ...]) -> bool:
        """Air data of the published filter, which hears them as a vector, see `haltere.estimators.air`."""
        if not math.isfinite(sum(v)):
            return self._refuse("airdata", "no vane" if math.isfinite(v[0]) else "not finite")
        if v[0] < ENOUGH * self.config.number("noise.airspeed"):
            return self._refuse("airdata", "airspeed below three times its noise")
        z, r = (a[0].tolist() for a in vanes(np.array([v]), self.config))
        return self._queue(VANES, t, (z[0], z[1], z[2]), (r[0], r[1], r[2]))

    def _queue(self, kind: int, t: float, z: tuple[float, float, float], r: tuple[float, float, float]) -> bool:
        return bool(self._kernels.offer(self._S, self._prm, kind, t, z, r) in (1, -1))

    def _refuse(self, sensor: str, reason: str) -> bool:
        """Count a measurement that was not taken; always False."""
        reasons = self._refused.setdefault(sensor, {})
        reasons[reason] = reasons.get(reason, 0) + 1
        return False

    @property
    def discarded(self) -> dict[str, dict[str, int]]:
        """What was not taken so far: ``{sensor: {reason: number}}``, as in ``summary.json``."""
        out = {sensor: dict(reasons) for sensor, reasons in self._refused.items()}
        if n := int(self._S["n_bad"][0]):
            out["imu"] = {"refused by the filter": n}
        for sensor, kinds in (
            ("gnss", (GNSS_POSITION, GNSS_VELOCITY)),
            ("barometer", (BAROMETER,)),
            ("magnetometer", (MAGNETOMETER,)),
            ("power", (POWER,)),
        ):
            for field, reason in (("n_late", "later than the fusion horizon"), ("n_overflow", "queue full before the first IMU sample")):
                if n := sum(int(self._S["aid"][field][0, k]) for k in kinds):
                    out.setdefault(sensor, {})[reason] = n
        return out

    def now(self) -> dict[str, FloatArray | float]:
        """State predicted to the newest IMU sample: ``t``, ``q_nb`` (4,), ``vel_n`` (3,), ``pos_n`` (3,); NaN what it does not hold."""
        self._kernels.now(self._S, self._prm, self._now)
        x = self._now.copy()
        return {"t": float(x[0]), "q_nb": x[1:5], "vel_n": x[5:8], "pos_n": x[8:11]}

    def finish(self) -> State:
        """Move the fusion horizon to the newest IMU sample: the end of a flight."""
        self._kernels.flush(self._S, self._prm, _NO_ROWS, _NO_ROWS, self._aids, _NO_ROWS, self._stage)
        return self._view

    def records(self) -> NDArray[np.void]:
        """Records of the measurement updates since the last call; at most 4096 are kept between calls, more are counted."""
        n = int(self._S["n_aids"][0])
        out = self._aids[:n].copy()
        self._S["n_aids"] = 0
        return out

    @property
    def state(self) -> State:
        """Copy of the whole memory; see `restore`."""
        return State(self._S.copy())

    def restore(self, snapshot: State) -> None:
        """Go on from a copy taken of an estimator with the same layout.

        Raises
        ------
        UsageError
            No copy, or one of another layout.
        """
        if not isinstance(snapshot, State):
            raise UsageError("a State, as Estimator.state gives", type(snapshot).__name__, "Estimator.restore")
        if snapshot.record.dtype != self._S.dtype:
            raise UsageError("a state of the same layout", "one of another", "Estimator.restore")
        self._S[:] = snapshot.record


def _flat(values: Any, name: str) -> tuple[Any, ...]:
    """The elements of a one-dimensional sequence, or a lone number as one."""
    n = getattr(values, "ndim", None)
    if n == 0 or isinstance(values, (int, float)):
        return (values,)
    try:
        if n in (None, 1) and not isinstance(values, str):
            return tuple(values)
    except TypeError:
        pass
    raise UsageError(f"{name} as a sequence of numbers", f"shape {values.shape}" if n is not None else repr(values), "Estimator.offer")


def _three(values: Any, name: str) -> tuple[float, float, float]:
    try:
        if getattr(values, "ndim", 1) != 1:
            raise TypeError
        x, y, z = values
        return float(x), float(y), float(z)
    except (TypeError, ValueError):
        found = f"shape {values.shape}" if hasattr(values, "shape") else repr(values)
        raise UsageError(f"three numbers for {name}", found, "Estimator.step", "x, y, z in the body frame (FRD)") from None


def _in_order(sensor: str, values: Sequence[float] | Mapping[str, float], least: int, others: tuple[str, ...] = ()) -> tuple[float, ...]:
    """Values in the order of their names, of which ``least`` must be there; NaN for what was not given. Names may also be ``others``."""
    names = _VALUES[sensor]
    if isinstance(values, Mapping):
        for name in values:
            if schema_column(sensor, str(name)) is None:
                near = nearest_column(str(name), (*names, *others))
                raise UsageError(
                    f"values of {sensor} by name ({', '.join(names)})",
                    repr(name),
                    "Estimator.offer",
                    f"did you mean {near!r}?" if near else "",
                )
        return tuple(number(values.get(n, math.nan), n, "Estimator.offer") for n in names)
    v = tuple(number(x, f"a value of {sensor}", "Estimator.offer") for x in _flat(values, f"values of {sensor}"))
    if not least <= len(v) <= len(names):
        raise UsageError(f"{least} to {len(names)} values for {sensor}: {', '.join(names)}", f"{len(v)}", "Estimator.offer")
    return v + (math.nan,) * (len(names) - len(v))
