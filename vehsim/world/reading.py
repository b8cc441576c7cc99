"""Terrains read from files: shipped terrains, height maps, and meshes sampled by vertical rays.

What belongs here is file formats. A height map's scale stands in a TOML file of the same stem beside it (or in the
``terrain.toml`` that is loaded itself): ``cell`` and ``origin`` in metres, ``range`` the heights of black and white.
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

from vehsim.assets import shipped
from vehsim.errors import InputError, Problem
from vehsim.intake.arrays import read_array, read_arrays
from vehsim.intake.gate import reading, refuse
from vehsim.intake.images import read_picture
from vehsim.intake.meshes import read_triangles
from vehsim.intake.toml import read_toml
from vehsim.world.terrain import MAX_POINTS, Terrain

Array = NDArray[np.float64]

SAMPLES = 50_000
"""Heights sampled from a mesh whose file does not say ``cell``: about 1e5 triangles."""


@dataclass(frozen=True)
class Placement:
    """How a file's heights lie in the world; None is left to the file itself.

    ``cell`` (dx, dy) and ``origin`` (x, y), m; ``range`` heights of black and white, m; ``look`` a USD file.
    """

    file: Path
    cell: tuple[float, float] | None = None
    origin: tuple[float, float] | None = None
    range: tuple[float, float] | None = None
    look: Path | None = None


def read_terrain(source: str | Path) -> Terrain:
    """The shipped terrain called ``source``, or the terrain in the file or folder ``source``. Raises ``InputError``."""
    path = shipped("terrain").get(str(source), Path(os.path.expanduser(source)))
    if path.is_dir():
        path = path / "terrain.toml"
    if not path.is_file():
        close = [f"did you mean {name!r}? " for name in get_close_matches(path.name, shipped("terrain"), n=1)]
        mend = f"{''.join(close)}give one of {', '.join(shipped('terrain'))} or the path of a mesh or height map"
        raise InputError(str(Problem("terrain", "no such terrain or file", mend, str(source))))
    if path.suffix == ".toml":
        heights, placement = _read_toml(path)
        return replace(_read_heights(heights, placement), name=path.parent.name, look=placement.look)
    beside = path.with_suffix(".toml")
    placement = _read_toml(beside)[1] if beside.is_file() else Placement(path)
    terrain = _read_heights(path, placement)
    return replace(terrain, look=placement.look) if placement.look else terrain


def _read_heights(path: Path, placement: Placement) -> Terrain:
    """The terrain in a mesh or height map."""
    if not path.is_file():
        raise refuse(placement.file, "heights", "no such file", "put the file there or mend the path", str(path))
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise refuse(path, "terrain", "unknown kind of file", f"use one of {' '.join(READERS)}", path.suffix)
    with reading(path, "terrain"):
        return reader(path, placement)


def _read_toml(path: Path) -> tuple[Path, Placement]:
    """The file of heights and the placement in a ``terrain.toml`` or in the TOML file beside a height map."""
    table, _ = read_toml(path)
    known = {"schema", "name", "heights", "look", "cell", "origin", "range"}
    for key in table.keys() - known:
        raise refuse(path, key, "unknown key", f"known are {', '.join(sorted(known))}", table[key])
    if table.get("schema", 1) != 1:
        raise refuse(path, "schema", "unknown schema", "this version reads schema 1", table["schema"])
    for key in ("heights", "look"):
        if not isinstance(table.get(key, ""), str):
            raise refuse(path, key, "not a path", "give a file name as a string", table[key])
    look = path.parent / table["look"] if "look" in table else None
    if look is not None and not look.is_file():
        raise refuse(path, "look", "no such file", "put the USD file there or mend the path", table["look"])
    if path.name == "terrain.toml" and "heights" not in table:
        raise refuse(path, "heights", "missing", "name the file of heights, such as heights = 'heights.npz'")
    pairs = {key: _pair(path, key, table) for key in ("cell", "origin", "range")}
    return path.parent / table.get("heights", ""), Placement(path, look=look, **pairs)


def _pair(path: Path, key: str, table: dict[str, Any]) -> tuple[float, float] | None:
    """Two numbers; one number for ``cell`` stands for both."""
    value = table.get(key)
    if value is None:
        return None
    values = [value, value] if key == "cell" and isinstance(value, int | float) else value
    number = isinstance(values, list) and len(values) == 2
    if not number or any(isinstance(v, bool) or not isinstance(v, int | float) for v in values):
        raise refuse(path, key, "not two numbers", f"write {key} = [1.0, 1.0]", value)
    return float(values[0]), float(values[1])


def _grid(path: Path, heights: Array, placement: Placement) -> Terrain:
    """A height map placed as its placement says; centred on the origin when it does not say."""
    heights = np.asarray(heights)
    if heights.ndim != 2 or heights.dtype.kind not in "fiub":
        mend = "give a two-dimensional array of numbers"
        raise refuse(path, "heights", "not a grid of numbers", mend, (heights.shape, str(heights.dtype)))
    if placement.cell is None:
        warnings.warn(f"{path}: no cell size given, taking 1 m; write cell = ... in {path.stem}.toml", stacklevel=2)
    cell = placement.cell or (1.0, 1.0)
    rows, cols = heights.shape
    centred = (-cell[0] * (cols - 1) / 2, -cell[1] * (rows - 1) / 2)
    return Terrain(path.name, heights, placement.origin or centred, cell)


def _read_npy(path: Path, placement: Placement) -> Terrain:
    return _grid(path, read_array(path, "heights"), placement)


def _read_npz(path: Path, placement: Placement) -> Terrain:
    """An archive with ``heights`` and, if it likes, ``cell`` and ``origin``."""
    arrays = read_arrays(path, "heights", ("heights", *_missing(placement)))
    if "heights" not in arrays:
        raise refuse(path, "heights", "missing", "save the array under the name heights")
    heights = arrays.pop("heights")
    own: dict[str, Any] = {key: tuple(np.broadcast_to(array, 2).tolist()) for key, array in arrays.items()}
    return _grid(path, heights, replace(placement, **own))


def _missing(placement: Placement) -> list[str]:
    """What the file itself may still say about its place."""
    return [key for key in ("cell", "origin") if getattr(placement, key) is None]


def _read_png(path: Path, placement: Placement) -> Terrain:
    """A grey picture, 8 or 16 bits, seen from above with +Y up."""
    if placement.range is None:
        mend = f"write range = [0.0, 50.0] (heights of black and white, m) in {path.stem}.toml beside it"
        raise refuse(path, "range", "a picture does not say how high it is", mend)
    grey, mode, _ = read_picture(path, ("L", "I;16", "I;16B", "I"), MAX_POINTS, "save it as 8- or 16-bit grey")
    grey = grey[::-1] / (255.0 if mode == "L" else 65535.0)
    low, high = placement.range
    return _grid(path, low + (high - low) * grey, placement)


PIXEL_SCALE, TIE_POINT = 33550, 33922


def _read_geotiff(path: Path, placement: Placement) -> Terrain:
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


def _read_trimesh(path: Path, placement: Placement) -> Terrain:
    return _sample(path, *read_triangles(path, "terrain"), placement)


def _read_usd(path: Path, placement: Placement) -> Terrain:
    """A stage's meshes from above; the stage is the look as well."""
    return replace(_sample(path, *read_triangles(path, "terrain"), placement), look=path)


