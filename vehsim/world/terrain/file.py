"""The keys of a ``terrain.toml``, and of the TOML file beside a height map, as a strict table."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Len
from pydantic import Discriminator, Field, Tag

from vehsim.intake.tables import Array, Number, Positive, Table, Text
from vehsim.vehicles.definition.surfaces import SurfaceName

Pair = Annotated[list[Number], Array, Len(2, 2)]
Corners = Annotated[list[Number], Array, Len(4, 4)]
Cell = Annotated[
    Annotated[Positive, Tag("one")] | Annotated[list[Positive], Array, Len(2, 2), Tag("two")],
    Discriminator(lambda value: "two" if isinstance(value, list | tuple) else "one"),
    Field(description="the spacing of the heights in m, above zero: a number, or [x, y]"),
]


class TerrainFile(Table):
    """A ``terrain.toml``, or the TOML file beside a height map."""

    version: Annotated[int, Field(alias="schema", ge=1, le=1)] = 1
    """1, the version of this file format"""
    name: Text | None = None
    """a name"""
    heights: Text | None = None
    """a mesh or height map, relative to this file, such as "heights.npz", or in an installed Python package, such as
    "package:matplotlib/mpl-data/sample_data/jacksboro_fault_dem.npz\""""
    array: Text | None = None
    """the name of the heights in an NPZ"""
    first_row: Literal["south", "north"] | None = None
    """the side of the first row of an NPY or NPZ"""
    look: Text | None = None
    """a USD file that is drawn, relative to this file"""
    shows: SurfaceName | None = None
    """the surface that the look shows, of level ground; vehicles on another one are shown on that one"""
    cell: Cell | None = None
    """the spacing of the heights in m, above zero: a number, or [x, y]"""
    origin: Pair | None = None
    """[x, y] of the first height, in m"""
    crop: Corners | None = None
    """[west, south, east, north] in m: only this part of a height map is read"""
    resample: Positive | None = None
    """a new spacing of the heights in m; if it is larger than the cell, heights are smoothed first"""
    nodata: Number | None = None
    """the value of missing heights in a height map, such as -9999; they are filled from their neighbours"""
    range: Pair | None = None
    """[low, high]: the heights of black and white in a picture, in m"""


class TerrainFolder(TerrainFile):
    """A ``terrain.toml``, which has to name its heights."""

    heights: Text
    """a mesh or height map, relative to this file, such as "heights.npz\""""
