"""Residuals of a vehicle's model against its IMU, whitened, and when they alarm: the detectors J11 to J16. It names nothing.

J11-J13 compare specific force, J14-J16 angular rate (theory.md §5.4, theory-amendments.md 2, 4, 5) in blocks of a hundredth of a second.
Biases are the filter's of 5 s before, held while an alarm is pending. The chain of a force is its offset b_F, a walk; that of a moment is
the rate and the offset b_M. Its innovations, over what they come to in this flight and less what follows from the one before, go into a
GLR over windows of 1 to 512 blocks. Its threshold is that of a rate of false alarms, raised by what the statistic usually comes to, as
for the bank of `haltere.diagnosis.inertial`: one stretch late, so that a fault does not raise its own.
"""

from __future__ import annotations

import math
from typing import Any

from haltere._jit import constant, jit, where
from haltere.aids.air import wind_n
from haltere.core.rotation import Vec, dcm, tmat_vec
from haltere.diagnosis.drifts import LASTS, MEAN, forget_means, lasting, shift_means, take_means, walk_of
from haltere.diagnosis.stand_in import across, density_of_noise, mark_before, offset_variance
from haltere.filter import usual
from haltere.filter.windows import empty, take
from haltere.strapdown.pairs import LATELY, MARKS, MATCHED
from haltere.strapdown.propagate import gusts

__all__ = [
    "BLOCK",
    "CALM_ENOUGH",
    "STEPS_TOO",
    "calm_again",
    "change",
    "contradicted",
    "gather",
    "hinted",
    "listen",
    "restart",
    "sector",
    "shift_bias",
    "vouch",
    "would_show",
    "yaw",
]

#: A block, and time between marks of the past [s].
BLOCK, MARK = 0.01, 0.25
#: Biases are held for so long [s]; blocks until a chain is known; time in the air before [s].
HELD, WARM, AIRBORNE = 5.0, 200, 2.0
#: A moment's offset walks by its 1 sigma in this time [s]; 1 sigma of one that begins anew, of a force and of a moment, in its own.
WALK, ANEW, ANEW_MOMENT = 5.0, 10.0, 30.0
#: Memory of what innovations come to, and of the noise of a block, in blocks; how far a lone one may move it.
LEARN, NOISE, LONE = 2000.0, 500.0, 9.0
#: And the shortest of the first, at the beginning.
EARLY_LEARN = 100.0
#: How fast the noise of a chain follows the flight, a part a block, at first and later; its bounds, over the vehicle file's.
QUICK, SETTLED, LEAST_SCALE, MOST_SCALE = 0.2, 0.02, 0.01, 4.0
#: How many times as often as its windows alone a rate's detector passes a level without a fault, steps that are matched added: 1.35 to
#: 1.6 for chains of gain 0.3 to 0.08, simulated with 3e7 white innovations each.
STEPS_TOO = 1.5
#: Most correlation of neighbours that is taken out; most of a step that a chain follows a block.
MOST_RHO, MOST_GAIN = 0.9, 0.95
#: Part of its threshold at which a force is looked at: what is made of it has a test of its own (`haltere.diagnosis.model_faults`).
LOOK = 0.5
#: What is left of the largest moment of late, a block.
HARD_FOR = 0.98
#: Forces are compared in the wind of so long ago [s].
LAG = 1.0
#: For so long [s] after a trial of forces that came to nothing the wind of before its end is that before a change.
HOLDS = 0.3
#: Memory of gusts [s].
STIR = 20.0
#: For so long [s] after a verdict on forces they are held against no accelerometer.
FOLLOWS = 5.0
#: Least part of the gusts expected that are taken for there.
CALMEST = 0.2
#: And the most of them with which forces are held against an accelerometer.
CALM_ENOUGH = 0.4
#: Of a step's squares, the part that the windows find; sigmas for a power of 99 %.
FOUND, POWER = 0.6, 2.33
#: An onset of the bank of signatures is on a grid of so many seconds; an alarm of the pair is that of a fault if it came so long after.
GRID, HINTED = 0.25, 1.0
#: And a fault that it would show must have shown within this time.
SHOWS = 0.5
#: Rotors and gyro agree if no detector of theirs alarmed for so long [s].
AGREED = 5.0
FORCES, AXES = constant(3), constant(6)


