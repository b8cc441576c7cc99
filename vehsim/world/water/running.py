"""The lift and resistance of a running hull, distributed over its wetted surface.

At each speed of a hull's `Running`, the pressure and the resistance of its patches are such that it moves steadily with
the given trim and resistance, under the thrust of its propellers. Away from this equilibrium, forces follow from the
patches that are wet and from their velocity: lift grows with the trim and is zero in the air.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.lie.quaternions import cross
from vehsim.vehicles.definition.resistance import SpeedSpline
from vehsim.world.water.hull_mesh import COLUMNS, DEPTH, HEAD, PLACE, THROUGH, HullMesh, Wetted

if TYPE_CHECKING:
    from vehsim.vehicles.definition.hydrodynamics import Hull

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lift:
    """The law at a speed. A patch that moves with ``v``, and with ``v_n`` into the water, has the pressure
    ``rho planing v_n |v| / 2``, and ``rate`` N s/m resists.

    ``across``: this pressure and slamming act across the keel only, as on Savitsky's hulls, because the resistance
    ahead is that of the hull's form.

    With a ``transom`` (x, length) m, the bottom is that of a planing hull: a ``vented`` share of the pressure is
    missing at the transom, where the water leaves, and none from ``length`` ahead of it. Water rises along the bottom
    (Wagner 1932), by ``rise`` times the depth of the keel below the undisturbed surface, and the planing pressure and
    ``rate`` act up to there; see `risen`.
    """

    planing: float = 0.0
    vented: float = 0.0
    rate: float = 0.0
    transom: tuple[float, float] | None = None
    rise: float = 0.0
    across: bool = False

    def risen(self, deep: Array, places: Array, keel: Array, through: Array, bottom: Any) -> Array:
        """How much the water rises at ``places`` (n, 3) of a hull, m, where the keel is ``deep`` (n,) m below the
        undisturbed surface and at the heights ``keel`` (n,). ``through`` (n, 3) m/s, and the indices ``bottom`` of the
        bottom's places, from the stern to the bow.

        Each half of a wedge has its own rise, in proportion to its own way into the water since the keel before it
        went under: the depth of the keel, and what drift and roll add, so that boats lean into turns. A heave adds
        nothing to it: a hull that rises is not wet further out.
        """
        before, level = places[bottom, 0], deep[bottom]
        under = np.flatnonzero(level > 0)
        if not len(under):
            return np.zeros(len(deep))
        k = under[-1]
        front = before[k]
        if k + 1 < len(before):
            front += (before[k + 1] - before[k]) * level[k] / (level[k] - level[k + 1])
        y, rising = places[:, 1], through[:, 2]
        rolling = (y[bottom] @ rising[bottom]) / max(float(y[bottom] @ y[bottom]), 1e-9)
        slope = (places[:, 2] - keel) / np.maximum(np.abs(y), 1e-9)
        aside = slope * np.sign(y) * through[:, 1] - rolling * y
        speed = np.sqrt(np.einsum("ni,ni->n", through, through))
        way = deep + aside * np.maximum(front - places[:, 0], 0.0) / np.maximum(speed, 1e-3)
        return np.where(deep > 0, self.rise * np.maximum(way, 0.0), 0.0)

    def peaked(self, depth: Array, keel: Array) -> Array:
        """The pressure over its mean across the bottom, at a ``depth`` m below the risen water where the keel is
        ``keel`` m below it: it grows towards the edge of the water, with the centre of Wagner's pressure."""
        across = 1 - np.clip(depth / np.maximum(keel, 1e-9), 0.0, 1.0)
        return np.asarray(1 + PEAKED * (across - 0.5))

    def missing(self, x: Array) -> Array:
        """The share of the pressure that is missing at ``x`` m ahead of the body frame's origin."""
        if self.transom is None or not self.vented:
            return np.zeros(np.shape(x))
        return np.asarray(self.vented * np.clip(1 - (x - self.transom[0]) / self.transom[1], 0.0, 1.0))


@dataclass(frozen=True)
class Law:
    """A `Lift` as a function of the speed ahead."""

    planing: SpeedSpline
    vented: SpeedSpline
    rate: SpeedSpline
    transom: tuple[float, float] | None = None
    rise: SpeedSpline | None = None
    across: bool = False

    def at(self, speed: float) -> Lift:
        """The law at ``speed`` m/s through the water; astern there is only resistance."""
        fore = max(speed, 0.0)
        rise = 0.0 if self.rise is None else self.rise(fore)
        if rise < 2 * FAINT:
            rise = max(2 * (rise - FAINT), 0.0)
        return Lift(self.planing(fore), self.vented(fore), self.rate(speed), self.transom, rise, self.across)


