"""Whitecaps: where waves break, and the foam that they leave on the water.

A surface breaks where it folds most: where the water of Gerstner's waves comes closest together. How much of it breaks
follows from the wind (Monahan and O'Muircheartaigh, 1980). Foam stays on the water that broke, drifts with it, and
fades within `LIFE`; so it is the same at a time, whichever times were computed before.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.world.water.water import Array, Waves

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Indices = NDArray[np.int64]

LIFE = 7.0
"""Time in which foam fades from 1 to 0, s; on average as Monahan's whitecaps, whose cover falls by e in 3.5 s."""
MOST_COVER = 0.3
"""Largest share of the sea that whitecaps cover."""
LEAST_FOLD = 0.08
"""Waves that fold less than this do not break: a swell without wind waves."""
SOFT = 0.25
"""How much more than the least the surface folds where foam is dense, in standard deviations."""
UNEVEN, LENGTHS, STREAK = 0.6, (2.0, 16.0), 2.5
"""Crests break unevenly along their length: by so many standard deviations, in patches of such lengths across the wind
[m], this much longer along it."""
SAMPLES, REGION = 30_000, 20_000.0
"""Places of a sea at which its breaking is measured, and the side of the square over which they are spread, m."""
BLOCK = 16
"""Steps whose folding is computed at once."""
SAMPLE_STEP = 0.25
"""Time between two such measurements, s."""


def cover(wind: float) -> float:
    """Share of the sea that whitecaps cover in a ``wind`` of m/s at 10 m: Monahan's and O'Muircheartaigh's fit."""
    return min(3.84e-6 * wind**3.41, MOST_COVER)


class Folding:
    """How much the surface folds at the water with rest positions ``xy`` (n, 2) m: 0 at rest, 1 where it touches
    itself."""

    def __init__(self, waves: Waves, xy: Array) -> None:
        theta = xy @ waves.number.T + waves.phase
        # A wave moves the water as in Gerstner's waves, whatever the choppiness that is shown.
        stretch = waves.amplitude[:, None] * waves.along[:, [0, 0, 1]] * waves.number[:, [0, 1, 1]]
        self._omega, self._stretch = waves.omega, stretch
        self._left = waves.share(xy)[:, 0].astype(np.float32)
        self._phases = np.concatenate([np.cos(theta), np.sin(theta)], axis=1).astype(np.float32)

    def at(self, times: ArrayLike) -> NDArray[np.float32]:
        """(..., n) at ``times`` (...) s: one minus the determinant of the gradient of the water's place.

        A time among many costs a tenth of a single one, for which the phases are read from memory all the same.
        """
        t = np.asarray(times, float)
        turn = self._stretch.T[:, None] * np.exp(1j * self._omega * t.reshape(-1, 1))  # (3, times, waves)
        flat = np.concatenate([turn.real, turn.imag], axis=-1).astype(np.float32).reshape(3 * t.size, -1)
        xx, yx, yy = (flat @ self._phases.T).reshape(3, *t.shape, -1)
        return np.asarray(self._left * (1 - (1 - xx) * (1 - yy) + yx**2))


@dataclass(frozen=True, eq=False)
class Breaking:
    """Where ``waves`` break in a ``wind`` (2,) m/s at 10 m, with zero for that which raises them."""

    waves: Waves
    wind: Array
    speed: float = field(init=False)
    downwind: Array = field(init=False)
    spread: float = field(init=False)
    """standard deviation of the folding"""
    least: float = field(init=False)
    """the folding at which foam begins; inf: nowhere"""

    def __post_init__(self) -> None:
        waves, given = self.waves, float(np.hypot(*self.wind))
        power = waves.amplitude**2 @ waves.along
        downwind = self.wind / given if given else power / max(float(np.hypot(*power)), 1e-12)
        spread = float(np.sqrt((waves.amplitude**2 @ np.hypot(*waves.number.T) ** 2) / 2))
        object.__setattr__(self, "speed", given or waves.wind)
        object.__setattr__(self, "downwind", downwind)
        object.__setattr__(self, "spread", spread)
        object.__setattr__(self, "least", self._calibrated())

    def unevenness(self, xy: Array) -> Array:
        """What is added (n,) to the folding at rest positions ``xy`` (n, 2) m, so that crests break in patches: behind
        moles as much less as of the waves."""
        random = np.random.default_rng(5)
        lengths, angles = np.geomspace(*LENGTHS, 16), random.uniform(0, 2 * np.pi, 16)
        across = np.array([-self.downwind[1], self.downwind[0]])
        local = np.stack([xy @ self.downwind / STREAK, xy @ across])
        number = 2 * np.pi / lengths * np.stack([np.cos(angles), np.sin(angles)])
        noise = np.cos(local.T @ number + random.uniform(0, 2 * np.pi, 16)).sum(axis=1)
        return np.asarray(UNEVEN * self.spread * self.waves.share(xy)[:, 0] * noise / np.sqrt(8))

    def _calibrated(self) -> float:
        """The `least` folding with which foam has the `cover` of the wind, on average over a large sea."""
        wanted = cover(self.speed)
        if wanted < 1e-6 or 5 * self.spread < LEAST_FOLD:
            return np.inf
        from scipy.optimize import brentq

        xy = np.random.default_rng(7).uniform(-REGION / 2, REGION / 2, (SAMPLES, 2))
        folding, uneven = Folding(self.waves, xy), self.unevenness(xy)
        ages = np.arange(0.0, LIFE, SAMPLE_STEP)
        past = folding.at(-ages) + uneven

        def excess(least: float) -> float:
            foam = np.zeros(SAMPLES)
            for age, row in zip(ages, past, strict=True):
                np.maximum(foam, self.born(row, least) - age / LIFE, out=foam)
            return float(foam.mean()) - wanted

        if excess(LEAST_FOLD) <= 0:
            return LEAST_FOLD
        return float(brentq(excess, LEAST_FOLD, float(past.max()), xtol=1e-3 * self.spread))

    def born(self, folding: Array, least: float | None = None) -> Array:
        """Foam (n,), 0 to 1, that appears where the surface folds by ``folding`` (n,), with `unevenness`."""
        return np.clip((folding - (self.least if least is None else least)) / (SOFT * self.spread), 0.0, 1.0)


