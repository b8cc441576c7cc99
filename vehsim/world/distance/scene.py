"""The MuJoCo model of a terrain and a vehicle's hulls, and the exact distance between them.

This module knows MuJoCo's models, poses and geometric queries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from threading import Lock
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.errors import InputError, SolveError
from vehsim.lie.quaternions import matrices
from vehsim.rig.linkage import part_poses
from vehsim.rig.parts import add_to_spec, solids
from vehsim.rig.rig import Rig
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]

BASE = 50.0
"""Thickness of the rock below the lowest height in MuJoCo's model, m."""
SLACK = 1e-9
"""Results within this distance of the cap confirm it, m."""
CAP_SLACK = 1e-3
"""Added to an expected distance to make a cap, m, so that a result below it is certain."""
TOUCHING = 1e-9
"""Reported depth of a pose that only touches the rock, m."""


def add_terrain(spec: Any, terrain: Terrain, name: str = "terrain") -> Any:
    """Add ``terrain`` to a ``mujoco.MjSpec`` as a height field; returns its geom.

    The compiler rescales elevations and loses their unit: call `write_heights` on the compiled model.
    """
    import mujoco

    rows, cols = terrain.heights.shape
    lower, upper = terrain.lower, terrain.upper
    half = 0.5 * (upper - lower)[:2]
    relief = max(upper[2] - lower[2], 1e-3)
    spec.add_hfield(name=name, size=[*half, relief, BASE], nrow=rows, ncol=cols, userdata=np.zeros(rows * cols))
    centre = [*(lower[:2] + half), lower[2]]
    return spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=name, pos=centre)


def write_heights(model: Any, terrain: Terrain, name: str = "terrain") -> None:
    """Write the heights of ``terrain`` into the compiled ``model``."""
    field = model.hfield(name)
    start, size = int(model.hfield_adr[field.id]), terrain.heights.size
    relief = float(model.hfield_size[field.id, 2])
    model.hfield_data[start : start + size] = ((terrain.heights - terrain.heights.min()) / relief).ravel()


def owners_of(rig: Rig, carriers: Sequence[str]) -> dict[str, str]:
    """The innermost of the ``carriers`` of each part with hulls, by path; "" carries the whole vehicle."""
    paths = [solid.path for solid in solids(rig.asset, rig.root or None)]
    return {path: max((c for c in carriers if not c or f"{path}/".startswith(f"{c}/")), key=len) for path in paths}


def add_carriers(spec: Any, rig: Rig, name: str, carriers: Sequence[str]) -> list[Any]:
    """Add a vehicle's hulls to a ``mujoco.MjSpec``, one free body for each of its ``carriers``, of which "" is the
    vehicle itself."""
    owners = owners_of(rig, carriers)
    return [
        add_to_spec(
            spec, rig, f"{name}.{k}" if k else name, only=[path for path, owner in owners.items() if owner == carrier]
        )
        for k, carrier in enumerate(carriers)
    ]


