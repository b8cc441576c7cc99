"""Checks of a motion in its world: marks in order and clear of rock, existing names, one attitude.

Checks are generators of `Problem` whose keys are relative to ``[vehicle.motion]``; `shot.py` adds the prefix.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import Problem
from vehsim.intake.usd import beyond, dependencies, open_stage
from vehsim.lie.quaternions import from_yaw
from vehsim.requests.mark_frame import FREE
from vehsim.shot.schema.tables import MAX_FRAMES, ExportTable, MarkTable

if TYPE_CHECKING:
    from vehsim.rig.rig import Rig
    from vehsim.vehicles import Vehicle
    from vehsim.world.world import World


@dataclass(frozen=True)
class Context:
    """The context of a check. ``first``, ``last``: the shot's frames; ``last`` None: the motion determines it."""

    world: World
    fps: Fraction
    first: int
    last: int | None
    folder: Path

    def seconds(self, frame: float) -> float:
        """Time of a frame, s after ``first``."""
        return float((Fraction(frame) - self.first) / self.fps)


def did_you_mean(name: str, known: Collection[str]) -> str:
    close = get_close_matches(name, list(known), n=1)
    return f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(sorted(known)) or '(none)'}"


def check_names(key: str, given: Mapping[str, Any], known: Collection[str], noun: str) -> Iterator[Problem]:
    for name, value in given.items():
        if name not in known:
            yield Problem(f"{key}.{name}", f"no such {noun}", did_you_mean(name, known), value)


def check_asset(key: str, asset: str, vehicle: Vehicle) -> Iterator[Problem]:
    """Every driven part exists and can move as a rigid part about its own pivot; the numbers of the ``vehicle.toml``,
    or those given in their place, match the asset: lengths, mass, and direction of the nose."""
    from vehsim.rig.ops import rig_problems
    from vehsim.vehicles.library.fit import backwards, misfits

    rig = vehicle.rig
    turned = backwards(rig)  # first: the wheels of a reversed asset seem to turn the wrong way
    if turned is None and rig is not None and rig.drives:
        broken = rig_problems(rig)
        yield from (problem.seen_from(key, asset) for problem in broken)
        if any(problem.severity == "error" for problem in broken):
            return
    for misfit in misfits(rig, vehicle.parameters) if turned is None else [turned]:
        own = misfit.key.startswith("parameters.")
        yield replace(misfit, key=f"{key.removesuffix('.asset')}.{misfit.key}") if own else misfit.seen_from(key, asset)


def check_copied(key: str, asset: str, file: Path, homes: Sequence[Path], export: ExportTable) -> Iterator[Problem]:
    """Copied files are in the asset's own folder, or in ``homes``: an asset could name any file of this machine."""
    for found in beyond(dependencies(file)[0], file.parent, *homes):
        message = f"its asset refers to {found}, outside its own folder"
        if export.outside == "copy":
            yield Problem(
                key, f"{message}: it is copied too", "check that copying it is intended", asset, severity="warning"
            )
        else:
            yield Problem(key, message, 'put it there, or give export.outside = "copy" to copy it', asset)


def variants_of(rig: Rig | None) -> dict[str, list[str]]:
    """The variant sets on the root prim of a vehicle's asset, and the variants in each."""
    stage = None if rig is None else open_stage(rig.asset)
    root = stage and (stage.GetPrimAtPath(f"/{rig.root.strip('/')}") if rig and rig.root else stage.GetDefaultPrim())
    sets = {} if not root else {name: root.GetVariantSet(name) for name in root.GetVariantSets().GetNames()}
    found = {name: list(each.GetVariantNames()) for name, each in sets.items()}
    if rig is not None and any(drive.disc for drive in rig.drives.values()):
        found["rotor"] = ["blades", "disc"]  # made with the animation layer
    return found


def check_variants(key: str, given: Mapping[str, str], rig: Rig | None) -> Iterator[Problem]:
    """Every requested variant set and variant is on the root prim of the vehicle's asset."""
    if not given:
        return
    sets = variants_of(rig)
    for name, variant in given.items():
        if name not in sets:
            remedy = did_you_mean(name, sets) if sets else "the asset has none: remove variants"
            yield Problem(f"{key}.{name}", "no such variant set", remedy, variant)
        elif variant not in sets[name]:
            yield Problem(f"{key}.{name}", "no such variant", did_you_mean(variant, sets[name]), variant)


def check_trailer(vehicle: Vehicle, world: World) -> Iterator[Problem]:
    """Warn of a trailer on ground that is not level, which its wheels do not follow."""
    from vehsim.world.ground.trailers import follows_ground

    if world.terrain is not None and np.ptp(world.terrain.heights) > 0.0 and not follows_ground(vehicle):
        message = f"the wheels of {vehicle.name}'s trailer do not follow uneven ground, and the export fails there"
        remedy = "add channels hitch_pitch* and hitch_roll* to its vehicle.toml, or stay on level ground"
        yield Problem("asset", message, remedy, vehicle.name, severity="warning")


