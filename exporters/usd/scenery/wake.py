"""The effect of vehicles on the visible water: their waves by linear theory, and foam.

A hull presses on the surface with its weight along its path. The waves of a moving pressure on deep water are computed
exactly, wave by wave, on a periodic box around the paths (``eta'' + g k eta = -k p / rho``, Lamb art. 242). This gives
Kelvin's wedge, its curvature in turns and its start. Where the paths are long, each vehicle has a box that follows it.
It is for pictures only: the wake does not push back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

CELL = 0.4
"""Cell of the boxes on which waves are computed, m."""
ROOM = 36.0
"""Margin of a box around the ways of its vehicles, m."""
MOST = 1024
"""Largest number of cells of a box along a side: where whole ways are longer, boxes follow the vehicles."""
SEEN = 20.0
"""Time for which a box that follows a vehicle keeps its wake, if that is not too long, s."""
STEP = 24.0
"""Distance by which such a box is behind before it follows, m."""
BORDER, FADING = 8.0, 20.0
"""Distances over which waves fade towards the border of a box, and at the end of the wake that it keeps, m."""
BEFORE = 2.5
"""Time before the first frame in which vehicles move straight on, s."""
FADE = 14.0
"""Time constant of the decay of wakes, s."""
FOAM_LIFE = 5.0
"""Time constant of the decay of foam, s."""
TRAIL = 14.0
"""Time for which churned water is tracked, s."""


@dataclass(frozen=True)
class Floating:
    """A vehicle that presses on the water: its ``clip``, displaced ``volume`` m^3, and its waterplane.

    ``length``, ``beam`` m; ``centre`` m: the waterplane's middle along the root's X. ``hull``: its closed surface,
    points (n, 3) m in the root's frame and faces (m, 3). ``wet`` (n,): share of its weight on the water on the
    requested frames, 0 in the air to 1; None: always 1.
    """

    clip: Clip
    volume: float
    length: float
    beam: float
    centre: float
    hull: tuple[Array, NDArray[np.int64]] | None = None
    wet: Array | None = None

    def bears(self, k: int) -> float:
        """Share of the vehicle's weight on the water in the ``k``-th frame."""
        return 1.0 if self.wet is None else float(self.wet[k])


@dataclass(frozen=True)
class _Way:
    """A vehicle on its way, for each frame: horizontal places (n, 2) m and velocities (n, 2) m/s, headings (n,) rad."""

    vehicle: Floating
    places: Array
    velocities: Array
    headings: Array

    def centres(self, lasts: int) -> Array:
        """The middle (n, 2) of the last frames of the way, ``lasts`` at most."""
        sums = np.vstack([np.zeros((1, 2)), np.cumsum(self.places, axis=0)])
        last = np.arange(1, len(sums))
        first = np.maximum(last - max(lasts, 1), 0)
        return np.asarray((sums[last] - sums[first]) / (last - first)[:, None])


Raised = Callable[[Array], Array]
"""The height (n,) m of a wake above the undisturbed surface at points (n, 2) m, in one frame."""


class Wake:
    """Waves of floating vehicles, frame by frame from the first."""

    def __init__(self, vehicles: Mapping[str, Floating], frames: Array, fps: float) -> None:
        ways = []
        for vehicle in vehicles.values():
            places, velocities, headings = clip_places(vehicle.clip, frames)
            ways.append(_Way(vehicle, places[:, :2], velocities, headings))
        whole, cells = _whole(ways), MOST // math.ceil(math.sqrt(len(ways)))
        following = [_following(way, cells, fps) for way in ways]
        if math.prod(whole.shape) <= min(MOST**2, sum(math.prod(box.shape) for box in following)):
            self._boxes = [_Waves(whole, ways, 1 / fps)]
        else:
            self._boxes = [_Waves(box, [way], 1 / fps) for box, way in zip(following, ways, strict=True)]

    def heights(self) -> Iterator[Raised]:
        """The wake in every frame."""
        for raised in zip(*(box.heights() for box in self._boxes), strict=True):
            yield partial(_sum, raised)


