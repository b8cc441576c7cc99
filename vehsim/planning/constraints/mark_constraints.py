"""The constraints of marks and loops at their knots, as blocks."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.lie import SO3
from vehsim.planning.constraints.block import Block
from vehsim.planning.problem.elements import Element, NonlinearProgram, Use, elastic
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.stage import knot_view, root_pose
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.marks import Gate, Mark, end_of_hold, shape
from vehsim.planning.terms import KnotView
from vehsim.planning.trajectory import Trajectory
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.gripping import rolling_ahead
from vehsim.vehicles.definition.mechanics import acceleration, conservative_at_rest, momentum, project
from vehsim.vehicles.definition.standing import braked

Array = NDArray[np.float64]
Expr = Any
Row = tuple[Expr, float, float]
"""An expression and its bounds."""

THROUGH = 0.05
"""Least speed through a gate, m/s: a vehicle that comes backwards and turns round in the gate does not pass it."""
EDGE = 20.0
"""Price of passing a gate at its edge; it falls towards the centre with the square of the distance. A second of hover
costs 1.5: a helicopter passes a ring of 2.5 m at up to 0.5 m from its centre. Much wider gates remain free."""
PARAMETERS = {"position": 3, "heading": 1, "orientation": 4, "velocity": 3, "speed": 1, "gate": 11}
"""The quantities a mark can fix besides joints, and their sizes."""
BRAKED = 1e-4
"""Acceleration, m/s^2, by which brakes may hold less in a hold on a slope than they could: 1 mm of creep in 5 s."""
SPRINGS, BRAKES = "balance on springs", "brakes"


@dataclass(frozen=True, eq=False)
class Centred(Block):
    """The price of the edge of a gate, the opening of mark ``number``: a motion passes near its centre where that takes
    little."""

    number: int
    price: float

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "centred", self.number, self.price

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if not self.price:
            return

        def make() -> Element:
            v = transcription.symbols("x", "c0")
            place = {key: ca.SX.sym(key, PARAMETERS[key]) for key in ("position", "gate")}
            shown = 3 if transcription.vehicle.group.dim == 6 else 2
            off = knot_view(transcription, v["x"], v["c0"]).position - place["position"]
            f = EDGE * self.price * ca.sumsqr(ca.vertcat(*_in_opening(place["gate"], off[:shown])))
            return Element("centred", ca.vertcat(*v.values()), place, f=f)

        knot, element = layout.mark_knots[self.number], transcription.kept(("centred", self.price), make)
        # the values are those of the mark's `MarkConstraint`
        parameters = {key: problem.parameter(f"mark[{self.number}].{key}", size) for key, size in element.sizes.items()}
        problem.add(element, np.vstack([layout.knot(knot), layout.control(knot)]), parameters)


@dataclass(frozen=True, eq=False)
class MarkConstraint(Block):
    """The constraints of mark ``number`` at its knot, unless it is the end of a hold.

    ``closes``: it ends a loop, and does not repeat what the first mark fixes. ``cut``: the motion of a body on springs
    begins or ends there. ``price``: above zero the mark may be missed at this price per unit, see `elements.elastic`.
    """

    marks: Sequence[Mark]
    number: int
    closes: bool = False
    cut: bool = False
    price: float = 0.0

    @property
    def mark(self) -> Mark:
        return self.marks[self.number]

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return self.number, shape([self.mark]), self._given, self._known, self.cut, self.price

    @property
    def _known(self) -> tuple[Any, ...]:
        """The shape of the mark whose constraints it does not repeat, if any."""
        return shape(self.marks[:1]) if self.closes else ()

    @property
    def _given(self) -> bool:
        """Whether its state is that of the previous mark, which is held."""
        return self.number > 0 and self.marks[self.number - 1].hold > 0

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if self._given:
            return
        # the values of the mark are parameters, so all marks of one shape share the element and its derivatives
        rests = _rests(transcription.vehicle, self.mark)
        key = "mark", shape([self.mark]), rests, self._known, self.cut, self.price
        element = transcription.kept(key, lambda: self._element(transcription))
        if element is None:
            return
        knot = layout.mark_knots[self.number]
        y = np.vstack([layout.knot(knot), layout.control(knot)])
        if self.price:
            y = np.vstack([y, problem.variables(2 * len(element.labels))[:, None]])
        own = {key: size for key, size in element.sizes.items() if key not in transcription.air}
        parameters = {key: problem.parameter(self._parameter(key), size) for key, size in own.items()}
        problem.add(element, y, parameters, names=[self.mark.name])

    def _element(self, transcription: Transcription) -> Element | None:
        """Its constraints; None if it fixes nothing."""
        element = mark_element(transcription, self.mark, self.marks[0] if self.closes else None, cut=self.cut)
        return elastic(element, self.price) if self.price and element is not None else element

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        return {self._parameter(key): value for key, value in mark_values(self.mark).items()}

    def _parameter(self, key: str) -> str:
        return f"mark[{self.number}].{key}"

    def amount(self, use: Use, row: int, violations: Array) -> str:
        labels = np.array(use.element.labels)
        return _amount(labels[row], violations[labels == labels[row]])

    def missed(self, key: str, off: Array) -> str:
        """The message for rows (n,) of what the mark fixes that elastic mode misses by ``off``."""
        if key == "velocity (balance)":
            return f"{self.mark.name}: the vehicle cannot be in balance there"
        if key == BRAKES:
            return f"{self.mark.name}.hold: its brakes cannot hold it there"
        if key == SPRINGS:
            return f"{self.mark.name}: the body cannot be in balance on its springs there"
        return f"{self.mark.name}.{key} is missed by {_amount(key, off)}"


def _amount(key: str, off: Array) -> str:
    """The amount that is missed, in the mark's own unit."""
    norm = float(np.linalg.norm(off))
    if key == "heading":  # its sine, and how far its cosine is below zero
        cosine = -off[1] if off[1] > 0 else math.sqrt(max(0.0, 1 - off[0] ** 2))
        return f"{math.degrees(math.atan2(off[0], cosine)):.3g} deg"
    if key == "orientation":
        return f"{math.degrees(2 * math.asin(min(1.0, norm))):.3g} deg"
    return f"{norm:.3g}{_UNITS.get(key, '')}"


