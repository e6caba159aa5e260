"""A magnetometer's calibration from a log: offset, matrix, load and what they are worth. It draws and writes nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from haltere.calibrate.coverage import HEADINGS, Coverage, coverage, heading_errors, heading_sd, level_fields
from haltere.calibrate.dip import Turn, turn
from haltere.calibrate.ellipsoid import BASIS, METHODS, Ellipsoid, fit
from haltere.errors import HaltereError, UsageError, nearest
from haltere.estimators.inputs import request
from haltere.flight.config import KEYS, Config
from haltere.flight.corrections import CALIBRATION, correct, mounting_matrix, raw_vectors
from haltere.flight.door import first_fix
from haltere.flight.field import decimal_year, earth_field
from haltere.flight.load import LOADS, load_at, loads_of
from haltere.flight.log import FlightLog
from haltere.readers.table import ROWS

__all__ = ["CoverageError", "MagnetometerCalibration", "calibrate_magnetometer"]

FloatArray = NDArray[np.float64]

#: Largest 1 sigma of a level heading that is taken for a calibration, and from where it is said to be poor [rad].
HEADING_REFUSED, HEADING_POOR = math.radians(3.0), math.radians(1.0)
#: Least eigenvalue of the scatter of directions: refused below the first times the noise in hundredths of the field, poor below the second.
SCATTER_REFUSED, SCATTER_POOR = 0.005, 0.02
#: Dip where nothing tells it [rad]; headings suffer more where it is steeper.
DIP_ASSUMED = math.radians(60.0)
#: 1 sigma of the strength of the World Magnetic Model, as a fraction.
STRENGTH_SD = 0.005
#: Least range of a load that can be told from an offset: between its 1st and 99th percentile, in its unit.
LEAST_RANGE = {"current": 1.0, "throttle": 0.1, "rotors": 20.0}
#: Largest 1 sigma of roll and pitch at which gravity is used [rad]: without GNSS a filter states some degrees, and is better than it says.
TILT_SD = math.radians(6.0)
#: Keys of the configuration that a run needs besides the calibration.
GIVEN = ("unit.magnetometer", "axes.magnetometer")
#: Chance of taking a load for real that is none.
LOAD_CHANCE = 1e-3


@dataclass(frozen=True)
class MagnetometerCalibration:
    """What a log tells of its magnetometer: ``m = matrix (m_raw - offset - load u)``.

    Attributes
    ----------
    name, stream, method
        Of the flight, the stream calibrated and the fit.
    offset
        Centre at zero load (3,) [µT].
    matrix
        A (3, 3): strength of the field times rotation times the ellipsoid's symmetric matrix.
    load_word, load
        ``off``, ``current``, ``throttle`` or ``rotors``, and the field a unit of it (3,) [µT per A, 1 or rad/s].
    covariance
        Of offset (3), matrix by rows (9), load (3): (15, 15).
    symmetric
        The matrix without the rotation, s G, as autopilots take it (3, 3).
    turn
        The rotation found from gravity; None without gravity.
    strength, dip, field_source
        Field [µT, rad] and where each is from.
    ellipsoid, coverage
        Fit and directions.
    t, log, raw, load_values
        Times (n,) [s], vectors as the log has them, vectors before any correction (n, 3) [µT], loads (n,).
    calibrated
        Vectors (n, 3) after the calibration [µT].
    heading_before, heading_sd
        Heading error of a level vehicle with the log as it is, and 1 sigma with this calibration, at `HEADINGS` [rad].
    undone
        Whether the log was corrected by its autopilot, and ``raw`` had that undone.
    sensor
        What autopilot parameters the stream belongs to: keys of ``FlightMeta.compass``.
    given
        Keys of the magnetometer's unit and axes that were set, which a run needs too.
    refused
        Why it is not to be used; empty where it may be.
    notes
        Sentences on what was assumed and what was found.
    """

    name: str
    stream: str
    method: str
    offset: FloatArray
    matrix: FloatArray
    load_word: str
    load: FloatArray
    covariance: FloatArray
    symmetric: FloatArray
    turn: Turn | None
    strength: float
    dip: float
    field_source: str
    ellipsoid: Ellipsoid
    coverage: Coverage
    t: FloatArray
    log: FloatArray
    raw: FloatArray
    load_values: FloatArray
    calibrated: FloatArray
    heading_before: FloatArray
    heading_sd: FloatArray
    undone: bool
    sensor: Mapping[str, Any]
    given: Mapping[str, str]
    refused: str
    notes: tuple[str, ...] = field(default=())

    @property
    def sd(self) -> FloatArray:
        """1 sigma of offset (3), matrix by rows (9), load (3)."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def used(self) -> NDArray[np.bool_]:
        """Samples that are no outliers (n,)."""
        return np.asarray(self.ellipsoid.weights > 0.0)

    def spread(self, vectors: FloatArray) -> float:
        """Standard deviation of the strength over its mean, of the samples that are no outliers."""
        strength = np.linalg.norm(vectors[self.used], axis=1)
        return float(np.std(strength) / np.mean(strength))

    def keys(self) -> dict[str, float | str]:
        """Configuration keys that apply it in a run."""
        out: dict[str, float | str] = {f"magnetometer.offset_{a}": float(v) for a, v in zip("xyz", self.offset, strict=True)}
        out |= {f"magnetometer.matrix_{r}{c}": float(self.matrix[i, k]) for i, r in enumerate("xyz") for k, c in enumerate("xyz")}
        out["magnetometer.load"] = self.load_word
        if self.load_word != "off":
            out |= {f"magnetometer.load_{a}": float(v) for a, v in zip("xyz", self.load, strict=True)}
        return out


