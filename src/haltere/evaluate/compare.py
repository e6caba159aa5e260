"""`compare`: one flight through our estimators, installed peers and the onboard solution, scored alike. It draws and writes nothing."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere import drive
from haltere._version import __version__
from haltere.aids.record import MAGNETOMETER
from haltere.errors import HaltereError, UsageError
from haltere.estimators.inputs import configure, imu_arrays, measurements, request
from haltere.estimators.registry import SPECIFICATIONS
from haltere.evaluate.choice import Choice, choices, peers_named
from haltere.evaluate.conclusions import conclusions, headline
from haltere.evaluate.peers import Peer, Samples, estimate, version
from haltere.flight.config import Config
from haltere.flight.corrections import correct
from haltere.flight.door import Checked, check, first_fix
from haltere.flight.local import local_from_geodetic
from haltere.flight.log import FlightLog, Stream
from haltere.flight.solution import Solution
from haltere.metrics.attitude import multiply
from haltere.metrics.comparison import Comparison, Track, common_rows, covered, differences_from_gnss, errors, pair, scores, track_of
from haltere.metrics.summary import finite

__all__ = ["SETTLE", "compare"]

FloatArray = NDArray[np.float64]

#: Time after the first row of the slowest solution before anything is scored [s].
SETTLE = 5.0
#: Heading of ours is scored where something measured it, and half of the rows state their yaw better than this, 1 sigma [rad].
YAW_KNOWN = math.radians(30.0)
#: Rows a second at which solutions are compared with each other where there is no reference [Hz].
RATE = 20.0
STREAMS = {"truth": "truth", "onboard": "onboard"}


@dataclass
class _Row:
    """One solution while it is being made: what goes into its part of the summary, and its track once it ran."""

    name: str
    kind: str
    facts: dict[str, Any] = field(default_factory=dict)
    track: Track | None = None


def compare(
    flight: FlightLog,
    estimators: str | Sequence[str] = ("navigator", "ahrs"),
    *,
    peers: str | Sequence[str] = "all",
    against: str | None = None,
    set: Mapping[str, Any] | None = None,
    settle: float = SETTLE,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:
    """Run a flight through several estimators and score all of them alike.

    Parameters
    ----------
    flight
        The log. Streams ``onboard`` and ``truth`` are read after all runs, for scoring alone.
    estimators
        Of ours: ``NAME[@PRESET][:KEY=VALUE]...`` each, as a list or separated by commas.

    Other Parameters
    ----------------
    peers
        ``all`` that are installed, ``none``, or names (`haltere.evaluate.peers.PEERS`) as a list or separated by commas.
    against
        ``truth`` or ``onboard``; default truth where the flight has one, else onboard, else nothing.
    set
        Configuration keys for all of our estimators.
    settle
        Time after the slowest solution's first row before anything is scored [s].
    progress
        Called with what is run and the fraction of it done.

    Returns
    -------
    Comparison
        Tracks, reference, scored times and the summary of ``compare.json``. A solution that failed has a row with the reason.

    Raises
    ------
    HaltereError
        The log has no IMU to navigate on, not the reference asked for, or nothing that ran.
    UsageError
        An unknown estimator, peer, preset, key or reference, or a negative time.
    """
    chosen, named = choices(estimators, set), peers_named(peers)
    if against not in (None, *STREAMS):
        raise UsageError("truth or onboard", repr(against), "--against")
    if not (math.isfinite(settle) and settle >= 0.0):
        raise UsageError("a time in seconds, zero or more", repr(settle), "--settle")
    if against is not None and (against not in flight or len(flight[against]) == 0):
        there = [s for s in STREAMS if s in flight and len(flight[s])]
        remedy = (
            f"leave out --against to compare with {there[0]}"
            if there
            else "leave out --against: solutions are then compared with each other"
        )
        raise HaltereError(f"a stream {against!r} to compare with", f"streams {', '.join(flight) or 'none'}", flight.meta.name, remedy)

    def told(words: str) -> Callable[[float], None]:
        return lambda fraction: progress(words, fraction) if progress is not None else None

    raw = flight.without(*STREAMS)
    asked = request(raw, "ahrs", overrides=_common(set))
    flight = correct(flight, asked.values)
    blind = flight.without(*STREAMS)
    checked = check(blind, upright=False, given=asked.values)
    base = configure(blind, checked, "ahrs", config=asked)  # the place and the field, as every estimator finds them
    fix = first_fix(checked.streams.get("gnss"))
    home = flight.meta.home
    origin = (home.lat, home.lon, home.alt) if home is not None else fix
    imu_t, gyro, accel = imu_arrays(blind, checked)

    rows: list[_Row] = []
    for choice in chosen:
        rows.append(_ours(raw, flight, choice, origin, told(choice.name)))
    samples = _samples(blind, checked, base, imu_t, gyro, accel)
    for peer in named:
        rows.append(_peer(peer, samples, base, told(peer.name), asked=peers != "all"))
    if not any(r.track for r in rows):
        raise HaltereError("a solution", "; ".join(f"{r.name}: {r.facts.get('failed')}" for r in rows), flight.meta.name or "flight")

    # Only from here on is what the log says of itself looked at.
    references = {s: track_of(s, flight[s], origin) for s in STREAMS if s in flight and len(flight[s])}
    if against is None:
        against = next((s for s in STREAMS if references.get(s) is not None), None)
    elif references.get(against) is None:
        raise HaltereError(f"rows of {against} with an attitude", "fewer than two", flight.meta.name or "flight")
    onboard = references.get("onboard")
    if onboard is not None and against != "onboard":
        rows.append(_Row("onboard", "onboard", {"maker": "the autopilot", "done": ["as logged; read after the run"]}, onboard))
    gnss = _gnss(checked.streams.get("gnss"), flight, origin)
    return _scored(flight, rows, references.get(against) if against else None, against, settle, imu_t, gnss, base, checked)


def _common(keys: Mapping[str, Any] | None) -> dict[str, Any]:
    """Keys that say something of the log rather than of a filter: they hold for peers too."""
    return {k: v for k, v in (keys or {}).items() if k.startswith(("field.", "home.", "unit.", "axes."))}


def _ours(
    blind: FlightLog, flight: FlightLog, choice: Choice, origin: tuple[float, float, float] | None, told: Callable[[float], None]
) -> _Row:
    """One of our estimators; what it gives is read, not changed."""
    row = _Row(choice.name, "haltere", {"maker": f"haltere {__version__}"})
    done = [f"preset {choice.preset}", *(f"{k} = {v}" for k, v in choice.keys.items())]
    try:
        _warm(blind, choice)
        solution = drive.run(blind, choice.estimator, preset=choice.preset, set=choice.keys, progress=told)
    except UsageError:
        raise
    except HaltereError as error:
        row.facts |= {"failed": str(error), "done": done}
        return row
    held = _used(solution, "gnss")
    heading = (held or _used(solution, "magnetometer")) and float(np.median(solution["sd_yaw"])) < YAW_KNOWN
    table = dict(solution.table)
    if SPECIFICATIONS[choice.estimator].POSITION and not held:
        table = {k: v for k, v in table.items() if not k.startswith(("vel_", "pos_", "lat", "lon", "alt"))}
        done.append("no GNSS was let in: velocity and position would be held by an assumption, and are not scored")
    elif not held:
        done.append("estimates attitude only")
    row.track = track_of(choice.name, Stream(table), origin, heading=heading)
    if row.track is None:
        row.facts |= {"failed": "fewer than two rows with an attitude", "done": done}
        return row
    if not row.track.heading:
        done.append("neither magnetometer nor GNSS made its heading known to 30 deg for half of the time: heading is not scored")
    row.facts |= {
        "sensors": ["imu", *(s for s in ("gnss", "magnetometer", "barometer") if _used(solution, s))],
        "seconds": solution.summary["timings"]["filter_s"], "nis": solution.summary["nis"], "done": done,
        "nees": _nees(solution, flight), "warnings": solution.summary["warnings"],
    }  # fmt: skip
    return row


def _nees(solution: Solution, flight: FlightLog) -> dict[str, Any]:
    from haltere.metrics.consistency import nees_series, nees_table

    return nees_table(nees_series(solution, flight["truth"])) if "truth" in flight and len(flight["truth"]) else {}


def _used(solution: Solution, sensor: str) -> bool:
    """Whether a measurement of a sensor was let in after the one that set the start."""
    a = solution.aids
    return bool(np.any((a["sensor"] == sensor) & (a["status"] != "rejected")))


def _warm(blind: FlightLog, choice: Choice) -> None:
    """Compile or load what the run needs on a second of the log, so that the time of the run is that of the filter."""
    imu = blind["imu"]
    short = {n: s.where(slice(0, 200)) for n, s in blind.streams.items() if n != "imu"} | {"imu": imu.where(slice(0, min(len(imu), 200)))}
    with contextlib.suppress(HaltereError):  # too short to align, as a rule
        drive.run(FlightLog(short, blind.meta), choice.estimator, preset=choice.preset, set=choice.keys)


def _samples(blind: FlightLog, checked: Checked, base: Config, t: FloatArray, gyro: FloatArray, accel: FloatArray) -> Samples:
    """What peers are given: the same checked samples in body axes as ours, at the times of the log."""
    offered = measurements(blind, checked, base)
    mine = offered.kind == MAGNETOMETER
    return Samples(t, gyro, accel, offered.t[mine], np.ascontiguousarray(offered.z[mine]), base.number("field.dip"))


def _peer(peer: Peer, samples: Samples, base: Config, told: Callable[[float], None], *, asked: bool) -> _Row:
    """One peer, its heading turned from magnetic to true north."""
    found = version(peer)
    row = _Row(peer.name, "peer", {"maker": f"{peer.package} {found}" if found else peer.package, "smoother": peer.smoother})
    if found is None:
        row.facts |= {"failed": 'not installed: pip install "haltere[peers]"', "missing": True}
        return row
    try:
        got = estimate(peer, samples, told)
    except HaltereError as error:
        row.facts["failed"] = error.found
        return row
    declination = base.number("field.declination")
    turn = np.array([math.cos(0.5 * declination), 0.0, 0.0, math.sin(0.5 * declination)])
    row.track = Track(peer.name, got.t, multiply(turn, got.q), heading=got.heading, smoother=peer.smoother)
    done = list(got.done)
    if got.heading:
        done.append(f"declination {math.degrees(declination):+.2f} deg added to its magnetic heading")
        if base.number("delay.magnetometer") > 0.0:
            done.append("its magnetometer samples come at their stamps: the delay that the log states is taken off for ours alone")
    row.facts |= {"seconds": got.seconds, "sensors": ["imu", *(["magnetometer"] if got.heading else [])], "done": done}
    return row


def _gnss(gnss: Stream | None, flight: FlightLog, origin: tuple[float, float, float] | None) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Times at which fixes were valid, with velocities and with positions NED."""
    nothing = (np.empty(0), np.empty((0, 3)))
    if gnss is None:
        return nothing, nothing
    delays = flight.meta.delays
    late = delays.get("gnss", 0.0)
    velocity = (gnss.t - delays.get("gnss_velocity", late), gnss.vector("vel", "ned"))
    if origin is None:
        return velocity, nothing
    p = np.column_stack(local_from_geodetic(gnss.get("lat"), gnss.get("lon"), gnss.get("alt"), *origin))
    return velocity, (gnss.t - delays.get("gnss_position", late), p)


