"""`plan`: from marks to the vehicle's best motion through them.

Top-down: check the request, find a path through free space, solve on few segments, move free marks to whole frames,
refine until the executed controls end where the plan does, certify the motion that will be exported, and tighten the
constraints and repeat if it comes too near an obstacle.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehsim.audit import Row, WorldScene, audit, missed, track_of_clip
from vehsim.clip.clip import Clip
from vehsim.errors import FailedPlan, SolveError
from vehsim.planning.blocks import blocks_of
from vehsim.planning.certificates import Executed
from vehsim.planning.certify import refine_and_certify
from vehsim.planning.constraints.clearance import SLACK, Clearance, SphereCover, cover_for
from vehsim.planning.constraints.timing import fixed_durations
from vehsim.planning.deadline import OutOfTime
from vehsim.planning.explain.depth import below_level
from vehsim.planning.explain.feasibility import refusals
from vehsim.planning.explain.looks import fastest_look
from vehsim.planning.fallbacks import (
    at_their_times,
    by_surface,
    enough_segments,
    from_other_guesses,
    in_narrow_places,
    unposed,
    with_fewer_requirements,
)
from vehsim.planning.guesses.routes import (
    InitialGuess,
    as_clip,
    initial_guess,
    reversing,
    roundabout,
    straight,
    turnings,
)
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.problem import interrupts
from vehsim.planning.problem.solver import HURRIED, LONGER, MET, Patience
from vehsim.planning.problem.transcription import Transcription, transcribe
from vehsim.planning.refine import ORDER, ends_elsewhere, largest_error, settle_on_frames, to_requested_segments
from vehsim.planning.request.asks import BEYOND, ROOM, asks_of, beyond_character
from vehsim.planning.request.character import NO_TRAITS, Traits
from vehsim.planning.request.landing import landings
from vehsim.planning.request.legs import facing, moved_far, same_choices
from vehsim.planning.request.marks import Mark, shape
from vehsim.planning.request.marks_near_obstacles import facing_clear, straightened, with_trailers_straight
from vehsim.planning.request.request import Request, all_marks, make_request
from vehsim.planning.restraint import in_character, nearby, restrain, restrained, without_character
from vehsim.planning.rolled import with_slip, without_slip
from vehsim.planning.solve import COARSE, begin, give_up, solve
from vehsim.planning.terms import Term
from vehsim.planning.trajectory import exported
from vehsim.requests import Ask
from vehsim.runtime.progress import Progress
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.character import DEFAULT, STUNT

Array = NDArray[np.float64]

NEARER = "request less clearance, more segments, or other marks"
THROUGH = "it passes through what it must avoid: make room, move the marks, or set a mark on the way"
"""Remedies for a motion that keeps too little clearance, and for one that keeps none."""
LATE = f"{HURRIED} before solving began{{}}: the motion is the unverified initial guess; {LONGER}"
"""The message of a plan that ran out of time before the first solve, and the step that used the time."""
TOO_SOON = "the marks leave too little time for {}{}; give later frames"
NONE_FOUND = "no {} motion was found"
TOO_NEAR = "the marks leave too little room for {}; move them apart, or give lower speeds"
"""Why a motion is driven in a harder character than the request's; where the planner chooses all frames, later."""
FINER, MOST = 4, 256
"""Factor by which the number of segments grows if the controls lead elsewhere, and the largest number."""
TELLING = 32
"""With fewer segments, even a known reason may be due to their number: controls cannot change within them."""
MORE = 1.1
"""Factor on the time of a slide at the limit of grip after which its controls repeat it: on snow, 1.06 is enough."""
FASTER = 0.005
"""By how much, relative to the vehicle's top speed or turn rate, a motion may exceed it before it is planned again with
that limit."""
TOPS = {
    "speed": "the top speed of the {vehicle}, {top:g} m/s",
    "turn_rate": "the top turn rate of the {vehicle}, {degrees:.3g} deg/s",
}
"""Those limits, for messages."""
TOO_HARD = 1.5
"""Ratio of a motion to a limit of its character above which the next harder character is the better choice: easing in
and out of rest would take time that the rest of the motion needs, which then is harder than a stunt."""
WORSE = 3.0
"""Ratio by which a motion in a harder character may exceed the limits of the request's more than one that exceeds them
as little as possible."""
FOLDED = math.radians(30)
"""Largest angle at which a trailer comes to rest, unless a mark gives it or no other motion is found."""
QUICK, PATIENT = Patience(60, near=1e-2), Patience(200)
"""That of a solve in a character, after which it is compared with a stunt, and of coarse solves that rank initial
guesses; and of the latter if none of them was solved."""
PRESSED = 1.2, 3.0
"""Ratios of a flight's guess to a limit of its character between which it is solved within the limits at once, which
otherwise takes a second solve. Below, it stays within them anyway; above, this takes more iterations."""
AS_GOOD = 1.01
"""Ratio of the cost of a motion near a stunt to that of one that this patience leaves unfinished, up to which it takes
the other's place: more iterations would hardly improve it."""
AT_ONCE = Patience(120, early=1.0)
"""That of a solve at once on the requested segments, refined: easy problems need 5 to 110 iterations there."""
CALM = 0.85
"""Ratio of a motion to the limits of its character below which it is not solved again within them."""
STRAINED, WORTH = 1.15, 0.9
"""Where the spheres around a vehicle press on a motion that exceeds a limit of its character by this ratio, its hulls
are used instead, if they reduce the ratio by this factor or more."""
Reason = Literal["refused", "time limit", "not solved", "clearance", "between knots", "execution", "audit"]
"""Why a plan failed. In turn: its marks contradict each other or the vehicle; the time limit was reached; the solver
found no motion; the certified clearance is too small; a constraint is violated between knots; the controls end
elsewhere than the plan; the finished motion misses a request."""
NAMED = 3
"""Maximum number of missed requests that the message names."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned motion with its certificates.

    ``defect``: largest constraint violation, in the problem's scaled units (m, m/s, rad); ``clearance``: smallest
    certified distance, m, plus the allowance near a landing; nan if it was not measured; ``executed``: distance from
    the plan, m, of a fine, independent execution of its controls; ``segments``, ``order``: the final discretisation.
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
    reason: Reason | None = None
    """Why it failed; None for a successful plan."""
    asks: tuple[Ask, ...] = ()
    """Everything that was requested, as data."""
    audit: tuple[Row, ...] = ()
    """What the finished clip was measured to achieve, one row per request; empty if the plan failed before the
    audit."""
    _iterate: Iterate | None = field(default=None, repr=False)
    _run: Run | None = field(default=None, repr=False)
    _cautions: tuple[str, ...] = field(default=(), repr=False)
    """What strains the vehicle, such as bends beyond the grip of tyres."""

    def __repr__(self) -> str:
        verdict = "solved" if self.success else "failed"
        return f"<Plan of {self.clip!r}: {verdict}, {self.message}>"

    @property
    def marks(self) -> list[Mark]:
        """The marks of the plan, with holds as two marks and marks on the ground placed on the terrain or obstacle."""
        return [] if self._iterate is None else list(self._iterate.request.given or self._iterate.request.marks)

    @property
    def character(self) -> str:
        """The character in which the motion is driven: a harder one than requested if the marks leave too little
        time."""
        assert self._iterate is not None
        return self._iterate.request.traits.name

    @property
    def possible(self) -> dict[str, int]:
        """Frames of marks, by name, with which a motion was found after this plan had failed; empty if none was."""
        return {} if self._iterate is None else dict(self._iterate.why.frames)

    @property
    def possible_clearance(self) -> float | None:
        """A smaller clearance, m, with which a motion was found after this plan had failed; None if none was."""
        return None if self._iterate is None else self._iterate.why.clearance

    def replan(self, marks: Sequence[Mark], progress: Progress | None = None) -> Plan:
        """The plan for other marks, started from this one: fast if the marks fix the same quantities at other
        values."""
        with interrupts.remembered():
            made = self._moved(marks, progress)
        _warn(made)
        return made

    def _moved(self, marks: Sequence[Mark], progress: Progress | None) -> Plan:
        assert self._iterate is not None and self._run is not None
        before = self._iterate.request
        request = replace(before, marks=all_marks(marks, before.vehicle, before.world, before.terms), deadline=math.inf)
        given = before.given or before.marks
        fresh = replace(request, given=())
        same = shape(request.marks) == shape(given)
        if same and moved_far(replace(before, marks=list(given)).stops, request.stops):
            return _solve(fresh, progress, None)
        if not same or not self.success or request.weighed is not before.weighed:
            return _solve(fresh, progress, self.clip)
        faced = replace(request, given=request.marks, marks=same_choices(request.marks, given, before.marks))
        run = Run(faced, progress, self._run.solvers)
        iterate = _in_traits(run, solve(run, at_marks(self._iterate, faced, self._iterate.cover)), faced)
        if not iterate.success or _is_too_hard(run, iterate):  # its own initial guess may lead to a solution
            return _solve(fresh, progress, None)
        return _result(run, refine_and_certify(run, iterate))


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
    character: str = DEFAULT,
    guess: Clip | Any = None,
    refine: bool = True,
    terms: Sequence[Term] = (),
    loop: bool = False,
    solver: str = "ipopt",
    max_iterations: int = 200,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Plan:
    """The motion through ``marks`` with the least cost, certified.

    ``fps``: frames per second; ``segments``: their total number, with every mark on a knot; ``cost``: a name of
    `terms.COSTS`, or weights by name; ``clearance``: m from terrain and obstacles; ``limits``: bounds by name of
    `terms.LIMITS`; ``character``: "calm", "normal", "brisk" or "stunt", how the vehicle is driven; ``guess``: a path
    (k, 3) m to start from, or a `Clip`, whose joints and controls are also used if its vehicle has the same ones;
    ``refine``: refine until the controls, executed finely, end within 0.1 m of the plan,
    a fortieth of the vehicle's length and half the clearance from obstacles; ``terms``: your own costs and
    constraints (`Cost`, `Constraint`, `look_at`, `stay`); ``loop``: the motion ends as it begins; ``solver``: a name of
    `problem.solver.SOLVERS`.

    ``time_limit``: seconds after the call at which the best motion so far is returned, certified. It includes loading:
    below about 0.5 s, or 1 s near terrain, you may get only the initial guess, and a message that says so. Distances to
    a new terrain are measured once, which takes a fraction of a second, and are cached.

    Raises ``InputError`` for an invalid request. A request without a solution returns a plan with ``success = False``
    and a message, and warns.
    """
    request = make_request(
        vehicle, world, marks, fps=fps, segments=segments, cost=cost, clearance=clearance, limits=limits,
        character=character, refine=refine, terms=terms, loop=loop, solver=solver, max_iterations=max_iterations,
        time_limit=time_limit,
    )  # fmt: skip
    if np.any(request.wind) and not request.vehicle.feels_wind:
        warnings.warn(
            f"{vehicle.name}: wind is set, but the vehicle has no drag, so the wind has no effect", stacklevel=2
        )
    with interrupts.remembered():
        made = _solve(request, progress, guess)
    _warn(made)
    return made


def _warn(plan: Plan) -> None:
    """Warn, at the caller's line, if a plan failed or differs from the request."""
    name = plan.clip.vehicle.name
    if not plan.success:
        warnings.warn(f"{name}: plan failed: {plan.message}", FailedPlan, stacklevel=3)
        return
    for message in plan._cautions:
        warnings.warn(message, stacklevel=3)
    if plan._iterate is not None and (
        plan._iterate.remark or ends_elsewhere(plan._iterate) or beyond_character(plan.audit)
    ):
        warnings.warn(f"{name}: {plan.message}", stacklevel=3)


