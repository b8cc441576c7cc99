"""Upper bounds on the acceleration that a vehicle's controls can cause in any motion, and what follows from them.

A free rigid body in the air: the acceleration of its centre of mass lies in a ball around gravity, which drag enlarges
(`thrust_ball`). Any vehicle: the square root of twice its kinetic energy grows no faster than the norm of the controls'
forces in the inverse inertia, and it bounds the speed of the body frame (`push_of`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.integrators.fast.kernel import Kernel
from vehsim.lie.quaternions import from_yaw
from vehsim.lie.vectorized import for_rows
from vehsim.planning.terms import SLACK
from vehsim.vehicles import Holonomic, Vehicle
from vehsim.vehicles.definition.mechanics import free_size, free_velocity, project
from vehsim.world.ground.slope import Relief

Array = NDArray[np.float64]

SAMPLING_FACTOR = 1.02
"""Safety factor for bounds found by sampling."""
SAMPLES = 600
"""Number of random joints, controls and velocities at which forces are sampled."""
SPEEDS = np.concatenate([[0.0], np.geomspace(0.01, 200.0, 25)])
"""Speeds at which drag and damping are sampled, m/s."""
LEVELS = 5
"""Number of values of each control on the grid at which its forces are sampled."""


@dataclass(frozen=True)
class Push:
    """Bounds (k,) m/s^2 on the change of a vehicle's speed at the speeds `SPEEDS` (k,) m/s.

    ``gain``: by its controls (and wind); ``loss``: by controls, drag and damping together.
    """

    gain: Array
    loss: Array

    @property
    def most(self) -> float:
        """The largest gain, m/s^2."""
        return float(self.gain.max())

    def reach(self, seconds: float, top: float, leave: float, arrive: float) -> float:
        """Upper bound on the distance, m, covered at speeds up to ``top``, from at most ``leave`` to at most ``arrive``
        m/s."""
        if seconds <= 0:
            return 0.0
        if math.isinf(self.most):
            return top * seconds if math.isfinite(top) else math.inf
        t = np.linspace(0.0, seconds, 2001)
        fastest = min(leave + self.most * seconds, top)
        braked = _changed(self.loss, arrive, fastest, t)[::-1]
        speed = np.minimum(np.minimum(_changed(self.gain, leave, fastest, t), braked), top)
        return float(np.trapezoid(speed, t)) * (1 + 1e-6)


def _changed(rates: Array, slow: float, fastest: float, t: Array) -> Array:
    """The largest speeds (n,) m/s that ``t`` (n,) s separate from the speed ``slow``, at ``rates`` (k,) m/s^2; inf
    above ``fastest``."""
    if math.isinf(slow):
        return np.full(len(t), math.inf)
    if np.allclose(rates, rates[0]):
        return np.asarray(slow + float(rates[0]) * t)
    high = min(max(fastest, slow) + 1e-3, float(SPEEDS[-1]))
    speed = np.linspace(slow, max(high, slow + 1e-3), 2001)
    taking = 1 / np.interp(speed, SPEEDS, rates)
    taken = np.concatenate([[0.0], np.cumsum((taking[1:] + taking[:-1]) / 2 * np.diff(speed))])
    return np.where(t <= taken[-1], np.interp(t, taken, speed), math.inf)


def uniform(gain: float, loss: float) -> Push:
    """The same bounds, m/s^2, at all speeds."""
    return Push(np.full(len(SPEEDS), gain), np.full(len(SPEEDS), loss))


UNBOUNDED = uniform(math.inf, math.inf)


def gripping(grip: float, relief: Relief | None) -> Push:
    """Bounds by the ``grip``, in g, that tyres may need on a ``relief``; None: on level ground.

    On a slope ``s``, under the load ``n`` g, gravity and friction change the horizontal velocity by up to ``(grip + s)
    n g``; in a hollow the load grows with the squared speed. The tolerance of limits is added.
    """
    slope, bend = (0.0, 0.0) if relief is None else relief.steepest()
    most = (1 + SLACK) * (grip + slope) * (GRAVITY + bend * SPEEDS**2)
    return Push(most, most)


@dataclass(frozen=True)
class Ball:
    """Accelerations (3,) m/s^2 within ``radius`` of ``centre``."""

    centre: Array
    radius: float

    def rules_out(self, displacement: Array, room: float, seconds: float, leave: Any, arrive: Any) -> bool:
        """Whether no such accelerations lead along ``displacement`` (3,) m, to within ``room`` m of its end, in
        ``seconds``.

        ``leave``, ``arrive``: velocities (3,) m/s, a largest speed, or inf if free. The proof is by duality: a simplex
        search looks for a linear function of the motion's ends that no such acceleration can reach.
        """
        if not (math.isfinite(self.radius) and seconds > 0) or self._leads(displacement, seconds, leave, arrive):
            return False
        t = np.linspace(0.0, seconds, 65)

        def gap(values: Array) -> float:
            along, final = values[:3], values[3:].copy()
            size = np.linalg.norm(along)
            if size < 1e-9:
                return 1.0
            along = along / size
            if np.ndim(arrive) == 0 and math.isinf(arrive):
                final[:] = 0.0
            if np.ndim(leave) == 0 and math.isinf(leave):
                final = -along * seconds
                if np.ndim(arrive) == 0 and math.isinf(arrive):
                    return 1.0
            first = along * seconds + final
            ends = _most(first, leave) + _most(-final, arrive)
            weights = along[None] * (seconds - t)[:, None] + final
            done = self.radius * np.linalg.norm(weights, axis=1) + weights @ self.centre
            # the norm is convex in time, so the trapezoidal rule is an upper bound
            return float(ends + np.trapezoid(done, t) + room - along @ displacement)

        from scipy.optimize import minimize

        direction = displacement / max(float(np.linalg.norm(displacement)), 1e-9)
        start = np.concatenate([direction, -direction * seconds / 2])
        for lift in (0.0, 0.3 * seconds, -0.3 * seconds):
            begin = start + np.array([0, 0, 0, 0, 0, lift])
            found = minimize(gap, begin, method="Nelder-Mead", options={"maxfev": 600, "fatol": 1e-6, "xatol": 1e-6})
            if found.fun < -1e-6 * max(1.0, float(np.linalg.norm(displacement))):
                return True
        return False

    def _leads(self, displacement: Array, seconds: float, leave: Any, arrive: Any) -> bool:
        """Whether two accelerations, one in each half of the time, lead along ``displacement``."""
        first, last = (_chosen(speed, displacement / seconds) for speed in (leave, arrive))
        change, pull = (last - first) / seconds, 4 * (displacement - first * seconds) / seconds**2
        accelerations = np.array([pull - change, 3 * change - pull])
        return bool(np.linalg.norm(accelerations - self.centre, axis=1).max() <= self.radius)


def _chosen(velocity: Any, wanted: Array) -> Array:
    """A given velocity (3,) m/s; of those up to a speed, the nearest one to ``wanted``."""
    if np.ndim(velocity):
        return np.asarray(velocity, float)
    speed = float(np.linalg.norm(wanted))
    return wanted * (min(1.0, float(velocity) / speed) if speed else 1.0)


def _most(weight: Array, velocity: Any) -> float:
    """Largest product of ``weight`` (3,) with a velocity: a given one, or any up to a speed."""
    if np.ndim(velocity):
        return float(weight @ velocity)
    return float(velocity * np.linalg.norm(weight)) if np.linalg.norm(weight) > 1e-12 else 0.0


@lru_cache(maxsize=64)
def thrust_ball(vehicle: Vehicle, airspeed: float = 0.0) -> Ball | None:
    """Possible accelerations of a free rigid body's centre of mass; None for any other vehicle.

    ``airspeed``: its largest speed against the air, m/s.
    """
    free = isinstance(vehicle, Holonomic) and vehicle.group.dim == 6 and vehicle.hull is None
    if not free or vehicle.resistance is not None:  # type: ignore[attr-defined]  # `Holonomic` has it
        return None
    assert isinstance(vehicle, Holonomic)
    linear = vehicle.inertia[3:, 3:]
    mass = float(np.linalg.eigvalsh(linear).min())
    if np.ptp(np.diag(linear)) > 1e-9 * mass or np.any(vehicle.inertia[:3, 3:]):
        return None
    c = ca.SX.sym("c", len(vehicle.controls))
    wrench: Any = ca.SX.zeros(6) if vehicle.wrench is None else ca.vertcat(vehicle.wrench(c))
    most = _largest(ca.Function("force", [c], [ca.densify(wrench[3:6])]), vehicle)
    weight = vehicle.gravity * (mass if vehicle.mass is None else vehicle.mass)
    return Ball(np.array([0.0, 0.0, -weight / mass]), (most + SAMPLING_FACTOR * vehicle.largest_drag(airspeed)) / mass)


def strength(vehicle: Vehicle) -> float:
    """Upper bound on a vehicle's acceleration in any direction, m/s^2, from its controls; inf if none is known."""
    ball = thrust_ball(vehicle)
    if ball is not None:
        return float(np.linalg.norm(ball.centre)) + ball.radius
    return push_of(vehicle, (0.0, 0.0, 0.0), 0.0).most


