"""The specification of a campaign, read and checked: factors, their combinations, and every run that follows. It runs nothing."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
import tomllib
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from haltere.errors import HaltereError, UsageError, nearest
from haltere.evaluate.campaign_require import Requirement, requirements
from haltere.evaluate.campaign_row import BOUNDS
from haltere.evaluate.choice import choices
from haltere.flight import config as configuration
from haltere.flight.vehicle import load_vehicle
from haltere.metrics.detection import HOLD
from haltere.simulate.parts import SENSORS
from haltere.simulate.scenario import SCENARIOS, WINDS, Scenario, load_scenario, parse_scenario
from haltere.simulate.words import parse_fault

__all__ = ["Plan", "Run", "load_plan", "parse_plan"]

#: Time after the first row before anything is scored [s].
SETTLE = 5.0
#: Keys of a specification.
TOP = (
    "name", "scenario", "logs", "estimators", "preset", "set", "seeds", "fault", "settle", "hold", "settling", "grid", "sample", "case",
    "require",
)  # fmt: skip
#: How a value is drawn, each with the number of its parameters (None: any).
DRAWS = {"uniform": 2, "log_uniform": 2, "normal": 2, "integer": 2, "choice": None}
_HOLE = re.compile(r"\{([a-z_]+)\}")


@dataclass(frozen=True)
class Run:
    """One run: a flight and how to estimate it.

    Attributes
    ----------
    index
        Its place in the table.
    id
        Of everything that makes it what it is: the same in every campaign that has this run.
    factors
        Value of each factor, in the order of the table's columns.
    scenario, log
        What is simulated, or the log that is read.
    faults
        Words to be injected into the log; those of a scenario are in it.
    estimator, preset, keys
        As of `haltere.run`.
    """

    index: int
    id: str
    factors: Mapping[str, Any]
    scenario: Scenario | None
    log: Path | None
    faults: tuple[str, ...]
    estimator: str
    preset: str
    keys: Mapping[str, Any]

    @property
    def flight(self) -> tuple[Any, ...]:
        """Equal for runs over the same flight."""
        return (str(self.log), self.faults) if self.log is not None else (repr(self.scenario),)


@dataclass(frozen=True)
class Plan:
    """A whole campaign.

    Attributes
    ----------
    name
        Of the campaign.
    runs
        In the order of the table.
    factors
        Names of factors, the columns of the table.
    varied
        Those of them that have more than one value.
    require
        Requirements.
    settle, hold
        Time after the first row before anything is scored, and after a fault in which an alarm is still of it [s].
    bounds
        Bounds of settling times by metric.
    same
        Combinations left out, as they are the same run as another.
    text
        The specification as written.
    """

    name: str
    runs: tuple[Run, ...]
    factors: tuple[str, ...]
    varied: tuple[str, ...]
    require: tuple[Requirement, ...]
    settle: float
    hold: float
    bounds: Mapping[str, float]
    same: int
    text: str


def load_plan(path: str | Path) -> Plan:
    """A campaign from its TOML file; other files are looked for beside it.

    Raises
    ------
    UsageError
        No such file, or a key, name or value that is not one, with the nearest name.
    HaltereError
        The file, or one that it names, cannot be read.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        document = tomllib.loads(text)
    except FileNotFoundError:
        raise UsageError("the specification of a campaign, a TOML file", "no such file", str(path)) from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise HaltereError("a TOML file of a campaign", str(error), str(path)) from None
    return parse_plan({"name": path.stem, **document}, str(path), path.parent, text)


