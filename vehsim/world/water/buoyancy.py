"""The effect of water on a hull: buoyancy by exact integration over the wetted surface, and the resistance of LIE eq.
16.

`Afloat` is the `Environment` of one vehicle: pressure under the local surface, so that waves push and boats surf;
resistance of every wetted patch with the local velocity through the water; slamming, added mass, propulsors and wind.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.integrators.carried import carried, carry_on
from vehsim.integrators.environment import Environment
from vehsim.lie.quaternions import conjugate, cross, matrices, product, rotate, rotation_vectors, yaw_tilt
from vehsim.vehicles.definition.base import State
from vehsim.vehicles.definition.coefficients import LEVEL
from vehsim.world.water.height_field import MOST, WaterField
from vehsim.world.water.hull_mesh import (
    BELOW,
    COLUMNS,
    DEPTH,
    HEAD,
    PLACE,
    RISEN,
    THROUGH,
    HullMesh,
    Wetted,
    read_hull,
    wetted,
)
from vehsim.world.water.hull_repair import repaired
from vehsim.world.water.motion import Motion
from vehsim.world.water.potential import Response, response
from vehsim.world.water.running import Law, Lift, law_of, steady
from vehsim.world.water.seakeeping import Seakeeping
from vehsim.world.water.water import Water

if TYPE_CHECKING:
    from vehsim.vehicles.definition.hydrodynamics import Hull

Array = NDArray[np.float64]

BEND = 1 / 5000
"""Error of the surface by Simpson's rule along an edge, as a share of the hull's mean draft, in waves as long as the
hull or longer. For shorter waves it may be larger, because it averages out along the hull."""
FINEST = 1 / 16
"""Edges need not be shorter than this share of the shortest wave; none is longer than that wave."""
COARSEST = 1 / 2
"""No edge is longer than this share of the hull's length, because the resistance varies along it when the hull
turns."""
FIELD = 1 / 375
"""Mean deviation of triangles between samples of the surface, which the height field makes good, as a share of the
hull's mean draft, in waves as long as the hull or longer; larger in shorter ones, because it averages out."""
OTHER = 0.1
"""Coefficients are those of another hull if it floats higher or lower by this share of its mean draft."""
EMPTY = 1e-4
"""Hulls that displace less of their volume are probably in other units than their mass."""
PANEL = 1 / 7
"""Longest edge of the panels that determine how waves act on the hull, as a share of its size."""
PLACES = 9
"""Places along and across the hull at which a boat that starts on waves meets their surface."""
INSTANT = 1e-3
"""Time from which its first velocity is taken, s."""
STILL, UNMOVED = 1e-3, 1e-4
"""A hull is at rest on calm water if no point of it is faster, m/s, nor accelerates more, m/s^2: it drifts on by a
centimetre at most if its speed falls by a factor of e in ten seconds."""
NUDGE = 1e-3
"""Share of its size, and angle in rad, by which a floating hull is moved to see whether it comes back."""
NEUTRAL = 1e-6
"""Share of the stiffness in heave that counts as none: a ball may roll."""
PANELS = 300
"""Hulls with more faces are simplified to this many before."""


class Weather(Protocol):
    """The water and wind of a world."""

    water: Water | None

    def wind_at(self, t: float) -> Array:
        """Wind (3,) m/s, world axes, ``t`` s since the first frame."""