class CoverageError(HaltereError):
    """A log that does not turn the sensor enough.

    Attributes
    ----------
    calibration
        What came out nevertheless, to be looked at; None where no ellipsoid could be fitted.
    raw
        The vectors (n, 3) [µT].
    """

    def __init__(
        self, expected: str, found: str, where: str, remedy: str, calibration: MagnetometerCalibration | None, raw: FloatArray
    ) -> None:
        super().__init__(expected, found, where, remedy)
        self.calibration = calibration
        self.raw = raw

    def __reduce__(self) -> tuple[Any, ...]:
        """The same in another process."""
        return type(self), (self.expected, self.found, self.where, self.remedy, self.calibration, self.raw)


def calibrate_magnetometer(
    flight: FlightLog,
    method: str = "sampson",
    *,
    load: str = "auto",
    stream: str = "magnetometer",
    config: Config | Mapping[str, Any] | str | Path | None = None,
    set: Mapping[str, Any] | None = None,
) -> MagnetometerCalibration:
    """Calibrate a magnetometer from a log.

    Parameters
    ----------
    flight
        Any log with a magnetometer that is turned. With an IMU the rotation against it is found too; with a place, the field's strength.
    method
        ``sampson`` (default), ``lg``, ``fz`` or ``axis``; see `haltere.calibrate.ellipsoid`.

    Other Parameters
    ----------------
    load
        ``auto`` takes a load where it makes a difference that chance does not; ``off``, ``current``, ``throttle`` or ``rotors``.
    stream
        Which magnetometer.
    config, set
        Configuration, as of `haltere.run`: units, axes, home, field. Keys of a calibration (``magnetometer.*``) are not used.

    Returns
    -------
    MagnetometerCalibration
        Parameters with 1 sigma, coverage, and what it does to headings.

    Raises
    ------
    CoverageError
        Headings would be uncertain by more than 3 deg (1 sigma), or the directions seen do not fix the ellipsoid.
    HaltereError
        No magnetometer, or vectors that fix no ellipsoid.
    UsageError
        An unknown method, load or key.
    """
    if method not in METHODS:
        raise UsageError(f"a method: {', '.join(METHODS)}", repr(method), "--method", nearest(method, METHODS))
    words = ("auto", "off", *LOADS)
    if load not in words:
        raise UsageError(f"a load: {', '.join(words)}", repr(load), "--load", nearest(load, words))
    if load in LOADS and method != "sampson":
        raise UsageError("the method sampson with a load", repr(method), "--method", "the algebraic fits have no place for a load")
    asked = request(flight, "navigator", "default", config, set).values
    plain = {k: v for k, v in asked.items() if k not in CALIBRATION}
    flight = correct(flight, plain)
    notes: list[str] = [n for n in flight.notes if n == ROWS]
    t, log, raw, undone = _samples(flight, stream, notes)
    C = mounting_matrix(flight, stream)
    strength, dip, source = _field(flight, plain)

    word, u = _load(flight, load if method == "sampson" else "off", t, notes)
    try:
        ellipsoid = fit(raw, method, u)
    except HaltereError as error:
        where = f"{flight.meta.name or 'flight'}, {stream}"
        raise CoverageError(error.expected, error.found, where, error.remedy, None, raw) from None
    if u is not None and load == "auto" and not _real(ellipsoid, u, word, notes):
        word, u = "off", None
        ellipsoid = fit(raw, method)
    values = np.zeros(len(t)) if u is None else u

    down = _gravity(flight, plain, t, stream, C, notes)
    found = None if down is None else turn(ellipsoid, raw, down, values, dip)
    if down is not None and found is None:
        notes.append("gravity is known at too few samples to find the rotation against the IMU")
    scale, scale_sd = _strength(ellipsoid, strength, notes)
    R = np.eye(3) if found is None else found.matrix
    A = scale * R @ ellipsoid.shape
    covariance = _covariance(ellipsoid, found, scale, scale_sd)
    if found is not None and dip is None:
        dip, source = found.dip, f"{source}; dip from gravity"
    elif dip is None:
        dip = DIP_ASSUMED
        notes.append("the dip of the field is not known: headings are given for 60 deg (set field.dip, or home)")
    calibrated = (raw - ellipsoid.centre - np.outer(values, ellipsoid.load)) @ A.T
    typical = float(np.median(values))
    fields = level_fields(scale, dip)
    sd = heading_sd(A, covariance, fields, typical, C)
    seen = coverage(ellipsoid(raw, values))
    sigma = ellipsoid.sigma * float(np.linalg.det(ellipsoid.shape)) ** (1.0 / 3.0)  # as a fraction of the field
    poor = _judge(seen, sd, sigma, notes)
    out = MagnetometerCalibration(
        flight.meta.name, stream, method, ellipsoid.centre, A, word, ellipsoid.load, covariance, scale * ellipsoid.shape, found, scale, dip,
        source, ellipsoid, seen, t, log, raw, values, calibrated, _before(log, calibrated, fields, C), sd, undone,
        flight.meta.compass.get(stream, {}), {k: str(plain[k]) for k in GIVEN if plain[k] != KEYS[k].default}, poor, tuple(notes),
    )  # fmt: skip
    if poor:
        raise CoverageError(
            "a calibration that headings can be taken from", poor, f"{flight.meta.name or 'flight'}, {stream}", _advice(seen, out), out, raw
        )
    return out