@jit
def calm_again(s: Any, i: int) -> None:
    """Begin the chain of a pair anew: whatever its offset is now is what it is compared with."""
    p = s.pairs[0]
    v = offset_variance(s, i) * (ANEW * ANEW if i < FORCES else ANEW_MOMENT * ANEW_MOMENT)
    p.P[i, 0], p.P[i, 1], p.P[i, 2] = v if i < FORCES else 1.0, 0.0, v
    p.z[i], p.t_alarm[i] = 0.0, 0.0
    if i < FORCES:
        p.P[i, 2], p.drift[i] = lasting(s, i), 0.0
    empty(p.w[i])
    if i >= FORCES:
        p.n_matched[i - FORCES] = 0


@jit
def shift_bias(s: Any, i: int, change: float) -> None:
    """Let residuals of a pair be free of a bias that is larger by ``change``; levels are those of the biases in use."""
    p = s.pairs[0]
    p.bias[i] += change
    p.level[i] -= change
    p.before[i] -= change
    for k in range(MARKS):
        p.m_level[k, i] -= change
    if i < FORCES:
        shift_means(p, i, change)
    else:
        for k in range(LATELY):
            p.lately[k, i - FORCES] -= change


@jit
def gather(s: Any, prm: Any, w: Vec, f: Vec, dt: float) -> bool:
    """Take a raw sample; True at the end of a block, when `listen` has something to hear."""
    p = s.pairs[0]
    if p.flying == 0 or s.rotor_known == 0 or prm.diagnosis_vehicle == 0.0:
        if p.n_blocks > 0 or p.span > 0.0:
            restart(s)
        return False
    if s.t >= p.t_bias and p.t_first == 0.0:
        use_bias(s)
    for i in range(3):
        p.total[i] += (f[0], f[1], f[2])[i] - p.bias[i] - p.f[i]
        p.total[3 + i] += (w[0], w[1], w[2])[i] - p.bias[3 + i] - p.turn[i]
    p.n += 1.0
    p.span += dt
    return p.span >= BLOCK - 0.4 * dt


@jit
def use_bias(s: Any) -> None:
    """Go on with the biases of `HELD` before; levels are those of the biases in use."""
    p = s.pairs[0]
    begins = p.t_bias < 0.0
    p.t_bias = s.t + HELD
    for i in range(AXES):
        new = s.ba[i] if i < FORCES else s.bg[i - 3]
        used = new if begins else p.next[i]
        p.next[i] = new
        shift_bias(s, i, used - p.bias[i])


@jit
def restart(s: Any) -> None:
    """Forget chains and alarms: on the ground, without rotor speeds, after alignment."""
    p = s.pairs[0]
    p.t_across, p.t_deaf, p.t_dull, p.t_held, p.headings = -1e9, -1e9, -1e9, -1e9, 0
    forget_means(p)
    p.n, p.span, p.t_first, p.t_bias, p.stir, p.calm, p.n_stir, p.n_blocks, p.trial = 0.0, 0.0, 0.0, -1e9, 1.0, 1.0, 0.0, 0, 0
    p.hard = 0.0
    p.out, p.t_healed = s.compass.out, -1e9
    p.healed_out = s.bank[0].healed if len(s.bank) > 0 else 0
    for i in range(6):
        p.total[i], p.drift[i], p.level[i], p.told_size[i], p.t_hint[i] = 0.0, 0.0, 0.0, 0.0, -1e9
        calm_again(s, i)
    for i in range(3):
        p.t_step[i] = -1e9
    p.n_lately, p.lag = 0, -1
    for k in range(MARKS):
        p.m_t[k] = -1e9


