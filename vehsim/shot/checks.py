"""What holds of a motion in its world: marks in order and clear of rock, names that exist, attitudes given once.

Checks are generators of `Problem` whose keys are relative to ``[vehicle.motion]``; `shot.py` adds what stands before.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import Problem
from vehsim.intake.usd import beyond, open_stage
from vehsim.shot.model import MAX_FRAMES, ExportTable, MarkTable

if TYPE_CHECKING:
    from vehsim.shot.file import ShotFile
    from vehsim.vehicles import Vehicle
    from vehsim.vehicles._base import Rig
    from vehsim.world import World


@dataclass(frozen=True)
class Setting:
    """What a motion is held against. ``first``, ``last``: the shot's frames; ``last`` None: the motion decides."""

    world: World
    fps: Fraction
    first: int
    last: int | None
    folder: Path

    def seconds(self, frame: float) -> float:
        """Time of a frame, s after ``first``."""
        return float((Fraction(frame) - self.first) / self.fps)


def choose(name: str, known: Collection[str]) -> str:
    close = get_close_matches(name, list(known), n=1)
    return f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(sorted(known)) or '(none)'}"


def check_names(key: str, given: Mapping[str, Any], known: Collection[str], noun: str) -> Iterator[Problem]:
    for name, value in given.items():
        if name not in known:
            yield Problem(f"{key}.{name}", f"no such {noun}", choose(name, known), value)


def check_asset(key: str, asset: str, rig: Rig | None) -> Iterator[Problem]:
    """Every part that is driven is there and can move as a rigid part about a pivot of its own; the numbers of the
    ``vehicle.toml`` are those of its asset: lengths, mass, and where its nose is.
    """
    from vehsim.rigging import rig_problems
    from vehsim.vehicles._fit import backwards, misfits

    turned = backwards(rig)  # first: wheels of an asset that is turned round seem to turn the wrong way
    if turned is None and rig is not None and rig.drives:
        broken = rig_problems(rig)
        for channel, message, mend in broken:
            yield Problem(key, f"channels.{channel}: {message}" if channel else message, mend, asset)
        if broken:
            return
    for misfit in misfits(rig) if turned is None else [turned]:
        said = f"{misfit.key}: " if misfit.value is None else f"{misfit.key} = {misfit.value!r}: "
        yield Problem(key, said + misfit.message, misfit.mend, asset, severity=misfit.severity)


def check_copied(key: str, asset: str, file: Path, homes: Sequence[Path], export: ExportTable) -> Iterator[Problem]:
    """What would be copied along lies in the asset's own folder, or ``homes``: it may name any file of this machine."""
    from vehsim.shot.inputs import with_dependencies

    for found in beyond(with_dependencies(file), file.parent, *homes):
        said = f"its asset refers to {found}, outside its own folder"
        if export.outside == "copy":
            yield Problem(key, f"{said}: copied along", "check that it may travel", asset, severity="warning")
        else:
            yield Problem(key, said, 'put it there, or give export.outside = "copy" to copy it along', asset)


def check_variants(key: str, given: Mapping[str, str], rig: Rig | None) -> Iterator[Problem]:
    """Every variant set and variant that is asked for is on the root prim of the vehicle's asset."""
    if not given:
        return
    stage = None if rig is None else open_stage(rig.asset)
    root = stage and (stage.GetPrimAtPath(f"/{rig.root.strip('/')}") if rig and rig.root else stage.GetDefaultPrim())
    sets = (
        {}
        if not root
        else {name: root.GetVariantSet(name).GetVariantNames() for name in root.GetVariantSets().GetNames()}
    )
    if rig is not None and any(drive.disc for drive in rig.drives.values()):
        sets = {**sets, "rotor": ["blades", "disc"]}  # made with the animation layer
    for name, variant in given.items():
        if name not in sets:
            mend = choose(name, sets) if sets else "the asset has none: leave variants out"
            yield Problem(f"{key}.{name}", "no such variant set", mend, variant)
        elif variant not in sets[name]:
            yield Problem(f"{key}.{name}", "no such variant", choose(variant, sets[name]), variant)


def check_trailer(vehicle: Vehicle, world: World) -> Iterator[Problem]:
    """Warn of a trailer on ground that is not level: its wheels do not follow that."""
    from vehsim.world.swings import swings

    if world.terrain is not None and np.ptp(world.terrain.heights) > 0.0 and swings(vehicle):
        message = f"the wheels of {vehicle.name}'s trailer do not follow uneven ground, and its export fails there"
        yield Problem("asset", message, "keep to where the ground is level", vehicle.name, severity="warning")