def _samples(flight: FlightLog, stream: str, notes: list[str]) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """Times, vectors as logged, raw vectors, and whether a correction was undone; finite, not zero, in order of time."""
    mag = flight.get(stream)
    where = flight.meta.name or "flight"
    if mag is None:
        have = [s for s in flight if s.startswith("magnetometer")]
        remedy = f"there is {', '.join(have)}" if have else "log it; of a table, name its columns (--column)"
        raise HaltereError(f"the stream {stream}", f"only {', '.join(flight)}", where, remedy)
    log = mag.vector("mag")
    raw, undone = raw_vectors(mag)
    good = np.isfinite(mag.t) & np.isfinite(log).all(axis=1) & np.isfinite(raw).all(axis=1) & (log != 0.0).any(axis=1)
    if lost := int((~good).sum()):
        notes.append(f"{lost} of {len(good)} samples without a value, or all zero, left out")
    if not good.any():
        raise HaltereError("samples with a value", f"none of {len(good)}", f"{where}, {stream}", "check mag_x, mag_y, mag_z")
    order = np.flatnonzero(good)[np.argsort(mag.t[good], kind="stable")]
    t, log, raw = mag.t[order], log[order], raw[order]
    kept = np.r_[True, np.any(np.diff(raw, axis=0) != 0.0, axis=1)]
    if (held := int((~kept).sum())) > 0.2 * len(kept):
        notes.append(f"{held} of {len(kept)} samples repeat the one before and were taken once")
        t, log, raw = t[kept], log[kept], raw[kept]
    return t, log, raw, undone


