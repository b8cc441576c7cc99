"""The methods of motion: one model per method, with its checks and its solution."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
