"""Light for a shot: a low warm sun, placed so that it lights the motion, and a dome whose cool sky fills the shade.

This module writes lights; `shading.py` decides how MuJoCo's renderer draws them.
"""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.delivery.take import Take
from vehsim.exporters.usd.packing import Pack
from vehsim.runtime.cache import kept

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mood:
    """A time of day and its weather, as data; default: late afternoon. Colours linear, angles in degrees, intensities
    UsdLux's.

    ``key_angle``: angle between the sun and the camera's back: 0 lights from behind the camera, 90 from the side.
    """

    elevations: tuple[float, ...] = (20.0, 25.0)
    key_angle: float = 55.0
    sun_colour: tuple[float, float, float] = (1.0, 0.80, 0.58)
    sun_intensity: float = 2.9
    sun_angle: float = 0.53
    dome_intensity: float = 1.0
    zenith: tuple[float, float, float] = (0.16, 0.27, 0.48)
    horizon: tuple[float, float, float] = (0.76, 0.66, 0.55)
    ground: tuple[float, float, float] = (0.26, 0.20, 0.16)
    glow: tuple[float, float, float] = (0.55, 0.36, 0.18)
    cover: float = 0.05
    """how much of the sky the clouds cover: -2 for none, 3 for all of it"""
    stars: int = 0


MOOD = Mood()
MOODS: dict[str, Mood] = {
    "afternoon": MOOD,
    "dusk": Mood(
        elevations=(7.0, 10.0),
        key_angle=80.0,
        sun_colour=(1.0, 0.56, 0.28),
        sun_intensity=2.4,
        zenith=(0.07, 0.12, 0.26),
        horizon=(0.60, 0.42, 0.33),
        glow=(0.42, 0.20, 0.07),
    ),
    "noon": Mood(
        elevations=(58.0, 66.0),
        sun_colour=(1.0, 0.95, 0.87),
        sun_intensity=4.0,
        zenith=(0.11, 0.24, 0.52),
        horizon=(0.58, 0.68, 0.80),
        ground=(0.30, 0.27, 0.22),
        glow=(0.30, 0.28, 0.24),
    ),
    "overcast": Mood(
        elevations=(72.0, 80.0),  # such a sky is brightest overhead, and darkest below vehicles
        sun_colour=(0.55, 0.56, 0.57),
        sun_intensity=2.2,
        sun_angle=40.0,
        zenith=(0.34, 0.37, 0.42),
        horizon=(0.42, 0.45, 0.49),
        ground=(0.16, 0.16, 0.16),
        glow=(0.05, 0.05, 0.05),
        cover=1.2,
    ),
    "night": Mood(
        elevations=(32.0, 42.0),
        sun_colour=(0.062, 0.078, 0.10),
        sun_intensity=2.6,
        zenith=(0.004, 0.007, 0.018),
        horizon=(0.022, 0.032, 0.055),
        ground=(0.006, 0.006, 0.007),
        glow=(0.010, 0.013, 0.018),
        cover=-0.2,
        stars=2400,
    ),
}
"""``render.mood`` of a shot file -> its light."""


def author_lights(stage: Any, scope: str, take: Take, pack: Pack, shot: Path, mood: Mood | None = None) -> None:
    """Author ``sun`` (DistantLight) and ``sky`` (DomeLight with a generated texture) below ``scope``."""
    from pxr import Gf, Sdf, UsdGeom, UsdLux

    mood = mood or MOODS[take.render.mood]
    azimuth, elevation = place_sun(take, mood)
    sun = UsdLux.DistantLight.Define(stage, f"{scope}/sun")
    sun.CreateIntensityAttr(mood.sun_intensity)
    sun.CreateColorAttr(Gf.Vec3f(*mood.sun_colour))
    sun.CreateAngleAttr(mood.sun_angle)
    # without this, intensity is that of the disc itself, and half a degree of that gives no light
    sun.CreateNormalizeAttr(True)
    # A distant light shines along its -Z: tilt it to the elevation, then rotate it to the azimuth.
    UsdGeom.Xformable(sun).AddRotateXYZOp(UsdGeom.XformOp.PrecisionDouble).Set(
        Gf.Vec3d(90.0 - elevation, 0.0, azimuth + 90.0)
    )

    texture = pack.folder / "assets" / "sky" / "sky.png"
    write_sky(texture, azimuth, elevation, mood, hills=take.world.terrain is not None)
    pack.written.append(texture)
    dome = UsdLux.DomeLight.Define(stage, f"{scope}/sky")
    dome.CreateIntensityAttr(mood.dome_intensity)
    dome.CreateTextureFileAttr(Sdf.AssetPath(pack.relative(texture, shot)))
    dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    UsdGeom.Xformable(dome).AddRotateXOp(UsdGeom.XformOp.PrecisionDouble).Set(90.0)  # its pole is +Y


