"""Exporters: from a take to files. One file each, found through entry points of the group ``vehsim.exporters``."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
