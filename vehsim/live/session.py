"""One shot that is edited: it solves the shot, drafts motion while a mark is dragged, and says what the page shows.

Everything here runs in one thread, the server's worker, and returns blocks for the page (`exporters/web/scene.py`).
"""

from __future__ import annotations

import copy
import glob
import math
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.clip.clip import Clip
from vehsim.errors import InputError, Problem, VehsimError
from vehsim.exporters.usd.sampling import clip_at
from vehsim.exporters.web.scene import (
    DrawnWater,
    Kinematics,
    compared_block,
    draft_block,
    draw_water,
    live_block,
    marks_shown,
    motion_block,
    movable,
    scene_block,
)
from vehsim.live.document import Document, write
from vehsim.live.messages import (
    AddMark,
    AddNote,
    Change,
    Compare,
    DeleteMark,
    DeleteNote,
    EditNote,
    Fix,
    Indexed,
    KeepDragged,
    Moved,
    MoveSticks,
    Place,
    Restore,
    Step,
    TakeControls,
    UseRecording,
)
from vehsim.live.settings import DECIMALS, Handle, Setting, handles, named, settings
from vehsim.runtime.progress import Progress, Watching
from vehsim.shot.checks import variants_of
from vehsim.vehicles.definition.character import CHARACTERS, STUNT

if TYPE_CHECKING:
    from vehsim.delivery.take import Take
    from vehsim.live.drive import Sticks
    from vehsim.planning.drafts import Draft
    from vehsim.planning.problem.solver import Patience
    from vehsim.shot.schema.shot_file import VehicleTable
    from vehsim.shot.shot import Shot

VISIBLE = 0.05
"""Distance between a dragged and the solved motion that is reported, m."""
WAIT = 1.0
"""Time after which a shot that has not been solved is drawn nevertheless, s."""
EXPORTED = ("usd", "html")
"""What the page's button exports."""
SHARE = 0.1
"""Largest share of the time of a solve in which its iterates are drawn."""


class Superseded(Exception):
    """A newer request made this solve pointless."""


@dataclass(frozen=True)
class Drawn:
    """A draft that was shown, and the motion and request for which it holds."""

    draft: Draft
    take: Take
    """That from which the drag started."""
    request: tuple[Any, ...]
    """Everything but the values of its marks."""