_UNITS = {"position": " m", "velocity": " m/s", "speed": " m/s"}


def mark_values(mark: Mark) -> dict[str, Array]:
    """The values of what a mark fixes, SI and radians; joints that it leaves free are zero."""
    values = {}
    for key in [*PARAMETERS, "joints"]:
        given: Any = getattr(mark, key)
        if isinstance(given, Gate):
            given = np.concatenate([given.axes.ravel(), given.size or (2 * (given.radius or 0.0),) * 2])
        if given is not None:
            numbers = np.nan_to_num(np.atleast_1d(np.asarray(given, float)))
            values[key] = np.deg2rad(numbers) if key == "heading" else numbers
    return values


def mark_element(
    transcription: Transcription,
    mark: Mark,
    known: Mark | None = None,
    everywhere: bool = False,
    cut: bool = False,
) -> Element | None:
    """The constraints of a mark at its knot: (x, c0).

    Parameters: those of `Transcription.air`, and the mark's values by key (see `mark_values`). ``known``: a mark whose
    state holds anyway, as in a loop; its constraints are not repeated. ``everywhere``: the relief of the ground is
    written out, with a hundred times as many operations, and not looked up. ``cut``: the motion begins or ends there.
    """
    v = transcription.symbols("x", "c0")
    x, c = v["x"], v["c0"]
    sizes = {**PARAMETERS, "joints": transcription.sizes[1]}
    wanted = {key: ca.SX.sym(key, size) for key, size in sizes.items()}
    view, g = knot_view(transcription, x, c), transcription.split(x)[0]

    def rows_of(mark: Mark) -> dict[str, list[Row]]:
        attitude = "heading" if mark.orientation is None else "orientation"
        balance = asks_balance(transcription.vehicle, mark)
        return {
            "position": _place(transcription, mark, view, wanted),
            attitude: _attitude(transcription, mark, root_pose(transcription.vehicle, g), wanted),
            "velocity (balance)": _equal(imbalance(transcription, x, c, everywhere)) if balance else [],
            BRAKES: _unbraked(transcription, x, c, everywhere) if balance else [],
            "speed" if mark.velocity is None else "velocity": _motion(transcription, mark, view, x, c, wanted),
            "joints": _joints(mark, view, wanted),
            SPRINGS: _equal(_bouncing(transcription, x, c, everywhere)) if cut and not mark.at_rest else [],
            "hold": [(c[k], 0.0, 0.0) for _, k in transcription.vehicle.driven] if mark.hold else [],
        }

    fixed = rows_of(mark)
    if known is not None:
        fixed = {key: rows for key, rows in fixed.items() if key == "joints" or not rows_of(known).get(key)}
    labels = [key for key, rows in fixed.items() for _ in rows]
    if not labels:
        return None
    rows, lower, upper = zip(*(row for rows in fixed.values() for row in rows), strict=True)
    y, given = ca.vertcat(*v.values()), {key: wanted[key] for key in sizes if getattr(mark, key) is not None}
    space = transcription.space(g) if {"velocity (balance)", BRAKES, SPRINGS} & {*labels} and not everywhere else None
    return Element(
        "mark", y, {**transcription.air, **given}, g=ca.vertcat(*rows), lower=lower, upper=upper, labels=labels,
        space=space,
    )  # fmt: skip


