"""Measure the finished clips of a shot against everything that was requested of them."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from vehsim.errors import SolveError

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.requests import Ask
    from vehsim.rig.rig import Rig
    from vehsim.vehicles import Vehicle
    from vehsim.world.world import World

NAMED = 3
"""Number of missed asks that an error names."""
DEPTH = 0.05
"""Depth of a vehicle without a clearance in rock or an obstacle above which there is a warning, m."""
GROUND = 0.005
"""Largest distance from the ground of a wheel that rolls on it, m."""
HELD, TURN, SHARE = 0.1, 2 * math.pi, 0.05
"""How far wheels may turn against their way in a hold, and in a motion; the latter also propellers and rotors against
their laws in a hold, rad; and the share of the way by which each may do so in addition. In plans, wheels keep within
0.002 rad."""


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
        mine += _turning(clip, mine, first, last)
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


def _turning(clip: Clip, asks: Sequence[Ask], first: float, last: float) -> Iterator[Ask]:
    """The asks that wheels turn as far as they come, those that may slip in holds only, and that in holds propellers
    and rotors turn as their laws say.

    It is a warning where the asset's wheels are not those of the model.
    """
    from vehsim.audit.scene import rolling_wheels
    from vehsim.requests import Ask

    vehicle = clip.vehicle
    if (rig := vehicle.rig) is None:
        return
    holds = [(ask.first, ask.last) for ask in asks if ask.measure == "drift"]
    wheels = rolling_wheels(rig) if vehicle.rolls else []
    if wheels:
        fits = all(_fits(vehicle, rig, wheel) for wheel in wheels)
        severity: Literal["error", "warning"] = "error" if fits else "warning"
        remedy = "" if fits else "compare its wheel_radius, half_track and wheelbase with its asset"
        wanted = {"wheels": wheels, "share": SHARE}
        if vehicle.rolling is None:
            yield Ask("rolling", "rolling", first, last, wanted, None, TURN, "rad", severity, remedy)
        for span in holds:
            yield Ask("rolling (hold)", "rolling", *span, wanted, None, HELD, "rad", severity, remedy)
    rolling = {wheel["channel"] for wheel in wheels}
    for name, channel in vehicle.channels.items():
        if channel.rate is not None and name in rig.drives and name not in rolling:
            for span in holds:
                wanted = {"channel": name, "share": SHARE}
                yield Ask(f"spinning.{name} (hold)", "spinning", *span, wanted, None, TURN, "rad")


def _fits(vehicle: Vehicle, rig: Rig, wheel: Mapping[str, Any]) -> bool:
    """Whether a wheel of the asset rolls as that of the model does, straight ahead and turning on the spot."""
    import casadi as ca
    import numpy as np

    if vehicle.rolling is not None:
        return True
    law, at = vehicle.channels[wheel["channel"]], np.zeros(len(vehicle.joints))
    r, u, xi = (ca.SX.sym(name, size) for name, size in (("r", len(at)), ("u", len(at)), ("xi", 3)))
    given = 0.0, r, u, xi, ca.DM.zeros(len(vehicle.controls))
    if law.value is not None:
        turning = ca.jtimes(ca.SX(law.value(*given)), r, u)
    else:
        assert law.rate is not None
        turning = law.rate(*given)
    rate = ca.Function("rate", [r, u, xi], [turning])
    # free motions: twists (3, .) of the body at unit speeds along the basis and unit rates of the joints
    free, tied = (np.array(ca.Function("free", [r], [part(r)])(at))[:3] for part in (vehicle.basis, vehicle.connection))
    motions = np.hstack([free, -tied])
    for twist in np.eye(3)[:2]:
        speeds, *_ = np.linalg.lstsq(motions, twist, rcond=None)
        rolled = wheel["radius"] * wheel["gain"] * float(rate(at, speeds[free.shape[1] :], twist))
        way = twist[1] - (wheel["centre"][1] - rig.origin[1]) * twist[0]
        if np.allclose(motions @ speeds, twist) and abs(rolled - way) > SHARE * abs(way) + 1e-6:
            return False
    return True


def _untouched(clip: Clip, world: World, first: float, last: float) -> list[Ask]:
    """The ask, with a warning, that nothing passes through rock or an obstacle between two frames."""
    from vehsim.audit.scene import can_hit
    from vehsim.requests import Ask

    if not can_hit(clip.vehicle, world):
        return []
    wanted = {"clearance": 0.0, "obstacles_only": clip.vehicle.group.planar, "landings": [], "slope": 0.0}
    return [Ask("contact", "clearance", first, last, wanted, lower=-DEPTH, unit="m", severity="warning")]
