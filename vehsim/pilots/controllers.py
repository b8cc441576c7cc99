"""Pilots: feedback controllers ``pilot(t, state) -> controls`` that `simulate` calls at every knot.

Time in s, `State` as everywhere (rig root, SI, radians), controls in SI units within their bounds. A pilot may have
memory (integrals, its route); `simulate` calls `reset` first, which clears it. ``targets(duration)`` returns what the
pilot is requested to achieve within that many seconds, as plain data, so that a finished clip can be measured against
it:

- ``{"key", "kind": "reach", "position" (3,) m, "tolerance" m, "at": "end"}``: the rig's root at the last sample; None
  in ``position`` is free; ``"needs"`` s, if known: a sufficient duration;
- ``{"key", "kind": "heading", "heading" rad, "tolerance" rad, "at": "end"}``;
- ``{"key", "kind": "speed", "upper" m/s, "from" s}``: of the rig's root over ground, from then on;
- ``{"key", "kind": "path", "points" (n, 3) m, "tolerance" m, "offset" (3,) m, "from" s}``: the distance of a point of
  the vehicle, ``offset`` in its own axes, to the polyline, seen from above;
- ``{"key", "kind": "amplitude", "joint", "amplitude" rad, "tolerance" relative, "from" s, "until" s}``: half of the
  range of the joint, and ``"needs_period"`` s, if known: a sufficient period.

Call ``targets`` after the simulation: the necessary time depends on the start. Pilots use a vehicle's numbers and its
state, not terrain or planning.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.lie.quaternions import matrices
from vehsim.pilots.gait import Gait
from vehsim.pilots.lead import Lead
from vehsim.pilots.path import RAMP, Route, Timetable
from vehsim.runtime.registry import Registry
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.character import NORMAL

_TILT = 0.6
"""Largest tilt of a helicopter pilot, rad."""
_FULL_TILT = 0.15
"""Attitude error, rad, at which the weaker of roll and pitch reaches its bound: sets the gains."""
_FULL_TURN = 0.5
"""Error of the heading, rad, at which the yaw control moves at its largest rate."""
_OBSERVER = 2.0
"""Speed of the estimate of wind and other forces, rad/s."""
_SIDE = 1.0
"""Speed of the average of a helicopter's own forces across its rotor's axis, rad/s."""
_TURN_RATE = 0.6
"""Yaw rate of a helicopter pilot, rad/s."""
_PLACE, _HEADING = 0.5, float(np.deg2rad(5.0))
"""Tolerance of a helicopter pilot's place, m, and heading, rad, at the end; it allows for gusts."""
_FASTER = 1.03
"""Factor by which feedback may exceed the requested speed."""
_CRUISE = 0.96
"""Share of the requested speed at which a helicopter's flight is planned; the rest is for feedback against the wind."""
_STOP, _BESIDE = 0.25, 0.2
"""Tolerance of a car's root at the end of its path, m, and of its axle's distance from the path, in wheelbases."""
_DRIVE = (2.0, 0.8)
"""Largest acceleration of a car's pilot, m/s^2, and the share of its torque that it plans with."""
_BEND = 2.5
"""Largest acceleration of a car's pilot sideways, m/s^2."""
_EASE = 2.0
"""Time over which a car's pilot changes its acceleration if nothing limits the rate of its torque, s."""
_HANDS = 0.15
"""Time in which a car's pilot changes the rate of its steering, s; from ``_ROLLS`` m/s on, it uses the full rate."""
_ROLLS = 1.0
_HURRY, _OFF = 2.0, 0.1
"""Where its steering is off by more than ``_OFF``, as a tangent, it steers faster: at twice that, by ``_HURRY`` times
its rate."""
_AHEAD = 0.6
"""How far ahead a car's pilot aims, beside the wheelbase, s."""
_PLACES, _SPEEDS = 0.5, 4.0
"""Feedback of a car's pilot: speed per error of its place, 1/s, and acceleration per error of its speed, 1/s."""


