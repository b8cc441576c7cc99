"""Apply a character to a plan, step by step.

A motion is found with the character's costs of fast controls, and then within its soft limits. If the first step fails,
a motion is found without a character; the character is applied to it afterwards, or dropped with a remark.
"""

from __future__ import annotations

from dataclasses import replace

from vehsim.planning.blocks import blocks_of
from vehsim.planning.costs import RunningCosts
from vehsim.planning.guesses.routes import InitialGuess
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.request.character import NO_TRAITS, Traits
from vehsim.planning.solve import begin, solve


def without_character(run: Run, failed: Iterate, guess: InitialGuess) -> Iterate:
    """The iterate solved from the same guess without a character, or the failed one."""
    request = replace(failed.request, traits=NO_TRAITS)
    return solve(run, begin(run, request, failed.transcription, failed.cover, guess.paths, guess.clip))


def in_character(run: Run, iterate: Iterate, traits: Traits) -> Iterate:
    """An iterate that was solved without its character, solved with it; if this fails, unchanged with a remark."""
    if not iterate.success or iterate.request.traits is traits or run.deadline.late:
        return iterate
    solved = solve(run, _with(traits, iterate))
    remark = f"; not in character: no {traits.name} motion was found"
    return solved if solved.success else replace(iterate, remark=iterate.remark + remark)


def nearby(run: Run, iterate: Iterate, traits: Traits) -> Iterate:
    """An iterate that was solved without its character, solved within its soft limits in one step; it may fail."""
    return solve(run, restrained(_with(traits, iterate)))


def _with(traits: Traits, iterate: Iterate) -> Iterate:
    """A solved iterate as the start of a solve in another character."""
    request = replace(iterate.request, traits=traits)
    fresh = blocks_of(request, iterate.transcription, iterate.cover)
    blocks = tuple(new.resume(old, iterate) for new, old in zip(fresh, iterate.blocks, strict=True))
    return replace(iterate, request=request, blocks=blocks, multipliers=None, prolongated=True)


def restrain(run: Run, iterate: Iterate) -> Iterate:
    """An iterate solved within the soft limits of its character, as far as its marks allow; if this fails,
    unchanged."""
    wanted = restrained(iterate)
    if wanted is iterate or not iterate.success or run.deadline.late:
        return iterate
    within = solve(run, replace(wanted, multipliers=None))
    return within if within.success else iterate


def restrained(iterate: Iterate) -> Iterate:
    """An iterate with the soft limits of its character in its problem; unchanged if there are none, or if they
    are active already."""
    costs = iterate.block(RunningCosts)
    if costs is None or costs.restrained or not (costs.limits or costs.control_rates):
        return iterate
    return replace(iterate, blocks=tuple(replace(b, restrained=True) if b is costs else b for b in iterate.blocks))
