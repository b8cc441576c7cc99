"""The definition of a vehicle: its group, joints, controls and channels, and the rig that it drives.

This module holds what simulation, planning, clips and exporters need of any vehicle. The equations are in
`holonomic.py` and `nonholonomic.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.rig.rig import Channel, Rig
from vehsim.vehicles.definition.actuator import Actuator
from vehsim.vehicles.definition.character import Character
from vehsim.vehicles.definition.surfaces import SurfaceName

if TYPE_CHECKING:
    from vehsim.lie import Group

Array = NDArray[np.float64]
Expr = Any
"""A CasADi ``SX`` expression."""


@dataclass(frozen=True)
class Control:
    """One control input: its bounds and the size of a typical value (for scaling), in SI units, and its actuator.

    ``scale``: by default what accelerates the vehicle as strongly as 1 m/s^2 does, or 1 if it has no force.
    """

    name: str
    lower: float = -np.inf
    upper: float = np.inf
    scale: float = math.nan
    unit: str = ""
    actuator: Actuator = field(default_factory=Actuator)


@dataclass(frozen=True)
class State:
    """A vehicle's state at an instant, as riggers see it.

    ``position`` (3,) m of the rig's root in the world; ``orientation`` (4,) w, x, y, z, body to world; ``twist`` (d,)
    of the rig's root in body axes, rad/s then m/s; ``joints`` (s,) and ``joint_rates`` (s,) in rad or m (and per s).
    ``None`` means zeros of the vehicle's size.
    """

    position: Any = (0.0, 0.0, 0.0)
    orientation: Any = (1.0, 0.0, 0.0, 0.0)
    twist: Any = None
    joints: Any = None
    joint_rates: Any = None

    def same(self, other: State) -> bool:
        """Whether every number is the same."""
        return all(np.array_equal(mine, getattr(other, part)) for part, mine in vars(self).items())


@dataclass(frozen=True, eq=False, kw_only=True)
class Definition:
    """A vehicle without the functions derived from it, which `Vehicle` adds.

    The discrete mechanics use these methods, all of CasADi columns. A segment's velocity ``z`` (b + s_d,) consists of
    the ``b`` coefficients along ``basis`` and the rates of the ``dynamic`` joints:

    - ``reduced_lagrangian(r, u, xi)``: kinetic energy minus joint potential, scalar
    - ``basis(r)`` (d, b): basis of the group velocities that the constraints leave free while the joints are locked
    - ``connection(r)`` (d, s): the free motion is ``xi = basis(r) z_b - connection(r) u``; if constraints bind the
      joints themselves, the rates of the ``tied`` joints are further rows of both
    - ``potential(g, r)``: potential energy, J (gravity); zero by default
    - ``force(g, r, u, xi, c, wind)``: all other forces, as covectors on the joints (s,) and the group (d,); ``xi`` is
      the group's velocity
    - ``dissipation(g, r, u, xi, wind)``: power dissipated by drag and damping, W
    """

    name: str
    group: Group
    joints: tuple[str, ...] = ()
    controls: tuple[Control, ...] = ()
    rate_controls: Mapping[str, str] = field(default_factory=dict)
    """Control name -> the joint whose rate it sets."""
    rolling: Callable[[Expr, Expr], Expr] | None = None
    """Joints (s,) and body twist (d,) -> the joint rates (s,) at which its wheels roll without slip, if they may slip.
    A motion of unknown joint rates rolls. None: constraints determine the wheels, or there are none."""
    across: Callable[[Expr, Expr], Expr] | None = None
    """Joints (s,) and body twist (d,) -> the speeds (m,) at which its axles move sideways, m/s: zero without slip."""
    torques: Callable[[Expr, Expr], Expr] | None = None
    """Joint rates (s,) and controls (c,) -> what engine and brakes exert on the joints (s,), if its wheels may slip."""
    standing: Callable[[Expr, Expr, Expr, Expr, Expr], Expr] | None = None
    """Joints (s,), their rates (s,), body twist (d,), controls (c,) and the force of its weight along a slope, a wrench
    on the body (d,) -> what its tyres bear of that near standstill (d,), if its wheels may slip: slip holds nothing at
    rest."""
    attitude: tuple[str, str, str] | None = None
    """Joints that are the body's heave [m], pitch (nose down) and roll (left side up) [rad] on its own springs; None:
    the springs of its rig move it on a terrain, see `vehsim.world.ground`."""
    channels: Mapping[str, Channel] = field(default_factory=dict)
    joint_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    joint_units: Mapping[str, str] = field(default_factory=dict)
    """Units of joints by name, "1" for a pure number; default: rad."""
    default_costs: Mapping[str, float] = field(default_factory=dict)
    """Cost weights that every plan of this vehicle adds, so that it moves as such vehicles do."""
    character: Character = field(default_factory=Character)
    """The numbers for driving it calmly, normally or briskly."""
    top_speed: float = 340.0
    """The greatest speed of the root, m/s, in plans without a ``limits.speed``; default: the speed of sound."""
    top_turn_rate: float = math.inf
    """The greatest angular speed of the root, rad/s, in plans without a ``limits.turn_rate``."""
    largest_step: float = math.inf
    """The largest step of a simulation, s: with longer ones, a fast decay such as that of a tyre's slip alternates."""
    surface: SurfaceName = "asphalt"
    """The ground under its tyres."""
    feels_wind: bool = False
    rig: Rig | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Numbers given in place of those of its ``vehicle.toml``; see `vehsim.load_vehicle`."""
    hull: Any = None
    """The effect of water, a `vehsim.vehicles.definition.hydrodynamics.Hull`; None: water has no effect."""

    def __post_init__(self) -> None:
        if isinstance(self.group, str):
            raise InputError(
                "not a group",
                f"give the group itself, vehsim.lie.{self.group}",
                key="group",
                value=self.group,
                subject=self.name,
            )
        controls = tuple(c if isinstance(c, Control) else Control(c) for c in self.controls)
        object.__setattr__(self, "controls", controls)
        object.__setattr__(self, "joints", tuple(self.joints))
        for control, joint in self.rate_controls.items():
            if control not in self.control_names or joint not in self.joints:
                raise InputError(
                    "no such control or joint",
                    f"name a control of {self.control_names} and a joint of {self.joints}",
                    key="rate_controls",
                    value={control: joint},
                    subject=self.name,
                )

    @property
    def control_names(self) -> tuple[str, ...]:
        """The controls' names, in the order of a control vector (c,)."""
        return tuple(control.name for control in self.controls)

    @property
    def actuated(self) -> bool:
        """Whether some control does not follow every command at once."""
        return not all(control.actuator.ideal for control in self.controls)

    @property
    def rolls(self) -> bool:
        """Whether it rolls on the ground, on wheels or rollers."""
        return False

    @property
    def dynamic(self) -> tuple[int, ...]:
        """Indices of the joints whose rates are free: neither set by a rate control nor tied by the constraints."""
        driven = set(self.rate_controls.values())
        return tuple(i for i, joint in enumerate(self.joints) if joint not in driven and i not in self.tied)

    @property
    def tied(self) -> tuple[int, ...]:
        """Indices of the joints whose rates the constraints determine, like the group's velocity (a trailer's
        hitch)."""
        return ()

    @property
    def driven(self) -> tuple[tuple[int, int], ...]:
        """(joint index, control index) of every rate control."""
        names = self.control_names
        return tuple((self.joints.index(joint), names.index(control)) for control, joint in self.rate_controls.items())

    @property
    def origin(self) -> Array:
        """The body frame's origin in the frame of the rig's root (3,), m."""
        return np.asarray(self.rig.origin if self.rig else (0.0, 0.0, 0.0), float)

    def reduced_lagrangian(self, r: Expr, u: Expr, xi: Expr) -> Expr:
        raise NotImplementedError

    def basis(self, r: Expr) -> Expr:
        raise NotImplementedError

    def connection(self, r: Expr) -> Expr:
        raise NotImplementedError

    def force(self, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr, wind: Expr) -> tuple[Expr, Expr]:
        raise NotImplementedError

    def potential(self, g: Expr, r: Expr) -> Expr:
        return 0.0

    def regularity(self, r: Expr) -> Expr:
        """How far ``basis`` and ``connection`` are from singular at ``r`` (s,): from 0 (singular) to 1."""
        return 1.0

    def dissipation(self, g: Expr, r: Expr, u: Expr, xi: Expr, wind: Expr) -> Expr:
        return 0.0