def _scored(
    flight: FlightLog,
    rows: list[_Row],
    reference: Track | None,
    against: str | None,
    settle: float,
    imu_t: FloatArray,
    gnss: tuple[tuple[FloatArray, FloatArray], ...],
    base: Config,
    checked: Checked,
) -> Comparison:
    """Score all tracks on the same rows, and put the summary together."""
    tracks = [r.track for r in rows if r.track is not None]
    t = reference.t if reference is not None else np.arange(imu_t[0], imu_t[-1], 1.0 / RATE)
    use, left_out = common_rows(tracks, t, settle)
    t = t[use]
    kept = [k for k in tracks if k.name not in left_out] if len(t) else []
    share = covered(imu_t, tracks)
    duration = float(imu_t[-1] - imu_t[0])
    span = (float(t[0]), float(t[-1])) if len(t) else None
    solutions: dict[str, Any] = {}
    for r in rows:
        facts = {"kind": r.kind, "smoother": False, "failed": None, **r.facts}
        if r.track is not None:
            facts |= {
                "aligned_at": float(r.track.t[0]),
                "covered": share[r.name],
                "heading": r.track.heading,
                "left_out": left_out.get(r.name),
            }
            if r.track in kept:
                facts["errors"] = scores(errors(r.track, reference, t)) if reference is not None else {}
                facts["gnss"] = differences_from_gnss(r.track, gnss[0], gnss[1], span) if span else {}
            if "seconds" in facts and facts["seconds"] > 0.0:
                facts["times_real_time"] = duration / facts["seconds"]
        solutions[r.name] = facts
    if reference is not None and against == "onboard" and span is not None:
        others, own = [*kept, reference], differences_from_gnss(reference, gnss[0], gnss[1], span)
    else:
        others, own = kept, {}
    meta = flight.meta
    summary: dict[str, Any] = {
        "haltere": __version__, "name": meta.name, "source": meta.source, "start_utc": meta.start_utc, "time_offset": meta.time_offset,
        "duration": duration, "against": against, "settle": settle, "span": list(span) if span else None, "rows": len(t),
        "declination_deg": math.degrees(base.number("field.declination")), "solutions": solutions,
        "pairs": [pair(a, b, t) for i, a in enumerate(others) for b in others[i + 1 :]], "onboard_gnss": own,
        "missing": [r.name for r in rows if r.facts.get("missing")], "discarded": checked.discarded, "notes": checked.warnings,
    }  # fmt: skip
    summary |= {"headline": headline(summary), "conclusions": conclusions(summary)}
    return Comparison(tracks, reference, against, t, finite(summary))
