"""Inspect an asset: its prims, axes and sizes, its possible wheels and rotors, and a first vehicle.toml.

This module measures and guesses. It prints every guess with its reason, so that you can correct the file. Parts are
read as vehicles read them (`vehsim.rig.parts`).
"""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.intake.polygons import has_polygons
from vehsim.intake.reader import Answer, read_cached
from vehsim.intake.usd import SUFFIXES, open_stage
from vehsim.rig.rig import CONING, DISC_PITCH, DISC_ROLL

if TYPE_CHECKING:
    from vehsim.rig.parts import Part

Array = NDArray[np.float64]

ROUND = 1.08
"""Largest ratio of radii of a part that counts as round: a cylinder with eight sides is round."""
THIN = 1.2
"""Largest ratio of width to diameter of a wheel: an axle with both its wheels is wider."""
SMALL = 0.6
"""Smallest ratio of a load-bearing wheel's radius to the largest: smaller wheels are castors."""
MOST_PRIMS = 120
MOST_PARTS = 1000
GIVE = "give a USD, GLB, glTF or OBJ file, or a vehicle's folder"
ROTOR = re.compile(r"rotor|propel|prop(?![a-z])|fan(?![a-z])|blade", re.IGNORECASE)
FRONT = {"front", "fl", "fr", "lf", "rf", "steer", "steering", "nose", "vorn"}
REAR = {"rear", "back", "rl", "rr", "lr", "bl", "br", "tail", "outboard", "propeller", "rudder", "stern"}
AXES = np.eye(3)
UNITS = ((400.0, 0.001), (40.0, 0.01))
"""A file without a unit is read as millimetres or centimetres above these sizes, else as metres."""


@dataclass(frozen=True)
class Round:
    """A part that could turn: ``spin`` and ``steer`` are prim paths, the innermost and outermost that contain only it.

    ``centre`` (3,) m; ``op`` the letter of the prim's own axis of rotation, ``axis`` (3,) its direction; ``up`` the
    letter and direction of the steering prim's axis closest to the vertical; ``radius`` m; ``pivoted``: whether the
    prims' own pivots are at the centre of rotation.
    """

    spin: str
    steer: str
    centre: Array
    op: str
    axis: Array
    up: tuple[str, Array]
    radius: float
    pivoted: bool


@dataclass(frozen=True)
class Inspection:
    """The result: ``keys`` of a vehicle.toml that turn the asset upright, ``reasons``: the reasons; all else in that
    frame."""

    asset: Path
    keys: dict[str, Any]
    reasons: dict[str, str]
    parts: list[Part]
    ready: Path
    wheels: list[Round]
    rotors: list[Round]

    @property
    def bounds(self) -> Array:
        """(2, 3) m: lowest and highest corner, nose along X."""
        points = np.concatenate([_points(part) for part in self.parts])
        return np.array([points.min(0), points.max(0)])


def inspect(path: Path) -> Inspection:
    """Inspect a USD, GLB, glTF or OBJ file, or the asset of a vehicle's folder. Raises ``InputError``."""
    from vehsim.vehicles.library.imported import MESHES

    folder = path if path.is_dir() else None
    keys: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    if folder is not None:
        path, keys = _of_folder(folder)
        reasons = dict.fromkeys(keys, "vehicle.toml")
    if not path.is_file():
        raise InputError("no such file", GIVE, file=path)
    if path.suffix.lower() not in (*MESHES, *SUFFIXES):
        raise InputError("not USD, GLB, glTF or OBJ", GIVE, file=path)
    if path.suffix.lower() == ".obj" and "up_axis" not in keys:
        unit, why = _unit_of_obj(path), "not given in an OBJ; guessed from its"
        reasons |= {"up_axis": f"{why} wheels", "meters_per_unit": f"{why} size"}
        options = [_upright_asset(path, keys | {"up_axis": up, "meters_per_unit": unit}, reasons) for up in ("Y", "Z")]
        return next((found for found in options if found.wheels or found.rotors), options[0])
    return _upright_asset(path, keys if "root" in keys else keys | _root(path), reasons)


