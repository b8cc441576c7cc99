"""The groups on which vehicles move, each with its own coordinates.

A group defines the product of its elements, their matrices, and two maps from the algebra to coordinates; everything
else (Ad, ad, tangents) follows from the matrices. Rotations are quaternions in homogeneous coordinates: any non-zero
multiple is the same rotation, so integration steps need no normalisation. Algebra vectors have the rotation first, as
in LIE.

| group  | coordinates          | algebra (body twist)                       |
|--------|----------------------|--------------------------------------------|
| SO3    | (w, x, y, z)         | omega                                      |
| SE2    | (theta, x, y)        | (omega, vx, vy), theta is never wrapped    |
| SE3    | (w, x, y, z, px..pz) | (omega, v), both in body axes              |
| SO3xR3 | (w, x, y, z, px..pz) | (omega in body axes, v in world axes)      |
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import casadi as ca
import numpy as np

from vehsim.lie.series import cosc, sinc, sinsc
from vehsim.lie.vectorized import vectorized

Expr = Any


class Group(ABC):
    """A Lie group of dimension ``dim`` whose elements are vectors of ``size`` coordinates.

    Every method takes CasADi columns, or arrays of shape ``(..., n)`` that broadcast over their leading axes.
    """

    name: str
    dim: int
    size: int
    identity: tuple[float, ...]
    planar = False
    """Whether its elements move in the plane Z = 0 and rotate about Z."""
    fixed = False
    """Whether its elements only rotate: the body's origin stays fixed."""
    direct = False
    """Whether it is SO(3), alone or as a direct product with the translations: rotating then moves no position."""

    def __repr__(self) -> str:
        return self.name

    @abstractmethod
    def compose(self, a: Expr, b: Expr) -> Expr:
        """The product ``a b``, (size,)."""

    @abstractmethod
    def inverse(self, g: Expr) -> Expr:
        """The inverse element, (size,)."""

    @abstractmethod
    def matrix(self, g: Expr) -> Expr:
        """The element as a square matrix; ``matrix(compose(a, b)) = matrix(a) @ matrix(b)``."""

    @abstractmethod
    def hat(self, x: Expr) -> Expr:
        """The matrix of an algebra vector (dim,)."""

    @abstractmethod
    def vee(self, matrix: Expr) -> Expr:
        """The inverse of ``hat``, for expressions only."""

    @abstractmethod
    def angle_squared(self, x: Expr) -> Expr:
        """Square of the rotation angle of ``x`` (dim,), rad^2: ``ad`` has the eigenvalues 0 and +-i angle."""

    @abstractmethod
    def exp(self, x: Expr) -> Expr:
        """Exponential map, algebra (dim,) to coordinates (size,)."""

    @abstractmethod
    def cay(self, x: Expr) -> Expr:
        """Cayley map ``(e - x/2)^-1 (e + x/2)`` of the group's matrices, algebra (dim,) to coordinates (size,)."""

    @vectorized
    def cay_ad(self, x: Expr) -> Expr:
        """The element whose ``Ad`` is ``(I - ad/2)^-1 (I + ad/2)``. Groups override it if this is not ``cay``."""
        return self.cay(x)

    @abstractmethod
    def pose(self, g: Expr) -> Expr:
        """Position and quaternion (7,): px, py, pz, w, x, y, z."""

    @abstractmethod
    def from_pose(self, pose: Expr) -> Expr:
        """Coordinates (size,) of the element closest to a pose (7,)."""

    @vectorized
    def normalize(self, g: Expr) -> Expr:
        """The same element in normalised coordinates (unit quaternions)."""
        return g

    @vectorized
    def Ad(self, g: Expr) -> Expr:
        """Adjoint matrix (dim, dim): ``Ad(g) x = vee(g hat(x) g^-1)``."""
        forward, back = self.matrix(g), self.matrix(self.inverse(g))
        return self._columns(lambda basis: forward @ basis @ back)

    @vectorized
    def ad(self, x: Expr) -> Expr:
        """Matrix (dim, dim) of the bracket: ``ad(x) y = [x, y]``."""
        matrix = self.hat(x)
        return self._columns(lambda basis: matrix @ basis - basis @ matrix)

    @vectorized
    def velocity_to_body(self, g: Expr, xi: Expr) -> Expr:
        """The group's own velocity (dim,) as a body twist (dim,)."""
        return xi

    @vectorized
    def velocity_from_body(self, g: Expr, twist: Expr) -> Expr:
        """A body twist (dim,) as the group's own velocity (dim,)."""
        return twist

    @vectorized
    def wrench_from_body(self, g: Expr, wrench: Expr) -> Expr:
        """A body wrench (dim,) as a covector dual to the group's own velocity (dim,)."""
        return wrench

    @vectorized
    def shift(self, twist: Expr, offset: Expr) -> Expr:
        """A body twist (dim,) at the point ``offset`` (3,) of the same body, in the same axes."""
        return ca.vertcat(twist[0:3], twist[3:6] + ca.cross(twist[0:3], offset))

    @vectorized
    def cube(self, x: Expr) -> Expr:
        """The algebra vector (dim,) whose ``ad`` is ``ad(x)^3``."""
        return -self.angle_squared(x) * x

    def _columns(self, linear: Any) -> Expr:
        """The matrix of a linear map of the algebra, where ``linear`` acts on the algebra's matrices."""
        return ca.horzcat(*(self.vee(linear(self.hat(ca.SX(e)))) for e in np.eye(self.dim)))


