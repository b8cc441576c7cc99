"""A draft: the motion while its marks are dragged. It is solved again from the last one, and nothing else is done.

A plan is refined, certified and audited; a draft is one solution of the optimal control problem on a coarse grid.
`plan` makes the motion that is exported.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vehsim.clip.clip import Clip
from vehsim.lie.quaternions import yaw_of
from vehsim.planning.constraints.clearance import SphereCover, cover_for, dragged_cover, moved_cover
from vehsim.planning.guesses.routes import initial_guess, straight
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.planner import at_marks
from vehsim.planning.problem import interrupts
from vehsim.planning.problem.solver import ENDLESS, Patience
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.legs import same_choices
from vehsim.planning.request.marks import Mark, shape
from vehsim.planning.request.marks_near_obstacles import check_marks_clear, straightened
from vehsim.planning.request.request import Request, afloat, all_marks, make_request
from vehsim.planning.restraint import restrain, restrained
from vehsim.planning.rolled import with_slip, without_slip
from vehsim.planning.solve import begin, solve
from vehsim.planning.trajectory import drawn
from vehsim.runtime.progress import Progress
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.character import STUNT
from vehsim.world.obstacles.obstacles import Obstacle, hulls_of
from vehsim.world.world import World

UNKNOWNS = 192
"""Largest number of controls of a draft, over all its segments: 96 segments with two controls, 48 with four. Enough for
fast flight, and few enough to be solved during a drag; fewer than the plan's change the motion visibly."""
ITERATIONS = 60
"""Largest number of iterations of a solve: marks that cannot be met must not hold up those that follow."""
GLANCE = Patience(5, unfinished=1e-2)
"""The iterations of one event of a drag: 0.1 s in the slowest problems. The next event goes on from there."""