def _largest(force: ca.Function, vehicle: Vehicle) -> float:
    """The largest norm of a force of the controls within their bounds; inf if these are infinite."""
    bounds = np.array([[control.lower, control.upper] for control in vehicle.controls]).reshape(-1, 2)
    if not np.all(np.isfinite(bounds)):
        return math.inf
    points = _grid(bounds)
    norms = np.linalg.norm(np.array(force.map(len(points))(points.T)), axis=0)
    corners = {tuple(point) for point in product(*bounds)} if len(bounds) <= 6 else set()
    exact = tuple(points[int(np.argmax(norms))]) in corners
    return float(norms.max()) * (1.0 if exact else SAMPLING_FACTOR)


def _grid(bounds: Array) -> Array:
    """Points (n, k) of a box (k, 2): a grid if that is small, otherwise some corners and random points."""
    if not len(bounds):
        return np.zeros((1, 0))
    if len(bounds) <= 4:
        return np.array(list(product(*(np.linspace(low, high, LEVELS) for low, high in bounds))))
    random = np.random.default_rng(0)
    corner = random.integers(0, 2, (2000, len(bounds)))
    inside = random.uniform(size=(500, len(bounds)))
    return np.asarray(bounds[:, 0] + np.vstack([corner, inside]) * (bounds[:, 1] - bounds[:, 0]))