def _sum(raised: Sequence[Raised], xy: Array) -> Array:
    return np.asarray(sum(one(xy) for one in raised))


@dataclass(frozen=True)
class _Box:
    """Where waves are computed: the ``lower`` corners (n, 2) m for each frame, and the cells (rows, columns).

    In a box that follows a vehicle, waves fade around its ``centres`` (n, 2), which move smoothly, beyond the distance
    ``kept`` m along an axis; in others, near the borders only.
    """

    lower: Array
    shape: tuple[int, int]
    centres: Array | None = None
    kept: float = math.inf

    def share(self, k: int, xy: Array) -> Array:
        """How much of the waves (n,) is seen at points (n, 2) in the ``k``-th frame, 0 to 1."""
        where = (xy - self.lower[k]) / CELL
        edge = np.minimum(where, np.array(self.shape[::-1]) - 1 - where).min(axis=1) * CELL
        share = np.clip(edge / BORDER, 0.0, 1.0)
        if self.centres is not None:
            away = np.abs(xy - self.centres[k]).max(axis=1)
            share *= np.clip((self.kept - away) / FADING + 1.0, 0.0, 1.0)
        return np.asarray(share)


def _whole(ways: Sequence[_Way]) -> _Box:
    """The box around the whole ways."""
    places = np.vstack([way.places for way in ways])
    low, high = places.min(axis=0) - ROOM, places.max(axis=0) + ROOM
    rows, columns = (int(np.ceil(side / CELL / 2) * 2) for side in (high - low)[::-1])
    return _Box(np.tile(low, (len(ways[0].places), 1)), (rows, columns))


def _following(way: _Way, cells: int, fps: float) -> _Box:
    """A box of at most ``cells`` along a side that follows a vehicle and the last seconds of its way, by whole
    cells."""
    speed = float(np.linalg.norm(way.velocities, axis=1).max())
    around = 2 * ROOM + STEP
    side = min(speed * SEEN + around, CELL * cells)
    centres = way.centres(round(max(side - around, 0.0) / max(speed, 1e-9) * fps) if speed else 1)
    count = int(np.ceil(side / CELL / 2) * 2)
    lower, corner = np.empty_like(centres), centres[0] - side / 2
    for k, centre in enumerate(centres):
        off = centre - (corner + side / 2)
        if np.abs(off).max() > STEP / 2:
            corner = corner + CELL * np.round(off / CELL)
        lower[k] = corner
    return _Box(lower, (count, count), centres, side / 2 - STEP / 2 - BORDER - FADING)


