"""The hopper: `python -m vehsim.assets.generate hopper` writes `assets/vehicles/hopper/hopper.usdc`.

A scout that hops about the Moon on one telescoping leg: a pod with an eye, and a forked leg hinged at the pod's centre
of mass. The fork passes outside the pod, so that the leg can make a full turn. X forward, Y left, Z up; the root is the
hinge. The leg turns about Y; its middle tubes and its foot slide along Z.
"""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._shapes import (
    Surface,
    below,
    both,
    both_sides,
    box,
    by_material,
    grown,
    join,
    lattice,
    outer_hull,
    painted,
    polygon,
    refined,
    revolve,
    ring,
    seam,
    superellipse,
    torus,
    tube,
)
from vehsim.assets.generate._slim import slimmed
from vehsim.assets.generate._usd import Material, PartShape

LENGTH = 0.90
"""From the hinge to the sole of the foot at rest, m."""
FORK = 0.30
"""Distance of the leg's tubes from the middle plane, m."""
SHORTEST, LONGEST = -0.36, 0.42
"""Smallest and largest extension of the leg, m."""

DOC = "Lunar hopper. X forward, Y left, Z up; root at the hip hinge, the pod's centre of mass."

MATERIALS = {
    "shell": Material((0.78, 0.785, 0.79), roughness=0.32, clearcoat=0.5),
    "foil": Material((0.72, 0.42, 0.10), roughness=0.28, metallic=0.9),
    "dark": Material((0.035, 0.037, 0.04), roughness=0.55),
    "seal": Material((0.012, 0.012, 0.013), roughness=0.7),
    "visor": Material((0.010, 0.012, 0.016), roughness=0.05, clearcoat=1.0),
    "eye": Material((0.2, 0.75, 0.95), roughness=0.2, glow=(0.12, 0.62, 0.85)),
    "accent": Material((0.85, 0.20, 0.012), roughness=0.35, clearcoat=0.5),
    "steel": Material((0.55, 0.56, 0.58), roughness=0.25, metallic=0.9),
    "tube": Material((0.30, 0.305, 0.315), roughness=0.35, metallic=0.7),
    "rubber": Material((0.03, 0.03, 0.031), roughness=0.9),
}


def build() -> dict[str, PartShape]:
    """The hopper's parts by name: its pod, and the leg with its sliding parts."""
    points = points_of(by_material(shell(), fittings()))  # hulls from the full-resolution surfaces
    pod = by_material(slimmed(shell(), 0.0001), fittings())
    upper, middle, foot = leg()
    return {
        "body": PartShape(look=pod, collision={"hull": outer_hull(points, 16.0)}),
        "leg": PartShape(
            look=upper,
            collision=beside(upper),
            parts={
                "shin": PartShape(look=middle, collision=beside(middle)),
                "foot": PartShape(
                    look=foot, collision={"hull": outer_hull(points_of(foot, below(2, -0.6)), 18.0), **beside(foot)}
                ),
            },
        ),
    }


def points_of(look: dict[str, Surface], region=None) -> np.ndarray:
    points = np.concatenate([s.points for s in look.values()])
    return points if region is None else points[region(points) < 0]


def beside(look: dict[str, Surface]) -> dict[str, Surface]:
    """A hull for each side of the fork."""
    points = points_of(look)
    return {
        f"hull_{name}": outer_hull(points[side * points[:, 1] > FORK - 0.075], 18.0)
        for name, side in (("left", 1), ("right", -1))
    }


# ---------------------------------------------------------------- pod


def shell() -> dict[str, Surface]:
    """A pod 0.52 m long between flat cheeks, with a visor in front and an orange belt."""
    ys = 0.225 * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 33))
    rows = []
    for y in ys:
        flat = (
            superellipse(0.27, 0.235, 2.6, 120) * (1 - (abs(y) / 0.225) ** 5) ** 0.30
            if abs(y) < 0.2249
            else (superellipse(0.27, 0.235, 2.6, 120) * 0.05)
        )
        rows.append(np.column_stack([flat[:, 0], np.full(120, y), flat[:, 1]]))
    skin = lattice(rows, crease=60)
    skin = refined(refined(skin, 1, np.arange(-0.2, 0.21, 0.02)), 2, np.arange(-0.22, 0.23, 0.02))
    ahead = lambda p: 0.05 - p[:, 0]
    visor = both(polygon([(-0.165, -0.02), (0.165, -0.02), (0.145, 0.135), (-0.145, 0.135)], 0.05, (1, 2)), ahead)
    eyes = both(both_sides(lambda p: np.hypot(p[:, 1] - 0.068, p[:, 2] - 0.06) - 0.027), ahead)
    belt = lambda p: np.abs(p[:, 2] + 0.105) - 0.024
    foil = lambda p: p[:, 2] + 0.129
    hatch = both(polygon([(-0.12, -0.05), (0.12, -0.05), (0.10, 0.13), (-0.10, 0.13)], 0.03, (1, 2)), lambda p: p[:, 0])
    skin, lines = seam(skin, [hatch], 0.003)
    coats = [("eye", eyes), ("visor", visor), ("seal", grown(visor, 0.010)), ("accent", belt), ("foil", foil)]
    return by_material(painted(skin, coats, "shell"), {"seal": lines})


