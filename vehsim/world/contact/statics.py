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


def balanced(bodies: Sequence[MovingBody], pairs: Sequence[Held], changes: Sequence[Array], friction: float) -> bool:
    """Whether ``bodies`` that ``pairs`` hold at rest stay so under further wrenches ``changes`` (6,) on each: whether
    other forces at the same places balance them. Bodies that do not touch each other are taken one by one."""
    from scipy.optimize import nnls
    from scipy.sparse.csgraph import connected_components

    needed, linked = -np.array(changes, float), np.eye(len(bodies))
    columns = []
    for a, b, places, normals, forces in pairs:
        cones = pyramids(normals, STICKING * friction)
        column = np.zeros((len(bodies), 6, SIDES * len(places)))
        for k, sign in ((a, 1.0), (b, -1.0)):
            if k is not None:
                linked[a, k] = 1.0
                needed[k] += sign * bodies[k].wrenches(places, forces).sum(axis=0)
                column[k] = sign * bodies[k].wrenches(np.repeat(places, SIDES, axis=0), cones).T
        columns.append((a, column))
    size = np.array([[*3 * [1 / body.body.reach], 1.0, 1.0, 1.0] for body in bodies])
    count, island_of = connected_components(linked, directed=False)
    for island in range(count):
        members = np.flatnonzero(island_of == island)
        wanted = (needed * size)[members].ravel()
        known = [(size[:, :, None] * column)[members] for a, column in columns if island_of[a] == island]
        rows = [column.reshape(len(wanted), -1) for column in [np.zeros((len(members), 6, 1)), *known]]
        try:
            _, left = nnls(np.concatenate(rows, axis=1), wanted)
        except RuntimeError:  # too many iterations
            return False
        if left > UNBALANCED * np.linalg.norm(wanted):
            return False
    return True


def pyramids(normals: Array, friction: float) -> Array:
    """Edges (n SIDES, 3) of pyramids inside the cones of friction around ``normals`` (n, 3)."""
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    aside = np.multiply.outer(np.cos(angles), first) + np.multiply.outer(np.sin(angles), np.cross(normals, first))
    return np.asarray((normals + friction * aside).swapaxes(0, 1).reshape(-1, 3))
