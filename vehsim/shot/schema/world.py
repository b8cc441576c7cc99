"""``[world]`` and its obstacles, water, gusts and contact. The docstring below a key says what to give.

This module holds their shape, as `tables.py` does; `shot/world` makes objects of them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Len
from pydantic import Field

from vehsim.constants import SEA_WATER
from vehsim.intake.tables import AT
from vehsim.shot.schema.tables import (
    Array,
    Heading,
    Metre,
    Name,
    NotNegative,
    Number,
    Place,
    Plane,
    Positive,
    Table,
    Text,
    Wind,
    shipped_or_path,
)


class StandingTable(Table):
    """Common keys of ``[[world.obstacle]]`` tables of standing obstacles."""

    shape: str
    """polygon, ellipse, box, sphere, cone, mesh or vehicle"""
    name: Name | None = None
    """a name of letters, digits and underscores, different for every obstacle"""
    finish: Literal["concrete", "paint", "stripes", "facade", "bands"] | None = None
    """what covers it in pictures: "concrete" in panels of 1 m, plain "paint", warning "stripes" 0.25 m wide, a house's
    "facade" with storeys of about 3 m and no cut window, or the "bands" of a traffic cone; default: concrete, and bands
    for a cone"""
    colour: Annotated[list[Annotated[Number, Field(ge=0, le=1)]], Array, Len(3, 3)] | None = None
    """the colour in pictures, [red, green, blue] from 0 to 1 as a colour picker shows it (sRGB); default: that of the
    finish"""


class UprightTable(StandingTable):
    """Common keys of obstacles between two heights."""

    height: Positive = 1.0
    """the height from bottom to top, in m"""
    base: Metre = 0.0
    """the height of the bottom, in m"""


class PolygonTable(UprightTable):
    """``[[world.obstacle]]`` with ``shape = "polygon"``: a prism."""

    shape: Literal["polygon"]
    """polygon, ellipse, box, sphere, cone, mesh or vehicle"""
    points: Annotated[list[Plane], Array, Len(3, 1000), AT]
    """the corners [x, y] in m in order around the polygon, three or more, convex or not"""


class EllipseTable(UprightTable):
    """``[[world.obstacle]]`` with ``shape = "ellipse"``: an upright cylinder."""

    shape: Literal["ellipse"]
    """polygon, ellipse, box, sphere, cone, mesh or vehicle"""
    centre: Annotated[Plane, AT]
    """the centre [x, y] in m"""
    radii: Annotated[list[Positive], Array, Len(2, 2)]
    """the two radii in m"""
    heading: Heading = 0.0
    """the angle of the first radius from world X in degrees, counter-clockwise"""


class BoxTable(StandingTable):
    """``[[world.obstacle]]`` with ``shape = "box"``."""

    shape: Literal["box"]
    """polygon, ellipse, box, sphere, cone, mesh or vehicle"""
    centre: Place
    """the centre of its bottom, [x, y, z] in m"""
    size: Annotated[list[Positive], Array, Len(3, 3)]
    """the length, width and height in m"""
    heading: Heading = 0.0
    """the angle of the length from world X in degrees, counter-clockwise"""


class SphereTable(StandingTable):
    """``[[world.obstacle]]`` with ``shape = "sphere"``."""

    shape: Literal["sphere"]
    """polygon, ellipse, box, sphere, cone, mesh or vehicle"""
    centre: Place
    """the centre, [x, y, z] in m"""
    radius: Positive
    """the radius in m"""


class ConeTable(StandingTable):
    """``[[world.obstacle]]`` with ``shape = "cone"``: an upright cone, by default the size of a traffic cone."""

    shape: Literal["cone"]
    """polygon, ellipse, box, sphere, cone, mesh or vehicle"""
    centre: Place
    """the centre of its bottom, [x, y, z] in m"""
    radius: Positive = 0.2
    """the radius of its bottom in m"""
    height: Positive = 0.75
    """the height in m"""
    tip: Positive = 0.03
    """the radius of its top in m"""


class MeshTable(StandingTable):
    """``[[world.obstacle]]`` with ``shape = "mesh"``, replaced by the convex hulls of its connected bodies."""

    shape: Literal["mesh"]
    """polygon, ellipse, box, sphere, cone, mesh or vehicle"""
    path: Text
    """a mesh file (OBJ, STL, PLY, GLB, USD) relative to the shot file"""
    position: Place = Field(default=[0.0, 0.0, 0.0])
    """the position of the mesh's origin, [x, y, z] in m"""
    heading: Heading = 0.0
    """the angle of the mesh's X axis from world X in degrees, counter-clockwise"""
    scale: Positive = 1.0
    """the scale relative to the file"""


class VehicleObstacleTable(Table):
    """``[[world.obstacle]]`` with ``shape = "vehicle"``: another vehicle of the shot, in motion."""

    shape: Literal["vehicle"]
    """polygon, ellipse, box, sphere, cone, mesh or vehicle"""
    vehicle: Text
    """the name of the vehicle that the other vehicles avoid"""

    @property
    def name(self) -> str:
        return self.vehicle


ObstacleTable = Annotated[
    PolygonTable | EllipseTable | BoxTable | SphereTable | ConeTable | MeshTable | VehicleObstacleTable,
    Field(discriminator="shape"),
]


class WaveTable(Table):
    """``[[world.water.wave]]``: a train of waves on deep water"""

    height: Annotated[NotNegative, Field(le=40)]
    """the height from trough to crest, in m"""
    length: Annotated[Number, Field(ge=0.05, le=2000)]
    """the length from crest to crest, in m"""
    heading: Heading = 0.0
    """the direction of travel in degrees from world X, counter-clockwise"""
    phase: Heading = 0.0
    """the place of a crest at the start, in degrees before the origin"""


