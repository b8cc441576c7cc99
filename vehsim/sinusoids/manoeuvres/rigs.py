"""Vehicles that can be steered by sinusoids: the system of each one, and how its states become a clip.

A vehicle is recognised by its joints. Its lengths are computed from its own constraints, so they always agree with
``vehicle.toml``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np

from vehsim.clip.clip import Clip
from vehsim.errors import InputError, SolveError
from vehsim.integrators.discrete import DiscreteMechanics
from vehsim.integrators.record import build_clip
from vehsim.lie.quaternions import conjugate, from_yaw, product, rotate, yaw_tilt
from vehsim.sinusoids.algebra.feedback import car_chained, car_triangular
from vehsim.sinusoids.canonical.chained import steer_chained
from vehsim.sinusoids.canonical.fourier import steer_through, steer_triangular
from vehsim.sinusoids.manoeuvres.controls import controls_of
from vehsim.sinusoids.manoeuvres.options import Alternative, SinusoidOptions, loops
from vehsim.sinusoids.manoeuvres.trailers import trailer_routes
from vehsim.sinusoids.steering import Steering, TooFast
from vehsim.sinusoids.system import Array, DriftlessSystem
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles.definition.states import internal

SPEED, STEERING_RATE = 1.5, 0.7
"""Default speed of the wheels, m/s, and of the steering, rad/s."""
SHARPEST_STEERING = 0.7
"""Largest steering angle of a vehicle whose joints have no limits, rad."""


@dataclass(frozen=True, eq=False)
class Rigged(ABC):
    """A vehicle as a driftless system. ``state``: a public state -> x (n,); ``motion``: x, inputs -> g, r, u, xi.

    ``alternatives``: labels and makers of the manoeuvres between two states; ``limits``: default bounds on inputs and
    states, SI; ``outlines``: every body from above, convex (k, 2) m about its axle; ``flight``: take-off and landing as
    passed to `rigged`.
    """

    vehicle: Vehicle

    @property
    @abstractmethod
    def system(self) -> DriftlessSystem: ...

    @property
    @abstractmethod
    def limits(self) -> dict[str, float]: ...

    @abstractmethod
    def alternatives(self, start: Array, goal: Array, options: SinusoidOptions) -> Iterator[Alternative]: ...

    @abstractmethod
    def state(self, at: State) -> Array: ...

    @abstractmethod
    def motion(self, steering: Steering) -> tuple[Array, Array, Array, Array]: ...

    @abstractmethod
    def reach(self, limits: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Joint -> lowest and highest value at the start and end, under the ``limits`` of `SinusoidOptions`; none for a
        joint that cannot be chosen."""

    @property
    def outlines(self) -> tuple[Array, ...]:
        return ()

    @property
    def flight(self) -> dict[str, Any]:
        return {}

    def bound(self, control: str, otherwise: float) -> float:
        """The smaller bound of a control; ``otherwise`` if it has none, or if a force moves the joint."""
        bounds = [min(c.upper, -c.lower) for c in self.vehicle.controls if c.name == control]
        return next((float(bound) for bound in bounds if np.isfinite(bound)), otherwise)


