"""Vehicles by name or folder: ``vehicle.toml`` gives the physics and the rig, a model gives the equations."""

from __future__ import annotations

import importlib
import inspect
import math
import warnings
from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim._cache import Stamp, stamp
from vehsim.assets import shipped
from vehsim.errors import InputError
from vehsim.vehicles._base import Control, Drive, Rig, Suspension
from vehsim.vehicles._file import read_vehicle
from vehsim.vehicles._imported import ready_asset
from vehsim.vehicles._mass import fill_in, weigh

if TYPE_CHECKING:
    from vehsim.vehicles._base import Vehicle

MODELS: dict[str, str] = {
    "helicopter": "vehsim.vehicles.helicopter:helicopter",
    "boat": "vehsim.vehicles.boat:boat",
    "car": "vehsim.vehicles.car:car",
    "truck": "vehsim.vehicles.truck:truck",
    "hopper": "vehsim.vehicles.hopper:hopper",
    "simple_car": "vehsim.vehicles.simple_car:simple_car",
    "two_wheeled": "vehsim.vehicles.two_wheeled:two_wheeled",
    "snakeboard": "vehsim.vehicles.snakeboard:snakeboard",
    "chaplygin_sleigh": "vehsim.vehicles.chaplygin_sleigh:chaplygin_sleigh",
    "roller_racer": "vehsim.vehicles.roller_racer:roller_racer",
    "car_trailer": "vehsim.vehicles.car_trailer:car_trailer",
    "suslov": "vehsim.vehicles.suslov:suslov",
    "rigid_body": "vehsim.vehicles.rigid_body:rigid_body",
}
"""Model name -> the function that makes its vehicle from ``[physics]``."""

DAMPING = np.array([0.05, 0.3, 1.0])
"""Usual damping of a hull over its mass, along body X, Y, Z, 1/s."""
ADDED_MASS = np.array([0.25, 0.9, 0.5, 0.06, 0.6, 1.0])
"""Usual added mass of a hull over its own inertia: roll, pitch, yaw, surge, sway, heave."""

POSITIVE = {"mass", "masses", "inertia", "inertias", "radius", "diameter", "wheelbase", "length", "hitches"}
"""What the names of quantities end in that are nothing unless above zero."""


def available() -> list[str]:
    """Names of the vehicles that ship with vehsim."""
    return list(shipped("vehicle"))


def load_vehicle(name: str | Path) -> Vehicle:
    """A vehicle by the name of a shipped one, or by the path of a folder that holds a ``vehicle.toml``.

    Raises ``InputError`` naming file, key, value and the mend.
    """
    if not isinstance(name, str | Path):
        raise InputError(f"vehicle = {name!r}: give a name or the path of a folder")
    path = Path(name) / "vehicle.toml"
    if not path.is_file():
        path = shipped("vehicle").get(str(name), path)
    if not path.is_file():
        close = get_close_matches(str(name), available(), n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(available())}"
        raise InputError(f"vehicle {str(name)!r}: no such vehicle, nor a folder with a vehicle.toml; {hint}")
    path = path.resolve()
    data = read_vehicle(path)
    asset = path.parent / data.get("asset", "")
    return _load(path, stamp(path), stamp(asset) if asset.is_file() else None)


@lru_cache(maxsize=64)
def _load(path: Path, written: Stamp, asset_written: Stamp | None) -> Vehicle:
    data = read_vehicle(path)
    model = data.get("model")
    if model not in MODELS:
        raise InputError(f"{path}: model = {model!r}: unknown; choose one of {', '.join(sorted(MODELS))}")
    module, _, function = MODELS[model].partition(":")
    factory = getattr(importlib.import_module(module), function)
    physics = _physics(path, factory, _weighed(path, factory, data))
    try:
        vehicle: Vehicle = factory(str(data.get("name", model)), **physics)
    except InputError:
        raise
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:  # of NumPy, of CasADi
        raise InputError(f"{path}: physics: no {model} can be made of it ({error}); compare the model's own") from error
    told: dict[str, Any] = {
        "controls": _controls(path, vehicle, data.get("controls", {})),
        "joint_limits": _limits(path, vehicle, data.get("joints", {})),
        "rig": _rig(path, vehicle, data),
        "top_speed": float(data.get("top_speed", vehicle.top_speed)),
    }
    planar = None if vehicle.planar is None else replace(vehicle.planar, **told | {"rig": _level(told["rig"])})
    return replace(vehicle, **told, hull=_hull(path, vehicle, data), planar=planar)


def _weighed(path: Path, factory: Any, data: dict[str, Any]) -> dict[str, Any]:
    """``[physics]``; where it gives a density, mass and inertia are measured on the asset."""
    physics: dict[str, Any] = data.get("physics", {})
    if "density" not in physics:
        return physics
    if "asset" not in data:
        raise InputError(f"{path}: physics.density = {physics['density']!r}: there is no asset to measure; give mass")
    asset, source = ready_asset(path, data)
    weighed = weigh(path, asset, None if asset != source else str(data.get("root", "")) or None, physics["density"])
    data.setdefault("origin", [float(x) for x in weighed[1]])
    return fill_in(physics, set(inspect.signature(factory).parameters), weighed, np.asarray(data["origin"], float))


