"""Manoeuvres of the shipped vehicles: the alternatives, and the clearance of each."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
