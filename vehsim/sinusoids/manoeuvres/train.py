"""A car with trailers as the path of its last axle: from derivatives to states and back, and legs of the path.

Every axle ahead lies one hitch length along the tangent of the path behind it, and the steering is the curvature of the
first (flatness). Over a graph ``y(x)`` this is chained form: ``z1 = x, zn = y`` and ``z2 .. z(n-1)`` the derivatives of
y. `trailers.py` chooses the legs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, lru_cache
from math import comb, factorial, perm
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev
from scipy.interpolate import BPoly

from vehsim.errors import SolveError
from vehsim.sinusoids.canonical.series import angle, derivative, divide, one, sincos, sqrt, times
from vehsim.sinusoids.laws import Law, chebyshev
from vehsim.sinusoids.system import Array

SAMPLES = 49
"""Number of samples on a leg for its largest angles."""
PACE = 12
"""Degree of the polynomial that evens the pace on a leg; a higher degree oscillates."""
TURNED = 0.5
"""Wheelbases of path over which a straightening leg may turn the wheels by at most its largest angle: otherwise they
oscillate, and an integrator of the highest order may step over it."""
IN_LINE = 1e-11
"""Poses with a smaller lateral offset, m and rad, are in line: round-off would otherwise turn the wheels on a short
leg."""
SPARE, ROUNDS = 5, 6
"""Number of free coefficients of a straightening leg for small angles, and of solves to find them."""


@dataclass(frozen=True)
class Train:
    """Lengths of a car and its trailers, m; each hitch is on the axle ahead."""

    hitches: tuple[float, ...]
    wheelbase: float

    @property
    def count(self) -> int:
        """Number of derivatives of ``y`` that determine a state: N + 2."""
        return len(self.hitches) + 2

    @property
    def length(self) -> float:
        return sum(self.hitches) + self.wheelbase


@dataclass(frozen=True)
class Pose:
    """The place of the last axle, m, and its heading, rad; the train ahead of it is straight, and so are the wheels."""

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

    From the system's own motion at a fixed steering angle: its Taylor series over x, one order per iteration.
    """
    order = train.count + 1
    angles = q[3:] - frame.heading
    series = np.zeros((len(angles), order))
    series[:, 0] = angles
    y = np.zeros(order)
    y[0] = last_axle(train, q).within(frame)[1]
    for _ in range(order - 1):
        # speeds over the last axle's x: 1 / cos theta_N there, and a factor 1 / cos(bend) for every axle ahead
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
    """States (k, n) and the path of the first axle per unit of x (k,).

    ``x`` (k,) and ``jets`` (k, N + 3), ``y .. y^(N+2)`` of the last axle's graph in the axes of ``frame``. Complex jets
    give complex states, from which their rates are found.
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
    """The graph ``y`` in the axes of ``frame``, a polynomial of the fraction ``(x - x0) / span``, from x0 to x0 + span.

    Backwards if ``span`` is negative. ``left``, ``right``: its derivatives with respect to the fraction at its ends,
    from the zeroth; ``spare``: coefficients between, in Bernstein's basis. Rounded coefficients would lose half the
    digits of the highest derivatives, which determine the steering.
    """

    train: Train
    frame: Pose
    x0: float
    span: float
    left: Array
    spare: Array
    right: Array
    label: str

    @property
    def length(self) -> float:
        return abs(self.span)

    @property
    def curve(self) -> Array:
        """All coefficients in Bernstein's basis."""
        return bernstein(self.left, self.spare, self.right)

    def jets(self, s: Array) -> Array:
        """``y .. y^(N+3)`` (k, N + 4) at fractions s (k,) of the leg."""
        return np.column_stack([c(s) / self.span**k for k, c in enumerate(self._derivatives)])

    @cached_property
    def _derivatives(self) -> list[BPoly]:
        """By the differences of exact coefficients, each rounded once."""
        ends = (self.left, self.spare, self.right)
        curve, curves = bernstein(*(np.array([Fraction(x) for x in end], object) for end in ends)), []
        for _ in range(self.train.count + 2):
            curves.append(BPoly(curve.astype(float)[:, None], [0.0, 1.0]))
            curve = (len(curve) - 1) * np.diff(curve)
        return curves

    def states(self, s: Array) -> Array:
        return state_of(self.train, self.x0 + self.span * s, self.jets(s)[:, :-1], self.frame)[0]

    @cached_property
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
        """`inputs` at an even pace of the front wheels, interpolated at Chebyshev points: as accurate, much faster."""
        pace, rate = self.pace, self.pace.deriv()
        return chebyshev(lambda s: self.inputs(pace(s)) * rate(s)[:, None])

    @cached_property
    def pace(self) -> Chebyshev:
        """Share of the front wheels' path -> fraction of the leg, from 0 to 1: nearly even, exactly a polynomial."""
        from scipy.interpolate import CubicSpline

        s = _dense(201)
        try:
            q, length = state_of(self.train, self.span * s, self.jets(s)[:, :-1], self.frame)
            distance = CubicSpline(s, length / np.cos(q[:, 2])).antiderivative()(s)
        # fractions too large for a double; a spline through values that are not finite
        except (OverflowError, ValueError):
            raise SolveError(f"leg {self.label!r}: bends without bound", "go by a nearer goal") from None
        found = Chebyshev.fit(distance / distance[-1], s, PACE, [0.0, 1.0])
        found -= Chebyshev([(found(1.0) - 1 + found(0.0)) / 2, (found(1.0) - 1 - found(0.0)) / 2], [0.0, 1.0])
        even: Chebyshev = found if found.deriv()(s).min() > 0.0 else Chebyshev([0.5, 0.5], [0.0, 1.0])
        return even

    @property
    def angles(self) -> tuple[float, float]:
        """The largest steering and hitch angle of the leg, rad."""
        steering, hitch, _, _ = sharpness([self])[0]
        return float(steering), float(hitch)

    def begun(self, q: Array) -> Leg:
        """The same leg from the state ``q``, very close to its start, to the same end, so that no error is
        carried on."""
        x0, last = last_axle(self.train, q).within(self.frame)[0], self.x0 + self.span
        span, known = last - x0, self.train.count + 1
        left, right = (end * (span / self.span) ** np.arange(len(end)) for end in (self.left, self.right))
        left[:known] = derivatives(self.train, q, self.frame) * span ** np.arange(known)
        return replace(self, x0=x0, span=span, left=left, right=right)

    def back(self, label: str) -> Leg:
        """The same path, backwards."""
        left, right = _mirrored(self.right), _mirrored(self.left)
        return Leg(self.train, self.frame, self.x0 + self.span, -self.span, left, self.spare[::-1], right, label)


