"""The shot of a delivery whose curves were edited, from its ``report.json``."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.delivery.reports import reading_report
from vehsim.errors import InputError, ShotError, VehsimError

if TYPE_CHECKING:
    from vehsim.delivery.take import Take
    from vehsim.runtime.progress import Progress
    from vehsim.shot.shot import Shot

NAMED = 5
"""Number of prims that a warning names."""
ANOTHER, TURNED = 2e-3, 0.2
"""Distance, m, and angle, degrees, between two motions above which they are not the same."""
EDIT = re.compile(r"vehicle\[(\d+)\]\.edit\b")
"""The key of a problem with a vehicle's edit."""


def edited_shot(delivery: Path, edit: Path, source: Path | None, progress: Progress) -> Shot:
    """The checked shot of a delivery, with the edit of every vehicle whose curves ``edit`` contains.

    ``source``: its shot file; by default the copy in ``report.json``, whose paths are relative to the working folder.
    Raises ``InputError`` if nothing was edited, or if the shot now has another motion than the delivery.
    """
    from pxr import Usd

    with _looking_from(source), Usd.StageCacheContext(Usd.StageCache()):  # each stage is opened once
        return _edited_shot(delivery, edit, source, progress)


@contextmanager
def _looking_from(source: Path | None) -> Iterator[None]:
    """Without a shot file, errors about files that are not there say that its paths start at the working folder."""
    try:
        yield
    except VehsimError as error:
        lost = [
            source is None and isinstance(one.value, str) and not Path(one.value).exists() for one in error.problems
        ]
        if not any(lost) or any(one.key.startswith("--") for one in error.problems):
            raise
        remedy = "paths are relative to the working folder: go to the shot file's folder, or give it with --shot"
        told = [replace(one, remedy=remedy) if gone else one for one, gone in zip(error.problems, lost, strict=True)]
        raise ShotError(told) from None


def _edited_shot(delivery: Path, edit: Path, source: Path | None, progress: Progress) -> Shot:
    """`edited_shot`, with plain errors."""
    from vehsim.intake.toml import read_toml
    from vehsim.shot.shot import Shot

    folder = Path() if source is None else source.parent
    with reading_report(delivery) as report:
        name = report["shot"]
        data = report["solved"]["shot"] if source is None else read_toml(source)[0]
        vehicles = {vehicle["name"]: vehicle for vehicle in data["vehicle"]}
        if source is not None:
            _add_edits(vehicles, report["solved"]["shot"]["vehicle"], folder, delivery)
    before = Shot.from_dict(data, folder, str(source or delivery / "report.json"))
    if not edit.is_file():
        raise InputError("no such file", "give the stage with the edited curves", key="--edit", value=str(edit))
    _check_new(before, edit)
    number, earlier = before.last_round + 1, {table.name: len(table.edits) for table in before.file.vehicle}
    found = prims_in(edit, {vehicle: f"/{name}/vehicles/{vehicle}" for vehicle in vehicles})
    for vehicle, prim in found.items():
        own: dict[str, Any] = {"usd": os.path.relpath(edit, folder), "prim": prim}
        own |= {} if number == earlier[vehicle] + 1 else {"round": number}
        vehicles[vehicle]["edit"] = [*_edits_in(vehicles[vehicle]), own]
    edited = Shot.from_dict(data, folder, before.source)
    errors = [problem for problem in edited.check() if problem.severity == "error"]
    refused = {int(match[1]) for error in errors if (match := EDIT.match(error.key))}
    for table in [edited.file.vehicle[i] for i in sorted(refused)]:  # not asked for: its motion stays
        if _as_delivered(delivery, name, table.name, edit, found[table.name], edited.vehicle(table).rig, edited.fps):
            del found[table.name], vehicles[table.name]["edit"][-1]
    if refused and found:
        edited = Shot.from_dict(data, folder, before.source)
        errors = [problem for problem in edited.check() if problem.severity == "error"]
    if errors:
        raise ShotError(errors)
    clips = edited.unedited().motion(progress)
    for vehicle in found:
        _check_same(delivery, name, vehicle, clips[vehicle])
    _warn_of_others(delivery, name, edit, found)
    return edited


def _add_edits(
    vehicles: Mapping[str, dict[str, Any]], delivered: list[dict[str, Any]], folder: Path, delivery: Path
) -> None:
    """Add to ``vehicles`` of a shot file in ``folder`` the edits that it lacks but the ``delivered`` motion has."""
    edits = {table["name"]: _edits_in(table) for table in delivered}
    for name, table in vehicles.items():
        own = _edits_in(table)
        for edit in edits.get(name, [])[len(own) :]:  # its path counts from where the delivery was made
            places = [base / Path(edit["usd"]).expanduser() for base in (folder, Path(), *delivery.resolve().parents)]
            found = next((place for place in places if place.is_file()), places[0])
            own.append({**edit, "usd": os.path.relpath(found, folder)})
        if own:
            table["edit"] = own


def _edits_in(table: Mapping[str, Any]) -> list[Any]:
    """The edits of a vehicle, of which there may be one table or several."""
    edits = table.get("edit") or []
    return [*edits] if isinstance(edits, list) else [edits]


