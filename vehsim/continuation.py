"""What continues a simulated clip: the settings that must stay as they were, and what its end leaves for later steps.

`vehsim.simulation` makes and continues clips; `vehsim.clip.ending` writes what they leave.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import InputError
from vehsim.vehicles import State, Vehicle

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.world.world import World

MOVING = "world.moving"
"""The setting of a simulation that names the vehicles that moved as obstacles."""
STORED = (
    "vehsim.vehicles.definition.base:State",
    "vehsim.integrators.phase:Phase",
    "vehsim.world.water.buoyancy:Forces",
    "vehsim.world.water.running:Lift",
    "vehsim.world.contact.contact:Event",
    "vehsim.world.contact.grip:Grip",
    "vehsim.world.contact.grounding:Points",
)
"""The classes of what continues a simulation, in addition to plain data."""


def settings_of(vehicle: Vehicle, step: float, fps: Fraction, start_frame: int) -> dict[str, Any]:
    """What a simulation has in common with one that it continues: argument -> value."""
    named = {"vehicle": vehicle.name, "vehicle.parameters": dict(vehicle.parameters)}
    return {**named, "step": step, "fps": str(fps), "start_frame": start_frame}


def surroundings(world: World) -> dict[str, Any]:
    """The same of the world: part -> content. Of vehicles that move as obstacles, only the names: their own motions may
    end earlier."""
    given = {"gusts": world.gusts, "contact": world.contact}
    hashed = {"terrain": world.terrain, "water": world.water, **{f"obstacle.{one.name}": one for one in world.standing}}
    parts = {
        **{name: None if part is None else f"content {part.content_hash[:12]}" for name, part in hashed.items()},
        **{name: None if part is None else repr(part) for name, part in given.items()},
        "wind": world.wind.tolist(),
    }
    return {**{f"world.{name}": part for name, part in parts.items()}, MOVING: [one.name for one in world.moving]}


def numbers_of(state: State) -> dict[str, list[float]]:
    """The parts of a state that are given."""
    return {part: np.asarray(value, float).tolist() for part, value in vars(state).items() if value is not None}


def ended(clip: Clip, memory: Mapping[str, Any], settings: Mapping[str, Any]) -> Clip:
    """The clip, such that it can be continued."""
    from vehsim.clip.ending import encoded

    left = {"positions": _hash(clip), "settings": settings, "memory": memory}
    return replace(clip, ending=encoded(left, STORED))


def _hash(clip: Clip) -> str:
    return sha256(clip.positions.tobytes()).hexdigest()


def memory_of(after: Clip, steps: int, settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a clip that is continued for ``steps`` in all left. Raises ``InputError``."""
    ending = _left(after)
    now = _single(settings)
    for key, earlier in _unlike(_single(ending["settings"]), now).items():
        message = f"the clip to be continued has {earlier}"
        raise InputError(message, "continue it with the same", key=key, value=now.get(key))
    if len(after) > steps + 1:
        message = f"has {len(after) - 1} steps, more than the {steps} of the whole duration"
        raise InputError(message, "give a longer duration, which counts from the start", key="after")
    memory: Mapping[str, Any] = ending["memory"]
    return memory


def _single(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with those in a mapping under keys of their own, such as ``start.position``."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        found |= {f"{key}.{part}": one for part, one in value.items()} if isinstance(value, Mapping) else {key: value}
    return found


def changed_surroundings(after: Clip, world: World) -> dict[str, tuple[Any, Any]]:
    """What differs in ``world`` from that of a simulated clip: key -> content there and here. Of vehicles that move as
    obstacles, it says nothing. Raises ``InputError`` for a clip that cannot be continued."""
    now = {key: part for key, part in surroundings(world).items() if key != MOVING}
    before = {key: part for key, part in _left(after)["settings"].items() if key.startswith("world.") and key != MOVING}
    return {key: (earlier, now.get(key)) for key, earlier in _unlike(before, now).items()}


def _left(after: Clip) -> dict[str, Any]:
    """What a simulated clip left. Raises ``InputError``."""
    from vehsim.clip.ending import decoded

    ending: dict[str, Any] = {} if after.ending is None else decoded(after.ending, STORED)
    if ending.get("positions") != _hash(after):
        remedy = "take a clip as `simulate` made it, not edited"
        raise InputError("cannot be continued", remedy, key="after", subject=after.vehicle.name)
    return ending


def _unlike(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """The earlier values of what differs."""
    return {key: earlier.get(key) for key in {**now, **earlier} if now.get(key) != earlier.get(key)}