def sharpness(legs: Sequence[Leg]) -> Array:
    """The largest steering and hitch angle on each of the legs of one train, rad, and the path of its car per metre of
    the last axle, mean and largest (k, 4). All at once, which is much faster."""
    train = legs[0].train
    # span^-k: derivatives over x
    jets = [
        _sampled(len(leg.curve) - 1, train.count) @ leg.curve / leg.span ** np.arange(train.count + 1)[:, None]
        for leg in legs
    ]
    rows = np.concatenate([j.T for j in jets])
    q, ratio = state_of(train, np.zeros(len(rows)), rows, Pose(0.0, 0.0, 0.0))
    q, ratio = q.reshape(len(legs), SAMPLES, -1), ratio.reshape(len(legs), SAMPLES)
    hitch = np.abs(np.diff(q[:, :, 3:], axis=2)).max(axis=(1, 2), initial=0.0)
    mean = np.trapezoid(ratio, _dense(SAMPLES), axis=1)
    return np.column_stack([np.abs(q[:, :, 2]).max(axis=1), hitch, mean, ratio.max(axis=1)])


def straighten(train: Train, q: Array, spans: Sequence[float], label: str) -> list[Leg]:
    """Legs from state ``q`` over ``spans`` m (backwards if negative) to a straight train.

    In the axes of the last trailer, a leg is a polynomial with the derivatives of ``q`` at one end, and vanishing
    derivatives from the second to the (N + 3)rd at the other. Of these, it has the smallest largest angles to first
    order, with slowly turning wheels (`TURNED`).
    """
    frame = last_axle(train, q)
    known = derivatives(train, q, frame)
    return [_straightening(train, frame, known, float(span), label) for span in spans]


