"""A car with trailers as the path of its last axle: states from derivatives and back, and legs of path.

Every axle ahead lies one hitch along the tangent of the path behind it, and the steering is the curvature of the first
(flatness). Over a graph ``y(x)`` this is chained form: ``z1 = x, zn = y`` and ``z2 .. z(n-1)`` the derivatives of y.
Which legs to take is chosen in `trailers.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from math import factorial
from typing import Any

import numpy as np
from scipy.interpolate import BPoly

from vehsim.sinusoids.series import angle, derivative, divide, one, sincos, sqrt, times
from vehsim.sinusoids.steering import Law
from vehsim.sinusoids.system import Array

SAMPLES = 49
"""States looked at on a leg to see how sharp it is."""


@dataclass(frozen=True)
class Train:
    """Lengths of a car and its trailers, m; each hitch is on the axle ahead."""

    hitches: tuple[float, ...]
    wheelbase: float

    @property
    def count(self) -> int:
        """Derivatives of ``y`` that fix a state: N + 2."""
        return len(self.hitches) + 2

    @property
    def length(self) -> float:
        return sum(self.hitches) + self.wheelbase


@dataclass(frozen=True)
class Pose:
    """Where the last axle is, m, and its heading, rad; the train behind the car straight, the wheels too."""

    x: float
    y: float
    heading: float

    def ahead(self, distance: float) -> Pose:
        return Pose(self.x + distance * np.cos(self.heading), self.y + distance * np.sin(self.heading), self.heading)

    def within(self, frame: Pose) -> tuple[float, float, float]:
        """x, y and slope in the axes of ``frame``."""
        c, s = np.cos(frame.heading), np.sin(frame.heading)
        dx, dy = self.x - frame.x, self.y - frame.y
        return c * dx + s * dy, c * dy - s * dx, float(np.tan(self.heading - frame.heading))


def last_axle(train: Train, q: Array) -> Pose:
    """Position and heading of the last axle of a state x, y, phi, theta0, ..."""
    theta, d = q[4:], np.array(train.hitches)
    return Pose(float(q[0] - np.cos(theta) @ d), float(q[1] - np.sin(theta) @ d), float(q[-1]))


def derivatives(train: Train, q: Array, frame: Pose) -> Array:
    """``y, y', .. y^(N+2)`` (N + 3,) of the last axle's path over its x, in the axes of ``frame``.

    By the system's own motion at a fixed steering angle: its Taylor series over x, one order an iteration.
    """
    order = train.count + 1
    angles = q[3:] - frame.heading
    series = np.zeros((len(angles), order))
    series[:, 0] = angles
    y = np.zeros(order)
    y[0] = last_axle(train, q).within(frame)[1]
    for _ in range(order - 1):
        # speeds over the last axle's x: 1 / cos theta_N there, and 1 / cos(bend) more for every axle ahead
        sine, cosine = sincos(series[-1])
        speed = divide(one(order), cosine)
        y[1:] = (times(sine, speed) / np.arange(1, order + 1))[:-1]
        rates = np.zeros_like(series)
        for i in range(len(angles) - 1, 0, -1):
            sine, cosine = sincos(series[i - 1] - series[i])
            rates[i] = times(divide(sine, cosine), speed) / train.hitches[i - 1]
            speed = divide(speed, cosine)
        rates[0] = speed * np.tan(q[2]) / train.wheelbase
        series[:, 1:] = (rates / np.arange(1, order + 1))[:, :-1]
    return y * [factorial(k) for k in range(order)]


def state_of(train: Train, x: Array, jets: Array, frame: Pose) -> tuple[Array, Array]:
    """States (k, n) and how far the first axle moves per unit of x (k,).

    ``x`` (k,) and ``jets`` (k, N + 3), ``y .. y^(N+2)`` of the last axle's graph in the axes of ``frame``. Complex jets
    give complex states: that is how their rates are found.
    """
    orders = jets.shape[1]
    px, py = np.zeros((2, *jets.shape), jets.dtype)
    px[:, 0], px[:, 1] = x, 1.0
    py[:] = jets / np.array([factorial(i) for i in range(orders)])
    angles = []
    for i in range(len(train.hitches), -1, -1):
        dx, dy = derivative(px), derivative(py)
        length = sqrt(times(dx, dx) + times(dy, dy))
        tx, ty = divide(dx, length), divide(dy, length)
        angles.append(angle(ty[:, 0], tx[:, 0]))
        if i:
            d = train.hitches[i - 1]
            px, py = px[:, :-1] + d * tx, py[:, :-1] + d * ty
    curvature = (tx[:, 0] * ty[:, 1] - ty[:, 0] * tx[:, 1]) / length[:, 0]
    phi = np.arctan(train.wheelbase * curvature)
    c, s = np.cos(frame.heading), np.sin(frame.heading)
    theta = np.array(angles[::-1]).T + frame.heading
    wx, wy = frame.x + c * px[:, 0] - s * py[:, 0], frame.y + s * px[:, 0] + c * py[:, 0]
    return np.column_stack([wx, wy, phi, theta]), length[:, 0]


@dataclass(frozen=True, eq=False)
class Leg:
    """The graph ``y`` in the axes of ``frame``, ``curve`` over the fraction ``(x - x0) / span``, from x0 to x0 + span.

    Backwards if ``span`` is negative. The curve is a polynomial in Bernstein's basis, where derivatives at either end
    are exact however many there are.
    """

    train: Train
    frame: Pose
    x0: float
    span: float
    curve: BPoly
    label: str

    @property
    def length(self) -> float:
        return abs(self.span)

    def jets(self, s: Array) -> Array:
        """``y .. y^(N+3)`` (k, N + 4) at fractions s (k,) of the leg."""
        return np.column_stack([c(s) / self.span**k for k, c in enumerate(self._derivatives)])

    @cached_property
    def _derivatives(self) -> list[BPoly]:
        curves = [self.curve]
        for _ in range(self.train.count + 1):
            curves.append(curves[-1].derivative())
        return curves

    def states(self, s: Array) -> Array:
        return state_of(self.train, self.x0 + self.span * s, self.jets(s)[:, :-1], self.frame)[0]

    @property
    def far_end(self) -> Pose:
        return last_axle(self.train, self.states(np.ones(1))[0])

    def inputs(self, s: Array) -> Array:
        """Front-wheel speed and steering rate (k, 2) per unit of s."""
        jets: Any = self.jets(s)
        step: Any = 1e-30j * self.span
        moved, length = state_of(
            self.train, self.x0 + self.span * s + step, jets[:, :-1] + step * jets[:, 1:], self.frame
        )
        phi = moved[:, 2]
        return np.column_stack([self.span * length.real / np.cos(phi.real), phi.imag / 1e-30])

    @cached_property
    def law(self) -> Law:
        """`inputs`, through its values at Chebyshev points: the same to 1e-13 and a hundred times faster."""
        return chebyshev(self.inputs)

    @cached_property
    def angles(self) -> tuple[float, float]:
        """The largest steering and hitch angle on the way, rad."""
        q = self.states(np.linspace(0, 1, SAMPLES))
        return float(np.abs(q[:, 2]).max()), float(np.abs(np.diff(q[:, 3:], axis=1)).max(initial=0.0))

    def back(self, label: str) -> Leg:
        """The same path the other way."""
        turned = BPoly(self.curve.c[::-1], self.curve.x)
        return Leg(self.train, self.frame, self.x0 + self.span, -self.span, turned, label)


def straighten(train: Train, q: Array, span: float, label: str) -> Leg:
    """The leg from state ``q`` over ``span`` m (backwards if negative) to where the train stands straight.

    In the axes of the last trailer: the polynomial with the derivatives of ``q`` at one end and none from the second to
    the (N + 3)rd at the other that bends least.
    """
    frame, k = last_axle(train, q), train.count
    known = derivatives(train, q, frame) * float(span) ** np.arange(k + 1)
    # linear in where and at what slope the straight line is met
    zero = np.zeros(k + 2)
    fixed, *free = (
        hermite(left, right) for left, right in ((known, zero), *((0 * known, e) for e in np.eye(k + 2)[:2]))
    )
    nodes = (1 - np.cos(np.pi * (np.arange(40) + 0.5) / 40)) / 2
    bends = np.array([c.derivative(2)(nodes) for c in (fixed, *free)])
    best = np.linalg.lstsq(bends[1:].T, -bends[0], rcond=None)[0]
    return Leg(train, frame, 0.0, span, hermite(known, np.concatenate([best, zero[2:]])), label)


def across(train: Train, a: Pose, b: Pose, label: str) -> Leg:
    """Straight at ``a`` to straight at ``b``, in axes half way between their headings, forwards or backwards.

    All derivatives from the second to the (N + 3)rd vanish at both ends, so that legs join smoothly.
    """
    frame = Pose(a.x, a.y, (a.heading + b.heading) / 2)
    (x0, y0, m0), (x1, y1, m1) = a.within(frame), b.within(frame)
    span, k = x1 - x0, train.count
    left, right = np.zeros((2, k + 2))
    left[:2], right[:2] = (y0, m0 * span), (y1, m1 * span)
    return Leg(train, frame, x0, span, hermite(left, right), label)


def hermite(left: Array, right: Array) -> BPoly:
    """The polynomial on 0..1 with these derivatives, from the zeroth, at its ends."""
    return BPoly.from_derivatives([0.0, 1.0], [left, right])


NODES = 25


def chebyshev(law: Law, cycles: int = 1) -> Law:
    """A smooth law through its values at Chebyshev points of as many panels as it takes, by the barycentric formula."""
    check = np.linspace(0.003, 0.997, 41)
    truth = law(check)
    nodes = (1 - np.cos(np.pi * np.arange(NODES) / (NODES - 1))) / 2
    for panels in cycles * np.array([2, 8, 32, 128]):
        at = (np.arange(panels)[:, None] + nodes) / panels
        read = partial(_barycentric, nodes, law(at.ravel()).reshape(panels, NODES, -1))
        if np.abs(read(check) - truth).max() < 1e-12 * max(1.0, np.abs(truth).max()):
            return read
    return law


def _barycentric(nodes: Array, values: Array, s: Array) -> Array:
    panels = len(values)
    panel = np.clip((np.asarray(s) * panels).astype(int), 0, panels - 1)
    gap = (np.asarray(s) * panels - panel)[:, None] - nodes
    hit = np.abs(gap) < 1e-15  # at a node, or so near that its reciprocal overflows
    weight = np.where(np.arange(NODES) % 2, -1.0, 1.0) / np.where(hit, 1.0, gap)
    weight[:, [0, -1]] /= 2
    at = hit.any(axis=1)
    if at.any():
        weight[at] = hit[at]
    return np.einsum("kn,knm->km", weight, values[panel]) / weight.sum(axis=1, keepdims=True)
