"""Stage variables: the quantities that laws of costs and constraints use, as expressions of a problem's variables.

A knot's view is computed from its state, or from a segment's velocity at its midpoint; a segment's view has two of
them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import casadi as ca

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.lie import SO3, difference_map
from vehsim.planning.problem.elements import SpatialField
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.terms import Cost, KnotView, SegmentView, Term
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.mechanics import free_velocity
from vehsim.vehicles.definition.states import shift_twist

Expr = Any

UNKNOWN = ca.SX.sym("acceleration", 3)
"""Placeholder for the acceleration, which is unknown at a single knot: laws that use it are evaluated on segments."""


def knot_view(transcription: Transcription, x: Expr, c: Expr, time: Expr = 0.0) -> KnotView:
    """The view of a state ``x`` with controls ``c`` over their scale."""
    g, r, pi = transcription.split(x)
    c = c * transcription.control_scale
    u, xi = transcription.mechanics.knot_velocity(r, pi, c)
    return _view(transcription.vehicle, transcription.vehicle.group.normalize(g), r, u, xi, c, time)


def middle_view(transcription: Transcription, x: Expr, z: Expr, c: Expr, h: Expr, time: Expr = 0.0) -> KnotView:
    """The view at the midpoint of a segment of length ``h``, from its velocity ``z``; ``c``: its mean controls,
    scaled."""
    vehicle, (g, r, _) = transcription.vehicle, transcription.split(x)
    c = c * transcription.control_scale
    u, xi = free_velocity(vehicle, r, z, transcription.mechanics.driven(c))
    tau = difference_map(transcription.mechanics.map_name, vehicle.group).tau
    return _view(vehicle, vehicle.group.compose(g, tau(h / 2 * xi)), r + h / 2 * u, u, xi, c, time)


def between_view(transcription: Transcription, segment: dict[str, Expr], s: Expr, time: Expr = 0.0) -> KnotView:
    """The view at a fraction ``s`` of a segment (x, x1, c0, c1, h) on the clip's interpolant.

    Positions, joints and rotation vectors are cubic there, controls linear.
    """
    x, x1, c0, c1, h = (segment[name] for name in ("x", "x1", "c0", "c1", "h"))
    a, b = knot_view(transcription, x, c0), knot_view(transcription, x1, c1)
    position, velocity = _cubic(s, h, a.position, b.position, a.velocity, b.velocity)
    acceleration = _bend(s, h, a, b)
    joints, rates = _cubic(s, h, a.joints, b.joints, a.joint_rates, b.joint_rates)
    turn = _rotation_vector(a.rotation.T @ b.rotation)
    turned, slope = _cubic(s, h, ca.SX.zeros(3), turn, a.omega, _unturned(turn, b.omega))
    return KnotView(
        position, velocity, _turning(turned, slope), a.rotation @ _rotation(turned), joints, rates,
        (c0 + s * (c1 - c0)) * transcription.control_scale, a.push + s * (b.push - a.push),
        a.rates + s * (b.rates - a.rates), ca.SX(time), acceleration, transcription.vehicle.joints,
    )  # fmt: skip


def segment_view(
    transcription: Transcription,
    segment: dict[str, Expr],
    time: Expr = 0.0,
    inner: list[tuple[Expr, Expr]] | None = None,
) -> SegmentView:
    """The view of a segment (x, x1, c0, c1, h); ``inner`` receives symbols that stand for the velocities in it, see
    `Element.inner`."""
    x, x1, c0, c1, h = (segment[name] for name in ("x", "x1", "c0", "c1", "h"))
    a, b = knot_view(transcription, x, c0, time), knot_view(transcription, x1, c1, time + h)
    if inner is not None:
        a, b = _apart(a, inner), _apart(b, inner)
    a, b = (replace(view, acceleration=_bend(s, h, a, b)) for s, view in ((0, a), (1, b)))
    return SegmentView(a, b, c0, c1, h)


def _apart(view: KnotView, inner: list[tuple[Expr, Expr]]) -> KnotView:
    """The view in symbols of its velocities, which ``inner`` receives with their expressions."""
    values = {name: value for name in ("velocity", "joint_rates") if (value := getattr(view, name)).shape[0]}
    symbols: dict[str, Any] = {name: ca.SX.sym(name, value.shape[0]) for name, value in values.items()}
    inner += [(symbols[name], value) for name, value in values.items()]
    return replace(view, **symbols)


def clip_view(
    vehicle: Vehicle,
    pose: Expr,
    twist: Expr,
    acceleration: Expr,
    r: Expr,
    u: Expr,
    c: Expr,
    time: Expr,
    slope: Expr,
    lift: Expr,
) -> KnotView:
    """The view of a sample of a clip.

    ``pose`` (7,) and body ``twist`` (d,) of the rig's root, its ``acceleration`` (3,) in the world, joints, their
    rates, and controls, SI; ``slope`` (2,) and ``lift`` of the ground below.
    """
    group = vehicle.group
    body = ca.vertcat(pose[0:3] + SO3.matrix(pose[3:7]) @ ca.DM(vehicle.origin), pose[3:7])
    g = group.from_pose(body)
    xi = group.velocity_from_body(g, group.shift(twist, ca.DM(vehicle.origin)))
    view = _view(vehicle, g, r, u, xi, c, time)
    rotation = SO3.matrix(pose[3:7])
    return replace(view, position=pose[0:3], rotation=rotation, acceleration=acceleration, slope=slope, lift=lift)


@dataclass
class Sloping:
    """Gives the views of an element the slope and bend of the ground below them, as symbols, and collects what these
    are."""

    transcription: Transcription
    _views: list[KnotView] = field(default_factory=list)

    def __call__(self, view: KnotView) -> KnotView:
        if self.transcription.relief is None:
            return view
        self._views.append(replace(view, slope=ca.SX.sym("slope", 2), lift=ca.SX.sym("lift")))
        return self._views[-1]

    def of(self, value: Expr) -> dict[str, Any]:
        """The arguments ``space`` and ``inner`` of an `Element` with this value; none if it does not use slopes."""
        relief = self.transcription.relief
        if relief is None or not ca.depends_on(value, ca.vertcat(*(ca.vertcat(v.slope, v.lift) for v in self._views))):
            return {}
        places = ca.horzcat(*(view.position[0:2] for view in self._views))
        models = ca.SX.sym("models", 2 + relief.CELL, len(self._views))
        inner = []
        for k, view in enumerate(self._views):
            inner.append((view.slope, relief.slope(places[:, k], models[2:, k])))
            inner.append((view.lift, relief.lift(places[:, k], view.velocity[0:2], models[2:, k])))
        return {"space": SpatialField(places, models, lambda count, order: relief.cells(count)), "inner": inner}


def _cubic(s: Expr, h: Expr, a: Expr, b: Expr, da: Expr, db: Expr) -> tuple[Expr, Expr]:
    """The cubic from ``a`` to ``b`` with slopes ``da, db`` over ``h``, and its slope, at ``s`` in 0..1."""
    rise = b - a
    value = a + s * h * da + s**2 * (3 * rise - h * (2 * da + db)) + s**3 * (h * (da + db) - 2 * rise)
    return value, da + 2 * s * (3 * rise / h - 2 * da - db) + 3 * s**2 * (da + db - 2 * rise / h)


def _bend(s: Expr, h: Expr, a: KnotView, b: KnotView) -> Expr:
    """Second derivative of the cubic from ``a`` to ``b``: linear in ``s``."""
    slope = 6 * (b.position - a.position) / h
    first, last = slope - 4 * a.velocity - 2 * b.velocity, 2 * a.velocity + 4 * b.velocity - slope
    return (first + s * (last - first)) / h


TURN = 1e-6
"""Keeps the norm of a rotation vector differentiable at zero, rad."""


def _length(vector: Expr) -> Expr:
    return ca.sqrt(ca.sumsqr(vector) + TURN**2)


def _rotation_vector(rotation: Expr) -> Expr:
    """The rotation vector (3,) rad of a rotation (3, 3) by less than half a turn."""
    twice = ca.vertcat(
        rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    )
    sine = _length(twice / 2)
    return ca.atan2(sine, (ca.trace(rotation) - 1) / 2) / sine * twice / 2


def _rotation(vector: Expr) -> Expr:
    half = _length(vector) / 2
    return SO3.matrix(ca.vertcat(ca.cos(half), ca.sin(half) / (2 * half) * vector))


def _turning(vector: Expr, slope: Expr) -> Expr:
    """Body angular velocity of a rotation vector that changes at the rate ``slope``."""
    a, across = _length(vector) + 1e-3, ca.cross(vector, slope)  # avoids cancellation at small angles
    return slope - (1 - ca.cos(a)) / a**2 * across + (1 - ca.sin(a) / a) / a**2 * ca.cross(vector, across)


def _unturned(vector: Expr, omega: Expr) -> Expr:
    """The rate of change of a rotation vector at a body angular velocity."""
    a, across = _length(vector) + 1e-3, ca.cross(vector, omega)
    return omega + across / 2 + (1 - a / 2 / ca.tan(a / 2)) / a**2 * ca.cross(vector, across)


def root_pose(vehicle: Vehicle, g: Expr) -> Expr:
    """Pose (7,) of the rig's root."""
    pose = vehicle.group.pose(g)
    return ca.vertcat(pose[0:3] - SO3.matrix(pose[3:7]) @ ca.DM(vehicle.origin), pose[3:7])