def _upright_asset(path: Path, keys: dict[str, Any], reasons: dict[str, str]) -> Inspection:
    """The asset turned upright with its nose along X, and its parts that could turn."""
    from vehsim.rig.parts import read_parts

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # `vehsim check` reports them for the vehicle
        if "forward" not in keys:
            up = str(keys.get("up_axis") or _up_axis(path, keys))
            asset, root = _read(path, keys | {"forward": "+X"})
            parts = _few(path, read_parts(asset, root))
            wheels, _ = _turning(parts, asset, root)
            forward, why = _forward(parts, up, sum((np.abs(wheel.axis) for wheel in wheels), np.zeros(3)))
            keys, reasons = keys | {"forward": forward}, reasons | {"forward": why}
        ready, root = _read(path, keys)
        parts = _few(path, read_parts(ready, root))
        return Inspection(path, keys, reasons, parts, ready, *_turning(parts, ready, root))


def _few(path: Path, parts: list[Part]) -> list[Part]:
    """The parts, if they are few enough: each is compared with all others."""
    if len(parts) > MOST_PARTS:
        said = f"{len(parts):,} parts, at most {MOST_PARTS:,}"
        raise InputError(said, "inspect the vehicle alone, or join parts that do not move", file=path)
    return parts


# ---------------------------------------------------------------- reading


def _of_folder(folder: Path) -> tuple[Path, dict[str, Any]]:
    from vehsim.vehicles.library.file import read_vehicle
    from vehsim.vehicles.library.imported import KEYS

    toml = folder / "vehicle.toml"
    if not toml.is_file():
        raise InputError("no vehicle.toml in it", "give the asset's file", file=folder)
    data = read_vehicle(toml)
    if "asset" not in data:
        raise InputError("names no asset", file=toml)
    keys = {key: data[key] for key in ("root", *KEYS) if key in data}
    return folder / str(data["asset"]), {"forward": "+X"} | keys


def _unit_of_obj(path: Path) -> float:
    """The unit, m, that gives a plausible size of a vehicle."""
    extent = float(read_cached(extent_of_obj, path, "asset")[0])
    return next((unit for least, unit in UNITS if extent > least), 1.0)