class Whitecaps:
    """Foam on the water with rest positions ``xy`` (n, 2) m, every ``step`` s; `LIFE` before the shot, there is none.

    ``triangles`` (m, 3) lie between these; ``flow`` (n, 2) m/s: the current. The foam moves with it and with the waves'
    drift (Stokes), in addition to their orbits, which rest positions follow.
    """

    def __init__(
        self, breaking: Breaking, xy: Array, triangles: Indices, step: float, flow: Array | float = 0.0
    ) -> None:
        self._breaking, self._step = breaking, step
        self._folding, self._uneven = Folding(breaking.waves, xy), breaking.unevenness(xy)
        self._carry = carried_from(xy, triangles, step * (flow + breaking.waves.drift))
        self.born = np.zeros(len(xy))
        """foam that appeared at the last step"""
        self.foam = np.zeros(len(xy))
        self._next: int | None = None
        self._block, self._folds = 0, np.zeros((0, len(xy)), np.float32)

    def at(self, k: int) -> Array:
        """Foam (n,), 0 to 1, at step ``k``, which is not before that of the last call."""
        if self._next is None:
            self._next = min(k, 0) - int(np.ceil(LIFE / self._step))
        for now in range(self._next, k + 1):
            self.born = self._breaking.born(self._folded(now) + self._uneven)
            self.foam = np.maximum(self.born, self._carry @ self.foam - self._step / LIFE)
        self._next = k + 1
        return self.foam

    def _folded(self, k: int) -> NDArray[np.float32]:
        """The folding (n,) at step ``k``, computed with its `BLOCK`, so that it is the same wherever one begins."""
        block, at = divmod(k, BLOCK)
        if block != self._block or not len(self._folds):
            steps = BLOCK * block + np.arange(BLOCK)
            self._block, self._folds = block, self._folding.at(steps * self._step)
        return np.asarray(self._folds[at])


def carried_from(xy: Array, triangles: Indices, way: Array) -> csr_array:
    """A matrix (n, n) that moves values at ``xy`` (n, 2) m by ``way`` (2,) or (n, 2) m, which is shorter than the
    ``triangles`` (m, 3) between them: linear in the triangle from which they come."""
    from scipy.sparse import csr_array, eye_array

    if not np.any(way):
        return csr_array(eye_array(len(xy)))
    corner = triangles.ravel()  # of each triangle: the water that arrives there
    place, own = (xy - way)[corner], np.repeat(triangles, 3, axis=0)
    a, b, c = np.moveaxis(xy[own], 1, 0)
    area = _cross(b - a, c - a)
    weights = np.stack([_cross(c - b, place - b), _cross(a - c, place - c), _cross(b - a, place - a)], axis=1)
    weights /= np.where(np.abs(area) > 1e-9, area, np.inf)[:, None]
    inside = np.where(np.abs(area) > 1e-9, weights.min(axis=1), -np.inf)
    order = np.lexsort([inside, corner])
    best = order[np.flatnonzero(np.diff(corner[order], append=-1))]  # the last of each corner, in the corners' order
    weights = np.maximum(weights[best], 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.repeat(corner[best], 3)
    return csr_array((weights.ravel(), (rows, own[best].ravel())), shape=(len(xy), len(xy)))


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
