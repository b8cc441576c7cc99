"""The waves that the mesh of a stage's water is too coarse to show: written as numbers, so that shading shows them.

A mesh that reaches the horizon carries long waves further than short ones. The stage has every wave of the sea, and how
long the mesh's cells are at its points; the preview, the page and Blender add to the normals what is missing there. So
relief passes into shading wave by wave, at the same places and times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.world.water.water import Water, Waves

if TYPE_CHECKING:
    from vehsim.delivery.take import Take
    from vehsim.exporters.usd.scenery.water_grid import Grid

Array = NDArray[np.float64]

CARRIED = (2.0, 2.5)
"""Cells per wave: from the second on, the mesh carries a wave as it is; below the first, it shows none of it. Flat
cells show a wave smaller than it is, so what fades sooner would be further from the sea; see docs/derivations.md."""
RIPPLED, CHOP, ASIDE = 1.6, 6, 0.7
"""Between the shortest waves of a sea, which end at a sixteenth of the length of those at its peak, and ripples, which
are up to so many m long, there are so many waves an octave for shading, and this deviation of their directions, rad."""
ROUGHENED = 2.5e-4
"""Mean square slope of an octave of waves, per m/s of wind: Cox and Munk measured 0.0016 for all longer than 0.3 m."""
PREFIX = "vehsim:waves:"
"""Of the attributes of the surface that hold its waves."""
CELL, SHARE = "cell", "share"
"""Primvars: the length of the mesh's cells, m, and the share of the waves that moles leave; without moles it is 1."""


class DistantWaves(NamedTuple):
    """A stage's waves: ``height`` sums ``amplitude cos(number . x + phase - turn * time code)``.

    ``amplitude`` (k,) m, ``number`` (k, 2) rad/m, ``phase`` (k,) rad, ``turn`` (k,) rad per time code; x (n, 2) m: the
    rest places, the texture coordinates times the side of their tile. ``cell`` and ``share`` (n,): see `CELL`;
    ``carried`` (2,): see `CARRIED`. Only the first ``meshed`` waves move the mesh.
    """

    amplitude: Array
    number: Array
    phase: Array
    turn: Array
    cell: Array
    share: Array
    carried: Array
    meshed: int

    def missing(self, some: NDArray[np.int64], cell: Array) -> Array:
        """Share (k, n) of ``some`` (k,) waves that the mesh does not show where its cells are ``cell`` m long."""
        left = 1 - _shown(self.lengths[some, None].astype(cell.dtype) / cell, self.carried)
        left[some >= self.meshed] = 1.0
        return left

    @property
    def lengths(self) -> Array:
        """(k,) m."""
        return np.asarray(2 * np.pi / np.hypot(*self.number.T))

    @property
    def steepness(self) -> Array:
        """Mean square slope (k,) of each wave."""
        return np.asarray((self.amplitude * np.hypot(*self.number.T)) ** 2 / 2)


def carried(waves: Waves, grid: Grid) -> Array:
    """Share (n, k) of each wave that the mesh shows at each of its points."""
    turns = np.maximum(*(np.abs(step @ waves.number.T) for step in grid.steps))  # of phase from point to point
    return _shown(2 * np.pi / np.maximum(turns, 1e-9), CARRIED)


def _shown(cells: Array, carried: Sequence[float] | Array) -> Array:
    least, most = (float(each) for each in carried)
    return np.asarray(np.clip((cells - least) / (most - least), 0.0, 1.0))


def unseen_slopes(water: Water, grid: Grid) -> Array:
    """Mean square slope (n,) of the waves that the mesh does not show."""
    waves = water.surface
    if not isinstance(waves, Waves):
        return np.zeros(len(grid.xy))
    return np.asarray(waves.share(grid.xy)[:, 0] ** 2 * ((1 - carried(waves, grid) ** 2) @ waves.steepness))