class Boat(Protocol):
    """What is needed of a vehicle in the water (`vehsim.world.water.buoyancy.Afloat`)."""

    @property
    def vehicle(self) -> Any: ...
    @property
    def data(self) -> Hull: ...
    @property
    def mesh(self) -> HullMesh: ...
    @property
    def mass(self) -> float: ...
    @property
    def rest_volume(self) -> float: ...

    def under(self, columns: Array, faces: Any, bottom: Any, up: Array, lift: Lift) -> tuple[Wetted, Wetted]:
        """The wetted surface, and that on which planing pressure acts."""

    def surface(self, wet: Wetted, splashed: Wetted, lift: Lift) -> tuple[Array, float, float]:
        """Body wrench (6,) on these surfaces, and two rates."""


VENTED = 0.5
"""Length of the bottom in front of the transom where pressure is missing, over that of the waterline: our choice."""
WAGNER = np.pi / 2 - 1
"""Rise of the water along a wedge that moves into it, over the depth of its keel (Wagner 1932)."""
PEAKED = 12 * (2 / np.pi - 0.5)
"""Growth of the pressure from the keel to the edge of the water, over its mean: puts its centre at 2 / pi of the width,
as Wagner's pressure 1 / sqrt(1 - s^2) does."""
FAINT = 1e-3
"""At a slow hull, water would rise by less than this share of its depth: it does not rise at all, which saves time."""
MOST = 0.3
"""Largest trim at rest, rad."""
SLOW = 0.4
"""Slower hulls, over ``sqrt(g volume^(1/3))``, have the coefficients of this speed: their lift is negligible."""


def law_of(boat: Boat) -> Law:
    """The law of the hull's `Running`; without it, or for a hull that does not plane, with the hull's own constants."""
    running, hull = boat.data.running, boat.data
    none = SpeedSpline.constant(0.0)
    if running is None or running.trim is None or running.draft is None or running.share is None:
        rate = none if running is None else running.rate
        return Law(SpeedSpline.constant(hull.planing), none, rate, across=running is not None)
    speeds = running.speeds
    slow = int(np.searchsorted(speeds, SLOW * np.sqrt(GRAVITY * boat.rest_volume ** (1 / 3))))
    first = int(np.flatnonzero(np.isfinite(running.draft))[0])
    transom = (float(running.transom[0]), VENTED * running.length)
    rows = np.zeros((len(speeds), 3))
    rise = WAGNER * running.share
    guess = Lift(1.0, 1.0, running.resistance[first] / speeds[first], transom, WAGNER, True)
    for k in range(first, len(speeds)):
        guess = _planing(boat, running, k, guess)
        rows[k] = guess.planing, guess.vented, guess.rate
    guess, still = Lift(rows[first, 0], rows[first, 1], rows[first, 2], transom, WAGNER, True), _trim_at_rest(boat)
    running = replace(running, trim=running.trim + (1 - running.share) * still)
    for k in range(first - 1, slow - 1, -1):
        planing = rows[first, 0] * speeds[k] / speeds[first]
        guess = _slow(boat, running, k, replace(guess, planing=planing, rise=rise[k]))
        rows[k] = guess.planing, guess.vented, guess.rate
    # the hull's own damping took part in the fit, and is to come on top of the running hull's resistance
    rows[slow:, 2] += float(hull.damping[0]) + float(hull.quadratic[0]) * speeds[slow:]
    usual = running.resistance / np.maximum(speeds, 1e-9)
    share = speeds[:slow] / speeds[slow]
    rows[:slow] = rows[slow] * np.column_stack([share, share**2, usual[:slow] / usual[slow]])
    planing, vented, rate = (SpeedSpline.through(speeds, column) for column in rows.T)
    return Law(planing, vented, rate, transom, SpeedSpline.through(speeds, rise), True)


def steady(boat: Boat, speed: float, lift: Lift) -> tuple[float, float]:
    """Height m of the body frame's origin above calm water, and the bow's angle upwards, rad, of a hull that moves
    ahead steadily at ``speed`` m/s; as it floats at rest where there is no such motion."""
    from scipy.optimize import root

    rest, length = _trim_at_rest(boat), float(np.ptp(boat.mesh.points[:, 0]))
    floats, weight = _floats(boat, rest), boat.mass * GRAVITY

    def unbalanced(y: Array) -> Array:
        return _imbalance(boat, speed, rest + y[1], floats + y[0], y[2] * weight, length, lift)

    found = root(unbalanced, np.zeros(3))
    if np.abs(found.fun).max() > 0.01 or abs(found.x[1]) > MOST:
        return floats, rest
    return floats + float(found.x[0]), rest + float(found.x[1])


