"""Exact motion as arrays, read through one C1 interpolant."""
