"""What cameras show: whether a hull is in the picture, and the frames whose picture has nothing but the sky in it."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from vehsim.cameras.path import Surroundings, in_rock

Array = NDArray[np.float64]

BORDER = np.array([xy for xy in product(np.linspace(-1, 1, 9), repeat=2) if np.abs(xy).max() == 1])
"""Places on the border of the picture, from -1 to 1: all ground hangs together, so it shows there if it shows."""
DOWN = np.sin(np.radians(1.0))
"""A sight that goes down by a degree ends on ground or water."""
STEPS = 80
"""Places along a sight above the horizon at which it is compared with the ground."""


def only_sky(
    positions: Array, rotations: Array, half: Array, world: Surroundings, hulls: Iterable[tuple[Array, Array]]
) -> NDArray[np.bool_]:
    """The frames (n,) that show only the sky above ground or water, and none of the ``hulls``: corners (k, 3) m, and
    where they are: T_wh (n, 4, 4), or (1, 4, 4) of what stands.

    ``rotations`` R_wc (n, 3, 3); ``half`` (2,): half the width and height of the picture at a distance of 1.
    """
    rays = np.column_stack([BORDER * half, -np.ones(len(BORDER))])
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ rotations.swapaxes(1, 2)
    sky = (rays[..., 2] > -DOWN).all(axis=1)
    for T_wh, corners in hulls:  # the cheapest question comes first: most cameras show some ground
        k = np.flatnonzero(sky)
        if not len(k):
            return sky
        sky[k] = out_of_view(positions[k], rotations[k], half, T_wh[k if len(T_wh) > 1 else [0]], corners)
    k = np.flatnonzero(sky)
    if len(k) and world.terrain is not None:
        far = np.geomspace(0.5, np.linalg.norm(world.terrain.upper - world.terrain.lower), STEPS)
        places = (positions[k, None, None] + far[:, None] * rays[k, :, None]).reshape(-1, 3)
        ground = in_rock(places, world) | (world.height(places[:, :2]) > places[:, 2])
        sky[k] = ~ground.reshape(len(k), -1).any(axis=1)
    return sky


def out_of_view(positions: Array, rotations: Array, half: Array, T_wh: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether nothing of a hull is in the picture, (n,): ``corners`` (k, 3) m at T_wh (n, 4, 4), or (1, 4, 4).

    ``positions`` (n, 3) m; ``rotations`` and ``half`` as in `only_sky`.
    """
    T_hw = np.linalg.inv(T_wh)
    eyes = (T_hw[:, :3, :3] @ positions[:, :, None] + T_hw[:, :3, 3:])[..., 0]
    return _apart(eyes, T_hw[:, :3, :3] @ rotations, half, corners)


def _apart(eyes: Array, rotations: Array, half: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether a side of the view, or a face of the convex hull of ``corners`` (k, 3), separates the two, (n,).

    A hull that only two edges separate counts as seen, which is rare.
    """
    from scipy.spatial import ConvexHull

    seen = (corners - eyes[:, None]) @ rotations
    depth = -seen[..., 2:]
    beyond = [np.any((side * seen[..., :2] > half * depth).all(axis=1), axis=1) for side in (-1, 1)]
    planes = np.unique(ConvexHull(corners, qhull_options="QJ").equations.round(9), axis=0)
    view = np.column_stack([BORDER[[0, 8, -9, -1]] * half, -np.ones(4)]) @ rotations.swapaxes(1, 2)
    outside = (eyes @ planes[:, :3].T + planes[:, 3] >= 0) & (view @ planes[:, :3].T >= 0).all(axis=1)
    return np.any([*beyond, (depth <= 0).all(axis=(1, 2)), np.any(outside, axis=1)], axis=0)