class _Waves:
    """The waves of some vehicles in a box, frame by frame from the first."""

    def __init__(self, box: _Box, ways: Sequence[_Way], dt: float) -> None:
        self.box, self._ways, self._dt = box, ways, dt
        rows, columns = box.shape
        self._kx = 2 * np.pi * np.fft.rfftfreq(columns, CELL)[None]
        self._ky = 2 * np.pi * np.fft.fftfreq(rows, CELL)[:, None]
        self._omega = np.sqrt(GRAVITY * np.maximum(np.hypot(self._kx, self._ky), 1e-9))
        # transform of cubic B-splines on the cells: values over it are the coefficients of the spline through them
        self._splines = (2 + np.cos(self._kx * CELL)) * (2 + np.cos(self._ky * CELL)) / 9
        fade = np.exp(-dt / FADE)
        turn = self._omega * dt
        self._cos = fade * np.cos(turn)
        self._from_rate, self._to_rate = fade * np.sin(turn) / self._omega, fade * np.sin(turn) * self._omega
        self._rate = np.zeros(self._omega.shape, complex)
        # as if the vehicles had always moved straight at their initial speed
        self._eta = -self._depth(0, BEFORE)
        for k in range(int(BEFORE / dt), 0, -1):
            self._advance(self._depth(0, k * dt))

    def heights(self) -> Iterator[Raised]:
        """The wake in every frame."""
        for k in range(len(self.box.lower)):
            self._follow(k)
            depth = self._depth(k)
            self._advance(depth)
            # the hull itself fills the depression, so a vehicle at rest leaves no trace
            yield partial(self._at, k, np.fft.irfft2((self._eta + depth) / self._splines, self.box.shape))

    def _follow(self, k: int) -> None:
        """Move the waves within the box when it moves; those that leave it are lost."""
        moved = np.round((self.box.lower[k] - self.box.lower[max(k - 1, 0)]) / CELL)[::-1].astype(int)
        if not moved.any():
            return
        shape = self.box.shape
        steps = np.clip(moved, np.negative(shape), shape).tolist()
        kept = tuple(slice(max(step, 0), size + min(step, 0)) for step, size in zip(steps, shape, strict=True))
        to = tuple(slice(part.start - step, part.stop - step) for part, step in zip(kept, steps, strict=True))
        edges = np.outer(*(_tapered(part.stop - part.start) for part in kept))

        for waves in (self._eta, self._rate):
            field = np.zeros(shape)
            field[to] = np.fft.irfft2(waves, shape)[kept] * edges
            waves[:] = np.fft.rfft2(field)

    def _advance(self, depth: Array) -> None:
        """Advance by one frame under constant pressures, exactly, with decay; ``depth``: of the depression at which the
        pressures would be in equilibrium, p / (rho g)."""
        off = self._eta + depth
        self._eta = self._cos * off + self._from_rate * self._rate - depth
        self._rate = self._cos * self._rate - self._to_rate * off

    def _depth(self, k: int, before: float = 0.0) -> Array:
        """Transform of the depth of water with the weight that it carries of the vehicles in the ``k``-th frame, as
        smooth blots around their waterplanes; ``before`` s earlier, at the same velocities."""
        total = np.zeros(self._omega.shape, complex)
        for way in self._ways:
            vehicle, heading = way.vehicle, way.headings[k]
            place = way.places[k] - before * way.velocities[k]
            c, s = np.cos(heading), np.sin(heading)
            x, y = place - self.box.lower[k] + vehicle.centre * np.array([c, s])
            along, across = c * self._kx + s * self._ky, -s * self._kx + c * self._ky
            blot = np.exp(-((0.26 * vehicle.length * along) ** 2 + (0.3 * vehicle.beam * across) ** 2) / 2)
            moved = np.exp(-1j * self._kx * x) * np.exp(-1j * self._ky * y)
            total += vehicle.bears(k) * vehicle.volume / CELL**2 * blot * moved
        return total

    def _at(self, k: int, coefficients: Array, xy: Array) -> Array:
        """Values (n,) of the ``k``-th frame's spline at ``xy`` (n, 2) m."""
        from scipy.ndimage import map_coordinates

        share = self.box.share(k, xy)
        seen = share > 0
        where = (xy[seen] - self.box.lower[k]) / CELL
        values = np.zeros(len(xy))
        values[seen] = share[seen] * map_coordinates(
            coefficients, where[:, ::-1].T, order=3, mode="nearest", prefilter=False
        )
        return values


def _tapered(count: int) -> Array:
    """Shares (count,) that fall to zero towards both ends, over `BORDER` m."""
    return np.asarray(np.clip((np.minimum(np.arange(count), np.arange(count)[::-1]) + 0.5) * CELL / BORDER, 0.0, 1.0))


def clip_places(clip: Clip, frames: Array) -> tuple[Array, Array, Array]:
    """Positions (n, 3) m, horizontal velocities (n, 2) m/s and headings (n,) rad on ``frames``, constant beyond the
    ends."""
    matrices = clip_matrices(clip, frames)
    places = matrices[:, :3, 3]
    heading = np.unwrap(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0]))
    velocity = np.gradient(places[:, :2], axis=0) * float(clip.fps) if len(places) > 1 else np.zeros((1, 2))
    return places, velocity, heading


