"""One shot that is edited: it solves the shot, drafts motion while a mark is dragged, and says what the page shows.

Everything here runs in one thread, the server's worker, and returns blocks for the page (`exporters/web/scene.py`).
"""

from __future__ import annotations

import tempfile
import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import InputError, Problem, VehsimError
from vehsim.exporters.usd.sampling import clip_at
from vehsim.exporters.web.scene import Kinematics, draft_block, live_block, motion_block, movable, scene_block
from vehsim.live.document import DECIMALS, Document
from vehsim.live.messages import AddMark, Change, DeleteMark, Drive, Moved
from vehsim.live.settings import Setting, settings
from vehsim.runtime.progress import Progress
from vehsim.shot.checks import variants_of

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.delivery.take import Take
    from vehsim.live.drive import Sticks
    from vehsim.planning.drafts import Draft
    from vehsim.shot.shot import Shot

VISIBLE = 0.05
"""Distance between a dragged and the solved motion that is reported, m."""


class Superseded(Exception):
    """A newer request made this solve pointless."""


@dataclass(frozen=True)
class Handle:
    """A mark that can be dragged: the ``index`` in its motion's list."""

    vehicle: str
    index: int
    drafts: bool
    """Whether motion follows while it is dragged; otherwise it is solved on release."""


class Session:
    """The state behind the page. ``tell(what, done)`` reports progress; ``out``: where exports go."""

    def __init__(self, path: Path, out: Path, tell: Progress) -> None:
        self.document = Document(path)
        self.out = out
        self.superseded = threading.Event()
        """Set it to stop the present solve at its next iteration."""
        self.shot: Shot | None = None
        self.take: Take | None = None
        self.problems: list[dict[str, Any]] = []
        """Errors and warnings for the page: ``text``, and a ``key`` and the ``fix`` that would do if there is one."""
        self.settings: list[Setting] = []
        self.sticks: Sticks | None = None
        """Those of the vehicle that is driven now."""
        self._solved = ""
        self._tell = tell
        self._drafts: dict[str, Draft] = {}
        self._kinematics: Kinematics | None = None
        self._stage = tempfile.TemporaryDirectory(prefix="vehsim-live-")

    def close(self) -> None:
        self._stage.cleanup()

    # ------------------------------------------------------------ what the page knows

    @property
    def state(self) -> dict[str, Any]:
        """Everything about the session that is not drawn."""
        document = self.document
        return {
            "kind": "state",
            "file": document.path.name,
            "changed": document.changed,
            "undo": document.undoable,
            "redo": document.redoable,
            "solved": self.solved,
            "problems": self.problems,
            "handles": [vars(handle) for handle in self.handles()],
            "drives": self.drives(),
            "settings": [vars(setting) for setting in self.settings],
        }

    @property
    def solved(self) -> bool:
        """Whether the motion that is shown is that of the present text."""
        return self.take is not None and self._solved == self.document.text

    def handles(self) -> list[Handle]:
        """The marks with a position, in the order in which the page lists them."""
        from vehsim.shot.motions.plan import PlanMotion

        found = []
        for table in self.shot.file.vehicle if self.shot else ():
            for k, mark in enumerate(getattr(table.motion, "mark", None) or ()):
                if getattr(mark, "position", None) is not None:
                    found.append(Handle(table.name, k, isinstance(table.motion, PlanMotion)))
        return found

    # ------------------------------------------------------------ solve

    def solve(self) -> bytes | None:
        """Solve the present text as an export would, and return what the page should show; None if that failed, with
        the reasons in ``problems``. Raises `Superseded`."""
        from vehsim.shot.shot import Shot

        self.superseded.clear()
        text = self.document.text
        self.settings = settings(self.document.data)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                shot = Shot.from_dict(
                    self.document.data, folder=self.document.path.parent, source=str(self.document.path)
                )
                self._reuse_world(shot)
                self.shot = shot
                self.settings = settings(
                    self.document.data, [variants_of(shot.vehicle(v).rig) for v in shot.file.vehicle]
                )
                take = shot.solve(self._progress)
            except VehsimError as error:
                self.problems = [_shown(problem) for problem in error.problems]
                return None
        texts = dict.fromkeys(str(one.message) for one in caught if issubclass(one.category, UserWarning))
        self.problems = [{"text": text} for text in texts]
        shown, self.take, self._solved = self.take, take, text
        if shown is not None and self._kinematics is not None and self._kinematics.can_show(take):
            return motion_block(take, self._kinematics)
        return self.scene()

    def scene(self) -> bytes:
        """The whole scene of the solved motion, read from a stage that is exported for it."""
        from vehsim.exporters.usd.stage import StageReader

        assert self.take is not None
        self._progress("drawing", 0.0)
        folder = self.take.export(self._stage.name, to=("usd",))
        stage = StageReader(folder / f"{self.take.name}.usda", local=False, moving=movable(self.take))
        self._kinematics = Kinematics(self.take, stage)
        return scene_block(self.take, stage)

    def export(self) -> Path:
        """Export the solved motion as ``vehsim export`` does; returns its folder. Raises ``InputError``."""
        if not self.solved or self.take is None:
            raise InputError("not solved", "fix what the page says, then export")
        return self.take.export(self.out, to=("usd", "html"))

    # ------------------------------------------------------------ drag

    def prepare(self) -> None:
        """Make the drafts of all planned vehicles, so that the first drag does not wait."""
        for handle in self.handles():
            if handle.drafts and handle.vehicle not in self._drafts:
                self._draft(handle.vehicle)

    def drag(self, moved: Moved) -> bytes:
        """The draft with a mark at another place. Raises ``VehsimError`` with the reason if there is none."""
        from vehsim.shot.motions.plan import as_mark

        table = self._table(moved)
        if not hasattr(table.motion, "options"):
            raise InputError("solved on release", key=moved.vehicle)
        assert self.take is not None and self._kinematics is not None
        vehicle = self.shot.vehicle(table)  # type: ignore[union-attr]
        marks = [as_mark(mark, vehicle) for mark in self._with(table.motion.mark, moved)]
        now = self._draft(moved.vehicle).moved(marks)
        if not now.success:
            raise InputError(now.reason)
        self._drafts[moved.vehicle] = now
        clips = {**self.take.clips, moved.vehicle: now.clip()}
        return draft_block(replace(self.take, clips=clips), self._kinematics, moved.vehicle)

    def place(self, moved: Moved) -> bytes | None:
        """Write a mark's new place into the document and `solve`."""
        table = self._table(moved)
        drawn = self._drafts.get(moved.vehicle)
        assert self.shot is not None
        vehicle = self.shot.file.vehicle.index(table)
        self.document.place_mark(vehicle, moved.mark, moved.position, moved.heading, moved.frame)
        shown = self.solve()
        if shown is not None and drawn is not None and self.take is not None and moved.frame is None:
            away = _apart(drawn.clip(), self.take.clips[moved.vehicle])
            if away > VISIBLE:
                text = f"{moved.vehicle}: the solved motion is up to {away:.2g} m from the dragged one"
                self.problems.append({"text": text})
        return shown

    # ------------------------------------------------------------ change

    def change(self, change: Change) -> bytes | None:
        """Set a value of the file and `solve`: one of the ``settings``, or the fix of a problem."""
        setting = next((one for one in self.settings if one.key == change.key), None)
        fixed = any(one.get("key") == change.key and one.get("fix") == change.value for one in self.problems)
        if setting is None and not fixed:
            raise InputError("cannot be changed here", "change it in the file", key=change.key)
        if isinstance(change.value, str) and not (setting and change.value in setting.choices):
            raise InputError("no such choice", key=change.key, value=change.value)
        value = change.value
        if setting and setting.kind == "integer" and isinstance(value, float) and value.is_integer():
            value = int(value)
        self.document.put(change.key, value)
        return self.solve()

    def add_mark(self, wanted: AddMark) -> bytes | None:
        """Add a mark where a planned vehicle is at a frame, and `solve`."""
        at, table = self._planned(wanted.vehicle)
        assert self.take is not None and self.shot is not None
        frames = [mark.frame for mark in table.motion.mark]
        whole = [frame for frame in frames if isinstance(frame, int)]
        if wanted.frame in whole or not whole[0] < wanted.frame:
            raise InputError("needs a frame of its own after the first mark", key="frame", value=wanted.frame)
        clip = self.take.clips[wanted.vehicle]
        place = clip_at(clip, np.array([float(wanted.frame)])).positions[0]
        if clip.vehicle.group.planar and self.shot.world.terrain is not None:
            place[2] = self.shot.world.height(place[None, :2])[0]
        index = next(
            (k for k, frame in enumerate(frames) if isinstance(frame, int) and frame > wanted.frame), len(frames)
        )
        values = {"frame": wanted.frame, "position": [round(x, DECIMALS) for x in place.tolist()]}
        self.document.add_mark(at, index, values)
        return self._again(wanted.vehicle)

    def delete_mark(self, wanted: DeleteMark) -> bytes | None:
        """Delete a mark of a planned vehicle, and `solve`."""
        at, table = self._planned(wanted.vehicle)
        if wanted.mark >= len(table.motion.mark):
            raise InputError("no such mark", "reload the page", key=f"{wanted.vehicle}.mark[{wanted.mark}]")
        self.document.delete_mark(at, wanted.mark)
        return self._again(wanted.vehicle)

    def _planned(self, name: str) -> tuple[int, Any]:
        """The index and the table of a vehicle with marks of its own. Raises ``InputError``."""
        for k, table in enumerate(self.shot.file.vehicle if self.shot and self.take else ()):
            if table.name == name and getattr(table.motion, "mark", None):
                return k, table
        raise InputError("has no marks", "choose a planned vehicle", key=name)

    def _again(self, name: str) -> bytes | None:
        """`solve` for other marks: drafts of the old ones are of no use."""
        self._drafts.pop(name, None)
        return self.solve()

    # ------------------------------------------------------------ drive

    def drives(self) -> list[dict[str, Any]]:
        """The vehicles with controls, what their sticks move, and whether their motion is a recording."""
        found = []
        for table in self.shot.file.vehicle if self.shot and self._kinematics else ():
            if controls := self.shot.vehicle(table).control_names:  # type: ignore[union-attr]
                continues = table.motion.method == "sticks"
                found.append({"vehicle": table.name, "controls": controls, "continues": continues})
        return found

    def drive(self, wanted: Drive, show: Callable[[bytes], object], ended: Callable[[], bool]) -> bytes | None:
        """Simulate a vehicle under ``sticks`` until ``ended``, write the recording, and `solve` the shot with it.

        ``show`` receives a block for each picture, in this thread. The recording is a table of controls and a clip
        beside the shot. Raises ``VehsimError`` if there is none.
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
        try:
            made = record(
                self.shot, name, self.take.clips, lambda clip, behind: show(live_block(clip, kinematics, name, behind)),
                ended, self.sticks, wanted.frame,
            )  # fmt: skip
        finally:
            self.sticks = None
        path = self._unused(f"{self.document.path.stem}.{name}")
        write_sticks(path, vehicle, made.frames, made.controls)
        self.document.put(f"vehicle[{at}].motion", {**made.motion, "file": path.name})
        shown = self.solve()
        if self.solved:
            self.take.clips[name].save(path)
        if made.problem is not None:
            self.problems.append({"text": f"the simulation ended: {made.problem}"})
        return shown

    def _unused(self, stem: str) -> Path:
        """The next table of a recording beside the shot."""
        names = (self.document.path.with_name(f"{stem}.{k:03d}.csv") for k in count(1))
        return next(path for path in names if not path.exists() and not path.with_suffix(".npz").exists())

    # ------------------------------------------------------------ helpers

    def _progress(self, what: str, done: float) -> None:
        if self.superseded.is_set():
            raise Superseded
        self._tell(what, done)

    def _reuse_world(self, shot: Shot) -> None:
        """Keep the world, whose terrain and distances take seconds to load, if its table is the same."""
        if self.shot is not None and self.shot.file.world == shot.file.world and "world" in vars(self.shot):
            vars(shot)["world"] = self.shot.world

    def _table(self, moved: Moved) -> Any:
        """The table of a message's vehicle. Raises ``InputError`` if it has no such mark."""
        handles = [(handle.vehicle, handle.index) for handle in self.handles()]
        if self.shot is None or (moved.vehicle, moved.mark) not in handles:
            raise InputError("no such mark", "reload the page", key=f"{moved.vehicle}.mark[{moved.mark}]")
        return next(table for table in self.shot.file.vehicle if table.name == moved.vehicle)

    def _with(self, marks: list[Any], moved: Moved) -> list[Any]:
        """The marks of the file with one moved."""
        change: dict[str, Any] = {"position": list(moved.position)}
        change |= {} if moved.heading is None else {"heading": moved.heading}
        change |= {} if moved.frame is None else {"frame": moved.frame}
        return [mark.model_copy(update=change) if k == moved.mark else mark for k, mark in enumerate(marks)]

    def _draft(self, name: str) -> Draft:
        """The present draft of a vehicle; made from its solved motion if there is none."""
        from vehsim.planning.drafts import draft
        from vehsim.shot.motions.plan import as_mark

        if name not in self._drafts:
            assert self.shot is not None and self.take is not None
            table: Any = next(table for table in self.shot.file.vehicle if table.name == name)
            vehicle, world = self.shot.vehicle(table), self.shot.world_of(name, self.take.clips)
            marks = [as_mark(mark, vehicle) for mark in table.motion.mark]
            options = table.motion.options()
            self._drafts[name] = draft(vehicle, world, marks, self.take.clips[name], fps=self.shot.fps, **options)
        return self._drafts[name]


def _shown(problem: Problem) -> dict[str, Any]:
    """A problem for the page."""
    fix = {} if problem.fix is None else {"key": problem.key, "fix": problem.fix}
    return {"text": str(problem), **fix}


def _apart(a: Clip, b: Clip) -> float:
    """The largest distance between two motions at equal times, m."""
    times = np.linspace(0.0, min(a.duration, b.duration), 200)
    b = b.at(np.clip(times + (a.start_frame - b.start_frame) / float(b.fps), b.times[0], b.times[-1]))
    return float(np.linalg.norm(a.at(times).positions - b.positions, axis=1).max())
