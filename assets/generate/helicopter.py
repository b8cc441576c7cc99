"""The light helicopter: `python -m vehsim.assets.generate helicopter` writes its `helicopter.usdc`.

A single-engine machine of the five- to six-seat class: rotor 10.7 m across, fuselage 10.9 m long. X forward, Y left,
Z up; the root is on the ground between the skids, below the mast. Seen from above the main rotor turns
counter-clockwise, so its torque turns the nose right, and the tail rotor, on the left, pushes the tail to the right.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vehsim.assets.generate._crew import ABOARD, FLIGHT_WEAR, driver_materials
from vehsim.assets.generate._fuselage import (
    HULL_TOP,
    HULL_WIDTH,
    bare_hull,
    below_hull,
    cabin,
    doors,
    pilot,
    superellipses,
    windows,
)
from vehsim.assets.generate._rotors import main_rotor, tail_disc, tail_rotor
from vehsim.assets.generate._shapes import (
    Field,
    Surface,
    both,
    box,
    by_material,
    convex,
    curve,
    grown,
    join,
    lattice,
    outer_hull,
    painted,
    polygon,
    revolve,
    seam,
    split,
    tube,
    wing,
)
from vehsim.assets.generate._slim import slimmed
from vehsim.assets.generate._usd import Material, PartShape

HUB = np.array([0.0, 0.0, 3.06])
TAIL_HUB = np.array([-6.35, 0.36, 2.12])

DOC = "Light helicopter. X forward, Y left, Z up; root on the ground below the mast."

MATERIALS = {
    "white": Material((0.78, 0.79, 0.80), roughness=0.28, clearcoat=1.0),
    "blue": Material((0.012, 0.055, 0.20), roughness=0.25, clearcoat=1.0),
    "gold": Material((0.80, 0.36, 0.035), roughness=0.28, clearcoat=1.0),
    "glass": Material((0.07, 0.095, 0.105), roughness=0.04, opacity=0.30, clearcoat=1.0, ior=1.5),
    "lining": Material((0.085, 0.087, 0.09), roughness=0.85),
    "seat": Material((0.045, 0.046, 0.05), roughness=0.8),
    "seal": Material((0.015, 0.015, 0.016), roughness=0.7),
    "dark": Material((0.035, 0.037, 0.04), roughness=0.55),
    "metal": Material((0.36, 0.37, 0.39), roughness=0.38, metallic=0.9),
    "steel": Material((0.16, 0.15, 0.145), roughness=0.5, metallic=0.8),
    "blade": Material((0.075, 0.08, 0.085), roughness=0.5),
    "tip": Material((0.80, 0.36, 0.035), roughness=0.4),
    "red": Material((0.6, 0.02, 0.02), roughness=0.2, glow=(0.5, 0.0, 0.0)),
    "green": Material((0.02, 0.5, 0.08), roughness=0.2, glow=(0.0, 0.4, 0.05)),
    "lamp": Material((0.9, 0.9, 0.85), roughness=0.1, glow=(0.25, 0.25, 0.22)),
    "blur": Material((0.10, 0.105, 0.11), roughness=0.8, opacity=0.10),
    "blur_root": Material((0.08, 0.085, 0.09), roughness=0.8, opacity=0.14),
    "blur_tip": Material((0.80, 0.42, 0.08), roughness=0.8, opacity=0.12),
    **driver_materials(FLIGHT_WEAR),
}
ABSENT = ABOARD
LIVERIES = {
    "navy": {name: MATERIALS[name] for name in ("white", "blue", "gold")},
    "rescue": {
        "white": Material((0.80, 0.62, 0.03), roughness=0.28, clearcoat=1.0),
        "blue": Material((0.45, 0.018, 0.012), roughness=0.25, clearcoat=1.0),
        "gold": Material((0.78, 0.79, 0.80), roughness=0.28, clearcoat=1.0),
    },
}

TOLERANCES = ((0.001, 0.002), (0.001, 0.001), (0.0002, 0.0002), (0.0002, 0.0002))
"""Decimation tolerances of hull, cowling, fin and landing gear, m: elsewhere, and where they are blue."""


def build() -> dict[str, PartShape]:
    """The helicopter's parts by name: fuselage, main rotor with its blades, tail rotor."""
    slim, rest = (hull(), cowling(), fin(), landing_gear()), (stabiliser(), mast(), fittings())
    # hulls from the full-resolution surfaces, so that they do not depend on the decimation
    whole = by_material(*slim, *rest)
    inside = cabin(), pilot()
    slim = (slim[0], {name: split(s, below_hull)[1] for name, s in slim[1].items()}, *slim[2:])
    look = by_material(*(slimmed(s, t, blue=b) for s, (t, b) in zip(slim, TOLERANCES, strict=True)), *rest, *inside)
    return {
        "fuselage": PartShape(look=look, collision=fuselage_hulls(whole)),
        "main_rotor": replace(main_rotor(), pivot=tuple(HUB)),
        "tail_rotor": PartShape(tuple(TAIL_HUB), tail_rotor(), {"disc": tail_disc()}),
    }


