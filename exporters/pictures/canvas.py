"""An off-screen OpenGL context with MuJoCo's renderer: from scenes to colour, depth and geoms per pixel.

This module draws; `render.py` decides what to draw, and from where.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import ExportError
from vehsim.exporters.pictures.backdrop import Backdrop
from vehsim.exporters.pictures.gloss import Gloss
from vehsim.exporters.pictures.tyre_marks import draw_tyre_marks
from vehsim.exporters.pictures.water import WaterView, distance_of
from vehsim.exporters.usd.scenery.shading import Stars
from vehsim.exporters.usd.stage import Ribbon

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

WITHOUT = "or deliver no pictures, such as --to usd,npz,html"
NO_OPENGL = {
    "linux": (
        "no off-screen OpenGL (EGL)",
        "install libegl1 and libgl1-mesa-dri (Debian, Ubuntu), mesa-libEGL and mesa-dri-drivers (Fedora), or a GPU "
        "driver with EGL",
    ),
    "darwin": ("no OpenGL", f"run it as the user who is logged in at the screen, {WITHOUT}"),
    "win32": ("no OpenGL", f"run it in a desktop session with the driver of a GPU, {WITHOUT}"),
}
"""By `sys.platform`, what is missing where MuJoCo cannot draw, and the remedy."""
FRUSTUM = [f"frustum_{part}" for part in ("near", "far", "center", "width", "bottom", "top")]
STAR_POINTS = 900
"""Width of a picture in the points of which a star has one."""
OPAQUE, TRANSLUCENT, CASTING = 0, 1, 2
"""Geom groups; translucent geoms that cast shadows are ``CASTING``."""


def _without_opengl(error: Exception) -> ExportError:
    missing, remedy = NO_OPENGL.get(sys.platform, NO_OPENGL["linux"])
    return ExportError(f"{missing}: {_first_line(error)}", remedy)


def _measure_haze_ahead() -> None:
    """Make the signed depth decide on haze in MuJoCo's context, which is current, where Mesa draws.

    OpenGL takes the absolute depth at each vertex: a corner of a face far behind the camera would count as far ahead,
    and bring haze to the camera on ground of kilometres. Of other drivers, the sign of the depth was not measured.
    """
    from OpenGL import GL
    from OpenGL.GL.NV import fog_distance

    if b"Mesa" in GL.glGetString(GL.GL_VERSION) and fog_distance.glInitFogDistanceNV():
        GL.glFogi(fog_distance.GL_FOG_DISTANCE_MODE_NV, GL.GL_EYE_PLANE)
        for end in (GL.GL_FOG_START, GL.GL_FOG_END):  # a depth ahead is negative
            GL.glFogf(end, -float(GL.glGetFloatv(end)))


class Canvas:
    """An off-screen OpenGL context with MuJoCo's renderer and one scene; ``ground`` (3,): the displayed colour that
    smooth things mirror from below; ``stars`` of the sky. Raises ``ExportError`` without EGL."""

    def __init__(self, model: Any, width: int, height: int, ground: Array, stars: Stars) -> None:
        import mujoco

        try:
            self._gl: Any = mujoco.GLContext(width, height)
            self._gl.make_current()
        except Exception as error:  # MuJoCo and PyOpenGL may raise anything
            raise _without_opengl(error) from error
        try:
            self._context: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:
            self._gl.free()
            if "valid OpenGL context" in str(error):  # GLFW, of Windows, only warns that it has none
                raise _without_opengl(error) from error
            message = f"OpenGL cannot draw {width} x {height} px off-screen here ({_first_line(error)})"
            raise ExportError(message, "ask for a smaller render.size or fewer render.samples") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        _measure_haze_ahead()
        self._model = model
        self._backdrop = Backdrop(model, self._context, stars)
        self._gloss = Gloss(model, self._context, self._backdrop.sky, ground)
        self._casting = (model.geom_group == CASTING).any()
        self.scene, self.glass, self.solid = (mujoco.MjvScene(model, model.ngeom + 100) for _ in range(3))
        self._shown = [
            (self.scene, _option(OPAQUE, CASTING)),  # what casts shadows; unseen if it is translucent
            (self.glass, _option(TRANSLUCENT, CASTING)),
            (self.solid, _option(OPAQUE)),
        ]

    @property
    def cameras(self) -> Iterator[Any]:
        """The cameras of all scenes; each has two eyes, drawn as their mean."""
        for scene in (self.scene, self.glass, self.solid):
            yield from scene.camera

    @property
    def shadow_reach(self) -> float:
        """Half the width of what the shadow map covers, m."""
        return float(self._context.shadowClip)

    @shadow_reach.setter
    def shadow_reach(self, reach: float) -> None:
        self._context.shadowClip = reach

    def update(self, data: Any) -> None:
        """Take geoms and lights from ``data``."""
        import mujoco

        everything, free = mujoco.mjtCatBit.mjCAT_ALL, mujoco.MjvCamera()
        for scene, option in self._shown:
            mujoco.mjv_updateScene(self._model, data, option, None, free, everything, scene)
        for geom in self.scene.geoms[: self.scene.ngeom] if self._casting else ():
            if geom.rgba[3] < 1:
                geom.rgba[3] = 0

    def draw_water(self, water: WaterView, data: Any, frame: float, height: int) -> None:
        """Update the water to a frame, as seen by the camera in a picture of ``height`` px."""
        self._gl.make_current()
        water.draw(self._model, data, self._context, frame, self.scene.camera[0], height, self._mirrored)

    def picture(
        self, size: tuple[int, int], shadows: bool, marks: Sequence[Ribbon], albedo: Array, haze: tuple[float, float]
    ) -> Picture:
        """Colour (h, w, 3) of everything in haze, with the sky behind it, from the bottom row up; ``size`` (w, h);
        tyre ``marks`` on ground with an ``albedo`` (3,), linear; ``haze``: where it begins and ends, m."""
        self._draw(self.scene, size, SHADOW=shadows, FOG=True)
        self._backdrop.draw_sky(self.scene.camera[0], max(round(size[0] / STAR_POINTS), 1))
        draw_tyre_marks(marks, np.asarray(self.scene.camera[0].pos, float), haze, albedo)
        self._backdrop.draw_glass(self.glass)
        geoms = [*self.scene.geoms[: self.scene.ngeom], *self.glass.geoms[: self.glass.ngeom]]
        self._gloss.draw(geoms, self.scene.camera[0], size, haze)
        return self._colour(size)

    def _mirrored(self, level: float, size: tuple[int, int]) -> tuple[Picture, NDArray[np.bool_]]:
        """What the camera would see in a mirror at a ``level`` m: colour (h, w, 3) of solid things above it, and where
        (h, w) there are any, from the bottom row up; ``size`` (w, h) px."""
        from OpenGL import GL

        seen, water = self.scene.camera[0], self._model.geom("water").id
        eye, forward, up = (np.array(each, float) for each in (seen.pos, seen.forward, seen.up))
        eye[2], forward[2], up[:2] = 2 * level - eye[2], -forward[2], -up[:2]  # its picture is upside down
        for geom in self.solid.geoms[: self.solid.ngeom]:
            if geom.objid == water:
                geom.rgba[3] = 0
        axes = np.cross(forward, up), up, -forward
        GL.glLoadIdentity()
        GL.glClipPlane(GL.GL_CLIP_PLANE1, [*(float(axis[2]) for axis in axes), float(eye[2]) - level])
        GL.glEnable(GL.GL_CLIP_PLANE1)
        with self._elsewhere() as cameras:
            for camera in cameras:
                camera.pos, camera.forward, camera.up = eye, forward, up
                camera.frustum_bottom, camera.frustum_top = -seen.frustum_top, -seen.frustum_bottom
            self._draw(self.solid, size)
        GL.glDisable(GL.GL_CLIP_PLANE1)
        picture, depth = self._colour(size)[::-1], self.depth(size)[::-1]
        for geom in self.solid.geoms[: self.solid.ngeom]:
            if geom.objid == water:
                geom.rgba[3] = 1
        return picture, depth > 0

    def _draw(self, scene: Any, size: tuple[int, int], **flags: bool) -> None:
        """``size`` (w, h) px, within the context's; ``flags``: those of the renderer (SHADOW, FOG, ...); others are
        off."""
        import mujoco

        for k, name in enumerate(mujoco.mjtRndFlag.__members__):
            if k < len(scene.flags):
                scene.flags[k] = flags.get(name.removeprefix("mjRND_"), name == "mjRND_CULL_FACE")
        self._gl.make_current()
        mujoco.mjr_render(mujoco.MjrRect(0, 0, *size), scene, self._context)

    def _colour(self, size: tuple[int, int]) -> Picture:
        import mujoco

        colour = np.empty((*size[::-1], 3), np.uint8)
        mujoco.mjr_readPixels(colour, None, mujoco.MjrRect(0, 0, *size), self._context)
        return colour

    def depth(self, size: tuple[int, int]) -> NDArray[np.float32]:
        """Depth of the last drawing (h, w), 0 where there is nothing opaque, from the bottom row up."""
        import mujoco

        depth = np.empty(size[::-1], np.float32)
        mujoco.mjr_readPixels(None, depth, mujoco.MjrRect(0, 0, *size), self._context)
        return depth

    def depth_from(
        self, eye: Array, forward: Array, up: Array, half: tuple[float, float], near: float, size: tuple[int, int]
    ) -> NDArray[np.float64]:
        """The depth (h, w) m of solid things from another place, from the bottom row up; ``half``: width and height of
        the view at distance 1."""
        far = 1e3 * near
        with self._elsewhere() as cameras:
            for camera in cameras:
                camera.pos, camera.forward, camera.up = eye, forward, up
                camera.frustum_near, camera.frustum_far = near, far
                camera.frustum_center, camera.frustum_width = 0.0, half[0] * near
                camera.frustum_bottom, camera.frustum_top = -half[1] * near, half[1] * near
            self._draw(self.solid, size)
        return distance_of(self.depth(size), (near, far))

    @contextmanager
    def _elsewhere(self) -> Iterator[Any]:
        """The cameras of the scene of solid things, for a view from another place; then they are as they were."""
        yield self.solid.camera
        for camera, own in zip(self.solid.camera, self.scene.camera, strict=True):
            for name in ("pos", "forward", "up", *FRUSTUM):
                setattr(camera, name, getattr(own, name))

    def draw_ids(self, size: tuple[int, int], translucent: bool = False) -> NDArray[np.int64]:
        """The visible opaque geom (h, w), -1 for none, from the bottom row up; or the ``translucent`` one that would be
        visible, from either side, if there were no opaque ones."""
        scene = self.glass if translucent else self.solid
        self._draw(scene, size, SEGMENT=True, IDCOLOR=True, CULL_FACE=not translucent)
        colour = self._colour(size).astype(np.int32)
        # 0 is the background, then in the scene's order
        drawn = colour[..., 0] + 256 * colour[..., 1] + 65536 * colour[..., 2]
        geoms = np.full(scene.ngeom + 1, -1)
        for geom in scene.geoms[: scene.ngeom]:
            geoms[geom.segid + 1] = geom.objid
        geoms[0] = -1
        return geoms[drawn]

    def close(self) -> None:
        self._gl.make_current()
        self._context.free()
        self._gl.free()


def _option(*groups: int) -> Any:
    """What MuJoCo shows: the geoms of some groups."""
    import mujoco

    option = mujoco.MjvOption()
    option.geomgroup[:] = np.isin(np.arange(len(option.geomgroup)), groups)
    return option


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0]
