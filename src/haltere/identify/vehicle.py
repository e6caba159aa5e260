"""A vehicle's forces and moments from its flights, linear in lumped constants, with what they are worth. It draws and writes nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError, UsageError, nearest
from haltere.estimators.lumped import Lumped
from haltere.flight.config import Config
from haltere.flight.log import FlightLog
from haltere.flight.vehicle import Vehicle, load_vehicle
from haltere.identify.checks import Check, check, with_residuals
from haltere.identify.drag import LEAST_SPREAD
from haltere.identify.fitting import WIND_SD, Result, fit
from haltere.identify.instrument import Instrumented, instrumented
from haltere.identify.motor import FULL, Motor, commands_of, fit_motor, modelled
from haltere.identify.prepare import Motion, Samples, motion, samples
from haltere.identify.rotors import MOMENT_RATE, Layout, Speeds, find_layout, speeds_of
from haltere.identify.track import FORCE, MOMENT, Track, Windows, columns, flying, force_windows, moment_windows, track
from haltere.vehicle.regressors import AXES, COLUMNS, NAMES, PRESETS

__all__ = ["VehicleIdentification", "identify_vehicle"]

FloatArray = NDArray[np.float64]

#: Least time in the air of a flight [s]; mean wind of air said to be still [m/s]; offset of the force along z before the flight [m/s^2].
LEAST, STILL_SD, OFFSET_SD = 3.0, 0.02, 0.1
#: Spread of the force along z below which thrust is said not to change [m/s^2].
LEAST_THRUST_SPREAD = 0.5
#: Ratio (Izz - Iyy)/Ixx of a flat vehicle before the flights, and its 1 sigma.
FLAT, FLAT_SD = 0.9, 0.2
#: Sigma of a constant below which it is said not to be told.
TOLD = 2.0


@dataclass
class VehicleIdentification:
    """What flights tell of a vehicle.

    Attributes
    ----------
    lumped
        The model.
    vehicle
        The vehicle file it was begun with; None where none was given.
    layout
        What each rotor does.
    plain
        Constants by ordinary least squares (6, 7), of moments and thrust, for comparison.
    condition
        Condition number of each axis' columns (6,).
    told
        Constants more than two sigma away from zero (6, 7).
    across
        The fit of the forces across the thrust axis, with the winds.
    arm, arm_sd
        IMU from the centre of gravity [m] (3,).
    checks
        The flights fitted; then flights kept back, or each flight predicted from the others.
    tracks, notes
        What was fitted, and sentences on what was assumed and found.
    motor
        The motor model, where rotor speeds are from commands.
    """

    lumped: Lumped
    vehicle: Vehicle | None
    layout: Layout
    plain: FloatArray
    condition: FloatArray
    told: NDArray[np.bool_]
    across: Result
    arm: FloatArray
    arm_sd: FloatArray
    checks: list[Check]
    tracks: list[Track]
    notes: list[str] = field(default_factory=list)
    motor: Motor | None = None

    @property
    def name(self) -> str:
        """Of the flights."""
        return ", ".join(tr.motion.name for tr in self.tracks)

    def as_vehicle(self) -> Vehicle:
        """The vehicle with this model; constants are per mass and inertia, which flights alone do not tell."""
        v = self.vehicle
        table = self.lumped.table()
        if self.motor is not None:
            table["motor"] = {"full": FULL, "linear": self.motor.a, "tau": self.motor.tau}
            table["motor"] |= {} if np.isnan(self.motor.voltage) else {"voltage": self.motor.voltage}
        if v is None:
            return Vehicle("identified", 1.0, (1.0, 1.0, 1.0, 0.0, 0.0, 0.0), lumped=table)
        return Vehicle(v.name, v.mass, v.inertia, v.rotors, v.drag, v.density, v.battery, table)


def identify_vehicle(
    flights: FlightLog | Sequence[FlightLog],
    preset: str = "full",
    *,
    vehicle: Vehicle | str | Path | None = None,
    validate: FlightLog | Sequence[FlightLog] = (),
    still: bool | None = None,
    instruments: bool = True,
    config: Config | Mapping[str, Any] | str | Path | None = None,
    set: Mapping[str, Any] | None = None,
) -> VehicleIdentification:
    """Force and moment constants of a vehicle from flights with rotor speeds.

    Parameters
    ----------
    flights
        Logs of one vehicle, with rotor speeds at 40 Hz or more; from 8 Hz on the thrust is told.
    preset
        Set of columns: ``full``, ``rate`` or ``literal`` (`haltere.vehicle.regressors`).

    Other Parameters
    ----------------
    vehicle
        Vehicle file, name or `Vehicle` with the geometry: it is checked against the flights.
    validate
        Flights to predict that are not fitted. Without any, each of several flights is predicted from the others.
    still
        Whether the air was still (a hall); by default wind is fitted where the flights move enough to tell it.
    instruments
        Use two readings of the rotor speeds as instruments for each other; else ordinary least squares, too small under noise.
    config, set
        Configuration, as of `haltere.run`.

    Raises
    ------
    HaltereError
        No rotor speeds, too short, or a geometry that the flights contradict: the message says how.
    UsageError
        An unknown preset or key.
    """
    if preset not in PRESETS:
        raise UsageError(f"a preset: {', '.join(PRESETS)}", repr(preset), "--preset", nearest(preset, PRESETS))
    logs = [flights] if isinstance(flights, FlightLog) else list(flights)
    kept = [validate] if isinstance(validate, FlightLog) else list(validate)
    if not logs:
        raise HaltereError("at least one flight", "none", "identify")
    given = vehicle if isinstance(vehicle, Vehicle) or vehicle is None else load_vehicle(vehicle)
    motions = [motion(log.without("onboard", "truth"), config, set, LEAST) for log in logs]
    back = [motion(log.without("onboard", "truth"), config, set, LEAST) for log in kept]
    out = _identified(motions, preset, given, still, instruments)
    model = out.lumped
    out.checks = [check(tr, model, out.arm, True) for tr in out.tracks]
    if back:
        out.checks += [check(_kept(m, out, still), model, out.arm, False) for m in back]
    elif len(motions) > 1:
        for k, m in enumerate(motions):
            rest = _identified([o for i, o in enumerate(motions) if i != k], preset, given, still, instruments)
            out.checks.append(check(_kept(m, rest, still), rest.lumped, rest.arm, False))
    else:
        out.notes.append("one flight: nothing was kept back to test the model on; give more logs, or --validate")
    return out


def _identified(motions: list[Motion], preset: str, given: Vehicle | None, still: bool | None, instruments: bool) -> VehicleIdentification:
    notes = list(dict.fromkeys(note for m in motions for note in m.notes))
    motor = _motor(motions, notes)
    speeds = [_speeds(m, motor) for m in motions]
    for m, s in zip(motions, speeds, strict=True):
        m.air = flying(m, s)
        said = f"{1e3 * s.lag:.1f} ms" if s.lag_told else "not told by the flight, taken for none"
        notes.append(f"{m.name}: lag of the rotor speeds {said} (they explain {100.0 * s.explained:.0f} % of quick roll and pitch)")
        if s.rate < MOMENT_RATE:
            notes.append(f"{m.name}: {s.rate:.0f} rotor speeds a second are too few for moments ({MOMENT_RATE:g} wanted): believe only t")
    windows = [samples(m, FORCE, np.sum(s.mean, axis=1)) for m, s in zip(motions, speeds, strict=True)]
    calm = _calm(windows, still, notes)
    used = PRESETS[preset]
    across_free = np.array([True, True, 3 in used[0], True, True, 3 in used[1]])
    across = fit("lumped", windows, across_free, STILL_SD if calm else WIND_SD)
    tracks = [
        track(m, s, w, part.wind_path if not calm else np.zeros_like(part.wind_path))
        for m, s, w, part in zip(motions, speeds, windows, across.parts, strict=True)
    ]
    layout = _layout(tracks, given)
    notes += layout.notes
    k, cov, plain = np.zeros((6, COLUMNS)), np.zeros((6, COLUMNS, COLUMNS)), np.zeros((6, COLUMNS))
    condition = np.zeros(6)
    arm, arm_sd = _across(across, preset, k, cov, plain)
    weights = (layout.roll, layout.pitch, layout.yaw)
    s1 = float(np.mean(np.concatenate([tr.speeds.mean[tr.use].sum(axis=1) for tr in tracks]))) if preset == "full" else 0.0
    first = [columns(tr, tr.speeds.first, weights, preset == "literal", s1) for tr in tracks]
    second = [columns(tr, tr.speeds.second, weights, preset == "literal", s1) for tr in tracks]
    for axis in range(2, 6):
        found = _fit_axis(axis, used[axis], tracks, first, second, arm, instruments, notes)
        j = np.array(used[axis])
        k[axis, j], plain[axis, j], condition[axis] = found.k, found.plain, found.condition
        cov[axis][np.ix_(j, j)] = found.covariance
        if instruments and not found.instruments:
            notes.append(f"{AXES[axis]}: noise of the rotor speeds swamps what was flown; ordinary least squares, constants too small")
    for axis in range(2):
        condition[axis] = _condition(np.concatenate([tr_w.x for tr_w in (
            force_windows(tr, a, b, axis, used[axis], arm) for tr, a, b in zip(tracks, first, second, strict=True))]))  # fmt: skip
    lumped = Lumped(
        preset, *weights, k, cov, 1.225, np.zeros(6), np.zeros(6), np.zeros(6), (FORCE, MOMENT),
        float(np.median([s.lag for s in speeds])), _valid(tracks), None, s1,
    )  # fmt: skip
    lumped = with_residuals(lumped, tracks, arm)
    told = np.abs(k) > TOLD * lumped.sd
    missing = [NAMES[i][j] for i in range(6) for j in used[i] if not told[i, j] and not (i < 3 and j == len(NAMES[i]) - 1)]
    if missing:
        notes.append(f"not told from none (2 sigma): {', '.join(missing)}; fly faster, climb, and swing about each axis to tell more")
    return VehicleIdentification(lumped, given, layout, plain, condition, told, across, arm, arm_sd, [], tracks, notes, motor)


def _motor(motions: list[Motion], notes: list[str]) -> Motor | None:
    """The motor model, where a flight has no rotor speeds; one for all, since their unit is another."""
    known = [any(c.startswith("speed_") for c in m.flight["rotors"].names) for m in motions if "rotors" in m.flight]
    if len(known) == len(motions) and all(known):
        return None
    motor = fit_motor(motions)
    volts = "" if np.isnan(motor.voltage) else f" at {motor.voltage:.1f} V"
    notes.append(
        f"no rotor speeds: modelled from commands, {100.0 * motor.a:.0f} % of thrust linear in them, lag {1e3 * motor.tau:.0f} ms; "
        f"a full command{volts} counts as {FULL:g} rad/s. They explain {100.0 * motor.explained[0]:.0f} % of the force along z and "
        f"{100.0 * motor.explained[1]:.0f} % of quick roll and pitch; constants are in that unit"
    )
    return motor


def _speeds(m: Motion, motor: Motor | None) -> Speeds:
    """Rotor speeds of a flight, from telemetry or from commands."""
    if motor is None:
        return speeds_of(m)
    values = modelled(m, motor.a, motor.tau)
    return Speeds(values, values, 0.0, True, motor.explained[1], commands_of(m)[2])


def _calm(windows: list[Samples], still: bool | None, notes: list[str]) -> bool:
    """Whether the air is taken for still."""
    if still is not None:
        notes.append("air said to be still" if still else "wind fitted, as asked")
        return still
    spread = float(np.sqrt(np.mean([np.sum(np.var(w.vel_n[:, :2], axis=0)) for w in windows])))
    calm = spread < LEAST_SPREAD
    if calm:
        notes.append(f"velocity varies by {spread:.2f} m/s only: wind cannot be told from drag, and the air is taken for still")
    return calm


def _layout(tracks: list[Track], given: Vehicle | None, signs: tuple[FloatArray, FloatArray] | None = None) -> Layout:
    """What each rotor does, from windows of rate change; anew with the ``signs`` in roll and pitch that were found first."""
    n = tracks[0].speeds.first.shape[1]
    if any(tr.speeds.first.shape[1] != n for tr in tracks):
        raise HaltereError("flights of one vehicle", f"{[tr.speeds.first.shape[1] for tr in tracks]} rotors", "identify")
    geometry = None
    if given is not None and given.rotors:
        if len(given.rotors) != n:
            raise HaltereError(f"a vehicle with {n} rotors, as the log has", f"{len(given.rotors)}", f"vehicle {given.name}")
        position = np.array([r.position for r in given.rotors])
        geometry = (-position[:, 1], position[:, 0], np.array([r.spin for r in given.rotors]))
    blocks = []
    for axis in range(3):
        parts = []
        for tr in tracks:
            w = tr.motion.gyro_b
            cross = w[:, (axis + 1) % 3] * w[:, (axis + 2) % 3]
            readings = []
            for reading in (tr.speeds.first, tr.speeds.second):
                total = reading.sum(axis=1)
                sides = [] if signs is None else [reading @ s for s in signs]
                if axis == 2:
                    extra = [np.gradient(reading, tr.t, axis=0), *(side * tr.v_air[:, k] for k, side in enumerate(sides))]
                else:
                    extra = [total * tr.v_air[:, 1 - axis], w[:, 2] * tr.v_air[:, axis]]
                    extra += [sides[axis] * tr.v_air[:, 2]] if sides else []
                readings.append(np.column_stack([reading**2 * tr.ratio[:, None], cross, total * w[:, axis], *extra]))
            parts.append(moment_windows(tr, readings[0], readings[1], axis))
        both = _joined(parts)
        blocks.append((both.y, both.a, both.b, both.stretch))
    found = find_layout(blocks, geometry, n)
    return found if signs is not None else _layout(tracks, given, (np.sign(found.roll), np.sign(found.pitch)))


def _joined(parts: list[Windows]) -> Windows:
    """Windows of several flights as one, their stretches kept apart."""
    stretch = np.concatenate([p.stretch + 1_000_000 * i for i, p in enumerate(parts)])
    y, t = np.concatenate([p.y for p in parts]), np.concatenate([p.t for p in parts])
    return Windows(y, np.concatenate([p.a for p in parts]), np.concatenate([p.b for p in parts]), stretch, t)


def _fit_axis(
    axis: int,
    used: tuple[int, ...],
    tracks: list[Track],
    first: list[FloatArray],
    second: list[FloatArray],
    arm: FloatArray,
    iv: bool,
    notes: list[str],
) -> Instrumented:
    parts = []
    for tr, a, b in zip(tracks, first, second, strict=True):
        if axis == 2:
            parts.append(force_windows(tr, a, b, 2, used, arm))
        else:
            parts.append(moment_windows(tr, a[:, axis][:, list(used)], b[:, axis][:, list(used)], axis - 3))
    both = _joined(parts)
    if len(both.y) < 5 * len(used):
        raise HaltereError(f"at least {5 * len(used)} windows in the air", f"{len(both.y)}", "identify", "give longer flights")
    mean, sd = (v[list(used)] for v in _thought(axis, tracks))
    left = both.y - both.x @ np.linalg.lstsq(both.x, both.y, rcond=None)[0]
    # in the unit of the sum of squares; what is left lasts, so that a stretch counts as one sample
    precision = float(np.var(left)) * len(both.y) / len(np.unique(both.stretch)) / sd**2
    if axis == 2 and float(np.std(both.y)) < LEAST_THRUST_SPREAD:
        precision[[n for n, j in enumerate(used) if j == 3]] = 1e12  # of a thrust that never changes no offset is told
        notes.append("thrust hardly changed: kT0 is thrust over speed squared, the offset kT3 is taken for none")
    a, b = (both.a, both.b) if iv else (both.x, both.x)
    return instrumented(both.y, a, b, both.stretch, mean, precision)


def _thought(axis: int, tracks: list[Track]) -> tuple[FloatArray, FloatArray]:
    """Constants of an axis before the flights, 1 sigma (7,): wide, but no hover may find a thrust that does not carry.

    An offset of the force is the accelerometer's. Products of rates are ratios of inertias, and a multirotor is flat: Izz is little less
    than Ixx + Iyy, so that (Iyy - Izz)/Ixx is little above -1 (-0.81 to -1.02 of the vehicles of theory.md §7). The rest is given as
    damping [1/s] or acceleration at the speeds flown.
    """
    speeds = np.concatenate([tr.speeds.mean[tr.use] for tr in tracks])
    s1, s2 = float(np.mean(speeds.sum(axis=1))), float(np.mean((speeds**2).sum(axis=1)))
    free, mean = 1e6, np.zeros(COLUMNS)
    if axis == 2:
        return mean, np.array([free, 0.05, 1.0 / s1, OFFSET_SD, free, free, free])
    mean[1] = (-FLAT, FLAT, 0.0)[axis - 3]
    if axis < 5:
        return mean, np.array([free, FLAT_SD, 3.0, 10.0 / s2, 2.0 / s1, 0.3, 50.0 / s1])
    return mean, np.array([free, FLAT_SD, 3.0, free, 10.0 / s2, 20.0 / s1, 20.0 / s1])


def _across(r: Result, preset: str, k: FloatArray, cov: FloatArray, plain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Constants of the forces across the thrust axis from the joint fit with the wind; the IMU's arm and its 1 sigma."""
    used = PRESETS[preset]
    rests = np.array([part.rest for part in r.parts])
    sds = np.array([r.part_sd(i)[: rests.shape[1]] for i in range(len(r.parts))])
    weight = 1.0 / np.maximum(sds, 1e-9) ** 2
    rest = (rests * weight).sum(axis=0) / weight.sum(axis=0)
    sd = 1.0 / np.sqrt(weight.sum(axis=0))
    for axis in range(2):
        p, P = r.values[3 * axis : 3 * axis + 3], r.covariance[3 * axis : 3 * axis + 3, 3 * axis : 3 * axis + 3]
        at = (0, 2, 3)
        for i, j in enumerate(at):
            k[axis, j] = -p[i] if j in used[axis] else 0.0
            for i2, j2 in enumerate(at):
                if j in used[axis] and j2 in used[axis]:
                    cov[axis, j, j2] = P[i, i2]
        eta, eta_sd = (rest[2 + axis], sd[2 + axis]) if preset != "literal" else ((1.0 - 2.0 * axis) * rest[6], sd[6])
        k[axis, 1], cov[axis, 1, 1] = eta, eta_sd**2
        if 4 in used[axis]:
            k[axis, 4], cov[axis, 4, 4] = rest[axis], sd[axis] ** 2
        plain[axis] = k[axis]
    return rest[4:7], sd[4:7]


