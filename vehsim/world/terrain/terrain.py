"""Terrain: a height grid, by the name of a shipped one or from a file."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from vehsim.world.terrain.grid import HeightGrid
from vehsim.world.terrain.reading import read_heights


class Terrain(HeightGrid):
    """A height field: ``heights`` (rows, cols) m, row = +Y, column = +X.

    ``origin`` (x, y) of ``heights[0, 0]`` and ``cell`` (dx, dy), m. ``look``: a USD file with the mesh, material and
    texture of this terrain, or None. Each cell is split along (r, c)-(r+1, c+1), as in MuJoCo. ``surface``: the rock of
    a terrain with overhangs, whose ``heights`` are those of the lowest ground; None for a height field.
    """

    @classmethod
    def load(cls, source: str | Path) -> Terrain:
        """The terrain called ``source`` ("canyon", "flat"), or read from a mesh, a height map or a ``terrain.toml``.

        Meshes: OBJ, STL, PLY, GLB, USD. Heights: PNG, NPY, NPZ, GeoTIFF. Raises ``InputError``.
        """
        grid = read_heights(source)
        return cls(*(getattr(grid, field.name) for field in fields(grid)))