def parse_plan(document: Mapping[str, Any], where: str = "campaign", folder: Path = Path(), text: str = "") -> Plan:
    """A campaign from the keys of its file, with every run checked.

    Parameters
    ----------
    document
        Keys as in the file.
    where
        What to call it in errors.
    folder
        Where relative paths begin.
    text
        The specification as written, to be kept with the results.

    Raises
    ------
    UsageError
        A key, name or value that is not one, with the nearest name.
    HaltereError
        A file that it names cannot be read.
    """
    for key in document:
        if key not in TOP:
            raise UsageError(f"keys {', '.join(TOP)}", repr(key), where, nearest(key, TOP))
    axes = _Axes(where)
    logs = _logs(document["logs"], folder, where) if "logs" in document else None
    if logs is not None and "scenario" in document:
        raise UsageError("a scenario or logs", "both", where)
    base, words = _scenario(document.get("scenario", {}), folder, where) if logs is None else (None, ())
    settle, hold = (_positive(document.get(k, d), k, where) for k, d in (("settle", SETTLE), ("hold", HOLD)))
    bounds = dict(BOUNDS)
    for key, value in _flat(_table(document.get("settling", {}), "settling", where)):
        if key not in BOUNDS:
            raise UsageError(f"a quantity that settles ({', '.join(BOUNDS)})", repr(key), f"{where}: [settling]", nearest(key, BOUNDS))
        bounds[key] = _positive(value, key, f"{where}: [settling]")
    common = dict(_flat(_table(document.get("set", {}), "set", where)))
    given = _words(document["fault"], f"{where}: fault") if "fault" in document else words

    axes.add("case", _cases(document.get("case", []), where))
    if logs is not None:
        axes.add("logs", [{"log": str(p)} for p in logs])
        if "seeds" in document:
            raise UsageError("seeds for simulated flights", "logs", f"{where}: seeds", "a log has nothing random in it")
    grid = dict(_flat(_table(document.get("grid", {}), "grid", where)))
    estimators = _estimators(document, grid, common, where)
    for key, values in grid.items():
        if not isinstance(values, list) or not values:
            raise UsageError("a list of values", repr(values), f"{where}: [grid] {key}")
        axes.add("grid", [{key: v} for v in values])
    draws = _samples(_table(document.get("sample", {}), "sample", where), where)
    axes.add("sample", draws or [{}])
    if logs is None:
        seeds = _seeds(document.get("seeds"), len(draws), where)
        own = len(draws) if seeds is None else 0
        axes.add("seeds", [{"seed": s} for s in seeds] if seeds is not None else [{}])
    else:
        own = 0
    axes.check(logs is not None)
    found: dict[str, Run] = {}
    builder = _Builder(base, given, common, str(document.get("preset", "default")), folder, where, (settle, hold, bounds))
    same = 0
    for factors, choice in itertools.product(axes.combinations(own), estimators):
        run = builder.run(len(found), factors, choice)
        same += found.setdefault(run.id, run) is not run
    runs = tuple(found.values())
    ends = ("fault", "estimator", "preset", "seed")
    columns = sorted(dict.fromkeys(k for r in runs for k in r.factors), key=lambda k: ends.index(k) if k in ends else -1)
    varied = [c for c in columns if len({repr(r.factors.get(c)) for r in runs}) > 1]
    require = requirements(document.get("require", []), columns, where)
    name = str(document.get("name", "campaign"))
    return Plan(name, runs, tuple(columns), tuple(varied), tuple(require), settle, hold, bounds, same, text)


# --- factors -------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _scenario_keys() -> tuple[str, ...]:
    """Keys of a scenario that may be factors, with dots."""
    plain = [f.name for f in fields(Scenario) if f.name not in ("name", "seed", "wind", "sensors", "fault")]
    sensors = [f"sensors.{s}.{p}" for s, keys in SENSORS.items() for p in ("preset", *keys)]
    return (*plain, *(f"wind.{k}" for k in WINDS), *sensors)


def _kind(key: str) -> str:
    """``scenario``, ``config``, ``run`` (of the campaign itself) or empty."""
    if key in ("estimator", "preset", "fault", "log", "seed") or re.fullmatch(r"fault\.[a-z_]+", key):
        return "run"
    if key in configuration.KEYS or key in configuration.GROUPS:
        return "config"
    return "scenario" if key in _scenario_keys() else ""


