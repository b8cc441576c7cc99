"""A shot: loaded, checked against the world, solved into a take."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import InputError, Problem, ShotError
from vehsim.intake.toml import line_of, lines_of, read_toml, too_large
from vehsim.intake.usd import complaints
from vehsim.requests import target_asks
from vehsim.shot import obstacles
from vehsim.shot.audited import audit_clips
from vehsim.shot.blocked import blocking_of
from vehsim.shot.checks import (
    Setting,
    check_asset,
    check_copied,
    check_cuts,
    check_names,
    check_trailer,
    check_variants,
    choose,
)
from vehsim.shot.file import ShotFile, VehicleTable, parse
from vehsim.shot.handles import carry_on
from vehsim.shot.holding import hold, rests
from vehsim.shot.model import MAX_FRAMES
from vehsim.shot.reading import apply_overrides
from vehsim.shot.water import check_afloat, check_water, make_water

if TYPE_CHECKING:
    from vehsim.blocking import Blocking
    from vehsim.cameras import Camera, CameraRig
    from vehsim.clip import Clip
    from vehsim.shot.kept import Motion
    from vehsim.shot.motions import SimulateMotion
    from vehsim.take import Progress, RenderSettings, Take, UsdSettings
    from vehsim.vehicles import Vehicle
    from vehsim.world import World

OFF_GROUND = 0.05
"""Distance of a driving vehicle from the ground that is worth a warning, m."""


class Shot:
    """A shot file in memory. Make one with `Shot.load` or `Shot.from_dict`; `solve` makes the take.

    Both raise ``ShotError`` with everything that is wrong at once.
    """

    def __init__(self, file: ShotFile, folder: Path, source: str = "", lines: Mapping[str, int] | None = None):
        self.file, self.folder, self.source = file, folder, source
        self._lines = lines or {}

    @classmethod
    def load(cls, path: str | Path, overrides: Sequence[str] = ()) -> Shot:
        """Read a shot file. ``overrides``: ``"world.wind=[0,3,0]"`` and the like, applied first."""
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
        """A shot from what a shot file holds; its paths are relative to ``folder``."""
        lines = lines or {}
        if problem := too_large(data):
            raise ShotError([_place(problem, source, lines)])
        if isinstance(data, Mapping):
            data = copy.deepcopy(dict(data))
            apply_overrides(data, overrides)
        file, problems = parse(data)
        shot = cls(file, Path(folder), source, lines) if file else None
        if problems:
            found = [_place(problem, source, lines) for problem in problems]
            raise ShotError(found + (shot.check() if shot else []))
        assert shot is not None
        return shot

    @property
    def name(self) -> str:
        """The shot's name: that of its folder, its stage and the root prim."""
        return self.file.shot.name

    @property
    def fps(self) -> Fraction:
        """Frames a second, exact: 23.976 is 24000/1001."""
        return self.file.shot.fps

    def only(self, names: Sequence[str]) -> Shot:
        """The shot with these vehicles alone; cameras whose target is gone look at the first of them."""
        known = [vehicle.name for vehicle in self.file.vehicle]
        for name in names:
            if name not in known:
                raise ShotError([Problem("--only", "no such vehicle", choose(name, known), name, self.source)])
        kept = [vehicle for vehicle in self.file.vehicle if vehicle.name in names]
        cameras = [
            camera if camera.target in (None, *names) else camera.model_copy(update={"target": kept[0].name})
            for camera in self.file.camera
        ]
        file = self.file.model_copy(update={"vehicle": kept, "camera": cameras})
        return Shot(file, self.folder, self.source, self._lines)

    @cached_property
    def world(self) -> World:
        """What surrounds the vehicles; obstacles that move come with the motions. Raises ``InputError``."""
        from vehsim.world import World
        from vehsim.world.contact import Contact
        from vehsim.world.wind import Gusts

        table = self.file.world
        terrain = None if table.terrain is None else self._asset(table.terrain)
        return World(
            terrain,
            table.wind,
            obstacles.standing(table.obstacle, self.folder),
            water=make_water(table.water, self.folder),
            gusts=None if table.gusts is None else Gusts(**table.gusts.model_dump()),
            contact=None if table.contact is None else Contact(**table.contact.model_dump()),
        )

    def vehicle(self, table: VehicleTable) -> Vehicle:
        """The vehicle that a ``[[vehicle]]`` names, in the variants asked for. Raises ``InputError``."""
        from vehsim.vehicles import load_vehicle

        vehicle = load_vehicle(self._asset(table.asset))
        if table.variants and vehicle.rig is not None:
            vehicle = replace(vehicle, rig=replace(vehicle.rig, variants={**vehicle.rig.variants, **table.variants}))
        return vehicle

    def check(self) -> list[Problem]:
        """Everything wrong that can be known before solving; nothing is written. Warnings have their severity."""
        return [_place(problem, self.source, self._lines) for problem in self._check()]

    def solve(self, progress: Progress | None = None, *, checked: bool = False, cached: bool = True) -> Take:
        """Check, then solve every vehicle's motion and every camera. Raises ``ShotError`` and ``SolveError``.

        ``checked``: this was done before, and nothing that the shot is made of has changed since. ``cached``: motion
        that was solved before, on this machine and for the same vehicles, world and marks, is taken from the cache.
        """
        from vehsim.take import Take
        from vehsim.world.ground import lift

        errors = [] if checked else [problem for problem in self.check() if problem.severity == "error"]
        if errors:
            raise ShotError(errors)
        progress = progress or (lambda what, done: None)
        (clips, vehicles), recalled = self._motion(progress, cached)
        marks = {name: report.pop("marks", []) for name, report in vehicles.items()}
        asks = {name: report.pop("asks", []) for name, report in vehicles.items()}
        for name, report in vehicles.items():
            ends = clips[name].start_frame, clips[name].end_frame
            targets = target_asks(report.pop("targets", ()), *ends, float(self.fps))
            asks[name] = [*asks[name], *(ask.as_dict() for ask in targets)]
        frames = self._frames(clips)
        handles = self.file.shot.handles
        clips = {name: carry_on(name, clip, *frames, handles, self.world) for name, clip in clips.items()}
        clips = {name: lift(clip, self.world) for name, clip in clips.items()}
        self._warn_off_ground(clips)
        clips = {name: lift(hold(clip, *frames), self.world) for name, clip in clips.items()}
        avoided = self._avoided
        worlds = {name: obstacles.with_vehicles(self.world, clips, avoided, name) for name in clips}
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
            recalled=recalled,
            report={
                "shot": self.file.model_dump(mode="json", by_alias=True, exclude_unset=True),
                "vehicles": vehicles,
                "marks": marks,
                "audit": audit_clips(clips, asks, worlds, frames),
            },
        )

    @property
    def render(self) -> RenderSettings:
        """How pictures are made."""
        from vehsim.cameras import CUT
        from vehsim.take import RenderSettings

        table = self.file.render
        cameras = table.cameras or [CUT] * bool(self.file.cut)
        size = (table.size[0], table.size[1])
        shown = (tuple(cameras) or None, table.layout, table.captions, table.mood, tuple(table.passes))
        return RenderSettings(size, table.every, table.samples, table.shadows, *shown, burn_in=table.burn_in)

    def blockings(self) -> dict[str, Blocking]:
        """What the vehicles that were blocked in follow, by vehicle."""
        tables = {table.name: getattr(table.motion, "marks", None) for table in self.file.vehicle}
        return {name: blocking_of(table, self.folder, self.fps) for name, table in tables.items() if table}

    @property
    def usd(self) -> UsdSettings:
        """How the USD is delivered."""
        from vehsim.take import UsdSettings

        given = self.file.export.model_dump()
        shutter = given.pop("shutter")
        return UsdSettings(**given, shutter=None if shutter is None else (shutter[0], shutter[1]))

    def _asset(self, name: str) -> str | Path:
        """A path relative to the shot file when there is one, else a shipped asset's name."""
        beside = self.folder / os.path.expanduser(name)  # Path's own raises for a user nobody knows
        return beside if beside.exists() else name

    @cached_property
    def _setting(self) -> Setting:
        header = self.file.shot
        return Setting(self.world, header.fps, header.first, header.last, self.folder)

    def _check(self) -> Iterator[Problem]:
        yield from self._check_header()
        yield from self._check_cameras()
        names = [vehicle.name for vehicle in self.file.vehicle]
        wrong = list(obstacles.check_obstacles(self.file.world.obstacle, self.folder, names))
        wrong += check_water(self.file.world.water, self.folder)
        yield from wrong
        world = None
        try:
            world = self.world
        except InputError as error:
            if self.file.world.terrain is not None and not wrong:
                said = str(error).partition("': ")[2] if str(error).startswith("terrain = ") else str(error)
                yield Problem("world.terrain", said, "see vehsim terrains", self.file.world.terrain)
        if world is not None and world.terrain is not None and world.terrain.look is not None:
            name = self.file.world.terrain or ""
            yield from check_copied("world.terrain", name, world.terrain.look, [], self.file.export)
        for i, table in enumerate(self.file.vehicle):
            key = f"vehicle[{i}].asset"
            try:
                with complaints(key):
                    yield from self._check_vehicle(i, table, world)
            except ShotError as error:  # all that is wrong with its vehicle.toml or asset
                for problem in error.problems:
                    message, _, remedy = str(problem).rpartition("; ")
                    yield Problem(key, message, remedy, table.asset)
            except InputError as error:
                yield Problem(key, str(error), "see vehsim vehicles", table.asset)

    def _check_vehicle(self, i: int, table: VehicleTable, world: World | None) -> Iterator[Problem]:
        vehicle, key = self.vehicle(table), f"vehicle[{i}].asset"
        yield from check_asset(key, table.asset, vehicle.rig)
        if (rig := vehicle.rig) is not None and self.file.export.assets == "copy":
            homes = [] if rig.folder is None else [rig.folder]
            yield from check_copied(key, table.asset, rig.source or rig.asset, homes, self.file.export)
        yield from check_variants(f"vehicle[{i}].variants", table.variants, vehicle.rig)
        if world is None:
            return
        for problem in table.motion.check(vehicle, self._setting):
            yield replace(problem, key=f"vehicle[{i}].motion.{problem.key}")
        for problem in (*check_afloat(vehicle, world), *check_trailer(vehicle, world)):
            yield replace(problem, key=f"vehicle[{i}].{problem.key}")
        if world.wind.any() and not vehicle.feels_wind:
            message = f"{table.name} does not feel it: its drag is zero"
            mend = "give its vehicle.toml drag, or leave the wind out"
            yield Problem("world.wind", message, mend, self.file.world.wind, severity="warning")

    def _check_header(self) -> Iterator[Problem]:
        header = self.file.shot
        if self.file.sweep is not None:
            mend = "vehsim export and vehsim.batch.load_shots make its clips"
            yield Problem("sweep", "this is the shot without its sweep", mend, severity="warning")
        if header.handles and header.end_frame is None:
            yield Problem("shot.handles", "handles need an end to stand after", "give shot.end_frame", header.handles)
        if header.end_frame is not None and header.end_frame < header.start_frame:
            message = f"before the first frame, {header.start_frame}"
            yield Problem("shot.end_frame", message, "give a later frame", header.end_frame)
        elif header.end_frame is not None and header.end_frame - header.start_frame >= MAX_FRAMES:
            message = f"{header.end_frame - header.start_frame + 1} frames"
            yield Problem("shot.end_frame", message, f"a shot has at most {MAX_FRAMES}", header.end_frame)
        for kind in ("vehicle", "camera"):
            names: list[str] = []
            for i, table in enumerate(getattr(self.file, kind)):
                if table.name.casefold() in names:  # each names files, also where cases are not told apart
                    mend = f"give every {kind} a name of its own, in more than its case"
                    yield Problem(f"{kind}[{i}].name", "used twice", mend, table.name)
                names.append(table.name.casefold())

    def _check_cameras(self) -> Iterator[Problem]:
        from vehsim.cameras import RIGS

        cameras = [camera.name for camera in self.file.camera]
        yield from check_names("render.captions", self.file.render.captions, cameras, "camera")
        vehicles = [vehicle.name for vehicle in self.file.vehicle]
        for i, camera in enumerate(self.file.camera):
            if camera.rig not in RIGS:
                yield Problem(f"camera[{i}].rig", "no such rig", choose(camera.rig, RIGS), camera.rig)
            if camera.target is not None and camera.target not in vehicles:
                yield Problem(f"camera[{i}].target", "no such vehicle", choose(camera.target, vehicles), camera.target)
            if camera.look_at is not None and camera.look_at == camera.position:
                yield Problem(f"camera[{i}].look_at", "the camera stands there", "look elsewhere", camera.look_at)
        yield from check_cuts(self.file)

    def _motion(self, progress: Progress, cached: bool) -> tuple[Motion, bool]:
        """Clips and reports by vehicle, and whether they are from the cache."""
        from vehsim.shot.kept import FROM_CACHE, recalled_or

        if not cached:
            return self._solve_vehicles(progress), False
        motion, recalled = recalled_or(lambda: self._solve_vehicles(progress), self)
        if recalled:
            progress(FROM_CACHE, 1.0)
        return motion, recalled

    def _solve_vehicles(self, progress: Progress) -> tuple[dict[str, Clip], dict[str, Any]]:
        clips: dict[str, Clip] = {}
        reports: dict[str, Any] = {}
        avoided = self._avoided
        meeting = self._meeting()
        together: dict[str, tuple[Clip, dict[str, Any]]] = {}
        # who is kept clear of moves first, the others about it
        for i, table in enumerate(sorted(self.file.vehicle, key=lambda vehicle: vehicle.name not in avoided)):
            world = obstacles.with_vehicles(self.world, clips, avoided, table.name)

            def report(what: str, done: float, name: str = table.name, before: int = i) -> None:
                progress(f"{name}: {what}", (before + done) / len(self.file.vehicle))

            if table.name in meeting:
                together = together or self._meet(meeting, world, progress)
                clips[table.name], said = together[table.name]
                said |= {"together": [*together]}
                reports[table.name] = {"asset": table.asset, "method": table.motion.method, **said}
                continue
            setting = replace(self._setting, world=world)
            clips[table.name], said = table.motion.solve(self.vehicle(table), setting, report)
            reports[table.name] = {"asset": table.asset, "method": table.motion.method, **said}
        order = [table.name for table in self.file.vehicle]
        return {name: clips[name] for name in order}, {name: reports[name] for name in order}

    @property
    def _avoided(self) -> set[str]:
        """The vehicles that the others keep clear of."""
        return {table.vehicle for table in self.file.world.obstacle if table.shape == "vehicle"}

    def _meeting(self) -> dict[str, tuple[SimulateMotion, Vehicle]]:
        """The simulated vehicles that may touch each other, with their motions; none unless there are two."""
        from vehsim.shot.motions import SimulateMotion

        motions = {table.name: (table.motion, self.vehicle(table)) for table in self.file.vehicle}
        simulated = {
            name: (motion, vehicle)
            for name, (motion, vehicle) in motions.items()
            if isinstance(motion, SimulateMotion) and vehicle.group.dim == 6 and vehicle.rig is not None
        }
        return {} if self.world.contact is None or len(simulated) < 2 else simulated

    def _meet(
        self, simulated: Mapping[str, tuple[SimulateMotion, Vehicle]], world: World, progress: Progress
    ) -> dict[str, tuple[Clip, dict[str, Any]]]:
        """Their clips, advanced together among what stands and moves in ``world``, and what the report says of each."""
        from vehsim.simulation import simulate_together

        movers, durations = {}, []
        for name, (motion, vehicle) in simulated.items():
            movers[name], duration = motion.mover(vehicle, self._setting)
            durations.append(duration)
        step, first = min(motion.step for motion, _ in simulated.values()), self._setting.first
        meeting = ", ".join(simulated)
        clips = simulate_together(
            movers, world, max(durations), step, self.fps, first,
            progress=lambda what, done: progress(f"{meeting}: {what}", done / len(self.file.vehicle)),
        )  # fmt: skip
        pilots = {name: mover.controls for name, mover in movers.items() if hasattr(mover.controls, "targets")}
        said = {name: {"targets": pilot.targets(clips[name].duration)} for name, pilot in pilots.items()}
        return {name: (clip, said.get(name, {})) for name, clip in clips.items()}

    def _warn_off_ground(self, clips: Mapping[str, Clip]) -> None:
        """What drives without wheels keeps its height: say where the ground rises or falls below it."""
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
                    "drive channels travel_* or roll_* in its vehicle.toml, or drive where it is level",
                    stacklevel=3,
                )

    def _frames(self, clips: Mapping[str, Clip]) -> tuple[int, int]:
        """First and last frame of the take; warn when one of its vehicles is cut off while it moves."""
        first = self.file.shot.first
        last = self.file.shot.last
        last = max(clip.end_frame for clip in clips.values()) if last is None else last
        for name, clip in clips.items():
            for index, short in ((0, clip.start_frame - first), (-1, last - clip.end_frame)):
                if short > self.file.shot.handles and not rests(clip, index):
                    warnings.warn(
                        f"{name}: its motion covers frames {clip.start_frame} to {clip.end_frame} of {first} to {last} "
                        "and is cut off while it moves: it stands still in the others; move its marks or its duration",
                        stacklevel=3,
                    )
        return first, last

    def cameras(self, clips: Mapping[str, Clip], frames: tuple[int, int]) -> tuple[Camera, ...]:
        """The cameras on whole ``frames`` (first, last) of solved ``clips``."""
        from vehsim.cameras import CUT, CameraRig, cut, solve_camera

        width, height = self.render.panel(len(self.render.cameras or self.file.camera))
        rigs: list[CameraRig] = [CameraRig(**camera.model_dump(exclude_unset=True)) for camera in self.file.camera]
        cameras = [solve_camera(rig, clips, self.world, frames, width / height) for rig in rigs]
        if self.file.cut:
            cuts = [(float(piece.frame), piece.camera) for piece in self.file.cut]
            cameras.append(cut(CUT, {camera.name: camera for camera in cameras}, cuts))
        return tuple(cameras)


def _place(problem: Problem, source: str, lines: Mapping[str, int]) -> Problem:
    """The problem with the file and line it stands on."""
    line = problem.line or line_of(problem.key, lines)
    return replace(problem, file=problem.file or source, line=line)
