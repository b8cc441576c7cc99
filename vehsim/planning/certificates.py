"""Certificates of a plan: the clearance of the exported motion, and where its controls lead when they are executed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.clip.interpolant import spatial
from vehsim.integrators import DiscreteMechanics
from vehsim.integrators.continuous import execute
from vehsim.lie.quaternions import yaw_of
from vehsim.planning.outlines import bounds_to, gaps_to
from vehsim.world.obstacles.articulated import articulated_footprint, fixed_footprint, swings_of
from vehsim.world.obstacles.obstacles import Moving, hulls_of
from vehsim.world.obstacles.plane import distance, placed

Array = NDArray[np.float64]

SAMPLES = 4
"""Poses per segment, counting one of its ends, at which outlines are measured first."""
FINEST = 1e-3
"""Accuracy of the smallest clearance, m."""
HALVINGS = 14
"""Maximum number of times that the interval between two poses is halved."""
LEAN = 1.2
"""Safety factor: an upper bound on the rotation between two poses is this times the larger angular speed of the two."""


@dataclass(frozen=True)
class Executed:
    """Distance (m) of the rig's root from the plan when a fine, independent integration executes the controls."""

    mean: float
    largest: float
    final: float


def certify(
    clip: Clip,
    world: Any,
    samples: int = 1,
    progress: Callable[[str, float], None] | None = None,
    less: Callable[[Array], Array] | None = None,
    slope: float = 0.0,
) -> float:
    """Smallest distance (m) between the vehicle's hulls and terrain or obstacles along the clip; inf without any.

    MuJoCo measures exact distances at ``samples`` poses per segment. Intervals in which the motion could come nearer
    than the smallest distance so far are halved until that distance is known to `FINEST`. ``less`` maps root positions
    (n, 3) to an allowance (n,), m, that is added to the distance, for example near a landing; it changes by at most
    ``slope`` per metre of motion.
    """
    if world is None or (world.terrain is None and not world.obstacles) or len(clip) < 2:
        return float("inf")
    add = less or (lambda positions: np.zeros(len(positions)))

    def measured(motion: Clip, seconds: Array) -> Array:
        poses = motion.positions, motion.orientations
        return np.asarray(world.clearance(clip.vehicle, *poses, seconds, motion.channels) + add(motion.positions))

    moving = [o for o in world.obstacles if o.moves]
    return _nearest(_Hulls(clip, measured, moving, slope), samples, progress)[0]


def certify_walls(clip: Clip, world: Any) -> tuple[float, Array]:
    """Smallest distance (m) between a vehicle that stands on the ground and the rock's walls and roofs, to `FINEST`,
    and the same per interval of the clip.

    Distances are exact, of the hulls to the rock's triangles, as the vehicle leans on its ground.
    """

    def measured(motion: Clip, seconds: Array) -> Array:
        poses = motion.positions, motion.orientations
        return np.asarray(world.clearance_from_walls(clip.vehicle, *poses, motion.channels))

    nearest, by_segment = _nearest(_Hulls(clip, measured), samples=1)
    return nearest, by_segment[0]


def certify_plane(
    clip: Clip,
    parts: Sequence[tuple[Any, int]],
    wanted: float = 0.0,
    samples: int = SAMPLES,
    levels: Sequence[float] = (),
) -> tuple[float, Array]:
    """Smallest signed distance (m) between a clip's vehicle and the parts, and the same per part and segment.

    Intervals in which the motion could come nearer than the smallest distance so far are halved until that distance is
    known to `FINEST`. The values per segment are the smallest of the samples; values above both that distance and
    ``wanted`` m are lower bounds. ``levels``: the heights at which the vehicle passes the parts, m, by default that of
    the clip; trailers pass over what is lower than they are.
    """
    if not parts or len(clip) < 2:
        return float("inf"), np.full((len(parts), max(len(clip) - 1, 1)), np.inf)
    turned = {name for part in articulated_footprint(clip.vehicle) for name, _, _ in part.pivots}
    channels = {name: values for name, values in clip.channels.items() if name in turned}
    bare = replace(clip, channels=channels, energy={})  # keep only what the outlines depend on
    return _nearest(_Outlines(bare, parts, wanted, levels or [float(clip.positions[0, 2])] * len(parts)), samples)


