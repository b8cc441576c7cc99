"""The manoeuvres available to a shot's vehicles, as text and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehsim.shot.motions.sinusoid import SinusoidMotion
from vehsim.shot.shot import Shot

if TYPE_CHECKING:
    from vehsim.sinusoids.manoeuvres.manoeuvres import Manoeuvre


def paint_offers(shot: Shot, folder: Path) -> Iterator[str]:
    """A line for every manoeuvre of a shot's vehicles; those on wheels are drawn, `<shot>.<vehicle>.<mark>.png`."""
    from vehsim.sinusoids.manoeuvres.picture import paint

    shapes = [shape for obstacle in shot.world.obstacles for shape in obstacle.shapes_at(np.zeros(1))]
    corners = [np.asarray(getattr(shape, "outline", lambda s=shape: s)()).reshape(-1, 2) for shape in shapes]
    for table in shot.file.vehicle:
        if not isinstance(table.motion, SinusoidMotion):
            continue
        vehicle = shot.vehicle(table)
        outlines = table.motion._rig(vehicle).outlines
        for k, offers in enumerate(table.motion.offers(vehicle, shot._context), 1):
            lines = [_line(m) for m in offers]
            yield from (f"{shot.name}: {table.name}: mark[{k}]: {line}" for line in lines)
            if outlines:
                path = folder / f"{shot.name}.{table.name}.{k}.png"
                painted = [replace(m.steering, label=line) for m, line in zip(offers, lines, strict=True)]
                yield str(paint(painted, path, footprints=outlines, obstacles=corners))


def _line(m: Manoeuvre) -> str:
    """A manoeuvre as text, such as ``7, one sweep: 12.1 s, 0.31 m clear``."""
    room = f", {m.clearance:.2f} m clear" if m.clearance >= 0 else f", collides by {-m.clearance:.2f} m"
    return f"{m.number}, {m.label}: {m.steering.duration:.1f} s{room if np.isfinite(m.clearance) else ''}"
