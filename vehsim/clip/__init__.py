"""Exact motion as arrays, and the one interpolant through which everything reads it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip as Clip
    from vehsim.clip.samples import frame_rate as frame_rate

_PUBLIC = {
    "Clip": "vehsim.clip.clip",
    "frame_rate": "vehsim.clip.samples",
}
__all__ = ["Clip", "frame_rate"]

# Loaded at first use: heavy libraries are loaded only when they are needed.
__getattr__, __dir__ = attach(__name__, _PUBLIC)
