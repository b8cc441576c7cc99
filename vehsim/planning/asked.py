"""What marks, holds and loops ask of the knots they stand on, as elements."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.lie import SO3
from vehsim.planning.cover import ROUND, approach
from vehsim.planning.elements import Element
from vehsim.planning.marks import Gate, Mark
from vehsim.planning.ranges import GENTLE, SINK
from vehsim.planning.request import Request
from vehsim.planning.terms import Cost, KnotView, Term
from vehsim.planning.transcription import Transcription
from vehsim.planning.views import knot_view, root_pose
from vehsim.vehicles import Vehicle
from vehsim.vehicles.mechanics import conservative, project
from vehsim.world.landing import feet

Array = NDArray[np.float64]
Expr = Any
Row = tuple[Expr, float, float]
"""An expression and its bounds."""

PARAMETERS = {"position": 3, "heading": 1, "orientation": 4, "velocity": 3, "speed": 1, "gate": 11}


def parameter_sizes(t: Transcription) -> dict[str, int]:
    """How many parameters each key of a mark has."""
    return {**PARAMETERS, "joints": t.sizes[1]}


def mark_values(t: Transcription, mark: Mark) -> Array:
    """Parameter values of a mark, zeros where it asks nothing."""
    values = []
    for key, size in parameter_sizes(t).items():
        given: Any = getattr(mark, key)
        if isinstance(given, Gate):
            given = np.concatenate([given.axes.ravel(), given.size or (2 * (given.radius or 0.0),) * 2])
        given = np.zeros(size) if given is None else np.nan_to_num(np.atleast_1d(np.asarray(given, float)))
        values.append(np.deg2rad(given) if key == "heading" else given)
    return np.concatenate(values)


def mark_element(t: Transcription, mark: Mark, known: Mark | None = None) -> Element | None:
    """What a mark asks at its knot: (x, c0), with the wind and its values (``mark_values``) as parameters.

    ``known``: a mark whose state it has anyway, as in a loop; what that asks is not asked twice.
    """
    x, c = ca.SX.sym("x", sum(t.sizes[:3])), ca.SX.sym("c", t.sizes[3])
    wind = ca.SX.sym("wind", 3)
    wanted = {key: ca.SX.sym(key, size) for key, size in parameter_sizes(t).items()}
    view, g = knot_view(t, x, c), t.split(x)[0]

    def rows_of(mark: Mark) -> dict[str, list[Row]]:
        attitude = "heading" if mark.orientation is None else "orientation"
        return {
            "position": _place(t, mark, view, wanted),
            attitude: _attitude(t, mark, root_pose(t.vehicle, g), wanted),
            "velocity (balance)": _equal(imbalance(t, x, c, wind)) if asks_balance(t.vehicle, mark) else [],
            "speed" if mark.velocity is None else "velocity": _motion(t, mark, view, x, c, wanted),
            "joints": _joints(mark, view, wanted),
            "hold": [(c[k], 0.0, 0.0) for _, k in t.vehicle.driven] if mark.hold else [],
        }

    asked = rows_of(mark)
    if known is not None:
        asked = {key: rows for key, rows in asked.items() if key == "joints" or not rows_of(known).get(key)}
    labels = [key for key, rows in asked.items() for _ in rows]
    if not labels:
        return None
    rows, lower, upper = zip(*(row for rows in asked.values() for row in rows), strict=True)
    p = ca.vertcat(wind, *wanted.values())
    return Element("mark", ca.vertcat(x, c), p, g=ca.vertcat(*rows), lower=lower, upper=upper, labels=labels)


def asks_balance(vehicle: Vehicle, mark: Mark) -> bool:
    """Whether the vehicle has to be in balance at a mark."""
    # in the plane nothing follows from standing still: a boat may touch a mark with the wind at its side
    return mark.balanced and (mark.hold > 0 or vehicle.group.dim == 6)


def _joints(mark: Mark, view: KnotView, wanted: dict[str, Expr]) -> list[Row]:
    given = np.asarray(() if mark.joints is None else mark.joints, float)
    return [(view.joints[i] - wanted["joints"][i], 0.0, 0.0) for i in np.flatnonzero(np.isfinite(given)).tolist()]


FALL, NEAR = 1.0, 4.0
"""What coming down at 1 m/s costs a second where it lands, and the distance over which that falls to 1/e, m. It keeps
the descent off its bound, along which controls would chatter."""
FADE = 10.0
"""How far from a landing its cone counts half, m: there it may be as much below the place."""


def landing_element(t: Transcription, upright: Array) -> Element:
    """What stands on the ground above the cone about its landing, and gently down, at a knot: (x, h).

    ``upright`` (4,): its attitude there. Parameters: the clearance asked for beyond, and the place (3,).
    """
    x, h = ca.SX.sym("x", sum(t.sizes[:3])), ca.SX.sym("h")
    asked, place = ca.SX.sym("asked"), ca.SX.sym("place", 3)
    view = knot_view(t, x, ca.SX.zeros(t.sizes[3]))
    distance = ca.sqrt(ca.sumsqr(view.position - place) + ROUND**2) - ROUND
    counts = 1 / (1 + (distance / FADE) ** 4)
    above = approach(distance, asked, 0.0, ca.tanh)
    below = feet(t.vehicle)
    flat = below @ SO3.matrix(upright).T
    rise = [
        (view.rotation @ ca.DM(foot))[2] - float(z) + view.position[2] - place[2]
        for foot, z in zip(below, flat[:, 2], strict=True)
    ]
    down = view.velocity[2] + GENTLE + SINK * distance
    g = ca.vertcat(counts * (ca.vertcat(*rise) - above) + (1 - counts) * FADE, down)
    cost = FALL * h * view.velocity[2] ** 2 * ca.exp(-((distance / NEAR) ** 2))
    return Element("landing", ca.vertcat(x, h), ca.vertcat(asked, place), f=cost, g=g, lower=0.0, upper=np.inf)


def hold_element(t: Transcription) -> Element:
    """A state that stays as it is, at no velocity: (x, z, x1).

    It stands in place of the mechanics: in balance these say the same, but twice, since controls that stay as they are
    say it too. The balance is asked once, by the mark where the hold begins.
    """
    x, z, x1 = (
        ca.SX.sym(name, size) for name, size in (("x", sum(t.sizes[:3])), ("z", t.sizes[2]), ("x1", sum(t.sizes[:3])))
    )
    return Element("hold", ca.vertcat(x, z, x1), ca.SX(0, 1), g=ca.vertcat(x1 - x, z))


def held_controls_element(t: Transcription) -> Element:
    """Controls that stay as they are: (c0, c1)."""
    c0, c1 = ca.SX.sym("c0", t.sizes[3]), ca.SX.sym("c1", t.sizes[3])
    return Element("held controls", ca.vertcat(c0, c1), ca.SX(0, 1), g=c1 - c0)


def loop_element(t: Transcription) -> Element:
    """A last knot (x1, c1) that repeats the first (x, c): pose, momentum, controls and every joint that matters.

    Joints that nothing depends on, as a wheel's roll, go on turning.
    """
    size, s, n, count = t.sizes
    x, x1, c, c1 = (
        ca.SX.sym(name, k) for name, k in (("x", size + s + n), ("x1", size + s + n), ("c", count), ("c1", count))
    )
    (g, r, pi), (g1, r1, pi1) = t.split(x), t.split(x1)
    group = t.vehicle.group
    relative = group.pose(group.compose(group.inverse(g), g1))
    turn, way = relative[4:7], relative[0:3]
    shown = {"SE2": ca.vertcat(way[0:2], turn[2]), "SO3": turn}.get(group.name, ca.vertcat(way, turn))
    kept = [i for i in range(s) if i not in t.idle]
    rows = [shown, *(r1[i] - r[i] for i in kept), (pi1 - pi) / t.momentum_scale, c1 - c]
    return Element("loop", ca.vertcat(x, c, x1, c1), ca.SX(0, 1), g=ca.vertcat(*rows))


def adrift(t: Transcription, request: Request) -> list[int]:
    """Joints that neither motion, limit, term nor mark places, such as a wheel's roll.

    Somebody has to say where they begin: a solver that is free to choose ends up anywhere.
    """
    rows = [np.asarray(mark.joints, float) for mark in request.marks if mark.joints is not None]
    return [
        i
        for i, name in enumerate(t.vehicle.joints)
        if i in t.idle
        and name not in request.limits.joints
        and not any(np.isfinite(row[i]) for row in rows)
        and not any(_reads(t, term, i) for term in request.terms)
    ]


def _reads(t: Transcription, term: Term, joint: int) -> bool:
    """A term's law depends on the joint."""
    element = t.term(term, "segment" if isinstance(term, Cost) or term.over == "segments" else "knot", 1)[0]
    return bool(ca.depends_on(ca.vertcat(element.f, element.g), element.y[t.sizes[0] + joint]))


