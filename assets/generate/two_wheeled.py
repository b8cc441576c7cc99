"""The two-wheeled robot: `python -m vehsim.assets.generate two_wheeled` writes its `two_wheeled.usdc`.

A delivery robot for corridors: 0.5 m long, two driven wheels of 0.2 m diameter 0.38 m apart, a ball caster behind.
X forward, Y left, Z up; the root is on the ground between the wheels. Wheels turn about Y.
"""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._shapes import (
    Array,
    Field,
    Surface,
    below,
    both,
    both_sides,
    box,
    by_material,
    curve,
    grown,
    join,
    lattice,
    outer_hull,
    painted,
    polygon,
    revolve,
    seam,
    sharpened,
    superellipse,
    tube,
)
from vehsim.assets.generate._usd import Material, PartShape
from vehsim.assets.generate._wheels import spoked_wheel, wheel_hull

RADIUS, WIDTH, HALF_TRACK = 0.10, 0.045, 0.19
DOC = "Two-wheeled robot. X forward, Y left, Z up; root on the ground between the wheels."

MATERIALS = {
    "shell": Material((0.78, 0.79, 0.80), roughness=0.3, clearcoat=0.6),
    "accent": Material((0.85, 0.22, 0.015), roughness=0.35, clearcoat=0.6),
    "chassis": Material((0.045, 0.047, 0.05), roughness=0.55),
    "rubber": Material((0.02, 0.02, 0.021), roughness=0.85),
    "visor": Material((0.010, 0.011, 0.013), roughness=0.05, clearcoat=1.0),
    "eye": Material((0.15, 0.75, 0.9), roughness=0.2, glow=(0.10, 0.65, 0.8)),
    "tail_lamp": Material((0.42, 0.006, 0.008), roughness=0.12, clearcoat=1.0, glow=(0.2, 0.0, 0.0)),
    "steel": Material((0.45, 0.46, 0.48), roughness=0.25, metallic=0.9),
    "tyre": Material((0.025, 0.025, 0.027), roughness=0.85),
    "rim": Material((0.32, 0.325, 0.335), roughness=0.3, metallic=0.8),
    "hub": Material((0.06, 0.062, 0.066), roughness=0.4),
    "mark": Material((0.85, 0.22, 0.015), roughness=0.35),
}
LIVERIES = {
    "orange": {name: MATERIALS[name] for name in ("shell", "accent", "mark")},
    "teal": {
        "shell": Material((0.012, 0.19, 0.20), roughness=0.3, clearcoat=0.6),
        "accent": Material((0.80, 0.62, 0.08), roughness=0.35, clearcoat=0.6),
        "mark": Material((0.80, 0.62, 0.08), roughness=0.35),
    },
}


def build() -> dict[str, PartShape]:
    """The robot's parts by name: body and its two wheels."""
    look = by_material(chassis(), shell(), head(), fittings())
    points = np.concatenate([s.points for s in look.values()])
    low = points[:, 2] < 0.20
    hulls = {"hull_low": outer_hull(points[points[:, 2] < 0.235], 16.0), "hull_high": outer_hull(points[~low], 16.0)}
    left = spoked_wheel(RADIUS, WIDTH)
    hull = {"hull": wheel_hull(0.0, RADIUS, WIDTH)}
    return {
        "body": PartShape(look=look, collision=hulls),
        "wheel_left": PartShape((0.0, HALF_TRACK, RADIUS), left, hull),
        "wheel_right": PartShape((0.0, -HALF_TRACK, RADIUS), {n: s.mirrored() for n, s in left.items()}, hull),
    }


def loft(zs: Array, length, width, power: float, middle=lambda z: 0.0, around: int = 72) -> Surface:
    """A closed skin of horizontal superellipses at heights ``zs``, half axes ``length(z)`` and ``width(z)``."""
    rows = []
    for z in zs:
        x, y = superellipse(float(length(z)), float(width(z)), power, around).T
        rows.append(np.column_stack([x + float(middle(z)), y, np.full(around, z)]))
    return lattice(rows, crease=45)


def chassis() -> dict[str, Surface]:
    """The tub between the wheels, its bumper, the axle stubs, and the ball caster."""
    length = curve([0.035, 0.045, 0.07, 0.2], [0.155, 0.195, 0.215, 0.215])
    width = curve([0.035, 0.045, 0.07, 0.2], [0.105, 0.130, 0.140, 0.140])
    tub = loft(np.array([0.035, 0.038, 0.045, 0.055, 0.07, 0.10, 0.15, 0.2]), length, width, 4.0, lambda z: -0.02)
    x, y = superellipse(0.232, 0.148, 4.0, 72).T
    loop = np.column_stack([x - 0.02, y, np.full(72, 0.085)])
    bumper = tube(np.vstack([loop, loop[:2]]), 0.014, 8)
    axles = join(*(tube([[0, s * 0.13, RADIUS], [0, s * 0.172, RADIUS]], 0.024, 20) for s in (-1, 1)))
    ball = revolve(
        [(0.0, -0.022), *((0.022 * np.cos(t), 0.022 * np.sin(t)) for t in np.linspace(-1.4, 1.4, 9)), (0.0, 0.022)], 24
    )
    cup = revolve([(0.0, 0.018), (0.034, 0.018), (0.036, 0.022), (0.034, 0.045), (0.0, 0.045)], 24)
    vents: list[Field] = [
        both(
            polygon([(x, 0.13), (x + 0.012, 0.13), (x + 0.012, 0.175), (x, 0.175)], 0.005),
            lambda p: 0.1 - np.abs(p[:, 1]),
        )
        for x in np.arange(-0.19, -0.13, 0.022)
    ]
    tub = sharpened(tub, lambda p: np.min([vent(p) for vent in vents], axis=0), 0.008, (0, 2))
    return by_material(
        painted(tub, [("rubber", vent) for vent in vents], "chassis"),
        {"rubber": bumper, "steel": join(axles, ball.moved([-0.185, 0, 0.022])), "chassis": cup.moved([-0.185, 0, 0])},
    )