@jit
def chain(s: Any, i: int, y: float, dt: float) -> float:
    """Take a block's residual into the chain of a pair; the innovation."""
    p = s.pairs[0]
    q = offset_variance(s, i) / WALK * dt * p.scale[i]
    if i < FORCES:  # its drift is what it is off by for a second
        keep = 1.0 - dt / LASTS
        p.drift[i] *= keep
        p.P[i, 0] += walk_of(s, i) * dt
        p.P[i, 1] *= keep
        p.P[i, 2] = keep * keep * p.P[i, 2] + lasting(s, i) * (1.0 - keep * keep)
        S = p.P[i, 0] + 2.0 * p.P[i, 1] + p.P[i, 2] + p.r[i]
        k, g = (p.P[i, 0] + p.P[i, 1]) / S, (p.P[i, 1] + p.P[i, 2]) / S
        e = y - p.level[i] - p.drift[i]
        p.level[i] += k * e
        p.drift[i] += g * e
        p.P[i, 0] -= k * k * S
        p.P[i, 1] -= k * g * S
        p.P[i, 2] -= g * g * S
    else:
        p.level[i] += dt * p.drift[i]
        p.P[i, 0] += dt * (2.0 * p.P[i, 1] + dt * p.P[i, 2]) + density_of_noise(s, i) * dt * p.scale[i]
        p.P[i, 1] += dt * p.P[i, 2]
        p.P[i, 2] += q
        S = p.P[i, 0] + p.r[i]
        k, g = p.P[i, 0] / S, p.P[i, 1] / S
        e = y - p.level[i]
        p.level[i] += k * e
        p.drift[i] += g * e
        p.P[i, 2] -= g * p.P[i, 1]
        p.P[i, 1] *= 1.0 - k
        p.P[i, 0] *= 1.0 - k
    p.sd[i] = math.sqrt(S)
    return e


@jit
def size_of(p: Any, i: int, rho: float, dt: float) -> float:
    """Size of what alarms: a force, or a moment from the innovations it makes in a settled chain."""
    w = p.w[i]
    e = w.average[0] * math.sqrt((1.0 + rho) / (1.0 - rho) * p.c0[i])
    if i >= FORCES:
        return float(e * p.P[i, 0] / p.r[i] / dt)  # a settled chain follows with its gain, P/r, of the innovation a block
    k = mark_before(p, p.t_lately[(p.n_lately - 1) % LATELY] - w.window * BLOCK - 2.0 * BLOCK)
    found = p.level[i] + p.drift[i] - p.m_level[k, i] if k >= 0 else e  # soon it is in the innovations, later in the chain
    return float(e if abs(e) > abs(found) else found)


@jit
def stepped(p: Any, a: int, x: float, gain: float, rho: float) -> tuple[float, float, int]:
    """Take a whitened innovation of rate axis ``a``: how well a step of the rate explains the last of them, its size, blocks since then.

    A chain follows a step with its gain K, so that innovations are the step times (1 - K)^n, and whitened ones s_n - ρ s_{n-1} of that.
    For every block of the last ones as the step's, num²/den as in `haltere.filter.signatures`; the size is in sigma of an innovation.
    """
    n = p.n_matched[a]
    p.n_matched[a] = n + 1
    k = n % MATCHED
    p.expected[a, k], p.agrees[a, k], p.energy[a, k] = 1.0, 0.0, 0.0
    white = 1.0 / math.sqrt(1.0 - rho * rho)
    best, size, age = 0.0, 0.0, 0
    for j in range(min(n + 1, MATCHED)):
        e = p.expected[a, j] * (white if j == k else white * (1.0 - rho / (1.0 - gain)))
        p.expected[a, j] *= 1.0 - gain
        p.agrees[a, j] += e * x
        p.energy[a, j] += e * e
        level = p.agrees[a, j] * p.agrees[a, j] / p.energy[a, j]
        if level > best:
            best, size, age = level, p.agrees[a, j] / p.energy[a, j], (k - j) % MATCHED + 1
    return best, size, age


