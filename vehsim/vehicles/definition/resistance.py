"""Resistance and attitude of a hull on calm water as functions of its speed.

Planing hulls follow Savitsky (1964, "Hydrodynamic design of planing hulls"), the others the friction line of ITTC 1957.
The same curve resists in simulation (`vehsim.world.water.running`) and in plans.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from vehsim.constants import GRAVITY, SEA_WATER
from vehsim.vehicles.definition.base import Array, Expr

VISCOSITY = 1.19e-6
"""Kinematic, of sea water at 15 degrees, m^2/s (ITTC 2011)."""
ALLOWANCE = 4e-4
"""Savitsky's addition to the friction coefficient, for roughness."""
FROUDE = np.concatenate([np.linspace(0.0, 3.0, 21), [3.4, 3.8, 4.4, 5.0, 6.0, 8.0, 10.0]])
"""Speeds of the curves over ``sqrt(g volume^(1/3))``."""
SLOWEST = 0.6
"""Least speed over ``sqrt(g beam)`` for Savitsky's lift."""
TRIMS = (0.5, 20.0)
"""Degrees."""
RISE = 3
"""The power of the speed with which wave resistance and trim grow up to the slowest planing speed: our choice."""


def ittc57(reynolds: Any) -> Any:
    """The friction coefficient of ITTC 1957; constant below a Reynolds number of 10^5."""
    return 0.075 / (np.log10(np.maximum(reynolds, 1e5)) - 2) ** 2


@dataclass(frozen=True)
class Planing:
    """A planing hull: ``beam`` between the chines, ``deadrise`` (rad) of a bottom whose keel is parallel to body X;
    ``lcg`` and ``vcg``, its centre of mass ahead of the transom and above the keel; ``thrust`` depth of the propellers
    below the centre of mass; m and ``mass`` kg. ``length`` m of its waterline at rest."""

    beam: float
    deadrise: float
    lcg: float
    vcg: float
    thrust: float
    mass: float
    length: float

    @property
    def slowest(self) -> float:
        """The least speed at which the bottom planes, m/s: within Savitsky's range, and with a wetted keel that is not
        longer than the hull."""
        speeds = math.sqrt(GRAVITY * self.beam) * np.linspace(SLOWEST, 4.0, 35)
        return float(next((v for v in speeds if self.at(v).keel <= self.length), speeds[-1]))

    def at(self, speed: float) -> Steady:
        """The equilibrium at ``speed`` m/s: Savitsky's eq. 15 and 16 (lift), 20 (friction), 35 and 36 (moments)."""
        from scipy.optimize import brentq

        low, high = TRIMS
        ends = [self._held(speed, trim)[1] for trim in TRIMS]
        if ends[0] >= 0 or ends[1] <= 0:
            trim = low if ends[0] >= 0 else high
        else:
            trim = brentq(lambda trim: self._held(speed, trim)[1], low, high, xtol=1e-10)
        return self._held(speed, trim)[0]

    def _held(self, speed: float, trim: float) -> tuple[Steady, float]:
        """The hull that carries its weight at a ``trim`` in degrees, and the moment that lowers its bow, N m."""
        from scipy.optimize import brentq

        weight, b, degrees = GRAVITY * self.mass, self.beam, math.degrees(self.deadrise)
        tau, froude = math.radians(trim), speed / math.sqrt(GRAVITY * b)
        wanted = weight / (0.5 * SEA_WATER * (speed * b) ** 2)
        flat = brentq(lambda c: _raised(c, degrees) - wanted, 0.0, 10 * wanted + 10)
        ratio = brentq(
            lambda k: trim**1.1 * (0.012 * k**0.5 + 0.0055 * k**2.5 / froude**2) - flat, 0.0, 1e4, xtol=1e-12
        )
        # the mean velocity over the bottom follows from the dynamic part of the lift
        dynamic = _raised(0.012 * ratio**0.5 * trim**1.1, degrees)
        mean = speed * math.sqrt(max(1 - dynamic / (ratio * math.cos(tau)), 0.0))
        friction = 0.5 * SEA_WATER * mean**2 * ratio * b**2 / math.cos(self.deadrise)
        friction *= float(ittc57(mean * ratio * b / VISCOSITY)) + ALLOWANCE
        centre = 0.75 - 1 / (5.21 * froude**2 / ratio**2 + 2.39)
        behind = self.lcg - centre * ratio * b
        below = self.vcg - b / 4 * math.tan(self.deadrise)
        moment = weight * (math.cos(tau) * behind - self.thrust * math.sin(tau)) + friction * (below - self.thrust)
        keel = ratio * b + b * math.tan(self.deadrise) / (2 * math.pi * math.tan(tau))
        resistance = weight * math.tan(tau) + friction / math.cos(tau)
        return Steady(speed, tau, ratio, keel, keel * math.sin(tau), friction, resistance), moment

    def displaced(self, steady: Steady) -> float:
        """The volume of the bottom below the undisturbed surface, m^3."""
        b, slope, deep = self.beam, math.tan(self.deadrise), steady.draft / math.cos(steady.trim)
        below = min(deep, b / 2 * slope)  # that part of the keel's depth at which the chines are dry
        prism = below**3 / (3 * slope) + b * (deep**2 - below**2) / 2 - (deep - below) * b**2 * slope / 4
        return prism / math.tan(steady.trim)


