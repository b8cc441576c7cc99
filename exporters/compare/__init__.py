"""Compare pictures with reference pictures; the pytest plugin for it."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
