"""Checks of a delivery: USD rules, and the audit of a delivery from its files."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
