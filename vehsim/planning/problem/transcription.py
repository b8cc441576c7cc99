"""A vehicle's discrete mechanics in the optimisation problem: variables of a knot and a segment, and their scales.

Variables, knot by knot: states ``(g, r, pi)``, segment velocities ``z``, knot controls, and a segment duration for
every leg between two marks. Momenta and controls are scaled to the size of velocities and of typical controls.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.integrators import DiscreteMechanics
from vehsim.integrators.continuous import equations_of_motion
from vehsim.integrators.discrete import mechanics_of
from vehsim.lie.maps import DEFAULT_MAP
from vehsim.planning.problem.elements import Element, SpatialField
from vehsim.vehicles import Vehicle
from vehsim.world.ground.slope import Weight

Array = NDArray[np.float64]
Made = TypeVar("Made", Element, Element | None)


class Transcription:
    """A vehicle, its mechanics, the scales of its variables, and the elements shared by its problems of any length."""

    def __init__(self, vehicle: Vehicle):
        self.vehicle = vehicle
        self.mechanics: DiscreteMechanics = mechanics_of(vehicle, DEFAULT_MAP, "galerkin")
        self.sizes = self.mechanics.sizes
        self.control_scale = np.array([c.scale for c in vehicle.controls])
        self.momentum_scale = self._mass()
        self._elements: dict[Hashable, Any] = {}

    def _mass(self) -> Array:
        m = self.mechanics
        r, n = np.zeros(self.sizes[1]), self.sizes[2]
        c = np.zeros(self.sizes[3])
        zero = np.ravel(np.asarray(m.knot_velocity_guess(r, np.zeros(n), c)))
        mobility = np.array([np.ravel(np.asarray(m.knot_velocity_guess(r, e, c))) - zero for e in np.eye(n)])
        return 1 / np.abs(np.diag(mobility)) if n else np.zeros(0)

    def symbols(self, *names: str) -> dict[str, Any]:
        """Symbols of a segment's variables by name: states ``x, x1``, velocity ``z``, controls ``c0, c1``, length ``h``
        (controls over their scale)."""
        size, s, n, c = self.sizes
        shapes = {"x": size + s + n, "x1": size + s + n, "z": n, "c0": c, "c1": c, "h": 1}
        return {name: ca.SX.sym(name, shapes[name]) for name in names}

    def split(self, x: Any) -> tuple[Any, Any, Any]:
        """``g, r`` and the unscaled ``pi`` of a state."""
        size, s, n = self.sizes[:3]
        g, r, pi = ca.vertsplit(x, [0, size, size + s, size + s + n])
        return g, r, pi * self.momentum_scale

    @cached_property
    def idle(self) -> list[int]:
        """Joints that influence neither the motion nor a limit, such as a wheel's roll."""
        law = equations_of_motion(self.vehicle)  # executes controls anyway, so that it costs nothing
        moving = {joint for rate in (0, 2) for joint in law.jac_sparsity(rate, 1).get_triplet()[1]}
        named = enumerate(self.vehicle.joints)
        return [i for i, name in named if name not in self.vehicle.joint_limits and i not in moving]

    @cached_property
    def variational(self) -> Element:
        """The discrete equations of a segment of order 2, those of the integrator: (x, z, c0, c1, x1, h).

        Parameter: ``wind`` (3,) m/s.
        """
        v, wind = self.symbols("x", "z", "c0", "c1", "x1", "h"), ca.SX.sym("wind", 3)
        g, r, pi = self.split(v["x"])
        g1, r1, pi1 = self.split(v["x1"])
        given = (g, r, v["z"], v["c0"] * self.control_scale, v["c1"] * self.control_scale, v["h"], wind)
        segment, weight = self.segment, self.weight
        cells = ca.SX.sym("cells", segment.size_in("cell")[0], 2)
        left, _, next_g, next_r = segment(*given, cells[:, 0])
        _, right, _, _ = segment(*given, cells[:, 1])
        residuals = ((left - pi) / self.momentum_scale, (right - pi1) / self.momentum_scale, next_g - g1, next_r - r1)
        space = None
        if weight is not None:
            places = ca.horzcat(weight.place(g), weight.place(next_g))
            models = ca.vertcat(ca.SX.sym("places", 2, 2), cells)
            space = SpatialField(places, models, lambda count, order: weight.relief.cells(count))
        return Element("dynamics", ca.vertcat(*v.values()), {"wind": wind}, g=ca.vertcat(*residuals), space=space)

    @cached_property
    def weight(self) -> Weight | None:
        """The vehicle's weight on a terrain, if it has one."""
        potential = getattr(self.vehicle, "potential_energy", None)
        return potential if isinstance(potential, Weight) else None

    @cached_property
    def local(self) -> tuple[Any, Vehicle]:
        """Symbols of the terrain's cell in which the weight acts, see `Relief.cells`, and the vehicle within that cell.

        Without a weight on a terrain, there are no symbols, and it is the vehicle itself.
        """
        if self.weight is None:
            return ca.SX.sym("cell", 0), self.vehicle
        # everywhere at once, the terrain would need a hundred times as many operations
        cell = ca.SX.sym("cell", self.weight.relief.CELL)
        return cell, replace(self.vehicle, potential_energy=replace(self.weight, cell=cell))  # type: ignore[call-arg]  # a weight belongs to a nonholonomic vehicle

    @property
    def segment(self) -> ca.Function:
        """``(g, r, z, c0, c1, h, wind, cell) -> (left, right, g1, r1)`` of `DiscreteMechanics.segment`; ``cell``: see
        `local`."""
        cell, vehicle = self.local
        step = mechanics_of(vehicle, DEFAULT_MAP, "galerkin")
        names = ("g", "r", "z", "c0", "c1", "h", "wind")
        inputs, results = [step.symbols[name] for name in names], ("left", "right", "g1", "r1")
        return ca.Function(
            "segment", [*inputs, cell], [step.segment[name] for name in results], [*names, "cell"], list(results)
        )

    def kept(self, key: Hashable, make: Callable[[], Made]) -> Made:
        """The element stored under ``key``, or the one that ``make`` builds; it is differentiated only once."""
        if key not in self._elements:
            self._elements[key] = make()
        made: Made = self._elements[key]
        return made


@lru_cache(maxsize=32)
def transcribe(vehicle: Vehicle) -> Transcription:
    """The vehicle's transcription, built once and cached."""
    return Transcription(vehicle)
