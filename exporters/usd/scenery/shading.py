"""How MuJoCo's renderer draws a stage's lights, sky and materials.

MuJoCo shades in display space, while USD uses linear light. A display value is approximately ``encode(albedo) *
encode(light)``, so albedos are encoded directly, and the light is matched in full shade and in full sun.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery.lighting import encode_srgb, latlong_directions, to_linear, to_srgb
from vehsim.exporters.usd.stage import Material, Sky, Sun
from vehsim.intake.images import read_colours

Array = NDArray[np.float64]

DEFAULT_SUN = Sun(np.array([0.5, 0.3, -0.8]) / np.linalg.norm([0.5, 0.3, -0.8]), np.full(3, 2.5))
DIP = 8.0
"""Angle below the horizon at which a camera sees past the ground's edge, degrees: 300 m away, from 42 m up."""
DEFAULT_SKY = np.array([0.30, 0.36, 0.44])
"""Light for a stage without lights, linear."""
HIGHLIGHT, SOFT = 1.35, 20.0
"""Linear display value of white in full sun, and the sun's width in degrees at which it exceeds 1 by a third of that:
under clouds, nothing dazzles."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Shares of linear red, green and blue in the luminance (Rec. 709)."""


STAR, STARLIGHT = 0.003, 1.5
"""Linear light by which a texel of a night's sky is a star, and how much brighter it is as a point than as a texel."""
DIMMEST = 0.36
"""Linear light, in the units of USD, below which the exposure does not rise further: a night stays dark."""


class Stars(NamedTuple):
    """Unit ``directions`` (n, 3) in the world, and displayed ``colours`` (n, 3)."""

    directions: Array
    colours: Array


NO_STARS = Stars(np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True)
class Light:
    """Display-space light: ``ambient`` everywhere, ``sky`` from above, ``bounce`` from below, ``sun`` along its ray.

    ``haze`` is the colour of distant objects; ``image`` the linear latitude-longitude sky (h, w, 3) without stars,
    ``skybox`` (6, n, n, 3) the faces of a cube with it; ``level`` the linear light
    on level ground in the units of USD, before the ``exposure``; ``stars`` those of a night; ``sharp``: whether
    the sun is narrow enough for shadows with an edge.
    """

    direction: Array
    sun: Array
    ambient: Array
    sky: Array
    bounce: Array
    haze: Array
    image: Array
    skybox: NDArray[np.uint8]
    stars: Stars
    level: float
    exposure: float
    sharp: bool


def light_for(sun: Sun | None, sky: Sky | None, grounded: bool = False) -> Light:
    """The light of a stage. A white surface reflects irradiance divided by pi: that of the sun, and the dome's mean.

    The exposure puts white in full sun just above display white, except at night. ``grounded``: the stage has ground
    with an edge, so the sky's horizon continues down for `DIP` degrees; light and haze do not change.
    """
    key = sun or DEFAULT_SUN
    image = sky_image(sky)
    fill = dome_mean(image) if sky else DEFAULT_SKY
    exposure = exposure_of(key, fill)
    shade = _display(fill * exposure)
    lit = _display((fill + key.colour / np.pi) * exposure)
    horizon = image[int(image.shape[0] * 0.49)].mean(axis=0)
    R_wd = np.eye(3) if sky is None else sky.R_wd
    stars = NO_STARS
    if (fill + key.colour / np.pi) @ LUMINANCE < DIMMEST:
        image, stars = _without_stars(image, exposure, R_wd)
    behind = below_horizon(image) if grounded else image
    return Light(
        direction=key.direction,
        sun=lit - shade,
        ambient=0.58 * shade,
        sky=0.42 * shade,
        bounce=0.46 * shade * (1.25, 0.96, 0.72),
        haze=to_srgb(horizon * exposure),
        image=image,
        skybox=_cube_faces(behind * exposure, R_wd),
        stars=stars,
        level=float((fill - key.colour / np.pi * min(float(key.direction[2]), 0.0)).max()),
        exposure=exposure,
        sharp=key.angle < SOFT,
    )


def exposure_of(key: Sun, fill: Array) -> float:
    """The factor on linear light that shows white in full sun just above display white, under clouds at it, and darker
    below `DIMMEST`; ``fill`` (3,) is the dome's mean."""
    white = 1.0 + (HIGHLIGHT - 1.0) * np.exp(-key.angle / SOFT)
    return float(white / max(float((fill + key.colour / np.pi) @ LUMINANCE), DIMMEST))


def _without_stars(image: Array, exposure: float, R_wd: Array) -> tuple[Array, Stars]:
    """A latitude-longitude sky (h, w, 3) without its stars, and these: texels brighter than those on both
    sides, as clouds near the horizon are not."""
    from scipy.ndimage import maximum_filter, median_filter

    around, beside = median_filter(image, (3, 3, 1)), np.array([[[True], [False], [True]]])
    stars = (image - maximum_filter(image, footprint=beside)).max(axis=2) > STAR
    rows, columns = np.nonzero(stars)
    directions = latlong_directions(image.shape[1], image.shape[0])[rows, columns]
    own = np.stack([directions[:, 0], directions[:, 2], -directions[:, 1]], axis=1)
    light = np.minimum(STARLIGHT * exposure * (image - around)[rows, columns], 1.0)
    return np.where(stars[..., None], around, image), Stars(own @ R_wd.T, to_srgb(light))


