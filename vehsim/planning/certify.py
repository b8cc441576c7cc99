"""What a plan is worth: its clearance on the exported motion, and where its controls really lead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim._interpolate import spatial
from vehsim.clip import Clip
from vehsim.integrators import DiscreteMechanics
from vehsim.integrators.continuous import execute
from vehsim.world.obstacles import Moving, hulls_of

Array = NDArray[np.float64]

SAMPLES = 4
"""Poses looked at per segment before looking closer, ends included once."""
FINEST = 1e-3
"""How exactly the least clearance is found, m."""
HALVINGS = 14
"""How often the time between two poses is halved at most."""
LEAN = 1.2
"""How much more a body may turn between two poses than at the faster one's rate throughout."""


@dataclass(frozen=True)
class Executed:
    """How far the rig's root is from the plan when its controls are run through a fine independent integration, m."""

    mean: float
    largest: float
    final: float


def certify(
    clip: Clip,
    world: Any,
    samples: int = SAMPLES,
    progress: Callable[[str, float], None] | None = None,
    less: Callable[[Array], Array] | None = None,
    slope: float = 0.0,
) -> float:
    """Smallest distance (m) of the vehicle's hulls to terrain and obstacles on the clip's own interpolant; inf if none.

    Exact, through MuJoCo, at ``samples`` poses a segment and then between those where the way from one to the next
    leaves room for a smaller distance, until the least is known to `FINEST`. ``less``: root positions (n, 3) -> what is
    added to the distance there, where less is asked; it changes by ``slope`` a metre at most.
    """
    if world is None or (world.terrain is None and not world.obstacles) or len(clip) < 2:
        return float("inf")
    measure = _Measure(clip, world, less or (lambda positions: np.zeros(len(positions))), slope)
    fine = np.linspace(0, 1, samples, endpoint=False)
    times = np.append((clip.times[:-1, None] + np.diff(clip.times)[:, None] * fine).ravel(), clip.times[-1])
    times = np.union1d(times, measure.breaks)
    pairs = np.column_stack([np.arange(len(times) - 1), np.arange(1, len(times))])
    nearest = np.inf
    for round_ in range(HALVINGS):
        gaps, moved = measure(times, pairs)
        nearest = min(nearest, float(gaps.min()))
        if progress is not None:
            progress("certifying clearance", 1 - 0.5 ** (round_ + 1))
        # no point comes nearer than the sum of what both ends allow
        least = (gaps[pairs[:, 0]] + gaps[pairs[:, 1]] - moved) / 2
        left, right = times[pairs[least < nearest - FINEST]].T
        if not len(left):
            break
        middle = (left + right) / 2
        times, place = np.unique(np.concatenate([left, middle, middle, right]), return_inverse=True)
        pairs = place.reshape(2, 2, -1).transpose(0, 2, 1).reshape(-1, 2)
    return nearest


class _Measure:
    """Distances along a clip, and how far anything may move between two poses."""

    def __init__(self, clip: Clip, world: Any, less: Callable[[Array], Array], slope: float) -> None:
        self.clip, self.world, self.less, self.slope = clip, world, less, slope
        self.start = clip.start_frame / float(clip.fps)
        self.moving = [o for o in world.obstacles if isinstance(o, Moving)]
        knots = [o.clip.start_frame / float(o.clip.fps) + o.clip.times - self.start for o in self.moving]
        inside = np.concatenate([np.zeros(0), *knots])
        self.breaks = inside[(inside > clip.times[0]) & (inside < clip.times[-1])]
        self.reach = reach(clip.vehicle)
        self.known: dict[float, float] = {}

    def __call__(self, times: Array, pairs: NDArray[np.intp]) -> tuple[Array, Array]:
        """Distances (n,) m at ``times``, and the most that any two points can approach between ``pairs`` (m, 2), m."""
        motion, seconds = self.clip.at(times), self.start + times
        omega, velocity = spatial(motion)
        new = np.array([k for k, t in enumerate(times.tolist()) if t not in self.known], int)
        if len(new):
            poses = motion.positions[new], motion.orientations[new]
            found = self.world.clearance(self.clip.vehicle, *poses, seconds[new]) + self.less(poses[0])
            self.known.update(zip(times[new].tolist(), found.tolist(), strict=True))
        way, turn = _path(times, motion.positions, velocity, omega, pairs)
        moved = (1 + self.slope) * way + self.reach * turn
        others = np.zeros(len(pairs))
        for obstacle in self.moving:
            way, turn = _path(*obstacle.motion_at(seconds), pairs)
            others = np.maximum(others, way + reach(obstacle.clip.vehicle) * turn)
        return np.array([self.known[t] for t in times.tolist()]), moved + others


def reach(vehicle: Any) -> float:
    """How far any point of a vehicle's hulls is from its rig's root, m."""
    return float(max((np.linalg.norm(hull, axis=1).max() for hull in hulls_of(vehicle)), default=0.0))


def _path(
    times: Array, positions: Array, velocity: Array, omega: Array, pairs: NDArray[np.intp]
) -> tuple[Array, Array]:
    """How far a root goes (m,) m and turns (m,) rad, at most, between ``pairs`` (m, 2) of poses without a knot inside.

    Positions are cubic there: no longer than their control polygon.
    """
    a, b = pairs.T
    third = ((times[b] - times[a]) / 3)[:, None]
    start, end = positions[a], positions[b]
    corners = [start, start + third * velocity[a], end - third * velocity[b], end]
    way = sum(np.linalg.norm(q - p, axis=1) for p, q in pairwise(corners))
    rate = np.linalg.norm(omega, axis=1)
    return np.asarray(way), LEAN * 3 * third[:, 0] * np.maximum(rate[a], rate[b])


def executed(
    mechanics: DiscreteMechanics, g: Array, r: Array, pi: Array, c: Array, steps: Array, wind: Array
) -> Executed:
    """Run knot controls (n, c) from the first knot through RK4 on the continuous equations and compare (m)."""
    z = np.ravel(np.asarray(mechanics.knot_velocity_guess(r[0], pi[0], c[0])))
    g_real, _ = execute(mechanics.vehicle, g[0], r[0], z, c, steps, wind)
    group, origin = mechanics.vehicle.group, mechanics.vehicle.origin
    planned, real = (_root(group, origin, x) for x in (g, g_real))
    errors = np.linalg.norm(planned - real, axis=1)
    return Executed(mean=float(errors.mean()), largest=float(errors.max()), final=float(errors[-1]))


def _root(group: Any, origin: Array, g: Array) -> Array:
    from vehsim.lie import SO3

    pose = group.pose(g)
    return pose[:, 0:3] - np.einsum("nij,j->ni", SO3.matrix(pose[:, 3:7]), origin)
