"""Retouch: the motion nearest to one that an animator edited by hand, which the vehicle can make.

The edit is compared with the solved motion, frame by frame. Around every run of touched frames, a window of the motion
is solved again: from the state with which the solved motion enters it, to the state with which it leaves. Inside, the
vehicle follows the edit as closely as its dynamics and limits permit; outside, nothing changes.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.audit import WorldScene, audit, track_of_clip
from vehsim.clip.clip import Clip
from vehsim.errors import InputError, SolveError
from vehsim.lie.quaternions import continuous, from_yaw, matrices, quaternions, yaw_of
from vehsim.planning.blocks import blocks_of
from vehsim.planning.certificates import extent
from vehsim.planning.certify import refine_and_certify
from vehsim.planning.constraints.block import Block
from vehsim.planning.constraints.clearance import SLACK, cover_for
from vehsim.planning.constraints.dynamics import UnitQuaternion
from vehsim.planning.constraints.easing import Easing
from vehsim.planning.constraints.mark_constraints import MarkConstraint, same_state
from vehsim.planning.costs import RunningCosts
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.problem import interrupts
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.stage import knot_view
from vehsim.planning.problem.transcription import Transcription, transcribe
from vehsim.planning.refine import ORDER
from vehsim.planning.request.asks import BEYOND, asks_of, beyond_character
from vehsim.planning.request.legs import poses_of
from vehsim.planning.request.marks import Mark
from vehsim.planning.request.request import Request, make_request
from vehsim.planning.solve import solve
from vehsim.planning.terms import Limits
from vehsim.planning.trajectory import Trajectory, exported
from vehsim.planning.trim import is_pushed
from vehsim.requests import Ask
from vehsim.runtime.progress import Progress
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.character import BRISK, STUNT
from vehsim.vehicles.definition.joint_channels import joint_channels
from vehsim.vehicles.definition.surfaces import SURFACES
from vehsim.world.ground.placing import place_on_terrain
from vehsim.world.obstacles.articulated import articulated_footprint
from vehsim.world.water.gliding import place_on_water

Array = NDArray[np.float64]

MOVED, TURNED = 2e-3, np.radians(0.2)
"""Distance, m, and angle, rad, from the solved motion above which a frame counts as touched."""
KEPT = 0.01
"""Largest distance of untouched frames from the solved motion, m."""
AT_KNOTS = 0.8
"""Share of `KEPT` that knots may use: the motion between them needs the rest."""
TRIES: tuple[tuple[float, float | None], ...] = ((1.0, 1 / 12), (1.5, 1 / 12), (1.0, 1 / 24), (1.5, 1 / 24))
"""How long before and after the touched frames the vehicle may prepare and recover on dry asphalt, s (`_slower` says by
what factor it is longer), and the duration of a segment, s, until a motion is found: linear controls must be able to
show those of the solved motion."""
SLIDES: tuple[tuple[float, float | None], ...] = ((1.0, None), (1.5, None))
"""The same where tyres slide, on the knots of the solved motion: other linear controls do not repeat a slide."""
FINEST = 1 / 40
"""Smallest duration of the segments of a solved motion on whose knots an edit is solved, s."""
BEND = 1e-6
"""By how much, relative to its largest slope, a control's slope changes at a knot at least."""
SETTLES = 7.0
"""Time constants after which springs have settled to a thousandth."""
FEWEST = 6
"""Smallest number of segments of a window."""
ITERATIONS = 60
"""Largest number of iterations of a solve; the solved motion is near, so most need fewer than 30."""
ALMOST = 1e-2
"""Largest violation of constraints, scaled, of a motion that stands in for an edit from which it is still far: the
motion nearest to it is found in a few iterations."""
NEAR = 0.02
"""Distance from the edit that costs one per second, m."""
LOOSE = 1e-3
"""Weight of the attitude, relative to where it was edited, on frames of which only the position was."""
SMOOTH = 0.05
"""Cost per second of controls that bend away from the solved ones by a typical control per squared brisk response time
of the vehicle. Those that merely change slowly would begin to at the ends of a window, with a jolt."""
FOLLOWS = 4.0
"""Lengths of a trailer on which it comes back to its way."""
SAME = 1e-6
"""Difference below which two frames are one."""
SPARE = 0.02
"""By how much nearer to obstacles than the solved motion an edit may come, m: the optimiser simplifies outlines and
adds a margin, which the solved motion itself would not keep."""
STANDS = 0.05
"""Distance of a flying vehicle from the ground and obstacles below which it counts as landed, m."""
AGREES = 1e-4
"""Share by which a limit that is measured on a motion may differ from the optimiser's."""
LOOP = "loop"
"""How the names of requests of a loop begin."""
SPENT = ("work", "dissipated")
"""The accounts of energy that accumulate."""


