"""What vehicles drive on, as pictures show it: a repeating picture and a finish for each surface under tyres.

A look of level ground says in its ``terrain.toml`` what it ``shows``. Vehicles whose surface is another one drive on
that one: a car on gravel does not slide over slabs of concrete. `ground.py` and `exporter.py` write these looks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vehsim.vehicles.definition.surfaces import SurfaceName

if TYPE_CHECKING:
    from vehsim.delivery.take import Take

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

TEXELS = 1024
"""Side of the repeating picture; it spans 40 to 48 m."""
STONES = (0.7, 1.5)
"""Sizes of loose stones, texels: of some 3 and 7 cm."""
STONE_CONTRAST = 0.12
"""Standard deviation of their brightness over that of the dust."""


@dataclass(frozen=True)
class Ground:
    """``paint()``: linear colours (n, n, 3) that repeat without a seam. ``low`` and ``high``: linear colours at the
    lowest and the highest point of ground that is not level. ``roughness``, and what it mirrors straight on,
    ``specular``: 0 for loose ground, 0.04 for water, 0.02 for ice."""

    paint: Callable[[], Array]
    low: Colour
    high: Colour
    roughness: float = 0.95
    specular: float = 0.0


def gravel() -> Array:
    """Linear colours (n, n, 3) of dust with loose stones."""
    size = (TEXELS, TEXELS)
    shade, patches = noise(size), noise(size, coarse=2, octaves=4, seed=7)
    dust = np.clip(0.5 + patches, 0, 1)[..., None]
    dark, bright = np.array((0.20, 0.165, 0.125)), np.array((0.36, 0.30, 0.225))
    light = 1 + 0.30 * shade + STONE_CONTRAST * _specks(11, STONES)
    return np.asarray((dark + dust * (bright - dark)) * light[..., None])


def snow() -> Array:
    """Linear colours (n, n, 3) of trodden snow: low drifts that the wind has drawn out, bluer in their hollows."""
    size = (TEXELS, TEXELS)
    wide, fine = (noise(size, coarse=coarse, octaves=5, seed=seed) for coarse, seed in ((4, 21), (24, 22)))
    drifts = 0.6 * wide + 0.4 * fine
    light = 0.74 * (1 + 0.13 * drifts + 0.012 * _specks(23, STONES))
    hollow = np.clip(0.5 - drifts, 0, 1)[..., None]
    return np.asarray(light[..., None] * (1 + hollow * np.array((-0.04, -0.01, 0.02))))


def ice() -> Array:
    """Linear colours (n, n, 3) of a frozen lake: dark clear ice, frost in patches, white cracks."""
    size = (TEXELS, TEXELS)
    frost = np.clip(0.45 + 1.3 * noise(size, coarse=5, octaves=7, seed=31), 0, 1)
    frost = 0.15 + 0.55 * frost * (1 + 0.25 * noise(size, coarse=64, octaves=4, seed=32))
    cracks = np.zeros(size)
    for seed, coarse, width in ((33, 3, 2.0), (34, 6, 1.2), (35, 13, 0.8)):
        cracks = np.maximum(cracks, _lines(noise(size, coarse=coarse, octaves=6, seed=seed, fade=0.45), width))
    clear, white = np.array((0.16, 0.26, 0.32)), np.array((0.58, 0.64, 0.68))
    share = np.clip(np.maximum(frost, 0.8 * cracks), 0, 1)[..., None]
    return np.asarray((clear + share * (white - clear)) * (1 + 0.02 * _specks(36, STONES))[..., None])


def wet_asphalt() -> Array:
    """Linear colours (n, n, 3) of dark asphalt with its chippings, darkest where water stands."""
    size = (TEXELS, TEXELS)
    pools = np.clip(2.2 * noise(size, coarse=5, octaves=5, seed=41), -1, 1)
    light = 0.040 * (1 - 0.35 * pools + 0.08 * noise(size, seed=42) + 0.07 * _specks(43, (0.6, 1.0)))
    return np.asarray(light[..., None] * np.array((0.98, 1.0, 1.04)))


GROUNDS: Mapping[SurfaceName, Ground] = {
    "wet asphalt": Ground(wet_asphalt, (0.036, 0.037, 0.039), (0.045, 0.046, 0.048), 0.15, 0.02),
    "gravel": Ground(gravel, (0.36, 0.28, 0.19), (0.42, 0.33, 0.23)),
    "snow": Ground(snow, (0.68, 0.69, 0.71), (0.74, 0.74, 0.75)),
    "ice": Ground(ice, (0.30, 0.39, 0.44), (0.44, 0.51, 0.56), 0.28, 0.02),
}
"""Surface -> its look. Dry asphalt is what vehicles drive on unless their shot says otherwise, so it has none: bare
ground is shown as `BARE`, and the shipped level ground as it is."""
BARE: SurfaceName = "gravel"


def surface_of(take: Take) -> SurfaceName | None:
    """The surface, other than the default, that pictures of a take show: that of the first vehicle on one."""
    rolling = (clip.vehicle for clip in take.clips.values() if clip.vehicle.rolls)
    return next((vehicle.surface for vehicle in rolling if vehicle.surface in GROUNDS), None)


def noise(
    shape: tuple[int, ...], coarse: int = 8, octaves: int = 8, seed: int = 3, wrap: bool = True, fade: float = 0.62
) -> NDArray[np.float32]:
    """Fractal value noise (h, w) of about -1 to 1; the same every time. Each octave has ``fade`` times the amplitude of
    the one before. It repeats without a seam if it is to ``wrap``."""
    rng = np.random.default_rng(seed)
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        grid = rng.uniform(-1, 1, np.minimum(np.array(shape), coarse * 2**octave))
        total += np.float32(fade**octave) * (_repeated(grid, shape) if wrap else resized(grid, shape))
    return total / np.abs(total).max()


def resized(values: Array, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Values (h, w) at the centres of texels, interpolated linearly for another number of them."""
    from PIL import Image

    height, width = shape
    picture = Image.fromarray(values.astype(np.float32)).resize((int(width), int(height)), Image.Resampling.BILINEAR)
    return np.asarray(picture)


def _repeated(values: Array, shape: tuple[int, ...]) -> Array:
    """The same as `resized`, of a picture that repeats seamlessly."""
    from scipy.ndimage import zoom

    factor = np.array(shape) / values.shape
    return np.asarray(zoom(values, factor, order=1, grid_mode=True, mode="grid-wrap")[: shape[0], : shape[1]])


def _specks(seed: int, sizes: tuple[float, float]) -> Array:
    """Brightness (n, n) of specks of two ``sizes`` in texels, of deviation 1 and at most 2."""
    from scipy.ndimage import gaussian_filter

    specks = np.random.default_rng(seed).normal(size=(2, TEXELS, TEXELS))
    specks = sum(gaussian_filter(one, width, mode="wrap") * width for one, width in zip(specks, sizes, strict=True))
    return np.asarray(np.clip(specks / specks.std(), -2, 2))


def _lines(height: NDArray[np.float32], width: float) -> Array:
    """Lines (n, n), 0 to 1, ``width`` texels wide, along which ``height`` (n, n) is 0."""
    steps = [(np.roll(height, -1, axis) - np.roll(height, 1, axis)) / 2 for axis in (0, 1)]
    away = np.abs(height) / np.maximum(np.hypot(*steps), 1e-6)
    return np.asarray(np.clip(width / 2 + 0.5 - away, 0, 1))
