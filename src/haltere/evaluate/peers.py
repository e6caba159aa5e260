"""Other programs' attitude filters, each called as its own documentation says. It tunes none, and none sees a reference.

What each gives is turned into q_nb, body FRD to NED with *magnetic* north; the declination is the caller's to add. Frames were found by
trying all of them against motion capture (BROAD), and one fixed choice fits every recording.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError
from haltere.metrics.attitude import multiply

__all__ = ["GAP", "HOLD", "PEERS", "Estimate", "Peer", "Samples", "estimate", "version"]

FloatArray = NDArray[np.float64]
Told = Callable[[float], None]

#: A gap of the IMU longer than this [s] is not bridged: the filter starts anew behind it, as ours do.
GAP = 2.0
#: A magnetometer sample is held for at most this long [s]; after that the filter's update without magnetometer is called.
HOLD = 1.0
#: Half a turn: NED from ENU, NED from NWU (or FRD from FLU).
_NED_ENU, _HALF_X = np.array([0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0]), np.array([0.0, 1.0, 0.0, 0.0])
_FLU = np.array([1.0, -1.0, -1.0])
G = 9.80665


@dataclass(frozen=True)
class Samples:
    """What a peer is given: checked, in the body frame FRD, and nothing else.

    Attributes
    ----------
    t, gyro, accel
        Times (n,) [s], strictly increasing, rates (n, 3) [rad/s], specific forces (n, 3) [m/s^2].
    mag_t, mag
        Magnetometer at its own times (m,), (m, 3) [uT]; empty where there is none.
    dip
        Dip of the field [rad], down positive, for a filter that asks for it; NaN where not known.
    """

    t: FloatArray
    gyro: FloatArray
    accel: FloatArray
    mag_t: FloatArray
    mag: FloatArray
    dip: float = math.nan

    def part(self, rows: slice) -> Samples:
        """IMU samples of a slice, with the whole magnetometer."""
        return Samples(self.t[rows], self.gyro[rows], self.accel[rows], self.mag_t, self.mag, self.dip)

    def held(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Newest magnetometer sample at each IMU time (n, 3), and whether it is not older than `HOLD`."""
        if len(self.mag_t) == 0:
            return np.zeros((len(self.t), 3)), np.zeros(len(self.t), bool)
        i = np.searchsorted(self.mag_t, self.t, side="right") - 1
        fresh = (i >= 0) & (self.t - self.mag_t[np.maximum(i, 0)] <= HOLD)
        return self.mag[np.maximum(i, 0)], fresh

    def uniform(self) -> tuple[Samples, float, bool]:
        """Samples at fixed steps, the step [s] (the median interval), and whether they had to be interpolated for it."""
        dt = np.diff(self.t)
        step = float(np.median(dt))
        if np.max(np.abs(self.t - self.t[0] - step * np.arange(len(self.t)))) <= 0.5 * step:
            return self, step, False
        t = self.t[0] + step * np.arange(int((self.t[-1] - self.t[0]) / step + 1e-6) + 1)
        gyro, accel = (np.column_stack([np.interp(t, self.t, v[:, k]) for k in range(3)]) for v in (self.gyro, self.accel))
        return Samples(t, gyro, accel, self.mag_t, self.mag, self.dip), step, True


@dataclass
class Estimate:
    """What a peer gave back.

    Attributes
    ----------
    t, q
        Times (n,) [s] and attitude q_nb (n, 4), FRD to NED of magnetic north; rows that are not finite are left out.
    heading
        A magnetometer was used: without one, heading begins anywhere.
    seconds
        Time spent in the filter, loop in Python included where its interface asks for one [s].
    done
        How it was called: settings, rate, frames.
    """

    t: FloatArray
    q: FloatArray
    heading: bool
    seconds: float
    done: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Peer:
    """Another program's filter: its package and how to call it.

    Attributes
    ----------
    name
        As it calls itself.
    package
        Distribution and module it is in.
    call
        Gives rows of q_nb over one stretch without gaps, in NED of magnetic north, and what was done.
    smoother
        It uses samples from after each instant.
    """

    name: str
    package: str
    call: Callable[[Samples, bool, Told], tuple[FloatArray, FloatArray, list[str]]]
    smoother: bool = False


