"""`Block`: one cost or constraint of a plan, from its rows in the problem to the words for what it cannot meet.

A plan's problem is a list of blocks. Each declares its parameters by name and adds its elements; the problem decides
where both stand. Blocks are immutable: a block that becomes active elsewhere, or asks for more, is a new block, and the
iterate that holds the old one stays as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.planning.problem.elements import NonlinearProgram, Use
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.trajectory import Trajectory

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Finding:
    """What a block measures on a finished clip.

    ``clearance``: the least distance from what may be hit, and what was ``wanted``, m; ``met``: no tighter solve is
    needed; ``lack``: by how much it is not met, in the block's own terms, for `Block.tighten`.
    """

    clearance: float = np.inf
    wanted: float = 0.0
    met: bool = True
    lack: Any = None
    message: str = ""
    """What to tell the user if tighter solves do not help; empty where the clearance says it."""


class Block:
    """One cost or constraint. By default it adds no variables, parameters, rows or bounds, and measures nothing."""

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        """Equal for blocks that add the same rows to a problem of a layout, whatever their parameters' values."""
        return type(self).__name__

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        """Declare the parameters, and add the elements that are always there."""

    def add_active(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        """Add the elements of the active set, behind those of all blocks that are always there."""

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        """The values of its parameters by name; of ``trajectory`` only timing counts."""
        return {}

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        """Narrow the bounds (size,) of variables, in place."""

    def describe(self, use: Use, occurrence: int, row: int, trajectory: Trajectory) -> str:
        """What messages call a row of one of its uses."""
        return use.name(occurrence, row)

    def activate(self, guess: Trajectory) -> Self:
        """The block before a first solve from ``guess``: what is near it becomes active."""
        return self

    def prolongate(self, coarse: Trajectory, fine: Trajectory) -> Self:
        """The block on a finer discretisation of the same motion."""
        return self

    def violated(self, solved: Trajectory) -> Self:
        """The block with what a solved motion violates and is not active yet; itself where there is nothing."""
        return self

    def measure(self, trajectory: Trajectory, clip: Clip, progress: Progress | None) -> Finding:
        """What the finished clip of a trajectory is worth to it."""
        return Finding()

    def tighten(self, trajectory: Trajectory, finding: Finding) -> Self:
        """The block that asks for more where a finished motion gives too little."""
        return self

    def resume(self, earlier: Self) -> Self:
        """The block at other marks, with the active set of the same block of an earlier plan."""
        return self


def assemble(transcription: Transcription, layout: Layout, blocks: Sequence[Block]) -> NonlinearProgram:
    """The problem of a list of blocks on a layout; the uses of its elements are owned by their numbers."""
    problem = NonlinearProgram(layout.size)
    for number, block in enumerate(blocks):
        with problem.owned_by(number):
            block.add(problem, transcription, layout)
    for number, block in enumerate(blocks):
        with problem.owned_by(number):
            block.add_active(problem, transcription, layout)
    return problem


def parameter_values(problem: NonlinearProgram, trajectory: Trajectory, blocks: Sequence[Block]) -> Array:
    """The parameter vector of a problem, from the blocks it was assembled of."""
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
