"""Certifying: what the finished clip is worth between its knots, and asking for more where it is not enough."""

from __future__ import annotations

from dataclasses import replace

from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.refine import refine
from vehsim.planning.solve import measured

TIGHTENINGS = 5
"""How often a motion that comes too near, or breaks a constraint between knots, is solved again."""


def certify(run: Run, iterate: Iterate) -> Iterate:
    """The iterate with what its clip was measured to be worth."""
    return replace(iterate, certificate=measured(run, iterate, iterate.clip))


def tighten(iterate: Iterate) -> Iterate:
    """The iterate that asks for more where its certificate says that it gives too little."""
    assert iterate.certificate is not None
    findings = zip(iterate.blocks, iterate.certificate.findings, strict=True)
    blocks = tuple(block.tighten(iterate, finding) for block, finding in findings)
    return replace(iterate, blocks=blocks, stale=True, tightenings=iterate.tightenings + 1)


def refine_and_certify(run: Run, iterate: Iterate) -> Iterate:
    """Refined until its controls lead where it does, and tightened until it keeps what was asked between its knots.

    Where a tightening has no solution, the iterate there was before it stands.
    """
    iterate = certify(run, refine(run, iterate))
    while _unmet(iterate) and iterate.tightenings < TIGHTENINGS and not run.deadline.late:
        tighter = refine(run, tighten(iterate), before=iterate)
        if not tighter.success:
            break
        iterate = certify(run, tighter)
    return iterate


def _unmet(iterate: Iterate) -> bool:
    return iterate.success and iterate.certificate is not None and not iterate.certificate.met