def version(peer: Peer) -> str | None:
    """Version of the peer's package as installed, or None where it is not."""
    try:
        importlib.import_module(peer.package)
        return importlib.metadata.version(peer.package)
    except ImportError:
        return None


def estimate(peer: Peer, samples: Samples, progress: Told | None = None) -> Estimate:
    """Run a peer over all stretches of a flight between IMU gaps.

    Parameters
    ----------
    peer
        One of `PEERS` that is installed.
    samples
        What it is given.
    progress
        Called with the fraction done.

    Returns
    -------
    Estimate
        Rows in time order.

    Raises
    ------
    HaltereError
        It raised something, whatever that was, or gave no finite row; the message is its own.
    """
    heading = len(samples.mag_t) > 0
    cuts = [0, *(np.flatnonzero(np.diff(samples.t) > GAP) + 1).tolist(), len(samples.t)]
    parts: list[tuple[FloatArray, FloatArray]] = []
    done: list[str] = []
    began = time.perf_counter()
    for a, b in itertools.pairwise(cuts):
        if heading:  # it starts with the first magnetometer sample of the stretch: nothing is known of heading before
            k = int(np.searchsorted(samples.mag_t, samples.t[a]))
            a = b if k == len(samples.mag_t) else a + int(np.searchsorted(samples.t[a:b], samples.mag_t[k]))
        if b - a < 2:
            continue

        def told(fraction: float, a: int = a, b: int = b) -> None:
            if progress is not None:
                progress((a + fraction * (b - a)) / len(samples.t))

        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                t, q, done = peer.call(samples.part(slice(a, b)), heading, told)
        except Exception as error:
            raise HaltereError(
                "attitudes", f"{type(error).__name__}: {error}", peer.name, "the fault is the peer's, or of its input"
            ) from error
        good = np.isfinite(q).all(axis=1) & (np.abs(np.linalg.norm(q, axis=1) - 1.0) < 1e-2)
        parts.append((t[good], q[good] / np.linalg.norm(q[good], axis=1, keepdims=True)))
    seconds = time.perf_counter() - began
    if sum(len(t) for t, _ in parts) < 2:
        raise HaltereError("attitudes", "none that is finite", peer.name)
    if len(parts) > 1:
        done = [*done, f"started {len(parts)} times: IMU gaps longer than {GAP:g} s are not bridged"]
    if not heading:
        done = [*done, "no magnetometer: its heading begins anywhere, and is not scored"]
    return Estimate(np.concatenate([t for t, _ in parts]), np.concatenate([q for _, q in parts]), heading, seconds, done)


# --- one peer after the other --------------------------------------------------------------------------------------------


def _counted(n: int, told: Told) -> Iterator[int]:
    """Row numbers, telling how far it is now and then."""
    for i in range(n):
        if i % 2000 == 0:
            told(i / n)
        yield i


def _turned(q: FloatArray, ned_earth: FloatArray) -> FloatArray:
    """q_nb of body FRD from a quaternion of body FLU to another earth frame."""
    turned: FloatArray = multiply(multiply(ned_earth, q), _HALF_X)
    return turned


def _steps(s: Samples) -> FloatArray:
    """Interval before each sample [s]; that of the first is the median."""
    dt = np.diff(s.t)
    return np.concatenate([[float(np.median(dt))], dt])


def _rate_note(step: float, resampled: bool) -> str:
    words = f"sample time {1e3 * step:.4g} ms, the median interval"
    return f"{words}; the log is irregular, so gyro and accelerometer were interpolated to it" if resampled else words


