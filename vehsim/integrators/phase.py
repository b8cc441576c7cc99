"""The state that an integrator carries from knot to knot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vehsim.integrators.discrete import DiscreteMechanics
from vehsim.vehicles.definition.base import Array


@dataclass
class Phase:
    """Group element ``g`` (size,), joints ``r`` (s,), momentum ``pi`` (n_z,), and Newton's warm start ``z`` (n_z,)."""

    g: Array
    r: Array
    pi: Array
    z: Array


def packed(phase: Phase) -> Array:
    """A phase as one row (size + s + 2 n_z,)."""
    return np.concatenate([phase.g, phase.r, phase.pi, phase.z])


def unpacked(mechanics: DiscreteMechanics, x: Array) -> Phase:
    """The phase of a row; its fields are copies."""
    return Phase(*(part.copy() for part in np.split(x, np.cumsum(mechanics.sizes[:3]))))


def joints_of(mechanics: DiscreteMechanics, x: Array) -> Array:
    """Joints (..., s) of packed phases (..., .)."""
    size, s = mechanics.sizes[:2]
    return x[..., size : size + s]
