"""Numbers: arrays, tables, and the report of a delivery."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
