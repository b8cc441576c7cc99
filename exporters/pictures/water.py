"""How the preview draws water: a mesh and a texture, both new in every frame, and wet lines on touching objects.

MuJoCo's shading has no Fresnel effect, so the appearance of the surface (sky mirrored at a grazing angle, depths seen
from above, the sun's glint, foam) is computed here, texel by texel for the camera's place, in display colours divided
by the light with which MuJoCo will multiply them. Everything is read from the stage.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.exporters.usd.scenery.lighting import to_linear, to_srgb
from vehsim.exporters.usd.scenery.shading import Light, dome_mean
from vehsim.exporters.usd.scenery.water_material import TILE, patches
from vehsim.exporters.usd.stage import StageReader, Sun

Array = NDArray[np.floating]
Mirrored = Callable[[float, tuple[int, int]], tuple[NDArray[np.uint8], NDArray[np.bool_]]]
"""What the camera sees in a mirror at a level, m, in a picture of some width and height: its colours (h, w, 3), and
where it shows anything."""

DENSITY = 0.7
"""Texels of the texture per pixel, where the mesh is seen; at least one per cell of the mesh."""
TALL = 0.6
"""Height of the texture over its width, which is that of the picture."""
BEYOND_VIEW = 1.15
"""Parts of the water further than this times half the picture's diagonal from its middle are not drawn."""
DEPTHS = np.array([0.006, 0.022, 0.030])
CREST = np.array([0.020, 0.075, 0.070])
"""Linear colours seen in the water: its depths, and thin crests lit from behind."""
FOAM, THIN = 0.78, 0.62
"""Albedo of foam, and how much of it old foam has."""
BUBBLES = np.array([0.05, 0.17, 0.17])
"""Linear colour of water with bubbles in it, under foam and around it."""
EDGE = 4
"""Texels around the used part of the texture that repeat its border: beyond the texture's edge is its opposite one."""
RIPPLES, RIPPLE_LENGTHS, RIPPLES_END = 18, (0.16, 1.8), 58.5
"""Ripples that only the texture has, their lengths m, and the distance up to which the last of them are visible, m."""
TEXELS = (2.0, 4.0)
"""Waves that only the texture has are visible with more texels per wave than the first, and fully with the second."""
SLOPES, FAR = 0.22, (25.0, 160.0)
"""Effect of waves too distant to be distinguished: between the distances ``FAR``, m, more and more of the visible faces
are tilted by up to ``SLOPES`` towards the eye. So a sea is darker than the sky at its horizon."""
WET, WETNESS = 0.15, 0.55
"""Height of the dark line above the water, m, and the share of light that remains there."""
NEAR = 60.0
"""Largest distance at which wet lines are drawn, m."""
ON_WATER = 0.4
"""Share of a vehicle's shade that water shows: it mirrors the hull's own light, and its depths are lit from around."""
ASIDE, COARSER = 1.5, 2
"""Distance from the water of the things that it mirrors, by which waves distort them, m, and the width of the pixels of
their picture, in those of the delivered one."""
HULL = 1.5
"""Pixels this close to water lowered inside a hull belong to the hull, m."""


