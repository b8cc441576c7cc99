"""Certify the finished clip between its knots, and tighten constraints that it violates there."""

from __future__ import annotations

from dataclasses import replace

from vehsim.planning.constraints.clearance import SLACK
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.refine import refine
from vehsim.planning.solve import measured

TIGHTENINGS = 5
"""Maximum number of tighter solves for a motion that comes too near or violates a constraint between knots."""


def certify(run: Run, iterate: Iterate) -> Iterate:
    """The iterate with the certificate of its clip."""
    return iterate.told(certificate=measured(run, iterate, iterate.clip))


def tighten(iterate: Iterate) -> Iterate:
    """The iterate with tighter constraints where its certificate finds too little clearance or a violation."""
    assert iterate.certificate is not None
    findings = zip(iterate.blocks, iterate.certificate.findings, strict=True)
    blocks = tuple(block.tighten(iterate, finding) for block, finding in findings)
    return replace(iterate, blocks=blocks, stale=True, tightenings=iterate.tightenings + 1)


def refine_and_certify(run: Run, iterate: Iterate) -> Iterate:
    """Refine until the executed controls end where the plan does, and tighten until constraints hold between knots.

    If a tighter problem has no solution, the previous iterate is returned.
    """
    iterate = certify(run, refine(run, iterate))
    while _unmet(iterate) and iterate.tightenings < TIGHTENINGS and not run.deadline.late:
        tighter = refine(run, tighten(iterate), before=iterate)
        if not tighter.success:
            break
        before, iterate = iterate, certify(run, tighter)
        if _settles(before, iterate):
            break
    return iterate


def _unmet(iterate: Iterate) -> bool:
    return iterate.success and iterate.certificate is not None and not iterate.certificate.met


def _settles(before: Iterate, after: Iterate) -> bool:
    """Whether the clearance that is missing is within its tolerance, and tightening reduced it by less than half."""
    assert before.certificate is not None and after.certificate is not None
    return not after.certificate.messages and before.certificate.lack / 2 < after.certificate.lack < SLACK