def check_order(marks: list[MarkTable], setting: Setting) -> Iterator[Problem]:
    """Frames rise and lie in the shot; the first mark has a frame and a place."""
    if marks[0].frame == "free":
        yield Problem("mark[0].frame", "the first mark starts the motion", "give it a whole frame", "free")
    if marks[0].position is None:
        yield Problem("mark[0].position", "missing", "say where the motion starts")
    leave: int | None = None
    for i, mark in enumerate(marks):
        key, frame = f"mark[{i}].frame", mark.frame
        if frame == "free":
            continue
        if frame < setting.first or (setting.last is not None and frame + mark.hold > setting.last):
            end = "" if setting.last is None else f" to {setting.last}"
            yield Problem(
                key, "outside the shot", f"the shot runs from frame {setting.first}{end}, handles included", frame
            )
        if leave is not None and frame <= leave:
            message = f"not after frame {leave} of the mark before it"
            yield Problem(key, message, "put marks in the order of time", frame)
        leave = frame + mark.hold
    frames = [mark.frame for mark in marks if mark.frame != "free"]
    if frames and max(frames) - min(frames) > MAX_FRAMES:
        yield Problem("mark", f"{max(frames) - min(frames)} frames apart", f"a shot has at most {MAX_FRAMES} frames")


def check_mark(key: str, mark: Any, vehicle: Vehicle) -> Iterator[Problem]:
    """One attitude, one velocity, joints that exist."""
    if mark.heading is not None and mark.orientation is not None:
        yield Problem(f"{key}.heading", "orientation is given too", "keep one of them", mark.heading)
    if not isinstance(mark, MarkTable):
        return
    if mark.speed is not None and mark.velocity is not None:
        yield Problem(f"{key}.speed", "velocity is given too", "keep one of them", mark.speed)
    landed = mark.on_ground and mark.velocity is None
    if mark.hold and not landed and (mark.velocity is None or any(mark.velocity)):
        yield Problem(f"{key}.hold", "a hold is at rest", "give velocity = [0, 0, 0]", mark.hold)
    if mark.joints is not None:
        yield from check_names(f"{key}.joints", mark.joints, vehicle.joints, "joint")


def check_free(
    key: str, position: list[float], pose: Any, clearance: float, vehicle: Vehicle, world: World
) -> Iterator[Problem]:
    """Is the vehicle clear of the rock there? With an unknown attitude only its root is asked."""
    if world.terrain is None:
        return
    ground, end = float(world.height([position[:2]])[0]), world.terrain.beyond(position)
    if end and position[2] < ground:
        yield Problem(key, outside(end), "move it inside", position)
        return
    attitude = orientation_of(pose)
    if position[2] < ground:
        message, mend = f"inside rock: the ground is at {ground:.2f} m", f"raise z above {ground + clearance:.2f}"
        yield Problem(key, message, mend, position)
    elif attitude is not None and vehicle.rig is not None:
        gap = float(world.clearance_from_terrain(vehicle, [position], [attitude])[0])
        if gap < min(clearance - 1e-6, 0.0):
            yield Problem(key, f"the vehicle reaches {-gap:.2f} m into rock", "move it out of the terrain", position)
        elif gap < clearance - 1e-6:
            mend = f"keep the clearance of {clearance:g} m, or ask for less"
            yield Problem(key, f"only {gap:.2f} m from rock", mend, position)


def outside(end: str) -> str:
    """What is said of a place beyond where the terrain ends."""
    return f"outside the terrain, which ends at {end}"


def check_inside(key: str, position: list[float], vehicle: Vehicle, world: World) -> Iterator[Problem]:
    """A start inside the terrain; beyond, the ground goes on level and is not drawn, which is worth a warning."""
    end = "" if world.terrain is None or vehicle.hull is not None else world.terrain.beyond(position)
    if end:
        mend = "beyond, the ground goes on level and is not drawn; start it inside"
        yield Problem(key, outside(end), mend, position, severity="warning")


def orientation_of(pose: Any) -> Any:
    """(4,) w, x, y, z of a table that gives a heading or an orientation; None when it gives neither."""
    if pose.orientation is not None:
        return np.array(pose.orientation) / np.linalg.norm(pose.orientation)
    if pose.heading is not None:
        half = np.deg2rad(pose.heading) / 2
        return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    return None


def check_cuts(file: ShotFile) -> Iterator[Problem]:
    """A cut list in order, of cameras that are there and have one film back; the cameras that shall be rendered."""
    from vehsim.cameras import CUT

    cameras = {camera.name: camera for camera in file.camera}
    used: list[str] = []
    for i, piece in enumerate(file.cut):
        if piece.camera not in cameras:
            yield Problem(f"cut[{i}].camera", "no such camera", choose(piece.camera, cameras), piece.camera)
            continue
        used.append(piece.camera)
        if i and piece.frame <= file.cut[i - 1].frame:
            message = f"not after the cut before it, at {file.cut[i - 1].frame}"
            yield Problem(f"cut[{i}].frame", message, "give the cuts in order", piece.frame)
        if cameras[piece.camera].aperture_width_mm != cameras[used[0]].aperture_width_mm:
            message = f"cut with {used[0]!r}, which has another film back"
            yield Problem(f"cut[{i}].camera", message, "give both the same aperture_width_mm", piece.camera)
    if file.cut and CUT in cameras:
        i = list(cameras).index(CUT)
        yield Problem(f"camera[{i}].name", "the cut list's own camera has this name", "choose another", CUT)
    names = [*cameras, CUT] if file.cut else [*cameras]
    for i, name in enumerate(file.render.cameras or []):
        if name not in names:
            yield Problem(f"render.cameras[{i}]", "no such camera", choose(name, names), name)
