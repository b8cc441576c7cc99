"""`plan`: marks in, the best motion the vehicle can make through them out.

Top-down: check what is asked, find a way through free space, solve coarsely, settle on whole frames, solve to higher
order until the controls lead where the plan says, certify the motion that will be exported, tighten and repeat if it
comes too near.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vehsim.audit import Row, WorldScene, audit, missed, track_of_clip
from vehsim.clip import Clip
from vehsim.errors import InputError, SolveError
from vehsim.planning import interrupts
from vehsim.planning.asks import asks_of
from vehsim.planning.attempt import EXECUTED, SLACK, TIGHTENINGS, Array, Attempt, Progress
from vehsim.planning.certify import Executed, extent
from vehsim.planning.cover import AROUND, Cover, balls, sphere_cover
from vehsim.planning.deadline import Deadline, OutOfTime
from vehsim.planning.feasibility import refusals
from vehsim.planning.legs import (
    bent,
    cut,
    divided,
    facing,
    legs_between,
    mark_positions,
    placed_marks,
    poses_of,
    round_trip,
    same_headings,
)
from vehsim.planning.marks import Mark
from vehsim.planning.motion import exported
from vehsim.planning.obstacles import obstacle_rows
from vehsim.planning.relax import diagnose, too_early
from vehsim.planning.request import Request, all_marks, ask, shape
from vehsim.planning.terms import Term
from vehsim.planning.transcription import transcription
from vehsim.requests import Ask
from vehsim.vehicles import Vehicle
from vehsim.world.route import check_free

RETRIES = ((1.7, 0.0), (0.6, 0.08), (1.2, -0.15))
"""First guesses tried when the first fails: durations of free legs times, and how far each path bends aside, of its
length."""
LATE = "time limit reached before solving began{}: there is no more than a first guess, which nobody checked"
"""Said of a plan for which there was no time, and what it was needed for."""
MET = 1e-6
"""Violations below this are none."""
FEWEST, LEAST = 4, 16
"""Fewer segments have fewer controls than two marks at rest ask for; and segments a leg that are tried instead of so
few a leg on which a plan fails."""
FINER, MOST = 4, 256
"""Times as many segments a plan is begun again on where its controls lead elsewhere, and the most of them."""
SHARE = 0.1
"""How far the controls of a plan may end from it, of the vehicle's length, beyond what refining aims at: farther off,
the motion is not one of the vehicle's, or so unstable that its controls mean nothing."""
FASTER = 0.005
"""By how much of a vehicle's top speed a motion may be faster before it is made again below that."""
SAID = 3
"""How many asks that the finished motion misses are named."""
ROOM = 30.0
"""How far from the first path the optimiser sees the terrain, m."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned motion and what it is worth.

    ``defect``: largest constraint violation, in the problem's scaled units (m, m/s, rad); ``clearance``: smallest
    certified, m, where near a landing as much is added as less is asked for, nan where nobody measured it;
    ``executed``: how far the controls, run finely and independently, lead from the plan, m; ``segments``, ``order``: of
    the discretisation in the end.
    """

    clip: Clip
    success: bool
    message: str
    cost: float
    duration: float
    iterations: int
    solve_seconds: float
    build_seconds: float
    defect: float
    clearance: float
    executed: Executed
    segments: int
    order: int
    tightenings: int = 0
    asks: tuple[Ask, ...] = ()
    """Everything that was asked, as data."""
    audit: tuple[Row, ...] = ()
    """What the finished clip was measured to do, a row for each ask; none of a plan that failed before."""
    _attempt: Attempt | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        verdict = "solved" if self.success else "failed"
        return f"<Plan of {self.clip!r}: {verdict}, {self.message}>"

    @property
    def marks(self) -> list[Mark]:
        """The marks it was made for, holds written out and those on the ground put down."""
        return [] if self._attempt is None else list(self._attempt.request.given or self._attempt.request.marks)

    def replan(self, marks: Sequence[Mark], progress: Progress | None = None) -> Plan:
        """The plan for other marks, started from this one: quick when they ask for the same things elsewhere."""
        with interrupts.remembered():
            made = self._moved(marks, progress)
        _warn(made)
        return made

    def _moved(self, marks: Sequence[Mark], progress: Progress | None) -> Plan:
        assert self._attempt is not None
        before = self._attempt.request
        request = replace(before, marks=all_marks(marks, before.vehicle, before.world, before.terms), deadline=math.inf)
        given = before.given or before.marks
        if not self.success or shape(request.marks) != shape(given) or request.weighed is not before.weighed:
            return _solve(replace(request, given=()), progress, self.clip)
        faced = replace(request, given=request.marks, marks=same_headings(request.marks, given, before.marks))
        attempt = self._attempt.moved(faced, progress)
        if np.any(attempt.free):
            attempt.solve()
            attempt.settle()
        attempt.resolve()
        if not attempt.solution.success:  # from here there is no way: from its own first guess there may be one
            return _solve(replace(request, given=()), progress, None)
        return _finish(attempt)


