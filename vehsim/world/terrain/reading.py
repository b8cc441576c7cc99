"""Read terrains from files: shipped terrains, height maps, and meshes sampled by vertical rays.

The scale of a height map is in a TOML file of the same stem beside it (or in the ``terrain.toml`` that is loaded):
``cell`` and ``origin`` in metres, ``range`` the heights of black and white.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.assets import described, description
from vehsim.errors import InputError
from vehsim.intake.arrays import read_array, read_arrays
from vehsim.intake.gate import reading, refuse
from vehsim.intake.images import read_picture
from vehsim.intake.meshes import read_triangles
from vehsim.intake.toml import lines_in
from vehsim.intake.usd import dependencies
from vehsim.world.terrain.grid import MAX_POINTS, HeightGrid
from vehsim.world.terrain.surface import Surface, surface_of

Array = NDArray[np.float64]

SAMPLES = 50_000
"""Number of heights sampled from a mesh without ``cell``: about 1e5 triangles."""


@dataclass(frozen=True)
class Placement:
    """The placement of a file's heights in the world; None: from the file itself.

    ``cell`` (dx, dy) and ``origin`` (x, y), m; ``range`` heights of black and white, m; ``look`` a USD file.
    """

    file: Path
    cell: tuple[float, float] | None = None
    origin: tuple[float, float] | None = None
    range: tuple[float, float] | None = None
    look: Path | None = None


def read_heights(source: str | Path) -> HeightGrid:
    """The shipped terrain called ``source``, or the terrain in the file or folder ``source``. Raises ``InputError``."""
    path = description("terrain", str(source)) or Path(os.path.expanduser(source))
    if path.is_dir():
        path = path / "terrain.toml"
    if not path.is_file():
        close = [f"did you mean {name!r}? " for name in get_close_matches(path.name, described("terrain"), n=1)]
        remedy = f"{''.join(close)}give one of {', '.join(described('terrain'))} or the path of a mesh or height map"
        raise InputError("no such terrain or file", remedy, key="terrain", value=str(source))
    if path.suffix == ".toml":
        heights, placement = _read_toml(path)
        return replace(_read_map(heights, placement), name=path.parent.name, look=placement.look)
    beside = path.with_suffix(".toml")
    placement = _read_toml(beside)[1] if beside.is_file() else Placement(path)
    terrain = _read_map(path, placement)
    return replace(terrain, look=placement.look) if placement.look else terrain


def _read_map(path: Path, placement: Placement) -> HeightGrid:
    """The terrain in a mesh or height map."""
    if not path.is_file():
        raise refuse(placement.file, "heights", "no such file", "put the file there or correct the path", str(path))
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise refuse(path, "terrain", "unknown kind of file", f"use one of {' '.join(READERS)}", path.suffix)
    with reading(path, "terrain"):
        return reader(path, placement)


def _read_toml(path: Path) -> tuple[Path, Placement]:
    """The file of heights and the placement in a ``terrain.toml`` or in the TOML file beside a height map."""
    from vehsim.intake.tables import read_table
    from vehsim.world.terrain.file import TerrainFile, TerrainFolder

    table = read_table(path, TerrainFolder if path.name == "terrain.toml" else TerrainFile)
    look = path.parent / table["look"] if "look" in table else None
    if look is not None and not look.is_file():
        with lines_in(path):
            raise refuse(path, "look", "no such file", "put the USD file there or fix the path", table["look"])
    if look is not None:
        dependencies(look)
    pairs = {key: _pair(table.get(key)) for key in ("cell", "origin", "range")}
    return path.parent / table.get("heights", ""), Placement(path, look=look, **pairs)


def _pair(value: Any) -> tuple[float, float] | None:
    """Two numbers; one number stands for both."""
    if value is None:
        return None
    x, y = value if isinstance(value, list) else (value, value)
    return float(x), float(y)


def _grid(path: Path, heights: Array, placement: Placement) -> HeightGrid:
    """A height map at its placement; by default centred on the origin."""
    heights = np.asarray(heights)
    if heights.ndim != 2 or heights.dtype.kind not in "fiub":
        remedy = "give a two-dimensional array of numbers"
        raise refuse(path, "heights", "not a grid of numbers", remedy, (heights.shape, str(heights.dtype)))
    if placement.cell is None:
        warnings.warn(
            f"{path}: no cell size is given, so 1 m is used; write cell = ... in {path.stem}.toml", stacklevel=2
        )
    cell = placement.cell or (1.0, 1.0)
    rows, cols = heights.shape
    centred = (-cell[0] * (cols - 1) / 2, -cell[1] * (rows - 1) / 2)
    return HeightGrid(path.name, heights, placement.origin or centred, cell)


def _read_npy(path: Path, placement: Placement) -> HeightGrid:
    return _grid(path, read_array(path, "heights"), placement)


def _read_npz(path: Path, placement: Placement) -> HeightGrid:
    """An archive with ``heights`` and optionally ``cell`` and ``origin``."""
    arrays = read_arrays(path, "heights", ("heights", *_missing(placement)))
    if "heights" not in arrays:
        raise refuse(path, "heights", "missing", "save the array under the name heights")
    heights = arrays.pop("heights")
    own: dict[str, Any] = {key: tuple(np.broadcast_to(array, 2).tolist()) for key, array in arrays.items()}
    return _grid(path, heights, replace(placement, **own))


def _missing(placement: Placement) -> list[str]:
    """The placement that the file itself may still give."""
    return [key for key in ("cell", "origin") if getattr(placement, key) is None]


def _read_png(path: Path, placement: Placement) -> HeightGrid:
    """A grey picture with 8 or 16 bits, seen from above with +Y up."""
    if placement.range is None:
        remedy = f"write range = [0.0, 50.0] (heights of black and white, m) in {path.stem}.toml beside it"
        raise refuse(path, "range", "a picture does not contain its heights", remedy)
    grey, mode, _ = read_picture(path, ("L", "I;16", "I;16B", "I"), MAX_POINTS, "save it as 8- or 16-bit grey")
    grey = grey[::-1] / (255.0 if mode == "L" else 65535.0)
    low, high = placement.range
    return _grid(path, low + (high - low) * grey, placement)


PIXEL_SCALE, TIE_POINT = 33550, 33922


def _read_geotiff(path: Path, placement: Placement) -> HeightGrid:
    """Heights in metres in a projected coordinate system; the first row is the northernmost."""
    heights, _, tags = read_picture(path, ("F", "I", "I;16", "I;16S", "L"), MAX_POINTS, "export one band")
    heights = heights[::-1]
    scale, tie = tags.get(PIXEL_SCALE), tags.get(TIE_POINT)
    cell = placement.cell or ((float(scale[0]), float(scale[1])) if scale else None)
    if cell is not None and min(cell) < 1e-3:
        raise refuse(path, "cell", "looks like degrees", "reproject to a metric coordinate system, such as UTM", cell)
    if placement.origin is None and tie is not None and cell is not None:
        x, y = tie[3] - tie[0] * cell[0], tie[4] + tie[1] * cell[1]
        corner = (float(x) + cell[0] / 2, float(y) - cell[1] * (len(heights) - 0.5))  # pixels are areas
        placement = replace(placement, origin=corner)
    return _grid(path, heights, replace(placement, cell=cell))


def _read_trimesh(path: Path, placement: Placement) -> HeightGrid:
    return _sample(path, *read_triangles(path, "terrain"), placement)


def _read_usd(path: Path, placement: Placement) -> HeightGrid:
    """A stage's meshes from above; the stage is also the look."""
    return replace(_sample(path, *read_triangles(path, "terrain"), placement), look=path)


