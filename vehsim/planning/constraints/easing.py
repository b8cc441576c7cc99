"""Easing: controls change smoothly, and start and end in balance, without rates, at marks where the vehicle rests.

What slips sideways, such as a boat, begins as it would go there unless its mark asks for a slip; what flies begins
and ends straight or in a coordinated turn unless its mark fixes the attitude.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.lie import SO3
from vehsim.planning.constraints.block import Block
from vehsim.planning.constraints.mark_constraints import asks_balance, imbalance
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.character import Traits, control_rates, eased
from vehsim.planning.request.legs import knots_within
from vehsim.planning.request.marks import Mark, heading_of
from vehsim.planning.terms import COSTS, BendView, Constraint, costs_of, weight_of
from vehsim.planning.trajectory import Trajectory
from vehsim.planning.trim import flies, is_pushed
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.character import STUNT
from vehsim.vehicles.definition.gripping import rolling_ahead
from vehsim.vehicles.definition.mechanics import acceleration, momentum

Array = NDArray[np.float64]

COORDINATED = 100.0
"""Price of x^2 where a flight begins or ends at speed; x: rates of roll and pitch, rad/s, and the bank, rad, that its
turn lacks. A degree costs 0.03; in flight, the effort of a second costs one."""
ASKED = 0.02
"""Rate of turn, rad/s, above which the price of turning there grows only slowly: its marks ask for that turn. Below it,
the turn would save effort of the tail rotor, a thousandth, and lead up to a metre aside on a straight way."""
NEAREST = 1.0
"""Distance from a place, m, below which the direction to it does not count: overhead it turns at any rate."""
STEADY, IN_STUNTS = 10.0, 0.1
"""Price of x^2 where what slides begins to move, and that in a stunt, whose other costs are lower; x: accelerations
sideways, m/s^2, and in yaw, rad/s^2."""
SPUN = 1.0
"""Price of x^2 there; x: the acceleration, m/s^2, that wheels give the vehicle as their slips change. Without it they
are spun up before the first frame, and tyres turn that into speed."""
STRAIGHT = np.radians(5.0)
"""The largest angle between the nose and the velocity at a mark that is no slide, rad."""
REST, ABRUPT = 6e3, 0.05
"""Price of imbalance x at rest, m/s^2, and of the rates x of controls, as shares of their largest: ``REST`` x^2 /
2 up to about ``ABRUPT``, so that a thousandth remains of what the rest of the motion would gain; from there on ``REST
ABRUPT`` x, so that a motion to a mark that is too early starts and ends abruptly rather than exceed its limits
everywhere between."""


@dataclass(frozen=True, eq=False)
class Easing(Block):
    """The costs of changing rates of controls, at their ``weights`` by name, and of marks at rest.

    Where a motion eases out of a mark at rest, its controls start in balance and without rates; the same holds for its
    arrival.
    """

    weights: Mapping[str, float]
    traits: Traits
    marks: Sequence[Mark]
    steady: Sequence[int] = ()
    """The marks at which the motion begins or ends steadily, see `steady_marks`."""
    straight: bool = True
    """Whether a flight begins and ends straight unless its marks ask for a turn; no other cost asks for one."""
    looks: Sequence[Constraint] = ()
    """Those constraints that point the heading at a place: where they hold, it turns as the place passes by."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the costs of two consecutive segments with a weight above zero."""
        return costs_of(BendView, self.weights)

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        ground = tuple(mark.on_ground for mark in self.marks)
        ends, rates = tuple(eased(self.traits, self.marks)), self._rates(transcription).tobytes()
        looked = tuple(self._looked(layout))
        steady = (*self.steady, self.traits.name == STUNT)
        return "easing", self.names, ends, ground, rates, steady, self.straight, looked

    def _looked(self, layout: Layout) -> dict[int, Array]:
        """The places (3,) m at which a heading points at steady marks, by the number of the mark."""
        found = {}
        for i in self.steady:
            for look in self.looks:
                first, last = knots_within(self.marks, layout.mark_knots, look.frames)
                if look.aim is not None and first <= layout.mark_knots[i] <= last:
                    found[i] = np.asarray(look.aim[0])
        return found

    def _rates(self, transcription: Transcription) -> Array:
        """The largest rates of the controls over their scale, 1/s."""
        return np.asarray(control_rates(self.traits, transcription.vehicle) / transcription.control_scale)

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if not transcription.sizes[3]:
            return
        if self.names:
            k = np.arange(1, layout.segments)
            controls = [layout.control(k + i) for i in (-1, 0, 1)]
            variables = np.vstack([*controls, layout.duration(k - 1), layout.duration(k)])
            problem.add(bend_element(transcription, self.names), variables)
        for i, comes, leaves in eased(self.traits, self.marks):
            knot = layout.mark_knots[i]
            element = rest_element(transcription, self.names, self._rates(transcription), self.traits.price)
            for side, there in ((-1, comes), (1, leaves)):
                if there:
                    segment = knot - 1 if side < 0 else knot
                    here = [layout.control(knot), layout.control(knot + side), layout.duration(segment)]
                    problem.add(element, np.vstack(here))
            held = i > 0 and self.marks[i - 1].hold
            if not (asks_balance(transcription.vehicle, self.marks[i]) or held):
                element = balance_element(transcription, self.traits.price, self.marks[i].on_ground)
                problem.add(element, np.vstack([layout.knot(knot), layout.control(knot)]))
        looked = self._looked(layout)
        for i in self.steady:
            knot, given = layout.mark_knots[i], {}
            if flies(transcription.vehicle):
                element = coordinated_element(transcription, self.traits.price, self.straight, i in looked)
                given = {"place": problem.parameter(f"look at mark[{i}]", 3)} if i in looked else {}
            else:
                element = steady_element(transcription, self.traits)
            problem.add(element, np.vstack([layout.knot(knot), layout.control(knot)]), given)

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        looked = {f"look at mark[{i}]": place for i, place in self._looked(trajectory.layout).items()}
        return {weight_of(name): self.weights[name] for name in self.names} | looked