def check_contact(vehicle: Vehicle, world: World, things: Collection[str]) -> Iterator[Problem]:
    """Contact moves vehicles in space only: refuse a simulated vehicle in the plane among ``things`` that it could
    hit."""
    in_water = world.water is not None and vehicle.hull is not None
    planar = vehicle.planar is not None and not in_water
    if world.contact is not None and things and (planar or vehicle.group.dim != 6):
        from vehsim.simulation import untouched

        yield untouched(vehicle, things)


def check_order(marks: list[MarkTable], context: Context) -> Iterator[Problem]:
    """Frames increase and are in the shot; the first mark has a frame and a place."""
    if marks[0].given_frame is None:
        yield Problem("mark[0].frame", "the first mark starts the motion", "give it a whole frame", FREE)
    if marks[0].position is None:
        yield Problem("mark[0].position", "missing", "say where the motion starts")
    leave: int | None = None
    for i, mark in enumerate(marks):
        key, frame = f"mark[{i}].frame", mark.given_frame
        if frame is None:
            continue
        if frame < context.first or (context.last is not None and frame + mark.hold > context.last):
            end = "" if context.last is None else f" to {context.last}"
            yield Problem(
                key, "outside the shot", f"the shot runs from frame {context.first}{end}, handles included", frame
            )
        if leave is not None and frame <= leave:
            message, later = f"not after frame {leave} of the mark before it", leave + 1 - frame
            rest = [(f"mark[{k}].frame", one.given_frame) for k, one in enumerate(marks) if k >= i]
            fixes = tuple((name, given + later) for name, given in rest if given is not None)
            yield Problem(key, message, "put the marks in order of time", frame, fixes=fixes)
        leave = frame + mark.hold
    frames = [mark.given_frame for mark in marks if mark.given_frame is not None]
    if frames and max(frames) - min(frames) > MAX_FRAMES:
        yield Problem("mark", f"{max(frames) - min(frames)} frames apart", f"a shot has at most {MAX_FRAMES} frames")


def check_mark(key: str, mark: Any, vehicle: Vehicle) -> Iterator[Problem]:
    """One attitude, one velocity, existing joints."""
    if mark.heading is not None and mark.orientation is not None:
        yield Problem(f"{key}.heading", "orientation is given too", "keep one of them", mark.heading)
    if not isinstance(mark, MarkTable):
        return
    if mark.speed is not None and mark.velocity is not None:
        yield Problem(f"{key}.speed", "velocity is given too", "keep one of them", mark.speed)
    landed = mark.on_ground and mark.velocity is None
    if mark.hold and not landed and (mark.velocity is None or any(mark.velocity)):
        yield Problem(f"{key}.hold", "a hold requires rest", "give velocity = [0, 0, 0]", mark.hold)
    if mark.joints is not None:
        yield from check_names(f"{key}.joints", mark.joints, vehicle.joints, "joint")


def check_free(key: str, position: list[float], clearance: float, world: World) -> Iterator[Problem]:
    """A vehicle's root is not in the rock."""
    if world.terrain is None:
        return
    ground, end = float(world.height([position[:2]])[0]), world.terrain.beyond(position)
    if end and position[2] < ground:
        yield Problem(key, outside(end), "move it inside", position)
        return
    if position[2] < ground:
        message, remedy = f"inside rock: the ground is at {ground:.2f} m", f"raise z above {ground + clearance:.2f}"
        yield Problem(key, message, remedy, position)
    elif world.terrain.below([position])[0]:
        yield Problem(key, "inside rock, above the ground of a cave or below the top of an arch", "move it", position)


def check_clear(key: str, position: list[float], pose: Any, vehicle: Vehicle, world: World) -> Iterator[Problem]:
    """A vehicle with a known attitude does not reach into the rock."""
    attitude = orientation_of(pose)
    if attitude is None or world.terrain is None or world.terrain.below([position])[0]:
        return
    gap = float(world.clearance_from_terrain(vehicle, [position], [attitude])[0])
    if gap < -1e-6:
        yield Problem(key, f"the vehicle reaches {-gap:.2f} m into rock", "move it out of the terrain", position)


def outside(end: str) -> str:
    """The message about a place beyond the end of the terrain."""
    return f"outside the terrain, which ends at {end}"


def check_inside(key: str, position: list[float], vehicle: Vehicle, world: World) -> Iterator[Problem]:
    """The start is inside the terrain; beyond it, the ground continues level and is not drawn: a warning."""
    end = "" if world.terrain is None or vehicle.hull is not None else world.terrain.beyond(position)
    if end:
        remedy = "outside, the ground is level and not drawn; start inside"
        yield Problem(key, outside(end), remedy, position, severity="warning")


def orientation_of(pose: Any) -> Any:
    """(4,) w, x, y, z of a table with a heading or an orientation; None if it has neither."""
    if pose.orientation is not None:
        return np.array(pose.orientation) / np.linalg.norm(pose.orientation)
    if pose.heading is not None:
        return from_yaw(np.deg2rad(pose.heading))
    return None
