"""What every vehicle is: a group, joints, controls, channels, and the rig it drives.

The dynamics live beside this file (`holonomic.py`, `nonholonomic.py`); what belongs here is what simulation, planning,
clips and exporters all need to know about a vehicle, whatever its equations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

if TYPE_CHECKING:
    from vehsim.lie import Group

Array = NDArray[np.float64]
Expr = Any
"""A CasADi ``SX`` expression."""


@dataclass(frozen=True)
class Control:
    """One control input: its bounds and the size of a typical value (for scaling), in SI units."""

    name: str
    lower: float = -np.inf
    upper: float = np.inf
    scale: float = 1.0
    unit: str = ""


@dataclass(frozen=True)
class Channel:
    """A rig channel: an animated scalar that follows from the motion.

    Exactly one of ``value`` and ``rate`` is given, both functions of ``(t, r, u, xi, c)``: time [s], joints (s,), joint
    rates (s,), body twist (d,) and controls (c,). A ``rate`` is integrated along the clip, so its channel is unwrapped.
    """

    value: Callable[..., Expr] | None = None
    rate: Callable[..., Expr] | None = None


@dataclass(frozen=True)
class Drive:
    """Where a channel goes: ``op`` ("rotateX|Y|Z", "translateX|Y|Z") on ``prim`` (path below the rig root).

    ``pivot``: what it turns about when the prim has no pivot of its own: a point (3,) m in the rig root's frame, or
    "centre", the middle of the part. ``factor`` multiplies the channel: -1 for a wheel modelled the other way round.
    ``disc``: a rotor that can be shown as the disc it blurs into: True to make one, or a pattern of its meshes' names.
    """

    prim: str
    op: str
    pivot: tuple[float, float, float] | str | None = None
    factor: float = 1.0
    disc: bool | str = False


@dataclass(frozen=True)
class Suspension:
    """Springs between a body and its wheels: natural ``frequency`` Hz and ``damping`` ratio of heave, pitch and roll.

    ``mass_height`` m: of the centre of mass above the ground; it makes the body dive and lean.
    """

    frequency: float = 1.5
    damping: float = 0.5
    mass_height: float = 0.5


@dataclass(frozen=True)
class Rig:
    """A vehicle's USD asset and how motion drives it.

    ``origin``: the body frame's origin (centre of mass, or the rear axle of a car) in the frame of the rig's root, m;
    the axes are parallel. ``drives``: channel name -> drive. ``suspension``: of a body on wheels.
    ``variants``: variant set -> variant of the asset's root, where not the asset's own choice.
    ``source``: the file that deliveries reference, at its prim ``source_root``, when ``asset`` is only a wrapper that
    stands it upright; ``folder``: where its vehicle.toml lies; ``named``: the asset as that file names it.
    """

    asset: Path
    root: str
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drives: Mapping[str, Drive] = field(default_factory=dict)
    suspension: Suspension = Suspension()
    variants: Mapping[str, str] = field(default_factory=dict)
    source: Path | None = None
    source_root: str = ""
    folder: Path | None = None
    named: str = ""


@dataclass(frozen=True)
class State:
    """A vehicle's state at an instant, as riggers see it.

    ``position`` (3,) m, the rig's root in the world; ``orientation`` (4,) w, x, y, z, body to world; ``twist`` (d,)
    in body axes, rad/s then m/s, of the rig's root; ``joints`` (s,) and ``joint_rates`` (s,) in rad or m (and per s).
    ``None`` stands for zeros of the vehicle's own size.
    """

    position: Any = (0.0, 0.0, 0.0)
    orientation: Any = (1.0, 0.0, 0.0, 0.0)
    twist: Any = None
    joints: Any = None
    joint_rates: Any = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Vehicle:
    """What simulation, planning and export need of a vehicle. Make one as `Holonomic` or `Nonholonomic`.

    Its discrete mechanics see a vehicle through these hooks, all of CasADi columns; a segment's velocity ``z``
    (b + s_d,) holds the ``b`` coefficients along ``basis`` and the rates of the ``dynamic`` joints:

    - ``reduced_lagrangian(r, u, xi)``: kinetic energy minus joint potential, scalar
    - ``basis(r)`` (d, b): group velocities the constraints leave free with the joints locked
    - ``connection(r)`` (d, s): the free motion is ``xi = basis(r) z_b - connection(r) u``; where constraints bind the
      joints themselves, the rates of the ``tied`` joints are further rows of both
    - ``potential(g, r)``: energy of position, J (gravity); zero unless the vehicle says otherwise
    - ``force(g, r, u, xi, c, wind)``: everything else that acts, covectors on the joints (s,) and the group (d,);
      ``xi`` is the group's velocity
    - ``dissipation(g, r, u, xi, wind)``: power that drag and damping take out, W
    """

    name: str
    group: Group
    joints: tuple[str, ...] = ()
    controls: tuple[Control, ...] = ()
    rate_controls: Mapping[str, str] = field(default_factory=dict)
    """Control name -> the joint whose rate it sets."""
    channels: Mapping[str, Channel] = field(default_factory=dict)
    joint_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    default_costs: Mapping[str, float] = field(default_factory=dict)
    """Weights a plan adds to whatever it is asked to minimise, so that the vehicle moves as such vehicles do."""
    top_speed: float = 340.0
    """The greatest speed of its root, m/s, in plans without a ``limits.speed``; that of sound by default."""
    feels_wind: bool = False
    rig: Rig | None = None
    hull: Any = None
    """What water does to it, a `vehsim.vehicles.hydrodynamics.Hull`; None: water does nothing."""
    planar: Vehicle | None = None
    """The same vehicle on calm water, moving in the plane: what plans are made of, and what moves in a world without
    water. None: the vehicle itself."""

    def __post_init__(self) -> None:
        if isinstance(self.group, str):
            raise InputError(f"{self.name}: group = {self.group!r}: give the group itself, vehsim.lie.{self.group}")
        controls = tuple(c if isinstance(c, Control) else Control(c) for c in self.controls)
        object.__setattr__(self, "controls", controls)
        object.__setattr__(self, "joints", tuple(self.joints))
        for control, joint in self.rate_controls.items():
            if control not in self.control_names or joint not in self.joints:
                raise InputError(
                    f"{self.name}: rate_controls: {control!r} -> {joint!r}: name a control of "
                    f"{self.control_names} and a joint of {self.joints}"
                )

    @property
    def control_names(self) -> tuple[str, ...]:
        """The controls' names, in the order of a control vector (c,)."""
        return tuple(control.name for control in self.controls)

    @property
    def dynamic(self) -> tuple[int, ...]:
        """Indices of the joints whose rates are free: neither set by a rate control nor tied by the constraints."""
        driven = set(self.rate_controls.values())
        return tuple(i for i, joint in enumerate(self.joints) if joint not in driven and i not in self.tied)

    @property
    def tied(self) -> tuple[int, ...]:
        """Indices of the joints whose rates the constraints give, like the group's velocity (a trailer's hitch)."""
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

    def dissipation(self, g: Expr, r: Expr, u: Expr, xi: Expr, wind: Expr) -> Expr:
        return 0.0

    def energy(self, state: State) -> tuple[float, float]:
        """Kinetic and potential energy of a state, J."""
        from vehsim.vehicles.states import state_energy

        return state_energy(self, state)

    def momentum(self, state: State) -> Array:
        """Spatial momentum (d,), angular then linear, world axes; on SO3xR3 angular about the body's own origin."""
        from vehsim.vehicles.states import state_momentum

        return state_momentum(self, state)

    def linearize(self, state: State, controls: Any, wind: Any = (0.0, 0.0, 0.0)) -> tuple[Array, Array]:
        """``A`` (n, n), ``B`` (n, c) of the motion about a state; see `vehsim.vehicles.states.linearize`."""
        from vehsim.vehicles.states import linearize

        return linearize(self, state, controls, wind)
