"""Legs: the path between two marks, in frames, seconds, metres and segments."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.lie.quaternions import yaw_of
from vehsim.planning.request.marks import Mark, given_frames, heading_of

Array = NDArray[np.float64]
OVAL, ROUND = 0.25, 0.5
"""Half the widths of a loop past a single mark, relative to its length: of an oval and of a circle."""
FAR = 0.5
"""Change of a leg, relative to its length, above which its motion leads to a worse one at the new marks than a fresh
guess, and more slowly."""


def facing(marks: Sequence[Mark], paths: Sequence[Array], aimed: Callable[[Mark], bool]) -> list[Mark]:
    """The marks; those at rest without an attitude face along their legs unless a constraint sets their heading."""
    turned = list(marks)
    for i, mark in enumerate(marks):
        if not mark.balanced or mark.heading is not None or aimed(mark):
            continue
        ahead = np.zeros(2)  # mean of the directions of arrival and departure
        if i > 0:
            ahead -= _bearing(paths[i - 1][::-1])
        if i < len(paths):
            ahead += _bearing(paths[i])
        if i and marks[i - 1].hold:
            turned[i] = replace(mark, heading=turned[i - 1].heading)
        elif np.linalg.norm(ahead) > 1e-6:
            turned[i] = replace(mark, heading=float(np.degrees(np.arctan2(ahead[1], ahead[0]))))
    return turned


def same_choices(marks: Sequence[Mark], given: Sequence[Mark], chosen: Sequence[Mark]) -> list[Mark]:
    """The marks, with the headings and joints that were ``chosen`` for the marks ``given`` before."""
    return [
        replace(
            mark,
            heading=after.heading if before.heading is None else mark.heading,
            joints=after.joints if before.joints is None else mark.joints,
        )
        for mark, before, after in zip(marks, given, chosen, strict=True)
    ]


def moved_far(before: Sequence[Mark], after: Sequence[Mark]) -> bool:
    """Whether a leg changed by more than `FAR`, or a heading by more than 90 degrees, from marks to others of the same
    shape."""
    legs = [[np.subtract(*leg) for leg in legs_between(marks)] for marks in (before, after)]
    far = any(np.linalg.norm(new - old) > FAR * np.linalg.norm(old) for old, new in zip(*legs, strict=True))
    noses = [[heading_of(mark) for mark in marks] for marks in (before, after)]
    pairs = [pair for pair in zip(*noses, strict=True) if None not in pair]
    return far or any(math.cos(old - new) < 0 for old, new in pairs)


def _bearing(path: Array) -> Array:
    """Horizontal direction (2,) of the start of a path; zero if the path is vertical there."""
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = min(steps[-1], max(5.0, 0.05 * steps[-1]))
    ahead = np.array([np.interp(at, steps, path[:, k]) - path[0, k] for k in (0, 1)])
    length = float(np.linalg.norm(ahead))
    return ahead / length if length > 1e-3 else np.zeros(2)


def bent(path: Array, share: float) -> Array:
    """A path bent sideways by a share of its length: by the full amount halfway, by nothing at its ends."""
    if not share or path_length(path) < 1e-6:
        return path
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.unique(np.concatenate([steps, np.linspace(0, steps[-1], 17)]))
    points = np.column_stack([np.interp(at, steps, path[:, k]) for k in range(3)])
    chord = path[-1] - path[0]
    aside = np.array([-chord[1], chord[0], 0.0])
    aside = aside / np.linalg.norm(aside) if np.linalg.norm(aside) > 1e-6 else np.array([1.0, 0.0, 0.0])
    return np.asarray(points + share * steps[-1] * np.sin(np.pi * at / steps[-1])[:, None] * aside)


def cut(points: Array, legs: list[tuple[Array, Array]]) -> list[Array]:
    """One path divided into legs at the points nearest to the marks, in order."""
    cuts = cuts_of(points, legs)
    spans = zip(legs, cuts[:-1], cuts[1:], strict=True)
    return [np.vstack([[*a, *points[i, 3:]], points[i : j + 1], [*b, *points[j, 3:]]]) for (a, b), i, j in spans]


def cuts_of(points: Array, legs: list[tuple[Array, Array]]) -> list[int]:
    """Indices of a path's points (k, ...) that represent the marks: its ends, and those nearest to the others, in
    order."""
    cuts = [0]
    for _, end in legs[:-1]:
        later = np.linalg.norm(points[cuts[-1] :, :3] - end, axis=1)
        cuts.append(cuts[-1] + int(np.argmin(later)))
    return [*cuts, len(points) - 1]


def poses_of(clip: Clip) -> Array:
    """Positions and headings (k, 4) m, rad along a clip, to start another plan from."""
    return np.column_stack([clip.positions, np.unwrap(yaw_of(clip.orientations))])


def legs_between(marks: Sequence[Mark]) -> list[tuple[Array, Array]]:
    """Start and end (3,) m of the leg from each mark to the next."""
    return list(pairwise(mark_positions(marks)))


def placed_marks(marks: Sequence[Mark]) -> list[int]:
    """Indices of the marks with a position, and of both ends: paths are searched between these."""
    return [i for i, mark in enumerate(marks) if mark.position is not None or i in (0, len(marks) - 1)]


def divided(paths: Sequence[Array], marks: Sequence[Mark]) -> list[Array]:
    """Paths (k, ...) between `placed_marks`, divided into one per leg: the marks between are placed by their frames."""
    legs: list[Array] = []
    for path, (i, j) in zip(paths, pairwise(placed_marks(marks)), strict=True):
        path = path if j == i + 1 else path[:, :4]  # the frames of marks between set the pace
        frames = given_frames(marks[i : j + 1])
        at = frames if np.all(np.isfinite(frames)) else np.arange(j - i + 1.0)
        steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1))])
        cuts = (at - at[0]) / (at[-1] - at[0]) * steps[-1]
        for a, b in pairwise(cuts):
            ends = [[np.interp(x, steps, column) for column in path.T] for x in (a, b)]
            legs.append(np.vstack([ends[0], path[(steps > a) & (steps < b)], ends[1]]) if j > i + 1 else path)
    return legs


def closed(marks: Sequence[Mark]) -> list[Mark]:
    """The marks of a loop, the last one where the first one is: paths lead back to it."""
    kept = ("position", "heading", "orientation", "velocity", "speed", "ease")
    return [*marks[:-1], replace(marks[-1], **{key: getattr(marks[0], key) for key in kept})]


def round_trip(marks: Sequence[Mark], width: float = OVAL) -> list[Array]:
    """Paths (k, 3) m of all legs along one smooth closed curve; ``marks``: those of a loop, as of `closed`.

    Past a single mark on the way it is an oval of half this ``width``, relative to its length, which leaves to the side
    of the first mark's heading.
    """
    from scipy.interpolate import CubicSpline

    points = mark_positions(marks)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if len(points) < 3 or steps.min() < 1e-6 or (len(points) == 3 and marks[1].at_rest):
        return [np.array(leg) for leg in pairwise(points)]
    cuts = np.arange(len(points))
    if len(points) == 3:
        first, turn, _ = points
        across = width * np.array([turn[1] - first[1], first[0] - turn[0], 0.0])  # to the right
        nose = heading_of(marks[0])
        if nose is not None and np.dot(across[:2], (math.cos(nose), math.sin(nose))) < 0:
            across = -across
        middle, cuts = (first + turn) / 2, np.array([0, 2, 4])
        points = np.array([first, middle + across, turn, middle - across, first])
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(steps)])
    curve = CubicSpline(at, points, bc_type="periodic")
    return [np.asarray(curve(np.linspace(at[a], at[b], 16 * (b - a) + 1))) for a, b in pairwise(cuts)]


def mark_positions(marks: Sequence[Mark]) -> Array:
    """A position for every mark; marks without one are spaced evenly between their neighbours."""
    known = [i for i, mark in enumerate(marks) if mark.position is not None]
    values = np.array([marks[i].position for i in known], float)
    return np.column_stack([np.interp(np.arange(len(marks)), known, values[:, k]) for k in range(3)])


def path_length(path: Array) -> float:
    return float(np.sum(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1)))


def knots_within(
    marks: Sequence[Mark], mark_knots: NDArray[np.intp], frames: tuple[int, int] | None
) -> tuple[int, int]:
    """First and last knot of a range of frames for which `with_breaks` added knots; all knots for None."""
    at = {mark.given_frame: int(knot) for mark, knot in zip(marks, mark_knots, strict=True)}
    end = int(mark_knots[-1])
    return (0, end) if frames is None else (at[frames[0]], at.get(frames[1], end))


def held_segments(legs: Sequence[int], marks: Sequence[Mark]) -> NDArray[np.bool_]:
    """Which segments (n,) belong to a hold; ``legs``: the number of segments of each leg."""
    return np.repeat([mark.hold > 0 for mark in marks[:-1]], legs)


def split_segments(segments: int, durations: Array, held: NDArray[np.bool_]) -> tuple[int, ...]:
    """Number of segments per leg, proportional to duration, at least two each; a hold is one segment."""
    counts = np.where(held, 1, 2)
    moving = np.where(held, 0.0, durations)
    share = moving / moving.sum() * max(0, segments - counts.sum())
    counts = counts + np.floor(share).astype(int)
    for i in np.argsort(np.floor(share) - share)[: max(0, segments - counts.sum())]:
        counts[i] += 1
    return tuple(int(n) for n in counts)
