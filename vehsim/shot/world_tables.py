"""``[world]`` and what stands in it: obstacles, water, gusts, contact. The docstring below a key says what to give.

What belongs here is their shape, as in `model.py`; `obstacles.py` and `water.py` make things of them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Len
from pydantic import Field

from vehsim.shot.model import (
    Array,
    Heading,
    Metre,
    Name,
    NotNegative,
    Number,
    Plane,
    Point,
    Positive,
    Table,
    Text,
    Wind,
    shipped_or_path,
)


class StandingTable(Table):
    """What ``[[world.obstacle]]`` tables of things that do not move share."""

    shape: str
    """polygon, ellipse, box, sphere, mesh or vehicle"""
    name: Name | None = None
    """a name of letters, digits and underscores, one of its own for every obstacle"""


class UprightTable(StandingTable):
    """Those between two heights, too."""

    height: Positive = 1.0
    """how high it is, in m"""
    base: Metre = 0.0
    """the height of its bottom, in m"""


class PolygonTable(UprightTable):
    """``[[world.obstacle]]`` with ``shape = "polygon"``: a prism."""

    shape: Literal["polygon"]
    """polygon, ellipse, box, sphere, mesh or vehicle"""
    points: Annotated[list[Plane], Array, Len(3, 1000)]
    """the corners [x, y] in m in order around it, three or more, convex or not"""


class EllipseTable(UprightTable):
    """``[[world.obstacle]]`` with ``shape = "ellipse"``: an upright cylinder."""

    shape: Literal["ellipse"]
    """polygon, ellipse, box, sphere, mesh or vehicle"""
    centre: Plane
    """its middle [x, y] in m"""
    radii: Annotated[list[Positive], Array, Len(2, 2)]
    """its two radii in m"""
    heading: Heading = 0.0
    """degrees by which the first radius is turned from world X, counter-clockwise"""


class BoxTable(StandingTable):
    """``[[world.obstacle]]`` with ``shape = "box"``."""

    shape: Literal["box"]
    """polygon, ellipse, box, sphere, mesh or vehicle"""
    centre: Point
    """the middle of its bottom, [x, y, z] in m"""
    size: Annotated[list[Positive], Array, Len(3, 3)]
    """its length, width and height in m"""
    heading: Heading = 0.0
    """degrees by which its length is turned from world X, counter-clockwise"""


class SphereTable(StandingTable):
    """``[[world.obstacle]]`` with ``shape = "sphere"``."""

    shape: Literal["sphere"]
    """polygon, ellipse, box, sphere, mesh or vehicle"""
    centre: Point
    """its middle, [x, y, z] in m"""
    radius: Positive
    """in m"""


class MeshTable(StandingTable):
    """``[[world.obstacle]]`` with ``shape = "mesh"``: kept clear of as the convex hulls of its connected bodies."""

    shape: Literal["mesh"]
    """polygon, ellipse, box, sphere, mesh or vehicle"""
    path: Text
    """a mesh file (OBJ, STL, PLY, GLB, USD) relative to the shot file"""
    position: Point = Field(default=[0.0, 0.0, 0.0])
    """where the mesh's origin stands, [x, y, z] in m"""
    heading: Heading = 0.0
    """degrees by which it is turned from world X, counter-clockwise"""
    scale: Positive = 1.0
    """how many times larger it is than in its file"""


class VehicleObstacleTable(Table):
    """``[[world.obstacle]]`` with ``shape = "vehicle"``: another vehicle of the shot, on its way."""

    shape: Literal["vehicle"]
    """polygon, ellipse, box, sphere, mesh or vehicle"""
    vehicle: Text
    """the name of the vehicle that the others keep clear of"""

    @property
    def name(self) -> str:
        return self.vehicle


ObstacleTable = Annotated[
    PolygonTable | EllipseTable | BoxTable | SphereTable | MeshTable | VehicleObstacleTable,
    Field(discriminator="shape"),
]


class WaveTable(Table):
    """``[[world.water.wave]]``: a train of waves on deep water"""

    height: Annotated[NotNegative, Field(le=40)]
    """from trough to crest, in m"""
    length: Annotated[Number, Field(ge=0.05, le=2000)]
    """from crest to crest, in m"""
    heading: Heading = 0.0
    """where it runs to: degrees from world X, counter-clockwise"""
    phase: Heading = 0.0
    """where the crest stands at the start: degrees before the origin"""


