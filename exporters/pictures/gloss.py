"""The sky mirrored in paint, chrome and glass, drawn by OpenGL into the same buffers as MuJoCo.

MuJoCo's materials mirror only lights. Here each smooth geom is drawn again: the shader adds what it mirrors to the
pixels below, in linear light, by Fresnel's effect.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.pictures.backdrop import columns

SMOOTH = 0.45
"""Roughness below which a surface mirrors the sky visibly."""
VERTEX = """
#version 120
varying vec3 normal, away;
void main() {
    gl_Position = ftransform();  // the depth that MuJoCo drew
    normal = gl_NormalMatrix * gl_Normal;
    away = vec3(gl_ModelViewMatrix * gl_Vertex);
}
"""
FRAGMENT = """
#version 120
#extension GL_ARB_shader_texture_lod : require
uniform samplerCube sky;
uniform sampler2D drawn;
uniform mat3 to_sky;
uniform vec2 size, haze;
uniform vec3 ground, colour;
uniform float roughness, metallic, blur;
varying vec3 normal, away;
void main() {
    vec3 n = normalize(normal), v = normalize(away);
    vec3 way = to_sky * reflect(v, n);
    float down = smoothstep(0.0, 0.06 + roughness * roughness, -way.y);
    vec3 mirrored = mix(textureCubeLod(sky, way, blur).rgb, ground, down);
    vec3 facing = mix(vec3(0.04), colour * colour, metallic);
    vec3 grazing = max(vec3(1.0 - roughness), facing);
    float turned = clamp(1.0 + dot(n, v), 0.0, 1.0), squared = turned * turned;
    vec3 share = facing + (grazing - facing) * squared * squared * turned;
    share *= mix(0.5, 1.0, metallic) * clamp((haze.y + away.z) / (haze.y - haze.x), 0.0, 1.0);
    vec3 below = texture2D(drawn, gl_FragCoord.xy / size).rgb;
    gl_FragColor = vec4(sqrt(mix(below * below, mirrored * mirrored, share)), 1.0);
}
"""
"""Schlick's Fresnel term, less at grazing angles on rough surfaces; 0.04 is that of USD's ior of 1.5. Of paint and
glass half of it is shown, as what stands around them hides some of the sky (both our choice). A gamma of 2 is close to
that of displays, and fast."""

UNIFORMS = "sky", "drawn", "to_sky", "size", "haze", "ground", "colour", "roughness", "metallic", "blur"


class Gloss:
    """Draws what smooth geoms mirror: the skybox ``sky`` and, below the horizon, the displayed colour ``ground`` (3,).

    The ``context`` of the model must be current. Warns where its OpenGL has no such shader: nothing is mirrored then.
    """

    def __init__(self, model: Any, context: Any, sky: int, ground: NDArray[np.float64]) -> None:
        from OpenGL import GL
        from OpenGL.GL import shaders

        self._context, self._sky, self._ground = context, sky, ground.tolist()
        self._roughness, self._metallic = model.mat_roughness, model.mat_metallic
        self._texels = int(model.tex_width[model.tex_type.argmax()])
        kinds = (VERTEX, GL.GL_VERTEX_SHADER), (FRAGMENT, GL.GL_FRAGMENT_SHADER)
        self._program: Any = None
        try:
            self._program = shaders.compileProgram(*(shaders.compileShader(*kind) for kind in kinds), validate=False)
        except (shaders.ShaderCompilationError, shaders.ShaderLinkError, GL.GLError):
            warnings.warn("this OpenGL cannot draw what paint, chrome and glass mirror: pictures lack it", stacklevel=2)
        self._drawn = int(GL.glGenTextures(1))

    def draw(self, geoms: Iterable[Any], camera: Any, size: tuple[int, int], haze: tuple[float, float]) -> None:
        """Add to a drawing of ``size`` (w, h) px what the smooth ones of ``geoms`` mirror, as ``camera`` sees it;
        ``haze``: where it begins and ends, m."""
        from OpenGL import GL
        from OpenGL.raw.GL.VERSION.GL_1_0 import glMultMatrixf

        smooth = [geom for geom in geoms if geom.matid >= 0 and self._roughness[geom.matid] < SMOOTH]
        if not smooth or self._program is None:
            return
        GL.glBindTexture(GL.GL_TEXTURE_2D, self._drawn)
        GL.glCopyTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_RGB8, 0, 0, *size, 0)
        for way in (GL.GL_TEXTURE_MIN_FILTER, GL.GL_TEXTURE_MAG_FILTER):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, way, GL.GL_NEAREST)
        GL.glUseProgram(self._program)
        GL.glActiveTexture(GL.GL_TEXTURE1)
        GL.glBindTexture(GL.GL_TEXTURE_CUBE_MAP, self._sky)
        GL.glTexParameteri(GL.GL_TEXTURE_CUBE_MAP, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR_MIPMAP_NEAREST)
        forward, up = np.array(camera.forward, float), np.array(camera.up, float)
        R_wc = np.stack([np.cross(forward, up), up, -forward], axis=1)
        to_sky = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ R_wc  # the skybox is Y up
        at = {name: GL.glGetUniformLocation(self._program, name) for name in UNIFORMS}
        GL.glUniform1i(at["sky"], 1)
        GL.glUniform1i(at["drawn"], 0)
        GL.glUniformMatrix3fv(at["to_sky"], 1, GL.GL_TRUE, to_sky.astype(np.float32))
        GL.glUniform2f(at["size"], *size)
        GL.glUniform2f(at["haze"], *haze)
        GL.glUniform3f(at["ground"], *self._ground)
        GL.glDepthMask(GL.GL_FALSE)
        for geom in smooth:
            roughness = float(self._roughness[geom.matid])
            GL.glUniform3f(at["colour"], *geom.rgba[:3].tolist())
            GL.glUniform1f(at["roughness"], roughness)
            GL.glUniform1f(at["metallic"], float(self._metallic[geom.matid]))
            GL.glUniform1f(at["blur"], float(np.log2(1 + self._texels * roughness**2)))
            GL.glPushMatrix()
            glMultMatrixf(columns(geom))
            GL.glCallList(self._context.baseMesh + geom.dataid)
            GL.glPopMatrix()
        GL.glDepthMask(GL.GL_TRUE)
        GL.glTexParameteri(GL.GL_TEXTURE_CUBE_MAP, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR)
        GL.glActiveTexture(GL.GL_TEXTURE0)
        GL.glUseProgram(0)