@dataclass(frozen=True)
class Retouch:
    """The retouched ``clip``, and what became of the edit.

    ``touched``: runs of frames (first, last) that the edit changed, whole and inclusive; ``windows``: the runs that
    were solved again; ``frames`` (n,): those of the edit, with the distance ``metres`` (n,) and the angle ``degrees``
    (n,) of the clip from the edit; ``kept``: largest distance of an untouched frame from the solved motion, m.
    """

    clip: Clip
    touched: tuple[tuple[int, int], ...]
    windows: tuple[tuple[int, int], ...]
    frames: Array
    metres: Array
    degrees: Array
    kept: float
    lifted: tuple[tuple[int, int], ...] = ()
    """Runs of frames on which the edit has another height or tilt than the solved motion, which the ground sets."""
    beyond: tuple[str, ...] = ()
    """The limits of its character that the clip exceeds, other than the solved motion did, in words."""

    def misses(self, more: float = KEPT) -> list[dict[str, float]]:
        """Every run of frames on which the edit is missed by ``more`` m: its ends, and where and by how much most."""
        found = []
        for first, last in _runs(self.metres > more):
            worst = first + int(self.metres[first : last + 1].argmax())
            found.append(
                {
                    "first": float(self.frames[first]),
                    "last": float(self.frames[last]),
                    "frame": float(self.frames[worst]),
                    "metres": float(self.metres[worst]),
                    "degrees": float(self.degrees[first : last + 1].max()),
                }
            )
        return found


def retouch(
    clip: Clip,
    world: Any,
    frames: Array,
    positions: Array,
    rotations: Array,
    *,
    clearance: float = 1.0,
    limits: Mapping[str, float] | None = None,
    stops: Sequence[float] = (),
    asks: Sequence[Ask] = (),
    progress: Progress | None = None,
) -> Retouch:
    """The motion nearest to an edit of ``clip``: root poses ``positions`` (n, 3) m, ``rotations`` R_wr (n, 3, 3) on
    whole ``frames`` (n,).

    ``clearance``, ``limits``: as in `plan`; ``stops``: frames whose state remains exactly, such as those of marks,
    unless the edit touches them; ``asks``: those of the plan, by which ``beyond`` of the result is measured. If they
    ask for a loop, its ends stay one: they move if the edit touches both, else they remain.
    Frames outside the clip are ignored. Raises ``InputError`` for a vehicle that nothing pushes, and ``SolveError``
    naming the frames if there is no motion that returns to the solved one, or if it stands on the ground there.
    """
    check_pushed(clip.vehicle)
    inside = (frames >= clip.start_frame) & (frames <= clip.end_frame)
    frames, positions, rotations = frames[inside], positions[inside], rotations[inside]
    edit = _Edit.of(clip, frames, positions, rotations, loop=any(ask.key.startswith(LOOP) for ask in asks))
    landed = _landed(clip, world, edit.frames)
    for a, b in _runs(landed & edit.touched):
        raise SolveError(
            f"frames {edit.frames[a]:.0f} to {edit.frames[b]:.0f} of the edit: the vehicle stands on the ground there",
            "move its mark and solve it again, or edit other frames",
            subject=clip.vehicle.name,
        )
    fixed, made = [*stops, *edit.frames[landed]], None
    slower, trailing = _slower(clip.vehicle), _trailing(clip, edit)
    slides = math.isfinite(clip.vehicle.largest_step)
    knots = _knots(clip) if slides else None
    for room, segment in SLIDES if knots is not None else sorted(TRIES) if slides else TRIES:
        before, after = (round(room * seconds * float(clip.fps)) for seconds in (slower, max(slower, trailing)))
        tried = edit.windows(before, after, fixed, knots)
        segments = knots if segment is None else segment
        assert segments is not None
        try:
            made = _solved_again(clip, world, edit, tried, segments, clearance, limits, progress)
        except SolveError as error:
            failed = error
            continue
        windows = tried
        there, solved = (each.at(_times(each, edit.frames)) for each in (made, clip))
        kept = float(np.linalg.norm(there.positions - solved.positions, axis=1)[~edit.touched].max(initial=0.0))
        if kept <= KEPT:  # between knots too
            break
    if made is None:
        raise failed
    metres, degrees = _apart(there, edit.positions, edit.rotations, edit.axes)
    touched = tuple((int(edit.frames[a]), int(edit.frames[b])) for a, b in _runs(edit.touched))
    lifted = _runs(_lifted(solved, positions, rotations)) if clip.vehicle.group.planar else []
    return Retouch(
        made,
        touched,
        tuple((math.floor(first), math.ceil(last)) for first, last in windows),
        edit.frames,
        metres,
        degrees,
        kept,
        tuple((int(edit.frames[a]), int(edit.frames[b])) for a, b in lifted),
        _beyond(clip, made, world, asks),
    )


def _beyond(solved: Clip, made: Clip, world: Any, asks: Sequence[Ask]) -> tuple[str, ...]:
    """What a motion exceeds of the character, other than the solved one did."""
    soft, scene = [ask for ask in asks if ask.key.startswith(BEYOND)], WorldScene(world, solved.vehicle)
    before, after = (beyond_character(audit(track_of_clip(clip), soft, scene)) for clip in (solved, made))
    return tuple(row for row in after if row not in before)