class _SO3(Group):
    name, dim, size, identity = "SO3", 3, 4, (1.0, 0.0, 0.0, 0.0)
    fixed = direct = True

    @vectorized
    def compose(self, a: Expr, b: Expr) -> Expr:
        vector = a[0] * b[1:4] + b[0] * a[1:4] + ca.cross(a[1:4], b[1:4])
        return ca.vertcat(a[0] * b[0] - ca.dot(a[1:4], b[1:4]), vector)

    @vectorized
    def inverse(self, g: Expr) -> Expr:
        return ca.vertcat(g[0], -g[1:4])

    @vectorized
    def normalize(self, g: Expr) -> Expr:
        return g / ca.sqrt(ca.dot(g, g))

    @vectorized
    def matrix(self, g: Expr) -> Expr:
        cross = self.hat(g[1:4])
        return ca.SX.eye(3) + (2 / ca.dot(g, g)) * (g[0] * cross + cross @ cross)

    @vectorized
    def hat(self, x: Expr) -> Expr:
        return ca.skew(x)

    def vee(self, matrix: Expr) -> Expr:
        return ca.vertcat(matrix[2, 1], matrix[0, 2], matrix[1, 0])

    @vectorized
    def angle_squared(self, x: Expr) -> Expr:
        return ca.dot(x, x)

    @vectorized
    def exp(self, x: Expr) -> Expr:
        quarter = ca.dot(x, x) / 4
        return ca.vertcat(cosc(quarter), sinc(quarter) / 2 * x)

    @vectorized
    def cay(self, x: Expr) -> Expr:
        return ca.vertcat(2, x) / ca.sqrt(4 + ca.dot(x, x))

    @vectorized
    def shift(self, twist: Expr, offset: Expr) -> Expr:
        return twist

    @vectorized
    def pose(self, g: Expr) -> Expr:
        return ca.vertcat(ca.SX.zeros(3), g)

    @vectorized
    def from_pose(self, pose: Expr) -> Expr:
        return pose[3:7]