@dataclass(eq=False)
class Afloat(Environment):
    """One vehicle in a world's water. Raises ``InputError`` if its hull is not valid."""

    CARRIED = ("_last",)
    free = True
    vehicle: Any
    world: Weather
    _last: tuple[State, Forces, Array, Array] | None = None
    """The state, forces, controls and wind of the last evaluation."""

    @property
    def data(self) -> Hull:
        return self.vehicle.hull

    @property
    def water(self) -> Water:
        water = self.world.water
        assert water is not None
        return water

    @cached_property
    def hull(self) -> HullMesh:
        """The hull as given, `repaired`, relative to the body frame's origin."""
        hull, rig = self.data, self.vehicle.rig
        if hull.points is not None:
            mesh = HullMesh(hull.points, hull.faces, f"{self.vehicle.name}: hull")
        elif hull.prim and rig is not None:
            mesh = read_hull(rig.asset, rig.root, hull.prim)
        else:
            raise InputError("missing", "name a closed mesh of its asset", key="hull", subject=self.vehicle.name)
        mesh = repaired(mesh).shifted(self.vehicle.origin)
        if self.rest_volume < EMPTY * mesh.volume:
            warnings.warn(
                f"{mesh.name}: displaces {self.rest_volume:.3g} of its {mesh.volume:.3g} m^3 and hardly touches the"
                " water; check physics.mass and the asset's metersPerUnit",
                stacklevel=2,
            )
        return mesh

    @cached_property
    def size(self) -> Array:
        """Size of the box around the hull (3,) m, along the body's axes."""
        return np.asarray(np.ptp(self.hull.points, axis=0))

    @property
    def draft(self) -> float:
        """Mean draft: the volume at rest divided by the area of that box from above, m."""
        return self.rest_volume / float(self.size[0] * self.size[1])

    @cached_property
    def mesh(self) -> HullMesh:
        """The hull with edges fine enough for the water."""
        length, wave = float(self.size.max()), self.water.shortest
        if self.water.flat:
            return self.hull.refined(COARSEST * length)
        miss = BEND * self.draft * max(1.0, length / wave) ** 2
        fourth = self.water.curvature * (2 * np.pi / wave) ** 2  # derivative of the height
        edge = (2880 * miss / max(fourth, 1e-12)) ** 0.25
        return self.hull.refined(min(COARSEST * length, float(np.clip(edge, FINEST * wave, wave))))

    @cached_property
    def field(self) -> WaterField | None:
        """The height field in MuJoCo for the water over the hull; None: the surface's formula is used."""
        cell, samples = self.samples
        return WaterField(self.water, cell, samples) if samples else None

    @property
    def samples(self) -> tuple[float, int]:
        """Cell (m) and samples per side of that field; 0 samples: no field. Raises ``InputError``."""
        cell, water = self.water.height_field, self.water
        if cell == 0:
            return 0.0, 0
        corners = np.concatenate([self.mesh.points, self.data.propulsor_points, np.zeros((1, 3))])
        reach = 2 * float(np.sqrt((corners**2).sum(axis=1).max()))
        if cell is None:
            miss = FIELD * self.draft * max(1.0, float(self.size.max()) / water.shortest)
            bend = np.sqrt(12 * miss / max(water.curvature, 1e-12))
            cell = max(min(bend, water.shortest / 8, reach / 2), reach / (MOST - 6))
        if water.grids is not None:
            cell = min(water.grids.cell)
        samples = int(np.ceil(reach / cell)) + 5
        if samples > MOST and water.grids is not None:
            return cell, 0  # same results, but slower
        if samples > MOST:
            message = f"{samples} samples per side for a width of {reach:.0f} m, at most {MOST} are possible"
            raise InputError(message, "give a wider cell, or 0", key="world.water.height_field", value=cell)
        return float(cell), samples

    @cached_property
    def response(self) -> Response:
        """How the motion of the water acts on the hull: over its wetted surface at rest, and not at one point."""
        if not np.any(self.added_mass_at_rest):
            return Response.at_origin()
        hull = self.hull.simplified(PANELS).refined(PANEL * float(self.size.max()))
        top = -float(hull.points[:, 2].min())  # of the origin, where the hull leaves the water
        sinks = self.mesh.volume <= self.rest_volume
        height = -float(10 * self.size.max()) if sinks else min(self.floating()[0], top)
        wet = wetted(np.column_stack([hull.points, -height - hull.points[:, 2]]), hull.faces)
        return response(wet.corners, -height)

    @cached_property
    def law(self) -> Law:
        """Lift and resistance of the hull's `Running`, for its wetted patches."""
        return law_of(self)

    @cached_property
    def seakeeping(self) -> Seakeeping | None:
        """What the hull's `Coefficients` say about its motions in the water's waves; None: it has none."""
        data = self.data.coefficients
        if data is None:
            return None
        deeper = data.height - self.floating()[0]
        if abs(deeper) > OTHER * self.draft:
            warnings.warn(
                f"{self.vehicle.name}: hydrodynamics: the hull floats {deeper:+.3g} m deeper than the one that was "
                "computed; run vehsim hydro again",
                stacklevel=2,
            )
        return Seakeeping(data, self.water)

    @property
    def added_mass_at_rest(self) -> Array:
        """Diagonal (6,) of the added mass: computed or given."""
        if self.seakeeping is not None:
            return np.diag(self.seakeeping.added)
        return np.asarray(self.data.added_mass, float)

    @cached_property
    def added_mass(self) -> Array:
        """The added mass (6, 6) of the hull at rest. Where its diagonal is given, the coupling of motions in the
        waterplane with those out of it, such as sway with roll, is that of the hull's potential flow. In the waterplane
        there is none, as in the planar form of the vehicle."""
        if self.seakeeping is not None:
            return self.seakeeping.added
        given, own = np.asarray(self.data.added_mass, float), self.response.added
        size = np.sqrt(given / np.maximum(np.diag(own), 1e-9 * max(np.diag(own).max(), 1e-300)))
        added = size[:, None] * own * size
        added[np.ix_(LEVEL, LEVEL)] = 0.0
        np.fill_diagonal(added, given)
        return added

    @cached_property
    def reference_area(self) -> float:
        """Wetted area (m^2) to which the hull's resistance refers; default: as the hull floats upright at rest."""
        if self.data.reference_area:
            return float(self.data.reference_area)
        return self.floating()[1].area

    @cached_property
    def rest_volume(self) -> float:
        """The volume that the vehicle displaces when it floats, m^3."""
        return self.mass / self.water.density

    @property
    def mass(self) -> float:
        return float(self.vehicle.inertia[5, 5] if self.vehicle.mass is None else self.vehicle.mass)

    def floating(self) -> tuple[float, Wetted]:
        """Height (m) of the body frame's origin above calm water when the vehicle floats upright, and the wetted
        part."""
        from scipy.optimize import brentq

        up, points = np.array([0.0, 0.0, 1.0]), self.mesh.points
        if self.mesh.volume <= self.rest_volume:
            message = f"displaces at most {self.mesh.volume:.4g} m^3, and needs {self.rest_volume:.4g} m^3 to float"
            raise InputError(message, "lower physics.mass, or give it a larger hull", key=self.mesh.name)

        def cut(height: float) -> Wetted:
            return wetted(np.column_stack([points, -height - points[:, 2]]), self.mesh.faces)

        low, high = -float(points[:, 2].max()), -float(points[:, 2].min())
        height = brentq(lambda z: cut(z).volume(up) - self.rest_volume, low, high, xtol=1e-13)
        return float(height), cut(height)

    def riding(self, place: ArrayLike = (0.0, 0.0), heading: float = 0.0, velocity: ArrayLike = (0.0, 0.0)) -> State:
        """The state of a boat that rides the water at t = 0: with its root at ``place`` (2,) m, its nose at ``heading``
        rad, and a horizontal ``velocity`` (2,) m/s, world axes.

        It follows the plane that is closest to the surface under its hull, as high and with its bow as high as it runs
        at that speed on calm water. Raises ``InputError`` if the hull sinks.
        """
        place, velocity = np.asarray(place, float), np.asarray(velocity, float)
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        ahead = float(velocity @ turn[:, 0])
        self.floating()  # refuses a hull that sinks
        height, trim = steady(self, ahead, self.law.at(ahead))
        low, high = self.mesh.points[:, :2].min(axis=0), self.mesh.points[:, :2].max(axis=0)
        x, y = (rows.ravel() for rows in np.meshgrid(*np.linspace(low, high, PLACES).T, indexing="ij"))
        plane = np.linalg.pinv(np.column_stack([np.ones_like(x), x, y]))

        def pose(t: float) -> tuple[Array, Array]:
            root = place + velocity * t
            origin = root + turn @ self.vehicle.origin[:2]
            level, rise, lean = plane @ self.water.height(origin + np.column_stack([x, y]) @ turn.T, t)
            angles = np.array([heading, -np.arctan(rise) - trim, np.arctan(lean)])
            orientation = yaw_tilt(*angles[:, None])[0]
            return np.append(root, level + height - rotate(orientation, self.vehicle.origin)[2]), orientation

        (position, orientation), (later, turned) = pose(0.0), pose(INSTANT)
        back = conjugate(orientation)
        spin = rotation_vectors(product(back, turned)) / INSTANT
        twist = np.concatenate([spin, rotate(back, (later - position) / INSTANT)])
        return State(position=position, orientation=orientation, twist=twist)

    @cached_property
    def max_step(self) -> float:  # type: ignore[override]  # an attribute of `Environment`
        """A quarter of a radian of the fastest heave, pitch or roll, and half of the fastest linear decay."""
        plan, arms, inertia = self._scales
        stiff = np.array([1 / 3, 1 / 3, 0, 0, 0, 1]) * self.water.density * GRAVITY * plan * arms
        decay = arms * np.array([1 / 3, 1 / 3, 1, 1, 1, 1]) * float(np.max(self.data.damping))
        return float(min(0.25 / np.sqrt((stiff / inertia).max()), 0.5 / max((decay / inertia).max(), 1e-9)))

    @property
    def next_step(self) -> float:  # type: ignore[override]  # the same
        """Half of the decay time due to the speed of the surface into the water: short during slamming."""
        if self._last is None:
            return np.inf
        plan, arms, inertia = self._scales
        into, through = self._last[1].speeds
        rate = self.data.impact * self.water.density * plan * into + float(np.max(self.data.quadratic)) * through
        rate += 0.5 * self._last[1].lift.planing * self.water.density * plan * through
        share = arms * np.array([1 / 3, 1 / 3, 1 / 3, 0, 0, 1]) / inertia
        return float(0.5 / max(rate * share.max(), 1e-9))

    @property
    def steady(self) -> bool:  # type: ignore[override]  # the same
        """Whether the hull floats on calm, still water in constant wind and hardly moves."""
        water, gusts = self.water, getattr(self.world, "gusts", None)
        if self._last is None or not water.flat or water.current is not None or gusts is not None:
            return False
        twist = np.asarray(self._last[0].twist)
        velocity = twist[3:] + cross(twist[:3], self.vehicle.origin)
        return self._last[1].volume > 0 and self._fastest(twist[:3], velocity) < STILL

    def balances(self, acceleration: Array) -> bool:
        assert self._last is not None
        return self._fastest(acceleration[:3], acceleration[3:]) < UNMOVED and self.stable(self._last[0])

    def stable(self, state: State) -> bool:
        """Whether calm water brings the hull back to its heave, roll and pitch in ``state``."""
        R_wb, position, *_ = _body(state, self.vehicle.origin)
        stiffness = self._stiffness(R_wb, position[2] - self.water.level)
        least, _, most = np.linalg.eigvalsh(stiffness + stiffness.T)
        return bool(least > -NEUTRAL * most)

    def _stiffness(self, R_wb: Array, height: float) -> Array:
        """What volume times length, and its moments about the origin, lose (3, 3) over two nudges in heave, roll and
        pitch, on calm water ``height`` m below the origin. A nudge in heave is a share of the hull's length."""
        length = float(self.size.max())

        def lift(heave: float, roll: float, pitch: float) -> Array:
            quaternion = np.array([1.0, roll / 2, pitch / 2, 0.0])
            turned = matrices(quaternion / np.linalg.norm(quaternion)) @ R_wb
            depths = -height - heave * length - self.mesh.points @ turned[2]
            wet = wetted(np.column_stack([self.mesh.points, depths]), self.mesh.faces)
            x, y, _ = turned @ wet.centroid(turned[2])
            return wet.volume(turned[2]) * np.array([length, y, -x])

        return np.array([lift(*-nudge) - lift(*nudge) for nudge in NUDGE * np.eye(3)])

    @cached_property
    def natural_frequencies(self) -> Array:
        """Those of heave, roll and pitch (3,) Hz about rest on calm water, each by itself and without damping; zero
        where the hull does not come back."""
        length = float(self.size.max())
        volumes = np.diag(self._stiffness(np.eye(3), self.floating()[0])) / (2 * NUDGE * np.array([length**2, 1, 1]))
        inertia = (np.diag(self.vehicle.inertia) + self.added_mass_at_rest)[[5, 0, 1]]
        return np.sqrt(self.water.density * GRAVITY * np.maximum(volumes, 0.0) / inertia) / (2 * np.pi)

    def _fastest(self, turning: Array, moving: Array) -> float:
        """Speed of the fastest corner of the hull's box that moves and turns as given, (3,) each, or the same of
        accelerations."""
        return float(np.linalg.norm(moving + cross(turning, self._corners), axis=1).max())

    @cached_property
    def _corners(self) -> Array:
        """The corners (8, 3) of the box around the hull, m."""
        ends = np.array([self.hull.points.min(axis=0), self.hull.points.max(axis=0)])
        return np.array(list(itertools.product(*ends.T)))

    @cached_property
    def _scales(self) -> tuple[float, Array, Array]:
        """Area from above, squared lever arms (6,), and inertia (6,) with a part of the added mass."""
        size = self.size
        arms = np.array([size[1] / 2, size[0] / 2, size[0] / 2, 1, 1, 1]) ** 2
        return float(size[0] * size[1]), arms, np.diag(self.vehicle.inertia) + 0.25 * self.added_mass_at_rest

    def memory(self) -> Any:
        remembered = self.seakeeping.remembered if self.seakeeping else None
        return {
            "last": carried(self),
            "waves": carried(remembered) if remembered else None,
            "window": self.field.window if self.field else None,
        }

    def recall(self, memory: Any) -> None:
        carry_on(self, memory["last"])
        if memory["waves"] is not None:
            assert self.seakeeping is not None
            carry_on(self.seakeeping.remembered, memory["waves"])
        if self.field is not None and self.water.flat:  # waves are written anew at each evaluation
            self.field.show(0.0, memory["window"])

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        return self.forces(t, state, controls).wrench

    def added_inertia(self, t: float, state: State) -> Array | None:
        if not np.any(self.added_mass_at_rest):
            return None
        if self._last is None or self._last[0] is not state:
            self.forces(t, state, np.zeros(len(self.vehicle.controls)))
        assert self._last is not None
        return self._last[1].immersion * self.added_mass

    def forces(self, t: float, state: State, controls: Array) -> Forces:
        """All effects of water and wind on the vehicle in ``state`` at ``t`` s."""
        wind = self.world.wind_at(t)
        last = self._last
        if last and self._timeless and last[0].same(state) and all(map(np.array_equal, last[2:], (controls, wind))):
            return self._later(t)
        R_wb, position, omega, velocity = _body(state, self.vehicle.origin)
        points, faces = (self.mesh.points, self.mesh.faces) if self.water.flat else self.mesh.quadratic
        world = points @ R_wb.T + position
        others = np.concatenate([self.data.propulsor_points, self.response.points]) @ R_wb.T + position
        motion, elsewhere, flow, near = self._motion(t, world, others, faces)
        columns = np.empty((len(points), COLUMNS))
        columns[:, PLACE], columns[:, DEPTH] = points, motion.height - world[:, 2]
        columns[:, THROUGH] = velocity + cross(omega, points) - motion.velocity @ R_wb
        columns[:, HEAD] = columns[:, DEPTH] - motion.fade
        up = R_wb[2]
        torque_force, volume = np.zeros(6), 0.0
        immersion = entering = 0.0
        lift = self.law.at(float((velocity - flow @ R_wb)[0]))
        wet, splashed = self.under(columns, faces.compress(near, axis=0), self.mesh.bottom[near], up, lift)
        fastest = float(np.sqrt((columns[:, THROUGH] ** 2).sum(axis=1).max()))
        speeds = (0.0 if len(wet.normals) else fastest, fastest)  # in the air, any part may hit the water next
        if len(wet.normals):
            volume = wet.volume(up)
            immersion = min(1.0, max(0.0, volume / self.rest_volume))
            torque_force, entering, into = self.surface(wet, splashed, lift)
            speeds = (into, fastest)
        forces = Forces(torque_force, torque_force, volume, immersion, speeds, lift)
        depths = (elsewhere.height - others[:, 2])[: len(self.data.propulsor_points)]
        self._couple(forces, t, controls, wind, (R_wb, position, omega, velocity), elsewhere, depths, entering)
        self._last = state, forces, controls, wind
        return forces

    def _later(self, t: float) -> Forces:
        """The forces at ``t`` s in the state of the last evaluation, if the water is `_timeless`."""
        assert self._last is not None
        state, forces, controls, wind = self._last
        if self.seakeeping is not None:
            R_wb, position, omega, velocity = _body(state, self.vehicle.origin)
            twist = np.concatenate([omega, velocity])
            waves = self.seakeeping.wrench(t, R_wb, position, twist, twist)
            forces = replace(forces, wrench=forces.instant + forces.immersion * waves)
            self._last = state, forces, controls, wind
        return forces

    @property
    def _timeless(self) -> bool:
        """Whether the water's force on a hull that stays where it is changes only with the memory of its waves."""
        return self.water.flat and (self.seakeeping is None or self.water.current is None)

    def _motion(self, t: float, world: Array, others: Array, faces: Any) -> tuple[Motion, Motion, Array, Any]:
        """The water at the nodes ``world`` (n, 3) m of ``faces`` (m, 3 or 6) and at ``others`` (k, 3) m, propulsors
        first, its mean flow (3,) m/s, and which faces may be wet (m,).

        The height field knows which faces are above it. Nodes of these alone are not evaluated: they have its height
        and the mean flow; those of a bottom along which water rises have the formula's. Of the response's points, only
        the flow is needed.
        """
        n, places = len(world), np.concatenate([world, others])
        if self.field is None:
            found = self.water.at(places, t)
            here, elsewhere = (Motion(*(part[rows] for part in found)) for rows in (slice(n), slice(n, None)))
            return here, elsewhere, self._flow(elsewhere), np.ones(len(faces), bool)
        self.field.cover(places, t)
        height = self.field.ceiling(world)
        low = world[:, 2] <= height
        near = np.logical_or.reduce([low.take(nodes) for nodes in faces.T])  # also crests between two corners
        rays = np.zeros(len(places), bool)
        rays[faces.compress(near, axis=0)] = rays[n : n + len(self.data.propulsor_points)] = True
        asked = rays.copy()
        asked[n:] = True
        if self.law.rise is not None:  # water rises along the bottom
            near |= self.mesh.bottom
            asked[faces.compress(near, axis=0)] = True
        index = np.flatnonzero(asked)
        found = self.field.motion(places.take(index, axis=0), t, rays.take(index))
        count = len(index) - len(others)
        elsewhere, index = Motion(*(part[count:] for part in found)), index[:count]
        flow = self._flow(elsewhere)
        motion = Motion(height, np.empty((n, 3)), found.acceleration[:0], np.zeros(n))  # nodes need no acceleration
        motion.velocity[:] = flow
        height[index], motion.velocity[index], motion.fade[index] = (
            part[:count] for part in (found.height, found.velocity, found.fade)
        )
        return motion, elsewhere, flow, near

    def _flow(self, others: Motion) -> Array:
        """Mean velocity (3,) m/s of the water over the wetted surface at rest."""
        velocities = others.velocity[len(self.data.propulsor_points) :]
        return np.asarray(np.ones(len(velocities)) @ velocities / len(velocities))

    def under(self, columns: Array, faces: Any, bottom: Any, up: Array, lift: Lift) -> tuple[Wetted, Wetted]:
        """The wetted part of ``faces`` (m, 3 or 6) of `mesh`, and that on which planing pressure acts: up to where the
        water rises along its ``bottom`` (m,). ``columns`` (n, COLUMNS) of their nodes; their `RISEN` is set here."""
        if not lift.rise:
            wet = wetted(columns, faces)
            return wet, wet
        keel, up_by = self._keel[: len(columns)], columns[:, PLACE] @ up
        deep = columns[:, DEPTH] + up_by - columns[:, 0] * up[0] - keel * up[2]
        lowest = self._lowest[self._lowest < len(columns)]
        rise = lift.risen(deep, columns[:, PLACE], keel, columns[:, THROUGH], lowest)
        columns[:, RISEN], columns[:, BELOW] = columns[:, DEPTH] + rise, deep + rise
        below, sides = faces[bottom], wetted(columns, faces[~bottom])
        return wetted(columns, below) + sides, wetted(columns, below, RISEN) + sides

    @cached_property
    def _lowest(self) -> NDArray[np.int64]:
        """The nodes of `mesh` that are on its bottom, from the stern to the bow."""
        nodes, faces = self.mesh.quadratic
        found = np.unique(faces[self.mesh.bottom])
        return np.asarray(found[np.argsort(nodes[found, 0], kind="stable")])

    @cached_property
    def _keel(self) -> Array:
        """Heights of the keel at the nodes of `mesh`, m."""
        return self.mesh.keel(self.mesh.quadratic[0][:, 0])

    def surface(self, wet: Wetted, splashed: Wetted, lift: Lift) -> tuple[Array, float, float]:
        """Body wrench (6,) of pressure and resistance on the ``wet`` surface, and of planing pressure and the running
        hull's resistance on the ``splashed`` one; volume rate (m^3/s) and speed (m/s) of ``wet`` into the water."""
        hull, rho = self.data, self.water.density
        middles, normals = wet.middles, wet.normals
        area = np.sqrt(np.einsum("ki,ki->k", normals, normals))
        through = middles[:, :, THROUGH]
        pressure = rho * GRAVITY * middles[:, :, HEAD]
        if hull.normal_force:
            pressure = pressure + hull.normal_force / self.reference_area
        into = np.einsum("kqi,ki->kq", through, normals)  # times the area
        fastest = 0.0
        force = -pressure[:, :, None] * normals[:, None]
        if hull.impact or lift.planing or lift.vented:
            over, speed = _entering(wet, lift)
            fastest = float((speed * area[:, None]).sum()) / 3 / self._scales[0]
            load = 0.5 * rho * hull.impact * speed**2
            load -= lift.missing(middles[:, :, 0]) * np.maximum(pressure + load, 0.0)
            force -= load[:, :, None] * over[:, None]
        if np.any(hull.damping) or np.any(hull.quadratic):
            rate = np.asarray(hull.damping, float)
            if np.any(hull.quadratic):
                size = np.sqrt(np.einsum("kqi,kqi->kq", through, through))
                rate = rate + size[:, :, None] * np.asarray(hull.quadratic, float)
            force -= (area / self.reference_area)[:, None, None] * rate * through
        wrench = _total(force, middles)
        if lift.planing or lift.rate:
            middles, through = splashed.middles, splashed.middles[:, :, THROUGH]
        if lift.rate:
            area = np.sqrt(np.einsum("ki,ki->k", splashed.normals, splashed.normals))
            force = -(lift.rate / self.reference_area) * area[:, None, None] * through * [1.0, 0.0, 0.0]
            wrench += _total(force, middles)
        if lift.planing:
            over, speed = _entering(splashed, lift)
            along = np.sqrt(np.einsum("kqi,kqi->kq", through, through))
            load = 0.5 * rho * lift.planing * speed * along * (1 - lift.missing(middles[:, :, 0]))
            if lift.rise:
                load *= lift.peaked(middles[:, :, RISEN], middles[:, :, BELOW])
            wrench -= _total(load[:, :, None] * over[:, None], middles)
        return wrench, float(into.sum() / 3), fastest

    def _couple(
        self,
        forces: Forces,
        t: float,
        controls: Array,
        wind: Array,
        body: tuple[Array, ...],
        water: Motion,
        depths: Array,
        entering: float,
    ) -> None:
        """Added mass in moving water, propulsion and wind: effects on the body as a whole.

        ``water``: at its propulsors, with their ``depths`` m, and at the points of the hull's `response`.
        """
        hull = self.data
        R_wb, position, omega, velocity = body
        n = len(depths)
        flows = water.velocity @ R_wb
        around = flows[n:]
        if np.any(self.added_mass_at_rest):
            through = np.concatenate([omega, velocity]) - self.response.twist(around)
            slow = self.added_mass if self.seakeeping is None else self.seakeeping.slow
            momentum = forces.immersion * slow @ through
            # Kirchhoff's equations in the waterplane, for the motion through the water. Perpendicular to it they would
            # pitch a fast hull out of the water; in reality its stern sheds the flow.
            x, y, turn = momentum[3], momentum[4], omega[2]
            forces.wrench[2:5] += x * through[4] - y * through[3], y * turn, -x * turn
            if self.seakeeping is None or not self.seakeeping.complete:
                # the water's own acceleration, in the axes that turn with the body, carries the hull along
                change = water.acceleration[n:] @ R_wb - cross(omega, around)
                forces.wrench += forces.immersion * self.added_mass @ self.response.twist(change)
            # water set in motion (von Karman); a hull that leaves takes its water along
            if forces.immersion < 1 and entering > 0:
                forces.wrench -= entering / self.rest_volume * self.added_mass @ through
        if self._propulsion is not None:
            depth = depths / hull.propulsor_size + 0.5
            flow = flows[:n].mean(axis=0) if n else np.zeros(3)
            past = np.concatenate([omega, velocity - flow])
            forces.wrench += self._propulsion(controls, past, np.clip(depth, 0, 1))[0]
        if self._windage is not None:
            air = wind @ R_wb
            forces.wrench += self._windage(np.concatenate([omega, velocity - air]))[0]
        forces.instant = forces.wrench
        if self.seakeeping is not None:
            waves = self.seakeeping.wrench(t, R_wb, position, np.concatenate([omega, velocity]), through)
            forces.wrench = forces.instant + forces.immersion * waves

    @cached_property
    def _propulsion(self) -> Any:
        if self.data.propulsion is None:
            return None
        import casadi as ca

        from vehsim.integrators.fast.kernel import Kernel

        sizes = (len(self.vehicle.controls), 6, len(self.data.propulsor_points))
        c, flow, immersion = (ca.SX.sym(name, n) for name, n in zip(("c", "flow", "immersion"), sizes, strict=True))
        law = ca.densify(self.data.propulsion(c, flow, immersion))
        return Kernel(ca.Function("propulsion", [c, flow, immersion], [law]))

    @cached_property
    def _windage(self) -> Any:
        if self.data.windage is None:
            return None
        import casadi as ca

        from vehsim.integrators.fast.kernel import Kernel

        air = ca.SX.sym("air", 6)
        return Kernel(ca.Function("windage", [air], [ca.densify(self.data.windage(air))]))


