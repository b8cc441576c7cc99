"""Measures the finished clips of a shot against everything that was asked of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from vehsim.errors import SolveError

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.requests import Ask
    from vehsim.world import World

NAMED = 3
"""How many missed asks an error names."""
DEPTH = 0.05
"""How deep a vehicle that keeps no clearance may be in rock or an obstacle before a warning says so, m."""
GROUND = 0.005
"""How far from the ground a wheel that rolls on it may be, m."""


def audit_clips(
    clips: Mapping[str, Clip],
    asks: Mapping[str, Sequence[Mapping[str, Any]]],
    worlds: Mapping[str, World],
    frames: tuple[int, int],
) -> dict[str, list[dict[str, Any]]]:
    """A row for every ask of every vehicle: the ask, and the ``value`` measured at its worst ``frame``.

    ``asks``: `Ask.as_dict` by vehicle; ``worlds``: what each vehicle moves in, the others included; ``frames``: first
    and last of the shot. Warns of contact; raises ``SolveError`` naming what else is missed.
    """
    from vehsim.audit import WorldScene, audit, missed, track_of_clip
    from vehsim.requests import Ask

    first, last = map(float, frames)
    found, wrong = {}, []
    for name, clip in clips.items():
        mine = [Ask.from_dict(ask) for ask in asks.get(name, ())]
        mine.append(Ask("shot.start_frame", "frame", first, first, lower=first, upper=first, unit="frames"))
        mine.append(Ask("shot.end_frame", "frame", last, last, lower=last, upper=last, unit="frames"))
        mine += _wheels(clip, worlds[name], first, last)
        if not any(ask.measure == "clearance" for ask in mine):
            mine += _untouched(clip, worlds[name], first, last)
        rows = audit(track_of_clip(clip), mine, WorldScene(worlds[name], clip.vehicle))
        found[name] = [ask.as_dict() | row.as_dict() for ask, row in zip(mine, rows, strict=True)]
        wrong += [f"{name}: {row}" for row in missed(rows)]
        for row in rows:
            if row.met is False and row.key == "contact":  # what pilots missed, simulation has said
                warnings.warn(f"{name}: {row}", stacklevel=3)
    if wrong:
        more = f" and {len(wrong) - NAMED} more" * (len(wrong) > NAMED)
        raise SolveError(f"the finished motion misses what was asked: {'; '.join(wrong[:NAMED])}{more}")
    return found


def _wheels(clip: Clip, world: World, first: float, last: float) -> list[Ask]:
    """That wheels touch the terrain they follow. An asset whose own animation moves it may lift them: a warning."""
    from vehsim.parts import is_animated
    from vehsim.requests import Ask
    from vehsim.world.ground import wheels_of

    rig = clip.vehicle.rig
    if rig is None or world.terrain is None or "heave" not in clip.channels:
        return []
    prims = [wheel.prim for wheel in wheels_of(rig)]
    severity: Literal["error", "warning"] = "warning" if is_animated(rig.asset, rig.root or None) else "error"
    wanted = {"prims": prims}
    return [Ask("wheels", "wheels", first, last, wanted, lower=-GROUND, upper=GROUND, unit="m", severity=severity)]


def _untouched(clip: Clip, world: World, first: float, last: float) -> list[Ask]:
    """A warning for what goes through rock or an obstacle, where no clearance was asked for."""
    from vehsim.requests import Ask

    planar = clip.vehicle.group.planar
    if clip.vehicle.rig is None or not (world.obstacles or (world.terrain is not None and not planar)):
        return []
    wanted = {"clearance": 0.0, "obstacles_only": planar, "landings": [], "slope": 0.0}
    return [Ask("contact", "clearance", first, last, wanted, lower=-DEPTH, unit="m", severity="warning")]