# ---------------------------------------------------------------- fuselage


STRIPE = curve([3.5, 2.4, 1.0, -0.2, -1.2, -2.2, -3.2, -4.4], [0.97, 1.03, 1.08, 1.16, 1.32, 1.58, 1.86, 2.10])


def livery(surface: Surface, coats: list[tuple[str, Field]]) -> dict[str, Surface]:
    """The ``coats``, then blue below the cheat line, the gold stripe along it, white above."""
    lines: list[tuple[str, Field]] = [
        ("blue", lambda p: p[:, 2] - STRIPE(p[:, 0])),
        ("gold", lambda p: p[:, 2] - STRIPE(p[:, 0]) - 0.075),
    ]
    return painted(surface, [*coats, *lines], "white")


def hull() -> dict[str, Surface]:
    """The skin with the glazing, its seals and the door lines cut into it."""
    panes = windows()
    skin, lines = seam(bare_hull(), doors(), 0.006)
    coats: list[tuple[str, Field]] = [("glass", pane) for pane in panes]
    coats += [("seal", grown(pane, 0.018)) for pane in panes]
    return by_material(livery(skin, coats), {"seal": lines})


def cowling() -> dict[str, Surface]:
    """The fairing over gearbox and engine, its intake and louvres, and the exhaust."""
    top = curve(
        [1.34, 1.22, 1.05, 0.80, 0.45, 0.0, -0.6, -1.2, -1.8, -2.2, -2.5, -2.72],
        [2.24, 2.34, 2.46, 2.57, 2.67, 2.72, 2.72, 2.68, 2.59, 2.47, 2.30, 2.10],
    )
    width = curve(
        [1.34, 1.22, 1.05, 0.8, 0.4, -0.6, -1.4, -2.0, -2.4, -2.72],
        [0.20, 0.34, 0.44, 0.52, 0.57, 0.57, 0.50, 0.39, 0.28, 0.12],
    )
    xs = np.concatenate([np.linspace(1.34, 1.0, 9), np.arange(0.93, -2.65, -0.13), [-2.72]])
    skin = lattice(superellipses(xs, top, lambda x: HULL_TOP(x) - 0.45, width, lambda x: 3.0, 0.5, 40), crease=45)
    intake = both(
        polygon([(1.12, 2.33), (0.52, 2.33), (0.52, 2.52), (0.86, 2.52)], 0.05), lambda p: 0.1 - np.abs(p[:, 1])
    )
    louvres = [polygon([(x, 2.30), (x - 0.34, 2.30), (x - 0.34, 2.54), (x, 2.54)], 0.04) for x in (-0.75, -1.18)]
    coats: list[tuple[str, Field]] = [("dark", intake), *(("dark", louvre) for louvre in louvres)]
    pipe = tube([[-1.7, 0.0, 2.36], [-2.3, 0.0, 2.43], [-2.86, 0.0, 2.55]], [0.20, 0.19, 0.18], 24, 8)
    bore = revolve([(0.0, 0.0), (0.165, 0.0), (0.165, 0.004)], 24, "x").moved([0, 0, 0])
    tilt = np.arctan2(0.12, 0.56)
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    bore = bore.turned(turn).moved([-2.8635, 0, 2.5505])
    return by_material(livery(skin, coats), {"steel": pipe}, {"dark": bore})