def _nearest(
    measure: _Measure, samples: int, progress: Callable[[str, float], None] | None = None
) -> tuple[float, Array]:
    """The smallest measured distance, and the smallest per row and segment (rows, segments)."""
    knots = measure.clip.times
    fine = np.linspace(0, 1, samples, endpoint=False)
    times = np.append((knots[:-1, None] + np.diff(knots)[:, None] * fine).ravel(), knots[-1])
    times = np.union1d(times, measure.breaks)
    pairs = np.column_stack([np.arange(len(times) - 1), np.arange(1, len(times))])
    nearest, by_segment = np.inf, np.zeros((0, len(knots) - 1))
    for round_ in range(HALVINGS):
        gaps, moved = measure(times, pairs, nearest)
        nearest = min(nearest, float(gaps.min()))
        by_segment = np.vstack([by_segment, np.full((len(gaps) - len(by_segment), len(knots) - 1), np.inf)])
        for side in ("left", "right"):  # a knot belongs to the segments on both sides
            segment = np.clip(np.searchsorted(knots, times, side) - 1, 0, len(knots) - 2)
            np.minimum.at(by_segment.T, segment, gaps.T)
        if progress is not None:
            progress("certifying clearance", 1 - 0.5 ** (round_ + 1))
        # lower bound on the distance between two samples, from the distances at both and the motion between them
        least = (gaps[:, pairs[:, 0]] + gaps[:, pairs[:, 1]] - moved) / 2
        left, right = times[pairs[least.min(axis=0) < nearest - FINEST]].T
        if not len(left):
            break
        middle = (left + right) / 2
        times, place = np.unique(np.concatenate([left, middle, middle, right]), return_inverse=True)
        pairs = place.reshape(2, 2, -1).transpose(0, 2, 1).reshape(-1, 2)
    return nearest, by_segment


class _Measure(ABC):
    """Distances along a clip, and bounds on the motion between two of its poses."""

    def __init__(self, clip: Clip, moving: Sequence[Moving], around: float) -> None:
        self.clip, self.moving, self.around = clip, moving, around
        self.start = clip.start_frame / float(clip.fps)
        knots = [o.clip.start_frame / float(o.clip.fps) + o.clip.times - self.start for o in moving]
        inside = np.concatenate([np.zeros(0), *knots])
        self.breaks = inside[(inside > clip.times[0]) & (inside < clip.times[-1])]

    def travel(self, times: Array, motion: Clip, pairs: NDArray[np.intp]) -> tuple[Array, Array, list[Array]]:
        """Bounds on the motion between ``pairs`` (m, 2) of poses.

        Returns the distance travelled by the root (m,), the distance that any point travels by rotation (m,), and for
        each moving obstacle the distance that the root travels relative to any of its points (m,), all in m.
        """
        omega, velocity = spatial(motion)
        moved, turn = _path(times, motion.positions, velocity, omega, pairs)
        others = []
        for o in self.moving:
            seconds = self.start + times
            at, positions, speeds, spins = o.motion_at(seconds)
            apart, turned = _path(times, motion.positions - positions, velocity - speeds, spins, pairs)
            swing = _swing(o.clip.vehicle, o.channels_at(seconds), pairs)
            stands = at[pairs[:, 0]] == at[pairs[:, 1]]  # before its first frame and after its last
            others.append(np.where(stands, moved, apart + reach(o.clip.vehicle) * turned + swing))
        return moved, self.around * turn, others

    @abstractmethod
    def __call__(self, times: Array, pairs: NDArray[np.intp], nearest: float) -> tuple[Array, Array]:
        """Distances (rows, n) m at ``times``, and bounds (rows, m) m on how much they shrink between ``pairs`` (m, 2).

        Distances above ``nearest`` m may be lower bounds.
        """


class _Hulls(_Measure):
    """Distances of hulls, measured at poses and seconds since frame 0, in one row; each pose is measured once."""

    def __init__(
        self,
        clip: Clip,
        measured: Callable[[Clip, Array], Array],
        moving: Sequence[Moving] = (),
        slope: float = 0.0,
    ) -> None:
        super().__init__(clip, moving, reach(clip.vehicle))
        self.measured, self.slope = measured, slope
        self.known: dict[float, float] = {}

    def __call__(self, times: Array, pairs: NDArray[np.intp], nearest: float) -> tuple[Array, Array]:
        motion = self.clip.at(times)
        new = np.array([k for k, t in enumerate(times.tolist()) if t not in self.known], int)
        if len(new):
            found = self.measured(self.clip.at(times[new]), self.start + times[new])
            self.known.update(zip(times[new].tolist(), found.tolist(), strict=True))
        travelled, turn, others = self.travel(times, motion, pairs)
        swing = _swing(motion.vehicle, motion.channels, pairs)
        moved = np.max([travelled, *others], axis=0) + self.slope * travelled + turn + swing
        return np.array([[self.known[t] for t in times.tolist()]]), moved[None]