def _physics(path: Path, factory: Any, table: dict[str, Any]) -> dict[str, Any]:
    parameters = {p.name: p for p in inspect.signature(factory).parameters.values() if p.kind is p.KEYWORD_ONLY}
    _known(path, "physics.", table, set(parameters))
    missing = [key for key, one in parameters.items() if one.default is one.empty and key not in table]
    if missing:
        keys = ", ".join(f"physics.{key}" for key in missing)
        raise InputError(f"{path}: {keys}: missing; a {factory.__name__} has no numbers of its own; give SI units")
    for key, value in table.items():
        depth = str(parameters[key].annotation).count("Sequence")  # float, Sequence[float] or rows of them
        if _depth(value) != depth:
            kind = ("a number", "a list of numbers", "a list of rows of numbers")[depth]
            raise InputError(f"{path}: physics.{key} = {value!r}: not {kind}; give SI units")
        rows = value if isinstance(value, list) else [value]
        if key.rpartition("_")[2] in POSITIVE and not all(isinstance(x, list) or x > 0 for x in rows):
            raise InputError(f"{path}: physics.{key} = {value!r}: not above zero; give SI units")
    return table


def _controls(path: Path, vehicle: Vehicle, table: dict[str, Any]) -> tuple[Control, ...]:
    _known(path, "controls.", table, set(vehicle.control_names))
    for name, values in table.items():
        if values.get("lower", -math.inf) > values.get("upper", math.inf):
            raise InputError(f"{path}: controls.{name}.lower = {values['lower']!r}: above upper; swap them")
    return tuple(replace(control, **table.get(control.name, {})) for control in vehicle.controls)


def _limits(path: Path, vehicle: Vehicle, table: dict[str, Any]) -> dict[str, tuple[float, float]]:
    _known(path, "joints.", table, set(vehicle.joints))
    for name, values in table.items():
        if not values.get("lower", -math.inf) < values.get("upper", math.inf):
            raise InputError(f"{path}: joints.{name}.lower = {values['lower']!r}: not below upper; swap them")
    return {name: (v.get("lower", -math.inf), v.get("upper", math.inf)) for name, v in table.items()}


def _depth(value: Any) -> int:
    """How deep lists are in each other, -1 where that differs or there is something else."""
    if isinstance(value, list):
        below = {_depth(row) for row in value} or {0}
        return 1 + below.pop() if len(below) == 1 and -1 not in below else -1
    return 0 if isinstance(value, int | float) else -1


def _level(rig: Rig | None) -> Rig | None:
    """The rig of a vehicle that keeps its height: its body frame stands level with the root."""
    return None if rig is None else replace(rig, origin=(*rig.origin[:2], 0.0))


def _hull(path: Path, vehicle: Vehicle, data: dict[str, Any]) -> Any:
    prim = data.get("hull")
    if vehicle.hull is None and prim is not None:
        raise InputError(f"{path}: hull = {prim!r}: {vehicle.name} does not float; leave it out")
    if vehicle.hull is not None and not isinstance(prim, str):
        raise InputError(f"{path}: hull = {prim!r}: name the closed mesh that displaces water, a path below the root")
    if prim is None:
        return None
    if not any(np.any(law) for law in (vehicle.hull.damping, vehicle.hull.quadratic, vehicle.hull.impact)):
        _warn_restless(path, vehicle)
    return replace(vehicle.hull, prim=prim)


def _warn_restless(path: Path, vehicle: Any) -> None:
    """Say what is usual for hulls of its mass and inertia where water would take no energy from one."""
    usual = {"damping": DAMPING * vehicle.mass, "added_mass": ADDED_MASS * np.diag(vehicle.inertia)}
    mend = ", ".join(f"{key} = [{', '.join(f'{x:.3g}' for x in row)}]" for key, row in usual.items())
    warnings.warn(
        f"{path}: physics.damping: missing: without it a boat never comes to rest; begin with {mend}, impact = 1",
        stacklevel=5,
    )


def _rig(path: Path, vehicle: Vehicle, data: dict[str, Any]) -> Rig | None:
    if "asset" not in data:
        return None
    asset, source = ready_asset(path, data)
    origin = tuple(float(x) for x in data.get("origin", (0.0, 0.0, 0.0)))
    channels = data.get("channels", {})
    _known(path, "channels.", channels, set(vehicle.channels))
    drives = {name: _drive(values) for name, values in channels.items()}

    def place(item: tuple[str, Drive]) -> tuple[bool, bool]:  # slide first, then steer, then spin
        return item[1].op.startswith("rotate"), vehicle.channels[item[0]].rate is not None

    drives = dict(sorted(drives.items(), key=place))
    springs = Suspension(**{name: float(value) for name, value in data.get("suspension", {}).items()})
    root = str(data.get("root", ""))
    return Rig(
        asset=asset,
        root=root if asset == source else "",
        origin=origin,  # type: ignore[arg-type]
        drives=drives,
        suspension=springs,
        variants=dict(data.get("variants", {})),
        source=None if asset == source else source,
        source_root=root,
        folder=path.parent,
        named=str(data["asset"]),
    )


def _drive(values: dict[str, Any]) -> Drive:
    pivot = values.get("pivot")
    if isinstance(pivot, list):
        pivot = (float(pivot[0]), float(pivot[1]), float(pivot[2]))
    return Drive(values["prim"], values["op"], pivot, float(values.get("factor", 1.0)), values.get("disc", False))


def _known(path: Path, prefix: str, table: dict[str, Any], known: set[str]) -> None:
    for key in table:
        if key not in known:
            close = get_close_matches(key, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(sorted(known))}"
            raise InputError(f"{path}: {prefix}{key} = {table[key]!r}: unknown key; {hint}")
