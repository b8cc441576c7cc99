"""The water's surface inside a MuJoCo model: a height field kept in step with time and with what it follows.

MuJoCo knows triangles only, so where the surface is a formula the formula is the more accurate answer, and the flow
needs it anyway: it is asked unless ``Water.height_field`` says that MuJoCo is, by `Rays`. The tests hold both against
each other.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vehsim.errors import InputError, Problem, SolveError
from vehsim.world.water import Array, Water

NAME = "water"
GROUP = 4
"""MuJoCo geom group of the surface: not drawn by default, collides with nothing."""
BELOW = 1.0
"""Thickness of the water below its lowest trough in MuJoCo's model, m."""
MOST = 2049
"""Samples a side."""


class WaterField:
    """``water`` as a height field of at most ``samples`` x ``samples`` points, ``size`` m wide.

    ``update(t, centre)`` moves it, by whole cells so that the surface does not swim, and writes its heights;
    ``heights(xy)`` asks MuJoCo by vertical rays. A ray off the field, ``wide`` (2,) m, raises ``SolveError``.
    """

    def __init__(self, water: Water, size: float = 24.0, samples: int = 129):
        import mujoco

        if not (size > 0 and 3 <= samples <= MOST):
            mend = f"give a width in m and 3 to {MOST} samples a side"
            raise InputError(str(Problem("water field", "not a grid", mend, (size, samples))))
        self.water, self.size, self.samples, self.cell = water, size, samples, size / (samples - 1)
        spec = mujoco.MjSpec()
        self.add_to(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.centre = self.wide = np.zeros(2)  # shows nothing yet

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

    def update(self, t: float, centre: Any, wide: Any = np.inf) -> None:
        """The surface at ``t`` s, its middle within a cell of ``centre`` (2,) m; ``wide`` (2,) m of it are enough."""
        self.write(self.model, self.data, t, centre, wide)

    def write(self, model: Any, data: Any, t: float, centre: Any, wide: Any = np.inf) -> None:
        """Write the surface into any compiled model that `add_to` was asked for."""
        import mujoco

        self.centre = np.round(np.asarray(centre, float)[:2] / self.cell) * self.cell
        cells = 2 * np.ceil(np.broadcast_to(np.minimum(wide, self.size), 2) / (2 * self.cell) - 1e-9)
        self.wide = cells * self.cell
        x, y = (c + self.cell * (np.arange(n + 1) - n / 2) for c, n in zip(self.centre, cells, strict=True))
        heights = self.water.height(np.stack(np.meshgrid(x, y), axis=-1), t)
        low, high = float(heights.min()), float(heights.max())
        relief = max(high - low, 1e-3)
        field = model.hfield(NAME).id
        start = int(model.hfield_adr[field])
        model.hfield_ncol[field], model.hfield_nrow[field] = len(x), len(y)
        model.hfield_size[field, :3] = [*self.wide / 2, relief]
        model.hfield_data[start : start + heights.size] = (heights - low) / relief
        data.mocap_pos[model.body_mocapid[model.body(NAME).id]] = [*self.centre, low]
        mujoco.mj_kinematics(model, data)

    def heights(self, xy: Any) -> Array:
        """Height (n,) m of the surface above ``xy`` (n, 2) m, found by vertical rays from above."""
        import mujoco

        points = np.asarray(xy, float).reshape(-1, 2)
        off = (np.abs(points - self.centre) > self.wide / 2).any(axis=1)
        if off.any():
            x, y = points[np.flatnonzero(off)[0]]
            raise SolveError(
                f"water field: asked at ({x:.2f}, {y:.2f}) m, off its {self.wide[0]:g} x {self.wide[1]:g} m around "
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
    """Where ``water`` stands as MuJoCo answers (LIE 4.3.2): by rays on a field of ``cell`` m that follows who asks.

    Heights are off the formula's by a cell's bend at most. The field is as large as what asks: nothing is asked off it.
    """

    def __init__(self, water: Water, cell: float):
        self.water, self.cell = water, cell
        self.field: WaterField | None = None

    def heights(self, xy: Array, t: float) -> Array:
        """Height (n,) m of the surface above ``xy`` (n, 2) m at ``t`` s."""
        low, high = xy.min(axis=0), xy.max(axis=0)
        need = high - low + 4 * self.cell
        if self.field is None or self.field.size < need.max():
            samples = 2 * int(np.ceil(0.6 * need.max() / self.cell)) + 1
            if samples > MOST:
                message = f"{samples} samples a side for what is {need.max():.0f} m wide, {MOST} at most"
                raise InputError(str(Problem("world.water.height_field", message, "give a wider cell", self.cell)))
            self.field = WaterField(self.water, (samples - 1) * self.cell, samples)
        self.field.update(t, (low + high) / 2, need)
        return self.field.heights(xy)
