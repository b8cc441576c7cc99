"""How the preview draws water: a mesh and a texture, both new in every frame, and wet lines on touching objects.

MuJoCo's shading has no Fresnel effect, so the appearance of the surface (sky mirrored at a grazing angle, depths seen
from above, the sun's glint, foam) is computed here, texel by texel for the camera's place, in display colours divided
by the light with which MuJoCo will multiply them. Everything is read from the stage.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.exporters.usd.scenery.lighting import to_srgb
from vehsim.exporters.usd.scenery.shading import HIGHLIGHT, Light, dome_mean, sky_image
from vehsim.exporters.usd.scenery.water_material import patches
from vehsim.exporters.usd.stage import StageReader, Sun

Array = NDArray[np.floating]

FINER = 4
"""Texels of the texture per cell of the mesh, along each side."""
DEPTHS = np.array([0.006, 0.022, 0.030])
CREST = np.array([0.020, 0.075, 0.070])
"""Linear colours seen in the water: its depths, and thin crests lit from behind."""
FOAM = 0.8
"""Albedo of foam."""
RIPPLES, RIPPLES_END = 10, 58.5
"""Ripples that only the texture has, and the distance up to which the last of them are visible, m."""
SLOPES, FAR = 0.22, (25.0, 160.0)
"""Effect of waves too distant to be distinguished: between the distances ``FAR``, m, more and more of the visible faces
are tilted by up to ``SLOPES`` towards the eye. So a sea is darker than the sky at its horizon."""
WET, WETNESS = 0.15, 0.55
"""Height of the dark line above the water, m, and the share of light that remains there."""
NEAR = 60.0
"""Largest distance at which wet lines are drawn, m."""
HULL = 1.5
"""Pixels this close to water lowered inside a hull belong to the hull, m."""


class WaterView:
    """A stage's water in MuJoCo's renderer: `author` it into a spec, `bind` it to the model, `draw` it for a frame."""

    def __init__(self, stage: StageReader, light: Light, shadows: bool = True) -> None:
        assert stage.water is not None
        self._stage, self._light = stage, light
        self.shape = stage.water_grid()
        self._time = float(stage.frames[0])
        self._points, self._normals, self._foam, self._lowered = stage.water_at(stage.frames[0])
        sun, sky = stage.sun(), stage.sky()
        self._sun, self._sky = sun or Sun(np.array([0.0, 0.0, -1.0]), np.ones(3)), sky
        image = sky_image(sky)
        fill, self._image = dome_mean(image), image.astype(np.float32)
        self._fill = fill
        self._exposure = HIGHLIGHT / float((fill + self._sun.colour / np.pi).max())
        overhead = max(-float(self._sun.direction[2]), 0.0)
        # MuJoCo's emission of 1 shows the texture unchanged. Shadows are added in a separate pass, so that a shadow on
        # water removes little light: most of the visible light is mirrored.
        self._lit = 1.0 + shadows * overhead * light.sun
        rng = np.random.default_rng(3)
        heading, length = rng.uniform(0, 2 * np.pi, RIPPLES), np.geomspace(0.35, 1.8, RIPPLES)
        self._ripples = 2 * np.pi / length * np.stack([np.cos(heading), np.sin(heading)])
        self._phases = rng.uniform(0, 2 * np.pi, RIPPLES)

    def author(self, spec: Any) -> None:
        """Add mesh, texture and geom to a spec."""
        import mujoco

        from vehsim.exporters.usd.scenery.water import quads

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
        material = spec.add_material(name="water", rgba=[1, 1, 1, 1], specular=0.0, shininess=0.0, emission=1.0)
        roles = list(material.textures)
        roles[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "water"
        material.textures = roles
        kind = mujoco.mjtGeom.mjGEOM_MESH
        spec.worldbody.add_geom(
            name="water", type=kind, meshname="water", material="water", contype=0, conaffinity=0, mass=0.0,
            castshadow=False,
        )  # fmt: skip

    def draw(self, model: Any, data: Any, context: Any, frame: float, eye: Array) -> None:
        """Update mesh and texture to a frame, seen from ``eye`` (3,) m. The OpenGL context must be current."""
        import mujoco

        self._time = frame
        self._points, self._normals, self._foam, self._lowered = self._stage.water_at(frame)
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
        """The appearance of every texel (h, w, 3)."""
        points, normals = self._fine(self._points), self._fine(self._normals)
        (foam,) = self._fine(self._foam[:, None])
        eye = eye.astype(np.float32)
        away = _length(points[:2] - eye[:2, None])
        normals[:2] -= self._small_slopes(points, away)
        normals /= _length(normals)
        view = eye[:, None] - points
        view /= np.maximum(_length(view), 1e-6)
        tilt = SLOPES * np.clip((away - FAR[0]) / (FAR[1] - FAR[0]), 0, 1)
        facing = np.clip((normals * view).sum(axis=0) + 0.5 * tilt, 0.04, 1.0)
        fresnel = 0.02 + 0.98 * (1 - facing) ** 5
        mirrored = 2 * facing * normals - view
        mirrored[2] = np.abs(mirrored[2]) + 0.02 + 2 * tilt
        mirrored /= _length(mirrored)
        crest = np.clip((points[2] - float(self._points[:, 2].mean())) / 0.6, 0, 1)
        white = patches(points[0], points[1], foam)
        bright = FOAM * (self._fill + max(-float(self._sun.direction[2]), 0.4) * self._sun.colour / np.pi)
        seen, glint = self._seen(mirrored), self._glint(mirrored)
        colour = np.empty((foam.size, 3), np.float32)
        for k in range(3):
            depths, lit_crest = (float(c[k] * self._fill[k] * np.pi) for c in (DEPTHS, CREST))
            water = (1 - fresnel) * (depths + lit_crest * crest)
            water += fresnel * (seen[k] + glint * float(self._sun.colour[k]))
            colour[:, k] = (1 - white) * water + white * float(bright[k])
        display = to_srgb(np.clip(colour * self._exposure, 0, 1)) / self._lit.astype(np.float32)
        rows, cols = self.shape
        return np.round(255 * np.clip(display, 0, 1)).astype(np.uint8).reshape(rows * FINER, cols * FINER, 3)

    def _fine(self, values: Array) -> Array:
        """Values (n, k) at the vertices, interpolated to the texels (k, m)."""
        rows, cols = self.shape
        net = values.T.reshape(-1, rows, cols).astype(np.float32)
        for axis, count in ((1, rows), (2, cols)):
            at = np.clip((np.arange(count * FINER) + 0.5) / FINER - 0.5, 0, count - 1)
            low = np.minimum(at.astype(int), count - 2)
            share = (at - low).astype(np.float32)
            share = share[:, None] if axis == 1 else share
            net = (1 - share) * net.take(low, axis) + share * net.take(low + 1, axis)
        return np.asarray(net.reshape(len(net), -1), np.float32)

    def _small_slopes(self, points: Array, away: Array) -> Array:
        """Slopes (2, m) of ripples, which fade with the distance."""
        slopes = np.zeros((2, away.size), np.float32)
        near = np.flatnonzero(away < RIPPLES_END)
        x, y = points[0, near], points[1, near]
        seconds = (self._time - self._stage.frames[0]) / float(self._stage.fps)
        for (kx, ky), phase in zip(self._ripples.T.tolist(), self._phases.tolist(), strict=True):
            k = math.hypot(kx, ky)
            wave = np.cos(x * kx + (y * ky + (phase - math.sqrt(GRAVITY * k) * seconds) % (2 * math.pi)))
            slopes[0, near] += wave * (kx / k)
            slopes[1, near] += wave * (ky / k)
        return np.asarray(0.035 * slopes * np.clip((RIPPLES_END - away) / 45.0, 0, 1))

    def _glint(self, directions: Array) -> Array:
        """The sun's reflection (m,) along ``directions`` (3, m), as a share of its colour."""
        towards = (-self._sun.direction).tolist()
        sun = np.clip(directions[0] * towards[0] + directions[1] * towards[1] + directions[2] * towards[2], 0, 1)
        glint = np.zeros(sun.size, np.float32)
        near = np.flatnonzero(sun > 0.8)  # 0.8^160 is 3e-16
        glint[near] = 0.5 * sun[near] ** 160
        return glint

    def _seen(self, directions: Array) -> Array:
        """Radiance (3, m) of the sky along ``directions`` (3, m)."""
        R_dw = np.eye(3) if self._sky is None else self._sky.R_wd.T
        x, y, z = (row[0] * directions[0] + row[1] * directions[1] + row[2] * directions[2] for row in R_dw.tolist())
        height, width = self._image.shape[:2]
        u = (np.arctan2(z, x) + np.pi / 2) / (2 * np.pi) % 1.0
        v = np.arccos(np.clip(y, -1, 1)) / np.pi
        texel = np.minimum((v * height).astype(int), height - 1) * width + (u * width).astype(int) % width
        return np.asarray(self._image.reshape(-1, 3).take(texel, axis=0).T)

    def wet(self, colour: NDArray[np.uint8], places: Array, distance: Array) -> NDArray[np.uint8]:
        """Pixels (h, w, 3), with wet lines on objects in the water; ``places`` (h, w, 3) m, ``distance`` (h, w) m."""
        from scipy.spatial import cKDTree

        surface = self._points + self._lowered[:, None] * (0.0, 0.0, 1.0)
        low, high = float(surface[:, 2].min()), float(surface[:, 2].max()) + WET
        near = (distance < NEAR) & (places[..., 2] > low) & (places[..., 2] < high)
        rows, cols = np.nonzero(near & self._outside(places, near))
        if not len(rows):
            return colour
        at = places[rows, cols]
        apart, nearest = cKDTree(surface[:, :2]).query(at[:, :2], k=4)
        point, normal = surface[nearest], self._normals[nearest]
        rise = -(normal[..., :2] / normal[..., 2:] * (at[:, None, :2] - point[..., :2])).sum(axis=2)
        weight = 1 / (apart**2 + 1e-4)
        above = at[:, 2] - ((point[..., 2] + rise) * weight).sum(axis=1) / weight.sum(axis=1)
        wet = np.clip((above - 0.02) / 0.02, 0, 1) * np.clip((WET - above) / 0.06, 0, 1)
        dark = colour[rows, cols] * (1 - (1 - WETNESS) * wet)[:, None]
        colour = colour.copy()
        colour[rows, cols] = np.round(dark).astype(np.uint8)
        return colour

    def _outside(self, places: Array, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The pixels (h, w), of those ``near`` the water, that are not on the inside of a hull, such as a cockpit."""
        from scipy.spatial import cKDTree

        rows, cols = np.nonzero(near)
        inside = self._points[self._lowered > 0, :2]
        if not len(rows) or not len(inside):
            return near
        after = [np.minimum(index + 1, size - 1) for index, size in zip((rows, cols), near.shape, strict=True)]
        at = places[rows, cols]
        facing = np.cross(places[rows, after[1]] - at, places[after[0], cols] - at)
        facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
        apart, nearest = cKDTree(inside).query(at[:, :2], distance_upper_bound=HULL)
        hull = np.isfinite(apart)
        outwards = at[hull, :2] - inside[nearest[hull]]
        looks = np.einsum("ni,ni->n", facing[hull, :2], outwards) > 0.2 * apart[hull]
        outside = near.copy()
        outside[rows[hull], cols[hull]] = looks
        return outside


def _length(vectors: Array) -> Array:
    """Lengths (m,) of ``vectors`` (k, m)."""
    return np.asarray(np.sqrt((vectors**2).sum(axis=0)))


def places_of(
    depth: NDArray[np.floating],
    eye: Any,
    forward: Array,
    up: Array,
    half: tuple[float, float],
    clip: tuple[float, float],
    part: tuple[slice, slice] = (slice(None), slice(None)),
    shift: tuple[float, float] = (0.0, 0.0),
) -> tuple[Array, Array]:
    """World places (h, w, 3) m of pixels, bottom row first, and their distance (h, w) along the view; inf: background.

    ``depth`` (h, w): 1 at the near plane, 0 at the far one; ``half``: width and height of the view at distance 1;
    ``part``: rows and columns of the requested pixels; ``shift``: of the view to the right and up at distance 1.
    """
    (near, far), (h, w) = clip, depth.shape
    x = (np.arange(w)[part[1]] + 0.5) / w * 2 - 1
    y = (np.arange(h)[part[0]] + 0.5) / h * 2 - 1
    share = depth[part].astype(float)
    distance = np.where(share > 0, near * far / np.maximum(share * (far - near) + near, 1e-12), np.inf)
    side = np.cross(forward, up)
    ray = forward + (shift[0] + half[0] * x[None, :, None]) * side + (shift[1] + half[1] * y[:, None, None]) * up
    reach = np.where(np.isfinite(distance), distance, 0.0)[..., None]
    return np.asarray(eye) + reach * ray, distance