def _straightening(train: Train, frame: Pose, known: Array, span: float, label: str) -> Leg:
    k = train.count
    left, right = known * span ** np.arange(k + 1), np.zeros(k + 2)
    degree = 2 * k + 2 + SPARE
    fixed = bernstein(left, np.zeros(SPARE), right)
    # place and slope at which the straight line is met, and the free coefficients between
    free = np.zeros((2 + SPARE, degree + 1))
    free[:2, -k - 2 :] = [np.ones(k + 2), np.arange(-k - 1.0, 1.0)]
    free[2:, k + 1 : k + 1 + SPARE] = np.eye(SPARE)
    samples = _sampled(degree, k + 1) / span ** np.arange(k + 2)[:, None, None]
    bends = np.concatenate([np.tensordot(row, samples, (0, 0)) for row in _linear_angles(train)])
    a, b = bends @ free.T, bends @ fixed
    weights = np.ones(len(b))
    for _ in range(ROUNDS):  # the largest angle, by weights that follow it
        best = np.linalg.lstsq(a * weights[:, None], -b * weights, rcond=1e-12)[0]
        left_over = np.abs(a @ best + b)
        weights *= np.sqrt(left_over / max(left_over.max(), 1e-12) + 1e-3)
        weights /= weights.max()
    right[:2] = best[0], degree * best[1]
    return Leg(train, frame, 0.0, span, left, best[2:].astype(float), right, label)


def across(train: Train, a: Pose, b: Pose, label: str) -> Leg:
    """Straight at ``a`` to straight at ``b``, in axes of the mean heading, forwards or backwards.

    All derivatives from the second to the (N + 3)rd vanish at both ends, so that legs join smoothly.
    """
    frame = Pose(a.x, a.y, (a.heading + b.heading) / 2)
    (x0, y0, m0), (x1, y1, m1) = a.within(frame), b.within(frame)
    span = x1 - x0
    if max(abs(y1 - y0), abs(m0), abs(m1)) < IN_LINE:
        y1, m0, m1 = y0, 0.0, 0.0
    left, right = np.zeros((2, train.count + 2))
    left[:2], right[:2] = [y0, m0 * span], [y1, m1 * span]
    return Leg(train, frame, x0, span, left, np.zeros(0), right, label)


def bernstein(left: Array, spare: Array, right: Array) -> Array:
    """Coefficients of the polynomial on 0..1 with these derivatives, from the zeroth, at its ends, and those between.

    As exact as the arguments: fractions give fractions.
    """
    degree = len(left) + len(spare) + len(right) - 1
    return np.concatenate([_from_left(left, degree), spare, _from_left(_mirrored(right), degree)[::-1]])


def _from_left(values: Array, degree: int) -> Array:
    """The first Bernstein coefficients of a polynomial with these derivatives at 0."""
    pascal, steps = _pascal(len(values), degree)
    return np.asarray(pascal @ (values / steps))


@lru_cache
def _pascal(count: int, degree: int) -> tuple[Array, Array]:
    pascal = np.array([[comb(i, j) for j in range(count)] for i in range(count)])
    return pascal, np.array([perm(degree, j) for j in range(count)])


def _mirrored(values: Array) -> Array:
    """Derivatives (k,), from the zeroth, of the same curve seen from its other end."""
    return values * (-1) ** np.arange(len(values))


def _dense(count: int) -> Array:
    """Fractions from 0 to 1, denser at both ends."""
    return (1 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2


@lru_cache
def _sampled(degree: int, order: int) -> Array:
    """Derivatives, from the zeroth to ``order``, of Bernstein's polynomials on samples: (order + 1, samples,
    degree + 1)."""
    curve, s, rows = BPoly(np.eye(degree + 1)[:, None], [0.0, 1.0]), _dense(SAMPLES), []
    for _ in range(order + 1):
        rows.append(curve(s))
        curve = curve.derivative()
    return np.array(rows)


@lru_cache
def _linear_angles(train: Train) -> Array:
    """Hitch angles from the last, the steering angle and its change over `TURNED`, linearised.

    They are combinations (N + 2, N + 4) of ``y .. y^(N+3)``. An axle ``d`` ahead is at ``y + d y'``, so each axle
    multiplies by ``1 + d D``.
    """
    ahead, rows = np.array([1.0]), []
    for d in (*train.hitches[::-1], train.wheelbase):
        rows.append(np.pad(d * ahead, (2, train.count - len(ahead))))
        ahead = np.convolve(ahead, [1.0, d])
    rows.append(TURNED * train.wheelbase * np.roll(rows[-1], 1))
    return np.array(rows)