def asks_balance(vehicle: Vehicle, mark: Mark) -> bool:
    """Whether the vehicle must be in balance at a mark."""
    # in the plane, rest does not imply balance: a boat may be at rest at a mark for an instant in a side wind
    return mark.balanced and (mark.hold > 0 or vehicle.group.dim == 6)


def _joints(mark: Mark, view: KnotView, wanted: dict[str, Expr]) -> list[Row]:
    given = np.asarray(() if mark.joints is None else mark.joints, float)
    return [(view.joints[i] - wanted["joints"][i], 0.0, 0.0) for i in np.flatnonzero(np.isfinite(given)).tolist()]


class Loop(Block):
    """The motion ends as it begins."""

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        ends = [np.vstack([layout.knot(k), layout.control(k)]) for k in (0, layout.segments)]
        problem.add(loop_element(transcription), np.vstack(ends))


def closes_loop(marks: Sequence[Mark], i: int, loop: bool) -> bool:
    """Whether mark ``i`` is the end of a ``loop``."""
    return loop and end_of_hold(marks, i) == len(marks) - 1


def loop_element(transcription: Transcription) -> Element:
    """A last knot (x1, c1) that repeats the first (x, c): pose, momentum, controls and every joint that matters.

    Joints that influence nothing, such as a wheel's roll, are not reset.
    """
    size, s, n, count = transcription.sizes
    x, x1, c, c1 = (
        ca.SX.sym(name, k) for name, k in (("x", size + s + n), ("x1", size + s + n), ("c", count), ("c1", count))
    )
    return Element("loop", ca.vertcat(x, c, x1, c1), g=same_state(transcription, x, c, x1, c1))


def same_state(transcription: Transcription, x: Expr, c: Expr, x1: Expr, c1: Expr) -> Expr:
    """Rows that vanish if a knot (x1, c1) repeats another, (x, c), except for joints that influence nothing."""
    (g, r, pi), (g1, r1, pi1) = transcription.split(x), transcription.split(x1)
    group = transcription.vehicle.group
    relative = group.pose(group.compose(group.inverse(g), g1))
    turn, offset = relative[4:7], relative[0:3]
    shown = {"SE2": ca.vertcat(offset[0:2], turn[2]), "SO3": turn}.get(group.name, ca.vertcat(offset, turn))
    kept = [i for i in range(len(transcription.vehicle.joints)) if i not in transcription.idle]
    return ca.vertcat(shown, *(r1[i] - r[i] for i in kept), (pi1 - pi) / transcription.momentum_scale, c1 - c)