class _Axes:
    """Lists of settings whose product the campaign is; each setting gives values to some factors."""

    def __init__(self, where: str) -> None:
        self.where = where
        self.lists: list[tuple[str, list[dict[str, Any]]]] = []

    def add(self, name: str, settings: list[dict[str, Any]]) -> None:
        """One more list; an empty one is none."""
        if settings:
            self.lists.append((name, settings))

    def check(self, logs: bool) -> None:
        """Every key known, at home in this campaign, and named once."""
        seen: dict[str, str] = {}
        for name, settings in self.lists:
            for key in dict.fromkeys(k for s in settings for k in s):
                if key in seen:
                    raise UsageError("every factor once", f"{key!r} in [{seen[key]}] and [{name}]", self.where)
                seen[key] = name
                kind = _kind(key)
                if not kind or (key == "seed" and name == "grid") or (key == "log" and name != "logs"):
                    known = [*_scenario_keys(), *configuration.KEYS, *configuration.GROUPS, "estimator", "preset", "fault"]
                    hint = (
                        "the top key is seeds"
                        if key in ("seed", "seeds")
                        else "the top key is logs"
                        if key == "log"
                        else nearest(key, known)
                    )
                    raise UsageError("a scenario or configuration key", repr(key), f"{self.where}: [{name}]", hint)
                if logs and kind == "scenario":
                    raise UsageError("configuration keys and faults, as the flights are logs", repr(key), f"{self.where}: [{name}]")

    def combinations(self, own: int) -> Iterator[dict[str, Any]]:
        """Every combination; with ``own`` draws each has its number for a seed."""
        which = next((i for i, (name, _) in enumerate(self.lists) if name == "sample"), -1)
        for combination in itertools.product(*(enumerate(settings) for _, settings in self.lists)):
            out: dict[str, Any] = {}
            for _, setting in combination:
                out |= setting
            if own:
                out["seed"] = combination[which][0] + 1
            yield out


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys with dots of nested tables; how a value is drawn is a value."""
    for key, value in table.items():
        if isinstance(value, Mapping) and not (len(value) == 1 and next(iter(value)) in DRAWS):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _table(value: Any, name: str, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UsageError(f"a table [{name}]", repr(value), where)
    return value


def _positive(value: Any, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < 0.0:
        raise UsageError(f"a number of at least 0 for {name}", repr(value), where)
    return float(value)


def _whole(value: Any, name: str, where: str, low: int = 0) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise UsageError(f"a whole number of at least {low} for {name}", repr(value), where)
    return value


def _cases(value: Any, where: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(v, Mapping) for v in value):
        raise UsageError("tables [[case]]", repr(value), where)
    # a whole home is a scenario's; home.lat alone is a key of the configuration
    return [dict(_flat({k: v for k, v in case.items() if k != "home"})) | {k: v for k, v in case.items() if k == "home"} for case in value]


def _seeds(value: Any, draws: int, where: str) -> list[int] | None:
    """Seeds; None: each draw has its own."""
    at = f"{where}: seeds"
    if value is None:
        return None if draws else [1]
    if isinstance(value, str):
        found = re.fullmatch(r"\s*(\d+)\s*-\s*(\d+)\s*", value)
        if found is None or int(found[1]) > int(found[2]):
            raise UsageError("a range such as 1-200", repr(value), at)
        return list(range(int(found[1]), int(found[2]) + 1))
    if isinstance(value, list):
        out = [_whole(v, "a seed", at) for v in value]
        if not out or len(set(out)) < len(out):
            raise UsageError("different seeds", repr(value), at)
        return out
    return list(range(1, _whole(value, "the number of seeds", at, 1) + 1))


def _samples(table: Mapping[str, Any], where: str) -> list[dict[str, Any]]:
    """Draws of a [sample]: each key from a generator of its own, so that neither more draws nor more keys change another's."""
    keys = dict(_flat(table))
    if not keys:
        return []
    at = f"{where}: [sample]"
    n, seed = _whole(keys.pop("n", None), "n", at, 1), _whole(keys.pop("seed", 1), "seed", at)
    out: list[dict[str, Any]] = [{} for _ in range(n)]
    for key, rule in keys.items():
        kind = next(iter(rule)) if isinstance(rule, Mapping) and len(rule) == 1 else None
        if kind not in DRAWS:
            raise UsageError(f"how to draw it ({', '.join(DRAWS)}), such as {{ uniform = [0, 8] }}", repr(rule), f"{at} {key}")
        parameters = rule[kind]
        if not isinstance(parameters, list) or not parameters or len(parameters) != (DRAWS[kind] or len(parameters)):
            raise UsageError(f"a list of {DRAWS[kind] or 'values'} for {kind}", repr(parameters), f"{at} {key}")
        rng = np.random.default_rng([seed, zlib.crc32(key.encode())])
        for draw in out:
            draw[key] = _drawn(rng, kind, parameters, f"{at} {key}")
    return out


