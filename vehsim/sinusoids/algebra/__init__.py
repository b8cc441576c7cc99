"""The control Lie algebra of a driftless system, and changes of its coordinates."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.sinusoids.algebra.classification import Classification as Classification
    from vehsim.sinusoids.algebra.classification import classify as classify
    from vehsim.sinusoids.algebra.classification import leaf as leaf

_PUBLIC = {
    "Classification": "vehsim.sinusoids.algebra.classification",
    "classify": "vehsim.sinusoids.algebra.classification",
    "leaf": "vehsim.sinusoids.algebra.classification",
}
__all__ = ["Classification", "classify", "leaf"]

# Loaded at first use: heavy libraries are loaded only when they are needed.
__getattr__, __dir__ = attach(__name__, _PUBLIC)
