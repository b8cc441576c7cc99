"""The MuJoCo model of a terrain and a vehicle's hulls, and the exact distance between them.

What belongs here is MuJoCo: models, poses, geometric queries. Contact, water and the ground under wheels will ask here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim._quaternions import matrices
from vehsim.errors import InputError, Problem, SolveError
from vehsim.parts import add_to_spec
from vehsim.vehicles._base import Rig
from vehsim.world.terrain import Terrain

Array = NDArray[np.float64]

BASE = 50.0
"""Thickness of the rock below the lowest height in MuJoCo's model, m."""
SLACK = 1e-9
"""Answers this near to the cap certify it, m."""
MARGIN = 1e-3
"""Added to a cap that should hold, m, so that an answer below it proves that it did."""
TOUCHING = 1e-9
"""What a pose that only touches the rock is inside it, m."""


def add_terrain(spec: Any, terrain: Terrain, name: str = "terrain") -> Any:
    """Add ``terrain`` to a ``mujoco.MjSpec`` as a height field; returns its geom.

    The compiler rescales elevations and would lose their metres: call `write_heights` on the compiled model.
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


class Scene:
    """A terrain and one vehicle's hulls in a MuJoCo model, ready to be asked for their distance."""

    def __init__(self, terrain: Terrain, rig: Rig) -> None:
        import igl
        import mujoco

        spec = mujoco.MjSpec()
        add_terrain(spec, terrain)
        body = add_to_spec(spec, rig, "vehicle")
        geoms, name = [geom.name for geom in body.geoms], body.name
        self.terrain = terrain
        self.model = spec.compile()
        write_heights(self.model, terrain)
        self.data = mujoco.MjData(self.model)
        self._ground, self._body = self.model.geom("terrain").id, self.model.body(name).id
        self._hulls = [self.model.geom(name).id for name in geoms]
        # With the body at the origin a geom's pose is its pose in the rig root's frame.
        self._place(np.zeros(3), np.array([1.0, 0, 0, 0]))
        self._corners = [self._vertices(hull) for hull in self._hulls]
        self._centres = np.array([0.5 * (c.min(axis=0) + c.max(axis=0)) for c in self._corners])
        self._radii = np.array(
            [np.linalg.norm(c - m, axis=1).max() for c, m in zip(self._corners, self._centres, strict=True)]
        )
        self._reach = max(float(np.linalg.norm(c, axis=1).max()) for c in self._corners)
        self._mesh = (np.ascontiguousarray(terrain.vertices), np.ascontiguousarray(terrain.faces))
        self._tree = igl.AABB()
        self._tree.init(*self._mesh)

    def clearance(self, positions: ArrayLike, orientations: ArrayLike) -> Array:
        """Signed distance (n,) m from the hulls to the terrain at rig-root poses (n, 3) m, (n, 4) w, x, y, z.

        Exact in the air. A pose that touches the rock gives minus its depth, measured vertically at the hulls' corners.
        Beyond the borders the ground goes on level, and no more is claimed than the height above it.
        """
        positions, orientations = _poses(positions, orientations)
        bounds = self._centre_distances(positions, orientations)
        result = np.empty(len(positions))
        for k, (position, orientation) in enumerate(zip(positions, orientations, strict=True)):
            expected = np.inf  # no farther than the pose before, plus what any point has moved since
            if k:
                moved = self._motion(positions[k - 1 : k + 1], orientations[k - 1 : k + 1])
                expected = max(result[k - 1], 0.0) + moved
            self._place(position, orientation)
            result[k] = self._nearest(bounds[k], expected)
            if result[k] > 0 and self._beyond(position):
                result[k] = min(result[k], self._gap())
        return result

    def _nearest(self, centre_distances: Array, expected: float) -> float:
        """Signed distance of the placed hulls, m; their centres are so far away, and about ``expected`` m is likely."""
        if centre_distances.min() <= 0:
            return min(-TOUCHING, self._gap())
        sure = float(centre_distances.min()) + MARGIN  # a hull is no farther away than its centre
        for cap in (min(expected + MARGIN, sure), sure):
            best = cap
            # A hull is at least as far away as its centre less its radius: near hulls first, far ones never.
            lower = centre_distances - self._radii
            for k in np.argsort(lower):
                if lower[k] >= best:
                    break
                best = self._shrink(self._hulls[k], best)
                if best <= 0:
                    return min(-TOUCHING, self._gap())
            if best < cap:
                return best
        raise SolveError("clearance: MuJoCo and the terrain's triangles disagree; please report this terrain")

    def _shrink(self, hull: int, cap: float) -> float:
        """The distance of ``hull`` if it is below ``cap``, else ``cap``, m.

        `mj_geomDistance` looks at no more than 50 cells of a height field, whichever come first: a large cap hides the
        nearest ones. An answer below the cap is a true distance to some cell, so it caps the next question; an answer
        equal to the cap says that no cell is nearer, and that is exact.
        """
        import mujoco

        while True:
            answer = mujoco.mj_geomDistance(self.model, self.data, hull, self._ground, cap, None)
            if answer <= 0 or answer >= cap - SLACK:
                return float(min(answer, cap))
            cap = answer

    def _gap(self) -> float:
        """The least height of the placed hulls' corners above the surface, m; negative when one lies below it."""
        corners = np.concatenate(self._corners) @ self.data.xmat[self._body].reshape(3, 3).T
        corners += self.data.xpos[self._body]
        return float((corners[:, 2] - self.terrain.height(corners[:, :2])).min())

    def _centre_distances(self, positions: Array, orientations: Array) -> Array:
        """Signed distance (n, hulls) m of every hull's centre from the surface."""
        rotation = matrices(np.asarray(orientations, float))
        centres = positions[:, None] + np.einsum("nij,hj->nhi", rotation, self._centres)
        points = np.ascontiguousarray(centres.reshape(-1, 3))
        squared, _, _ = self._tree.squared_distance(*self._mesh, points)
        above = points[:, 2] > self.terrain.height(points[:, :2])
        return np.asarray((np.where(above, 1, -1) * np.sqrt(squared)).reshape(centres.shape[:2]))

    def _beyond(self, position: Array) -> bool:
        """Whether hulls at ``position`` may reach beyond the terrain's borders."""
        low, high = self.terrain.lower[:2] + self._reach, self.terrain.upper[:2] - self._reach
        return bool((position[:2] < low).any() or (position[:2] > high).any())

    def _motion(self, positions: Array, orientations: Array) -> float:
        """The farthest any point of the hulls moves between two poses, at most, m."""
        turn = 2 * np.arccos(min(1.0, abs(float(orientations[0] @ orientations[1]))))
        return float(np.linalg.norm(positions[1] - positions[0]) + turn * self._reach)

    def _place(self, position: Array, orientation: Array) -> None:
        import mujoco

        self.data.qpos[:3], self.data.qpos[3:7] = position, orientation
        mujoco.mj_kinematics(self.model, self.data)

    def _vertices(self, geom: int) -> Array:
        """The vertices (n, 3) m of a mesh geom where it stands now."""
        mesh = self.model.geom_dataid[geom]
        start, count = self.model.mesh_vertadr[mesh], self.model.mesh_vertnum[mesh]
        points = self.model.mesh_vert[start : start + count].astype(float)
        return np.asarray(points @ self.data.geom_xmat[geom].reshape(3, 3).T + self.data.geom_xpos[geom])


def _poses(positions: ArrayLike, orientations: ArrayLike) -> tuple[Array, Array]:
    """Positions (n, 3) and unit quaternions (n, 4), or an ``InputError``."""
    points, quaternions = np.atleast_2d(np.asarray(positions, float)), np.atleast_2d(np.asarray(orientations, float))
    wanted = {"positions": (points, 3, "x, y, z in metres"), "orientations": (quaternions, 4, "w, x, y, z")}
    for key, (array, width, mend) in wanted.items():
        if array.ndim != 2 or array.shape != (len(points), width):
            raise InputError(str(Problem(key, "has the wrong shape", f"give one row of {mend} per pose", array.shape)))
        if not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise InputError(str(Problem(f"{key}[{row}]", "not finite", f"give {mend}", array[row].tolist())))
    norm = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if (norm < 1e-9).any():
        row = int(np.argmin(norm))
        raise InputError(str(Problem(f"orientations[{row}]", "no rotation", "give a unit quaternion w, x, y, z")))
    return points, quaternions / norm
