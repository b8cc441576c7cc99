"""The exact distance between a vehicle's convex hulls and terrain with overhangs, by FCL's bounding volumes.

`scene.py` measures height fields, for which MuJoCo has a geom; it has none for a concave surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.lie.quaternions import matrices
from vehsim.rig.linkage import part_poses
from vehsim.rig.parts import solids
from vehsim.rig.rig import Rig
from vehsim.world.distance.scene import TOUCHING, checked_poses, owners_of
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]


class SurfaceScene:
    """A terrain with a surface and one vehicle's hulls, for distance queries.

    ``mesh``: points (n, 3) m and faces (m, 3) of the part of the surface that counts, all by default. ``carriers``:
    paths of the parts that swing out of the vehicle, such as trailers.
    """

    def __init__(
        self,
        terrain: Terrain,
        rig: Rig,
        mesh: tuple[Array, NDArray[np.int64]] | None = None,
        carriers: Sequence[str] = (),
    ) -> None:
        import fcl
        import igl
        from scipy.spatial import ConvexHull

        self.terrain, self.rig, self.carriers, self._whole = terrain, rig, ("", *carriers), mesh is None
        hulls: list[Array] = []
        owners: list[int] = []
        carrier = owners_of(rig, self.carriers)
        for solid in solids(rig.asset, rig.root or None):
            hulls += solid.hulls
            owners += [self.carriers.index(carrier[solid.path])] * len(solid.hulls)
        self._owners = np.array(owners)
        shapes = [ConvexHull(hull) for hull in hulls]
        self._corners = [hull[shape.vertices] for hull, shape in zip(hulls, shapes, strict=True)]
        self._planes = [shape.equations for shape in shapes]
        self._centres = np.array([0.5 * (c.min(axis=0) + c.max(axis=0)) for c in self._corners])
        self._radii = np.array(
            [np.linalg.norm(c - m, axis=1).max() for c, m in zip(self._corners, self._centres, strict=True)]
        )
        pairs = zip(hulls, shapes, strict=True)
        self._hulls = [fcl.CollisionObject(_model(hull, shape.simplices)) for hull, shape in pairs]
        points, faces = (terrain.vertices, terrain.faces) if mesh is None else mesh
        self._mesh = np.ascontiguousarray(points), np.ascontiguousarray(faces)
        if not len(faces):
            return
        self._rock = fcl.CollisionObject(_model(*self._mesh))
        self._tree = igl.AABB()
        self._tree.init(*self._mesh)
        _, first = np.unique(igl.vertex_components(self._mesh[1]), return_index=True)
        self._pieces = self._mesh[0][first]

    def clearance(
        self,
        positions: ArrayLike,
        orientations: ArrayLike,
        channels: Mapping[str, Array] = MappingProxyType({}),
    ) -> Array:
        """Signed distance (n,) m from the hulls to the terrain at rig-root poses (n, 3) m, (n, 4) w, x, y, z;
        ``channels`` (n,): those that move the ``carriers``.

        Exact in the air. A pose that touches the rock gives minus the distance of the hulls' deepest corner or centre
        in it from the surface. Beyond the borders the ground continues level, and the result is at most the height
        above it.
        """
        import fcl

        positions, orientations = checked_poses(positions, orientations)
        result = np.full(len(positions), np.inf)
        if not len(self._mesh[1]):
            return result
        own = [part_poses(self.rig, path, channels, positions, orientations) for path in self.carriers]
        places, turned = (np.stack(pose, axis=1)[:, self._owners] for pose in zip(*own, strict=True))
        rotations = matrices(turned.reshape(-1, 4)).reshape(*turned.shape[:2], 3, 3)
        away = self._signed(places + np.einsum("nhij,hj->nhi", rotations, self._centres))
        for k in range(len(positions)):
            lower, best = away[k] - self._radii, np.inf
            for hull in np.argsort(lower):
                if lower[hull] >= best or best <= 0:
                    break
                position, turn = places[k, hull], rotations[k, hull]
                self._hulls[hull].setTransform(fcl.Transform(turned[k, hull], position))
                inside = (
                    (self._pieces - position) @ turn @ self._planes[hull][:, :3].T + self._planes[hull][:, 3]
                ) <= 0
                buried = away[k, hull] <= 0 or inside.all(axis=1).any()
                best = 0.0 if buried else min(best, fcl.distance(self._hulls[hull], self._rock))
            placed = zip(self._corners, rotations[k], places[k], strict=True)
            corners = np.concatenate([corner @ turn.T + position for corner, turn, position in placed])
            if best <= 0:
                result[k] = min(-TOUCHING, self._signed(corners).min(), away[k].min())
            else:
                result[k] = min(best, self._above_level(corners)) if self._whole else best
        return result

    def _signed(self, points: Array) -> Array:
        """Signed distances (...) m of points (..., 3) from the surface, negative in the rock."""
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        squared, _, _ = self._tree.squared_distance(*self._mesh, flat)
        away = np.where(self.terrain.below(flat), -1, 1) * np.sqrt(squared)
        return np.asarray(away.reshape(points.shape[:-1]))

    def _above_level(self, corners: Array) -> float:
        """The smallest height m of corners (n, 3) beyond the borders above the ground there; inf without any."""
        low, high = self.terrain.lower[:2], self.terrain.upper[:2]
        beyond = corners[((corners[:, :2] < low) | (corners[:, :2] > high)).any(axis=1)]
        return float((beyond[:, 2] - self.terrain.height(beyond[:, :2])).min(initial=np.inf)) if len(beyond) else np.inf


def _model(points: Array, faces: NDArray[Any]) -> Any:
    """Triangles with FCL's hierarchy of bounding volumes."""
    import fcl

    model = fcl.BVHModel()
    model.beginModel(len(faces), len(points))
    model.addSubModel(np.ascontiguousarray(points), np.ascontiguousarray(faces, dtype=np.int64))
    model.endModel()
    return model
