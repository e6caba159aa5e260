"""The IMU of a simulated flight: true rates and forces through biases, scale, noise, vibration and limits. It moves nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere._jit import entry
from haltere.simulate.truth import Truth

__all__ = ["SECOND_HARMONIC", "WALK_RATE", "imu"]

FloatArray = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

#: Steps of a bias a second at most [Hz]; between them it goes on lines.
WALK_RATE = 100.0
#: Amplitude of the vibration at twice a rotor's frequency, over that at the frequency itself.
SECOND_HARMONIC = 0.4
#: Temperature of an IMU at the start [degC].
COLD = 25.0


@dataclass
class _Triad:
    """What one flight's gyro or accelerometer is like: drawn once."""

    bias: FloatArray  # with what warmth does to it, at coarse times (m, 3)
    matrix: FloatArray  # scale and misalignment (3, 3)
    shake: FloatArray  # of cosine, sine, and both of twice the angle, a rotor and axis (4, rotors, 3)


def _triad(truth: Truth, p: Mapping[str, float], name: str, rng: np.random.Generator, skip: int) -> _Triad:
    n, m, step = len(truth.t), truth.speed.shape[1], skip / truth.rate
    bias = p[f"{name}_walk"] * math.sqrt(step) * rng.standard_normal((n // skip + 2, 3))
    bias[0] = p[f"{name}_turn_on"] * rng.standard_normal(3)
    np.cumsum(bias, axis=0, out=bias)
    M = np.eye(3) + np.diag(p[f"{name}_scale"] * rng.standard_normal(3))
    M += p[f"{name}_misalignment"] * rng.standard_normal((3, 3)) * (1.0 - np.eye(3))
    warm = p[f"{name}_temperature"] * rng.standard_normal(3)
    bias += _heat(p, step * np.arange(len(bias), dtype=np.float64))[:, None] * warm
    size = p[f"{name}_vibration"] * rng.uniform(0.5, 1.5, (2, m, 3)) * np.array([1.0, SECOND_HARMONIC])[:, None, None]
    angle = rng.uniform(0.0, 2.0 * math.pi, (2, m, 3))
    shake = np.stack([size[0] * np.cos(angle[0]), size[0] * np.sin(angle[0]), size[1] * np.cos(angle[1]), size[1] * np.sin(angle[1])])
    return _Triad(bias, M, shake)


def _heat(p: Mapping[str, float], t: FloatArray) -> FloatArray:
    """Temperature gained [K]."""
    return np.asarray(p["warm_up"] * (1.0 - np.exp(-t / max(p["warm_up_time"], 1e-9))))


@entry
def _corrupt(
    gyro: Any, force: Any, speed: Any, phase: Any, hover: float, still: float, noise: Any, skip: int, gyro_bias: Any, accel_bias: Any,
    matrices: Any, shakes: Any, limits: Any, steps: Any, out: Any, biases: Any,
) -> None:  # fmt: skip
    """Samples of both triads from true rate and force (n, 3).

    ``out`` (6, n) holds normal numbers and takes the samples, gyro first; ``biases`` (6, n) is filled. ``noise`` (2,) is 1 sigma of a
    sample in flight, of which the share ``still`` is there with motors off; ``shakes`` (2, 4, m, 3) as of `_Triad`.
    """
    m = speed.shape[1]
    n = out.shape[1]
    for i in range(n):
        c, f = i // skip, (i % skip) / skip
        v = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        spin = 0.0
        for r in range(m):
            spin += speed[i, r]
            grown = (speed[i, r] / hover) ** 2
            if shakes.shape[2] > 0 and grown > 0.0:
                co, si = math.cos(phase[i, r]), math.sin(phase[i, r])
                a, b, a2, b2 = grown * co, grown * si, grown * (co * co - si * si), 2.0 * grown * co * si
                g, h = shakes[0], shakes[1]
                v = (
                    v[0] + g[0, r, 0] * a + g[1, r, 0] * b + g[2, r, 0] * a2 + g[3, r, 0] * b2,
                    v[1] + g[0, r, 1] * a + g[1, r, 1] * b + g[2, r, 1] * a2 + g[3, r, 1] * b2,
                    v[2] + g[0, r, 2] * a + g[1, r, 2] * b + g[2, r, 2] * a2 + g[3, r, 2] * b2,
                    v[3] + h[0, r, 0] * a + h[1, r, 0] * b + h[2, r, 0] * a2 + h[3, r, 0] * b2,
                    v[4] + h[0, r, 1] * a + h[1, r, 1] * b + h[2, r, 1] * a2 + h[3, r, 1] * b2,
                    v[5] + h[0, r, 2] * a + h[1, r, 2] * b + h[2, r, 2] * a2 + h[3, r, 2] * b2,
                )
        loud = still + (1.0 - still) * min(1.0, spin / (m * hover))
        for j in range(6):
            s, k = j // 3, j % 3
            if s == 0:
                bias = gyro_bias[c, k] + f * (gyro_bias[c + 1, k] - gyro_bias[c, k])
                x = (gyro[i, 0], gyro[i, 1], gyro[i, 2])
            else:
                bias = accel_bias[c, k] + f * (accel_bias[c + 1, k] - accel_bias[c, k])
                x = (force[i, 0], force[i, 1], force[i, 2])
            M = matrices[s]
            y = M[k, 0] * x[0] + M[k, 1] * x[1] + M[k, 2] * x[2] + bias + loud * noise[s] * out[j, i] + v[j]
            y = max(-limits[s], min(limits[s], y))
            out[j, i] = steps[s] * math.floor(y / steps[s] + 0.5) if steps[s] > 0.0 else y
            biases[j, i] = bias


def imu(truth: Truth, p: Mapping[str, float], stamps: FloatArray, rng: np.random.Generator) -> tuple[Columns, Columns]:
    """Stream of the IMU at ``truth``'s point and times, stamped ``stamps``, and the columns of its true biases.

    Parameters are those of `haltere.simulate.parts.sensor` for ``imu``.
    """
    n = len(truth.t)
    skip = max(1, round(truth.rate / WALK_RATE))
    gyro, accel = _triad(truth, p, "gyro", rng, skip), _triad(truth, p, "accel", rng, skip)
    shakes = np.stack([gyro.shake, accel.shake])
    if not shakes.any():
        shakes = shakes[:, :, :0]
    out, biases = np.empty((6, n)), np.empty((6, n))
    rng.standard_normal(out=out)

    def both(name: str) -> FloatArray:
        return np.array([p[f"gyro_{name}"], p[f"accel_{name}"]])

    speed, phase = np.asfortranarray(truth.speed), np.asfortranarray(truth.phase)
    _corrupt(
        np.asfortranarray(truth.gyro_b), np.asfortranarray(truth.force_b), speed, phase, truth.hover, p["still"],
        math.sqrt(truth.rate) * both("noise"), skip, gyro.bias, accel.bias, np.stack([gyro.matrix, accel.matrix]),
        np.ascontiguousarray(shakes), both("range"), both("resolution"), out, biases,
    )  # fmt: skip
    names = [f"{s}_{a}" for s in ("gyro", "accel") for a in "xyz"]
    columns: Columns = {"t": stamps} | {name: out[k] for k, name in enumerate(names)}
    if p["warm_up"] > 0.0:
        columns["temperature"] = COLD + _heat(p, truth.t)
    return columns, {name.replace("_", "_bias_"): biases[k] for k, name in enumerate(names)}
