"""DMOC: a vehicle's discrete mechanics, marks, limits and clearance as one sparse optimisation problem.

Variables, knot by knot: node states ``(g, r, pi)``, segment velocities ``z``, knot controls, and a segment length for
every phase between two marks. At order 4 a segment is five symmetric substeps (Suzuki), each with a node of its own.
Momenta and controls are scaled to the size of velocities and of typical controls.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.integrators import DiscreteMechanics
from vehsim.integrators.integrator import mechanics_of
from vehsim.lie import SO3
from vehsim.planning.elements import Element
from vehsim.planning.layout import Layout as Layout
from vehsim.planning.marks import Mark
from vehsim.planning.terms import COSTS, LIMITS, KnotView, SegmentView
from vehsim.vehicles import Vehicle
from vehsim.vehicles.mechanics import conservative, project

Array = NDArray[np.float64]

MARK_PARAMETERS = {"position": 3, "heading": 1, "orientation": 4, "velocity": 3, "speed": 1}
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

    @cached_property
    def cost(self) -> Element:
        """Weighted costs of one segment: (x, x1, c0, c1, h), with the weights as parameters."""
        v = self._symbols("x", "x1", "c0", "c1", "h")
        weights = ca.SX.sym("weights", len(COSTS))
        ends = (self._view(v["x"], v["c0"]), self._view(v["x1"], v["c1"]))
        view = SegmentView(*ends, v["c0"], v["c1"], v["h"])
        total = ca.dot(weights, ca.vertcat(*(law(view) for law in COSTS.values())))
        return Element("cost", ca.vertcat(*v.values()), weights, f=total)

    def limit(self, name: str, value: float) -> Element:
        """A limit at one knot: (x, c0)."""
        v = self._symbols("x", "c0")
        law = LIMITS[name](self._view(v["x"], v["c0"]))
        return Element(f"limit {name}", ca.vertcat(*v.values()), ca.SX(0, 1), g=law / value, lower=-np.inf, upper=1.0)

    @cached_property
    def gauge(self) -> Element:
        """Unit norm of the first quaternion; the steps keep it."""
        v = self._symbols("x")
        q = self.split(v["x"])[0][0:4]
        return Element("gauge", v["x"], ca.SX(0, 1), g=ca.dot(q, q) - 1)

    def mark(self, mark: Mark) -> Element | None:
        """What a mark asks at its knot: (x, c0), with its values as parameters (``mark_values``)."""
        v = self._symbols("x", "c0")
        parameters = {key: ca.SX.sym(key, size) for key, size in self.mark_sizes.items()}
        wind = ca.SX.sym("wind", 3)
        view = self._view(v["x"], v["c0"])
        velocity, omega, rotation = view.velocity, view.omega, view.rotation
        g, r, _ = self.split(v["x"])
        root = self._root(g)
        rows: list[tuple[Any, float, float]] = []
        spatial = self.vehicle.group.dim == 6

        def equal(expression: Any, slack: float = 0.0) -> None:
            rows.extend((row, -slack, slack) for row in ca.vertsplit(expression))

        if mark.position is not None:
            shown = 3 if spatial else 2
            equal((root[0:3] - parameters["position"])[:shown], mark.tolerance)
        if mark.orientation is not None:
            equal(SO3.compose(SO3.inverse(parameters["orientation"]), root[3:7])[1 if spatial else 3 : 4])
        elif mark.heading is not None:
            c, s = ca.cos(parameters["heading"]), ca.sin(parameters["heading"])
            equal(c * rotation[1, 0] - s * rotation[0, 0])
            rows.append((c * rotation[0, 0] + s * rotation[1, 0], 0.0, np.inf))
        if mark.balanced:
            equal(self._imbalance(g, r, v["c0"], wind))
        if mark.velocity is not None:
            equal(self._velocity_error(mark, view, parameters["velocity"]))
        if mark.at_rest and spatial:
            equal(omega)
        if mark.speed is not None:
            equal(velocity if mark.speed == 0 and spatial else _speed(velocity) - parameters["speed"])
        if mark.joints is not None:
            equal(r - parameters["joints"])
        if not rows:
            return None
        g_rows, lower, upper = zip(*rows, strict=True)
        y, p = ca.vertcat(*v.values()), ca.vertcat(wind, *parameters.values())
        return Element("mark", y, p, g=ca.vertcat(*g_rows), lower=lower, upper=upper)

    def _imbalance(self, g: Any, r: Any, c: Any, wind: Any) -> Any:
        """Acceleration along the free velocities of a vehicle that stands still, (n_z,)."""
        vehicle = self.vehicle
        still = (ca.SX.zeros(len(vehicle.joints)), ca.SX.zeros(vehicle.group.dim))
        forces = vehicle.force(g, r, *still, c * self.control_scale, wind)
        weight = conservative(vehicle, g, r)
        total = [a + b for a, b in zip(forces, weight, strict=True)]
        return project(vehicle, r, *total) / self.momentum_scale

    @cached_property
    def hold(self) -> Element:
        """Controls that stay as they are: (c0, c1)."""
        v = self._symbols("c0", "c1")
        return Element("hold", ca.vertcat(*v.values()), ca.SX(0, 1), g=v["c1"] - v["c0"])

    def _velocity_error(self, mark: Mark, view: KnotView, wanted: Any) -> Any:
        """What is missing to a velocity; where rolling leaves one way to go, standing still is one equation."""
        error = view.velocity - wanted
        if self.vehicle.group.dim == 6:
            return error
        stuck = mark.at_rest and self.sizes[2] == 1
        return view.rotation[0:2, 0].T @ error[0:2] if stuck else error[0:2]

    @cached_property
    def mark_sizes(self) -> dict[str, int]:
        return {**MARK_PARAMETERS, "joints": self.sizes[1]}

    def mark_values(self, mark: Mark) -> Array:
        """Parameter values of a mark, zeros where it asks nothing."""
        values = []
        for key, size in self.mark_sizes.items():
            given = getattr(mark, key)
            given = np.zeros(size) if given is None else np.atleast_1d(np.asarray(given, float))
            values.append(np.deg2rad(given) if key == "heading" else given)
        return np.concatenate(values)

    def clearance(self, field: Any, centres: Array, radii: Array, between: bool) -> Element:
        """Spheres (k, 3), (k,) off the rock at a node, (x), or half way along a substep, (x, z, h) when ``between``.

        Parameter: the clearance asked for. MX, because the field is a spline.
        """
        v = self._symbols(*(("x", "z", "h") if between else ("x",)))
        y = ca.vertcat(*v.values())
        g, r, _ = self.split(v["x"])
        if between:
            from vehsim.lie import difference_map
            from vehsim.vehicles.mechanics import free_velocity

            group = self.vehicle.group
            xi = free_velocity(self.vehicle, r, v["z"], ca.SX(len(self.vehicle.joints), 1))[1]
            g = group.compose(g, difference_map(self.mechanics.map_name, group).tau(v["h"] / 2 * xi))
        root = self._root(g)
        points = [root[0:3] + SO3.matrix(root[3:7]) @ ca.DM(c) for c in centres]
        place = ca.Function("place", [y], [ca.horzcat(*points)])
        my, asked = ca.MX.sym("y", y.shape[0]), ca.MX.sym("asked", 1)
        distances = field.map(len(radii))(place(my)) if len(radii) > 1 else field(place(my))
        g_rows = distances.T - ca.DM(radii) - asked
        return Element("clearance", my, asked, g=g_rows, lower=0.0, upper=np.inf)

    def _root(self, g: Any) -> Any:
        """Pose (7,) of the rig's root."""
        pose = self.vehicle.group.pose(g)
        return ca.vertcat(pose[0:3] - SO3.matrix(pose[3:7]) @ ca.DM(self.vehicle.origin), pose[3:7])

    def _view(self, x: Any, c: Any) -> KnotView:
        g, r, pi = self.split(x)
        root, twist, _, _ = self.mechanics.root_state(g, r, pi, c * self.control_scale)
        rotation = SO3.matrix(root[3:7])
        if self.vehicle.group.dim == 6:
            return KnotView(root[0:3], rotation @ twist[3:6], twist[0:3], rotation)
        planar, turning = ca.vertcat(twist[1:3], 0), ca.vertcat(0, 0, twist[0])
        return KnotView(root[0:3], rotation @ planar, turning, rotation)


@lru_cache(maxsize=32)
def transcription(vehicle: Vehicle) -> Transcription:
    """The vehicle's transcription, built once."""
    return Transcription(vehicle)


def _speed(velocity: Any) -> Any:
    return ca.sqrt(ca.sumsqr(velocity) + 1e-10)
