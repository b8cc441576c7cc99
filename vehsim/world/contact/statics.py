"""Whether contacts can hold bodies at rest: forces within cones of friction that balance given wrenches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehsim.world.contact.bodies import MovingBody

Array = NDArray[np.float64]
Held = tuple[int, int | None, Array, Array, Array]
"""A touching pair: a vehicle, another one or None, places (n, 3) m, normals (n, 3) towards the first, and forces (n, 3)
N on it."""

STICKING = 0.95
"""Share of friction that may be needed."""
UNBALANCED = 1e-6
"""Share of a wrench that may be left, by round-off."""
SIDES = 8
"""Edges of the pyramids that replace the cones, inside them."""


def balanced(
    bodies: Sequence[MovingBody],
    islands: Sequence[int],
    pairs: Sequence[Held],
    changes: Sequence[Array],
    friction: float,
) -> list[bool]:
    """Whether each of ``bodies`` that ``pairs`` hold at rest stays so under further wrenches ``changes`` (6,) on each:
    whether other forces at the same places balance them. ``islands``: equal numbers for bodies that touch each
    other."""
    from scipy.optimize import nnls

    needed, island_of, found = -np.array(changes, float), np.asarray(islands), np.ones(len(bodies), bool)
    disturbed = set(island_of[needed.any(axis=1)])
    columns = []
    for a, b, places, normals, forces in pairs:
        cones = pyramids(normals, STICKING * friction)
        column = np.zeros((len(bodies), 6, SIDES * len(places)))
        for k, sign in ((a, 1.0), (b, -1.0)):
            if k is not None:
                needed[k] += sign * bodies[k].wrenches(places, forces).sum(axis=0)
                column[k] = sign * bodies[k].wrenches(np.repeat(places, SIDES, axis=0), cones).T
        columns.append((a, column))
    size = np.array([[*3 * [1 / body.body.reach], 1.0, 1.0, 1.0] for body in bodies])
    for island in disturbed:
        members = np.flatnonzero(island_of == island)
        wanted = (needed * size)[members].ravel()
        known = [(size[:, :, None] * column)[members] for a, column in columns if island_of[a] == island]
        rows = [column.reshape(len(wanted), -1) for column in [np.zeros((len(members), 6, 1)), *known]]
        try:
            _, left = nnls(np.concatenate(rows, axis=1), wanted)
        except RuntimeError:  # too many iterations
            left = np.inf
        found[members] = left <= UNBALANCED * np.linalg.norm(wanted)
    return [bool(each) for each in found]


def pyramids(normals: Array, friction: float) -> Array:
    """Edges (n SIDES, 3) of pyramids inside the cones of friction around ``normals`` (n, 3)."""
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    aside = np.multiply.outer(np.cos(angles), first) + np.multiply.outer(np.sin(angles), np.cross(normals, first))
    return np.asarray((normals + friction * aside).swapaxes(0, 1).reshape(-1, 3))
