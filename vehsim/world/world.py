"""The world: terrain, wind, obstacles and water, with answers to vehicles' queries by MuJoCo and exact geometry.

A `World` owns no motion. Heights and meshes are in `terrain`, obstacles in `obstacles`; clearances, the distance field
and routes through free space in `distance`.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.errors import InputError
from vehsim.runtime.progress import Progress
from vehsim.world.distance.field import DistanceField, box_of, distance_field, exact_along
from vehsim.world.obstacles.articulated import carriers_of, swung
from vehsim.world.obstacles.obstacles import Moving, Obstacle, check_obstacles
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.water.water import Water

if TYPE_CHECKING:
    from vehsim.integrators.environment import Environment
    from vehsim.world.contact.contact import Contact
    from vehsim.world.distance.clearance import ObstacleScene
    from vehsim.world.distance.scene import Scene
    from vehsim.world.distance.surface_scene import SurfaceScene
    from vehsim.world.ground.walls import Walls
    from vehsim.world.wind import Gusts

Array = NDArray[np.float64]

MAX_WIND = 150.0
"""Largest plausible wind, m/s."""
STANDING = 0.1
"""Without a terrain, an obstacle stands on level ground if its bottom is this near to z = 0, m."""


class World:
    """The surroundings of the vehicles: ``terrain`` (`Terrain` or None, empty space), ``wind`` (3,) m/s, world axes,
    and ``obstacles``, made by the functions of `vehsim.world.obstacles`.

    ``terrain`` is a `Terrain`, the name of a shipped one ("canyon", "flat", "hills") or a path; ``water`` a
    `Water`, the level of calm water in m, or None; ``gusts`` make the wind change with time; ``contact``: how hulls
    touch obstacles, ground and each other; None: they pass through. Raises ``InputError``.
    """

    def __init__(
        self,
        terrain: Terrain | str | Path | None = None,
        wind: ArrayLike = (0.0, 0.0, 0.0),
        obstacles: Sequence[Obstacle | Moving] = (),
        water: Water | float | None = None,
        gusts: Gusts | None = None,
        contact: Contact | None = None,
    ) -> None:
        self.obstacles = check_obstacles(obstacles)
        self.terrain = terrain if isinstance(terrain, Terrain) or terrain is None else Terrain.load(terrain)
        self.wind = _wind(wind)
        self.water, self.gusts, self.contact = _water(water), gusts, contact
        self._fields: dict[Any, DistanceField] = {}
        self._grids: dict[Any, Any] = {}
        """The terrain's distances on the grids used last, shared with the same world with other obstacles."""
        self._scenes: dict[Any, Scene | SurfaceScene] = {}
        self._obstacle_scenes: dict[Any, ObstacleScene] = {}
        self._walls: dict[Any, Any] = {}

    def __repr__(self) -> str:
        name = None if self.terrain is None else self.terrain.name
        about = f", {len(self.obstacles)} obstacles" if self.obstacles else ""
        return f"World(terrain={name!r}, wind={tuple(self.wind.tolist())}{about})"

    @cached_property
    def content_hash(self) -> str:
        """A hash of the world's content."""
        ground = "" if self.terrain is None else self.terrain.content_hash
        content = (ground, self.wind.tolist(), *(obstacle.content_hash for obstacle in self.obstacles))
        content += () if self.water is None else (self.water.content_hash,)
        content += () if self.gusts is None else (repr(self.gusts),)
        return hashlib.sha256(repr(content).encode()).hexdigest()

    @property
    def looks(self) -> list[tuple[str, Any]]:
        """The finish and the colour of each standing obstacle; they are no part of `content_hash`."""
        return [(one.finish, one.colour) for one in self.obstacles if isinstance(one, Obstacle)]

    def with_obstacles(self, obstacles: Sequence[Obstacle | Moving]) -> World:
        """This world with more obstacles in it."""
        return self.with_only((*self.obstacles, *obstacles)) if obstacles else self

    def with_only(self, obstacles: Sequence[Obstacle | Moving]) -> World:
        """This world with other obstacles in place of its own."""
        other = copy.copy(self)
        other.__dict__.pop("content_hash", None)
        other.obstacles = check_obstacles(obstacles)
        other._fields, other._obstacle_scenes = {}, {}  # what is known of the terrain stays
        return other

    def on_level(self, places: ArrayLike, around: ArrayLike = ()) -> World:
        """This world with the ground of a vehicle that stands at ``places`` (n, 3) m; see `vehsim.world.ground.levels`.
        Itself if there is only one level of ground, or one was chosen."""
        from vehsim.world.ground.levels import on_level

        terrain = self.terrain if self.terrain is None else on_level(self.terrain, places, around)
        if terrain is self.terrain:
            return self
        other = self.with_only(self.obstacles)
        other.terrain = terrain
        other._scenes, other._walls = {}, {}
        return other

    def walls(self, height: float) -> Walls | None:
        """What a vehicle ``height`` m high must not touch on its level of ground; None without a level."""
        from vehsim.world.ground.walls import Walls

        if self.terrain is None or self.terrain.level is None:
            return None
        if height not in self._walls:
            self._walls[height] = Walls(self.terrain, height)
        return self._walls[height]

    @property
    def standing(self) -> tuple[Obstacle, ...]:
        """The obstacles that never move."""
        return tuple(obstacle for obstacle in self.obstacles if isinstance(obstacle, Obstacle))

    @property
    def moving(self) -> tuple[Moving, ...]:
        """The obstacles that move."""
        return tuple(obstacle for obstacle in self.obstacles if isinstance(obstacle, Moving))

    @property
    def seems_level(self) -> bool:
        """Whether, without terrain and water, an obstacle that never moves stands at z = 0, as if on level ground."""
        dry = self.terrain is None and self.water is None
        return dry and any(abs(obstacle.bottom) <= STANDING for obstacle in self.standing)

    @property
    def bounds(self) -> Array | None:
        """(2, 3) m: the box of the whole distance field; None without terrain and standing obstacles."""
        if self.terrain is None and not self.standing:
            return None
        return np.array(box_of(self.terrain, obstacles=self.standing))

    @property
    def waves(self) -> bool:
        """Whether its water has waves."""
        return self.water is not None and not self.water.flat

    def height(self, xy: ArrayLike) -> Array:
        """Height (n,) m of the ground at ``xy`` (n, 2) m; -inf without terrain."""
        points = np.atleast_2d(np.asarray(xy, dtype=float))
        if points.ndim != 2 or points.shape[1] != 2:
            raise InputError(
                f"shape {np.shape(xy)}", "give (n, 2) m: positions[:, :2] of points with a height", key="xy"
            )
        return np.full(len(points), -np.inf) if self.terrain is None else self.terrain.height(points)

    def wind_at(self, t: float) -> Array:
        """The wind (3,) m/s at ``t`` s, including gusts."""
        return self.wind if self.gusts is None else self.gusts.at(self.wind, t)

    def environment(self, vehicle: Any, alone: bool = True, start_time: float = 0.0) -> Environment | None:
        """Everything in this world that pushes ``vehicle`` from outside; None without any such force.

        Contact is included only if the vehicle is ``alone``: vehicles that touch each other share one
        `vehsim.world.contact.ContactScene`. ``start_time``: the time at which ``t`` is 0, s since frame 0.
        """
        from vehsim.integrators.environment import Combined, Spaced

        parts: list[Environment] = []
        if self.water is not None and vehicle.hull is not None:
            from vehsim.world.water.buoyancy import Afloat

            afloat = Afloat(vehicle, self)
            parts.append(afloat if alone and self.contact is None else Spaced(afloat))
        elif self.gusts is not None and getattr(vehicle, "drag", None) is not None:
            from vehsim.world.wind import Gusty

            parts.append(Gusty(vehicle, self.wind, self.gusts))
        if alone and self.contact is not None and vehicle.group.dim == 6 and vehicle.rig is not None:
            from vehsim.world.contact.contact import Touching

            parts.append(Touching(vehicle, self, self.contact, start_time))
        return Combined(parts) if parts else None

    def distance_field(
        self,
        progress: Progress | None = None,
        *,
        spacing: float | None = None,
        box: ArrayLike | None = None,
        quick: bool = False,
    ) -> DistanceField | None:
        """The smooth field of signed distances to the terrain and to standing obstacles, None if there is neither.

        See `distance_field`; without terrain it is open, and by default extends a little beyond the obstacles; ``box``
        (2, 3) m changes this. ``quick``: found in a third of the time where there is only a height field; 0.2 m too
        large on average, and up to 3 m far from steep rock.
        """
        if self.terrain is None and not self.standing:
            return None
        quick = quick and self._by_height
        key = (spacing, None if box is None else tuple(np.ravel(np.asarray(box, dtype=float)).tolist()), quick)
        if key not in self._fields:
            self._fields[key] = distance_field(self.terrain, spacing, box, progress, self.standing, self._grids, quick)
        return self._fields[key]

    def distance_field_along(
        self, path: ArrayLike, reach: float, progress: Progress | None = None, *, box: ArrayLike | None = None
    ) -> DistanceField | None:
        """The part of the distance field around a ``path`` (k, 3) m, with at least ``reach`` m beside it; near the
        ground it is as accurate as the whole field."""
        field, points = self.distance_field(progress, box=box, quick=True), np.asarray(path, dtype=float)
        if field is None:
            return None
        part = field.crop(points.min(axis=0) - reach, points.max(axis=0) + reach)
        if not self._by_height:
            return part
        assert self.terrain is not None
        return exact_along(part, self.terrain, points, reach)

    @property
    def _by_height(self) -> bool:
        """Whether distances are those to a height field alone."""
        return self.terrain is not None and self.terrain.surface is None and not self.standing

    def clearance(
        self,
        vehicle: Any,
        positions: ArrayLike,
        orientations: ArrayLike,
        seconds: ArrayLike | None = None,
        channels: Mapping[str, Array] = MappingProxyType({}),
    ) -> Array:
        """Signed distance (n,) m from the vehicle's hulls to terrain and obstacles at rig-root poses; +inf without any.

        ``positions`` (n, 3) m, ``orientations`` (n, 4) w, x, y, z (T_wr). It is exact in the air; a pose that touches
        rock gives minus its vertical depth. Moving obstacles are placed at ``seconds`` (n,) since frame 0, and ignored
        without them. ``channels`` (n,) of the rig: with them, a rotor's disc tilts and trailers turn; otherwise they
        are as at rest.
        """
        least = self._from_obstacles(vehicle, positions, orientations, seconds, channels=channels).min(axis=1)
        return np.minimum(least, self.clearance_from_terrain(vehicle, positions, orientations, channels))

    def clearance_from_terrain(
        self,
        vehicle: Any,
        positions: ArrayLike,
        orientations: ArrayLike,
        channels: Mapping[str, Array] = MappingProxyType({}),
    ) -> Array:
        """`clearance` from the terrain only, (n,) m."""
        if self.terrain is None or vehicle.rig is None:
            return np.full(len(np.asarray(positions, dtype=float).reshape(-1, 3)), np.inf)
        key = str(vehicle.rig.asset), carriers_of(vehicle)
        if key not in self._scenes:
            from vehsim.world.distance.scene import Scene
            from vehsim.world.distance.surface_scene import SurfaceScene

            kind = Scene if self.terrain.surface is None else SurfaceScene
            self._scenes[key] = kind(self.terrain, vehicle.rig, carriers=key[1])
        return np.asarray(self._scenes[key].clearance(positions, orientations, swung(vehicle, channels)))

    def clearance_from_walls(
        self,
        vehicle: Any,
        positions: ArrayLike,
        orientations: ArrayLike,
        channels: Mapping[str, Array] = MappingProxyType({}),
    ) -> Array:
        """`clearance` (n,) m of a vehicle on the ground from the walls and roofs of a terrain with overhangs, its
        trailers turned by ``channels`` (n,); +inf without any."""
        points = np.asarray(positions, dtype=float).reshape(-1, 3)
        if self.terrain is None or self.terrain.surface is None or vehicle.rig is None or not len(points):
            return np.full(len(points), np.inf)
        if self.terrain.level is None:
            return self.on_level(points).clearance_from_walls(vehicle, points, orientations, channels)
        carriers = carriers_of(vehicle)
        key = str(vehicle.rig.asset), carriers
        if key not in self._walls:
            from vehsim.world.distance.surface_scene import SurfaceScene

            walls = self.walls(np.inf)
            assert walls is not None
            self._walls[key] = SurfaceScene(self.terrain, vehicle.rig, walls.mesh, carriers)
        return np.asarray(self._walls[key].clearance(points, orientations, swung(vehicle, channels)))

    def clearance_by_obstacle(
        self,
        vehicle: Any,
        positions: ArrayLike,
        orientations: ArrayLike,
        seconds: ArrayLike | None = None,
        channels: Mapping[str, Array] = MappingProxyType({}),
    ) -> Array:
        """`clearance` from each of the ``obstacles``, (n, obstacles) m. ``channels`` (n,): with them, trailers turn
        and tilt; otherwise they are as at rest."""
        return self._from_obstacles(vehicle, positions, orientations, seconds, each=True, channels=channels)

    def _from_obstacles(
        self,
        vehicle: Any,
        positions: ArrayLike,
        orientations: ArrayLike,
        seconds: ArrayLike | None,
        each: bool = False,
        channels: Mapping[str, Array] = MappingProxyType({}),
    ) -> Array:
        """Distances (n, obstacles) m from each, or (n, 1) from the nearest."""
        points = np.asarray(positions, dtype=float).reshape(-1, 3)
        if not self.obstacles:
            return np.full((len(points), 0 if each else 1), np.inf)
        carriers = carriers_of(vehicle)
        key = vehicle.rig and (str(vehicle.rig.asset), carriers)
        if key not in self._obstacle_scenes:
            from vehsim.world.distance.clearance import ObstacleScene

            self._obstacle_scenes[key] = ObstacleScene(vehicle.rig, self.obstacles, carriers)
        turned = np.asarray(orientations, dtype=float).reshape(-1, 4)
        when = None if seconds is None else np.atleast_1d(np.asarray(seconds, float))
        return self._obstacle_scenes[key].clearance(points, turned, when, each, swung(vehicle, channels))

    def route(
        self,
        start: ArrayLike,
        goal: ArrayLike,
        clearance: float,
        ceiling: float | None = None,
        box: ArrayLike | None = None,
        best: bool = False,
        shy: float | None = None,
    ) -> Array:
        """A path (k, 3) m from ``start`` to ``goal`` (3,) m through free space, ``clearance`` m from terrain and
        obstacles.

        ``box`` (2, 3) m: the region to search; ``best``: whether a path counts only if none outside can be better.
        ``ceiling`` m bounds its height; by default it may be a little higher than start and goal, so that it follows
        the valleys. ``shy``: how much it avoids them, see `find_route`. Raises ``InputError`` (an end in the rock) and
        ``SolveError`` (no path).
        """
        from vehsim.world.distance.route import find_route

        field, bounds = self.distance_field(box=box, quick=True), self.bounds if best else None
        return find_route(field, start, goal, clearance, ceiling, self.height, bounds, shy)


def _water(water: Water | float | None) -> Water | None:
    if water is None or isinstance(water, Water):
        return water
    if isinstance(water, bool) or not isinstance(water, int | float):
        raise InputError("not water", "give a Water, or calm water's level in m", key="world.water", value=water)
    return Water(level=float(water))


def _wind(wind: ArrayLike) -> Array:
    try:
        values = np.array(wind, dtype=float)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (3,) or not np.isfinite(values).all() or np.linalg.norm(values) > MAX_WIND:
        remedy = f"give x, y, z in m/s, at most {MAX_WIND:g} in all"
        raise InputError("not a wind", remedy, key="world.wind", value=wind)
    values.flags.writeable = False
    return values
