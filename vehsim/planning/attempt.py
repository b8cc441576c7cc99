"""One attempt at a plan: a discretisation, its variables, and how they are solved, settled, refined and certified.

`planner.py` says in which order; what belongs here changes the state of an attempt.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip import Clip
from vehsim.planning.certify import SAMPLES, Executed, certify, certify_plane
from vehsim.planning.cover import SLOPE, forgiven, landings
from vehsim.planning.deadline import MORE, Deadline
from vehsim.planning.elements import Problem
from vehsim.planning.guess import along_clip, along_paths, clip_spans, lift
from vehsim.planning.instants import Excess, Instants
from vehsim.planning.layout import Layout
from vehsim.planning.legs import (
    cruising,
    fixed_durations,
    knots_within,
    share_known_spans,
    spans_between,
    split_segments,
    whole_frames,
)
from vehsim.planning.motion import Motion, exported
from vehsim.planning.multipliers import carried
from vehsim.planning.obstacles import FINEST, obstacle_rows
from vehsim.planning.problem import add_instants, build, distances, hold_adrift, parameter_values, variable_bounds
from vehsim.planning.request import Request
from vehsim.planning.shelf import Shelf, common
from vehsim.planning.solver import Multipliers, Solution, Solver, Start
from vehsim.planning.transcription import Transcription

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

TIGHTENINGS = 5
"""How often a motion that comes too near, or breaks a constraint between knots, is solved again."""
EXECUTED = 0.1
"""Largest accepted distance between the plan's end and where its controls lead, m, before the plan is refined."""
LADDER = ((1, 4), (1, 6), (2, 6), (4, 6))
"""Discretisations a plan climbs through: times the segments asked for, and order. Higher order is cheaper than more
segments."""
CLOSE = 48
"""The same among obstacles, and to land: between knots farther apart they could be jumped over."""
COARSE = 24
"""A plan is first found on at least as many segments, a half or a quarter of those asked for where that goes."""
SLACK = 0.01
"""How far below the asked clearance a certified motion may be, m."""
SIGHT = 4.0
"""How far from a motion found on fewer segments terrain is seen by those that refine it, beyond the clearance asked
for, m."""
LOOKS = 3
"""How often a solve begins again because it ran through an obstacle it had not seen."""
REHEARSED = 8
"""Segments the first guess is certified on to learn how long that takes, where time is limited: it looks closer
where it has to, so that their number matters little."""
CRUISE = 12.0
"""Guess of a free leg's speed, m/s, when no speed limit is lower."""