class Hover:
    """Holds a helicopter's rig root at ``position`` (3,) m with ``heading`` rad (yaw of its nose from world X).

    Steady wind and other constant forces are compensated: the error converges to zero.
    """

    def __init__(self, vehicle: Vehicle, position: Any, heading: float = 0.0):
        self._law = _Helicopter(vehicle)
        self.position = _finite("position", position, (3,), "three numbers, m")
        self.heading = float(_finite("heading", heading, (), "one number, rad"))

    def reset(self) -> None:
        """Clear the memory of an earlier run; simulations call this at their start."""
        self._law.reset()

    def __call__(self, t: float, state: State) -> Array:
        still = np.zeros(3)
        return self._law(t, state, self.position, still, still, self.heading)

    def targets(self, duration: float) -> list[dict[str, Any]]:
        """The place within 0.5 m and the heading within 5 degrees, at the end."""
        return [_reach(self.position, _PLACE), _face(self.heading)]


class FlyTo:
    """Flies a helicopter's rig root to ``position`` (3,) m, or through ``waypoints`` (n, 3) m, and hovers there.

    ``speed`` m/s along the path, slower in bends; ``heading`` rad at all times, or None: the nose points along the
    flight and keeps its heading at the end. The route is a smooth curve from the start.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        position: Any = None,
        waypoints: Any = None,
        heading: float | None = None,
        speed: float = 10.0,
    ):
        self._law = _Helicopter(vehicle)
        if (position is None) == (waypoints is None):
            raise InputError(
                "not one of position and waypoints",
                "give either position (one goal, m) or waypoints (n, 3), m",
                key="fly_to",
            )
        goals = position if waypoints is None else waypoints
        key = "position" if waypoints is None else "waypoints"
        self.waypoints = np.atleast_2d(_finite(key, goals, None, "three numbers a point, m"))
        if self.waypoints.shape[1] != 3:
            raise InputError("not points", "give three numbers per point, m", key=key, value=goals)
        self.heading = None if heading is None else float(_finite("heading", heading, (), "one number, rad"))
        self.speed = _positive("speed", speed)
        self.reset()

    def reset(self) -> None:
        """Clear the memory of an earlier run; simulations call this at their start."""
        self._law.reset()
        self._route: Route | None = None
        self._times: Timetable | None = None
        self._heading: float | None = None
        self._fast = 0.0

    def targets(self, duration: float) -> list[dict[str, Any]]:
        """The last place within 0.5 m, a given heading within 5 degrees; the speed within 3 %.

        A start faster than ``speed`` is slowed down first, at a tenth of gravity.
        """
        settling = 2.0 * self._law.ease
        needs = {} if self._times is None else {"needs": self._times.duration + settling}
        found = [_reach(self.waypoints[-1], _PLACE) | needs]
        begin = self._fast / (0.1 * GRAVITY) + settling if self._fast else 0.0
        found.append({"key": "pilot.speed", "kind": "speed", "upper": _FASTER * self.speed, "from": begin})
        return found + ([] if self.heading is None else [_face(self.heading)])

    def __call__(self, t: float, state: State) -> Array:
        if self._route is None or self._times is None:
            self._begin = t
            start = np.asarray(state.position, float)
            points = np.vstack([start, self.waypoints])
            self._route = Route(
                points, _CRUISE * self.speed, acceleration=0.1 * GRAVITY, lateral=0.2 * GRAVITY, ease=self._law.ease
            )
            self._times = self._route.timetable()
            moving = 0.0 if state.twist is None else float(np.linalg.norm(np.asarray(state.twist, float)[3:6]))
            self._fast = max(0.0, moving - self.speed)
        since = t - self._begin
        position, velocity, _ = self._route.at(*self._times.at(since))
        _, then, acceleration = self._route.at(*self._times.at(since + self._law.lag))  # the vehicle has to tilt first
        acceleration = acceleration - self._law.drag(_matrix(state.orientation), then)
        heading = self.heading
        if heading is None:
            ahead = np.hypot(*velocity[:2]) > 0.05 * self.speed
            if ahead or self._heading is None:
                self._heading = float(np.arctan2(*velocity[1::-1])) if ahead else _yaw(_matrix(state.orientation))
            heading = self._heading
        return self._law(t, state, position, velocity, acceleration, heading)


class FollowPath:
    """Drives a car's rear axle along the smooth curve through ``points`` (n, 2) m; its root stops at the last one.

    ``speed`` m/s along the path, less in bends (2.5 m/s^2 sideways). Pure pursuit. Steering and torque change at most
    as fast as in the vehicle's character ``normal``; steering faster where the car is far off its path. The car may
    start anywhere near the first point.
    """

    def __init__(self, vehicle: Vehicle, points: Any, speed: float = 8.0):
        if not {"torque", "steering_rate"} <= set(vehicle.control_names) or "sigma" not in vehicle.joints:
            raise InputError(
                f"{vehicle.name} is not a car", "it needs controls torque and steering_rate", key="follow_path"
            )
        points = _finite("points", points, None, "two numbers a point, m")
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise InputError(f"shape {points.shape}", "give at least two points of two numbers, m", key="points")
        if np.linalg.norm(np.ptp(points, axis=0)) < 1e-6:
            raise InputError(f"all at {points[0].tolist()}", "give at least two places, m", key="points")
        self.vehicle, self.points, self.speed = vehicle, points, _positive("speed", speed)
        self._offset = vehicle.origin[:2]
        self._length, self._per_torque = _car_numbers(vehicle)
        torque, steering = (vehicle.controls[vehicle.control_names.index(n)] for n in ("torque", "steering_rate"))
        most = _DRIVE[1] * min(torque.upper, -torque.lower) * self._per_torque(0.0)
        self._acceleration = min(_DRIVE[0], most)
        traits = vehicle.character
        rates = [torque.actuator.rate / 2] + [t.of(NORMAL) for n, t in traits.control_rates.items() if n == "torque"]
        self._foot = min(rates)
        jerk = self._foot * self._per_torque(0.0)
        ease = 2 * self._acceleration / (1 - RAMP) / jerk if np.isfinite(jerk) else _EASE
        angles = [t.of(NORMAL) for n, t in traits.limits.items() if n == "steering_rate"]
        self._hands = min([steering.upper, -steering.lower, *angles])
        self._route = Route(points, self.speed, acceleration=self._acceleration, lateral=_BEND, ease=ease)
        self._lead = Lead(vehicle)
        self.reset()

    def reset(self) -> None:
        """Clear the memory of an earlier run; simulations call this at their start."""
        self._along, self._place, self._integral, self._turning = 0.0, 0.0, 0.0, 0.0
        self._torque: float | None = None
        self._begin, self._time = 0.0, 0.0
        self._times: Timetable | None = None
        self._fast, self._away = 0.0, 0.0
        self._lead.reset()

    def targets(self, duration: float) -> list[dict[str, Any]]:
        """The root at the end of the path within 0.25 m, the axle within a fifth of the wheelbase of the path, the
        speed within 5 %.

        From a start beside the path or too fast, these hold after some time.
        """
        end = [*map(float, self.points[-1]), None]
        ahead = self._length + 0.6 * self.speed
        beside = _BESIDE * self._length
        joins = 0.0 if self._away < beside / 2 else 3.0 * (self._away + ahead) / self.speed
        slows = 0.0 if self._fast <= 0 else self._fast / self._acceleration + 2.0
        behind = self._route.point(0.0) - 3 * self._tail()
        return [
            _reach(end, _STOP) | ({} if self._times is None else {"needs": self._times.duration + 1.0 + joins}),
            {"key": "pilot.speed", "kind": "speed", "upper": 1.05 * self.speed, "from": slows},
            {
                "key": "pilot.path",
                "kind": "path",
                "points": [[*map(float, point), 0.0] for point in [behind, *self._route.places()]],
                "tolerance": beside,
                "offset": [*map(float, self._offset), 0.0],
                "from": joins,
            },
        ]

    def __call__(self, t: float, state: State) -> Array:
        rotation = _matrix(state.orientation)[:2, :2]
        axle = np.asarray(state.position, float)[:2] + rotation @ self._offset
        speed = float(state.twist[1]) if state.twist is not None else 0.0
        root = np.asarray(state.position, float)[:2]
        if self._times is None:
            before = self._route.point(0.0) - np.outer(np.linspace(3, 0, 40), self._tail())
            self._away = float(np.linalg.norm(np.vstack([before, self._route.places(0.1)]) - axle, axis=1).min())
            self._fast = speed - self.speed
            self._place = self._route.nearest(root, 0.0, reach=self._route.length)
            self._times = self._route.timetable(self._place, max(speed, 0.0))
            self._begin = self._time = t
        dt, self._time = t - self._time, t
        sigma = float(state.joints[self.vehicle.joints.index("sigma")]) if state.joints is not None else 0.0
        reach = 2.0 + 4 * abs(speed) * max(dt, 1 / 240)
        self._along = self._route.nearest(axle, self._along, reach)
        self._place = self._route.nearest(root, self._place, reach)
        torque = self._drive(dt, self._times.at(t - self._begin), speed, sigma)
        controls = {"steering_rate": self._steer(dt, axle, rotation, speed, sigma), "torque": torque}
        return self._lead(t, np.array([controls[name] for name in self.vehicle.control_names]))

    def _tail(self) -> Array:
        """From the axle to the root, (2,) m, for a car that stands at the first point, aligned with the path."""
        return float(np.linalg.norm(self._offset)) * self._route.direction()

    def _steer(self, dt: float, axle: Array, rotation: Array, speed: float, sigma: float) -> float:
        """Pure pursuit: the arc through a point one look-ahead ahead has curvature ``2 y / d^2``."""
        ahead = self._length + _AHEAD * abs(speed)
        aim = rotation.T @ (self._route.point(self._along + ahead) - axle)
        wanted = self._length * 2 * aim[1] / max(aim @ aim, 1e-6)
        # no more than the hands can take back in time, or the car would swing from side to side of its path
        bend, room = self._length * self._route.bend(self._along + ahead / 2), (1 + _HURRY) * _AHEAD * self._hands
        wanted = np.clip(wanted, bend - room, bend + room)
        lower, upper = self.vehicle.joint_limits.get("sigma", (-1.0, 1.0))
        off = float(np.clip(wanted, lower, upper)) - sigma
        hurry = 1 + _HURRY * np.clip(abs(off) / _OFF - 1, 0.0, 1.0)
        most = hurry * self._hands * (1 + sigma**2) * min(abs(speed) / _ROLLS, 1.0)
        rate = np.clip(6.0 * off, -most, most)
        self._turning += (1 - np.exp(-dt / _HANDS)) * (float(rate) - self._turning)
        return self._turning

    def _drive(self, dt: float, planned: tuple[float, float, float], speed: float, sigma: float) -> float:
        place, wanted, push = planned
        error = wanted + _PLACES * (place - self._place) - speed
        control = self.vehicle.controls[self.vehicle.control_names.index("torque")]
        torque = (push + _SPEEDS * error + self._integral) / self._per_torque(sigma)
        before = torque if self._torque is None else self._torque
        lower, upper = max(control.lower, before - self._foot * dt), min(control.upper, before + self._foot * dt)
        if lower < torque < upper:  # no integrator wind-up at the bounds
            self._integral += _SPEEDS * error * dt
        self._torque = float(np.clip(torque, lower, upper))
        return self._torque


class _Helicopter:
    """Geometric tracking: desired force, then attitude, then torque; controls through the inverse of LIE's F(gamma).

    Gains place the four poles of the hover at one frequency, as fast as the weaker of roll and pitch allows. An
    observer estimates forces other than the vehicle's own (wind), so that steady wind leaves no error. It would lag
    behind drag, which changes with the speed, so drag in still air is a feed-forward term. Tilting the thrust also
    pushes sideways; therefore the steered point is ``J / (m d_t)`` below the centre of mass, where this has no effect.
    """

    def __init__(self, vehicle: Vehicle):
        wrench = getattr(vehicle, "wrench", None)
        if vehicle.control_names != ("collective", "yaw", "pitch", "roll") or wrench is None:
            raise InputError(
                "is not a helicopter", "it needs controls collective, yaw, pitch, roll", subject=vehicle.name
            )
        self.vehicle = vehicle
        inertia = np.asarray(vehicle.inertia)  # type: ignore[attr-defined]  # a rigid body has it
        self.mass, self.J = float(inertia[5, 5]), inertia[:3, :3]
        self.gravity = float(vehicle.gravity)  # type: ignore[attr-defined]  # a rigid body has it
        self._applied = _applied_wrench(vehicle)
        law = getattr(vehicle, "drag", None)
        self._drag = None if law is None else _function(law, 6)
        weight = self.mass * self.gravity
        slope = np.asarray(self._applied([weight, 0.0, 0.0, 0.0], np.zeros(6))[1])
        self.d_t = float(slope[1, 2] / weight)  # with the moment of a stiff hub
        self.lower = np.array([c.lower for c in vehicle.controls])
        self.upper = np.array([c.upper for c in vehicle.controls])
        tilt = np.sin(np.clip(self.upper[2:], 0.01, 0.5)).min()
        strongest = self.d_t * self.mass * self.gravity * tilt / max(self.J[0, 0], self.J[1, 1])
        self.pole = float(np.clip(np.sqrt(strongest / _FULL_TILT / 6), 0.2, 2.5))
        quickest = vehicle.controls[1].actuator.rate * abs(slope[2, 1]) / self.J[2, 2]
        self.poles = np.array([self.pole, self.pole, min(self.pole, np.cbrt(quickest / _FULL_TURN / 6))])
        self.ease, self.lag = 3.0 / self.pole, 2.0 / (3.0 * self.pole)
        self._lead = Lead(vehicle)
        self.reset()

    def reset(self) -> None:
        """Clear the memory of an earlier run; simulations call this at their start."""
        self._heading: float | None = None
        self._time: float | None = None
        self._push, self._side = np.zeros(3), np.zeros(3)
        self._lead.reset()

    def drag(self, R: Array, velocity: Array) -> Array:
        """Acceleration (3,) by drag in still air at a world velocity (3,), m/s, and an attitude."""
        if self._drag is None:
            return np.zeros(3)
        wrench = np.asarray(self._drag(np.concatenate([np.zeros(3), R.T @ velocity]))).ravel()
        return np.asarray(R @ wrench[3:6] / self.mass)

    def __call__(
        self, t: float, state: State, goal: Array, velocity: Array, acceleration: Array, heading: float
    ) -> Array:
        """Controls for a reference: ``acceleration`` is that due to thrust and wind, without drag."""
        dt = 0.0 if self._time is None else t - self._time
        self._time = t
        R = _matrix(state.orientation)
        twist = np.zeros(6) if state.twist is None else np.asarray(state.twist, float)
        origin, omega = self.vehicle.origin, twist[:3]
        moving = R @ (twist[3:6] + np.cross(omega, origin))
        push = self._observe(dt, moving, self.drag(R, moving)) + R @ self._side / self.mass
        nose = self._turn(heading, _yaw(R), dt)
        steady = _attitude(self._limited(acceleration - push), nose)

        # the steered point: in hover, only the thrust accelerates it
        level = _about_z(nose)
        lever = level @ np.diag([self.J[1, 1], self.J[0, 0], 0.0]) @ level.T / (self.mass * self.d_t)
        centre = np.asarray(state.position, float) - goal + (R - steady) @ origin
        point = centre - lever @ (R - steady)[:, 2]
        speed = moving - velocity - lever @ (R @ np.cross(omega, [0.0, 0.0, 1.0]))
        force = self._limited(acceleration - push - self._pull(point, speed))

        torque = self._torque(R, _attitude(self.mass * force, nose), omega)
        air = np.concatenate([omega, R.T @ moving])
        controls = self._controls(torque, self.mass * float(force @ R[:, 2]), air)
        own = np.asarray(self._applied(controls, air)[0]).ravel()[3:6]
        self._own = R @ own / self.mass - [0.0, 0.0, self.gravity]
        # the tail rotor's push and the steady tilt against it, not the tilt that turns the helicopter
        self._side += (1 - np.exp(-_SIDE * dt)) * (own * [1.0, 1.0, 0.0] - self._side)
        return self._lead(t, controls)

    def _observe(self, dt: float, moving: Array, drag: Array) -> Array:
        """Acceleration (3,) that controls, gravity and ``drag`` do not explain: a Luenberger observer on the
        velocity."""
        if dt <= 0:
            self._moving = moving
            return self._push
        predicted = self._moving + dt * (self._own + drag + self._push)
        wrong = moving - predicted
        self._moving = predicted + 2 * _OBSERVER * dt * wrong
        self._push = self._push + _OBSERVER**2 * dt * wrong
        return self._push

    def _turn(self, heading: float, yaw: float, dt: float) -> float:
        """Turn the reference heading of the nose to ``heading``, in the shorter direction and at most at the
        turn rate."""
        if self._heading is None:
            self._heading = yaw
        step = np.arctan2(np.sin(heading - self._heading), np.cos(heading - self._heading))
        self._heading += float(np.clip(step, -_TURN_RATE * dt, _TURN_RATE * dt))
        return self._heading

    def _pull(self, point: Array, speed: Array) -> Array:
        """PD on position, m/s^2; the pull is bounded, so that the vehicle arrives at a bounded speed."""
        pull = self.pole**2 / 6 * point
        size, most = float(np.linalg.norm(pull)), 0.25 * self.gravity
        return pull * min(1.0, most / max(size, 1e-9)) + 2 * self.pole / 3 * speed

    def _limited(self, acceleration: Array) -> Array:
        """Thrust per mass (3,) for an acceleration, m/s^2, at least 0.3 g upwards and with a bounded tilt."""
        up = max(acceleration[2] + self.gravity, 0.3 * self.gravity)
        across = np.hypot(*acceleration[:2])
        share = min(1.0, np.tan(_TILT) * up / max(across, 1e-9))
        return np.array([share * acceleration[0], share * acceleration[1], up])

    def _torque(self, R: Array, wanted: Array, omega: Array) -> Array:
        """Body torque (3,) N m that turns ``R`` to ``wanted`` (Lee's error on SO(3), at full strength for any
        angle)."""
        skew = wanted.T @ R - R.T @ wanted
        error = np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / 2
        # sin(angle) decreases beyond a right angle: rescale so that the torque does not
        angle = np.arccos(np.clip((np.trace(wanted.T @ R) - 1) / 2, -1.0, 1.0))
        sine = np.linalg.norm(error)
        error = error * (angle / sine) if sine > 1e-6 else error + (angle > 1) * np.array([np.pi, 0.0, 0.0])
        p = self.poles
        return np.cross(omega, self.J @ omega) - self.J @ (6 * p**2 * error + 4 * p * omega)

    def _controls(self, torque: Array, thrust: float, air: Array) -> Array:
        """Controls (4,) for a torque (3,) and a force along body Z at a twist ``air`` (6,) against still air, within
        their bounds, by Newton's method."""
        lift = float(np.clip(thrust, max(self.lower[0], 0.2 * self.mass * self.gravity), self.upper[0]))
        damped = np.zeros(3) if self._drag is None else np.asarray(self._drag(air)).ravel()[:3]
        wanted, controls = np.append(torque - damped, lift), np.array([lift, 0.0, 0.0, 0.0])
        for _ in range(3):
            given, slope = self._applied(controls, air)
            rows = np.array([0, 1, 2, 5])
            off = wanted - np.asarray(given).ravel()[rows]
            controls = controls + np.linalg.solve(np.asarray(slope)[rows], off)
            controls[2:] = np.clip(controls[2:], -1.1, 1.1)
        return np.clip(controls, self.lower, self.upper)