class SeaTable(Table):
    """``[world.water.sea]``: wind waves with a JONSWAP spectrum"""

    height: Annotated[Positive, Field(le=40)]
    """the significant height in m: the mean of the highest third, from trough to crest"""
    period: Annotated[Number, Field(ge=0.2, le=60)] | None = None
    """the period of the peak in s; that of a fully developed sea, 5.1 sqrt(height), unless given"""
    heading: Heading = 0.0
    """where it runs to: degrees from world X, counter-clockwise"""
    spread: Annotated[NotNegative, Field(le=68)] = 28.0
    """how far its waves stray from there, in degrees: about 28 for a wind sea, 8 for swell, 0 for long crests"""
    peakedness: Annotated[Number, Field(ge=1, le=20)] = 3.3
    """JONSWAP's gamma: 3.3 for a young sea, 1 for a fully developed one (Pierson-Moskowitz)"""
    seed: Annotated[int, Field(ge=0)] = 0
    """a whole number: the same one gives the same sea"""


class VortexTable(Table):
    """``[[world.water.vortex]]``"""

    centre: Annotated[list[Metre], Array, Len(2, 2)]
    """its middle, [x, y] in m"""
    speed: Annotated[Number, Field(ge=-50, le=50)]
    """its fastest in m/s, counter-clockwise"""
    radius: Positive
    """where it is fastest, in m"""


class WaterTable(Table):
    """``[world.water]``"""

    level: Metre = 0.0
    """the height of the calm surface in m"""
    density: Annotated[Number, Field(ge=1, le=20_000)] = 1025.0
    """in kg/m^3; fresh water has 1000"""
    wave: Annotated[list[WaveTable], Array, Len(0, 100)] = Field(default=[])
    """[[world.water.wave]] tables"""
    sea: SeaTable | None = None
    """a [world.water.sea] table"""
    choppiness: Annotated[NotNegative, Field(le=1)] = 0.0
    """0 for round waves, 1 for sharp crests and flat troughs (Gerstner)"""
    grids: Text | None = None
    """an .npz of times, heights, velocities, origin and cell from a liquid solver, relative to the shot file"""
    current: Annotated[list[Annotated[Number, Field(ge=-50, le=50)]], Array, Len(3, 3)] = Field(default=[0.0, 0.0, 0.0])
    """the current [x, y, z] in m/s, world axes"""
    current_depth: Positive | None = None
    """the depth in m where the current has faded to nothing; it reaches down for ever unless given"""
    vortex: Annotated[list[VortexTable], Array, Len(0, 100)] = Field(default=[])
    """[[world.water.vortex]] tables"""
    height_field: Annotated[Number, Field(ge=0, le=10)] | None = None
    """the cell in m, such as 0.1, of the height field in MuJoCo that says where the water stands over a hull, or 0 to
    ask the waves' own formula instead; as fine as the hull needs unless given"""


class GustsTable(Table):
    """``[world.gusts]``"""

    strength: Annotated[NotNegative, Field(le=1)] = 0.15
    """standard deviation of the wind over its mean: 0.1 over open sea, 0.2 over land"""
    period: Annotated[Number, Field(ge=0.1, le=1000)] = 8.0
    """time scale of the large gusts in s"""
    seed: Annotated[int, Field(ge=0)] = 0
    """a whole number: the same one gives the same gusts"""


class ContactTable(Table):
    """``[world.contact]``: how what flies and floats touches obstacles, the ground and each other"""

    friction: Annotated[NotNegative, Field(le=10)] = 0.4
    """Coulomb's coefficient"""
    restitution: Annotated[Number, Field(ge=0.02, le=1)] = 0.3
    """speed after a bounce over speed before, 0.02 to 1"""
    speed: Annotated[Number, Field(ge=0.1, le=200)] = 20.0
    """the fastest meeting in m/s that is kept from sinking in by 2 cm; less of it computes faster"""


class WorldTable(Table):
    """``[world]``"""

    terrain: Annotated[Text, shipped_or_path("terrain")] | None = None
    """a shipped terrain's name, or the path of a mesh (OBJ, STL, PLY, GLB, USD) or height map (PNG, NPY, NPZ, GeoTIFF)
    relative to the shot file; empty space unless given"""
    wind: Wind = Field(default=[0.0, 0.0, 0.0])
    """the wind [x, y, z] in m/s, world axes, at most 150 m/s in all"""
    gusts: GustsTable | None = None
    """a [world.gusts] table: the wind changes with time; it is steady unless given"""
    water: WaterTable | None = None
    """a [world.water] table, for vehicles with a hull; a boat glides on calm water, level, unless given"""
    contact: ContactTable | None = None
    """a [world.contact] table: hulls touch obstacles, ground and each other; they pass through unless given"""
    obstacle: Annotated[list[ObstacleTable], Array, Len(0, 1000)] = Field(default=[])
    """[[world.obstacle]] tables, each with shape = "polygon", "ellipse", "box", "sphere", "mesh" or "vehicle\""""