@dataclass(frozen=True, eq=False)
class Wheeled(Rigged):
    """A car, with or without trailers coupled on the axle ahead: x, y of its rear axle."""

    wheelbase: float
    wheel_radius: float
    hitches: tuple[float, ...]

    @property
    def steering(self) -> float:
        """Largest steering angle, rad."""
        lower, upper = self.vehicle.joint_limits.get("sigma", (-np.inf, np.inf))
        return min(SHARPEST_STEERING, float(np.arctan(min(upper, -lower))))

    @property
    def hitch(self) -> float:
        """Largest hitch angle, rad."""
        bounds = [self.vehicle.joint_limits.get(j, (-np.inf, np.inf)) for j in self.vehicle.joints[2:]]
        return min([np.inf, *(min(upper, -lower) for lower, upper in bounds)])

    @cached_property
    def system(self) -> DriftlessSystem:  # type: ignore[override]  # a property of `Rigged`
        from vehsim.sinusoids.models import car, trailers

        if self.hitches:
            return trailers(self.hitches, self.wheelbase)
        found = car(self.wheelbase)  # the chart's bound on its heading is for the axes in which loops are made
        return replace(found, domain={name: bounds for name, bounds in found.domain.items() if name != "theta"})

    @property
    def limits(self) -> dict[str, float]:
        rate = self.bound("steering_rate", STEERING_RATE)
        return {"speed": SPEED, "steering_rate": min(STEERING_RATE, rate), "phi": self.steering}

    def reach(self, limits: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        sigma = float(np.tan(min(self.steering, limits.get("phi", np.inf))))
        hitch = min(self.hitch, limits.get("hitch", np.inf), np.pi / 2 - 1e-3)
        return {"sigma": (-sigma, sigma)} | {joint: (-hitch, hitch) for joint in self.vehicle.joints[2:]}

    @cached_property
    def outlines(self) -> tuple[Array, ...]:  # type: ignore[override]  # the same
        """From the collision hulls of the parts of each body."""
        rig = self.vehicle.rig
        if rig is None:
            return ()
        from vehsim.rig.parts import read_parts
        from vehsim.world.obstacles.plane import convex_hull

        towed = [rig.drives[joint].prim for joint in self.vehicle.joints[2:] if joint in rig.drives]
        points: list[list[Array]] = [[] for _ in range(1 + len(self.hitches))]
        for part in read_parts(rig.asset, rig.root or None):
            body = max((k for k, prim in enumerate(towed, 1) if f"{part.path}/".startswith(f"{prim}/")), default=0)
            points[body] += [hull @ part.T_rp[:2, :3].T + part.T_rp[:2, 3] for hull in part.hulls]
        axles = np.asarray(rig.origin)[:2] - np.outer(np.cumsum([0.0, *self.hitches]), [1.0, 0.0])
        return tuple(convex_hull(np.concatenate(p) - axle) for p, axle in zip(points, axles, strict=True) if p)

    def alternatives(self, start: Array, goal: Array, options: SinusoidOptions) -> Iterator[Alternative]:
        steering = min(self.steering, options.limits.get("phi", np.inf))
        if not self.hitches:
            yield from self._loops(start, goal, options, steering)
        order = [0, 1, 2, 3] if self.hitches else [0, 1, 3, 2]  # of x, y, phi, theta0 in this system's states
        ends = [np.concatenate([x[:4][order], x[4:]]) for x in (start, goal)]
        hitch = min(self.hitch, options.limits.get("hitch", np.inf))

        @lru_cache
        def legs() -> list[Steering] | SolveError:
            try:
                return trailer_routes(self.hitches, *ends, wheelbase=self.wheelbase, steering=steering, hitch=hitch)
            except SolveError as error:
                return error

        def leg(k: int) -> Steering:
            found = legs()
            if isinstance(found, SolveError):
                raise found
            q = found[k].goal
            return replace(found[k], system=self.system, start=start, goal=np.concatenate([q[:4][order], q[4:]]))

        found = legs()
        labels = ["in legs"] if isinstance(found, SolveError) else [route.label for route in found]
        for k, label in enumerate(labels):
            yield label, partial(leg, k)

    def _loops(self, start: Array, goal: Array, options: SinusoidOptions, steering: float) -> Iterator[Alternative]:
        """Sweeps through chained form and SIN's loops, in axes of the mean heading."""
        goal = goal.copy()
        goal[2] = start[2] + (goal[2] - start[2] + np.pi) % (2 * np.pi) - np.pi  # the shorter rotation
        frame = (start[2] + goal[2]) / 2
        c, s = np.cos(frame), np.sin(frame)
        x0, x1 = (
            np.array([c * x + s * y, c * y - s * x, theta - frame, phi])
            for x, y, theta, phi in ([*(q[:2] - start[:2]), *q[2:]] for q in (start, goal))
        )
        chained, triangular = car_chained(self.wheelbase, steering), car_triangular(self.wheelbase, steering)

        limits = {**self.limits, **options.limits}

        def there(make: Callable[[], Steering]) -> Steering:
            return replace(make().evened(limits).eased(), start=start, goal=goal)

        def sweep(a: float) -> Steering:
            return steer_through(chained, x0, x1, lambda z0, z1: steer_chained(4, z0, z1, amplitude=a))

        def loop(a: float, cycles: int, phase: float) -> Steering:
            return steer_triangular(triangular, x0, x1, amplitude=a, cycles=cycles, phase=phase)

        for k in (0.0, 0.5, -0.5, 1.0, -1.0):
            out = f", {abs(k) * 2 * self.wheelbase:.2g} m {'ahead' if k > 0 else 'back'} on the way" if k else ""
            yield f"one sweep{out}", partial(there, partial(sweep, k * self.wheelbase))
        for a, cycles, phase, label in loops((self.wheelbase, -self.wheelbase), options):
            yield label, partial(there, partial(loop, a, cycles, phase))

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
        rates = steering.system.rates(q, v)
        turning = rates[:, 3:] if self.hitches else rates[:, 2:3]
        along = v[:, 0] * np.cos(phi)
        psi = CubicSpline(t, along / self.wheel_radius).antiderivative()(t)
        r = np.column_stack([psi, np.tan(phi), np.diff(headings, axis=1)])
        u = np.column_stack([along / self.wheel_radius, v[:, 1] / np.cos(phi) ** 2, np.diff(turning, axis=1)])
        xi = np.column_stack([turning[:, 0], along, 0 * along])
        return np.column_stack([theta, q[:, :2]]), r, u, xi


@dataclass(frozen=True, eq=False)
class Airborne(Rigged):
    """The hopper between take-off and landing: its centre of mass falls freely, its body rotates about its own Y.

    ``take_off``, ``landing``: places of the rig's root, m; ``heading`` of the plane in which it flips, rad from world
    X. The steering determines the time in the air.
    """

    leg_length: float
    ratio: float
    share: float
    gravity: float
    take_off: tuple[float, float, float] = (0.0, 0.0, 0.0)
    landing: tuple[float, float, float] = (0.0, 0.0, 0.0)
    heading: float = 0.0

    @property
    def system(self) -> DriftlessSystem:
        from vehsim.sinusoids.models import hopper

        lower, upper = self.vehicle.joint_limits.get("stretch", (-np.inf, np.inf))
        return hopper(self.ratio, (max(-0.99, lower / self.leg_length), min(100.0, upper / self.leg_length)))

    @property
    def limits(self) -> dict[str, float]:
        return {
            "psi_rate": self.bound("psi_rate", 6.0),
            "l_rate": self.bound("stretch_rate", 2.0) / self.leg_length,
        }

    def reach(self, limits: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        lower, upper = self.system.domain["l"]
        return {"psi": (-np.inf, np.inf), "stretch": (lower * self.leg_length, upper * self.leg_length)}

    @property
    def flight(self) -> dict[str, Any]:
        return {"take_off": self.take_off, "landing": self.landing, "heading": self.heading}

    def alternatives(self, start: Array, goal: Array, options: SinusoidOptions) -> Iterator[Alternative]:
        def loop(a: float, cycles: int, phase: float) -> Steering:
            found = steer_triangular(self.system, start, goal, amplitude=a, cycles=cycles, phase=phase)
            return found.evened({**self.limits, **options.limits}).eased()

        for a, cycles, phase, label in loops((1.0, -1.0, 1.8, -1.8), options):
            yield f"{label}, leg to {np.degrees(abs(a)):.0f} deg", partial(loop, a, cycles, phase)

    def state(self, at: State) -> Array:
        _, r, _, _ = internal(self.vehicle, at)
        w, x, y, z = product(from_yaw(-self.heading), np.asarray(at.orientation, float))
        if np.hypot(x, z) > 1e-6:
            raise InputError(
                "turned about another axis than its own Y, where the leg cannot steer it",
                "give a heading, and the same at take-off and landing",
                key="orientation",
                value=list(at.orientation),
                subject=self.vehicle.name,
            )
        return np.array([r[0], r[1] / self.leg_length, 2 * np.arctan2(y, w)])

    def motion(self, steering: Steering) -> tuple[Array, Array, Array, Array]:
        q, v, t = steering.states, steering.controls, steering.times
        psi, reach, theta = q[:, 0], self.leg_length * (1 + q[:, 1]), q[:, 2]
        rates = steering.system.rates(q, v)
        zero, down = 0 * t, np.array([0.0, 0.0, -self.gravity])
        ahead = np.array([np.cos(self.heading), np.sin(self.heading), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        # from the root down the leg to the foot, which has its share of the mass
        along = -np.outer(np.sin(psi + theta), ahead) - np.outer(np.cos(psi + theta), up)
        across = -np.outer(np.cos(psi + theta), ahead) + np.outer(np.sin(psi + theta), up)
        offset = self.share * reach[:, None] * along
        first, last = np.asarray(self.take_off) + offset[0], np.asarray(self.landing) + offset[-1]
        start = (last - first) / t[-1] - down * t[-1] / 2
        origin = first + np.outer(t, start) + np.outer(t**2, down) / 2 - offset
        self._check_ground(steering, origin + reach[:, None] * along)
        turn, reach_rate = rates[:, 0] + rates[:, 2], self.leg_length * v[:, 1]
        moving = reach_rate[:, None] * along + (reach * turn)[:, None] * across
        velocity = start + np.outer(t, down) - self.share * moving
        quaternions = yaw_tilt(np.full_like(theta, self.heading), theta, zero)
        body = rotate(conjugate(quaternions), velocity)
        xi = np.column_stack([zero, rates[:, 2], zero, body])
        g = np.hstack([quaternions, origin])
        return g, np.column_stack([psi, reach - self.leg_length]), np.column_stack([v[:, 0], reach_rate]), xi

    def _check_ground(self, steering: Steering, foot: Array) -> None:
        """The foot stays above the line between take-off and landing."""
        share = steering.times / steering.times[-1]
        above = foot[:, 2] - (foot[0, 2] + share * (foot[-1, 2] - foot[0, 2]))
        if above.min() < -0.01:
            raise TooFast(
                f"its foot goes {-above.min():.2f} m into the ground "
                f"{share[above.argmin()] * steering.duration:.2f} s after take-off",
                1.1 * steering.duration,
            )


def rigged(vehicle: Vehicle, **flight: Any) -> Rigged:
    """The system of a vehicle; ``flight``: take_off, landing and heading of a hopper.

    Raises ``InputError`` for vehicles that are not among the paper's.
    """
    joints = vehicle.joints
    rolls = joints[:2] == ("psi", "sigma") and all(joint.startswith("hitch") for joint in joints[2:])
    if rolls and vehicle.group.planar:
        return _wheeled(vehicle)
    if joints == ("psi", "stretch") and vehicle.group.name == "SE3":
        return _airborne(vehicle, **flight)
    raise InputError(
        f"joints {', '.join(joints) or 'none'}: not a system that is steered by sinusoids",
        "give a car, a truck with trailers or a hopper, or plan or simulate its motion",
        subject=vehicle.name,
    )


def clip_of(
    steering: Steering, vehicle: Vehicle, fps: Any = 24, start_frame: int = 1001, height: float = 0.0, **flight: Any
) -> Clip:
    """The steering as a clip of ``vehicle``, with the forces that produce the motion. Raises ``InputError`` if it is
    another system."""
    rig = rigged(vehicle, **flight)
    if rig.system.states != steering.system.states:
        raise InputError(
            f"its states are {', '.join(rig.system.states)}, those of the steering {', '.join(steering.system.states)}",
            "steer vehsim.sinusoids.rigged(vehicle).system",
            subject=vehicle.name,
        )
    g, r, u, xi = rig.motion(steering)
    mechanics = DiscreteMechanics(vehicle)
    momenta = np.asarray(mechanics.knot_momentum.map(len(r))(r.T, u.T, xi.T)).T
    controls = controls_of(mechanics, steering.times, g, r, u, xi)
    anchor = (0.0, 0.0, height if vehicle.group.dim == 3 else 0.0)
    return build_clip(mechanics, steering.times, g, r, momenta, controls, anchor, fps=fps, start_frame=start_frame)


def _wheeled(vehicle: Vehicle) -> Wheeled:
    """Lengths from the velocities that the constraints permit: at a steering angle of 45 degrees, at hitches of 45
    degrees."""

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
        # its heading turns by -sin(bend) / d per metre if everything ahead goes straight
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
            "a trailer is not coupled on the axle ahead, and chained form needs that",
            "set its hitch there (hitch_behind = 0), or plan its motion",
            subject=found.vehicle.name,
        )


def _airborne(vehicle: Vehicle, **flight: Any) -> Airborne:
    """Masses and lengths from the vehicle's own energy."""
    r, u, xi = ca.SX.sym("r", 2), ca.SX.sym("u", 2), ca.SX.sym("xi", 6)
    hessian = ca.hessian(vehicle.reduced_lagrangian(r, u, xi), ca.vertcat(u, xi))[0]
    m = np.asarray(ca.Function("m", [r], [ca.densify(hessian)])(np.zeros(2)))
    total, foot = float(m[5, 5]), float(m[1, 1])  # translation of everything; stretching moves only the foot
    length = float(np.sqrt(m[0, 0] / foot))
    inertia = float(m[3, 3] - m[0, 0])
    g = np.array([*vehicle.group.identity])
    raised = g.copy()
    raised[6] = 1.0
    weigh = ca.SX.sym("g", 7)
    height = ca.Function("V", [weigh], [ca.SX(vehicle.potential(weigh, ca.SX.zeros(2)))])
    gravity = float(height(raised) - height(g)) / total
    reduced = foot * (total - foot) / total
    return Airborne(vehicle, length, reduced * length**2 / inertia, foot / total, gravity, **flight)