def fittings() -> dict[str, Surface]:
    """Hinge stubs, a camera mast with a lamp, antenna, solar lid and sampling ports."""
    stub = revolve(
        [(0.0, -0.255), (0.085, -0.255), (0.095, -0.235), (0.095, 0.235), (0.085, 0.255), (0.0, 0.255)], 40, "y"
    )
    lid = box((0.30, 0.26, 0.016), (-0.03, 0, 0.243), 0.006)
    cells = join(
        *(
            box((0.052, 0.052, 0.004), (x, y, 0.2525), 0.001)
            for x in (-0.12, -0.06, 0.0, 0.06)
            for y in (-0.09, -0.03, 0.03, 0.09)
        )
    )
    antenna = tube([(-0.18, 0.09, 0.20), (-0.20, 0.09, 0.36)], 0.006, 8)
    tip = revolve([(0.0, 0.0), (0.014, 0.008), (0.014, 0.022), (0.0, 0.03)], 16).moved((-0.20, 0.09, 0.355))
    dish = revolve([(0.0, 0.0), (0.05, 0.018), (0.055, 0.03), (0.05, 0.022), (0.0, 0.006)], 32).moved(
        (-0.16, -0.1, 0.255)
    )
    nozzle = revolve([(0.0, 0.0), (0.045, 0.0), (0.06, -0.04), (0.05, -0.04), (0.0, -0.01)], 28).moved((0, 0, -0.23))
    return {"dark": join(stub, nozzle), "steel": join(antenna, dish), "visor": join(lid, cells), "accent": tip}


# ---------------------------------------------------------------- leg


def leg() -> tuple[dict[str, Surface], dict[str, Surface], dict[str, Surface]]:
    """The upper tubes with their hips, the tubes that slide by half the extension, and the foot with its cross bar and
    pad."""
    hip = revolve([(0.0, -0.03), (0.075, -0.03), (0.085, -0.02), (0.085, 0.025), (0.07, 0.04), (0.0, 0.04)], 40, "y")
    bolt = join(
        *(
            revolve([(0.0, 0.0), (0.009, 0.0), (0.009, 0.014), (0.0, 0.016)], 6, "y").moved(
                (0.052 * np.cos(a), 0.036, 0.052 * np.sin(a))
            )
            for a in np.arange(6) * np.pi / 3
        )
    )
    band = torus(0.0862, 0.006, 40, "y")
    barrel = revolve(
        [(0.0, 0.06), (0.036, 0.05), (0.040, 0.03), (0.040, -0.40), (0.045, -0.405), (0.045, -0.44), (0.0, -0.44)], 28
    )
    upper = {"dark": join(hip, barrel), "steel": bolt, "accent": band}
    shin = revolve([(0.0, -0.16), (0.030, -0.16), (0.030, -0.62), (0.034, -0.625), (0.034, -0.65), (0.0, -0.65)], 28)
    middle = {"tube": shin}
    rod = revolve([(0.0, -0.32), (0.021, -0.32), (0.021, -0.79), (0.0, -0.79)], 24)
    knuckle = revolve([(0.0, -0.74), (0.036, -0.745), (0.036, -0.80), (0.0, -0.81)], 28)
    bar = tube([(0, FORK, -0.775), (0, FORK - 0.03, -0.80), (0, FORK - 0.10, -0.815), (0, 0, -0.82)], 0.026, 16, 20)
    post = revolve([(0.0, -0.80), (0.045, -0.80), (0.05, -0.82), (0.038, -0.87), (0.0, -0.87)], 28)
    pad = revolve([(0.0, -0.845), (0.07, -0.85), (0.105, -0.872), (0.105, -LENGTH), (0.0, -LENGTH)], 44)
    collar = ring([(0.106, -0.874), (0.112, -0.876), (0.112, -0.886), (0.106, -0.888)], 44, "z")
    side = {"steel": join(rod, knuckle).moved((0, FORK, 0)).pair(), "accent": collar}
    foot = {**side, "tube": join(bar.pair(), post), "rubber": pad}
    placed = [{name: s.moved((0, FORK, 0)).pair() for name, s in look.items()} for look in (upper, middle)]
    return placed[0], placed[1], foot
