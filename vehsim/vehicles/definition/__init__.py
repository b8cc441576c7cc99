"""What a vehicle is: groups, joints and controls, and the mechanics that follow from one definition."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