def extent_of_obj(path: Path) -> Answer:
    """The longest side of an OBJ file, in its own unit. It runs in the reader process."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    points = [line.split()[1:4] for line in lines if line.startswith("v ")]
    if not points:
        raise InputError("no vertex in it", "export it again, or as USD", file=path)
    return float(np.ptp(np.array(points, float), axis=0).max()), []


def _data(path: Path, keys: Mapping[str, Any]) -> dict[str, Any]:
    return {"asset": path.name, **keys}


def _read(path: Path, keys: Mapping[str, Any]) -> tuple[Path, str | None]:
    """The file that vehsim reads of the asset with these keys, and the root prim in it."""
    from vehsim.vehicles.library.imported import ready_asset

    ready, source = ready_asset(path.parent / "vehicle.toml", _data(path, keys))
    return ready, (str(keys.get("root", "")) or None) if ready == source else None


def _source(path: Path, keys: Mapping[str, Any]) -> Path:
    """The asset itself as USD, in its own axes and units."""
    from vehsim.vehicles.library.imported import ready_asset

    return ready_asset(path.parent / "vehicle.toml", _data(path, keys))[1]


def _root(path: Path) -> dict[str, str]:
    """The only top prim, if the file names none."""

    if path.suffix.lower() not in SUFFIXES:
        return {}
    stage = open_stage(path, load=False)
    if stage.GetDefaultPrim():
        return {}
    tops = stage.GetPseudoRoot().GetChildren()
    tops = [prim for prim in tops if prim.GetTypeName() in ("Xform", "") or has_polygons(prim)]
    if len(tops) != 1:
        names = ", ".join(str(prim.GetPath()) for prim in tops) or "none"
        raise InputError(f"no defaultPrim, and several prims could be the vehicle: {names}", "author one", file=path)
    return {"root": str(tops[0].GetPath())}


def _up_axis(path: Path, keys: Mapping[str, Any]) -> str:
    from pxr import UsdGeom

    return str(UsdGeom.GetStageUpAxis(open_stage(_source(path, keys), load=False)))


def _points(part: Part) -> Array:
    return np.asarray(part.points @ part.T_rp[:3, :3].T + part.T_rp[:3, 3])


# ---------------------------------------------------------------- guessing


def _turning(parts: Sequence[Part], asset: Path, root: str | None) -> tuple[list[Round], list[Round]]:
    """Possible wheels, on the ground, and rotors, by their names; each once."""
    below = {
        part.path: [p for p in parts if p.path == part.path or p.path.startswith(f"{part.path}/")] for part in parts
    }
    whole = {path: np.concatenate([np.zeros((0, 3)), *map(_points, group)]) for path, group in below.items() if path}
    driven = {
        path: points for path, points in whole.items() if len(points) > 3 and not _inside_instance(asset, root, path)
    }
    floor = min((points[:, 2].min() for points in whole.values() if len(points)), default=0.0)
    by_path = {part.path: part for part in parts}
    wheels: list[Round] = []
    rotors: list[Round] = []
    for path, points in sorted(driven.items()):  # parents before children
        part = by_path[path]
        for op, axis, radius, centre, is_round in _spins(part, points):
            named = ROTOR.search(path.rpartition("/")[2]) is not None
            stands = is_round and abs(axis[2]) < 0.3 and centre[2] - radius < floor + 0.2 * radius
            if not (named or stands):
                continue
            found = rotors if named else wheels
            outer = next((one for one in found if np.linalg.norm(one.centre - centre) < 0.3 * one.radius), None)
            if outer is not None and len(whole[outer.spin]) > len(points):
                continue  # a tyre or a hub: the prim that holds both turns
            if outer is not None:
                found.remove(outer)
            steer = outer.steer if outer is not None and path.startswith(f"{outer.steer}/") else path
            offset = part.T_rp[:3, 3] - centre
            pivoted = bool(np.linalg.norm(offset - axis * (offset @ axis)) < 0.03 * radius)
            found.append(Round(path, steer, centre, op, axis, _upright(by_path[steer]), radius, pivoted))
    return wheels, rotors


def _spins(part: Part, points: Array) -> Iterator[tuple[str, Array, float, Array, bool]]:
    """Its possible axis of rotation: letter, direction, radius, centre, and whether it is round."""
    found = []
    for letter, axis in zip("XYZ", part.T_rp[:3, :3].T, strict=True):
        side = np.cross(axis, AXES[int(np.argmin(np.abs(axis)))])
        side /= np.linalg.norm(side)
        across = np.stack([side, np.cross(axis, side)])
        flat, along = points @ across.T, points @ axis
        middle = (flat.min(0) + flat.max(0)) / 2
        angles = np.linspace(0, 2 * np.pi, 36, endpoint=False)
        reach = ((flat - middle) @ np.stack([np.cos(angles), np.sin(angles)])).max(0)
        if not reach.max() < ROUND * reach.min():
            middle = _enclosing(flat, middle)  # three blades have their box's middle elsewhere
            reach = ((flat - middle) @ np.stack([np.cos(angles), np.sin(angles)])).max(0)
        width, radius = float(np.ptp(along)), float(reach.max())
        if radius > 0 and width < THIN * 2 * radius:
            centre = middle @ across + axis * (along.min() + along.max()) / 2
            found.append((width / radius, letter, axis, radius, centre, bool(reach.max() < ROUND * reach.min())))
    best = sorted(found, key=lambda one: (not one[-1], one[0]))[:1]
    yield from ((letter, axis, radius, centre, rim) for _, letter, axis, radius, centre, rim in best)


def _enclosing(points: Array, centre: Array) -> Array:
    """The centre (2,) of the smallest circle around points (n, 2), within 0.3 % of its radius (Badoiu and Clarkson)."""
    for k in range(1, 400):
        centre = centre + (points[np.argmax(((points - centre) ** 2).sum(axis=1))] - centre) / (k + 1)
    return centre


def _inside_instance(asset: Path, root: str | None, path: str) -> bool:

    stage = open_stage(asset)
    top = stage.GetPrimAtPath(root if root.startswith("/") else f"/{root}") if root else stage.GetDefaultPrim()
    prim = stage.GetPrimAtPath(top.GetPath().AppendPath(path))
    return bool(prim and prim.IsInstanceProxy())


def _words(path: str) -> set[str]:
    return set(re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", path.rpartition("/")[2]).lower())) - {""}


def _forward(parts: Sequence[Part], up: str, axles: Array) -> tuple[str, str]:
    """Direction of the nose in the asset's own axes, and the reason.

    ``parts`` are upright, but not rotated otherwise. ``axles`` (3,): the axes along which wheels turn; zeros without
    wheels.
    """
    named = [(_all_words(part), _points(part).mean(0)) for part in parts if len(part.points)]
    front = [centre for words, centre in named if words & FRONT and not words & REAR]
    rear = [centre for words, centre in named if words & REAR and not words & FRONT]
    middle = np.mean([centre for _, centre in named], axis=0) if named else np.zeros(3)
    extent = np.ptp(np.concatenate([_points(part) for part in parts]), axis=0)[:2]
    forward = (np.mean(front, axis=0) if front else middle) - (np.mean(rear, axis=0) if rear else middle)
    why = "parts are named front or rear"
    if not (front or rear) or np.abs(forward[:2]).max() < 0.05 * extent.max():
        long = int(np.argmin(axles[:2])) if axles.any() else int(np.argmax(extent))
        forward = AXES[long] * (-1 if up == "Y" and long == 1 else 1)
        side = "across its axles" if axles.any() else "its longest side"
        why = f"{side}; no part is named front or rear: may be the tail"
    axis = int(np.argmax(np.abs(forward[:2])))
    positive = bool(forward[axis] > 0)
    letter = "X" if axis == 0 else "Y" if up == "Z" else "Z"
    if up == "Y" and axis == 1:  # after the asset is turned upright, +Z points along -Y
        positive = not positive
    return f"{'+' if positive else '-'}{letter}", why


def _all_words(part: Part) -> set[str]:
    return set().union(*(_words(name) for name in part.path.split("/"))) if part.path else set()


# ---------------------------------------------------------------- saying


def report(found: Inspection) -> list[str]:
    """The result as text, line by line."""
    from pxr import UsdGeom

    stage = open_stage(_source(found.asset, found.keys))
    scale = UsdGeom.GetStageMetersPerUnit(stage)
    authored = stage.HasAuthoredMetadata("metersPerUnit")
    up = found.keys.get("up_axis", UsdGeom.GetStageUpAxis(stage))
    scale = float(found.keys.get("meters_per_unit", scale))
    low, high = found.bounds
    size = " x ".join(f"{side:.3g}" for side in high - low)
    unit = f"{scale:g} m" + ("" if authored else ", USD's default: the file gives no unit")
    lines = [
        f"{found.asset}",
        f"up axis   {up}{_because(found, 'up_axis')}",
        f"unit      {unit}{_because(found, 'meters_per_unit')}",
        f"nose      {found.keys['forward']}{_because(found, 'forward')}",
        f"size      {size} m, along its nose, across and up; lowest point at {round(low[2], 6) + 0.0:.3g} m",
    ]
    if not 0.05 < (high - low).max() < 60:
        lines.append(f"          {(high - low).max():.3g} m is unlikely for a vehicle: give meters_per_unit")
    top = stage.GetPrimAtPath(found.keys["root"]) if found.keys.get("root") else stage.GetDefaultPrim()
    for name in top.GetVariantSets().GetNames():
        lines.append(f"variants  {name}: {', '.join(top.GetVariantSet(name).GetVariantNames())}")
    lines += ["prims", *_tree(stage, scale)]
    lines += [f"wheel     {_turns(one)}" for one in found.wheels] or ["wheel     none found"]
    lines += [f"rotor     {_turns(one)}" for one in found.rotors]
    return lines


def _because(found: Inspection, key: str) -> str:
    return f" ({found.reasons[key]})" if key in found.reasons else ""


def _turns(one: Round) -> str:
    centre = ", ".join(f"{x:.3g}" for x in one.centre + 0.0)
    pivot = "" if one.pivoted else "; the prim's own pivot is elsewhere"
    steer = "" if one.steer == one.spin else f"; steers at {one.steer}"
    return f"{one.spin}: centre ({centre}) m, radius {one.radius:.3g} m, about its own {one.op}{pivot}{steer}"


def _tree(stage: Any, scale: float) -> list[str]:
    """The prims by name and type, with their size in m; without materials."""
    from pxr import Usd, UsdGeom, UsdShade

    boxes = UsdGeom.BBoxCache(Usd.TimeCode.EarliestTime(), [UsdGeom.Tokens.default_, UsdGeom.Tokens.render])
    lines = []
    prims = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim.IsA(UsdShade.Material) or prim.IsA(UsdShade.Shader):
            prims.PruneChildren()
        elif not prim.IsPseudoRoot():
            box = boxes.ComputeWorldBound(prim).ComputeAlignedRange() if prim.IsA(UsdGeom.Imageable) else None
            size = "" if box is None or box.IsEmpty() else " x ".join(f"{side * scale:.3g}" for side in box.GetSize())
            depth = prim.GetPath().pathElementCount
            kind = f"{prim.GetTypeName() or 'untyped'}{' instance' if prim.IsInstance() else ''}"
            lines.append(f"{'  ' * depth}{prim.GetName():<{max(30 - 2 * depth, 1)}} {kind:<16} {size}".rstrip())
    if len(lines) > MOST_PRIMS:
        lines[MOST_PRIMS:] = [f"  ... and {len(lines) - MOST_PRIMS} more"]
    return lines


# ---------------------------------------------------------------- a first vehicle.toml


def write_vehicle(found: Inspection, folder: Path) -> Path:
    """Write a first ``vehicle.toml`` to ``folder``, which is created; an existing file is kept. Raises
    ``InputError``."""
    from vehsim.vehicles import load_vehicle

    path = folder / "vehicle.toml"
    if os.path.lexists(path):
        raise InputError("exists and is not overwritten", "give another folder, or remove it", file=path)
    if os.path.lexists(folder) and not folder.is_dir():
        raise InputError("a file", "give a folder", file=folder)
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with path.open("x", encoding="utf-8") as file:
        file.write(vehicle_toml(found, folder))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            load_vehicle(folder)
    except BaseException:
        path.unlink()
        for one in made:
            one.rmdir()
        raise
    return path


def vehicle_toml(found: Inspection, folder: Path) -> str:
    """A first vehicle.toml for the asset, with a model that suits its turning parts."""
    kind, (model, physics) = next((kind, text) for kind, make in KINDS.items() if (text := make(found)) is not None)
    asset = Path(os.path.relpath(found.asset.resolve(), folder.resolve())).as_posix()
    name = re.sub(r"\W|^(?=\d)", "_", found.asset.stem, flags=re.ASCII)
    keys = {key: value for key, value in found.keys.items() if not (key == "forward" and value == "+X")}
    stands = [f"{key} = {_toml(value)}{_comment(found.reasons.get(key))}" for key, value in keys.items() if value != ""]
    lowest = float(found.bounds[0, 2])
    if found.wheels and abs(lowest) > 0.01 * found.wheels[0].radius and "offset" not in keys:
        stands.append(f"offset = [0.0, 0.0, {_digits(-lowest)}]  # m: its wheels stand on the ground")
    head = [
        f"# {name}: made by `vehsim inspect`, which identified a {kind}. Lengths are measured on the asset;",
        "# numbers with a question mark are only typical for its size: correct them. Keys: docs/riggers-guide.md.",
        "schema = 1",
        f"name = {_toml(name)}",
        f"model = {_toml(model)}",
        f"asset = {_toml(asset)}",
        *stands,
    ]
    return "\n".join([*head, physics]).rstrip() + "\n"


def _car(found: Inspection) -> tuple[str, str] | None:
    axles = _axles(found)
    if len(axles) < 2:
        return None
    front, rear = axles[0], axles[1]
    radius, half_track = rear[0].radius, (rear[0].centre[1] - rear[1].centre[1]) / 2
    wheelbase, mass = front[0].centre[0] - rear[0].centre[0], _mass(found, 160.0)
    yaw_inertia = mass * (np.ptp(found.bounds[:, 0]) ** 2 / 12 + (wheelbase / 2) ** 2)
    more = f"# {2 * len(axles)} wheels: the model drives the front two axles; see the model truck for trailers\n" * (
        len(axles) > 2
    )
    wheels = {"fl": front[0], "fr": front[1], "rl": rear[0], "rr": rear[1]}
    steered = "".join(_channel(f"steer_{at}", wheels[at], steer=True) for at in ("fl", "fr"))
    return (
        "car",
        f"""\
