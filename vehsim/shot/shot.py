"""A shot: load it, check it against the world, solve it into a take."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import Caution, InputError, Problem, ShotError, SolveError, VehsimError
from vehsim.intake.timelines import read_cuts
from vehsim.intake.toml import line_of, lines_of, read_toml, too_large
from vehsim.intake.usd import complaints, dependencies
from vehsim.requests import clearance_ask, target_asks
from vehsim.runtime.progress import Progress, silent, told_as
from vehsim.shot.audited import audit_clips
from vehsim.shot.checks import (
    Context,
    check_asset,
    check_contact,
    check_copied,
    check_trailer,
    check_variants,
    did_you_mean,
)
from vehsim.shot.cuts import check_cuts
from vehsim.shot.follow_through import hold, rests
from vehsim.shot.handles import carry_on
from vehsim.shot.motions.blocking import blocking_of
from vehsim.shot.motions.state import is_planar
from vehsim.shot.overrides import apply_overrides
from vehsim.shot.schema.shot_file import ShotFile, VehicleTable, parse
from vehsim.shot.schema.tables import MAX_FRAMES
from vehsim.shot.subjects import naming
from vehsim.shot.world.obstacle_tables import check_obstacles, check_stands, standing, with_vehicles
from vehsim.shot.world.water import check_afloat, check_water, make_water
from vehsim.vehicles.library.file import vehicle_files

if TYPE_CHECKING:
    from vehsim.cameras.camera import Camera, CameraRig
    from vehsim.clip.clip import Clip
    from vehsim.delivery.take import RenderSettings, Take, UsdSettings
    from vehsim.rig.blocking import Blocking
    from vehsim.shot.cache import SolvedMotion
    from vehsim.shot.motions.simulate import ForwardMotion
    from vehsim.vehicles import Vehicle
    from vehsim.world.world import World

OFF_GROUND = 0.05
"""Distance of a driving vehicle from the ground above which there is a warning, m."""


class Shot:
    """A shot file in memory. Make one with `Shot.load` or `Shot.from_dict`; `solve` makes the take.

    Both raise ``ShotError`` with all errors at once.
    """

    def __init__(self, file: ShotFile, folder: Path, source: str = "", lines: Mapping[str, int] | None = None):
        self.file, self.folder, self.source = file, folder, source
        self._lines = lines or {}
        self.left_out: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: str | Path, overrides: Sequence[str] = ()) -> Shot:
        """Read a shot file. ``overrides``, such as ``"world.wind=[0,3,0]"``, are applied first."""
        path = Path(path)
        data, text = read_toml(path)
        return cls.from_dict(data, folder=path.parent, source=str(path), overrides=overrides, lines=lines_of(text))

    @classmethod
    def from_dict(
        cls,
        data: Mapping[str, Any],
        folder: str | Path = ".",
        source: str = "",
        overrides: Sequence[str] = (),
        lines: Mapping[str, int] | None = None,
    ) -> Shot:
        """A shot from the data of a shot file; its paths are relative to ``folder``."""
        lines = lines or {}
        if problem := too_large(data):
            raise ShotError([_place(problem, source, lines)])
        if isinstance(data, Mapping):
            data = copy.deepcopy(dict(data))
            apply_overrides(data, overrides)
        file, problems = parse(data)
        shot = cls(file, Path(folder), source, lines) if file else None
        if problems:
            # without its wrong keys, the world may lack what a mark stands on
            whole = not any(problem.key.startswith("world") for problem in problems)
            problems += shot._check(in_world=whole) if shot else []
            raise ShotError([_place(problem, source, lines) for problem in problems])
        assert shot is not None
        return shot

    @property
    def name(self) -> str:
        """The shot's name, which is also that of its folder, its stage and the root prim."""
        return self.file.shot.name

    @property
    def fps(self) -> Fraction:
        """Frames per second, exact: 23.976 is 24000/1001."""
        return self.file.shot.fps

    def motion_files(self) -> Iterator[Path]:
        """Files that determine the motion, in addition to its own and its world's: rigs and their references, clips,
        blockings."""
        for table in self.file.vehicle:
            rig = self.vehicle(table).rig
            if rig is not None:
                toml = (rig.folder or rig.asset.parent) / "vehicle.toml"
                yield from vehicle_files(toml) if toml.is_file() else [toml]
                yield from dependencies(rig.asset)[0]
            for key in ("path", "file", "guess_file", "continues"):
                if (path := getattr(table.motion, key, None)) is not None:
                    yield self.folder / path
        for blocking in self.blockings().values():
            yield from dependencies(blocking.path)[0]
        for table in self.file.vehicle:
            for edit in table.edits.values():
                yield from dependencies(edit.path(self.folder))[0]

    def only(self, names: Sequence[str]) -> Shot:
        """The shot with only these vehicles; cameras whose target is missing look at the first of them."""
        known = [vehicle.name for vehicle in self.file.vehicle]
        for name in names:
            if name not in known:
                raise ShotError([Problem("--only", "no such vehicle", did_you_mean(name, known), name, self.source)])
        kept = [vehicle for vehicle in self.file.vehicle if vehicle.name in names]
        cameras = [
            camera if camera.target in (None, *names) else camera.model_copy(update={"target": kept[0].name})
            for camera in self.file.camera
        ]
        file = self.file.model_copy(update={"vehicle": kept, "camera": cameras})
        left = tuple(name for name in known if name not in names)
        return Shot(file, self.folder, self.source, self._lines).without((*self.left_out, *left))

    def without(self, names: Sequence[str]) -> Shot:
        """The same shot, recording that vehicles called ``names`` were left out: their delivered files stay."""
        shot = copy.copy(self)
        shot.left_out = tuple(names)
        return shot

    @cached_property
    def world(self) -> World:
        """The surroundings of the vehicles; moving obstacles come with the motions. Raises ``InputError``."""
        from vehsim.world.contact.contact import Contact
        from vehsim.world.wind import Gusts
        from vehsim.world.world import World

        table = self.file.world
        terrain = None if table.terrain is None else self._asset(table.terrain)
        return World(
            terrain,
            table.wind,
            standing(table.obstacle, self.folder),
            water=make_water(table.water, self.folder),
            gusts=None if table.gusts is None else Gusts(**table.gusts.model_dump()),
            contact=None if table.contact is None else Contact(**table.contact.model_dump()),
        )

    def vehicle(self, table: VehicleTable) -> Vehicle:
        """The vehicle of a ``[[vehicle]]`` table, with the requested variants. Raises ``InputError``.

        It is made once, because it keeps what is built of its laws.
        """
        from vehsim.vehicles import load_vehicle

        key = table.name, table.asset, repr(table.parameters), repr(table.variants)
        if key not in self._vehicles:
            vehicle = load_vehicle(self._asset(table.asset), table.parameters)
            self._vehicles[key] = _showing(table.variants, vehicle) if table.variants else vehicle
        return self._vehicles[key]

    @cached_property
    def _vehicles(self) -> dict[Hashable, Vehicle]:
        """Those that were made, by what they are made of."""
        return {}

    def check(self) -> list[Problem]:
        """All errors that can be found before solving; nothing is written. Warnings have their own severity."""
        return [_place(problem, self.source, self._lines) for problem in self._check()]

    def solve(self, progress: Progress | None = None, *, checked: bool = False, cached: bool = True) -> Take:
        """Check, then solve every vehicle's motion and every camera. Raises ``ShotError`` and ``SolveError``.

        ``checked``: the shot was checked before, and none of its inputs has changed since. ``cached``: take motion from
        the cache if it was solved on this machine for the same vehicles, world and marks.
        """
        from vehsim.cameras.cuts import within
        from vehsim.delivery.take import Take

        errors = [] if checked else [problem for problem in self.check() if problem.severity == "error"]
        if errors:
            raise ShotError(errors)
        progress = progress or silent
        (clips, vehicles), recalled = self._motion(progress, cached)
        marks = {name: report.pop("marks", []) for name, report in vehicles.items()}
        asks = {name: report.pop("asks", []) for name, report in vehicles.items()}
        for name, report in vehicles.items():
            ends = clips[name].start_frame, clips[name].end_frame
            targets = target_asks(report.pop("targets", ()), *ends, float(self.fps))
            asks[name] = [*asks[name], *(ask.as_dict() for ask in targets)]
            asks[name] = self._asks_apart(name, clips[name], asks[name])
        self._check_free_ends(clips)
        frames = self._frames(clips)
        clips = {name: self._carried(name, clip, frames) for name, clip in clips.items()}
        for name, clip in clips.items():
            vehicles[name]["frames"] = [clip.start_frame, clip.end_frame]
        self._warn_off_ground(clips)
        self._warn_under_water(clips)
        self._check_rock(clips)
        self._warn_of_what_is_late(frames[1])
        clips = {name: self._held(name, clip, frames) for name, clip in clips.items()}
        avoided = self._avoided
        worlds = {name: with_vehicles(self.world, clips, avoided, name) for name in clips}
        return Take(
            name=self.name,
            clips=clips,
            world=self.world,
            cameras=self.cameras(clips, frames),
            fps=self.fps,
            frames=frames,
            render=self.render,
            usd=self.usd,
            blockings=self.blockings(),
            cuts=within(self.cuts, *frames),
            recalled=recalled,
            report={
                "shot": self.file.model_dump(mode="json", by_alias=True, exclude_unset=True),
                "vehicles": vehicles,
                "marks": marks,
                "audit": audit_clips(clips, asks, worlds, frames),
            }
            | ({"left_out": list(self.left_out)} if self.left_out else {}),
        )

    def motion(self, progress: Progress | None = None) -> dict[str, Clip]:
        """The motion of every vehicle of a checked shot, from its own first to its own last frame, solved or from the
        cache: what `solve` delivers, without cameras and audit. Raises ``SolveError``."""
        (clips, _), _ = self._motion(progress or silent, cached=True)
        return {name: self._placed(name, clip) for name, clip in clips.items()}

    def preview(self) -> Take | None:
        """The take of a shot that is not solved: each vehicle goes straight from mark to mark; None if none has
        marks."""
        from vehsim.delivery.take import Take
        from vehsim.planning.drafts import guessed
        from vehsim.shot.motions.plan import PlanMotion, as_mark

        clips, marks = {}, {}
        for table in self.file.vehicle:
            if isinstance(table.motion, PlanMotion):
                with suppress(VehsimError):
                    vehicle, given = self.vehicle(table), table.motion.all_marks(self._context)
                    wanted = [as_mark(mark, vehicle) for mark in given]
                    clips[table.name] = guessed(vehicle, self.world, wanted, self.fps)
                    marks[table.name] = [mark.model_dump(mode="json", exclude_unset=True) for mark in given]
        if not clips:
            return None
        shown = self.only(list(clips))
        vars(shown)["world"] = self.world
        frames = shown._frames(clips)
        clips = {name: hold(clip, *frames) for name, clip in clips.items()}
        return Take(
            name=self.name,
            clips=clips,
            world=self.world,
            cameras=shown.cameras(clips, frames),
            fps=self.fps,
            frames=frames,
            render=shown.render,
            report={"shot": self.file.model_dump(mode="json", by_alias=True, exclude_unset=True), "marks": marks},
        )

    def _placed(self, name: str, clip: Clip) -> Clip:
        from vehsim.world.placing import placed

        with naming(name, clip.vehicle.name):
            return placed(clip, self.world)

    def _carried(self, name: str, clip: Clip, frames: tuple[int, int]) -> Clip:
        """The clip through the handles of a shot's ``frames``."""
        return self._placed(name, carry_on(name, clip, *frames, self.file.shot.handles, self.world))

    def _held(self, name: str, clip: Clip, frames: tuple[int, int]) -> Clip:
        """The clip on all ``frames``."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a motion that is cut off does not brake; of the rest, all is said
            return self._placed(name, hold(clip, *frames))

    @cached_property
    def cuts(self) -> tuple[tuple[int, str], ...]:
        """The cut list, first frames and names of cameras: of the tables, or of an editor's timeline. Raises
        ``InputError`` if the timeline cannot be read."""
        path = self.file.render.cuts
        if path is None:
            return tuple((piece.frame, piece.camera) for piece in self.file.cut)
        return read_cuts(self.folder / path, "render.cuts", self.fps)

    @property
    def render(self) -> RenderSettings:
        """The settings of pictures."""
        from vehsim.cameras.cuts import CUT
        from vehsim.delivery.take import RenderSettings

        table = self.file.render
        cameras = table.cameras or [CUT] * bool(self.cuts)
        size = (table.size[0], table.size[1])
        shown = (tuple(cameras) or None, table.layout, table.captions, table.mood, tuple(table.passes))
        return RenderSettings(size, table.every, table.samples, table.shadows, *shown, burn_in=table.burn_in)

    def blockings(self) -> dict[str, Blocking]:
        """The animator's blocking, by vehicle, for vehicles with one."""
        tables = {table.name: getattr(table.motion, "marks", None) for table in self.file.vehicle}
        given = {name: table for name, table in tables.items() if table and not table.edit}
        return {name: blocking_of(table, self.folder, self.fps) for name, table in given.items()}

    @property
    def usd(self) -> UsdSettings:
        """The form of the USD."""
        from vehsim.delivery.take import UsdSettings

        given = self.file.export.model_dump()
        shutter, curves = given.pop("shutter"), given.pop("curves")
        return UsdSettings(
            **given,
            shutter=None if shutter is None else (shutter[0], shutter[1]),
            curves=None if curves is None else (curves["tolerance"], curves["angle"]),
        )

    def _asset(self, name: str) -> str | Path:
        """A path relative to the shot file if it exists, else a shipped asset's name."""
        beside = self.folder / os.path.expanduser(name)  # Path's own method raises for an unknown user
        return beside if beside.exists() else name

    @cached_property
    def _context(self) -> Context:
        header = self.file.shot
        return Context(self.world, header.fps, header.first, header.last, self.folder)

    def _check(self, in_world: bool = True) -> Iterator[Problem]:
        """All problems; without those of motions in the world if it is not whole."""
        yield from self._check_header()
        yield from self._check_cameras()
        names = [vehicle.name for vehicle in self.file.vehicle]
        wrong = list(check_obstacles(self.file.world.obstacle, self.folder, names, self.left_out))
        wrong += check_water(self.file.world.water, self.folder)
        yield from wrong
        world = None
        try:
            world = self.world if in_world else None
        except InputError as error:
            if self.file.world.terrain is not None and not wrong:
                for problem in error.problems:
                    yield problem.seen_from("world.terrain", self.file.world.terrain, "see vehsim terrains")
        if world is not None and world.terrain is not None and world.terrain.look is not None:
            name = self.file.world.terrain or ""
            yield from check_copied("world.terrain", name, world.terrain.look, [], self.file.export)
        if world is not None:
            yield from check_stands(self.file.world.obstacle, world)
        for i, table in enumerate(self.file.vehicle):
            key = f"vehicle[{i}].asset"
            try:
                with complaints(key):
                    yield from self._check_vehicle(i, table, world)
            except InputError as error:  # all errors of its vehicle.toml or asset
                for problem in error.problems:
                    if problem.key.startswith("parameters."):
                        yield replace(problem, key=f"vehicle[{i}].{problem.key}")
                    else:
                        yield problem.seen_from(key, table.asset, "see vehsim vehicles")

    def _check_vehicle(self, i: int, table: VehicleTable, world: World | None) -> Iterator[Problem]:
        vehicle, key = self.vehicle(table), f"vehicle[{i}].asset"
        yield from check_asset(key, table.asset, vehicle)
        if (rig := vehicle.rig) is not None and self.file.export.assets == "copy":
            homes = [] if rig.folder is None else [rig.folder]
            yield from check_copied(key, table.asset, rig.source or rig.asset, homes, self.file.export)
        yield from check_variants(f"vehicle[{i}].variants", table.variants, vehicle.rig)
        if world is None:
            return
        for problem in table.motion.check(vehicle, self._context):
            yield problem.below(f"vehicle[{i}].motion")
        found = [*check_afloat(vehicle, world), *check_trailer(vehicle, world)]
        from vehsim.shot.motions.simulate import ForwardMotion

        found += self._check_edits(table, isinstance(table.motion, ForwardMotion))
        if isinstance(table.motion, ForwardMotion):
            others = [other.name for other in self.file.vehicle if other is not table]
            things = {obstacle.name for obstacle in world.obstacles} | set(others)
            found += check_contact(vehicle, world, things)
        for problem in found:
            yield replace(problem, key=f"vehicle[{i}].{problem.key}")
        if world.wind.any() and not vehicle.feels_wind:
            message = f"{table.name} has no drag, so wind has no effect"
            remedy = "add drag to its vehicle.toml, or remove the wind"
            yield Problem("world.wind", message, remedy, self.file.world.wind, severity="warning")
        if world.water is None and vehicle.hull is not None:
            message = f"{table.name} moves level in the plane, and pictures show no water"
            yield Problem("world.water", message, "add [world.water]", severity="warning")

    def _check_edits(self, table: VehicleTable, simulated: bool) -> Iterator[Problem]:
        """Problems with the edits of a vehicle, with keys relative to its table. ``simulated``: as in
        `EditTable.check`."""
        marks, edits, given = getattr(table.motion, "marks", None), table.edits, len(table.edit)
        if len(edits) < given + bool(marks and marks.edit) or any(b <= a for a, b in pairwise(edits)):
            yield Problem("edit", "their rounds do not rise", "leave round out, or give each edit a higher one")
            return
        for i, edit in enumerate(edits.values(), given - len(edits)):
            for problem in edit.check(self.vehicle(table), self._context, simulated):
                key = f"edit[{i}]" if given > 1 and i >= 0 else "edit"
                yield replace(problem, key=key + problem.key.removeprefix("edit"))

    def _check_header(self) -> Iterator[Problem]:
        header = self.file.shot
        if self.file.sweep is not None:
            remedy = "vehsim export and vehsim.batch.load_shots expand it"
            yield Problem("sweep", "the sweep is ignored here", remedy, severity="warning")
        if header.handles and header.end_frame is None:
            yield Problem("shot.handles", "handles need an end frame", "give shot.end_frame", header.handles)
        if header.end_frame is not None and header.end_frame < header.start_frame:
            message = f"before the first frame, {header.start_frame}"
            yield Problem("shot.end_frame", message, "give a later frame", header.end_frame)
        elif header.end_frame is not None and header.end_frame - header.start_frame >= MAX_FRAMES:
            message = f"{header.end_frame - header.start_frame + 1} frames"
            yield Problem("shot.end_frame", message, f"a shot has at most {MAX_FRAMES}", header.end_frame)
        for kind in ("vehicle", "camera"):
            names: list[str] = []
            for i, table in enumerate(getattr(self.file, kind)):
                # each name becomes a file name, also on file systems that ignore case
                if table.name.casefold() in names:
                    remedy = f"give every {kind} a name that differs in more than its case"
                    yield Problem(f"{kind}[{i}].name", "used twice", remedy, table.name)
                names.append(table.name.casefold())

    def _check_cameras(self) -> Iterator[Problem]:
        from vehsim.cameras.rigs import RIGS

        vehicles = [vehicle.name for vehicle in self.file.vehicle]
        for i, camera in enumerate(self.file.camera):
            if camera.rig not in RIGS:
                yield Problem(f"camera[{i}].rig", "no such rig", did_you_mean(camera.rig, RIGS), camera.rig)
            if camera.target is not None and camera.target not in vehicles:
                yield Problem(
                    f"camera[{i}].target", "no such vehicle", did_you_mean(camera.target, vehicles), camera.target
                )
            if camera.look_at is not None and camera.look_at == camera.position:
                yield Problem(
                    f"camera[{i}].look_at",
                    "the camera is at this point",
                    "give another point to look at",
                    camera.look_at,
                )
        try:
            yield from check_cuts(self.file, self.cuts)
        except InputError as error:
            for problem in error.problems:
                yield replace(problem, key="").seen_from("render.cuts", self.file.render.cuts)

    def _motion(self, progress: Progress, cached: bool) -> tuple[SolvedMotion, bool]:
        """Clips and reports by vehicle, and whether they come from the cache."""
        from vehsim.shot.cache import FROM_CACHE, motion_key, recalled_or

        if not cached:
            return self._solved_or_retouched(progress, cached), False
        vehicles = {table.name: self.vehicle(table) for table in self.file.vehicle}
        key = motion_key(self.file, self.motion_files(), self.world.content_hash)
        motion, recalled = recalled_or(lambda: self._solved_or_retouched(progress), key, vehicles)
        if recalled:
            progress(FROM_CACHE, 1.0)
        return motion, recalled

    def _solved_or_retouched(self, progress: Progress, cached: bool = True) -> SolvedMotion:
        """The solved motion; where an animator edited it, the nearest motion that the vehicle can make.

        A later round edits the motion of all vehicles that the earlier ones lead to, as it was delivered.
        """
        last = self.last_round
        edited = [table for table in self.file.vehicle if last in table.edits]
        if not edited:
            return self._solve_vehicles(progress)
        clips, reports = self.unedited()._motion(progress, cached)[0]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `solve` says it of the retouched motion
            frames = self._frames(clips)
            delivered = {
                table.name: self._held(table.name, self._carried(table.name, clips[table.name], frames), frames)
                for table in edited
            }
        for table in edited:
            name = table.name

            def report(what: str, done: float, name: str = name) -> None:
                progress(f"{name}: {what}", done)

            context = replace(self._context, world=self.world_of(name, clips))
            options = table.motion.options() if hasattr(table.motion, "options") else {}
            clips[name], reports[name] = table.edits[last].retouch(
                name, clips[name], delivered[name], reports[name], options, context, report, self.usd.curves, last
            )
        return clips, reports

    @property
    def last_round(self) -> int:
        """The number of the last round of edits; zero without edits."""
        return max((number for table in self.file.vehicle for number in table.edits), default=0)

    def unedited(self) -> Shot:
        """The shot with the motion that was edited last."""
        last = self.last_round
        vehicles = [table.without_last_edit if last in table.edits else table for table in self.file.vehicle]
        shot = Shot(self.file.model_copy(update={"vehicle": vehicles}), self.folder, self.source, self._lines)
        vars(shot).update(world=self.world, _vehicles=self._vehicles)
        return shot.without(self.left_out)

    def _solve_vehicles(self, progress: Progress) -> tuple[dict[str, Clip], dict[str, Any]]:
        clips: dict[str, Clip] = {}
        reports: dict[str, Any] = {}
        meeting = self._meeting()
        together: dict[str, tuple[Clip, dict[str, Any]]] = {}
        for i, table in enumerate(self._in_order()):
            world = self.world_of(table.name, clips)

            def report(what: str, done: float, name: str = table.name, before: int = i) -> None:
                progress(f"{name}: {what}", (before + done) / len(self.file.vehicle))

            if table.name in meeting:
                together = together or self._meet(meeting, world, progress)
                clips[table.name], details = together[table.name]
                details |= {"together": [*together]}
                reports[table.name] = {"asset": table.asset, "method": table.motion.method, **details}
                continue
            context = replace(self._context, world=world)
            vehicle = self.vehicle(table)
            key = f"vehicle[{self.file.vehicle.index(table)}].motion"
            with naming(table.name, vehicle.name, key):
                clips[table.name], details = table.motion.solve(vehicle, context, told_as(table.name, progress, report))
            reports[table.name] = {"asset": table.asset, "method": table.motion.method, **details}
        order = [table.name for table in self.file.vehicle]
        return {name: clips[name] for name in order}, {name: reports[name] for name in order}

    def world_of(self, name: str, clips: Mapping[str, Clip]) -> World:
        """The world of one vehicle: the others that are obstacles move through it as in ``clips``."""
        return with_vehicles(self.world, clips, self._avoided, name)

    def _in_order(self) -> list[VehicleTable]:
        """The vehicles in the order in which they are solved: each moves around those before it that are obstacles.

        Obstacles come first; of them, those that keep clear of nothing (in a world with contact, others push them),
        then those on the ground, which flying ones also avoid above and below.
        """
        avoided, free = self._avoided, self.file.world.contact is None

        def place(table: VehicleTable) -> tuple[bool, bool, bool]:
            keeps_clear = self._clearance(table) is not None
            return table.name not in avoided, free and keeps_clear, keeps_clear and not is_planar(self.vehicle(table))

        return sorted(self.file.vehicle, key=place)

    @staticmethod
    def _clearance(table: VehicleTable) -> float | None:
        """The clearance that a vehicle's motion keeps from obstacles, m; None if it avoids nothing."""
        return getattr(table.motion, "clearance", None)

    def _asks_apart(self, name: str, clip: Clip, asks: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """The asks of a vehicle, with its clearance from obstacles that were solved after it too.

        They keep only their own clearance from it; the audit measures whether that is enough.
        """
        order = self._in_order()
        tables = [table.name for table in order]
        later = [table for table in order[tables.index(name) + 1 :] if table.name in self._avoided]
        clearance = self._clearance(order[tables.index(name)])
        if clearance is None or not later:
            return asks
        given = [ask for ask in asks if ask["measure"] == "clearance"]
        if not given:
            ends = float(clip.start_frame), float(clip.end_frame)
            given = [clearance_ask(*ends, clearance, planar=clip.vehicle.group.planar).as_dict()]
            asks = [*asks, *given]
        less = [table for table in later if (self._clearance(table) or 0.0) < clearance]
        if less:
            names = " and ".join(table.name for table in less)
            given[0]["remedy"] = (
                f"{names} moves around it: give the motion of {names} a clearance of {clearance:g} m too"
            )
        return asks

    @property
    def _avoided(self) -> set[str]:
        """The vehicles that are obstacles for the others."""
        return {table.vehicle for table in self.file.world.obstacle if table.shape == "vehicle"}

    def _meeting(self) -> dict[str, tuple[ForwardMotion, Vehicle]]:
        """The simulated vehicles that may touch each other, with their motions; none if there are fewer than two."""
        from vehsim.shot.motions.simulate import ForwardMotion

        motions = {table.name: (table.motion, self.vehicle(table)) for table in self.file.vehicle}
        simulated: dict[str, tuple[ForwardMotion, Vehicle]] = {
            name: (motion, vehicle)
            for name, (motion, vehicle) in motions.items()
            if isinstance(motion, ForwardMotion) and vehicle.group.dim == 6 and vehicle.rig is not None
        }
        return {} if self.world.contact is None or len(simulated) < 2 else simulated

    def _meet(
        self, simulated: Mapping[str, tuple[ForwardMotion, Vehicle]], world: World, progress: Progress
    ) -> dict[str, tuple[Clip, dict[str, Any]]]:
        """Their clips, advanced together in ``world``, and the report about each."""
        from vehsim.simulation import simulate_together

        movers, durations, after = {}, [], {}
        for name, (motion, vehicle) in simulated.items():
            movers[name], duration = motion.mover(vehicle, self._context)
            durations.append(duration)
            if (clip := motion.continued(vehicle, self._context)) is not None:
                after[name] = clip
        step, first = min(motion.step for motion, _ in simulated.values()), self._context.first
        meeting = ", ".join(simulated)
        clips = simulate_together(
            movers, world, max(durations), step, self.fps, first, after=after or None,
            progress=lambda what, done: progress(f"{meeting}: {what}", done / len(self.file.vehicle)),
        )  # fmt: skip
        pilots = {name: mover.controls for name, mover in movers.items() if hasattr(mover.controls, "targets")}
        details = {name: {"targets": pilot.targets(clips[name].duration)} for name, pilot in pilots.items()}
        return {name: (clip, details.get(name, {})) for name, clip in clips.items()}

    def _warn_of_what_is_late(self, last: int) -> None:
        """Warn of notes and cuts that no frame shows."""
        at = {f"note[{i}].frame": note.frame for i, note in enumerate(self.file.note)}
        edited = self.file.render.cuts is not None
        at |= {"render.cuts" if edited else f"cut[{i}].frame": frame for i, (frame, _) in enumerate(self.cuts)}
        for key, frame in at.items():
            if frame > last:
                message = f"after the last frame, {last}, so it is not shown"
                warnings.warn(Caution(Problem(key, message, "move it", frame)), stacklevel=3)

    def _warn_off_ground(self, clips: Mapping[str, Clip]) -> None:
        """Warn of a vehicle in the plane without wheels where the ground rises or falls below it."""
        if self.world.terrain is None:
            return
        water = self.world.water is not None
        floating = [table.name for table in self.file.vehicle if water and self.vehicle(table).hull is not None]
        for name, clip in clips.items():
            if clip.vehicle.group.dim != 3 or "heave" in clip.channels or name in floating:
                continue
            off = clip.positions[:, 2] - self.world.height(clip.positions[:, :2])
            for k in np.flatnonzero(np.abs(off) > OFF_GROUND)[:1]:
                place = f"{abs(off[k]):.2f} m {'above' if off[k] > 0 else 'below'}"
                warnings.warn(
                    f"{name}: {place} the ground at frame {clip.frames[k]:g}: its asset has no wheels to follow it; "
                    "add channels travel_* or roll_* to its vehicle.toml, or stay on level ground",
                    stacklevel=3,
                )

    def _warn_under_water(self, clips: Mapping[str, Clip]) -> None:
        """Warn of a vehicle that does not float where its root is below the water's level: nothing keeps it out."""
        water = self.world.water
        if water is None:
            return
        for name, clip in clips.items():
            depth = water.level - clip.positions[:, 2]
            if clip.vehicle.hull is None and (under := depth > OFF_GROUND).any():
                first = clip.frames[under.argmax()]
                warnings.warn(
                    f"{name}: goes under water at frame {first:g}, down to {depth.max():.2f} m; raise its marks, or "
                    f"keep a plan above with [[vehicle.motion.stay]] above = {water.level:g}",
                    stacklevel=3,
                )

    def _check_rock(self, clips: Mapping[str, Clip]) -> None:
        """Warn of a vehicle on the ground that reaches into the rock above or beside it, which only plans avoid. Raises
        ``SolveError`` if its wheels are in the rock."""
        from vehsim.world.ground.rock import rock_met, rock_under_wheels

        for name, clip in clips.items():
            found = rock_met(clip, self.world) if clip.vehicle.group.planar else None
            if found is None:
                continue
            frame, (x, y, z) = found
            place = f"at ({x:.2f}, {y:.2f}, {z:.2f}) m at frame {frame:g}"
            remedy = "only plans keep vehicles on the ground away from walls and roofs: keep away, or plan its motion"
            if rock_under_wheels(clip, self.world):
                message = f"drives into the rock of the terrain {place}, where its wheels have no ground"
                terrain = self.file.world.terrain
                raise SolveError(message, remedy, key="world.terrain", value=terrain, subject=name)
            warnings.warn(f"{name}: reaches into the rock of the terrain {place}; {remedy}", stacklevel=3)

    def _check_free_ends(self, clips: Mapping[str, Clip]) -> None:
        """Raise ``SolveError`` if a mark whose frame the planner chose is reached after the shot's last frame."""
        last = self.file.shot.last
        for table in self.file.vehicle:
            name, marks = table.name, getattr(table.motion, "mark", None) or []
            free = bool(marks) and marks[-1].frame == "free"
            if free and last is not None and (clip := clips[name]).end_frame > last:
                key, given, needed = "shot.end_frame", self.file.shot.end_frame, clip.end_frame - self.file.shot.handles
                message = f"{name} reaches mark[{len(marks) - 1}] only at frame {clip.end_frame}"
                remedy = f"use {needed} or later, or give the mark an earlier frame"
                raise SolveError.of(Problem(key, message, remedy, given, fixes=((key, needed),)))

    def _frames(self, clips: Mapping[str, Clip]) -> tuple[int, int]:
        """First and last frame of the take; warns if a vehicle is cut off in motion."""
        first = self.file.shot.first
        last = self.file.shot.last
        last = max(clip.end_frame for clip in clips.values()) if last is None else last
        for name, clip in clips.items():
            for index, short in ((0, clip.start_frame - first), (-1, last - clip.end_frame)):
                if short > self.file.shot.handles and not rests(clip, index):
                    warnings.warn(
                        f"{name}: its motion covers only frames {clip.start_frame} to {clip.end_frame} of {first} to "
                        f"{last} and is cut off while it moves; in the other frames it stands still; change marks or "
                        "duration",
                        stacklevel=3,
                    )
        return first, last

    def cameras(self, clips: Mapping[str, Clip], frames: tuple[int, int]) -> tuple[Camera, ...]:
        """The cameras on whole ``frames`` (first, last) for solved ``clips``."""
        from vehsim.cameras.camera import CameraRig
        from vehsim.cameras.cuts import CUT, cut, shown_of, within
        from vehsim.cameras.framing import solve_camera
        from vehsim.cameras.rigs import RIGS
        from vehsim.shot.cache import filmed, motion_key

        width, height = self.render.panel(len(self.render.cameras or self.file.camera))
        rigs: list[CameraRig] = [CameraRig(**camera.model_dump(exclude_unset=True)) for camera in self.file.camera]
        aspect, key = width / height, None
        if not RIGS.has_additions and (made_of := motion_key(self.file, self.motion_files(), self.world.content_hash)):
            moves = [sha256(clip.to_bytes()).hexdigest() for clip in clips.values()]
            key = repr((made_of, moves, frames, aspect))
        film = within(self.cuts, *frames) if self.cuts else ()
        shown = {rig.name: shown_of(rig.name, film, frames[1]) or None for rig in rigs}
        shown |= dict.fromkeys(self.file.render.cameras or ())  # pictures of its own show all of it
        cameras = filmed(
            rigs, lambda rig: solve_camera(rig, clips, self.world, frames, aspect, shown[rig.name]), key, shown
        )
        if film:
            cameras.append(cut(CUT, {camera.name: camera for camera in cameras}, film))
        return tuple(cameras)


def _showing(variants: Mapping[str, str], vehicle: Vehicle) -> Vehicle:
    """A vehicle, also where it moves in the plane, with these ``variants`` of its asset."""
    planar = None if vehicle.planar is None else _showing(variants, vehicle.planar)
    rig = vehicle.rig and replace(vehicle.rig, variants={**vehicle.rig.variants, **variants})
    return replace(vehicle, rig=rig, planar=planar)


def _place(problem: Problem, source: str, lines: Mapping[str, int]) -> Problem:
    """The problem with its file and line."""
    line = problem.line or line_of(problem.key, lines)
    return replace(problem, file=problem.file or source, line=line)
