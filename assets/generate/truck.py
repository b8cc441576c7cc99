"""The truck: `python -m vehsim.assets.generate truck` writes `assets/vehicles/truck/truck.usdc`.

A two-axle tractor, wheelbase 3.6 m, with a city semi-trailer: one axle 6.2 m behind the king pin, which is directly
above the tractor's rear axle. X forward, Y left, Z up; the root is on the ground midway between the tractor's axles.
Wheels turn about Y, the front ones are children of parts that steer about Z, and the trailer turns about Z on its king
pin.
"""

from __future__ import annotations

import numpy as np

from vehsim.assets.generate._shapes import (
    Surface,
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
    refined,
    revolve,
    seam,
    superellipse,
    tube,
)
from vehsim.assets.generate._slim import slimmed
from vehsim.assets.generate._usd import Material, PartShape
from vehsim.assets.generate._wheels import spoked_wheel, wheel_hull

AXLE, HALF_TRACK, RADIUS, WIDTH = 1.8, 1.03, 0.50, 0.36
HITCH = 6.2
DECK = 1.20
"""Height of the fifth wheel, on which the trailer rests, m."""
STEER_LIMIT = np.radians(45.0)

DOC = "Tractor and semi-trailer. X forward, Y left, Z up; root on the ground between the tractor's axles."

MATERIALS = {
    "paint": Material((0.42, 0.022, 0.016), roughness=0.28, clearcoat=1.0),
    "stripe": Material((0.62, 0.60, 0.55), roughness=0.35, clearcoat=0.6),
    "glass": Material((0.012, 0.016, 0.02), roughness=0.05, clearcoat=1.0),
    "trim": Material((0.035, 0.036, 0.038), roughness=0.6),
    "seal": Material((0.012, 0.012, 0.013), roughness=0.7),
    "frame": Material((0.055, 0.057, 0.06), roughness=0.55, metallic=0.3),
    "steel": Material((0.50, 0.51, 0.52), roughness=0.3, metallic=0.9),
    "box": Material((0.72, 0.73, 0.72), roughness=0.45, clearcoat=0.2),
    "band": Material((0.42, 0.022, 0.016), roughness=0.4, clearcoat=0.2),
    "lamp": Material((0.80, 0.82, 0.85), roughness=0.08, clearcoat=1.0, glow=(0.15, 0.15, 0.16)),
    "amber": Material((0.80, 0.30, 0.01), roughness=0.2, glow=(0.25, 0.09, 0.0)),
    "tail_lamp": Material((0.42, 0.006, 0.008), roughness=0.12, clearcoat=1.0, glow=(0.2, 0.0, 0.0)),
    "tyre": Material((0.018, 0.018, 0.019), roughness=0.85),
    "rim": Material((0.40, 0.405, 0.415), roughness=0.3, metallic=0.85),
    "hub": Material((0.16, 0.16, 0.165), roughness=0.4, metallic=0.6),
    "mark": Material((0.62, 0.60, 0.55), roughness=0.4),
}


def build() -> dict[str, PartShape]:
    """The truck's parts by name: tractor, its wheels, and the trailer with its own."""
    tractor = by_material(cab(), chassis(), mudguards())  # hulls from the full-resolution surfaces
    look = by_material(slimmed(cab(), 0.0005), slimmed(chassis(), 0.0005), mudguards())
    parts = {"tractor": PartShape(look=look, collision=tractor_hulls(tractor))}
    left = slimmed(spoked_wheel(RADIUS, WIDTH, rim=0.56, spokes=8, sides=40), 0.0012)
    for side, y in (("l", HALF_TRACK), ("r", -HALF_TRACK)):
        spun = left if y > 0 else {name: s.mirrored() for name, s in left.items()}
        still, steered = wheel_hull(0.0, RADIUS, WIDTH), wheel_hull(STEER_LIMIT, RADIUS, WIDTH)
        parts[f"wheel_r{side}"] = PartShape((-AXLE, y, RADIUS), spun, {"hull": still})
        front = PartShape((0.0, 0.0, 0.0), spun, {"hull": steered})
        parts[f"steer_f{side}"] = PartShape((AXLE, y, RADIUS), parts={f"wheel_f{side}": front})
    parts["trailer_1"] = trailer(left)
    return parts


# ---------------------------------------------------------------- cab


