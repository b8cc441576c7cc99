"""The effect of vehicles on the visible water: their waves by linear theory, and foam.

A hull presses on the surface with its weight along its path. The waves of a moving pressure on deep water are computed
exactly, wave by wave, on a periodic box around the paths (``eta'' + g k eta = -k p / rho``, Lamb art. 242). This gives
Kelvin's wedge, its curvature in turns and its start. It is for pictures only: the wake does not push back.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

CELL = 0.4
"""Cell of the box on which waves are computed, m."""
ROOM = 36.0
"""Margin of the box around the paths, m."""
MOST = 1024
"""Largest number of cells of the box along a side."""
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


class Wake:
    """Waves of floating vehicles on a box, frame by frame from the first; `step` advances by a frame."""

    def __init__(self, vehicles: Mapping[str, Floating], level: float, frames: Array, fps: float) -> None:
        self.vehicles, self.level, self._frames, self._dt = tuple(vehicles.values()), level, frames, 1.0 / fps
        places = [clip_places(v.clip, frames) for v in self.vehicles]
        low = np.min([p[0][:, :2].min(axis=0) for p in places], axis=0) - ROOM
        high = np.max([p[0][:, :2].max(axis=0) for p in places], axis=0) + ROOM
        self.lower = low
        self.cell = max(CELL, float((high - low).max()) / MOST)
        self.shape = tuple(int(np.ceil(side / self.cell / 2) * 2) for side in (high - low)[::-1])
        rows, cols = self.shape
        self._kx = 2 * np.pi * np.fft.rfftfreq(cols, self.cell)[None]
        self._ky = 2 * np.pi * np.fft.fftfreq(rows, self.cell)[:, None]
        k = np.hypot(self._kx, self._ky)
        self._omega = np.sqrt(GRAVITY * np.maximum(k, 1e-9))
        fade = np.exp(-self._dt / FADE)
        self._cos, self._sin = fade * np.cos(self._omega * self._dt), fade * np.sin(self._omega * self._dt)
        self._eta = np.zeros(k.shape, complex)
        self._rate = np.zeros(k.shape, complex)
        self._places = places
        self._resolve()

    def _resolve(self) -> None:
        """Initialise the first frame as if the vehicles had always moved straight at their initial speed."""
        before = 2.5
        steps = int(before / self._dt)
        self._eta = -self._depth([(p - v * before, h) for (p, v, h) in self._at(0)], 0)
        for k in range(steps, 0, -1):
            self._advance(self._depth([(p - v * k * self._dt, h) for (p, v, h) in self._at(0)], 0))

    def _at(self, k: int) -> list[tuple[Array, Array, float]]:
        return [(p[k, :2], v[k], float(h[k])) for p, v, h in self._places]

    def heights(self) -> Iterator[Array]:
        """The wake's height (rows, cols) m above the undisturbed surface, for every frame."""
        for k in range(len(self._frames)):
            depth = self._depth([(p, h) for p, _, h in self._at(k)], k)
            self._advance(depth)
            # the hull itself fills the depression, so a vehicle at rest leaves no trace
            yield np.fft.irfft2(self._eta + depth, self.shape)

    def _advance(self, depth: Array) -> None:
        """Advance by one frame under constant pressures, exactly, with decay; ``depth``: of the depression at which the
        pressures would be in equilibrium, p / (rho g)."""
        off, rate = self._eta + depth, self._rate / self._omega
        self._eta = self._cos * off + self._sin * rate - depth
        self._rate = self._omega * (self._cos * rate - self._sin * off)

    def _depth(self, poses: list[tuple[Array, float]], k: int) -> Array:
        """Transform of the depth of water with the weight that it carries of the vehicles in the ``k``-th frame, as
        smooth blots around their waterplanes."""
        total = np.zeros(self._omega.shape, complex)
        for vehicle, (place, heading) in zip(self.vehicles, poses, strict=True):
            c, s = np.cos(heading), np.sin(heading)
            x, y = place - self.lower + vehicle.centre * np.array([c, s])
            along, across = c * self._kx + s * self._ky, -s * self._kx + c * self._ky
            blot = np.exp(-((0.26 * vehicle.length * along) ** 2 + (0.3 * vehicle.beam * across) ** 2) / 2)
            moved = np.exp(-1j * self._kx * x) * np.exp(-1j * self._ky * y)
            total += vehicle.bears(k) * vehicle.volume / self.cell**2 * blot * moved
        return total

    def at(self, field: Array, xy: Array) -> Array:
        """Values (n,) of a field of the box at ``xy`` (n, 2) m; fading to zero towards its borders."""
        from scipy.ndimage import map_coordinates

        where = (xy - self.lower) / self.cell
        edge = np.minimum(where, np.array(self.shape[::-1]) - 1 - where).min(axis=1) * self.cell
        inside = edge > 0
        values = np.zeros(len(xy))
        values[inside] = map_coordinates(field, where[inside][:, ::-1].T, order=3, mode="nearest")
        return values * np.clip(edge / 8.0, 0.0, 1.0)


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
