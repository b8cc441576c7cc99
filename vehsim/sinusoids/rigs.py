"""Vehicles that can be steered by sinusoids: which system each one is, and how its states become a clip.

A vehicle is recognised by its joints; its lengths are read off its own constraints, so that whatever a rigger writes in
``vehicle.toml`` is what is steered.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from vehsim.clip import Clip
from vehsim.errors import InputError
from vehsim.integrators.continuous import equations_of_motion
from vehsim.integrators.discrete import DiscreteMechanics
from vehsim.integrators.integrator import build_clip
from vehsim.lie import SO3
from vehsim.sinusoids.steering import Steering
from vehsim.sinusoids.system import Array, DriftlessSystem
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles.states import internal


@dataclass(frozen=True, eq=False)
class Rigged(ABC):
    """A vehicle as a driftless system. ``state``: a public state -> x (n,); ``motion``: x, inputs -> g, r, u, xi."""

    vehicle: Vehicle

    @property
    @abstractmethod
    def system(self) -> DriftlessSystem: ...

    @abstractmethod
    def state(self, at: State) -> Array: ...

    @abstractmethod
    def motion(self, steering: Steering) -> tuple[Array, Array, Array, Array]: ...


@dataclass(frozen=True, eq=False)
class Wheeled(Rigged):
    """A car, with or without trailers coupled on the axle ahead: x, y of its rear axle."""

    wheelbase: float
    wheel_radius: float
    hitches: tuple[float, ...]

    @property
    def system(self) -> DriftlessSystem:
        from vehsim.sinusoids.models import car, trailers

        return trailers(self.hitches, self.wheelbase) if self.hitches else car(self.wheelbase)

    def state(self, at: State) -> Array:
        g, r, _, _ = internal(self.vehicle, at)
        headings = g[0] + np.cumsum([0.0, *r[2:]])
        phi = np.arctan(r[1])
        return np.array([g[1], g[2], phi, *headings]) if self.hitches else np.array([g[1], g[2], g[0], phi])

    def motion(self, steering: Steering) -> tuple[Array, Array, Array, Array]:
        from scipy.interpolate import CubicSpline

        q, v, t = steering.states, steering.controls, steering.times
        names = list(steering.system.states)
        phi, theta = q[:, names.index("phi")], q[:, names.index("theta0" if "theta0" in names else "theta")]
        headings = q[:, 3:] if self.hitches else theta[:, None]
        rates = np.array([steering.system.rate(x, u) for x, u in zip(q, v, strict=True)])
        turning = rates[:, 3:] if self.hitches else rates[:, 2:3]
        along = v[:, 0] * np.cos(phi)
        psi = CubicSpline(t, along / self.wheel_radius).antiderivative()(t)
        r = np.column_stack([psi, np.tan(phi), np.diff(headings, axis=1)])
        u = np.column_stack([along / self.wheel_radius, v[:, 1] / np.cos(phi) ** 2, np.diff(turning, axis=1)])
        xi = np.column_stack([turning[:, 0], along, 0 * along])
        return np.column_stack([theta, q[:, :2]]), r, u, xi


@dataclass(frozen=True, eq=False)
class Airborne(Rigged):
    """The hopper between take-off and landing: its centre of mass falls freely, its body turns about Y.

    ``take_off``, ``landing``: where the rig's root is, m; flight time is the steering's.
    """

    leg_length: float
    ratio: float
    share: float
    gravity: float
    take_off: tuple[float, float, float] = (0.0, 0.0, 0.0)
    landing: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def system(self) -> DriftlessSystem:
        from vehsim.sinusoids.models import hopper

        return hopper(self.ratio)

    def state(self, at: State) -> Array:
        _, r, _, _ = internal(self.vehicle, at)
        w, x, y, z = np.asarray(at.orientation, float)
        if np.hypot(x, z) > 1e-6:
            raise InputError(
                f"{self.vehicle.name}: orientation {list(at.orientation)}: turned about another axis than Y, where the "
                "leg cannot steer it; give (cos(a/2), 0, sin(a/2), 0)"
            )
        return np.array([r[0], r[1] / self.leg_length, 2 * np.arctan2(y, w)])

    def _offset(self, psi: Array, reach: Array, theta: Array) -> Array:
        """From the body's origin to the centre of mass, world axes (k, 3)."""
        angle = psi + theta
        return -self.share * (reach * np.array([np.sin(angle), 0 * angle, np.cos(angle)])).T

    def motion(self, steering: Steering) -> tuple[Array, Array, Array, Array]:
        q, v, t = steering.states, steering.controls, steering.times
        psi, reach, theta = q[:, 0], self.leg_length * (1 + q[:, 1]), q[:, 2]
        rates = np.array([steering.system.rate(x, u) for x, u in zip(q, v, strict=True)])
        zero, down = 0 * t, np.array([0.0, 0.0, -self.gravity])
        offset = self._offset(psi, reach, theta)
        first, last = np.asarray(self.take_off) + offset[0], np.asarray(self.landing) + offset[-1]
        start = (last - first) / t[-1] - down * t[-1] / 2
        origin = first + np.outer(t, start) + np.outer(t**2, down) / 2 - offset
        turn, reach_rate = rates[:, 0] + rates[:, 2], self.leg_length * v[:, 1]
        angle = psi + theta
        moving = reach_rate * np.array([np.sin(angle), zero, np.cos(angle)])
        moving += reach * turn * np.array([np.cos(angle), zero, -np.sin(angle)])
        velocity = start + np.outer(t, down) + self.share * moving.T
        quaternions = np.column_stack([np.cos(theta / 2), zero, np.sin(theta / 2), zero])
        body = np.einsum("kji,kj->ki", SO3.matrix(quaternions), velocity)
        xi = np.column_stack([zero, rates[:, 2], zero, body])
        g = np.hstack([quaternions, origin])
        return g, np.column_stack([psi, reach - self.leg_length]), np.column_stack([v[:, 0], reach_rate]), xi