class Attempt:
    """The state of one planning: layout, variables, lengths of the legs, margin, and what was measured."""

    def __init__(self, request: Request, t: Transcription, cover: Any, progress: Progress | None):
        self.request, self.t, self.cover, self.progress = request, t, cover, progress
        self.margin, self.tightenings, self.iterations = request.clearance, 0, 0
        self.build_seconds = self.solve_seconds = 0.0
        self.deadline = Deadline(request.deadline)
        self.clearance = self.wanted = float("inf")
        self.checked = Executed(np.inf, np.inf, np.inf)
        # between rocks controls are agile throughout: the first rung would not do
        self.rung, self.lifted, self.stale, self.note = -1 + (cover is not None), False, True, ""
        self.why = self.remark = ""
        self.solvers = Shelf()
        self.solved: tuple[Multipliers, tuple[Problem, Layout]] | None = None
        self.near: NDArray[np.bool_] | None = None
        self.rows = obstacle_rows(request.vehicle, request.world, request.marks)
        self.instants = Instants(t, request.constraints)
        self.broken: list[Excess] = []
        self.before: tuple[Any, ...] | None = None

    def moved(self, request: Request, progress: Progress | None) -> Attempt:
        """A new attempt at other marks of the same shape, from where this one ended."""
        other = Attempt(request, self.t, self.cover, progress)
        other.margin, other.rung, other.layout, other.solvers = self.margin, self.rung, self.layout, self.solvers
        other.lifted, other.solved = True, self.solved
        other.x, other.lengths, other.free = self.x.copy(), self.lengths.copy(), self.free
        other.rows, other.near, other.paths = self.rows, self.near, self.paths
        other.instants.segments, other.instants.places = self.instants.segments, list(self.instants.places)
        fixed = fixed_durations(request.marks, request.fps)
        other._resize(np.where(np.isnan(fixed), other.lengths, fixed / np.array(other.layout.phases)))
        return other

    def start(self, paths: list[Array], stretch: float = 1.0, clip: Clip | None = None) -> None:
        """Layout, leg lengths (of free legs stretched) and first guess: along the paths, or a ``clip`` as it is."""
        marks, self.solved, began = self.request.marks, None, time.monotonic()
        self.paths = paths
        fixed = fixed_durations(marks, self.request.fps)
        if clip is None:
            free = stretch * cruising(marks, paths, min(CRUISE, 0.6 * self.request.limits.get("speed")))
        else:
            free = np.maximum(-np.subtract(*clip_spans(clip, marks)), 0.1)
        durations = np.where(np.isnan(fixed), free, fixed)
        share_known_spans(durations, marks, self.request.fps)
        held = np.array([mark.hold > 0 for mark in marks[:-1]])
        self.layout = Layout(self.t.sizes, split_segments(self._coarse(), durations, held))
        phases = self.layout.phases
        self.lengths = durations / np.array(phases)
        self.free = np.isnan(fixed)
        if clip is None:
            aims = self.request.aims(self.layout.mark_knots)
            self.x = along_paths(self.t, self.layout, marks, paths, self.lengths, self.request.wind, aims)
        else:
            self.x = along_clip(self.t, self.layout, marks, clip, self.lengths)
        self.guess = self.x
        self._look()
        if math.isfinite(self.deadline.end) and not (self.deadline.kept or self.deadline.late):
            self._rehearse()
            self.deadline.guessed = time.monotonic() - began

    def _rehearse(self) -> None:
        """Finish the first guess on a few segments, to know how long that takes in the end."""
        clip = self.motion.clip()
        few = clip.at(np.linspace(0.0, clip.duration, REHEARSED + 1))
        moment, share = (clip.at([0.0, part * clip.duration]) for part in (1e-3, 1 / REHEARSED))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a guess
            self._measured(moment)  # this and the next two build models, which takes longer
            self.motion.executed()
            exported(moment, self.request)
            self.deadline.rehearse(lambda: (self._measured(few), self.motion.executed()))
            longer = MORE if np.any(self.free) else 1.0  # free legs may take longer than guessed
            self.deadline.rehearse(lambda: exported(share, self.request), longer * REHEARSED)

    def _coarse(self) -> int:
        """Segments to find a plan on: as many as asked for, halved while enough are left."""
        enough = COARSE if self.rows is None and not landings(self.request.marks) else CLOSE
        segments, least = self.request.segments, max(enough, 2 * len(self.request.marks))
        while segments % 2 == 0 and segments // 2 >= least:
            segments //= 2
        return segments

    def solve(self, free: bool = True) -> None:
        """Solve on the present layout from the present variables; legs of free marks vary when ``free``.

        A motion through an obstacle that was too far away to be seen is solved again, from the same start.
        """
        start, lengths, solved = self.x.copy(), self.lengths.copy(), self.solved
        self._solve(free)
        for _ in range(LOOKS):
            if self.deadline.late or not self._overlooked():
                break
            self.x, self.lengths, self.solved = start.copy(), lengths.copy(), solved
            self._solve(free, "again")

    def _solve(self, free: bool, start: Start = "guess") -> None:
        began = time.monotonic()
        request, layout = self.request, self.layout
        solver = self._solver(spans_between(request.marks, request.fps) if free else [])
        solver.watch = self._watch() if self.progress else None
        built = time.monotonic()
        self.build_seconds += built - began
        span = [(h / 8, h * 8) if free and f else (h, h) for h, f in zip(self.lengths, self.free, strict=True)]
        lower, upper = variable_bounds(self.t, layout, span, request.limits.joints)
        hold_adrift(self.t, layout, request, self.x, lower, upper)
        self.solution: Solution = self._answer(solver, lower, upper, self.parameters(), start)
        self.x = self.solution.x
        self.lengths = self.x[layout.lengths]
        self.stale = False
        self.solve_seconds += time.monotonic() - built
        self.deadline.solved(began, layout.nodes, self.solution.hurried)
        self.worst = self._plainly(solver.problem.names()[int(np.argmax(self.solution.violations))])

    def _plainly(self, row: str) -> str:
        """A constraint as an animator knows it: the equations of motion by their frame."""
        if not row.startswith("dynamics["):
            return row
        segment = int(row[9:-1]) // len(self.layout.fractions)
        return f"the motion at frame {self.motion.seconds()[segment] * float(self.request.fps):.0f}"

    def parameters(self) -> Array:
        """The parameter vector: of wind, weights and marks, then of what is to be kept clear of."""
        request, layout = self.request, self.layout
        values = [parameter_values(self.t, layout, request.marks, request.wind, self.margin, request.weights)]
        if self.cover is not None:
            values.append(self.cover.values(layout, request.marks, self.lengths, self.motion.seconds()[0]))
        if self.rows is not None:
            values.append(self.rows.values(self.motion.seconds(), request.clearance))
        values.append(self.instants.values())
        return np.concatenate(values)

    def _answer(self, solver: Solver, lower: Array, upper: Array, values: Array, start: Start) -> Solution:
        """From the multipliers of the last solve, where there was one; from the motion alone where these mislead."""
        deadline, answer = self.deadline.solving, None
        blocked = self.cover is not None or self.rows is not None  # finer, what is in the way pushes elsewhere
        if self.solved is not None and not (blocked and self.solved[1][1] != self.layout):
            given = carried(*self.solved, (solver.problem, self.layout))
            answer = solver.solve(self.x, lower, upper, values, deadline, multipliers=given)
            self.iterations += answer.iterations
        if answer is None or not (answer.success or answer.hurried or self.deadline.late):
            answer = solver.solve(self.x, lower, upper, values, deadline, "motion" if self.lifted else start)
            self.iterations += answer.iterations
        if answer.success and answer.multipliers is not None:
            self.solved = answer.multipliers, (solver.problem, self.layout)
        return answer

    def _solver(self, spans: Sequence[tuple[list[int], float]]) -> Solver:
        """The built problem of the present layout; built once for every shape of marks, in free space once for all."""
        request = self.request
        near = None if self.near is None else self.near.tobytes()
        self.instants.settle(self.layout)
        seen = self.rows and self.rows.key, self.instants.key
        key = (self.t, self.layout, request.key, repr(spans), near, seen)
        shelf = self.solvers if self.cover is not None or request.terms else common()
        return shelf.get(key, lambda: Solver(self._problem(spans), request.solver, request.max_iterations))

    def _problem(self, spans: Sequence[tuple[list[int], float]]) -> Problem:
        return self.completed(build(self.t, self.layout, self.request, self.cover, spans, near=self.near))

    def completed(self, problem: Problem) -> Problem:
        """A built problem, with what was found to be in the way or broken since."""
        if self.rows is not None:
            self.rows.add(problem, self.t, self.layout)
        add_instants(problem, self.layout, self.instants)
        return problem

    def give_up(self, message: str) -> None:
        """End with the first guess, where nothing can be solved."""
        nothing = np.zeros(0)
        self.solution = Solution(self.x, math.nan, math.inf, False, message, 0, nothing)
        self.stale, self.worst, self.clip = False, "", self.motion.clip()
        if self.request.hazards or self.rows is not None:
            self.clearance = math.nan  # nobody measured it

    def settle(self) -> None:
        """Put free marks on whole frames, later rather than earlier."""
        if not np.any(self.free):
            return
        spans = whole_frames(self.lengths * self.layout.phases, self.request.marks, self.request.fps)
        self._resize(spans / np.array(self.layout.phases))

    def _resize(self, lengths: Array) -> None:
        """Other segment lengths for the same motion: velocities and momenta scale with the pace."""
        ratio = self.lengths / lengths
        per_substep = np.repeat(ratio, np.array(self.layout.phases) * len(self.layout.fractions))
        per_node = np.append(per_substep, per_substep[-1])
        momenta = self.layout.node(np.arange(self.layout.nodes))[sum(self.t.sizes[:2]) :]
        self.x[momenta] *= per_node
        self.x[self.layout.velocity(np.arange(self.layout.nodes - 1))] *= per_substep
        self.lengths, self.stale = lengths, True
        self.x[self.layout.lengths] = lengths

    def approach(self) -> None:
        """From the coarse discretisation a plan was found on to the one asked for, in steps on the way."""
        self.resolve()
        asked, refine = self.request.segments, self.request.refine
        while self.solution.success and 4 * self.layout.segments <= asked and self._step(asked):
            pass
        finer = self.solution.success and (refine or self.layout.segments < asked)
        if finer and not self._climb() and self.deadline.cut and self.layout.segments < asked:
            note = self.note  # a lower order may still be in time
            self._try(asked, 2)
            self.note = note
        self.checked = self.motion.executed()

    @property
    def motion(self) -> Motion:
        """What the present variables stand for."""
        return Motion(self.request, self.t, self.layout, self.x, self.lengths)

    @property
    def state(self) -> tuple[Any, ...]:
        """What a solve starts from and comes to, to be put back."""
        return self.x, self.layout, self.lengths, self.solution, self.worst, self.near

    @state.setter
    def state(self, kept: tuple[Any, ...]) -> None:
        self.x, self.layout, self.lengths, self.solution, self.worst, self.near = kept

    def _step(self, asked: int) -> bool:
        """Four times the segments where that stays below those ``asked`` for, or else twice as many."""
        few = self.layout.segments
        found = any(self._try(times * few, 2) for times in (4, 2) if 2 * times * few <= asked)
        self.note = "" if found else self.note
        return found

    def refine(self) -> None:
        """Climb the ladder of discretisations until the executed controls end where the plan does."""
        if self.resolve() or math.isinf(self.checked.final):
            self.checked = self.motion.executed()
        while self._too_far() and self.rung < len(LADDER) - 1 and not self.deadline.cut and self._climb():
            self.checked = self.motion.executed()

    def resolve(self) -> bool:
        """Solve again if anything changed since; True when it did. What failed for want of time has none for that."""
        if self.stale and (not self.deadline.late or self.solution.success):
            self.solve(free=False)
            if not self.solution.success and self.before is not None and np.any(self.free) and not self.deadline.late:
                self._later()
            return True
        return False

    def _later(self) -> None:
        """What cannot be kept in the time that free legs have taken so far, in the time it takes."""
        assert self.before is not None
        self.state = self.before
        self.solve()
        if self.solution.success:
            self.settle()
            self.solve(free=False)

    def _too_far(self) -> bool:
        return self.request.refine and self.solution.success and self.checked.final > EXECUTED

    def _climb(self) -> bool:
        """The next discretisation, from the present motion; False when it fails."""
        self.rung += 1
        times, order = LADDER[self.rung] if self.request.refine else (1, 2)
        return self._try(times * self.request.segments, order)

    def _try(self, segments: int, order: int) -> bool:
        """Solve on a finer discretisation; where that fails, keep what there was, and say so."""
        split = segments // self.layout.segments
        fine = Layout(self.t.sizes, tuple(split * n for n in self.layout.phases), order)
        if not self.deadline.allows(fine.nodes):
            self.note = f"; not refined to {segments} segments of order {order}: time limit reached"
            return False
        before = self.state
        self._see_instants()
        self.x = lift(self.t, self.layout, fine, self.x, self.request.wind)
        self.layout, self.lengths, self.lifted = fine, self.x[fine.lengths], True
        self._look()
        self.solve(free=False)
        if self.solution.success:
            return True
        self.note = f"; not refined to {segments} segments of order {order}: {self.solution.message}"
        self.state = before
        return False

    def _overlooked(self) -> bool:
        """Whether the present motion comes too near to what it did not see; that is seen from now on."""
        if self.rows is not None:
            return self.rows.overlooked(*self.motion.poses(), self.motion.seconds(), self.request.clearance)
        if self.near is None:
            return False
        missed = ~self.near & (self._away() < self.margin - FINEST)
        self.near = self.near | missed
        return bool(missed.any())

    def _away(self) -> Array:
        return distances(self.t, self.layout, self.cover, self.request.marks, self.x)

    def _look(self) -> None:
        """See the obstacles near the present motion."""
        self.near, everywhere = None, bool(self.request.weights["safety"])
        if self.lifted and self.cover is not None and self.cover.stands is not None and not everywhere:
            self.near = self._away() < self.margin + SIGHT
        if self.rows is not None:
            positions, yaw = self.motion.poses()
            self.rows.look(positions, yaw, self.motion.seconds(), self.request.clearance)

    def kept(self) -> bool:
        """Certify the clip; True when it keeps its distance and all constraints at every instant, or when nothing more
        can be done. Where the last tightening has no solution, what there was before comes back."""
        if not self.solution.success and self.before is not None:
            self.state, self.tightenings = self.before, TIGHTENINGS
        self.wanted = self.request.clearance if self.cover is not None or self.rows is not None else 0.0
        self.clip = self.motion.clip()
        self.clearance = self._measured(self.clip)
        self.broken = self.instants.measure(self.clip, self._knots, self._spans) if self.solution.success else []
        more = self._near or self.broken
        return not (more and self.solution.success and self.tightenings < TIGHTENINGS and not self.deadline.late)

    def _see_instants(self) -> None:
        """Ask constraints where the present motion breaks them between knots."""
        if self.instants.constraints:
            self.instants.settle(self.layout)
            self.instants.see(self.motion.clip(), self._knots, self._spans)

    @property
    def _near(self) -> bool:
        return bool(self.clearance < self.wanted - (SLACK if self.rows is None else FINEST))

    @property
    def _knots(self) -> Array:
        seconds = self.motion.seconds()
        return np.asarray(seconds - seconds[0])

    @property
    def _spans(self) -> list[tuple[int, int]]:
        """The first and last knot of every constraint."""
        marks, knots = self.request.marks, self.layout.mark_knots
        return [knots_within(marks, knots, term.frames) for term in self.instants.constraints]

    def _measured(self, clip: Clip) -> float:
        """The least clearance of a clip, and what it lacks where it drives."""
        clearance = self._certified(clip) if self.request.hazards else np.inf
        if self.rows is not None:
            nearest, by_segment = certify_plane(clip, self.rows.parts, self.request.clearance)
            clearance = min(clearance, nearest)
            self.lack = np.maximum(self.request.clearance - by_segment, 0.0)
        return clearance

    def _certified(self, clip: Clip) -> float:
        """The least clearance; near a landing, as much is added as less is asked for."""
        marks = self.request.marks
        less = forgiven(marks, max(self.request.clearance, SLACK))
        return certify(clip, self.request.world, SAMPLES, self.progress, less, SLOPE * bool(landings(marks)))

    def tighten(self) -> None:
        """Ask for more where the certified motion gives less than was asked for."""
        self.before = self.state
        if self._near and self.rows is not None:
            self.rows.tighten(self.lack, *self.motion.poses(), self.motion.seconds(), self.request.clearance)
        elif self._near:
            self.margin += (self.wanted - self.clearance) + 0.05
        self._see_instants()
        self.tightenings += 1
        self.stale = True

    def _watch(self) -> Callable[[int], None]:
        text = f"planning {self.layout.segments} segments at order {self.layout.order}"
        if self.tightenings:
            text += f", margin {self.margin:.2f} m"

        def report(count: int) -> None:
            assert self.progress is not None
            self.progress(f"{text}: iteration {count}", 1 - math.exp(-count / 40))

        return report