def shell() -> dict[str, Surface]:
    """The body shell over tub and wheels, with its accent band, visor, eyes, tail lamp and the lid's seam."""
    zs = np.concatenate(
        [
            [0.212, 0.214, 0.220],
            np.linspace(0.235, 0.40, 14),
            0.44 - 0.04 * np.cos(np.linspace(0.25, np.pi / 2, 9)) ** 2,
        ]
    )
    length = curve([0.212, 0.22, 0.26, 0.36, 0.41, 0.43, 0.44], [0.232, 0.246, 0.255, 0.235, 0.205, 0.155, 0.02])
    width = curve([0.212, 0.22, 0.26, 0.36, 0.41, 0.43, 0.44], [0.205, 0.219, 0.226, 0.205, 0.175, 0.130, 0.017])
    skin = loft(zs, length, width, 3.2, curve([0.21, 0.44], [-0.015, -0.045]))
    ahead, behind = below(0, 0.08), lambda p: p[:, 0] + 0.1
    facing = both(
        polygon([(-0.165, 0.285), (0.165, 0.285), (0.145, 0.375), (-0.145, 0.375)], 0.03, (1, 2)), lambda p: -ahead(p)
    )
    eye = both(both_sides(lambda p: np.hypot(p[:, 1] - 0.062, (p[:, 2] - 0.333) / 1.35) - 0.0165), lambda p: -ahead(p))
    tail = both(polygon([(-0.11, 0.33), (0.11, 0.33), (0.11, 0.345), (-0.11, 0.345)], 0.006, (1, 2)), behind)
    lid = both(
        polygon([(0.10, -0.13), (0.10, 0.13), (-0.21, 0.13), (-0.21, -0.13)], 0.04, (0, 1)), lambda p: 0.38 - p[:, 2]
    )
    band = both(below(2, 0.262), lambda p: 0.240 - p[:, 2])
    skin, lines = seam(sharpened(skin, eye, 0.006), [lid], 0.0016)
    coats = [("eye", eye), ("visor", facing), ("chassis", grown(facing, 0.006)), ("tail_lamp", tail), ("accent", band)]
    return by_material(painted(skin, coats, "shell"), {"rubber": lines})


def head() -> dict[str, Surface]:
    """The lidar on its post and the signal mast."""
    post = revolve([(0.0, 0.43), (0.034, 0.43), (0.027, 0.445), (0.027, 0.46), (0.0, 0.46)], 32)
    lidar = revolve(
        [
            (0.0, 0.458),
            (0.043, 0.458),
            (0.046, 0.462),
            (0.046, 0.472),
            (0.042, 0.475),
            (0.042, 0.492),
            (0.046, 0.495),
            (0.046, 0.505),
            (0.040, 0.512),
            (0.0, 0.514),
        ],
        40,
    )
    window = revolve([(0.0, 0.476), (0.0425, 0.476), (0.0425, 0.491), (0.0, 0.491)], 40)
    mast = tube([[-0.20, 0, 0.40], [-0.215, 0, 0.50], [-0.235, 0, 0.62]], [0.006, 0.005, 0.004], 10, 8)
    flag = tube([[-0.236, 0, 0.62], [-0.240, 0, 0.645]], [0.011, 0.011], 14)
    return {
        "chassis": join(post.moved([0.02, 0, 0]), lidar.moved([0.02, 0, 0]), mast),
        "visor": window.moved([0.02, 0, 0]),
        "accent": flag,
    }


def fittings() -> dict[str, Surface]:
    """Depth camera below the visor and charging contacts."""
    camera = box([0.03, 0.11, 0.03], [0.222, 0, 0.175], 0.011, 3)
    lenses = join(
        *(
            revolve([(0.0, 0.0), (0.009, 0.0), (0.009, 0.004), (0.0, 0.005)], 16, "x").moved([0.2365, y, 0.175])
            for y in (-0.036, 0.0, 0.036)
        )
    )
    bracket = box([0.05, 0.05, 0.02], [0.195, 0, 0.175], 0.006, 2)
    contacts = join(*(box([0.006, 0.03, 0.012], [-0.236, y, 0.14], 0.002) for y in (-0.03, 0.03)))
    return {"chassis": join(camera, bracket), "visor": lenses, "steel": contacts}