def rigged(vehicle: Vehicle, **flight: Any) -> Rigged:
    """The system a vehicle is; ``flight``: take_off and landing of a hopper.

    Raises ``InputError`` for vehicles that are none of the paper's.
    """
    joints = vehicle.joints
    if (
        joints[:2] == ("psi", "sigma")
        and all(j.startswith("hitch") for j in joints[2:])
        and vehicle.group.name == "SE2"
    ):
        return _wheeled(vehicle)
    if joints == ("psi", "stretch") and vehicle.group.name == "SE3":
        return _airborne(vehicle, **flight)
    raise InputError(
        f"{vehicle.name}: joints {', '.join(joints) or 'none'}: not a system that is steered by sinusoids; "
        "give a car, a truck with trailers or a hopper, or plan or simulate its motion"
    )


def clip_of(steering: Steering, vehicle: Vehicle, fps: Any = 24, start_frame: int = 1001, **flight: Any) -> Clip:
    """The steering as a clip of ``vehicle``, its forces found from the motion. ``InputError`` when it is another
    system.
    """
    who = rigged(vehicle, **flight)
    if who.system.states != steering.system.states:
        raise InputError(
            f"{vehicle.name}: its states are {', '.join(who.system.states)}, those of the steering "
            f"{', '.join(steering.system.states)}; steer vehsim.sinusoids.rigged(vehicle).system"
        )
    g, r, u, xi = who.motion(steering)
    mechanics = DiscreteMechanics(vehicle)
    momenta = np.asarray(mechanics.knot_momentum.map(len(r))(r.T, u.T, xi.T)).T
    controls = _controls(mechanics, steering.times, g, r, u, xi)
    return build_clip(mechanics, steering.times, g, r, momenta, controls, fps=fps, start_frame=start_frame)


