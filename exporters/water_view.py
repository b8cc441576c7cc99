"""How the preview draws water: a mesh and a picture on it, both new in every frame, and wet lines on what it touches.

MuJoCo's shading knows no Fresnel, so what the surface shows (sky mirrored at a grazing angle, depths seen from above,
the sun's glint, foam) is computed here, texel by texel for where the camera stands, in display colours divided by the
light that MuJoCo will multiply them with. Everything is read from the stage.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.lighting import to_srgb
from vehsim.exporters.shading import HIGHLIGHT, Light, dome_mean, sky_image
from vehsim.exporters.stage import StageReader, Sun

Array = NDArray[np.float64]

FINER = 4
"""Texels of the picture per cell of the mesh, along each side."""
DEPTHS = np.array([0.006, 0.022, 0.030])
CREST = np.array([0.020, 0.075, 0.070])
"""Linear colours of the water seen into: its depths, and thin crests lit from behind."""
FOAM = 0.8
"""Albedo of foam."""
RIPPLES = 7
"""Small waves that only the picture has."""
WET, WETNESS = 0.15, 0.55
"""Height of the dark line above the water, m, and how much of its light is left."""
NEAR = 60.0
"""How far away wet lines are drawn, m."""


class WaterView:
    """A stage's water in MuJoCo's renderer: `author` it into a spec, `bind` to the model, `draw` it for a frame."""

    def __init__(self, stage: StageReader, light: Light) -> None:
        assert stage.water is not None
        self._stage, self._light = stage, light
        self.shape = stage.water_grid()
        self._time = float(stage.frames[0])
        self._points, self._normals, self._foam = stage.water_at(stage.frames[0])
        sun, sky = stage.sun(), stage.sky()
        self._sun, self._sky = sun or Sun(np.array([0.0, 0.0, -1.0]), np.ones(3)), sky
        self._image = sky_image(sky)
        fill = dome_mean(self._image)
        self._fill = fill
        self._exposure = HIGHLIGHT / float((fill + self._sun.colour / np.pi).max())
        overhead = max(-float(self._sun.direction[2]), 0.0)
        self._lit = np.maximum(light.ambient + light.sky + overhead * light.sun, 1e-3)
        rng = np.random.default_rng(3)
        heading, length = rng.uniform(0, 2 * np.pi, RIPPLES), rng.uniform(0.5, 1.6, RIPPLES)
        self._ripples = 2 * np.pi / length * np.stack([np.cos(heading), np.sin(heading)])
        self._phases = rng.uniform(0, 2 * np.pi, RIPPLES)

    def author(self, spec: Any) -> None:
        """Add mesh, texture and geom to a spec."""
        import mujoco

        from vehsim.exporters.water import quads

        rows, cols = self.shape
        faces = quads(rows, cols)
        triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]).astype(np.int32)
        mesh = spec.add_mesh(name="water", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        mesh.uservert = self._points.astype(np.float32).ravel()
        mesh.userface = triangles.ravel()
        mesh.usernormal = np.tile(np.array([0, 0, 1], np.float32), rows * cols)
        mesh.userfacenormal = triangles.ravel()
        row, col = np.divmod(np.arange(rows * cols), cols)
        mesh.usertexcoord = np.stack([(col + 0.5) / cols, (row + 0.5) / rows], axis=1).astype(np.float32).ravel()
        mesh.userfacetexcoord = triangles.ravel()
        texture = spec.add_texture(name="water", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
        texture.height, texture.width = rows * FINER, cols * FINER
        texture.data = bytes(rows * cols * FINER**2 * 3)
        material = spec.add_material(name="water", rgba=[1, 1, 1, 1], specular=0.0, shininess=0.0, emission=0.0)
        roles = list(material.textures)
        roles[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "water"
        material.textures = roles
        kind = mujoco.mjtGeom.mjGEOM_MESH
        spec.worldbody.add_geom(
            name="water", type=kind, meshname="water", material="water", contype=0, conaffinity=0, mass=0.0,
            castshadow=False,
        )  # fmt: skip

    def draw(self, model: Any, data: Any, context: Any, frame: float, eye: Array) -> None:
        """Bring mesh and picture to a frame, seen from ``eye`` (3,) m. The OpenGL context must be current."""
        import mujoco

        self._time = frame
        self._points, self._normals, self._foam = self._stage.water_at(frame)
        mesh, geom = model.mesh("water").id, model.geom("water").id
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        own = (self._points - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
        model.mesh_vert[first : first + count] = own
        mujoco.mjr_uploadMesh(model, context, mesh)
        picture = self._picture(eye)
        texture = model.texture("water").id
        start = model.tex_adr[texture]
        model.tex_data[start : start + picture.size] = picture.ravel()
        mujoco.mjr_uploadTexture(model, context, texture)

    def _picture(self, eye: Array) -> NDArray[np.uint8]:
        """What every texel shows (h, w, 3)."""
        points, normals = self._fine(self._points), self._fine(self._normals)
        foam = self._fine(self._foam[:, None])[:, 0]
        away = np.linalg.norm(points[:, :2] - eye[:2], axis=1)
        slope = self._small_slopes(points[:, :2], away)
        normals[:, :2] -= slope
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        view = eye - points
        view /= np.maximum(np.linalg.norm(view, axis=1, keepdims=True), 1e-6)
        facing = np.clip(np.einsum("ij,ij->i", normals, view), 0.04, 1.0)
        fresnel = (0.02 + 0.98 * (1 - facing) ** 5)[:, None]
        mirrored = 2 * facing[:, None] * normals - view
        mirrored[:, 2] = np.abs(mirrored[:, 2]) + 0.02
        mirrored /= np.linalg.norm(mirrored, axis=1, keepdims=True)
        into = DEPTHS + CREST * np.clip((points[:, 2:] - self._points[:, 2].mean()) / 0.6, 0, 1)
        sun = np.clip(mirrored @ -self._sun.direction, 0, 1)[:, None]
        glint = 0.5 * self._sun.colour * sun**160
        colour = (1 - fresnel) * into * self._fill * np.pi + fresnel * (self._seen(mirrored) + glint)
        white = np.clip(1.25 * foam * (1 + 1.1 * self._grain(points[:, :2])), 0, 1)[:, None]
        bright = FOAM * (self._fill + max(-float(self._sun.direction[2]), 0.4) * self._sun.colour / np.pi)
        colour = (1 - white) * colour + white * bright
        display = to_srgb(np.clip(colour * self._exposure, 0, 1)) / self._lit
        rows, cols = self.shape
        return np.round(255 * np.clip(display, 0, 1)).astype(np.uint8).reshape(rows * FINER, cols * FINER, 3)

    def _fine(self, values: Array) -> Array:
        """Values (n, k) at the vertices, at the texels (m, k)."""
        rows, cols = self.shape
        net = values.reshape(rows, cols, -1)
        for axis, count in ((0, rows), (1, cols)):
            at = np.clip((np.arange(count * FINER) + 0.5) / FINER - 0.5, 0, count - 1)
            low = np.minimum(at.astype(int), count - 2)
            share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
            net = (1 - share) * net.take(low, axis) + share * net.take(low + 1, axis)
        return net.reshape(-1, net.shape[-1])

    def _small_slopes(self, xy: Array, away: Array) -> Array:
        """Slopes (n, 2) of ripples, which the eye no longer tells apart far away."""
        seconds = (self._time - self._stage.frames[0]) / float(self._stage.fps)
        k = np.hypot(*self._ripples)
        slope = np.cos(xy @ self._ripples + self._phases - np.sqrt(9.81 * k) * seconds) @ (self._ripples / k).T
        return 0.035 * slope * np.clip(1.3 - away / 45.0, 0, 1)[:, None]

    def _grain(self, xy: Array) -> Array:
        """Patches and holes of foam (n,), -1 to 1."""
        a, b = np.array([[3.1, 1.7], [-1.3, 4.3]]), np.array([[7.9, -2.2], [1.9, 9.1]])
        coarse = np.sin(xy @ a[0] + 1.3 * np.sin(xy @ a[1]))
        return np.asarray(0.55 * coarse + 0.45 * np.sin(xy @ b[0] + 1.7 * np.sin(xy @ b[1] + coarse)))

    def _seen(self, ways: Array) -> Array:
        """Radiance (n, 3) of the sky along ``ways`` (n, 3)."""
        own = ways if self._sky is None else ways @ self._sky.R_wd
        height, width = self._image.shape[:2]
        u = (np.arctan2(own[:, 2], own[:, 0]) + np.pi / 2) / (2 * np.pi) % 1.0
        v = np.arccos(np.clip(own[:, 1], -1, 1)) / np.pi
        return np.asarray(
            self._image[np.minimum((v * height).astype(int), height - 1), (u * width).astype(int) % width]
        )

    def wet(self, colour: NDArray[np.uint8], places: Array, distance: Array) -> NDArray[np.uint8]:
        """Pixels (h, w, 3), wet lines on what stands in the water; ``places`` (h, w, 3) m, ``distance`` (h, w) m."""
        from scipy.spatial import cKDTree

        low, high = float(self._points[:, 2].min()), float(self._points[:, 2].max()) + WET
        rows, cols = np.nonzero((distance < NEAR) & (places[..., 2] > low) & (places[..., 2] < high))
        if not len(rows):
            return colour
        at = places[rows, cols]
        apart, nearest = cKDTree(self._points[:, :2]).query(at[:, :2], k=4)
        point, normal = self._points[nearest], self._normals[nearest]
        rise = -(normal[..., :2] / normal[..., 2:] * (at[:, None, :2] - point[..., :2])).sum(axis=2)
        weight = 1 / (apart**2 + 1e-4)
        above = at[:, 2] - ((point[..., 2] + rise) * weight).sum(axis=1) / weight.sum(axis=1)
        ragged = WET * (0.8 + 0.2 * np.sin(9.0 * at[:, 0] + 4.0 * np.sin(5.0 * at[:, 1])))
        wet = np.clip((above - 0.035) / 0.02, 0, 1) * np.clip((ragged - above) / 0.04, 0, 1)
        dark = colour[rows, cols] * (1 - (1 - WETNESS) * wet)[:, None]
        colour = colour.copy()
        colour[rows, cols] = np.round(dark).astype(np.uint8)
        return colour


def places_of(
    depth: Array, eye: Any, forward: Array, up: Array, half: tuple[float, float], clip: tuple[float, float]
) -> tuple[Array, Array]:
    """World places (h, w, 3) m of pixels, bottom row first, and their distance (h, w) along the view; inf: nothing.

    ``depth`` (h, w): 1 at the near plane, 0 at the far one; ``half``: width and height of the view at distance 1.
    """
    near, far = clip
    distance = near * far / np.maximum(depth * (far - near) + near, 1e-12)
    distance = np.where(depth > 0, distance, np.inf)
    h, w = depth.shape
    x = (np.arange(w) + 0.5) / w * 2 - 1
    y = (np.arange(h) + 0.5) / h * 2 - 1
    side = np.cross(forward, up)
    ray = forward + half[0] * x[None, :, None] * side + half[1] * y[:, None, None] * up
    reach = np.where(np.isfinite(distance), distance, 0.0)[..., None]
    return np.asarray(eye) + reach * ray, distance
