"""`Iterate`: the state of a plan between its steps, immutable; `Run`: what one run of the planner uses and counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehsim.planning.certificates import Executed
from vehsim.planning.constraints.block import Block, Finding
from vehsim.planning.constraints.clearance import Clearance, SphereCover
from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance
from vehsim.planning.constraints.timing import Timing
from vehsim.planning.deadline import Deadline
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.solver import Multipliers, Solution
from vehsim.planning.problem.solver_cache import SolverCache
from vehsim.planning.request.request import Request
from vehsim.planning.trajectory import Trajectory

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
B = TypeVar("B", bound=Block)

NOT_RUN = Executed(np.inf, np.inf, np.inf)
"""Where the controls lead, before they are run."""


@dataclass(frozen=True)
class Certificate:
    """What the finished clip of an iterate was measured to be worth, a finding for each block."""

    findings: tuple[Finding, ...]

    @property
    def clearance(self) -> float:
        """The least clearance, m; inf where there is nothing to hit, nan where it was not measured."""
        return float(min((finding.clearance for finding in self.findings), default=np.inf))

    @property
    def wanted(self) -> float:
        """The clearance asked for, m; zero where there is nothing to hit."""
        return max((finding.wanted for finding in self.findings), default=0.0)

    @property
    def met(self) -> bool:
        """Whether nothing asks for another, tighter solve."""
        return all(finding.met for finding in self.findings)

    @property
    def messages(self) -> list[str]:
        """What is not kept, in the user's words."""
        return [finding.message for finding in self.findings if finding.message]


@dataclass(frozen=True, eq=False)
class Iterate(Trajectory):
    """A trajectory, the blocks of its problem, and what is known of it. A step takes one and returns another."""

    blocks: tuple[Block, ...]
    paths: Sequence[Array] = ()
    """The paths that it began with, one per leg."""
    solution: Solution | None = None
    """What the last solve came to; None before the first."""
    problem: NonlinearProgram | None = None
    """The problem that was solved."""
    multipliers: tuple[Multipliers, tuple[NonlinearProgram, Layout]] | None = None
    """Those of the last solve that succeeded, for the next one to start from."""
    stale: bool = True
    """Something has changed since it was solved."""
    prolongated: bool = False
    """Its variables come from a coarser discretisation, or an earlier plan, rather than from an initial guess."""
    rung: int = -1
    """The discretisation of `refine.LADDER` that it is on."""
    executed: Executed = NOT_RUN
    certificate: Certificate | None = None
    tightenings: int = 0
    why: str = ""
    """Why it was not solved."""
    remark: str = ""
    """What is not as it was asked for."""
    note: str = ""
    """What was left out."""

    @property
    def success(self) -> bool:
        """It is solved."""
        return self.solution is not None and self.solution.success

    def block(self, kind: type[B]) -> B | None:
        """The first block of a kind."""
        return next((block for block in self.blocks if isinstance(block, kind)), None)

    @property
    def timing(self) -> Timing:
        found = self.block(Timing)
        assert found is not None
        return found

    @property
    def cover(self) -> SphereCover | None:
        """What is kept off terrain and obstacles in flight."""
        found = self.block(Clearance)
        return None if found is None else found.cover

    @property
    def blocked(self) -> bool:
        """There is something to hit."""
        return self.cover is not None or self.block(ObstacleClearance) is not None

    def with_timing(self, timing: Timing) -> Self:
        """The same with another timing."""
        blocks = tuple(timing if isinstance(block, Timing) else block for block in self.blocks)
        return replace(self, blocks=blocks)

    def worst(self) -> str:
        """What messages call the constraint row that is violated most."""
        assert self.solution is not None and self.problem is not None
        use, occurrence, row = self.problem.row(int(np.argmax(self.solution.violations)))
        return self.blocks[use.owner].describe(use, occurrence, row, self)


class Run:
    """What one run of the planner uses and counts: its clock, its built solvers, and where progress is reported."""

    def __init__(self, request: Request, progress: Progress | None = None, solvers: SolverCache | None = None) -> None:
        self.deadline = Deadline(request.deadline)
        self.progress = progress
        self.solvers = solvers or SolverCache()
        self.iterations = 0
        self.build_seconds = self.solve_seconds = 0.0

    def watcher(self, text: str) -> Callable[[int], None] | None:
        """A solver's watcher that reports progress; None where no report is wanted."""
        progress: Any = self.progress
        if progress is None:
            return None
        return lambda count: progress(f"{text}: iteration {count}", 1 - float(np.exp(-count / 40)))