FRONT = curve([0.62, 1.0, 1.6, 2.6, 3.2, 3.45, 3.55], [3.13, 3.20, 3.20, 3.10, 2.98, 2.84, 2.62])
BACK = 1.02
HALF_WIDTH = curve([0.62, 1.0, 2.0, 3.0, 3.4, 3.55], [1.20, 1.235, 1.235, 1.19, 1.10, 0.96])


def cab() -> dict[str, Surface]:
    """The painted cab with windows, grille, bumper and lamps cut into it, with visor and mirrors."""
    zs = np.concatenate([np.linspace(0.62, 3.2, 22), np.linspace(3.25, 3.55, 8)])
    rows = []
    for z in zs:
        flat = superellipse((FRONT(z) - BACK) / 2, HALF_WIDTH(z), 9.0, 96)
        rows.append(np.column_stack([flat[:, 0] + (FRONT(z) + BACK) / 2, flat[:, 1], np.full(96, z)]))
    skin = lattice(rows, crease=45)
    skin = refined(refined(skin, 1, np.arange(-1.1, 1.11, 0.22)), 0, np.arange(1.2, 3.0, 0.2))
    skin, _ = front_arch(skin)
    ahead, beside = below_x(2.62), both_sides(lambda p: 1.0 - p[:, 1])
    door = both(polygon([(1.52, 0.95), (2.72, 0.95), (2.72, 2.72), (1.52, 2.72)], 0.07), beside)
    skin, lines = seam(skin, [door], 0.005)
    screen = both(polygon([(-1.07, 1.74), (1.07, 1.74), (1.02, 2.66), (-1.02, 2.66)], 0.10, (1, 2)), ahead)
    side = both(polygon([(1.62, 1.78), (2.66, 1.66), (2.62, 2.58), (1.62, 2.62)], 0.07), beside)
    grille = both(polygon([(-0.78, 0.98), (0.78, 0.98), (0.84, 1.58), (-0.84, 1.58)], 0.06, (1, 2)), ahead)
    bumper = lambda p: p[:, 2] - 0.86
    lamp = both(both_sides(polygon([(0.72, 0.68), (1.10, 0.68), (1.14, 0.83), (0.72, 0.80)], 0.02, (1, 2))), ahead)
    turn = both(both_sides(polygon([(1.02, 0.90), (1.19, 0.90), (1.19, 0.98), (1.02, 0.98)], 0.01, (1, 2))), ahead)
    step = both(polygon([(1.30, 0.5), (1.45, 0.5), (1.45, 0.9), (1.30, 0.9)]), beside)
    coats = [("glass", screen), ("glass", side), ("seal", grown(screen, 0.03)), ("seal", grown(side, 0.025))]
    coats += [("lamp", lamp), ("amber", turn), ("frame", grille), ("trim", step), ("trim", bumper)]
    look = painted(skin, coats, "paint")
    slats = join(*(box((0.03, 1.44, 0.035), (FRONT(z) - 0.005, 0, z), 0.01) for z in np.arange(1.06, 1.56, 0.095)))
    visor = box((0.22, 2.0, 0.10), (FRONT(2.72) + 0.09, 0, 2.80), 0.04, 3)
    wiper = [tube([(3.215, y, 1.70), (3.19, y + 0.48, 1.86)], 0.012, 6) for y in (-0.75, 0.1)]
    markers = join(*(box((0.06, 0.12, 0.05), (2.80, y, 3.50), 0.015) for y in (-0.75, 0.75)))
    stays = [tube([(2.9, 1.18, z), (3.0, 1.40, z)], 0.018, 8) for z in (1.75, 2.45)]
    mirror = join(box((0.10, 0.20, 0.72), (3.0, 1.42, 2.1), 0.04, 3), *stays).pair()
    return by_material(look, {"seal": join(lines, *wiper), "trim": join(visor, mirror, slats), "amber": markers})


def below_x(value: float):
    """The region ahead of ``value`` along X."""
    return lambda p: value - p[:, 0]


def front_arch(skin: Surface) -> tuple[Surface, Surface]:
    """The cab without its wheel arches, and the removed part."""
    from vehsim.assets.generate._shapes import split

    inside, rest = split(skin, both(lambda p: np.hypot(p[:, 0] - AXLE, p[:, 2] - RADIUS) - 0.62, below_side(0.6)))
    return rest, inside


def below_side(value: float):
    """The region farther than ``value`` from the middle plane."""
    return lambda p: value - np.abs(p[:, 1])