PILOTS: Registry[type] = Registry(
    "vehsim.pilots", {"hover": Hover, "fly_to": FlyTo, "follow_path": FollowPath, "gait": Gait}
)
"""Name in a shot file -> pilot. Parameters are the keyword arguments after ``vehicle``, in SI units and radians."""


def _reach(position: Any, tolerance: float) -> dict[str, Any]:
    place = [None if x is None else float(x) for x in position]
    return {"key": "pilot.position", "kind": "reach", "position": place, "tolerance": tolerance, "at": "end"}


def _face(heading: float) -> dict[str, Any]:
    return {"key": "pilot.heading", "kind": "heading", "heading": heading, "tolerance": _HEADING, "at": "end"}


def _car_numbers(vehicle: Vehicle) -> tuple[float, Any]:
    """Wheelbase, m, and a function sigma -> forward acceleration per torque, m/s^2 per N m, from the vehicle itself."""
    joints = np.zeros(len(vehicle.joints))
    sigma, torque = vehicle.joints.index("sigma"), vehicle.control_names.index("torque")

    connection = _function(vehicle.connection, len(joints))

    def at(value: float) -> tuple[Array, float]:
        joints[sigma] = value
        lift = np.array(connection(joints))
        wheel = int(np.argmax(np.abs(lift[1])))
        _, b = vehicle.linearize(State(joints=joints.copy()), np.zeros(len(vehicle.controls)))
        return lift[:, wheel], -lift[1, wheel] * b[-1, torque]

    column, _ = at(0.1)
    grid = np.linspace(-1.5, 1.5, 31)
    gain = np.array([at(value)[1] for value in grid])
    return float(0.1 * column[1] / column[0]), lambda value: float(np.interp(value, grid, gain))