class _TooHard(Exception):
    """A coarse ``motion`` exceeds its character by far, and there is a harder one."""

    def __init__(self, motion: Iterate) -> None:
        self.motion = motion


def _solve(request: Request, progress: Progress | None, guess: Any) -> Plan:
    """The plan in its character; where the motion would exceed that by far, in the next harder character."""
    beyond: list[Iterate] = []
    made, traits = _unless_too_hard(request, progress, guess, beyond), request.traits
    while made is None and (harder := traits.harder) is not None:
        again = None
        if not _beyond_too(beyond, harder):
            again = _unless_too_hard(replace(request, traits=harder), progress, guess, beyond)
        if again is not None and not again.success:
            break
        if again is not None and not _is_better(again, beyond, request):
            softer = _in_one_character(request, progress, guess)
            assert softer._iterate is not None
            if softer.success and not _is_better(again, [softer._iterate], request):
                return softer
        made, traits = again, harder
    if made is None:  # no harder motion was found
        made = _in_one_character(replace(request, traits=traits), progress, guess)
    if traits is request.traits:
        return made
    assert made._iterate is not None and made._run is not None
    found = made._iterate.request.traits.name
    why = _why_harder(request)
    late = made._run.deadline.late
    if made.success and not late and not _is_too_hard(made._run, replace(made._iterate, request=request)):
        # the requested character only began from a worse guess, such as to turn round instead of reversing
        near = _unless_too_hard(request, progress, made.clip, [])
        if near is not None and near.success:
            return near
        why = NONE_FOUND
    elif looks := fastest_look(made.clip, request):
        why = looks + " as {}; look from farther away, or give later frames"
    where = _most_hurried(beyond, request) if why == TOO_SOON else ""
    return _remarked(made, f"; driven as {found}: {why.format(request.traits.name, where)}")