# ---------------------------------------------------------------- chassis


def chassis() -> dict[str, Surface]:
    """Rails, axles, tanks, fifth wheel, rear lamps."""
    rails = box((5.3, 0.10, 0.26), (0.15, 0.42, 0.90), 0.02).pair()
    cross = [box((0.14, 0.84, 0.16), (x, 0, 0.90), 0.02) for x in (-2.45, -1.2, -0.3, 0.7)]
    axles = [
        revolve([(0.0, -0.86), (0.09, -0.86), (0.09, 0.86), (0.0, 0.86)], 20, "y").moved((x, 0, RADIUS))
        for x in (-AXLE, AXLE)
    ]
    case = revolve([(0.0, -0.2), (0.14, -0.17), (0.24, 0.0), (0.14, 0.17), (0.0, 0.2)], 24, "y").moved(
        (-AXLE, 0, RADIUS)
    )
    well = box((1.5, 1.5, 0.8), (1.95, 0, 1.05), 0.05)
    plate = revolve([(0.0, 0.0), (0.46, 0.0), (0.48, 0.03), (0.48, 0.06), (0.0, 0.06)], 40).moved(
        (-AXLE, 0, DECK - 0.07)
    )
    feet = [box((0.5, 0.16, 0.13), (-AXLE, y, DECK - 0.125), 0.02) for y in (-0.36, 0.36)]
    tank = revolve([(0.0, -0.62), (0.30, -0.62), (0.33, -0.58), (0.33, 0.58), (0.30, 0.62), (0.0, 0.62)], 40, "x")
    tanks = tank.moved((-0.05, 0.86, 0.72)).pair()
    straps = join(
        *(
            revolve([(0.335, -0.03), (0.345, -0.03), (0.345, 0.03), (0.335, 0.03)], 40, "x").moved((x, 0.86, 0.72))
            for x in (-0.4, 0.3)
        )
    ).pair()
    lamps = box((0.05, 0.34, 0.12), (-2.50, 0.62, 0.86), 0.015).pair()
    stack = tube([(0.86, -0.78, 1.0), (0.86, -0.78, 2.9), (0.80, -0.78, 3.15)], 0.075, 16)
    shield = box((0.04, 2.0, 1.3), (0.98, 0, 1.85), 0.015)
    return {
        "frame": join(rails, *cross, *axles, case, well, *feet, shield),
        "steel": join(plate, tanks, stack),
        "trim": straps,
        "tail_lamp": lamps,
    }


def mudguards() -> dict[str, Surface]:
    """Arched guards over the rear wheels."""
    turn = np.radians(np.linspace(18, 162, 24))
    loops = []
    for t in turn:
        c, s = np.cos(t), np.sin(t)
        loops.append(
            [(-AXLE + r * c, y, RADIUS + r * s) for r, y in ((0.57, 0.83), (0.57, 1.24), (0.60, 1.24), (0.60, 0.83))]
        )
    return {"trim": lattice(np.array(loops), crease=40).pair()}


def tractor_hulls(look: dict[str, Surface]) -> dict[str, Surface]:
    """Two hulls: the cab, and the chassis behind it."""
    points = np.concatenate([s.points for s in look.values()])
    cut = BACK - 0.05
    return {
        "hull_cab": outer_hull(points[points[:, 0] > cut - 0.4], 14.0),
        "hull_rear": outer_hull(np.concatenate([points[points[:, 0] < cut], _rails_at(cut)]), 16.0),
    }


def _rails_at(x: float) -> np.ndarray:
    """Corners of the rails and tanks where the hulls meet, so that no gap is left."""
    return np.array([(x, y, z) for y in (-1.2, 1.2) for z in (0.4, 1.1)])


# ---------------------------------------------------------------- trailer


FRONT_END, TAIL, ROOF, FLOOR = 1.15, -8.55, 2.62, 0.02
"""Dimensions of the box, m from the king pin: ahead, behind, and heights above the fifth wheel."""


