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
from vehsim.integrators.continuous import local_equations
from vehsim.integrators.discrete import Loads, mechanics_of
from vehsim.lie.maps import DEFAULT_MAP
from vehsim.planning.problem.elements import Element, SpatialField
from vehsim.vehicles import Holonomic, Vehicle
from vehsim.vehicles.definition.mechanics import conservative
from vehsim.vehicles.definition.resistance import in_pieces, speeds_of
from vehsim.world.ground.below import Below
from vehsim.world.ground.slope import Relief, Weight

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
        if not self.vehicle.joints:
            return []
        law, _ = local_equations(self.vehicle)  # executes controls anyway, so that it costs nothing
        moving = {joint for rate in (0, 2) for joint in law.jac_sparsity(rate, 1).get_triplet()[1]}
        named = enumerate(self.vehicle.joints)
        return [i for i, name in named if name not in self.vehicle.joint_limits and i not in moving]

    @cached_property
    def variational(self) -> Element:
        """The discrete equations of a segment of order 2, those of the integrator: (x, z, c0, c1, x1, h).

        Parameters: `air`.
        """
        m, v = self.mechanics, self.symbols("x", "z", "c0", "c1", "x1", "h")
        g, r, pi = self.split(v["x"])
        g1, r1, pi1 = self.split(v["x1"])
        c0, c1 = v["c0"] * self.control_scale, v["c1"] * self.control_scale
        wind, depth, ground = self.air["wind"], self.air.get("depth", 0), self.ground
        cells, airs = (ca.SX.sym(name + "s", self.loads.size1_in(name), 2) for name in ("cell", "air"))
        piece, end = ca.SX.sym("piece", self.loads.size1_in("piece")), ca.SX.sym("end", g.shape[0])

        def loads(k: int, *motion: Any) -> Loads:
            forces: Any = self.loads(*motion, wind, cells[:, k] - depth, piece, airs[:, k])
            return forces[:2], forces[2:]

        segment = m.segment_under(loads, end)
        given = [m.symbols[name] for name in ("g", "r", "z", "c0", "c1", "h")]
        found = [segment[name] for name in ("left", "right", "g1", "r1")]
        left, right, next_g, next_r = ca.substitute(found, given, [g, r, v["z"], c0, c1, v["h"]])
        residuals = ((left - pi) / self.momentum_scale, (right - pi1) / self.momentum_scale, next_g - g1, next_r - r1)
        space = None
        if ground is not None:
            places = ca.horzcat(ground.place(g), ground.place(next_g))
            models = ca.vertcat(ca.SX.sym("places", 2, 2), cells)
            space = SpatialField(places, models, lambda count, order: ground.cells(count))
        blown = self.blown(airs, (g, v["z"]), (end, v["z"]))  # a segment has one velocity
        return Element(
            "dynamics", ca.vertcat(*v.values()), self.air, g=ca.vertcat(*residuals), space=space,
            inner=[*blown[:1], (end, next_g), *blown[1:]], table=self.looked_up(piece, (g, v["z"])),
        )  # fmt: skip

    @cached_property
    def _on_relief(self) -> tuple[str, Any]:
        """The field of the vehicle that depends on the ground's relief, and its law; None: no field does."""
        laws = ((field, getattr(self.vehicle, field, None)) for field in ("potential_energy", "ground"))
        return next(((field, law) for field, law in laws if isinstance(law, Weight | Below)), ("", None))

    @property
    def ground(self) -> Any:
        """The vehicle's weight on a terrain's relief, or the relief below its rotors; None: neither."""
        return self._on_relief[1]

    @property
    def rides_on_air(self) -> bool:
        """Whether there is ground below rotors, which need less power near it."""
        return isinstance(self.ground, Below)

    @cached_property
    def air(self) -> dict[str, Any]:
        """Symbols of what a solve is given of the surroundings, by name: ``wind`` (3,) m/s, and for rotors above ground
        ``depth`` m, by which the ground is lower."""
        return {"wind": ca.SX.sym("wind", 3)} | ({"depth": ca.SX.sym("depth")} if self.rides_on_air else {})

    @cached_property
    def in_air(self) -> Vehicle:
        """The vehicle above its ground at the ``depth`` of `air`."""
        if not self.rides_on_air:
            return self.vehicle
        return replace(self.vehicle, ground=replace(self.ground, depth=self.air["depth"]))  # type: ignore[call-arg]  # a holonomic vehicle has it

    @cached_property
    def local(self) -> tuple[Any, Vehicle]:
        """Symbols of the relief's cell at which the vehicle is, see `Relief.cells`, and the vehicle within that cell.

        Without a relief, there are no symbols, and it is the vehicle itself.
        """
        field, law = self._on_relief
        if law is None:
            return ca.SX.sym("cell", 0), self.vehicle
        # everywhere at once, the relief would need a hundred times as many operations
        cell = ca.SX.sym("cell", law.CELL)
        return cell, replace(self.vehicle, **{field: replace(law, cell=cell)})

    @cached_property
    def local_in_air(self) -> tuple[Any, Vehicle]:
        """The same as `local`, of the vehicle `in_air`."""
        cell, vehicle = self.local
        if not self.rides_on_air:
            return cell, vehicle
        return cell, replace(vehicle, ground=replace(vehicle.ground, depth=self.air["depth"]))  # type: ignore[attr-defined, call-arg]  # a holonomic vehicle has it

    @cached_property
    def within(self) -> tuple[Any, Any, Vehicle]:
        """The same as `local`, and between both the symbols of `in_pieces`."""
        cell, vehicle = self.local
        return cell, *in_pieces(vehicle)

    def looked_up(self, pieces: Any, *motions: tuple[Any, Any]) -> SpatialField | None:
        """Where to look up ``pieces`` (n, k), symbols as of `within` for each of k ``motions``: pairs of a pose and a
        velocity."""
        if not pieces.numel():
            return None
        vehicle: Any = self.vehicle
        speeds, curves = speeds_of(vehicle, *motions).T, vehicle.resistance.curves
        models = ca.vertcat(ca.SX.sym("speeds", *speeds.shape), ca.reshape(pieces, curves.size, -1))
        return SpatialField(speeds, models, lambda count, order: curves.pieces_at(count))

    def space(self, g: Any) -> SpatialField | None:
        """The relief below the pose ``g`` in the symbols of `local`, for an element; None without one."""
        ground = self.ground
        if ground is None:
            return None
        models = ca.vertcat(ca.SX.sym("place", 2), self.local[0])
        return SpatialField(ground.place(g), models, lambda count, order: ground.cells(count))

    @property
    def relief(self) -> Relief | None:
        """The relief that carries the vehicle's weight; None: it stands on level ground or flies."""
        return self.ground.relief if isinstance(self.ground, Weight) else None

    def followed(self, places: Array, velocities: Array) -> tuple[Array, Array]:
        """`Relief.followed` of the ground that carries the vehicle, at places and velocities (n, 2 or more) m, m/s."""
        if self.relief is None:
            return np.zeros((len(places), 2)), np.zeros(len(places))
        return self.relief.followed(places[:, :2], velocities[:, :2])

    def cells(self, count: int) -> ca.Function:
        """Poses (n, count) -> the values of `local`'s symbols there, as columns."""
        g, ground = ca.SX.sym("g", self.sizes[0]), self.ground
        if ground is None:
            return ca.Function("cells", [g], [ca.SX(0, 1)]).map(count)
        poses, place = ca.MX.sym("poses", self.sizes[0], count), ca.Function("place", [g], [ground.place(g)])
        return ca.Function("cells", [poses], [ground.cells(count)(place.map(count)(poses))])

    @cached_property
    def loads(self) -> ca.Function:
        """``(g, r, u, xi, c, wind, cell, piece, air)`` -> applied forces and forces of a potential, each on the joints
        and on the group; ``cell, piece`` as in `within`, ``air`` as in `blown`."""
        m, (cell, piece, vehicle) = self.mechanics, self.within
        g, r, c, wind = (m.symbols[name] for name in ("g", "r", "c0", "wind"))
        u, xi, air = ca.SX.sym("u", r.shape[0]), ca.SX.sym("xi", vehicle.group.dim), ca.SX.sym("air", 0)
        if isinstance(vehicle, Holonomic) and not vehicle.group.planar and (vehicle.drag or vehicle.rotors):
            air = ca.SX.sym("air", 3)
            vehicle = replace(vehicle, air=air)
        forces = [*vehicle.force(g, r, u, xi, c, wind), *conservative(vehicle, g, r)]
        names = ["g", "r", "u", "xi", "c", "wind", "cell", "piece", "air"]
        results = ["on_joints", "on_group", "steady_on_joints", "steady_on_group"]
        return ca.Function(
            "loads", [g, r, u, xi, c, wind, cell, piece, air], [ca.densify(x) for x in forces], names, results
        )

    def blown(self, airs: Any, *motions: tuple[Any, Any]) -> list[tuple[Any, Any]]:
        """``airs`` (n, k), symbols of velocities through the air, with their expressions at k ``motions``: pairs of a
        pose and a velocity; none unless drag or rotors act on a body in space."""
        n, vehicle = airs.shape[0], self.vehicle
        if not n or not isinstance(vehicle, Holonomic):
            return []
        wind = self.air["wind"]
        return [(airs[:, k], vehicle.through_air(*motion, wind)[-n:]) for k, motion in enumerate(motions)]

    @cached_property
    def newton(self) -> tuple[ca.Function, ca.Function]:
        """Of ``(z, g, r, pi, c0, c1, h, wind, cell)``: the velocity ``z`` of a segment after a step of Newton's method,
        and ``(g1, r1, pi1)`` at its end; ``cell`` as in `local`."""
        cell, vehicle = self.local
        step = mechanics_of(vehicle, DEFAULT_MAP, "galerkin")
        g, r, z, c0, c1, h, wind = (step.symbols[name] for name in ("g", "r", "z", "c0", "c1", "h", "wind"))
        left, right, g1, r1 = (step.segment[name] for name in ("left", "right", "g1", "r1"))
        pi = ca.SX.sym("pi", z.shape[0])
        missing = left - pi
        slope = ca.jacobian(missing, z)
        better = z - (ca.solve(slope, missing) if z.shape[0] else missing)
        given = [z, g, r, pi, c0, c1, h, wind, cell]
        return ca.Function("newton", given, [better]), ca.Function("end", given, [g1, r1, right - missing])

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
