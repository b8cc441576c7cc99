"""Does any path exist? An independent answer by a sampling planner: OMPL's RRT-Connect, with its own tests of contact.

`find_path` knows nothing of vehsim's planner: vehicles in the plane are outlines that shapely keeps out of outlines,
those that cannot turn on the spot move along Reeds and Shepp's curves; what flies is a ball in its middle. Speeds,
forces and trailers are ignored, so a path does not prove that a motion exists, but where there is no path, there is no
motion. Needs ``pip install ompl``; without it, nothing is said.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from benchmarks.unseen import Problem

SECONDS = 60.0
"""CPU time after which no path is found."""
INNER = 1.0
"""Radius, m, of a ball inside every helicopter's fuselage."""
AROUND = 40.0
"""Width of the space around marks and obstacles in which paths are looked for, m, at most."""
STEP = 1e-3
"""Largest distance between tested places on a path, as a share of the space."""


def find_path(problem: Problem, seconds: float = SECONDS) -> bool | None:
    """Whether a path from the first to the last mark is found in ``seconds`` of CPU time; None without OMPL."""
    import vehsim

    if find_spec("ompl") is None:
        return None
    vehicle = vehsim.load_vehicle(problem.vehicle)
    space, valid, ends = (_in_plane if vehicle.group.planar else _in_air)(problem, vehicle)
    from ompl import geometric, util

    util.noOutputHandler()
    util.RNG.setSeed(1)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(valid)
    setup.getSpaceInformation().setStateValidityCheckingResolution(STEP)
    setup.setStartAndGoalStates(*ends, 1e-3)
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    if not all(map(valid, ends)):
        return False
    begun = time.process_time()
    while time.process_time() - begun < seconds:
        setup.solve(1.0)
        if setup.haveExactSolutionPath():
            return True
    return False


def _in_plane(problem: Problem, vehicle: Any) -> tuple[Any, Callable[[Any], bool], list[Any]]:
    """The space of poses in the plane, whether one keeps the clearance, and the poses of the marks."""
    import shapely
    from ompl import base
    from shapely import affinity

    from vehsim.planning.guesses.astar import turning_radius
    from vehsim.planning.request.marks import heading_of
    from vehsim.rig.parts import read_parts

    parts = read_parts(vehicle.rig.asset, vehicle.rig.root or None)
    towing = [part for part in parts if not part.path.startswith("trailer") and len(part.points)]
    points = np.concatenate([part.points @ part.T_rp[:3, :3].T + part.T_rp[:3, 3] for part in towing])
    outline = shapely.MultiPoint(points[:, :2]).convex_hull
    walls = [shapely.MultiPoint(hull[:, :2]).convex_hull for one in _obstacles(problem) for hull in one.hulls]
    blocked, near = shapely.STRtree(walls), problem.asked.get("clearance", 0.0)

    radius = turning_radius(vehicle)
    narrow = 0 < radius < math.inf
    space = base.ReedsSheppStateSpace(radius) if narrow else base.SE2StateSpace()
    places = np.array([mark.position[:2] for mark in problem.marks])
    corners = np.concatenate([places, *(np.reshape(wall.bounds, (2, 2)) for wall in walls)])
    margin = min(AROUND, float(np.ptp(corners, axis=0).max()))
    space.setBounds(_bounds(corners.min(0) - margin, corners.max(0) + margin))

    def valid(state: Any) -> bool:
        turned = affinity.rotate(outline, state.getYaw(), origin=(0, 0), use_radians=True)
        here = affinity.translate(turned, state.getX(), state.getY())
        return (
            not len(blocked.query(here, predicate="dwithin", distance=near))
            if near
            else not len(blocked.query(here, predicate="intersects"))
        )

    ends = []
    for mark in (problem.marks[0], problem.marks[-1]):
        ends.append(space.allocState())
        ends[-1].setX(float(mark.position[0]))
        ends[-1].setY(float(mark.position[1]))
        ends[-1].setYaw(float(heading_of(mark) or 0.0))
        space.enforceBounds(ends[-1])  # -pi is inside, pi is not
    return space, valid, ends


def _in_air(problem: Problem, vehicle: Any) -> tuple[Any, Callable[[Any], bool], list[Any]]:
    """The space of places, whether a ball there keeps the clearance, and the places of the marks.

    The ball's distance to the terrain is at most its height above it, and to an upright obstacle between bottom and top
    its distance in the plane: balls that are too near by these are too near.
    """
    import shapely
    from ompl import base

    near, terrain = INNER + problem.asked.get("clearance", 0.0), problem.world.terrain
    walls = [(one, shapely.MultiPoint(hull[:, :2]).convex_hull) for one in _obstacles(problem) for hull in one.hulls]
    places = np.array([mark.position for mark in problem.marks], float)
    low, high = places.min(0) - AROUND, places.max(0) + AROUND
    if terrain is not None:
        low, high = np.minimum(low, terrain.lower), np.maximum(high, terrain.upper + AROUND)
    ceiling = problem.asked.get("limits", {}).get("ceiling")
    high[2] = high[2] if ceiling is None else ceiling
    space = base.RealVectorStateSpace(3)
    space.setBounds(_bounds(low, high))

    def valid(state: Any) -> bool:
        x, y, z = state[0], state[1], state[2]
        if terrain is not None and z - near < terrain.height([[x, y]])[0]:
            return False
        place = shapely.Point(x, y)
        return not any(one.bottom < z < one.top and wall.distance(place) < near for one, wall in walls)

    ends = []
    for place in (places[0], places[-1]):
        ends.append(space.allocState())
        for axis in range(3):
            ends[-1][axis] = float(place[axis])
    return space, valid, ends


def _obstacles(problem: Problem) -> Any:
    return [] if problem.world is None else problem.world.obstacles


def _bounds(low: Any, high: Any) -> Any:
    from ompl import base

    bounds = base.RealVectorBounds(len(low))
    for axis in range(len(low)):
        bounds.setLow(axis, float(low[axis]))
        bounds.setHigh(axis, float(high[axis]))
    return bounds
