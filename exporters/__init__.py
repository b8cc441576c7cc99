"""Exporters: a take in, files out. One file each, found through the entry points of group ``vehsim.exporters``."""

from vehsim._lazy import attach

__getattr__, __dir__ = attach(__name__)
