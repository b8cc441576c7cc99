"""Vehicles that are one actuated rigid body: an inertia, a wrench of the controls, drag and gravity (LIE section 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.lie import SO3
from vehsim.lie.once import built_once
from vehsim.vehicles.definition.base import Expr
from vehsim.vehicles.definition.mechanics import law, symbols
from vehsim.vehicles.definition.scales import scaled
from vehsim.vehicles.definition.vehicle import Vehicle


@dataclass(frozen=True, eq=False, kw_only=True)
class Holonomic(Vehicle):
    """A rigid body on ``group`` with the Lagrangian ``1/2 xi^T inertia xi`` (LIE eq. 9).

    ``inertia``: (d, d) or its diagonal (d,), rotation first, kg m^2 and kg, about the body frame's origin. ``wrench``:
    controls (c,) -> body wrench (d,), N m and N; None: no actuators. ``drag``: body twist relative to the air (d,) ->
    body wrench (d,), which must not add power; None: no drag. ``resistance``: body twist (d,) and controls (c,) -> body
    wrench (d,) of a medium at rest in the world, such as calm water; None: no resistance. ``rotors``: body twist
    relative to the air, controls, and the height of the body frame's origin above the ground, m -> torque (3,), N m,
    with which rotors react on the body beside ``wrench``; None: no reaction. ``power``: of the same -> power at the
    shafts of its rotors, W; None: unknown. ``ground``: group coordinates -> height of the ground below, m; None: far
    below. ``gravity``: m/s^2, acts on ``mass`` along -Z; ``mass`` defaults to the
    translational inertia and is necessary with added mass.

    Raises ``InputError`` if the inertia has the wrong shape or is not symmetric and positive definite, or if a law has
    the wrong shape.
    """

    inertia: Any
    wrench: Callable[[Expr], Expr] | None = None
    drag: Callable[[Expr], Expr] | None = None
    resistance: Callable[[Expr, Expr], Expr] | None = None
    rotors: Callable[[Expr, Expr, Expr], Expr] | None = None
    power: Callable[[Expr, Expr, Expr], Expr] | None = None
    ground: Callable[[Expr], Expr] | None = None
    mass: float | None = None
    gravity: float = GRAVITY
    air: Expr | None = None
    """Symbols (3,) that stand for the velocity of `through_air` in forces; a solver's derivatives then follow the chain
    rule through them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        inertia = np.asarray(self.inertia, float)
        inertia = np.diag(inertia) if inertia.ndim == 1 else inertia
        d = self.group.dim
        if inertia.shape != (d, d):
            raise InputError(
                f"of shape {inertia.shape}",
                f"{self.group} needs ({d}, {d}) or ({d},)",
                key="inertia",
                subject=self.name,
            )
        if not np.allclose(inertia, inertia.T) or np.linalg.eigvalsh(inertia).min() <= 0:
            raise InputError(
                "inertia must be symmetric and positive definite", f"got {inertia.tolist()}", subject=self.name
            )
        object.__setattr__(self, "inertia", inertia)
        object.__setattr__(self, "feels_wind", self.feels_wind or bool(self.drag or self.rotors))
        self.force(*symbols(self))  # names a law of the wrong shape now
        object.__setattr__(self, "controls", scaled(self))

    def largest_drag(self, airspeed: float) -> float:
        """The largest force of drag, N, on a body in space at speeds up to ``airspeed`` m/s, found by sampling; inf if
        it depends on the turn rate too."""
        if self.drag is None or not airspeed:
            return 0.0
        air = ca.SX.sym("air", 6)
        force = ca.densify(law(self, "drag", 6, self.drag, air)[3:])
        if not np.isfinite(airspeed) or ca.depends_on(force, air[:3]):
            return float("inf")
        rays = np.random.default_rng(0).normal(size=(600, 3))
        rays[:3] = np.eye(3)
        velocities = airspeed * rays / np.linalg.norm(rays, axis=1)[:, None]
        velocities = np.vstack([share * velocities for share in np.linspace(0.1, 1.0, 10)])
        twists = np.hstack([np.zeros_like(velocities), velocities])
        forces = np.array(ca.Function("drag", [air], [force]).map(len(twists))(twists.T))
        return float(np.linalg.norm(forces, axis=0).max())

    @built_once
    def reduced_lagrangian(self, r: Expr, u: Expr, xi: Expr) -> Expr:
        return ca.dot(xi, ca.DM(self.inertia) @ xi) / 2

    def basis(self, r: Expr) -> Expr:
        return ca.SX.eye(self.group.dim)

    def connection(self, r: Expr) -> Expr:
        return ca.SX(self.group.dim, 0)

    def force(self, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr, wind: Expr) -> tuple[Expr, Expr]:
        # apart from the rest, because it may have symbols of its own, of a cell of the ground's relief
        height = np.inf if self.ground is None else self.group.pose(g)[2] - self.ground(g)
        applied: tuple[Expr, Expr] = self._force(g, xi, c, wind, height)
        return applied

    @built_once
    def _force(self, g: Expr, xi: Expr, c: Expr, wind: Expr, height: Expr) -> tuple[Expr, Expr]:
        d, group = self.group.dim, self.group
        air, through = self.through_air(g, xi, wind), group.velocity_to_body(g, xi)
        if self.air is not None:
            air = ca.vertcat(air[: d - 3], self.air)
        body = ca.SX(d, 1)
        if self.wrench is not None:
            body += law(self, "wrench", d, self.wrench, c)
        if self.drag is not None:
            body += law(self, "drag", d, self.drag, air)
        if self.rotors is not None:
            body[:3] += law(self, "rotors", 3, self.rotors, air, c, height)
        if self.resistance is not None:
            pieces = getattr(self.resistance, "pieces", None)  # symbols, of a part of its curves
            given = (through, c) if pieces is None else (through, c, pieces)
            body += law(self, "resistance", d, self.resistance, *given)
        return ca.SX(0, 1), group.wrench_from_body(g, body)

    def through_air(self, g: Expr, xi: Expr, wind: Expr) -> Expr:
        """The body twist (d,) relative to the air."""
        return self.group.velocity_to_body(g, xi - _still(self.group, g, wind))

    def potential(self, g: Expr, r: Expr) -> Expr:
        if self.group.dim != 6:
            return 0.0
        mass = self.inertia[5, 5] if self.mass is None else self.mass
        return self.gravity * mass * self.group.pose(g)[2]

    def dissipation(self, g: Expr, r: Expr, u: Expr, xi: Expr, wind: Expr) -> Expr:
        lost: Any = 0.0
        d = self.group.dim
        if self.drag is not None:
            air = self.through_air(g, xi, wind)
            lost -= ca.dot(law(self, "drag", d, self.drag, air), air)
        if self.resistance is not None:
            body, idle = self.group.velocity_to_body(g, xi), ca.SX(len(self.controls), 1)
            lost -= ca.dot(law(self, "resistance", d, self.resistance, body, idle), body)
        return lost


def _still(group: Any, g: Expr, velocity: Expr) -> Expr:
    """The group's velocity (d,) of a body that drifts with a world velocity (3,) and does not rotate."""
    if group.planar:  # with half the operations of quaternions
        c, s = ca.cos(g[0]), ca.sin(g[0])
        linear = ca.vertcat(c * velocity[0] + s * velocity[1], c * velocity[1] - s * velocity[0])
        return group.velocity_from_body(g, ca.vertcat(0, linear))
    linear = SO3.matrix(group.pose(g)[3:7]).T @ velocity
    return group.velocity_from_body(g, ca.vertcat(ca.SX(3, 1), linear[: group.dim - 3]))
