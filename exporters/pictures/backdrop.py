"""The sky behind a drawing of MuJoCo's, and translucent geoms in front of both, drawn by OpenGL into the same buffers.

MuJoCo's own haze would hide its skybox, which it draws far away, and its translucent geoms have to come after the sky.
Both are drawn here as MuJoCo does it, with its texture, meshes, lights, haze and materials: the state that
``mjr_render`` leaves.
"""

from __future__ import annotations

import ctypes
import math
from typing import Any

import numpy as np

from vehsim.exporters.usd.scenery.shading import Stars


class Backdrop:
    """Draws after ``mjr_render``, with its ``context`` current; the model has a skybox, and meshes only are
    translucent. The ``stars`` are points, as texels of the sky would be blobs."""

    def __init__(self, model: Any, context: Any, stars: Stars) -> None:
        import mujoco
        from OpenGL import GL

        self._context, self._stars = context, stars
        self._textures = model.mat_texid[:, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)]
        kinds = list(context.textureType[: context.ntexture])
        self.sky = int(context.texture[kinds.index(int(mujoco.mjtTexture.mjTEXTURE_SKYBOX))])
        GL.glBindTexture(GL.GL_TEXTURE_CUBE_MAP, self.sky)
        # the sky is magnified, so that coarser copies of it would only cost time
        GL.glTexParameteri(GL.GL_TEXTURE_CUBE_MAP, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR)
        self._lists: dict[int, int] = {}

    def draw_sky(self, camera: Any, point: int) -> None:
        """The sky wherever nothing was drawn, as the scene's camera (a mean of two equal eyes) sees it; its stars are
        ``point`` px wide."""
        from OpenGL import GL

        (fx, fy, fz), (ux, uy, uz), near = camera.forward.tolist(), camera.up.tolist(), camera.frustum_near
        right = fy * uz - fz * uy, fz * ux - fx * uz, fx * uy - fy * ux
        GL.glMatrixMode(GL.GL_PROJECTION)
        GL.glPushMatrix()
        GL.glLoadIdentity()
        GL.glMatrixMode(GL.GL_MODELVIEW)
        GL.glPushMatrix()
        GL.glLoadIdentity()
        switched = GL.GL_LIGHTING, GL.GL_FOG, GL.GL_CULL_FACE
        for state in switched:
            GL.glDisable(state)
        GL.glDepthMask(GL.GL_FALSE)
        GL.glDepthRange(0, 0)  # MuJoCo clears the depth to 0 and draws what is nearer with more
        GL.glEnable(GL.GL_TEXTURE_CUBE_MAP)
        GL.glBindTexture(GL.GL_TEXTURE_CUBE_MAP, self.sky)
        GL.glColor4f(1, 1, 1, 1)
        GL.glBegin(GL.GL_QUADS)
        for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            across = (camera.frustum_center + x * camera.frustum_width) / near
            above = (camera.frustum_top if y > 0 else camera.frustum_bottom) / near
            rx, ry, rz = (
                ahead + across * aside + above * up
                for ahead, aside, up in zip((fx, fy, fz), right, (ux, uy, uz), strict=True)
            )
            GL.glTexCoord3f(rx, rz, -ry)  # the skybox is Y up
            GL.glVertex3f(x, y, 0)
        GL.glEnd()
        GL.glDisable(GL.GL_TEXTURE_CUBE_MAP)
        if len(self._stars.directions):
            self._draw_stars(camera, point)
        GL.glDepthRange(0, 1)
        GL.glDepthMask(GL.GL_TRUE)
        for state in switched:
            GL.glEnable(state)
        GL.glPopMatrix()
        GL.glMatrixMode(GL.GL_PROJECTION)
        GL.glPopMatrix()
        GL.glMatrixMode(GL.GL_MODELVIEW)

    def _draw_stars(self, camera: Any, point: int) -> None:
        """The stars, in the coordinates of the picture."""
        from OpenGL import GL

        forward, up = np.array(camera.forward, float), np.array(camera.up, float)
        middle = camera.frustum_center, (camera.frustum_top + camera.frustum_bottom) / 2
        half = camera.frustum_width, (camera.frustum_top - camera.frustum_bottom) / 2
        ahead = self._stars.directions @ forward
        x, y = (
            (camera.frustum_near * (self._stars.directions @ axis) / np.where(ahead > 0, ahead, np.nan) - at) / size
            for axis, at, size in zip((np.cross(forward, up), up), middle, half, strict=True)
        )
        seen = (np.abs(x) < 1) & (np.abs(y) < 1)
        places = np.column_stack([x, y, np.zeros_like(x)])[seen].astype(np.float32)
        GL.glEnable(GL.GL_BLEND)
        GL.glBlendFunc(GL.GL_ONE, GL.GL_ONE)
        GL.glPointSize(point)
        GL.glBegin(GL.GL_POINTS)
        for place, colour in zip(places.tolist(), self._stars.colours[seen].tolist(), strict=True):
            GL.glColor3f(*colour)
            GL.glVertex3f(*place)
        GL.glEnd()
        GL.glDisable(GL.GL_BLEND)

    def draw_glass(self, scene: Any) -> None:
        """The geoms of ``scene``, all translucent: the nearest first, then again the farthest first."""
        from OpenGL import GL
        from OpenGL.raw.GL.VERSION.GL_1_0 import glMultMatrixf

        eye = scene.camera[0].pos.tolist()
        geoms = [scene.geoms[k] for k in range(scene.ngeom)]
        geoms.sort(key=lambda geom: math.dist(geom.pos.tolist(), eye) - geom.modelrbound)
        draws = [(columns(geom), self._list(geom)) for geom in geoms]
        GL.glDepthMask(GL.GL_FALSE)
        GL.glEnable(GL.GL_BLEND)
        GL.glBlendFunc(GL.GL_SRC_ALPHA, GL.GL_ONE_MINUS_SRC_ALPHA)
        lights = [GL.GL_LIGHT0 + k for k in range(scene.nlight)]
        for light in lights:
            GL.glEnable(light)
        for pose, drawing in [*draws, *draws[::-1]]:
            GL.glPushMatrix()
            glMultMatrixf(pose)
            GL.glCallList(drawing)
            GL.glPopMatrix()
        for light in lights:
            GL.glDisable(light)
        GL.glDisable(GL.GL_BLEND)
        GL.glDepthMask(GL.GL_TRUE)

    def _list(self, geom: Any) -> int:
        """The display list of a geom: its material, which does not change, and its mesh."""
        from OpenGL import GL

        if geom.objid not in self._lists:
            made = self._lists[geom.objid] = int(GL.glGenLists(1))
            GL.glNewList(made, GL.GL_COMPILE)
            both = GL.GL_FRONT_AND_BACK
            GL.glMaterialfv(both, GL.GL_EMISSION, [*(geom.emission * geom.rgba[:3]).tolist(), 1.0])
            GL.glMaterialfv(both, GL.GL_SPECULAR, [float(geom.specular)] * 3 + [1.0])
            GL.glMaterialf(both, GL.GL_SHININESS, 128 * geom.shininess)
            GL.glColor4f(*geom.rgba.tolist())
            texture = self._textures[geom.matid] if geom.texcoord else -1
            if texture >= 0:
                GL.glEnable(GL.GL_TEXTURE_2D)
                GL.glBindTexture(GL.GL_TEXTURE_2D, int(self._context.texture[texture]))
            GL.glCallList(self._context.baseMesh + geom.dataid)
            GL.glDisable(GL.GL_TEXTURE_2D)
            GL.glEndList()
        return self._lists[geom.objid]


def columns(geom: Any) -> Any:
    """A geom's pose (4, 4) for OpenGL, column by column."""
    a, b, c = geom.mat.tolist()
    x, y, z = geom.pos.tolist()
    across = a[0], b[0], c[0], 0, a[1], b[1], c[1], 0, a[2], b[2], c[2], 0, x, y, z, 1
    return (ctypes.c_float * 16)(*across)
