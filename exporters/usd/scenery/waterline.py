"""The water at hulls: its mesh follows their waterlines, and lies below their skins inside them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from itertools import permutations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery.wake import Floating, clip_matrices, clip_places
from vehsim.exporters.usd.scenery.water_grid import FINEST, longest_way

if TYPE_CHECKING:
    from vehsim.exporters.usd.scenery.water_grid import Grid

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SKIN = 0.03
"""Height of lowered water above the bottom of a hull, m."""
ASIDE = np.array([1.0, 0.6, 0.3]) * 1e-6
"""Where rays to a hull's skin start beside their places, m: along an edge of the skin they may miss it."""
COARSE = 0.5
"""Cells longer than this share of a hull's beam may have no corner inside it."""


class Waterline(NamedTuple):
    """How the points of a surface move at hulls.

    The points ``moved`` (k,) lie on a hull's skin, at ``share`` (k,) of the way to the points ``inner`` (k,) inside.
    ``lowered`` (n,) m: how far each point is lowered to the bottom of the hull that it is in.
    """

    moved: Indices
    inner: Indices
    share: Array
    lowered: Array

    def of(self, values: Array) -> Array:
        """Values (n, ...) of the surface where its points have moved to."""
        found, share = values.copy(), self.share.reshape(-1, *[1] * (values.ndim - 1))
        found[self.moved] += share * (values[self.inner] - values[self.moved])
        return found


def waterline(afloat: Mapping[str, Floating], points: Array, grid: Grid, frame: float) -> Waterline:
    """The waterline of all hulls on a surface with ``points`` (n, 3) m.

    Of a cell with a corner inside a hull, the other corners move onto the skin, so that no cell lies on both sides.
    """
    lowered = np.zeros(len(points))
    pairs, shares = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    for vehicle in afloat.values():
        if vehicle.hull is None:
            continue
        T_wr = clip_matrices(vehicle.clip, np.array([frame]))[0]
        own = (points - T_wr[:3, 3]) @ T_wr[:3, :3]
        inner = _within(vehicle.hull, own)
        down = np.tile(-T_wr[2, :3], (len(inner), 1))
        lowered[inner] = np.maximum(_to_skin(vehicle.hull, own[inner], down) - SKIN, 0.0)
        pair = _beside(inner, grid)
        pairs.append(pair)
        shares.append(1.0 - _to_skin(vehicle.hull, own[pair[:, 1]], own[pair[:, 0]] - own[pair[:, 1]]))
    pair, share = np.concatenate(pairs), np.concatenate(shares)
    share[lowered[pair[:, 0]] > 0] = 0.0  # in another hull
    order = np.argsort(share, kind="stable")
    moved, first = np.unique(pair[order, 0], return_index=True)
    return Waterline(moved, pair[order[first], 1], share[order[first]], lowered)


def warn_of_coarse(afloat: Mapping[str, Floating], grid: Grid, frames: Array) -> None:
    """Warn of hulls that are too small for the cells of the surface where they are on ``frames`` (n,)."""
    from scipy.spatial import cKDTree

    tree = cKDTree(grid.xy)
    for name, vehicle in afloat.items():
        cell = float(grid.cells[tree.query(clip_places(vehicle.clip, frames)[0][:, :2])[1]].max())
        enough = COARSE * vehicle.beam
        if cell > enough:
            way = longest_way(enough, float(vehicle.clip.fps))
            remedy = (
                "divide the shot (shot.start_frame, shot.end_frame) so that boats and near cameras stay within about "
                f"{way:.0f} m in each part"
                if way
                else f"give it a deck, as the finest cells have {FINEST:g} m"
            )
            warnings.warn(
                f"{name}: pictures may show water inside its hull, because the mesh of the water has points only every "
                f"{cell:.1f} m there and the hull is {vehicle.beam:.1f} m wide; {remedy}",
                stacklevel=3,
            )


def aboard(vehicle: Floating, places: Array, frame: float) -> Indices:
    """Which ``places`` (n, 3) m in the world are inside a vehicle's hull."""
    if vehicle.hull is None:
        return np.zeros(0, np.int64)
    T_wr = clip_matrices(vehicle.clip, np.array([frame]))[0]
    return _within(vehicle.hull, (places - T_wr[:3, 3]) @ T_wr[:3, :3])


def _within(hull: tuple[Array, Indices], places: Array) -> Indices:
    """Which ``places`` (n, 3) m in a hull's frame are inside its closed surface."""
    import igl

    corners, faces = hull
    near = np.flatnonzero(((places > corners.min(axis=0)) & (places < corners.max(axis=0))).all(axis=1))
    # Summed triangle by triangle: signed_distance's own, fast winding number was wrong on one machine.
    inside = [igl.winding_number(corners, faces, place) > 0.5 for place in places[near]]
    return near[np.array(inside, bool)]


def _beside(inner: Indices, grid: Grid) -> Indices:
    """Pairs (k, 2) of corners of the same cell: one that is not in ``inner``, and one that is."""
    inside = np.zeros(len(grid.xy), bool)
    inside[inner] = True
    pairs = []
    for faces in grid.faces:
        crossed = faces[inside[faces].any(axis=1)]
        for a, b in permutations(range(faces.shape[1]), 2):
            pair = crossed[:, [a, b]]
            pairs.append(pair[~inside[pair[:, 0]] & inside[pair[:, 1]]])
    return np.unique(np.concatenate(pairs), axis=0)


def _to_skin(hull: tuple[Array, Indices], places: Array, ways: Array) -> Array:
    """Share (n,) of ``ways`` (n, 3) m after which they leave a hull from ``places`` (n, 3) m inside; at most all."""
    import igl

    corners, faces = hull
    hits = [igl.ray_mesh_intersect(*ray, corners, faces) for ray in zip(places + ASIDE, ways, strict=True)]
    return np.array([min(nearest[0][1], 1.0) if nearest else 1.0 for nearest in hits])
