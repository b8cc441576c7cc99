"""The bodies of contact at an instant: vehicles, which yield, and moving obstacles, which do not.

This module gives the place, velocity and compliance of their points; `contact.py` finds what they touch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.interpolant import spatial
from vehsim.lie.quaternions import cross, matrices
from vehsim.vehicles.definition.base import State

Array = NDArray[np.float64]

ALLOWANCE = 0.5
"""Added to the greatest speed of a body's points, for pushes until the next evaluation, m/s."""


@dataclass(frozen=True)
class Body:
    """A vehicle in the scene: the index of its joint in the model, the corners (8, 3) of a box around its hulls, m from
    its root, and its inertia."""

    name: str
    vehicle: Any
    joint: int
    reach: float
    corners: Array
    inverse_inertia: Array

    @cached_property
    def root_of_inverse(self) -> Array:
        """``L`` with ``L L^T`` the inverse inertia."""
        return np.asarray(np.linalg.cholesky(self.inverse_inertia))


@dataclass(frozen=True)
class MovingObstacle:
    """A moving obstacle, whose motion does not depend on contact: the index of its joint in the model, and its
    motion."""

    joint: int
    reach: float
    obstacle: Any


class MovingBody:
    """A vehicle at a public state; gives its points in world axes. ``speed`` m/s: none of them is faster now;
    ``fastest``: until the next evaluation."""

    def __init__(self, body: Body, state: State) -> None:
        self.body = body
        self.position = np.asarray(state.position, float)
        self.orientation = np.asarray(state.orientation, float)
        twist = np.asarray(state.twist, float)
        self.R_wr = matrices(self.orientation)
        self.omega, self.v = self.R_wr @ twist[:3], self.R_wr @ twist[3:]
        self.speed = float(np.linalg.norm(twist[3:] + cross(twist[:3], body.corners), axis=1).max())
        self.centre = self.position + self.R_wr @ body.vehicle.origin
        self.fastest = float(np.linalg.norm(self.v) + np.linalg.norm(self.omega) * 2 * body.reach) + ALLOWANCE

    def velocity(self, places: Array) -> Array:
        return np.asarray(self.v + cross(self.omega, places - self.position))

    def wrench(self, places: Array, forces: Array) -> Array:
        """Torque and force of forces (n, 3) at places (n, 3), in body axes about the body frame's origin."""
        torque = cross(places - self.centre, forces)
        return np.concatenate([torque.sum(axis=0) @ self.R_wr, forces.sum(axis=0) @ self.R_wr])

    def wrenches(self, places: Array, forces: Array) -> Array:
        """The same (n, 6) of each force."""
        return np.concatenate([cross(places - self.centre, forces) @ self.R_wr, forces @ self.R_wr], axis=1)

    def damping(self, places: Array, normals: Array, along: Array, across: Array) -> Array:
        """Of its twist, (6, 6), by dampers ``along`` the normals and ``across`` them (n,) N s/m."""
        units = self.wrenches(np.repeat(places, 3, axis=0), np.tile(np.eye(3), (len(places), 1)))
        upright = self.wrenches(places, normals)
        return np.asarray((units.T * np.repeat(across, 3)) @ units + (upright.T * (along - across)) @ upright)

    def yielding(self, place: Array) -> Array:
        """The change of velocity (3, 3) at a place by impulses along the world's axes, 1/kg."""
        units = self.wrenches(np.tile(place, (3, 1)), np.eye(3))
        return np.asarray(units @ self.body.inverse_inertia @ units.T)


class Led:
    """A moving obstacle at a time, s since frame 0; it counts as infinitely heavy. ``speed``, ``fastest`` as of a
    `MovingBody`."""

    def __init__(self, moving: MovingObstacle, seconds: float) -> None:
        self.body = moving
        clip = moving.obstacle.clip
        first, last = clip.times[[0, -1]]
        since = seconds - clip.start_frame / float(clip.fps)
        motion = clip.at(np.array([np.clip(since, first, last)]))
        # before and after its motion it stands still
        omega, v = (rows[0] if first <= since <= last else np.zeros(3) for rows in spatial(motion))
        self.position, self.orientation, self.v = motion.positions[0], motion.orientations[0], v
        self.centre, self.R_wr = self.position, matrices(self.orientation)
        self.omega = self.R_wr @ omega
        self.speed = float(np.linalg.norm(self.v) + np.linalg.norm(self.omega) * 2 * moving.reach)
        self.fastest = self.speed + ALLOWANCE

    def velocity(self, places: Array) -> Array:
        return np.asarray(self.v + cross(self.omega, places - self.position))

    def wrench(self, places: Array, forces: Array) -> Array:
        return np.zeros(6)

    def yielding(self, place: Array) -> Array:
        return np.zeros((3, 3))


def damping_rate(body: MovingBody, damping: Array) -> float:
    """The fastest rate of decay of a body's motion by ``damping`` (6, 6) of its twist, 1/s."""
    root = body.body.root_of_inverse
    return float(np.linalg.eigvalsh(root.T @ damping @ root)[-1])


def effective(yielding: Array, normal: Array) -> tuple[float, float]:
    """The effective mass for a push along ``normal``, and the least for one across it, kg."""
    across = np.eye(3) - np.outer(normal, normal)
    sideways = across @ yielding @ across  # its eigenvalues: zero and two more
    half, square = float(np.trace(sideways)) / 2, float((sideways * sideways).sum()) / 2
    return 1 / float(normal @ yielding @ normal), 1 / (half + math.sqrt(max(square - half**2, 0.0)))
