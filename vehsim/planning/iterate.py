"""`Iterate`: the immutable state of a plan between steps; `Run`: the resources and counters of one planner run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehsim.audit import Track, track_of_clip
from vehsim.planning.certificates import Executed
from vehsim.planning.constraints.block import Block, Finding
from vehsim.planning.constraints.clearance import Clearance, SphereCover
from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance
from vehsim.planning.constraints.timing import Timing
from vehsim.planning.deadline import Deadline
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.solver import End, Multipliers, Solution
from vehsim.planning.problem.solver_cache import SolverCache
from vehsim.planning.request.request import Request
from vehsim.planning.trajectory import Trajectory, drawn
from vehsim.runtime.progress import Progress, Watching

Array = NDArray[np.float64]
B = TypeVar("B", bound=Block)

NOT_RUN = Executed(np.inf, np.inf, np.inf)
"""The value of `Iterate.executed` before the controls are executed."""


@dataclass(frozen=True)
class Why:
    """Why a plan failed, false if it is not known.

    ``frames``: of marks, by name, with which a motion was found; ``clearance`` m: the same, None if none was found.
    """

    text: str = ""
    frames: Mapping[str, int] = field(default_factory=dict)
    clearance: float | None = None

    def __bool__(self) -> bool:
        return bool(self.text)


@dataclass(frozen=True)
class Certificate:
    """What the finished clip of an iterate was measured to achieve: one finding per block."""

    findings: tuple[Finding, ...]

    @property
    def clearance(self) -> float:
        """The smallest clearance, m; inf without terrain and obstacles, nan if it was not measured."""
        return float(min((finding.clearance for finding in self.findings), default=np.inf))

    @property
    def wanted(self) -> float:
        """The requested clearance, m; zero without terrain and obstacles."""
        return max((finding.wanted for finding in self.findings), default=0.0)

    @property
    def lack(self) -> float:
        """By how much the clearance is too small, m; negative where it is larger than requested."""
        return self.wanted - self.clearance

    @property
    def met(self) -> bool:
        """Whether no finding requires a tighter solve."""
        return all(finding.met for finding in self.findings)

    @property
    def messages(self) -> list[str]:
        """The requirements that are not met, as messages to the user."""
        return [finding.message for finding in self.findings if finding.message]


@dataclass(frozen=True, eq=False)
class Iterate(Trajectory):
    """A trajectory, the blocks of its problem, and the results so far. Each step takes an iterate and returns a new
    one."""

    blocks: tuple[Block, ...]
    paths: Sequence[Array] = ()
    """The initial paths, one per leg."""
    solution: Solution | None = None
    """The result of the last solve; None before the first."""
    problem: NonlinearProgram | None = None
    """The problem that was solved."""
    multipliers: tuple[Multipliers, tuple[NonlinearProgram, Layout]] | None = None
    """The multipliers of the last successful solve, with its problem and layout, to start the next solve from."""
    stale: bool = True
    """Whether it has changed since the last solve."""
    prolongated: bool = False
    """Whether its variables come from a coarser discretisation or an earlier plan, rather than from an initial
    guess."""
    rung: int = -1
    """Index of its number of segments in `refine.LADDER`; -1 before the climb."""
    executed: Executed = NOT_RUN
    certificate: Certificate | None = None
    tightenings: int = 0
    why: Why = Why()
    """Why it was not solved."""
    remark: str = ""
    """In which way the plan differs from the request, for the message."""
    note: str = ""
    """Which step was left out, for the message."""

    @property
    def success(self) -> bool:
        """Whether the last solve succeeded."""
        return self.solution is not None and self.solution.success

    @property
    def cost(self) -> float:
        """The cost of its motion; infinite if it was not solved."""
        return self.solution.cost if self.solution is not None and self.solution.success else math.inf

    def block(self, kind: type[B]) -> B | None:
        """The first block of a kind, or None."""
        return next((block for block in self.blocks if isinstance(block, kind)), None)

    @cached_property
    def strains(self) -> dict[Request, float]:
        """Largest ratios of its motion to soft limits, by request, as far as they were measured."""
        return {}

    @property
    def timing(self) -> Timing:
        found = self.block(Timing)
        assert found is not None
        return found

    @property
    def cover(self) -> SphereCover | None:
        """The spheres that flight keeps away from terrain and obstacles."""
        found = self.block(Clearance)
        return None if found is None else found.cover

    @cached_property
    def track(self) -> Track:
        """The motion as an audit measures it, without channels: interpolating these takes half the time."""
        return track_of_clip(replace(self.clip, vehicle=self.request.vehicle, channels={}))

    @property
    def blocked(self) -> bool:
        """Whether there is terrain or an obstacle to hit."""
        return self.cover is not None or self.block(ObstacleClearance) is not None

    def with_timing(self, timing: Timing) -> Self:
        """The same iterate with another timing."""
        blocks = tuple(timing if isinstance(block, Timing) else block for block in self.blocks)
        return replace(self, blocks=blocks)

    def told(self, **more: Any) -> Self:
        """The same motion with ``more`` known about it; its clip and track stay as they were built."""
        made = replace(self, **more)
        for name in ("clip", "track"):  # cached properties
            if name in self.__dict__:
                made.__dict__[name] = self.__dict__[name]
        return made

    def worst(self) -> str:
        """The constraint row with the largest violation and how far it is off, for messages."""
        assert self.solution is not None and self.problem is not None
        violations = self.solution.violations
        worst = int(np.argmax(violations))
        use, occurrence, row = self.problem.row(worst)
        block, first = self.blocks[use.owner], worst - row
        off = block.amount(use, row, violations[first : first + use.rows])
        return f"{block.describe(use, occurrence, row, self)}, off by {off}"


class Run:
    """The resources and counters of one planner run: its deadline, its solver cache, and its progress callback.

    ``end``: when its solves end; None: as the character of the request says.
    """

    def __init__(
        self,
        request: Request,
        progress: Progress | None = None,
        solvers: SolverCache | None = None,
        end: End | None = None,
    ) -> None:
        self.deadline = Deadline(request.deadline)
        self.progress, self.end = progress, end
        self.solvers = solvers or SolverCache()
        self.iterations = 0
        self.build_seconds = self.solve_seconds = 0.0

    def watcher(self, text: str, start: Trajectory) -> Callable[[int, Array], None] | None:
        """A callback for a solver that begins at ``start``: it reports progress; None if no progress is wanted."""
        progress = self.progress
        if progress is None:
            return None
        name = start.request.vehicle.name

        def watch(count: int, x: Array) -> None:
            progress(f"{text}: iteration {count}", 1 - float(np.exp(-count / 40)))
            if isinstance(progress, Watching):
                progress.show(name, lambda: drawn(replace(start, x=x), start.request.world))

        return watch
