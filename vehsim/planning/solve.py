"""Solve: from an initial guess to a solved iterate, activating constraints that a solution violates."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.planning.blocks import blocks_of
from vehsim.planning.constraints.block import Block, assemble, parameter_values, variable_bounds
from vehsim.planning.constraints.clearance import Clearance, SphereCover
from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance
from vehsim.planning.constraints.timing import fixed_durations, share_known_spans
from vehsim.planning.deadline import MORE
from vehsim.planning.guesses.pace import cruising, fewest_segments
from vehsim.planning.guesses.paths import along_clip, along_paths, clip_spans
from vehsim.planning.iterate import Certificate, Finding, Iterate, Run
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.multipliers import transferred
from vehsim.planning.problem.solver import ENDLESS, End, Patience, Solution, Solver, Start
from vehsim.planning.problem.solver_cache import common
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.landing import landings
from vehsim.planning.request.legs import path_length, split_segments
from vehsim.planning.request.request import Request
from vehsim.planning.trajectory import Trajectory, exported
from vehsim.vehicles import Holonomic
from vehsim.vehicles.definition.character import STUNT

Array = NDArray[np.float64]

COARSE = 24
"""Smallest number of segments of the first solve, in free space: the requested number is halved while this many
remain."""
CLOSE = 48
"""The same among obstacles and for landings: with fewer segments, an obstacle could lie between two knots."""
LOOKS = 3
"""Maximum number of times a solve is repeated because it violated inactive constraints."""
REHEARSED = 8
"""Segments on which the initial guess is certified to measure how long that takes, if time is limited. Certification
adds samples where necessary, so this number matters little."""


def begin(
    run: Run,
    request: Request,
    transcription: Transcription,
    cover: SphereCover | None,
    paths: Sequence[Array],
    clip: Clip | None = None,
    *,
    stretch: float = 1.0,
    blocks: Sequence[Block] | None = None,
    coarse: bool = True,
) -> Iterate:
    """The initial guess: along ``paths``, one per leg, or an unchanged ``clip``.

    ``stretch``: factor on the duration of free legs at cruising speed; ``blocks``: those of an earlier guess for the
    same request, whose active sets are kept; ``coarse``: start on fewer segments than requested,
    unless the vehicle has a largest step.
    """
    marks, began = request.marks, time.monotonic()
    blocks = blocks_of(request, transcription, cover) if blocks is None else blocks
    blocks = blocks if clip is None else tuple(block.complete() for block in blocks)
    fixed = fixed_durations(marks, request.fps)
    durations = fixed
    if np.isnan(fixed).any():
        if clip is None:
            free = stretch * cruising(request, paths)
        else:
            free = np.maximum(-np.subtract(*clip_spans(clip, request.stops)), 0.1)
        durations = np.where(np.isnan(fixed), free, fixed)
        share_known_spans(durations, marks, request.fps)
    held = np.array([mark.hold > 0 for mark in marks[:-1]])
    close = any(isinstance(block, ObstacleClearance) for block in blocks) or bool(landings(marks))
    coarse = coarse and math.isinf(request.vehicle.largest_step)  # interpolated, slips would exceed any grip
    segments = _coarse(request, paths, CLOSE if close else COARSE) if coarse else request.segments
    layout = Layout(transcription.sizes, split_segments(segments, durations, held))
    lengths = durations / np.array(layout.legs)
    if clip is None:
        aims, end = request.aims(layout.mark_knots), request.stops[-1]
        paced = [*marks[:-1], replace(marks[-1], velocity=end.velocity, speed=end.speed)]  # a loop ends as it begins
        x = along_paths(transcription, layout, paced, paths, lengths, request.wind, aims)
    else:
        x = along_clip(transcription, layout, request.stops, clip, lengths)
    guess = Trajectory(request, transcription, layout, x)
    active = tuple(block.activate(guess) for block in blocks)
    iterate = Iterate(request, transcription, layout, x, active, paths)
    if math.isfinite(run.deadline.end) and not (run.deadline.kept or run.deadline.late):
        _rehearse(run, iterate)
        run.deadline.guessed = time.monotonic() - began
    return iterate


def _coarse(request: Request, paths: Sequence[Array], enough: int) -> int:
    """Number of segments for the first solve: the requested number, halved while at least ``enough`` remain."""
    length = sum(path_length(path) for path in paths)
    segments, least = request.segments, max(enough, 2 * len(request.marks), fewest_segments(request.vehicle, length))
    while segments % 2 == 0 and segments // 2 >= least:
        segments //= 2
    return segments


def _rehearse(run: Run, iterate: Iterate) -> None:
    """Certify the initial guess on a few segments, to estimate how long that will take for the final motion."""
    clip = iterate.clip
    few = clip.at(np.linspace(0.0, clip.duration, REHEARSED + 1))
    moment, share = (clip.at([0.0, part * clip.duration]) for part in (1e-3, 1 / REHEARSED))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings about a guess are of no use
        measured(run, iterate, moment)  # this and the next two lines build models, whose time must not count
        iterate.run_controls()
        exported(moment, iterate.request)
        run.deadline.rehearse(lambda: (measured(run, iterate, few), iterate.run_controls()))
        longer = MORE if np.any(iterate.timing.free) else 1.0  # free legs may take longer than guessed
        run.deadline.rehearse(lambda: exported(share, iterate.request), longer * REHEARSED)


def measured(run: Run, iterate: Iterate, clip: Clip) -> Certificate:
    """The certificate of a clip of an iterate."""
    return Certificate(tuple(block.measure(iterate, clip, run.progress) for block in iterate.blocks))


def give_up(iterate: Iterate, message: str) -> Iterate:
    """Stop and return the initial guess, without solving."""
    solution = Solution(iterate.x, math.nan, math.inf, False, message, 0, np.zeros(0))
    hazards = iterate.request.hazards or iterate.block(ObstacleClearance) is not None
    unmeasured = Certificate((Finding(math.nan if hazards else math.inf),))
    return replace(iterate, solution=solution, stale=False, certificate=unmeasured)


def solve(run: Run, iterate: Iterate, patience: Patience = ENDLESS, *, once: bool = False) -> Iterate:
    """Solve from the iterate's variables; the durations of legs to free marks vary until they are fixed.

    A solution that violates inactive constraints activates them, and is solved again: from itself if all
    their blocks say so (`Block.continues`), else from the same start. ``patience``: that of one solve; when it
    ends, the unfinished motion is returned. ``once``: a first attempt, with steps that take fewer iterations but may
    fail.
    """
    solved = _solve_active(run, iterate, _start(iterate, once), patience)
    for _ in range(LOOKS):
        if run.deadline.late or not (solved.success or patience is ENDLESS):
            break
        blocks = tuple(block.violated(solved) for block in iterate.blocks)
        if all(new is old for new, old in zip(blocks, iterate.blocks, strict=True)):
            break
        pairs = zip(blocks, iterate.blocks, strict=True)
        near = all(new is old or new.continues for new, old in pairs)
        iterate = replace(solved, blocks=blocks, multipliers=None) if near else replace(iterate, blocks=blocks)
        solved = _solve_active(run, iterate, "again", patience)
    if solved.success and not run.deadline.late:
        solved = _completed(run, solved, patience)
    return solved


def _start(iterate: Iterate, once: bool) -> Start:
    """What the first solve of an iterate starts from; ``once``: as for `solve`."""
    vehicle = iterate.request.vehicle
    if iterate.blocked or iterate.request.traits.name == STUNT:
        return "guess"
    # trailers fold and wheels steer: a truck takes more iterations without the curvature of its constraints
    if not (once and isinstance(vehicle, Holonomic)):
        return "open"
    return "plane" if vehicle.group.planar else "space"


def _completed(run: Run, solved: Iterate, patience: Patience) -> Iterate:
    """A solution with what its blocks left out before it was found."""
    blocks = tuple(block.complete() for block in solved.blocks)
    if all(new is old for new, old in zip(blocks, solved.blocks, strict=True)):
        return solved
    whole = replace(solved, blocks=blocks)
    if not solved.transcription.rides_on_air:
        return whole
    finer = solved.rung < 0 and solved.request.refine and math.isinf(run.deadline.end)
    if finer and not landings(solved.request.marks):
        return replace(whole, stale=True)  # it is solved with that on more segments
    return _solve_active(run, whole, "again", patience)


def _solve_active(run: Run, iterate: Iterate, start: Start, patience: Patience) -> Iterate:
    """One solve with the current active sets."""
    began = time.monotonic()
    solver = _solver(run, iterate)
    clearance = iterate.block(Clearance)
    text = f"planning {iterate.request.traits.name} motion"
    text += f", {iterate.layout.segments} segments at order {iterate.layout.order}"
    if iterate.tightenings and clearance is not None:
        text += f", margin {clearance.required:.2f} m"
    solver.watch = run.watcher(text, iterate)
    built = time.monotonic()
    run.build_seconds += built - began
    solution = _answer(run, iterate, solver, start, patience)
    solver.watch = None  # it is kept for later plans
    run.solve_seconds += time.monotonic() - built
    run.deadline.solved(began, iterate.layout.knots, solution.out_of_time)
    multipliers = iterate.multipliers
    if solution.success and solution.multipliers is not None:
        multipliers = solution.multipliers, (solver.problem, iterate.layout)
    return replace(
        iterate, x=solution.x, solution=solution, problem=solver.problem, multipliers=multipliers, stale=False,
        certificate=None,
    )  # fmt: skip


def _solver(run: Run, iterate: Iterate) -> Solver:
    """The solver of an iterate's problem, built once per shape of marks and, in free space, shared by all plans."""
    request, layout, transcription = iterate.request, iterate.layout, iterate.transcription
    keys: tuple[Hashable, ...] = tuple(block.key(layout, transcription) for block in iterate.blocks)
    # a character is a preference: its costs need not be least
    content: End = "content" if request.vehicle.rolling is None else "stiff"
    end: End = run.end or ("optimal" if request.traits.name == STUNT else content)
    key = transcription, layout, keys, request.solver, request.max_iterations, end
    cache = run.solvers if iterate.cover is not None or request.terms else common()

    def make() -> Solver:
        problem = assemble(transcription, layout, iterate.blocks)
        return Solver(problem, request.solver, request.max_iterations, end)

    return cache.get(key, make)


def _answer(run: Run, iterate: Iterate, solver: Solver, start: Start, patience: Patience) -> Solution:
    """The solution, started from the multipliers of the last solve if it has any; if that fails, from the motion
    alone."""
    bounds = variable_bounds(iterate, iterate.blocks)
    values = parameter_values(solver.problem, iterate, iterate.blocks)
    deadline, answer, last = run.deadline.solving, None, iterate.multipliers
    # multipliers of obstacle constraints do not carry over to another discretisation
    if last is not None and not (iterate.blocked and last[1][1] != iterate.layout):
        given = transferred(*last, (solver.problem, iterate.layout))
        answer = solver.solve(iterate.x, *bounds, values, deadline, multipliers=given, patience=patience)
        run.iterations += answer.iterations
    if answer is None or not (answer.success or answer.out_of_time or run.deadline.late):
        start = "motion" if iterate.prolongated else start
        answer = solver.solve(iterate.x, *bounds, values, deadline, start, patience=patience)
        run.iterations += answer.iterations
    return answer
