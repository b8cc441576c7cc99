"""The water's surface inside a MuJoCo model: a height field kept in step with time and with what it follows.

MuJoCo knows triangles only, so where the surface is a formula `Water` itself is the more accurate answer and buoyancy
asks it by default; `Rays` has MuJoCo answer instead. Both are held against each other in the tests.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vehsim.errors import InputError, Problem, SolveError
from vehsim.world.water import Array, Surface, Water

NAME = "water"
GROUP = 4
"""MuJoCo geom group of the surface: not drawn by default, collides with nothing."""
BELOW = 1.0
"""Thickness of the water below its lowest trough in MuJoCo's model, m."""


class WaterField:
    """``water`` as a height field of ``samples`` x ``samples`` points, ``size`` m wide.

    ``update(t, centre)`` moves it, by whole cells so that the surface does not swim, and writes its heights;
    ``heights(xy)`` asks MuJoCo by vertical rays. A ray off the field raises ``SolveError``.
    """

    def __init__(self, water: Water, size: float = 24.0, samples: int = 129):
        import mujoco

        if not (size > 0 and 3 <= samples <= 2049):
            mend = "give a width in m and 3 to 2049 samples a side"
            raise InputError(str(Problem("water field", "not a grid", mend, (size, samples))))
        self.water, self.size, self.samples, self.cell = water, size, samples, size / (samples - 1)
        spec = mujoco.MjSpec()
        self.add_to(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.time, self.centre = 0.0, np.zeros(2)
        self.update(0.0, np.zeros(2))

    def add_to(self, spec: Any) -> Any:
        """Add the surface to a ``mujoco.MjSpec``; returns its geom, on a body of its own that `write` moves."""
        import mujoco

        n = self.samples
        spec.add_hfield(
            name=NAME, size=[self.size / 2, self.size / 2, 1.0, BELOW], nrow=n, ncol=n, userdata=np.zeros(n * n)
        )
        body = spec.worldbody.add_body(name=NAME, mocap=True)
        return body.add_geom(
            name=NAME, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=NAME, group=GROUP, contype=0, conaffinity=0
        )

    def update(self, t: float, centre: Any) -> None:
        """The surface at ``t`` s, its middle within a cell of ``centre`` (2,) m."""
        self.write(self.model, self.data, t, centre)

    def write(self, model: Any, data: Any, t: float, centre: Any) -> None:
        """Write the surface into any compiled model that `add_to` was asked for."""
        import mujoco

        self.time, self.centre = t, np.round(np.asarray(centre, float)[:2] / self.cell) * self.cell
        side = (np.arange(self.samples) - (self.samples - 1) / 2) * self.cell
        x, y = np.meshgrid(self.centre[0] + side, self.centre[1] + side)
        heights = self.water.height(np.column_stack([x.ravel(), y.ravel()]), t)
        low, high = float(heights.min()), float(heights.max())
        relief = max(high - low, 1e-3)
        field = model.hfield(NAME).id
        start = int(model.hfield_adr[field])
        model.hfield_size[field, 2] = relief
        model.hfield_data[start : start + heights.size] = (heights - low) / relief
        data.mocap_pos[model.body_mocapid[model.body(NAME).id]] = [*self.centre, low]
        mujoco.mj_kinematics(model, data)

    def heights(self, xy: Any) -> Array:
        """Height (n,) m of the surface above ``xy`` (n, 2) m, found by vertical rays from above."""
        import mujoco

        points = np.asarray(xy, float).reshape(-1, 2)
        off = np.abs(points - self.centre).max(axis=1, initial=0.0) > self.size / 2
        if off.any():
            x, y = points[np.flatnonzero(off)[0]]
            raise SolveError(
                f"water field: asked at ({x:.2f}, {y:.2f}) m, off its {self.size:g} m around "
                f"({self.centre[0]:.2f}, {self.centre[1]:.2f}); move it with update(), or make it larger"
            )
        geom = self.model.geom(NAME).id
        top = float(self.data.geom_xpos[geom, 2] + self.model.hfield_size[self.model.hfield(NAME).id, 2] + 1.0)
        down, found = np.array([0.0, 0.0, -1.0]), np.empty(len(points))
        origin = np.array([0.0, 0.0, top])
        for k, point in enumerate(points):
            origin[:2] = point
            found[k] = mujoco.mj_rayHfield(self.model, self.data, geom, origin, down, None)
        if (found < 0).any():  # a ray along the border itself may pass by it
            raise SolveError("water field: a ray missed it; keep its borders away from what asks")
        return top - found


class Rays:
    """A surface as MuJoCo answers for it (LIE 4.3.2): `Surface` by vertical rays on a field that follows who asks.

    ``surface`` is what the field shows, ``cell`` m its spacing: heights are off the formula's by a cell's bend at most,
    velocities are the surface's own. The field grows with what asks, so that nothing is asked off it.
    """

    def __init__(self, surface: Surface, cell: float = 0.1):
        if not 0 < cell < 100:
            raise InputError(str(Problem("water field", "not a cell", "give its width in m, such as 0.1", cell)))
        self.surface, self.cell = surface, float(cell)
        self.field: WaterField | None = None

    @property
    def shortest(self) -> float:
        return self.surface.shortest

    @property
    def curvature(self) -> float:
        return self.surface.curvature

    @property
    def content_hash(self) -> str:
        return f"rays:{self.cell}:{self.surface.content_hash}"

    def at(self, points: Array, level: float, t: float) -> tuple[Array, Array]:
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        need = float((high - low).max()) + 4 * self.cell
        if self.field is None or self.field.size < need:
            samples = 2 * int(np.ceil(0.75 * need / self.cell)) + 1
            self.field = WaterField(Water(0.0, self.surface), (samples - 1) * self.cell, samples)
        self.field.update(t, (low + high) / 2)
        return self.field.heights(points[:, :2]), self.surface.at(points, level, t)[1]

    def slope(self, xy: Array, t: float) -> Array:
        return self.surface.slope(xy, t)