def imbalance(transcription: Transcription, x: Expr, c: Expr, everywhere: bool = False) -> Expr:
    """Acceleration along the free velocities of a vehicle at rest, (n,), in the symbols of `Transcription.air` and,
    unless ``everywhere``, of `Transcription.space`.

    Tyres at rest do not slip: only what would make them roll, or move the body on its springs, is out of balance. What
    their rounded friction leaves is judged by `vehicles.definition.standing`.
    """
    vehicle = transcription.in_air if everywhere else transcription.local_in_air[1]
    g, r, _ = transcription.split(x)
    still = (ca.SX.zeros(len(vehicle.joints)), ca.SX.zeros(vehicle.group.dim))
    forces = vehicle.force(g, r, *still, c * transcription.control_scale, transcription.air["wind"])
    weight = conservative_at_rest(vehicle, g, r)
    total = [a + b for a, b in zip(forces, weight, strict=True)]
    scale, rolls = transcription.momentum_scale, rolling_ahead(vehicle, r)
    rows = project(vehicle, r, *total) / scale
    if rolls is None:
        return rows
    inertia = momentum(vehicle, r, *rolls)
    along, mass = (sum(ca.dot(*pair) for pair in zip(rolls, of, strict=True)) for of in (total, inertia))
    body = zip(vehicle.attitude or (), _of_body(vehicle, rows), strict=True)
    if vehicle.standing is not None and transcription.relief is not None:  # brakes hold it, see `_unbraked`
        along = ca.dot(rolls[0], total[0])
    return ca.vertcat(along / mass, *(total[0][vehicle.joints.index(name)] / scale[k] for name, k in body))


def _unbraked(transcription: Transcription, x: Expr, c: Expr, everywhere: bool) -> list[Row]:
    """What the brakes of a vehicle at rest on a slope hold, less than they could, m/s^2, where its tyres may slip.

    An engine's torque would balance the weight, but executed it lets the vehicle creep.
    """
    vehicle = transcription.in_air if everywhere else transcription.local_in_air[1]
    g, r, _ = transcription.split(x)
    rolls = rolling_ahead(vehicle, r)
    if rolls is None or vehicle.standing is None or transcription.relief is None:
        return []
    still = (ca.SX.zeros(len(vehicle.joints)), ca.SX.zeros(vehicle.group.dim))
    controls = c * transcription.control_scale, ca.SX(braked(vehicle))
    held, most = (vehicle.force(g, r, *still, each, transcription.air["wind"])[1] for each in controls)
    mass = sum(ca.dot(*pair) for pair in zip(rolls, momentum(vehicle, r, *rolls), strict=True))
    return _equal(ca.dot(rolls[1], held - most) / mass, BRAKED)


def _of_body(vehicle: Vehicle, z: Expr) -> list[int]:
    """Where a free velocity ``z`` contains the joints of a body on springs."""
    offset = z.shape[0] - len(vehicle.dynamic)
    return [offset + vehicle.dynamic.index(vehicle.joints.index(name)) for name in vehicle.attitude or ()]


def _bouncing(transcription: Transcription, x: Expr, c: Expr, everywhere: bool) -> Expr:
    """Rates and accelerations of a sprung body on its springs, which vanish where it neither bounces nor rocks.

    Where a motion begins or ends at speed, these joints are free: the springs would be wound up there to save effort.
    """
    vehicle = transcription.in_air if everywhere else transcription.local_in_air[1]
    if not vehicle.attitude:
        return ca.SX(0, 1)
    g, r, pi = transcription.split(x)
    controls, constant = c * transcription.control_scale, ca.SX.zeros(c.shape[0])
    z = transcription.mechanics.knot_velocity_guess(r, pi, controls)
    rates = acceleration(vehicle, g, r, z, controls, constant, transcription.air["wind"])
    body = _of_body(vehicle, z)
    return ca.vertcat(*(z[k] for k in body), *(rates[k] for k in body))


