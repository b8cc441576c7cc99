"""The surroundings of the vehicles in a stage: ground, light, water, obstacles, guides."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