@jit
def listen(s: Any, prm: Any) -> bool:
    """Take the block that has ended into every detector; True while an alarm is pending."""
    p = s.pairs[0]
    dt, n = p.span, p.n
    p.n, p.span = 0.0, 0.0
    first = p.n_blocks == 0
    p.n_blocks += 1
    learns = p.t_first == 0.0
    blown = by_lag(s)
    change = (dot_row(p, 0, blown), dot_row(p, 1, blown), dot_row(p, 2, blown))
    if learns and p.n_blocks > WARM:
        take_means(s, (p.total[0] / n + change[0], p.total[1] / n + change[1], p.total[2] / n + change[2]))
    for i in range(AXES):
        y = p.total[i] / n
        p.total[i], p.residual[i] = 0.0, y
        if i < FORCES:
            y += change[i]
        if first:
            p.level[i] = y
            p.before[i] = y
            if p.r[i] <= 0.0:
                p.r[i] = 1e-3 if i >= FORCES else 0.3
                p.c0[i], p.c1[i], p.scale[i], p.n_learnt[i] = 2.0 * p.r[i], 0.0, 1.0, 0.0
            continue
        d = y - p.before[i]
        p.before[i] = y
        p.r[i] += (min(0.5 * d * d, LONE * p.r[i]) - p.r[i]) / NOISE
        z = chain(s, i, y, dt)
        if p.n_blocks < WARM // 2:
            continue
        if learns:
            p.n_learnt[i] = min(p.n_learnt[i] + 1.0, LEARN)
            rate = 1.0 / max(p.n_learnt[i], EARLY_LEARN)
            x = min(max(z * p.z[i], -LONE * p.c0[i]), LONE * p.c0[i])
            p.c0[i] += rate * (min(z * z, LONE * p.c0[i]) - p.c0[i])
            p.c1[i] += rate * (x - p.c1[i])
            if i >= FORCES:  # neighbours that are alike: the chain is too slow for what the model leaves; that alternate: too quick
                quick = min(QUICK, max(SETTLED, EARLY_LEARN * rate * QUICK))
                p.scale[i] = min(max(p.scale[i] * (1.0 + quick * x / p.c0[i]), LEAST_SCALE), MOST_SCALE)
        p.z[i] = z
        rho = min(max(p.c1[i] / p.c0[i], 0.0), MOST_RHO)
        unit, last = z / math.sqrt(p.c0[i]), p.w[i].last[0] if p.w[i].n > 0 else 0.0
        glr = take(p.w[i], (unit, 0.0, 0.0), 1, rho)
        size, window = size_of(p, i, rho, dt), p.w[i].window
        enough, sign = abs(size) > (prm.diagnosis_force if i < FORCES else prm.diagnosis_moment), math.copysign(1.0, size)
        if i >= FORCES:
            gain = p.P[i, 0] / p.r[i]
            level, step, age = stepped(p, i - FORCES, (unit - rho * last) / math.sqrt(1.0 - rho * rho), min(gain, MOST_GAIN), rho)
            if level > glr:
                glr, window, enough = level, age, abs(step) * math.sqrt(p.c0[i]) > prm.diagnosis_gyro
                sign = math.copysign(1.0, step)
        over = glr / prm.diagnosis_pair_threshold
        deaf = i < FORCES and p.t_first == 0.0 and s.t < p.t_deaf
        if not deaf:
            p.peak[i] = max(p.peak[i], over)
        if p.on[3 + i if i < FORCES else i - 3] == 1 or p.n_blocks < WARM or s.t - p.t_flying < AIRBORNE:
            continue
        if deaf:
            continue
        factor = usual.raised(p, i)
        if over > factor and enough and (p.t_alarm[i] == 0.0 or p.t_hint[i] < p.t_alarm[i]):
            p.t_hint[i], p.hint_sign[i] = s.t, sign  # a witness is one at its full threshold only
        factor *= LOOK if i < FORCES and s.t >= p.t_dull else 1.0
        if over > factor and p.t_alarm[i] == 0.0 and enough:
            p.t_alarm[i], p.told_size[i] = s.t, size
            if p.t_first == 0.0:
                p.t_first, p.onset = s.t, s.t - window * BLOCK
                p.mean_n, p.mean_T = 0.0, 0.0
                p.statistic, p.threshold = glr, factor * prm.diagnosis_pair_threshold
                p.mark = mark_before(p, p.onset - 2.0 * BLOCK)
                p.healed = s.bank[0].healed if len(s.bank) > 0 else 0
    if p.t_first != 0.0:
        p.mean_n += 1.0
        p.mean_T += (p.residual[2] + change[2] - p.mean_T) / p.mean_n
    p.hard *= HARD_FOR
    for i in range(FORCES):
        p.hard = max(p.hard, abs(p.m[i]))
    k = p.n_lately % LATELY
    for i in range(FORCES):
        p.lately[k, i] = p.residual[FORCES + i]
    p.t_lately[k] = s.t
    p.n_lately += 1
    usual.learn(p, s.t)
    if s.t >= p.t_mark and p.t_first == 0.0 and p.n_blocks > WARM // 2:
        remember(s, prm)
    return p.t_first != 0.0


