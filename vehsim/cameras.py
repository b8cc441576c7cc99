"""Cameras: a rig (data) and a take's motion in, a camera per frame out. The same camera is exported and rendered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A solved camera: looks along its own -Z with +Y up (the USD convention).

    ``frames`` (n,) time codes; ``positions`` (n, 3) m and ``orientations`` (n, 4) w, x, y, z, camera to world (T_wc);
    ``lens_mm`` focal length and ``aperture_mm`` (width, height) in millimetres; ``clip_range`` near and far, m.
    """

    name: str
    frames: Array
    positions: Array
    orientations: Array
    lens_mm: float = 35.0
    aperture_mm: tuple[float, float] = (36.0, 20.25)
    clip_range: tuple[float, float] = (0.3, 3000.0)