def fin() -> dict[str, Surface]:
    """The swept upper fin, the ventral fin below it, and the tail guard."""
    up = [0.0, 1.0, 0.0]
    heights = np.linspace(1.72, 3.02, 12)
    lean = curve([1.72, 2.1, 2.9, 3.02], [-6.02, -6.24, -6.76, -6.84])
    chord = curve([1.72, 1.95, 2.2, 2.9, 2.98, 3.02], [1.25, 1.02, 0.90, 0.66, 0.56, 0.40])
    upper = wing([([lean(z), 0, z], chord(z), 0.13, 0.0) for z in heights], up, 14)
    depths = np.linspace(1.95, 1.02, 9)
    back = curve([1.02, 1.95], [-6.74, -6.25])
    width = curve([1.02, 1.06, 1.3, 1.95], [0.32, 0.46, 0.58, 0.85])
    lower = wing([([back(z), 0, z], width(z), 0.12, 0.0) for z in depths], up, 14)
    guard = tube([[-6.72, 0, 1.12], [-6.85, 0, 0.98], [-7.05, 0, 0.93], [-7.22, 0, 0.98]], 0.022, 8, 14)
    cap = both(lambda p: 2.78 - p[:, 2] + 0.25 * (p[:, 0] + 6.7))
    band = both(lambda p: 2.71 - p[:, 2] + 0.25 * (p[:, 0] + 6.7))
    return by_material(
        painted(upper, [("white", cap), ("gold", band)], "blue"),
        {"blue": lower},
        {"metal": guard},
    )


def stabiliser() -> dict[str, Surface]:
    """The tailplane through the boom, its end plates and the navigation lights."""
    x, z, half = -4.75, 1.79, 1.27
    ys = np.concatenate([[-half, -half + 0.02], np.linspace(-half + 0.1, half - 0.1, 9), [half - 0.02, half]])
    plane = wing([([x, y, z], 0.50 - 0.12 * (abs(y) > half - 0.01), 0.12, -0.03) for y in ys], [0, 0, 1.0], 12)
    plate = wing(
        [([x - 0.03 - 0.25 * abs(h), half, z + h], 0.58 - 0.7 * abs(h), 0.07, 0) for h in np.linspace(-0.32, 0.42, 9)],
        [0, 1.0, 0],
        10,
    )
    light = revolve([(0.0, 0.06), (0.018, 0.05), (0.028, 0.0), (0.018, -0.05), (0.0, -0.06)], 10, "x")
    return by_material(
        {"blue": plane},
        {"white": plate.pair()},
        {"red": light.moved([x + 0.08, half + 0.03, z]), "green": light.moved([x + 0.08, -half - 0.03, z])},
    )


def landing_gear() -> dict[str, Surface]:
    """Skids, their arched cross tubes with fairings, and the steps below the doors."""
    skid = tube(
        [
            [2.32, 1.10, 0.42],
            [2.22, 1.10, 0.27],
            [2.02, 1.10, 0.12],
            [1.72, 1.10, 0.052],
            [1.3, 1.10, 0.045],
            [0, 1.10, 0.045],
            [-1.55, 1.10, 0.045],
        ],
        [0.034, 0.042, 0.045, 0.045, 0.045, 0.045, 0.045],
        12,
        26,
    )
    shoe = box([2.4, 0.05, 0.03], [0.05, 1.10, 0.015], 0.008)
    tubes = []
    for x in (1.15, -0.72):
        path = [
            [x, y * s, z]
            for y, z, s in ((1.10, 0.06, 1), (1.04, 0.24, 1), (0.86, 0.46, 1), (0.55, 0.60, 1), (0.0, 0.64, 1))
        ]
        path += [[x, -p[1], p[2]] for p in path[-2::-1]]
        tubes.append(tube(path, 0.042, 12, 26))
    saddles = join(*(tube([[x - 0.11, 1.10, 0.049], [x + 0.11, 1.10, 0.049]], 0.048, 12) for x in (1.15, -0.72)))
    step = box([1.25, 0.16, 0.035], [1.10, 0.97, 0.43], 0.012)
    brackets = join(*(tube([[x, 0.97, 0.43], [x, 0.80, 0.56], [x, 0.70, 0.66]], 0.018, 8, 8) for x in (0.75, 1.5)))
    return by_material(
        {"dark": join(skid.pair(), *tubes, saddles.pair(), step.pair(), brackets.pair())},
        {"steel": shoe.pair()},
    )