def _field(flight: FlightLog, config: Mapping[str, Any]) -> tuple[float | None, float | None, str]:
    """Strength [µT] and dip [rad], None where unknown: the configuration's, else the World Magnetic Model's."""
    strength, dip = float(config["field.strength"]), float(config["field.dip"])
    source = "configuration" if math.isfinite(strength) or math.isfinite(dip) else "not known"
    place: tuple[float, float, float] | None = (float(config["home.lat"]), float(config["home.lon"]), float(config["home.alt"]))
    if place is not None and math.isnan(place[0]):
        gnss = flight.get("gnss")
        place = first_fix(gnss) if gnss is not None else None
    if place is not None:
        model = earth_field(place[0], place[1], 0.0 if math.isnan(place[2]) else place[2], decimal_year(flight.meta.start_utc))
        if not (math.isfinite(strength) and math.isfinite(dip)):
            source = model.source if source == "not known" else f"{source} and {model.source}"
        strength = strength if math.isfinite(strength) else model.strength
        dip = dip if math.isfinite(dip) else model.dip
    return (strength if math.isfinite(strength) else None), (dip if math.isfinite(dip) else None), source


def _load(flight: FlightLog, wanted: str, t: FloatArray, notes: list[str]) -> tuple[str, FloatArray | None]:
    """Word and values of the load to try."""
    if wanted == "off":
        return "off", None
    for word in loads_of(flight) if wanted == "auto" else (wanted,):
        u = load_at(flight, word, t)
        low, high = np.percentile(u, [1.0, 99.0])
        if high - low > LEAST_RANGE[word]:
            return word, u
        unit = LOADS[word][0]
        text = f"{word} varies by {high - low:.2g} {unit} only: its field cannot be told from an offset"
        if wanted != "auto":
            raise HaltereError(
                f"a {word} that varies by more than {LEAST_RANGE[word]:g} {unit}", f"{high - low:.2g} {unit}", flight.meta.name
            )
        notes.append(text)
    return "off", None


def _real(e: Ellipsoid, u: FloatArray, word: str, notes: list[str]) -> bool:
    """Whether a load's field is more than chance: Hotelling's T² with as many observations as the covariance has stretches."""
    statistic = float(e.load @ np.linalg.solve(e.covariance[9:, 9:], e.load))
    n = max(e.stretches, 5.0)
    chance = float(f_distribution.sf(statistic * (n - 3.0) / (3.0 * (n - 1.0)), 3, n - 3.0))
    real = chance < LOAD_CHANCE
    size = float(np.linalg.norm(e.load)) * float(np.ptp(np.percentile(u, [1.0, 99.0])))
    what = f"the field that follows {word}, {size:.2g} uT over the flight, is chance with probability {chance:.2g}"
    notes.append(f"{what}: taken" if real else f"{what}: not taken")
    return real


def _gravity(
    flight: FlightLog, config: Mapping[str, Any], t: FloatArray, stream: str, C: FloatArray, notes: list[str]
) -> FloatArray | None:
    """Direction of gravity in the sensor's axes (n, 3) from the navigator without magnetometer; NaN where tilt is poorly known."""
    from haltere.drive import run

    if "imu" not in flight:
        notes.append("no IMU in the log: the rotation between magnetometer and IMU is not known")
        return None
    keys = {k: v for k, v in config.items() if not k.startswith(("unit.", "axes.", "aid."))}
    try:
        solution = run(flight, "navigator", config=keys, set={"aid.magnetometer": "off"}, scored=False)
    except HaltereError as error:
        notes.append(f"no gravity from the IMU, so that the rotation against it is not known: {error}")
        return None
    at = t - float(config.get(f"delay.{stream.partition('.')[0]}", 0.0))
    i = np.clip(np.searchsorted(solution.t, at), 1, len(solution) - 1)
    i = np.where(np.abs(solution.t[i - 1] - at) < np.abs(solution.t[i] - at), i - 1, i)
    w, x, y, z = (solution[f"q_{a}"][i] for a in "wxyz")
    down = np.column_stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z])
    bad = (np.abs(solution.t[i] - at) > 0.1) | (np.maximum(solution["sd_roll"][i], solution["sd_pitch"][i]) > TILT_SD)
    down[bad] = np.nan
    return np.asarray(down @ C)