origin = [{_digits(rear[0].centre[0])}, 0.0, 0.0]  # middle of the rear axle, on the ground, m
{more}
[physics]
mass = {_digits(mass)}  # kg ?
yaw_inertia = {_digits(yaw_inertia)}  # about the rear axle, kg m^2 ?
wheel_inertia = {_digits(0.012 * mass * radius**2)}  # both driven wheels, kg m^2 ?
wheel_radius = {_digits(radius)}  # m
wheelbase = {_digits(wheelbase)}  # m
half_track = {_digits(half_track)}  # m

[controls.torque]  # N m on the rear axle ?
lower = {_digits(-8.0 * mass * radius)}
upper = {_digits(5.0 * mass * radius)}
scale = {_digits(2.0 * mass * radius)}
unit = "N m"
[controls.steering_rate]  # of tan(steering angle), 1/s
lower = -0.8
upper = 0.8
scale = 0.3
unit = "1/s"
[joints.sigma]  # tan(steering angle): 35 degrees
lower = -0.7
upper = 0.7

{"".join(_channel(f"roll_{at}", wheel) for at, wheel in wheels.items())}{steered}""",
    )


def _robot(found: Inspection) -> tuple[str, str] | None:
    axles = _axles(found)
    if len(axles) != 1:
        return None
    left, right = axles[0]
    radius, mass = left.radius, _mass(found, 300.0)
    half = (left.centre[1] - right.centre[1]) / 2
    most = _digits(2.5 * mass * radius)
    bounds = f'lower = -{most}\nupper = {most}\nscale = {_digits(0.6 * mass * radius)}\nunit = "N m"\n'
    controls = "".join(f"[controls.torque_{at}]  # N m ?\n{bounds}" for at in ("right", "left"))
    return (
        "two_wheeled",
        f"""\
