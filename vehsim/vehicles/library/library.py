"""Vehicles by name or folder: ``vehicle.toml`` gives the physics and the rig, a model gives the equations."""

from __future__ import annotations

import inspect
import json
import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.assets import described, description
from vehsim.errors import InputError
from vehsim.intake.tables import suggestion
from vehsim.intake.toml import lines_in
from vehsim.rig.rig import DISC_PITCH, DISC_ROLL, HITCH_PITCH, HITCH_ROLL, Channel, Drive, Rig, Suspension
from vehsim.runtime.cache import Stamp, stamp
from vehsim.runtime.registry import Registry
from vehsim.vehicles.definition.base import Control
from vehsim.vehicles.definition.character import Character, Trait
from vehsim.vehicles.definition.coefficients import LEVEL, Coefficients
from vehsim.vehicles.library.file import SuspensionTable, VehicleFile, read_vehicle, vehicle_files
from vehsim.vehicles.library.imported import ready_asset
from vehsim.vehicles.library.mass import fill_in, weigh
from vehsim.vehicles.library.parameters import (
    TOPS,
    blamed,
    check_effect,
    check_parameters,
    check_physics,
    in_unit,
    physics_table,
    replaced,
    words_of,
)

if TYPE_CHECKING:
    from vehsim.vehicles.definition.vehicle import Vehicle

MODELS: Registry[Callable[..., Vehicle]] = Registry(
    "vehsim.models",
    {
        "helicopter": "vehsim.vehicles.models.helicopter:helicopter",
        "boat": "vehsim.vehicles.models.boat:boat",
        "car": "vehsim.vehicles.models.car:car",
        "truck": "vehsim.vehicles.models.truck:truck",
        "hopper": "vehsim.vehicles.models.hopper:hopper",
        "simple_car": "vehsim.vehicles.models.simple_car:simple_car",
        "drift_car": "vehsim.vehicles.models.drift_car:drift_car",
        "four_wheel_car": "vehsim.vehicles.models.four_wheel_car:four_wheel_car",
        "two_wheeled": "vehsim.vehicles.models.two_wheeled:two_wheeled",
        "snakeboard": "vehsim.vehicles.models.snakeboard:snakeboard",
        "chaplygin_sleigh": "vehsim.vehicles.models.chaplygin_sleigh:chaplygin_sleigh",
        "roller_racer": "vehsim.vehicles.models.roller_racer:roller_racer",
        "car_trailer": "vehsim.vehicles.models.car_trailer:car_trailer",
        "suslov": "vehsim.vehicles.models.suslov:suslov",
        "rigid_body": "vehsim.vehicles.models.rigid_body:rigid_body",
    },
)
"""Model name -> the function that makes its vehicle from ``[physics]``. Packages add theirs as entry points."""

DAMPING = np.array([0.05, 0.3, 1.0])
"""Usual damping of a hull divided by its mass, along body X, Y, Z, 1/s."""
ADDED_MASS = np.array([0.25, 0.9, 0.5, 0.06, 0.6, 1.0])
"""Usual added mass of a hull divided by its own inertia: roll, pitch, yaw, surge, sway, heave."""
IMPACT = 1.0
"""Usual pressure where a hull meets the water, over its dynamic pressure."""
NUMBERED = re.compile(r"_[1-9][0-9]*$")
"""The end of the name of a channel that moves one of several prims."""
SHORT: Any = {"float": "{:.3g}".format}
"""How messages give numbers."""


def available() -> list[str]:
    """Names of the vehicles that ship with vehsim or that an installed package registers."""
    return list(described("vehicle"))