def _sample(path: Path, points: Array, faces: NDArray[np.int64], placement: Placement) -> HeightGrid:
    """Heights of a mesh by a vertical ray per grid point; a mesh with overhangs also stays as its surface."""
    import igl

    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low
    if min(size[:2]) < 1e-3 or max(size) > 1e6:
        remedy = "terrains are metres, Z up, between 1 mm and 1000 km wide"
        raise refuse(path, "points", "absurd size", remedy, tuple(np.round(size, 6).tolist()))
    cell = placement.cell or (float(np.sqrt(size[0] * size[1] / SAMPLES)),) * 2
    cols, rows = (max(2, int(np.floor(size[k] / cell[k] + 1e-6)) + 1) for k in range(2))
    if rows * cols > MAX_POINTS:
        raise refuse(placement.file, "cell", f"more than {MAX_POINTS:,} heights", "give a larger cell", cell)
    x, y = low[0] + cell[0] * np.arange(cols), low[1] + cell[1] * np.arange(rows)
    rays = np.stack([*np.meshgrid(x, y), np.full((rows, cols), high[2] + 1.0)], axis=-1).reshape(-1, 3)
    inset = 1e-7 * size[:2]  # a ray exactly along a border could miss
    rays[:, :2] = np.clip(rays[:, :2], low[:2] + inset, high[:2] - inset)
    tree = igl.AABB()
    tree.init(points, faces)
    hit, depth, _ = tree.intersect_ray_first(points, faces, rays, np.tile([0.0, 0.0, -1.0], (len(rays), 1)))
    heights = np.where(hit >= 0, rays[:, 2] - depth, np.nan)
    origin = (float(low[0]), float(low[1]))
    top = HeightGrid(path.name, _filled(path, heights.reshape(rows, cols)), origin, cell)
    surface = surface_of(points, faces)
    if not _has_overhangs(top, surface):
        return top
    floor = surface.floor(rays[:, :2])
    floor = np.where(np.isnan(floor), top.heights.ravel(), floor).reshape(rows, cols)
    return replace(top, heights=floor, surface=surface)


