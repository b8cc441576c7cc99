"""``[vehicle.edit]``: root curves that an animator changed, and the nearest motion that the vehicle can make."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from vehsim.errors import InputError, Problem, SolveError
from vehsim.shot.checks import Context
from vehsim.shot.schema.tables import Table, Text
from vehsim.shot.subjects import naming

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.planning.retouch import Retouch
    from vehsim.rig.blocking import Blocking
    from vehsim.rig.edited import Moved
    from vehsim.runtime.progress import Progress
    from vehsim.vehicles import Vehicle

NAMED = 3
"""Number of misses that a warning names."""
MAX_ROUNDS = 1000
"""Largest number of a round: each vehicle may have its own."""


class EditTable(Table):
    """``[vehicle.edit]``: the delivered curves of a vehicle, changed by an animator."""

    usd: Text
    """a USD stage in which the vehicle's delivered motion was edited, relative to the shot file"""
    prim: Text
    """the path of the vehicle's prim in it, such as /shot/vehicles/heli"""
    round: Annotated[int, Field(ge=1, le=MAX_ROUNDS)] | None = None
    """when it is applied: it starts from the motion that the edits of lower rounds give, of this vehicle and others;
    default: 1 for a vehicle's first edit, 2 for its second ..."""

    def read(self, vehicle: Vehicle, context: Context) -> Blocking:
        """The edited motion of the vehicle's root. Raises ``InputError``."""
        from vehsim.rig.blocking import read_edit

        path = self.path(context.folder)
        if not path.is_file():
            raise InputError("no such file", file=self.usd)
        if vehicle.rig is None:
            raise InputError("has no asset, so it has no curves", subject=vehicle.name)
        return read_edit(path, self.prim, context.fps, vehicle.rig)

    def path(self, folder: Path) -> Path:
        """The edited stage."""
        path = Path(self.usd).expanduser()
        return path if path.is_absolute() else folder / path

    def check(self, vehicle: Vehicle, context: Context, simulated: bool) -> Iterator[Problem]:
        """Problems with keys relative to the vehicle's table. ``simulated``: its motion follows from forces."""
        if simulated and context.world.environment(vehicle) is not None:
            message = "water, gusts or contact determine its motion, so the motion cannot be chosen"
            yield Problem("edit", message, "change the controls or the pilot instead")
        from vehsim.planning.retouch import check_pushed

        try:
            check_pushed(vehicle.planar or vehicle)
            self.read(vehicle, context)
        except InputError as error:
            yield error.problem.seen_from("edit", remedy="fix the stage or this table")

    def retouch(
        self,
        name: str,
        clip: Clip,
        delivered: Clip,
        report: Mapping[str, Any],
        options: Mapping[str, Any],
        context: Context,
        progress: Progress,
        curves: tuple[float, float | None] | None = None,
        number: int = 1,
    ) -> tuple[Clip, dict[str, Any]]:
        """The retouched clip and its report, from those of the solved motion, or of the round before ``number``.

        ``delivered``: that motion on all frames of the shot, through its handles.
        Marks that the edit touches are no longer required; the others still are. ``curves``: how far the delivered
        curves may be from the motion, m and degrees, as for `curve_tolerances`.
        """
        from pxr import Usd

        from vehsim.planning.retouch import KEPT, retouch
        from vehsim.requests import Ask
        from vehsim.world.placing import placed

        model = clip.vehicle.name
        with naming(name, model):
            clip = placed(clip, context.world)
        with Usd.StageCacheContext(Usd.StageCache()):  # the stage is opened once
            edited = self.read(clip.vehicle, context)
            parts = self._parts_moved(edited, delivered, context, curves)
        asks = [dict(ask) for ask in report.get("asks", [])]
        marks = [ask for ask in asks if ask["key"].startswith("mark[")]
        with naming(name, model):
            made = retouch(
                clip,
                context.world,
                edited.frames,
                edited.positions,
                edited.rotations,
                stops=sorted({frame for ask in marks for frame in (ask["first"], ask["last"])}),
                asks=[Ask.from_dict(ask) for ask in asks],
                progress=progress,
                **{key: options[key] for key in ("clearance", "limits") if key in options},
            )
        if made.kept > KEPT:
            raise SolveError(
                f"frames that the edit does not touch move by {1000 * made.kept:.3g} mm, more than {1000 * KEPT:g} mm",
                "edit more frames around it",
                subject=name,
            )
        for ask in marks:
            if any(ask["first"] <= last and ask["last"] >= first for first, last in made.touched):
                ask["severity"] = "warning"
        of = name if number == 1 else f"{name}, round {number}"  # the warnings of earlier rounds are repeated
        _warn(of, made, _beyond(edited, clip, delivered), clip)
        _warn_of_parts(of, parts)
        if made.beyond:
            character = report.get("character", "its character")
            warnings.warn(f"{of}: retouched; beyond {character}: {'; '.join(made.beyond)}", stacklevel=2)
        details = {
            "round": number,
            "touched": made.touched,
            "solved_again": made.windows,
            "kept_within": made.kept,
            "missed": made.misses(),
            "largest_miss": float(made.metres.max(initial=0.0)),
            "beyond": made.beyond,
            "parts": [asdict(part) for part in parts],
        }
        if (earlier := report.get("edit")) is not None:
            before = [*earlier.get("earlier", []), {key: earlier[key] for key in earlier if key != "earlier"}]
            details["earlier"] = before
        return made.clip, {**report, "asks": asks, "edit": details}

    def _parts_moved(
        self, edited: Blocking, clip: Clip, context: Context, curves: tuple[float, float | None] | None
    ) -> list[Moved]:
        """Wheels, rotors and other parts that the edit poses otherwise than the solved motion ``clip``."""
        from vehsim.rig.edited import parts_moved
        from vehsim.rig.tolerances import curve_tolerances

        assert clip.vehicle.rig is not None
        frames = edited.frames[(edited.frames >= clip.start_frame) & (edited.frames <= clip.end_frame)]
        if not len(frames):
            return []
        channels = clip.at(np.minimum((frames - clip.start_frame) / float(clip.fps), clip.times[-1])).channels
        rate = float(context.fps)
        loose = None if curves is None else curve_tolerances(clip.vehicle.rig, *curves)
        return parts_moved(edited.path, edited.prim, clip.vehicle.rig, channels, frames, rate, loose)


