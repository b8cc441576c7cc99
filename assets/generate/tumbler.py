"""The tumbler: `python -m vehsim.assets.generate tumbler` writes its `tumbler.usdc`.

A T-handle as astronauts spin it: a steel crossbar of 0.30 m with a brass stem, whose three moments of inertia differ. X
along the stem, Y along the crossbar; the root is at the centre of mass, axes along the principal ones.
"""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._shapes import (
    Array,
    Field,
    Surface,
    both,
    by_material,
    join,
    outer_hull,
    painted,
    revolve,
)
from vehsim.assets.generate._usd import Material, PartShape

STEEL, BRASS = 7850.0, 8500.0  # kg/m^3
BAR, BAR_RADIUS = 0.15, 0.013  # half length and radius of the crossbar, m
STEM, STEM_RADIUS = 0.155, 0.018  # length of the stem from the crossbar's axis, and its radius, m
DOC = "T-handle. X along the stem, Y along the crossbar; root at the centre of mass."

MATERIALS = {
    "bar": Material((0.40, 0.41, 0.43), roughness=0.25, metallic=0.9),
    "grip": Material((0.018, 0.019, 0.021), roughness=0.8),
    "cap": Material((0.70, 0.035, 0.03), roughness=0.3, clearcoat=0.6),
    "cap_other": Material((0.02, 0.14, 0.55), roughness=0.3, clearcoat=0.6),
    "stem": Material((0.62, 0.40, 0.12), roughness=0.28, metallic=0.85),
    "mark": Material((0.78, 0.78, 0.75), roughness=0.4),
}
LIVERIES = {
    "steel": {name: MATERIALS[name] for name in ("bar", "stem", "mark")},
    "orange": {
        "bar": Material((0.80, 0.25, 0.02), roughness=0.3, clearcoat=0.6),
        "stem": Material((0.30, 0.31, 0.33), roughness=0.3, metallic=0.85),
        "mark": Material((0.03, 0.03, 0.032), roughness=0.4),
    },
}


def build() -> dict[str, PartShape]:
    """One part: the handle about its centre of mass."""
    shift = [-centre_of_mass()[0], 0.0, 0.0]
    look = {name: surface.moved(shift) for name, surface in by_material(crossbar(), stem()).items()}
    points = np.concatenate([s.points for s in look.values()])
    along = points[:, 0] - shift[0]
    hulls = {
        "bounds_bar": outer_hull(points[along < 0.030], 16.0),
        "bounds_stem": outer_hull(points[along > 0.0], 16.0),
    }
    return {"handle": PartShape(look=look, collision=hulls)}


def masses() -> tuple[float, float]:
    """Mass of crossbar and stem as plain cylinders, kg."""
    return STEEL * np.pi * BAR_RADIUS**2 * 2 * BAR, BRASS * np.pi * STEM_RADIUS**2 * STEM


def centre_of_mass() -> Array:
    bar, shaft = masses()
    return np.array([shaft * STEM / 2 / (bar + shaft), 0.0, 0.0])


def inertia() -> Array:
    """Principal moments (3,) about the centre of mass, kg m^2."""
    (bar, shaft), x = masses(), centre_of_mass()[0]
    axial, across = bar * BAR_RADIUS**2 / 2, bar * (3 * BAR_RADIUS**2 + 4 * BAR**2) / 12
    spin, swing = shaft * STEM_RADIUS**2 / 2, shaft * (3 * STEM_RADIUS**2 + STEM**2) / 12
    away = bar * x**2 + shaft * (STEM / 2 - x) ** 2
    return np.array([across + spin, axial + swing + away, across + swing + away])


def crossbar() -> dict[str, Surface]:
    """The bar with knurled grips and a coloured cap on either end: red on the left, blue on the right."""
    r, y = BAR_RADIUS, BAR
    ring: list[tuple[float, float]] = [(0.0, -y), (0.7 * r, -y), (0.93 * r, -y + 0.07 * r), (r, -y + 0.3 * r)]
    ribs = np.arange(0.055, 0.122, 0.004)
    for centre in [*-ribs[::-1], *ribs]:
        ring += [
            (r, centre - 0.0015),
            (r - 0.0012, centre - 0.0006),
            (r - 0.0012, centre + 0.0006),
            (r, centre + 0.0015),
        ]
    ring += [(r, y - 0.3 * r), (0.93 * r, y - 0.07 * r), (0.7 * r, y), (0.0, y)]
    surface = revolve(ring, 48, "y", 40)
    grip: Field = lambda p: np.abs(np.abs(p[:, 1]) - 0.0885) - 0.0375
    left: Field = lambda p: 0.128 - p[:, 1]
    right: Field = lambda p: p[:, 1] + 0.128
    collar = revolve([(r, -0.030), (r + 0.006, -0.027), (r + 0.006, 0.027), (r, 0.030)], 48, "y", 35)
    return by_material(painted(surface, [("cap", left), ("cap_other", right), ("grip", grip)], "bar"), {"stem": collar})


def stem() -> dict[str, Surface]:
    """The stem with a stepped shank, a flange, a hexagonal end, and a white line along one side."""
    r = STEM_RADIUS
    profile = [(0.0, 0.0), (r, 0.0), (r, 0.030), (r + 0.004, 0.034), (r + 0.004, 0.042), (r, 0.046), (r, 0.118)]
    profile += [(r - 0.002, 0.121), (r - 0.002, 0.124), (0.0, 0.124)]
    shank = revolve(profile, 48, "x", 35)
    hexagon = revolve(
        [(0.0, 0.122), (r, 0.122), (r + 0.004, 0.126), (r + 0.004, STEM - 0.004), (r, STEM), (0.0, STEM)], 6, "x", 20
    )
    line: Field = both(
        lambda p: np.abs(p[:, 1]) - 0.004, lambda p: -p[:, 2], lambda p: 0.050 - p[:, 0], lambda p: p[:, 0] - 0.112
    )
    bore = revolve([(0.0, STEM - 0.001), (0.009, STEM - 0.001), (0.009, STEM + 0.0008), (0.0, STEM + 0.0008)], 24, "x")
    return by_material(painted(shank, [("mark", line)], "stem"), {"stem": join(hexagon), "grip": bore})