def _filled(path: Path, heights: Array) -> Array:
    """Fill holes with the closest height, with a warning. Raises ``InputError`` for a mesh that is mostly holes."""
    from scipy.ndimage import distance_transform_edt

    holes = np.isnan(heights)
    if holes.mean() > 0.5:
        remedy = "check that Z is up, or give a mesh that covers its rectangle"
        raise refuse(path, "terrain", f"seen from above, {holes.mean():.0%} of it is hole", remedy)
    if holes.any():
        warnings.warn(
            f"{path}: {holes.sum()} of {holes.size} heights are missing, filled from their neighbours", stacklevel=2
        )
        nearest = distance_transform_edt(holes, return_distances=False, return_indices=True)
        heights = heights[tuple(nearest)]
    return heights


def _has_overhangs(top: HeightGrid, surface: Surface) -> bool:
    """Whether ground is hidden below other rock, so that the heights seen from above, ``top``, lose it."""
    from scipy.ndimage import maximum_filter, minimum_filter

    # On steep slopes a sampled height may differ by the relief of the adjacent cells; that is no overhang.
    relief = replace(top, heights=maximum_filter(top.heights, 3) - minimum_filter(top.heights, 3))
    centre = surface.points[surface.ground].mean(axis=1)
    depth = top.height(centre[:, :2]) - centre[:, 2]
    return bool((depth > relief.height(centre[:, :2]) + 1e-3 * max(top.cell)).any())


READERS: dict[str, Callable[[Path, Placement], HeightGrid]] = {
    ".npz": _read_npz,
    ".npy": _read_npy,
    ".png": _read_png,
    **dict.fromkeys((".tif", ".tiff"), _read_geotiff),
    **dict.fromkeys((".obj", ".stl", ".ply", ".glb", ".gltf"), _read_trimesh),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _read_usd),
}