def load_vehicle(name: str | Path, parameters: Mapping[str, Any] | None = None) -> Vehicle:
    """A shipped vehicle by name, or the vehicle in a folder with a ``vehicle.toml``, or of that file.

    ``parameters`` replace numbers of the file: those of ``[physics]`` by their names, such as ``{"mass": 1500.0}``, and
    tables ``controls``, ``actuators``, ``joints``, ``character`` and ``suspension``, ``top_speed`` and
    ``top_turn_rate`` as they stand in the file, each number on its own; SI units.
    Raises ``InputError`` naming file, key, value and the fix.
    """
    path = _file(name)
    data = read_vehicle(path)
    asset = path.parent / data.get("asset", "")
    given = _as_data(parameters or {})
    text = json.dumps(given, sort_keys=True, default=str)
    try:
        with lines_in(path):
            written = tuple(stamp(file) for file in (*vehicle_files(path), asset) if file.is_file())
            return _load(path, written, text)
    except InputError as error:
        if not given:
            raise
        raise type(error).of(*(blamed(problem, given, data) for problem in error.problems)) from None


def parameters_of(name: str | Path) -> Iterator[tuple[str, Any, str]]:
    """Dotted key, value and description with unit of every parameter of a vehicle. Raises ``InputError``."""
    path = _file(name)
    data, vehicle = read_vehicle(path), load_vehicle(name)
    factory = MODELS[data["model"]]
    physics = _measured(path, data, _weighed(path, factory, data))
    for key, field in physics_table(factory).model_fields.items():
        yield key, physics.get(key, field.default), str(field.description)
    for control in vehicle.controls:
        for bound in ("lower", "upper", "scale"):
            yield f"controls.{control.name}.{bound}", getattr(control, bound), f"in {control.unit or 'SI units'}"
        actuator, key, source = control.actuator, f"actuators.{control.name}", control.actuator.source
        unit, why = control.unit or "SI units", f": {source}" if source else ""
        yield f"{key}.rate", actuator.rate, f"in {unit} per second{why}"
        yield f"{key}.lag", actuator.lag, f"in s{why}"
    for joint, bounds in vehicle.joint_limits.items():
        for bound, value in zip(("lower", "upper"), bounds, strict=True):
            yield f"joints.{joint}.{bound}", value, in_unit(data, "joints", joint)
    for key, field in SuspensionTable.model_fields.items() if "suspension" in data else ():
        yield f"suspension.{key}", data["suspension"].get(key, field.default), words_of(SuspensionTable, key)
    for key in TOPS:
        yield key, getattr(vehicle, key), words_of(VehicleFile, key)


def _file(name: str | Path) -> Path:
    """The ``vehicle.toml`` of a vehicle."""
    if not isinstance(name, str | Path):
        raise InputError("not a vehicle's name", "give a name or the path of a folder", key="vehicle", value=name)
    path = Path(name)
    path = path if path.name == "vehicle.toml" else path / "vehicle.toml"
    if not path.is_file():
        path = description("vehicle", str(name)) or path
    if not path.is_file():
        close = get_close_matches(str(name), available(), n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(available())}"
        raise InputError("no such vehicle, nor a folder with a vehicle.toml", hint, key="vehicle", value=str(name))
    return path.resolve()


def _as_data(parameters: Any) -> Any:
    """Parameters as TOML would give them."""
    if isinstance(parameters, Mapping):
        return {str(key): _as_data(value) for key, value in parameters.items()}
    if isinstance(parameters, np.ndarray | np.generic):
        return parameters.tolist()
    return [_as_data(value) for value in parameters] if isinstance(parameters, list | tuple) else parameters


