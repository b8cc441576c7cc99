"""Wheels: the car's, spoked wheels of any size, and hulls that contain them at every angle of roll and steering."""

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
    # letters on the sidewall, in two arcs of different lengths: they make the rotation visible
    letters = [
        _letter(a, r) for start, count in ((0.35, 7), (0.35 + np.pi, 4)) for a in start + 0.13 * np.arange(count)
    ]
    back = revolve([(0.0, -0.075), (0.20, -0.075), (0.20, -0.06), (0.0, -0.06)], 32, "y")
    return by_material(
        {
            "tyre": tyre,
            "rim": join(barrel, hub, *spokes),
            "trim": join(back, nuts),
            "disc": disc,
            "mark": join(*letters),
        }
    )


def _letter(angle: float, radius: float) -> Surface:
    """A raised block on the outer sidewall at ``angle``."""
    along, across = np.array([np.cos(angle), 0, np.sin(angle)]), np.array([-np.sin(angle), 0, np.cos(angle)])
    corners = [
        d * radius * along + side * half * across + (WIDTH / 2 + y) * np.array([0, 1.0, 0])
        for d in (0.805, 0.875)
        for side in (-1, 1)
        for half, y in ((0.0105, -0.006), (0.009, 0.0012))
    ]
    return convex(np.array(corners), 20.0)


def spoked_wheel(
    radius: float, width: float, rim: float = 0.72, spokes: int = 5, marked: int = 1, sides: int = 56
) -> dict[str, Surface]:
    """A left wheel about its own centre, Y outboard: a round-shouldered "tyre", a "rim" with spokes, a "hub".

    ``rim``: its share of ``radius``; ``sides`` of the tyre's outline. The first ``marked`` spokes are the surface
    "mark", which makes the rotation visible.
    """
    h, r, b = width / 2, rim * radius, 0.16 * width
    shoulder = [(radius - b + b * np.sin(t), h - b + b * np.cos(t)) for t in np.linspace(0, np.pi / 2, 5)]
    outer = [(r, h - 0.6 * b), (r + 0.25 * (radius - r), h), *shoulder]
    tyre = ring([*outer, *((a, -y) for a, y in outer[::-1])], sides)
    t = 0.1 * radius
    section = [(r, -h + b), (r, h - 0.7 * b), (r - 0.5 * t, h - 0.4 * b), (r - t, h - b), (r - t, -h + b)]
    barrel = ring(section, sides * 6 // 7)
    arms = []
    for k in range(spokes):
        a = 2 * np.pi * k / spokes
        along, across = np.array([np.cos(a), 0, np.sin(a)]), np.array([-np.sin(a), 0, np.cos(a)])
        corners = [
            d * along + side * half * across + y * np.array([0, 1.0, 0])
            for d, half, lift in ((0.12 * radius, 0.085 * radius, 0.0), (r - 0.6 * t, 0.06 * radius, 0.25 * b))
            for side in (-1, 1)
            for half, y in ((half, h - 3.2 * b), (half, h - 1.4 * b + lift), (0.6 * half, h - b + lift))
        ]
        arms.append(convex(np.array(corners), 20.0))
    cap = 0.22 * radius
    hub = revolve([(0.0, -h + b), (cap, -h + b), (cap, h - b), (0.8 * cap, h - 0.5 * b), (0.0, h - 0.4 * b)], 32, "y")
    bolts = [
        revolve([(0.0, 0.0), (0.12 * cap, 0.0), (0.12 * cap, 0.25 * b), (0.0, 0.3 * b)], 6, "y").moved(
            [0.5 * cap * np.cos(a), h - 0.5 * b, 0.5 * cap * np.sin(a)]
        )
        for a in np.linspace(0, 2 * np.pi, spokes, endpoint=False)
    ]
    return by_material(
        {"tyre": tyre, "rim": join(barrel, *arms[marked:])}, {"mark": join(*arms[:marked])}, {"hub": join(hub, *bolts)}
    )


def wheel_hull(steer: float, radius: float = RADIUS, width: float = WIDTH) -> Surface:
    """A prism around a wheel, swept over its steering angles if it steers, because hulls do not move."""
    r, h, sides = radius, width / 2 + 0.002, 16
    turn = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    ring = np.stack([np.cos(turn), np.zeros(sides), np.sin(turn)], 1) * r / np.cos(np.pi / sides)
    ring[:, 2] = np.clip(ring[:, 2], -r, r)
    prism = np.concatenate([ring + np.array([0, h, 0]), ring - np.array([0, h, 0])])
    turns = [(np.cos(t), np.sin(t)) for t in np.linspace(-steer, steer, 7 if steer else 1)]
    swept = [prism @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) for c, s in turns]
    return outer_hull(np.concatenate(swept), 16.0) if steer else convex(prism, crease=180.0)
