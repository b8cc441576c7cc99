"""Camera rigs as data, and a camera for every frame: framing, cuts, and a clear view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.cameras.camera import Camera as Camera
    from vehsim.cameras.camera import CameraRig as CameraRig
    from vehsim.cameras.camera import Subject as Subject
    from vehsim.cameras.cuts import cut as cut
    from vehsim.cameras.framing import solve_camera as solve_camera
    from vehsim.cameras.rigs import RIGS as RIGS

_PUBLIC = {
    "Camera": "vehsim.cameras.camera",
    "CameraRig": "vehsim.cameras.camera",
    "RIGS": "vehsim.cameras.rigs",
    "Subject": "vehsim.cameras.camera",
    "cut": "vehsim.cameras.cuts",
    "solve_camera": "vehsim.cameras.framing",
}
__all__ = ["RIGS", "Camera", "CameraRig", "Subject", "cut", "solve_camera"]

# Loaded at first use: heavy libraries are loaded only when they are needed.
__getattr__, __dir__ = attach(__name__, _PUBLIC)
