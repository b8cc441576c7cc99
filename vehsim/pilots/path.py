"""The route of a pilot: a smooth curve through points, and its permitted speeds.

This module holds geometry and timing along a curve; `controllers.py` follows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vehsim.vehicles.definition.base import Array

SAMPLE = 1 / 240
"""Spacing of the samples of a timetable, s."""
RAMP = 0.2
"""Share of the time of an acceleration's change in which its rate rises, and of that in which it falls."""


@dataclass(frozen=True)
class Timetable:
    """Arc lengths m, speeds m/s and accelerations m/s^2 along a route, each (n,), at every `SAMPLE` since its start."""

    s: Array
    v: Array
    a: Array

    @property
    def duration(self) -> float:
        """Duration until it rests at the end of the route, s."""
        return SAMPLE * (len(self.s) - 1)

    def at(self, t: float) -> tuple[float, float, float]:
        """Arc length, speed and acceleration at ``t`` s: as at its ends before and after."""
        k = t / SAMPLE
        rows = np.arange(len(self.s))
        s, v, a = (float(np.interp(k, rows, values)) for values in (self.s, self.v, self.a))
        return s, v, a


class Route:
    """A smooth curve through points (n, d), with speeds bounded by acceleration and by bends; it ends at rest.

    ``ease`` s: time over which the acceleration changes. A vehicle slows down for a bend, and speeds up after it, by
    half of that time earlier and later, so that smooth changes never exceed the speeds of the bends.
    """

    def __init__(self, points: Array, speed: float, *, acceleration: float, lateral: float, ease: float = 0.0):
        from scipy.interpolate import CubicSpline

        apart = np.linalg.norm(np.diff(points, axis=0), axis=1)
        points = points[np.concatenate([[True], apart > 1e-6])]
        if len(points) < 2:
            points = np.vstack([points, points + np.eye(points.shape[1])[0] * 1e-6])
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        curve = CubicSpline(chord, points, bc_type="natural")
        fine = np.linspace(0, chord[-1], 50 * len(points) + 200)
        dense = curve(fine)
        self._s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
        self._curve = CubicSpline(self._s, dense)
        self.length = float(self._s[-1])
        self._acceleration, self._ease = acceleration, ease
        bend = np.linalg.norm(self._curve(self._s, 2), axis=1)
        limit = np.minimum(speed, np.sqrt(lateral / np.maximum(bend, 1e-9)))
        # the lowest within half of the ease; a vehicle is never earlier than these times
        times = np.concatenate([[0.0], np.cumsum(2 * np.diff(self._s) / (limit[1:] + limit[:-1]))])
        first = np.searchsorted(times, times - ease / 2, side="left")
        last = np.searchsorted(times, times + ease / 2, side="right")
        self._limit = np.array([limit[i:j].min() for i, j in zip(first, last, strict=True)])

    def timetable(self, along: float = 0.0, speed: float = 0.0) -> Timetable:
        """The fastest permitted drive from an arc length m, where the vehicle moves at ``speed`` m/s, to the end.

        A vehicle that is too fast there slows down by the permitted acceleration.
        """
        # each speed is the mean of those within the last `ease` seconds, so the vehicle is half of that time behind
        begin = min(along + speed * self._ease / 2, self.length - 1e-6)
        s = np.concatenate([[begin], self._s[self._s > begin]])
        v = np.interp(s, self._s, self._limit) ** 2
        v[0], v[-1] = speed**2, 0.0
        gain = 2 * self._acceleration * np.diff(s)
        for k in range(len(gain)):
            v[k + 1] = min(v[k + 1], v[k] + gain[k])
        for k in range(len(gain) - 1, -1, -1):
            v[k] = min(v[k], v[k + 1] + gain[k])
        v = np.sqrt(np.maximum(v, speed**2 - 2 * self._acceleration * (s - begin)))
        v[-1] = 0.0
        times = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[1:] + v[:-1]))])
        count = max(round(self._ease / SAMPLE), 1)
        rows = SAMPLE * np.arange(-count, int(np.ceil(times[-1] / SAMPLE)) + count + 1)
        rise = np.arange(1, count + 1)
        weights = np.clip(np.minimum(rise, rise[::-1]) / max(RAMP * count, 1.0), 0.0, 1.0)
        smooth = np.convolve(np.interp(rows, times, v, left=speed, right=0.0), weights / weights.sum(), "valid")
        travelled = np.concatenate([[0.0], np.cumsum((smooth[1:] + smooth[:-1]) * SAMPLE / 2)])
        exact = (self.length - along) / max(float(travelled[-1]), 1e-9)  # of the sampling
        return Timetable(along + exact * travelled, exact * smooth, np.gradient(exact * smooth, SAMPLE))

    def at(self, s: float, v: float, a: float) -> tuple[Array, Array, Array]:
        """Position (d,) m, velocity m/s and acceleration m/s^2 at an arc length, speed and its change."""
        along = self._curve(s, 1)
        return self._curve(s), v * along, a * along + v**2 * self._curve(s, 2)

    def places(self, spacing: float = 0.5) -> Array:
        """Points (n, d) on the curve at this spacing, m."""
        return np.asarray(self._curve(np.linspace(0, self.length, max(2, int(np.ceil(self.length / spacing)) + 1))))

    def direction(self) -> Array:
        """Unit tangent (d,) at the start of the curve."""
        return np.asarray(self._curve(0.0, 1))

    def point(self, s: float) -> Array:
        """Point at an arc length; beyond its end the curve continues straight."""
        inside = float(np.clip(s, 0.0, self.length))
        return self._curve(inside) + (s - inside) * self._curve(inside, 1)

    def bend(self, s: float) -> float:
        """Curvature at an arc length of a curve in the plane, 1/m, positive to the left; zero beyond its ends."""
        if not 0.0 <= s <= self.length:
            return 0.0
        (x, y), (x2, y2) = self._curve(s, 1), self._curve(s, 2)
        return float(x * y2 - y * x2)

    def nearest(self, position: Array, s: float, reach: float) -> float:
        """Arc length of the closest point, not before ``s`` and within ``reach`` of it."""
        span = np.linspace(s, min(s + reach, self.length), 33)
        distance = np.linalg.norm(self._curve(span) - position, axis=1)
        k = int(np.argmin(distance))
        fine = np.linspace(span[max(k - 1, 0)], span[min(k + 1, 32)], 33)
        return float(fine[int(np.argmin(np.linalg.norm(self._curve(fine) - position, axis=1)))])
