"""Refine a coarse plan: move free marks to whole frames, then use more segments and a higher order."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vehsim.planning.certificates import extent
from vehsim.planning.constraints.timing import EARLY
from vehsim.planning.guesses.prolongate import prolongate
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.solver import ENDLESS, HURRIED, Patience
from vehsim.planning.request.request import Request
from vehsim.planning.solve import solve
from vehsim.planning.trajectory import Trajectory
from vehsim.planning.trim import swims

EXECUTED, OF_SIZE, OF_CLEARANCE = 0.1, 0.025, 0.5
"""Largest accepted distance between the end of the plan and the end of its executed controls: m, and fractions of the
vehicle's greatest length and of the clearance; the least of them applies. Above it the plan is refined."""
SHARE = 0.1
"""How far from the plan its executed controls may end in addition to `execution_tolerance`, as a share of the vehicle's
length.

If they end farther away, the plan is not a motion of this vehicle, or so unstable that its controls do not reproduce
it.
"""
ORDER = 4
"""The order of refined plans."""
BRIEF = Patience(60)
"""Of a refined solve of a car on tyres: most need 15 to 50 iterations."""
LADDER = (1, 2, 4, 8)
"""Factors on the requested number of segments, in turn, of a refined plan."""


def execution_tolerance(request: Request) -> float:
    """The largest accepted distance between a plan's end and where its controls lead, m."""
    size = extent(request.vehicle)
    near = request.clearance if request.world is not None and (request.world.obstacles or request.hazards) else 0.0
    return min(EXECUTED, OF_SIZE * size or EXECUTED, OF_CLEARANCE * near or EXECUTED)


def largest_error(request: Request) -> float:
    """The distance between a plan's end and where its controls lead, m, above which the plan fails."""
    return execution_tolerance(request) + SHARE * extent(request.vehicle)


def settle_on_frames(run: Run, iterate: Iterate) -> Iterate:
    """The iterate solved with free marks on whole frames; their timing is fixed from then on."""
    open_ = iterate.timing.open and np.any(iterate.timing.free)
    return resolve(run, on_frames(iterate), iterate) if open_ else iterate


def on_frames(iterate: Iterate, early: float = EARLY) -> Iterate:
    """The same motion with free marks on whole frames, at most ``early`` of a frame too early."""
    x = iterate.stretched(iterate.timing.on_frames(iterate, early))
    return replace(iterate, x=x, stale=True).with_timing(iterate.timing.settled())


def to_requested_segments(run: Run, iterate: Iterate) -> Iterate:
    """From the coarse discretisation of the first solve to the requested one, in steps."""
    requested, refined = iterate.request.segments, iterate.request.refine
    found = True
    while found and iterate.success and 4 * iterate.layout.segments <= requested:
        iterate, found = _step(run, iterate, requested)
    if iterate.success and iterate.rung < 0 and (refined or iterate.layout.segments < requested):
        iterate, _ = _climb(run, iterate)
    return iterate.told(executed=iterate.run_controls())


def refine(run: Run, iterate: Iterate, before: Iterate | None = None) -> Iterate:
    """Refine the discretisation until the executed controls end where the plan does.

    ``before``: the iterate before a tightening.
    """
    if iterate.stale or math.isinf(iterate.executed.final):
        iterate = resolve(run, iterate, before)
        iterate = iterate.told(executed=iterate.run_controls())
    climbed = True
    while climbed and ends_elsewhere(iterate) and iterate.rung < len(LADDER) - 1 and not run.deadline.cut:
        iterate, climbed = _climb(run, iterate)
        if climbed:
            iterate = iterate.told(executed=iterate.run_controls())
    return iterate


def resolve(run: Run, iterate: Iterate, before: Iterate | None = None) -> Iterate:
    """Solve again if anything changed since the last solve; an iterate that ran out of time stays as it is.

    If this fails because free legs are fixed, solve from ``before`` with free legs and fix them again afterwards.
    """
    if not iterate.stale or (run.deadline.late and not iterate.success):
        return iterate
    solved = solve(run, iterate)
    if solved.success or before is None or not np.any(iterate.timing.free) or run.deadline.late:
        return solved
    again = replace(before, blocks=solved.blocks, tightenings=solved.tightenings)
    later = solve(run, again.with_timing(iterate.timing.opened()))
    return solve(run, on_frames(later, early=0.0)) if later.success else later


def ends_elsewhere(iterate: Iterate) -> bool:
    """Whether the executed controls of a solved and refined iterate end elsewhere than it does."""
    within = execution_tolerance(iterate.request)
    return iterate.success and iterate.request.refine and iterate.executed.final > within


def _step(run: Run, iterate: Iterate, requested: int) -> tuple[Iterate, bool]:
    """The iterate on four times or twice as many segments, fewer than ``requested``, and whether it is solved."""
    few = iterate.layout.segments
    for times in (4, 2):
        if 2 * times * few <= requested:
            iterate, found = _solved_on(run, iterate, times * few, 2)
            if found:
                return replace(iterate, note=""), True
    return iterate, False


def _climb(run: Run, iterate: Iterate) -> tuple[Iterate, bool]:
    """The iterate on the next discretisation of the ladder, and whether it was solved there."""
    rung = iterate.rung + 1
    times, order = (LADDER[rung], ORDER) if iterate.request.refine else (1, 2)
    iterate, segments = replace(iterate, rung=rung), times * iterate.request.segments
    if rung and iterate.layout.order < order:  # refined plans were not found on fewer: from order 2 they are near
        iterate, found = _solved_on(run, iterate, segments, 2)
        if not found:
            return iterate, False
    # forces of tyres are too stiff for some long segments: more of them are found sooner
    patience = ENDLESS if iterate.request.vehicle.rolling is None else BRIEF
    iterate, found = _solved_on(run, iterate, segments, order, patience)
    return replace(iterate, note="") if found else iterate, found


def _solved_on(
    run: Run, iterate: Iterate, segments: int, order: int, patience: Patience = ENDLESS
) -> tuple[Iterate, bool]:
    """The iterate on a finer discretisation and True; if that is not solved, the unchanged iterate, with a note, and
    False."""
    layout = iterate.layout
    split = segments // layout.segments
    fine = Layout(iterate.transcription.sizes, tuple(split * n for n in layout.legs), order)
    note = f"; not refined to {segments} segments of order {order}: "
    if not run.deadline.allows(fine.knots):
        return replace(iterate, note=f"{note}{HURRIED}"), False
    finer = Trajectory(iterate.request, iterate.transcription, fine, prolongate(iterate, fine))
    blocks = tuple(block.prolongate(iterate, finer) for block in iterate.blocks)
    # where joints swing to propel a vehicle, 10 of 11 solves from multipliers found no motion
    kept = None if swims(iterate.request.vehicle) else iterate.multipliers
    start = replace(iterate, layout=fine, x=finer.x, blocks=blocks, multipliers=kept, prolongated=True)
    solved = solve(run, start, patience)
    if solved.success:
        return solved, True
    assert solved.solution is not None
    return replace(iterate, note=f"{note}{solved.solution.message}", prolongated=True), False
