"""Spectra of sensors: density, white-noise floor, lines, spectrogram, and PX4's measure of vibration. It knows no stream."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

__all__ = ["Peak", "Spectrum", "floor", "folded", "peaks", "px4_vibration", "spectrogram", "spectrum"]

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Spectrum:
    """Noise density over frequency.

    Attributes
    ----------
    f
        Frequencies (m,) [Hz], without zero.
    density
        Square root of the two-sided power spectral density, (m, k) [unit/√Hz]: white noise of standard deviation σ at rate r shows
        σ/√r, which is what ``noise.gyro`` and ``noise.accel`` state. A one-sided density, as in data sheets, is √2 larger.
    averages
        Independent averages in it, about.
    rate
        Samples a second [Hz]; half of it is the highest frequency.
    seconds
        Length of data in it [s].
    """

    f: FloatArray
    density: FloatArray
    averages: float
    rate: float
    seconds: float


@dataclass(frozen=True)
class Peak:
    """A line in a spectrum: frequency [Hz], amplitude over all axes [unit], the axis with most of it, and how far it stands out."""

    frequency: float
    amplitude: float
    axis: int
    ratio: float


def _pieces(t: FloatArray, keep: Mask) -> list[slice]:
    """Stretches of kept rows without an interval above three typical ones."""
    if len(t) < 2:
        return []
    dt = np.diff(t)
    cut = np.r_[True, (dt > 3.0 * float(np.median(dt))) | (keep[1:] != keep[:-1]), True]
    edges = np.flatnonzero(cut)
    return [slice(int(a), int(b)) for a, b in pairwise(edges) if keep[a]]


def spectrum(t: FloatArray, x: FloatArray, keep: Mask | None = None) -> Spectrum | None:
    """Spectrum after Welch: Hann windows of two seconds or 128 samples, halfway overlapping, none across a gap.

    Parameters
    ----------
    t
        Increasing times (n,) [s]. Samples are taken as evenly spaced within a piece: jitter widens lines, it does not move them.
    x
        Values (n, k).
    keep
        Rows to use; all where None.

    Returns
    -------
    Spectrum or None
        None where no stretch has 32 samples.
    """
    pieces = _pieces(t, np.ones(len(t), bool) if keep is None else keep)
    longest = max((p.stop - p.start for p in pieces), default=0)
    if longest < 32:
        return None
    dt = np.concatenate([np.diff(t[p]) for p in pieces])
    rate = 1.0 / float(np.mean(dt))
    size = min(max(2 * round(rate), 128), 4096)
    if longest < size:
        size = 1 << (longest.bit_length() - 1)
    window = np.hanning(size + 1)[:-1]
    total, n = np.zeros((size // 2 + 1, x.shape[1])), 0
    for p in pieces:
        if p.stop - p.start < size:
            continue
        views = np.lib.stride_tricks.sliding_window_view(x[p], size, axis=0)[:: size // 2]
        views = (views - views.mean(axis=2, keepdims=True)) * window
        total += (np.abs(np.fft.rfft(views, axis=2)) ** 2).sum(axis=0).T
        n += len(views)
    power = total / (n * rate * float(window @ window))
    f = np.fft.rfftfreq(size, 1.0 / rate)
    # Half-overlapping Hann windows give 9/11 of the averages of as many separate ones (P. D. Welch, 1967).
    return Spectrum(np.asarray(f[1:], np.float64), np.sqrt(power[1:]), max(1.0, 9.0 * n / 11.0), rate, float(n + 1) * 0.5 * size / rate)


def floor(s: Spectrum) -> FloatArray:
    """White-noise floor (k,) [unit/√Hz]: the median density from 15 Hz (or 0.3 of half the rate) to 0.8 of half the rate.

    Below is the vehicle's own motion; lines fill less than half of the rest. The median of an average of m squares of white
    noise is a little below its mean, which is put right.
    """
    from scipy.special import gammaincinv

    half = 0.5 * s.rate
    rows = (s.f >= min(15.0, 0.3 * half)) & (s.f <= 0.8 * half)
    bias = float(gammaincinv(s.averages, 0.5)) / s.averages
    return np.asarray(np.sqrt(np.median(s.density[rows] ** 2, axis=0) / bias))


def peaks(s: Spectrum, most: int = 3) -> list[Peak]:
    """Lines above 5 Hz (or four bins) that stand out of their neighbourhood, the strongest first.

    The amplitude is that of a sine of the same power: √2 times the root of the power above the background, over all axes.
    """
    power = (s.density**2).sum(axis=1)
    step = float(s.f[1] - s.f[0])
    reach = max(8, round(10.0 / step))
    padded = np.pad(power, reach, mode="reflect") if len(power) > reach else power
    if len(padded) < 2 * reach + 1:
        return []
    around = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=1)
    threshold = max(4.0, 1.0 + 8.0 / math.sqrt(s.averages))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(around > 0.0, power / around, 0.0)
    top = (ratio[1:-1] > threshold) & (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:]) & (s.f[1:-1] > max(5.0, 4.0 * step))
    out: list[Peak] = []
    for i in (np.flatnonzero(top) + 1).tolist():
        rows = slice(max(i - 3, 0), i + 4)
        above = np.maximum(power[rows] - around[rows], 0.0)
        frequency = float(above @ s.f[rows] / above.sum())
        amplitude = math.sqrt(2.0 * 2.0 * float(above.sum()) * step)  # two-sided density, so twice; a sine of amplitude A has A²/2
        out.append(Peak(frequency, amplitude, int(np.argmax((s.density[rows] ** 2).sum(axis=0))), float(ratio[i])))
    out.sort(key=lambda p: -p.amplitude)
    kept: list[Peak] = []
    for p in out:
        if all(abs(p.frequency - q.frequency) > 4.0 * step for q in kept):
            kept.append(p)
    return kept[:most]


def folded(frequency: float, rate: float) -> float:
    """Where a frequency [Hz] shows in samples at ``rate`` [Hz] without a filter before: folded about multiples of half the rate."""
    return abs(frequency - rate * round(frequency / rate))


def spectrogram(t: FloatArray, x: FloatArray, columns: int = 120, bins: int = 64) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Density of one signal over time and frequency, coarse.

    Returns
    -------
    times : (c,)
        Middles of the columns [s].
    f : (b,)
        Middles of the bins [Hz].
    density : (b, c)
        Two-sided density [unit/√Hz], NaN in columns without data. None where there are not four columns.
    """
    if len(t) < 128 or not t[-1] > t[0]:
        return None
    dt = float(np.median(np.diff(t)))
    size = 128
    step = max(size, int(len(t) / columns))
    starts = np.arange(0, len(t) - size + 1, step)
    if len(starts) < 4:
        return None
    window = np.hanning(size + 1)[:-1]
    # A column is the mean of up to four windows spread over it.
    offsets = np.unique(np.linspace(0, step - size, min(4, step // size)).astype(int))
    rows = starts[:, None, None] + offsets[None, :, None] + np.arange(size)
    rows = np.minimum(rows, len(t) - 1)
    whole = t[rows[..., -1]] - t[rows[..., 0]] < 1.5 * size * dt
    views = x[rows]
    views = (views - views.mean(axis=2, keepdims=True)) * window
    power = np.abs(np.fft.rfft(views, axis=2)) ** 2 * dt / float(window @ window)
    weight = whole.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (power * whole[..., None]).sum(axis=1) / weight[:, None]
    f = np.fft.rfftfreq(size, dt)[1:]
    group = max(1, math.ceil(len(f) / bins))
    use = len(f) // group * group
    density = np.sqrt(mean[:, 1 : 1 + use].reshape(len(starts), -1, group).mean(axis=2)).T
    middle = np.minimum(starts + step // 2, len(t) - 1)
    return t[middle], f[:use].reshape(-1, group).mean(axis=1), density


def px4_vibration(t: FloatArray, accel: FloatArray) -> FloatArray | None:
    """PX4's ``accel_vibration_metric`` [m/s²] from logged samples (n, 3): the difference of successive samples, smoothed over 100.

    It is defined at the rate at which PX4 publishes its IMU; None outside 150 to 400 Hz, where it would be another number.
    """
    if len(t) < 200 or not 150.0 <= 1.0 / max(float(np.median(np.diff(t))), 1e-9) <= 400.0:
        return None
    step = np.r_[0.0, np.linalg.norm(np.diff(accel, axis=0), axis=1)]
    # A running exponential mean as a product with its own kernel, in blocks: exp(-0.01 i) falls below 1e-6 within 1400 samples.
    kernel = 0.01 * 0.99 ** np.arange(1400)
    return _convolve(step, np.asarray(kernel, np.float64))[: len(step)]


def _convolve(x: FloatArray, kernel: FloatArray) -> FloatArray:
    """Linear convolution through the frequency domain."""
    size = 1 << (len(x) + len(kernel) - 2).bit_length()
    return np.asarray(np.fft.irfft(np.fft.rfft(x, size) * np.fft.rfft(kernel, size), size))