def _vqf(s: Samples, heading: bool, told: Told) -> tuple[FloatArray, FloatArray, list[str]]:
    """vqf.VQF, sample by sample, the magnetometer at its own rate, as its class allows; ENU, any body axes."""
    import vqf

    u, step, resampled = s.uniform()
    gyro, accel = np.ascontiguousarray(u.gyro * _FLU), np.ascontiguousarray(u.accel * _FLU)
    done = ["default parameters", _rate_note(step, resampled), "fed FLU; its ENU turned to NED"]
    if not heading:
        return u.t, _turned(vqf.VQF(step).updateBatch(gyro, accel)["quat6D"], _NED_ENU), done
    if np.array_equal(u.t, u.mag_t):
        q = vqf.VQF(step).updateBatch(gyro, accel, np.ascontiguousarray(u.mag * _FLU))["quat9D"]
        return u.t, _turned(q, _NED_ENU), [*done, "magnetometer at the IMU's times"]
    inside = (u.mag_t >= u.t[0]) & (u.mag_t <= u.t[-1])
    mag_t, mag = u.mag_t[inside], np.ascontiguousarray(u.mag[inside] * _FLU)
    mag_step = float(np.median(np.diff(mag_t))) if len(mag_t) > 1 else step
    due = np.searchsorted(u.t, mag_t)  # each sample goes in with the first IMU sample not before it
    f = vqf.VQF(step, step, max(mag_step, step))
    q = np.empty((len(u.t), 4))
    j = 0
    for i in _counted(len(u.t), told):
        f.updateGyr(gyro[i])
        f.updateAcc(accel[i])
        while j < len(due) and due[j] <= i:
            f.updateMag(mag[j])
            j += 1
        q[i] = f.getQuat9D()
    return u.t, _turned(q, _NED_ENU), [*done, f"magnetometer at its own rate, sample time {1e3 * mag_step:.4g} ms"]


def _vqf_offline(s: Samples, heading: bool, told: Told) -> tuple[FloatArray, FloatArray, list[str]]:
    """vqf.offlineVQF: all data at one rate, past and future."""
    import vqf

    u, step, resampled = s.uniform()
    gyro, accel = np.ascontiguousarray(u.gyro * _FLU), np.ascontiguousarray(u.accel * _FLU)
    done = ["default parameters", _rate_note(step, resampled), "fed FLU; its ENU turned to NED"]
    if not heading:
        return u.t, _turned(vqf.offlineVQF(gyro, accel, None, step)["quat6D"], _NED_ENU), done
    mag = np.ascontiguousarray(np.column_stack([np.interp(u.t, u.mag_t, u.mag[:, k]) for k in range(3)]) * _FLU)
    if not np.array_equal(u.t, u.mag_t):
        done.append("magnetometer interpolated to the IMU's times")
    return u.t, _turned(vqf.offlineVQF(gyro, accel, mag, step)["quat9D"], _NED_ENU), done


def _imufusion(s: Samples, heading: bool, told: Told) -> tuple[FloatArray, FloatArray, list[str]]:
    """imufusion.Ahrs: deg/s and g, its default convention NWU (a constructor that is given another drops it, 1.3.3)."""
    import imufusion

    dt = _steps(s)
    f = imufusion.Ahrs()
    f.set_settings(imufusion.AhrsSettings(sample_rate=1.0 / float(np.median(dt))))
    gyro, accel = np.degrees(s.gyro) * _FLU, s.accel * _FLU / G
    held, fresh = s.held()
    mag = held * _FLU
    q = np.empty((len(s.t), 4))
    starting = 0
    for i in _counted(len(s.t), told):
        f.set_sample_period(float(dt[i]))
        if fresh[i]:
            f.update(gyro[i], accel[i], mag[i])
        else:
            f.update_no_magnetometer(gyro[i], accel[i])
        q[i] = f.get_quaternion()
        if starting == i and f.get_flags().startup:
            starting = i + 1
    done = [
        "default settings: gain 0.5, no rejection, no bias correction", "the log's own intervals",
        "fed FLU, deg/s, g; its NWU turned to NED",
        f"rows while its startup flag is set are left out ({starting} samples)",
    ]  # fmt: skip
    if heading:
        done.append("magnetometer held to the IMU's times")
    return s.t[starting:], _turned(q[starting:], _HALF_X), done


def _recursive(
    s: Samples, heading: bool, told: Told, start: FloatArray, marg: Callable[..., Any], imu: Callable[..., Any], v: tuple[FloatArray, ...]
) -> FloatArray:
    """Quaternions of one of ahrs' filters, sample by sample with the log's own intervals, from its own first attitude."""
    dt = _steps(s)
    gyro, accel, mag = v
    _, fresh = s.held()
    q = np.empty((len(s.t), 4))
    q[0] = start
    for i in _counted(len(s.t), told):
        if i and heading and fresh[i]:
            q[i] = marg(q[i - 1], gyro[i], accel[i], mag[i], float(dt[i]))
        elif i:
            q[i] = imu(q[i - 1], gyro[i], accel[i], float(dt[i]))
    return q


_AHRS = ["the log's own intervals", "first attitude its own, from the first samples"]