def _equal(expression: Expr, slack: float = 0.0) -> list[Row]:
    return [(row, -slack, slack) for row in ca.vertsplit(expression)]


def _place(transcription: Transcription, mark: Mark, view: KnotView, wanted: dict[str, Expr]) -> list[Row]:
    shown = 3 if transcription.vehicle.group.dim == 6 else 2
    off = (view.position - wanted["position"])[:shown]
    if mark.position is None or transcription.vehicle.group.fixed:
        return []
    if mark.gate is None:
        return _equal(off, mark.tolerance)
    slowest = THROUGH if mark.velocity is None and mark.speed is None else 0.0
    axis = wanted["gate"][:shown]
    rows: list[Row] = [(ca.dot(axis, off), 0.0, 0.0), (ca.dot(axis, view.velocity[:shown]), slowest, np.inf)]
    along, up = _in_opening(wanted["gate"], off)
    if mark.gate.radius is not None:
        return [*rows, (along**2 + up**2, 0.0, 1.0)]
    return [*rows, (along, -1.0, 1.0), *([(up, -1.0, 1.0)] if shown == 3 else [])]


def _in_opening(gate: Expr, off: Expr) -> tuple[Expr, Expr]:
    """A place in the opening of a ``gate``, ``off`` (2,) or (3,) m from its centre, relative to its edges."""
    along, up = (ca.dot(gate[3 * i : 3 * i + off.shape[0]], off) for i in (1, 2))
    return 2 * along / gate[9], 2 * up / gate[10]


def _attitude(transcription: Transcription, mark: Mark, root: Expr, wanted: dict[str, Expr]) -> list[Row]:
    rotation = SO3.matrix(root[3:7])
    if mark.orientation is not None:
        # the vector part of the quaternion vanishes only at the requested attitude
        off = SO3.compose(SO3.inverse(wanted["orientation"]), root[3:7])
        return _equal(off[3 if transcription.vehicle.group.planar else 1 : 4])
    if mark.heading is not None:
        c, s = ca.cos(wanted["heading"]), ca.sin(wanted["heading"])
        return [
            (c * rotation[1, 0] - s * rotation[0, 0], 0.0, 0.0),
            (c * rotation[0, 0] + s * rotation[1, 0], 0.0, np.inf),
        ]
    return []


def _rests(vehicle: Vehicle, mark: Mark) -> bool:
    """Whether a vehicle at rest at a mark rests with its body, which may elsewhere still rock on its springs."""
    return not vehicle.attitude or mark.place == 0 or mark.hold > 0


def _motion(
    transcription: Transcription, mark: Mark, view: KnotView, x: Expr, c: Expr, wanted: dict[str, Expr]
) -> list[Row]:
    spatial, rolls = transcription.vehicle.group.dim == 6, transcription.sizes[2] == 1
    if mark.at_rest:  # all free velocities vanish; with one rolling direction there is only one
        _, r, pi = transcription.split(x)
        body, vehicle = transcription.vehicle.attitude or (), transcription.vehicle
        if _rests(vehicle, mark):
            still = transcription.mechanics.knot_velocity_guess(r, pi, c * transcription.control_scale)
            return _equal(ca.vertcat(still, *(view.joint(name) for name in body)))
        wheels = [vehicle.joints[k] for k in vehicle.dynamic if vehicle.joints[k] not in body]
        return _equal(ca.vertcat(view.velocity[0:2], view.omega[2], *(view.rate(name) for name in wheels)))
    if mark.velocity is not None:
        error = view.velocity - wanted["velocity"]
        return _equal(error if spatial else error[0:2])
    if mark.speed == 0:
        along = view.rotation[0:2, 0].T @ view.velocity[0:2]
        return _equal(view.velocity if spatial else along if rolls else view.velocity[0:2])
    if mark.speed is not None:
        return _equal(ca.sqrt(ca.sumsqr(view.velocity) + 1e-10) - wanted["speed"])
    return []
