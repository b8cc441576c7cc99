"""`Block`: one cost or constraint of a plan, from its rows in the problem to its messages.

A planning problem is a list of blocks. Each declares its parameters by name and adds its elements; the problem
allocates both. Blocks are immutable: a block with another active set, or a tighter one, is a new block, and the iterate
with the old one does not change.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.planning.problem.elements import NonlinearProgram, Use
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.trajectory import Trajectory
from vehsim.runtime.progress import Progress

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Finding:
    """The result of measuring a block on a finished clip.

    ``clearance``: the smallest distance from terrain and obstacles, and the one ``wanted``, m; ``met``: no tighter
    solve is needed; ``lack``: the shortfall, in the block's own terms, for `Block.tighten`.
    """

    clearance: float = np.inf
    wanted: float = 0.0
    met: bool = True
    lack: Any = None
    message: str = ""
    """The message to the user if tighter solves do not help; empty if ``clearance`` says it."""


class Block:
    """One cost or constraint. By default it adds no variables, parameters, rows or bounds, and measures nothing."""

    continues: ClassVar[bool] = False
    """Whether a solve with more of its constraints active starts from the motion that violated them, not from the same
    start again, because there can be no obstacle in between."""

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        """A key that is equal for blocks that add the same rows to a problem of the same layout, whatever the parameter
        values."""
        return type(self).__name__

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        """Declare the parameters, and add the elements that do not depend on the active set."""

    def add_active(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        """Add the elements of the active set, after the other elements of all blocks."""

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        """The values of its parameters by name; only the timing of ``trajectory`` matters."""
        return {}

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        """Narrow the bounds (size,) of variables, in place."""

    def describe(self, use: Use, occurrence: int, row: int, trajectory: Trajectory) -> str:
        """The name of a row of one of its uses, in messages."""
        return use.name(occurrence, row)

    def amount(self, use: Use, row: int, violations: Array) -> str:
        """How far a row is off, in messages; ``violations`` (rows,) of all rows of its occurrence."""
        return f"{violations[row]:.3g}"

    def activate(self, guess: Trajectory) -> Self:
        """The block before a first solve from ``guess``: constraints near the guess become active."""
        return self

    def prolongate(self, coarse: Trajectory, fine: Trajectory) -> Self:
        """The block on a finer discretisation of the same motion."""
        return self

    def violated(self, solved: Trajectory) -> Self:
        """The block with the constraints that a solution violates added to its active set; itself if there are none."""
        return self

    def complete(self) -> Self:
        """The block with what it leaves out until a first motion is found; itself if that is nothing."""
        return self

    def measure(self, trajectory: Trajectory, clip: Clip, progress: Progress | None) -> Finding:
        """The finding of this block on the finished clip of a trajectory."""
        return Finding()

    def tighten(self, trajectory: Trajectory, finding: Finding) -> Self:
        """A tighter block where the finished motion falls short."""
        return self

    def resume(self, earlier: Self, solved: Trajectory) -> Self:
        """The block at other marks, or among obstacles at other places, with the active set that the same block had in
        an earlier plan, whose motion is ``solved``."""
        return self


def assemble(transcription: Transcription, layout: Layout, blocks: Sequence[Block]) -> NonlinearProgram:
    """The problem of a list of blocks on a layout; every use of an element is owned by the index of its block."""
    problem = NonlinearProgram(layout.size)
    for number, block in enumerate(blocks):
        with problem.owned_by(number):
            block.add(problem, transcription, layout)
    for number, block in enumerate(blocks):
        with problem.owned_by(number):
            block.add_active(problem, transcription, layout)
    problem.reduce()
    return problem


def parameter_values(problem: NonlinearProgram, trajectory: Trajectory, blocks: Sequence[Block]) -> Array:
    """The parameter vector of a problem, from the blocks it was assembled from."""
    values = {"wind": trajectory.request.wind}
    for block in blocks:
        values.update(block.values(trajectory))
    return problem.vector(values)


def variable_bounds(trajectory: Trajectory, blocks: Sequence[Block]) -> tuple[Array, Array]:
    """Lower and upper bounds (size,) of a layout's variables."""
    lower, upper = np.full(trajectory.layout.size, -np.inf), np.full(trajectory.layout.size, np.inf)
    for block in blocks:
        block.bound(trajectory, lower, upper)
    return lower, upper
