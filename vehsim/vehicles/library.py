"""Vehicles by name or folder: ``vehicle.toml`` gives the physics and the rig, a model gives the equations."""

from __future__ import annotations

import importlib
import inspect
import math
import tomllib
import warnings
from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.assets import shipped
from vehsim.errors import InputError
from vehsim.vehicles._base import Control, Drive, Rig, Suspension
from vehsim.vehicles._imported import KEYS, ready_asset
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

_TOP = {"schema", "name", "model", "asset", "root", "origin", "hull", "physics", "controls", "joints", "channels"}
_TOP |= {"suspension", "top_speed"} | KEYS


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
    return _load(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _load(path: Path, changed: int) -> Vehicle:
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    _known(path, "", data, _TOP)
    model = data.get("model")
    if model not in MODELS:
        raise InputError(f"{path}: model = {model!r}: unknown; choose one of {', '.join(sorted(MODELS))}")
    module, _, function = MODELS[model].partition(":")
    factory = getattr(importlib.import_module(module), function)
    vehicle: Vehicle = factory(str(data.get("name", model)), **_physics(path, factory, _weighed(path, factory, data)))
    told: dict[str, Any] = {
        "controls": _controls(path, vehicle, data.get("controls", {})),
        "joint_limits": _limits(path, vehicle, data.get("joints", {})),
        "rig": _rig(path, vehicle, data),
        "top_speed": _top_speed(path, data),
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
    for key in parameters:
        for number in _flat(table.get(key, 0.0)):
            if not isinstance(number, int | float) or isinstance(number, bool) or not math.isfinite(number):
                raise InputError(f"{path}: physics.{key} = {table[key]!r}: not a finite number; give SI units")
    return table


def _controls(path: Path, vehicle: Vehicle, table: dict[str, Any]) -> tuple[Control, ...]:
    _known(path, "controls.", table, set(vehicle.control_names))
    for name, values in table.items():
        _known(path, f"controls.{name}.", values, {"lower", "upper", "scale", "unit"})
        if values.get("lower", -math.inf) > values.get("upper", math.inf):
            raise InputError(f"{path}: controls.{name}.lower = {values['lower']!r}: above upper; swap them")
    return tuple(replace(control, **table.get(control.name, {})) for control in vehicle.controls)


def _limits(path: Path, vehicle: Vehicle, table: dict[str, Any]) -> dict[str, tuple[float, float]]:
    _known(path, "joints.", table, set(vehicle.joints))
    for name, values in table.items():
        _known(path, f"joints.{name}.", values, {"lower", "upper"})
    return {name: (v.get("lower", -math.inf), v.get("upper", math.inf)) for name, v in table.items()}


def _top_speed(path: Path, data: dict[str, Any]) -> float:
    from vehsim.vehicles._base import Vehicle

    value = data.get("top_speed", Vehicle.top_speed)
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise InputError(f"{path}: top_speed = {value!r}: give a speed above zero, in m/s")
    return float(value)


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
    if len(origin) != 3:
        raise InputError(f"{path}: origin = {data['origin']!r}: give three numbers, m, in the rig root's frame")
    channels = data.get("channels", {})
    _known(path, "channels.", channels, set(vehicle.channels))
    ops = {f"{kind}{axis}" for kind in ("rotate", "translate") for axis in "XYZ"}
    for name, values in channels.items():
        _known(path, f"channels.{name}.", values, {"prim", "op", "pivot", "factor", "disc"})
        if not isinstance(values.get("prim"), str):
            raise InputError(f"{path}: channels.{name}.prim = {values.get('prim')!r}: give a path below the rig root")
        if values.get("op") not in ops:
            raise InputError(f"{path}: channels.{name}.op = {values.get('op')!r}: choose one of {sorted(ops)}")
    drives = {name: _drive(path, name, values) for name, values in channels.items()}

    def place(item: tuple[str, Drive]) -> tuple[bool, bool]:  # slide first, then steer, then spin
        return item[1].op.startswith("rotate"), vehicle.channels[item[0]].rate is not None

    drives = dict(sorted(drives.items(), key=place))
    springs = _suspension(path, data.get("suspension", {}))
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


def _drive(path: Path, name: str, values: dict[str, Any]) -> Drive:
    pivot, factor = values.get("pivot"), values.get("factor", 1.0)
    if isinstance(pivot, list) and len(pivot) == 3 and all(isinstance(x, int | float) for x in pivot):
        pivot = (float(pivot[0]), float(pivot[1]), float(pivot[2]))
    if pivot not in (None, "centre") and not isinstance(pivot, tuple):
        raise InputError(f'{path}: channels.{name}.pivot = {pivot!r}: give "centre" or three numbers, m')
    if isinstance(factor, bool) or not isinstance(factor, int | float) or not math.isfinite(factor) or factor == 0:
        raise InputError(f"{path}: channels.{name}.factor = {factor!r}: give a number such as -1")
    disc = values.get("disc", False)
    if not isinstance(disc, bool | str):
        raise InputError(f"{path}: channels.{name}.disc = {disc!r}: give true, or a pattern of meshes' names")
    return Drive(values["prim"], values["op"], pivot, float(factor), disc)


def _suspension(path: Path, table: dict[str, Any]) -> Suspension:
    _known(path, "suspension.", table, set(Suspension.__dataclass_fields__))
    for name, value in table.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and math.isfinite(value) and (value > 0 or (value == 0 and name == "mass_height"))):
            raise InputError(f"{path}: suspension.{name} = {value!r}: give a positive number, in Hz, of 1, or in m")
    return Suspension(**{name: float(value) for name, value in table.items()})


def _known(path: Path, prefix: str, table: dict[str, Any], known: set[str]) -> None:
    for key in table:
        if key not in known:
            close = get_close_matches(key, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(sorted(known))}"
            raise InputError(f"{path}: {prefix}{key} = {table[key]!r}: unknown key; {hint}")


def _flat(value: Any) -> list[Any]:
    return [x for item in value for x in _flat(item)] if isinstance(value, list) else [value]