def distant_waves(take: Take, grid: Grid, origin: Array | float = 0.0) -> DistantWaves | None:
    """The waves of a take's water on its grid, with places that count from ``origin`` (2,) m; None if they are
    unknown."""
    waves = None if take.world.water is None else take.world.water.surface
    if not isinstance(waves, Waves):
        return None
    every = [waves, *_chop(waves, np.asarray(take.world.wind[:2], float))]
    amplitude, number, phase, omega = (
        np.concatenate([getattr(each, name) for each in every]) for name in ("amplitude", "number", "phase", "omega")
    )
    turn = omega / float(take.fps)
    phase = (phase + (number * origin).sum(axis=1) + turn * first_frame(take)) % (2 * np.pi)
    share, meshed = waves.share(grid.xy)[:, 0], len(waves.amplitude)
    return DistantWaves(amplitude, number, phase, turn, grid.cells, share, np.array(CARRIED), meshed)


def _chop(waves: Waves, wind: Array) -> list[Waves]:
    """Waves too short for those of a sea and too long for ripples, around the direction of the ``wind`` (2,) m/s; zero:
    of that which raises the sea. They have no relief. None without a gap or wind."""
    speed = max(float(np.hypot(*wind)), waves.wind)
    ahead = wind if wind.any() else waves.steepness @ waves.along
    octaves = float(np.log2(2 * np.pi / np.hypot(*waves.number.T).max() / RIPPLED))
    random, count = np.random.default_rng(11), round(CHOP * octaves)
    if speed == 0 or count <= 0:
        return []
    length = RIPPLED * 2 ** (octaves * (np.arange(count) + random.uniform(0.2, 0.8, count)) / count)
    angle = np.arctan2(ahead[1], ahead[0]) + random.normal(0.0, ASIDE, count)
    k = 2 * np.pi / length
    slope = np.sqrt(2 * ROUGHENED * speed / CHOP)
    number = k[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return [Waves(slope / k, number, random.uniform(0, 2 * np.pi, count))]


def first_frame(take: Take) -> int:
    """The frame at which the time of a take's water is zero."""
    return min((clip.start_frame for clip in take.clips.values()), default=take.frames[0])


def author_waves(mesh: Any, waves: DistantWaves, tile: float) -> None:
    """Write the waves onto a surface whose texture coordinates count tiles of ``tile`` m."""
    from pxr import Gf, Sdf, UsdGeom, Vt

    types, prim, primvars = Sdf.ValueTypeNames, mesh.GetPrim(), UsdGeom.PrimvarsAPI(mesh)

    def floats(values: Array) -> Any:
        return Vt.FloatArray.FromNumpy(values.astype(np.float32))

    for name, kind, value in (
        ("amplitude", types.FloatArray, floats(waves.amplitude)),
        ("number", types.Float2Array, Vt.Vec2fArray.FromNumpy(waves.number.astype(np.float32))),
        ("phase", types.FloatArray, floats(waves.phase)),
        ("turn", types.FloatArray, floats(waves.turn)),
        ("carried", types.Float2, Gf.Vec2f(*waves.carried.tolist())),
        ("meshed", types.Int, waves.meshed),
        ("tile", types.Float, tile),
    ):
        prim.CreateAttribute(PREFIX + name, kind, variability=Sdf.VariabilityUniform).Set(value)
    for name, field in ((CELL, waves.cell), (SHARE, waves.share)):
        if name == CELL or (field < 1).any():
            primvars.CreatePrimvar(name, types.FloatArray, UsdGeom.Tokens.vertex).Set(floats(field))


def read_waves(mesh: Any) -> DistantWaves | None:
    """The waves that `author_waves` wrote onto a surface, or None."""
    prim = mesh.GetPrim()
    names = {name: PREFIX + name for name in ("amplitude", "number", "phase", "turn", "carried", "meshed")}
    names |= {name: f"primvars:{name}" for name in (CELL, SHARE)}
    given = {name: prim.GetAttribute(at).Get() for name, at in names.items() if prim.HasAttribute(at)}
    if not given.keys() >= names.keys() - {SHARE}:
        return None
    meshed = given.pop("meshed")
    fields = {name: np.array(values, float) for name, values in given.items()}
    return DistantWaves(**{SHARE: np.ones(len(fields[CELL])), **fields}, meshed=meshed)
