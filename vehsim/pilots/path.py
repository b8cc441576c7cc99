"""The route of a pilot: a smooth curve through points, and its permitted speeds.

This module holds geometry and timing along a curve; `controllers.py` follows it.
"""

from __future__ import annotations

import numpy as np

from vehsim.vehicles.definition.base import Array


class Route:
    """A smooth curve through points (n, d), with speeds bounded by acceleration and by bends; it ends at rest.

    ``ease`` s: time over which `at` changes its acceleration, so that a vehicle can follow.
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
        bend = np.linalg.norm(self._curve(self._s, 2), axis=1)
        limit = np.minimum(speed, np.sqrt(lateral / np.maximum(bend, 1e-9)))
        limit[-1] = 0.0
        self._v = self._reachable(limit, acceleration)
        start = self._v.copy()
        start[0] = 0.0
        self._timed = self._reachable(start, acceleration)
        gaps = np.diff(self._s) / np.maximum((self._timed[1:] + self._timed[:-1]) / 2, 1e-9)
        self._t = np.concatenate([[0.0], np.cumsum(gaps)])
        self._ease = max(ease, 1e-3)
        self._slope = np.diff(self._timed) / gaps
        parts = gaps * (self._s[:-1] + gaps * (self._timed[:-1] / 2 + gaps * self._slope / 6))
        self._swept = np.concatenate([[0.0], np.cumsum(parts)])
        self.duration = float(self._t[-1] + self._ease)
        """Duration from rest to rest, s."""

    def _reachable(self, limit: Array, acceleration: float) -> Array:
        v = limit**2
        steps = 2 * acceleration * np.diff(self._s)
        for k in range(len(steps)):
            v[k + 1] = min(v[k + 1], v[k] + steps[k])
        for k in range(len(steps) - 1, -1, -1):
            v[k] = min(v[k], v[k + 1] + steps[k])
        return np.sqrt(v)

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """Position (d,) m, velocity m/s and acceleration m/s^2 at ``t`` s since the start from rest."""
        # the mean of the profile over the last `ease` seconds: the same length, never faster, continuous acceleration
        (area, travelled, v), (before, earlier, v0) = self._profile(t), self._profile(t - self._ease)
        s, rate, change = ((b - a) / self._ease for a, b in ((before, area), (earlier, travelled), (v0, v)))
        along = self._curve(min(s, self.length), 1)
        return self._curve(min(s, self.length)), rate * along, change * along + rate**2 * self._curve(s, 2)

    def _profile(self, t: float) -> tuple[float, float, float]:
        """Integral of the distance, m s, the distance, m, and the speed, m/s, at ``t`` s: at rest before and after."""
        if t <= 0:
            return 0.0, 0.0, 0.0
        beyond = max(t - self._t[-1], 0.0)
        k = int(np.clip(np.searchsorted(self._t, t, side="right") - 1, 0, len(self._t) - 2))
        since = min(t, self._t[-1]) - self._t[k]
        s, v, a = self._s[k], self._timed[k], self._slope[k]
        area = self._swept[k] + since * (s + since * (v / 2 + since * a / 6)) + beyond * self.length
        return float(area), float(s + since * (v + since * a / 2)), float(v + since * a) if not beyond else 0.0

    def speed(self, s: float) -> tuple[float, float]:
        """Speed at an arc length, and its change per metre."""
        left = max(self.length - s, 0.0)
        v = min(float(np.interp(s, self._s, self._v)), 2.0 * left)
        nudge = 1e-3
        return v, (float(np.interp(s + nudge, self._s, self._v)) - float(np.interp(s, self._s, self._v))) / nudge

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

    def nearest(self, position: Array, s: float, reach: float) -> float:
        """Arc length of the closest point, not before ``s`` and within ``reach`` of it."""
        span = np.linspace(s, min(s + reach, self.length), 33)
        distance = np.linalg.norm(self._curve(span) - position, axis=1)
        k = int(np.argmin(distance))
        fine = np.linspace(span[max(k - 1, 0)], span[min(k + 1, 32)], 33)
        return float(fine[int(np.argmin(np.linalg.norm(self._curve(fine) - position, axis=1)))])