class Session:
    """The state behind the page. ``tell(what, done)`` reports progress; ``show`` receives what is drawn during a solve;
    ``out``: where exports go."""

    def __init__(
        self, path: Path, out: Path, tell: Progress, show: Callable[[bytes], object] = lambda block: None
    ) -> None:
        self.document = Document(path)
        self.out = out
        self.superseded = threading.Event()
        """Set it to stop the present solve at its next iteration; clear it before the next one."""
        self.interrupted = False
        """Whether the last solve was stopped by it."""
        self._ending = threading.Event()
        self.shot: Shot | None = None
        self.take: Take | None = None
        self.problems: list[dict[str, Any]] = []
        """Errors and warnings for the page: ``text``; ``fixes``: keys and values that would work together; ``offer``:
        how the page says them; ``keeps``: the vehicle whose dragged motion can be kept; ``restores``: that whose
        earlier motion can."""
        self.settings: list[Setting] = []
        self.notes: list[dict[str, Any]] = []
        """Those of the last valid text: ``frame``, ``text``, ``position`` or None."""
        self.handles: list[Handle] = []
        """The places of the present text that can be dragged; none if it is no valid shot file."""
        self.sticks: Sticks | None = None
        """Those of the vehicle that is driven now."""
        self._replaced: dict[str, dict[str, Any]] = {}
        """The tables of the motion that vehicles had before they were driven."""
        self.compared: list[str] = []
        """The recordings that are drawn beside the present motion, by name of their tables."""
        self._solved = ""
        self._tell, self._show = tell, show
        self._drawing = 0.0
        """Time at which the next iterate is drawn, on the clock of `time.monotonic`, s."""
        self._on_screen: Take | None = None
        """The take whose scene or motion the page shows; one of straight guesses if no solve has succeeded."""
        self._water: DrawnWater | None = None
        """The moving water that was drawn last."""
        self.waits_for_water = False
        """Whether the page shows the water of the first frame, or of another motion."""
        self._drafts: dict[str, Drawn] = {}
        self._solved_handles: list[Handle] = []
        self._drawn_handles: dict[str, Handle] = {}
        """Where the scene shows them."""
        self._dragged: Moved | None = None
        """The last drag that was drawn."""
        self._lagging: Shot | None = None
        """The shot with the handle where it was dragged last, if its motion is not solved to its end."""
        self._kept: tuple[str, dict[str, Clip]] = "", {}
        """A text, and the motion of vehicles that was drawn before it was solved."""
        self._characters: dict[str, str] = {}
        """The characters of that motion."""
        self._uncompared: list[str] = []
        """The vehicles whose motion was solved after a drag, but not compared with the dragged one."""
        self._guesses: list[Path] = []
        """The dragged motions that were saved."""
        self._kinematics: Kinematics | None = None
        self._scenes = tempfile.TemporaryDirectory(prefix="vehsim-live-")

    def end(self) -> None:
        """Stop what is done, also in another thread: the session ends."""
        self._ending.set()
        self.superseded.set()

    def close(self) -> None:
        """Remove what is no longer needed: guesses that were undone and in no saved text, and the scene."""
        self._scenes.cleanup()
        for path in self._guesses:
            if not self.document.names(path.name):
                path.unlink(missing_ok=True)

    # ------------------------------------------------------------ what the page knows

    @property
    def state(self) -> dict[str, Any]:
        """Everything about the session that is not drawn."""
        document = self.document
        return {
            "kind": "state",
            "file": document.path.name,
            "changed": document.changed,
            "tables": document.tables,
            "undo": document.undoable,
            "redo": document.redoable,
            "solved": self.solved,
            "problems": [*self.problems, *self._driven_instead(), *self._not_kept()],
            "handles": [self._handle_shown(handle) for handle in self.handles],
            "unplaced": self._unplaced(),
            "blocked": self._blocked(),
            "notes": self.notes,
            "drives": self.drives(),
            "recordings": [shown for shown, _ in self._recordings().values()],
            "settings": [vars(setting) for setting in self.settings],
        }

    @property
    def solved(self) -> bool:
        """Whether the motion that is shown is that of the present text."""
        return self.take is not None and self._solved == self.document.text

    def _handle_shown(self, handle: Handle) -> dict[str, Any]:
        """A handle for the page. ``follows``: the vehicles whose motion follows while it is dragged; that of others is
        solved on release. ``drawn``: where the scene shows it. ``frame``: that of a mark in the file, None if it is
        chosen by the planner."""
        from vehsim.shot.world.obstacle_tables import name_of

        assert self.shot is not None
        file, k, drawn = self.shot.file, handle.obstacle, self._drawn_handles.get(handle.key, handle)
        motion: Any = None if handle.vehicle is None else file.vehicle[handle.vehicle].motion
        frame = None if handle.mark is None else motion.mark[handle.mark].frame
        return {
            "frame": frame if isinstance(frame, int) else None,
            "drawn": {"place": drawn.place, "heading": drawn.heading},
            **{name: getattr(handle, name) for name in ("key", "place", "heading", "turns", "mark", "on", "tilt")},
            "vehicle": None if handle.vehicle is None else file.vehicle[handle.vehicle].name,
            "obstacle": None if k is None else name_of(k, file.world.obstacle[k]),
            "follows": [table.name for table in self._following(handle)],
        }

    def _unplaced(self) -> list[dict[str, Any]]:
        """The marks of the present text with a frame but no place, which have no handle; ``key``: that of the frame."""
        return [
            {"vehicle": table.name, "mark": k, "frame": mark.frame, "key": f"vehicle[{at}].motion.mark[{k}].frame"}
            for at, table in enumerate(self.shot.file.vehicle if self.shot and self.handles else ())
            for k, mark in enumerate(getattr(table.motion, "mark", None) or ())
            if mark.position is None and isinstance(mark.frame, int)
        ]

    def _blocked(self) -> list[str]:
        """The vehicles whose marks come from an artist's prim; the page shows them but cannot edit them."""
        tables = self.shot.file.vehicle if self.shot else ()
        return [table.name for table in tables if getattr(table.motion, "marks", None) is not None]

    def _following(self, handle: Handle) -> list[VehicleTable]:
        """The vehicles whose motion follows while a handle is dragged: planned ones with marks of their own."""
        from vehsim.shot.motions.plan import PlanMotion

        if self.shot is None or self.take is None or (handle.vehicle is None and handle.obstacle is None):
            return []
        tables = self.shot.file.vehicle if handle.vehicle is None else [self.shot.file.vehicle[handle.vehicle]]
        return [table for table in tables if isinstance(table.motion, PlanMotion) and table.motion.mark]

    # ------------------------------------------------------------ solve

    def solve(self) -> bytes | None:
        """Solve the present text as an export would, and return what the page should show.

        If that fails, the reasons are in ``problems``, and the result is None, or the scene of straight guesses if the
        page shows none yet. Raises `Superseded`.
        """
        from vehsim.shot.shot import Shot

        text, self.interrupted, self._lagging = self.document.text, False, None
        self.settings, self.handles = settings(self.document.data), []
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                shot = Shot.from_dict(
                    self.document.data, folder=self.document.path.parent, source=str(self.document.path)
                )
                self.notes = [note.model_dump() for note in shot.file.note]
                self._reuse_world(shot)
                variants = [variants_of(shot.vehicle(table).rig) for table in shot.file.vehicle]
                self.settings = settings(self.document.data, variants)
                self.shot, self.handles = shot, handles(self.document.data)
                self._drawing = monotonic() + WAIT
                self._progress("solving", 0.0)
                take = shot.solve(Watching(self._progress, self._show_iterate))
            except Superseded:
                self.interrupted = True
                raise
            except VehsimError as error:
                self.problems = [self._described(problem) for problem in error.problems]
                return None if self.take or self.shot is None else self._preview()
        texts = dict.fromkeys(str(one.message) for one in caught if issubclass(one.category, UserWarning))
        self.problems = [{"text": text} for text in texts]
        self.take, self._solved, self._solved_handles = take, text, self.handles
        return self._shown(take)

    def scene(self) -> bytes:
        """The whole scene of what the page shows, read from a stage that is exported for it.

        Water is that of the first frame, without wakes and foam; `water` follows.
        """
        from vehsim.delivery.exporters import write_files
        from vehsim.exporters.usd.stage import StageReader

        assert self._on_screen is not None
        take = _plain(self._on_screen)
        self._draws("drawing", 0.0)
        self._scenes.cleanup()
        self._scenes = tempfile.TemporaryDirectory(prefix="vehsim-live-")  # USD remembers the layers of an open path
        folder = Path(self._scenes.name)
        write_files(take, folder, ("usd",), self._draws)
        stage = StageReader(folder / f"{take.name}.usda", moving=movable(take))
        self._kinematics = Kinematics(take, stage)
        self._drawn_handles = {handle.key: handle for handle in self._solved_handles}
        return scene_block(take, stage)

    def water(self) -> bytes:
        """How the water moves around what the page shows, which takes longer than all else. Raises `Superseded`."""
        take, kinematics = self._on_screen, self._kinematics
        assert take is not None and kinematics is not None
        self.waits_for_water = False  # also if it fails, which would fail again
        try:
            if self._water is None or not self._water.shows(take, kinematics.stage):
                draws = partial(self._progress, "drawing the water")
                self._water = draw_water(take, kinematics.stage, draws)
            return self._water.block
        except Superseded:
            self.waits_for_water = True
            raise

    def _shown(self, take: Take) -> bytes:
        """What makes the page show a take: its motion if the scene stays as it is, else the whole scene."""
        self._on_screen, kinematics = take, self._kinematics
        if kinematics is None or not kinematics.can_show(take):
            self.waits_for_water = take.world.water is not None
            return self.scene()
        if take.world.water is not None and (self._water is None or not self._water.shows(take, kinematics.stage)):
            self.waits_for_water = True
        return motion_block(take, kinematics)

    def _preview(self) -> bytes | None:
        """What shows straight guesses from mark to mark; None if there are none."""
        assert self.shot is not None
        with suppress(VehsimError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            take = self.shot.preview()
            if take is not None:
                self._solved_handles = self.handles
                return self._shown(take)
        return None

    def _show_iterate(self, name: str, motion: Callable[[], Clip]) -> None:
        """Draw the motion of a vehicle at an iteration of its solve, unless another was drawn a moment ago."""
        began = monotonic()
        if began < self._drawing:
            return
        shown, block = self._on_screen, None
        if shown is not None and self._kinematics is not None and name in shown.clips:
            # such as a car on the way through a wall of rock, or beyond the grip of its tyres
            with suppress(VehsimError), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                drawn = replace(shown, clips={**shown.clips, name: motion()})
                block = draft_block(drawn, self._kinematics, [name], "iterate" if self.take else "preview")
        if block is not None:
            self._show(block)
        self._drawing = monotonic() + (monotonic() - began) / SHARE

    def export(self) -> Path:
        """Export the solved motion as ``vehsim export`` does; returns its folder. Raises ``InputError``."""
        from vehsim.batch.inputs import fingerprint

        if not self.solved or self.take is None or self.shot is None:
            raise InputError("not solved", "fix what the page says, then export")
        report = {**self.take.report, "inputs": fingerprint(self.shot, EXPORTED)}
        return replace(self.take, report=report).export(self.out, to=EXPORTED, progress=self._draws)

    def check(self, message: object) -> None:
        """Raises ``InputError`` if tables were added or removed since the state to which the message refers."""
        if isinstance(message, Indexed) and message.tables not in (None, self.document.tables):
            raise InputError("the shot has other tables by now", "try again")

    # ------------------------------------------------------------ drag

    def prepare(self) -> None:
        """Make the drafts of all planned vehicles, so that the first drag does not wait."""
        assert self.shot is not None
        names = dict.fromkeys(table.name for handle in self.handles for table in self._following(handle))
        for name in names:
            self._follow(self.shot, name)

    def drag(self, moved: Moved) -> bytes:
        """The drafts with a handle at another place. Raises ``VehsimError`` with the reason if there is none."""
        from vehsim.shot.shot import Shot

        self.check(moved)
        handle = self._handle(moved)
        following = self._following(handle)
        if not following:
            raise InputError("solved on release", key=moved.key)
        assert self.take is not None and self._kinematics is not None
        data = copy.deepcopy(self.document.data)
        for key, value in handle.moved(moved.position, moved.heading, moved.frame, moved.tilt):
            write(data, key, value)
        shot = Shot.from_dict(data, folder=self.document.path.parent)
        self._reuse_world(shot)
        from vehsim.planning.drafts import GLANCE

        self._lagging = None
        drafts = {table.name: self._follow(shot, table.name, GLANCE) for table in following}
        if any(draft.unfinished for draft in drafts.values()):
            self._lagging = shot
        self._dragged = moved
        return self._draft_block(drafts)

    @property
    def lags(self) -> bool:
        """Whether the last drag's motion is not solved to its end: `catch_up` does that."""
        return self._lagging is not None

    def catch_up(self) -> bytes:
        """The drafts of the last drag, solved to their end. Raises ``VehsimError`` with the reason if there is none."""
        shot, self._lagging = self._lagging, None
        assert shot is not None
        behind = [name for name, drawn in self._drafts.items() if drawn.draft.unfinished]
        return self._draft_block({name: self._follow(shot, name) for name in behind})

    def _draft_block(self, drafts: Mapping[str, Draft]) -> bytes:
        """What draws drafts, by vehicle."""
        assert self.take is not None and self._kinematics is not None
        clips = {name: draft.clip() for name, draft in drafts.items()}
        return draft_block(replace(self.take, clips={**self.take.clips, **clips}), self._kinematics, list(clips))

    def place(self, moved: Place) -> bytes | None:
        """Write a handle's new place into the document and `solve`; `compare_dragged` comes after that is shown."""
        handle = self._handle(moved)
        drawn = {}
        if self._dragged is not None and self._dragged.key == moved.key:
            with suppress(VehsimError):  # a drag that ended elsewhere is drawn to its end, to be compared
                if self._dragged.model_dump(exclude={"kind"}) != moved.model_dump(exclude={"kind"}):
                    self.drag(moved)
                if self.lags:
                    self.catch_up()
                last = {table.name: self._drafts[table.name].draft for table in self._following(handle)}
                drawn = {name: draft.clip() for name, draft in last.items()}
                self._characters = {name: draft.character for name, draft in last.items()}
        self._dragged = None
        self.document.change(handle.moved(moved.position, moved.heading, moved.frame, moved.tilt))
        shown = self.solve()
        self._kept, self._uncompared = (self.document.text, drawn), list(drawn) if shown is not None else []
        return shown

    def compare_dragged(self) -> bytes | None:
        """Add to ``problems`` where the motion solved on release, which the page shows, is not the dragged one.

        If it is in a harder character, the dragged one becomes its guess, and this returns what shows the motion that
        is solved from there. Raises `Superseded`.
        """
        names, self._uncompared = self._uncompared, []
        for name in names if self.solved else ():
            self._compare(name)
        harder = {name: self._character(name) for name in names if self.solved and self._is_harder(name)}
        if not harder:
            return None
        before = {name: self._planned(name)[1].motion.guess for name in harder}
        shown = self._keep(list(harder))
        if shown is None or all(map(self._is_harder, harder)):  # the guesses do not help
            said = self.problems
            self.document.retract()
            shown, self.problems = self.solve(), said
            return shown
        for name, found in harder.items():
            text = f'{name}: the dragged motion is its guess now, because without that it would be driven as "{found}"'
            back = "removes it" if before[name] is None else f'brings "{before[name]}" back'
            self.problems.append({"text": f"{text}; undo {back}"})
        return shown

    def _character(self, name: str) -> str:
        """That of a vehicle's solved motion."""
        assert self.take is not None
        return str(self.take.report["vehicles"][name].get("character", STUNT))

    def _is_harder(self, name: str) -> bool:
        """Whether a vehicle's solved motion is in a harder character than the dragged one."""
        return CHARACTERS.index(self._character(name)) > CHARACTERS.index(self._characters[name])

    def keep_dragged(self, wanted: KeepDragged) -> bytes | None:
        """Save the dragged motion of a vehicle beside the shot as its guess, and `solve` from there."""
        text, drawn = self._kept
        if text != self.document.text or wanted.vehicle not in drawn:
            raise InputError("no longer the dragged motion", "drag again", key=wanted.vehicle)
        return self._keep([wanted.vehicle])

    def _keep(self, names: Sequence[str]) -> bytes | None:
        """Save the dragged motion of vehicles beside the shot as their guesses, and `solve` from there."""
        drawn, guesses = self._kept[1], {}
        for name in names:
            path = self._unused(f"{self.document.path.stem}.{name}.guess").with_suffix(".npz")
            drawn[name].save(path)
            self._guesses.append(path)
            guesses[f"vehicle[{self._planned(name)[0]}].motion.guess"] = path.name
        self.document.change(guesses.items())
        shown = self.solve()
        for name in names if shown is not None else ():
            self._compare(name, drawn[name])
        return shown

    def _compare(self, name: str, guess: Clip | None = None) -> None:
        """Report a solved motion that differs visibly from the dragged one, which was its ``guess`` or may become it.

        As a guess it would change nothing if the solved motion, drawn as coarsely as in a drag, is the dragged one.
        Later drags start from the solved motion.
        """
        assert self.take is not None and self.shot is not None
        dragged = guess or self._kept[1][name]
        away = _apart(dragged, self.take.clips[name])
        if away <= VISIBLE:
            return
        text, coarse, offer = f"{name}: the solved motion is up to {away:.2g} m from the dragged one", False, {}
        self._drafts.pop(name, None)
        with suppress(VehsimError):
            coarse = _apart(dragged, self._follow(self.shot, name).clip()) <= VISIBLE
        if coarse:
            text += ", because a drag is solved on a coarser grid"
        elif guess is not None:
            text += ", also with that as its guess"
        else:
            offer = {"keeps": name}
        self.problems.append({"text": text, **offer})

    # ------------------------------------------------------------ change

    def undo(self, step: Step) -> bytes | None:
        """Go back to the state of the file before the last change, and `solve`."""
        self.document.undo()
        return self.solve()

    def redo(self, step: Step) -> bytes | None:
        """Go to the state of the file before `undo`, and `solve`."""
        self.document.redo()
        return self.solve()

    def change(self, change: Change) -> bytes | None:
        """Set one of the ``settings`` and `solve`."""
        setting = next((one for one in self.settings if one.key == change.key), None)
        if setting is None:
            raise InputError("cannot be changed here", "change it in the file", key=change.key)
        if isinstance(change.value, str) and change.value not in setting.choices:
            raise InputError("no such choice", key=change.key, value=change.value)
        value = change.value
        if setting.kind == "integer" and isinstance(value, float) and value.is_integer():
            value = int(value)
        self.document.put(change.key, value)
        return self.solve()

    def fix(self, wanted: Fix) -> bytes | None:
        """Set what a problem offers as its fix, and `solve`."""
        offered = [one.get("fixes", ()) for one in self.problems]
        found = next((fixes for fixes in offered if [list(fix) for fix in fixes] == wanted.fixes), None)
        if not found:
            raise InputError("is not offered any more", "reload the page", key="fixes")
        self.document.change(found)
        return self.solve()

    def add_mark(self, wanted: AddMark) -> bytes | None:
        """Add a mark where a planned vehicle is at a frame, and `solve`."""
        at, table = self._planned(wanted.vehicle)
        assert self._on_screen is not None and self.shot is not None
        shown = {one["index"]: one["frame"] for one in marks_shown(self._on_screen) if one["vehicle"] == wanted.vehicle}
        frames = [
            mark.frame if isinstance(mark.frame, int) else shown.get(k, math.inf)
            for k, mark in enumerate(table.motion.mark)
        ]
        if wanted.frame in frames or not frames[0] < wanted.frame:
            raise InputError("needs a frame of its own after the first mark", key="frame", value=wanted.frame)
        clip = self._on_screen.clips[wanted.vehicle]
        place = clip_at(clip, np.array([float(wanted.frame)])).positions[0]
        if clip.vehicle.group.planar and self.shot.world.terrain is not None:
            place[2] = self.shot.world.height(place[None, :2])[0]
        index = next((k for k, frame in enumerate(frames) if frame > wanted.frame), len(frames))
        values = {"frame": wanted.frame, "position": [round(x, DECIMALS) for x in place.tolist()]}
        self.document.insert(f"vehicle[{at}].motion.mark", index, values)
        return self.solve()

    def delete_mark(self, wanted: DeleteMark) -> bytes | None:
        """Delete a mark of a planned vehicle, and `solve`."""
        at, table = self._planned(wanted.vehicle)
        if wanted.mark >= len(table.motion.mark):
            raise InputError("no such mark", "reload the page", key=f"{wanted.vehicle}.mark[{wanted.mark}]")
        if len(table.motion.mark) == 2:
            raise InputError("a motion needs two marks", "move this one instead", key=f"{wanted.vehicle}.mark")
        self.document.put(f"vehicle[{at}].motion.mark[{wanted.mark}]", None)
        return self.solve()

    def add_note(self, wanted: AddNote) -> bytes | None:
        """Add a note after those of earlier frames, and `solve`, which recalls the same motion."""
        index = sum(one["frame"] <= wanted.frame for one in self.notes)
        self.document.insert("note", index, {"frame": wanted.frame, "text": wanted.text})
        return self.solve()

    def edit_note(self, wanted: EditNote) -> bytes | None:
        """Change the text or the place of a note, and `solve`."""
        key, place = self._note(wanted.note), wanted.position
        found = {"text": wanted.text, "position": place and [round(x, DECIMALS) for x in place]}
        self.document.change([(f"{key}.{name}", value) for name, value in found.items() if value is not None])
        return self.solve()

    def delete_note(self, wanted: DeleteNote) -> bytes | None:
        """Delete a note, and `solve`."""
        self.document.put(self._note(wanted.note), None)
        return self.solve()

    def _note(self, index: int) -> str:
        """The key of a note. Raises ``InputError``."""
        if index >= len(self.notes):
            raise InputError("no such note", "reload the page", key=f"note[{index}]")
        return f"note[{index}]"

    def _planned(self, name: str) -> tuple[int, Any]:
        """The index and the table of a vehicle with marks of its own. Raises ``InputError``."""
        shown = self._on_screen.clips if self._on_screen else {}
        for k, table in enumerate(self.shot.file.vehicle if self.shot and name in shown else ()):
            if table.name == name and getattr(table.motion, "mark", None):
                return k, table
        raise InputError("has no marks", "choose a planned vehicle", key=name)

    # ------------------------------------------------------------ drive

    def drives(self) -> list[dict[str, Any]]:
        """The vehicles with controls, what their sticks move, and whether their motion is a recording."""
        found = []
        for table in self.shot.file.vehicle if self.shot and self.take else ():
            if controls := self.shot.vehicle(table).control_names:  # type: ignore[union-attr]  # the loop is empty without a shot
                continues = table.motion.method == "sticks"
                found.append({"vehicle": table.name, "controls": controls, "continues": continues})
        return found

    def drive(
        self,
        wanted: TakeControls,
        began: Callable[[], object],
        show: Callable[[bytes], object],
        ended: Callable[[], bool],
    ) -> bytes | None:
        """Simulate a vehicle under ``sticks`` until ``ended``, write the recording, and `solve` the shot with it.

        In this thread, ``began`` is called once the sticks can be moved, then ``show`` with a block for each picture.
        The recording is a table of controls and a clip beside the shot. Raises ``VehsimError`` if there is none.
        """
        from vehsim.live.drive import Sticks, record
        from vehsim.shot.motions.sticks import write_sticks

        offered = {one["vehicle"]: one for one in self.drives()}
        if self.take is None or wanted.vehicle not in offered:
            raise InputError("cannot be driven", "choose a vehicle with controls", key=wanted.vehicle)
        if wanted.frame is not None and not offered[wanted.vehicle]["continues"]:
            raise InputError("is no recording", "drive it from the start", key=wanted.vehicle)
        assert self.shot is not None and self._kinematics is not None
        name, kinematics = wanted.vehicle, self._kinematics
        at, vehicle = next(
            (k, self.shot.vehicle(table)) for k, table in enumerate(self.shot.file.vehicle) if table.name == name
        )
        self.sticks = Sticks(vehicle, self.shot.world.wind)
        began()
        try:
            made = record(
                self.shot, name, self.take.clips, lambda clip, behind: show(live_block(clip, kinematics, name, behind)),
                ended, self.sticks, wanted.frame,
            )  # fmt: skip
        finally:
            self.sticks = None
        path = self._unused(f"{self.document.path.stem}.{name}")
        write_sticks(path, vehicle, made.frames, made.controls)
        before = self.document.data["vehicle"][at]["motion"]
        if not offered[name]["continues"]:
            self._replaced[name] = before
        self.document.put(f"vehicle[{at}].motion", {**made.motion, "file": path.name})
        if not self._ending.is_set():
            self.superseded.clear()  # what ended the drive waits until the recording is complete
        shown = self.solve()
        if self.solved:
            self.take.clips[name].save(path)
        if offered[name]["continues"] and name not in self._replaced:  # else `state` says so
            text = f"{name}: its motion is {path.name} now; {before['file']} stays in the list of recordings"
            self.problems.append({"text": text})
        if made.problem is not None:
            self.problems.append({"text": f"the simulation ended: {made.problem}"})
        return shown

    def _driven_instead(self) -> Iterator[dict[str, Any]]:
        """What the page says of every vehicle whose motion was replaced by a recording: this must not go unnoticed."""
        for table in self.shot.file.vehicle if self.shot else ():
            if table.motion.method == "sticks" and table.name in self._replaced:
                method = self._replaced[table.name]["method"]
                text = f'{table.name}: its motion is the recording {table.motion.file} now, not that of "{method}"'
                yield {"text": text, "restores": table.name}

    def _not_kept(self) -> Iterator[dict[str, Any]]:
        """What the page says where the autosave cannot be written."""
        if self.document.changed and self.document.unkept:
            text = f"{self.document.autosave.name} cannot be written: {self.document.unkept}"
            yield {"text": f"{text}; until you save, your changes last only as long as vehsim runs"}

    def restore(self, wanted: Restore) -> bytes | None:
        """Give a vehicle the motion back that it had before it was driven, and `solve`; its recordings stay."""
        offered = [one["restores"] for one in self._driven_instead()]
        if wanted.vehicle not in offered:
            raise InputError("was not driven", "reload the page", key=wanted.vehicle)
        assert self.shot is not None
        at = next(k for k, table in enumerate(self.shot.file.vehicle) if table.name == wanted.vehicle)
        self.document.put(f"vehicle[{at}].motion", self._replaced[wanted.vehicle])
        return self.solve()

    def move_sticks(self, moved: MoveSticks) -> None:
        """Move the sticks of the present drive; those of a drive that has ended have no effect."""
        sticks = self.sticks
        if sticks is not None and len(moved.values) == len(sticks.values):
            sticks.move(moved.values)

    def use_recording(self, wanted: UseRecording) -> bytes | None:
        """Make another recording of a driven vehicle its motion, and `solve`."""
        shown, path = self._recordings().get(wanted.file, ({"usable": False}, Path()))
        if not shown["usable"]:
            raise InputError("cannot be used here", "drive the vehicle, then choose", key="file", value=wanted.file)
        assert self.shot is not None
        name = shown["vehicle"]
        at = next(k for k, table in enumerate(self.shot.file.vehicle) if table.name == name)
        self.document.put(f"vehicle[{at}].motion.file", wanted.file)
        block = self.solve()
        if block is not None and self.take is not None:
            clip = self.take.clips[name]
            away = _apart(Clip.load(path, clip.vehicle), clip)
            if away > VISIBLE:
                text = f"{name}: up to {away:.2g} m from what was recorded, because the start or the world has changed"
                self.problems.append({"text": text})
        return block

    def compare(self, wanted: Compare) -> bytes:
        """Draw other recordings beside the present motion. Raises ``InputError`` for one that is not there."""
        missing = [name for name in wanted.files if name not in self._recordings()]
        if missing or self._kinematics is None:
            raise InputError("no such recording", "reload the page", key="files", value=missing)
        self.compared = list(dict.fromkeys(wanted.files))
        return self.comparison()

    def comparison(self) -> bytes:
        """The block of the recordings that are compared, as far as their clips can be read. Raises ``InputError``."""
        assert self.take is not None and self._kinematics is not None
        found, there = {}, self._recordings()
        self.compared = [name for name in self.compared if name in there]
        for name in self.compared:
            shown, path = there[name]
            found[name] = shown["vehicle"], Clip.load(path, self.take.clips[shown["vehicle"]].vehicle)
        return compared_block(self.take, self._kinematics, found)

    def _recordings(self) -> dict[str, tuple[dict[str, Any], Path]]:
        """The recordings beside the shot by name of their table: what the page shows of each, and its clip.

        ``used``: it is the present motion; ``usable``: it can become so, because another recording is.
        """
        found: dict[str, tuple[dict[str, Any], Path]] = {}
        for table in self.shot.file.vehicle if self.shot and self.take else ():
            sticks = table.motion.method == "sticks"
            present = getattr(table.motion, "file", None) if sticks else None
            stem = f"{self.document.path.stem}.{table.name}."
            for path in sorted(self.document.path.parent.glob(f"{glob.escape(stem)}[0-9][0-9][0-9].csv")):
                if path.with_suffix(".npz").is_file():
                    shown = {
                        "name": path.name,
                        "vehicle": table.name,
                        "used": path.name == present,
                        "compared": path.name in self.compared,
                        "usable": sticks,
                    }
                    found[path.name] = shown, path.with_suffix(".npz")
        return found

    def _unused(self, stem: str) -> Path:
        """The next table of a recording beside the shot."""
        names = (self.document.path.with_name(f"{stem}.{k:03d}.csv") for k in count(1))
        return next(path for path in names if not path.exists() and not path.with_suffix(".npz").exists())

    # ------------------------------------------------------------ helpers

    def _progress(self, what: str, done: float) -> None:
        if self.superseded.is_set():
            raise Superseded
        waits = self._on_screen is None and monotonic() > self._drawing and done < 1.0  # 1: it comes from the cache
        if waits and (scene := self._preview()) is not None:
            self._show(scene)
        self._tell(what, done)

    def _draws(self, what: str, done: float) -> None:
        """Report the progress of a scene, which a newer request does not interrupt: drags need one."""
        if self._ending.is_set():
            raise Superseded
        self._tell(what, done)

    def _reuse_world(self, shot: Shot) -> None:
        """Keep the world, whose terrain and distances take seconds to load, as far as its table is the same."""
        from vehsim.shot.world.obstacle_tables import standing

        if self.shot is None or "world" not in vars(self.shot):
            return
        ours, theirs = self.shot.file.world, shot.file.world
        if ours == theirs:
            vars(shot)["world"] = self.shot.world
        elif ours == theirs.model_copy(update={"obstacle": ours.obstacle}):
            vars(shot)["world"] = self.shot.world.with_only(standing(theirs.obstacle, shot.folder))

    def _described(self, problem: Problem) -> dict[str, Any]:
        """A problem for the page, without the name of the file that it shows; ``offer``: what its fixes set."""
        if problem.line is None and problem.file == str(self.document.path):
            problem = replace(problem, file="", key=named(problem.key, self.document.data))
        if not problem.fixes:
            return {"text": str(problem)}
        (key, value), *others = problem.fixes
        more = f", and {len(others)} more" if others else ""
        offer = f"{named(key, self.document.data)} = {value}{more}"
        return {"text": str(problem), "fixes": problem.fixes, "offer": offer}

    def _handle(self, moved: Moved) -> Handle:
        """The handle of a message. Raises ``InputError``."""
        found = next((handle for handle in self.handles if handle.key == moved.key), None)
        if found is None:
            raise InputError("cannot be dragged", "reload the page", key=moved.key)
        return found

    def _follow(self, shot: Shot, name: str, patience: Patience | None = None) -> Draft:
        """The draft of a vehicle for the marks and the world of ``shot``, which becomes the present one.

        It has the character and the segments of the solved motion, because fewer segments or another character may
        lead to another one far away. It is solved from the present draft, also where obstacles moved. If
        anything else differs than the values of marks, or if that fails, a new one starts from its motion; if that
        fails too, from a new path, at last in the character of the shot. ``patience``: that of a solve from the
        present draft. Raises ``VehsimError`` with the reason if there is no such motion.
        """
        from vehsim.planning.drafts import ENDLESS, draft
        from vehsim.planning.request.marks import shape
        from vehsim.shot.motions.plan import as_mark

        assert self.take is not None
        table: Any = next(table for table in shot.file.vehicle if table.name == name)
        vehicle, world = shot.vehicle(table), shot.world_of(name, self.take.clips)
        marks = [as_mark(mark, vehicle) for mark in table.motion.mark]
        others = tuple(self.take.clips[one.name] for one in world.moving)
        empty = shot.world.with_only(()).content_hash
        rest = empty, table.asset, table.parameters, table.motion.model_copy(update={"mark": None}), shape(marks)
        solved = self.take.report["vehicles"][name]
        driven = solved.get("character", table.motion.character)
        segments = solved.get("segments", table.motion.segments)
        options = table.motion.options() | {"fps": shot.fps, "segments": segments}
        request = (shot.world, others, driven, segments, *rest)
        before = self._drafts.get(name)
        now, same = None, before is not None and before.request == request
        if before is not None and before.request[1:] == request[1:]:
            now = before.draft.moved(marks, None if same else world, patience or ENDLESS)
        if now is None or not (now.success or same):
            clip = before.draft.clip() if before is not None and before.take is self.take else self.take.clips[name]
            starts = [(driven, clip), (driven, None)]  # the second if an obstacle was dragged into the path
            if driven != table.motion.character:  # such as a stunt that few segments cannot follow
                starts.append((table.motion.character, None))
            for character, start in starts:
                now = draft(vehicle, world, marks, start, **{**options, "character": character})
                if now.success:
                    break
            assert now is not None
        if now.success or before is None:
            self._drafts[name] = Drawn(now, self.take, request)
        if not now.success:
            raise InputError(now.reason or "no motion was found", subject=name)
        return now


def _plain(take: Take) -> Take:
    """A take whose stage contains only what the page shows."""
    form = replace(
        take.usd,
        thin=None,
        curves=None,
        clip_frames=None,
        layer_only=False,
        versions=False,
        spray=False,
        moving_water=False,
    )
    return replace(take, usd=form)


def _apart(a: Clip, b: Clip) -> float:
    """The largest distance between two motions at equal times, m."""
    times = np.linspace(0.0, min(a.duration, b.duration), 200)
    b = b.at(np.clip(times + (a.start_frame - b.start_frame) / float(b.fps), b.times[0], b.times[-1]))
    return float(np.linalg.norm(a.at(times).positions - b.positions, axis=1).max())
