"""Read terrains from files: shipped terrains, height maps, and meshes sampled by vertical rays.

The scale of a height map is in a TOML file of the same stem beside it (or in the ``terrain.toml`` that is loaded):
``cell`` and ``origin`` in metres, ``range`` the heights of black and white; ``crop``, ``resample``, ``nodata``;
``array`` and ``first_row`` for arrays of others.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.assets import described, description
from vehsim.errors import InputError
from vehsim.intake.arrays import Window, read_array, read_arrays, read_shape
from vehsim.intake.foreign import reading, refuse
from vehsim.intake.images import read_header, read_pixels
from vehsim.intake.meshes import read_triangles
from vehsim.intake.tiff import read_tiff, read_tiff_header
from vehsim.intake.toml import lines_in
from vehsim.intake.usd import SUFFIXES, dependencies
from vehsim.runtime.cache import kept
from vehsim.world.terrain.grid import MAX_POINTS, HeightGrid
from vehsim.world.terrain.surface import BELOW, LEVELS, LIFT, TerrainSurface, looks_up, surface_of

Array = NDArray[np.float64]

MAX_SOURCE = 150_000_000
"""Largest number of heights that are resampled."""
PACKAGE = "package:"
"""Before the path of heights in an installed Python package."""
SAMPLES = 50_000
"""Number of heights sampled from a mesh without ``cell``: about 1e5 triangles."""
MOST_LAYERS = 50
"""Largest area of a mesh's faces, copies left out, relative to the surface of the box around it. Rock with caves and
trees stays below 10; each point's side of the surface costs time in proportion."""


@dataclass(frozen=True)
class Placement:
    """The placement of a file's heights in the world; None: from the file itself.

    ``cell`` (dx, dy) and ``origin`` (x, y), m; ``range`` heights of black and white, m; ``look`` a USD file, which
    ``shows`` a surface under tyres. Of a height map, ``crop`` (west, south, east, north) m is the part that is read,
    ``resample`` m the new spacing, and ``nodata`` the value of missing heights. ``array`` is the name of the heights in
    an archive, ``first_row`` "south" or "north".
    """

    file: Path
    cell: tuple[float, float] | None = None
    origin: tuple[float, float] | None = None
    range: tuple[float, float] | None = None
    look: Path | None = None
    crop: tuple[float, float, float, float] | None = None
    resample: float | None = None
    nodata: float | None = None
    array: str | None = None
    first_row: str | None = None
    shows: str | None = None


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
        return replace(_read_map(heights, placement), name=path.parent.name, look=placement.look, shows=placement.shows)
    beside = path.with_suffix(".toml")
    placement = _read_toml(beside)[1] if beside.is_file() and not _is_shot(beside) else Placement(path)
    terrain = _read_map(path, placement)
    return replace(terrain, look=placement.look, shows=placement.shows) if placement.look else terrain


def _is_shot(path: Path) -> bool:
    """Whether a TOML file beside a mesh or height map is a shot that happens to have its name."""
    from vehsim.errors import ShotError
    from vehsim.intake.toml import read_toml

    try:
        return "shot" in read_toml(path)[0]
    except ShotError:
        return False  # its reader reports it


def _read_map(path: Path, placement: Placement) -> HeightGrid:
    """The terrain in a mesh or height map."""
    if not path.is_file():
        raise refuse(placement.file, "heights", "no such file", "put the file there or correct the path", str(path))
    if path.suffix.lower() not in READERS:
        raise refuse(path, "terrain", "unknown kind of file", f"use one of {' '.join(READERS)}", path.suffix)
    reader, keys = READERS[path.suffix.lower()]
    for field in fields(placement):
        if field.name not in ("file", "look", "shows", *keys) and getattr(placement, field.name) is not None:
            said = f"{field.name} has no effect on a {path.suffix} file; it uses {', '.join(keys)}"
            warnings.warn(f"{placement.file}: {said}", stacklevel=2)
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
    pairs: dict[str, Any] = {key: _pair(table.get(key)) for key in ("cell", "origin", "range")}
    crop: Any = tuple(map(float, table["crop"])) if "crop" in table else None
    others = {key: table.get(key) for key in ("resample", "nodata", "array", "first_row", "shows")}
    heights = _heights_file(path, table["heights"]) if "heights" in table else path
    return heights, Placement(path, look=look, crop=crop, **others, **pairs)