def _ahrs_notes(heading: bool) -> list[str]:
    return [*_AHRS, "magnetometer held to the IMU's times"] if heading else list(_AHRS)


def _madgwick(s: Samples, heading: bool, told: Told) -> tuple[FloatArray, FloatArray, list[str]]:
    """ahrs.filters.Madgwick: north along x and up along z, NWU."""
    from ahrs.filters import Madgwick

    v = (s.gyro * _FLU, s.accel * _FLU, s.held()[0] * _FLU)
    f = Madgwick(*(x[:1] for x in (v if heading else v[:2])))  # the gain depends on whether there is a magnetometer
    q = _recursive(s, heading, told, f.Q[0], f.updateMARG, f.updateIMU, v)
    return s.t, _turned(q, _HALF_X), [f"default gain {f.gain:g}", *_ahrs_notes(heading), "fed FLU; its NWU turned to NED"]


def _mahony(s: Samples, heading: bool, told: Told) -> tuple[FloatArray, FloatArray, list[str]]:
    """ahrs.filters.Mahony: north along y and up along z, ENU; without magnetometer only up is fixed."""
    from ahrs.filters import Mahony

    v = (s.gyro * _FLU, s.accel * _FLU, s.held()[0] * _FLU)
    first = Mahony(*(x[:1] for x in (v if heading else v[:2])))
    f = Mahony()
    q = _recursive(s, heading, told, first.Q[0], f.updateMARG, f.updateIMU, v)
    return s.t, _turned(q, _NED_ENU), [f"default gains {f.k_P:g}, {f.k_I:g}", *_ahrs_notes(heading), "fed FLU; its ENU turned to NED"]


def _ekf(s: Samples, heading: bool, told: Told) -> tuple[FloatArray, FloatArray, list[str]]:
    """ahrs.filters.EKF in NED. Its reference of gravity points down, so it is fed the specific force with its sign changed.

    Its reference field is Munich's, declination included, unless the local dip is given, as its documentation asks for.
    """
    from ahrs.filters import EKF

    held, _ = s.held()
    v = (s.gyro, -s.accel, held)
    done = ["default noises", *_ahrs_notes(heading), "fed FRD, NED; specific force with its sign changed, since it expects gravity"]
    if not heading:
        f = EKF()
        first = EKF(gyr=v[0][:1], acc=v[1][:1]).Q[0]
        q = _recursive(s, heading, told, first, f.update, lambda q, g, a, dt: f.update(q, g, a, None, dt), v)
        return s.t, q, done
    dip, source = s.dip, "of the World Magnetic Model or the log"
    if math.isnan(dip):
        a, m = v[1][: _second(s)], held[: _second(s)]
        sine = np.sum(a * m, axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(m, axis=1))
        dip, source = float(np.median(np.arcsin(np.clip(sine, -1.0, 1.0)))), "between magnetometer and accelerometer in the first second"
    f = EKF(magnetic_ref=math.degrees(dip))
    first = EKF(gyr=v[0][:1], acc=v[1][:1], mag=held[:1], magnetic_ref=math.degrees(dip)).Q[0]

    def marg(q: FloatArray, g: FloatArray, a: FloatArray, m: FloatArray, dt: float) -> Any:
        f.mag = m  # `update` looks here to know how many measurements there are
        return f.update(q, g, a, m, dt)

    def imu(q: FloatArray, g: FloatArray, a: FloatArray, dt: float) -> Any:
        f.mag = None
        return f.update(q, g, a, None, dt)

    return s.t, _recursive(s, heading, told, first, marg, imu, v), [*done, f"magnetic_ref = dip {math.degrees(dip):.1f} deg, {source}"]


def _second(s: Samples) -> int:
    """Number of samples in the first second, at least one."""
    return max(1, int(np.searchsorted(s.t, s.t[0] + 1.0)))


#: Peers by the name each calls itself, in the order of tables.
PEERS: dict[str, Peer] = {
    p.name: p
    for p in (
        Peer("vqf.VQF", "vqf", _vqf),
        Peer("vqf.offlineVQF", "vqf", _vqf_offline, smoother=True),
        Peer("imufusion.Ahrs", "imufusion", _imufusion),
        Peer("ahrs.Madgwick", "ahrs", _madgwick),
        Peer("ahrs.Mahony", "ahrs", _mahony),
        Peer("ahrs.EKF", "ahrs", _ekf),
    )
}