class _Outlines(_Measure):
    """Distances of outlines in the plane to parts of obstacles, one row per part.

    The outlines are those of the vehicle and of each articulated part.
    """

    def __init__(self, clip: Clip, parts: Sequence[tuple[Any, int]], wanted: float, levels: Sequence[float]) -> None:
        self.outline, self.articulated = fixed_footprint(clip.vehicle), articulated_footprint(clip.vehicle)
        around = [float(np.linalg.norm(self.outline, axis=1).max())]
        around += [float(np.linalg.norm(swing.pivots[0][2])) + swing.reach for swing in self.articulated]
        super().__init__(clip, [o for o, _ in parts if o.moves], max(around))
        self.parts, self.wanted = parts, wanted
        self.meets = [
            [swing for swing in self.articulated if swing.meets(o, level)]
            for (o, _), level in zip(parts, levels, strict=True)
        ]

    def __call__(self, times: Array, pairs: NDArray[np.intp], nearest: float) -> tuple[Array, Array]:
        motion = self.clip.at(times)
        travelled, turn, others = self.travel(times, motion, pairs)
        places, yaw = motion.positions[:, :2], yaw_of(motion.orientations)
        outlines, swung = placed(self.outline, places, yaw), np.zeros(len(pairs))
        turned = {}
        for swing in self.articulated:
            turned[id(swing)] = placed(swing.at(motion.channels), places, yaw)
            steps = [np.abs(np.diff(motion.channels[name][pairs], axis=1))[:, 0] for name, _, _ in swing.pivots]
            swung = np.maximum(swung, LEAN * swing.reach * np.sum(steps, axis=0))
        their = iter(others)
        moved = np.array([(next(their) if o.moves else travelled) + turn + swung for o, _ in self.parts])
        shapes = [o.shapes_at(self.start + times)[number] for o, number in self.parts]
        bounds = np.array([bounds_to(shape, outlines) for shape in shapes])
        # the exact distance to the part with the smallest bound is an upper bound on the smallest distance
        row, column = np.unravel_index(int(bounds.argmin()), bounds.shape)
        here = shapes[row] if np.ndim(shapes[row]) < 3 else shapes[row][[column]]
        nearest = min(nearest, float(distance(outlines[[column]], here)[0]))
        enough = max(nearest, self.wanted) + float(moved.max())
        gaps = [
            np.min([gaps_to(shape, each, enough) for each in (outlines, *(turned[id(s)] for s in meets))], axis=0)
            for shape, meets in zip(shapes, self.meets, strict=True)
        ]
        return np.array(gaps), moved


def _swing(vehicle: Any, channels: Mapping[str, Array], pairs: NDArray[np.intp]) -> Array:
    """Upper bound (m,) m on how far trailers and discs move against their vehicle between ``pairs`` (m, 2)."""
    swings = {name: far for name, far in swings_of(vehicle).items() if name in channels}
    steps = [far * np.abs(np.diff(channels[name][pairs], axis=1))[:, 0] for name, far in swings.items()]
    return LEAN * np.sum(steps, axis=0) if steps else np.zeros(len(pairs))


def reach(vehicle: Any) -> float:
    """Largest distance of any point of a vehicle's hulls from its rig's root, m."""
    return float(max((np.linalg.norm(hull, axis=1).max() for hull in hulls_of(vehicle)), default=0.0))


def extent(vehicle: Any) -> float:
    """Longest side of the bounding box of a vehicle's hulls, m; zero without hulls."""
    points = np.vstack([np.zeros((1, 3)), *hulls_of(vehicle)])
    return float(np.ptp(points, axis=0).max())


def _path(
    times: Array, positions: Array, velocity: Array, omega: Array, pairs: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Upper bounds on how far a root moves (m,) m and turns (m,) rad between ``pairs`` (m, 2) of poses.

    There must be no knot between the two poses of a pair. Positions are cubic there, and therefore no longer than their
    control polygon.
    """
    a, b = pairs.T
    third = ((times[b] - times[a]) / 3)[:, None]
    start, end = positions[a], positions[b]
    corners = [start, start + third * velocity[a], end - third * velocity[b], end]
    length = sum(np.linalg.norm(q - p, axis=1) for p, q in pairwise(corners))
    rate = np.linalg.norm(omega, axis=1)
    return np.asarray(length), LEAN * 3 * third[:, 0] * np.maximum(rate[a], rate[b])


def executed(
    mechanics: DiscreteMechanics, g: Array, r: Array, pi: Array, c: Array, steps: Array, wind: Array
) -> Executed:
    """Distance (m) between a plan and its knot controls (n, c) integrated from the first knot with RK4."""
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
