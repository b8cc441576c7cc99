"""A solved motion on a finer discretisation: the initial guess of the next solve."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vehsim.integrators.discrete import NEWTON_STEPS
from vehsim.planning.problem.layout import Layout
from vehsim.planning.trajectory import Trajectory

Array = NDArray[np.float64]


def prolongate(trajectory: Trajectory, fine: Layout) -> Array:
    """Variables (size,) on a finer layout: every coarse segment's controls are executed from its own first knot."""
    transcription, coarse, x = trajectory.transcription, trajectory.layout, trajectory.x
    if fine.segments == coarse.segments:
        return x.copy()
    split = fine.segments // coarse.segments
    k = np.arange(coarse.segments)
    state, z = x[coarse.knot(k)], x[coarse.velocity(k)]
    cuts = np.cumsum([0, *transcription.sizes[:3]])
    g, r, pi = (state[a:b] for a, b in pairwise(cuts))
    pi = pi * transcription.momentum_scale[:, None]
    c0, c1 = (x[coarse.control(k + e)] * transcription.control_scale[:, None] for e in (0, 1))
    h = x[coarse.duration(k)] / split
    air = np.tile(trajectory.request.wind[:, None], len(k))

    y = np.zeros(fine.size)
    newton, end = (step.map(len(k)) for step in transcription.newton)
    cells = transcription.cells(len(k))
    for j in range(split):
        here, ends = k * split + j, [c0 + (j + end) / split * (c1 - c0) for end in (0, 1)]
        y[fine.control(here)] = ends[0] / transcription.control_scale[:, None]
        y[fine.knot(here)] = np.vstack([g, r, pi / transcription.momentum_scale[:, None]])
        given = g, r, pi, *ends, h, air, cells(g)
        for _ in range(NEWTON_STEPS):
            z = newton(z, *given)
        g, r, pi, z = (np.asarray(v) for v in (*end(z, *given), z))
        y[fine.velocity(here)] = z
    y[fine.knot(fine.segments)] = x[coarse.knot(coarse.segments)]
    y[fine.control(fine.segments)] = x[coarse.control(coarse.segments)]
    y[fine.lengths] = x[coarse.lengths] / split
    return y