def _why_harder(request: Request) -> str:
    """What of the marks can leave no motion in the request's character: given frames, or else given speeds."""
    arrivals = [mark for before, mark in pairwise(request.marks) if not before.hold]
    if any(mark.frame != "free" for mark in arrivals):
        return TOO_SOON
    own = request.marks[:-1] if request.loop else request.marks
    return NONE_FOUND if all(mark.at_rest for mark in own) else TOO_NEAR


def _most_hurried(beyond: Sequence[Iterate], request: Request) -> str:
    """The mark with a given frame on whose way motions ``beyond`` the request's character exceed it most, in words;
    empty if there is one way only."""
    if not beyond:
        return ""
    iterate = min(beyond, key=lambda each: _strain(each, request))
    marks, frames = request.marks, iterate.mark_frames()
    given = [k for k, mark in enumerate(marks) if k == 0 or mark.frame != "free"]
    ways = [  # without the frames of the marks, which belong to two ways
        (_largest_ratio(_soft_rows(iterate, request, (frames[i] + 1, frames[k] - 1))), marks[k].name)
        for i, k in pairwise(given)
        if frames[k] - frames[i] > 2 and not marks[i].hold
    ]
    return f", most of all {max(ways)[1]}" if len(ways) > 1 else ""


def _beyond_too(beyond: Sequence[Iterate], traits: Traits) -> bool:
    """Whether motions ``beyond`` a softer character, which exceed it as little as possible, exceed a harder one so far
    that its own motion would do so too."""
    strains = [_strain(each, replace(each.request, traits=traits)) for each in beyond]
    return min(strains, default=0.0) > TOO_HARD**2 / (1 + ROOM)