@dataclass
class Forces:
    """The effect of water and wind at an instant: body ``wrench`` (6,), its part ``instant`` (6,) without the waves of
    `Seakeeping`, displaced ``volume`` m^3, ``immersion`` 0 to 1, and ``speeds`` m/s of the hull's surface: into the
    water, averaged over its area from above, and the greatest through it; ``lift`` is the law of its patches at its
    speed."""

    wrench: Array
    instant: Array
    volume: float
    immersion: float
    speeds: tuple[float, float]
    lift: Lift


def _entering(wet: Wetted, lift: Lift) -> tuple[Array, Array]:
    """Normals (k, 3) of the pressure of water that triangles move into, with their areas as lengths, and the speed
    (k, 3) into it at the middles of their edges, m/s."""
    over = wet.normals * [0.0, 1.0, 1.0] if lift.across else wet.normals
    area = np.sqrt(np.einsum("ki,ki->k", wet.normals, wet.normals))
    speed = np.maximum(np.einsum("kqi,ki->kq", wet.middles[:, :, THROUGH], over), 0.0)
    return over, speed / np.maximum(area, 1e-300)[:, None]


def _total(force: Array, middles: Array) -> Array:
    """Wrench (6,) about the body's origin of forces (k, 3, 3) N over triangles, at the ``middles`` of their edges."""
    force, arms = force.reshape(-1, 3) / 3, middles[:, :, PLACE].reshape(-1, 3)
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = arms.T @ force
    return np.array([yz - zy, zx - xz, xy - yx, *(np.ones(len(force)) @ force)])


def _body(state: State, origin: Array) -> tuple[Array, Array, Array, Array]:
    """Rotation body to world, position of the body frame's origin, angular and linear velocity in body axes."""
    R_wb = matrices(np.asarray(state.orientation, float))
    twist = np.zeros(6) if state.twist is None else np.asarray(state.twist, float)
    omega = twist[:3]
    return R_wb, np.asarray(state.position, float) + R_wb @ origin, omega, twist[3:] + cross(omega, origin)