origin = [{_digits(left.centre[0])}, 0.0, 0.0]  # between its wheels, on the ground, m

[physics]
mass = {_digits(mass)}  # kg ?
yaw_inertia = {_digits(mass * (np.ptp(found.bounds[:, :2], axis=0) ** 2).sum() / 12)}  # kg m^2 ?
wheel_inertia = {_digits(0.02 * mass * radius**2)}  # each, kg m^2 ?
wheel_radius = {_digits(radius)}  # m
half_track = {_digits(half)}  # m
rolling_damping = {_digits(0.01 * mass * radius**2)}  # N m s/rad ?

{controls}
{_channel("roll_right", right)}{_channel("roll_left", left)}""",
    )


def _rotorcraft(found: Inspection) -> tuple[str, str] | None:
    upright = [one for one in found.rotors if abs(one.axis[2]) > 0.7]
    if not upright:
        return None
    main = max(upright, key=lambda one: one.radius)
    others = (one for one in found.rotors if one is not main and not one.spin.startswith(f"{main.spin}/"))
    tail = min(others, key=lambda one: one.centre[0], default=None)
    mass, centre, inertia = _weighed(found, 150.0)
    lift = GRAVITY * mass
    behind = max(centre[0] - (tail.centre[0] if tail else found.bounds[0, 0]), 0.1)
    above = max(main.centre[2] - centre[2], 0.05)
    channels = _disc(main, found.parts) + _channel("main_rotor", main, aim=AXES[2])
    coned, blades = _coning(main, found.parts)
    channels += coned + (_channel("tail_rotor", tail) if tail else "")
    return (
        "helicopter",
        f"""\