@jit
def dot_row(p: Any, i: int, v: Vec) -> float:
    """What a velocity through the air more makes of the force along an axis [m/s^2]."""
    return float(p.by_v[0, i, 0] * v[0] + p.by_v[0, i, 1] * v[1] + p.by_v[0, i, 2] * v[2])


@jit
def by_lag(s: Any) -> Vec:
    """Wind of a while ago less that of now, body frame [m/s]: an estimate that follows at once would hide a change of force."""
    p = s.pairs[0]
    held = s.t < p.t_held + LAG
    if p.lag < 0 and not held:
        return (0.0, 0.0, 0.0)
    W = wind_n(s)
    n, e = (p.wind_held[0], p.wind_held[1]) if held else (p.m_wind[p.lag, 0], p.m_wind[p.lag, 1])
    return tmat_vec(dcm((s.q[0], s.q[1], s.q[2], s.q[3])), (n - W[0], e - W[1], 0.0))


@jit
def yaw(s: Any) -> float:
    """Heading [rad]."""
    C = dcm((s.q[0], s.q[1], s.q[2], s.q[3]))
    return math.atan2(C[1][0], C[0][0])


@jit
def sector(heading: float) -> int:
    """Which of eight sectors a heading is in."""
    return math.floor((heading + math.pi) / (0.25 * math.pi)) % 8


@jit
def remember(s: Any, prm: Any) -> None:
    """Mark the past: what the chains are now."""
    p = s.pairs[0]
    p.t_mark = s.t + MARK
    k = p.head
    p.head = (k + 1) % MARKS
    p.m_t[k] = s.t
    for i in range(6):
        p.m_level[k, i], p.m_drift[k, i], p.m_var[k, i] = p.level[i], p.drift[i], p.P[i, 0]
    for i in range(3):
        p.m_turn[k, i] = p.turn[i]
    W = wind_n(s)
    p.m_wind[k, 0], p.m_wind[k, 1], p.m_yaw[k] = W[0], W[1], yaw(s)
    if s.t < p.t_held + HOLDS:  # a fault that came just before has not bent it
        p.m_wind[k, 0], p.m_wind[k, 1] = p.wind_held[0], p.wind_held[1]
    p.headings |= 1 << sector(p.m_yaw[k])
    p.lag = mark_before(p, s.t - LAG)
    if p.lag >= 0 and p.m_t[p.lag] < p.t_across:  # levels begin anew with a verdict: in the wind of then
        p.lag = -1
    if len(s.wind) > 0 and not across(s):
        gust, _ = gusts(s, prm)
        blown = 0.0
        for i in range(2):
            blown += 0.5 * (s.wind[i] - s.steady[i]) * (s.wind[i] - s.steady[i])
        p.n_stir = min(p.n_stir + 1.0, STIR / MARK)
        p.stir += (blown / (gust * gust) - p.stir) / p.n_stir
        p.calm = math.sqrt(min(max(p.stir, CALMEST * CALMEST), 1.0))