def _view(vehicle: Vehicle, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr, time: Expr) -> KnotView:
    position, velocity, omega, rotation, push = _seen(vehicle)(g, r, u, xi, c)
    rates = ca.vertcat(u, xi)
    return KnotView(position, velocity, omega, rotation, r, u, c, push, rates, ca.SX(time), UNKNOWN, vehicle.joints)


@lru_cache(maxsize=32)
def _seen(vehicle: Vehicle) -> ca.Function:
    """``(g, r, u, xi, c) -> (position, velocity, omega, rotation, push)`` of a view.

    Built once: to insert arguments takes a tenth of the time.
    """
    g, xi = ca.SX.sym("g", vehicle.group.size), ca.SX.sym("xi", vehicle.group.dim)
    r, u = (ca.SX.sym(name, len(vehicle.joints)) for name in ("r", "u"))
    c = ca.SX.sym("c", len(vehicle.controls))
    root = root_pose(vehicle, g)
    rotation = SO3.matrix(root[3:7])
    twist = vehicle.group.velocity_to_body(g, xi)
    if vehicle.group.fixed:
        omega, body = twist, ca.SX.zeros(3)
    else:
        twist = shift_twist(twist, -vehicle.origin)
        flat = vehicle.group.dim == 3
        omega = ca.vertcat(0, 0, twist[0]) if flat else twist[0:3]
        body = ca.vertcat(twist[1:3], 0) if flat else twist[3:6]
    seen = [root[0:3], rotation @ body, omega, rotation, _push(vehicle, g, r, u, xi, c)]
    return ca.Function("seen", [g, r, u, xi, c], [ca.SX(each) for each in seen])