def clip_matrices(clip: Clip, frames: Array) -> Array:
    """Poses T_wr (n, 4, 4) on ``frames``, constant beyond the clip's ends."""
    times = np.clip((frames - clip.start_frame) / float(clip.fps), clip.times[0], clip.times[-1])
    unique, back = np.unique(times, return_inverse=True)
    return np.asarray(clip.at(unique).matrices()[back])


class Foam:
    """Foam (from 0) on the water at fixed points: it appears around and behind hulls, and fades."""

    def __init__(self, vehicles: Mapping[str, Floating], xy: Array, frames: Array, fps: float) -> None:
        self._vehicles, self._xy, self._frames, self._dt = tuple(vehicles.values()), xy, frames, 1.0 / fps
        self._places = [clip_places(vehicle.clip, frames) for vehicle in self._vehicles]

    def at(self, k: int) -> Array:
        """Foam (n,) in frame ``k``."""
        foam = np.zeros(len(self._xy))
        for vehicle, (places, velocity, heading) in zip(self._vehicles, self._places, strict=True):
            foam = np.maximum(foam, self._trail(vehicle, places, velocity, heading, k))
        return foam

    def _trail(self, vehicle: Floating, places: Array, velocity: Array, heading: Array, k: int) -> Array:
        """Churned water behind a hull, and spray from its bow and sides."""
        from scipy.spatial import cKDTree

        first = max(0, k - int(TRAIL / self._dt))
        past = slice(first, k + 1)
        forward = np.column_stack([np.cos(heading[past]), np.sin(heading[past])])
        stern = places[past, :2] + (vehicle.centre - 0.5 * vehicle.length) * forward
        distance, nearest = cKDTree(stern).query(self._xy, distance_upper_bound=2.5 * vehicle.beam + 3.0)
        near = np.isfinite(distance)
        row = nearest[near]
        age = (k - first - row) * self._dt
        bears = np.array([vehicle.bears(j) for j in range(first, k + 1)])
        speed = bears[row] * np.linalg.norm(velocity[past][row], axis=1)
        offset = self._xy[near] - stern[row]
        ahead = np.einsum("ij,ij->i", offset, forward[row])
        aside = np.abs(forward[row, 0] * offset[:, 1] - forward[row, 1] * offset[:, 0])
        width = 0.45 * vehicle.beam + 0.25 * np.sqrt(np.maximum(age, 0)) * vehicle.beam
        strength = np.clip((speed - 0.8) / 4.0, 0, 1)
        strength = strength * (ahead < 0.3) * np.exp(-age / FOAM_LIFE)
        churn = strength * np.exp(-((aside / width) ** 2))
        edges = 0.7 * strength * np.exp(-(((aside - 1.15 * width) / (0.3 * width)) ** 2 + 0.6 * age / FOAM_LIFE))
        foam = np.zeros(len(self._xy))
        foam[near] = np.maximum(churn, edges)
        return np.maximum(foam, vehicle.bears(k) * self._bow(vehicle, places[k], velocity[k], heading[k]))

    def _bow(self, vehicle: Floating, place: Array, velocity: Array, heading: float) -> Array:
        """White water along the forward sides, thrown out and back."""
        c, s = np.cos(heading), np.sin(heading)
        offset = self._xy - place[:2]
        x, y = offset @ np.array([c, s]) - vehicle.centre, offset @ np.array([-s, c])
        half = 0.5 * vehicle.length
        back = (half - x) / vehicle.length
        side = 0.5 * vehicle.beam * np.sqrt(np.clip(1.7 * back, 0, 1)) + 0.35 * vehicle.beam * np.clip(
            back - 0.15, 0, 2
        )
        strength = np.clip((float(np.linalg.norm(velocity)) - 1.5) / 5.0, 0, 1)
        band = 1.3 * np.exp(-(((np.abs(y) - side) / (0.24 * vehicle.beam + 0.1 * np.clip(back, 0, 2))) ** 2))
        return np.asarray(
            strength * band * np.clip(4 * back, 0, 1) * np.exp(-np.clip(back, 0, None) * 1.4) * (back > 0)
        )
