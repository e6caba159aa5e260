"""Do innovations repeat themselves? Autocorrelation with its band and a portmanteau test. It judges no sizes (see consistency)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.solution import Solution

__all__ = ["LEAST", "Whiteness", "assumed", "autocorrelation", "whiteness", "whiteness_series", "whiteness_table"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Fewest innovations tested, most lags, and innovations a lag: with fewer the statistic is not yet chi-square.
LEAST, LAGS, PER_LAG = 40, 40, 5
#: Risk of calling white innovations correlated. A flight has about ten components: with 5 % every other one would be called so.
RISK = 0.01
#: Correlation below which it matters little, whatever its significance.
SMALL = 0.15


def assumed(sensor: str) -> bool:
    """Whether a sensor of the aid records is an assumption and no measurement: its innovations need not be white."""
    return sensor.startswith(("zero_", "fake_"))


@dataclass(frozen=True)
class Whiteness:
    """Autocorrelation of one component's normalised innovations.

    Attributes
    ----------
    r
        Autocorrelation at lags 1, 2, ... samples, (m,). The mean is not subtracted: it should be zero, and a bias is correlation.
    band
        Two-sided 95 % limit of each under whiteness, (m,): 1.96 / sqrt(pairs).
    interval
        Typical time between samples, one lag [s].
    n, deweighted
        Innovations used, and how many of them the filter de-weighted. Refused ones are left out, their places kept.
    statistic, p
        Portmanteau statistic over all lags and its upper tail probability, chi-square with one degree of freedom a lag.
    """

    r: FloatArray
    band: FloatArray
    interval: float
    n: int
    deweighted: int
    statistic: float
    p: float

    @property
    def verdict(self) -> str:
        """``white``, ``nearly white`` (significant but small) or ``correlated``."""
        if self.p >= RISK:
            return "white"
        return "nearly white" if float(np.max(np.abs(self.r))) < SMALL else "correlated"

    @property
    def lasting(self) -> float:
        """Time [s] until the correlation first falls below 1/e."""
        return self.interval * (1 + int(np.argmax(np.r_[self.r, 0.0] < math.exp(-1.0))))


def _products(z: FloatArray, lags: int) -> tuple[FloatArray, FloatArray, IntArray]:
    """Sums of z_i z_{i+l}, the geometric mean of the sums of their squares, and the number of pairs, at lags 1 ... lags."""
    known = np.isfinite(z)
    filled = np.where(known, z, 0.0)
    weight = known.astype(np.float64)
    sums, powers, pairs = np.zeros(lags), np.zeros(lags), np.zeros(lags, np.int64)
    for k in range(1, min(lags, len(z) - 1) + 1):
        sums[k - 1] = filled[:-k] @ filled[k:]
        powers[k - 1] = np.sqrt((filled[:-k] ** 2 @ weight[k:]) * (weight[:-k] @ filled[k:] ** 2))
        pairs[k - 1] = np.count_nonzero(known[:-k] & known[k:])
    return sums, powers, pairs


def autocorrelation(z: FloatArray, lags: int) -> tuple[FloatArray, IntArray]:
    """Autocorrelation about zero at lags 1 ... lags, and the number of pairs of each.

    ``z`` (n,) has one place a sample and NaN where it is missing. r_l = Σ z_i z_{i+l} / √(Σ z_i² Σ z_{i+l}²) over the pairs of which
    both are there (Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications, 2001, §5.4.2), so that no r is beyond ±1;
    NaN where there is no pair, or nothing but zeros.
    """
    sums, powers, pairs = _products(z, lags)
    return np.divide(sums, powers, out=np.full(lags, np.nan), where=powers > 0.0), pairs


def _places(t: FloatArray, lags: int) -> IntArray:
    """Place of each sample in a regular sequence: a gap leaves places empty, and no pair reaches over a long one."""
    if len(t) < 2:
        return np.zeros(len(t), np.int64)
    dt = np.diff(t)
    typical = float(np.median(dt))
    steps = np.rint(dt / typical) if typical > 0.0 else np.ones(len(dt))
    return np.asarray(np.r_[0, np.cumsum(np.clip(steps, 1, lags + 1))], np.int64)


def whiteness(t: FloatArray, z: FloatArray, used: NDArray[np.bool_], deweighted: int = 0, lags: int = LAGS) -> Whiteness | None:
    """Test of one component's normalised innovations for whiteness.

    Parameters
    ----------
    t
        Times of all samples offered (n,) [s], in any order.
    z
        Innovations over their stated standard deviations (n,).
    used
        Which of them count: not the refused ones, whose places stay empty.
    deweighted
        How many of those used were de-weighted, to be passed on.
    lags
        Most lags; fewer where there is less than one for five innovations.

    Returns
    -------
    Whiteness or None
        None below `LEAST` usable innovations, or where too many places are empty for a pair at every lag.

    Notes
    -----
    The statistic is that of G. M. Ljung and G. E. P. Box (Biometrika 65, 1978) in the form for missing places (D. S. Stoffer and
    C. M. C. Toloi, Statistics & Probability Letters 13, 1992): Q = (n + 2) / n Σ m_l c_l² / c_0², with c_l the mean product over the
    m_l pairs of lag l. Without missing places it is n (n + 2) Σ r_l² / (n - l) with the usual r_l = Σ z_i z_{i+l} / Σ z_i².
    """
    from scipy.special import gammaincc

    order = np.argsort(t, kind="stable")
    t, z, used = t[order], z[order], used[order] & np.isfinite(z[order])
    n = int(np.count_nonzero(used))
    if n < LEAST:
        return None
    lags = min(lags, n // PER_LAG)
    place = _places(t, lags)
    sequence = np.full(int(place[-1]) + 1, np.nan)
    sequence[place[used]] = z[used]
    sums, powers, pairs = _products(sequence, lags)
    power = float(np.mean(sequence[place[used]] ** 2))
    if not powers.min() > 0.0:
        return None
    r = sums / powers
    statistic = float((n + 2.0) / n * np.sum(sums**2 / pairs) / power**2)
    interval = float(np.median(np.diff(t)))
    p = float(gammaincc(0.5 * lags, 0.5 * statistic))
    return Whiteness(r, 1.959964 / np.sqrt(pairs), interval, n, deweighted, statistic, p)


def whiteness_series(solution: Solution) -> dict[str, dict[str, Whiteness]]:
    """Whiteness by sensor and component of every measurement with enough innovations; assumptions are left out."""
    a = solution.aids
    out: dict[str, dict[str, Whiteness]] = {}
    for sensor in (str(s) for s in np.unique(a["sensor"])):
        if assumed(sensor):
            continue
        mine = (a["sensor"] == sensor) & (a["reason"] != "start")
        names = a["component"][mine]
        for component in dict.fromkeys(names.tolist()):
            rows = np.flatnonzero(mine)[names == component]
            status = a["status"][rows]
            sd = a["innovation_sd"][rows]
            with np.errstate(divide="ignore", invalid="ignore"):
                z = np.where(sd > 0.0, a["innovation"][rows] / sd, np.nan)
            lowered = status == "deweighted"
            found = whiteness(a["t"][rows], z, (status == "fused") | lowered, int(np.count_nonzero(lowered)))
            if found is not None:
                out.setdefault(sensor, {})[str(component)] = found
    return out


def whiteness_table(series: dict[str, dict[str, Whiteness]]) -> dict[str, dict[str, dict[str, Any]]]:
    """The same in numbers for ``summary.json``: first lag with its 95 % limit, statistic over all lags, p and verdict."""
    return {
        sensor: {
            component: {
                "lag1": float(w.r[0]), "limit1": float(w.band[0]), "n": w.n, "deweighted": w.deweighted, "lags": len(w.r),
                "statistic": w.statistic, "p": w.p, "lasting": w.lasting, "verdict": w.verdict,
            }
            for component, w in components.items()
        }
        for sensor, components in series.items()
    }  # fmt: skip
