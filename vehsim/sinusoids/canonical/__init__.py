"""Exact steering of canonical systems: chained form, Fourier algorithm, optimal inputs."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