@jit
def change(s: Any, i: int) -> float:
    """What the level of a pair has changed by since before the alarm: a force [m/s^2], or a rate that the model did not make [rad/s]."""
    p = s.pairs[0]
    k = p.mark
    if k < 0:
        return math.nan
    return float(p.level[i] - p.m_level[k, i] - (p.m_drift[k, i] * (s.t - p.m_t[k]) if i >= FORCES else 0.0))


@jit
def would_show(s: Any, prm: Any, i: int, size: float) -> bool:
    """Whether a step of a pair [m/s^2, rad/s] would have set off its detector, with a power of 99 %, if it came while that listened.

    A chain of a rate follows a step with its gain K, so that its innovations are size (1 - K)^n, with the sum of squares size²/(2K - K²).
    Of a force a second says size² over the variance of a mean over it.
    """
    p = s.pairs[0]
    if p.flying == 0 or p.n_blocks < WARM or s.t - p.t_flying < AIRBORNE or p.sd[i] <= 0.0:
        return False
    root = math.sqrt(prm.diagnosis_pair_threshold * usual.raised(p, i)) + POWER
    if i < FORCES:
        return FOUND * size * size / (p.r[i] * BLOCK + MEAN * lasting(s, i) + p.P[i, 0]) > root * root
    K = p.P[i, 0] / (p.sd[i] * p.sd[i])
    rho = min(max(p.c1[i] / p.c0[i], 0.0), MOST_RHO)
    white = p.c0[i] * (1.0 + rho) / (1.0 - rho)
    return FOUND * size * size / (white * (2.0 * K - K * K)) > root * root


@jit
def _hinted(s: Any, g: int, onset: float, size: float) -> float:
    p = s.pairs[0]
    if g >= FORCES and p.calm > CALM_ENOUGH:
        return -1.0
    i = 3 + g if g < FORCES else g - 3
    t = p.t_hint[i]
    return float(t) if t > onset - GRID and t < onset + GRID + HINTED and size * p.hint_sign[i] >= 0.0 else -1.0


@jit
def _no_hint(s: Any, g: int, onset: float, size: float) -> float:
    return -1.0


#: When the pair of gyro axis ``g`` = 0 to 2, or of accelerometer axis g - 3, alarmed for a fault of the sign of ``size`` (0: of any) that
#: began at ``onset``; -1: never.
hinted = where("pairs", _hinted, _no_hint)


@jit
def _contradicted(s: Any, prm: Any, g: int, size: float, onset: float) -> bool:
    if prm.diagnosis_vehicle == 0.0:
        return False
    p = s.pairs[0]
    i = 3 + g if g < FORCES else g - 3
    if s.t < onset + SHOWS or onset < p.t_calm + 2.0 or p.standing != 0:
        return False
    if i < FORCES and (s.t - p.t_across < FOLLOWS or p.calm > CALM_ENOUGH):
        return False
    return would_show(s, prm, i, size) and hinted(s, g, onset, 0.0) < 0.0


@jit
def _uncontradicted(s: Any, prm: Any, g: int, size: float, onset: float) -> bool:
    return False


#: Whether a step of such an axis would have set off the detector of its pair, and has not; a force only says so in still air.
contradicted = where("pairs", _contradicted, _uncontradicted)


@jit
def _vouch(s: Any) -> bool:
    p = s.pairs[0]
    for i in range(FORCES, 6):
        if s.t - p.t_hint[i] < AGREED:
            return False
    return bool(p.flying == 1 and p.standing == 0 and p.n_blocks >= WARM and s.t - p.t_flying > AIRBORNE)


@jit
def _no_vouch(s: Any) -> bool:
    return False


#: Whether the rotors agree with the gyro for some seconds: then a small fault of what else is measured is believed, too.
vouch = where("pairs", _vouch, _no_vouch)
