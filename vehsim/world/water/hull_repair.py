"""What is repaired in a hull, with a warning: cockpits are closed at the gunwale, and large meshes are simplified."""

from __future__ import annotations

import json
import warnings
from hashlib import sha256
from typing import Any

import numpy as np

from vehsim.runtime.cache import kept, packed, unpacked
from vehsim.world.water.hull_mesh import Array, HullMesh, wetted

LEVELS = 24
"""Heights at which cockpits are looked for. Bisection finds the gunwale."""
SMALL = 2e-3
"""Cockpits and cavities smaller than this share of the hull's volume stay."""
FACES = 2000
"""Hulls with more faces are simplified, if `ERROR` permits."""
ERROR = 2e-3
"""Greatest change of the volume and of its centroid below three waterlines: a share of the volume and of the hull's
length."""


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
    points, faces, texts = unpacked(kept("hull-1", content.hexdigest(), make))
    for text in json.loads(texts.tobytes()):
        warnings.warn(f"{hull.name}{text}", stacklevel=2)
    return hull.replaced(points, faces)


def filled(hull: HullMesh) -> HullMesh:
    """``hull`` with every space that can hold water closed at its rim: the sea enters a boat over its gunwale only."""
    import manifold3d

    solid = manifold3d.Manifold(manifold3d.Mesh64(hull.points, hull.faces.astype(np.uint64)))
    if solid.is_empty():
        warnings.warn(f"{hull.name}: could not be checked for open cockpits: {solid.status()}", stacklevel=3)
        return hull
    low, high = hull.points.min(axis=0), hull.points.max(axis=0)
    room, closed, rim = 0.0, solid, high[2]
    levels = np.linspace(high[2], low[2], LEVELS + 2)[1:-1]
    above = high[2]
    for level in levels:
        spaces = _spaces(closed, low, high, level)
        if sum(space.volume() for space in spaces) > SMALL * hull.volume:
            inside, outside = level, above
            while outside - inside > 1e-4 * (high[2] - low[2]):
                middle = (inside + outside) / 2
                found = _spaces(closed, low, high, middle)
                if sum(space.volume() for space in found) > SMALL * hull.volume:
                    inside, spaces = middle, found
                else:
                    outside = middle
            room += sum(space.volume() for space in spaces)
            rim = min(rim, inside)
            for space in spaces:
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


def _spaces(solid: Any, low: Array, high: Array, level: float) -> list[Any]:
    """The spaces below ``level`` that the solid encloses: parts of a box around it that do not reach its sides."""
    import manifold3d

    margin = 0.1 * (high - low).max()
    size = np.array([*(high - low)[:2] + 2 * margin, level - low[2] + margin])
    box = manifold3d.Manifold.cube(size).translate([*(low - margin)[:2], low[2] - margin])
    parts = (box - solid).decompose()
    return [part for part in parts if part.bounding_box()[0] > low[0] - margin / 2]


def simplified(hull: HullMesh) -> HullMesh:
    """``hull`` with `FACES` faces, or the smallest multiple of this number within `ERROR`. The volume stays exact."""
    count = FACES
    while count < len(hull.faces):
        rough = hull.simplified(count)
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
        count *= 2
    return hull


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