def _drawn(rng: np.random.Generator, kind: str, p: list[Any], where: str) -> Any:
    if kind == "choice":
        return p[int(rng.integers(len(p)))]
    if any(isinstance(v, bool) or not isinstance(v, int | float) for v in p):
        raise UsageError("numbers", repr(p), where)
    if kind == "normal":
        return float(p[0] + p[1] * rng.standard_normal())
    if p[1] < p[0] or (kind == "log_uniform" and p[0] <= 0.0):
        raise UsageError("a low and a high limit" + (" above 0" if kind == "log_uniform" else ""), repr(p), where)
    if kind == "integer":
        return int(rng.integers(int(p[0]), int(p[1]) + 1))
    u = float(rng.random())
    return float(p[0] * (p[1] / p[0]) ** u) if kind == "log_uniform" else float(p[0] + u * (p[1] - p[0]))


def _estimators(document: Mapping[str, Any], grid: dict[str, Any], common: Mapping[str, Any], where: str) -> list[str]:
    """Estimators as ``NAME[@PRESET][:KEY=VALUE]...``."""
    if "estimators" in document and "estimator" in grid:
        raise UsageError("every factor once", "estimators and [grid] estimator", where)
    value = grid.pop("estimator") if "estimator" in grid else document.get("estimators", ["navigator"])
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise UsageError("a list of estimators", repr(value), f"{where}: estimators")
    if len(set(names)) < len(names):
        raise UsageError("every estimator once", repr(value), f"{where}: estimators")
    return list(names)


# --- flights -------------------------------------------------------------------------------------------------------------


def _words(value: Any, where: str) -> tuple[str, ...]:
    """Fault words; an empty text is none."""
    words = [value] if isinstance(value, str) else value
    if not isinstance(words, list | tuple) or not all(isinstance(w, str) for w in words):
        raise UsageError("fault words, a text or a list of texts", repr(value), where)
    return tuple(w.strip() for w in words if w.strip())


def _scenario(value: Any, folder: Path, where: str) -> tuple[Scenario, tuple[str, ...]]:
    """What every flight starts from, and its fault words, which may have holes."""
    if isinstance(value, str):
        beside = folder / value
        found = load_scenario(value if value in SCENARIOS or not beside.is_file() else beside)
        return found, found.fault
    document = dict(_table(value, "scenario", where))
    words = _words(document.pop("fault"), f"{where}: [scenario] fault") if "fault" in document else None
    if "seed" in document:
        raise UsageError("no seed in [scenario]", repr(document["seed"]), where, "the top key is seeds")
    base = parse_scenario(_beside(document, folder), f"{where}: [scenario]")
    return base, base.fault if words is None else words