def imbalance(t: Transcription, x: Expr, c: Expr, wind: Expr) -> Expr:
    """Acceleration along the free velocities of a vehicle that stands still, (n_z,)."""
    vehicle, (g, r, _) = t.vehicle, t.split(x)
    still = (ca.SX.zeros(len(vehicle.joints)), ca.SX.zeros(vehicle.group.dim))
    forces = vehicle.force(g, r, *still, c * t.control_scale, wind)
    weight = conservative(vehicle, g, r)
    total = [a + b for a, b in zip(forces, weight, strict=True)]
    return project(vehicle, r, *total) / t.momentum_scale


def _equal(expression: Expr, slack: float = 0.0) -> list[Row]:
    return [(row, -slack, slack) for row in ca.vertsplit(expression)]


def _place(t: Transcription, mark: Mark, view: KnotView, wanted: dict[str, Expr]) -> list[Row]:
    shown = 3 if t.vehicle.group.dim == 6 else 2
    off = (view.position - wanted["position"])[:shown]
    if mark.position is None or t.vehicle.group.fixed:
        return []
    if mark.gate is None:
        return _equal(off, mark.tolerance)
    axes = [wanted["gate"][3 * i : 3 * i + 3][:shown] for i in range(3)]
    through, along, up = (ca.dot(axis, off) for axis in axes)
    width, height = wanted["gate"][9], wanted["gate"][10]
    rows: list[Row] = [(through, 0.0, 0.0), (ca.dot(axes[0], view.velocity[:shown]), 0.0, np.inf)]
    if mark.gate.radius is not None:
        return [*rows, (4 * (along**2 + up**2) / (width * height), 0.0, 1.0)]
    return [*rows, (2 * along / width, -1.0, 1.0), *([(2 * up / height, -1.0, 1.0)] if shown == 3 else [])]


