"""The boat's outboard motor: cowling, leg and gear case about the steering axis, and its propeller.

Everything here turns about the motor's pivot, at `PIVOT` on the boat.
"""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._shapes import (
    Array,
    Surface,
    both,
    box,
    by_material,
    curve,
    join,
    lattice,
    painted,
    polygon,
    revolve,
    split,
    superellipse,
    wing,
)
from vehsim.assets.generate._usd import PartShape

PIVOT = (-3.16, 0.0, 0.40)
"""The steering axis at the bracket, in the boat's root frame, m."""
SHAFT = -1.00  # propeller shaft below the pivot
BLADE_RADIUS, PITCH = 0.19, 0.43


def outboard() -> tuple[dict[str, Surface], PartShape]:
    """The steered part, in the pivot's frame, and the propeller that it carries."""
    look = by_material(cowling(), leg(), gear_case())
    disc = [(0.0, -0.10), (BLADE_RADIUS, -0.10), (BLADE_RADIUS, 0.09), (0.0, 0.09)]
    turn = revolve([(r * 1.02, x) for r, x in disc], 20, "x", 180.0)
    return look, PartShape((-0.405, 0.0, SHAFT), propeller(), {"disc": turn})


def cowling() -> dict[str, Surface]:
    """The engine's cover: a rounded body, higher aft than forward, with a band and an air intake."""
    low, high = 0.17, 0.80
    zs = np.concatenate(
        [
            [low, low + 0.004, low + 0.02],
            np.linspace(0.24, 0.66, 12),
            high - 0.14 * np.cos(np.linspace(0.2, np.pi / 2, 8)) ** 2,
        ]
    )
    length = curve([low, 0.22, 0.40, 0.62, 0.72, 0.78, high], [0.28, 0.34, 0.375, 0.355, 0.31, 0.21, 0.02])
    width = curve([low, 0.22, 0.40, 0.62, 0.72, 0.78, high], [0.15, 0.20, 0.225, 0.205, 0.17, 0.115, 0.012])
    middle = curve([low, 0.4, high], [-0.14, -0.20, -0.27])
    rows = []
    for z in zs:
        x, y = superellipse(length(z), width(z), 8 / 3, 36).T
        tilt = 0.26 * np.clip((z - 0.4) / 0.4, 0, 1) * x  # the top slopes down forward
        rows.append(np.stack([middle(z) + x, y, z - tilt], 1))
    skin = lattice(rows, crease=50)
    band = polygon([(0.30, 0.335), (-0.70, 0.405), (-0.70, 0.465), (0.30, 0.375)])
    split_line = both(lambda p: p[:, 2] - 0.243, lambda p: 0.231 - p[:, 2])
    intake = both(
        polygon([(-0.44, 0.53), (-0.53, 0.53), (-0.50, 0.66), (-0.42, 0.66)], 0.03), lambda p: 0.05 - np.abs(p[:, 1])
    )
    return painted(skin, [("rubber", intake), ("rubber", split_line), ("cowl_band", band)], "cowl")


def leg() -> dict[str, Surface]:
    """The midsection from the cowling down to the plate above the propeller, and the swivel it turns in."""
    heights = [0.20, 0.10, -0.05, -0.25, -0.45, -0.62, -0.72, -0.77]
    chord = curve([-0.77, -0.6, -0.25, 0.1, 0.2], [0.40, 0.36, 0.36, 0.44, 0.52])
    thick = curve([-0.77, -0.3, 0.1, 0.2], [0.26, 0.34, 0.44, 0.50])
    column = wing(
        [([-0.10 + 0.25 * (chord(z) - 0.4), 0, z], float(chord(z)), float(thick(z)), 0.0) for z in heights],
        [0, 1.0, 0],
        14,
    )
    outline = [(0.08, 0.03), (0.02, 0.095), (-0.20, 0.13), (-0.52, 0.12), (-0.56, 0.09)]
    loop = np.array([*outline, *((x, -y) for x, y in outline[::-1])])
    plate = lattice(
        [
            np.column_stack([loop * k, np.full(len(loop), z)])
            for k, z in ((0.98, -0.790), (1.0, -0.784), (1.0, -0.774), (0.98, -0.768))
        ],
        crease=20,
    )
    upper = lattice([np.column_stack([loop * [0.72, 0.8], np.full(len(loop), z)]) for z in (-0.665, -0.653)], crease=20)
    swivel = box([0.13, 0.15, 0.40], [0.03, 0.0, -0.02], 0.03, 2)
    return {"casing": join(column, plate, upper), "rubber": swivel}


