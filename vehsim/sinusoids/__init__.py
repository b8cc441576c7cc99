"""Steering nonholonomic systems with sinusoids (Murray and Sastry 1990): algebra, canonical systems, cars, trailers."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