def _condition(x: FloatArray) -> float:
    size = np.sqrt(np.mean(x * x, axis=0))
    eigen = np.linalg.eigvalsh((x / np.maximum(size, 1e-12)).T @ (x / np.maximum(size, 1e-12)) / len(x))
    return float(np.sqrt(eigen[-1] / max(eigen[0], 1e-15)))


def _valid(tracks: list[Track]) -> dict[str, Any]:
    """Range of what was flown, but for the outermost hundredth."""
    use = [tr.use for tr in tracks]
    speed = np.concatenate([tr.speeds.mean[u].ravel() for tr, u in zip(tracks, use, strict=True)])
    air = np.concatenate([np.linalg.norm(tr.v_air[u], axis=1) for tr, u in zip(tracks, use, strict=True)])
    rate = np.concatenate([np.abs(tr.motion.gyro_b[u]) for tr, u in zip(tracks, use, strict=True)])
    return {
        "speed": [float(v) for v in np.percentile(speed, [0.5, 99.5])], "airspeed": [0.0, float(np.percentile(air, 99.0))],
        "rate": [float(v) for v in np.percentile(rate, 99.0, axis=0)],
    }  # fmt: skip


def _kept(m: Motion, of: VehicleIdentification, still: bool | None) -> Track:
    """A flight that was not fitted, its wind from itself."""
    speeds = _speeds(m, of.motor)
    m.air = flying(m, speeds)
    w = samples(m, FORCE, np.sum(speeds.mean, axis=1))
    if _calm([w], still, []):
        return track(m, speeds, w, np.zeros((len(w.t), 2)))
    return track(m, speeds, w, fit("lumped", [w], of.across.free).parts[0].wind_path)
