"""A rig as data: the asset, the channels that animate it, and where each channel goes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HITCH_PITCH, HITCH_ROLL = "hitch_pitch", "hitch_roll"
"""Prefixes of channels that tilt a trailer on its hitch, so that its wheels follow the ground."""
DISC_PITCH, DISC_ROLL = "disc_pitch", "disc_roll"
"""Channels that tilt a rotor's disc with its thrust: forward, then to the right."""
CONING = "coning"
"""Channel that raises the blades of a rotor above their pose at rest."""


@dataclass(frozen=True)
class Channel:
    """A rig channel: an animated scalar that follows from the motion.

    Exactly one of ``value`` and ``rate`` is given. Both are functions of ``(t, r, u, xi, c)``: time [s], joints (s,),
    joint rates (s,), body twist (d,) and controls (c,). They return CasADi expressions. A ``rate`` is integrated along
    the clip, so its channel is unwrapped. ``unit``: "1" for a pure number; default: that of the op which it drives.
    """

    value: Callable[..., Any] | None = None
    rate: Callable[..., Any] | None = None
    unit: str = ""


@dataclass(frozen=True)
class Drive:
    """The target of a channel: ``op`` ("rotateX|Y|Z", "translateX|Y|Z") on ``prim`` (path below the rig root).

    ``pivot``: the centre of rotation of a prim without its own pivot: a point (3,) m in the rig root's frame, or
    "centre", the middle of the part. ``factor`` multiplies the channel: -1 for a wheel modelled the other way round.
    ``disc``: for rotors, also show the part as a blurred disc: True to make one, or a pattern of its meshes' names.
    """

    prim: str
    op: str
    pivot: tuple[float, float, float] | str | None = None
    factor: float = 1.0
    disc: bool | str = False


@dataclass(frozen=True)
class Suspension:
    """Springs between a body and its wheels: natural ``frequency`` Hz and ``damping`` ratio of heave, pitch and roll.

    ``mass_height`` m: height of the centre of mass above the ground, which makes the body dive and lean.
    """

    frequency: float = 1.5
    damping: float = 0.5
    mass_height: float = 0.5


@dataclass(frozen=True)
class Rig:
    """A vehicle's USD asset and how motion drives it.

    ``origin``: the body frame's origin (centre of mass, or the rear axle of a car) in the frame of the rig's root, m;
    the axes are parallel. ``drives``: channel name -> drive. ``suspension``: that of a body on wheels. ``variants``:
    variant set -> variant of the asset's root that differs from the asset's own choice. ``source``: the file that
    deliveries reference, at its prim ``source_root``, if ``asset`` is a wrapper that corrects its axes; ``folder``: the
    folder of its vehicle.toml; ``named``: the asset's path as given in that file.
    """

    asset: Path
    root: str
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drives: Mapping[str, Drive] = field(default_factory=dict)
    suspension: Suspension = Suspension()
    variants: Mapping[str, str] = field(default_factory=dict)
    source: Path | None = None
    source_root: str = ""
    folder: Path | None = None
    named: str = ""