def _attitude(t: Transcription, mark: Mark, root: Expr, wanted: dict[str, Expr]) -> list[Row]:
    rotation = SO3.matrix(root[3:7])
    if mark.orientation is not None:
        # the vector part of a quaternion: it vanishes at the attitude alone
        off = SO3.compose(SO3.inverse(wanted["orientation"]), root[3:7])
        return _equal(off[3 if t.vehicle.group.planar else 1 : 4])
    if mark.heading is not None:
        c, s = ca.cos(wanted["heading"]), ca.sin(wanted["heading"])
        return [
            (c * rotation[1, 0] - s * rotation[0, 0], 0.0, 0.0),
            (c * rotation[0, 0] + s * rotation[1, 0], 0.0, np.inf),
        ]
    return []


def _motion(t: Transcription, mark: Mark, view: KnotView, x: Expr, c: Expr, wanted: dict[str, Expr]) -> list[Row]:
    spatial, rolls = t.vehicle.group.dim == 6, t.sizes[2] == 1
    if mark.at_rest:  # every free velocity; where rolling leaves one way to go, that is one
        _, r, pi = t.split(x)
        return _equal(t.mechanics.knot_velocity_guess(r, pi, c * t.control_scale))
    if mark.velocity is not None:
        error = view.velocity - wanted["velocity"]
        return _equal(error if spatial else error[0:2])
    if mark.speed == 0:
        along = view.rotation[0:2, 0].T @ view.velocity[0:2]
        return _equal(view.velocity if spatial else along if rolls else view.velocity[0:2])
    if mark.speed is not None:
        return _equal(ca.sqrt(ca.sumsqr(view.velocity) + 1e-10) - wanted["speed"])
    return []