@lru_cache(maxsize=64)
def push_of(vehicle: Vehicle, wind: tuple[float, ...], slope: float) -> Push:
    """Bounds on the change of speed of a vehicle's body frame in a ``wind`` (3,) m/s on ground of a ``slope``, m/m.

    With ``q`` the square root of twice its kinetic energy, ``dq/dt`` is the forces' power over ``q``: at most their
    norm in the inverse inertia. Forces are sampled over the controls' and joints' bounds, with `SAMPLING_FACTOR`. The
    bound is infinite if joints driven at a rate, springs or controls without bounds add energy.
    """
    bounds = np.array([[control.lower, control.upper] for control in vehicle.controls]).reshape(-1, 2)
    forces = [i for i, control in enumerate(vehicle.controls) if control.name not in vehicle.rate_controls]
    if vehicle.group.fixed or not np.all(np.isfinite(bounds[forces])) or _other_energy(vehicle):
        return UNBOUNDED
    laws = _laws(vehicle)
    random = np.random.default_rng(0)
    grid = np.zeros((len(_grid(bounds[forces])), len(bounds)))
    grid[:, forces] = _grid(bounds[forces])
    joints = _joints(vehicle, random, 64)
    inertias, motions = for_rows(laws["inertia"], np.array(joints))
    n, here = inertias.shape[1], _turned(vehicle, 0.0)
    values, vectors = np.linalg.eigh((inertias + inertias.transpose(0, 2, 1)) / 2)
    if not n or np.any(values.min(axis=1) <= 1e-12 * values.max(axis=1)):
        return UNBOUNDED
    roots = vectors / np.sqrt(values)[:, None] @ vectors.transpose(0, 2, 1)
    fastest = float(np.linalg.norm(motions @ roots, 2, axis=(1, 2)).max())
    still, calm = np.zeros(n), np.zeros(3)
    # all at once: a call for each of these rows would cost more than the rows themselves
    force, shapes = Kernel(laws["force"]), np.array(joints)
    each, count = np.repeat(shapes, len(grid), axis=0), len(shapes)
    pushes = _rows(force, here, each, still, np.tile(grid, (count, 1)), calm).reshape(count, len(grid), n)
    most = float(np.linalg.norm(pushes @ roots, axis=2).max())

    picks = random.integers(0, len(joints), SAMPLES)
    facing = np.array([_turned(vehicle, angle) for angle in random.uniform(-np.pi, np.pi, SAMPLES)])
    controls = grid[random.integers(0, len(grid), SAMPLES)]
    rays = random.normal(size=(SAMPLES, n))
    rays[: 2 * n] = np.vstack([np.eye(n), -np.eye(n)])[: min(2 * n, SAMPLES)]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    shapes, velocities = shapes[picks], np.einsum("kij,kj->ki", roots[picks], rays)
    rest = _rows(force, facing, shapes, still, controls, calm)
    if not any(laws["force"].jac_sparsity(0, k).nnz() for k in (2, 4)):  # neither drag nor damping
        gain = most * fastest * SAMPLING_FACTOR + GRAVITY * slope
        return uniform(gain, gain)
    q, tiled = np.maximum(SPEEDS, 1e-6) / fastest, (len(SPEEDS), 1)
    moving = (q[:, None, None] * velocities).reshape(-1, n)
    given = (np.tile(facing, tiled), np.tile(shapes, tiled), moving, np.tile(controls, tiled), np.array(wind))
    change = _rows(force, *given).reshape(len(SPEEDS), SAMPLES, n) - rest
    power = (change * velocities).sum(axis=2)
    gains, losses = np.maximum(power.max(axis=1), 0.0), np.maximum(-power.min(axis=1), 0.0)
    gain = (most + gains.max()) * fastest * SAMPLING_FACTOR + GRAVITY * slope
    loss = gain + np.maximum.accumulate(losses) * fastest * SAMPLING_FACTOR
    return Push(np.full(len(SPEEDS), gain), loss)


