"""Where the federated filter begins, and which axes of which sensor its local filters hear. It fuses nothing."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.estimators.federated_layout import LF_ACCEL, LF_BARO, LF_GYRO, LOCAL_FILTERS
from haltere.estimators.local_filters import miss, set_shares
from haltere.filter.federated import share_out
from haltere.strapdown.dynamics import ACCEL_BIAS, BARO_OFFSET, GYRO_BIAS, STATES

__all__ = ["begin", "set_axes"]

#: What is not known of the rate when it begins, 1 sigma [rad/s].
RATE_SD = 0.1
#: Wind and its mean begin alike to this correlation: wholly alike, their covariance could not be inverted.
ALIKE = 0.9


@jit
def excluded(x: Any, sensor: int, t: float) -> int:
    """Bits of the axes of gyro (0) or accelerometer (1) that are not to be used at t, as configured."""
    out = 0
    for k in range(x.exclude.shape[1]):
        if x.exclude[sensor, k, 1] <= t and t < x.exclude[sensor, k, 2]:
            out |= int(x.exclude[sensor, k, 0])
    return out


@jit
def open_bias(x: Any, j: int, sd: float) -> None:
    """A sensor is heard again: of its bias, state j, no more is known than at first."""
    for i in range(LOCAL_FILTERS):
        f = x.lf[i]
        if f.share > 0.0:
            f.P[j, j] += sd * sd / f.share


@jit
def set_axes(s: Any, prm: Any, t: float) -> None:
    """Let every local filter hear what is neither isolated nor excluded; one that comes back takes the fused state as it is.

    Bits of ``isolated``: gyro and accelerometer axes, model axes hx hy t r p q, compass, GNSS velocity, barometer, GNSS position.
    """
    x = s.ft[0]
    for i in range(LOCAL_FILTERS):
        f = x.lf[i]
        if i == LF_GYRO:
            axes = 7 & ~(x.isolated & 7) & ~excluded(x, 0, t)
        elif i == LF_ACCEL:
            axes = 7 & ~((x.isolated >> 3) & 7) & ~excluded(x, 1, t)
        elif i == 2:
            axes = 0 if x.isolated & (1 << 12) else 1
        elif i == 3:
            axes = (0 if x.isolated & (1 << 13) else 1) | (0 if x.isolated & (1 << 15) else 2)
        else:
            axes = 0 if x.isolated & (1 << 14) else 1
        if axes == f.axes:
            continue
        for a in range(3):
            if axes & ~f.axes & (1 << a):
                if i == LF_GYRO:
                    open_bias(x, GYRO_BIAS + a, prm.init_gyro_bias)
                elif i == LF_ACCEL:
                    open_bias(x, ACCEL_BIAS + a, prm.init_accel_bias)
                elif i == LF_BARO and a == 0:
                    open_bias(x, BARO_OFFSET, prm.init_baro_bias)
        f.axes, f.changed = axes, 1


@jit
def begin(s: Any, prm: Any, t: float) -> None:
    """Take the ordinary filter's state for the fused one, and share it out; of the wind nothing is known."""
    x = s.ft[0]
    wind = prm.init_wind * prm.init_wind if prm.fault_tolerant_wind > 0.0 else 1e-9
    for i in range(STATES):
        x.dx[i] = 0.0
        for j in range(STATES):
            x.P[i, j] = 0.0
    for i in range(3):
        x.w[i], x.v[i], x.p[i] = s.w_raw[i] - s.bg[i], s.v[i], s.p[i]
        x.bm[i], x.bf[i], x.a[i] = 0.0, 0.0, 0.0
        x.P[i, i] = RATE_SD * RATE_SD
        x.P[12 + i, 12 + i] = miss(s, prm, 3 + i) ** 2
        x.P[15 + i, 15 + i] = miss(s, prm, i) ** 2
    for i in range(9):
        for j in range(9):
            x.P[3 + i, 3 + j] = s.P[i, j]
        for j in range(6):
            x.P[3 + i, GYRO_BIAS + j] = x.P[GYRO_BIAS + j, 3 + i] = s.P[i, 9 + j]
    for i in range(4):
        x.q[i] = s.q[i]
    for i in range(2):
        x.wind[i], x.steady[i] = 0.0, 0.0
        x.P[18 + i, 18 + i] = x.P[20 + i, 20 + i] = wind
        x.P[18 + i, 20 + i] = x.P[20 + i, 18 + i] = ALIKE * wind
    for i in range(3):
        x.bg[i], x.ba[i] = s.bg[i], s.ba[i]
    for i in range(6):
        for j in range(6):
            x.P[GYRO_BIAS + i, GYRO_BIAS + j] = s.P[9 + i, 9 + j]
    x.baro, x.P[BARO_OFFSET, BARO_OFFSET] = s.baro_start, prm.init_baro_bias * prm.init_baro_bias
    if len(s.baro) > 0:
        x.baro, x.P[BARO_OFFSET, BARO_OFFSET] = s.baro[0], s.P[15, 15]
        for j in range(9):
            x.P[3 + j, BARO_OFFSET] = x.P[BARO_OFFSET, 3 + j] = s.P[j, 15]
        for j in range(6):
            x.P[GYRO_BIAS + j, BARO_OFFSET] = x.P[BARO_OFFSET, GYRO_BIAS + j] = s.P[9 + j, 15]
    for i in range(LOCAL_FILTERS):
        x.lf[i].axes, x.lf[i].changed = 7, 0
    set_axes(s, prm, t)
    set_shares(x)
    for i in range(LOCAL_FILTERS):
        x.lf[i].changed = 0
        share_out(x, x.lf[i], max(x.lf[i].share, 1e-6))
    x.on, x.t_begun, x.t_fuse, x.n_fused = 1, t, t, 0
    x.n, x.span = 0, 0.0
    for a in range(3):
        x.by_gyro[a], x.by_accel[a], x.by_model[a] = 0.0, 0.0, 0.0
