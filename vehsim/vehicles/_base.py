"""What every vehicle is: a group, joints, controls, channels, and the rig it drives.

The dynamics live beside this file (`holonomic.py`, `nonholonomic.py`); what belongs here is what simulation, planning,
clips and exporters all need to know about a vehicle, whatever its equations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Expr = Any
"""A CasADi ``SX`` expression."""


@dataclass(frozen=True)
class Control:
    """One control input: its bounds and the size of a typical value (for scaling), in SI units."""

    name: str
    lower: float = -np.inf
    upper: float = np.inf
    scale: float = 1.0
    unit: str = ""


@dataclass(frozen=True)
class Channel:
    """A rig channel: an animated scalar that follows from the motion.

    Exactly one of ``value`` and ``rate`` is given, both functions of ``(t, r, u, xi, c)``: time [s], joints (s,), joint
    rates (s,), body twist (d,) and controls (c,). A ``rate`` is integrated along the clip, so its channel is unwrapped.
    """

    value: Callable[..., Expr] | None = None
    rate: Callable[..., Expr] | None = None


@dataclass(frozen=True)
class Drive:
    """Where a channel goes in the rig: ``op`` ("rotateX|Y|Z", "translateX|Y|Z") on ``prim`` (path below the rig root)."""

    prim: str
    op: str


@dataclass(frozen=True)
class Rig:
    """A vehicle's USD asset and how motion drives it.

    ``origin``: the body frame's origin (centre of mass, or the rear axle of a car) in the frame of the rig's root, m;
    the axes are parallel. ``drives``: channel name -> drive.
    """

    asset: Path
    root: str
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drives: Mapping[str, Drive] = field(default_factory=dict)


@dataclass(frozen=True)
class State:
    """A vehicle's state at an instant, as riggers see it.

    ``position`` (3,) m, the rig's root in the world; ``orientation`` (4,) w, x, y, z, body to world; ``twist`` (d,) body
    axes, rad/s then m/s, of the rig's root; ``joints`` (s,) and ``joint_rates`` (s,) in rad or m (and per s).
    ``None`` stands for zeros of the vehicle's own size.
    """

    position: Any = (0.0, 0.0, 0.0)
    orientation: Any = (1.0, 0.0, 0.0, 0.0)
    twist: Any = None
    joints: Any = None
    joint_rates: Any = None
