"""The car's wheels, and the hulls that hold them at every angle of roll and steering."""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._shapes import (
    Surface,
    by_material,
    convex,
    join,
    outer_hull,
    revolve,
    ring,
)

RADIUS, WIDTH = 0.32, 0.215


def wheel() -> dict[str, Surface]:
    """A left wheel about its own centre: tyre, rim with five twin spokes, brake disc. Outboard is +Y."""
    h, r = WIDTH / 2, RADIUS
    tread = [
        (0.222, -h + 0.012),
        (0.25, -h),
        (0.285, -h),
        (0.308, -h + 0.012),
        (r - 0.002, -h + 0.035),
        (r, -0.04),
        (r, 0.04),
    ]
    tread += [(r - 0.002, h - 0.035), (0.308, h - 0.012), (0.285, h), (0.25, h), (0.222, h - 0.012)]
    tyre = ring(tread, 48)
    barrel = ring(
        [
            (0.226, -h + 0.01),
            (0.226, h - 0.012),
            (0.218, h - 0.004),
            (0.204, h - 0.012),
            (0.200, h - 0.03),
            (0.200, -h + 0.01),
        ],
        48,
    )
    spokes = []
    for k in range(5):
        for lean in (-0.13, 0.13):
            a, b = 2 * np.pi * k / 5 + 0.35 * lean, 2 * np.pi * k / 5 + lean
            inner = np.array([0.045 * np.cos(a), h - 0.035, 0.045 * np.sin(a)])
            outer = np.array([0.206 * np.cos(b), h - 0.016, 0.206 * np.sin(b)])
            across = np.array([-np.sin(b), 0.0, np.cos(b)])
            deep = np.array([0.0, 0.016, 0.0])
            corners = [
                p + s * wd * across + t * deep
                for p, wd in ((inner, 0.014), (outer, 0.019))
                for s in (-1, 1)
                for t in (-1.2, 0)
            ]
            corners += [
                p + s * wd * 0.55 * across + deep * 0.35 for p, wd in ((inner, 0.014), (outer, 0.019)) for s in (-1, 1)
            ]
            spokes.append(convex(np.array(corners)))
    hub = revolve(
        [(0.0, h - 0.07), (0.062, h - 0.07), (0.062, h - 0.025), (0.05, h - 0.016), (0.0, h - 0.014)], 24, "y"
    )
    nuts = join(
        *(
            revolve([(0.0, h - 0.03), (0.008, h - 0.03), (0.008, h - 0.01), (0.0, h - 0.01)], 6, "y").moved(
                [0.034 * np.cos(t), 0, 0.034 * np.sin(t)]
            )
            for t in np.linspace(0, 2 * np.pi, 5, endpoint=False)
        )
    )
    disc = revolve([(0.0, 0.0), (0.155, 0.0), (0.155, 0.022), (0.0, 0.022)], 32, "y")
    back = revolve([(0.0, -0.075), (0.20, -0.075), (0.20, -0.06), (0.0, -0.06)], 32, "y")
    return by_material({"tyre": tyre, "rim": join(barrel, hub, *spokes), "trim": join(back, nuts), "disc": disc})


def wheel_hull(steer: float) -> Surface:
    """A wheel as a prism about it; swept over its steering angles when it steers, for the hulls do not move."""
    r, h, sides = RADIUS, WIDTH / 2 + 0.002, 16
    turn = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    ring = np.stack([np.cos(turn), np.zeros(sides), np.sin(turn)], 1) * r / np.cos(np.pi / sides)
    ring[:, 2] = np.clip(ring[:, 2], -r, r)
    prism = np.concatenate([ring + np.array([0, h, 0]), ring - np.array([0, h, 0])])
    turns = [(np.cos(t), np.sin(t)) for t in np.linspace(-steer, steer, 7 if steer else 1)]
    swept = [prism @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) for c, s in turns]
    return outer_hull(np.concatenate(swept), 16.0) if steer else convex(prism, crease=180.0)