origin = [{", ".join(_digits(x) for x in centre)}]  # centre of mass of its parts at one density, m ?

[physics]
mass = {_digits(mass)}  # kg ?
inertia = [{", ".join(_digits(x) for x in np.diag(inertia))}]  # kg m^2 ?
d_t = {_digits(above)}  # rotor above the centre of mass, m
d_r = {_digits(behind)}  # tail rotor behind it, m
drag_quadratic = [0.6, 3.0, 3.0]  # N s^2/m^2 ? leave it out for none
main_rotor_speed = {_digits(200.0 / main.radius)}  # rad/s: tips at 200 m/s ?
tail_rotor_speed = {_digits(200.0 / tail.radius) if tail else "200.0"}  # rad/s ?
{blades}
[controls.collective]  # thrust, N ?
lower = 0.0
upper = {_digits(1.8 * lift)}
scale = {_digits(lift)}  # the weight
unit = "N"
[controls.yaw]
lower = {_digits(-0.08 * lift)}
upper = {_digits(0.08 * lift)}
scale = {_digits(0.03 * lift)}
unit = "N"
[controls.pitch]
lower = -0.2
upper = 0.2
scale = 0.1
unit = "rad"
[controls.roll]
lower = -0.2
upper = 0.2
scale = 0.1
unit = "rad"

