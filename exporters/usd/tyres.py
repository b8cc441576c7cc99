"""Slip, load and contact of every tyre as primvars of its wheel, for shaders and effects.

``vehsim:tyre:slip_ratio``, ``:slip_angle`` (degrees), ``:load`` (N, if it is known) and ``:contact`` (0 or 1), on whole
frames. Primvars are inherited, so all that turns with a wheel has them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.exporters.usd.metadata import samples
from vehsim.world.ground.tyres import tyres_of

Array = NDArray[np.float64]

PREFIX = "primvars:vehsim:tyre:"


def author_tyres(root: Any, whole: Clip, frames: Array) -> None:
    """Author the primvars on the wheels below the prim spec ``root``; ``whole``: the clip at ``frames`` (n,). Inside an
    ``Sdf.ChangeBlock``."""
    from pxr import Sdf

    for tyre in tyres_of(whole):
        prim = Sdf.CreatePrimInLayer(root.layer, root.path.AppendPath(tyre.prim)) if tyre.prim else root
        shown = {
            "slip_ratio": (tyre.ratio, "speed of the rim over the hub's, over the hub's"),
            "slip_angle": (np.degrees(tyre.angle), "deg, of the hub's velocity from the wheel, left is positive"),
            "load": (tyre.load, "N"),
            "contact": (tyre.contact.astype(float), "1 where the tyre touches the ground, 0 where it is lifted"),
        }
        for name, (values, meaning) in shown.items():
            if values is not None:
                spec = samples(prim, PREFIX + name, Sdf.ValueTypeNames.Double, frames, values)
                spec.documentation = meaning