@lru_cache(maxsize=256)
def _load(path: Path, written: tuple[Stamp, ...], parameters: str) -> Vehicle:
    data, given = read_vehicle(path), json.loads(parameters)
    model = str(data.get("model"))
    if model not in MODELS:
        raise InputError("unknown", f"choose one of {', '.join(sorted(MODELS))}", key="model", value=model, file=path)
    factory = MODELS[model]
    if given:
        check_parameters(factory, given)
        check_effect(factory, data.get("physics", {}), given)
        data = replaced(data, given)
    physics = _measured(path, data, _weighed(path, factory, data))
    try:
        check_physics(factory, physics)
    except InputError as error:
        raise InputError.of(*(replace(each, file=str(path)) for each in error.problems)) from None
    coefficients, physics = _coefficients(path, data, physics)
    if coefficients is None:
        physics = _with_usual_damping(path, factory, data, physics)
    try:
        vehicle: Vehicle = factory(str(data.get("name", model)), **physics)
    except InputError:
        raise
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:  # raised by NumPy or CasADi
        raise InputError(
            f"the model {model} does not accept these numbers ({error})",
            "compare them with a shipped vehicle.toml",
            key="physics",
            file=path,
        ) from error
    tables = _one_prim_each(data.get("channels", {}))
    channels = _channels(path, vehicle, tables)
    settings: dict[str, Any] = {
        "controls": _controls(path, vehicle, data.get("controls", {}), data.get("actuators", {})),
        "joint_limits": _limits(path, vehicle, data.get("joints", {})),
        "joint_units": {name: row["unit"] for name, row in data.get("joints", {}).items() if row.get("unit")},
        "character": _character(path, vehicle, data.get("character", {})),
        "channels": channels,
        "rig": _rig(path, channels, tables, data),
        **{key: float(data.get(key, getattr(vehicle, key))) for key in TOPS},
        "parameters": given,
    }
    whole = replace(vehicle, **settings, hull=_hull(path, vehicle, data, coefficients), planar=None)
    if vehicle.planar is None:
        return whole
    planar = replace(vehicle.planar, **settings | {"rig": _level(settings["rig"])}, floating=whole)
    return replace(whole, planar=planar)


def _weighed(path: Path, factory: Any, data: dict[str, Any]) -> dict[str, Any]:
    """``[physics]``; if it has a density, mass and inertia are measured on the asset."""
    physics: dict[str, Any] = data.get("physics", {})
    if "density" not in physics:
        return physics
    if "asset" not in data:
        raise InputError(
            "there is no asset to measure", "give mass", key="physics.density", value=physics["density"], file=path
        )
    asset, source = ready_asset(path, data)
    weighed = weigh(path, asset, None if asset != source else str(data.get("root", "")) or None, physics["density"])
    data.setdefault("origin", [float(x) for x in weighed[1]])
    return fill_in(physics, set(inspect.signature(factory).parameters), weighed, np.asarray(data["origin"], float))


def _measured(path: Path, data: dict[str, Any], physics: dict[str, Any]) -> dict[str, Any]:
    """``[physics]`` with the particulars of the hull's form; those that it lacks are measured on the mesh."""
    form = data.get("hull_form")
    if form is None or not isinstance(data.get("hull"), str) or "asset" not in data or "mass" not in physics:
        return physics
    keys = ("wetted_length", "wetted_area") + (("chine_beam", "deadrise", "transom") if form == "planing" else ())
    if all(key in physics for key in keys):
        return physics
    from vehsim.rig.parts import read_mesh
    from vehsim.vehicles.library.hull_form import particulars

    asset, source = ready_asset(path, data)
    points, faces = read_mesh(asset, str(data.get("root", "")) if asset == source else "", data["hull"])
    origin = np.asarray(data.get("origin", (0.0, 0.0, 0.0)), float)
    try:
        found = particulars(points - origin, faces, float(physics["mass"]), form == "planing")
    except InputError as error:
        raise InputError.of(*(replace(each, file=str(path)) for each in error.problems)) from None
    return {**found, **physics}


def _controls(path: Path, vehicle: Vehicle, table: dict[str, Any], actuators: dict[str, Any]) -> tuple[Control, ...]:
    _known(path, "controls.", table, set(vehicle.control_names))
    _known(path, "actuators.", actuators, set(vehicle.control_names))
    for name, values in table.items():
        if values.get("lower", -math.inf) > values.get("upper", math.inf):
            raise InputError("above upper", "swap them", key=f"controls.{name}.lower", value=values["lower"], file=path)
    return tuple(
        replace(
            control,
            **table.get(control.name, {}),
            actuator=replace(control.actuator, **actuators.get(control.name, {})),
        )
        for control in vehicle.controls
    )


