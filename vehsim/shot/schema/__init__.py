"""The shape of a shot file: pydantic models, one per table."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
