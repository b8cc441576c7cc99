"""Fast versions of the same steps: compiled functions, loops over arrays, fleets."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
