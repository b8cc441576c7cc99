"""Friction with memory: springs along the surface hold two bodies at the place where they stopped sliding."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehsim.lie.quaternions import cross
from vehsim.world.contact.bodies import Led, MovingBody
from vehsim.world.contact.grounding import Points

Array = NDArray[np.float64]


class Grip:
    """The springs of one touching pair.

    They are stretched by ``shift`` (3,) m at the middle of the contact and ``twist`` (3,) rad around its normal, and
    follow the motion of the bodies from one evaluation to the next, so that a body at rest does not creep. Springs that
    would pull harder than friction permits slide along. ``speed`` m/s: the closing speed for which the pair is stiff.
    """

    def __init__(self, a: MovingBody | Led, b: MovingBody | Led | None) -> None:
        self.shift, self.twist, self.slides, self.speed = np.zeros(3), np.zeros(3), True, 0.0
        self._poses = _pose(a), _pose(b)

    def hold(
        self,
        a: MovingBody | Led,
        b: MovingBody | Led | None,
        middle: Array,
        normal: Array,
        points: Points,
        slide: Array,
        springs: Array,
        dampers: Array,
        most: Array,
    ) -> Array:
        """Forces (n, 3) N on ``a`` along the surface, at most ``most`` (n,) N, of ``springs`` (n,) N/m and ``dampers``
        (n,) N s/m at points that slide with ``slide`` (n, 3) m/s."""
        self._follow(a, b, middle, normal)
        stretch = self.shift + cross(self.twist, points.places - middle)
        stretch -= (stretch * points.normals).sum(axis=1)[:, None] * points.normals
        spring = -springs[:, None] * stretch
        pull, limit = float(np.linalg.norm(spring, axis=1).sum()), float(most.sum())
        self.slides = pull > limit
        if self.slides:
            share = limit / pull
            self.shift, self.twist, spring = share * self.shift, share * self.twist, share * spring
        force = spring - dampers[:, None] * slide
        size = np.linalg.norm(force, axis=1)
        return np.asarray(force * np.minimum(1.0, most / np.maximum(size, 1e-300))[:, None])

    def _follow(self, a: MovingBody | Led, b: MovingBody | Led | None, middle: Array, normal: Array) -> None:
        """Add the motion of ``a`` relative to ``b`` since the last time."""
        (Ra, xa), (Rb, xb) = self._poses
        (Ra1, xa1), (Rb1, xb1) = self._poses = _pose(a), _pose(b)
        earlier = Ra @ (Ra1.T @ (middle - xa1)) + xa  # where the point of a was, and then moved with b
        self.shift = self.shift + middle - (Rb1 @ (Rb.T @ (earlier - xb)) + xb1)
        turn = Ra1 @ Ra.T @ (Rb1 @ Rb.T).T
        angle = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        self.shift = self.shift - (self.shift @ normal) * normal
        self.twist = ((self.twist + angle) @ normal) * normal


def _pose(body: MovingBody | Led | None) -> tuple[Array, Array]:
    return (np.eye(3), np.zeros(3)) if body is None else (body.R_wr, body.position)