def _slower(vehicle: Vehicle) -> float:
    """By what factor a vehicle needs longer for the same correction than on dry asphalt.

    A force moves a mass by a distance in a time that goes with the root of 1 / force.
    """
    return float(SURFACES[vehicle.surface].friction ** -0.5)


def _trailing(clip: Clip, edit: _Edit) -> float:
    """The time, s, after which trailers follow the solved motion again after an edit; zero without trailers."""
    if not clip.vehicle.tied or not edit.touched.any():
        return 0.0
    reach = max((part.reach for part in articulated_footprint(clip.vehicle)), default=0.0)
    speeds = np.linalg.norm(clip.at(_times(clip, edit.frames[edit.touched])).twists[:, 1:], axis=1)
    return float(min(FOLLOWS * reach / max(speeds.mean(), SAME), clip.duration))


def check_pushed(vehicle: Vehicle) -> None:
    """Raise ``InputError`` if only one motion leads from a state of the vehicle, because no control pushes it."""
    if not is_pushed(vehicle):
        raise InputError(
            "no control pushes it in the air, so its path follows from its start",
            "change its start or its marks, and solve it again",
            subject=vehicle.name,
        )


@dataclass(frozen=True, eq=False)
class _Edit:
    """Edited root poses on whole ``frames`` (n,); ``moved``, ``turned`` (n,): whether position and attitude differ."""

    frames: Array
    positions: Array
    rotations: Array
    moved: NDArray[np.bool_]
    turned: NDArray[np.bool_]
    axes: int
    """Number of axes of the position that the vehicle's motion sets: 2 if the ground sets the height."""
    seam: Clip | None = None
    """The sample at both ends of a loop: where the edit moves it if it moves both, else where it was."""

    @classmethod
    def of(cls, clip: Clip, frames: Array, positions: Array, rotations: Array, loop: bool) -> _Edit:
        solved, planar = clip.at(_times(clip, frames)), clip.vehicle.group.planar
        axes = 2 if planar else 3
        if planar:  # the ground sets the tilt
            rotations = matrices(from_yaw(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])))
        metres, degrees = _apart(solved, positions, rotations, axes)
        edit = cls(frames, positions, rotations, metres > MOVED, np.radians(degrees) > TURNED, axes)
        return replace(edit, seam=edit._seam(clip)) if loop else edit

    def _seam(self, clip: Clip) -> Clip:
        solved = clip.at(clip.times[:1])
        if not self.touched[[0, -1]].all():
            return solved
        turned = continuous(np.vstack([solved.orientations, quaternions(self.rotations[:1])]))[1:]
        return replace(
            solved, positions=self.positions[:1], orientations=turned if self.turned[0] else solved.orientations
        )

    @property
    def touched(self) -> NDArray[np.bool_]:
        return self.moved | self.turned

    def windows(
        self, before: int, after: int, stops: Sequence[float], knots: Array | None = None
    ) -> list[tuple[float, float]]:
        """First and last frame of runs of touched frames, from so many frames ``before`` to ``after`` them, but not
        beyond ``stops``; from knot to knot, if their frames ``knots`` (n,) are given; joined where they meet."""
        found: list[tuple[float, float]] = []
        fixed = [round(stop - self.frames[0]) for stop in stops]
        fixed = [k for k in fixed if 0 <= k < len(self.frames) and not self.touched[k]]
        for a, b in _runs(self.touched):
            first = max([a - before, 0, *(k for k in fixed if k < a)])
            last = min([b + after, len(self.frames) - 1, *(k for k in fixed if k > b)])
            begin, end = float(self.frames[first]), float(self.frames[last])
            if knots is not None:
                i, j = np.searchsorted(knots, [begin + SAME, end - SAME])
                begin, end = float(knots[max(i - 1, 0)]), float(knots[min(j, len(knots) - 1)])
            if found and begin < found[-1][1]:
                begin = found.pop()[0]
            found.append((begin, end))
        return found

    def moved_to(self, reached: Clip, window: tuple[float, float]) -> _Edit:
        """The same touched frames, with the poses of another motion ``reached`` inside a window, where it begins."""
        inside = (self.frames >= window[0]) & (self.frames <= window[1])
        there = reached.at((self.frames[inside] - window[0]) / float(reached.fps))
        positions, rotations = self.positions.copy(), self.rotations.copy()
        positions[inside], rotations[inside] = there.positions, matrices(there.orientations)
        return replace(self, positions=positions, rotations=rotations)

    def at(self, frames: Array) -> tuple[Array, Array, Array]:
        """Positions (k, 3) and rotations (k, 3, 3) at any ``frames`` (k,), and the weights (k, 2) of their change."""
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        near = np.clip(np.round(frames - self.frames[0]).astype(int), 0, len(self.frames) - 1)
        places = CubicSpline(self.frames, self.positions)(frames)
        turns = RotationSpline(self.frames, Rotation.from_matrix(self.rotations))(frames).as_matrix()
        weights = np.column_stack([np.ones(len(near)), np.where(self.turned[near], 1.0, LOOSE)])
        return np.asarray(places), np.asarray(turns), weights

    def free(self, knots: Array) -> NDArray[np.bool_]:
        """Which of ``knots`` (k,), in frames, have only touched frames beside them, up to the next knots."""
        beside = np.concatenate([knots[:1], knots, knots[-1:]])
        still = np.concatenate([[0], np.cumsum(~self.touched)])
        low = np.clip(np.floor(beside[:-2] - self.frames[0]).astype(int), 0, len(self.frames) - 1)
        high = np.clip(np.ceil(beside[2:] - self.frames[0]).astype(int), 0, len(self.frames) - 1)
        return np.asarray(still[high + 1] == still[low])


