"""Cameras as data: a solved camera, a camera rig with its settings, and the subject in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A solved camera: looks along its own -Z with +Y up (the USD convention).

    ``frames`` (n,) time codes; ``positions`` (n, 3) m and ``orientations`` (n, 4) w, x, y, z, camera to world (T_wc);
    ``lens_mm`` focal length, one or (n,), and ``aperture_mm`` (width, height) in millimetres; ``clip_range`` near and
    far, m.
    """

    name: str
    frames: Array
    positions: Array
    orientations: Array
    lens_mm: float | Array = 35.0
    aperture_mm: tuple[float, float] = (36.0, 20.25)
    clip_range: tuple[float, float] = (0.3, 3000.0)


@dataclass(frozen=True)
class CameraRig:
    """The settings of a camera. None means that the value is chosen automatically.

    ``rig``: one of `RIGS`. ``target``: the vehicle it looks at; default: the first. ``fill``: the target's share of the
    frame's height, which determines the distance; ``distance`` m sets it directly. ``height`` m above the target.
    ``azimuth`` degrees, counter-clockwise: from straight behind (chase), from straight ahead (first_person) or from
    looking along +X (the others). ``position`` (x, y, z) m: the place of a static, fly_by or crane camera, or the start
    of a dolly's rail; ``to``: the end of the rail; ``look_at``: the point at which a camera looks without panning.
    ``turn`` degrees per second of an orbit; ``rise`` m of a crane; ``eye`` (x, y, z) m in the root frame, for
    first_person. ``framing`` (x, y): the target's place, from the centre (0, 0) to the right and upper edges (1, 1).
    ``level``: whether the horizon is level or banks with the vehicle. ``margin`` m: least height above the ground.
    """

    name: str = "chase"
    rig: str = "chase"
    target: str | None = None
    lens_mm: float = 35.0
    aperture_width_mm: float = 36.0
    fill: float = 0.30
    distance: float | None = None
    height: float | None = None
    azimuth: float | None = None
    position: tuple[float, float, float] | None = None
    look_at: tuple[float, float, float] | None = None
    to: tuple[float, float, float] | None = None
    turn: float = 20.0
    rise: float | None = None
    eye: tuple[float, float, float] | None = None
    framing: tuple[float, float] | None = None
    level: bool | None = None
    margin: float = 1.5


@dataclass(frozen=True)
class Subject:
    """The target of a camera: poses ``matrices`` T_wr (n, 4, 4) of ``outline`` (k, 3) m in the root frame; its points
    ``corners`` (n, k, 3) in the world, ``upright`` without tilt, their ``centre`` (n, 3); ``headings`` (n,) rad."""

    matrices: Array
    outline: Array
    corners: Array
    upright: Array
    centre: Array
    headings: Array
    fps: float

    @property
    def size(self) -> float:
        """Largest extent, m."""
        return float(np.ptp(self.corners[0], axis=0).max())