def place_sun(take: Take, mood: Mood = MOOD) -> tuple[float, float]:
    """Azimuth (from +X, counter-clockwise) and elevation of the sun, degrees.

    Of 36 azimuths, the one that keeps most of the motion out of the terrain's shadow while it lights the vehicles
    ``key_angle`` off the camera's back.
    """
    points = np.concatenate([clip.positions for clip in take.clips.values()] or [np.zeros((1, 3))])
    points = points[:: max(1, len(points) // 64)] + np.array([0.0, 0.0, 1.5])
    view = _view_azimuths(take)
    best = (-np.inf, 0.0, mood.elevations[0])
    for elevation in mood.elevations:
        for azimuth in np.arange(0.0, 360.0, 10.0):
            lit = _lit(take, points, azimuth, elevation).mean()
            behind = np.abs((azimuth - view) % 360.0 - 180.0)  # 0: the sun is behind the camera
            key = np.exp(-(((behind - mood.key_angle) / 35.0) ** 2)).mean()
            score = lit + 0.4 * key
            if score > best[0] + 1e-9:
                best = (float(score), float(azimuth), elevation)
    return best[1], best[2]


def _view_azimuths(take: Take) -> Array:
    """Viewing direction of the cameras (n,), degrees; along +X if there are none."""
    if not take.cameras:
        return np.zeros(1)
    w, x, y, z = np.concatenate([camera.orientations for camera in take.cameras]).T
    forward = -np.stack([2 * (x * z + w * y), 2 * (y * z - w * x)])
    return np.degrees(np.arctan2(forward[1], forward[0]))[:: max(1, len(w) // 64)]


def _lit(take: Take, points: Array, azimuth: float, elevation: float) -> NDArray[np.bool_]:
    """Whether the sun reaches each of ``points`` (n, 3) over the terrain."""
    a, e = np.radians([azimuth, elevation])
    reach = np.geomspace(2.0, 400.0, 60)
    ray = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    along = points[:, None] + reach[:, None] * ray
    heights = np.asarray(take.world.height(along[..., :2].reshape(-1, 2))).reshape(along.shape[:2])
    return ~(heights > along[..., 2]).any(axis=1)


def latlong_directions(width: int, height: int) -> Array:
    """World direction (height, width, 3) of each pixel of a sky whose pole was rotated from +Y to +Z.

    UsdLux (as OpenEXR) puts the dome's own +Z in the middle of the image and +X a quarter from the left.
    """
    phi = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi / 2
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi, theta = np.meshgrid(phi, theta)
    own = np.stack([np.cos(phi) * np.sin(theta), np.cos(theta), np.sin(phi) * np.sin(theta)], axis=-1)
    return np.stack([own[..., 0], -own[..., 2], own[..., 1]], axis=-1)


def write_sky(
    path: Path, azimuth: float, elevation: float, mood: Mood = MOOD, width: int = 1024, hills: bool = False
) -> None:
    """A sky as a latitude-longitude PNG: zenith to warm horizon, clouds, a glow around the sun, ground below.

    ``hills``: distant ones along the horizon.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_kept_sky(azimuth, elevation, mood, width, hills))


@lru_cache(maxsize=64)
def _kept_sky(azimuth: float, elevation: float, mood: Mood, width: int, hills: bool) -> bytes:
    """The PNG, cached: there are few places for the sun and many shots, and it takes half a second."""
    import PIL

    arguments = (azimuth, elevation, mood, width, hills)
    by = (np.__version__, PIL.__version__, hashlib.sha256(Path(__file__).read_bytes()).hexdigest())
    return kept("sky", (arguments, by), lambda: _sky(*arguments))


def _sky(azimuth: float, elevation: float, mood: Mood, width: int, hills: bool) -> bytes:
    from PIL import Image

    directions = latlong_directions(width, width // 2)
    up = directions[..., 2]
    a, e = np.radians([azimuth, elevation])
    sun = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    haze = np.exp(-np.clip(up, 0, 1) / 0.16)[..., None]
    sky = (1 - haze) * np.array(mood.zenith) + haze * np.array(mood.horizon)
    toward = np.clip(directions @ sun, 0, 1)[..., None]
    glow = np.array(mood.glow) * (0.35 * toward**6 + 0.5 * toward**48)
    cover, light = clouds(directions, sun, mood.cover)
    lit = light * (0.6 * np.array(mood.sun_colour) + 0.4 * np.array(mood.horizon)) + (1 - light) * sky
    sky = sky + _stars(directions.shape[:2], mood.stars) * (1 - haze) * (1 - cover)
    sky = sky + cover * (0.9 * lit - 0.6 * sky) + glow
    if hills:
        hidden = ridges(directions)
        sky = (1 - hidden) * sky + hidden * (0.30 * np.array(mood.horizon) + 0.45 * np.array(mood.zenith))
    below = np.clip(-up / 0.08, 0, 1)[..., None]
    linear = (1 - below) * sky + below * np.array(mood.ground)
    png = io.BytesIO()
    Image.fromarray(encode_srgb(linear)).save(png, "png")
    return png.getvalue()


def _stars(shape: tuple[int, ...], count: int) -> Array:
    """The light of ``count`` stars (h, w, 1), scattered evenly over the sphere; few of them are bright."""
    rng = np.random.default_rng(3)
    light = np.zeros((*shape, 1))
    rows = np.arccos(rng.uniform(-1, 1, count)) / np.pi * shape[0]
    np.maximum.at(
        light[..., 0], (rows.astype(int), rng.integers(0, shape[1], count)), 0.01 + 0.2 * rng.uniform(size=count) ** 5
    )
    return light


CLOUD_TILE = 256
"""Texels along each side of the repeating cloud pattern."""


@lru_cache(maxsize=8)
def fractal_noise(size: int, slope: float, seed: int) -> Array:
    """Repeating noise (n, n) with mean 0 and deviation 1: white noise with a spectrum that decreases by ``slope``."""
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(size) * size] * 2))
    white = np.fft.fft2(np.random.default_rng(seed).normal(size=(size, size)))
    noise = np.fft.ifft2(white * np.where(frequency > 0, np.maximum(frequency, 2.0) ** -slope, 0.0)).real
    return np.asarray(noise / noise.std())


def clouds(directions: Array, sun: Array, amount: float = MOOD.cover) -> tuple[Array, Array]:
    """How much of the sky clouds hide along ``directions`` (h, w, 3), and their brightness: (h, w, 1)."""
    from scipy.ndimage import map_coordinates

    up = np.clip(directions[..., 2], 0, 1)
    # on a layer that the Earth's curvature bends down to the horizon
    flat = directions[..., :2] / (up + 0.10)[..., None]

    def density(shift: Array) -> Array:
        where = np.moveaxis((flat + shift) * (CLOUD_TILE / 12.0), -1, 0)
        return np.asarray(map_coordinates(fractal_noise(CLOUD_TILE, 1.75, 11), where, order=1, mode="grid-wrap"))

    here, sunwards = density(np.zeros(2)), density(0.10 * sun[:2] / np.hypot(*sun[:2]))
    cover = np.clip((here + amount) / 1.5, 0, 1) * np.clip(up / 0.10, 0, 1)
    light = np.clip(0.62 + 0.35 * (here - sunwards), 0.25, 1)
    return 0.85 * (cover * cover * (3 - 2 * cover))[..., None], light[..., None]


def ridges(directions: Array) -> Array:
    """How much of the sky distant hills hide along ``directions`` (h, w, 3): (h, w, 1); mist lies at their feet."""
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    height = np.degrees(np.arcsin(np.clip(directions[..., 2], -1, 1)))
    hidden = np.zeros_like(height)
    for k, (top, share) in enumerate(((3.6, 0.70), (2.0, 0.85))):
        waves = sum(np.sin((n + k) * azimuth + 2.4 * n + k) / (n + 3) for n in (2, 3, 5, 8, 13, 21, 34, 55))
        crest = top * (0.55 + 0.55 * waves)
        hidden = np.maximum(hidden, share * np.clip((crest - height) / 0.35, 0, 1))
    return np.asarray(hidden * np.clip(0.65 + height / 3.0, 0, 1))[..., None]


def encode_srgb(linear: Any) -> NDArray[np.uint8]:
    """Linear light to 8-bit sRGB."""
    return np.round(255 * to_srgb(linear)).astype(np.uint8)


def to_srgb(linear: Any) -> Array:
    """Linear light to sRGB, both 0 to 1."""
    x = np.asarray(linear)
    x = np.clip(x if np.issubdtype(x.dtype, np.floating) else x.astype(float), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def to_linear(srgb: Any) -> Array:
    """sRGB to linear light, both 0 to 1."""
    x = np.clip(np.asarray(srgb, float), 0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