def _is_better(made: Plan, beyond: Sequence[Iterate], request: Request) -> bool:
    """Whether a plan in a harder character is better than motions ``beyond`` the request's, which exceed it as little
    as possible: without limits, a car on a lap without a stop costs nothing at any speed."""
    assert made._iterate is not None
    least = min((_strain(each, request) for each in beyond), default=math.inf)
    return _strain(made._iterate, request) < WORSE * least


def _unless_too_hard(request: Request, progress: Progress | None, guess: Any, beyond: list[Iterate]) -> Plan | None:
    """The plan in its character; None if it exceeds that by far, and there is a harder one: then the motions
    that do so are added to those ``beyond`` a character.

    Where a vehicle turned round at such a cost, it is tried in reverse; where it flew through a narrow place, the
    way around it.
    """
    made = _gentle(request, progress, guess, beyond)
    for other in (reversing, roundabout) if made is None and guess is None else ():
        if (path := other(request)) is not None:
            again = _gentle(request, progress, path, beyond)
            if again is not None and again.success:
                return again
    return made


def _gentle(request: Request, progress: Progress | None, guess: Any, beyond: list[Iterate]) -> Plan | None:
    """The plan in its character from one guess; None if it exceeds the character by far, and there is a harder one:
    then the motion is added to those ``beyond``."""
    try:
        made = _in_one_character(request, progress, guess, early=True)
    except _TooHard as error:
        beyond.append(error.motion)
        return None
    if not _too_hard(made):
        return made
    assert made._iterate is not None
    beyond.append(made._iterate)
    return None


def _in_one_character(request: Request, progress: Progress | None, guess: Any, early: bool = False) -> Plan:
    """The plan, if necessary planned again with fewer freedoms or more segments.

    ``early``: raise ``_TooHard`` as soon as the coarse motion shows it.

    A motion beyond the vehicle's top speed or turn rate is planned again with that limit. If the controls do not lead
    where the motion does, or no motion is found for an unknown reason, the plan is repeated on more segments.
    """
    enough = enough_segments(request)
    if request.segments < enough:
        made = _in_one_character(replace(request, segments=enough), progress, guess, early)
        return _remarked(made, f"; with {enough} segments, because {request.segments} are too few")
    made, limited = _attempt(request, progress, guess, early=early), ""
    while made._iterate is not None and made._iterate.success and (tops := _exceeded(made, request)):
        request = replace(request, limits=request.limits.within(tops))
        made = _attempt(request, progress, guess)
        for name, top in tops.items():
            own = TOPS[name].format(vehicle=request.vehicle.name, top=top, degrees=math.degrees(top))
            limited += f"; limited to {own}: to change this, give velocities or limits.{name}"
    made = _unfolded(made, request, progress, guess)
    segments = request.segments
    while _misled(made) and segments < MOST:
        segments = min(FINER * segments, MOST)
        again = _attempt(replace(request, segments=segments), progress, guess, once=True)
        if again._iterate is None or not again._iterate.success:
            break
        made = min(made, again, key=lambda plan: plan.executed.final)
    if segments == request.segments < MOST and (_unexplained(made) or (segments < TELLING and _unsolved(made))):
        segments = min(FINER * segments, MOST)
        again = _attempt(replace(request, segments=segments), progress, guess, once=True)
        if again.success:
            made = _remarked(again, f"; with {segments} segments, because {request.segments} are too few")
    if _fails_in_character(made):
        stunt = _attempt(replace(request, traits=NO_TRAITS), progress, guess)
        if stunt.success:
            made = _remarked(stunt, f"; not in character: no {request.traits.name} motion was found")
    return _remarked(made, limited) if limited else made


