"""The vehicles that ship, one file each."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