{channels}""",
    )


def _body(found: Inspection) -> tuple[str, str]:
    mass, centre, inertia = _weighed(found, 300.0)
    return (
        "rigid_body",
        f"""\
origin = [{", ".join(_digits(x) for x in centre)}]  # centre of mass of its parts at one density, m ?
# no wheels or rotors were found: choose a model yourself, such as "boat" (docs/vehicles.md)

[physics]
mass = {_digits(mass)}  # kg ?
inertia = [{", ".join(_digits(x) for x in np.diag(inertia))}]  # kg m^2 ?""",
    )


SOLID = 0.2
"""Blades fill less of a helicopter's disc: with more, they carry something else, such as a blurred disc."""
KINDS: Mapping[str, Callable[[Inspection], tuple[str, str] | None]] = {
    "rotorcraft": _rotorcraft,
    "car": _car,
    "two-wheeled robot": _robot,
    "rigid body": _body,
}
"""Kind of asset -> its model and the rest of its file, None if it does not match; the first match counts."""


def _axles(found: Inspection) -> list[tuple[Round, Round]]:
    """Pairs of wheels, left and right, the front one first; castors are left out."""
    largest = max((one.radius for one in found.wheels), default=0.0)
    wheels = sorted((one for one in found.wheels if one.radius > SMALL * largest), key=lambda one: -one.centre[0])
    axles: list[list[Round]] = []
    for wheel in wheels:
        if axles and abs(axles[-1][0].centre[0] - wheel.centre[0]) < 0.5 * wheel.radius:
            axles[-1].append(wheel)
        else:
            axles.append([wheel])
    pairs = [sorted(axle, key=lambda one: -one.centre[1]) for axle in axles]
    return [(axle[0], axle[-1]) for axle in pairs if len(axle) > 1 and axle[0].centre[1] > axle[-1].centre[1]]


def _weighed(found: Inspection, density: float) -> tuple[float, Array, Array]:
    """Mass kg, centre (3,) m and inertia (3, 3) of the parts at a density; of the box if they enclose no volume."""
    from vehsim.vehicles.library.mass import weigh

    root = None if found.ready != found.asset else found.keys.get("root")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return weigh(found.asset, found.ready, root, density)
    except InputError:
        low, high = found.bounds
        x, y, z = np.maximum(high - low, 1e-3)
        mass = 0.3 * density * x * y * z
        return mass, (low + high) / 2, np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) * mass / 12


def _mass(found: Inspection, density: float) -> float:
    return float(_weighed(found, density)[0])


def _disc(one: Round, parts: Sequence[Part]) -> str:
    """The channels that tilt the disc of a rotor about the axes to the left and ahead."""
    frame, text = next(part.T_rp for part in parts if part.path == one.spin), ""
    for name, aim in ((DISC_PITCH, AXES[1]), (DISC_ROLL, AXES[0])):
        k = int(np.argmax(np.abs(aim @ frame[:3, :3])))
        text += _channel(name, replace(one, op="XYZ"[k], axis=frame[:3, k]), aim=aim)
    return text


@dataclass(frozen=True)
class Blade:
    """A blade of an upright rotor on a hinge of its own: the letter of the own axis about which it flaps, and whether
    turning about that lowers it; its chord, m, and its coning, rad."""

    path: str
    letter: str
    lowers: bool
    chord: float
    coning: float


