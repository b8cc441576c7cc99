"""Potential flow around a hull at rest: its added mass, and how waves act on it.

A panel method for Laplace's equation with ``phi = 0`` at the surface of the water, the limit of high frequencies:
constant potentials on flat triangles and their mirror images, ``2 pi phi + D phi = -S v_n`` at the centroids. `D` and
`S` are integrated exactly (van Oosterom and Strackee 1983; Wilton et al. 1984).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WEAK = 1e-4
"""Modes that set less water in motion than this share of the strongest are not excited by waves, such as the rotation
of a sphere. Rotations are compared over half of the hull's size."""
ON_EDGE = 1e-15
"""A point on an edge counts as this far from it, over its length: the integral is continuous there, its logarithm is
not."""


@dataclass(frozen=True, eq=False)
class Response:
    """How water in motion acts on a hull: as if its velocities ``v`` (n, 3) at ``points`` (n, 3) were a rigid motion
    with the twist ``share (6, 3 n) @ v`` (angular, linear), body axes. ``added`` (6, 6): the added mass over the
    water's density, about the origin."""

    points: Array
    share: Array
    added: Array

    def twist(self, velocities: Array) -> Array:
        """The equivalent twist (6,) of velocities (n, 3)."""
        return self.share @ velocities.ravel()

    @classmethod
    def at_origin(cls) -> Response:
        """That of a small hull: the motion of the water at the origin."""
        return cls(np.zeros((1, 3)), np.eye(6, 3, -3), np.zeros((6, 6)))


def response(corners: Array, surface: float) -> Response:
    """That of a hull whose wetted triangles are ``corners`` (n, 3, 3) m, counter-clockwise from the water, below the
    height ``surface`` m.

    By Haskind's relation, a wave pushes a hull that is held still with ``-rho integral(phi_j d(u n)/dt) dS``, if
    ``phi_j`` is the potential of the hull's own motion j. It is the force of the rigid acceleration
    ``A^-1 (-rho integral(phi_j du/dt n) dS)``. In waves much longer than the hull this is the water's acceleration; the
    effects of short waves cancel.
    """
    middles = corners.mean(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas = np.linalg.norm(normals, axis=1)
    corners, middles, normals = (x[areas > 1e-9 * areas.max()] for x in (corners, middles, normals))
    areas = np.linalg.norm(normals, axis=1)
    modes = np.concatenate([np.cross(middles, normals), normals], axis=1) / areas[:, None]  # normal velocity
    mirrored = middles * [1, 1, -1] + [0, 0, 2 * surface]
    single, double = (a - b for a, b in zip(_potentials(corners, middles), _potentials(corners, mirrored), strict=True))
    potentials = np.linalg.solve(2 * np.pi * np.eye(len(areas)) + double, -single @ modes)
    weights = -potentials * areas[:, None]
    added = weights.T @ modes
    size = np.array([*3 * [np.ptp(corners, axis=(0, 1)).max() / 2], 1, 1, 1])
    inverse = np.linalg.pinv(added / np.outer(size, size), rcond=WEAK) / np.outer(size, size)
    share = inverse @ (weights.T[:, :, None] * (normals / areas[:, None])).reshape(6, -1)
    return Response(middles, share, (added + added.T) / 2)


def _potentials(corners: Array, points: Array) -> tuple[Array, Array]:
    """Integrals (points, triangles) of ``1 / r`` over triangles (n, 3, 3), and their solid angles, positive behind
    them."""
    arms = corners[None] - points[:, None, None]  # (points, triangles, 3, 3)
    reach = np.linalg.norm(arms, axis=3)
    a, b, c = np.moveaxis(arms, 2, 0)
    ra, rb, rc = np.moveaxis(reach, 2, 0)
    product = np.einsum("pni,pni->pn", a, np.cross(b, c))
    across = ra * rb * rc + sum(np.einsum("pni,pni->pn", x, y) * r for x, y, r in ((a, b, rc), (b, c, ra), (c, a, rb)))
    flat = np.abs(product) <= 1e-9 * ra * rb * rc  # a triangle does not see itself
    angle = np.where(flat, 0.0, 2 * np.arctan2(product, across))
    unit = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    single = -np.abs(np.einsum("pni,ni->pn", a, unit) * angle)
    for k in range(3):
        edge = corners[:, (k + 1) % 3] - corners[:, k]
        length = np.linalg.norm(edge, axis=1)
        outward = np.cross(edge, unit) / length[:, None]
        ends = reach[:, :, k] + reach[:, :, (k + 1) % 3]
        beyond = np.maximum(ends - length, ON_EDGE * length)
        single += np.einsum("pni,ni->pn", arms[:, :, k], outward) * np.log((ends + length) / beyond)
    return single, angle
