"""What a plan is worth: its clearance on the exported motion, and where its controls really lead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip import Clip
from vehsim.integrators import DiscreteMechanics
from vehsim.integrators.continuous import execute

Array = NDArray[np.float64]

SAMPLES = 8
"""Poses certified per segment, ends included once."""


@dataclass(frozen=True)
class Executed:
    """How far the rig's root is from the plan when its controls are run through a fine independent integration, m."""

    mean: float
    largest: float
    final: float


def certify(
    clip: Clip, world: Any, samples: int = SAMPLES, progress: Callable[[str, float], None] | None = None
) -> float:
    """Smallest distance (m) of the vehicle's hulls to the terrain on the clip's own interpolant; inf without terrain.

    Exact, through MuJoCo, at ``samples`` poses a segment.
    """
    if world is None or world.terrain is None or clip.vehicle.rig is None:
        return float("inf")
    fine = np.linspace(0, 1, samples, endpoint=False)
    times = np.append((clip.times[:-1, None] + np.diff(clip.times)[:, None] * fine).ravel(), clip.times[-1])
    motion = clip.at(times)
    nearest = np.inf
    blocks = np.array_split(np.arange(len(times)), max(1, len(times) // 128))
    for i, block in enumerate(blocks):
        distances = world.clearance(clip.vehicle, motion.positions[block], motion.orientations[block])
        nearest = min(nearest, float(np.min(distances)))
        if progress is not None:
            progress("certifying clearance", (i + 1) / len(blocks))
    return nearest


def executed(
    mechanics: DiscreteMechanics, g: Array, r: Array, pi: Array, c: Array, steps: Array, wind: Array
) -> Executed:
    """Run knot controls (n, c) from the first knot through RK4 on the continuous equations and compare (m)."""
    z = np.ravel(np.asarray(mechanics.knot_velocity_guess(r[0], pi[0], c[0])))
    g_real, _ = execute(mechanics.vehicle, g[0], r[0], z, c, steps, wind)
    group, origin = mechanics.vehicle.group, mechanics.vehicle.origin
    planned, real = (_root(group, origin, x) for x in (g, g_real))
    errors = np.linalg.norm(planned - real, axis=1)
    return Executed(mean=float(errors.mean()), largest=float(errors.max()), final=float(errors[-1]))


def _root(group: Any, origin: Array, g: Array) -> Array:
    from vehsim.lie import SO3

    pose = group.pose(g)
    return pose[:, 0:3] - np.einsum("nij,j->ni", SO3.matrix(pose[:, 3:7]), origin)
