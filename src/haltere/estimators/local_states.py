"""Where the federated filter begins, and which axes of which sensor its local filters hear. It fuses nothing."""

from __future__ import annotations

from typing import Any

from haltere._jit import jit
from haltere.estimators.federated_layout import LF_ACCEL, LF_BARO, LF_GYRO, LOCAL_FILTERS
from haltere.estimators.local_filters import SHARES, miss

__all__ = ["begin", "set_axes"]

#: What is not known of the rate when it begins, 1 sigma [rad/s].
RATE_SD = 0.1


@jit
def begin(s: Any, prm: Any, t: float) -> None:
    """Take the ordinary filter's state for the fused one, and share it out; of the wind nothing is known."""
    x = s.ft[0]
    wind = prm.init_wind * prm.init_wind if prm.fault_tolerant_wind > 0.0 else 1e-12
    for i in range(22):
        x.dx[i] = 0.0
        for j in range(22):
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
    for i in range(4):
        x.q[i] = s.q[i]
    for i in range(2):
        x.wind[i], x.steady[i] = 0.0, 0.0
        x.P[18 + i, 18 + i] = x.P[20 + i, 20 + i] = x.P[18 + i, 20 + i] = x.P[20 + i, 18 + i] = wind
    for i in range(LOCAL_FILTERS):
        f = x.lf[i]
        f.axes = 7
        for a in range(25):
            f.dx[a] = 0.0
            for b in range(25):
                f.P[a, b] = x.P[a, b] / SHARES[i] if a < 22 and b < 22 else 0.0
        for a in range(3):
            f.P[22 + a, 22 + a], f.own[a] = 1e-12, 0.0
    for a in range(3):
        x.lf[LF_GYRO].own[a], x.lf[LF_ACCEL].own[a] = s.bg[a], s.ba[a]
        for b in range(3):
            x.lf[LF_GYRO].P[22 + a, 22 + b] = s.P[9 + a, 9 + b]
            x.lf[LF_ACCEL].P[22 + a, 22 + b] = s.P[12 + a, 12 + b]
    f = x.lf[LF_BARO]
    f.own[0], f.P[22, 22] = s.baro_start, prm.init_baro_bias * prm.init_baro_bias
    if len(s.baro) > 0:
        f.own[0], f.P[22, 22] = s.baro[0], s.P[15, 15]
    x.on, x.t_begun, x.t_fuse, x.n_fused = 1, t, t, 0
    x.n, x.span = 0, 0.0
    for a in range(3):
        x.by_gyro[a], x.by_accel[a], x.by_model[a] = 0.0, 0.0, 0.0


@jit
def excluded(x: Any, sensor: int, t: float) -> int:
    """Bits of the axes of gyro (0) or accelerometer (1) that are not to be used at t, as configured."""
    out = 0
    for k in range(x.exclude.shape[1]):
        if x.exclude[sensor, k, 1] <= t and t < x.exclude[sensor, k, 2]:
            out |= int(x.exclude[sensor, k, 0])
    return out


@jit
def return_axis(f: Any, a: int, sd: float) -> None:
    """An axis is heard again: of its bias no more is known than at first."""
    for j in range(25):
        f.P[22 + a, j], f.P[j, 22 + a] = 0.0, 0.0
    f.P[22 + a, 22 + a] = sd * sd


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
        if f.axes == 0:
            for a in range(25):
                f.dx[a] = 0.0
            for a in range(22):
                for b in range(22):
                    f.P[a, b] = 1e6 * x.P[a, b]  # nothing to say until the fused state is shared out anew
            for a in range(3):
                return_axis(f, a, 1e-6)
        for a in range(3):
            if axes & ~f.axes & (1 << a):
                if i == LF_GYRO:
                    return_axis(f, a, prm.init_gyro_bias)
                elif i == LF_ACCEL:
                    return_axis(f, a, prm.init_accel_bias)
                elif i == LF_BARO and a == 0:
                    return_axis(f, a, prm.init_baro_bias)
        f.axes = axes