def _sample(path: Path, points: Array, faces: NDArray[np.int64], placement: Placement) -> Terrain:
    """Heights of a mesh seen from above: a vertical ray per grid point."""
    import igl

    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low
    if min(size[:2]) < 1e-3 or max(size) > 1e6:
        mend = "terrains are metres, Z up, between 1 mm and 1000 km wide"
        raise refuse(path, "points", "absurd size", mend, tuple(np.round(size, 6).tolist()))
    cell = placement.cell or (float(np.sqrt(size[0] * size[1] / SAMPLES)),) * 2
    cols, rows = (max(2, int(np.floor(size[k] / cell[k] + 1e-6)) + 1) for k in range(2))
    if rows * cols > MAX_POINTS:
        raise refuse(placement.file, "cell", f"more than {MAX_POINTS:,} heights", "give a larger cell", cell)
    x, y = low[0] + cell[0] * np.arange(cols), low[1] + cell[1] * np.arange(rows)
    rays = np.stack([*np.meshgrid(x, y), np.full((rows, cols), high[2] + 1.0)], axis=-1).reshape(-1, 3)
    inset = 1e-7 * size[:2]  # a ray along a border would slip past it
    rays[:, :2] = np.clip(rays[:, :2], low[:2] + inset, high[:2] - inset)
    tree = igl.AABB()
    tree.init(points, faces)
    hit, depth, _ = tree.intersect_ray_first(points, faces, rays, np.tile([0.0, 0.0, -1.0], (len(rays), 1)))
    heights = np.where(hit >= 0, rays[:, 2] - depth, np.nan).reshape(rows, cols)
    terrain = Terrain(path.name, _fill(path, heights), (float(low[0]), float(low[1])), cell)
    _warn_of_overhangs(path, terrain, points, faces)
    return terrain


def _fill(path: Path, heights: Array) -> Array:
    """Holes take the nearest height, with a warning; a mesh that is mostly hole is no terrain."""
    from scipy.ndimage import distance_transform_edt

    holes = np.isnan(heights)
    if holes.mean() > 0.5:
        mend = "is Z up? Give a mesh that covers its rectangle"
        raise refuse(path, "terrain", f"seen from above, {holes.mean():.0%} of it is hole", mend)
    if holes.any():
        warnings.warn(f"{path}: {holes.sum()} of {holes.size} heights are holes, filled from beside", stacklevel=2)
        nearest = distance_transform_edt(holes, return_distances=False, return_indices=True)
        heights = heights[tuple(nearest)]
    return heights


def _warn_of_overhangs(path: Path, terrain: Terrain, points: Array, faces: NDArray[np.int64]) -> None:
    """Say so when rock that faces up lies hidden below other rock: a height field cannot hold it."""
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centre = corners.mean(axis=1)
    # Where the surface is steep a sampled height may differ by the relief of the neighbouring cells: not an overhang.
    from scipy.ndimage import maximum_filter, minimum_filter

    relief = replace(terrain, heights=maximum_filter(terrain.heights, 3) - minimum_filter(terrain.heights, 3))
    depth = terrain.height(centre[:, :2]) - centre[:, 2]
    hidden = (normal[:, 2] > 0) & (depth > relief.height(centre[:, :2]) + 1e-3 * max(terrain.cell))
    if hidden.any():
        warnings.warn(
            f"{path}: overhangs: {hidden.sum()} upward faces lie up to {depth[hidden].max():.2f} m below the surface "
            "seen from above; the terrain is that surface, caves and undercuts are filled",
            stacklevel=2,
        )


READERS: dict[str, Callable[[Path, Placement], Terrain]] = {
    ".npz": _read_npz,
    ".npy": _read_npy,
    ".png": _read_png,
    **dict.fromkeys((".tif", ".tiff"), _read_geotiff),
    **dict.fromkeys((".obj", ".stl", ".ply", ".glb", ".gltf"), _read_trimesh),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _read_usd),
}