def plan(
    vehicle: Vehicle,
    world: Any = None,
    marks: Sequence[Mark] = (),
    *,
    fps: Any = 24,
    segments: int = 64,
    cost: str | Mapping[str, float] = "effort",
    clearance: float = 1.0,
    limits: Mapping[str, float] | None = None,
    guess: Clip | Any = None,
    refine: bool = True,
    terms: Sequence[Term] = (),
    loop: bool = False,
    solver: str = "ipopt",
    max_iterations: int = 200,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Plan:
    """The motion through ``marks`` that costs least, certified.

    ``fps`` frames a second; ``segments`` in all, every mark on a knot; ``cost``: a name of `terms.COSTS` or weights;
    ``clearance`` m from terrain and obstacles; ``limits``: name of `terms.LIMITS` -> bound; ``guess``: a `Clip`, which
    brings joints and controls along when it is of such a vehicle, or a path (k, 3) m to start from; ``refine`` until
    the controls, executed finely, end within 0.1 m of the plan, or say so; ``terms``: costs and constraints of one's
    own (`terms.Cost`, `terms.Constraint`, `ranges.look_at`, `ranges.stay`); ``loop``: the motion ends as it begins;
    ``solver``: a name of `solver.SOLVERS`; ``time_limit`` s from the call on, after which the best motion so far comes
    back, certified. Loading counts: where it takes longer, as it may below half a second, or one where terrain is near,
    the first guess comes back, and a message that says so. Distances to a new terrain are measured once, which takes
    seconds, and are kept.

    Raises ``InputError`` for what cannot be asked. What cannot be solved comes back with ``success = False`` and a
    message, and a warning.
    """
    request = ask(
        vehicle, world, marks, fps=fps, segments=segments, cost=cost, clearance=clearance, limits=limits,
        refine=refine, terms=terms, loop=loop, solver=solver, max_iterations=max_iterations, time_limit=time_limit,
    )  # fmt: skip
    if np.any(request.wind) and not request.vehicle.feels_wind:
        warnings.warn(f"{vehicle.name}: wind is set, but the vehicle has no drag to feel it", stacklevel=2)
    with interrupts.remembered():
        made = _solve(request, progress, guess)
    _warn(made)
    return made


def _warn(plan: Plan) -> None:
    """Say of a failed plan, where it was asked for, that it is one; and what of a plan is not as it was asked for."""
    name = plan.clip.vehicle.name
    if not plan.success:
        warnings.warn(f"{name}: plan failed: {plan.message}", stacklevel=3)
    elif plan._attempt is not None and (plan._attempt.remark or "the controls end" in plan.message):
        warnings.warn(f"{name}: {plan.message}", stacklevel=3)


def _solve(request: Request, progress: Progress | None, guess: Any) -> Plan:
    """The plan; begun again below the vehicle's top speed where it outran that, and on more segments where a few have
    led the optimiser to a motion that their controls do not make."""
    if request.segments < FEWEST:
        enough = LEAST * (len(request.marks) - 1)
        made = _solve(replace(request, segments=enough), progress, guess)
        return _remarked(made, f"; on {enough} segments: {request.segments} are too few")
    made = _begin(request, progress, guess)
    if made.success and _outran(made):
        top = request.top_speed
        request = replace(request, limits=request.limits.below(top))
        made = _begin(request, progress, guess)
        own = f"the top speed of the {request.vehicle.name}, {top:g} m/s"
        made = _remarked(made, f"; kept to {own}: give velocities, or limits.speed for another")
    segments = request.segments
    while _misled(made) and segments < MOST:
        segments = min(FINER * segments, MOST)
        again = _begin(replace(request, segments=segments), progress, guess, once=True)
        if not again._attempt.solution.success:  # type: ignore[union-attr]
            break
        made = min(made, again, key=lambda plan: plan.executed.final)
    return made


def _remarked(plan: Plan, remark: str) -> Plan:
    assert plan._attempt is not None
    plan._attempt.remark += remark
    return replace(plan, message=plan.message + remark)


def _outran(plan: Plan) -> bool:
    """Whether a motion is faster than its vehicle, where nothing else was asked for."""
    assert plan._attempt is not None
    request, velocity = plan._attempt.request, 3 if plan.clip.twists.shape[1] == 6 else 1
    speeds = np.linalg.norm(plan.clip.twists[:, velocity:], axis=1)
    return bool(math.isinf(request.limits.get("speed")) and speeds.max() > (1 + FASTER) * request.top_speed)


def _misled(plan: Plan) -> bool:
    """Whether the controls, however fine, do not lead where the motion does."""
    assert plan._attempt is not None
    solved, request = plan._attempt.solution.success, plan._attempt.request
    return bool(
        solved
        and request.refine
        and plan.executed.final > EXECUTED
        and not plan._attempt.deadline.late
        and not plan._attempt.deadline.cut
    )


def _begin(request: Request, progress: Progress | None, guess: Any, once: bool = False) -> Plan:
    """The plan from one discretisation on; ``once``: without seeking other ways, or why there is none."""
    t = transcription(request.weighed)
    hurried = Deadline(request.deadline).watched(progress)
    try:
        paths = _paths(request, guess, hurried)
        cover = _cover(request, paths, hurried)
        late = ""
    except OutOfTime as error:
        paths, cover, late = _straight(request), None, f" ({error})"
    refused = "; ".join(map(str, refusals(request)))
    faced = facing(request.marks, paths, request.aimed) if request.weights["course"] else request.marks
    faced_request = request if faced == request.marks else replace(request, marks=faced, given=request.marks)
    attempt = Attempt(faced_request, t, cover, progress)
    attempt.start(paths, clip=_own(request, guess))
    if refused or attempt.deadline.hopeless:
        attempt.give_up(refused or LATE.format(late))
        return _result(attempt)
    attempt.solve()
    if not (attempt.solution.success or once):
        attempt = _otherwise(attempt, request, paths, guess)
    if not (attempt.solution.success or once):
        _again(attempt, paths, guess)
    attempt.settle()
    attempt.approach()
    return _finish(attempt)


def _otherwise(attempt: Attempt, request: Request, paths: list[Array], guess: Any) -> Attempt:
    """The attempt, or a better one, at what was asked alone: marks at rest not turned along their legs, and on more
    segments where there are few."""
    legs, few = len(request.marks) - 1, request.segments
    enough = LEAST * legs if few <= FEWEST * legs else few
    tries = [(few, "")] if attempt.request.given else []
    tries += [(enough, f"; on {enough} segments: {few} are too few")] if enough > few else []
    for segments, said in tries:
        if attempt.deadline.late:
            break
        turned = "; nothing faces along its leg: there was no such motion" if attempt.request.given else ""
        attempt = Attempt(replace(request, segments=segments), attempt.t, attempt.cover, attempt.progress)
        attempt.start(paths, clip=_own(request, guess))
        attempt.solve()
        if attempt.solution.success:
            attempt.remark = turned + said
            break
    return attempt


def _own(request: Request, guess: Any) -> Clip | None:
    """A guess that is a clip of such a vehicle: it brings joints and controls along."""
    if not isinstance(guess, Clip):
        return None
    names = [[*v.joints, *(control.name for control in v.controls)] for v in (request.vehicle, guess.vehicle)]
    return guess if names[0] == names[1] and request.vehicle.group.name == guess.vehicle.group.name else None


def _again(attempt: Attempt, paths: list[Array], guess: Any) -> None:
    """Solve from other first guesses; in free space find out first whether the marks go together at all."""
    request, blocked = attempt.request, attempt.rows is not None or attempt.cover is not None
    if not blocked and not attempt.deadline.late:
        attempt.why, near = diagnose(attempt)
        if near is not None:
            attempt.x = near
            attempt.solve()
    for wariness, (stretch, bend) in enumerate(RETRIES, 1):
        if attempt.solution.success or attempt.why or attempt.deadline.late:
            break
        ways = [bent(path, bend) if attempt.rows is None else path for path in paths]
        if attempt.rows is not None and guess is None:
            kept = [request.marks[i] for i in placed_marks(request.marks)]
            ways = divided(attempt.rows.drive(replace(request, marks=kept), wariness), request.marks)
        attempt.start(ways, stretch)
        attempt.solve()
    if attempt.solution.success or attempt.why or attempt.deadline.late:
        return
    best = attempt.state  # what of it can be met the first way, and when could all be?
    attempt.start(paths, clip=_own(request, guess))
    if blocked:
        attempt.why, near = diagnose(attempt)
        if near is not None:
            attempt.x = near
            attempt.solve()
    if not attempt.solution.success:
        attempt.why = attempt.why or too_early(attempt, attempt.guess)
        attempt.state = best


def _finish(attempt: Attempt) -> Plan:
    """Solve on whole frames, finely enough, far enough from the rock."""
    for _ in range(TIGHTENINGS + 1):
        attempt.refine()
        if attempt.kept():
            break
        attempt.tighten()
    return _result(attempt)


def _result(attempt: Attempt) -> Plan:
    """What the attempt came to."""
    request, solution = attempt.request, attempt.solution
    message, success = solution.message, solution.success
    if not success and attempt.worst:
        worst = f"worst {attempt.worst}, off by {solution.violation:.3g}"
        if solution.violation < MET:
            worst = "all that is asked is met, but not at the least cost; allow more iterations"
        message = attempt.why or f"{message}: {worst}"
    elif success and attempt.clearance < attempt.wanted - SLACK:
        success = False
        message = (
            f"certified clearance {attempt.clearance:.3f} m is below the {attempt.wanted:g} m asked for after "
            f"{attempt.tightenings} tighter solves; ask for less clearance, more segments, or other marks"
        )
    elif success and attempt.broken:
        success = False
        frames = [float(request.marks[0].frame) + each.seconds * float(request.fps) for each in attempt.broken]
        said = "; ".join(each.said(frame) for each, frame in zip(attempt.broken, frames, strict=True))
        message = f"{said}, after {attempt.tightenings} tighter solves; loosen it, or ask for more segments"
    message += attempt.remark + attempt.note
    if success and attempt.checked.final > EXECUTED and request.refine:
        off, allowed = attempt.checked.final, EXECUTED + SHARE * extent(request.vehicle)
        message += f"; executed, the controls end {off:.2f} m off"
        if off > allowed:
            success = False
            message += f", more than {allowed:.2f} m: ask for more segments, more time, or slower motion"
    begun = attempt.iterations > 0 or not attempt.deadline.hopeless  # or else there is no time for wheels on the ground
    clip = exported(attempt.clip, request) if begun else replace(attempt.clip, vehicle=request.vehicle)
    asks = asks_of(request, attempt.motion.mark_frames())
    rows = audit(track_of_clip(clip), asks, WorldScene(request.world, clip.vehicle)) if success else []
    if wrong := missed(rows):
        success = False
        message = f"the finished motion misses what was asked: {'; '.join(map(str, wrong[:SAID]))}{attempt.note}"
    return Plan(
        clip=clip,
        success=success,
        message=message,
        cost=solution.cost,
        duration=float(attempt.clip.times[-1]),
        iterations=attempt.iterations,
        solve_seconds=attempt.solve_seconds,
        build_seconds=attempt.build_seconds,
        defect=solution.violation,
        clearance=attempt.clearance,
        executed=attempt.checked,
        segments=attempt.layout.segments,
        order=attempt.layout.order,
        tightenings=attempt.tightenings,
        asks=tuple(asks),
        audit=tuple(rows),
        _attempt=attempt,
    )


def _cover(request: Request, paths: list[Array], progress: Progress) -> Any:
    """What is to be kept clear of around the paths, and the spheres that do; None where there is nothing to hit."""
    if not request.hazards:
        return None
    centres, radii = sphere_cover(request.vehicle)
    points = np.vstack([path[:, :3] for path in paths])
    room = np.array([points.min(axis=0) - ROOM, points.max(axis=0) + ROOM])
    if request.world.terrain is not None and request.world.standing:  # finer than the terrain's whole
        field = request.world.distance_field(progress, box=room)
    else:
        field = request.world.distance_field(progress, box=_airspace(request))
        field = None if field is None else field.crop(*room)
    around = request.clearance + float(radii.max()) + AROUND
    moving = []
    for obstacle in request.world.moving:
        progress(f"measuring distances to {obstacle.name}", 0.0)
        moving.append((obstacle, obstacle.around(around)))
    return Cover(field, centres, radii, tuple(moving))


def _airspace(request: Request) -> Array | None:
    """A box (2, 3) m about the marks and what stands near them, to look for a way in; None: the terrain's."""
    world = request.world
    if world.terrain is not None or not world.standing:
        return None
    places = mark_positions(request.marks)
    low, high = places.min(axis=0) - ROOM, places.max(axis=0) + ROOM
    for obstacle in world.standing:
        corners = np.vstack(obstacle.hulls)
        a, b = corners.min(axis=0), corners.max(axis=0)
        if (a < high).all() and (b > low).all():
            low, high = np.minimum(low, a - ROOM), np.maximum(high, b + ROOM)
    return np.array([low, high])


def _straight(request: Request) -> list[Array]:
    """The straight way from mark to mark, for every leg."""
    return round_trip(request.marks) if request.loop else [np.array(leg) for leg in legs_between(request.marks)]


def _paths(request: Request, guess: Any, progress: Progress) -> list[Array]:
    """A polyline (k, 3) for every leg between marks, or poses (k, 4) with headings in rad."""
    if guess is not None:
        points = poses_of(guess) if isinstance(guess, Clip) else np.asarray(guess, float)
        if points.ndim != 2 or points.shape[1] not in (3, 4) or len(points) < 2:
            raise InputError(f"guess: shape {points.shape}; give a Clip, or a path of (k, 3) points in metres")
        return cut(points, legs_between(request.marks))
    kept = [request.marks[i] for i in placed_marks(request.marks)]
    if not request.hazards:
        rows = obstacle_rows(request.vehicle, request.world, request.marks)
        if rows is None:
            return _straight(request)
        progress("seeking a way among obstacles", 0.0)
        return divided(rows.drive(replace(request, marks=kept)), request.marks)
    box = _airspace(request)
    field = request.world.distance_field(progress, box=box)
    if field is None:
        return _straight(request)
    middle, roomy, tight = balls(request.vehicle)
    up = np.array([0, 0, middle[2]])
    ceiling = request.limits.get("ceiling")
    lid = ceiling + middle[2] if math.isfinite(ceiling) else None

    def flown(radius: float) -> list[Array]:
        ways, legs = [], legs_between(kept)
        for done, (a, b) in enumerate(legs):
            progress("seeking a way", done / len(legs))
            try:
                ways.append(request.world.route(a + up, b + up, radius + request.clearance, lid, box))
            except InputError:
                for mark, end in ((kept[done], a), (kept[done + 1], b)):
                    check_free(field, f"{mark.name}.position", end, request.clearance, ceiling, request.world.height)
                raise
            except SolveError:
                room = f"{request.clearance:g} m clearance and {radius:.1f} m for the {request.vehicle.name} itself"
                below = "" if lid is None else f" below the ceiling of {ceiling:g} m"
                mend = "lower the clearance" if lid is None else "raise the ceiling or lower the clearance"
                names = f"{kept[done].name} to {kept[done + 1].name}"
                raise SolveError(f"no way from {names} with {room}{below}; {mend}") from None
        return divided([np.asarray(way) - up for way in ways], request.marks)

    try:
        return flown(roomy)
    except SolveError:  # no way for all its spheres; whether it gets through nose first, the solve says
        return flown(tight)