def _controls(mechanics: DiscreteMechanics, times: Array, g: Array, r: Array, u: Array, xi: Array) -> Array:
    """Controls (k, c): rates as they are, forces as the equations of motion ask for them."""
    from scipy.interpolate import CubicSpline

    vehicle, law = mechanics.vehicle, equations_of_motion(mechanics.vehicle)
    controls = np.zeros((len(times), len(vehicle.controls)))
    for joint, control in vehicle.driven:
        controls[:, control] = u[:, joint]
    others = [i for i, name in enumerate(vehicle.control_names) if name not in vehicle.rate_controls]
    if not others:
        return controls
    free = np.asarray(
        mechanics.knot_velocity_guess.map(len(times))(
            r.T, np.asarray(mechanics.knot_momentum.map(len(times))(r.T, u.T, xi.T)), controls.T
        )
    ).T
    wanted, rates = CubicSpline(times, free).derivative()(times), CubicSpline(times, controls).derivative()(times)
    c = ca.SX.sym("c", controls.shape[1])
    symbols = [ca.SX.sym(name, size) for name, size in (("g", g.shape[1]), ("r", r.shape[1]), ("z", free.shape[1]))]
    c_rate = ca.SX.sym("c_rate", controls.shape[1])
    z_dot = law(*symbols, c, c_rate, ca.SX.zeros(3))[2]
    function = ca.Function(
        "z", [*symbols, c, c_rate], [ca.densify(z_dot), ca.densify(ca.jacobian(z_dot, c)[:, others])]
    )
    for k in range(len(times)):
        rest, gain = (np.asarray(x) for x in function(g[k], r[k], free[k], controls[k], rates[k]))
        controls[k, others] = np.linalg.lstsq(gain, wanted[k] - rest.ravel(), rcond=None)[0]
    return controls


def _wheeled(vehicle: Vehicle) -> Wheeled:
    """Lengths from the velocities the constraints allow: at a steering of 45 degrees, at hitches of 45 degrees."""

    def rates(joints: Array) -> Array:
        r = ca.SX.sym("r", len(joints))
        rows = ca.horzcat(vehicle.basis(r), -vehicle.connection(r)[:, 0])
        value = np.asarray(ca.Function("A", [r], [ca.densify(rows)])(joints))
        return value[:, -1] if vehicle.basis(r).shape[1] == 0 else value[:, 0]

    count = len(vehicle.joints) - 2
    sharp = np.zeros(len(vehicle.joints))
    sharp[1] = 1.0
    turning = rates(sharp)
    wheelbase = float(turning[1] / turning[0])
    straight = np.zeros(len(vehicle.joints))
    radius = float(rates(straight)[1])
    hitches = []
    for k in range(count):
        bent = straight.copy()
        bent[2 + k] = np.pi / 4
        # its heading turns by -sin(bend) / d per metre, all ahead goes straight
        moving = rates(bent)
        hitches.append(float(-np.sin(np.pi / 4) * moving[1] / moving[3 + k]))
    found = Wheeled(vehicle, wheelbase, radius, tuple(hitches))
    _check_hitching(found, rates)
    return found


def _check_hitching(found: Wheeled, rates: Any) -> None:
    """Whether the trailers follow as if coupled on the axle ahead."""
    joints = np.concatenate([[0.0, 0.3], 0.2 + 0.1 * np.arange(len(found.hitches))])
    moving = rates(joints)
    speed, turning = moving[1], [moving[0]]
    for d, bend in zip(found.hitches, joints[2:], strict=True):
        turning.append(-speed * np.sin(bend) / d)
        speed *= np.cos(bend)
    if not np.allclose(np.diff(turning), moving[3:], atol=1e-9 * max(1.0, abs(moving[1]))):
        raise InputError(
            f"{found.vehicle.name}: a trailer is not coupled on the axle ahead, and chained form needs that; set its "
            "hitch there (hitch_behind = 0), or plan its motion"
        )


def _airborne(vehicle: Vehicle, **flight: Any) -> Airborne:
    """Masses and lengths from the vehicle's own energy."""
    r, u, xi = ca.SX.sym("r", 2), ca.SX.sym("u", 2), ca.SX.sym("xi", 6)
    hessian = ca.hessian(vehicle.reduced_lagrangian(r, u, xi), ca.vertcat(u, xi))[0]
    m = np.asarray(ca.Function("m", [r], [ca.densify(hessian)])(np.zeros(2)))
    total, foot = float(m[5, 5]), float(m[1, 1])  # translation of all; stretching moves the foot alone
    length = float(np.sqrt(m[0, 0] / foot))
    inertia = float(m[3, 3] - m[0, 0])
    g = np.array([*vehicle.group.identity])
    lifted = g.copy()
    lifted[6] = 1.0
    weigh = ca.SX.sym("g", 7)
    height = ca.Function("V", [weigh], [ca.SX(vehicle.potential(weigh, ca.SX.zeros(2)))])
    gravity = float(height(lifted) - height(g)) / total
    reduced = foot * (total - foot) / total
    return Airborne(vehicle, length, reduced * length**2 / inertia, foot / total, gravity, **flight)