def _limits(path: Path, vehicle: Vehicle, table: dict[str, Any]) -> dict[str, tuple[float, float]]:
    _known(path, "joints.", table, set(vehicle.joints))
    for name, values in table.items():
        if not values.get("lower", -math.inf) < values.get("upper", math.inf):
            raise InputError(
                "not below upper", "swap them", key=f"joints.{name}.lower", value=values["lower"], file=path
            )
    return {name: (v.get("lower", -math.inf), v.get("upper", math.inf)) for name, v in table.items()}


def _character(path: Path, vehicle: Vehicle, table: dict[str, Any]) -> Character:
    _known(path, "character.control_rates.", table.get("control_rates", {}), set(vehicle.control_names))
    own, traits, stunts = vehicle.character, {}, table.get("stunt_controls", vehicle.character.stunt_controls)
    _known(path, "character.stunt_controls.", dict.fromkeys(stunts), set(vehicle.control_names))
    for kind in ("costs", "limits", "control_rates", "review"):
        known = getattr(own, kind)
        rows = table.get(kind, {})
        traits[kind] = {name: _trait(path, f"{kind}.{name}", known.get(name), row) for name, row in rows.items()}
    traits["review"] = {**own.review, **traits["review"]}
    response = _trait(path, "response", own.response, table.get("response", {}))
    return replace(own, response=response, stunt_controls=tuple(stunts), **traits)


def _trait(path: Path, key: str, default: Trait | None, row: dict[str, Any]) -> Trait:
    """The trait of a row, with the numbers that it lacks from the ``default``. Raises ``InputError``."""
    known = {} if default is None else vars(default)
    if missing := [name for name in ("calm", "normal", "brisk") if name not in {**known, **row}]:
        remedy = f"give {', '.join(missing)} too: there is no other number"
        raise InputError("incomplete", remedy, key=f"character.{key}", value=row, file=path)
    return Trait(**{**known, **row})


def _level(rig: Rig | None) -> Rig | None:
    """The rig of a vehicle that keeps its height: its body frame is at the root's height."""
    return None if rig is None else replace(rig, origin=(*rig.origin[:2], 0.0))


def _coefficients(
    path: Path, data: dict[str, Any], physics: dict[str, Any]
) -> tuple[Coefficients | None, dict[str, Any]]:
    """The hull's coefficients, overridden by ``[physics]``; and that with the added mass that it lacks, which plans
    use."""
    named = data.get("hydrodynamics")
    if named is None:
        return None, physics
    if not isinstance(data.get("hull"), str):
        raise InputError("there is no hull", "leave it out", key="hydrodynamics", value=named, file=path)
    file = path.parent / named
    if not file.is_file():
        raise InputError("no such file", "write it with vehsim hydro", key="hydrodynamics", value=named, file=path)
    found = Coefficients.load(file).overridden(physics.get("added_mass"), physics.get("damping"))
    plane = np.isin(np.arange(6), LEVEL)
    return found, {"added_mass": np.diag(np.where(plane, found.slow, found.infinite)).tolist(), **physics}


def _hull(path: Path, vehicle: Vehicle, data: dict[str, Any], coefficients: Coefficients | None) -> Any:
    prim = data.get("hull")
    if vehicle.hull is None and prim is not None:
        raise InputError(f"{vehicle.name} does not float", "leave it out", key="hull", value=prim, file=path)
    if vehicle.hull is not None and not isinstance(prim, str):
        raise InputError(
            "missing",
            "name the closed mesh that displaces water, a path below the root",
            key="hull",
            value=prim,
            file=path,
        )
    if prim is None:
        return None
    laws = (vehicle.hull.damping, vehicle.hull.quadratic, vehicle.hull.impact)
    if (coefficients is None or coefficients.memory is None) and not any(np.any(law) for law in laws):
        warnings.warn(
            f"{path}: physics.damping: none: without it a boat never comes to rest; give damping, or compute it with "
            "vehsim hydro (pip install 'vehsim[hydro]')",
            stacklevel=4,
        )
    return replace(vehicle.hull, prim=prim, coefficients=coefficients)