def _solved_again(
    clip: Clip,
    world: Any,
    edit: _Edit,
    windows: Sequence[tuple[float, float]],
    segments: float | Array,
    clearance: float,
    limits: Mapping[str, float] | None,
    progress: Progress | None,
) -> Clip:
    """The clip with another motion in every window, from the state of ``clip`` at its first frame to that at its last.
    ``segments``: their duration, about, s, or the frames of their knots. Raises ``SolveError``."""
    made = clip
    for number, window in enumerate(windows):
        if progress is not None:
            progress(f"retouching frames {window[0]:.0f} to {window[1]:.0f}", number / len(windows))
        if isinstance(segments, float):
            count = int(np.ceil((window[1] - window[0]) / float(clip.fps) / segments))
        else:
            count = int(np.subtract(*np.searchsorted(segments, [window[1] - SAME, window[0] - SAME])))
        count = max(FEWEST, count)
        request, iterate = _attempt(clip, world, edit, window, count, clearance, limits, progress)
        if not iterate.success:
            why = iterate.worst() if iterate.solution else "not solved"
            raise SolveError(
                f"frames {window[0]:.0f} to {window[1]:.0f} of the edit: no motion leads back to the solved one: {why}",
                "edit less, or more frames around it",
                subject=clip.vehicle.name,
            )
        made = _replaced(made, exported(iterate.clip, request), window)
        made = _in_water(_on_springs(made, request.world, window), request.world, window)
    return made


def _attempt(
    clip: Clip,
    world: Any,
    edit: _Edit,
    window: tuple[float, float],
    count: int,
    clearance: float,
    limits: Mapping[str, float] | None,
    progress: Progress | None,
) -> tuple[Request, Iterate]:
    """The motion of a window on ``count`` segments, solved or not."""
    first, last = math.floor(window[0] + SAME), math.ceil(window[1] - SAME)
    solved = clip.at(_times(clip, np.arange(first, last + 1.0)))
    marks = [Mark(frame, position=tuple(solved.positions[j].tolist())) for frame, j in ((first, 0), (last, -1))]
    near = _clear(clip, world, solved, first, clearance)
    request = make_request(
        clip.vehicle,
        world,
        marks,
        fps=clip.fps,
        segments=count,
        clearance=near,
        limits=limits,
        character=STUNT,
        max_iterations=ITERATIONS,
    )
    exact = [replace(mark, frame=at) for mark, at in zip(request.marks, window, strict=True)]  # type: ignore[arg-type]
    request = replace(request, marks=exact)  # knots need not be on whole frames
    local = clip.at(_times(clip, np.linspace(*window, 2 * count + 1)))  # at the knots, and halfway
    request = replace(request, limits=_limits(request, local))
    run, transcription = Run(request, progress, end="near"), transcribe(request.weighed)
    with interrupts.remembered():
        cover = cover_for(request, [poses_of(local)], run.deadline.watched(progress))
        layout = Layout(transcription.sizes, (count,), ORDER)
        states = _states(transcription, _flat(local))
        x = _variables(transcription, layout, states, local.duration / count)
        ends = _ends(transcription, states, edit, window)
        blocks = [*_without_costs(request, transcription, cover, ends), ends, _Following(edit, clip)]
        guess = Trajectory(request, transcription, layout, x)
        active = tuple(block.activate(guess) for block in blocks)
        iterate = Iterate(request, transcription, layout, x, active, [poses_of(local)], rung=0)
        iterate = solve(run, iterate)
        if not iterate.success and iterate.solution is not None and iterate.solution.violation < ALMOST:
            reached = _Following(edit.moved_to(iterate.clip, window), clip, window)
            blocks = [reached if isinstance(block, _Following) else block for block in iterate.blocks]
            iterate = solve(run, replace(iterate, blocks=tuple(blocks)))
        iterate = refine_and_certify(run, iterate)
    return request, iterate