def _raised(flat: float, degrees: float) -> float:
    """The lift coefficient with a deadrise, from that of a flat plate (eq. 16)."""
    return flat - 0.0065 * degrees * flat**0.6


@dataclass(frozen=True)
class Steady:
    """A planing hull at a steady ``speed`` m/s: ``trim`` of the keel in rad, mean wetted length over the beam
    (``ratio``), wetted length of the ``keel`` and ``draft`` of its end at the transom in m, ``friction`` and
    ``resistance`` N."""

    speed: float
    trim: float
    ratio: float
    keel: float
    draft: float
    friction: float
    resistance: float


@dataclass(frozen=True, eq=False)
class Running:
    """A hull on calm water at ``speeds`` (n,) m/s: its ``resistance`` (n,) N, and for planing hulls the ``trim`` (n,)
    rad, the ``draft`` (n,) m of the keel at the transom, NaN where it does not plane yet, and the ``share`` (n,) of its
    way from rest to planing; ``immersion`` (n,): what it displaces over what it displaces at rest; ``transom`` (x, z):
    the end of its keel, m from the centre of mass; ``length`` m of its waterline at rest."""

    speeds: Array
    resistance: Array
    trim: Array | None = None
    draft: Array | None = None
    share: Array | None = None
    immersion: Array | None = None
    transom: Sequence[float] = (0.0, 0.0)
    length: float = 0.0

    @property
    def rate(self) -> SpeedSpline:
        """Resistance over speed, N s/m."""
        return SpeedSpline.through(self.speeds, self.resistance / np.maximum(self.speeds, 1e-9))

    def curves(self, slope: float) -> Curves:
        """What resists, as curves: the ``rate``; the share of its way from rest to planing; the share of what it
        displaces at rest by which it has risen out of the water; and ``slope`` times the speed of a hull that does not
        plane yet, constant where it planes, as its bottom then carries the same weight at every speed."""
        flat = np.zeros(len(self.speeds))
        share = flat if self.share is None else self.share
        dry = flat if self.immersion is None else 1 - self.immersion
        slowest = np.interp(1.0 - 1e-9, share, self.speeds) if share.any() else math.inf
        others = (share, dry, slope * np.minimum(self.speeds, slowest))
        return Curves([self.rate, *(SpeedSpline.through(self.speeds, values) for values in others)])


def running(mass: float, length: float, area: float, planing: Planing | None, form: float = 0.0) -> Running:
    """That of a hull whose wetted surface at rest has a ``length`` m and an ``area`` m^2: the friction of ITTC 1957
    times 1 + ``form``; with the equilibria of ``planing``, if given, and a wave resistance that grows up to them."""
    speeds = FROUDE * math.sqrt(GRAVITY * (mass / SEA_WATER) ** (1 / 3))
    friction = 0.5 * SEA_WATER * area * speeds**2 * ittc57(speeds * length / VISCOSITY) * (1 + form)
    if planing is None:
        return Running(speeds, friction)
    first = planing.at(planing.slowest)
    share = np.minimum(speeds / first.speed, 1.0) ** RISE
    begun = 0.5 * SEA_WATER * area * first.speed**2 * float(ittc57(first.speed * length / VISCOSITY)) * (1 + form)
    resistance = friction + share * (first.resistance - begun)
    trim, draft = share * first.trim, np.full(len(speeds), np.nan)
    rest = mass / SEA_WATER
    immersion = 1 - share * (1 - min(planing.displaced(first) / rest, 1.0))
    for k in np.flatnonzero(speeds >= first.speed):
        steady = planing.at(float(speeds[k]))
        resistance[k], trim[k], draft[k] = steady.resistance, steady.trim, steady.draft
        immersion[k] = min(planing.displaced(steady) / rest, 1.0)
    return Running(speeds, resistance, trim, draft, share, immersion, (-planing.lcg, -planing.vcg), length)