def bend_element(transcription: Transcription, names: tuple[str, ...]) -> Element:
    """The weighted costs of two consecutive segments: (c0, c1, c2, h0, h1)."""

    def make() -> Element:
        size = transcription.sizes[3]
        c, h = [ca.SX.sym(f"c{i}", size) for i in range(3)], [ca.SX.sym(f"h{i}") for i in range(2)]
        f, parameters = _weighted(names, BendView(*c, *h))
        return Element("easing", ca.vertcat(*c, *h), parameters, f=f)

    return transcription.kept(("easing", *names), make)


def rest_element(transcription: Transcription, names: tuple[str, ...], rates: Array, price: float) -> Element:
    """The costs of a segment that starts or ends at rest, and of the controls' rates there: (c at rest, c, h)."""

    def make() -> Element:
        size = transcription.sizes[3]
        rest, c, h = ca.SX.sym("rest", size), ca.SX.sym("c", size), ca.SX.sym("h")
        f, parameters = _weighted(names, BendView(rest, rest, c, h, h))
        f += price * _abrupt((c - rest) / (h * rates))
        return Element("ease", ca.vertcat(rest, c, h), parameters, f=f)

    return transcription.kept(("ease", *names, rates.tobytes(), price), make)


def balance_element(transcription: Transcription, price: float, on_ground: bool = False) -> Element:
    """The cost of imbalance of a vehicle at rest: (x, c).

    On the ground, friction bears forces to the side: a level helicopter cannot balance the push of its tail rotor.
    """

    def make() -> Element:
        v = transcription.symbols("x", "c0")
        off = imbalance(transcription, v["x"], v["c0"])
        f = price * _abrupt(ca.vertcat(off[:3], off[5]) if on_ground and off.shape[0] == 6 else off)
        space = transcription.space(transcription.split(v["x"])[0])
        return Element("balance", ca.vertcat(*v.values()), transcription.air, f=f, space=space)

    return transcription.kept(("balance", price, on_ground), make)


def steady_marks(vehicle: Vehicle, marks: Sequence[Mark], traits: Traits) -> list[int]:
    """Indices of the marks at which a motion that is no loop begins or ends steadily: a flight that is no stunt at both
    ends where it moves with a free attitude, a vehicle that slides where it begins to move and its mark asks for no
    slip."""
    ends = [i for i in (0, len(marks) - 1) if marks[i].moves]
    if flies(vehicle) and is_pushed(vehicle):
        return [i for i in ends if marks[i].orientation is None and traits.name != STUNT]
    return [i for i in ends if i == 0 and not _slips(marks[i])] if slides(vehicle) else []


def _slips(mark: Mark) -> bool:
    """Whether a mark gives a velocity that is not along the nose."""
    heading = heading_of(mark)
    if heading is None or mark.velocity is None:
        return False
    ahead = np.dot(mark.velocity[:2], [np.cos(heading), np.sin(heading)])
    return bool(ahead < np.cos(STRAIGHT) * np.linalg.norm(mark.velocity[:2]))


def slides(vehicle: Vehicle) -> bool:
    """Whether a vehicle in the plane can move and turn in any direction, as boats and cars on tyres can."""
    free = vehicle.basis(ca.SX.zeros(len(vehicle.joints))).shape[1]
    return vehicle.group.name == "SE2" and free == vehicle.group.dim


def steady_element(transcription: Transcription, traits: Traits) -> Element:
    """The cost of accelerations sideways, in body axes, and in yaw, and of wheels that slip more or less: (x, c).

    They vanish in a steady bend. A motion with a free heading would otherwise begin with a slide, on which the water or
    the road then pushes it to its next mark; one with a given heading would begin with a turn that they stop.
    """

    def make() -> Element:
        v, vehicle = transcription.symbols("x", "c0"), transcription.vehicle
        z, rates = _motion(transcription, v)
        spun = _spun(vehicle, transcription.split(v["x"])[1], z, rates)
        f = steady * (rates[0] ** 2 + rates[2] ** 2) + SPUN * ca.sumsqr(spun)
        return _at_knot(transcription, v, traits.price * f)

    steady = IN_STUNTS if traits.name == STUNT else STEADY
    return transcription.kept(("steady", steady, traits.price), make)


