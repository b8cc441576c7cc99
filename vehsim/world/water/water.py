"""Water: the height of its surface and its velocity, anywhere and at any time.

This module holds the surface as data: level, waves (linear or Gerstner), a current below them. `sea.py` holds spectra
and sea states, `currents.py` currents, `grids.py` grids from a liquid solver, `buoyancy.py` the effect on a hull.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.constants import GRAVITY, SEA_WATER
from vehsim.errors import InputError
from vehsim.world.water.motion import Motion

if TYPE_CHECKING:
    from vehsim.world.water.grids import WaterGrids
    from vehsim.world.water.shelter import Shelter

Array = NDArray[np.float64]

MAX_WAVES = 4096
NEWTON = 60
"""Maximum number of steps; five suffice, except for crests about to break."""
CLOSE = 1e-5
"""Required accuracy of a rest position found from a guess, in shortest waves; it bounds the error of the flow."""
NEAR = 1e-3
"""Accuracy at which one last step is made without evaluating its result; the error is squared by it."""
BLOCK = 20_000
"""Number of phases evaluated at once: points times waves."""


class Surface(Protocol):
    """A disturbance of the level: heights above it, and velocities of the water."""

    @property
    def shortest(self) -> float:
        """Wavelength (m) that determines the curvature; linear interpolation needs pieces of a small share of it."""

    @property
    def curvature(self) -> float:
        """Root mean square (1/m) of the Laplacian of the height: the curvature."""

    @property
    def content_hash(self) -> str: ...

    def at(self, points: Array, level: float, t: float, guess: Array | None = None) -> Motion:
        """The water at ``points`` (n, 3), with its height above the level. From a ``guess`` (n, 2) of the water's rest
        positions, it is accurate to `CLOSE`."""

    def grid(self, x: Array, y: Array, t: float) -> tuple[Array, Array | None]:
        """Heights (rows, cols) m above the level at all ``y`` (rows,) and ``x`` (cols,) m, evenly spaced, and the rest
        positions of the water there (rows, cols, 2), None: unchanged; accurate to `CLOSE`."""

    def slope(self, xy: Array, t: float) -> Array:
        """Gradient (n, 2) of the height at ``xy`` (n, 2)."""


class Current(Protocol):
    """A flow of the water as a whole."""

    @property
    def content_hash(self) -> str: ...

    def velocity(self, points: Array, t: float) -> Array:
        """(n, 3) m/s at ``points`` (n, 3) whose z is height above the surface (negative below)."""


@dataclass(frozen=True, eq=False)
class Waves:
    """Waves on deep water, ``omega^2 = g k``: one row each.

    ``amplitude`` (k,) m, ``number`` (k, 2) wave vectors rad/m, ``phase`` (k,) rad. ``choppiness`` 0: linear (Airy),
    ``sum a cos(k x - omega t + phase)``; 1: Gerstner, whose particles move on circles, so that crests are sharp and
    troughs flat. ``wind`` m/s: the speed at 10 m of the wind that raises them, 0 for swell; it whitens their crests.
    ``shelter``: where moles leave less of them. Raises ``InputError``, also if the surface would fold.
    """

    amplitude: Array
    number: Array
    phase: Array
    choppiness: float = 0.0
    wind: float = 0.0
    shelter: Shelter | None = None
    omega: Array = field(init=False)
    content_hash: str = field(init=False)

    def __post_init__(self) -> None:
        for name, shape in (("amplitude", (-1,)), ("number", (-1, 2)), ("phase", (-1,))):
            object.__setattr__(self, name, np.array(getattr(self, name), float).reshape(shape))
        sizes = {len(self.amplitude), len(self.number), len(self.phase)}
        if len(sizes) != 1 or not 0 < len(self.amplitude) <= MAX_WAVES:
            raise _wrong(
                "waves", "amplitude, number and phase differ in length", "give one row per wave", sorted(sizes)
            )
        k = np.hypot(*self.number.T)
        if not (np.isfinite(k).all() and np.isfinite(self.amplitude).all() and np.isfinite(self.phase).all()):
            raise _wrong("waves", "not finite", "give finite amplitudes, wave vectors and phases")
        if (k <= 0).any():
            raise _wrong("waves.number", "a wave without length", "give wave vectors of 2 pi / wavelength, rad/m")
        if not 0 <= self.choppiness <= 1:
            raise _wrong("waves.choppiness", "not between 0 and 1", "0 is linear, 1 is Gerstner", self.choppiness)
        steep = self.choppiness * np.abs(self.amplitude) * k
        if min(steep.sum(), 4 * np.sqrt((steep**2).sum() / 2)) >= 1:
            message = f"the surface folds over: steepness {steep.sum():.3g}"
            raise _wrong("waves.choppiness", message, "lower the choppiness or the waves", self.choppiness)
        object.__setattr__(self, "omega", np.sqrt(GRAVITY * k))
        digest = hashlib.sha256(repr(self.choppiness).encode())
        for rows in (self.amplitude, self.number, self.phase):
            digest.update(rows.tobytes())
        if self.shelter is not None:
            digest.update(self.shelter.content_hash.encode())
        object.__setattr__(self, "content_hash", digest.hexdigest())

    @cached_property
    def _k(self) -> Array:
        return np.hypot(*self.number.T)

    @property
    def steepness(self) -> Array:
        """Mean square slope (k,) of each wave."""
        return (self.amplitude * self._k) ** 2 / 2

    @cached_property
    def along(self) -> Array:
        """(k, 2) unit vectors of the directions of the waves."""
        return self.number / self._k[:, None]

    @cached_property
    def drift(self) -> Array:
        """(2,) m/s: the mean motion of the water at the surface, by Stokes."""
        return (self.amplitude**2 * self.omega) @ self.number

    @cached_property
    def _shift(self) -> Array:
        """(k, 2) m: horizontal amplitude of the water in each wave."""
        return (self.choppiness * self.amplitude)[:, None] * self.along

    @cached_property
    def _stretch(self) -> Array:
        """(k, 3): xx, yx and yy of the gradient of this displacement."""
        return self._shift[:, [0, 0, 1]] * self.number[:, [0, 1, 1]]

    @cached_property
    def _swing(self) -> Array:
        """(k, 7): amplitudes of each wave's velocity and acceleration along X, Y and Z at the surface, and of its
        height."""
        along = np.column_stack([self.along, np.ones(len(self._k))])
        speed = (self.amplitude * self.omega)[:, None] * along
        return np.column_stack([speed, self.omega[:, None] * speed, self.amplitude])

    @cached_property
    def _rise(self) -> Array:
        """(k, 2): amplitude of each wave's slope along X and Y, at rest."""
        return self.amplitude[:, None] * self.number

    @cached_property
    def shortest(self) -> float:
        """Length (m) of a single wave with the same ratio of curvature to height as the whole surface."""
        power = self.amplitude**2
        return float(2 * np.pi * (power.sum() / max((power * self._k**4).sum(), 1e-300)) ** 0.25)

    @cached_property
    def curvature(self) -> float:
        """Root mean square (1/m) of the Laplacian of the height."""
        return float(np.sqrt((self.amplitude**2 * self._k**4).sum() / 2))

    def share(self, xy: Array) -> Array:
        """Share (n, 1) of the waves that moles leave at ``xy`` (n, 2) m."""
        return np.ones((len(xy), 1)) if self.shelter is None else self.shelter.share(xy)[:, None]

    def rest(self, xy: Array, t: float) -> Array:
        """The rest positions (n, 2) of the water at ``xy`` (n, 2): the inverse of Gerstner's horizontal map."""
        return self._solved(xy, t)[0]

    def at(self, points: Array, level: float, t: float, guess: Array | None = None) -> Motion:
        """See `Surface`. Under a crest, each wave fades with the depth below the crest."""
        height, fade = np.empty(len(points)), np.empty(len(points))
        velocity, acceleration = np.empty((len(points), 3)), np.empty((len(points), 3))
        for block in self._blocks(len(points)):
            _, cos, sin = self._solved(points[block, :2], t, None if guess is None else guess[block])
            left = self.share(points[block, :2])
            height[block] = left[:, 0] * (cos @ self.amplitude)
            below = np.minimum(points[block, 2] - level - height[block], 0.0)
            decay = np.exp(below[:, None] * self._k)
            ahead, up = left * ((decay * cos) @ self._swing), left * ((decay * sin) @ self._swing)
            velocity[block, :2], velocity[block, 2] = ahead[:, :2], up[:, 2]
            acceleration[block, :2], acceleration[block, 2] = up[:, 3:5], -ahead[:, 5]
            fade[block] = height[block] - ahead[:, 6]
        return Motion(height, velocity, acceleration, fade)

    def heights(self, xy: Array, t: float) -> Array:
        """Heights (n,) m above the level at ``xy`` (n, 2) m and ``t`` s."""
        found = [self._solved(xy[block], t)[1] @ self.amplitude for block in self._blocks(len(xy))]
        return self.share(xy)[:, 0] * np.concatenate(found)

    def grid(self, x: Array, y: Array, t: float) -> tuple[Array, Array | None]:
        """See `Surface`. Sums of products of functions of ``x`` and of ``y``; if they do not give the rest positions,
        Newton's first step from there, and further steps point by point."""
        across = _turns(self.number[:, 0], x).conj()
        along = _turns(self.number[:, 1], y) * np.exp(1j * (self.phase - self.omega * t))

        def waves(share: Array, across: NDArray[np.complex128] = across) -> Array:
            return np.asarray((share * along).view(float) @ across.view(float).T)  # the real part

        if self.choppiness == 0 and self.shelter is None:
            return waves(self.amplitude), None
        xy = places(x, y).reshape(-1, 2)
        left = self.share(xy)
        if self.choppiness == 0:
            return left.reshape(len(y), len(x)) * waves(self.amplitude), None
        gap = left * np.stack([waves(share, 1j * across).ravel() for share in self._shift.T], axis=1)
        start = xy + _newton(gap, left * np.stack([waves(share).ravel() for share in self._stretch.T], axis=1))
        height, rest = np.empty(len(xy)), np.empty((len(xy), 2))
        for block in self._blocks(len(xy)):
            found, cos, sin = self._solved(xy[block], t, start[block], NEAR)
            step = _newton(xy[block] - found + left[block] * (sin @ self._shift), left[block] * (cos @ self._stretch))
            height[block] = left[block, 0] * (cos @ self.amplitude - (step * (sin @ self._rise)).sum(axis=1))
            rest[block] = found + step
        return height.reshape(len(y), len(x)), rest.reshape(len(y), len(x), 2)

    def slope(self, xy: Array, t: float) -> Array:
        """Gradient (n, 2) of the height at ``xy`` (n, 2) m and ``t`` s."""
        _, cos, sin = self._solved(xy, t)
        left = self.share(xy)
        uphill = -left * (sin @ self._rise)  # the shelter varies over many waves
        if self.choppiness == 0:
            return uphill
        shift = left * cos * (self.choppiness * self.amplitude)
        stretch = np.eye(2) - np.einsum("nk,ki,kj->nij", shift, self.along, self.number)
        return np.asarray(np.linalg.solve(np.swapaxes(stretch, 1, 2), uphill[:, :, None])[:, :, 0])

    def _solved(
        self, xy: Array, t: float, guess: Array | None = None, near: float = CLOSE
    ) -> tuple[Array, Array, Array]:
        """`rest` (n, 2), and cosine and sine (n, k) of every wave's phase there: Newton's method, guarded, to
        round-off; from a ``guess`` (n, 2) to an accuracy of ``near``."""
        rest = xy if guess is None or self.choppiness == 0 else guess
        cos, sin = self._phases(rest, t)
        if self.choppiness == 0:
            return rest, cos, sin
        left, share = self.share(xy), np.ones((len(xy), 1))
        close = 1e-13 * (1 + _larger(xy)) if guess is None else near * self.shortest
        gap = xy - rest + left * (sin @ self._shift)  # the error of the guess: its image minus xy
        for _ in range(NEWTON):
            size = _larger(gap)
            if (size <= close).all():
                break
            tried = rest + share * _newton(gap, left * (cos @ self._stretch))
            cos_there, sin_there = self._phases(tried, t)
            gap_there = xy - tried + left * (sin_there @ self._shift)
            better = (_larger(gap_there) < size)[:, None]
            if better.all():
                rest, cos, sin, gap = tried, cos_there, sin_there, gap_there
            else:
                rest, cos, sin, gap = (
                    np.where(better, there, here)
                    for there, here in ((tried, rest), (cos_there, cos), (sin_there, sin), (gap_there, gap))
                )
            share = np.where(better, 1.0, share / 2)
        return rest, cos, sin

    def _blocks(self, count: int) -> Iterator[slice]:
        """Slices of ``count`` rows, small enough for a processor's cache."""
        size = max(1, BLOCK // len(self.omega))
        return (slice(first, first + size) for first in range(0, max(count, 1), size))

    def _phases(self, rest: Array, t: float) -> tuple[Array, Array]:
        """Cosine and sine (n, k) of every wave's phase, from the tangent of half the phase, which numpy vectorises."""
        half = rest @ (0.5 * self.number.T)
        half += 0.5 * (self.phase - self.omega * t)
        np.tan(half, out=half)
        cos = half * half
        cos += 1.0
        np.divide(2.0, cos, out=cos)
        half *= cos
        cos -= 1.0
        return cos, half


def places(x: Array, y: Array) -> Array:
    """(rows, cols, 2) m of all ``y`` (rows,) and ``x`` (cols,), in a fifth of the time of ``numpy.meshgrid``."""
    found = np.empty((len(y), len(x), 2))
    found[:, :, 0], found[:, :, 1] = x, y[:, None]
    return found


def _newton(gap: Array, stretch: Array) -> Array:
    """Newton's steps (n, 2) that close gaps (n, 2), from `Waves._stretch` (n, 3) there."""
    xx, yx, yy = stretch.T
    determinant = np.maximum((1 - xx) * (1 - yy) - yx**2, 1e-6)
    along, across = gap.T / determinant
    return np.stack([(1 - yy) * along + yx * across, yx * along + (1 - xx) * across], axis=1)


def _turns(number: Array, places: Array) -> NDArray[np.complex128]:
    """``exp(i number place)`` (n, k) at evenly spaced ``places`` (n,): each is the previous one, rotated."""
    turns = np.empty((len(places), len(number)), complex)
    turns[0], turns[1:] = np.exp(1j * number * places[0]), np.exp(1j * number * (places[1] - places[0]))
    return np.multiply.accumulate(turns, axis=0)


def _larger(pairs: Array) -> Array:
    """The larger size (n,) of rows (n, 2)."""
    return np.maximum(np.abs(pairs[:, 0]), np.abs(pairs[:, 1]))


def wave(height: float, length: float, heading: float = 0.0, phase: float = 0.0, choppiness: float = 0.0) -> Waves:
    """One train of waves: ``height`` m from trough to crest, ``length`` m, travelling towards ``heading`` rad
    from X."""
    if not (np.isfinite([height, length, heading, phase]).all() and length > 0 and height >= 0):
        raise _wrong("waves", "not a wave", "give a height and a length in metres, the length above zero")
    k = 2 * np.pi / length
    wave = [[k * np.cos(heading), k * np.sin(heading)]]
    return Waves(np.array([height / 2]), np.array(wave), np.array([phase]), choppiness)


@dataclass(frozen=True, eq=False)
class Water:
    """Water up to ``level`` m, with ``surface`` (`Waves`, `WaterGrids`, None: flat) and ``current`` (None: still).

    All points and velocities are in world axes, m and m/s; ``t`` s since the shot's first frame. ``density`` kg/m^3.
    ``height_field`` m: the cell of MuJoCo's height field that follows a hull and gives the height of the surface over
    it (`height_field.py`); None: as fine as the hull needs; 0: use the surface's formula.
    """

    level: float = 0.0
    surface: Surface | None = None
    current: Current | None = None
    density: float = SEA_WATER
    height_field: float | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.level) and abs(self.level) < 1e5):
            raise _wrong("water.level", "not a height", "give metres", self.level)
        if not 1 <= self.density <= 20_000:
            raise _wrong(
                "water.density",
                "not the density of a liquid",
                f"give kg/m^3; sea water has {SEA_WATER:g}",
                self.density,
            )
        if not (self.height_field is None or self.height_field == 0 or 1e-3 <= self.height_field < 100):
            raise _wrong(
                "water.height_field", "not a cell", "give its width in m, such as 0.1, or 0", self.height_field
            )

    @cached_property
    def content_hash(self) -> str:
        """A hash of the water's content."""
        parts = [part.content_hash for part in (self.surface, self.current) if part is not None]
        return hashlib.sha256(repr((self.level, self.density, self.height_field, *parts)).encode()).hexdigest()

    @property
    def flat(self) -> bool:
        """Whether it has no waves."""
        return self.surface is None

    @property
    def shortest(self) -> float:
        """The shortest relevant length on the surface, m; inf if it is flat."""
        return np.inf if self.surface is None else self.surface.shortest

    @property
    def curvature(self) -> float:
        """The curvature of the surface, 1/m: see `Surface`."""
        return 0.0 if self.surface is None else self.surface.curvature

    @property
    def grids(self) -> WaterGrids | None:
        """The surface if it is a liquid solver's, else None."""
        from vehsim.world.water.grids import WaterGrids

        return self.surface if isinstance(self.surface, WaterGrids) else None

    def grid(self, x: Array, y: Array, t: float = 0.0) -> tuple[Array, Array | None]:
        """Heights (rows, cols) m of the surface at all ``y`` (rows,) and ``x`` (cols,) m, evenly spaced, and the rest
        positions of the water there (rows, cols, 2), None: unchanged."""
        if self.surface is None:
            return np.full((len(y), len(x)), self.level), None
        above, rest = self.surface.grid(x, y, t)
        return self.level + above, rest

    def height(self, xy: ArrayLike, t: float = 0.0) -> Array:
        """Height (n,) m of the surface at ``xy`` (n, 2) m."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        if self.surface is None:
            return np.full(len(xy), self.level)
        if isinstance(self.surface, Waves):
            return self.level + self.surface.heights(xy, t)
        points = np.column_stack([xy, np.full(len(xy), np.inf)])
        return self.level + self.surface.at(points, self.level, t).height

    def normal(self, xy: ArrayLike, t: float = 0.0) -> Array:
        """Unit normals (n, 3) of the surface at ``xy`` (n, 2) m, upwards."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        slope = np.zeros_like(xy) if self.surface is None else self.surface.slope(xy, t)
        up = np.column_stack([-slope, np.ones(len(xy))])
        return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))

    def velocity(self, points: ArrayLike, t: float = 0.0) -> Array:
        """Velocity (n, 3) m/s of the water at ``points`` (n, 3) m, waves and current; above it, the surface's."""
        return self.at(np.asarray(points, float).reshape(-1, 3), t).velocity

    def at(self, points: Array, t: float, guess: Array | None = None) -> Motion:
        """The water at ``points`` (n, 3) m; ``guess``: see `Surface`. The acceleration is that of the waves."""
        n = len(points)
        if self.surface is None:
            found = Motion(np.full(n, self.level), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n))
        else:
            found = self.surface.at(points, self.level, t, guess)
            found = found._replace(height=self.level + found.height)
        if self.current is not None:
            depth = np.minimum(points[:, 2] - found.height, 0.0)
            flow = self.current.velocity(np.column_stack([points[:, :2], depth]), t)
            found = found._replace(velocity=found.velocity + flow)
        return found


def _wrong(key: str, message: str, remedy: str, value: object = None) -> InputError:
    return InputError(message, remedy, key=key, value=value)
