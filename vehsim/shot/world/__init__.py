"""The world of a shot file: its obstacles and its water."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