def _unfolded(made: Plan, request: Request, progress: Progress | None, guess: Any) -> Plan:
    """A plan in which trailers rest folded at marks, planned again with them straight there; unchanged if the marks
    give joints, or if no such motion is found."""
    vehicle = request.vehicle
    assert made._run is not None and made._iterate is not None
    if not (vehicle.tied and made.success) or request.loop or made._run.deadline.late:
        return made
    seconds = (np.array(made._iterate.mark_frames(), float) - made.clip.start_frame) / float(request.fps)
    turned = np.abs(made.clip.at(np.minimum(seconds, made.clip.times[-1])).joints[:, list(vehicle.tied)]).max(axis=1)
    folded = [
        mark.at_rest and mark.joints is None and angle >= FOLDED
        for mark, angle in zip(request.marks, turned, strict=True)
    ]
    if not any(folded):
        return made
    marks = [
        with_trailers_straight(vehicle, mark) if each else mark
        for mark, each in zip(request.marks, folded, strict=True)
    ]
    again = _attempt(replace(request, marks=marks), progress, guess, once=True)
    return again if again.success and not _too_hard(again) else made


def _fails_in_character(plan: Plan) -> bool:
    """Whether a plan failed after it was solved in its character: without it, it may succeed."""
    assert plan._iterate is not None and plan._run is not None
    known = plan._iterate.why or plan.reason in ("refused", "time limit") or plan._run.deadline.late
    return not (plan.success or known) and plan._iterate.request.traits.name != STUNT


def _too_hard(plan: Plan) -> bool:
    """Whether a motion exceeds a limit of its character by far, and there is a harder one."""
    assert plan._iterate is not None and plan._run is not None
    harder = plan._iterate.request.traits.harder
    return (
        plan.success
        and harder is not None
        and not plan._run.deadline.late
        and _largest_ratio(plan.audit) > TOO_HARD / (1 + ROOM)
    )


def _is_too_hard(run: Run, iterate: Iterate) -> bool:
    """The same of a coarse motion."""
    if not iterate.success or iterate.request.traits.harder is None or run.deadline.late:
        return False
    return _strain(iterate, iterate.request) > TOO_HARD / (1 + ROOM)


def _strain(iterate: Iterate, request: Request) -> float:
    """The largest ratio of a coarse motion to a soft limit of the request's character."""
    known = iterate.strains
    if request not in known:
        known[request] = _largest_ratio(_soft_rows(iterate, request))
    return known[request]


def _soft_rows(iterate: Iterate, request: Request, frames: tuple[float, float] | None = None) -> Sequence[Row]:
    """The measured soft limits of the request's character in a coarse motion, or between two ``frames`` of it."""
    soft = [ask for ask in asks_of(request, iterate.mark_frames()) if ask.key.startswith(BEYOND)]
    if frames is not None:
        soft = [replace(ask, first=frames[0], last=frames[1]) for ask in soft]
    return audit(iterate.track, soft, WorldScene(request.world, request.vehicle))


def _largest_ratio(rows: Sequence[Row]) -> float:
    """The largest ratio of a motion to one of its soft limits; 0 without any."""
    soft = [(row.value, row.upper) for row in rows if row.key.startswith(BEYOND)]
    return max((abs(value) / upper for value, upper in soft if value and upper), default=0.0)


def _remarked(plan: Plan, remark: str) -> Plan:
    assert plan._iterate is not None
    iterate = replace(plan._iterate, remark=plan._iterate.remark + remark)
    return replace(plan, message=plan.message + remark, _iterate=iterate)


def _exceeded(plan: Plan, request: Request) -> dict[str, float]:
    """The vehicle's top speed and turn rate, SI, where a motion exceeds them and the request sets no such limit."""
    linear = 3 if plan.clip.twists.shape[1] == 6 else 1
    turning, moving = np.split(plan.clip.twists, [linear], axis=1)
    tops = {"speed": (moving, request.vehicle.top_speed), "turn_rate": (turning, request.vehicle.top_turn_rate)}
    return {
        name: top
        for name, (rates, top) in tops.items()
        if math.isinf(request.limits.get(name)) and np.linalg.norm(rates, axis=1).max() > (1 + FASTER) * top
    }


def _misled(plan: Plan) -> bool:
    """Whether the executed controls end elsewhere than the motion even after refinement."""
    assert plan._iterate is not None and plan._run is not None
    deadline = plan._run.deadline
    return ends_elsewhere(plan._iterate) and not deadline.late and not deadline.cut


def _unsolved(plan: Plan) -> bool:
    """Whether a plan was tried and failed with time left: on more segments it may succeed."""
    assert plan._run is not None
    return not (plan.success or plan._run.deadline.late) and plan.iterations > 0


def _unexplained(plan: Plan) -> bool:
    """Whether it failed without a known reason."""
    assert plan._iterate is not None
    return _unsolved(plan) and not plan._iterate.why


