"""The motion of water at an instant, as data."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """The water at places (n, 3) m at an instant: ``height`` (n,) m of the surface, ``velocity`` (n, 3) m/s and
    ``acceleration`` (n, 3) m/s^2 of the water; above the surface, those of the surface. ``fade`` (n,) m: how much
    smaller the head of pressure is than the depth, because waves fade with depth."""

    height: Array
    velocity: Array
    acceleration: Array
    fade: Array