def mast() -> dict[str, Surface]:
    """The fixed parts below the rotor head: the mast fairing and the fixed swash plate with its servo rods."""
    fairing = revolve([(0.0, 2.60), (0.34, 2.62), (0.30, 2.70), (0.20, 2.76), (0.12, 2.78), (0.0, 2.785)], 28)
    plate = revolve([(0.0, 2.795), (0.17, 2.795), (0.185, 2.805), (0.185, 2.825), (0.17, 2.835), (0.0, 2.835)], 28)
    rods = []
    for turn in np.radians([30, 150, 270]):
        c, s = np.cos(turn), np.sin(turn)
        rods.append(tube([[0.24 * c, 0.24 * s, 2.6], [0.165 * c, 0.165 * s, 2.81]], 0.018, 8))
    return by_material({"white": fairing}, {"metal": plate}, {"steel": join(*rods)})


def fittings() -> dict[str, Surface]:
    """Small fittings: handles, pitot tube, aerials, beacon, landing light, tail gearbox and drive shaft cover."""
    handles = [box([0.16, 0.03, 0.035], [x, HULL_WIDTH(x) - 0.002, 1.13], 0.008).pair() for x in (1.42, 0.2)]
    pitot = tube(
        [[3.28, 0.0, 1.45], [3.40, 0.0, 1.50], [3.52, 0, 1.50], [3.66, 0, 1.50]], [0.014, 0.013, 0.011, 0.009], 8, 10
    )
    belly = wing([([-0.2, 0, z], c, 0.12, 0) for z, c in ((0.66, 0.26), (0.45, 0.12))], [0, 1.0, 0], 8)
    whip = tube([[-3.4, 0, 1.94], [-3.52, 0, 2.22]], [0.012, 0.006], 8)
    beacon = revolve([(0.0, 3.10), (0.03, 3.09), (0.042, 3.05), (0.042, 3.0), (0.0, 3.0)], 14).moved([-6.92, 0, -0.01])
    lamp = revolve([(0.0, 0.588), (0.10, 0.592), (0.115, 0.61), (0.115, 0.70), (0.0, 0.70)], 20).moved([2.05, 0, 0])
    shaft = tube(
        [[-2.3, 0, 2.02], [-2.7, 0, 2.02], [-4.5, 0, 1.975], [-6.3, 0, 1.965], [-6.45, 0, 1.96]],
        [0.07, 0.085, 0.075, 0.07, 0.03],
        14,
        14,
    )
    gearbox = convex(
        np.concatenate(
            [
                revolve([(0.09, -0.12), (0.135, -0.05), (0.135, 0.08), (0.09, 0.17)], 18, "y")
                .moved([-6.35, 0.03, 2.12])
                .points,
            ]
        )
    )
    axle = tube([[-6.35, 0.1, 2.12], [-6.35, 0.30, 2.12]], [0.06, 0.035], 14)
    return by_material(
        {"dark": join(*handles, belly, whip), "metal": join(pitot, gearbox, axle)},
        {"red": beacon, "lamp": lamp, "blue": shaft},
    )


# ---------------------------------------------------------------- collision


def fuselage_hulls(look: dict[str, Surface]) -> dict[str, Surface]:
    """A few convex hulls that together contain every triangle of the fuselage; no triangle is split between regions."""
    everything = join(*look.values())
    centre = everything.points[everything.faces].mean(1)
    x, y, z = centre.T
    regions = {
        "gear_left": (z < 0.62) & (y > 0.62) & (x > -3),
        "gear_right": (z < 0.62) & (y < -0.62) & (x > -3),
        "tailplane": (np.abs(y) > 0.23) & (x < -3),
        "cowl": (z > 2.16) & (x > -3),
        "fin": (x < -5.55),
        "boom": (x < -2.2),
        "rear": (x < -0.4),
    }
    hulls, left = {}, np.ones(len(centre), bool)
    for name, region in {**regions, "cabin": left}.items():
        hulls[name] = outer_hull(everything.points[np.unique(everything.faces[left & region])])
        left = left & ~region
    return hulls