class _SE2(Group):
    name, dim, size, identity = "SE2", 3, 3, (0.0, 0.0, 0.0)
    planar = True

    @vectorized
    def compose(self, a: Expr, b: Expr) -> Expr:
        return ca.vertcat(a[0] + b[0], a[1:3] + _turn(a[0]) @ b[1:3])

    @vectorized
    def inverse(self, g: Expr) -> Expr:
        return ca.vertcat(-g[0], -_turn(-g[0]) @ g[1:3])

    @vectorized
    def matrix(self, g: Expr) -> Expr:
        return _affine(_turn(g[0]), g[1:3])

    @vectorized
    def hat(self, x: Expr) -> Expr:
        return ca.vertcat(ca.horzcat(0, -x[0], x[1]), ca.horzcat(x[0], 0, x[2]), ca.SX(1, 3))

    def vee(self, matrix: Expr) -> Expr:
        return ca.vertcat(matrix[1, 0], matrix[0, 2], matrix[1, 2])

    @vectorized
    def angle_squared(self, x: Expr) -> Expr:
        return x[0] ** 2

    @vectorized
    def exp(self, x: Expr) -> Expr:
        along, across = sinc(x[0] ** 2), x[0] * _versine(x[0] ** 2)
        return ca.vertcat(x[0], along * x[1] - across * x[2], across * x[1] + along * x[2])

    @vectorized
    def cay(self, x: Expr) -> Expr:
        scale = 2 / (4 + x[0] ** 2)
        return ca.vertcat(2 * ca.atan(x[0] / 2), scale * (2 * x[1] - x[0] * x[2]), scale * (2 * x[2] + x[0] * x[1]))

    @vectorized
    def shift(self, twist: Expr, offset: Expr) -> Expr:
        return ca.vertcat(twist[0], twist[1] - twist[0] * offset[1], twist[2] + twist[0] * offset[0])

    @vectorized
    def pose(self, g: Expr) -> Expr:
        return ca.vertcat(g[1:3], 0, ca.cos(g[0] / 2), 0, 0, ca.sin(g[0] / 2))

    @vectorized
    def from_pose(self, pose: Expr) -> Expr:
        w, x, y, z = (pose[i] for i in range(3, 7))
        return ca.vertcat(ca.atan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2), pose[0:2])


class _Spatial(Group):
    """A rotation and a position; subclasses define how they compose."""

    dim, size, identity = 6, 7, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @vectorized
    def normalize(self, g: Expr) -> Expr:
        return ca.vertcat(SO3.normalize(g[0:4]), g[4:7])

    @vectorized
    def angle_squared(self, x: Expr) -> Expr:
        return ca.dot(x[0:3], x[0:3])

    @vectorized
    def pose(self, g: Expr) -> Expr:
        return ca.vertcat(g[4:7], g[0:4])

    @vectorized
    def from_pose(self, pose: Expr) -> Expr:
        return ca.vertcat(pose[3:7], pose[0:3])


class _SE3(_Spatial):
    name = "SE3"

    @vectorized
    def compose(self, a: Expr, b: Expr) -> Expr:
        return ca.vertcat(SO3.compose(a[0:4], b[0:4]), a[4:7] + SO3.matrix(a[0:4]) @ b[4:7])

    @vectorized
    def inverse(self, g: Expr) -> Expr:
        return ca.vertcat(SO3.inverse(g[0:4]), -SO3.matrix(g[0:4]).T @ g[4:7])

    @vectorized
    def matrix(self, g: Expr) -> Expr:
        return _affine(SO3.matrix(g[0:4]), g[4:7])

    @vectorized
    def hat(self, x: Expr) -> Expr:
        return ca.vertcat(ca.horzcat(ca.skew(x[0:3]), x[3:6]), ca.SX(1, 4))

    def vee(self, matrix: Expr) -> Expr:
        return ca.vertcat(SO3.vee(matrix[0:3, 0:3]), matrix[0:3, 3])

    @vectorized
    def exp(self, x: Expr) -> Expr:
        squared, cross = self.angle_squared(x), ca.skew(x[0:3])
        turned = cross @ x[3:6]  # LIE eq. 14, B_exp
        translation = x[3:6] + _versine(squared) * turned + sinsc(squared) * cross @ turned
        return ca.vertcat(SO3.exp(x[0:3]), translation)

    @vectorized
    def cay(self, x: Expr) -> Expr:
        w, v = x[0:3], x[3:6]
        translation = 2 / (4 + ca.dot(w, w)) * (2 * v + ca.cross(w, v) + w * ca.dot(w, v) / 2)
        return ca.vertcat(SO3.cay(w), translation)

    @vectorized
    def cube(self, x: Expr) -> Expr:
        w, v = x[0:3], x[3:6]
        return ca.vertcat(-ca.dot(w, w) * w, -ca.dot(w, w) * v - 2 * ca.dot(w, v) * w)

    @vectorized
    def cay_ad(self, x: Expr) -> Expr:
        w, v = x[0:3], x[3:6]
        return ca.vertcat(SO3.cay(w), 2 / (4 + ca.dot(w, w)) * (2 * v + ca.cross(w, v)))  # LIE eq. 14, B_cay