def trailer(wheel: dict[str, Surface]) -> PartShape:
    """The semi-trailer about its king pin, its wheels one hitch behind."""
    shell = box((FRONT_END - TAIL, 2.5, ROOF - FLOOR), ((FRONT_END + TAIL) / 2, 0, (ROOF + FLOOR) / 2), 0.05, 3)
    shell = refined(refined(shell, 0, np.arange(TAIL + 0.6, FRONT_END, 0.9)), 2, np.arange(0.4, ROOF, 0.5))
    ribs = join(
        *(box((0.03, 0.012, 2.2), (x, 1.252, 1.32), 0.003) for x in np.arange(TAIL + 1.2, FRONT_END, 1.2))
    ).pair()
    sides = below_side(1.2)
    slant = polygon([(-3.4, -0.2), (-1.2, -0.2), (0.5, 3.0), (-1.7, 3.0)])
    slim = polygon([(-4.1, -0.2), (-3.7, -0.2), (-2.0, 3.0), (-2.4, 3.0)])
    split_doors = box((0.02, 0.014, 2.4), (TAIL - 0.001, 0, 1.32), 0.002)
    coats = [("band", both(sides, slant)), ("band", both(sides, slim))]
    look = painted(shell, coats, "box")
    bars = [tube([(TAIL - 0.03, y, 0.15), (TAIL - 0.03, y, ROOF - 0.12)], 0.018, 10) for y in (-0.9, -0.25, 0.25, 0.9)]
    rails = box((8.0, 0.12, 0.24), (-4.3, 0.45, -0.14), 0.02).pair()
    axle = revolve([(0.0, -0.86), (0.09, -0.86), (0.09, 0.86), (0.0, 0.86)], 20, "y").moved((-HITCH, 0, RADIUS - DECK))
    hanger = box((0.9, 0.12, 0.36), (-HITCH, 0.55, -0.36), 0.03).pair()
    legs = join(box((0.14, 0.14, 0.72), (-2.75, 0.75, -0.40), 0.02), box((0.3, 0.3, 0.05), (-2.75, 0.75, -0.77), 0.015))
    guard = join(
        box((0.10, 2.3, 0.14), (TAIL + 0.1, 0, -0.62), 0.02),
        box((0.08, 0.10, 0.62), (TAIL + 0.1, 0.6, -0.32), 0.01).pair(),
    )
    skirt = join(*(box((2.2, 0.03, 0.12), (-4.25, 1.2, z), 0.01) for z in (-0.25, -0.50))).pair()
    posts = join(*(box((0.06, 0.05, 0.6), (x, 1.18, -0.28), 0.01) for x in (-5.2, -4.25, -3.3))).pair()
    lamps = join(box((0.05, 0.36, 0.13), (TAIL + 0.03, 0.95, -0.45), 0.015)).pair()
    amber = join(*(box((0.12, 0.03, 0.06), (x, 1.255, 0.10), 0.01) for x in (0.6, -2.0, -4.6, -7.8))).pair()
    hang = join(box((0.3, 0.03, 0.09), (-4.25, 1.16, -0.05), 0.01)).pair()
    turn = np.radians(np.linspace(15, 165, 22))
    guards = lattice(
        np.array(
            [
                [
                    (-HITCH + r * np.cos(t), y, RADIUS - DECK + r * np.sin(t))
                    for r, y in ((0.56, 0.83), (0.56, 1.23), (0.585, 1.23), (0.585, 0.83))
                ]
                for t in turn
            ]
        ),
        crease=40,
    ).pair()
    extra = {
        "frame": join(rails, axle, hanger, legs.pair(), guard, posts, hang),
        "steel": join(*bars, skirt, ribs),
        "tail_lamp": lamps,
        "amber": amber,
        "trim": join(guards, split_doors),
    }
    look = by_material(look, extra)
    points = np.concatenate([s.points for s in look.values()])
    hulls = {
        "hull_box": outer_hull(points[points[:, 2] > 0.0], 16.0),
        "hull_under": outer_hull(points[(points[:, 2] < 0.1) & (points[:, 0] < -2.5)], 16.0),
        "hull_neck": outer_hull(points[(points[:, 2] < 0.1) & (points[:, 0] > -2.9) & (points[:, 2] > -0.27)], 16.0),
    }
    wheels = {}
    for side, y in (("l", HALF_TRACK), ("r", -HALF_TRACK)):
        spun = wheel if y > 0 else {name: s.mirrored() for name, s in wheel.items()}
        wheels[f"wheel_t1_{side}"] = PartShape(
            (-HITCH, y, RADIUS - DECK), spun, {"hull": wheel_hull(0.0, RADIUS, WIDTH)}
        )
    return PartShape((-AXLE, 0.0, DECK), slimmed(look, 0.0005), hulls, wheels)
