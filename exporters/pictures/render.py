"""Draw a stage with MuJoCo's renderer over EGL: one rigid body per moving group, the camera exactly as in USD.

This module makes the MuJoCo model of a stage and a frame's picture. `stage.py` reads the stage, `shading.py` determines
the look, `frames.py` and `film.py` write files.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.pictures import lamps
from vehsim.exporters.pictures.canvas import CASTING, OPAQUE, TRANSLUCENT, Canvas, Picture
from vehsim.exporters.pictures.contact_shade import Shades
from vehsim.exporters.pictures.grain import grained, is_ground, strengths_of
from vehsim.exporters.pictures.motion_passes import Pixels, drop_flow, drops_seen
from vehsim.exporters.pictures.passes import prim_colours
from vehsim.exporters.pictures.spray import draw_spray
from vehsim.exporters.pictures.water import ON_WATER, WaterView, distance_of, places_of
from vehsim.exporters.usd.scenery.lighting import to_linear
from vehsim.exporters.usd.scenery.shading import author_material, author_skybox, light_for, mean_of
from vehsim.exporters.usd.stage import Shape, StageReader

Array = NDArray[np.float64]
Depth = NDArray[np.float32]
Geoms = NDArray[np.int64]

SHADOW_MAP = 4096
SHADOW_REACH = (5.0, 115.0)
"""Half the width of what the shadow map covers, m, minimum and maximum; it moves with the camera."""
SHADOW_DEPTH, GRAZING = (400.0, 4_000.0), 700.0
"""Far plane in units of the shadow map's reach, minimum and maximum, and per tangent of the angle of light on standing
things. MuJoCo biases shadows by four steps of the depth range, at most by 1.5 texels: less, and slopes under grazing
light cast jagged shadows on themselves; more, and vehicles seem to float, and rounding specks far ground."""
INSTANTS = 241
"""Number of instants at which it is found where casters are during a shot: paths between them must hardly bulge."""
SUPERSAMPLE = 4
"""Largest number of drawn pixels per delivered pixel, along each side; 2 for the usual four samples. Supersampling
smooths shadow edges and texture, which multisampling cannot."""
LARGEST = 16_000
"""Longest side of an off-screen buffer, px; 16384 is refused."""
HAZE = (10.0, 760.0)
"""Distances at which haze starts and at which it hides everything, m."""
CLEAR = 4.0
"""Haze hides everything no nearer than this many times the usual distance of the cameras from the movers."""


class StageRenderer:
    """Renders frames of a stage as 8-bit RGB. A context manager: it holds an OpenGL context.

    ``size`` (width, height) px. With ``shadows`` and more than one of ``samples`` per pixel, near ground has grain, and
    vehicles shade it. Raises ``ExportError`` if there is no EGL.
    """

    def __init__(self, stage: StageReader, size: tuple[int, int], shadows: bool = True, samples: int = 4) -> None:
        os.environ.setdefault("MUJOCO_GL", "egl")
        import mujoco

        self.stage, self.size = stage, size
        self._shadows, self._detailed = shadows, shadows and samples > 1
        grounded = stage.water is None and any(not shape.group for shape in stage.shapes)
        self._light = light_for(stage.sun(), stage.sky(), grounded)
        self._water = None if stage.water is None else WaterView(stage, self._light, shadows, size[0])
        self._bounds = bounds_of(stage)
        self._shadow_axes = _across(self._light.direction)
        self._casters = spans_of_casters(stage, self._shadow_axes)
        towards = (self._light.direction,) * 2
        self._sunwards = float(spans_of_casters(stage, towards).min()) - 1.0
        self._reaches = {name: shadow_reach(stage, self._casters, [name]) for name in stage.cameras}
        self._reach = shadow_reach(stage, self._casters)
        self._shadow_depth = shadow_depth(stage, self._light.direction)
        self._haze_end = haze_end(stage)
        self._shades = Shades(stage)
        self._lamps = lamps.lamps_of(stage, self._light)
        self._supersample = max(1, min(SUPERSAMPLE, round(samples**0.5), LARGEST // max(size)))
        self._size = width, height = self._supersample * size[0], self._supersample * size[1]
        beam = lamps.PIXELS if self._lamps else (0, 0)  # what is read from beyond the buffer is undefined
        self._model = self._spec(max(width, beam[0]), max(height, beam[1])).compile()
        self._data = mujoco.MjData(self._model)
        grain = {f"shape{k}": strength for k, strength in enumerate(strengths_of(stage.shapes))}
        geoms = [self._model.geom(k).name for k in range(self._model.ngeom)]
        self._grain = np.array([*(grain.get(name, 0.0) for name in geoms), 0.0], np.float32)  # the last: no geom
        ground = {f"shape{k}" for k, shape in enumerate(stage.shapes) if is_ground(shape)}
        self._ground = np.array([*(name in ground for name in geoms), False])
        ground_colours = (mean_of(shape.surface) for shape in stage.shapes if is_ground(shape))
        self._albedo = to_linear(next(ground_colours, np.zeros(3)))
        self._mocap = {
            group: self._model.body_mocapid[self._model.body(f"group{k}").id] for k, group in enumerate(stage.groups)
        }
        self._canvas = Canvas(self._model, width, height, self._below(), self._light.stars)

    def __enter__(self) -> StageRenderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the OpenGL context."""
        self._canvas.close()

    def render(self, camera: str, frame: float) -> Picture:
        """The picture (height, width, 3) of ``camera`` at a time code."""
        from PIL import Image

        self._pose(camera, frame)
        self._place_lights()
        canvas, side = self._canvas, self._supersample
        if self._water is not None:
            canvas.draw_water(self._water, self._data, frame, self.size[1])
        marks = self.stage.tyre_marks_at(frame)
        colour = canvas.picture(self._size, self._shadows, marks, self._albedo, (HAZE[0], self._haze_end))
        if side == 1 and not self._detailed and self._water is None:
            return np.ascontiguousarray(colour[::-1])
        depth = canvas.depth(self._size)
        if self._water is not None:
            colour = self._wet(colour, depth, camera, frame)
        picture = np.asarray(Image.fromarray(colour[::-1]).reduce(side))
        return self._finished(picture, depth, camera, frame)

    def passes(self, camera: str, frame: float, kinds: Sequence[str]) -> dict[str, NDArray[Any]]:
        """The passes ``kinds`` of a picture: "depth" (height, width) m along the view, 0 for the background;
        "segmentation", the prims' colours (height, width, 3); "flow" (height, width, 4 or 8) and "normals" (height,
        width, 3) of `motion_passes`.

        Translucent surfaces have flow only, in channels of their own. Prims are those of `prims`, coloured by
        `passes.prim_colours`.
        """
        self._pose(camera, frame)
        if self._water is not None:
            self._canvas.draw_water(self._water, self._data, frame, self.size[1])
        of_geom, depth = self._canvas.draw_ids(self.size)[::-1], self._canvas.depth(self.size)[::-1]
        view = self.stage.camera(camera, frame)
        near, far = self._drawn(view.clip)
        away = near * far / (depth * (far - near) + near)
        colours = np.vstack([prim_colours(self.prims), np.zeros((1, 3), np.uint8)])  # the last one, -1: background
        drawings: dict[str, NDArray[Any]] = {
            "depth": np.where(of_geom < 0, 0.0, away).astype(np.float32),
            "segmentation": colours[of_geom],
        }
        if {"flow", "normals"} & {*kinds}:
            names = [self._model.geom(k).name for k in range(self._model.ngeom)]
            of_shape = np.array([*(int(n.removeprefix("shape")) if n != "water" else -2 for n in names), -1])
            pixels = Pixels(self.stage, camera, frame, of_shape[of_geom], away.astype(float))
            drawings["normals"] = pixels.normals
            first, last = self.stage.frames
            beside = [min(max(frame + step, first), last) for step in (1, -1)] if "flow" in kinds else []
            flows = [pixels.flow(at) for at in beside]
            flows += self._translucent(camera, frame, of_shape, away.astype(float), beside)
            drawings["flow"] = np.concatenate(flows, axis=-1) if flows else pixels.normals
        return {kind: drawings[kind] for kind in kinds}

    def _translucent(
        self, camera: str, frame: float, of_shape: NDArray[np.int64], away: Array, beside: Sequence[float]
    ) -> list[Array]:
        """Flow (h, w, 2) to each of the time codes ``beside`` of what is translucent in front of opaque things that are
        ``away`` (h, w) m, and of spray in front of that; NaN elsewhere. None if the stage has neither."""
        glass = (self._model.geom_group != OPAQUE).any()
        if not beside or not (glass or self.stage.spray):
            return []
        shown, front = np.full(away.shape, -1), away.copy()
        if glass:
            of_geom, depth = self._canvas.draw_ids(self.size, True)[::-1], self._canvas.depth(self.size)[::-1]
            distance = distance_of(depth, self._drawn(self.stage.camera(camera, frame).clip))
            seen = (of_geom >= 0) & (distance < away)
            shown, front = np.where(seen, of_shape[of_geom], -1), np.where(seen, distance, away).astype(float)
        pixels = Pixels(self.stage, camera, frame, shown, front)
        drops = drops_seen(self.stage, camera, frame, front) if self.stage.spray else np.full(away.shape, -1)
        found = []
        for at in beside:
            flow = np.where((shown >= 0)[..., None], pixels.flow(at), np.nan)
            if self.stage.spray:
                flow = np.where((drops >= 0)[..., None], drop_flow(self.stage, camera, frame, at, drops), flow)
            found.append(flow)
        return found

    @property
    def prims(self) -> list[str]:
        """The paths of the drawn prims, in the order of the model's geoms."""
        names = {f"shape{k}": shape.name for k, shape in enumerate(self.stage.shapes)} | {"water": self.stage.water}
        return [str(names[self._model.geom(k).name]) for k in range(self._model.ngeom)]

    def _pose(self, camera: str, frame: float) -> None:
        """Set all moving groups, and the camera, to a time code."""
        import mujoco

        for group, T_wg in self.stage.matrices(frame).items():
            place = self._mocap[group]
            self._data.mocap_pos[place] = T_wg[:3, 3]
            mujoco.mju_mat2Quat(self._data.mocap_quat[place], T_wg[:3, :3].ravel())
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._canvas.update(self._data)
        self._reach = self._canvas.shadow_reach = self._reaches[camera]
        self._place_camera(camera, frame)

    def _drawn(self, clip: tuple[float, float]) -> tuple[float, float]:
        """Near and far plane for drawing, m, if the stage requests ``clip``."""
        return clip[0], max(clip[1], self._reach * self._shadow_depth)

    def _place_camera(self, name: str, frame: float) -> None:
        pose, half_width, shift, clip = self.stage.camera(name, frame)
        near, far = self._drawn(clip)
        half_height = half_width * self.size[1] / self.size[0]  # pixels are square
        for camera in self._canvas.cameras:
            camera.pos = pose[:3, 3]
            camera.forward = -pose[:3, 2]
            camera.up = pose[:3, 1]
            camera.orthographic = 0
            camera.frustum_near, camera.frustum_far = near, far
            camera.frustum_center = shift[0] * near
            camera.frustum_width = half_width * near
            camera.frustum_bottom = (shift[1] - half_height) * near
            camera.frustum_top = (shift[1] + half_height) * near

    def _wet(self, colour: Picture, depth: NDArray[np.float32], camera: str, frame: float) -> Picture:
        """Dark lines on hulls, piles and rocks at the waterline."""
        assert self._water is not None
        standing = (depth > 0) & (self._canvas.draw_ids(self._size) != self._model.geom("water").id)
        left, low, right, high = _box(standing, 1)
        part = slice(low, high + 1), slice(left, right + 1)  # one more pixel: slopes need the next one
        places, distance = self._places(depth, camera, frame, part)
        colour[part] = self._water.wet(colour[part], places, np.where(standing[part], distance, np.inf))
        return colour

    def _finished(self, picture: Picture, depth: NDArray[np.float32], camera: str, frame: float) -> Picture:
        """The picture with the shade below vehicles, and with spray in front of what was drawn with ``depth``."""
        side = self._supersample
        depth = depth[side // 2 :: side, side // 2 :: side]
        if self._detailed:
            samples = self._canvas.draw_ids(self._size)
            of_geom = samples[side // 2 :: side, side // 2 :: side]
            ground = self._ground[samples].reshape(len(of_geom), side, -1, side).mean(axis=(1, 3))
            picture = self._grainy(picture, depth, of_geom, camera, frame)
            picture = self._shaded(picture, depth, of_geom, ground, camera, frame)
        if self._lamps:
            picture = self._lamplit(picture, depth, camera, frame)
        if self.stage.spray is None or self._water is None:
            return picture
        view, half, shift, clip = self._sight(camera, frame)
        distance = distance_of(depth, clip)
        drops, seconds = self.stage.spray_at(frame), 1 / float(self.stage.fps)
        return draw_spray(picture, distance[::-1], drops, view, half, shift, seconds, self._water.foam_colour)

    def _grainy(self, picture: Picture, depth: Depth, of_geom: Geoms, camera: str, frame: float) -> Picture:
        """The picture with grain on the ground near the camera."""
        if not self._grain.any():
            return picture
        (eye, forward, up), half, shift, clip = self._sight(camera, frame)
        width, height = self.size
        x, y = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (width, height))
        rays = (
            forward,
            (shift[0] + half[0] * x[:, None]) * np.cross(forward, up),
            (shift[1] + half[1] * y[:, None]) * up,
        )
        return grained(picture[::-1], self._grain[of_geom], distance_of(depth, clip), rays, eye)[::-1]

    def _shaded(
        self, picture: Picture, depth: Depth, of_geom: Geoms, ground: Array, camera: str, frame: float
    ) -> Picture:
        """The picture, darker where vehicles and obstacles hide the sky from the ground, less so in haze; ``ground``
        (h, w): the share of each pixel that shows it."""
        from scipy.ndimage import grey_dilation

        picture = picture[::-1].copy()  # bottom row first, as the depth
        strength = np.ones(picture.shape[:2])
        if self._water is not None:
            strength[of_geom == self._model.geom("water").id] = ON_WATER
        poses = self.stage.matrices(frame)
        for body in self._shades.bodies:
            shade, T_wr = self._shades[body], self._shades.frame(body, poses)
            part = shade and self._part(shade.corners @ T_wr[:3, :3].T + T_wr[:3, 3], camera, frame)
            if shade is None or part is None:
                continue
            places, distance = self._places(depth, camera, frame, part)
            clear = (self._haze_end - distance) / (self._haze_end - HAZE[0])
            lost = strength[part] * shade.at((places - T_wr[:3, 3]) @ T_wr[:3, :3]) * np.clip(clear, 0, 1)
            lost *= np.clip(2 * T_wr[2, 2] - 1, 0, 1)  # the ground is not below a vehicle that lies on its side
            if body in self._shades.standing:
                lost *= ground[part]
            else:
                lost = np.maximum(lost, grey_dilation(lost, 3) / 2)  # pixels that show ground and vehicle
            picture[part] = (picture[part] * (1 - lost[..., None])).round()
        return picture[::-1]

    def _lamplit(self, picture: Picture, depth: Depth, camera: str, frame: float) -> Picture:
        """The picture with the light of lamps."""
        places, distance = self._places(depth, camera, frame, (slice(None), slice(None)))
        places[~np.isfinite(distance)] = 1e6
        poses = self.stage.matrices(frame)

        def depth_from(eye: Array, forward: Array, up: Array) -> Array:
            return self._canvas.depth_from(eye, forward, up, lamps.VIEW, lamps.CLEAR, lamps.PIXELS)

        def part_of(corners: Array) -> tuple[slice, slice] | None:
            return self._part(corners, camera, frame)

        picture = lamps.lit(picture[::-1], places, self._lamps, poses, self._light, part_of, depth_from)
        return lamps.haloed(picture, distance, self._lamps, poses, self._sight(camera, frame))[::-1]

    def _part(self, corners: Array, camera: str, frame: float) -> tuple[slice, slice] | None:
        """Rows (from the bottom) and columns of the picture that a box (8, 3) m may cover; None if it is not seen."""
        (eye, forward, up), half, shift, _ = self._sight(camera, frame)
        away = corners - eye
        depth = away @ forward
        if depth.max() <= 0:
            return None
        if depth.min() <= 0:  # the camera may be inside
            return slice(None), slice(None)
        ends = []
        for axis, k in ((up, 1), (np.cross(forward, up), 0)):
            share = ((away @ axis / depth - shift[k]) / half[k] + 1) / 2 * self.size[k]
            ends.append((max(0, int(share.min())), min(self.size[k], int(share.max()) + 1)))
        if any(first >= last for first, last in ends):
            return None
        return slice(*ends[0]), slice(*ends[1])

    def _places(
        self,
        depth: NDArray[np.float32],
        camera: str,
        frame: float,
        part: tuple[slice, slice],
    ) -> tuple[Array, Array]:
        """`places_of` the pixels of a drawing with ``depth`` from a camera."""
        (eye, forward, up), half, shift, clip = self._sight(camera, frame)
        return places_of(depth, eye, forward, up, half, clip, part, shift)

    def _sight(
        self, camera: str, frame: float
    ) -> tuple[tuple[Array, Array, Array], tuple[float, float], tuple[float, float], tuple[float, float]]:
        """A camera's eye, forward and up (3,); half its view at distance 1, its shift, and the drawn (near, far) m."""
        pose, half_width, shift, clip = self.stage.camera(camera, frame)
        half = (half_width, half_width * self.size[1] / self.size[0])
        return (pose[:3, 3], -pose[:3, 2], pose[:3, 1]), half, shift, self._drawn(clip)

    def _below(self) -> Array:
        """The displayed colour (3,) of the water or of level ground, partly in shade."""
        if self._water is not None:
            return self._water.colour
        light = self._light
        lit = light.ambient + light.sky - 0.5 * light.sun * min(light.direction[2], 0.0)
        return next((mean_of(shape.surface) * lit for shape in self.stage.shapes if is_ground(shape)), 0.3 * lit)

    def _place_lights(self) -> None:
        """Place the sun's shadow map over the camera's view and what casts shadows there, aligned to whole texels so
        that shadow edges do not flicker."""
        scene = self._canvas.scene
        eye = scene.camera[0]
        lower, upper = self._bounds
        centre = np.clip(eye.pos + 0.6 * self._reach * eye.forward, lower, upper)
        direction, texel = self._light.direction, 2 * self._reach / SHADOW_MAP
        inner = self._casters + np.array([[self._reach], [-self._reach]])
        inner = np.where(inner[0] > inner[1], self._casters.mean(axis=0), inner)
        places = np.clip(np.array(self._shadow_axes) @ centre, *inner)
        across = np.round(places / texel) * texel @ np.array(self._shadow_axes)
        # as close as casters permit: far away, rounding would cast specks of shadow
        scene.lights[SUN].pos = across + min(self._sunwards, centre @ direction - 1.0) * direction
        scene.lights[SUN].dir = direction

    def _spec(self, width: int, height: int) -> Any:
        import mujoco

        spec = mujoco.MjSpec()
        light, vis = self._light, spec.visual
        vis.global_.offwidth, vis.global_.offheight = width, height
        vis.quality.shadowsize, vis.quality.offsamples = SHADOW_MAP, 0
        lower, upper = self._bounds
        extent = max(float(np.linalg.norm((upper - lower)[:2])), 1.0)
        spec.stat.extent, spec.stat.center = extent, ((lower + upper) / 2).tolist()
        vis.map.shadowclip = self._reach / extent
        vis.map.fogstart, vis.map.fogend = HAZE[0] / extent, self._haze_end / extent
        vis.rgba.fog = [*light.haze.tolist(), 1.0]
        vis.headlight.ambient = light.ambient.tolist()
        vis.headlight.diffuse = vis.headlight.specular = [0.0, 0.0, 0.0]
        directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        for name, direction, colour, cast in (
            ("sun", light.direction, light.sun, True),
            ("sky", (0.0, 0.0, -1.0), light.sky, False),
            ("bounce", (0.0, 0.0, 1.0), light.bounce, False),
        ):
            body = spec.worldbody
            body.add_light(
                name=name,
                type=directional,
                dir=list(direction),
                diffuse=list(colour),
                specular=list(colour) if cast else [0, 0, 0],
                castshadow=cast and self._shadows and light.sharp,
            )
        author_skybox(spec, light.skybox)
        if self._water is not None:
            self._water.author(spec)
        bodies = {"": spec.worldbody}
        for k, group in enumerate(self.stage.groups):
            bodies[group] = spec.worldbody.add_body(name=f"group{k}", mocap=True)
        textures: dict[Any, str] = {}
        materials: dict[Any, str] = {}
        casters = {shape.name for shape in _casting(self.stage)}
        for k, shape in enumerate(self.stage.shapes):
            if shape.surface not in materials:
                materials[shape.surface] = f"material{len(materials)}"
                author_material(spec, materials[shape.surface], shape.surface, textures)
            _author_mesh(spec, f"shape{k}", shape)
            casting = self._shadows and shape.name in casters
            bodies[shape.group].add_geom(
                name=f"shape{k}",
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=f"shape{k}",
                material=materials[shape.surface],
                group=OPAQUE if shape.surface.opacity == 1 else CASTING if casting else TRANSLUCENT,
                contype=0,
                conaffinity=0,
                mass=0.0,
                castshadow=casting,
            )
        return spec


SUN = 1
"""Index of the sun among the scene's lights, after the headlight."""


def _author_mesh(spec: Any, name: str, shape: Shape) -> None:
    """A MuJoCo mesh with the stage's own normals and texture coordinates; open two-sided shapes get a back."""
    import mujoco

    points, faces = shape.points, shape.faces
    normals, face_normals, face_uvs = shape.normals, shape.face_normals, shape.face_uvs
    if not shape.closed and shape.surface.opacity == 1:  # MuJoCo draws both sides of translucent geoms
        face_normals = np.concatenate([face_normals, face_normals[:, ::-1] + len(normals)])
        normals = np.concatenate([normals, -normals])
        faces = np.concatenate([faces, faces[:, ::-1]])
        face_uvs = None if face_uvs is None else np.concatenate([face_uvs, face_uvs[:, ::-1]])
    # one vertex per normal at a point: MuJoCo 4.0 does not read userfacenormal
    used, faces = np.unique(np.stack([faces, face_normals], axis=-1).reshape(-1, 2), axis=0, return_inverse=True)
    points, normals = points[used[:, 0]], normals[used[:, 1]]
    if len(points) < 4:  # MuJoCo requires at least four vertices
        points, normals = (
            np.concatenate([each, np.repeat(each[:1], 4 - len(each), axis=0)]) for each in (points, normals)
        )
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = points.astype(np.float32).ravel()
    mesh.userface = faces.astype(np.int32).ravel()
    mesh.usernormal = normals.astype(np.float32).ravel()
    if shape.uvs is not None and face_uvs is not None:
        mesh.usertexcoord = shape.uvs.astype(np.float32).ravel()
        mesh.userfacetexcoord = face_uvs.astype(np.int32).ravel()


def _box(mask: NDArray[np.bool_], side: int) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the true pixels, on multiples of ``side``."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    low = [int(places[0]) // side * side if len(places) else 0 for places in (columns, rows)]
    high = [-(-(int(places[-1]) + 1) // side) * side if len(places) else side for places in (columns, rows)]
    return low[0], low[1], high[0], high[1]


def _casting(stage: StageReader) -> list[Shape]:
    """The shapes that cast shadows: no blurred rotor, and no level ground with nothing below it but the feet of
    obstacles."""
    ground = [float(shape.points[:, 2].min()) for shape in stage.shapes if is_ground(shape)]
    lowest = min(ground, default=-np.inf) + 1e-3
    level = [is_ground(shape) and float(shape.points[:, 2].max()) < lowest for shape in stage.shapes]
    return [
        shape
        for shape, is_level in zip(stage.shapes, level, strict=True)
        if shape.surface.opacity > 0.5 and not is_level
    ]


def bounds_of(stage: StageReader) -> tuple[Array, Array]:
    """The box (lower, upper) (3,) m of all standing shapes, or of the movers at the start."""
    poses = {"": np.eye(4), **stage.matrices(stage.frames[0])}
    still = [shape for shape in stage.shapes if not shape.group] or list(stage.shapes)
    if not still:
        return np.full(3, -10.0), np.full(3, 10.0)
    corners = []
    for shape in still:
        pose = poses[shape.group]
        points = shape.points @ pose[:3, :3].T + pose[:3, 3]
        corners += [points.min(axis=0), points.max(axis=0)]
    return np.min(corners, axis=0), np.max(corners, axis=0)


def haze_end(stage: StageReader) -> float:
    """Distance at which haze hides everything, m: before the ground's edge; in empty space there is no edge to hide.

    It ends no nearer than `CLEAR` times the usual distance of the cameras from the movers: distant shots stay clear.
    """
    ground = [shape for shape in stage.shapes if is_ground(shape)]
    if stage.water is not None or not ground:
        return HAZE[1]
    points = np.concatenate([shape.points[:, :2] for shape in ground])
    edge = 0.6 * float(np.ptp(points, axis=0).min())
    return max(min(HAZE[1], max(edge, 60.0)), CLEAR * (_usual_distance(stage, stage.cameras) or 0.0))


def _across(direction: Array) -> tuple[Array, Array]:
    """The right and the up (3,) of MuJoCo's shadow map for light along a unit ``direction``."""
    up = np.cross(direction, (-1.0, 0.0, 0.0) if np.hypot(*direction[1:]) > 0.1 else (0.0, 1.0, 0.0))
    up /= np.linalg.norm(up)
    return np.cross(direction, up), up


def spans_of_casters(stage: StageReader, axes: tuple[Array, Array]) -> Array:
    """From where to where (2, 2) along each of two ``axes`` something casts shadows during the shot, m."""
    across = np.array(axes)
    casting = _casting(stage)
    sizes: dict[str, float] = {}  # of what moves, around its own origin
    spans = [np.zeros((0, 2))]
    for shape in casting:
        if shape.group:
            sizes[shape.group] = max(sizes.get(shape.group, 0.0), float(np.linalg.norm(shape.points, axis=1).max()))
        else:
            spans.append(shape.points @ across.T)
    for frame in np.linspace(stage.frames[0], stage.frames[1], INSTANTS) if sizes else ():
        poses = stage.matrices(frame)
        for group, size in sizes.items():
            place = across @ poses[group][:3, 3]
            spans.append(np.array([place - size, place + size]))
    every = np.concatenate(spans)
    return np.array([every.min(axis=0), every.max(axis=0)]) if len(every) else np.zeros((2, 2))


def shadow_reach(stage: StageReader, casters: Array, cameras: Collection[str] | None = None) -> float:
    """Half the width of the shadow map, m: that of all ``casters`` (2, 2), see `spans_of_casters`, but no more than
    four times the usual distance of what the ``cameras`` show, by default all."""
    whole = float((casters[1] - casters[0]).max()) / 2 + 1.0
    usual = _usual_distance(stage, stage.cameras if cameras is None else cameras)
    return float(np.clip(whole if usual is None else min(4.0 * usual, whole), *SHADOW_REACH))


def shadow_depth(stage: StageReader, direction: Array) -> float:
    """The far plane, in units of the shadow map's reach, for light along a unit ``direction`` (3,): of the standing
    faces that it falls on, all but a twentieth by area have no larger tangent of its angle to their normals."""
    normals = [np.zeros((0, 3))]
    for shape in stage.shapes:
        if not shape.group:
            a, b, c = shape.points[shape.faces].swapaxes(0, 1)
            normals.append(np.cross(b - a, c - a) / 2)
    every = np.vstack(normals)
    areas, towards = np.linalg.norm(every, axis=1), -every @ direction
    lit = towards > 1e-3 * areas
    if not lit.any():
        return SHADOW_DEPTH[1]
    areas, towards = areas[lit], towards[lit]
    tangents = np.sqrt(np.maximum(areas**2 - towards**2, 0.0)) / towards
    order = np.argsort(tangents)
    share = np.cumsum(areas[order]) / areas.sum()
    return float(np.clip(GRAZING * tangents[order][np.searchsorted(share, 0.95)], *SHADOW_DEPTH))


def _usual_distance(stage: StageReader, cameras: Collection[str]) -> float | None:
    """The median distance of ``cameras`` from the nearest mover or vehicle, m; None without these or cameras."""
    distances = []
    for frame in np.linspace(stage.frames[0], stage.frames[1], 5):
        places = [pose[:3, 3] for pose in stage.matrices(frame).values()] + stage.vehicles(frame)
        eyes = [stage.camera(name, frame).T_wc[:3, 3] for name in cameras]
        distances += [min(np.linalg.norm(place - eye) for place in places) for eye in eyes if places]
    return float(np.median(distances)) if distances else None
