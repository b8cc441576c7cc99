"""Exact distances between a vehicle's convex hulls and obstacles, standing and moving, by MuJoCo.

`scene.py` measures the distance to terrain. The optimiser uses the smooth field of `field.py` instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from threading import Lock
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.rig.linkage import part_poses
from vehsim.rig.rig import Rig
from vehsim.world.distance.scene import add_carriers
from vehsim.world.obstacles.articulated import carriers_of, swung
from vehsim.world.obstacles.obstacles import Moving, Obstacle

Array = NDArray[np.float64]

POINT = 1e-6
"""Radius of the ball that represents a vehicle without an asset, m."""
EXACT = 1e-6
"""Accuracy of MuJoCo's distances, m: pairs of hulls are compared with bounds that are that much smaller."""
CHUNK = 64
"""Number of poses whose bounds are found at once."""


class ObstacleScene:
    """One vehicle's hulls and a world's obstacles in a MuJoCo model, for distance queries.

    ``carriers``: paths of the parts that swing out of the vehicle, with all parts below them, such as trailers, parents
    before children; the other parts stay as they are at rest.
    """

    def __init__(self, rig: Rig | None, obstacles: Sequence[Obstacle | Moving], carriers: Sequence[str] = ()) -> None:
        import mujoco

        spec = mujoco.MjSpec()
        self.obstacles, self.rig, self.carriers = list(obstacles), rig, ("", *carriers)
        bodies = [[_add_point(spec)] if rig is None else add_carriers(spec, rig, "vehicle", self.carriers)]
        for k, obstacle in enumerate(self.obstacles):
            if isinstance(obstacle, Moving):
                bodies.append(add_carriers(spec, _rig(obstacle), f"obstacle/{k}", _carriers(obstacle)))
                continue
            body = spec.worldbody.add_body(name=f"obstacle/{k}")
            for n, hull in enumerate(obstacle.hulls):
                mesh = f"obstacle/{k}/{n}"
                spec.add_mesh(name=mesh, uservert=np.ravel(hull), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
                body.add_geom(name=mesh, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh)
            bodies.append([body])
        geoms = [[geom.name for body in group for geom in body.geoms] for group in bodies]
        names = [[body.name for body in group] for group in bodies]
        self.model = spec.compile()
        self.data, self._lock = mujoco.MjData(self.model), Lock()
        self._own, *self._theirs = [[self.model.geom(name).id for name in group] for group in geoms]
        self._places = [[self._place_of(name) for name in group] for group in names]

    def _place_of(self, body: str) -> int:
        """Where the pose of a body is in the model's coordinates; -1 for one that stands."""
        joint = int(self.model.body_jntadr[self.model.body(body).id])
        return int(self.model.jnt_qposadr[joint]) if joint >= 0 else -1

    def clearance(
        self,
        positions: Array,
        orientations: Array,
        seconds: Array | None = None,
        each: bool = False,
        channels: Mapping[str, Array] = MappingProxyType({}),
    ) -> Array:
        """Signed distances m at rig-root poses (n, 3) m, (n, 4) w, x, y, z: (n, 1) to the nearest, or to ``each``.

        ``seconds`` (n,) since frame 0; without them, moving obstacles are ignored. ``channels`` (n,): those that move
        the ``carriers``; without them, all parts are at rest. Negative: the depth of the overlap.
        """
        own = [(positions, orientations)]
        if self.rig is not None:
            own = [part_poses(self.rig, path, channels, positions, orientations) for path in self.carriers]
        moving = {k: o for k, o in enumerate(self.obstacles) if isinstance(o, Moving)}
        shown = [k for k in range(len(self.obstacles)) if k not in moving or seconds is not None]
        placed = [*zip(self._places[0], own, strict=True)]
        for k, obstacle in moving.items():
            if seconds is not None:
                rig, there = _rig(obstacle), obstacle.poses_at(seconds)
                turned = swung(obstacle.clip.vehicle, obstacle.channels_at(seconds))
                poses = [part_poses(rig, path, turned, *there) for path in _carriers(obstacle)]
                placed += zip(self._places[k + 1], poses, strict=True)
        groups = [self._theirs[k] for k in shown] if each else [[geom for k in shown for geom in self._theirs[k]]]
        columns = shown if each else [0]
        result = np.full((len(positions), len(self.obstacles) if each else 1), np.inf)
        for first in range(0, len(positions), CHUNK):
            rows = range(first, min(first + CHUNK, len(positions)))
            with self._lock:  # MuJoCo releases Python's
                centres, turns = (np.stack(each) for each in zip(*(self._posed(placed, n) for n in rows), strict=True))
                bounds = [self._least(centres, turns, group) for group in groups]
                for k, n in enumerate(rows):
                    self.data.geom_xpos[:], self.data.geom_xmat[:] = centres[k], turns[k]
                    result[n, columns] = [
                        self._nearest(least[k], group) for least, group in zip(bounds, groups, strict=True)
                    ]
        return result

    def _posed(self, placed: Sequence[tuple[int, tuple[Array, Array]]], n: int) -> tuple[Array, Array]:
        """Places (geoms, 3) m and rotations (geoms, 9) of all geoms at sample ``n`` of the poses of the bodies."""
        import mujoco

        for at, (points, quaternions) in placed:
            self.data.qpos[at : at + 3], self.data.qpos[at + 3 : at + 7] = points[n], quaternions[n]
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.geom_xpos.copy(), self.data.geom_xmat.copy()

    def _least(self, centres: Array, turns: Array, others: Sequence[int]) -> Array:
        """Lower bounds (n, own geoms, others) m of the distances between the vehicle's geoms and ``others`` at poses
        (n, geoms, 3) m and (n, geoms, 9): from a ball around each of its geoms to a box around each of the others."""
        boxes = self.model.geom_aabb[others]
        between = centres[:, self._own, None] - centres[:, None, others]
        inside = np.einsum("noji,nkoj->nkoi", turns[:, others].reshape(len(turns), len(others), 3, 3), between)
        over = np.abs(inside - boxes[:, :3]) - boxes[:, 3:]
        away = np.sqrt((np.maximum(over, 0.0) ** 2).sum(axis=3)) + np.minimum(over.max(axis=3), 0.0)
        return np.asarray(away - self.model.geom_rbound[self._own][:, None] - EXACT)

    def _nearest(self, least: Array, others: Sequence[int]) -> float:
        """Smallest signed distance of the vehicle's geoms to ``others`` in their current poses, m, whose lower bounds
        (own geoms, others) m are ``least``."""
        import mujoco

        best, centres = np.inf, self.data.geom_xpos
        for pair in np.argsort(least, axis=None):
            i, j = divmod(int(pair), len(others))
            if least[i, j] >= best:
                break
            own, other = self._own[i], others[j]
            apart = float(np.linalg.norm(centres[own] - centres[other]))
            cap = min(best, apart + 1.0)  # the centres lie within the bounds of their hulls
            found = mujoco.mj_geomDistance(self.model, self.data, own, other, cap, None)
            best = min(best, found) if found < cap else best
        return float(best)


def _carriers(obstacle: Moving) -> tuple[str, ...]:
    return ("", *carriers_of(obstacle.clip.vehicle))


def _rig(obstacle: Moving) -> Rig:
    rig: Rig = obstacle.clip.vehicle.rig  # type: ignore[assignment]  # `moving` refuses vehicles without one
    return rig


def _add_point(spec: Any) -> Any:
    """The position of a vehicle without an asset: its root."""
    import mujoco

    body = spec.worldbody.add_body(name="vehicle", mass=1.0, inertia=[1.0, 1.0, 1.0], explicitinertial=True)
    body.add_freejoint()
    body.add_geom(name="vehicle", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[POINT, 0, 0])
    return body