def _attempt(request: Request, progress: Progress | None, given: Any, once: bool = False, early: bool = False) -> Plan:
    """The plan of one request from the user's guess or paths through free space; ``once``: on failure, do not try other
    guesses and do not diagnose.

    ``early``: as in `_in_one_character`.
    """
    transcription, run = transcribe(request.weighed), Run(request, progress)
    watched = run.deadline.watched(progress)
    try:
        guess = initial_guess(request, given, watched)
        cover, late = cover_for(request, guess.paths, watched), ""
    except OutOfTime as error:
        guess, cover, late = InitialGuess(straight(request), as_clip(request, given)), None, f" ({error})"
    posed, easy = _posed(request, guess.paths), not once and _is_easy(request, cover)
    guess = _turning(run, posed, transcription, guess) if cover is None else guess
    iterate = begin(run, posed, transcription, cover, guess.paths, guess.clip, coarse=not easy)
    hopeless = run.deadline.hopeless
    # a stunt may slide, which is tried first
    rolled = None if hopeless or request.traits.name == STUNT else without_slip(run, posed, guess)
    if rolled is not None:
        if early and _is_too_hard(run, rolled):
            raise _TooHard(rolled)
        slipping = with_slip(run, iterate, rolled)
        if early and not slipping.success and _strain(rolled, rolled.request) > 1:
            raise _TooHard(rolled)
        iterate, easy = (slipping, False) if slipping.success else (iterate, easy)
    if easy:
        iterate = _at_once(run, iterate)
    # a motion disproves every refusal
    refused = "" if iterate.success else "; ".join(map(str, refusals(request)))
    if refused or hopeless:
        reason: Reason = "refused" if refused else "time limit"
        return _result(run, give_up(iterate, refused or LATE.format(late)), reason)
    if easy and not iterate.success:  # few segments of order 2 are a shorter way, and often to a better motion
        iterate = begin(run, posed, transcription, cover, guess.paths, guess.clip)
    if not iterate.success:
        run, iterate = _found(run, iterate, guess, request, once, early)
    iterate = _in_traits(run, iterate, request)
    iterate = _by_its_surface(run, iterate, request)
    if early and _is_too_hard(run, iterate):
        raise _TooHard(iterate)
    iterate = to_requested_segments(run, iterate)
    iterate = refine_and_certify(run, iterate)
    return _result(run, iterate)


def _found(
    run: Run, begun: Iterate, guess: InitialGuess, request: Request, once: bool, early: bool
) -> tuple[Run, Iterate]:
    """A motion from the initial guess; where it fails, with less asked of it, then from other guesses.

    Returns the last iterate that was tried; it may have failed. Raises `_TooHard` if ``early``.
    """
    iterate, stunt, untried = begun, None, None
    clearance = iterate.block(Clearance)
    if clearance is not None and clearance.squeezes(iterate):
        iterate = in_narrow_places(run, iterate, guess)
    patient = math.isinf(request.deadline) and request.max_iterations > QUICK.most
    if early and patient and not iterate.success and request.traits.harder is not None:
        iterate, stunt = _quickly(run, iterate, guess)
    if stunt is not None and iterate.blocked and not stunt.success:
        untried = iterate  # other guesses are better than this one
    elif not iterate.success:
        iterate = solve(run, iterate)
    if not iterate.success and request.traits.name == STUNT and not run.deadline.late:
        rolled = without_slip(run, iterate.request, guess)
        iterate = iterate if rolled is None else with_slip(run, iterate, rolled)
    if iterate.success or once:
        return run, iterate
    relaxed = request
    if not run.deadline.late:
        if request.traits.name != STUNT:  # first find any motion, then apply the character
            iterate = stunt or without_character(run, iterate, guess)
            relaxed = replace(request, traits=NO_TRAITS)
        if not iterate.success:
            iterate = in_narrow_places(run, iterate, guess)
    posed = iterate.request
    if not iterate.success and posed.given:
        iterate = from_other_guesses(run, iterate, guess, brief=True)
    if not iterate.success:
        run, iterate = with_fewer_requirements(run, iterate, relaxed, guess)
    if not iterate.success:
        iterate = from_other_guesses(run, iterate, guess, untried)
        if iterate.success:
            iterate = replace(iterate, remark=unposed(posed))
    return run, iterate


def _by_its_surface(run: Run, iterate: Iterate, request: Request) -> Iterate:
    """A motion beyond its character on which the spheres around the vehicle press, solved again with the vehicle's
    surface; unchanged if that makes it little softer."""
    if not _presses(iterate) or (strain := _strain(iterate, request)) <= STRAINED or run.deadline.late:
        return iterate
    # from the motion itself: from its guess it takes four times as many iterations, to motions that are no better
    narrow = solve(run, by_surface(iterate))
    return narrow if narrow.success and _strain(narrow, request) < WORTH * strain else iterate