def _limits(request: Request, solved: Clip) -> Limits:
    """The limits, as far as the solved motion keeps them in a window: it may exceed them between its knots, where the
    window may begin, by what the audit allows, and no other motion begins there."""
    limits, prefix = request.limits, "limits."
    track = track_of_clip(replace(solved, times=solved.times - solved.times[0]))
    asks = asks_of(request, [float(mark.frame) for mark in request.marks])
    first, last = float(track.frames[0]), float(track.frames[-1])
    wanted = [replace(ask, first=first, last=last) for ask in asks if ask.key.startswith(prefix)]
    rows = audit(track, wanted, WorldScene(request.world, solved.vehicle))
    found = [(row.key.removeprefix(prefix), row.value, row.upper) for row in rows]
    most = {name: min(value + AGREES * abs(value), upper) for name, value, upper in found if value and upper}

    def wider(given: Mapping[str, tuple[float, float]], values: Array) -> dict[str, tuple[float, float]]:
        low, high = (
            dict(zip(solved.vehicle.joints, side.tolist(), strict=True)) for side in (values.min(0), values.max(0))
        )
        return {name: (min(a, low[name]), max(b, high[name])) for name, (a, b) in given.items()}

    return Limits(
        {name: max(value, most.get(name, value)) for name, value in limits.values.items()},
        wider(limits.joints, solved.joints),
        wider(limits.joint_rates, solved.joint_rates),
    )


def _without_costs(request: Request, transcription: Transcription, cover: Any, ends: _Ends) -> list[Block]:
    """The blocks of a plan from mark to mark, without its costs and with its ends given by states."""
    unwanted: tuple[type, ...] = (RunningCosts, Easing, MarkConstraint, *((UnitQuaternion,) if ends.begins else ()))
    return [block for block in blocks_of(request, transcription, cover) if not isinstance(block, unwanted)]


def _landed(clip: Clip, world: Any, frames: Array) -> NDArray[np.bool_]:
    """On which ``frames`` (n,) a flying vehicle touches the ground or an obstacle."""
    if clip.vehicle.group.planar or world is None or (world.terrain is None and not world.obstacles):
        return np.zeros(len(frames), bool)
    there, seconds = clip.at(_times(clip, frames)), frames / float(clip.fps)
    return np.asarray(
        world.clearance(clip.vehicle, there.positions, there.orientations, seconds, there.channels) < STANDS
    )


def _clear(clip: Clip, world: Any, solved: Clip, first: int, clearance: float) -> float:
    """The requested clearance, or less where the solved motion comes nearer, as over the place where it lands.

    A vehicle on the ground keeps it from obstacles and walls.
    """
    if world is None or (world.terrain is None and not world.obstacles):
        return clearance
    seconds = (first / float(clip.fps)) + solved.times - solved.times[0]
    there = clip.vehicle, solved.positions, solved.orientations
    if clip.vehicle.group.planar:
        from_obstacles = world.clearance_by_obstacle(*there, seconds, solved.channels)
        apart = [from_obstacles.min(initial=math.inf), world.clearance_from_walls(*there, solved.channels).min()]
    else:
        apart = [world.clearance(*there, seconds, solved.channels).min()]
    nearest = float(min(apart))
    if nearest >= clearance - SLACK:  # the audit allows no less
        return min(clearance, nearest)
    return max(0.0, nearest - SPARE)


@dataclass(frozen=True, eq=False)
class _Ends(Block):
    """The states and controls at both ends of a window: those of the solved motion, unless the edit moves them.

    ``first``, ``last``: state and scaled controls (k,) each; ``begins``, ``ends``: whether they hold.
    """

    first: Array
    last: Array
    begins: bool
    ends: bool
    still: tuple[bool, bool]
    """Whether the vehicle rests at an end that the edit moves: it then rests there too."""

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "ends", self.begins, self.ends, self.still

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if self.ends:
            element = transcription.kept("end", lambda: _end_element(transcription))
            at = np.vstack([layout.knot(layout.segments), layout.control(layout.segments)])
            problem.add(element, at, {"end": problem.parameter("end", len(self.last))})

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        return {"end": self.last} if self.ends else {}

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        layout, sizes = trajectory.layout, trajectory.transcription.sizes
        begin = np.concatenate([layout.knot(0).ravel(), layout.control(0).ravel()])
        if self.begins:
            lower[begin] = upper[begin] = self.first
        for still, knot in zip(self.still, (0, layout.segments), strict=True):
            if still:  # momenta
                rows = layout.knot(knot).ravel()[sizes[0] + sizes[1] :]
                lower[rows] = upper[rows] = 0.0


def _end_element(transcription: Transcription) -> Element:
    """The last knot (x1, c1) has the state and controls of the parameter ``end``."""
    size, s, n, count = transcription.sizes
    x1, c1, end = ca.SX.sym("x1", size + s + n), ca.SX.sym("c1", count), ca.SX.sym("end", size + s + n + count)
    x, c = ca.vertsplit(end, [0, size + s + n, size + s + n + count])
    return Element("the end of the edit", ca.vertcat(x1, c1), {"end": end}, g=same_state(transcription, x, c, x1, c1))


