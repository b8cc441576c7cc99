"""The USD stage of a take: layers of motion, assets, metadata."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