def _turning(run: Run, request: Request, transcription: Transcription, guess: InitialGuess) -> InitialGuess:
    """The guess, or that of other `turnings` from which the coarse motion costs least. If time is limited, none is
    solved, and the first of the others is taken."""
    others = [] if guess.given or run.deadline.late else turnings(request, guess.paths)
    if not others:
        return guess
    if math.isfinite(run.deadline.end):
        return InitialGuess(others[0])
    guesses, costs = [*map(InitialGuess, others), guess], []
    for patience in (QUICK, PATIENT):
        coarse = [solve(run, begin(run, request, transcription, None, each.paths), patience) for each in guesses]
        costs = [each.cost for each in coarse]
        if math.isfinite(min(costs)):
            break
    return guesses[int(np.argmin(costs))]


def _is_easy(request: Request, cover: SphereCover | None) -> bool:
    """Whether a problem may be solved at once on its segments: in free space, with given frames and all the time."""
    world = request.world
    empty = world is None or (world.terrain is None and not world.obstacles)
    free = cover is None and empty and not landings(request.marks)
    timed = math.isinf(request.deadline) and not np.isnan(fixed_durations(request.marks, request.fps)).any()
    return free and timed and request.refine and request.segments < 4 * COARSE


def _at_once(run: Run, begun: Iterate) -> Iterate:
    """A guess on the requested segments solved to the order of refined plans, if that is easy; else unchanged."""
    solved = solve(run, replace(begun, layout=replace(begun.layout, order=ORDER), rung=0), AT_ONCE, once=True)
    return solved if solved.success else begun


def _quickly(run: Run, begun: Iterate, guess: InitialGuess) -> tuple[Iterate, Iterate | None]:
    """The iterate solved if that takes few iterations, or near its stunt if that is as good as the unfinished motion;
    else as it was, with its stunt, which may have failed.

    Raises `_TooHard` if it is too hard even near the motion of the stunt, which is found at once where marks leave too
    little time for the character. Where the unfinished motion is softer than that, it goes another way.
    """
    quick = solve(run, restrained(begun) if _pressed(begun) else begun, QUICK)
    if quick.success:
        return quick, None
    stunt = without_character(run, begun, guess)
    near = nearby(run, stunt, begun.request.traits) if stunt.success else stunt
    if _is_too_hard(run, near) and not _strain(quick, begun.request) < _strain(near, begun.request):
        raise _TooHard(near)
    assert quick.solution is not None and near.solution is not None
    if near.success and near.solution.cost <= AS_GOOD * quick.solution.cost:
        return near, None
    return begun, stunt


def _pressed(begun: Iterate) -> bool:
    """Whether a guess exceeds its character so far that a motion will press on its limits."""
    least, most = PRESSED
    return not begun.request.vehicle.group.planar and least < _strain(begun, begun.request) < most


def _in_traits(run: Run, iterate: Iterate, request: Request) -> Iterate:
    """A solved iterate in the character of the request, with free marks on whole frames.

    Soft limits cost next to nothing where a motion stays well within them: it is not solved again.
    """
    iterate = in_character(run, iterate, request.traits)
    within = restrained(iterate)
    if within is not iterate and not (within.success and _strain(within, within.request) < CALM):
        within = restrain(run, iterate)
    return settle_on_frames(run, at_their_times(run, within))


def _presses(iterate: Iterate) -> bool:
    """Whether the spheres around the vehicle press on a motion where its own surface would have room."""
    clearance = iterate.block(Clearance)
    return iterate.success and clearance is not None and clearance.presses(iterate)


def _posed(request: Request, paths: Sequence[Array]) -> Request:
    """The request with marks at rest posed as is usual: turned along their legs, if the cost includes `course`, or as
    near to them as the vehicle has room; in bays, with trailers straight."""
    given, vehicle = request.marks, request.vehicle
    posed = facing(given, paths, request.aimed) if request.weights["course"] else given
    if posed != given:
        posed = facing_clear(vehicle, request.world, given, posed, request.clearance, request.fps)
    # in reverse, a trailer diverges from where it starts
    posed = straightened(vehicle, request.world, posed, request.loop)
    return request if list(posed) == list(given) else replace(request, marks=posed, given=given)


def at_marks(iterate: Iterate, request: Request, cover: SphereCover | None) -> Iterate:
    """A solved iterate at other marks of the same shape, to start from; ``cover``: that of the request's world."""
    transcription, layout = iterate.transcription, iterate.layout
    blocks = blocks_of(request, transcription, cover)
    if list(map(type, blocks)) == list(map(type, iterate.blocks)):  # otherwise obstacles came into or out of reach
        blocks = tuple(new.resume(old, iterate) for new, old in zip(blocks, iterate.blocks, strict=True))
    fixed = fixed_durations(request.marks, request.fps)
    lengths = np.where(np.isnan(fixed), iterate.lengths, fixed / np.array(layout.legs))
    return Iterate(
        request,
        transcription,
        layout,
        iterate.stretched(lengths),
        blocks,
        iterate.paths,
        multipliers=iterate.multipliers,
        prolongated=True,
        rung=iterate.rung,
    )


