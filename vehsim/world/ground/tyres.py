"""What each tyre of a vehicle does on the ground: its slip, its load, and whether it touches.

All of it is in the channels of a clip. A model whose tyres slip has these channels itself. The wheels of a rolling
model do not slip, and on a terrain its springs carry it, so their travel gives the loads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.constants import GRAVITY
from vehsim.lie.quaternions import matrices
from vehsim.rig.linkage import part_poses
from vehsim.vehicles.definition.inertia import known_inertia
from vehsim.world.ground.wheels import TRAVEL, Wheel, wheels_of

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

ROLL, STEER, RATIO, ANGLE, LOAD, SLIDING = "roll_", "steer_", "slip_ratio_", "slip_angle_", "load_", "slip_"
"""Prefixes of a wheel's channels, before its name."""
TOUCHING = 0.01
"""Share of its mean load below which a tyre counts as lifted."""


@dataclass(frozen=True, eq=False)
class Tyre:
    """A tyre over a clip (n samples): slip ``ratio`` and slip ``angle`` (rad), ``load`` N (None: not known), whether it
    is in ``contact``, and its speed over the ground, ``sliding`` m/s.

    ``name``, such as "fl"; ``prim``: the path of its wheel below the rig's root.
    """

    name: str
    prim: str
    wheel: Wheel
    ratio: Array
    angle: Array
    load: Array | None
    contact: NDArray[np.bool_]
    sliding: Array

    @property
    def slip(self) -> Array:
        """Magnitude of the slip in any direction (n,): the speed over the ground, over that of the hub."""
        return np.hypot(self.ratio, np.tan(self.angle))


def tyres_of(clip: Clip) -> tuple[Tyre, ...]:
    """The tyres of a clip's vehicle, if it drives; none if it has no wheels."""
    rig = clip.vehicle.rig
    if rig is None or not clip.vehicle.group.planar:
        return ()
    channels, still, found = clip.channels, np.zeros(len(clip)), []
    for wheel in wheels_of(rig):
        name = _name(wheel)
        load = channels.get(LOAD + name)
        touches = np.ones(len(clip), bool) if load is None else load > TOUCHING * max(float(load.mean()), 0.0)
        prim = wheel.prim if wheel.roll is None else rig.drives[wheel.roll].prim
        ratio, angle, sliding = (channels.get(prefix + name, still) for prefix in (RATIO, ANGLE, SLIDING))
        found.append(Tyre(name, prim, wheel, ratio, angle, load, touches, sliding))
    return tuple(found)


def contacts(clip: Clip, tyre: Tyre) -> tuple[Array, Array]:
    """Where a tyre touches the ground (n, 3) m, and which way its wheel points (n, 3), unit vectors in the world."""
    rig = clip.vehicle.rig
    assert rig is not None
    wheel, channels, still = tyre.wheel, clip.channels, np.zeros(len(clip))
    there, turned = part_poses(rig, wheel.carrier, channels, clip.positions, clip.orientations)
    R = matrices(turned)
    steered = channels.get(STEER + tyre.name, still)
    heading = np.cos(steered)[:, None] * R[:, :, 0] + np.sin(steered)[:, None] * R[:, :, 1]
    travel = channels.get(wheel.travel or "", still)
    down = travel[:, None] - float(wheel.rings[:, 1].max())
    return there + R @ wheel.centre + down * R[:, :, 2], heading


def _name(wheel: Wheel) -> str:
    """What the channels of a wheel have in common: "fl" of ``travel_fl`` and ``roll_fl``."""
    if wheel.travel is not None:
        return wheel.travel.removeprefix(TRAVEL)
    return (wheel.roll or wheel.prim.rpartition("/")[2]).removeprefix(ROLL)


@lru_cache(maxsize=64)
def _mass(vehicle: Vehicle) -> float | None:
    known = known_inertia(vehicle)
    return None if known is None else known[0]


def spring_loads(clip: Clip, wheels: Sequence[Wheel]) -> dict[str, Array]:
    """Channels ``load_*`` [N] of the tyres of a clip that stands on a terrain: each carries its share of the weight,
    its spring and its damper, which only push.

    Empty if the model has loads of its own, if a wheel has no spring or is on a trailer, or if the mass is not known.
    """
    rig = clip.vehicle.rig
    mass = _mass(clip.vehicle)
    sprung = bool(wheels) and all(wheel.travel is not None and not wheel.carrier for wheel in wheels)
    if rig is None or mass is None or not sprung or any(name.startswith(LOAD) for name in clip.vehicle.channels):
        return {}
    omega, zeta = 2 * np.pi * rig.suspension.frequency, rig.suspension.damping
    travel = np.stack([clip.channels[wheel.travel or ""] for wheel in wheels])
    squeezed = travel - travel.mean(axis=0) - clip.channels["heave"]  # a leaning tyre's edge lifts hubs, not loads
    rate = np.gradient(squeezed, clip.times, axis=1) if len(clip) > 1 else np.zeros_like(squeezed)
    push = GRAVITY * matrices(clip.orientations)[:, 2, 2] + omega**2 * squeezed + 2 * zeta * omega * rate
    loads = np.maximum(mass / len(wheels) * push, 0.0)
    return {LOAD + _name(wheel): load for wheel, load in zip(wheels, loads, strict=True)}