def _rows(kernel: Kernel, *inputs: Array) -> Array:
    """The column of a function for every row (n, .) of its inputs; a single row (.,) is the same for all."""
    n = max(len(a) for a in inputs if a.ndim == 2)
    out = np.empty((n, kernel.function.numel_out(0)))
    kernel.rows([np.broadcast_to(a, (n, a.shape[-1])) for a in inputs], [out])
    return out


def _other_energy(vehicle: Vehicle) -> bool:
    """Whether joints driven at a rate add energy, or energy is stored in springs or, in flight, in height."""
    s, d = len(vehicle.joints), vehicle.group.dim
    r, u, xi = ca.SX.sym("r", s), ca.SX.sym("u", s), ca.SX.sym("xi", d)
    lagrangian = ca.SX(vehicle.reduced_lagrangian(r, u, xi))
    if ca.depends_on(vehicle.reduced_lagrangian(r, ca.SX.zeros(s), ca.SX.zeros(d)) + ca.SX(0), r):
        return True
    if d == 6 and not (isinstance(vehicle, Holonomic) and not vehicle.gravity):
        return True
    driven = [joint for joint, _ in vehicle.driven]
    if not driven:
        return False
    ties = vehicle.connection(r)[:, driven]
    driven_joints = ca.vertcat(*(ca.vertcat(r[i], u[i]) for i in driven))
    return bool(ca.depends_on(lagrangian, driven_joints) or not ca.SX(ties).is_zero())


