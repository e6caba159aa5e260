"""How far an estimated wind is to be believed, in a word and its reasons, and the table ``wind`` of a summary. It estimates no wind."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.flight.log import FlightLog
from haltere.flight.solution import Solution
from haltere.metrics.attitude import euler
from haltere.metrics.wind import (
    BLOCK,
    SECTORS,
    Difference,
    WindSeries,
    blocks,
    components,
    difference,
    direction_from,
    direction_sd,
    profile,
    rose,
    turbulence,
    wind_series,
)  # fmt: skip

__all__ = ["WORDS", "Quality", "quality", "wind_table"]

FloatArray = NDArray[np.float64]
DEG = 180.0 / math.pi
#: The verdicts, best first.
WORDS = ("good", "usable", "poor", "not observable")
#: Sensors of the aid records that feel the air, and what they are in words.
AIR = {"drag": "drag", "airdata": "air data", "wind": "a given wind"}
#: 1 sigma of a component [m/s] up to which a wind is good, and usable; and the share of its prior above which nothing was learned.
GOOD, USABLE, UNLEARNED = 0.5, 1.0, 0.7
#: Turn of the heading [rad] and change of the velocity [m/s], 5th to 95th percentile, from which a flight counts as excited.
TURNED, SPED = math.radians(45.0), 2.0
#: An estimate that moved by so many times what it learned is not to be believed.
ASTRAY = 4.0
#: Mean normalised innovation squared above which what is stated is too sure, and far too sure.
SURE, FAR_TOO_SURE = 1.5, 3.0
#: Coefficients that the wind hangs on and their names in words.
SCALES = {"drag_mu": "drag coefficient", "airspeed_scale": "airspeed scale"}


@dataclass(frozen=True)
class Quality:
    """A verdict of `WORDS` and the reasons for it."""

    word: str
    why: tuple[str, ...]


class _Judge:
    """Collects reasons; the worst verdict stands."""

    def __init__(self) -> None:
        self.level, self.why = 0, list[str]()

    def say(self, reason: str, level: int = 0) -> None:
        self.why.append(reason)
        self.level = max(self.level, level)

    @property
    def quality(self) -> Quality:
        return Quality(WORDS[self.level], tuple(self.why))


def quality(solution: Solution, flight: FlightLog, w: WindSeries) -> Quality:
    """What the stated uncertainty, the motion and the innovations say of a wind; no reference is read.

    Parameters
    ----------
    solution
        With its summary's ``nis``.
    flight
        The flight it is of.
    w
        Its wind, as `haltere.metrics.wind.wind_series` gives it.
    """
    judge = _Judge()
    if not w.flying.any():
        judge.say("the vehicle was not in flight, as far as the log tells", 3)
        return judge.quality
    sensors = [s for s in AIR if np.any((solution.aids["sensor"] == s) & (solution.aids["status"] != "rejected"))]
    if not sensors and solution.config.estimator == "fault-tolerant":
        judge.say("felt through the force of the vehicle's model, which leaves no innovations to judge it by", 1)
        return judge.quality
    if not sensors:
        judge.say("nothing that feels the air was let in: the wind is what it was assumed to be", 3)
        return judge.quality
    _stated(judge, w)
    learned = _learned(judge, solution, w)
    _moved(judge, solution, w, sensors, learned)
    _innovations(judge, solution, sensors)
    if "wind" in sensors:
        judge.say("a wind given from outside was let in, so this is not independent of it")
    return judge.quality


def _stated(judge: _Judge, w: WindSeries) -> None:
    """What the filter states, over the second half of the flight and against its start."""
    rows = np.flatnonzero(w.flying)
    sd = np.sqrt(np.mean(w.sd**2, axis=1))
    late = float(np.median(sd[rows[len(rows) // 2 :]]))
    if not math.isfinite(late):
        judge.say("no uncertainty of it is stated", 2)
        return
    first = float(np.nanmax(sd[w.t <= w.t[0] + 1.0]))
    level = 3 if late > UNLEARNED * first else 0 if late <= GOOD else 1 if late <= USABLE else 2
    judge.say(f"1σ of a component is {late:.2g} m/s over the second half of the flight, {first:.2g} m/s at the start", level)
    if not np.isfinite(w.direction[rows]).any():
        judge.say("the wind was weaker than its uncertainty all the time, so it has no direction")


def _moved(judge: _Judge, solution: Solution, w: WindSeries, sensors: list[str], learned: bool) -> None:
    """Whether the flight told apart what looks the same at one heading and one air speed; ``learned`` is that the drag was."""
    yaw = np.unwrap(euler(solution.vector("q", "wxyz"))[:, 2])[w.flying]
    turn = float(np.ptp(np.percentile(yaw, [5.0, 95.0])))
    change = 0.0
    if "vel_n" in solution:  # of the vehicle, not of the estimated air velocity, which changes with the wind's own error
        change = float(np.max(np.ptp(np.percentile(solution.vector("vel", "ne")[w.flying], [5.0, 95.0], axis=0), axis=0)))
    moved = f"the heading turned by {DEG * turn:.0f}°, the velocity changed by {change:.1f} m/s"
    if "airdata" in sensors:
        if turn < TURNED:
            judge.say(f"{moved}: at one heading the wind along it and the scale of the air speed are one", 2)
        else:
            judge.say(f"{moved}: the wind triangle was seen from several sides")
    elif "drag" in sensors:
        sped = change >= SPED or learned
        if turn < TURNED and not sped:
            judge.say(f"{moved}: wind, accelerometer offset and drag are not told apart, so its 1σ rests on what was assumed of those", 1)
        elif turn < TURNED:
            judge.say(f"{moved}: drag was told from wind, an accelerometer offset from wind was not", 1)
        elif not sped:
            judge.say(f"{moved}: an accelerometer offset was told from wind, but the size of the wind hangs on the assumed drag", 1)
        else:
            judge.say(f"{moved}: enough to tell wind, drag and accelerometer offsets apart")


def _learned(judge: _Judge, solution: Solution, w: WindSeries) -> bool:
    """What became of the uncertainty of the coefficients; whether the drag was learned."""
    drag = False
    last = int(np.flatnonzero(w.flying)[-1])
    for name, word in SCALES.items():
        if name not in solution or f"sd_{name}" not in solution:
            continue
        relative = solution[f"sd_{name}"] / np.abs(solution[name])
        before, after = float(relative[0]), float(relative[last])
        if not (math.isfinite(before) and math.isfinite(after) and before > 0.0):
            continue
        said = f"the {word} went from ±{100.0 * before:.2g} % to ±{100.0 * after:.2g} %"
        # An estimate moves by what it learned: the variances' difference. More is no learning but a drift.
        shift = abs(math.log(abs(float(solution[name][last] / solution[name][0]))))
        if shift > ASTRAY * math.sqrt(max(before**2 - after**2, (0.3 * before) ** 2)):
            judge.say(f"{said} but moved by a factor of {math.exp(shift):.2g}, more than that says: it is not to be believed", 2)
        elif after > UNLEARNED * before:
            judge.say(f"{said}: not learned in this flight, and the air speed scales with it", 1)
        else:
            drag |= name == "drag_mu"
            judge.say(f"{said} (1σ)")
    return drag


def _innovations(judge: _Judge, solution: Solution, sensors: list[str]) -> None:
    """Whether what feels the air fits as well as stated."""
    for sensor in sensors:
        mean = solution.summary.get("nis", {}).get(sensor, {}).get("mean")
        if mean is None:
            continue
        said = f"innovations of {AIR[sensor]} are {math.sqrt(mean):.2g} times what is stated of them"
        if mean > FAR_TOO_SURE:
            judge.say(f"{said}: the stated 1σ is not to be believed", 2)
        elif mean > SURE:
            judge.say(f"{said}: the stated 1σ is too small", 1)
        elif mean < 0.25:
            judge.say(f"{said}: its noise is set larger than this flight shows")


def _axes(values: FloatArray) -> dict[str, float]:
    return {"n": float(values[0]), "e": float(values[1])}


def _against(d: Difference) -> dict[str, Any]:
    out: dict[str, Any] = {"n": d.n, "bias": _axes(d.bias), "sd": _axes(d.sd), "rms": _axes(d.rms), "direction_deg": DEG * d.turn}
    if d.means is not None:
        out["means"] = {"seconds": BLOCK, "n": d.means[2], "bias": _axes(d.means[0]), "sd": _axes(d.means[1])}
    return out


def wind_table(solution: Solution, flight: FlightLog) -> dict[str, Any]:
    """The table ``wind`` of a summary, over the rows in flight and settled; empty where the solution has no wind.

    References are read here, after the estimation, for comparison alone. Directions are azimuths the wind comes from [deg]; components are
    velocities of the air over ground [m/s].
    """
    w = wind_series(solution, flight)
    if w is None:
        return {}
    said = quality(solution, flight, w)
    out: dict[str, Any] = {"verdict": said.word, "why": list(said.why), "convention": "components blow to, directions come from"}
    weight = w.weight
    total = float(weight.sum())
    out["seconds"] = total
    if total <= 0.0:
        return out
    share = weight / total
    use = weight > 0.0
    out["settled_at"] = float(w.t[np.argmax(use)])
    mean = share[use] @ w.wind[use]
    sd = share[use] @ w.sd[use]
    n, e, sd_n, sd_e = (np.array(v) for v in (*mean, *sd))
    out["mean"] = {
        "n": float(n), "e": float(e), "speed": float(np.hypot(n, e)), "from_deg": DEG * float(direction_from(n, e)),
        "sd": _axes(sd), "sd_speed": float(share[use] @ w.speed_sd[use]), "sd_from_deg": DEG * float(direction_sd(n, e, sd_n, sd_e)),
    }  # fmt: skip
    if "d" in components(solution):
        out["mean"]["d"] = float(share[use] @ solution["wind_d"][use])
    k = int(np.argmax(np.where(use, w.speed, -1.0)))
    out["strongest"] = {"t": float(w.t[k]), "speed": float(w.speed[k]), "sd": float(w.speed_sd[k])}
    out["turbulence_intensity"] = turbulence(w.wind[use], weight[use])
    out["means"] = [
        {"t": b.t, "n": b.wind[0], "e": b.wind[1], "speed": b.speed, "from_deg": DEG * b.direction, "sd": b.sd, "turbulence": b.turbulence}
        for b in blocks(w)
    ]
    r = rose(w)
    if r is not None:
        centres = [360.0 * s / SECTORS for s in range(SECTORS)]
        out["rose"] = {"from_deg": centres, "speed_from": r.bounds.tolist(), "share": r.share.tolist(), "no_direction": r.calm}
    p = profile(w)
    if p is not None:
        names = ("height", "speed", "spread", "sd", "seconds")
        out["profile"] = {name: getattr(p, name).tolist() for name in names} | {"law": p.law}
    found = {name: difference(w, flight[name]) for name in ("truth", "onboard") if name in flight and len(flight[name])}
    out["against"] = {name: _against(d) for name, d in found.items() if d is not None}
    return out
