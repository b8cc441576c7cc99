"""Exporters: a take in, files out. One file each, found through the entry points of group ``vehsim.exporters``."""