def _result(run: Run, iterate: Iterate, reason: Reason | None = None) -> Plan:
    """The finished plan of an iterate; ``reason``: why it was not solved, if planning stopped early."""
    request, solution, certificate = iterate.request, iterate.solution, iterate.certificate
    assert solution is not None and certificate is not None
    message, success = solution.message, solution.success
    times = f"after {iterate.tightenings} tighter solves"
    if not success and iterate.problem is not None:
        reason = "time limit" if solution.out_of_time else "not solved"
        worst = f"worst violation: {iterate.worst()}"
        if solution.violation < MET:
            worst = "all constraints are met, but the cost is not minimal yet; allow more iterations"
        else:
            worst += f"; {LONGER if solution.out_of_time else request.loosen}"
        message = iterate.why.text or f"{message}: {worst}"
    elif success and certificate.clearance < certificate.wanted - SLACK:
        success, reason = False, "clearance"
        message = (
            f"certified clearance {certificate.clearance:.3f} m is below the requested {certificate.wanted:g} m "
            f"{times}; {NEARER if certificate.clearance > 0 else THROUGH}"
        )
    elif success and certificate.messages:
        success, reason = False, "between knots"
        message = f"{'; '.join(certificate.messages)}, {times}; loosen it, or use more segments"
    message += iterate.remark + iterate.note
    if success and ends_elsewhere(iterate):
        off, allowed = iterate.executed.final, largest_error(request)
        message += f"; when executed, the controls end {off:.3g} m from the planned end"
        if off > allowed:
            success, reason = False, "execution"
            message += f", more than {allowed:.2g} m: {_calmer(request)}"
    begun = run.iterations > 0 or not run.deadline.hopeless  # otherwise there is no time to place wheels on the ground
    with warnings.catch_warnings(record=True) as cautions:  # of this motion, which may not be the plan's
        warnings.simplefilter("always")
        clip = replace(iterate.clip, vehicle=request.vehicle)
        try:
            clip = exported(iterate.clip, request) if begun else clip
            if success and (below := below_level(clip, request)):
                warnings.warn(f"{clip.vehicle.name}: {below}", stacklevel=2)
        except SolveError as error:  # its wheels cannot stand there
            success, reason, message = False, reason or "audit", message if not success else error.problem.message
    asks = asks_of(request, iterate.mark_frames())
    known = iterate.track if clip.positions is iterate.clip.positions else None  # else wheels were placed on the ground
    rows = audit(track_of_clip(clip, known), asks, WorldScene(request.world, clip.vehicle)) if success else []
    if beyond := beyond_character(rows):
        message += f"; beyond {request.traits.name}: {'; '.join(beyond)}"
    if wrong := missed(rows):
        success, reason = False, "audit"
        out_of_time = run.deadline.over or run.deadline.cut
        remedy = "" if any(row.remedy for row in wrong[:NAMED]) else f"; {LONGER if out_of_time else request.loosen}"
        missing = "; ".join(map(str, wrong[:NAMED]))
        message = f"the finished motion misses what was requested: {missing}{iterate.note}{remedy}"
    return Plan(
        clip=clip,
        success=success,
        message=message,
        cost=solution.cost,
        duration=float(iterate.clip.times[-1]),
        iterations=run.iterations,
        solve_seconds=run.solve_seconds,
        build_seconds=run.build_seconds,
        defect=solution.violation,
        clearance=certificate.clearance,
        executed=iterate.executed,
        segments=iterate.layout.segments,
        order=iterate.layout.order,
        tightenings=iterate.tightenings,
        reason=reason,
        asks=tuple(asks),
        audit=tuple(rows),
        _iterate=iterate,
        _run=run,
        _cautions=tuple(str(caution.message) for caution in cautions),
    )


def _calmer(request: Request) -> str:
    """What makes controls repeat a motion from which they lead astray."""
    if request.vehicle.rolling is None:
        return "use more segments, more time, or a slower motion"
    first, last = request.marks[0], request.marks[-1]
    why = "at the limit of grip, where slides are unstable, controls do not repeat a motion"
    if last.given_frame is None:
        return f"{why}: ask for a slower one"
    frame = math.ceil(int(first.frame) + MORE * (int(last.frame) - int(first.frame)))
    return f"{why}: give it about {MORE - 1:.0%} more time ({last.name}.frame = {frame}), or smaller slides"