def _ends(transcription: Transcription, states: Array, edit: _Edit, window: tuple[float, float]) -> _Ends:
    """The ends of a window, from the first and last of its ``states``."""
    first, last = states[[0, -1]]
    begins, ends = (not edit.touched[round(frame - edit.frames[0])] for frame in window)
    if edit.seam is not None:
        seam = _states(transcription, _flat(edit.seam))[0]
        begins, first = (True, seam) if window[0] == edit.frames[0] else (begins, first)
        ends, last = (True, seam) if window[1] == edit.frames[-1] else (ends, last)
    momenta = slice(sum(transcription.sizes[:2]), sum(transcription.sizes[:3]))
    rests = np.abs(states[[0, -1], momenta]).max(axis=1, initial=0.0) < 1e-6
    still = (bool(rests[0]) and not begins, bool(rests[1]) and not ends)
    return _Ends(first, last, begins, ends, still)


def _states(transcription: Transcription, clip: Clip) -> Array:
    """States and scaled controls (n, k) of the problem's variables at the samples of a clip."""
    vehicle, group = transcription.vehicle, transcription.vehicle.group
    body = clip.positions + np.einsum("nij,j->ni", matrices(clip.orientations), vehicle.origin)
    g = group.from_pose(np.hstack([body, clip.orientations]))
    r, u, xi = clip.joints, clip.joint_rates, group.velocity_from_body(g, group.shift(clip.twists, vehicle.origin))
    if group.planar:
        g[:, 0] = poses_of(clip)[:, 3]
    pi = np.asarray(transcription.mechanics.knot_momentum.map(len(r))(r.T, u.T, xi.T)).T
    return np.hstack([g, r, pi / transcription.momentum_scale, clip.controls / transcription.control_scale])


def _variables(transcription: Transcription, layout: Layout, states: Array, length: float) -> Array:
    """The problem's variables (size,) from ``states`` (2 n + 1, k) at the knots and middles of n segments of ``length``
    s."""
    x, knots = np.zeros(layout.size), np.arange(layout.knots)
    x[layout.knot(knots)] = states[::2, : layout.state].T
    x[layout.control(knots)] = states[::2, layout.state :].T
    cuts = np.cumsum([*transcription.sizes[:3]])
    _, r, pi, c = np.split(states[1::2], cuts, axis=1)
    middles = r.T, (pi * transcription.momentum_scale).T, (c * transcription.control_scale).T
    velocities = transcription.mechanics.knot_velocity_guess.map(layout.segments)(*middles)
    x[layout.velocity(np.arange(layout.segments))] = velocities
    x[layout.lengths] = length
    return x


@dataclass(frozen=True, eq=False)
class _Following(Block):
    """The distance from the edit at every knot, as a cost; where nothing was touched, also as a bound.

    ``clip``: the solved motion, from whose controls the vehicle departs smoothly.
    """

    edit: _Edit
    clip: Clip

    def _frames(self, trajectory: Trajectory) -> Array:
        return np.asarray(trajectory.seconds() * float(trajectory.request.fps))

    def _kept(self, layout: Layout) -> NDArray[np.intp]:
        """The inner knots beside which something was not touched."""
        kept = np.flatnonzero(~self.edit.free(self._knots(layout)))
        return kept[(kept > 0) & (kept < layout.segments)]

    def _knots(self, layout: Layout) -> Array:
        """Frames of the knots of a layout of one leg."""
        first, last = self._window
        return np.linspace(first, last, layout.segments + 1)

    _window: tuple[float, float] = (0.0, 0.0)

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "following", tuple(self._kept(layout).tolist())

    def activate(self, guess: Trajectory) -> _Following:
        frames = self._frames(guess)
        return replace(self, _window=(float(frames[0]), float(frames[-1])))

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        knots = np.arange(layout.segments + 1)
        lever = max(extent(transcription.vehicle) / 2, 0.5)
        near = transcription.kept(("near", self.edit.axes), lambda: _near(transcription, self.edit.axes, lever))
        place = {"target": problem.parameter("edit", 15, len(knots))}
        problem.add(near, np.vstack([layout.knot(knots), layout.control(knots)]), place)
        bends = problem.parameter("solved bends", transcription.sizes[3], len(knots))
        ends, beside, between = knots[[0, -1]], knots[[1, -2]], knots[1:-1]
        for at, around in ((between, [between - 1, between, between + 1]), (ends, [ends, beside])):
            smooth = transcription.kept(("smooth", len(around)), partial(_smooth, transcription, len(around)))
            controls = [*map(layout.control, around), layout.duration(np.maximum(at - 1, 0))]
            problem.add(smooth, np.vstack(controls), {"bend": bends[:, at]})
        kept = self._kept(layout)
        if len(kept):
            inside = transcription.kept(("kept", self.edit.axes), lambda: _inside(transcription, self.edit.axes))
            where = {"centre": problem.parameter("kept", 3, len(kept))}
            names = [f"what was not touched at frame {frame:.0f}" for frame in self._knots(layout)[kept]]
            problem.add(inside, np.vstack([layout.knot(kept), layout.control(kept)]), where, names=names)

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        frames, layout = self._frames(trajectory), trajectory.layout
        solved = self.clip.at(np.clip(_times(self.clip, frames), self.clip.times[0], self.clip.times[-1]))
        places, turns, weights = self.edit.at(frames)
        still = ~self.edit.free(frames)
        places[still] = solved.positions[still]
        h = np.gradient(trajectory.seconds())
        h[[0, -1]] /= 2
        weights = weights * h[:, None]
        scaled = np.pad(solved.controls / trajectory.transcription.control_scale, ((1, 1), (0, 0)), mode="edge")
        target = np.hstack([places, turns.reshape(-1, 9), weights, np.zeros((len(frames), 1))])
        kept = self._kept(layout)
        values: dict[str, Any] = {"edit": target.T, "solved bends": np.diff(scaled, 2, axis=0).T}
        return values | ({"kept": solved.positions[kept].T} if len(kept) else {})


