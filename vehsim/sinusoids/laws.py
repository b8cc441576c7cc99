"""Laws of inputs as tables: a costly smooth law read through its values at Chebyshev points."""

from __future__ import annotations

from functools import partial

import numpy as np

from vehsim.sinusoids.steering import Law
from vehsim.sinusoids.system import Array

NODES = 25
TOLERANCES = (1e-12, 1e-12, 1e-11, 1e-10)
"""Largest difference accepted, relative, with more and more panels: a sharp law's own round-off may be above 1e-12."""


def chebyshev(law: Law, cycles: int = 1) -> Law:
    """A smooth law through its values at Chebyshev points of as many panels as it takes, by the barycentric formula."""
    check = np.linspace(0.003, 0.997, 41)
    truth = law(check)
    nodes = (1 - np.cos(np.pi * np.arange(NODES) / (NODES - 1))) / 2
    for panels, tolerance in zip(cycles * np.array([2, 8, 24, 96]), TOLERANCES, strict=True):
        at = (np.arange(panels)[:, None] + nodes) / panels
        read = partial(_barycentric, nodes, law(at.ravel()).reshape(panels, NODES, -1))
        if np.abs(read(check) - truth).max() < tolerance * max(1.0, np.abs(truth).max()):
            return read
    return law


def _barycentric(nodes: Array, values: Array, s: Array) -> Array:
    panels = len(values)
    panel = np.clip((np.asarray(s) * panels).astype(int), 0, panels - 1)
    gap = (np.asarray(s) * panels - panel)[:, None] - nodes
    hit = np.abs(gap) < 1e-15  # at a node, or so near that its reciprocal overflows
    weight = np.where(np.arange(NODES) % 2, -1.0, 1.0) / np.where(hit, 1.0, gap)
    weight[:, [0, -1]] /= 2
    at = hit.any(axis=1)
    if at.any():
        weight[at] = hit[at]
    return np.einsum("kn,knm->km", weight, values[panel]) / weight.sum(axis=1, keepdims=True)