def _strength(e: Ellipsoid, strength: float | None, notes: list[str]) -> tuple[float, float]:
    """What the unit sphere is scaled by [µT] and its 1 sigma; without a known field the log's own size is kept."""
    if strength is not None:
        return strength, STRENGTH_SD * strength
    notes.append("the field's strength is not known: the mean size of the log's vectors is kept (set field.strength, or home)")
    return float(np.linalg.det(e.shape)) ** (-1.0 / 3.0), 0.0


def _covariance(e: Ellipsoid, found: Turn | None, scale: float, scale_sd: float) -> FloatArray:
    """Covariance (15, 15) of offset, matrix by rows and load."""
    n = len(e.covariance)
    R = np.eye(3) if found is None else found.matrix
    A = scale * R @ e.shape
    P = np.zeros((n + 4, n + 4))  # ellipsoid, rotation, strength
    P[:n, :n] = e.covariance
    if found is not None:
        P[n : n + 3, n : n + 3] = found.covariance
        P[n : n + 3, :n] = found.cross
        P[:n, n : n + 3] = found.cross.T
    P[n + 3, n + 3] = scale_sd * scale_sd
    J = np.zeros((15, n + 4))
    J[:3, :3] = np.eye(3)
    J[3:12, 3:9] = np.column_stack([(scale * R @ basis).ravel() for basis in BASIS])
    if n > 9:
        J[12:, 9:12] = np.eye(3)
    small = np.array([[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float)
    J[3:12, n : n + 3] = np.column_stack([(axis @ A).ravel() for axis in small])
    J[3:12, n + 3] = A.ravel() / scale
    return np.asarray(J @ P @ J.T)


def _before(log: FloatArray, calibrated: FloatArray, fields: FloatArray, C: FloatArray) -> FloatArray:
    """Heading error of a level vehicle with the log's own vectors, which follow the calibrated ones linearly."""
    X = np.column_stack([calibrated, np.ones(len(calibrated))])
    solved = np.linalg.lstsq(X, log, rcond=None)[0]
    measured = np.column_stack([fields @ C, np.ones(len(fields))]) @ solved
    return heading_errors(measured @ C.T)


def _judge(seen: Coverage, sd: FloatArray, sigma: float, notes: list[str]) -> str:
    """Why a calibration is not to be used, empty where it may be; a note where it is poor."""
    worst = float(np.max(sd))
    least = float(seen.eigenvalues[0])
    if not worst <= HEADING_REFUSED:
        at = math.degrees(HEADINGS[int(np.argmax(sd))])
        return f"a level heading uncertain by {math.degrees(worst):.1f} deg (1 sigma) at {at:.0f} deg, of 3 deg allowed"
    bound = SCATTER_REFUSED * sigma / 0.01
    if least < bound:
        return f"directions that scatter by {least:.2g} at least (eigenvalue; {bound:.2g} wanted at this noise)"
    if worst > HEADING_POOR or least < SCATTER_POOR:
        notes.append(
            f"poor coverage: level headings are known to {math.degrees(worst):.1f} deg (1 sigma) at worst, "
            f"directions scatter by {least:.2g} at least (eigenvalue; {SCATTER_POOR:g} is good, 0.33 the whole sphere)"
        )
    return ""


def _advice(seen: Coverage, c: MagnetometerCalibration) -> str:
    """What to do about a refused calibration."""
    if seen.share > 0.6:
        spread = 100.0 * c.spread(c.calibrated)
        return f"{100.0 * seen.share:.0f} % of the directions were seen, but the strength spreads by {spread:.2g} % still: avoid iron"
    what = f"; the field never came from near {', '.join(seen.missing)} in the sensor's axes" if seen.missing else ""
    return f"{100.0 * seen.share:.0f} % of the directions were seen{what}: roll and pitch further, or turn it by hand through all attitudes"
