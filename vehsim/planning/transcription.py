"""DMOC: a vehicle's discrete mechanics, costs, limits and clearance as elements of one sparse optimisation problem.

Variables, knot by knot: node states ``(g, r, pi)``, segment velocities ``z``, knot controls, and a segment length for
every phase between two marks. At order 4 a segment is five symmetric substeps (Suzuki), each with a node of its own.
Momenta and controls are scaled to the size of velocities and of typical controls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.integrators import DiscreteMechanics
from vehsim.integrators.integrator import mechanics_of
from vehsim.planning.cover import POSE, ROUND, Cover, approach
from vehsim.planning.elements import Element, Seen, second_order
from vehsim.planning.layout import Layout as Layout
from vehsim.planning.terms import COSTS, Cost, KnotView, SegmentView, Term, repulsion
from vehsim.planning.views import UNKNOWN, between_view, knot_view, middle_view, segment_view
from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

WIND, MARGIN = slice(0, 3), 3
"""Places in the parameter vector: wind (3,) m/s, and the clearance asked of the sphere cover, m."""


class Transcription:
    """A vehicle's elements, differentiated once and used in problems of any length."""

    def __init__(self, vehicle: Vehicle):
        self.vehicle = vehicle
        self.mechanics: DiscreteMechanics = mechanics_of(vehicle, "cay", "galerkin")
        self.sizes = self.mechanics.sizes
        self.control_scale = np.array([c.scale for c in vehicle.controls])
        self.momentum_scale = self._mass()
        self._elements: dict[Any, Element] = {}

    def _mass(self) -> Array:
        m = self.mechanics
        r, n = np.zeros(self.sizes[1]), self.sizes[2]
        c = np.zeros(self.sizes[3])
        zero = np.ravel(np.asarray(m.knot_velocity_guess(r, np.zeros(n), c)))
        mobility = np.array([np.ravel(np.asarray(m.knot_velocity_guess(r, e, c))) - zero for e in np.eye(n)])
        return 1 / np.abs(np.diag(mobility)) if n else np.zeros(0)

    def _symbols(self, *names: str) -> dict[str, Any]:
        size, s, n, c = self.sizes
        shapes = {"x": size + s + n, "x1": size + s + n, "z": n, "c0": c, "c1": c, "h": 1}
        return {name: ca.SX.sym(name, shapes[name]) for name in names}

    def split(self, x: Any) -> tuple[Any, Any, Any]:
        """``g, r`` and the unscaled ``pi`` of a node state."""
        size, s, n = self.sizes[:3]
        g, r, pi = ca.vertsplit(x, [0, size, size + s, size + s + n])
        return g, r, pi * self.momentum_scale

    @cached_property
    def idle(self) -> list[int]:
        """Joints that nothing depends on, neither the motion nor a limit: a wheel's roll."""
        y, step = self.mechanics.symbols, self.mechanics.segment
        moved = ca.vertcat(step["left"], step["right"], step["g1"])
        named = enumerate(self.vehicle.joints)
        return [i for i, name in named if name not in self.vehicle.joint_limits and not ca.depends_on(moved, y["r"][i])]

    @cached_property
    def substep(self) -> Element:
        """The three discrete equations of a substep: (x, z, c0, c1, x1, h); parameters (wind, start, fraction)."""
        v = self._symbols("x", "z", "c0", "c1", "x1", "h")
        wind, start, fraction = ca.SX.sym("wind", 3), ca.SX.sym("start"), ca.SX.sym("fraction")
        g, r, pi = self.split(v["x"])
        g1, r1, pi1 = self.split(v["x1"])
        ca_, cb = v["c0"] * self.control_scale, v["c1"] * self.control_scale
        step = self.mechanics
        expressions = [step.segment[name] for name in ("left", "right", "g1", "r1")]
        inputs = [step.symbols[name] for name in ("g", "r", "z", "c0", "c1", "h", "wind")]
        segment = ca.Function("segment", inputs, expressions)
        ends = (ca_ + start * (cb - ca_), ca_ + (start + fraction) * (cb - ca_))
        left, right, next_g, next_r = segment(g, r, v["z"], *ends, v["h"] * fraction, wind)
        residuals = ((left - pi) / self.momentum_scale, (right - pi1) / self.momentum_scale, next_g - g1, next_r - r1)
        y = ca.vertcat(*v.values())
        return Element("dynamics", y, ca.vertcat(wind, start, fraction), g=ca.vertcat(*residuals))

    def cost(self, names: Sequence[str]) -> Element:
        """Weighted costs of one segment: (x, x1, c0, c1, h), with the weights as parameters."""
        return self._kept(("cost", *names), lambda: self._cost(names))

    def _cost(self, names: Sequence[str]) -> Element:
        y, view = self._segment_view()
        weights = ca.SX.sym("weights", len(names))
        total = ca.dot(weights, ca.vertcat(*(COSTS[name](view) for name in names)))
        return Element("cost", y, weights, f=total)

    def _segment_view(self, time: Any = 0.0) -> tuple[Any, Any]:
        v = self._symbols("x", "x1", "c0", "c1", "h")
        return ca.vertcat(*v.values()), segment_view(self, v, time)

    def accelerated(self, term: Term) -> bool:
        """Whether a law of a `KnotView` asks for the acceleration, which takes a segment to know."""
        v = self._symbols("x", "c0")
        return bool(ca.depends_on(self.law(term, knot_view(self, v["x"], v["c0"])), UNKNOWN))

    def term(self, term: Term, place: str, phases: int) -> tuple[Element, bool]:
        """A term at a place: a ``knot`` (x, c0), a ``segment`` (x, x1, c0, c1, h), or ``between`` two knots, with the
        same variables as a segment and the fraction of it as first parameter.

        When its law asks for the time, the lengths of all ``phases`` are variables too, and parameters (phases,) say
        how many of each have passed before: the second value is True.
        """
        now, lengths, passed = ca.SX.sym("t"), ca.SX.sym("lengths", phases), ca.SX.sym("passed", phases)
        p = ca.SX(0, 1)
        view: KnotView | SegmentView
        if place == "segment":
            y, view = self._segment_view(now)
        elif place == "knot":
            v = self._symbols("x", "c0")
            y, view = ca.vertcat(*v.values()), knot_view(self, v["x"], v["c0"], now)
        else:
            v, p = self._symbols("x", "x1", "c0", "c1", "h"), ca.SX.sym("fraction")
            y, view = ca.vertcat(*v.values()), between_view(self, v, p, now + p * v["h"])
        value = self.law(term, view)
        timed = bool(ca.depends_on(value, now))
        if timed:
            value = ca.substitute(value, now, ca.dot(lengths, passed))
            y, p = ca.vertcat(y, lengths), ca.vertcat(p, passed)
        if isinstance(term, Cost):
            return Element(term.name, y, p, f=term.weight * value), timed
        return Element(term.name, y, p, g=value, lower=term.lower, upper=term.upper), timed

    def law(self, term: Term, view: KnotView | SegmentView) -> Any:
        """A term's law of a view, a dense column."""
        return _law_of(term, view)

    def _kept(self, key: Any, make: Callable[[], Element]) -> Element:
        if key not in self._elements:
            self._elements[key] = make()
        return self._elements[key]

    @cached_property
    def gauge(self) -> Element:
        """Unit norm of the first quaternion; the steps keep it."""
        v = self._symbols("x")
        q = self.split(v["x"])[0][0:4]
        return Element("gauge", v["x"], ca.SX(0, 1), g=ca.dot(q, q) - 1)

    def clearance(self, cover: Cover, k: int, landed: int, between: bool, wary: bool) -> Element:
        """Spheres off what stands (field ``k`` = 0) or moves at a node (x, h), or half way along a substep (x, z, h).

        Parameters: the clearance asked for, and the weight of `repulsion`, which costs something when ``wary``; then
        for every landing of ``landed`` what `Cover.landing` says, or for what moves where it is.
        """
        key = (k, landed, between, wary)
        if key not in cover.elements:
            cover.elements[key] = self._clearance(cover, *key)
        return cover.elements[key]

    def _clearance(self, cover: Cover, k: int, landed: int, between: bool, wary: bool) -> Element:
        field, radii = cover.fields()[k], cover.radii
        assert field is not None
        v = self._symbols(*(("x", "z", "h") if between else ("x", "h")))
        y, none = ca.vertcat(*v.values()), ca.SX.zeros(self.sizes[3])
        view = middle_view(self, v["x"], v["z"], none, v["h"]) if between else knot_view(self, v["x"], none)
        asked, weight = ca.SX.sym("asked"), ca.SX.sym("weight")
        more = ca.SX.sym("more", POSE if k else landed * (3 + len(radii)))
        points = [view.position + view.rotation @ ca.DM(c) for c in cover.centres]
        wanted = ca.repmat(asked, len(radii), 1)
        if k:  # what moves is met in its own frame
            there, R_wo = more[:3], ca.reshape(more[3:], 3, 3)
            points = [R_wo.T @ (point - there) for point in points]
        else:
            for landing in ca.vertsplit(more, 3 + len(radii)) if landed else []:
                distance = ca.sqrt(ca.sumsqr(view.position - landing[:3]) + ROUND**2) - ROUND
                touching = ca.fmin(landing[3:], asked - ROUND)
                wanted = ca.fmin(wanted, approach(distance, asked, touching, ca.tanh))
        models = ca.SX.sym("models", 13, len(radii))
        met = ca.horzcat(*points)
        free = second_order(met, models) - ca.DM(radii)
        return Element(
            "clearance",
            y,
            ca.vertcat(asked, weight, more),
            f=weight * v["h"] / 2 * repulsion(free) if wary else 0.0,
            g=free - wanted,
            lower=0.0,
            upper=np.inf,
            seen=Seen(met, models, field.models),
        )


@lru_cache(maxsize=32)
def transcription(vehicle: Vehicle) -> Transcription:
    """The vehicle's transcription, built once."""
    return Transcription(vehicle)


def _law_of(term: Term, view: KnotView | SegmentView) -> Any:
    """A law's expression as a dense SX column; what goes wrong in it is named."""
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
            f"term {term.name!r}: its law cannot be evaluated: {error}; see vehsim.planning.KnotView"
        ) from error
    if value.shape[1] != 1 or (isinstance(term, Cost) and value.shape[0] != 1):
        wanted = "a scalar" if isinstance(term, Cost) else "a column"
        raise InputError(f"term {term.name!r}: its law gives shape {value.shape}; give {wanted}")
    return ca.densify(value)