def gear_case() -> dict[str, Surface]:
    """The strut below the plate, the torpedo on the shaft, and the skeg."""
    stations = np.linspace(-0.77, SHAFT + 0.03, 5)
    strut = wing([([-0.12, 0, z], 0.36, 0.20, 0.0) for z in stations], [0, 1.0, 0], 12)
    profile = [
        (0.0, 0.13),
        (0.018, 0.125),
        (0.040, 0.09),
        (0.056, 0.03),
        (0.062, -0.06),
        (0.062, -0.22),
        (0.058, -0.30),
        (0.0, -0.30),
    ]
    torpedo = revolve(profile, 28, "x", 50).moved([0, 0, SHAFT])
    back = curve([SHAFT - 0.24, SHAFT - 0.04], [-0.20, -0.10])
    size = curve([SHAFT - 0.24, SHAFT - 0.2, SHAFT - 0.04], [0.11, 0.15, 0.30])
    skeg = wing(
        [([back(z), 0, z], float(size(z)), 0.09, 0.0) for z in np.linspace(SHAFT - 0.04, SHAFT - 0.24, 6)],
        [0, 1.0, 0],
        10,
    )
    return {"casing": join(strut, torpedo, skeg)}


def propeller() -> dict[str, Surface]:
    """Three blades on a right-handed hub: positive rotation about +X drives ahead. The tip of one blade is marked."""
    hub = revolve(
        [
            (0.0, 0.095),
            (0.05, 0.09),
            (0.058, 0.06),
            (0.055, -0.08),
            (0.05, -0.10),
            (0.044, -0.10),
            (0.04, -0.06),
            (0.0, -0.06),
        ],
        28,
        "x",
    )
    nut = revolve([(0.0, -0.06), (0.024, -0.06), (0.020, -0.115), (0.010, -0.135), (0.0, -0.14)], 16, "x")
    blades = [blade(2 * np.pi * k / 3) for k in range(3)]
    marked, plain = split(blades[0], lambda p: 0.135 - np.hypot(p[:, 1], p[:, 2]))
    return {"steel": join(hub, nut, plain, *blades[1:]), "blade_mark": marked}


def blade(turn: float) -> Surface:
    """One blade: a helicoid of constant pitch, its outline a skewed ear, thin towards tip and edges."""
    radii = np.concatenate([np.linspace(0.045, 0.17, 9), [0.18, 0.186, BLADE_RADIUS]])
    half_angle = curve([0.045, 0.08, 0.12, 0.16, 0.18, BLADE_RADIUS], [0.62, 0.66, 0.60, 0.46, 0.32, 0.06])
    skew = curve([0.045, 0.10, BLADE_RADIUS], [0.0, 0.04, 0.34])
    thickness = curve([0.045, 0.1, BLADE_RADIUS], [0.011, 0.006, 0.002])
    along = np.cos(np.linspace(0, np.pi, 9))
    rows = []
    for r in radii:
        theta = half_angle(r) * along - skew(r)
        bulge = thickness(r) * (1 - along**2) / 2 + 0.0006
        loop = [_screw(r, a, turn, b) for a, b in zip(theta, bulge, strict=True)]
        loop += [_screw(r, a, turn, -b) for a, b in zip(theta[::-1], bulge[::-1], strict=True)]
        rows.append(loop)
    return lattice(rows, crease=50)


def _screw(radius: float, angle: float, turn: float, off: float) -> Array:
    """A point on the helicoid, moved ``off`` along the shaft."""
    return np.array([PITCH * angle / (2 * np.pi) + off, radius * np.cos(angle + turn), radius * np.sin(angle + turn)])
