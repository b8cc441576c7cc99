"""Measure the finished clips of a shot against everything that was requested of them."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from vehsim.errors import SolveError

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.requests import Ask
    from vehsim.world.world import World

NAMED = 3
"""Number of missed asks that an error names."""
DEPTH = 0.05
"""Depth of a vehicle without a clearance in rock or an obstacle above which there is a warning, m."""
GROUND = 0.005
"""Largest distance from the ground of a wheel that rolls on it, m."""


def audit_clips(
    clips: Mapping[str, Clip],
    asks: Mapping[str, Sequence[Mapping[str, Any]]],
    worlds: Mapping[str, World],
    frames: tuple[int, int],
) -> dict[str, list[dict[str, Any]]]:
    """A row for every ask of every vehicle: the ask, and the ``value`` measured at its worst ``frame``.

    ``asks``: `Ask.as_dict` by vehicle; ``worlds``: the surroundings of each vehicle, including the others; ``frames``:
    first and last of the shot. Warns of contact; raises ``SolveError`` naming other missed asks.
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
        for begin, end in _unasked(mine, first, last):
            mine += _untouched(clip, worlds[name], begin, end)
        rows = audit(track_of_clip(clip), mine, WorldScene(worlds[name], clip.vehicle))
        found[name] = [ask.as_dict() | row.as_dict() for ask, row in zip(mine, rows, strict=True)]
        wrong += [f"{name}: {row}" for row in missed(rows)]
        for row in rows:
            if row.met is False and row.key == "contact":  # simulation has already reported what pilots missed
                warnings.warn(f"{name}: {row}", stacklevel=3)
    if wrong:
        more = f" and {len(wrong) - NAMED} more" * (len(wrong) > NAMED)
        raise SolveError(f"the finished motion misses what was requested: {'; '.join(wrong[:NAMED])}{more}")
    return found


def _unasked(asks: Sequence[Ask], first: float, last: float) -> list[tuple[float, float]]:
    """The frames of which no clearance is requested: all, or those before and after it, such as handles."""
    asked = [(ask.first, ask.last) for ask in asks if ask.measure == "clearance"]
    if not asked:
        return [(first, last)]
    begin, end = min(a for a, _ in asked), max(b for _, b in asked)
    return [span for span in ((first, begin), (end, last)) if span[0] < span[1]]


def _wheels(clip: Clip, world: World, first: float, last: float) -> list[Ask]:
    """The ask that wheels touch their terrain.

    It is a warning where nothing could make them touch: an asset's own animation may lift wheels, and uneven ground
    does if more of them are fixed to a rigid body than determine its pose.
    """
    from vehsim.requests import Ask
    from vehsim.rig.parts import is_animated
    from vehsim.world.ground.wheels import wheels_of

    rig = clip.vehicle.rig
    if rig is None or world.terrain is None or "heave" not in clip.channels:
        return []
    wheels = wheels_of(rig)
    fixed = Counter(wheel.carrier for wheel in wheels if wheel.travel is None)
    rigid = any(count > (2 if carrier else 3) for carrier, count in fixed.items())  # a trailer also hangs on its hitch
    severity: Literal["error", "warning"] = "warning" if rigid or is_animated(rig.asset, rig.root or None) else "error"
    wanted = {"prims": [wheel.prim for wheel in wheels]}
    remedy = "give its wheels travel_* channels, with which they follow uneven ground" if rigid else ""
    return [Ask("wheels", "wheels", first, last, wanted, -GROUND, GROUND, "m", severity, remedy)]


def _untouched(clip: Clip, world: World, first: float, last: float) -> list[Ask]:
    """The ask, with a warning, that nothing passes through rock or an obstacle between two frames."""
    from vehsim.audit.scene import can_hit
    from vehsim.requests import Ask

    if not can_hit(clip.vehicle, world):
        return []
    wanted = {"clearance": 0.0, "obstacles_only": clip.vehicle.group.planar, "landings": [], "slope": 0.0}
    return [Ask("contact", "clearance", first, last, wanted, lower=-DEPTH, unit="m", severity="warning")]