def _laws(vehicle: Vehicle) -> dict[str, ca.Function]:
    """The vehicle's kinematics and forces, as functions.

    ``twist``: joints -> the body's twist per free velocity; ``inertia``: joints -> inertia of these, and the body
    frame's velocity per free velocity; ``force``: forces along them, from pose, joints, free velocities, controls and
    wind.
    """
    s, n = len(vehicle.joints), free_size(vehicle)
    g, r, z = ca.SX.sym("g", vehicle.group.size), ca.SX.sym("r", s), ca.SX.sym("z", n)
    c, wind = ca.SX.sym("c", len(vehicle.controls)), ca.SX.sym("wind", 3)
    u, xi = free_velocity(vehicle, r, z, ca.SX(s, 1))
    inertia = ca.hessian(vehicle.reduced_lagrangian(r, u, xi), z)[0]
    turning = {6: 3, 3: 1}[vehicle.group.dim]
    moves = ca.jacobian(xi[turning:], z)
    forces = project(vehicle, r, *vehicle.force(g, r, u, xi, c, wind))
    return {
        "twist": ca.Function("twist", [r], [ca.densify(ca.jacobian(xi, z))]),
        "inertia": ca.Function("inertia", [r], [ca.densify(inertia), ca.densify(moves)]),
        "force": ca.Function("force", [g, r, z, c, wind], [ca.densify(forces)]),
    }


def _joints(vehicle: Vehicle, random: Any, count: int) -> list[Array]:
    """Joint values (s,): all zero, at their limits, and between; joints without limits cover one turn."""
    limits = [vehicle.joint_limits.get(joint, (-np.inf, np.inf)) for joint in vehicle.joints]
    ends = [(a, b) if np.isfinite([a, b]).all() else (-np.pi, np.pi) for a, b in limits]
    if not ends:
        return [np.zeros(0)]
    corners = [np.array(point) for point in product(*ends)][:64]
    inside = [np.array([random.uniform(a, b) for a, b in ends]) for _ in range(count)]
    return [np.zeros(len(ends)), *corners, *inside]


def _turned(vehicle: Vehicle, angle: float) -> Array:
    """The group element of a body at the origin, rotated about Z."""
    if vehicle.group.planar:
        return np.array([angle, 0.0, 0.0])
    pose = np.concatenate([np.zeros(3), from_yaw(angle)])
    return np.ravel(np.asarray(vehicle.group.from_pose(pose[None])))


@lru_cache(maxsize=64)
def slips(vehicle: Vehicle) -> tuple[bool, float]:
    """Whether a planar vehicle may move in any direction; and the largest angle, deg, between its root's velocity and
    the body's X axis, forwards or backwards, over its joints' limits."""
    moves = _laws(vehicle)["twist"]
    x, y = vehicle.origin[:2]
    most = 0.0
    for r in _joints(vehicle, np.random.default_rng(0), 400):
        twists = np.array(moves(r))
        roots = np.array([twists[1] + twists[0] * y, twists[2] - twists[0] * x])
        if np.linalg.matrix_rank(roots, tol=1e-6) != 1:
            return True, 180.0
        velocity = roots[:, int(np.argmax(np.linalg.norm(roots, axis=0)))]
        most = max(most, math.degrees(math.atan2(abs(velocity[1]), abs(velocity[0]))))
    return False, most


def least_time(reach: Callable[[float], float], distance: float, high: float = 1e5) -> float:
    """The smallest time, s, at which an increasing ``reach`` equals ``distance`` m; inf beyond ``high``."""
    low, top = 0.0, 1.0
    while reach(top) < distance:
        low, top = top, 2 * top
        if top > high:
            return math.inf
    for _ in range(50):
        middle = (low + top) / 2
        low, top = (middle, top) if reach(middle) < distance else (low, middle)
    return top


def polyline(points: Sequence[Any]) -> float:
    """The length, m, of the straight lines between consecutive places."""
    places = np.asarray(points, float)
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