@dataclass(frozen=True, eq=False)
class Draft:
    """A solved motion that follows its marks. ``success``: whether the last solve met its marks and limits.

    Make one with `draft`; `moved` returns the next.
    """

    _iterate: Iterate
    _run: Run

    @property
    def success(self) -> bool:
        return self._iterate.success

    @property
    def character(self) -> str:
        """The name of its character."""
        return self._iterate.request.traits.name

    @property
    def reason(self) -> str:
        """What a failed draft misses."""
        if self.success or self._iterate.solution is None or self._iterate.problem is None:
            return ""
        return f"worst violation: {self._iterate.worst()}"

    @property
    def unfinished(self) -> bool:
        """Whether the last solve was ended by its patience: the motion follows later, see `moved`."""
        return self._iterate.solution is not None and self._iterate.solution.unfinished

    def moved(self, marks: Sequence[Mark], world: Any = None, patience: Patience = ENDLESS) -> Draft:
        """The draft for marks that fix the same quantities at other values; ``world``: one with obstacles elsewhere;
        ``patience``: that of its solve.

        A failed solve is returned too: the next one starts from the last that succeeded. Raises ``InputError`` for
        marks that the vehicle or the world refuses.
        """
        before, cover = self._iterate.request, self._iterate.cover
        given = before.given or before.marks
        world = before.world if world is None else world
        marks = all_marks(marks, before.vehicle, world, before.terms)
        if shape(marks) != shape(given):
            raise ValueError("the marks fix other quantities than before: make a new draft")
        request = replace(before, world=world, given=marks, marks=same_choices(marks, given, before.marks))
        run = Run(request, solvers=self._run.solvers, end="draft")
        with interrupts.remembered():
            if world is not before.world:
                changed = _changed(before.world, world)
                if any(_reaches(request, obstacle, request.marks) for obstacle in changed):
                    check_marks_clear(request.vehicle, world, request.marks, request.clearance, request.fps)
                cover = self._cover(request, changed, run.deadline.watched(None))
                earlier = self._iterate.cover
                if cover is not None and (earlier is None or cover.fields != earlier.fields):  # solvers contain them
                    run = Run(request, end="draft")
            iterate = solve(run, at_marks(self._iterate, request, cover), patience)
        return Draft(iterate, run)

    def _cover(self, request: Request, changed: Sequence[Any], progress: Progress) -> SphereCover | None:
        """The cover among obstacles of which some have ``changed``: these are dragged from now on, unless something
        lands on one."""
        landed = [mark for mark in request.marks if mark.on_ground]
        if not request.hazards or any(_reaches(request, obstacle, landed) for obstacle in changed):
            return cover_for(request, self._iterate.paths, progress)
        before, names = self._iterate.cover, {obstacle.name for obstacle in changed}
        there = {obstacle.name for obstacle in request.world.standing}
        gone = any(obstacle.name not in there for obstacle in self._iterate.request.world.standing)
        if before is not None and names <= before.dragged and not gone:
            moved = moved_cover(before, request.world)
            if moved is not None:
                return moved
        return dragged_cover(request, self._iterate.paths, progress, names)

    def clip(self) -> Clip:
        """The motion on whole frames, with wheels on the ground, within a millimetre or two.

        Warnings, such as of the grip of tyres, are left to the solve.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return drawn(self._iterate, self._iterate.request.world)


def _changed(before: World, after: World) -> list[Obstacle]:
    """The standing obstacles of a world that stand elsewhere, or not at all, in another."""
    there = {obstacle.name: obstacle.content_hash for obstacle in before.standing}
    return [obstacle for obstacle in after.standing if there.get(obstacle.name) != obstacle.content_hash]


def _reaches(request: Request, obstacle: Obstacle, marks: Sequence[Mark]) -> bool:
    """Whether the vehicle may be too near to an obstacle at one of the marks: by boxes around them, which is quick."""
    points = np.vstack([np.zeros((0, 3)), *hulls_of(request.vehicle)])
    reach = request.clearance + float(np.linalg.norm(points, axis=1).max(initial=0.0))
    low, high = np.vstack(obstacle.hulls).min(axis=0) - reach, np.vstack(obstacle.hulls).max(axis=0) + reach
    places = [np.asarray(mark.position, float) for mark in marks if mark.position is not None]
    return any((low <= place).all() and (place <= high).all() for place in places)


def draft(vehicle: Vehicle, world: Any, marks: Sequence[Mark], clip: Clip | None, **options: Any) -> Draft:
    """The first draft, started from a ``clip`` with marks at the same frames, or from a path that is found; ``options``
    as in `plan`. Where the requested segments are too few, it has more.

    Raises ``InputError`` for an invalid request.
    """
    most = UNKNOWNS // max(1, len(vehicle.control_names))
    segments = max(min(most, options.get("segments", most)), 2 * len(marks))
    while True:
        request = make_request(
            vehicle, world, marks, **{**options, "refine": False, "segments": segments, "max_iterations": ITERATIONS}
        )
        made = _first(request, clip)
        if made.success or segments >= most:
            return made
        segments = min(2 * segments, most)


def _first(request: Request, clip: Clip | None) -> Draft:
    """The first draft of a request."""
    run = Run(request, end="draft")
    with interrupts.remembered():
        guess = initial_guess(request, clip, run.deadline.watched(None))
        cover = cover_for(request, guess.paths, run.deadline.watched(None))
        like = guess.clip
        marks = _facing_as(like, request) if like is not None and request.weights["course"] else request.marks
        posed = straightened(request.vehicle, request.world, marks, request.loop)
        if posed != list(request.marks):
            request = replace(request, given=request.marks, marks=posed)
        first = begin(run, request, transcribe(request.weighed), cover, guess.paths, like, coarse=False)
        iterate = first
        if request.traits.name != STUNT and (rolled := without_slip(run, request, guess)) is not None:
            iterate = restrain(run, with_slip(run, first, rolled))
        elif like is not None:  # a solved motion, in its character already: stay near it
            iterate = solve(run, replace(restrained(first), prolongated=True))
        return Draft(iterate if iterate.success else restrain(run, solve(run, first)), run)


def guessed(vehicle: Vehicle, world: Any, marks: Sequence[Mark], fps: Any) -> Clip:
    """The initial guess straight from mark to mark, also through rock: what is drawn of a shot that is not solved.

    Raises ``InputError`` for marks that contradict each other.
    """
    marks = afloat(marks, vehicle, world)
    heights = [float(mark.position[2]) for mark in marks if mark.position is not None]
    plain = [replace(mark, on_ground=False) for mark in marks]
    if vehicle.group.planar:  # the ground is that of the world
        plain = [
            mark if mark.position is None else replace(mark, position=(*mark.position[:2], heights[0]))
            for mark in plain
        ]
    request = make_request(vehicle, None, plain, fps=fps, segments=8 * len(plain), refine=False)
    start = begin(Run(request), request, transcribe(request.weighed), None, straight(request), coarse=False)
    return drawn(start, world)


def _facing_as(clip: Clip, request: Request) -> list[Mark]:
    """The marks; those at rest without an attitude, which a plan turns along its path, face as the clip does there."""
    marks = list(request.marks)
    for i, mark in enumerate(marks):
        if mark.balanced and mark.heading is None and mark.frame != "free" and not request.aimed(mark):
            time = (float(mark.frame) - clip.start_frame) / float(clip.fps)
            yaw = yaw_of(clip.at([np.clip(time, clip.times[0], clip.times[-1])]).orientations)
            marks[i] = replace(mark, heading=float(np.degrees(yaw[0])))
    return marks