def _heights_file(path: Path, given: str) -> Path:
    """The file that ``heights`` of the TOML file ``path`` names, beside it or in an installed package, which is not
    imported."""
    if not given.startswith(PACKAGE):
        return path.parent / given
    package, _, inside = given.removeprefix(PACKAGE).partition("/")
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    if spec is None or not spec.submodule_search_locations:
        with lines_in(path):
            raise refuse(path, "heights", f"the Python package {package!r} is not installed", "install it", given)
    return Path(next(iter(spec.submodule_search_locations)), inside)


def _pair(value: Any) -> tuple[float, float] | None:
    """Two numbers; one number stands for both."""
    if value is None:
        return None
    x, y = value if isinstance(value, list) else (value, value)
    return float(x), float(y)


def _grid(path: Path, shape: tuple[int, ...], placement: Placement, read: Callable[[Window], Array]) -> HeightGrid:
    """A height map of ``shape`` (rows, columns), whose window ``read`` returns, +Y up; by default centred on the
    origin."""
    if len(shape) != 2 or min(shape) < 2:
        raise refuse(path, "heights", "not a grid of at least 2 x 2", "give one height per (row, column)", shape)
    if placement.cell is None:
        warnings.warn(
            f"{path}: no cell size is given, so 1 m is used; write cell = ... in {path.stem}.toml", stacklevel=2
        )
    cell = placement.cell or (1.0, 1.0)
    origin = placement.origin or (-cell[0] * (shape[1] - 1) / 2, -cell[1] * (shape[0] - 1) / 2)
    window = _window(shape, origin, cell, placement)
    first, last, left, right = window
    if (last - first) * (right - left) > (MAX_SOURCE if placement.resample else MAX_POINTS):
        remedy = f"write crop = [west, south, east, north] or resample = ... in {path.stem}.toml"
        raise refuse(path, "size", "too many heights", remedy, (last - first, right - left))
    heights = np.asarray(read(window))
    if heights.dtype.kind not in "fiub":
        raise refuse(path, "heights", "not a grid of numbers", "give a two-dimensional array", str(heights.dtype))
    heights = heights.astype(float)
    if placement.nodata is not None:
        heights[heights == placement.nodata] = np.nan
    heights = _filled(path, heights)
    origin = (origin[0] + left * cell[0], origin[1] + first * cell[1])
    if placement.resample is not None:
        heights, cell = _resampled(heights, cell, placement.resample)
    return HeightGrid(path.name, heights, origin, cell)


def _window(shape: tuple[int, ...], origin: Any, cell: Any, placement: Placement) -> Window:
    """The first and last row and column, the last ones excluded, that cover the ``crop`` of a height map."""
    if placement.crop is None:
        return 0, shape[0], 0, shape[1]
    crop = np.reshape(placement.crop, (2, 2))
    low = np.clip(np.floor((crop[0] - origin) / cell + 1e-9), 0, None).astype(int)
    high = np.minimum(np.ceil((crop[1] - origin) / cell - 1e-9).astype(int) + 1, shape[::-1])
    if not np.isfinite(crop).all() or (high - low < 2).any():
        end = np.asarray(origin) + np.asarray(cell) * (np.array(shape[::-1]) - 1)
        remedy = f"give [west, south, east, north]; the heights reach from {tuple(origin)} to {tuple(end.tolist())}"
        raise refuse(placement.file, "crop", "no part of the height map", remedy, list(placement.crop))
    return int(low[1]), int(high[1]), int(low[0]), int(high[0])


