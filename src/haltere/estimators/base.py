"""The online estimator: step, offer, now, state, restore over the compiled step. It reads no log; `haltere.drive` does."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import as_records
from haltere.aids.record import AID_RECORD, BAROMETER, GNSS_POSITION, GNSS_VELOCITY, MAGNETOMETER
from haltere.core.earth import STANDARD_GRAVITY, gravity
from haltere.errors import HaltereError, UsageError
from haltere.estimators import step as kernels
from haltere.estimators.inputs import altitude_of, parameters
from haltere.flight import config as configuration
from haltere.flight.config import Config
from haltere.strapdown.layout import CORE, layout

__all__ = ["Estimator", "InitialState", "State", "new_state"]

FloatArray = NDArray[np.float64]
_NO_ROWS = np.empty((0, 0))
_NAN = (math.nan, math.nan, math.nan)


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
        return np.array(self.record[name][0], dtype=np.float64)

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
        return self._vector("P")


@dataclass(frozen=True)
class InitialState:
    """A state to begin from in place of alignment: nominal values at time t and the covariance of their errors.

    Attributes
    ----------
    t
        Time of the first IMU sample [s].
    q_nb, vel_n, pos_n, gyro_bias_b, accel_bias_b
        Nominal state, SI units.
    P
        Covariance (n, n) in the order of `State.P`.
    baro_bias
        Barometer offset [m].
    """

    t: float
    q_nb: FloatArray
    vel_n: FloatArray
    pos_n: FloatArray
    gyro_bias_b: FloatArray
    accel_bias_b: FloatArray
    P: FloatArray
    baro_bias: float = 0.0


def new_state(config: Config, initial: InitialState | None = None) -> NDArray[np.void]:
    """State record, one element, that has seen nothing yet."""
    record = as_records(np.zeros(1, layout(1 if config["baro.offset"] == "on" else 0)))
    record["q"][0, 0] = 1.0
    home = (config.number("home.lat"), config.number("home.lon"), config.number("home.alt"))
    record["gravity"] = STANDARD_GRAVITY
    if not math.isnan(home[0]):
        record["origin"][0] = home
        record["has_origin"] = 1
        record["gravity"] = gravity(home[0], home[2])
    declination = config.number("field.declination")
    record["field"][0, 0] = 0.0 if math.isnan(declination) else declination
    dip, strength = config.number("field.dip"), config.number("field.strength")
    if not (math.isnan(dip) or math.isnan(strength)):
        record["field"][0, 1:] = dip, strength
        record["has_field"] = 1
    if initial is not None:
        _begin_from(record, initial)
    return record


def _begin_from(record: NDArray[np.void], initial: InitialState) -> None:
    n = record["P"].shape[1]
    P = np.asarray(initial.P, dtype=np.float64)
    if P.shape != (n, n):
        raise HaltereError(f"an initial covariance of shape ({n}, {n})", f"{P.shape}", "initial state", "see State.P for the order")
    if not np.allclose(P, P.T, rtol=1e-9, atol=1e-15) or np.linalg.eigvalsh(P).min() <= 0.0:
        raise HaltereError("a symmetric positive covariance", "one that is not", "initial state")
    record["t"] = initial.t
    for name, values in (
        ("q", initial.q_nb),
        ("v", initial.vel_n),
        ("p", initial.pos_n),
        ("bg", initial.gyro_bias_b),
        ("ba", initial.accel_bias_b),
    ):
        record[name][0] = values
    record["baro_start"] = initial.baro_bias
    if n > CORE:
        record["baro"][0, 0] = initial.baro_bias
    record["q"][0] /= np.linalg.norm(record["q"][0])
    record["P"][0] = P
    record["phase"] = 2
    record["n_aligned"] = 1
    record["t_aligned"] = initial.t
    record["aid"]["started"][0] = 1
    record["aid"]["t_passed"][0] = initial.t
    record["aid"]["t_due"][0] = initial.t
    record["rest"]["t_block"] = initial.t
    record["t_wake"] = initial.t


class Estimator:
    """A filter that is fed sample by sample; the same compiled code as `haltere.run` over a log.

    Parameters
    ----------
    name
        ``navigator`` or ``ahrs``.
    config
        A complete `Config`, or a mapping of configuration keys to change. Home and field that are not given are taken from
        the first fix (origin) and from the first magnetometer samples (field); declination is then 0.
    initial
        State to begin from instead of aligning.

    Examples
    --------
    >>> est = Estimator("ahrs")
    >>> for k in range(1500):
    ...     state = est.step(0.001 * k, (0.0, 0.0, 0.0), (0.0, 0.0, -9.80665))
    """

    def __init__(
        self, name: str = "navigator", config: Config | Mapping[str, Any] | None = None, initial: InitialState | None = None
    ) -> None:
        if isinstance(config, Config):
            if config.estimator != name:
                raise UsageError(f"a configuration of {name}", f"one of {config.estimator}", "Estimator")
            self.config = config
        else:
            self.config = configuration.resolve(name, "default", config or {}, "Estimator")
        self._S = new_state(self.config, initial)
        self._prm = parameters(self.config)
        self._aids = as_records(np.empty(4096, AID_RECORD))
        self._now = np.zeros(11)
        self._view = State(self._S)

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
        """
        kernels.step(
            self._S, self._prm, t, (float(gyro[0]), float(gyro[1]), float(gyro[2])), (float(accel[0]), float(accel[1]), float(accel[2])),
            _NO_ROWS, _NO_ROWS, self._aids,
        )  # fmt: skip
        return self._view

    def offer(self, sensor: str, t: float, values: Sequence[float] | Mapping[str, float], variances: Sequence[float] | None = None) -> bool:
        """Offer a measurement, whenever it arrives.

        Parameters
        ----------
        sensor
            ``gnss``, ``barometer`` or ``magnetometer``.
        t
            Time stamp [s]; it was valid at t minus the configured delay.
        values
            By column name as in the flight folder, or in order: gnss ``lat, lon, alt[, vel_n, vel_e, vel_d]`` (deg, m, m/s),
            barometer ``pressure`` [Pa], magnetometer ``mag_x, mag_y, mag_z`` [uT].
        variances
            Of the values in order, for gnss (lat, lon and alt in m^2); NaN or absent: as configured.

        Returns
        -------
        bool
            False when it was not taken: switched off, not finite, or valid before the fusion horizon. The last is counted.

        Raises
        ------
        UsageError
            Unknown sensor, or too few values.
        """
        if sensor == "gnss":
            names = ("lat", "lon", "alt", "vel_n", "vel_e", "vel_d")
            v = _in_order(sensor, values, names, 3)
            r = tuple(variances) if variances is not None else ()
            if isinstance(values, Mapping) and variances is None:
                r = tuple(
                    x * x if x > 0.0 else math.nan
                    for x in (values.get(k, math.nan) for k in ("h_acc", "h_acc", "v_acc", "s_acc", "s_acc", "s_acc"))
                )
            r = r + (math.nan,) * (6 - len(r))
            taken = False
            if math.isfinite(v[3] + v[4]):
                taken = kernels.offer(self._S, self._prm, GNSS_VELOCITY, t, (v[3], v[4], v[5]), (r[3], r[4], r[5])) in (1, -1)
            if math.isfinite(v[0] + v[1]):
                taken |= kernels.offer(self._S, self._prm, GNSS_POSITION, t, (v[0], v[1], v[2]), (r[0], r[1], r[2])) in (1, -1)
            return taken
        if sensor == "barometer":
            if isinstance(values, Mapping) and "pressure" not in values:
                h = float(values.get("altitude", math.nan))
            else:
                h = float(altitude_of(np.array(_in_order(sensor, values, ("pressure",), 1)), self.config)[0])
            if not math.isfinite(h):
                return False
            return bool(kernels.offer(self._S, self._prm, BAROMETER, t, (h, math.nan, math.nan), _NAN) in (1, -1))
        if sensor == "magnetometer":
            m = _in_order(sensor, values, ("mag_x", "mag_y", "mag_z"), 3)
            if not math.isfinite(m[0] + m[1] + m[2]) or m == (0.0, 0.0, 0.0):
                return False
            return bool(kernels.offer(self._S, self._prm, MAGNETOMETER, t, (m[0], m[1], m[2]), _NAN) in (1, -1))
        raise UsageError("a sensor: gnss, barometer or magnetometer", repr(sensor), "Estimator.offer")

    def now(self) -> dict[str, FloatArray | float]:
        """State predicted to the newest IMU sample: ``t``, ``q_nb`` (4,), ``vel_n`` (3,), ``pos_n`` (3,)."""
        kernels.now(self._S, self._prm, self._now)
        x = self._now.copy()
        return {"t": float(x[0]), "q_nb": x[1:5], "vel_n": x[5:8], "pos_n": x[8:11]}

    def finish(self) -> State:
        """Move the fusion horizon to the newest IMU sample: the end of a flight."""
        kernels.flush(self._S, self._prm, _NO_ROWS, _NO_ROWS, self._aids)
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
            The copy is of another layout.
        """
        if snapshot.record.dtype != self._S.dtype:
            raise UsageError("a state of the same layout", "one of another", "Estimator.restore")
        self._S[:] = snapshot.record


def _in_order(sensor: str, values: Sequence[float] | Mapping[str, float], names: tuple[str, ...], least: int) -> tuple[float, ...]:
    """Values in the order of their names; NaN for what was not given."""
    if isinstance(values, Mapping):
        v = tuple(float(values.get(n, math.nan)) for n in names)
    else:
        v = tuple(float(x) for x in np.atleast_1d(np.asarray(values, dtype=np.float64)))
        if not least <= len(v) <= len(names):
            raise UsageError(f"{least} to {len(names)} values for {sensor}: {', '.join(names)}", f"{len(v)}", "Estimator.offer")
        v = v + (math.nan,) * (len(names) - len(v))
    return v