@dataclass(frozen=True)
class SpeedSpline:
    """A natural cubic spline of a speed of either sign: ``value + slope x + sum(bends max(x - knots, 0)^3)`` with ``x``
    the magnitude of the speed. Linear beyond its last knot. `Curves` makes expressions of it."""

    value: float
    slope: float
    knots: tuple[float, ...]
    bends: tuple[float, ...]

    @staticmethod
    def through(speeds: Array, values: Array) -> SpeedSpline:
        """The curve through ``values`` (n,) at ``speeds`` (n,) m/s, which begin at zero."""
        from scipy.interpolate import CubicSpline

        cubic = CubicSpline(speeds, values, bc_type="natural").c
        bends = np.diff(np.concatenate([[0.0], cubic[0], [0.0]]))
        return SpeedSpline(float(values[0]), float(cubic[2, 0]), tuple(map(float, speeds)), tuple(map(float, bends)))

    @staticmethod
    def constant(value: float) -> SpeedSpline:
        return SpeedSpline(value, 0.0, (), ())

    def __call__(self, speed: float) -> float:
        x = abs(float(speed))
        above = np.maximum(x - np.array(self.knots), 0.0)
        return float(self.value + self.slope * x + above**3 @ np.array(self.bends))

    @property
    def pieces(self) -> Array:
        """The cubics (4, n) from every knot on: their coefficients in the distance from the knot."""
        past = np.tril(np.subtract.outer(self.knots, self.knots))
        value = self.value + self.slope * np.array(self.knots) + past**3 @ self.bends
        slope = self.slope + 3 * past**2 @ self.bends
        return np.array([value, slope, 3 * past @ self.bends, np.tril(np.ones_like(past)) @ self.bends])


@dataclass(frozen=True, eq=False)
class Curves:
    """Splines over the same knots, as expressions. A piece is the last knot passed, and the cubics from there on."""

    splines: Sequence[SpeedSpline]

    @cached_property
    def _pieces(self) -> Array:
        """All pieces (size, n)."""
        return np.vstack([self.splines[0].knots, *(spline.pieces for spline in self.splines)])

    @property
    def size(self) -> int:
        """Size of a piece."""
        return 1 + 4 * len(self.splines)

    def at(self, speed: Expr, piece: Expr | None = None) -> list[Expr]:
        """Their values at a ``speed``, smooth at zero: within a ``piece`` (size,), or everywhere, which costs much
        more.

        Everywhere, the numbers of the piece are sums of steps: these have no derivatives, so that those of the splines
        take few operations.
        """
        x = _magnitude(speed)
        if piece is None:
            steps = ca.vertcat(1.0, *(x >= knot for knot in self.splines[0].knots[1:]))
            piece = ca.DM(np.diff(self._pieces, prepend=0.0)) @ steps
        knot, *cubics = ca.vertsplit(piece, [0, *range(1, self.size + 1, 4)])
        return [_cubic(x - knot, cubic) for cubic in cubics]

    def pieces_at(self, count: int) -> ca.Function:
        """Speeds (1, count) -> the pieces (size, count) there, by a call: SX cannot look up."""
        if count not in self._calls:
            speeds = ca.MX.sym("speeds", 1, count)
            found = ca.low(ca.DM([*self.splines[0].knots, math.inf]), _magnitude(speeds.T))
            pieces = [ca.MX(ca.DM(self._pieces))[:, found]]
            self._calls[count] = ca.Function("pieces", [speeds], pieces, {"never_inline": True})
        return self._calls[count]

    @cached_property
    def _calls(self) -> dict[int, ca.Function]:
        return {}


@dataclass(frozen=True, eq=False)
class ByCurves:
    """A ``law`` of a body's twist and controls that reads ``curves`` at ``speeds(twist)`` (k,).

    With ``pieces``, symbols (size, k) of the pieces there, it holds within them, and costs a third.
    """

    law: Callable[..., Expr]
    curves: Curves
    speeds: Callable[[Expr], Expr]
    pieces: Expr | None = None

    def __call__(self, twist: Expr, c: Expr, pieces: Expr | None = None) -> Expr:
        return self.law(twist, c, pieces)


def in_pieces(vehicle: Any) -> tuple[Expr, Any]:
    """Symbols (n,) of the pieces of the curves that a vehicle's resistance reads, and the vehicle within these pieces;
    without curves no symbols, and the vehicle itself."""
    law = getattr(vehicle, "resistance", None)
    if not isinstance(law, ByCurves):
        return ca.SX.sym("piece", 0), vehicle
    count = law.speeds(ca.SX.zeros(vehicle.group.dim)).shape[0]
    pieces = ca.SX.sym("piece", law.curves.size, count)
    return ca.vec(pieces), replace(vehicle, resistance=replace(law, pieces=pieces))


def speeds_of(vehicle: Any, *motions: tuple[Expr, Expr]) -> Expr:
    """Where the curves of a vehicle's resistance are read at ``motions``: pairs of a pose and a group's velocity."""
    return ca.vertcat(*(vehicle.resistance.speeds(vehicle.group.velocity_to_body(*motion)) for motion in motions))


def _magnitude(speed: Any) -> Any:
    """The magnitude of speeds, smooth at zero."""
    return ca.sqrt(speed**2 + 1e-6)


def _cubic(x: Expr, coefficients: Expr) -> Expr:
    a, b, c, d = ca.vertsplit(coefficients)
    return a + x * (b + x * (c + x * d))