def _warn_of_parts(name: str, parts: Sequence[Moved]) -> None:
    """Warn of parts that the edit moves although they follow from the motion."""
    if parts:
        more = f" and {len(parts) - NAMED} more" if len(parts) > NAMED else ""
        warnings.warn(
            f"{name}: the edit also moves {', '.join(map(str, parts[:NAMED]))}{more}, without effect: wheels, rotors "
            "and other parts follow from the motion of the root",
            stacklevel=2,
        )


def _beyond(edited: Blocking, clip: Clip, delivered: Clip) -> list[float]:
    """Frames outside the motion in which the edit departs from what was ``delivered``."""
    from vehsim.lie.quaternions import matrices
    from vehsim.planning.retouch import MOVED, TURNED

    frames, first, last = edited.frames, delivered.start_frame, delivered.end_frame
    outside = (frames < clip.start_frame) | (frames > clip.end_frame)
    outside &= ~np.isin(frames, (first - 1, last + 1))  # with an open shutter, delivered curves continue for a frame
    times = np.clip((frames - first) / float(delivered.fps), 0.0, delivered.times[-1])
    times, rows = np.unique(times, return_inverse=True)
    shown = delivered.at(times)
    moved = np.linalg.norm(edited.positions - shown.positions[rows], axis=1) > MOVED
    # the trace of a rotation by an angle is 1 + 2 cos(angle)
    turned = np.einsum("nij,nij->n", edited.rotations, matrices(shown.orientations)[rows]) < 1 + 2 * np.cos(TURNED)
    return [float(frame) for frame in edited.frames[(moved | turned) & outside]]


def _warn(name: str, made: Retouch, beyond: Sequence[float], clip: Clip) -> None:
    """Warn of an edit without effect, and of what it cannot reach."""
    if made.lifted:
        spans = ", ".join(f"{first} to {last}" for first, last in made.lifted[:NAMED])
        more = f" and {len(made.lifted) - NAMED} more" if len(made.lifted) > NAMED else ""
        warnings.warn(
            f"{name}: the edit changes height or tilt in frames {spans}{more}, without effect: the ground or the water "
            "sets them",
            stacklevel=2,
        )
    elif not made.touched:
        warnings.warn(f"{name}: the edit changes nothing: its curves are those of the solved motion", stacklevel=2)
    if beyond:
        ends = f"{clip.start_frame} to {clip.end_frame}"
        warnings.warn(
            f"{name}: the edit moves in frames {beyond[0]:g} to {beyond[-1]:g}, beyond the motion, which goes from "
            f"{ends}; they are ignored",
            stacklevel=2,
        )
    misses = sorted(made.misses(), key=lambda miss: -miss["metres"])
    for miss in misses[:NAMED]:
        warnings.warn(
            f"{name}: the vehicle cannot follow the edit from frame {miss['first']:.0f} to {miss['last']:.0f}: it is "
            f"missed by {miss['metres']:.2g} m at frame {miss['frame']:.0f}",
            stacklevel=2,
        )
    if len(misses) > NAMED:
        warnings.warn(f"{name}: the edit is missed in {len(misses) - NAMED} more places", stacklevel=2)
