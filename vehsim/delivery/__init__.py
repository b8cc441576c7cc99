"""Takes and their delivery: exporters found by entry points, folders replaced atomically."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.delivery.exporters import Exporter as Exporter
    from vehsim.delivery.exporters import exporter_names as exporter_names
    from vehsim.delivery.exporters import find_exporter as find_exporter
    from vehsim.delivery.take import RenderSettings as RenderSettings
    from vehsim.delivery.take import Take as Take
    from vehsim.delivery.take import UsdSettings as UsdSettings
    from vehsim.delivery.take import export_clip as export_clip

_PUBLIC = {
    "Exporter": "vehsim.delivery.exporters",
    "RenderSettings": "vehsim.delivery.take",
    "Take": "vehsim.delivery.take",
    "UsdSettings": "vehsim.delivery.take",
    "export_clip": "vehsim.delivery.take",
    "exporter_names": "vehsim.delivery.exporters",
    "find_exporter": "vehsim.delivery.exporters",
}
__all__ = ["Exporter", "RenderSettings", "Take", "UsdSettings", "export_clip", "exporter_names", "find_exporter"]

# Loaded at first use: heavy libraries are loaded only when they are needed.
__getattr__, __dir__ = attach(__name__, _PUBLIC)
