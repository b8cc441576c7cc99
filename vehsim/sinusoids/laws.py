"""Input laws, interpolated through Chebyshev points, and at an even pace."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.polynomial import Chebyshev

from vehsim.sinusoids.system import Array

Law = Callable[[Array], Array]
"""``s`` (k,) in 0..1 -> inputs (k, m) per unit of s."""

NODES = 25
PANELS = (2, 8, 24, 96, 384)
"""Numbers of points per cycle; the smallest sufficient one is used."""
TOLERANCE = 1e-12
"""Largest accepted relative difference."""

DEGREE = 64
"""Degree of the polynomial that evens the pace of one cycle."""
TURNING = 0.4
"""Share of its largest rate below which an evened law slows down: where both inputs pass through zero, a car stops
gently."""
NEWTON = 40
"""Maximum number of Newton steps; from the nearest of many samples three or four suffice."""


def chebyshev(law: Law, cycles: int = 1) -> Law:
    """A smooth law through its values at Chebyshev points, in as many panels as necessary, by the barycentric
    formula."""
    check = np.linspace(0.003, 0.997, 41)
    truth = law(check)
    nodes = (1 - np.cos(np.pi * np.arange(NODES) / (NODES - 1))) / 2
    for panels in cycles * np.array(PANELS):
        at = (np.arange(panels)[:, None] + nodes) / panels
        read = partial(_barycentric, nodes, law(at.ravel()).reshape(panels, NODES, -1))
        if np.abs(read(check) - truth).max() < TOLERANCE * max(1.0, np.abs(truth).max()):
            return read
    return law


def _barycentric(nodes: Array, values: Array, s: Array) -> Array:
    panels = len(values)
    panel = np.clip((np.asarray(s) * panels).astype(int), 0, panels - 1)
    gap = (np.asarray(s) * panels - panel)[:, None] - nodes
    hit = np.abs(gap) < 1e-15  # at a node, or so close that its reciprocal overflows
    weight = np.where(np.arange(NODES) % 2, -1.0, 1.0) / np.where(hit, 1.0, gap)
    weight[:, [0, -1]] /= 2
    at = hit.any(axis=1)
    if at.any():
        weight[at] = hit[at]
    return np.einsum("kn,knm->km", weight, values[panel]) / weight.sum(axis=1, keepdims=True)


def even(law: Law, bounds: Array, cycles: int = 1) -> Law:
    """The same path at a more even pace: at all times some input is about equally near its bound (m,).

    The pace is the reciprocal of a polynomial and its integral is exact, so the path is as well. A law too uneven for a
    polynomial is returned unchanged.
    """

    def demand(s: Array) -> Array:
        return np.sqrt(np.sum((law(s) / bounds) ** 2, axis=1) + floor)

    floor = 0.0
    greatest = float(demand(np.linspace(0, 1, 400 * cycles + 1)).max())
    if not 0 < greatest < np.inf:
        return law
    floor = (TURNING * greatest) ** 2
    need = Chebyshev.interpolate(demand, DEGREE * cycles, domain=[0.0, 1.0])
    dense = np.linspace(0, 1, 4 * DEGREE * cycles + 1)
    if need(dense).min() < np.sqrt(floor) / 2:
        return law
    distance = need.integ(lbnd=0.0)
    total, along = distance(1.0), distance(dense)

    def evened(sigma: Array) -> Array:
        s = np.interp(total * np.asarray(sigma), along, dense)
        for _ in range(NEWTON):
            step = (distance(s) - total * sigma) / need(s)
            s = np.clip(s - step, 0.0, 1.0)
            if np.abs(step).max(initial=0.0) < 1e-13:
                break
        return law(s) * (total / need(s))[:, None]

    return chebyshev(evened, cycles)