class _SO3xR3(_Spatial):
    """Rotations and translations as a direct product: the group on which SYM discretises the helicopter."""

    name = "SO3xR3"
    direct = True

    @vectorized
    def compose(self, a: Expr, b: Expr) -> Expr:
        return ca.vertcat(SO3.compose(a[0:4], b[0:4]), a[4:7] + b[4:7])

    @vectorized
    def inverse(self, g: Expr) -> Expr:
        return ca.vertcat(SO3.inverse(g[0:4]), -g[4:7])

    @vectorized
    def matrix(self, g: Expr) -> Expr:
        return ca.diagcat(SO3.matrix(g[0:4]), _affine(ca.SX.eye(3), g[4:7]))

    @vectorized
    def hat(self, x: Expr) -> Expr:
        return ca.diagcat(ca.skew(x[0:3]), ca.vertcat(ca.horzcat(ca.SX(3, 3), x[3:6]), ca.SX(1, 4)))

    def vee(self, matrix: Expr) -> Expr:
        return ca.vertcat(SO3.vee(matrix[0:3, 0:3]), matrix[3:6, 6])

    @vectorized
    def exp(self, x: Expr) -> Expr:
        return ca.vertcat(SO3.exp(x[0:3]), x[3:6])

    @vectorized
    def cay(self, x: Expr) -> Expr:
        return ca.vertcat(SO3.cay(x[0:3]), x[3:6])

    @vectorized
    def cube(self, x: Expr) -> Expr:
        return ca.vertcat(SO3.cube(x[0:3]), ca.SX(3, 1))

    @vectorized
    def velocity_to_body(self, g: Expr, xi: Expr) -> Expr:
        return ca.vertcat(xi[0:3], SO3.matrix(g[0:4]).T @ xi[3:6])

    @vectorized
    def velocity_from_body(self, g: Expr, twist: Expr) -> Expr:
        return ca.vertcat(twist[0:3], SO3.matrix(g[0:4]) @ twist[3:6])

    @vectorized
    def wrench_from_body(self, g: Expr, wrench: Expr) -> Expr:
        return ca.vertcat(wrench[0:3], SO3.matrix(g[0:4]) @ wrench[3:6])


def _turn(theta: Expr) -> Expr:
    c, s = ca.cos(theta), ca.sin(theta)
    return ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c))


def _affine(linear: Expr, translation: Expr) -> Expr:
    size = linear.shape[0]
    return ca.vertcat(ca.horzcat(linear, translation), ca.horzcat(ca.SX(1, size), 1))


def _versine(squared: Expr) -> Expr:
    """``(1 - cos x) / x^2`` as a function of ``x^2``."""
    return sinc(squared / 4) ** 2 / 2


SO3, SE2, SE3, SO3xR3 = _SO3(), _SE2(), _SE3(), _SO3xR3()
GROUPS: dict[str, Group] = {group.name: group for group in (SO3, SE2, SE3, SO3xR3)}