def coordinated_element(transcription: Transcription, price: float, straight: bool, looks: bool = False) -> Element:
    """The cost of rolling, pitching, accelerating sideways in body axes, and if ``straight`` of turning slowly: (x, c).

    The first three vanish in a steady turn, which is about a vertical axis. A flight would otherwise begin with a bank
    of ten degrees and the roll rate that ends it, which take no effort. ``looks``: its heading points at ``place``
    (3,) m, within a tolerance; it costs to turn otherwise than the direction to that place does.
    """

    def make() -> Element:
        v, group = transcription.symbols("x", "c0"), transcription.vehicle.group
        g = transcription.split(v["x"])[0]
        z, rates = (each[: group.dim] for each in _motion(transcription, v))
        t, zero = ca.SX.sym("t"), ca.SX.zeros(1)
        twist = group.velocity_to_body(group.compose(g, group.cay(t * z)), z + t * rates)
        twist, change = (ca.substitute(each, t, zero) for each in (twist, ca.jacobian(twist, t)))
        turning = SO3.matrix(group.pose(g)[3:7]) @ twist[0:3]
        off = ca.vertcat(turning[0:2], change[4] / GRAVITY)
        place = ca.SX.sym("place", 3)
        if looks:
            ahead, velocity = place - group.pose(g)[0:3], SO3.matrix(group.pose(g)[3:7]) @ twist[3:6]
            passes = ca.cross(velocity, ahead)[2] / (ca.sumsqr(ahead[0:2]) + NEAREST**2)
            wander = (turning[2] - passes) ** 2
        else:
            wander = ASKED**2 * ca.log1p((turning[2] / ASKED) ** 2) if straight else 0.0
        f = price * COORDINATED * (ca.sumsqr(off) + wander)
        return _at_knot(transcription, v, f, {"place": place} if looks else None)

    return transcription.kept(("coordinated", price, straight, looks), make)


def _motion(transcription: Transcription, v: dict[str, Any]) -> tuple[Any, Any]:
    """The free velocity (d + s_d,) at a knot (x, c0) of a vehicle that moves freely, and its rate of change."""
    vehicle = transcription.local_in_air[1]
    g, r, pi = transcription.split(v["x"])
    controls = v["c0"] * transcription.control_scale
    z = transcription.mechanics.knot_velocity_guess(r, pi, controls)
    rates = acceleration(vehicle, g, r, z, controls, ca.SX.zeros(controls.shape[0]), transcription.air["wind"])
    return z, rates


def _spun(vehicle: Vehicle, r: Any, z: Any, rates: Any) -> Any:
    """How fast the slips of wheels grow (n,), as the acceleration, m/s^2, that the wheels' inertia would give the
    vehicle; none for wheels that never slip."""
    rolls = rolling_ahead(vehicle, r)
    if rolls is None:
        return ca.SX(0, 1)
    assert vehicle.rolling is not None
    inertia = momentum(vehicle, r, *rolls)
    mass = sum(ca.dot(*pair) for pair in zip(rolls, inertia, strict=True))
    twist = ca.SX.sym("twist", vehicle.group.dim)
    rolled = ca.jtimes(vehicle.rolling(r, twist), twist, rates[: vehicle.group.dim])
    rolled = ca.substitute(rolled, twist, z[: vehicle.group.dim])
    spin = rates[z.shape[0] - len(vehicle.dynamic) :]
    wheels = [(k, joint) for k, joint in enumerate(vehicle.dynamic) if not rolls[0][joint].is_zero()]
    return ca.vertcat(*((spin[k] - rolled[joint]) * inertia[0][joint] / mass for k, joint in wheels))


def _at_knot(
    transcription: Transcription, v: dict[str, Any], f: Any, given: Mapping[str, Any] | None = None
) -> Element:
    """An element with the cost ``f`` of a knot (x, c0), which depends on what is below it, and on parameters
    ``given``."""
    space = transcription.space(transcription.split(v["x"])[0])
    return Element("steady", ca.vertcat(*v.values()), {**(given or {}), **transcription.air}, f=f, space=space)


def _abrupt(values: Any) -> Any:
    """The price of values that should be zero at rest: quadratic for small ones, linear for large ones."""
    return REST * ABRUPT**2 * ca.sum1(ca.sqrt(1 + (values / ABRUPT) ** 2) - 1)


def _weighted(names: tuple[str, ...], view: BendView) -> tuple[Any, dict[str, Any]]:
    """The sum of the costs ``names``, and the parameters that are their weights."""
    parameters = {weight_of(name): ca.SX.sym(name) for name in names}
    return sum((parameters[weight_of(n)] * COSTS[n](view) for n in names), ca.SX(0)), parameters
