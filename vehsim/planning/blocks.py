"""The blocks of a planning problem, in the order in which they are assembled."""

from __future__ import annotations

from vehsim.planning.constraints.actuation import Actuation
from vehsim.planning.constraints.approach import Landing
from vehsim.planning.constraints.block import Block
from vehsim.planning.constraints.clearance import Clearance, SphereCover
from vehsim.planning.constraints.dynamics import Dynamics, UnconstrainedJoints, UnitQuaternion
from vehsim.planning.constraints.easing import Easing, steady_marks
from vehsim.planning.constraints.mark_constraints import Centred, Loop, MarkConstraint, closes_loop
from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance
from vehsim.planning.constraints.path_constraints import PathConstraint
from vehsim.planning.constraints.timing import Timing
from vehsim.planning.costs import OwnCost, RunningCosts
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.marks_near_obstacles import levels_at, parts_in_reach
from vehsim.planning.request.request import Request
from vehsim.planning.terms import Cost, HazardView, costs_of
from vehsim.vehicles.definition.character import STUNT


def blocks_of(request: Request, transcription: Transcription, cover: SphereCover | None) -> tuple[Block, ...]:
    """The costs and constraints of a request, as blocks.

    ``cover``: the spheres that flight keeps away from terrain and obstacles; None in free space.
    """
    marks, constraints = request.marks, request.constraints
    blocks: list[Block] = [Dynamics(marks, unused=request.traits.unused)]
    aims, traits = [term for term in constraints if term.aim is not None], request.traits
    weights, limits = traits.weights(request.weights), traits.without(request.limits)
    # a lap at given frames, without drag and stops, costs next to nothing at any speed
    slowed = request.vehicle.feels_wind or weights["time"] or any(mark.at_rest for mark in marks)
    restrained = request.loop and not slowed
    blocks.append(RunningCosts(weights, aims, marks, limits, traits.control_rates, traits.price, restrained))
    steady = [] if request.loop else steady_marks(request.vehicle, marks, traits)
    asks_turns = bool(costs_of(HazardView, weights)) or any(isinstance(term, Cost) for term in request.terms)
    blocks.append(Easing(weights, traits, request.stops, steady, straight=not asks_turns, looks=aims))
    blocks.append(Actuation(active=traits.name == STUNT and request.vehicle.actuated))
    blocks.append(UnitQuaternion())
    for i, mark in enumerate(marks):
        cut = request.vehicle.attitude is not None and not request.loop and i in (0, len(marks) - 1)
        blocks.append(MarkConstraint(marks, i, closes_loop(marks, i, request.loop), cut))
        if mark.gate is not None:
            blocks.append(Centred(i, 0.0 if traits.name == STUNT else traits.price))
        if mark.on_ground and not (i and marks[i - 1].hold):
            blocks.append(Landing(marks, i))
    if request.loop:
        blocks.append(Loop())
    parts = parts_in_reach(request.vehicle, request.world, marks, request.clearance)
    if parts:
        levels = levels_at(request.vehicle, request.world, marks, parts)
        blocks.append(ObstacleClearance(request.vehicle, parts, request.clearance, levels=levels))
    blocks += [PathConstraint(term, marks, number) for number, term in enumerate(constraints)]
    blocks += [OwnCost(term, marks) for term in request.terms if isinstance(term, Cost)]
    if not request.vehicle.group.planar:
        blocks.append(Clearance(request, cover, request.clearance))
    blocks.append(Timing(marks, request.fps))
    blocks.append(UnconstrainedJoints(request, transcription))
    return tuple(blocks)