def _resampled(heights: Array, cell: tuple[float, float], spacing: float) -> tuple[Array, tuple[float, float]]:
    """Heights at a new ``spacing`` m; before a larger one, detail that it cannot show is smoothed."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    steps = np.array([spacing / cell[1], spacing / cell[0]])
    spread = np.where(steps > 1, steps / 2, 0.0)
    around = np.ceil(4 * spread).astype(int)  # as far as the filter reaches
    # mirrored through its edge, a slope goes on there; repeating the last height would flatten it
    padded = np.pad(heights, [(n, n) for n in around], mode="reflect", reflect_type="odd")
    smooth = gaussian_filter(padded, spread)[
        tuple(slice(n, size + n) for n, size in zip(around, heights.shape, strict=True))
    ]
    counts = np.floor((np.array(heights.shape) - 1) / steps + 1e-9).astype(int) + 1
    if min(counts) < 2 or np.prod(counts, dtype=float) > MAX_POINTS:
        remedy = f"give a spacing that makes between 2 x 2 and {MAX_POINTS:,} heights"
        raise InputError("not a spacing for these heights", remedy, key="resample", value=spacing)
    at = np.meshgrid(*(step * np.arange(count) for step, count in zip(steps, counts, strict=True)), indexing="ij")
    return map_coordinates(smooth, at, order=1, mode="nearest"), (spacing, spacing)


def _read_npy(path: Path, placement: Placement) -> HeightGrid:
    return _array(path, read_shape(path, "heights"), placement, lambda window: read_array(path, "heights", window))


def _read_npz(path: Path, placement: Placement) -> HeightGrid:
    """An archive with heights and optionally ``cell`` and ``origin``."""
    name = placement.array or "heights"
    arrays = read_arrays(path, "heights", (name, *_missing(placement)))
    if name not in arrays:
        remedy = f"save the array under the name {name}, or write array = its name in {path.stem}.toml"
        raise refuse(path, name, "missing", remedy)
    heights = arrays.pop(name)
    own: dict[str, Any] = {key: tuple(np.broadcast_to(array, 2).tolist()) for key, array in arrays.items()}
    return _array(path, heights.shape, replace(placement, **own), lambda w: heights[w[0] : w[1], w[2] : w[3]])


def _array(path: Path, shape: tuple[int, ...], placement: Placement, read: Callable[[Window], Array]) -> HeightGrid:
    """A height map in an array, whose first row is the southernmost by default."""
    return (_north_first if placement.first_row == "north" else _grid)(path, shape, placement, read)


def _missing(placement: Placement) -> list[str]:
    """The placement that the file itself may still give."""
    return [key for key in ("cell", "origin") if getattr(placement, key) is None]


def _north_first(
    path: Path, shape: tuple[int, ...], placement: Placement, read: Callable[[Window], Array]
) -> HeightGrid:
    """A height map of ``shape`` (rows, columns), whose first row is the northernmost; ``read`` returns a window of
    it."""
    rows = shape[0]
    return _grid(path, shape, placement, lambda w: read((rows - w[1], rows - w[0], *w[2:]))[::-1])


def _read_png(path: Path, placement: Placement) -> HeightGrid:
    """A grey picture with 8 or 16 bits, seen from above with +Y up; ``nodata`` is the value of a pixel."""
    if placement.range is None:
        remedy = f"write range = [0.0, 50.0] (heights of black and white, m) in {path.stem}.toml beside it"
        raise refuse(path, "range", "a picture does not contain its heights", remedy)
    header = read_header(path, ("L", "I;16", "I;16B", "I"), "save it as 8- or 16-bit grey")
    (low, high), white = placement.range, 255.0 if header.mode == "L" else 65535.0
    missing = placement.nodata

    def read(window: Window) -> Array:
        grey = read_pixels(path, window)
        return np.where(grey == missing, np.nan, low + (high - low) * grey / white)

    return _north_first(path, header.shape, replace(placement, nodata=None), read)


def _read_geotiff(path: Path, placement: Placement) -> HeightGrid:
    """Heights in metres in a projected coordinate system; the first row is the northernmost."""
    header = read_tiff_header(path)
    scale, tie = header.scale, header.tie
    cell = placement.cell or ((float(scale[0]), float(scale[1])) if scale else None)
    if cell is not None and min(cell) < 1e-3:
        raise refuse(path, "cell", "looks like degrees", "reproject to a metric coordinate system, such as UTM", cell)
    if placement.origin is None and tie is not None and cell is not None:
        x, y = tie[3] - tie[0] * cell[0], tie[4] + tie[1] * cell[1]
        corner = (float(x) + cell[0] / 2, float(y) - cell[1] * (header.shape[0] - 0.5))  # pixels are areas
        placement = replace(placement, origin=corner)
    if placement.nodata is None:
        placement = replace(placement, nodata=header.nodata)
    return _north_first(path, header.shape, replace(placement, cell=cell), lambda window: read_tiff(path, window))


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
    surface = surface_of(points, faces)
    if (layers := _layers(surface, size)) > MOST_LAYERS:
        found = f"its faces are {layers:.0f} times as large as the box around it: many surfaces lie over each other"
        raise refuse(path, "terrain", found, "keep one of them", None)
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
    if not _has_overhangs(top, surface, rays[:, :2]):
        return top
    floor = _floor(surface, rays[:, :2])
    floor = np.where(np.isnan(floor), top.heights.ravel(), floor).reshape(rows, cols)
    return replace(top, heights=floor, surface=surface)


def _floor(surface: TerrainSurface, xy: Array) -> Array:
    """The floor (n,) m of a surface at ``xy`` (n, 2) m, cached: every process that reads the terrain asks for it."""
    made_of = (surface.content_hash, hashlib.sha256(xy.tobytes()).hexdigest())
    return np.frombuffer(kept("floor-1", made_of, lambda: surface.floor(xy).tobytes()))


def _layers(surface: TerrainSurface, size: Array) -> float:
    """Area of the faces of a surface over that of the box of ``size`` (3,) m around it."""
    x, y, z = size
    return float(np.linalg.norm(surface.normals, axis=1).sum() / 2 / (2 * (x * y + y * z + z * x)))


def _filled(path: Path, heights: Array) -> Array:
    """Fill holes with the closest height, with a warning. Raises ``InputError`` for heights that are mostly holes."""
    holes = np.isnan(heights)
    if holes.mean() > 0.5:
        remedy = "crop it; for a mesh, check that Z is up and that it covers its rectangle"
        raise refuse(path, "terrain", f"seen from above, {holes.mean():.0%} of it is missing", remedy)
    if holes.any():
        from scipy.ndimage import distance_transform_edt  # it takes half a second to load

        warnings.warn(
            f"{path}: {holes.sum()} of {holes.size} heights are missing, filled from their neighbours", stacklevel=2
        )
        nearest = distance_transform_edt(holes, return_distances=False, return_indices=True)
        heights = heights[tuple(nearest)]
    return heights


def _has_overhangs(top: HeightGrid, surface: TerrainSurface, xy: Array) -> bool:
    """Whether ground is hidden below other rock, so that the heights seen from above, ``top``, lose it.

    Looks at the middle of each face, and at ``xy`` (n, 2) m because faces may be large.
    """
    import igl
    from scipy.ndimage import maximum_filter, minimum_filter

    # On steep slopes a sampled height may differ by the relief of the adjacent cells; that is no overhang.
    relief = replace(top, heights=maximum_filter(top.heights, 3) - minimum_filter(top.heights, 3))

    def hidden(places: Array) -> Array:
        depth = top.height(places[:, :2]) - places[:, 2]
        return places[depth > relief.height(places[:, :2]) + 1e-3 * max(top.cell)]

    upward = np.ascontiguousarray(surface.faces[looks_up(surface.points[surface.faces])])
    if not len(upward):
        return False
    if surface.free_above(hidden(surface.points[upward].mean(axis=1))).any():
        return True
    tree = igl.AABB()
    tree.init(surface.points, upward)
    places = np.column_stack([xy, np.full(len(xy), surface.points[:, 2].min() - BELOW)])
    for _ in range(LEVELS):  # from below, until it is free or seen from above
        up = np.tile([0.0, 0.0, 1.0], (len(places), 1))
        hit, far, _ = tree.intersect_ray_first(surface.points, upward, np.ascontiguousarray(places), up)
        found = np.asarray(hit) >= 0
        places = hidden(places[found] + np.asarray(far)[found, None] * [0.0, 0.0, 1.0])
        if surface.free_above(places).any():
            return True
        if not len(places):
            return False
        places = places + LIFT
    return False


MAP = ("cell", "origin", "crop", "resample", "nodata")
READERS: dict[str, tuple[Callable[[Path, Placement], HeightGrid], tuple[str, ...]]] = {
    ".npz": (_read_npz, (*MAP, "array", "first_row")),
    ".npy": (_read_npy, (*MAP, "first_row")),
    ".png": (_read_png, (*MAP, "range")),
    **dict.fromkeys((".tif", ".tiff"), (_read_geotiff, MAP)),
    **dict.fromkeys((".obj", ".stl", ".ply", ".glb", ".gltf"), (_read_trimesh, ("cell",))),
    **dict.fromkeys(SUFFIXES, (_read_usd, ("cell",))),
}
"""By suffix, the reader of a terrain and the keys of its TOML file that it uses."""