def _beside(document: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Vehicle and track files beside the specification."""
    out = dict(document)
    for key in ("vehicle", "track"):
        value = out.get(key)
        if isinstance(value, str) and value and not Path(value).is_absolute() and (folder / value).exists():
            out[key] = str(folder / value)
    return out


def _logs(value: Any, folder: Path, where: str) -> list[Path]:
    """Logs of a list; a folder that is no flight folder stands for what it holds, in order of names."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise UsageError("a folder of logs, or a list of logs", repr(value), f"{where}: logs")
    out: list[Path] = []
    for name in names:
        path = Path(name) if Path(name).is_absolute() else folder / name
        if not path.exists():
            raise HaltereError("a log or a folder of logs", "nothing there", str(path))
        if path.is_dir() and not (path / "flight.toml").is_file() and not (path / "metadata.yaml").is_file():
            inside = sorted(p for p in path.iterdir() if not p.name.startswith("."))
            if not inside:
                raise HaltereError("logs in the folder", "none", str(path))
            out += inside
        else:
            out.append(path)
    return list(dict.fromkeys(out))


class _Builder:
    """Runs of one plan from the values of their factors."""

    def __init__(
        self, base: Scenario | None, words: tuple[str, ...], common: Mapping[str, Any], preset: str, folder: Path, where: str, scoring: Any
    ) -> None:
        self.base, self.words, self.common, self.preset = base, words, common, preset
        self.folder, self.where, self.scoring = folder, where, scoring

    def run(self, index: int, factors: Mapping[str, Any], estimator: str) -> Run:
        """One run, checked."""
        values = dict(factors)
        estimator = str(values.pop("estimator", estimator))
        keys = {k: v for k, v in values.items() if _kind(k) == "config"}
        changed = {k: v for k, v in values.items() if _kind(k) == "scenario"}
        preset = values.get("preset", self.preset)
        name = estimator
        if not isinstance(preset, str):
            raise UsageError("a text for preset", repr(preset), self.where)
        if "@" not in name.partition(":")[0]:
            head, colon, rest = name.partition(":")
            name = f"{head}@{preset}{colon}{rest}"
        try:
            choice = choices([name], {**self.common, **keys})[0]
        except UsageError as error:
            raise UsageError(error.expected, error.found, self.where, error.remedy) from None
        faults, holes = self._faults(values)
        scenario, log = None, None
        if self.base is not None:
            document: dict[str, Any] = {"seed": values.get("seed", 1), "fault": list(faults)}
            for key, value in _beside(changed, self.folder).items():
                *tables, last = key.split(".")
                at = document
                for part in tables:
                    at = at.setdefault(part, {})
                at[last] = value
            scenario = parse_scenario(document, self.where, self.base)
            if isinstance(scenario.vehicle, str | Path):
                _known_vehicle(str(scenario.vehicle))
        else:
            log = Path(values["log"])
            for word in faults:
                if parse_fault(word).simulated_only:
                    raise UsageError("faults that a log can have", repr(word), self.where, "those of the vehicle and the air are simulated")
        shown = {
            **({"log": log.name} if log is not None else {}),
            **{k: _shown(v) for k, v in values.items() if _kind(k) != "run"},
            **{k: v for k, v in values.items() if k.startswith("fault.") and k.removeprefix("fault.") in holes},
            "fault": ", ".join(faults), "estimator": estimator,
            **({"preset": preset} if "preset" in values else {}), **({"seed": values.get("seed", 1)} if scenario is not None else {}),
        }  # fmt: skip
        identity = {
            "scenario": _plain(scenario) if scenario is not None else None,
            "files": [_fingerprint(p) for p in (log, *(_files(scenario) if scenario is not None else ())) if p is not None],
            "faults": faults, "estimator": choice.estimator, "preset": choice.preset, "keys": {k: str(v) for k, v in choice.keys.items()},
            "scoring": _plain(self.scoring),
        }  # fmt: skip
        digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
        return Run(index, digest, shown, scenario, log, faults if log is not None else (), choice.estimator, choice.preset, choice.keys)

    def _faults(self, values: Mapping[str, Any]) -> tuple[tuple[str, ...], set[str]]:
        """Fault words with their holes filled, and the names of those holes."""
        words = _words(values["fault"], f"{self.where}: fault") if "fault" in values else self.words
        filling = {k.removeprefix("fault."): v for k, v in values.items() if k.startswith("fault.")}
        holes: set[str] = set()
        out = []
        for word in words:
            mine = _HOLE.findall(word)
            for hole in mine:
                if hole not in filling:
                    raise UsageError(f"a factor fault.{hole} for the fault {word}", ", ".join(filling) or "none", self.where)
            holes.update(mine)
            out.append(_HOLE.sub(lambda found: _text(filling[found[1]]), word))
            parse_fault(out[-1])
        return tuple(out), holes


def _text(value: Any) -> str:
    """A value as fault words have it: numbers without an exponent."""
    if isinstance(value, float):
        return np.format_float_positional(value, precision=9, trim="-")
    return str(value)


def _shown(value: Any) -> Any:
    """A value for a table: numbers, truths and texts as they are."""
    return value if isinstance(value, bool | int | float | str) else json.dumps(_plain(value), sort_keys=True)


@lru_cache(maxsize=256)
def _known_vehicle(name: str) -> None:
    load_vehicle(name)


def _files(scenario: Scenario) -> Sequence[Path]:
    """Files that a scenario names."""
    named = (scenario.vehicle, scenario.track)
    return [Path(p) for p in named if isinstance(p, str | Path) and Path(p).exists()]


def _plain(value: Any) -> Any:
    """Values that JSON has; paths by their names, since what is in them counts."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, str) and "/" in value and Path(value).exists():
        return Path(value).name
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value if isinstance(value, str | float | bool) or value is None else str(value)


@lru_cache(maxsize=4096)
def _fingerprint(path: Path) -> str:
    """Of what is in a file, or in the files of a folder: name, size, and a MiB of either end."""
    digest = hashlib.sha256()
    inside = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    try:
        for file in inside:
            size = file.stat().st_size
            digest.update(f"{file.name} {size}\n".encode())
            with file.open("rb") as handle:
                digest.update(handle.read(1 << 20))
                handle.seek(max(size - (1 << 20), 0))
                digest.update(handle.read())
    except OSError as error:
        raise HaltereError("a readable file", str(error), str(path)) from None
    return digest.hexdigest()