def below_horizon(image: Array) -> Array:
    """A latitude-longitude sky (rows, columns, 3) whose lower half starts `DIP` degrees below the horizon."""
    half, dip = image.shape[0] // 2, round(image.shape[0] * DIP / 180.0)
    horizon = np.repeat(image[half - 1 : half], dip, axis=0)
    return np.concatenate([image[:half], horizon, image[half : image.shape[0] - dip]])


def _display(linear: Array) -> Array:
    """sRGB of linear light, extended beyond white."""
    return np.where(linear > 1.0, linear ** (1 / 2.4), to_srgb(linear))


def sky_image(sky: Sky | None) -> Array:
    """The dome as a linear latitude-longitude image (h, w, 3), light intensity included."""
    if sky is None or sky.texture is None:
        colour = DEFAULT_SKY if sky is None else sky.colour
        return np.broadcast_to(colour, (64, 128, 3)).astype(float)
    return to_linear(read_colours(sky.texture) / 255.0) * sky.colour


def dome_mean(image: Array) -> Array:
    """Mean radiance (3,) over the upper half of the dome, weighted by solid angle and by the cosine to the zenith."""
    theta = (np.arange(image.shape[0]) + 0.5) / image.shape[0] * np.pi
    weight = np.sin(theta) * np.maximum(np.cos(theta), 0.0)
    return np.asarray((image.mean(axis=1) * weight[:, None]).sum(axis=0) / weight.sum())


def _cube_faces(image: Array, R_wd: Array, size: int = 512) -> NDArray[np.uint8]:
    """The sky as the six faces (6, n, n, 3) of MuJoCo's skybox: right, left, up, down, front, back."""
    from scipy.ndimage import map_coordinates

    s, t = np.meshgrid((np.arange(size) + 0.5) / size * 2 - 1, (np.arange(size) + 0.5) / size * 2 - 1)
    one = np.ones_like(s)
    # OpenGL's cube faces: directions in the skybox's own axes, Y up.
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    height, width = image.shape[:2]
    wrapped = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    result = []
    for x, y, z in faces:
        world = np.stack([x, -z, y], axis=-1)
        own = world @ R_wd / np.linalg.norm(world, axis=-1, keepdims=True)
        u = (np.arctan2(own[..., 2], own[..., 0]) + np.pi / 2) / (2 * np.pi) % 1.0
        v = np.arccos(np.clip(own[..., 1], -1, 1)) / np.pi
        where = [np.clip(v * height - 0.5, 0, height - 1), u * width + 0.5]
        face = np.stack([map_coordinates(wrapped[..., k], where, order=1, mode="nearest") for k in range(3)], axis=-1)
        result.append(encode_srgb(face))
    return np.stack(result)


def author_material(spec: Any, name: str, surface: Material, textures: dict[Path, str]) -> None:
    """Add a MuJoCo material for ``surface`` to a spec; ``textures`` remembers the images already added."""
    import mujoco

    material = spec.add_material(name=name)
    colour = to_srgb(surface.colour) if surface.texture is None else np.ones(3)
    material.rgba = [*colour.tolist(), 1.0 - (1.0 - surface.opacity) ** 0.5]  # MuJoCo draws translucent geoms twice
    gloss = (1.0 - surface.roughness) ** 2
    material.specular = float(np.clip(0.9 * gloss + 0.3 * surface.metallic * gloss, 0.0, 1.0))
    material.shininess = float(np.clip(gloss, 0.02, 0.9))
    material.emission = float(np.clip(surface.emission, 0.0, 1.0))
    material.reflectance = 0.0
    material.roughness, material.metallic = surface.polish, surface.metallic
    if surface.texture is not None:
        if surface.texture not in textures:
            textures[surface.texture] = f"texture{len(textures)}"
            _author_texture(spec, textures[surface.texture], surface.texture)
        roles = list(material.textures)
        roles[mujoco.mjtTextureRole.mjTEXROLE_RGB] = textures[surface.texture]
        material.textures = roles


def mean_of(surface: Material) -> Array:
    """The mean albedo (3,) of a surface as it is displayed."""
    if surface.texture is None:
        return to_srgb(surface.colour)
    return np.asarray(read_colours(surface.texture).mean(axis=(0, 1)) / 255.0)


def _author_texture(spec: Any, name: str, path: Path) -> None:
    import mujoco

    pixels = read_colours(path)[::-1]  # USD counts v from the bottom
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    texture.height, texture.width = pixels.shape[:2]
    texture.data = pixels.tobytes()


def author_skybox(spec: Any, faces: NDArray[np.uint8]) -> None:
    """Add the sky's six faces (6, n, n, 3) to a spec."""
    import mujoco

    texture = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, nchannel=3)
    texture.width, texture.height = faces.shape[2], 6 * faces.shape[1]
    texture.data = np.ascontiguousarray(faces).tobytes()