class Scene:
    """A terrain and one vehicle's hulls in a MuJoCo model, for distance queries.

    ``carriers``: paths of the parts that swing out of the vehicle, such as a rotor's disc, parents before children.
    """

    def __init__(self, terrain: Terrain, rig: Rig, carriers: Sequence[str] = ()) -> None:
        import mujoco

        spec = mujoco.MjSpec()
        add_terrain(spec, terrain)
        self.terrain, self.rig, self.carriers = terrain, rig, ("", *carriers)
        bodies = add_carriers(spec, rig, "vehicle", self.carriers)
        geoms, names = [[geom.name for geom in body.geoms] for body in bodies], [body.name for body in bodies]
        self.model = spec.compile()
        write_heights(self.model, terrain)
        self.data, self._lock = mujoco.MjData(self.model), Lock()
        self._ground, self._bodies = self.model.geom("terrain").id, [self.model.body(name).id for name in names]
        self._joints = self.model.jnt_qposadr[self.model.body_jntadr[self._bodies]]
        self._hulls = [self.model.geom(name).id for group in geoms for name in group]
        self._owners = np.repeat(np.arange(len(geoms)), [len(group) for group in geoms])
        # With its body at the origin, a geom's pose is its pose in the rig root's frame.
        self._place(np.zeros((len(bodies), 3)), np.tile([1.0, 0, 0, 0], (len(bodies), 1)))
        self._corners = [self._vertices(hull) for hull in self._hulls]
        self._centres = np.array([0.5 * (c.min(axis=0) + c.max(axis=0)) for c in self._corners])
        self._radii = np.array(
            [np.linalg.norm(c - m, axis=1).max() for c, m in zip(self._corners, self._centres, strict=True)]
        )
        self._reach = max(float(np.linalg.norm(c, axis=1).max()) for c in self._corners)

    def clearance(
        self,
        positions: ArrayLike,
        orientations: ArrayLike,
        channels: Mapping[str, Array] = MappingProxyType({}),
    ) -> Array:
        """Signed distance (n,) m from the hulls to the terrain at rig-root poses (n, 3) m, (n, 4) w, x, y, z;
        ``channels`` (n,): those that move the ``carriers``.

        Exact in the air. A pose that touches the rock gives minus its depth, measured vertically at the hulls' corners.
        Beyond the borders the ground continues level, and the result is at most the height above it.
        """
        positions, orientations = checked_poses(positions, orientations)
        own = [part_poses(self.rig, path, channels, positions, orientations) for path in self.carriers]
        places, turned = (np.stack(pose, axis=1) for pose in zip(*own, strict=True))
        bounds, beyond = self._centre_distances(places, turned), self._beyond(positions)
        result, moved = np.empty(len(positions)), self._motion(places, turned)
        with self._lock:  # MuJoCo releases Python's
            for k in range(len(positions)):
                # at most the distance of the previous pose, plus the greatest displacement since
                expected = max(result[k - 1], 0.0) + moved[k - 1] if k else np.inf
                self._place(places[k], turned[k])
                result[k] = self._nearest(bounds[k], expected)
                if result[k] > 0 and beyond[k]:
                    result[k] = min(result[k], self._gap())
        return result

    def _nearest(self, centre_distances: Array, expected: float) -> float:
        """Signed distance of the placed hulls, m, given the distances of their centres and the ``expected`` distance,
        m."""
        if centre_distances.min() <= 0:
            return min(-TOUCHING, self._gap())
        sure = float(centre_distances.min()) + CAP_SLACK  # a hull is at most as far away as its centre
        for cap in (min(expected + CAP_SLACK, sure), sure):
            best = cap
            # A hull is at least as far away as its centre minus its radius: check near hulls first, far ones never.
            lower = centre_distances - self._radii
            for k in np.argsort(lower):
                if lower[k] >= best:
                    break
                best = self._shrink(self._hulls[k], best)
                if best <= 0:
                    return min(-TOUCHING, self._gap())
            if best < cap:
                return best
        raise SolveError("MuJoCo and the terrain's triangles disagree", "please report this terrain", key="clearance")

    def _shrink(self, hull: int, cap: float) -> float:
        """The distance of ``hull`` if it is below ``cap``, else ``cap``, m.

        `mj_geomDistance` checks at most 50 cells of a height field, in scan order: a large cap hides the nearest ones.
        A result below the cap is a true distance to some cell, so it is the cap of the next query; a result equal to
        the cap proves that no cell is nearer, and is exact.
        """
        import mujoco

        while True:
            answer = mujoco.mj_geomDistance(self.model, self.data, hull, self._ground, cap, None)
            if answer <= 0 or answer >= cap - SLACK:
                return float(min(answer, cap))
            cap = answer

    def _gap(self) -> float:
        """The smallest height of the placed hulls' corners above the surface, m; negative if one lies below it."""
        corners = []
        for own, owner in zip(self._corners, self._owners, strict=True):
            body = self._bodies[owner]
            corners.append(own @ self.data.xmat[body].reshape(3, 3).T + self.data.xpos[body])
        placed = np.concatenate(corners)
        return float((placed[:, 2] - self.terrain.height(placed[:, :2])).min())

    def _centre_distances(self, positions: Array, orientations: Array) -> Array:
        """Signed distance (n, hulls) m of every hull's centre from the surface, at poses (n, carriers, ...)."""
        rotation = matrices(orientations.reshape(-1, 4)).reshape(*orientations.shape[:2], 3, 3)[:, self._owners]
        centres = positions[:, self._owners] + np.einsum("nhij,hj->nhi", rotation, self._centres)
        points = centres.reshape(-1, 3)
        away = np.linalg.norm(self.terrain.nearest(points) - points, axis=1)
        above = points[:, 2] > self.terrain.height(points[:, :2])
        return np.asarray((np.where(above, 1, -1) * away).reshape(centres.shape[:2]))

    def _beyond(self, positions: Array) -> NDArray[np.bool_]:
        """At which ``positions`` (n, 3) m hulls may reach beyond the terrain's borders, (n,)."""
        low, high = self.terrain.lower[:2] + self._reach, self.terrain.upper[:2] - self._reach
        return np.asarray(((positions[:, :2] < low) | (positions[:, :2] > high)).any(axis=1))

    def _motion(self, positions: Array, orientations: Array) -> Array:
        """An upper bound (n - 1,) m of the displacement of any point of the hulls from each of the poses
        (n, carriers, ...) to the next."""
        turn = 2 * np.arccos(np.minimum(1.0, np.abs(np.einsum("nci,nci->nc", orientations[:-1], orientations[1:]))))
        return np.asarray((np.linalg.norm(np.diff(positions, axis=0), axis=2) + turn * self._reach).max(axis=1))

    def _place(self, positions: Array, orientations: Array) -> None:
        """Place the carriers at poses (carriers, 3) m and (carriers, 4)."""
        import mujoco

        for at, position, orientation in zip(self._joints, positions, orientations, strict=True):
            self.data.qpos[at : at + 3], self.data.qpos[at + 3 : at + 7] = position, orientation
        mujoco.mj_kinematics(self.model, self.data)

    def _vertices(self, geom: int) -> Array:
        """The vertices (n, 3) m of a mesh geom in its current pose."""
        mesh = self.model.geom_dataid[geom]
        start, count = self.model.mesh_vertadr[mesh], self.model.mesh_vertnum[mesh]
        points = self.model.mesh_vert[start : start + count].astype(float)
        return np.asarray(points @ self.data.geom_xmat[geom].reshape(3, 3).T + self.data.geom_xpos[geom])


def checked_poses(positions: ArrayLike, orientations: ArrayLike) -> tuple[Array, Array]:
    """Positions (n, 3) and unit quaternions (n, 4). Raises ``InputError``."""
    points, quaternions = np.atleast_2d(np.asarray(positions, float)), np.atleast_2d(np.asarray(orientations, float))
    wanted = {"positions": (points, 3, "x, y, z in metres"), "orientations": (quaternions, 4, "w, x, y, z")}
    for key, (array, width, remedy) in wanted.items():
        if array.ndim != 2 or array.shape != (len(points), width):
            raise InputError("has the wrong shape", f"give one row of {remedy} per pose", key=key, value=array.shape)
        if not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise InputError("not finite", f"give {remedy}", key=f"{key}[{row}]", value=array[row].tolist())
    norm = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if (norm < 1e-9).any():
        row = int(np.argmin(norm))
        raise InputError("no rotation", "give a unit quaternion w, x, y, z", key=f"orientations[{row}]")
    return points, quaternions / norm
