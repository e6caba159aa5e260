"""Vehicle files: mass, inertia, rotors and body of a multirotor, checked once when read. It computes no force."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haltere.errors import HaltereError, UsageError, nearest

__all__ = ["LIBRARY", "Battery", "Rotor", "Vehicle", "load_vehicle", "parse_vehicle"]

Vec = tuple[float, float, float]

#: Vehicles that come with haltere, by name.
LIBRARY = ("crazyflie", "hexarotor", "hummingbird", "iris")


@dataclass(frozen=True)
class Rotor:
    """One rotor (theory.md §5.2; interface.md §2).

    Attributes
    ----------
    position
        Hub from the centre of gravity [m], FRD.
    axis
        Direction of thrust, unit vector, FRD; (0, 0, -1) lifts.
    spin
        +1 turns counter-clockwise seen from above (from where the thrust points), -1 clockwise.
    k_T, k_M
        Thrust [N/(rad/s)^2] and drag torque [N m/(rad/s)^2].
    k_d, k_z, k_h
        Drag across the axis and loss of thrust by inflow [N/(rad/s)/(m/s)], translational lift [N/(m/s)^2].
    tau_up, tau_down
        Time constants of the motor speeding up and slowing down [s].
    speed_max
        Largest speed [rad/s] at full battery voltage.
    inertia
        Of rotor and bell about the axis [kg m^2]; 0 leaves the gyroscopic torque away.
    """

    position: Vec
    k_T: float
    k_M: float
    spin: float
    tau_up: float
    tau_down: float
    speed_max: float
    axis: Vec = (0.0, 0.0, -1.0)
    k_d: float = 0.0
    k_z: float = 0.0
    k_h: float = 0.0
    inertia: float = 0.0


@dataclass(frozen=True)
class Battery:
    """A battery as an ideal source behind a resistance.

    Attributes
    ----------
    voltage
        Without load, full [V]; motors are rated at it.
    resistance
        Inner resistance [ohm].
    capacity
        Charge [A h]; the voltage falls by ``sag`` over it, in proportion.
    sag
        Fraction of the voltage lost when empty.
    efficiency
        Rotor power over electrical power.
    """

    voltage: float
    resistance: float
    capacity: float
    sag: float = 0.15
    efficiency: float = 0.6


@dataclass(frozen=True)
class Vehicle:
    """A multirotor as a rigid body with rotors.

    Attributes
    ----------
    mass
        kg; 1 in a file that holds only ``[lumped]`` and does not say.
    inertia
        Elements xx, yy, zz, xy, xz, yz of the inertia matrix about the centre of gravity [kg m^2], FRD.
    rotors
        In the order of ``speed_0, speed_1, ...``; empty in a file that holds only ``[lumped]``.
    drag
        Quadratic body drag along x, y, z [N/(m/s)^2].
    density
        Air density at which the coefficients hold [kg/m^3].
    lumped
        The table ``[lumped]`` as it stands in the file, where there is one.
    """

    name: str
    mass: float
    inertia: tuple[float, float, float, float, float, float]
    rotors: tuple[Rotor, ...] = ()
    drag: Vec = (0.0, 0.0, 0.0)
    density: float = 1.225
    battery: Battery | None = None
    lumped: Mapping[str, Any] = field(default_factory=dict)

    @property
    def inertia_matrix(self) -> NDArray[np.float64]:
        """Inertia as a matrix (3, 3) [kg m^2]."""
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def allocation(self) -> NDArray[np.float64]:
        """Upward force and moments about x, y, z by unit thrust of each rotor, (4, n), in still air."""
        columns = []
        for r in self.rotors:
            n = np.array(r.axis)
            moment = np.cross(np.array(r.position), n) - r.spin * r.k_M / r.k_T * n
            columns.append([-n[2], *moment])
        return np.array(columns).T.reshape(4, -1)

    def hover_speeds(self, gravity: float = 9.80665, density: float | None = None) -> NDArray[np.float64]:
        """Rotor speeds (n,) [rad/s] that hold the vehicle still and level in still air."""
        thrust = np.linalg.pinv(self.allocation()) @ np.array([self.mass * gravity, 0.0, 0.0, 0.0])
        ratio = 1.0 if density is None else density / self.density
        k = np.array([r.k_T for r in self.rotors])
        return np.asarray(np.sqrt(np.maximum(thrust, 0.0) / (k * ratio)), dtype=np.float64)

    def to_toml(self) -> str:
        """The vehicle as the text of a vehicle file."""
        import tomli_w

        out: dict[str, Any] = {"name": self.name, "mass": self.mass, "inertia": list(self.inertia), "density": self.density}
        out["body"] = {"drag": list(self.drag)}
        if self.battery is not None:
            out["battery"] = asdict(self.battery)
        if self.rotors:
            out["rotor"] = [{k: list(v) if isinstance(v, tuple) else v for k, v in asdict(r).items()} for r in self.rotors]
        if self.lumped:
            out["lumped"] = dict(self.lumped)
        return tomli_w.dumps(out)


def load_vehicle(source: str | Path) -> Vehicle:
    """Read a vehicle file, or take one of `LIBRARY` by name.

    Raises
    ------
    HaltereError
        The file is not there, no TOML, or no vehicle: the message names the key.
    UsageError
        Neither a file nor a name of the library.
    """
    name = str(source)
    if name in LIBRARY:
        text = resources.files("haltere.flight").joinpath("vehicles", f"{name}.toml").read_text(encoding="utf-8")
        return parse_vehicle(text, f"vehicle {name}")
    path = Path(source)
    if not path.is_file():
        hint = nearest(name, LIBRARY) or f"haltere has {', '.join(LIBRARY)}"
        raise UsageError("a vehicle file or the name of a vehicle", repr(name), "vehicle", hint)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise HaltereError("a readable vehicle file", str(error), str(path)) from None
    return parse_vehicle(text, str(path))


def parse_vehicle(text: str, where: str = "vehicle file") -> Vehicle:
    """Vehicle from the text of its file; see `load_vehicle`."""
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise HaltereError("a TOML file of a vehicle", str(error), where) from None
    known = {"name", "mass", "inertia", "density", "rotor", "body", "battery", "lumped"}
    _known(document, known, where)
    body = document.get("body", {})
    _known(body, {"drag"}, f"{where}: [body]")
    rotors = tuple(_rotor(r, f"{where}: rotor {k}") for k, r in enumerate(document.get("rotor", [])))
    if not rotors and "lumped" not in document:
        raise HaltereError("at least one of [[rotor]] and [lumped]", "neither", where)
    if rotors and len(rotors) < 3:
        raise HaltereError("at least 3 rotors", f"{len(rotors)}", where)
    # constants of [lumped] are per mass and inertia: a file that holds only them may leave these away
    alone = not rotors
    vehicle = Vehicle(
        str(document.get("name", "vehicle")),
        _positive(document, "mass", where) if "mass" in document or not alone else 1.0,
        _vector(document, "inertia", 6, where) if "inertia" in document or not alone else (1.0, 1.0, 1.0, 0.0, 0.0, 0.0),
        rotors,
        _vector(body, "drag", 3, f"{where}: [body]") if "drag" in body else (0.0, 0.0, 0.0),
        _positive(document, "density", where) if "density" in document else 1.225,
        _battery(document["battery"], f"{where}: [battery]") if "battery" in document else None,
        document.get("lumped", {}),
    )
    moments = np.linalg.eigvalsh(vehicle.inertia_matrix)
    # Measured moments may miss the triangle inequality a little: the published Crazyflie does, by 1 %.
    if moments[0] <= 0.0 or moments[2] > 1.05 * (moments[0] + moments[1]):
        raise HaltereError("an inertia matrix of a real body", f"principal moments {np.round(moments, 9).tolist()}", f"{where}: inertia",
                           "each is positive and none larger than the sum of the others; order xx, yy, zz, xy, xz, yz")  # fmt: skip
    if rotors and np.linalg.matrix_rank(vehicle.allocation(), tol=1e-9) < 3:
        raise HaltereError("rotors that can lift, roll and pitch the vehicle", "positions or axes that cannot", where)
    return vehicle


def _known(table: Mapping[str, Any], names: set[str], where: str) -> None:
    for key in table:
        if key not in names:
            raise HaltereError(f"keys {', '.join(sorted(names))}", repr(key), where, nearest(key, names))


def _number(table: Mapping[str, Any], key: str, where: str) -> float:
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise HaltereError(f"a number {key}", "nothing" if value is None else repr(value), where)
    return float(value)


def _positive(table: Mapping[str, Any], key: str, where: str) -> float:
    value = _number(table, key, where)
    if value <= 0.0:
        raise HaltereError(f"a positive {key}", f"{value:g}", where)
    return value


def _vector(table: Mapping[str, Any], key: str, n: int, where: str) -> Any:
    values = table.get(key)
    good = isinstance(values, list) and len(values) == n
    if not good or not all(isinstance(v, int | float) and math.isfinite(v) for v in values or []):
        raise HaltereError(f"{n} numbers {key}", "nothing" if values is None else repr(values), where)
    return tuple(float(v) for v in values or [])


def _rotor(table: Mapping[str, Any], where: str) -> Rotor:
    _known(table, {f.name for f in fields(Rotor)}, where)
    axis = _vector(table, "axis", 3, where) if "axis" in table else (0.0, 0.0, -1.0)
    length = math.sqrt(sum(a * a for a in axis))
    if length < 1e-6:
        raise HaltereError("a direction axis", repr(axis), where)
    spin = _number(table, "spin", where)
    if spin not in (1.0, -1.0):
        raise HaltereError("spin +1 (counter-clockwise seen from above) or -1", f"{spin:g}", where)
    positive = {k: _positive(table, k, where) for k in ("k_T", "k_M", "tau_up", "tau_down", "speed_max")}
    rest = {k: _number(table, k, where) for k in ("k_d", "k_z", "k_h", "inertia") if k in table}
    if any(v < 0.0 for v in rest.values()):
        raise HaltereError("coefficients of at least 0", ", ".join(f"{k} {v:g}" for k, v in rest.items() if v < 0.0), where)
    unit = (axis[0] / length, axis[1] / length, axis[2] / length)
    return Rotor(position=_vector(table, "position", 3, where), axis=unit, spin=spin, **positive, **rest)


def _battery(table: Mapping[str, Any], where: str) -> Battery:
    _known(table, {f.name for f in fields(Battery)}, where)
    return Battery(**{k: _positive(table, k, where) for k in ("voltage", "resistance", "capacity")},
                   **{k: _positive(table, k, where) for k in ("sag", "efficiency") if k in table})  # fmt: skip