def _near(transcription: Transcription, axes: int, lever: float) -> Element:
    """The cost of the distance of a knot (x, c0) from the edit; ``target``: position (3,), rotation (9,), two weights
    and one unused number."""
    v, target = transcription.symbols("x", "c0"), ca.SX.sym("target", 15)
    view = knot_view(transcription, v["x"], v["c0"])
    off = (view.position - target[0:3])[:axes]
    turn = view.rotation - ca.reshape(target[3:12], 3, 3).T
    cost = target[12] * ca.sumsqr(off) + target[13] * lever**2 * ca.sumsqr(turn) / 2
    return Element("edit", ca.vertcat(v["x"], v["c0"]), {"target": target}, f=cost / NEAR**2)


def _smooth(transcription: Transcription, knots: int) -> Element:
    """The cost of controls that bend otherwise than the solved ones, which bend by ``bend``: (c0, c1, c2, h) at three
    ``knots``, or (c0, c1, h) at an end c0, beyond which they are the solved ones."""
    time, size = transcription.vehicle.character.response.of(BRISK), transcription.sizes[3]
    c, h, bend = [ca.SX.sym(f"c{i}", size) for i in range(knots)], ca.SX.sym("h"), ca.SX.sym("bend", size)
    slopes = [after - before for before, after in pairwise(c)]
    off = slopes[-1] - sum(slopes[:-1]) - bend
    return Element("smooth", ca.vertcat(*c, h), {"bend": bend}, f=SMOOTH * time**4 * ca.sumsqr(off) / h**3)


def _inside(transcription: Transcription, axes: int) -> Element:
    """A knot (x, c0) stays near the solved position ``centre`` (3,)."""
    v, centre = transcription.symbols("x", "c0"), ca.SX.sym("centre", 3)
    off = (knot_view(transcription, v["x"], v["c0"]).position - centre)[:axes] / (AT_KNOTS * KEPT)
    y = ca.vertcat(v["x"], v["c0"])
    return Element("kept", y, {"centre": centre}, g=ca.sumsqr(off), lower=-np.inf, upper=1.0)


# ---------------------------------------------------------------- clips


def _on_springs(clip: Clip, world: Any, window: tuple[float, float]) -> Clip:
    """The clip with its body and trailers on their springs through a window of other motion: they enter it as they
    moved before, and settle after it."""
    rig = clip.vehicle.rig
    if rig is None or "heave" not in clip.channels:
        return clip
    settles = SETTLES / (2 * np.pi * rig.suspension.frequency * rig.suspension.damping)
    first, last = _times(clip, np.array(window)) + np.array([-settles, settles])
    within = np.flatnonzero((clip.times >= first - 1e-9) & (clip.times <= last + 1e-9))
    there = {name: values[within] for name, values in clip.channels.items()}
    heights = clip.positions[within] - there.pop("heave")[:, None] * [0.0, 0.0, 1.0]
    piece = replace(clip.at(clip.times[within]), positions=heights, channels=there)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of strain, which was said where the motion was solved
        placed = place_on_terrain(piece, world)
    if len(placed) != len(within):  # it was sampled more finely
        placed = placed.at(piece.times)
    positions, attitudes = clip.positions.copy(), clip.orientations.copy()
    positions[within], attitudes[within] = placed.positions, placed.orientations
    rates = {name for name in clip.channels if name in (laws := clip.vehicle.channels) and laws[name].rate is not None}
    channels = {name: values.copy() for name, values in clip.channels.items()}
    for name in clip.channels.keys() - rates:  # wheels turn as before
        channels[name][within] = placed.channels[name]
    return replace(clip, positions=positions, orientations=continuous(attitudes), channels=channels)