def _push(vehicle: Vehicle, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
    """Forces of the controls on the joints (s,) and the group (d,) over the weight; rate controls have none."""
    still = ca.SX.zeros(3)
    given = vehicle.force(g, r, u, xi, c, still)
    rest = vehicle.force(g, r, u, xi, ca.SX.zeros(c.shape[0]), still)
    force = ca.vertcat(*(a - b for a, b in zip(given, rest, strict=True)))
    return force / (max(_mass(vehicle), 1e-9) * GRAVITY)


@lru_cache(maxsize=32)
def _mass(vehicle: Vehicle) -> float:
    """Mass along the body's last axis with its joints at zero, kg."""
    speed, still = ca.SX.sym("speed"), ca.SX.zeros(len(vehicle.joints))
    along = ca.vertcat(ca.SX.zeros(vehicle.group.dim - 1), speed)
    kinetic = ca.SX(vehicle.reduced_lagrangian(still, still, along))
    return float(ca.evalf(ca.substitute(ca.hessian(kinetic, speed)[0], speed, 0)))


def evaluate(term: Term, view: KnotView | SegmentView) -> Expr:
    """A term's law evaluated on a view, as a dense column; raises ``InputError`` with the term's name if it fails."""
    try:
        law = term.law
        if isinstance(term, Cost) and term.integral:
            assert isinstance(view, SegmentView)
            value = view.h / 2 * (law(view.start) + law(view.end))
        else:
            value = law(view)
        value = ca.vertcat(*value) if isinstance(value, list | tuple) else ca.SX(value)
    except Exception as error:
        raise InputError(
            f"its law cannot be evaluated: {error}", "see vehsim.planning.KnotView", subject=f"term {term.name!r}"
        ) from error
    if value.shape[1] != 1 or (isinstance(term, Cost) and value.shape[0] != 1):
        wanted = "a scalar" if isinstance(term, Cost) else "a column"
        raise InputError(f"its law gives shape {value.shape}", f"give {wanted}", subject=f"term {term.name!r}")
    return ca.densify(value)