def _coning(rotor: Round, parts: Sequence[Part]) -> tuple[str, str]:
    """The channels that raise a rotor's blades on hinges of their own, and the numbers of ``[physics]`` with which they
    do; empty for fewer than two such blades."""
    blades: list[Blade] = []
    for part in sorted(parts, key=lambda one: one.path):
        if not any(part.path.startswith(f"{blade.path}/") for blade in blades):
            points = [_points(one) for one in parts if f"{one.path}/".startswith(f"{part.path}/")]
            blades += _blade(part, np.concatenate(points), rotor)
    if len(blades) < 2:
        return "", ""
    tables: list[tuple[str, Any, Blade]]
    if len({(blade.letter, blade.lowers) for blade in blades}) == 1:
        tables = [(CONING, [blade.path for blade in blades], blades[0])]
    else:
        tables = [(f"{CONING}_{k}", blade.path, blade) for k, blade in enumerate(blades, 1)]
    text = "".join(
        f'[channels.{name}]  # up\nprim = {_toml(prim)}\nop = "rotate{one.letter}"\n' + "factor = -1\n" * one.lowers
        for name, prim, one in tables
    )
    solid = sum(blade.chord for blade in blades) / (np.pi * rotor.radius)
    return (
        text,
        f"""\
# with these, blades cone with the thrust; the rotor's torque acts too, and a fin_area must keep the nose steady:
# rotor_radius = {_digits(rotor.radius)}  # m
# solidity = {_digits(solid) if solid < SOLID else "0.06"}  # area of the blades over that of the disc ?
# lock_number = 6.0  # of the blades ?
# blades_up = {_digits(max(0.0, float(np.mean([blade.coning for blade in blades]))))}  # their coning as modelled, rad
""",
    )


def _blade(part: Part, points: Array, rotor: Round) -> list[Blade]:
    """The part with its points (n, 3) as a blade, or nothing: it starts near the rotor's axis, reaches its tips, and
    has an own axis across itself."""
    origin, reach = part.T_rp[:3, 3], rotor.radius
    around, inner = points[:, :2] - rotor.centre[:2], np.hypot(*(origin - rotor.centre)[:2])
    far = np.hypot(*around.T)
    if not part.path.startswith(f"{rotor.spin}/") or inner > 0.15 * reach or far.max(initial=0.0) < 0.8 * reach:
        return []
    tip = points[far > 0.98 * far.max()].mean(axis=0) - origin
    long = float(np.hypot(*tip[:2]))
    out = np.array([tip[0], tip[1], 0.0]) / max(long, 1e-9)
    side = np.cross(out, AXES[2])
    turned = part.T_rp[:3, :3].T @ side
    k = int(np.argmax(np.abs(turned)))
    if (around @ out[:2]).mean() < 0.2 * reach or abs(turned[k]) < 0.98:
        return []
    chord = float(np.ptp(points @ side))
    return [Blade(part.path, "XYZ"[k], bool(turned[k] < 0), chord, float(np.arctan2(tip[2], long)))]


def _channel(name: str, one: Round, steer: bool = False, aim: Array = AXES[1]) -> str:
    """``[channels.NAME]``: wheels roll about the axis to the left, ``aim``; steering turns about the vertical axis."""
    prim, letter, axis = (one.steer if steer else one.spin), one.op, one.axis
    lines = [f"[channels.{name}]", f"prim = {_toml(prim)}"]
    if steer:
        letter, axis = one.up
        aim = AXES[2]
    lines.append(f'op = "rotate{letter}"')
    if not one.pivoted:
        lines.append(f"pivot = [{', '.join(_digits(x) for x in one.centre)}]  # m: the prim's own pivot is elsewhere")
    if axis @ aim < 0:
        lines.append("factor = -1")
    return "\n".join(lines) + "\n"


def _upright(part: Part) -> tuple[str, Array]:
    """The part's own axis closest to the vertical."""
    k = int(np.argmax(np.abs(part.T_rp[2, :3])))
    return "XYZ"[k], part.T_rp[:3, k]


def _toml(value: Any) -> str:
    return (
        "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
        if isinstance(value, dict)
        else json.dumps(value)
    )


def _comment(text: str | None) -> str:
    return f"  # {text}" if text else ""


def _digits(value: float) -> str:
    """Four digits, with a decimal point, as TOML requires for floats."""
    text = f"{float(value) + 0.0:.4g}"
    text = f"{float(text):f}".rstrip("0") if "e" in text else text
    return text if "." in text and not text.endswith(".") else f"{text.rstrip('.')}.0"
