"""The smallest shot that moves, for tests of what happens around it: a car driven for a quarter of a second."""

from __future__ import annotations


def driven(name: str = "drive", asset: str = "car", duration: float = 0.25, keys: str = "") -> str:
    """The text of the shot file, which ends in its ``[vehicle.motion]``; ``keys``: further lines of ``[[vehicle]]``."""
    return f"""
[shot]
schema = 1
name = "{name}"
[[vehicle]]
name = "car"
asset = "{asset}"
{keys}[vehicle.motion]
method = "simulate"
duration = {duration}
commands = [{{ frame = 1001, torque = 500 }}]
"""