def _with_usual_damping(path: Path, factory: Any, data: dict[str, Any], physics: dict[str, Any]) -> dict[str, Any]:
    """``[physics]`` with `DAMPING` and `ADDED_MASS` if its hull says nothing about damping; warns of it. The resistance
    ahead of a hull with a form is that of the form."""
    laws = ("damping", "damping_quadratic", "impact")
    known = inspect.signature(factory).parameters
    if "hull" not in data or not {*laws, "mass", "inertia"} <= set(known) or any(law in physics for law in laws):
        return physics
    mass, ahead = float(physics["mass"]), np.array(["hull_form" not in data, 1.0, 1.0])
    own = np.append(np.asarray(physics["inertia"], float), 3 * [mass])
    usual = {"damping": ahead * DAMPING * mass, "added_mass": ADDED_MASS * own, "impact": np.array(IMPACT)}
    used = {name: _as_data(value.round(6)) for name, value in usual.items() if name not in physics}
    said = ", ".join(f"{name} = {np.array2string(usual[name], separator=', ', formatter=SHORT)}" for name in used)
    warnings.warn(
        f"{path}: physics.damping: missing: usual values for its mass and inertia are used, {said}; better ones come "
        "from vehsim hydro (pip install 'vehsim[hydro]')",
        stacklevel=4,
    )
    return {**physics, **used}


def _one_prim_each(tables: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """``[channels.NAME]`` with a channel for every prim: of several prims, NAME_1, NAME_2 and so on."""
    found: dict[str, dict[str, Any]] = {}
    for name, table in tables.items():
        several = isinstance(table["prim"], list)
        each = {f"{name}_{k}": prim for k, prim in enumerate(table["prim"], 1)} if several else {name: table["prim"]}
        found |= {key: {**table, "prim": prim} for key, prim in each.items()}
    return found


def _channels(path: Path, vehicle: Vehicle, tables: Mapping[str, Any]) -> dict[str, Channel]:
    """The model's channels; one that moves several prims is there for each of them, with a number after its name."""
    own = dict(vehicle.channels)
    numbered = {name: name.rpartition("_")[0] for name in tables if name not in own and NUMBERED.search(name)}
    _known(path, "channels.", {numbered.get(name, name): None for name in tables}, set(own))
    several = {name: own[whole] for name, whole in numbered.items()}
    return {name: channel for name, channel in own.items() if name not in numbered.values()} | several


def _rig(path: Path, channels: Mapping[str, Channel], tables: Mapping[str, Any], data: dict[str, Any]) -> Rig | None:
    if "asset" not in data:
        return None
    asset, source = ready_asset(path, data)
    origin = tuple(float(x) for x in data.get("origin", (0.0, 0.0, 0.0)))
    drives = {name: _drive(values) for name, values in tables.items()}

    def place(item: tuple[str, Drive]) -> tuple[bool, bool, int]:  # order: slide, steer, pitch, roll, spin
        name, drive = item
        tilt = 1 * name.startswith((HITCH_PITCH, DISC_PITCH)) + 2 * name.startswith((HITCH_ROLL, DISC_ROLL))
        return drive.op.startswith("rotate"), channels[name].rate is not None, tilt

    drives = dict(sorted(drives.items(), key=place))
    springs = Suspension(**{name: float(value) for name, value in data.get("suspension", {}).items()})
    root = str(data.get("root", ""))
    return Rig(
        asset=asset,
        root=root if asset == source else "",
        origin=origin,  # type: ignore[arg-type]  # checked by the file's schema
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
            raise InputError(
                "unknown key", suggestion(key, sorted(known)), key=f"{prefix}{key}", value=table[key], file=path
            )