class SeaTable(Table):
    """``[world.water.sea]``: wind waves with a JONSWAP spectrum"""

    height: Annotated[Positive, Field(le=40)]
    """the significant height in m: the mean of the highest third, from trough to crest"""
    period: Annotated[Number, Field(ge=0.2, le=60)] | None = None
    """the peak period in s; default: that of a fully developed sea, 5.1 sqrt(height)"""
    heading: Heading = 0.0
    """the direction of travel in degrees from world X, counter-clockwise"""
    spread: Annotated[NotNegative, Field(le=68)] = 28.0
    """the spread of the waves' directions in degrees: about 28 for a wind sea, 8 for swell, 0 for long crests"""
    peakedness: Annotated[Number, Field(ge=1, le=20)] = 3.3
    """the peak enhancement factor gamma of JONSWAP: 3.3 for a young sea, 1 for a fully developed one
    (Pierson-Moskowitz)"""
    seed: Annotated[int, Field(ge=0)] = 0
    """a whole number; the same seed gives the same sea"""


class VortexTable(Table):
    """``[[world.water.vortex]]``"""

    centre: Annotated[list[Metre], Array, Len(2, 2)]
    """the centre, [x, y] in m"""
    speed: Annotated[Number, Field(ge=-50, le=50)]
    """the greatest speed in m/s, counter-clockwise"""
    radius: Positive
    """the radius at which the speed is greatest, in m"""


class MoleTable(Table):
    """``[[world.water.mole]]``: a line that waves do not cross. Its shape is an obstacle's"""

    line: Annotated[list[Plane], Array, Len(2, 1000)]
    """the places [x, y] in m along it, two or more"""


class WaterTable(Table):
    """``[world.water]``"""

    level: Metre = 0.0
    """the height of the calm surface in m"""
    density: Annotated[Number, Field(ge=1, le=20_000)] = SEA_WATER
    """the density in kg/m^3; fresh water has 1000"""
    wave: Annotated[list[WaveTable], Array, Len(0, 100)] = Field(default=[])
    """[[world.water.wave]] tables"""
    sea: SeaTable | None = None
    """a [world.water.sea] table"""
    choppiness: Annotated[NotNegative, Field(le=1)] = 0.0
    """0 for round waves, 1 for sharp crests and flat troughs (Gerstner)"""
    mole: Annotated[list[MoleTable], Array, Len(0, 100)] = Field(default=[])
    """[[world.water.mole]] tables: waves are lower in their shelter, as they are bent around their ends"""
    grids: Text | None = None
    """an .npz of times, heights, velocities, origin and cell from a liquid solver, relative to the shot file"""
    current: Annotated[list[Annotated[Number, Field(ge=-50, le=50)]], Array, Len(3, 3)] = Field(default=[0.0, 0.0, 0.0])
    """the current [x, y, z] in m/s, world axes"""
    current_depth: Positive | None = None
    """the depth in m at which the current vanishes; default: the current is the same at all depths"""
    vortex: Annotated[list[VortexTable], Array, Len(0, 100)] = Field(default=[])
    """[[world.water.vortex]] tables"""
    height_field: Annotated[Number, Field(ge=0, le=10)] | None = None
    """the cell in m, such as 0.1, of MuJoCo's height field of the water around a hull, or 0 to evaluate the waves'
    formula; default: as fine as the hull needs"""


class GustsTable(Table):
    """``[world.gusts]``"""

    strength: Annotated[NotNegative, Field(le=1)] = 0.15
    """the standard deviation of the wind divided by its mean: 0.1 over open sea, 0.2 over land"""
    period: Annotated[Number, Field(ge=0.1, le=1000)] = 8.0
    """the time scale of the large gusts in s"""
    seed: Annotated[int, Field(ge=0)] = 0
    """a whole number; the same seed gives the same gusts"""


class ContactTable(Table):
    """``[world.contact]``: how flying and floating vehicles touch obstacles, the ground and each other"""

    friction: Annotated[NotNegative, Field(le=10)] = 0.4
    """the Coulomb friction coefficient"""
    restitution: Annotated[Number, Field(ge=0.02, le=1)] = 0.3
    """the ratio of the speeds after and before a bounce, 0.02 to 1"""
    speed: Annotated[Number, Field(ge=0.1, le=200)] = 20.0
    """the greatest closing speed in m/s at which hulls sink in by less than 2 cm; lower values compute faster"""


class WorldTable(Table):
    """``[world]``"""

    terrain: Annotated[Text, shipped_or_path("terrain")] | None = None
    """a shipped terrain's name, or the path of a mesh (OBJ, STL, PLY, GLB, USD) or height map (PNG, NPY, NPZ, GeoTIFF)
    relative to the shot file; default: empty space"""
    wind: Wind = Field(default=[0.0, 0.0, 0.0])
    """the wind [x, y, z] in m/s, world axes, at most 150 m/s in total"""
    gusts: GustsTable | None = None
    """a [world.gusts] table, which makes the wind change with time; default: steady wind"""
    water: WaterTable | None = None
    """a [world.water] table, for vehicles with a hull; default: a boat moves in the plane, on calm water"""
    contact: ContactTable | None = None
    """a [world.contact] table, which makes hulls touch obstacles, ground and each other; default: no contact"""
    obstacle: Annotated[list[ObstacleTable], Array, Len(0, 1000)] = Field(default=[])
    """[[world.obstacle]] tables, each with shape = "polygon", "ellipse", "box", "sphere", "cone", "mesh" or
    "vehicle\""""
