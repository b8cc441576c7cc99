"""What is repaired in a hull, with a warning: cockpits are closed at the gunwale, and large meshes are simplified."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from vehsim.runtime.cache import kept, packed, unpacked
from vehsim.world.water.hull_mesh import Array, HullMesh, wetted

LEVELS = 24
"""Heights at which cockpits are looked for. Bisection finds the gunwale."""
RIM = 1e-4
"""Its precision, as a share of the hull's height."""
SMALL = 2e-3
"""Cockpits and cavities smaller than this share of the hull's volume stay."""
FACES = 2000
"""Hulls with more faces are simplified, if `ERROR` permits."""
ERROR = 2e-3
"""Greatest change of the volume and of its centroid below three waterlines: a share of the volume and of the hull's
length."""
THIN = 2e-4
"""Distance, as a share of the length, by which the surface of a large mesh may move before it is simplified."""


def repaired(hull: HullMesh) -> HullMesh:
    """``hull`` without cockpits and with fewer faces; warns of both. Cached by content, since it takes seconds for a
    hull of many faces."""

    def make() -> bytes:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            made = simplified(filled(hull))
        texts = [str(one.message).removeprefix(hull.name) for one in caught]
        return packed([made.points, made.faces, np.frombuffer(json.dumps(texts).encode(), np.uint8)])

    given = np.ascontiguousarray(hull.points, float), np.ascontiguousarray(hull.faces, np.int64)
    content = sha256(repr([array.shape for array in given]).encode() + given[0].tobytes() + given[1].tobytes())
    points, faces, texts = unpacked(kept("hull-3", content.hexdigest(), make))
    for text in json.loads(texts.tobytes()):
        warnings.warn(f"{hull.name}{text}", stacklevel=2)
    return hull.replaced(points, faces)


def filled(hull: HullMesh) -> HullMesh:
    """``hull`` with every space that can hold water closed at its rim: the sea enters a boat over its gunwale only."""
    solid = _solid(hull)
    if solid.is_empty():
        warnings.warn(f"{hull.name}: could not be checked for open cockpits: {solid.status()}", stacklevel=3)
        return hull
    low, high = hull.points.min(axis=0), hull.points.max(axis=0)
    least, room, closed, rim, above = SMALL * hull.volume, 0.0, solid, high[2], high[2]
    for level in np.linspace(high[2], low[2], LEVELS + 2)[1:-1]:
        spaces = _Spaces(closed, low, high, least)
        if spaces.held(level):
            highest = _highest(spaces.ringed, level, above, RIM * (high[2] - low[2]))
            found = spaces.below(highest)
            if _volume(found) <= least:  # what is ringed there is a passage, or small
                highest = _highest(spaces.held, level, above, RIM * (high[2] - low[2]))
                found = spaces.below(highest)
            room, rim = room + _volume(found), min(rim, highest)
            for space in found:
                closed += space
        above = level
    if closed is solid:
        return hull
    warnings.warn(
        f"{hull.name}: an open hull: the space of {room:.3g} m^3 below its rim, {rim:.3g} m high in the asset's frame,"
        " counts as dry; close the mesh where you want another rim",
        stacklevel=3,
    )
    mesh = closed.to_mesh64()
    return hull.replaced(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, np.int64))


@dataclass(frozen=True)
class _Spaces:
    """The spaces that a solid between the corners ``low`` and ``high`` (3,) encloses; ``least`` m^3 is of interest."""

    solid: Any
    low: Array
    high: Array
    least: float

    def below(self, level: float) -> list[Any]:
        """Those below ``level``: parts of a box around the solid that do not reach its sides."""
        import manifold3d

        margin = 0.1 * (self.high - self.low).max()
        size = np.array([*(self.high - self.low)[:2] + 2 * margin, level - self.low[2] + margin])
        box = manifold3d.Manifold.cube(size).translate([*(self.low - margin)[:2], self.low[2] - margin])
        parts = (box - self.solid).decompose()
        return [part for part in parts if part.bounding_box()[0] > self.low[0] - margin / 2]

    def held(self, level: float) -> bool:
        """Whether those below ``level`` are large enough. They end in holes of the section there, which are found far
        sooner than spaces."""
        return self.ringed(level) and _volume(self.below(level)) > self.least

    def ringed(self, level: float) -> bool:
        """Whether the section at ``level`` has holes as large as those of large spaces."""
        rings = [np.asarray(ring) for ring in self.solid.slice(level).to_polygons()]
        areas = [float((x * (np.roll(y, -1) - np.roll(y, 1))).sum()) / 2 for x, y in (ring.T for ring in rings)]
        return -sum(area for area in areas if area < 0) > self.least / (self.high - self.low)[2]


def _highest(holds: Callable[[float], bool], low: float, high: float, within: float) -> float:
    """The greatest height up to which ``holds`` is true, from ``low``, where it is, to ``high``, where it is not."""
    while high - low > within:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _volume(solids: list[Any]) -> float:
    return float(sum(solid.volume() for solid in solids))


def _solid(hull: HullMesh) -> Any:
    import manifold3d

    return manifold3d.Manifold(
        manifold3d.Mesh64(np.array(hull.points, order="C"), np.array(hull.faces, np.uint64, order="C"))
    )


def simplified(hull: HullMesh) -> HullMesh:
    """``hull`` with `FACES` faces, or the smallest multiple of this number within `ERROR`. The volume stays exact."""
    if len(hull.faces) <= FACES:
        return hull
    lighter, count = _thinned(hull), FACES
    while count < len(hull.faces):
        rough = lighter.simplified(count)
        middle = rough.points.mean(axis=0)
        scaled = rough.replaced(middle + (rough.points - middle) * np.cbrt(hull.volume / rough.volume), rough.faces)
        volume, centre = _differences(hull, scaled)
        if max(volume, centre) <= ERROR:
            warnings.warn(
                f"{hull.name}: {len(hull.faces):,} faces, simplified to {len(scaled.faces):,}: displaced volume within"
                f" {100 * volume:.2g} %, centre of buoyancy within {100 * centre:.2g} % of the length",
                stacklevel=3,
            )
            return scaled
        if count > len(lighter.faces):
            lighter = hull
        count *= 2
    return hull


def _thinned(hull: HullMesh) -> HullMesh:
    """``hull`` without the points of flat and nearly flat places, which is fast: collapsing edges in the best order is
    slow for many of them."""
    solid = _solid(hull)
    if solid.is_empty():
        return hull
    mesh = solid.simplify(THIN * float(np.ptp(hull.points, axis=0).max())).to_mesh64()
    if len(mesh.tri_verts) <= FACES:  # waves are felt at faces: a pontoon's twelve would miss them
        return hull
    return hull.replaced(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, np.int64))


def _differences(one: HullMesh, other: HullMesh) -> tuple[float, float]:
    """Greatest differences of the volumes below three waterlines, over the whole volume, and of the centroids, over the
    length."""
    up, (low, high) = np.array([0.0, 0.0, 1.0]), (one.points[:, 2].min(), one.points[:, 2].max())
    length = float(np.ptp(one.points, axis=0).max())
    volumes, centres = [], []
    for level in low + (high - low) * np.array([0.25, 0.5, 0.75]):
        a, b = (wetted(np.column_stack([h.points, level - h.points[:, 2]]), h.faces) for h in (one, other))
        volumes.append(abs(a.volume(up) - b.volume(up)) / one.volume)
        centres.append(float(np.linalg.norm(a.centroid(up) - b.centroid(up))) / length)
    return max(volumes), max(centres)