@dataclass(frozen=True)
class Texels:
    """The part of a texture that is drawn, texel by texel, and how it lies on a net of cells.

    ``ends``: of the texels of each row and each column of cells; ``rows``, ``columns`` (n,): of the texels; ``cell``
    (n,): the cell's first place on the net with ``width`` columns; ``shares`` (2, n): how far the texel is across it;
    ``size`` (n,) m.
    """

    ends: tuple[NDArray[np.int64], NDArray[np.int64]]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    cell: NDArray[np.int64]
    shares: NDArray[np.float32]
    size: NDArray[np.float32]

    @classmethod
    def of(cls, rows: NDArray[np.int64], columns: NDArray[np.int64], seen: NDArray[np.bool_], cells: Array) -> Texels:
        """``rows``, ``columns``: texels of each row and column of cells; ``seen``, ``cells`` (rows, columns): whether a
        cell is drawn, and the size of its texels in m."""
        of_row, of_column = (np.repeat(np.arange(len(count)), count) for count in (rows, columns))
        row, column = np.nonzero(seen[of_row[:, None], of_column])
        r, c = of_row[row], of_column[column]
        ends = EDGE + np.cumsum(rows), EDGE + np.cumsum(columns)
        shares = [
            ((at + EDGE - (end - count)[of] + 0.5) / count[of]).astype(np.float32)
            for at, of, end, count in ((row, r, ends[0], rows), (column, c, ends[1], columns))
        ]
        return cls(
            ends,
            row + EDGE,
            column + EDGE,
            r * (len(columns) + 1) + c,
            np.stack(shares),
            cells[r, c].astype(np.float32),
        )

    def corners(self, size: tuple[int, int]) -> Array:
        """Texture coordinates (m, 2) of the net's places in a texture of ``size`` (rows, columns)."""
        v, u = (np.concatenate([[EDGE], end]) / total for end, total in zip(self.ends, size, strict=True))
        return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)

    def nearest(self, size: tuple[int, int]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Row and column of the nearest drawn texel to each of a texture of ``size`` (rows, columns): its smaller
        copies blend the others into water at grazing angles, which would show what an earlier frame left there."""
        from scipy.ndimage import distance_transform_edt

        empty = np.ones(size, bool)
        empty[self.rows, self.columns] = False
        row, column = distance_transform_edt(empty, return_distances=False, return_indices=True)
        return row, column

    def between(self, fields: Array) -> NDArray[np.float32]:
        """Values (m, k) of the net's places on the texels (k, n)."""
        down, right = self.shares[:, None]
        next_row = len(self.ends[1]) + 1
        columns = fields.T.astype(np.float32)

        def row(at: NDArray[np.int64]) -> NDArray[np.float32]:
            left = columns.take(at, axis=1)
            return np.asarray(left + right * (columns.take(at + 1, axis=1) - left))

        near = row(self.cell)
        return np.asarray(near + down * (row(self.cell + next_row) - near))


class WaterView:
    """A stage's water in MuJoCo's renderer: `author` it into a spec, `bind` it to the model, `draw` it for a frame."""

    def __init__(self, stage: StageReader, light: Light, shadows: bool = True, width: int = 960) -> None:
        assert stage.water is not None
        self._stage, self._light = stage, light
        self.shape = stage.water_net.shape
        self._rest, self._waves = TILE * stage.water_st(), stage.water_waves()
        self._size = max(int(TALL * width), self.shape[0] + 2 * EDGE), max(width, self.shape[1] + 2 * EDGE)
        self._time = float(stage.frames[0])
        self._points, self._normals, self._foam, self._lowered = stage.water_at(stage.frames[0])
        sun, sky = stage.sun(), stage.sky()
        self._sun, self._sky = sun or Sun(np.array([0.0, 0.0, -1.0]), np.ones(3)), sky
        fill, self._image = dome_mean(light.image), light.image.astype(np.float32)
        self._fill = fill
        self._exposure = light.exposure
        overhead = max(-float(self._sun.direction[2]), 0.0)
        # MuJoCo's emission of 1 shows the texture unchanged. Shadows are added in a separate pass, so that a shadow on
        # water removes little light: most of the visible light is mirrored.
        self._lit = 1.0 + shadows * overhead * light.sun
        rng = np.random.default_rng(3)
        heading, length = rng.uniform(0, 2 * np.pi, RIPPLES), np.geomspace(*RIPPLE_LENGTHS, RIPPLES)
        self._ripples = 2 * np.pi / length * np.stack([np.cos(heading), np.sin(heading)])
        self._phases = rng.uniform(0, 2 * np.pi, RIPPLES)

    @property
    def foam_colour(self) -> Array:
        """The displayed colour (3,) of foam in the air, 0 to 255."""
        light = self._fill + 0.5 * self._sun.colour / np.pi
        return np.asarray(255 * to_srgb(np.clip(FOAM * light * self._exposure, 0, 1)))

    @property
    def colour(self) -> Array:
        """The displayed colour (3,) of the water from above."""
        return to_srgb(np.clip((DEPTHS * np.pi + 0.02) * self._fill * self._exposure, 0, 1))

    def author(self, spec: Any) -> None:
        """Add mesh, texture and geom to a spec."""
        import mujoco

        rows, cols = self.shape
        triangles = self._stage.water_net.triangles.astype(np.int32)
        mesh = spec.add_mesh(name="water", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        mesh.uservert = self._points.astype(np.float32).ravel()
        mesh.userface = triangles.ravel()
        mesh.usernormal = np.tile(np.array([0, 0, 1], np.float32), rows * cols)
        mesh.userfacenormal = triangles.ravel()
        row, col = np.divmod(np.arange(rows * cols), cols)
        mesh.usertexcoord = np.stack([(col + 0.5) / cols, (row + 0.5) / rows], axis=1).astype(np.float32).ravel()
        mesh.userfacetexcoord = triangles.ravel()
        texture = spec.add_texture(name="water", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
        texture.height, texture.width = self._size
        texture.data = bytes(3 * texture.height * texture.width)
        material = spec.add_material(name="water", rgba=[1, 1, 1, 1], specular=0.0, shininess=0.0, emission=1.0)
        material.roughness = 1.0  # the texture has what the water mirrors
        roles = list(material.textures)
        roles[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "water"
        material.textures = roles
        kind = mujoco.mjtGeom.mjGEOM_MESH
        spec.worldbody.add_geom(
            name="water", type=kind, meshname="water", material="water", contype=0, conaffinity=0, mass=0.0,
            castshadow=False,
        )  # fmt: skip

    def draw(
        self, model: Any, data: Any, context: Any, frame: float, camera: Any, height: int, mirrored: Mirrored
    ) -> None:
        """Update mesh and texture to a frame, for a picture of ``height`` px from MuJoCo's ``camera``. The OpenGL
        context must be current."""
        import mujoco

        self._time, self._height = frame, height
        self._points, self._normals, self._foam, self._lowered = self._stage.water_at(frame)
        mesh, geom = model.mesh("water").id, model.geom("water").id
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        own = (self._points - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
        model.mesh_vert[first : first + count] = own
        texels = self._texels(camera, height)
        first = model.mesh_texcoordadr[mesh]
        model.mesh_texcoord[first : first + count] = texels.corners(self._size)
        mujoco.mjr_uploadMesh(model, context, mesh)
        texture = model.texture("water").id
        start, (rows, cols) = model.tex_adr[texture], self._size
        image = model.tex_data[start : start + 3 * rows * cols].reshape(rows, cols, 3)
        image[texels.rows, texels.columns] = self._picture(texels, camera, mirrored)
        image[:] = image[texels.nearest(self._size)]
        mujoco.mjr_uploadTexture(model, context, texture)

    def _texels(self, camera: Any, height: int) -> Texels:
        """How the texture is shared among the cells of the mesh: by their size in the picture."""
        from scipy.ndimage import maximum_filter

        net = self._points.reshape(*self.shape, 3)
        eye, forward = np.array(camera.pos, float), np.array(camera.forward, float)
        tall = (camera.frustum_top - camera.frustum_bottom) / camera.frustum_near
        wide = 2 * camera.frustum_width / camera.frustum_near
        away = net - eye
        distance = np.maximum(np.linalg.norm(away, axis=2), 0.3)
        ahead = (away @ forward) / distance
        least = math.cos(min(BEYOND_VIEW * math.atan(math.hypot(tall, wide) / 2), math.pi))
        seen = ahead >= min(least, ahead.max())  # a long lens may look between all places of the net
        seen = maximum_filter(seen, 5)  # and the cells around them
        sides, counts = [], []
        for axis in (0, 1):
            steps = np.diff(net, axis=axis)
            start = (slice(None),) * axis + (slice(-1),)
            sight, far = away[start] / distance[start][..., None], distance[start]
            across = np.linalg.norm(np.cross(steps, sight), axis=2)
            pixels = np.where(seen[start], DENSITY * height / tall * across / far, 0.0).max(axis=1 - axis)
            share, total = 1.0, self._size[axis] - 2 * EDGE
            while (count := np.ceil(np.clip(share * pixels, 1, 64)).astype(int)).sum() > total:
                share *= 0.95
            counts.append(count)
            sides.append(np.linalg.norm(steps, axis=2))
        cells = np.maximum(sides[0][:, :-1] / counts[0][:, None], sides[1][:-1] / counts[1][None, :])
        return Texels.of(counts[0], counts[1], seen[:-1, :-1], cells)

    def _picture(self, texels: Texels, camera: Any, mirrored: Mirrored) -> NDArray[np.uint8]:
        """The appearance of the texels (n, 3)."""
        eye = np.array(camera.pos, np.float32)
        fields = np.column_stack([self._points, self._normals, self._anchors(), self._foam])
        points, normals, rest, (foam,) = np.split(texels.between(fields), [3, 6, 8])
        away = _length(points[:2] - eye[:2, None])
        normals[:2] -= self._small_slopes(points, away, texels.size) + self._distant_slopes(texels)
        normals /= _length(normals)
        view = eye[:, None] - points
        view /= np.maximum(_length(view), 1e-6)
        tilt = SLOPES * np.clip((away - FAR[0]) / (FAR[1] - FAR[0]), 0, 1)
        facing = np.clip((normals * view).sum(axis=0) + 0.5 * tilt, 0.04, 1.0)
        fresnel = 0.02 + 0.98 * (1 - facing) ** 5
        directions = 2 * facing * normals - view
        directions[2] = np.abs(directions[2]) + 0.02 + 2 * tilt
        directions /= _length(directions)
        heights = self._points[:, 2]
        crest = np.clip((points[2] - float(heights.mean())) / max(0.6, 3 * float(heights.std())), 0, 1)
        white = patches(rest, foam, texels.size) * (THIN + (1 - THIN) * foam)
        sunlit = np.clip(-(self._sun.direction.astype(np.float32) @ normals), 0, 1)
        seen, glint = self._seen(directions), self._glint(directions)
        near, things = self._things(points, directions, camera, mirrored)
        seen[:, near] = things
        glint[near] = 0
        colour = np.empty((foam.size, 3), np.float32)
        for k in range(3):
            depths, lit_crest, bubbles = (float(c[k] * self._fill[k] * np.pi) for c in (DEPTHS, CREST, BUBBLES))
            water = (1 - fresnel) * (depths + lit_crest * crest + bubbles * foam)
            water += fresnel * (seen[k] + glint * float(self._sun.colour[k]))
            bright = FOAM * (float(self._fill[k]) + sunlit * float(self._sun.colour[k] / np.pi))
            colour[:, k] = (1 - white) * water + white * bright
        display = to_srgb(np.clip(colour * self._exposure, 0, 1)) / self._lit.astype(np.float32)
        return np.asarray(np.round(255 * np.clip(display, 0, 1)), np.uint8)

    def _anchors(self) -> Array:
        """Rest positions (n, 2) m of the water at the points. Those at hulls have moved to the skin, past the water:
        they get the drift of the points around them, or foam would be stretched there."""
        from scipy.ndimage import median_filter

        place = self._points[:, :2]
        drift = (place - self._rest).reshape(*self.shape, 2)
        around = np.stack([median_filter(drift[..., k], 5) for k in (0, 1)], axis=-1)
        return np.asarray(place - around.reshape(-1, 2))

    def _distant_slopes(self, texels: Texels) -> Array:
        """Slopes (2, m) of the waves that the mesh is too coarse to show, where texels can show them."""
        waves, slopes = self._waves, np.zeros((2, len(texels.size)), np.float32)
        if waves is None:
            return slopes
        x, y, cell, share = texels.between(np.column_stack([self._rest, waves.cell, waves.share]))
        phase = (waves.phase - waves.turn * self._time) % (2 * np.pi)
        length, rise = waves.lengths, (waves.amplitude[:, None] * waves.number).astype(np.float32)
        ends = np.searchsorted(texels.rows, texels.ends[0])
        for first, end in itertools.pairwise([0, *ends.tolist()]):
            row = slice(first, end)
            if first == end:
                continue
            carried = (length >= waves.carried[1] * cell[row].max()) & (np.arange(len(length)) < waves.meshed)
            some = np.flatnonzero(~carried & (length > TEXELS[0] * texels.size[row].min()))
            number = waves.number[some].astype(np.float32)
            theta = np.outer(number[:, 0], x[row]) + np.outer(number[:, 1], y[row])
            theta += phase[some, None].astype(np.float32)
            clear = length[some, None].astype(np.float32) / texels.size[row] - TEXELS[0]
            seen = np.clip(clear / (TEXELS[1] - TEXELS[0]), 0, 1) * share[row] * waves.missing(some, cell[row])
            slopes[:, row] = -rise[some].T @ (seen * np.sin(theta))
        return slopes

    def _small_slopes(self, points: Array, away: Array, size: Array) -> Array:
        """Slopes (2, m) of ripples, which fade with the distance, and where texels of ``size`` (m,) m cannot show
        them."""
        slopes = np.zeros((2, away.size), np.float32)
        near = np.flatnonzero(away < RIPPLES_END)
        x, y = points[0, near], points[1, near]
        seconds = (self._time - self._stage.frames[0]) / float(self._stage.fps)
        for (kx, ky), phase in zip(self._ripples.T.tolist(), self._phases.tolist(), strict=True):
            k = math.hypot(kx, ky)
            wave = np.cos(x * kx + (y * ky + (phase - math.sqrt(GRAVITY * k) * seconds) % (2 * math.pi)))
            wave *= np.clip(2 * math.pi / k / size[near] / 3 - 1, 0, 1)
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

    def _things(
        self, points: Array, directions: Array, camera: Any, mirrored: Mirrored
    ) -> tuple[NDArray[np.int64], Array]:
        """The texels (k,) that mirror solid things, and the radiance (3, k) of these, for ``points`` (3, m) m of the
        water and mirrored ``directions`` (3, m). Things are taken to be `ASIDE` m away from the water."""
        level = float(np.median(self._points[:, 2]))
        wide = 2 * camera.frustum_width / (camera.frustum_top - camera.frustum_bottom)
        width, height = (max(int(size) // COARSER, 16) for size in (wide * self._height, self._height))
        picture, there = mirrored(level, (width, height))
        if not there.any():
            return np.zeros(0, int), np.zeros((3, 0))
        forward, up = np.array(camera.forward, np.float32), np.array(camera.up, np.float32)
        away = points + ASIDE * directions
        away[2] = 2 * level - away[2]
        away -= np.array(camera.pos, np.float32)[:, None]
        ahead = np.maximum(forward @ away, 1e-3) / camera.frustum_near
        half = camera.frustum_width, (camera.frustum_top - camera.frustum_bottom) / 2
        middle = camera.frustum_center, (camera.frustum_top + camera.frustum_bottom) / 2
        column, row = (
            np.floor(np.clip((axis @ away / ahead - at) / size, -2, 2) * (0.5 * count) + 0.5 * count).astype(np.int32)
            for axis, at, size, count in zip((np.cross(forward, up), up), middle, half, (width, height), strict=True)
        )
        inside = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
        near = inside[there[row[inside], column[inside]]]
        display = picture[row[near], column[near]].T / np.float32(255)
        return near, to_linear(display) / self._exposure

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
        # the mean of several neighbours: a single one may lie along the hull, not across it
        apart, nearest = cKDTree(inside).query(at[:, :2], k=[1, 2, 3, 4, 5, 6], distance_upper_bound=HULL)
        found = np.isfinite(apart)
        hull = found[:, 0]
        neighbours = np.vstack([inside, [0.0, 0.0]])[nearest[hull]].sum(axis=1) / found[hull].sum(axis=1)[:, None]
        outwards = at[hull, :2] - neighbours
        away = np.linalg.norm(outwards, axis=1)
        looks = np.einsum("ni,ni->n", facing[hull, :2], outwards) > 0.2 * away
        outside = near.copy()
        outside[rows[hull], cols[hull]] = looks
        return outside


def _length(vectors: Array) -> Array:
    """Lengths (m,) of ``vectors`` (k, m)."""
    return np.asarray(np.sqrt((vectors**2).sum(axis=0)))


def distance_of(depth: NDArray[np.floating], clip: tuple[float, float]) -> Array:
    """Metres along the view; inf: background. ``depth``: 1 at the near plane of ``clip``, 0 at the far one."""
    near, far = clip
    share = depth.astype(float)
    return np.where(share > 0, near * far / np.maximum(share * (far - near) + near, 1e-12), np.inf)


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
    h, w = depth.shape
    x = (np.arange(w)[part[1]] + 0.5) / w * 2 - 1
    y = (np.arange(h)[part[0]] + 0.5) / h * 2 - 1
    distance = distance_of(depth[part], clip)
    side = np.cross(forward, up)
    across, above = (shift[0] + half[0] * x[:, None]) * side + forward, (shift[1] + half[1] * y[:, None]) * up
    places = across[None] + above[:, None]
    places *= np.where(np.isfinite(distance), distance, 0.0)[..., None]
    places += eye
    return places, distance