def _in_water(clip: Clip, world: Any, window: tuple[float, float]) -> Clip:
    """The clip with its hull in the water through a window of other motion, which it enters and leaves as it moved
    before and moves afterwards."""
    first, last = _times(clip, np.array(window))
    within = (clip.times > first - 1e-9) & (clip.times < last + 1e-9)
    level = _flat(clip).orientations
    if clip.vehicle.floating is None or np.allclose(clip.orientations[~within], level[~within], atol=1e-9):
        return clip
    orientations = continuous(np.where(within[:, None], level, clip.orientations))
    return place_on_water(replace(clip, orientations=orientations), world)


def _knots(clip: Clip) -> Array | None:
    """Frames (n,) of the knots of a planned clip, between which its controls are linear; None for other clips, and for
    segments shorter than `FINEST`."""
    slopes = np.diff(clip.controls, axis=0) / np.diff(clip.times)[:, None]
    bends = np.abs(np.diff(slopes, axis=0)) > BEND * np.abs(slopes).max(axis=0, initial=0.0)
    times = clip.times[np.flatnonzero(np.concatenate([[True], bends.any(axis=1), [True]]))]
    gaps = np.diff(times)
    length = float(np.median(gaps))
    parts = np.maximum(np.rint(gaps / length), 1).astype(int)  # controls may be linear over several segments
    if length < FINEST:
        return None
    between = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(times[:-1], times[1:], parts, strict=True)]
    return np.asarray(clip.start_frame + np.concatenate([*between, times[-1:]]) * float(clip.fps))


def _times(clip: Clip, frames: Array) -> Array:
    """Times (n,) s of ``frames`` (n,) of a clip."""
    return np.minimum((frames - clip.start_frame) / float(clip.fps), clip.times[-1])


def _flat(clip: Clip) -> Clip:
    """The clip without the tilt that the ground gives a planar vehicle."""
    if not clip.vehicle.group.planar:
        return clip
    return replace(clip, orientations=continuous(from_yaw(yaw_of(clip.orientations))))


def _apart(clip: Clip, positions: Array, rotations: Array, axes: int) -> tuple[Array, Array]:
    """Distances (n,) m along the first ``axes`` and angles (n,) in degrees between a clip's samples and poses."""
    metres = np.linalg.norm((clip.positions - positions)[:, :axes], axis=1)
    traces = np.einsum("nij,nij->n", matrices(_flat(clip).orientations), rotations)
    return metres, np.degrees(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0)))


def _lifted(clip: Clip, positions: Array, rotations: Array) -> NDArray[np.bool_]:
    """Which samples of a clip have another height or another up direction than the poses."""
    up = np.einsum("ni,ni->n", matrices(clip.orientations)[:, :, 2], rotations[:, :, 2])
    tilt = np.arccos(np.clip(up, -1.0, 1.0))
    return np.asarray((np.abs(clip.positions[:, 2] - positions[:, 2]) > MOVED) | (tilt > TURNED))


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of true entries."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _replaced(clip: Clip, motion: Clip, window: tuple[float, float]) -> Clip:
    """The clip with another motion in a window; what accumulates, such as the angle of a wheel, continues from it, and
    everything else is afterwards what it was."""
    first, last = _times(clip, np.array(window, float))
    before, after = clip.times < first - 1e-9, clip.times > last + 1e-9
    entry, leave = clip.at(first), clip.at(last)

    def joined(old: Array, new: Array, enters: Any, leaves: Any, *, anew: bool, carried: bool) -> Array:
        new = new + anew * (enters - new[0])
        return np.concatenate([old[before], new, old[after] + carried * (new[-1] - leaves)])

    laws = clip.vehicle.channels
    rates = {name for name in clip.channels if name in laws and laws[name].rate is not None}
    turns_with_joints = joint_channels(clip.vehicle, clip.joints[:1])
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(clip, name)[before], getattr(motion, name), getattr(clip, name)[after]])
        for name in ("positions", "twists", "joint_rates", "controls")
    }
    attitudes = np.concatenate([clip.orientations[before], motion.orientations, clip.orientations[after]])
    return replace(
        clip,
        times=np.concatenate([clip.times[before], motion.times - motion.times[0] + first, clip.times[after]]),
        orientations=continuous(attitudes),
        joints=joined(clip.joints, motion.joints, entry.joints[0], leave.joints[0], anew=False, carried=True),
        channels={
            name: joined(
                values,
                motion.channels[name],
                entry.channels[name][0],
                leave.channels[name][0],
                anew=name in rates,
                carried=name in rates or name in turns_with_joints,
            )
            for name, values in clip.channels.items()
            if name in motion.channels
        },
        channel_rates={
            name: np.concatenate([values[before], motion.channel_rates[name], values[after]])
            for name, values in clip.channel_rates.items()
            if name in motion.channel_rates
        },
        energy={
            name: joined(
                values,
                motion.energy[name],
                entry.energy[name][0],
                leave.energy[name][0],
                anew=name in SPENT,
                carried=name in SPENT,
            )
            for name, values in clip.energy.items()
            if name in motion.energy
        },
        commands={},
        **columns,
    )