def _planing(boat: Boat, running: Any, k: int, guess: Lift) -> Lift:
    """The lift with which the hull runs steadily at the ``k``-th speed, with the keel as deep at the transom as given;
    but it never displaces more than at rest."""
    (x, z), trim = running.transom, float(running.trim[k])
    floats = _floats(boat, trim)
    height = max(floats, -float(running.draft[k]) - x * np.sin(trim) - z * np.cos(trim))

    def lift(y: Array) -> Lift:
        return replace(guess, planing=float(y[0]), vented=float(y[1]), rate=float(y[2]) * guess.rate)

    start = [guess.planing, guess.vented, 1.0]
    y = _zero(boat, running.speeds[k], lambda y: _unbalanced(boat, running, k, height, lift(y)), start)
    return lift(y)


def _slow(boat: Boat, running: Any, k: int, guess: Lift) -> Lift:
    """The same for a hull that does not plane yet: with the planing pressure of ``guess``, as deep as that makes it."""
    trim = float(running.trim[k])
    floats = _floats(boat, trim)

    def lift(y: Array) -> Lift:
        return replace(guess, vented=float(y[1]), rate=float(y[2]) * guess.rate)

    start = [0.0, guess.vented, 1.0]
    y = _zero(boat, running.speeds[k], lambda y: _unbalanced(boat, running, k, floats + float(y[0]), lift(y)), start)
    return lift(y)


def _unbalanced(boat: Boat, running: Any, k: int, height: float, lift: Lift) -> Array:
    """Pitch moment and forces along and across the keel at the ``k``-th speed, over weight and weight times length,
    with the body frame's origin ``height`` m above calm water."""
    trim = float(running.trim[k])
    push = float(running.resistance[k]) / np.cos(trim)
    return _imbalance(boat, float(running.speeds[k]), trim, height, push, running.length, lift)


def _imbalance(boat: Boat, speed: float, trim: float, height: float, push: float, length: float, lift: Lift) -> Array:
    """The same at a ``speed`` m/s and a ``trim`` rad, with a ``push`` N of the propulsors along the keel."""
    thrust, places, weight = np.array([push, 0.0, 0.0]), boat.data.propulsor_points, boat.mass * GRAVITY
    at = places.mean(axis=0) if len(places) else np.zeros(3)
    total = boat.surface(*_cut(boat, trim, height, speed, lift), lift)[0]
    total = total + np.concatenate([cross(at, thrust), thrust - weight * _up(trim)])
    return np.asarray(total[[1, 3, 5]] / weight / [length, 1.0, 1.0])


def _zero(boat: Boat, speed: float, wrong: Callable[[Array], Array], guess: list[float]) -> Array:
    """Where ``wrong`` is zero. Raises ``InputError`` if it is nowhere."""
    from scipy.optimize import root

    found = root(wrong, guess)
    if np.abs(found.fun).max() > 0.01:
        message = f"no pressure on its bottom keeps the trim of Savitsky's equations at {speed:.3g} m/s"
        remedy = "check chine_beam, deadrise and transom against the hull, or leave hull_form and chine_beam out"
        raise InputError(message, remedy, key="physics.chine_beam", subject=boat.vehicle.name)
    return np.asarray(found.x)


def _up(trim: float) -> Array:
    """The vertical in the axes of a body with its bow up by ``trim``."""
    return np.array([np.sin(trim), 0.0, np.cos(trim)])


def _cut(boat: Boat, trim: float, height: float, speed: float = 0.0, lift: Lift | None = None) -> tuple[Wetted, Wetted]:
    """The surfaces that `Boat.surface` takes, with the body frame's origin ``height`` m above calm water."""
    points, up = boat.mesh.points, _up(trim)
    columns = np.zeros((len(points), COLUMNS))
    columns[:, PLACE], columns[:, DEPTH] = points, -height - points @ up
    columns[:, HEAD], columns[:, THROUGH] = columns[:, DEPTH], speed * np.array([up[2], 0.0, -up[0]])
    return boat.under(columns, boat.mesh.faces, boat.mesh.bottom, up, lift or Lift())


def _trim_at_rest(boat: Boat) -> float:
    """The bow's angle upwards when the hull floats at rest, rad."""
    from scipy.optimize import brentq

    def moment(trim: float) -> float:
        return float(boat.surface(*_cut(boat, trim, _floats(boat, trim)), Lift())[0][1])

    ends = (-MOST, MOST)
    return float(brentq(moment, *ends, xtol=1e-9)) if moment(ends[0]) * moment(ends[1]) < 0 else 0.0


def _floats(boat: Boat, trim: float) -> float:
    """The height at which the hull displaces as much as at rest."""
    from scipy.optimize import brentq

    up = _up(trim)
    heights = -boat.mesh.points @ up
    volume = lambda height: _cut(boat, trim, height)[0].volume(up) - boat.rest_volume
    return float(brentq(volume, heights.min(), heights.max(), xtol=1e-12))