def _applied_wrench(vehicle: Any) -> Any:
    """A function of a helicopter's controls (4,) and its body twist against the air (6,): the body wrench (6,) that
    they apply, and its derivative by the controls."""
    import casadi as ca

    c, air = ca.SX.sym("c", 4), ca.SX.sym("air", 6)
    wrench = ca.SX(vehicle.wrench(c))
    if vehicle.rotors is not None:
        far = ca.SX(np.inf)  # feedback makes up for the ground's cushion
        wrench[:3] += ca.SX(vehicle.rotors(air, c, far))
    return ca.Function("applied", [c, air], [ca.densify(wrench), ca.densify(ca.jacobian(wrench, c))])


def _function(law: Any, size: int) -> Any:
    import casadi as ca

    symbol = ca.SX.sym("x", size)
    return ca.Function("f", [symbol], [ca.densify(ca.SX(law(symbol)))])


def _matrix(q: Any) -> Array:
    return matrices(np.asarray(q, float) / np.linalg.norm(q))


def _about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _yaw(R: Array) -> float:
    """Heading of a rotation, rad; if the nose points up or down, that of its Y axis minus a right angle."""
    if np.hypot(R[0, 0], R[1, 0]) > 0.1:
        return float(np.arctan2(R[1, 0], R[0, 0]))
    return float(np.arctan2(-R[0, 1], R[1, 1]))


def _attitude(force: Array, heading: float) -> Array:
    """The rotation whose Z axis is along ``force`` and whose X axis points along ``heading``; force points upwards."""
    up = force / np.linalg.norm(force)
    left = np.cross(up, [np.cos(heading), np.sin(heading), 0.0])
    left /= np.linalg.norm(left)
    return np.column_stack([np.cross(left, up), left, up])


def _finite(key: str, values: Any, shape: tuple[int, ...] | None, remedy: str) -> Array:
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        array = np.full((), np.nan)
    if (shape is not None and array.shape != shape) or not np.all(np.isfinite(array)):
        raise InputError("of the wrong shape or not finite", f"give {remedy}", key=key, value=values)
    return array


def _positive(key: str, value: Any) -> float:
    number = float(_finite(key, value, (), "a positive number, m/s"))
    if number <= 0:
        raise InputError("not a speed", "give a positive number, m/s", key=key, value=value)
    return number