def _check_new(before: Shot, edit: Path) -> None:
    """Raise ``InputError`` if an earlier retouch was made from the same file: its edit is lost then."""
    for table in before.file.vehicle:
        if any(edit.resolve() == earlier.path(before.folder).resolve() for earlier in table.edits.values()):
            raise InputError(
                f"the delivery was retouched from this file before, so that edit of {table.name} must stay in it",
                "save the new edit under another name, and the earlier one in this file again",
                key="--edit",
                value=str(edit),
            )


def prims_in(edit: Path, wanted: dict[str, str]) -> dict[str, str]:
    """The prims of vehicles in an edited stage: at their delivered paths or, in a stage that another tool wrote, the
    topmost moving prim with the vehicle's name. Raises ``InputError`` if there are none."""
    from pxr import Usd, UsdGeom

    from vehsim.intake.usd import open_stage
    from vehsim.rig.blocking import moves

    stage = open_stage(edit)
    found = {}
    for vehicle, path in wanted.items():
        named = [prim for prim in Usd.PrimRange(stage.GetPseudoRoot()) if prim.GetName() == vehicle]
        for prim in [stage.GetPrimAtPath(path), *named]:
            if prim and prim.IsA(UsdGeom.Xformable) and moves(prim):
                found[vehicle] = str(prim.GetPath())
                break
    if not found:
        raise InputError("no vehicle of the delivery moves in it", f"edit {', '.join(wanted.values())}", file=edit)
    return found


def _as_delivered(delivery: Path, name: str, vehicle: str, edit: Path, prim: str, rig: Any, fps: Fraction) -> bool:
    """Whether a vehicle's root in the edited stage is where it was delivered."""
    from vehsim.exporters.checks.audit import stage_of
    from vehsim.rig.blocking import read_edit

    stage = stage_of(delivery, name)
    if stage is None or rig is None:
        return False
    try:
        before = read_edit(stage, f"/{name}/vehicles/{vehicle}", fps, rig)
        after = read_edit(edit, prim, fps, rig)
    except InputError:  # the check of the edit tells it
        return False
    change = before.departure(after.frames, after.positions, after.rotations)
    return bool(change) and change["largest"] <= ANOTHER and change["largest_turn"] <= TURNED


def _check_same(delivery: Path, name: str, vehicle: str, clip: Any) -> None:
    """Raise ``InputError`` if a vehicle's delivered motion is not ``clip``."""
    from vehsim.exporters.checks.audit import stage_of
    from vehsim.rig.blocking import read_edit

    stage = stage_of(delivery, name)
    if stage is None:
        return
    shown = read_edit(stage, f"/{name}/vehicles/{vehicle}", clip.fps, clip.vehicle.rig)
    inside = (shown.frames >= clip.start_frame) & (shown.frames <= clip.end_frame)
    there = clip.at(np.minimum((shown.frames[inside] - clip.start_frame) / float(clip.fps), clip.times[-1]))
    off = np.linalg.norm(there.positions - shown.positions[inside], axis=1)
    if off.size and off.max() > ANOTHER:
        raise InputError(
            f"{vehicle}: the shot now gives another motion than was delivered, {off.max():.2g} m away at frame "
            f"{shown.frames[inside][off.argmax()]:g}",
            "export it again with this version of vehsim, and edit the new delivery",
            file=delivery,
        )


def _warn_of_others(delivery: Path, name: str, edit: Path, found: Mapping[str, str]) -> None:
    """Warn of prims outside vehicles that the edit moves although only vehicles are read."""
    from vehsim.exporters.checks.audit import stage_of
    from vehsim.rig.edited import others_moved

    stage = stage_of(delivery, name)
    moved = [] if stage is None else others_moved(edit, stage, [f"/{name}/vehicles/{vehicle}" for vehicle in found])
    if moved:
        more = f" and {len(moved) - NAMED} more" if len(moved) > NAMED else ""
        warnings.warn(
            f"the edit also moves {', '.join(map(str, moved[:NAMED]))}{more}, without effect: only vehicles' roots, "
            f"such as {next(iter(found.values()))}, are read",
            stacklevel=2,
        )


def summary(take: Take) -> Iterator[str]:
    """What became of the edit of each vehicle in the last round, in words."""
    vehicles = take.report["vehicles"]
    last = max((report["edit"]["round"] for report in vehicles.values() if "edit" in report), default=0)
    for name, report in vehicles.items():
        if "edit" in report and report["edit"]["round"] == last:
            edit = report["edit"]
            touched = ", ".join(f"{first} to {last}" for first, last in edit["touched"])
            again = ", ".join(f"{first} to {last}" for first, last in edit["solved_again"])
            yield f"{name}: edited in frames {touched or 'none'}; solved again in {again or 'none'}"
            worst = max(edit["missed"], key=lambda miss: miss["metres"], default=None)
            if worst is not None:
                yield f"{name}: farthest from the edit at frame {worst['frame']:.0f}, {worst['metres']:.3f} m"
